"""The line, the train and the passport that a trip carries with it; the line of a trajectory."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from trainlog.errors import LogError
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.formats.files import sha256, to_bytes
from trainlog.formats.line import line_from_bytes
from trainlog.formats.train import train_from_bytes
from trainlog.railway.line import Line
from trainlog.railway.passport import Passport, Quantity
from trainlog.railway.train import Train
from trainlog.railway.trajectory import Trajectory
from trainlog.trip import LINE_ATTACHMENT, PASSPORT_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.version import __version__

MAX_LOAD_SHARE = 0.25
"""Largest load over the empty mass where the train's file states none."""

WEIGHING_SHARE, WEIGHING_OFFSET = 0.03, 0.02
"""Standard deviation of a recorded load: this share of the load, and this share of the largest."""

KEPT = 4
"""Lines and trains that are kept, so that the analyses of a trip read its attachments once."""


def line_of(trip: Trip) -> Line:
    """The line that the trip was driven on, as the train met it.

    A trip whose metadata say ``direction: reverse`` gets the line reversed, so that its chainage
    grows in the direction of travel.

    Raises
    ------
    LogError
        If the trip carries no line, or its direction is neither ``forward`` nor ``reverse``.
    InputError
        If the attachment is not a line file.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> line_of(read_log("sample_logs/nonstop.mcap")).name
    'CH_StGallen_Wil'
    """
    data = _attachment(trip, LINE_ATTACHMENT)
    direction = trip.metadata.get("direction", "forward")
    if direction not in ("forward", "reverse"):
        raise LogError(
            f"trip '{trip.name}': direction is '{direction}'",
            remedy="metadata 'direction' must be 'forward' or 'reverse'",
        )
    return _line(data, _called(trip, LINE_ATTACHMENT), direction == "reverse")


@lru_cache(KEPT)
def _line(data: bytes, called: str, backwards: bool) -> Line:
    line = line_from_bytes(data, file=called)
    return line.reversed() if backwards else line


def line_of_plan(trajectory: Trajectory) -> Line | None:
    """The line that a trajectory was planned on, in its direction of travel.

    None of trajectories whose file an earlier version wrote: it does not hold the line.

    Raises
    ------
    InputError
        If what the file holds is not a line.

    Examples
    --------
    >>> import trainlog
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> line = trainlog.read_line("sample").reversed()
    >>> train = trainlog.read_train("sample")
    >>> nominal = [trainlog.Configuration.of(train)]
    >>> problem = TrajectoryProblem(line, train, nominal, end=9_286.1, direction="reverse")
    >>> line_of_plan(optimise(problem, OptimiserOptions(60))).stations[0].name
    'Wil'
    """
    kept = trajectory.provenance.get("line")
    if kept is None:
        return None
    return line_from_bytes(to_bytes(kept), file=f"the line in the trajectory on {trajectory.line}")


def train_of(trip: Trip) -> Train:
    """The train that made the trip, empty.

    Raises
    ------
    LogError
        If the trip carries no train.
    InputError
        If the attachment is not a train file.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> train_of(read_log("sample_logs/nonstop.mcap")).name
    'CH_Stadler_FLIRT_TPF'
    """
    return _train(_attachment(trip, TRAIN_ATTACHMENT), _called(trip, TRAIN_ATTACHMENT))


@lru_cache(KEPT)
def _train(data: bytes, called: str) -> Train:
    return train_from_bytes(data, file=called)


def passport_of(trip: Trip) -> Passport | None:
    """The passport that is stored with the trip; None if there is none.

    Raises
    ------
    InputError
        If the attachment is not a passport file.

    Examples
    --------
    >>> passport_of(Trip({})) is None
    True
    """
    data = trip.attachments.get(PASSPORT_ATTACHMENT)
    if data is None:
        return None
    return thing_from_bytes(Passport, data, file=_called(trip, PASSPORT_ATTACHMENT))


def with_passport(trip: Trip, passport: Passport) -> Trip:
    """A copy of the trip that carries the passport, in the place of the one it may have.

    Examples
    --------
    >>> from analysis import passport
    >>> from trainlog.mcap import read_log
    >>> trip = read_log("sample_logs/nonstop.mcap")
    >>> passport_of(with_passport(trip, passport(trip))).trip
    'trip-01'
    """
    data = thing_to_bytes(passport)
    carried = replace(trip, attachments={**trip.attachments, PASSPORT_ATTACHMENT: data})
    return carried.with_step(
        "passport", software=f"trainlog {__version__}", outputs={PASSPORT_ATTACHMENT: sha256(data)}
    )


def recorded_load(trip: Trip, train: Train | None = None) -> Quantity | None:
    """The load [kg] that a trip's metadata state, with its uncertainty; None without.

    Parameters
    ----------
    trip : Trip
    train : Train, optional
        Its largest load sizes the offset of the weighing.

    Raises
    ------
    LogError
        If ``load`` or ``load_std`` is not a mass.

    Examples
    --------
    >>> recorded_load(Trip({}, {"load": "12000", "load_std": "500"})).band
    (11020.0, 12980.0)
    """
    load = _stated(trip, "load")
    if load is None:
        return None
    std = _stated(trip, "load_std")
    if std is None:
        largest = largest_load(train) if train is not None else 0.0
        std = float(np.hypot(WEIGHING_SHARE * load, WEIGHING_OFFSET * largest))
    return Quantity(load, std, "recorded")


def _stated(trip: Trip, key: str) -> float | None:
    """A mass [kg] among the metadata."""
    stated = trip.metadata.get(key)
    if not stated:
        return None
    try:
        mass = float(stated)
    except ValueError:
        mass = np.nan
    if not (np.isfinite(mass) and mass >= 0.0):
        raise LogError(
            f"trip '{trip.name}': {key} '{stated}' is not a mass in kg",
            remedy=f"correct metadata '{key}' when the log is made",
        )
    return mass


def largest_load(train: Train) -> float:
    """Largest load of a train [kg]; a share of its mass where its file states none.

    Examples
    --------
    >>> from trainlog import DEFAULT_TRAIN, read_train, sample
    >>> largest_load(read_train(sample(DEFAULT_TRAIN)))
    25000.0
    """
    return train.max_load or MAX_LOAD_SHARE * train.mass


def _attachment(trip: Trip, name: str) -> bytes:
    try:
        return trip.attachments[name]
    except KeyError:
        raise LogError(
            f"trip '{trip.name}' carries no {name}",
            remedy=f"attachments present: {', '.join(trip.attachments) or 'none'};"
            " 'trainlog ingest --line FILE --train FILE' attaches them when it makes the log",
        ) from None


def _called(trip: Trip, name: str) -> str:
    return f"{name} of trip '{trip.name}'"
