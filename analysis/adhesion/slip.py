"""Slip of the powered axles over a trip: speeds, adhesion in use, and slip events.

Of a slip event only the onset measures the maximum adhesion: while the slip grows the force
between wheel and rail rises to its maximum and falls beyond it (Zhao et al., 2025, eq. 10). Every
other sample shows that the maximum is at least what is in use.

An axle slips where it turns faster or slower than the train by more than a threshold. Modern slip
protection acts earlier: slips below the threshold are found from what it does. It cuts the effort
of the axle although the driver asks for no less, and the wheel returns to the train's speed.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.axles import SLOW, PoweredAxles, powered_axles
from analysis.resistance.passport import passport
from analysis.view import Given, TripView, one_way, view_of
from estimators.adhesion import (
    NOISE_MULTIPLE,
    SLIP_THRESHOLD,
    SLOPE_RATE,
    SLOPE_RATE_WITHOUT_BRAKE,
    SlipDetector,
    TrainSpeed,
    impulse,
    smoothed_force,
    train_speed,
)
from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std
from trainlog.display import counted, span
from trainlog.errors import LogError
from trainlog.formats.railway import line_of
from trainlog.ingest.recording import Finding
from trainlog.presentation import Presented, WordTable, frame_table
from trainlog.railway.line import Line, in_km
from trainlog.railway.train import Train, axle_loads
from trainlog.resampling import interpolated
from trainlog.spans import in_spans, runs_of
from trainlog.topics import ESTIMATED_ADHESION, EVENTS, STANDSTILL, TRAIN_AXLES
from trainlog.trip import Trip, frame_of
from trainlog.units import GRAVITY, KMH, NANOSECONDS

TOPICS = ("/train/state", "/train/controls", "/train/axles", "/gnss/motion", "/estimates/state")
"""What is read of a log."""

ADHESION_RATE = 0.12
"""How fast adhesion in use may wander, for the observer [1/s^0.5]: from nothing to the maximum in
a few seconds of a run-up, from the maximum to little in half a second of slip."""

REFERENCES = {"/gnss/motion": "speed_accuracy", "/estimates/state": "speed_std"}
"""Topics with a speed that does not come from the powered wheels, and what states its accuracy."""

MEMORY, FEWEST_APART = 1.0, 3
"""A recorded speed of the train that is slower than all powered wheels were for so long before and
after [s], or faster, in so many samples, does not come from them."""

UNSEEN_CREEP = 1.0
"""Standard deviation of what all powered wheels slip alike [m/s] where no such speed is recorded:
at the maximum adhesion wheels slip 0.2 to 3 m/s."""

SPEED_NOISE_FLOOR = 0.005
"""Least noise of a wheel speed that is assumed [m/s]."""

SATELLITE_STD = 0.1
"""Standard deviation of a satellite speed that comes without one [m/s]."""

CALIBRATION_SPEED = 5.0
"""Least speed at which wheel diameters are compared [m/s]."""

CALIBRATION_SAMPLES = 50
"""Least number of samples from which a wheel diameter is corrected."""

CURVE_BEFORE, CURVE_AFTER = 1.5, 0.5
"""The creep curve is estimated from so long before the detection of slip to so long after the
largest slip [s]."""

CURVE_SPEED_STD = 0.03
"""Error of the train's speed while its axles slip [m/s]."""

NOISE_SPAN = 0.4
"""Time over which differences of the observed adhesion are taken for noise [s]."""

ADHESION_NOISE_FLOOR = 0.002
"""Least noise of an observed adhesion that is assumed."""

LARGEST_FACTOR = 1.3
"""Measured over true wheel speed, or the inverse, that a wrong diameter may make; beyond it the
unit is wrong."""

COASTING_ADHESION = 0.02
"""Adhesion in use up to which a wheel is taken to roll without creep, to compare diameters."""

LOOK_BACK = 3.0
"""How long before the detection of slip its onset is sought [s]."""

PROMINENCE = 3.0
"""Standard deviations by which adhesion in use must fall on either side of a maximum."""

CUT = 0.7
"""Effort over the effort at peak slip, half a second later, below which slip protection acted."""

CUT_TIME = 0.5
"""Time in which it acts [s]."""

LOW_SLIP = 0.3
"""Least slip speed [m/s] that is looked at."""

LEAST_SPEED = 3.0
"""Train speed [m/s] below which small slips are not looked for in braking: electric brakes fade
out there."""

SHARED_STD = 0.13, 0.2
"""Relative standard deviation of an axle's effort that is known as a share of the total, and of
what each second between two samples adds."""

SHARED_TIME = 0.1
"""Time before a slip from which on the share of the total effort gives its level [s]."""

FALLEN = 0.8, 0.2
"""Adhesion while an axle slips over that at the onset, where its own effort is not recorded: mean
and standard deviation. Measured curves fall to 0.4 at most, the flattest hardly."""

TRANSFER = 0.5
"""Standard deviation of the change of an axle's load, over the load and the adhesion in use, that
efforts make where the train's file does not state the geometry of its axles: for two bogies with
wheelbases of 2.2 to 3.0 m that pull the body at a height of 0.2 to 1.0 m."""

CREEPAGE_SPEED = 1.0
"""Train speed [m/s] below which a creepage, a ratio of speeds, is not stated."""

RECOVERY = 8.0
"""How long after a slip [s] the axles do not share the total effort evenly."""


