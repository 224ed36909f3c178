"""Make docs/images/site.png, the picture of the documentation's first page, from build/site.

    make docs
    python docs/tools/screenshot.py

Needs Chromium.
"""

from __future__ import annotations

import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from shutil import which
from typing import Any

CHECKOUT = Path(__file__).resolve().parents[2]
IMAGE = CHECKOUT / "docs" / "images" / "site.png"
OPTIONS = ["--no-sandbox", "--disable-gpu", "--no-first-run", "--disable-background-networking"]


def chromium() -> str | None:
    """The distribution's Chromium, if there is one."""
    return which("chromium") or which("chromium-browser") or which("google-chrome")


@contextmanager
def browser_page(**options: Any) -> Iterator[Any]:
    """An empty page of a headless browser."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium(), args=OPTIONS)
        try:
            yield browser.new_page(**options)
        finally:
            browser.close()


def main(site: Path) -> None:
    """Picture of the first page of a site, half in light and half in dark."""
    from io import BytesIO

    from PIL import Image

    shots = []
    for scheme in ("light", "dark"):
        with browser_page(viewport={"width": 1280, "height": 900}, color_scheme=scheme) as page:
            page.goto((site / "index.html").as_uri())
            page.wait_for_timeout(500)
            shots.append(Image.open(BytesIO(page.screenshot())).convert("RGB"))
    light, dark = shots
    half = light.width // 2
    light.paste(dark.crop((half, 0, dark.width, dark.height)), (half, 0))
    light.convert("P", palette=Image.Palette.ADAPTIVE).save(IMAGE, optimize=True)
    print(f"wrote {IMAGE}")


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else CHECKOUT / "build" / "site")
