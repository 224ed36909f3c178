"""From a trip to the arrays of the regression: what is used, what is masked and why."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Literal

import numpy as np
import pandas as pd

from analysis.view import TripView, one_way, with_chainage
from estimators.motion import smooth_motion
from trainlog.arrays import BoolArray, FloatArray, IntArray, numbered
from trainlog.errors import LogError, NotIdentifiableError
from trainlog.formats.railway import line_of
from trainlog.ingest.recording import CLOCK_RULES
from trainlog.railway.line import Line
from trainlog.railway.resistance import basis, published_tunnel_coefficient
from trainlog.railway.train import Train
from trainlog.resampling import filled, interpolated, interpolated_columns
from trainlog.spans import runs_of
from trainlog.trip import LINE_ATTACHMENT, Trip, seconds
from trainlog.units import GRAVITY

if TYPE_CHECKING:
    from analysis.resistance.fit import TripFit

Reason = Literal[
    "not recorded",
    "contradiction",
    "gap",
    "standstill",
    "braking",
    "slip",
    "too short",
    "condition",
    "excitation",
]
"""``"not recorded"``: speed, chainage or tractive effort is missing altogether.
``"contradiction"``: the speed is not that of satellites or chainage, or no load explains the motion
under the recorded efforts. ``"gap"``,
``"standstill"``, ``"braking"``, ``"slip"``: most of the trip was masked for that. ``"too short"``:
it was not, and there are too few windows all the same. ``"condition"``: speed and effort vary too
little to separate the parameters. ``"excitation"``: at some speed that was asked for the curve
is known too badly."""

EFFORT_DIPS = "effort dips"
"""Slip protection takes effort off and gives it back: all that shows where no wheel is recorded."""


@dataclass(frozen=True, eq=False)
class Timeline:
    """The trip at a glance, a row a second; (n,) arrays.

    Attributes
    ----------
    time : array [s]
    speed, position : array [m/s], [m]
    masks : dict of str to bool array
        What was masked, by reason.
    slip : str
        What the recording shows where slip is masked: speeds of wheels, or only the efforts.
    """

    time: FloatArray
    speed: FloatArray
    position: FloatArray
    masks: dict[str, BoolArray]
    slip: str = "slip"

    def named(self, reason: str) -> str:
        """A reason in words: slip by what was recorded of it.

        Examples
        --------
        >>> none = np.zeros(0)
        >>> Timeline(none, none, none, {}, "effort dips").named("slip")
        'effort dips'
        """
        return self.slip if reason == "slip" else reason

    def in_words(self, times: Mapping[str, float]) -> str:
        """How long was masked [s], for each reason for which anything was."""
        said = [
            f"{self.named(reason)} {time:.0f} s" for reason, time in times.items() if time > 0.0
        ]
        return ", ".join(said) or "nothing"


class TripRefusedError(NotIdentifiableError):
    """A trip that does not determine the curve.

    Attributes
    ----------
    reason : str
        One of `Reason`.
    timeline : Timeline or None
        What was masked; None if nothing could be made of the recording.
    fit : TripFit or None
        What the trip shows, where it shows too little: others may add to it.

    Examples
    --------
    >>> error = TripRefusedError("short", "only 90 s can be used", remedy="drive longer")
    >>> error.reason, str(error)
    ('short', 'only 90 s can be used; drive longer')
    """

    def __init__(
        self,
        reason: Reason,
        problem: str,
        *,
        place: str | None = None,
        remedy: str | None = None,
        timeline: Timeline | None = None,
    ) -> None:
        super().__init__(problem, place=place, remedy=remedy)
        self.reason: Reason = reason
        self.timeline = timeline
        self.fit: TripFit | None = None


LOWEST_SPEED = 2.0
"""Slower samples [m/s] are left out: wheel impulses are too few, drag is not Davis's."""

SLIP = 2.0
"""A wheel that differs from the train's speed by more than this [m/s] slips. Creep under heavy
traction on a wet rail stays below and does no harm: the wheels' own momentum is counted."""

PNEUMATIC = 0.0005
"""Friction braking above this share of the train's weight masks: its effort is not measured but
inferred from pressure, and 10 to 20 % wrong."""

