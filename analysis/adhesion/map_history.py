"""What a track-condition map knows of one place over time: its evidence and its estimates."""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import (
    ADHESIONS,
    MAY_BE_CHANGE,
    changes_table,
    dates,
    kilometres,
    met_words,
    probability_words,
    shown,
    spots_table,
)
from trainlog.arrays import IntArray
from trainlog.condition import layer_before
from trainlog.errors import InputError
from trainlog.presentation import (
    ADHESION,
    NUMBER,
    Cell,
    Column,
    Ends,
    Presented,
    Said,
    WordTable,
    frame_table,
    new_table,
)
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.line import Line

MOST_DAYS = 12
"""Days that get the estimate of then, unless more are asked for."""

REACH = 500.0
"""A day counts for a place if it has evidence no further from it than this [m]."""

SPOT = [
    *("first_day", "last_day", "checked_day"),
    *("adhesion", "low", "high", "present", "life", "may_be_change"),
]
CHANGE = ["day", "earliest", "latest", "before", "after"]
"""Of passing spots and lasting changes, what a history has."""

LISTED = 15
"""Days that a table lists: the last."""


@dataclass(frozen=True, eq=False, repr=False)
class PlaceHistory(Presented):
    """The history of one bin in one layer.

    Attributes
    ----------
    line, layer : str
    start, end : float [m]
        Of the bin.
    start_km, end_km : float
        The operator's kilometres of its ends.
    near : str
        Its place by the nearest station; empty without a line.
    onsets : DataFrame
        A row a day on which a slip measured the maximum there: ``day``, ``trips``, ``events``,
        ``adhesion`` and its 95 % band from the measurement alone.
    used : DataFrame
        A row a day: the highest ``level`` that was used without slip, and by how many ``trips``.
    known : DataFrame
        The estimate as it was known at the end of ``day``, made of the evidence up to then:
        whether the bin was ``observed``, the lasting ``adhesion``, ``low``, ``high``, and what was
        ``expected`` right after, with its band; NaN where it was not observed. Empty where no
        slip was measured there up to now.
    spots, changes : DataFrame
        Passing spots and lasting changes there, as known now, with their dates.
    days : int
        Days with evidence there or nearby, of which `known` has all or some.
    """

    charts_by: ClassVar[str] = "analysis.adhesion.map_plot:history_charts"

    line: str
    layer: str
    start: float
    end: float
    start_km: float
    end_km: float
    near: str
    onsets: pd.DataFrame
    used: pd.DataFrame
    known: pd.DataFrame
    spots: pd.DataFrame
    changes: pd.DataFrame
    days: int = 0

    def summary(self) -> dict[str, str]:
        """How often slip began there, and how often it did not."""
        return {
            "onsets": f"{int(self.onsets['events'].sum())} of slip on {len(self.onsets)} days",
            "used": f"without slip on {len(self.used)} days",
        }

    @property
    def unmeasured(self) -> str:
        """What is known where no slip was measured, in a sentence; else empty."""
        if not self.onsets.empty or self.known["observed"].any():
            return ""
        words = "No slip was measured here: the maximum is not known"
        if not self.used.empty:
            words += f" (used without slip up to {self.used['level'].max():.2f})"
        return f"{words}."

    @property
    def notes(self) -> tuple[str, ...]:
        """What is not shown or not known, in sentences."""
        thinned = (
            f"The estimate as known then was made for {len(self.known)} of"
            f" {self.days} days with evidence nearby, chosen evenly (--days sets how many)."
        )
        said = (thinned if self.thinned else "", self.unmeasured)
        spots = (_spot_in_words(each) for each in self.spots.to_dict("records"))
        changes = (
            f"Lasting change on {each.day:%Y-%m-%d} ({each.earliest:%Y-%m-%d} to"
            f" {each.latest:%Y-%m-%d}): {each.before:.3f} to {each.after:.3f}."
            for each in self.changes.itertuples()
        )
        return tuple(filter(None, (*said, *spots, *changes)))

    @property
    def thinned(self) -> bool:
        """Whether `known` leaves days out."""
        return 0 < len(self.known) < self.days

    @property
    def title(self) -> str:
        """Line, place and layer in words."""
        place = f"km {self.start_km:.3f} to {self.end_km:.3f}" + f", {self.near}" * bool(self.near)
        return f"{self.line}, {place}, {self.layer}"

    def facts(self) -> dict[str, Any]:
        """The place."""
        return {
            "line": self.line,
            "layer": self.layer,
            "start_m": self.start,
            "end_m": self.end,
            "start_km": self.start_km,
            "end_km": self.end_km,
            "near": self.near,
            "thinned": self.thinned,
        }

    def tables(self) -> list[WordTable]:
        """What is known by day, the last days of it; and what it is made of as data."""
        earlier = len(self._days) - LISTED
        hidden = f"{earlier} earlier days are not listed." if earlier > 0 else None
        table = new_table(self.title, *DAY_COLUMNS, name="days", caption=hidden)
        names = ("onsets", "used", "known", "spots", "changes")
        parts = [frame_table(name, getattr(self, name)) for name in names]
        return [table.add_rows(self._days[-LISTED:]), *parts]

    @property
    def _days(self) -> list[dict[str, Any]]:
        """What is known of each day."""
        of = {
            name: {row["day"]: row for row in getattr(self, name).to_dict("records")}
            for name in ("onsets", "used", "known")
        }
        days = sorted({day for rows in of.values() for day in rows})
        return [{"day": day} | {name: rows.get(day) for name, rows in of.items()} for day in days]


