"""Tracking MPC of Hauck et al. (2023), eqs. (9) to (11): follow the reference, keep the map.

Once a second a dense quadratic program in the levers of the next 20 s is solved by DAQP. As
published (`AS_PUBLISHED`) the motion is linearised about the reference by time, with R = 0.01.
`EXTENDED` linearises about the prediction from the measured state (a real-time iteration), which
also serves a train that is late, follows its reference with a lead where the rail asks for one,
learns of the train's mass, and has a guard between two programs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from analysis.control.qp import QPSubproblem, solve
from analysis.control.route import value
from analysis.studies.hauck_2023 import model as model, tracking as kernels
from analysis.studies.hauck_2023.model import NOMINAL_MASS
from analysis.studies.hauck_2023.reference import SAMPLING, Reference
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError
from trainlog.simulation.plant import HOLDING
from trainlog.units import GRAVITY

TOLERANCE = 0.015
"""How far measured and modelled acceleration may differ [m/s²]: lag, creep, the rail's bends."""

EXCITATION = 0.25
"""Less acceleration by the effort than this shows nothing of the mass [m/s²]."""

ROTATING = 0.08
"""What rotating parts add to the mass of the motion, at most, as a share of it."""

SETTLING = 3
"""Samples of each window in which the motors still follow the lever."""

STEADY = 0.03
"""How far the lever may move in a window that shows the mass."""

SLOWEST = 2.0
"""Speed at which a train still shows its mass: creep takes a share of slower ones [m/s]."""

EVEN_ADHESION = 1.1
"""How far the rail's adhesion may change in a window: wheels gain slip where it falls."""


@dataclass
class ObservedMass:
    """Every mass of the motion, rotating parts included, that agrees with all that was felt.

    Set membership: each observation bounds the mass, and what is left is the intersection. Where
    the observations contradict each other, as when wheels slip, all is open again.

    Attributes
    ----------
    lightest, heaviest : float [kg]
        Before anything was felt.
    low, high : float [kg]
    """

    lightest: float
    heaviest: float
    low: float = 0.0
    high: float = np.inf

    def __post_init__(self) -> None:
        self._restart()

    @property
    def middle(self) -> float:
        """Of the interval [kg]."""
        return 0.5 * (self.low + self.high)

    def observe(self, pull: float, acceleration: float, weight: float) -> bool:
        """Take in what a train did; says whether the interval became smaller.

        Parameters
        ----------
        pull : float [N]
            Effort less the drag of the air; negative in braking.
        acceleration : float [m/s²]
        weight : float [m/s²]
            What gravity and rolling resistance take from every kilogram that does not rotate.
        """
        gained = acceleration + weight
        if abs(gained) < EXCITATION or gained * pull <= 0.0:
            return False
        rotating = ROTATING * self.lightest * np.array([0.0, 1.0])
        found = (pull + rotating[:, None] * weight) / (gained + TOLERANCE * np.array([-1.0, 1.0]))
        low, high = max(self.low, float(found.min())), min(self.high, float(found.max()))
        if low > high:
            self._restart()
            return True
        smaller = low > self.low or high < self.high
        self.low, self.high = low, high
        return smaller

    def _restart(self) -> None:
        self.low, self.high = self.lightest, self.heaviest * (1.0 + ROTATING)


