"""Slip of a trip's axles: train speed, wheel diameters, slip events and their onsets."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused
from simulated_line import flirt, hilly_line
from slip_truth import Fine, Score, Seen, onset_errors, seen

from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.estimates import estimate_log
from trainlog.arrays import FloatArray
from trainlog.errors import LogError
from trainlog.formats.railway import train_to_bytes
from trainlog.mcap import read_log, write_log
from trainlog.railway import Axles
from trainlog.resampling import interpolated
from trainlog.simulation import Scenario, draw_scenarios
from trainlog.simulation.plant import Plant
from trainlog.spans import runs_of
from trainlog.trip import TRAIN_ATTACHMENT, Trip

pytestmark = pytest.mark.usefixtures("remembered")


@pytest.fixture(scope="module")
def trips() -> list[Seen]:
    """Dry and wet, forward and reverse."""
    return [seen(scenario) for scenario in draw_scenarios(hilly_line(), flirt(), 4, seed=1)]


def without(trip: Trip, *topics: str) -> Trip:
    return replace(trip, topics={n: f for n, f in trip.topics.items() if n not in topics})


def score(trips: list[Seen]) -> Score:
    total = Score()
    for each in trips:
        total.count(each)
    return total


def test_train_speed_under_slipping_wheels(trips: list[Seen]) -> None:
    for each in trips:
        error = each.found.speed - each.speed
        assert np.sqrt(np.mean(error**2)) < 0.12
        assert np.max(np.abs(error)) < 0.8


def test_every_slip_is_found_and_nothing_else(trips: list[Seen]) -> None:
    found = score(trips)
    assert found.true > 100
    assert found.recall > 0.997
    assert found.precision > 0.997


def test_onsets_measure_the_maximum_adhesion(trips: list[Seen]) -> None:
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
def test_with_less_recorded_it_still_works(
    trips: list[Seen], missing: tuple[str, ...], limit: float
) -> None:
    """Without satellites the creep of the wheels, up to a metre a second, cannot be seen."""
    found = Score()
    for each in trips[1:3]:
        less = slip(without(each.trip, *missing))
        assert np.sqrt(np.mean((less.speed - each.speed) ** 2)) < limit
        found.count(replace(each, found=less), margin=0.75)
    assert found.recall > 0.95
    assert found.precision > 0.95


def of_efforts(trip: Trip, change: Callable[[pd.DataFrame], pd.DataFrame], *topics: str) -> Trip:
    """The trip with its recorded efforts changed, in the topics named or in all."""
    for topic in topics or ("/train/axles", "/train/controls"):
        frame = trip[topic].copy()
        names = [n for n in frame if "effort" in n and "demand" not in n]
        frame[names] = change(frame[names])
        trip = trip.with_topic(frame)
    return trip


def late(efforts: pd.DataFrame, delay: float) -> pd.DataFrame:
    clock = efforts.index.asi8 / 1e9
    columns = {name: np.interp(clock - delay, clock, efforts[name]) for name in efforts}
    return pd.DataFrame(columns, efforts.index)


def off(each: Seen, found: SlipAnalysis) -> FloatArray:
    """Logarithm of the adhesion at the measured onsets over the truth there."""
    return np.asarray(np.log1p(onset_errors(replace(each, found=found)) / truths(each, found)))


def truths(each: Seen, found: SlipAnalysis) -> FloatArray:
    places = found.events.loc[found.events["measured"], "position"].to_numpy()
    return np.asarray(each.scenario.maximum_adhesion(places))


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


class TestSmallSlips:
    def peaks(self, each: Seen) -> list[tuple[int, int, int]]:
        """Axle, first and last sample of each true slip beyond the maximum of the creep curve."""
        row = each.scenario.plant().rail
        place = interpolated(each.trip["/truth"], "position", each.found.time)
        a, b = row[np.searchsorted(row[:, 0], place, side="right") - 1, 2:4].T
        beyond = np.abs(each.slip) > 1.2 * (np.log(b / a) / (b - a))[:, None]
        return [
            (axle, *span) for axle in range(beyond.shape[1]) for span in runs_of(beyond[:, axle])
        ]

    def test_they_are_found_and_measure_the_maximum(self, quick: Seen) -> None:
        true = self.peaks(quick)
        assert len(true) > 50
        assert np.max(np.abs(quick.slip)) < 1.5
        hits = [quick.found.slipping[max(a - 3, 0) : b + 3, axle].any() for axle, a, b in true]
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

    def test_the_load(self, heavy: Seen) -> None:
        """The motion shows it: the adhesion is right, within a band that is stated."""
        found = slip(of_unknown_load(heavy.trip))
        errors = off(heavy, found)
        assert errors.size > 10
        shift = np.median(errors) - np.median(off(heavy, heavy.found))
        assert abs(shift) < 1.96 * found.common_std
        assert abs(shift) < 0.05
        assert 0.002 < found.common_std < 0.05
        assert any("load is not recorded" in note for note in found.notes)

    @pytest.mark.parametrize("delay", [0.2, 0.5])
    def test_the_delay_of_the_efforts(self, heavy: Seen, delay: float) -> None:
        found = slip(of_efforts(heavy.trip, lambda efforts: late(efforts, delay)))
        self.check(heavy, found)
        assert np.mean(np.abs(off(heavy, found)) < 0.15) > 0.9
        assert any(f"{delay:.1f}" in note and "late" in note for note in found.notes)

    @pytest.mark.parametrize(("share", "word"), [(np.nan, "empty"), (0.0, "zero")])
    def test_the_efforts_of_the_axles(self, heavy: Seen, share: float, word: str) -> None:
        """Slips are found, with no level, and no adhesion is made up."""
        found = slip(of_efforts(heavy.trip, lambda efforts: share * efforts, "/train/axles"))
        assert np.isnan(found.adhesion).all()
        assert len(found.events) == len(heavy.found.events)
        assert not found.events["measured"].any()
        assert found.events["adhesion"].isna().all()
        assert any(f"axle efforts are {word}" in note for note in found.notes)
        assert "not known" in repr(found)
        assert len(found.events_frame()) == len(found.events)

    def test_some_axle_speeds(self, heavy: Seen) -> None:
        """One a bogie: the others are not known, those recorded are as they were."""
        axles = heavy.trip["/train/axles"].copy()
        axles[["wheel_speed_2", "wheel_speed_4"]] = np.nan
        found = slip(heavy.trip.with_topic(axles))
        assert np.isnan(found.adhesion[:, [1, 3]]).all()
        assert set(found.events["axle"]) == {1, 3}
        assert abs(np.median(off(heavy, found))) < 0.05
        assert any("axles 2, 4 are not known" in note for note in found.notes)

    def test_noise_of_the_wheel_speeds(self, heavy: Seen) -> None:
        generator = np.random.default_rng(4)
        axles = heavy.trip["/train/axles"].copy()
        names = [name for name in axles if name.startswith("wheel_speed_")]
        axles[names] += 0.3 * generator.standard_normal((len(axles), len(names)))
        found, total = slip(heavy.trip.with_topic(axles)), Score()
        total.count(replace(heavy, found=found), margin=0.4)
        assert total.precision > 0.97
        assert total.recall > 0.97
        assert any("slips below" in note for note in found.notes)
        assert not found.complete

    @pytest.mark.parametrize("every", [5, 10])
    def test_levels_of_slow_samples_hold_their_band(self, wet: Fine, every: int) -> None:
        """Of each passage of a place; the axles of one err alike, so that they count once."""
        found = slip(slower(wet.trip, every))
        shown = found.events[found.events["measured"]]
        true = wet.scenario.maximum_adhesion(shown["position"].to_numpy())
        error = np.log(shown["adhesion"] / true)
        own = shown["adhesion_std"] / shown["adhesion"]
        passages = (shown["position"] // 25.0).astype(int)
        error, own = error.groupby(passages).mean(), own.groupby(passages).mean()
        assert len(error) > 15
        spread = np.sqrt(own**2 + found.common_std**2 + found.passage_std**2)
        assert np.mean(np.abs(error) < 1.96 * spread) > 0.9
        assert np.mean(np.abs(error) < 1.96 * own) < 0.9


def total_only(trip: Trip) -> Trip:
    """The axles' efforts were not recorded."""
    axles = trip["/train/axles"]
    bare = axles[[name for name in axles if "effort" not in name]]
    bare.attrs = axles.attrs
    return trip.with_topic(bare)


