"""What the columns of an unknown table are: by name and unit, checked by physics.

Columns that became no field may state facts of a trip: its number, load and weather.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from numpy.typing import NDArray

from estimators.matching import FASTEST
from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.ingest.mapping import in_si, is_text, words_in
from trainlog.ingest.motion import (
    ACTS,
    ALIKE,
    DRIVES,
    EFFORTS,
    ENOUGH,
    FAR,
    GNSS_SPEED,
    LATITUDE,
    LIKELY,
    LONGITUDE,
    POSITION,
    SPEED,
    WHEEL_SPEED,
    driven_mass,
    rate_of,
)
from trainlog.ingest.parts import CONSTANT
from trainlog.ingest.profile import Column, LoadColumn, TripColumns, WeatherColumn
from trainlog.ingest.proposal.layout import MOST, Clock, Layout, Reading
from trainlog.ingest.proposal.motion import (
    AMBIGUOUS,
    TOLERANCE,
    Answer,
    Position,
    Ratio,
    positions_of,
    same_motion,
    units_of,
)
from trainlog.ingest.proposal.vocabulary import (
    NO_FIELD,
    UNKNOWN,
    Meaning,
    dimension_of,
    plain,
    role_of,
    split_unit,
    vocabulary,
)
from trainlog.ingest.recording import NO_TIME, SELDOM, carried_on, field_of
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.topics import RECORDED, Recorded
from trainlog.units import KMH, NANOSECONDS, factor, si_unit

TRACTION, DYNAMIC, PNEUMATIC = EFFORTS
ACCELERATION, LEVER = "/train/state.acceleration", "/train/controls.lever"
WHEEL_EFFORT = "/train/axles.wheel_effort"
MESSAGE = "/events.message"

BOTH, BRAKING = "both", "braking"
"""Roles of columns that hold traction and braking, or do not say which; that do not say of which
brake."""

EITHER_BRAKE = "the friction brakes' or the sum of both brakes"
"""Open of a braking effort whose brake is not stated: it is taken as the dynamic one's."""

FOLLOWS = DRIVES
"""Correlation, or share of the trip, from which on a column goes with the train's motion."""

SLOWEST_STEP = 30.0
"""Usual step [s] beyond which rows are no recording of motion."""

MOST_UNNAMED = 12
"""Columns of unknown names that are compared two by two."""

PAUSE = 900.0
"""Time [s] without rows, or at standstill, from which on two trips are proposed."""

_TURNS = {"rpm": 60.0, "Hz": 1.0, "rad/s": 2.0 * np.pi}
"""Of one turn a second, in each unit."""


@dataclass(frozen=True, slots=True)
class Proposed:
    """A field of our topics, and what it is read from.

    Attributes
    ----------
    field : str
    column : Column
        As the profile has it.
    why, check, alternative : str
        What the name and the unit say, what physics says in numbers, and another reading.
    """

    field: str
    column: Column
    why: str = ""
    check: str = ""
    alternative: str = ""


@dataclass
class Work:
    """What is known so far of a table.

    Attributes
    ----------
    layout, clock, meanings, train, line
        What is given.
    order : (n,) int array
        Rows that have a time, in its order.
    seconds : (n,) array [s]
        Their times.
    numbers : dict of str to (n,) array
        Columns of numbers, in order of time.
    names : dict of str to list of str
        Columns by role, the better named first.
    left : dict of str to str
        Columns that are not used, and why.
    proposed : dict of str to Proposed
        By field.
    readings : list of Reading
    speed : (n,) array, optional [m/s]
        The train's, that others are compared with.
    moved : (n,) array, optional [m/s]
        How fast distance or fixes move, that wheels are compared with where no speed is recorded.
    speed_open : str
        Why what is scaled by it is open, if its own unit is.
    rivals : dict of str to list of str
        Columns of the same role as one that is used, and as well named.
    trips : TripColumns
        Columns that state facts of each trip.
    """

    layout: Layout
    clock: Clock
    meanings: dict[str, Meaning]
    train: Train | None
    line: Line | None
    order: IntArray
    seconds: FloatArray
    numbers: dict[str, FloatArray] = field(default_factory=dict)
    names: dict[str, list[str]] = field(default_factory=dict)
    left: dict[str, str] = field(default_factory=dict)
    proposed: dict[str, Proposed] = field(default_factory=dict)
    readings: list[Reading] = field(default_factory=list)
    speed: FloatArray | None = None
    moved: FloatArray | None = None
    speed_open: str = ""
    rivals: dict[str, list[str]] = field(default_factory=dict)
    trips: TripColumns = field(default_factory=TripColumns)

    def first(self, role: str) -> str | None:
        """The column of a role; the others of that role are not used."""
        names = self.names.get(role, [])
        for other in names[1:]:
            self.left[other] = f"a second column for {role}; '{names[0]}' is used"
            if self.meanings[other].coverage >= 0.9 * self.meanings[names[0]].coverage:
                self.rivals.setdefault(names[0], []).append(f"'{other}'")
        del names[1:]
        return names[0] if names else None

    def stated(self, name: str | None, dimension: str) -> str:
        """The unit of that kind that the file states for a column; empty if none."""
        unit = self.meanings[name].unit if name is not None else None
        return unit if unit is not None and dimension_of(unit) == dimension else ""

    def unit_of(self, *fields: str) -> str:
        """The unit of the first of some fields that is proposed; empty if none is."""
        found = (self.proposed[name].column.unit for name in fields if name in self.proposed)
        return next(found, None) or ""

    def put(self, proposed: Proposed) -> None:
        """Propose a field; other columns of its name are an alternative."""
        rivals = " or ".join(self.rivals.get(proposed.column.names[0], ()))
        other = proposed.alternative
        other = other if rivals in other else said(other, rivals)
        self.proposed[proposed.field] = replace(proposed, alternative=other)

    def place(
        self, field: str, *names: str, unit: str = "", why: str, check: str = "",
        alternative: str = "", **more: Any
    ) -> None:  # fmt: skip
        """Propose a field of one column, or of several where it has one value an axle."""
        where = {"columns": names} if field_of(field)[2].per_axle else {"column": names[0]}
        column = Column(**where, unit=unit or None, **more)
        self.put(Proposed(field, column, why, check, alternative))


