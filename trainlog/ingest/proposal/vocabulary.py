"""What a column's name says, in English, German and French: quantity, qualifiers, axle, unit.

The words of a field are in the table of topics; those of quantities that several fields have, or
none, are in ``vocabulary.toml`` beside this module.
"""

from __future__ import annotations

import re
import tomllib
import unicodedata
from collections.abc import Iterator
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

from trainlog.topics import TOPICS, Field, Recorded

SHORT = 3
"""Letters up to which a stem must be a whole word of the name; words of a name that may make one
stem together, as ``h Acc``."""


def plain(text: str) -> str:
    """A word without capitals and accents; ``ä``, ``ae`` and ``a`` are the same.

    Examples
    --------
    >>> plain("Höhe"), plain("HOEHE"), plain("caténaire")
    ('hohe', 'hohe', 'catenaire')
    """
    lowered = unicodedata.normalize("NFKD", text.casefold())
    bare = "".join(letter for letter in lowered if not unicodedata.combining(letter))
    return bare.replace("ae", "a").replace("oe", "o").replace("ue", "u")


@cache
def vocabulary() -> dict[str, Any]:
    """The words of ``vocabulary.toml``."""
    return tomllib.loads(Path(__file__).with_name("vocabulary.toml").read_text("utf-8"))


def recorded_fields() -> Iterator[tuple[str, Field, Recorded]]:
    """Fields of the topic table that a name alone shows: ``"/topic.field"``, field, its words."""
    for topic in TOPICS.values():
        for item in topic.fields:
            if item.recorded is not None:
                yield f"{topic.name}.{item.name}", item, item.recorded


def named(words: str) -> str:
    """What words mean: the first of them."""
    return words.split()[0] if words else ""


@cache
def _stems() -> dict[str, tuple[tuple[str, str], ...]]:
    """What a stem can mean: ("quantity" or "qualifier", which), by stem."""
    found: dict[str, dict[tuple[str, str], None]] = {}

    def add(kind: str, name: str, words: str) -> None:
        for stem in words.split():
            found.setdefault(plain(stem), {})[kind, name] = None

    for _, _, recorded in recorded_fields():
        add("quantity", named(recorded.words), recorded.words)
    for name, quantity in vocabulary()["quantity"].items():
        add("quantity", name, quantity["words"])
    for _, _, recorded in recorded_fields():
        add("qualifier", named(recorded.qualifier), recorded.qualifier)
    for name, words in vocabulary()["qualifier"].items():
        add("qualifier", name, words)
    return {stem: tuple(means) for stem, means in found.items()}


@cache
def _units() -> dict[str, str]:
    """Units in the profile's spelling, by the spellings of recorders."""
    spelled = {
        spelling: unit
        for units in vocabulary()["unit"].values()
        for unit, spellings in units.items()
        for spelling in spellings
    }
    for _, item, _ in recorded_fields():
        spelled.setdefault(item.usual_unit, item.usual_unit)
    return spelled


@cache
def dimension_of(unit: str) -> str:
    """What a unit measures; one that the vocabulary does not list measures a kind of its own.

    Examples
    --------
    >>> dimension_of("km/h"), dimension_of("lux")
    ('speed', 'lux')
    """
    return next((kind for kind, units in vocabulary()["unit"].items() if unit in units), unit)


@cache
def _dimensions() -> dict[str, frozenset[str]]:
    """Kinds of unit that a quantity can have; none if it has no number."""
    found = {
        name: frozenset(quantity.get("units", ()))
        for name, quantity in vocabulary()["quantity"].items()
    }
    for _, item, recorded in recorded_fields():
        kinds = {dimension_of(item.usual_unit)} if item.unit else set[str]()
        name = named(recorded.words)
        found[name] = found.get(name, frozenset()) | kinds
    return found


def unit_of(text: str) -> str | None:
    """The unit that a text spells, in the profile's spelling; None if it is none.

    Capitals count where they make a difference: ``kN`` is a kilonewton, ``kn`` a knot.

    Examples
    --------
    >>> unit_of("[km/h]"), unit_of("kN"), unit_of("kn"), unit_of("tr/min"), unit_of("ok")
    ('km/h', 'kN', 'knot', 'rpm', None)
    """
    bare = text.strip().strip("[](){}<> ").strip()
    bare = bare.replace("⁻¹", "-1").replace("⁻²", "-2").replace("·", ".").replace("μ", "µ")
    units = _units()
    if bare in units:
        return units[bare]
    lowered = bare.lower().replace(" ", "")
    return units.get(lowered) if len(lowered) > 1 and lowered not in ("mn",) else None


