"""Scores of the maps of a network: each day from the days before, or on later trips."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from analysis.network.maps import LogOnEdges, NetworkMap
from analysis.verification.scoring import (
    LeftOut,
    Score,
    counted_once,
    refusal,
    score_map_on,
    score_rolling,
)
from analysis.verification.verify import Forecaster, Verification
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.files import sha256_of

if TYPE_CHECKING:
    from analysis.adhesion.evidence import Evidence
    from trainlog.railway.weather import Weather


def score_network(
    maps: NetworkMap,
    layers: list[str] | None = None,
    report: Callable[[int, int], None] | None = None,
    forecasters: Mapping[str, Forecaster] | None = None,
) -> tuple[Score, dict[str, Score]]:
    """Score what the maps of a network would have expected of each day from the days before alone.

    Parameters
    ----------
    maps : NetworkMap
    layers : list of str, optional
        Rail conditions to score; default: all.
    report : callable, optional
        Called with the number of edges done and that of all.
    forecasters : mapping of str to callable, optional
        By edge, what forecasts; default: its map from the days before.

    Returns
    -------
    whole : Score
        Of all edges together, added up by day: its bands are of days, as weather is alike on all.
    edges : dict of str to Score
        By edge, those that have evidence of two days.

    Raises
    ------
    InputError
        If no edge has evidence of two days.
    """
    found: dict[str, Score] = {}
    short = []
    for number, (name, track) in enumerate(maps.maps.items(), start=1):
        chosen = None if layers is None else [each for each in layers if each in track.layers]
        if track.days.size < 2 or chosen == []:
            short.append(name)
        else:
            forecaster = None if forecasters is None else forecasters[name]
            found[name] = score_rolling(track, chosen, None, forecaster)
        if report is not None:
            report(number, len(maps.maps))
    if not found:
        raise InputError(
            "no edge has evidence of two days: no day can be forecast from the days before",
            file=maps.folder,
            remedy="count in trips of several days",
        )
    limits = [f"{counted(len(short), 'edge')} without evidence of two days: not scored"] * bool(
        short
    )
    return _whole(maps, "the maps, day by day", found, limits), found


def score_network_on(
    maps: NetworkMap,
    logs: Iterable[str | Path],
    layer: str | None = None,
    weather: Weather | None = None,
) -> tuple[Score, dict[str, Score]]:
    """Score the maps of a network on later trips, each edge that a trip ran over by its own map.

    Trips of days of which an edge's map holds evidence are left out there. A trip that cannot be
    used on one edge is refused there alone.

    Parameters
    ----------
    maps : NetworkMap
    logs : iterable of path
    layer : str, optional
        Rail condition of the trips; default: what each states of the edge.
    weather : Weather, optional
        Condition of trips that state none.

    Returns
    -------
    whole : Score
        Of all edges together, added up by day.
    edges : dict of str to Score

    Raises
    ------
    InputError
        If there is no later trip on an edge with a map.
    """
    pieces: dict[str, list[Evidence]] = {}
    refused: list[str] = []
    digests: set[str] = set()
    stated: dict[str, str] = {}
    without: dict[str, int] = {}
    for path in map(Path, logs):
        try:
            digest = sha256_of(path)
            if digest in digests:
                continue
            digests.add(digest)
            given = LogOnEdges(path, maps.network)
            edges = given.edges
            if layer is not None:
                stated[digest] = given.trip.metadata.get("weather", "")
        except TrainlogError as error:
            refused.append(refusal(error, path))
            continue
        for edge in edges:
            track = maps.maps.get(edge.name)
            if track is None:
                without[edge.name] = without.get(edge.name, 0) + 1
                continue
            try:
                piece = given.evidence_on(edge, track, layer, weather, digest)
            except TrainlogError as error:
                refused.append(f"edge '{edge.name}': {refusal(error, path)}")
            else:
                pieces.setdefault(edge.name, []).append(piece)
    limits = [
        f"edge '{name}' has no map: {counted(count, 'trip')} not scored there"
        for name, count in sorted(without.items())
    ]
    found: dict[str, Score] = {}
    for name, some in sorted(pieces.items()):
        trips = counted_once(maps.maps[name], some, [], stated, layer)
        try:
            found[name] = score_map_on(maps.maps[name], trips)
        except InputError as error:
            limits.append(f"edge '{name}': {error.problem}")
    if not found:
        why = [*limits, *refused]
        raise InputError(
            "no later trip on an edge with a map" + (f": {'; '.join(why[:4])}" if why else ""),
            file=maps.folder,
            remedy="give logs of trips of days that the maps do not hold",
        )
    return _whole(maps, "the maps", found, limits, refused), found


def _whole(
    maps: NetworkMap,
    name: str,
    found: Mapping[str, Score],
    limits: Iterable[str],
    refused: Iterable[str] = (),
) -> Score:
    """All edges together, added up by day and rail condition."""
    names = sorted({each for score in found.values() for each in score.layers} - {"all"})
    pooled = {
        layer: Verification.together(
            {edge: each.layers[layer] for edge, each in found.items() if layer in each.layers}
        )
        for layer in [*names, "all"]
    }
    network = maps.network.name if maps.network is not None else maps.folder.name
    left_out: dict[LeftOut, None] = {}
    for score in found.values():
        left_out |= dict.fromkeys(score.left_out)
    own = {f"edge '{edge}': {words}": None for edge, each in found.items() for words in each.limits}
    return Score(
        f"network {network}",
        name,
        pooled,
        tuple(left_out),
        tuple(refused),
        (*limits, *own),
        {edge: each.layers["all"] for edge, each in found.items()},
    )
