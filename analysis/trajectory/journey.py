"""A whole journey: sections between stops, and the departures that make it cheapest.

Sections are coupled by their times. The least energy of a section is convex in its departure and
arrival, and the multipliers of a solution are its slopes: each solution is a cutting plane, and a
linear program over the cuts and the windows chooses the next times (Kelley, 1960).

They are coupled by the train, too: a configuration is the same in all sections, so that what is
spent at worst is ``max over configurations of the sum over sections``. By the minimax theorem it is
the highest, over mixtures of the configurations, of the least energy expected under the mixture;
and each section's least expected energy can be found by itself. Every mixture gives a lower bound.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import cvxpy as cp
import numpy as np

from analysis.trajectory.advice import with_times
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.feasibility import check_speeds, limiting_factors, place_of, seconds
from analysis.trajectory.optimiser import COARSE_CELLS, gap_of, optimise
from analysis.trajectory.problem import DEFAULT_OPTIONS, OptimiserOptions, TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.presentation import Presented, WordTable
from trainlog.progress import task
from trainlog.railway import Line, Trajectory
from trainlog.railway.trajectory import Journey, TimingPoint
from trainlog.units import JOULES_PER_KWH, clock

_TURNS = 12
_CLOSE = 2e-4
"""Energy that other times might still save, relative, when the search for them ends."""

_LEAST_MARGIN = 1.01
"""Least running time over that of the slowest configuration by itself."""


class Schedule:
    """Departures and arrivals that keep the windows, and the linear programs over them.

    Parameters
    ----------
    least : (m,) array [s]
        Least running time of each section.
    low, high : (m, 2) array [s]
        Windows of its departure and arrival.
    dwell : float [s]
    """

    def __init__(self, least: FloatArray, low: FloatArray, high: FloatArray, dwell: float) -> None:
        self.least, self.low, self.high, self.dwell = least, low, high, dwell
        self.times, self.energies = cp.Variable(low.shape), cp.Variable(least.size)
        self.running = self.times[:, 1] - self.times[:, 0]
        late = np.nonzero(np.isfinite(high))
        self.limits = [self.times >= low, self.times[late] <= high[late]]
        self.limits += [self.times[1:, 0] >= self.times[:-1, 1] + dwell] * (self.count > 1)
        self.cuts: list[Any] = []

    @property
    def count(self) -> int:
        """How many sections."""
        return self.least.size

    def anew(self) -> Schedule:
        """The same without its cuts."""
        return Schedule(self.least, self.low, self.high, self.dwell)

    def even(self) -> FloatArray:
        """Times that give every section the same reserve over its least time, (m, 2) [s]."""
        share = cp.Variable(bounds=[-0.5, 3.0])
        return self._solved(-share, [self.running >= self.least * (1.0 + share)])[0]

    def cheapest(self) -> tuple[FloatArray, float]:
        """Times of the least energy that the cuts allow, (m, 2) [s], and that energy [J]."""
        slow_enough = self.running >= _LEAST_MARGIN * self.least
        return self._solved(cp.sum(self.energies), [slow_enough, *self.cuts])

    def cut(self, number: int, times: FloatArray, energy: float, slopes: FloatArray) -> None:
        """Energy of a section is at least that at `times` and what the slopes add."""
        least = energy / 1e6 + slopes / 1e6 @ (self.times[number] - times)
        self.cuts.append(self.energies[number] >= least)

    def _solved(self, cost: Any, limits: list[Any]) -> tuple[FloatArray, float]:
        program = cp.Problem(cp.Minimize(cost), [*self.limits, *limits])
        program.solve(solver=cp.SCIPY)
        if program.status != cp.OPTIMAL:
            raise InfeasibleError(
                "journey: the windows leave no times for the slowest configuration",
                remedy="open the windows longer",
            )
        return np.asarray(self.times.value) + 0.0, 1e6 * float(program.value)


def best_times(
    schedule: Schedule, solve: Callable[[int, FloatArray], Trajectory], start: FloatArray
) -> tuple[FloatArray, float]:
    """Times of least energy, and what others might still save, relative.

    Parameters
    ----------
    schedule : Schedule
        Without cuts.
    solve : callable
        From a section's number and its times, (2,) [s], to its trajectory.
    start : (m, 2) array [s]
        Where the search begins.
    """
    times, best, chosen, saving = start, np.inf, start, np.inf
    for _ in range(_TURNS):
        energy = 0.0
        for number in range(schedule.count):
            certificate = solve(number, times[number]).certificate
            energy += certificate["energy"]
            arriving = sum(certificate["time_price"].values())
            slopes = np.array([certificate["departure_price"], -arriving])
            schedule.cut(number, times[number], certificate["energy"], slopes)
        if energy < best:
            best, chosen = energy, times
        times, least = schedule.cheapest()
        saving = max((best - least) / max(abs(best), 1.0), 0.0)
        if saving <= _CLOSE:
            break
        # Half way to the cuts' optimum: cuts far from it mislead.
        times = 0.5 * (times + chosen)
    return chosen, saving


_MIXTURE_TURNS = 10
_MIXTURE_CLOSE = 1e-4
"""Part of the energy by which the worst may be above what its mixture expects, at the end."""

_LITTLE = 0.05
"""Part of a mixture that is enough for a configuration to have its own brakes optimised."""

_LEAST_PART = 2e-3
"""Part of a mixture below which a configuration is left out of it."""


def worst_mixture(energies: Callable[[FloatArray], FloatArray], start: FloatArray) -> FloatArray:
    """The mixture under which the least expected energy is highest, about.

    Parameters
    ----------
    energies : callable
        From a mixture to the energies of all configurations, (q,) [J], under the plan of least
        expected energy.
    start : (q,) array
        Where the search begins; parts that add up to 1.

    Returns
    -------
    (q,) array
        Parts that add up to 1: the mixture whose plan has the least worst energy of those tried.
    """
    mixture, chosen, best, least = start, start, np.inf, -np.inf
    seen = list[FloatArray]()
    for _ in range(_MIXTURE_TURNS):
        found = energies(mixture)
        seen.append(found)
        least = max(least, float(mixture @ found))
        if found.max() < best:
            best, chosen = float(found.max()), mixture
        scale = float(np.abs(seen).max())
        if best - least <= _MIXTURE_CLOSE * scale:
            break
        before, mixture = mixture, _rounded(_next(np.array(seen) / scale, chosen))
        if np.abs(mixture - before).max() < _LEAST_PART:
            break
    return chosen


def _next(seen: FloatArray, chosen: FloatArray) -> FloatArray:
    """First a little of all that take more than the mixture expects, then what the cuts give."""
    if seen.shape[0] == 1:
        costlier = (seen[0] > chosen @ seen[0]) & (chosen == 0.0)
        if costlier.any():
            return np.asarray((1.0 - _LITTLE) * chosen + _LITTLE * costlier / costlier.sum())
    # Half way to the cuts' optimum: cuts far from it mislead.
    return np.asarray(0.5 * (_highest(seen) + chosen))


def _highest(seen: FloatArray) -> FloatArray:
    """The mixture under which the least of the energies seen is highest."""
    parts, least = cp.Variable(seen.shape[1], nonneg=True), cp.Variable()
    program = cp.Problem(cp.Maximize(least), [cp.sum(parts) == 1.0, seen @ parts >= least])
    program.solve(solver=cp.SCIPY)
    return np.asarray(parts.value)


def _rounded(mixture: FloatArray) -> FloatArray:
    """Without those that hardly count: they need no place in the program."""
    kept = np.where(mixture < _LEAST_PART, 0.0, mixture)
    return np.asarray(kept / kept.sum())


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


@dataclass(frozen=True, eq=False, repr=False)
class JourneyPlan(Presented):
    """Trajectories of all sections of a journey, and when each departs.

    Printing it lists them.

    Attributes
    ----------
    journey : Journey
    sections : tuple of m Trajectory
    departures, arrivals : (m,) array [s]
        Since the start of the journey; arrivals as planned, no configuration is later.
    certificate : dict
        Of all sections together, and what other times might still save. The sections carry their
        own certificates. ``energy`` is that of the configuration that takes most in all, the
        ``costliest``, or the expected one. At the line the sections are optimised for the
        ``mixture`` of configurations that makes the journey costliest; ``lower_bound`` holds for
        it, and so for the worst.
    """

    journey: Journey
    sections: tuple[Trajectory, ...]
    departures: FloatArray
    arrivals: FloatArray
    certificate: dict[str, Any] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """The journey and its line."""
        return f"Plan of journey '{self.journey.name}' on {self.journey.line}"

    @property
    def line(self) -> str:
        """Name of the line."""
        return self.journey.line

    @property
    def train(self) -> str:
        """Name of the train."""
        return self.sections[0].train

    @property
    def running_time(self) -> float:
        """From the first departure to the last arrival, with the standing times [s]."""
        return float(self.arrivals[-1] - self.departures[0])

    @property
    def energy_label(self) -> str:
        """The energy that the certificate states, in words."""
        mixed = self.certificate["mixture"]
        return "worst-case energy from the line" if mixed else self.sections[0].energy_label

    def tables(self) -> list[WordTable]:
        """Sections: when, how much, and what a second is worth in each."""
        from analysis.trajectory.table import journey_table

        return [journey_table(self)]

    def summary(self) -> dict[str, str]:
        """When the train runs in each section, and its energy."""
        rows = {
            "sections": f"{len(self.sections)}",
            "running time": f"{self.running_time:.1f} s ({clock(self.running_time)})",
        }
        if "energy" in self.certificate:
            rows["energy"] = (
                f"{self.certificate['energy'] / JOULES_PER_KWH:.2f} kWh,"
                f" at most {self.certificate['gap']:.3%} above the minimum for these times"
            )
        return rows


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
    following = [*(point.position for point in journey.points[2:]), journey.points[-1].position]
    for point, ahead in zip(journey.points[1:], following, strict=True):
        stands = ahead == point.position and point.position != departure.position
        if stands and point is not journey.points[-1] and point.highest_speed not in (None, 0.0):
            raise InputError(
                f"journey '{journey.name}': the train stops at km {point.position / 1e3:.3f}, where"
                " two points stand, but may arrive there at a speed",
                remedy="leave out its highest speed, or one of the two points",
            )
        if point.position == departure.position:
            if not arrived or passing:
                raise InputError(
                    f"journey '{journey.name}': at km {point.position / 1e3:.3f} there is more than"
                    " an arrival and a departure",
                    remedy="two points at one position are a stop",
                )
            departure, arrived = point, False
        elif stands or point.highest_speed == 0.0:
            sections.append(Section(departure, point, tuple(passing)))
            # Without a departure of its own the train leaves when it may.
            departure, passing, arrived = replace(point, latest=None), [], True
        else:
            passing.append(point)
    return tuple(sections)


@task("optimising the sections")
def optimise_journey(
    problem: TrajectoryProblem,
    journey: Journey,
    options: OptimiserOptions = DEFAULT_OPTIONS,
    *,
    dwell: float = 0.0,
) -> JourneyPlan:
    """Trajectories of least worst-case energy for all sections of a journey.

    Parameters
    ----------
    problem : TrajectoryProblem
        Line, train, configurations and what else is the same in every section. Places, speeds,
        windows and times come from the journey; the reserve counts where the journey does not state
        when it ends, as part of the least running time.
    journey : Journey
        On the problem's line, in the direction of travel.
    options : OptimiserOptions
    dwell : float [s]
        Least time that the train stands at each stop on the way.

    Raises
    ------
    InfeasibleError
        If the windows cannot be kept; with the place and what is missing.
    InputError
        If the journey is not of this line or leaves it.

    Examples
    --------
    >>> from trainlog import Journey
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.railway import Configuration, TimingPoint
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> stops = [TimingPoint(place, None, None, 0.0, 0.0) for place in (0.0, 9_613.0, 15_000.0)]
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], reserve=0.1)
    >>> journey = Journey("one stop", line.name, tuple(stops))
    >>> plan = optimise_journey(problem, journey, OptimiserOptions(cells=60), dwell=30.0)
    >>> len(plan.sections), bool(plan.departures[1] - plan.arrivals[0] >= 30.0 - 1e-6)
    (2, True)
    """
    _check(problem.line, journey, dwell)
    sections = sections_of(journey)
    fastest = [_fastest(problem, each) for each in sections]
    least = np.array([each.times[-1] for each in fastest])
    low, high = _windows(sections, least, dwell, problem.reserve)
    _check_times(problem.line, journey, sections, fastest, low, high, dwell)
    parts, schedule = _Sections(problem, sections), Schedule(least, low, high, dwell)
    coarse = OptimiserOptions(min(options.cells, COARSE_CELLS), tolerance=np.inf)
    times, saving, mixture = _planned(parts, schedule, coarse)
    found = parts.mixed(mixture).solve_all(times, options)
    totals = _totals(found)
    energy = float(totals.max())
    if problem.objective == "expected":
        energy = sum(float(each.certificate["energy"]) for each in found)
    running = times[:, 1] - times[:, 0]
    bound = sum(float(each.certificate["lower_bound"]) for each in found)
    tolerance = sum(float(each.certificate["tolerance"]) for each in found)
    unit = problem.configurations[0].inertia
    certificate = {
        "energy": energy,
        "lower_bound": bound,
        "gap": gap_of(energy / unit, bound / unit),
        "tolerance": tolerance,
        "bound_holds_for": "these departures and arrivals",
        "costliest": problem.configurations[int(np.argmax(totals))].name,
        "costliest_energy": float(totals.max()),
        "mixture": {
            each.name: float(part)
            for each, part in zip(problem.configurations, mixture, strict=False)
            if part > 0.0
        },
        "other_times_might_save": saving,
        "least_running_times": least.tolist(),
        "least_time": [float(least.sum())],
        "reserve": float(running.sum() / least.sum() - 1.0),
        "standing": float(times[-1, 1] - times[0, 0] - running.sum()),
        "time_price": found[-1].certificate["time_price"],
        "certified": bool(energy - bound <= tolerance),
    }
    departing = with_times(found, times[:, 0], journey.name)
    return JourneyPlan(journey, departing, times[:, 0], times[:, 1], certificate)


@dataclass(frozen=True, eq=False)
class _Sections:
    """The sections of a journey, and the problem that each is a part of."""

    problem: TrajectoryProblem
    sections: tuple[Section, ...]

    def mixed(self, mixture: FloatArray) -> _Sections:
        """The same, for the energy expected under a mixture of the configurations, if any."""
        if not mixture.size:
            return self
        weights = tuple(mixture.tolist())
        return replace(self, problem=replace(self.problem, objective="expected", weights=weights))

    def solve(self, number: int, times: FloatArray, options: OptimiserOptions) -> Trajectory:
        """A section between its departure and arrival, (2,) [s]; windows count from the former."""
        section, (departure, arrival) = self.sections[number], times.tolist()

        def since(time: float | None) -> float | None:
            return None if time is None else time - departure

        windows = [
            replace(point, earliest=_positive(since(point.earliest)), latest=since(point.latest))
            for point in section.passing
        ]
        part = replace(
            _section_problem(self.problem, section),
            running_time=arrival - departure,
            windows=windows,
        )
        found = optimise(part, options)
        soonest = since(section.arrival.earliest) or 0.0
        if found.times[:, -1].min() < soonest:
            last = TimingPoint(section.arrival.position, earliest=soonest)
            found = optimise(replace(part, windows=[*windows, last]), options)
        return found

    def solve_all(self, times: FloatArray, options: OptimiserOptions) -> tuple[Trajectory, ...]:
        """All of them, between times (m, 2) [s]."""
        return tuple(self.solve(number, each, options) for number, each in enumerate(times))


def _planned(
    sections: _Sections, schedule: Schedule, options: OptimiserOptions
) -> tuple[FloatArray, float, FloatArray]:
    """Times of least energy, what others might save, and the mixture of configurations it is of.

    At the wheel all configurations take the same, and the expected energy adds up; at the line the
    worst of a journey is worst in all its sections together. There is no mixture but there.
    """
    solve = partial(sections.solve, options=options)
    times, saving = best_times(schedule, solve, schedule.even())
    several = min(len(sections.sections), len(sections.problem.configurations)) > 1
    if sections.problem.objective != "line" or not several:
        return times, saving, np.zeros(0)
    totals = _totals(sections.solve_all(times, options))
    mixture = np.eye(totals.size)[int(np.argmax(totals))]
    for _ in range(_MIXTURES):
        at = times

        def energies(parts: FloatArray, at: FloatArray = at) -> FloatArray:
            return _totals(sections.mixed(parts).solve_all(at, options))

        mixture = worst_mixture(energies, mixture)
        solve = partial(sections.mixed(mixture).solve, options=options)
        times, saving = best_times(schedule.anew(), solve, at)
        if float(np.abs(times - at).max()) <= _SAME_TIMES:
            break
    return times, saving, mixture


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
        raise InputError(
            f"journey: the dwell time must be 0 or more and finite, not {dwell} s",
            remedy="write it as 30s",
        )


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


def _section_problem(problem: TrajectoryProblem, section: Section) -> TrajectoryProblem:
    """The problem between the stops of a section; its windows count from the journey's start."""
    departure, arrival = section.departure, section.arrival
    return replace(
        problem,
        running_time=None,
        start=departure.position,
        end=arrival.position,
        initial_speed=departure.lowest_speed or 0.0,
        final_speed=0.0 if arrival.highest_speed is None else arrival.highest_speed,
        windows=section.passing,
    )


def _fastest(problem: TrajectoryProblem, section: Section) -> _Fastest:
    """The fastest run of the slowest configuration; speeds that none reaches are refused."""
    run = _section_problem(problem, section)
    fastest = fastest_run(run)
    check_speeds(run, fastest)
    slowest = int(np.argmax(fastest.times))
    places = [*(point.position for point in section.passing), run.end]
    return _Fastest(
        run.configurations[slowest].name,
        fastest.times_at(places)[slowest],
        limiting_factors(run, fastest, slowest),
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
    # Without a window it departs at once: waiting at the start would be no timetable.
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


def _positive(time: float | None) -> float | None:
    return None if time is None or time <= 0.0 else time
