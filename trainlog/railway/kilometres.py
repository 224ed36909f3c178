"""Kilometres as people read and type them: the operator's, or the chainage of a line without.

Positions are chainage in metres everywhere else. Whatever shows a place in km or reads one goes
through here, so that the same place has the same number in tables, in pictures and on the command
line.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.line import Line

ROUNDING = 1.0
"""How far [m] behind the ends of its pieces a line still has a kilometre: those shown are rounded
to a metre."""

AT_STATION = 100.0
"""What is nearer to a station lies at it [m]."""

STATION_REACH = 200.0
"""A train that stands so near to a station's chainage [m] has stopped there."""

STEPS = (1.0, 2.0, 5.0)
"""Of ticks, times a power of ten."""


def in_km(line: Line | None, position: ArrayLike) -> FloatArray:
    """Kilometres that a person reads for positions [m] of a line; none is a negative zero.

    Examples
    --------
    >>> from dataclasses import replace
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.railway import LineReference
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> in_km(line, 1_000.0).item(), in_km(None, 1_000.0).item()
    (1.0, 1.0)
    >>> down = LineReference("850", [0.0], [61_200.0], [61_200.0 - line.length])
    >>> in_km(replace(line, reference=down), 1_000.0).item()
    60.2
    >>> f"{in_km(line, -0.2).item():.3f}"
    '0.000'
    """
    places = np.asarray(position, dtype=np.float64)
    km = np.asarray((places if line is None else line.kilometre(places)) / 1e3)
    return np.where((km <= 0.0) & (km >= -5e-4), 0.0, km)


def km_words(line: Line | None, position: float) -> str:
    """A place as ``km 61.400``.

    Examples
    --------
    >>> km_words(None, 350.0)
    'km 0.350'
    """
    return f"km {float(in_km(line, position)):.3f}"


def position_of(line: Line | None, km: float) -> float:
    """Position [m] of a kilometre as a person types it, the reverse of `in_km`.

    Where the kilometres come twice, the first.

    Raises
    ------
    InputError
        If the line has no such kilometre.

    Examples
    --------
    >>> position_of(None, 3.2)
    3200.0
    """
    if line is None:
        return 1e3 * km
    if line.reference is None:
        if not -ROUNDING <= 1e3 * km <= line.length + ROUNDING:
            raise InputError(f"line '{line.name}' has no km {km:g}", remedy=_kilometres_of(line))
        return min(max(1e3 * km, 0.0), line.length)
    for first, last, start, end in _pieces(line):
        low, high = min(start, end), max(start, end)
        if low - ROUNDING <= 1e3 * km <= high + ROUNDING and high > low:
            share = (min(max(1e3 * km, low), high) - start) / (end - start)
            return first + share * (last - first)
    raise InputError(f"line '{line.name}' has no km {km:g}", remedy=_kilometres_of(line))


def section_of_km(
    line: Line | None, start: float | None, end: float | None
) -> tuple[float | None, float | None]:
    """Positions [m] of the ends of a section that a person types in km; None where it is open.

    Of a line with the operator's kilometres the ends may come in either order, for they may fall in
    the direction of travel; an open section has the kilometres above, or below, the one given.

    Raises
    ------
    InputError
        If the line has no such kilometre.

    Examples
    --------
    >>> section_of_km(None, 3.2, None)
    (3200.0, None)
    """
    ends = [None if each is None else position_of(line, each) for each in (start, end)]
    if line is None or line.reference is None:
        return ends[0], ends[1]
    first, last = ends
    if first is not None and last is not None:
        return min(first, last), max(first, last)
    falling = line.reference.end[-1] < line.reference.start[0]
    return (last, first) if falling else (first, last)


