"""Measured against calculated: what a fit or a train's file predicts for a recorded trip.

The recorded efforts, in time and size by the trip's passport, drive the train of the model along
the recorded positions. Between the stops the speed follows from the equation of motion by
position,

    d(v²)/ds = 2 (F - R(v, w) - m a_track(s)) / (m + m_rot),

started with the recorded speed in each section, and with it the running time; w is the head wind
where it is recorded. The energy at the
wheels follows from the recorded speeds instead: what the efforts must have done is the change of
kinetic energy, the work against the track and the work against the running resistance.

Both have bands of what is not known: the running resistance of a trip that was not seen, a wind
that is not recorded, the mass,
the gain of the efforts, the gradients, the speed itself.

What a model predicts for a trip, cell by cell: work and speed, their bands, why it is off.

What of a model is wrong: one coefficient of the resistance, or the mass, named with its factor.

A trip with efforts is fitted by itself (`analysis.resistance.fit.fit_trip`): its curve hardly
depends on the resistance of the train's file. What trips differ by beside that, a head wind that is
not recorded above all, is a part of the difference that is no error of the file. What is left is
explained by a change of one coefficient at a time; the change that leaves least is named, with
those that explain it nearly as well: of the linear term also a steady wind. The mass shows in the
gain of the efforts, by which both are found in one. Several trips are taken together: their winds
differ, an error of the file does not.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.stats import f as f_distribution

from analysis.comparison.compare import Sections, sections_between, with_units
from analysis.comparison.driven import DrivenTrip, driven_trip
from analysis.comparison.energy import (
    FIT,
    RECORDED_WIND,
    STEP,
    ForceModel,
    smooth_speed,
    trip_spread,
)
from analysis.resistance.curve import HEAD_WIND
from analysis.resistance.fit import TripFit, fit_trip
from analysis.resistance.observed import FitOfTrips, parameter_set
from analysis.resistance.passport import estimated_passport, with_effort_delay
from analysis.resistance.recording import LEAST_EFFORT, recorded_head_wind, scale_of
from analysis.view import Given, TripView, view_of
from estimators.regression import Free, regress
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.files import check_kind
from trainlog.formats.railway import largest_load, recorded_load, train_to_bytes
from trainlog.presentation import (
    DURATION,
    ENERGY,
    SHARE,
    SPEED,
    Band,
    Column,
    Columns,
    Presented,
    Said,
    WordTable,
    new_table,
    word_table,
)
from trainlog.railway import Line, ParameterSet, RunningResistance, Train
from trainlog.railway.passport import Quantity
from trainlog.railway.resistance import TERMS, basis
from trainlog.spans import runs_of
from trainlog.trip import TRAIN_ATTACHMENT, Trip
from trainlog.units import GRAVITY, JOULES_PER_KWH, NANOSECONDS

SURE = 0.999
"""Probability with which a difference of the curve must not be chance."""

FALSE_ALARMS = 0.1
"""Share of trips that contradicted a right file, by the mass or by the curve, as measured."""

ALIKE = 3.84
"""Rise of chi-squared up to which another coefficient explains as well."""

OWN_SPREAD = 0.1
"""Standard deviation of each coefficient of a file, over its value, that is no error of it."""

LEAST_FACTOR = 1.25
"""Smaller factors of a coefficient are within what trains of a kind and days differ by."""

CONVERTER_STD, MASS_SURE = 0.03, 2.4
"""Standard deviation of the gain of an ordinary recorder's efforts, and how many of it, together
with what the trip leaves open, a gain must differ from 1 by to be that of a wrong mass."""


@dataclass(frozen=True, slots=True)
class Wrong:
    """A quantity of a model that the trip contradicts.

    Attributes
    ----------
    name : str
        One of `TERMS`, ``"running resistance"`` (more than one) or ``"mass"``.
    factor, factor_std : float
        What the model states over what the trip shows, and its standard deviation.
    alternatives : tuple of str
        What explains the same nearly as well.
    """

    name: str
    factor: float
    factor_std: float
    alternatives: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """In a sentence."""
        size = f"{self.factor:.2f} ± {1.96 * self.factor_std:.2f} times what the trip shows"
        others = f" (or {' or '.join(self.alternatives)})" if self.alternatives else ""
        return f"{self.name} is {size}{others}"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What of a model is wrong.

    Attributes
    ----------
    wrong : tuple of Wrong
    not_judged : str
        Why nothing can be said, if so.
    judged_trips : int
        How many trips it rests on.
    false_alarms : float
        Share of trips that contradict a right file by chance, about.
    """

    wrong: tuple[Wrong, ...] = ()
    not_judged: str = ""
    judged_trips: int = 1
    false_alarms: float = FALSE_ALARMS

    @property
    def words(self) -> str:
        """In a sentence."""
        if self.not_judged:
            return f"not judged: {self.not_judged}"
        if not self.wrong:
            return "nothing that the trip contradicts"
        return "; ".join(each.words for each in self.wrong)


