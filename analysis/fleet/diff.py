"""What changed: two versions over the same trips, and every estimate that moved beyond its band.

The trips are the same on both sides, and so is their noise: where nothing changed an estimate is
the same to the last bit, and two bands say nothing of how far it may move. So each difference is
judged twice: against the band of the estimate itself (does it matter?), and, of many trips
together, against the scatter of the differences (is it systematic?).
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from scipy.sparse import csr_array
from scipy.special import stdtr

from analysis.adhesion.condition_map import empty_map_of
from analysis.adhesion.map_difference import q_values
from analysis.fleet.analyses import ANALYSES, analyses_named, code_of, computation_of
from analysis.fleet.maps import evidence_of_row
from analysis.fleet.update import EVIDENCE
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.catalogue import Computation
from trainlog.condition import estimated
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.summaries import COVARIANCE, PARAMETERS, covariances_of, parameters_of
from trainlog.presentation import (
    NUMBER,
    Column,
    Presented,
    Quantity,
    WordTable,
    new_table,
    with_band,
)
from trainlog.progress import note
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.evidence import DailyEvidence
from trainlog.spans import runs_of
from trainlog.units import DAY, JOULES_PER_KWH, KMH, NANOSECONDS

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue


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
    left, right = (piece.reset_index() for piece in pieces[0].align(pieces[1], axis=0))
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


REACH = 1.96
"""Standard deviations of a band to one side."""

ROUNDING, ROUNDING_OF_BAND = 1e-6, 1e-3
"""Share of a value, and of its standard deviation, that rounding moves on other machines."""

WITHOUT_BAND = 0.01
"""Share of a value, or of the root mean square over all trips where that is more, that counts as
the band of a figure that is no count and has none of its own."""

RATE = 0.05
"""False discovery rate among the means over several trips."""

LEAST_TRIPS = 3
"""Of which a mean is judged."""

CLASSES = ("same", "rounding", "within", "beyond")
"""Of a difference: the same to the bit, within rounding, within the band, beyond the band."""

SAME, ROUNDED, WITHIN, BEYOND = range(len(CLASSES))

FRAMES: dict[str, tuple[str, ...]] = {
    "estimates": ("analysis", "estimate", "unit", "rows", *CLASSES, "band_ratio"),
    "trip_counts": ("analysis", "trips", *CLASSES),
    "moved": (
        "analysis", "estimate", "unit", "key", "trip", "train", "kind", "place", "start",
        "first", "second", "std", "bands", "banded",
    ),
    "means": (
        "analysis", "estimate", "unit", "of", "name", "trips", "moved", "value", "value_std",
        "shift", "shift_std", "bands", "p", "q", "systematic", "beyond",
    ),
    "verdicts": (
        "analysis", "key", "trip", "train", "kind", "line", "start", "first", "second",
    ),
    "words": (
        "analysis", "key", "trip", "train", "kind", "line", "start", "estimate", "first", "second",
    ),
    "places": ("place", "layer", "from_km", "to_km", "first", "second", "std_log", "bands"),
}  # fmt: skip
"""Columns of the frames of a `FleetDiff`."""


@dataclass(frozen=True)
class Pair:
    """The estimates of the same rows on both sides.

    Attributes
    ----------
    names : list of str
    units : list of str
        As they are shown.
    a, b : (n, m) array
        Of each row, by estimate: the first side's and the second's.
    a_std, b_std : (n, m) array
        NaN: no band.
    counted : (m,) bool array
        See `Values`.
    """

    names: list[str]
    units: list[str]
    a: FloatArray
    b: FloatArray
    a_std: FloatArray
    b_std: FloatArray
    counted: BoolArray


def paired(name: str, left: pd.DataFrame, right: pd.DataFrame) -> Pair:
    """The estimates that both tables of an analysis give, where any row has one."""
    columns = {column.name: column for column in ANALYSES[name].columns} if name in ANALYSES else {}
    counts = {each.name for each in columns.values() if each.unit == "1" and each.kind == "count"}
    one, other = (estimates(table, counts | _COUNTS) for table in (left, right))
    names = [
        each
        for each in one
        if each in other and np.isfinite([one[each].value, other[each].value]).any()
    ]
    units = [columns[each].unit if each in columns else UNITS.get(each, "") for each in names]
    a, b, a_std, b_std = (
        np.array([getattr(side[each], what) for each in names]).reshape(len(names), len(left)).T
        for what in ("value", "std")
        for side in (one, other)
    )
    shown = [{"1": "", "ns": "s"}.get(unit, unit) for unit in units]
    counted = np.array([one[each].counted for each in names], dtype=np.bool_)
    return Pair(names, shown, a, b, a_std, b_std, counted)


_COUNTS = {"slips"}
"""Counts that may not be known, which a column of counts cannot hold."""


def classes_of(pair: Pair) -> tuple[IntArray, FloatArray]:
    """The class of each difference, and the half width of its band, both (n, m)."""
    a, b = pair.a, pair.b
    a_std, b_std = (np.where(std > 0.0, std, np.nan) for std in (pair.a_std, pair.b_std))
    difference, std = np.abs(b - a), np.fmin(a_std, b_std)
    known = np.isfinite(a)
    squares = np.sum(np.square(a, where=known, out=np.zeros(a.shape)), axis=0)
    typical = np.sqrt(squares / np.maximum(known.sum(axis=0), 1))
    size = np.fmax(np.abs(a), np.abs(b))
    rounding = ROUNDING * np.fmax(size, 1e-3 * typical) + ROUNDING_OF_BAND * np.nan_to_num(std)
    band = np.where(np.isfinite(std), REACH * std, WITHOUT_BAND * np.fmax(size, typical))
    found = np.full(a.shape, BEYOND)  # given by one side alone
    found[difference <= band] = WITHIN
    found[difference <= rounding] = ROUNDED
    # A band that changed alone is no move of its estimate, but not the same either.
    equal = (a == b) | (np.isnan(a) & np.isnan(b))
    alike = (pair.a_std == pair.b_std) | (np.isnan(pair.a_std) & np.isnan(pair.b_std))
    found[equal] = WITHIN
    found[equal & (np.abs(pair.b_std - pair.a_std) <= 2.0 * ROUNDING_OF_BAND * a_std)] = ROUNDED
    found[equal & alike] = SAME
    return found, band


def mean_shifts(about: pd.DataFrame, pair: Pair, classes: IntArray) -> pd.DataFrame:
    """The mean of a difference over all trips, over those of each train and of each place.

    Weighted by the precision of the first side, where it states one; a count by its own chance
    would weigh the small ones most, so that each counts alike. The standard error of the
    shift is that of the differences' own scatter; that of the mean value the larger of what the
    bands and the scatter of the values give.
    """
    moved = classes > ROUNDED
    both = np.isfinite(pair.a) & np.isfinite(pair.b) & moved.any(axis=0)
    stated = both & (pair.a_std > 0.0) & ~pair.counted
    banded = stated.any(axis=0)
    use = np.where(banded, stated, both)
    weight = np.where(use & banded, pair.a_std, 1.0) ** -2 * use
    a, d = np.where(use, pair.a, 0.0), np.where(use, pair.b - pair.a, 0.0)
    chance = np.where(use & pair.counted, pair.a_std, 0.0) ** 2
    parts = []
    for of in ("all trips", "train", "place"):
        names = about[of] if of in about else np.full(len(about), "all", dtype=object)
        codes, labels = pd.factorize(np.asarray(names, dtype=object), sort=True)
        kept = np.flatnonzero(codes >= 0)
        by = csr_array((np.ones(kept.size), (codes[kept], kept)), (len(labels), len(about)))
        count, total = by @ use.astype(np.float64), by @ weight
        with np.errstate(divide="ignore", invalid="ignore"):
            value, shift = by @ (weight * a) / total, by @ (weight * d) / total
            value_std, shift_std = (
                np.sqrt(count / np.maximum(count - 1.0, 1.0) * (by @ square)) / total
                for square in (
                    (weight * np.where(use, each - mean[codes], 0.0)) ** 2
                    for each, mean in ((a, value), (d, shift))
                )
            )
            value_std = np.where(banded, np.fmax(value_std, np.sqrt(1.0 / total)), value_std)
            value_std = np.fmax(value_std, np.sqrt(by @ chance) / total)
        several = (count > 0.0).sum(axis=0) > (of != "all trips")
        column, row = np.nonzero(((count > 0.0) & several).T)
        parts.append(
            pd.DataFrame(
                {
                    "estimate": np.array(pair.names, dtype=object)[column],
                    "unit": np.array(pair.units, dtype=object)[column],
                    "of": of, "name": np.asarray(labels, dtype=object)[row],
                    "trips": count[row, column].astype(np.int64),
                    "moved": (by @ (moved & use).astype(np.float64))[row, column].astype(np.int64),
                    "value": value[row, column], "value_std": value_std[row, column],
                    "shift": shift[row, column], "shift_std": shift_std[row, column],
                }
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def judged(means: pd.DataFrame) -> pd.DataFrame:
    """Means with the probability of their shift by chance, and what follows."""
    shift, std = (means[name].to_numpy(np.float64) for name in ("shift", "shift_std"))
    freedom = np.maximum(means["trips"].to_numpy(np.float64) - 1.0, 1.0)
    # A shift that is the same in all trips but for rounding has no scatter to be judged by.
    std = np.fmax(std, ROUNDING * np.abs(means["value"].to_numpy(np.float64)))
    with np.errstate(divide="ignore", invalid="ignore"):
        score = np.where(shift == 0.0, 0.0, np.abs(shift) / std)
        bands = np.abs(shift) / (REACH * means["value_std"].to_numpy(np.float64))
    judged = means["trips"].to_numpy() >= LEAST_TRIPS
    p = np.where(judged, 2.0 * stdtr(freedom, -score), 1.0)
    q = np.ones(p.size)
    q[judged] = q_values(p[judged])
    systematic = q <= RATE
    bands = np.where(shift == 0.0, 0.0, bands)
    found = means.assign(
        bands=bands, p=p, q=q, systematic=systematic, beyond=systematic & (bands > 1.0)
    )
    order = found.sort_values(["beyond", "bands"], ascending=False, ignore_index=True)
    return order[list(FRAMES["means"])]


def moved_places(left: pd.DataFrame, right: pd.DataFrame) -> list[dict[str, Any]]:
    """Stretches where the map of all trips together moved beyond its band."""
    found = []
    for (edge, layer), rows in left.groupby(["edge", "layer"], sort=True):
        other = right.loc[rows.index]
        if (rows["evidence"] == other["evidence"]).all():
            continue
        one, its = _layer(rows), _layer(other)
        if one is None or its is None:
            continue
        (length, mine), (other_length, theirs) = one, its
        middle = (np.arange(mine.log_mean.size) + 0.5) * length
        nearest = np.clip((middle / other_length).astype(int), 0, theirs.log_mean.size - 1)
        mean, std = theirs.log_mean[nearest], theirs.log_std[nearest]
        both = mine.observed & theirs.observed[nearest]
        with np.errstate(invalid="ignore"):
            bands = np.abs(mean - mine.log_mean) / (REACH * np.fmin(mine.log_std, std))
        # Bins of another length begin and end elsewhere.
        alone = (mine.observed ^ theirs.observed[nearest]) & (length == other_length)
        for begin, end in runs_of((both & (bands > 1.0)) | alone):
            part = slice(begin, end)
            sides = (
                np.where(mine.observed, np.exp(mine.log_mean), np.nan)[part],
                np.where(theirs.observed[nearest], np.exp(mean), np.nan)[part],
            )
            largest = bands[part][both[part]]
            found.append(
                {
                    "place": edge, "layer": layer,
                    "from_km": (middle[begin] - 0.5 * length) / 1e3,
                    "to_km": (middle[end - 1] + 0.5 * length) / 1e3,
                    "first": _mean(sides[0]), "second": _mean(sides[1]),
                    "std_log": _mean(mine.log_std[part]),
                    "bands": float(largest.max()) if largest.size else np.inf,
                }
            )  # fmt: skip
    return found


def _mean(values: FloatArray) -> float:
    known = values[np.isfinite(values)]
    return float(known.mean()) if known.size else np.nan


def _layer(rows: pd.DataFrame) -> tuple[float, ConditionLayer] | None:
    """The map's layer that the evidence of all rows gives, with the length of its bins [m]."""
    given = rows[rows["evidence"].notna()]
    if not len(given):
        return None
    edge, layer, length, bin_length = given.iloc[0][["edge", "layer", "edge_length", "bin_length"]]
    total = DailyEvidence.total(evidence_of_row(each) for each in given["evidence"])
    empty = empty_map_of(edge, float(length), float(bin_length))
    made = estimated(replace(empty, layers={layer: ConditionLayer.unestimated(total)}))
    return float(bin_length), made.layers[layer]


