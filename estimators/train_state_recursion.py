"""The recursion of the train-state filter: compiled, in place, sample by sample.

See `estimators.train_state`, which is its face, for what is modelled.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from estimators.kalman import ACCELERATION_STD, NO_POSITION_STD, NO_SPEED_STD, STATES
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]
BoolArray = NDArray[np.bool_]

GATE = 5.0
"""Innovations beyond this many standard deviations are left out."""

SLIP = 1.5
"""A wheel further than this from the expected speed [m/s] is taken to slip, however well the
speed is known, until it is nearer than half of it: creep under heavy traction stays below."""

CREEP = 1.0
"""Standard deviation of creep over acceleration [s]: wet rail, half of the weight on powered
axles (003, eq. 10)."""

CREEP_FLOOR = 0.05
"""Standard deviation of creep at constant speed [m/s]."""

CREEP_TIME = 10.0
"""Time over which creep stays the same [s]."""

WHEEL_TIME = 0.5
"""Time over which a wheel's own acceleration is averaged [s]."""

QUICK = 1.0
"""A wheel whose acceleration departs by more than this from the train's [m/s²] slips: between
them lies all that adhesion can do to a train in half a second."""

SLIP_CREEP = 2.0
"""Standard deviation of creep [m/s] within `SLIP_MEMORY` of a slip: the rail is at its limit."""

SLIP_MEMORY = 20.0
"""Time after a slip [s] over which wheels that hold again, and efforts, are believed less."""

HELD = 3
"""Samples in a row that a wheel must keep to the expected speed to be taken back."""

SLIP_EFFORT_STD = 0.2
"""How wrong the expected acceleration is where axles slip [m/s²]: what the motors give turns the
wheels, and comes back when they are caught."""

SLIP_EFFORT_TIME = 1.0
"""For how long it is wrong in the same way [s]."""

PATIENCE = 20.0
"""When no speed, or no position, was taken for so long [s] though some were measured, it is the
filter that was wrong: it starts anew from what is measured."""

STANDSTILL_STDS = 2.0
"""A receiver tells the size of the speed, so its noise never averages to 0: below this many
standard deviations the train is taken to stand."""

FEWEST_LEFT_OUT = 5
"""It takes so many measurements left out to say so."""

SLIPPING, OUT, HELD_FOR, SMOOTH = range(4)
"""What is remembered of a wheel: whether it slips, samples left out and held in a row, its speed
averaged."""

CLOCK, POSITION_TIME, SPEED_TIME, SLIP_TIME, POSITION_COUNT, SPEED_COUNT, STEP = range(7)
"""What is remembered besides: time, how long ago position and speed were taken and an axle slipped,
how often position and speed were left out since, and what `predict` went ahead."""


@njit(cache=True)  # type: ignore[untyped-decorator]
def observe(observed: FloatArray, measured: FloatArray, lasting: float) -> None:
    """Fill in what of the state the samples show, (n, m, 7)."""
    for k in range(measured.shape[0]):
        observed[k, 0, 0], observed[k, 0, 4] = 1.0, lasting
        observed[k, 1, 1] = 1.0
        observed[k, 2, 2], observed[k, 2, 3] = 1.0, GRAVITY
        observed[k, 3, 2], observed[k, 3, 3], observed[k, 3, 6] = 1.0, GRAVITY, 1.0
        for i in range(4, measured.shape[1]):
            observed[k, i, 1] = 1.0
            # w = v / (1 - e) is linear in speed and error: w = v + w e.
            observed[k, i, 5] = 0.0 if np.isnan(measured[k, i]) else measured[k, i]


@njit(cache=True)  # type: ignore[untyped-decorator]
def predict(
    mean: FloatArray, covariance: FloatArray, transition: FloatArray, noise: FloatArray
) -> None:
    """One step in place. Beyond the motion the transition is diagonal."""
    before, old = mean.copy(), covariance.copy()
    half = np.empty_like(old)
    for j in range(STATES):
        for i in range(3):
            half[i, j] = (
                transition[i, 0] * old[0, j]
                + transition[i, 1] * old[1, j]
                + transition[i, 2] * old[2, j]
            )
        for i in range(3, STATES):
            half[i, j] = transition[i, i] * old[i, j]
    for i in range(STATES):
        for j in range(i, STATES):
            if j < 3:
                total = (
                    half[i, 0] * transition[j, 0]
                    + half[i, 1] * transition[j, 1]
                    + half[i, 2] * transition[j, 2]
                )
            else:
                total = half[i, j] * transition[j, j]
            covariance[i, j] = covariance[j, i] = total + noise[i, j]
    for i in range(3):
        mean[i] = (
            transition[i, 0] * before[0]
            + transition[i, 1] * before[1]
            + transition[i, 2] * before[2]
        )
    for i in range(3, STATES):
        mean[i] = transition[i, i] * before[i]


