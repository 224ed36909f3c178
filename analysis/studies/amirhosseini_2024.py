"""Amirhosseini et al. (2024), section 5: a train learns its resistance while it follows a profile.

The plant is the single-particle train of eq. (10), integrated continuously between the samples;
the estimators are those of eqs. (22)-(25), the controller is that of eq. (34). The same system also
drives the multi-particle train of eqs. (7)-(9), which the paper derives and does not run. The
paper's profile is lost: its speed, distance and time fix a trapezoid, with 300 s each of gaining
and losing speed chosen here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from analysis.charts import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Chart, Curve, Panel
from analysis.studies.report import StudyReport, study_trip
from estimators.regression import RecursiveLeastSquares, edges_crossed, periods_elapsed
from trainlog.arrays import FloatArray, IntArray
from trainlog.declaration import NotNegative, Positive, check
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.railway import read_consist
from trainlog.formats.samples import sample
from trainlog.presentation import Columns, WordTable, new_table, word_table
from trainlog.railway import Line, RunningResistance, Station, StepProfile
from trainlog.railway.resistance import TERMS
from trainlog.railway.train import Consist
from trainlog.simulation.consist import ConsistPlant, Variation
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_RESISTANCE,
    REFERENCE,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_STATE,
    TRUTH,
    Topic,
)
from trainlog.trip import Trip
from trainlog.units import GRAVITY, KMH

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


# ---------------------------------------------------------- its runs, as logs, pictures and tables

Figures = tuple[float | None, float | None, float | None]

SETTLED = 200.0
"""After which the coefficients are judged [s]."""


def errors_table(
    exact: Mapping[str, Run],
    measured: Mapping[str, Run],
    shifted: Mapping[str, Sequence[Run]],
) -> WordTable:
    """Largest errors of Amirhosseini et al. (2024): published, reached, and with measured speed.

    Parameters
    ----------
    exact, measured : mapping of str to Run
        By name of the variant.
    shifted : mapping of str to sequence of Run
        Runs with the slopes shifted within one sample, of which the worst is stated.
    """
    of: Columns[tuple[str, Run]] = {
        "estimator": lambda row: row[0],
        "published": lambda row: _published(row[1].variant.published),
        "reached": lambda row: _shown(row[1].figures),
        "slopes shifted within a sample": lambda row: (
            _shown(worst(shifted[row[0]])) if shifted.get(row[0]) else ""
        ),
        "speed measured": lambda row: _shown(measured[row[0]].figures),
    }
    title = "Largest errors of position (m) and speed (m/s), error at the stop (m)"
    return word_table(title, exact.items(), of)


def coefficients_table(exact: Mapping[str, Run], measured: Mapping[str, Run]) -> WordTable:
    """How far the single coefficients are from the true ones, beside figure 6 of the paper.

    The error of an estimate is the median of its amount after the first `SETTLED` seconds, as a
    share of the mean true value: after each reset it is far greater for a while.

    Parameters
    ----------
    exact, measured : mapping of str to Run
        By name of the variant; those that estimate three coefficients are listed.
    """
    title = f"Estimated coefficients after {SETTLED:g} s: median error over the mean true value (%)"
    names = ("a0 + f2", "a1", "a2", "their sum")
    table = new_table(title, "estimator", "speed", *names)
    for speed, runs in (("exact", exact), ("measured", measured)):
        for name, run in runs.items():
            if run.variant.parameters == 3:
                errors = coefficient_errors(run)
                table.add_row(name, speed, *(f"{100.0 * error:.1f}" for error in errors))
    return table


def coefficient_errors(run: Run) -> FloatArray:
    """Relative median errors of a0 + f2, a1, a2 and of the sum of all resistances; (4,) array."""
    true = np.column_stack([run.coefficients, run.resistance])
    true[:, 0] += run.slope_force
    late = run.time > SETTLED
    error = np.column_stack([run.theta, run.estimate])[late] - true[late]
    mean = np.abs(true[late]).mean(axis=0)
    return np.asarray(np.median(np.abs(error), axis=0) / mean)


def eight_wagons_table(exact: Mapping[str, Run], coupled: Sequence[Run]) -> WordTable:
    """The multi-particle train under the paper's control, beside the single particle.

    Parameters
    ----------
    exact : mapping of str to Run
        Of the single particle, by name of the variant.
    coupled : sequence of Run
        Of the eight wagons.
    """
    of: Columns[Run] = {
        "estimator": lambda run: run.variant.name,
        "traction": lambda run: (
            (
                "first wagon"
                if any(vehicle.max_tractive_effort == 0.0 for vehicle in run.train.vehicles)
                else "every wagon"
            )
            + (", ε below 0" if run.train.couplers[0].nonlinearity < 0.0 else "")
        ),
        "one particle": lambda run: _shown(exact[run.variant.name].figures),
        "eight wagons": lambda run: _shown(run.figures),
        "largest draft / buff": lambda run: (
            f"{run.coupler_forces.max() / 1e3:.1f} / {-run.coupler_forces.min() / 1e3:.1f}"
        ),
    }
    title = "Eight wagons, eqs. (2)-(9): the same errors, and the couplers' forces (kN)"
    return word_table(title, coupled, of)


def claims_table(exact: Mapping[str, Run], obstructed: Run) -> WordTable:
    """What section 5 states in words of figures 9, 10, 13 and 14, and eq. (6) with all its terms.

    Parameters
    ----------
    exact : mapping of str to Run
        By name of the variant.
    obstructed : Run
        The scalar variant on a line with a curve in a tunnel.
    """
    scalar, spatial = exact["scalar"], exact["spatial reset"]
    off, steps = np.abs(scalar.estimate - scalar.resistance), np.diff(scalar.slope_force)
    worst, most = int(np.argmax(off)), int(np.argmax(np.abs(steps)))
    jumps, sways = (
        [figure(run) / 1e3 for run in (scalar, spatial)]
        for figure in (lambda run: np.abs(np.diff(run.effort)).max(), effort_sway)
    )
    table = new_table("Statements of section 5 of the paper", "statement", "published", "reached")
    for row in (
        ("scalar: settled after an edge, at most [s]", "30", f"{settling(scalar):.1f}"),
        (
            "scalar: largest error of the estimate [kN] at km",
            "at the largest disturbance",
            f"{off[worst] / 1e3:.1f} at {scalar.position[worst] / 1e3:.2f};"
            f" {abs(steps[most]) / 1e3:.1f} at {scalar.position[most] / 1e3:.2f}",
        ),
        (
            "largest jump of the effort, scalar / spatial reset [kN]",
            "less with the scalar",
            f"{jumps[0]:.1f} / {jumps[1]:.1f}",
        ),
        (
            "sway of the effort in the 30 s after each edge, the same [kN]",
            "more with the scalar",
            f"{sways[0]:.1f} / {sways[1]:.1f}",
        ),
        (
            "largest effort, the same [kN]",
            "within 250",
            f"{np.abs(scalar.effort).max() / 1e3:.1f} / {np.abs(spatial.effort).max() / 1e3:.1f}",
        ),
        (
            "eq. (6), curve of 400 m in 3 km of tunnel: errors",
            "not run",
            _shown(obstructed.figures),
        ),
    ):
        table.add_row(*row)
    return table


def _edges(run: Run) -> IntArray:
    """Samples after which the slope has changed."""
    return np.flatnonzero(np.abs(np.diff(run.slope_force)) > 1e3) + 1


def settling(run: Run, within: float = 100.0) -> float:
    """Longest time after an edge until the estimate stays within so many newtons [s]."""
    off = np.abs(run.estimate - run.resistance)
    off[run.speed < 0.05] = 0.0  # at standstill nothing resists
    parts = np.split(off > within, _edges(run))
    return PERIOD * max(int(np.flatnonzero(part).max(initial=-1)) + 1 for part in parts)


def effort_sway(run: Run, span: float = 30.0) -> float:
    """Up and down of the effort beyond its change, in a time [s] after each edge; the sum [N]."""
    rows = [run.effort[edge : edge + round(span / PERIOD) + 1] for edge in _edges(run) - 1]
    return float(sum(np.abs(np.diff(row)).sum() - abs(row[-1] - row[0]) for row in rows))


def _published(figures: Figures) -> str:
    if figures == (None, None, None):
        return "not tried"
    if figures[1:] == (None, None):
        return f"more than {figures[0]:g}"
    return _shown(figures)


def _shown(figures: Figures) -> str:
    digits = (2, 3, 4)
    return " / ".join(
        "–" if value is None else f"{value:.{count}f}"
        for value, count in zip(figures, digits, strict=True)
    )


COLOURS = dict(zip((v.name for v in VARIANTS), (GREEN, BLUE, RED, ORANGE), strict=True))
"""Of the variants."""

SECONDS = "time [s]"


def study_charts(runs: Mapping[str, Run]) -> dict[str, list[Chart]]:
    """The paper's figures by the names of their files.

    Parameters
    ----------
    runs : mapping of str to Run
        With exact speed, by name of the variant.
    """
    timed, spatial = runs["time reset"], runs["spatial reset"]
    return {
        "figures-01-03-profile.png": _profile(spatial),
        "figures-04-05-time-reset.png": _learning(timed, "Figs. 4 and 5"),
        "figures-06-09-spatial-reset.png": _learning(spatial, "Figs. 6 to 9"),
        "figures-10-14-scalar.png": _scalar(runs["scalar"]),
    }


def _profile(run: Run) -> list[Chart]:
    """Figs. 1-3: speed over position and over time, force of the slopes."""
    desired, slopes = KMH * run.target_speed, run.slope_force / 1e3
    over_km = Curve("", run.target_position / 1e3, desired)
    return [
        Chart("km", [Panel("km/h", [over_km], title="Fig. 1  Desired speed over position")]),
        Chart(
            SECONDS,
            [
                Panel("km/h", [Curve("", run.time, desired)], 1.0, "Fig. 2  The same over time"),
                Panel("kN", [Curve("", run.time, slopes, RED, "step")], 1.0,
                      "Fig. 3  Force of the slopes, f2"),
            ],
        ),
    ]  # fmt: skip


def _estimate(run: Run, truth: FloatArray, found: FloatArray, unit: str, title: str) -> Panel:
    """An estimate beside the truth; one that has not settled would hide the rest."""
    curves = [
        Curve("true", run.time, truth, GREY, width=2.5),
        Curve("estimated", run.time, found, width=1.0),
    ]
    settled = np.concatenate([truth, found[found.size // 6 :]])
    margin = 0.1 * max(float(np.ptp(settled)), 1e-9)
    limits = (float(settled.min()) - margin, float(settled.max()) + margin)
    return Panel(unit, curves, title=title, limits=limits)


def _learning(run: Run, title: str) -> list[Chart]:
    """Estimates of a0 + f2, a1, a2; errors of position and speed; the control signal."""
    true = [run.coefficients[:, 0] + run.slope_force, *run.coefficients.T[1:]]
    named = ((1e3, "kN", "a0 + f2"), (1.0, "N/(m/s)", "a1"), (1.0, "N/(m/s)²", "a2"))
    panels = [
        _estimate(run, truth / scale, found / scale, unit, f"Estimate of {name}")
        for truth, found, (scale, unit, name) in zip(true, run.theta.T, named, strict=False)
    ]
    return [Chart(SECONDS, [*panels, *_errors(run)], title=title)]


def _scalar(run: Run) -> list[Chart]:
    """Figs. 10-14: the sum of all resistances, errors, control, error of the estimate."""
    off = Curve("", run.time, (run.estimate - run.resistance) / 1e3, PURPLE, width=0.8)
    panels = [
        _estimate(run, run.resistance / 1e3, run.estimate / 1e3, "kN", "All resistances together"),
        *_errors(run),
        Panel("kN", [off], title="Error of the estimate"),
    ]
    return [Chart(SECONDS, panels, title="Figs. 10 to 14")]


def _errors(run: Run) -> list[Panel]:
    colour = COLOURS[run.variant.name]
    return [
        Panel(unit, [Curve("", run.time, values, colour, width=0.9)], title=title)
        for values, unit, title in (
            (run.position_error, "m", "Position error"),
            (run.speed_error, "m/s", "Speed error"),
            (run.effort / 1e3, "kN", "Control signal"),
        )
    ]


SHIFTS = 5
"""Positions of the slopes within one sample."""


def main(report: StudyReport, seed: int) -> None:
    """Run every estimator with exact and with measured speed, shifted slopes, and eight wagons."""
    scalar, spatial = VARIANTS[:2]
    tracks = [line(float(shift)) for shift in edge_shifts(SHIFTS)[1:]]
    plans = [
        *((variant, 0.0, None) for variant in VARIANTS),
        *((variant, SPEED_NOISE, None) for variant in VARIANTS),
        *((spatial, 0.0, track) for track in tracks),
        (scalar, 0.0, line(curved_tunnel=True)),
    ]
    runs = [
        run(variant, noise=noise, track=track, seed=seed)
        for variant, noise, track in report.track(plans, "driving")
    ]
    count = len(VARIANTS)
    exact = {run.variant.name: run for run in runs[:count]}
    measured = {run.variant.name: run for run in runs[count : 2 * count]}
    trains = [eight_wagons(), eight_wagons(first_pulls=True)]
    softening = eight_wagons(first_pulls=True, softening=True)
    coupled = [
        run(variant, train=train, seed=seed)
        for variant, train in report.track(
            [*((variant, each) for variant in (scalar, spatial) for each in trains),
             (scalar, softening)],
            "driving eight wagons",
        )
    ]  # fmt: skip
    for each in (*runs[: 2 * count], *coupled):
        report.log(trip_of(each, seed))
    report.draw(study_charts(exact))
    shifted = [exact[spatial.name], *runs[2 * count : -1]]
    report.show(
        errors_table(exact, measured, {spatial.name: shifted}),
        claims_table(exact, runs[-1]),
        coefficients_table(exact, measured),
        eight_wagons_table(exact, coupled),
    )


def trip_of(run: Run, seed: int) -> Trip:
    """The log of one run.

    In ``/estimates/running_resistance`` ``r0`` is the estimate of a0 + f2, the slope included, as
    eq. (24) has it; the scalar variant knows only the sum, which stands in ``resistance``.
    """
    slopes = run.track
    estimates = {"resistance": run.estimate}
    if run.variant.parameters == 3:
        estimates |= dict(zip(TERMS, run.theta.T, strict=True))
    else:
        estimates["resistance_std"] = run.theta_std[:, 0]
    traction, braking = np.maximum(run.effort, 0.0), np.maximum(-run.effort, 0.0)
    running = run.resistance - run.slope_force
    targets = [target(now) for now in run.time]
    needed = MASS * np.array([each.acceleration for each in targets]) + run.resistance
    topics: dict[Topic, dict[str, ArrayLike]] = {
        TRAIN_STATE: {"position": run.position, "speed": run.measured_speed},
        TRAIN_CONTROLS: {
            "tractive_effort_demand": traction,
            "braking_effort_demand": braking,
            "tractive_effort": traction,
            "dynamic_braking_effort": braking,
            "pneumatic_braking_effort": 0.0,
        },
        ENVIRONMENT: {
            "gradient": slopes.gradient(run.position),
            "speed_limit": slopes.speed_limit(run.position),
        },
        ESTIMATED_RESISTANCE: {**estimates, "mass": MASS},
        REFERENCE: {
            "speed": run.target_speed,
            "tractive_effort": np.maximum(needed, 0.0),
            "braking_effort": np.maximum(-needed, 0.0),
        },
        TRUTH: {"position": run.position, "speed": run.speed, "running_resistance": running},
    }
    if run.train.couplers:
        topics[TRAIN_COUPLERS] = {"force": run.coupler_forces}
    return study_trip(
        name_of(run),
        run.train.name,
        slopes,
        run.time,
        topics,
        (
            "study rls-sliding-mode",
            {"seed": seed, "variant": run.variant.name, "speed_noise": run.noise},
        ),
        attachments={"consist.json": thing_to_bytes(run.train)},
        metadata={"seed": str(seed), "study": "Amirhosseini et al. (2024), section 5"},
    )


def name_of(run: Run) -> str:
    """Name of a run: its variant, whether its train has couplers, and whether speed is measured."""
    name = run.variant.name.replace(" ", "-")
    if run.train.couplers:
        alone = any(each.max_tractive_effort == 0.0 for each in run.train.vehicles)
        name += "-8-wagons-first-pulls" if alone else "-8-wagons"
        name += "-softening" if run.train.couplers[0].nonlinearity < 0.0 else ""
    return f"{name}-measured" if run.noise else name
