"""The nonlinear problem (18) of paper 003 itself, by CasADi and IPOPT: what a step is judged by."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from analysis.studies.zhao_2025.controller import Demand, Locomotive, Tuning
from trainlog.errors import InputError

FloatArray = NDArray[np.float64]


@dataclass
class Referee:
    """Solves the problem that `CooperativeController` linearises: same model, same bounds.

    Attributes
    ----------
    locomotive : Locomotive
    tuning : Tuning
    """

    locomotive: Locomotive
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


def _built(locomotive: Locomotive, tuning: Tuning) -> Any:
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
