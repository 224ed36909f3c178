"""The motion along a line from satellite fixes: chainage and speed with their standard deviations.

First the best chain of places along the line (`estimators.matching`): where a line comes close to
itself, continuity and direction decide. Then, a few times over: the fixes are projected where the
chain or the last turn's motion puts the train, what departs from it is set aside, and the motion is
smoothed anew (`estimators.motion`), with the noise that the receiver shows on this trip. Speed and
position never come from differences of raw values.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd
from scipy.special import stdtrit

from estimators.matching import FASTEST, EdgeGraph, LeftOut, best_chain, distances
from estimators.motion import (
    ACCELERATION_TIME,
    LASTING_TIME,
    LastingError,
    MotionModel,
    SmoothedMotion,
    smooth_motion,
)
from estimators.receiver import (
    LARGEST_GAP,
    Delay,
    ReceiverNoise,
    Series,
    WheelSpeeds,
    integral,
    mean_square,
    position_noise,
    series_of,
    speed_noise,
    structure,
    white_noise,
)
from estimators.receiver_states import LATE_STD, ReceiverStates, receiver_states
from trainlog.arrays import BoolArray, FloatArray, IntArray, robust_std
from trainlog.errors import InputError
from trainlog.ingest.clock import Result
from trainlog.ingest.matching import GEOMETRY_STD, EdgeTracks, edge_nodes, rough_noise
from trainlog.ingest.motion import (
    ALIKE,
    CHORD,
    ELSEWHERE,
    ENOUGH,
    FAR,
    GATE,
    MANY,
    MOVING,
    POSITION,
    RESTING,
    SEVERAL,
    SMALLEST_NOISE,
    SPAN,
    STAYED,
    SUSPECT,
    covered,
    held,
    rate_of,
    repeats,
    scale_of,
)
from trainlog.ingest.profile import Profile, Quantity
from trainlog.ingest.receiver import (
    ODOMETER_STD,
    OLDEST,
    REPLAYED,
    Driven,
    Fixes,
    common_delay,
    count_placed,
    delay_behind,
    distance_driven,
    extrapolated,
    fixes_of,
    hold_of,
    kept_on,
    late_throughout,
    slipping_wheels,
    unmeasured,
)
from trainlog.ingest.recording import MOST, NEARLY_ALL, Finding, Table
from trainlog.ingest.rules import quantum
from trainlog.railway.geometry import beside, candidates, nearest_on, track_of
from trainlog.railway.line import Geometry, Line
from trainlog.topics import ESTIMATED_STATE
from trainlog.trip import Trip, frame_of, seconds as seconds_of
from trainlog.units import NANOSECONDS

DRIFT = 0.1
"""Random walk [m/√s] of the chainage beyond the integral of the speed: curves cut short by the
geometry."""

AGE_STD = 3.0
"""Standard deviation of the age of an old fix [s]."""

LATE_TIME = 120.0
"""For how long [s] a receiver whose fixes are late stays equally late."""

TURNS = 5
"""Times the fixes are projected and the motion is smoothed, unless it has settled."""

WHEEL_TIME = 2.0
"""Time over which the errors of wheel speeds last [s]: creep goes with the effort."""

SPEED_SPREAD = 0.4, 1.2
"""Least and largest standard deviation of a train's acceleration [m/s²]: trains that rarely
change speed, trams."""

UNSEEN_SPREAD = 0.6
"""The least where no speed was measured."""

OUTAGE_DENSITY = 8.0
"""Spectral density of the acceleration in an outage [m²/s³]: a train brakes, stands and starts."""

FOLDS = 4
"""Parts in which fixes are left out and predicted."""

LEAST_FREEDOM = 3.0
"""Least number of independent values that the size of errors is taken to rest on."""

ODOMETER_DRIFT = 0.005
"""Share of the distance by which an odometer drifts."""

CLOCKS = 1.0
"""Time [s] by which odometer and receiver may be apart."""


TWO_TRIPS = "a log that runs in both directions is two trips: cut it by pause under [limits]"
"""Said of one whose fixes turn back."""


class AgainstLineError(InputError):
    """The fixes run against the direction of travel."""


class OnLine:
    """Fixes on a line: projected, sized, smoothed, what departs set aside, until all agrees.

    Parameters
    ----------
    geometry : Geometry
        Of the line as travelled.
    fixes : Fixes
        At least two of them with a position.
    gated : bool
        Whether fixes are rejected at all.
    slip_aware : bool
        Whether wheel speeds are set aside at all.
    speed_aware : bool
        Whether satellite speeds are set aside, or put back by their delay, at all.

    Attributes
    ----------
    chainage : (n,) array [m]
        Growing in the direction of travel; NaN where there is none.
    aside, judged : (n,) bool array
        Satellite speeds that are not used, by what was known before the motion and by the motion.
    computed : (n,) bool array
        Fixes that the receiver did not measure then: extrapolated, held or replayed ones. Those
        that were replayed count where they were measured.
    misplaced : (n,) bool array
        Fixes that are elsewhere while the speeds go on.
    slipping : (n,) bool array
        Wheel speeds that are not trusted.
    misfit : float [m]
        Standard deviation of the line's own place on the earth: what of the distance between line
        and fixes the receiver's noise does not explain.
    motion : SmoothedMotion
        At every row.
    position_noise, speed_noise : ReceiverNoise or None
        As estimated on this trip [m], [m/s].
    along_std : float [m]
        Of a further noise of the positions, along the line alone: fixes that come late.
    caught_up, late_rest, late_prior : (n,) array [m]
        How far the train was ahead of each fix when it came, where the receiver is late throughout,
        by how much that is more than it is for the mean lateness, and the standard deviation of
        that beforehand: the motion and how late each fix is are estimated together.
    aged_std : (n,) array [m]
        Standard deviation of the place of old fixes by that of their age; 0 for others.
    lateness : float [s]
        Mean of how late the fixes are while the train moves; 0 where they are not.
    delay : float [s]
        By which the satellite speed came later than the fixes; it was put back by it.
    common_delay : Delay
        By which fixes and satellite speed came later than the wheels' speed, NaN if that is not
        known; `motion` is that of the satellites' clock.

    Raises
    ------
    InputError
        If the fixes lie elsewhere or follow another line; if most of them are set aside.
    AgainstLineError
        If chainage falls while the train drives.
    """

    def __init__(
        self,
        geometry: Geometry,
        fixes: Fixes,
        *,
        gated: bool = True,
        slip_aware: bool = True,
        speed_aware: bool = True,
    ) -> None:
        self.gated, self.slip_aware = gated, slip_aware
        self.track = track = track_of(geometry)
        self.points = points = track.plane(fixes.latitude, fixes.longitude)
        self.known = np.isfinite(points)
        self.near, self.apart = nearest_on(track, points)
        self.aside = np.zeros(points.size, dtype=np.bool_)
        self.judged = self.misplaced = self.aside
        self.reasons_aside: Counter[str] = Counter()
        self.along_std = self.delay = 0.0
        self.caught_up, self.late_rest, self.late_prior = np.zeros((3, points.size))
        self.aged_std = np.zeros(points.size)
        self.lateness = 0.0
        self.common_delay = Delay(0.0, 0.0)
        self.speed_noise: ReceiverNoise | None = None
        self.position_noise = ReceiverNoise(1.0, 0.0, LASTING_TIME)
        self.chainage = np.full(points.size, np.nan)
        count = np.count_nonzero(self.known)
        std, self.misfit = rough_noise(fixes.std, self.apart)
        if self.misfit > FAR:
            raise InputError(
                f"half of the {count} fixes lie"
                f" {np.nanmedian(self.apart) / 1e3:.1f} km or more from the line",
                remedy="give the line that was driven",
            )
        self.computed = extrapolated(fixes.seconds, points) | kept_on(fixes.seconds, points, std)
        self.computed &= gated
        points[self.computed] = np.nan
        self.hold = hold_of(fixes.seconds, fixes.speed)
        self.fixes = replace(fixes, std=std, speed=fixes.speed.copy())
        if speed_aware:
            self._set_doubtful_aside()
        fitting, course = self._roughly(speed_aware)
        self.known = np.isfinite(points) & ~self.misplaced
        self.motion = self._run(course, fitting)
        if gated and np.count_nonzero(self.rejected | self.computed) > MOST * count:
            raise self._too_few()

    @property
    def rejected(self) -> BoolArray:
        """Fixes that were measured and give no chainage, (n,)."""
        return np.asarray(np.isfinite(self.points) & ~np.isfinite(self.chainage))

    def _too_few(self) -> InputError:
        count = np.count_nonzero(np.isfinite(self.points) | self.computed)
        return InputError(
            f"{np.count_nonzero(self.rejected | self.computed)} of {count} fixes were set aside"
            f" ({np.count_nonzero(self.computed)} extrapolated, held or replayed, the others"
            " away from line or motion): what is left determines no chainage",
            remedy="give the line that was driven, or another recording of the trip",
        )

    @property
    def reasons(self) -> str:
        """Why speeds are not used, in words."""
        counts = self.reasons_aside.copy()
        if further := int(np.count_nonzero(self.judged & ~self.aside)):
            counts["contradicted"] += further
        found = [f"{count} {reason}" for reason, count in counts.items()]
        if self.delay:
            found.append(f"all {self.delay:.1f} s late")
        if self.common_delay.value > 0.0:
            late, std = self.common_delay.value, self.common_delay.std
            found.append(f"with the fixes {late:.2f} s (standard deviation {std:.2f} s) late")
        return ", ".join(found)

    # -------------------------------------------------------------- before the motion is known

    def _without_speeds(self, reason: str, flags: BoolArray) -> None:
        speed = self.fixes.speed
        flags = flags & np.isfinite(speed)
        if flags.any():
            self.reasons_aside[reason] += int(np.count_nonzero(flags))
        self.aside = self.aside | flags
        self.fixes = replace(self.fixes, speed=np.where(flags, np.nan, speed))

    def _set_doubtful_aside(self) -> None:
        """Set aside speeds of extrapolated fixes, and all where the unit is another."""
        seconds = self.fixes.seconds
        if np.count_nonzero(np.isfinite(self.fixes.speed)) < 2:
            return
        self._without_speeds("extrapolated", self.computed)
        scale = scale_of(seconds, self.points, self.fixes.speed)
        if np.isfinite(scale) and not 1.0 / SUSPECT < scale < SUSPECT:
            every = np.isfinite(self.fixes.speed)
            self._without_speeds(f"{scale:.2f} times what positions show", every)

    def _roughly(self, speed_aware: bool) -> tuple[BoolArray, FloatArray]:
        """Which fixes fit the chain, and a rough chainage at every row [m]; it judges speeds."""
        std = np.sqrt(self.fixes.std**2 + self.misfit**2 + GEOMETRY_STD**2)
        driven = distance_driven(self.fixes, slip_aware=self.slip_aware)
        self.slipping = driven.slipping
        chain = self._chain(std, driven)
        course = self._course(chain)
        chainage, aside = beside(self.track, self.points, course)
        judged = speed_aware and np.count_nonzero(np.isfinite(self.fixes.speed)) > 1
        if judged:
            self._put_speeds_back(chainage)
        if self.gated and speed_aware:
            chainage = self._judge_fixes(chainage, std)
            course = self._course(chainage)
        aside = np.where(np.isfinite(chainage), aside, np.nan)
        spread = robust_std(aside[~np.isnan(aside)])
        fitting = np.isfinite(chainage)
        if self.gated:
            unsure = np.hypot(spread, std)
            fitting &= np.hypot(aside / unsure, (chainage - course) / unsure) < GATE
        if speed_aware:
            fit = np.where(fitting, chainage, np.nan)
            self.common_delay = common_delay(self.fixes, fit)
            if self.common_delay.value > 0.0:
                self.fixes = self.fixes.with_late_wheels(self.common_delay.value)
                driven = distance_driven(self.fixes, slip_aware=self.slip_aware)
                self.slipping = driven.slipping
        return fitting, course

    def _course(self, chainage: FloatArray) -> FloatArray:
        """A chainage at every row [m], between those that are known by the distance driven."""
        seconds = self.fixes.seconds
        driven = distance_driven(self.fixes, slip_aware=self.slip_aware).distance
        nodes = np.flatnonzero(np.isfinite(chainage))
        if not np.isfinite(driven).all():
            return np.asarray(np.interp(seconds, seconds[nodes], chainage[nodes]))
        return driven + np.interp(seconds, seconds[nodes], (chainage - driven)[nodes])

    def _put_speeds_back(self, chainage: FloatArray) -> None:
        """Put speeds that come later than the fixes back by their delay."""
        seconds, used = self.fixes.seconds, self.fixes.speed
        known = np.flatnonzero(np.isfinite(used))
        self.delay = delay_behind(WheelSpeeds(seconds[known], used[known]), seconds, chainage)
        if self.delay:
            at = seconds + self.delay
            put_back = np.interp(at, seconds[known], used[known])
            _, missing = integral(seconds, used)
            whole = np.interp(at, seconds, missing) - missing < 1e-6
            inside = (at <= seconds[known[-1]]) & whole & np.isfinite(used)
            self.fixes = replace(self.fixes, speed=np.where(inside, put_back, np.nan))

    def _judge_fixes(self, chainage: FloatArray, std: FloatArray) -> FloatArray:
        """Where the train was at each row of a fix [m]; NaN for wrong ones.

        Old fixes are put where they were measured; those of a receiver that is late throughout are
        brought forward by the speeds.
        """
        if self.misfit > STAYED or np.count_nonzero(np.isfinite(chainage)) < ENOUGH:
            # Places on another line show nothing of the receiver.
            return chainage
        seconds = self.fixes.seconds
        driven = distance_driven(self.fixes, slip_aware=self.slip_aware).distance
        if not np.isfinite(driven).all():
            places = series_of(seconds, chainage, 10.0)
            if places.seconds.size < 2:
                return chainage
            mean, *usual = _usual_speed(places)
            even, none = mean * seconds, np.zeros(seconds.size)
            found = receiver_states(seconds, chainage, std, even, none, *usual)
            known = np.isfinite(chainage)
            most = np.mean((found.age >= REPLAYED)[known] | found.wrong[known]) > MOST
            return chainage if most else self._put_in_time(found, chainage, measured=False)
        speed = unmeasured(seconds, self.fixes.any_speed)
        found = receiver_states(seconds, chainage, std, driven, speed.unsure)
        late = late_throughout(seconds, chainage, driven, found.age, std, speed)
        if late is not None:
            self._bring_forward(late.value)
            chainage = chainage + self.caught_up
            std = np.hypot(std, late.std * speed.pace)
            found = receiver_states(seconds, chainage, std, driven, speed.unsure)
        kept = self._kept_until(found.doubted)
        self.computed |= kept & np.isfinite(self.points)
        self.points[kept] = np.nan
        self._without_speeds("contradicted", found.doubted | kept)
        return self._put_in_time(found, np.where(kept, np.nan, chainage))

    def _kept_until(self, doubted: BoolArray) -> BoolArray:
        """Rows at which a receiver keeps its speed and place until it is elsewhere at once."""
        seconds, known = self.fixes.seconds, np.flatnonzero(np.isfinite(self.points))
        pace = np.abs(np.diff(self.points[known])) / np.diff(seconds[known])
        leaps = np.zeros(doubted.size, dtype=np.bool_)
        leaps[known[1:][pace > FASTEST]] = True
        runs = repeats(self.fixes.speed)
        rests = runs.samples >= SEVERAL
        first, last = runs.known[runs.first[rests]], runs.known[runs.last[rests]]
        soon = np.searchsorted(seconds, seconds[last] + RESTING) - 1
        for flags in (leaps, doubted):
            count = np.cumsum(flags)
            found = count[soon] > count[first]
            first, last, soon = first[found], last[found], soon[found]
        return covered(first, last + 1, doubted.size)

    def _bring_forward(self, age: FloatArray) -> None:
        """Bring the fixes of a receiver that is late throughout forward, by their age [s].

        An error of that age by a second is one by the way that the train came in a second then.
        """
        seconds, pace = self.fixes.seconds, self.fixes.any_speed
        known = np.isfinite(pace)
        driven = distance_driven(self.fixes, slip_aware=self.slip_aware).distance
        self.caught_up = driven - np.interp(seconds - age, seconds, driven)
        pace = np.interp(seconds - age, seconds[known], pace[known])
        self.lateness = float(np.mean(age[np.isfinite(self.points) & (pace > MOVING)]))
        self.late_rest, self.late_prior = (age - self.lateness) * pace, LATE_STD * pace

    def _put_in_time(
        self, found: ReceiverStates, chainage: FloatArray, *, measured: bool = True
    ) -> FloatArray:
        """The chainage with old fixes at the rows of when they were measured, without wrong ones.

        Without a `measured` speed nothing shows how fast a receiver catches up: while it does, its
        fixes are left out.
        """
        seconds, points = self.fixes.seconds, self.points.copy()
        age = np.where(np.isfinite(chainage), found.age, np.nan)
        old = held(age, seconds, REPLAYED - 0.5, 0.5)
        steady = measured | (np.abs(rate_of(seconds, age)) < ALIKE)
        self.computed |= old & np.isfinite(points)
        self.misplaced = found.wrong & ~old
        placed = np.where(old | self.misplaced, np.nan, chainage)
        self.points[old] = np.nan
        rows = np.flatnonzero(old & steady & ~found.wrong & np.isfinite(chainage))
        then = np.searchsorted(seconds, np.maximum(seconds[rows] - found.age[rows], seconds[0]))
        free = ~np.isfinite(self.points[then])
        rows, then = rows[free], then[free]
        self.points[then], placed[then] = points[rows], chainage[rows]
        self.fixes.std[then] = self.fixes.std[rows]
        following = np.append(then[1:], 0)
        close = np.diff(seconds[then], append=np.inf) < OLDEST
        aged = covered(then, np.where(close, following, then + 1), seconds.size)
        pace = np.maximum(rate_of(seconds, self._course(placed)), MOVING)
        self.aged_std = np.where(aged, AGE_STD * pace, 0.0)
        return placed

    def _chain(self, std: FloatArray, driven: Driven) -> FloatArray:
        """Chainage of the fixes in the best chain, NaN for all others.

        Raises
        ------
        InputError
            If most fixes follow no chain, or one against the line.
        """
        fixes, known = self.fixes, np.flatnonzero(np.isfinite(self.points))
        _, first = np.unique(np.floor(fixes.seconds[known] / SPAN), return_index=True)
        chosen = known[first]
        places = candidates(self.track, self.points[chosen], GATE * std[chosen])
        one = np.zeros(places.owner.size, dtype=np.int64)
        graph = EdgeGraph(self.track.positions[-1:], np.zeros((0, 2), dtype=np.int64))
        edges = EdgeTracks(graph, (self.track,), self.track.origin)
        found = places.owner, one, places.chainage, places.distance
        nodes = edge_nodes(edges, fixes, chosen, std[chosen], driven, found)
        # On a line the train does not turn round.
        nodes = nodes._replace(stood=np.zeros(chosen.size, dtype=np.bool_))
        between = distances(graph, np.zeros(1, dtype=np.int64))
        chain, back = (
            best_chain(graph, nodes, between, only, absence=np.inf)
            for only in (LeftOut(course, -np.inf, np.inf, between) for course in (1, 0))
        )
        backwards = nodes.chainage[back.candidate]
        if back.worth > chain.worth and np.ptp(backwards) > FAR:
            near = self.near[known[np.isfinite(self.near[known])][[0, -1]]] / 1e3
            raise AgainstLineError(
                f"the fixes run from km {near[0]:.3f} to km {near[1]:.3f},"
                " against the direction of travel",
                remedy="correct the direction, 'reverse' instead of 'forward' or vice versa, or"
                " leave it out (--reverse, direction= in Python, direction under [trip] of the"
                " profile): the fixes of each trip give it",
            )
        if not chain.node.size:
            raise InputError(
                f"none of {known.size} fixes lies as near to the line as its accuracy says",
                remedy="give the line that was driven",
            )
        near_line = np.count_nonzero(np.diff(nodes.first))
        against = backwards[~np.isin(back.node, chain.node)]
        returns = against.size > 0.25 * chain.node.size and np.ptp(against) > FAR
        if self.gated and (returns or chain.node.size < 0.5 * near_line):
            raise InputError(
                f"only {chain.node.size / near_line:.0%} of the fixes near the line follow it in"
                " one direction",
                remedy=f"give the line that was driven; {TWO_TRIPS}",
            )
        chainage = np.full(self.points.size, np.nan)
        chainage[chosen[chain.node]] = nodes.chainage[chain.candidate]
        return chainage

    # -------------------------------------------------------------- the motion, turn by turn

    def _run(self, course: FloatArray, fitting: BoolArray) -> SmoothedMotion:
        """The motion; `course` and `fitting` are the first guess of position and good fixes."""
        seconds = self.fixes.seconds
        position, pace = course, np.gradient(course, seconds)
        motion = None
        for _ in range(TURNS):
            chainage, aside = beside(self.track, self.points, position - self.caught_up)
            chainage += self.caught_up
            if motion is not None and self.gated:
                fitting = self.known & ~self._departs(chainage, aside, motion)
                self._judge_speeds(motion)
            self.chainage = np.where(fitting, chainage, np.nan)
            if np.count_nonzero(fitting) < 2:
                if motion is None:
                    raise self._too_few()
                break
            self._size(np.where(fitting, aside, np.nan), pace, smoothed=motion is not None)
            beside_line = np.abs(aside) < GATE * self._usual(aside)
            self._size_along(np.where(np.isfinite(self.points) & beside_line, chainage, np.nan))
            last, motion = position, self._smoothed()
            position, pace = motion.position, motion.speed
            if self.lateness:
                age = self.lateness - LATE_STD * motion.lasting[:, 1]
                self._bring_forward(np.maximum(age, 0.0))
            ratio = 1.0 - motion.wheel_error
            self.slipping = (
                slipping_wheels(self.fixes, motion.speed, motion.speed_std, ratio) & self.slip_aware
            )
            if np.abs(position - last).max() < 0.1:
                break
        found = self._smoothed() if motion is None else motion
        if not self.lateness:
            return found
        # Only the places where the train stands count: few, and off for long. No number of fixes
        # that are late together shows by how much.
        late = self.position_noise.std
        return replace(
            found,
            position_std=np.hypot(found.position_std, late),
            speed_std=np.hypot(found.speed_std, late / LASTING_TIME),
        )

    def _size(self, aside: FloatArray, pace: FloatArray, *, smoothed: bool) -> None:
        """Estimate the noise of positions and speeds, and the train's agility, on this trip."""
        seconds, fixes = self.fixes.seconds, self.fixes
        self.relative = _relative_accuracy(fixes.std, aside)
        moving = pace > MOVING
        enough = np.count_nonzero(np.isfinite(aside) & moving) > MANY
        values = np.where(moving, aside, np.nan) if enough else aside
        series = series_of(seconds, values / self.relative)
        self.position_noise = position_noise(series.seconds, series.values)
        self._size_misfit(series.values, series.seconds)
        of_fix = series_of(seconds, self.chainage)
        self.position_count = np.where(of_fix.owner >= 0, of_fix.count[of_fix.owner], 1)
        speed = np.where(self.judged, np.nan, fixes.speed)
        self._size_agility(pace)
        if np.count_nonzero(np.isfinite(speed)) < 20:
            self.speed_noise = None
            return
        shown = series_of(seconds, speed)
        self.speed_count = np.where(shown.owner >= 0, shown.count[shown.owner], 1)
        driven, missing = integral(seconds, speed)
        along = series_of(seconds, np.where(self.aged_std > 0.0, np.nan, self.chainage - driven))
        whole = np.round(np.interp(along.seconds, seconds, missing), 6)
        dense = float(np.median(np.diff(shown.seconds))) < 2.0
        of_moving = shown.values[shown.values > MOVING]
        white = white_noise(of_moving, self.hold) if dense else 0.0
        white = max(white, SMALLEST_NOISE[1])
        if self.lateness:
            # How late fixes are changes: their places show nothing of the speeds' errors.
            found = ReceiverNoise(white if dense else float(np.median(fixes.speed_std)), 0.0, 10.0)
        else:
            beside_track = structure(series.seconds, series.values)[:2]
            found = speed_noise(along.seconds, along.values, whole, beside_track, white)
        # The speeds depart from the motion by no less than their noise.
        apart = mean_square(series_of(seconds, speed - pace).values) if smoothed else 0.0
        lasting = float(np.sqrt(max(apart - found.white**2, found.lasting**2, 0.0)))
        self.speed_noise = ReceiverNoise(found.white, lasting, found.time)

    def _size_misfit(self, aside: FloatArray, seconds: FloatArray) -> None:
        """The line's misfit: what of the distances neither noise nor stated accuracy explains."""
        noise = self.position_noise
        stated = float(np.median(self.fixes.std[self.known]))
        apart = np.minimum(np.diff(seconds, prepend=seconds[0]), noise.time)
        lasting = min(noise.time / max(float(apart.sum()), noise.time), 1.0)
        share = noise.lasting**2 / max(noise.std**2, 1e-12)
        independent = share**2 * lasting + (1.0 - share**2) / max(aside.size, 1)
        total = mean_square(aside)
        explained = max(noise.std, stated) ** 2 * (1.0 + np.sqrt(2.0 * independent))
        self.misfit = float(np.sqrt(max(0.0, total - explained)))
        # What the differences do not show but is no misfit lasts.
        rest = total - self.misfit**2 - noise.std**2
        lasting_std = float(np.sqrt(noise.lasting**2 + max(rest, 0.0)))
        self.position_noise = ReceiverNoise(noise.white, lasting_std, noise.time)
        # A size from few independent values is unsure, the more as errors have heavy tails:
        # Student's t in place of the normal.
        # Of a receiver that is late throughout, only what it shows of a slow train counts.
        slow = np.interp(seconds, self.fixes.seconds, self.late_prior) < noise.std
        freedom = max(float(apart[slow].sum()) / (4.0 * noise.time), LEAST_FREEDOM)
        self.unsure = float(stdtrit(freedom, 0.975)) / 1.96

    def _size_along(self, chainage: FloatArray) -> None:
        """Noise along the line alone, from fixes that are left out and predicted by the others.

        A fix that comes late, as phones replay them, lies on the line, behind the train: what
        departs beside the line does not show it. Only where fixes are rare or come without a speed;
        else the integral of the speed shows it.
        """
        seconds = self.fixes.seconds
        known = np.flatnonzero(np.isfinite(chainage))
        spacing = float(np.median(np.diff(seconds[known]))) if known.size > 1 else 0.0
        if known.size < ENOUGH or (spacing < LARGEST_GAP and self.speed_noise is not None):
            return
        _, first = np.unique(np.floor(seconds / max(0.5 * spacing, 1.0)), return_index=True)
        rows = np.unique(np.concatenate([first, known])) if spacing >= 1.0 else first
        seen = np.isfinite(chainage[rows]) & (np.isfinite(self.chainage[rows]))
        judged = np.isfinite(chainage[rows])
        number = np.floor(seconds[rows] / max(RESTING, 1.01 * spacing)).astype(np.int64) % FOLDS
        own = self._position_std()[rows]
        for _ in range(4):
            error, std = np.full(rows.size, np.nan), np.ones(rows.size)
            for fold in range(FOLDS):
                out = number == fold
                given = np.where(seen & ~out, chainage[rows], np.nan)
                if np.count_nonzero(np.isfinite(given)) < 4:
                    continue
                motion = self._smoothed(given, rows=rows)
                asked = out & judged
                error[asked] = (chainage[rows] - motion.position)[asked]
                std[asked] = np.hypot(motion.position_std, np.hypot(own, self.along_std))[asked]
            found = np.isfinite(error)
            if np.count_nonzero(found) < ENOUGH:
                return
            ratio = float(np.quantile(np.abs(error[found]) / std[found], 0.95)) / 1.96
            if ratio < 1.05:
                return
            usual = np.median(np.hypot(own, self.along_std)[found])
            self.along_std = float(np.hypot(self.along_std, usual * np.sqrt(ratio**2 - 1.0)))
            self.along_std = min(self.along_std, FAR)

    def _position_std(self) -> FloatArray:
        """Standard deviation of each fix [m]."""
        noise = self.position_noise
        white = np.hypot(noise.white, SMALLEST_NOISE[0]) * np.sqrt(self.position_count)
        return np.asarray(np.hypot(white, noise.lasting) * self.relative)

    def _usual(self, aside: FloatArray) -> FloatArray:
        """Usual distance of each fix beside the line, as a standard deviation [m]."""
        size = robust_std((aside / self.relative)[self.known])
        return np.hypot(max(size, SMALLEST_NOISE[0]) * self.relative, GEOMETRY_STD)

    def _size_agility(self, pace: FloatArray) -> None:
        """Standard deviation of the acceleration, from the changes of speed over `RESTING`."""
        seconds = self.fixes.seconds
        even = np.arange(seconds[0], seconds[-1], RESTING)
        change = np.diff(np.interp(even, seconds, pace))
        share = RESTING / ACCELERATION_TIME
        per_unit = 2.0 * ACCELERATION_TIME**2 * (share + np.expm1(-share))
        size = float(np.sqrt(np.mean(change**2) / per_unit)) if change.size else 0.0
        least, most = SPEED_SPREAD
        if np.count_nonzero(np.isfinite(self.fixes.speed)) < 20:
            # Smoothed positions hide how hard a train brakes: any train then.
            least = UNSEEN_SPREAD
        self.acceleration_std = float(np.clip(size, least, most))
        measured = np.isfinite(self.chainage) | np.isfinite(self.fixes.any_speed)
        usual = 2.0 * self.acceleration_std**2 * ACCELERATION_TIME
        outage = _apart(seconds, measured) > CHORD
        self.unmeasured = np.where(outage, max(OUTAGE_DENSITY / usual, 1.0), 1.0)

    def _smoothed(
        self, along: FloatArray | None = None, rows: IntArray | slice = slice(None)
    ) -> SmoothedMotion:
        """The motion by the chainage, or by other positions of some rows."""
        fixes, noise, speeds = self.fixes, self.position_noise, self.speed_noise
        white = np.maximum(noise.white, SMALLEST_NOISE[0]) * np.sqrt(self.position_count)
        speed = np.where(self.judged, np.nan, fixes.speed)
        speed_white = fixes.speed_std
        if speeds is not None:
            speed_white = np.maximum(speeds.white, SMALLEST_NOISE[1]) * np.sqrt(self.speed_count)
        wheels, wheel_std = fixes.wheel_speed, fixes.wheel_speed_std
        if wheels is not None and wheel_std is not None:
            step = float(np.median(np.diff(fixes.seconds[np.isfinite(wheels)])))
            wheels = np.where(self.slipping, np.nan, wheels)[rows]
            # White noise of this size carries as much, taken together, as errors that last.
            wheel_std = (wheel_std * np.sqrt(max(1.0, 2.0 * WHEEL_TIME / step)))[rows]
        lasting = np.hypot(self.unsure * noise.lasting * self.relative, GEOMETRY_STD)
        errors = [LastingError(lasting[rows], noise.time)]
        if self.lateness:
            errors.append(LastingError(self.late_prior[rows], LATE_TIME))
        if self.aged_std.any():
            errors.append(LastingError(self.aged_std[rows], LATE_TIME))
        if speeds is not None:
            errors.append(LastingError(speeds.lasting, speeds.time, "speed"))
        return smooth_motion(
            fixes.seconds[rows],
            speed[rows],
            speed_white[rows],
            (self.chainage[rows] if along is None else along) - self.late_rest[rows],
            np.hypot(white * self.relative, self.along_std)[rows],
            errors=errors,
            wheel_speed=wheels,
            wheel_speed_std=wheel_std,
            model=MotionModel(
                acceleration_std=self.acceleration_std,
                drift=DRIFT,
                unmeasured=self.unmeasured[rows],
            ),
        )

    def _departs(
        self, chainage: FloatArray, aside: FloatArray, motion: SmoothedMotion
    ) -> BoolArray:
        """Fixes that do not go with the motion, along the line or beside it."""
        std = self._usual(aside)
        spread = np.sqrt(std**2 + motion.position_std**2 + self.along_std**2 + self.aged_std**2)
        along = (chainage - motion.position) / spread
        departure = np.hypot(along, aside / std)
        # Where most depart it is the motion that is away: those depart that do so most.
        departure /= max(float(np.median(departure[self.known])), 1.0)
        # So do those beyond the ends of the line, by more than their own error.
        (begin, end), margin = self.track.positions[[0, -1]], GATE * std
        departure[(chainage < begin - margin) | (chainage > end + margin)] = np.inf
        return held(departure, self.fixes.seconds)

    def _judge_speeds(self, motion: SmoothedMotion) -> None:
        """Set aside the speeds that do not go with the motion."""
        noise = self.speed_noise
        if noise is None:
            return
        std = np.hypot(noise.white * np.sqrt(self.speed_count), noise.lasting)
        apart = np.abs(self.fixes.speed - motion.speed)
        departure = apart / np.hypot(std, motion.speed_std)
        self.judged = held(departure, self.fixes.seconds)


