"""What a trip's recordings say, written back beside them as the topics ``/estimates/*``."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.adhesion.slip import TOPICS, slip
from analysis.resistance.fit import estimated_resistance, fit_trip
from analysis.resistance.recording import LARGEST_SCALE, increasing_seconds, scale_of
from analysis.view import TripView, view_of, views_of
from estimators.motion import smooth_motion
from trainlog import __version__
from trainlog.arrays import FloatArray, robust_std
from trainlog.display import counted
from trainlog.errors import LogError, TrainlogError
from trainlog.formats.files import csv_bytes, write_bytes
from trainlog.mcap import LogWriter, read_log
from trainlog.topics import ESTIMATED_STATE, TRAIN_AXLES
from trainlog.trip import Trip, frame_of

CHAINAGE_STD = 3.0
"""Standard deviation of a recorded chainage [m]: odometry that is corrected at balises."""

CHAINAGE_TIME = 30.0
"""Time over which an error of recorded chainage lasts [s]: the way from balise to balise."""

LEAST_BALISES = 3
"""Corrections of the chainage from which on they are taken for those of balises."""

LEAST_JUMP = 0.5
"""Correction of the chainage [m] that stands out from its noise."""

LONGEST_STEP = 1.0
"""Time between two samples [s] over which their chainage may be compared with their speed."""


def with_estimates(trip: Trip | TripView) -> tuple[Trip, tuple[str, ...]]:
    """Add what can be estimated of a trip: motion, running resistance, adhesion and slip.

    Parameters
    ----------
    trip : Trip or TripView
        With ``/train/state``; ``/train/controls`` gives the running resistance, ``/train/axles``
        adhesion and slip.

    Returns
    -------
    trip : Trip
        With the topics ``/estimates/*``, and slip events among the ``/events``.
    refusals : tuple of str
        What could not be estimated, and why.

    Raises
    ------
    LogError
        If nothing could be estimated.

    Examples
    --------
    >>> import trainlog
    >>> trip, refusals = with_estimates(trainlog.read("sample_logs/stopping.mcap"))
    >>> [topic for topic in trip.topics if topic.startswith("/estimates/")]
    ['/estimates/state', '/estimates/running_resistance', '/estimates/adhesion']
    >>> refusals
    ()
    """
    refusals: list[str] = []
    first: TrainlogError | None = None
    added: list[str] = []
    view = view_of(trip)
    result = view.trip
    for name, estimate in (
        ("state", _state),
        ("running resistance", _resistance),
        ("adhesion", _adhesion),
    ):
        try:
            result = estimate(view, result)
            added.append(name)
        except TrainlogError as error:
            refusals.append(f"{name}: {error}")
            first = first or error
    if first is not None and not added:
        raise LogError(
            f"trip '{view.name}': nothing can be estimated; state: {first.problem}",
            place=first.place,
            remedy=first.remedy if "/train/state" in result else "give a log with /train/state",
        )
    done = result.with_step(
        "estimate", software=f"trainlog {__version__}", added=added, refused=refusals
    )
    return done, tuple(refusals)


def estimate_log(log: str | Path, output: str | Path) -> tuple[str, ...]:
    """Write a log with what can be estimated of it; see `with_estimates`.

    Of a log too long for the memory each part is estimated by itself (`analysis.view`).

    Returns
    -------
    tuple of str
        What could not be estimated, and why.

    Raises
    ------
    LogError
        If the log cannot be read, or nothing could be estimated; a part of several for which
        nothing could is written as it was recorded.
    InputError
        If the output cannot be written.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     estimate_log("sample_logs/stopping.mcap", Path(folder) / "estimated.mcap")
    ()
    """
    refusals: list[str] = []
    metadata = read_log(log, []).metadata
    with LogWriter(output) as writer:
        for view in views_of(log):
            try:
                trip, refused = with_estimates(view)
            except LogError as error:
                if view.count == 1:
                    raise
                trip, refused = view.trip, (str(error),)
            writer.add(replace(trip, metadata=metadata))
            where = "" if view.count == 1 else f"part {view.number} of {view.count}: "
            refusals += [f"{where}{reason}" for reason in refused]
    return tuple(refusals)


def _resistance(view: TripView, result: Trip) -> Trip:
    """Running resistance as the trip went on."""
    return result.with_topic(estimated_resistance(fit_trip(view)))


def _state(view: TripView, result: Trip) -> Trip:
    """Smoothed motion from the wheels' speed and the recorded chainage."""
    estimated = "/train/state" not in view.trip or view.located is not view.trip
    if "/estimates/state" in view.trip and estimated:
        return result
    state = view.trip["/train/state"]
    if len(state) < 2:
        raise LogError(
            f"trip '{view.name}': /train/state holds {counted(len(state), 'sample')}",
            remedy="record it over the whole trip",
        )
    time = increasing_seconds(state, view.name)
    speed = state["speed"].to_numpy(dtype=np.float64)
    position = state["position"].to_numpy(dtype=np.float64)
    scale = scale_of(view)
    position = without_wheel_error(time, speed, position, scale.factor)
    # The chainage's error is that of the odometer since the last balise: it lasts, so that many
    # samples together say no more than one. White noise of this size says as much.
    lasting = np.sqrt(2.0 * CHAINAGE_TIME / float(np.median(np.diff(time))))
    motion = smooth_motion(
        time,
        speed / scale.factor,
        np.hypot(_noise(speed), scale.std * speed),
        position,
        CHAINAGE_STD * max(1.0, lasting),
    )
    frame = frame_of(
        ESTIMATED_STATE,
        pd.DatetimeIndex(state.index),
        {
            "position": motion.position,
            "position_std": motion.position_std,
            "speed": np.maximum(motion.speed, 0.0),
            "speed_std": np.hypot(motion.speed_std, scale.std * motion.speed),
            "acceleration": motion.acceleration,
            "acceleration_std": motion.acceleration_std,
        },
    )
    return result.with_topic(frame)


def without_wheel_error(
    time: FloatArray, speed: FloatArray, position: FloatArray, factor: float
) -> FloatArray:
    """Chainage between balises, less what a wrong wheel diameter has added to it.

    From each balise on an odometer errs to one side, in proportion to the distance: its mean
    over a trip is off by half of what the balises correct, which no smoothing removes.

    Parameters
    ----------
    time, speed, position : (n,) array [s], [m/s], [m]
        As recorded; NaN what is missing.
    factor : float
        Recorded over true speed.

    Returns
    -------
    (n,) array [m]
        The chainage as recorded where fewer than `LEAST_BALISES` corrected it.

    Examples
    --------
    An odometer that counts 1 % too much is corrected every 20 s:

    >>> import numpy as np
    >>> time = np.arange(0.0, 100.0, 0.5)
    >>> true, since = 20.0 * time, 20.0 * (time % 20.0)
    >>> recorded = true + 0.01 * since
    >>> corrected = without_wheel_error(time, np.full(time.size, 20.2), recorded, factor=1.01)
    >>> [float(np.abs(each - true).max().round(1)) for each in (recorded, corrected)]
    [3.9, 0.0]
    """
    known = np.isfinite(speed) & np.isfinite(position)
    v, s, steps = speed[known], position[known], np.diff(time[known])
    travelled, moved = 0.5 * (v[1:] + v[:-1]) * steps, np.diff(s)
    jump = (np.abs(moved - travelled) > LEAST_JUMP) & (steps < LONGEST_STEP)
    distance = float(np.sum(travelled[~jump]))
    if np.count_nonzero(jump) < LEAST_BALISES or distance <= 0.0:
        return position
    # The odometer's wheel need not be the one whose speed was recorded.
    ratio = factor * float(np.sum(moved[~jump])) / distance
    if not 1.0 / LARGEST_SCALE < ratio < LARGEST_SCALE:
        return position
    balise = s[np.r_[0, np.flatnonzero(jump) + 1]][np.r_[0, np.cumsum(jump)]]
    result = position.copy()
    result[known] = balise + (s - balise) / ratio
    return result


def slip_table(logs: Iterable[str | Path]) -> pd.DataFrame:
    """The slip events of logs, one row each, as `trainlog estimate --slips` writes them.

    Returns
    -------
    DataFrame
        ``trip``; the columns of `analysis.adhesion.slip.SlipAnalysis.events` and of
        `SlipAnalysis.creep_curves`, those with a unit named with it (``peak_slip_m/s``).

    Raises
    ------
    LogError, InputError
        As `analysis.slip`, for a log that cannot be analysed.

    Examples
    --------
    >>> table = slip_table(["sample_logs/nonstop.mcap"])
    >>> len(table), table["kind"].unique().tolist(), f"{table['energy_J'].sum() / 1e6:.1f} MJ"
    (25, ['traction', 'braking'], '3.9 MJ')
    """
    found = []
    for log in logs:
        for view in views_of(log, TOPICS):
            if view.count > 1 and len(view.trip[TRAIN_AXLES.name]) < 2:
                continue
            part = slip(view)
            curves = part.creep_curves()
            units = {**part.events.attrs["units"], **curves.attrs["units"]}
            rows = part.events.join(curves).sort_values(["start", "axle"])
            rows.columns = [
                name if units.get(name, "1") == "1" else f"{name}_{units[name]}" for name in rows
            ]
            rows.insert(0, "trip", part.trip)
            found.append(rows)
    return pd.concat(found, ignore_index=True)


def write_slip_table(logs: Iterable[str | Path], path: str | Path) -> int:
    """Write `slip_table` as CSV, whole or not at all, and return the number of events.

    Examples
    --------
    >>> from pathlib import Path
    >>> from tempfile import TemporaryDirectory
    >>> with TemporaryDirectory() as folder:
    ...     write_slip_table(["sample_logs/nonstop.mcap"], Path(folder) / "slips.csv")
    25
    """
    table = slip_table(logs)
    write_bytes(path, csv_bytes(table, float_format="%.8g"))
    return len(table)


def _adhesion(view: TripView, result: Trip) -> Trip:
    """Adhesion in use and slip of every axle, and the slip events in words."""
    found = slip(view)
    events = found.events_frame(view.own_line)
    if "/events" in view.trip:
        attrs = events.attrs
        events = pd.concat([view.trip["/events"], events]).sort_index(kind="stable")
        events.attrs = attrs
    return result.with_topic(found.adhesion_frame()).with_topic(events)


def _noise(speed: FloatArray) -> float:
    """Standard deviation of white noise on a smooth speed [m/s], from its second differences."""
    second = np.diff(speed, 2)
    second = second[np.isfinite(second)]
    spread = robust_std(second) / np.sqrt(6.0) if second.size else 0.0
    return max(spread, 0.01)
