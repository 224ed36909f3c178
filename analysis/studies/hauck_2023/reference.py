"""Reference trajectories of Hauck et al. (2023), eq. (8), by multiple shooting and IPOPT.

The lever is continuous and linear between two nodes; states are carried from node to node by
Runge-Kutta, and the constraints (7) hold at every one of its steps, not only at the nodes.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.control.route import GRID
from analysis.studies.hauck_2023 import model
from analysis.studies.hauck_2023.model import NOMINAL_MASS, TOP_SPEED, LeverTrain, Tables
from trainlog.arrays import FloatArray
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Line, StepProfile
from trainlog.simulation.drivers import Stop, check_stops
from trainlog.units import GRAVITY

SMOOTHING = 25.0
"""The gradient under the train is that of the track this far before and behind it [m]."""


@dataclass(frozen=True, slots=True)
class Reserves:
    """How much of the map is used; the rest is for what no model knows.

    Attributes
    ----------
    adhesion : float
        Share of the map's maximum adhesion: the first axle finds the rail least clean.
    brake : float
        Share of the brake that the envelope counts on.
    speed : float [m/s]
        Kept below every speed limit: efforts follow their demand with a lag.
    lever, comfort : float
        Share of the lever and of a_max: a heavier train needs more of both than a reference does.
    """

    adhesion: float = 0.95
    brake: float = 0.99
    speed: float = 0.04
    lever: float = 1.0
    comfort: float = 0.99

    def __post_init__(self) -> None:
        for name in ("adhesion", "brake", "lever", "comfort"):
            if not 0.0 < getattr(self, name) <= 1.0:
                raise InputError(
                    f"the share of the {name} must be above 0 and at most 1, not"
                    f" {getattr(self, name)}"
                )


DRIVING = Reserves()
"""Of a train under way."""

NONE = Reserves(adhesion=1.0, brake=1.0, speed=0.0, lever=1.0, comfort=1.0)
"""Of a bound."""

PLANNING = Reserves(adhesion=0.7, brake=0.7, speed=0.4, lever=0.7, comfort=0.75)
"""Of a reference, so that a controller may deviate from it."""

STOPPING_TOLERANCE = 0.5
"""epsilon_1 of eq. (8): how far beyond its stop a train may stand [m]."""

FASTEST_RISE = 1.5
"""No train gains speed faster than this [m/s²]."""

RUNNING_ON = 100.0
"""How far the tables reach beyond both ends of a section [m]."""

NO_LIMIT = StepProfile(np.zeros(1), np.array([0.999]))
"""What a controller assumes that knows no map: that the rail holds anything."""


@dataclass(frozen=True, eq=False)
class Section:
    """A train's way from one stop to the next, and what may be asked of it there.

    Attributes
    ----------
    origin, destination : Stop
    line : Line
    train : LeverTrain
    maximum_adhesion : StepProfile
        As the map has it.
    tables : Tables
        Of a train under way; its ceiling is that of the mass that brakes worst.
    planned : Tables
        Of its reference: less of everything, and the ceiling of the speed limits alone, smoothed.
    stopping : (n,) array [m²/s²]
        Square of the speed from which a reference stops at the destination, on the grid of
        `planned`.
    planning : Reserves
    """

    origin: Stop
    destination: Stop
    line: Line
    train: LeverTrain
    maximum_adhesion: StepProfile
    tables: Tables
    planned: Tables
    stopping: FloatArray
    planning: Reserves

    @property
    def name(self) -> str:
        """Both ends."""
        return f"{self.origin.station} - {self.destination.station}"

    @property
    def duration(self) -> float:
        """What the timetable allows [s]."""
        return self.destination.arrival - self.origin.departure

    @property
    def planning_train(self) -> LeverTrain:
        """The train with the lever and the comfort that a reference uses."""
        return _reserved(self.train, self.planning)

    @property
    def driving_train(self) -> LeverTrain:
        """The train with the comfort that is used under way."""
        return _reserved(self.train, DRIVING)


def section_of(
    line: Line,
    train: LeverTrain,
    maximum_adhesion: StepProfile,
    origin: Stop,
    destination: Stop,
    planning: Reserves = PLANNING,
) -> Section:
    """Prepare one section.

    Parameters
    ----------
    line : Line
        As travelled.
    train : LeverTrain
    maximum_adhesion : StepProfile
        By position.
    origin, destination : Stop
    planning : Reserves

    Raises
    ------
    InputError
        If the stops are not in the order of travel, or an adhesion is not between 0 and 1.
    """
    check_stops(line, (origin, destination))
    _check(line, maximum_adhesion)
    rail, start, stop = maximum_adhesion, origin.position, destination.position
    planned = _tables(line, rail, start, stop, planning)
    driven = _tables(line, rail, start, stop + STOPPING_TOLERANCE, DRIVING, 0.0)
    at_stop = planned.origin + GRID * np.arange(planned.sine.size) >= stop
    stopping = planned._replace(ceiling=np.where(at_stop, 0.0, TOP_SPEED**2))
    limited = _braked(planned, planning, train).ceiling
    return Section(
        origin,
        destination,
        line,
        train,
        rail,
        _braked(driven, DRIVING, train),
        planned._replace(adhesion=_smoothed(planned.adhesion), ceiling=_smoothed(limited)),
        _braked(stopping, planning, train).ceiling,
        planning,
    )


def _tables(
    line: Line, rail: StepProfile, start: float, stop: float, reserves: Reserves,
    last: float = np.inf,
) -> Tables:  # fmt: skip
    """Tables from a place on with a node at `stop` [m], beyond which the speed is `last` [m/s].

    The ceiling does not allow for braking.
    """
    before = int(np.ceil((stop - start + RUNNING_ON) / GRID))
    nodes = stop + GRID * np.arange(-before, RUNNING_ON / GRID + 1.0)
    slope = line.gradients.mean(nodes - SMOOTHING, nodes + SMOOTHING)
    limit = np.minimum(_lowest(line.speed_limits, nodes), TOP_SPEED)
    squares = np.maximum(limit - reserves.speed, 0.0) ** 2
    squares = np.where(nodes >= stop, np.minimum(squares, last**2), squares)
    return Tables(
        float(nodes[0]),
        np.asarray(slope / np.hypot(1.0, slope)),
        reserves.adhesion * _lowest(rail, nodes),
        model.limited_rise(squares, FASTEST_RISE),
    )


def sections_of(
    line: Line, train: LeverTrain, maximum_adhesion: StepProfile, stops: tuple[Stop, ...]
) -> tuple[Section, ...]:
    """All sections of a timetable.

    Raises
    ------
    InputError
        As `section_of`.
    """
    check_stops(line, stops)
    return tuple(
        section_of(line, train, maximum_adhesion, origin, destination)
        for origin, destination in pairwise(stops)
    )


@dataclass(frozen=True, eq=False)
class FastRun:
    """A run as fast as allowed, by position; (n,) arrays.

    Attributes
    ----------
    positions, speeds, times, levers : [m], [m/s], [s], [1]
    """

    positions: FloatArray
    speeds: FloatArray
    times: FloatArray
    levers: FloatArray

    @property
    def duration(self) -> float:
        """From rest to rest [s]."""
        return float(self.times[-1])


def fastest(
    section: Section, mass: float = NOMINAL_MASS, most: float = np.inf, step: float = 1.0
) -> FastRun:
    """The fastest run of a section that a reference could be.

    Parameters
    ----------
    section : Section
    mass : float [kg]
    most : float [m/s]
        Speed that is never exceeded.
    step : float [m]

    Raises
    ------
    InfeasibleError
        If the train comes to a stand on the way.
    """
    section.train.check_mass(mass)
    t = section.planned
    allowed = t._replace(ceiling=np.minimum(t.ceiling, section.stopping))
    return _fastest(section, allowed, section.planning_train, mass, most, step)


def fastest_unweighed(
    section: Section, mass: float = NOMINAL_MASS, rotating_mass: float = 0.0
) -> FastRun:
    """The fastest run of any driver who does not know the mass: (7) holds for every mass of (6).

    A bound, without any reserve: adhesion, brake, comfort and limits in full, no lag, and a lever
    that changes at every metre. The motion and the brake are those of the true mass, as if it had
    been guessed right.

    Parameters
    ----------
    section : Section
    mass : float [kg]
    rotating_mass : float [kg]
        What rotating parts add to the mass of the motion.

    Raises
    ------
    InputError
        If the train cannot have the mass.
    InfeasibleError
        If it comes to a stand on the way.
    """
    section.train.check_mass(mass)
    stop = section.destination.position + STOPPING_TOLERANCE
    start, inertia, c = section.origin.position, 1.0 + rotating_mass / mass, section.train
    t = _tables(section.line, section.maximum_adhesion, start, stop, NONE, 0.0)
    ceiling = model.braking_envelope(t.ceiling, t.sine, t.adhesion, 1.0, mass, mass, inertia, c)
    return _fastest(section, t._replace(ceiling=ceiling), c, mass, np.inf, 1.0, inertia)


def _fastest(
    section: Section, t: Tables, c: LeverTrain, mass: float, most: float, step: float,
    inertia: float = 1.0,
) -> FastRun:  # fmt: skip
    start, end = section.origin.position, section.destination.position
    run = FastRun(*model.fastest_run(start, end, step, most, mass, inertia, t, c))
    if run.positions[-1] < end - 1e-6:
        place = float(run.positions[-1])
        raise InfeasibleError(
            f"{section.name}: a train of {mass / 1e3:g} t comes to a stand at km"
            f" {place / 1e3:.3f}, on {1e3 * t.at(t.sine, place):.1f} per mille with a maximum"
            f" adhesion of {t.at(t.adhesion, place):.3f}",
            remedy="less load, or a better rail",
        )
    return run


def check_timetable(sections: tuple[Section, ...], mass: float = NOMINAL_MASS) -> None:
    """Refuse a timetable that cannot be kept, before any solver runs.

    Raises
    ------
    InfeasibleError
        Names the first section whose time is below the least, and by how much.
    """
    for section in sections:
        least = fastest(section, mass).duration
        if section.duration < least:
            raise InfeasibleError(
                f"{section.name}: the timetable allows {section.duration:.0f} s, a train of"
                f" {mass / 1e3:g} t needs {least:.1f} s at least",
                remedy=f"arrive {least - section.duration:.0f} s later or more",
            )


def smoothed_line(track: Line) -> Line:
    """The line under a train of 40 m: gradients averaged over its length, in short steps."""
    starts: FloatArray = GRID * np.arange(np.ceil(track.length / GRID), dtype=np.float64)
    middles = starts + 0.5 * GRID
    mean = track.gradients.mean(middles - SMOOTHING, middles + SMOOTHING)
    return replace(track, gradients=StepProfile(starts, mean))


def _lowest(profile: StepProfile, nodes: FloatArray) -> FloatArray:
    """The lowest value of a profile within one step of the grid around each node."""
    fine = nodes[:, None] + np.linspace(-GRID, GRID, 21)
    lowest = profile(fine).min(axis=1)
    # A step between two of the samples is met by the value on its other side.
    inside = np.searchsorted(nodes, profile.positions[1:])
    for i, lower in zip(inside, np.minimum(profile.values[1:], profile.values[:-1]), strict=True):
        for j in (i - 1, i):
            if 0 <= j < nodes.size:
                lowest[j] = min(lowest[j], lower)
    return np.asarray(lowest)


def _braked(t: Tables, reserves: Reserves, train: LeverTrain) -> Tables:
    """Tables with the ceiling from which all that lies ahead can be kept."""
    c, grip = _reserved(train, reserves), _around(t.adhesion)
    return t._replace(
        ceiling=model.braking_envelope(
            t.ceiling, t.sine, grip, reserves.brake, c.light, c.heavy, 1.0, c
        )
    )


def _reserved(train: LeverTrain, reserves: Reserves) -> LeverTrain:
    return train._replace(lever=reserves.lever, comfort=reserves.comfort * train.comfort)


def _around(adhesion: FloatArray) -> FloatArray:
    """The least within 40 m: a lever is held for a second, and looks ahead."""
    from scipy.ndimage import minimum_filter1d

    return np.asarray(minimum_filter1d(adhesion, 17, mode="nearest"))


def _smoothed(squares: FloatArray) -> FloatArray:
    """Never above `squares`, with its corners rounded over 20 m."""
    from scipy.ndimage import minimum_filter1d, uniform_filter1d

    return np.asarray(uniform_filter1d(minimum_filter1d(squares, 5, mode="nearest"), 5))


def _check(line: Line, maximum_adhesion: StepProfile) -> None:
    values = maximum_adhesion.values
    wrong = (values <= 0.0) | (values >= 1.0)
    if np.any(wrong):
        at = float(maximum_adhesion.positions[int(np.argmax(wrong))])
        raise InputError(
            f"line '{line.name}': maximum adhesion {values[wrong][0]} at km {at / 1e3:.3f} is not"
            " between 0 and 1"
        )


# -------------------------------------------------------------------------------------- references

OPTIMAL = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
"""Statuses of IPOPT with which it finds its answer to be optimal."""


NODE_SPACING = 3.0
"""Nodes are closer than this [s]."""

CHECKS = (4, 8, 16)
"""Places from node to node at which the program keeps the constraints; more if its rollout breaks
one in between or IPOPT does not end. The spline is then one of the logarithm of adhesion, which
does not swing beyond a step from what no map limits to a slippery place."""

STEPS = 2
"""Runge-Kutta steps between two of them: gradients change within 50 m, a second or two."""

FINE = 60
"""Steps from node to node of the rollout that the answer is judged by."""

TOLERANCE, FARTHEST = 1e-6, 0.5
"""Of a constraint in the rollout; of the rollout from the program [m]."""

SAMPLING = 1.0
"""Of what a controller tracks [s]."""


@dataclass(frozen=True, eq=False)
class Reference:
    """What a train of the nominal mass does between two stops.

    Attributes
    ----------
    section : Section
    mass : float [kg]
        That it was made for.
    times : (n,) array [s]
        Of the nodes, from the departure.
    positions, speeds, levers : (n,) array [m], [m/s], [1]
        Of the program, at the nodes.
    fine : (FINE (n - 1) + 1, 3) array
        Position [m], speed [m/s] and lever of an independent rollout of the levers.
    cost : float [s]
        ``1/2 ∫ u² dt``.
    iterations : int
        Of IPOPT.
    worst : (4,) array
        Largest constraint of comfort [m/s²], of traction [m/s²], of speed [m/s] and of the lever
        over the rollout, against the tables of the section, both ends of the mass; not positive.
    """

    section: Section
    mass: float
    times: FloatArray
    positions: FloatArray
    speeds: FloatArray
    levers: FloatArray
    fine: FloatArray
    cost: float
    iterations: int
    worst: FloatArray

    @property
    def duration(self) -> float:
        """From departure to arrival [s]."""
        return float(self.times[-1])

    @property
    def rollout_error(self) -> float:
        """Largest distance of the rollout from the program at the nodes [m]."""
        return float(np.abs(self.fine[::FINE, 0] - self.positions).max())

    def at(self, time: float) -> tuple[float, float, float]:
        """Position [m], speed [m/s] and lever at a time from the departure [s].

        Before it the train stands at the origin, after the arrival at the destination.
        """
        if time <= 0.0:
            return float(self.positions[0]), 0.0, 0.0
        if time >= self.duration:
            return float(self.positions[-1]), 0.0, 0.0
        x = time / self.duration * (len(self.fine) - 1)
        i = int(x)
        p, v, u = self.fine[i] + (x - i) * (
            self.fine[min(i + 1, len(self.fine) - 1)] - self.fine[i]
        )
        return float(p), float(v), float(u)

    def sampled(self) -> FloatArray:
        """Rows of position, speed and lever once a second, the arrival last."""
        count = int(np.ceil(self.duration / SAMPLING)) + 1
        return np.array([self.at(k * SAMPLING) for k in range(count)])


def node_count(duration: float) -> int:
    """Nodes that are less than `NODE_SPACING` apart; the paper's floor(T/3) leaves more."""
    return int(np.floor(duration / NODE_SPACING)) + 2


