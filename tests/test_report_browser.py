"""Reports in a real browser: drawn, light and dark, under the pointer and printed; no network."""

from __future__ import annotations

import re
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from report_folder import SCRIPT, make_folder

from analysis.reports.build import write_report

pytestmark = pytest.mark.long
BROWSERS = ("chromium", "chromium-browser", "google-chrome")

PAGE_WIDTH, PAGE_HEIGHT = 688, 1009
"""What A4 has within the margins [px], 96 to the inch."""

CANVASES = """() => {
    const found = [];
    const walk = (root) => {
        for (const each of root.querySelectorAll("*")) {
            if (each.tagName === "CANVAS" && each.width > 0) found.push(each);
            if (each.shadowRoot) walk(each.shadowRoot);
        }
    };
    walk(document);
    return found.map((canvas) => {
        const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
        const colours = new Set();
        for (let i = 0; i < data.length; i += 4 * 37) colours.add(data.slice(i, i + 4).join(","));
        return {width: canvas.width, height: canvas.height, colours: colours.size,
                corner: [...data.slice(12 * canvas.width + 12, 12 * canvas.width + 16)]};
    });
}"""
"""Of each canvas: its size, the colours in it, and the colour near its corner."""

TOOLTIP = """() => {
    const texts = [];
    const walk = (root) => {
        for (const each of root.querySelectorAll("*")) {
            if (each.classList.contains("bk-Tooltip") && each.getClientRects().length)
                texts.push(each.shadowRoot ? each.shadowRoot.textContent : each.textContent);
            if (each.shadowRoot) walk(each.shadowRoot);
        }
    };
    walk(document);
    return texts.join(" ");
}"""


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory, remembered: None) -> Path:
    """The report on a folder with results of every kind, and a file that is none."""
    del remembered
    folder = make_folder(tmp_path_factory.mktemp("browser") / "results")
    write_report(folder, folder.parent / "report.html")
    return folder.parent / "report.html"


@pytest.fixture(scope="module")
def browser() -> Iterator[Any]:
    """One Chromium for all tests; it reaches no network."""
    program = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if program is None:
        pytest.skip("no Chromium here: 'apt-get install chromium' has it")
    playwright = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    switches = ["--no-sandbox", "--disable-gpu", "--no-first-run"]
    with playwright.sync_playwright() as running:
        opened = running.chromium.launch(
            executable_path=program, args=[*switches, "--disable-background-networking"]
        )
        yield opened
        opened.close()


