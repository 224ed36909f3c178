"""Slip of the powered axles over a trip: speeds, adhesion in use, and slip events.

Of a slip event only the onset measures the maximum adhesion: while the slip grows the force
between wheel and rail rises to its maximum and falls beyond it (Zhao et al., 2025, eq. 10). Every
other sample shows that the maximum is at least what is in use.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.given import Given, trip_of
from estimators.adhesion import smoothed_force
from estimators.slip import (
    SLOPE_RATE,
    SLOPE_RATE_WITHOUT_BRAKE,
    SlipDetector,
    TrainSpeed,
    impulse,
    train_speed,
)
from trainlog.display import as_html, as_text, picture, span
from trainlog.errors import LogError
from trainlog.formats.attached import line_of, train_of
from trainlog.railway.train import Train
from trainlog.resampling import interpolated
from trainlog.spans import in_spans
from trainlog.topics import ESTIMATED_ADHESION, EVENTS, STANDSTILL
from trainlog.trip import Trip, frame_of, seconds
from trainlog.units import KMH, NANOSECONDS

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

TOPICS = ("/train/state", "/train/controls", "/train/axles", "/gnss/motion", "/estimates/state")
"""What is read of a log."""

ADHESION_RATE = 0.12
"""How fast adhesion in use may wander, for the observer [1/s^0.5]: from nothing to the maximum in
a few seconds of a run-up, from the maximum to little in half a second of slip."""

SPEED_NOISE_FLOOR = 0.005
"""Least noise of a wheel speed that is assumed [m/s]."""

NOISE_SPAN = 0.4
"""Time over which differences of the observed adhesion are taken for noise [s]."""

ADHESION_NOISE_FLOOR = 0.002
"""Least noise of an observed adhesion that is assumed."""

SATELLITE_STD = 0.1
"""Standard deviation of a satellite speed that comes without one [m/s]."""

COASTING_ADHESION = 0.02
"""Adhesion in use up to which a wheel is taken to roll without creep, to compare diameters."""

CALIBRATION_SPEED = 5.0
"""Least speed at which wheel diameters are compared [m/s]."""

CALIBRATION_SAMPLES = 50
"""Least number of samples from which a wheel diameter is corrected."""

LOOK_BACK = 3.0
"""How long before the detection of slip its onset is sought [s]."""

CURVE_BEFORE, CURVE_AFTER = 1.5, 0.5
"""The creep curve is estimated from so long before the detection of slip to so long after the
largest slip [s]."""

CURVE_SPEED_STD = 0.03
"""Error of the train's speed while its axles slip [m/s]."""

PROMINENCE = 3.0
"""Standard deviations by which adhesion in use must fall on either side of a maximum."""

CUT = 0.7
"""Effort over the effort at peak slip, half a second later, below which slip protection acted."""


