"""Maps of the track condition of a network: a folder with one map an edge.

What a trip on a route shows counts on each edge that it ran over, by the edge's own chainage,
whichever way it ran. Such a folder is kept as a single map is: trips are added as they come, each
once, by several processes if need be, and whatever interrupts an update, the next one goes on.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar
from urllib.parse import quote

import numpy as np
import pandas as pd
from numpy.typing import NDArray

from analysis.adhesion.condition_map import (
    FileUpdate,
    LogOutcome,
    MapUpdate,
    known_layers,
    outcomes_of,
    refusal_of,
)
from analysis.adhesion.condition_table import shown
from analysis.adhesion.map_state import summary
from trainlog.condition import estimated, known_before
from trainlog.display import counted
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.declared import thing_to_bytes
from trainlog.formats.files import made_folder, read_bytes, sha256, sha256_of, write_bytes
from trainlog.formats.mapfile import MapFile, read_map
from trainlog.formats.railway import network_from_bytes
from trainlog.presentation import (
    ADHESION,
    NUMBER,
    POSITION,
    Cell,
    Column,
    Ends,
    Presented,
    Said,
    WordTable,
    new_table,
)
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.line import Leg, Line
from trainlog.railway.network import Network
from trainlog.railway.weather import given_condition

if TYPE_CHECKING:
    from analysis.adhesion.evidence import Evidence
    from analysis.network.edges import EdgeOfLine
    from trainlog.identity import TripIdentity
    from trainlog.railway.condition import AdhesionForecast
    from trainlog.railway.weather import Weather

NETWORK_FILE = "network.json"
"""In a folder of maps: the network that they are of."""

SUFFIX = ".map"


def edge_stem(edge: str) -> str:
    """The name of an edge's files, without ending.

    It is the edge's name. Characters that names of files cannot have are replaced, and a digest
    of the whole name is appended then, so that no two edges share a file.

    Examples
    --------
    >>> edge_stem("850 Wil - Gossau"), edge_stem("850 Wil/Gossau")
    ('850 Wil - Gossau', '850 Wil_Gossau 4d0db3ee')
    """
    plain = "".join("_" if each in '/\\:*?"<>|\0' else each for each in edge).lstrip(".")
    return plain if plain == edge else f"{plain} {sha256(edge.encode())[:8]}"


def edge_map_path(folder: str | Path, edge: str) -> Path:
    """The file of an edge's map in a folder; one that an earlier version named stays in use.

    Raises
    ------
    InputError
        If the folder holds both.

    Examples
    --------
    >>> edge_map_path("maps", "850 Wil - Gossau").name
    '850 Wil - Gossau.map'
    """
    path = Path(folder) / f"{edge_stem(edge)}{SUFFIX}"
    earlier = path.with_name(f"{quote(edge, safe=' ()+,')}{SUFFIX}")
    if earlier == path or not earlier.is_file():
        return path
    if path.is_file():
        raise _two_maps(edge, earlier, path)
    return earlier


def _two_maps(edge: str, first: Path, second: Path) -> InputError:
    """That two files of a folder are maps of one edge."""
    return InputError(
        f"edge '{edge}' has two maps, '{first.name}' and '{second.name}'",
        file=first.parent,
        remedy="make one of them with 'trainlog map merge', and take both out of the folder",
    )


@dataclass(frozen=True, eq=False, repr=False)
class NetworkMap(Presented):
    """Maximum adhesion along the edges of a network.

    Attributes
    ----------
    folder : Path
    network : Network or None
        None: the folder does not state it; then routes are taken as their lines state them.
    maps : dict of str to TrackConditionMap
        By edge; an edge without a map was not observed.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     updated = update_network_map("sample_logs/nonstop.mcap", folder)
    ...     network_map(folder)
    Track-condition maps of 1 edge
      CH_StGallen_Wil  1 trip: dry
    """

    folder: Path
    network: Network | None
    maps: Mapping[str, TrackConditionMap]

    charts_by: ClassVar[str] = "analysis.network.plot:network_map_charts"

    @property
    def title(self) -> str:
        """How many edges of which network have a map."""
        named = f" of network '{self.network.name}'" if self.network is not None else ""
        of_all = f" of {len(self.network.edges)}" if self.network is not None else ""
        return f"Track-condition maps of {counted(len(self.maps), 'edge')}{of_all}{named}"

    def summary(self) -> dict[str, str]:
        """Trips and layers of the first edges."""
        rows = {
            name: f"{counted(len(track.trips), 'trip')}: {', '.join(track.layers)}"
            for name, track in list(self.maps.items())[:6]
        }
        return rows | ({"...": f"{len(self.maps) - 6} more"} if len(self.maps) > 6 else {})

    def tables(self) -> list[WordTable]:
        """A row per edge and rail condition."""
        return [network_table(self)]

    @property
    def layers(self) -> tuple[str, ...]:
        """Rail conditions that some edge has evidence of."""
        return tuple(sorted({name for track in self.maps.values() for name in track.layers}))

    def known_before(self, time: pd.Timestamp) -> NetworkMap:
        """The maps as they were known then: of the evidence of the days before.

        Edges without any are left out.
        """
        kept = {}
        for name, track in self.maps.items():
            if track.days.size and track.days[0] < time.timestamp() // 86_400:
                kept[name] = known_before(track, time)
        return replace(self, maps=kept)

    def along(self, line: Line) -> TrackConditionMap:
        """The map along a route's line, or a line that is an edge itself.

        It is made of the evidence of the edges that the line runs over, each bin of an edge at the
        bin of the line that holds its middle: places are right to half a bin. Edges without a map
        stay unobserved.

        Raises
        ------
        InputError
            If no edge of the line has a map, or maps differ in their bins.
        """
        return map_along(line, self.maps)


def network_map(folder: str | Path) -> NetworkMap:
    """Read a folder of maps, one an edge.

    Raises
    ------
    InputError
        If it is no folder with maps, one of them cannot be read, or two are of one edge.

    Examples
    --------
    >>> network_map("docs")
    Traceback (most recent call last):
    trainlog.errors.InputError: docs: has no track-condition maps (*.map); ...
    """
    place = Path(folder)
    files = map_files(place)
    if not files:
        raise InputError(
            f"has no track-condition maps (*{SUFFIX})",
            file=place,
            remedy="add trips with 'trainlog map update LOGS --network NETWORK --map FOLDER'",
        )
    maps, problems = maps_in(files)
    if problems:
        raise problems[0]
    return NetworkMap(place, _network_of(place), maps)


def maps_in(files: Iterable[Path]) -> tuple[dict[str, TrackConditionMap], list[TrainlogError]]:
    """The maps in files by edge, and what cannot be used: files, and edges with two maps."""
    found: dict[str, TrackConditionMap | None] = {}
    places, problems = dict[str, Path](), list[TrainlogError]()
    for path in files:
        try:
            track = read_map(path)
        except TrainlogError as error:
            problems.append(error)
            continue
        if track.line in places:
            problems.append(_two_maps(track.line, places[track.line], path))
        found[track.line] = None if track.line in places else track
        places[track.line] = path
    return {edge: track for edge, track in found.items() if track is not None}, problems


def map_files(folder: Path) -> list[Path]:
    """The maps in a folder, without those that are being written."""
    return sorted(folder.glob(f"[!.]*{SUFFIX}")) if folder.is_dir() else []


def _network_of(folder: Path) -> Network | None:
    path = folder / NETWORK_FILE
    return network_from_bytes(read_bytes(path), file=path) if path.is_file() else None


def network_table(
    maps: NetworkMap, time: pd.Timestamp | None = None, layers: list[str] | None = None
) -> WordTable:
    """A row per edge and rail condition, in the order of the network's edges.

    Parameters
    ----------
    maps : NetworkMap
    time : Timestamp, optional
        At which adhesion is expected; default: right after the last evidence.
    layers : list of str, optional
        Default: all.

    Raises
    ------
    InputError
        If no edge has a rail condition that is named.
    """
    for name in layers or []:
        if name not in maps.layers:
            raise InputError(
                f"no edge has a layer '{name}'",
                file=maps.folder,
                remedy=f"layers there are: {', '.join(maps.layers) or 'none'}",
            )
    network = maps.network
    name = network.name if network is not None else maps.folder.name
    table = new_table(
        f"Track condition of network {name}",
        Column("edge"),
        Column("rail\ncondition", key="layer"),
        Column("trips", NUMBER),
        Column("onsets\nmeasured", NUMBER, key="onsets"),
        Column("observed", POSITION),
        Column("expected\nadhesion", ADHESION, key="expected"),
        Column("lowest (95 % band)", ADHESION, key="lowest"),
        Column("lowest at", POSITION),
        name="edges",
    )
    for edge in maps.maps if network is None else [each.name for each in network.edges]:
        track = maps.maps.get(edge)
        if track is None:
            table.add_cells(edge, None, 0, 0, Said(0.0, "nothing"), None, None, None)
            continue
        for each in summary(track, 0):
            if layers and each.layer not in layers:
                continue
            layer = track.layer(each.layer)
            expected, seen = layer.expected(time), layer.observed
            share = each.observed_length / track.length
            observed = Said(
                each.observed_length, f"{each.observed_length / 1e3:.1f} km, {share:.0%}"
            )
            found: tuple[Cell, ...] = (None, None, None)
            if seen.any():
                middle = expected.log_mean
                lowest = int(np.flatnonzero(seen)[np.argmin(middle[seen])])
                _, low, high = (float(each[lowest]) for each in shown(expected))
                found = (
                    float(np.exp(np.mean(middle[seen]))),
                    Ends(float(np.exp(middle[lowest])), low, high),
                    float(track.centres[lowest]),
                )
            table.add_cells(edge, each.layer, each.trips, each.events, observed, *found)
    return table


def map_along(line: Line, maps: Mapping[str, TrackConditionMap]) -> TrackConditionMap:
    """The map along a line of the maps of the edges that it runs over; see `NetworkMap.along`.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (trainlog.Node("St. Gallen"), trainlog.Node("Wil"))
    >>> edge = trainlog.Edge("850", line, "St. Gallen", "Wil")
    >>> route = trainlog.Network("one", nodes, (edge,)).route("Wil", "Gossau SG").line
    >>> known = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> found = map_along(route, {"850": known})
    >>> found.line, bool(found.layer("wet").events.sum() < known.layer("wet").events.sum())
    ('Wil - Gossau SG', True)
    """
    legs = line.legs or (Leg(line.name, 0.0, line.length, 0.0, line.length, line.length),)
    used = [leg for leg in legs if leg.edge in maps]
    if not used:
        named = ", ".join(f"'{leg.edge}'" for leg in legs[:3])
        raise InputError(
            f"there is no map of an edge of line '{line.name}' ({named})",
            remedy=f"maps there are of {', '.join(sorted(maps)[:4])}",
        )
    first = maps[used[0].edge]
    for leg in used:
        track = maps[leg.edge]
        if abs(track.length - leg.edge_length) > 1e-3:
            raise InputError(
                f"the map of edge '{leg.edge}' is of {track.length:.1f} m, the route's edge of"
                f" {leg.edge_length:.1f} m",
                remedy="give the maps of the network that the route was made of",
            )
        same = np.array_equal(track.levels, first.levels) and track.settings == first.settings
        if track.bin_length != first.bin_length or not same:
            raise InputError(
                f"the maps of edges '{used[0].edge}' and '{leg.edge}' differ in bins or settings",
                remedy="make both with the same settings",
            )
    whole = replace(first, line=line.name, length=line.length, layers={}, trips=())
    pieces: dict[str, list[DailyEvidence]] = {}
    trips: dict[tuple[str, str], dict[str, Any]] = {}
    for leg in used:
        track = maps[leg.edge]
        # By bin of the edge the bin of the line in which its middle lies; -1: not on the leg.
        middle = 0.5 * (track.edges[1:] + track.edges[:-1])
        low, high = sorted((leg.edge_start, leg.edge_end))
        there = (middle >= low) & (middle <= high)
        rows = np.where(there, whole.bin_of(leg.on_line(middle)), -1)
        for name, layer in track.layers.items():
            pieces.setdefault(name, []).append(_moved(layer.evidence, rows, whole.bins))
        for entry in track.trips:
            trips.setdefault((str(entry.get("sha256")), str(entry.get("layer"))), entry)
    layers = {
        name: ConditionLayer.unestimated(DailyEvidence.total(pieces[name]))
        for name in sorted(pieces)
    }
    return estimated(replace(whole, layers=layers, trips=tuple(trips.values())))


def _moved(evidence: DailyEvidence, rows: NDArray[Any], bins: int) -> DailyEvidence:
    """Evidence with its bins numbered anew; what is numbered -1 is left out."""
    kept = evidence.chosen(rows[evidence.bin] >= 0, rows[evidence.used_bin] >= 0)
    return replace(kept, bins=bins, bin=rows[kept.bin], used_bin=rows[kept.used_bin])


# ------------------------------------------------------------------------------------- update


def update_network_map(
    logs: str | Path | Iterable[str | Path],
    folder: str | Path,
    network: Network | None = None,
    layer: str | None = None,
    weather: Weather | None = None,
    *,
    retry: bool = False,
    report: Callable[[LogOutcome], None] | None = None,
) -> MapUpdate:
    """Add the trips of logs to the maps of a network's edges.

    As `analysis.update_map`, edge by edge: a trip is on the disk on all its edges when it is
    reported; an update that is interrupted between two of them adds the others when the log is
    given again. A trip on an ordinary line belongs to the edge of its name.

    Parameters
    ----------
    logs : path or iterable of paths
        Logs, and folders of logs.
    folder : path
        Of the maps; made if it is not there.
    network : Network, optional
        Which edges there are: a log on another is refused. Kept in the folder; default: the one
        that is there.
    layer, weather, retry, report
        As of `analysis.update_map`.

    Returns
    -------
    MapUpdate
        Of which `trips` are those of all edges, each once, on however many it counts.

    Raises
    ------
    InputError
        If a map cannot be read or written, the folder is of another network, or no log is given.
    """
    place = made_folder(folder)
    if layer is not None:
        layers = (each for path in map_files(place) for each in known_layers(path))
        layer = given_condition(layer, layers)
    known = _kept_network(place, network)
    edges: dict[str, FileUpdate] = {}
    try:
        options = (layer, weather, retry)
        outcomes = outcomes_of(
            logs, lambda log: _outcome(log, place, known, edges, options), report
        )
    finally:
        for each in edges.values():
            each.close()
    trips, days = _amount(place)
    return MapUpdate(place, outcomes, trips, days, made=trips > 0)


def _amount(folder: Path) -> tuple[int, int]:
    """How many trips the maps of a folder count, each once, and of how many days."""
    found: dict[str, set[int]] = {}
    for path in map_files(folder):
        with MapFile(path) as file:
            for trip, (first, last) in file.trip_days().items():
                found.setdefault(trip, set()).update(range(first, last + 1))
    return len(found), len(set().union(*found.values()))


def _kept_network(folder: Path, network: Network | None) -> Network | None:
    """The network of a folder, kept there if it is given for the first time."""
    before = _network_of(folder)
    if network is None:
        return before
    if before is None:
        write_bytes(folder / NETWORK_FILE, thing_to_bytes(network))
    elif thing_to_bytes(before) != thing_to_bytes(network):
        raise InputError(
            f"holds maps of network '{before.name}', which differs from the '{network.name}' given",
            file=folder,
            remedy="name another folder, or give the network that it was made with",
        )
    return network


class LogOnEdges:
    """A log that is added to the maps of its edges; it is analysed once at most."""

    def __init__(self, path: Path, network: Network | None) -> None:
        from analysis.adhesion.evidence import COVARIATE_TOPICS, own_line
        from analysis.network.edges import edges_of
        from trainlog.mcap import read_log

        self.path = path
        self.trip = read_log(path, topics=COVARIATE_TOPICS)
        self.line = own_line(self.trip)
        self.edges = edges_of(self.line)
        for edge in self.edges if network is not None else ():
            assert network is not None
            length = network.edge(edge.name).line.length
            if abs(length - edge.length) > 1e-3:
                raise InputError(
                    f"edge '{edge.name}' is {edge.length:.1f} m long in it, and {length:.1f} m in"
                    f" network '{network.name}'",
                    file=path,
                    remedy="record or ingest it with a route of this network",
                )

    @cached_property
    def pieces(self) -> list[Any]:
        """Slip analyses of the log, or of its parts."""
        from analysis.adhesion.evidence import slips_of
        from analysis.adhesion.slip import TOPICS
        from analysis.view import views_of

        return list(slips_of(views_of(self.path, TOPICS)))

    @cached_property
    def recorded(self) -> TripIdentity | None:
        """Which drive the log is of."""
        from trainlog.mcap.reader import identity_of_log

        return identity_of_log(self.path)

    def evidence_on(
        self,
        edge: EdgeOfLine,
        track: TrackConditionMap,
        layer: str | None,
        weather: Weather | None,
        digest: str,
    ) -> Evidence:
        """What the trip showed on an edge, in the bins of its map."""
        from analysis.adhesion.evidence import condition_of, with_details
        from analysis.network.edges import on_edge

        of_line = replace(track, line=self.line.name, length=self.line.length)
        # What the recording lacks goes before a rail condition that is not stated.
        parts = [on_edge(piece, edge) for piece in self.pieces]
        condition = condition_of(self.trip, of_line, layer, weather, edge=edge.name)
        parts = [part for part in parts if part.time.size]
        if not parts:
            raise LogError(
                f"trip '{self.trip.name}' was not recorded on edge '{edge.name}' of its route",
                remedy="give trips that were recorded on it",
            )
        found = with_details(parts, self.trip, track, condition, weather, sha256=digest,
                             recorded=self.recorded)  # fmt: skip
        name = self.trip.name if edge.whole else f"{self.trip.name}@{edge.name}"
        return replace(found, trip=name)


def _outcome(
    log: Path,
    folder: Path,
    network: Network | None,
    edges: dict[str, FileUpdate],
    options: tuple[str | None, Weather | None, bool],
) -> LogOutcome:
    """What became of a log on all its edges."""
    try:
        given = LogOnEdges(log, network)
    except TrainlogError as error:
        return LogOutcome(str(log), "refused", reason=refusal_of(error, log))
    found: list[LogOutcome] = []
    digest = sha256_of(log)
    for edge in given.edges:
        update = edges.get(edge.name)
        if update is None:
            update = FileUpdate(edge_map_path(folder, edge.name), *options, edge.name)
            edges[edge.name] = update
        found.append(update.outcome(log, digest, given))
    return _of_all(found)


def _of_all(found: list[LogOutcome]) -> LogOutcome:
    """One outcome of those on the edges: the first of these that one of them has."""
    for outcome in ("added", "same drive", "held", "refused", "not recorded", "refused before"):
        those = [each for each in found if each.outcome == outcome]
        if those:
            trip = those[0].trip.partition("@")[0]
            replaced = tuple(dict.fromkeys(name for each in those for name in each.replaced))
            return replace(those[0], trip=trip, replaced=replaced)
    raise AssertionError("a log has an edge")


# ---------------------------------------------------------------------------------- forecast


def forecasts_of_network(
    maps: NetworkMap,
    time: pd.Timestamp | None = None,
    layer: str | None = None,
    hours: float = 24.0,
) -> tuple[pd.Timestamp, dict[str, AdhesionForecast]]:
    """What the maps of a network expect at a time, by the name of each edge's forecast file.

    Parameters
    ----------
    maps : NetworkMap
    time : Timestamp, optional
        Default: the day after the last evidence of all edges.
    layer : str, optional
        Rail condition; default: all.
    hours : float

    Raises
    ------
    InputError
        If no edge has evidence of a day before.
    """
    from analysis.verification.forecasts import first_free, forecast_of

    when = time or max(first_free(track) for track in maps.maps.values() if track.days.size)
    found = {}
    for name, track in maps.known_before(when).maps.items():
        if layer is None or layer in track.layers:
            found[f"{edge_stem(name)}.csv"] = forecast_of(track, when, layer=layer, hours=hours)
    if not found:
        raise InputError(
            f"no edge has evidence of a day before {when:%Y-%m-%d}"
            + ("" if layer is None else f" in rail condition '{layer}'"),
            file=maps.folder,
            remedy="ask for a later time",
        )
    return when, found
