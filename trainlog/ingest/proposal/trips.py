"""Which columns of an unknown table state facts of a trip: its number, load and weather."""

from __future__ import annotations

import re

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from trainlog.arrays import IntArray
from trainlog.formats.declared import toml_value
from trainlog.ingest.parts import CONSTANT, LEAST_GROUP
from trainlog.ingest.profile import LoadColumn, TripColumns, WeatherColumn
from trainlog.ingest.proposal.layout import Reading
from trainlog.ingest.proposal.vocabulary import plain, split_unit, words_of
from trainlog.ingest.proposal.work import TripFacts, Work
from trainlog.units import NANOSECONDS

_TRIP = "fahrten|fahrt|zugfahrt|zuglauf|lauf|trip|run|ride|journey|trajet|course|mission|marche"
_TRAIN = "zug|train|service|umlauf"
_NUMBER = "nr|no|n|num|nummer|number|numero|id|kennung|code"
_NUMBERED = tuple(
    re.compile(rf"(({noun})s?({_NUMBER})?|({_NUMBER})(de|du|of|der)?({noun})s?)")
    for noun in (_TRIP, _TRAIN)
)
"""Names of columns that number trips, the surer first; without blanks and signs."""

_LOAD = ("zuladung", "beladung", "nutzlast", "payload", "load", "ladung", "charge", "chargement")

_WEATHER = ("weather", "wetter", "witterung", "meteo", "schienenzustand", "railcondition")

_CONDITIONS = {
    "dry": "dry trocken sec seche sonnig sonne sunny clear klar heiter",
    "wet": "wet nass nas mouille pluie regen rain rainy regnerisch humide",
    "damp": "damp feucht",
    "leaves": "leaves laub feuilles",
    "frost": "frost reif raureif gel",
    "ice": "ice eis glace vereist",
    "snow": "snow schnee neige",
}
"""What recorders call the conditions of the rail, in `plain` spelling."""

PAUSE = 900.0
"""Time [s] without rows, or at standstill, from which on two trips are proposed."""


def facts_of(work: Work) -> TripFacts:
    """Find the columns among those that became no field; they are taken from `work.left`."""
    number, readings = _number(work)
    parted = np.diff(work.clock.time) > PAUSE * NANOSECONDS
    if number is not None:
        parted = parted | (_changes(_cells(work, number)) > 0)
    labels = np.cumsum(np.concatenate(([0], parted)))
    load, about = _load(work, labels)
    weather, words = _weather(work, labels)
    return TripFacts(
        TripColumns(number=number, load=load, weather=weather), (*readings, *about, *words)
    )


def _cells(work: Work, name: str) -> NDArray[np.object_]:
    """The text of a column; an empty cell has that of the row before."""
    text = pc.utf8_trim_whitespace(pc.fill_null(pc.cast(work.layout.table[name], pa.string()), ""))
    cells = np.asarray(text.to_pylist(), dtype=np.object_)
    filled = cells != ""
    last = np.maximum.accumulate(np.where(filled, np.arange(cells.size), 0))
    return np.asarray(cells[last])


def _changes(cells: NDArray[np.object_]) -> IntArray:
    return np.asarray(cells[1:] != cells[:-1]).astype(np.int64)


def _number(work: Work) -> tuple[str | None, list[Reading]]:
    """The column that numbers the trips."""
    for pattern in _NUMBERED:
        for name in list(work.left):
            bare = re.sub(r"[^a-z]", "", plain(name))
            if work.meanings[name].unit is not None or not pattern.fullmatch(bare):
                continue
            cells = _cells(work, name)
            edges = np.flatnonzero(np.concatenate(([1], _changes(cells), [1])))
            if np.diff(edges).min() < LEAST_GROUP or not cells[0]:
                work.left[name] = "may number trips, but it is not constant over blocks of rows"
                continue
            del work.left[name]
            labels = [str(cells[first]) for first in edges[:-1]]
            shown = ", ".join(labels[:6]) + (", ..." if len(labels) > 6 else "")
            what = f"{len(labels)}: {shown}" if len(labels) > 1 else f"1: {shown}"
            why = f"column '{name}' numbers them: it is constant over blocks of rows"
            return name, [Reading("trips", what, why)]
    return None, []


