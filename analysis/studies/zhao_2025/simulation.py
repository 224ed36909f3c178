"""Zhao et al. (2025), section 4: four motors share the torque while the rail under them changes.

Two presets: the paper's table 2, read literally (which is physically odd: its axles have three
times the inertia of what rests on them), and a locomotive of 85 t with a train of 400 t. Two
plants: one explicit Euler step of 0.1 s, as eq. (15) has it, and Runge-Kutta.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from analysis.control.cooperative import (
    CooperativeController,
    Demand,
    Tuning,
    adhesion_at,
    peak_slips,
)
from analysis.control.multi_motor import MultiMotorLocomotive, creep
from analysis.control.rail_estimate import RailEstimator
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway import RunningResistance, StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve, creep_coefficients

Integration = Literal["euler", "runge-kutta"]

DURATION = 30.0
"""Of a run [s]."""

STEP = 0.002
"""Of the Runge-Kutta integration [s]."""

SAMPLE = 0.02
"""Between two recorded samples of it [s]."""

WET_SPAN, RESTORED = (10.0, 20.0), 25.0
"""When the rail is wet, and when the failed motor of case 4 is back [s]."""

AXLES = np.array([2.9, 5.5, 12.8, 15.4])
"""How far the axles are behind the train's front [m]."""

GRAVITY = 9.8
"""As the paper's table 2 has it [m/s²]."""

PUBLISHED_LOCOMOTIVE = MultiMotorLocomotive(
    name="Zhao et al. (2025), table 2 read literally",
    mass=14_167.0,
    axle_loads=(14_167.0 / 4.0 * GRAVITY,) * 4,
    inertia=146.7,
    gear_ratio=4.13,
    wheel_radius=0.5,
    resistance=RunningResistance(1_800.0, 12.0, 0.4),
    torque_limit=5_000.0,
    total_torque=16_500.0,
)
"""Resistance is chosen here, the paper does not state it."""

LOCOMOTIVE_85_T = MultiMotorLocomotive(
    name="locomotive of 85 t with a train of 400 t",
    mass=485_000.0,
    axle_loads=(21_250.0 * GRAVITY,) * 4,
    inertia=44.0,
    gear_ratio=4.13,
    wheel_radius=0.5,
    resistance=RunningResistance(6_000.0, 50.0, 9.0),
    torque_limit=8_500.0,
    total_torque=28_000.0,
)
"""Gear and wheels of the paper; 3 t of rotating mass an axle; torques in the paper's proportions to
what a dry rail bears."""


def coefficients(curves: Sequence[CreepCurve]) -> FloatArray:
    """a, b and c of the creep curves under the axles, (n, 3)."""
    return np.array([(each.a, each.b, each.c) for each in curves], dtype=np.float64)


@njit(cache=True)
def rates(state, torque, rail, loads, constants, out):  # type: ignore[no-untyped-def]
    """Rates of change of the state [m/s²]; eqs. (1), (3) and (8). A train at rest stays there."""
    mass, rotating, ratio, still, linear, square = constants
    v = state[0]
    pull = 0.0
    for i in range(loads.size):
        force = loads[i] * creep(state[1 + i] - v, rail[i])[0]
        pull += force
        out[1 + i] = (ratio * torque[i] - force) / rotating
    out[0] = (pull - still - (linear + square * v) * v) / mass
    if v <= 0.0 and out[0] < 0.0:
        out[0] = 0.0


@njit(cache=True)
def euler(state, torque, rail, loads, constants, step, steps):  # type: ignore[no-untyped-def]
    """Explicit Euler steps, in place; eq. (15)."""
    rate = np.empty(state.size)
    for _ in range(steps):
        rates(state, torque, rail, loads, constants, rate)
        state += step * rate
        state[0] = max(state[0], 0.0)


@njit(cache=True)
def runge_kutta(state, torque, rail, loads, constants, step, steps):  # type: ignore[no-untyped-def]
    """Classical Runge-Kutta steps of fourth order, in place."""
    size = state.size
    k1, k2, k3, k4 = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for _ in range(steps):
        rates(state, torque, rail, loads, constants, k1)
        rates(state + 0.5 * step * k1, torque, rail, loads, constants, k2)
        rates(state + 0.5 * step * k2, torque, rail, loads, constants, k3)
        rates(state + step * k3, torque, rail, loads, constants, k4)
        state += step / 6.0 * (k1 + 2.0 * k2 + 2.0 * k3 + k4)
        state[0] = max(state[0], 0.0)


