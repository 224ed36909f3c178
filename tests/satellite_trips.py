"""Trips of a satellite receiver along any curve of the plane, with the truth beside them."""

from dataclasses import dataclass

import numpy as np
import pandas as pd
from scipy.signal import lfilter

from trainlog import Geometry, Trip, frame_of
from trainlog.railway.geometry import from_plane
from trainlog.topics import GNSS_FIX, GNSS_MOTION, TRAIN_STATE

ORIGIN = (47.0, 9.0)
START = pd.Timestamp("2024-05-01T06:00:00Z").value


def curve_of(curvature: np.ndarray, step: float = 5.0, heading: float = 0.3) -> Geometry:
    """The geometry of a track whose curvature [1/m], to the left, is given every `step` [m]."""
    turned = heading + np.concatenate(([0.0], np.cumsum(curvature * step)))
    middle = 0.5 * (turned[1:] + turned[:-1])
    points = np.concatenate(([0.0], np.cumsum(step * np.exp(1j * middle))))
    latitude, longitude = from_plane(points, ORIGIN)
    return Geometry(step * np.arange(points.size), latitude, longitude, "made up")


def winding(length: float = 12_000.0) -> Geometry:
    """Bends of 400 m and straights."""
    s = np.arange(0.0, length, 5.0)
    return curve_of(np.clip(3.0 * np.sin(s / 450.0), -1.0, 1.0) / 400.0)


@dataclass(frozen=True)
class Receiver:
    """How a receiver errs."""

    rate: float = 1.0
    noise: float = 3.0
    lasting: bool = False
    speed_noise: float = 0.2
    outages: tuple[tuple[float, float], ...] = ()
    bursts: tuple[tuple[float, float, complex], ...] = ()
    wheels: bool = False