@dataclass(frozen=True, eq=False, repr=False)
class SlipAnalysis:
    """What the powered axles did on one trip, at the axles' own samples.

    Attributes
    ----------
    trip : str
    time : (n,) DatetimeIndex
    position : (n,) array [m]
        Chainage of the line as its file counts it, whatever the direction of the trip.
    speed, speed_std : (n,) array [m/s]
        Train speed and its standard deviation.
    slip_speed : (n, axles) array [m/s]
        Wheel speed less train speed.
    adhesion, adhesion_std : (n, axles) array
        Force between wheel and rail over axle load, positive in traction.
    slipping : (n, axles) bool array
    wheel_factor : (axles,) array
        Measured over true wheel speed, from the wheel diameter.
    events : DataFrame
        One row a slip event: ``axle`` (from 1), ``start``, ``end`` (time), ``kind``
        (``"traction"``, ``"braking"``), ``position`` [m] of the onset, ``speed`` [m/s],
        ``peak_slip`` [m/s], ``adhesion`` and ``adhesion_std`` at the onset, and ``measured``:
        whether the maximum was passed, so that the onset measures it.
    """

    trip: str
    time: pd.DatetimeIndex
    position: FloatArray
    speed: FloatArray
    speed_std: FloatArray
    slip_speed: FloatArray
    adhesion: FloatArray
    adhesion_std: FloatArray
    slipping: BoolArray
    wheel_factor: FloatArray
    events: pd.DataFrame

    def __repr__(self) -> str:
        return as_text(self._title, self._summary())

    def _repr_html_(self) -> str:
        time = (self.time - self.time[0]).total_seconds().to_numpy()
        most = np.abs(self.adhesion).max(axis=1)
        curves = {"speed [m/s]": self.speed, "adhesion in use, greatest of the axles": most}
        return as_html(self._title, self._summary(), picture(time, curves))

    @property
    def _title(self) -> str:
        minutes = (self.time[-1] - self.time[0]).total_seconds() / 60.0
        return f"Slip of {self.adhesion.shape[1]} axles on trip '{self.trip}', {minutes:.1f} min"

    def _summary(self) -> dict[str, str]:
        events = self.events
        traction = int(np.count_nonzero(events["kind"] == "traction"))
        onsets = events.loc[events["measured"], "adhesion"].to_numpy(np.float64)
        measured = f"{onsets.size} show the maximum adhesion"
        return {
            "events": f"{len(events)}, {traction} in traction and {len(events) - traction} in"
            " braking",
            "of these": measured + (f", {span(onsets, digits=3)}" if onsets.size else ""),
            "adhesion in use": f"up to {np.nanmax(np.abs(self.adhesion)):.3f}",
            "wheels": f"measure {span(self.wheel_factor, digits=4)} times the speed",
        }

    def part(self, span: tuple[int, int]) -> SlipAnalysis:
        """The samples from one instant to another [ns since 1970 UTC], and what began then."""
        rows = in_spans(self.time.as_unit("ns").asi8, np.array([span], dtype=np.int64))
        starts = pd.DatetimeIndex(self.events["start"]).as_unit("ns").asi8
        events = self.events[in_spans(starts, np.array([span], dtype=np.int64))]
        names = ("position", "speed", "speed_std", "slip_speed", "adhesion", "adhesion_std")
        samples = {name: getattr(self, name)[rows] for name in (*names, "slipping", "time")}
        return replace(self, events=events, **samples)

    def adhesion_frame(self) -> pd.DataFrame:
        """Frame of the topic ``/estimates/adhesion``."""
        return frame_of(
            ESTIMATED_ADHESION,
            self.time,
            {"adhesion": self.adhesion, "slip_speed": self.slip_speed},
        )

    def creep_curves(self) -> pd.DataFrame:
        """Adhesion characteristic of each slip event, by an unscented filter.

        Returns
        -------
        DataFrame
            With the index of `events`: ``maximum`` and ``maximum_std``, the maximum adhesion at
            the onset; ``slope`` and ``slope_std`` [s/m], the change of adhesion with slip speed at
            the largest slip, negative where the maximum was passed. NaN where too few samples show
            the curve.
        """
        # filterpy takes half a second to import; the map does without it.
        from estimators.creep_curve import estimate_creep_curve

        clock = np.asarray(self.time.as_unit("ns").asi8)
        time = (clock - clock[0]) / NANOSECONDS if clock.size else np.empty(0)
        noise = adhesion_noise(time, self.adhesion) if len(self.events) else 0.0
        slip_std = float(np.hypot(wheel_noise(self.slip_speed), CURVE_SPEED_STD))
        columns = ["maximum", "maximum_std", "slope", "slope_std"]
        found = np.full((len(self.events), 4), np.nan)
        axles = self.events["axle"].to_numpy() - 1
        signs = np.sign(self.events["peak_slip"].to_numpy())
        places = self.events["position"].to_numpy()
        starts, stops = (self.time.searchsorted(self.events[name]) for name in ("start", "end"))
        for number, (axle, sign, start, stop) in enumerate(
            zip(axles, signs, starts, stops, strict=True)
        ):
            slip = sign * self.slip_speed[:, axle]
            peak = int(start) + int(np.nanargmax(slip[start : max(stop, start + 1)]))
            first = int(np.searchsorted(time, time[start] - CURVE_BEFORE))
            part = slice(first, min(stop, int(np.searchsorted(time, time[peak] + CURVE_AFTER))))
            used = sign * self.adhesion[part, axle]
            curve = estimate_creep_curve(time[part], slip[part], used, noise, slip_std)
            known = np.flatnonzero(np.isfinite(curve.maximum))
            if not known.size:
                continue
            onset_at = known[np.argmin(np.abs(self.position[part][known] - places[number]))]
            peak_at = known[np.argmax(slip[part][known])]
            found[number, :2] = curve.maximum[onset_at], curve.maximum_std[onset_at]
            found[number, 2:] = curve.slope[peak_at], curve.slope_std[peak_at]
        frame = pd.DataFrame(found, self.events.index, columns)
        frame.attrs["units"] = dict(zip(columns, ("1", "1", "s/m", "s/m"), strict=True))
        return frame

    def events_frame(self) -> pd.DataFrame:
        """The slip events as a frame of the topic ``/events``, one warning each."""
        rows = self.events.join(self.creep_curves()).sort_values(["start", "axle"])
        columns = zip(
            rows["axle"],
            rows["kind"],
            rows["position"].to_numpy() / 1e3,
            rows["speed"].to_numpy() * KMH,
            np.abs(rows["peak_slip"].to_numpy()),
            rows["adhesion"].to_numpy(),
            rows["maximum"].to_numpy(),
            1.96 * rows["maximum_std"].to_numpy(),
            strict=True,
        )
        messages = [
            f"axle {axle} slips in {kind} at km {km:.3f}, {kmh:.0f} km/h: {peak:.1f} m/s,"
            f" adhesion {adhesion:.3f}"
            + (f", maximum {top:.3f} ± {reach:.3f}" if np.isfinite(top) else "")
            for axle, kind, km, kmh, peak, adhesion, top, reach in columns
        ]
        return frame_of(
            EVENTS,
            pd.DatetimeIndex(rows["start"]),
            {
                "level": np.full(len(rows), 3, dtype=np.int64),
                "message": messages,
                "name": ["slip"] * len(rows),
            },
        )