def _usual_speed(places: Series) -> tuple[float, float, float]:
    """Mean and standard deviation of the speed [m/s], and for how long it stays alike [s].

    From two places or more.
    """
    step = np.diff(places.seconds)
    speed = np.diff(places.values) / step
    # Stands are speeds, too.
    speed = np.maximum(speed, 0.0)
    mean = float(np.mean(speed))
    spread = max(float(np.var(speed)), (0.5 * mean) ** 2)
    close = (step[1:] < 25.0) & (step[:-1] < 25.0)
    change = 1.5 * mean_square(np.diff(speed)[close]) / float(np.median(step))
    return mean, np.sqrt(spread), float(np.clip(2.0 * spread / max(change, 1e-9), 5.0, 120.0))


def _apart(seconds: FloatArray, measured: BoolArray) -> FloatArray:
    """Time between the measurements on both sides of each step [s]."""
    at = np.flatnonzero(measured)
    if not at.size:
        return np.full(seconds.size, np.inf)
    after = np.searchsorted(at, np.arange(seconds.size))
    later = seconds[at[np.minimum(after, at.size - 1)]]
    return np.asarray(later - seconds[at[np.maximum(after - 1, 0)]])


def _relative_accuracy(stated: FloatArray, aside: FloatArray) -> FloatArray:
    """What the stated accuracies say of the fixes beside each other, with a median of 1.

    A power of them, 0, 1/2 or 1: that under which the distances beside the track are likeliest.
    """
    used = np.isfinite(aside)
    unit = stated / float(np.median(stated[used]))
    best, chosen = np.inf, 0.0
    for power in (0.0, 0.5, 1.0):
        scaled = np.abs(aside[used]) / unit[used] ** power
        size = max(robust_std(scaled), 1e-6)
        # Negative log-likelihood of Laplace's distribution, whose tails are heavy.
        value = np.log(size) + float(np.mean(power * np.log(unit[used]) + scaled / size))
        if value < best - 0.01:
            best, chosen = value, power
    return np.asarray(unit**chosen)