@dataclass(frozen=True)
class Preset:
    """A locomotive, how it is controlled, and what a failed motor of it still gives [N m]."""

    key: str
    locomotive: MultiMotorLocomotive
    tuning: Tuning
    failed: float


PAPER = Preset("paper", PUBLISHED_LOCOMOTIVE, Tuning(substeps=1, exact=False), 2_000.0)
SENSIBLE = Preset("85-t", LOCOMOTIVE_85_T, Tuning(), 3_400.0)
PRESETS = (PAPER, SENSIBLE)


@dataclass(frozen=True)
class Case:
    """One of the paper's cases.

    Attributes
    ----------
    number : int
    name : str
    wet : tuple of int
        Axles (from 1) that run on a wet rail from 10 s to 20 s.
    fails : bool
        Whether the motor of axle 4 fails at 10 s and is back at 25 s.
    published : str
        What the paper states.
    wet_curve : CreepCurve
        Of the wet rail.
    places : StepProfile, optional
        Maximum adhesion by chainage, of a rail that changes with the place instead of with time.
    """

    number: int
    name: str
    wet: tuple[int, ...]
    fails: bool
    published: str
    wet_curve: CreepCurve = WET
    places: StepProfile | None = None

    def rail(self, time: float, position: float = 0.0) -> FloatArray:
        """Creep curves under the four axles, (4, 3).

        Parameters
        ----------
        time : float [s]
        position : float [m]
            Of the train's front.
        """
        if self.places is not None:
            return creep_coefficients(self.places(np.maximum(position - AXLES, 0.0)))
        wet = self.wet if WET_SPAN[0] <= time < WET_SPAN[1] else ()
        return coefficients([self.wet_curve if axle in wet else DRY for axle in range(1, 5)])

    def limits(self, time: float, preset: Preset) -> FloatArray:
        """The most that each motor gives, (4,) [N m]."""
        limits = np.full(4, preset.locomotive.torque_limit)
        if self.fails and WET_SPAN[0] <= time < RESTORED:
            limits[3] = preset.failed
        return limits


CASES = (
    Case(
        1, "all axles dry, wet, dry", (1, 2, 3, 4), fails=False,
        published="T from 1500 to about 4200, mu about 0.27; wet T 2200, mu about 0.14",
    ),
    Case(
        2, "axle 4 dry, wet, dry", (4,), fails=False,
        published="T of axle 4 falls, T of axles 1 to 3 rises",
    ),
    Case(
        3, "axles 3 and 4 dry, wet, dry", (3, 4), fails=False,
        published="T of axles 3 and 4 falls, the speed grows visibly less",
    ),
    Case(
        4, "all axles dry, wet, dry; motor 4 fails", (1, 2, 3, 4), fails=True,
        published="wet: hardly a difference between the axles; dry: 1 to 3 more, 4 less; then even",
    ),
)  # fmt: skip


SCARCE = 20_000.0
"""Total torque [N m] at which sharing it matters: less than its share is what a wet axle bears."""


@dataclass(frozen=True)
class Noise:
    """Of what the controller sees: standard deviations of train and wheel speeds [m/s]."""

    speed: float = 0.0
    wheel_speed: float = 0.0


@dataclass(frozen=True, eq=False)
class Measurement:
    """What a controller sees at a sample.

    Attributes
    ----------
    time, position, speed : float [s], [m], [m/s]
    wheel_speeds : (4,) array [m/s]
    torques : (4,) array [N m]
        At work since the last sample.
    """

    time: float
    position: float
    speed: float
    wheel_speeds: FloatArray
    torques: FloatArray


