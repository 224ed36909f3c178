"""What the maps of a network know: a table by edge, and the network drawn by expected adhesion."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import shown
from analysis.network.maps import NetworkMap
from analysis.network.plot import AlongEdge, draw_network
from trainlog.errors import InputError
from trainlog.presentation import WordTable, new_table
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.network import Network

PIECES, LEAST_PIECE = 200.0, 100.0
"""Of the length of a network in a picture, and how long they are at least [m]: what is shorter
cannot be seen."""


def network_rows(
    maps: NetworkMap, time: pd.Timestamp | None = None, layers: list[str] | None = None
) -> list[dict[str, Any]]:
    """A row an edge and rail condition, in SI units, in the order of the network's edges.

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
    order = list(maps.maps)
    if maps.network is not None:
        order = [edge.name for edge in maps.network.edges]
    rows = []
    for edge in order:
        track = maps.maps.get(edge)
        if track is None:
            rows.append({"edge": edge, "layer": None, "trips": 0})
            continue
        for name, layer in track.layers.items():
            if layers and name not in layers:
                continue
            expected, seen = layer.expected(time), layer.observed
            widths = np.diff(np.minimum(np.arange(track.bins + 1) * track.bin_length, track.length))
            row: dict[str, Any] = {
                "edge": edge,
                "layer": name,
                "trips": sum(trip["layer"] == name for trip in track.trips),
                "onsets": int(layer.events.sum()),
                "observed_m": float(widths[seen].sum()),
                "length_m": track.length,
            }
            if seen.any():
                middle = expected.log_mean
                _, *ends = shown(expected)
                lowest = int(np.flatnonzero(seen)[np.argmin(middle[seen])])
                row |= {
                    "expected": float(np.exp(np.mean(middle[seen]))),
                    "lowest": float(np.exp(middle[lowest])),
                    "lowest_at_m": float(track.centres[lowest]),
                    "lowest_band": [float(each[lowest]) for each in ends],
                }
            rows.append(row)
    return rows


def network_table(maps: NetworkMap, rows: list[dict[str, Any]]) -> WordTable:
    """The rows of `network_rows` as a table."""
    name = maps.network.name if maps.network is not None else maps.folder.name
    table = new_table(
        f"Track condition of network {name}",
        "edge", "rail\ncondition", "trips", "onsets\nmeasured", "observed",
        "expected\nadhesion", "lowest (95 % band)",
    )  # fmt: skip
    for row in rows:
        if row["layer"] is None:
            table.add_row(row["edge"], "-", "0", "0", "nothing", "-", "-")
            continue
        lowest = "-"
        if "lowest" in row:
            low, high = row["lowest_band"]
            place = f"km {row['lowest_at_m'] / 1e3:.3f}"
            lowest = f"{row['lowest']:.3f} ({low:.3f} to {high:.3f}) at {place}"
        table.add_row(
            row["edge"],
            row["layer"],
            str(row["trips"]),
            str(row["onsets"]),
            f"{row['observed_m'] / 1e3:.1f} km, {row['observed_m'] / row['length_m']:.0%}",
            f"{row['expected']:.3f}" if "expected" in row else "-",
            lowest,
        )
    return table


def draw_network_map(
    maps: NetworkMap,
    path: str | Path,
    *,
    time: pd.Timestamp | None = None,
    layer: str | None = None,
    network: Network | None = None,
) -> None:
    """Draw a network by the adhesion that is expected along its edges; the surer, the wider.

    Parameters
    ----------
    maps : NetworkMap
    path : path
        PNG or SVG.
    time : Timestamp, optional
        Default: right after the last evidence.
    layer : str, optional
        Rail condition; default: the one in which most was measured.
    network : Network, optional
        Default: that of the folder.

    Raises
    ------
    InputError
        If the network is not known, or no edge has the layer.
    """
    network = network or maps.network
    if network is None:
        raise InputError(
            "the folder does not state the network, which gives the picture its shape",
            file=maps.folder,
            remedy="give it once with 'trainlog map update --network NETWORK'",
        )
    if layer is None:
        measured = {
            name: sum(t.layers[name].events.sum() for t in maps.maps.values() if name in t.layers)
            for name in maps.layers
        }
        layer = max(measured, key=lambda name: (measured[name], name), default="dry")
    piece = max(network.length / PIECES, LEAST_PIECE)
    shown = {
        name: _along(track, layer, time, piece)
        for name, track in maps.maps.items()
        if layer in track.layers
    }
    if not shown:
        raise InputError(
            f"no edge has a layer '{layer}'",
            file=maps.folder,
            remedy=f"layers there are: {', '.join(maps.layers) or 'none'}",
        )
    when = "" if time is None else f" on {time:%Y-%m-%d %H:%M} UTC"
    draw_network(
        network,
        path,
        shown=shown,
        label="lowest expected adhesion",
        title=f"{network.name}: expected adhesion, {layer} rail{when}; pieces of {piece:.0f} m,"
        " the surer the wider; grey: not observed",
    )


def _along(
    track: TrackConditionMap, layer: str, time: pd.Timestamp | None, piece: float
) -> AlongEdge:
    """The lowest expected adhesion of each piece [m] of an edge, where it was observed."""
    expected = track.layer(layer).expected(time)
    certainty = 1.0 - expected.log_std / max(track.settings.get("prior_std", 0.4), 1e-9)
    each = max(round(piece / track.bin_length), 1)
    starts = np.arange(0, track.bins, each)
    lowest = np.where(expected.observed, expected.maximum_adhesion, np.inf)
    values = np.minimum.reduceat(lowest, starts)
    sure = np.maximum.reduceat(np.where(expected.observed, certainty, 0.0), starts)
    bounds = np.minimum(np.append(starts, track.bins) * track.bin_length, track.length)
    return AlongEdge(bounds, np.where(np.isfinite(values), values, np.nan), sure.clip(0.0, 1.0))
