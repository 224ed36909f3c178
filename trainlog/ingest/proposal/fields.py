"""Fields of an unknown table beside its motion: wheels, receiver, lever, surroundings."""

from __future__ import annotations

import re

import numpy as np

from trainlog.errors import InputError
from trainlog.ingest.proposal import roles
from trainlog.ingest.proposal.checks import Ratio, driven_mass, same_motion
from trainlog.ingest.proposal.efforts import EFFORTS, place_torques, place_wheel_efforts
from trainlog.ingest.proposal.vocabulary import plain, split_unit
from trainlog.ingest.proposal.work import Proposed, Work
from trainlog.ingest.recording import field_of
from trainlog.topics import RECORDED, Recorded
from trainlog.units import KMH, factor, si_unit

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
            work.add(
                Proposed(roles.GNSS_SPEED, (name,), unit, why=why, check=check, alternative=other)
            )
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
            work.add(
                Proposed(
                    "/environment.speed_limit", (name,), unit,
                    why="the file states it" if not same else "the unit of the speed",
                    check=f"up to {top:.0f} km/h", alternative=same,
                )
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
    """Speeds and efforts of the axles."""
    names = work.names.get(roles.WHEEL_SPEED, [])
    if names:
        _wheel_speeds(work, tuple(names))
    names = work.names.get(roles.WHEEL_EFFORT, [])
    if names:
        place_wheel_efforts(work, tuple(names))
    names = work.names.get(roles.TORQUE, [])
    if names and roles.WHEEL_EFFORT in work.proposed:
        for name in names:
            work.left[name] = "a torque beside the axles' efforts"
    elif names:
        place_torques(work, tuple(names))


def _wheel_speeds(work: Work, names: tuple[str, ...]) -> None:
    if work.speed is None:
        stated = work.stated(names[0], "speed")
        if stated:
            why = "the file states it"
            other = "nothing to check it with"
            work.add(Proposed(roles.WHEEL_SPEED, names, stated, why=why, alternative=other))
        else:
            for name in names:
                work.left[name] = "turns, and no speed to find the wheel's circumference from"
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
        work.add(Proposed(roles.WHEEL_SPEED, kept, unit, why=why, check=check, alternative=other))
        return
    if not turning and not named:
        for name in kept:
            work.left[name] = why
        return
    scale = float(f"{1.0 / middle:.6g}")
    turns = _TURNS[turning or "rpm"]
    radius = scale * turns / (2.0 * np.pi)
    check = f"1 {turning or 'rpm'} is {scale:.5g} m/s at the train's speed"
    if 0.25 <= radius <= 0.75:
        check += f": wheels of radius {radius:.3f} m"
    else:
        check += f": {radius:.4g} m for each radian, so the turns are not the wheels' own (gear)"
    work.add(
        Proposed(
            roles.WHEEL_SPEED, kept, "m/s", scale, why="turns, scaled by the train's speed",
            alternative=work.speed_open,
            check=check,
        )
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
        correlation = driven_mass(work.motion, values, work.speed).correlation
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
    work.add(
        Proposed(
            roles.LEVER, (name,), unit, sign=-1 if turned else 1, why=why, check=check,
            alternative=other,
        )
    )  # fmt: skip


def place_rest(work: Work) -> None:
    """Fields that only their name and unit speak for."""
    done = {
        roles.POSITION, roles.SPEED, roles.GNSS_SPEED, roles.LATITUDE, roles.LONGITUDE,
        roles.LEVER, roles.WHEEL_SPEED, roles.WHEEL_EFFORT, roles.TORQUE, roles.SIGNED,
        roles.BRAKING, roles.TRACTION_DEMAND, roles.BRAKING_DEMAND, "/environment.speed_limit",
        *EFFORTS,
    }  # fmt: skip
    for target in [target for target in work.names if target not in done]:
        name = work.first(target)
        if name is None:
            continue
        if target == "/events.message":
            work.add(Proposed(target, (name,), "", why="words"))
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
        work.add(
            Proposed(
                f"{RECORDED}other.{slug}", (name,), meaning.unit, meaning=name,
                why=f"{why}: kept in a topic of the recorder's own",
            )
        )  # fmt: skip


def _place_acceleration(work: Work, name: str) -> None:
    if work.speed is None:
        work.left[name] = "an acceleration, and no speed to check it with"
        return
    rate = work.motion.derivative(work.speed)
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
    work.add(
        Proposed(
            roles.ACCELERATION, (name,), unit, sign=-1 if correlation < 0 else 1,
            why="the file states it" if stated else "as the speed changes", check=check,
            alternative=other,
        )
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
    dilution = work.meanings[name].quantity == "horizontal_dilution"
    if dilution:
        unit, why, other = "m", "HDOP; an axis has 3 m at an HDOP of 1", "another accuracy"
        scale = 0.03 if whole and float(np.median(known)) > 20.0 else 3.0
    low, high = recorded.plausible or (item.bounds.low, item.bounds.high)
    try:
        slope, offset = factor(unit, si)
    except InputError:
        work.left[name] = f"'{unit}' is no unit of {target}"
        return
    if target.endswith("line_voltage") and not stated and float(np.median(np.abs(known))) > 100.0:
        unit, slope = "V", 1.0
    values_si = known * scale * slope + offset
    inside = float(np.mean((values_si >= low) & (values_si <= high)))
    if inside < 0.9:
        middle = float(np.median(values_si))
        work.left[name] = f"not plausible as {target} in {unit} (median {middle:.4g} {si})"
        return
    middle = float(np.median(known * scale))
    text = f"median {middle:.4g} {unit}"
    work.add(Proposed(target, (name,), unit, scale, why=why, check=text, alternative=other))