def window(
    past: Sequence[tuple[float, float, float]],
    period: float,
    t: model.Tables,
    c: model.Constants,
) -> tuple[float, float, float] | None:
    """What `ObservedMass.observe` needs from a second under way; None where it shows nothing.

    Parameters
    ----------
    past : sequence of tuple
        Position [m], speed [m/s], and the lever that led there.
    period : float [s]
        Between two samples.
    """
    if len(past) < SETTLING + 2:
        return None
    position, speed, lever = np.array(past).T
    if np.ptp(lever[1:]) > STEADY or speed[-1] < SLOWEST:
        return None
    position, speed, lever = position[SETTLING:], speed[SETTLING:], lever[SETTLING + 1 :]
    grip = [value(t.adhesion, t.origin, p) for p in position]
    if max(grip) > EVEN_ADHESION * min(grip):
        return None
    sine = np.array([value(t.sine, t.origin, p) for p in position])
    weight = GRAVITY * float(np.mean(sine + c.rolling * np.sqrt(1.0 - sine**2)))
    mean = 0.5 * (speed[1:] + speed[:-1])
    effort = lever * (c.k1 * np.exp(-c.k2 * mean) + c.k3)
    pull = float(np.mean(effort - c.drag * mean**2))
    return pull, float(speed[-1] - speed[0]) / (period * len(mean)), weight


RunArrays = tuple[FloatArray, FloatArray, FloatArray, FloatArray]

LATEST = 0.97
"""Where the fastest run takes this share of the time that is left no train should be behind."""

RETURN = 20.0
"""Time constant of leads, and with which a train that is near its target returns to it [s]."""

RETURN_ACCELERATION = 0.05
"""With which the speed of a train that returns comes back to the target's, at most [m/s²]."""

NEAR = 1.0
"""A train within this [m] of its target is brought back by the program alone."""


def latest(run: RunArrays, due: float, count: int) -> FloatArray:
    """Where a train must be, second by second, to arrive in time with a little in hand.

    At each place the fastest run takes `LATEST` of the time that is left from there; what is in
    hand shrinks to nothing at the stop, where the train arrives on the second.

    Parameters
    ----------
    run : RunArrays
        From departure to stop.
    due : float [s]
        Arrival, from the departure of the timetable.
    count : int

    Returns
    -------
    (count, 3) array
    """
    left = due - SAMPLING * np.arange(count, dtype=np.float64)
    now = run[2][-1] - LATEST * left
    return _rows(run, now, LATEST, (now > 0.0) & (left > 0.0))


def with_lead(rows: FloatArray, least: FloatArray) -> FloatArray:
    """Rows of a reference, brought ahead of it where it would fall behind `least`.

    The lead grows by `RETURN` towards the place where it is needed, so that a train need not brake
    with its reference and pull again.

    Parameters
    ----------
    rows, least : (n, 3) arrays

    Returns
    -------
    (n, 3) array
    """
    lead = np.maximum(least[:, 0] - rows[:, 0], 0.0)
    fading = np.exp(-SAMPLING / RETURN)
    for k in range(lead.size - 2, -1, -1):
        lead[k] = max(lead[k], fading * lead[k + 1])
    found = rows.copy()
    found[:, 0] += lead
    found[:-1, 1] += np.diff(lead) / SAMPLING
    held = (lead > 0.0) & (least[:, 0] > found[:, 0] - 1e-6)
    found[held] = least[held]
    return found


def paced(run: RunArrays, pace: float, steps: int) -> FloatArray:
    """The fastest run slowed so that it takes 1/pace of its time.

    Parameters
    ----------
    run : RunArrays
        From where the train is.
    pace : float
        Not above 1.
    steps : int

    Returns
    -------
    (steps + 1, 3) array
    """
    now = pace * SAMPLING * np.arange(steps + 1, dtype=np.float64)
    return _rows(run, now, pace, now >= 0.0)


