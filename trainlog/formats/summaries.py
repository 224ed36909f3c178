"""Summaries of trips, one row a trip, as a Parquet file; docs/formats.md describes it.

What the identification keeps of a trip: a thousandth of its log, and all that combining it with
others needs. The frame is plain; `COLUMNS` says what it holds.
"""

from __future__ import annotations

import os
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.declared import check_version
from trainlog.formats.files import atomic_write, refuse_reading
from trainlog.railway.resistance import TERMS, UNITS

FORMAT, VERSION = "trainlog/summaries", 1
"""Named in the file; the version is raised when a column changes its meaning or goes."""

SUFFIX = ".parquet"

ROWS = 100_000
"""Rows of a row group."""

PARAMETERS = (*TERMS, "mass")
_UNITS = (*UNITS, "kg")


@dataclass(frozen=True, slots=True)
class Column:
    """One column of a table of trips.

    Attributes
    ----------
    name, unit, meaning : str
    kind : {"number", "count", "text", "numbers", "data"}
        Numbers are null where they are unknown.
    of : str
        Where it is found in what a row is of: attributes, keys and places, with dots between;
        empty: by its name.
    """

    name: str
    unit: str
    meaning: str
    kind: str = "number"
    of: str = ""

    def value(self, thing: Any) -> Any:
        """What it is of a thing; None where the thing has none.

        Examples
        --------
        >>> Column("slip", "s", "time masked", of="masked.slip").value({"masked": {"slip": 2.0}})
        2.0
        """
        for part in (self.of or self.name).split("."):
            if isinstance(thing, Mapping):
                thing = thing.get(part)
            else:
                thing = thing[int(part)] if part.isdigit() else getattr(thing, part, None)
        return thing

    @property
    def field(self) -> pa.Field:
        """What it is in a file."""
        about = {"unit": self.unit, "meaning": self.meaning}
        return pa.field(self.name, _ARROW[self.kind], metadata=about)


_ARROW = {
    "text": pa.string(),
    "count": pa.int64(),
    "number": pa.float64(),
    "numbers": pa.list_(pa.float64()),
    "data": pa.binary(),
}
_EMPTY: dict[str, Any] = {"text": "", "count": 0, "number": np.nan, "numbers": (), "data": b""}


def frame_of(columns: Iterable[Column], rows: Iterable[Mapping[str, Any]]) -> pd.DataFrame:
    """A table of declared columns; what a row does not state is empty, 0 or NaN."""
    given = list(rows)
    found: dict[str, Any] = {}
    for column in columns:
        kind = {"count": np.int64, "number": np.float64}.get(column.kind, object)
        values = found[column.name] = np.empty(len(given), dtype=kind)
        for number, row in enumerate(given):
            values[number] = row.get(column.name, _EMPTY[column.kind])
        if kind is object:
            found[column.name] = pd.Series(values, dtype=object)
    return pd.DataFrame(found)


def arrow_of(columns: Iterable[Column], frame: Mapping[str, Any] | pd.DataFrame) -> pa.Table:
    """The table as it is kept in a file, with units and meanings."""
    arrays = []
    fields = [column.field for column in columns]
    for field in fields:
        values, unknown = frame[field.name], None
        if field.type == pa.float64():
            values = np.asarray(values, np.float64)
            unknown = np.isnan(values)
        arrays.append(pa.array(values, field.type, mask=unknown))
    return pa.Table.from_arrays(arrays, schema=pa.schema(fields))


def _triangle(prefix: str, size: int, meaning: str) -> tuple[Column, ...]:
    """The upper triangle of a matrix of the first `PARAMETERS`, row by row."""
    return tuple(
        Column(
            f"{prefix}_{PARAMETERS[i]}_{PARAMETERS[j]}",
            f"{_UNITS[i]} {_UNITS[j]}",
            meaning,
            of=f"{prefix}.{i}.{j}",
        )
        for i in range(size)
        for j in range(i, size)
    )


