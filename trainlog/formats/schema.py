"""Files of other programs: models of what is read of them, and errors with their places."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from pydantic_core import ErrorDetails

from trainlog.errors import InputError

Finite = Annotated[float, Field(allow_inf_nan=False)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]


class Foreign(BaseModel):
    """A part of a file of another project: keys that are not known are passed over."""

    model_config = ConfigDict(extra="ignore", frozen=True)


Model = TypeVar("Model", bound=BaseModel)


def checked(model: type[Model], content: Any, file: str | Path) -> Model:
    """Validate `content`; pydantic's complaints become one InputError in one line."""
    try:
        return model.model_validate(content)
    except ValidationError as error:
        # Misspelt keys go first.
        complaints = error.errors(include_url=False)
        complaints.sort(key=lambda each: each["type"] != "extra_forbidden")
        raise InputError.listing([_problem(each) for each in complaints], file=file) from error


def _problem(complaint: ErrorDetails) -> InputError:
    place = ""
    for part in complaint["loc"]:
        place += f"[{part}]" if isinstance(part, int) else f".{part}"
    key = complaint["loc"][-1] if complaint["loc"] else "file"
    problem, remedy = {
        "missing": (f"'{key}' is missing", "add it"),
        "extra_forbidden": (f"unknown key '{key}'", "correct its spelling or remove it"),
        "finite_number": ("is not a finite number", "give one"),
        "too_short": ("has too few entries", f"give {_at_least(complaint)}"),
    }.get(complaint["type"], (must_be(complaint["msg"]), None))
    return InputError(problem, place=place.lstrip(".") or None, remedy=remedy)


def _at_least(complaint: ErrorDetails) -> str:
    least = complaint.get("ctx", {}).get("min_length", 1)
    return f"at least {least} item{'' if least == 1 else 's'}"


def must_be(message: str) -> str:
    """A complaint of pydantic ("Input should be a valid string") as what the value must be."""
    demand = re.sub(r"^(?:\w+ )?should ", "must ", message)
    return demand[:1].lower() + demand[1:] if demand == message else demand
