"""The track-condition map's format, ``"trainlog/condition"``; docs/formats.md has its keys."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from trainlog.errors import InputError
from trainlog.formats.files import check_written, plain, read_bytes, write_bytes
from trainlog.formats.parameters import Details
from trainlog.formats.schema import Array, File, FloatArray, Part, Quantity, built
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

_Length = Annotated[float, Quantity("m", "m")]
_Bins = Annotated[FloatArray, Array("1")]
_Estimates = Annotated[FloatArray, Array("1", gaps=True)]


class _Evidence(Part):
    day: list[int]
    bin: list[int]
    trips: _Bins
    events: _Bins
    weight: _Bins
    weighted_log: _Bins
    weighted_square: _Bins
    common: _Bins
    used_day: list[int]
    used_bin: list[int]
    used_level: list[int]
    used_trips: _Bins

    def evidence(self, place: str, bins: int, levels: int) -> DailyEvidence:
        """The evidence that the part describes."""
        columns: dict[str, Any] = {
            name: np.asarray(value, dtype=np.int64) if isinstance(value, list) else value
            for name in type(self).model_fields
            for value in [getattr(self, name)]
        }
        for name, values in columns.items():
            rows = columns["used_day" if name.startswith("used") else "day"].size
            if values.size != rows:
                raise InputError(
                    f"has {values.size} values, needs {rows}",
                    place=f"{place}.{name}",
                    remedy="one a row",
                )
        for name, end in (("bin", bins), ("used_bin", bins), ("used_level", levels)):
            values = columns[name]
            if values.size and not (values.min() >= 0 and values.max() < end):
                raise InputError(
                    f"has a number that is not from 0 to {end - 1}",
                    place=f"{place}.{name}",
                    remedy="correct it, or begin a new map from the logs",
                )
        return DailyEvidence(bins, levels, **columns)


class _Layer(Part):
    log_mean: _Estimates
    log_std: _Estimates
    observed: list[bool]
    evidence: _Evidence

    def layer(self, place: str, bins: int, levels: int) -> ConditionLayer:
        """The layer that the part describes."""
        fields = {name: getattr(self, name) for name in ("log_mean", "log_std")}
        fields["observed"] = np.array(self.observed, dtype=np.bool_)
        for name, values in fields.items():
            if values.shape != (bins,):
                raise InputError(
                    f"has {' by '.join(map(str, values.shape))} values, needs {bins}",
                    place=f"{place}.{name}",
                    remedy="one row a bin of the line",
                )
        known = self.evidence.evidence(f"{place}.evidence", bins, levels)
        return ConditionLayer(**fields, evidence=known)

    @staticmethod
    def of(layer: ConditionLayer) -> _Layer:
        """The part that describes a layer."""
        whole = ("day", "bin", "used_day", "used_bin", "used_level")
        known = layer.evidence
        rows = {name: getattr(known, name).tolist() for name in whole}
        return _Layer.holding(
            layer, observed=layer.observed.tolist(), evidence=_Evidence.holding(known, **rows)
        )


class _MapFile(File):
    FORMAT: ClassVar[str] = "trainlog/condition"

    line: str
    length: _Length
    bin_length: _Length
    levels: _Bins
    layers: dict[str, _Layer]
    settings: dict[str, Annotated[float, Field(allow_inf_nan=False)]] = Field(default_factory=dict)
    trips: list[Details] = Field(default_factory=list)

    def map(self) -> TrackConditionMap:
        """The map that the file describes."""
        for name in ("length", "bin_length"):
            if not getattr(self, name) > 0.0:
                raise InputError("must be positive", place=name, remedy="correct it")
        empty = TrackConditionMap(
            line=self.line,
            length=self.length,
            bin_length=self.bin_length,
            levels=self.levels,
            layers={},
            trips=tuple(self.trips),
            settings=self.settings,
        )
        bins, levels = empty.bins, self.levels.size
        layers = {n: part.layer(f"layers.{n}", bins, levels) for n, part in self.layers.items()}
        return replace(empty, layers=layers)

    @staticmethod
    def of(condition: TrackConditionMap) -> _MapFile:
        """The file that describes a map."""
        return _MapFile.holding(
            condition,
            layers={name: _Layer.of(layer) for name, layer in condition.layers.items()},
            settings=plain(condition.settings, "settings"),
            trips=plain(condition.trips, "trips"),
        )


def map_from_bytes(data: bytes, *, file: str | Path = "map.json") -> TrackConditionMap:
    """The track-condition map in the bytes of a map file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a map file, naming the place and the remedy.

    Examples
    --------
    >>> map_from_bytes(read_bytes("sample_logs/CH_StGallen_Wil.map.json")).bins
    1183
    """
    return built(_MapFile.from_bytes(data, file).map, file)


def map_to_bytes(condition: TrackConditionMap) -> bytes:
    """The bytes of the map's file: doubles exact, the same map gives the same bytes.

    Examples
    --------
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map.json")
    >>> map_to_bytes(map_from_bytes(map_to_bytes(condition))) == map_to_bytes(condition)
    True
    """
    return _MapFile.of(condition).to_bytes()


def read_map(path: str | Path) -> TrackConditionMap:
    """Read a track-condition map; errors as `map_from_bytes`, and if the file cannot be read.

    Examples
    --------
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map.json")
    >>> condition.line, list(condition.layers)
    ('CH_StGallen_Wil', ['dry', 'wet'])
    """
    return map_from_bytes(read_bytes(path), file=path)


def write_map(condition: TrackConditionMap, path: str | Path) -> None:
    """Write a track-condition map, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> condition = read_map("sample_logs/CH_StGallen_Wil.map.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_map(condition, Path(folder) / "copy.map.json")
    ...     read_map(Path(folder) / "copy.map.json").bins
    1183
    """
    check_written(condition, TrackConditionMap)
    write_bytes(path, map_to_bytes(condition))
