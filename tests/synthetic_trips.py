"""Trips for the catalogue without logs: what registering asks of a file, drawn from a seed."""

import numpy as np
import pandas as pd

from trainlog.catalogue import FileEntry, LogEntry
from trainlog.formats.files import sha256
from trainlog.identity import TripIdentity

DAY = 86_400_000_000_000
FIRST = pd.Timestamp("2026-01-01", tz="UTC").value


def synthetic_entry(number: int, seed: int = 1, trains: int = 20, days: int = 365) -> FileEntry:
    """The file of a trip that has never been driven; the same number gives the same."""
    rng = np.random.default_rng([seed, number])
    train, line = f"flirt-{rng.integers(trains):02d}", f"line {rng.integers(10)}"
    start = FIRST + int(rng.integers(days)) * DAY + int(rng.integers(DAY))
    minutes = int(rng.integers(12, 60))
    end = start + minutes * 60_000_000_000
    length = float(rng.uniform(5e3, 9e4))
    km = float(rng.uniform(0.0, 50.0))
    direction = ("forward", "reverse")[number % 2]
    blocks = np.unique(rng.integers(0, 2**64, minutes, dtype=np.uint64))
    values = {
        "name": f"trip-{number:06d}",
        "train": train,
        "kind": None if number % 7 == 0 else ("FLIRT", "KISS", "Re 460")[number % 3],
        "line": line,
        "direction": direction,
        "start": start,
        "end": end,
        "duration": (end - start) / 1e9,
        "distance": length,
        "km_from": km,
        "km_to": km + length / 1e3,
        "weather": [None, "dry", "wet", "leaves"][int(rng.integers(4))],
        "load": None if number % 5 == 0 else float(rng.uniform(0.0, 4e4)),
        "labels": {"configuration": str(number % 4), "clock": "UTC"},
        "topics": {"/train/state": minutes * 600, "/train/axles": (number % 2) * minutes * 60},
        "passport": {"effort_gain": float(rng.normal(1.0, 0.02))} if number % 3 else {},
        "quality": "whole",
        "damage": "",
        "repairs": int(rng.integers(0, 30)),
        "samples": minutes * 600,
        "messages": minutes * 2000,
        "software": "trainlog 0.1.0",
    }
    ends = (pd.Timestamp(each, tz="UTC") for each in (start, end))
    identity = TripIdentity(*ends, minutes * 600, blocks)
    edges = ((line, values["km_from"], values["km_to"], direction),)
    if number % 4 == 0:
        edges += ((f"line {(int(line[-1]) + 1) % 10}", 0.0, 5.0, direction),)
    entry = LogEntry(values, edges, identity)
    path = f"/fleet/{train}/trip-{number:06d}.mcap"
    return FileEntry(path, sha256(f"{seed} {number}".encode()), 2_000_000, start, entry)
