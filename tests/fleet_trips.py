"""Many short trips of a few seconds' making, for tests of a fleet."""

from dataclasses import replace
from pathlib import Path

import pandas as pd

import trainlog
from trainlog.trip import Trip

SAMPLES = ("sample_logs/nonstop.mcap", "sample_logs/stopping.mcap")
MINUTES = 4
TRIPS = 4  # so many are made for all tests of a session, in the fixture `fleet_logs`


def short_trips(folder: Path, count: int) -> list[Path]:
    """Logs of pieces of the sample trips, each moved to a time of its own."""
    folder.mkdir(parents=True, exist_ok=True)
    whole = [trainlog.read(log) for log in SAMPLES]
    paths = []
    for number in range(count):
        trip = whole[number % 2]
        start = trip.start + pd.Timedelta(minutes=MINUTES * (number // 2 % 4))
        piece = trip.between(start, start + pd.Timedelta(minutes=MINUTES))
        moved = later(piece, pd.Timedelta(days=number))
        named = replace(moved, metadata=moved.metadata | {"trip": f"trip-{number:03d}"})
        paths.append(folder / f"trip-{number:03d}.mcap")
        trainlog.write(named, paths[-1])
    return paths


def later(trip: Trip, by: pd.Timedelta) -> Trip:
    """The trip as if it had been driven later."""
    topics = {name: frame.set_axis(frame.index + by) for name, frame in trip.topics.items()}
    return replace(trip, topics=topics, provenance=trip.provenance[:1])
