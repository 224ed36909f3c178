"""What a track-condition map says of a time: lasting beside expected, spots, changes, the model."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Group, RenderableType

from analysis.adhesion.condition_map import SPOT_SEPARATION, map_words, summary
from analysis.adhesion.condition_table import (
    MAY_BE_CHANGE,
    bins_table,
    changes_table,
    check_course,
    chosen_layers,
    day_name,
    last_evidence,
    met_words,
    plain_rows,
    probability_words,
    spots_table,
)
from trainlog.condition import day_of_trip, known_before, left_out
from trainlog.display import counted
from trainlog.errors import TrainlogError
from trainlog.formats.attached import line_of
from trainlog.formats.line import read_line
from trainlog.formats.mapfile import MapFile
from trainlog.formats.samples import names, sample
from trainlog.mcap import read_log
from trainlog.presentation import as_page, new_table
from trainlog.railway.condition import ConditionLayer, ModelParameter, TrackConditionMap
from trainlog.railway.line import Line

LOGARITHMS = {
    "mean": "median of normal rail",
    "slippery_mean": "median of slippery places",
    "spot_mean": "median of passing spots",
}
"""Parameters of the model that are means of logarithms of adhesion; a table has the medians."""

SPREADS = ("std", "slippery_std", "trip_std", "spot_std")
"""Parameters that are standard deviations of logarithms of adhesion."""

LISTED = 12
"""Spots, and changes, of a layer that a table lists; the likeliest first."""


@dataclass(frozen=True, eq=False, repr=False)
class MapState:
    """What a track-condition map says of a time.

    Attributes
    ----------
    track : TrackConditionMap
    line : Line or None
    at : Timestamp or None
        Of the expected condition, UTC; None of a map without evidence.
    last_evidence : Timestamp or None
        End of the last day with evidence, UTC.
    layers : DataFrame
        A row a layer: trips, onsets, observed length, last day with evidence.
    lowest : DataFrame
        The lowest places, least lasting or expected adhesion first; a row as of
        `analysis.bins_table`, with the nearest station.
    model : DataFrame
        A row a layer and parameter of the model: value, standard deviation, of a mean of logarithms
        its ``median`` as an adhesion, too, and its ``source``:
        "estimated" from the evidence, "mostly assumed" where the evidence weighs less than what
        was assumed beforehand, "assumed" where it has no part.
    spots, changes : DataFrame
        A row a passing spot, with the probability that it lies there then; a row a lasting change.
    trips : DataFrame
        A row a trip that counts: ``layer``, ``trip`` (its name), ``day`` of its middle, UTC.
    notes : tuple of str
        What holds where nothing was observed, what the recorders lacked, in which layers no lasting
        change was found, and which later evidence is left out, in sentences.
    """

    track: TrackConditionMap
    line: Line | None
    at: pd.Timestamp | None
    last_evidence: pd.Timestamp | None
    layers: pd.DataFrame
    lowest: pd.DataFrame
    model: pd.DataFrame
    spots: pd.DataFrame
    changes: pd.DataFrame
    trips: pd.DataFrame
    notes: tuple[str, ...] = ()

    def __repr__(self) -> str:
        when = "no evidence" if self.at is None else f"expected at {self.at:%Y-%m-%d %H:%M} UTC"
        return f"{self.track!r}\n  {when}"

    def _repr_html_(self) -> str:
        return as_page(state_table(self))

    def as_json(self) -> dict[str, Any]:
        """The same in JSON's own types; null where nothing is known."""
        times = {
            "expected_at": None if self.at is None else self.at.isoformat(),
            "last_evidence": None if self.last_evidence is None else _last_day(self.last_evidence),
            "evidence_ends": None if self.last_evidence is None else self.last_evidence.isoformat(),
        }
        tables = ("layers", "lowest", "model", "spots", "changes", "trips")
        return {
            "line": self.track.line,
            "length_m": self.track.length,
            **times,
            **{name: plain_rows(getattr(self, name)) for name in tables},
            "notes": list(self.notes),
        }