BRAKED = 0.25
"""Deceleration [m/s²] that only a brake causes, gradient aside; used where no brake is recorded."""

READHESION = 3.0
"""A slip protection takes the effort of a wheel off and gives it back within this time [s]; by so
long before, too, the wheel may have begun to slip."""

NOTCH = 0.5
"""By so much of an axle's effort that of the train falls at least when one axle is protected."""

LEAST_EFFORT = 0.2
"""Below this share of the largest effort no wheel slips, and notches are noise."""

MARGIN = 1.0
"""Masked before and after anything that is masked [s]."""

LONGEST_GAP = 0.5
"""Longest time between two samples that is interpolated [s], longer where a topic is always
recorded less often."""

LONGEST_STEP = 1.2
"""Longest time between two samples [s] of a topic that is always recorded so seldom."""

SMOOTHING = 1.0
"""Speed is smoothed in blocks of this length [s]; masks need no finer."""

CONTROLS = (
    "tractive_effort",
    "dynamic_braking_effort",
    "pneumatic_braking_effort",
    "braking_effort_demand",
    "lever",
)
"""What is read of ``/train/controls``."""

DEMANDS = {
    "tractive_effort": "tractive_effort_demand",
    "dynamic_braking_effort": "braking_effort_demand",
    "pneumatic_braking_effort": "braking_effort_demand",
}
"""What is asked of each effort."""

MOVED = 0.05
"""Share of the largest demand by which it moves where an effort that rests is not believed."""

FEWEST_BRAKING, OFF_ZERO = 20, 0.002
"""Samples of dynamic braking that show whether the tractive effort is 0 there; and what of its
largest it may be."""

POSITION_STEP = 10.0
"""Half the distance over which the effect of a position error is measured [m]."""

LONGEST_SECTION = 1000.0
"""Pieces of the gradient profile are not taken to be longer than this [m]: surveys err anew. Longer
pieces give bands of the mass that are too narrow by half on a line of one gradient."""

RECORDED_DISTANCE = "recorded distance"
"""Source of a speed scale: a recorded distance that is corrected on the way, as at balises."""

UNCALIBRATED_SCALE_STD = 0.004
"""Standard deviation of the speed scale where nothing calibrates it: worn wheels."""

LARGEST_SCALE = 1.15
"""Recorded over true speed, or the inverse: between new and fully worn wheels the diameter differs
by 8 to 10 %."""


@dataclass(frozen=True, slots=True)
class SpeedScale:
    """Measured speed over true speed: the effect of a wrong wheel diameter.

    Attributes
    ----------
    factor, std : float
    source : str
        What it was calibrated against: ``"GNSS speed"``, ``"recorded distance"`` or ``"nothing"``.
    """

    factor: float
    std: float
    source: str


@dataclass(frozen=True, eq=False)
class Recording:
    """What the regression needs of a trip, on one clock; all (n,) arrays.

    Attributes
    ----------
    time : array [s]
        Strictly increasing.
    speed : array [m/s]
        Measured, true to scale.
    curve : (n, p) array
        What each coefficient of running resistance is multiplied by, in the recorded wind.
    effort : array [N]
        At the wheel rims: traction less braking less `tunnel`.
    braking : array [N]
        Dynamic braking effort, already taken off `effort`.
    between : array [N² s]
        Variance of the impulse, by time, of what the efforts did between two of their samples.
    rotating_momentum : array [kg m/s]
        Of the rotating parts, as masses at the wheel rims.
    slip_momentum : array [kg m/s]
        What of it the powered wheels have beyond the train's speed where they slip; 0 elsewhere.
    tunnel : array [N]
        What tunnels are expected to add to the resistance.
    track : array [m/s²]
        Deceleration by gradient and curves at the train's chainage.
    track_slope : array [m/s² per m]
        How it changes with chainage: what an error of position does.
    section : int array
        Which piece of the gradient profile the train is on.
    nearest_edge : int array
        Which change of gradient is nearest.
    usable : bool array
        False where the equation of motion is not to be trusted: braking, standstill, slip, gaps.
    """

    time: FloatArray
    speed: FloatArray
    curve: FloatArray
    effort: FloatArray
    braking: FloatArray
    between: FloatArray
    rotating_momentum: FloatArray
    slip_momentum: FloatArray
    tunnel: FloatArray
    track: FloatArray
    track_slope: FloatArray
    section: IntArray
    nearest_edge: IntArray
    usable: BoolArray


