"""A track-condition map as a table for people."""

from __future__ import annotations

from rich.console import Group

from analysis.adhesion.condition_map import summary
from analysis.tables import new_table
from trainlog.railway import TrackConditionMap


def map_table(track: TrackConditionMap) -> Group:
    """What a track-condition map knows, layer by layer, with its lowest spots."""
    title = f"Track condition of {track.line}, {track.bin_length:.0f} m bins"
    lowest = "lowest maximum adhesion (95 % band)"
    table = new_table(title, "rail", "trips", "slip events", "observed", lowest)
    for layer in summary(track):
        spots = [
            f"km {spot.position / 1e3:.3f}: {spot.adhesion:.3f} ({spot.low:.3f} to {spot.high:.3f})"
            for spot in layer.lowest
        ]
        share = layer.observed_bins / layer.bins
        table.add_row(
            layer.layer,
            str(layer.trips),
            str(layer.events),
            f"{layer.observed_length / 1e3:.1f} km, {share:.0%}",
            "\n".join(spots) or "nothing observed",
        )
    return Group(table, "Elsewhere demand never met the limit: there the map says nothing.")