MOST = 20
"""Rows of a table that lists single trips."""

JUDGED = (
    f"What states no band of its own has one in its place: a count of n that of chance, {REACH}"
    f" times the root of n (at least of 1); another figure {WITHOUT_BAND:.0%} of its value, or of"
    " its root mean square over all trips where that is more."
)
"""What stands in place of a band."""


_BANDS = Quantity("", "", 1.0, 2)

COUNTS = tuple(
    Column(heading, NUMBER, key)
    for key, heading in zip(
        CLASSES,
        ("same to the bit", "within rounding", "within the band", "beyond the band"),
        strict=True,
    )
)
_ANALYSIS, _ESTIMATE, _TRIP = Column("analysis"), Column("estimate"), Column("trip")
_TRAIN = Column("train", of=lambda row: row["train"] or "")
_APART = Column(
    "difference over its band",
    _BANDS,
    "bands",
    of=lambda row: row["bands"] if math.isfinite(row["bands"]) else "one side alone",
)


def _sides(words: Callable[..., str]) -> list[Column]:
    return [Column(f"{n} side", of=partial(words, name=n)) for n in ("first", "second")]


ESTIMATE_COLUMNS = (
    _ANALYSIS, _ESTIMATE, Column("values", NUMBER, of="rows"), *COUNTS,
    Column("bands, second over first", _BANDS, "band_ratio"),
)  # fmt: skip
MEAN_COLUMNS = (
    Column("of", of=lambda row: f"{row['of']} {row['name']}".removesuffix(" all")),
    _ANALYSIS, _ESTIMATE, Column("trips", NUMBER),
    Column("first side", of=lambda row: _number(row, "value", row["value_std"])),
    Column("shift on the same trips", of=lambda row: _number(row, "shift", row["shift_std"], "+")),
    Column("shift over its band", _BANDS, "bands", of=lambda row: min(row["bands"], 1e6)),
    Column("beyond the band", of=lambda row: "yes" if row["beyond"] else "no"),
)  # fmt: skip
MOVED_COLUMNS = (
    _TRIP, _TRAIN, Column("place", of=lambda row: row["place"] or ""), _ANALYSIS, _ESTIMATE,
    *_sides(lambda row, name: _number(row, name, row["std"])), _APART,
)  # fmt: skip
VERDICT_COLUMNS = (_TRIP, _TRAIN, _ANALYSIS, *_sides(lambda row, name: row[name] or ""))
PLACE_COLUMNS = (
    Column("line or edge", of="place"), Column("rail", of="layer"),
    Column("from, km", of=lambda row: f"{row['from_km']:.3f}"),
    Column("to, km", of=lambda row: f"{row['to_km']:.3f}"),
    *_sides(lambda row, name: "not observed" if math.isnan(row[name]) else f"{row[name]:.3f}"),
    _APART,
)  # fmt: skip
WORD_COLUMNS = (
    _TRIP, _ANALYSIS, Column("text", of="estimate"), *_sides(lambda row, name: str(row[name])),
)  # fmt: skip


