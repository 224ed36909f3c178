"""What the columns of an unknown table are: by name and unit, checked by physics."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.ingest.motion import driven_mass, rate_of
from trainlog.ingest.proposal import roles
from trainlog.ingest.proposal.layout import Layout, Reading
from trainlog.ingest.proposal.motion import (
    AMBIGUOUS,
    FASTEST,
    SCALES,
    Answer,
    Motion,
    Position,
    Question,
    Ratio,
    Units,
    positions_of,
    same_motion,
    units_of,
)
from trainlog.ingest.proposal.times import Clock
from trainlog.ingest.proposal.trips import facts_of
from trainlog.ingest.proposal.vocabulary import Meaning, dimension_of, plain, split_unit
from trainlog.ingest.proposal.work import Proposed, Work, said, unit_reason
from trainlog.ingest.recording import field_of
from trainlog.railway.train import Train
from trainlog.topics import RECORDED, Recorded
from trainlog.units import KMH, factor, si_unit

LEVELS = 8
"""Different values that an effort without a stated unit of force has at least."""


STRONG = 0.05
"""Share of the largest effort from which on its sign counts."""


BOTH_SIGNS = 0.02
"""Share of the samples of the rarer sign from which on a column has both."""


@dataclass(frozen=True, slots=True)
class _Signs:
    """Which signs the strong values of a column have."""

    positive: float
    negative: float

    @property
    def both(self) -> bool:
        return min(self.positive, self.negative) > BOTH_SIGNS


EITHER_BRAKE = "the friction brakes' or the sum of both brakes"
"""Open of a braking effort whose brake is not stated: it is taken as the dynamic one's."""


def _signs(values: FloatArray) -> _Signs:
    known = values[np.isfinite(values)]
    top = float(np.percentile(np.abs(known), 99.5)) if known.size else 0.0
    if top == 0.0:
        return _Signs(0.0, 0.0)
    return _Signs(float(np.mean(known > STRONG * top)), float(np.mean(known < -STRONG * top)))


def effort_signs(work: Work, speed: str | None) -> None:
    """Which columns are traction, which braking, with which sign; proposals without a unit yet."""
    for role in (roles.TRACTION, roles.SIGNED, roles.DYNAMIC, roles.PNEUMATIC, roles.BRAKING):
        for name in list(work.names.get(role, [])):
            force = dimension_of(work.meanings[name].unit or "") == "force"
            if not force and np.unique(work.numbers[name]).size < LEVELS:
                work.names[role].remove(name)
                work.left[name] = f"an effort of fewer than {LEVELS} values: a state?"
    main = work.first(roles.TRACTION)
    both = work.first(roles.SIGNED)
    if main is not None and both is not None:
        work.left[both] = f"an effort beside '{main}', not stated of which kind"
        both = None
    for role in (roles.DYNAMIC, roles.PNEUMATIC):
        stated = work.first(role)
        if stated is not None:
            _add_braking(work, role, stated, "")
    braking = work.first(roles.BRAKING)
    if braking is not None:
        taken = [role for role in (roles.DYNAMIC, roles.PNEUMATIC) if role in work.proposed]
        if len(taken) == 2:
            work.left[braking] = "a braking effort beside those of both brakes"
        else:
            target = roles.PNEUMATIC if taken == [roles.DYNAMIC] else roles.DYNAMIC
            other = "" if taken else EITHER_BRAKE
            _add_braking(work, target, braking, other)
    driving = main or both
    if driving is not None:
        _add_driving(work, driving, speed)


def _add_braking(work: Work, target: str, name: str, other: str) -> None:
    signs = _signs(work.numbers[name])
    if signs.both:
        work.left[name] = "a braking effort of both signs"
        return
    sign: Literal[1, -1] = -1 if signs.negative > signs.positive else 1
    shown = "negative, sign -1" if sign < 0 else "positive"
    work.place(target, (name,), "", sign=sign, why=f"braking is {shown}", alternative=other)