_BRACKETED = re.compile(r"[\[({<]\s*([^\])}>]*)\s*[\])}>]")
_TRAILING = re.compile(
    r"^(.*?[\w.)])(?:\s*/\s*|\s+in\s+|[_\s]\s*|(?<=[a-z])(?=[A-Z][a-z]))"
    r"([^\s_]{1,8}|km[_ ]h|m[_ ]s)$"
)


def split_unit(name: str) -> tuple[str, str | None, bool]:
    """A name without its unit, the unit, and whether brackets or ``in`` state it beyond doubt.

    Examples
    --------
    >>> split_unit("v [km/h]"), split_unit("V_axle1_kmh"), split_unit("Fahrhebel")
    (('v', 'km/h', True), ('V_axle1', 'km/h', False), ('Fahrhebel', None, False))
    """
    for match in _BRACKETED.finditer(name):
        unit = unit_of(match.group(1))
        if unit is not None:
            return (name[: match.start()] + name[match.end() :]).strip(" _,"), unit, True
    trailing = _TRAILING.match(name.strip())
    if trailing is not None:
        unit = unit_of(trailing.group(2).replace("_", "/").replace(" ", "/"))
        if unit is not None:
            sure = " in " in name or "/" in name.removesuffix(trailing.group(2))
            return trailing.group(1), unit, sure
    return name.strip(), None, False


@dataclass(frozen=True)
class Meaning:
    """What a column's name says.

    Attributes
    ----------
    quantities : tuple of str
        What it can be, the likeliest first; empty if no word is known.
    qualifiers : frozenset of str
    index : int, optional
        The one number in the name, of an axle.
    unit : str, optional
        As the name, or a line of units, states it.
    coverage : float
        Share of the name's letters that are known words.
    """

    quantities: tuple[str, ...] = ()
    qualifiers: frozenset[str] = field(default_factory=frozenset)
    index: int | None = None
    unit: str | None = None
    coverage: float = 0.0


def words_of(text: str) -> list[str]:
    """The words of a name: parted at signs, capitals and digits, in `plain` spelling.

    Examples
    --------
    >>> words_of("V_axle1_kmh"), words_of("SpeedKmh"), words_of("Zug-/Bremskraft")
    (['v', 'axle', '1', 'kmh'], ['speed', 'kmh'], ['zug', 'bremskraft'])
    """
    parted = re.sub(r"(?<=[a-zäöü])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", " ", text)
    parted = re.sub(r"(?<=\D)(?=\d)|(?<=\d)(?=\D)", " ", parted)
    return [plain(word) for word in re.findall(r"[^\W_\d]+|\d+", parted)]


def meaning_of(name: str, unit: str | None = None) -> Meaning:
    """What a column's name says, with the unit that a line of units gives, if any.

    Examples
    --------
    >>> found = meaning_of("Istgeschwindigkeit [km/h]")
    >>> found.quantities[0], found.unit
    ('speed', 'km/h')
    >>> found = meaning_of("F_axle3_kN")
    >>> found.quantities, sorted(found.qualifiers), found.index
    (('effort',), ['axle'], 3)
    >>> meaning_of("effort de freinage").qualifiers >= {"braking"}
    True
    >>> meaning_of("v_ms").unit, meaning_of("t_ms").unit
    ('m/s', 'ms')
    """
    label, own, sure = split_unit(name)
    if unit is not None or own is None or sure:
        return _meaning(label, unit or own)
    # What looks like a unit may be a word: "F_t" is no force in tonnes; or lack its stroke: "v_ms".
    found, whole = _meaning(label, own), _meaning(name, None)
    if own == "ms" and "speed" in found.quantities:
        return _meaning(label, "m/s")
    if not found.quantities:
        return whole if whole.quantities else found
    possible = set[str]().union(*(_dimensions()[each] for each in found.quantities))
    return found if dimension_of(own) in possible else whole


def _meaning(label: str, unit: str | None) -> Meaning:
    words = words_of(label)
    numbers = [int(word) for word in words if word.isdigit()]
    kinds, matched = _matched(words)
    qualifiers = frozenset(what for kind, what in kinds if kind == "qualifier")
    quantities = [what for kind, what in kinds if kind == "quantity"]
    if unit is not None:
        kind = dimension_of(unit)
        fitting = [each for each in quantities if kind in (_dimensions()[each] or {kind})]
        # "n [km/h]" of a wheel is a speed; "Achse 1 [km/h]" has no word for what it measures.
        shown = "effort" if kind == "force" else kind
        by_unit = [shown] if shown in vocabulary()["by_unit"].split() else []
        quantities = fitting or [*by_unit, *quantities]
    elif not quantities and {"braking", "traction"} & qualifiers:
        quantities = ["effort"]  # "Frein pneumatique": of which quantity, the data say
    letters = sum(len(word) for word in words if not word.isdigit())
    return Meaning(
        tuple(dict.fromkeys(quantities)),
        qualifiers,
        numbers[0] if len(numbers) == 1 else None,
        unit,
        matched / letters if letters else 0.0,
    )


