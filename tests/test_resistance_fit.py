"""Running resistance and mass of one trip: the truth in the band, and refusals with reasons."""

from __future__ import annotations

import json
import re
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import example, given, settings, strategies as st
from refusals import refused
from resistance_trips import RESISTANCE, changed, trip, with_exact_efforts
from trip_parts import without

import analysis
from analysis import TripRefusedError, coast_down, fit_trip, view_of, with_estimates
from analysis.resistance import TripFit
from analysis.resistance.curve import band_factor, curve_std
from analysis.resistance.noise import build_windows
from analysis.resistance.recording import prepare
from trainlog.errors import LogError, NotIdentifiableError
from trainlog.formats.railway import read_line, read_train, train_to_bytes
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway import RunningResistance
from trainlog.railway.adhesion import polach_curve
from trainlog.railway.resistance import basis
from trainlog.simulation import draw_scenarios, simulate
from trainlog.simulation.vehicles import kinds
from trainlog.topics import GNSS_MOTION, TRAIN_AXLES
from trainlog.trip import TRAIN_ATTACHMENT, Trip, frame_of, seconds

pytestmark = pytest.mark.usefixtures("remembered")

LINE = read_line(sample(DEFAULT_LINE))
FLIRT = read_train(sample(DEFAULT_TRAIN))


@pytest.fixture(scope="module")
def simulated() -> list[Trip]:
    """Three simulated trips: dry, dry back, wet."""
    return [simulate(scenario) for scenario in draw_scenarios(LINE, FLIRT, 3, seed=1)]


@pytest.fixture(scope="module")
def fitted(simulated: list[Trip]) -> list[TripFit]:
    return [fit_trip(one) for one in simulated]


def truth(one: Trip) -> tuple[RunningResistance, float]:
    """What the fit must not see."""
    content = json.loads(one.attachments["scenario.json"])
    return RunningResistance(content["r0"], content["r1"], content["r2"]), content["mass"]


def curve_error(fit: TripFit, true: RunningResistance) -> float:
    speed = np.linspace(5.0, fit.asked[1], 61)
    return float(np.sqrt(np.mean((fit.resistance(speed) / true(speed) - 1.0) ** 2)))


def in_band(fit: TripFit, true: RunningResistance) -> bool:
    speed = np.linspace(5.0, fit.asked[1], 61)
    low, high = fit.band(speed)
    return bool(np.all((low <= true(speed)) & (true(speed) <= high)))


def test_truth_of_simulated_trips_is_found(simulated, fitted):
    for one, fit in zip(simulated, fitted, strict=True):
        true, mass = truth(one)
        assert curve_error(fit, true) < 0.05
        assert abs(fit.mass - mass) < 4.0 * fit.mass_std
        # The load is weighed to 625 kg; the motion alone shows more.
        assert fit.mass_std < 0.01 * mass
    assert fit_trip(with_exact_efforts(simulated[0])).mass_std < 0.005 * truth(simulated[0])[1]


@settings(max_examples=4, derandomize=True)
@given(
    seed=st.integers(0, 2**32 - 1),
    duration=st.floats(100.0, 1500.0),
    noise=st.floats(np.log(1e-3), np.log(0.5)).map(np.exp),
    tail=st.sampled_from([1.2, 2.0, 4.0, 100.0]),
)
@example(seed=5, duration=1500.0, noise=0.02, tail=1.2)
def test_any_trip_is_fitted_or_refused(seed, duration, noise, tail):
    """However many outliers there are: the residuals are those of the windows that were kept."""
    made = trip(duration=duration, noise=0.0)
    speed = made["/train/state"]["speed"].to_numpy()
    errors = np.random.default_rng(seed).standard_t(tail, speed.size).clip(-200.0, 200.0)
    try:
        fit = fit_trip(changed(made, "/train/state", speed=np.abs(speed + noise * errors)))
    except NotIdentifiableError:
        return
    assert fit.residuals.value.size == fit.windows["used"]
    assert np.sum(~fit.points.used) == fit.windows["outlier"]
    assert np.all(np.isfinite(fit.covariance))
    assert np.all(np.linalg.eigvalsh(fit.covariance[:3, :3]) > 0.0)
    # What is still far off was left in because the search was given up, never by chance.
    assert np.max(np.abs(fit.residuals.value)) < 5.0 or fit.windows["outlier"] >= 59