def diagnosed(evidence: Sequence[Inputs]) -> Diagnosis:
    """What trips contradict of a model.

    Raises
    ------
    InputError
        If there is none, or they are of different trains.
    """
    if len({each.model.train.name for each in evidence}) != 1:
        raise InputError(
            "trips of one train are judged together",
            remedy="give those of one train",
        )
    train = evidence[0].model.train
    heavy = wrong_mass(train, [(each.load, each.shown_gain) for each in evidence])
    fitted = [(each, each.fit) for each in evidence if isinstance(each.fit, TripFit)]
    if not fitted:
        wrong = () if heavy is None else (heavy,)
        return Diagnosis(wrong, "" if wrong else str(evidence[0].fit), len(evidence))
    # A wrong mass makes the gain, and with it all forces, wrong by its factor.
    coefficient = _wrong_coefficient(fitted, 1.0 if heavy is None else heavy.factor)
    found = tuple(each for each in (heavy, coefficient) if each is not None)
    return Diagnosis(found, "", len(fitted))


def wrong_mass(train: Train, weighed: Sequence[tuple[float | None, Quantity]]) -> Wrong | None:
    """The mass of the train's file, if motions with it need efforts of another size.

    Parameters
    ----------
    train : Train
    weighed : sequence of (float or None, Quantity)
        The recorded load [kg] and gain of the efforts of each trip.
    """
    known = [
        (load, gain) for load, gain in weighed if load is not None and gain.source == "estimated"
    ]
    if not known:
        return None
    weights = np.array([(gain.value / gain.std) ** 2 for _, gain in known])
    ratios = np.array([1.0 / gain.value for _, gain in known])
    # One recorder's efforts err alike on all trips.
    std = float(np.hypot(weights.sum() ** -0.5, CONVERTER_STD))
    if abs(float(np.average(ratios, weights=weights)) - 1.0) < MASS_SURE * std:
        return None
    # The recorded load is no part of what may be wrong.
    own = train.mass + train.rotating_mass
    shown = np.array([(own + load) * gain.value - load for load, gain in known])
    factor = own / float(np.average(shown, weights=weights))
    return Wrong("mass", factor, factor * std, ("recorded efforts",))


def _wrong_coefficient(fitted: Sequence[tuple[Inputs, TripFit]], factor: float) -> Wrong | None:
    """The coefficient that trips contradict, their efforts and curves over a factor."""
    model = fitted[0][0].model
    own = model.resistance.coefficients
    fits = [fit for _, fit in fitted]
    betas = np.array([fit.beta for fit in fits]) / factor
    single = np.array([fit.own_covariance for fit in fits]) / factor**2
    if model.name != FIT:
        rough = _mean(betas, single)[0]
        # Of the coefficients as they may be: those of a wrong file are too large or too small.
        size = np.minimum(own, np.maximum(rough, 0.1 * own))
        usual = RunningResistance.of(size)
        single = single + np.array([trip_spread(usual, each.wind_std) for each, _ in fitted])
        common = np.diag((OWN_SPREAD * size) ** 2)
    else:
        common = model.covariance
    shown, variance = _mean(betas, single)
    if len(fits) > 1:
        off = betas - shown
        scatter = np.einsum("ni,nij,nj", off, np.linalg.inv(single), off) / (off.size - own.size)
        variance = variance * max(1.0, float(scatter))
        # Trips over one line share the errors of its gradients.
        variance = variance + np.mean([fit.own_survey for fit in fits], axis=0) / factor**2
    freedom = float(sum(fit.freedom for fit in fits))
    return _coefficient(own, shown, common + variance, freedom)