def near(line: Line | None, position: ArrayLike, within: float = AT_STATION) -> list[str]:
    """Where each position [m] lies, by the nearest station; empty without a line.

    At a station is what is less than `within` [m] away from it.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> near(line, [20.0, 9_000.0])
    ['at St.Gallen', '0.3 km before Gossau SG']
    """
    at = np.asarray(position, dtype=np.float64)
    if line is None or not line.stations:
        return [""] * at.size
    places = np.array([each.position for each in line.stations])
    nearest = np.argmin(np.abs(places - at[:, None]), axis=1)
    beyond = at - places[nearest]
    return [
        f"at {line.stations[i].name}"
        if abs(by) < within
        else f"{abs(by) / 1e3:.1f} km {'after' if by > 0 else 'before'} {line.stations[i].name}"
        for i, by in zip(nearest.tolist(), beyond.tolist(), strict=True)
    ]


def station_at(line: Line, position: float, reach: float = STATION_REACH) -> str:
    """Name of the nearest station within `reach` [m] of a position; empty if there is none."""
    places = np.array([station.position for station in line.stations])
    nearest = int(np.argmin(np.abs(places - position)))
    near = abs(places[nearest] - position) <= reach
    return line.stations[nearest].name if near else ""


def km_ticks(
    line: Line | None, start: float, end: float, most: int = 10
) -> tuple[FloatArray, list[str]]:
    """Ticks of an axis over positions: where they stand [m], and their labels.

    They are at round kilometres, not at round positions.

    Parameters
    ----------
    line : Line or None
    start, end : float [m]
        Of the axis.
    most : int
        Ticks, about.

    Examples
    --------
    >>> places, labels = km_ticks(None, 0.0, 24_500.0, 6)
    >>> places.tolist(), labels
    ([0.0, 5000.0, 10000.0, 15000.0, 20000.0], ['0', '5', '10', '15', '20'])
    """
    step = _step(abs(end - start) / 1e3 / max(most, 1))
    digits = max(0, -int(np.floor(np.log10(step) + 1e-9)))
    low, high = min(start, end), max(start, end)
    places, labels = list[float](), list[str]()
    pieces = _pieces(line) if line is not None else [(low, high, low, high)]
    for number, (first, last, at_first, at_last) in enumerate(pieces):
        if at_first == at_last:
            continue
        within = sorted((at_first / 1e3 / step, at_last / 1e3 / step))
        numbers = step * np.arange(np.ceil(within[0] - 1e-9), np.floor(within[1] + 1e-9) + 1.0)
        found = first + (1e3 * numbers - at_first) / (at_last - at_first) * (last - first)
        order = np.argsort(found)
        for place, km in zip(found[order].tolist(), numbers[order].tolist(), strict=True):
            ends_here = place >= last - 1e-6 and number + 1 < len(pieces)
            apart = not places or place - places[-1] > 300.0 * step
            if low - 1e-6 <= place <= high + 1e-6 and apart and not ends_here:
                places.append(place)
                labels.append(f"{km + 0.0:.{digits}f}")
    return np.array(places), labels


def _step(least: float) -> float:
    """The least round step that is not below."""
    power = 10.0 ** np.floor(np.log10(max(least, 1e-3)))
    return float(next(power * each for each in (*STEPS, 10.0) if power * each >= least * 0.999))


def _pieces(line: Line) -> list[tuple[float, float, float, float]]:
    """First and last position, and the kilometres there, of each piece [m]."""
    known = line.reference
    if known is None:
        return [(0.0, line.length, 0.0, line.length)]
    ends = np.append(known.positions[1:], max(line.length, float(known.positions[-1])))
    rows = (known.positions, ends, known.start, known.end)
    return list(zip(*(each.tolist() for each in rows), strict=True))


def _kilometres_of(line: Line) -> str:
    """From where to where a line's kilometres are, and which it has not."""
    pieces = _pieces(line)
    words = f"its kilometres are {pieces[0][2] / 1e3:.3f} to {pieces[-1][3] / 1e3:.3f}"
    jumps = [
        f"{before[3] / 1e3:.3f} to {after[2] / 1e3:.3f}"
        for before, after in pairwise(pieces)
        if abs(before[3] - after[2]) > ROUNDING
    ]
    return words + (f", with a jump from {', from '.join(jumps)}" if jumps else "")
