"""Make docs/images/replay.png, the picture in the README, from the results of the demo.

    trainlog demo --output results
    python docs/make_screenshot.py results/replay.rrd

Needs a Vulkan driver, in software too (Debian: mesa-vulkan-drivers), but no screen.
"""

from __future__ import annotations

import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from PIL import Image

from trainlog.replay import take_picture

IMAGE = Path(__file__).parent / "images" / "replay.png"
SIZE = 1600, 1000
MENU = 36  # height of the viewer's own menu, which is cut off
INSTANT = 600_000_000_000  # ten minutes after departure


def main(recording: Path) -> None:
    """Picture of a replay, ten minutes after its trips began."""
    IMAGE.parent.mkdir(exist_ok=True)
    with TemporaryDirectory() as folder:
        whole = Path(folder) / "replay.png"
        take_picture(recording, whole, size=SIZE, timeline="elapsed", at=INSTANT)
        with Image.open(whole) as picture:
            picture.crop((0, MENU, *SIZE)).convert("RGB").save(IMAGE, optimize=True)
    print(f"wrote {IMAGE}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "results/replay.rrd"))