def map_history(
    track: TrackConditionMap,
    position: float,
    layer: str,
    *,
    line: Line | None = None,
    days: int = MOST_DAYS,
) -> PlaceHistory:
    """The history of the bin at a position: its evidence, and the estimate as it was known by day.

    Parameters
    ----------
    track : TrackConditionMap
    position : float [m]
        Chainage.
    layer : str
    line : Line, optional
        Gives the operator's kilometres and the stations.
    days : int
        At most so many days get the estimate of then, which each takes as long as an update of the
        layer; of more they are chosen evenly, the last among them.

    Raises
    ------
    InputError
        If the position is not on the line, the map lacks the layer, the line is another, or there
        are to be no days.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> found = map_history(track, 9_680.0, "wet")
    >>> [str(day.date()) for day in found.onsets["day"]], found.onsets["adhesion"].round(2).tolist()
    (['2024-10-07'], [0.07])
    """
    if not 0.0 <= position <= track.length:
        raise InputError(
            f"km {position / 1e3:g} is not on line '{track.line}'",
            remedy=f"it reaches from km 0 to {track.length / 1e3:.3f}",
        )
    if line is not None:
        track.check_line(line.name, line.length)
    if days < 1:
        raise InputError(
            f"map history: days must be 1 or more, got {days}", remedy="give 1 or more days"
        )
    chosen = track.layer(layer)
    row = int(track.bin_of(position))
    start = row * track.bin_length
    end = min(start + track.bin_length, track.length)
    where = pd.DataFrame(kilometres(line, np.array([start]), np.array([end]))).iloc[0]
    when = _days_near(track, chosen, row)
    onsets = _onsets(chosen, row)
    if onsets.empty and np.isfinite(chosen.log_mean[row]) and not chosen.observed[row]:
        # Less evidence did not show it either.
        when = when[:0]
    evenly = np.linspace(when.size - 1, 0, min(days, when.size)).astype(int)
    shown = when[evenly[::-1]]
    spots = spots_table(track, layers=[layer]).sort_values("first_day", kind="stable")
    spots = spots.rename(columns={"present_when_checked": "present", "life_days": "life"})
    return PlaceHistory(
        line=track.line,
        layer=layer,
        start=start,
        end=end,
        start_km=float(where["start_km"]),
        end_km=float(where["end_km"]),
        near=str(where["near"]),
        onsets=onsets,
        used=_used(track, chosen, row),
        known=_known(track, layer, row, shown),
        spots=_there(spots, start, end, SPOT),
        changes=_there(changes_table(track, layers=[layer]), start, end, CHANGE),
        days=int(when.size),
    )


