"""The report on a fleet: what the catalogue holds, and what is known of its trains and lines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from analysis.charts import BLUE, GREEN, GREY, ORANGE, Chart, Curve, Panel, Rule
from analysis.comparison.losses import CAUSES
from analysis.fleet.analyses import ANALYSES
from analysis.fleet.codes import code_of, computation_of
from analysis.fleet.columns import LOST
from analysis.fleet.maps import maps_folder
from analysis.fleet.table import form_of_reason
from analysis.fleet.trains import FleetTrains, trains_in
from analysis.reports.charts import as_part
from analysis.reports.fleet_attention import FleetFacts, attention_parts
from analysis.reports.fleet_trains import drift_parts, resistance_parts, unlike_parts
from analysis.reports.page import Page, Part, Section, Warned
from trainlog.arrays import BoolArray
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.presentation import DURATION, NUMBER, SHARE, Column, Quantity, WordTable, new_table
from trainlog.progress import note
from trainlog.units import JOULES_PER_KWH
from trainlog.version import __version__, code_version

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue
    from trainlog.railway.network import Network


MOST_ROWS = 60
"""Rows of a table by line, train or reason; the others are counted."""

MOST_BARS = 40
"""Trains or edges of one picture."""

DISTANCE = Quantity("m", "km", 1e-3, 0)
PER_KM = Quantity("J_m", "kWh/km", 1e3 / JOULES_PER_KWH, 2)
HOURS = Quantity("s", "h", 1.0 / 3600.0, 1)


@dataclass(frozen=True)
class FleetReportOptions:
    """What a report on a fleet is made with beside the catalogue.

    Attributes
    ----------
    where : str, optional
        Chooses trips, as for `Catalogue.query`.
    network : Network, optional
        On which the condition of the rail is drawn.
    maps : Path, optional
        Folder of the maps of its edges; default: that of the catalogue.
    at : Timestamp, optional
        For which the condition is forecast; default: the day after the last trip.
    """

    where: str | None = None
    network: Network | None = None
    maps: Path | None = None
    at: pd.Timestamp | None = None


@dataclass(frozen=True)
class _Fleet:
    """What of a catalogue the report shows; each part is read when it is first needed."""

    catalogue: Catalogue
    options: FleetReportOptions

    @cached_property
    def trips(self) -> pd.DataFrame:
        """All trips that are chosen."""
        return self.catalogue.query(self.options.where)

    @cached_property
    def trains(self) -> FleetTrains:
        """What is known of them."""
        return trains_in(self.catalogue, where=self.options.where)

    def results(self, name: str) -> pd.DataFrame:
        """What the present code has of an analysis, train and kind as the catalogue knows them."""
        computation = computation_of(ANALYSES[name])
        found = self.catalogue.results(computation, where=self.options.where)
        if not len(found):
            # Made by other code, until the fleet is updated.
            found = self.catalogue.results(name, where=self.options.where)
        about = self.trips.set_index("key")
        return found.assign(**{each: found["key"].map(about[each]) for each in ("train", "kind")})

    def outcomes(self, name: str) -> pd.DataFrame:
        """What became of an analysis of each trip, by the code whose results are shown."""
        computation = computation_of(ANALYSES[name])
        found = self.catalogue.outcomes(computation, where=self.options.where)
        return found if len(found) else self.catalogue.outcomes(name, where=self.options.where)


def write_fleet_report(
    catalogue: Catalogue, path: str | Path, options: FleetReportOptions | None = None
) -> Page:
    """Write the report on a fleet as one HTML page that needs no network.

    Parameters
    ----------
    catalogue : Catalogue
        Whose results `trainlog fleet update` made.
    path : path
        HTML file; written whole or not at all. The same results give the same bytes.
    options : FleetReportOptions, optional

    Raises
    ------
    InputError
        If no trip is chosen, or the page cannot be written.
    """
    page = fleet_page(catalogue, options or FleetReportOptions())
    page.write(path)
    return page


def fleet_page(catalogue: Catalogue, options: FleetReportOptions) -> Page:
    """The page of a fleet; parameters and errors as of `write_fleet_report`."""
    fleet = _Fleet(catalogue, options)
    if fleet.trips.empty:
        raise InputError(
            "no trip is chosen", file=catalogue.place, remedy="choose others, or add logs"
        )
    parts: Mapping[str, Callable[[_Fleet], list[Part]]] = {
        "What asks for attention": _attention,
        "The fleet in numbers": _numbers,
        "Trips": _trips,
        "Running resistance": lambda fleet: resistance_parts(fleet.trains),
        "Trains unlike the others": lambda fleet: unlike_parts(fleet.trains),
        "Drift": lambda fleet: drift_parts(fleet.trains),
        "Condition of the rail": _condition,
        "Energy and time": _energy,
        "Refused and failed": _refused,
        "Quality of the recordings": _quality,
    }
    sections = list[Section]()
    for title, made in parts.items():
        note(title)
        try:
            shown = made(fleet)
        except TrainlogError as error:
            shown = [Warned(f"Not shown: {error}.")]
        sections.append(Section(title, shown, whole_page=bool(sections)))
    chosen = f"trips: {options.where}" if options.where else ""
    return Page(f"Fleet of {counted(len(fleet.trips), 'trip')}", chosen, sections)


def _attention(fleet: _Fleet) -> list[Part]:
    try:
        trains: FleetTrains | str = fleet.trains
    except TrainlogError as error:
        trains = str(error)
    outcomes = {name: fleet.outcomes(name) for name in ANALYSES}
    return attention_parts(FleetFacts(fleet.trips, trains, outcomes, fleet.results("checks")))


# ------------------------------------------------------------------------------------ catalogue


def _numbers(fleet: _Fleet) -> list[Part]:
    trips = fleet.trips
    driving = fleet.results("driving")
    table = new_table("", "", "result", name="fleet")
    first, last = trips["start"].min(), trips["start"].max()
    days = trips["start"].dt.date.nunique()
    kinds = ", ".join(sorted(filter(None, trips["kind"].dropna().unique())))
    facts = {
        "trips": f"{len(trips):,}, {HOURS.words(float(trips['duration'].sum()))},"
        f" {DISTANCE.words(float(trips['distance'].sum()))}",
        "trains": f"{trips['train'].nunique():,}" + (f" of kind {kinds}" if kinds else ""),
        "lines and routes": f"{trips['line'].nunique():,}",
        "edges that were run over": f"{driving['edge'].nunique():,}"
        if len(driving)
        else "not known",
        "days": f"{days:,}, {first:%Y-%m-%d} to {last:%Y-%m-%d}",
        "rail condition": ", ".join(
            f"{count:,} {name or 'not stated'}"
            for name, count in trips["weather"].fillna("").value_counts().items()
        ),
        "recorded by": ", ".join(
            f"{name} ({count:,})" for name, count in trips["software"].value_counts().items()
        ),
        "report made by": f"trainlog {__version__}, code {code_version()}",
    }
    for name, words in facts.items():
        table.add_row(name, words)
    done = new_table(
        "Computed of them", "analysis", *(Column(each, NUMBER) for each in
        ("done", "refused", "failed", "pending")), "version of the code", name="computed",
    )  # fmt: skip
    late = []
    for name, analysis in ANALYSES.items():
        states = fleet.outcomes(name)["state"].value_counts()
        pending = len(trips) - int(states.sum())
        code = code_of(analysis)
        made = fleet.catalogue.computations()
        latest = made[made["analysis"] == name]["code"]
        known = code if (latest == code).any() else next(iter(latest), "")
        late += [name] if known not in ("", code) else []
        counts = [int(states.get(each, 0)) for each in ("done", "refused", "failed")]
        done.add_cells(name, *counts, pending, known or "-")
    parts: list[Part] = [table, done]
    if late:
        words = f"Computed by other code than this: {', '.join(late)}."
        parts.insert(0, Warned(f"{words} 'trainlog fleet update' computes them anew."))
    return parts


def _trips(fleet: _Fleet) -> list[Part]:
    trips = fleet.trips
    month = trips["start"].dt.strftime("%Y-%m")
    parts: list[Part] = [_by_day(trips)] if len(set(trips["start"].dt.date)) > 1 else []
    for title, keys in (
        ("line or route", trips["line"]),
        ("train", trips["train"]),
        ("month", month),
    ):
        if title != "month" or len(set(month)) > 1:
            parts.append(_grouped(trips, title, keys))
    return parts


def _grouped(trips: pd.DataFrame, title: str, keys: pd.Series) -> WordTable:
    """Trips counted by line, train or month; of many those with most trips."""
    name = title.split(" ")[0]
    groups = trips.assign(_by=keys.fillna("not stated"), _lost=trips["quality"] != "whole")
    found = groups.groupby("_by").agg(
        trips=("key", "size"), trains=("train", "nunique"), distance=("distance", "sum"),
        duration=("duration", "sum"), lost=("_lost", "sum"),
    )  # fmt: skip
    kept = found.nlargest(MOST_ROWS, "trips") if len(found) > MOST_ROWS else found
    trains = [Column("trains", NUMBER)] if name != "train" else []
    damaged = [Column("damaged logs", NUMBER)] if groups["_lost"].any() else []
    table = new_table(
        f"By {title}", name, Column("trips", NUMBER), *trains, Column("distance", DISTANCE),
        Column("time", HOURS), *damaged,
        name=f"by_{name}", caption=_more(len(found) - len(kept)),
    )  # fmt: skip
    for key, row in kept.sort_index().iterrows():
        table.add_cells(
            str(key), int(row["trips"]), *([int(row["trains"])] if trains else []),
            float(row["distance"]), float(row["duration"]),
            *([int(row["lost"])] if damaged else []),
        )  # fmt: skip
    return table


def _more(count: int) -> str | None:
    return f"{count:,} more with fewer trips" if count > 0 else None


def _by_day(trips: pd.DataFrame) -> Part:
    """Trips a day, of each kind of train."""
    day = trips["start"].dt.tz_localize(None).dt.floor("D")
    counts = trips.assign(_kind=trips["kind"].fillna("").replace("", "kind not stated"))
    table = pd.crosstab(day, counts["_kind"])
    table = table.reindex(pd.date_range(day.min(), day.max()), fill_value=0)

    at = pd.DatetimeIndex(table.index).as_unit("s").asi8 / 86_400.0
    top = table.cumsum(axis=1)
    colours = (BLUE, ORANGE, GREEN, GREY)
    bars = [
        Curve(
            str(kind),
            at,
            top[kind],
            colours[min(number, 3)],
            "bars",
            top[kind] - table[kind],
            hover={
                "day": [f"{day:%Y-%m-%d}" for day in table.index],
                str(kind): [str(count) for count in table[kind]],
            },
            width=0.85,
        )
        for number, kind in enumerate(table)
    ]
    ends = (float(at[0]) - 0.6, float(at[-1]) + 0.6)
    panel = Panel("trips per day", bars, 0.8, from_zero=True)
    return as_part(
        Chart("", [panel], "Trips of each day, by kind of train.", span=ends, dates=True)
    )


# ------------------------------------------------------------------------------------ condition


def _condition(fleet: _Fleet) -> list[Part]:
    from analysis.reports.fleet_condition import condition_parts

    folder = fleet.options.maps or maps_folder(fleet.catalogue)
    return condition_parts(folder, fleet.options.network, fleet.options.at)


# --------------------------------------------------------------------------------------- energy


def _energy(fleet: _Fleet) -> list[Part]:
    rows = fleet.results("driving")
    if rows.empty:
        return ["No trip has its times and energy computed."]
    rows = rows[rows["distance"] > 0.0]
    by_edge, by_train = (_energy_of(rows, by) for by in ("edge", "train"))
    return [
        "A run is that of a trip over one edge, or over the whole line where trips run on no"
        " network. Traction and dynamic brake are work at the wheel rims; from the line is what was"
        " drawn less what was fed back.",
        energy_sources(rows["line_energy_source"]),
        _bars(by_train, "train"),
        _energy_table(by_train, "train"),
        _bars(by_edge, "line or edge"),
        _energy_table(by_edge, "line or edge"),
        _lost(rows),
    ]


_SOURCES = {
    "recorded": "recorded",
    "efficiencies": "calculated by the efficiencies of the train's file",
    "": "not known",
}
"""Words of where the energy from the line is from."""


def energy_sources(sources: pd.Series) -> str:
    """Where the energy from the line of runs over an edge is from, with their number."""
    words = "; ".join(
        f"{_SOURCES.get(str(name), str(name))}: {counted(int(count), 'run')}"
        for name, count in sources.fillna("").value_counts().items()
    )
    return f"Energy from the line, of runs over an edge, {words}."


def _energy_of(rows: pd.DataFrame, by: str) -> pd.DataFrame:
    """Sums of runs by edge or train; energy only of runs of which it is known."""
    known = {
        name: rows["distance"].where(rows[name].notna()) for name in ("traction", "line_energy")
    }
    given = rows.assign(_traction_m=known["traction"], _line_m=known["line_energy"])
    found = given.groupby(by).agg(
        runs=("distance", "size"), distance=("distance", "sum"), traction=("traction", "sum"),
        dynamic=("dynamic_braking", "sum"), line_energy=("line_energy", "sum"),
        traction_m=("_traction_m", "sum"), line_m=("_line_m", "sum"), slips=("slips", "sum"),
    )  # fmt: skip
    for name, over in (("traction", "traction_m"), ("line_energy", "line_m")):
        distance = found[over].replace(0.0, np.nan)
        found[f"{name}_per_m"] = found[name] / distance
    found["dynamic_per_m"] = found["dynamic"] / found["traction_m"].replace(0.0, np.nan)
    return found


def _energy_table(found: pd.DataFrame, what: str) -> WordTable:
    kept = found.nlargest(MOST_ROWS, "distance") if len(found) > MOST_ROWS else found
    table = new_table(
        f"Energy by {what}", what, Column("runs", NUMBER, "runs"),
        Column("distance", DISTANCE), Column("traction", PER_KM, "traction"),
        Column("dynamic brake", PER_KM, "dynamic_brake"),
        Column("from the line", PER_KM, "from_the_line"),
        Column("slip protection acted, times", NUMBER, "slips"),
        name=f"energy_by_{what.split(' ')[0]}", caption=_more(len(found) - len(kept)),
    )  # fmt: skip
    for name, row in kept.sort_index().iterrows():
        table.add_cells(
            str(name), int(row["runs"]), float(row["distance"]), float(row["traction_per_m"]),
            float(row["dynamic_per_m"]), float(row["line_energy_per_m"]), float(row["slips"]),
        )  # fmt: skip
    return table


def _bars(found: pd.DataFrame, what: str) -> Part:
    """Energy per kilometre, a bar each."""
    rows = found.nlargest(MOST_BARS, "distance").sort_index()
    per_km = 1e3 / JOULES_PER_KWH
    names = [str(each) for each in rows.index]
    bars = [
        Curve(words, sign * per_km * rows[column].to_numpy(np.float64), np.arange(len(rows)),
              colour, "bars", hover={what: names, words: [f"{per_km * each:.2f} kWh/km"
                                                          for each in rows[column]]},
              width=width, opacity=opacity, across=True)
        for words, column, sign, colour, width, opacity in (
            ("traction at the wheel", "traction_per_m", 1.0, BLUE, 0.78, 0.35),
            ("from the line less fed back", "line_energy_per_m", 1.0, BLUE, 0.42, 1.0),
            ("dynamic brake at the wheel", "dynamic_per_m", -1.0, GREEN, 0.78, 0.6),
        )
    ]  # fmt: skip
    values = np.concatenate([each.x for each in bars] + [np.zeros(1)])
    low, high = float(np.nanmin(values)), float(np.nanmax(values))
    alt = f"Energy per kilometre by {what}: at the wheel, by the dynamic brake, and from the line."
    panel = Panel("", bars, 0.3 + 0.085 * len(rows), rows=names, rules=[Rule(0.0, upright=True)])
    return as_part(Chart("energy, kWh/km", [panel], alt, span=(1.05 * low, 1.05 * high or 1.0)))


def _lost(rows: pd.DataFrame) -> WordTable:
    """Time lost against the shortest run with the same stops, by cause."""
    table = new_table(
        "Time against the shortest run with the same stops", "cause", Column("a run", DURATION),
        Column("share of the running time", SHARE, "share"), "which is", name="lost_time",
    )  # fmt: skip
    for cause in LOST:
        column = f"lost_{cause.replace(' ', '_')}"
        if column not in rows:
            continue
        values = rows[column].to_numpy(np.float64)
        known = np.isfinite(values)
        if known.any():
            time = float(rows["running_time"].to_numpy(np.float64)[known].sum())
            mean, share = float(values[known].mean()), float(values[known].sum()) / time
            table.add_cells(cause, mean, share, CAUSES[cause].removeprefix(f"{cause}: "))
    return table


# -------------------------------------------------------------------------------------- quality


def _refused(fleet: _Fleet) -> list[Part]:
    """Trips without a result, by analysis and reason; figures and names do not part reasons."""
    table = new_table(
        "Without a result", "analysis", "state", Column("trips", NUMBER), Column("trains", NUMBER),
        "reason, of one of them", "this trip", name="refused",
    )  # fmt: skip
    for name in ANALYSES:
        found = fleet.outcomes(name)
        found = found[found["state"] != "done"]
        form = found["reason"].map(form_of_reason)
        groups = list(found.groupby(["state", form]))
        for (state, _), rows in sorted(groups, key=lambda each: -len(each[1]))[:MOST_ROWS]:
            first = rows.iloc[0]
            trains = rows["train"].nunique()
            reason = first["reason"].removeprefix(f"trip '{first['name']}': ")
            table.add_cells(name, str(state), len(rows), trains, reason, first["name"])
    return [table] if table.rows else ["Every analysis has a result of every trip."]


def _quality(fleet: _Fleet) -> list[Part]:
    rows = fleet.results("checks")
    if rows.empty:
        return ["No recording was checked."]
    table = new_table(
        "What is doubtful", "what", Column("trips", NUMBER), Column("trains", NUMBER),
        "most of them", name="checks",
    )  # fmt: skip
    for what, chosen in _doubts(rows):
        trains = rows["train"][chosen].value_counts()
        most = ", ".join(f"{name} ({count:,})" for name, count in trains.head(4).items())
        if what == SPEED_OFF:
            most = _sizes(100.0 * (rows["speed_scale"][chosen] - 1.0), rows["train"][chosen])
        table.add_cells(what, int(chosen.sum()), len(trains), most)
    numbers = new_table(
        "Figures of all recordings", "figure", "median", "95 % of the trips are below", "largest",
        name="figures",
    )  # fmt: skip
    for name, words, factor in _FIGURES:
        values = rows[name].to_numpy(np.float64)
        known = factor * np.abs(values[np.isfinite(values)])
        if known.size:
            numbers.add_row(
                words, *(f"{each:.3g}" for each in (*np.quantile(known, (0.5, 0.95)), known.max()))
            )
    nothing = ["Nothing is doubtful."] if not table.rows else [table]
    return [*nothing, numbers]


_FIGURES = (
    ("gap_time", "time in gaps, s", 1.0),
    ("repairs", "repairs by ingest", 1.0),
    ("fix_beside", "fixes beside the line's geometry, m", 1.0),
    ("fix_along", "fixes along the line against the recorded chainage, m", 1.0),
)


LEAST_SPEED_OFF = 0.002
"""A recorded speed that is off by a smaller share is no doubt: wheels wear by as much."""

SPEED_OFF = f"recorded speed off by more than its band and {100.0 * LEAST_SPEED_OFF:g} %"


def _sizes(percent: pd.Series, train: pd.Series) -> str:
    """By how much the speeds of trains are off: of those with most trips median and largest."""
    words = []
    for name in train.value_counts().head(4).index:
        own = percent[train == name]
        largest = float(own[own.abs().idxmax()])
        words.append(
            f"{name} ({len(own):,}; median {float(own.median()):+.2f} %, largest {largest:+.2f} %)"
        )
    return ", ".join(words)


def _doubts(rows: pd.DataFrame) -> Iterator[tuple[str, BoolArray]]:
    """Each doubt with the trips that have it."""
    yield from _doubt("damaged log", rows["damage"] != "")
    yield from _doubt("gaps in the train's state", rows["gaps"] > 0)
    yield from _doubt("repaired by ingest", rows["repairs"] > 0)
    for column, words in (("missing", "not recorded: {}"), ("frozen", "repeats a value: {}")):
        listed = rows[column].str.split(", ")
        names = sorted({name for each in listed for name in each if name})
        for name in names:
            yield from _doubt(words.format(name), listed.map(lambda each, name=name: name in each))
    size = (rows["speed_scale"] - 1.0).abs()
    off = (size > 1.96 * rows["speed_scale_std"]) & (size > LEAST_SPEED_OFF)
    yield from _doubt(SPEED_OFF, off)
    yield from _doubt("not all could be checked", rows["doubts"] != "")


def _doubt(words: str, chosen: pd.Series) -> Iterator[tuple[str, BoolArray]]:
    found = chosen.to_numpy(bool)
    if found.any():
        yield words, found