# ------------------------------------------------------------------ the estimated state


@dataclass(frozen=True, eq=False)
class Estimate:
    """What could be estimated: the frame, if any, what was found, and the metadata of it."""

    frame: pd.DataFrame | None = None
    findings: tuple[Finding, ...] = ()
    metadata: dict[str, str] = field(default_factory=dict)


def estimated_state(
    trip: Trip, line: Line | None, profile: Profile, unplaced: Sequence[tuple[int, int]] = ()
) -> Estimate:
    """The ``/estimates/state`` frame of a trip, if its data give one.

    From fixes and satellite speed on a line with geometry; else from the wheels' speed and the
    profile's start position, where no position was recorded.

    Parameters
    ----------
    line : Line or None
        As travelled.

    Raises
    ------
    InputError
        If the fixes lie elsewhere, or, as `AgainstLineError`, run against the line.
    """
    geometry = line.geometry if line is not None else None
    if geometry is not None and count_placed(trip) > 1:
        fixes = _placed(fixes_of(trip), unplaced)
        matched = OnLine(
            geometry,
            fixes,
            gated=profile.repair.off_line,
            slip_aware=profile.repair.slip,
            speed_aware=profile.repair.contradicted,
        )
        metadata = _noise_of(matched)
        if fixes.row_time:
            metadata["receiver.held_rows"] = f"{fixes.row_time:g}"
        usable = np.isfinite(matched.chainage).sum() > 1
        frame = _smoothed_fixes(fixes, matched) if usable else None
        return Estimate(frame, _findings(fixes, matched), metadata)
    start = profile.trip.start_position
    if not isinstance(start, Quantity) or "/train/state" not in trip:
        return Estimate()
    state = trip["/train/state"]
    if state["position"].notna().any() or not state["speed"].notna().any():
        return Estimate()
    index = pd.DatetimeIndex(state.index)
    motion = smooth_motion(seconds_of(state), state["speed"].to_numpy(), ODOMETER_STD)
    return Estimate(_frame(index, motion, start.si("m")))