def slip(trip: Given) -> SlipAnalysis:
    """Slip, adhesion in use and slip events of a trip that carries its line and its train.

    Parameters
    ----------
    trip : Trip or path
        A trip at hand, or a log, with ``/train/axles`` and a position.

    Raises
    ------
    LogError
        If the trip has no axles, fewer or more than its train, no position, a load that is no
        number, or lacks line or train.

    Examples
    --------
    >>> found = slip("sample_logs/nonstop.mcap")
    >>> found.adhesion.shape[1], found.events["kind"].unique().tolist()
    (4, ['traction', 'braking'])
    """
    trip = trip_of(trip, TOPICS)
    train, line = train_of(trip), line_of(trip)
    frame = trip["/train/axles"]
    wheels, efforts = _recorded(trip, frame, train)
    time, clock = seconds(frame), pd.DatetimeIndex(frame.index)
    load = _load(trip)
    axle_load = train.adhesive_weight(load) / train.axles.count
    noise = wheel_noise(wheels)
    force = smoothed_force(
        time, wheels, efforts, train.axles.rotating_mass, noise, ADHESION_RATE * axle_load
    )
    adhesion, adhesion_std = force.force / axle_load, force.std / axle_load
    speed, factor = _train_speed(trip, train, load, time, wheels, efforts, adhesion, noise)
    slip_speed = wheels / factor - speed.speed[:, None]
    slipping = _slipping(slip_speed, noise, speed)
    travelled = _position(trip, clock)
    backwards = trip.metadata.get("direction") == "reverse"
    position = line.length - travelled if backwards else travelled
    axles = _Axles(clock, time, position, speed.speed, efforts, adhesion)
    return SlipAnalysis(
        trip=trip.name,
        time=clock,
        position=position,
        speed=speed.speed,
        speed_std=speed.std,
        slip_speed=slip_speed,
        adhesion=adhesion,
        adhesion_std=adhesion_std,
        slipping=slipping,
        wheel_factor=factor,
        events=_events(axles, slip_speed, slipping),
    )


