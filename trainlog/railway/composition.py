"""A line composed of lines that follow each other, each in the direction of travel."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.line import (
    CurvatureProfile,
    Geometry,
    Leg,
    Line,
    LineReference,
    Station,
    StepProfile,
    Survey,
    Tunnel,
)
from trainlog.railway.line_parts import TINY
from trainlog.railway.resistance import CurveFormula


def composed(
    name: str,
    placed: Sequence[tuple[float, Line]],
    stations: Sequence[Station],
    legs: Sequence[Leg] = (),
) -> Line:
    """Lines that follow each other, in this order, as one.

    Limits, gradients, curves, tunnels and kilometres are those of the parts at each position. It
    has a geometry where all parts have one; gradients are known as well as on the part where they
    are known worst.

    Parameters
    ----------
    name : str
    placed : sequence of (float, Line)
        The parts, each with the position [m] at which it begins.
    stations : sequence of Station
        On the whole.
    legs : sequence of Leg
        Of a route: the edges that the parts are.

    Raises
    ------
    InputError
        If parts state different formulas of the curve resistance.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> parts = [(0.0, line.section(0.0, 4e3)), (4e3, line.section(4e3, line.length))]
    >>> both = composed("again", parts, line.stations)
    >>> both.length, bool(both.gradient(20e3) == line.gradient(20e3))
    (29556.1, True)
    """
    parts = [part for _, part in placed]
    return Line(
        name=name,
        length=placed[-1][0] + parts[-1].length,
        stations=tuple(stations),
        speed_limits=_joined_steps([(at, part.speed_limits) for at, part in placed]),
        gradients=_joined_steps([(at, part.gradients) for at, part in placed]),
        curvatures=_joined_curvatures(placed),
        tunnels=tuple(
            Tunnel(at + each.position, each.length, each.cross_section)
            for at, part in placed
            for each in part.tunnels
        ),
        altitude=parts[0].altitude,
        geometry=_joined_geometry(placed),
        source="; ".join(dict.fromkeys(part.source for part in parts if part.source)),
        braking_parameters=_common_parameters(parts),
        survey=_joined_survey(parts),
        assumed=tuple(dict.fromkeys(name for part in parts for name in part.assumed)),
        reference=_joined_reference(placed),
        curve_resistance=_same_curve_resistance(name, parts),
        legs=tuple(legs),
        speed_limits_reverse=None
        if all(part.speed_limits_reverse is None for part in parts)
        else _joined_steps([(at, part.limits_against) for at, part in placed]),
    )


def _joined_steps(parts: Sequence[tuple[float, StepProfile]]) -> StepProfile:
    return StepProfile(
        np.concatenate([at + part.positions for at, part in parts]),
        np.concatenate([part.values for _, part in parts]),
    )


def _joined_curvatures(parts: Sequence[tuple[float, Line]]) -> CurvatureProfile | None:
    """Curvature of the parts; straight where a part has none, as `Line.curvature` states."""
    if all(part.curvatures is None for _, part in parts):
        return None
    straight = CurvatureProfile(np.zeros(1), np.zeros(1), np.zeros(1))
    profiles = [(at, part.curvatures or straight) for at, part in parts]
    return CurvatureProfile(
        np.concatenate([at + each.positions for at, each in profiles]),
        np.concatenate([each.start for _, each in profiles]),
        np.concatenate([each.end for _, each in profiles]),
    )


def _joined_reference(parts: Sequence[tuple[float, Line]]) -> LineReference | None:
    """The operator's kilometres; of an edge without, its chainage."""
    if all(part.reference is None for _, part in parts):
        return None
    names = dict.fromkeys(part.reference.name for _, part in parts if part.reference is not None)
    rows: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for at, part in parts:
        own = part.reference
        if own is None:
            own = LineReference(part.name, [0.0], [0.0], [part.length])  # type: ignore[arg-type]
        rows.append((at + own.positions, own.start, own.end))
    return LineReference(
        " + ".join(names), *(np.concatenate(each) for each in zip(*rows, strict=True))
    )


def _joined_geometry(parts: Sequence[tuple[float, Line]]) -> Geometry | None:
    """The course of all parts; where two meet, in the middle between their ends."""
    courses = [(at, part.geometry) for at, part in parts if part.geometry is not None]
    if len(courses) < len(parts):
        return None
    positions = np.concatenate([at + each.positions for at, each in courses])
    latitudes = np.concatenate([each.latitudes for _, each in courses])
    longitudes = np.concatenate([each.longitudes for _, each in courses])
    same = np.flatnonzero(np.diff(positions) <= TINY)
    for values in (latitudes, longitudes):
        values[same] = 0.5 * (values[same] + values[same + 1])
    kept = np.setdiff1d(np.arange(positions.size), same + 1)
    quality = "; ".join(dict.fromkeys(each.quality for _, each in courses if each.quality))
    return Geometry(positions[kept], latitudes[kept], longitudes[kept], quality)


def _joined_survey(parts: Sequence[Line]) -> Survey | None:
    """How well the gradients are known where they are known worst; None where one part has none.

    The longest stretch over which an error holds: of a part whose gradients have each one of
    their own, their mean length, the longer ones counting for more.
    """
    surveys = [part.survey for part in parts]
    if any(survey is None for survey in surveys):
        return None
    known = [survey for survey in surveys if survey is not None]
    worst = max(survey.gradient_std for survey in known)
    if all(survey.correlation_length is None for survey in known):
        return Survey(worst)
    lengths = []
    for part, survey in zip(parts, known, strict=True):
        widths = np.diff(np.append(part.gradients.positions, part.length))
        own = float(np.sum(widths**2) / part.length)
        lengths.append(survey.correlation_length or own)
    return Survey(worst, max(lengths))


def _common_parameters(parts: Sequence[Line]) -> dict[str, float]:
    """Braking parameters on which all parts agree."""
    first, *others = (part.braking_parameters for part in parts)
    return {
        name: value
        for name, value in first.items()
        if all(other.get(name) == value for other in others)
    }


def _same_curve_resistance(name: str, parts: Sequence[Line]) -> CurveFormula:
    """The formula of the curve resistance, which all curves of a line have in common."""
    formulas = {part.curve_resistance: part.name for part in parts if part.curvatures is not None}
    if len(formulas) > 1:
        words = ", ".join(f"'{formula}' on '{edge}'" for formula, edge in formulas.items())
        raise InputError(
            f"route '{name}': edges state different curve resistances: {words}",
            remedy="state the same on all edges of a network",
        )
    return next(iter(formulas), "proportional")