def map_state(
    track: TrackConditionMap,
    at: pd.Timestamp | None = None,
    *,
    line: Line | None = None,
    layers: Sequence[str] | None = None,
    places: int = 5,
) -> MapState:
    """What a map says of a time: the lowest places, the model, spots and changes.

    Parameters
    ----------
    track : TrackConditionMap
    at : Timestamp, optional
        Without a zone it is UTC. Only evidence of the days before its day counts, which is stated
        in the notes (`trainlog.condition.known_before`). Default: right after the last evidence,
        with all of it.
    line : Line, optional
        Gives the stations and the operator's kilometres.
    layers : sequence of str, optional
        Default: all.
    places : int
        How many of the lowest places of each layer are listed.

    Raises
    ------
    InputError
        If the map has no such layer, no evidence is of a day before, or the line is another.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> state = map_state(track, line=trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json"))
    >>> state.lowest.query("layer == 'wet'")["near"].tolist()[:2]
    ['at Flawil', '0.9 km after Uzwil']
    """
    if line is not None:
        check_course(track, line)
    if at is not None and at.tzinfo is None:
        at = at.tz_localize("UTC")
    track = replace(track, layers=chosen_layers(track, layers))
    without = left_out(track, at)
    if at is not None:
        track = known_before(track, at)
    chosen, last = track.layers, last_evidence(track)
    return MapState(
        track=track,
        line=line,
        at=at or last,
        last_evidence=last,
        layers=_layers(track, list(chosen)),
        lowest=_lowest(track, line, at, list(chosen), places),
        model=_model(chosen),
        spots=spots_table(track, line, at, list(chosen)),
        changes=changes_table(track, line, list(chosen)),
        trips=_trips(track),
        notes=(
            *map_words(track),
            *_without_changes(chosen),
            *filter(None, [without]),
        ),
    )


def _without_changes(layers: Mapping[str, ConditionLayer]) -> Iterator[str]:
    """In which layers no lasting change was found, and how many bins could have shown it best."""
    for name, each in layers.items():
        if not each.changes:
            by_day = np.unique(np.stack((each.evidence.bin, each.evidence.day)), axis=1)[0]
            places = int(np.count_nonzero(np.bincount(by_day, minlength=1) > 1))
            where = counted(places, "bin") if places else "no bin"
            have = "has" if places <= 1 else "have"
            yield f"{name}: no lasting change found; {where} {have} onsets of two days or more."


def _layers(track: TrackConditionMap, names: list[str]) -> pd.DataFrame:
    every = [each for each in summary(track, 0) if each.layer in names]
    return pd.DataFrame(
        {
            "layer": [each.layer for each in every],
            "trips": [each.trips for each in every],
            "onsets": [each.events for each in every],
            "observed_m": [round(each.observed_length, 3) for each in every],
            "observed_bins": [each.observed_bins for each in every],
            "bins": [each.bins for each in every],
            "last_day": [_last_day_of(track.layer(each.layer)) for each in every],
        }
    )


def _trips(track: TrackConditionMap) -> pd.DataFrame:
    every = [each for each in track.trips if each["layer"] in track.layers]
    days = [day_of_trip(each) for each in every]
    return pd.DataFrame(
        {
            "layer": [str(each["layer"]) for each in every],
            "trip": [str(each["trip"]) for each in every],
            "day": [None if day is None else day_name(day) for day in days],
        },
        dtype=object,
    )


def _last_day_of(layer: ConditionLayer) -> str | None:
    """The last day with evidence; None if there is none."""
    days = layer.evidence.days
    return day_name(int(days[-1])) if days.size else None


def _lowest(
    track: TrackConditionMap,
    line: Line | None,
    at: pd.Timestamp | None,
    names: list[str],
    places: int,
) -> pd.DataFrame:
    """The lowest bins of each layer, lasting or expected, apart from each other."""
    rows = bins_table(track, line, at, names)
    chosen: list[int] = []
    for _, layer in rows[rows["observed"]].groupby("layer", sort=False):
        least = layer[["adhesion", "expected"]].min(axis=1).sort_values(kind="stable")
        taken: list[float] = []
        for number in least.index:
            place = float(rows["start_m"][number])
            if len(taken) < places and all(abs(place - one) >= SPOT_SEPARATION for one in taken):
                taken.append(place)
                chosen.append(int(number))
    return rows.loc[chosen].reset_index(drop=True)