@dataclass(frozen=True, slots=True)
class _Axles:
    """What the onset of an event is read from, at the axles' samples."""

    clock: pd.DatetimeIndex
    time: FloatArray
    position: FloatArray
    speed: FloatArray
    effort: FloatArray
    adhesion: FloatArray


def wheel_noise(wheel_speed: FloatArray) -> float:
    """Standard deviation of white noise in wheel speeds [m/s], from their third differences.

    The median absolute value, so that slips and brake applications do not count.
    """
    third = np.diff(wheel_speed, n=3, axis=0)
    known = np.abs(third[np.isfinite(third)])
    if known.size == 0:
        return SPEED_NOISE_FLOOR
    # The variance of a third difference of white noise is 20 times that of the noise.
    return max(float(np.median(known) / 0.6745 / np.sqrt(20.0)), SPEED_NOISE_FLOOR)


def _load(trip: Trip) -> float:
    """Load that the log states [kg]; 0 where it states none."""
    stated = trip.metadata.get("load") or "0"
    try:
        load = float(stated)
    except ValueError:
        load = np.nan
    if not (np.isfinite(load) and load >= 0.0):
        raise LogError(
            f"trip '{trip.name}': load '{stated}' is not a mass in kg",
            remedy="correct metadata 'load' when the log is made",
        )
    return load


def _recorded(trip: Trip, frame: pd.DataFrame, train: Train) -> tuple[FloatArray, FloatArray]:
    """Wheel speeds and wheel efforts, (n, axles); gaps in the efforts are held."""
    numbers = range(1, train.axles.count + 1)
    names = [f"wheel_speed_{i}" for i in numbers], [f"wheel_effort_{i}" for i in numbers]
    given = sum(name.startswith("wheel_speed_") for name in frame.columns)
    if given != train.axles.count or not {*names[0], *names[1]} <= set(frame.columns):
        raise LogError(
            f"trip '{trip.name}': /train/axles has {given} axles,"
            f" train '{train.name}' has {train.axles.count} powered ones",
            remedy="state the powered axles in the train file, with speed and effort each",
        )
    if len(frame) < 2:
        raise LogError(f"trip '{trip.name}': /train/axles holds {len(frame)} samples")
    speeds = frame[names[0]].to_numpy(dtype=np.float64)
    efforts = frame[names[1]].ffill().fillna(0.0).to_numpy(dtype=np.float64)
    return speeds, efforts


def _train_speed(
    trip: Trip,
    train: Train,
    load: float,
    time: FloatArray,
    wheels: FloatArray,
    efforts: FloatArray,
    adhesion: FloatArray,
    noise: float,
) -> tuple[TrainSpeed, FloatArray]:
    """Train speed, and what each wheel measures over what is true, (axles,)."""
    clock = pd.DatetimeIndex(trip["/train/axles"].index)
    mass = train.mass + train.rotating_mass + load
    mass -= train.axles.count * train.axles.rotating_mass
    whole = pd.DataFrame(wheels).interpolate(limit_direction="both").fillna(0.0).to_numpy()
    other = _other_effort(trip, train, load, whole, efforts)
    gained = impulse(time, whole, efforts, other, train.axles.rotating_mass) / mass
    reference, reference_std = _reference(trip, clock)
    standing = np.median(whole, axis=1) <= STANDSTILL
    reference[standing], reference_std[standing] = 0.0, STANDSTILL
    factor = np.ones(train.axles.count)
    nowhere = np.full_like(wheels, np.nan)
    rate = SLOPE_RATE if _brake_is_known(trip) else SLOPE_RATE_WITHOUT_BRAKE
    rolls = nowhere if np.count_nonzero(np.isfinite(reference[~standing])) > 1 else wheels
    first = train_speed(time, rolls, adhesion, noise, gained, reference, reference_std, rate)
    rolling = (
        (np.abs(adhesion).max(axis=1) < COASTING_ADHESION)
        & (first.speed > CALIBRATION_SPEED)
        & (first.std < 0.2)
    )
    for axle in range(factor.size):
        use = rolling & np.isfinite(wheels[:, axle])
        if np.count_nonzero(use) >= CALIBRATION_SAMPLES:
            factor[axle] = np.median(wheels[use, axle] / first.speed[use])
    speed = train_speed(
        time, wheels / factor, adhesion, noise, gained, reference, reference_std, rate
    )
    return speed, factor


