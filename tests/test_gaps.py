"""What is missing for 20 s of a trip: bridged by what else is recorded, or stated as unknown."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from test_calculated import TRAIN, driven, true_work
from trip_parts import without

from analysis.comparison.calculated import Calculation, calculate, judged_together, together_words
from analysis.comparison.compare import ComparedTrip, compare
from analysis.comparison.driven import driven_trip
from analysis.comparison.groups import trip_cost
from trainlog.formats.samples import sample
from trainlog.mcap import read_log
from trainlog.railway import RunningResistance
from trainlog.trip import Trip

pytestmark = pytest.mark.usefixtures("remembered")


@cache
def whole() -> Trip:
    return read_log(sample("stopping.mcap"))


@cache
def compared_whole() -> ComparedTrip:
    return compare(whole()).trip("trip-03")


def interrupted(trip: Trip, topic: str, *columns: str, first: float) -> Trip:
    """A trip without some columns for 20 s; without columns, without rows."""
    frame = trip[topic]
    since = (frame.index - trip["/train/state"].index[0]).total_seconds().to_numpy()
    inside = (since > first) & (since < first + 20.0)
    changed = frame.copy() if columns else frame[~inside]
    for column in columns:
        changed.loc[inside, column] = np.nan
    return trip.with_topic(changed)


STATE, CONTROLS, AXLES, MOTION = "/train/state", "/train/controls", "/train/axles", "/gnss/motion"


@pytest.mark.parametrize(
    ("lost", "topics", "first", "words"),
    [
        ((STATE, "speed"), (), 25.0, "no speed for 20 s, bridged by"),
        ((STATE, "speed"), (AXLES, MOTION), 600.0, "no speed for 20 s, bridged by position"),
        ((STATE, "position"), (), 600.0, "no position for 20 s, bridged by speed"),
        ((STATE, "speed", "position"), (MOTION,), 150.0, "no speed for 20 s, bridged by wheel sp"),
        ((STATE, "speed", "position"), (AXLES,), 25.0, "no speed for 20 s, bridged by satellites'"),
    ],
)
def test_work_over_a_bridged_gap_is_that_of_the_true_motion(lost, topics, first, words):
    trip = without(interrupted(whole(), *lost, first=first), *topics)
    found, own = compare(trip).trip("trip-03"), compared_whole()
    assert found.trip.sums["traction"][-1] == pytest.approx(true_work(trip), rel=0.01)
    np.testing.assert_allclose(found.table["traction"], own.table["traction"], rtol=0.01)
    np.testing.assert_allclose(found.table["running_time"], own.table["running_time"], atol=0.5)
    assert any(words in note for note in found.trip.notes)
    assert not found.trip.flags["unknown_speed"].any()


@pytest.mark.parametrize(
    ("lost", "topics", "words"),
    [
        ((STATE, "speed", "position"), (AXLES, MOTION), "no speed for 20 s, not known there"),
        ((CONTROLS,), (), "no effort for 20 s, not known there"),
        ((CONTROLS, "tractive_effort"), (), "no effort for 20 s, not known there"),
    ],
)
def test_work_over_a_gap_that_nothing_bridges_is_not_stated(lost, topics, words):
    trip = without(interrupted(whole(), *lost, first=600.0), *topics)
    cost = trip_cost(trip)
    assert np.isnan(cost.traction)
    assert cost.unknown
    assert np.isnan(cost.line)
    compared = compare(trip)
    found, own = compared.trip("trip-03"), compared_whole()
    lacks = found.table["traction"].isna().to_numpy()
    assert lacks.sum() == 1
    np.testing.assert_allclose(
        found.table["traction"][~lacks], own.table["traction"][~lacks], rtol=2e-3
    )
    assert words in compared._repr_html_()


def test_energy_from_the_line_lacks_what_lacks_of_traction_or_brake():
    trip = interrupted(whole(), CONTROLS, "dynamic_braking_effort", first=600.0)
    found = compare(trip).trip("trip-03")
    assert found.recorded_energy("traction")[1] == pytest.approx(0.0, abs=1e-9)
    share = 20.0 / found.trip.running[-1]
    assert found.recorded_energy("line")[1] == pytest.approx(share, rel=0.02)


def test_a_trip_with_position_alone_has_its_speed_from_there():
    trip = whole().with_topic(whole()["/train/state"].assign(speed=np.nan))
    assert trip_cost(trip).traction == pytest.approx(true_work(trip), rel=0.01)


def calculated(trip: Trip) -> Calculation:
    return calculate(trip, TRAIN)


@pytest.mark.parametrize("bridged", [True, False])
def test_a_calculation_starts_anew_behind_a_gap(bridged):
    trip = interrupted(driven(), "/train/state", "speed", first=200.0)
    if not bridged:
        trip = interrupted(trip, "/train/state", "position", first=200.0)
        trip = without(trip, "/train/axles", "/gnss/motion")
    found, own = calculated(trip), calculated(driven())
    sums = driven_trip(trip).unknown()
    assert sums is not bridged
    if bridged:
        assert found.total("work") == pytest.approx(own.total("work"), rel=0.01)
        assert found.total("calculated_work") == pytest.approx(
            own.total("calculated_work"), rel=0.01
        )
        assert np.nanmax(np.abs(found.calculated_speed - own.calculated_speed)) < 1.0
    else:
        lacks = found.table["work"].isna()
        assert lacks.sum() == 1
        assert (found.table["calculated_work"].isna() == lacks).all()
        assert np.isnan(found.speed).sum() > np.isnan(own.speed).sum()
        behind = np.flatnonzero(np.isnan(found.speed[100:]))[-1]
        assert behind > 0
    np.testing.assert_allclose(
        found.table["time"], compare(trip).directions[0].trips[0].table["running_time"], atol=1e-6
    )
    off = found.table["calculated_time"] - own.table["calculated_time"]
    assert off.abs().max() < 3.0
    assert f"{trip.name}: no speed for 20 s" in found._repr_html_()


def test_a_drive_given_twice_is_judged_once():
    found = calculated(driven())
    assert judged_together([found, replace(found, notes=("copy",))]).judged_trips == 1
    assert "1 given twice, counted once" in together_words([found, found], found.diagnosis)


def test_what_a_model_does_not_determine_is_said_so():
    found = calculated(driven())
    first = found.table.index[0]
    table = found.table.copy()
    table.loc[first, "time_determined"] = False
    vague = replace(found, table=table)._repr_html_()
    assert "not determined" in vague
    assert f"does not determine the running time of {first}" in vague
    # A resistance ten times the train's stops it before the section ends.
    own = TRAIN.resistance
    heavy = replace(TRAIN, resistance=RunningResistance(12 * own.r0, 12 * own.r1, 12 * own.r2))
    assert calculate(driven(), heavy).not_determined["running time"]
