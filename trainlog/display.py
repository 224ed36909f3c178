"""Summaries of objects: a few lines of text for a prompt, a table and a picture for a notebook."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from datetime import UTC, datetime
from html import escape
from zoneinfo import ZoneInfo

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import BoolArray, FloatArray

WIDTH, HEIGHT = 480, 110
"""Of a picture [px]."""

COLOURS = ("#1f6f8b", "#c8553d", "#6a8d3f", "#8a6fb0")
"""Of the curves of a picture, in order."""

MOST_LINES = 10
"""Of the text of an object."""

_MOST_POINTS = 600
"""Of a curve: more than there are pixels show nothing more."""


def as_text(title: str, rows: Mapping[str, str]) -> str:
    """A title, and a line per row under it: at most ten lines.

    Examples
    --------
    >>> print(as_text("Line 'A - B'", {"length": "3.0 km", "stations": "2"}))
    Line 'A - B'
      length    3.0 km
      stations  2
    """
    width = max(map(len, rows), default=0)
    lines = [title, *(f"  {name:<{width}}  {said}".rstrip() for name, said in rows.items())]
    if len(lines) > MOST_LINES:
        lines[MOST_LINES - 1 :] = [f"  and {len(lines) - MOST_LINES + 1} more"]
    return "\n".join(lines)


def picture(
    position: ArrayLike, curves: Mapping[str, ArrayLike], *, steps: Sequence[str] = ()
) -> str:
    """Curves over position as a small SVG, each on a scale of its own.

    Parameters
    ----------
    position : (n,) array [m]
    curves : dict of str to (n,) array
        By label; not finite where there is none.
    steps : sequence of str
        Labels of the curves that hold each value up to the next position.
    """
    s = np.asarray(position, dtype=np.float64)
    drawn, labels = [], []
    for number, (label, values) in enumerate(curves.items()):
        y, colour = np.asarray(values, dtype=np.float64), COLOURS[number % len(COLOURS)]
        known = np.isfinite(y)
        if not known.any():
            continue
        low, high = float(y[known].min()), float(y[known].max())
        labels.append(
            f"<text x='4' y='{12 + 13 * number}' fill='{colour}' font-size='11'>"
            f"{escape(label)}: {low:g} to {high:g}</text>"
        )
        drawn += [
            f"<polyline points='{points}' fill='none' stroke='{colour}' stroke-width='1.2'/>"
            for points in _points(s, y, known, label in steps)
        ]
    return (
        f"<svg width='{WIDTH}' height='{HEIGHT}' xmlns='http://www.w3.org/2000/svg'"
        f" style='display:block'>{''.join(drawn)}{''.join(labels)}</svg>"
    )


def _points(s: FloatArray, y: FloatArray, known: BoolArray, steps: bool) -> list[str]:
    """Points of each part of a curve that is known without a gap."""
    low, high = y[known].min(), y[known].max()
    x = WIDTH * (s - s[0]) / max(s[-1] - s[0], 1e-9)
    down = HEIGHT - 6 - (HEIGHT - 54) * (y - low) / max(high - low, 1e-12)
    edges = np.flatnonzero(np.diff(known.astype(np.int8), prepend=0, append=0))
    found = []
    for first, last in zip(edges[::2], edges[1::2], strict=True):
        across, depth = x[first:last], down[first:last]
        if steps:
            across = np.repeat(np.append(across, x[min(last, x.size - 1)]), 2)[1:-1]
            depth = np.repeat(depth, 2)
        every = max(across.size // _MOST_POINTS, 1)
        pairs = zip(across[::every], depth[::every], strict=True)
        found.append(" ".join(f"{each:.1f},{other:.1f}" for each, other in pairs))
    return found


def at_most(share: float, digits: int = 3) -> str:
    """A bound as a percentage, rounded up: what is stated holds.

    Examples
    --------
    >>> at_most(0.000141), at_most(0.000141, 2)
    ('0.015%', '0.02%')
    """
    return f"{math.ceil(round(share * 10 ** (digits + 2), 6)) / 10 ** (digits + 2):.{digits}%}"


def counted(count: int, noun: str) -> str:
    """A number of things, in the singular or the plural.

    Examples
    --------
    >>> counted(1, "trip"), counted(2, "trip"), counted(12345, "row")
    ('1 trip', '2 trips', '12,345 rows')
    """
    return f"{count:,} {noun}{'s' * (count != 1)}"


def span(values: ArrayLike, factor: float = 1.0, digits: int = 0) -> str:
    """Least and greatest of some values, as ``60 to 125``, or the one value that they all have.

    Examples
    --------
    >>> span([20.0, 30.0], 3.6)
    '72 to 108'
    """
    known = np.asarray(values, dtype=np.float64)
    low, high = (f"{factor * each + 0.0:.{digits}f}" for each in (known.min(), known.max()))
    return low if low == high else f"{low} to {high}"


def lateness(seconds: float) -> str:
    """How long after the timetable something happens, to a hundredth of a second.

    Examples
    --------
    >>> lateness(-0.0002), lateness(0.034), lateness(-2.0)
    ('on time', '0.03 s late', '2.00 s early')
    """
    if abs(seconds) < 0.005:
        return "on time"
    return f"{abs(seconds):.2f} s {'late' if seconds > 0.0 else 'early'}"


SPEED_UNITS = {"km/h": 1.0, "m/s": 1.0 / 3.6, "mph": 1000.0 / 1609.344}
"""Units in which speeds can be shown, with what 1 km/h is in them."""

_NUMBER = r"-?\d[\d,]*(?:\.\d+)?"
_SPEEDS = re.compile(rf"(?<![\w.,])({_NUMBER})(?:( to | ± |-)({_NUMBER}))? km/h\b")
_CLOCK = r"\d{4}-\d\d-\d\d[ T]\d\d:\d\d(?::\d\d(?:\.\d+)?)?"
_TIMES = re.compile(rf"({_CLOCK})(?: to ({_CLOCK}))?(?: UTC|Z|\+00:00)\b")


def in_speed_unit(words: str, unit: str) -> str:
    """Words with the speeds in them in another unit than km/h.

    Examples
    --------
    >>> in_speed_unit("from 60 to 125 km/h, hold 80.0 km/h", "mph")
    'from 37 to 78 mph, hold 49.7 mph'
    >>> in_speed_unit("hold 80 km/h", "m/s")
    'hold 22.2 m/s'
    """
    if unit == "km/h":
        return words
    factor = SPEED_UNITS[unit]

    def shown(number: str) -> str:
        digits = len(number.partition(".")[2]) + (unit == "m/s")
        return f"{float(number.replace(',', '')) * factor:,.{digits}f}"

    def converted(found: re.Match[str]) -> str:
        first, between, second = found.groups()
        rest = f"{between}{shown(second)}" if second else ""
        return f"{shown(first)}{rest} {unit}"

    return _SPEEDS.sub(converted, words)


def in_zone(words: str, zone: str) -> str:
    """Words with the times in them, which state that they are UTC, in another zone.

    Examples
    --------
    >>> in_zone("expected at 2024-10-09 06:00 UTC", "Europe/Zurich")
    'expected at 2024-10-09 08:00 CEST'
    >>> in_zone("2024-10-08T00:00:00+00:00", "Europe/Zurich")
    '2024-10-08 02:00:00 CEST'
    """
    if zone == "UTC":
        return words
    there = ZoneInfo(zone)

    def local(time: str) -> tuple[str, str]:
        seconds, point, rest = time.replace("T", " ").partition(".")
        moment = datetime.fromisoformat(seconds).replace(tzinfo=UTC).astimezone(there)
        form = "%Y-%m-%d %H:%M:%S" if seconds.count(":") > 1 else "%Y-%m-%d %H:%M"
        return f"{moment:{form}}{point}{rest}", f"{moment:%Z}"

    def converted(found: re.Match[str]) -> str:
        first, second = found.groups()
        begin, name = local(first)
        if not second:
            return f"{begin} {name}"
        end, last = local(second)
        return f"{begin} to {end} {last}" if name == last else f"{begin} {name} to {end} {last}"

    return _TIMES.sub(converted, words)
