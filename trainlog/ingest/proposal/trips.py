"""Which columns of an unknown table state facts of a trip: its number, load and weather."""

from __future__ import annotations

import re

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from trainlog.arrays import IntArray
from trainlog.ingest.motion import ENOUGH
from trainlog.ingest.parts import CONSTANT
from trainlog.ingest.profile import LoadColumn, TripColumns, WeatherColumn
from trainlog.ingest.proposal.columns import Work
from trainlog.ingest.proposal.layout import Reading
from trainlog.ingest.proposal.vocabulary import plain, split_unit, vocabulary
from trainlog.units import NANOSECONDS

PAUSE = 900.0
"""Time [s] without rows, or at standstill, from which on two trips are proposed."""


def find_trips(work: Work) -> None:
    """Find the columns among those that became no field; they are taken from `work.left`."""
    number = _number(work)
    parted = np.diff(work.clock.time) > PAUSE * NANOSECONDS
    if number is not None:
        cells = _cells(work, number)
        parted = parted | (cells[1:] != cells[:-1])
    labels = np.cumsum(np.concatenate(([0], parted)))
    load = _load(work, labels)
    work.trips = TripColumns(number=number, load=load, weather=_weather(work, labels))


def _bare(text: str) -> str:
    """The letters of a text, in plain spelling."""
    return re.sub(r"[^a-z]", "", plain(text))


def _stems(key: str) -> list[str]:
    return [plain(stem) for stem in vocabulary()["trip"][key].split()]


def _cells(work: Work, name: str) -> NDArray[np.object_]:
    """The text of a column; an empty cell has that of the row before."""
    text = pc.utf8_trim_whitespace(pc.fill_null(pc.cast(work.layout.table[name], pa.string()), ""))
    cells = np.asarray(text.to_pylist(), dtype=np.object_)
    last = np.maximum.accumulate(np.where(cells != "", np.arange(cells.size), 0))
    return np.asarray(cells[last])


def _number(work: Work) -> str | None:
    """The column that numbers the trips."""
    number = "|".join(_stems("number"))
    for key in ("trip", "train"):
        noun = "|".join(_stems(key))
        pattern = re.compile(rf"({noun})s?({number})?|({number})(de|du|of|der)?({noun})s?")
        for name in list(work.left):
            if work.meanings[name].unit is not None or not pattern.fullmatch(_bare(name)):
                continue
            cells = _cells(work, name)
            edges = np.flatnonzero(np.concatenate(([True], cells[1:] != cells[:-1], [True])))
            if np.diff(edges).min() < ENOUGH or not cells[0]:
                why = "may number trips, but it is not constant over blocks of rows"
                work.left[name] = why
                continue
            labels = [str(cells[first]) for first in edges[:-1]]
            shown = f"{len(labels)}: {', '.join(labels[:6])}{', ...' if len(labels) > 6 else ''}"
            why = f"column '{name}' numbers them: it is constant over blocks of rows"
            work.readings.append(Reading("trips", shown, why))
            del work.left[name]
            return name
    return None


def _load(work: Work, labels: IntArray) -> LoadColumn | None:
    """The column of the load, where it is constant over each trip."""
    for name in [name for name in work.left if name in work.numbers]:
        bare, stated = _bare(split_unit(name)[0]), work.meanings[name].unit or ""
        values = work.layout.number(name)
        known = np.isfinite(values)
        named = any(stem in bare for stem in _stems("load")) and stated in ("t", "kg", "")
        if not named or not known.any() or float(np.nanmin(values)) < 0.0:
            continue
        loads = [values[known & (labels == each)] for each in np.unique(labels[known])]
        top = float(np.nanmax(values))
        if any(float(np.ptp(each)) > CONSTANT * top for each in loads):
            continue
        unit, other = ("t", "kg") if top < 500.0 else ("kg", "t")
        why = f"no unit is stated; {top:g} of them"
        if stated:
            unit, other, why = stated, "", f"the file states {stated}"
        shown = ", ".join(f"{float(np.median(each)):g}" for each in loads[:6])
        why += f"; constant over each trip: {shown}"
        work.readings.append(Reading("load", f"column '{name}' [{unit}]", why, other))
        del work.left[name]
        return LoadColumn(column=name, unit=unit)
    return None


def _weather(work: Work, labels: IntArray) -> WeatherColumn | None:
    """The column of the rail's condition, where all its words are known."""
    conditions = {
        plain(word): condition
        for condition, words in vocabulary()["weather"].items()
        for word in words.split()
    }
    for name in [name for name in work.left if name not in work.numbers]:
        if not _bare(name).startswith(tuple(_stems("weather"))):
            continue
        cells = _cells(work, name).astype(str)
        words = [str(word) for word in dict.fromkeys(cells.tolist()) if word]
        unknown = ", ".join(f"'{word}'" for word in words if _bare(word) not in conditions)
        if unknown or not words:
            work.left[name] = f"a weather in words that are not known: {unknown or 'none'}"
        elif any(np.unique(cells[labels == each]).size > 1 for each in np.unique(labels)):
            work.left[name] = "a weather that changes within a trip"
        else:
            meant = {word: conditions[_bare(word)] for word in words}
            shown = ", ".join(f"'{word}' is {condition}" for word, condition in meant.items())
            why = f"constant over each trip: {shown}"
            work.readings.append(Reading("weather", f"column '{name}'", why))
            del work.left[name]
            return WeatherColumn(column=name, words=meant)
    return None