@dataclass(frozen=True, eq=False)
class Prepared(Recording):
    """A trip made ready for the regression.

    Attributes
    ----------
    index : (n,) DatetimeIndex
    scale : SpeedScale
    smooth, acceleration : (n,) array [m/s], [m/s²]
        Of the smoothed speed.
    position : (n,) array [m]
        As recorded, 0 where it is not.
    wheels : (n, axles) array [m/s]
        Speeds of the powered wheels that are recorded.
    masks : dict of str to (n,) bool array
        What is masked, by reason; reasons may overlap.
    slip_unseen : bool
        Whether wheels may slip without anything that is recorded showing it.
    slip : str
        What the recording shows where slip is masked.
    wind_recorded : bool
    """

    index: pd.DatetimeIndex
    scale: SpeedScale
    smooth: FloatArray
    acceleration: FloatArray
    position: FloatArray
    wheels: FloatArray
    masks: dict[str, BoolArray]
    slip_unseen: bool
    slip: str
    wind_recorded: bool

    @property
    def masked(self) -> dict[str, float]:
        """Time masked [s], by reason."""
        step = np.gradient(self.time)
        return {reason: float(np.sum(step[mask])) for reason, mask in self.masks.items()}

    @property
    def duration(self) -> float:
        """Of the recording [s]."""
        return float(np.sum(np.gradient(self.time)))

    @property
    def timeline(self) -> Timeline:
        """The trip at a glance."""
        time = self.time
        first = np.flatnonzero(np.diff(np.floor(time), prepend=-np.inf) > 0)
        masks = {reason: np.logical_or.reduceat(mask, first) for reason, mask in self.masks.items()}
        return Timeline(time[first], self.smooth[first], self.position[first], masks, self.slip)


def prepare(view: TripView, corrected: Trip | None = None) -> Prepared:
    """Bring a trip's topics onto one clock and mask what the equation of motion does not cover.

    What a recorder repeats while the train moves on is a gap.

    Parameters
    ----------
    view : TripView
        Of a trip with ``/train/state`` and ``/train/controls``; ``/train/axles`` and
        ``/gnss/motion`` help, and so does a head wind in ``/environment``.
    corrected : Trip, optional
        `sound` with its efforts corrected; default: as they were recorded.

    Raises
    ------
    LogError
        If a topic is missing or time does not increase.
    """
    trip = sound(view) if corrected is None else corrected
    of, train, controls = view.once(_course), view.train, trip["/train/controls"]
    there = seconds(controls, of.index[0])
    known = {name: _bridged(there, controls[name].to_numpy(np.float64)) for name in CONTROLS}
    columns = interpolated_columns(controls.assign(**known), CONTROLS, of.index)
    traction, dynamic, pneumatic, demand, lever = columns
    gap = _gaps(of.time, [trip["/train/state"], controls], of.index[0]) | ~np.isfinite(traction)
    braked = _braking(dynamic, pneumatic, demand, lever, of.acceleration + of.track, train)
    traction, dynamic = np.nan_to_num(traction), np.nan_to_num(dynamic)
    protected = _protected(of.time, traction - dynamic, of.wheels.shape[1], train)
    masks = {
        "gap": of.masks["gap"] | gap,
        "standstill": of.masks["standstill"],
        "braking": braked,
        "slip": of.masks["slip"] | protected,
    }
    return replace(
        of,
        effort=traction - dynamic - np.nan_to_num(pneumatic) - of.tunnel,
        braking=dynamic,
        between=_between(controls, there, of.time),
        masks=masks,
        usable=~widened(of.time, np.logical_or.reduce(list(masks.values()))),
    )


def effort_times(trip: Trip) -> FloatArray:
    """When the tractive effort was recorded [s]."""
    return seconds(trip["/train/controls"].dropna(subset=["tractive_effort"]))