def returning(off: float, steps: int) -> FloatArray:
    """How a train that is off its target returns to it: what is left, and its rate.

    By `RETURN` near the target; from farther away its speed changes by `RETURN_ACCELERATION`.
    Within `NEAR` nothing is left: a program that has to hold a distance cannot make up for errors
    of the model.

    Parameters
    ----------
    off : float [m]
        Position less the target's.
    steps : int

    Returns
    -------
    (steps + 1, 2) array [m], [m/s]
    """
    time = SAMPLING * np.arange(steps + 1, dtype=np.float64)
    size = abs(off) ** 3 / (off**2 + NEAR**2)
    near = min(size, RETURN_ACCELERATION * RETURN**2)
    rate = np.sqrt((near / RETURN) ** 2 + 2.0 * RETURN_ACCELERATION * (size - near))
    begun = (rate - near / RETURN) / RETURN_ACCELERATION
    far = size - rate * time + 0.5 * RETURN_ACCELERATION * time**2
    fading = near * np.exp(-(time - begun) / RETURN)
    left = np.where(time < begun, far, fading)
    change = np.where(time < begun, rate - RETURN_ACCELERATION * time, fading / RETURN)
    return np.asarray(np.sign(off) * np.column_stack([left, -change]))


def _rows(run: RunArrays, now: FloatArray, pace: float, moving: BoolArray) -> FloatArray:
    """A run at times of its own [s]; a lever is held for a second, and its middle stands for it."""
    positions, speeds, times, levers = run
    return np.column_stack([
        np.interp(now, times, positions),
        pace * np.interp(now, times, speeds) * moving,
        np.interp(now + 0.5 * pace * SAMPLING, times, levers),
    ])  # fmt: skip


About = Literal["reference", "prediction"]

PERIOD = 0.1
"""Between two levers of the guard [s]."""

HOLDING_SPEED = 0.5
"""Below it the holding brake is applied to a train that does not pull [m/s]."""

APPROACH = 4.0
"""The last seconds before the stop are driven to the place rather than by the clock [s]."""

LAST = 15.0
"""Nothing but the stop is ahead within this time [s]."""

HARD_BRAKING = 0.9
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


@dataclass(frozen=True, slots=True)
class Method:
    """How a reference is followed.

    Attributes
    ----------
    about : {"reference", "prediction"}
        About what the motion is linearised.
    tuning : Tuning
    extended : bool
        Whether there is more than the program of eq. (11): ten times a second a guard, the mass
        that is learnt under way, and the even deceleration of the last seconds. A lead and a run
        that hurries go with the prediction.
    """

    about: About = "prediction"
    tuning: Tuning = field(default=Tuning())
    extended: bool = True

    def __post_init__(self) -> None:
        if self.about not in ("reference", "prediction"):
            raise InputError(
                f"tracking: linearisation about '{self.about}' is unknown",
                remedy="linearise about the reference or the prediction",
            )


EXTENDED = Method()
"""What this study adds to the paper."""

AS_PUBLISHED = Method("reference", Tuning(lever=0.01), extended=False)
"""Eqs. (9) to (11) and section 4 of the paper, and no more."""


