"""Which drive a trip is: known by the samples that were recorded, not by file, name or metadata.

Of each minute of UTC one number is kept, computed from the times and values of one recorded column:
the same drive ingested again with another load, estimated, cut, converted or recovered has the same
numbers, or some of them, and another drive has none of them. Two trips that share more than
`SHARED` of the shorter one's minutes are one drive; parts of a drive that overlap by less are two.
Where other rules of repair have moved the times, the recorded file decides: two trips that were
ingested from the same one are one drive if their spans of time overlap by more than that.
"""

from __future__ import annotations

import base64
import binascii
from collections import Counter
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from functools import cached_property
from hashlib import sha256
from typing import NamedTuple

import numpy as np
import pandas as pd

from trainlog.arrays import IntArray, UintArray
from trainlog.errors import InputError
from trainlog.presentation import Presented
from trainlog.trip import Trip, nanoseconds
from trainlog.units import MINUTE

COLUMNS = (
    ("/train/state", "speed", 1e-6),
    ("/gnss/motion", "speed", 1e-6),
    ("/gnss/fix", "latitude", 1e-9),
    ("/train/state", "position", 1e-4),
)
"""Topic, column and step to which its values are rounded; the first of them that was recorded."""


LEAST_VALUES = 3
"""Different values from which on a minute distinguishes a drive: all standing trains are alike."""

SHARED = 0.05
"""Share of the shorter trip's minutes beyond which two trips are one drive."""

_MICROSECOND = 1000
_GOLDEN = np.uint64(0x9E3779B97F4A7C15)
_FIRST = np.uint64(0xBF58476D1CE4E5B9)
_SECOND = np.uint64(0x94D049BB133111EB)


@dataclass(frozen=True, eq=False, repr=False)
class TripIdentity(Presented):
    """What distinguishes a drive from all others.

    Attributes
    ----------
    start, end : Timestamp
        Of the first and the last sample of the column.
    samples : int
        Recorded values of the column.
    blocks : (n,) uint64 array
        One number a minute with at least `LEAST_VALUES` different values, increasing. Of a trip
        without such a minute one number of all its samples and its train.
    source : str
        Digest of the recorded file that it was ingested from, and of the recording's name in it;
        empty if it was not ingested.
    """

    start: pd.Timestamp
    end: pd.Timestamp
    samples: int
    blocks: UintArray
    source: str = ""

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, TripIdentity):
            return NotImplemented
        return self.text == other.text

    def __hash__(self) -> int:  # type: ignore[override]
        return hash(self.text)

    @property
    def title(self) -> str:
        """When the trip began."""
        return f"Identity of the trip of {self.start:%Y-%m-%d %H:%M:%S UTC}"

    def summary(self) -> dict[str, str]:
        """Its samples and minutes."""
        return {"samples": f"{self.samples}", "minutes": f"{self.blocks.size}"}

    def shared(self, other: TripIdentity) -> float:
        """Share of the shorter trip that both have: 1 if one holds the other.

        Examples
        --------
        >>> import trainlog
        >>> trip = trainlog.read("sample_logs/stopping.mcap")
        >>> part = trip.between("2024-10-07T08:05", "2024-10-07T08:15")
        >>> identity_of(trip).shared(identity_of(part))
        1.0
        """
        both = np.intersect1d(self.blocks, other.blocks, assume_unique=True).size
        share = both / max(1, min(self.blocks.size, other.blocks.size))
        return max(share, self.overlap(other) if self.source == other.source != "" else 0.0)

    def overlap(self, other: TripIdentity) -> float:
        """Share of the shorter one's span of time in which the other was recorded, too."""
        common = min(self.end, other.end) - max(self.start, other.start)
        shorter = min(self.end - self.start, other.end - other.start)
        return max(0.0, common / max(shorter, pd.Timedelta(1, "ns")))

    @cached_property
    def text(self) -> str:
        """The identity as files hold it; `identity_from_text` reads it."""
        data = base64.b64encode(self.blocks.astype("<u8").tobytes()).decode("ascii")
        return f"{self.start.value} {self.end.value} {self.samples} {self.source or '-'} {data}"


