"""SFERA 4.00 (UIC IRS 90940): journeys of driver advisory systems as line, journey and train.

A JourneyProfile names segments in the order and direction in which a train runs over them, with
times at timing points and temporary constraints; a SegmentProfile states what lies along a segment,
by location [m] from its begin; TrainCharacteristics state the train. Speeds are in km/h, gradients
in mm/m, kilometres in km, times in UTC. The documents come bare or in a message's payload, each in
a file of its own, in a folder, or in a zip archive.
"""

from __future__ import annotations

import datetime
import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import groupby, pairwise
from operator import itemgetter
from pathlib import Path
from typing import Any
from zipfile import BadZipFile, ZipFile

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.declaration import at as within_place
from trainlog.errors import InputError
from trainlog.formats.declared import built
from trainlog.formats.files import beginning, read_bytes
from trainlog.formats.railml import Element, parsed_xml
from trainlog.formats.sfera_messages import Placed
from trainlog.formats.tracks import (
    Account,
    Limit,
    LimitChoice,
    Stretch,
    TrackData,
    curvature_of,
    distinct_names,
)
from trainlog.formats.ttobench import UNPUBLISHED, assumed_axles
from trainlog.railway import (
    EffortCurve,
    Journey,
    Line,
    LineReference,
    RunningResistance,
    Station,
    TimingPoint,
    Train,
)
from trainlog.railway.line import composed
from trainlog.units import KMH

LARGEST = 2**25
"""Larger documents are refused [bytes]: a journey over a whole country has a tenth of it."""

ROOTS = re.compile(
    rb"<(SFERA_\w+|[BG]2[BG]_\w+|JourneyProfile|SegmentProfile|TrainCharacteristics)\b"
)
"""How a document of SFERA begins."""

_REPORT = re.compile(rb"<(SFERA_B2G|B2G)_")
"""How a message of a train begins."""

_OUTSIDE = "places outside of their segment"

_NO_TIMES = "journey: it has times at fewer than two timing points"

_TIMES = ("TP_latestArrivalTime", "departureTime", "earliestDepartureTime", "startTime", "endTime")
"""Times of a journey that are used."""

_SLACK = 1.0
"""A location may lie so far outside of its segment [m]: lengths are rounded."""

_JUMP = 5.0
"""Kilometres that differ by more from the way between two points [m] jump at the second."""

_HELD = {
    "SegmentProfile": {
        "SP_Zone", "SP_Points", "SP_Areas", "SP_Characteristics", "SP_ContextInformation",
    },
    "SP_Points": {"TimingPoint", "VirtualBalise"},
    "SP_Areas": {"Tunnel", "TAF_TAP_Location"},
    "SP_Characteristics": {"StaticSpeedProfile", "Gradient", "Curves"},
    "SP_ContextInformation": {"KilometreReferencePoint"},
    "SegmentProfileReference": {
        "SP_Zone", "TimingPointConstraints", "TemporaryConstraints", "TrainCharacteristicsRef",
    },
    "TC_Features": {"TractionForceCurve", "BrakingForceCurve"},
}  # fmt: skip
"""Of each element the parts that are used; others are counted as not used."""


@dataclass(frozen=True)
class SferaJourney:
    """What a journey and its segments became.

    Attributes
    ----------
    name : str
        Of the train on its day.
    line : Line
        The segments in the order and direction in which they are run over.
    journey : Journey or None
        None where the profile has times at fewer than two places.
    train : Train or None
        None where its characteristics are not given, or too few.
    left_out, assumed : list of str
        What of the documents is not used, and what they leave open, with numbers, in words.
    profile : Element
        The JourneyProfile.
    segments : tuple of Placed
        Its references, with their places along the line.
    characteristics : Element or None
        The TrainCharacteristics that it names first.
    """

    name: str
    line: Line
    journey: Journey | None
    train: Train | None
    left_out: list[str]
    assumed: list[str]
    profile: Element
    segments: tuple[Placed, ...]
    characteristics: Element | None

    def position(self, where: Element, last: float = 0.0) -> float:
        """Position [m] along the journey of an element that names segment and location.

        Of a segment that is run over several times that place which lies nearest to the `last`;
        NaN if the journey does not run over it.
        """
        name, location = _named(where)[0], where.number("location")
        found = [
            each.begin + (each.length - location if each.reverse else location)
            for each in self.segments
            if _named(each.reference)[0] == name
        ]
        return min(found, key=lambda at: abs(at - last), default=np.nan)


def is_sfera(start: bytes) -> bool:
    """Whether a file that begins so is a document of SFERA.

    Examples
    --------
    >>> is_sfera(b'<?xml version="1.0"?><JourneyProfile JP_Status="Valid">'), is_sfera(b"<railml>")
    (True, False)
    """
    return ROOTS.search(start[:4000]) is not None


def is_source(path: str | Path) -> bool:
    """Whether a file, folder or archive holds documents of SFERA.

    Examples
    --------
    >>> is_source("sample_logs/CH_StGallen_Wil.line.json")
    False
    """
    path = Path(path)
    if path.suffix.lower() == ".zip":
        return path.is_file()
    files = path.glob("*.xml") if path.is_dir() else [path]
    with suppress(OSError):
        return any(is_sfera(beginning(each)) for each in files if each.is_file())
    return False