def said(*parts: str) -> str:
    """Parts of a sentence that are not empty, joined."""
    return "; ".join(filter(None, parts))


def columns_of(
    layout: Layout,
    clock: Clock,
    meanings: dict[str, Meaning],
    train: Train | None,
    line: Line | None,
) -> Work:
    """The fields that the columns give.

    Raises
    ------
    InputError
        If nothing in the table moves as a train does.
    """
    known = np.flatnonzero(clock.time != NO_TIME)
    order = known[np.argsort(clock.time[known], kind="stable")]
    seconds = (clock.time[order] - clock.time[order[0]]) / NANOSECONDS
    _refuse_no_recording(seconds)
    work = Work(layout, clock, meanings, train, line, order, seconds)
    for name in [name for name in layout.names if name not in clock.options.names]:
        role, why = role_of(meanings[name])
        numbers, no_numbers = _content(layout, name)
        if numbers is not None:
            work.numbers[name] = numbers[order]
        if (numbers is None) != (role == MESSAGE and no_numbers == "holds words"):
            work.left[name] = no_numbers or "a message without words"
        elif role is None:
            work.left[name] = why
        else:
            work.names.setdefault(role, []).append(name)
    _sort_roles(work)
    _place_motion(work)
    _place_speeds(work)
    _place_lever(work)
    _place_rest(work)
    return work


def refuse_no_motion(work: Work) -> None:
    """Refuse a table without any column of motion."""
    if not {POSITION, SPEED, GNSS_SPEED, LATITUDE} & set(work.proposed):
        shown = "; ".join(f"{name}: {why}" for name, why in list(work.left.items())[:8])
        raise InputError(
            "is not a recording of a trip: no column is a speed, a distance or a satellite position"
            + (f" ({shown})" if shown else ""),
            remedy="if a column is one of them, write a profile, see docs/ingest.md",
        )


def _refuse_no_recording(seconds: FloatArray) -> None:
    if seconds.size < ENOUGH:
        raise InputError(
            f"is not a recording of a trip: {seconds.size} rows have a time, it takes {ENOUGH}",
            remedy="give the recorder's file, not a summary of it",
        )
    step = np.diff(seconds)
    usual = float(np.median(step[step > 0])) if np.any(step > 0) else np.inf
    if usual > SLOWEST_STEP:
        raise InputError(
            f"is not a recording of a trip: its rows lie {usual:.0f} s apart, as in a timetable"
            " or a summary",
            remedy=f"trips need a row every {SLOWEST_STEP:.0f} s or more often",
        )


def _content(layout: Layout, name: str) -> tuple[FloatArray | None, str]:
    """The numbers of a column, or why there are none."""
    column = layout.table[name]
    kinds = {"is true or false": pa.types.is_boolean, "a further time": pa.types.is_temporal}
    for why, holds in kinds.items():
        if holds(column.type):
            return None, why
    if column.null_count == len(column):
        return None, "is empty"
    share = layout.share_of_numbers(name)
    if share >= MOST:
        return layout.number(name), ""
    texts = is_text(column)
    if texts and pc.any(pc.match_substring_regex(column, r"^-?\d{1,3}[ ',.]\d{3}\b")).as_py():
        why = f"{1.0 - share:.0%} of its cells are not numbers: marks between thousands?"
        return None, f"{why} Then state thousands under [file]"
    return None, "holds words" if texts else "has no numbers"


def _sort_roles(work: Work) -> None:
    """Numbered speeds and efforts, such as ``v1`` to ``v4``, are those of axles."""
    meanings = work.meanings
    for role, axles in ((SPEED, WHEEL_SPEED), (BOTH, WHEEL_EFFORT), (TRACTION, WHEEL_EFFORT)):
        numbered = [name for name in work.names.get(role, ()) if meanings[name].index is not None]
        if len(numbered) > 1:
            work.names.setdefault(axles, []).extend(numbered)
            work.names[role] = [name for name in work.names[role] if name not in numbered]
    for role, names in work.names.items():
        names.sort(key=lambda name: -meanings[name].coverage)
        if role in (WHEEL_SPEED, WHEEL_EFFORT):
            names.sort(key=lambda name: meanings[name].index or 0)
    work.names = {role: names for role, names in work.names.items() if names}