def _add_driving(work: Work, name: str, speed: str | None) -> None:
    """An effort that drives the train, and perhaps brakes it, too."""
    values = work.numbers[name]
    signs = _signs(values)
    correlation = 0.0
    if speed is not None:
        correlation = driven_mass(
            work.motion.seconds, values, np.abs(work.numbers[speed])
        ).correlation
    if signs.both:
        inverted = correlation < -0.3
        scale = -1.0 if inverted else 1.0
        weak = abs(correlation) < 0.3
        why = f"of both signs, {'negative' if inverted else 'positive'} drives"
        other = "the opposite sign" if weak else ""
        work.place(roles.TRACTION, (name,), "", scale, part="positive", why=why, alternative=other)
        if roles.DYNAMIC not in work.proposed:
            work.place(
                roles.DYNAMIC, (name,), "", scale, part="negative", why=why,
                alternative=other or ("" if roles.PNEUMATIC in work.proposed else
                                      "with the friction brakes in it")
            )  # fmt: skip
        return
    negative = signs.negative > signs.positive
    drives = correlation * (-1.0 if negative else 1.0) > -0.3
    # A traction that is negative where it drives is written with the sign turned.
    why = "traction only, negative: sign -1" if negative else "traction only"
    other = "" if drives else "braking: the train slows down with it"
    sign: Literal[1, -1] = -1 if negative else 1
    work.place(roles.TRACTION, (name,), "", sign=sign, why=why, alternative=other)


EFFORTS = {roles.TRACTION: 1.0, roles.DYNAMIC: -1.0, roles.PNEUMATIC: -1.0}
"""Fields whose sum, with these signs, moves the train."""


def net_effort(work: Work) -> tuple[FloatArray | None, str]:
    """The effort that drives the train, in the unit that the first column states, and the unit."""
    proposals = [work.proposed[name] for name in EFFORTS if name in work.proposed]
    if not any(each.field == roles.TRACTION for each in proposals):
        return None, ""
    stated = [work.stated(each.columns[0], "force") for each in proposals]
    unit = next((each for each in stated if each), "")
    total = np.zeros(work.motion.order.size)
    for each, own in zip(proposals, stated, strict=True):
        size = factor(own, unit)[0] if own and unit else 1.0
        total += EFFORTS[each.field] * size * np.nan_to_num(_part(work, each))
    return total, unit


def _part(work: Work, proposed: Proposed) -> FloatArray:
    """A proposed column with its scale, part and sign, not yet in its unit."""
    values = work.numbers[proposed.columns[0]] * proposed.scale + proposed.offset
    if proposed.part == "positive":
        values = np.maximum(values, 0.0)
    elif proposed.part == "negative":
        values = np.maximum(-values, 0.0)
    return values * proposed.sign


def add_efforts(work: Work, answer: Answer, stated: Units) -> None:
    """Give the efforts their unit."""
    for target in EFFORTS:
        proposed = work.proposed.get(target)
        if proposed is None:
            continue
        name = proposed.columns[0]
        own = work.stated(name, "force")
        if work.meanings[name].unit == "%":
            del work.proposed[target]
            work.left[name] = "an effort in per cent of a maximum that is not stated"
            continue
        unit = answer.units.force or own
        if own and stated.force and answer.units.force == stated.force:
            unit = own
        if not unit:
            del work.proposed[target]
            work.left[name] = "an effort without a unit, and nothing to find it from"
            continue
        why, other = unit_reason(own, unit, answer.alternatives.get("force", ()))
        mass = answer.mass
        check = "no acceleration to check it with"
        if np.isfinite(mass):
            known = f", the train's is {work.train.mass / 1e3:.0f} t" if work.train else ""
            check = (
                f"it accelerates {mass / 1e3:.0f} t{known}"
                f" (correlation with acceleration {answer.correlation:.2f})"
            )
        elif answer.correlation:
            check = f"correlation with acceleration {answer.correlation:.2f}: decides nothing"
            if not own:
                other = other or "another unit"
        why, other = f"{why}; {proposed.why}", said(proposed.alternative, other)
        work.proposed[target] = replace(
            proposed, unit=unit, why=why, check=check, alternative=other
        )


