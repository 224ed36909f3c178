"""What the parts of a profile have in common: strict keys, several problems at once, units."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from pydantic import BaseModel, ConfigDict

from trainlog.errors import InputError, similar
from trainlog.topics import TOPICS, Field as Item
from trainlog.units import factor, to_si


class Strict(BaseModel):
    """A part of a profile; a key that it does not know is an error."""

    model_config = ConfigDict(extra="forbid", frozen=True)


class ProblemsError(ValueError):
    """Several things that are wrong with one part of a profile."""

    def __init__(self, problems: Iterable[str]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(self.problems))


def refuse(problems: Iterable[str | None]) -> None:
    """Refuse a part for all its problems; None is no problem."""
    found = [problem for problem in problems if problem is not None]
    if found:
        raise ProblemsError(found)


def problem_of(check: Callable[..., object], *given: object) -> str | None:
    """What `check` finds wrong, if anything."""
    try:
        check(*given)
    except (ValueError, InputError) as error:
        return str(error)
    return None


class MismatchError(InputError):
    """A file lacks what its profile names: one of the two has to be corrected."""


def suggestion(name: str, known: Iterable[str], what: str = "known") -> str:
    """Remedy for a name that is not among the `known` ones: close matches, then all of them."""
    names = [str(candidate) for candidate in known]
    matches = " or ".join(f"'{match}'" for match in similar(name, names))
    if matches:
        return f"did you mean {matches}?"
    shown = ", ".join(names[:30]) + (", ..." if len(names) > 30 else "")
    return f"{what}: {shown or 'none'}"


def known_field(name: str) -> Item:
    """The field that ``"/topic.field"`` names; ValueError with close matches if there is none."""
    topic_name, _, column = name.rpartition(".")
    if topic_name not in TOPICS:
        every = [f"{topic.name}.{item.name}" for topic in TOPICS.values() for item in topic.fields]
        raise ValueError(f"unknown field '{name}'; {suggestion(name, every)}")
    fields = {item.name: item for item in TOPICS[topic_name].fields}
    if column not in fields:
        raise ValueError(
            f"topic {topic_name} has no field '{column}'; {suggestion(column, fields)}"
        )
    return fields[column]


def check_unit(name: str, unit: str, si: str) -> None:
    """Refuse a unit of `name` that is not known, or not of the kind of the SI unit `si`."""
    try:
        factor(unit, si)
    except InputError as error:
        raise ValueError(f"{name}: {error.problem}; {error.remedy}") from None


class Quantity(Strict):
    """A number with its unit."""

    value: float
    unit: str

    def si(self, unit: str) -> float:
        """The number in the SI unit `unit`."""
        return float(to_si(self.value, self.unit, unit))
