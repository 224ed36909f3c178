"""Format ``sfera``: status reports of a train (SFERA, B2G_StatusReport), beside its journey.

Places are locations in segments: the journey and the segments that it names make positions of them,
so that the documents stand in one archive or file with the reports.
"""

from __future__ import annotations

import datetime
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.railml import Element
from trainlog.formats.sfera import Documents, SferaJourney, is_sfera, journeys_of
from trainlog.ingest.profile import Profile
from trainlog.ingest.recording import NO_TIME, Finding, Recording, Table
from trainlog.topics import SLIP_PROTECTION
from trainlog.units import KMH, NANOSECONDS

USED = {"TrainIdentification", "PositionSpeed", "JP_InUse"}
"""Parts of a report that are used; others are counted."""


def is_reports(head: bytes) -> bool:
    """Whether a file that begins so may hold status reports: XML of SFERA, or an archive of XML.

    Examples
    --------
    >>> is_reports(b"<SFERA_B2G_EventMessage>"), is_reports(b"<gpx>")
    (True, False)
    """
    archive = head.startswith(b"PK\x03\x04") and b".xml" in head[30:286].lower()
    return archive or (head.lstrip()[:1] == b"<" and is_sfera(head))


def read_reports(path: Path, profile: Profile | None = None) -> list[Recording]:  # noqa: ARG001
    """The recordings of an archive's trains: one a journey with status reports.

    Raises
    ------
    InputError
        If there is no report, or none of the journeys knows where one was.
    """
    documents = Documents.of(path)
    reports = [each for each in documents.messages if each.tag == "B2G_StatusReport"]
    if not reports:
        raise InputError(
            "holds no status report (B2G_StatusReport)",
            file=path,
            remedy="give the reports with their journey and its segments, as one zip archive",
        )
    found = []
    for journey in journeys_of(documents):
        own = [each for each in reports if _is_of(each, journey, documents)]
        if own:
            found.append(_recording(own, journey, documents))
    if not found:
        raise InputError(
            "holds status reports, but not the journey of their train",
            file=path,
            remedy="add its JourneyProfile and the SegmentProfiles that it names",
        )
    return found


def _is_of(report: Element, journey: SferaJourney, documents: Documents) -> bool:
    """Whether a report is of a journey's train; one that names none is of the only journey."""
    own = report.first("TrainIdentification")
    if own is None:
        return len(documents.journeys) == 1
    train = journey.profile.first("TrainIdentification")
    return train is not None and _words(own) == _words(train)


def _words(element: Element) -> list[tuple[str, str]]:
    return [(each.tag, each.content.strip()) for each in element.every() if each.content.strip()]


def _recording(reports: list[Element], journey: SferaJourney, documents: Documents) -> Recording:
    rows = list(_rows(reports, journey, documents))
    time, row, position, speed, margin, slips = (np.array(each) for each in zip(*rows, strict=True))
    order = np.argsort(time, kind="stable")
    known = np.isfinite(slips[order])
    begins = np.diff(np.where(known, slips[order], 0.0), prepend=0.0) > 0.0
    state = Table(
        time[order],
        row[order],
        {"/train/state.position": position[order], "/train/state.speed": speed[order]},
    )
    tables = [state]
    if begins.any():
        at = order[begins]
        words = np.full(at.size, SLIP_PROTECTION, dtype=np.object_)
        said = np.full(at.size, "slip or slide reported", dtype=np.object_)
        texts = {"/events.message": said, "/events.name": words}
        tables.append(Table(time[at], row[at], {}, texts))
    unused = Counter(
        part.tag for report in reports for part in report.children if part.tag not in USED
    )
    placeless = int(np.count_nonzero(~np.isfinite(position)))
    findings = [Finding("damaged_messages", placeless, (), "", "reports without a place")]
    metadata = {"line": journey.line.name, "journey": journey.name}
    if np.isfinite(margin).any():
        metadata["position_margin"] = f"{np.nanmedian(margin):.3g} m"
    if unused:
        metadata["not_used"] = ", ".join(f"{tag} ({count})" for tag, count in unused.items())
    return Recording(
        tuple(tables), len(reports), tuple(each for each in findings if each.count),
        metadata=metadata,
    )  # fmt: skip


def _rows(
    reports: list[Element], journey: SferaJourney, documents: Documents
) -> Iterator[tuple[int, int, float, float, float, float]]:
    """Time [ns], row, position [m], speed [m/s], margin [m] and slip (0, 1, NaN) of each report."""
    last = 0.0
    for report in reports:
        stated = documents.times.get(id(report))
        time = NO_TIME
        if stated is not None:
            since = stated - datetime.datetime(1970, 1, 1, tzinfo=datetime.UTC)
            time = (since.days * 86_400 + since.seconds) * NANOSECONDS
        where = report.first("PositionSpeed")
        position = speed = margin = np.nan
        if where is not None:
            position = journey.position(where, last)
            speed = where.number("speed", np.nan) / KMH
            ahead, behind = (
                where.number(f"location_{sign}ErrorMargin", np.nan)
                for sign in ("Positive", "Negative")
            )
            margin = max(ahead, behind)
            last = position if np.isfinite(position) else last
        slips = {"true": 1.0, "1": 1.0, "false": 0.0, "0": 0.0}
        yield (
            time, report.line, position, speed, margin,
            slips.get(report.text("slipSlideReported"), np.nan),
        )  # fmt: skip
