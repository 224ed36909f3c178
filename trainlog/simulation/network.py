"""A made-up railway network: lines that meet at junctions and stations, consistent throughout.

Nodes lie on a plane that touches the earth. Each has a track axis, so that every line leaves it
along that axis to one of its two sides: a train runs on from one side to the other and never
around a corner. Between two nodes the line is made of straights, clothoids and arcs whose
curvatures are solved for until the line arrives where and as the next node lies; its gradients
climb exactly from one node's altitude to the other's. So altitude and place close round every loop.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.ndimage import grey_opening

from trainlog.arrays import BoolArray, ComplexArray, FloatArray
from trainlog.errors import InputError
from trainlog.railway import CurvatureProfile, Geometry, Line, Station, StepProfile, Tunnel
from trainlog.railway.geometry import from_plane, plane_curve, thinned
from trainlog.railway.network import Edge, Network, Node, NodeKind
from trainlog.units import KMH

ORIGIN = (47.3, 9.0)
"""Where the plane of drawn networks touches the earth [deg]."""

SPACING = 7_500.0
"""Between neighbouring nodes, before they are shifted [m]."""

SHARPEST = 1.0 / 320.0
"""Curvature of the sharpest arcs [1/m]."""

STEEPEST, STEEPEST_MEAN, IN_STATION = 25e-3, 10e-3, 2.5e-3
"""Gradients at most: of any element, on average between two nodes, and in stations."""

STATION_HALF = 220.0
"""A station reaches so far to either side of its stopping point [m]."""

CANT_SPEED = 4.5
"""Permitted speed [km/h] over the root of the radius [m]: 130 mm of cant and as much deficiency
(11.8 v²/R with v in km/h and 240 mm together), rounded down."""

LINE_SPEEDS = (100.0, 110.0, 125.0, 140.0)
"""Of lines, where no curve or station asks for less [km/h]."""

_STEMS = (
    "Ahorn Birk Buch Eich Erl Esch Farn Fichten Forst Hasel Hirsch Holz Kirsch Lind Moos Mühl Neu"
    " Ober Otter Reh Ried Rot Sand Schwarz See Stein Tann Ulm Unter Wald Weid Weiss Wies"
)
_ENDINGS = "au bach berg brunn burg dorf egg feld hof hausen kirch matt stetten tal wil"


@dataclass(frozen=True)
class _Graph:
    """Nodes on the plane, and which are joined."""

    points: ComplexArray
    pairs: tuple[tuple[int, int], ...]
    headings: dict[tuple[int, int], float]
    altitudes: FloatArray

    def degree(self, node: int) -> int:
        return sum(node in pair for pair in self.pairs)


def draw_network(seed: int, lines: int = 10) -> Network:
    """Draw a network; the same seed draws the same one.

    Stations and junctions some kilometres apart, and lines between them, with at least one loop
    from three lines on. Radii are 320 m and more, gradients 25 per mille at most, 2.5 in stations.

    Parameters
    ----------
    seed : int
    lines : int
        Edges of the network.

    Raises
    ------
    InputError
        If `lines` is not between 1 and 60.

    Examples
    --------
    >>> network = draw_network(seed=1, lines=4)
    >>> len(network.edges), len(network.nodes)
    (4, 4)
    """
    if not 1 <= lines <= 60:
        raise InputError(f"cannot draw {lines} lines", remedy="give 1 to 60")
    graph = _graph(lines, seed)
    names = _names(seed)
    node_names = [next(names) for _ in graph.points]
    latitudes, longitudes = from_plane(graph.points, ORIGIN)
    nodes = []
    junctions = [n for n in range(graph.points.size) if graph.degree(n) >= 3][1::2]
    for number, name in enumerate(node_names):
        kind: NodeKind = "junction" if number in junctions else "station"
        shown = f"{name} Junction" if kind == "junction" else name
        node_names[number] = shown
        place = (round(float(latitudes[number]), 7), round(float(longitudes[number]), 7))
        nodes.append(Node(shown, kind, *place))
    edges = []
    for number, (start, end) in enumerate(graph.pairs):
        generator = np.random.default_rng([seed, 22, number])
        name = f"{node_names[start]}-{node_names[end]}"
        ends = tuple(node_names[node] if node not in junctions else None for node in (start, end))
        through = tuple(graph.degree(node) >= 3 for node in (start, end))
        line = _line(name, graph, (start, end), ends, through, names, generator)
        edges.append(Edge(name, line, node_names[start], node_names[end]))
    return Network(
        f"Drawn {seed}",
        tuple(nodes),
        tuple(edges),
        turns=_turns(graph, node_names),
        source=f"made up, drawn by trainlog with seed {seed}: no such railway exists",
    )


def _turns(graph: _Graph, names: list[str]) -> dict[str, tuple[tuple[str, str], ...]]:
    """Movements between lines that leave a node to opposite sides of its tracks."""
    found = {}
    for node, name in enumerate(names):
        lines = {
            f"{names[a]}-{names[b]}": graph.headings[node, a + b - node]
            for a, b in graph.pairs
            if node in (a, b)
        }
        found[name] = tuple(
            (one, other)
            for one, other in combinations(lines, 2)
            if np.cos(lines[one] - lines[other]) < 0.0
        )
    return {name: pairs for name, pairs in found.items() if pairs}


def _names(seed: int) -> Iterator[str]:
    """Names of places, each once."""
    generator = np.random.default_rng([seed, 20])
    stems, endings = _STEMS.split(), _ENDINGS.split()
    for pick in generator.permutation(len(stems) * len(endings)):
        stem, ending = divmod(int(pick), len(endings))
        yield stems[stem] + endings[ending]


def _graph(lines: int, seed: int) -> _Graph:
    """Nodes and who is joined: a spanning tree of short lines, and some more that close loops."""
    loops = max(1, lines // 5) if lines >= 3 else 0
    count = lines - loops + 1
    generator = np.random.default_rng([seed, 21])
    for _ in range(200):
        side = int(np.ceil(np.sqrt(count)))
        cells = generator.permutation(side * (side + 1))[:count]
        grid = (cells % side) + 0.5 * (cells // side % 2) + 0.87j * (cells // side)
        shift = generator.uniform(-0.22, 0.22, (2, count))
        points = SPACING * (grid - grid.mean() + shift[0] + 1j * shift[1])
        pairs = _joined(points, lines)
        if pairs is not None:
            headings = _headings(points, pairs)
            if headings is not None:
                return _Graph(points, pairs, headings, _altitudes(points, pairs, generator))
    raise InputError(f"no network of {lines} lines found with seed {seed}", remedy="try another")


def _joined(points: ComplexArray, lines: int) -> tuple[tuple[int, int], ...] | None:
    """Pairs of nodes: the shortest that join all, then the shortest others that close loops."""
    count = points.size
    every = sorted(
        combinations(range(count), 2), key=lambda pair: abs(points[pair[0]] - points[pair[1]])
    )
    group = list(range(count))
    tree: list[tuple[int, int]] = []
    for a, b in every:
        if group[a] != group[b]:
            old, new = group[b], group[a]
            group = [new if each == old else each for each in group]
            tree.append((a, b))
    chosen = list(tree)
    for pair in every:
        if len(chosen) == lines:
            break
        if pair not in chosen and _fits(points, chosen, pair):
            chosen.append(pair)
    degrees = [sum(node in pair for pair in chosen) for node in range(count)]
    lengths = [abs(points[a] - points[b]) for a, b in chosen]
    fine = len(chosen) == lines and max(degrees) <= 4
    return (
        tuple(chosen)
        if fine and max(lengths) < 2.1 * SPACING and min(lengths) > 0.6 * SPACING
        else None
    )


def _fits(points: ComplexArray, chosen: list[tuple[int, int]], pair: tuple[int, int]) -> bool:
    """Whether one more line crosses no other and leaves no node close beside another."""
    a, b = (points[node] for node in pair)
    for other in chosen:
        c, d = (points[node] for node in other)
        shared = set(pair) & set(other)
        if not shared:
            sides = [np.sign((np.conj(b - a) * (x - a)).imag) for x in (c, d)]
            others = [np.sign((np.conj(d - c) * (x - c)).imag) for x in (a, b)]
            if sides[0] != sides[1] and others[0] != others[1]:
                return False
            continue
        node = shared.pop()
        one, two = (points[p[0] + p[1] - node] - points[node] for p in (pair, other))
        if abs(np.angle(one / two)) < np.radians(50.0):
            return False
    return True


def _headings(
    points: ComplexArray, pairs: tuple[tuple[int, int], ...]
) -> dict[tuple[int, int], float] | None:
    """The direction in which each line leaves each node [rad]: along the axis of its tracks."""
    found: dict[tuple[int, int], float] = {}
    for node in range(points.size):
        others = [a + b - node for a, b in pairs if node in (a, b)]
        wanted = np.angle(points[others] - points[node])
        best, best_axis = np.inf, 0.0
        for axis in np.linspace(0.0, np.pi, 72, endpoint=False):
            forward = np.cos(wanted - axis) >= 0.0
            if len(others) > 1 and forward.all() | (~forward).all():
                continue
            off = float(np.max(np.arccos(np.abs(np.cos(wanted - axis)))))
            if off < best:
                best, best_axis = off, float(axis)
        if best > np.radians(70.0):
            return None
        if len(others) == 1:
            best_axis = float(wanted[0])
        for other, towards in zip(others, wanted, strict=True):
            found[node, other] = (
                best_axis if np.cos(towards - best_axis) >= 0.0 else best_axis + np.pi
            )
    return found


def _altitudes(
    points: ComplexArray,
    pairs: tuple[tuple[int, int], ...],
    generator: np.random.Generator,
) -> FloatArray:
    """Of the nodes [m], so that no line between two climbs too steeply on average."""
    raw = 70.0 * generator.standard_normal(points.size)
    climbs = [abs(raw[a] - raw[b]) / abs(points[a] - points[b]) for a, b in pairs]
    return np.asarray(np.round(520.0 + raw * min(1.0, STEEPEST_MEAN / max(*climbs, 1e-9)), 2))


def _line(
    name: str,
    graph: _Graph,
    pair: tuple[int, int],
    ends: tuple[str | None, ...],
    through: tuple[bool, ...],
    names: Iterator[str],
    generator: np.random.Generator,
) -> Line:
    """The line between two nodes."""
    start, end = pair
    curvatures, length = _course(
        graph.points[end] - graph.points[start],
        graph.headings[start, end],
        graph.headings[end, start] + np.pi,
        generator,
    )
    stations = _stations(length, ends, names, generator)
    at = np.array([station.position for station in stations])
    climb = float(graph.altitudes[end] - graph.altitudes[start])
    tunnels = _tunnels(length, at, generator)
    return Line(
        name=name,
        length=length,
        stations=stations,
        speed_limits=_limits(length, curvatures, at, through, generator),
        gradients=_gradients(length, climb, at, generator),
        curvatures=curvatures,
        tunnels=tunnels,
        altitude=float(graph.altitudes[start]),
        geometry=_geometry(curvatures, length, graph.points[start], graph.headings[start, end]),
        source="made up, drawn by trainlog: no such line exists",
    )


def _geometry(
    curvatures: CurvatureProfile, length: float, start: complex, heading: float
) -> Geometry:
    """The course laid on the earth, by its points that matter to 0.3 m."""
    positions, points = plane_curve(curvatures, length)
    # plane_curve heads north; a heading here is that of complex numbers, from east to the left.
    laid = start + points * np.exp(1j * (heading - np.pi / 2.0))
    latitude, longitude = from_plane(laid, ORIGIN)
    shrink = np.cos(np.radians(ORIGIN[0]))
    kept = thinned(positions, 111.2e3 * (longitude * shrink + 1j * latitude), 0.3)
    return Geometry(
        np.round(positions[kept], 3),
        np.round(latitude[kept], 7),
        np.round(longitude[kept], 7),
        "drawn: exact to the curvature",
    )


def _course(
    chord: complex, leaving: float, arriving: float, generator: np.random.Generator
) -> tuple[CurvatureProfile, float]:
    """Curvature and length of a line that runs from 0 to `chord` with given directions at both."""
    best: tuple[float, CurvatureProfile, float] | None = None
    for attempt in range(60):
        drawn = _drawn_course(chord, leaving, arriving, attempt, generator)
        if drawn is None:
            continue
        sharpest = float(np.max(np.abs(drawn[0].start)))
        if best is None or sharpest < best[0]:
            best = (sharpest, *drawn)
        if sharpest <= SHARPEST:
            break
    if best is None or best[0] > 1.0 / 250.0:
        raise InputError("a line of the network would be too sharp", remedy="try another seed")
    return best[1], best[2]


def _drawn_course(
    chord: complex,
    leaving: float,
    arriving: float,
    attempt: int,
    generator: np.random.Generator,
) -> tuple[CurvatureProfile, float] | None:
    """One draw of the course: a smooth curve's bends and some of its own, then solved for."""
    t = np.linspace(0.0, 1.0, 2001)
    reach = abs(chord) * generator.uniform(0.8, 1.3)
    curve = (
        (t**3 - 2.0 * t**2 + t) * reach * np.exp(1j * leaving)
        + (3.0 * t**2 - 2.0 * t**3) * chord
        + (t**3 - t**2) * reach * np.exp(1j * arriving)
    )
    steps = np.diff(curve)
    along = np.concatenate(([0.0], np.cumsum(np.abs(steps))))
    heading = np.unwrap(np.angle(steps))
    turned = np.interp(np.linspace(0.0, along[-1], 4001), 0.5 * (along[1:] + along[:-1]), heading)
    margin = 180.0
    count = max(int((along[-1] - 2.0 * margin) / generator.uniform(550.0, 900.0)), 4)
    widths = generator.uniform(0.6, 1.4, count)
    widths *= (along[-1] - 2.0 * margin) / widths.sum()
    shares = generator.uniform(0.5, 0.85, count)
    ends = margin + np.cumsum(widths)
    starts = ends - widths
    turn = np.interp(ends, np.linspace(0.0, along[-1], 4001), turned) - np.interp(
        starts, np.linspace(0.0, along[-1], 4001), turned
    )
    active = generator.uniform(size=count) < 0.8
    if active.sum() < 4:
        return None
    own = generator.uniform(-1.0, 1.0, count) / (700.0 + 60.0 * attempt)
    # Turning to the left is a negative curvature of a line.
    bends = np.where(active, -turn / (0.75 * shares * widths) + own, 0.0)
    return _solved(chord, leaving, arriving, margin, widths, shares, bends, active)