def place_other_efforts(work: Work) -> None:
    """Efforts asked for and those of axles: in their stated unit, or that of the efforts."""
    main = work.proposed.get(roles.TRACTION) or work.proposed.get(roles.DYNAMIC)
    for target in (roles.TRACTION_DEMAND, roles.BRAKING_DEMAND, roles.WHEEL_EFFORT):
        axles = target == roles.WHEEL_EFFORT
        first = None if axles else work.first(target)
        names = tuple(work.names.get(target, ())) if axles else (first,) if first else ()
        if not names:
            continue
        stated = work.stated(names[0], "force")
        unit = stated or (main.unit if main else "")
        signs = _signs(np.concatenate([work.numbers[name] for name in names]))
        if not unit or work.meanings[names[0]].unit == "%" or (signs.both and not axles):
            why = "a further effort, without a unit, in per cent, or of both signs"
            work.left |= dict.fromkeys(names, why)
            continue
        why = "the file states it" if stated else "the unit of the effort"
        negative = signs.negative > signs.positive and not axles
        work.place(
            target, names, unit, sign=-1 if negative else 1, why=why,
            alternative="" if stated else "another unit"
        )  # fmt: skip


USUAL_SPEEDS = ("km/h", "m/s", "mph", "knot")
"""Units that a further speed is tried in."""


TURNING = 0.02
"""Deviation up to which a column that is called turns is a speed after all."""


_TURNS = {"rpm": 60.0, "Hz": 1.0, "rad/s": 2.0 * np.pi}
"""Of one turn a second, in each unit."""


def place_speeds(work: Work) -> None:
    """Further speeds, in the unit in which they are the train's: the receiver's, and limits."""
    for target in (roles.SPEED, roles.GNSS_SPEED):
        names = [n for n in work.names.get(target, []) if target in work.proposed]
        for second in names[1:]:
            work.left[second] = f"a second column for {target}; '{names[0]}' is used"
    name = work.first(roles.GNSS_SPEED)
    if name is not None and roles.GNSS_SPEED not in work.proposed and work.speed is not None:
        ratio = same_motion(work.numbers[name], work.speed)
        unit, why, other = _speed_unit(work, name, ratio)
        if unit:
            check = f"{ratio.value * factor(unit, 'm/s')[0]:.3f} times the train's speed"
            work.place(roles.GNSS_SPEED, (name,), unit, why=why, check=check, alternative=other)
        else:
            work.left[name] = why
    name = work.first("/environment.speed_limit")
    if name is not None:
        unit = work.stated(name, "speed")
        main = work.proposed.get(roles.SPEED) or work.proposed.get(roles.GNSS_SPEED)
        same = "" if unit else "another unit than the speed's"
        unit = unit or (main.unit if main else "")
        if unit:
            top = KMH * float(np.nanmax(work.numbers[name])) * factor(unit, "m/s")[0]
            work.place(
                "/environment.speed_limit", (name,), unit,
                why="the file states it" if not same else "the unit of the speed",
                check=f"up to {top:.0f} km/h", alternative=same
            )  # fmt: skip
        else:
            work.left[name] = "a speed limit without a unit"


def _speed_unit(work: Work, name: str, ratio: Ratio) -> tuple[str, str, str]:
    """The unit in which a column is the train's speed: unit (empty if none), why, alternative."""
    stated = work.stated(name, "speed")
    if ratio.windows < 20 or ratio.agreement < 0.5:
        if stated:
            return stated, "the file states it", "nothing to check it with"
        return "", "a speed that does not follow the train's", ""
    off = {unit: abs(np.log(ratio.value * factor(unit, "m/s")[0])) for unit in USUAL_SPEEDS}
    best = min(off, key=lambda unit: off[unit])
    if stated and off[stated] < 0.12:
        return stated, "the file states it", ""
    if off[best] < 0.08:
        if stated:
            return best, f"the file states {stated}, which contradicts the speed", f"{stated}"
        return best, "no unit is stated; so it is the train's speed", work.speed_open
    if stated:
        return stated, "the file states it", f"{ratio.value:.3g} times the train's speed"
    return "", f"{ratio.value:.3g} times the train's speed: no unit does that", ""


