"""Slip of a trip's axles: train speed, wheel diameters, slip events and their onsets."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import flirt, hilly_line, level_line
from trip_parts import without

from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.estimates import estimate_log
from estimators.adhesion import SlipDetector
from trainlog.arrays import FloatArray
from trainlog.errors import LogError
from trainlog.formats.railway import train_to_bytes
from trainlog.mcap import read_log, write_log
from trainlog.railway import Axles, Train
from trainlog.railway.train import AxleGeometry, axle_loads, load_transfer
from trainlog.resampling import interpolated
from trainlog.simulation import Scenario, draw_scenarios, drive, recorded
from trainlog.simulation.plant import Plant
from trainlog.simulation.recording import Run
from trainlog.spans import runs_of
from trainlog.trip import TRAIN_ATTACHMENT, Trip


@dataclass(frozen=True, eq=False)
class Seen:
    """A trip, its analysis, and the true train speed and slip speeds at the axles' samples."""

    scenario: Scenario
    trip: Trip
    found: SlipAnalysis
    speed: FloatArray
    slip: FloatArray


def seen(scenario: Scenario) -> Seen:
    run = drive(scenario)
    trip = recorded(scenario, run)
    names = scenario.plant().columns
    speed = run.samples[:, names.index("speed")]
    wheels = run.samples[:, [i for i, n in enumerate(names) if n.startswith("wheel_speed_")]]
    return Seen(scenario, trip, slip(trip), speed, wheels - speed[:, None])


def rates(trips: Sequence[Seen], margin: float = 0.15) -> tuple[float, float, int]:
    """Shares of true slips that are reported and of reported that are true; how many are true.

    Slips whose size is within the margin [m/s] of the threshold may be either.
    """
    found, right = list[bool](), list[bool]()
    for each in trips:
        truly = SlipDetector(each.slip.shape[1], 0.0).update(each.slip)
        for axle in range(each.slip.shape[1]):
            size, reported = np.abs(each.slip[:, axle]), each.found.slipping[:, axle]
            for a, b in runs_of(truly[:, axle]):
                if size[a:b].max() > 1.5 + margin:
                    found.append(reported[a:b].any())
            for a, b in runs_of(reported):
                right.append(size[max(a - 1, 0) : b + 1].max() >= 1.5 - margin)
    return float(np.mean(found)), float(np.mean(right)), len(found)


def onset_errors(each: Seen) -> FloatArray:
    """Error of the adhesion at the onsets that measured it, against the truth at their places."""
    events = each.found.events[each.found.events["measured"]]
    truth = each.scenario.maximum_adhesion(events["position"].to_numpy())
    return np.asarray(events["adhesion"].to_numpy() - truth)


FINE = 200
"""Samples a second of the truth about the heat of a slip."""


@dataclass(frozen=True, eq=False)
class Fine:
    """A trip at the sensors' own rate, and the true slip power of each axle [W] at `FINE` Hz.

    The force between wheel and rail is what is left of the motor's effort when the wheel has been
    turned faster, so that it does not depend on the plant's law of adhesion.
    """

    scenario: Scenario
    trip: Trip
    power: FloatArray


pytestmark = pytest.mark.usefixtures("remembered")


@pytest.fixture(scope="module")
def trips() -> list[Seen]:
    """Dry and wet, forward and reverse."""
    return [seen(scenario) for scenario in draw_scenarios(hilly_line(), flirt(), 4, seed=1)]


def test_train_speed_under_slipping_wheels(trips):
    for each in trips:
        error = each.found.speed - each.speed
        assert np.sqrt(np.mean(error**2)) < 0.12
        assert np.max(np.abs(error)) < 0.8


@pytest.mark.parametrize("every", [1, 5, 10])
def test_train_speed_is_that_of_its_time(trips, every):
    """Satellites give several speeds between two slow samples of the axles."""
    for each in trips:
        found = slip(slower(each.trip, every)).speed - each.speed[::every]
        acceleration = np.gradient(each.speed[::every], 0.1 * every)
        assert abs(found @ acceleration / (acceleration @ acceleration)) < 0.05  # s
        assert np.sqrt(np.mean(found**2)) < 0.12


def test_every_slip_is_found_and_nothing_else(trips):
    recall, precision, count = rates(trips)
    assert count > 100
    assert recall > 0.997
    assert precision > 0.997


