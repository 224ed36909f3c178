"""The condition of the rail on all edges of a network, as a report shows it."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import bins_table
from analysis.network.maps import map_files, two_maps
from analysis.reports.page import Part, Warned
from analysis.reports.pictures import drawn
from trainlog.condition import known_before
from trainlog.display import counted
from trainlog.errors import TrainlogError
from trainlog.formats.condition import read_map
from trainlog.presentation import NUMBER, POSITION, SHARE, Column, Quantity, WordTable, new_table
from trainlog.railway import Network, TrackConditionMap

ADHESION = Quantity("", "", 1.0, 3)

MOST_PLACES = 10
"""Places that are listed of each rail condition."""

APART = 500.0
"""Two places that are listed lie at least so far from each other on their edge [m]."""


def condition_parts(
    folder: Path, network: Network | None = None, at: pd.Timestamp | None = None
) -> list[Part]:
    """Maps of all edges in a folder: what is expected at a time, where, and how sure that is.

    Parameters
    ----------
    folder : Path
        As `trainlog fleet update` keeps them: a file an edge.
    network : Network, optional
        On which it is drawn.
    at : Timestamp, optional
        Only evidence of days before its day counts (UTC). Default: right after the last evidence.
    """
    paths = map_files(folder)
    if not paths:
        return ["No trip's evidence is in a map yet: 'trainlog fleet update' adds it."]
    read, bad = dict[str, tuple[TrackConditionMap, Path]](), list[Part]()
    several = set[str]()
    for path in paths:
        try:
            track = read_map(path)
        except TrainlogError as error:
            bad.append(Warned(f"{path.name} could not be read: {error}."))
            continue
        if track.line in read:
            several.add(track.line)
            bad.append(Warned(f"{two_maps(track.line, read[track.line][1], path)}; left out."))
        read[track.line] = track, path
    tracks = [track for edge, (track, _) in read.items() if edge not in several]
    last = max(
        (
            int(layer.evidence.days.max(initial=-1))
            for track in tracks
            for layer in track.layers.values()
        ),
        default=-1,
    )
    if at is None:
        at = pd.Timestamp(last + 1, unit="D", tz="UTC")
    day = at.timestamp() // 86_400
    tracks = [known_before(each, at) for each in tracks if each.days.size and each.days[0] < day]
    tables = [
        bins_table(track, None, at).assign(edge=track.line) for track in tracks if track.layers
    ]
    if not tables:
        before = f" of days before {at:%Y-%m-%d}" if 0 <= day <= last else ""
        return [*bad, f"The maps hold no evidence{before} yet."]
    bins = pd.concat(tables, ignore_index=True)
    layers = sorted(bins["layer"].unique())
    span = (0.0, max(0.3, float(bins["expected"].max(skipna=True))))
    parts: list[Part] = [*bad, f"What is expected on {at:%Y-%m-%d %H:%M} UTC, by the maps of"
                         f" {counted(len(tracks), 'edge')}, on each condition of the rail. Where"
                         " nothing was observed the maps have no estimate"
                         + (", and the network is drawn in grey." if network else ".")]  # fmt: skip
    for layer in layers:
        rows = bins[bins["layer"] == layer]
        if network is not None and rows["expected"].notna().any():
            parts.append(_drawn(network, layer, rows, span))
    return [
        *parts,
        _observed(bins),
        *(part for layer in layers for part in lowest_places(bins, layer)),
    ]


def _drawn(network: Network, layer: str, rows: pd.DataFrame, span: tuple[float, float]) -> Part:
    from analysis.network.plot import AlongEdge, draw_network

    shown: Mapping[str, AlongEdge] = {
        str(edge): AlongEdge(
            np.append(part["start_m"].to_numpy(np.float64), float(part["end_m"].iloc[-1])),
            part["expected"].to_numpy(np.float64),
        )
        for edge, part in rows.groupby("edge", sort=True)
    }
    unseen = {
        edge.name: AlongEdge(np.array([0.0, edge.line.length]), np.array([np.nan]))
        for edge in network.edges
        if edge.name not in shown
    }
    draw = partial(
        draw_network, network, shown={**shown, **unseen}, label="expected maximum adhesion",
        title=f"condition of the rail: {layer}", span=span,
    )  # fmt: skip
    return drawn(
        lambda path: draw(path),
        f"The network, coloured by the maximum adhesion that is expected on {layer} rail.",
    )


def _observed(bins: pd.DataFrame) -> WordTable:
    table = new_table(
        "Maps of the edges", "edge", "rail", Column("observed", SHARE), Column("onsets", NUMBER),
        Column("lowest expected", ADHESION, "lowest"), name="maps",
    )  # fmt: skip
    for (edge, layer), part in bins.groupby(["edge", "layer"], sort=True):
        expected = part["expected"].to_numpy(np.float64)
        known = np.isfinite(expected)
        table.add_cells(
            str(edge), str(layer), float(known.mean()), float(part["events"].sum()),
            float(expected[known].min()) if known.any() else None,
        )  # fmt: skip
    return table


def lowest_places(bins: pd.DataFrame, layer: str) -> list[Part]:
    """The places with the least expected adhesion, each once, and how many are not listed."""
    table = new_table(
        f"Lowest expected, condition of the rail: {layer}", "edge",
        Column("chainage on the edge", POSITION, "position"),
        Column("expected", ADHESION), "95 % band", Column("onsets", NUMBER),
        name=f"lowest_{layer}",
    )  # fmt: skip
    rows = bins[(bins["layer"] == layer) & bins["expected"].notna()].sort_values("expected")
    taken: list[tuple[str, float]] = []
    band = "{expected_low:.3f} to {expected_high:.3f}"
    for row in rows.to_dict("records"):
        middle = 0.5 * (row["start_m"] + row["end_m"])
        near = (edge == row["edge"] and abs(middle - place) < APART for edge, place in taken)
        if any(near):
            continue
        taken.append((row["edge"], middle))
        if len(taken) <= MOST_PLACES:
            table.add_cells(
                row["edge"], middle, row["expected"], band.format_map(row), float(row["events"])
            )
    more = len(taken) - MOST_PLACES
    if more <= 0:
        return [table]
    return [table, f"{counted(more, 'more place')}, each {APART:.0f} m or more from all others, not"
                   " listed: no lower than these."]  # fmt: skip