# ------------------------------------------------------------ speed, distance, fixes and efforts


def _place_motion(work: Work) -> None:
    """Fixes, speed, distance and efforts, with units on which they agree."""
    _find_unnamed(work)
    speed, position = work.first(SPEED) or work.first(GNSS_SPEED), work.first(POSITION)
    efforts = _efforts(work, speed)
    net, force = _net(work, efforts)
    stated = {
        "length": work.stated(position, "length"), "speed": work.stated(speed, "speed"),
        "force": force,
    }  # fmt: skip
    given = {kind: work.numbers[n] for kind, n in (("length", position), ("speed", speed)) if n}
    given |= {} if net is None else {"force": net}
    answer = units_of(work.seconds, given, stated, None, work.train)
    places = _possible_fixes(work, given.get("speed"))
    if places:
        tried = [(units_of(work.seconds, given, stated, p.fixes, work.train), p) for p in places]
        tried.sort(key=lambda each: each[0].cost + each[1].cost)
        (answer, place), *others = tried
        most = answer.cost + place.cost + AMBIGUOUS
        close = [other for units, other in others if units.cost + other.cost <= most]
        _place_fixes(work, place, close, answer)
        work.moved = place.fixes.speeds(work.seconds)
    if speed is None and position is not None:
        work.moved = np.abs(rate_of(work.seconds, work.numbers[position]) * answer.si("length"))
    if speed is not None:
        work.speed = work.numbers[speed] * answer.si("speed")
        _place_speed(work, speed, answer, stated["speed"], bool(places))
    if position is not None:
        _place_position(work, position, answer, stated["length"])
    _place_efforts(work, efforts, answer, force)


def _find_unnamed(work: Work) -> None:
    """A distance whose name is not known, with the speed that it is the integral of."""
    if work.names.get(POSITION):
        return
    unknown = [n for n in work.left if n in work.numbers and not work.meanings[n].quantities]
    speeds = work.names.get(SPEED) or work.names.get(GNSS_SPEED) or unknown[:MOST_UNNAMED]
    for far in unknown[:MOST_UNNAMED]:
        steps = np.diff(work.numbers[far][np.isfinite(work.numbers[far])])
        if not np.any(steps) or max(np.mean(steps >= 0.0), np.mean(steps <= 0.0)) < 0.95:
            continue
        for name in [name for name in speeds if name != far]:
            given = {"length": work.numbers[far], "speed": work.numbers[name]}
            answer = units_of(work.seconds, given)
            if answer.distance.exact and not answer.unexplained:
                _found(work, far, POSITION, f"it is the integral of '{name}'")
                _found(work, name, SPEED, f"its integral is '{far}'")
                return


def _found(work: Work, name: str, role: str, why: str) -> None:
    if work.left.pop(name, None) is not None:
        work.names[role] = [name]
        why = f"the name is not known, but {why}"
        work.readings.append(Reading(f"column '{name}'", role, why))


def _possible_fixes(work: Work, speed: FloatArray | None) -> list[Position]:
    """The readings of latitude and longitude that are to be tried, the likeliest first."""
    names = [name for role in (LATITUDE, LONGITUDE) if (name := work.first(role)) is not None]
    why = "latitude without longitude, or the other way round"
    places: list[Position] = []
    if len(names) == 2:
        why = "is not a latitude or longitude in any scale"
        pair = [work.numbers[name] for name in names]
        # A receiver without a fix gives zero for both.
        absent = (pair[0] == 0.0) & (pair[1] == 0.0)
        fixed = [np.where(absent, np.nan, values) for values in pair]
        places = positions_of(work.seconds, list(zip(names, fixed, strict=True)), speed)
    if not places:
        work.left |= dict.fromkeys(names, why)
    return [place for place in places if place.cost <= places[0].cost + LIKELY]


def _place_fixes(work: Work, place: Position, close: list[Position], answer: Answer) -> None:
    fastest = place.fixes.speed
    if fastest > FASTEST:
        raise InputError(
            f"is not a recording of one trip: its positions move at {fastest:.0f} m/s",
            remedy="does it hold several devices or rides? Give a file of one",
        )
    why = f"read as {place.words}"
    if place.swapped:
        why += "; the names say the opposite, but so the fixes move as the speed says"
    other = ""
    if close:
        swapped = "swapped" if close[0].swapped else "as named"
        other = f"{close[0].words}, latitude and longitude {swapped}"
    if "fixes" in answer.unexplained:
        other = said(other, f"they move {answer.unexplained['fixes']:.3g} times the speed")
    check = f"the fixes move at up to {KMH * fastest:.0f} km/h"
    for name, column, letters in (
        (LATITUDE, place.latitude, "NS"),
        (LONGITUDE, place.longitude, "EW"),
    ):
        signed = replace(column, sign=_hemisphere(work, letters))
        work.put(Proposed(name, signed, why, check, other))


