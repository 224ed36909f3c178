"""Energy against running time: the Pareto front, and what a second is worth along it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.optimiser import optimise
from trainlog.errors import InfeasibleError, InputError
from trainlog.railway import Configuration, Line, Train, Trajectory

FloatArray = NDArray[np.float64]

RESERVES = (0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.13, 0.17, 0.22, 0.3)
"""Over the least time; closer where the front is steep."""


@dataclass(frozen=True, eq=False)
class Front:
    """Least energies for several running times.

    Attributes
    ----------
    trajectories : tuple of m Trajectory
        Each with its certificate, shortest running time first.
    least_time : float [s]
        Of the slowest configuration by itself.
    """

    trajectories: tuple[Trajectory, ...]
    least_time: float

    @property
    def times(self) -> FloatArray:
        """Running times, (m,) [s]."""
        return np.array([each.running_time for each in self.trajectories])

    @property
    def energies(self) -> FloatArray:
        """Worst-case (or expected) energies, (m,) [J]."""
        return np.array([each.certificate["energy"] for each in self.trajectories])

    @property
    def bounds(self) -> FloatArray:
        """Lower bounds of the energies, (m,) [J]."""
        return np.array([each.certificate["lower_bound"] for each in self.trajectories])

    @property
    def prices(self) -> FloatArray:
        """What a second more saves, from the multipliers of the running time, (m,) [J/s]."""
        return np.array(
            [sum(each.certificate["time_price"].values()) for each in self.trajectories]
        )


def energy_against_time(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    *,
    reserves: Sequence[float] = RESERVES,
    **options: Any,
) -> Front:
    """Least energy for several reserves over the least time.

    Parameters
    ----------
    line, train, configurations
        As for `optimise`.
    reserves : sequence of float
        Parts of the least time. Those that cannot be kept together are left out.
    **options
        What else `optimise` takes, the same for every point.

    Raises
    ------
    InputError
        If there are no reserves.
    InfeasibleError
        If not one of them can be kept.
    """
    if not len(reserves):
        raise InputError("front: no reserves are given")
    found: list[Trajectory] = []
    failure: InfeasibleError | None = None
    for reserve in sorted(set(reserves)):
        try:
            found.append(optimise(line, train, configurations, reserve=reserve, **options))
        except InfeasibleError as error:
            failure = error
    if not found:
        assert failure is not None
        raise failure
    return Front(tuple(found), max(found[0].certificate["least_time"]))
