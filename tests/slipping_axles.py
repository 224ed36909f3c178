"""A small plant to judge the adhesion estimators by: a train whose powered axles can slip.

Independent of `trainlog.simulation`, with the truth at every sample: Zhao et al. (2025), eqs. (1),
(8), (10), all at the wheel rim, with a slip protection that takes effort away and gives it back.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit

from trainlog.arrays import FloatArray
from trainlog.railway.adhesion import DRY, CreepCurve

AXLES = 4
ROTATING_MASS = 2_000.0
AXLE_LOAD = 16_000.0 * 9.81
INERTIA = 126_200.0


@dataclass(frozen=True)
class Run:
    """What was measured, and the truth; (n,) or (n, axles) arrays in SI units."""

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    wheel_speed: FloatArray
    wheel_effort: FloatArray
    true_wheel_speed: FloatArray
    adhesion: FloatArray
    maximum_adhesion: FloatArray


def run(
    profile: FloatArray,
    *,
    bin_length: float = 25.0,
    demand: float = 0.26,
    speed: float = 8.0,
    curve: CreepCurve = DRY,
    rate: float = 20.0,
    noise: float = 0.03,
    seed: int = 0,
    resistance: float | None = None,
) -> Run:
    """Drive over a profile of maximum adhesion, one value a bin.

    The demand is an adhesion (effort over axle load) that wanders by 15 % in the course of the
    trip; resistance makes up for it so that the speed stays about the same.
    """
    rng = np.random.default_rng(seed)
    axle_noise = 1.0 + 0.01 * rng.standard_normal(AXLES)
    wave = rng.uniform(0.0, 2.0 * np.pi, 2)
    held = AXLES * demand * AXLE_LOAD if resistance is None else resistance
    step, every = 2e-3, round(500 / rate)
    steps = int(len(profile) * bin_length / speed * 1.5 / step)
    raw = _integrate(
        profile, bin_length, demand, speed, curve.a, curve.b, curve.c / curve.peak, axle_noise,
        wave, held, step, steps, every,
    )  # fmt: skip
    count = int(raw[-1, 0])
    raw = raw[:count]
    wheel = raw[:, 4 : 4 + AXLES]
    measured = wheel + noise * rng.standard_normal(wheel.shape)
    return Run(
        time=raw[:, 0],
        position=raw[:, 1],
        speed=raw[:, 2],
        wheel_speed=measured,
        wheel_effort=raw[:, 4 + AXLES : 4 + 2 * AXLES].copy(),
        true_wheel_speed=wheel.copy(),
        adhesion=raw[:, 4 + 2 * AXLES :].copy(),
        maximum_adhesion=raw[:, 3],
    )


@njit(cache=True)
def _integrate(  # type: ignore[no-untyped-def]
    profile,
    bin_length,
    demand,
    speed,
    a,
    b,
    scale,
    axle_noise,
    wave,
    resistance,
    step,
    steps,
    every,
):
    n = len(axle_noise)
    out = np.zeros((steps // every + 2, 4 + 3 * n))
    v, s = speed, 0.5 * bin_length
    w = np.full(n, speed)
    effort = np.zeros(n)
    cut = np.ones(n)
    holding = np.zeros(n)
    row = 0
    for k in range(steps):
        t = k * step
        place = s / bin_length - 0.5
        i = min(max(int(place), 0), len(profile) - 2)
        mu_max = profile[i] + (profile[i + 1] - profile[i]) * min(max(place - i, 0.0), 1.0)
        lever = demand * (
            1.0 + 0.1 * np.sin(wave[0] + s / 230.0) + 0.05 * np.sin(wave[1] + s / 71.0)
        )
        total = 0.0
        for axle in range(n):
            slip = w[axle] - v
            size = abs(slip)
            mu = np.sign(slip) * mu_max * scale * (np.exp(-a * size) - np.exp(-b * size))
            force = mu * AXLE_LOAD
            wanted = lever * AXLE_LOAD * cut[axle] * min(1.0, t / 3.0)
            effort[axle] += (wanted - effort[axle]) * step / 0.15
            total += force
            if k % every == 0:
                out[row, 4 + axle] = w[axle]
                out[row, 4 + n + axle] = effort[axle]
                out[row, 4 + 2 * n + axle] = mu
            # Slip protection: above 2.5 m/s (a little different on each axle) down until
            # the slip is gone, then back within eight seconds.
            if size > 2.5 * axle_noise[axle]:
                holding[axle] = 1.0
            if holding[axle] > 0.0:
                cut[axle] = max(0.0, cut[axle] - 3.0 * step)
                if size < 0.6:
                    holding[axle] = 0.0
            else:
                cut[axle] = min(1.0, cut[axle] + step / 8.0)
            w[axle] += step * (effort[axle] - force) / ROTATING_MASS
        # A driver who keeps the speed: resistance and a brake on the other axles.
        pull = total - min(resistance, total) * 1.0 - 8_000.0 * (v - speed)
        v += step * pull / INERTIA
        s += step * v
        if k % every == 0:
            out[row, 0], out[row, 1], out[row, 2], out[row, 3] = t, s, v, mu_max
            row += 1
        if s > (len(profile) - 1) * bin_length:
            break
    out[-1, 0] = row
    return out
