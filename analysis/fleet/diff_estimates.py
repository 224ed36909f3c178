"""Estimates in the tables of two versions: row beside row, with their standard deviations."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, FloatArray
from trainlog.formats.summaries import COVARIANCE, PARAMETERS, covariances_of, parameters_of
from trainlog.units import DAY, KMH, NANOSECONDS

SPEEDS = (40.0, 80.0, 120.0)
"""At which curves of running resistance are compared [km/h]."""

_ABOUT = ("trip", "train", "kind", "line", "start", "edge", "layer", "direction")
_SKIPPED = {
    *("key", "sha256", "identity", "software", "message", "entry", "evidence", "gradients"),
    *("main_layer", "steps", "bin_length", "edge_length", "asked_lowest", "asked_highest"),
    *("weight", "weighted_log"),
}
"""Columns that state of which trip a row is, what made it and what it was asked for; bulk that is
compared by place; and sums of which the mean is compared."""

_BULK = ("evidence", "gradients")
"""Columns of which the bytes are compared."""


@dataclass(frozen=True)
class Values:
    """An estimate on one side.

    Attributes
    ----------
    value, std : FloatArray
        Of each row; a standard deviation of NaN: none.
    counted : bool
        A count, or a correlation, which states no band: its standard deviation is that of chance.
    """

    value: FloatArray
    std: FloatArray
    counted: bool = False

    @property
    def stated(self) -> BoolArray:
        """The rows that state a band of their own."""
        return (self.std > 0.0) & (not self.counted)


def by_definition(left: pd.DataFrame, right: pd.DataFrame) -> tuple[str, ...]:
    """What the parameters of two sides change by definition; blanked in both tables.

    Bins of two lengths are no estimate that moved, and a curve can be compared as far as both
    sides asked for it.
    """
    found = []
    if {"bin_length", "bins"} <= set(left) & set(right):
        other = _differ(left["bin_length"], right["bin_length"])
        if other.any():
            found.append("number of bins")
            for table in (left, right):
                table["bins"] = table["bins"].astype(np.float64).mask(other)
    if "asked_highest" in left and "asked_highest" in right:
        if _differ(left["asked_highest"], right["asked_highest"]).any():
            found.append("speeds that the curve was asked for")
        both = np.fmin(left["asked_highest"], right["asked_highest"])
        left["asked_highest"] = right["asked_highest"] = both
    return tuple(found)


def _differ(one: pd.Series, other: pd.Series) -> BoolArray:
    values = (one.to_numpy(np.float64), other.to_numpy(np.float64))
    return np.asarray(np.isfinite(values[0] - values[1]) & (values[0] != values[1]))


def other_bytes(left: pd.DataFrame, right: pd.DataFrame) -> BoolArray:
    """Rows whose evidence or packed columns differ in any byte."""
    found = np.zeros(len(left), dtype=np.bool_)
    for name in _BULK:
        if name in left and name in right:
            both = left[name].notna() & right[name].notna()
            found |= (both & (left[name] != right[name])).to_numpy(bool)
    return found


def aligned(one: pd.DataFrame, other: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
    """The rows that both sides have, in the same order; those of one side with nothing beside."""
    ids = [name for name in ("key", "trip", "edge", "layer") if name in one and name in other]
    pieces = []
    for table in (one, other):
        number: Any = table.groupby(ids, sort=False).cumcount() if len(table) else []
        pieces.append(table.assign(_number=number).set_index([*ids, "_number"]))
    every = pieces[0].index.union(pieces[1].index)
    left, right = (piece.reindex(every).reset_index() for piece in pieces)
    for column in _ABOUT:
        if column in left and column in right and column not in ids:
            left[column] = left[column].where(left[column].notna(), right[column])
    return left, right


def trips_of(table: pd.DataFrame) -> pd.DataFrame:
    """Of which trip, train and place each row is."""
    edge = table["edge"] if "edge" in table else table.get("line", pd.Series(dtype=object))
    layer = table.get("layer")
    place = edge if layer is None else edge + ", " + layer
    empty = pd.Series([None] * len(table), dtype=object)
    names = ("key", "trip", "train", "kind", "line", "start")
    return pd.DataFrame({name: table.get(name, empty) for name in names} | {"place": place})


def texts(left: pd.DataFrame, right: pd.DataFrame) -> list[str]:
    """The columns that hold texts on both sides, but for those that say of which trip a row is."""
    skipped = _SKIPPED | set(_ABOUT)
    return [
        str(name)
        for name in left
        if name in right
        and name not in skipped
        and left[name].map(lambda each: isinstance(each, str)).any()
    ]


UNITS = {f"resistance at {speed:.0f} km/h": "N" for speed in SPEEDS}


def estimates(table: pd.DataFrame, counts: Collection[str] = ()) -> dict[str, Values]:
    """The estimates of a table, with their standard deviations.

    Parameters
    ----------
    table : DataFrame
    counts : collection of str
        Columns that hold counts: of one of n the chance is that of Poisson, the root of n.
    """
    found: dict[str, Values] = {}
    nothing = np.full(len(table), np.nan)
    bands = {*COVARIANCE, *(name for name in table if str(name).startswith("survey_"))}
    for name in table:
        if name in _SKIPPED or name in _ABOUT or name in bands or name == "_number":
            continue
        column = table[name]
        if pd.api.types.is_numeric_dtype(column):
            if str(name).endswith(("_std", "_stds")):
                continue
            value = column.to_numpy(np.float64)
            if name in _INSTANTS and "start" in table:
                # From the trip's start on: of an instant one per cent would be years.
                value = _INSTANTS[str(name)](value, pd.to_datetime(table["start"]).astype("int64"))
            std = table[f"{name}_std"].to_numpy(np.float64) if f"{name}_std" in table else nothing
            if f"covariance_{name}_{name}" in table:
                std = np.sqrt(table[f"covariance_{name}_{name}"].to_numpy(np.float64))
            counted = name in counts and not np.isfinite(std).any()
            if counted:
                std = np.sqrt(np.fmax(value, 1.0))
            found[str(name)] = Values(value, std, counted)
        elif str(name).endswith("s") and f"{str(name)[:-1]}_stds" in table:
            found |= _listed(str(name)[:-1], column, table[f"{str(name)[:-1]}_stds"])
    if {"residual_correlation", "windows"} <= set(found):
        # Of n uncorrelated residuals it scatters by the root of 1/n (Bartlett, 1946).
        chance = np.sqrt(1.0 / np.fmax(found["windows"].value, 1.0))
        found["residual_correlation"] = Values(found["residual_correlation"].value, chance, True)
    return found | _curves(table) | _adhesion(table)


_INSTANTS: dict[str, Callable[[FloatArray, pd.Series], FloatArray]] = {
    "entered": lambda value, start: np.asarray((value - start) / NANOSECONDS),
    "first_day": lambda value, start: np.where(value >= 0.0, value - start // DAY, np.nan),
    "last_day": lambda value, start: np.where(value >= 0.0, value - start // DAY, np.nan),
}
"""Columns of instants, and how they are counted from the start of the trip (-1: no day)."""


def _adhesion(table: pd.DataFrame) -> dict[str, Values]:
    """The mean of the maximum adhesion over a row's onsets, by their inverse variances."""
    if not {"weight", "weighted_log"} <= set(table):
        return {}
    weight = table["weight"].to_numpy(np.float64)
    weight = np.where(weight > 0.0, weight, np.nan)
    mean = np.exp(table["weighted_log"].to_numpy(np.float64) / weight)
    return {"maximum adhesion": Values(mean, mean / np.sqrt(weight))}


