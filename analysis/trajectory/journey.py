"""A whole journey: sections between stops, and the departures that make it cheapest.

Sections are coupled by their times alone. The least energy of a section is convex in its departure
and arrival, and the multipliers of a solution are its slopes: each solution cuts away what cannot
be cheaper, and a linear program over the cuts and the windows chooses the next times (Kelley,
1960). That is how the reserve of a timetable is shared among its sections.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linprog

from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.feasibility import check_speeds, held_back, place_of, seconds
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.run import Run
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Configuration, Line, Train, Trajectory
from trainlog.railway.journey import Journey, TimingPoint
from trainlog.units import clock

FloatArray = NDArray[np.float64]

_SCOUTING_CELLS = 120
_TURNS = 12
_CLOSE = 2e-4
"""Energy that other times might still save, relative, when the search for them ends."""

_LEAST_MARGIN = 1.01
"""Least running time over that of the slowest configuration by itself."""


@dataclass(frozen=True)
class Section:
    """From one stop to the next; times since the start of the journey.

    Attributes
    ----------
    departure, arrival : TimingPoint
    passing : tuple of TimingPoint
    """

    departure: TimingPoint
    arrival: TimingPoint
    passing: tuple[TimingPoint, ...]


@dataclass(frozen=True, eq=False)
class JourneyPlan:
    """Trajectories of all sections of a journey, and when each departs.

    Attributes
    ----------
    journey : Journey
    sections : tuple of m Trajectory
    departures, arrivals : (m,) array [s]
        Since the start of the journey; arrivals as planned, no configuration is later.
    certificate : dict
        Sums over the sections, and what other times might still save. The sections carry their
        own certificates. At the line ``energy`` adds the worst of each section, which need not be
        one and the same configuration; ``dearest_energy`` is that of the one which takes most in
        all, never more, and the same at the wheel.
    """

    journey: Journey
    sections: tuple[Trajectory, ...]
    departures: FloatArray
    arrivals: FloatArray
    certificate: dict[str, Any] = field(default_factory=dict)


def sections_of(journey: Journey) -> tuple[Section, ...]:
    """The journey cut at its stops.

    Raises
    ------
    InputError
        If timing points share a position and are not arrival and departure of a stop.
    """
    sections: list[Section] = []
    departure, passing = journey.points[0], list[TimingPoint]()
    arrived = False
    for number, point in enumerate(journey.points[1:], start=1):
        if point.position == departure.position:
            if not arrived or passing:
                raise InputError(
                    f"journey '{journey.name}': at km {point.position / 1e3:.3f} there is more than"
                    " an arrival and a departure",
                    remedy="two points at one position, both with speed 0, are a stop",
                )
            departure, arrived = point, False
        elif point.highest_speed == 0.0 or number == len(journey.points) - 1:
            sections.append(Section(departure, point, tuple(passing)))
            # Without a departure of its own the train leaves when it may.
            departure, passing, arrived = replace(point, latest=None), [], True
        else:
            passing.append(point)
    return tuple(sections)


def optimise_journey(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    journey: Journey,
    *,
    dwell: float = 0.0,
    reserve: float = 0.07,
    **options: Any,
) -> JourneyPlan:
    """Trajectories of least worst-case energy for all sections of a journey.

    Parameters
    ----------
    line, train, configurations
        As for `optimise`.
    journey : Journey
        On this line, in the direction of travel.
    dwell : float [s]
        Least time that the train stands at each stop on the way.
    reserve : float
        Part of the least running time, where the journey does not say when it ends.
    **options
        What else `optimise` takes, the same for every section.

    Raises
    ------
    InfeasibleError
        If the windows cannot be kept; with the place and what is missing.
    InputError
        If the journey is not of this line or leaves it.
    """
    _check(line, journey, dwell)
    sections = sections_of(journey)
    fastest = [_fastest(line, train, configurations, each, options) for each in sections]
    least = np.array([each.times[-1] for each in fastest])
    low, high = _windows(sections, least, dwell, reserve)
    _check_times(line, journey, sections, fastest, low, high, dwell)
    schedule = _Schedule(least, low, high, dwell)

    def solve(number: int, times: FloatArray, cells: int) -> Trajectory:
        return _solved(
            line,
            train,
            configurations,
            sections[number],
            times[number],
            {**options, "cells": cells},
        )

    cells = int(options.get("cells", 500))
    times, saving = _best_times(schedule, solve, min(cells, _SCOUTING_CELLS))
    found = tuple(solve(number, times, cells) for number in range(len(sections)))
    energy = sum(float(each.certificate["energy"]) for each in found)
    bound = sum(float(each.certificate["lower_bound"]) for each in found)
    totals = np.sum([_energies(each) for each in found], axis=0)
    certificate = {
        "energy": energy,
        "lower_bound": bound,
        "gap": energy / bound - 1.0,
        "bound_holds_for": "these departures and arrivals"
        + (", the worst of each section added up" if len(found) > 1 else ""),
        "dearest": configurations[int(np.argmax(totals))].name,
        "dearest_energy": float(totals.max()),
        "other_times_might_save": saving,
        "least_running_times": least.tolist(),
        "certified": all(bool(each.certificate["certified"]) for each in found),
    }
    return JourneyPlan(journey, found, times[:, 0], times[:, 1], certificate)


def _energies(section: Trajectory) -> FloatArray:
    """Energy of each configuration by the section's objective, (q,) [J]."""
    at_line = section.provenance["settings"]["objective"] != "wheel"
    return np.array(section.certificate["line_energy" if at_line else "wheel_energy"])