def position_offset(table: Table, estimate: pd.DataFrame) -> Result:
    """Shift recorded positions by a constant offset from the fixes; take away what contradicts.

    An odometer that drifts by up to `ODOMETER_DRIFT` of the distance does not contradict the fixes.

    Parameters
    ----------
    table : Table
        In order of time.
    estimate : DataFrame
        ``/estimates/state`` from the fixes.
    """
    position = table.signals.get(POSITION)
    if position is None:
        return table, []
    known = pd.DatetimeIndex(estimate.index).as_unit("ns").asi8
    rows = np.flatnonzero(np.isfinite(position) & _near(table.time, known))
    if rows.size < ENOUGH:
        return table, []
    chainage, std, speed = (
        np.interp(table.time[rows], known, estimate[name].to_numpy())
        for name in ("position", "position_std", "speed")
    )
    off = position[rows] - chainage
    least = np.maximum(ELSEWHERE, GATE * std) + (quantum(position) or 0.0)
    drifted = least + ODOMETER_DRIFT * np.ptp(chainage) + CLOCKS * speed
    offset = float(np.median(off))
    beyond, agreeing = np.sign(offset) * off > least, np.abs(off - offset) <= drifted
    constant = min(np.mean(beyond), np.mean(agreeing)) >= NEARLY_ALL
    shift = offset if constant else 0.0
    wrong = np.abs(off - shift) > drifted
    if not (shift or wrong.any()):
        return table, []
    away = np.interp(table.time, table.time[rows], wrong) >= 0.5
    if shift:
        size = "too large" if shift > 0.0 else "too small"
        note = f"the distance was {abs(shift) / 1e3:.3f} km off the fixes, {size}; put back"
    else:
        note = (
            f"the distance is {np.min(off) / 1e3:+.3f} to {np.max(off) / 1e3:+.3f} km off the"
            " fixes, by no constant offset"
        )
    if np.mean(wrong) > MOST:
        away[:] = True
        note += "; none of it is used"
    elif away.any():
        note += "; it is absent where it contradicts them"
    moved = np.where(away, np.nan, position - shift)
    changed = np.isfinite(position) & (moved != position)
    return table.with_values(POSITION, moved), table.found(
        "position_offset", changed, POSITION, note
    )


