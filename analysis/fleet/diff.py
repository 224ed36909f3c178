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
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from analysis.fleet.analyses import ANALYSES, analyses_named, code_of, computation_of
from analysis.fleet.diff_estimates import (
    UNITS,
    aligned,
    by_definition,
    estimates,
    other_bytes,
    texts,
    trips_of,
)
from analysis.fleet.diff_judgement import (
    CLASSES,
    MEANS,
    MOVED,
    RATE,
    REACH,
    WITHOUT_BAND,
    classes_of,
    judged,
    mean_shifts,
    moved_rows,
)
from analysis.fleet.diff_map import PLACES, moved_places
from analysis.fleet.update import EVIDENCE
from trainlog.arrays import FloatArray
from trainlog.catalogue import Computation
from trainlog.display import counted
from trainlog.errors import InputError
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
from trainlog.units import JOULES_PER_KWH

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue


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
        for each, values in parameters_of(name if "=" in name else "").items():
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


def parameters_of(text: str) -> dict[str, dict[str, Any]]:
    """Parameters of analyses, as they are typed.

    Raises
    ------
    InputError
        If it is no list of ``analysis.parameter=value``.

    Examples
    --------
    >>> parameters_of("adhesion.bin_length=50, resistance.speeds=[5, 40]")
    {'adhesion': {'bin_length': 50}, 'resistance': {'speeds': [5, 40]}}
    """
    found: dict[str, dict[str, Any]] = {}
    for part in filter(None, re.split(r",\s*(?=\w+\.\w+=)", text.strip())):
        match = re.fullmatch(r"(\w+)\.(\w+)=(.*)", part.strip())
        if match is None:
            raise InputError(
                f"'{part}' is no parameter of an analysis",
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
        means = len(self.means) and bool(self.means["beyond"].any())
        return bool(len(self.moved) or len(self.verdicts) or len(self.places) or means)

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
        counts = {
            name: f"{int(self.estimates[name].sum()):,}" if len(self.estimates) else "0"
            for name in CLASSES
        }
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
        return self.means[self.means["systematic"]] if len(self.means) else self.means

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
        if changed and len(estimates):
            estimates = estimates[estimates["within"] + estimates["beyond"] > 0]
        places = self.places
        if len(places):
            places = places.sort_values("bands", ascending=False)
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
        means = int(self.means["beyond"].sum()) if len(self.means) else 0
        banded = int(self.moved["banded"].sum()) if len(self.moved) else 0
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


def _read(catalogue: Catalogue, side: Version, name: str, where: str | None) -> Results:
    given = side.computations[name]
    return Results(catalogue.results(given, where=where), catalogue.outcomes(given, where=where))


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
    by_definition: list[str] = field(default_factory=list)


VERDICTS = ("analysis", "key", "trip", "train", "kind", "line", "start", "first", "second")


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
        judged(means) if means is not None else pd.DataFrame(columns=list(MEANS)),
        _together(found.verdicts, VERDICTS),
        _together(found.words, (*VERDICTS[:7], "estimate", "first", "second")),
        pd.DataFrame(found.places, columns=list(PLACES)),
        tuple(dict.fromkeys(found.by_definition)),
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
    left, right = aligned(*(each.table[~each.table["key"].isin(alone)] for each in (one, other)))
    about = trips_of(left)
    columns = {column.name: column for column in ANALYSES[name].columns} if name in ANALYSES else {}
    worst = np.zeros(len(left), dtype=np.int64)
    for column in texts(left, right):
        both = left[column].notna() & right[column].notna()
        changed = (both & (left[column] != right[column])).to_numpy()
        worst[changed] = np.maximum(worst[changed], CLASSES.index("within"))
        if changed.any() and column != "refused":
            rows = about[changed].assign(analysis=name, estimate=column)
            rows["first"], rows["second"] = left[column][changed], right[column][changed]
            found.words.append(rows)
    changed = other_bytes(left, right)
    worst[changed] = np.maximum(worst[changed], CLASSES.index("within"))
    found.by_definition += by_definition(left, right)
    counts = {each.name for each in columns.values() if each.unit == "1" and each.kind == "count"}
    sides = estimates(left, counts | _COUNTS), estimates(right, counts | _COUNTS)
    means = []
    for estimate in [each for each in sides[0] if each in sides[1]]:
        unit = columns[estimate].unit if estimate in columns else UNITS.get(estimate, "")
        mine, its = sides[0][estimate], sides[1][estimate]
        known = np.isfinite(mine.value) | np.isfinite(its.value)
        if not known.any():
            continue
        classes, band = classes_of(mine, its)
        worst = np.maximum(worst, classes)
        found.estimates.append(
            {"analysis": name, "estimate": estimate, "unit": _shown(unit)}
            | {"rows": int(known.sum())}
            | {each: int(np.sum((classes == n) & known)) for n, each in
               enumerate(CLASSES)}
            | {"band_ratio": _ratio(its.std, mine.std)}
        )  # fmt: skip
        beyond = classes == CLASSES.index("beyond")
        if beyond.any():
            found.moved.append(moved_rows(name, estimate, _shown(unit), about[beyond],
                                           mine, its, band, beyond))  # fmt: skip
        if (classes > CLASSES.index("rounding")).any():
            means.append(mean_shifts(about, estimate, _shown(unit), mine, its, classes))
    found.means += [each.assign(analysis=name) for each in means]
    keys = one.outcomes["key"].to_numpy()
    by_trip = pd.Series(worst).groupby(about["key"].to_numpy()).max().reindex(keys, fill_value=0)
    by_trip[list(alone)] = CLASSES.index("beyond")
    numbers = np.bincount(by_trip.to_numpy(np.int64), minlength=len(CLASSES)).tolist()
    found.trip_counts.append(
        {"analysis": name, "trips": len(by_trip), **dict(zip(CLASSES, numbers, strict=True))}
    )
    if "evidence" in left and not (left["evidence"] == right["evidence"]).all():
        found.places += moved_places(left, right)


_COUNTS = {"slips"}
"""Counts that may not be known, which a column of counts cannot hold."""


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