def read_sfera(
    path: str | Path, limits: LimitChoice | None = None, electrification: str | None = None
) -> list[SferaJourney]:
    """Read the journeys of SFERA documents, each with its segments and its train.

    Parameters
    ----------
    path : str or Path
        A file, a folder, or a zip archive of XML files. Of a file alone, its folder's other
        documents are looked at, too.
    limits : LimitChoice, optional
        Which of the speed limits hold.
    electrification : str, optional
        Whose efforts the train gets, where it has several: ``"electrical"``, ``"battery"``,
        ``"diesel"`` or ``"hydrogen"``.

    Raises
    ------
    InputError
        If a document cannot be read, there is no journey, or one refers to a segment that is not
        given, or not in its version.
    """
    documents = Documents.of(path)
    if not documents.journeys:
        raise InputError(
            "has no journey (JourneyProfile)",
            file=path,
            remedy="give the journey and its segments as files of one folder or archive",
        )
    return journeys_of(documents, limits, electrification)


def read_journey(path: str | Path) -> SferaJourney:
    """The only journey of SFERA documents; parameters as `read_sfera`.

    Raises
    ------
    InputError
        As `read_sfera`, and if there are several.
    """
    found = read_sfera(path)
    if len(found) > 1:
        raise InputError(
            f"holds {len(found)} journeys",
            file=path,
            remedy="name the file of one; documents beside it are found",
        )
    return found[0]


def journeys_of(
    documents: Documents, limits: LimitChoice | None = None, electrification: str | None = None
) -> list[SferaJourney]:
    """The journeys of some documents; parameters and errors as `read_sfera`."""
    choice = limits or LimitChoice()
    return [
        built(lambda each=each: _journey(each, documents, choice, electrification), file)  # type: ignore[misc]
        for file, each in documents.journeys.values()
    ]


def documents_in(path: Path) -> Iterator[tuple[str, bytes]]:
    """The documents: a file and those beside it, all of a folder, or those of an archive."""
    if path.suffix.lower() == ".zip":
        try:
            with ZipFile(path) as archive:
                for each in archive.infolist():
                    if each.filename.lower().endswith(".xml"):
                        _check_size(each.file_size, f"{path}/{each.filename}")
                        yield f"{path}/{each.filename}", archive.read(each)
        except (BadZipFile, OSError, NotImplementedError) as error:
            raise InputError(
                f"is not a readable archive: {error}", file=path, remedy="pack it again"
            ) from error
        return
    files = sorted((path if path.is_dir() else path.parent).glob("*.xml"))
    for file in files if path.is_dir() else [path, *(other for other in files if other != path)]:
        if file.is_file():
            _check_size(file.stat().st_size, file)
        yield str(file), read_bytes(file)


def _check_size(size: int, path: str | Path) -> None:
    if size > LARGEST:
        raise InputError(
            f"has {size / 1e6:.0f} MB; documents of up to {LARGEST / 1e6:.0f} MB are read",
            file=path,
            remedy="give each journey and each segment as a document of its own",
        )


_Known = dict[str, tuple[str, Element]]
"""Documents by their version: file and element."""

_NAMES = {
    "SP": ("segment", "SP_ID", (("SP_Zone", "IM_ID"),)),
    "TC": ("train characteristics", "TC_ID", (("TC_RU_ID",), ("teltsi_KeeperShortNameVKM",))),
}
"""What segments and characteristics are called, their identifier, and whose they are."""


@dataclass
class Documents:
    """The documents that are given.

    Attributes
    ----------
    journeys : dict of str to (file, Element)
        Each train's in its newest version.
    named : dict of str to dict of str to (file, Element)
        Segments and characteristics by what errors call them, and by version.
    reports : list of (int, Element)
        Of trains; when each was sent, by the message's header [ns since 1970 UTC], NaT without.
    ignored : list of str
        Names of XML files that are no documents of SFERA.
    damaged : int
        Messages of trains that cannot be read.
    """

    journeys: dict[str, tuple[str, Element]] = field(default_factory=dict)
    named: dict[str, _Known] = field(default_factory=dict)
    reports: list[tuple[int, Element]] = field(default_factory=list)
    ignored: list[str] = field(default_factory=list)
    damaged: int = 0

    @staticmethod
    def of(path: str | Path) -> Documents:
        """The documents of a file and its folder, of a folder, or of an archive."""
        found, of = Documents(), Path(path)
        whole = of.is_dir() or of.suffix.lower() == ".zip"
        for name, data in documents_in(of):
            named = name == str(path)
            if is_sfera(data):
                try:
                    found.take(name, data, journeys=whole or named)
                except InputError:
                    # One broken report of many stops nothing; journeys and segments are needed.
                    if not _REPORT.search(data[:4000]):
                        raise
                    found.damaged += 1
            elif named:
                raise InputError(
                    "is not a document of SFERA (XML)",
                    file=path,
                    remedy="give a journey (JourneyProfile), a folder or zip archive with one",
                )
            else:
                found.ignored.append(Path(name).name)
        return found

    def take(self, file: str, data: bytes, *, journeys: bool) -> None:
        """Take what a file holds, with its journeys or without."""
        sent = int(pd.NaT.value)
        for each in parsed_xml(data, file).every():
            if each.tag == "MessageHeader":
                time = _time(each, "timestamp")
                sent = int(pd.NaT.value) if np.isnan(time) else round(1e3 * time) * 1_000_000
            elif each.tag == "B2G_StatusReport":
                self.reports.append((sent, each))
            elif each.tag == "JourneyProfile" and journeys:
                name = built(partial(_train_number, each), file)
                before = self.journeys.get(name, (file, each))[1]
                if each.number("JP_Version", 0.0) >= before.number("JP_Version", 0.0):
                    self.journeys[name] = file, each
            elif each.tag in ("SegmentProfile", "TrainCharacteristics"):
                name, version = _named(each)
                known = self.named.setdefault(name, {})
                if version in known and known[version][0] != file:
                    raise InputError(
                        f"states {name} in version {version}, as {known[version][0]} does",
                        file=file,
                        place=each.place,
                        remedy="leave one of them out",
                    )
                known[version] = file, each

    def found(self, reference: Element) -> tuple[str, Element]:
        """The document that a reference names.

        Raises
        ------
        InputError
            If it is not given, or not in its version.
        """
        name, version = _named(reference)
        known = self.named.get(name, {})
        if version in known:
            return known[version]
        if not known:
            but = f"; {', '.join(self.ignored)} holds none" if self.ignored else ""
            raise reference.error(
                f"refers to {name}, which is not given{but}", "add its document to the folder"
            )
        raise reference.error(
            f"refers to {name} in version {version}; given is version {', '.join(sorted(known))}",
            "add the document of that version",
        )