def _near(time: IntArray, known: IntArray) -> BoolArray:
    """Which times lie in no gap of the estimate, and neither before nor after it."""
    after = np.searchsorted(known, time)
    inside = (after > 0) & (after < known.size)
    after = np.clip(after, 1, known.size - 1)
    return inside & (known[after] - known[after - 1] <= LARGEST_GAP * NANOSECONDS)


def _placed(fixes: Fixes, unplaced: Sequence[tuple[int, int]]) -> Fixes:
    """The fixes without positions between some times [ns]."""
    time = fixes.index.as_unit("ns").asi8
    lost = np.zeros(time.size, dtype=np.bool_)
    for first, last in unplaced:
        lost |= (time >= first) & (time <= last)
    if not lost.any():
        return fixes
    latitude, longitude = (
        np.where(lost, np.nan, each) for each in (fixes.latitude, fixes.longitude)
    )
    return replace(fixes, latitude=latitude, longitude=longitude)


def _findings(fixes: Fixes, matched: OnLine) -> tuple[Finding, ...]:
    """What was set aside, by rule."""
    count = int(np.count_nonzero(matched.computed))
    computed = f"{count} extrapolated, held or replayed by the receiver" if count else ""
    late_by = f"late by {matched.lateness:.1f} s in the mean; brought forward by the speeds"
    # A delay of fixes and speeds together concerns every speed.
    late = np.isfinite(fixes.speed) & (matched.common_delay.value > 0.0)
    speeds = matched.aside | matched.judged | late
    behind = np.isfinite(matched.chainage) & (matched.lateness > 0.0)
    counts = (
        ("contradicted", speeds, "/gnss/motion.speed", matched.reasons),
        ("off_line", matched.rejected | matched.computed, "/gnss/fix", computed),
        ("slip", matched.slipping, "/train/state.speed", ""),
        ("contradicted", behind, "/gnss/fix", late_by),
    )
    return tuple(
        Finding(rule, int(np.count_nonzero(flags)), (), column, note)
        for rule, flags, column, note in counts
        if flags.any()
    )


