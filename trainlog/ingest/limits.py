"""What each field can be, and how fast it can change, unless a profile says otherwise."""

from __future__ import annotations

import numpy as np

from trainlog.ingest.profile_parts import Limit, Limits
from trainlog.ingest.recording import base_name, field_of
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
    "/train/supply.line_voltage": Limit(unit="kV", min=-60.0, max=60.0),
    "/train/supply.line_current": Limit(unit="kA", min=-20.0, max=20.0),
    "/train/brakes.brake_pipe_pressure": Limit(unit="bar", min=-1.0, max=16.0),
    "/train/brakes.brake_cylinder_pressure": Limit(unit="bar", min=-1.0, max=16.0),
    "/train/doors.release": Limit(unit="1", min=0.0, max=1.0),
    **{f"/imu.specific_force_{axis}": Limit(unit="m/s^2", min=-200.0, max=200.0) for axis in "xyz"},
    **{f"/imu.angular_rate_{axis}": Limit(unit="rad/s", min=-40.0, max=40.0) for axis in "xyz"},
}
"""What each field can be, unless the profile says otherwise."""


def limit_of(name: str, limits: Limits) -> Limit:
    """The limit that holds for a column: the profile's, or else the built-in one."""
    key = base_name(name)
    return limits.columns.get(key) or LIMITS.get(key) or Limit(unit=field_of(name)[2].unit or "1")


def si_bounds(limit: Limit, name: str) -> tuple[float, float]:
    """Smallest and largest value of a column, in SI; infinite where there is none."""
    slope, offset = factor(limit.unit, field_of(name)[2].unit or "1")
    low = -np.inf if limit.min is None else limit.min * slope + offset
    high = np.inf if limit.max is None else limit.max * slope + offset
    return float(low), float(high)


def si_rate(limit: Limit, name: str) -> tuple[float, float]:
    """Rate a second and tolerance of a column, in SI; no rate is an infinite one."""
    slope, _ = factor(limit.unit, field_of(name)[2].unit or "1")
    rate = np.inf if limit.rate is None else limit.rate * slope
    return float(rate), float((limit.tolerance or 0.0) * slope)
