"""Cooperative maximum-adhesion MPC of paper 003: the torques of all motors from one program.

Each axle is to run at the slip speed at which its rail gives most (eq. 16), within the torque of
each motor and of all of them together (eq. 17). At every sample the motion is linearised along the
prediction from the measured state, and the dense quadratic program is solved by DAQP: a real-time
iteration. `analysis.studies.zhao_2025.referee` solves the nonlinear problem itself.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.studies.zhao_2025 import kernels as kernels
from trainlog.errors import InputError
from trainlog.railway.adhesion import CreepCurve
from trainlog.railway.resistance import RunningResistance

FloatArray = NDArray[np.float64]

UNBOUNDED = 1e30
"""What the solver takes for no bound."""


@dataclass(frozen=True)
class Locomotive:
    """A locomotive with a motor for each axle, and what it pulls.

    Attributes
    ----------
    name : str
    mass : float [kg]
        Of locomotive and train, without the rotating part; M of eq. (1).
    axle_loads : tuple of float [N]
        Weight on each driven axle, W g of eq. (2).
    inertia : float [kg m²]
        Of one axle with its motor, at the motor; J_eq of eq. (9).
    gear_ratio : float
        Motor speed over axle speed, R_g.
    wheel_radius : float [m]
    resistance : RunningResistance
        F_d, eq. (3).
    torque_limit, total_torque : float [N m]
        The most that a motor, and that all of them together may give.
    """

    name: str
    mass: float
    axle_loads: tuple[float, ...]
    inertia: float
    gear_ratio: float
    wheel_radius: float
    resistance: RunningResistance
    torque_limit: float
    total_torque: float

    def __post_init__(self) -> None:
        for name in (
            "mass", "inertia", "gear_ratio", "wheel_radius", "torque_limit", "total_torque",
        ):  # fmt: skip
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(
                    f"locomotive '{self.name}': {name} {getattr(self, name)} is not positive"
                )
        if not self.axle_loads or not all(load > 0.0 for load in self.axle_loads):
            raise InputError(
                f"locomotive '{self.name}': needs driven axles, each with a positive load"
            )

    @property
    def axles(self) -> int:
        """Number of driven axles."""
        return len(self.axle_loads)

    @property
    def effort_per_torque(self) -> float:
        """Effort at the wheel rims for each newton metre at the motor [1/m]."""
        return self.gear_ratio / self.wheel_radius

    @property
    def rotating_mass(self) -> float:
        """Inertia of one axle with its motor, as a mass at the wheel rims [kg]."""
        return self.inertia * self.effort_per_torque**2

    @property
    def loads(self) -> FloatArray:
        """`axle_loads` as an array, (n,) [N]."""
        return np.array(self.axle_loads, dtype=np.float64)

    @property
    def constants(self) -> tuple[float, float, float, float, float, float]:
        """What the compiled code needs: masses [kg], effort per torque [1/m], r0, r1, r2."""
        r = self.resistance
        return (self.mass, self.rotating_mass, self.effort_per_torque, r.r0, r.r1, r.r2)


@dataclass(frozen=True, slots=True)
class Tuning:
    """Of eqs. (15)-(17).

    Attributes
    ----------
    horizon, control_horizon : int
        Np and Nc: steps that are predicted, and steps with a torque of their own.
    period : float [s]
        T.
    substeps : int
        Of the prediction within a period. The paper takes one, which is unstable for axles that
        are light for their load: below the peak creep pulls a wheel to the train's speed within
        milliseconds.
    slip : float [s²/m²]
        Q is this times the unit matrix.
    torque : float
        R likewise, on torques over the torque limit.
    margin : float [m/s]
        Epsilon: how far the slip speed may stray from its reference.
    slack : float [s²/m²]
        Weight of the squared excess over these bounds, which must be soft: a rail that has just
        become wet, or a motor that fails, makes them impossible. Heavier ones take the other axles
        off their peak for the sake of one that cannot reach its own.
    """

    horizon: int = 10
    control_horizon: int = 5
    period: float = 0.1
    substeps: int = 1
    slip: float = 1.0
    torque: float = 1e-4
    margin: float = 0.2
    slack: float = 5.0

    def __post_init__(self) -> None:
        for name in self.__slots__:
            if not (getattr(self, name) > 0.0 and np.isfinite(getattr(self, name))):
                raise InputError(
                    f"cooperative control: {name} {getattr(self, name)} is not positive"
                )
        if self.control_horizon > self.horizon:
            raise InputError(
                f"cooperative control: {self.control_horizon} steps of control are more than the"
                f" {self.horizon} that are predicted"
            )


@dataclass(frozen=True, eq=False)
class Demand:
    """What the motors may give at one instant, and where their axles are to run.

    Attributes
    ----------
    rail : (horizon, n, 3) array
        a, b and c of the creep curve under each axle.
    reference : (horizon, n) array [m/s]
        Slip speeds.
    limits : (n,) array [N m]
        Of the motors; a failed one has less.
    total : float [N m]
        Of all motors together.
    """

    rail: FloatArray
    reference: FloatArray
    limits: FloatArray
    total: float


@dataclass(frozen=True, eq=False)
class Program:
    """``min 1/2 x'Hx + f'x``: changes of the plan's torques over the torque limit, then slacks.

    Attributes
    ----------
    hessian, gradient : (m, m), (m,) arrays
        m is control horizon * n torques and horizon * n slacks [m/s].
    rows : (control horizon + horizon * n, m) array
        Sums of the torques; slip speeds and their slacks.
    upper, lower : arrays
        Of x, then of the rows.
    """

    hessian: FloatArray
    gradient: FloatArray
    rows: FloatArray
    upper: FloatArray
    lower: FloatArray


def coefficients(curves: Sequence[CreepCurve]) -> FloatArray:
    """a, b and c of the creep curves under the axles, (n, 3)."""
    return np.array([(each.a, each.b, each.c) for each in curves], dtype=np.float64)


def peak_slips(rail: FloatArray) -> FloatArray:
    """Slip speeds of maximum adhesion [m/s] of (..., 3) creep curves."""
    a, b = rail[..., 0], rail[..., 1]
    return np.asarray(np.log(b / a) / (b - a))


@dataclass
class CooperativeController:
    """Gives the torques of all motors, sample by sample.

    Attributes
    ----------
    locomotive : Locomotive
    tuning : Tuning
    unsolved : int
        Samples at which the program was not solved, and the shifted plan was taken instead.
    """

    locomotive: Locomotive
    tuning: Tuning = field(default_factory=Tuning)
    unsolved: int = 0

    def __post_init__(self) -> None:
        self._plan = np.zeros((self.tuning.control_horizon, self.locomotive.axles))

    @property
    def plan(self) -> FloatArray:
        """Torques from the last sample on, (control horizon, n) [N m]."""
        return self._plan.copy()

    def torques(self, speed: float, wheel_speeds: ArrayLike, demand: Demand) -> FloatArray:
        """Torques of the motors until the next sample.

        Parameters
        ----------
        speed : float [m/s]
            Of the train.
        wheel_speeds : (n,) array [m/s]
            Circumferential.
        demand : Demand
            See `demand`.

        Returns
        -------
        (n,) array [N m]
            Never beyond the limits of a motor or of all together.
        """
        state = self._state(speed, wheel_speeds)
        guess = self.guess(demand)
        change, status = solve(self.program(state, guess, demand))
        if status <= 0:
            self.unsolved += 1
            change = np.zeros(change.size)
        moved = change[: guess.size].reshape(guess.shape)
        # The solver keeps its bounds within a tolerance, a motor does not.
        self._plan = within(guess + self.locomotive.torque_limit * moved, demand)
        return np.asarray(self._plan[0].copy())

    def demand(
        self,
        rail: ArrayLike,
        limits: ArrayLike | None = None,
        total: float | None = None,
        reference: ArrayLike | None = None,
    ) -> Demand:
        """What is asked of the motors on a rail.

        Parameters
        ----------
        rail : (n, 3) or (horizon, n, 3) array
            Creep curves under the axles now, or over the horizon; see `coefficients`.
        limits : (n,) array [N m], optional
            Of the motors; default: the torque limit.
        total : float [N m], optional
            Of all motors; default: that of the locomotive.
        reference : (n,) array [m/s], optional
            Slip speeds; default: those of the maximum adhesion of the curves.

        Raises
        ------
        InputError
            If shapes do not fit, a creep curve is none, or a limit is negative.
        """
        n, horizon = self.locomotive.axles, self.tuning.horizon
        curves = np.asarray(rail, dtype=np.float64)
        if curves.shape not in ((n, 3), (horizon, n, 3)):
            raise InputError(
                f"cooperative control: creep curves of shape {curves.shape}",
                remedy=f"give a, b, c of {n} axles, or of each in {horizon} steps",
            )
        a, b, c = np.moveaxis(curves, -1, 0)
        if not np.all((a > 0.0) & (b > a) & (c > 0.0) & np.isfinite(b + c)):
            raise InputError("cooperative control: creep curves need 0 < a < b and c > 0")
        limit = self.locomotive.torque_limit
        caps = np.full(n, limit) if limits is None else np.asarray(limits, dtype=np.float64)
        if caps.shape != (n,) or not np.all((caps >= 0.0) & (caps <= limit)):
            raise InputError(
                f"cooperative control: limits of the motors {caps} are not {n} torques"
                f" from 0 to {limit:g} N m"
            )
        most = self.locomotive.total_torque if total is None else float(total)
        if not most >= 0.0:
            raise InputError(f"cooperative control: total torque {most} N m is negative")
        curves = np.ascontiguousarray(np.broadcast_to(curves, (horizon, n, 3)))
        slips = peak_slips(curves)
        if reference is not None:
            given = np.asarray(reference, dtype=np.float64)
            if given.shape != (n,) or not np.all(np.isfinite(given)):
                raise InputError(f"cooperative control: reference slip speeds {given} of {n} axles")
            slips = np.tile(given, (horizon, 1))
        return Demand(curves, slips, caps, most)

    def guess(self, demand: Demand) -> FloatArray:
        """The plan of the last sample, shifted, and made to keep the limits."""
        return within(np.concatenate([self._plan[1:], self._plan[-1:]]), demand)

    def program(self, state: FloatArray, plan: FloatArray, demand: Demand) -> Program:
        """The program (18), linearised about a plan from a state; see `Program`."""
        tuning, locomotive = self.tuning, self.locomotive
        scale = locomotive.torque_limit
        slip, change = kernels.predicted(
            state, plan, demand.rail, locomotive.loads, locomotive.constants,
            tuning.period, tuning.substeps,
        )  # fmt: skip
        change *= scale
        error = slip - demand.reference.ravel()
        levels = plan.ravel() / scale
        (moves, n), size, soft = plan.shape, plan.size, error.size
        # Each soft row has a variable of its own: the solver's own soft rows are weighted by
        # their length, which differs from row to row.
        hessian = np.zeros((size + soft, size + soft))
        hessian[:size, :size] = 2.0 * tuning.slip * change.T @ change
        weights = np.concatenate([np.full(size, tuning.torque), np.full(soft, tuning.slack)])
        hessian[np.diag_indices_from(hessian)] += 2.0 * weights
        gradient = np.zeros(size + soft)
        gradient[:size] = 2.0 * (tuning.slip * change.T @ error + tuning.torque * levels)
        rows = np.zeros((moves + soft, size + soft))
        rows[:moves, :size] = sums = np.kron(np.eye(moves), np.ones((1, n)))
        rows[moves:, :size] = change
        rows[moves:, size:] = np.eye(soft)
        upper = np.concatenate([
            np.tile(demand.limits / scale, moves) - levels,
            np.full(soft, UNBOUNDED),
            demand.total / scale - sums @ levels,
            tuning.margin - error,
        ])  # fmt: skip
        lower = np.concatenate([
            -levels, np.full(soft + moves, -UNBOUNDED), -tuning.margin - error
        ])  # fmt: skip
        return Program(hessian, gradient, rows, upper, lower)

    def _state(self, speed: float, wheel_speeds: ArrayLike) -> FloatArray:
        wheels = np.asarray(wheel_speeds, dtype=np.float64)
        if wheels.shape != (self.locomotive.axles,):
            raise InputError(
                f"cooperative control: wheel speeds of shape {wheels.shape} for"
                f" {self.locomotive.axles} axles"
            )
        state = np.concatenate([[speed], wheels])
        if not np.all(np.isfinite(state)):
            raise InputError(f"cooperative control: speeds {state} are not all numbers")
        return state


def within(plan: FloatArray, demand: Demand) -> FloatArray:
    """Torques next to a plan that keep the limits: capped, then scaled down to the total."""
    capped = np.clip(plan, 0.0, demand.limits)
    sums = np.maximum(capped.sum(axis=1, keepdims=True), 1e-300)
    return np.asarray(capped * np.minimum(demand.total / sums, 1.0))


def solve(program: Program) -> tuple[FloatArray, int]:
    """Solve a program by DAQP.

    Returns
    -------
    change : (m,) array
    status : int
        Positive where the optimum was found.
    """
    import daqp

    answer: tuple[Any, ...] = daqp.solve(
        program.hessian, program.gradient, program.rows, program.upper, program.lower
    )
    return np.asarray(answer[0]), int(answer[2])