@dataclass(frozen=True, eq=False, repr=False)
class SlipAnalysis(Presented):
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

        NaN in all of these is what is not known: axles whose speed or effort was not recorded.
    events : DataFrame
        One row a slip event: ``axle`` (from 1), ``kind`` (``"traction"``, ``"braking"``);
        ``onset``, the time of the adhesion's last maximum before the slip was largest; ``start``,
        when it was detected; ``peak``, when the slip was largest; ``release``, when it was over;
        ``duration`` [s] from the earlier of start and onset to the release; ``position`` [m] and
        ``speed`` [m/s] where the slip began, at the later of start and onset: what the axle used
        there is the maximum, and what it used before without slip was not yet the maximum;
        ``peak_slip`` [m/s] and ``creepage``, slip speed over train speed, at the peak, NaN below
        1 m/s; ``adhesion`` and ``adhesion_std`` at the onset;
        ``delay_std``: the standard deviation by a delay of the efforts that is not known, which all
        onsets of the trip have in common and which is not in ``adhesion_std``; ``energy`` and
        ``energy_std`` [J]: what the slip turned into heat, the work of the adhesion force over the
        slip speed, NaN where no effort is known; and ``measured``: whether the maximum was passed,
        so that the onset measures it.
    common_std : float
        Relative standard deviation of what all adhesion of the trip errs by alike, from a load and
        a gain of the efforts that are not known; not in `adhesion_std`.
    passage_std : float
        The same of what the onsets in one place err by alike, where axles are sampled slowly.
    load : {"recorded", "estimated", "assumed"}
        Where the load is from.
    notes : tuple of str
        What the recorder lacks, and what was made of it.
    complete : bool
        Whether slips of every axle, also short and small ones, are found: where none is, demand
        never met the limit.
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
    common_std: float = 0.0
    passage_std: float = 0.0
    load: str = "recorded"
    notes: tuple[str, ...] = ()
    complete: bool = True

    @property
    def details(self) -> dict[str, Any]:
        """What the track-condition map keeps of the trip beside its name.

        ``load``: where it is from; ``common_std``; ``unmeasured``: slip events that did not show
        the maximum adhesion; ``complete``: false where slips may have gone unseen; ``notes``.
        What is not worth a word is left out.
        """
        unmeasured = int(np.count_nonzero(~self.events["measured"]))
        known: dict[str, Any] = {} if self.load == "recorded" else {"load": self.load}
        known |= {"common_std": round(self.common_std, 4)} if self.common_std > 0.0 else {}
        known |= {"unmeasured": unmeasured} if unmeasured else {}
        known |= {} if self.complete else {"complete": False}
        return known | ({"notes": list(self.notes)} if self.notes else {})

    @property
    def title(self) -> str:
        """Trip, axles and time."""
        minutes = (self.time[-1] - self.time[0]).total_seconds() / 60.0
        return f"Slip of {self.adhesion.shape[1]} axles on trip '{self.trip}', {minutes:.1f} min"

    def tables(self) -> list[WordTable]:
        """What was found; the events as data."""
        return [*super().tables(), frame_table("events", self.events)]

    def summary(self) -> dict[str, str]:
        """Events, adhesion in use, and what the recorder lacks."""
        events = self.events
        traction = int(np.count_nonzero(events["kind"] == "traction"))
        onsets = events.loc[events["measured"], "adhesion"].to_numpy(np.float64)
        measured = f"{onsets.size} show the maximum adhesion"
        used = np.abs(self.adhesion[np.isfinite(self.adhesion)])
        alike = float(np.hypot(self.common_std, self.passage_std))
        band = f", all within ± {1.96 * alike:.0%}" if alike > 0.0 else ""
        factors = self.wheel_factor[np.isfinite(self.wheel_factor)]
        return {
            "events": f"{len(events)}, {traction} in traction and {len(events) - traction} in"
            " braking",
            "of these": measured + (f", {span(onsets, digits=3)}" if onsets.size else ""),
            "adhesion in use": f"up to {used.max():.3f}{band}" if used.size else "not known",
            "wheels": f"measure {span(factors, digits=4)} times the speed",
        } | ({"notes": "; ".join(self.notes)} if self.notes else {})

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
        """Adhesion characteristic of each slip event, by an unscented filter and the observer.

        Returns
        -------
        DataFrame
            With the index of `events`: ``maximum`` and ``maximum_std``, the maximum adhesion where
            the slip began: the filter's and, where the event measured it, the observer's,
            weighted by their precisions, as their errors are of either sign; ``slope`` and
            ``slope_std`` [s/m], the change of adhesion with slip speed at the largest slip,
            negative where the maximum was passed. NaN where too few samples show the curve.
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
        delayed = np.nan_to_num(self.events["delay_std"] / self.events["adhesion"].abs())
        names = ("measured", "adhesion", "adhesion_std")
        measured, levels, level_stds = (self.events[name].to_numpy() for name in names)
        starts, onsets, stops = (
            self.time.searchsorted(self.events[name]) for name in ("start", "onset", "release")
        )
        for number, (axle, sign, start, stop) in enumerate(
            zip(axles, signs, starts, stops, strict=True)
        ):
            slip = sign * self.slip_speed[:, axle]
            within = slip[start : max(stop, start + 1)]
            if not np.isfinite(within).any():
                continue
            peak = int(start) + int(np.nanargmax(within))
            first = int(np.searchsorted(time, time[start] - CURVE_BEFORE))
            part = slice(first, min(stop, int(np.searchsorted(time, time[peak] + CURVE_AFTER))))
            used = sign * self.adhesion[part, axle]
            curve = estimate_creep_curve(time[part], slip[part], used, noise, slip_std)
            known = np.flatnonzero(np.isfinite(curve.maximum))
            if not known.size:
                continue
            began = max(start, onsets[number]) - part.start
            onset_at = known[np.argmin(np.abs(known - began))]
            peak_at = known[np.argmax(slip[part][known])]
            top, std = float(curve.maximum[onset_at]), float(curve.maximum_std[onset_at])
            if measured[number]:
                top, std = _weighted((top, std), (levels[number], level_stds[number]))
            found[number, :2] = top, np.hypot(std, top * delayed[number])
            found[number, 2:] = curve.slope[peak_at], curve.slope_std[peak_at]
        frame = pd.DataFrame(found, self.events.index, columns)
        frame.attrs["units"] = dict(zip(columns, ("1", "1", "s/m", "s/m"), strict=True))
        return frame

    def events_frame(self, line: Line | None = None) -> pd.DataFrame:
        """The slip events as a frame of the topic ``/events``, one warning each.

        Their messages name the kilometres of the line, in its own direction.
        """
        rows = self.events.join(self.creep_curves()).sort_values(["start", "axle"])
        rows["km"], rows["kmh"] = in_km(line, rows["position"]), rows["speed"] * KMH
        messages = [_words(each) for each in rows.to_dict("records")]
        return frame_of(
            EVENTS,
            pd.DatetimeIndex(rows["start"]),
            {
                "level": np.full(len(rows), 3, dtype=np.int64),
                "message": messages,
                "name": ["slip"] * len(rows),
            },
        )


def _weighted(one: tuple[float, float], other: tuple[float, float]) -> tuple[float, float]:
    """Mean of two values by their precisions, and its standard deviation.

    They are of the same samples: their errors add up in full, and so does what they differ by.
    """
    share = other[1] ** 2 / (one[1] ** 2 + other[1] ** 2)
    apart = np.sqrt(share * (1.0 - share)) * (one[0] - other[0])
    mean, std = (share * a + (1.0 - share) * b for a, b in zip(one, other, strict=True))
    return mean, float(np.hypot(std, apart))


def _words(event: dict[Hashable, Any]) -> str:
    """One slip event in words, from a row of `SlipAnalysis.events` with its creep curve."""
    creepage, energy = abs(event["creepage"]), event["energy"]
    parts = (
        f"axle {event['axle']} slips in {event['kind']} at km {event['km']:.3f},"
        f" {event['kmh']:.0f} km/h: {abs(event['peak_slip']):.1f} m/s",
        f", creepage {creepage:.0%}" if np.isfinite(creepage) else "",
        f", {event['duration']:.1f} s",
        f", {energy / 1e3:.1f} ± {1.96 * event['energy_std'] / 1e3:.1f} kJ"
        if np.isfinite(energy)
        else "",
        f", adhesion {event['adhesion']:.3f}"
        if np.isfinite(event["adhesion"])
        else ", adhesion not known",
        f", maximum {event['maximum']:.3f} ± {1.96 * event['maximum_std']:.3f}"
        if np.isfinite(event["maximum"])
        else "",
    )
    return "".join(parts)


def joined_details(first: dict[str, Any], second: dict[str, Any]) -> dict[str, Any]:
    """`SlipAnalysis.details` of two parts of a trip as those of both."""
    both = {**first, **second}
    if "common_std" in both:
        both["common_std"] = max(each.get("common_std", 0.0) for each in (first, second))
    if "unmeasured" in both:
        both["unmeasured"] = sum(each.get("unmeasured", 0) for each in (first, second))
    if "notes" in both:
        notes = [*first.get("notes", ()), *second.get("notes", ())]
        both["notes"] = list(dict.fromkeys(notes))
    return both


def slip(trip: Given) -> SlipAnalysis:
    """Slip, adhesion in use and slip events of a trip that carries its line and its train.

    Parameters
    ----------
    trip : Trip or path
        A trip at hand, or a log, with ``/train/axles`` and a position.

    Raises
    ------
    LogError
        If the trip has no axle speed, more axles than its train powers, no position, a load that
        is no number, or lacks line or train.

    Notes
    -----
    What the recorder lacks is taken from the trip's passport (`analysis.passport`): load, gain and
    delay of the efforts. Where they are not known the band is wider (`SlipAnalysis.common_std`),
    and `SlipAnalysis.notes` states what is lacking.

    Examples
    --------
    >>> found = slip("sample_logs/nonstop.mcap")
    >>> found.adhesion.shape[1], found.events["kind"].unique().tolist()
    (4, ['traction', 'braking'])
    """
    return view_of(trip, TOPICS).once(_slip)


def _slip(view: TripView) -> SlipAnalysis:
    trip, frozen = view.unfrozen
    train, line = view.train, view.line
    axles = powered_axles(trip, train, passport(view))
    noise = wheel_noise(axles.wheel_speed)
    wheels = pd.DataFrame(axles.wheel_speed).interpolate(limit_direction="both").fillna(0.0)
    travelled = _position(trip, axles.clock)
    place = np.asarray(pd.Series(travelled).interpolate(limit_direction="both"), np.float64)
    other = _other_effort(trip, train, axles, wheels.to_numpy(), place)
    force, force_std = _force(axles, train, noise)
    loads = _loads(train, axles, force, other, line.gradient(place))
    adhesion, adhesion_std = force / loads, force_std / loads
    reference = _reference(trip, axles)
    is_measured = bool(np.isfinite(reference[0]).any())
    speed, factor = _train_speed(
        trip, train, axles, adhesion, noise, wheels.to_numpy(), other, reference
    )
    one_way(trip.name, line, axles.time, speed.speed, place)
    slip_speed = axles.wheel_speed / factor - speed.speed[:, None]
    backwards = trip.metadata.get("direction") == "reverse"
    position = line.length - travelled if backwards else travelled
    std = float(np.hypot(noise, np.median(speed.std)))
    share = _share(axles, train.axles.rotating_mass, loads)
    later = tuple(
        (_force(each, train, noise)[0] / loads, _share(each, train.axles.rotating_mass, loads))
        for each in axles.at_other_delays()
    )
    creep_std = 0.0 if is_measured else UNSEEN_CREEP
    motion = Motion(
        axles, position, speed.speed, speed.std, slip_speed, std, loads, adhesion,
        train.axles.geometry is not None, creep_std, share, later,
    )  # fmt: skip
    slipping = slipping_axles(motion)
    slipping |= small_slips(motion, slipping)
    slipping = _leave_out_gaps(axles, slipping)
    least = least_slip(motion)
    against = 0 if share is None else _without_contradicted(motion, slipping, share)
    events = event_rows(motion, slipping)
    adhesion[:, ~axles.levelled] = adhesion_std[:, ~axles.levelled] = np.nan
    adhesion[~axles.shown] = adhesion_std[~axles.shown] = np.nan
    if share is not None:
        adhesion = _mean_force(axles) / loads
        # The effort of wheels that slip turns them, not the train.
        adhesion[slipping.any(axis=1)] = np.nan
        adhesion_std = _shared_std(axles) * np.abs(adhesion)
        later = tuple((_mean_force(each) / loads, None) for each in axles.at_other_delays())
    if later:
        squares = [(each - adhesion) ** 2 for each, _ in later]
        adhesion_std = np.sqrt(adhesion_std**2 + np.mean(squares, axis=0))
    return SlipAnalysis(
        trip=trip.name,
        time=axles.clock,
        position=position,
        speed=speed.speed,
        speed_std=speed.std,
        slip_speed=axles.of_all(slip_speed),
        adhesion=axles.of_all(adhesion),
        adhesion_std=axles.of_all(adhesion_std),
        slipping=axles.of_all(slipping, False),
        wheel_factor=axles.of_all(factor[None, :])[0],
        events=events,
        common_std=axles.common_std,
        passage_std=axles.passage_std,
        load=axles.load,
        notes=(*axles.notes, *_notes(axles, events, noise, least, against, frozen)),
        complete=axles.complete and least < SLIP_THRESHOLD,
    )


def _force(axles: PoweredAxles, train: Train, noise: float) -> tuple[FloatArray, FloatArray]:
    """Adhesion force of the recorded axles and its standard deviation [N], (n, k)."""
    found = smoothed_force(
        axles.time,
        axles.wheel_speed,
        axles.wheel_effort,
        train.axles.rotating_mass,
        noise,
        ADHESION_RATE * axles.axle_load,
    )
    return found.force, found.std


def _loads(
    train: Train, axles: PoweredAxles, force: FloatArray, other: FloatArray, gradient: FloatArray
) -> FloatArray:
    """Weight on the recorded axles [N], (n, k), with the load transfer by their adhesion forces."""
    transfer = train.load_transfer(axles.mass - train.mass)
    if transfer is None:
        return np.full_like(force, axles.axle_load)
    known = np.nan_to_num(force)
    every = np.repeat(known.mean(axis=1)[:, None], axles.count, axis=1)
    every[:, axles.numbers] = known
    inertia = axles.mass + train.rotating_mass - axles.count * train.axles.rotating_mass
    moving = other != -axles.total_effort
    acceleration = np.where(moving, (every.sum(axis=1) + other) / inertia, 0.0)
    specific = acceleration + GRAVITY * gradient
    return axle_loads(transfer, axles.axle_load, every, specific)[:, axles.numbers]


def _shared_std(axles: PoweredAxles) -> float:
    """Relative standard deviation of an axle's effort that is known as a share of the total."""
    lasting, between = SHARED_STD
    return math.hypot(lasting, between * axles.sampling)


