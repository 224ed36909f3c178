"""What trips cost: running time, distance, energy and slip, side by side."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from rich.console import Group

from analysis.adhesion.events import protection_onsets
from analysis.given import Given, each_given
from analysis.tables import kwh, new_table
from trainlog.display import as_text, counted
from trainlog.errors import LogError
from trainlog.formats.attached import passport_of, recorded_load, train_of
from trainlog.mcap import read_log
from trainlog.mcap.reader import stream_log
from trainlog.railway import Line, Train
from trainlog.resampling import joined_pieces
from trainlog.topics import EVENTS, REFERENCE, STANDSTILL, TRAIN_SLIP_PROTECTION
from trainlog.trip import Trip, seconds
from trainlog.units import JOULES_PER_KWH

FloatArray = NDArray[np.float64]

SHORTEST_STOP = 5.0
"""A train that stands for less [s] is creeping, not stopping."""


@dataclass(frozen=True, slots=True)
class TripCost:
    """What one trip took.

    Attributes
    ----------
    name, direction : str
    distance : float [m]
    running_time : float [s]
        From the first to the last movement, dwell included.
    stops : int
        Standstills between departure and arrival.
    mass : float [kg]
        Train and load, by the stored passport or the recorded load; NaN without either.
    traction : float [J]
        Work of the tractive effort at the wheel rims.
    dynamic_braking : float [J]
        Work taken by the dynamic brake at the wheel rims.
    line : float [J]
        Energy drawn from the line less what was fed back, with the train's efficiencies.
    top_speed : float [m/s]
    slips : int or None
        How often the slip protection acted; None where that is not recorded.
    late : float or None [s]
        On arrival, behind the trajectory that was followed; None if there was none.
    """

    name: str
    direction: str
    distance: float
    running_time: float
    stops: int
    mass: float
    traction: float
    dynamic_braking: float
    line: float
    top_speed: float
    slips: int | None = None
    late: float | None = None


Recorded = Trip | Path
"""A trip, or the log that holds it, which is read in pieces, however long it is."""

_STATES = ("/train/state", "/estimates/state")
_CONTROLS = "/train/controls"
_EFFORTS = ("tractive_effort", "dynamic_braking_effort")
ROWS = 250_000
"""Rows of a piece."""


def trip_cost(trip: Recorded) -> TripCost:
    """Energy and time of a trip from its recorded efforts and speed.

    Parameters
    ----------
    trip : Trip, or path of a log
        With `/train/state` (or `/estimates/state`) and `/train/controls`.

    Returns
    -------
    TripCost

    Raises
    ------
    LogError
        If the trip has no speed, no efforts, or never moves.
    """
    bare = _described(trip)
    train = train_of(bare)
    state = _STATES[1] if _STATES[0] not in bare and _STATES[1] in bare else _STATES[0]
    motion = [f"{state}.speed", f"{state}.position"]
    efforts = [f"{_CONTROLS}.{name}" for name in _EFFORTS]
    meter = _Meter()
    pieces = _pieces(trip, {state: ["speed", "position"], _CONTROLS: _EFFORTS})
    for table in joined_pieces(pieces, motion + efforts, state, max_gap=None):
        meter.add(table)
    stands = [stand for stand in meter.standstills() if stand.lasts]
    if stands and stands[0].begin == meter.first and stands[0].moves is None:
        raise LogError(f"trip '{bare.name}' never moves: there is no energy to compare")
    departs = bool(stands) and stands[0].begin == meter.first
    arrives = bool(stands) and stands[-1].moves is None
    departure = stands[0].moves if departs else meter.first
    arrival = stands[-1].begin if arrives else meter.last
    traction, dynamic = meter.work.tolist()
    return TripCost(
        name=bare.name,
        direction=bare.metadata.get("direction", "forward"),
        distance=float(meter.highest[1] - meter.lowest[1]),
        running_time=float(arrival - (departure or 0.0)),
        stops=len(stands) - int(departs) - int(arrives),
        mass=_mass(bare, train),
        traction=traction,
        dynamic_braking=dynamic,
        line=line_energy(train, traction, dynamic),
        top_speed=float(meter.highest[0]),
        slips=_slips(trip),
        late=_late(trip),
    )


def _mass(bare: Trip, train: Train) -> float:
    """Mass of the loaded train [kg]; NaN where nothing is known of its load."""
    stored, load = passport_of(bare), recorded_load(bare, train)
    if stored is not None and stored.mass.known:
        return stored.mass.value
    return float("nan") if load is None else train.mass + load.value


def _slips(trip: Recorded) -> int | None:
    """How often the slip protection acted; None where that is not recorded."""
    topics = [EVENTS.name, TRAIN_SLIP_PROTECTION.name]
    onsets = protection_onsets(trip if isinstance(trip, Trip) else read_log(trip, topics))
    return None if onsets is None else len(onsets)


def _late(trip: Recorded) -> float | None:
    """Lateness at the end of the trip."""
    late = None
    for piece in _pieces(trip, {REFERENCE.name: ["lateness"]}):
        if REFERENCE.name in piece:
            known = piece[REFERENCE.name]["lateness"].dropna()
            late = float(known.iloc[-1]) if len(known) else late
    return late


def _described(trip: Recorded) -> Trip:
    """The trip; of a log, its topics without rows."""
    if isinstance(trip, Trip):
        return trip
    never = (pd.Timestamp(0, tz="UTC"), pd.Timestamp(0, tz="UTC"))
    return read_log(trip, [*_STATES, _CONTROLS], time=never)


def _pieces(trip: Recorded, columns: Mapping[str, Iterable[str]]) -> Iterable[Trip]:
    return [trip] if isinstance(trip, Trip) else stream_log(trip, columns, rows=ROWS)


@dataclass(frozen=True, slots=True)
class _Standstill:
    """First and last instant of a standstill, and when the train moves again [s]."""

    begin: float
    end: float
    moves: float | None

    @property
    def lasts(self) -> bool:
        return self.end - self.begin >= SHORTEST_STOP


class _Meter:
    """Sums over a trip that comes in pieces.

    Attributes
    ----------
    first, last : float [s]
        Times of the first and the last sample, since the first.
    work : (2,) array [J]
        Of traction and of the dynamic brake.
    lowest, highest : (2,) array
        Of speed [m/s] and position [m].
    """

    def __init__(self) -> None:
        self.first = self.last = 0.0
        self.work = np.zeros(2)
        self.lowest, self.highest = np.full(2, np.nan), np.full(2, np.nan)
        self._origin: pd.Timestamp | None = None
        self._power = np.zeros((0, 2))
        self._begin: float | None = None
        self._ended: list[_Standstill] = []

    def add(self, table: pd.DataFrame) -> None:
        """Add rows with the columns speed, position, tractive and dynamic braking effort."""
        if table.empty:
            return
        if self._origin is None:
            self._origin = pd.Timestamp(table.index[0])
        time = seconds(table, self._origin)
        values = table.to_numpy(dtype=np.float64)
        power = np.nan_to_num(values[:, 2:] * values[:, :1])
        before = self._power.shape[0]
        self.work += np.trapezoid(
            np.concatenate((self._power, power)),
            np.concatenate(([self.last][:before], time)),
            axis=0,
        )
        self.lowest = np.fmin(self.lowest, np.fmin.reduce(values[:, :2], axis=0))
        self.highest = np.fmax(self.highest, np.fmax.reduce(values[:, :2], axis=0))
        self._stand(time, np.nan_to_num(values[:, 0]) <= STANDSTILL)
        self.last, self._power = float(time[-1]), power[-1:]

    def standstills(self) -> list[_Standstill]:
        """Every standstill, the shortest ones too."""
        if self._begin is None:
            return self._ended
        return [*self._ended, _Standstill(self._begin, self.last, None)]

    def _stand(self, time: FloatArray, standing: NDArray[np.bool_]) -> None:
        """Go through the changes between standing and moving."""
        before = np.concatenate(([self.last], time))
        for row in np.flatnonzero(np.diff(standing, prepend=self._begin is not None)).tolist():
            if self._begin is None:
                self._begin = float(time[row])
            else:
                ended = _Standstill(self._begin, float(before[row]), float(time[row]))
                self._ended.append(ended)
                self._begin = None


def line_energy(train: Train, traction: float, dynamic_braking: float) -> float:
    """Energy from the line [J]: traction over its efficiency, less what braking feeds back."""
    return traction / train.efficiency_traction - train.efficiency_regeneration * dynamic_braking


def fastest_nonstop(trips: Sequence[Recorded], line: Line) -> float:
    """Shortest running time [s] among the trips that run the whole line forward without a stop.

    Raises
    ------
    LogError
        If there is no such trip.
    """
    forward = [
        trip for trip in trips if _described(trip).metadata.get("direction", "forward") == "forward"
    ]
    times = [
        cost.running_time
        for cost in map(trip_cost, forward)
        if cost.stops == 0 and cost.distance > 0.98 * line.length
    ]
    if not times:
        raise LogError(
            f"no trip runs the whole line '{line.name}' forward without a stop",
            remedy="give the running time instead",
        )
    return min(times)


@dataclass(frozen=True, slots=True)
class Punctuality:
    """How well trips followed their trajectory.

    Attributes
    ----------
    trips : int
    late : float [s]
        On arrival behind the trajectory, of the trip furthest from it; signed.
    slips : int or None
        How often the slip protection acted on all of them; None where one does not record it.
    """

    trips: int
    late: float
    slips: int | None


def punctuality(followed: Sequence[Recorded]) -> Punctuality:
    """Lateness and slip of trips that followed a trajectory.

    Raises
    ------
    LogError
        If one of them has no reference.
    """
    late, slips = [], list[int | None]()
    for trip in followed:
        found = _late(trip)
        if found is None:
            raise LogError(
                f"trip '{_described(trip).name}' followed no trajectory: it has no /reference",
                remedy="give the trips of 'trainlog simulate --trajectory'",
            )
        late.append(found)
        slips.append(_slips(trip))
    known = [each for each in slips if each is not None]
    acted = sum(known) if len(known) == len(slips) else None
    return Punctuality(len(late), max(late, key=abs), acted)


@dataclass(frozen=True, slots=True)
class Saving:
    """A driver's trip beside the trip of the same train, equally loaded, on the trajectory.

    Attributes
    ----------
    driver, trajectory : TripCost
    """

    driver: TripCost
    trajectory: TripCost

    @property
    def traction(self) -> float:
        """Tractive work saved at the wheel rims [J]."""
        return self.driver.traction - self.trajectory.traction

    @property
    def line(self) -> float:
        """Energy from the line saved, feeding back included [J]."""
        return self.driver.line - self.trajectory.line


@dataclass(frozen=True, eq=False, repr=False)
class Comparison:
    """Drivers' trips beside trips that followed a trajectory.

    Attributes
    ----------
    pairs : tuple of Saving
    """

    pairs: tuple[Saving, ...]

    def __repr__(self) -> str:
        return as_text(self._title, self._summary())

    def _repr_html_(self) -> str:
        from analysis.tables import as_page

        return as_page(savings_table(self))

    @property
    def _title(self) -> str:
        return f"Drivers beside the trajectory: {counted(len(self.pairs), 'pair')} of trips"

    def _summary(self) -> dict[str, str]:
        spent, saved = self.total_saved
        driver, own = self.running_times
        return {
            "tractive energy": f"{saved / JOULES_PER_KWH:.2f} of"
            f" {spent / JOULES_PER_KWH:.2f} kWh saved, {saved / spent:.1%}",
            "running time": f"{own:.0f} s on the trajectory, {driver:.0f} s by the drivers",
        }

    @property
    def total_saved(self) -> tuple[float, float]:
        """Tractive work of the drivers, and what the trajectory saved of it [J]."""
        spent = sum(pair.driver.traction for pair in self.pairs)
        return spent, sum(pair.traction for pair in self.pairs)

    @property
    def running_times(self) -> tuple[float, float]:
        """Mean running time of the drivers and on the trajectory [s]."""
        times = [(each.driver.running_time, each.trajectory.running_time) for each in self.pairs]
        driver, trajectory = np.mean(times, axis=0).tolist()
        return driver, trajectory


def compare(drivers: Given | Iterable[Given], followed: Given | Iterable[Given]) -> Comparison:
    """Pair drivers' trips with trips that followed a trajectory, configuration by configuration.

    A pair is comparable when the followed trip was driven with the configuration observed on the
    driver's trip (metadata ``configuration``), in the same direction, over the same distance,
    and neither stopped on the way.

    Parameters
    ----------
    drivers, followed : Trip, path, or iterable of them
        Trips at hand, logs and folders of logs.

    Raises
    ------
    LogError
        If no trip followed a trajectory, or no pair is comparable.

    Examples
    --------
    A trip beside itself, as if it had followed a trajectory with its own configuration:

    >>> from dataclasses import replace
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/nonstop.mcap")
    >>> same = replace(trip, metadata={**trip.metadata, "configuration": trip.name})
    >>> compare(trip, same).pairs[0].traction
    0.0
    """
    by_name = {_described(trip).name: trip for trip in each_given(drivers)}
    candidates = [(_described(trip), trip) for trip in each_given(followed)]
    candidates = _that_followed(candidates)
    pairs, unlike = [], list[tuple[int, str]]()
    for described, trip in candidates:
        observed = by_name.get(described.metadata["configuration"])
        if observed is None:
            name = described.name
            unlike.append((0, f"there is no trip of the configuration that '{name}' drove with"))
            continue
        driver, cost = trip_cost(observed), trip_cost(trip)
        differs = _unlike(driver, cost)
        if differs is None:
            pairs.append(Saving(driver, cost))
        else:
            unlike.append(differs)
    if not pairs:
        nearest = max(unlike, key=lambda each: each[0])[1]
        raise LogError(
            f"no trip that followed the trajectory has a comparable trip by a driver: {nearest}",
            remedy="needs one non-stop trip of the same configuration, direction and distance",
        )
    return Comparison(tuple(pairs))


def _that_followed(trips: Sequence[tuple[Trip, Recorded]]) -> list[tuple[Trip, Recorded]]:
    """The trips, each with its description first, that state the configuration they drove with."""
    remedy = "give trips recorded by 'trainlog simulate --trajectory' or analysis.follow"
    if not trips:
        raise LogError("no trip that followed a trajectory was given", remedy=remedy)
    followed = [each for each in trips if each[0].metadata.get("configuration")]
    if followed:
        return followed
    described, recorded = trips[0]
    others = f", nor did {counted(len(trips) - 1, 'other')}" if len(trips) > 1 else ""
    raise LogError(
        f"trip '{described.name}' did not follow a trajectory{others}",
        file=None if isinstance(recorded, Trip) else recorded,
        remedy=remedy,
    )


def _unlike(driver: TripCost, followed: TripCost) -> tuple[int, str] | None:
    """Why two trips cannot be compared, with how near they come to it; None if they can."""
    names = f"'{driver.name}'", f"'{followed.name}'"
    if driver.direction != followed.direction:
        return 1, f"{names[0]} ran {driver.direction}, {names[1]} {followed.direction}"
    if not abs(followed.distance - driver.distance) < 0.02 * followed.distance:
        return 2, (
            f"{names[0]} ran {driver.distance / 1e3:.1f} km, {names[1]}"
            f" {followed.distance / 1e3:.1f} km"
        )
    if driver.stops or followed.stops:
        each = zip(names, (driver.stops, followed.stops), strict=True)
        return 3, " and ".join(f"{name} stopped {stops}x" for name, stops in each if stops)
    return None


def savings_table(found: Comparison) -> Group:
    """What following the trajectory saved, pair by pair and together."""
    pairs = found.pairs
    title = "Tractive energy at the wheel rims, running time, how often slip protection acted"
    table = new_table(
        title, "trip", "driver", "trajectory", "saved", "saved from the line", "behind it", "slips"
    )
    for pair in pairs:
        driver, own = pair.driver, pair.trajectory
        table.add_row(
            driver.name,
            f"{kwh(driver.traction)}, {driver.running_time:.0f} s",
            f"{kwh(own.traction)}, {own.running_time:.0f} s",
            f"{kwh(pair.traction)}, {pair.traction / driver.traction:.1%}",
            kwh(pair.line),
            "-" if own.late is None else f"{own.late:+.1f} s",
            " / ".join("-" if each.slips is None else f"{each.slips}" for each in (driver, own)),
        )
    spent, saved = found.total_saved
    words = f"Saved on {counted(len(pairs), 'trip')}:"
    words += f" {kwh(saved)} of {kwh(spent)}, {saved / spent:.1%};"
    words += f" {kwh(sum(pair.line for pair in pairs))} from the line; {running_times(found)}."
    return Group(table, words)


def running_times(found: Comparison) -> str:
    """Mean running times of both, in words."""
    driver, trajectory = found.running_times
    return f"{trajectory:.0f} s on the trajectory against {driver:.0f} s on average"
