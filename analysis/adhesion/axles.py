"""The powered axles as a trip recorded them, calibrated by the trip's passport.

What a recorder lacks is stated, not made up: an axle without speed is not seen, one without effort
has no level of adhesion. Of efforts that are late or too large the passport knows by how much; how
heavy the train is, too, and with what uncertainty.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.resistance.passport import DELAY_STD
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import LogError, NotRecordedError
from trainlog.railway.passport import Passport
from trainlog.railway.train import Train
from trainlog.resampling import interpolated
from trainlog.topics import (
    EVENTS,
    SLIP_PROTECTION,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_SLIP_PROTECTION,
)
from trainlog.trip import SCENARIO_ATTACHMENT, Trip, seconds

Value = TypeVar("Value", np.float64, np.bool_)

LEAST_DELAY = 0.02
"""Delay of the efforts [s] below which they are left as they are recorded."""

LEAST_EARLY = 0.1
"""The same of efforts that seem early [s]: slips of axles that are not seen look like that."""

LEAST_RATIO = 0.02
"""Axle efforts that differ from the total by less than this share are left as recorded."""

STATED_RATIO = 0.05
"""Axle efforts that differ from the total by more than this share are stated."""

STATED_DELAY = 0.05
"""A delay of the efforts from which on it is stated [s]."""

KNOWN_DELAY = 0.05
"""Standard deviation of the delay of the efforts [s] up to which it is in the levels' own noise."""

STATED_GAIN = 0.03
"""A gain of the efforts that differs from 1 by more than this is stated."""

STRONG = 0.1
"""Share of the largest total effort from which on its sign is that of the axles."""

NO_EFFORT = 0.02
"""Axle efforts that sum up to less than this share of the total were not recorded."""

TURNING_SHARE = 0.45
"""By how much the level of an onset errs for an error of the gain alone: what turns the wheels
faster is known without the gain, and it is most where slip sets in."""

LONGEST_HELD, HELD = 5.0, 3.0
"""Gaps in an axle's speed or effort are bridged for so long [s], or so many of its usual steps."""

SLOW = 0.25
"""Time between samples [s] from which on short slips are missed."""


COARSE = 2.0
"""Time between samples [s] beyond which a slip measures no level: its band would be too wide."""

SLOW_STD = 0.1
"""Relative standard deviation of the levels of a trip for each second between two samples: those
seen in the slip lie below the maximum that was passed between."""

PASSAGE_STD = 0.13
"""The same of the levels that one passage of a place shows: the force changes between two samples,
and all axles are sampled at the same instants, so that their number does not make it less."""


@dataclass(frozen=True, slots=True)
class PoweredAxles:
    """The powered axles whose speed is recorded.

    Attributes
    ----------
    clock : (n,) DatetimeIndex
    time : (n,) array [s]
    count : int
        Powered axles of the train.
    numbers : (k,) int array
        Those whose speed is recorded, from 0.
    wheel_speed : (n, k) array [m/s]
        NaN in gaps.
    wheel_effort : (n, k) array [N]
        At the rims, without the recorder's delay and gain; of each axle by itself, or its share of
        the total.
    total_effort : (n,) array [N]
        Of all motors, negative in braking.
    demand : (n,) array or None
        What the driver asks for, positive in traction; its unit does not matter. None where
        neither efforts asked for nor the lever are recorded.
    level : {"axle", "shared", "none"}
        How the efforts of the axles are known: each by itself, from the total, or not.
    levelled : (k,) bool array
        Axles whose effort is known.
    shown : (n, k) bool array
        Whether a sample shows speed and effort of the axle.
    mass : float [kg]
        Of the loaded train, without the rotating part.
    axle_load : float [N]
        Weight on one powered axle.
    common_std : float
        Relative standard deviation of effort over axle load that lasts for the whole trip.
    passage_std : float
        The same for as long as the train passes a place, from what happens between two samples.
    gain_std : float
        The same of the effort alone.
    delay_std : float [s]
        Standard deviation of the delay that the efforts still have; 0 where it does not matter.
    sampling : float [s]
        Median time between samples.
    load : str
        Where the load is from: ``"recorded"``, ``"estimated"`` or ``"assumed"``.
    notes : tuple of str
        What the recorder lacks, and what was made of it.
    complete : bool
        Whether slips of every axle, also short and small ones, can be found.
    """

    clock: pd.DatetimeIndex
    time: FloatArray
    count: int
    numbers: IntArray
    wheel_speed: FloatArray
    wheel_effort: FloatArray
    total_effort: FloatArray
    demand: FloatArray | None
    level: str
    levelled: BoolArray
    shown: BoolArray
    mass: float
    axle_load: float
    common_std: float
    passage_std: float
    gain_std: float
    delay_std: float
    sampling: float
    load: str
    notes: tuple[str, ...]
    complete: bool

    def at_other_delays(self) -> tuple[PoweredAxles, ...]:
        """The same with efforts at delays one standard deviation more and less; none if known."""
        return tuple(
            replace(
                self,
                wheel_effort=np.column_stack(
                    [_earlier(self.time, each, delay) for each in self.wheel_effort.T]
                ),
                total_effort=_earlier(self.time, self.total_effort, delay),
            )
            for delay in (-self.delay_std, self.delay_std)
            if delay
        )

    def of_all(self, values: NDArray[Value], absent: float | bool = np.nan) -> NDArray[Value]:
        """Values of the recorded axles, (n, k), as values of all powered axles, (n, count)."""
        if self.numbers.size == self.count:
            return values
        whole = np.full((len(values), self.count), absent, dtype=values.dtype)
        whole[:, self.numbers] = values
        return whole


