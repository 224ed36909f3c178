"""What a model predicts for a trip, cell by cell: work and speed, their bands, why it is off."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pandas as pd

from analysis.comparison.diagnosis import wrong_mass
from analysis.comparison.driven import DrivenTrip, driven_trip
from analysis.comparison.energy import (
    HEAD_WIND,
    RECORDED_WIND,
    ForceModel,
    resistance_of,
    smooth_speed,
    trip_spread,
)
from analysis.comparison.sections import sections_between
from analysis.passports import estimated_passport, with_effort_delay
from analysis.resistance.fit import scale_of
from analysis.resistance.recording import recorded_head_wind
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.formats.railway import largest_load, recorded_load, train_of
from trainlog.railway import ParameterSet, RunningResistance, Train
from trainlog.railway.passport import Quantity
from trainlog.spans import runs_of
from trainlog.trip import Trip
from trainlog.units import GRAVITY, NANOSECONDS

STEP = 20.0
"""Length of the cells [m]."""

SLOWEST = 5.0
"""Below this speed [m/s] the recorded one is taken: what a brake does there is not known."""

SPEED_STD = 0.03
"""Standard deviation of the smoothed speed at the ends of a section [m/s]."""

GRADIENT_STD, GRADIENT_LENGTH = 0.2e-3, 1000.0
"""Error of gradients, and the length [m] it holds for, where the line states none."""

UNCALIBRATED = Quantity(1.0, 0.06, "assumed", "no load is recorded")
"""Recorded over true effort of ordinary converters."""

WIDEST = 0.5
"""Half a band over its value from which on the model does not determine it."""

WINDOW = 500.0
"""Length over which residuals are explained [m]."""

FILE_TRUST, FILE_MASS = 1.0, 0.1
"""Standard deviation over the value of a file's coefficients and of its mass, when residuals are
explained."""


@dataclass(frozen=True, eq=False)
class Inputs:
    """A trip with its efforts in time and size, the model, and what is not known of either."""

    trip: Trip
    driven: DrivenTrip
    model: ForceModel
    mass: Quantity
    gain: Quantity
    shown_gain: Quantity
    scale_std: float
    wind_std: float

    @property
    def windy(self) -> bool:
        """Whether the head wind is recorded."""
        return "head_wind" in self.driven.signals

    @property
    def efforts(self) -> bool:
        """Whether efforts are recorded."""
        return "traction" in self.driven.sums

    @property
    def inertia(self) -> float:
        """Of the train, its rotating masses included [kg]."""
        return self.mass.value + self.model.train.rotating_mass


def inputs_of(trip: Trip, model: ParameterSet | Train, wind_std: float | None) -> Inputs:
    """The trip and the model as they are compared; errors as `calculate`."""
    train = train_of(trip)
    known = estimated_passport(trip)
    delay = known.motion_delay.value if known.effort_delay.source == "estimated" else 0.0
    # Efforts are corrected here, not once more by a stored passport.
    bare = replace(
        with_effort_delay(trip, delay),
        attachments={k: v for k, v in trip.attachments.items() if k != "passport.json"},
    )
    driven = driven_trip(bare)
    scale = scale_of(trip) if "/train/state" in trip else None
    factor = 1.0 if scale is None else scale.factor
    gain = known.effort_gain if known.effort_gain.known else UNCALIBRATED
    load = recorded_load(trip, train)
    if wrong_mass(train, [(None if load is None else load.value, gain)]) is not None:
        gain = UNCALIBRATED  # found with that mass, it would hide what is wrong
    sums = {
        name: values / (gain.value * factor) if "unknown" not in name else values
        for name, values in driven.sums.items()
    }
    driven = replace(driven, speed=driven.speed / factor, sums=sums, signals=_signals(bare, driven))
    windy = "head_wind" in driven.signals
    wind_std = (RECORDED_WIND if windy else HEAD_WIND) if wind_std is None else wind_std
    forces = _forces(driven, train, model, wind_std)
    return Inputs(
        bare,
        driven,
        forces,
        _mass(bare, train, model),
        gain,
        known.effort_gain,
        0.0 if scale is None else scale.std,
        wind_std,
    )


def _signals(trip: Trip, driven: DrivenTrip) -> dict[str, FloatArray]:
    """The signals, with the head wind at all samples or not at all, as the fit takes it."""
    signals = {name: values for name, values in driven.signals.items() if name != "head_wind"}
    stamps = driven.departure + np.rint(driven.time * NANOSECONDS).astype(np.int64)
    wind = recorded_head_wind(trip, pd.DatetimeIndex(stamps, tz="UTC"))
    return signals if wind is None else signals | {"head_wind": wind}


def _forces(
    trip: DrivenTrip, train: Train, model: ParameterSet | Train, wind_std: float
) -> ForceModel:
    if isinstance(model, ParameterSet):
        model.check_train(train.name)
        common, covariance = resistance_of(model, wind_std)
        return ForceModel("fit", train, trip.line, common, covariance)
    own = model.resistance
    return ForceModel("train's file", model, trip.line, own, trip_spread(own, wind_std))


def _mass(trip: Trip, train: Train, model: ParameterSet | Train) -> Quantity:
    """Mass of the loaded train: by the recorded load, else what the fit saw, else half the load."""
    load = recorded_load(trip, train)
    if load is not None:
        return Quantity(train.mass + load.value, load.std, "recorded")
    if isinstance(model, ParameterSet) and model.configurations:
        masses = np.array([each.mass for each in model.configurations])
        std = float(np.hypot(masses.std(), 0.02 * masses.mean()))
        return Quantity(float(masses.mean()), std, "assumed", "no load is recorded")
    largest = largest_load(train)
    value, std = train.mass + 0.5 * largest, largest / np.sqrt(12.0)
    return Quantity(value, float(std), "assumed", "no load is recorded")


@dataclass(frozen=True, eq=False)
class Cells:
    """The trip by position: nodes (n + 1,), and what happens between them (n,).

    `unknown` are cells without efforts or speed, `speedless` those of them without speed.
    """

    nodes: FloatArray
    speed: FloatArray
    fast: BoolArray
    running: FloatArray
    work: FloatArray
    braking: FloatArray
    track: FloatArray
    tunnels: FloatArray
    wind: FloatArray
    section: IntArray
    edges: FloatArray
    names: tuple[str, ...]
    unknown: BoolArray
    speedless: BoolArray

    @staticmethod
    def of(inputs: Inputs) -> Cells:
        """The cells of a trip between its first and last recorded position."""
        trip, model = inputs.driven, inputs.model
        first, last = trip.covered
        sections = sections_between(trip.line, first, last)
        inner = np.arange(first + STEP, last - 0.5 * STEP, STEP)
        apart = np.min(np.abs(inner[:, None] - sections.edges), axis=1) >= 0.2 * STEP
        nodes = np.unique(np.concatenate((inner[apart], sections.edges)))
        middle, step = 0.5 * (nodes[1:] + nodes[:-1]), np.diff(nodes)
        speed = smooth_speed(trip, nodes)

        def of_cells(name: str) -> FloatArray:
            if name not in trip.sums:
                return np.zeros(step.size)
            return np.diff(trip.at(trip.sums[name], nodes))

        braking = of_cells("dynamic_braking") + of_cells("pneumatic_braking")
        wind = np.zeros(middle.size)
        if inputs.windy:
            wind = trip.at(trip.signals["head_wind"], middle)
        section = np.clip(np.searchsorted(sections.edges, middle) - 1, 0, sections.edges.size - 2)
        return Cells(
            nodes,
            speed,
            speed >= SLOWEST,
            np.diff(trip.at(trip.running, nodes)),
            of_cells("traction"),
            braking,
            model.train.track_force(trip.line, middle, 1.0) * step,
            model.tunnels(middle),
            wind,
            section.astype(np.int64),
            sections.edges,
            tuple(sections.names),
            *_unknown(trip, nodes),
        )

    @property
    def inside_gap(self) -> BoolArray:
        """Nodes at which the speed is not known."""
        none = self.speedless
        return np.asarray(np.append(none, False) & np.append(False, none), dtype=np.bool_)

    @property
    def step(self) -> FloatArray:
        """Lengths of the cells [m]."""
        return np.diff(self.nodes)

    @property
    def squared(self) -> FloatArray:
        """Mean speed squared of each cell [m²/s²]."""
        return 0.5 * (self.speed[1:] ** 2 + self.speed[:-1] ** 2)

    def resisting(self, resistance: RunningResistance) -> FloatArray:
        """Running resistance, that of tunnels and of the recorded wind included [N]."""
        speed = np.sqrt(self.squared)
        through_wind = resistance.r2 * self.wind * (2.0 * speed + self.wind)
        return np.asarray(resistance(speed) + self.tunnels * self.squared + through_wind)

    def runs(self) -> list[tuple[int, int]]:
        """First cell and one past the last of each run above `SLOWEST` within a section.

        Behind a gap of the recording another run begins, with the recorded speed.
        """
        both = self.fast[1:] & self.fast[:-1] & ~self.unknown
        found = []
        for begin, end in runs_of(both):
            cuts = begin + 1 + np.flatnonzero(np.diff(self.section[begin:end]))
            edges = [begin, *cuts.tolist(), end]
            found += list(pairwise(edges))
        return [each for each in found if each[1] - each[0] >= 3]


def _unknown(trip: DrivenTrip, nodes: FloatArray) -> tuple[BoolArray, BoolArray]:
    """Cells in which efforts or speed are not known, and those in which speed is not."""
    speedless = np.zeros(nodes.size - 1, dtype=np.bool_)
    if "unknown_speed" in trip.flags:
        speedless = trip.share_of("unknown_speed", nodes) > 0.0
    lacks = speedless.copy()
    for name in ("effort", "dynamic_braking", "pneumatic_braking"):
        if (
            f"unknown_{name}" in trip.sums
            and ("traction" if name == "effort" else name) in trip.sums
        ):
            lacks |= np.diff(trip.at(trip.sums[f"unknown_{name}"], nodes)) > 0.2
    return lacks, speedless


@dataclass(frozen=True, slots=True)
class _Variant:
    """What one quantity that is not known would change by a standard deviation."""

    resistance: RunningResistance
    mass: float
    gain: float = 1.0
    slope: float = 0.0
    start: float = 0.0

    def mirrored(self, own: _Variant) -> _Variant:
        """As far to the other side of the model as it is."""
        names = ("r0", "r1", "r2")
        resistance = [
            2.0 * getattr(own.resistance, name) - getattr(self.resistance, name) for name in names
        ]
        return _Variant(
            RunningResistance(*resistance),
            2.0 * own.mass - self.mass,
            2.0 - self.gain,
            -self.slope,
            -self.start,
        )


def variants_of(inputs: Inputs) -> list[_Variant]:
    """The model as it is, and with one standard deviation of each thing that is not known.

    First all to one side, then all to the other.
    """
    model, mass = inputs.model, inputs.mass.value
    own = _Variant(model.resistance, mass)
    gain_std = inputs.gain.std / inputs.gain.value if np.isfinite(inputs.gain.std) else 0.06
    found = [own]
    found += [replace(own, resistance=each.resistance) for each in model.varied()]
    found += [replace(own, mass=mass + inputs.mass.std), replace(own, gain=1.0 + gain_std)]
    survey = inputs.driven.line.survey
    slope = GRADIENT_STD if survey is None else survey.gradient_std
    found += [replace(own, slope=slope), replace(own, start=SPEED_STD)]
    return found + [each.mirrored(own) for each in found[1:]]


def predicted(
    inputs: Inputs, cells: Cells, variants: Sequence[_Variant]
) -> tuple[pd.DataFrame, FloatArray, FloatArray]:
    """Times and works by section with their bands, and the calculated speeds with theirs."""
    count = len(cells.names)
    works = np.array([_work(inputs, cells, each, count) for each in variants])
    times, speeds = zip(*(_driven(inputs, cells, each, count) for each in variants), strict=True)
    fast = np.zeros(cells.step.size, dtype=np.bool_)
    for begin, end in cells.runs():
        fast[begin:end] = True
    measured = np.bincount(cells.section, cells.running, count)
    # Where nothing is calculated, the recorded time counts.
    rest = np.bincount(cells.section, cells.running * ~fast, count)
    lacks = np.bincount(cells.section, cells.unknown, count) > 0
    speed = np.array(speeds)
    squares = np.where(fast, (speed[0][1:] - cells.speed[1:]) ** 2 * cells.step, 0.0)
    length = np.maximum(np.bincount(cells.section, cells.step * fast, count), 1e-9)
    recorded = np.bincount(cells.section, cells.work, count)
    if not inputs.efforts:
        recorded = np.full(count, np.nan)
    table = pd.DataFrame(
        {
            "first": cells.edges[:-1],
            "last": cells.edges[1:],
            "time": measured,
            "calculated_time": times[0] + rest,
            "time_std": _spread(np.array(times)),
            "speed_rms": np.sqrt(np.bincount(cells.section, squares, count) / length),
            "work": np.where(lacks, np.nan, recorded),
            "calculated_work": np.where(lacks, np.nan, works[0]),
            "work_std": np.where(lacks, np.nan, _spread(works)),
        },
        index=pd.Index(cells.names, name="section"),
    )
    if not inputs.efforts:
        table[["calculated_time", "time_std", "speed_rms"]] = np.nan
    spread = _spread(speed)
    # Between runs nothing is calculated.
    inside = np.append(fast, False) | np.append(False, fast)
    calculated = np.where(inside, speed[0], np.nan)
    wide = inside & (1.96 * spread >= calculated)  # down to a stand
    wide_in = np.bincount(cells.section, wide[1:], count) > 0
    for name, more in (("time", wide_in), ("work", False)):
        reach, value = 1.96 * table[f"{name}_std"], table[f"calculated_{name}"].abs()
        table[f"{name}_determined"] = ~((reach > WIDEST * value) | more)
    return table, np.where(wide, np.nan, calculated), spread


def _spread(values: FloatArray) -> FloatArray:
    """Standard deviation of the first row from the rows one standard deviation off, either way.

    Of both sides the larger: more resistance costs more time than less of it saves.
    """
    off = np.abs(values[1:] - values[0])
    sides = off.reshape(2, off.shape[0] // 2, *off.shape[1:])
    return np.asarray(np.sqrt(np.sum(sides.max(axis=0) ** 2, axis=0)))


def _slope_length(inputs: Inputs) -> float:
    survey = inputs.driven.line.survey
    length = None if survey is None else survey.correlation_length
    return GRADIENT_LENGTH if length is None else length


def _work(inputs: Inputs, cells: Cells, variant: _Variant, count: int) -> FloatArray:
    """Tractive work [J] that the recorded motion of each section needs."""
    inertia = variant.mass + inputs.model.train.rotating_mass
    kinetic = 0.5 * inertia * np.diff(cells.speed**2)
    resisting = cells.resisting(variant.resistance) * cells.step
    needed = kinetic + resisting + variant.mass * cells.track
    if inputs.efforts:
        needed = needed + cells.braking * (2.0 - variant.gain)
        # What is not known of the gain is not known of the measured work, too.
        needed = needed - cells.work * (variant.gain - 1.0)
        found = np.bincount(cells.section, needed, count)
    else:
        found = np.bincount(cells.section, np.maximum(needed, 0.0), count)
    length = np.diff(cells.edges)
    uneven = np.sqrt(_slope_length(inputs) * length)
    top = np.sqrt(np.array([cells.squared[cells.section == row].max() for row in range(count)]))
    return np.asarray(
        found
        + variant.slope * GRAVITY * variant.mass * uneven
        + variant.start * inertia * top
        + 2.0 * inputs.scale_std * (variant.start > 0.0) * np.abs(found)
    )


def _driven(
    inputs: Inputs, cells: Cells, variant: _Variant, count: int
) -> tuple[FloatArray, FloatArray]:
    """Time of each section [s] and speed at the nodes [m/s] with the recorded efforts."""
    speed = cells.speed.copy()
    times = np.zeros(count)
    inertia = variant.mass + inputs.model.train.rotating_mass
    force = (cells.work - cells.braking) / cells.step / variant.gain
    uneven = np.sqrt(_slope_length(inputs))
    for begin, end in cells.runs():
        part = slice(begin, end)
        step = cells.step[part]
        ran = np.cumsum(step)
        push = force[part] - variant.mass * cells.track[part] / step
        lost = variant.slope * GRAVITY * variant.mass * uneven * np.sqrt(ran) / ran
        first = (cells.speed[begin] + variant.start) ** 2
        wind, resistance = cells.wind[part], variant.resistance
        air = _Air(resistance.r1 + 2.0 * resistance.r2 * wind, resistance.r2 + cells.tunnels[part])
        still = resistance.r0 + resistance.r2 * wind**2
        found = _speeds(first, push - lost - still, step, air, inertia)
        speed[begin + 1 : end + 1] = found[1:]
        times[cells.section[begin]] += float(np.sum(2.0 * step / (found[1:] + found[:-1])))
    return times, speed


@dataclass(frozen=True, slots=True)
class _Air:
    """Linear and quadratic term of the running resistance in each cell."""

    linear: FloatArray
    quadratic: FloatArray


def _speeds(
    first: float, push: FloatArray, step: FloatArray, air: _Air, inertia: float
) -> FloatArray:
    """Speeds [m/s] at the nodes of a run; `push` is what does not depend on speed [N].

    The quadratic term decays exponentially in position, exactly; the linear one is iterated.
    """
    decay = np.concatenate(([0.0], np.cumsum(2.0 * air.quadratic / inertia * step)))
    growth = np.exp(np.minimum(0.5 * (decay[1:] + decay[:-1]), 500.0))
    speed = np.full(step.size, np.sqrt(first))
    for _ in range(8):
        drive = 2.0 / inertia * (push - air.linear * speed) * step
        squared = np.exp(-decay) * (first + np.concatenate(([0.0], np.cumsum(drive * growth))))
        nodes = np.sqrt(np.maximum(squared, (0.5 * SLOWEST) ** 2))
        speed = 0.5 * (nodes[1:] + nodes[:-1])
    return np.asarray(nodes)


def explained_by(inputs: Inputs, cells: Cells) -> tuple[dict[str, float], float]:
    """Share of the squared residual work that each cause explains, by a regression with priors.

    Shares are those of Pratt (1987): the contribution of a cause times the residual, over the
    residual squared; they add up to one with what is left.
    """
    model = inputs.model
    window = np.floor((cells.nodes[:-1] - cells.nodes[0]) / WINDOW).astype(np.int64)
    count = int(window[-1]) + 1
    speed, step = np.sqrt(cells.squared), cells.step

    known = np.bincount(window, cells.unknown, count) == 0

    def summed(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(window, values, count) * known, dtype=np.float64)

    kinetic = 0.5 * np.diff(cells.speed**2)
    net = cells.work - cells.braking
    resisting = cells.resisting(model.resistance) * step
    expected = inputs.inertia * kinetic + resisting + inputs.mass.value * cells.track
    residual = summed(net - expected)
    mass_std = inputs.mass.std
    if model.name == "fit":
        variances, axes = np.linalg.eigh(model.covariance)
        root = axes * np.sqrt(np.maximum(variances, 0.0))
    else:
        own = model.resistance
        root = np.diag(FILE_TRUST * own.coefficients)
        mass_std = max(mass_std, FILE_MASS * inputs.mass.value)
    powers = np.stack([summed(step), summed(step * speed), summed(step * speed**2)], axis=1)
    gain_std = inputs.gain.std / inputs.gain.value
    tilt = np.eye(count) * (GRADIENT_STD * GRAVITY * inputs.mass.value * summed(step))[:, None]
    causes = {
        "running resistance": powers @ root,
        # What the motion under recorded efforts shows is the ratio of the two.
        "mass or gain of efforts": np.stack(
            [mass_std * summed(kinetic + cells.track), -gain_std * summed(net)], axis=1
        ),
        "gradients": tilt,
    }
    length = np.maximum(summed(step), 1e-9)
    edge = inputs.inertia * np.sqrt(2.0) * SPEED_STD * summed(step * speed) / length
    noise = np.hypot(edge, 0.01 * summed(np.abs(net))) + 1.0 * ~known
    design = np.concatenate(list(causes.values()), axis=1) / noise[:, None]
    normal = design.T @ design + np.eye(design.shape[1])
    beta = np.linalg.solve(normal, design.T @ (residual / noise))
    total = float(residual @ residual)
    shares, first, left = {}, 0, residual.copy()
    for name, columns in causes.items():
        part = columns @ beta[first : first + columns.shape[1]]
        shares[name] = float(part @ residual) / total
        first, left = first + columns.shape[1], left - part
    slipped = np.zeros(count, dtype=np.bool_)
    if "slip" in inputs.driven.flags:
        slipped[window[inputs.driven.share_of("slip", cells.nodes) > 0.0]] = True
    shares["slip"] = float(left[slipped] @ residual[slipped]) / total
    shares["unexplained"] = float(left[~slipped] @ residual[~slipped]) / total
    return shares, float(np.sqrt(total / count))
