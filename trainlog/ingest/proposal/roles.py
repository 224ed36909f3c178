"""Which field of our topics a column is meant for, by what its name says."""

from __future__ import annotations

from collections import Counter

from trainlog.ingest.proposal.vocabulary import Meaning, named, recorded_fields

POSITION, SPEED = "/train/state.position", "/train/state.speed"
ACCELERATION = "/train/state.acceleration"
LEVER = "/train/controls.lever"
TRACTION = "/train/controls.tractive_effort"
DYNAMIC = "/train/controls.dynamic_braking_effort"
PNEUMATIC = "/train/controls.pneumatic_braking_effort"
TRACTION_DEMAND = "/train/controls.tractive_effort_demand"
BRAKING_DEMAND = "/train/controls.braking_effort_demand"
WHEEL_SPEED, WHEEL_EFFORT = "/train/axles.wheel_speed", "/train/axles.wheel_effort"
LATITUDE, LONGITUDE = "/gnss/fix.latitude", "/gnss/fix.longitude"
GNSS_SPEED = "/gnss/motion.speed"

NO_FIELD = "no field for"
"""Begin of the reason why a column of a known quantity is not used."""

UNKNOWN = "its name is not known"
"""Reason why a column is not used whose name holds no known word."""

SIGNED = "effort of both signs"
"""Role of a column that holds traction and braking, or does not say which."""

BRAKING = "braking effort"
"""Role of a column of braking efforts that does not say of which brake."""

_UNPLACED = {
    "temperature": f"{NO_FIELD} a temperature, not stated to be the outside air's",
    "wind": "a wind, not stated to be along the train",
    "radius": "a radius: curvature is its inverse, which no factor gives",
    "heading": "a heading: the line gives it",
    "clock": "a further time",
    "date": "a further date",
    "station": "the name of a place",
    "slip_protection": "slip protection: give it as a message, see docs/ingest.md",
}


_RULES: tuple[tuple[str, str, str, str | None, str], ...] = (
    ("speed", "limit", "", "/environment.speed_limit", ""),
    ("speed", "demand", "", None, f"{NO_FIELD} a speed that is asked for, not driven"),
    ("speed", "wheel", "", WHEEL_SPEED, ""),
    ("speed", "satellite", "", GNSS_SPEED, ""),
    ("speed", "", "", SPEED, ""),
    ("rotation", "", "", WHEEL_SPEED, ""),
    ("distance", "wheel", "", None, "no distance of the train"),
    ("distance", "limit", "", None, "no distance of the train"),
    ("distance", "demand", "", None, "no distance of the train"),
    ("distance", "remaining", "", None, "a distance that is left, whose end is not known"),
    ("distance", "", "", POSITION, ""),
    ("lever", "", "", LEVER, ""),
    ("torque", "", "", None, "a torque: the lever arm is not known"),
    ("effort", "limit", "", None, "the effort that is available, not the one applied"),
    ("effort", "demand wheel", "", None, "an effort that is asked for"),
    ("effort", "demand brake traction", "", None, "an effort that is asked for"),
    ("effort", "demand brake", "", BRAKING_DEMAND, ""),
    ("effort", "demand", "", TRACTION_DEMAND, ""),
    ("effort", "wheel", "brake", WHEEL_EFFORT, ""),
    ("effort", "wheel numbered", "pneumatic", WHEEL_EFFORT, ""),
    ("effort", "traction braking", "", SIGNED, ""),
    ("effort", "traction", "", TRACTION, ""),
    ("effort", "pneumatic", "", PNEUMATIC, ""),
    ("effort", "electric", "", DYNAMIC, ""),
    ("effort", "braking", "", BRAKING, ""),
    ("effort", "", "", SIGNED, ""),
)
"""Quantity, qualifiers that a name has and those that it has not, role, and why it has none; the
first that fits counts. ``wheel`` stands for an axle or a motor, ``brake`` for any brake."""


def role_of(meaning: Meaning) -> tuple[str | None, str]:
    """The field or role of a column, and, where it has none, why.

    Examples
    --------
    >>> from trainlog.ingest.proposal.vocabulary import meaning_of
    >>> role_of(meaning_of("Geschwindigkeit"))[0]
    '/train/state.speed'
    >>> role_of(meaning_of("v_soll"))
    (None, 'no field for a speed that is asked for, not driven')
    """
    quantity = meaning.quantity
    if quantity is None:
        return None, UNKNOWN
    if meaning.coverage < 0.5:
        return None, f"its name is hardly known ('{quantity}' is a part of it)"
    words = meaning.qualifiers | ({"numbered"} if meaning.index is not None else set())
    words |= {"wheel"} if words & {"axle", "motor"} else set()
    words |= {"brake"} if words & {"braking", "electric", "pneumatic"} else set()
    for rule, has, has_not, role, why in _RULES:
        if rule == quantity:
            if "deviation" in words:
                return None, f"an error or a difference ({quantity})"
            if words.issuperset(has.split()) and words.isdisjoint(has_not.split()):
                return role, why
    meant = {
        named(recorded.qualifier): target
        for target, _, recorded in recorded_fields()
        if quantity == named(recorded.words)
    }
    for qualifier, target in meant.items():
        if qualifier and qualifier in meaning:
            return target, ""
    if "deviation" in meaning or "demand" in meaning or "limit" in meaning:
        return None, f"no measured value ({quantity})"
    if "" in meant:
        return meant[""], ""
    return None, _UNPLACED.get(quantity, f"{NO_FIELD} it ({quantity.replace('_', ' ')})")


def roles_of(meanings: dict[str, Meaning]) -> tuple[dict[str, list[str]], dict[str, str]]:
    """Columns by role, the better named first, and the others with the reason.

    Numbered speeds and efforts, such as ``v1`` to ``v4``, are those of axles.
    """
    found: dict[str, list[str]] = {}
    left: dict[str, str] = {}
    numbered = Counter(
        (role_of(meaning)[0]) for meaning in meanings.values() if meaning.index is not None
    )
    for name, meaning in meanings.items():
        role, why = role_of(meaning)
        several = meaning.index is not None and numbered[role] > 1
        if several and role == SPEED:
            role = WHEEL_SPEED
        elif several and role in (SIGNED, TRACTION):
            role = WHEEL_EFFORT
        if role is None:
            left[name] = why or "no field for it"
        else:
            found.setdefault(role, []).append(name)
    for role, names in found.items():
        if role in (WHEEL_SPEED, WHEEL_EFFORT):
            names.sort(key=lambda name: meanings[name].index or 0)
        else:
            names.sort(key=lambda name: -meanings[name].coverage)
    return found, left
