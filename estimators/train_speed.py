"""Train speed while wheels slip: the wheels that hold, satellite speed, and the train's inertia.

The momentum that efforts give to a train is known whether its wheels slip or not: what the motors
give and the wheels do not keep goes into the rail,
``M dv/dt = sum(T) - J d(sum w)/dt - brake - resistance``. So ``v - P/M``, with the impulse
``P = ∫(sum T - brake) dt - J sum w``, changes only by the running resistance and the gradient:
slowly, and the more surely the shorter a slip lasts. A Kalman filter follows it as a line with a
wandering slope, forwards and backwards (Rauch-Tung-Striebel).

A wheel tells the train's speed as far as its creep is small; its creep grows with the adhesion in
use and lasts, so it is no white noise and weighs little beside a satellite speed.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

SLOPE_RATE = 0.005
"""How fast what is not known of the efforts, over mass, may wander [m/s² per s^0.5], where the
friction brake is recorded: errors of resistance, gradient and mass are left."""

SLOPE_RATE_WITHOUT_BRAKE = 0.05
"""The same where the friction brake is not recorded and has to be found as well."""

CREEP_PER_ADHESION = 5.0
"""Creep speed over adhesion in use [m/s] that a wheel without slip may have (wet: 003, eq. 10)."""

CREEP_TIME = 5.0
"""Time over which creep stays the same [s]."""

HOLDING_GATE = 1.0
"""A wheel further than this from the expected train speed [m/s] is taken not to hold."""


@dataclass(frozen=True, slots=True)
class TrainSpeed:
    """Speed over ground and its standard deviation, (n,) arrays [m/s]."""

    speed: FloatArray
    std: FloatArray


def impulse(
    time: FloatArray,
    wheel_speed: FloatArray,
    wheel_effort: FloatArray,
    other_effort: FloatArray,
    rotating_mass: float,
) -> FloatArray:
    """Momentum that the efforts gave to the train since the first sample, less the axles' own.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed, wheel_effort : (n, axles) array [m/s], [N]
        Without NaN.
    other_effort : (n,) array [N]
        Efforts on the train besides, negative in braking.
    rotating_mass : float [kg]
        Of one axle.

    Returns
    -------
    (n,) array [N s]
    """
    effort = wheel_effort.sum(axis=1) + other_effort
    given = np.concatenate(([0.0], np.cumsum(0.5 * (effort[1:] + effort[:-1]) * np.diff(time))))
    kept = rotating_mass * (wheel_speed - wheel_speed[0]).sum(axis=1)
    return np.asarray(given - kept)


def train_speed(
    time: FloatArray,
    wheel_speed: FloatArray,
    adhesion: FloatArray,
    wheel_std: float,
    gained: FloatArray,
    reference: FloatArray,
    reference_std: FloatArray,
    slope_rate: float = SLOPE_RATE,
) -> TrainSpeed:
    """Smoothed train speed.

    Parameters
    ----------
    time : (n,) array [s]
    wheel_speed : (n, axles) array [m/s]
        Corrected for the wheel diameters; NaN where missing.
    adhesion : (n, axles) array
        In use.
    wheel_std : float [m/s]
    gained : (n,) array [m/s]
        `impulse` over the train's mass.
    reference, reference_std : (n,) array [m/s]
        Satellite speed at the samples where there is one, else NaN.
    slope_rate : float [m/s^1.5]
        `SLOPE_RATE` or `SLOPE_RATE_WITHOUT_BRAKE`.
    """
    if time.size == 0:
        return TrainSpeed(np.empty(0), np.empty(0))
    step = float(np.median(np.diff(time))) if time.size > 1 else 1.0
    inflation = np.sqrt(max(CREEP_TIME / step, 1.0))
    creep = wheel_std + CREEP_PER_ADHESION * np.abs(adhesion)
    means, covariances = _filter(
        time, wheel_speed, (creep * inflation) ** 2, gained, reference, reference_std**2, slope_rate
    )
    _smooth(time, means, covariances, slope_rate)
    return TrainSpeed(means[:, 0] + gained, np.sqrt(covariances[:, 0]))


@njit(cache=True)
def _filter(time, wheel, wheel_variance, gained, reference, reference_variance, slope_rate):  # type: ignore[no-untyped-def]
    n, axles = wheel.shape
    means, covariances = np.empty((n, 2)), np.empty((n, 3))
    u, b = 0.0, 0.0
    p_uu, p_ub, p_bb = 1e4, 0.0, 0.2**2
    q = slope_rate * slope_rate
    for k in range(n):
        if k > 0:
            step = time[k] - time[k - 1]
            u += step * b
            p_uu += 2.0 * step * p_ub + step * step * p_bb + q * step**3 / 3.0
            p_ub += step * p_bb + q * step**2 / 2.0
            p_bb += q * step
        for i in range(axles + 1):
            if i == 0:
                z, r = reference[k] - gained[k], reference_variance[k]
            else:
                z, r = wheel[k, i - 1] - gained[k], wheel_variance[k, i - 1]
                gate = max(HOLDING_GATE, 4.0 * np.sqrt(p_uu))
                if abs(z - u) > gate:
                    continue
            if np.isnan(z) or np.isnan(r):
                continue
            g_u, g_b = p_uu / (p_uu + r), p_ub / (p_uu + r)
            residual = z - u
            u += g_u * residual
            b += g_b * residual
            p_bb -= g_b * p_ub
            p_ub *= 1.0 - g_u
            p_uu *= 1.0 - g_u
        means[k, 0], means[k, 1] = u, b
        covariances[k, 0], covariances[k, 1], covariances[k, 2] = p_uu, p_ub, p_bb
    return means, covariances


@njit(cache=True)
def _smooth(time, means, covariances, slope_rate):  # type: ignore[no-untyped-def]
    """Rauch-Tung-Striebel recursion, in place."""
    q = slope_rate * slope_rate
    for k in range(len(time) - 2, -1, -1):
        step = time[k + 1] - time[k]
        u, b = means[k]
        p_uu, p_ub, p_bb = covariances[k]
        c_uu, c_ub = p_uu + step * p_ub, p_ub
        c_bu, c_bb = p_ub + step * p_bb, p_bb
        m_uu = p_uu + 2.0 * step * p_ub + step * step * p_bb + q * step**3 / 3.0
        m_ub = p_ub + step * p_bb + q * step**2 / 2.0
        m_bb = p_bb + q * step
        det = m_uu * m_bb - m_ub * m_ub
        g_uu = (c_uu * m_bb - c_ub * m_ub) / det
        g_ub = (c_ub * m_uu - c_uu * m_ub) / det
        g_bu = (c_bu * m_bb - c_bb * m_ub) / det
        g_bb = (c_bb * m_uu - c_bu * m_ub) / det
        d_u = means[k + 1, 0] - (u + step * b)
        d_b = means[k + 1, 1] - b
        means[k, 0] = u + g_uu * d_u + g_ub * d_b
        means[k, 1] = b + g_bu * d_u + g_bb * d_b
        e_uu = covariances[k + 1, 0] - m_uu
        e_ub = covariances[k + 1, 1] - m_ub
        e_bb = covariances[k + 1, 2] - m_bb
        covariances[k, 0] = p_uu + g_uu**2 * e_uu + 2.0 * g_uu * g_ub * e_ub + g_ub**2 * e_bb
        covariances[k, 1] = (
            p_ub + g_uu * g_bu * e_uu + (g_uu * g_bb + g_ub * g_bu) * e_ub + g_ub * g_bb * e_bb
        )
        covariances[k, 2] = p_bb + g_bu**2 * e_uu + 2.0 * g_bu * g_bb * e_ub + g_bb**2 * e_bb