def reference(section: Section, mass: float = NOMINAL_MASS) -> Reference:
    """Solve eq. (8) for one section.

    Parameters
    ----------
    section : Section
    mass : float [kg]
        Of the motion; the constraints hold for every mass of eq. (6).

    Raises
    ------
    InfeasibleError
        Before the solver runs, if the section's time is below the least; after it, if IPOPT does
        not find a solution or the solution does not pass the rollout.
    """
    check_timetable((section,), mass)
    count = node_count(section.duration)
    times = np.linspace(0.0, section.duration, count)
    guess = warm_start(section, times, mass)
    failures = []
    for checks in CHECKS:
        try:
            return _solved(section, times, guess, mass, checks)
        except InfeasibleError as error:
            failures.append(error)
    raise failures[-1]


def _solved(
    section: Section, times: FloatArray, guess: FloatArray, mass: float, checks: int
) -> Reference:
    """The answer of the program with so many checks, if its rollout keeps the constraints."""
    for strategy in ("monotone", "adaptive"):
        solved, stats = _solve(section, times, guess, mass, strategy, checks)
        if stats["return_status"] in OPTIMAL:
            break
    else:
        raise InfeasibleError(
            f"{section.name}: IPOPT ended with {stats['return_status']} after"
            f" {stats['iter_count']} iterations",
            remedy="more time in the timetable",
        )
    positions, speeds, levers = solved
    fine = _rollout(section, times, levers, mass)
    (p, v, u), t = fine.T, section.tables
    limit = np.sqrt(t.at(t.ceiling, p))
    worst = model.constraints(v, u, t.at(t.sine, p), t.at(t.adhesion, p), limit, section.train).max(
        axis=0
    )
    found = Reference(
        section, mass, times, positions, speeds, levers, fine,
        _cost(times, levers), int(stats["iter_count"]), worst,
    )  # fmt: skip
    if worst.max() > TOLERANCE or found.rollout_error > FARTHEST:
        raise InfeasibleError(
            f"{section.name}: the rollout of the solution breaks a constraint by"
            f" {worst.max():.2g} or leaves it by {found.rollout_error:.2g} m",
            remedy="more time in the timetable",
        )
    return found