def _profile(
    margin: float, widths: FloatArray, shares: FloatArray, bends: FloatArray, scale: float
) -> tuple[CurvatureProfile, float]:
    """Cells of a straight, a clothoid, an arc and a clothoid; straight at both ends."""
    positions, start, end = [0.0], [0.0], [0.0]
    at = margin * scale
    for width, share, bend in zip(scale * widths, shares, bends, strict=True):
        if bend != 0.0:
            curved = share * width
            first = at + 0.5 * (width - curved)
            positions += [first, first + 0.25 * curved, first + 0.75 * curved, first + curved]
            start += [0.0, bend, bend, 0.0]
            end += [bend, bend, 0.0, 0.0]
        at += width
    return CurvatureProfile(*map(np.array, (positions, start, end))), at + margin * scale


def _solved(
    chord: complex,
    leaving: float,
    arriving: float,
    margin: float,
    widths: FloatArray,
    shares: FloatArray,
    bends: FloatArray,
    active: BoolArray,
) -> tuple[CurvatureProfile, float] | None:
    """Change bends and length least, by Gauss and Newton, until the course arrives as it should."""
    unit = 1e-4

    def missed(unknown: FloatArray) -> FloatArray:
        now = bends.copy()
        now[active] += unit * unknown[:-1]
        profile, length = _profile(margin, widths, shares, now, 1.0 + 1e-2 * unknown[-1])
        _, points = plane_curve(profile, length, 100.0)
        turned = leaving - float(
            np.sum(
                0.5 * (profile.start + profile.end) * np.diff(np.append(profile.positions, length))
            )
        )
        gap = points[-1] * np.exp(1j * (leaving - np.pi / 2.0)) - chord
        return np.array(
            [gap.real / 1e3, gap.imag / 1e3, np.angle(np.exp(1j * (turned - arriving)))]
        )

    unknown = np.zeros(int(active.sum()) + 1)
    for _ in range(40):
        off = missed(unknown)
        if np.max(np.abs(off)) < 1e-10:
            break
        slopes = np.column_stack(
            [(missed(unknown + 1e-4 * one) - off) / 1e-4 for one in np.eye(unknown.size)]
        )
        step = np.linalg.lstsq(slopes, -off, rcond=None)[0]
        unknown = unknown + step * min(1.0, 8.0 / max(float(np.max(np.abs(step))), 1e-12))
    else:
        return None
    found = bends.copy()
    found[active] += unit * unknown[:-1]
    return _profile(margin, widths, shares, found, 1.0 + 1e-2 * unknown[-1])