_COVARIANCE = _triangle("covariance", len(PARAMETERS), "covariance")
COVARIANCE = tuple(each.name for each in _COVARIANCE)
"""The upper triangle of the covariance of `PARAMETERS`, row by row."""

_SURVEY = _triangle("survey", len(TERMS), "what errors of the gradients bring into it")
SURVEY = tuple(each.name for each in _SURVEY)
"""The upper triangle of what errors of the line bring into that of the curve, row by row."""

COLUMNS: tuple[Column, ...] = (
    Column("trip", "", "name of the trip", "text"),
    Column("sha256", "", "checksum of its log", "text"),
    Column("train", "", "name of the train", "text"),
    Column("software", "", "software that made the summary, with its version", "text"),
    Column("refused", "", "why the trip does not determine the curve; empty if it does", "text"),
    Column("message", "", "the reason in a sentence, with the figures", "text"),
    *(
        Column(name, unit, "running resistance", of=f"resistance.{name}")
        for name, unit in zip(TERMS, UNITS, strict=True)
    ),
    Column("mass", "kg", "mass without its rotating part"),
    *_COVARIANCE,
    Column("freedom", "1", "degrees of freedom of the covariance", "count"),
    Column("rotating_mass", "kg", "rotating mass of the train's file"),
    Column("train_power", "W", "largest traction power that the train's file states"),
    Column("max_power", "W", "power on stretches at the power limit; null if there was none"),
    Column("max_power_std", "W", "its standard deviation"),
    Column("asked_lowest", "m/s", "lowest speed that the curve was asked for", of="asked.0"),
    Column("asked_highest", "m/s", "highest speed that the curve was asked for", of="asked.1"),
    Column("speed_lowest", "m/s", "lowest mean speed of a window", of="speed_range.0"),
    Column("speed_highest", "m/s", "highest mean speed of a window", of="speed_range.1"),
    Column("condition", "1", "column-normalised condition number of the regressors"),
    Column("windows", "1", "windows used", "count", of="windows.used"),
    Column("outliers", "1", "windows left out", "count", of="windows.outlier"),
    Column("noise_speed", "m/s", "noise of the speed averaged at a window's end", of="noise.speed"),
    Column(
        "noise_gradient", "1", "noise of the gradient of a piece of the map", of="noise.gradient"
    ),
    Column(
        "noise_position", "m", "noise of the chainage at a change of gradient", of="noise.position"
    ),
    Column("noise_effort", "1", "noise of one sample's effort, over the effort", of="noise.effort"),
    Column("delay", "s", "delay of recorded efforts"),
    Column("brake_scale", "1", "ratio of the dynamic brake's recorded to its true effort"),
    Column("cluster_factor", "1", "factor on the noise model's variances"),
    Column("residual_std", "1", "standard deviation of the whitened residuals"),
    Column("residual_correlation", "1", "correlation of neighbouring whitened residuals"),
    Column("speed_scale", "1", "ratio of measured to true speed", of="scale.factor"),
    Column("speed_scale_std", "1", "its standard deviation", of="scale.std"),
    Column("speed_scale_source", "", "reference of the calibration", "text", of="scale.source"),
    Column(
        "gradients", "", "SHA-256 of the line's gradients as travelled; of a route edges", "text"
    ),
    *_SURVEY,
    Column("masked_gap", "s", "time masked: gaps", of="masked.gap"),
    Column("masked_standstill", "s", "time masked: standstill", of="masked.standstill"),
    Column(
        "masked_braking",
        "s",
        "time masked: braking effort not known well enough",
        of="masked.braking",
    ),
    Column("masked_slip", "s", "time masked: slip", of="masked.slip"),
    Column(
        "effort_gain",
        "1",
        "ratio of recorded to true effort; efforts were divided by it",
        of="passport.effort_gain.value",
    ),
    Column(
        "assumed_gain_std",
        "1",
        "its standard deviation where no recorded load shows it; in the covariance, trips share it",
    ),
    Column("identity", "", "checksum of the drive's recorded samples; empty: not known", "text"),
)