def _number(row: Mapping[str, Any], name: str, std: float, plus: str = "") -> str:
    """A number with its band where it has one; large and small ones in six digits."""
    value, unit = row[name], f" {row['unit']}" if row["unit"] else ""
    if math.isnan(value):
        return "-"
    if unit == " J":
        value, std, unit = value / JOULES_PER_KWH, std / JOULES_PER_KWH, " kWh"
    plus = plus if value > 0.0 else ""
    if not math.isfinite(std) or std <= 0.0 or abs(value) > 1e9:
        return f"{plus}{value:.6g}{unit}"
    return plus + with_band(value, std, unit)


PRESENT = "now"
"""Names the code that runs."""


@dataclass(frozen=True)
class Version:
    """One side of a comparison: which code, with which parameters, computes the trips.

    Attributes
    ----------
    name : str
        As it was asked for.
    computations : mapping of str to Computation
        Of each analysis that it has, as results are recorded.
    present : bool
        Whether it is the code that runs.
    """

    name: str
    computations: Mapping[str, Computation]
    present: bool = False

    def __str__(self) -> str:
        if "=" in self.name:  # the code that runs, as on the other side: the parameters differ
            return self.name
        known = ", ".join(sorted({each.code for each in self.computations.values()}))
        return known if known.startswith(self.name) else f"{self.name} ({known})"


