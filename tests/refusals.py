"""Calls that are refused: the kind of the error, and what its message states."""

from collections.abc import Callable
from typing import Any, TypeVar

import pytest

E = TypeVar("E", bound=Exception)


def refused(error: type[E], said: str, call: Callable[..., object], *given: Any, **named: Any) -> E:
    """The error that a call raises; its message matches `said`, if stated, and is one line."""
    with pytest.raises(error, match=said or None) as caught:
        call(*given, **named)
    assert "\n" not in str(caught.value)
    return caught.value