def _named(element: Element) -> tuple[str, str]:
    """What errors call the segment or the characteristics that are stated or meant; its version."""
    prefix = "TC" if element.tag.startswith("Train") else "SP"
    what, key, owners = _NAMES[prefix]
    owner = next(filter(None, (_text(element, *path) for path in owners)), "")
    version = element.text(f"{prefix}_VersionMajor"), element.text(f"{prefix}_VersionMinor", "0")
    return f"{what} '{element.text(key)}' of {owner}", ".".join(version)


def _text(element: Element, *path: str) -> str:
    found = element.first(*path)
    return "" if found is None else found.content.strip()


# ------------------------------------------------------------------------------------ the journey


def _journey(
    element: Element, documents: Documents, limits: LimitChoice, electrification: str | None
) -> SferaJourney:
    account = Account()
    _check_status(element, "JP_Status")
    name = _train_number(element)
    account.assumed["times without a zone, taken as UTC"] += sum(
        "T" in each.text(time) and re.search(r"(Z|[+-]\d\d:?\d\d)$", each.text(time)) is None
        for each in element.every()
        for time in _TIMES
    )
    references = list(element.all("SegmentProfileReference"))
    if not references:
        raise element.error("names no segment", "add a SegmentProfileReference")
    for before, each in pairwise(references):
        if _named(before)[0] == _named(each)[0] and _reverse(before) == _reverse(each):
            raise each.error(
                f"runs over segment '{each.text('SP_ID')}' twice in the same direction",
                "name each segment once, in the order in which the train runs over them",
            )
    times = _running(element)
    runs = [_Run.of(each, documents, times, account) for each in references]
    placed, at = list[tuple[float, Line]](), 0.0
    choice = limits.among([run.track for run in runs], account)
    for run in runs:
        line = run.track.line(account, choice)
        placed.append((at, line.reversed() if run.reverse else line))
        run.begin, at = at, at + line.length
    timed = runs if np.isfinite(times[0]) else []
    points = [each for run in timed for each in run.timing_points(times[0])]
    stations = _stations(runs, account)
    ends = stations[:1] + stations[-1:]
    title = " - ".join(dict.fromkeys(each.name for each in ends)) or name
    wrong, journey = _NO_TIMES if len(points) < 2 else _contradicted(points), None
    if wrong:
        account.left_out[wrong] += 1
    else:
        journey = Journey(name, title, tuple(points), f"SFERA {name}")
    line = replace(composed(title, placed, stations), source=f"SFERA {name}")
    characteristics, train = _train(references, documents, electrification, account)
    account.left_out.update(_unused(element))
    left_out = [
        what if what.startswith(("journey:", "train")) else f"{what}: {number}"
        for what, number in account.left_out.items()
        if number
    ]
    segments = tuple(
        Placed(run.reference, run.begin, run.track.length, run.reverse) for run in runs
    )
    return SferaJourney(
        name, line, journey, train, left_out, account.assumed_words(), element, segments,
        characteristics,
    )  # fmt: skip


def _contradicted(points: Sequence[TimingPoint]) -> str:
    """Where times cannot be kept, in words; empty if they can."""
    since = 0.0
    for point in points:
        since = max(since, point.earliest or since)
        if point.latest is not None and point.latest < since:
            return (
                f"journey: it asks the train to be at km {point.position / 1e3:.3f} by"
                f" {point.latest:.0f} s, and not to leave a place before until {since:.0f} s"
            )
    return ""


_TRAIN = ("Company", "OperationalTrainNumber", "Core", "Variant", "StartDate")
"""What a journey names its train by: some parts of OTN_ID, others of TAF_TAP_ID."""


