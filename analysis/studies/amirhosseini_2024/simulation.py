"""Amirhosseini et al. (2024), section 5: a train learns its resistance while it follows a profile.

The plant is the single-particle train of eq. (10), integrated continuously between the samples;
the estimators are those of eqs. (22)-(25), the controller is that of eq. (34). The same system also
drives the multi-particle train of eqs. (7)-(9), which the paper derives and does not run. The
paper's profile is lost: its speed, distance and time fix a trapezoid, with 300 s each of gaining
and losing speed chosen here.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from estimators.rls import RecursiveLeastSquares, edges_crossed, periods_elapsed
from trainlog.arrays import FloatArray
from trainlog.declaration import NotNegative, Positive, check
from trainlog.formats.railway import read_consist
from trainlog.formats.samples import sample
from trainlog.railway import Line, RunningResistance, Station, StepProfile
from trainlog.railway.train import Consist
from trainlog.simulation.consist import ConsistPlant, Variation
from trainlog.units import GRAVITY

PERIOD = 0.1
"""Of sampling and control, tau [s]."""

STEP = 0.01
"""Of the integration [s]."""

MASS = 350e3
"""Of the train [kg]."""

EFFORT_LIMIT = 250e3
"""Saturation of the control signal [N]."""

TOP_SPEED, DISTANCE, DURATION, RAMP = 83.0, 74_700.0, 1_200.0, 300.0
"""Of the desired profile [m/s], [m], [s], and how long it gains and loses speed [s]."""

EDGES = np.array([0.0, 5e3, 10e3, 25e3, 42e3, 50e3, 62e3, 70e3])
SLOPES = np.array([-10.0, 9.0, -8.0, -7.0, 20.0, -14.0, 2.0, 15.0]) / 1e3
"""Table 1, in per mille as corrected: where each slope begins [m], and its rise over run."""

RESISTANCE = RunningResistance(2_090.0, 39.0, 0.675)
VARIATION = Variation((0.2 / 2.09, 0.004 / 0.039, 0.0000067 / 0.000675), 0.0052)
"""Eq. (35): means, and the swings as printed (the last one is 1 per cent)."""

CURVE, TUNNEL = 0.6, 1.3e-7
"""Eq. (6): k_C [m], and the tunnel's term over the weight [1/m], which the printed one lacks."""

PRIOR_STD = 1e3 * np.sqrt([100.0, 0.01, 0.001])
"""Eq. (36): square roots of the diagonal of p_0, with forces in N instead of kN."""

SAMPLE_VARIANCE = 1e6
"""One, with forces in N² instead of kN²."""

TIME_RESET = 30.0
"""Between two resets by time [s]."""

SPEED_NOISE = 0.03
"""Standard deviation of the measured speed [m/s] where it is not exact."""

Reset = Literal["never", "time", "space", "space, constant term"]


@dataclass(frozen=True, slots=True)
class Target:
    """Where the train ought to be: position [m], speed [m/s] and acceleration [m/s²]."""

    position: float
    speed: float
    acceleration: float


@dataclass(frozen=True, slots=True)
class SlidingModeController:
    """Control law (34): the estimated resistance is fed forward, the rest is drawn to s = 0.

    Attributes
    ----------
    mass : float [kg]
        That the controller assumes.
    convergence : float [1/s]
        lambda of eq. (27): on the sliding surface a position error decays at this rate.
    switching_effort : float [N]
        rho of eq. (32).
    boundary_layer : float [m/s]
        delta of eq. (33): within it the switching is linear, so that it does not chatter.
    effort_limit : float [N]
        The effort is kept between minus and plus this.
    """

    mass: Positive
    convergence: Positive = 0.5
    switching_effort: NotNegative = 180e3
    boundary_layer: Positive = 5.0
    effort_limit: Positive = 250e3

    def __post_init__(self) -> None:
        check(self)

    def effort(self, position: float, speed: float, target: Target, resistance: float) -> float:
        """The effort [N], positive traction and negative braking.

        Parameters
        ----------
        position, speed : float [m], [m/s]
            As measured.
        target : Target
        resistance : float [N]
            Running resistance and additional resistance together, as estimated.
        """
        error = position - target.position  # (26)
        error_rate = speed - target.speed
        surface = error_rate + self.convergence * error  # (27)
        switching = max(-1.0, min(1.0, surface / self.boundary_layer))  # (33)
        wanted = (
            self.mass * (target.acceleration - self.convergence * error_rate)  # (30)
            + resistance
            - self.switching_effort * switching  # (32)
        )
        return max(-self.effort_limit, min(self.effort_limit, wanted))