def _mean(values: FloatArray, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted mean (3,) of values (n, 3), and its covariance."""
    weights = np.linalg.inv(variances)
    variance = np.linalg.inv(weights.sum(axis=0))
    return variance @ np.einsum("nij,nj->i", weights, values), variance


def _coefficient(
    own: FloatArray, shown: FloatArray, spread: FloatArray, freedom: float
) -> Wrong | None:
    """The coefficient whose change explains most of the difference; None if there is none."""
    precision = np.linalg.inv(spread)
    off = own - shown
    whole = float(off @ precision @ off)
    size = own.size
    if whole < size * f_distribution.ppf(SURE, size, freedom):
        return None
    changes = (precision @ off) / np.diag(precision)
    left = whole - changes**2 * np.diag(precision)
    best = int(np.argmin(left))
    true = own - changes
    if left[best] > (size - 1) * f_distribution.ppf(SURE, size - 1, freedom):
        scale = float(own @ precision @ shown / (own @ precision @ own))
        std = float(1.0 / np.sqrt(own @ precision @ own))
        return Wrong("running resistance", 1.0 / scale, std / scale**2)
    factor = own[best] / true[best] if true[best] > 0.0 else np.inf
    if 1.0 / LEAST_FACTOR < factor < LEAST_FACTOR:
        return None
    std = float(factor / max(true[best], 1e-9) / np.sqrt(precision[best, best]))
    others = [TERMS[row] for row in range(size) if row != best and left[row] < left[best] + ALIKE]
    if TERMS[1] in (TERMS[best], *others):
        # Air resistance of a wind w is r2 (v + w)²: to the motion it is a linear term.
        others.append(f"a head wind of {-changes[1] / (2.0 * max(shown[2], 1e-9)):.0f} m/s")
    return Wrong(TERMS[best], float(factor), std, tuple(others))


SLOWEST = 5.0
"""Below this speed [m/s] the recorded one is taken: what a brake does there is not known."""

SPEED_STD = 0.03
"""Standard deviation of the smoothed speed at the ends of a section [m/s]."""

GRADIENT_STD, GRADIENT_LENGTH = 0.2e-3, 1000.0
"""Error of gradients, and the length [m] it holds for, where the line states none."""

BRAKED = 0.05
"""Deceleration [m/s²] without traction, beyond resistance and gradient, that a brake which is not
recorded has caused."""

SAID_GAIN = 0.005
"""Gain of recorded efforts beside 1 from which it is stated."""

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
    load: float | None

    @property
    def windy(self) -> bool:
        """Whether the head wind is recorded."""
        return "head_wind" in self.driven.signals

    @property
    def efforts(self) -> bool:
        """Whether efforts are recorded."""
        return "traction" in self.driven.sums

    @property
    def unrecorded_brakes(self) -> str:
        """Brakes of the train whose efforts are not recorded beside the traction, in words."""
        train, sums = self.model.train, self.driven.sums
        brakes = {
            "dynamic_braking": ("motor", train.max_dynamic_braking_effort),
            "pneumatic_braking": ("friction", train.max_pneumatic_braking_effort),
        }
        missing = [word for name, (word, most) in brakes.items() if most and name not in sums]
        return " and ".join(missing) if self.efforts else ""

    @property
    def inertia(self) -> float:
        """Of the train, its rotating masses included [kg]."""
        return self.mass.value + self.model.train.rotating_mass

    @property
    def slope(self) -> tuple[float, float]:
        """Standard deviation of the gradients, and the length [m] over which they err alike."""
        survey = self.driven.line.survey
        if survey is None:
            return GRADIENT_STD, GRADIENT_LENGTH
        return survey.gradient_std, survey.correlation_length or GRADIENT_LENGTH

    @cached_property
    def fit(self) -> TripFit | str:
        """Of the trip by itself; or why there is none."""
        try:
            # A curve that is known roughly still contradicts one that is far off.
            return fit_trip(self.trip, largest_std=np.inf)
        except TrainlogError as error:
            return str(error).partition(";")[0]


def inputs_of(view: TripView, model: ParameterSet | Train, wind_std: float | None) -> Inputs:
    """The trip and the model as they are compared; errors as `calculate`."""
    trip, train, known = view.trip, view.train, estimated_passport(view)
    delay = known.motion_delay.value if known.effort_delay.source == "estimated" else 0.0
    # Efforts are corrected here, not once more by a stored passport.
    bare = replace(
        with_effort_delay(trip, delay),
        attachments={k: v for k, v in trip.attachments.items() if k != "passport.json"},
    )
    driven = driven_trip(bare)
    scale = scale_of(view) if "/train/state" in trip else None
    factor = 1.0 if scale is None else scale.factor
    gain = known.effort_gain if known.effort_gain.known else UNCALIBRATED
    load = recorded_load(bare, train)
    weighed = None if load is None else load.value
    if wrong_mass(train, [(weighed, gain)]) is not None:
        gain = UNCALIBRATED  # found with that mass, it would hide what is wrong
    sums = {
        name: values / (gain.value * factor) if "unknown" not in name else values
        for name, values in driven.sums.items()
    }
    # The signals, with the head wind at all samples or not at all, as the fit takes it.
    signals = {name: values for name, values in driven.signals.items() if name != "head_wind"}
    stamps = driven.departure + np.rint(driven.time * NANOSECONDS).astype(np.int64)
    wind = recorded_head_wind(bare, pd.DatetimeIndex(stamps, tz="UTC"))
    driven = replace(
        driven,
        speed=driven.speed / factor,
        sums=sums,
        signals=(signals if wind is None else signals | {"head_wind": wind}),
    )
    windy = "head_wind" in driven.signals
    wind_std = (RECORDED_WIND if windy else HEAD_WIND) if wind_std is None else wind_std
    fitted = model if isinstance(model, ParameterSet) else None
    forces = ForceModel.of(train, driven.line, fitted, wind_std)
    return Inputs(
        bare,
        driven,
        forces,
        _mass(load, train, model),
        gain,
        known.effort_gain,
        0.0 if scale is None else scale.std,
        wind_std,
        weighed,
    )


def _mass(load: Quantity | None, train: Train, model: ParameterSet | Train) -> Quantity:
    """Mass of the loaded train: by the recorded load, else what the fit saw, else half the load."""
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

    `unknown` are cells without efforts or speed, `speedless` those of them without speed;
    `inferred` those whose braking follows from the motion, for want of a record.
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
    sections: Sections
    section: IntArray
    unknown: BoolArray
    speedless: BoolArray
    inferred: BoolArray

    @staticmethod
    def of(inputs: Inputs) -> Cells:
        """The cells of a trip between its first and last recorded position."""
        trip, model = inputs.driven, inputs.model
        first, last = trip.covered
        if last - first < STEP:
            raise LogError(
                f"trip '{trip.name}' runs {last - first:.1f} m only",
                remedy=f"give one of at least {STEP:.0f} m",
            )
        sections = sections_between(trip.line, first, last)
        sections = replace(sections, edges=sections.edges_of(trip))
        inner = np.arange(first + STEP, last - 0.5 * STEP, STEP)
        nodes = sections.with_edges(inner, STEP)
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
        speedless = trip.share_of("unknown_speed", nodes) > 0.0
        lacks = speedless.copy()
        for name in ("traction", "dynamic_braking", "pneumatic_braking"):
            lacks |= of_cells(f"unknown_{name}") > 0.2
        cells = Cells(
            nodes,
            speed,
            speed >= SLOWEST,
            np.diff(trip.at(trip.running, nodes)),
            of_cells("traction"),
            braking,
            model.train.track_force(trip.line, middle, 1.0) * step,
            model.tunnels(middle),
            wind,
            sections,
            sections.of(middle),
            lacks,
            speedless,
            np.zeros(step.size, dtype=np.bool_),
        )
        return cells._with_unrecorded_braking(inputs) if inputs.unrecorded_brakes else cells

    def _with_unrecorded_braking(self, inputs: Inputs) -> Cells:
        """With the braking that the motion shows where none of the recorded efforts explains it."""
        train, own = inputs.model.train, inputs.model.resistance
        needed = self.needed(own, inputs.mass.value, inputs.inertia) + self.braking
        idle = self.work <= LEAST_EFFORT * train.max_tractive_effort * self.step
        braked = idle & ~self.unknown & (needed < -BRAKED * inputs.inertia * self.step)
        braking = np.where(braked, self.braking - needed, self.braking)
        return replace(self, braking=braking, inferred=braked)

    @property
    def inside_gap(self) -> BoolArray:
        """Nodes at which the speed is not known."""
        none = self.speedless
        return np.asarray(np.append(none, False) & np.append(False, none), dtype=np.bool_)

    @property
    def step(self) -> FloatArray:
        """Lengths of the cells [m]."""
        return np.diff(self.nodes)

    def by_section(self, values: ArrayLike) -> FloatArray:
        """Sums over the cells of each section."""
        count = self.sections.edges.size - 1
        return np.bincount(self.section, values, count).astype(np.float64)

    @property
    def squared(self) -> FloatArray:
        """Mean speed squared of each cell [m²/s²]."""
        return 0.5 * (self.speed[1:] ** 2 + self.speed[:-1] ** 2)

    def resisting(self, resistance: RunningResistance) -> FloatArray:
        """Running resistance, that of tunnels and of the recorded wind included [N]."""
        speed = np.sqrt(self.squared)
        through_wind = resistance.r2 * self.wind * (2.0 * speed + self.wind)
        return np.asarray(resistance(speed) + self.tunnels * self.squared + through_wind)

    def needed(self, resistance: RunningResistance, mass: float, inertia: float) -> FloatArray:
        """Work [J] that the motion needs of a train without and with rotating masses [kg]."""
        kinetic = 0.5 * inertia * np.diff(self.speed**2)
        return np.asarray(kinetic + self.resisting(resistance) * self.step + mass * self.track)

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


def predicted(inputs: Inputs, cells: Cells) -> tuple[pd.DataFrame, FloatArray, FloatArray]:
    """Times and works by section with their bands, and the calculated speeds with theirs."""
    # The model as it is, and one standard deviation of each thing off that is not known of it.
    model, mass, gain = inputs.model, inputs.mass, inputs.gain
    gain_std = gain.std / gain.value if np.isfinite(gain.std) else UNCALIBRATED.std
    own = np.append(model.resistance.coefficients, [mass.value, 1.0, 0.0, 0.0])
    curve, off = len(TERMS), np.zeros((own.size, own.size))
    off[:curve, :curve] = model.principal_axes
    off[curve:, curve:] = np.diag([mass.std, gain_std, inputs.slope[0], SPEED_STD])
    steps = own + np.vstack([np.zeros(own.size), off, -off])
    works = np.array([_work(inputs, cells, each) for each in steps])
    times, speeds = zip(*(_driven(inputs, cells, each) for each in steps), strict=True)
    fast = np.zeros(cells.step.size, dtype=np.bool_)
    for begin, end in cells.runs():
        fast[begin:end] = True
    # Where nothing is calculated, the recorded time counts.
    rest = cells.by_section(cells.running * ~fast)
    lacks = cells.by_section(cells.unknown) > 0
    speed = np.array(speeds)
    squares = np.where(fast, (speed[0][1:] - cells.speed[1:]) ** 2 * cells.step, 0.0)
    length = np.maximum(cells.by_section(cells.step * fast), 1e-9)
    recorded = cells.by_section(cells.work if inputs.efforts else np.full(fast.size, np.nan))
    table = pd.DataFrame(
        {
            "first": cells.sections.edges[:-1],
            "last": cells.sections.edges[1:],
            "time": cells.by_section(cells.running),
            "calculated_time": times[0] + rest,
            "time_std": _spread(np.array(times)),
            "speed_rms": np.sqrt(cells.by_section(squares) / length),
            "work": np.where(lacks, np.nan, recorded),
            "calculated_work": np.where(lacks, np.nan, works[0]),
            "work_std": np.where(lacks, np.nan, _spread(works)),
        },
        index=pd.Index(cells.sections.names, name="section"),
    )
    if not inputs.efforts:
        table[["calculated_time", "time_std", "speed_rms"]] = np.nan
    spread = _spread(speed)
    # Between runs nothing is calculated.
    inside = np.append(fast, False) | np.append(False, fast)
    calculated = np.where(inside, speed[0], np.nan)
    wide = inside & (1.96 * spread >= calculated)  # down to a stand
    wide_in = cells.by_section(wide[1:]) > 0
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


def _work(inputs: Inputs, cells: Cells, at: FloatArray) -> FloatArray:
    """Tractive work [J] that each section's recorded motion needs; `at`: a row of `predicted`."""
    mass, gain, slope, start = at[-4:].tolist()
    inertia = mass + inputs.model.train.rotating_mass
    needed = cells.needed(RunningResistance.of(at[:-4]), mass, inertia)
    if inputs.efforts:
        # What is not known of the gain is not known of the measured work, too.
        needed = needed + cells.braking * (2.0 - gain) - cells.work * (gain - 1.0)
    else:
        needed = np.maximum(needed, 0.0)
    found = cells.by_section(needed)
    uneven = np.sqrt(inputs.slope[1] * np.diff(cells.sections.edges))
    top = np.sqrt([cells.squared[cells.section == row].max() for row in range(found.size)])
    found += slope * GRAVITY * mass * uneven + start * inertia * top
    return np.asarray(found + 2.0 * inputs.scale_std * (start > 0.0) * np.abs(found))


def _driven(inputs: Inputs, cells: Cells, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Time of each section [s] and speed at the nodes [m/s] with the recorded efforts."""
    mass, gain, slope, start = at[-4:].tolist()
    speed, times = cells.speed.copy(), np.zeros(cells.sections.edges.size - 1)
    inertia = mass + inputs.model.train.rotating_mass
    constant, linear, quadratic = RunningResistance.of(at[:-4]).parabola
    force = (cells.work - cells.braking) / cells.step / gain
    force = force - mass * cells.track / cells.step - constant - quadratic * cells.wind**2
    through, air = linear + 2.0 * quadratic * cells.wind, quadratic + cells.tunnels
    for begin, end in cells.runs():
        part, step = slice(begin, end), cells.step[begin:end]
        ran = np.cumsum(step)
        lost = slope * GRAVITY * mass * np.sqrt(inputs.slope[1] * ran) / ran
        first = (cells.speed[begin] + start) ** 2
        found = _speeds(first, force[part] - lost, step, through[part], air[part], inertia)
        speed[begin + 1 : end + 1] = found[1:]
        times[cells.section[begin]] += float(np.sum(2.0 * step / (found[1:] + found[:-1])))
    return times, speed


def _speeds(
    first: float,
    push: FloatArray,
    step: FloatArray,
    linear: FloatArray,
    quadratic: FloatArray,
    inertia: float,
) -> FloatArray:
    """Speeds [m/s] at the nodes of a run; `push` is what does not depend on speed [N].

    The quadratic term decays exponentially in position, exactly; the linear one is iterated.
    """
    decay = np.concatenate(([0.0], np.cumsum(2.0 * quadratic / inertia * step)))
    growth = np.exp(np.minimum(0.5 * (decay[1:] + decay[:-1]), 500.0))
    speed = np.full(step.size, np.sqrt(first))
    for _ in range(8):
        drive = 2.0 / inertia * (push - linear * speed) * step
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
    if not known.any():
        return {}, 0.0

    def summed(values: FloatArray) -> FloatArray:
        return np.asarray(np.bincount(window, values, count) * known, dtype=np.float64)

    kinetic = 0.5 * np.diff(cells.speed**2)
    net = cells.work - cells.braking
    expected = cells.needed(model.resistance, inputs.mass.value, inputs.inertia)
    residual = summed(net - expected)
    mass_std = inputs.mass.std
    root = model.principal_axes.T
    if model.name != FIT:
        root = np.diag(FILE_TRUST * model.resistance.coefficients)
        mass_std = max(mass_std, FILE_MASS * inputs.mass.value)
    powers = np.stack([summed(step * column) for column in basis(speed).T], axis=1)
    gain_std = inputs.gain.std / inputs.gain.value
    length = np.maximum(summed(step), 1e-9)
    edge = inputs.inertia * np.sqrt(2.0) * SPEED_STD * summed(step * speed) / length
    noise = np.hypot(edge, 0.01 * summed(np.abs(net))) + 1.0 * ~known
    tilt = np.eye(count) * (GRAVITY * inputs.mass.value * summed(step))[:, None]
    causes = [Free("running resistance", column, 1.0) for column in (powers @ root).T]
    # What the motion under recorded efforts shows is the ratio of the two.
    name = "mass or gain of efforts"
    causes += [
        Free(name, summed(kinetic + cells.track), mass_std),
        Free(name, summed(net), gain_std),
    ]
    causes += [Free("gradients", column, GRADIENT_STD) for column in tilt.T]
    found = regress(residual / noise, [replace(c, column=c.column / noise) for c in causes])
    total = float(residual @ residual)
    shares, left = dict[str, float](), residual.copy()
    for cause, size in zip(causes, found.estimate.tolist(), strict=True):
        part = size * cause.column
        shares[cause.name] = shares.get(cause.name, 0.0) + float(part @ residual) / total
        left -= part
    slipped = np.zeros(count, dtype=np.bool_)
    slipped[window[inputs.driven.share_of("slip", cells.nodes) > 0.0]] = True
    shares["slip"] = float(left[slipped] @ residual[slipped]) / total
    shares["unexplained"] = float(left[~slipped] @ residual[~slipped]) / total
    return shares, float(np.sqrt(total / count))


def _calculated(row: Mapping[str, Any], name: str) -> Band | str:
    determined = row[f"{name}_determined"]
    return Band(row[f"calculated_{name}"], row[f"{name}_std"]) if determined else "not determined"


def _off(row: Mapping[str, Any]) -> Said | None:
    off = row["work"] / row["calculated_work"] - 1.0 if row["calculated_work"] else math.nan
    known = math.isfinite(off) and row["work_determined"]
    return Said(off, f"{off:+.1%}") if known else None


SECTIONS = (
    Column("section"),
    Column("time measured", DURATION, of="time"),
    Column("calculated", DURATION, of=lambda row: _calculated(row, "time")),
    Column(
        "speed off (RMS)",
        SPEED,
        of=lambda row: row["speed_rms"] if row["time_determined"] else None,
    ),
    Column("wheels measured", ENERGY, of="work"),
    Column("calculated", ENERGY, of=lambda row: _calculated(row, "work")),
    Column("off", SHARE, of=_off),
)
"""Of a section of a trip: measured and calculated time and work."""


@dataclass(frozen=True, eq=False, repr=False)
class Calculation(Presented):
    """A recorded trip beside what a model calculates for it.

    Attributes
    ----------
    table : DataFrame
        By section, SI units: ``first``, ``last`` [m]; ``time`` (in motion), ``calculated_time``,
        ``time_std`` [s]: up to `SLOWEST` and in gaps of the recording the recorded time counts;
        ``speed_rms`` [m/s] of the difference; ``work``, ``calculated_work``, ``work_std`` [J]:
        tractive work at the wheel rims, NaN where speed or efforts are not known;
        ``time_determined``, ``work_determined``: whether half a band is at most `WIDEST` of its
        value, and for a time no speed on the way down to 0.
    position, speed, calculated_speed, speed_std : (n,) array [m], [m/s]
        Where `SLOWEST` was exceeded; NaN elsewhere.
    explained : dict of str to float
        Share of the squared residual work, in windows of `WINDOW`, that each cause explains; what
        is left is ``"unexplained"``. They add up to 1.
    residual : float [J]
        Root mean square of the residual work in a window.
    diagnosis : Diagnosis
        What of the model is wrong, as far as the trip shows it.
    inputs : Inputs
        On which that rests; for `judged_together`.
    notes : tuple of str
    """

    charts_by: ClassVar[str] = "analysis.comparison.plot:calculation_charts"

    table: pd.DataFrame
    position: FloatArray
    speed: FloatArray
    calculated_speed: FloatArray
    speed_std: FloatArray
    explained: dict[str, float]
    residual: float
    diagnosis: Diagnosis
    inputs: Inputs
    notes: tuple[str, ...] = ()

    @property
    def trip(self) -> str:
        """Name of the trip."""
        return self.inputs.driven.name

    @property
    def model(self) -> str:
        """Where the resistance is from."""
        return self.inputs.model.name

    @property
    def line(self) -> Line:
        """As travelled: its kilometres are shown."""
        return self.inputs.driven.line

    @property
    def title(self) -> str:
        """Trip and model."""
        return f"Trip '{self.trip}' against the {self.model}"

    def facts(self) -> dict[str, Any]:
        """What explains the residuals, and what of the model is wrong."""
        return {
            "trip": self.trip,
            "model": self.model,
            "outside": self.outside,
            "verdict": self.words,
            "explained": self.explained,
            "residual_rms_J": self.residual,
            "wind_recorded": self.inputs.windy,
            "wind_std_m_s": self.inputs.wind_std,
            **asdict(self.diagnosis),
        }

    def tables(self) -> list[WordTable]:
        """Sections, and what explains the residuals."""
        sections = new_table(
            f"{self.title}: ± is half the 95 % band",
            *SECTIONS,
            name="sections",
            frame=with_units(self.table.reset_index()),
        ).add_rows(self.table.reset_index().to_dict("records"))
        title = f"Residuals: {self.residual / JOULES_PER_KWH:.3f} kWh (RMS) in 500 m; explained by"
        of: Columns[tuple[str, float]] = {
            "cause": lambda row: row[0],
            "share": lambda row: f"{row[1]:.0%}",
        }
        explained = word_table(title, self.explained.items(), of)
        return [sections, *([explained] if self.inputs.efforts else [])]

    def sentences(self) -> list[str]:
        """What the model does not determine, and what the trip contradicts."""
        alarms = f"about {self.diagnosis.false_alarms:.0%} of trips contradict a right one"
        return [
            *(
                f"the {self.model} does not determine the {quantity} of {', '.join(sections)}: half"
                f" the 95 % band is more than {WIDEST:.0%} of the value, or reaches down to a stand"
                for quantity, sections in self.not_determined.items()
            ),
            f"bands: {self.wind_words}; a day's wind that is known better is stated by --wind",
            f"{self.model} against trip '{self.trip}': {self.words} ({alarms})",
            *(f"{self.trip}: {note}" for note in self.notes),
        ]

    def summary(self) -> dict[str, str]:
        """Work and time, calculated and measured."""
        rows, table = {}, self.table

        def stated(words: str, known: pd.Series) -> str:
            number, of = int(known.sum()), len(known)
            words += f" on {number} of {of} sections" * (number < of)
            return words if number else "not determined"

        # What a trip has in common errs alike in all sections.
        total, std = self.total("calculated_work"), self.total("work_std")
        work = f"{total / JOULES_PER_KWH:.1f} ± {1.96 * std / JOULES_PER_KWH:.1f} kWh calculated"
        if self.inputs.efforts:
            work += f", {self.total('work') / JOULES_PER_KWH:.1f} kWh measured"
        rows["tractive work"] = stated(work, table["work_std"].notna())
        if self.inputs.efforts:
            sure = table[table["time_determined"]]
            times = float(sure["calculated_time"].sum()), float(sure["time"].sum())
            time = f"{times[0]:.0f} s calculated, {times[1]:.0f} s measured"
            rows["running time"] = stated(time, table["time_determined"])
            shares = sorted(self.explained.items(), key=lambda item: -item[1])
            rows["residuals"] = ", ".join(f"{name} {share:.0%}" for name, share in shares[:4])
        rows["wind"] = self.wind_words
        rows["model"] = self.words
        return rows

    @property
    def words(self) -> str:
        """What the trip contradicts of the model, in a sentence."""
        if not self.outside:
            return self.diagnosis.words
        where = f"contradicted in {', '.join(self.outside)} (outside of the 95 % band)"
        if self.diagnosis.wrong:
            return f"{where}: {self.diagnosis.words}"
        reason = self.diagnosis.not_judged
        return where + (
            f"; which coefficient is {self.diagnosis.words}"
            if reason
            else "; no coefficient or mass by itself explains it"
        )

    @property
    def not_determined(self) -> dict[str, list[str]]:
        """By quantity, the sections of which the model says less than half."""
        found = {
            words: self.table.index[~self.table[f"{name}_determined"]].tolist()
            for name, words in (("time", "running time"), ("work", "tractive work"))
        }
        return {words: sections for words, sections in found.items() if sections}

    @property
    def wind_words(self) -> str:
        """What the bands assume of the wind, in words."""
        known = "recorded" if self.inputs.windy else "not recorded"
        return f"head wind {known}, ± {1.96 * self.inputs.wind_std:.1f} m/s assumed"

    def total(self, column: str) -> float:
        """Sum of a column of the table."""
        return float(self.table[column].sum())

    @property
    def outside(self) -> list[str]:
        """Sections whose measured time or work lies outside of the 95 % band."""
        if not self.inputs.efforts:
            return []
        table = self.table
        times = (table["time"] - table["calculated_time"]).abs() > 1.96 * table["time_std"]
        works = (table["work"] - table["calculated_work"]).abs() > 1.96 * table["work_std"]
        return table.index[times | works].tolist()


def calculate(
    trip: Given,
    model: ParameterSet | Train | FitOfTrips | TripFit,
    *,
    wind_std: float | None = None,
) -> Calculation:
    """What a fit or a train's file predicts for a recorded trip, section by section.

    Parameters
    ----------
    trip : Trip or path
        With its line and train; with efforts, or else only its energy is calculated.
    model : ParameterSet, Fits, TripFit or Train
        A fit of trips or of one trip: its common curve, with what trips differ by. A train's
        file: at its word, with what trips differ by
        (`analysis.comparison.energy.trip_spread`); its mass counts as well.
    wind_std : float [m/s], optional
        Standard deviation of the head wind as far as it is not recorded, as for a day of known
        weather. Default: `RECORDED_WIND` where it is recorded, else `HEAD_WIND`.

    Returns
    -------
    Calculation

    Raises
    ------
    InputError
        If the fit is of another train, or the wind's standard deviation is negative.
    LogError
        If the trip lacks line, train or chainage, or runs less than 20 m.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> found = calculate("sample_logs/stopping.mcap", train)
    >>> found.diagnosis.wrong
    ()
    >>> bool(abs(found.total("work") / found.total("calculated_work") - 1.0) < 0.03)
    True
    """
    check_kind(model, ParameterSet, Train, FitOfTrips, TripFit)
    if isinstance(model, FitOfTrips):
        model = model.parameters
    elif isinstance(model, TripFit):
        model = parameter_set([model])
    view = view_of(trip)
    if isinstance(model, Train):
        attached = {**view.trip.attachments, TRAIN_ATTACHMENT: train_to_bytes(model)}
        view = TripView(replace(view.trip, attachments=attached))
    if wind_std is not None and not 0.0 <= wind_std < np.inf:
        raise InputError(
            f"a standard deviation of the head wind of {wind_std:g} m/s",
            remedy="give 0 or more, in m/s",
        )
    inputs = inputs_of(view, model, wind_std)
    cells = Cells.of(inputs)
    table, speeds, spread = predicted(inputs, cells)
    explained, residual = explained_by(inputs, cells) if inputs.efforts else ({}, 0.0)
    return Calculation(
        table=table,
        position=cells.nodes,
        speed=np.where(cells.fast & ~cells.inside_gap, cells.speed, np.nan),
        calculated_speed=np.where(cells.fast, speeds, np.nan),
        speed_std=np.where(cells.fast, spread, np.nan),
        explained=explained,
        residual=residual,
        diagnosis=diagnosed([inputs]),
        inputs=inputs,
        notes=(*inputs.driven.notes, *_notes(inputs, cells)),
    )


def _notes(inputs: Inputs, cells: Cells) -> list[str]:
    """What tunnels lack, what efforts are divided by, and which are taken from the motion."""
    brakes, ends = inputs.unrecorded_brakes, cells.nodes[[0, -1]].tolist()
    found = inputs.model.train.unknown_tunnels(inputs.model.line, *ends)
    if inputs.efforts and abs(inputs.gain.value - 1.0) > SAID_GAIN:
        found.append(
            f"recorded efforts are divided by their gain, {inputs.gain.value:.3f}, found by the"
            " motion at the mass of the train's file: the measured energy is theirs after that"
        )
    if not brakes:
        return found
    length = float(cells.step[cells.inferred].sum()) / 1e3
    return [
        *found,
        f"the effort of the {brakes} brake is not recorded: over {length:.1f} km of braking it"
        " follows from the motion and the model, which are not compared there",
    ]


def judged_together(found: Sequence[Calculation]) -> Diagnosis:
    """What several trips contradict of the model that calculated them.

    The same drive given twice counts once.

    Raises
    ------
    InputError
        If there is none, or they are of different trains.
    """
    return diagnosed([each.inputs for each in distinct(found)])


def together_words(found: Sequence[Calculation], together: Diagnosis) -> str:
    """What several trips together contradict of the model."""
    every, found = len(found), distinct(found)
    trips = counted(len(found), "trip")
    if every > len(found):
        trips += f" ({every - len(found)} given twice, counted once)"
    words = f"{found[0].model} against {trips} together: {together.words}"
    outside = [each.trip for each in found if each.outside]
    of = f"{len(outside)} of them ({', '.join(outside)})" if outside else ""
    return words + (f"; sections of {of} are outside of the 95 % band" if outside else "")


def distinct(found: Sequence[Calculation]) -> list[Calculation]:
    """One calculation of each drive."""
    kept: list[Calculation] = []
    for each in found:
        if not any(each.inputs.driven.same_drive(other.inputs.driven) for other in kept):
            kept.append(each)
    return kept
