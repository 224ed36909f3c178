"""Energy and time of trips, and what a trajectory saves."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from analysis.comparison.groups import compare_groups, punctuality, trip_cost
from trainlog.errors import LogError
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.topics import EVENTS, REFERENCE, TRAIN_CONTROLS, TRAIN_SLIP_PROTECTION, TRAIN_STATE
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, frame_of


def trip(name: str = "t", effort: float = 50_000.0, stop: bool = False, **metadata: str) -> Trip:
    """Stands 10 s, runs 600 s at 20 m/s (with a stop of 20 s on demand), stands 10 s."""
    speed = np.concatenate((np.zeros(100), np.full(6000, 20.0), np.zeros(100)))
    if stop:
        speed[3000:3200] = 0.0
    time = np.arange(speed.size) * 100_000_000
    position = np.concatenate(([0.0], np.cumsum(speed[:-1]) * 0.1))
    running = speed > 0.0
    return Trip(
        {
            "/train/state": frame_of(TRAIN_STATE, time, {"speed": speed, "position": position}),
            "/train/controls": frame_of(
                TRAIN_CONTROLS,
                time,
                {
                    "tractive_effort": effort * running,
                    "dynamic_braking_effort": 10_000.0 * running,
                },
            ),
        },
        {"trip": name, "direction": "forward", "load": "10000", **metadata},
        attachments={
            LINE_ATTACHMENT: sample(DEFAULT_LINE).read_bytes(),
            TRAIN_ATTACHMENT: sample(DEFAULT_TRAIN).read_bytes(),
        },
    )


def test_work_is_effort_times_distance() -> None:
    cost = trip_cost(trip())
    assert cost.distance == pytest.approx(12_000.0)
    assert cost.traction == pytest.approx(50_000.0 * 12_000.0, rel=1e-3)
    assert cost.dynamic_braking == pytest.approx(10_000.0 * 12_000.0, rel=1e-3)
    # The FLIRT's efficiencies are 90 % both ways.
    assert cost.line == pytest.approx(cost.traction / 0.9 - 0.9 * cost.dynamic_braking)
    assert cost.mass == 132_000.0


def test_a_trip_that_never_moves_is_refused() -> None:
    still = trip()
    state = still["/train/state"].assign(speed=0.0)
    state.attrs = still["/train/state"].attrs
    with pytest.raises(LogError, match="never moves"):
        trip_cost(still.with_topic(state))


def test_savings_pair_the_same_configuration_only() -> None:
    drivers = [trip("a", 50_000.0), trip("b", 60_000.0, stop=True)]
    followed = [
        trip("driven-a", 40_000.0, configuration="a"),
        trip("driven-b", 40_000.0, configuration="b"),
        trip("driven-c", 40_000.0, configuration="c"),
    ]
    (pair,) = compare_groups(drivers, followed).pairs
    assert pair.driver.name == "a"
    assert pair.traction == pytest.approx(10_000.0 * 12_000.0, rel=1e-3)


def test_slip_protection_that_is_not_recorded_is_not_zero() -> None:
    """A flag counts where there is one, else events; without both, how often is not known."""
    silent = followed("departure from A", "arrival at B", late=0.1)
    assert trip_cost(silent).slips is None
    assert punctuality([silent, followed("slip protection active", late=0.1)]).slips is None
    mapped = replace(silent, metadata={**silent.metadata, "slip_protection": "events"})
    assert trip_cost(mapped).slips == 0
    active = [0.0, 2.0, 1.0, np.nan, 1.0, 0.0, 1.0]
    flags = frame_of(
        TRAIN_SLIP_PROTECTION, np.arange(7) * 1_000_000_000, {"active": np.array(active)}
    )
    assert trip_cost(silent.with_topic(flags)).slips == 2


def followed(*messages: str, late: float) -> Trip:
    """A trip that followed a trajectory, with events."""
    time = np.arange(len(messages)) * 1_000_000_000
    events = {
        "level": np.full(time.size, 3),
        "message": np.array(messages, dtype=object),
        "name": np.full(time.size, "drive", dtype=object),
    }
    lateness = {"lateness": np.linspace(0.0, late, 6)}
    return (
        trip()
        .with_topic(frame_of(EVENTS, time, events))
        .with_topic(frame_of(REFERENCE, np.arange(6) * 1_000_000_000, lateness))
    )


def test_nothing_comparable_is_reported() -> None:
    backwards = replace(trip("a"), metadata={**trip("a").metadata, "direction": "reverse"})
    followed = [trip("driven-a", configuration="a"), trip("driven-c", configuration="c")]
    for drivers, nearest in (
        ([], "there is no trip of the configuration that 'driven-a' drove with"),
        ([backwards], "'a' ran reverse, 'driven-a' forward"),
        ([trip("a", stop=True)], "'a' ran 11.6 km, 'driven-a' 12.0 km"),
        ([trip("a", stop=True), trip("c", stop=True)], "'a' ran 11.6 km, 'driven-a' 12.0 km"),
    ):
        words = f"comparable trip by a driver: {nearest}; needs one non-stop trip"
        with pytest.raises(LogError, match=words):
            compare_groups(drivers, followed)
    stopping = trip("driven-b", stop=True, configuration="b")
    with pytest.raises(LogError, match="driver: 'b' stopped 1x and 'driven-b' stopped 1x; needs"):
        compare_groups([backwards, trip("b", stop=True)], [*followed, stopping])


def test_a_plan_for_the_nominal_train_is_compared_by_train_and_says_so() -> None:
    drivers = [trip("a", 60_000.0, load="20000"), trip("b", stop=True)]
    found = compare_groups(drivers, [trip("driven", 40_000.0, configuration="nominal")])
    (pair,) = found.pairs
    assert (pair.driver.name, pair.trajectory.name) == ("a", "driven")
    assert found.remarks == (
        "'driven' followed a plan for the train of its file, at 132.0 t; 'a' ran at 142.0 t",
    )
    assert found.remarks[0] in found.notes[0]
    other = trip("other")
    content = other.attachments[TRAIN_ATTACHMENT].replace(b"CH_Stadler_FLIRT_TPF", b"another")
    other = replace(other, attachments={**other.attachments, TRAIN_ATTACHMENT: content})
    with pytest.raises(LogError, match="no trip of the train that 'driven' drove with"):
        compare_groups([other], [trip("driven", configuration="nominal")])


def test_a_trip_of_the_name_is_of_the_same_train_and_line() -> None:
    """Trips are called trip-01 on every line: only one of the train and the line compares."""
    driven = trip("driven-a", 40_000.0, configuration="a")
    attached = trip("a").attachments
    for attachment, name in (
        (TRAIN_ATTACHMENT, b"CH_Stadler_FLIRT_TPF"),
        (LINE_ATTACHMENT, b"CH_StGallen_Wil"),
    ):
        content = attached[attachment].replace(name, b"another")
        other = replace(trip("a"), attachments={**attached, attachment: content})
        with pytest.raises(LogError, match="no trip of the configuration that 'driven-a' drove"):
            compare_groups([other], [driven])
        assert compare_groups([other, trip("a")], [driven]).pairs[0].driver.name == "a"
    with pytest.raises(LogError, match="2 trips are called 'a', the configuration of 'driven-a'"):
        compare_groups([trip("a"), trip("a", stop=True)], [driven])


def test_trips_that_followed_nothing_are_named_with_their_file() -> None:
    path = sample("nonstop.mcap")
    words = "trip 'trip-01' did not follow a trajectory; give trips recorded by"
    with pytest.raises(LogError, match=words) as refused:
        compare_groups(path, path)
    assert refused.value.file == path
    with pytest.raises(LogError, match="'b' did not follow a trajectory, nor did 1 other;"):
        compare_groups([trip("a")], [trip("b"), trip("c")])
    with pytest.raises(LogError, match="no trip that followed a trajectory was given"):
        compare_groups([trip("a")], [])
