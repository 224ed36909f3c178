"""Reports on a fleet: what is known of its trains and lines; what changed between versions."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import bins_table, with_ends
from analysis.adhesion.map_plot import lowest_bins
from analysis.charts import BLUE, GREEN, GREY, ORANGE, RED, Chart, Curve, Panel, Rule, Span
from analysis.comparison import CAUSES, LOST
from analysis.fleet.analyses import ANALYSES, code_of, computation_of
from analysis.fleet.channels import CHANNELS, raw_step
from analysis.fleet.checks import contradicted_dates
from analysis.fleet.diff import JUDGED, FleetDiff
from analysis.fleet.maps import maps_folder
from analysis.fleet.plot import channels_over_time, drift_charts, findings_charts, resistance_charts
from analysis.fleet.trains import FleetTrains, trains_in
from analysis.fleet.unlike import Step
from analysis.fleet.update import form_of_reason
from analysis.network.maps import NetworkMap, map_files, maps_in, network_table
from analysis.reports.answers import SPEED_OFF, doubts, map_words, summary_section, verdict_counts
from analysis.reports.page import Page, Part, Section, Still, Warned
from trainlog.catalogue.querying import problems_table
from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.files import csv_bytes, made_folder, write_bytes
from trainlog.presentation import (
    DURATION,
    HOURS,
    NUMBER,
    POSITION,
    SHARE,
    Column,
    Columns,
    Quantity,
    WordTable,
    facts_table,
    new_table,
    word_table,
)
from trainlog.progress import note
from trainlog.railway import Network
from trainlog.units import JOULES_PER_KWH
from trainlog.version import __version__, code_version

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue


MOST_ROWS = 60
"""Rows of a table by line, train or reason; the others are counted."""

MOST_URGENT = 3
"""Of what asks for attention, named on the first page."""

MOST_BARS = 40
"""Trains or edges of one picture."""

DISTANCE = Quantity("m", "km", 1e-3, 0)
PER_KM = Quantity("J_m", "kWh/km", 1e3 / JOULES_PER_KWH, 2)


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

    @cached_property
    def facts(self) -> FleetFacts:
        """What may ask for attention."""
        try:
            trains: FleetTrains | str = self.trains
        except TrainlogError as error:
            trains = str(error)
        outcomes = {name: self.outcomes(name) for name in ANALYSES}
        # Files without a trip satisfy no condition.
        files = pd.DataFrame() if self.options.where else self.catalogue.uncounted()
        return FleetFacts(self.trips, trains, outcomes, self.results("checks"), files)

    @cached_property
    def maps(self) -> KnownMaps:
        """The maps of the edges."""
        asked = self.options
        return known_maps(asked.maps or maps_folder(self.catalogue), asked.network, asked.at)

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
    parts: Mapping[str, Callable[[_Fleet], Sequence[Part]]] = {
        "Summary": _summary,
        "Needs attention": lambda fleet: attention_parts(fleet.facts),
        "The fleet in numbers": _numbers,
        "Trips": _trips,
        "Running resistance": lambda fleet: resistance_parts(fleet.trains),
        "Trains unlike the others": lambda fleet: unlike_parts(fleet.trains),
        "Drift": lambda fleet: drift_parts(fleet.trains),
        "Condition of the rail": lambda fleet: condition_parts(fleet.maps),
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


def _summary(fleet: _Fleet) -> Sequence[Part]:
    """The first page: drive, recordings, slippery places, cost, and what to do."""
    facts = _facts(fleet)
    levels = (
        max((each.level for each in doubts(row)), default=0)
        for row in fleet.results("checks").to_dict("records")
    )
    rows = fleet.results("driving")
    cost = ""
    if len(rows):
        (energy,) = _energy_of(rows.assign(all=0), "all").to_dict("records")
        cost = (
            f"{PER_KM.words(energy['traction_per_m'])} of traction at the wheel rims,"
            f" {PER_KM.words(energy['line_energy_per_m'])} from the line"
        )
    urgent = [f"{train}: {what}: {todo}" for train, what, _, _, todo in attention_rows(fleet.facts)]
    return summary_section(
        [f"{name}: {facts[name]}" for name in ("trips", "trains", "days")],
        verdict_counts(levels) or "not checked",
        fleet.maps.nothing or map_words(fleet.maps.bins),
        cost or "not computed",
        urgent[:MOST_URGENT] or ["nothing asks for attention"],
    ).parts


# ------------------------------------------------------------------------------------ catalogue


def _facts(fleet: _Fleet) -> dict[str, str]:
    """Trips, trains, lines and days, in words."""
    trips, driving = fleet.trips, fleet.results("driving")
    first, last = trips["start"].min(), trips["start"].max()
    kinds = ", ".join(sorted(filter(None, trips["kind"].dropna().unique())))
    edges = f"{driving['edge'].nunique():,}" if len(driving) else "not known"
    return {
        "trips": f"{len(trips):,}, {HOURS.words(float(trips['duration'].sum()))},"
        f" {DISTANCE.words(float(trips['distance'].sum()))}",
        "trains": f"{trips['train'].nunique():,}" + (f" of kind {kinds}" if kinds else ""),
        "lines and routes": f"{trips['line'].nunique():,}",
        "edges that were run over": edges,
        "days": f"{trips['start'].dt.date.nunique():,}, {first:%Y-%m-%d} to {last:%Y-%m-%d}",
        "rail condition": ", ".join(
            f"{count:,} {name or 'not stated'}"
            for name, count in trips["weather"].fillna("").value_counts().items()
        ),
        "recorded by": ", ".join(
            f"{name} ({count:,})" for name, count in trips["software"].value_counts().items()
        ),
        "report made by": f"trainlog {__version__}, code {code_version()}",
    }


def _numbers(fleet: _Fleet) -> list[Part]:
    trips = fleet.trips
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
    parts: list[Part] = [facts_table("", _facts(fleet), name="fleet"), done]
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
    columns = [
        Column(name, of="name"),
        Column("trips", NUMBER),
        *([Column("trains", NUMBER)] if name != "train" else []),
        Column("distance", DISTANCE),
        Column("time", HOURS, of="duration"),
        *([Column("damaged logs", NUMBER, of="lost")] if groups["_lost"].any() else []),
    ]
    return _table(f"By {title}", columns, found, "trips", f"by_{name}")


def _table(
    title: str, columns: Sequence[Column], rows: pd.DataFrame, by: str, name: str
) -> WordTable:
    """Rows in the order of their index; of many those that are largest by a column."""
    kept = rows.nlargest(MOST_ROWS, by) if len(rows) > MOST_ROWS else rows
    more = len(rows) - len(kept)
    caption = f"{more:,} more with fewer trips" if more else None
    table = new_table(title, *columns, name=name, caption=caption)
    return table.add_rows(kept.sort_index().rename_axis("name").reset_index().to_dict("records"))


def _by_day(trips: pd.DataFrame) -> Part:
    """Trips a day, of each kind of train."""
    day = trips["start"].dt.tz_localize(None).dt.floor("D")
    counts = trips.assign(_kind=trips["kind"].fillna("").replace("", "kind not stated"))
    table = pd.crosstab(day, counts["_kind"])
    at = pd.DatetimeIndex(table.index).as_unit("s").asi8 / 86_400.0
    top = table.cumsum(axis=1)
    colours, days = (BLUE, ORANGE, GREEN, GREY), [f"{day:%Y-%m-%d}" for day in table.index]
    bars = [
        Curve(str(kind), at, top[kind], colours[min(number, 3)], "bars", top[kind] - table[kind],
              hover={"day": days, str(kind): [str(count) for count in table[kind]]}, width=0.85)
        for number, kind in enumerate(table)
    ]  # fmt: skip
    ends = (float(at[0]) - 0.6, float(at[-1]) + 0.6)
    panel = Panel("trips per day", bars, 0.8, from_zero=True)
    return Chart("", [panel], span=ends, dates=True)


# --------------------------------------------------------------------------------------- energy


def _energy(fleet: _Fleet) -> list[Part]:
    rows = fleet.results("driving")
    if rows.empty:
        return ["No trip has its times and energy computed."]
    rows = rows[rows["distance"] > 0.0]
    by_edge, by_train = (_energy_of(rows, by) for by in ("edge", "train"))
    sources = rows["line_energy_source"]
    words = "; ".join(
        f"{_SOURCES.get(str(name), str(name))}: {counted(int(count), 'run')}"
        for name, count in sources.fillna("").value_counts().items()
    )
    return [
        "A run is that of a trip over one edge, or over the whole line where trips run on no"
        " network. Traction and dynamic brake are work at the wheel rims; from the line is what was"
        " drawn less what was fed back.",
        f"Energy from the line, of runs over an edge, {words}.",
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


def _energy_of(rows: pd.DataFrame, by: str) -> pd.DataFrame:
    """Sums of runs by edge or train; energy only of runs of which it is known."""
    works = {"_traction_m": "traction", "_line_m": "line_energy"}
    known = {name: rows["distance"].where(rows[work].notna()) for name, work in works.items()}
    found = rows.assign(**known).groupby(by).agg(
        runs=("distance", "size"), distance=("distance", "sum"), traction=("traction", "sum"),
        dynamic=("dynamic_braking", "sum"), line_energy=("line_energy", "sum"),
        traction_m=("_traction_m", "sum"), line_m=("_line_m", "sum"), slips=("slips", "sum"),
    )  # fmt: skip
    for name, over in (
        ("traction", "traction_m"),
        ("line_energy", "line_m"),
        ("dynamic", "traction_m"),
    ):
        found[f"{name}_per_m"] = found[name] / found[over].replace(0.0, np.nan)
    return found


def _energy_table(found: pd.DataFrame, what: str) -> WordTable:
    columns = [
        Column(what, of="name"),
        Column("runs", NUMBER),
        Column("distance", DISTANCE),
        Column("traction", PER_KM, of="traction_per_m"),
        Column("dynamic brake", PER_KM, of="dynamic_per_m"),
        Column("from the line", PER_KM, of="line_energy_per_m"),
        Column("slip protection acted, times", NUMBER, "slips"),
    ]
    name = f"energy_by_{what.split(' ')[0]}"
    return _table(f"Energy by {what}", columns, found, "distance", name)


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
    height, rules = 0.3 + 0.085 * len(rows), [Rule(0.0, upright=True)]
    panel = Panel("", bars, height, f"by {what}", rows=names, rules=rules)
    return Chart("energy, kWh/km", [panel], span=(1.05 * low, 1.05 * high or 1.0))


def _lost(rows: pd.DataFrame) -> WordTable:
    """Time lost against the shortest run with the same stops, by cause."""
    table = new_table(
        "Time against the shortest run with the same stops", "cause", Column("a run", DURATION),
        Column("share of the running time", SHARE, "share"), "which is", name="lost_time",
    )  # fmt: skip
    for cause, column in LOST.items():
        if column not in rows:
            continue
        values = rows[column].to_numpy(np.float64)
        known = np.isfinite(values)
        if known.any():
            time = float(rows["running_time"].to_numpy(np.float64)[known].sum())
            mean, share = float(values[known].mean()), float(values[known].sum()) / time
            table.add_cells(cause, mean, share, CAUSES[cause][0].removeprefix(f"{cause}: "))
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
    shown: list[Part] = [table] if table.rows else ["Every analysis has a result of every trip."]
    files = problems_table(fleet.catalogue)
    return [*shown, files] if files.rows and not fleet.options.where else shown


def _quality(fleet: _Fleet) -> list[Part]:
    rows = fleet.results("checks")
    if rows.empty:
        return ["No recording was checked."]
    table = new_table(
        "What is doubtful", "what", Column("trips", NUMBER), Column("trains", NUMBER),
        "most of them", name="checks",
    )  # fmt: skip
    found: dict[str, list[int]] = {}
    for number, row in enumerate(rows.to_dict("records")):
        for kind in (kind for each in doubts(row) for kind in each.kinds):
            found.setdefault(kind, []).append(number)
    for what, numbered in sorted(found.items(), key=lambda each: -len(each[1])):
        chosen = rows.iloc[numbered]
        trains = chosen["train"].value_counts()
        most = ", ".join(f"{name} ({count:,})" for name, count in trains.head(4).items())
        if what == SPEED_OFF:
            most = _sizes(100.0 * (chosen["speed_scale"] - 1.0), chosen["train"])
        table.add_cells(what, len(chosen), len(trains), most)
    numbers = new_table(
        "Figures of all recordings", "figure", "median", "95 % of the trips are below", "largest",
        name="figures",
    )  # fmt: skip
    for name, words, factor in _FIGURES:
        values = rows[name].to_numpy(np.float64)
        known = factor * np.abs(values[np.isfinite(values)])
        if known.size:
            figures = (*np.quantile(known, (0.5, 0.95)), known.max())
            numbers.add_row(words, *(f"{each:.3g}" for each in figures))
    return [table if table.rows else "Nothing is doubtful.", numbers]


_FIGURES = (
    ("gap_time", "time in gaps, s", 1.0),
    ("repairs", "repairs by ingest", 1.0),
    ("fix_beside", "fixes beside the line's geometry, m", 1.0),
    ("fix_along", "fixes along the line against the recorded chainage, m", 1.0),
)


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


# ----------------------------------------------------------------- what asks for attention

MOST_NAMES = 3
"""Trains that a row names."""

TO_DO = {
    "dragging brake": "look for a friction brake that does not release",
    "running resistance": "check bearings and gears, and what was coupled or loaded",
    "mass": "weigh the train, or correct the empty mass in its file",
    "effort gain": "calibrate the recorded efforts",
    "wheel diameter": "set the diameter in the recorder; expected after wheels were turned or"
    " changed",
    "sensor delay": "check clock and filter of the recorded efforts",
    "speed noise": "check the speed sensor and its cable",
}
"""What to do about each known fault."""

UNKNOWN = "look at its trips before and after ('trainlog compare')"
"""What to do about a change that no known fault explains."""

NO_RESULT = {
    "resistance": "no curve is known of it: record longer trips with coasting and several speeds",
    "passport": "its gain, delay and mass are not known: see the reason below",
    "adhesion": "it adds nothing to the maps: record the speeds of its axles (/train/axles)",
    "driving": "its times and energy are not known: see the reason below",
    "checks": "its recordings are not checked: see the reason below",
}
"""What follows where an analysis has no result of any trip of a train, and what to do."""


@dataclass(frozen=True)
class FleetFacts:
    """What is looked through.

    Attributes
    ----------
    trips : DataFrame
        Of the catalogue.
    trains : FleetTrains or str
        What is known of the trains, or why nothing is.
    outcomes : mapping of str to DataFrame
        What became of each analysis of each trip.
    checks : DataFrame
        Results of the checks of the recordings.
    files : DataFrame
        Files that do not count: `Catalogue.uncounted`.
    """

    trips: pd.DataFrame
    trains: FleetTrains | str
    outcomes: Mapping[str, pd.DataFrame]
    checks: pd.DataFrame
    files: pd.DataFrame = field(default_factory=pd.DataFrame)


def attention_rows(facts: FleetFacts) -> list[Row]:
    """What asks for attention, what is most urgent first."""
    return [
        *_findings(facts),
        *_steps(facts),
        *_results(facts),
        *_files(facts),
        *_recordings(facts),
        *_dates(facts),
    ]


def attention_parts(facts: FleetFacts) -> list[Part]:
    """What asks for attention, what is most urgent first, each with what to do."""
    rows = attention_rows(facts)
    # Where little can be compared, no finding is no all-clear.
    few = "" if isinstance(facts.trains, str) else facts.trains.too_few
    warned: list[Part] = [Warned(few)] if few else []
    if not rows:
        words = (
            "every analysis has results of every train, no train has a finding or a step, no file"
        )
        return [f"Nothing: {words} is refused or damaged.", *warned]
    table = new_table("", *ATTENTION, name="attention").add_rows(rows, MOST_ROWS)
    return [table, *warned]


Row = tuple[str, str, str, int | None, str]
"""Train, what, since when, in how many trips, what to do."""

ATTENTION = (
    Column("train", of=lambda row: row[0]),
    Column("what", of=lambda row: row[1]),
    Column("since", of=lambda row: row[2]),
    Column("trips", NUMBER, of=lambda row: row[3]),
    Column("what to do", of=lambda row: row[4]),
)


def _findings(facts: FleetFacts) -> Iterator[Row]:
    if isinstance(facts.trains, str):
        yield "all", f"trains are not compared: {facts.trains}", "", None, "see the reason"
        return
    starts = facts.trips.groupby("train")["start"]
    by_train = {str(name): each for name, each in starts}
    for each in facts.trains.unlike.findings:
        causes = [each.explanation.cause, *each.explanation.others]
        known = [TO_DO[cause.what] for cause in causes if cause.what in TO_DO]
        todo = known if each.explanation.explained else [UNKNOWN]
        since = each.lasts(by_train.get(each.train, pd.Series(dtype="datetime64[ns, UTC]")))
        yield (
            each.train, str(each.explanation), f"{each.since:%Y-%m-%d %H:%M}", int(since.sum()),
            "; or ".join(dict.fromkeys(todo)) or UNKNOWN,
        )  # fmt: skip


def _steps(facts: FleetFacts) -> Iterator[Row]:
    """Steps that are no finding, also of recordings that no train was compared by."""
    unlike = None if isinstance(facts.trains, str) else facts.trains.unlike
    steps = list(unlike.steps) if unlike else []
    stated = {each.train for each in steps if each.channel == SPEED.name}
    if unlike is not None:
        stated |= {each.train for each in unlike.findings if each.channel == SPEED.name}
    if "speed_scale" in facts.checks and "start" in facts.checks:
        known = facts.checks[np.isfinite(facts.checks["speed_scale"].to_numpy(np.float64))]
        for train, rows in known.sort_values("start").groupby("train"):
            seen = raw_step(np.log(rows["speed_scale"].to_numpy(np.float64)), SPEED.tolerance)
            if seen is not None and train not in stated:
                at, size, deviations = seen
                since, after = pd.Timestamp(rows["start"].iloc[at]), len(rows) - at
                steps.append(Step(str(train), SPEED.name, "1", size, deviations, since, after))
    for each in steps:
        yield each.train, str(each), f"{each.since:%Y-%m-%d %H:%M}", each.trips, UNKNOWN


SPEED = next(each for each in CHANNELS if each.name == "speed scale")


def _results(facts: FleetFacts) -> Iterator[Row]:
    """Results that are missing of all trips of a train, that failed, or are not computed yet."""
    for name, outcomes in facts.outcomes.items():
        pending = len(facts.trips) - len(outcomes)
        if pending:
            words = "not computed yet" if len(outcomes) else "not computed"
            yield "all", f"{name}: {words}", "", pending, "'trainlog fleet update' computes it"
        failed = outcomes[outcomes["state"] == "failed"]
        if len(failed):
            todo = "'trainlog fleet show --problems' lists them; a fault of trainlog: report it"
            yield _named(failed["train"]), f"{name}: failed", "", len(failed), todo
        done = (outcomes["state"] == "done").groupby(outcomes["train"].fillna("")).any()
        lacking = outcomes[outcomes["train"].fillna("").isin(done.index[~done])]
        if len(lacking):
            yield (
                _named(lacking["train"]), f"{name}: no trip gives a result", "", len(lacking),
                NO_RESULT.get(name, "see the reason below"),
            )  # fmt: skip


def _files(facts: FleetFacts) -> Iterator[Row]:
    """Files that are no trip: refused by the catalogue, or vanished since."""
    for what, todo in (
        ("refused", "read the reason under 'Refused and failed', and copy or ingest them again"),
        ("vanished", "restore them, or 'trainlog fleet remove' their trips"),
    ):
        count = int((facts.files["what"] == what).sum()) if len(facts.files) else 0
        if count:
            yield "not stated", f"{counted(count, 'file')} {what}", "", None, todo


def _recordings(facts: FleetFacts) -> Iterator[Row]:
    rows = facts.checks
    if rows.empty:
        return
    doubts = {
        "damaged log": (rows["damage"] != "", "recover it: 'trainlog convert'"),
        "a channel repeats its value while the train moves": (
            rows["frozen"] != "", "check the sensor; its values are not used",
        ),
    }  # fmt: skip
    for what, (chosen, todo) in doubts.items():
        found = rows[chosen.to_numpy(bool)]
        if len(found):
            yield _named(found["train"]), what, "", len(found), todo


def _dates(facts: FleetFacts) -> Iterator[Row]:
    """Trips whose dates cannot all be right."""
    todo = (
        "check clock and zone of the recorder, and that no two vehicles have one name; ingest again"
    )
    for what, rows in contradicted_dates(facts.trips).groupby("what", sort=False):
        first = f"{rows['start'].min():%Y-%m-%d %H:%M}"
        yield _named(rows["train"].fillna("")), str(what), first, len(rows), todo


def _named(trains: pd.Series) -> str:
    """The trains, those with most trips first; of many a few and how many more."""
    names = [str(each) for each in trains.replace("", np.nan).dropna().value_counts().index]
    if not names:
        return "not stated"
    more = len(names) - MOST_NAMES
    words = ", ".join(sorted(names[:MOST_NAMES]))
    return words if more <= 0 else f"{words} and {counted(more, 'other')}"


# ---------------------------------------------------------------------- condition of the rail

MOST_PLACES = 10
"""Places that are listed of each rail condition."""


class KnownMaps(NamedTuple):
    """Maps of edges by the evidence of the days before a time.

    Attributes
    ----------
    maps : NetworkMap
    at : Timestamp
    nothing : str
        Why nothing is known; empty where something is.
    bad : list of str
        Maps that could not be used, and why.
    bins : DataFrame
        Rows of `bins_table` of all of them.
    """

    maps: NetworkMap
    at: pd.Timestamp
    nothing: str
    bad: list[str]
    bins: pd.DataFrame


def known_maps(
    folder: Path, network: Network | None = None, at: pd.Timestamp | None = None
) -> KnownMaps:
    """The maps of all edges in a folder.

    Parameters
    ----------
    folder : Path
        As `trainlog fleet update` keeps them: a file an edge.
    network : Network, optional
        On which they are drawn.
    at : Timestamp, optional
        Only evidence of days before its day counts (UTC). Default: right after the last evidence.
    """
    paths = map_files(folder)
    tracks, problems = maps_in(paths)
    last = max((int(each.days.max(initial=-1)) for each in tracks.values()), default=-1)
    at = pd.Timestamp(last + 1, unit="D", tz="UTC") if at is None else at
    maps = NetworkMap(folder, network, tracks).known_before(at)
    tables = [
        bins_table(each, None, at).assign(line=edge)
        for edge, each in maps.maps.items()
        if each.layers
    ]
    before = f" of days before {at:%Y-%m-%d}" if 0 <= at.timestamp() // 86_400 <= last else ""
    nothing = "" if tables else f"The maps have no evidence{before} yet."
    if not paths:
        nothing = "No trip's evidence is in a map yet: 'trainlog fleet update' adds it."
    bad = [f"Not used: {each}." for each in problems]
    return KnownMaps(maps, at, nothing, bad, pd.concat([*tables, pd.DataFrame()]))


def condition_parts(known: KnownMaps) -> list[Part]:
    """What is expected of the rail, where, and how sure that is."""
    bad: list[Part] = [Warned(each) for each in known.bad]
    if known.nothing:
        return [*bad, known.nothing]
    maps, at = known.maps, known.at
    return [
        *bad,
        f"What is expected on {at:%Y-%m-%d %H:%M} UTC, by the maps of"
        f" {counted(len(maps.maps), 'edge')}, on each condition of the rail. Where nothing was"
        " observed the maps have no estimate.",
        *maps.charts(at=at),
        network_table(maps, at),
        *(part for layer in maps.layers for part in lowest_parts(known.bins, layer)),
    ]


def lowest_parts(bins: pd.DataFrame, layer: str) -> list[Part]:
    """The places with the least adhesion to count on, and how many are not listed."""
    table = new_table(
        f"Lowest adhesion to count on, condition of the rail: {layer}", Column("edge", of="line"),
        Column("chainage on the edge", POSITION, "position",
               of=lambda row: 0.5 * (row["start_m"] + row["end_m"])),
        with_ends("expected", "expected"), Column("onsets", NUMBER, of="events"),
        name=f"lowest_{layer}",
    )  # fmt: skip
    rows = lowest_bins(bins[bins["layer"] == layer], len(bins))
    table.add_rows(rows.head(MOST_PLACES).to_dict("records"))
    more = len(rows) - MOST_PLACES
    words = f"{counted(more, 'more place')} apart from these: no lower than these."
    return [table, *[words] * (more > 0)]


# -------------------------------------------------------------------------- trains, and drift


def resistance_parts(found: FleetTrains) -> list[Part]:
    """Running resistance of each train against its kind."""
    pictures = [Still(resistance_charts(kind, found)) for kind in found.resistance]
    # Findings and limits have a section of their own.
    return [*_few(found), *pictures, found.trains_table()]


def unlike_parts(found: FleetTrains) -> list[Part]:
    """Trains that are not like the others, with the rate of false alarms and what is not seen."""
    unlike = found.unlike
    parts: list[Part] = [*_few(found)]
    if not unlike.findings:
        parts.append(
            f"No finding in {unlike.train_months:.1f} months of trains; what would not be seen is"
            f" below. A healthy train raises an alarm in at most {100.0 * unlike.rate:g} % of"
            " months."
        )
    else:
        parts.append(found.findings_table())
        parts.append(Still(findings_charts(found)))
    return [*parts, found.limits_table()]


def _few(found: FleetTrains) -> list[Part]:
    return [Warned(found.too_few)] if found.too_few else []


def drift_parts(found: FleetTrains) -> list[Part]:
    """What changes over months."""
    pictures: list[Part] = [
        Still(drift_charts(kind.kind, found))
        for kind in found.resistance
        if channels_over_time(kind.kind, found)
    ]
    drifting = [str(each) for each in found.drift if each.drifts]
    if not drifting:
        words = "No channel of a train or kind has a trend whose 95 % band leaves out zero."
        return [*pictures, words]
    of: Columns[str] = {
        "train or kind": lambda words: words.partition(": ")[0],
        "channel and trend": lambda words: words.partition(": ")[2],
    }
    return [
        *pictures,
        word_table("Channels that drift", drifting, of, name="drift", most=MOST_ROWS),
    ]


PAGE, TABLES = "diff.html", ("moved", "means", "estimates", "verdicts", "places", "words")
"""What `write_diff` writes into a folder: the page, and these tables as CSV."""

SECTIONS = {
    "verdicts": "Given by one side alone",
    "places": "Track-condition map",
    "moved": "Single trips",
    "estimates": "Every estimate",
    "words": "Texts",
}
"""Of the page, by the table that each shows."""

MOST_DRAWN = 24
"""Means of one picture."""


def write_diff(found: FleetDiff, folder: str | Path) -> list[Path]:
    """Write the report and all tables of a difference into a folder; the files.

    Raises
    ------
    InputError
        If the folder cannot be written.
    """
    target = made_folder(Path(folder))
    written = []
    for name in TABLES:
        path = target / f"{name}.csv"
        write_bytes(path, csv_bytes(getattr(found, name)))
        written.append(path)
    diff_page(found).write(target / PAGE)
    return [target / PAGE, *written]


def diff_page(found: FleetDiff) -> Page:
    """The page of a difference."""
    said = f"Of {found.second} against {found.first}: {found.sentence}"
    tables = {each.name: each for each in found.tables(100, changed=False)}
    first: list[Part] = [Warned(said) if found.beyond else said, tables["analyses"]]
    sections = [Section("What changed", first)]
    if len(found.systematic):
        sections.append(Section("Means over trips", [_shifts(found), tables["means"]]))
    for name, title in SECTIONS.items():
        if tables[name].rows or name == "estimates":
            sections.append(Section(title, [tables[name]]))
    sections.append(Section("How differences are judged", list(_JUDGED)))
    return Page(f"Fleet: {found.second} against {found.first}", "", sections)


_JUDGED = (
    "Both sides saw the same trips with the same noise: where nothing changed an estimate is the"
    " same to the bit. A difference is within rounding up to a millionth of the value or a"
    " thousandth of its standard deviation; beyond the band where it exceeds 1.96 of the smaller of"
    " the two standard deviations.",
    JUDGED,
    "Means are weighted by the precision of each trip. The shift has the standard error that its"
    " own scatter over the trips gives, in which the noise that both sides share is not contained;"
    " it is systematic at a false discovery rate of 5 per cent among all means (Benjamini and"
    " Hochberg, 1995), and beyond the band where it exceeds that of the first side's mean.",
)


def _shifts(found: FleetDiff) -> Chart:
    """Shifts of means in units of their bands."""
    rows = found.systematic[np.isfinite(found.systematic["bands"])].head(MOST_DRAWN)
    names = [
        f"{row.estimate}, {'all trips' if row.of == 'all trips' else row.name}"
        for row in rows.itertuples(index=False)
    ]
    value = np.sign(rows["shift"].to_numpy(np.float64)) * rows["bands"].to_numpy(np.float64)
    reach = rows["shift_std"].to_numpy(np.float64) / rows["value_std"].to_numpy(np.float64)
    points, at = list[Curve](), np.arange(len(rows))
    for beyond, colour, words in ((True, RED, "beyond"), (False, BLUE, "within")):
        chosen = rows["beyond"].to_numpy(bool) == beyond
        if chosen.any():
            points.append(
                Curve(f"systematic, {words}", value[chosen], at[chosen], colour, "points",
                      (value - reach)[chosen], (value + reach)[chosen],
                      {"": [names[row] for row in at[chosen]]}, 2.0, across=True)
            )  # fmt: skip
    largest = 1.1 * float(np.max(np.abs(value) + reach, initial=1.0))
    panel = Panel(
        "", points, 0.3 + 0.1 * len(rows), rows=names, rules=[Rule(0.0, upright=True)],
        spans=[Span(-1.0, 1.0, GREY, "within the band", 0.18)],
    )  # fmt: skip
    return Chart(
        "shift over the half width of the band",
        [panel],
        caption="Bars: 95 % band of the shift on the same trips.",
        span=(-largest, largest),
    )
