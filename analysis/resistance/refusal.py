"""Why a trip does not determine its running resistance: one word for machines, one sentence."""

from __future__ import annotations

from typing import Literal, get_args

from trainlog.errors import NotIdentifiableError

Reason = Literal[
    "not recorded", "gap", "standstill", "braking", "slip", "too short", "condition", "excitation"
]
"""``"not recorded"``: speed, chainage or tractive effort is missing altogether. ``"gap"``,
``"standstill"``, ``"braking"``, ``"slip"``: most of the trip was masked for that. ``"too short"``:
it was not, and there are too few windows all the same. ``"condition"``: speed and effort vary too
little to tell the parameters apart. ``"excitation"``: at some speed that was asked for the curve
is known too badly."""

REASONS: tuple[Reason, ...] = get_args(Reason)


class TripRefusedError(NotIdentifiableError):
    """A trip that does not determine the curve.

    Attributes
    ----------
    reason : str
        One of `REASONS`.
    """

    def __init__(
        self, reason: Reason, problem: str, *, place: str | None = None, remedy: str | None = None
    ) -> None:
        super().__init__(problem, place=place, remedy=remedy)
        self.reason: Reason = reason