def _mean_force(axles: PoweredAxles) -> FloatArray:
    """Adhesion force if the axles share the total effort evenly [N], (n, k)."""
    return np.repeat((axles.total_effort / axles.count)[:, None], axles.numbers.size, axis=1)


def _notes(
    axles: PoweredAxles,
    events: pd.DataFrame,
    noise: float,
    least: float,
    against: int,
    frozen: Sequence[Finding],
) -> list[str]:
    """What is to be stated of delay and noise, of slips left out, and of what was repeated."""
    notes = []
    if axles.delay_std and axles.levelled.any():
        note = f"the delay of the efforts is not known better than ± {1.96 * axles.delay_std:.2f} s"
        shown = events[events["measured"]]
        if not shown.empty:
            share = float(np.median(shown["delay_std"] / shown["adhesion"]))
            note += f": levels within ± {1.96 * share:.0%} by the delay"
        notes.append(note)
    if least >= SLIP_THRESHOLD:
        notes.append(
            f"wheel speeds have a noise of {noise:.2f} m/s: slips below {least:.1f} m/s are not"
            " seen"
        )
    if against:
        notes.append(
            f"{counted(against, 'slip')} against the effort of the motors left out: all wheels"
            " slipped, and nothing else measures the train's speed there; efforts by axle or"
            " satellites would"
        )
    counts = Counter[str]()
    for each in frozen:
        counts[each.column] += each.count
    return notes + [
        f"{column} repeats itself while the train moves on, {counted(count, 'sample')}: left out"
        for column, count in sorted(counts.items())
    ]