def of_unknown_load(trip: Trip) -> Trip:
    return replace(trip, metadata={n: v for n, v in trip.metadata.items() if n != "load"})


def slower(trip: Trip, every: int) -> Trip:
    for name in ("/train/axles", "/train/controls", "/train/state"):
        frame = trip[name].iloc[::every]
        frame.attrs = trip[name].attrs
        trip = trip.with_topic(frame)
    return trip


@pytest.fixture(scope="module")
def wet() -> Fine:
    return Fine.of(draw_scenarios(hilly_line(), flirt(), 3, seed=1)[2])


class TestEnergyOfSlip:
    """Against the works that the plant integrates, on recorders that are not all good."""

    @pytest.mark.parametrize(
        "change",
        [
            pytest.param(of_unknown_load, id="no load"),
            pytest.param(lambda t: of_efforts(t, lambda values: 1.1 * values), id="gain"),
            pytest.param(lambda t: of_efforts(t, lambda values: late(values, 0.2)), id="late"),
            pytest.param(lambda t: without(t, "/gnss/motion"), id="no satellites"),
            pytest.param(lambda t: slower(t, 5), id="2 Hz"),
            pytest.param(total_only, id="total effort only"),
        ],
    )
    def test_its_band_holds_for_poor_recorders(
        self, wet: Fine, change: Callable[[Trip], Trip]
    ) -> None:
        found = wet.heats(change).dropna(subset=["energy"])
        assert len(found) > 10
        score = (found["energy"] - found["truth"]) / found["energy_std"]
        assert np.mean(np.abs(score) < 1.96) > 0.93


