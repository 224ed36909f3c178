"""Running resistance from coasting: known answers, simulated trips, and what is refused."""

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from refusals import refused
from simulated_line import level_line

from analysis import coast_down, coast_down_without_gradient
from analysis.resistance.coast_down import CoastDown, lever_at_rest
from analysis.resistance.coasting_detection import motion_of
from analysis.truth import truth_of
from trainlog.arrays import FloatArray
from trainlog.errors import InputError, LogError, NotIdentifiableError
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.formats.railway import CoastDownResult, line_to_bytes, train_of
from trainlog.formats.samples import sample
from trainlog.mcap import read_log, write_log
from trainlog.railway import Line, RunningResistance, StepProfile
from trainlog.topics import ESTIMATED_STATE, GNSS_MOTION
from trainlog.trip import LINE_ATTACHMENT, Trip, frame_of, seconds

RATIO = 0.93  # mass over inertia of the train that is driven here

STEP = 0.1


def line_of_gradients(values: Sequence[float], each: float = 400.0) -> Line:
    """A line whose gradient changes every `each` metres."""
    gradients = StepProfile(each * np.arange(len(values)), list(values))
    return level_line(each * len(values), limit=45.0, name="made", gradients=gradients)


LEVEL = line_of_gradients([0.0] * 300)
PLACES = np.arange(300)
HILLY = line_of_gradients(6e-3 * np.sin(PLACES * 1.7) + 3e-3 * np.cos(PLACES * 0.61))


def coasting_down(time: FloatArray, start: float, curve: RunningResistance) -> FloatArray:
    """Speed [m/s] after coasting for `time` [s] on level track, in closed form.

    dv/dt = -(c0 + c1 v + c2 v²), for all three signs of c1² - 4 c0 c2.
    """
    c0, c1, c2 = curve.coefficients
    discriminant = c1**2 - 4.0 * c0 * c2
    slope = 2.0 * c2 * start + c1
    if abs(discriminant) < 1e-15:
        found = 1.0 / (1.0 / slope + 0.5 * time)
    elif discriminant < 0.0:
        root = np.sqrt(-discriminant)
        found = root * np.tan(np.arctan(slope / root) - 0.5 * root * time)
    else:
        root = np.sqrt(discriminant)
        ratio = (slope - root) / (slope + root) * np.exp(-root * time)
        found = root * (1.0 + ratio) / (1.0 - ratio)
    return np.asarray((found - c1) / (2.0 * c2))


def driven(line, curve, efforts, *, start=0.0, speed=10.0):
    """Time, position, speed and effort over inertia of a drive, every `STEP`; see `DRIVE`."""
    grid = line.track_acceleration(np.arange(0.0, line.length + 100.0, 1.0))
    c0, c1, c2 = curve.coefficients.tolist()
    rows = []
    v, s, t = speed, start, 0.0
    for duration, wanted in efforts:
        for _ in range(round(duration / STEP)):
            along = RATIO * float(grid[int(s)])
            resisted = along + c0 + (c1 + c2 * v) * v
            effort = resisted if np.isnan(wanted) else wanted
            rows.append((t, s, v, effort))
            middle = v + 0.5 * STEP * (effort - resisted)
            # Edges of gradients are met within a step, as they are by trains.
            ahead = RATIO * float(grid[int(s + STEP * middle)])
            force = effort - 0.5 * (along + ahead) - c0 - (c1 + c2 * middle) * middle
            if np.isnan(wanted):
                force = 0.0
            s += STEP * (v + 0.5 * STEP * force)
            v += STEP * force
            t += STEP
    time, position, reported, effort = np.array(rows).T
    return time, position, reported, effort


def recorded(time, position, speed, line=None, every=2, noise=0.05, seed=1, name="made", **about):
    """What a satellite receiver and the chainage made of it would have recorded."""
    generator = np.random.default_rng(seed)
    t, s, v = (array[::every] for array in (time, position, speed))
    stamps = np.int64(1_700_000_000_000_000_000) + np.round(t * 1e9).astype(np.int64)
    measured = np.abs(v + noise * generator.standard_normal(v.size))
    known = {GNSS_MOTION: {"speed": measured}, ESTIMATED_STATE: {"position": s}}
    return Trip(
        {topic.name: frame_of(topic, stamps, columns) for topic, columns in known.items()},
        {"trip": name, "direction": "forward", **about},
        attachments={} if line is None else {LINE_ATTACHMENT: line_to_bytes(line)},
    )


