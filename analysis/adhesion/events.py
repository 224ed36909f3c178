"""Slip events: where an axle slips, what its onset says of the maximum adhesion, what it costs.

An axle slips where it turns faster or slower than the train by more than a threshold. Modern slip
protection acts earlier: slips below the threshold are found from what it does. It cuts the effort
of the axle although the driver asks for no less, and the wheel returns to the train's speed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.axles import SLOW, PoweredAxles
from estimators.slip import NOISE_MULTIPLE, SlipDetector
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.spans import runs_of
from trainlog.topics import EVENTS, SLIP_PROTECTION, TRAIN_SLIP_PROTECTION
from trainlog.trip import SCENARIO_ATTACHMENT, Trip
from trainlog.units import NANOSECONDS

NOISE_SPAN = 0.4
"""Time over which differences of the observed adhesion are taken for noise [s]."""

ADHESION_NOISE_FLOOR = 0.002
"""Least noise of an observed adhesion that is assumed."""

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

SHARED_STD = 0.13
"""Relative standard deviation of an axle's effort that is known as a share of the total."""

SHARED_TIME = 0.5
"""Time before a slip in which the share of the total effort gives its level [s]."""

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


def protection_onsets(trip: Trip) -> pd.DatetimeIndex | None:
    """When the slip protection began to act; None where that is not recorded.

    From the topic ``/train/slip_protection``, or from events of that name. Where there are none, it
    never acted only if the recorder's profile maps its words (metadata ``slip_protection``) or the
    trip is simulated.

    Examples
    --------
    >>> import trainlog
    >>> len(protection_onsets(trainlog.read("sample_logs/stopping.mcap")))
    27
    """
    frame = trip.topics.get(TRAIN_SLIP_PROTECTION.name)
    if frame is not None and frame["active"].notna().any():
        active = frame["active"].ffill().to_numpy() > 0.0
        return pd.DatetimeIndex(frame.index[np.diff(active, prepend=False) & active])
    if EVENTS.name not in trip:
        return None
    events = trip[EVENTS.name]
    named = (events["name"] == SLIP_PROTECTION) | events["message"].str.startswith(SLIP_PROTECTION)
    covered = "slip_protection" in trip.metadata or SCENARIO_ATTACHMENT in trip.attachments
    return pd.DatetimeIndex(events.index[named]) if covered or named.any() else None


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
    return max(float(np.median(loaded) / 0.6745 / np.sqrt(2.0)), ADHESION_NOISE_FLOOR)


def event_rows(motion: Motion, slipping: BoolArray) -> pd.DataFrame:
    """One row a slip event; see `analysis.adhesion.slip.SlipAnalysis`."""
    axles = motion.axles
    noise = adhesion_noise(axles.time, motion.adhesion)
    last = len(axles.clock) - 1
    rows = []
    for axle in range(slipping.shape[1]):
        for start, stop in runs_of(slipping[:, axle]):
            peak = start + int(np.nanargmax(np.abs(motion.slip_speed[start:stop, axle])))
            at, found = _onset_of(motion, axle, start, peak, noise)
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
                    **{name: axles.clock[row] for name, row in times.items()},
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
    clock = axles.clock.dtype
    columns = {
        "axle": "int64", "start": clock, "onset": clock, "peak": clock, "release": clock,
        "duration": "float64", "kind": "str", "position": "float64", "speed": "float64",
        "peak_slip": "float64", "creepage": "float64", "adhesion": "float64",
        "adhesion_std": "float64", "delay_std": "float64", "transfer_std": "float64",
        "energy": "float64", "energy_std": "float64", "measured": "bool",
    }  # fmt: skip
    frame = pd.DataFrame(rows, columns=list(columns)).astype(columns)
    frame.attrs["units"] = {
        "duration": "s", "position": "m", "speed": "m/s", "peak_slip": "m/s", "creepage": "1",
        "adhesion": "1", "adhesion_std": "1", "delay_std": "1", "transfer_std": "1", "energy": "J",
        "energy_std": "J",
    }  # fmt: skip
    if axles.level == "shared" and len(frame):
        later = _after_others(frame)
        frame["measured"] &= ~later
        frame.loc[later, ["energy", "energy_std"]] = np.nan
    return frame


