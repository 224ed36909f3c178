"""The geometry of a line from the satellite fixes of trips along it, where no map exists."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import ClassVar

import numpy as np
from scipy.integrate import cumulative_trapezoid
from scipy.ndimage import label
from scipy.spatial import cKDTree

from analysis.view import trip_of
from estimators.centre_line import OVER, Curve, HeightProfile, Ride, fitted_curve, height_profile
from estimators.motion import smooth_motion
from trainlog.arrays import BoolArray, ComplexArray, FloatArray, IntArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.identity import Known, identity_of, same_drives
from trainlog.ingest.chainage import OnLine
from trainlog.ingest.receiver import Fixes, count_placed, distance_driven, fixes_of
from trainlog.presentation import Presented
from trainlog.railway.geometry import from_plane, nearest_on, thinned, to_plane, track_of
from trainlog.railway.line import CurvatureProfile, Geometry, Line, Station, StepProfile, Survey
from trainlog.trip import Trip
from trainlog.units import KMH, PER_MILLE

PIECE = 25.0
"""Fixes within so much distance driven are one point of the first, rough line [m]."""

TURNS = 3
"""Times the fixes are matched to the line and the line is fitted to them."""

STEP = 10.0
"""Distance between the points of the surveyed line [m]."""

SUPPORT = 200.0
"""A trip supports the line within this distance of its fixes [m]."""

REGION = 500.0
"""Stretch over which trips are compared with each other [m]."""

TOLERANCE = 0.1
"""How far the geometry's straight pieces may lie from the curve [m]."""

CURVATURE_STEP = 50.0
"""Length of the elements of the curvature profile [m]."""

LEAST_KNOWN = 0.9
"""Share of a line whose gradients must be known for a line to have any."""

NEAR = 60.0
"""A fix so near to the rough line adds nothing to its course [m]."""

GAP = 100.0
"""Points of the rough line further apart than this [m] have a gap between them."""


FEWEST_FIXES = 11
"""Of a trip that adds to a line."""


@dataclass(frozen=True, eq=False, repr=False)
class CentreLine(Presented):
    """A line's geometry, and what it rests on; arrays are (n,), one value a `STEP`.

    Attributes
    ----------
    geometry : Geometry
        Without points on stretches that no trip supports.
    curvatures : CurvatureProfile
    position : array [m]
    latitude, longitude : array [deg]
    std : array [m]
        Of the line's place across the track.
    curvature, curvature_std : array [1/m]
    support : int array
        Number of trips with fixes within `SUPPORT`.
    unsupported : tuple of (from, to) [m]
        Stretches without any fix: bridged by a smooth curve, not known.
    used : tuple of str
        Names of the trips the line rests on.
    refused : tuple of (name, reason)
    fixes, rejected : int
        Fixes of the trips used, and those of them that were set aside.
    fastest : float [m/s]
        Highest smoothed speed of any trip.
    heights : HeightProfile or None
        Height and gradients with their standard deviations, from the receivers' altitudes; None
        where they do not show them.
    no_heights : str
        Why not.
    """

    charts_by: ClassVar[str] = "analysis.geometry.plot:centre_line_charts"

    geometry: Geometry
    curvatures: CurvatureProfile
    position: FloatArray
    latitude: FloatArray
    longitude: FloatArray
    std: FloatArray
    curvature: FloatArray
    curvature_std: FloatArray
    support: IntArray
    unsupported: tuple[tuple[float, float], ...]
    used: tuple[str, ...]
    refused: tuple[tuple[str, str], ...] = ()
    fixes: int = 0
    rejected: int = 0
    fastest: float = 0.0
    heights: HeightProfile | None = None
    no_heights: str = ""

    @property
    def gradients_known(self) -> bool:
        """Whether the altitudes show the gradients of nearly the whole line."""
        return self.heights is not None and bool(np.mean(self.heights.known) >= LEAST_KNOWN)

    @property
    def gradient_std(self) -> float:
        """Root mean square of the standard deviations of the gradients over `OVER`."""
        assert self.heights is not None
        return float(np.sqrt(np.mean(self.heights.gradient_std**2)))

    @property
    def length(self) -> float:
        """Of the line [m]."""
        return float(self.geometry.positions[-1])

    @property
    def title(self) -> str:
        """Length, trips and fixes."""
        return (
            f"Centre line, {self.length / 1e3:.3f} km from {counted(len(self.used), 'trip')},"
            f" {self.fixes} fixes, {self.rejected} set aside"
        )

    def summary(self) -> dict[str, str]:
        """How well the course and the gradients are known."""
        known = self.support > 0
        return {
            "across the track": f"standard deviation {np.median(self.std[known]):.1f} m, at most"
            f" {self.std[known].max():.1f} m; {np.mean(self.support > 1):.0%} of the line rests on"
            " more than one trip",
            "gradients": self._gradients(),
        }

    @property
    def notes(self) -> list[str]:
        """What has no fixes, and trips that are not used."""
        return [
            *(
                f"no fixes from km {start / 1e3:.3f} to km {end / 1e3:.3f}: bridged, not known"
                for start, end in self.unsupported
            ),
            *(f"{name} is not used: {reason}" for name, reason in self.refused),
        ]

    def _gradients(self) -> str:
        """What is known of the gradients, in words."""
        if self.heights is None:
            return f"not known: {self.no_heights}"
        known, size = self.heights.known, PER_MILLE * self.gradient_std
        errors = f"altitudes err by {self.heights.sigma:.1f} m for {self.heights.tau:.0f} s"
        if not self.gradients_known:
            return (
                f"not known: the trips' altitudes show {np.mean(known):.0%} of them,"
                f" to {size:.1f} per mille over {OVER:.0f} m; {errors}"
            )
        return f"over {OVER:.0f} m to {size:.1f} per mille (standard deviation); {errors}"


