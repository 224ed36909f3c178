"""Messages of SFERA 4.00 that are written: journeys with constraints, characteristics, reports.

What a document holds already stays in it: a journey, or a train's characteristics, is read, gets
what is new, and is written as its next version.
"""

from __future__ import annotations

import datetime
import hashlib
import uuid
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from xml.etree import ElementTree as Xml

from trainlog.formats.railml import Element
from trainlog.railway import RunningResistance
from trainlog.units import KMH

VERSION = "4.00"
"""Of SFERA."""

DRY = "Dry Rail"
"""The best category of rail."""

ADHESION = (
    (0.15, DRY),
    (0.12, "Dry Rail (Medium)"),
    (0.08, "Dry Rail (Low)"),
    (0.05, "Low Adhesion"),
    (0.03, "Very Low Adhesion"),
    (0.0, "Extremely Low Adhesion"),
)
"""Categories with the least adhesion of each; the lowest three by EN 15595, as far as published."""


def category_of(adhesion: float) -> str:
    """The category of rail that an adhesion belongs to.

    Examples
    --------
    >>> category_of(0.2), category_of(0.06)
    ('Dry Rail', 'Low Adhesion')
    """
    return next(name for least, name in ADHESION if adhesion >= least or not least)


@dataclass(frozen=True)
class Constraint:
    """A temporary constraint over a stretch of a journey.

    Attributes
    ----------
    begin, end : float [m]
        Along the journey.
    kind : str
        The type of the constraint, such as ``"AdvisedSpeed"``.
    attributes : mapping of str to str
        Of the element that says what is constrained.
    tag : str
        Of this element; default: the type.
    start, until : datetime, optional
        While it holds.
    """

    begin: float
    end: float
    kind: str
    attributes: Mapping[str, str] = field(default_factory=dict)
    tag: str = ""
    start: datetime.datetime | None = None
    until: datetime.datetime | None = None