def _train_number(element: Element) -> str:
    """Company, train number and day of a journey."""
    train = element.first("TrainIdentification") or element
    own = train.first("OTN_ID") or train.first("TAF_TAP_ID")
    parts = [] if own is None else [_text(own, f"teltsi_{each}") for each in _TRAIN]
    if not any(parts):
        raise element.error("does not identify its train", "add TrainIdentification with OTN_ID")
    try:
        # XML's dates may have a zone behind.
        datetime.date.fromisoformat(re.sub(r"(Z|[+-]\d\d:\d\d)$", "", parts[-1] or "2000-01-01"))
    except ValueError:
        raise element.error(
            f"teltsi_StartDate '{parts[-1]}' is not a date", "write it as 2026-05-17"
        ) from None
    return " ".join(filter(None, parts))


def _reverse(reference: Element) -> bool:
    stated = reference.text("SP_Direction", "Nominal")
    if stated not in ("Nominal", "Reverse"):
        raise reference.error(f"SP_Direction '{stated}' is unknown", "give Nominal or Reverse")
    return stated == "Reverse"


def _check_status(element: Element, name: str) -> None:
    """Refuse a document that states that it is not valid."""
    stated = element.text(name, "Valid")
    if stated in ("Invalid", "Unavailable"):
        raise element.error(f"states {name} '{stated}'", "give the version that is valid")


def _time(element: Element | None, name: str) -> float:
    """A time in seconds since 1970 UTC; NaN where there is none."""
    text = "" if element is None else element.text(name)
    if element is None or not text:
        return np.nan
    try:
        found = datetime.datetime.fromisoformat(text)
    except ValueError:
        raise element.error(
            f"{name} '{text}' is not a time", "write it as 2026-05-17T06:30:00Z"
        ) from None
    return (found if found.tzinfo else found.replace(tzinfo=datetime.UTC)).timestamp()


def _duration(element: Element, name: str) -> float:
    """A duration [s] as XML has it, such as PT1M30S; 0 where there is none."""
    text = element.text(name, "PT0S")
    with suppress(ValueError):
        if text.startswith("PT"):
            return float(pd.Timedelta(text).total_seconds())
    raise element.error(f"{name} '{text}' is not a duration", "write it as PT1M30S")


def _running(journey: Element) -> tuple[float, float]:
    """The first and the last time at a timing point [s since 1970 UTC]; NaN without any."""
    found = list[float]()
    for each in journey.all("SegmentProfileReference", "TimingPointConstraints"):
        leaves = each.first("StoppingPointDepartureDetails")
        found += [_time(each, "TP_latestArrivalTime"), _time(leaves, "departureTime")]
    stated = [each for each in found if np.isfinite(each)] or [np.nan]
    return min(stated), max(stated)


@dataclass
class _Run:
    """A segment as a journey runs over it.

    Attributes
    ----------
    reference, segment : Element
    track : TrackData
        In the segment's nominal direction.
    reverse : bool
    file : str
        Of the segment.
    begin : float [m]
        Where it begins along the journey.
    """

    reference: Element
    segment: Element
    track: TrackData
    reverse: bool
    file: str
    begin: float = 0.0

    @staticmethod
    def of(
        reference: Element, documents: Documents, times: tuple[float, float], account: Account
    ) -> _Run:
        """What a reference names, with the constraints that hold for this journey."""
        file, segment = documents.found(reference)
        track = built(lambda: _track(segment, account), file)
        run = _Run(reference, segment, track, _reverse(reference), file)
        run._restrict(times, account)
        return run

    def _restrict(self, times: tuple[float, float], account: Account) -> None:
        """Take over the speed restrictions that hold while the train runs."""
        first, last = times
        for each in self.reference.all("TemporaryConstraints"):
            kind = each.text("temporaryConstraintType")
            asked = each.first("AdditionalSpeedRestriction")
            if asked is None:
                account.left_out[f"temporary constraints ({kind or 'of no kind'})"] += 1
            elif _time(each, "startTime") > last or _time(each, "endTime") < first:
                account.left_out["speed restrictions at other times"] += 1
            else:
                begin, end = self._restricted(each, account)
                self.track.limits.append(Limit(begin, end, asked.speed("ASR_Speed")))

    def _restricted(self, constraint: Element, account: Account) -> tuple[float, float]:
        """From where to where a restriction reaches [m]; without an end, to that of the segment."""
        length = self.track.length
        with suppress(InputError):
            return _extent(constraint, length, slack=0.0)
        if constraint.text("startEndQualifier", "StartsEnds") != "StartsEnds":
            return _extent(constraint, length)
        account.assumed["speed restrictions that end with their segment, for want of an end"] += 1
        return min(max(constraint.number("startLocation", 0.0), 0.0), length), length

    def at(self, location: float) -> float:
        """Position [m] along the journey of a location in the segment."""
        return self.begin + (self.track.length - location if self.reverse else location)

    def timing_points(self, first: float) -> Iterator[TimingPoint]:
        """When the train has to be where, counted from a time [s since 1970 UTC]."""
        for each in self.reference.all("TimingPointConstraints"):
            point = self._point(each)
            place = self.at(built(partial(_place, point, self.track.length), self.file))
            leaves = each.first("StoppingPointDepartureDetails")
            arrives, window = _time(each, "TP_latestArrivalTime"), _duration(each, "arrivalWindow")
            departs, least = _time(leaves, "departureTime"), _time(leaves, "earliestDepartureTime")
            stops = each.text("TP_StopSkipPass", "Passing_Point") == "Stopping_Point"
            stands = {"lowest_speed": 0.0, "highest_speed": 0.0} if stops else {}
            if np.isfinite(arrives):
                # The window is what it may be earlier; without one no time is too early.
                earliest = arrives - window - first if window else None
                yield TimingPoint(place, earliest, arrives - first, **stands)
            if np.isfinite(departs):
                latest = None if np.isfinite(arrives) else departs - first
                leave = departs if np.isnan(least) else least
                yield TimingPoint(place, leave - first, latest, **stands)

    def _point(self, constraints: Element) -> Element:
        """The timing point that constraints refer to."""
        for reference, tag, key in (
            ("TP_ID_Reference", (), "TP_ID"),
            ("TimingPointZoneReference", ("TimingPointZone",), "identifier"),
        ):
            named = constraints.first("TimingPointReference", reference)
            if named is None:
                continue
            for each in self.segment.all("SP_Points", "TimingPoint"):
                if any(own.text(key) == named.text(key) for own in each.all(*tag)):
                    return each
            raise constraints.error(
                f"refers to the timing point '{named.text(key)}', which segment"
                f" '{self.segment.text('SP_ID')}' does not have",
                "correct the reference, or add the point",
            )
        raise constraints.error("refers to no timing point", "add TimingPointReference")