def _other_effort(
    trip: Trip, train: Train, load: float, wheels: FloatArray, efforts: FloatArray
) -> FloatArray:
    """Effort on the train besides that of its motors [N].

    Friction brake, running resistance as the train's file has it, gradient and curves. While the
    train stands they balance the motors, whatever the brakes could do.
    """
    clock = pd.DatetimeIndex(trip["/train/axles"].index)
    speed = np.median(wheels, axis=1)
    position = pd.Series(_position(trip, clock)).interpolate(limit_direction="both").to_numpy()
    held = train.resistance(speed) + train.track_force(line_of(trip), position, train.mass + load)
    if _brake_is_known(trip):
        brake = interpolated(trip["/train/controls"], "pneumatic_braking_effort", clock)
        held = held + np.nan_to_num(brake)
    return np.where(speed > STANDSTILL, -held, -efforts.sum(axis=1))


def _brake_is_known(trip: Trip) -> bool:
    controls = trip.topics.get("/train/controls")
    return controls is not None and bool(controls["pneumatic_braking_effort"].notna().any())


def _reference(trip: Trip, clock: pd.DatetimeIndex) -> tuple[FloatArray, FloatArray]:
    """Speed that does not come from the powered wheels, at the axles' nearest samples, else NaN."""
    speed, std = np.full(len(clock), np.nan), np.full(len(clock), np.nan)
    for topic, column in (("/gnss/motion", "speed_accuracy"), ("/estimates/state", "speed_std")):
        frame = trip.topics.get(topic)
        if frame is None or not frame["speed"].notna().any():
            continue
        known = frame[frame["speed"].notna()]
        # What lies before, behind or in a gap of the axles' samples belongs to none of them.
        reach = pd.Timedelta(np.median(np.diff(clock.asi8)), "ns")
        at = clock.get_indexer(pd.DatetimeIndex(known.index), method="nearest", tolerance=reach)
        known, at = known[at >= 0], at[at >= 0]
        speed[at] = known["speed"].to_numpy()
        std[at] = known[column].fillna(SATELLITE_STD).to_numpy()
        return speed, np.maximum(std, 1e-2)
    return speed, std


def _slipping(slip_speed: FloatArray, noise: float, speed: TrainSpeed) -> BoolArray:
    """Whether each axle slips, counted from the first sample above the threshold."""
    std = float(np.hypot(noise, np.median(speed.std)))
    known = SlipDetector(slip_speed.shape[1], std).update(slip_speed)
    # The detector confirms one sample late; the event began with the sample before.
    known[:-1] |= known[1:]
    return known


def _position(trip: Trip, clock: pd.DatetimeIndex) -> FloatArray:
    """Chainage in the direction of travel [m]: smoothed where there is an estimate."""
    for topic in ("/estimates/state", "/train/state"):
        if topic in trip:
            found = interpolated(trip[topic], "position", clock)
            if np.isfinite(found).any():
                return found
    raise LogError(
        f"trip '{trip.name}' has no position while its axles were recorded",
        remedy="it needs /train/state or /estimates/state with a position",
    )


def adhesion_noise(time: FloatArray, adhesion: FloatArray) -> float:
    """Standard deviation of what noise remains in the observed adhesion, from its differences.

    Over `NOISE_SPAN` the true adhesion hardly changes for most of a trip: the median absolute
    difference of samples that far apart, where the axles pull or brake, is noise.
    """
    lag = max(1, round(NOISE_SPAN / float(np.median(np.diff(time)))))
    apart = np.abs(adhesion[lag:] - adhesion[:-lag])
    loaded = apart[np.abs(adhesion[lag:]) > COASTING_ADHESION]
    if loaded.size == 0:
        return ADHESION_NOISE_FLOOR
    return max(float(np.median(loaded) / 0.6745 / np.sqrt(2.0)), ADHESION_NOISE_FLOOR)


