"""A track-condition map for other programs: GeoJSON, GeoPackage, Parquet, CSV, TTOBench."""

from __future__ import annotations

import json
import struct
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import (
    bins_table,
    changes_table,
    chosen_layers,
    last_evidence,
    sections_table,
    spots_table,
)
from trainlog.arrays import FloatArray
from trainlog.condition import known_before
from trainlog.errors import InputError
from trainlog.extras import load
from trainlog.formats.files import atomic_write, csv_bytes, write_bytes
from trainlog.formats.ttobench import AdhesionSections, Metadata, write_adhesion
from trainlog.presentation import plain_rows
from trainlog.railway import Line, TrackConditionMap
from trainlog.railway.line import in_km
from trainlog.version import __version__

DIGITS = 7
"""Decimals of coordinates [deg]: a centimetre."""

GEOGRAPHIC = (".geojson", ".gpkg")
"""Suffixes of files with coordinates."""

UNITS = {
    "m": "m",
    "km": "km, the operator's",
    "permil": "per mille",
    "per_km": "1/km",
    "km_h": "km/h",
    "days": "days",
    "day": "date, UTC",
}
"""What the ends of the columns' names state; other numbers are without unit."""


@dataclass(frozen=True, eq=False)
class _Export:
    """What is exported, and of which time."""

    track: TrackConditionMap
    line: Line | None
    time: pd.Timestamp | None
    layers: list[str]

    @property
    def about(self) -> dict[str, str]:
        """What the file was made from."""
        trips = sum(trip["layer"] in self.layers for trip in self.track.trips)
        now = self.time or last_evidence(self.track)
        return {
            "line": self.track.line,
            "operators_line": "" if self.line is None or self.line.reference is None
            else self.line.reference.name,
            "layers": ", ".join(self.layers),
            "trips": str(trips),
            "expected_at": "" if now is None else now.isoformat(),
            "software": f"trainlog {__version__}",
        }  # fmt: skip

    @property
    def table(self) -> pd.DataFrame:
        """The bins."""
        return self._dated(bins_table(self.track, self.line, self.time, self.layers))

    def _dated(self, rows: pd.DataFrame) -> pd.DataFrame:
        """Rows with the time that their expected condition and probabilities hold for."""
        return rows.assign(expected_at=self.about["expected_at"] or None)

    def located(self) -> Iterator[tuple[str, pd.DataFrame, list[FloatArray | None]]]:
        """Name, rows and courses of each table that has a place on the earth."""
        given = (self.track, self.line)
        tables = {
            "bins": self.table,
            "sections": self._dated(sections_table(*given, self.time, self.layers)),
            "spots": self._dated(spots_table(*given, self.time, self.layers)),
            "changes": changes_table(*given, self.layers),
        }
        for name, rows in tables.items():
            pieces = zip(rows["start_m"], rows["end_m"], strict=True)
            yield name, rows, [course_of(self.line, *each) for each in pieces]
        stations = self.line.stations if self.line is not None else ()
        at = np.array([each.position for each in stations])
        rows = pd.DataFrame(
            {
                "line": self.track.line,
                "name": [each.name for each in stations],
                "position_m": at,
                "position_km": in_km(self.line, at),
            }
        )
        yield "stations", rows, [point_of(self.line, each) for each in at.tolist()]


def export_map(
    track: TrackConditionMap,
    path: str | Path,
    *,
    line: Line | None = None,
    at: pd.Timestamp | None = None,
    layers: Sequence[str] | None = None,
) -> None:
    """Write a track-condition map for other programs, whole or not at all.

    What was not observed is empty there, never the prior. The suffix decides:

    ``.geojson``
        RFC 7946, WGS 84: a feature a bin, spot, change and station (``kind``).
    ``.gpkg``
        GeoPackage with the layers bins, sections, spots, changes and stations; those without rows
        are left out. Needs the extra ``gis``.
    ``.parquet``, ``.csv``
        The bins by chainage.
    ``.json``
        Sections of one layer in the layout of TTOBench.

    Parameters
    ----------
    track : TrackConditionMap
    path : path
    line : Line, optional
        Gives kilometres, stations, gradients and coordinates; GeoJSON and GeoPackage need it.
    at : Timestamp, optional
        Time of the expected condition; only evidence of the days before its day counts
        (`trainlog.condition.known_before`). Default: right after the last evidence, with all of it.
    layers : sequence of str, optional
        Default: all.

    Raises
    ------
    InputError
        If the suffix is another, the map lacks a layer, no evidence is of a day before `at`, the
        line is another or has no coordinates where they are needed, or the file cannot be written.
    MissingExtraError
        If a GeoPackage is asked for without the extra ``gis``.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> import pandas, trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     export_map(track, Path(folder) / "map.csv", layers=["wet"])
    ...     int(pandas.read_csv(Path(folder) / "map.csv")["adhesion"].notna().sum())
    37
    """
    suffix = exported_suffix(path)
    if line is not None:
        track.check_line(line.name, line.length)
    if suffix in GEOGRAPHIC:
        _check_coordinates(track, line, path)
    track = replace(track, layers=chosen_layers(track, layers))
    if at is not None:
        track = known_before(track, at)
    _WRITERS[suffix](_Export(track, line, at, list(track.layers)), path)