@dataclass(frozen=True)
class Variant:
    """One way to learn.

    Attributes
    ----------
    name : str
    parameters : {1, 3}
        The sum of all resistances, eq. (25); or a0 + f2, a1 and a2, eq. (24).
    forgetting : float
    reset : str
        When the covariance returns to p_0: never, every 30 s, where the slope changes, or there
        for the constant term alone, so that what was learnt about a1 and a2 stays.
    published : tuple of float or None
        Largest errors of position [m] and speed [m/s], and the error at the stop [m], where the
        paper states them.
    """

    name: str
    parameters: int
    forgetting: float
    reset: Reset
    published: tuple[float | None, float | None, float | None] = (None, None, None)


VARIANTS = (
    Variant("scalar", 1, 0.95, "never", (0.82, 0.22, 0.002)),
    Variant("spatial reset", 3, 1.0, "space", (0.12, 0.04, None)),
    Variant("time reset", 3, 1.0, "time", (1.0, None, None)),
    Variant("partial reset", 3, 1.0, "space, constant term"),
)
"""The three of the paper, and one whose reset is partial."""


@dataclass(frozen=True, eq=False)
class Run:
    """One simulated trip; (n,) arrays with one value a sample unless said otherwise.

    Attributes
    ----------
    variant : Variant
    train : Consist
    noise : float [m/s]
        Standard deviation of the measured speed.
    track : Line
    time, position, speed : [s], [m], [m/s]
        True motion, of a consist's front.
    measured_speed : [m/s]
    target_position, target_speed : [m], [m/s]
    effort : [N]
        At work until the next sample.
    theta : (n, 1) or (n, 3) array
        Estimated parameters in N, N/(m/s) and N/(m/s)².
    theta_std : array of the same shape
    estimate : [N]
        All resistances together, as estimated.
    coupler_forces : (n, couplers) array [N]
        Positive when pulled apart.
    """

    variant: Variant
    train: Consist
    noise: float
    track: Line
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    measured_speed: FloatArray
    target_position: FloatArray
    target_speed: FloatArray
    effort: FloatArray
    theta: FloatArray
    theta_std: FloatArray
    estimate: FloatArray
    coupler_forces: FloatArray

    @property
    def position_error(self) -> FloatArray:
        """Position less the desired one [m], eq. (26)."""
        return self.position - self.target_position

    @property
    def speed_error(self) -> FloatArray:
        """Speed less the desired one [m/s]."""
        return self.speed - self.target_speed

    @property
    def stop_error(self) -> float:
        """Distance from the stop at the end [m]."""
        return float(abs(self.position_error[-1]))

    @property
    def figures(self) -> tuple[float, float, float]:
        """Largest errors of position [m] and speed [m/s], and the error at the stop [m]."""
        return (
            float(np.abs(self.position_error).max()),
            float(np.abs(self.speed_error).max()),
            self.stop_error,
        )

    @cached_property
    def coefficients(self) -> FloatArray:
        """True a0, a1, a2 at each sample, eq. (35); (n, 3) array."""
        swing = np.sin(VARIATION.angular_frequency * self.time)
        return np.asarray(RESISTANCE.coefficients * (1.0 + np.outer(swing, VARIATION.amplitudes)))

    @cached_property
    def slope_force(self) -> FloatArray:
        """True f2 [N]: the slope under the train, eq. (6), from its front to its rear."""
        slopes = self.track.gradients
        sine = slopes.values / np.hypot(1.0, slopes.values)
        if len(self.train.vehicles) == 1:
            row = np.searchsorted(slopes.positions, self.position, side="right") - 1
            return np.asarray(MASS * GRAVITY * sine[row])
        # Before its first and beyond its last edge the line goes on as there.
        edges = np.concatenate(([-self.train.length], slopes.positions[1:], [2.0 * DISTANCE]))
        height = np.concatenate(([0.0], np.cumsum(sine * np.diff(edges))))
        ends = (self.position, self.position - self.train.length)
        front, rear = (np.interp(end, edges, height) for end in ends)
        return np.asarray(MASS * GRAVITY * (front - rear) / self.train.length)

    @property
    def resistance(self) -> FloatArray:
        """True sum of all resistances [N]."""
        a0, a1, a2 = self.coefficients.T
        return np.asarray(a0 + (a1 + a2 * self.speed) * self.speed + self.slope_force)