def _hemisphere(work: Work, letters: str) -> Literal[1, -1]:
    """-1 where a column of single letters says south or west."""
    for name in [name for name, why in work.left.items() if why == "holds words"]:
        cells = set(pc.unique(work.layout.table[name].drop_null()).to_pylist()[:5])
        if cells and cells <= set(letters):
            work.left[name] = f"'{letters}' is the sign of the position"
            return -1 if cells == {letters[1]} else 1
    return 1


_OF_THE_TRAIN = {POSITION, LEVER, ACCELERATION, WHEEL_SPEED, WHEEL_EFFORT, *EFFORTS, BOTH, BRAKING}
"""Roles that no receiver has: beside one of them a speed is the wheels'."""


def _place_speed(work: Work, name: str, answer: Answer, stated: str, fixes: bool) -> None:
    target, other = SPEED, ""
    if SPEED not in work.names:
        target = GNSS_SPEED
    elif fixes and GNSS_SPEED not in work.names and not _OF_THE_TRAIN & set(work.names):
        target = GNSS_SPEED
        other = f"{SPEED}, if it is the wheels' and not the receiver's"
    assert work.speed is not None
    to_one = 1.0 / answer.si("speed")
    checks = [f"up to {KMH * np.nanpercentile(work.speed, 99.5):.0f} km/h"]
    checks += _in_words(answer.chords, "the fixes move", "the speed", to_one)
    if "length" in answer.units:
        to_one *= answer.si("length")
        checks += _in_words(answer.distance, "the distance changes by", "its integral", to_one)
    if "fixes" in answer.unexplained:
        other = said(other, "no unit explains how fast the fixes move")
    why, alternative = _unit_reason(stated, answer, "speed")
    if alternative:
        work.speed_open = f"another size: the speed may be in {alternative}"
    sign: Literal[1, -1] = 1
    if np.mean(work.speed[np.isfinite(work.speed)] < -0.5) > 0.5:
        sign, work.speed = -1, -work.speed
        why += "; negative while the train moves, sign -1"
    work.place(
        target, name, unit=answer.units["speed"], sign=sign, why=why, check=", ".join(checks),
        alternative=said(alternative, other), unproven=bool(alternative) or _unproven(answer),
    )  # fmt: skip


def _in_words(ratio: Ratio, what: str, other: str, to_one: float) -> Iterator[str]:
    if ratio.windows:
        held = f"in {ratio.agreement:.0%} of {ratio.windows} parts of the trip"
        yield f"{what} {abs(ratio.value) * to_one:.3f} times {other} {held}"


def _unproven(answer: Answer) -> bool:
    """Whether no other column shows in which unit motion and efforts are."""
    return not (answer.distance.windows or answer.chords.windows or answer.driven.seconds)


def _unit_reason(stated: str, answer: Answer, kind: str, unit: str = "") -> tuple[str, str]:
    """Why a unit was taken, and the alternative."""
    if not stated:
        others = " or ".join(answer.others.get(kind, ())[:2])
        why = "is the usual one" if _unproven(answer) else "agrees with the other columns"
        return f"no known unit is stated; this one {why}", others
    if stated == (unit or answer.units[kind]):
        return f"the file states {stated}", ""
    why = f"the file states {stated}, which contradicts the other columns"
    return why, f"{stated}, as the file states"


def _place_position(work: Work, name: str, answer: Answer, stated: str) -> None:
    values = work.numbers[name]
    known, ratio = values[np.isfinite(values)], answer.distance
    if known.size < 2 or float(np.ptp(known)) == 0.0:
        work.left[name] = "a distance that does not change"
        return
    if work.speed is not None and (not ratio.holds or "distance" in answer.unexplained):
        why = "a distance that does not follow the speed:"
        why += f" factor {ratio.value:.4g} in {ratio.agreement:.0%} of {ratio.windows} parts"
        work.left[name] = why
        other = "another unit or meaning"
        work.readings.append(Reading(f"column '{name}'", "not used", why, other))
        return
    why, other = _unit_reason(stated, answer, "length")
    unproven = bool(other) or _unproven(answer)
    length = answer.si("length")
    checks = [f"its values span {length * float(np.ptp(known)) / 1e3:.2f} km"]
    to_one = length / answer.si("speed")
    checks += _in_words(ratio, "it changes by", "the integral of the speed", to_one)
    falling = ratio.value < 0.0 if ratio.windows else known[-1] < known[0]
    sign: Literal[1, -1] = -1 if falling else 1
    one_way = float(np.mean(np.diff(known) * sign >= 0.0))
    checks.append(f"cumulative: {one_way:.1%} of its steps go one way")
    offset = 0.0
    if falling:
        why += "; it falls, so the train runs against it: sign -1"
    low, high = length * known.min(), length * known.max()
    counted = (
        ()
        if work.line is None
        else (np.array([0.0, work.line.length]), work.line.kilometre([0.0, work.line.length]))
    )
    begins = [
        float(max(ends) if falling else min(ends))
        for ends in counted
        if min(ends) - FAR < low and high < max(ends) + FAR
    ]
    if begins and work.line is not None:
        offset = -begins[0] / length
        why += f", from km {begins[0] / 1e3:.3f} of line '{work.line.name}'" * (begins[0] != 0.0)
        if begins[-1] != begins[0]:
            other = said(other, f"offset = {-begins[-1] / length:g}, by the operator's kilometres")
    elif falling:
        offset = -float(np.ceil(high / 1e3)) * 1e3 / length
        other = said(other, f"offset = minus the line's length, not {offset:g}")
    work.place(
        POSITION, name, unit=answer.units["length"], sign=sign, offset=offset, why=why,
        check=", ".join(checks), alternative=other, unproven=unproven,
    )  # fmt: skip