def test_fitting_does_not_read_the_truth(simulated, fitted):
    shown = {n: data for n, data in simulated[0].attachments.items() if "scenario" not in n}
    blind = replace(without(simulated[0], "/truth"), attachments=shown)
    again = fit_trip(blind)
    np.testing.assert_array_equal(again.beta, fitted[0].beta)
    np.testing.assert_array_equal(again.covariance, fitted[0].covariance)


def test_wrong_wheels_are_found_by_satellites_and_charged_without_them():
    made = with_exact_efforts(trip(noise=0.03))
    worn = changed(made, "/train/state", speed=1.004 * made["/train/state"]["speed"])
    stamps = made["/train/state"].index[::2]
    speed = made["/train/state"]["speed"].to_numpy()[::2].copy()
    speed[500] = 80.0  # an outlier as receivers give them
    frame = frame_of(GNSS_MOTION, pd.DatetimeIndex(stamps), {"speed": speed})
    calibrated, blind = fit_trip(worn.with_topic(frame)), fit_trip(worn)
    assert calibrated.scale.factor == pytest.approx(1.004, abs=2e-4)
    assert calibrated.scale.source == "GNSS speed"
    assert curve_error(calibrated, RESISTANCE) < curve_error(blind, RESISTANCE)
    assert in_band(calibrated, RESISTANCE)
    assert in_band(blind, RESISTANCE)
    top = 30.0
    assert blind.std(top) > 2.0 * calibrated.std(top)


@pytest.mark.parametrize("lever", [1.0, 0.8])
def test_power_limit_is_read_off_a_full_lever_where_no_demand_is_recorded(lever):
    (scenario,) = draw_scenarios(LINE, FLIRT, 1, seed=2)
    power = 0.93 * FLIRT.max_traction_power
    habits = replace(scenario.habits, lever=lever)
    made = simulate(replace(scenario, max_power=power, habits=habits))
    absent = np.full(len(made["/train/controls"]), np.nan)
    demands = {"tractive_effort_demand": absent, "braking_effort_demand": absent}
    fit = fit_trip(changed(made, "/train/controls", **demands))
    if lever < 1.0:
        assert fit.max_power is None, "a lever that asks for less shows no limit"
        return
    assert abs(fit.max_power - power) < 1.96 * fit.max_power_std
    assert fit.max_power_std < 0.015 * power
    # Of axles of which one lacks its effort, or its speed, the train's effort gives the power.
    for lost in ("wheel_effort_2", "wheel_speed_2"):
        fewer = made["/train/axles"].drop(columns=lost)
        fewer.attrs = made["/train/axles"].attrs
        short = fit_trip(changed(made, "/train/controls", **demands).with_topic(fewer))
        assert abs(short.max_power - power) < 1.96 * short.max_power_std, lost


@pytest.mark.parametrize("factor", [0.0, 0.25, 3.6])
def test_speeds_that_chainage_contradicts_are_refused(simulated, factor):
    kept = ("/train/state", "/train/controls")
    made = replace(simulated[0], topics={name: simulated[0][name] for name in kept})
    wrong = changed(made, "/train/state", speed=factor * made["/train/state"]["speed"].to_numpy())
    said = f"the recorded speed is {factor:.1f}. times that of the chainage"
    stated = refused(TripRefusedError, said, fit_trip, wrong)
    assert stated.reason == "contradiction"
    refused(LogError, f"nothing can be estimated; state: .*{said}", with_estimates, wrong)
    refused(NotIdentifiableError, said, coast_down, [wrong])


