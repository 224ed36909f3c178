"""Rows as they come: which of them follow in time, and what of their values can be.

The rules of repair are those of `trainlog.ingest.rules`, as far as they need nothing that comes
later: docs/log.md lists which. A row whose time does not follow those before waits until the rows
behind it show whether it is late, wrong, or the first after a gap.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, IntArray
from trainlog.ingest.clock import has_fix, same_as_previous
from trainlog.ingest.profile_parts import Limits, Repair
from trainlog.ingest.recording import NO_TIME, Table, base_name
from trainlog.ingest.rules import blank_without_fix
from trainlog.ingest.stream import joined
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
        self._fixed = False
        self._second = WholeSeconds()
        self._previous: Table | None = None
        self.met: Counter[tuple[str, str]] = Counter()
        self.longest_gap = 0.0
        self.events: list[str] = []

    def take(self, table: Table) -> Table | None:
        """The rows that can be recorded now, repaired; None if there are none."""
        unreadable = table.time == NO_TIME
        self._count("time_unreadable", unreadable)
        table = table.take(~unreadable)
        if self._repair.before_first_fix and not self._fixed and len(table):
            table = self._from_first_fix(table)
        return self._repaired(self._in_time(table))

    def end(self) -> Table | None:
        """The rows that wait: those that begin a gap are recorded, others are dropped."""
        held, self._held = self._held, None
        kept = None
        if held is not None:
            follows = held.time >= self._highest if self._highest != NO_TIME else held.time >= 0
            kept = self._resolved(held, follows)
        return self._repaired(kept, last=True)

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
                accepted = part if accepted is None else joined(accepted, part)
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
        self._held = row if self._held is None else joined(self._held, row)
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

    def _from_first_fix(self, table: Table) -> Table:
        fix = has_fix(table)
        if fix is None or not all(name.startswith("/gnss/") for name in table.signals):
            return table
        before = np.cumsum(fix) == 0
        self._fixed = bool(fix.any())
        self._count("before_first_fix", before)
        return table.take(~before)

    # ---------------------------------------------------------------------------------- values

    def _repaired(self, table: Table | None, *, last: bool = False) -> Table | None:
        if self._repair.subsecond:
            table = self._second.take(table, last=last)
            self.met["subsecond", ""] = self._second.moved
        if table is None or not len(table):
            return None
        if self._repair.duplicates:
            table = self._without_duplicates(table)
        if self._repair.no_fix:
            table, found = blank_without_fix(table, self._limits)
            for finding in found:
                self.met["no_fix", ""] += finding.count
        if self._repair.out_of_limits:
            table = self._within_limits(table)
        return table if len(table) else None

    def _without_duplicates(self, table: Table) -> Table:
        before, self._previous = self._previous, table.take(np.array([len(table) - 1]))
        both = table if before is None else joined(before, table)
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


class WholeSeconds:
    """Rows of a clock that knows whole seconds only, spread over each of them.

    As the rule ``subsecond``: the usual number N of rows a second lie 1/N s apart. The rows of a
    second wait until the next one begins.
    """

    def __init__(self) -> None:
        self.moved = 0
        self._waiting: Table | None = None
        self._usual = 0
        self._alone = 0
        self._fractions = False
        self._first = True
        self._before = 0

    def take(self, table: Table | None, *, last: bool = False) -> Table | None:
        """The rows of the seconds that are complete; all if these are the last."""
        if self._waiting is not None:
            table = self._waiting if table is None else joined(self._waiting, table)
            self._waiting = None
        if table is None or not len(table):
            return None
        self._fractions |= bool(np.any(table.time % NANOSECONDS))
        if self._fractions or (self._usual == 1 and self._alone >= CONFIRMING):
            return table
        second, count = np.unique(table.time, return_counts=True)
        # The first second is seldom whole: it waits for the second one, which shows the rate.
        whole = second[: None if last else -1]
        if not whole.size or (self._first and whole.size < 2 and not last):
            self._waiting = table
            return None
        counts = count[: whole.size]
        self._usual = max(self._usual, int(counts.max()))
        self._alone = self._alone + whole.size if self._usual == 1 else 0
        complete = table.time <= whole[-1]
        rest = table.take(~complete)
        self._waiting = rest if len(rest) else None
        return self._spread(table.take(complete), counts)

    def _spread(self, table: Table, counts: IntArray) -> Table:
        order = np.argsort(table.time, kind="stable")
        table = table.take(order)
        rank = np.arange(len(table)) - np.repeat(np.cumsum(counts) - counts, counts)
        share = np.maximum(np.repeat(counts, counts), self._usual)
        second = table.time[np.cumsum(counts) - counts]
        # The rows of a second behind a gap, or of the first one, are its last.
        begins = np.diff(second, prepend=self._before) != NANOSECONDS
        rank += np.repeat(np.where(begins, np.maximum(self._usual - counts, 0), 0), counts)
        self._first, self._before = False, int(second[-1])
        time = table.time + np.round(rank * (NANOSECONDS / share)).astype(np.int64)
        self.moved += int(np.count_nonzero(time != table.time))
        return table.at(time)


def _time(time: int) -> str:
    return pd.Timestamp(time, tz="UTC").strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]
