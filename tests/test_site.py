"""The documentation's site, built from a copy of the checkout, in a browser and in a wheel."""

from __future__ import annotations

import re
import shutil
import subprocess
import sys
import sysconfig
from pathlib import Path
from urllib.parse import unquote, urlsplit

import pytest
from test_public import CHECKOUT, OUTSIDE, environment, install, trainlog
from test_report_page import Outline

sys.path.append(str(CHECKOUT / "docs" / "tools"))
from screenshot import browser_page, chromium

pytestmark = pytest.mark.long

MOST_BYTES = 25_000_000
LOUD, LOCAL = ("error", "warning"), ("file:", "data:", "blob:")


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout with its site built, which must not give a single warning."""
    copy = tmp_path_factory.mktemp("site") / "checkout"
    names = (".git", ".venv", "build", "dist", "results", "__pycache__", ".*_cache", ".hypothesis")
    shutil.copytree(CHECKOUT, copy, ignore=shutil.ignore_patterns(*names))
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    known = {**OUTSIDE, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=copy, capture_output=True, text=True, timeout=1200, env=known
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return copy


@pytest.fixture(scope="module")
def site(checkout: Path) -> Path:
    return checkout / "build" / "site"


def test_every_link_leads_to_a_file_and_a_place_in_it(site):
    pages = {path: Outline(path.read_text("utf-8")) for path in site.rglob("*.html")}
    anchors = {path: set(page.values("id", "name")) for path, page in pages.items()}
    lost = []
    for page, outline in pages.items():
        if page.name == "404.html":  # for servers: its links begin at their root
            continue
        for target in outline.values("href", "src"):
            parts = urlsplit(target)
            if parts.scheme:
                continue
            path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            path = path / "index.html" if path.is_dir() else path
            fragment = unquote(parts.fragment)
            known = anchors.get(path)
            if not path.is_file() or (known is not None and fragment and fragment not in known):
                lost.append(f"{page.relative_to(site)}: {target}")
    assert lost == []
    assert len(pages) > 30
    assert sum(path.stat().st_size for path in site.rglob("*") if path.is_file()) < MOST_BYTES


def test_executed_pages_show_what_their_code_printed_and_drew(site):
    engineer = (site / "tutorials" / "engineer.html").read_text("utf-8")
    assert re.search(r"Running resistance of CH_Stadler_FLIRT_TPF: N", engineer)
    developer = (site / "tutorials" / "developer.html").read_text("utf-8")
    assert "<b>Track-condition map of line" in developer
    gallery = (site / "gallery.html").read_text("utf-8")
    assert len(re.findall(r"<img [^>]*src=", gallery)) >= 13


@pytest.mark.skipif(chromium() is None, reason="there is no Chromium")
def test_pages_are_whole_in_a_browser_without_a_network(site):
    """No errors on the console, no request to anywhere else, every picture drawn."""
    wrong = []
    with browser_page(viewport={"width": 1280, "height": 900}) as page:
        page.on("console", lambda said: said.type in LOUD and wrong.append((page.url, said.text)))
        page.on("pageerror", lambda error: wrong.append((page.url, str(error))))
        page.on("requestfailed", lambda asked: wrong.append((page.url, asked.url)))
        page.on("request", lambda asked: asked.url.startswith(LOCAL) or wrong.append(asked.url))
        for path in sorted(site.rglob("*.html")):
            if path.name == "404.html":
                continue
            page.goto(path.as_uri())
            empty = "[...document.images].filter(i => !(i.complete && i.naturalWidth)).length"
            assert page.evaluate(empty) == 0, path
            wide = page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert wide <= 0, f"{path.name} is {wide} px wider than the window"
    assert wrong == []


@pytest.mark.skipif(chromium() is None, reason="there is no Chromium")
def test_the_search_finds_a_word_without_a_server(site):
    with browser_page() as page:
        page.goto((site / "index.html").as_uri())
        page.keyboard.press("/")
        page.wait_for_selector(".md-search__input:focus")
        page.keyboard.type("recursive least squares")
        page.wait_for_selector(".md-search-result__item", timeout=10_000)
        assert page.locator(".md-search-result__item").count() >= 3
        found = page.locator(".md-search-result__list").inner_text().lower()
        assert "recursive" in found


def test_a_wheel_made_after_the_site_holds_it_and_opens_it(checkout, tmp_path):
    """The wheel is that of the source distribution, as `python -m build` makes both."""
    make = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path / "dist")]
    done = subprocess.run([*make, str(checkout)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    python, packages = environment(tmp_path / "environment")
    install(python, "--no-deps", "--no-index", str(wheel), timeout=300)
    (packages / "third_party.pth").write_text(sysconfig.get_path("purelib") + "\n")
    page = trainlog(python, "docs", "planner", "--path", cwd=tmp_path).strip()
    assert Path(page).parts[-4:] == ("documentation_pages", "site", "tutorials", "planner.html")
    assert Path(page).is_relative_to(python.parents[1])
    place = trainlog(python, "docs", "analysis.fit", "--path", cwd=tmp_path).strip()
    assert place.endswith("reference/resistance.html#analysis.fit")
    assert "tutorials/planner" in trainlog(python, "docs", "--list", cwd=tmp_path)