@dataclass(frozen=True, eq=False)
class _Pass:
    """A trip along the line: its fixes, their points, and where on the line they lie."""

    name: str
    fixes: Fixes
    points: ComplexArray
    matched: OnLine | None = None
    chainage: FloatArray = field(default_factory=lambda: np.zeros(0))
    reason: str = ""
    altitude: FloatArray = field(default_factory=lambda: np.zeros(0))
    accuracy: FloatArray = field(default_factory=lambda: np.zeros(0))


def geometry_of(trips: Sequence[Trip]) -> CentreLine:
    """The centre line of the track from the fixes of trips along it, in either direction.

    The longest trip gives a rough line, its gaps and ends filled from the others. Then, in turns,
    all trips are matched to the line as any trip is (`OnLine`: reflections are set aside), and
    the smoothest curve near all matched fixes is fitted (`estimators.centre_line`). Chainage is
    the length along it, in the direction of the longest trip.

    Parameters
    ----------
    trips : sequence of Trip
        With fixes, of the same line. Each drive is used once (`trainlog.identity`); trips of one
        that a fuller recording stands for are listed among the refused.

    Raises
    ------
    InputError
        If no trip has fixes that move along a line.
    LogError
        If a trip holds infinite numbers.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> centre_line = geometry_of([read_log("sample_logs/nonstop.mcap")])
    >>> bool(abs(centre_line.length - 29_556.0) < 100.0)
    True
    """
    trips = [trip_of(trip) for trip in trips]
    same = same_drives([Known(trip.name, identity_of(trip), (trip.name,)) for trip in trips])
    again = {each.number for each in same}
    passes, few = _passes([trip for number, trip in enumerate(trips) if number not in again])
    origin = _origin(passes)
    passes = [
        replace(p, points=to_plane(p.fixes.latitude, p.fixes.longitude, origin)) for p in passes
    ]
    rough = rough_line([_thinned(p) for p in passes])
    along = np.concatenate(([0.0], np.cumsum(np.abs(np.diff(rough)))))
    curve, _ = fitted_curve(along, rough, np.full(rough.size, _std(passes)))
    for turn in range(TURNS):
        geometry = _by_length(curve, origin)
        # At first the line may be what is off, not the fixes: all of them count.
        passes = [_matched(p, geometry, gated=turn > 0) for p in passes]
        used = [p for p in passes if p.matched is not None]
        if not used:
            raise InputError(
                f"the trips follow no common line; '{passes[0].name}': {passes[0].reason}",
                remedy="give trips along one line, each in one direction",
            )
        kept = [np.isfinite(p.chainage) for p in used]
        curve, _ = fitted_curve(
            np.concatenate([p.chainage[k] for p, k in zip(used, kept, strict=True)]),
            np.concatenate([p.points[k] for p, k in zip(used, kept, strict=True)]),
            np.concatenate([_std_in_fit(p)[k] for p, k in zip(used, kept, strict=True)]),
        )
    found = _centre_line(curve, used, [p for p in passes if p.matched is None], origin)
    copies = tuple((s.trip, s.sentence) for s in same)
    return replace(found, refused=(*found.refused, *few, *copies))