def _load(work: Work, labels: IntArray) -> tuple[LoadColumn | None, list[Reading]]:
    """The column of the load, where it is constant over each trip."""
    for name in list(work.left):
        bare = "".join(word for word in words_of(split_unit(name)[0]) if word.isalpha())
        if not any(stem in bare for stem in map(plain, _LOAD)) or name not in work.numbers:
            continue
        stated = work.meanings[name].unit or ""
        if stated not in ("t", "kg", ""):
            continue
        values = work.layout.number(name)
        known = np.isfinite(values)
        if not known.any() or float(np.nanmin(values)) < 0.0:
            continue
        loads = [values[known & (labels == each)] for each in range(int(labels.max()) + 1)]
        top = float(np.nanmax(values))
        if any(each.size and float(np.ptp(each)) > CONSTANT * top for each in loads):
            continue
        unit = stated or ("t" if top < 500.0 else "kg")
        del work.left[name]
        shown = ", ".join(f"{float(np.median(each)):g}" for each in loads[:6] if each.size)
        why = f"the file states {unit}" if stated else f"no unit is stated; {top:g} of them"
        other = "" if stated else ("kg" if unit == "t" else "t")
        what = f"column '{name}' [{unit}]"
        reading = Reading("load", what, f"{why}; constant over each trip: {shown}", other)
        return LoadColumn(column=name, unit=unit), [reading]
    return None, []


def _weather(work: Work, labels: IntArray) -> tuple[WeatherColumn | None, list[Reading]]:
    """The column of the rail's condition, where all its words are known."""
    for name in list(work.left):
        bare = re.sub(r"[^a-z]", "", plain(name))
        if name in work.numbers or not any(bare.startswith(stem) for stem in _WEATHER):
            continue
        cells = _cells(work, name)
        words = {str(word): _condition(str(word)) for word in dict.fromkeys(cells.tolist()) if word}
        if not words or not all(words.values()):
            unknown = ", ".join(f"'{word}'" for word, meant in words.items() if not meant)
            work.left[name] = f"a weather in words that are not known: {unknown or 'none'}"
            continue
        if any(np.unique(cells[labels == each].astype(str)).size > 1 for each in np.unique(labels)):
            work.left[name] = "a weather that changes within a trip"
            continue
        del work.left[name]
        shown = ", ".join(f"'{word}' is {meant}" for word, meant in words.items())
        reading = Reading("weather", f"column '{name}'", f"constant over each trip: {shown}")
        return WeatherColumn(column=name, words=words), [reading]
    return None, []


def _condition(word: str) -> str:
    """The rail's condition that a word means; empty if it is not known."""
    bare = re.sub(r"[^a-z]", "", plain(word))
    for condition, spellings in _CONDITIONS.items():
        if bare in {plain(spelling) for spelling in spellings.split()}:
            return condition
    return ""


def trip_lines(facts: TripFacts) -> list[str]:
    """The section ``[trip.columns]`` of a profile; empty if there is nothing to state."""
    columns = facts.columns
    found = {reading.what: reading for reading in facts.readings}
    lines: list[str] = []
    if columns.number is not None:
        lines += [f"# {found['trips'].why}", f"number = {toml_value(columns.number)}"]
    if columns.load is not None:
        lines.append(f"# {found['load'].why}")
        if found["load"].alternative:
            lines.append(f"# open: or {found['load'].alternative}")
        pair = {"column": columns.load.column, "unit": columns.load.unit}
        lines.append(f"load = {toml_value(pair)}")
    if columns.weather is not None:
        words = columns.weather.words.items()
        shown = ", ".join(f"{toml_value(word)} = {toml_value(meant)}" for word, meant in words)
        lines.append(f"# {found['weather'].why}")
        lines.append(
            f"weather = {{ column = {toml_value(columns.weather.column)}, words = {{ {shown} }} }}"
        )
    return ["", "[trip.columns]", *lines] if lines else []
