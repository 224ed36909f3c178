"""Where on its line a trip begins, and in which direction it ran: by stop places and gradients.

A counter that starts anywhere is put where the stops lie at stations. Both directions are tried
where none is stated; what decides is kept as metadata, and so is that nothing does.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from trainlog.arrays import FloatArray, robust_std
from trainlog.errors import InputError
from trainlog.ingest.motion import (
    EFFORTS,
    MANY,
    MOVING,
    POSITION,
    RESTING,
    SPAN,
    SPEED,
    STANDING,
    SURE,
    seconds_of,
)
from trainlog.ingest.recording import Table
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.units import NANOSECONDS

NEAR, DRIFT = 60.0, 0.01
"""A stop lies at a station up to this distance [m], and this share of the way so far."""


@dataclass(frozen=True)
class Match:
    """Stops of a trip at the stations of a line.

    Attributes
    ----------
    start : float [m]
        Chainage at which the trip begins, in its direction.
    matched, stops : int
        Stops that lie at stations, both ends included, and all.
    error : float [m]
        RMS of the distances between them.
    """

    start: float
    matched: int
    stops: int
    error: float


def stops_of(table: Table) -> FloatArray | None:
    """Positions [m] of the stops from the first one, both ends included; None without them.

    The trip has to begin and end at standstill.
    """
    position, speed = table.signals.get(POSITION), table.signals.get(SPEED)
    if position is None or speed is None:
        return None
    known = np.flatnonzero(np.isfinite(position) & np.isfinite(speed))
    moves = np.flatnonzero(np.abs(speed[known]) > STANDING)
    if moves.size < 2 or moves[0] == 0 or moves[-1] == known.size - 1:
        return None
    time, place = table.time[known] / NANOSECONDS, position[known]
    still = np.flatnonzero(np.diff(time[moves]) >= RESTING)
    inner = [
        float(np.median(place[first + 1 : last]))
        for first, last in zip(moves[still].tolist(), moves[still + 1].tolist(), strict=True)
        if last - first > 1
    ]
    stops = np.array([place[0], *inner, place[-1]])
    return np.asarray(stops - stops[0])


def match_of(stops: FloatArray, line: Line) -> Match | None:
    """The one start at which both ends lie at stations, and the most stops; None if there is none.

    Of two that match as many stops none is taken.
    """
    stations = np.array([station.position for station in line.stations])
    near = NEAR + DRIFT * stops
    found = []
    for begin in stations:
        off = np.abs(begin + stops[:, None] - stations[None, :]).min(axis=1)
        if off[-1] <= near[-1]:
            inside = off <= near
            error = float(np.sqrt(np.mean(off[inside] ** 2)))
            found.append(Match(float(begin), int(inside.sum()), stops.size, error))
    found.sort(key=lambda match: (-match.matched, match.error))
    if not found or (len(found) > 1 and found[1].matched == found[0].matched):
        return None
    return found[0]


@dataclass(frozen=True)
class Gradients:
    """How well the motion follows the gradients of a direction.

    Attributes
    ----------
    share, std : float
        Of the gradients' acceleration in the motion, one if they are right, and its standard
        deviation.
    squares : float
        Mean square [m²/s⁴] that is left.
    windows : int
    """

    share: float
    std: float
    squares: float
    windows: int


def gradients_in(table: Table, line: Line, train: Train, start: float | None) -> Gradients | None:
    """Gradients of `line`, in its direction, in the motion; None where the data do not show them.

    Least squares of the acceleration by efforts, running resistance and gradients, with every
    coefficient free.
    """
    if not {POSITION, SPEED, EFFORTS[0]} <= set(table.signals):
        return None
    seconds = seconds_of(table)
    columns = [table.signals[name] for name in (POSITION, SPEED, *EFFORTS) if name in table.signals]
    values = np.column_stack([seconds, *columns])
    values = values[np.isfinite(values).all(axis=1)]
    if not len(values):
        return None
    values[:, 1] += 0.0 if start is None else start - values[0, 1]
    bins = (values[:, 0] / SPAN).astype(np.int64)
    count = np.bincount(bins)
    sums = [np.bincount(bins, column) for column in values.T]
    with np.errstate(invalid="ignore", divide="ignore"):
        mean = np.column_stack(sums) / count[:, None]
    rate = (mean[2:, 2] - mean[:-2, 2]) / (mean[2:, 0] - mean[:-2, 0])
    mean = 0.25 * (mean[2:] + 2.0 * mean[1:-1] + mean[:-2])
    used = np.isfinite(rate) & np.isfinite(mean).all(axis=1) & (mean[:, 2] > MOVING)
    used &= rate > (-0.4 if EFFORTS[2] not in table.signals else -3.0)
    if used.sum() < MANY:
        return None
    rate, mean = rate[used], mean[used]
    place, speed = np.clip(mean[:, 1], 0.0, line.length), mean[:, 2]
    pull = -line.track_acceleration(place, train.length) / (1.0 + train.rotating_mass_factor)
    if np.std(pull) < 1e-3:
        return None
    efforts = mean[:, 3:] / train.mass
    design = np.column_stack([pull, np.ones_like(speed), speed, speed**2, efforts])
    kept = np.ones(rate.size, dtype=np.bool_)
    for _ in range(3):
        beta = np.linalg.lstsq(design[kept], rate[kept], rcond=None)[0]
        left = rate - design @ beta
        scale = robust_std(left[kept])
        kept = np.abs(left) <= 4.0 * max(scale, 1e-6)
    # All windows count, those far off by no more than the bound: both directions have the same.
    squares = float(np.mean(np.minimum(np.abs(left), 4.0 * scale) ** 2))
    inverse = np.linalg.pinv(design[kept].T @ design[kept])
    std = float(np.sqrt(3.0 * squares * inverse[0, 0]))
    return Gradients(float(beta[0]), std, squares, int(rate.size))


@dataclass(frozen=True)
class Placed:
    """Where a trip lies.

    Attributes
    ----------
    direction : str
        ``"forward"`` or ``"reverse"``; empty where the data do not decide.
    start : float or None [m]
        Of the stations.
    evidence : str
    """

    direction: str
    start: float | None
    evidence: str


def placed(
    table: Table, line: Line, train: Train | None, stated: str | None, *, by_stations: bool
) -> Placed:
    """The direction of a trip, and its start by the stations if that is asked for.

    Raises
    ------
    InputError
        If the start is asked for, and the stops do not decide it.
    """
    ways = {"forward": line, "reverse": line.reversed()}
    stops = stops_of(table)
    matches = {way: None if stops is None else match_of(stops, each) for way, each in ways.items()}
    able = {way: match for way, match in matches.items() if match is not None}
    if by_stations and not ({stated} if stated else set(ways)) & set(able):
        raise InputError(
            f"its stops match the stations of line '{line.name}' nowhere, or in several places",
            remedy="give start_position under [trip] of the profile, or --set start_position=0.2km",
        )
    starts = {way: able[way].start if by_stations and way in able else None for way in ways}
    most = max((match.matched for match in able.values()), default=0)
    best = [way for way, match in able.items() if match.matched == most]
    shown = {way: f"{m.matched} of {m.stops} stops at stations {way}" for way, m in able.items()}
    if by_stations and stated is None and len(best) == 1:
        match = able[best[0]]
        where = f"start at km {match.start / 1e3:.3f}"
        words = f"{shown[best[0]]}, {match.error:.0f} m off (RMS), {where}"
        return Placed(best[0], match.start, words)
    found = (
        {}
        if train is None
        else {way: gradients_in(table, each, train, starts[way]) for way, each in ways.items()}
    )
    one, other = found.get("forward"), found.get("reverse")
    if one is not None and other is not None:
        way = "forward" if one.squares <= other.squares else "reverse"
        good, bad = (one, other) if way == "forward" else (other, one)
        ratio = good.windows / 6.0 * float(np.log(bad.squares / max(good.squares, 1e-12)))
        if ratio > SURE and 0.5 < good.share < 1.6 and (not by_stations or way in able):
            words = (
                f"the motion follows the gradients {way} ({good.share:.2f}"
                f" ± {1.96 * good.std:.2f} of them; the other way {bad.share:.2f}"
                f" ± {1.96 * bad.std:.2f})"
            )
            return Placed(way, starts[stated or way], words)
    way = stated or (best[0] if by_stations else "forward")
    words = "neither stops at stations nor gradients decide it"
    words = f"as stated: {words}" if stated else f"{way} assumed: {words}"
    return Placed("", starts[way] if by_stations else None, words)