def warm_start(section: Section, times: FloatArray, mass: float) -> FloatArray:
    """A feasible guess: the fastest run below that speed with which it takes the time allowed.

    Returns
    -------
    (3, n) array
        Positions, speeds and levers at the times.
    """
    low, high = 0.3, float(np.sqrt(section.planned.ceiling.max()))
    for _ in range(40):
        most = 0.5 * (low + high)
        if fastest(section, mass, most, step=5.0).duration > times[-1]:
            low = most
        else:
            high = most
    run = fastest(section, mass, high, step=1.0)
    stretched = run.times * times[-1] / run.duration
    return np.array(
        [np.interp(times, stretched, each) for each in (run.positions, run.speeds, run.levers)]
    )


def _cost(times: FloatArray, levers: FloatArray) -> float:
    a, b = levers[:-1], levers[1:]
    return float(np.sum(np.diff(times) * (a * a + a * b + b * b)) / 6.0)


def _rollout(section: Section, times: FloatArray, levers: FloatArray, mass: float) -> FloatArray:
    rows = []
    p, v = section.origin.position, 0.0
    spans = np.diff(times)
    for span, u0, u1 in zip(spans, levers[:-1], levers[1:], strict=True):
        part = model.roll(p, v, u0, u1, span, FINE, mass, section.tables, section.train)
        p, v = part[-1, 0], part[-1, 1]
        rows.append(part[:-1])
    return np.concatenate([*rows, part[-1:]])


