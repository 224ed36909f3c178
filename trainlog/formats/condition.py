"""The track-condition map's file; docs/formats.md has its tables.

It holds evidence. The estimate is a function of evidence and settings (`trainlog.condition`): it is
made on reading, or taken from the file where an earlier reader kept it.
"""

from __future__ import annotations

from contextlib import suppress
from dataclasses import asdict, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from trainlog.condition import estimated
from trainlog.errors import InputError
from trainlog.formats.files import check_written, write_bytes
from trainlog.formats.mapfile import MapFile, whole_file
from trainlog.formats.packed import pack, unpack
from trainlog.formats.recordings import place_of
from trainlog.railway.condition import (
    ConditionChange,
    ConditionLayer,
    ConditionModel,
    ModelParameter,
    PassingSpot,
    TrackConditionMap,
)
from trainlog.railway.evidence import DailyEvidence
from trainlog.version import code_version_of

_LISTED: dict[str, Any] = {"spots": PassingSpot, "changes": ConditionChange}


def map_from_bytes(data: bytes, *, file: str | Path = "track.map") -> TrackConditionMap:
    """The track-condition map in the bytes of a map file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a map file, naming the place and the remedy.

    Examples
    --------
    >>> from trainlog.formats.files import read_bytes
    >>> map_from_bytes(read_bytes("sample_logs/CH_StGallen_Wil.map")).bins
    1183
    """
    with MapFile.of_bytes(data, file) as opened:
        return _read(opened)


def map_to_bytes(condition: TrackConditionMap) -> bytes:
    """The bytes of a file with the map's evidence, added up by day: equal for equal maps.

    Raises
    ------
    InputError
        If an estimate of the map is not that of its evidence: the file could not hold it.

    Examples
    --------
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> map_to_bytes(map_from_bytes(map_to_bytes(condition))) == map_to_bytes(condition)
    True
    """
    _check_estimates(condition)
    return whole_file(condition)


def read_map(path: str | Path) -> TrackConditionMap:
    """Read a track-condition map; errors as `map_from_bytes`, and if the file cannot be read.

    Examples
    --------
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> condition.line, list(condition.layers)
    ('CH_StGallen_Wil', ['dry', 'wet'])
    """
    with MapFile(path) as opened:
        return _read(opened)


def write_map(condition: TrackConditionMap, path: str | Path) -> None:
    """Write a track-condition map, whole or not at all; errors as `map_to_bytes`.

    A file that is there is replaced, with what other processes add to it at that moment: trips are
    added to a file by `analysis.update_map`.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_map(condition, Path(folder) / "copy.map")
    ...     read_map(Path(folder) / "copy.map").bins
    1183
    """
    check_written(condition, TrackConditionMap)
    write_bytes(path, map_to_bytes(condition))


def _read(opened: MapFile) -> TrackConditionMap:
    with opened.unchanging():
        trips = opened.trips()
        entries = sorted((row.entry_whole for row in trips if row.counted), key=place_of)
        track = replace(opened.empty, trips=tuple(entries))
        known = opened.layers(trips)
        # What else changed since the estimate was made does not matter.
        code = code_version_of(__name__)
        made_from = {name: f"{digest} {code}" for name, (_, digest) in known.items()}
        kept = {name: opened.estimate(name, each) for name, each in made_from.items()}
    for name, (evidence, _) in known.items():
        if (evidence.bins, evidence.levels) != (track.bins, track.levels.size):
            raise InputError(
                f"has evidence of {evidence.bins} bins and {evidence.levels} levels for a line of"
                f" {track.bins} and {track.levels.size}",
                file=opened.path,
                place=f"layer '{name}'",
                remedy="build the map anew from the logs",
            )
    layers = {
        name: _layer_of(evidence, kept[name]) or ConditionLayer.unestimated(evidence)
        for name, (evidence, _) in known.items()
    }
    if all(kept.values()) and all(np.isfinite(each.log_mean).all() for each in layers.values()):
        return replace(track, layers=layers)
    found = estimated(replace(track, layers=layers))
    with suppress(TypeError, ValueError, InputError):
        new = {name: (made_from[name], _packed(layer)) for name, layer in found.layers.items()}
        opened.keep_estimates(new)
    return found


def _packed(layer: ConditionLayer) -> bytes:
    """The estimate of a layer, as `_layer_of` reads it."""
    values = {each.name: getattr(layer, each.name) for each in fields(layer)}
    del values["evidence"]
    arrays = {name: value for name, value in values.items() if isinstance(value, np.ndarray)}
    facts: dict[str, Any] = {name: [asdict(each) for each in values[name]] for name in _LISTED} | {
        "model": asdict(layer.model)["parameters"]
    }
    return pack(facts, arrays)


def _layer_of(evidence: DailyEvidence, data: bytes | None) -> ConditionLayer | None:
    """A layer with the estimate that the file keeps; None if it keeps none."""
    if data is None:
        return None
    try:
        facts, arrays = unpack(data)
        kept: dict[str, Any] = {**arrays}
        kept |= {
            name: tuple(kind(**each) for each in facts[name]) for name, kind in _LISTED.items()
        }
        kept["model"] = ConditionModel(tuple(ModelParameter(**each) for each in facts["model"]))
        return ConditionLayer(evidence=evidence, **kept)
    except (ValueError, KeyError, TypeError):
        return None


def _check_estimates(condition: TrackConditionMap) -> None:
    """Refuse a map with an estimate that its evidence does not give."""
    given = {n: each for n, each in condition.layers.items() if np.isfinite(each.log_mean).any()}
    if not given:
        return
    found = estimated(replace(condition, layers=given))
    for name, layer in given.items():
        own = found.layers[name]
        if not (
            np.allclose(layer.log_mean, own.log_mean, rtol=0.0, atol=1e-6)
            and np.allclose(layer.log_std, own.log_std, rtol=1e-6, atol=1e-9)
            and np.array_equal(layer.observed, own.observed)
        ):
            raise InputError(
                f"map of line '{condition.line}': the estimate of layer '{name}' is not that of its"
                " evidence, and a map's file holds evidence alone",
                remedy="change the evidence or the settings, and make the estimate of them"
                " (trainlog.condition.estimated)",
            )
