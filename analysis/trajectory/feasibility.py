"""What the fastest runs refuse before any solver runs: timetables and windows out of reach."""

from __future__ import annotations

import numpy as np

from analysis.trajectory.envelope import Envelope
from analysis.trajectory.run import Run
from trainlog.errors import InfeasibleError, InputError
from trainlog.units import KMH

SLACKEST = 5.0
"""Times the least time, beyond which a timetable is refused."""


def check_time(run: Run, fastest: Envelope, running_time: float) -> None:
    """Refuse a timetable that the slowest configuration cannot keep by itself."""
    slowest = int(np.argmax(fastest.times))
    least = float(fastest.times[slowest])
    if running_time > SLACKEST * least:
        raise InputError(
            f"trajectory: a running time of {running_time:.1f} s is"
            f" {running_time / least:.3g} times the least, {least:.1f} s: a train that slow would"
            " stand on the way",
            remedy=f"give at most {SLACKEST * least:.0f} s, and let it wait at a station",
        )
    if running_time < least:
        late = [
            configuration.name
            for configuration, time in zip(run.configurations, fastest.times, strict=True)
            if time > running_time
        ]
        raise InfeasibleError(
            f"{running_time:.1f} s are not enough: configuration"
            f" '{run.configurations[slowest].name}' needs at least {least:.1f} s,"
            f" {least - running_time:.1f} s are missing"
            f" ({len(late)} of {len(run.configurations)} configurations would be late)",
            remedy=f"allow at least {np.ceil(least):.0f} s",
        )
    _check_windows(run, fastest, running_time)


def _check_windows(run: Run, fastest: Envelope, running_time: float) -> None:
    """Refuse windows that a configuration cannot keep even on its fastest run."""
    times = fastest.times_at([point.position for point in run.windows])
    for point, found in zip(run.windows, times.T, strict=True):
        slowest = int(np.argmax(found))
        name, place = run.configurations[slowest].name, f"km {point.position / 1e3:.3f}"
        if point.latest is not None and found[slowest] > point.latest:
            raise InfeasibleError(
                f"configuration '{name}' passes {place} after {found[slowest]:.1f} s at the"
                f" earliest, {found[slowest] - point.latest:.1f} s after its window closes",
                remedy=f"let it pass until {np.ceil(found[slowest]):.0f} s after departure",
            )
        left = running_time - (point.earliest or 0.0) - (fastest.times - found)
        slowest = int(np.argmin(left))
        if left[slowest] < 0.0:
            raise InfeasibleError(
                f"configuration '{run.configurations[slowest].name}' needs at least"
                f" {fastest.times[slowest] - found[slowest]:.1f} s from {place} to the end;"
                f" passed after {point.earliest or 0.0:.1f} s or later, {-left[slowest]:.1f} s are"
                " missing",
                remedy="let it pass earlier, or arrive later",
            )
        speeds = fastest.at(np.array([point.position]))[:, 0]
        slowest = int(np.argmin(speeds))
        if point.lowest_speed is not None and speeds[slowest] < point.lowest_speed:
            raise InfeasibleError(
                f"configuration '{run.configurations[slowest].name}' passes {place} at"
                f" {KMH * speeds[slowest]:.1f} km/h at most, {KMH * point.lowest_speed:.1f} km/h"
                " are asked for",
                remedy="lower what is asked for",
            )
