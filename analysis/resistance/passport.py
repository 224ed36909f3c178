"""The passport of a recorded trip: what its recorder lacks, estimated with uncertainty.

Delay and gain of the recorded efforts are sought in the equation of motion (see
`analysis.resistance.noise`). With a gain g of the recorded effort F, a delay d of it, and the
loaded mass m,

    Δv + ∫ a_track dt + Δp_rot / m = 1/(g m) ∫ F(t + d) dt - ∫ R(v) dt / m.

Windows of a second are whitened by a Kalman filter with noise of the speed and errors of the
line's gradients (`analysis.resistance.noise`). The efforts are shifted by the delay of their
regression (`estimators.regression`) until nothing of it is left. Uncertainties are cluster-robust
(Liang and Zeger 1986, Biometrika 73(1), eq. 6).

The motion determines g m only. Gain and load are separated by what is known beforehand: the load
that was recorded, with a weighing error, or any load up to the largest; and the accuracy of a
traction converter's torque estimate.

Wheels creep ahead of the train by s(F), as adhesion needs slip. Where their speeds are not known,
the momentum J ds/dt that this takes of the effort is missing; with the compliance ds/dF of the
contact, what moves the train is F - J ds/dF dF/dt, later than F by J ds/dF. The motion then shows
the delay less that lead, which is added, with all of its range in the band (`_Motion.creep_lead`).
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from analysis.resistance.noise import Expected, Windows, build_windows, window_width
from analysis.resistance.recording import (
    UNCALIBRATED_SCALE_STD,
    SpeedScale,
    check_recorded,
    effort_times,
    prepare,
    recorded_wheels,
    scale_of,
    sound,
)
from analysis.resistance.regression import BRAKE_SCALE_STD, CLUSTER, White
from analysis.view import Given, TripView, view_of
from estimators.regression import Cut, Free, Regression, regress
from trainlog.arrays import FloatArray, robust_std
from trainlog.display import counted
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import largest_load, passport_of, recorded_load, with_passport
from trainlog.ingest.motion import suspect_efforts
from trainlog.ingest.recording import Finding
from trainlog.railway.adhesion import DRY, WET, CreepCurve, creep_coefficients
from trainlog.railway.passport import Passport, Quantity, Source
from trainlog.railway.resistance import OVER_MASS_STD, TERMS
from trainlog.railway.train import Train
from trainlog.resampling import interpolated
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, seconds
from trainlog.units import GRAVITY, KMH

TOPICS = ("/train/state", "/train/controls", "/train/axles", "/gnss/motion")
READ = (*TOPICS, "/environment", "/estimates/state")
"""What is read of a log."""

GAIN_STD = 0.06
"""Standard deviation of recorded over true effort before a trip is seen: a converter estimates the
torque of its motors to some per cent, and wheels are worn by some."""

EFFORT_DRIFT = 0.004
"""Standard deviation of what the gain wanders by over a trip, as motors grow warm."""

SAMPLING = 0.04
"""Standard deviation of a delay for efforts that are straight lines between samples, over the time
between two of them."""

DELAY_STD = 0.25
"""Standard deviation of the delay [s] where the trip does not show it."""

DELAYS = -0.5, 2.5
"""Delays [s] between which the least squares are sought."""

SAME_DELAY = 0.002
"""A change of the delay [s] in a step that ends the search."""

STEPS = 8
"""Most steps of the search."""

LEAST_DELAY = 0.02
"""Smaller delays [s] are not corrected."""

MOST_DELAY = 1.0
"""Standard deviation [s] of the delay that is sought, beforehand."""

RESISTANCE_SHARE = 0.3
"""Standard deviation of each coefficient of running resistance, over that of the train's file."""

LEAST_WINDOWS = 60
"""Fewer windows of a second than this do not show delay and gain."""

FEWEST_CLUSTERS = 8
"""Fewer clusters of windows than this do not show how windows err together."""

SHORT_TRIP = 2.0
"""Standard deviations are taken so many times larger where there are fewer."""

ANY_UNIT = 1e4
"""Recorded efforts may be in any unit: one over their gain has this standard deviation."""

LARGEST_DELAY_STD = 0.15
"""A delay known worse than this [s] is not taken from the trip."""

LARGEST_RATIO_STD = 0.08
"""Effort over mass known worse than this is not taken from the trip."""

CUT = Cut(5.0, own_scale=True)
"""Of windows, whose noise is not sized here."""

OUTLIER = 5.0
"""Speeds that differ by more than so many standard deviations are left out of their ratio."""