@njit(cache=True)  # type: ignore[untyped-decorator]
def _expect(
    mean: FloatArray, covariance: FloatArray, row: FloatArray, shared: FloatArray
) -> tuple[float, float]:
    """Expected measurement and its variance; ``P h`` is left in `shared`."""
    value, variance = 0.0, 0.0
    for i in range(STATES):
        shared[i] = 0.0
        for j in range(STATES):
            if row[j] != 0.0:
                shared[i] += covariance[i, j] * row[j]
    for i in range(STATES):
        value += row[i] * mean[i]
        variance += row[i] * shared[i]
    return value, variance


@njit(cache=True)  # type: ignore[untyped-decorator]
def _correct(
    mean: FloatArray,
    covariance: FloatArray,
    shared: FloatArray,
    innovation: float,
    spread: float,
) -> None:
    """One measurement in place; Joseph's form for a scalar, symmetric by construction."""
    for i in range(STATES):
        mean[i] += shared[i] / spread * innovation
    for i in range(STATES):
        for j in range(i, STATES):
            covariance[i, j] -= shared[i] * shared[j] / spread
            covariance[j, i] = covariance[i, j]


@njit(cache=True)  # type: ignore[untyped-decorator]
def run_block(
    which: NDArray[np.int64],
    steps: FloatArray,
    transition: FloatArray,
    noise: FloatArray,
    z: FloatArray,
    variances: FloatArray,
    lasting: float,
    mean: FloatArray,
    covariance: FloatArray,
    wheels: FloatArray,
    clocks: FloatArray,
    left_out: NDArray[np.int64],
    counts: NDArray[np.int64],
    means: FloatArray,
    covariances: FloatArray,
    slipping: BoolArray,
) -> None:
    """Filter a block in place; what is left out becomes NaN in `z`, `variances` those used."""
    observed = np.zeros((1, z.shape[1], STATES))
    shared = np.empty(STATES)
    for k in range(z.shape[0]):
        if steps[k] > 0.0:
            predict(mean, covariance, transition[which[k]], noise[which[k]])
            clocks[POSITION_TIME : SLIP_TIME + 1] += steps[k]
        step = steps[k] + clocks[STEP]
        clocks[STEP] = 0.0
        counts[0] += 1
        observe(observed, z[k : k + 1], lasting)
        if np.any(wheels[:, SLIPPING] > 0.0):
            clocks[SLIP_TIME] = 0.0
        if clocks[SLIP_TIME] < SLIP_MEMORY:
            variances[k, 2] += SLIP_EFFORT_STD**2 * 2.0 * SLIP_EFFORT_TIME / max(step, 0.01)
        for i in range(4):
            if np.isnan(z[k, i]):
                continue
            if i == 1 and z[k, i] < STANDSTILL_STDS * np.sqrt(variances[k, i]):
                z[k, i] = 0.0
            value, variance = _expect(mean, covariance, observed[0, i], shared)
            innovation, spread = z[k, i] - value, variance + variances[k, i]
            if innovation**2 > GATE**2 * spread:
                z[k, i] = np.nan
                left_out[i] += 1
                if i < 2:
                    clocks[POSITION_COUNT + i] += 1.0
                continue
            _correct(mean, covariance, shared, innovation, spread)
            if i < 2:
                clocks[POSITION_TIME + i] = clocks[POSITION_COUNT + i] = 0.0
        _take_wheels(
            z[k, 4:], variances[k, 4:], observed[0, 4:], step, mean, covariance, wheels, clocks,
            left_out[4:], shared,
        )  # fmt: skip
        _open(covariance, wheels, clocks, counts)
        means[k], covariances[k] = mean, covariance
        for i in range(wheels.shape[0]):
            slipping[k, i] = wheels[i, SLIPPING] > 0.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _take_wheels(
    speeds: FloatArray,
    variances: FloatArray,
    observed: FloatArray,
    step: float,
    mean: FloatArray,
    covariance: FloatArray,
    wheels: FloatArray,
    clocks: FloatArray,
    left_out: NDArray[np.int64],
    shared: FloatArray,
) -> None:
    """Correct by the wheels that hold, those first that keep closest to the expected speed."""
    count = 0
    for i in range(speeds.size):
        count += not np.isnan(speeds[i])
    creep = CREEP_FLOOR + CREEP * abs(mean[2])
    if clocks[SLIP_TIME] < SLIP_MEMORY:
        creep += SLIP_CREEP
    # Creep is common to the axles and lasts: together, and for as long, they say no more than one.
    lasting = creep**2 * count * 2.0 * CREEP_TIME / max(step, 0.01)
    waiting = ~np.isnan(speeds)
    for _ in range(count):
        nearest, least = -1, np.inf
        for i in range(speeds.size):
            if waiting[i]:
                distance = abs(speeds[i] * (1.0 - mean[5]) - mean[1])
                if distance < least:
                    nearest, least = i, distance
        i = nearest
        waiting[i] = False
        value, variance = _expect(mean, covariance, observed[i], shared)
        innovation = speeds[i] - value
        reach = max(SLIP, GATE * np.sqrt(variance + variances[i]))
        if _holds(wheels[i], speeds[i], variances[i], innovation, reach, step, mean, covariance):
            # A wheel that stands does not creep.
            variances[i] += lasting * min(speeds[i] ** 2, 1.0)
            _correct(mean, covariance, shared, innovation, variance + variances[i])
            clocks[SPEED_TIME] = clocks[SPEED_COUNT] = 0.0
        else:
            speeds[i] = np.nan
            left_out[i] += 1
            clocks[SPEED_COUNT] += 1.0