def motion(length: float, top: float = 25.0) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], position [m] and speed [m/s] of a run with a stop of 40 s in the middle."""
    half = np.linspace(0.0, length / 2.0, 4_000)
    pace = np.sqrt(np.minimum(2.0 * 0.5 * half, 2.0 * 0.6 * (half[-1] - half)))
    pace = np.maximum(np.minimum(pace, top), 0.15)
    took = np.concatenate(([0.0], np.cumsum(np.diff(half) * 2.0 / (pace[1:] + pace[:-1]))))
    time = np.concatenate(([0.0], 20.0 + took, 60.0 + took[-1] + took, [80.0 + 2.0 * took[-1]]))
    way = np.concatenate(([0.0], half, length / 2.0 + half, [length]))
    even = np.arange(0.0, time[-1], 0.1)
    position = np.interp(even, time, way)
    return even, position, np.gradient(position, even)


def drive(geometry, receiver, seed=1, *, reverse=False):
    """A trip over the whole geometry, or from its end; its true position [m] and speed [m/s]."""
    generator = np.random.default_rng(seed)
    length = float(geometry.positions[-1])
    way = geometry.reversed(length) if reverse else geometry
    time, position, speed = motion(length, top=20.0 + seed % 4 * 3.0)
    every = round(10.0 / receiver.rate)
    t, s, v = time[::every], position[::every], speed[::every]
    error = generator.standard_normal(t.size) + 1j * generator.standard_normal(t.size)
    if receiver.lasting:
        keep = np.exp(-1.0 / receiver.rate / 30.0)
        error[1:] *= np.sqrt(1.0 - keep**2)
        error = lfilter([1.0], [1.0, -keep], error)
    error = receiver.noise * error
    for begin, end, size in receiver.bursts:
        error[(t >= begin) & (t < end)] += size
    latitude, longitude = way.at(s)
    metre = np.degrees(1.0 / 6_371_000.0)
    seen = np.ones(t.size, dtype=bool)
    for begin, end in receiver.outages:
        seen &= (t < begin) | (t >= end)
    stamps = START + (t[seen] * 1e9).astype(np.int64)
    ones = np.ones(stamps.size)
    east = error.real * metre / np.cos(np.radians(latitude))
    fix = {
        "latitude": (latitude + error.imag * metre)[seen], "longitude": (longitude + east)[seen],
        "horizontal_accuracy": receiver.noise * ones,
    }  # fmt: skip
    noisy = np.abs(v + receiver.speed_noise * generator.standard_normal(t.size))[seen]
    doppler = {"speed": noisy, "speed_accuracy": receiver.speed_noise * ones}
    topics = {
        "/gnss/fix": frame_of(GNSS_FIX, stamps, fix),
        "/gnss/motion": frame_of(GNSS_MOTION, stamps, doppler),
    }
    index = pd.DatetimeIndex(START + (time * 1e9).astype(np.int64), tz="UTC")
    if receiver.wheels:
        stated = np.maximum(1.008 * speed + 0.05 * generator.standard_normal(time.size), 0.0)
        stated = np.where(speed > 0.0, stated, 0.0)
        topics["/train/state"] = frame_of(TRAIN_STATE, index, {"speed": stated})
    name = f"trip-{seed:02d}"
    truth = pd.DataFrame({"position": position, "speed": speed}, index=index)
    return Trip(topics, {"trip": name}), truth


def errors(estimate: pd.DataFrame, truth: pd.DataFrame, name: str) -> tuple[np.ndarray, np.ndarray]:
    """Errors of an estimate every second, and its standard deviations."""
    index = estimate.index.as_unit("ns").asi8
    even = np.arange(index[0], index[-1], 1_000_000_000)
    at = (even - index[0]) / 1e9
    own = (index - index[0]) / 1e9
    stated = [np.interp(at, own, estimate[column]) for column in (name, f"{name}_std")]
    known = (truth.index.as_unit("ns").asi8 - index[0]) / 1e9
    return stated[0] - np.interp(at, known, truth[name]), stated[1]


def valley() -> Geometry:
    """Up a valley's side: winding, a hairpin with tracks 40 m apart, and a loop over itself."""
    s = np.arange(0.0, 26_000.0, 5.0)
    curvature = np.clip(3.0 * np.sin(s / 700.0), -1.0, 1.0) / 450.0
    first, second = 8_000.0, 16_000.0
    turn = np.pi * 180.0
    curvature[(s > first - 2_500.0) & (s < first + 2_500.0 + turn)] = 0.0
    # Out a little, round, and back in: the tracks lie 40 m apart after the hairpin.
    part = 180.0 * np.arccos(1.0 - (180.0 - 20.0) / 360.0)
    edges = first + np.cumsum([0.0, part, 2.0 * part + turn, part])
    curvature[(s >= edges[0]) & (s < edges[1])] = -1.0 / 180.0
    curvature[(s >= edges[1]) & (s < edges[2])] = 1.0 / 180.0
    curvature[(s >= edges[2]) & (s < edges[3])] = -1.0 / 180.0
    curvature[(s > second) & (s < second + 2.0 * np.pi * 260.0)] = 1.0 / 260.0
    return curve_of(curvature)


def streets() -> Geometry:
    """A tram's way: straight streets, corners of 30 m radius, twice round the same block."""
    pieces = [(600.0, 1), (250.0, 1), (600.0, -1), (900.0, -1), (400.0, 1)]
    block = [(300.0, 1), (200.0, 1), (300.0, 1), (200.0, 1)]
    curvature: list[float] = []
    for straight, sense in [*pieces, *block, *block, *pieces, *pieces]:
        curvature += [0.0] * int(straight / 5.0)
        curvature += [sense * np.pi / 2.0 / 45.0] * 9
    curvature += [0.0] * 200
    return curve_of(np.array(curvature))


@dataclass(frozen=True)
class Pace:
    """How a train is driven: top speed [m/s], acceleration and braking [m/s²], stops."""

    top: float
    accelerating: float
    braking: float
    between_stops: float
    dwell: float


PACES = {
    "regional": Pace(38.0, 0.7, 0.8, 4_500.0, 40.0),
    "freight": Pace(23.0, 0.12, 0.25, 12_000.0, 150.0),
    "tram": Pace(14.0, 1.1, 1.2, 600.0, 20.0),
}


