"""What trips cost: running time, distance, energy and slip, side by side."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from analysis.adhesion.axles import protection_onsets
from analysis.comparison.driven import TOPICS, driven_trip, line_energy
from analysis.view import Given, TripView, each_given, trip_of, view_of
from trainlog.display import counted
from trainlog.errors import LogError
from trainlog.formats.railway import line_of, train_of
from trainlog.presentation import (
    DURATION,
    ENERGY,
    Column,
    Presented,
    Said,
    WordTable,
    kwh,
    new_table,
)
from trainlog.railway import Line
from trainlog.railway.train import NOMINAL
from trainlog.topics import EVENTS, REFERENCE, TRAIN_SLIP_PROTECTION
from trainlog.trip import LINE_ATTACHMENT, RECORDED_BRAKE, Trip
from trainlog.units import clock


@dataclass(frozen=True, slots=True)
class TripCost:
    """What one trip took.

    Attributes
    ----------
    name, direction : str
    distance : float [m]
    running_time : float [s]
        In motion: without the dwell times at stops on the way.
    dwell : float [s]
        At stops on the way; with the running time it makes up the travel time.
    stops : int
        Standstills between departure and arrival.
    mass : float [kg]
        Train and load, by the stored passport or the recorded load; NaN without either.
    traction : float [J]
        Work of the tractive effort at the wheel rims; NaN where efforts, or the speed and what
        would bridge it, are missing for more than a second.
    dynamic_braking : float [J]
        Work taken by the dynamic brake at the wheel rims.
    line : float [J]
        Energy drawn from the line less what was fed back, with the train's efficiencies.
    top_speed : float [m/s]
    slips : int or None
        How often the slip protection acted; None where that is not recorded.
    late : float or None [s]
        On arrival, behind the trajectory that was followed; None if there was none.
    notes : tuple of str
        What of the recording was repaired, or is not known.
    """

    name: str
    direction: str
    distance: float
    running_time: float
    dwell: float
    stops: int
    mass: float
    traction: float
    dynamic_braking: float
    line: float
    top_speed: float
    slips: int | None = None
    late: float | None = None
    notes: tuple[str, ...] = ()

    @property
    def times(self) -> str:
        """Running time, and of trips with stops the dwell times and the travel time, in words."""
        running = clock(self.running_time)
        if not self.dwell:
            return running
        travel = clock(self.running_time + self.dwell)
        return f"{running}, with {clock(self.dwell)} of dwell {travel}"

    @property
    def unknown(self) -> bool:
        """Whether the energy of a part of the trip is not known."""
        return self.traction != self.traction


RECORDED_PART = "where efforts are recorded"
"""What of an energy is known though efforts are missing."""


Candidate = tuple[Trip, Trip | TripView | Path]
"""A trip, or its log without rows, and what was given."""


def trip_cost(given: Given) -> TripCost:
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
    view = view_of(given, TOPICS)
    bare, train, driven = view.trip, view.train, driven_trip(view)
    if "traction" not in driven.sums:
        raise LogError(
            f"trip '{bare.name}' has no recorded efforts: its energy is not known",
            place="topic /train/controls",
            remedy="record efforts, or name their columns in the profile",
        )
    running = float(np.ptp(driven.running))
    traction, dynamic = driven.work("traction"), driven.work("dynamic_braking")
    notes = list(driven.notes)
    if driven.gain.known and driven.gain.value != 1.0:
        notes.append(
            f"efforts are the recorded ones over the passport's gain, {driven.gain.text(digits=3)}"
        )
    if driven.unknown():
        known = float(driven.sums["traction"][-1])
        notes.append(f"{RECORDED_PART} {kwh(known)} of traction at the wheel rims")
    brake = bare.metadata.get(RECORDED_BRAKE)
    if brake is not None:
        notes.append(f"the recorded dynamic brake {brake}: its energy may be less")
    return TripCost(
        name=bare.name,
        direction=driven.direction,
        distance=driven.distance,
        running_time=running,
        dwell=driven.duration - running,
        stops=sum(stand.duration > 0.0 for stand in driven.stands),
        mass=driven.mass.value,
        traction=traction,
        dynamic_braking=dynamic,
        line=line_energy(train, traction, dynamic),
        top_speed=float(driven.speed.max()),
        slips=_slips(bare),
        late=_late(bare),
        notes=tuple(notes),
    )


def _slips(trip: Trip) -> int | None:
    """How often the slip protection acted; None where that is not recorded."""
    onsets = protection_onsets(trip)
    return None if onsets is None else len(onsets)


def lateness_of(trip: Trip) -> float:
    """Lateness at the end of a trip that followed a trajectory [s].

    Raises
    ------
    LogError
        If it followed none.
    """
    late = _late(trip)
    if late is None:
        raise LogError(
            f"trip '{trip.name}' followed no trajectory: it has no /reference",
            remedy="give the trips of 'trainlog simulate follow'",
        )
    return late


def _late(trip: Trip) -> float | None:
    """Lateness at the end of the trip."""
    if REFERENCE.name not in trip:
        return None
    known = trip[REFERENCE.name]["lateness"].dropna()
    return float(known.iloc[-1]) if len(known) else None


def fastest_nonstop(trips: Sequence[Given], line: Line) -> float:
    """Shortest running time [s] among the trips that run the whole line forward without a stop.

    Raises
    ------
    LogError
        If there is no such trip.
    """
    forward = [
        trip
        for trip in trips
        if trip_of(trip, []).metadata.get("direction", "forward") == "forward"
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


def punctuality(followed: Sequence[Given]) -> Punctuality:
    """Lateness and slip of trips that followed a trajectory.

    Raises
    ------
    LogError
        If one of them has no reference.
    """
    topics = [REFERENCE.name, EVENTS.name, TRAIN_SLIP_PROTECTION.name]
    trips = [trip_of(given, topics) for given in followed]
    late, slips = [lateness_of(trip) for trip in trips], [_slips(trip) for trip in trips]
    acted = None if None in slips else sum(each or 0 for each in slips)
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


def _cost(of: TripCost) -> Said:
    return Said(of.traction, f"{kwh(of.traction)}, {of.running_time:.0f} s")


def _share(saved: float, spent: float) -> str:
    return f"{saved / spent:.1%}" if spent > 0.0 else "not known"


def _saved(pair: Saving, name: str) -> Said:
    saved, spent = getattr(pair, name), getattr(pair.driver, name)
    return Said(saved, f"{kwh(saved)}, {_share(saved, spent)}")


def _late_cell(pair: Saving) -> Said | None:
    late = pair.trajectory.late
    return None if late is None else Said(late, f"{late:+.1f} s")


def _slips_cell(pair: Saving) -> str:
    counts = (pair.driver.slips, pair.trajectory.slips)
    return " / ".join("-" if each is None else f"{each}" for each in counts)


PAIR_COLUMNS = (
    Column("trip", of=lambda pair: pair.driver.name),
    Column("driver", ENERGY, each=True, of=lambda pair: _cost(pair.driver)),
    Column("trajectory", ENERGY, each=True, of=lambda pair: _cost(pair.trajectory)),
    Column("saved", ENERGY, each=True, of=lambda pair: _saved(pair, "traction")),
    Column("saved from the line", ENERGY, each=True, of=lambda pair: _saved(pair, "line")),
    Column("behind it", DURATION, each=True, of=_late_cell, rank=1),
    Column("slips", of=_slips_cell, rank=1),
)
"""Of a pair of trips."""


@dataclass(frozen=True, eq=False, repr=False)
class GroupComparison(Presented):
    """Drivers' trips beside trips that followed a trajectory.

    Attributes
    ----------
    pairs : tuple of Saving
    remarks : tuple of str
        Where the trips of a pair differ in more than who drove.
    """

    pairs: tuple[Saving, ...]
    remarks: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """How many trips were compared."""
        return f"Drivers beside the trajectory: {counted(len(self.pairs), 'pair')} of trips"

    def summary(self) -> dict[str, str]:
        """Energy saved, and running times."""
        return {"saved": self.saved_words, "running time": self.times_words}

    def tables(self) -> list[WordTable]:
        """What following the trajectory saved, pair by pair, and their mean."""
        title = "Tractive energy at the wheel rims, running time, how often slip protection acted"
        table = new_table(title, *PAIR_COLUMNS, name="pairs").add_rows(self.pairs)
        if len(self.pairs) > 1:
            sides = [
                [getattr(pair, side) for pair in self.pairs] for side in ("driver", "trajectory")
            ]
            saved = _spread([pair.traction for pair in self.pairs])
            cells = (*map(_mean, sides), saved, "", "", "")
            table.add_row("mean ± std", *(Said(None, words) for words in cells))
        return [table]

    @property
    def sentence(self) -> str:
        """What was saved on all trips together."""
        trips = counted(len(self.pairs), "trip")
        return f"Saved on {trips}: {self.saved_words}; {self.times_words}."

    @property
    def saved_words(self) -> str:
        """What was saved at the wheel rims and from the line on all trips together."""
        parts = []
        for name, place in (("traction", "at the wheel rims"), ("line", "from the line")):
            spent = sum(getattr(pair.driver, name) for pair in self.pairs)
            saved = sum(getattr(pair, name) for pair in self.pairs)
            parts.append(f"{_share(saved, spent)} {place} ({kwh(saved)} of {kwh(spent)})")
        return ", ".join(parts)

    @property
    def notes(self) -> list[str]:
        """Where the trips of a pair differ in more than who drove."""
        return [f"{remark}." for remark in self.remarks]

    @property
    def times_words(self) -> str:
        """Mean running times of both, in words."""
        times = [(each.driver.running_time, each.trajectory.running_time) for each in self.pairs]
        driver, trajectory = np.mean(times, axis=0)
        return f"{trajectory:.0f} s on the trajectory against {driver:.0f} s on average"


def compare_groups(
    drivers: Given | Iterable[Given], followed: Given | Iterable[Given]
) -> GroupComparison:
    """Pair drivers' trips with trips that followed a trajectory, configuration by configuration.

    A pair is comparable when the followed trip was driven with the configuration observed on the
    driver's trip (metadata ``configuration``), of the same train on the same line, in the same
    direction, over the same distance, and neither stopped on the way. A plan for the nominal
    train, which no driver's trip observed, is laid beside every such trip of the same train,
    whatever its load; a remark states both masses.

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
    >>> compare_groups(trip, same).pairs[0].traction
    0.0
    """
    known = [(trip_of(trip, []), trip) for trip in each_given(drivers)]
    candidates = _that_followed([(trip_of(trip, []), trip) for trip in each_given(followed)])
    pairs, remarks, unlike = list[Saving](), list[str](), list[tuple[int, str]]()
    for bare, trip in candidates:
        configuration = bare.metadata["configuration"]
        alike = [each for each in known if _same_train_and_line(each[0], bare)]
        named = [recorded for about, recorded in alike if about.name == configuration]
        nominal = not named and configuration == NOMINAL
        observed = [recorded for _, recorded in alike] if nominal else named
        if len(named) > 1:
            words = f"{len(named)} trips are called '{configuration}', the configuration of"
            unlike.append((0, f"{words} '{bare.name}'"))
            continue
        if not observed:
            missing = "train" if nominal else "configuration"
            unlike.append((0, f"there is no trip of the {missing} that '{bare.name}' drove with"))
        for each in observed:
            pair = Saving(trip_cost(each), trip_cost(trip))
            differs = _unlike(pair.driver, pair.trajectory)
            if differs is not None:
                unlike.append(differs)
                continue
            pairs.append(pair)
            if nominal:
                by, own = (f"{each.mass / 1e3:.1f} t" for each in (pair.driver, pair.trajectory))
                remarks.append(
                    f"'{pair.trajectory.name}' followed a plan for the train of its file, at {own};"
                    f" '{pair.driver.name}' ran at {by}"
                )
    if not pairs:
        nearest = max(unlike, key=lambda each: each[0])[1]
        raise LogError(
            f"no trip that followed the trajectory has a comparable trip by a driver: {nearest}",
            remedy="needs one non-stop trip of the same configuration, direction and distance",
        )
    return GroupComparison(tuple(pairs), tuple(remarks))


def _same_train_and_line(one: Trip, other: Trip) -> bool:
    if train_of(one).name != train_of(other).name:
        return False
    lines = [line_of(each).name for each in (one, other) if LINE_ATTACHMENT in each.attachments]
    return len(set(lines)) < 2


def _that_followed(trips: Sequence[Candidate]) -> list[Candidate]:
    """The trips, each with its description first, that state the configuration they drove with."""
    remedy = "give trips recorded by 'trainlog simulate follow'"
    if not trips:
        raise LogError("no trip that followed a trajectory was given", remedy=remedy)
    followed = [each for each in trips if each[0].metadata.get("configuration")]
    if followed:
        return followed
    first, recorded = trips[0]
    others = f", nor did {counted(len(trips) - 1, 'other')}" if len(trips) > 1 else ""
    raise LogError(
        f"trip '{first.name}' did not follow a trajectory{others}",
        file=recorded if isinstance(recorded, Path) else None,
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
    unknown = [n for n, each in zip(names, (driver, followed), strict=True) if each.unknown]
    if unknown:
        return 3, f"the energy of {' and '.join(unknown)} is not known throughout"
    if driver.stops or followed.stops:
        each = zip(names, (driver.stops, followed.stops), strict=True)
        return 3, " and ".join(f"{name} stopped {stops}x" for name, stops in each if stops)
    return None


def _spread(energies: Sequence[float]) -> str:
    """Mean of energies [J], and how much they differ."""
    return f"{kwh(float(np.mean(energies)))} ± {kwh(float(np.std(energies, ddof=1)))}"


def _mean(costs: Sequence[TripCost]) -> str:
    """Mean work and running time of a group of trips, with how much they differ."""
    times = [each.running_time for each in costs]
    work = _spread([each.traction for each in costs])
    return f"{work}, {np.mean(times):.0f} ± {np.std(times, ddof=1):.0f} s"