def test_onsets_measure_the_maximum_adhesion(trips):
    errors = np.concatenate([onset_errors(each) for each in trips])
    assert errors.size > 50
    assert np.median(np.abs(errors)) < 0.005
    assert np.mean(np.abs(errors) < 0.02) > 0.95
    assert abs(np.median(errors)) < 0.003


@pytest.mark.parametrize(
    ("missing", "limit"),
    [
        (("/train/controls",), 0.4),
        (("/gnss/motion",), 0.6),
        (("/gnss/motion", "/train/controls"), 0.8),
    ],
)
def test_with_less_recorded_it_still_works(trips, missing, limit):
    """Without satellites the creep of the wheels, up to a metre a second, cannot be seen."""
    less = [replace(each, found=slip(without(each.trip, *missing))) for each in trips[1:3]]
    for each in less:
        assert np.sqrt(np.mean((each.found.speed - each.speed) ** 2)) < limit
    assert min(rates(less, margin=0.75)[:2]) > 0.95


def of_efforts(trip: Trip, change: Callable[[pd.DataFrame], pd.DataFrame], *topics: str) -> Trip:
    """The trip with its recorded efforts changed, in the topics named or in all."""
    for topic in topics or ("/train/axles", "/train/controls"):
        frame = trip[topic].copy()
        names = [n for n in frame if "effort" in n and "demand" not in n]
        frame[names] = change(frame[names])
        trip = trip.with_topic(frame)
    return trip


def of_speeds(trip: Trip, change: Callable[[pd.DataFrame], pd.DataFrame], *axles: int) -> Trip:
    """The trip with the recorded speeds of its wheels changed, of the axles named or of all."""
    frame = trip["/train/axles"].copy()
    names = [f"wheel_speed_{axle}" for axle in axles or range(1, 5)]
    frame[names] = change(frame[names])
    return trip.with_topic(frame)


def late(efforts: pd.DataFrame, delay: float) -> pd.DataFrame:
    clock = efforts.index.asi8 / 1e9
    columns = {name: np.interp(clock - delay, clock, efforts[name]) for name in efforts}
    return pd.DataFrame(columns, efforts.index)


def off(each: Seen, found: SlipAnalysis) -> FloatArray:
    """Logarithm of the adhesion at the measured onsets over the truth there."""
    places = found.events.loc[found.events["measured"], "position"].to_numpy()
    truth = each.scenario.maximum_adhesion(places)
    return np.asarray(np.log1p(onset_errors(replace(each, found=found)) / truth))


@pytest.fixture(scope="module")
def heavy() -> Seen:
    """A wet trip of a train with more load than its file allows for, which the log states."""
    scenario = draw_scenarios(hilly_line(), flirt(), 3, seed=1)[2]
    found = seen(replace(scenario, mass=1.2 * scenario.train.mass))
    stated = {**found.trip.metadata, "load": f"{0.2 * scenario.train.mass:.0f}"}
    trip = replace(found.trip, metadata=stated)
    return replace(found, trip=trip, found=slip(trip))


@dataclass(frozen=True, eq=False)
class QuickProtection(Scenario):
    """A rail whose adhesion is most at small slips, and a protection that acts at 0.6 m/s."""

    def plant(self) -> Plant:
        found = super().plant()
        rail = found.rail.copy()
        rail[:, 2:4] *= 7.0
        quick = found.parameters._replace(
            slip_threshold=0.6, slip_delay=0.0, slip_release=0.2, motor_lag=0.03
        )
        return replace(found, parameters=quick, rail=rail)


@pytest.fixture(scope="module")
def quick() -> Seen:
    scenario = draw_scenarios(hilly_line(), flirt(), 3, seed=1)[2]
    known = {name: getattr(scenario, name) for name in Scenario.__dataclass_fields__}
    return seen(QuickProtection(**known))


