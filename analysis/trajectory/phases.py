"""Driving phases of a trajectory: those of optimal train control, one for each cell."""

from __future__ import annotations

from enum import IntEnum

import numpy as np

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Trajectory


class Phase(IntEnum):
    """Control phases of the robust maximum principle; Cunillera et al. (2022), section 3."""

    MAXIMUM_TRACTION = 0
    CRUISING = 1
    COASTING = 2
    PARTIAL_BRAKING = 3
    MAXIMUM_BRAKING = 4

    @property
    def letter(self) -> str:
        """The phase as one letter, as a trajectory's certificate lists it."""
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
) -> IntArray:
    """Phase of each cell from the efforts and their limits.

    Parameters
    ----------
    traction, braking, most_traction, most_braking : (n,) array [N]
    band : float
        Part of the limit that counts as nothing, or as all.

    Returns
    -------
    (n,) array of `Phase`. A configuration that brakes against the common traction is classified by
    what remains: less traction is partial traction.
    """
    net = traction - braking
    phase = np.full(traction.shape, int(Phase.COASTING))
    phase[net > band * most_traction] = Phase.CRUISING
    phase[net >= (1.0 - band) * most_traction] = Phase.MAXIMUM_TRACTION
    phase[net < -band * most_braking] = Phase.PARTIAL_BRAKING
    phase[(net < 0.0) & (braking >= (1.0 - band) * most_braking)] = Phase.MAXIMUM_BRAKING
    return phase


def phases_by_switching(switching: FloatArray, band: float = 1e-3) -> IntArray:
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


def phases_of(trajectory: Trajectory, row: int) -> IntArray:
    """Phase of each cell for the configuration in `row`, as the certificate lists them.

    Raises
    ------
    InputError
        If the trajectory does not come from `optimise`.

    Examples
    --------
    >>> from analysis.trajectory.phases import Phase
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.railway import Configuration
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=9_613.0)
    >>> trajectory = optimise(problem, OptimiserOptions(cells=60))
    >>> Phase(phases_of(trajectory, 0)[0]).label
    'maximum traction'
    """
    try:
        letters = trajectory.certificate["phases"][row]
    except (KeyError, IndexError):
        raise InputError(
            "the trajectory carries no phases", remedy="make it with `trainlog plan`"
        ) from None
    codes = {phase.letter: int(phase) for phase in Phase}
    return np.array([codes[letter] for letter in letters], dtype=np.int64)


def phase_letters(phases: IntArray) -> str:
    """The phases as letters, one a cell."""
    return _LETTERS[phases].tobytes().decode("ascii")