@njit(cache=True)  # type: ignore[untyped-decorator]
def _holds(
    wheel: FloatArray,
    speed: float,
    variance: float,
    innovation: float,
    reach: float,
    step: float,
    mean: FloatArray,
    covariance: FloatArray,
) -> bool:
    """Whether an axle holds, by how far it departs and how fast it changes; its memory goes on."""
    quick = False
    departure = abs(innovation)
    if np.isnan(wheel[SMOOTH]) or step > 1.0 or step == 0.0:
        wheel[SMOOTH] = speed
    else:
        # A steady acceleration a keeps the average behind by a step keep / (1 - keep).
        keep = np.exp(-step / WHEEL_TIME)
        wheel[SMOOTH] = keep * wheel[SMOOTH] + (1.0 - keep) * speed
        behind = step * keep / (1.0 - keep)
        most = (QUICK + 2.0 * np.sqrt(covariance[2, 2])) * behind + GATE * np.sqrt(variance)
        quick = abs(speed - wheel[SMOOTH] - mean[2] * behind) > most
    if quick or departure > reach:
        wheel[OUT] += 1.0
        wheel[HELD_FOR] = 0.0
        if wheel[OUT] > 1.0:
            wheel[SLIPPING] = 1.0
        return False
    wheel[OUT] = 0.0
    if wheel[SLIPPING] > 0.0:
        wheel[HELD_FOR] = wheel[HELD_FOR] + 1.0 if departure < 0.5 * reach else 0.0
        if wheel[HELD_FOR] < HELD:
            return False
        wheel[SLIPPING] = 0.0
    return True


@njit(cache=True)  # type: ignore[untyped-decorator]
def _open(
    covariance: FloatArray,
    wheels: FloatArray,
    clocks: FloatArray,
    counts: NDArray[np.int64],
) -> None:
    """Start anew from what is measured where all that was measured was left out for long."""
    for state, std in ((0, NO_POSITION_STD), (1, NO_SPEED_STD)):
        late = clocks[POSITION_TIME + state] > PATIENCE
        if late and clocks[POSITION_COUNT + state] >= FEWEST_LEFT_OUT:
            covariance[state, state] += std**2
            clocks[POSITION_TIME + state] = clocks[POSITION_COUNT + state] = 0.0
            counts[1] += 1
            if state == 1:
                covariance[2, 2] += ACCELERATION_STD**2
                wheels[:, SLIPPING] = 0.0