def _matched(words: list[str]) -> tuple[list[tuple[str, str]], int]:
    """What the words of a name mean, and how many letters are known.

    Quantities of longer stems come first.
    """
    stems = _stems()
    found: list[str] = []
    at = 0
    while at < len(words):
        joined = {size: "".join(words[at : at + size]) for size in range(SHORT, 0, -1)}
        size = next((size for size, text in joined.items() if text in stems), 0)
        found += [joined[size]] if size else _segments(words[at])
        at += max(1, min(size, len(words) - at))
    # Of equal lengths the earlier one (sorting is stable).
    ordered = sorted(found, key=len, reverse=True)
    return [means for stem in ordered for means in stems[stem]], sum(map(len, found))


def _segments(word: str) -> list[str]:
    """The stems that a compound holds, the longest first and without overlap."""
    inside = vocabulary()["inside"].split()
    possible = [stem for stem in _stems() if len(stem) > SHORT or stem in inside]
    rest, found = word, []
    for stem in sorted(possible, key=len, reverse=True):
        if stem in rest:
            found.append(stem)
            rest = rest.replace(stem, "\0" * len(stem), 1)
    left = [part for part in re.split("\0+", rest) if len(part) > SHORT]
    # A long unknown rest makes it another word: "windschutz" is no wind.
    return [] if left and sum(map(len, found)) < len(word) / 2 else found


NO_FIELD, UNKNOWN = "no field for", "its name is not known"
"""Begin of the reason why a column of a known quantity, and of an unknown one, is not used."""


def role_of(meaning: Meaning) -> tuple[str | None, str]:
    """The field that a column is meant for, or the kind of effort; where it has none, why.

    Examples
    --------
    >>> role_of(meaning_of("Geschwindigkeit"))[0]
    '/train/state.speed'
    >>> role_of(meaning_of("v_soll"))
    (None, 'no field for a speed that is asked for, not driven')
    """
    quantity = next(iter(meaning.quantities), None)
    if quantity is None:
        return None, UNKNOWN
    if meaning.coverage < 0.5:
        return None, f"its name is hardly known ('{quantity}' is a part of it)"
    words = meaning.qualifiers | ({"numbered"} if meaning.index is not None else set())
    words |= {"wheel"} if words & {"axle", "motor"} else set()
    words |= {"brake"} if words & {"braking", "electric", "pneumatic"} else set()
    every = (each["rules"] for each in vocabulary()["role"] if each["quantity"] == quantity)
    for rule in next(every, ()):
        if "deviation" in words:
            return None, f"an error or a difference ({quantity})"
        has, without = (rule.get(key, "").split() for key in ("has", "without"))
        if words.issuperset(has) and words.isdisjoint(without):
            return rule.get("role"), rule.get("why", "")
    meant = {
        named(recorded.qualifier): target
        for target, _, recorded in recorded_fields()
        if quantity == named(recorded.words)
    }
    # Without a qualifier: the field whose name alone shows it.
    for qualifier in sorted(meant, reverse=True):
        if qualifier in words:
            return meant[qualifier], ""
    if words & {"deviation", "demand", "limit"}:
        return None, f"no measured value ({quantity})"
    why = vocabulary()["unplaced"].get(quantity, f"{NO_FIELD} it ({quantity.replace('_', ' ')})")
    return (meant[""], "") if "" in meant else (None, why)


def language_of(names: tuple[str, ...]) -> str | None:
    """The language of a header: ``"en"``, ``"de"``, ``"fr"``; None if no word decides.

    Examples
    --------
    >>> language_of(("Zeit", "Geschwindigkeit")), language_of(("t", "v"))
    ('de', None)
    """
    text = " ".join(" ".join(words_of(name)) for name in names)
    counts = {
        language: sum(plain(word) in text for word in words)
        for language, words in vocabulary()["language"].items()
    }
    best = max(counts, key=lambda language: counts[language])
    others = [count for language, count in counts.items() if language != best]
    return best if counts[best] > max(others) else None


def zone_of(name: str) -> str | None:
    """The time zone that a name states: ``"UTC"``, an offset, ``"local"``, or None.

    Examples
    --------
    >>> zone_of("Time (UTC)"), zone_of("Zeit [MESZ]"), zone_of("heure locale"), zone_of("t")
    ('UTC', '+02:00', 'local', None)
    """
    words = set(words_of(name))
    for zone, spellings in vocabulary()["zone"].items():
        if words & {plain(spelling) for spelling in spellings}:
            return str(zone)
    return None
