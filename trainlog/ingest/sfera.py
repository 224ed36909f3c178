"""Format ``sfera``: status reports of a train (SFERA, B2G_StatusReport), beside its journey.

Places are locations in segments: the journey and the segments that it names make positions of them,
so that the documents stand in one archive or file with the reports.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from operator import itemgetter
from pathlib import Path

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.railml import Element
from trainlog.formats.sfera import Documents, SferaJourney, is_sfera, journeys_of
from trainlog.ingest.profile import Profile
from trainlog.ingest.recording import Finding, Recording, Table
from trainlog.topics import SLIP_PROTECTION
from trainlog.units import KMH

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
    holds = any(name == str(path) for name, _ in documents.journeys.values())
    if path.suffix.lower() != ".zip" and not holds:
        raise InputError(
            "has no journey, which the places of reports refer to",
            file=path,
            remedy="pack the journey, its segments and the reports into one zip archive",
        )
    if not documents.reports:
        raise InputError(
            "has no status report (B2G_StatusReport)",
            file=path,
            remedy="give the reports with their journey and its segments, as one zip archive",
        )
    found = []
    for journey in journeys_of(documents):
        own = [(time, each) for time, each in documents.reports if is_of(each, journey)]
        if own:
            found.append(_recording(own, journey, documents))
    if not found:
        raise InputError(
            "holds status reports, but not the journey of their train",
            file=path,
            remedy="add its JourneyProfile and the SegmentProfiles that it names",
        )
    return found


def is_of(report: Element, journey: SferaJourney) -> bool:
    """Whether a report is of a journey's train; one that names no train is."""
    own = report.first("TrainIdentification")
    train = journey.profile.first("TrainIdentification")
    return own is None or (train is not None and _words(own) == _words(train))


def _words(element: Element) -> list[tuple[str, str]]:
    return [(each.tag, each.content.strip()) for each in element.every() if each.content.strip()]


def _recording(
    own: list[tuple[int, Element]], journey: SferaJourney, documents: Documents
) -> Recording:
    timed = sorted(((time, each.line, each) for time, each in own), key=itemgetter(0))
    tables = ReportRows(journey).take(timed)
    reports, others = [each for _, each in own], len(documents.reports) - len(own)
    unused = Counter(
        part.tag for report in reports for part in report.children if part.tag not in USED
    )
    version = journey.profile.text("JP_Version")
    stated = [each.first("JP_InUse") for each in reports]
    apart = sum(each is not None and each.text("JP_Version", version) != version for each in stated)
    unused |= Counter({"reports of other trains": others} if others else {})
    unused |= Counter({f"reports by another version than {version}": apart} if apart else {})
    placeless = int(np.isnan(tables[0].signals["/train/state.position"]).sum())
    findings = [
        Finding("damaged_messages", placeless, (), "", "reports without a place"),
        Finding("damaged_messages", documents.damaged, (), "", "reports that cannot be read"),
    ]
    metadata = {"line": journey.line.name, "journey": journey.name}
    if unused:
        metadata["not_used"] = ", ".join(f"{tag} ({count})" for tag, count in unused.items())
    return Recording(
        tuple(tables), len(reports), tuple(each for each in findings if each.count),
        metadata=metadata,
    )  # fmt: skip


class ReportRows:
    """Status reports of one train as rows: its motion, and an event where slip begins.

    Parameters
    ----------
    journey : SferaJourney
        Whose segments the reports name.
    """

    def __init__(self, journey: SferaJourney) -> None:
        self.journey = journey
        self._last, self._slipping = 0.0, 0.0

    def take(self, reports: Sequence[tuple[int, int, Element]]) -> list[Table]:
        """The rows of the next reports: motion; and events, if there are any.

        Parameters
        ----------
        reports : sequence of (time [ns], number of the row, report)
        """
        found = [self._values(each) for _, _, each in reports]
        position, speed, slips = np.array(found).reshape(-1, 3).T
        time, row = np.array([(at, number) for at, number, _ in reports], dtype=np.int64).T
        motion = {"/train/state.position": position, "/train/state.speed": speed}
        tables = [Table(time, row, motion)]
        begins = np.diff(slips, prepend=self._slipping) > 0.0
        self._slipping = float(slips[-1])
        if begins.any():
            words = np.full(int(begins.sum()), SLIP_PROTECTION, dtype=np.object_)
            said = np.full(words.size, "slip or slide reported", dtype=np.object_)
            texts = {"/events.message": said, "/events.name": words}
            tables.append(Table(time[begins], row[begins], {}, texts))
        return tables

    def _values(self, report: Element) -> tuple[float, float, float]:
        """Position [m], speed [m/s], and whether wheels slip."""
        where, position, speed = report.first("PositionSpeed"), np.nan, np.nan
        if where is not None:
            position = self.journey.position(where, self._last)
            speed = where.number("speed", np.nan) / KMH
            self._last = position if np.isfinite(position) else self._last
        return position, speed, float(report.text("slipSlideReported") in ("true", "1"))