def exported_suffix(path: str | Path) -> str:
    """The suffix of a file that a map can be exported to, in lower case.

    Raises
    ------
    InputError
        If it is another.

    Examples
    --------
    >>> exported_suffix("map.GPKG")
    '.gpkg'
    """
    path = Path(path)
    suffix = path.suffix.lower()
    if suffix not in _WRITERS:
        raise InputError(
            "a track-condition map is not exported to files of this kind",
            file=path,
            remedy=f"end it in {', '.join(_WRITERS)}",
        )
    return suffix


def _check_coordinates(track: TrackConditionMap, line: Line | None, path: str | Path) -> None:
    if line is None:
        raise InputError(
            f"needs the coordinates of line '{track.line}', which a map does not hold",
            file=path,
            remedy="give the line file (--line), or export .csv or .parquet",
        )
    if line.geometry is None:
        raise InputError(
            f"line '{line.name}' has no coordinates",
            file=path,
            remedy="add them from fixes with 'trainlog new line --from LOGS', or export .csv",
        )


def course_of(line: Line | None, start: float, end: float) -> FloatArray | None:
    """Longitudes and latitudes of a piece of the line, (n, 2); None beyond its coordinates."""
    geometry = None if line is None else line.geometry
    if geometry is None:
        return None
    known = geometry.positions
    start, end = max(start, float(known[0])), min(end, float(known[-1]))
    if end <= start:
        return None
    inside = known[(known > start) & (known < end)]
    latitude, longitude = geometry.at(np.concatenate(([start], inside, [end])))
    return np.column_stack((longitude, latitude)).round(DIGITS)


def point_of(line: Line | None, position: float) -> FloatArray | None:
    """Longitude and latitude of a place of the line, (1, 2); None beyond its coordinates."""
    geometry = None if line is None else line.geometry
    if geometry is None or not geometry.positions[0] <= position <= geometry.positions[-1]:
        return None
    latitude, longitude = geometry.at([position])
    return np.column_stack((longitude, latitude)).round(DIGITS)


def _write_geojson(export: _Export, path: str | Path) -> None:
    features = []
    for name, rows, courses in export.located():
        if name == "sections":
            continue
        for values, course in zip(plain_rows(rows), courses, strict=True):
            kind = "Point" if name == "stations" else "LineString"
            coordinates = None if course is None else course.tolist()
            geometry = None if coordinates is None else {
                "type": kind,
                "coordinates": coordinates[0] if kind == "Point" else coordinates,
            }  # fmt: skip
            properties = {"kind": name.removesuffix("s"), **values}
            features.append({"type": "Feature", "geometry": geometry, "properties": properties})
    write_features(path, features, export.about)


def write_features(
    path: str | Path, features: Sequence[dict[str, Any]], about: dict[str, str]
) -> None:
    """Write GeoJSON features to a file, whole or not at all, with what it was made from."""
    # One feature a line: large files can be compared, and read line by line.
    lines = ",\n".join(json.dumps(each, ensure_ascii=False, allow_nan=False) for each in features)
    made_from = json.dumps(about, ensure_ascii=False)
    text = f'{{"type": "FeatureCollection", "trainlog": {made_from}, "features": [\n{lines}\n]}}\n'
    write_bytes(path, text.encode())


