"""Why a trip does not determine its running resistance: one word for machines, one sentence."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, get_args

import numpy as np
from numpy.typing import NDArray

from trainlog.errors import NotIdentifiableError

FloatArray = NDArray[np.float64]

Reason = Literal[
    "not recorded",
    "contradiction",
    "gap",
    "standstill",
    "braking",
    "slip",
    "too short",
    "condition",
    "excitation",
]
"""``"not recorded"``: speed, chainage or tractive effort is missing altogether.
``"contradiction"``: the speed is not that of satellites or chainage. ``"gap"``,
``"standstill"``, ``"braking"``, ``"slip"``: most of the trip was masked for that. ``"too short"``:
it was not, and there are too few windows all the same. ``"condition"``: speed and effort vary too
little to tell the parameters apart. ``"excitation"``: at some speed that was asked for the curve
is known too badly."""

REASONS: tuple[Reason, ...] = get_args(Reason)


@dataclass(frozen=True, eq=False)
class Timeline:
    """The trip at a glance, a row a second; (n,) arrays.

    Attributes
    ----------
    time : array [s]
    speed, position : array [m/s], [m]
    masks : dict of str to bool array
        What was masked, by reason.
    """

    time: FloatArray
    speed: FloatArray
    position: FloatArray
    masks: dict[str, NDArray[np.bool_]]


class TripRefusedError(NotIdentifiableError):
    """A trip that does not determine the curve.

    Attributes
    ----------
    reason : str
        One of `REASONS`.
    timeline : Timeline or None
        What was masked; None if nothing could be made of the recording.
    """

    def __init__(
        self,
        reason: Reason,
        problem: str,
        *,
        place: str | None = None,
        remedy: str | None = None,
        timeline: Timeline | None = None,
    ) -> None:
        super().__init__(problem, place=place, remedy=remedy)
        self.reason: Reason = reason
        self.timeline = timeline


class AllRefusedError(NotIdentifiableError):
    """No trip determines the curve.

    Attributes
    ----------
    refused : dict of str to TripRefusedError
        Why, by trip, of the logs that were read now.
    """

    def __init__(
        self,
        problem: str,
        *,
        remedy: str | None = None,
        refused: dict[str, TripRefusedError],
    ) -> None:
        super().__init__(problem, remedy=remedy)
        self.refused = refused