def target(time: float) -> Target:
    """The desired motion at `time` [s]."""
    rate = TOP_SPEED / RAMP
    if time < RAMP:
        return Target(0.5 * rate * time**2, rate * time, rate)
    if time < DURATION - RAMP:
        return Target(0.5 * rate * RAMP**2 + TOP_SPEED * (time - RAMP), TOP_SPEED, 0.0)
    left = max(DURATION - time, 0.0)
    return Target(DISTANCE - 0.5 * rate * left**2, rate * left, -rate if left > 0.0 else 0.0)


def additional_resistance(
    mass: float, sine: ArrayLike, *, radius: float = np.inf, tunnel: float = 0.0
) -> FloatArray:
    """Eq. (6), f_2 [N]: gradient, curve and tunnel.

    Parameters
    ----------
    mass : float [kg]
    sine : array_like
        Of the gradient's angle.
    radius, tunnel : float [m]
        L_C of the curve, L_TU of the tunnel that the train is in.

    Examples
    --------
    >>> additional_resistance(350e3, 0.0, radius=400.0, tunnel=3_000.0).round(1)
    np.float64(6489.3)
    """
    return np.asarray(mass * GRAVITY * (np.asarray(sine) + CURVE / radius + TUNNEL * tunnel))


def line(shift: float = 0.0, *, curved_tunnel: bool = False) -> Line:
    """The line of Table 1.

    Parameters
    ----------
    shift : float [m]
        By which all slopes but the first begin later.
    curved_tunnel : bool
        Adds a curve of 400 m in a tunnel of 3 km, which the paper's simulation does not have; by
        eq. (6) both act like a gradient.
    """
    gradients = StepProfile(np.where(EDGES > 0.0, EDGES + shift, 0.0), SLOPES)
    if curved_tunnel:
        inside = additional_resistance(1.0, SLOPES[3], radius=400.0, tunnel=3_000.0) / GRAVITY
        edges = np.insert(gradients.positions, 4, [30e3, 33e3])
        gradients = StepProfile(edges, np.insert(SLOPES, 4, [inside, SLOPES[3]]))
    return Line(
        name="Table 1 of Amirhosseini et al. (2024)",
        length=75_000.0,
        stations=(Station("start", 0.0), Station("stop", DISTANCE)),
        speed_limits=StepProfile(np.zeros(1), np.array([TOP_SPEED + 1.0])),
        gradients=gradients,
        source="Amirhosseini et al. (2024), Table 1, read in per mille",
    )


def consist() -> Consist:
    """The paper's train as a single particle: a point, so that slopes begin at once."""
    return read_consist(sample("amirhosseini_2024.consist.json"))


def eight_wagons(*, first_pulls: bool = False, softening: bool = False) -> Consist:
    """The paper's train in eight wagons of 43.75 t, eqs. (2)-(9).

    Parameters
    ----------
    first_pulls : bool
        Whether the first wagon gives all the traction, as a locomotive does; else each an eighth.
    softening : bool
        Whether epsilon of eq. (4) is negative, which the paper calls the worst case.
    """
    train = read_consist(sample("amirhosseini_2024_8_wagons.consist.json"))
    if softening:
        couplers = tuple(replace(each, nonlinearity=-each.nonlinearity) for each in train.couplers)
        train = replace(train, name=f"{train.name}, softening", couplers=couplers)
    if not first_pulls:
        return train
    locomotive, wagon = (
        replace(train.vehicles[0], max_tractive_effort=effort) for effort in (EFFORT_LIMIT, 0.0)
    )
    return replace(
        train, name=f"{train.name}, the first pulls", vehicles=(locomotive, *(wagon,) * 7)
    )