@dataclass(frozen=True, eq=False)
class AssumedRail:
    """What a controller takes the rail for.

    Attributes
    ----------
    rail : (4, 3) or (horizon, 4, 3) array
        Creep curves under the axles.
    maximum : (4,) array
        Maximum adhesion now.
    reference : (4,) array [m/s], optional
        Slip speeds to be sought; default: those of the curves' maxima.
    """

    rail: FloatArray
    maximum: FloatArray
    reference: FloatArray | None = None


RailSource = Callable[[Measurement], AssumedRail]
"""From where a controller knows the rail at a sample."""


def known_rail(case: Case) -> RailSource:
    """The rail under each axle is known, as in the paper."""

    def rail(measured: Measurement) -> AssumedRail:
        curves = case.rail(measured.time, measured.position)
        return AssumedRail(curves, adhesion_at(peak_slips(curves), curves))

    return rail


STRATEGIES: dict[str, Callable[[Preset], CooperativeController | SlipControl]] = {
    "cooperative": lambda each: CooperativeController(each.locomotive, each.tuning),
    "each axle for itself": lambda each: SlipControl(each.locomotive, each.tuning.period),
    "one torque for all": lambda each: SlipControl(each.locomotive, each.tuning.period, alike=True),
    "no slip control": lambda each: SlipControl(each.locomotive, each.tuning.period, heeds=False),
}
"""The paper's controller, and what there is without it."""


PLANS: tuple[tuple[Case, Preset, Integration], ...] = (
    *((case, PAPER, "euler") for case in CASES),
    *((case, PAPER, "runge-kutta") for case in CASES),
    *((case, SENSIBLE, "runge-kutta") for case in CASES),
)
"""The paper's cases, as they are run."""

FIRST_TORQUE = 1_500.0
"""From which the torques of the paper's case 1 rise [N m]: the assumed u(0) of its eq. (19)."""

COMPARED: tuple[tuple[Case, Preset, float], ...] = (
    *((case, PAPER, PUBLISHED_LOCOMOTIVE.total_torque) for case in CASES),
    *((case, SENSIBLE, LOCOMOTIVE_85_T.total_torque) for case in CASES),
    *((case, SENSIBLE, SCARCE) for case in CASES),
)
"""What is run by every strategy."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run; arrays with one row a sample, and one column an axle.

    Attributes
    ----------
    case : Case
    preset : Preset
    strategy : str
    integration : str
    total : float [N m]
        Asked of all motors together.
    time, position, speed : (m,) arrays [s], [m], [m/s]
    wheel_speed : (m, 4) array [m/s]
    torque : (m, 4) array [N m]
        At work from the sample on.
    reference : (m, 4) array [m/s]
        Slip speeds that the controller sought.
    assumed : (m, 4) array
        What the controller took the maximum adhesion to be.
    adhesion, maximum_adhesion : (m, 4) arrays
        In use, and the most that the rail under the axle gives.
    decisions, unsolved : int
        Samples at which the controller decided, and at which its program was not solved.
    """

    case: Case
    preset: Preset
    strategy: str
    integration: Integration
    total: float
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    wheel_speed: FloatArray
    torque: FloatArray
    reference: FloatArray
    assumed: FloatArray
    adhesion: FloatArray
    maximum_adhesion: FloatArray
    decisions: int = 0
    unsolved: int = 0

    @property
    def slip(self) -> FloatArray:
        """Slip speeds, eq. (11), (m, 4) [m/s]."""
        return np.asarray(self.wheel_speed - self.speed[:, None])

    @property
    def slip_error(self) -> FloatArray:
        """Reference less slip speed, (m, 4) [m/s]."""
        return np.asarray(self.reference - self.slip)

    @cached_property
    def force(self) -> FloatArray:
        """Force between the wheels and the rail, of all axles together, (m,) [N]."""
        return np.asarray(self.adhesion @ self.preset.locomotive.loads)

    @property
    def acceleration(self) -> FloatArray:
        """Of the train, (m,) [m/s²]."""
        resistance = self.preset.locomotive.resistance(self.speed)
        gained = (self.force - resistance) / self.preset.locomotive.mass
        return np.where(self.speed > 0.0, gained, np.maximum(gained, 0.0))

    @property
    def slip_work(self) -> float:
        """Work of creep: what the wheels lose in the contact [J]."""
        power = (self.adhesion * self.preset.locomotive.loads * self.slip).sum(axis=1)
        return float(np.sum(power[:-1] * np.diff(self.time)))

    def mean(self, values: FloatArray, start: float, end: float) -> FloatArray:
        """Mean of (m,) or (m, 4) values from one time to another [s]."""
        within = (self.time >= start - 1e-9) & (self.time < end - 1e-9)
        return np.asarray(values[within].mean(axis=0))