def wheel_noise(wheel_speed: FloatArray) -> float:
    """Standard deviation of white noise in wheel speeds [m/s], from their third differences.

    The median absolute value, so that slips and brake applications do not count.
    """
    third = np.diff(wheel_speed, n=3, axis=0)
    known = np.abs(third[np.isfinite(third)])
    if known.size == 0:
        return SPEED_NOISE_FLOOR
    # The variance of a third difference of white noise is 20 times that of the noise.
    return max(robust_std(known) / math.sqrt(20.0), SPEED_NOISE_FLOOR)


def _train_speed(
    trip: Trip,
    train: Train,
    axles: PoweredAxles,
    adhesion: FloatArray,
    noise: float,
    whole: FloatArray,
    other: FloatArray,
    known: tuple[FloatArray, FloatArray],
) -> tuple[TrainSpeed, FloatArray]:
    """Train speed, and what each wheel measures over what is true, (k,)."""
    time, wheels = axles.time, axles.wheel_speed
    mass = axles.mass + train.rotating_mass - wheels.shape[1] * train.axles.rotating_mass
    total = axles.total_effort[:, None]
    gained = impulse(time, whole, total, other, train.axles.rotating_mass) / mass
    reference, reference_std = known
    standing = np.abs(np.median(whole, axis=1)) <= STANDSTILL
    reference[standing], reference_std[standing] = 0.0, STANDSTILL
    factor = np.ones(wheels.shape[1])
    nowhere = np.full_like(wheels, np.nan)
    rate = SLOPE_RATE if _brake_is_known(trip) else SLOPE_RATE_WITHOUT_BRAKE
    rolls = nowhere if np.count_nonzero(np.isfinite(reference[~standing])) > 1 else wheels
    first = train_speed(time, rolls, adhesion, noise, gained, reference, reference_std, rate)
    rolling = (
        (np.abs(adhesion).max(axis=1) < COASTING_ADHESION)
        & (np.abs(first.speed) > CALIBRATION_SPEED)
        & (first.std < 0.2)
    )
    for axle in range(factor.size):
        use = rolling & np.isfinite(wheels[:, axle])
        if np.count_nonzero(use) >= CALIBRATION_SAMPLES:
            factor[axle] = np.median(wheels[use, axle] / np.abs(first.speed[use]))
        if not 1.0 / LARGEST_FACTOR <= factor[axle] <= LARGEST_FACTOR:
            raise LogError(
                f"trip '{trip.name}': wheel_speed_{axles.numbers[axle] + 1} is {factor[axle]:.3g}"
                " times the train's speed",
                place=f"topic {TRAIN_AXLES.name}",
                remedy="check its unit and sign in the profile",
            )
    speed = train_speed(
        time, wheels / factor, adhesion, noise, gained, reference, reference_std, rate
    )
    return speed, factor


