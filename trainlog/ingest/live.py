"""A recorder's stream into a log while the train runs: decoded, repaired, counted."""

from __future__ import annotations

import time as clock
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
import pandas as pd

from trainlog.arrays import IntArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.formats.railway import line_to_bytes, train_to_bytes
from trainlog.ingest.framing import frames
from trainlog.ingest.pipeline import (
    PROFILE_ATTACHMENT,
    Given,
    bounded_limits,
    default_profile,
    metadata_of,
)
from trainlog.ingest.profile import Profile, parse_profile
from trainlog.ingest.profile_columns import own_topics
from trainlog.ingest.profile_parts import Limits, Repair
from trainlog.ingest.recording import NO_TIME, Recording as Recorded, Table
from trainlog.ingest.sequence import Numbering, Sequence
from trainlog.ingest.sources import Source
from trainlog.ingest.stream import Decoded, Decoder, Framer, Malformed
from trainlog.ingest.tabular import open_text
from trainlog.mcap.recorder import Recording, record
from trainlog.topics import EVENTS, TOPICS, Topic
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT
from trainlog.units import EARTH_RADIUS, NANOSECONDS

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
        Driven since the first sample [m], by position, else by the integral of the speed, else
        from fix to fix.
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
        self._framer = Framer()
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
            Time of JSON samples that state none. Default: they are not recorded.
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
                    if source.whole and not block.endswith(b"\n"):
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
            self._refuse(Malformed(self.lines, rest.decode("utf-8", "replace"), "cut off"))
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
        if numbers.lost:
            found.append(f"{counted(numbers.lost, 'line')} lost by the sender's numbers")
        if numbers.late:
            found.append(f"{counted(numbers.late, 'line')} late by the sender's numbers")
        if numbers.repeated:
            found.append(f"{counted(numbers.repeated, 'line')} came twice by the sender's numbers")
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
            if kind.startswith("json") and arrival is not None and undated.any():
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
        self._last: dict[str, tuple[int, tuple[float, ...]]] = {}

    @property
    def distance(self) -> float:
        """By the first of position, speeds and fixes that is known [m]."""
        for name in ("position", "/train/state", "/gnss/motion", "/gnss/fix"):
            if name in self._distances:
                return self._distances[name]
        return 0.0

    def take(self, topic: str, time: IntArray, frame: pd.DataFrame) -> None:
        """Take the rows of a topic."""
        latest = int(time[-1])
        self.time = latest if self.time is None else max(self.time, latest)
        if topic in ("/train/state", "/gnss/motion"):
            speed = frame["speed"].to_numpy()
            known = np.isfinite(speed)
            if known.any():
                both = self._with_last(topic, time[known], speed[known, None])
                step = np.diff(both[0]) / NANOSECONDS
                mean = 0.5 * (both[1][1:, 0] + both[1][:-1, 0])
                self._drive(topic, float(np.sum(np.abs(mean) * step)))
                self.speed = float(speed[known][-1])
        if topic == "/train/state" and frame["position"].notna().any():
            known = frame["position"].notna().to_numpy()
            both = self._with_last(
                "position", time[known], frame["position"].to_numpy()[known, None]
            )
            self._drive("position", float(np.sum(np.abs(np.diff(both[1][:, 0])))))
        if topic == "/gnss/fix":
            fixes = frame[["latitude", "longitude"]].to_numpy()
            known = np.isfinite(fixes).all(axis=1)
            if known.any():
                _, places = self._with_last(topic, time[known], np.radians(fixes[known]))
                moved = places[1:] - places[:-1]
                steps = np.hypot(moved[:, 0], moved[:, 1] * np.cos(places[:-1, 0]))
                self._drive(topic, float(np.sum(EARTH_RADIUS * steps)))

    def _drive(self, name: str, distance: float) -> None:
        self._distances[name] = self._distances.get(name, 0.0) + distance

    def _with_last(
        self, name: str, time: IntArray, values: np.ndarray
    ) -> tuple[IntArray, np.ndarray]:
        last = self._last.get(name)
        self._last[name] = (int(time[-1]), tuple(values[-1]))
        if last is None:
            return time, values
        return np.append(last[0], time), np.vstack((last[1], values))