def demand_on(
    asked: Preset | CooperativeController,
    rail: FloatArray,
    limits: FloatArray | None = None,
    total: float | None = None,
    reference: FloatArray | None = None,
) -> Demand:
    """What is asked of the motors on a rail.

    Parameters
    ----------
    asked : Preset or CooperativeController
        Whose locomotive and horizon count.
    rail : (n, 3) or (horizon, n, 3) array
        Creep curves under the axles now, or over the horizon.
    limits : (n,) array [N m], optional
        Of the motors; default: the torque limit.
    total : float [N m], optional
        Of all motors; default: that of the locomotive.
    reference : (n,) array [m/s], optional
        Slip speeds; default: those of the maximum adhesion of the curves.
    """
    locomotive, horizon = asked.locomotive, asked.tuning.horizon
    curves = np.ascontiguousarray(np.broadcast_to(rail, (horizon, locomotive.axles, 3)))
    return Demand(
        curves,
        peak_slips(curves) if reference is None else np.tile(reference, (horizon, 1)),
        np.full(locomotive.axles, locomotive.torque_limit) if limits is None else limits,
        locomotive.total_torque if total is None else total,
    )


def run(
    case: Case,
    preset: Preset = PAPER,
    total: float | None = None,
    *,
    strategy: str = "cooperative",
    integration: Integration = "runge-kutta",
    knowledge: RailSource | None = None,
    noise: Noise | None = None,
    seed: int = 1,
    first: float | None = None,
) -> Run:
    """Drive one case from a stand.

    Parameters
    ----------
    case : Case
    preset : Preset
    total : float [N m], optional
        Asked of all motors together; default: the most that they give together.
    strategy : str
        One of `STRATEGIES`.
    integration : {"euler", "runge-kutta"}
        One explicit step a period, as in the paper, or steps of 2 ms.
    knowledge : RailSource, optional
        Of the rail; default: all of it.
    noise : Noise, optional
        Of the speeds that are seen; default: none.
    seed : int
        Of the noise.
    first : float [N m], optional
        Torque of every motor in the first period, u(0) of eq. (19): the paper's algorithm assumes
        it and solves from the second sample on. Default: solved from the first.

    Raises
    ------
    InputError
        If the strategy is unknown, or the first torque is beyond the limits.
    """
    if strategy not in STRATEGIES:
        raise InputError(f"strategy '{strategy}' is unknown", remedy=f"one of {list(STRATEGIES)}")
    locomotive, period = preset.locomotive, preset.tuning.period
    asked = locomotive.total_torque if total is None else total
    if first is not None and not 0.0 <= first <= min(
        locomotive.torque_limit, asked / locomotive.axles
    ):
        raise InputError(f"first torque {first} N m is not within the limits of the motors")
    known, errors = knowledge or known_rail(case), noise or Noise()
    random = np.random.default_rng(seed)
    controller = STRATEGIES[strategy](preset)
    plant = _Plant(case, preset, integration)
    torques = np.zeros(locomotive.axles)
    for k in range(round(DURATION / period)):
        measured = plant.measured(k * period, torques, errors, random)
        assumed = known(measured)
        limits = case.limits(measured.time, preset)
        demand = demand_on(preset, assumed.rail, limits, asked, assumed.reference)
        torques = controller.torques(measured.speed, measured.wheel_speeds, demand)
        if k == 0 and first is not None:
            torques = np.full(locomotive.axles, first)
        plant.advance(measured.time, torques, demand.reference[0], assumed.maximum)
    return Run(
        case, preset, strategy, integration, asked,
        decisions=k + 1,
        unsolved=getattr(controller, "unsolved", 0),
        **_columns(np.array(plant.rows)),
    )  # fmt: skip