def _check(line: Line, journey: Journey, dwell: float) -> None:
    if journey.line != line.name:
        raise InputError(
            f"journey '{journey.name}' is on line '{journey.line}', not on '{line.name}'",
            remedy="give its line",
        )
    if journey.points[-1].position > line.length:
        raise InputError(
            f"journey '{journey.name}' ends at km {journey.points[-1].position / 1e3:.3f}, the line"
            f" at km {line.length / 1e3:.3f}",
            remedy="give the line of the journey, in its direction of travel",
        )
    if not (dwell >= 0.0 and np.isfinite(dwell)):
        raise InputError(f"journey: a dwell time of {dwell} s makes no sense")


def _ends(section: Section) -> dict[str, float]:
    """How fast the run of a section begins and ends at most."""
    departure, arrival = section.departure, section.arrival
    return {
        "initial_speed": departure.lowest_speed or 0.0,
        "final_speed": 0.0 if arrival.highest_speed is None else arrival.highest_speed,
    }


@dataclass(frozen=True, eq=False)
class _Fastest:
    """The slowest configuration of a section on its fastest run.

    Attributes
    ----------
    name : str
    times : (p,) array [s]
        From the departure to each passing point and to the arrival.
    held : str
        What holds it back.
    """

    name: str
    times: FloatArray
    held: str


def _fastest(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    section: Section,
    options: dict[str, Any],
) -> _Fastest:
    """The fastest run of the slowest configuration; speeds that nobody reaches are refused."""
    known = {
        "braking", "layer", "sigmas", "assumed_adhesion", "protected_length", "direction",
    }  # fmt: skip
    chosen: dict[str, Any] = {key: value for key, value in options.items() if key in known}
    chosen |= {**_ends(section), "condition": options.get("condition_map")}
    first, last = section.departure.position, section.arrival.position
    run = Run(line, train, tuple(configurations), first, last, windows=section.passing, **chosen)
    fastest = fastest_run(run)
    check_speeds(run, fastest)
    slowest = int(np.argmax(fastest.times))
    places = [*(point.position for point in section.passing), last]
    return _Fastest(
        configurations[slowest].name,
        fastest.times_at(places)[slowest],
        held_back(run, fastest, slowest),
    )