_LATER = {"gradients", *SURVEY, "effort_gain", "assumed_gain_std", "identity"}
"""Columns that older files lack: then nothing is known of what the trip shares with others."""

_ALWAYS = (*PARAMETERS, *COVARIANCE, "rotating_mass", "train_power", "asked_highest")
"""What no accepted trip can be without."""


def write_summaries(summaries: pd.DataFrame, path: str | Path) -> None:
    """Write summaries, whole or not at all, in the order of trip and SHA-256.

    The same summaries give the same bytes, in whatever order they come.

    Raises
    ------
    InputError
        If a column is missing or strange, a row is not plausible, or the file cannot be written.
    """
    frame = ordered(summaries)
    _check(frame, path)
    table = arrow_of(COLUMNS, frame).replace_schema_metadata(
        {"format": FORMAT, "version": str(VERSION)}
    )
    with atomic_write(path) as temporary:
        pq.write_table(
            table,
            temporary,
            compression="zstd",
            row_group_size=ROWS,
            use_dictionary=["train", "software", "refused", "speed_scale_source"],
            write_page_checksum=True,
        )


def holds_summaries(path: str | Path) -> bool:
    """Whether a Parquet file holds summaries of fits."""
    try:
        metadata = pq.read_schema(os.fspath(path)).metadata or {}
    except (pa.ArrowException, OSError):
        return False
    return metadata.get(b"format") == FORMAT.encode()


def read_summaries(path: str | Path) -> pd.DataFrame:
    """Read summaries.

    Returns
    -------
    DataFrame
        With the columns of `COLUMNS`, in the order of trip and SHA-256.

    Raises
    ------
    InputError
        If it is not such a file, of a version this trainlog does not know, or damaged.
    """
    try:
        with Path(path).open("rb"):
            pass
        table = pq.read_table(os.fspath(path), page_checksum_verification=True)
    except pa.ArrowException as error:
        raise InputError(
            "is not a Parquet file, or damaged", file=path, remedy="fit the logs again"
        ) from error
    except OSError as error:
        # Arrow reports a page whose checksum is wrong by an OSError without a number.
        if error.errno is None:
            raise InputError("is damaged", file=path, remedy="fit the logs again") from error
        refuse_reading(path, error)
    metadata = table.schema.metadata or {}
    if metadata.get(b"format") != FORMAT.encode():
        raise InputError(
            f"is not a {FORMAT} file", file=path, remedy="give logs, or what 'trainlog fit' wrote"
        )
    version = metadata.get(b"version", b"").decode("utf-8", "replace")
    check_version(int(version) if version.isdecimal() else version, VERSION, path)
    frame = pd.DataFrame(
        {
            name: pd.Series(
                column.to_numpy(), dtype=object if pa.types.is_string(column.type) else None
            )
            for name, column in zip(table.column_names, table.columns, strict=True)
        }
    )
    for name in _LATER - set(frame):
        frame[name] = "" if name in ("gradients", "identity") else np.nan
    _check(frame, path)
    return ordered(frame[[column.name for column in COLUMNS]])


def ordered(summaries: pd.DataFrame) -> pd.DataFrame:
    """The summaries in the order of trip, SHA-256, software and identity."""
    keys = ["trip", "sha256", "software", "identity"]
    return summaries.sort_values(keys, kind="stable", ignore_index=True)


def merged(pieces: Sequence[pd.DataFrame]) -> pd.DataFrame:
    """Summaries of several files together; a log that several of them hold counts once.

    Of two summaries of one log that of the later software is kept, whatever the order of the
    pieces.
    """
    together = pd.concat(pieces, ignore_index=True)
    together["_version"] = age(together)
    together = together.sort_values(
        ["sha256", "trip", "_version", *PARAMETERS], kind="stable", ignore_index=True
    )
    unknown = together["sha256"] == ""
    again = together.duplicated(["sha256", "trip"], keep="last") & ~unknown
    return ordered(together[~again].drop(columns="_version"))