def run(
    variant: Variant,
    *,
    noise: float = 0.0,
    track: Line | None = None,
    seed: int = 1,
    train: Consist | None = None,
) -> Run:
    """Drive the profile once.

    Parameters
    ----------
    variant : Variant
    noise : float [m/s]
        Standard deviation of the measured speed that estimator and controller see.
    track : Line, optional
        Default: that of Table 1.
    seed : int
        Of the noise.
    train : Consist, optional
        Default: the single particle. Of a consist, position and speed of the front are controlled.
    """
    random = np.random.default_rng(seed)
    slopes = track or line()
    plant = ConsistPlant(train or consist(), slopes, variation=VARIATION, step=STEP)
    # A point is where its middle is, a consist where its front is.
    lead = float(plant.consist.middles[0])
    point = len(plant.consist.vehicles) == 1
    state = plant.at(lead if point else 0.0)
    learner = RecursiveLeastSquares(PRIOR_STD[: variant.parameters], forgetting=variant.forgetting)
    controller = SlidingModeController(MASS, effort_limit=EFFORT_LIMIT)
    count = round(DURATION / PERIOD) + 1
    errors = noise * random.standard_normal(count)
    rows = np.empty((count, 7))
    theta = np.empty((count, variant.parameters))
    spread = np.empty_like(theta)
    forces = np.empty((count, len(plant.consist.couplers)))
    theta[0], spread[0] = 0.0, PRIOR_STD[: variant.parameters]
    effort, before = 0.0, 0.0
    for k in range(count):
        now = k * PERIOD
        position, speed = float(state.positions[0]), float(state.speeds[0])
        position += 0.0 if point else lead
        forces[k] = plant.coupler_forces(state)
        measured = speed + errors[k]
        if k:
            # While an edge passes under a train, its slope keeps changing.
            since = rows[k - 1, 0] if point else max(position - plant.consist.length, 0.0)
            _reset(learner, variant, now, slopes.gradients.positions, (since, position))
            # (22): the rate of change of speed less the effort that was at work.
            output = MASS / PERIOD * (measured - before) - effort
            found, covariance = learner.record(_regressor(variant, before), output, SAMPLE_VARIANCE)
            theta[k], spread[k] = found[0], np.sqrt(np.diag(covariance[0]))
        estimate = -float(theta[k] @ _regressor(variant, measured))
        wanted = target(now)
        effort = controller.effort(position, measured, wanted, estimate)
        rows[k] = position, speed, measured, wanted.position, wanted.speed, effort, estimate
        before = measured
        plant.advance(state, max(effort, 0.0), max(-effort, 0.0), round(PERIOD / STEP))
    return Run(
        variant=variant,
        train=plant.consist,
        noise=noise,
        track=slopes,
        time=PERIOD * np.arange(count, dtype=np.float64),
        position=rows[:, 0],
        speed=rows[:, 1],
        measured_speed=rows[:, 2],
        target_position=rows[:, 3],
        target_speed=rows[:, 4],
        effort=rows[:, 5],
        theta=theta,
        theta_std=spread,
        estimate=rows[:, 6],
        coupler_forces=forces,
    )


def edge_shifts(count: int) -> FloatArray:
    """Shifts of the slopes [m] that vary the instant of their change over one sample."""
    return np.arange(count) / count * TOP_SPEED * PERIOD


def worst(runs: Sequence[Run]) -> tuple[float, float, float]:
    """The largest of each figure over several runs."""
    figures = np.array([each.figures for each in runs]).max(axis=0)
    return float(figures[0]), float(figures[1]), float(figures[2])


def _regressor(variant: Variant, speed: float) -> FloatArray:
    """(23), or -1 alone for (25)."""
    return -np.array([1.0, speed, speed**2])[: variant.parameters]


def _reset(
    learner: RecursiveLeastSquares,
    variant: Variant,
    now: float,
    edges: FloatArray,
    moved: tuple[float, float],
) -> None:
    """Reset as the variant does, `now` [s], having moved from a position to another [m]."""
    if variant.reset == "time":
        due = periods_elapsed(TIME_RESET, now, now - PERIOD)[0]
    else:
        due = variant.reset != "never" and edges_crossed(edges, moved[1], moved[0])[0]
    if due:
        learner.reset([0] if variant.reset == "space, constant term" else None)