class _Plant:
    """The train, and what is recorded of it."""

    def __init__(self, case: Case, preset: Preset, integration: Integration) -> None:
        self._case, self._locomotive, self._period = case, preset.locomotive, preset.tuning.period
        literal = integration == "euler"
        self._step, self._each = (self._period, 1) if literal else (STEP, round(SAMPLE / STEP))
        self._integrate = euler if literal else runge_kutta
        self._state = np.zeros(1 + self._locomotive.axles)
        self._position = 0.0
        self.rows: list[FloatArray] = []

    def measured(
        self, time: float, torques: FloatArray, noise: Noise, random: np.random.Generator
    ) -> Measurement:
        """What the controller sees now; what stands is seen to stand."""
        std = np.array([noise.speed] + [noise.wheel_speed] * self._locomotive.axles)
        errors = std * random.standard_normal(std.size)
        speeds = np.where(self._state > 0.0, np.maximum(self._state + errors, 0.0), 0.0)
        return Measurement(time, self._position, float(speeds[0]), speeds[1:], torques)

    def advance(
        self, time: float, torques: FloatArray, reference: FloatArray, assumed: FloatArray
    ) -> None:
        """Record, and let a period pass."""
        locomotive = self._locomotive
        span = self._step * self._each
        for part in range(round(self._period / span)):
            rail, before = self._case.rail(time, self._position), float(self._state[0])
            parts = (self._state, torques, reference, assumed, *rail.T)
            self.rows.append(np.concatenate([[time + part * span, self._position], *parts]))
            self._integrate(
                self._state, torques, rail, locomotive.loads, locomotive.constants,
                self._step, self._each,
            )  # fmt: skip
            self._position += 0.5 * span * (before + float(self._state[0]))


def _columns(rows: FloatArray) -> dict[str, FloatArray]:
    """The arrays of `Run` from its recorded rows."""
    time, position, speed = rows[:, :3].T
    wheels, torque, reference, assumed, *curves = np.split(rows[:, 3:], 7, axis=1)
    rail = np.stack(curves, axis=-1)
    return {
        "time": time,
        "position": position,
        "speed": speed,
        "wheel_speed": wheels,
        "torque": torque,
        "reference": reference,
        "assumed": assumed,
        "adhesion": adhesion_at(wheels - speed[:, None], rail),
        "maximum_adhesion": adhesion_at(peak_slips(rail), rail),
    }


BANDWIDTH = 6.0
"""Of a slip controller [rad/s]: of those from 1 to 8 the one that takes a locomotive farthest."""


@dataclass
class SlipControl:
    """Every motor has its share of the total, less by proportional and integral control of slip.

    Attributes
    ----------
    locomotive : MultiMotorLocomotive
    period : float [s]
    alike : bool
        All motors get one torque, as from one inverter; the axle that slips most decides on it.
    heeds : bool
        False: every motor gives its share, whatever its wheels do.
    """

    locomotive: MultiMotorLocomotive
    period: float
    alike: bool = False
    heeds: bool = True

    def __post_init__(self) -> None:
        self._memory = np.zeros(1 if self.alike else self.locomotive.axles)

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        most = np.minimum(demand.total / demand.limits.size, demand.limits)
        if not self.heeds:
            return most
        error = demand.reference[0] - (wheel_speeds - speed)
        if self.alike:
            error, most = error.min(keepdims=True), most.min(keepdims=True)
        gain = self.locomotive.effort_per_torque / self.locomotive.rotating_mass
        grown = self._memory + self.period * BANDWIDTH**2 / gain * error
        asked = 2.0 * BANDWIDTH / gain * error + grown
        torque = np.clip(asked, 0.0, most)
        # Beyond a limit the memory may only move back.
        self._memory = np.where((asked - torque) * error > 0.0, self._memory, grown)
        return np.full(self.locomotive.axles, torque)


MEASURED = Noise(speed=0.05, wheel_speed=0.02)
"""A radar or satellites for the train speed, a pulse encoder for each wheel [m/s]."""