def version_of(name: str, catalogue: Catalogue) -> Version:
    """One side of a comparison, by its name.

    Parameters
    ----------
    name : str
        ``now``; parameters of the code that runs (``adhesion.bin_length=50``, several divided by
        commas); or the beginning of a version of which the catalogue has results.
    catalogue : Catalogue

    Raises
    ------
    InputError
        If it is none of these.
    """
    if name == PRESENT or "=" in name:
        own = {each: computation_of(analysis) for each, analysis in ANALYSES.items()}
        for each, values in typed_parameters(name if "=" in name else "").items():
            own[each] = computation_of(ANALYSES[each].with_parameters(**values))
        return Version(name, own, present=True)
    every = catalogue.computations()
    made = every[every["code"].str.startswith(name)]
    codes = sorted(set(made["code"]))
    if len(codes) > 1:
        raise InputError(
            f"'{name}' begins the versions {' and '.join(codes)}", remedy="give more of its digits"
        )
    if not codes:
        known = ", ".join(sorted(set(every["code"]))) or "none"
        raise InputError(
            f"the catalogue has no results of a version '{name}'; it has results of: {known}",
            file=catalogue.place,
            remedy=f"give '{PRESENT}', parameters (analysis.parameter=value) or the beginning of a"
            " version; results of another version come by 'trainlog fleet update' of that version",
        )
    first = made.drop_duplicates("analysis")
    about = first[["analysis", "code", "parameters"]].to_numpy().tolist()
    latest = {each[0]: Computation(*each) for each in about}
    present = {each: code_of(ANALYSES[each]) if each in ANALYSES else "" for each in latest}
    return Version(name, latest, present=set(present.values()) == set(codes))


