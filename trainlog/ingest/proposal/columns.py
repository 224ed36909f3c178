"""What the columns of an unknown table are: by name and unit, checked by physics."""

from __future__ import annotations

from dataclasses import replace
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.ingest.proposal import roles
from trainlog.ingest.proposal.checks import Motion, Ratio
from trainlog.ingest.proposal.efforts import add_efforts, effort_signs, net_effort, place_demands
from trainlog.ingest.proposal.fields import (
    keep_others,
    place_lever,
    place_rest,
    place_speeds,
    place_wheels,
)
from trainlog.ingest.proposal.fixes import FASTEST, Position, positions_of
from trainlog.ingest.proposal.layout import Layout, Reading
from trainlog.ingest.proposal.motion import AMBIGUOUS, Answer, Question, Units, units_of
from trainlog.ingest.proposal.times import Clock
from trainlog.ingest.proposal.trips import facts_of
from trainlog.ingest.proposal.vocabulary import Meaning
from trainlog.ingest.proposal.work import Proposed, Work, unit_reason
from trainlog.railway.train import Train
from trainlog.units import KMH, factor

NUMERIC = 0.6
"""Share of numbers from which on a column is one of numbers."""


SLOWEST_STEP = 30.0
"""Usual step [s] beyond which rows are no recording of motion."""


LEAST_ROWS = 10


MOST_UNNAMED = 12
"""Columns of unknown names that are compared two by two."""

OTHER_FIXES = 5.0
"""Cost up to which another reading of the fixes is tried with the units of the speed."""


CONTRADICTED = 1.5
"""Factor between fixes and speed beyond which the fixes are not used."""


def columns_of(
    layout: Layout, clock: Clock, meanings: dict[str, Meaning], train: Train | None
) -> Work:
    """The fields that the columns give.

    Raises
    ------
    InputError
        If nothing in the table moves as a train does.
    """
    motion = Motion.of(clock.time)
    _refuse_no_recording(layout, motion)
    times = set(clock.options.names)
    candidates = {n: m for n, m in meanings.items() if n not in times}
    numbers: dict[str, FloatArray] = {}
    left: dict[str, str] = {}
    for name in list(candidates):
        kept, why = _content(layout, name)
        if kept is not None:
            numbers[name] = motion.take(kept)
        elif not (why == "words" and roles.role_of(candidates[name])[0] == "/events.message"):
            left[name] = why if why != "words" else "holds words"
            del candidates[name]
    named, unplaced = roles.roles_of(candidates)
    words = [n for n in named.get("/events.message", []) if n not in numbers]
    named["/events.message"] = words
    work = Work(layout, clock, meanings, train, motion, numbers, named, left | unplaced)
    _place_motion(work)
    place_speeds(work)
    place_wheels(work)
    place_lever(work)
    place_demands(work)
    place_rest(work)
    work.trips = facts_of(work)
    keep_others(work)
    if not {roles.POSITION, roles.SPEED, roles.GNSS_SPEED, roles.LATITUDE} & set(work.proposed):
        shown = "; ".join(f"{name}: {why}" for name, why in list(work.left.items())[:8])
        raise InputError(
            "is no recording of a trip: no column is a speed, a distance or a satellite position"
            + (f" ({shown})" if shown else ""),
            file=layout.path,
            remedy="if a column is one of them, write a profile, see docs/ingest.md",
        )
    return work


def _refuse_no_recording(layout: Layout, motion: Motion) -> None:
    if motion.order.size < LEAST_ROWS:
        raise InputError(
            f"is no recording of a trip: {motion.order.size} rows have a time,"
            f" it takes {LEAST_ROWS}",
            file=layout.path,
            remedy="give the recorder's file, not a summary of it",
        )
    step = np.diff(motion.seconds)
    usual = float(np.median(step[step > 0])) if np.any(step > 0) else np.inf
    if usual > SLOWEST_STEP:
        raise InputError(
            f"is no recording of a trip: its rows lie {usual:.0f} s apart, as those of a timetable"
            " or of a summary",
            file=layout.path,
            remedy=f"trips need a row every {SLOWEST_STEP:.0f} s or more often",
        )