def _write_geopackage(export: _Export, path: str | Path) -> None:
    pyogrio = load("pyogrio")
    # GDAL stamps its tables with this time: the same map gives the same bytes.
    now = export.time or last_evidence(export.track) or pd.Timestamp(0, tz="UTC")
    stamp = now.strftime("%Y-%m-%dT%H:%M:%S.000Z")
    before = pyogrio.get_gdal_config_option("OGR_CURRENT_DATE")
    pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": stamp})
    try:
        with atomic_write(path) as temporary:
            # GDAL makes a file of its own in the place of the empty one.
            temporary.unlink()
            begun = False
            for name, rows, courses in export.located():
                if rows.empty:
                    continue
                point = name == "stations"
                pyogrio.raw.write(
                    temporary,
                    layer=name,
                    driver="GPKG",
                    geometry=np.array([_well_known(each, point=point) for each in courses], object),
                    geometry_type="Point" if point else "LineString",
                    crs="EPSG:4326",
                    append=begun,
                    dataset_metadata=None if begun else export.about,
                    **_fields(rows),
                )
                begun = True
    except pyogrio.errors.DataSourceError as error:
        raise InputError("cannot be written by GDAL", file=path, remedy=str(error)) from error
    finally:
        pyogrio.set_gdal_config_options({"OGR_CURRENT_DATE": before})


def _fields(rows: pd.DataFrame) -> dict[str, Any]:
    """The columns of a table as pyogrio takes them."""
    data, masks = [], []
    for column in (rows[name] for name in rows):
        unknown = column.isna().to_numpy()
        if column.dtype.kind == "M":
            values: Any = column.to_numpy().astype("datetime64[D]")
        elif column.dtype.kind in "fiub":
            values = column.to_numpy()
        else:
            values = column.astype(object).where(~unknown, None).to_numpy(dtype=object)
        data.append(values)
        masks.append(unknown if unknown.any() and column.dtype.kind in "fM" else None)
    return {"field_data": data, "field_mask": masks, "fields": np.array(list(rows), dtype=object)}


def _well_known(course: FloatArray | None, *, point: bool) -> bytes | None:
    """A course, or the one point of it, as well-known binary (OGC 06-103r4, 8.2)."""
    if course is None:
        return None
    head = struct.pack("<BI", 1, 1) if point else struct.pack("<BII", 1, 2, len(course))
    return head + course.astype("<f8").tobytes()


def _write_parquet(export: _Export, path: str | Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = export.table
    table = pa.Table.from_pandas(rows, preserve_index=False)
    described = [
        pa.field(
            each.name,
            pa.date32() if pa.types.is_timestamp(each.type) else each.type,
            metadata={"unit": unit_of(each.name)} if unit_of(each.name) else None,
        )
        for each in table.schema
    ]
    table = table.cast(pa.schema(described, {"trainlog": json.dumps(export.about)}))
    with atomic_write(path) as temporary:
        pq.write_table(table, temporary, compression="zstd")


def unit_of(column: str) -> str:
    """The unit that the end of a column's name states; empty of one without.

    Examples
    --------
    >>> unit_of("start_m"), unit_of("speed_limit_km_h"), unit_of("adhesion")
    ('m', 'km/h', '')
    """
    ends = [end for end in UNITS if column.endswith(f"_{end}")]
    return UNITS[max(ends, key=len)] if ends else ""


def _write_csv(export: _Export, path: str | Path) -> None:
    write_bytes(path, csv_bytes(export.table, date_format="%Y-%m-%d"))


def _write_ttobench(export: _Export, path: str | Path) -> None:
    if len(export.layers) > 1:
        raise InputError(
            "TTOBench's layout has one adhesion a track, and the map has the layers"
            f" {', '.join(export.layers)}",
            file=path,
            remedy="choose one (--layer)",
        )
    rows = sections_table(export.track, export.line, export.time, export.layers)
    columns = ("start_m", "adhesion", "low", "high", "expected", "expected_low", "expected_high")
    about = export.about
    write_adhesion(
        AdhesionSections(
            metadata=Metadata.of(
                f"{export.track.line} {export.layers[0]}",
                f"{about['trips']} trips; {about['software']}",
                export.track.line,
            ),
            rail_condition=export.layers[0],
            length=export.track.length,
            expected_at=about["expected_at"],
            adhesion=tuple(rows[name].to_numpy(dtype=np.float64) for name in columns),
        ),
        path,
    )


_WRITERS: dict[str, Callable[[_Export, str | Path], None]] = {
    ".geojson": _write_geojson,
    ".gpkg": _write_geopackage,
    ".parquet": _write_parquet,
    ".csv": _write_csv,
    ".json": _write_ttobench,
}
