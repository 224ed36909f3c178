"""A recorder's stream into a log while the train runs: decoded, put in order, counted.

A live recording keeps what comes. Order and limits are applied at once, as the rules of
`trainlog.ingest.rules` do; all other repair is left to ingesting what was recorded. A row whose
time does not follow those before waits until the rows behind it show whether it is late, wrong, or
the first after a gap.
"""

from __future__ import annotations

import time as clock
from collections import Counter
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from trainlog.arrays import BoolArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.formats.railway import line_to_bytes, train_to_bytes
from trainlog.ingest.clock import same_as_previous
from trainlog.ingest.pipeline import (
    PROFILE_ATTACHMENT,
    Given,
    bounded_limits,
    default_profile,
    metadata_of,
)
from trainlog.ingest.profile import Limits, Profile, Repair, own_topics, parse_profile
from trainlog.ingest.recording import NO_TIME, Recording as Recorded, Table, base_name, frames
from trainlog.ingest.sources import Source
from trainlog.ingest.stream import Decoded, Decoder, Framer, Malformed, as_it_came
from trainlog.ingest.tabular import open_text
from trainlog.ingest.telegrams import TelegramFramer
from trainlog.mcap.recorder import Recording, record
from trainlog.topics import EVENTS, GNSS_MOTION, TOPICS, TRAIN_STATE, Topic
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT
from trainlog.units import NANOSECONDS

CONFIRMING = 3
"""Rows that must follow each other before a time is believed that does not follow those before."""

STEPS = 100
"""Intervals between rows of which the usual one is the median."""

DOUBTED = 100
"""Values of a column from which on most of them being impossible is reported."""

RESTART = 1000
"""A number that falls by more than this is the first of a sender that was started again."""

COUNTERS = tuple(1 << bits for bits in (8, 16, 32))
"""Numbers that a sender's counter of 1, 2 or 4 bytes has; behind the last, it goes on at 0."""