def identity_of(trip: Trip) -> TripIdentity | None:
    """Which drive a trip is, by what was recorded: neither estimates nor metadata matter.

    The train takes part only where no minute distinguishes the drive: whatever it is called, the
    same samples at the same instants are one drive.

    Returns
    -------
    TripIdentity or None
        None if no column of `COLUMNS` was recorded.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> heavier = replace(trip, metadata={**trip.metadata, "load": "12000", "trip": "again"})
    >>> identity_of(heavier) == identity_of(trip)
    True
    >>> identity_of(trip)
    Identity of the trip of 2024-10-07 08:00:00 UTC
      samples  14140
      minutes  24
    """
    for topic, column, step in COLUMNS:
        frame = trip.topics.get(topic)
        if frame is None or column not in frame:
            continue
        values = frame[column].to_numpy(np.float64)
        known = np.isfinite(values)
        if not known.any():
            continue
        time = nanoseconds(frame)[known]
        rounded = np.rint(values[known] / step).astype(np.int64)
        if np.any(np.diff(time) < 0):
            order = np.argsort(time, kind="stable")
            time, rounded = time[order], rounded[order]
        blocks = _blocks(time, rounded)
        if not blocks.size:
            blocks = _whole(time, rounded, f"{topic}.{column} {trip.metadata.get('train', '')}")
        start, end = pd.Timestamp(time[0], tz="UTC"), pd.Timestamp(time[-1], tz="UTC")
        steps = (each for each in trip.provenance if each.get("step") == "ingest")
        source = str(next(steps, {}).get("source", ""))
        return TripIdentity(start, end, int(time.size), blocks, source)
    return None


def source_of(digests: Sequence[str], recording: str) -> str:
    """What identifies a recording: the SHA-256 of its files, and its name in them."""
    return sha256("\n".join([*sorted(digests), recording]).encode()).hexdigest()[:16]


def identity_from_text(text: str) -> TripIdentity | None:
    """The identity that a file holds; None if it holds none.

    Raises
    ------
    InputError
        If the text is no identity.

    Examples
    --------
    >>> import trainlog
    >>> found = identity_of(trainlog.read("sample_logs/nonstop.mcap"))
    >>> identity_from_text(found.text) == found, identity_from_text("")
    (True, None)
    """
    if not text:
        return None
    try:
        start, end, samples, source, data = text.split(" ")
        blocks = np.frombuffer(base64.b64decode(data, validate=True), dtype="<u8").astype(np.uint64)
        first, last = (pd.Timestamp(int(each), tz="UTC") for each in (start, end))
        return TripIdentity(first, last, int(samples), blocks, "" if source == "-" else source)
    except (ValueError, binascii.Error) as error:
        raise InputError(
            f"'{text[:40]}' is not the identity of a trip",
            remedy="make the file again from the logs",
        ) from error


def overlapping(texts: Sequence[str]) -> list[int]:
    """The numbers of the identities, as files hold them, whose spans of time meet another's.

    The others are of drives of their own: of many trips most are found to be so without more.

    Raises
    ------
    InputError
        If a text is no identity.

    Examples
    --------
    >>> overlapping(["10 20 5 - AAAA", "30 40 5 - AAAA", "18 25 5 - AAAA"])
    [0, 2]
    """
    try:
        ends = np.array([text.split(" ", 2)[:2] for text in texts], dtype=np.int64).reshape(-1, 2)
    except ValueError as error:
        raise InputError(
            "holds what is not the identity of a trip", remedy="make the file again from the logs"
        ) from error
    order = np.argsort(ends[:, 0], kind="stable")
    start, end = ends[order].T
    after = np.append(start[1:] <= np.maximum.accumulate(end)[:-1], False)
    return sorted(order[after | np.append(False, after[:-1])].tolist()) if len(texts) else []


def text_of(identity: TripIdentity | None) -> str:
    """The identity as files hold it; empty if it is not known."""
    return "" if identity is None else identity.text


class Known(NamedTuple):
    """A trip to be compared with others, and its place among those of one drive.

    Attributes
    ----------
    name : str
    identity : TripIdentity or None
        None: not known; such a trip is the same as no other.
    order : sortable
        Decides between recordings that are equally full: the least is used.
    held : bool
        Whether it is used whatever comes; such trips are not compared with each other.
    digest : str
        SHA-256 of the log, by which trips of one name are distinguished in words.
    """

    name: str
    identity: TripIdentity | None
    order: tuple[Hashable, ...] = ()
    held: bool = False
    digest: str = ""


@dataclass(frozen=True, slots=True)
class SameDrive:
    """A trip that is not used, since another that is used is of the same drive.

    Attributes
    ----------
    number, other : int
        Of the trip, and of the one that is used in its place.
    trip, of : str
        Their names.
    share : float
        Of the shorter one that is in both.
    held : bool
        Whether the other was used before these trips came.
    """

    number: int
    other: int
    trip: str
    of: str
    share: float
    held: bool = False

    @property
    def sentence(self) -> str:
        """It in words."""
        part = "" if self.share >= 1.0 else f" to {self.share:.0%} of the shorter one"
        used = "which is counted already" if self.held else "which is used"
        return f"trip '{self.trip}' is{part} the same drive as '{self.of}', {used}"