def test_a_state_of_one_sample_is_not_smoothed(simulated):
    one = simulated[0].with_topic(simulated[0]["/train/state"].iloc[:1])
    assert "/train/state holds 1 sample; record it" in with_estimates(one)[1][0]
    twice = simulated[0]["/train/state"].iloc[[0, 0, 1, 1]]
    said = "can be estimated; state: trip 'trip-01': time does not increase; ingest the recording"
    stated = refused(LogError, said, with_estimates, simulated[0].with_topic(twice))
    assert stated.place == "topic /train/state, row 1"


def test_band_holds_the_whole_curve_as_often_as_it_says():
    generator = np.random.default_rng(1)
    root = np.array([[300.0, 0.0, 0.0], [-18.0, 6.0, 0.0], [0.4, -0.12, 0.03]])
    covariance = root @ root.T
    speed = np.linspace(5.0, 35.0, 121)
    std = curve_std(covariance, speed)
    for freedom in (8, 1000):
        draws = generator.standard_normal((20_000, 3)) @ root.T @ basis(speed).T / std
        draws /= np.sqrt(generator.chisquare(freedom, (20_000, 1)) / freedom)
        factor = band_factor(covariance, (5.0, 35.0), freedom)
        held = np.mean(np.all(np.abs(draws) < factor, axis=1))
        assert 0.945 < held < 0.975
        assert np.mean(np.abs(draws[:, 60]) < factor) > 0.95


def test_efforts_that_cannot_be_those_of_the_train_are_refused_in_a_line():
    made = trip(noise=0.03)
    effort = made["/train/controls"]["tractive_effort"]
    cases = {
        "tractive effort is 0 throughout": 0.0 * effort,
        "declare unit kN for its column": 1e-3 * effort,
        "declare unit N for its column": 1e3 * effort,
        r"tractive effort is 1.5 kN while the dynamic brake acts": effort + 1.5e3,
        "recorded efforts are 0.2[0-9] times what the motion needs": 0.25 * effort,
    }
    for message, wrong in cases.items():
        braking = made["/train/controls"]["dynamic_braking_effort"] * (wrong.max() / effort.max())
        bad = changed(
            made, "/train/controls", tractive_effort=wrong, dynamic_braking_effort=braking
        )
        caught = refused(TripRefusedError, message, fit_trip, bad)
        assert caught.reason in ("not recorded", "contradiction")


def test_a_dynamic_brake_of_0_throughout_is_taken_for_one_that_is_not_recorded(simulated):
    for made in simulated[:2]:
        silent, unknown = (
            fit_trip(changed(made, "/train/controls", dynamic_braking_effort=value))
            for value in (0.0, np.nan)
        )
        for speed in (10.0, 30.0):
            assert silent.resistance(speed) == pytest.approx(unknown.resistance(speed))


@pytest.mark.parametrize(
    ("topic", "column", "every"),
    [
        ("/train/state", "position", 10),
        ("/train/state", "speed", 2),
        ("/train/controls", "tractive_effort", 2),
        ("/train/controls", "tractive_effort", 10),
    ],
)
def test_columns_of_one_table_may_be_recorded_more_seldom_than_others(
    simulated, fitted, topic, column, every
):
    values = simulated[0][topic][column].to_numpy(np.float64, copy=True)
    values[np.arange(values.size) % every > 0] = np.nan
    fit = fit_trip(changed(simulated[0], topic, **{column: values}))
    assert in_band(fit, truth(simulated[0])[0])
    assert fit.resistance(20.0) == pytest.approx(fitted[0].resistance(20.0), rel=0.02)
    # A gap that is too long for any column stays one.
    values[3000:3600] = np.nan
    left = prepare(view_of(changed(simulated[0], topic, **{column: values}))).masked["gap"]
    assert left == pytest.approx(60.0, abs=3.0)


