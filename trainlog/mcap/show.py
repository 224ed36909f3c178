"""A log's description as a person reads it, for the command line."""

from __future__ import annotations

import math
import re

import pandas as pd
from rich import box
from rich.console import Group, RenderableType
from rich.table import Table
from rich.text import Text

from trainlog.mcap.account import Account, counted
from trainlog.mcap.description import LogDescription, TopicDescription
from trainlog.topics import EVENTS, TOPICS

_LONGEST = 160
"""Metadata values are cut to this many characters."""


def render(description: LogDescription) -> RenderableType:
    """What is in a log, as something that rich prints."""
    parts: list[RenderableType] = [_overview(description), _topics(description)]
    if any(topic.units for topic in description.topics):
        parts.append(_fields(description))
    if description.metadata:
        parts.append(_pairs("Metadata", description.metadata))
    if description.provenance:
        steps = {
            f"{number} {step.get('step', '')}".strip(): ", ".join(
                f"{key} {_in_words(value)}" for key, value in step.items() if key != "step"
            )
            for number, step in enumerate(description.provenance, start=1)
        }
        parts.append(_pairs("Provenance", steps))
    if description.attachments:
        parts.append(_attachments(description))
    return Group(Text(str(description.path), style="bold"), *parts)


def _overview(description: LogDescription) -> Table:
    table = Table.grid(padding=(0, 2))
    table.add_column(style="dim")
    table.add_column(overflow="fold")
    first, last = description.first, description.last
    if first is not None and last is not None:
        duration = _duration((last - first).total_seconds())
        table.add_row("time", f"{_time(first)} to {_time(last)} UTC ({duration})")
    if description.position_span is not None:
        start, end = description.position_span
        shown = [round(position / 1e3, 3) + 0.0 for position in (start, end)]  # no -0.000
        table.add_row(
            "position", f"km {shown[0]:.3f} to km {shown[1]:.3f} ({(end - start) / 1e3:.3f} km)"
        )
    table.add_row("messages", f"{description.count:,} in {_chunks(description)}")
    table.add_row("file", _size(description.size))
    if description.schema_version is not None:
        table.add_row("topics", f"version {description.schema_version} of the table of topics")
    table.add_row("state", _state(description.account))
    if description.problem is not None and (
        description.complete or not description.account.only_unclosed
    ):
        table.add_row("problem", _plain(description.problem))
    return table


def _state(account: Account) -> str:
    if account.whole:
        return "ends properly"
    if account.only_unclosed:
        return account.sentence
    return "damaged, only what is readable is listed"


def _chunks(description: LogDescription) -> str:
    kinds = " and ".join(kind or "no" for kind in description.compression) or "no"
    size = f"{_size(description.stored_size)} with {kinds} compression"
    chunks = counted(description.chunks, "chunk")
    return f"{chunks}, {size} ({_size(description.content_size)} without)"


def _topics(description: LogDescription) -> Table:
    table = Table("Topic", "Message", box=box.SIMPLE_HEAD, pad_edge=False)
    for heading in ("Count", "Rate", "From", "To", "Gaps", "Longest"):
        table.add_column(heading, justify="right")
    for topic in description.topics:
        table.add_row(
            _plain(topic.name),
            _plain(topic.message or topic.encoding),
            f"{topic.count:,}",
            _number(topic.rate, "Hz"),
            _time_of_day(topic.first),
            _time_of_day(topic.last),
            # Events come as they come: there is no interval that could be missed.
            "" if topic.message == EVENTS.message else f"{topic.gaps:,}",
            _number(topic.largest_gap, "s"),
        )
    return table


def _fields(description: LogDescription) -> Table:
    table = Table("Topic", "Fields and units", box=box.SIMPLE_HEAD, pad_edge=False)
    for topic in description.topics:
        if topic.units:
            fields = ", ".join(_field(topic, name) for name in topic.units)
            table.add_row(_plain(topic.name), _plain(fields))
    return table


def _field(topic: TopicDescription, name: str) -> str:
    unit = topic.units[name]
    shown = name if unit in ("", "1") else f"{name} [{unit}]"
    if name not in topic.axles:
        return shown
    known = TOPICS.get(topic.name)
    each = {field.name: field.each for field in known.fields} if known else {}
    return f"{shown} of {counted(topic.axles[name], each.get(name, 'axle').split()[-1])}"


def _pairs(heading: str, pairs: dict[str, str]) -> Table:
    table = Table(heading, "", box=box.SIMPLE_HEAD, pad_edge=False)
    for key, value in pairs.items():
        shown = value if len(value) <= _LONGEST else f"{value[:_LONGEST]} …"
        table.add_row(_plain(key), _plain(shown))
    return table


def _in_words(value: object) -> str:
    """A value of provenance in words, checksums shortened to their first digits."""
    if isinstance(value, dict):
        return ", ".join(f"{key} {_in_words(each)}" for key, each in value.items())
    text = str(value)
    return f"{text[:12]}…" if re.fullmatch("[0-9a-f]{64}", text) else text


def _attachments(description: LogDescription) -> Table:
    table = Table("Attachment", box=box.SIMPLE_HEAD, pad_edge=False)
    table.add_column("Size", justify="right")
    table.add_column("SHA-256")
    for attachment in description.attachments:
        table.add_row(_plain(attachment.name), _size(attachment.size), attachment.sha256)
    return table


def _plain(text: str) -> Text:
    """Text from a file, which is neither markup nor allowed to steer the terminal."""
    return Text("".join(letter if letter.isprintable() else " " for letter in text))


def _time(time: pd.Timestamp) -> str:
    return f"{time:%Y-%m-%d %H:%M:%S}.{time.microsecond // 1000:03d}"


def _time_of_day(time: pd.Timestamp | None) -> str:
    return "" if time is None else f"{time:%H:%M:%S}"


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds, 1), 60)
    return f"{minutes:.0f} min {rest:.1f} s" if minutes else f"{rest:.1f} s"


def _number(value: float, unit: str) -> str:
    return "" if math.isnan(value) else f"{value:.3g} {unit}"


def _size(size: int) -> str:
    if size < 10_000:
        return f"{size:,} B"
    return f"{size / 1e6:.1f} MB" if size >= 1e6 else f"{size / 1e3:.0f} kB"
