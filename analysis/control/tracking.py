"""Tracking MPC of paper 000, eq. (9) to (11): the reference is followed, the map is kept.

Once a second a dense quadratic program in the levers of the next 20 s is solved by DAQP. The
motion is linearised either about the reference by time, as the paper has it, or about the
prediction from the measured state (a real-time iteration), which also serves a train that is late.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from analysis.control import tracking_kernels as kernels
from analysis.trajectory.reference import SAMPLING, Reference
from trainlog.errors import InputError
from trainlog.railway.lever import NOMINAL_MASS

FloatArray = NDArray[np.float64]

About = Literal["reference", "prediction"]

SHORTEST = 6
"""Steps of the horizon that remain at the stop."""

SOFTNESS = 1e-7
"""Of the ceiling of the speed in the program: one over its quadratic weight."""


@dataclass(frozen=True, slots=True)
class Tuning:
    """Of eq. (11).

    Attributes
    ----------
    horizon : int
        N.
    position : float [1/m²]
        Q is this times the unit matrix.
    lever : float
        R likewise.
    mass : float [kg]
        What the controller takes the train to weigh.
    """

    horizon: int = 20
    position: float = 1.0
    lever: float = 0.01
    mass: float = NOMINAL_MASS

    def __post_init__(self) -> None:
        for name in ("horizon", "position", "lever", "mass"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"tracking: {name} {getattr(self, name)} is not positive")


@dataclass(frozen=True, eq=False)
class Program:
    """``min 1/2 x'Hx + f'x`` in changes x of the levers about which the motion is linearised.

    Attributes
    ----------
    hessian, gradient : (n, n), (n,) arrays
    rows : (2n, n) array
        Ceiling of the speed and standstill; soft.
    upper, lower : (3n,) arrays
        Of the changes, hard; then of the rows.
    levers : (n,) array
    """

    hessian: FloatArray
    gradient: FloatArray
    rows: FloatArray
    upper: FloatArray
    lower: FloatArray
    levers: FloatArray


@dataclass
class TrackingController:
    """Follows one reference.

    Attributes
    ----------
    reference : Reference
    about : {"reference", "prediction"}
        About what the motion is linearised.
    tuning : Tuning
    unsolved : int
        Steps at which the program was not solved, and the shifted plan was taken instead.
    """

    reference: Reference
    about: About = "prediction"
    tuning: Tuning = field(default_factory=Tuning)
    unsolved: int = 0

    def __post_init__(self) -> None:
        if self.about not in ("reference", "prediction"):
            raise InputError(f"tracking: linearisation about '{self.about}' is unknown")
        section = self.reference.section
        self._tables = section.tables
        self._constants = section.driving_constants
        self._plan: FloatArray | None = None
        rows = self.reference.sampled()
        # The lever is held for a second: that of its middle stands for it.
        rows[:, 2] = [self.reference.at((k + 0.5) * SAMPLING)[2] for k in range(len(rows))]
        rest = np.tile([rows[-1, 0], 0.0, 0.0], (self.tuning.horizon + SHORTEST + 1, 1))
        rows[-1, 1:] = 0.0
        self._rows = np.concatenate([rows, rest])

    def lever(self, time: float, position: float, speed: float) -> float:
        """The lever for the next second.

        Parameters
        ----------
        time : float [s]
            From the departure of the timetable.
        position, speed : float [m], [m/s]
            As measured.
        """
        program = self.program(time, position, speed)
        plan = self._solved(program)
        self._plan = plan
        return float(plan[0])

    def program(self, time: float, position: float, speed: float) -> Program:
        """The program (11) at a state; see `lever`."""
        at, n = self._window(time)
        target, aim = self._rows[at : at + n + 1], self._rows[at : at + n, 2]
        mass, t, c = self.tuning.mass, self._tables, self._constants
        if self.about == "reference":
            states, levers = np.ascontiguousarray(target[:, :2]), aim
            deviation = np.array([position, speed]) - states[0]
        else:
            states, levers = kernels.predicted(
                position, speed, self._guess(aim), SAMPLING, mass, t, c
            )
            deviation = np.zeros(2)
        tuning = self.tuning
        found = kernels.condensed(
            states, np.ascontiguousarray(levers), deviation,
            np.ascontiguousarray(target[:, :2]), np.ascontiguousarray(aim),
            tuning.position, tuning.lever, SAMPLING, mass, t, c,
        )  # fmt: skip
        hessian, gradient, rows, upper, lower = found
        return Program(hessian, gradient, rows, upper, lower, levers)

    def guarded(self, lever: float, position: float, speed: float) -> float:
        """The lever next to `lever` that keeps (7) for a second, whatever the train weighs."""
        return float(
            kernels.guarded(position, speed, lever, SAMPLING, self._tables, self._constants)
        )

    def _window(self, time: float) -> tuple[int, int]:
        """First row of the reference and number of steps: the horizon shrinks at the stop."""
        last = int(np.ceil(self.reference.duration / SAMPLING))
        at = min(max(round(time / SAMPLING), 0), last)
        return at, int(np.clip(last - at, SHORTEST, self.tuning.horizon))

    def _guess(self, aim: FloatArray) -> FloatArray:
        """The plan of the last second, shifted; the reference's levers where there is none."""
        if self._plan is None or self._plan.size < 2:
            return np.ascontiguousarray(aim)
        shifted = np.append(self._plan[1:], self._plan[-1])
        extra = max(aim.size - shifted.size, 0)
        return np.concatenate([shifted, np.full(extra, shifted[-1])])[: aim.size]

    def _solved(self, program: Program) -> FloatArray:
        change, status = solve(program)
        if status <= 0:
            self.unsolved += 1
            return np.ascontiguousarray(program.levers)
        return program.levers + change


def solve(program: Program) -> tuple[FloatArray, int]:
    """Solve a program by DAQP.

    Returns
    -------
    change : (n,) array
    status : int
        Positive where the optimum was found.
    """
    import daqp

    sense: NDArray[np.int32] = np.zeros(program.upper.size, dtype=np.int32)
    sense[program.levers.size :] = 8  # soft
    answer: tuple[Any, ...] = daqp.solve(
        program.hessian, program.gradient, program.rows, program.upper, program.lower, sense,
        rho_soft=SOFTNESS,
    )  # fmt: skip
    return np.asarray(answer[0]), int(answer[2])