def _share(axles: PoweredAxles, rotating_mass: float, loads: FloatArray) -> FloatArray | None:
    """Adhesion of each axle by its share of the total effort, (n, k), where only that is known."""
    if axles.level != "shared":
        return None
    turning = rotating_mass * np.diff(axles.wheel_speed, axis=0) / np.diff(axles.time)[:, None]
    between = 0.5 * (axles.total_effort[1:] + axles.total_effort[:-1])[:, None] / axles.count
    used = between - turning
    return np.nan_to_num(np.concatenate((used[:1], used)) / loads)


def _other_effort(
    trip: Trip, train: Train, axles: PoweredAxles, wheels: FloatArray, position: FloatArray
) -> FloatArray:
    """Effort on the train besides that of its motors [N].

    Friction brake, running resistance as the train's file has it, gradient and curves. While the
    train stands they balance the motors, whatever the brakes could do.
    """
    speed = np.median(wheels, axis=1)
    held = train.resistance(speed) + train.track_force(line_of(trip), position, axles.mass)
    if _brake_is_known(trip):
        brake = interpolated(trip["/train/controls"], "pneumatic_braking_effort", axles.clock)
        held = held + np.nan_to_num(brake)
    return np.where(speed > STANDSTILL, -held, -axles.total_effort)


def _brake_is_known(trip: Trip) -> bool:
    controls = trip.topics.get("/train/controls")
    return controls is not None and bool(controls["pneumatic_braking_effort"].notna().any())