def _stations(
    length: float,
    ends: tuple[str | None, ...],
    names: Iterator[str],
    generator: np.random.Generator,
) -> tuple[Station, ...]:
    """At the nodes that are stations, and every few kilometres between."""
    inner = max(round(length / generator.uniform(3200.0, 5200.0)) - 1, 0)
    if inner == 0 and not any(ends):
        inner = 1
    cuts = (np.arange(inner) + 1.0 + generator.uniform(-0.18, 0.18, inner)) / (inner + 1.0)
    found = [] if ends[0] is None else [Station(ends[0], 0.0)]
    found += [Station(next(names), round(float(cut * length), 1)) for cut in cuts]
    return tuple(found if ends[1] is None else [*found, Station(ends[1], length)])


def _gradients(
    length: float, climb: float, stations: FloatArray, generator: np.random.Generator
) -> StepProfile:
    """Gradients that climb by `climb` [m] in all; nearly level in stations."""
    cuts = np.cumsum(generator.lognormal(np.log(450.0), 0.6, int(length / 60.0)))
    level = np.concatenate((stations - STATION_HALF, stations + STATION_HALF))
    near = np.min(np.abs(cuts[:, None] - level), axis=1) < 60.0
    inside = np.min(np.abs(cuts[:, None] - stations), axis=1) < STATION_HALF
    positions = np.unique(np.concatenate(([0.0], cuts[~near & ~inside], level)))
    positions = np.round(positions[(positions >= 0.0) & (positions < length - 30.0)], 1)
    widths = np.diff(np.append(positions, length))
    centres = positions + 0.5 * widths
    flat = np.min(np.abs(centres[:, None] - stations), axis=1) < STATION_HALF
    values = np.where(
        flat,
        generator.uniform(-IN_STATION, IN_STATION, positions.size),
        9e-3 * generator.standard_normal(positions.size),
    )
    most = STEEPEST - 1e-3
    values = np.round(np.where(flat, values, np.clip(values, -most, most)), 5)
    for _ in range(200):
        missing = climb - float(values @ widths)
        free = ~flat & (np.abs(values) < most if abs(missing) > 1e-9 else True)
        if abs(missing) < 1e-9:
            break
        values = np.where(free, values + missing / widths[free].sum(), values)
        values = np.where(flat, values, np.clip(values, -STEEPEST, STEEPEST))
    return StepProfile(positions, np.asarray(values, dtype=np.float64))


