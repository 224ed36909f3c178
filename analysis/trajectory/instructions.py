"""Advice that can be followed word by word with every configuration of a plan.

A plan's phases leave to the reader what a driver must be given: where to brake for a lower limit,
and which speed not to exceed. Limits are those of the line; without it, the speeds planned.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np

from analysis.trajectory.phases import AdvicePoint, Phase, rounded_down
from trainlog.arrays import FloatArray
from trainlog.railway import StepProfile, Trajectory
from trainlog.spans import runs_of
from trainlog.units import KMH

DRIVEABLE = 8.0
"""What takes less time is joined with what comes before or after it, unless it brakes for a limit
or a stop [s]."""

NOTICE = 10.0
"""So long before a lower limit its braking is advised at least [s]."""

COMFORTABLE = 0.5
"""Deceleration to a lower limit that is counted on at most [m/s²]."""

_SHARE = 0.85
"""Part of the planned deceleration that is counted on."""

_FASTER = 5.0 / KMH
"""How much faster than planned a train may come to a lower limit [m/s]."""

_LITTLE = 3.0 / KMH
"""The same for the stop, ahead of which all brake as planned [m/s]."""

_SLOW = 8.0 / KMH
"""Further below a limit no configuration needs a word about it [m/s]."""

_APPROACH = 2_000.0
"""Ahead of a limit or a stop, where decelerations are looked for [m]."""

_BEFORE = 300.0
"""Ahead of a limit, where speeds decide whether it is of concern [m]."""

_REACH = 12_000.0
"""Longest braking that is looked for [m]."""

_LONG_PARTIAL = 20.0
"""Rising partial traction below this goes on as full traction [s]."""


@dataclass(frozen=True, slots=True)
class _Stretch:
    """One instruction between two places [m]; `target` where it brakes for a limit or a stop."""

    start: float
    end: float
    point: AdvicePoint
    target: float | None = None

    @property
    def kind(self) -> tuple[int, bool]:
        """What the driver does; stretches of one kind are one."""
        return int(self.point.phase), self.point.hold


class _Plan:
    """The speeds of all configurations, the permitted ones and the braking that is planned."""

    def __init__(self, trajectory: Trajectory, row: int, limits: StepProfile | None) -> None:
        self.places, self.speeds = trajectory.positions, trajectory.speeds
        self.row, self.limits = row, limits
        self.times = trajectory.times[row]
        self.highest = self.speeds.max(axis=0)
        self.top = float(self.highest.max())
        step = np.diff(self.places)
        self.deceleration = -np.diff(0.5 * self.speeds**2, axis=1) / step
        letters = trajectory.certificate["phases"]
        self.full = np.array([[each == "B" for each in row_] for row_ in letters])
        self.brakes = self.full | np.array([[each == "H" for each in row_] for row_ in letters])

    def extremes(self, start: float, end: float) -> tuple[float, float, float]:
        """Lowest and highest speed of the one configuration, highest of all, between places."""
        inside = (self.places > start) & (self.places < end)
        own = np.append(self.speeds[self.row, inside], self.at([start, end]))
        ends = np.interp([start, end], self.places, self.highest)
        return (
            float(own.min()),
            float(own.max()),
            float(np.append(self.highest[inside], ends).max()),
        )

    def at(self, places: Sequence[float]) -> FloatArray:
        """Speed of the one configuration."""
        return np.asarray(np.interp(places, self.places, self.speeds[self.row]))

    def course(self, start: float, end: float) -> tuple[float, ...]:
        """Speeds of the one configuration between which it rises and falls."""
        inside = self.places[(self.places > start) & (self.places < end)]
        speeds = self.at([start, *inside.tolist(), end])
        turns = sorted({0, int(np.argmin(speeds)), int(np.argmax(speeds)), speeds.size - 1})
        return tuple(speeds[turns].tolist())

    def usual(self, start: float, end: float) -> float:
        """The speed in the middle of those between two places [m/s]."""
        return float(np.median(self.at(np.linspace(start, end, 101).tolist())))

    def lasts(self, start: float, end: float) -> float:
        """Time between two places [s]."""
        return float(np.diff(np.interp([start, end], self.places, self.times))[0])

    def lowest_limit(self, start: float, end: float) -> float:
        """The lowest permitted speed between two places; without limits the highest planned."""
        if self.limits is None:
            return self.extremes(start, end)[2]
        inside = (self.limits.positions > start) & (self.limits.positions < end)
        return float(np.append(self.limits.values[inside], self.limits(start)).min())

    def falls(self) -> list[tuple[float, float]]:
        """Places of lower limits, and the speed from there on; the end of the run is the last."""
        first, last = float(self.places[0]), float(self.places[-1])
        found = list[tuple[float, float]]()
        if self.limits is not None:
            capped = np.minimum(self.limits.values, self.top)
            edges = zip(self.limits.positions[1:].tolist(), pairwise(capped.tolist()), strict=True)
            found = [
                (place, after)
                for place, (before, after) in edges
                if after < before and first < place < last
                and self.extremes(max(place - _BEFORE, first), place)[2] > after - _SLOW
            ]  # fmt: skip
        else:
            for row, brakes in enumerate(self.brakes):
                for start, end in runs_of(brakes):
                    if self.speeds[row, start] - self.speeds[row, end] > 2.0 / KMH:
                        found.append((float(self.places[end]), float(self.highest[end])))
            found = [each for each in sorted(set(found)) if each[0] < last]
        return [*found, (last, float(self.highest[-1]))]

    def rate(self, place: float) -> float:
        """Deceleration [m/s²] to count on ahead of a place: part of the least planned there."""
        near = (self.places[1:] > place - _APPROACH) & (self.places[1:] <= place + 1.0)
        cells = self.full & near
        cells = cells if cells.any() else self.full
        found = self.deceleration[cells & (self.deceleration > 0.02)]
        return _SHARE * float(np.quantile(found, 0.1)) if found.size else 0.25

    def begin(self, place: float, target: float) -> float:
        """Where to brake from, so that every configuration is at `target` by `place`."""
        first = float(self.places[0])
        at = np.linspace(max(place - _REACH, first), place, 4001)
        stop = place >= float(self.places[-1])
        rate = self.rate(place) if stop else min(self.rate(place), COMFORTABLE)
        highest = np.interp(at, self.places, self.highest) + (_LITTLE if stop else _FASTER)
        if self.limits is not None:
            highest = np.minimum(highest, self.limits(at))
        slow = highest**2 <= target**2 + 2.0 * rate * (place - at)
        fast = np.flatnonzero(~slow[:-1])
        enough = np.flatnonzero(slow[:-1])
        # The last place from which it is enough; beyond it some are too fast.
        start = place if not fast.size else float(at[enough.max()]) if enough.size else first
        pace = float(np.interp(start, at, highest))
        return max(min(start, place - NOTICE * pace, self._planned(place)), first)

    def _planned(self, place: float) -> float:
        """Where the first configuration begins to brake fully for `place`."""
        end = int(np.searchsorted(self.places, place - 1e-6))
        starts = [float(place)]
        for brakes in self.full:
            start = end
            while start > 0 and brakes[start - 1]:
                start -= 1
            starts.append(float(self.places[start]))
        return min(starts)


def instructions(
    trajectory: Trajectory,
    row: int,
    points: Sequence[AdvicePoint],
    limits: StepProfile | None,
) -> tuple[AdvicePoint, ...]:
    """Points that a driver can follow word by word, from those at which phases begin.

    Speeds are whole km/h, rounded down, nowhere above the lowest limit until the next point. Each
    lower limit that any configuration comes near has its own point, from which a comfortable
    deceleration is enough for the fastest; so has the stop.

    Parameters
    ----------
    trajectory : Trajectory
    row : int
        Configuration of the points.
    points : sequence of AdvicePoint
    limits : StepProfile or None [m/s]
        Of the line, in the direction of travel; None: speeds planned take their place.
    """
    plan = _Plan(trajectory, row, limits)
    ends = [*(point.position for point in points[1:]), float(plan.places[-1])]
    stretches = [
        _Stretch(point.position, end, point) for point, end in zip(points, ends, strict=True)
    ]
    stretches = _without_partial(stretches, plan)
    stretches = _joined(_with_braking(stretches, _braking(plan, stretches), points[-1]), plan)
    stretches = [
        replace(each, point=replace(each.point, target=plan.extremes(each.start, each.end)[1]))
        for each in stretches
    ]
    stretches = [part for each in stretches for part in _split(each, plan)]
    found = list[AdvicePoint]()
    for point in (_worded(each, plan) for each in stretches):
        if found and point.hold and found[-1].hold and point.target == found[-1].target:
            # One speed to hold, up to a limit that is lower or higher without being reached.
            stretch = _Stretch(found[-1].position, point.end, point)
            point = _worded(stretch, plan)
            found.pop()
        found.append(point)
    return tuple(found)


def _braking(plan: _Plan, stretches: list[_Stretch]) -> list[tuple[float, float, float]]:
    """Start, end and final speed of the braking for each lower limit and for the stop."""
    found = list[tuple[float, float, float]]()
    for place, after in reversed(plan.falls()):
        target = rounded_down(after) if after > 1.0 / KMH else 0.0
        if found and _held_below(place, target, stretches, plan):
            continue
        if found:
            start, end, final = found[0]
            if end - place < DRIVEABLE * target and final > 0.0:
                # Two limits next to each other: the lower one by the first of them.
                found[0] = (plan.begin(place, min(final, target)), place, min(final, target))
                continue
            if start < place:
                rate = min(plan.rate(end), COMFORTABLE if final > 0.0 else np.inf)
                reach = float(np.sqrt(final**2 + 2.0 * rate * (end - place)))
                target = max(rounded_down(min(target, reach)), min(final, target))
                found[0] = (place, end, final)
        found.insert(0, (plan.begin(place, target), place, target))
    return found


def _held_below(place: float, target: float, stretches: list[_Stretch], plan: _Plan) -> bool:
    """Whether one speed not above `target` is held for long before and at a place."""
    for each in stretches:
        if each.point.hold and each.start < place < each.end:
            held = rounded_down(plan.usual(each.start, each.end)) <= target + 1e-9
            return held and plan.lasts(each.start, place) > 2.0 * _LONG_PARTIAL
    return False


def _split(each: _Stretch, plan: _Plan) -> list[_Stretch]:
    """A stretch in parts, where a limit that slows it rises on the way."""
    if plan.limits is None or each.target is not None or each.point.phase > Phase.COASTING:
        return [each]
    wanted = plan.extremes(each.start, each.end)[2]
    if each.point.hold:
        wanted = plan.usual(each.start, each.end)
    inside = (plan.limits.positions > each.start) & (plan.limits.positions < each.end)
    for place in plan.limits.positions[inside][::-1].tolist():
        before, after = plan.lowest_limit(each.start, place), plan.lowest_limit(place, each.end)
        if before < min(wanted, after) - 1e-6:
            first = _split(replace(each, end=place), plan)
            return [*first, *_split(replace(each, start=place), plan)]
    return [each]


def _with_braking(
    stretches: list[_Stretch], braking: list[tuple[float, float, float]], model: AdvicePoint
) -> list[_Stretch]:
    """The stretches, with the braking for limits and stops in the place of what was there."""
    found, left = list[_Stretch](), stretches[0].start
    for start, end, target in [*braking, (stretches[-1].end, stretches[-1].end, 0.0)]:
        for each in stretches:
            begin, stop = max(each.start, left), min(each.end, start)
            if begin < stop:
                found.append(replace(each, start=begin, end=stop))
        if start < end:
            phase = Phase.MAXIMUM_BRAKING
            brake = replace(model, phase=phase, hold=False)
            found.append(_Stretch(max(start, left), end, brake, target))
        left = end
    return found


def _without_partial(stretches: list[_Stretch], plan: _Plan) -> list[_Stretch]:
    """Short partial traction that goes on where full traction ends is full traction, too."""
    found = stretches[:1]
    for each in stretches[1:]:
        before, short = found[-1], plan.lasts(each.start, each.end) < _LONG_PARTIAL
        partial = each.point.phase is Phase.CRUISING and not each.point.hold
        if partial and short and before.point.phase is Phase.MAXIMUM_TRACTION:
            found[-1] = replace(before, end=each.end)
        else:
            found.append(each)
    return found


def _joined(stretches: list[_Stretch], plan: _Plan) -> list[_Stretch]:
    """Without what is too short to be driven, and without neighbours of one kind."""
    found = list[_Stretch]()
    begin: float | None = None
    for number, each in enumerate(stretches):
        if begin is not None:
            each, begin = replace(each, start=begin), None
        before = found[-1] if found else None
        if each.target is None and plan.lasts(each.start, each.end) < DRIVEABLE:
            if before is not None and before.target is None:
                following = stretches[number + 1] if number + 1 < len(stretches) else each
                gains = each.point.phase is Phase.MAXIMUM_TRACTION and following.target is None
                found[-1] = before if gains else replace(before, end=each.end)
                begin = each.start if gains else None
                continue
            if number + 1 < len(stretches) and before is not None:
                begin = each.start
                continue
        same = before is not None and before.kind == each.kind and not each.point.hold
        if same and before is not None and before.target is None and each.target is None:
            found[-1] = replace(before, end=each.end)
            continue
        found.append(each)
    return found


def _worded(each: _Stretch, plan: _Plan) -> AdvicePoint:
    """The point of a stretch: its speeds, and which not to exceed."""
    lowest, highest, highest_of_all = plan.extremes(each.start, each.end)
    limit = plan.lowest_limit(each.start, each.end)
    speed, until = plan.at([each.start, each.end]).tolist()
    phase, hold = each.point.phase, each.point.hold
    target, capped = until, False
    if each.target is not None:
        target = each.target
    elif hold:
        target = plan.usual(each.start, each.end)
    elif phase is Phase.MAXIMUM_TRACTION:
        target = each.point.target
    elif phase is Phase.COASTING:
        target = min(limit, plan.top)
        inside = (plan.places >= each.start) & (plan.places <= each.end)
        rises = np.any(np.diff(plan.speeds[:, inside], axis=1) > 0.0)
        capped = bool(rises and highest_of_all > target - _SLOW)
    target = min(target, limit, plan.top)
    return replace(
        each.point,
        position=each.start,
        time=float(np.interp(each.start, plan.places, plan.times)),
        speed=speed,
        until=until,
        end=each.end,
        target=rounded_down(target) if target > 0.0 else 0.0,
        lowest=lowest,
        highest=highest,
        permitted=limit if plan.limits is not None else None,
        capped=capped,
        course=plan.course(each.start, each.end),
    )
