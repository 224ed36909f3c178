"""What the maps of a network know, as a table by edge."""

from __future__ import annotations

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import shown
from analysis.network.maps import NetworkMap
from trainlog.errors import InputError
from trainlog.presentation import (
    ADHESION,
    NUMBER,
    POSITION,
    Cell,
    Column,
    Ends,
    Said,
    WordTable,
    new_table,
)


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
        widths = np.diff(np.minimum(np.arange(track.bins + 1) * track.bin_length, track.length))
        for name, layer in track.layers.items():
            if layers and name not in layers:
                continue
            expected, seen = layer.expected(time), layer.observed
            observed = float(widths[seen].sum())
            share = f"{observed / 1e3:.1f} km, {observed / track.length:.0%}"
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
            trips = sum(trip["layer"] == name for trip in track.trips)
            table.add_cells(
                edge, name, trips, int(layer.events.sum()), Said(observed, share), *found
            )
    return table