class Opened:
    """A report as it stands in the browser, with all that it complained of and asked for."""

    def __init__(self, browser: Any, file: Path, scheme: str) -> None:
        self.context = browser.new_context(
            viewport={"width": 1200, "height": 900}, color_scheme=scheme
        )
        self.page = self.context.new_page()
        self.complaints = list[str]()
        self.requests = list[str]()
        self.page.on("console", lambda said: self._heard(said.type, said.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda asked: self.requests.append(asked.url))
        self.page.goto(file.as_uri())
        self.page.wait_for_selector("html.drawn", timeout=30_000)
        self.page.wait_for_timeout(300)

    def _heard(self, kind: str, words: str) -> None:
        # How fast BokehJS reads its canvases back is not ours to say.
        if kind in ("error", "warning") and not words.startswith("Canvas2D: Multiple readback"):
            self.complaints.append(words)


@pytest.fixture(scope="module")
def light(browser: Any, page_file: Path) -> Iterator[Opened]:
    opened = Opened(browser, page_file, "light")
    yield opened
    opened.context.close()


@pytest.fixture(scope="module")
def dark(browser: Any, page_file: Path) -> Iterator[Opened]:
    opened = Opened(browser, page_file, "dark")
    yield opened
    opened.context.close()


def test_every_picture_is_drawn_light_and_dark_and_nothing_is_asked_for(light, dark, page_file):
    assert SCRIPT in light.page.inner_text("main"), "a name that is a script is only shown"
    grounds = {}
    for name, opened in (("light", light), ("dark", dark)):
        assert opened.complaints == []
        assert opened.requests == [page_file.as_uri()]
        sizes = opened.page.locator("figure svg, figure img").evaluate_all(
            "all => all.filter(each => !each.closest('.still'))"
            ".map(each => [each.getBoundingClientRect().width,"
            " each.tagName === 'IMG' ? each.naturalHeight : each.getBBox().height])"
        )
        assert all(width > 200 and height > 50 for width, height in sizes)
        canvases = opened.page.evaluate(CANVASES)
        plots = opened.page.locator(".plot").count()
        assert len(sizes) + plots >= 9
        # Above each chart lies one for what the pointer shows, which is empty as yet.
        charts = [each for each in canvases if each["height"] > 80 and each["corner"][3]]
        assert len(charts) >= plots
        assert all(each["colours"] >= 3 for each in charts)
        grounds[name] = {tuple(each["corner"]) for each in charts}
    # A chart has the ground of its page.
    assert grounds["light"] == {(255, 255, 255, 255)}
    assert grounds["dark"] == {(22, 24, 28, 255)}


def test_the_pointer_shows_values_and_a_name_in_the_legend_hides_its_curve(light):
    plot = light.page.locator(".plot").first
    plot.scroll_into_view_if_needed()
    box = plot.bounding_box()
    assert light.page.evaluate(TOOLTIP) == ""
    for share in (0.4, 0.5):
        light.page.mouse.move(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
    light.page.wait_for_timeout(300)
    shown = light.page.evaluate(TOOLTIP)
    assert re.search(r"\d km/h", shown)
    assert "kN" in shown
    key = light.page.locator(".key", has_text="permitted speed").first
    visible = """() => [...Bokeh.documents].flatMap(each => [...each._all_models.values()])
        .filter(each => each.name === "permitted speed").map(each => each.visible)"""
    before = light.page.evaluate(visible)
    key.click()
    assert light.page.evaluate(visible).count(False) == 1
    key.click()
    assert light.page.evaluate(visible) == before


def test_printed_pages_cut_no_row_and_no_picture(light):
    light.page.set_viewport_size({"width": PAGE_WIDTH, "height": PAGE_HEIGHT})
    light.page.emulate_media(media="print")
    whole = light.page.locator("figure, tr").evaluate_all(
        "all => all.map(each => [getComputedStyle(each).breakInside,"
        " each.getBoundingClientRect().height])"
    )
    assert {rule for rule, _ in whole} == {"avoid"}
    assert max(height for _, height in whole) <= PAGE_HEIGHT
    wide = light.page.locator(".table").evaluate_all(
        "all => all.filter(each => each.scrollWidth > each.clientWidth + 1).length"
    )
    assert wide == 0
    stills = light.page.locator(".still").evaluate_all(
        "all => all.map(each => each.getBoundingClientRect().height)"
    )
    assert min(stills) > 100
    assert light.page.locator(".plot").first.is_hidden()
    repeated = light.page.locator("thead").first.evaluate("each => getComputedStyle(each).display")
    assert repeated == "table-header-group"
    pdf = light.page.pdf(prefer_css_page_size=True)
    boxes = re.findall(rb"/MediaBox\s*\[0 0 ([\d.]+) ([\d.]+)\]", pdf)
    assert len(boxes) >= 8
    # A4, in points.
    assert {(round(float(a)), round(float(b))) for a, b in boxes} <= {(595, 842), (596, 842)}
    light.page.emulate_media(media="screen")
    light.page.set_viewport_size({"width": 1200, "height": 900})


def test_on_a_narrow_screen_tables_scroll_and_charts_are_drawn_to_the_width(light):
    light.page.set_viewport_size({"width": 390, "height": 800})
    light.page.evaluate("() => document.querySelectorAll('details').forEach(d => d.open = true)")
    light.page.wait_for_timeout(1_500)
    try:
        assert light.page.evaluate("() => document.documentElement.scrollWidth") <= 390
        wide = light.page.locator(".table").evaluate_all(
            "all => all.filter(each => each.scrollWidth > each.clientWidth + 1)"
            ".map(each => getComputedStyle(each).overflowX)"
        )
        assert set(wide) == {"auto"}
        charts = [each for each in light.page.evaluate(CANVASES) if each["height"] > 80]
        assert charts
        assert all(200 < each["width"] <= 390 for each in charts)
    finally:
        fold = "() => document.querySelectorAll('details').forEach(d => d.open = false)"
        light.page.evaluate(fold)
        light.page.set_viewport_size({"width": 1200, "height": 900})
        light.page.wait_for_timeout(500)


def test_details_are_folded_on_a_screen_and_open_in_print(light):
    seen = "all => all.map(each => each.checkVisibility())"
    folded = light.page.locator("details .inner")
    assert not any(folded.evaluate_all(seen))
    light.page.emulate_media(media="print")
    printed = folded.evaluate_all(seen)
    light.page.emulate_media(media="screen")
    assert all(printed)
    # The contents lead into what is folded, and open it.
    light.page.locator("nav a").last.click()
    light.page.wait_for_timeout(200)
    assert folded.evaluate_all(seen)[-1]