def _solve(
    section: Section, times: FloatArray, guess: FloatArray, mass: float, strategy: str, checks: int
) -> tuple[FloatArray, dict[str, Any]]:
    """The program (8); returns (3, n) positions, speeds and levers, and IPOPT's account."""
    import casadi as ca

    count, span = times.size, float(times[1] - times[0])
    base, length = section.origin.position, 1e3
    shoot, low, high = _interval(section, span, mass, checks)
    p, v, u = ca.MX.sym("p", count), ca.MX.sym("v", count), ca.MX.sym("u", count)
    ends, kept = shoot.map(count - 1)(p[:-1].T, v[:-1].T, u[:-1].T, u[1:].T)
    gaps = ca.vertcat(ends[0, :].T - p[1:], ends[1, :].T - v[1:])
    squares = u[:-1] ** 2 + u[:-1] * u[1:] + u[1:] ** 2
    problem = {
        "x": ca.vertcat(p, v, u),
        "f": span / 6.0 * ca.sum1(squares),
        "g": ca.vertcat(gaps, ca.reshape(kept, -1, 1)),
    }
    solver = ca.nlpsol(
        "reference", "ipopt", problem,
        {"print_time": False, "ipopt": {
            "print_level": 0, "sb": "yes", "max_iter": 200, "tol": 1e-8,
            "mu_strategy": strategy,
            "mu_init": 1e-2, "constr_viol_tol": 1e-9,
        }},
    )  # fmt: skip
    positions = (guess[0] - base) / length
    most = np.full(count, section.planning.lever)
    lowest = np.concatenate([np.full(count, -0.01), np.zeros(count), -most])
    highest = np.concatenate([np.full(count, 1e3), np.full(count, 60.0), most])
    final = (section.destination.position - base) / length
    for index, exactly in ((0, 0.0), (count - 1, final), (count, 0.0), (2 * count - 1, 0.0)):
        lowest[index] = highest[index] = exactly
    solution = solver(
        x0=np.concatenate([positions, guess[1], guess[2]]),
        lbx=lowest,
        ubx=highest,
        lbg=np.concatenate([np.zeros(2 * (count - 1)), np.tile(low, (count - 1) * checks)]),
        ubg=np.concatenate([np.zeros(2 * (count - 1)), np.tile(high, (count - 1) * checks)]),
    )
    found = np.asarray(solution["x"]).reshape(3, count).copy()
    found[0] = base + length * found[0]
    return found, solver.stats()