def _reference(trip: Trip, axles: PoweredAxles) -> tuple[FloatArray, FloatArray]:
    """Speed that does not come from the powered wheels, at the axles' nearest samples, else NaN.

    Several values around a sample are their mean, so that none is of a later or an earlier time.
    """
    clock = axles.clock
    speed, std = np.full(len(clock), np.nan), np.full(len(clock), np.nan)
    for topic, column in REFERENCES.items():
        frame = trip.topics.get(topic)
        if frame is None or not frame["speed"].notna().any():
            continue
        known = frame[frame["speed"].notna()]
        # What lies before, behind or in a gap of the axles' samples belongs to none of them.
        reach = pd.Timedelta(np.median(np.diff(clock.asi8)), "ns")
        at = clock.get_indexer(pd.DatetimeIndex(known.index), method="nearest", tolerance=reach)
        variance = np.maximum(known[column].fillna(SATELLITE_STD), 1e-2) ** 2
        values = pd.DataFrame({"speed": known["speed"], "variance": variance})[at >= 0]
        each = values.groupby(at[at >= 0])
        found = each.mean()
        speed[found.index] = found["speed"]
        std[found.index] = np.sqrt(found["variance"] / each.size())
        return speed, std
    state = trip.topics.get("/train/state")
    if state is not None and state["speed"].notna().any():
        recorded = interpolated(state, "speed", clock)
        # A value that repeats itself while the wheels turn faster may be frozen.
        for start, stop in runs_of(np.diff(recorded) == 0.0):
            if axles.time[stop] - axles.time[start] >= MEMORY:
                recorded[start : stop + 1] = np.nan
        # Slower than all powered wheels, or faster, within `MEMORY`: no filter of theirs gives it.
        around = 2 * max(1, round(MEMORY / axles.sampling)) + 1
        slowest = pd.Series(axles.wheel_speed.min(axis=1)).rolling(around, center=True).min()
        fastest = pd.Series(axles.wheel_speed.max(axis=1)).rolling(around, center=True).max()
        beyond = SLIP_THRESHOLD + 0.02 * recorded
        apart = (slowest.to_numpy() - recorded > beyond) | (recorded - fastest.to_numpy() > beyond)
        if np.count_nonzero(apart) >= FEWEST_APART:
            return recorded, np.full(len(clock), SATELLITE_STD)
    return speed, std


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


# ----------------------------------------------------------------------------------- events


@dataclass(frozen=True, slots=True)
class Motion:
    """What an event is read from; arrays (n,) and (n, k) of the recorded axles.

    Where only the total effort is known, `share` is the adhesion of each axle by its share of it,
    (n, k): up to the sample, without what comes after. `loads` are those of the axles [N],
    `transfer_known` whether with the transfer between them. `creep_std` is the standard deviation
    [m/s] of what all wheels slip alike unseen, where nothing but wheels measures the speed. `later`
    is what adhesion and share would be with the efforts at other delays that may be.
    """

    axles: PoweredAxles
    position: FloatArray
    speed: FloatArray
    speed_std: FloatArray
    slip_speed: FloatArray
    slip_std: float
    loads: FloatArray
    adhesion: FloatArray
    transfer_known: bool = False
    creep_std: float = 0.0
    share: FloatArray | None = None
    later: tuple[tuple[FloatArray, FloatArray | None], ...] = ()


def slipping_axles(motion: Motion) -> BoolArray:
    """Whether each axle slips, counted from the first sample above the threshold, (n, k)."""
    detector = SlipDetector(motion.slip_speed.shape[1], motion.slip_std)
    if motion.axles.sampling >= SLOW:
        # Few samples show a slip: each counts as its own confirmation.
        return detector.update(np.repeat(motion.slip_speed, 2, axis=0))[1::2]
    found = detector.update(motion.slip_speed)
    # The detector confirms one sample late; the event began with the sample before.
    found[:-1] |= found[1:]
    return found


def least_slip(motion: Motion) -> float:
    """Least slip speed [m/s] that stands out from the noise."""
    return max(LOW_SLIP, NOISE_MULTIPLE * motion.slip_std)


def small_slips(motion: Motion, slipping: BoolArray) -> BoolArray:
    """Slips that the threshold does not find, (n, k): of those the maximum adhesion was passed.

    The effort of the axle is cut although no less is asked for, by the driver or, where that is
    not recorded, from the other axles; and the wheel returns to the train's speed. Both within
    `CUT_TIME`.
    """
    axles = motion.axles
    found = np.zeros_like(slipping)
    least = least_slip(motion)
    reach = max(1, round(CUT_TIME / axles.sampling))
    if axles.level != "axle" or axles.sampling >= SLOW:
        return found
    for axle in np.flatnonzero(axles.levelled).tolist():
        asked = _asked(axles, axle)
        if asked is None:
            continue
        size = np.abs(motion.slip_speed[:, axle])
        braking = motion.slip_speed[:, axle] < 0.0
        for start, stop in runs_of((size > least) & ~(braking & (motion.speed < LEAST_SPEED))):
            if slipping[max(start - 1, 0) : stop + 1, axle].any():
                continue
            peak = start + int(np.argmax(size[start:stop]))
            sign = np.sign(motion.slip_speed[peak, axle])
            effort = sign * axles.wheel_effort[max(peak - reach, 0) : peak + reach + 1, axle]
            wanted = sign * asked[max(peak - reach, 0) : peak + reach + 1]
            first = min(peak, reach)
            strong, most = float(effort[: first + 1].max()), float(wanted[: first + 1].max())
            last = first + int(np.argmin(effort[first:]))
            returned = np.nanmin(size[peak : peak + reach + 1]) < 0.5 * size[peak]
            if (
                returned
                and strong > COASTING_ADHESION * axles.axle_load
                and effort[last] * most < CUT * strong * wanted[last]
            ):
                found[start:stop, axle] = True
    return found