@dataclass
class TrackingController:
    """Follows one reference.

    Attributes
    ----------
    reference : Reference
    method : Method
    due : float, optional [s]
        From the departure of the timetable to the arrival that is hurried for; default: that of
        the reference, which may have been put off.
    unsolved : int
        Steps at which the program was not solved, and the shifted plan was taken instead.
    """

    reference: Reference
    method: Method = EXTENDED
    due: float | None = None
    unsolved: int = 0

    def __post_init__(self) -> None:
        section = self.reference.section
        self._tables = section.tables
        self._constants = section.driving_constants
        self._due = self.reference.duration if self.due is None else self.due
        self._plan: FloatArray | None = None
        self._mass = self.method.tuning.mass
        self._observed_mass = ObservedMass(section.train.mass, section.train.max_mass)
        self._past: list[tuple[float, float, float]] = []
        self._held = 0.0
        self._asked = 0.0
        self._arriving = self._hurrying = False
        rows = self.reference.sampled()
        # The lever is held for a second: that of its middle stands for it.
        rows[:, 2] = [self.reference.at((k + 0.5) * SAMPLING)[2] for k in range(len(rows))]
        rest = np.tile([rows[-1, 0], 0.0, 0.0], (self.method.tuning.horizon + SHORTEST + 1, 1))
        rows[-1, 1:] = 0.0
        self._rows = np.concatenate([rows, rest])
        self._lead()

    @property
    def mass(self) -> tuple[float, float]:
        """Between what [kg] the mass of the motion is, by all that was felt in `drive`."""
        return self._observed_mass.low, self._observed_mass.high

    def drive(self, time: float, position: float, speed: float) -> float:
        """The lever for the next `PERIOD`.

        Once a second the program is solved. As published its lever is held until the next.
        Extended, the guard lets through of it what rail, comfort and ceiling allow, and the last
        seconds are an even deceleration.

        Parameters
        ----------
        time : float [s]
            From the departure of the timetable.
        position, speed : float [m], [m/s]
            As measured.
        """
        self._past.append((position, speed, self._held))
        if len(self._past) > round(SAMPLING / PERIOD) or len(self._past) == 1:
            if not self.method.extended:
                self._held = self.lever(time, position, speed)
            else:
                self._learn_mass()
                self._asked = self._demanded(time, position, speed)
            self._past = [(position, speed, self._held)]
        if not self.method.extended:
            return self._held
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
        if self.method.about == "reference":
            states, levers = np.ascontiguousarray(target[:, :2]), aim
            deviation = np.array([position, speed]) - states[0]
        else:
            guess = self._guess(aim)
            if speed == 0.0:
                # A lever that leaves the train standing shows nothing of what more would do.
                guess = np.maximum(guess, self._starting(position))
            states, levers = kernels.predicted(position, speed, guess, SAMPLING, mass, t, c)
            deviation = np.zeros(2)
        tuning = self.method.tuning
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
            self._arriving = 2.0 * left < APPROACH * speed or lever < HARD_BRAKING * most
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
        n = int(np.clip(last - at, SHORTEST, self.method.tuning.horizon))
        if self.method.about == "reference":
            rows = self._rows[at : at + n + 1]
            return rows, rows[:n, 2]
        rows = self._kept[at : at + n + 1]
        off = position - rows[0, 0]
        run = self._fastest(position, speed)
        least, left = run[2][-1], max(self._due - time, 1e-3)
        self._hurrying = least > HASTE * left or (self._hurrying and off < 0.0)
        if least > 0.0 and self._hurrying:
            pace = min(least / left, 1.0)
            n = int(
                np.clip(np.ceil(least / (pace * SAMPLING)), SHORTEST, self.method.tuning.horizon)
            )
            rows = paced(run, pace, n)
        else:
            rows = rows + np.pad(returning(off, n), ((0, 0), (0, 1)))
        return rows, rows[:n, 2].copy()

    def _fastest(self, position: float, speed: float) -> RunArrays:
        """The fastest run to the stop by positions, speeds, times, levers; no time if it stalls."""
        stop = self.reference.section.destination.position
        nothing = np.zeros(1)
        if stop - position < FAST_STEP:
            return nothing, nothing, nothing, nothing
        found: RunArrays = model.fastest_run(
            position, speed, stop, FAST_STEP, np.inf, self._mass, 1.0,
            self._tables, self._constants,
        )  # fmt: skip
        return found if found[0][-1] > stop - 1e-6 else (nothing, nothing, nothing, nothing)

    def _lead(self) -> None:
        """The reference with the lead that it needs on this rail to be in time."""
        run = self._fastest(self.reference.section.origin.position, 0.0)
        self._kept = self._rows
        if run[2].size > 1:
            self._kept = with_lead(self._rows, latest(run, self._due, len(self._rows)))

    def _learn_mass(self) -> None:
        """Learn of the mass from the last second, and raise the ceiling by what was learnt."""
        observed = window(self._past, PERIOD, self._tables, self._constants)
        if observed is not None and self._observed_mass.observe(*observed):
            self._mass = self._observed_mass.middle
            self._tables = self.reference.section.braked_for(self._observed_mass.high)
            self._lead()

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