SHARPER = 0.6
"""Gain and load count as estimated where the trip leaves less of their standard deviation."""

NO_TRAIN = Quantity(np.nan, np.nan, "assumed", "the trip has no train")
"""Load and mass of a trip of no train."""

NO_LEAD = Quantity(0.0, 0.0, "recorded")
"""Lead by creep where the speeds of all powered wheels are recorded: their momentum is known."""

PEAKS = 41
"""Maxima of adhesion over which the lead by creep is averaged."""

LEAST_PEAK = 0.06
"""Lowest maximum adhesion of a rail on which wheels were seen to slip, as under leaves."""

ADHESION_QUANTILE = 0.99
"""Share of the seconds that use no more adhesion than what counts as the most that was used."""

SHARED_LEAD = 0.5
"""Share of the variance of the lead by creep that is alike on all trips of a train."""

LAGS = 0.5
"""Noise of a speed is looked for over lags up to this [s]."""

SLOWEST = 3.0
"""Speeds below this [m/s] say nothing of a wheel's diameter."""

COASTING = 0.15
"""Wheels creep little while the effort is below this share of the largest."""

RATIO_STRETCH = 200
"""Samples over which a wheel's speed may err together, as it creeps."""

LEAST_GAIN = 0.02
"""A gain that differs from 1 by no more than this is not stated."""

DOUBTFUL_RATIO = 0.05
"""Axle efforts that differ from the total by more than this are stated."""


def passport(trip: Given, fleet: Iterable[Passport] = ()) -> Passport:
    """What is known of a trip's recorder and load: the stored passport, or else an estimate.

    Parameters
    ----------
    trip : Trip or path
        A trip at hand, or a log. Its line and its train, speed, chainage and efforts show delay
        and gain of the efforts; without them these are assumed, with the reason.
    fleet : iterable of Passport, optional
        Of other trips of the same train and recorder whose load was recorded: what they show of
        gain and load is known beforehand.

    Returns
    -------
    Passport

    Raises
    ------
    LogError
        If the log cannot be read, or its metadata state a load that is none.
    InputError
        If the trip is neither a trip nor the path of a log, or its line, train or stored passport
        is not one.

    Notes
    -----
    The load is that of the metadata ``load`` [kg], with the standard deviation ``load_std`` [kg]
    or else that of a weighing by air springs; the truth of simulated trips is not read.

    Examples
    --------
    >>> found = passport("sample_logs/stopping.mcap")
    >>> low, high = found.effort_delay.band
    >>> bool(low < 0.05 and high > -0.05 and found.effort_delay.std < 0.05)
    True
    >>> bool(abs(found.axle_effort_ratio.value - 1.0) < 0.01)
    True
    """
    view = view_of(trip, READ)
    stored = passport_of(view.trip)
    return estimated_passport(view, fleet) if stored is None else stored


def estimated_passport(trip: Given, fleet: Iterable[Passport] = ()) -> Passport:
    """The passport that a trip's samples and metadata give, whatever is stored; see `passport`."""
    view, others = view_of(trip, READ), tuple(fleet)
    return _estimated(view, others) if others else view.once(_estimated)


def _estimated(view: TripView, fleet: tuple[Passport, ...] = ()) -> Passport:
    trip = view.trip
    train = view.train if TRAIN_ATTACHMENT in trip.attachments else None
    findings = [f"{each.column}: {each.note}" for each in view.once(suspected_efforts)]
    prior = _prior(trip, train, fleet)
    noise = _speed_noise(trip)
    scale = _scale(view, findings)
    delay, ratio, lead = _delay_and_ratio(view, noise)
    gain, load, mass = _gain_and_load(prior, ratio, train)
    sample_time = {
        name: round(float(np.median(np.diff(seconds(frame)))), 6)
        for name, frame in trip.topics.items()
        if name in TOPICS and len(frame) > 2
    }
    found = Passport(
        trip=trip.name,
        effort_delay=delay,
        effort_gain=gain,
        mass=mass,
        load=load,
        effort_over_mass=ratio,
        axle_effort_ratio=_axle_effort_ratio(trip, train),
        speed_noise=noise,
        wheel_factor=_wheel_factors(trip, train, scale),
        sample_time=sample_time,
        creep_lead=lead,
    )
    return replace(found, findings=(*findings, *_findings(found, prior)))