def line_of(centre_line: CentreLine, name: str) -> Line:
    """A line with the surveyed geometry and curvature; its source names what is not known.

    A line needs speed limits: it gets the highest speed driven, rounded up to 5 km/h. Gradients
    come from the trips' altitudes, with how well they are known as its `survey`; where these do not
    show them the line is level, and `assumed` has ``"gradients"``: what needs them refuses it.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> centre_line = geometry_of([read_log("sample_logs/nonstop.mcap")])
    >>> line = line_of(centre_line, "from fixes")
    >>> line.source.endswith("gradients, stations, tunnels: not known"), line.assumed
    (True, ('speed_limits', 'stations', 'gradients'))
    """
    limit = 5.0 / KMH * np.ceil(max(centre_line.fastest, 1.0) * KMH / 5.0)
    missing = sum(end - start for start, end in centre_line.unsupported)
    source = (
        f"{centre_line.geometry.quality}; chainage counts along the fitted curve;"
        f" {missing:.0f} m without fixes; speed limit: highest speed driven;"
    )
    gradients, survey = StepProfile(np.zeros(1), np.zeros(1)), None
    assumed: tuple[str, ...] = ("speed_limits", "stations")
    altitude = 0.0
    if centre_line.gradients_known and centre_line.heights is not None:
        heights = centre_line.heights
        # One for every half of the stretches over which they are known.
        step = heights.position[1] - heights.position[0]
        edges = np.concatenate(([0.0], heights.position[:-1] + 0.5 * step))
        gradients = StepProfile(edges, heights.gradient)
        altitude = float(heights.height[0])
        survey = Survey(centre_line.gradient_std, OVER)
        source += " gradients: from the receivers' altitudes; stations, tunnels: not known"
    else:
        assumed = (*assumed, "gradients")
        source += " gradients, stations, tunnels: not known"
    return Line(
        name=name,
        length=centre_line.length,
        stations=(Station("start", 0.0), Station("end", centre_line.length)),
        speed_limits=StepProfile(np.zeros(1), np.array([limit])),
        gradients=gradients,
        curvatures=centre_line.curvatures,
        altitude=altitude,
        geometry=centre_line.geometry,
        source=source,
        survey=survey,
        assumed=assumed,
    )


def _heights(used: list[_Pass], length: float) -> tuple[HeightProfile | None, str]:
    """Height and gradients from the altitudes of the trips, or why there are none."""
    rides = []
    for one in used:
        known = np.isfinite(one.chainage) & np.isfinite(one.altitude)
        if np.ptp(one.chainage[known]) < 2.0 * OVER if known.any() else True:
            continue
        columns = (one.fixes.seconds, one.chainage, one.altitude, one.accuracy)
        rides.append(Ride(*(column[known] for column in columns)))
    try:
        return height_profile(rides, length), ""
    except InputError as error:
        return None, str(error)


def _passes(trips: Sequence[Trip]) -> tuple[list[_Pass], list[tuple[str, str]]]:
    """Trips with fixes; and those with too few, with the reason."""
    counts = [count_placed(trip) for trip in trips]
    found = [trip for trip, count in zip(trips, counts, strict=True) if count >= FEWEST_FIXES]
    if not found:
        most = max(counts, default=0)
        enough = f" enough: {most} at most, {FEWEST_FIXES} are needed" * bool(most)
        raise InputError(
            f"none of the trips has satellite fixes{enough}", remedy="give trips with /gnss/fix"
        )
    few = [
        (trip.name, f"it has {count} satellite fixes, at least {FEWEST_FIXES} are needed")
        for trip, count in zip(trips, counts, strict=True)
        if count < FEWEST_FIXES
    ]
    return [_pass_of(trip) for trip in found], few


