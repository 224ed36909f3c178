"""The question: one run between two stops, and how its answer is searched for."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import KW_ONLY, dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np
from pandas import Timestamp

from analysis.adhesion.map_state import UsableAdhesion, risk_of_run, usable_adhesion
from trainlog.arrays import FloatArray, numbered
from trainlog.condition import setting
from trainlog.display import as_text, counted
from trainlog.errors import InputError
from trainlog.railway import (
    Configuration,
    Line,
    StepProfile,
    TimingPoint,
    TrackConditionMap,
    Train,
    Trajectory,
)
from trainlog.railway.line import km_words
from trainlog.units import GRAVITY, KMH, PER_MILLE

Braking = Literal["recourse", "common"]
Direction = Literal["forward", "reverse"]
Objective = Literal["wheel", "line", "expected"]

MOST_RESERVE = 5.0
"""Largest reserve over the least time: a larger one is meant in per cent."""

FEWEST_CELLS, MOST_CELLS = 20, 20_000
"""Of the grid; more cells than a line has metres cost hours and gain nothing."""

_ENERGY = {"wheel": "at the wheel", "line": "from the line", "expected": "expected from the line"}

LEAST_SECTION = 10.0
"""Shortest section [m] that a trajectory is found for: of a metre or two the bound is wrong."""

_PIECE = 10.0
"""Longest piece in which the strongest deceleration is looked at [m]."""

_RAMP = 2e-3
"""Part of the permitted ``v²/2`` by which the speed may rise inside a cell of changing gradient."""

_MOST_RAMPS = 6_000
"""Parts of changing gradient, at most, but for one between any two breakpoints."""

_SLOWEST = 1.0 / KMH
"""Least speed that must be permitted everywhere [m/s]."""


@dataclass(frozen=True, eq=False, repr=False)
class TrajectoryProblem:
    """What is asked of the optimiser: one run of a train between two stops of a line.

    Attributes
    ----------
    line : Line
        In the direction of travel.
    train : Train
    configurations : sequence of q Configuration
        The observed set: everyone must be able to follow the trajectory.
    running_time : float, optional [s]
        What the timetable allows. Without it, the least time of the slowest configuration and
        `reserve` on top.
    reserve : float
        Part of the least time. With 0 the run takes the least time in which all arrive together
        under one common traction: 0.015 per cent more than the slowest by itself, or more.
    start, end : float [m]
        Section of the line; without them the whole line.
    initial_speed, final_speed : float [m/s]
        The run ends at the final speed or below it.
    braking : {"recourse", "common"}
        ``"recourse"``: each configuration brakes for itself (the driver closes the loop with the
        brake). ``"common"``: one braking effort for all, as in Cunillera et al. (2022).
    objective : {"wheel", "line", "expected"}
        ``"wheel"``: energy at the wheel rims without regeneration, Cunillera et al. (2022),
        eq. (9). ``"line"``: energy taken from the line with the train's efficiencies and its
        dynamic brake, of the worst configuration, eq. (1). ``"expected"``: the same, as the mean
        of the configurations by their weights; all of them keep timetable and limits nevertheless.
        Of more than twelve a few then represent the others.
    weights : sequence of q float
        Of the configurations, for the expected energy; equal ones if empty.
    condition_map : TrackConditionMap, optional
        Limits efforts to the adhesion that the map cautiously promises where it was observed.
    layer : str
        Rail condition to read from the map.
    sigmas : float
        How cautiously the map is read: the estimate less this many standard deviations.
    risk : float, optional
        Instead: the probability, for each place and trip, that there is less adhesion than is
        counted on.
    time : Timestamp, optional
        Of the run: what the map expects then is counted on; default: right after its last evidence
        with a risk, else its lasting condition.
    assumed_adhesion : float
        Where the map has no estimate, unless more was demonstrated there without slip; infinite for
        no limit there. See `analysis.adhesion.map_state`.
    protected_length : float [m]
        Length of train to which a speed limit applies: 0 for its front, ``train.length`` for all.
    windows : sequence of TimingPoint
        When and how fast it may pass points on the way; times count from the start of the run.
    direction : {"forward", "reverse"}
        Of travel against the chainage of the line's file, in which the map is counted. `line` is
        given in the direction of travel all the same (`Line.reversed`), and so is every position
        here.

    Raises
    ------
    InputError
        If an attribute has a value that no run has; with the value and the remedy.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.railway import Configuration
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> TrajectoryProblem(line, train, [Configuration.of(train)], end=9_613.0, reserve=0.1)
    Trajectory problem: CH_Stadler_FLIRT_TPF on CH_StGallen_Wil, km 0.000 to km 9.613
      configurations  1
      time            10 % over the least time
      braking         recourse
      energy          at the wheel

    The train as its file describes it, without a set of observed configurations:

    >>> TrajectoryProblem.nominal(line, train, load=8_000.0, end=9_613.0).planned_for
    'the train of the file, without a band of observed trips'
    """

    line: Line
    train: Train
    configurations: Sequence[Configuration]
    _: KW_ONLY
    running_time: float | None = None
    reserve: float = 0.07
    start: float = 0.0
    end: float = np.inf
    initial_speed: float = 0.0
    final_speed: float = 0.0
    braking: Braking = "recourse"
    objective: Objective = "wheel"
    weights: Sequence[float] = ()
    condition_map: TrackConditionMap | None = None
    layer: str = "wet"
    sigmas: float = 2.0
    risk: float | None = None
    time: Timestamp | None = None
    assumed_adhesion: float = np.inf
    protected_length: float = 0.0
    windows: Sequence[TimingPoint] = ()
    direction: Direction = "forward"

    @staticmethod
    def nominal(line: Line, train: Train, *, load: float = 0.0, **asked: Any) -> TrajectoryProblem:
        """The run of a train of which no trip was observed: one configuration, that of its file.

        Parameters
        ----------
        load : float [kg]
        **asked
            The other attributes.
        """
        return TrajectoryProblem(line, train, [Configuration.of(train, load)], **asked)

    @property
    def planned_for(self) -> str:
        """For whom the trajectory holds, in words: observed configurations, or the train's file."""
        every, train = self.configurations, self.train
        own = (train.resistance, train.max_traction_power, train.rotating_mass)
        if all((c.resistance, c.max_power, c.rotating_mass) == own for c in every):
            return "the train of the file, without a band of observed trips"
        return f"{counted(len(every), 'configuration')} of a parameter set"

    def __repr__(self) -> str:
        count, time = len(self.configurations), f"{100.0 * self.reserve:g} % over the least time"
        if self.running_time is not None:
            time = f"{self.running_time:.1f} s"
        rows = {
            "configurations": f"{count}",
            "time": time,
            "braking": self.braking,
            "energy": _ENERGY[self.objective],
        }
        if self.condition_map is not None:
            rows["adhesion"] = f"of the track-condition map, {self.layer}" + (
                "" if self.risk is None else f", risk {self.risk:g} a place"
            )
        if self.windows:
            rows["passing points"] = f"{len(self.windows)}"
        title = f"Trajectory problem: {self.train.name} on {self.line.name}"
        return as_text(f"{title}, {self._km(self.start)} to {self._km(self.end)}", rows)

    def __post_init__(self) -> None:
        for name in ("configurations", "weights", "windows"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.end == np.inf:
            object.__setattr__(self, "end", self.line.length)
        line, where = self.line, f"run on line '{self.line.name}'"
        self._check_configurations(where)
        if not 0.0 <= self.start < self.end <= line.length:
            raise InputError(
                f"{where}: from km {self.start / 1e3:.3f} to km {self.end / 1e3:.3f} is not a"
                f" section of a line of {line.length / 1e3:.3f} km",
                remedy="give a start and an end on the line, in the order of travel",
            )
        if self.end - self.start < LEAST_SECTION:
            raise InputError(
                f"{where}: from {self._km(self.start)} the train would run"
                f" {self.end - self.start:.2g} m, less than {LEAST_SECTION:.0f} m",
                remedy="give an end farther away",
            )
        if not (0.0 <= self.initial_speed < np.inf and 0.0 <= self.final_speed < np.inf):
            raise InputError(
                f"{where}: initial and final speed must be finite and not negative",
                remedy="give 0 or more",
            )
        if self.braking not in get_args(Braking) or self.objective not in get_args(Objective):
            raise InputError(
                f"{where}: no such braking '{self.braking}' or objective '{self.objective}'",
                remedy="braking is 'recourse' or 'common', objective 'wheel', 'line' or 'expected'",
            )
        if not (0.0 <= self.protected_length < np.inf):
            raise InputError(
                f"{where}: the protected length must be 0 or more, not {self.protected_length} m",
                remedy="give 0 for the train's front, or the train's length",
            )
        self._check_time(where)
        self._check_windows(where)
        self._check_weights(where)
        if self.direction not in get_args(Direction):
            raise InputError(
                f"{where}: no such direction '{self.direction}'",
                remedy="give 'forward' or 'reverse'",
            )
        limit = float(self.permitted_speed(np.array([self.start]))[0])
        if self.initial_speed > limit:
            raise InputError(
                f"{where}: the initial speed {KMH * self.initial_speed:.1f} km/h is above the"
                f" {KMH * limit:.1f} km/h permitted at {self._km(self.start)}",
                remedy="lower the initial speed, or start elsewhere",
            )
        if self.condition_map is not None:
            self.condition_map.check_line(line.name, line.length, what=where)
        self._check_limits(where)

    def _check_time(self, where: str) -> None:
        """Refuse numbers that no timetable has."""
        time, reserve = self.running_time, self.reserve
        if time is not None and not (time > 0.0 and np.isfinite(time)):
            raise InputError(
                f"{where}: the running time must be above 0 and finite, not {time} s",
                remedy="give the timetable's running time in seconds",
            )
        if not 0.0 <= reserve <= MOST_RESERVE:
            raise InputError(
                f"{where}: the reserve must be 0 to {MOST_RESERVE:.0%}, not {100.0 * reserve:g}%",
                remedy="7 per cent over the least time are 0.07 in Python, 7 on the command line",
            )

    def _km(self, position: float) -> str:
        """A place of the run in words."""
        return km_words(self.line, position)

    def _check_windows(self, where: str) -> None:
        """Refuse passing points outside the run, or out of order."""
        places = [self.start, *(point.position for point in self.windows), self.end]
        # The last may be the end itself: no configuration arrives earlier than that.
        if self.windows and self.windows[-1].position == self.end:
            places.pop()
        for before, place in pairwise(places):
            if not before < place:
                raise InputError(
                    f"{where}: the passing point at {self._km(place)} does not come after"
                    f" {self._km(before)}",
                    remedy="order the points by position, between the start and the end",
                )
        for point in self.windows:
            if point.highest_speed == 0.0:
                raise InputError(
                    f"{where}: the train stands at {self._km(point.position)}, in the run",
                    remedy="a stop is where one run ends and the next begins: give a journey",
                )

    def _check_weights(self, where: str) -> None:
        """Refuse weights that are not those of these configurations."""
        weights = np.array(self.weights)
        if not self.weights:
            return
        if weights.size != len(self.configurations):
            raise InputError(
                f"{where}: {counted(weights.size, 'weight')} for"
                f" {counted(len(self.configurations), 'configuration')}",
                remedy="give one for each",
            )
        wrong = np.flatnonzero(~((weights >= 0.0) & np.isfinite(weights)))
        if wrong.size:
            raise InputError(
                f"{where}: the weight of configuration '{self.configurations[wrong[0]].name}'"
                f" must be 0 or more, not {weights[wrong[0]]:g}",
                remedy="give shares or numbers of trips",
            )
        if not weights.sum() > 0.0:
            raise InputError(
                f"{where}: the weights add up to {weights.sum():g}",
                remedy="give at least one configuration a weight above 0",
            )

    def _check_configurations(self, where: str) -> None:
        """Refuse a set that is empty, ambiguous, or whose resistance falls as the speed rises."""
        if not self.configurations:
            raise InputError(
                f"{where}: no parameter configuration given",
                remedy="give a set with at least one: 'trainlog fit' makes it from trips",
            )
        names = [configuration.name for configuration in self.configurations]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(
                f"{where}: two configurations are called '{twice}'",
                remedy="give each a name of its own",
            )
        for configuration in self.configurations:
            resistance = configuration.resistance
            for name, value in list(resistance.terms.items())[1:]:
                if value < 0.0:
                    raise InputError(
                        f"{where}: the running resistance of configuration"
                        f" '{configuration.name}' has a negative part, {name} = {value:g}",
                        remedy="fit it again without negative coefficients",
                    )

    def _check_limits(self, where: str) -> None:
        """Refuse a limit below walking pace, and a map that cannot be read as asked."""
        positions = self.breakpoints
        limit = self.permitted_speed(0.5 * (positions[:-1] + positions[1:]))
        if limit.min() < _SLOWEST:
            raise InputError(
                f"{where}: {KMH * limit.min():.2f} km/h permitted at"
                f" {self._km(positions[int(np.argmin(limit))])} is not a speed to run at",
                remedy=f"permit at least {KMH * _SLOWEST:.0f} km/h, or end the run there",
            )
        if self.condition_map is None:
            return
        if not (0.0 <= self.sigmas < np.inf):
            raise InputError(
                f"{where}: the standard deviations taken off the map must be 0 or more, not"
                f" {self.sigmas}",
                remedy="give 0 or more",
            )
        lower = self.condition_map.lower_bound(
            self.layer, self.condition_map.centres, self.sigmas, risk=self.risk, time=self.time
        )
        wrong = np.flatnonzero(~((lower > 0.0) & (self._usable > 0.0)))
        if wrong.size:
            raise InputError(
                f"{where}: the track-condition map has no adhesion at"
                f" {self._km(self.condition_map.centres[wrong[0]])}, which it marks as observed",
                remedy="build the map again; places not observed are left out, not guessed",
            )

    @property
    def at_line(self) -> bool:
        """Whether energy counts at the line, not at the wheel."""
        return self.objective != "wheel"

    @property
    def effort_prices(self) -> tuple[float, float]:
        """Energy that a unit of traction takes, and that one of the dynamic brake feeds back."""
        if not self.at_line:
            return 1.0, 0.0
        return 1.0 / self.train.efficiency_traction, self.train.efficiency_regeneration

    @property
    def limits(self) -> StepProfile:
        """The line's speed limits as the protected length of the train meets them [m/s]."""
        return self.line.limits_over(self.protected_length)

    def permitted_speed(self, position: FloatArray) -> FloatArray:
        """Highest permitted speed [m/s] at each position: line and train."""
        return np.minimum(self.limits(position), self.train.max_speed)

    def track_acceleration(self, position: FloatArray) -> FloatArray:
        """Deceleration by gradient and curves [m/s²], as the train's mass meets them."""
        return self.line.track_acceleration(position, self.train.strip_length)

    def highest_speed(self, position: FloatArray) -> FloatArray:
        """Bound of the speed [m/s] of a train that brakes no harder than it may of its own.

        From there it can keep all limits ahead with its largest deceleration, or with that of the
        line and the resistance alone where they are stronger.
        """
        nodes, z, decelerations = self._highest
        cell = np.clip(np.searchsorted(nodes, position, side="right") - 1, 0, nodes.size - 2)
        braking = z[cell + 1] + decelerations[cell] * (nodes[cell + 1] - position)
        return np.minimum(np.sqrt(2.0 * np.maximum(braking, 0.0)), self.permitted_speed(position))

    @cached_property
    def _highest(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Nodes [m], highest ``v²/2`` there, and strongest deceleration between them [m/s²]."""
        pieces = max(int((self.end - self.start) / _PIECE), 1)
        even = np.linspace(self.start, self.end, pieces + 1)
        nodes = np.unique(np.concatenate((self.breakpoints, even)))
        inside = nodes[:-1, None] + np.diff(nodes)[:, None] * np.linspace(1e-9, 1.0 - 1e-9, 5)
        limit, track = self.permitted_speed(inside[:, 2]), self.track_acceleration(inside)
        tunnel = self.train.tunnel_coefficient(self.line.tunnel_cross_section(inside[:, 2]))
        strongest = np.full(limit.size, self.train.max_deceleration)
        for each in self.configurations:
            held = each.resistance(limit) + tunnel * limit**2 + each.mass * track.max(axis=1)
            strongest = np.maximum(strongest, held / each.inertia)
        ceiling = (
            0.5 * np.minimum(np.append(limit, self.final_speed), np.insert(limit, 0, np.inf)) ** 2
        )
        work = np.concatenate(([0.0], np.cumsum(strongest * np.diff(nodes))))
        reachable = np.minimum.accumulate((ceiling + work)[::-1])[::-1] - work
        return nodes, np.maximum(reachable, 0.0), strongest

    def steepness(self, position: float) -> str:
        """What a refusal at a place [m] adds where the length of the train would level the line."""
        train, line = self.train, self.line
        if train.strip_length > 0.0:
            return f"; gradients are averaged over the train's {train.length:.0f} m"
        ahead = np.linspace(position, min(position + max(train.length, 100.0), line.length), 201)
        there = PER_MILLE * float(np.abs(line.gradient(ahead)).max())
        if train.length == 0.0:
            return f"; the gradient reaches {there:.0f} per mille there, for a train without length"
        means = line.track_acceleration(ahead, train.length) / GRAVITY
        mean = PER_MILLE * float(np.abs(means).max())
        if mean > 0.9 * there:
            return ""
        return (
            f"; the gradient reaches {there:.0f} per mille there, but {mean:.0f} averaged over the"
            f" train's {train.length:.0f} m: state 'mass_model': 'homogeneous_strip' in its file"
        )

    @property
    def breakpoints(self) -> FloatArray:
        """Positions [m] from start to end at which something about the line changes."""
        points = np.concatenate(
            (
                self.line.edges(self.train.strip_length),
                self.limits.positions,
                [point.position for point in self.windows],
            )
        )
        inside = points[(points > self.start) & (points < self.end)]
        return self._with_ramps(np.unique(np.concatenate(([self.start], inside, [self.end]))))

    def _with_ramps(self, points: FloatArray) -> FloatArray:
        """With points in between where the gradient under the train changes.

        With one effort the speed then rises inside a cell, and must stay below the limit there.
        """
        if self.train.strip_length == 0.0:
            return points
        step = np.diff(points)
        ends = self.track_acceleration(points)
        squares = 0.5 * self.permitted_speed(points[:-1] + 0.5 * step) ** 2
        longest = np.sqrt(8.0 * _RAMP * squares * step / np.maximum(np.abs(np.diff(ends)), 1e-9))
        coarser = max(1.0, float((step / longest).sum()) / _MOST_RAMPS)
        counts = np.ceil(step / (coarser * longest)).astype(np.int64)
        cell, number = numbered(counts)
        between = points[cell] + number / counts[cell] * step[cell]
        return np.append(between, points[-1])

    @property
    def hard_breakpoints(self) -> FloatArray:
        """Those that no grid may leave out: changes of the speed limit, and passing points."""
        points = np.array([*self.limits.positions, *(point.position for point in self.windows)])
        inside = points[(points > self.start) & (points < self.end)]
        return np.unique(np.concatenate(([self.start], inside, [self.end])))

    @cached_property
    def usable(self) -> UsableAdhesion | None:
        """What may be counted on in each bin of the map; None without a map."""
        if self.condition_map is None:
            return None
        return usable_adhesion(
            self.condition_map,
            self.layer,
            sigmas=self.sigmas,
            risk=self.risk,
            time=self.time,
            assumed=self.assumed_adhesion,
        )

    @property
    def _usable(self) -> FloatArray:
        """Adhesion to count on in each bin of the map; infinite where nothing limits."""
        return np.zeros(0) if self.usable is None else self.usable.values

    def adhesion_at(self, positions: FloatArray) -> FloatArray:
        """Cautious maximum adhesion at each position; infinite where unknown."""
        if self.condition_map is None:
            return np.full(positions.shape, np.inf)
        own = self.line.length - positions if self.direction == "reverse" else positions
        return np.asarray(self._usable[self.condition_map.bin_of(own)])

    def adhesion(self, positions: FloatArray) -> FloatArray:
        """Cautious maximum adhesion in each cell between `positions`; infinite where unknown."""
        cells = positions.size - 1
        if self.condition_map is None:
            return np.full(cells, np.inf)
        if self.direction == "reverse":
            # The map is counted in the line's own direction.
            turned = replace(self, direction="forward")
            return turned.adhesion(self.line.length - positions[::-1])[::-1]
        bins = self._usable
        first = self.condition_map.bin_of(positions[:-1])
        last = self.condition_map.bin_of(np.nextafter(positions[1:], -np.inf))
        spans = np.column_stack((first, last + 1)).ravel()
        return np.asarray(np.minimum.reduceat(np.append(bins, np.inf), spans)[::2])


@dataclass(frozen=True)
class OptimiserOptions:
    """How a trajectory is searched for.

    Attributes
    ----------
    cells : int
        Cells of the grid, about; a line with many breakpoints gets more.
    tolerance : float
        Total gap, relative, above which the cells are laid anew about the plan found.
    time_limit : float or None [s]
        After which the best that was found is the answer, with its gap; what has begun is finished,
        and where nothing is known that all can drive the search goes on until there is. None: no
        limit.

    Raises
    ------
    InputError
        If there are too few or too many cells, the tolerance is negative, or there is no time.

    Examples
    --------
    >>> OptimiserOptions(cells=200)
    OptimiserOptions(cells=200, tolerance=0.0005, time_limit=None)
    """

    cells: int = 500
    tolerance: float = 5e-4
    time_limit: float | None = None

    def __post_init__(self) -> None:
        if not self.tolerance >= 0.0:
            raise InputError(
                f"trajectory: the tolerance of the gap must be 0 or more, not {self.tolerance:g}",
                remedy="0.0005 asks for 0.05 per cent",
            )
        if self.time_limit is not None and not self.time_limit > 0.0:
            raise InputError(
                f"trajectory: the time limit must be more than 0 s, not {self.time_limit:g}",
                remedy="leave it out, or give some seconds",
            )
        if not FEWEST_CELLS <= self.cells <= MOST_CELLS:
            raise InputError(
                f"trajectory: the grid must have {FEWEST_CELLS} to {MOST_CELLS} cells, not"
                f" {self.cells}",
                remedy="give about one for 60 m of line",
            )


DEFAULT_OPTIONS = OptimiserOptions()


def adhesion_demand(run: TrajectoryProblem, trajectory: Trajectory) -> FloatArray:
    """Most adhesion that any configuration asks for in each bin of the run's map; (n,) array.

    Traction and dynamic brake of the powered axles, braking of all; 0 beyond the trajectory.
    """
    track = run.condition_map
    assert track is not None
    asked = np.maximum(*_asked(run, trajectory))
    places = trajectory.positions
    if run.direction == "reverse":
        places, asked = run.line.length - places[::-1], asked[::-1]
    found = np.zeros(track.bins)
    first = track.bin_of(places[:-1])
    last = track.bin_of(np.nextafter(places[1:], -np.inf))
    for cell in range(asked.size):
        here = slice(first[cell], last[cell] + 1)
        found[here] = np.maximum(found[here], asked[cell])
    return found


def _asked(run: TrajectoryProblem, trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Most adhesion that any configuration asks for in traction and in braking; (n,) arrays.

    The dynamic brake gives what it can, within what the map leaves it; friction gives the rest.
    """
    train, brake = run.train, trajectory.braking_effort
    masses = np.array([[each.mass] for each in trajectory.configurations])
    adhesive = np.array([train.adhesive_weight(mass - train.mass) for mass in masses])
    pull = trajectory.tractive_effort + 0.5 * np.abs(trajectory.tractive_effort_fall)
    fastest = np.maximum(trajectory.speeds[:, 1:], trajectory.speeds[:, :-1])
    dynamic = np.minimum(brake, train.dynamic_braking_effort_limit(fastest)) / adhesive
    dynamic = np.minimum(dynamic, run.adhesion(trajectory.positions))
    return pull / adhesive.min(), np.maximum(brake / (GRAVITY * masses), dynamic).max(axis=0)


def expected_when(time: Timestamp | None) -> str:
    """For which time a map's expectation holds."""
    return "right after the last evidence" if time is None else f"at {time.isoformat()}"


def read_words(risk: float | None, time: Timestamp | None, less: str) -> str:
    """How a map is read: with a risk, or what lasts or is expected `less` a margin."""
    when = expected_when(time)
    if risk is not None:
        return f"at most a risk of {risk:g} a place, as expected {when}"
    if time is None:
        return f"the lasting condition {less}"
    return f"what is expected {when}, with passing spots, {less}"


def adhesion_words(run: TrajectoryProblem, trajectory: Trajectory) -> list[str]:
    """How the map was read, over how many kilometres it limits, and the risk of the run.

    Without a map: the most adhesion that the run asks for, which nothing limits.

    Examples
    --------
    >>> import trainlog
    >>> from trainlog.railway import Configuration
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> alone = (Configuration.of(train),)
    >>> run = TrajectoryProblem(line, train, alone, condition_map=track, risk=0.05)
    >>> standing = Trajectory(
    ...     line.name, train.name, np.array([0.0, 500.0]), alone, np.zeros((1, 2)),
    ...     np.zeros((1, 2)), np.zeros(1), np.zeros((1, 1)), 100.0,
    ... )
    >>> adhesion_words(run, standing)[0]
    'adhesion: layer wet, at most a risk of 0.05 a place, as expected right after the last evidence'
    """
    track, usable = run.condition_map, run.usable
    if track is None or usable is None:
        pulling, braking = (each.max(initial=0.0) for each in _asked(run, trajectory))
        return [
            "adhesion: no limit, no map given (--map); the plan uses up to"
            f" {pulling:.3f} in traction, {braking:.3f} in braking"
        ]
    when = expected_when(run.time)
    less = f"less {run.sigmas:g} standard deviations"
    ends = trajectory.positions[[0, -1]]
    start, end = run.line.length - ends[::-1] if run.direction == "reverse" else ends
    edges = track.bin_length * np.arange(track.bins + 1)
    km = np.diff(np.clip(edges, start, end)) / 1e3
    free = np.isinf(usable.values)
    parts = [
        (km[usable.seen].sum(), "known from slip"),
        (km[usable.demonstrated].sum(), "demonstrated without slip"),
        (km[usable.assumed & ~free].sum(), f"assumed, {run.assumed_adhesion:g}"),
        (km[free].sum(), "without a limit, for want of evidence (assumed-adhesion sets one)"),
    ]
    shares = ", ".join(f"{length:.1f} km {words}" for length, words in parts if length > 0.0)
    expected = track.layer(run.layer).expected(run.time)
    demand = np.where(expected.observed, adhesion_demand(run, trajectory), 0.0)
    risk = risk_of_run(expected, demand, track.bin_length, setting(track, "correlation_length"))
    low, high = (f"{100.0 * each:.2g} %" for each in risk)
    return [
        f"adhesion: layer {run.layer}, {read_words(run.risk, run.time, less)}",
        f"of {km.sum():.1f} km: {shares}",
        f"risk that a run finds less than it asks for somewhere, as expected {when}: {low} to"
        f" {high}, from the {km[usable.seen].sum():.1f} km known from slip alone",
    ]