def _after_others(events: pd.DataFrame) -> BoolArray:
    """Events before which another axle slipped so shortly that it does not pull its share yet."""
    starts, ends = (pd.DatetimeIndex(events[n]).as_unit("ns").asi8 for n in ("start", "release"))
    recovered = ends + round(RECOVERY * NANOSECONDS)
    earlier = (starts[None, :] < starts[:, None]) & (recovered[None, :] > starts[:, None])
    return np.asarray(earlier.any(axis=1))


def _energy_of(
    motion: Motion, axle: int, span: tuple[int, int], found: dict[str, Any], noise: float
) -> tuple[float, float]:
    """Energy [J] that the slip turned into heat between two samples, and its std [J].

    The work of the adhesion force over the slip. Its errors: those of force and train speed last
    about as long as an event, so that their work adds up; the gain of the efforts; their delay; and
    the integral itself, as far as it changes with every other sample left out. Where only the total
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
        relative = np.hypot(spread / mean, SHARED_STD)
        return mean * most, float(mean * abs(most) * np.hypot(relative, axles.gain_std))
    force = motion.adhesion[rows, axle] * loads
    energy = work(force, slip_speed)
    others = [work(each[rows, axle] * loads, slip_speed) for each, _ in motion.later]
    errors = (
        work(noise * loads, np.abs(slip_speed)),
        work(np.abs(force), motion.speed_std[rows]),
        axles.gain_std * energy,
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
    first = int(np.searchsorted(axles.time, axles.time[start] - LOOK_BACK))
    # The cut of the effort falls between two samples: the last before it may be off.
    used = direction * motion.adhesion[first : max(peak, first + 1), axle]
    effort = direction * axles.wheel_effort[:, axle]
    top, fell = onset(used, noise)
    others = [_level(motion, axle, start, peak, noise, each) for each in motion.later]
    at = first + int(top[top.size // 2])
    after = int(np.searchsorted(axles.time, axles.time[peak] + CUT_TIME))
    cut = bool(effort[peak : after + 1].min() < CUT * effort[peak])
    adhesion, known = float(used[top].mean()), bool(axles.levelled[axle])
    spread = 0.0
    if motion.share is not None:
        # When whose effort is cut is not known: the level is what the axle used just before.
        before = int(np.searchsorted(axles.time, axles.time[start] - SHARED_TIME))
        shared = direction * motion.share[before : start + 1, axle]
        at, adhesion = start, float(shared.max())
        spread = SHARED_STD * abs(adhesion)
    spread_by_transfer = 0.0 if motion.transfer_known else TRANSFER * adhesion**2
    delayed = np.sqrt(np.mean((np.array(others) - adhesion) ** 2)) if others else 0.0
    return at, {
        "kind": "traction" if direction > 0.0 else "braking",
        "adhesion": adhesion if known else np.nan,
        "adhesion_std": np.hypot(noise, spread) if known else np.nan,
        "delay_std": float(delayed) if known else np.nan,
        "transfer_std": spread_by_transfer if known else np.nan,
        "measured": known and adhesion > 0.0 and (fell or cut),
    }


def _level(
    motion: Motion,
    axle: int,
    start: int,
    peak: int,
    noise: float,
    other: tuple[FloatArray, FloatArray | None],
) -> float:
    """Level of one event with other efforts: their adhesion, and share, at the axles' samples."""
    time = motion.axles.time
    direction = np.sign(motion.slip_speed[peak, axle])
    adhesion, share = other
    if share is not None:
        before = int(np.searchsorted(time, time[start] - SHARED_TIME))
        return float((direction * share[before : start + 1, axle]).max())
    first = int(np.searchsorted(time, time[start] - LOOK_BACK))
    used = direction * adhesion[first : max(peak, first + 1), axle]
    return float(used[onset(used, noise)[0]].mean())


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