def _content(layout: Layout, name: str) -> tuple[FloatArray | None, str]:
    """The numbers of a column, or why there are none."""
    column = layout.table[name]
    if pa.types.is_boolean(column.type):
        return None, "is true or false"
    if pa.types.is_temporal(column.type):
        return None, "a further time"
    if column.null_count == len(column):
        return None, "is empty"
    share = layout.share_of_numbers(name)
    if share >= NUMERIC:
        return layout.number(name), ""
    texts = pa.types.is_string(column.type) or pa.types.is_large_string(column.type)
    if texts and pc.any(pc.match_substring_regex(column, r"^-?\d{1,3}[ ',.]\d{3}\b")).as_py():
        return None, f"{1.0 - share:.0%} of its cells are no numbers: marks between thousands?"
    return None, "words" if texts else "holds no numbers"


def _place_motion(work: Work) -> None:
    """Fixes, speed, distance and efforts, with units on which they agree."""
    speed, position = _main_speed(work), _main_position(work)
    effort_signs(work, speed)
    effort, force = net_effort(work)
    stated = Units(work.stated(speed, "speed"), work.stated(position, "length"), force)
    values = None if speed is None else work.numbers[speed]
    question = Question(
        work.motion,
        values,
        None if position is None else work.numbers[position],
        effort,
        None,
        stated,
        work.train,
    )
    place, other, answer = _with_fixes(question, _possible_fixes(work, values))
    if place is not None and "fixes" in answer.unexplained:
        off = answer.chords.value / factor(answer.units.speed, "m/s")[0]
        if not 1.0 / CONTRADICTED < off < CONTRADICTED:
            for name in (place.latitude, place.longitude):
                work.left[name] = f"positions that move {off:.3g} times as fast as the speed says"
            place = None
        other = "; ".join(filter(None, [other, f"they move {off:.3g} times the speed"]))
    _add_fixes(work, place, other)
    if speed is not None:
        work.speed = work.numbers[speed] * factor(answer.units.speed, "m/s")[0]
        _add_speed(work, speed, answer, stated, place)
    if position is not None:
        _add_position(work, position, answer, stated)
    add_efforts(work, answer, stated)


def _main_speed(work: Work) -> str | None:
    """The column of the train's speed: by name, or else by what it integrates to."""
    named = work.first(roles.SPEED) or work.first(roles.GNSS_SPEED)
    if named is not None:
        return named
    position = work.names.get(roles.POSITION, [])
    if not position:
        return _unnamed_pair(work)
    for name in _unknown(work):
        values = work.numbers[name]
        if np.nanmin(values) < -0.1 * np.nanmax(values) or not np.nanmax(values) > 0.0:
            continue
        answer = units_of(Question(work.motion, values, work.numbers[position[0]]))
        exact = answer.distance.agreement > 0.9 and answer.distance.scatter < 0.02
        if exact and not answer.unexplained:
            return _found(work, name, roles.SPEED, f"its integral follows '{position[0]}'")
    return None


def _unnamed_pair(work: Work) -> str | None:
    """A speed and a distance without names that one knows, where one is the other's integral."""
    unknown = _unknown(work)[:MOST_UNNAMED]
    for far in unknown:
        steps = np.diff(work.numbers[far][np.isfinite(work.numbers[far])])
        if not np.any(steps) or max(np.mean(steps >= 0.0), np.mean(steps <= 0.0)) < 0.95:
            continue
        for name in unknown:
            values = work.numbers[name]
            if name == far or np.nanmin(values) < -0.1 * np.nanmax(values):
                continue
            answer = units_of(Question(work.motion, values, work.numbers[far]))
            exact = answer.distance.agreement > 0.95 and answer.distance.scatter < 0.02
            if exact and not answer.unexplained:
                _found(work, far, roles.POSITION, f"it is the integral of '{name}'")
                return _found(work, name, roles.SPEED, f"its integral is '{far}'")
    return None


def _main_position(work: Work) -> str | None:
    """The column of the distance: of several the one that follows the speed best."""
    names = work.names.get(roles.POSITION, [])
    speeds = work.names.get(roles.SPEED, []) or work.names.get(roles.GNSS_SPEED, [])
    if not speeds:
        return work.first(roles.POSITION)
    speed = speeds[0]
    values = work.numbers[speed]
    if not names:
        for name in _unknown(work):
            answer = units_of(Question(work.motion, values, work.numbers[name]))
            ratio = answer.distance
            if ratio.agreement > 0.95 and ratio.scatter < 0.02 and not answer.unexplained:
                return _found(work, name, roles.POSITION, f"it follows the integral of '{speed}'")
        return None
    if len(names) > 1:
        agreements = {
            name: units_of(Question(work.motion, values, work.numbers[name])).distance
            for name in names
        }
        names.sort(key=lambda name: (-round(agreements[name].agreement, 1), names.index(name)))
    return work.first(roles.POSITION)


