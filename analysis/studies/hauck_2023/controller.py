"""Who follows a reference: the controller of Hauck et al. (2023), and the product's own.

`PublishedController` is that of eqs. (9) to (11): once a second a dense quadratic program in the
levers of the next 20 s, linearised about the reference by time. `MapController` is
`analysis.control.follow.Follower` on the same reference and map: it linearises about the
prediction from the measured state, learns of its train, and has a guard between two programs.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Protocol

import numpy as np
from scipy.linalg import expm

from analysis.control.follow import Follower
from analysis.control.prediction import (
    AHEAD,
    QPSubproblem,
    solve,
    speed_rows,
    terminal_weight,
    tracking_cost,
)
from analysis.studies.hauck_2023.model import (
    NOMINAL_MASS,
    TOP_SPEED,
    LeverTrain,
    Tables,
    full_effort,
    lever_bounds,
)
from analysis.studies.hauck_2023.reference import SAMPLING, Reference
from analysis.studies.hauck_2023.section import NO_LIMIT, STOPPING_TOLERANCE, smoothed_line
from trainlog.arrays import FloatArray
from trainlog.railway import Configuration, Line, StepProfile, TrackConditionMap, Train, Trajectory
from trainlog.railway.condition import BIN_LENGTH, ConditionLayer
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.resistance import EffortCurve
from trainlog.simulation.drivers import DEPARTURE, PERIOD, Observation
from trainlog.units import GRAVITY

HORIZON, LEVER_WEIGHT = 20, 0.01
"""N and R of eq. (11); Q is the unit matrix."""

SHORTEST = 6
"""Steps of the horizon that remain at the stop."""

BELOW = 0.02
"""The program stays this far below the ceiling [m/s]."""


HOLDING_SPEED, SOONER = 0.5, 0.3
"""Below this speed [m/s] a train at its stop is left to the holding brake, which stops it by so
much sooner [m]."""


class Controller(Protocol):
    """Follows one reference."""

    @property
    def unsolved(self) -> int:
        """Steps at which the program was not solved, and the plan was kept."""
        ...

    def lever(self, time: float, position: float, speed: float) -> float:
        """The lever for the next `PERIOD`.

        Parameters
        ----------
        time : float [s]
            From the departure of the timetable.
        position, speed : float [m], [m/s]
            As measured.
        """
        ...


class PublishedController:
    """Eqs. (9) to (11) and section IV of the paper, and no more; a `Controller`."""

    def __init__(self, reference: Reference, due: float | None = None) -> None:
        del due  # it follows the reference, whatever the timetable asks
        self.unsolved = 0
        self._reference = reference
        self._held, self._until = 0.0, 0
        rows = reference.sampled()
        # The lever is held for a second: that of its middle stands for it.
        rows[:, 2] = [reference.at((k + 0.5) * SAMPLING)[2] for k in range(len(rows))]
        rest = np.tile([rows[-1, 0], 0.0, 0.0], (HORIZON + SHORTEST + 1, 1))
        rows[-1, 1:] = 0.0
        self._rows = np.concatenate([rows, rest])

    def lever(self, time: float, position: float, speed: float) -> float:
        """See `Controller`; a lever is held for a second."""
        if self._until == 0:
            program = self.program(time, position, speed)
            change, status = solve(program)
            self.unsolved += status <= 0
            self._held = float(program.inputs[0] + (change[0] if status > 0 else 0.0))
            self._until = round(SAMPLING / PERIOD)
        self._until -= 1
        return self._held

    def program(self, time: float, position: float, speed: float) -> QPSubproblem:
        """The program (11) at a state; the horizon shrinks at the stop."""
        section = self._reference.section
        last = int(np.ceil(self._reference.duration / SAMPLING))
        at = min(max(round(time / SAMPLING), 0), last)
        n = int(np.clip(last - at, SHORTEST, HORIZON))
        states, levers = self._rows[at : at + n + 1, :2], self._rows[at : at + n, 2]
        deviation = np.array([position, speed]) - states[0]
        return condensed(states, levers, deviation, section.tables, section.driving_train)


def condensed(
    states: FloatArray, levers: FloatArray, deviation: FloatArray, t: Tables, c: LeverTrain
) -> QPSubproblem:
    """The program (11) in the changes of the lever alone.

    Parameters
    ----------
    states, levers : (n + 1, 2), (n,) arrays
        Of the reference, about which the motion is linearised.
    deviation : (2,) array
        Of the measured state from the first of them.
    """
    n, (p, v) = levers.size, states.T
    a, b = sampled_system(p[:-1], v[:-1], levers, t, c)
    free, response = np.zeros((n + 1, 2)), np.zeros((n + 1, 2, n))
    free[0] = deviation
    for k in range(n):
        free[k + 1], response[k + 1] = a[k] @ free[k], a[k] @ response[k]
        response[k + 1, :, k] += b[k]
    share = 0.25 * np.arange(5)[:, None]
    places, speeds = (each[:-1] + share * np.diff(each) for each in (p, v))
    ahead = t.at(t.adhesion, places + AHEAD * speeds)
    grip = np.minimum(t.at(t.adhesion, places), ahead)
    low, high = lever_bounds(speeds, t.at(t.sine, places), grip, c)
    least, most = np.maximum(low.max(axis=0), -1.0), np.minimum(high.min(axis=0), 1.0)
    terminal = terminal_weight(a[-1], b[-1], 1.0, LEVER_WEIGHT)
    hessian, gradient = tracking_cost(response, free, np.zeros(n), terminal, 1.0, LEVER_WEIGHT)
    squares = t.at(t.ceiling, p) - 2.0 * v * BELOW
    rows, upper, lower = speed_rows(
        least - levers, most - levers, response, states, free, squares, t.slope(t.ceiling, p)
    )
    return QPSubproblem(hessian, gradient, rows, upper, lower, levers)


def sampled_system(
    p: FloatArray, v: FloatArray, u: FloatArray, t: Tables, c: LeverTrain
) -> tuple[FloatArray, FloatArray]:
    """Eqs. (9) and (10) about n states and levers: (n, 2, 2) and (n, 2) arrays.

    By the exponential of ``[[A, b], [0, 0]] SAMPLING``.
    """
    system, full = np.zeros((p.size, 3, 3)), full_effort(v, c)
    system[:, 0, 1] = 1.0
    system[:, 1, 0] = -GRAVITY * t.slope(t.sine, p)
    system[:, 1, 1] = -(2.0 * c.drag * v + c.k2 * (full - c.k3) * u) / NOMINAL_MASS
    system[:, 1, 2] = full / NOMINAL_MASS
    found = expm(SAMPLING * system)
    return found[:, :2, :2].copy(), found[:, :2, 2].copy()


class MapController:
    """The product's controller on a reference and its map; a `Controller`.

    It knows neither the mass nor the rotating mass. Where the section's map is `NO_LIMIT` it has
    none, and takes the rail for dry.

    Parameters
    ----------
    reference : Reference
    due : float, optional [s]
        From the departure of the timetable to the arrival; default: that of the reference, which
        may have been put off.
    """

    def __init__(self, reference: Reference, due: float | None = None) -> None:
        section = reference.section
        self._train, self._stop = section.train, section.destination.position
        line, train = smoothed_line(section.line), driven_train(section.driving_train)
        known = section.maximum_adhesion is not NO_LIMIT
        self._driver = Follower(
            trajectory_of(reference, line, train, reference.duration if due is None else due),
            line,
            train,
            condition=map_of(line, section.maximum_adhesion) if known else None,
            layer="wet" if known else "dry",
        )

    @property
    def unsolved(self) -> int:
        """See `Controller`."""
        return self._driver.unsolved

    def lever(self, time: float, position: float, speed: float) -> float:
        """See `Controller`."""
        wanted = self._driver.demand(Observation(time + DEPARTURE, position, speed, 0.0))
        at_stop = speed < HOLDING_SPEED and abs(position - self._stop) < STOPPING_TOLERANCE
        if self._driver.finished or at_stop:
            return 0.0
        effort = wanted.tractive_effort - wanted.braking_effort
        # Between two points the curve of effort lies above the lever's, by up to 0.01 per cent.
        return min(max(effort / float(self._train.full_effort(speed)), -1.0), 1.0)


def driven_train(c: LeverTrain) -> Train:
    """The train with the curve of its lever, and comfort as a limit of its own acceleration."""
    speeds = np.linspace(0.0, TOP_SPEED, 120)
    curve = EffortCurve(speeds, c.full_effort(speeds))
    return replace(
        c.on_axles(), traction_curve=curve, dynamic_braking_curve=curve, acceleration_limits="net"
    )


def trajectory_of(reference: Reference, line: Line, train: Train, due: float) -> Trajectory:
    """A reference for both ends of the mass, stretched to arrive when it is due [s].

    It ends `SOONER` beyond the stop.
    """
    c, fine = reference.section.train, reference.fine
    ahead = np.diff(np.maximum.accumulate(fine[:, 0]), prepend=-np.inf) > 1e-6
    ahead &= fine[:, 0] < reference.positions[-1] - 1e-3
    position, speed, lever = fine[ahead].T
    time = np.linspace(0.0, due, len(fine))[ahead]
    effort, both = lever * c.full_effort(speed), np.ones((2, 1))
    speed[0] = 0.0
    masses = {"light": (c.light, 0.0), "heavy": (c.heavy, train.rotating_mass)}
    return Trajectory(
        line.name,
        train.name,
        np.append(position, reference.positions[-1] + SOONER),
        tuple(
            Configuration(name, mass, rotating, c.resistance(mass), train.max_traction_power)
            for name, (mass, rotating) in masses.items()
        ),
        both * np.append(speed, 0.0),
        both * np.append(time, due),
        np.maximum(effort, 0.0),
        both * np.maximum(-effort, 0.0),
        due,
    )


def map_of(line: Line, rail: StepProfile) -> TrackConditionMap:
    """A map that knows a rail exactly."""
    found = TrackConditionMap(line.name, line.length, BIN_LENGTH, np.array([0.1, 0.2, 0.3]), {})
    none = DailyEvidence.none(found.bins, found.levels.size)
    found.layers["wet"] = ConditionLayer(
        log_mean=np.log(rail(found.centres)),
        log_std=np.full(found.bins, 1e-9),
        observed=np.ones(found.bins, dtype=bool),
        evidence=none,
    )
    return found
