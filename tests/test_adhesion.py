"""Slip detector, adhesion observer and train speed under slipping wheels, as recursions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from simulated_line import flirt, level_line
from test_adhesion_characteristic import eurosprinter

from analysis.adhesion.slip import onset
from estimators.adhesion import AdhesionObserver, SlipDetector, impulse, smoothed_force, train_speed
from estimators.creep_curve import estimate_creep_curve
from estimators.linear_gaussian import LinearGaussian, random_walk_slope
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway import RunningResistance, StepProfile
from trainlog.railway.adhesion import DRY, WET, CreepCurve, PolachCurve
from trainlog.simulation.plant import Plant

AXLES, ROTATING_MASS, AXLE_LOAD = 4, 2_000.0, 16_000.0 * 9.81
FORCE_RATE = 0.12 * AXLE_LOAD


@dataclass(frozen=True)
class Run:
    """What was measured on the axles of a plant twenty times a second, and the truth [SI]."""

    time: FloatArray
    speed: FloatArray
    wheel_speed: FloatArray
    wheel_effort: FloatArray
    true_wheel_speed: FloatArray
    adhesion: FloatArray
    inertia: float


def run(
    base: float,
    *,
    curve: CreepCurve = DRY,
    demand: float = 0.26,
    speed: float = 8.0,
    climb: float = 0.1,
    seconds: float = 200.0,
    seed: int = 0,
) -> Run:
    """A plant that pulls with an adhesion of `demand` uphill, on a rail of about `base`."""
    rng = np.random.default_rng(seed)
    places = np.arange(0.0, 40_000.0, 100.0)
    rail = StepProfile(places, base * np.exp(0.12 * rng.standard_normal(places.size)))
    train = flirt(max_traction_power=20e6, resistance=RunningResistance(0.0, 0.0, 0.0))
    plant = Plant.of(level_line(gradient=climb), train, maximum_adhesion=rail, characteristic=curve)
    state = plant.at(0.0, speed)
    rows = plant.advance(state, AXLES * demand * AXLE_LOAD, 0.0, round(seconds / 0.005), 10)
    found = dict(zip(plant.columns, rows.T, strict=True))
    wheel, effort = (
        np.column_stack([found[f"{kind}_{axle + 1}"] for axle in range(AXLES)])
        for kind in ("wheel_speed", "wheel_effort")
    )
    used = curve(wheel - found["speed"][:, None]) / curve.peak * rail(found["position"])[:, None]
    measured = wheel + 0.03 * rng.standard_normal(wheel.shape)
    time, inertia = 0.05 * np.arange(len(wheel)), plant.parameters.body_inertia
    return Run(time, found["speed"], measured, effort, wheel, used, inertia)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def smoothed(plant: Run, noise: float) -> FloatArray:
    force = smoothed_force(
        plant.time, plant.wheel_speed, plant.wheel_effort, ROTATING_MASS, noise, FORCE_RATE
    )
    return force.force / AXLE_LOAD


class TestSlipDetector:
    def test_two_samples_above_then_until_half(self):
        slip = np.array([0.0, 1.6, 0.2, 1.6, 1.7, 1.2, 0.8, 0.74, 1.4])[:, None]
        found = SlipDetector(1, 0.05).update(slip)[:, 0]
        assert found.tolist() == [False] * 4 + [True, True, True, False, False]


class TestObserver:
    @given(st.integers(0, 2**31), st.integers(1, 5))
    @settings(max_examples=8)
    def test_it_is_the_linear_gaussian_filter(self, seed, axles):
        """The engine of all models, on uneven steps with speeds and efforts missing."""
        rng = np.random.default_rng(seed)
        count = 200
        time = np.cumsum(rng.uniform(0.02, 0.5, count))
        speed = 20.0 + rng.standard_normal((count, axles)).cumsum(axis=0)
        effort = 20e3 * rng.standard_normal((count, axles))
        speed[rng.random(speed.shape) < 0.2] = np.nan
        held = effort.copy()
        for row, axle in np.argwhere(rng.random(effort.shape) < 0.2):
            if row:
                effort[row, axle] = np.nan
        for row in range(1, count):
            lost = np.isnan(effort[row])
            held[row] = np.where(lost, held[row - 1], effort[row])
        found = AdhesionObserver(axles, ROTATING_MASS, 0.03, FORCE_RATE).update(time, speed, effort)
        steps = np.diff(time)
        shift = np.zeros((count - 1, axles, 2))
        shift[:, :, 0] = 0.5 * (held[1:] + held[:-1]) * (steps / ROTATING_MASS)[:, None]
        transition, noise = random_walk_slope(steps, FORCE_RATE, -1.0 / ROTATING_MASS)
        model = LinearGaussian(transition, noise, np.array([[[1.0, 0.0]]]), shift=shift)
        known = ~np.isnan(speed[0])
        first = np.where(known, 0.03, 100.0) ** 2
        spread = np.stack([np.diag(each) for each in np.column_stack(
            [first, FORCE_RATE**2 + effort[0] ** 2]
        )])  # fmt: skip
        start = np.column_stack([np.nan_to_num(speed[0]), effort[0]])
        plain = model.filter(speed[1:, :, None], 0.03**2, start, spread)
        np.testing.assert_allclose(found.force[1:], plain.means[:, :, 1], rtol=1e-9, atol=1e-4)
        np.testing.assert_allclose(found.std[1:], plain.std[:, :, 1], rtol=1e-9)

    @pytest.mark.parametrize(("curve", "base", "demand"), [(DRY, 0.28, 0.25), (WET, 0.15, 0.14)])
    def test_adhesion_in_and_out_of_slip(self, curve, base, demand):
        plant = run(base, curve=curve, demand=demand, climb=0.48 * demand)
        error = smoothed(plant, 0.03) - plant.adhesion
        slips = np.abs(plant.true_wheel_speed - plant.speed[:, None]) > 1.5
        assert slips.any()
        assert rms(error[~slips]) < 0.006
        assert rms(error[slips]) < 0.008

    def test_refuses_bad_input(self):
        with pytest.raises(InputError, match="rotating mass must be positive"):
            AdhesionObserver(1, 0.0, 0.05, FORCE_RATE)
        with pytest.raises(InputError, match="speed noise must be positive"):
            AdhesionObserver(1, 1.0, np.nan, FORCE_RATE)
        observer = AdhesionObserver(1, ROTATING_MASS, 0.05, FORCE_RATE)
        with pytest.raises(InputError, match="row 2: adhesion observer: time must increase"):
            observer.update(np.array([0.0, 1.0, 2.0, 2.0]), np.ones((4, 1)), np.ones((4, 1)))
        observer.update(np.array([5.0]), np.ones((1, 1)), np.ones((1, 1)))
        with pytest.raises(InputError, match="row 0"):
            observer.update(np.array([4.0]), np.ones((1, 1)), np.ones((1, 1)))
        with pytest.raises(InputError, match="do not fit"):
            observer.update(np.arange(3.0), np.ones((2, 1)), np.ones((2, 1)))


class TestTrainSpeed:
    @pytest.mark.parametrize("satellites", [True, False])
    def test_all_axles_may_slip_at_once(self, satellites):
        plant = run(0.22, speed=2.0, climb=0.0, seconds=60.0)
        slip = plant.true_wheel_speed - plant.speed[:, None]
        assert np.min(slip, axis=1).max() > 3.0
        reference = np.full(plant.time.size, np.nan)
        if satellites:
            noise = 0.1 * np.random.default_rng(0).standard_normal(reference[::4].size)
            reference[::4] = plant.speed[::4] + noise
        # What is given of brake and resistance is wrong by 8 per mille of the train's weight.
        other = np.full(plant.time.size, -0.008 * 9.81 * plant.inertia)
        gained = impulse(plant.time, plant.wheel_speed, plant.wheel_effort, other, ROTATING_MASS)
        found = train_speed(
            plant.time,
            plant.wheel_speed,
            smoothed(plant, 0.03),
            0.03,
            gained / plant.inertia,
            reference,
            np.full(plant.time.size, 0.1),
        )
        limit = 0.03 if satellites else 0.25
        assert rms(found.speed - plant.speed) < limit
        assert np.max(np.abs(found.speed - plant.speed)) < 3.0 * limit


class TestOnset:
    def test_a_flat_top_is_averaged(self):
        rng = np.random.default_rng(1)
        used = np.concatenate((np.linspace(0.05, 0.1, 20), np.full(40, 0.1)))
        used += 0.003 * rng.standard_normal(60)
        top, fell = onset(used, noise=0.003)
        assert used[top].mean() == pytest.approx(0.1, abs=0.0015)
        assert used.max() > 0.105
        assert not fell

    def test_measured_creep_curves(self):
        """Curves after a measurement peak at 0.16 m/s and lie flat or fall slowly beyond."""
        creepage, adhesion, speed = eurosprinter(2)
        time = np.arange(0.0, 12.0, 0.05)
        wheel, used, effort = climb(creepage * speed, adhesion, time)
        noise = 0.02 * np.random.default_rng(3).standard_normal(wheel.shape)
        force = smoothed_force(
            time, wheel + noise, effort, ROTATING_MASS, 0.02, FORCE_RATE
        ).force / (AXLE_LOAD)
        assert rms(force[20:-20] - used[20:-20]) < 0.008
        peak = int(np.argmax(wheel[:, 0]))
        window = force[peak - 60 : peak, 0]
        top, fell = onset(window, noise=0.004)
        assert fell
        assert window[top].mean() == pytest.approx(adhesion.max(), rel=0.03)


def climb(
    slip: FloatArray, adhesion: FloatArray, time: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """An axle of a train at 10 m/s whose effort rises slowly until it slips away, then is cut."""
    fine = 1e-3
    steps = round((time[1] - time[0]) / fine)
    wheel, effort, cut = 10.0, 0.25 * AXLE_LOAD, False
    speeds, used, efforts = [], [], []
    for k in range(len(time) * steps):
        cut |= wheel - 10.0 > 2.2
        wanted = AXLE_LOAD * min(0.25 + 0.01 * k * fine, 0.35) * (0.3 if cut else 1.0)
        effort += (wanted - effort) * fine / 0.1
        now = float(np.interp(wheel - 10.0, slip, adhesion, left=0.0))
        if k % steps == 0:
            speeds.append(wheel)
            used.append(now)
            efforts.append(effort)
        wheel += fine * (effort - now * AXLE_LOAD) / ROTATING_MASS
    return np.array(speeds)[:, None], np.array(used)[:, None], np.array(efforts)[:, None]


@pytest.mark.parametrize("friction", [0.2, 0.25, 0.3])
@pytest.mark.parametrize(("floor", "decay"), [(0.4, 0.2), (0.4, 0.6), (0.6, 0.3)])
def test_the_maximum_of_polachs_curves_is_found(friction, floor, decay):
    slip = np.linspace(0.0, 6.0, 300)
    curve = PolachCurve(40.0 / np.pi, 1.0, 0.4, friction, floor, decay)(slip, 10.0)
    time = np.arange(0.0, 14.0, 0.1)
    wheel, _, effort = climb(slip, curve, time)
    rng = np.random.default_rng(3)
    wheel = wheel + 0.02 * rng.standard_normal(wheel.shape)
    force = smoothed_force(time, wheel, effort, ROTATING_MASS, 0.02, FORCE_RATE)
    slip_speed = wheel[:, 0] - 10.0
    peak = int(np.argmax(slip_speed))
    part = slice(max(peak - 20, 0), peak + 5)
    found = estimate_creep_curve(
        time[part], slip_speed[part], force.force[part, 0] / AXLE_LOAD, 0.005, 0.04
    )
    middle = int(np.argmin(np.abs(slip_speed[part] - slip[np.argmax(curve)])))
    error = found.maximum[middle] - curve.max()
    assert abs(error) < 0.12 * curve.max()
    assert abs(error) < 3.0 * found.maximum_std[middle]
    top = int(np.argmax(slip_speed[part]))
    slope = float(np.interp(slip_speed[part][top], slip, np.gradient(curve, slip)))
    assert abs(found.slope[top] - slope) < 3.0 * found.slope_std[top]