LEAVES = Case(
    number=5,
    name="leaves on the rail, here and there",
    wet=(),
    fails=False,
    published="",
    places=StepProfile(
        np.array([0.0, 25.0, 37.0, 60.0, 66.0, 90.0, 115.0, 140.0, 152.0]),
        np.array([DRY.peak, 0.10, DRY.peak, 0.08, DRY.peak, 0.12, DRY.peak, 0.08, DRY.peak]),
    ),
)
"""Patches of which some are shorter than the locomotive; not of the paper."""


STEEP = replace(
    CASES[2],
    number=6,
    name="axles 3 and 4 dry, another wet, dry",
    published="",
    wet_curve=CreepCurve(a=0.8, b=3.5, c=0.2935, d=0.2935),
)
"""Case 3 on a wet rail whose peak lies at 0.55 m/s instead of 3 m/s; not of the paper."""


def learnt_rail(preset: Preset) -> RailSource:
    """The rail is learnt while driving."""
    noise = MEASURED.speed, MEASURED.wheel_speed
    estimator = RailEstimator(preset.locomotive, preset.tuning, *noise)

    def rail(measured: Measurement) -> AssumedRail:
        found = estimator.update(measured.speed, measured.wheel_speeds, measured.torques)
        return AssumedRail(found.rail, found.maximum, found.reference)

    return rail


def rail_ahead(
    maximum_adhesion: StepProfile, position: float, speed: float, axles: ArrayLike, tuning: Tuning
) -> FloatArray:
    """Creep curves under each axle over the horizon, from a map; (horizon, n, 3) array.

    Parameters
    ----------
    maximum_adhesion : StepProfile
        By chainage in the direction of travel.
    position, speed : float [m], [m/s]
        Of the train's front.
    axles : (n,) array [m]
        How far behind the front each axle is.
    tuning : Tuning
    """
    middles = tuning.period * (np.arange(tuning.horizon) + 0.5)
    places = position + speed * middles[:, None] - np.asarray(axles, dtype=np.float64)
    return creep_coefficients(maximum_adhesion(np.maximum(places, 0.0)))


def mapped_rail(case: Case, preset: Preset) -> RailSource:
    """A map gives the maximum adhesion ahead.

    Raises
    ------
    InputError
        If the rail of the case changes with time: no map holds that.
    """
    places = case.places
    if places is None:
        raise InputError(f"case {case.number}: its rail changes with time, no map holds that")

    def rail(measured: Measurement) -> AssumedRail:
        ahead = rail_ahead(places, measured.position, measured.speed, AXLES, preset.tuning)
        return AssumedRail(ahead, adhesion_at(peak_slips(ahead[0]), ahead[0]))

    return rail


def uniform_rail(curve: CreepCurve) -> RailSource:
    """The rail is taken for one and the same everywhere."""
    return lambda _: AssumedRail(coefficients([curve] * 4), np.full(4, curve.peak))


RAIL_SOURCES: dict[str, Callable[[Case, Preset], RailSource]] = {
    "known": lambda case, _: known_rail(case),
    "map": mapped_rail,
    "learnt": lambda _, preset: learnt_rail(preset),
    "taken for dry": lambda *_: uniform_rail(DRY),
    "taken for wet": lambda *_: uniform_rail(WET),
}
"""From where a controller may know the rail, by name."""

UNKNOWN = (CASES[0], CASES[1], LEAVES, STEEP)
"""Cases in which the rail is not known."""

ASKED = (SENSIBLE.locomotive.total_torque, SCARCE)
"""Of all motors together [N m]."""


def by_knowledge(name: str, seed: int) -> list[Run | None]:
    """The cases with 85 t and speeds that are measured, by what is known of the rail.

    Parameters
    ----------
    name : str
        One of `RAIL_SOURCES`.
    seed : int
        Of the noise.

    Returns
    -------
    list of Run or None
        None where no map can hold the rail.
    """
    return [driven(name, case, total, seed) for total in ASKED for case in UNKNOWN]


def driven(name: str, case: Case, total: float, seed: int) -> Run | None:
    """One run with 85 t and one way to know the rail; see `by_knowledge`."""
    if name == "map" and case.places is None:
        return None
    known = RAIL_SOURCES[name](case, SENSIBLE)
    return run(case, SENSIBLE, total, knowledge=known, noise=MEASURED, seed=seed)