@pytest.mark.parametrize(("kind", "seed", "number"), [("kiss", 41, 6), ("flirt", 61, 0)])
def test_efforts_recorded_every_second_beside_speeds_at_10_hz(kind, seed, number):
    """When an effort changes between two samples is not known: no brake drags, no offset."""
    line = read_line(sample("DE_Chemnitz_Cranzahl.line.json"))
    trip = simulate(draw_scenarios(line, kinds()[kind], 8, seed=seed)[number])
    seldom = trip.with_topic(trip["/train/controls"].iloc[::10])
    fit, true = fit_trip(seldom), truth(trip)[0]
    assert in_band(fit, true)
    assert curve_error(fit, true) < 0.04
    assert not fit.notes


def test_slip_is_masked_where_no_axle_speeds_are_recorded():
    """Wheels of another adhesion than any estimator knows slip; the effort alone shows it."""
    wet = replace(draw_scenarios(LINE, FLIRT, 4, seed=2)[3], characteristic=polach_curve("wet"))
    trip = simulate(wet)
    state, wheels, truth = trip["/train/state"], trip["/train/axles"], trip["/truth"]
    names = [name for name in wheels if name.startswith("wheel_speed")]
    slip = wheels[names].sub(truth["speed"], axis=0).sum(axis=1).to_numpy()
    time = seconds(state)

    def left(trip: Trip) -> tuple[float, float]:
        """Change of the sum of slips in a window [m/s], RMS, and time that is used [s]."""
        windows = build_windows(prepare(view_of(trip)))
        change = np.interp(windows.end, time, slip) - np.interp(windows.start, time, slip)
        return float(np.sqrt(np.mean(change**2))), float(windows.duration.sum())

    bare = without(trip, TRAIN_AXLES.name)
    speeds = np.tile(state["speed"].to_numpy()[:, None], (1, FLIRT.axles.count))
    # Axles that turn as the train moves hide slip from masks.
    hidden = bare.with_topic(frame_of(TRAIN_AXLES, state.index, {"wheel_speed": speeds}))
    unseen, all_time = left(hidden)
    rest, used = left(bare)
    assert unseen > 0.5
    assert rest < 0.25 * unseen
    assert used > 0.8 * all_time


def test_slips_of_a_locomotive_are_used_where_all_its_wheels_are_recorded():
    """On another creep curve than the fit knows; the file's momentum of the axles may be wrong.

    Masked, slip leaves 11 % of uncertainty at 36 km/h and the trip is refused.
    """
    train = kinds()["traxx"]
    wet = draw_scenarios(LINE, train, 4, seed=1)[3]
    trip = simulate(replace(wet, characteristic=polach_curve("wet")))
    for share in (0.7, 1.0, 1.3):
        axles = replace(train.axles, rotating_mass=share * train.axles.rotating_mass)
        stated = {TRAIN_ATTACHMENT: train_to_bytes(replace(train, axles=axles))}
        fit = fit_trip(replace(trip, attachments={**trip.attachments, **stated}))
        assert fit.masked["slip"] == 0.0
        assert in_band(fit, wet.resistance)
        assert fit.std(fit.asked[0]) < 0.05 * fit.resistance(fit.asked[0])
    unknown = np.full(len(trip[TRAIN_AXLES.name]), np.nan)
    fewer = changed(trip, TRAIN_AXLES.name, wheel_speed_1=unknown)
    refused(TripRefusedError, r"masked \d+ s, which the speeds of all powered", fit_trip, fewer)


def at_one_speed(kmh: float) -> Trip:
    """A start, and nothing but one speed behind it."""
    return trip(
        lambda time: kmh / 3.6 * np.sin(0.5 * np.pi * np.clip(time / 60.0, 0.0, 1.0)),
        name=f"at {kmh:.0f}", seed=round(kmh),
    )  # fmt: skip