def _sign(values: FloatArray) -> Literal[1, -1, 0]:
    """The sign that the strong values of a column have; 0 if it has both."""
    known = values[np.isfinite(values)]
    top = ACTS * float(np.percentile(np.abs(known), 99.5)) if known.size else 0.0
    if top == 0.0:
        return 1
    positive, negative = float(np.mean(known > top)), float(np.mean(known < -top))
    if min(positive, negative) > SELDOM:
        return 0
    return -1 if negative > positive else 1


def _efforts(work: Work, speed: str | None) -> dict[str, Proposed]:
    """Which columns are traction, which braking, with which sign; in no unit yet."""
    for role in (*EFFORTS, BOTH, BRAKING):
        for name in list(work.names.get(role, ())):
            if not work.stated(name, "force") and np.unique(work.numbers[name]).size < ENOUGH:
                work.names[role].remove(name)
                work.left[name] = f"an effort of fewer than {ENOUGH} values: a state?"
    found: dict[str, Proposed] = {}
    for role in (DYNAMIC, PNEUMATIC, BRAKING):
        brake = work.first(role)
        free = [each for each in (DYNAMIC, PNEUMATIC) if each not in found]
        if brake is None:
            continue
        sign = _sign(work.numbers[brake])
        if role == BRAKING and not free:
            work.left[brake] = "a braking effort beside those of both brakes"
        elif sign == 0:
            work.left[brake] = "a braking effort of both signs"
        else:
            target = free[0] if role == BRAKING else role
            why = f"braking is {'negative, sign -1' if sign < 0 else 'positive'}"
            other = EITHER_BRAKE if role == BRAKING and len(free) == 2 else ""
            found[target] = Proposed(target, Column(column=brake, sign=sign), why, "", other)
    main, both = work.first(TRACTION), work.first(BOTH)
    if main is not None and both is not None:
        work.left[both] = f"an effort beside '{main}', not stated of which kind"
    driving = main or both
    return found if driving is None else found | _driving(work, driving, speed, found)


def _driving(
    work: Work, name: str, speed: str | None, brakes: dict[str, Proposed]
) -> dict[str, Proposed]:
    """An effort that drives the train, and perhaps brakes it, too."""
    values, correlation = work.numbers[name], 0.0
    if speed is not None:
        moves = np.abs(work.numbers[speed])
        correlation = driven_mass(work.seconds, values, moves).correlation
    sign = _sign(values)
    if sign != 0:
        # A traction that is negative where it drives is written with the sign turned.
        why = "traction only, negative: sign -1" if sign < 0 else "traction only"
        drives = correlation * sign > -FOLLOWS
        other = "" if drives else "braking: the train slows down with it"
        return {TRACTION: Proposed(TRACTION, Column(column=name, sign=sign), why, "", other)}
    scale = -1.0 if correlation < -FOLLOWS else 1.0
    why = f"of both signs, {'negative' if scale < 0.0 else 'positive'} drives"
    other = "the opposite sign" if abs(correlation) < FOLLOWS else ""
    column = Column(column=name, scale=scale, part="positive")
    found = {TRACTION: Proposed(TRACTION, column, why, "", other)}
    if DYNAMIC not in brakes:
        column = Column(column=name, scale=scale, part="negative")
        other = other or ("" if PNEUMATIC in brakes else "with the friction brakes in it")
        found[DYNAMIC] = Proposed(DYNAMIC, column, why, "", other)
    return found


def _net(work: Work, efforts: dict[str, Proposed]) -> tuple[FloatArray | None, str]:
    """The effort that drives the train, in the unit that the first column states, and the unit."""
    if TRACTION not in efforts:
        return None, ""
    stated = {name: work.stated(each.column.column, "force") for name, each in efforts.items()}
    unit = next((stated[name] for name in EFFORTS if stated.get(name)), "")
    total = np.zeros(work.order.size)
    for name, each in efforts.items():
        column = replace(each.column, unit=stated[name] or unit or "N")
        values = np.nan_to_num(in_si(name, column, work.numbers[column.names[0]]))
        total += values if name == TRACTION else -values
    return total / factor(unit or "N", "N")[0], unit