def powered_axles(trip: Trip, train: Train, known: Passport) -> PoweredAxles:
    """The powered axles of a trip, calibrated by its passport.

    Raises
    ------
    LogError
        If no axle speed is recorded, those of more axles than the train powers, or fewer than two
        samples.
    """
    frame = trip[TRAIN_AXLES.name]
    numbers, speeds, notes = _speeds(trip, frame, train)
    # A row without any wheel speed is no sample of them.
    measured = np.flatnonzero(np.isfinite(speeds).any(axis=1))
    efforts = _axle_efforts(frame, train.axles.count)
    own = None if efforts is None else efforts[measured]
    frame, speeds = frame.iloc[measured], speeds[measured]
    if len(frame) < 2:
        raise LogError(
            f"trip '{trip.name}': /train/axles holds {counted(len(frame), 'sample')}",
            remedy="record the axles over the whole trip",
        )
    time, clock = seconds(frame), pd.DatetimeIndex(frame.index)
    sampling = float(np.median(np.diff(time)))
    gain, delay, said = _corrections(known)
    total = _total(trip, clock)
    level, own, more = _level(own, total, known)
    if own is None:
        own = np.full((len(frame), train.axles.count), np.nan)
    total = _sum(own) if total is None or level == "axle" else total
    levelled = np.asarray(np.isfinite(own[:, numbers]).any(axis=0) | (level == "shared"))
    # What an axle's effort is not known to be is taken for its share, for the train's speed.
    efforts = np.where(np.isfinite(own), own, total[:, None] / train.axles.count)[:, numbers]
    if delay:
        efforts = np.column_stack([_earlier(time, each, delay) for each in efforts.T])
        total = _earlier(time, total, delay)
    passage_std = 0.0
    load = known.load.value if known.load.known else 0.0
    # The weight by which an effort without its gain gives the adhesion.
    loaded = train.adhesive_weight(load)
    if known.effort_over_mass.known:
        # The motion shows the gain times the mass together, better than each.
        loaded = train.adhesive_weight(0.0) * known.effort_over_mass.value / gain
    calibration = common_std = _common_std(train, known)
    if sampling >= SLOW:
        common_std = float(np.hypot(calibration, SLOW_STD * sampling))
        passage_std = PASSAGE_STD * sampling
        within = 1.96 * float(np.hypot(SLOW_STD, PASSAGE_STD)) * sampling
        levels = (
            f"levels are read within ± {within:.0%}; slips in which the effort only falls measure"
            " none"
            if sampling <= COARSE
            else "none measures a level"
        )
        levelled &= sampling <= COARSE
        more.append(
            f"the axles are sampled every {sampling:.2g} s: slips shorter than {2 * sampling:.2g} s"
            f" may be missed, {levels}"
        )
    return PoweredAxles(
        clock=clock,
        time=time,
        count=train.axles.count,
        numbers=numbers,
        wheel_speed=speeds,
        wheel_effort=efforts / gain,
        total_effort=total / gain,
        demand=_demand(trip, clock),
        level=level,
        levelled=levelled,
        shown=_lately(time, speeds)
        & (np.isfinite(own[:, numbers]) | ~levelled | (level != "axle")),
        mass=train.mass + load,
        axle_load=loaded / train.axles.count,
        common_std=common_std,
        passage_std=passage_std,
        gain_std=float(np.nan_to_num(known.effort_gain.std)) / gain,
        delay_std=_delay_std(known, delay) if levelled.any() else 0.0,
        sampling=sampling,
        load=known.load.source,
        notes=(*notes, *(_load_notes(known, calibration) if levelled.any() else ()), *said, *more),
        complete=numbers.size == train.axles.count and level == "axle" and sampling < SLOW,
    )