def paced(length: float, pace: Pace, seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time [s], position [m] and speed [m/s] ten times a second; stops, limits, checks at signals.

    The driver changes between power, coasting and brake as the speed allowed changes, and stands
    for a drawn time; nothing of it is a random process that a smoother models.
    """
    generator = np.random.default_rng(seed)
    s = np.arange(0.0, length + 1.0, 1.0)
    allowed = np.full(s.size, pace.top)
    at = 0.0
    while at < length:
        stretch = generator.uniform(300.0, 3_000.0)
        inside = (s >= at) & (s < at + stretch)
        allowed[inside] *= generator.choice([1.0, 1.0, 0.8, 0.6, 0.4])
        at += stretch
    stops = []
    at = pace.between_stops * generator.uniform(0.5, 1.5)
    while at < length - 300.0:
        stops.append(int(at))
        at += pace.between_stops * generator.uniform(0.5, 1.5)
    stops.append(s.size - 1)
    allowed[[0, *stops]] = 0.0
    square = allowed**2
    forward, backward = square.copy(), square.copy()
    for k in range(1, s.size):
        forward[k] = min(forward[k], forward[k - 1] + 2.0 * pace.accelerating)
        backward[-k - 1] = min(backward[-k - 1], backward[-k] + 2.0 * pace.braking)
    speed = np.sqrt(np.minimum(forward, backward))
    took = 2.0 / np.maximum(speed[1:] + speed[:-1], 0.5)
    clock = 25.0 + np.concatenate(([0.0], np.cumsum(took)))
    for stop in stops[:-1]:
        clock[stop + 1 :] += pace.dwell * generator.uniform(0.6, 2.0)
    # A dwell is a step between two points of the way, 1 m apart: it is crept over at its end.
    knots, way = [0.0], [0.0]
    for begin, end in zip([0, *stops[:-1]], stops, strict=True):
        first = clock[begin] if begin == 0 else clock[begin + 1] - took[begin]
        knots += [first, *clock[begin + 1 : end + 1]]
        way += [s[begin], *s[begin + 1 : end + 1]]
    knots.append(knots[-1] + 30.0)
    way.append(way[-1])
    even = np.arange(0.0, knots[-1], 0.1)
    position = np.interp(even, knots, way)
    window = np.hanning(21) / np.hanning(21).sum()
    smooth = np.convolve(np.pad(position, 10, mode="edge"), window, mode="valid")
    smooth = np.maximum.accumulate(smooth)
    return even, smooth, np.gradient(smooth, even)


@dataclass(frozen=True)
class Field:
    """A receiver as met in the field; rates are times an hour."""

    interval: float = 1.0  # between fixes [s]
    noise: float = 4.0  # of each axis [m], with tails of Student's t of 3 degrees of freedom
    memory: float = 20.0  # how long an error lasts [s]
    reflections: float = 6.0  # all fixes are shifted by 10 to 60 m, for 8 to 60 s
    outages: float = 3.0  # nothing is received, for 20 to 240 s
    extrapolated: float = 0.0  # the receiver goes straight on at its last speed, for 20 to 90 s
    stated: float = 1.0  # accuracy stated over the true one; 0 states 5 m always
    speed: str = "good"  # or "none" or a kind of `shown_speed`
    speed_stated: float = 1.0  # speed accuracy stated over 0.2 m/s; 0 states none
    places: str = "measured"  # or a kind of `misplaced`


def misplaced(kind, t, generator):
    """How old each position is [s], how far aside [m], its accuracy over the usual, and if shown.

    "held": one position for 5 to 60 s, eight times an hour. "replayed": after an outage of 20 to
    60 s, five times an hour, the positions of the outage, up to four times as fast as they were
    measured, or as late as the outage was long for one to five minutes, and then at once no more.
    "late": by 1 to 8 s, which changes within minutes. "jumping": 50 to 500 m aside, in any
    direction, for 5 to 60 s, six times an hour. "cold start": for the first 1 to 4 minutes hundreds
    of metres off, and stated so.
    """
    age, aside = np.zeros(t.size), np.zeros(t.size, dtype=np.complex128)
    accuracy, shown = np.ones(t.size), np.ones(t.size, dtype=bool)
    if kind == "held":
        for begin, end in spans(8.0, 5.0, 60.0, t[-1], generator):
            inside = (t >= begin) & (t < end)
            age[inside] = t[inside] - begin
    elif kind == "replayed":
        for begin, end in spans(5.0, 20.0, 60.0, t[-1], generator):
            shown &= (t < begin) | (t >= end)
            since, lost = t - end, end - begin
            if generator.uniform() < 0.5:
                old = lost - (generator.uniform(1.2, 4.0) - 1.0) * since
            else:
                old = np.where(since < generator.uniform(60.0, 300.0), lost, 0.0)
            age = np.maximum(age, np.where(since >= 0.0, np.maximum(old, 0.0), 0.0))
    elif kind == "late":
        age += 4.5 + 3.5 * np.sin(t / generator.uniform(40.0, 120.0) + generator.uniform(0.0, 6.0))
    elif kind == "jumping":
        for begin, end in spans(6.0, 5.0, 60.0, t[-1], generator):
            size = generator.uniform(50.0, 500.0) * np.exp(2j * np.pi * generator.uniform())
            aside[(t >= begin) & (t < end)] += size
    elif kind == "cold start":
        lasts = generator.uniform(60.0, 240.0)
        left = np.clip(1.0 - t / lasts, 0.0, 1.0)
        size = generator.uniform(200.0, 1_000.0) * np.exp(2j * np.pi * generator.uniform())
        aside += size * left
        accuracy += generator.uniform(50.0, 300.0) * left
    elif kind != "measured":
        raise ValueError(kind)
    return age, aside, accuracy, shown


def heavy(count: int, interval: float, memory: float, generator: np.random.Generator) -> np.ndarray:
    """Errors of unit size with heavy tails that last: two lags in series behind Student's t."""
    drawn = generator.standard_t(3.0, count + 2_000)
    keep = np.exp(-interval / max(memory / 2.0, 1e-3))
    for _ in range(2):
        drawn = lfilter([1.0 - keep], [1.0, -keep], drawn)
    drawn = drawn[2_000:]
    response = np.convolve(*[(1 - keep) * keep ** np.arange(3000)] * 2)
    return drawn / np.sqrt(3.0 * np.sum(response**2))


def spans(rate, shortest, longest, end, generator):
    """Times drawn at a rate an hour, each of a drawn length [s]."""
    count = generator.poisson(rate * end / 3_600.0) if rate else 0
    begins = generator.uniform(40.0, end - 60.0, count)
    return [(b, b + generator.uniform(shortest, longest)) for b in np.sort(begins)]


def shown_speed(kind, t, time, speed, generator):
    """What a receiver gives for the speed."""
    step = t[1] - t[0]
    true = np.interp(t, time, speed)
    white = 0.1 * generator.standard_normal(t.size)
    if kind == "good":
        return np.abs(true + 2.0 * white)
    if kind == "lasting":
        return np.abs(true + white + 0.5 * heavy(t.size, step, 15.0, generator))
    if kind == "late":
        return np.abs(np.interp(t - 3.0, time, speed) + white)
    if kind == "replayed":
        # A phone: filtered by 2 s, renewed when it likes to, 1 to 6 s old.
        keep = np.exp(-step / 2.0)
        filtered = lfilter([1.0 - keep], [1.0, -keep], true)
        renewed = np.cumsum(generator.uniform(1.0, 6.0, int(t[-1]) + 2))
        last = np.maximum(np.searchsorted(renewed, t, side="right") - 1, 0)
        at = np.interp(renewed[last], t, filtered)
        held_noise = generator.standard_normal(renewed.size)[last]
        return np.abs(np.where(t < renewed[0], 0.0, at) + 0.3 * held_noise)
    if kind == "frozen":
        seen = np.abs(true + white)
        for begin, end in spans(5.0, 40.0, 300.0, t[-1], generator):
            inside = np.flatnonzero((t >= begin) & (t < end))
            if inside.size:
                seen[inside] = seen[inside[0]]
        return seen
    if kind == "wild":
        # Runs of values that have nothing to do with the train, each near the one before.
        seen = np.abs(true + white)
        for begin, end in spans(20.0, 3.0, 60.0, t[-1], generator):
            inside = (t >= begin) & (t < end)
            walk = np.cumsum(generator.standard_normal(inside.sum())) * 1.5 * np.sqrt(step)
            seen[inside] = np.abs(generator.uniform(0.0, 45.0) + walk)
        return seen
    if kind == "wrong unit":
        return np.abs(true + white) / 0.5144
    raise ValueError(kind)


def receive(geometry, run, field, seed):
    """A trip as a receiver of the field records it, and its truth."""
    generator = np.random.default_rng(seed)
    time, position, speed = run
    t = np.arange(generator.uniform(0.0, field.interval), time[-1], field.interval)
    age, aside, worse, shown_at_all = misplaced(field.places, t, generator)
    s = np.interp(t - age, time, position)
    error = field.noise * (
        heavy(t.size, field.interval, field.memory, generator)
        + 1j * heavy(t.size, field.interval, field.memory, generator)
    )
    error += 0.5 * (generator.standard_normal(t.size) + 1j * generator.standard_normal(t.size))
    for begin, end in spans(field.reflections, 8.0, 60.0, t[-1], generator):
        size = generator.uniform(10.0, 60.0) * np.exp(2j * np.pi * generator.uniform())
        error[(t >= begin) & (t < end)] += size
    held = age > 0.0
    if field.places == "held":
        # The same position to its last digit.
        first = np.searchsorted(t, t - age)
        error[held] = error[np.minimum(first, t.size - 1)][held]
    error += aside
    latitude, longitude = geometry.at(s)
    metre = np.degrees(1.0 / 6_371_000.0)
    shrink = np.cos(np.radians(latitude))
    latitude = latitude + error.imag * metre
    longitude = longitude + error.real * metre / shrink
    seen = shown_at_all
    for begin, end in spans(field.outages, 20.0, 240.0, t[-1], generator):
        seen &= (t < begin) | (t >= end)
    shown = None
    if field.speed != "none":
        shown = shown_speed(field.speed, t, time, speed, generator)
    for begin, end in spans(field.extrapolated, 20.0, 90.0, t[-1], generator):
        inside = np.flatnonzero((t >= begin) & (t < end))
        if inside.size < 2 or inside[0] < 1:
            continue
        before = max(inside[0] - max(round(3.0 / field.interval), 1), 0)
        last = inside[0]
        span = t[last] - t[before]
        ahead = np.array(geometry.at(s[[before, last]]))
        for axis, (first, second) in zip((latitude, longitude), ahead, strict=True):
            axis[inside] = axis[last] + (second - first) / span * (t[inside] - t[last])
        if shown is not None:
            shown[inside] = shown[last]
    stamps = START + (t[seen] * 1e9).astype(np.int64)
    size = np.hypot(field.noise, 0.5)
    lasting = heavy(t.size, field.interval, 30.0, generator)
    stated = worse * size * field.stated * np.exp(0.3 * lasting)
    fix = {"latitude": latitude[seen], "longitude": longitude[seen]}
    fix["horizontal_accuracy"] = stated[seen] if field.stated else np.full(seen.sum(), 5.0)
    topics = {"/gnss/fix": frame_of(GNSS_FIX, stamps, fix)}
    if shown is not None:
        columns = {"speed": shown[seen]}
        if field.speed_stated:
            columns["speed_accuracy"] = np.full(seen.sum(), 0.2 * field.speed_stated)
        topics["/gnss/motion"] = frame_of(GNSS_MOTION, stamps, columns)
    index = pd.DatetimeIndex(START + (time * 1e9).astype(np.int64), tz="UTC")
    truth = pd.DataFrame({"position": position, "speed": speed}, index=index)
    return Trip(topics, {"trip": f"field-{seed:02d}"}), truth
