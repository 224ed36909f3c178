"""Driving phases: what a trajectory does in each cell, in the words of optimal train control."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from trainlog.errors import InputError
from trainlog.railway import Trajectory

FloatArray = NDArray[np.float64]


class Phase(IntEnum):
    """Control phases of the robust maximum principle; paper 002, section 3."""

    MAXIMUM_TRACTION = 0
    CRUISING = 1
    COASTING = 2
    PARTIAL_BRAKING = 3
    MAXIMUM_BRAKING = 4

    @property
    def letter(self) -> str:
        """The phase as one letter, as a trajectory's certificate spells it."""
        return "TPCHB"[self]

    @property
    def label(self) -> str:
        """The phase in words."""
        return self.name.replace("_", " ").lower()


_LETTERS = np.array([phase.letter for phase in Phase], dtype="S1")


def phases_by_control(
    traction: FloatArray,
    braking: FloatArray,
    most_traction: FloatArray,
    most_braking: FloatArray,
    band: float = 1e-3,
) -> NDArray[np.int64]:
    """Phase of each cell from the efforts and their limits.

    Parameters
    ----------
    traction, braking, most_traction, most_braking : (n,) array [N]
    band : float
        Part of the limit that counts as nothing, or as all.

    Returns
    -------
    (n,) array of `Phase`. A configuration that brakes against the common traction is told by
    what remains: less traction is partial traction.
    """
    net = traction - braking
    phase = np.full(traction.shape, int(Phase.COASTING))
    phase[net > band * most_traction] = Phase.CRUISING
    phase[net >= (1.0 - band) * most_traction] = Phase.MAXIMUM_TRACTION
    phase[net < -band * most_braking] = Phase.PARTIAL_BRAKING
    phase[(net < 0.0) & (braking >= (1.0 - band) * most_braking)] = Phase.MAXIMUM_BRAKING
    return phase


def phases_by_switching(switching: FloatArray, band: float = 1e-3) -> NDArray[np.int64]:
    """Phase of each cell from the switching function ``sum of lambda_v / v``.

    Within `band` of 1 or of 0 the control is singular: cruising by partial traction or braking.
    """
    phase = np.full(switching.shape, int(Phase.COASTING))
    phase[switching > 1.0 - band] = Phase.CRUISING
    phase[switching > 1.0 + band] = Phase.MAXIMUM_TRACTION
    phase[switching < band] = Phase.PARTIAL_BRAKING
    phase[switching < -band] = Phase.MAXIMUM_BRAKING
    return phase


def agreement(
    efforts: FloatArray, most: FloatArray, worth: FloatArray, band: float = 1e-3
) -> float:
    """Share of the cells in which an effort is what the maximum principle asks for.

    Parameters
    ----------
    efforts, most : (..., n) array [N]
        The effort and its limit, in the same unit.
    worth : (..., n) array
        Switching function less the level at which the effort begins to pay, its sign such that
        the effort pays where it is positive.
    band : float
        Within this of the level the control is singular, and any effort agrees; part of the limit
        that counts as nothing, or as all.
    """
    full, none = efforts >= (1.0 - band) * most, efforts <= band * most
    return float(np.mean(np.where(worth > band, full, np.where(worth < -band, none, True))))


def phases_of(trajectory: Trajectory, row: int) -> NDArray[np.int64]:
    """Phase of each cell for the configuration in `row`, as the certificate lists them.

    Raises
    ------
    InputError
        If the trajectory does not come from `optimise`.
    """
    try:
        letters = trajectory.certificate["phases"][row]
    except (KeyError, IndexError):
        raise InputError(
            "the trajectory carries no phases", remedy="make it with `trainlog optimise`"
        ) from None
    codes = {phase.letter: int(phase) for phase in Phase}
    return np.array([codes[letter] for letter in letters], dtype=np.int64)


def spelled(phases: NDArray[np.int64]) -> str:
    """The phases as letters, one a cell."""
    return _LETTERS[phases].tobytes().decode("ascii")
