"""Drawn trips: what varies, what stays, what is recorded; and the same again for the same seed."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from foreign_recorders import write_recorder_csv, write_ublox_csv
from refusals import refused
from simulated_line import flirt, hilly_line

from trainlog.errors import InputError
from trainlog.mcap import write_log
from trainlog.simulation import Scenario, draw_scenarios, simulate
from trainlog.simulation.rail import base_map
from trainlog.trip import Trip


@cache
def drawn() -> tuple[Scenario, ...]:
    return tuple(draw_scenarios(hilly_line(), flirt(), count=12, seed=1))


@cache
def trips() -> tuple[Trip, ...]:
    return tuple(simulate(scenario) for scenario in drawn()[:4])


def test_scenarios_vary_as_they_should() -> None:
    scenarios = drawn()
    assert [s.direction for s in scenarios] == ["forward", "reverse"] * 6
    assert sum(s.weather == "wet" for s in scenarios) == 6
    assert len({(s.direction, s.weather) for s in scenarios}) == 4
    loads = np.array([s.load for s in scenarios])
    assert np.all((loads >= 0.0) & (loads <= 20_000.0))
    assert np.ptp(loads) > 8_000.0
    nominal = flirt().resistance
    for name in ("r0", "r1", "r2"):
        factor = np.array([getattr(s.resistance, name) for s in scenarios]) / getattr(nominal, name)
        assert 0.03 < np.std(factor) < 0.12
        assert np.all(np.abs(factor - 1.0) <= 0.15 + 1e-12)
    assert len({len(s.stops) for s in scenarios}) > 1
    assert len({s.seed for s in scenarios}) == 12
    assert len({s.start for s in scenarios}) == 12


def test_slippery_places_stay_from_trip_to_trip() -> None:
    line = hilly_line()
    line_bins = np.arange(440) * 25.0
    for weather, base, low in (("dry", 0.325, 0.16), ("wet", 0.185, 0.13)):
        layer = base_map(line, weather, 1)
        assert np.median(layer) == pytest.approx(base, rel=0.1)
        spots = layer < low
        assert 0.02 < np.mean(spots) < 0.4
        assert np.all(layer > 0.05)
        for scenario in (s for s in drawn() if s.weather == weather):
            met = scenario.maximum_adhesion(line_bins)
            assert np.std(np.log(met / layer)) < 0.25
            assert np.mean(met[spots] < 1.2 * low) > 0.95
    assert not np.array_equal(base_map(line, "wet", 1), base_map(line, "wet", 2))


def test_the_same_seed_makes_the_same_bytes(tmp_path: Path) -> None:
    for attempt in ("one", "two"):
        scenario = draw_scenarios(hilly_line(), flirt(), count=3, seed=7)[2]
        trip = simulate(scenario)
        write_log(trip, tmp_path / f"{attempt}.mcap")
        write_recorder_csv(trip, tmp_path / f"{attempt}.csv")
        write_ublox_csv(trip, tmp_path / f"{attempt}.ublox.csv")
    for name in ("{}.mcap", "{}.csv", "{}.ublox.csv"):
        one, two = ((tmp_path / name.format(k)).read_bytes() for k in ("one", "two"))
        assert one == two
    other = simulate(draw_scenarios(hilly_line(), flirt(), count=3, seed=8)[2])
    assert not other["/truth"].equals(trip["/truth"])


def test_the_log_states_the_load_as_it_was_weighed() -> None:
    errors = []
    for scenario, trip in zip(drawn(), trips(), strict=False):
        std = float(trip.metadata["load_std"])
        assert std == pytest.approx(0.025 * (scenario.train.max_load or 20e3), abs=0.5)
        errors.append((float(trip.metadata["load"]) - scenario.load) / std)
    assert min(map(abs, errors)) > 0.0
    assert max(map(abs, errors)) < 4.0


def test_truth_is_attached() -> None:
    for scenario, trip in zip(drawn(), trips(), strict=False):
        truth = json.loads(trip.attachments["scenario.json"])
        assert truth["mass"] == scenario.mass
        assert (truth["r0"], truth["r1"], truth["r2"]) == (
            scenario.resistance.r0,
            scenario.resistance.r1,
            scenario.resistance.r2,
        )
        frame = trip["/truth"]
        profile = truth["maximum_adhesion"]
        position = frame.position
        if scenario.direction == "reverse":
            position = scenario.line.length - position
        bins = np.searchsorted(profile["positions"], position, side="right") - 1
        # Bin edges belong to the bin ahead of the train.
        same = np.array(profile["values"])[bins] == frame.maximum_adhesion
        assert np.mean(same) > 0.999
        expected = scenario.resistance(frame.speed)
        np.testing.assert_allclose(
            frame.running_resistance, np.where(frame.speed > 0.0, expected, 0.0)
        )


def test_sensors_see_the_truth_within_their_errors() -> None:
    for trip in trips():
        state, truth, axles = trip["/train/state"], trip["/truth"], trip["/train/axles"]
        cruising = (truth.speed > 15.0).to_numpy()
        ratio = (state.speed / truth.speed)[cruising]
        scale = np.mean(ratio)
        assert abs(scale - 1.0) < 0.012
        noise = (state.speed - scale * truth.speed)[cruising]
        assert np.std(noise) == pytest.approx(0.0301, rel=0.1)
        assert np.max(np.abs(state.position - truth.position)) < 15.0
        rolling = cruising & (trip["/train/controls"].tractive_effort == 0.0)
        rolling &= trip["/train/controls"].dynamic_braking_effort == 0.0
        slip = axles.wheel_speed_1[rolling] - state.speed[rolling]
        assert abs(np.median(slip)) < 0.2


def test_events_tell_what_happened() -> None:
    for scenario, trip in zip(drawn(), trips(), strict=False):
        events = trip["/events"]
        written = [m for m in events.message if m.startswith(("departure", "arrival"))]
        names = [stop.station for stop in scenario.stops]
        expected = [f"departure from {names[0]}"]
        for name in names[1:-1]:
            expected += [f"arrival at {name}", f"departure from {name}"]
        expected.append(f"arrival at {names[-1]}")
        assert written == expected
        truth, axles = trip["/truth"], trip["/train/axles"]
        for when in events.index[events.message.str.contains("slip protection")]:
            speeds = axles.loc[when, [f"wheel_speed_{k}" for k in range(1, 5)]]
            around = truth.speed.loc[when]
            assert np.abs(speeds - around).max() > 1.0


def test_bad_wishes_are_refused() -> None:
    refused(InputError, "cannot draw 0", draw_scenarios, hilly_line(), flirt(), count=0)
    with pytest.raises(InputError, match="fewer than two stations"):
        draw_scenarios(replace(hilly_line(), stations=()), flirt())
    refused(InputError, "direction 'up' is unknown", replace, drawn()[0], direction="up")