def _stations(runs: Iterable[_Run], account: Account) -> list[Station]:
    """The timing points by their places' names, and the places that have none, in their order."""
    points, places = list[Station](), list[Station]()
    for run in runs:
        length, names = run.track.length, dict[str, str]()
        for each in run.segment.all("SP_Areas", "TAF_TAP_Location"):
            own = each.first("TAF_TAP_LocationIdent") or each
            spoken = each.first("TAF_TAP_LocationName")
            name = _text(own, "teltsi_PrimaryLocationName")
            names[_text(own, "teltsi_LocationPrimaryCode")] = name
            name = name or (
                each.text("TAF_TAP_location_abbreviation")
                if spoken is None
                else spoken.text("text")
            )
            try:
                middle = 0.5 * sum(_extent(each, length))
            except InputError:
                account.left_out[_OUTSIDE] += 1
            else:
                places += [Station(name, run.at(middle))] if name else []
        for each in run.segment.all("SP_Points", "TimingPoint"):
            code = _text(each, "TAF_TAP_LocationReference", "teltsi_LocationPrimaryCode")
            stated = each.first("TP_Name")
            name = names.get(code) or ("" if stated is None else stated.text("name"))
            location = each.number("location")
            if -_SLACK <= location <= length + _SLACK:
                points.append(Station(name or each.text("TP_ID"), run.at(_place(each, length))))
            else:
                account.left_out[_OUTSIDE] += 1
    known = {each.name for each in points}
    every = [*points, *(each for each in places if each.name not in known)]
    every.sort(key=lambda each: each.position)
    once = [row[0] for row in (list(group) for _, group in groupby(every, lambda each: each.name))]
    names_of = distinct_names((each.name, f"{number + 1}") for number, each in enumerate(once))
    return [replace(each, name=name) for each, name in zip(once, names_of, strict=True)]


# ------------------------------------------------------------------------------------ the segments


def _place(element: Element, length: float, name: str = "location", slack: float = _SLACK) -> float:
    """A location [m] in a segment.

    Raises
    ------
    InputError
        If it lies outside.
    """
    found = element.number(name)
    if not -slack <= found <= length + slack:
        raise element.error(
            f"{name} {found:g} m is not in its segment of {length:g} m", "correct the location"
        )
    return min(max(found, 0.0), length)


def _extent(element: Element, length: float, slack: float = _SLACK) -> tuple[float, float]:
    """From where to where an area or constraint reaches [m]."""
    qualifier, ends = element.text("startEndQualifier", "StartsEnds"), [0.0, length]
    for number, (word, name) in enumerate((("Starts", "startLocation"), ("Ends", "endLocation"))):
        if word in qualifier:
            ends[number] = _place(element, length, name, slack)
    return min(ends), max(ends)


def _pieces(
    holder: Element | None, length: float, tag: str
) -> Iterator[tuple[float, float, Element]]:
    """What holds piece by piece: from the begin of a segment, and from each change on."""
    if holder is None:
        return
    changes = ((_place(each, length), each) for each in holder.all(f"{tag}Change"))
    rows = [(0.0, each) for each in holder.all(f"{tag}Start")]
    rows += sorted(changes, key=itemgetter(0))
    for (at, each), (end, _) in pairwise([*rows, (length, holder)]):
        if end > at:
            yield at, end, each


def _gradient(element: Element) -> float:
    """Rise over run; falls are negative."""
    sign = {"Uphill": 1.0, "Downhill": -1.0}.get(element.text("gradientDirection"), 0.0)
    value = element.number("gradientValue")
    if not sign and value:
        raise element.error("has no gradientDirection", "give Uphill or Downhill")
    return sign * value / 1e3


def _curve(element: Element) -> float:
    """Curvature [1/m]; bends to the left are negative."""
    sign = -1.0 if element.text("curveDirection") == "Left" else 1.0
    return sign * curvature_of(element.number("curveRadius"))