def _pass_of(trip: Trip) -> _Pass:
    fixes, frame = fixes_of(trip), trip["/gnss/fix"]
    frame = frame[~frame.index.duplicated()].reindex(fixes.index)
    altitude, accuracy = (
        frame[name].to_numpy(np.float64) for name in ("altitude", "vertical_accuracy")
    )
    nowhere = np.zeros(0, dtype=np.complex128)
    return _Pass(trip.name, fixes, nowhere, altitude=altitude, accuracy=accuracy)


def _origin(passes: list[_Pass]) -> tuple[float, float]:
    latitudes = np.concatenate([p.fixes.latitude for p in passes])
    longitudes = np.concatenate([p.fixes.longitude for p in passes])
    return float(np.nanmedian(latitudes)), float(np.nanmedian(longitudes))


def _std(passes: list[_Pass]) -> float:
    return float(np.median(np.concatenate([p.fixes.std for p in passes])))


def _thinned(one: _Pass) -> ComplexArray:
    """One point for every `PIECE` driven, the median of its fixes."""
    known = np.flatnonzero(np.isfinite(one.points))
    driven = distance_driven(one.fixes).distance
    if not np.isfinite(driven).any():
        driven = _distance_along_fixes(one)
    piece = np.floor(driven[known] / PIECE)
    edges = np.flatnonzero(np.diff(piece, prepend=piece[0] - 1.0))
    groups = np.split(one.points[known], edges[1:])
    return np.array([np.median(g.real) + 1j * np.median(g.imag) for g in groups])


def _distance_along_fixes(one: _Pass) -> FloatArray:
    """Distance driven [m] where no speed was measured: along the smoothed fixes."""
    nothing = np.full(one.points.size, np.nan)
    axes = [
        smooth_motion(one.fixes.seconds, nothing, 1.0, values, one.fixes.std)
        for values in (one.points.real, one.points.imag)
    ]
    speed = np.hypot(axes[0].speed, axes[1].speed)
    unsure = np.hypot(axes[0].speed_std, axes[1].speed_std)
    speed = np.where(speed > unsure, speed, 0.0)
    return np.asarray(cumulative_trapezoid(speed, one.fixes.seconds, initial=0.0))


def _by_length(curve: Curve, origin: tuple[float, float]) -> Geometry:
    """The curve as a geometry whose positions are the length along it."""
    at = np.linspace(curve.start, curve.end, int((curve.end - curve.start) / STEP) + 2)
    points = curve.at(at)
    latitude, longitude = from_plane(points, origin)
    return Geometry(_length_along(curve, at), latitude, longitude, "being fitted")


def _length_along(curve: Curve, at: FloatArray) -> FloatArray:
    """Length of the curve [m] up to each of increasing positions, by Simpson's rule."""
    middle = 0.5 * (at[1:] + at[:-1])
    pace = np.abs(curve.spline(at, 1)), np.abs(curve.spline(middle, 1))
    pieces = np.diff(at) * (pace[0][:-1] + 4.0 * pace[1] + pace[0][1:]) / 6.0
    return np.concatenate(([0.0], np.cumsum(pieces)))


def _matched(one: _Pass, geometry: Geometry, *, gated: bool) -> _Pass:
    """The pass with its fixes on the line, in whichever direction it runs."""
    length = float(geometry.positions[-1])
    track = track_of(geometry)
    near, away = nearest_on(track, track.plane(one.fixes.latitude, one.fixes.longitude))
    near = near[away < 2.0 * NEAR]
    backwards = float(np.clip(np.diff(near), -GAP, GAP).sum()) < 0.0
    travelled = geometry.reversed(length) if backwards else geometry
    try:
        matched = OnLine(travelled, one.fixes, gated=gated)
    except InputError as error:
        return replace(one, matched=None, reason=error.problem)
    # Fixes of a train that stands at the line's end scatter beyond it; the line ends where it is.
    kept = np.isfinite(matched.chainage)
    apart = max(matched.misfit, float(np.median(away[kept])) if kept.any() else np.inf)
    if apart > NEAR:
        reason = f"its fixes lie {apart:.0f} m from the line that the others make"
        return replace(one, matched=None, reason=reason)
    reached = matched.motion.position[kept]
    # Replayed fixes count at other rows there.
    own = np.where(np.isfinite(one.points), matched.chainage, np.nan)
    chainage = np.clip(own, reached.min(), reached.max())
    if backwards:
        chainage = length - chainage
    return replace(one, matched=matched, chainage=chainage)


