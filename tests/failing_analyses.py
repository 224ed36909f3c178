"""Analyses that go wrong on one trip, for tests of a fleet; workers import them by name."""

import os
import signal
from multiprocessing.connection import Connection

import pandas as pd

from analysis import FleetAnalysis, TripView
from trainlog.errors import LogError
from trainlog.formats.summaries import Column

COLUMNS = (Column("trip", "", "name of the trip", "text"), Column("samples", "1", "", "count"))


def _counted(trip: TripView) -> pd.DataFrame:
    return pd.DataFrame({"trip": [trip.name], "samples": [len(trip.trip["/train/state"])]})


def deadly(trip: TripView, name: str) -> pd.DataFrame:
    """Ends the worker, as a system that is out of memory does."""
    if trip.name == name:
        os.kill(os.getpid(), signal.SIGKILL)
    return _counted(trip)


def deadly_after(trip: TripView, name: str) -> pd.DataFrame:
    """Ends the worker when it has written half of the result."""
    if trip.name == name:
        Connection._send = half_sent
    return _counted(trip)


def half_sent(self: Connection, data: bytes, *_: object) -> None:
    """Write half of a message, and end."""
    os.write(self.fileno(), bytes(data)[: len(data) // 2])
    os.kill(os.getpid(), signal.SIGKILL)


def wrong(trip: TripView, name: str) -> pd.DataFrame:
    """Fails by a mistake in the analysis, or refuses."""
    if trip.name == name:
        raise ZeroDivisionError("no samples at all")
    if trip.name == "trip-001":
        raise LogError(f"trip '{trip.name}' is not wanted")
    return _counted(trip)


DEADLY = FleetAnalysis("deadly", COLUMNS, deadly, {"name": "trip-002"})
DEADLY_AFTER = FleetAnalysis("deadly-after", COLUMNS, deadly_after, {"name": "trip-002"})
WRONG = FleetAnalysis("wrong", COLUMNS, wrong, {"name": "trip-002"})
