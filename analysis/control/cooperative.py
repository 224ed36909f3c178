"""Cooperative maximum-adhesion MPC of Zhao et al. (2025): all torques from one program.

Each axle is to run at the slip speed at which its rail gives most (eq. 16), within the torque of
each motor and of all of them together (eq. 17). At every sample the motion is linearised along the
prediction from the measured state, and a dense quadratic program is solved by DAQP: sequential
quadratic programming, of which the first step often is enough.

Beyond the peak of a creep curve slip grows by itself, and a plan made for another rail lets the
predicted wheels race: a linearisation about that is of no use. So the search begins from the
better of two plans, the last one shifted and one that only brings each axle to its slip speed, and
a step counts only where the motion itself, not its linearisation, becomes better by it.

The bounds of the slip speeds are soft. Their excess stands in the cost as a piecewise quadratic:
which bounds are exceeded is found by Newton's method (two or three programs in the torques alone),
so that no program has slack variables.

State of a train with n powered axles: its speed and the circumferential speeds of its wheels,
``x = [v, w_1 … w_n]`` [m/s]. ``rail[k, i]`` holds a, b and c of the creep curve under axle i in
step k; ``constants`` are those of `MultiMotorLocomotive.constants`.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, NamedTuple

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from analysis.control.prediction import UNBOUNDED, QPSubproblem, solve
from trainlog.arrays import FloatArray
from trainlog.declaration import POSITIVE_FINITE, NotNegative, Number, PositiveFinite, check
from trainlog.errors import InputError
from trainlog.railway.resistance import RunningResistance

ROUNDS = 8
"""Of Newton's method for the slip speeds that leave their bounds."""

SHORTENINGS = 4
"""How often a step of the torques is halved that makes the predicted motion no better."""

SMALL_SLIP = 4.0
"""A slip speed sought that is less than this many margins is small: its error and its margin count
relative to it."""


