"""Make the pictures of the replay, docs/images/replay*.png, from the results of the demo.

    trainlog demo --output results
    python docs/make_screenshot.py results

One of each named view, and of trips over each other. Needs a Vulkan driver, in software too
(Debian: mesa-vulkan-drivers), but no screen.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

import trainlog
from trainlog.replay import HeadlessViewer, headless_viewer, write_replay

IMAGES = Path(__file__).parent / "images"
SIZE = 1600, 964
PLACE = 14_370
"""Where the cursor stands in pictures by position: before Flawil [m]."""

INSTANT = 600_000_000_000
"""Where it stands in pictures by time: ten minutes after departure [ns]."""


def main(results: Path) -> None:
    """Pictures of one trip with all that the demo has made of it, and of several."""
    IMAGES.mkdir(exist_ok=True)
    estimated = [trainlog.read(log) for log in sorted((results / "estimated").glob("*.mcap"))]
    trips = [trainlog.read(log) for log in sorted((results / "trips").glob("*.mcap"))[:10:2]]
    known = {
        "trajectory": trainlog.read_trajectory(results / "trajectory.json"),
        "condition_map": trainlog.read_map(results / "wil.map"),
    }
    with TemporaryDirectory() as folder:
        alone, together = Path(folder) / "alone.rrd", Path(folder) / "together.rrd"
        write_replay(estimated[:1], alone, **known)
        with headless_viewer(alone, size=SIZE) as viewer:
            for view in viewer.views():
                viewer.show(view)
                by_place = view == "map"
                viewer.set_time(
                    "position_m" if by_place else "elapsed", PLACE if by_place else INSTANT
                )
                save(viewer, "replay" if view == "overview" else f"replay-{view}")
        write_replay(trips, together, **known)
        with headless_viewer(together, size=SIZE) as viewer:
            viewer.set_time("position_m", PLACE)
            save(viewer, "replay-together")


def save(viewer: HeadlessViewer, name: str) -> None:
    """Save what is shown, in few colours."""
    target = IMAGES / f"{name}.png"
    with TemporaryDirectory() as folder:
        whole = Path(folder) / "whole.png"
        viewer.picture(whole)
        with Image.open(whole) as picture:
            few = picture.quantize(255, dither=Image.Dither.NONE)
            few.save(target, optimize=True)
    print(f"wrote {target}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results"))
