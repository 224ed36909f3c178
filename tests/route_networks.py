"""Networks drawn on a plane, trains that drive over them, and what receivers make of it.

The errors are none that the matcher assumes: they last and wander, jump in cuttings, freeze, come
late, are missing in tunnels, and the receiver's datum is shifted against the network.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
from ingest_logs import profile
from scipy.signal import lfilter

from trainlog import Edge, Geometry, Line, Network, Node, Station, StepProfile
from trainlog.arrays import ComplexArray, FloatArray
from trainlog.ingest import Profile
from trainlog.railway.geometry import from_plane, to_plane

ORIGIN = (47.4, 9.2)
Points = ComplexArray


def bezier(*corners: complex, count: int = 400) -> Points:
    """A smooth course from the first to the last of four corners."""
    t = np.linspace(0.0, 1.0, count)
    a, b, c, d = corners
    return (1 - t) ** 3 * a + 3 * (1 - t) ** 2 * t * b + 3 * (1 - t) * t**2 * c + t**3 * d


def straight(start: complex, end: complex, count: int = 200) -> Points:
    return start + np.linspace(0.0, 1.0, count) * (end - start)


def bowed(start: complex, end: complex, aside: float, ramp: float = 0.05) -> Points:
    """Beside a straight, that far [m], but for ramps at both ends."""
    t = np.linspace(0.0, 1.0, 600)
    off = np.clip(np.minimum(t, 1.0 - t) / ramp, 0.0, 1.0)
    off = aside * (3 * off**2 - 2 * off**3)
    return start + t * (end - start) + off * 1j * (end - start) / abs(end - start)


def line_of(name: str, points: Points, stations: Sequence[tuple[str, float]]) -> Line:
    """A line along points of the plane [m]."""
    position = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(points)))))
    latitude, longitude = from_plane(points, ORIGIN)
    length = float(position[-1])
    known = tuple(Station(each, at if at >= 0.0 else length) for each, at in stations)
    return Line(
        name=name,
        length=length,
        stations=known,
        speed_limits=StepProfile([0.0], [40.0]),
        gradients=StepProfile([0.0], [0.0]),
        geometry=Geometry(position, latitude, longitude, "drawn"),
    )


@dataclass(frozen=True)
class Receiver:
    """What a receiver and its place make of positions; sizes in m, times in s."""

    rate: float = 1.0  # fixes a second
    white: float = 0.6
    lasting: float = 2.0
    time: float = 70.0  # how long errors last
    shift: float = 5.0  # of the receiver's datum against the network, in a direction drawn
    stated: float = 2.0  # accuracy that it states; 0: none
    speed: float | None = 0.15  # noise of its speed [m/s]; None: it gives none
    outliers: float = 0.002  # share of fixes some hundred metres off
    gaps: int = 3  # times without fixes, of 1 to 30 s
    multipath: int = 3  # stretches of 5 to 20 s up to 40 m aside
    frozen: int = 1  # stretches of 5 to 20 s in which a fix is repeated


UBLOX = Receiver(rate=10.0)
GPX = Receiver(rate=1.0, white=1.2, lasting=3.0, stated=0.0, speed=0.3)
PHONE = Receiver(rate=1.0 / 11.0, white=6.0, lasting=6.0, time=120.0, stated=12.0, speed=None,
                 outliers=0.01, gaps=1, multipath=1, frozen=0)  # fmt: skip


def motion(stops, rng, rate):
    """Time [s], position [m] and speed [m/s] of a train that stops at places."""
    rows = [(float(stops[0]), 0.0)]
    dt = min(0.1, 1.0 / rate) if rate >= 1.0 else 0.5
    for begin, end in pairwise(stops):
        most = float(rng.uniform(14.0, 32.0))
        s, v = float(begin), 0.0
        rows += [(s, 0.0)] * int(rng.uniform(20.0, 45.0) / dt)
        while s < end - 0.5:
            v = min(v + 0.6 * dt, most, np.sqrt(max(2.0 * 0.7 * (end - s), 0.05)))
            s = min(s + v * dt, float(end))
            rows.append((s, v))
    rows += [(rows[-1][0], 0.0)] * int(25.0 / dt)
    position, speed = np.array(rows)[:: round(1.0 / rate / dt)].T
    return round(1.0 / rate / dt) * dt * np.arange(position.size), position, speed


@dataclass(frozen=True, eq=False)
class Received:
    """Fixes as received, NaN where there is none, and where the train was [m]."""

    seconds: FloatArray
    points: Points
    speed: FloatArray | None
    stated: FloatArray
    true_position: FloatArray
    origin: tuple[float, float] = ORIGIN


def received(track, drive, receiver, rng, tunnels=()):
    """What a receiver gives of a drive along a track (positions [m], points)."""
    seconds, position, speed = drive
    count, step = seconds.size, 1.0 / receiver.rate
    points = np.interp(position, *track)
    keep = np.exp(-step / receiver.time)
    steps = rng.standard_normal((count, 2)) @ np.array([1.0, 1j]) * np.sqrt(1.0 - keep**2)
    first = complex(*rng.standard_normal(2))
    wander, _ = lfilter([1.0], [1.0, -keep], steps, zi=[keep * first])
    points = points + receiver.shift * np.exp(2j * np.pi * rng.random())
    points += receiver.lasting * wander
    points += receiver.white * (rng.standard_normal((count, 2)) @ np.array([1.0, 1j]))

    def stretch(least: float, most: float) -> slice:
        n = max(1, int(rng.uniform(least, most) * receiver.rate))
        first = int(rng.integers(0, max(count - n, 1)))
        return slice(first, first + n)

    for _ in range(receiver.multipath):
        points[stretch(5.0, 20.0)] += rng.uniform(10.0, 40.0) * np.exp(2j * np.pi * rng.random())
    for _ in range(receiver.frozen):
        where = stretch(5.0, 20.0)
        points[where] = points[where.start]
    wild = rng.random(count) < receiver.outliers
    points[wild] += 300.0 * (rng.standard_normal((int(wild.sum()), 2)) @ np.array([1.0, 1j]))
    for _ in range(receiver.gaps):
        points[stretch(1.0, 30.0)] = np.nan
    for first, end in tunnels:
        points[(position >= first) & (position <= end)] = np.nan
    shown = None
    if receiver.speed is not None:
        shown = np.abs(speed + receiver.speed * rng.standard_normal(count))
        shown[np.isnan(points)] = np.nan
    stated = np.full(count, receiver.stated or np.nan)
    return Received(seconds, points, shown, stated, position)


def network_of(edges, stations, turns=None):
    """A network of edges (name, start, end, course); nodes named as stations are stations."""
    nodes: dict[str, Node] = {}
    for _, start, end, course in edges:
        for name, point in ((start, course[:1]), (end, course[-1:])):
            latitude, longitude = from_plane(point, ORIGIN)
            kind = "station" if name in stations else "junction"
            nodes.setdefault(name, Node(name, kind, float(latitude[0]), float(longitude[0])))
    lines = [
        Edge(name, line_of(name, course, ((start, 0.0), (end, -1.0))), start, end)
        for name, start, end, course in edges
    ]
    return Network("drawn", tuple(nodes.values()), tuple(lines), turns or {})


def y_junction() -> Network:
    """A stem from A to junction J, from there to B and to C; a bridge over it, from D to E."""
    return network_of(
        [
            ("stem", "A", "J", straight(0, 5000)),
            ("left", "J", "B", bezier(5000, 6000, 7000, 9000 + 1500j)),
            ("right", "J", "C", bezier(5000, 6000, 7000, 9000 - 1200j)),
            ("over", "D", "E", straight(2500 - 3000j, 2500 + 3000j)),
            ("link", "E", "B", bezier(2500 + 3000j, 3500 + 6000j, 8000 + 5000j, 9000 + 1500j)),
        ],
        "ABCDE",
        {"J": (("stem", "left"), ("stem", "right"))},
    )


def doubled(aside: float) -> Network:
    """From A to D; between B and C two lines so far apart [m]."""
    return network_of(
        [
            ("west", "A", "B", straight(-4000, 0)),
            ("main", "B", "C", straight(0, 7000)),
            ("relief", "B", "C", bowed(0, 7000, aside)),
            ("east", "C", "D", straight(7000, 11000)),
        ],
        "AD",
        {"B": (("west", "main"), ("west", "relief")), "C": (("main", "east"), ("relief", "east"))},
    )


def wye() -> Network:
    """Lines from A, B and C that meet in a triangle."""
    return network_of(
        [
            ("west", "A", "W", straight(-5000, -400)),
            ("south", "S", "B", straight(-400j, -5000j)),
            ("east", "E", "C", straight(400, 5000)),
            ("west-south", "W", "S", bezier(-400, -150, -150j, -400j)),
            ("south-east", "S", "E", bezier(-400j, -150j, 150, 400)),
            ("west-east", "W", "E", straight(-400, 400)),
        ],
        "ABC",
        {
            "W": (("west", "west-south"), ("west", "west-east")),
            "S": (("south", "west-south"), ("south", "south-east")),
            "E": (("east", "south-east"), ("east", "west-east")),
        },
    )


def balloon() -> Network:
    """A line from A to a loop on which trains turn."""
    loop = bezier(0, 3500 + 3500j, 3500 - 3500j, 0)
    return network_of([("stem", "A", "L", straight(-6000, 0)), ("loop", "L", "L", loop)], "A")


def drive(route, receiver, rng, stops=(), tunnels=()):
    """A trip over a route, as received."""
    geometry = route.line.geometry
    points = to_plane(geometry.latitudes, geometry.longitudes, ORIGIN)
    places = stops or (40.0, 0.45 * route.length, route.length - 40.0)
    course = motion(places, rng, receiver.rate)
    return received((geometry.positions, points), course, receiver, rng, tunnels)


def write_csv(path: Path, fixes: Received, start: str = "2026-05-01T06:00:00") -> Path:
    """The fixes as a table that its own profile describes."""
    lost = np.isnan(fixes.points)
    latitude, longitude = from_plane(np.where(lost, 0.0, fixes.points), fixes.origin)
    time = pd.Timestamp(start, tz="UTC") + pd.to_timedelta(fixes.seconds, unit="s")
    stamps = time.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
    frame = pd.DataFrame({"time": stamps, "latitude": latitude, "longitude": longitude}).round(8)
    if np.isfinite(fixes.stated).any():
        frame["accuracy"] = fixes.stated
    if fixes.speed is not None:
        frame["speed"] = fixes.speed.round(3)
    frame[~lost].to_csv(path, index=False)
    return path


def profile_for(fixes: Received) -> Profile:
    """How `write_csv` writes."""
    columns = {
        "/gnss/fix.latitude": {"column": "latitude", "unit": "deg"},
        "/gnss/fix.longitude": {"column": "longitude", "unit": "deg"},
    }
    if np.isfinite(fixes.stated).any():
        columns["/gnss/fix.horizontal_accuracy"] = {"column": "accuracy", "unit": "m"}
    if fixes.speed is not None:
        columns["/gnss/motion.speed"] = {"column": "speed", "unit": "m/s"}
    return profile(columns, file={"format": "csv"}, time={"column": "time", "format": "iso"})


def write_gpx(path: Path, fixes: Received, start: str = "2026-05-01T06:00:00") -> Path:
    begun = pd.Timestamp(start, tz="UTC")
    kept = np.flatnonzero(np.isfinite(fixes.points))
    latitude, longitude = from_plane(fixes.points[kept], fixes.origin)
    rows = [
        f'<trkpt lat="{north:.8f}" lon="{east:.8f}"><ele>400</ele>'
        f"<time>{(begun + pd.Timedelta(seconds=float(at))).isoformat()}</time></trkpt>"
        for north, east, at in zip(latitude, longitude, fixes.seconds[kept], strict=True)
    ]
    head = '<?xml version="1.0"?><gpx version="1.1" creator="x"><trk><trkseg>'
    path.write_text(head + "\n".join(rows) + "</trkseg></trk></gpx>", "utf-8")
    return path
