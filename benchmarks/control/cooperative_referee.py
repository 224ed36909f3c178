"""The problem that `CooperativeController` linearises, solved by CasADi and IPOPT."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from analysis.control.cooperative import Demand, MultiMotorLocomotive, Tuning, slip_weights
from trainlog.arrays import FloatArray
from trainlog.errors import InputError


@dataclass
class NonlinearReferee:
    """Solves the problem that `CooperativeController` linearises: same model, same bounds.

    In traction, and for motors without lag.

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
        reference = demand.reference.ravel()
        weights, margins = slip_weights(reference, tuning)
        slacks = np.zeros(tuning.horizon * n)
        caps = np.tile(demand.limits / scale, tuning.control_horizon)
        bounds = np.full(tuning.control_horizon, demand.total / scale)
        free = np.full(slacks.size, np.inf)
        given: list[FloatArray] = [
            np.array([speed]), np.asarray(wheel_speeds, dtype=np.float64),
            demand.rail.ravel(), reference, weights,
        ]  # fmt: skip
        answer = self._solver(
            x0=np.concatenate([guess.ravel() / scale, slacks]),
            p=np.concatenate(given),
            lbx=np.concatenate([np.zeros(caps.size), -free]),
            ubx=np.concatenate([caps, free]),
            lbg=np.concatenate([np.full(bounds.size, -np.inf), -margins]),
            ubg=np.concatenate([bounds, margins]),
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
    levels, slacks = ca.SX.sym("u", moves * n), ca.SX.sym("s", horizon * n)
    state = ca.SX.sym("x", 1 + n)
    rail, reference = ca.SX.sym("rail", horizon * n * 3), ca.SX.sym("r", horizon * n)
    weights = ca.SX.sym("q", horizon * n)
    v = state[0]
    slips = [state[1 + i] - v for i in range(n)]
    errors = []
    for k in range(horizon):
        torques = [locomotive.torque_limit * levels[min(k, moves - 1) * n + i] for i in range(n)]
        curves = [[rail[(k * n + i) * 3 + j] for j in range(3)] for i in range(n)]
        for _ in range(tuning.substeps):
            v, slips = _substep(ca, locomotive, tuning, v, slips, torques, curves)
        errors += [slip - reference[k * n + i] for i, slip in enumerate(slips)]
    error = ca.vertcat(*errors)
    sums = [ca.sum1(levels[j * n : (j + 1) * n]) for j in range(moves)]
    problem = {
        "x": ca.vertcat(levels, slacks),
        "p": ca.vertcat(state, rail, reference, weights),
        "f": ca.dot(weights, error**2)
        + tuning.torque * ca.sumsqr(levels)
        + tuning.slack * ca.dot(weights, slacks**2),
        "g": ca.vertcat(*sums, error + slacks),
    }
    options: dict[str, Any] = {
        "print_time": False,
        "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-9},
    }
    return ca.nlpsol("cooperative", "ipopt", problem, options)


def _substep(
    ca: Any,
    locomotive: MultiMotorLocomotive,
    tuning: Tuning,
    v: Any,
    slips: list[Any],
    torques: list[Any],
    curves: list[list[Any]],
) -> tuple[Any, list[Any]]:
    """Speed and slip speeds after a substep; see `analysis.control.cooperative.predicted`."""
    mass, rotating, ratio, r0, r1, r2 = locomotive.constants
    step = tuning.period / tuning.substeps
    forces, slopes, stiff = [], [], []
    for slip, (a, b, c), load in zip(slips, curves, locomotive.axle_loads, strict=True):
        one, other = c * ca.exp(-a * ca.fabs(slip)), c * ca.exp(-b * ca.fabs(slip))
        forces.append(load * ca.sign(slip) * (one - other))
        slopes.append(load * (b * other - a * one))
        stiff.append(load * c * (b - a) / rotating)
    gain = (sum(forces) - r0 - (r1 + r2 * v) * v) / mass
    gain = ca.if_else(v <= 0.0, ca.fmax(gain, 0.0), gain)
    found = []
    for slip, force, slope, steep, torque in zip(
        slips, forces, slopes, stiff, torques, strict=True
    ):
        z = -step * slope / rotating
        series = 1.0 + z * (0.5 + z * (1.0 / 6.0 + z / 24.0))
        small = ca.fabs(z) < 1e-2
        weight = ca.if_else(small, series, (ca.exp(z) - 1.0) / ca.if_else(small, 1.0, z))
        reach = step * (weight if tuning.exact else 1.0)
        after = slip + reach * ((ratio * torque - force) / rotating - gain)
        if tuning.exact:
            keep, push = ca.exp(-step * steep), ratio * torque / rotating - gain
            turned = keep * slip + (1.0 - keep) / steep * push
            after = ca.if_else(slip * after < 0.0, turned, after)
        found.append(after)
    return ca.fmax(v + step * gain, 0.0), found
