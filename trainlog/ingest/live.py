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
from trainlog.errors import InputError, in_file
from trainlog.formats.files import writing_error
from trainlog.formats.sfera import SferaJourney
from trainlog.ingest.clock import gap_beside, same_as_previous
from trainlog.ingest.motion import MANY
from trainlog.ingest.pipeline import Given, attachments_of, bounded_limits, metadata_of, profile_of
from trainlog.ingest.profile import Limits, Profile, Repair, default_profile, own_topics
from trainlog.ingest.recording import (
    INFO,
    LONGEST_TEXT,
    MOST,
    NO_TIME,
    WARNING,
    Recording as Recorded,
    Table,
    base_name,
    frames,
)
from trainlog.ingest.rules import impossible
from trainlog.ingest.sources import POLL, Source
from trainlog.ingest.stream import Decoded, Decoder, Framer, Malformed, as_it_came
from trainlog.ingest.tabular import open_text
from trainlog.ingest.telegrams import TelegramFramer
from trainlog.mcap.recorder import Recording, record
from trainlog.topics import EVENTS, GNSS_MOTION, TOPICS, TRAIN_STATE, Topic
from trainlog.units import NANOSECONDS

CONFIRMING = 3
"""Rows that must follow each other before a time is believed that does not follow those before."""

RESTART = 1000
"""A number that falls by more than this is the first of a sender that was started again."""

COUNTERS = tuple(1 << bits for bits in (8, 16, 32))
"""Numbers that a sender's counter of 1, 2 or 4 bytes has; behind the last, it goes on at 0."""

NEAR = 32, 100
"""Within this part of a counter's numbers, and so many, of its end and of 0 it has gone round."""