CURVE = RunningResistance(0.014, 4e-4, 6e-5)

DRIVE = [
    *((60.0, 0.5), (70.0, 0.0), (40.0, 0.35), (20.0, np.nan), (80.0, 0.0), (25.0, -0.2)),
    *((60.0, 0.45), (30.0, 0.07), (90.0, 0.0), (20.0, 0.3), (40.0, np.nan), (60.0, 0.0)),
]  # durations [s] and efforts over inertia [m/s²]; NaN holds the speed


def inside(found: CoastDown, curve: RunningResistance) -> bool:
    speed = np.linspace(*found.curve.supported, 31)
    low, high = found.curve.band(speed)
    return bool(np.all((low <= curve(speed)) & (curve(speed) <= high)))


def error(found: CoastDown, curve: RunningResistance) -> float:
    speed = np.linspace(*found.curve.supported, 31)
    return float(np.sqrt(np.mean((found.curve(speed) / curve(speed) - 1.0) ** 2)))


@pytest.mark.parametrize(
    "curve",
    [
        RunningResistance(0.012, 1e-4, 2.5e-5),
        RunningResistance(0.012, 1.5e-3, 2.0e-5),
        RunningResistance(0.012, 1.2e-3, 3.0e-5),
    ],
    ids=["negative discriminant", "positive discriminant", "no discriminant"],
)
def test_closed_form_of_coasting_down_is_found_again(curve):
    time = np.arange(0.0, 250.0, 0.1)
    down = coasting_down(time, 40.0, curve)
    up = np.linspace(down[-1], 40.0, 600)
    speed = np.concatenate((up, down, up, down))
    at = 0.1 * np.arange(speed.size)
    position = np.concatenate(([0.0], np.cumsum(0.05 * (speed[1:] + speed[:-1]))))
    found = coast_down([recorded(at, position, speed, line=LEVEL, every=1, noise=0.02)])
    assert error(found, curve) < 0.01
    assert inside(found, curve)
    z = (found.curve.theta[1:] - curve.coefficients) / np.sqrt(np.diag(found.curve.covariance)[1:])
    assert np.all(np.abs(z) < 4.0)
    # On level track the rotating mass makes no difference and cannot be identified.
    assert found.ratio.source == "any train"
    assert found.ratio.std == pytest.approx(0.02, rel=0.01)


def test_gradients_that_vary_tell_the_rotating_mass():
    time, position, speed, _ = driven(HILLY, CURVE, DRIVE)
    found = coast_down([recorded(time, position, speed, line=HILLY, every=1, noise=0.02)])
    assert found.ratio.source == "data"
    assert abs(found.ratio.value - RATIO) < 3.0 * found.ratio.std < 0.03
    weight, std = found.curve.per_weight(25.0)
    assert abs(weight - CURVE(25.0) / RATIO / 9.81) < 4.0 * std


@pytest.mark.parametrize("efforts", [(0.05, 0.09), (0.03, -0.04), (np.nan, np.nan)])
def test_a_train_that_never_coasts_is_refused(efforts):
    drive = [(50.0, 0.5), (60.0, efforts[0]), (30.0, -0.3), (40.0, 0.4), (90.0, efforts[1])]
    time, position, speed, _ = driven(HILLY, CURVE, [*drive, (30.0, -0.2)], speed=12.0)
    with pytest.raises(NotIdentifiableError, match="coasting"):
        coast_down([recorded(time, position, speed, line=HILLY)])


