"""What changed: two versions over the same trips, and every estimate that moved beyond its band.

The trips are the same on both sides, and so is their noise: where nothing changed an estimate is
the same to the last bit, and two bands say nothing of how far it may move. So each difference is
judged twice: against the band of the estimate itself (does it matter?), and, of many trips
together, against the scatter of the differences (is it systematic?).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from numpy.typing import NDArray
from scipy.special import stdtr

from analysis.adhesion.condition_map import empty_map_of
from analysis.adhesion.map_difference import q_values
from analysis.fleet.analyses import ANALYSES
from analysis.fleet.maps import evidence_of_row
from analysis.fleet.versions import Version, ensure_results, opened_version
from trainlog.condition import estimated
from trainlog.display import as_text, counted
from trainlog.errors import InputError
from trainlog.formats.summaries import COVARIANCE, PARAMETERS
from trainlog.railway.condition import ConditionLayer
from trainlog.railway.evidence import DailyEvidence
from trainlog.spans import runs_of
from trainlog.units import KMH, NANOSECONDS

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue

FloatArray = NDArray[np.float64]

REACH = 1.96
"""Standard deviations of a band to one side."""

ROUNDING, ROUNDING_OF_BAND = 1e-6, 1e-3
"""Share of a value, and of its standard deviation, that rounding moves on other machines."""

WITHOUT_BAND = 0.01
"""Share of a value that counts as its band where it has none of its own."""

RATE = 0.05
"""False discovery rate among the means over several trips."""

LEAST_TRIPS = 3
"""Of which a mean is judged."""

SPEEDS = (40.0, 80.0, 120.0)
"""At which curves of running resistance are compared [km/h]."""

CLASSES = ("same", "rounding", "within", "beyond")
"""Of a difference: the same to the bit, within rounding, within the band, beyond the band."""

_ABOUT = ("trip", "train", "kind", "line", "start", "edge", "layer", "direction")
_SKIPPED = {
    *("key", "sha256", "identity", "software", "message", "entry", "evidence", "gradients"),
    *("main_layer", "steps", "bin_length", "edge_length"),
}
"""Columns that say of which trip a row is or what made it, and bulk that is compared by place."""

_OF_BINS = {"bins", "weight", "weighted_log"}
"""Counts and sums over bins: of bins of two lengths they differ by definition, as the map need not.
"""


@dataclass(frozen=True)
class _Values:
    """An estimate on one side: a value a row, with its standard deviation (NaN: none)."""

    value: FloatArray
    std: FloatArray


@dataclass(frozen=True, repr=False)
class FleetDiff:
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

    @property
    def beyond(self) -> bool:
        """Whether anything moved beyond its band, or is given by one side alone."""
        means = len(self.means) and bool(self.means["beyond"].any())
        return bool(len(self.moved) or len(self.verdicts) or len(self.places) or means)

    @property
    def same(self) -> bool:
        """Whether every result is the same to the byte."""
        counts = self.trip_counts
        changed = len(self.verdicts) + len(self.words)
        return not changed and bool((counts["same"] == counts["trips"]).all())

    def __repr__(self) -> str:
        counts = {
            name: f"{int(self.estimates[name].sum()):,}" if len(self.estimates) else "0"
            for name in CLASSES
        }
        return as_text(
            f"Difference of {self.second} to {self.first} over {counted(self.trips, 'trip')}",
            counts | {"given by one side": f"{len(self.verdicts):,}"},
        )


def fleet_diff(
    catalogue: Catalogue,
    first: str,
    second: str,
    *,
    analyses: Sequence[str] | None = None,
    where: str | None = None,
    place: str | None = None,
    workers: int | None = None,
) -> FleetDiff:
    """Compare two versions of the code, or two sets of parameters, over the trips of a catalogue.

    What of either side is not in the catalogue is computed, and recorded there.

    Parameters
    ----------
    catalogue : Catalogue
    first, second : str
        As for `analysis.fleet.versions.opened_version`.
    analyses : sequence of str, optional
        Names; default: all that both sides have. Where a side is given by parameters, default:
        those that it gives parameters of.
    where : str, optional
        Chooses trips, as for `Catalogue.query`.
    place : str, optional
        As another process opens the catalogue; default: its folder.
    workers : int, optional
        Processes.

    Raises
    ------
    InputError
        If a side is no version or cannot compute the trips, or no trip is chosen.
    """
    with opened_version(first, catalogue) as one, opened_version(second, catalogue) as other:
        names = _asked_for(one, other, analyses)
        if not len(catalogue.query(where, columns=["key"])):
            raise InputError(
                "no trip is chosen", file=catalogue.place, remedy="choose others, or add logs"
            )
        for side in (one, other):
            ensure_results(side, catalogue, place or catalogue.place, names, where, workers)
        results = {
            name: (_read(catalogue, one, name, where), _read(catalogue, other, name, where))
            for name in names
        }
        first_side, second_side = (
            replace(side, command=(), environment={}) for side in (one, other)
        )
        return compared(first_side, second_side, results)


def _asked_for(one: Version, other: Version, analyses: Sequence[str] | None) -> list[str]:
    both = [name for name in one.parameters if name in other.parameters]
    if analyses is not None:
        lacking = [name for name in analyses if name not in both]
        if lacking:
            raise InputError(
                f"one side has no analysis '{lacking[0]}'", remedy=f"give {', '.join(both)}"
            )
        return [name for name in both if name in analyses]
    if one.codes == other.codes:
        both = [name for name in both if one.parameters[name] != other.parameters[name]] or both
    if not both:
        raise InputError(f"{one} and {other} have no analysis in common", remedy="update trainlog")
    return both


@dataclass(frozen=True)
class Results:
    """What a version has of an analysis: the table of all trips, and what became of each."""

    table: pd.DataFrame
    outcomes: pd.DataFrame


def _read(catalogue: Catalogue, side: Version, name: str, where: str | None) -> Results:
    given = (name, side.codes[name], side.parameters[name])
    return Results(catalogue.results(*given, where=where), catalogue.outcomes(*given, where=where))


# ----------------------------------------------------------------------------------- comparing


@dataclass
class _Found:
    """What was found so far, a list of parts for each frame of a `FleetDiff`."""

    estimates: list[dict[str, Any]] = field(default_factory=list)
    trip_counts: list[dict[str, Any]] = field(default_factory=list)
    moved: list[pd.DataFrame] = field(default_factory=list)
    means: list[pd.DataFrame] = field(default_factory=list)
    verdicts: list[pd.DataFrame] = field(default_factory=list)
    words: list[pd.DataFrame] = field(default_factory=list)
    places: list[dict[str, Any]] = field(default_factory=list)


MOVED = (
    "analysis", "estimate", "unit", "key", "trip", "train", "kind", "place", "start",
    "first", "second", "std", "bands", "banded",
)  # fmt: skip
MEANS = (
    "analysis", "estimate", "unit", "of", "name", "trips", "moved", "value", "value_std",
    "shift", "shift_std", "bands", "p", "q", "systematic", "beyond",
)  # fmt: skip
VERDICTS = ("analysis", "key", "trip", "train", "kind", "line", "start", "first", "second")
PLACES = ("place", "layer", "from_km", "to_km", "first", "second", "std_log", "bands")


def compared(
    first: Version, second: Version, results: Mapping[str, tuple[Results, Results]]
) -> FleetDiff:
    """The difference of what two versions gave, by the name of the analysis."""
    found = _Found()
    keys: set[str] = set()
    for name, (one, other) in results.items():
        shared = set(one.outcomes["key"]) & set(other.outcomes["key"])
        keys |= shared
        _compare(found, name, _of(one, shared), _of(other, shared))
    means = pd.concat(found.means, ignore_index=True) if found.means else None
    return FleetDiff(
        first,
        second,
        len(keys),
        pd.DataFrame(found.estimates),
        pd.DataFrame(found.trip_counts, columns=["analysis", "trips", *CLASSES]),
        _together(found.moved, MOVED).sort_values(
            ["banded", "bands"], ascending=False, ignore_index=True
        ),
        _judged(means) if means is not None else pd.DataFrame(columns=list(MEANS)),
        _together(found.verdicts, VERDICTS),
        _together(found.words, (*VERDICTS[:7], "estimate", "first", "second")),
        pd.DataFrame(found.places, columns=list(PLACES)),
    )


def _together(parts: list[pd.DataFrame], columns: Sequence[str]) -> pd.DataFrame:
    kept = [part for part in parts if len(part)]
    if not kept:
        return pd.DataFrame(columns=list(columns))
    return pd.concat(kept, ignore_index=True)[list(columns)]


def _of(results: Results, keys: set[str]) -> Results:
    table, outcomes = results.table, results.outcomes
    return Results(table[table["key"].isin(keys)], outcomes[outcomes["key"].isin(keys)])


def _compare(found: _Found, name: str, one: Results, other: Results) -> None:
    """Compare an analysis of the same trips on both sides."""
    found.verdicts.append(_verdicts(name, one.outcomes, other.outcomes))
    alone = set(found.verdicts[-1]["key"])
    left, right = _aligned(*(each.table[~each.table["key"].isin(alone)] for each in (one, other)))
    about = _about(left)
    columns = {column.name: column for column in ANALYSES[name].columns} if name in ANALYSES else {}
    worst = np.zeros(len(left), dtype=np.int64)
    for column in _texts(left, right):
        both = left[column].notna() & right[column].notna()
        changed = (both & (left[column] != right[column])).to_numpy()
        worst[changed] = np.maximum(worst[changed], CLASSES.index("within"))
        if changed.any() and column != "refused":
            rows = about[changed].assign(analysis=name, estimate=column)
            rows["first"], rows["second"] = left[column][changed], right[column][changed]
            found.words.append(rows)
    sides = _figures(left), _figures(right)
    other_bins = _other_bins(left, right)
    worst[other_bins] = np.maximum(worst[other_bins], CLASSES.index("within"))
    skipped = _OF_BINS if other_bins.any() else set[str]()
    means = []
    for estimate in [each for each in sides[0] if each in sides[1] and each not in skipped]:
        unit = columns[estimate].unit if estimate in columns else _UNITS.get(estimate, "")
        mine, its = sides[0][estimate], sides[1][estimate]
        if not (np.isfinite(mine.value) | np.isfinite(its.value)).any():
            continue
        classes, band = _classes(mine, its)
        worst = np.maximum(worst, classes)
        found.estimates.append(
            {"analysis": name, "estimate": estimate, "unit": _shown(unit)}
            | {"rows": int(np.sum(np.isfinite(mine.value) | np.isfinite(its.value)))}
            | {each: int(np.sum((classes == n) & _known(mine, its))) for n, each in
               enumerate(CLASSES)}
            | {"band_ratio": _ratio(its.std, mine.std)}
        )  # fmt: skip
        beyond = classes == CLASSES.index("beyond")
        if beyond.any():
            found.moved.append(_moved_rows(name, estimate, _shown(unit), about[beyond],
                                           mine, its, band, beyond))  # fmt: skip
        if (classes > CLASSES.index("rounding")).any():
            means.append(_means(about, estimate, _shown(unit), mine, its, classes))
    found.means += [each.assign(analysis=name) for each in means]
    _count_trips(found, name, one.outcomes["key"], about["key"].to_numpy(), worst, found.verdicts)
    if "evidence" in left and not (left["evidence"] == right["evidence"]).all():
        found.places += _places(left, right)


def _other_bins(left: pd.DataFrame, right: pd.DataFrame) -> NDArray[np.bool_]:
    """Rows of evidence whose bins are of another length on the other side."""
    if "bin_length" not in left or "bin_length" not in right:
        return np.zeros(len(left), dtype=np.bool_)
    lengths = [table["bin_length"].to_numpy(np.float64) for table in (left, right)]
    return np.asarray(np.isfinite(lengths[0] - lengths[1]) & (lengths[0] != lengths[1]))


def _known(mine: _Values, its: _Values) -> NDArray[np.bool_]:
    return np.asarray(np.isfinite(mine.value) | np.isfinite(its.value))


def _shown(unit: str) -> str:
    return {"1": "", "ns": "s"}.get(unit, unit)


def _ratio(other: FloatArray, one: FloatArray) -> float:
    both = (other > 0.0) & (one > 0.0)
    return float(np.median(other[both] / one[both])) if both.any() else np.nan


def _verdicts(name: str, one: pd.DataFrame, other: pd.DataFrame) -> pd.DataFrame:
    """Trips of which one side alone has a result."""
    pair = one.merge(other[["key", "state", "reason"]], on="key", suffixes=("", "_other"))
    changed = pair[(pair["state"] == "done") != (pair["state_other"] == "done")]
    stated = {
        "first": changed["state"] + changed["reason"].map(lambda each: f": {each}" if each else ""),
        "second": changed["state_other"]
        + changed["reason_other"].map(lambda each: f": {each}" if each else ""),
    }
    return changed.rename(columns={"name": "trip"}).assign(analysis=name, **stated)


def _aligned(one: pd.DataFrame, other: pd.DataFrame) -> tuple[pd.DataFrame, pd.DataFrame]:
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


def _about(table: pd.DataFrame) -> pd.DataFrame:
    """Of which trip, train and place each row is."""
    edge = table["edge"] if "edge" in table else table.get("line", pd.Series(dtype=object))
    layer = table.get("layer")
    place = edge if layer is None else edge + ", " + layer
    empty = pd.Series([None] * len(table), dtype=object)
    names = ("key", "trip", "train", "kind", "line", "start")
    return pd.DataFrame({name: table.get(name, empty) for name in names} | {"place": place})


def _texts(left: pd.DataFrame, right: pd.DataFrame) -> list[str]:
    skipped = _SKIPPED | set(_ABOUT)
    return [
        str(name)
        for name in left
        if name in right
        and name not in skipped
        and left[name].map(lambda each: isinstance(each, str)).any()
    ]


_UNITS = {f"resistance at {speed:.0f} km/h": "N" for speed in SPEEDS}


def _figures(table: pd.DataFrame) -> dict[str, _Values]:
    """The estimates of a table, with their standard deviations."""
    found: dict[str, _Values] = {}
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
            if name == "entered" and "start" in table:
                value = (value - pd.to_datetime(table["start"]).astype("int64")) / NANOSECONDS
            std = table[f"{name}_std"].to_numpy(np.float64) if f"{name}_std" in table else nothing
            if f"covariance_{name}_{name}" in table:
                std = np.sqrt(table[f"covariance_{name}_{name}"].to_numpy(np.float64))
            found[str(name)] = _Values(value, std)
        elif str(name).endswith("s") and f"{str(name)[:-1]}_stds" in table:
            found |= _listed(str(name)[:-1], column, table[f"{str(name)[:-1]}_stds"])
    return found | _curves(table)


def _listed(name: str, values: pd.Series, stds: pd.Series) -> dict[str, _Values]:
    """Columns of lists, an estimate a place in the list."""
    sizes = [len(each) if isinstance(each, np.ndarray | list | tuple) else 0 for each in values]
    table, bands = (np.full((len(sizes), max(sizes, default=0)), np.nan) for _ in range(2))
    for row, size in enumerate(sizes):
        if size:
            table[row, :size] = values.iloc[row]
            given = stds.iloc[row]
            bands[row, : min(size, len(given))] = given[:size]
    return {
        f"{name} {number + 1}": _Values(table[:, number], bands[:, number])
        for number in range(table.shape[1])
    }


def _curves(table: pd.DataFrame) -> dict[str, _Values]:
    """Running resistance at a few speeds, as far as a trip's curve was asked for."""
    if not {*PARAMETERS, *COVARIANCE, "asked_highest"} <= set(table):
        return {}
    found = {}
    values = table[["r0", "r1", "r2"]].to_numpy(np.float64)
    names = [(a, b) for a in range(3) for b in range(a, 3)]
    drag = ("r0", "r1", "r2")
    for speed in SPEEDS:
        basis = (speed / KMH) ** np.arange(3)
        variance = np.zeros(len(table))
        for a, b in names:
            term = table[f"covariance_{drag[a]}_{drag[b]}"].to_numpy(np.float64)
            variance += (1 + (a != b)) * basis[a] * basis[b] * term
        asked = table["asked_highest"].to_numpy(np.float64) >= speed / KMH - 1e-6
        value = np.where(asked, values @ basis, np.nan)
        std = np.sqrt(np.maximum(variance, 0.0))
        found[f"resistance at {speed:.0f} km/h"] = _Values(value, std)
    return found


