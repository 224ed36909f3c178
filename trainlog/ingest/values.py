"""Rules on values: what a sensor cannot have measured becomes absent (NaN), and is counted."""

from __future__ import annotations

import numpy as np
from scipy.ndimage import median_filter

from trainlog.errors import InputError
from trainlog.ingest.clock import Result, has_fix
from trainlog.ingest.profile import Limit, Limits
from trainlog.ingest.recording import BoolArray, Finding, FloatArray, Table, base_name, field_of
from trainlog.units import factor

LIMITS: dict[str, Limit] = {
    "/train/state.position": Limit(unit="m", min=-1e6, max=1e7, rate=150.0, tolerance=20.0),
    "/train/state.speed": Limit(unit="m/s", min=-1.0, max=150.0, rate=5.0, tolerance=2.0),
    "/train/state.acceleration": Limit(unit="m/s^2", min=-6.0, max=6.0),
    "/train/controls.lever": Limit(unit="1", min=-1.05, max=1.05),
    "/train/controls.tractive_effort_demand": Limit(unit="kN", min=0.0, max=3000.0),
    "/train/controls.braking_effort_demand": Limit(unit="kN", min=0.0, max=6000.0),
    "/train/controls.tractive_effort": Limit(unit="kN", min=0.0, max=3000.0),
    "/train/controls.dynamic_braking_effort": Limit(unit="kN", min=0.0, max=3000.0),
    "/train/controls.pneumatic_braking_effort": Limit(unit="kN", min=0.0, max=6000.0),
    # Spinning wheels gain 10 m/s² and more: only what no wheel can do is a spike.
    "/train/axles.wheel_speed": Limit(unit="m/s", min=-1.0, max=150.0, rate=40.0, tolerance=5.0),
    "/train/axles.wheel_effort": Limit(unit="kN", min=-300.0, max=300.0),
    "/gnss/fix.latitude": Limit(unit="deg", min=-90.0, max=90.0),
    "/gnss/fix.longitude": Limit(unit="deg", min=-180.0, max=180.0),
    "/gnss/fix.altitude": Limit(unit="m", min=-500.0, max=9000.0, rate=20.0, tolerance=100.0),
    "/gnss/fix.horizontal_accuracy": Limit(unit="m", min=0.0, max=1e5),
    "/gnss/fix.vertical_accuracy": Limit(unit="m", min=0.0, max=1e5),
    "/gnss/motion.speed": Limit(unit="m/s", min=0.0, max=150.0, rate=5.0, tolerance=3.0),
    "/gnss/motion.speed_accuracy": Limit(unit="m/s", min=0.0, max=1e4),
    "/gnss/motion.satellites": Limit(unit="1", min=0.0, max=200.0),
    "/gnss/motion.pdop": Limit(unit="1", min=0.0, max=100.0),
    "/environment.speed_limit": Limit(unit="m/s", min=0.0, max=150.0),
    "/environment.gradient": Limit(unit="1", min=-0.2, max=0.2),
    "/environment.curvature": Limit(unit="1/m", min=-0.05, max=0.05),
    "/environment.air_temperature": Limit(unit="degC", min=-60.0, max=60.0),
    "/environment.head_wind": Limit(unit="m/s", min=-60.0, max=60.0),
    **{f"/imu.specific_force_{axis}": Limit(unit="m/s^2", min=-200.0, max=200.0) for axis in "xyz"},
    **{f"/imu.angular_rate_{axis}": Limit(unit="rad/s", min=-40.0, max=40.0) for axis in "xyz"},
}
"""What each field can be, unless the profile says otherwise."""

FIX_RATE, FIX_TOLERANCE = 150.0, 50.0
"""How fast a satellite position can move [m/s], and by how much it may err [m]."""

METRES_PER_DEGREE = 111_195.0
"""Length of a degree of latitude [m]."""

WINDOW = 7
"""Samples in the median that spikes are measured against: up to three in a row are found."""

MAX_OUT_OF_LIMITS = 0.5
"""Share of a column's values out of limits beyond which its unit is doubted."""