def _listed(name: str, values: pd.Series, stds: pd.Series) -> dict[str, Values]:
    """Columns of lists, an estimate a place in the list."""
    sizes = [len(each) if isinstance(each, np.ndarray | list | tuple) else 0 for each in values]
    table, bands = (np.full((len(sizes), max(sizes, default=0)), np.nan) for _ in range(2))
    for row, size in enumerate(sizes):
        if size:
            table[row, :size] = values.iloc[row]
            given = stds.iloc[row]
            bands[row, : min(size, len(given))] = given[:size]
    return {
        f"{name} {number + 1}": Values(table[:, number], bands[:, number])
        for number in range(table.shape[1])
    }


def _curves(table: pd.DataFrame) -> dict[str, Values]:
    """Running resistance at a few speeds, as far as a trip's curve was asked for."""
    if not {*PARAMETERS, *COVARIANCE, "asked_highest"} <= set(table):
        return {}
    found = {}
    values, variances = parameters_of(table)[:, :3], covariances_of(table)[:, :3, :3]
    for speed in SPEEDS:
        basis = (speed / KMH) ** np.arange(3)
        asked = table["asked_highest"].to_numpy(np.float64) >= speed / KMH - 1e-6
        std = np.sqrt(np.maximum(variances @ basis @ basis, 0.0))
        value = np.where(asked, values @ basis, np.nan)
        found[f"resistance at {speed:.0f} km/h"] = Values(value, std)
    return found