def no_axle_speed(trip: Trip) -> Trip:
    axles = trip["/train/axles"].copy()
    axles[[name for name in axles if name.startswith("wheel_speed_")]] = np.nan
    return trip.with_topic(axles)


def one_sample(trip: Trip) -> Trip:
    axles = trip["/train/axles"].iloc[:1]
    axles.attrs = trip["/train/axles"].attrs
    return trip.with_topic(axles)


def of_two_axles(trip: Trip) -> Trip:
    train = train_to_bytes(flirt(axles=Axles(count=2)))
    return replace(trip, attachments={**trip.attachments, TRAIN_ATTACHMENT: train})


@pytest.mark.parametrize(
    ("spoilt", "words"),
    [
        (lambda trip: without(trip, "/train/axles"), "no topic /train/axles"),
        (lambda trip: without(trip, "/train/state"), "has no position"),
        (of_two_axles, "4 axles, train 'flirt' has 2"),
        (no_axle_speed, "has no axle speed"),
        (lambda trip: replace(trip, attachments={}), r"has no train\.json"),
        (one_sample, "holds 1 samples"),
        (lambda t: replace(t, metadata={**t.metadata, "load": "heavy"}), "load 'heavy'"),
    ],
)
def test_what_cannot_be_analysed_is_refused(
    trips: list[Seen], spoilt: Callable[[Trip], Trip], words: str
) -> None:
    refused(LogError, words, slip, spoilt(trips[0].trip))


@pytest.mark.parametrize("recorded", [pytest.param("total only", marks=pytest.mark.long), "gaps"])
def test_logs_without_the_efforts_of_axles_are_estimated(
    recorded: str, heavy: Seen, tmp_path: Path
) -> None:
    """Samples without adhesion show nothing of a creep curve, and stop nothing."""
    axles = heavy.trip["/train/axles"].copy()
    names = [name for name in axles if name.startswith("wheel_effort_")]
    if recorded == "total only":
        axles[names] = np.nan
        axles = axles.drop(columns=names)
    else:
        axles.loc[axles.index[: len(axles) // 3], names] = np.nan
        axles[names[0]] = np.nan
    axles.attrs = heavy.trip["/train/axles"].attrs
    write_log(heavy.trip.with_topic(axles), tmp_path / "trip.mcap")
    assert estimate_log(tmp_path / "trip.mcap", tmp_path / "estimated.mcap") == ()
    written = read_log(tmp_path / "estimated.mcap")
    topics = {name for name in written.topics if name.startswith("/estimates/")}
    expected = {"/estimates/state", "/estimates/running_resistance", "/estimates/adhesion"}
    assert topics == expected
    assert written["/events"]["message"].str.contains("slips in").any()


def test_values_that_rest_for_a_minute_are_left_out(trips: list[Seen]) -> None:
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
    frame.attrs = each.trip["/train/axles"].attrs
    found = slip(each.trip.with_topic(frame))
    assert sum("repeats itself" in note for note in found.notes) == 2
    for column, start in stuck.items():
        axle, inside = int(column[-1]), slice(start + 60, start + 590)
        assert np.isnan(found.adhesion[inside, axle - 1]).all()
        own = found.events[(found.events["axle"] == axle) & found.events["measured"]]
        assert not own["onset"].between(found.time[inside.start], found.time[inside.stop]).any()
    # What other axles did is as it was.
    before, after = (seen[seen["axle"].isin([1, 4])] for seen in (each.found.events, found.events))
    assert len(before) == len(after)
    assert (
        abs(before["start"].to_numpy() - after["start"].to_numpy()) < pd.Timedelta("0.3s")
    ).all()
    np.testing.assert_allclose(before["adhesion"], after["adhesion"], rtol=0.07)