def _track(segment: Element, account: Account) -> TrackData:
    """What lies along a segment."""
    _check_status(segment, "SP_Status")
    length = segment.number("SP_Length")
    if length <= 0.0:
        raise segment.error(f"SP_Length {length:g} m is not positive", "give the segment's length")
    held = segment.first("SP_Characteristics") or Element("", "", {}, segment.line)
    track = TrackData(segment.text("SP_Name") or segment.text("SP_ID"), length)
    for into, within, tag, value in (
        (track.gradients, "Gradient", "Gradient", _gradient),
        (track.curves, "Curves", "Curve", _curve),
    ):
        pieces = _pieces(held.first(within), length, tag)
        into += [Stretch(at, end, value(each)) for at, end, each in pieces]
    sides = [e for e in held.all("Curves") for e in e.children if e.number("curveRadius")]
    account.assumed["curves whose direction is not stated, taken to bend to the right"] += sum(
        each.text("curveDirection", "Unknown") == "Unknown" for each in sides
    )
    for profile in held.all("StaticSpeedProfile"):
        track.limits += _limits(profile, length, account)
    for each in segment.all("SP_Areas", "Tunnel"):
        track.tunnels.append(Stretch(*_extent(each, length), each.number("tunnelFactor", np.nan)))
    for each in segment.all("SP_Points", "VirtualBalise"):
        own = each.first("VirtualBalisePosition")
        if own is not None:
            track.course.append(
                (_place(each, length), own.number("latitude"), own.number("longitude"))
            )
    track.course_quality = "positions of virtual balises, SFERA"
    track.reference = _reference(segment, length, account)
    account.left_out.update(_unused(segment))
    return track


def _limits(profile: Element, length: float, account: Account) -> Iterator[Limit]:
    """The speed limits of a profile: for all trains, and by the categories that it states."""
    for begin, end, each in _pieces(profile, length, "StaticSpeedProfile"):
        base = each.number("SSP_Speed", np.nan)
        if base <= 0.0:
            raise each.error(
                "SSP_Speed 0 km/h lets no train run", "give the limit, or leave it out"
            )
        if base > 0.0:
            yield Limit(begin, end, base / KMH)
        for other in each.all("SpecificSSP"):
            kind = other.first("OtherSpecificSSP") or other.first("CantDeficiencySSP")
            names = ("trainCategoryCode", "SSP_NC_DIFF", "SSP_NC_CDDIFF")
            name = next((kind.text(n) for n in names if kind.text(n)), "") if kind else ""
            speed = base + other.number("V_DIFF", 0.0)
            if name and speed > 0.0:
                yield Limit(begin, end, speed / KMH, category=name)
            else:
                account.left_out["speed limits without a category or a speed"] += 1


def _reference(segment: Element, length: float, account: Account) -> LineReference | None:
    """How the kilometres run along a segment; None with fewer than two points."""
    every = list(segment.all("SP_ContextInformation", "KilometreReferencePoint"))
    within = [each for each in every if 0.0 <= each.number("location") <= length + _SLACK]
    account.left_out["kilometres beyond the end of their segment"] += len(every) - len(within)
    rows = sorted(
        (_place(each, length), 1e3 * stone.number("kmRef"))
        for each in within
        for stone in each.all("KM_Reference")
    )
    rows = [row for number, row in enumerate(rows) if not number or row[0] > rows[number - 1][0]]
    if len(rows) < 2:
        return None
    at, km = np.array(rows).T
    way, counted = np.diff(at), np.diff(km)
    rising = float(np.sign(np.median(counted))) or 1.0
    whole = np.abs(counted - rising * way) <= _JUMP + 0.02 * way
    end = np.where(whole, km[1:], km[:-1] + rising * way)
    # Before the first and behind the last stone they go on.
    start = np.concatenate(([km[0] - rising * at[0]], km[:-1], [km[-1]]))
    ends = np.concatenate(([km[0]], end, [km[-1] + rising * (length - at[-1])]))
    begin = np.concatenate(([0.0], at))
    kept = np.diff(np.append(begin, length)) > 0.0
    own = segment.first(
        "SP_ContextInformation", "LineAndTrackIdentifier", "LineAndTrackIdentifierStart"
    )
    name = (own.text("lineIdentifier") if own is not None else "") or segment.text("SP_ID")
    return LineReference(name, begin[kept], start[kept], ends[kept])


def _unused(document: Element) -> Counter[str]:
    """How many of the parts of a document are not used, by name."""
    return Counter(
        part.tag
        for each in document.every()
        for part in each.children
        if part.tag not in _HELD.get(each.tag, (part.tag,))
    )


# --------------------------------------------------------------------------------------- the train

ROTATING, BRAKING = 0.08, 0.6
"""Assumed of a train whose characteristics do not state it: rotating part of the mass, and the
deceleration [m/s²] of its friction brake."""


FEATURES = {
    "mass": ("trainWeight", 1e3, "weight"),
    "length": ("trainLength", 1.0, ""),
    "max_speed": ("trainMaxSpeed", 1.0 / KMH, "largest speed"),
    "r0": ("rolloutCoefficientA", 1.0, "rollout coefficient A"),
    "r1": ("rolloutCoefficientB", 1.0, ""),
    "r2": ("rolloutCoefficientC", 1.0, "rollout coefficient C"),
    "rotating_mass_factor": ("rotatingMassFactor", 1.0, ""),
    "max_acceleration": ("comfortableAcceleration", 1.0, ""),
    "max_deceleration": ("comfortableBraking", 1.0, ""),
}
"""Of a train's features the attribute, its unit [SI], and what errors call it if it is needed."""


