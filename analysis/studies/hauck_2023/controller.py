"""Tracking MPC of paper 000, eq. (9) to (11): the reference is followed, the map is kept.

Once a second a dense quadratic program in the levers of the next 20 s is solved by DAQP. The
motion is linearised either about the reference by time, as the paper has it, or about the
prediction from the measured state (a real-time iteration), which also serves a train that is late.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from analysis.control.qp import QPSubproblem, solve
from analysis.control.route import value
from analysis.studies.hauck_2023 import dynamics as dynamics
from analysis.studies.hauck_2023 import prediction as kernels
from analysis.studies.hauck_2023.mass import ObservedMass, window
from analysis.studies.hauck_2023.model import NOMINAL_MASS
from analysis.studies.hauck_2023.reference import SAMPLING, Reference
from analysis.studies.hauck_2023.target import Fast, latest, paced, returning, with_lead
from trainlog.errors import InputError
from trainlog.simulation.plant import HOLDING
from trainlog.units import GRAVITY

FloatArray = NDArray[np.float64]

About = Literal["reference", "prediction"]

PERIOD = 0.1
"""Between two levers of the guard [s]."""

HOLDING_SPEED = 0.5
"""Below it the holding brake is applied to a train that does not pull [m/s]."""

APPROACH = 4.0
"""The last seconds before the stop are driven to the place rather than by the clock [s]."""

LAST = 15.0
"""Nothing but the stop is ahead within this time [s]."""

HARD = 0.9
"""Share of the brake from which a train is driven to the place before that, too."""

HASTE = 0.985
"""A train hurries when the fastest run takes more than this share of the time that is left."""

FAST_STEP = 5.0
"""Of the fastest run from where the train is [m]."""

SHORTEST = 6
"""Steps of the horizon that remain at the stop."""


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
        R likewise. The paper's 0.01 makes the lever swing where wheels creep much: on a rail that
        holds little the effort comes late, and so high a gain does not bear that.
    mass : float [kg]
        What the controller takes the train to weigh.
    """

    horizon: int = 20
    position: float = 1.0
    lever: float = 1.0
    mass: float = NOMINAL_MASS

    def __post_init__(self) -> None:
        for name in ("horizon", "position", "lever", "mass"):
            if not getattr(self, name) > 0.0:
                raise InputError(f"tracking: {name} {getattr(self, name)} is not positive")