def test_small_slips_are_found_and_measure_the_maximum(quick):
    row = quick.scenario.plant().rail
    place = interpolated(quick.trip["/truth"], "position", quick.found.time)
    a, b = row[np.searchsorted(row[:, 0], place, side="right") - 1, 2:4].T
    # Beyond the maximum of the creep curve.
    beyond = np.abs(quick.slip) > 1.2 * (np.log(b / a) / (b - a))[:, None]
    hits = [
        quick.found.slipping[max(start - 3, 0) : end + 3, axle].any()
        for axle in range(beyond.shape[1])
        for start, end in runs_of(beyond[:, axle])
    ]
    assert len(hits) > 50
    assert np.max(np.abs(quick.slip)) < 1.5
    assert np.mean(hits) > 0.95
    errors = off(quick, quick.found)
    assert errors.size > 50
    assert abs(np.median(errors)) < 0.05


class TestWhatTheRecorderLacks:
    def check(self, heavy: Seen, found: SlipAnalysis) -> None:
        """What the recorder does to the efforts moves the adhesion hardly at all."""
        error = np.median(off(heavy, found))
        assert abs(error - np.median(off(heavy, heavy.found))) < 0.01
        assert abs(error) < 0.05

    def test_the_load(self, heavy):
        """The motion shows it: the adhesion is right, within a band that is stated."""
        found = slip(of_unknown_load(heavy.trip))
        errors = off(heavy, found)
        assert errors.size > 10
        shift = np.median(errors) - np.median(off(heavy, heavy.found))
        assert abs(shift) < 1.96 * found.common_std
        assert abs(shift) < 0.05
        assert 0.002 < found.common_std < 0.05
        assert any("load is not recorded" in note for note in found.notes)

    def test_the_delay_of_the_efforts(self, heavy):
        found = slip(of_efforts(heavy.trip, lambda efforts: late(efforts, 0.5)))
        self.check(heavy, found)
        assert np.mean(np.abs(off(heavy, found)) < 0.15) > 0.9
        assert any("0.5" in note and "late" in note for note in found.notes)

    def test_the_total_that_the_efforts_of_the_axles_contradict(self, heavy):
        found = slip(of_efforts(heavy.trip, lambda efforts: 1.25 * efforts, "/train/axles"))
        self.check(heavy, found)
        assert any("1.25 times the total" in note for note in found.notes)

    @pytest.mark.parametrize(("share", "word"), [(np.nan, "empty"), (0.0, "zero")])
    def test_the_efforts_of_the_axles(self, heavy, share, word):
        """Slips are found, with no level, and no adhesion is made up."""
        found = slip(of_efforts(heavy.trip, lambda efforts: share * efforts, "/train/axles"))
        assert np.isnan(found.adhesion).all()
        assert len(found.events) == len(heavy.found.events)
        assert not found.events["measured"].any()
        assert found.events["adhesion"].isna().all()
        assert any(f"axle efforts are {word}" in note for note in found.notes)
        assert "not known" in repr(found)
        assert len(found.events_frame()) == len(found.events)

    def test_some_axle_speeds(self, heavy):
        """One a bogie: the others are not known, those recorded are as they were."""
        found = slip(of_speeds(heavy.trip, lambda speeds: np.nan * speeds, 2, 4))
        assert np.isnan(found.adhesion[:, [1, 3]]).all()
        assert set(found.events["axle"]) == {1, 3}
        assert abs(np.median(off(heavy, found))) < 0.05
        assert any("axles 2, 4 are not known" in note for note in found.notes)

    def test_noise_of_the_wheel_speeds(self, heavy):
        noise = 0.32 * np.random.default_rng(4).standard_normal((len(heavy.speed), 4))
        found = slip(of_speeds(heavy.trip, lambda speeds: speeds + noise))
        assert min(rates([replace(heavy, found=found)], margin=0.4)[:2]) > 0.97
        assert any("slips below" in note for note in found.notes)
        assert not found.complete

    def test_the_efforts_of_axles_but_not_their_total(self):
        """Where the rail does not change within 10 m: at a spot's edge either side may count."""
        errors, scores = [], []
        for scenario in draw_scenarios(hilly_line(), flirt(), 4, seed=2):
            found = slip(total_only(recorded(scenario, drive(scenario))))
            shown = found.events[found.events["measured"]]
            places = shown["position"].to_numpy()
            around = [scenario.maximum_adhesion(places + off) for off in (-10.0, 0.0, 10.0)]
            clear = np.ptp(around, axis=0) < 0.1 * around[1]
            error = (shown["adhesion"] / around[1] - 1.0)[clear]
            std = np.hypot(shown["adhesion_std"] / shown["adhesion"], found.common_std)[clear]
            errors.extend(error)
            scores.extend(np.abs(error) / std)
        assert len(errors) > 15
        assert np.sqrt(np.mean(np.square(errors))) < 0.1
        assert np.mean(np.array(scores) < 1.96) > 0.94

    def test_levels_of_slow_samples_hold_their_band(self, wet):
        """Of each passage of a place; the axles of one err alike, so that they count once."""
        every = []
        for each in wet:
            found = slip(slower(each.trip, 10))
            shown = found.events[found.events["measured"]]
            true = each.scenario.maximum_adhesion(shown["position"].to_numpy())
            own = shown["adhesion_std"] / shown["adhesion"]
            rows = pd.DataFrame({"error": np.log(shown["adhesion"] / true), "own": own})
            passages = rows.groupby((shown["position"] // 25.0).astype(int)).mean()
            every.append(passages.assign(common=np.hypot(found.common_std, found.passage_std)))
        shown = pd.concat(every)
        assert len(shown) > 25
        error, spread = np.abs(shown["error"]), np.hypot(shown["own"], shown["common"])
        assert np.mean(error < 1.96 * spread) > 0.9
        assert np.mean(error < 1.96 * shown["own"]) < 0.9


def total_only(trip: Trip) -> Trip:
    """The axles' efforts were not recorded."""
    axles = trip["/train/axles"]
    return trip.with_topic(axles[[name for name in axles if "effort" not in name]])


def of_unknown_load(trip: Trip) -> Trip:
    return replace(trip, metadata={n: v for n, v in trip.metadata.items() if n != "load"})


def slower(trip: Trip, every: int) -> Trip:
    for name in ("/train/axles", "/train/controls", "/train/state"):
        trip = trip.with_topic(trip[name].iloc[::every])
    return trip


@pytest.fixture(scope="module")
def wet() -> list[Fine]:
    return [fine(each) for each in draw_scenarios(hilly_line(), flirt(), 4, seed=1)[2:]]


def fine(scenario: Scenario) -> Fine:
    every = FINE // scenario.sensors.rate
    run = drive(replace(scenario, sensors=replace(scenario.sensors, rate=FINE)))
    names = scenario.plant().columns
    wheels, efforts = (
        run.samples[:, [i for i, name in enumerate(names) if name.startswith(kind)]]
        for kind in ("wheel_speed_", "wheel_effort_")
    )
    force = efforts - scenario.train.axles.rotating_mass * np.gradient(wheels, run.seconds, axis=0)
    power = force * (wheels - run.samples[:, [names.index("speed")]])
    coarse = Run(run.seconds[::every], run.samples[::every], run.demands[::every])
    return Fine(scenario, recorded(scenario, coarse), power)


@pytest.mark.parametrize(
    "change",
    [
        pytest.param(of_unknown_load, id="no load"),
        pytest.param(lambda t: of_efforts(t, lambda values: 1.1 * values), id="gain"),
        pytest.param(lambda t: of_efforts(t, lambda values: late(values, 0.2)), id="late"),
        pytest.param(lambda t: without(t, "/gnss/motion"), id="no satellites"),
        pytest.param(lambda t: slower(t, 5), id="2 Hz"),
        pytest.param(lambda t: slower(t, 10), id="1 Hz"),
        pytest.param(total_only, id="total effort only"),
    ],
)
def test_the_band_of_the_energy_of_slip_holds_for_poor_recorders(wet, change):
    """Against the works that the plant integrates."""
    scores = []
    for each in wet:
        events = slip(change(each.trip)).events.dropna(subset=["energy"])
        begin = pd.DatetimeIndex(each.trip["/train/axles"].index)[0]
        last, start, onset = (
            np.round((events[name] - begin).dt.total_seconds().to_numpy() * FINE).astype(int)
            for name in ("release", "start", "onset")
        )
        truth = [
            np.trapezoid(each.power[a : b + 1, axle - 1], dx=1.0 / FINE)
            for a, b, axle in zip(np.minimum(start, onset), last, events["axle"], strict=True)
        ]
        scores.append((events["energy"] - truth) / events["energy_std"])
    score = pd.concat(scores)
    assert len(score) > 20
    assert np.mean(np.abs(score) < 1.96) > 0.93


def test_efforts_of_axles_may_be_written_without_their_sign(trips):
    """The total shows when the motors brake."""
    each = trips[2]
    found = slip(of_efforts(each.trip, pd.DataFrame.abs, "/train/axles"))
    assert found.notes == ("the axle efforts have the wrong sign where the motors brake: turned",)
    pd.testing.assert_frame_equal(found.events, each.found.events, rtol=0.02)


@pytest.mark.parametrize("efforts", ["with the speeds", "between them"])
def test_rows_without_any_wheel_speed_are_no_samples(trips, efforts):
    trip = trips[0].trip
    axles = trip["/train/axles"]
    between = axles.set_axis(axles.index + pd.Timedelta("50ms"))
    speeds = [name for name in axles if name.startswith("wheel_speed_")]
    apart = {name: np.nan for name in axles if name not in speeds}
    if efforts == "between them":
        axles, between = axles.assign(**apart), between.assign(**dict.fromkeys(speeds, np.nan))
    else:
        between = between * np.nan
    every = pd.concat([axles, between]).sort_index()
    every.attrs = axles.attrs
    found, whole = slip(trip.with_topic(every)), slip(trip)
    assert found.time.equals(whole.time)
    assert len(found.events) == pytest.approx(len(whole.events), rel=0.02)
    if efforts == "with the speeds":
        pd.testing.assert_frame_equal(found.events, whole.events)


def without_speeds(trip: Trip, axle: int, times: pd.DatetimeIndex) -> Trip:
    return of_speeds(trip, lambda v: v.where(~v.index.isin(times)[:, None], np.nan), axle)


def test_a_missing_sample_of_an_axle_does_not_split_its_slip(trips):
    """A longer gap does: slip protection may have ended the slip in it."""
    for each in (trips[0], *trips[2:]):  # the other has slips at the threshold, which noise decides
        whole, clock = each.found.events, each.trip["/train/axles"].index
        found = slip(without_speeds(each.trip, 1, clock[::50])).events
        assert found["axle"].tolist() == whole["axle"].tolist()
        np.testing.assert_allclose(found["peak_slip"], whole["peak_slip"], rtol=0.2)
        energies = found[["energy", "energy_std"]].to_numpy()
        assert (np.abs(energies[:, 0] - whole["energy"]) < 2.0 * energies[:, 1]).all()
    slips = trips[0].found.events
    longest = slips.loc[slips["duration"].idxmax()]
    middle = longest["start"] + 0.5 * (longest["release"] - longest["start"])
    clock = trips[0].trip["/train/axles"].index
    for gap, events in ((0.3, 1), (1.0, 2)):
        half = pd.Timedelta(seconds=gap / 2.0)
        lost = clock[(clock > middle - half) & (clock < middle + half)]
        found = slip(without_speeds(trips[0].trip, int(longest["axle"]), lost)).events
        assert len(found) == len(slips) + events - 1


def of_train(trip: Trip, train: Train) -> Trip:
    stated = {TRAIN_ATTACHMENT: train_to_bytes(train)}
    return replace(trip, attachments={**trip.attachments, **stated})


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        (lambda trip: without(trip, "/train/axles"), "no topic /train/axles"),
        (lambda trip: without(trip, "/train/state"), "has no position"),
        (lambda t: of_train(t, flirt(axles=Axles(count=2))), "4 axles, train 'flirt' has 2"),
        (lambda trip: of_speeds(trip, lambda v: np.nan * v), "has no axle speed"),
        (
            lambda trip: of_speeds(trip, lambda v: 2.237 * v, 2),
            r"wheel_speed_2 is 2\.2. times the train's speed; check its unit",
        ),
        (
            lambda trip: of_speeds(trip, lambda v: -v),
            r"wheel_speed_1 is -1(\.0\d+)? times the train's speed; check its unit and sign",
        ),
        (lambda trip: replace(trip, attachments={}), r"has no train\.json"),
        (lambda trip: trip.with_topic(trip["/train/axles"].iloc[:1]), "holds 1 sample;"),
        (lambda t: replace(t, metadata={**t.metadata, "load": "heavy"}), "load 'heavy'"),
    ],
)
def test_what_cannot_be_analysed_is_refused(trips, spoilt, words):
    refused(LogError, words, slip, spoilt(trips[0].trip))