def same_drives(trips: Sequence[Known]) -> list[SameDrive]:
    """The trips that are not to be used, since others of the same drive are.

    The fullest recording of a drive is used: that of the most minutes, of these that of the most
    samples, of these the first by `Known.order`. Which trips are left out does not depend on the
    order in which they come, as long as `order` distinguishes them.

    Parameters
    ----------
    trips : sequence of Known

    Returns
    -------
    list of SameDrive
        In the order of `trips`.

    Examples
    --------
    >>> import trainlog
    >>> trip = trainlog.read("sample_logs/stopping.mcap")
    >>> halves = trip.between(None, "2024-10-07T08:10"), trip.between("2024-10-07T08:10", None)
    >>> whole, first, second = (identity_of(each) for each in (trip, *halves))
    >>> same_drives([Known("first", first), Known("second", second)])
    []
    >>> [each.trip for each in same_drives([Known("first", first), Known("whole", whole)])]
    ['first']
    """
    known = [number for number, trip in enumerate(trips) if trip.identity is not None]
    used: dict[int, int] = {}
    by_source: dict[str, list[int]] = {}
    found = []
    for number in sorted(known, key=lambda number: _place(trips[number])):
        trip, identity = trips[number], _known(trips[number])
        blocks = identity.blocks.tolist()
        owners = Counter(used[block] for block in blocks if block in used)
        shares = {owner: identity.shared(_known(trips[owner])) for owner in owners}
        for owner in by_source.get(identity.source, []):
            shares[owner] = identity.shared(_known(trips[owner]))
        # Several that are used may share a part each.
        share = max([owners.total() / max(1, len(blocks)), *shares.values()])
        if share > SHARED and not trip.held:
            other = min(shares, key=lambda owner: (-shares[owner], _place(trips[owner])))
            of = trips[other]
            names = trip.name, of.name
            if trip.name == of.name and trip.digest and of.digest:
                names = f"{trip.name} ({trip.digest[:8]})", f"{of.name} ({of.digest[:8]})"
            found.append(SameDrive(number, other, *names, share, of.held))
            continue
        used |= {block: number for block in blocks if block not in used}
        if identity.source:
            by_source.setdefault(identity.source, []).append(number)
    return sorted(found, key=lambda each: each.number)


def _known(trip: Known) -> TripIdentity:
    assert trip.identity is not None
    return trip.identity


def _place(trip: Known) -> tuple[object, ...]:
    identity = _known(trip)
    return (not trip.held, -identity.blocks.size, -identity.samples, trip.order)


def _blocks(time: IntArray, values: IntArray) -> UintArray:
    """A number for each minute in which the values distinguish a drive, increasing."""
    minute = time // MINUTE
    first = np.flatnonzero(np.diff(minute, prepend=minute[0] - 1))
    order = np.lexsort((values, minute))
    new = np.diff(values[order], prepend=values[order[0]]) != 0
    new[first] = True
    different = np.add.reduceat(new.astype(np.int64), first)
    with np.errstate(over="ignore"):
        total = np.add.reduceat(_of_samples(time, values), first)
        found = _mixed(total + _mixed(minute[first].view(np.uint64)))
    return np.asarray(np.unique(found[different >= LEAST_VALUES]), dtype=np.uint64)


def _whole(time: IntArray, values: IntArray, words: str) -> UintArray:
    """One number for all samples."""
    with np.errstate(over="ignore"):
        total = np.add.reduce(_of_samples(time, values))
        for byte in words.encode():
            total = _mixed(np.array([total + np.uint64(byte)]))[0]
    return np.array([total], dtype=np.uint64)


def _of_samples(time: IntArray, values: IntArray) -> UintArray:
    """A number for each sample; times to the microsecond."""
    instants = (time + _MICROSECOND // 2) // _MICROSECOND
    return _mixed(instants.view(np.uint64) * _GOLDEN + _mixed(values.view(np.uint64)))


def _mixed(number: UintArray) -> UintArray:
    """SplitMix64's finaliser (Steele, Lea and Flood, 2014): every bit depends on every other."""
    number = (number ^ (number >> np.uint64(30))) * _FIRST
    number = (number ^ (number >> np.uint64(27))) * _SECOND
    return number ^ (number >> np.uint64(31))
