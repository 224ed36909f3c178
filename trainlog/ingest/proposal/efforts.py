"""Efforts of an unknown table: which drive, which brake, in which unit and sign."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.ingest.proposal import roles
from trainlog.ingest.proposal.checks import driven_mass, same_motion
from trainlog.ingest.proposal.motion import Answer, Units
from trainlog.ingest.proposal.work import Proposed, Work, unit_reason
from trainlog.units import factor

LEVELS = 8
"""Different values that an effort has at least."""


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
            if np.unique(work.numbers[name]).size < LEVELS:
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
        _add_driving(work, driving, speed, known_as_traction=main is not None)


def _add_braking(work: Work, target: str, name: str, other: str) -> None:
    signs = _signs(work.numbers[name])
    if signs.both:
        negative = signs.negative >= signs.positive
        part: Literal["positive", "negative"] = "negative" if negative else "positive"
        work.add(
            Proposed(
                target, (name,), "", part=part, why=f"of both signs, the {part} ones are taken",
                alternative="; ".join(filter(None, [other, "the other sign"])),
            )
        )  # fmt: skip
        return
    sign: Literal[1, -1] = -1 if signs.negative > signs.positive else 1
    shown = "negative, sign -1" if sign < 0 else "positive"
    work.add(Proposed(target, (name,), "", sign=sign, why=f"braking is {shown}", alternative=other))


def _add_driving(work: Work, name: str, speed: str | None, *, known_as_traction: bool) -> None:
    """An effort that drives the train, and perhaps brakes it, too."""
    values = work.numbers[name]
    signs = _signs(values)
    correlation = 0.0
    if speed is not None:
        correlation = driven_mass(work.motion, values, np.abs(work.numbers[speed])).correlation
    if signs.both:
        inverted = correlation < -0.3
        scale = -1.0 if inverted else 1.0
        weak = abs(correlation) < 0.3
        why = f"of both signs, {'negative' if inverted else 'positive'} drives"
        other = "the opposite sign" if weak else ""
        work.add(
            Proposed(
                roles.TRACTION, (name,), "", scale, part="positive", why=why, alternative=other
            )
        )
        if roles.DYNAMIC not in work.proposed:
            work.add(
                Proposed(
                    roles.DYNAMIC, (name,), "", scale, part="negative", why=why,
                    alternative=other or ("" if roles.PNEUMATIC in work.proposed else
                                          "with the friction brakes in it"),
                )
            )  # fmt: skip
        return
    negative = signs.negative > signs.positive
    drives = correlation * (-1.0 if negative else 1.0) > -0.3
    sign: Literal[1, -1] = -1 if negative else 1
    if drives or known_as_traction:
        # A traction that is negative where it drives is written with the sign turned.
        why = "traction only, negative: sign -1" if negative else "traction only"
        other = "" if drives else "braking: the train slows down with it"
        work.add(Proposed(roles.TRACTION, (name,), "", sign=sign, why=why, alternative=other))
        return
    target = roles.DYNAMIC if roles.DYNAMIC not in work.proposed else roles.PNEUMATIC
    if target in work.proposed:
        work.left[name] = "a further braking effort"
        return
    why = "the train slows down with it, so it brakes"
    work.add(Proposed(target, (name,), "", sign=sign, why=why, alternative="the friction brakes'"))


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
        work.add(
            replace(
                proposed,
                unit=unit,
                why=f"{why}; {proposed.why}",
                check=check,
                alternative="; ".join(filter(None, [proposed.alternative, other])),
            )
        )


def place_demands(work: Work) -> None:
    """Efforts asked for: in their stated unit, or that of the efforts."""
    main = work.proposed.get(roles.TRACTION) or work.proposed.get(roles.DYNAMIC)
    for target in (roles.TRACTION_DEMAND, roles.BRAKING_DEMAND):
        name = work.first(target)
        if name is None:
            continue
        stated = work.stated(name, "force")
        unit = stated or (main.unit if main else "")
        signs = _signs(work.numbers[name])
        if not unit or work.meanings[name].unit == "%" or signs.both:
            work.left[name] = "an effort asked for, without a unit, in per cent, or of both signs"
            continue
        why = "the file states it" if stated else "the unit of the effort"
        work.add(
            Proposed(
                target, (name,), unit, sign=-1 if signs.negative > signs.positive else 1, why=why,
                alternative="" if stated else "another unit",
            )
        )  # fmt: skip


def _net_newtons(work: Work, *, powered: bool) -> FloatArray | None:
    """The proposed efforts together [N]; `powered`: without the friction brakes."""
    total = np.zeros(work.motion.order.size)
    if roles.TRACTION not in work.proposed:
        return None
    for target, sign in EFFORTS.items():
        if target in work.proposed and not (powered and target == roles.PNEUMATIC):
            each = work.proposed[target]
            total += sign * factor(each.unit, "N")[0] * np.nan_to_num(_part(work, each))
    return total


def place_wheel_efforts(work: Work, names: tuple[str, ...]) -> None:
    """Propose the efforts of the axles: their sum is the train's without the friction brakes."""
    total = np.nansum([work.numbers[name] for name in names], axis=0)
    stated = work.stated(names[0], "force")
    net = _net_newtons(work, powered=True)
    check, other, unit, sign = "", "", stated, 1
    if net is not None:
        strong = np.abs(net) > 0.3 * np.max(np.abs(net))
        fit = float(np.sum(net[strong] * total[strong]) / max(np.sum(total[strong] ** 2), 1e-9))
        close = {
            each: abs(np.log(max(abs(fit), 1e-12) / factor(each, "N")[0]))
            for each in ("N", "kN", "daN")
        }
        best = min(close, key=lambda each: close[each])
        sign = -1 if fit < 0.0 else 1
        share = abs(fit) / factor(stated or best, "N")[0]
        check = f"the train's effort is {share:.2f} times their sum"
        if not stated:
            unit = best if close[best] < 1.1 else ""
        if unit and abs(np.log(max(share, 1e-9))) > 0.3:
            other = "not all powered axles, or another unit"
    elif work.speed is not None:
        driven = driven_mass(work.motion, total, work.speed)
        mass = {each: driven.mass * factor(each, "N")[0] for each in ("kN", "N")}
        likely = [each for each, value in mass.items() if 1.5e4 < abs(value) < 4e6]
        unit = stated or (likely[0] if driven.decides and likely else "")
        if unit and driven.decides:
            sign = -1 if driven.correlation < 0.0 else 1
            check = f"their sum accelerates {abs(driven.mass) * factor(unit, 'N')[0] / 1e3:.0f} t"
    if not unit:
        for name in names:
            work.left[name] = "efforts of axles without a unit, and nothing to find it from"
        return
    why = "the file states the unit" if stated else "the unit follows from the train's effort"
    work.add(
        Proposed(
            roles.WHEEL_EFFORT, names, unit, sign=-1 if sign < 0 else 1, why=why, check=check,
            alternative=other,
        )
    )  # fmt: skip


def place_torques(work: Work, names: tuple[str, ...]) -> None:
    """Torques as wheel efforts: by the factor that makes their sum the train's effort."""
    net = _net_newtons(work, powered=True)
    if net is None:
        for name in names:
            work.left[name] = "a torque, and no effort to find its lever arm from"
        return
    total = np.nansum([work.numbers[name] for name in names], axis=0)
    ratio = same_motion(np.abs(net), np.abs(total))
    if ratio.windows < 20 or ratio.agreement < 0.7:
        for name in names:
            work.left[name] = "a torque that does not follow the train's effort"
        return
    work.add(
        Proposed(
            roles.WHEEL_EFFORT, names, "N", float(f"{ratio.value:.5g}"),
            why="torques, scaled by the train's effort",
            check=f"the effort is {ratio.value:.4g} N a unit in {ratio.agreement:.0%} of samples",
            alternative="not all powered axles are recorded",
        )
    )  # fmt: skip