def with_estimated_passport(trip: Trip) -> Trip:
    """The trip with the passport that its samples and metadata give, stored in it.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> trip = with_estimated_passport(read_log("sample_logs/stopping.mcap"))
    >>> passport_of(trip).trip, trip.provenance[-1]["step"]
    ('trip-03', 'passport')
    """
    return with_passport(trip, estimated_passport(trip))


def suspected_efforts(view: TripView) -> list[Finding]:
    """Efforts of a trip that are of another unit by the motion."""
    train = view.train if TRAIN_ATTACHMENT in view.trip.attachments else None
    return list(suspect_efforts(view.trip, train))


@dataclass(frozen=True, slots=True)
class _Prior:
    """What is known of gain and load before the trip's motion is seen.

    Attributes
    ----------
    gain, gain_std : float
    loads, weight : (n,) array [kg], [1]
        Loads that may be, and how probable each is.
    load : Quantity [kg]
        Their mean and standard deviation.
    """

    gain: float
    gain_std: float
    loads: FloatArray
    weight: FloatArray
    load: Quantity


def _prior(trip: Trip, train: Train | None, fleet: tuple[Passport, ...]) -> _Prior:
    """What is known beforehand: by the recorded load, by other trips, or by the train's file."""
    weighed = [each for each in fleet if each.load.source == "recorded" and each.load.known]
    gain, gain_std = 1.0, GAIN_STD
    gains = [each.effort_gain for each in weighed if each.effort_gain.source == "estimated"]
    if gains:
        values = np.array([each.value for each in gains])
        weights = np.array([each.std**-2.0 for each in gains])
        gain = float(values @ weights / weights.sum())
        # One recorder errs alike on all trips; what the trips differ by may be its drift.
        gain_std = float(np.hypot(weights.sum() ** -0.5, np.sqrt(np.average((values - gain) ** 2))))
    recorded, steps = recorded_load(trip, train), np.linspace(-5.0, 5.0, 201)
    load, loads, weight = recorded or NO_TRAIN, np.zeros(1), np.ones(1)
    if train is not None and recorded is not None:
        loads = np.maximum(recorded.value + max(recorded.std, 1.0) * steps, 0.0)
        weight = np.exp(-0.5 * steps**2)
    elif train is not None:
        largest = largest_load(train)
        loads, weight = np.linspace(0.0, largest, steps.size), np.ones(steps.size)
        reason = "no load recorded; uniform up to the maximum"
        if len(weighed) > 2:
            known = np.array([each.load.value for each in weighed])
            away = (loads - known.mean()) / max(known.std(), 0.05 * largest)
            weight = np.exp(-0.5 * away**2)
            reason = f"no load recorded: that of {len(weighed)} other trips is taken"
        load = Quantity(*_moments(loads, weight), "assumed", reason)
    return _Prior(gain, gain_std, loads, weight / weight.sum(), load)


def _moments(values: FloatArray, weight: FloatArray) -> tuple[float, float]:
    """Mean and standard deviation of values, by how probable each is."""
    mean = float(np.average(values, weights=weight))
    return mean, float(np.sqrt(np.average((values - mean) ** 2, weights=weight)))


def _gain_and_load(
    prior: _Prior, ratio: Quantity, train: Train | None
) -> tuple[Quantity, Quantity, Quantity]:
    """Gain, load and mass, from what was known of them and effort over mass.

    With ``g = k m0 / (m0 + load)`` and g normal beforehand, every load has its probability; the
    moments of gain and load are sums over the loads.
    """
    empty = np.nan if train is None else train.mass
    if train is None or ratio.source != "estimated":
        assumed = Quantity(prior.gain, prior.gain_std, "assumed", ratio.reason)
        mass = NO_TRAIN if train is None else replace(prior.load, value=empty + prior.load.value)
        return assumed, prior.load, mass
    share = empty / (empty + prior.loads)
    shown, shown_std = ratio.value * share, ratio.std * share
    spread = np.hypot(prior.gain_std, shown_std)
    log_weight = np.log(prior.weight) - 0.5 * ((shown - prior.gain) / spread) ** 2 - np.log(spread)
    weight = np.exp(log_weight - log_weight.max())
    weight /= weight.sum()
    variance = (prior.gain_std * shown_std / spread) ** 2
    gains = (prior.gain * shown_std**2 + shown * prior.gain_std**2) / spread**2
    (gain, apart), (load, load_std) = _moments(gains, weight), _moments(prior.loads, weight)
    gain_std = float(np.hypot(apart, np.sqrt(variance @ weight)))
    if gain_std < SHARPER * prior.gain_std:
        of_gain = Quantity(gain, gain_std, "estimated")
    else:
        # Its expected square about what is assumed: all trips of a recorder are taken alike.
        gain_std = float(np.hypot(gain_std, gain - prior.gain))
        reason = "effort gain and load cannot be separated: no load recorded"
        of_gain = Quantity(prior.gain, gain_std, "assumed", reason)
    loaded = prior.load
    if loaded.source == "assumed":
        narrow = load_std < SHARPER * loaded.std
        loaded = replace(loaded, value=load, std=load_std)
        loaded = replace(loaded, source="estimated", reason="") if narrow else loaded
    return of_gain, loaded, replace(loaded, value=empty + loaded.value)