def _between(controls: pd.DataFrame, there: FloatArray, time: FloatArray) -> FloatArray:
    """`Recording.between` at some times [s]; `there` are those of the rows.

    An effort that changes at an unknown instant between two samples bends at both of them; straight
    lines between samples then err by the change times their distance over the root of 12.
    """
    found = np.zeros(time.size)
    for name in ("tractive_effort", "dynamic_braking_effort"):
        effort = controls[name].to_numpy(np.float64)
        known = np.flatnonzero(np.isfinite(effort))
        if known.size > 2:
            at, bend = there[known], np.zeros(known.size)
            bend[1:-1] = np.diff(effort[known], n=2) ** 2 * (at[2:] - at[:-2]) / 48.0
            found += np.interp(time, at, bend)
    return found


def _course(view: TripView) -> Prepared:
    """What of a trip does not depend on its efforts."""
    trip, line, train = sound(view), view.line, view.train
    state = trip["/train/state"]
    index, time = pd.DatetimeIndex(state.index), increasing_seconds(state, trip.name)
    scale = scale_of(view)
    measured, position = (state[name].to_numpy(np.float64) for name in ("speed", "position"))
    position = _bridged(time, position)
    known = np.flatnonzero(np.isfinite(measured))
    if known.size > 1 and np.median(np.diff(known)) <= 2.0:
        # Of more that are filled in the noise would seem less than it is.
        measured = _bridged(time, measured)
    smooth, acceleration = _smoothed(time, measured / scale.factor)
    wheels = _wheel_speeds(trip, index) / scale.factor
    speed, place = np.nan_to_num(measured / scale.factor), np.nan_to_num(position)
    section, nearest = gradient_pieces(line, place)
    wind = recorded_head_wind(trip, index)
    count = wheels.shape[1]
    slip = "slip" if count else EFFORT_DIPS
    slips = _slipping(time, wheels, smooth)
    # Of wheels that are all recorded, and often, the momentum is known while they slip.
    followed = count == train.axles.count and not _seldom(time)
    # Powered axles turn at their own speed.
    turning = train.axles.rotating_mass if count == train.axles.count else 0.0
    turning = min(turning, train.rotating_mass / max(train.axles.count, 1))
    own = turning * np.where(np.isfinite(wheels), wheels - speed[:, None], 0.0).sum(axis=1)
    return Prepared(
        time=time,
        speed=speed,
        curve=basis(speed, 0.0 if wind is None else wind),
        effort=np.zeros(time.size),
        braking=np.zeros(time.size),
        between=np.zeros(time.size),
        rotating_momentum=train.rotating_mass * speed + own,
        slip_momentum=np.where(followed & widened(time, slips), own, 0.0),
        tunnel=tunnel_coefficient(train, line.tunnel_cross_section(place)) * speed**2,
        track=line.track_acceleration(place, train.strip_length),
        track_slope=track_slope(line, place, train.strip_length),
        section=section,
        nearest_edge=nearest,
        usable=np.ones(time.size, dtype=np.bool_),
        index=index,
        scale=scale,
        smooth=smooth,
        acceleration=acceleration,
        position=place,
        wheels=wheels,
        masks={
            "gap": ~np.isfinite(measured + position),
            "standstill": ~(smooth >= LOWEST_SPEED),
            "slip": slips & (not followed),
        },
        slip_unseen=_slip_unseen(time, count, train),
        slip=f"slip or {EFFORT_DIPS}" if 0 < count < train.axles.count else slip,
        wind_recorded=wind is not None,
    )


def increasing_seconds(frame: pd.DataFrame, trip: str) -> FloatArray:
    """Time of each row of a trip's topic [s] since the first.

    Raises
    ------
    LogError
        If it does not increase.
    """
    time = seconds(frame)
    stops = np.diff(time) <= 0.0
    if np.any(stops):
        raise LogError(
            f"trip '{trip}': time does not increase",
            place=f"topic {frame.attrs['topic']}, row {int(np.argmax(stops)) + 1}",
            remedy="ingest the recording again; that repairs it",
        )
    return time


def tunnel_coefficient(train: Train, cross_section: FloatArray) -> FloatArray:
    """Extra quadratic resistance [N/(m/s)²] expected in tunnels of each section [m²].

    That of the train's file; where it states none, the published one.
    """
    if train.tunnel_resistance:
        return train.tunnel_coefficient(cross_section)
    return published_tunnel_coefficient(cross_section)