def typed_parameters(text: str) -> dict[str, dict[str, Any]]:
    """Parameters of analyses, as they are typed.

    Raises
    ------
    InputError
        If it is no list of ``analysis.parameter=value``.

    Examples
    --------
    >>> typed_parameters("adhesion.bin_length=50, resistance.speeds=[5, 40]")
    {'adhesion': {'bin_length': 50}, 'resistance': {'speeds': [5, 40]}}
    """
    found: dict[str, dict[str, Any]] = {}
    for part in filter(None, re.split(r",\s*(?=\w+\.\w+=)", text.strip())):
        match = re.fullmatch(r"(\w+)\.(\w+)=(.*)", part.strip())
        if match is None:
            raise InputError(
                f"'{part}' is not a parameter of an analysis",
                remedy="write analysis.parameter=value, such as adhesion.bin_length=50",
            )
        analysis, parameter, value = match.groups()
        analyses_named([analysis])
        try:
            given = json.loads(value)
        except json.JSONDecodeError:
            given = value
        found.setdefault(analysis, {})[parameter] = given
    return found


def ensure_results(
    version: Version,
    catalogue: Catalogue,
    analyses: Sequence[str],
    where: str | None = None,
    workers: int | None = None,
) -> None:
    """Compute what the catalogue lacks of the trips on one side, if its code is the one that runs.

    Raises
    ------
    InputError
        If results of another version are lacking.
    """
    missing = [
        name for name in analyses if len(catalogue.pending(version.computations[name], where=where))
    ]
    if not missing:
        return
    if not version.present:
        raise InputError(
            f"the catalogue lacks results of {version} for some of the trips",
            file=catalogue.place,
            remedy="run 'trainlog fleet update' of that version, or choose fewer trips",
        )
    from analysis.fleet.update import UpdateOptions, update_fleet

    note(str(version))
    asked = [
        ANALYSES[name].with_parameters(**version.computations[name].parameters) for name in missing
    ]
    update_fleet(catalogue, asked, UpdateOptions(workers, where=where))