def _place_efforts(work: Work, efforts: dict[str, Proposed], answer: Answer, stated: str) -> None:
    """Give the efforts their unit."""
    mass, correlation, _, alone = answer.driven
    check = "no acceleration to check it with"
    if np.isfinite(mass):
        known = f", the train's is {work.train.mass / 1e3:.0f} t" if work.train else ""
        check = (
            f"it accelerates {mass / 1e3:.0f} t{known}"
            f" (correlation with acceleration {correlation:.2f})"
        )
        if alone:
            check += "; only seconds in which it acts or the train coasts are used, as no effort of"
            check += " the other sign is recorded"
    elif correlation:
        check = f"correlation with acceleration {correlation:.2f}: decides nothing"
    for each in efforts.values():
        name = each.column.names[0]
        own = work.stated(name, "force")
        unit = answer.units.get("force", own)
        unit = own if own and unit == stated else unit
        if work.meanings[name].unit == "%" or not unit:
            none = "in per cent of a maximum that is not stated"
            none = none if unit else "without a unit, and nothing to find it from"
            work.left[name] = f"an effort {none}"
            continue
        why, other = _unit_reason(own, answer, "force", unit)
        if not own and correlation and not np.isfinite(mass):
            other = other or "another unit"
        unproven = bool(other) or not np.isfinite(mass)
        column = replace(each.column, unit=unit, unproven=unproven)
        other = said(each.alternative, other)
        work.put(Proposed(each.field, column, f"{why}; {each.why}", check, other))


# ---------------------------------------------------------- what is compared with the train's speed


USUAL_SPEEDS = ("km/h", "m/s", "mph", "knot")
"""Units that a further speed is tried in."""


def _place_speeds(work: Work) -> None:
    """Further speeds: the receiver's beside the train's, those of the axles, and their turns."""
    work.first(GNSS_SPEED)
    speed = work.moved if work.speed is None else work.speed
    for target in (GNSS_SPEED, WHEEL_SPEED):
        names = [] if target in work.proposed else work.names.get(target, [])
        if speed is None:
            work.left |= dict.fromkeys(names, "a further speed, and none to compare it with")
            continue
        ratios = {name: same_motion(work.numbers[name], speed) for name in names}
        known = [ratio.value for ratio in ratios.values() if np.isfinite(ratio.value)]
        middle = float(np.median(known or [np.nan]))
        kept: list[str] = []
        for name, ratio in ratios.items():
            enough = ratio.windows >= 2 * ENOUGH and ratio.agreement >= FOLLOWS
            if enough and abs(ratio.value / middle - 1.0) < ALIKE:
                kept.append(name)
            elif target == GNSS_SPEED and (stated := work.stated(name, "speed")):
                other = "nothing to check it with"
                work.place(target, name, unit=stated, why=_STATED, alternative=other, unproven=True)
            else:
                part = f"factor {ratio.value:.4g} in {ratio.agreement:.0%} of the samples"
                work.left[name] = f"a speed that does not follow the train's ({part})"
        if kept:
            _place_as_speed(work, target, kept, middle)


_STATED = "the file states it"


def _place_as_speed(work: Work, target: str, names: list[str], ratio: float) -> None:
    """Propose columns that are a ratio times the train's speed, in the unit that explains it."""
    stated, turning = work.stated(names[0], "speed"), work.stated(names[0], "rotation")
    turns = bool(turning) or work.meanings[names[0]].quantities[:1] == ("rotation",)
    times = {unit: ratio * factor(unit, "m/s")[0] for unit in (*USUAL_SPEEDS, stated) if unit}
    off = {unit: abs(np.log(each)) if each > 0.0 else np.inf for unit, each in times.items()}
    unit = min(USUAL_SPEEDS, key=off.__getitem__)
    why, other = "no unit is stated; so it is the train's speed", work.speed_open
    fits = not turning and off[unit] < (TOLERANCE if turns else ALIKE)
    if stated and (off[stated] < ALIKE or not fits):
        other = "" if off[stated] < ALIKE else f"{ratio:.3g} times the train's speed"
        unit, why, fits = stated, _STATED, True
    elif stated:
        why, other = f"the file states {stated}, which contradicts the speed", stated
    if fits:
        check = f"{times[unit]:.3f} times the train's speed"
        work.place(
            target, *names, unit=unit, why=why, check=check, alternative=other, unproven=bool(other)
        )
    elif not turns:
        why = f"{ratio:.3g} times the train's speed: no unit does that"
        work.left |= dict.fromkeys(names, why)
    else:
        scale = float(f"{1.0 / ratio:.6g}")
        turning = turning or "rpm"
        radius = scale * _TURNS[turning] / (2.0 * np.pi)
        gear = f"{radius:.4g} m for each radian, so the turns are not the wheels' own (gear)"
        check = f"1 {turning} is {scale:.5g} m/s at the train's speed: "
        check += f"wheels of radius {radius:.3f} m" if 0.25 <= radius <= 0.75 else gear
        work.place(
            target, *names, unit="m/s", scale=scale, check=check,
            why="turns, scaled by the train's speed", alternative=work.speed_open,
            unproven=bool(work.speed_open),
        )  # fmt: skip