def _std_in_fit(one: _Pass) -> FloatArray:
    """Standard deviation [m] with which each fix counts: all of a trip's in a `PIECE` as one.

    Errors last. Ten fixes a second, or those of a train that stands before a reflecting wall,
    carry little more than one, and must not outweigh the other trips.
    """
    kept = np.isfinite(one.chainage)
    piece = np.where(kept, np.floor(one.chainage / PIECE), -1.0)
    _, number, count = np.unique(piece, return_inverse=True, return_counts=True)
    return np.asarray(one.fixes.std * np.sqrt(count[number]))


def _centre_line(
    curve: Curve, used: list[_Pass], refused: list[_Pass], origin: tuple[float, float]
) -> CentreLine:
    """The centre line that the fitted curve gives."""
    at = np.linspace(curve.start, curve.end, int((curve.end - curve.start) / STEP) + 2)
    position = _length_along(curve, at)
    points = curve.at(at)
    latitude, longitude = from_plane(points, origin)
    on_curve = [np.sort(p.chainage[np.isfinite(p.chainage)]) for p in used]
    support = np.sum([_supported(at, places) for places in on_curve], axis=0)
    std = np.hypot(curve.std(at), _between(curve, used) / np.sqrt(np.maximum(support, 1)))
    quality = (
        f"fitted to the satellite fixes of {counted(len(used), 'trip')} (standard deviation"
        f" {np.median(std[support > 0]):.1f} m across the track); not surveyed"
    )
    heights, no_heights = _heights(used, float(position[-1]))
    kept = thinned(position, points, TOLERANCE)
    kept = kept[(support[kept] > 0) | (kept == 0) | (kept == at.size - 1)]
    bend = curve.curvature(at)
    return CentreLine(
        geometry=Geometry(position[kept], latitude[kept], longitude[kept], quality),
        curvatures=_profile(position, bend),
        position=position,
        latitude=latitude,
        longitude=longitude,
        std=std,
        curvature=bend,
        curvature_std=curve.curvature_std(at),
        support=support,
        unsupported=_spans(position, support == 0),
        used=tuple(p.name for p in used),
        refused=tuple((p.name, p.reason) for p in refused),
        fixes=sum(int(np.isfinite(p.points).sum()) for p in used),
        rejected=sum(int(p.matched.rejected.sum()) for p in used if p.matched is not None),
        fastest=max(float(p.matched.motion.speed.max()) for p in used if p.matched is not None),
        heights=heights,
        no_heights=no_heights,
    )


def _supported(at: FloatArray, places: FloatArray) -> IntArray:
    """1 where a fix lies within `SUPPORT`, else 0."""
    following = np.searchsorted(places, at - SUPPORT)
    return (np.searchsorted(places, at + SUPPORT) > following).astype(np.int64)


def _between(curve: Curve, used: list[_Pass]) -> float:
    """Standard deviation [m] of a trip's own lasting error, from how trips differ.

    Errors that last do not average out along the line, only over trips. With one trip alone
    they cannot be separated from the line: its stated accuracy is taken.
    """
    sums: dict[int, list[tuple[float, float]]] = {}
    for p in used:
        kept = np.isfinite(p.chainage)
        s = p.chainage[kept]
        ahead = curve.spline(s, 1)
        aside = (np.conj(ahead) * (p.points[kept] - curve.at(s))).imag / np.abs(ahead)
        regions = np.floor(s / REGION).astype(np.int64)
        for region in np.unique(regions):
            inside = regions == region
            if np.count_nonzero(inside) > 3:
                sums.setdefault(int(region), []).append((float(aside[inside].mean()), 1.0))
    several = [np.array(found)[:, 0] for found in sums.values() if len(found) > 1]
    if not several:
        return _std(used)
    freedom = sum(values.size - 1 for values in several)
    spread = sum(float(np.sum((values - values.mean()) ** 2)) for values in several)
    return float(np.sqrt(spread / freedom))