def blank_without_fix(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Take away what a receiver says in rows without a satellite fix."""
    fix = has_fix(table)
    if fix is None or fix.all():
        return table, []
    says = np.zeros(len(table), dtype=np.bool_)
    for name, values in table.signals.items():
        if name.startswith("/gnss/"):
            says |= np.isfinite(values)
    lost = ~fix & says
    found = table.found("no_fix", lost)
    for name in table.signals:
        if name.startswith("/gnss/"):
            table = table.without(name, lost)
    return table, found


def blank_out_of_limits(table: Table, limits: Limits) -> Result:
    """Take away values that are physically impossible.

    Raises
    ------
    InputError
        If most values of a column are: then it is the unit that is wrong.
    """
    findings: list[Finding] = []
    for name, values in table.signals.items():
        limit = limit_of(name, limits)
        low, high = _bounds(limit, name)
        out = (values < low) | (values > high)
        count, present = np.count_nonzero(out), np.count_nonzero(np.isfinite(values))
        if not count:
            continue
        if count > MAX_OUT_OF_LIMITS * present:
            unit = field_of(name)[2].unit
            first = int(np.argmax(out))
            raise InputError(
                f"{base_name(name)}: {count} of {present} values are impossible, the first is"
                f" {values[first]:.6g} {unit}, limits {low:.6g} to {high:.6g}",
                place=f"row {table.rows[first]}",
                remedy="check the unit, scale and sign of its column in the profile",
            )
        findings += table.found("out_of_limits", out, base_name(name))
        table = table.without(name, out)
    return table, findings


def limit_of(name: str, limits: Limits) -> Limit:
    """The limit that holds for a column: the profile's, or else the built-in one."""
    key = base_name(name)
    return limits.columns.get(key) or LIMITS.get(key) or Limit(unit=field_of(name)[2].unit or "1")


def _bounds(limit: Limit, name: str) -> tuple[float, float]:
    slope, offset = factor(limit.unit, field_of(name)[2].unit or "1")
    low = -np.inf if limit.min is None else limit.min * slope + offset
    high = np.inf if limit.max is None else limit.max * slope + offset
    return float(low), float(high)


def blank_spikes(table: Table, limits: Limits) -> Result:
    """Take away single values that nothing can have jumped to and back from.

    A value is a spike if it lies further from the median of the `WINDOW` samples around it than
    ``tolerance + rate * (time to the farthest of them)``. What changes no faster than `rate` is
    never taken for one, whatever its sampling.
    """
    findings: list[Finding] = []
    seconds = (table.time - table.time[0]) / 1e9
    for name, values in table.signals.items():
        limit = limit_of(name, limits)
        if limit.rate is None:
            continue
        slope, _ = factor(limit.unit, field_of(name)[2].unit or "1")
        tolerance = (limit.tolerance or 0.0) * slope
        spike = spikes(seconds, values, limit.rate * slope, tolerance)
        findings += table.found("spikes", spike, base_name(name))
        table = table.without(name, spike)
    leaps = _leaping_fixes(table, seconds)
    findings += table.found("spikes", leaps, "/gnss/fix.latitude")
    findings += table.found("spikes", leaps, "/gnss/fix.longitude")
    if leaps.any():
        table = table.without("/gnss/fix.latitude", leaps)
        table = table.without("/gnss/fix.longitude", leaps)
    return table, findings


def _leaping_fixes(table: Table, seconds: FloatArray) -> BoolArray:
    """Which satellite positions are spikes, north or east."""
    latitude = table.signals.get("/gnss/fix.latitude")
    longitude = table.signals.get("/gnss/fix.longitude")
    if latitude is None or longitude is None or not np.isfinite(latitude).any():
        return np.zeros(len(table), dtype=np.bool_)
    metres_east = METRES_PER_DEGREE * np.cos(np.radians(np.nanmedian(latitude)))
    north = spikes(seconds, latitude * METRES_PER_DEGREE, FIX_RATE, FIX_TOLERANCE)
    east = spikes(seconds, longitude * metres_east, FIX_RATE, FIX_TOLERANCE)
    return np.asarray(north | east)


def spikes(seconds: FloatArray, values: FloatArray, rate: float, tolerance: float) -> BoolArray:
    """Mark spikes; see `blank_spikes`.

    Parameters
    ----------
    seconds : (n,) array [s]
        Increasing.
    values : (n,) array
        NaN where absent; absent values take no part.
    rate, tolerance : float
        In the unit of `values` a second, and in the unit of `values`.
    """
    marked = np.zeros(values.size, dtype=np.bool_)
    present = np.flatnonzero(np.isfinite(values))
    if present.size < WINDOW:
        return marked
    known, instants = values[present], seconds[present]
    # Mirrored at the ends, so that no sample counts itself twice.
    median = median_filter(known, WINDOW, mode="mirror")
    half = WINDOW // 2
    number = np.arange(present.size)
    ahead = instants[np.minimum(number + half, present.size - 1)] - instants
    behind = instants - instants[np.maximum(number - half, 0)]
    allowed = tolerance + rate * np.maximum(ahead, behind)
    marked[present] = np.abs(known - median) > allowed
    return marked
