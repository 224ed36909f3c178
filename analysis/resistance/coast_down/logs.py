"""From recorded logs to what their coasting shows, with what it was made from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

from analysis.resistance.coast_down.motion import TOPICS
from analysis.resistance.coast_down.results import result_of
from analysis.resistance.coast_down.together import CoastDown, coast_down
from analysis.resistance.coast_down.unknown_gradient import coast_down_without_gradient
from trainlog import __version__
from trainlog.formats.files import sha256_of
from trainlog.formats.line import read_line
from trainlog.formats.parameters import CoastDownResult
from trainlog.mcap.stretches import stretches
from trainlog.trip import Trip


class CoastDowns(NamedTuple):
    """What a set of logs shows by coasting.

    Attributes
    ----------
    found : CoastDown
    result : CoastDownResult
        Ready to be written.
    """

    found: CoastDown
    result: CoastDownResult


def coast_down_logs(
    logs: Iterable[Path],
    line: Path | None = None,
    speeds: tuple[float, float] | None = None,
) -> CoastDowns:
    """Find where the trips of logs coasted, and what that shows of the running resistance.

    Parameters
    ----------
    logs : iterable of path
        Of one train. A log too long for the memory is read in stretches, each a trip of its own.
    line : path, optional
        Line file for logs that carry no line.
    speeds : (float, float) [m/s], optional
        Speeds between which the curve must be known; see `coast_down`.

    Raises
    ------
    NotIdentifiableError, InputError, LogError
        As `coast_down`, and if a file is not a log or not a line.
    """
    given = None if line is None else read_line(line)
    trips, digests = trips_of(logs)
    found = coast_down(trips, given, speeds)
    return CoastDowns(found, with_origin(result_of(found), digests, line))


def coast_down_logs_without_gradient(
    logs: Iterable[Path], line: Path | None = None
) -> CoastDownResult:
    """What logs tell by coasting where the line's gradients are not known.

    Coasting is where the recorded lever was at rest; see `coast_down_without_gradient`.

    Parameters
    ----------
    logs : iterable of path
        Of one train.
    line : path, optional
        Line file for logs that carry no line.

    Raises
    ------
    NotIdentifiableError, InputError, LogError
        As `coast_down_without_gradient`, and if a file is not a log or not a line.
    """
    given = None if line is None else read_line(line)
    trips, digests = trips_of(logs, (*TOPICS, "/train/controls"))
    return with_origin(coast_down_without_gradient(trips, given), digests, line)


def trips_of(
    logs: Iterable[Path], topics: tuple[str, ...] = TOPICS
) -> tuple[list[Trip], dict[str, str]]:
    """The trips of logs, and the SHA-256 of the log that each came from."""
    trips: list[Trip] = []
    digests: dict[str, str] = {}
    for path in logs:
        digest = sha256_of(path)
        for stretch in stretches(path, topics):
            trip = stretch.named()
            trips.append(trip)
            digests[trip.name] = digest
    return trips, digests


def with_origin(
    result: CoastDownResult, digests: dict[str, str], line: Path | None
) -> CoastDownResult:
    """The result with the files that it was made from."""
    inputs = dict(sorted(digests.items()))
    if line is not None:
        inputs["line"] = sha256_of(line)
    return replace(
        result,
        trips=[{**trip, "sha256": digests[trip["trip"]]} for trip in result.trips],
        provenance={
            "step": "coast-down",
            "software": f"trainlog {__version__}",
            "inputs": inputs,
        },
    )
