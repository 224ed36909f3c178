"""Zhao et al. (2025), section 4: four motors share the torque while the rail under them changes.

Two presets: the paper's table 2, read literally (which is physically odd: its axles have three
times the inertia of what rests on them), and a locomotive of 85 t with a train of 400 t. Two
plants: one explicit Euler step of 0.1 s, as eq. (15) has it, and Runge-Kutta.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby
from typing import Any, Literal

import numpy as np
from numba import njit

from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    SKY,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    Span,
)
from analysis.control.cooperative import (
    CooperativeController,
    Demand,
    MultiMotorLocomotive,
    Tuning,
    adhesion_at,
    creep,
    peak_slips,
)
from analysis.studies.report import StudyReport, study_trip
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.railway import train_to_bytes
from trainlog.presentation import Columns, WordTable, word_table
from trainlog.railway import Line, RunningResistance, Station, StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve
from trainlog.railway.train import Axles, Train
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_ADHESION,
    GNSS_MOTION,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
    TRUTH,
)
from trainlog.trip import TRAIN_ATTACHMENT, Trip
from trainlog.units import GRAVITY as STANDARD_GRAVITY, KMH

Integration = Literal["euler", "runge-kutta"]

DURATION = 30.0
"""Of a run [s]."""

STEP = 0.002
"""Of the Runge-Kutta integration [s]."""

SAMPLE = 0.02
"""Between two recorded samples of it [s]."""

WET_SPAN, RESTORED = (10.0, 20.0), 25.0
"""When the rail is wet, and when the failed motor of case 4 is back [s]."""

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
        force = loads[i] * creep(state[1 + i] - v, rail[i])
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
    """

    number: int
    name: str
    wet: tuple[int, ...]
    fails: bool
    published: str

    def rail(self, time: float) -> FloatArray:
        """Creep curves under the four axles at a time [s], (4, 3)."""
        wet = self.wet if WET_SPAN[0] <= time < WET_SPAN[1] else ()
        return coefficients([WET if axle in wet else DRY for axle in range(1, 5)])

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
) -> Demand:
    """What is asked of the motors on a rail.

    Parameters
    ----------
    asked : Preset or CooperativeController
        Whose locomotive and horizon count.
    rail : (n, 3) array
        Creep curves under the axles.
    limits : (n,) array [N m], optional
        Of the motors; default: the torque limit.
    total : float [N m], optional
        Of all motors; default: that of the locomotive.
    """
    locomotive, horizon = asked.locomotive, asked.tuning.horizon
    curves = np.ascontiguousarray(np.broadcast_to(rail, (horizon, locomotive.axles, 3)))
    return Demand(
        curves,
        peak_slips(curves),
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
    controller = STRATEGIES[strategy](preset)
    plant = _Plant(case, preset, integration)
    torques = np.zeros(locomotive.axles)
    for k in range(round(DURATION / period)):
        now, speed, wheel_speeds = k * period, float(plant.state[0]), plant.state[1:].copy()
        demand = demand_on(preset, case.rail(now), case.limits(now, preset), asked)
        torques = controller.torques(speed, wheel_speeds, demand)
        if k == 0 and first is not None:
            torques = np.full(locomotive.axles, first)
        plant.advance(now, torques, demand.reference[0])
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
        self.state = np.zeros(1 + self._locomotive.axles)
        self._position = 0.0
        self.rows: list[FloatArray] = []

    def advance(self, time: float, torques: FloatArray, reference: FloatArray) -> None:
        """Record, and let a period pass."""
        locomotive = self._locomotive
        span = self._step * self._each
        for part in range(round(self._period / span)):
            rail, before = self._case.rail(time), float(self.state[0])
            parts = (self.state, torques, reference, *rail.T)
            self.rows.append(np.concatenate([[time + part * span, self._position], *parts]))
            self._integrate(
                self.state, torques, rail, locomotive.loads, locomotive.constants,
                self._step, self._each,
            )  # fmt: skip
            self._position += 0.5 * span * (before + float(self.state[0]))


def _columns(rows: FloatArray) -> dict[str, FloatArray]:
    """The arrays of `Run` from its recorded rows."""
    time, position, speed = rows[:, :3].T
    wheels, torque, reference, *curves = np.split(rows[:, 3:], 6, axis=1)
    rail = np.stack(curves, axis=-1)
    return {
        "time": time,
        "position": position,
        "speed": speed,
        "wheel_speed": wheels,
        "torque": torque,
        "reference": reference,
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


# ---------------------------------------------------------- its runs, as logs, pictures and tables

SPANS = ((5.0, 10.0), (15.0, 20.0), (22.0, 25.0), (27.0, 30.0))
"""In which the axles have come to rest at their slip speeds [s]."""


STARTING = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)
"""At which the start of case 1 is listed [s]."""


def published_table() -> WordTable:
    """What Zhao et al. (2025) states of its cases."""
    of: Columns[Case] = {
        "case": lambda case: case.number,
        "": lambda case: case.name,
        "reached there": lambda case: case.published,
    }
    return word_table("Published; torques in N m", CASES, of)


def torque_table(runs: Sequence[Run]) -> WordTable:
    """Torques, adhesion in use and acceleration of each run, where its axles have come to rest.

    Parameters
    ----------
    runs : sequence of Run
    """
    of: Columns[tuple[Run, int]] = {
        "case": lambda row: "" if row[1] else row[0].case.number,
        "preset": lambda row: "" if row[1] else row[0].preset.key,
        "plant": lambda row: "" if row[1] else "Euler" if row[0].integration == "euler" else "RK4",
        "s": lambda row: "{:.0f}-{:.0f}".format(*SPANS[row[1]]),
        "torques N m": lambda row: _axles(_mean(row, row[0].torque), ".0f"),
        "slip m/s": lambda row: _axles(_mean(row, row[0].slip), ".2f"),
        "adhesion": lambda row: _axles(_mean(row, row[0].adhesion), ".4f"),
        "train m/s²": lambda row: f"{_mean(row, row[0].acceleration):.2f}",
        "unsolved": lambda row: "" if row[1] else f"{row[0].unsolved} of {row[0].decisions}",
    }
    rows = ((run, number) for run in runs for number in range(len(SPANS)))
    return word_table("Reached; means over each span", rows, of)


def _mean(row: tuple[Run, int], values: FloatArray) -> Any:
    run, number = row
    return run.mean(values, *SPANS[number])


def start_table(solved: Run, assumed: Run) -> WordTable:
    """How case 1 begins: solved from the first sample, and with the torque that is assumed there.

    Parameters
    ----------
    solved, assumed : Run
        Of case 1 in the paper's steps; see `first` of `simulation.run`.
    """
    rows = {"solved from 0 s on": solved, "u(0) assumed, eq. (19)": assumed}

    def at(when: float) -> Callable[[tuple[str, Run]], str]:
        def cell(row: tuple[str, Run]) -> str:
            k = np.searchsorted(row[1].time, when - 1e-9)
            return f"{row[1].torque[k, 0]:.0f} / {row[1].slip[k, 0]:.2f}"

        return cell

    of: Columns[tuple[str, Run]] = {"": lambda row: row[0]}
    of |= {f"{when:g} s": at(when) for when in STARTING}
    title = "Start of case 1; torque of each motor N m / slip m/s"
    return word_table(title, rows.items(), of)


def gain_table(runs: Mapping[str, Sequence[Run]]) -> WordTable:
    """What cooperation is worth: force, speed and way of each strategy.

    Parameters
    ----------
    runs : mapping of str to sequence of Run
        By strategy; the same runs in the same order.
    """

    def figures(number: int) -> Callable[[Sequence[Run]], str]:
        return lambda found: (
            f"{_force_and_way(found[number])} / {found[number].slip_work / 1e6:.2f}"
        )

    of: Columns[Sequence[Run]] = {
        "case": lambda found: found[0].case.number,
        "preset": lambda found: found[0].preset.key,
        "asked N m": lambda found: f"{found[0].total:.0f}",
        **{name: figures(number) for number, name in enumerate(runs)},
    }
    rows: Iterable[Sequence[Run]] = zip(*runs.values(), strict=True)
    title = "Force on the rail kN, 15-20 s / way m, 30 s / work of creep MJ, 30 s"
    return word_table(title, rows, of)


def _force_and_way(run: Run) -> str:
    return f"{run.mean(run.force, 15.0, 20.0) / 1e3:.1f} / {run.position[-1]:.1f}"


def _axles(values: np.ndarray, form: str) -> str:
    """Values of the axles; those that are alike are listed once: ``3 x 3934, 3349``."""
    groups = [(text, len([*alike])) for text, alike in groupby(f"{each:{form}}" for each in values)]
    return ", ".join(f"{count} x {text}" if count > 1 else text for text, count in groups)


AXLES = ((BLUE, 4.0), (SKY, 2.8), (ORANGE, 1.6), (RED, 0.7))
"""Colours and widths of the axles: those that run alike lie on one another."""

WHEN_WET = [Span(*WET_SPAN, SKY, opacity=0.12)]
"""Marks when the rail is wet."""


def _pair(left: Panel, right: Panel, title: str = "") -> list[Chart]:
    """Two panels over time beside each other."""
    return [
        Chart("time [s]", [left], title=title, width=0.5),
        Chart("time [s]", [right], width=0.5, beside=True),
    ]


def study_charts(runs: Sequence[Run]) -> dict[str, list[Chart]]:
    """The paper's figures of every run, by the files' names.

    Parameters
    ----------
    runs : sequence of Run
    """
    stepped = {(run.preset.key, run.case.number): run for run in runs if run.integration == "euler"}
    charts = {"figure-02-adhesion.png": [_curves()]}
    for run in (each for each in runs if each.integration != "euler"):
        key, number = run.preset.key, run.case.number
        name = f"figure-{number + 2:02d}-case-{number}-{key}.png"
        charts[name] = _case(run, stepped.get((key, number)))
    return charts


def _curves() -> Chart:
    """Fig. 2: adhesion coefficient over slip speed."""
    slip = np.linspace(0.0, 10.0, 401)
    curves, labels = list[Curve](), list[Label]()
    for curve, colour, name in ((DRY, RED, "dry"), (WET, BLUE, "wet")):
        at, peak = curve.peak_slip, curve.peak
        curves.append(Curve(name, slip, curve(slip), colour))
        curves.append(Curve("", [at], [peak], colour, "points", width=3.0))
        words = f"   {at:.2f} m/s, {peak:.3f}"
        labels.append(Label(at, words, peak + 0.01, side="left", size=8.0))
    panel = Panel("adhesion coefficient", curves, 1.3, limits=(0.0, 0.32), labels=labels)
    return Chart("slip speed [m/s]", [panel], title="Fig. 2  Creep curves", width=0.65)


def _case(run: Run, stepped: Run | None) -> list[Chart]:
    """Figs. 3-6: slip speeds and references, their errors, torques, adhesion coefficients.

    Where there is a run in the paper's steps, it is laid over as dots.
    """

    def panel(unit: str, title: str, values: str, wide: str = "", **options: Any) -> Panel:
        sought, found = (
            getattr(run, name).T if name else [None] * len(AXLES) for name in (wide, values)
        )
        curves = [Curve("", run.time, each, PALE, width=7.0) for each in sought if each is not None]
        kind: Literal["step", "line"] = "step" if values == "torque" else "line"
        curves += [
            Curve(f"axle {number}" if values == "slip" else "", run.time, each, colour, kind,
                  width=width)
            for number, (each, (colour, width)) in enumerate(zip(found, AXLES, strict=True), 1)
        ]  # fmt: skip
        if stepped is not None:
            dots = getattr(stepped, values).T
            curves += [Curve("", stepped.time, each, INK, "points", width=0.6) for each in dots]
        return Panel(unit, curves, 1.2, title, spans=WHEN_WET, **options)

    limit = run.preset.locomotive.torque_limit
    plant = "Runge-Kutta" if stepped is None else "Runge-Kutta; dots: Euler in steps of 0.1 s"
    title = (
        f"Fig. {run.case.number + 2}  Case {run.case.number}: {run.case.name}"
        f" ({run.preset.locomotive.name}; {plant})"
    )
    return [
        *_pair(
            panel("m/s", "(a)  Slip speed; wide: its reference", "slip", "reference"),
            panel("m/s", "(b)  Reference less slip speed", "slip_error"),
            title,
        ),
        *_pair(
            panel("N m", "(c)  Torque of the motors; dotted: limit of a motor", "torque",
                  rules=[Rule(limit, GREY, dash=":")], limits=(-0.03 * limit, 1.12 * limit)),
            panel("", "(d)  Adhesion coefficient; wide: the most the rail gives", "adhesion",
                  "maximum_adhesion"),
        ),
    ]  # fmt: skip


LENGTH = 2_500.0
"""Of the line [m]; the paper's locomotive comes about 1,000 m far."""

TOP_SPEED = 200.0 / KMH
"""Of line and locomotive [m/s]; the runs know no limit but the motors'."""

SPEED_STD = 0.01
"""Stated of the train speed [m/s], which the controller knows exactly."""


def main(report: StudyReport) -> None:
    """Run the cases as published, and without cooperation."""
    runs = [
        run(case, preset, integration=integration)
        for case, preset, integration in report.track(PLANS, "driving")
    ]
    for each in runs:
        report.log(trip_of(each))
    assumed = run(CASES[0], integration="euler", first=FIRST_TORQUE)
    compared = {
        strategy: [run(*plan, strategy=strategy) for plan in COMPARED]
        for strategy in report.track(STRATEGIES, "comparing")
    }
    report.draw(study_charts(runs))
    report.show(
        published_table(), start_table(runs[0], assumed), torque_table(runs), gain_table(compared)
    )


def trip_of(run: Run) -> Trip:
    """The log of one run.

    The train speed that the controller sees stands in ``/gnss/motion``: all axles are driven, and
    ``/train/state`` has the mean of their wheels. ``/estimates/adhesion`` holds what the
    controller knows, here the truth.
    """
    locomotive = run.preset.locomotive
    effort = locomotive.effort_per_torque * run.torque
    rate = np.diff(run.time, prepend=0.0)
    energy = np.cumsum(np.r_[0.0, (effort * run.wheel_speed).sum(axis=1)[:-1]] * rate)
    return study_trip(
        name_of(run),
        locomotive.name,
        line(),
        run.time,
        {
            TRAIN_STATE: {
                "position": run.position,
                "speed": run.wheel_speed.mean(axis=1),
                "acceleration": run.acceleration,
            },
            TRAIN_CONTROLS: {
                "tractive_effort_demand": locomotive.effort_per_torque * locomotive.total_torque,
                "braking_effort_demand": 0.0,
                "tractive_effort": effort.sum(axis=1),
                "dynamic_braking_effort": 0.0,
                "pneumatic_braking_effort": 0.0,
            },
            TRAIN_AXLES: {"wheel_speed": run.wheel_speed, "wheel_effort": effort},
            GNSS_MOTION: {"speed": run.speed, "speed_accuracy": SPEED_STD},
            ENVIRONMENT: {"speed_limit": TOP_SPEED, "gradient": 0.0, "curvature": 0.0},
            ESTIMATED_ADHESION: {"adhesion": run.adhesion, "slip_speed": run.slip},
            TRUTH: {
                "position": run.position,
                "speed": run.speed,
                "acceleration": run.acceleration,
                "running_resistance": locomotive.resistance(run.speed),
                "maximum_adhesion": run.maximum_adhesion.mean(axis=1),
                "energy": energy,
            },
        },
        (
            "study cooperative-adhesion",
            {
                "case": run.case.number,
                "preset": run.preset.key,
                "strategy": run.strategy,
                "integration": run.integration,
            },
        ),
        attachments={TRAIN_ATTACHMENT: train_to_bytes(train(run.preset))},
        metadata={
            "load": "0",
            "traction_control": run.strategy,
            "traction_decisions": str(run.decisions),
            "traction_unsolved": str(run.unsolved),
            "study": "Zhao et al. (2025), section 4",
        },
        events=_events(run.case),
    )


def name_of(run: Run) -> str:
    """Name of a run: its case, its preset, and what is unusual of it."""
    words = [f"case-{run.case.number}", run.preset.key]
    if run.strategy != "cooperative":
        words.append(run.strategy.replace(" ", "-"))
    if run.integration == "euler":
        words.append("euler")
    return "-".join(words)


def line() -> Line:
    """Straight and level."""
    return Line(
        name="straight and level",
        length=LENGTH,
        stations=(Station("start", 0.0), Station("end", LENGTH)),
        speed_limits=StepProfile(np.zeros(1), np.array([TOP_SPEED])),
        gradients=StepProfile(np.zeros(1), np.zeros(1)),
        source="Zhao et al. (2025), which states no line",
    )


def train(preset: Preset) -> Train:
    """Locomotive and train as one train file: axles, resistance, limits at the wheel rims."""
    locomotive = preset.locomotive
    effort = locomotive.effort_per_torque * locomotive.total_torque
    rotating = locomotive.axles * locomotive.rotating_mass
    return Train(
        name=locomotive.name,
        mass=locomotive.mass,
        rotating_mass_factor=rotating / locomotive.mass,
        resistance=locomotive.resistance,
        max_tractive_effort=effort,
        max_traction_power=effort * TOP_SPEED,
        max_speed=TOP_SPEED,
        max_acceleration=3.0,
        length=20.0,
        axles=Axles(
            count=locomotive.axles,
            adhesive_mass=float(locomotive.loads.sum()) / STANDARD_GRAVITY,
            wheel_radius=locomotive.wheel_radius,
            rotating_mass=locomotive.rotating_mass,
        ),
        source="Zhao et al. (2025), table 2, and what is chosen beside it",
    )


def _events(case: Case) -> list[tuple[float, str, str]]:
    axles = "axle" if len(case.wet) == 1 else "axles"
    which = f"{axles} {', '.join(str(axle) for axle in case.wet)}"
    found = [
        (0.0, "departure", "train"),
        (WET_SPAN[0], f"wet rail under {which}", "rail"),
        (WET_SPAN[1], f"dry rail under {which}", "rail"),
    ]
    if case.fails:
        found.append((WET_SPAN[0], "motor 4 fails", "drive"))
        found.append((RESTORED, "motor 4 works again", "drive"))
    return sorted(found)