def _noise_of(matched: OnLine) -> dict[str, str]:
    """What was found of the receiver and the line, as metadata."""
    noise = matched.position_noise
    found = {
        "line.misfit": f"{matched.misfit:.1f}",
        "receiver.position_std": f"{noise.std:.1f}",
        "receiver.position_time": f"{noise.time:.0f}",
    }
    if matched.along_std:
        found["receiver.along_std"] = f"{matched.along_std:.0f}"
    if matched.speed_noise is not None:
        found["receiver.speed_std"] = f"{matched.speed_noise.std:.2f}"
        found["receiver.speed_time"] = f"{matched.speed_noise.time:.0f}"
    if matched.lateness:
        found["receiver.lateness"] = f"{matched.lateness:.1f}"
    if matched.delay:
        found["receiver.speed_delay"] = f"{matched.delay:.2f}"
    if matched.common_delay.value > 0.0:
        found["receiver.delay"] = f"{matched.common_delay.value:.2f}"
        found["receiver.delay_std"] = f"{matched.common_delay.std:.2f}"
    elif np.isnan(matched.common_delay.value):
        found["receiver.delay"] = "not known"
    return found


def _smoothed_fixes(fixes: Fixes, matched: OnLine) -> pd.DataFrame:
    """Smoothed motion over the span in which fixes were matched."""
    known = np.flatnonzero(np.isfinite(matched.chainage))
    span = slice(int(known[0]), int(known[-1]) + 1)
    # Where the line itself is misplaced no number of fixes helps.
    motion = _on_time(fixes.seconds, matched)
    std = np.hypot(motion.position_std, matched.misfit)
    return _frame(fixes.index, replace(motion, position_std=std), 0.0).iloc[span]


