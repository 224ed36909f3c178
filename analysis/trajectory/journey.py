"""A whole journey: sections between stops, and the departures that make it cheapest.

Sections are coupled by their times (`schedule`): that is how the reserve of a timetable is shared
among them. And by the train, which runs in one configuration from the first stop to the last
(`mixture`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.certificate import GAP_TOLERANCE
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.feasibility import check_speeds, held_back, place_of, seconds
from analysis.trajectory.mixture import worst_mixture
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.run import Run
from analysis.trajectory.schedule import Schedule, best_times
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Configuration, Line, Train, Trajectory
from trainlog.railway.journey import Journey, TimingPoint
from trainlog.units import clock

FloatArray = NDArray[np.float64]

_SCOUTING_CELLS = 120

_MIXTURES = 3
"""How often the mixture of configurations and the times are found in turn."""

_SAME_TIMES = 0.5
"""Change of the times [s] below which the mixture is that of before."""


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
        Of all sections together, and what other times might still save. The sections carry their
        own certificates. ``energy`` is that of the configuration that takes most in all, the
        ``dearest``, or the expected one. At the line the sections are optimised for the
        ``mixture`` of configurations that makes the journey dearest; ``lower_bound`` holds for it,
        and so for the worst.
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
    asked = _Asked(line, train, tuple(configurations), sections, options)
    schedule = Schedule(least, low, high, dwell)
    cells = int(options.get("cells", 500))
    times, saving, mixture = _planned(asked, schedule, min(cells, _SCOUTING_CELLS))
    found = asked.all(times, cells=cells, **_mixed(mixture))
    totals = _totals(found)
    energy = float(totals.max())
    if options.get("objective") == "expected":
        energy = sum(float(each.certificate["energy"]) for each in found)
    bound = sum(float(each.certificate["lower_bound"]) for each in found)
    gap = (energy - bound) / max(abs(bound), 1.0)
    certificate = {
        "energy": energy,
        "lower_bound": bound,
        "gap": gap,
        "bound_holds_for": "these departures and arrivals",
        "dearest": configurations[int(np.argmax(totals))].name,
        "dearest_energy": float(totals.max()),
        "mixture": {
            each.name: float(part)
            for each, part in zip(configurations, mixture, strict=False)
            if part > 0.0
        },
        "other_times_might_save": saving,
        "least_running_times": least.tolist(),
        "certified": gap <= GAP_TOLERANCE,
    }
    return JourneyPlan(journey, found, times[:, 0], times[:, 1], certificate)


@dataclass(frozen=True, eq=False)
class _Asked:
    """What is asked of every section."""

    line: Line
    train: Train
    configurations: tuple[Configuration, ...]
    sections: tuple[Section, ...]
    options: dict[str, Any]

    def section(self, number: int, times: FloatArray, **more: Any) -> Trajectory:
        """One section between its departure and arrival, (2,) [s]."""
        return _solved(
            self.line,
            self.train,
            self.configurations,
            self.sections[number],
            times,
            {**self.options, **more},
        )

    def all(self, times: FloatArray, **more: Any) -> tuple[Trajectory, ...]:
        """All of them, between times (m, 2) [s]."""
        return tuple(self.section(number, each, **more) for number, each in enumerate(times))


def _planned(asked: _Asked, schedule: Schedule, cells: int) -> tuple[FloatArray, float, FloatArray]:
    """Times of least energy, what others might save, and the mixture of configurations it is of.

    At the wheel all configurations take the same, and the expected energy adds up; at the line the
    worst of a journey is worst in all its sections together. There is no mixture but there.
    """
    times, saving = best_times(schedule, partial(asked.section, cells=cells), schedule.even())
    several = min(len(asked.sections), len(asked.configurations)) > 1
    if asked.options.get("objective") != "line" or not several:
        return times, saving, np.zeros(0)
    totals = _totals(asked.all(times, cells=cells))
    mixture = np.eye(totals.size)[int(np.argmax(totals))]
    for _ in range(_MIXTURES):
        at = times

        def energies(parts: FloatArray, at: FloatArray = at) -> FloatArray:
            return _totals(asked.all(at, cells=cells, **_mixed(parts)))

        mixture = worst_mixture(energies, mixture)
        solve = partial(asked.section, cells=cells, **_mixed(mixture))
        times, saving = best_times(schedule.anew(), solve, at)
        if float(np.abs(times - at).max()) <= _SAME_TIMES:
            break
    return times, saving, mixture


def _mixed(mixture: FloatArray) -> dict[str, Any]:
    """How a section is asked for its part in a journey whose worst is that of a mixture."""
    return {"objective": "expected", "weights": tuple(mixture.tolist())} if mixture.size else {}


def _totals(sections: Sequence[Trajectory]) -> FloatArray:
    """Energy of each configuration over all sections, by their objective, (q,) [J]."""
    kinds = ["line_energy" if each.objective != "wheel" else "wheel_energy" for each in sections]
    energies = [each.certificate[kind] for each, kind in zip(sections, kinds, strict=True)]
    return np.asarray(np.sum(energies, axis=0))


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
