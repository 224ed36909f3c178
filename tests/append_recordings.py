"""Add recordings to a map's file and state each when it is on the disk: run by the tests.

    python tests/append_recordings.py MAP RECORDINGS

`RECORDINGS` is a pickle of the empty map and the recordings.
"""

from __future__ import annotations

import pickle
import sys
from pathlib import Path

from trainlog.formats.mapfile import MapFile

if __name__ == "__main__":
    empty, recordings = pickle.loads(Path(sys.argv[2]).read_bytes())
    print("ready", flush=True)
    with MapFile(sys.argv[1], empty) as file:
        for recording in recordings:
            file.append(recording)
            print(recording.trip, flush=True)