def _common_std(train: Train, known: Passport) -> float:
    """Relative standard deviation of effort over axle load that lasts for the whole trip."""
    both = known.effort_over_mass
    if both.known:
        turning = TURNING_SHARE * np.nan_to_num(known.effort_gain.std)
        return float(np.hypot(both.std / both.value, turning))
    apart = known.effort_gain.std, known.load.std / (train.mass + known.load.value)
    return float(np.hypot(*np.nan_to_num(apart)))


def _speeds(
    trip: Trip, frame: pd.DataFrame, train: Train
) -> tuple[IntArray, FloatArray, list[str]]:
    """Which axles are recorded (from 0), their speeds (n, k), and what is to be stated."""
    given = [name for name in frame.columns if name.startswith("wheel_speed_")]
    recorded = sorted(int(n.rpartition("_")[2]) for n in given if frame[n].notna().any())
    count = train.axles.count
    if not recorded:
        raise NotRecordedError(
            f"trip '{trip.name}': /train/axles has no axle speed",
            remedy="slip needs the speed of one powered axle at least",
        )
    if recorded[-1] > count:
        raise LogError(
            f"trip '{trip.name}': /train/axles has {counted(len(given), 'axle')}, train"
            f" '{train.name}' has {count} powered ones",
            remedy="map the powered axles only, or correct the number in the train file",
        )
    speeds = frame[[f"wheel_speed_{i}" for i in recorded]].to_numpy(dtype=np.float64)
    lacking = [str(i) for i in range(1, count + 1) if i not in recorded]
    notes = []
    if lacking:
        notes.append(
            f"the speed of {len(recorded)} of {count} powered axles is recorded: slips of"
            f" {'axle' if len(lacking) == 1 else 'axles'} {', '.join(lacking)} are not known"
        )
    return np.array(recorded, dtype=np.int64) - 1, speeds, notes


def _axle_efforts(frame: pd.DataFrame, count: int) -> FloatArray | None:
    """Recorded efforts of all powered axles, (n, count), short gaps held; None without any column.

    NaN throughout for axles without.
    """
    names = [f"wheel_effort_{i}" for i in range(1, count + 1)]
    if not any(name in frame.columns for name in names):
        return None
    efforts = frame.reindex(columns=names)
    held = efforts.ffill().to_numpy(dtype=np.float64)
    return np.where(_lately(seconds(frame), efforts.to_numpy(dtype=np.float64)), held, np.nan)


def _lately(time: FloatArray, values: FloatArray) -> BoolArray:
    """Whether each column (n, k) was recorded shortly before each sample, for its usual steps."""
    found = np.zeros(values.shape, dtype=np.bool_)
    for column, one in zip(found.T, values.T, strict=True):
        known = np.flatnonzero(np.isfinite(one))
        if known.size > 1:
            longest = max(LONGEST_HELD, HELD * float(np.median(np.diff(time[known]))))
            last = np.searchsorted(known, np.arange(time.size), "right") - 1
            column[:] = (last >= 0) & (time - time[known[np.maximum(last, 0)]] <= longest)
    return found


def _total(trip: Trip, clock: pd.DatetimeIndex) -> FloatArray | None:
    """Recorded effort of all motors [N] at the axles' samples, negative in braking."""
    frame = trip.topics.get(TRAIN_CONTROLS.name)
    if frame is None or not frame["tractive_effort"].notna().any():
        return None
    pull = interpolated(frame, "tractive_effort", clock)
    hold = interpolated(frame, "dynamic_braking_effort", clock)
    return np.asarray(np.nan_to_num(pull) - np.nan_to_num(hold))