def test_what_is_missing_is_named():
    time, position, speed, _ = driven(HILLY, CURVE, DRIVE)
    trip = recorded(time, position, speed, line=HILLY)
    fixes = replace(trip, topics={"/estimates/state": trip["/estimates/state"]})
    refused(NotIdentifiableError, "no speed was recorded", coast_down, [fixes])
    unplaced = replace(trip, topics={"/gnss/motion": trip["/gnss/motion"]})
    refused(NotIdentifiableError, r"where on the line .* ingest", coast_down, [unplaced])
    refused(LogError, r"has no line\.json", coast_down, [replace(trip, attachments={})])
    rare = recorded(time, position, speed, line=HILLY, every=50)
    refused(NotIdentifiableError, r"a speed every 5\.0 s only", coast_down, [rare])
    words = "asked for 18 to 216 km/h"
    refused(NotIdentifiableError, words, coast_down, [trip], speeds=(5.0, 60.0))
    twice = coast_down([trip, trip])
    assert "'made (2)' is the same drive as 'made', which is used" in twice.refused["made (2)"]
    np.testing.assert_array_equal(twice.curve.covariance, coast_down([trip]).curve.covariance)
    unlike = [replace(trip, metadata={"trip": name, "train": name}) for name in "ab"]
    refused(InputError, "different trains: a, b", coast_down, unlike)
    back = frame_of(GNSS_MOTION, [2, 3, 3, 4], {"speed": [1.0, 2.0, 3.0, 4.0]})
    refused(LogError, "time does not increase", coast_down, [trip.with_topic(back)])
    refused(NotIdentifiableError, "no trip was given", coast_down, [])


def test_several_trips_are_sharper_than_one_and_come_in_any_order():
    trips = []
    for number in range(3):
        time, position, speed, _ = driven(HILLY, CURVE, DRIVE, start=5_000.0 * number)
        named = {"seed": number, "name": f"trip-{number}"}
        trips.append(recorded(time, position, speed, line=HILLY, **named))
    together = coast_down(trips)
    assert np.array_equal(together.curve.theta, coast_down(trips[::-1]).curve.theta)
    assert inside(together, CURVE)
    assert error(together, CURVE) < 0.02


@cache
def sample_trip(name: str) -> Trip:
    return read_log(sample(name))


def satellites_only(trip: Trip) -> Trip:
    """Without what the train itself recorded but its chainage."""
    state = trip["/train/state"].assign(speed=np.nan)
    kept = {"/gnss/motion": trip["/gnss/motion"], "/train/state": state}
    return replace(trip, topics=kept)


@pytest.mark.parametrize("satellites", [False, True], ids=["wheels", "satellites"])
def test_a_simulated_trip_gives_its_true_curve(satellites):
    trip = sample_trip("nonstop.mcap")
    shown = satellites_only(trip) if satellites else trip
    found, truth = coast_down([shown]), truth_of(trip)
    true = truth.resistance.scaled(1.0 / (truth.mass + train_of(trip).rotating_mass))
    assert error(found, true) < 0.05
    assert inside(found, true)
    # It has used what truly was coasting.
    controls = trip["/train/controls"]
    time = seconds(controls, motion_of(shown).start)
    names = ["tractive_effort", "dynamic_braking_effort", "pneumatic_braking_effort"]
    coasting = np.all(controls[names].to_numpy() < 1.0, axis=1)
    marked = np.zeros(time.size, dtype=bool)
    for segment in found.trips[0].segments:
        marked |= (time >= segment.start) & (time <= segment.end)
    assert np.mean(coasting[marked]) > 0.9
    assert satellites or marked.sum() > 0.8 * np.count_nonzero(
        coasting & (trip["/truth"]["speed"] > 5.0)
    )


def test_speeds_that_begin_late_have_the_scale_of_all():
    trip = sample_trip("stopping.mcap")
    state = trip["/train/state"].copy()
    state.iloc[:300, state.columns.get_loc("speed")] = np.nan
    late, whole = motion_of(trip.with_topic(state)), motion_of(trip)
    assert (late.source, late.scale.source) == ("/train/state", "GNSS speed")
    assert late.scale.factor == pytest.approx(whole.scale.factor, abs=1e-5)
    assert late.scale.std == pytest.approx(whole.scale.std, rel=0.01)