def age(summaries: pd.DataFrame) -> pd.Series:
    """Place of the software of each row among those of all, the oldest first."""
    numbers = {name: [int(n) for n in re.findall(r"\d+", name)] for name in summaries["software"]}
    versions = sorted(numbers, key=lambda name: (numbers[name], name))
    return summaries["software"].map({name: place for place, name in enumerate(versions)})


def parameters_of(summaries: pd.DataFrame) -> FloatArray:
    """`PARAMETERS` of each trip (k, p); NaN for refused ones."""
    return np.ascontiguousarray(summaries[list(PARAMETERS)].to_numpy(np.float64))


def covariances_of(summaries: pd.DataFrame) -> FloatArray:
    """Covariance of `PARAMETERS` of each trip (k, p, p)."""
    return _symmetric(summaries, COVARIANCE, len(PARAMETERS))


def surveys_of(summaries: pd.DataFrame) -> FloatArray:
    """What errors of the line bring into the covariance of each trip's curve.

    Zero where it is not known.
    """
    return np.nan_to_num(_symmetric(summaries, SURVEY, len(TERMS)))


def _symmetric(summaries: pd.DataFrame, names: Sequence[str], size: int) -> FloatArray:
    """Matrices of each trip by the columns of their upper triangle."""
    full = np.empty((len(summaries), size, size))
    rows, columns = np.triu_indices(size)
    full[:, rows, columns] = summaries[list(names)].to_numpy(np.float64)
    full[:, columns, rows] = full[:, rows, columns]
    return full


def _check(frame: pd.DataFrame, path: str | Path) -> None:
    """Refuse what is no table of summaries, or holds a row that no fit gives."""
    known = {column.name for column in COLUMNS}
    present = {str(name) for name in frame}
    for names, what in ((known - present, "lacks"), (present - known, "has an unknown")):
        if names:
            raise InputError(
                f"{what} column '{min(names)}'", file=path, remedy="fit the logs again"
            )
    for column in COLUMNS:
        numeric = pd.api.types.is_numeric_dtype(frame[column.name])
        if numeric == (column.kind == "text") or frame[column.name].isna().any() > (
            column.kind == "number"
        ):
            raise InputError(
                "is not what it should be",
                file=path,
                place=f"column {column.name}",
                remedy="fit the logs again",
            )
    check_fitted(frame, path)


def check_fitted(frame: pd.DataFrame, path: str | Path | None = None) -> None:
    """Refuse rows that no fit gives; a single one would spoil all trips together.

    Raises
    ------
    InputError
        With the trip; of a file with the row.

    Examples
    --------
    >>> from analysis.resistance.combination import summarised
    >>> from analysis.resistance.fit import fit_trip
    >>> check_fitted(summarised([fit_trip("sample_logs/nonstop.mcap")]).assign(mass=-1.0))
    Traceback (most recent call last):
    trainlog.errors.InputError: trip 'trip-01': numbers that no fit gives; fit its log again
    """
    numbers = frame[list(_ALWAYS)].to_numpy(np.float64)
    covariance = covariances_of(frame)
    # Scaled to ones on the diagonal, so that units do not matter.
    with np.errstate(invalid="ignore", divide="ignore"):
        size = np.sqrt(np.einsum("kii->ki", covariance))
        scaled = covariance / (size[:, :, None] * size[:, None, :])
        right = np.isfinite(numbers).all(axis=1) & (frame["mass"] > 0.0) & (size > 0.0).all(axis=1)
        for minor in (2, 3):
            right &= np.linalg.det(scaled[:, :minor, :minor]) > 0.0
    bad = ((frame["refused"] == "") & ~right).to_numpy()
    if bad.any():
        row = int(np.argmax(bad))
        raise InputError(
            f"trip '{frame['trip'].iloc[row]}': numbers that no fit gives",
            file=path,
            place=None if path is None else f"row {row}",
            remedy="fit its log again",
        )