def sound(view: TripView) -> Trip:
    """The trip without what its recorder repeats; an effort that rests as its demand does stays."""
    return view.once(_without_repeated)


def _without_repeated(view: TripView) -> Trip:
    found = with_chainage(view.unfrozen[0])
    before, after = view.trip["/train/controls"], found["/train/controls"]
    if after is before:
        return found
    kept: dict[str, FloatArray] = {}
    for column, asked in DEMANDS.items():
        effort = before[column].to_numpy(np.float64)
        values = after[column].to_numpy(np.float64).copy()
        demand = before[asked].to_numpy(np.float64)
        usual = np.nanmax(np.abs(demand)) if np.isfinite(demand).any() else np.inf
        for start, stop in runs_of(np.isfinite(effort) & ~np.isfinite(values)):
            if not np.ptp(demand[start:stop]) > MOVED * usual:
                values[start:stop] = effort[start:stop]
        kept[column] = values
    return found.with_topic(after.assign(**kept))


def recorded_head_wind(trip: Trip, index: pd.DatetimeIndex) -> FloatArray | None:
    """Recorded head wind [m/s] at some times: its mean.

    A gust at the instrument is not that of the whole train, and noise of a regressor makes its
    coefficient wrong. None where less than half of it is recorded: the rest may be unlike.
    """
    if "/environment" not in trip:
        return None
    frame = trip["/environment"]
    if "head_wind" not in frame or len(frame) < 2:
        return None
    if not np.isfinite(frame["head_wind"].to_numpy()).any():
        return None
    wind = interpolated(frame, "head_wind", index)
    known = np.isfinite(wind)
    if 2 * int(known.sum()) < known.size:
        return None
    return np.full(wind.size, wind[known].mean())


def check_recorded(trip: Trip) -> None:
    """Refuse a trip that lacks what no fit can do without.

    Raises
    ------
    TripRefusedError
        If no speed, no position or no tractive effort but 0 is recorded, or the line's gradients
        are not known.
    """
    for topic, column, remedy in (
        ("/train/state", "speed", "map its column"),
        (
            "/train/state", "position",
            "map its column, or ingest fixes with a line that has coordinates (--line), or with"
            " --set start_position=stations",
        ),
        ("/train/controls", "tractive_effort", "map its column, or use trainlog fit coasting"),
    ):  # fmt: skip
        if topic in trip and trip[topic][column].notna().sum() > 1:
            continue
        raise TripRefusedError(
            "not recorded",
            f"trip '{trip.name}': no {column.replace('_', ' ')} recorded",
            place=f"topic {topic}",
            remedy=f"the fit needs it: {remedy}",
        )
    if not (trip["/train/controls"]["tractive_effort"].fillna(0.0) != 0.0).any():
        raise TripRefusedError(
            "not recorded",
            f"trip '{trip.name}': the recorded tractive effort is 0 throughout",
            place="topic /train/controls",
            remedy="map the column that holds it; running resistance needs it",
        )
    _check_zero(trip)
    if LINE_ATTACHMENT in trip.attachments and "gradients" in line_of(trip).assumed:
        raise TripRefusedError(
            "not recorded",
            f"trip '{trip.name}': the gradients of line '{line_of(trip).name}' are not known",
            remedy="build the line from rides whose receivers give altitudes, or state its"
            " gradients; a level line is imported with --gradients-known",
        )


def _check_zero(trip: Trip) -> None:
    """Refuse a tractive effort that is not 0 while the motors brake: it would be resistance."""
    controls = trip["/train/controls"]
    names = ("tractive_effort", "dynamic_braking_effort")
    traction, dynamic = (controls[name].to_numpy(np.float64) for name in names)
    largest = np.nanmax(dynamic) if np.isfinite(dynamic).any() else 0.0
    braking = np.isfinite(traction) & (dynamic > MOVED * largest)
    if np.count_nonzero(braking) < FEWEST_BRAKING:
        return
    rest = float(np.median(traction[braking]))
    if rest > OFF_ZERO * np.nanmax(traction):
        raise TripRefusedError(
            "contradiction",
            f"trip '{trip.name}': the recorded tractive effort is {rest / 1e3:.2g} kN while the"
            " dynamic brake acts",
            place="topic /train/controls",
            remedy="correct its zero (offset in the profile), or map traction without braking",
        )


