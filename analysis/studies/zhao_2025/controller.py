"""Cooperative maximum-adhesion MPC of Zhao et al. (2025): all torques from one program.

Each axle is to run at the slip speed at which its rail gives most (eq. 16), within the torque of
each motor and of all of them together (eq. 17). At every sample the motion is linearised along the
prediction from the measured state, and the dense quadratic program is solved by DAQP: a real-time
iteration. `NonlinearReferee` solves the nonlinear problem itself, by CasADi and IPOPT.

Beside it stand slip controllers that know nothing of each other. They are proportional and
integral: a wheel under torque is an integrator of slip speed near the peak of the creep curve, and
their gains put both poles at `BANDWIDTH`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.control.qp import UNBOUNDED, QPSubproblem, solve
from analysis.studies.zhao_2025 import model
from analysis.studies.zhao_2025.model import MultiMotorLocomotive
from trainlog.errors import InputError
from trainlog.railway.adhesion import CreepCurve

FloatArray = NDArray[np.float64]

BANDWIDTH = 6.0
"""Of a slip controller [rad/s]: of those from 1 to 8 the one that takes a locomotive farthest."""


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
    locomotive : MultiMotorLocomotive
    tuning : Tuning
    unsolved : int
        Samples at which the program was not solved, and the shifted plan was taken instead.
    """

    locomotive: MultiMotorLocomotive
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

    def program(self, state: FloatArray, plan: FloatArray, demand: Demand) -> QPSubproblem:
        """The program (18), linearised about a plan from a state.

        In changes of the plan's torques over the torque limit, then slacks [m/s]; its rows are the
        sums of the torques, then slip speeds and their slacks.
        """
        tuning, locomotive = self.tuning, self.locomotive
        scale = locomotive.torque_limit
        slip, change = model.predicted(
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
        return QPSubproblem(hessian, gradient, rows, upper, lower, plan, soft=False)

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


# ---- without cooperation -----------------------------------------------------------------------


@dataclass
class NoSlipControl:
    """Every motor has its share of the total and gives it, whatever its wheels do."""

    locomotive: MultiMotorLocomotive

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        del speed, wheel_speeds
        return _share(demand)


@dataclass
class AxleByAxle:
    """Every motor has its share of the total and a slip controller of its own."""

    locomotive: MultiMotorLocomotive
    period: float

    def __post_init__(self) -> None:
        self._memory = np.zeros(self.locomotive.axles)

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        error = demand.reference[0] - (wheel_speeds - speed)
        torque, self._memory = _controlled(
            self.locomotive, self.period, error, self._memory, _share(demand)
        )
        return torque


@dataclass
class EqualTorque:
    """All motors get one torque, as from one inverter; the axle that slips most decides on it."""

    locomotive: MultiMotorLocomotive
    period: float

    def __post_init__(self) -> None:
        self._memory = np.zeros(1)

    def torques(self, speed: float, wheel_speeds: FloatArray, demand: Demand) -> FloatArray:
        """Torques until the next sample, (n,) [N m]; see `CooperativeController.torques`."""
        error = demand.reference[0] - (wheel_speeds - speed)
        worst, most = error.min(keepdims=True), _share(demand).min(keepdims=True)
        torque, self._memory = _controlled(self.locomotive, self.period, worst, self._memory, most)
        return np.full(self.locomotive.axles, torque[0])


def _share(demand: Demand) -> FloatArray:
    return np.minimum(demand.total / demand.limits.size, demand.limits)


def _controlled(
    locomotive: MultiMotorLocomotive,
    period: float,
    error: FloatArray,
    memory: FloatArray,
    most: FloatArray,
) -> tuple[FloatArray, FloatArray]:
    """Proportional and integral control of slip errors [m/s]: torques and memory [N m]."""
    gain = locomotive.effort_per_torque / locomotive.rotating_mass
    proportional = 2.0 * BANDWIDTH / gain * error
    grown = memory + period * BANDWIDTH**2 / gain * error
    torque = np.clip(proportional + grown, 0.0, most)
    # Beyond a limit the memory may only move back.
    outward = (proportional + grown - torque) * error > 0.0
    return np.asarray(torque), np.where(outward, memory, grown)


# ---- the nonlinear problem itself --------------------------------------------------------------


@dataclass
class NonlinearReferee:
    """Solves the problem that `CooperativeController` linearises: same model, same bounds.

    Attributes
    ----------
    locomotive : MultiMotorLocomotive
    tuning : Tuning
    """

    locomotive: MultiMotorLocomotive
    tuning: Tuning = field(default_factory=Tuning)

    def __post_init__(self) -> None:
        self._solver = _built(self.locomotive, self.tuning)

    def plan(
        self, speed: float, wheel_speeds: ArrayLike, guess: FloatArray, demand: Demand
    ) -> FloatArray:
        """The best torques from a state on, (control horizon, n) [N m].

        Parameters
        ----------
        speed, wheel_speeds : [m/s]
        guess : (control horizon, n) array [N m]
            Where the search begins.
        demand : Demand

        Raises
        ------
        InputError
            If IPOPT finds no optimum.
        """
        tuning, n = self.tuning, self.locomotive.axles
        scale = self.locomotive.torque_limit
        slacks = np.zeros(tuning.horizon * n)
        caps = np.tile(demand.limits / scale, tuning.control_horizon)
        bounds = np.full(tuning.control_horizon, demand.total / scale)
        free, margin = np.full(slacks.size, np.inf), np.full(slacks.size, tuning.margin)
        given: list[FloatArray] = [
            np.array([speed]), np.asarray(wheel_speeds, dtype=np.float64),
            demand.rail.ravel(), demand.reference.ravel(),
        ]  # fmt: skip
        answer = self._solver(
            x0=np.concatenate([guess.ravel() / scale, slacks]),
            p=np.concatenate(given),
            lbx=np.concatenate([np.zeros(caps.size), -free]),
            ubx=np.concatenate([caps, free]),
            lbg=np.concatenate([np.full(bounds.size, -np.inf), -margin]),
            ubg=np.concatenate([bounds, margin]),
        )
        if not self._solver.stats()["success"]:
            raise InputError(
                f"cooperative control: IPOPT found no optimum"
                f" ({self._solver.stats()['return_status']})",
                remedy="begin from another guess",
            )
        levels = np.asarray(answer["x"]).ravel()[: caps.size]
        return np.asarray(scale * levels.reshape(guess.shape))


def _built(locomotive: MultiMotorLocomotive, tuning: Tuning) -> Any:
    import casadi as ca

    n, horizon, moves = locomotive.axles, tuning.horizon, tuning.control_horizon
    mass, rotating, ratio, r0, r1, r2 = locomotive.constants
    step = tuning.period / tuning.substeps
    levels, slacks = ca.SX.sym("u", moves * n), ca.SX.sym("s", horizon * n)
    state = ca.SX.sym("x", 1 + n)
    rail, reference = ca.SX.sym("rail", horizon * n * 3), ca.SX.sym("r", horizon * n)
    v, wheels = state[0], [state[1 + i] for i in range(n)]
    errors = []
    for k in range(horizon):
        torques = [locomotive.torque_limit * levels[min(k, moves - 1) * n + i] for i in range(n)]
        curves = [[rail[(k * n + i) * 3 + j] for j in range(3)] for i in range(n)]
        for _ in range(tuning.substeps):
            forces = []
            for w, (a, b, c), load in zip(wheels, curves, locomotive.axle_loads, strict=True):
                size = ca.fabs(w - v)
                adhesion = c * (ca.exp(-a * size) - ca.exp(-b * size))
                forces.append(load * ca.sign(w - v) * adhesion)
            gain = (sum(forces) - r0 - (r1 + r2 * v) * v) / mass
            gain = ca.if_else(v <= 0.0, ca.fmax(gain, 0.0), gain)
            wheels = [
                w + step * (ratio * torque - force) / rotating
                for w, torque, force in zip(wheels, torques, forces, strict=True)
            ]
            v = ca.fmax(v + step * gain, 0.0)
        errors += [w - v - reference[k * n + i] for i, w in enumerate(wheels)]
    error = ca.vertcat(*errors)
    sums = [ca.sum1(levels[j * n : (j + 1) * n]) for j in range(moves)]
    problem = {
        "x": ca.vertcat(levels, slacks),
        "p": ca.vertcat(state, rail, reference),
        "f": tuning.slip * ca.sumsqr(error)
        + tuning.torque * ca.sumsqr(levels)
        + tuning.slack * ca.sumsqr(slacks),
        "g": ca.vertcat(*sums, error + slacks),
    }
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9},
    }
    return ca.nlpsol("cooperative", "ipopt", problem, options)
