"""What a line of a user's file can be: values beyond it come from a wrong unit.

The limits are wide, and still separate m from km, m/s from km/h and per cent from per mille. Logs
keep what they were recorded with: their attachments are not judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.line import Line
from trainlog.units import KMH


@dataclass(frozen=True, slots=True)
class Plausible:
    """The range of a field.

    Attributes
    ----------
    low, high : float
        In SI.
    unit : str
        Unit of the message.
    scale : float
        That unit in SI.
    what : str
        What has such values.
    confused : tuple of (float, str)
        Factors by which a value is off when its unit is confused, each with the confusion.
    """

    low: float
    high: float
    unit: str
    scale: float
    what: str
    confused: tuple[tuple[float, str], ...] = ()

    def problem(self, value: float, place: str) -> InputError | None:
        """What is wrong with `value` [SI]; None if nothing is, or if it is not positive."""
        if not np.isfinite(value) or value <= 0.0 or self.low <= value <= self.high:
            return None
        likely = [cause for by, cause in self.confused if self.low <= value * by <= self.high]
        return InputError(
            f"{value / self.scale:.6g} {self.unit} is not plausible: {self.what}"
            f" {self.low / self.scale:g} to {self.high / self.scale:g} {self.unit}",
            place=place,
            remedy=f"{likely[0]}?" if likely else "check the value and its unit",
        )


_SPEED = (
    (KMH, "were m/s meant where the unit states km/h"),
    (1.0 / KMH, "were km/h meant where the unit states m/s"),
)

LINE = {
    "length": Plausible(20.0, 2e7, "km", 1e3, "lines have",
                        ((1e3, "were km meant where the unit states m"),
                         (1e-3, "were m meant where the unit states km"))),
}  # fmt: skip
"""By the field of a line file."""

LIMIT = Plausible(1.0 / KMH, 600.0 / KMH, "km/h", 1.0 / KMH, "speed limits are", _SPEED)
STEEPEST_MEAN = 0.08
"""Mean size of the gradients of a whole line; only rack railways exceed it."""

LOWEST, HIGHEST = -1_000.0, 6_000.0
"""Altitudes [m] between which there are railways."""

LEAST_EXTENT = 0.005
"""Share of a line's length that its rows cover at least, where there are several."""


def implausible_line(values: Mapping[str, Any]) -> Iterator[InputError]:
    """What of a line's `values` [SI], by the fields of its file, cannot be meant."""
    length = values.get("length") or 0.0
    for name, plausible in LINE.items():
        problem = plausible.problem(values.get(name) or 0.0, name)
        if problem is not None:
            yield problem
    for name in ("speed_limits", "speed_limits_reverse"):
        if values.get(name) is None:
            continue
        limits = np.asarray(values[name][1], dtype=np.float64)
        wild = np.flatnonzero((limits > 0.0) & ((limits < LIMIT.low) | (limits > LIMIT.high)))
        if wild.size:
            problem = LIMIT.problem(float(limits[wild[0]]), f"{name}.values[{wild[0]}][1]")
            if problem is not None:
                yield problem
    altitude = values.get("altitude") or 0.0
    if not LOWEST <= altitude <= HIGHEST:
        yield InputError(
            f"{altitude:.6g} m is not plausible: railways lie between {LOWEST:g} and {HIGHEST:g} m",
            place="altitude",
            remedy="check the value and its unit",
        )
    if values.get("gradients") is not None and length > 0.0:
        positions, gradients = (np.asarray(x, dtype=np.float64) for x in values["gradients"])
        yield from _implausible_gradients(positions, gradients, length)
        yield from _implausible_chainage(values, length)


def check_line(line: Line) -> None:
    """Refuse a line that cannot be meant; errors as `check_plausible`.

    Examples
    --------
    >>> import trainlog
    >>> check_line(trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json"))
    """
    stations = [station.position for station in line.stations]
    against = line.speed_limits_reverse
    tables = {
        "stations": ((), stations),
        "speed_limits": (line.speed_limits.positions, line.speed_limits.values),
        "speed_limits_reverse": None if against is None else (against.positions, against.values),
        "gradients": (line.gradients.positions, line.gradients.values),
    }
    problems = list(implausible_line({"length": line.length, "altitude": line.altitude} | tables))
    if problems:
        raise InputError.listing(problems)


def _implausible_gradients(
    positions: FloatArray, gradients: FloatArray, length: float
) -> Iterator[InputError]:
    if positions.size == 0 or np.any(np.diff(positions) <= 0.0) or np.any(np.abs(gradients) > 0.2):
        return
    widths = np.diff(np.append(positions, max(length, positions[-1])))
    mean = float(np.sum(np.abs(gradients) * widths)) / max(float(np.sum(widths)), 1e-9)
    rise = np.cumsum(gradients * widths)
    if mean > STEEPEST_MEAN and length > 1e3:
        problem = f"are {1e3 * mean:.0f} per mille on the whole line's average"
    elif np.ptp(rise) > HIGHEST - LOWEST:
        problem = f"make the line rise by {np.ptp(rise):.0f} m"
    else:
        return
    yield InputError(
        f"{problem}: not plausible",
        place="gradients",
        remedy="were per mille meant where the unit states '%'?",
    )


def _implausible_chainage(values: Mapping[str, Any], length: float) -> Iterator[InputError]:
    """Rows of a line that all lie at its start: chainage in km whose unit states m."""
    tables = ("speed_limits", "speed_limits_reverse", "gradients", "curvatures", "tunnels")
    found = [np.asarray(values[name][0]) for name in tables if values.get(name) is not None]
    if values.get("stations") is not None:
        found.append(np.asarray(values["stations"][1], dtype=np.float64))
    positions = np.concatenate(found)
    if np.unique(positions).size >= 5 and np.max(positions) < LEAST_EXTENT * length:
        yield InputError(
            f"all positions lie within {np.max(positions):.6g} m of a line of {length:.6g} m:"
            " not plausible",
            place="units.position",
            remedy="were km meant where the unit states m?",
        )