def place_wheels(work: Work) -> None:
    """Speeds of the axles."""
    names = work.names.get(roles.WHEEL_SPEED, [])
    if names:
        _wheel_speeds(work, tuple(names))


def _wheel_speeds(work: Work, names: tuple[str, ...]) -> None:
    if work.speed is None:
        work.left |= dict.fromkeys(names, "wheel speeds, and no speed to compare them with")
        return
    ratios = [same_motion(work.numbers[name], work.speed) for name in names]
    values = np.array([ratio.value for ratio in ratios])
    middle = float(np.nanmedian(values)) if np.isfinite(values).any() else np.nan
    follows = [r.agreement >= 0.5 and abs(r.value / middle - 1.0) < 0.1 for r in ratios]
    for name, good, ratio in zip(names, follows, ratios, strict=True):
        if not good:
            work.left[name] = (
                "a wheel speed that does not follow the train's"
                f" (factor {ratio.value:.4g} in {ratio.agreement:.0%} of the samples)"
            )
    kept = tuple(name for name, good in zip(names, follows, strict=True) if good)
    if not kept:
        return
    joint = Ratio(middle, min(r.agreement for r, g in zip(ratios, follows, strict=True) if g), 20)
    turning = work.stated(kept[0], "rotation")
    named = work.meanings[kept[0]].quantity == "rotation"
    unit = why = ""
    if not turning:
        unit, why, other = _speed_unit(work, kept[0], joint)
        if unit and named and abs(np.log(middle * factor(unit, "m/s")[0])) > TURNING:
            unit = ""
    if unit:
        check = f"{middle * factor(unit, 'm/s')[0]:.3f} times the train's speed"
        work.place(roles.WHEEL_SPEED, kept, unit, why=why, check=check, alternative=other)
        return
    if not turning and not named:
        work.left |= dict.fromkeys(kept, why)
        return
    scale = float(f"{1.0 / middle:.6g}")
    turns = _TURNS[turning or "rpm"]
    radius = scale * turns / (2.0 * np.pi)
    check = f"1 {turning or 'rpm'} is {scale:.5g} m/s at the train's speed"
    if 0.25 <= radius <= 0.75:
        check += f": wheels of radius {radius:.3f} m"
    else:
        check += f": {radius:.4g} m for each radian, so the turns are not the wheels' own (gear)"
    work.place(
        roles.WHEEL_SPEED, kept, "m/s", scale, why="turns, scaled by the train's speed",
        alternative=work.speed_open,
        check=check
    )  # fmt: skip


def place_lever(work: Work) -> None:
    """Propose the lever, as a share of its full scale, positive where it drives."""
    name = work.first(roles.LEVER)
    if name is None:
        return
    values = work.numbers[name]
    known = values[np.isfinite(values)]
    size = float(np.percentile(np.abs(known), 99.9)) if known.size else 0.0
    unit = "1" if 0.2 < size <= 1.06 else "%" if 20.0 < size <= 106.0 else ""
    if not unit:
        work.left[name] = f"a lever of up to {size:g}: its full scale is not known"
        return
    correlation = 0.0
    if work.speed is not None:
        correlation = driven_mass(work.motion.seconds, values, work.speed).correlation
    turned = correlation < -0.4
    check = (
        f"from {known.min():g} to {known.max():g}, correlation with acceleration {correlation:.2f}"
    )
    why = f"read as {'a share' if unit == '1' else 'per cent'}"
    if turned:
        why += "; the train slows down with it, so sign -1"
    other = "" if abs(correlation) >= 0.2 else "the opposite sign"
    if known.min() >= 0.0:
        other = "traction alone" if not turned else other
        middle = 0.5 * (0.01 if unit == "%" else 1.0)
        other += f", or neutral at {middle:g}" if other else ""
    work.place(
        roles.LEVER, (name,), unit, sign=-1 if turned else 1, why=why, check=check,
        alternative=other
    )  # fmt: skip