@dataclass(frozen=True, eq=False, repr=False)
class FleetDiff(Presented):
    """Where two versions differ over the same trips.

    Attributes
    ----------
    first, second : Version
    trips : int
        Compared.
    estimates : DataFrame
        A row an estimate: ``analysis``, ``estimate``, ``unit``, over how many ``rows``, and how
        many of these are ``same``, ``rounding``, ``within`` and ``beyond``; ``band_ratio``, the
        median of the second's bands over the first's.
    trip_counts : DataFrame
        A row an analysis: ``trips``, and of how many the worst is which of `CLASSES`.
    moved : DataFrame
        A row an estimate of a trip that moved beyond its band, by how many bands (``bands``);
        ``banded`` where it states a band of its own.
    means : DataFrame
        A row an estimate of all trips, a train, or a line or edge: the mean ``shift`` with its
        standard error on the same data (``shift_std``), the mean ``value`` of the first side with
        its own (``value_std``), ``q`` (false discovery rate), and whether it is ``systematic`` and
        ``beyond`` the band of the mean.
    verdicts : DataFrame
        Trips of which one side has a result and the other has none, with both reasons.
    words : DataFrame
        Trips whose texts (of findings, sources, missing channels) differ.
    places : DataFrame
        Stretches of the map that all trips together give where it moved beyond its band.
    by_definition : tuple of str
        What is not compared, as the parameters of the two sides change it by definition.
    """

    first: Version
    second: Version
    trips: int
    estimates: pd.DataFrame
    trip_counts: pd.DataFrame
    moved: pd.DataFrame
    means: pd.DataFrame
    verdicts: pd.DataFrame
    words: pd.DataFrame
    places: pd.DataFrame
    by_definition: tuple[str, ...] = ()

    @property
    def beyond(self) -> bool:
        """Whether anything moved beyond its band, or is given by one side alone."""
        found = (self.moved, self.verdicts, self.places)
        return any(map(len, found)) or bool(self.means["beyond"].any())

    @property
    def same(self) -> bool:
        """Whether every result is the same to the byte."""
        counts = self.trip_counts
        changed = len(self.verdicts) + len(self.words) + len(self.by_definition)
        return not changed and bool((counts["same"] == counts["trips"]).all())

    @property
    def title(self) -> str:
        """What is compared over how many trips."""
        return f"Difference of {self.second} to {self.first} over {counted(self.trips, 'trip')}"

    def summary(self) -> dict[str, str]:
        """How many estimates moved how far."""
        counts = {name: f"{int(self.estimates[name].sum()):,}" for name in CLASSES}
        return counts | {"given by one side": f"{len(self.verdicts):,}"}

    def facts(self) -> dict[str, Any]:
        """All of it; of single trips as many as the tables list."""
        return {
            "first": str(self.first),
            "second": str(self.second),
            "trips": self.trips,
            "same": self.same,
            "beyond": self.beyond,
            "analyses": self.trip_counts.to_dict("records"),
            "estimates": self.estimates.to_dict("records"),
            "means": self.systematic.to_dict("records"),
            "moved": self.moved.head(MOST).to_dict("records"),
            "moved_in_all": len(self.moved),
            "verdicts": self.verdicts.head(MOST).to_dict("records"),
            "verdicts_in_all": len(self.verdicts),
            "places": self.places.to_dict("records"),
            "words": len(self.words),
            "by_definition": self.by_definition,
        }

    @property
    def systematic(self) -> pd.DataFrame:
        """Means that moved systematically, the farthest first."""
        return self.means[self.means["systematic"].astype(bool)]

    def tables(self, most: int = MOST, *, changed: bool = True) -> list[WordTable]:
        """Counts, means, verdicts, places, single estimates and texts.

        Parameters
        ----------
        most : int
            Rows of those that list single trips, means or places.
        changed : bool
            Only estimates that moved beyond rounding.
        """

        def listed(
            name: str, title: str, rows: pd.DataFrame, columns: Sequence[Column], caption: str = ""
        ) -> WordTable:
            more = len(rows) - most
            words = f"{more:,} more are in the folder given by -o." if more > 0 else ""
            caption = " ".join(filter(None, (caption, words)))
            table = new_table(title, *columns, name=name, caption=caption or None)
            return table.add_rows(rows.head(most).to_dict("records"))

        counts = new_table(
            f"Trips of {self.second} against {self.first}",
            Column("analysis"), Column("trips", NUMBER), *COUNTS, name="analyses",
            caption="Beyond the band: an estimate at least, or one side alone has a result.",
        )  # fmt: skip
        estimates = self.estimates
        if changed:
            estimates = estimates[estimates["within"] + estimates["beyond"] > 0]
        places = self.places.sort_values("bands", ascending=False)
        return [
            counts.add_rows(self.trip_counts.to_dict("records")),
            listed("means", "Means that moved", self.systematic, MEAN_COLUMNS,
                   f"False discovery rate {RATE:.0%} among {len(self.means):,} means."),
            listed("verdicts", "Given by one side alone", self.verdicts, VERDICT_COLUMNS),
            listed("places", "Places of the track-condition map that moved", places,
                   PLACE_COLUMNS),
            listed("moved", "Estimates that moved beyond their band", self.moved, MOVED_COLUMNS),
            new_table("Estimates of single trips", *ESTIMATE_COLUMNS, name="estimates",
                      caption=JUDGED).add_rows(estimates.to_dict("records")),
            listed("words", "Texts that differ", self.words, WORD_COLUMNS),
        ]  # fmt: skip

    @property
    def sentence(self) -> str:
        """The difference in one sentence."""
        trips = counted(self.trips, "trip")
        if self.same:
            return f"every result of {trips} is the same to the byte."
        left_out = (
            f"; not compared, as the parameters change it: {', '.join(self.by_definition)}"
            if self.by_definition else ""
        )  # fmt: skip
        if not self.beyond:
            return f"nothing moved beyond its band on {trips}{left_out}."
        means, banded = int(self.means["beyond"].sum()), int(self.moved["banded"].sum())
        others = len(self.moved) - banded
        parts = [
            f"{counted(banded, 'estimate')} of single trips" if banded else "",
            f"{counted(others, 'figure')} without a band of single trips" if others else "",
            counted(means, "mean") if means else "",
            f"{counted(len(self.places), 'place')} of the map" if len(self.places) else "",
        ]  # fmt: skip
        words = ", ".join(filter(None, parts))
        said = [f"{words} moved beyond their band" if words else ""]
        said += [
            f"{counted(len(self.verdicts), 'result')} given by one side alone"
            if len(self.verdicts) else "",
            "no place of the map of all trips moved beyond its band"
            if EVIDENCE in self.trip_counts["analysis"].tolist() and not len(self.places) else "",
        ]  # fmt: skip
        return f"{'; '.join(filter(None, said))}, on {trips}{left_out}."


