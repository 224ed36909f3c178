"""The study of Hauck et al. (2023), on its first section; its tables are of the whole line."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from analysis.studies.hauck_2023 import run as study, simulation as driving
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from analysis.studies.hauck_2023.run import (
    Day,
    day_by_day,
    difference_table,
    least_lateness,
    replanned,
)
from analysis.studies.hauck_2023.simulation import trip_of
from trainlog.mcap import read_log, write_log
from trainlog.railway import StepProfile

MASS = PUBLISHED_TRAIN.light
"""The heavier ones, and the other scenarios, are driven where the tables of the study are made."""
SLIPPERY = StepProfile(np.array([0.0, 60.0, 200.0, 2_700.0]), np.array([0.07, 0.05, 0.09, 0.045]))


@pytest.fixture(scope="module", autouse=True)
def fewer_nodes() -> Iterator[None]:
    """References of half the nodes, which are solved sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("analysis.studies.hauck_2023.reference.NODE_SPACING", 6.0)
        yield


@pytest.fixture(scope="module")
def prepared(fewer_nodes: None) -> study.Setup:
    return study.prepared(seed=1, sections=1)


@pytest.fixture(scope="module")
def known(prepared: study.Setup) -> study.Setup:
    return replace(prepared, rails={**prepared.rails, "bad": SLIPPERY})


@pytest.fixture(scope="module")
def outcomes(known: study.Setup) -> dict[str, study.Outcome]:
    return {each.name: study.outcome(known, each, MASS) for each in study.SCENARIOS[:2]}


@pytest.fixture(scope="module")
def days(known: study.Setup, tmp_path_factory: pytest.TempPathFactory) -> list[Day]:
    folder = tmp_path_factory.mktemp("days")
    each = day_by_day(known.plan, [SLIPPERY, SLIPPERY], [70e3, 85e3], folder, seed=1)
    first = next(each)
    # It is yielded while the second is still to be driven.
    assert [day.number for day in first] == [1]
    assert sorted(folder.iterdir()) == sorted(first[0].logs)
    (both,) = each
    assert both[0] is first[0]
    return both


def test_constraints_and_stops_are_kept_and_only_without_the_map_axles_skid(outcomes):
    for each in outcomes.values():
        found = each.informed
        assert found.worst.max() <= 1e-6
        assert found.unsolved == found.slip_events == found.protections == 0
        assert np.abs(found.stop_error).max() < 0.3
    blind = outcomes["weather turns bad"].blind
    assert blind.slip_events > 0
    assert blind.skid_energy > 0.0
    assert blind.worst[1] > 0.0


def test_the_second_day_beats_the_first_in_slip_and_is_punctual(days):
    first, second = days
    assert first.slip_events > 0
    assert second.slip_events == 0
    assert second.skid_energy == 0.0
    assert second.slip_energy < first.slip_energy
    assert second.late.min() > -1.5
    assert second.late.max() < 0.5
    assert len(second.track.trips) == 2


def test_a_section_that_the_rail_forbids_in_its_time_is_late_by_the_least(known, monkeypatch):
    """Its arrival is put off before it is solved; the second day solves such a section."""
    monkeypatch.setattr(study, "reference", lambda made: replace(known.plan[0], section=made))
    icy = StepProfile(np.zeros(1), np.array([0.04]))
    asked = known.plan[0].section.destination.arrival
    arrival = replanned(known.plan, icy)[0].section.destination.arrival
    assert arrival > asked + 5.0
    bound = least_lateness([driving.with_map(known.plan, icy)[0].section], MASS, 0.0)[0]
    assert arrival - asked > bound


def test_a_run_is_logged_with_its_levers_reference_and_truth(outcomes, tmp_path):
    found = outcomes["good track"].informed
    write_log(trip_of(found, "dry", 1), tmp_path / "trip.mcap")
    again = read_log(tmp_path / "trip.mcap")
    assert np.array_equal(again["/train/controls"]["lever"], np.round(found.lever, 4))
    np.testing.assert_array_equal(again["/truth"]["position"], found.position)
    assert np.abs(again["/reference"]["lateness"]).max() < 5.0
    assert again.metadata["weather"] == "dry"
    write_log(trip_of(found, "dry", 1), tmp_path / "twice.mcap")
    assert (tmp_path / "twice.mcap").read_bytes() == (tmp_path / "trip.mcap").read_bytes()


def test_as_published_a_late_train_takes_the_bounds_of_where_it_ought_to_be(known):
    """On time the published controller keeps eq. (7) but for a guard's share; late it does not."""
    on_time, _, late, _ = study.SCENARIOS
    good = study.outcome(known, on_time, 78_200.0, published=True)
    assert good.blind is None
    assert np.abs(good.informed.position_error).max() <= 5.0
    assert np.abs(good.informed.speed_error).max() < 3.0
    assert good.informed.worst.max() < 0.05
    other = study.outcome(known, late, 78_200.0, published=True)
    found = other.informed
    assert found.worst[0] > 0.5
    assert found.late[0] < 1.0
    table = difference_table([good, other])
    assert table.heads[-1] == "78.2 t"