def _delay_and_ratio(
    view: TripView, noise: dict[str, Quantity]
) -> tuple[Quantity, Quantity, Quantity]:
    """Delay of the efforts, effort over mass, and the lead by creep that is taken out of the delay.

    With the reason where the trip shows none of them.
    """
    try:
        for attachment, what in (
            (TRAIN_ATTACHMENT, "train"),
            (LINE_ATTACHMENT, "line, whose gradients are needed"),
        ):
            if attachment not in view.trip.attachments:
                raise NotIdentifiableError(f"the trip has no {what}")
        check_recorded(view.located)
        return _Motion(view, noise).quantities()
    except NotIdentifiableError as error:
        reason = str(error).removeprefix(f"trip '{view.name}': ")
        none = Quantity(np.nan, np.nan, "assumed", reason)
        if "/train/controls" not in view.trip:
            return none, none, NO_LEAD
        return Quantity(0.0, DELAY_STD, "assumed", reason), none, NO_LEAD


class _Motion:
    """The equation of motion of one trip, for efforts shifted by any delay."""

    def __init__(self, view: TripView, noise: dict[str, Quantity]) -> None:
        self._view, self._train, self._scale = view, view.train, scale_of(view)
        # By it the rotating parts' share of the inertia: half a load off biases the gain by 0.5 %.
        load = recorded_load(view.trip, view.train)
        self._mass = view.train.mass + (
            0.5 * largest_load(view.train) if load is None else load.value
        )
        time = seconds(view.trip["/train/state"])
        step = float(np.median(np.diff(time)))
        self._width = window_width(time, effort_times(view.trip))
        self._slipped = False
        self._sampling = SAMPLING * step
        white = noise["/train/state.speed"].value if "/train/state.speed" in noise else np.nan
        per_end = (white if np.isfinite(white) else 0.1) * np.sqrt(step / self._width)
        self._noise = Expected.on(view.line).sizes._replace(speed=max(float(per_end), 0.002))

    def quantities(self) -> tuple[Quantity, Quantity, Quantity]:
        """Delay, effort over mass, and lead by creep.

        The efforts are shifted by what is left of their delay until nothing is.
        """
        delay = 0.0
        for _ in range(STEPS):
            windows = self._windows(delay)
            found = self._regressed(windows)
            change, delay_std = found.over("delay", "1/m")
            delay += change
            if abs(change) < SAME_DELAY or not DELAYS[0] <= delay <= DELAYS[1]:
                break
        if not DELAYS[0] < delay < DELAYS[1]:
            raise NotIdentifiableError(
                f"no delay of the efforts from {DELAYS[0]:g} to {DELAYS[1]:g} s explains the motion"
            )
        delay_std = float(np.hypot(delay_std, self._sampling))
        ratio = 1.0 / (found["1/m"] * self._train.mass)
        # A wrong speed scale enters like mass; so does a wrong share of the rotating parts.
        turning = self._train.rotating_mass / self._mass * GAIN_STD
        parts = (found.std("1/m") / found["1/m"], self._scale.std, turning, EFFORT_DRIFT)
        ratio_std = ratio * float(np.linalg.norm(parts))
        if not delay_std < LARGEST_DELAY_STD or not ratio > 0.0:
            raise NotIdentifiableError(
                "the efforts vary too little for their delay to be seen in the motion"
            )
        used = windows.select(found.kept)
        force = np.quantile(np.abs(used.x[:, 0] + used.momentum) / used.duration, ADHESION_QUANTILE)
        share = self._train.axles.adhesive_mass / self._train.mass
        lead = self.creep_lead(float(force) * found["1/m"] / (GRAVITY * share))
        late = Quantity(delay + lead.value, float(np.hypot(delay_std, lead.std)), "estimated")
        if not ratio_std < LARGEST_RATIO_STD * ratio:
            reason = "the efforts vary too little for the mass to be seen in the motion"
            return late, Quantity(np.nan, np.nan, "assumed", reason), lead
        return late, Quantity(ratio, ratio_std, "estimated"), lead

    def creep_lead(self, used: float) -> Quantity:
        """By how much efforts seem early as wheels creep [s], from the most adhesion in use.

        Any from none, for a stiff contact, to that of the soft curves of Zhao et al. (2025), with
        all maxima from the wet rail's, or what was used, to the dry rail's taken for as probable;
        from what was used on where wheels slipped. The compliance is that from no effort to the
        largest, slip speed over force.
        """
        axles = self._train.axles
        if recorded_wheels(self._view.trip) == axles.count or not axles.rotating_mass > 0.0:
            return NO_LEAD
        peak = max(used, LEAST_PEAK if self._slipped else WET.peak)
        peaks = np.linspace(min(peak, 0.99), max(min(peak, 0.99), DRY.peak), PEAKS)
        slip = np.array([_creep_at(used, *each) for each in creep_coefficients(peaks).tolist()])
        weight = GRAVITY * axles.adhesive_mass * self._mass / self._train.mass
        turning = min(axles.rotating_mass * axles.count, self._train.rotating_mass)
        soft = turning * slip / (weight * max(used, 1e-6))
        # Uniform from 0 to each of them.
        mean = 0.5 * float(soft.mean())
        std = float(np.sqrt(np.mean(soft**2) / 3.0 - mean**2))
        reason = "the speeds of the wheels, which creep, are not recorded"
        return Quantity(mean, std, "assumed", reason)

    def _windows(self, delay: float) -> Windows:
        """Windows with the efforts shifted by a delay [s]."""
        prepared = prepare(self._view, with_effort_delay(sound(self._view), delay))
        self._slipped = bool(prepared.masks["slip"].any())
        windows = build_windows(prepared, self._width)
        if windows.count < LEAST_WINDOWS:
            raise NotIdentifiableError(
                f"only {counted(windows.count, 'second')} can be used: the rest is standstill,"
                " friction braking, slip or gaps"
            )
        return windows

    def _regressed(self, windows: Windows) -> Regression:
        """What is left of the delay, and the mass, in the measure of the efforts."""
        mass, coefficients = self._mass, self._train.resistance.coefficients
        spread = RESISTANCE_SHARE * np.abs(coefficients) / mass + 0.01 * np.array(OVER_MASS_STD)
        free = [
            # The momentum of the rotating parts stands on the left: it is no effort.
            Free("1/m", windows.x[:, 0] + windows.momentum, ANY_UNIT / mass, 1.0 / mass),
            *map(Free, TERMS, windows.x[:, 1:].T, spread, coefficients / mass),
            Free("delay", windows.effort_change, MOST_DELAY / mass),
            Free("brake", windows.braking, BRAKE_SCALE_STD / mass),
        ]
        left = windows.y + windows.momentum / mass
        found = regress(White(windows, mass, free, left, self._noise), free, CUT)
        rest = max(len(found.rows) - len(free), 1)
        least = max(1.0, float(found.residual @ found.residual) / rest)
        larger, _, count = found.clustered(windows.start[found.kept] // CLUSTER)
        if count < FEWEST_CLUSTERS:
            return found.wider(SHORT_TRIP * np.sqrt(least))
        # So few clusters know their own spread as badly as Student's t says.
        student = float(stdtrit(count - 1, 0.975)) / 1.96
        return found.wider(student * np.sqrt(np.maximum(larger, least)))


def _creep_at(adhesion: float, a: float, b: float, scale: float) -> float:
    """Slip speed [m/s] at an adhesion on a creep curve, at most that of its maximum."""
    curve = CreepCurve(a, b, scale, scale)
    slips = curve.peak_slip * np.linspace(0.0, 1.0, 201)
    return float(np.interp(adhesion, curve(slips), slips))


def shared_delay_std(known: Passport) -> float:
    """Part [s] of the delay's standard deviation by which all trips of a train err alike.

    Half the variance of the lead by creep: the form of the curve lasts, the rail changes.
    """
    return float(np.sqrt(SHARED_LEAD) * known.creep_lead.std)


def with_effort_delay(trip: Trip, delay: float) -> Trip:
    """The trip with its recorded efforts where they belong: earlier by their delay [s].

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> trip = read_log("sample_logs/stopping.mcap")
    >>> earlier = with_effort_delay(trip, 0.2)
    >>> (trip["/train/controls"].index[0] - earlier["/train/controls"].index[0]).total_seconds()
    0.2
    """
    if delay == 0.0 or "/train/controls" not in trip:
        return trip
    frame = trip["/train/controls"]
    index = pd.DatetimeIndex(frame.index) - pd.Timedelta(round(1e9 * delay), "ns")
    return trip.with_topic(frame.set_axis(index))


def with_calibrated_efforts(trip: Trip, known: Passport) -> Trip:
    """The trip with its efforts as they were, by its passport: in time, and in their true size.

    All of ``/train/controls`` is taken to be late alike, the efforts of the axles as well; demands
    are in the measure of the efforts. What the passport does not know stays as it is, and so does a
    delay that is not distinguished from none.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> trip = read_log("sample_logs/stopping.mcap")
    >>> known = replace(passport(trip), effort_gain=Quantity(0.5, 0.01, "estimated"))
    >>> found = with_calibrated_efforts(trip, known)
    >>> largest = [each["/train/controls"]["tractive_effort"].max() for each in (trip, found)]
    >>> round(float(largest[1] / largest[0]), 6)
    2.0
    """
    delay = known.motion_delay.value if known.motion_delay.known else 0.0
    if abs(delay) < max(LEAST_DELAY, 2.0 * known.motion_delay.std):
        delay = 0.0
    gain = known.effort_gain.value if known.effort_gain.known else 1.0
    ratio = known.axle_effort_ratio.value if known.axle_effort_ratio.known else 1.0
    ratio = ratio or 1.0  # axle efforts of 0 throughout
    if "/train/controls" in trip:
        trip = _scaled(with_effort_delay(trip, delay), "/train/controls", 1.0 / gain)
    if "/train/axles" not in trip or not (known.motion_delay.known or known.effort_gain.known):
        return trip
    axles = trip["/train/axles"]
    time = seconds(axles)
    moved = {
        name: np.interp(time + delay, time, axles[name].to_numpy(np.float64))
        for name in axles.columns
        if name.startswith("wheel_effort_")
    }
    trip = trip.with_topic(axles.assign(**moved))
    return _scaled(trip, "/train/axles", 1.0 / (gain * ratio))


def _scaled(trip: Trip, topic: str, factor: float) -> Trip:
    """The trip with the efforts of a topic times a factor."""
    frame = trip[topic]
    scaled = {name: factor * frame[name] for name in frame.columns if "effort" in name}
    return trip.with_topic(frame.assign(**scaled))


def _speed_noise(trip: Trip) -> dict[str, Quantity]:
    """Noise of each recorded speed, by its column."""
    return {
        f"{topic}.{name}": _noise_of(seconds(trip[topic]), trip[topic][name].to_numpy(np.float64))
        for topic in ("/train/state", "/gnss/motion", "/train/axles")
        if topic in trip
        for name in trip[topic].columns
        if re.fullmatch(r"speed|wheel_speed_\d+", name)
    }


def _noise_of(time: FloatArray, speed: FloatArray) -> Quantity:
    """Standard deviation of a speed's noise, from its second differences while the train moves.

    The median, so that the starts and ends of brake applications and slips do not count; over the
    lag of those up to `LAGS` at which it is largest, so that noise is found that lasts for some
    samples.
    """
    moving = np.isfinite(speed) & (speed > SLOWEST) & (np.diff(time, prepend=-np.inf) > 0.0)
    t, v = time[moving], speed[moving]
    if v.size < 50:
        return Quantity(np.nan, np.nan, "assumed", "too few samples in motion")
    step = float(np.median(np.diff(t)))
    best, count = 0.0, 1
    lag = 1
    while lag == 1 or lag * step <= LAGS:
        even = np.abs(t[2 * lag :] - t[: -2 * lag] - 2.0 * lag * step) < 0.2 * step
        second = (v[2 * lag :] - 2.0 * v[lag:-lag] + v[: -2 * lag])[even]
        if second.size >= 50:
            size = _spread(second) / np.sqrt(6.0)
            if size > best:
                best, count = size, second.size // lag
        lag *= 2
    if best == 0.0:
        return Quantity(np.nan, np.nan, "assumed", "its noise is below its resolution")
    # A median deviation is worth 37 % of the samples; second differences are worth a third.
    return Quantity(best, best * float(np.sqrt(0.5 / (0.37 * max(count / 3.0, 1.0)))), "estimated")


def _spread(values: FloatArray) -> float:
    """Standard deviation by the median; of values that are mostly alike by all of them."""
    spread = robust_std(values)
    return spread if spread > 0.0 else float(np.sqrt(np.mean(np.minimum(values**2, 1.0))))


def _scale(view: TripView, findings: list[str]) -> SpeedScale:
    """The scale of the train's speed; a contradiction becomes a finding."""
    nothing = SpeedScale(1.0, UNCALIBRATED_SCALE_STD, "nothing")
    if "/train/state" not in view.trip or len(view.trip["/train/state"]) < 2:
        return nothing
    try:
        return scale_of(view)
    except NotIdentifiableError as error:
        findings.append(str(error).removeprefix(f"trip '{view.name}': "))
        return nothing


def _wheel_factors(trip: Trip, train: Train | None, scale: SpeedScale) -> tuple[Quantity, ...]:
    """Recorded over true speed of each axle: over the train's speed, times the scale of that."""
    if "/train/axles" not in trip or "/train/state" not in trip:
        return ()
    axles, state = trip["/train/axles"], trip["/train/state"]
    names = [name for name in axles.columns if name.startswith("wheel_speed_")]
    index = pd.DatetimeIndex(axles.index)
    own = interpolated(state, "speed", index, 2.0)
    effort = _total_effort(trip, index)
    calm = np.isfinite(own) & (own > SLOWEST)
    if train is not None and np.isfinite(effort).any():
        coasting = calm & (np.abs(effort) < COASTING * train.max_tractive_effort)
        calm = coasting if np.count_nonzero(coasting) > 100 else calm
    found = []
    for name in names:
        wheel = axles[name].to_numpy(np.float64)
        used = calm & np.isfinite(wheel)
        if np.count_nonzero(used) < 50:
            found.append(Quantity(np.nan, np.nan, "assumed", "too few samples in motion"))
            continue
        middle, spread = ratio_of_speeds(wheel[used], own[used])
        std = float(np.hypot(scale.std * middle, spread))
        measured = scale.source != "nothing"
        reason = "" if measured else "neither satellites nor distance show the train's true speed"
        source: Source = "estimated" if measured else "assumed"
        found.append(Quantity(middle * scale.factor, std, source, reason))
    return tuple(found)


def ratio_of_speeds(speed: FloatArray, reference: FloatArray) -> tuple[float, float]:
    """Ratio of two recorded speeds and its standard deviation, also of speeds that are rounded.

    Of rounded speeds the median ratio is that of two numbers on the display; the ratio of the sums
    is not drawn to them. Samples beyond `OUTLIER` standard deviations of the difference are left
    out. Neighbouring samples err together, by stretches of `RATIO_STRETCH` samples; all samples
    that show the same number err by the same part of the resolution.

    Parameters
    ----------
    speed, reference : (n,) array [m/s]
        Finite and positive, in order of time; at least two stretches.

    Examples
    --------
    A wheel of 0.2 % more, displayed in steps of 0.1 km/h:

    >>> import numpy as np
    >>> true = np.linspace(5.0, 25.0, 2000)
    >>> shown = [np.round(36.0 * each) / 36.0 for each in (1.002 * true, true)]
    >>> print("{:.4f} ± {:.4f}".format(*ratio_of_speeds(*shown)))
    1.0020 ± 0.0000
    """
    ratio = float(np.median(speed / reference))
    coarse = _resolution(speed), _resolution(reference)
    for _ in range(3):
        apart = speed - ratio * reference
        middle = float(np.median(apart))
        size = robust_std(apart - middle)
        near = np.abs(apart - middle) <= OUTLIER * np.hypot(size, np.hypot(coarse[0], coarse[1]))
        ratio = float(np.sum(speed[near]) / np.sum(reference[near]))
    v, u = speed[near], reference[near]
    apart = v - ratio * u
    sums = np.add.reduceat(apart, np.arange(0, apart.size, RATIO_STRETCH))
    variance = float(sums @ sums) * sums.size / max(sums.size - 1, 1)
    for values, step in zip((v, u), coarse, strict=True):
        alike = np.unique(np.round(values / step), return_counts=True)[1].astype(np.float64)
        variance += step**2 / 12.0 * float(alike @ alike)
    return ratio, float(np.sqrt(variance) / np.sum(u))


def _resolution(speed: FloatArray) -> float:
    """Step [m/s] between the numbers that a speed was recorded as."""
    steps = np.diff(np.unique(np.round(speed, 6)))
    return float(np.median(steps)) if steps.size else 1.0 / KMH


def _total_effort(trip: Trip, index: pd.DatetimeIndex) -> FloatArray:
    """Traction less dynamic braking [N] at the instants; NaN where traction is not recorded."""
    if "/train/controls" not in trip:
        return np.full(len(index), np.nan)
    controls = trip["/train/controls"]
    traction = interpolated(controls, "tractive_effort", index, 2.0)
    braking = interpolated(controls, "dynamic_braking_effort", index, 2.0)
    return np.asarray(traction - np.nan_to_num(braking))


def _axle_effort_ratio(trip: Trip, train: Train | None) -> Quantity:
    """Sum of the axles' efforts over that of the train, by the median over stretches of effort."""

    def unknown(reason: str) -> Quantity:
        return Quantity(np.nan, np.nan, "assumed", reason)

    if "/train/axles" not in trip or "/train/controls" not in trip:
        return unknown("no axle efforts recorded" if "/train/controls" in trip else "no efforts")
    axles = trip["/train/axles"]
    names = [name for name in axles.columns if name.startswith("wheel_effort_")]
    efforts = axles[names].to_numpy(np.float64)
    known = np.isfinite(efforts).any(axis=0) if len(efforts) else np.zeros(len(names), dtype=bool)
    powered = len(names) if train is None else train.axles.count
    if not known.any():
        return unknown("no axle efforts recorded")
    if np.count_nonzero(known) < powered:
        return unknown(f"efforts of {np.count_nonzero(known)} axles of {powered} recorded")
    together = efforts.sum(axis=1)
    total = _total_effort(trip, pd.DatetimeIndex(axles.index))
    both = np.isfinite(together) & np.isfinite(total)
    least = 0.1 * float(np.max(np.abs(total[both]), initial=0.0))
    # Dynamic braking is left out where it is not recorded: then the axles show more than the total.
    used = both & (np.abs(total) > max(least, 1.0))
    if np.count_nonzero(used) < 50:
        return unknown("too few samples under effort")
    ratio = together[used] / total[used]
    blocks = np.array_split(ratio, 25)
    medians = np.array([np.median(block) for block in blocks])
    spread = 1.2533 * float(np.std(medians)) / np.sqrt(medians.size)
    return Quantity(float(np.median(ratio)), spread, "estimated")


def gain_words(found: Passport) -> str:
    """Efforts that differ from what the motion needs, and the load that would explain them."""
    gain, load = found.effort_gain, found.load
    if gain.source != "estimated" or abs(gain.value - 1.0) <= max(2.0 * gain.std, LEAST_GAIN):
        return ""
    words = f"recorded efforts are {gain.value:.3f} times the true ones"
    if load.source != "recorded" or not found.mass.known:
        return words
    other = load.value + (gain.value - 1.0) * found.mass.value
    likely = f"; a load of {other / 1e3:.1f} t would explain them" if other >= 0.0 else ""
    return (
        f"{words} if the stated load of {load.value / 1e3:.1f} t is right{likely}: check the load"
    )


def _findings(found: Passport, prior: _Prior) -> list[str]:
    """What a reader should know, in sentences."""
    sentences = []
    delay, gain, ratio = found.effort_delay, found.effort_gain, found.axle_effort_ratio
    if delay.source == "estimated" and min(np.abs(delay.band)) > 0.05 and np.prod(delay.band) > 0:
        late = "late" if delay.value > 0.0 else "early"
        sentences.append(f"recorded efforts are {abs(delay.value):.2f} s {late}")
    if delay.known and delay.source == "assumed":
        sentences.append(f"the delay of the efforts is not known: {delay.reason}")
    if found.effort_over_mass.known and abs(gain.value - prior.gain) > 2.5 * prior.gain_std:
        sentences.append(
            f"recorded efforts are {gain.value:.2f} times what the motion needs: check their unit,"
            " whether they are of the whole train, and the train's mass"
        )
    elif words := gain_words(found):
        sentences.append(words)
    if ratio.known and abs(ratio.value - 1.0) > max(DOUBTFUL_RATIO, 3.0 * ratio.std):
        sentences.append(f"axle efforts are {ratio.value:.2f} times the total effort")
    if not ratio.known and "axles of" in ratio.reason:
        sentences.append(f"{ratio.reason}: axle efforts are not compared with the total")
    if found.load.source != "recorded":
        sentences.append(
            "no load recorded: "
            + (
                f"{found.load.value / 1e3:.1f} ± {1.96 * found.load.std / 1e3:.1f} t is"
                f" {'estimated from the motion' if found.load.source == 'estimated' else 'assumed'}"
                if found.load.known
                else "and no train is known"
            )
        )
    return sentences