def fleet_diff(
    catalogue: Catalogue,
    first: str,
    second: str,
    *,
    analyses: Sequence[str] | None = None,
    where: str | None = None,
    workers: int | None = None,
) -> FleetDiff:
    """Compare two versions of the code, or two sets of parameters, over the trips of a catalogue.

    What the code that runs has not computed yet is computed, and recorded in the catalogue.

    Parameters
    ----------
    catalogue : Catalogue
    first, second : str
        As for `version_of`.
    analyses : sequence of str, optional
        Names; default: all that both sides have. Where a side is given by parameters, default:
        those that it gives parameters of.
    where : str, optional
        Chooses trips, as for `Catalogue.query`.
    workers : int, optional
        Processes.

    Raises
    ------
    InputError
        If a side is no version or lacks results, or no trip is chosen.
    """
    one, other = version_of(first, catalogue), version_of(second, catalogue)
    names = _asked_for(one, other, analyses)
    if not len(catalogue.query(where, columns=["key"])):
        raise InputError(
            "no trip is chosen", file=catalogue.place, remedy="choose others, or add logs"
        )
    for side in (one, other):
        ensure_results(side, catalogue, names, where, workers)
    results = {
        name: (_read(catalogue, one, name, where), _read(catalogue, other, name, where))
        for name in names
    }
    return compared(one, other, results)


def _asked_for(one: Version, other: Version, analyses: Sequence[str] | None) -> list[str]:
    both = [name for name in one.computations if name in other.computations]
    if analyses is not None:
        lacking = [name for name in analyses if name not in both]
        if lacking:
            raise InputError(
                f"one side has no analysis '{lacking[0]}'", remedy=f"give {', '.join(both)}"
            )
        return [name for name in both if name in analyses]
    differing = [name for name in both if one.computations[name] != other.computations[name]]
    if all(one.computations[name].code == other.computations[name].code for name in both):
        both = differing or both
    if not both:
        raise InputError(f"{one} and {other} have no analysis in common", remedy="update trainlog")
    return both


@dataclass(frozen=True)
class Results:
    """What a version has of an analysis: the table of all trips, and what became of each."""

    table: pd.DataFrame
    outcomes: pd.DataFrame

    def of(self, keys: set[str]) -> Results:
        """Those of some trips."""
        table, outcomes = self.table, self.outcomes
        return Results(table[table["key"].isin(keys)], outcomes[outcomes["key"].isin(keys)])


def _read(catalogue: Catalogue, side: Version, name: str, where: str | None) -> Results:
    given = side.computations[name]
    return Results(catalogue.results(given, where=where), catalogue.outcomes(given, where=where))


# ----------------------------------------------------------------------------------- comparing