def _classes(mine: _Values, its: _Values) -> tuple[NDArray[np.int64], FloatArray]:
    """Of each row the class of its difference, and the half width of its band."""
    a, b = mine.value, its.value
    difference = np.abs(b - a)
    std = np.fmin(np.where(mine.std > 0.0, mine.std, np.nan), its.std)
    std = np.where(std > 0.0, std, np.where(mine.std > 0.0, mine.std, np.nan))
    finite = a[np.isfinite(a)]
    typical = float(np.sqrt(np.mean(np.square(finite)))) if finite.size else 0.0
    size = np.fmax(np.abs(a), np.abs(b))
    rounding = ROUNDING * np.fmax(size, 1e-3 * typical) + ROUNDING_OF_BAND * np.nan_to_num(std)
    band = np.where(np.isfinite(std), REACH * std, WITHOUT_BAND * size)
    found = np.full(a.size, CLASSES.index("beyond"))  # given by one side alone
    found[difference <= band] = CLASSES.index("within")
    found[difference <= rounding] = CLASSES.index("rounding")
    # A band that changed alone is no move of its estimate, but not the same either.
    equal = (a == b) | (np.isnan(a) & np.isnan(b))
    alike = (mine.std == its.std) | (np.isnan(mine.std) & np.isnan(its.std))
    found[equal] = CLASSES.index("within")
    near = np.abs(its.std - mine.std) <= 2.0 * ROUNDING_OF_BAND * mine.std
    found[equal & near] = CLASSES.index("rounding")
    found[equal & alike] = CLASSES.index("same")
    return found, band


