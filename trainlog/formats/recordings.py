"""Recordings of drives as rows of a map's file: what is kept, and checksums over it."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any, NamedTuple

from trainlog.formats.files import plain, sha256
from trainlog.formats.packed import pack
from trainlog.identity import Known, TripIdentity, identity_from_text
from trainlog.railway.evidence import DailyEvidence

_EVIDENCE = tuple(
    each.name for each in fields(DailyEvidence) if each.name not in ("bins", "levels")
)
_SORTED_BY = ("layer", "trip", "sha256", "identity")


@dataclass(frozen=True, eq=False)
class Recording:
    """A recording of a drive, as the file of a map keeps it.

    Attributes
    ----------
    layer : str
        Rail condition; where it changed on the way the one that held longest.
    entry : dict
        What the map keeps of the trip: ``trip`` (its name), ``sha256`` of its log (empty where
        there is none), ``layer``, ``software`` and what else is known.
    identity : TripIdentity or None
        Which drive it is; None: not known.
    steps : int
        Of processing since it was recorded.
    evidence : dict of str to DailyEvidence, optional
        By rail condition. None: in the sums of its layers, or, if it does not count, not kept.
    counted : bool
        Whether it counts; a fuller recording of the same drive may do in its place.
    """

    layer: str
    entry: dict[str, Any]
    identity: TripIdentity | None = None
    steps: int = 0
    evidence: dict[str, DailyEvidence] | None = None
    counted: bool = True

    @property
    def days(self) -> list[int]:
        """Days with evidence."""
        pieces = (self.evidence or {}).values()
        return sorted({day for piece in pieces for day in piece.days.tolist()})

    @property
    def trip(self) -> str:
        """Name of the trip."""
        return str(self.entry.get("trip", ""))

    @property
    def key(self) -> str:
        """What identifies the recording: SHA-256 of the log, else the drive, else the name."""
        if digest := str(self.entry.get("sha256") or ""):
            return digest
        if self.identity is not None:
            return f"drive {sha256(self.identity.text.encode())}"
        return f"trip {self.trip}"


@dataclass(frozen=True, slots=True)
class Appended:
    """What became of a recording that was given to a map.

    Attributes
    ----------
    counted : bool
    held : bool
        Whether the map held this very recording already.
    reason : str
        Why it does not count, in words.
    replaced : tuple of str
        Names of the trips that counted before, and do no more: this is a fuller recording.
    """

    counted: bool
    held: bool = False
    reason: str = ""
    replaced: tuple[str, ...] = ()


class Refusal(NamedTuple):
    """That a log could not be used, as a map's file keeps it.

    Attributes
    ----------
    sha256 : str
        Of the log.
    path : str
        Where it was.
    reason : str
        In words, with the path.
    tried : str
        What the outcome depends on besides the log: code, rail condition and weather given.
    """

    sha256: str
    path: str
    reason: str
    tried: str

    def is_repeated_by(self, other: Refusal) -> bool:
        """Whether the other states the same, of the log where it is then."""
        return self.reason.replace(self.path, "") == other.reason.replace(other.path, "")


class Row(NamedTuple):
    """A row of the table of trips, as it stands in the file."""

    key: str
    layer: str
    start: int | None
    end: int | None
    first_day: int | None
    last_day: int | None
    steps: int
    entry: str
    identity: str | None
    evidence: str | None
    counted: int

    @property
    def full(self) -> tuple[Any, ...]:
        """The columns and their digest."""
        return (*self, sealed(self))

    @property
    def days(self) -> tuple[int, int]:
        """The first and the last with evidence; (-1, -1) if there is none."""
        if self.first_day is None or self.last_day is None:
            return -1, -1
        return self.first_day, self.last_day

    @property
    def pieces(self) -> dict[str, str]:
        """Digests of the evidence by layer; none if it is in the sums."""
        found: dict[str, str] = json.loads(self.evidence) if self.evidence else {}
        return found

    @property
    def entry_whole(self) -> dict[str, Any]:
        """The entry of the trip as a map at hand has it."""
        entry: dict[str, Any] = json.loads(self.entry)
        return entry if self.identity is None else {**entry, "identity": self.identity}

    @property
    def known(self) -> Known:
        """The recording, to be compared with others of the drive."""
        entry = json.loads(self.entry)
        name, digest = str(entry.get("trip", "")), str(entry.get("sha256") or "")
        fixed = self.evidence is None
        # What is in the sums is counted for good, what was left out of them never is.
        identity = None if fixed and not self.counted else identity_from_text(self.identity or "")
        order = (self.steps, digest, name)
        return Known(name, identity, order, held=fixed and bool(self.counted), digest=digest)


def sealed(values: Sequence[Any]) -> str:
    """The checksum over the columns of a row."""
    return sha256(repr(tuple(values)).encode())[:16]


def packed_evidence(evidence: DailyEvidence) -> bytes:
    """Evidence as bytes; its digest is that of these."""
    facts = {"bins": evidence.bins, "levels": evidence.levels}
    return pack(facts, {name: getattr(evidence, name) for name in _EVIDENCE})


def row_of(recording: Recording, digests: Mapping[str, str] | None) -> Row:
    """The row of a recording; the digests of its evidence by layer, None if it is in the sums."""
    identity, days = recording.identity, recording.days
    entry = plain({name: v for name, v in recording.entry.items() if name != "identity"}, "trips")
    return Row(
        recording.key,
        recording.layer,
        None if identity is None else int(identity.start.value),
        None if identity is None else int(identity.end.value),
        days[0] if days else None,
        days[-1] if days else None,
        recording.steps,
        compact_json(entry),
        recording.entry.get("identity"),
        None if digests is None else compact_json(digests),
        int(recording.counted),
    )


def compact_json(value: Mapping[str, Any]) -> str:
    """JSON on one line, keys in order."""
    return json.dumps(value, sort_keys=True, ensure_ascii=False, separators=(",", ":"))


def place_of(entry: Mapping[str, Any]) -> tuple[str, ...]:
    """By what the trips of a map are sorted."""
    return (*(str(entry.get(name, "")) for name in _SORTED_BY), repr(sorted(entry.items())))