def _model(layers: dict[str, ConditionLayer]) -> pd.DataFrame:
    every = [(name, each) for name, layer in layers.items() for each in layer.model.parameters]
    return pd.DataFrame(
        {
            "layer": [name for name, _ in every],
            "parameter": [each.name for _, each in every],
            "value": np.array([each.value for _, each in every], dtype=np.float64),
            "std": np.array([each.std for _, each in every], dtype=np.float64),
            "unit": [_unit(each) for _, each in every],
            "median": np.array(
                [np.exp(each.value) if each.name in LOGARITHMS else np.nan for _, each in every],
                dtype=np.float64,
            ),
            "source": [_source(each) for _, each in every],
        }
    )


def _unit(parameter: ModelParameter) -> str:
    logarithm = parameter.name in LOGARITHMS or parameter.name in SPREADS
    return "ln(adhesion)" if logarithm else parameter.unit


def _source(parameter: ModelParameter) -> str:
    """Where a parameter is from; one that is assumed has nothing that the evidence moved."""
    moved = np.isfinite(parameter.std) and parameter.std > 0.0
    return "mostly assumed" if parameter.source == "assumed" and moved else parameter.source


def state_table(state: MapState, *, model: bool = False) -> Group:
    """The tables of a map's state; those of its model on request."""
    parts: list[RenderableType] = [_layers_table(state)]
    if not state.lowest.empty:
        parts.append(_places_table(state))
    if not state.spots.empty:
        parts.append(_spots_table(state))
    if not state.changes.empty:
        parts.append(_changes_table(state))
    if model and not state.model.empty:
        parts.append(_model_table(state))
    return Group(*parts, *state.notes)


def _layers_table(state: MapState) -> RenderableType:
    title = f"Track condition of {state.track.line}, {state.track.bin_length:.0f} m bins"
    table = new_table(
        title, "rail\ncondition", "trips", "onsets measured", "observed", "last evidence"
    )
    for each in state.layers.to_dict("records"):
        table.add_row(
            str(each["layer"]),
            str(each["trips"]),
            str(each["onsets"]),
            f"{each['observed_m'] / 1e3:.1f} km, {each['observed_bins'] / each['bins']:.0%}",
            each["last_day"] if isinstance(each["last_day"], str) else "none",
        )
    return table


def _places_table(state: MapState) -> RenderableType:
    at = "" if state.at is None else f", expected at {state.at:%Y-%m-%d %H:%M} UTC"
    heads = ("km", "near", "lasting (95 % band)", "expected (95 % band)", "spot")
    table = new_table(f"Lowest maximum adhesion{at}", "rail\ncondition", *heads)
    lasting = _bands(state.lowest, "adhesion", "low", "high")
    expected = _bands(state.lowest, "expected", "expected_low", "expected_high")
    rows = state.lowest.to_dict("records")
    for each, now, then in zip(rows, lasting, expected, strict=True):
        share = f"{each['spot_probability']:.0%}" if each["spot_probability"] > 0.0 else ""
        words = (f"{each['start_km']:.3f}", str(each["near"]), now, then, share)
        table.add_row(str(each["layer"]), *words)
    return table


def _bands(rows: pd.DataFrame, value: str, low: str, high: str) -> list[str]:
    return [
        f"{middle:.3f} ({least:.3f} to {most:.3f})"
        for middle, least, most in zip(rows[value], rows[low], rows[high], strict=True)
    ]


def _spots_table(state: MapState) -> RenderableType:
    still = "still there" if state.at is None else f"there on {state.at:%Y-%m-%d %H:%M}"
    heads = ("km", "near", "adhesion (95 % band)", "met", "last evidence there", still)
    table = new_table("Passing spots, the likeliest first", "rail\ncondition", *heads)
    for name, listed, more in _listed(state.spots, "probability"):
        bands = _bands(listed, "adhesion", "low", "high")
        for each, band in zip(listed.to_dict("records"), bands, strict=True):
            met = met_words(each["first_day"], each["last_day"])
            words = (_ends(each), str(each["near"]), band, met, _day(each["checked_day"]))
            mark = " *" if each["may_be_change"] else ""
            table.add_row(name, *words, probability_words(each["probability"]) + mark)
        if more:
            table.add_row(name, f"and {more} more")
    return Group(table, f"* {MAY_BE_CHANGE}") if state.spots["may_be_change"].any() else table