NEAR = 32, 100
"""Within this part of a counter's numbers, and so many, of its end and of 0 it has gone round."""


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
    _counter: int = 0
    _begun: int = 0

    def take(self, numbers: Iterable[int]) -> None:
        """Take the numbers in the order of arrival."""
        for counted_as in numbers:
            number = self._gone_on(counted_as)
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
            elif self._highest - number > RESTART or counted_as <= 1:
                self.restarts += 1
                self._highest, self._missing, self._begun = counted_as, set(), 0
            else:
                self.repeated += 1

    def _gone_on(self, number: int) -> int:
        """The number since the sender was started: its counter may have gone round."""
        if self._highest is None:
            return number
        last = self._highest - self._begun
        size = next((each for each in COUNTERS if last < each and self._counter <= each), 0)
        near = min(size // NEAR[0], NEAR[1])
        if last < size <= last + near and number < near:
            self._counter, self._begun = size, self._begun + size
        elif self._begun and last < near and size - near <= number < size:
            return self._begun - size + number  # late, from before the counter went round
        return self._begun + number


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


INFO, WARNING = 2, 3
"""Levels of events."""

SOURCE = "trainlog.record"
"""What events of this module name as their source."""

WAIT = 0.1
"""How long to wait for the next block before the time is looked at [s]."""

MOST_KEPT = 1000
"""Malformed lines that are kept in the log; more are counted."""

MOST_TEXT = 200
"""Characters of a malformed line that are kept."""


@dataclass(frozen=True)
class Progress:
    """How far a recording is.

    Attributes
    ----------
    time : int or None
        Of the last sample [ns UTC].
    speed : float or None
        Last known [m/s].
    distance : float
        Driven since the first sample [m], by the integral of the speed.
    """

    time: int | None
    speed: float | None
    distance: float


@dataclass(frozen=True)
class LiveOptions:
    """How a stream is recorded.

    Attributes
    ----------
    source : str
        Where it comes from, in words, for the metadata of the trip.
    header : Path, optional
        A file of the same recorder, whose header names the columns of a stream without one.
    sequence : str
        Column or key with the number that the sender counts its lines with.
    flush : float [s]
        As in `trainlog.record`.
    """

    source: str = ""
    header: Path | None = None
    sequence: str = "sequence"
    flush: float = 0.5


class LiveIngest:
    """Decodes, repairs and records what a sender gives.

    Parameters
    ----------
    recording : Recording
        Made by `trainlog.record`; closed by whoever made it, after `close`.
    profile : Profile, optional
        As for `trainlog.ingest.ingest`; rows of a table need one.
    header : tuple of str, optional
        Names of the columns of a table that does not begin with them.
    limits : Limits, optional
        In place of the profile's.
    sequence : str
        Column or key with the number that the sender counts its lines with.

    Examples
    --------
    >>> import tempfile, trainlog
    >>> line = b'{"topic": "/train/state", "time": "2024-05-01T06:00:0%dZ", "speed": %d}'
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with trainlog.record(f"{folder}/trip.mcap") as recording:
    ...         live = LiveIngest(recording)
    ...         for second in range(5):
    ...             live.take(line % (second, 10 + second), whole=True)
    ...         live.take(b"{half a li", whole=True)
    ...         live.close()
    ...     trip = trainlog.read(f"{folder}/trip.mcap")
    >>> trip["/train/state"]["speed"].tolist()
    [10.0, 11.0, 12.0, 13.0, 14.0]
    >>> live.malformed
    Counter({'no JSON': 1})
    """

    def __init__(
        self,
        recording: Recording,
        profile: Profile | None = None,
        *,
        header: tuple[str, ...] | None = None,
        limits: Limits | None = None,
        sequence: str = "sequence",
    ) -> None:
        self._recording = recording
        telegram = profile.telegram if profile is not None else None
        self._framer = Framer() if telegram is None else TelegramFramer(telegram.length)
        self._lines = telegram is None
        self._decoder = Decoder(profile, header, sequence)
        self._repair = profile.repair if profile is not None else Repair()
        self._limits = limits or (profile.limits if profile is not None else Limits())
        self._own: dict[str, Topic] = own_topics(profile.columns) if profile is not None else {}
        for topic in self._own.values():
            recording.declare(topic)
        self._sequences: dict[str, Sequence] = {}
        self._waiting: list[tuple[int, bytes]] = []
        self._events: list[tuple[int, str]] = []
        self._kept = 0
        self._constants: dict[str, float | str] = {}
        self._driven = _Driven()
        self.lines = 0
        self.malformed: Counter[str] = Counter()
        self.others: Counter[str] = Counter()
        self.numbering = Numbering()
        self._read: Counter[tuple[str, str]] = Counter()

    @classmethod
    def begun(
        cls, path: str | Path, given: Given, options: LiveOptions
    ) -> tuple[Recording, LiveIngest]:
        """A recording with what is known of line, train and recorder, and what decodes into it.

        Raises
        ------
        InputError
            If the file exists, or what is given cannot be used.
        """
        if given.network is not None:
            raise InputError(
                "a route in a network is found when a trip is over, not while it is recorded",
                remedy="give the line of its route (my.network.json#Wil,Gossau), or record without"
                " and ingest what --raw kept",
            )
        attachments: dict[str, bytes] = {}
        profile = given.profile
        if profile is not None and not isinstance(profile, Profile):
            attachments[PROFILE_ATTACHMENT] = read_bytes(profile)
            profile = parse_profile(attachments[PROFILE_ATTACHMENT], file=profile)
        header = None
        if options.header is not None:
            if profile is None:
                raise InputError("a header goes with a profile", remedy="give --profile, too")
            header = open_text(options.header, profile.file).names
        rules = profile or default_profile()
        if given.line is not None:
            attachments[LINE_ATTACHMENT] = line_to_bytes(given.line)
        if given.train is not None:
            attachments[TRAIN_ATTACHMENT] = train_to_bytes(given.train)
        direction = given.direction or rules.trip.direction or "forward"
        known = metadata_of(Recorded((), 0), rules, given.line, given.train, direction)
        known = {"trip": Path(path).stem} | known | dict(given.metadata or {})
        known |= {"source": options.source} if options.source else {}
        recording = record(path, metadata=known, attachments=attachments, flush=options.flush)
        limits = bounded_limits(rules.limits, given.line, given.train)
        live = cls(recording, profile, header=header, limits=limits, sequence=options.sequence)
        return recording, live

    def take(self, data: bytes, *, whole: bool = False) -> None:
        """Take what has come next; `flush` decodes it.

        Parameters
        ----------
        data : bytes
        whole : bool
            Whether it ends with the end of a line or message, as a datagram does.
        """
        for frame in self._framer.cut(data, whole=whole):
            self.lines += 1
            self._waiting.append((self.lines, frame))

    def flush(self, arrival: int | None = None) -> None:
        """Decode and record what was taken.

        Parameters
        ----------
        arrival : int [ns UTC], optional
            Time of JSON samples and telegrams that state none. Default: they are not recorded.
        """
        waiting, self._waiting = self._waiting, []
        if waiting:
            self._add(self._decoder.decode(waiting), arrival)

    def follow(
        self,
        source: Source,
        *,
        stopped: Callable[[], bool] = lambda: False,
        idle: float | None = None,
        each: Callable[[], object] = lambda: None,
        raw: BinaryIO | None = None,
    ) -> None:
        """Record what a source gives until it ends, is to stop, or is silent for too long.

        Parameters
        ----------
        source : Source
            Within its ``with`` block.
        stopped : callable
            Asked ten times a second at least.
        idle : float [s], optional
            Silence after which the recording ends, once something has come.
        each : callable
            Called as often, to show how far the recording is.
        raw : binary file, optional
            Where everything is written as it came.
        """
        last = np.inf
        while True:
            blocks = source.read(WAIT)
            now = clock.monotonic()
            for block in blocks:
                self.take(block, whole=source.whole)
                if raw is not None:
                    raw.write(block)
                    if source.whole and self._lines and not block.endswith(b"\n"):
                        raw.write(b"\n")
            self.flush(clock.time_ns())
            each()
            if blocks:
                last = now
            silent = idle is not None and now - last > idle
            if stopped() or silent or (source.ended and not blocks):
                break

    def close(self, arrival: int | None = None) -> None:
        """Decode and record what waits for something that does not come, and what was met."""
        rest = self._framer.end()
        self.flush(arrival)
        if rest:
            self.lines += 1
            self._refuse(Malformed(self.lines, as_it_came(rest), "cut off"))
        self._add(self._decoder.end(), arrival)
        for kind, sequence in self._sequences.items():
            self._write(kind, sequence, sequence.end())
        self._note()

    @property
    def progress(self) -> Progress:
        """How far the recording is."""
        driven = self._driven
        return Progress(driven.time, driven.speed, driven.distance)

    @property
    def met(self) -> dict[tuple[str, str], int]:
        """How often each rule met something, by rule and column (empty: whole rows)."""
        every = Counter(self._read)
        for sequence in self._sequences.values():
            every.update({key: count for key, count in sequence.met.items() if key[0] and count})
        return dict(every)

    @property
    def longest_gap(self) -> float:
        """Longest time between two rows that counts as a gap [s]."""
        return max((each.longest_gap for each in self._sequences.values()), default=0.0)

    def sentences(self) -> list[str]:
        """What was met, a sentence each."""
        found = []
        total = sum(self.malformed.values())
        if total:
            reasons = ", ".join(f"{why} ({count:,})" for why, count in self.malformed.most_common())
            beyond = total - self._kept
            kept = f"; {beyond:,} of them not kept in the log" if beyond > 0 else ""
            found.append(f"{counted(total, 'malformed line')}: {reasons}{kept}")
        for (rule, column), count in sorted(self.met.items()):
            longest = f", the longest {self.longest_gap:.1f} s" if rule == "gaps" else ""
            found.append(f"{rule}: {count:,}{f' in {column}' if column else ''}{longest}")
        numbers = self.numbering
        for count, words in (
            (numbers.lost, "lost"), (numbers.late, "late"), (numbers.repeated, "came twice"),
        ):  # fmt: skip
            if count:
                found.append(f"{counted(count, 'line')} {words} by the sender's numbers")
        if numbers.restarts:
            found.append(f"the sender began to count anew {counted(numbers.restarts, 'time')}")
        if self.others:
            kinds = ", ".join(f"{count:,} {name}" for name, count in sorted(self.others.items()))
            found.append(f"not used: {kinds}")
        return found

    def details(self) -> dict[str, Any]:
        """What was met, in JSON's types: lines, malformed ones by reason, rules, lost lines."""
        numbers = self.numbering
        return {
            "lines": self.lines,
            "malformed": dict(self.malformed),
            "repairs": {
                f"{rule}.{column}" if column else rule: count
                for (rule, column), count in sorted(self.met.items())
            },
            "longest_gap_s": self.longest_gap,
            "lost_by_number": numbers.lost,
            "late_by_number": numbers.late,
            "repeated_by_number": numbers.repeated,
            "restarts_by_number": numbers.restarts,
            "not_used": dict(self.others),
            "distance_m": self._driven.distance,
        }

    def _add(self, decoded: Decoded, arrival: int | None) -> None:
        for each in decoded.malformed:
            self._refuse(each)
        for finding in decoded.findings:
            self._read[finding.rule, finding.column] += finding.count
        self.others += decoded.others
        self.numbering.take(decoded.numbers)
        if decoded.constants and not self._constants:
            self._constants = decoded.constants
        for kind, table in decoded.tables.items():
            undated = table.time == NO_TIME
            if kind.startswith(("json", "telegram")) and arrival is not None and undated.any():
                table = table.at(np.where(undated, arrival, table.time))
            sequence = self._sequences.setdefault(kind, Sequence(self._limits, self._repair))
            self._write(kind, sequence, sequence.take(table))

    def _write(self, kind: str, sequence: Sequence, table: Table | None) -> None:
        """Record rows, and the events of their sequence."""
        events, sequence.events = sequence.events, []
        for words in events:
            self._event(WARNING, words)
        if table is None:
            return
        constants = self._constants if kind in ("row", "json") else {}
        for name, frame in frames([table], constants, self._own).items():
            time = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
            if name == EVENTS.name:
                for at, (level, message, source) in zip(
                    time.tolist(), frame[["level", "message", "name"]].to_numpy(), strict=True
                ):
                    self._recording.event(int(level), message, source, time=at)
                continue
            topic = TOPICS.get(name) or self._own[name]
            self._recording.write(name, time, **_values(topic, frame))
            self._driven.take(name, time, frame)
        if self._events and self._driven.time is not None:
            for level, words in self._events:
                self._recording.event(level, words, SOURCE, time=self._driven.time)
            self._events = []

    def _refuse(self, each: Malformed) -> None:
        """Count a malformed line, and keep it in the log."""
        self.malformed[each.reason.partition(":")[0]] += 1
        self._kept += self._kept < MOST_KEPT
        if sum(self.malformed.values()) <= MOST_KEPT:
            text = each.text if len(each.text) <= MOST_TEXT else f"{each.text[:MOST_TEXT]} …"
            self._event(WARNING, f"malformed line {each.row}: {each.reason}: {text}")

    def _event(self, level: int, words: str) -> None:
        """Record an event at the time of the last sample; before the first it waits for it."""
        if self._driven.time is None:
            self._events.append((level, words))
        else:
            self._recording.event(level, words, SOURCE, time=self._driven.time)

    def _note(self) -> None:
        """Write what was met at the end of the log."""
        for words in self.sentences():
            self._event(INFO, words)
        for level, words in self._events:
            self._recording.event(level, words, SOURCE)
        self._recording.note("lines", str(self.lines))
        self._recording.note("malformed", str(sum(self.malformed.values())))
        if self.numbering.lost:
            self._recording.note("lost_by_number", str(self.numbering.lost))
        for (rule, column), count in sorted(self.met.items()):
            key = f"repair.{rule}.{column}" if column else f"repair.{rule}"
            self._recording.note(key, str(count))


def _values(topic: Topic, frame: pd.DataFrame) -> dict[str, np.ndarray]:
    """The columns of a frame by field, those of axles side by side."""
    names = list(frame.columns)
    table = frame.to_numpy(dtype=np.float64)
    known = dict(zip(names, np.isfinite(table).any(axis=0).tolist(), strict=True))
    found = {}
    for item in topic.fields:
        if item.per_axle:
            places = [n for n, name in enumerate(names) if name.startswith(f"{item.name}_")]
            if places:
                found[item.name] = table[:, places]
        elif known[item.name]:
            found[item.name] = table[:, names.index(item.name)]
    return found


class _Driven:
    """Time, speed and distance of what was recorded so far."""

    def __init__(self) -> None:
        self.time: int | None = None
        self.speed: float | None = None
        self._distances: dict[str, float] = {}
        self._last: dict[str, tuple[int, float]] = {}

    @property
    def distance(self) -> float:
        """The integral of the train's speed, else of its receiver's [m]."""
        return self._distances.get(TRAIN_STATE.name, self._distances.get(GNSS_MOTION.name, 0.0))

    def take(self, topic: str, time: IntArray, frame: pd.DataFrame) -> None:
        """Take the rows of a topic."""
        latest = int(time[-1])
        self.time = latest if self.time is None else max(self.time, latest)
        if topic not in (TRAIN_STATE.name, GNSS_MOTION.name):
            return
        speed = frame["speed"].to_numpy()
        known = np.isfinite(speed)
        if not known.any():
            return
        before = self._last.get(topic, (int(time[known][0]), float(speed[known][0])))
        seconds = np.append(before[0], time[known]) / NANOSECONDS
        driven = float(np.trapezoid(np.abs(np.append(before[1], speed[known])), seconds))
        self._distances[topic] = self._distances.get(topic, 0.0) + driven
        self.speed = float(speed[known][-1])
        self._last[topic] = (int(time[known][-1]), self.speed)