def _level(
    own: FloatArray | None, total: FloatArray | None, known: Passport
) -> tuple[str, FloatArray | None, list[str]]:
    """How the efforts of the axles are known, themselves (n, count), and what is to be stated."""
    if own is None:
        if total is None:
            return "none", None, ["no efforts are recorded: slips without a level, no adhesion"]
        return (
            "shared",
            None,
            ["only the total effort is recorded: the powered axles share it by their load"],
        )
    size = float(np.nansum(np.abs(own)))
    if not size > (NO_EFFORT * np.sum(np.abs(total)) if total is not None else 0.0):
        word = "zero" if np.isfinite(own).any() else "empty"
        return "none", None, [f"the axle efforts are {word}: slips without a level, no adhesion"]
    notes, ratio = [], known.axle_effort_ratio
    if total is not None and ratio.known and abs(ratio.value - 1.0) > LEAST_RATIO:
        own = own / ratio.value
        if abs(ratio.value - 1.0) > STATED_RATIO:
            notes.append(
                f"the axle efforts sum up to {ratio.value:.2f} times the total effort:"
                " divided by it"
            )
    if total is not None:
        # Recorders may write the size of efforts alone: their sign is that of the total.
        for sign, words in ((1.0, "pull"), (-1.0, "brake")):
            strong = sign * total > STRONG * np.max(np.abs(total))
            if strong.any() and np.median(sign * _sum(own)[strong]) < 0.0:
                own = np.where((sign * total > 0.0)[:, None], -own, own)
                notes.append(
                    f"the axle efforts have the wrong sign where the motors {words}: turned"
                )
    return "axle", own, notes


def _sum(own: FloatArray) -> FloatArray:
    """Effort of all axles, those without one taken to do as the others."""
    known = np.isfinite(own)
    count = known.sum(axis=1)
    return np.asarray(np.nansum(own, axis=1) * own.shape[1] / np.maximum(count, 1))


def _corrections(known: Passport) -> tuple[float, float, list[str]]:
    """Gain and delay [s] to take out of the efforts, and what is to be stated of them."""
    gain = known.effort_gain.value if known.effort_gain.known else 1.0
    each = known.effort_delay
    shown = each.known and each.source != "assumed"
    shown &= abs(each.value) > max(LEAST_DELAY, 1.96 * each.std)
    delay = each.value if shown and not -LEAST_EARLY < each.value < 0.0 else 0.0
    notes = []
    if abs(delay) > STATED_DELAY:
        notes.append(f"the efforts are {delay:.2f} s late: shifted by that")
    if abs(gain - 1.0) > STATED_GAIN:
        notes.append(f"the efforts are {gain:.3f} times what moves the train: divided by that")
    return gain, delay, notes


def _delay_std(known: Passport, corrected: float) -> float:
    """Standard deviation [s] of the delay that remains; 0 where levels do not depend on it."""
    each = known.effort_delay
    std = float(np.hypot(each.value - corrected, each.std)) if each.known else DELAY_STD
    return std if std > KNOWN_DELAY else 0.0


def _load_notes(known: Passport, spread: float) -> list[str]:
    """What is to be stated of load and gain: where the level of all adhesion is from."""
    shown = known.effort_over_mass.known
    if known.load.source == "recorded" and shown:
        return []
    band = f"± {1.96 * spread:.0%}"
    how = f"adhesion from what the efforts do to the motion, {band}"
    if not shown:
        how = f"adhesion within {band} by the gain of the efforts, which is not known either"
    if known.load.source == "recorded":
        return [f"the motion does not show the gain of the efforts: adhesion within {band}"]
    size = known.load.text("t", 1e-3, 1).partition(",")[0]
    return [f"the load is not recorded ({known.load.source} {size}): {how}"]


def _demand(trip: Trip, clock: pd.DatetimeIndex) -> FloatArray | None:
    """What is asked for at the axles' samples, positive in traction."""
    frame = trip.topics.get(TRAIN_CONTROLS.name)
    if frame is None:
        return None
    pull, hold = (
        interpolated(frame, f"{kind}_effort_demand", clock) for kind in ("tractive", "braking")
    )
    if np.isfinite(pull).any():
        return np.asarray(np.nan_to_num(pull) - np.nan_to_num(hold))
    if frame["lever"].notna().any():
        return np.asarray(np.nan_to_num(interpolated(frame, "lever", clock)))
    return None


def _earlier(time: FloatArray, values: FloatArray, delay: float) -> FloatArray:
    """Values that were recorded `delay` [s] late, at the instants of the others."""
    finite = np.isfinite(values)
    if not finite.any():
        return values
    moved = np.interp(time + delay, time[finite], values[finite])
    return np.where(finite, moved, np.nan)


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