def _asked(axles: PoweredAxles, axle: int) -> FloatArray | None:
    """What an axle is asked for, (n,), by the driver or as the other axles; None if unknown."""
    if axles.demand is not None:
        return axles.demand
    others = axles.levelled.copy()
    others[axle] = False
    if not others.any():
        return None
    effort = axles.wheel_effort[:, others]
    return np.asarray(np.take_along_axis(effort, np.abs(effort).argmax(axis=1)[:, None], 1)[:, 0])


def adhesion_noise(time: FloatArray, adhesion: FloatArray) -> float:
    """Standard deviation of what noise remains in the observed adhesion, from its differences.

    Over `NOISE_SPAN` the true adhesion hardly changes for most of a trip: the median absolute
    difference of samples that far apart, where the axles pull or brake, is noise. Samples without
    adhesion (NaN) are left out.
    """
    lag = max(1, round(NOISE_SPAN / float(np.median(np.diff(time)))))
    apart = np.abs(adhesion[lag:] - adhesion[:-lag])
    loaded = apart[np.isfinite(apart) & (np.abs(adhesion[lag:]) > COASTING_ADHESION)]
    if loaded.size == 0:
        return ADHESION_NOISE_FLOOR
    return max(robust_std(loaded) / math.sqrt(2.0), ADHESION_NOISE_FLOOR)


def event_rows(motion: Motion, slipping: BoolArray) -> pd.DataFrame:
    """One row a slip event; see `SlipAnalysis`."""
    axles = motion.axles
    noise = adhesion_noise(axles.time, motion.adhesion)
    last = len(axles.clock) - 1
    rows = []
    for axle in range(slipping.shape[1]):
        for start, stop in runs_of(slipping[:, axle]):
            peak = _peak_of(motion, axle, start, stop)
            at, found = _onset_of(motion, axle, start, peak, noise)
            # Of slow samples the last before a slip is of another place, which bore the effort.
            found["measured"] &= axles.sampling < SLOW or at >= start
            began = max(start, at)
            if not np.isfinite(motion.position[began]):
                began = at
            times = {"start": start, "onset": at, "peak": peak, "release": min(stop, last)}
            slip_speed, speed = motion.slip_speed[peak, axle], motion.speed[peak]
            span = min(start, at), times["release"]
            energy, energy_std = _energy_of(motion, axle, span, found, noise)
            rows.append(
                {
                    "axle": int(axles.numbers[axle]) + 1,
                    **times,
                    "duration": axles.time[span[1]] - axles.time[span[0]],
                    "position": motion.position[began],
                    "speed": motion.speed[began],
                    "peak_slip": slip_speed,
                    "creepage": slip_speed / speed if speed >= CREEPAGE_SPEED else np.nan,
                    **found,
                    "energy": energy,
                    "energy_std": energy_std,
                }
            )
    units = {
        "duration": "s", "position": "m", "speed": "m/s", "peak_slip": "m/s", "creepage": "1",
        "adhesion": "1", "adhesion_std": "1", "delay_std": "1", "transfer_std": "1", "energy": "J",
        "energy_std": "J",
    }  # fmt: skip
    instants, (first, *others) = ("start", "onset", "peak", "release"), units
    frame = pd.DataFrame(rows, columns=["axle", *instants, first, "kind", *others, "measured"])
    kinds = {"axle": "int64", "kind": "str", "measured": "bool"}
    frame = frame.astype(dict.fromkeys(units, "float64") | kinds)
    for name in instants:
        frame[name] = axles.clock[frame[name].to_numpy(np.int64)]
    frame.attrs["units"] = units
    if axles.level == "shared" and len(frame):
        # So shortly after another axle slipped an axle does not pull its share yet.
        starts, ends = (pd.DatetimeIndex(frame[n]).as_unit("ns").asi8 for n in ("start", "release"))
        recovered = ends + round(RECOVERY * NANOSECONDS)
        earlier = (starts[None, :] < starts[:, None]) & (recovered[None, :] > starts[:, None])
        later = np.asarray(earlier.any(axis=1))
        frame["measured"] &= ~later
        frame.loc[later, ["energy", "energy_std"]] = np.nan
    return frame


def _leave_out_gaps(axles: PoweredAxles, slipping: BoolArray) -> BoolArray:
    """Slips (n, k) without the samples in which an axle's speed is not known.

    A slip goes on over a gap in which slip protection could not have ended it: no longer than
    `CUT_TIME`, or of a single sample.
    """
    known, rows = np.isfinite(axles.wheel_speed), np.arange(len(slipping))[:, None]
    before = np.maximum.accumulate(np.where(known, rows, 0), axis=0)
    after = np.minimum.accumulate(np.where(known, rows, rows[-1])[::-1], axis=0)[::-1]
    short = (after - before == 2) | (axles.time[after] - axles.time[before] <= CUT_TIME)
    slips = slipping & known
    goes_on = np.take_along_axis(slips, before, axis=0) & np.take_along_axis(slips, after, axis=0)
    return np.asarray(slips | (goes_on & short))


def _without_contradicted(motion: Motion, slipping: BoolArray, share: FloatArray) -> int:
    """Take out slips against the effort of the motors, in place; how many there were.

    A wheel that is driven cannot run slower than the train by more than what rolling takes: where
    it seems to, all wheels slipped, and the train's speed was taken from them.
    """
    count = 0
    for axle in range(slipping.shape[1]):
        for start, stop in runs_of(slipping[:, axle]):
            peak = _peak_of(motion, axle, start, stop)
            sign = np.sign(motion.slip_speed[peak, axle])
            if sign * float(np.median(share[start : peak + 1, axle])) < -COASTING_ADHESION:
                slipping[start:stop, axle] = False
                count += 1
    return count


