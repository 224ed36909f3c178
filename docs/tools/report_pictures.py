"""Take the pictures of the reports in the documentation, from the samples alone.

    make report-pictures

Needs Chromium and the extras `report` and `plan`.
"""

from __future__ import annotations

import io
import sys
import tempfile
from pathlib import Path
from typing import Any

from PIL import Image
from screenshot import browser_page, chromium

from analysis.reports.build import ReportOptions, write_report
from analysis.reports.results import write_driver_advice
from analysis.reports.trip import known_zone
from analysis.trajectory.advice import time_of_day
from analysis.trajectory.journey import optimise_journey
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from trainlog.formats.railway import read_line, read_train, write_trajectory
from trainlog.formats.samples import sample
from trainlog.railway import Configuration, Journey, TimingPoint

IMAGES = Path(__file__).parents[1] / "images"
WIDTH = 1000

PICTURES = (
    # name, page, colour scheme, first heading that is shown, height [px], where the pointer is
    ("report-trip", "trip", "light", "Speed and efforts", 1010, (0.45, 0.12)),
    ("report-trip-dark", "trip", "dark", "Stops and stations", 760, None),
    ("report-map", "map", "light", "Track condition", 1010, None),
    ("report-advice", "advice", "light", None, 1150, None),
)


def main() -> None:
    """Make the pages in a folder of their own, and the pictures of them."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        options = ReportOptions(zone=known_zone("Europe/Zurich"))
        write_report(sample("stopping.mcap"), folder / "trip.html", options)
        write_report(sample("CH_StGallen_Wil.map"), folder / "map.html")
        _advice(folder)
        _pictures(folder)


def _advice(folder: Path) -> None:
    """A journey with all stops, at 07:12."""
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    points = [TimingPoint(each.position, None, None, 0.0, 0.0) for each in line.stations]
    journey = Journey("S1", line.name, tuple(points))
    problem = TrajectoryProblem(line, train, [Configuration.of(train)], reserve=0.1)
    plan = optimise_journey(problem, journey, OptimiserOptions(cells=150), dwell=40.0)
    files = []
    for section in plan.sections:
        files.append(folder / f"plan-{len(files) + 1}.json")
        write_trajectory(section, files[-1])
    start = time_of_day("07:12")
    write_driver_advice(files, folder / "advice.html", folder / "advice.csv", start=start)


def _pictures(folder: Path) -> None:
    if chromium() is None:
        sys.exit("no Chromium here: apt-get install chromium")
    for name, page, scheme, heading, height, pointer in PICTURES:
        size = {"width": WIDTH, "height": height}
        with browser_page(viewport=size, color_scheme=scheme) as opened:
            opened.goto((folder / f"{page}.html").as_uri())
            opened.wait_for_selector("html.drawn")
            if heading is not None:
                shown = opened.locator("h2", has_text=heading).first
                shown.evaluate("each => window.scrollTo(0, each.offsetTop - 12)")
            if pointer is not None:
                _point(opened, *pointer)
            opened.wait_for_timeout(500)
            _write(opened.screenshot(), IMAGES / f"{name}.png")


def _point(page: Any, across: float, down: float) -> None:
    box = page.locator(".plot").first.bounding_box()
    place = box["x"] + across * box["width"], box["y"] + down * box["height"]
    page.mouse.move(place[0] - 5, place[1])
    page.mouse.move(*place)


def _write(data: bytes, path: Path) -> None:
    """With as many colours as such a picture needs: a third of the size."""
    picture = Image.open(io.BytesIO(data)).convert("RGB")
    picture.quantize(128, dither=Image.Dither.NONE).save(path, optimize=True)
    print(f"wrote {path}, {path.stat().st_size // 1000} kB")


if __name__ == "__main__":
    main()