def _place_lever(work: Work) -> None:
    """Propose the lever, as a share of its full scale, positive where it drives."""
    name = work.first(LEVER)
    if name is None:
        return
    known = work.numbers[name][np.isfinite(work.numbers[name])]
    size = float(np.percentile(np.abs(known), 99.9)) if known.size else 0.0
    full = {"1": 1.0, "%": 100.0}
    unit = next((unit for unit, top in full.items() if 0.2 * top < size <= 1.06 * top), "")
    if not unit:
        work.left[name] = f"a lever of up to {size:g}: its full scale is not known"
        return
    correlation = 0.0
    if work.speed is not None:
        correlation = driven_mass(work.seconds, work.numbers[name], work.speed).correlation
    turned = correlation < -FOLLOWS
    why = f"read as {'a share' if unit == '1' else 'per cent'}"
    why += "; the train slows down with it, so sign -1" if turned else ""
    other = "" if abs(correlation) >= FOLLOWS else "the opposite sign"
    if known.min() >= 0.0 and not turned:
        other = (
            f"traction alone, or neutral at {0.5 * full[unit] / 100.0 if unit == '%' else 0.5:g}"
        )
    work.place(
        LEVER, name, unit=unit, sign=-1 if turned else 1, why=why, alternative=other,
        check=f"from {known.min():g} to {known.max():g}, correlation with acceleration"
        f" {correlation:.2f}",
    )  # fmt: skip


# --------------------------------------------------------------------- what name and unit speak for


def _place_rest(work: Work) -> None:
    """Fields that only their name and unit speak for."""
    done = {SPEED, GNSS_SPEED, POSITION, LATITUDE, LONGITUDE, LEVER, WHEEL_SPEED, *EFFORTS}
    for target in [role for role in work.names if role not in done | {BOTH, BRAKING}]:
        names = tuple(work.names[target])
        if target != WHEEL_EFFORT:
            names = (work.first(target) or "",)
        if target == MESSAGE:
            work.place(target, *names, why="words")
        elif target == ACCELERATION:
            _place_acceleration(work, names[0])
        else:
            why = _place_plain(work, target, names)
            work.left |= dict.fromkeys(names, why) if why else {}


def _place_acceleration(work: Work, name: str) -> None:
    if work.speed is None:
        work.left[name] = "an acceleration, and no speed to check it with"
        return
    rate, values = rate_of(work.seconds, work.speed), work.numbers[name]
    known = np.isfinite(values) & np.isfinite(rate)
    rate, values = rate[known], values[known]
    vary = known.any() and min(np.ptp(values), np.ptp(rate)) > 0.0
    correlation = float(np.corrcoef(values, rate)[0, 1]) if vary else 0.0
    if abs(correlation) < FOLLOWS:
        work.left[name] = f"an acceleration that is not the speed's (correlation {correlation:.2f})"
        return
    stated = work.stated(name, "acceleration")
    unit = stated or "m/s^2"
    times = float(np.sum(values * rate) / np.sum(rate**2)) * factor(unit, "m/s^2")[0]
    work.place(
        ACCELERATION, name, unit=unit, sign=-1 if correlation < 0 else 1,
        why=_STATED if stated else "the usual unit",
        check=f"{times:.2f} times the change of speed",
        alternative="" if abs(np.log(abs(times))) < FOLLOWS else "another unit",
    )  # fmt: skip


def _place_plain(work: Work, target: str, names: tuple[str, ...]) -> str:
    """Propose a field that is plausible in its unit; else why it is not used."""
    if target.startswith("/gnss/fix") and LATITUDE not in work.proposed:
        return "belongs to a satellite position, and there is none"
    item = field_of(target)[2]
    recorded, stated = item.recorded or Recorded(""), work.meanings[names[0]].unit or ""
    unit, why, other = stated, "the file states the unit", ""
    if not stated:
        unit, why = item.usual_unit, "the usual unit"
        other = "" if target.endswith(("satellites", "pdop", "accuracy")) else "another unit"
        like = {"N": (TRACTION, DYNAMIC), "m/s": (SPEED, GNSS_SPEED)}.get(item.unit)
        if like is not None and item.recorded is None:
            unit, why = work.unit_of(*like), "the unit of the others of its kind"
    raw = np.concatenate([work.numbers[name] for name in names])
    known = raw[np.isfinite(raw)]
    force = item.unit == "N"
    sign = _sign(raw) if force and not item.per_axle else 1
    if not unit or sign == 0 or (force and stated == "%"):
        return "without a unit, in per cent, or of both signs"
    # Large integers of a receiver are thousandths or hundredths, as its positions are.
    scale, size = 1.0, float(np.median(np.abs(known)))
    beside = work.proposed.get(LATITUDE)
    if not stated and recorded.integers and np.all(known == np.round(known)) and beside is not None:
        big = 20_000.0 if target.endswith("altitude") else 60.0
        if size > big and beside.column.scale != 1.0:
            scale, why, other = recorded.integers, "integers, as the receiver's positions", ""
    try:
        factor(unit, item.unit or "1")
    except InputError:
        return f"'{unit}' is not a unit of {target}"
    low, high = recorded.plausible or (item.bounds.low, item.bounds.high)
    column = Column(column=names[0], unit=unit, scale=scale, sign=sign)
    values = in_si(target, column, known)
    middle = float(np.median(values))
    if float(np.mean((values >= low) & (values <= high))) < 0.9:
        return f"not plausible as {target} in {unit} (median {middle:.4g} {item.unit})"
    median = float(np.median(known * scale))
    work.place(
        target, *names, unit=unit, scale=scale, sign=sign, why=why, alternative=other,
        unproven=bool(other), check=f"median {median:.4g} {unit}",
    )  # fmt: skip
    return ""


