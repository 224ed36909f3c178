"""The line and the train that a trip carries with it."""

from __future__ import annotations

from trainlog.errors import LogError
from trainlog.formats.line import line_from_bytes
from trainlog.formats.train import train_from_bytes
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip


def line_of(trip: Trip) -> Line:
    """The line that the trip was driven on, as the train met it.

    A trip whose metadata say ``direction: reverse`` gets the line reversed, so that its chainage
    grows in the direction of travel.

    Raises
    ------
    LogError
        If the trip carries no line, or its direction is neither ``forward`` nor ``reverse``.
    InputError
        If the attachment is not a line file.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> line_of(read_log("sample_logs/nonstop.mcap")).name
    'CH_StGallen_Wil'
    """
    line = line_from_bytes(_attachment(trip, LINE_ATTACHMENT), file=_called(trip, LINE_ATTACHMENT))
    direction = trip.metadata.get("direction", "forward")
    if direction not in ("forward", "reverse"):
        raise LogError(
            f"trip '{trip.name}': direction is '{direction}'",
            remedy="metadata 'direction' must be 'forward' or 'reverse'",
        )
    return line.reversed() if direction == "reverse" else line


def train_of(trip: Trip) -> Train:
    """The train that made the trip, empty.

    Raises
    ------
    LogError
        If the trip carries no train.
    InputError
        If the attachment is not a train file.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> train_of(read_log("sample_logs/nonstop.mcap")).name
    'CH_Stadler_FLIRT_TPF'
    """
    data = _attachment(trip, TRAIN_ATTACHMENT)
    return train_from_bytes(data, file=_called(trip, TRAIN_ATTACHMENT))


def _attachment(trip: Trip, name: str) -> bytes:
    try:
        return trip.attachments[name]
    except KeyError:
        raise LogError(
            f"trip '{trip.name}' carries no {name}",
            remedy=f"attachments present: {', '.join(trip.attachments) or 'none'};"
            " name the line and the train when the log is made",
        ) from None


def _called(trip: Trip, name: str) -> str:
    return f"{name} of trip '{trip.name}'"