def _windows(
    sections: Sequence[Section], least: FloatArray, dwell: float, reserve: float
) -> tuple[FloatArray, FloatArray]:
    """Earliest and latest departure and arrival of each section, (m, 2) arrays [s]."""
    low = np.array([[s.departure.earliest or 0.0, s.arrival.earliest or 0.0] for s in sections])
    high = np.array(
        [
            [np.inf if point.latest is None else point.latest for point in (s.departure, s.arrival)]
            for s in sections
        ]
    )
    if not np.isfinite(high[-1, 1]):
        standing = dwell * (len(sections) - 1)
        high[-1, 1] = low[0, 0] + standing + (1.0 + reserve) * float(least.sum())
    # It departs at once unless told otherwise: waiting at the start would be no timetable.
    high[0, 0] = min(high[0, 0], max(low[0, 0], 0.0)) if high[0, 0] == np.inf else high[0, 0]
    return low, high


def _check_times(
    line: Line,
    journey: Journey,
    sections: Sequence[Section],
    fastest: Sequence[_Fastest],
    low: FloatArray,
    high: FloatArray,
    dwell: float,
) -> None:
    """Refuse windows that the slowest configuration cannot keep on its fastest run."""
    time = -dwell
    for number, section in enumerate(sections):
        opens = [low[number, 0], *(point.earliest or 0.0 for point in section.passing)]
        closes = [high[number, 0], *(point.latest for point in section.passing), high[number, 1]]
        points = (section.departure, *section.passing, section.arrival)
        spent = [dwell, *np.diff(fastest[number].times, prepend=0.0).tolist()]
        opens.append(low[number, 1])
        for point, least, opening, closing in zip(points, spent, opens, closes, strict=True):
            time += least
            if closing is not None and time > closing + 1e-9:
                raise InfeasibleError(
                    f"journey '{journey.name}': configuration '{fastest[number].name}', the"
                    f" slowest, is at {place_of(line, point.position)} after {time:.1f} s"
                    f" at the earliest ({clock(time)}), {seconds(time - closing)} after its window"
                    f" closes; from {place_of(line, section.departure.position)} to"
                    f" {place_of(line, section.arrival.position)} its fastest run is"
                    f" {fastest[number].held}",
                    remedy="open that window longer, or those before it earlier",
                )
            time = max(time, float(opening))


