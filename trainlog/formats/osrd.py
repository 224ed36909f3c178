"""Rolling stock and infrastructure of OSRD, the Open Source Railway Designer (railjson).

https://osrd.fr: SI units without declaration, but slopes in per mille. Rolling stock becomes a
train: its tractive effort is a table over speed, one or more for each electrification.
Infrastructure becomes a network: track sections with slopes and curves [m], joined by switches;
speed sections; operational points; positions from a section's beginning.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, fields
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np

from trainlog.declaration import (
    Foreign,
    Many,
    Must,
    Name,
    NotNegative,
    Number,
    Positive,
    at,
    from_content,
)
from trainlog.display import span
from trainlog.errors import InputError
from trainlog.formats.declared import built
from trainlog.formats.files import read_json
from trainlog.formats.tracks import (
    EVERY_LIMIT,
    Account,
    Infrastructure,
    Limit,
    LimitChoice,
    Stretch,
    TrackData,
    TrackEnd,
    TrackGraph,
    curvature_of,
    distinct_names,
    not_in_file,
)
from trainlog.formats.ttobench import UNPUBLISHED, assumed_axles
from trainlog.railway import EffortCurve, RunningResistance, Station, Train
from trainlog.railway.geometry import to_plane

# ------------------------------------------------------------------------------- rolling stock

_ASSUMED = (*UNPUBLISHED, "max_load", "axles", "brake")
"""Fields of a train that OSRD does not know."""


class _Efforts(Foreign):
    speeds: tuple[NotNegative, ...]
    max_efforts: tuple[NotNegative, ...]

    def curve(self, place: str) -> EffortCurve:
        with at(place):
            return EffortCurve(np.array(self.speeds), np.array(self.max_efforts))


class _Conditional(Foreign):
    cond: dict[str, Any]
    curve: _Efforts


class _Mode(Foreign):
    curves: tuple[_Conditional, ...] = ()
    default_curve: _Efforts
    is_electric: bool = False


class _EffortCurves(Foreign):
    default_mode: str
    modes: dict[str, _Mode]


class _Davis(Foreign):
    type: Literal["davis"]
    A: NotNegative
    B: NotNegative
    C: NotNegative


class _Gamma(Foreign):
    type: Literal["CONST", "MAX"]
    value: Positive


class _RollingStock(Foreign):
    """Keys that are not known are passed over and listed."""

    name: Name
    railjson_version: str
    mass: Positive
    length: Positive
    max_speed: Positive
    comfort_acceleration: Positive
    inertia_coefficient: Annotated[
        float, Number(must=Must("is below 1", "give mass with rotating part over mass", 1.0))
    ]
    rolling_resistance: _Davis
    effort_curves: _EffortCurves
    gamma: _Gamma | None = None
    const_gamma: Positive | None = None

    @property
    def deceleration(self) -> float:
        """Of service braking [m/s²]."""
        if self.const_gamma is not None:
            return self.const_gamma
        if self.gamma is None:
            raise InputError("is missing", place="gamma", remedy="give the deceleration [m/s²]")
        return self.gamma.value

    def chosen(self, electrification: str | None) -> tuple[str, _Mode]:
        """The electrification and its efforts."""
        curves = self.effort_curves
        name = electrification or curves.default_mode
        if name not in curves.modes:
            raise InputError(
                f"has no tractive effort for electrification '{name}'",
                place="effort_curves.modes",
                remedy=f"choose one of {', '.join(curves.modes)}",
            )
        return name, curves.modes[name]

    def train(self, electrification: str | None) -> Train:
        """The train with the efforts of one electrification."""
        name, mode = self.chosen(electrification)
        curve = mode.default_curve.curve(f"effort_curves.modes.{name}.default_curve")
        rotating = self.inertia_coefficient - 1.0
        effort = float(curve.efforts.max())
        return Train(
            name=self.name,
            source=f"OSRD rolling stock (railjson {self.railjson_version}), electrification {name}",
            mass=self.mass,
            rotating_mass_factor=rotating,
            resistance=RunningResistance(
                self.rolling_resistance.A, self.rolling_resistance.B, self.rolling_resistance.C
            ),
            max_tractive_effort=effort,
            max_traction_power=curve.peak_power,
            max_pneumatic_braking_effort=self.deceleration * self.mass * self.inertia_coefficient,
            max_speed=self.max_speed,
            max_acceleration=self.comfort_acceleration,
            max_deceleration=self.deceleration,
            length=self.length,
            axles=assumed_axles(self.mass, effort, rotating),
            traction_curve=curve,
            assumed=_ASSUMED,
        )

    def dropped(self, electrification: str | None) -> list[str]:
        """What of the file the train does not hold, in words."""
        name, mode = self.chosen(electrification)
        others = [each for each in self.effort_curves.modes if each != name]
        found = [f"efforts of electrification {', '.join(others)}"] if others else []
        if mode.curves:
            conditions = sorted({key for each in mode.curves for key in each.cond})
            found.append(f"{len(mode.curves)} efforts by {', '.join(conditions)}")
        return found


def is_rolling_stock(content: Any) -> bool:
    """Whether JSON content looks like rolling stock of OSRD."""
    return isinstance(content, dict) and {"railjson_version", "effort_curves"} <= content.keys()


def read_train(path: str | Path, electrification: str | None = None) -> tuple[Train, list[str]]:
    """The train of a file of rolling stock, and what of the file it does not hold.

    The friction brake gives the deceleration that OSRD plans with; dynamic brake, axles and
    efficiencies are not published, and listed in the train's ``assumed``.

    Parameters
    ----------
    path : str or Path
    electrification : str, optional
        One of the file's; default: that which the file calls its default. Of its efforts those
        without a condition are taken (comfort, power restriction, electrical profile).

    Returns
    -------
    train : Train
    dropped : list of str

    Raises
    ------
    InputError
        If the file is no such rolling stock, or has no efforts for the electrification.

    Examples
    --------
    >>> read_train("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    content = read_json(path)
    if not is_rolling_stock(content):
        raise InputError(
            "is not rolling stock of OSRD",
            file=path,
            remedy="expected the keys 'railjson_version' and 'effort_curves'",
        )
    stock = built(lambda: from_content(_RollingStock, content), path)
    train = built(lambda: stock.train(electrification), path)
    used = {each.name for each in fields(_RollingStock)}
    unused = sorted(key for key in content if key not in used)
    dropped = stock.dropped(electrification)
    return train, dropped + ([f"keys {', '.join(unused)}"] if unused else [])


# ------------------------------------------------------------------------------ infrastructure

SWITCH_TYPES: dict[str, tuple[tuple[str, str], ...]] = {
    "link": (("A", "B"),),
    "point_switch": (("A", "B1"), ("A", "B2")),
    "crossing": (("A1", "B1"), ("A2", "B2")),
    "single_slip_switch": (("A1", "B1"), ("A1", "B2"), ("A2", "B2")),
    "double_slip_switch": (("A1", "B1"), ("A1", "B2"), ("A2", "B1"), ("A2", "B2")),
}
"""The ports that the switches of OSRD connect, by their type."""

NOT_HELD = {
    "signals": "signals",
    "detectors": "detectors",
    "routes": "routes of the interlocking",
    "electrifications": "electrified sections",
    "neutral_sections": "neutral sections",
    "level_crossings": "level crossings",
}
"""Lists of a file that a network does not hold, and what they are of."""


FARTHEST = 2.0
"""Courses so many times as long as their sections, or shorter by it, are drawings."""

FARTHEST_ENDS = 10.0
"""Ends so many times as far apart as their section is long have no coordinates."""


class _Range(Foreign):
    begin: NotNegative
    end: NotNegative


class _Slope(_Range):
    gradient: float


class _Curve(_Range):
    radius: float


class _Course(Foreign):
    type: Literal["LineString"]
    coordinates: Annotated[tuple[Annotated[tuple[float, ...], Many(least=2)], ...], Many(least=2)]


class _Section(Foreign):
    id: Name
    length: Positive
    slopes: tuple[_Slope, ...] = ()
    curves: tuple[_Curve, ...] = ()
    loading_gauge_limits: tuple[Any, ...] = ()
    geo: _Course | None = None


class _Port(Foreign):
    track: str
    endpoint: Literal["BEGIN", "END"]


class _Switch(Foreign):
    id: Name
    switch_type: str
    ports: dict[str, _Port]


class _Connection(Foreign):
    src: str
    dst: str


class _SwitchType(Foreign):
    id: str
    ports: tuple[str, ...]
    groups: dict[str, tuple[_Connection, ...]]


class _Place(Foreign):
    track: str
    position: NotNegative


class _OperationalPoint(Foreign):
    id: Name
    parts: tuple[_Place, ...]
    extensions: dict[str, Any] = field(default_factory=dict)

    @property
    def name(self) -> str:
        identifier = self.extensions.get("identifier")
        known = identifier.get("name") if isinstance(identifier, dict) else None
        return known if known and isinstance(known, str) else self.id


class _TrackRange(_Range):
    track: str
    applicable_directions: Literal["START_TO_STOP", "STOP_TO_START", "BOTH"]


class _SpeedSection(Foreign):
    id: str
    speed_limit: Positive | None = None
    speed_limit_by_tag: dict[str, Positive] = field(default_factory=dict)
    track_ranges: tuple[_TrackRange, ...]
    on_routes: tuple[str, ...] | None = None


class _BufferStop(_Place):
    id: Name


class _Infrastructure(Foreign):
    """Keys that are not known are passed over and listed."""

    version: str
    track_sections: Annotated[tuple[_Section, ...], Many(least=1)]
    switches: tuple[_Switch, ...]
    extended_switch_types: tuple[_SwitchType, ...] = ()
    operational_points: tuple[_OperationalPoint, ...] = ()
    speed_sections: tuple[_SpeedSection, ...] = ()
    buffer_stops: tuple[_BufferStop, ...] = ()


def is_infrastructure(content: Any) -> bool:
    """Whether the content of a JSON file is infrastructure of OSRD.

    Examples
    --------
    >>> is_infrastructure({"version": "3.4.12", "track_sections": [], "switches": []})
    True
    """
    return isinstance(content, dict) and {"track_sections", "switches"} <= content.keys()


def read_infrastructure(path: str | Path, limits: LimitChoice = EVERY_LIMIT) -> Infrastructure:
    """Read infrastructure of OSRD as a network.

    Track sections that follow each other without a choice are one edge, through links and crossings
    as well. Operational points are stations inside the edges of their tracks; switches and the ends
    of tracks are nodes. Limits that hold on routes of the interlocking alone are taken to hold on
    all. railjson does not define the side of a curve: positive radii are taken as bends to the
    right from a section's beginning.

    Parameters
    ----------
    path : str or Path
    limits : LimitChoice, optional
        Which of its speed limits hold.

    Raises
    ------
    InputError
        If the file cannot be read, lacks something, refers to a track that it does not have, has no
        limits of a category, or a switch is of a type that is not known.

    Examples
    --------
    >>> read_infrastructure("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    content = read_json(path)
    infra = built(lambda: from_content(_Infrastructure, content), path)
    return built(lambda: _networks(infra, content, Path(path).stem, limits), path)


def _networks(
    infra: _Infrastructure, content: dict[str, Any], name: str, limits: LimitChoice
) -> Infrastructure:
    graph = TrackGraph(name, f"OSRD infrastructure (railjson {infra.version})")
    tracks = _tracks(infra, graph)
    _add_stations(infra, tracks)
    _add_limits(infra, tracks, graph.account)
    _add_movements(infra, graph, tracks)
    for stop in infra.buffer_stops:
        track = _track(tracks, stop.track, f"buffer_stops '{stop.id}'")
        graph.label(stop.track, track.length, stop.position, stop.id)
    held = {each.name for each in fields(_Infrastructure)}
    for key in [*NOT_HELD, *sorted(content.keys() - NOT_HELD.keys() - held)]:
        here, what = content.get(key) or [], NOT_HELD.get(key, f"'{key}'")
        graph.account.left_out[what] += len(here) if isinstance(here, list | dict) else 1
    return graph.whole(tracks, limits)


def _tracks(infra: _Infrastructure, graph: TrackGraph) -> dict[str, TrackData]:
    """The track sections, with gradients, curves and course."""
    tracks, account, scales = dict[str, TrackData](), graph.account, []
    for number, section in enumerate(infra.track_sections):
        place = f"track_sections[{number}]"
        if section.id in tracks:
            raise InputError(
                f"track section '{section.id}' comes twice", place=place, remedy="remove one"
            )
        track = TrackData(section.id, section.length, level_between=True)
        track.gradients = [Stretch(s.begin, s.end, 1e-3 * s.gradient) for s in section.slopes]
        track.curves = [Stretch(s.begin, s.end, curvature_of(s.radius)) for s in section.curves]
        if section.geo is not None:
            scales.append(_lay(graph, track, section.geo.coordinates))
        account.left_out["loading gauge limits"] += len(section.loading_gauge_limits)
        tracks[section.id] = track
    known = np.array(scales)
    drawn = int(np.sum(np.isnan(known) | (known > FARTHEST) | (known < 1.0 / FARTHEST)))
    account.left_out["courses of track sections with a course that does not fit their length"] += (
        drawn
    )
    scaled = known[(np.abs(known - 1.0) > 0.01) & (known <= FARTHEST) & (known >= 1.0 / FARTHEST)]
    if scaled.size:
        account.assumed[
            f"courses {span(scaled, 1.0, 2)} times as long as their track sections, laid evenly"
            " over these"
        ] += scaled.size
    return tracks


def _lay(graph: TrackGraph, track: TrackData, coordinates: Sequence[Sequence[float]]) -> float:
    """Give a track its course, laid evenly over its length; how many times as long it is.

    NaN where it does not lie on the earth. Such and much longer or shorter ones are drawings.
    """
    longitudes, latitudes = np.array([point[:2] for point in coordinates]).T
    if np.any(np.abs(latitudes) > 90.0) or np.any(np.abs(longitudes) > 180.0):
        return np.nan
    points = to_plane(latitudes, longitudes, (float(latitudes.mean()), float(longitudes.mean())))
    if np.abs(points[-1] - points[0]) <= FARTHEST_ENDS * track.length:
        for at_end, end in ((False, 0), (True, -1)):
            corner = float(latitudes[end]), float(longitudes[end])
            graph.corners[TrackEnd(track.name, at_end)] = corner
    along = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(points)))))
    scale = float(along[-1] / track.length)
    if 1.0 / FARTHEST <= scale <= FARTHEST:
        rows = zip(along / scale, latitudes, longitudes, strict=True)
        track.course = [(float(at), float(lat), float(lon)) for at, lat, lon in rows]
        track.course_quality = "coordinates of OSRD infrastructure, laid over the stated lengths"
    return scale


def _track(tracks: dict[str, TrackData], name: str, place: str) -> TrackData:
    if name not in tracks:
        raise not_in_file("track section", name, place)
    return tracks[name]


def _add_stations(infra: _Infrastructure, tracks: dict[str, TrackData]) -> None:
    """Operational points on their tracks; those that share a name have their id in it."""
    names = distinct_names((point.name, point.id) for point in infra.operational_points)
    for number, (point, name) in enumerate(zip(infra.operational_points, names, strict=True)):
        for row, part in enumerate(point.parts):
            place = f"operational_points[{number}].parts[{row}]"
            track = _track(tracks, part.track, place)
            if part.position > track.length + 1.0:
                raise InputError(
                    f"lies at {part.position:g} m of track section '{part.track}', which is"
                    f" {track.length:g} m long",
                    place=place,
                    remedy="correct the position",
                )
            track.stations.append(Station(name, min(part.position, track.length)))


def _add_limits(infra: _Infrastructure, tracks: dict[str, TrackData], account: Account) -> None:
    """The limits of the speed sections, by direction and by category of train.

    A section holds for a category with its own limit, else with that for all trains.
    """
    categories = sorted({tag for each in infra.speed_sections for tag in each.speed_limit_by_tag})
    for number, section in enumerate(infra.speed_sections):
        place = f"speed_sections[{number}]"
        speeds = {tag: section.speed_limit_by_tag.get(tag, section.speed_limit)
                  for tag in categories} | {"": section.speed_limit}  # fmt: skip
        for row, each in enumerate(section.track_ranges):
            track = _track(tracks, each.track, f"{place}.track_ranges[{row}]")
            forward = each.applicable_directions != "STOP_TO_START"
            against = each.applicable_directions != "START_TO_STOP"
            track.limits += [
                Limit(each.begin, each.end, speed, forward, against, tag)
                for tag, speed in speeds.items()
                if speed is not None
            ]
        routes = "speed sections of single routes of the interlocking hold on all routes"
        account.assumed[routes] += section.on_routes is not None


def _add_movements(infra: _Infrastructure, graph: TrackGraph, tracks: dict[str, TrackData]) -> None:
    types = dict(SWITCH_TYPES)
    for kind in infra.extended_switch_types:
        pairs = [(each.src, each.dst) for group in kind.groups.values() for each in group]
        types[kind.id] = tuple(dict.fromkeys(pairs))
    taken: dict[TrackEnd, str] = {}
    for number, switch in enumerate(infra.switches):
        place = f"switches[{number}]"
        if switch.switch_type not in types:
            raise InputError(
                f"switch '{switch.id}' is of the type '{switch.switch_type}', which is not known",
                place=place,
                remedy=f"known are {', '.join(types)}; describe others in 'extended_switch_types'",
            )
        ends: dict[str, TrackEnd] = {}
        for port, each in switch.ports.items():
            end = ends[port] = TrackEnd(each.track, each.endpoint == "END")
            _track(tracks, each.track, f"{place}.ports.{port}")
            if taken.setdefault(end, switch.id) != switch.id:
                raise InputError(
                    f"the {each.endpoint} of track section '{each.track}' is at switch"
                    f" '{switch.id}' and at switch '{taken[end]}'",
                    place=f"{place}.ports.{port}",
                    remedy="a track ends at one of them",
                )
            graph.labels[end] = switch.id
        for pair in types[switch.switch_type]:
            for port in pair:
                if port not in ends:
                    raise InputError(
                        f"switch '{switch.id}' has no port '{port}'",
                        place=f"{place}.ports",
                        remedy=f"a {switch.switch_type} has one",
                    )
            graph.movements.append((ends[pair[0]], ends[pair[1]]))
        if switch.switch_type == "crossing":
            graph.account.left_out["crossings, whose tracks are unconnected"] += 1