def test_logs_give_a_file_that_says_what_it_was_made_from(tmp_path):
    log = tmp_path / "a.mcap"
    write_log(satellites_only(sample_trip("nonstop.mcap")), log)
    found = coast_down([log])
    data = thing_to_bytes(found.result)
    assert thing_to_bytes(thing_from_bytes(CoastDownResult, data)) == data
    assert thing_to_bytes(coast_down(log).result) == data
    result = found.result
    assert result["c0"].value == found.curve.theta[1]
    assert result["mass_ratio"].reason in (None, "expected: train file")
    assert len(result.provenance["inputs"]["trip-01"]) == 64
    assert result.trips[0]["segments"]
    with pytest.raises(KeyError):
        result["r0"]
    longer = data.replace(b'"covariance": [\n    [', b'"covariance": [\n    [0, ')
    said = "covariance: rows differ in length"
    refused(InputError, said, thing_from_bytes, CoastDownResult, longer)


@cache
def coasting_over(count, *, both):
    """Trips that coast over the same track from different speeds, and when."""
    trips, spans = [], {}
    back = HILLY.reversed()
    for number in range(count):
        turned = both and number % 2 == 1
        line, start = (back, HILLY.length - 47_000.0) if turned else (HILLY, 40_000.0)
        speed = (38.0, 33.0, 28.0, 24.0)[(number // 2 if both else number) % 4]
        begun = {"start": start + 90.0 * number, "speed": speed}
        time, position, stated, _ = driven(line, CURVE, [(200.0, 0.0)], **begun)
        way = "reverse" if turned else "forward"
        trip = recorded(time, position, stated, seed=number, name=f"trip-{number}", direction=way)
        trips.append(trip)
        spans[trip.name] = [(0.0, float(time[-1]))]
    return trips, spans


def test_one_way_over_unknown_gradients_tells_how_resistance_grows_and_no_more():
    trips, spans = coasting_over(4, both=False)
    result = coast_down_without_gradient(trips, spans=spans)
    assert result["c0"].value is None
    assert "merged with the gradient" in result["c0"].reason
    assert result.curve is None
    change = np.array([33.0 - 20.0, 33.0**2 - 20.0**2])
    stated = change @ [result["c1"].value, result["c2"].value]
    std = np.sqrt(change @ result.covariance @ change)
    true = change @ CURVE.coefficients[1:]
    assert abs(stated - true) < 3.0 * std < 0.3 * true
    sums = np.array([piece["deceleration"] for piece in result.pieces])
    stds = np.array([piece["std"] for piece in result.pieces])
    ends = np.array([piece["position"] for piece in result.pieces])
    true_sums = CURVE.r0 + RATIO * 9.81 * HILLY.gradients.mean(ends[:, 0], ends[:, 1])
    assert np.all(np.abs(sums - true_sums) < 4.0 * stds)
    assert thing_from_bytes(CoastDownResult, thing_to_bytes(result))["c0"] == result["c0"]


def test_both_ways_over_unknown_gradients_tell_all_of_it():
    trips, spans = coasting_over(8, both=True)
    result = coast_down_without_gradient(trips, HILLY, spans)
    true = CURVE(result.curve.speeds)
    assert np.all((result.curve.low < true) & (true < result.curve.high))
    assert np.max(np.abs(result.curve.deceleration / true - 1.0)) < 0.05
    assert {piece["quantity"] for piece in result.pieces} == {"gradient"}
    with pytest.raises(NotIdentifiableError, match="over a piece coasted more than once"):
        # Without the line's length the way back cannot be laid over the way there.
        coast_down_without_gradient([trips[0], trips[1]], spans=spans)


def test_unknown_gradients_are_not_guessed():
    trips, spans = coasting_over(1, both=False)
    words, error = "0 of them over a piece coasted more than once", NotIdentifiableError
    refused(error, words, coast_down_without_gradient, trips, spans=spans)
    words = r"no trip shows .* no lever was recorded"
    refused(error, words, coast_down_without_gradient, trips)
    refused(error, "no lever was recorded", lever_at_rest, trips[0], motion_of(trips[0]))