def _moved_rows(
    name: str,
    estimate: str,
    unit: str,
    about: pd.DataFrame,
    mine: _Values,
    its: _Values,
    band: FloatArray,
    rows: NDArray[np.bool_],
) -> pd.DataFrame:
    with np.errstate(divide="ignore", invalid="ignore"):
        bands = np.abs(its.value - mine.value)[rows] / band[rows]
    stated: dict[str, Any] = {
        "first": mine.value[rows],
        "second": its.value[rows],
        "std": mine.std[rows],
    }
    stated |= {"bands": np.where(np.isnan(bands), np.inf, bands)}
    stated |= {"banded": (mine.std[rows] > 0.0) | (its.std[rows] > 0.0)}
    return about.assign(analysis=name, estimate=estimate, unit=unit, **stated)


def _means(
    about: pd.DataFrame,
    estimate: str,
    unit: str,
    mine: _Values,
    its: _Values,
    classes: NDArray[np.int64],
) -> pd.DataFrame:
    """The mean of a difference over all trips, over those of each train and of each place.

    Weighted by the precision of the first side, where it states one. The standard error of the
    shift is that of the differences' own scatter; that of the mean value the larger of what the
    bands and the scatter of the values give.
    """
    both = np.isfinite(mine.value) & np.isfinite(its.value)
    banded = both & np.isfinite(mine.std) & (mine.std > 0.0)
    use = banded if banded.any() else both
    a, d = mine.value[use], (its.value - mine.value)[use]
    weight = mine.std[use] ** -2 if banded.any() else np.ones(a.size)
    moved = (classes > CLASSES.index("rounding"))[use]
    parts = []
    for of, names in (
        ("all trips", np.full(a.size, "all", dtype=object)),
        ("train", about["train"].to_numpy(object)[use]),
        ("place", about["place"].to_numpy(object)[use]),
    ):
        codes, labels = pd.factorize(names, sort=True)
        if of != "all trips" and len(labels) < 2:
            continue
        kept = codes >= 0
        sums = [
            np.bincount(codes[kept], each[kept], len(labels))
            for each in (np.ones(a.size), weight, weight * a, weight * d, moved * 1.0)
        ]
        count, total = sums[0], sums[1]
        value, shift = sums[2] / total, sums[3] / total
        scatter = [
            np.bincount(codes[kept], (weight**2 * (each - mean[codes]) ** 2)[kept], len(labels))
            for each, mean in ((a, value), (d, shift))
        ]
        spread = np.sqrt(count / np.maximum(count - 1, 1))
        value_std, shift_std = (spread * np.sqrt(each) / total for each in scatter)
        if banded.any():
            value_std = np.fmax(value_std, np.sqrt(1.0 / total))
        parts.append(
            pd.DataFrame(
                {
                    "estimate": estimate, "unit": unit, "of": of, "name": labels,
                    "trips": count.astype(np.int64), "moved": sums[4].astype(np.int64),
                    "value": value, "value_std": value_std, "shift": shift, "shift_std": shift_std,
                }
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def _judged(means: pd.DataFrame) -> pd.DataFrame:
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
    return order[list(MEANS)]


def _count_trips(
    found: _Found,
    name: str,
    keys: pd.Series,
    rows: NDArray[np.object_],
    worst: NDArray[np.int64],
    verdicts: list[pd.DataFrame],
) -> None:
    """Count of how many trips the worst difference is which."""
    by_trip = pd.Series(worst).groupby(rows).max().reindex(keys.to_numpy(), fill_value=0)
    by_trip[verdicts[-1]["key"].to_numpy()] = CLASSES.index("beyond")
    counts = np.bincount(by_trip.to_numpy(np.int64), minlength=len(CLASSES))
    found.trip_counts.append(
        {"analysis": name, "trips": len(by_trip)} | dict(zip(CLASSES, counts.tolist(), strict=True))
    )


# ---------------------------------------------------------------------------------------- places


def _places(left: pd.DataFrame, right: pd.DataFrame) -> list[dict[str, Any]]:
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
