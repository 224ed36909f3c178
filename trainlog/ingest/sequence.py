"""Rows as they come: which of them follow in time, and what of their values can be.

A live recording keeps what comes. Order and limits are applied at once, as the rules of
`trainlog.ingest.rules` do; all other repair is left to ingesting what was recorded. A row whose
time does not follow those before waits until the rows behind it show whether it is late, wrong, or
the first after a gap.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray
from trainlog.ingest.clock import same_as_previous
from trainlog.ingest.profile_parts import Limits, Repair
from trainlog.ingest.recording import NO_TIME, Table, base_name
from trainlog.units import NANOSECONDS

CONFIRMING = 3
"""Rows that must follow each other before a time is believed that does not follow those before."""

STEPS = 100
"""Intervals between rows of which the usual one is the median."""

DOUBTED = 100
"""Values of a column from which on most of them being impossible is reported."""

RESTART = 1000
"""A number that falls by more than this is the first of a sender that was started again."""


@dataclass
class Numbering:
    """The numbers that a sender counts its lines with: what did not arrive.

    Attributes
    ----------
    lost : int
        Numbers that were passed over and have not come since.
    late, repeated : int
        Lines that came after one with a higher number, or twice.
    restarts : int
        How often the sender began to count anew.
    """

    lost: int = 0
    late: int = 0
    repeated: int = 0
    restarts: int = 0
    _highest: int | None = None
    _missing: set[int] = field(default_factory=set)

    def take(self, numbers: Iterable[int]) -> None:
        """Take the numbers in the order of arrival."""
        for number in numbers:
            if self._highest is None or number == self._highest + 1:
                self._highest = number
            elif number > self._highest:
                between = range(self._highest + 1, number)
                self.lost += len(between)
                self._missing.update(between[-RESTART:])
                self._highest = number
            elif number in self._missing:
                self._missing.discard(number)
                self.lost -= 1
                self.late += 1
            elif self._highest - number > RESTART or number <= 1:
                self.restarts += 1
                self._highest, self._missing = number, set()
            else:
                self.repeated += 1


class Sequence:
    """The rows of one kind of lines: which time follows the one before, and what each row holds.

    Parameters
    ----------
    limits : Limits
    repair : Repair
    """

    def __init__(self, limits: Limits, repair: Repair) -> None:
        self._limits, self._repair = limits, repair
        self._highest = NO_TIME
        self._shift = 0
        self._steps = np.zeros(0, dtype=np.int64)
        self._held: Table | None = None
        self._previous: Table | None = None
        self.met: Counter[tuple[str, str]] = Counter()
        self.longest_gap = 0.0
        self.events: list[str] = []

    def take(self, table: Table) -> Table | None:
        """The rows that can be recorded now, repaired; None if there are none."""
        unreadable = table.time == NO_TIME
        self._count("time_unreadable", unreadable)
        table = table.take(~unreadable)
        return self._repaired(self._in_time(table))

    def end(self) -> Table | None:
        """The rows that wait: those that begin a gap are recorded, others are dropped."""
        held, self._held = self._held, None
        kept = None
        if held is not None:
            follows = held.time >= self._highest if self._highest != NO_TIME else held.time >= 0
            kept = self._resolved(held, follows)
        return self._repaired(kept)

    # ------------------------------------------------------------------------------------ time

    def _in_time(self, table: Table) -> Table | None:
        """The rows whose time follows, and those that are only late."""
        if self._held is None and self._highest != NO_TIME and len(table):
            time = table.time + self._shift
            steps = np.diff(time, prepend=self._highest)
            if np.all((steps >= 0) & (steps <= self._ahead())):
                return self._accept(table.at(time))
        accepted: Table | None = None
        for number in range(len(table)):
            row = table.take(np.array([number]))
            for part in self._judge(row.at(row.time + self._shift)):
                accepted = part if accepted is None else accepted.then(part)
        return accepted

    def _judge(self, row: Table) -> list[Table]:
        """What is accepted now that this row has come."""
        time, ahead = int(row.time[0]), self._ahead()
        known = self._highest != NO_TIME
        if known and self._highest <= time <= self._highest + ahead:
            held, self._held = self._held, None
            late = [] if held is None else [self._resolved(held, np.zeros(len(held), np.bool_))]
            return [*filter(None, late), self._accept(row)]
        follows = self._held is not None and 0 <= time - int(self._held.time[-1]) <= ahead
        dropped: list[Table | None] = []
        if self._held is not None and not follows:
            dropped = [self._resolved(self._held, np.zeros(len(self._held), np.bool_))]
            self._held = None
        self._held = row if self._held is None else self._held.then(row)
        if len(self._held) < CONFIRMING:
            return [*filter(None, dropped)]
        held, self._held = self._held, None
        if known and int(held.time[0]) < self._highest:
            held = self._set_back(held)
        return [*filter(None, dropped), self._accept(held)]

    def _ahead(self) -> int:
        """How far ahead of the last row a time may be before it is doubted [ns]."""
        usual = float(np.median(self._steps)) if self._steps.size else 0.0
        return int(max(self._limits.sort_within * NANOSECONDS, 5.0 * usual))

    def _set_back(self, held: Table) -> Table:
        """Rows of a clock that was set back, put on where it stood before, by whole seconds."""
        usual = float(np.median(self._steps)) if self._steps.size else 0.0
        back = self._highest + usual - float(held.time[0])
        shift = int(max(round(back / NANOSECONDS), 1)) * NANOSECONDS
        self._shift += shift
        self.met["clock_step", ""] += 1
        self.events.append(
            f"the sender's clock was set back by {shift / NANOSECONDS:g} s; the rows from line"
            f" {held.rows[0]} on are {shift / NANOSECONDS:g} s later here than it states, so that"
            " time goes on"
        )
        return held.at(held.time + shift)

    def _resolved(self, held: Table, follows: BoolArray) -> Table | None:
        """Of rows that were not confirmed those that are late, or that `follows` marks."""
        within = int(self._limits.sort_within * NANOSECONDS)
        late = (held.time < self._highest) & (held.time >= self._highest - within) & ~follows
        self._count("time_backwards", late)
        wrong = ~late & ~follows
        self._count("clock_jump", wrong)
        for row, time in zip(held.rows[wrong], held.time[wrong], strict=True):
            self.events.append(f"line {row} was not recorded: its time is {_time(int(time))}")
        kept = held.take(late | follows)
        return kept if len(kept) else None

    def _accept(self, table: Table) -> Table:
        """Take rows whose time follows."""
        first = self._highest if self._highest != NO_TIME else int(table.time[0])
        steps = np.diff(table.time, prepend=first)
        usual = float(np.median(self._steps)) / NANOSECONDS if self._steps.size else 0.0
        threshold = self._limits.gap or max(1.0, 5.0 * usual)
        gaps = steps > threshold * NANOSECONDS
        if usual > 0.0 and gaps.any():
            self.met["gaps", ""] += int(gaps.sum())
            self.longest_gap = max(self.longest_gap, float(steps.max()) / NANOSECONDS)
            for end, step in zip(table.time[gaps], steps[gaps], strict=True):
                self.events.append(f"gap of {step / NANOSECONDS:.1f} s until {_time(int(end))}")
        moved = steps[(steps > 0) & ~gaps]
        self._steps = np.concatenate((self._steps, moved))[-STEPS:]
        self._highest = int(table.time[-1])
        return table

    # ---------------------------------------------------------------------------------- values

    def _repaired(self, table: Table | None) -> Table | None:
        if table is not None and len(table) and self._repair.duplicates:
            table = self._without_duplicates(table)
        if table is not None and self._repair.out_of_limits:
            table = self._within_limits(table)
        return table if table is not None and len(table) else None

    def _without_duplicates(self, table: Table) -> Table:
        before, self._previous = self._previous, table.take(np.array([len(table) - 1]))
        both = table if before is None else before.then(table)
        repeated = same_as_previous(both) & (np.diff(both.time, prepend=NO_TIME) == 0)
        repeated = repeated[len(both) - len(table) :]
        self._count("duplicates", repeated)
        return table.take(~repeated)

    def _within_limits(self, table: Table) -> Table:
        for name, values in table.signals.items():
            bounds = self._limits.of(name)
            out = (values < bounds.low) | (values > bounds.high)
            key = ("out_of_limits", base_name(name))
            self.met["", name] += int(np.count_nonzero(np.isfinite(values)))
            if not out.any():
                continue
            self._count(*key[:1], out, key[1])
            table = table.without(name, out)
            present = self.met["", name]
            most = self.met[key] > present / 2 and ("unit_suspected", key[1]) not in self.met
            if present >= DOUBTED and most:
                self.met["unit_suspected", key[1]] += 1
                self.events.append(
                    f"most values of {key[1]} are impossible: check the unit of its column in the"
                    " profile"
                )
        return table

    def _count(self, rule: str, rows: BoolArray, column: str = "") -> None:
        if rows.any():
            self.met[rule, column] += int(np.count_nonzero(rows))


def _time(time: int) -> str:
    return pd.Timestamp(time, tz="UTC").strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