def keep_others(work: Work) -> None:
    """Propose what no field is for, but has a stated unit, for a topic of the recorder's own."""
    for name, why in list(work.left.items()):
        unit = work.meanings[name].unit
        slug = re.sub(r"[^a-z0-9]+", "_", plain(split_unit(name)[0])).strip("_")
        target = f"{RECORDED}other.{slug}"
        unknown = why.startswith((NO_FIELD, UNKNOWN)) and name in work.numbers
        if unit is None or not unknown or not slug[:1].isalpha() or target in work.proposed:
            continue
        try:
            si_unit(unit)
        except InputError:
            continue
        del work.left[name]
        why += ": kept in a topic of the recorder's own"
        work.place(target, name, unit=unit, meaning=name, why=why)


# --------------------------------------------------------- what states facts of each trip


def find_trips(work: Work) -> None:
    """Find the columns among those that became no field; they are taken from `work.left`."""
    number = _number(work)
    parted = np.diff(work.clock.time) > PAUSE * NANOSECONDS
    if number is not None:
        cells = _cells(work, number)
        parted = parted | (cells[1:] != cells[:-1])
    labels = np.cumsum(np.concatenate(([0], parted)))
    load = _load(work, labels)
    work.trips = TripColumns(number=number, load=load, weather=_weather(work, labels))


def _bare(text: str) -> str:
    """The letters of a text, in plain spelling."""
    return re.sub(r"[^a-z]", "", plain(text))


def _stems(key: str) -> list[str]:
    return [plain(stem) for stem in vocabulary()["trip"][key].split()]


def _cells(work: Work, name: str) -> NDArray[np.object_]:
    """The text of a column; an empty cell has that of the row before."""
    return carried_on(words_in(work.layout.table[name]))


def _number(work: Work) -> str | None:
    """The column that numbers the trips."""
    number = "|".join(_stems("number"))
    for key in ("trip", "train"):
        noun = "|".join(_stems(key))
        pattern = re.compile(rf"({noun})s?({number})?|({number})(de|du|of|der)?({noun})s?")
        for name in list(work.left):
            if work.meanings[name].unit is not None or not pattern.fullmatch(_bare(name)):
                continue
            cells = _cells(work, name)
            edges = np.flatnonzero(np.concatenate(([True], cells[1:] != cells[:-1], [True])))
            if np.diff(edges).min() < ENOUGH or not cells[0]:
                why = "may number trips, but it is not constant over blocks of rows"
                work.left[name] = why
                continue
            labels = [str(cells[first]) for first in edges[:-1]]
            shown = f"{len(labels)}: {', '.join(labels[:6])}{', ...' if len(labels) > 6 else ''}"
            why = f"column '{name}' numbers them: it is constant over blocks of rows"
            work.readings.append(Reading("trips", shown, why))
            del work.left[name]
            return name
    return None


def _load(work: Work, labels: IntArray) -> LoadColumn | None:
    """The column of the load, where it is constant over each trip."""
    for name in [name for name in work.left if name in work.numbers]:
        bare, stated = _bare(split_unit(name)[0]), work.meanings[name].unit or ""
        values = work.layout.number(name)
        known = np.isfinite(values)
        named = any(stem in bare for stem in _stems("load")) and stated in ("t", "kg", "")
        if not named or not known.any() or float(np.nanmin(values)) < 0.0:
            continue
        loads = [values[known & (labels == each)] for each in np.unique(labels[known])]
        top = float(np.nanmax(values))
        if any(float(np.ptp(each)) > CONSTANT * top for each in loads):
            continue
        unit, other = ("t", "kg") if top < 500.0 else ("kg", "t")
        why = f"no unit is stated; {top:g} of them"
        if stated:
            unit, other, why = stated, "", f"the file states {stated}"
        shown = ", ".join(f"{float(np.median(each)):g}" for each in loads[:6])
        why += f"; constant over each trip: {shown}"
        work.readings.append(Reading("load", f"column '{name}' [{unit}]", why, other))
        del work.left[name]
        return LoadColumn(column=name, unit=unit)
    return None


def _weather(work: Work, labels: IntArray) -> WeatherColumn | None:
    """The column of the rail's condition, where all its words are known."""
    conditions = {
        plain(word): condition
        for condition, words in vocabulary()["weather"].items()
        for word in words.split()
    }
    for name in [name for name in work.left if name not in work.numbers]:
        if not _bare(name).startswith(tuple(_stems("weather"))):
            continue
        cells = _cells(work, name).astype(str)
        words = [str(word) for word in dict.fromkeys(cells.tolist()) if word]
        unknown = ", ".join(f"'{word}'" for word in words if _bare(word) not in conditions)
        if unknown or not words:
            work.left[name] = f"a weather in words that are not known: {unknown or 'none'}"
        elif any(np.unique(cells[labels == each]).size > 1 for each in np.unique(labels)):
            work.left[name] = "a weather that changes within a trip"
        else:
            meant = {word: conditions[_bare(word)] for word in words}
            shown = ", ".join(f"'{word}' is {condition}" for word, condition in meant.items())
            why = f"constant over each trip: {shown}"
            work.readings.append(Reading("weather", f"column '{name}'", why))
            del work.left[name]
            return WeatherColumn(column=name, words=meant)
    return None