def scale_of(view: TripView) -> SpeedScale:
    """`speed_scale` of a trip's ``/train/state``."""
    return view.once(_scale)


def _scale(view: TripView) -> SpeedScale:
    state = view.located["/train/state"]
    time = seconds(state)
    speed, position = (state[name].to_numpy(np.float64) for name in ("speed", "position"))
    known = np.isfinite(speed + position)
    if known.sum() > 1:
        line = view.line if LINE_ATTACHMENT in view.trip.attachments else None
        try:
            one_way(view.name, line, time[known], speed[known], position[known])
        except LogError as error:
            raise TripRefusedError(
                "contradiction", error.problem, place=error.place, remedy=error.remedy
            ) from error
    return speed_scale(view.trip, time, speed, position)


def speed_scale(
    trip: Trip, time: FloatArray, speed: FloatArray, position: FloatArray
) -> SpeedScale:
    """Measured over true speed, from satellites or from recorded distance that balises correct.

    Where ingest repaired or suspected the clock, distance says nothing about the speed. A scale
    error of 0.3 % shifts a well-determined curve by more than its band; it is taken out where it
    can be and charged to the band where it cannot.

    Parameters
    ----------
    trip : Trip
    time, speed, position : (n,) array [s], [m/s], [m]
        Since the first sample of ``/train/state``; NaN what is missing.

    Raises
    ------
    TripRefusedError
        If the speed differs from satellites or chainage by more than any wheel does.
    """
    known = np.isfinite(speed)
    scale = SpeedScale(1.0, UNCALIBRATED_SCALE_STD, "nothing")
    if "/gnss/motion" in trip and np.count_nonzero(known) > 1:
        scale = _scale_by_satellites(trip, time[known], speed[known]) or scale
    if scale.source == "nothing":
        both = known & np.isfinite(position)
        scale = _scale_by_distance(time[both], speed[both], position[both]) or scale
    if not 1.0 / LARGEST_SCALE <= scale.factor <= LARGEST_SCALE:
        against = "satellites" if scale.source == "GNSS speed" else "the chainage"
        raise TripRefusedError(
            "contradiction",
            f"trip '{trip.name}': the recorded speed is {scale.factor:.2f} times that of"
            f" {against}, which no wear of wheels explains",
            place="topic /train/state",
            remedy="check its unit, and that the sensor worked",
        )
    doubtful = any(f"repair.{rule}" in trip.metadata for rule in CLOCK_RULES)
    if scale.source == RECORDED_DISTANCE and doubtful:
        return SpeedScale(1.0, UNCALIBRATED_SCALE_STD, "nothing")
    return scale


def _scale_by_satellites(trip: Trip, time: FloatArray, speed: FloatArray) -> SpeedScale | None:
    """Recorded speed over that of satellites; None where too few of them are recorded."""
    motion = trip["/gnss/motion"]
    there = seconds(motion, pd.DatetimeIndex(trip["/train/state"].index)[0])
    gnss = motion["speed"].to_numpy(np.float64)
    own = np.interp(there, time, speed, left=np.nan, right=np.nan)
    both = (own > 5.0) & (gnss > 5.0)
    own, gnss = own[both], gnss[both]
    if own.size < 300:
        return None
    rest = own - float(np.median(own / gnss)) * gnss
    fitting = np.abs(rest) < 8.0 * np.median(np.abs(rest)) + 1e-9
    own, gnss = own[fitting], gnss[fitting]
    ratio = float(own @ gnss / (gnss @ gnss))
    # Twice: neighbouring fixes share part of their error.
    return SpeedScale(
        ratio, 2.0 * float(np.std(own - ratio * gnss) / np.sqrt(gnss @ gnss)), "GNSS speed"
    )