def _limits(
    length: float,
    curvatures: CurvatureProfile,
    stations: FloatArray,
    through: tuple[bool, ...],
    generator: np.random.Generator,
) -> StepProfile:
    """What the line, its curves, junctions and some stations permit, in steps of 5 km/h."""
    grid = np.arange(0.0, length, 25.0)
    usual = float(generator.choice(LINE_SPEEDS))
    bend = np.abs(curvatures.at(grid, length))
    bend = np.maximum.reduce([np.roll(bend, shift) for shift in (-2, -1, 0, 1, 2)])
    limit = np.minimum(usual, CANT_SPEED / np.sqrt(np.maximum(bend, 1e-6)))
    for position, crowded in zip((0.0, length), through, strict=True):
        if crowded:
            near = np.abs(grid - position) < 300.0
            limit = np.where(near, np.minimum(limit, generator.choice((80.0, 90.0))), limit)
    for position in stations:
        if generator.uniform() < 0.3:
            near = np.abs(grid - position) < 400.0
            limit = np.where(near, np.minimum(limit, generator.choice((80.0, 90.0, 100.0))), limit)
    limit = 5.0 * np.floor(limit / 5.0)
    # A limit that rises for less than 400 m is not posted.
    limit = grey_opening(limit, 17, mode="nearest")
    changes = np.concatenate(([True], np.diff(limit) != 0.0))
    return StepProfile(grid[changes], limit[changes] / KMH)


def _tunnels(
    length: float, stations: FloatArray, generator: np.random.Generator
) -> tuple[Tunnel, ...]:
    """Now and then one, away from stations and junctions."""
    if generator.uniform() > 0.45:
        return ()
    extent = float(generator.uniform(250.0, 1100.0))
    for _ in range(20):
        position = float(generator.uniform(500.0, length - extent - 500.0))
        if np.min(np.abs(stations - position - 0.5 * extent)) > 0.5 * extent + 400.0:
            return (Tunnel(round(position, 1), round(extent, 1), 45.0),)
    return ()