@dataclass(frozen=True)
class MultiMotorLocomotive:
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
    mass: PositiveFinite
    axle_loads: tuple[float, ...]
    inertia: PositiveFinite
    gear_ratio: PositiveFinite
    wheel_radius: PositiveFinite
    resistance: RunningResistance
    torque_limit: PositiveFinite
    total_torque: PositiveFinite

    def __post_init__(self) -> None:
        check(self)
        if not self.axle_loads or not all(load > 0.0 for load in self.axle_loads):
            raise InputError(
                f"locomotive '{self.name}': needs driven axles, each with a positive load",
                remedy="give the load of each driven axle in N",
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
        """What the compiled code needs: masses [kg], effort per torque [1/m], resistance."""
        r = self.resistance
        return (self.mass, self.rotating_mass, self.effort_per_torque, *r.parabola)


class Prediction(NamedTuple):
    """How the motion is predicted, for the compiled code.

    Attributes
    ----------
    period : float [s]
        Over which a torque is held.
    substeps : int
        Within it.
    lag : float [s]
        Of the motors; 0: they give at once what is asked.
    direction : float
        1 in traction; -1 in braking, where slip speeds, torques and forces count against the train.
    exact : float
        1: each substep takes the exponential of its linearised slip (below); 0: explicit Euler.
    """

    period: float
    substeps: int
    lag: float
    direction: float
    exact: float


@njit(cache=True)
def creep(slip, curve):  # type: ignore[no-untyped-def]
    """Adhesion coefficient at a slip speed; eq. (10), made odd."""
    a, b, c = curve
    value = c * (np.exp(-a * abs(slip)) - np.exp(-b * abs(slip)))
    return value if slip >= 0.0 else -value


LARGEST_EXPONENT = 2.0
"""Growth of slip within a substep beyond the peak: no substep is that long where it matters."""


@njit(cache=True)
def exponential_weight(z):  # type: ignore[no-untyped-def]
    """``(exp(z) - 1) / z`` and its derivative."""
    if z > LARGEST_EXPONENT:
        return (np.exp(LARGEST_EXPONENT) - 1.0) / LARGEST_EXPONENT, 0.0
    if abs(z) < 1e-2:
        return 1.0 + z * (0.5 + z * (1.0 / 6.0 + z / 24.0)), 0.5 + z * (1.0 / 3.0 + z / 8.0)
    grown = np.exp(z)
    value = (grown - 1.0) / z
    return value, (grown - value) / z


@njit(cache=True)
def predicted(state, begun, plan, rail, loads, constants, how, sensitive):  # type: ignore[no-untyped-def]
    """Slip speeds over the horizon and how they change with the plan's torques.

    Within a substep the slip speed of an axle relaxes to that at which creep bears its torque, with
    the rate that the slope of its creep curve gives (an exponential Rosenbrock step): so a steep
    curve needs no shorter steps, where an explicit step would be unstable.

    Parameters
    ----------
    state : (1 + n,) array [m/s]
    begun : (n,) array [N m]
        Torques at work at the beginning; of no weight without lag.
    plan : (control horizon, n) array [N m]
        Held beyond its end.
    rail : (horizon, n, 3) array
    how : Prediction
    sensitive : bool
        Whether `change` is wanted.

    Returns
    -------
    slip : (horizon * n,) array [m/s]
    change : (horizon * n, control horizon * n) array [m/s per N m]
    """
    mass, rotating, ratio, still, linear, square = constants
    horizon, n = rail.shape[0], loads.size
    moves = plan.shape[0]
    step = how.period / how.substeps
    keep = np.exp(-step / how.lag) if how.lag > 0.0 else 0.0
    size = moves * n if sensitive else 0
    v = state[0]
    s = how.direction * (state[1:] - v)
    torque = begun.copy()
    share = np.zeros(moves)
    grow, of_speed, pull = np.zeros((n, size)), np.zeros(size), np.zeros(size)
    force, slope, bend = np.empty(n), np.empty(n), np.empty(n)
    slip = np.empty(horizon * n)
    change = np.empty((horizon * n if sensitive else 0, size))
    for k in range(horizon):
        j = min(k, moves - 1)
        used = (j + 1) * n if sensitive else 0
        for _ in range(how.substeps):
            total = 0.0
            for i in range(n):
                a, b, c = rail[k, i]
                x = abs(s[i])
                one, other = c * np.exp(-a * x), c * np.exp(-b * x)
                sign = 1.0 if s[i] >= 0.0 else -1.0
                force[i] = sign * loads[i] * (one - other)
                slope[i] = loads[i] * (b * other - a * one)
                bend[i] = sign * loads[i] * (a * a * one - b * b * other)
                total += force[i]
            gain = (total - how.direction * (still + (linear + square * v) * v)) / mass
            drag = how.direction * (linear + 2.0 * square * v) / mass
            at_rest = v <= 0.0 and how.direction * gain < 0.0
            if at_rest:
                gain = drag = 0.0
            for column in range(used):
                pull[column] = -drag * of_speed[column]
            if not at_rest:
                for i in range(n):
                    part = slope[i] / mass
                    for column in range(used):
                        pull[column] += part * grow[i, column]
            for m in range(moves):
                share[m] *= keep
            share[j] += 1.0 - keep
            for i in range(n):
                torque[i] = keep * torque[i] + (1.0 - keep) * plan[j, i]
                rate = (ratio * torque[i] - force[i]) / rotating - gain
                z = -step * slope[i] / rotating * how.exact
                weight, of_z = exponential_weight(z)
                reach = step * weight
                own = 1.0 - reach * slope[i] / rotating
                own -= rate * step * step * of_z * bend[i] / rotating * how.exact
                if how.exact > 0.0 and s[i] * (s[i] + reach * rate) < 0.0:
                    # The slope here is not that where creep turns round: the one there is taken.
                    a, b, c = rail[k, i]
                    stiff = loads[i] * c * (b - a) / rotating
                    own = np.exp(-step * stiff)
                    reach = (1.0 - own) / stiff
                    rate = ratio * torque[i] / rotating - gain - stiff * s[i]
                for column in range(used):
                    grow[i, column] = own * grow[i, column] - reach * pull[column]
                if sensitive:
                    for m in range(j + 1):
                        grow[i, m * n + i] += reach * ratio / rotating * share[m]
                s[i] += reach * rate
            for column in range(used):
                of_speed[column] += step * how.direction * pull[column]
            v = max(v + step * how.direction * gain, 0.0)
        for i in range(n):
            slip[k * n + i] = s[i]
            if sensitive:
                for column in range(size):
                    change[k * n + i, column] = grow[i, column]
    return slip, change


@njit(cache=True)
def tracking_plan(state, begun, reference, rail, loads, constants, how, limits, total, moves):  # type: ignore[no-untyped-def]
    """A plan that brings each axle to its slip speed and keeps it there, (moves, n) [N m].

    Found forwards, torque by torque, with half of the error of slip taken back in a period. Not
    optimal, but sound from any state: also where the plan of another rail would let wheels race.
    """
    mass, rotating, ratio, still, linear, square = constants
    n = loads.size
    plan = np.zeros((moves, n))
    now, at_work = state.copy(), begun.copy()
    one = np.empty((1, n))
    keep = np.exp(-how.period / how.lag) if how.lag > 0.0 else 0.0
    for j in range(moves):
        v = now[0]
        pull = 0.0
        for i in range(n):
            pull += loads[i] * creep(how.direction * (now[1 + i] - v), rail[j, i])
        gain = (pull - how.direction * (still + (linear + square * v) * v)) / mass
        if v <= 0.0 and how.direction * gain < 0.0:
            gain = 0.0
        total_given = 0.0
        for i in range(n):
            s = how.direction * (now[1 + i] - v)
            aim = 0.5 * (s + reference[j * n + i])
            bearing = loads[i] * creep(aim, rail[j, i])
            wanted = bearing + rotating * ((aim - s) / how.period + gain)
            one[0, i] = min(max(wanted / ratio, 0.0), limits[i])
            total_given += one[0, i]
        scale = min(total / total_given, 1.0) if total_given > 0.0 else 1.0
        for i in range(n):
            plan[j, i] = one[0, i] = scale * one[0, i]
        slip, _ = predicted(now, at_work, one, rail[j : j + 1], loads, constants, how, False)
        v = max(v + how.period * how.direction * gain, 0.0)
        now[0] = v
        for i in range(n):
            now[1 + i] = v + how.direction * slip[i]
            at_work[i] = keep * at_work[i] + (1.0 - keep) * one[0, i]
    return plan


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
        Of the prediction within a period.
    exact : bool
        Whether a substep takes the exponential of its linearised slip. The paper takes one
        explicit Euler step, which is unstable for axles that are light for their load: below the
        peak creep pulls a wheel to the train's speed within milliseconds.
    iterations : int
        Of the quadratic programming in a sample, at most.
    tolerance : float
        Change of a torque, over the torque limit, below which there is no further iteration.
    lag : float [s]
        Of the motors' torques behind their demand.
    slip : float [s²/m²]
        Q is this times the unit matrix.
    torque : float
        R likewise, on torques over the torque limit.
    margin : float [m/s]
        Epsilon: how far the slip speed may stray from its reference; less where that is small
        (`slip_weights`).
    slack : float
        Weight, over that of the slip, of the squared excess over these bounds, which must be soft:
        a rail that has just become wet, or a motor that fails, makes them impossible. Heavier ones
        take the other axles off their peak for the sake of one that cannot reach its own.
    """

    horizon: Annotated[int, Number(must=POSITIVE_FINITE)] = 10
    control_horizon: Annotated[int, Number(must=POSITIVE_FINITE)] = 5
    period: PositiveFinite = 0.1
    substeps: Annotated[int, Number(must=POSITIVE_FINITE)] = 4
    exact: bool = True
    iterations: Annotated[int, Number(must=POSITIVE_FINITE)] = 4
    tolerance: PositiveFinite = 5e-4
    lag: NotNegative = 0.0
    slip: PositiveFinite = 1.0
    torque: PositiveFinite = 1e-4
    margin: PositiveFinite = 0.2
    slack: PositiveFinite = 5.0

    def __post_init__(self) -> None:
        check(self)
        if self.control_horizon > self.horizon:
            raise InputError(
                f"cooperative control: {self.control_horizon} steps of control are more than the"
                f" {self.horizon} that are predicted",
                remedy="control over fewer steps, or predict more",
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
    direction : float
        1 in traction, -1 in braking: torques and slip speeds are then counted against the train.
    at_work : (n,) array [N m], optional
        Torques that the motors give now, where they lag behind what is asked.
    held_back : float [N]
        Force against the train besides its running resistance: gradient, friction brakes.
    """

    rail: FloatArray
    reference: FloatArray
    limits: FloatArray
    total: float
    direction: float = 1.0
    at_work: FloatArray | None = None
    held_back: float = 0.0


def peak_slips(rail: FloatArray) -> FloatArray:
    """Slip speeds of maximum adhesion [m/s] of (..., 3) creep curves."""
    a, b = rail[..., 0], rail[..., 1]
    return np.asarray(np.log(b / a) / (b - a))


def adhesion_at(slip: FloatArray, rail: FloatArray) -> FloatArray:
    """Adhesion at slip speeds [m/s] on creep curves that broadcast with them; eq. (10), odd."""
    a, b, c = np.moveaxis(rail, -1, 0)
    size = np.abs(slip)
    return np.asarray(np.sign(slip) * c * (np.exp(-a * size) - np.exp(-b * size)))


def slip_weights(reference: FloatArray, tuning: Tuning) -> tuple[FloatArray, FloatArray]:
    """Weight of each error of slip speed [s²/m²] and its margin [m/s].

    Q and epsilon of eqs. (16) and (17) for slip speeds from `SMALL_SLIP` margins on; the error of a
    smaller one counts relative to it: on a steep creep curve the margin would reach from no force
    to racing wheels.
    """
    small = np.minimum(np.abs(reference) / (SMALL_SLIP * tuning.margin), 1.0)
    small = np.maximum(small, 1e-3)
    return np.asarray(tuning.slip / small**2), np.asarray(tuning.margin * small)


@dataclass(frozen=True, eq=False)
class Task:
    """The problem of one sample.

    State and demand; and for each slip speed of the horizon what is sought, weight and margin.
    """

    state: FloatArray
    demand: Demand
    reference: FloatArray
    weights: FloatArray
    margins: FloatArray
    at_work: FloatArray
    how: Prediction
    constants: tuple[float, float, float, float, float, float]


@njit(cache=True)
def normal_equations(rows, weights, error):  # type: ignore[no-untyped-def]
    """``rows' W rows`` and ``rows' W error``; no threads, which wait longer than they compute."""
    count, size = rows.shape
    square, right = np.zeros((size, size)), np.zeros(size)
    for k in range(count):
        for i in range(size):
            weighted = weights[k] * rows[k, i]
            if weighted == 0.0:
                continue
            right[i] += weighted * error[k]
            for j in range(size):
                square[i, j] += weighted * rows[k, j]
    return square, right


@njit(cache=True)
def tracking_cost(error, weights, margins, levels, torque, slack):  # type: ignore[no-untyped-def]
    """Cost of errors of slip [m/s] and of levels, eq. (16), with the excess over the margins."""
    found = 0.0
    for k in range(error.size):
        beyond = max(abs(error[k]) - margins[k], 0.0)
        found += weights[k] * error[k] * error[k]
        found += slack * beyond * beyond * weights[k]
    for each in levels:
        found += torque * each * each
    return found


@dataclass
class CooperativeController:
    """Gives the torques of all motors, sample by sample.

    Attributes
    ----------
    locomotive : MultiMotorLocomotive
    tuning : Tuning
    steps : int
        Samples so far.
    unsolved : int
        Samples at which no program was solved: the torques are then those of the better of two
        plans, the shifted one and the one that brings each axle to its slip speed.
    """

    locomotive: MultiMotorLocomotive
    tuning: Tuning = field(default_factory=Tuning)
    steps: int = 0
    unsolved: int = 0

    def __post_init__(self) -> None:
        self._plan = np.zeros((self.tuning.control_horizon, self.locomotive.axles))
        self._loads, self._constants = self.locomotive.loads, self.locomotive.constants
        self._excess = np.zeros(self.tuning.horizon * self.locomotive.axles, dtype=np.int64)
        moves, n = self._plan.shape
        self._sums = np.asarray(np.kron(np.eye(moves), np.ones((1, n))), dtype=np.float64)

    def torques(self, speed: float, wheel_speeds: ArrayLike, demand: Demand) -> FloatArray:
        """Torques of the motors until the next sample.

        Parameters
        ----------
        speed : float [m/s]
            Of the train.
        wheel_speeds : (n,) array [m/s]
            Circumferential.
        demand : Demand

        Returns
        -------
        (n,) array [N m]
            Never beyond the limits of a motor or of all together.

        Raises
        ------
        InputError
            If speeds are not numbers, or not one for each axle.
        """
        state = self._state(speed, wheel_speeds)
        task = self._task(state, demand)
        plan, cost = self._start(task, self.guess(demand))
        solved = np.isfinite(cost)
        for _ in range(self.tuning.iterations):
            step = self._step(task, plan)
            if step is None:
                solved = False
                break
            plan, cost, moved = self._shortened(task, plan, cost, step)
            if moved < self.tuning.tolerance:
                break
        if not np.isfinite(cost):
            plan, solved = np.zeros_like(plan), False
        self._plan = plan.copy()
        self.steps += 1
        self.unsolved += not solved
        return np.asarray(plan[0].copy())

    def restart(self) -> None:
        """Forget the plan, as when traction turns to braking; the counts stay."""
        self._plan[:] = 0.0
        self._excess[:] = 0

    def guess(self, demand: Demand) -> FloatArray:
        """The plan of the last sample, shifted, and made to keep the limits."""
        return within(np.concatenate([self._plan[1:], self._plan[-1:]]), demand)

    # ---- within a sample --------------------------------------------------------------------

    def _task(self, state: FloatArray, demand: Demand) -> Task:
        reference = np.ascontiguousarray(demand.reference).ravel()
        weights, margins = slip_weights(reference, self.tuning)
        at_work = np.zeros(demand.limits.size) if demand.at_work is None else demand.at_work
        how = Prediction(
            float(self.tuning.period), int(self.tuning.substeps), float(self.tuning.lag),
            float(demand.direction), float(self.tuning.exact),
        )  # fmt: skip
        mass, rotating, ratio, still, linear, square = self._constants
        constants = (mass, rotating, ratio, still + float(demand.held_back), linear, square)
        return Task(state, demand, reference, weights, margins, at_work, how, constants)

    def _start(self, task: Task, shifted: FloatArray) -> tuple[FloatArray, float]:
        """The better of the shifted plan and the one that brings each axle to its slip speed."""
        cost = self._cost(task, shifted)
        tracking = within(
            tracking_plan(
                task.state, task.at_work, task.reference, task.demand.rail, self._loads,
                task.constants, task.how, task.demand.limits, task.demand.total, len(shifted),
            ),
            task.demand,
        )  # fmt: skip
        other = self._cost(task, tracking)
        return (shifted, cost) if cost <= other else (tracking, other)

    def _errors(
        self, task: Task, plan: FloatArray, sensitive: bool = False
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Errors of slip under a plan [m/s], how they change with its levels, and these."""
        scale = self.locomotive.torque_limit
        slip, change = predicted(
            task.state, task.at_work, plan, task.demand.rail, self._loads, task.constants,
            task.how, sensitive,
        )  # fmt: skip
        return slip - task.reference, scale * change, plan.ravel() / scale

    def _cost(self, task: Task, plan: FloatArray) -> float:
        """Of a plan by the motion itself, eq. (16); infinite where that leaves the numbers."""
        error, _, levels = self._errors(task, plan)
        weights, tuning = (task.weights, task.margins), self.tuning
        found = float(tracking_cost(error, *weights, levels, tuning.torque, tuning.slack))
        return found if np.isfinite(found) else np.inf

    def _step(self, task: Task, plan: FloatArray) -> FloatArray | None:
        """Change of the plan's torques over the torque limit; None: no program was solved."""
        tuning, demand, limit = self.tuning, task.demand, self.locomotive.torque_limit
        error, change, levels = self._errors(task, plan, sensitive=True)
        hessian, gradient = normal_equations(change, 2.0 * task.weights, error)
        hessian[np.diag_indices_from(hessian)] += 2.0 * tuning.torque
        gradient += 2.0 * tuning.torque * levels
        if not np.all(np.isfinite(hessian)):
            return None
        caps, remaining = np.tile(demand.limits / limit, len(plan)), demand.total / limit
        upper = np.concatenate([caps - levels, remaining - self._sums @ levels])
        lower = np.concatenate([-levels, np.full(len(plan), -UNBOUNDED)])
        outside = self._excess
        for _ in range(ROUNDS):
            beyond = np.flatnonzero(outside)
            more = normal_equations(
                change[beyond],
                2.0 * tuning.slack * task.weights[beyond],
                error[beyond] - outside[beyond] * task.margins[beyond],
            )
            step, status = solve(
                QPSubproblem(
                    hessian + more[0], gradient + more[1], self._sums, upper, lower, plan,
                    soft=False,
                )
            )  # fmt: skip
            if status <= 0 or not np.all(np.isfinite(step)):
                return None
            found = error + change @ step
            known = outside
            # 1 above the margin, -1 below, 0 within.
            outside = (found > task.margins).astype(np.int64) - (found < -task.margins)
            if np.array_equal(outside, known):
                break
        self._excess = outside
        return step

    def _shortened(
        self, task: Task, plan: FloatArray, cost: float, step: FloatArray
    ) -> tuple[FloatArray, float, float]:
        """A plan, its cost, and how far its first torques moved, after the step or a part of it."""
        whole = self.locomotive.torque_limit * step.reshape(plan.shape)
        best, least, length = plan, cost, 1.0
        for _ in range(SHORTENINGS):
            # The solver keeps its bounds within a tolerance, a motor does not.
            tried = within(plan + length * whole, task.demand)
            found = self._cost(task, tried)
            if found < least:
                best, least = tried, found
                # Where much is left of the errors the step is short: the curvature of the creep
                # curves, which it leaves out, then counts.
                if length < 1.0:
                    break
                length *= 2.0
            elif length > 1.0:
                break
            else:
                length *= 0.5
        moved = np.abs(best[0] - plan[0]).max() / self.locomotive.torque_limit
        return best, least, float(moved)

    def _state(self, speed: float, wheel_speeds: ArrayLike) -> FloatArray:
        state = np.append(speed, np.asarray(wheel_speeds, dtype=np.float64))
        if state.size != 1 + self.locomotive.axles or not np.all(np.isfinite(state)):
            raise InputError(
                f"cooperative control: train speed {state[0]} and wheel speeds {state[1:]} are not"
                f" all numbers, one per axle of {self.locomotive.axles}",
                remedy="give one wheel speed per axle, and replace values that are missing",
            )
        return state


def within(plan: FloatArray, demand: Demand) -> FloatArray:
    """Torques next to a plan that keep the limits: capped, then scaled down to the total."""
    capped = np.clip(plan, 0.0, demand.limits)
    sums = np.maximum(capped.sum(axis=1, keepdims=True), 1e-300)
    return np.asarray(capped * np.minimum(demand.total / sums, 1.0))
