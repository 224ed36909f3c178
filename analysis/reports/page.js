"use strict";
(() => {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const style = getComputedStyle(document.documentElement);
  const colour = (name) => style.getPropertyValue("--" + name).trim();
  const documents = [];
  const originals = new Map();
  const names = new Map();
  const paint = () => {
    for (const doc of documents) {
      for (const model of doc._all_models.values()) {
        if (model.type === "AreaVisuals") continue;
        const set = {};
        for (const property of Object.keys(model.attributes)) {
          if (!property.endsWith("color")) continue;
          const key = model.id + "." + property; // identifiers are unique on the page
          if (!originals.has(key)) originals.set(key, model.attributes[property]);
          const before = originals.get(key);
          const name = names.get(String(before && before.value !== undefined ? before.value : before).toLowerCase());
          if (name === undefined) continue;
          set[property] = before && before.value !== undefined ? {value: colour(name)} : colour(name);
        }
        if (Object.keys(set).length > 0) model.setv(set);
      }
    }
  };
  const toggle = (key) => {
    const hidden = key.classList.toggle("hidden");
    const plots = [...key.closest(".plot, .row").querySelectorAll("[id^=plot-]")].map((each) => each.id + "-");
    for (const doc of documents) {
      for (const model of doc._all_models.values()) {
        const here = plots.some((each) => model.id.startsWith(each));
        if (here && model.name === key.dataset.name) model.visible = !hidden;
      }
    }
  };
  const start = async () => {
    Bokeh.set_log_level("warn");
    for (const [name, value] of Object.entries(JSON.parse(document.documentElement.dataset.colours))) {
      names.set(value.toLowerCase(), name);
    }
    document.documentElement.classList.add("interactive");
    for (const script of document.querySelectorAll("script[data-plot]")) {
      const views = await Bokeh.embed.embed_item(JSON.parse(script.textContent));
      for (const view of views) documents.push(view.model.document);
    }
    for (const key of document.querySelectorAll(".key")) key.addEventListener("click", () => toggle(key));
    paint();
    dark.addEventListener("change", paint);
    const folded = [...document.querySelectorAll("details:not([open])")];
    addEventListener("beforeprint", () => folded.forEach((each) => { each.dataset.closed = !each.open; each.open = true; }));
    addEventListener("afterprint", () => folded.forEach((each) => { each.open = each.dataset.closed !== "true"; }));
    document.documentElement.classList.add("drawn");
  };
  start().catch((error) => {
    document.documentElement.classList.remove("interactive");
    console.error(error);
  });
})();