def _on_time(seconds: FloatArray, matched: OnLine) -> SmoothedMotion:
    """The motion on the table's clock, its band wider by what is not known of the delay."""
    motion, late = matched.motion, matched.common_delay
    if not late.value > 0.0:
        return motion
    at = seconds + late.value

    def earlier(values: FloatArray) -> FloatArray:
        return np.asarray(np.interp(at, seconds, values))

    beyond = np.maximum(at - seconds[-1], 0.0)
    speed, acceleration = earlier(motion.speed), earlier(motion.acceleration)
    return replace(
        motion,
        position=earlier(motion.position) + speed * beyond,
        position_std=np.hypot(earlier(motion.position_std), late.std * speed),
        speed=speed,
        speed_std=np.hypot(earlier(motion.speed_std), late.std * acceleration),
        acceleration=acceleration,
        acceleration_std=earlier(motion.acceleration_std),
    )


def _frame(index: pd.DatetimeIndex, motion: SmoothedMotion, start: float) -> pd.DataFrame:
    """The topic's frame; a train on its trip does not roll back."""
    return frame_of(
        ESTIMATED_STATE,
        index,
        {
            "position": np.maximum.accumulate(motion.position) + start,
            "position_std": motion.position_std,
            "speed": np.maximum(motion.speed, 0.0),
            "speed_std": motion.speed_std,
            "acceleration": motion.acceleration,
            "acceleration_std": motion.acceleration_std,
        },
    )