def _onsets(layer: ConditionLayer, row: int) -> pd.DataFrame:
    known = layer.evidence
    there = (known.bin == row) & (known.weight > 0.0)
    weight = known.weight[there]
    mean = known.weighted_log[there] / weight
    # What all onsets of a trip share does not average out within the trip.
    std = np.sqrt(1.0 / weight + known.common[there] / weight**2)
    return pd.DataFrame(
        {
            "day": dates(known.day[there]),
            "trips": known.trips[there].astype(np.int64),
            "events": known.events[there].astype(np.int64),
            "adhesion": np.exp(mean),
            "low": np.exp(mean - 1.96 * std),
            "high": np.exp(mean + 1.96 * std),
        }
    )


def _used(track: TrackConditionMap, layer: ConditionLayer, row: int) -> pd.DataFrame:
    known = layer.evidence
    there = known.used_bin == row
    rows = pd.DataFrame(
        {
            "day": dates(known.used_day[there]),
            "level": track.levels[known.used_level[there]],
            "trips": known.used_trips[there].astype(np.int64),
        }
    )
    # The rows of a day are in the order of the levels.
    return rows.groupby("day", as_index=False).last()


def _days_near(track: TrackConditionMap, layer: ConditionLayer, row: int) -> IntArray:
    """Days with evidence in or near a bin."""
    reach = int(np.ceil(REACH / track.bin_length))
    known = layer.evidence
    near = np.abs(known.bin - row) <= reach
    used = np.abs(known.used_bin - row) <= reach
    return np.union1d(known.day[near], known.used_day[used]).astype(np.int64)


def _known(track: TrackConditionMap, name: str, row: int, days: IntArray) -> pd.DataFrame:
    """The estimate in a bin as it was known at the end of each day."""
    rows = []
    for day in days.tolist():
        layer = layer_before(track, day + 1, name)
        assert layer is not None
        known = (each[row] for one in (layer, layer.expected()) for each in shown(one))
        rows.append((day, layer.observed[row], *known))
    table = pd.DataFrame(rows, columns=["day", "observed", *ADHESIONS])
    table["day"] = dates(days)
    return table


def _there(rows: pd.DataFrame, start: float, end: float, columns: Sequence[str]) -> pd.DataFrame:
    """Columns of the rows of a table that lie on a part of the line, from its beginning on."""
    there = rows[(rows["start_m"] < end) & (rows["end_m"] > start)]
    return there.sort_values("start_m", kind="stable")[columns].reset_index(drop=True)


def _spot_in_words(spot: Mapping[Hashable, Any]) -> str:
    share = probability_words(spot["present"])
    still = share if share.startswith("gone") else f"still there with {share}"
    met = met_words(spot["first_day"], spot["last_day"])
    end = f"; {MAY_BE_CHANGE}" if spot["may_be_change"] else "."
    on = f"{spot['checked_day']:%Y-%m-%d}"
    return f"Passing spot: {spot['adhesion']:.3f}, met {met}; on {on} {still}{end}"


def _of(name: str, value: str, ends: tuple[str, str]) -> Callable[[Mapping[str, Any]], Cell]:
    """An adhesion with its band as it was known on a day; empty where it was not."""

    def cell(day: Mapping[str, Any]) -> Cell:
        row = day[name]
        if row is None or not np.isfinite(row[value]):
            return Said(None, "")
        return Ends(row[value], *(row[each] for each in ends))

    return cell


DAY_COLUMNS = (
    Column("day", of=lambda day: f"{day['day']:%Y-%m-%d}"),
    Column("onsets", NUMBER, of=lambda day: (day["onsets"] or {}).get("events", "")),
    Column("measured (95 % band)", ADHESION, key="measured", rank=1,
           of=_of("onsets", "adhesion", ("low", "high"))),
    Column("used without slip", replace(ADHESION, digits=2), rank=1,
           of=lambda day: (day["used"] or {}).get("level", "")),
    Column("lasting (95 % band)", ADHESION, key="lasting",
           of=_of("known", "adhesion", ("low", "high"))),
    Column("expected (95 % band)", ADHESION, key="expected",
           of=_of("known", "expected", ("expected_low", "expected_high"))),
)  # fmt: skip
"""Of what is known of a place on a day."""