def _unknown(work: Work) -> list[str]:
    """Columns of numbers whose names mean nothing to us."""
    return [name for name in work.left if name in work.numbers and not work.meanings[name].quantity]


def _found(work: Work, name: str, role: str, why: str) -> str:
    work.names[role] = [name]
    del work.left[name]
    work.readings.append(Reading(f"column '{name}'", role, f"the name is not known, but {why}"))
    return name


def _possible_fixes(work: Work, speed: FloatArray | None) -> list[Position]:
    north, east = work.names.get(roles.LATITUDE, []), work.names.get(roles.LONGITUDE, [])
    if not north or not east:
        for name in (*north, *east):
            work.left[name] = "latitude without longitude, or the other way round"
        return []
    first, second = _without_zero(work.numbers[north[0]], work.numbers[east[0]])
    return positions_of(work.motion, ((north[0], first), (east[0], second)), speed)


def _with_fixes(question: Question, places: list[Position]) -> tuple[Position | None, str, Answer]:
    """The reading of the fixes, another one that the data allow, and the units beside it."""
    if not places:
        return None, "", units_of(question)
    likely = [place for place in places if place.cost <= places[0].cost + OTHER_FIXES]
    answers = [units_of(replace(question, fixes=place.fixes)) for place in likely]
    costs = [place.cost + answer.cost for place, answer in zip(likely, answers, strict=True)]
    order = sorted(range(len(likely)), key=lambda number: costs[number])
    best = order[0]
    close = [likely[n].words for n in order[1:] if costs[n] <= costs[best] + AMBIGUOUS]
    return likely[best], close[0] if close else "", answers[best]