def _profile(position: FloatArray, bend: FloatArray) -> CurvatureProfile:
    """Curvature as elements between which it is continuous."""
    count = max(int(position[-1] / CURVATURE_STEP), 1)
    edges = np.linspace(0.0, position[-1], count + 1)
    values = np.interp(edges, position, bend)
    return CurvatureProfile(edges[:-1], values[:-1], values[1:])


def _spans(position: FloatArray, flags: BoolArray) -> tuple[tuple[float, float], ...]:
    runs, count = label(flags)
    spans = [np.flatnonzero(runs == k + 1) for k in range(count)]
    return tuple((float(position[s[0]]), float(position[s[-1]])) for s in spans)


def rough_line(sequences: list[ComplexArray]) -> ComplexArray:
    """The longest sequence of points, with what others have in its gaps and beyond its ends.

    Parameters
    ----------
    sequences : list of complex arrays [m]
        Points of the plane along each trip, one trip in one direction or the other.

    Returns
    -------
    (n,) complex array [m]
        In the direction of the longest, without points at which it would turn back on itself.
    """
    lengths = [float(np.sum(np.minimum(np.abs(np.diff(s)), GAP))) for s in sequences]
    order = np.argsort(lengths)[::-1]
    line = sequences[int(order[0])]
    for number in order[1:]:
        sequence = sequences[int(number)]
        for begin, end in _pieces_apart(line, sequence):
            line = _with_piece(line, sequence, begin, end)
    return _without_turns_back(line)


def _without_turns_back(line: ComplexArray) -> ComplexArray:
    """The points without those, far off, at which the line would turn back on itself."""
    while line.size > 3:
        steps = np.diff(line)
        back = (np.conj(steps[:-1]) * steps[1:]).real < 0.0
        if not back.any():
            break
        line = line[np.concatenate(([True], ~back, [True]))]
    return line


def _pieces_apart(line: ComplexArray, sequence: ComplexArray) -> list[tuple[int, int]]:
    """Runs of a sequence that the line does not pass by, as (first, one past the last)."""
    apart, _ = cKDTree(_pairs(line)).query(_pairs(sequence))
    runs, count = label(apart > NEAR)
    spans = [np.flatnonzero(runs == k + 1) for k in range(count)]
    return [(int(span[0]), int(span[-1]) + 1) for span in spans if span.size > 2]


def _with_piece(line: ComplexArray, sequence: ComplexArray, begin: int, end: int) -> ComplexArray:
    """The line with a piece of another sequence, if it fills a gap or goes on beyond an end."""
    tree = cKDTree(_pairs(line))
    piece, last = sequence[begin:end], line.size - 1
    before = int(tree.query(_pairs(sequence[begin - 1 : begin]))[1][0]) if begin else None
    after = int(tree.query(_pairs(sequence[end : end + 1]))[1][0]) if end < sequence.size else None
    if before is not None and after is not None:
        low, high = sorted((before, after))
        inner = np.abs(np.diff(line[low : high + 1]))
        if inner.size and inner.max() > GAP and high - low <= 5:
            part = piece if before < after else piece[::-1]
            return np.concatenate([line[: low + 1], part, line[high:]])
        return line
    for anchor, outward in ((before, piece), (after, piece[::-1])):
        if anchor is None:
            continue
        if anchor >= last - 2 and _continues(line, outward):
            return np.concatenate([line, outward])
        if anchor <= 2 and _continues(line[::-1], outward):
            return np.concatenate([outward[::-1], line])
    return line


def _continues(line: ComplexArray, further: ComplexArray) -> bool:
    """Whether points beyond the end of a line lie within 60° of ahead: no train turns at once."""
    heading, ahead = line[-1] - line[max(line.size - 6, 0)], further[2] - line[-1]
    return bool((np.conj(heading) * ahead).real > 0.5 * np.abs(heading) * np.abs(ahead))


def _pairs(points: ComplexArray) -> FloatArray:
    return np.column_stack([points.real, points.imag])