def _events(axles: _Axles, slip_speed: FloatArray, slipping: BoolArray) -> pd.DataFrame:
    """One row a slip event; see `SlipAnalysis`."""
    noise = adhesion_noise(axles.time, axles.adhesion)
    rows = []
    for axle in range(slipping.shape[1]):
        edges = np.flatnonzero(np.diff(slipping[:, axle].astype(np.int8), prepend=0, append=0))
        for start, stop in zip(edges[::2], edges[1::2], strict=True):
            peak = int(start) + int(np.nanargmax(np.abs(slip_speed[start:stop, axle])))
            rows.append(
                {
                    "axle": axle + 1,
                    "start": axles.clock[start],
                    "end": axles.clock[min(stop, len(axles.clock) - 1)],
                    "peak_slip": slip_speed[peak, axle],
                    **_onset_of(axles, axle, int(start), peak, slip_speed[peak, axle], noise),
                }
            )
    columns = {
        "axle": "int64", "start": axles.clock.dtype, "end": axles.clock.dtype, "kind": "str",
        "position": "float64", "speed": "float64", "peak_slip": "float64",
        "adhesion": "float64", "adhesion_std": "float64", "measured": "bool",
    }  # fmt: skip
    frame = pd.DataFrame(rows, columns=list(columns)).astype(columns)
    frame.attrs["units"] = {
        "position": "m", "speed": "m/s", "peak_slip": "m/s", "adhesion": "1", "adhesion_std": "1",
    }  # fmt: skip
    return frame


def _onset_of(
    axles: _Axles, axle: int, start: int, peak: int, peak_slip: float, noise: float
) -> dict[str, Any]:
    """Adhesion at the onset of one event, which begins at sample `start` and peaks at `peak`."""
    direction = np.sign(peak_slip)
    first = int(np.searchsorted(axles.time, axles.time[start] - LOOK_BACK))
    # The cut of the effort falls between two samples: the last before it may be off.
    used = direction * axles.adhesion[first : max(peak, first + 1), axle]
    effort = direction * axles.effort[:, axle]
    top, fell = onset(used, noise)
    at = first + int(top[top.size // 2])
    after = int(np.searchsorted(axles.time, axles.time[peak] + 0.5))
    cut = bool(effort[peak : after + 1].min() < CUT * effort[peak])
    adhesion = float(used[top].mean())
    return {
        "kind": "traction" if direction > 0.0 else "braking",
        "position": axles.position[at],
        "speed": axles.speed[at],
        "adhesion": adhesion,
        "adhesion_std": noise,
        "measured": adhesion > 0.0 and (fell or cut),
    }


def onset(adhesion: FloatArray, noise: float) -> tuple[NDArray[np.int64], bool]:
    """Where the adhesion in use had its last maximum before the slip was largest.

    The record is walked backwards from its end, the instant of largest slip. The adhesion rises
    to the maximum of the creep curve; once it has fallen again by more than noise explains the
    search ends: what lies before belongs to another place.

    Parameters
    ----------
    adhesion : (n,) array
        In use, positive, up to the instant of largest slip.
    noise : float
        Its standard deviation.

    Returns
    -------
    top : (k,) int array
        Samples that differ from the maximum by no more than noise. Their mean is the maximum
        without the bias of a largest value.
    fell : bool
        Whether the adhesion fell from there to the end: the maximum was passed.
    """
    backwards = adhesion[::-1]
    highest = np.maximum.accumulate(backwards)
    fallen = backwards < highest - PROMINENCE * noise
    stop = int(np.argmax(fallen)) if fallen.any() else backwards.size
    best = float(backwards[:stop].max())
    top = np.flatnonzero(backwards[:stop] >= best - PROMINENCE * noise)
    return adhesion.size - 1 - top[::-1], bool(backwards[0] < best - PROMINENCE * noise)