def _changes_table(state: MapState) -> RenderableType:
    heads = ("km", "near", "on (95 %)", "before (95 % band)", "after (95 % band)")
    table = new_table("Changes of the lasting condition", "rail\ncondition", *heads)
    for name, listed, more in _listed(state.changes, "log_odds"):
        before, after = (
            _bands(listed, side, f"{side}_low", f"{side}_high") for side in ("before", "after")
        )
        for each, old, new in zip(listed.to_dict("records"), before, after, strict=True):
            days = f"{_day(each['day'])} ({_day(each['earliest'])} to {_day(each['latest'])})"
            table.add_row(name, _ends(each), str(each["near"]), days, old, new)
        if more:
            table.add_row(name, f"and {more} more")
    return table


def _listed(rows: pd.DataFrame, rank: str) -> Iterator[tuple[str, pd.DataFrame, int]]:
    """Name, first rows by rank, and number of the others, of each layer."""
    for name, every in rows.groupby("layer", sort=False):
        listed = every.sort_values(rank, ascending=False, kind="stable")[:LISTED]
        yield str(name), listed, len(every) - len(listed)


def _ends(row: Mapping[Hashable, Any]) -> str:
    return f"{row['start_km']:.3f} to {row['end_km']:.3f}"


def _model_table(state: MapState) -> RenderableType:
    heads = ("parameter", "value", "standard deviation", "unit", "from")
    table = new_table("Model", "rail\ncondition", *heads)
    for each in state.model.to_dict("records"):
        name, value, std = str(each["parameter"]), float(each["value"]), float(each["std"])
        unit = "" if each["unit"] == "1" else str(each["unit"])
        if name in LOGARITHMS:
            # Read as an adhesion: the logarithm's deviation is one in proportion.
            value, unit = float(np.exp(value)), "adhesion"
            std *= value
        words = LOGARITHMS.get(name, name.replace("_", " "))
        numbers = (_digits(value, 3), _digits(std, 2) if np.isfinite(std) and std > 0.0 else "")
        table.add_row(str(each["layer"]), words, *numbers, unit, str(each["source"]))
    return table


def _digits(value: float, digits: int) -> str:
    """A number to so many digits, without an exponent."""
    return np.format_float_positional(
        float(f"{value:.{digits}g}"), fractional=False, trim="-", precision=digits
    )


def _last_day(end: pd.Timestamp) -> str:
    """The day that ends then."""
    return _day(end - pd.Timedelta(days=1))


def _day(time: Any) -> str:
    return f"{time:%Y-%m-%d}"


def line_of_map(track: TrackConditionMap, given: Path | None, condition: Path) -> Line | None:
    """The line of a map: the one given, a sample, or that of a log the map was made from.

    Parameters
    ----------
    track : TrackConditionMap
    given : path, optional
        A line file, or a log that carries its line.
    condition : path
        The file of the map.

    Returns
    -------
    Line or None
        None if there is none of these, or no such log is where it was.

    Raises
    ------
    InputError
        If what is given is no line, or another than the map's.
    """
    if given is not None:
        line = _line_of_log(given) if given.suffix == ".mcap" else read_line(given)
        check_course(track, line)
        return line
    for name in names():
        if name.endswith(".line.json"):
            line = read_line(sample(name))
            if (line.name, line.length) == (track.line, track.length):
                return line
    with MapFile(condition) as opened:
        for log in opened.unchanged_logs():
            with suppress(TrainlogError):
                line = _line_of_log(log)
                check_course(track, line)
                return line
    return None


def _line_of_log(log: Path) -> Line:
    """The line that a log carries, in its own direction."""
    trip = read_log(log, topics=[])
    line = line_of(trip)
    return line.reversed() if trip.metadata.get("direction") == "reverse" else line