def _train(
    references: Sequence[Element],
    documents: Documents,
    electrification: str | None,
    account: Account,
) -> tuple[Element | None, Train | None]:
    """The characteristics that a journey names, and the train; None where they are too few."""
    named = [each for reference in references for each in reference.all("TrainCharacteristicsRef")]
    if not named:
        account.left_out["train: the journey names no characteristics"] += 1
        return None, None
    account.left_out["changes of the train on the way"] += len({_named(e) for e in named}) - 1
    file, element = documents.found(named[0])
    return element, built(lambda: _train_of(element, named[0], electrification, account), file)


def _train_of(
    element: Element, reference: Element, electrification: str | None, account: Account
) -> Train | None:
    features = element.first("TC_Features")
    if features is None:
        account.left_out[f"train '{element.text('TC_ID')}': it has no characteristics"] += 1
        return None
    name = features.text("displayName") or element.text("TC_ID")
    account.left_out.update(_unused(features))
    curve = _curve_of(features, "TractionForceCurve", "tractionForce", electrification, account)
    stated = {
        own: unit * features.number(key, reference.number(key, np.nan))
        for own, (key, unit, _) in FEATURES.items()
    }
    stated["mass"] = stated["mass"] if stated["mass"] > 0.0 else np.nan
    missing = [words for own, (_, _, words) in FEATURES.items() if words and np.isnan(stated[own])]
    missing += ["traction force curve"] if curve is None else []
    if missing or curve is None:
        account.left_out[f"train '{name}': its characteristics lack {', '.join(missing)}"] += 1
        return None
    r0, r1, r2 = (stated.pop(each) for each in ("r0", "r1", "r2"))
    # Factors of a mass are stated as 1.08, and as 0.08 by some.
    stated["rotating_mass_factor"] -= float(stated["rotating_mass_factor"] >= 1.0)
    zero = {"rotating_mass_factor": -1e-9}
    lacking = [each for each, value in stated.items() if not value > zero.get(each, 0.0)]
    given: dict[str, Any] = {each: stated[each] for each in stated if each not in lacking}
    if "rotating_mass_factor" in lacking:
        given["rotating_mass_factor"] = ROTATING
        account.assumed[f"rotating mass of {ROTATING:.0%} of the train's"] += 1
    assumed = [*UNPUBLISHED, "max_load", "axles", "brake", *(e for e in lacking if e != "length")]
    effort = float(curve.efforts.max())
    dynamic = _curve_of(features, "BrakingForceCurve", "maximumRegenerativeForce", None, account)
    if dynamic is not None:
        given |= {
            "max_dynamic_braking_effort": float(dynamic.efforts.max()),
            "max_dynamic_braking_power": dynamic.peak_power,
            "dynamic_braking_curve": dynamic,
        }
        assumed = [each for each in assumed if not each.startswith("max_dynamic_braking")]
    mass, rotating = given["mass"], given["rotating_mass_factor"]
    return Train(
        name=name,
        source=f"SFERA {element.text('TC_ID')} {_named(element)[1]}",
        resistance=RunningResistance(r0, 0.0 if np.isnan(r1) else r1, r2),
        max_tractive_effort=effort,
        max_traction_power=curve.peak_power,
        max_pneumatic_braking_effort=given.get("max_deceleration", BRAKING)
        * mass
        * (1.0 + rotating),
        axles=assumed_axles(mass, effort, rotating),
        traction_curve=curve,
        assumed=tuple(assumed),
        **given,
    )


def _curve_of(
    features: Element, tag: str, force: str, electrification: str | None, account: Account
) -> EffortCurve | None:
    """Effort over speed: of several curves that of an electrification, else the first."""
    every = [each for each in features.all(tag) if any(p.text(force) for p in each.children)]
    if electrification is not None:
        chosen = [e for e in every if electrification.capitalize() in _kinds(e)]
        if every and not chosen:
            known = ", ".join(sorted({kind.lower() for e in every for kind in _kinds(e)}))
            raise features.error(
                f"has no traction force curve for '{electrification}'",
                f"choose one of {known or 'none'}",
            )
        every = chosen
    if not every:
        return None
    account.left_out[f"further curves ({tag})"] += len(every) - 1
    rows = sorted(
        (point.number("speed") / KMH, point.number(force))
        for point in every[0].all(f"{tag}DataPoint")
        if point.text(force)
    )
    with within_place(every[0].place):
        return EffortCurve(*np.array(rows, dtype=np.float64).reshape(-1, 2).T)


def _kinds(curve: Element) -> set[str]:
    """The kinds of traction that a curve holds for."""
    return {
        kind.tag
        for each in curve.children
        if each.tag.endswith("TractionType")
        for kind in each.children
    }


# -------------------------------------------------------------------- what a line of ours has more

_APART = 0.05
"""Part by which two ways between the same places may differ, and 100 m besides."""