def compared(
    first: Version, second: Version, results: Mapping[str, tuple[Results, Results]]
) -> FleetDiff:
    """The difference of what two versions gave, by the name of the analysis."""
    keys, by_name = set[str](), {}
    for name, sides in results.items():
        shared = set.intersection(*(set(side.outcomes["key"]) for side in sides))
        keys |= shared
        by_name[name] = _differences(name, *(side.of(shared) for side in sides))
    frames = {}
    for each, columns in FRAMES.items():
        parts = [
            found[each].assign(analysis=name)
            for name, (found, _) in by_name.items()
            if each in found and len(found[each])
        ]
        frames[each] = (
            pd.concat(parts, ignore_index=True) if parts else pd.DataFrame(columns=list(columns))
        )
    frames["means"] = judged(frames["means"])
    order = frames["moved"].sort_values(["banded", "bands"], ascending=False, ignore_index=True)
    frames = {
        each: frame[list(FRAMES[each])] for each, frame in (frames | {"moved": order}).items()
    }
    defined = [words for _, all_words in by_name.values() for words in all_words]
    return FleetDiff(
        first, second, len(keys), **frames, by_definition=tuple(dict.fromkeys(defined))
    )


def _differences(
    name: str, one: Results, other: Results
) -> tuple[dict[str, pd.DataFrame], tuple[str, ...]]:
    """Frames of a `FleetDiff` of an analysis of the same trips, and what is not compared."""
    verdicts = _verdicts(one.outcomes, other.outcomes)
    alone = set(verdicts["key"])
    left, right = aligned(*(each.table[~each.table["key"].isin(alone)] for each in (one, other)))
    about = trips_of(left)
    worst, words = np.where(other_bytes(left, right), WITHIN, SAME), []
    for column in texts(left, right):
        both = left[column].notna() & right[column].notna()
        changed = (both & (left[column] != right[column])).to_numpy()
        worst[changed] = WITHIN
        if changed.any() and column != "refused":
            sides = {"first": left[column][changed], "second": right[column][changed]}
            words.append(about[changed].assign(estimate=column, **sides))
    defined = by_definition(left, right)
    pair = paired(name, left, right)
    classes, band = classes_of(pair)
    known = np.isfinite(pair.a) | np.isfinite(pair.b)
    at, row = np.nonzero((classes == BEYOND).T)
    stated = ((pair.a_std > 0.0) | (pair.b_std > 0.0)) & ~pair.counted
    names, units = (np.array(each, dtype=object) for each in (pair.names, pair.units))
    with np.errstate(divide="ignore", invalid="ignore"):
        bands = np.abs(pair.b - pair.a) / band
    moved = about.iloc[row].assign(
        estimate=names[at], unit=units[at], first=pair.a[row, at],
        second=pair.b[row, at], std=pair.a_std[row, at], banded=stated[row, at],
        bands=np.where(np.isnan(bands), np.inf, bands)[row, at],
    )  # fmt: skip
    counts = {each: np.sum((classes == n) & known, axis=0) for n, each in enumerate(CLASSES)}
    by_estimate = {"estimate": names, "unit": units, "rows": known.sum(axis=0), **counts}
    ratio = [_ratio(*stds) for stds in zip(pair.b_std.T, pair.a_std.T, strict=True)]
    worst = np.maximum(worst, classes.max(axis=1, initial=SAME))
    keys = one.outcomes["key"].to_numpy()
    by_trip = pd.Series(worst).groupby(about["key"].to_numpy()).max().reindex(keys, fill_value=SAME)
    by_trip[list(alone)] = BEYOND
    numbers = np.bincount(by_trip.to_numpy(np.int64), minlength=len(CLASSES)).tolist()
    found = {
        "estimates": pd.DataFrame(by_estimate | {"band_ratio": ratio}),
        "trip_counts": pd.DataFrame(
            [dict(zip(CLASSES, numbers, strict=True)) | {"trips": len(keys)}]
        ),
        "moved": moved,
        "means": mean_shifts(about, pair, classes),
        "verdicts": verdicts,
        "words": pd.concat(words) if words else pd.DataFrame(),
    }
    if (
        "evidence" in left
        and "evidence" in right
        and not (left["evidence"] == right["evidence"]).all()
    ):
        found["places"] = pd.DataFrame(moved_places(left, right))
    return found, defined


def _ratio(other: FloatArray, one: FloatArray) -> float:
    both = (other > 0.0) & (one > 0.0)
    return float(np.median(other[both] / one[both])) if both.any() else np.nan


def _verdicts(one: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Trips of which one side alone has a result."""
    pair = one.merge(other[["key", "state", "reason"]], on="key", suffixes=("", "_other"))
    changed = pair[(pair["state"] == "done") != (pair["state_other"] == "done")]
    stated = {
        side: changed[f"state{end}"] + changed[f"reason{end}"].map(lambda x: f": {x}" if x else "")
        for side, end in (("first", ""), ("second", "_other"))
    }
    return changed.rename(columns={"name": "trip"}).assign(**stated)