def _without_zero(first: FloatArray, second: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Two columns without the rows in which both are zero: a receiver without a fix."""
    absent = (first == 0.0) & (second == 0.0)
    return np.where(absent, np.nan, first), np.where(absent, np.nan, second)


def _add_fixes(work: Work, place: Position | None, other: str) -> None:
    names = [work.first(role) for role in (roles.LATITUDE, roles.LONGITUDE)]
    if place is None:
        for name in names:
            if name is not None:
                work.left.setdefault(name, "is no latitude or longitude in any scale")
        return
    if place.speed > FASTEST:
        raise InputError(
            f"is no recording of one trip: its positions move at {place.speed:.0f} m/s",
            file=work.layout.path,
            remedy="does it hold several devices or rides? Give a file of one",
        )
    check = f"the fixes move at up to {KMH * place.speed:.0f} km/h"
    exact = {"1e-7 degrees": 1e-7, "1e-6 degrees": 1e-6, "1e-5 degrees": 1e-5}
    fine = {"seconds of arc": 1.0 / 3600.0, "milliseconds of arc": 1.0 / 3.6e6}
    scale = (exact | fine | {"semicircles": 180.0 / 2.0**31}).get(place.scale, 1.0)
    unit = "rad" if place.scale == "radians" else "deg"
    notation: Literal["number", "degrees_minutes"] = (
        "degrees_minutes" if place.scale == "degrees and minutes" else "number"
    )
    why = f"read as {place.scale}"
    if place.swapped:
        why += "; the names say the opposite, but so the fixes move as the speed says"
    for target, name, letters in (
        (roles.LATITUDE, place.latitude, "NS"),
        (roles.LONGITUDE, place.longitude, "EW"),
    ):
        work.add(
            Proposed(
                target, (name,), unit, scale, sign=_hemisphere(work, letters), notation=notation,
                why=why, check=check, alternative=other,
            )
        )  # fmt: skip


def _hemisphere(work: Work, letters: str) -> Literal[1, -1]:
    """-1 where a column of single letters says south or west."""
    for name in [name for name, why in work.left.items() if why == "holds words"]:
        cells = set(pc.unique(work.layout.table[name].drop_null()).to_pylist()[:5])
        if cells and cells <= set(letters):
            work.left[name] = f"'{letters}' is the sign of the position"
            return -1 if cells == {letters[1]} else 1
    return 1


def _add_speed(
    work: Work, name: str, answer: Answer, stated: Units, place: Position | None
) -> None:
    vehicle = {
        roles.POSITION, roles.LEVER, roles.TRACTION, roles.SIGNED, roles.BRAKING, roles.DYNAMIC,
        roles.WHEEL_SPEED, roles.WHEEL_EFFORT, roles.TORQUE, roles.ACCELERATION,
    }  # fmt: skip
    target, other = roles.SPEED, ""
    if roles.SPEED not in work.names:
        target = roles.GNSS_SPEED
    elif (
        place is not None
        and roles.GNSS_SPEED not in work.names
        and not vehicle & {role for role, names in work.names.items() if names}
    ):
        target = roles.GNSS_SPEED
        other = f"{roles.SPEED}, if it is the wheels' and not the receiver's"
    assert work.speed is not None
    checks = [f"up to {KMH * np.nanpercentile(work.speed, 99.5):.0f} km/h"]
    metres = factor(answer.units.speed, "m/s")[0]
    checks += _in_words(answer.chords, "the fixes move", "the speed", 1.0 / metres)
    if answer.units.length:
        length = factor(answer.units.length, "m")[0]
        checks += _in_words(
            answer.distance, "the distance changes by", "its integral", length / metres
        )
    if place is not None and "fixes" in answer.unexplained:
        other = "; ".join(filter(None, [other, "no unit explains how fast the fixes move"]))
    why, alternative = unit_reason(stated.speed, answer.units.speed, answer.alternatives["speed"])
    if alternative:
        work.speed_open = f"another size: the speed may be in {alternative}"
    work.names[roles.SPEED] = []
    if target == roles.GNSS_SPEED:
        work.names[target] = [name]
    backwards = float(np.mean(work.speed[np.isfinite(work.speed)] < -0.5))
    sign: Literal[1, -1] = -1 if backwards > 0.5 else 1
    if sign < 0:
        work.speed = -work.speed
        why += "; negative while the train moves, sign -1"
    work.add(
        Proposed(
            target, (name,), answer.units.speed, sign=sign, why=why, check=", ".join(checks),
            alternative="; ".join(filter(None, [alternative, other])),
        )
    )  # fmt: skip


def _in_words(ratio: Ratio, what: str, other: str, to_one: float) -> list[str]:
    if not ratio.windows:
        return []
    held = f"in {ratio.agreement:.0%} of {ratio.windows} parts of the trip"
    return [f"{what} {abs(ratio.value) * to_one:.3f} times {other} {held}"]


def _add_position(work: Work, name: str, answer: Answer, stated: Units) -> None:
    values = work.numbers[name]
    known = values[np.isfinite(values)]
    if known.size < 2 or float(np.ptp(known)) == 0.0:
        work.left[name] = "a distance that does not change"
        return
    if answer.units.speed and work.speed is not None:
        ratio = answer.distance
        if not ratio.holds or "distance" in answer.unexplained:
            work.left[name] = (
                "a distance that does not follow the speed:"
                f" factor {ratio.value:.4g} in {ratio.agreement:.0%} of {ratio.windows} parts"
            )
            work.readings.append(
                Reading(f"column '{name}'", "not used", work.left[name], "another unit or meaning")
            )
            return
    falling = answer.distance.value < 0.0 if answer.distance.windows else known[-1] < known[0]
    why, alternative = unit_reason(
        stated.length, answer.units.length, answer.alternatives["length"]
    )
    length = factor(answer.units.length, "m")[0]
    checks = [f"{length * float(np.ptp(known)) / 1e3:.2f} km in all"]
    if answer.distance.windows and answer.units.speed:
        to_one = length / factor(answer.units.speed, "m/s")[0]
        checks += _in_words(answer.distance, "it changes by", "the integral of the speed", to_one)
    falls = float(np.mean(np.diff(known) * (-1.0 if falling else 1.0) >= 0.0))
    checks.append(f"cumulative: {falls:.1%} of its steps go one way")
    proposed = Proposed(
        roles.POSITION, (name,), answer.units.length, why=why, check=", ".join(checks),
        alternative=alternative,
    )  # fmt: skip
    if falling:
        start = float(np.ceil(known[0] * length / 1e3)) * 1e3 / length
        proposed = replace(
            proposed,
            sign=-1,
            offset=-start,
            why=why + "; it falls, so the train runs against it: sign -1",
            alternative="; ".join(
                filter(None, [alternative, f"offset = minus the line's length, not {-start:g}"])
            ),
        )
    work.add(proposed)