def utc(time: datetime.datetime) -> str:
    """A time as SFERA has it: to the second, in UTC.

    Examples
    --------
    >>> utc(datetime.datetime(2026, 5, 17, 6, 30, tzinfo=datetime.UTC))
    '2026-05-17T06:30:00Z'
    """
    return time.astimezone(datetime.UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def xml_of(element: Element) -> bytes:
    """A document as XML, indented."""

    def made(each: Element) -> Xml.Element:
        found = Xml.Element(each.tag, each.attributes)
        found.text = each.content.strip() or None
        found.extend(made(child) for child in each.children)
        return found

    root = made(element)
    Xml.indent(root)
    body: bytes = Xml.tostring(root, "utf-8")
    return b'<?xml version="1.0" encoding="UTF-8"?>\n' + body + b"\n"


def new(
    tag: str, attributes: Mapping[str, str] | None = None, *children: Element, content: str = ""
) -> Element:
    """An element.

    Examples
    --------
    >>> xml_of(new("IM_ID", content="0099")).decode().splitlines()[1]
    '<IM_ID>0099</IM_ID>'
    """
    return Element(tag, "", dict(attributes or {}), 0, list(children), content)


@dataclass(frozen=True)
class Placed:
    """A segment of a journey: its reference, and where it lies along the journey.

    Attributes
    ----------
    reference : Element
    begin, length : float [m]
    reverse : bool
    """

    reference: Element
    begin: float
    length: float
    reverse: bool

    def location(self, position: float) -> float:
        """The location [m] in the segment of a position along the journey."""
        within = min(max(position - self.begin, 0.0), self.length)
        return round(self.length - within if self.reverse else within, 3)


def with_constraints(
    journey: Element, segments: Sequence[Placed], constraints: Iterable[Constraint], *kinds: str
) -> Element:
    """The next version of a journey, with these constraints in the place of those of some kinds.

    A constraint that reaches over several segments begins in the first and ends in the last.

    Parameters
    ----------
    journey : Element
        A JourneyProfile; it is changed.
    segments : sequence of Placed
        Of its references, in their order.
    constraints : iterable of Constraint
    *kinds : str
        Constraints of these types that the journey has are left out.
    """
    for each in segments:
        each.reference.children[:] = [
            child
            for child in each.reference.children
            if child.tag != "TemporaryConstraints"
            or child.text("temporaryConstraintType") not in kinds
        ]
    for constraint in constraints:
        times = {"startTime": constraint.start, "endTime": constraint.until}
        stated = {name: utc(time) for name, time in times.items() if time is not None}
        stated["temporaryConstraintType"] = constraint.kind
        for each, extent in _reached(constraint, segments):
            what = new(constraint.tag or constraint.kind, constraint.attributes)
            found = new("TemporaryConstraints", extent | stated, what)
            # Behind those that are there, as the schema orders the parts of a reference.
            before = ("SP_Zone", "TimingPointConstraints", "TemporaryConstraints")
            parts = each.reference.children
            at = [n for n, part in enumerate(parts, 1) if part.tag in before]
            parts.insert(max(at, default=0), found)
    version = int(journey.number("JP_Version", 0.0)) + 1
    journey.attributes["JP_Version"] = str(version)
    return journey


def _reached(
    constraint: Constraint, segments: Iterable[Placed]
) -> Iterator[tuple[Placed, dict[str, str]]]:
    """The segments that a constraint reaches, with from where to where it does in each."""
    qualifiers = {(True, True): "StartsEnds", (True, False): "Starts", (False, True): "Ends"}
    for segment in segments:
        end = segment.begin + segment.length
        if constraint.begin >= end - 1e-6 or constraint.end <= segment.begin + 1e-6:
            continue
        starts, ends = constraint.begin >= segment.begin, constraint.end <= end
        extent = {"startEndQualifier": qualifiers.get((starts, ends), "WholeSP")}
        if starts:
            extent["startLocation"] = f"{segment.location(constraint.begin):.10g}"
        if ends:
            extent["endLocation"] = f"{segment.location(constraint.end):.10g}"
        yield segment, extent


def advice_message(
    journey: Element,
    segments: Sequence[Placed],
    constraints: Iterable[Constraint],
    time: datetime.datetime,
    sender: str,
) -> Element:
    """A G2B event message with advice for a train on its way (C_DAS_C_Advice).

    Parameters
    ----------
    journey : Element
        Whose train it is.
    segments : sequence of Placed
    constraints : iterable of Constraint
        Advised speeds, in the order in which the train meets them.
    time : datetime
        Of sending.
    sender : str
        Name of the device.
    """
    train = journey.first("TrainIdentification")
    assert train is not None
    payload = new("G2B_EventPayload")
    for number, each in enumerate(constraints, 1):
        stated = {"identifier": str(number), **each.attributes}
        found = new("C_DAS_C_Advice", stated, train)
        for placed, extent in _reached(each, segments):
            own = placed.reference.attributes
            names = ("SP_ID", "SP_VersionMajor", "SP_VersionMinor", "SP_Direction")
            where = {name: own[name] for name in names if name in own}
            zone = placed.reference.all("SP_Zone")
            found.children.append(new("SegmentProfileInfo", where | extent, *zone))
        payload.children.append(found)
    header = _header(time, sender, journey, payload, from_train=False)
    return new("SFERA_G2B_EventMessage", None, header, payload)


# ----------------------------------------------------------------------------- what was learned


def with_resistance(
    characteristics: Element,
    resistance: RunningResistance,
    published: datetime.datetime | None = None,
) -> Element:
    """The next version of a train's characteristics, with what was learned of it.

    Parameters
    ----------
    characteristics : Element
        TrainCharacteristics; it is changed.
    resistance : RunningResistance
    published : datetime, optional

    Raises
    ------
    InputError
        If it has no features.
    """
    features = characteristics.first("TC_Features")
    if features is None:
        raise characteristics.error("has no TC_Features", "give the train's characteristics")
    values = (resistance.r0, resistance.r1, resistance.r2)
    for name, value in zip("ABC", values, strict=True):
        features.attributes[f"rolloutCoefficient{name}"] = f"{value:.6g}"
    minor = int(characteristics.number("TC_VersionMinor", 0.0)) + 1
    characteristics.attributes["TC_VersionMinor"] = str(minor)
    if published is not None:
        characteristics.attributes["datePublished"] = utc(published)
    return characteristics


# ------------------------------------------------------------------------------ reports of a train


@dataclass(frozen=True)
class Report:
    """What a train reports of one instant.

    Attributes
    ----------
    time : datetime
    position : float [m]
        Of its front, along the journey.
    speed : float [m/s]
    slips : bool or None
        Whether wheels slip or slide; None: not known.
    """

    time: datetime.datetime
    position: float
    speed: float
    slips: bool | None = None


def status_report(
    report: Report, segments: Sequence[Placed], journey: Element, sender: str
) -> Element:
    """A B2G event message with one status report.

    Parameters
    ----------
    report : Report
    segments : sequence of Placed
    journey : Element
        Whose train it is.
    sender : str
        Name of the device.
    """
    placed = next(
        (each for each in segments if report.position <= each.begin + each.length), segments[-1]
    )
    zone = placed.reference.first("SP_Zone")
    train = journey.first("TrainIdentification")
    assert zone is not None
    assert train is not None
    where = {
        "SP_ID": placed.reference.text("SP_ID"),
        "location": f"{placed.location(report.position):.10g}",
        "speed": f"{KMH * report.speed:.4g}",
    }
    stated = {"trainMoving": str(report.speed > 0.0).lower()}
    if report.slips is not None:
        stated["slipSlideReported"] = str(report.slips).lower()
    version = {"JP_Version": journey.text("JP_Version", "1")}
    place = new("PositionSpeed", where, zone)
    status = new("B2G_StatusReport", stated, train, place, new("JP_InUse", version))
    header = _header(report.time, sender, journey, status, from_train=True)
    return new("SFERA_B2G_EventMessage", None, header, new("B2G_EventPayload", None, status))


def _header(
    time: datetime.datetime, sender: str, journey: Element, content: Element, *, from_train: bool
) -> Element:
    """A header whose identifier follows from the time and the content."""
    digest = hashlib.sha256(utc(time).encode() + sender.encode() + xml_of(content)).digest()
    about = {
        "SFERA_version": VERSION,
        "message_ID": str(uuid.UUID(bytes=digest[:16], version=4)),
        "timestamp": utc(time),
        "sourceDevice": sender,
    }
    train = journey.first("TrainIdentification", "OTN_ID", "teltsi_Company")
    ground = journey.first("SegmentProfileReference", "SP_Zone", "IM_ID")
    names = ["0000" if each is None else each.content.strip() for each in (train, ground)]
    ends = names if from_train else names[::-1]
    parts = (
        new(tag, content=name) for tag, name in zip(("Sender", "Recipient"), ends, strict=True)
    )
    return new("MessageHeader", about, *parts)