def _peak_of(motion: Motion, axle: int, start: int, stop: int) -> int:
    """Sample of the largest slip of one event."""
    return start + int(np.nanargmax(np.abs(motion.slip_speed[start:stop, axle])))


def _energy_of(
    motion: Motion, axle: int, span: tuple[int, int], found: dict[str, Any], noise: float
) -> tuple[float, float]:
    """Energy [J] that the slip turned into heat between two samples, and its std [J].

    The work of the adhesion force over the slip. Its errors: those of force and train speed last
    about as long as an event, so that their work adds up; the gain of the efforts; their delay;
    efforts and slips between slow samples; and the integral itself, as far as it changes with every
    other sample left out. Where only the total
    effort is known, the force is that of the onset, fallen by `FALLEN`; without effort, or where
    another axle slipped shortly before that, there is none.
    """
    axles, rows = motion.axles, slice(span[0], span[1] + 1)
    if not axles.levelled[axle]:
        return np.nan, np.nan
    time, loads = axles.time[rows], motion.loads[rows, axle]
    slip_speed = motion.slip_speed[rows, axle]
    known = np.isfinite(slip_speed)
    slip_speed = np.interp(time, time[known], slip_speed[known])

    def work(force: FloatArray, times: FloatArray, step: int = 1) -> float:
        return float(np.trapezoid((force * times)[::step], time[::step]))

    if motion.share is not None:
        sign = 1.0 if found["kind"] == "traction" else -1.0
        mean, spread = FALLEN
        most = work(sign * found["adhesion"] * loads, slip_speed)
        relative = np.hypot(spread / mean, _shared_std(axles))
        return mean * most, float(mean * abs(most) * np.hypot(relative, axles.gain_std))
    force = motion.adhesion[rows, axle] * loads
    energy = work(force, slip_speed)
    others = [work(each[rows, axle] * loads, slip_speed) for each, _ in motion.later]
    errors = (
        work(noise * loads, np.abs(slip_speed)),
        work(np.abs(force), motion.speed_std[rows]),
        axles.gain_std * energy,
        axles.passage_std * energy,
        np.sqrt(np.mean((np.array(others) - energy) ** 2)) if others else 0.0,
        work(np.abs(force), np.full(time.size, motion.creep_std)),
        energy - work(force, slip_speed, 2),
    )
    return energy, float(np.sqrt(np.sum(np.square(errors))))


def _onset_of(
    motion: Motion, axle: int, start: int, peak: int, noise: float
) -> tuple[int, dict[str, Any]]:
    """Sample of the onset of one event and the adhesion there, by columns of `event_rows`.

    The event begins at sample `start` and peaks at `peak`.
    """
    axles = motion.axles
    direction = np.sign(motion.slip_speed[peak, axle])
    effort = direction * axles.wheel_effort[:, axle]
    row = (motion, axle, start, peak, noise)
    at, adhesion, fell = _level(*row, motion.adhesion, motion.share)
    others = [_level(*row, *each)[1] for each in motion.later]
    after = int(np.searchsorted(axles.time, axles.time[peak] + CUT_TIME))
    cut = bool(effort[peak : after + 1].min() < CUT * effort[peak])
    known = bool(axles.levelled[axle])
    # Whether the effort is known before the onset, up to the largest slip.
    first = int(np.searchsorted(axles.time, axles.time[min(at, peak)] - CUT_TIME))
    shown = bool(axles.shown[first : peak + 1, axle].all())
    spread = _shared_std(axles) * abs(adhesion) if motion.share is not None else 0.0
    spread_by_transfer = 0.0 if motion.transfer_known else TRANSFER * adhesion**2
    delayed = np.sqrt(np.mean((np.array(others) - adhesion) ** 2)) if others else 0.0
    return at, {
        "kind": "traction" if direction > 0.0 else "braking",
        "adhesion": adhesion if known else np.nan,
        "adhesion_std": np.hypot(noise, spread) if known else np.nan,
        "delay_std": float(delayed) if known else np.nan,
        "transfer_std": spread_by_transfer if known else np.nan,
        "measured": known and adhesion > 0.0 and (fell or cut) and shown,
    }


def _level(
    motion: Motion,
    axle: int,
    start: int,
    peak: int,
    noise: float,
    adhesion: FloatArray,
    share: FloatArray | None,
) -> tuple[int, float, bool]:
    """Sample and level of one event's onset by the adhesion in use, and whether that fell after."""
    time = motion.axles.time
    direction = np.sign(motion.slip_speed[peak, axle])
    first = int(np.searchsorted(time, time[start] - LOOK_BACK))
    # The cut of the effort falls between two samples: the last before it may be off.
    used = direction * adhesion[first : max(peak, first + 1), axle]
    top, fell = onset(used, noise)
    if share is None:
        return first + int(top[top.size // 2]), float(used[top].mean()), fell
    # When whose effort is cut is not known: the level is what the axle used up to the largest slip.
    before = int(np.searchsorted(time, time[start] - SHARED_TIME))
    return start, float((direction * share[before : max(start, peak) + 1, axle]).max()), fell


def onset(adhesion: FloatArray, noise: float) -> tuple[IntArray, bool]:
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
