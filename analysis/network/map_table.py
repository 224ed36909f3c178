"""What the maps of a network know, as a table by edge."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import shown
from analysis.network.maps import NetworkMap
from trainlog.errors import InputError
from trainlog.presentation import WordTable, new_table


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