def place_rest(work: Work) -> None:
    """Fields that only their name and unit speak for."""
    done = {
        roles.POSITION, roles.SPEED, roles.GNSS_SPEED, roles.LATITUDE, roles.LONGITUDE,
        roles.LEVER, roles.WHEEL_SPEED, roles.WHEEL_EFFORT, roles.SIGNED,
        roles.BRAKING, roles.TRACTION_DEMAND, roles.BRAKING_DEMAND, "/environment.speed_limit",
        *EFFORTS,
    }  # fmt: skip
    for target in [target for target in work.names if target not in done]:
        name = work.first(target)
        if name is None:
            continue
        if target == "/events.message":
            work.place(target, (name,), "", why="words")
        elif target == roles.ACCELERATION:
            _place_acceleration(work, name)
        else:
            _place_plain(work, target, name)


def keep_others(work: Work) -> None:
    """Propose what no field is for, but has a stated unit, for a topic of the recorder's own."""
    taken: set[str] = set()
    for name, why in list(work.left.items()):
        meaning = work.meanings[name]
        unknown = why.startswith((roles.NO_FIELD, roles.UNKNOWN))
        if name not in work.numbers or meaning.unit is None or not unknown:
            continue
        slug = re.sub(r"[^a-z0-9]+", "_", plain(split_unit(name)[0])).strip("_")
        if not re.match(r"[a-z]", slug) or slug in taken:
            continue
        try:
            si_unit(meaning.unit)
        except InputError:
            continue
        taken.add(slug)
        del work.left[name]
        work.place(
            f"{RECORDED}other.{slug}", (name,), meaning.unit, meaning=name,
            why=f"{why}: kept in a topic of the recorder's own"
        )  # fmt: skip


def _place_acceleration(work: Work, name: str) -> None:
    if work.speed is None:
        work.left[name] = "an acceleration, and no speed to check it with"
        return
    rate = rate_of(work.motion.seconds, work.speed)
    values = work.numbers[name]
    known = np.isfinite(values) & np.isfinite(rate)
    if np.std(values[known]) == 0.0:
        work.left[name] = "an acceleration that does not change"
        return
    correlation = float(np.corrcoef(values[known], rate[known])[0, 1])
    slope = float(np.sum(values[known] * rate[known]) / np.sum(rate[known] ** 2))
    if abs(correlation) < 0.5:
        work.left[name] = f"an acceleration that is not the speed's (correlation {correlation:.2f})"
        return
    off = {
        unit: abs(np.log(abs(slope) * factor(unit, "m/s^2")[0]))
        for unit in ("m/s^2", "standard_gravity")
    }
    stated = work.stated(name, "acceleration")
    unit = stated or min(off, key=lambda each: off[each])
    check = f"{slope * factor(unit, 'm/s^2')[0]:.2f} times the change of speed"
    other = "" if off[unit] < 0.5 else "another unit"
    work.place(
        roles.ACCELERATION, (name,), unit, sign=-1 if correlation < 0 else 1,
        why="the file states it" if stated else "as the speed changes", check=check,
        alternative=other
    )  # fmt: skip


