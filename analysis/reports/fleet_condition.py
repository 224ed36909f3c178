"""The condition of the rail on all edges of a network, as a report shows it."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import pandas as pd

from analysis.adhesion.condition_table import bins_table, with_ends
from analysis.adhesion.map_plot import lowest_bins
from analysis.network.map_table import network_table
from analysis.network.maps import NetworkMap, map_files, two_maps
from analysis.reports.page import Part, Warned
from trainlog.display import counted
from trainlog.errors import TrainlogError
from trainlog.formats.condition import read_map
from trainlog.presentation import NUMBER, POSITION, Column, new_table
from trainlog.railway import Network, TrackConditionMap

MOST_PLACES = 10
"""Places that are listed of each rail condition."""


class KnownMaps(NamedTuple):
    """Maps of edges by the evidence of the days before a time.

    Attributes
    ----------
    maps : NetworkMap
    at : Timestamp
    nothing : str
        Why nothing is known; empty where something is.
    bad : list of str
        Maps that could not be used, and why.
    bins : DataFrame
        Rows of `bins_table` of all of them.
    """

    maps: NetworkMap
    at: pd.Timestamp
    nothing: str
    bad: list[str]
    bins: pd.DataFrame


def known_maps(
    folder: Path, network: Network | None = None, at: pd.Timestamp | None = None
) -> KnownMaps:
    """The maps of all edges in a folder.

    Parameters
    ----------
    folder : Path
        As `trainlog fleet update` keeps them: a file an edge.
    network : Network, optional
        On which they are drawn.
    at : Timestamp, optional
        Only evidence of days before its day counts (UTC). Default: right after the last evidence.
    """
    paths = map_files(folder)
    read, bad = dict[str, tuple[TrackConditionMap, Path]](), list[str]()
    several = set[str]()
    for path in paths:
        try:
            track = read_map(path)
        except TrainlogError as error:
            bad.append(f"{path.name} could not be read: {error}.")
            continue
        if track.line in read:
            several.add(track.line)
            bad.append(f"{two_maps(track.line, read[track.line][1], path)}; left out.")
        read[track.line] = track, path
    tracks = {edge: track for edge, (track, _) in read.items() if edge not in several}
    last = max((int(each.days.max(initial=-1)) for each in tracks.values()), default=-1)
    at = pd.Timestamp(last + 1, unit="D", tz="UTC") if at is None else at
    maps = NetworkMap(folder, network, tracks).known_before(at)
    tables = [
        bins_table(each, None, at).assign(line=edge)
        for edge, each in maps.maps.items()
        if each.layers
    ]
    before = f" of days before {at:%Y-%m-%d}" if 0 <= at.timestamp() // 86_400 <= last else ""
    nothing = "" if tables else f"The maps hold no evidence{before} yet."
    if not paths:
        nothing = "No trip's evidence is in a map yet: 'trainlog fleet update' adds it."
    return KnownMaps(maps, at, nothing, bad, pd.concat([*tables, pd.DataFrame()]))


def condition_parts(known: KnownMaps) -> list[Part]:
    """What is expected of the rail, where, and how sure that is."""
    bad: list[Part] = [Warned(each) for each in known.bad]
    if known.nothing:
        return [*bad, known.nothing]
    maps, at = known.maps, known.at
    return [
        *bad,
        f"What is expected on {at:%Y-%m-%d %H:%M} UTC, by the maps of"
        f" {counted(len(maps.maps), 'edge')}, on each condition of the rail. Where nothing was"
        " observed the maps have no estimate.",
        *maps.charts(at=at),
        network_table(maps, at),
        *(part for layer in maps.layers for part in lowest_parts(known.bins, layer)),
    ]


def lowest_parts(bins: pd.DataFrame, layer: str) -> list[Part]:
    """The places with the least adhesion to count on, and how many are not listed."""
    table = new_table(
        f"Lowest adhesion to count on, condition of the rail: {layer}", Column("edge", of="line"),
        Column("chainage on the edge", POSITION, "position",
               of=lambda row: 0.5 * (row["start_m"] + row["end_m"])),
        with_ends("expected", "expected"), Column("onsets", NUMBER, of="events"),
        name=f"lowest_{layer}",
    )  # fmt: skip
    rows = lowest_bins(bins[bins["layer"] == layer], len(bins))
    table.add_rows(rows.head(MOST_PLACES).to_dict("records"))
    more = len(rows) - MOST_PLACES
    words = f"{counted(more, 'more place')} apart from these: no lower than these."
    return [table, *[words] * (more > 0)]