class Numbering:
    """The numbers that a sender counts its lines with: what did not arrive.

    Attributes
    ----------
    counts : dict of str to int
        ``"lost"``: numbers that were passed over and have not come since; ``"late"``,
        ``"repeated"``: lines that came after one with a higher number, or twice; ``"restarts"``:
        lines with which the sender began to count anew.
    """

    def __init__(self) -> None:
        self.counts = dict.fromkeys(("lost", "late", "repeated", "restarts"), 0)
        self._highest: int | None = None
        self._missing: set[int] = set()
        self._size = self._begun = 0  # of the counter, once it has gone round; begin of its round

    def take(self, numbers: Iterable[int]) -> None:
        """Take the numbers in the order of arrival."""
        for counted_as in numbers:
            number = self._gone_on(counted_as)
            if self._highest is None or number > self._highest:
                between = range(number if self._highest is None else self._highest + 1, number)
                self.counts["lost"] += len(between)
                self._missing.update(between[-RESTART:])
                self._highest = number
            elif number in self._missing:
                self._missing.discard(number)
                self.counts["lost"] -= 1
                self.counts["late"] += 1
            elif self._highest - number > RESTART or counted_as <= 1:
                self.counts["restarts"] += 1
                self._highest, self._missing, self._begun = counted_as, set(), 0
            else:
                self.counts["repeated"] += 1

    def _gone_on(self, number: int) -> int:
        """The number since the sender was started: its counter may have gone round."""
        last = -1 if self._highest is None else self._highest - self._begun
        size = next((each for each in COUNTERS if last < each and self._size <= each), 0)
        near = min(size // NEAR[0], NEAR[1])
        if last < size <= last + near and number < near:
            self._size, self._begun = size, self._begun + size
        elif self._begun and last < near and size - near <= number < size:
            return self._begun - size + number  # late, from before the counter went round
        return self._begun + number


@dataclass
class Met:
    """What was met in a stream.

    Attributes
    ----------
    counts : Counter of (str, str)
        How often each rule met something, by rule and column (empty: whole rows).
    longest_gap : float [s]
        Longest time between two rows that counts as a gap.
    events : list of (int, str)
        What is still to be recorded among the log's events: level and words.
    """

    counts: Counter[tuple[str, str]] = field(default_factory=Counter)
    longest_gap: float = 0.0
    events: list[tuple[int, str]] = field(default_factory=list)

    def count(self, rule: str, cells: BoolArray, column: str = "") -> None:
        """Count the marked rows or cells."""
        if cells.any():
            self.counts[rule, column] += int(np.count_nonzero(cells))

    def say(self, words: str, level: int = WARNING) -> None:
        """Take note of an event."""
        self.events.append((level, words))


class Sequence:
    """The rows of one kind of lines, in the order of their time and within the limits.

    Parameters
    ----------
    limits : Limits
    repair : Repair
    met : Met
        Where it is counted what they meet.
    late : int [ns]
        Rows that come so much later than others are recorded with their own time: their source
        keeps what it cannot deliver at once.
    """

    def __init__(self, limits: Limits, repair: Repair, met: Met, late: int = 0) -> None:
        self._limits, self._repair, self._met, self._late = limits, repair, met, late
        self._highest, self._shift = NO_TIME, 0
        self._steps = np.zeros(0, dtype=np.int64)
        self._waiting: Table | None = None
        self._previous: Table | None = None
        self._shown: Counter[str] = Counter()

    def take(self, table: Table, *, end: bool = False) -> Table | None:
        """The rows that can be recorded now; None if there are none.

        A row whose time does not follow waits until others follow it; at the end those that begin
        a gap are recorded, others dropped.
        """
        unreadable = table.time == NO_TIME
        self._met.count("time_unreadable", unreadable)
        table = table.take(~unreadable)
        table = table.at(table.time + self._shift)
        if self._waiting is not None:
            table, self._waiting = self._waiting.then(table), None
        table = self._in_order(table, end=end)
        if self._repair.duplicates and len(table):
            table = self._without_duplicates(table)
        if self._repair.out_of_limits:
            table = self._within_limits(table)
        return table if len(table) else None

    def _in_order(self, table: Table, *, end: bool) -> Table:
        """The rows whose time follows, and those that are only late; others wait, or are wrong."""
        time, first = table.time, self._highest
        steps = np.diff(time, prepend=first)
        follows = (steps >= 0) & (steps <= self._ahead())
        self._steps = np.concatenate((self._steps, steps[follows & (steps > 0)]))[-MANY:]
        kept, late = np.ones(len(table), dtype=np.bool_), np.zeros(len(table), dtype=np.bool_)
        if first == NO_TIME or not follows.all():
            time, kept, late, waiting = self._judged(time.copy(), table.rows, end=end)
            table = table.at(time)
            self._waiting = table.take(waiting) if waiting.any() else None
            wrong = ~kept & ~late & ~waiting
            self._met.count("time_backwards", late)
            self._met.count("clock_jump", wrong)
            for row, at in zip(table.rows[wrong], time[wrong], strict=True):
                self._met.say(f"line {row} was not recorded: its time is {_time(int(at))}")
        if kept.any():
            self._go_on(time[kept], first)
        return table.take(kept | late)

    def _judged(
        self, time: IntArray, rows: IntArray, *, end: bool
    ) -> tuple[IntArray, BoolArray, BoolArray, BoolArray]:
        """The times, and which rows are kept, which of the others are late, and which wait.

        Rows that follow each other, but not those before, are believed from `CONFIRMING` on: after
        a gap, or where a clock was set back, which is then put on by whole seconds.
        """
        ahead, within = self._ahead(), int(self._limits.sort_within * NANOSECONDS)
        kept = np.zeros(time.size, dtype=np.bool_)
        reached = np.full(time.size, NO_TIME)
        begun = 0  # the first of the rows that wait
        for number in range(time.size):
            reached[number], at = self._highest, int(time[number])
            if self._highest - self._late <= at < self._highest:
                begun = number + 1
                continue
            if self._highest != NO_TIME and 0 <= at - self._highest <= ahead:
                kept[number], begun, self._highest = True, number + 1, at
                continue
            if number > begun and not 0 <= at - time[number - 1] <= ahead:
                begun = number
            if number - begun + 1 == CONFIRMING:
                if time[begun] < self._highest:
                    time[begun:] += self._set_back(int(time[begun]), int(rows[begun]))
                kept[begun : number + 1], self._highest = True, int(time[number])
                begun = number + 1
        waiting = np.arange(time.size) >= begun
        if end:
            kept |= waiting & (time >= max(self._highest, 0))
            waiting[:] = False
        late = ~kept & ~waiting & (reached != NO_TIME) & (time < reached)
        return time, kept, late & (time >= reached - max(within, self._late)), waiting

    def _usual(self) -> float:
        """Usual interval between rows [ns]; 0 if it is not known yet."""
        return float(np.median(self._steps)) if self._steps.size else 0.0

    def _ahead(self) -> int:
        """How far ahead of the last row a time may be before it is doubted [ns]."""
        within = max(self._limits.sort_within * NANOSECONDS, self._late)
        return int(max(within, 5.0 * self._usual()))

    def _set_back(self, time: int, row: int) -> int:
        """By how much a clock that was set back is put on [ns]."""
        back = (self._highest + self._usual() - time) / NANOSECONDS
        seconds = max(round(back), 1)
        self._shift += seconds * NANOSECONDS
        self._met.counts["clock_step", ""] += 1
        self._met.say(
            f"the sender's clock was set back by {seconds} s; the rows from line {row} on are"
            f" {seconds} s later here than it states, so that time goes on"
        )
        return seconds * NANOSECONDS

    def _go_on(self, time: IntArray, before: int) -> None:
        """Go on behind rows that follow, and count the gaps before them."""
        steps = np.diff(time, prepend=time[0] if before == NO_TIME else before)
        self._highest = int(time[-1])
        gaps = steps > gap_beside(self._usual() / NANOSECONDS, self._limits) * NANOSECONDS
        self._met.count("gaps", gaps)
        for end, step in zip(time[gaps], steps[gaps] / NANOSECONDS, strict=True):
            self._met.longest_gap = max(self._met.longest_gap, float(step))
            self._met.say(f"gap of {step:.1f} s until {_time(int(end))}")

    def _without_duplicates(self, table: Table) -> Table:
        before, self._previous = self._previous, table.take(np.array([len(table) - 1]))
        both = table if before is None else before.then(table)
        repeated = same_as_previous(both) & (np.diff(both.time, prepend=NO_TIME) == 0)
        repeated = repeated[len(both) - len(table) :]
        self._met.count("duplicates", repeated)
        return table.take(~repeated)

    def _within_limits(self, table: Table) -> Table:
        for name, values in table.signals.items():
            column, (out, judged) = base_name(name), impossible(values, self._limits.of(name))
            self._shown[column] += int(np.count_nonzero(judged))
            if not out.any():
                continue
            self._met.count("out_of_limits", out, column)
            table = table.without(name, out)
            counts, suspected = self._met.counts, ("unit_suspected", column)
            most = counts["out_of_limits", column] > MOST * self._shown[column]
            if self._shown[column] >= MANY and most and suspected not in counts:
                counts[suspected] += 1
                self._met.say(
                    f"most values of {column} are impossible: check the unit of its column in the"
                    " profile"
                )
        return table


def _time(time: int) -> str:
    return pd.Timestamp(time, tz="UTC").strftime("%Y-%m-%d %H:%M:%S.%f")[:-3]


SOURCE = "trainlog.record"
"""What events of this module name as their source."""

FLUSH = 0.5
"""A log is whole up to so long [s] before whatever ends the program."""

MOST_KEPT = 1000
"""Malformed lines that are kept in the log; more are counted."""

MOST_REASONS = 10
"""Reasons for which malformed lines are counted apart; they may hold a value of the line."""

LONGEST_STEP = 60.0
"""Over longer pauses of a stream nothing counts as driven [s]."""


class Progress:
    """How far a recording is.

    Attributes
    ----------
    time : int or None
        Of the last sample [ns UTC].
    speed : float or None
        Last known [m/s].
    """

    def __init__(self) -> None:
        self.time: int | None = None
        self.speed: float | None = None
        self._driven: dict[str, tuple[float, float, float]] = {}

    @property
    def distance(self) -> float:
        """Driven since the first sample [m], by the train's speed or else a receiver's."""
        topics = (TRAIN_STATE.name, GNSS_MOTION.name)
        return next((self._driven[each][0] for each in topics if each in self._driven), 0.0)

    def take(self, topic: str, time: IntArray, frame: pd.DataFrame) -> None:
        """Take the rows of a topic."""
        self.time = max(int(time[-1]), self.time or 0)
        known = np.isfinite(frame["speed"].to_numpy()) if "speed" in frame else np.zeros(0)
        if topic not in (TRAIN_STATE.name, GNSS_MOTION.name) or not known.any():
            return
        seconds, speed = time[known] / NANOSECONDS, frame["speed"].to_numpy()[known]
        driven, *last = self._driven.get(topic, (0.0, seconds[0], speed[0]))
        seconds, speed = np.append(last[0], seconds), np.append(last[1], speed)
        passed = np.diff(seconds)
        mean = 0.5 * (np.abs(speed[1:]) + np.abs(speed[:-1]))
        driven += float(np.sum((mean * passed)[passed <= LONGEST_STEP]))
        self._driven[topic] = driven, float(seconds[-1]), float(speed[-1])
        self.speed = float(speed[-1])


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
    journey : SferaJourney, optional
        Whose train sends status reports.
    """

    source: str = ""
    header: Path | None = None
    sequence: str = "sequence"
    journey: SferaJourney | None = None


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
        journey: SferaJourney | None = None,
    ) -> None:
        self._recording = recording
        telegram = profile.telegram if profile is not None else None
        self._framer = Framer() if telegram is None else TelegramFramer(telegram.length)
        self._lines = telegram is None
        self._decoder = Decoder(profile, header, sequence, journey)
        self._repair = profile.repair if profile is not None else Repair()
        self._limits = limits or (profile.limits if profile is not None else Limits())
        self._own: dict[str, Topic] = own_topics(profile.columns) if profile is not None else {}
        for topic in self._own.values():
            recording.declare(topic)
        self._sequences: dict[str, Sequence] = {}
        self._late = 0
        self._waiting: list[tuple[int, bytes]] = []
        self._constants: dict[str, float | str] = {}
        self._met = Met()
        self.progress = Progress()
        self.lines = 0
        self.malformed: Counter[str] = Counter()
        self.others: Counter[str] = Counter()
        self.numbering = Numbering()

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
        profile, attachments = profile_of(given.profile)
        header = None
        if options.header is not None:
            if profile is None:
                raise InputError("a header goes with a profile", remedy="give --profile, too")
            with in_file(options.header):
                header = open_text(options.header, profile.file).names
        rules = profile or default_profile()
        attachments |= attachments_of(given.line, given.train)
        direction = given.direction or rules.trip.direction or "forward"
        known = metadata_of(Recorded((), 0), rules, given.line, given.train, direction)
        known = {"trip": Path(path).stem} | known | dict(given.metadata or {})
        known |= {"source": options.source} if options.source else {}
        recording = record(path, metadata=known, attachments=attachments, flush=FLUSH)
        limits = bounded_limits(rules.limits, given.line, given.train)
        live = cls(
            recording, profile, header=header, limits=limits, sequence=options.sequence,
            journey=options.journey,
        )  # fmt: skip
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

        Raises
        ------
        InputError
            If that file cannot be written.
        """
        last, self._late = np.inf, int(source.late * NANOSECONDS)
        while True:
            ended, blocks = source.ended, source.read(POLL)
            now = clock.monotonic()
            for block in blocks:
                self.take(block, whole=source.whole)
                if raw is not None:
                    ended = not source.whole or not self._lines or block.endswith(b"\n")
                    try:
                        raw.write(block if ended else block + b"\n")
                    except OSError as error:
                        raise writing_error(raw.name, error) from error
            self.flush(clock.time_ns())
            each()
            if blocks:
                last = now
            silent = idle is not None and now - last > idle
            if stopped() or silent or (ended and not blocks):
                break

    def close(self, arrival: int | None = None) -> None:
        """Decode and record what waits for something that does not come, and what was met."""
        rest = self._framer.end()
        self.flush(arrival)
        if rest:
            self.lines += 1
            self._refuse(Malformed(self.lines, as_it_came(rest), "cut off"))
        self._add(self._decoder.end(), arrival)
        nothing = np.zeros(0, dtype=np.int64)
        for kind, sequence in self._sequences.items():
            self._write(kind, sequence.take(Table(nothing, nothing, {}), end=True))
        self._note()

    @property
    def met(self) -> dict[tuple[str, str], int]:
        """How often each rule met something, by rule and column (empty: whole rows)."""
        return dict(sorted(self._met.counts.items()))

    @property
    def longest_gap(self) -> float:
        """Longest time between two rows that counts as a gap [s]."""
        return self._met.longest_gap

    def sentences(self) -> list[str]:
        """What was met, a sentence each."""
        found = []
        total = sum(self.malformed.values())
        if total:
            reasons = ", ".join(f"{why} ({count:,})" for why, count in self.malformed.most_common())
            kept = f"; {total - MOST_KEPT:,} of them not kept in the log"
            found.append(
                f"{counted(total, 'malformed line')}: {reasons}{kept if total > MOST_KEPT else ''}"
            )
        for (rule, column), count in self.met.items():
            longest = f", the longest {self.longest_gap:.1f} s" if rule == "gaps" else ""
            found.append(f"{rule}: {count:,}{f' in {column}' if column else ''}{longest}")
        for what, count in self.numbering.counts.items():
            if count:
                found.append(f"{counted(count, 'line')} {what} by the sender's numbers")
        if self.others:
            kinds = ", ".join(f"{count:,} {name}" for name, count in sorted(self.others.items()))
            found.append(f"not used: {kinds}")
        return found

    def details(self) -> dict[str, Any]:
        """What was met, in JSON's types: lines, malformed ones by reason, rules, lost lines."""
        return {
            "lines": self.lines,
            "malformed": dict(self.malformed),
            "repairs": self._repairs(),
            "longest_gap_s": self.longest_gap,
            **{f"{what}_by_number": count for what, count in self.numbering.counts.items()},
            "not_used": dict(self.others),
            "distance_m": self.progress.distance,
        }

    def _repairs(self) -> dict[str, int]:
        return {f"{rule}.{column}".rstrip("."): count for (rule, column), count in self.met.items()}

    def _add(self, decoded: Decoded, arrival: int | None) -> None:
        for each in decoded.malformed:
            self._refuse(each)
        for finding in decoded.findings:
            self._met.counts[finding.rule, finding.column] += finding.count
        self.others += decoded.others
        self.numbering.take(decoded.numbers)
        self._constants = self._constants or decoded.constants
        for kind, table in decoded.tables.items():
            if kind.startswith(("json", "telegram")) and arrival is not None:
                table = table.at(np.where(table.time == NO_TIME, arrival, table.time))
            known = Sequence(self._limits, self._repair, self._met, self._late)
            self._write(kind, self._sequences.setdefault(kind, known).take(table))

    def _write(self, kind: str, table: Table | None) -> None:
        """Record rows, and what was met among them."""
        constants = self._constants if kind in ("row", "json") else {}
        written = {} if table is None else frames([table], constants, self._own)
        for name, frame in written.items():
            time = pd.DatetimeIndex(frame.index).as_unit("ns").asi8
            if name == EVENTS.name:
                words = frame[["level", "message", "name"]].itertuples(index=False, name=None)
                for at, event in zip(time.tolist(), words, strict=True):
                    self._recording.event(*event, time=at)
                continue
            topic = TOPICS.get(name) or self._own[name]
            self._recording.write(name, time, **_values(topic, frame))
            self.progress.take(name, time, frame)
        # Before the first sample there is no time to which an event belongs.
        if self.progress.time is not None:
            self._say()

    def _say(self) -> None:
        """Record the events that were met, at the time of the last sample."""
        for level, words in self._met.events:
            self._recording.event(level, words, SOURCE, time=self.progress.time)
        self._met.events.clear()

    def _refuse(self, each: Malformed) -> None:
        """Count a malformed line, and keep it in the log."""
        reason = each.reason.partition(": ")[0]
        known = reason in self.malformed or len(self.malformed) < MOST_REASONS
        self.malformed[reason if known else "other reasons"] += 1
        if sum(self.malformed.values()) <= MOST_KEPT:
            text = each.text if len(each.text) <= LONGEST_TEXT else f"{each.text[:LONGEST_TEXT]} …"
            self._met.say(f"malformed line {each.row}: {each.reason}: {text}")

    def _note(self) -> None:
        """Write what was met at the end of the log."""
        for words in self.sentences():
            self._met.say(words, INFO)
        self._say()
        notes = {"lines": self.lines, "malformed": sum(self.malformed.values())}
        if self.numbering.counts["lost"]:
            notes["lost_by_number"] = self.numbering.counts["lost"]
        notes |= {f"repair.{rule}": count for rule, count in self._repairs().items()}
        for name, count in notes.items():
            self._recording.note(name, str(count))


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