def _scale_by_distance(
    time: FloatArray, speed: FloatArray, position: FloatArray
) -> SpeedScale | None:
    """Recorded speed over that of a chainage which is corrected on the way; None if it is not."""
    took = np.diff(time)
    pairs = took <= max(LONGEST_STEP, 3.0 * float(np.median(took))) if took.size else took > 0.0
    travelled = 0.5 * (speed[1:] + speed[:-1]) * took
    steps = np.diff(position) - travelled
    corrections = steps[(np.abs(steps) > 0.5) & pairs]
    distance = float(np.sum(np.diff(position)[pairs]))
    if not distance > 5000.0 or corrections.size < 3:
        return None
    # What was not yet corrected at the end is about as large as one correction.
    std = float(np.std(corrections)) / distance + 5e-5
    return SpeedScale(float(np.sum(travelled[pairs])) / distance, std, RECORDED_DISTANCE)


def _smoothed(time: FloatArray, speed: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Smoothed speed and acceleration at each sample.

    Masks that follow the noise would select it.
    """
    known = np.isfinite(speed)
    block = np.floor(time / SMOOTHING).astype(np.int64)
    block -= block[0]
    count = np.bincount(block[known])
    filled = count > 0
    mean_time = np.bincount(block[known], time[known])[filled] / count[filled]
    mean_speed = np.bincount(block[known], speed[known])[filled] / count[filled]
    if mean_time.size < 2:
        return speed, np.zeros(time.size)
    motion = smooth_motion(mean_time, mean_speed, 0.05)
    return (
        np.interp(time, mean_time, motion.speed),
        np.interp(time, mean_time, motion.acceleration),
    )


def _wheel_speeds(trip: Trip, index: pd.DatetimeIndex) -> FloatArray:
    """Speeds of the powered wheels (n, axles) [m/s]; no columns if none are recorded."""
    if "/train/axles" not in trip:
        return np.empty((len(index), 0))
    axles = trip["/train/axles"]
    names = [name for name in axles.columns if name.startswith("wheel_speed_")]
    columns = interpolated_columns(axles, names, index)
    known = [column for column in columns if np.isfinite(column).any()]
    return np.column_stack(known) if known else np.empty((len(index), 0))


def recorded_wheels(trip: Trip) -> int:
    """Number of powered wheels whose speeds are recorded, of any sample."""
    if "/train/axles" not in trip:
        return 0
    return int(trip["/train/axles"].filter(like="wheel_speed_").notna().any().sum())


def _braking(
    dynamic: FloatArray,
    pneumatic: FloatArray,
    demand: FloatArray,
    lever: FloatArray,
    acceleration: FloatArray,
    train: Train,
) -> BoolArray:
    """Where the braking effort is not known well enough.

    The dynamic brake is measured like traction and stays in; the friction brake masks. If either
    is not recorded, or the dynamic brake is 0 throughout, any demand for braking masks; without
    that, a deceleration (the track's part taken off) that only a brake can cause.
    """
    threshold = PNEUMATIC * GRAVITY * train.mass
    mask = np.nan_to_num(pneumatic) > threshold
    unknown = ~np.isfinite(dynamic) | ~np.isfinite(pneumatic) | ~np.any(dynamic > 0.0)
    asked = (np.nan_to_num(demand) > threshold) | (np.nan_to_num(lever) < -0.02)
    unrecorded = ~np.isfinite(demand) & ~np.isfinite(lever)
    return np.asarray(mask | (unknown & np.where(unrecorded, acceleration < -BRAKED, asked)))


def _slipping(time: FloatArray, wheels: FloatArray, smooth: FloatArray) -> BoolArray:
    """Where a powered wheel turns at another speed than the train moves, beyond creep."""
    width = min(max(1, round(LONGEST_GAP / float(np.median(np.diff(time))))), time.size)
    kernel = np.ones(width) / width
    mask = np.zeros(time.size, dtype=bool)
    for wheel in wheels.T:
        difference = np.nan_to_num(wheel - smooth)
        mask |= np.abs(np.convolve(difference, kernel, mode="same")) > SLIP
    return mask


def _protected(time: FloatArray, effort: FloatArray, recorded: int, train: Train) -> BoolArray:
    """Where a slip protection acts on wheels of which fewer are `recorded` than are powered.

    While a wheel runs up, a part of its effort accelerates the wheel and not the train; that part
    comes back when effort, and weight in the fit, are lower. Running resistance at low speeds is
    2 to 8 % too low if that stays in. The protection shows in the recorded effort: it takes that of
    an axle off and gives it back, a notch that the morphological closing fills (a black top-hat).
    Samples further apart than a sixth of `READHESION` do not show it.
    """
    from scipy.ndimage import grey_closing, uniform_filter1d

    if time.size < 2 or recorded >= train.axles.count or _slip_unseen(time, recorded, train):
        return np.zeros(time.size, dtype=bool)
    step = float(np.median(np.diff(time)))
    size = uniform_filter1d(np.abs(np.nan_to_num(effort)), max(round(0.1 * READHESION / step), 1))
    filled = grey_closing(size, max(round(READHESION / step), 1))
    axle = np.maximum(filled, LEAST_EFFORT * train.max_tractive_effort) / max(train.axles.count, 1)
    marked = np.concatenate(([0], np.cumsum(filled - size > NOTCH * axle)))
    last = np.searchsorted(time, time + READHESION, side="right")
    return np.asarray(marked[last] > marked[:-1])


def _slip_unseen(time: FloatArray, recorded: int, train: Train) -> bool:
    """Whether wheels may slip without anything that is recorded showing it."""
    return _seldom(time) and recorded < train.axles.count


def _seldom(time: FloatArray) -> bool:
    """Whether samples are too far apart to show the course of a slip."""
    return time.size > 1 and 6.0 * float(np.median(np.diff(time))) > READHESION


def _gaps(time: FloatArray, frames: list[pd.DataFrame], origin: pd.Timestamp) -> BoolArray:
    """Samples that lie in, or just after, a gap of one of the topics."""
    mask = np.zeros(time.size, dtype=bool)
    for frame in frames:
        there = seconds(frame, origin)
        after = np.clip(np.searchsorted(there, time, side="left"), 0, there.size - 1)
        before = np.clip(np.searchsorted(there, time, side="right") - 1, 0, there.size - 1)
        mask |= (there[after] - there[before] > _longest_gap(there)) | (there[before] > time)
        mask |= there[after] < time
    mask[1:] |= np.diff(time) > _longest_gap(time)
    return mask


def _longest_gap(time: FloatArray) -> float:
    """Longest time between samples at these times that is no gap [s]."""
    step = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    return max(LONGEST_GAP, min(1.2 * step, LONGEST_STEP))


def _bridged(time: FloatArray, values: FloatArray) -> FloatArray:
    """Values with those filled in that are missing for no longer than `_longest_gap`."""
    return filled(time, values, _longest_gap(time[np.isfinite(values)]))


def widened(time: FloatArray, mask: BoolArray) -> BoolArray:
    """The mask with `MARGIN` before and after."""
    marked = np.concatenate(([0], np.cumsum(mask)))
    first = np.searchsorted(time, time - MARGIN, side="left")
    last = np.searchsorted(time, time + MARGIN, side="right")
    return np.asarray(marked[last] > marked[first])


def track_slope(line: Line, position: FloatArray, train_length: float = 0.0) -> FloatArray:
    """Change of the track's deceleration with chainage [m/s² per m] at each position [m]."""
    ahead, behind = (
        line.track_acceleration(position + change, train_length)
        for change in (POSITION_STEP, -POSITION_STEP)
    )
    change = ahead - behind
    return np.asarray(change / (2.0 * POSITION_STEP))


def gradient_pieces(line: Line, position: FloatArray) -> tuple[IntArray, IntArray]:
    """Piece of the gradient profile at each position, and number of the nearest change.

    A piece is what one error of the survey holds for.
    """
    edges = line.gradients.positions
    changes = edges[1:]
    nearest = np.searchsorted(0.5 * (changes[1:] + changes[:-1]), position).astype(np.int64)
    if line.survey is not None and line.survey.correlation_length is not None:
        piece = np.floor(np.maximum(position, 0.0) / line.survey.correlation_length)
        return piece.astype(np.int64), nearest
    lengths = np.diff(np.append(edges, max(line.length, edges[-1] + 1.0)))
    parts = np.maximum(np.ceil(lengths / LONGEST_SECTION), 1.0).astype(np.int64)
    owner, number = numbered(parts)
    starts = edges[owner] + number * (lengths / parts)[owner]
    section = np.searchsorted(starts, position, side="right") - 1
    return section.astype(np.int64), nearest