def test_logs_without_the_efforts_of_axles_are_estimated(heavy, tmp_path):
    """Samples without adhesion show nothing of a creep curve, and stop nothing."""
    axles = heavy.trip["/train/axles"].copy()
    names = [name for name in axles if name.startswith("wheel_effort_")]
    axles.loc[axles.index[: len(axles) // 3], names] = np.nan
    axles[names[0]] = np.nan
    write_log(heavy.trip.with_topic(axles), tmp_path / "trip.mcap")
    assert estimate_log(tmp_path / "trip.mcap", tmp_path / "estimated.mcap") == ()
    written = read_log(tmp_path / "estimated.mcap")
    topics = {name for name in written.topics if name.startswith("/estimates/")}
    expected = {"/estimates/state", "/estimates/running_resistance", "/estimates/adhesion"}
    assert topics == expected
    assert written["/events"]["message"].str.contains("slips in").any()


def test_values_that_rest_for_a_minute_are_left_out(trips):
    """A wheel's speed and another axle's effort: a recorder that repeats them, no slip."""
    each = trips[2]
    frame = each.trip["/train/axles"].copy()
    moving = np.flatnonzero(each.speed > 12.0)
    pulling = np.flatnonzero((each.speed > 8.0) & (frame["wheel_effort_3"].to_numpy() > 20e3))
    stuck = {"wheel_speed_2": moving[moving.size // 3], "wheel_effort_3": pulling[0]}
    for column, start in stuck.items():
        values = frame[column].to_numpy().copy()
        values[start : start + 600] = values[start]
        frame[column] = values
    found = slip(each.trip.with_topic(frame))
    assert sum("repeats itself" in note for note in found.notes) == 2
    for column, start in stuck.items():
        axle, inside = int(column[-1]), slice(start + 60, start + 590)
        assert np.isnan(found.adhesion[inside, axle - 1]).all()
        own = found.events[(found.events["axle"] == axle) & found.events["measured"]]
        assert not own["onset"].between(found.time[inside.start], found.time[inside.stop]).any()
    # What other axles did is as it was, but for slips near the threshold.
    before, after = (seen.sort_values("start") for seen in (each.found.events, found.events))
    within = {
        "on": "start",
        "by": "axle",
        "direction": "nearest",
        "tolerance": pd.Timedelta("0.3s"),
    }
    for ours, theirs in ((before, after), (after, before)):
        clear = ours[ours["axle"].isin([1, 4]) & (ours["peak_slip"].abs() > 1.65)]
        assert len(clear) > 70
        pairs = pd.merge_asof(clear, theirs, **within)
        np.testing.assert_allclose(pairs["adhesion_x"], pairs["adhesion_y"], rtol=0.07)


GEOMETRY = AxleGeometry(2.6, 9.5, 0.6, 1.0, 1.6)


def with_geometry(geometry: AxleGeometry | None = GEOMETRY, **axles: object) -> Train:
    return flirt(axles=Axles(**{"geometry": geometry, **axles}))


lengths = st.floats(0.3, 3.0)


class TestMoments:
    @settings(max_examples=40)
    @given(
        st.builds(
            AxleGeometry, st.floats(1.5, 4.0), st.floats(6.0, 14.0), lengths, lengths, lengths,
            st.integers(2, 3),
        ),
        st.lists(st.floats(-60e3, 60e3), min_size=6, max_size=6),
        st.floats(-2.0, 2.0),
    )  # fmt: skip
    def test_a_vehicle_is_in_equilibrium(self, geometry, forces, specific):
        """About the rail: loads times their places, coupler force and inertia at their heights."""
        count = 2 * geometry.axles_per_bogie
        pull, mass = np.array(forces[:count]), count * 18e3
        transfer = load_transfer(geometry, count, mass)
        change = transfer[:, :-1] @ pull + transfer[:, -1] * specific
        assert change.sum() == pytest.approx(0.0, abs=1e-6)
        inertia = mass * specific
        coupler = pull.sum() - inertia
        offsets = np.linspace(0.5, -0.5, geometry.axles_per_bogie) * geometry.wheelbase
        middle = 0.5 * geometry.pivot_distance
        places = np.concatenate([offsets + middle, offsets - middle])
        moment = coupler * geometry.coupler_height + inertia * geometry.centre_height
        assert -change @ places == pytest.approx(moment, abs=1e-3)

    def test_a_locomotive_by_hand(self):
        """240 kN at the rails, all of it at the coupler: 120 kN × 0.6 m / 2.6 m a bogie, and
        240 kN × 0.4 m / 9.5 m of the body, shared by two axles."""
        transfer = load_transfer(GEOMETRY, 4, 84e3)
        bogie, body = 120e3 * 0.6 / 2.6, 240e3 * 0.4 / 9.5 / 2.0
        expected = [-bogie - body, bogie - body, -bogie + body, bogie + body]
        np.testing.assert_allclose(transfer[:, :4] @ np.full(4, 60e3), expected)


class TestPlant:
    def test_the_loads_are_those_of_the_moments(self):
        """On a rail at whose limit the axles pull: what each transmits is its load times that."""
        train = with_geometry()
        plant = Plant.of(level_line(), train, maximum_adhesion=None)
        state = plant.at(50_000.0, 10.0)
        rows = plant.advance(state, 190e3, 0.0, steps=400)
        found = dict(zip(plant.columns, rows.T, strict=True))
        seconds = plant.parameters.step * np.arange(400)
        wheels = np.column_stack([found[f"wheel_speed_{i}"] for i in range(1, 5)])
        efforts = np.column_stack([found[f"wheel_effort_{i}"] for i in range(1, 5)])
        turning = train.axles.rotating_mass * np.gradient(wheels, seconds, axis=0)
        force = (efforts - turning)[100:-1]
        transfer = train.load_transfer()
        static = train.adhesive_weight() / 4
        loads = axle_loads(transfer, static, force, found["acceleration"][100:-1])
        a, b, scale = plant.rail[0, 2:]
        slip_speed = (wheels - found["speed"][:, None])[100:-1]
        adhesion = scale * (np.exp(-a * slip_speed) - np.exp(-b * slip_speed))
        # Where an effort is cut the difference of wheel speeds takes no account of the kink.
        off = np.abs(force / (adhesion * loads) - 1.0)
        assert np.quantile(off, 0.9) < 2e-3
        assert off.max() < 0.05
        assert loads.min() < 0.93 * static


@pytest.fixture(scope="module")
def uneven() -> Seen:
    return seen(draw_scenarios(hilly_line(), with_geometry(), 3, seed=1)[2])


def errors(each: Seen, geometry: AxleGeometry | None) -> tuple[FloatArray, ...]:
    """Relative errors at measured onsets, their stated deviations, and the axles.

    Not where the rail changes within the 10 m to which the place of an onset is known.
    """
    events = slip(of_train(each.trip, with_geometry(geometry))).events
    events = events[events["measured"]]
    places = events["position"].to_numpy()
    around = [each.scenario.maximum_adhesion(places + off) for off in (-10.0, 0.0, 10.0)]
    clear = np.ptp(around, axis=0) < 0.1 * around[1]
    events, truth = events[clear], around[1][clear]
    used, std = events["adhesion"].to_numpy(), events["adhesion_std"].to_numpy()
    whole = np.hypot(std, events["transfer_std"].to_numpy())
    return used / truth - 1.0, std / truth, whole / truth, events["axle"].to_numpy()


def apart(error: FloatArray, axle: FloatArray) -> float:
    """By how much the leading axle is known less right than the last."""
    return float(np.median(error[axle == 4]) - np.median(error[axle == 1]))


def test_transfer_is_taken_out_by_the_geometry_and_allowed_for_without_it(uneven, trips):
    best, _, _, of_axle = errors(trips[2], None)
    least, usual = np.sqrt(np.mean(best**2)), apart(best, of_axle)
    error, std, whole, axle = errors(uneven, GEOMETRY)
    assert error.size > 100
    assert np.sqrt(np.mean(error**2)) < 1.1 * least
    assert abs(apart(error, axle) - usual) < 0.02
    assert np.mean(np.abs(error) < 1.96 * std) > 0.95
    np.testing.assert_array_equal(std, whole)
    error, std, whole, axle = errors(uneven, None)
    assert apart(error, axle) > usual + 0.05
    assert np.sqrt(np.mean(error**2)) > 1.2 * least
    assert np.median(np.sqrt(whole**2 - std**2)) > 0.02
    assert np.mean(np.abs(error) < 1.96 * whole) > 0.97