@dataclass
class TrackingController:
    """Follows one reference.

    Attributes
    ----------
    reference : Reference
    about : {"reference", "prediction"}
        About what the motion is linearised.
    tuning : Tuning
    due : float, optional [s]
        From the departure of the timetable to the arrival that is hurried for; default: that of
        the reference, which may have been put off.
    unsolved : int
        Steps at which the program was not solved, and the shifted plan was taken instead.
    """

    reference: Reference
    about: About = "prediction"
    tuning: Tuning = field(default_factory=Tuning)
    due: float | None = None
    unsolved: int = 0

    def __post_init__(self) -> None:
        if self.about not in ("reference", "prediction"):
            raise InputError(f"tracking: linearisation about '{self.about}' is unknown")
        section = self.reference.section
        self._tables = section.tables
        self._constants = section.driving_constants
        self._due = self.reference.duration if self.due is None else self.due
        self._plan: FloatArray | None = None
        self._mass = self.tuning.mass
        self._felt = ObservedMass(section.train.mass, section.train.max_mass)
        self._past: list[tuple[float, float, float]] = []
        self._held = 0.0
        self._asked = 0.0
        self._arriving = self._hurrying = False
        rows = self.reference.sampled()
        # The lever is held for a second: that of its middle stands for it.
        rows[:, 2] = [self.reference.at((k + 0.5) * SAMPLING)[2] for k in range(len(rows))]
        rest = np.tile([rows[-1, 0], 0.0, 0.0], (self.tuning.horizon + SHORTEST + 1, 1))
        rows[-1, 1:] = 0.0
        self._rows = np.concatenate([rows, rest])
        self._keep()

    @property
    def mass(self) -> tuple[float, float]:
        """Between what [kg] the mass of the motion is, by all that was felt in `drive`."""
        return self._felt.low, self._felt.high

    def drive(self, time: float, position: float, speed: float) -> float:
        """The lever for the next `PERIOD`.

        Once a second the program is solved; in between the guard lets through of its lever what
        the rail, the comfort and the ceiling allow. The last seconds are an even deceleration.

        Parameters
        ----------
        time : float [s]
            From the departure of the timetable.
        position, speed : float [m], [m/s]
            As measured.
        """
        self._past.append((position, speed, self._held))
        if len(self._past) > round(SAMPLING / PERIOD) or len(self._past) == 1:
            self._feel()
            self._past = [(position, speed, self._held)]
            self._asked = self._demanded(time, position, speed)
        asked = self._stopping(position, speed)
        if asked is None:
            asked = self._asked
        low, high = self.mass
        self._held = float(
            kernels.guarded(
                position, speed, asked, self._held, PERIOD, low, high,
                self._tables, self._constants,
            )
        )  # fmt: skip
        return self._held

    def lever(self, time: float, position: float, speed: float) -> float:
        """The lever that the program wants for the next second; see `drive`."""
        program = self.program(time, position, speed)
        plan = self._solved(program)
        self._plan = plan
        return float(plan[0])

    def program(self, time: float, position: float, speed: float) -> QPSubproblem:
        """The program (11) at a state; see `drive`."""
        target, aim = self._target(time, position, speed)
        mass, t, c = self._mass, self._tables, self._constants
        if self.about == "reference":
            states, levers = np.ascontiguousarray(target[:, :2]), aim
            deviation = np.array([position, speed]) - states[0]
        else:
            guess = self._guess(aim)
            if speed == 0.0:
                # A lever that leaves the train standing tells nothing of what more would do.
                guess = np.maximum(guess, self._starting(position))
            states, levers = kernels.predicted(position, speed, guess, SAMPLING, mass, t, c)
            deviation = np.zeros(2)
        tuning = self.tuning
        found = kernels.condensed(
            states, np.ascontiguousarray(levers), deviation,
            np.ascontiguousarray(target[:, :2]), np.ascontiguousarray(aim),
            tuning.position, tuning.lever, SAMPLING, mass, t, c,
        )  # fmt: skip
        hessian, gradient, rows, upper, lower = found
        return QPSubproblem(hessian, gradient, rows, upper, lower, levers)

    def guarded(self, lever: float, position: float, speed: float) -> float:
        """The lever next to `lever` that keeps (7) for a second, whatever the train weighs."""
        c = self._constants
        return float(
            kernels.guarded(
                position, speed, lever, lever, SAMPLING, c.light, c.heavy, self._tables, c
            )
        )

    def _stopping(self, position: float, speed: float) -> float | None:
        """The lever of an even deceleration to the stop; None while it is too far."""
        t, c = self._tables, self._constants
        left = self.reference.section.destination.position - position
        if not 0.0 < 2.0 * left < LAST * speed:
            return None
        if speed < HOLDING_SPEED:
            return 0.0
        grip = value(t.adhesion, t.origin, position + left)
        rest = HOLDING_SPEED**2 / (2.0 * min(HOLDING, grip * GRAVITY))
        lever = float(
            kernels.stopping_lever(position, speed, left - rest, HOLDING_SPEED, self._mass, t, c)
        )
        if not self._arriving:
            most = kernels.bounds_over(position, speed, position, speed, t, c)[0]
            self._arriving = 2.0 * left < APPROACH * speed or lever < HARD * most
        return lever if self._arriving else None

    def _demanded(self, time: float, position: float, speed: float) -> float:
        """The program's lever; one at its bound stands for all that the guard lets through."""
        program = self.program(time, position, speed)
        plan = self._solved(program)
        self._plan = plan
        change = plan[0] - program.inputs[0]
        if change > program.upper[0] - 1e-6:
            return 1.0
        return -1.0 if change < program.lower[0] + 1e-6 else float(plan[0])

    def _target(self, time: float, position: float, speed: float) -> tuple[FloatArray, FloatArray]:
        """Rows of the horizon to follow, and levers; the horizon shrinks at the stop.

        The reference with its lead, and a gentle return to it; where hardly more than the fastest
        run arrives in time that run, at the pace that arrives in time, until the reference is
        reached.
        """
        last = int(np.ceil(self.reference.duration / SAMPLING))
        at = min(max(round(time / SAMPLING), 0), last)
        n = int(np.clip(last - at, SHORTEST, self.tuning.horizon))
        if self.about == "reference":
            rows = self._rows[at : at + n + 1]
            return rows, rows[:n, 2]
        rows = self._kept[at : at + n + 1]
        off = position - rows[0, 0]
        run = self._fastest(position, speed)
        least, left = run[2][-1], max(self._due - time, 1e-3)
        self._hurrying = least > HASTE * left or (self._hurrying and off < 0.0)
        if least > 0.0 and self._hurrying:
            pace = min(least / left, 1.0)
            n = int(np.clip(np.ceil(least / (pace * SAMPLING)), SHORTEST, self.tuning.horizon))
            rows = paced(run, pace, n)
        else:
            rows = rows + np.pad(returning(off, n), ((0, 0), (0, 1)))
        return rows, rows[:n, 2].copy()

    def _fastest(self, position: float, speed: float) -> Fast:
        """The fastest run to the stop by positions, speeds, times, levers; no time if it stalls."""
        stop = self.reference.section.destination.position
        nothing = np.zeros(1)
        if stop - position < FAST_STEP:
            return nothing, nothing, nothing, nothing
        found: Fast = dynamics.fastest_run(
            position, speed, stop, FAST_STEP, np.inf, self._mass, 1.0,
            self._tables, self._constants,
        )  # fmt: skip
        return found if found[0][-1] > stop - 1e-6 else (nothing, nothing, nothing, nothing)

    def _keep(self) -> None:
        """The reference with the lead that it needs on this rail to be in time."""
        run = self._fastest(self.reference.section.origin.position, 0.0)
        self._kept = self._rows
        if run[2].size > 1:
            self._kept = with_lead(self._rows, latest(run, self._due, len(self._rows)))

    def _feel(self) -> None:
        """Learn of the mass from the last second, and raise the ceiling by what was learnt."""
        told = window(self._past, PERIOD, self._tables, self._constants)
        if told is not None and self._felt.observe(*told):
            self._mass = self._felt.middle
            self._tables = self.reference.section.braked_for(self._felt.high)
            self._keep()

    def _starting(self, position: float) -> float:
        """The lever above which a train at rest begins to move."""
        t, c = self._tables, self._constants
        sine = float(value(t.sine, t.origin, position))
        weight = GRAVITY * (sine + c.rolling * np.sqrt(1.0 - sine**2))
        return float(self._mass * weight / (c.k1 + c.k3))

    def _guess(self, aim: FloatArray) -> FloatArray:
        """The plan of the last second, shifted; the reference's levers where there is none."""
        if self._plan is None or self._plan.size < 2:
            return np.ascontiguousarray(aim)
        shifted = np.append(self._plan[1:], self._plan[-1])
        extra = max(aim.size - shifted.size, 0)
        return np.concatenate([shifted, np.full(extra, shifted[-1])])[: aim.size]

    def _solved(self, program: QPSubproblem) -> FloatArray:
        change, status = solve(program)
        if status <= 0:
            self.unsolved += 1
            return np.ascontiguousarray(program.inputs)
        return program.inputs + change