def test_trips_at_one_speed_each_determine_the_curve_together():
    made = [at_one_speed(kmh) for kmh in (36.0, 72.0, 120.0)]
    for one in made:
        refused(TripRefusedError, "speed and effort vary too little", fit_trip, one)
    found = analysis.fit(made)
    speed = np.linspace(10.0, 33.0, 24)
    low, high = found.common.band(speed)
    true = RESISTANCE(speed)
    assert np.all((low <= true) & (true <= high))
    assert np.max(np.abs(found.common.resistance(speed) / true - 1.0)) < 0.02
    assert [one.trip for one in found.trips] == ["at 120", "at 36", "at 72"]
    assert not found.refused
    assert any("alone too little is known of the curve" in note for note in found.notes)
    # What they do not show together stays refused.
    near = [at_one_speed(kmh) for kmh in (36.0, 40.0, 44.0)]
    refused(NotIdentifiableError, "no trip determines the running resistance", analysis.fit, near)


@pytest.mark.parametrize(
    ("number", "offset"), [(0, 2000.0), (1, 2000.0), (0, -2000.0), (2, -1000.0), (1, 500.0)]
)
def test_an_offset_of_efforts_while_pulling_is_stated_and_left_to_itself(
    simulated, fitted, number, offset
):
    assert "while pulling" not in str(fitted[number].notes)
    effort = simulated[number]["/train/controls"]["tractive_effort"]
    spoilt = effort.where(effort <= 0.0, effort + offset)
    fit = fit_trip(changed(simulated[number], "/train/controls", tractive_effort=spoilt))
    too = "high" if offset > 0.0 else "low"
    said = re.search(rf"efforts are (\d\.\d) ± 0\.\d kN too {too} while pulling", str(fit.notes))
    assert said
    assert 0.7 < 1e3 * float(said[1]) / abs(offset) < 1.3
    true = truth(simulated[number])[0]
    assert curve_error(fit, true) < 0.06
    assert in_band(fit, true)


def test_a_large_offset_of_efforts_while_pulling_is_refused(simulated):
    effort = simulated[0]["/train/controls"]["tractive_effort"]
    spoilt = effort.where(effort <= 0.0, effort + 4000.0)
    whole = changed(simulated[0], "/train/controls", tractive_effort=spoilt)
    refused(TripRefusedError, "running resistance is uncertain by", fit_trip, whole)


def test_a_brake_that_drags_through_half_of_a_trip_is_named_with_place_and_time():
    """A force that no term of the equation of motion knows."""
    whole = trip()
    controls = whole["/train/controls"]
    effort = controls["tractive_effort"] - controls["dynamic_braking_effort"]
    effort += 2500.0 * (seconds(controls) >= 600.0)
    efforts = {
        "tractive_effort": effort.clip(0.0),
        "dynamic_braking_effort": -effort.clip(None, 0.0),
    }
    dragged = changed(whole, "/train/controls", **efforts)
    error = refused(TripRefusedError, "elsewhere: a dragging brake", fit_trip, dragged)
    assert error.reason == "contradiction"
    # Which half is right is not known: the trip begins at 22:13:20.
    assert re.search(r"22:23:[12]\d", str(error))
    assert "2.5 ± 0." in str(error)


def test_without_a_recorded_wind_the_band_of_still_air_holds_the_truth():
    """A steady head wind of 8 m/s: r2 (v + w)² for r2 v²."""
    blown = RunningResistance(
        RESISTANCE.r0 + RESISTANCE.r2 * 64.0, RESISTANCE.r1 + 16.0 * RESISTANCE.r2, RESISTANCE.r2
    )
    windy = trip(resistance=blown)
    fit = fit_trip(windy)
    speed = np.array([12.0, 20.0, 30.0])
    assert np.all(fit.band(speed)[0] > RESISTANCE(speed))
    low, high = fit.still_air(speed)
    assert np.all((low < RESISTANCE(speed)) & (RESISTANCE(speed) < high))
    assert "no wind is recorded" in fit.summary()["in still air"]
    (note,) = (each for each in analysis.fit(windy).notes if "wind is recorded" in each)
    v, curve = 80.0 / 3.6, fit.resistance
    share = curve.r2 * 10.0 * (2.0 * v + 10.0) / float(curve(v))
    assert f"A head wind of 10 m/s would be {share:.0%} of it at 80 km/h" in note