def _place_plain(work: Work, target: str, name: str) -> None:
    """A field that is plausible in its unit, or not used."""
    gnss = target.startswith("/gnss/fix")
    if gnss and roles.LATITUDE not in work.proposed:
        work.left[name] = "belongs to a satellite position, and there is none"
        return
    item = field_of(target)[2]
    recorded, si = item.recorded or Recorded(""), item.unit or "1"
    stated = work.meanings[name].unit or ""
    unit, scale = stated or item.usual_unit, 1.0
    values = work.numbers[name]
    known = values[np.isfinite(values)]
    pure = ("satellites", "pdop", "accuracy")
    other = "" if stated or target.endswith(pure) else "another unit"
    why = "the file states the unit" if stated else "the usual unit"
    whole = bool(np.all(known == np.round(known)))
    # Large integers of a receiver are thousandths or hundredths.
    if not stated and whole and recorded.integers and float(np.median(np.abs(known))) > 60.0:
        big = 20_000.0 if target.endswith("altitude") else 60.0
        beside = work.proposed.get(roles.LATITUDE)
        if float(np.median(np.abs(known))) > big and beside is not None and beside.scale != 1.0:
            scale, why = recorded.integers, "integers, as the receiver's positions"
            other = ""
    low, high = recorded.plausible or (item.bounds.low, item.bounds.high)
    try:
        slope, offset = factor(unit, si)
    except InputError:
        work.left[name] = f"'{unit}' is no unit of {target}"
        return
    values_si = known * scale * slope + offset
    inside = float(np.mean((values_si >= low) & (values_si <= high)))
    if inside < 0.9:
        middle = float(np.median(values_si))
        work.left[name] = f"not plausible as {target} in {unit} (median {middle:.4g} {si})"
        return
    middle = float(np.median(known * scale))
    text = f"median {middle:.4g} {unit}"
    work.place(target, (name,), unit, scale, why=why, check=text, alternative=other)


NUMERIC = 0.6
"""Share of numbers from which on a column is one of numbers."""


SLOWEST_STEP = 30.0
"""Usual step [s] beyond which rows are no recording of motion."""


LEAST_ROWS = 10


MOST_UNNAMED = 12
"""Columns of unknown names that are compared two by two."""

OTHER_FIXES = 5.0
"""Cost up to which another reading of the fixes is tried with the units of the speed."""


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
            numbers[name] = kept[motion.order]
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
    place_other_efforts(work)
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
        other = said(other, f"they move {off:.3g} times the speed")
    _add_fixes(work, place, other)
    if speed is not None:
        work.speed = work.numbers[speed] * factor(answer.units.speed, "m/s")[0]
        _add_speed(work, speed, answer, stated, place)
    if position is not None:
        _add_position(work, position, answer, stated)
    add_efforts(work, answer, stated)


def _main_speed(work: Work) -> str | None:
    """The column of the train's speed: by name, or else with the distance that it integrates to."""
    named = work.first(roles.SPEED) or work.first(roles.GNSS_SPEED)
    if named is not None:
        return named
    return None if work.names.get(roles.POSITION) else _unnamed_pair(work)


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
    """The column of the distance: by name, or else by what it follows."""
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
    first, second = work.numbers[north[0]], work.numbers[east[0]]
    # A receiver without a fix gives zero for both.
    absent = (first == 0.0) & (second == 0.0)
    first, second = np.where(absent, np.nan, first), np.where(absent, np.nan, second)
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
    plain = place.scale in ("degrees", "radians", "degrees and minutes")
    scale = 1.0 if plain else SCALES[place.scale][0]
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
        work.place(
            target, (name,), unit, scale, sign=_hemisphere(work, letters), notation=notation,
            why=why, check=check, alternative=other
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
        roles.WHEEL_SPEED, roles.WHEEL_EFFORT, roles.ACCELERATION,
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
        other = said(other, "no unit explains how fast the fixes move")
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
    work.place(
        target, (name,), answer.units.speed, sign=sign, why=why, check=", ".join(checks),
        alternative=said(alternative, other)
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
    sign, offset = 1, 0.0
    if falling:
        sign, offset = -1, -float(np.ceil(known[0] * length / 1e3)) * 1e3 / length
        why += "; it falls, so the train runs against it: sign -1"
        alternative = said(alternative, f"offset = minus the line's length, not {offset:g}")
    work.place(
        roles.POSITION, (name,), answer.units.length, sign=sign, offset=offset, why=why,
        check=", ".join(checks), alternative=alternative,
    )  # fmt: skip