class _Schedule:
    """Departures and arrivals that keep the windows, and the linear programs over them."""

    def __init__(self, least: FloatArray, low: FloatArray, high: FloatArray, dwell: float) -> None:
        self.least, self.low, self.high = least, low, high
        m = least.size
        self.rows: list[FloatArray] = []
        self.right: list[float] = []
        self.cuts: list[FloatArray] = []
        self.levels: list[float] = []
        for number in range(m - 1):
            # departure of the next section not before this arrival and the dwell time
            row = np.zeros(3 * m + 1)
            row[2 * number + 1], row[2 * number + 2] = 1.0, -1.0
            self.rows.append(row)
            self.right.append(-dwell)

    @property
    def count(self) -> int:
        """How many sections."""
        return self.least.size

    def even(self) -> FloatArray:
        """Times that give every section the same reserve over its least time, (m, 2) [s]."""
        m = self.count
        rows, right = list(self.rows), list(self.right)
        for number in range(m):
            row = np.zeros(3 * m + 1)
            row[2 * number], row[2 * number + 1], row[-1] = 1.0, -1.0, self.least[number]
            rows.append(row)
            right.append(-float(self.least[number]))
        cost = np.zeros(3 * m + 1)
        cost[-1] = -1.0
        bounds = [*self._bounds(), *[(0.0, 0.0)] * m, (-0.5, 3.0)]
        return self._solved(cost, rows, right, bounds)[0]

    def cheapest(self) -> tuple[FloatArray, float]:
        """Times of the least energy that the cuts allow, (m, 2) [s], and that energy [J]."""
        m = self.count
        rows, right = list(self.rows), list(self.right)
        for number in range(m):
            row = np.zeros(3 * m + 1)
            row[2 * number], row[2 * number + 1] = 1.0, -1.0
            rows.append(row)
            right.append(-_LEAST_MARGIN * float(self.least[number]))
        cost = np.zeros(3 * m + 1)
        cost[2 * m : 3 * m] = 1.0
        bounds = [*self._bounds(), *[(0.0, None)] * m, (0.0, 0.0)]
        return self._solved(cost, [*rows, *self.cuts], [*right, *self.levels], bounds)

    def cut(self, number: int, times: FloatArray, energy: float, slopes: FloatArray) -> None:
        """Energy of a section is at least that at `times` and what the slopes add."""
        row = np.zeros(3 * self.count + 1)
        row[2 * number : 2 * number + 2] = slopes / 1e6
        row[2 * self.count + number] = -1.0
        self.cuts.append(row)
        self.levels.append(float(slopes @ times - energy) / 1e6)

    def _bounds(self) -> list[tuple[float, float | None]]:
        pairs = zip(self.low.ravel().tolist(), self.high.ravel().tolist(), strict=True)
        return [(low, None if high == np.inf else high) for low, high in pairs]

    def _solved(
        self, cost: FloatArray, rows: list[FloatArray], right: list[float], bounds: Any
    ) -> tuple[FloatArray, float]:
        found = linprog(cost, A_ub=np.array(rows), b_ub=np.array(right), bounds=bounds)
        if found.status != 0:
            raise InfeasibleError(
                "journey: the windows leave no times for the slowest configuration",
                remedy="open the windows longer",
            )
        return np.asarray(found.x[: 2 * self.count]).reshape(-1, 2), 1e6 * float(found.fun)


def _best_times(
    schedule: _Schedule, solve: Callable[[int, FloatArray, int], Trajectory], cells: int
) -> tuple[FloatArray, float]:
    """Times of least energy, and what others might still save, relative."""
    times, best, chosen, saving = schedule.even(), np.inf, schedule.even(), np.inf
    for _ in range(_TURNS):
        energy = 0.0
        for number in range(schedule.count):
            certificate = solve(number, times, cells).certificate
            energy += certificate["energy"]
            arriving = sum(certificate["time_price"].values())
            slopes = np.array([certificate["departure_price"], -arriving])
            schedule.cut(number, times[number], certificate["energy"], slopes)
        if energy < best:
            best, chosen = energy, times
        times, least = schedule.cheapest()
        saving = max(1.0 - least / best, 0.0)
        if saving <= _CLOSE:
            break
        # Half way to the cuts' optimum: cuts far from it mislead.
        times = 0.5 * (times + chosen)
    return chosen, saving


def _solved(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    section: Section,
    times: FloatArray,
    options: dict[str, Any],
) -> Trajectory:
    """A section between two times, its windows counted from the departure."""
    departure, arrival = times.tolist()

    def since(time: float | None) -> float | None:
        return None if time is None else time - departure

    windows = [
        replace(point, earliest=_positive(since(point.earliest)), latest=since(point.latest))
        for point in section.passing
    ]
    question: dict[str, Any] = {
        "running_time": arrival - departure,
        "start": section.departure.position,
        "end": section.arrival.position,
        **_ends(section),
        **options,
    }
    found = optimise(line, train, configurations, windows=windows, **question)
    soonest = since(section.arrival.earliest) or 0.0
    if found.times[:, -1].min() < soonest:
        last = TimingPoint(section.arrival.position, earliest=soonest)
        found = optimise(line, train, configurations, windows=[*windows, last], **question)
    return found


def _positive(time: float | None) -> float | None:
    return None if time is None or time <= 0.0 else time