def _adhesion_spline(
    nodes: NDArray[np.floating[Any]], adhesion: FloatArray, logarithmic: bool
) -> Callable[[Any], Any]:
    import casadi as ca

    if not logarithmic:
        return ca.interpolant("grip", "bspline", [nodes], adhesion)
    spline = ca.interpolant("grip", "bspline", [nodes], np.log(adhesion))
    return lambda position: ca.exp(spline(position))


def _interval(
    section: Section, span: float, mass: float, checks: int
) -> tuple[Any, FloatArray, FloatArray]:
    """From one node to the next: the end state, and the constraints on the way.

    Positions are in kilometres from the origin. The light end of the mass implies the heavy one
    in (4) and (5), since what the lever alone does not overcome, `a_max` less the track, is
    positive on any railway; the rollout judges both.
    """
    import casadi as ca

    c, t = section.planning_train, section.planned
    nodes = (t.origin + GRID * np.arange(t.sine.size) - section.origin.position) / 1e3
    sine = ca.interpolant("sine", "bspline", [nodes], t.sine)
    grip = _adhesion_spline(nodes, t.adhesion, logarithmic=checks > CHECKS[0])
    ceiling = ca.interpolant("ceiling", "bspline", [nodes], t.ceiling)
    # Mirrored at the stop, so that the spline runs straight through it.
    beyond = np.maximum(np.arange(nodes.size) - int(np.argmin(section.stopping)), 0)
    mirrored = section.stopping - section.stopping[int(np.argmin(section.stopping)) - beyond]
    stopping = ca.interpolant("stopping", "bspline", [nodes], mirrored)

    def effort(v: Any) -> Any:
        return c.k1 * ca.exp(-c.k2 * v) + c.k3

    def weight(slope: Any) -> Any:
        return GRAVITY * (slope + c.rolling * ca.sqrt(1.0 - slope**2))

    def motion(v: Any, u: Any, along: Any) -> tuple[Any, Any]:
        return 1e-3 * v, (effort(v) * u - c.drag * v * v) / mass - along

    p, v, u0, u1 = (ca.MX.sym(name) for name in ("p", "v", "u0", "u1"))
    x, w, h = p, v, span / (checks * STEPS)
    kept = []
    for k in range(checks * STEPS):
        u, middle, after = (u0 + (u1 - u0) * (k + s) / (checks * STEPS) for s in (0.0, 0.5, 1.0))
        slope = weight(sine(x))
        if k % STEPS == 0:
            forward = effort(w) * u
            kept += [
                (forward - c.drag * w * w) / c.light - slope,
                forward / c.light - GRAVITY * grip(x),
                -forward / c.light - GRAVITY * grip(x),
                w * w - ceiling(x),
                w * w - stopping(x),
                w,
            ]
        a1, b1 = motion(w, u, slope)
        halfway = weight(sine(x + 0.5 * h * a1))
        a2, b2 = motion(w + 0.5 * h * b1, middle, halfway)
        a3, b3 = motion(w + 0.5 * h * b2, middle, halfway)
        a4, b4 = motion(w + h * b3, after, weight(sine(x + h * a3)))
        x = x + h / 6.0 * (a1 + 2.0 * a2 + 2.0 * a3 + a4)
        w = w + h / 6.0 * (b1 + 2.0 * b2 + 2.0 * b3 + b4)
    shoot = ca.Function("shoot", [p, v, u0, u1], [ca.vertcat(x, w), ca.vertcat(*kept)])
    most = c.comfort
    low = np.array([-most, -np.inf, -np.inf, -np.inf, -np.inf, 0.0])
    high = np.array([most, 0.0, 0.0, 0.0, 0.0, np.inf])
    return shoot, low, high