def filled(line: Line, own: Line) -> tuple[Line, list[str]]:
    """The line with the gradients, curves and tunnels of a line of one's own, where it has none.

    Places are the same by the operator's kilometre where both lines have it, else by the names of
    their stations.

    Parameters
    ----------
    line : Line
        As a journey gives it.
    own : Line
        In either direction.

    Returns
    -------
    line : Line
    said : list of str
        Which part of it came from where.

    Raises
    ------
    InputError
        If the two have no two places in common.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> own = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> level = own.gradients.with_rows(*np.zeros((3, 1)))
    >>> plain = replace(own, gradients=level, assumed=("gradients",))
    >>> again, said = filled(plain, own)
    >>> again.gradients == own.gradients, said[0]
    (True, "gradients from line 'CH_StGallen_Wil', km 0.000 to km 29.556")
    """
    source, at, there, by, _ = _matched(line, own)
    begin, end = float(at[0]), float(at[-1])
    changes: dict[str, Any] = {}
    wanted = {"gradients": "gradients" in line.assumed, "curvatures": line.curvatures is None}
    for name, lacks in wanted.items():
        if lacks and (held := getattr(source, name)) is not None:
            changes[name] = _carried(held, source.length, at, there, line.length)
    if not line.tunnels:
        inside = [
            each for each in source.tunnels
            if there[0] <= each.position and each.position + each.length <= there[-1]
        ]  # fmt: skip
        changes["tunnels"] = tuple(
            replace(each, position=float(np.interp(each.position, there, at))) for each in inside
        )
    whole = begin <= _SLACK and end >= line.length - _SLACK
    assumed = [
        e for e in line.assumed if e != "gradients" or not whole or "gradients" in own.assumed
    ]
    words = {"gradients": "gradients", "curvatures": "curves", "tunnels": "tunnels"}
    said = [
        f"{words[name]} from line '{own.name}', km {begin / 1e3:.3f} to km {end / 1e3:.3f}"
        for name, value in changes.items()
        if value
    ]
    if not whole:
        said.append("level and straight elsewhere")
    return replace(line, assumed=tuple(assumed), **changes), [*said, f"places by {by}"]


def places_along(line: Line, own: Line) -> Callable[[FloatArray], FloatArray]:
    """The positions [m] along a line of positions on another one, in either direction.

    The answer is NaN for what lies beside the line.

    Parameters
    ----------
    line, own : Line
        With the operator's kilometres, or stations, in common.

    Raises
    ------
    InputError
        If the two have no two places in common.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> own = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> places_along(own.reversed(), own)(np.array([0.0, own.length])).round(3).tolist()
    [29556.1, 0.0]
    """
    _, at, there, _, backwards = _matched(line, own)

    def along(position: FloatArray) -> FloatArray:
        place = own.length - position if backwards else np.asarray(position)
        return np.interp(place, there, at, left=np.nan, right=np.nan)

    return along


def _matched(line: Line, own: Line) -> tuple[Line, FloatArray, FloatArray, str, bool]:
    """A line of one's own in the direction of another, places on both, how, and whether reversed.

    Raises
    ------
    InputError
        If the two have no two places in common.
    """
    ways = [(each, *_common(line, each), each is not own) for each in (own, own.reversed())]
    found = max(ways, key=lambda way: way[1].size)
    if found[1].size < 2:
        raise InputError(
            f"line '{own.name}' and the journey have no two places in common",
            remedy="give a line with the same stations, or the same operator's kilometres",
        )
    return found


def _common(line: Line, own: Line) -> tuple[FloatArray, FloatArray, str]:
    """Positions [m] of the same places on two lines, increasing on both."""
    if line.reference is not None and own.reference is not None:
        at = np.unique([0.0, *line.reference.positions, line.length])
        here = line.reference.at(at, line.length)
        grid = np.unique([*np.arange(0.0, own.length, 10.0), own.length])
        km = own.reference.at(grid, own.length)
        if np.all(np.diff(km) > 0.0) or np.all(np.diff(km) < 0.0):
            order = np.argsort(km)
            within = (here >= km.min()) & (here <= km.max())
            there = np.interp(here, km[order], grid[order])
            at, there = _increasing(at[within], there[within])
            if at.size > 1:
                return at, there, "the operator's kilometre"
    named = {each.name: each.position for each in own.stations}
    both = [(each.position, named[each.name]) for each in line.stations if each.name in named]
    at, there = np.array(both, dtype=np.float64).reshape(-1, 2).T
    return *_increasing(at, there), "the names of stations"


def _increasing(at: FloatArray, there: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Those places that follow each other on both lines, about as far apart."""
    kept = [0] if at.size else []
    for number in range(1, at.size):
        way, other = at[number] - at[kept[-1]], there[number] - there[kept[-1]]
        if other > 0.0 and abs(way - other) <= _APART * way + 100.0:
            kept.append(number)
    return at[kept], there[kept]


def _carried(profile: Any, length: float, at: FloatArray, there: FloatArray, whole: float) -> Any:
    """A profile of one line, laid along another between the places they have in common."""
    part = profile.between(float(there[0]), float(there[-1]), length)
    inner = np.interp(part.positions + there[0], there, at)
    rows = [(float(x), a, b) for x, a, b in zip(inner, part.start, part.end, strict=True)]
    if at[0] > 0.0:
        rows.insert(0, (0.0, 0.0, 0.0))
    if at[-1] < whole - _SLACK:
        rows.append((float(at[-1]), 0.0, 0.0))
    positions, start, end = (np.array(each, dtype=np.float64) for each in zip(*rows, strict=True))
    # Of a part that begins on the first place the first row stands at 0.
    positions[0] = 0.0
    return profile.with_rows(positions, start, end)
