"""Traction controls that drive the simulated train: cooperative on a map, and plain re-adhesion.

Both are a `trainlog.simulation.TractionControl`: they see what the drive of a train measures, and
give each powered axle its effort, in traction and in dynamic braking. `CooperativeTraction` is the
controller of Zhao et al. (2025) with the rail of a track-condition map ahead, corrected by what the
wheels show; `ReadhesionControl` knows no map and no peak and takes effort off a wheel that begins
to slip (after Kadowaki et al., 2007). Without either the plant's own slip protection works.

Zhao et al. (2025) take the rail for known. `RailEstimator` learns it from slip speeds and adhesion
in use: a hidden Markov model of the creep curve, of its maximum and of how its slip speeds are
stretched against those of `trainlog.railway.adhesion.creep_coefficients`. A map gives the maximum
that is likely before a wheel is there (`map_prior`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import Literal, get_args

import numpy as np
from numba import njit
from numpy.typing import ArrayLike

from analysis.control.cooperative import (
    CooperativeController,
    Demand,
    MultiMotorLocomotive,
    Tuning,
    adhesion_at,
    peak_slips,
)
from estimators.adhesion import AdhesionObserver
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway import Line, TrackConditionMap, Train
from trainlog.railway.adhesion import creep_coefficients
from trainlog.simulation import Drive, DriveReading, DriveSensors, Scenario, TractionControl
from trainlog.simulation.scenario import LARGEST_LOAD
from trainlog.simulation.sensors import weighed_load

MAXIMA = np.geomspace(0.03, 0.45, 48)
"""Maximum adhesion that is thought of."""

STRETCHES = 2.0 ** np.arange(-5.0, 1.01, 0.375)
"""Slip speeds of a rail over those of its like of the same maximum: measured curves peak at a tenth
of the slip speeds of the paper's, and before."""

STRETCH_STD = 1.0
"""Of the logarithm of the stretch, before anything is measured."""

SLIPS = np.geomspace(0.05, 8.0, 80)
"""Slip speeds of which one is sought [m/s]."""

MAP_SPREAD = 0.15
"""Of the logarithm of the maximum on one trip about the map's: passing spots, other wheels."""

OTHER_RAIL = 0.2
"""Probability that the rail is not as the map has it: any maximum is then as likely."""

GRID_STEP = float(np.log(MAXIMA[1] / MAXIMA[0]))

WANDERING = 0.01, 0.005
"""How far the logarithm of the maximum wanders: by way [1/m^0.5], and by time [1/s^0.5]. A rail
differs from place to place, and hardly while a train creeps over it: an estimate that wanders by
time alone follows the slip speed down at a slow start, ever further below the peak."""

ADHESION_RATE = 0.5
"""How fast adhesion in use may wander, for the observer [1/s^0.5]: a wheel meets a wet rail at
once."""

CHANGES = 0.04, 0.05
"""How often the rail is expected to become another one altogether: by way [1/m], by time [1/s]."""

MODEL_STD = 0.005, 0.05
"""Of what a creep curve gives: absolute, and relative to adhesion."""

FARTHEST = 300.0
"""Curves so many times e less likely than the likeliest have no probability."""

UNLIKELY = 1e-6
"""Curves of less probability do not count for the slip speed that is sought."""


@dataclass(frozen=True)
class RailEstimate:
    """What is known of the rail under each axle.

    Attributes
    ----------
    maximum : (n,) array
        Maximum adhesion, median.
    reference : (n,) array [m/s]
        Slip speed at which most adhesion is expected, whatever the rail may be.
    rail : (n, 3) array
        Mean creep curves, for the prediction.
    """

    maximum: FloatArray
    reference: FloatArray
    rail: FloatArray


class RailEstimator:
    """Creep curve under each axle, learnt sample by sample.

    The force between wheel and rail comes from `estimators.adhesion.AdhesionObserver`. What it
    says together with the slip speed is compared with many creep curves; on its way the rail
    wanders a little, and at times becomes any other. Far below the peak the maximum is known
    by little but the rise of the curves.

    The reference is where most adhesion is expected over all curves that are still possible, not
    the peak of the likeliest one: beyond the peak of a rail that is unlike its maximum suggests,
    both a rail that gives little and a steep one explain what is seen, and only less slip decides.

    Parameters
    ----------
    locomotive : MultiMotorLocomotive
    tuning : Tuning
    speed_std, wheel_speed_std : float [m/s]
        Noise of the train speed and of the wheel speeds.
    """

    def __init__(
        self,
        locomotive: MultiMotorLocomotive,
        tuning: Tuning,
        speed_std: float,
        wheel_speed_std: float,
    ) -> None:
        self._locomotive, self._period = locomotive, tuning.period
        load = float(locomotive.loads.mean())
        self._observer = AdhesionObserver(
            locomotive.axles, locomotive.rotating_mass, wheel_speed_std, ADHESION_RATE * load
        )
        # Slip is the mean of two samples, so its noise is that of one over the root of two.
        self._slip_variance = 0.5 * (speed_std**2 + wheel_speed_std**2)
        curves = np.repeat(creep_coefficients(MAXIMA)[:, None], STRETCHES.size, axis=1)
        curves[..., :2] /= STRETCHES[:, None]
        self._curves = curves.reshape(-1, 3)
        self._expected = adhesion_at(SLIPS, self._curves[:, None])
        likely = np.exp(-0.5 * (np.log(STRETCHES) / STRETCH_STD) ** 2)
        self._stretches = likely / likely.sum()
        self._prior = self._joint(np.full((locomotive.axles, MAXIMA.size), 1.0 / MAXIMA.size))
        self._probability = self._prior.copy()
        self._slip: FloatArray | None = None
        self._mapped: FloatArray | None = None
        self._time = 0.0

    def _joint(self, maxima: FloatArray) -> FloatArray:
        """Probability of maximum and stretch from that of the maximum, (n, maxima, stretches)."""
        return np.ascontiguousarray(maxima[:, :, None] * self._stretches)

    def expect(self, log_mean: ArrayLike, log_std: ArrayLike) -> None:
        """Take over what a map makes likely where the axles are now.

        What was learnt is kept relative to the map: where its maximum rises, that of the rail is
        expected to rise.

        Parameters
        ----------
        log_mean, log_std : (n,) arrays
            Of the logarithm of the maximum adhesion.
        """
        mean = np.asarray(log_mean, dtype=np.float64)
        if self._mapped is None:
            self._probability = self._joint(map_prior(mean, log_std))
        else:
            moved = (mean - self._mapped) / GRID_STEP
            if np.any(moved):
                shift_maxima(self._probability, moved)
        if self._mapped is None or np.any(mean != self._mapped):
            self._prior = self._joint(map_prior(mean, log_std))
        self._mapped = mean.copy()

    def forget(self) -> None:
        """Begin anew from the map, as after coasting, when nothing is learnt of the rail."""
        self._observer.reset()
        self._probability = self._prior.copy()
        self._slip, self._time = None, 0.0

    def update(
        self,
        speed: float,
        wheel_speeds: ArrayLike,
        torques: ArrayLike,
        direction: float = 1.0,
    ) -> RailEstimate:
        """Take a sample in.

        Parameters
        ----------
        speed : float [m/s]
            Of the train.
        wheel_speeds : (n,) array [m/s]
        torques : (n,) array [N m]
            At work now, changing evenly since the last sample; positive also in braking.
        direction : float
            -1 in braking.

        Raises
        ------
        InputError
            If shapes do not fit.
        """
        wheels = np.asarray(wheel_speeds, dtype=np.float64)
        effort = direction * self._locomotive.effort_per_torque * np.asarray(torques, dtype=float)
        slip, last = direction * (wheels - speed), self._slip
        force = self._observer.update(self._time, wheels, effort)
        adhesion = direction * force.force[-1] / self._locomotive.loads
        if last is not None:
            noise = force.std[-1] / self._locomotive.loads
            bayes_update(
                self._probability, self._prior, self._moves(speed), self._curves,
                0.5 * (slip + last), adhesion, noise, self._slip_variance,
            )  # fmt: skip
        self._slip, self._time = slip, self._time + self._period
        return self.estimate()

    def _moves(self, speed: float) -> tuple[float, float]:
        """Probabilities that the maximum is the next one of the grid, and that it is any other."""
        way = abs(float(speed)) * self._period
        variance = WANDERING[0] ** 2 * way + WANDERING[1] ** 2 * self._period
        changed = CHANGES[0] * way + CHANGES[1] * self._period
        return min(0.5 * variance / GRID_STEP**2, 0.25), min(changed, 0.5)

    def estimate(self) -> RailEstimate:
        """What is known now."""
        summed = np.cumsum(self._probability.sum(axis=2), axis=1)
        middle = MAXIMA[np.minimum((summed < 0.5).sum(axis=1), MAXIMA.size - 1)]
        flat = self._probability.reshape(self._locomotive.axles, -1)
        reference = SLIPS[highest_mean(flat, self._expected)]
        # The likeliest curve jumps from sample to sample, and the torques with it.
        rail = creep_coefficients(np.exp(self._probability.sum(axis=2) @ np.log(MAXIMA)))
        rail[:, :2] /= np.exp(self._probability.sum(axis=1) @ np.log(STRETCHES))[:, None]
        return RailEstimate(middle, reference, rail)


def map_prior(log_mean: ArrayLike, log_std: ArrayLike) -> FloatArray:
    """Probability of each of `MAXIMA` where a map gives the maximum adhesion, (n, maxima).

    Parameters
    ----------
    log_mean, log_std : (n,) arrays
        Of its logarithm.

    Raises
    ------
    InputError
        If a mean is no number, or a deviation is negative.

    Examples
    --------
    >>> likely = map_prior([np.log(0.15)], [0.1])
    >>> bool(abs(MAXIMA[likely[0].argmax()] - 0.15) < 0.005), round(float(likely.sum()), 6)
    (True, 1.0)
    """
    mean = np.atleast_1d(np.asarray(log_mean, dtype=np.float64))
    std = np.atleast_1d(np.asarray(log_std, dtype=np.float64))
    if not (np.all(np.isfinite(mean)) and np.all(std >= 0.0)):
        raise InputError(
            "rail estimator: the map gives no number for a maximum adhesion",
            remedy="update the map with trips on this line",
        )
    spread = np.hypot(np.where(np.isfinite(std), std, 10.0), MAP_SPREAD)[:, None]
    found = np.exp(-0.5 * ((np.log(MAXIMA) - mean[:, None]) / spread) ** 2) + 1e-300
    found /= found.sum(axis=1, keepdims=True)
    return np.asarray((1.0 - OTHER_RAIL) * found + OTHER_RAIL / MAXIMA.size)


@njit(cache=True)
def shift_maxima(probability, moved):  # type: ignore[no-untyped-def]
    """Move the probability of each axle along the maxima by so many steps of their grid."""
    axles, size, stretches = probability.shape
    before = np.empty(size)
    for i in range(axles):
        if moved[i] == 0.0:
            continue
        for k in range(stretches):
            for m in range(size):
                before[m] = probability[i, m, k]
                probability[i, m, k] = 0.0
            for m in range(size):
                to = min(max(m + moved[i], 0.0), size - 1.0)
                low = int(to)
                part = to - low
                probability[i, low, k] += (1.0 - part) * before[m]
                probability[i, min(low + 1, size - 1), k] += part * before[m]


@njit(cache=True)
def bayes_update(probability, prior, moves, curves, slip, adhesion, noise, slip_variance):  # type: ignore[no-untyped-def]
    """Bayes' rule on the grid, in place: the rail's diffusion, then the measurement's likelihood.

    Parameters
    ----------
    probability, prior : (n, maxima, stretches) arrays
    moves : tuple of float
        Probabilities that the maximum is each neighbouring one, and that it is any other.
    curves : (maxima * stretches, 3) array
    slip, adhesion, noise : (n,) arrays
        Slip speed [m/s], adhesion in use and its standard deviation.
    slip_variance : float [m²/s²]
    """
    axles, size, stretches = probability.shape
    absolute, relative = MODEL_STD
    near, change = moves
    missed, spread = np.empty((size, stretches)), np.empty((size, stretches))
    for i in range(axles):
        x = abs(slip[i])
        sign = 1.0 if slip[i] >= 0.0 else -1.0
        least = np.inf
        for m in range(size):
            for k in range(stretches):
                a, b, c = curves[m * stretches + k]
                one, other = c * np.exp(-a * x), c * np.exp(-b * x)
                expected, slope = sign * (one - other), b * other - a * one
                variance = (
                    noise[i] ** 2 + absolute**2 + (relative * expected) ** 2
                    + slope * slope * slip_variance
                )  # fmt: skip
                error = adhesion[i] - expected
                missed[m, k], spread[m, k] = 0.5 * error * error / variance, np.sqrt(variance)
                least = min(least, missed[m, k])
        total = 0.0
        for k in range(stretches):
            before = probability[i, 0, k]
            for m in range(size):
                here, after = probability[i, m, k], probability[i, min(m + 1, size - 1), k]
                mixed = (1.0 - 2.0 * near) * here + near * (before + after)
                mixed = (1.0 - change) * mixed + change * prior[i, m, k]
                before = here
                beyond = missed[m, k] - least
                likely = np.exp(-beyond) / spread[m, k] if beyond < FARTHEST else 0.0
                probability[i, m, k] = mixed * likely
                total += probability[i, m, k]
        for m in range(size):
            for k in range(stretches):
                probability[i, m, k] /= total


@njit(cache=True)
def highest_mean(probability, curves):  # type: ignore[no-untyped-def]
    """Where the mean of many curves under the probability of each is highest, (n,) indices.

    Most have none; and the product of the matrices would be given to threads, which on a machine
    with other work wait longer than they compute.
    """
    axles, count = probability.shape
    found = np.empty(axles, dtype=np.int64)
    mean = np.empty(curves.shape[1])
    for i in range(axles):
        mean[:] = 0.0
        for k in range(count):
            p = probability[i, k]
            if p > UNLIKELY:
                for j in range(mean.size):
                    mean[j] += p * curves[k, j]
        found[i] = np.argmax(mean)
    return found


# ---------------------------------------------------------------------------------------- controls

TractionName = Literal["cooperative", "readhesion"]

TUNING = Tuning(period=0.05, lag=Drive().motor_lag)
"""Of the cooperative control: motors that lag, and a period in which no wheel races."""

LEAST_SLIP = 0.05
"""Slip speed [m/s] that is sought at least: less is lost in the noise of the wheel speeds."""

EVEN_UTILISATION = 0.8
"""Of what the rail under an axle bears, up to which a demand is shared evenly."""


def drive_model(train: Train, mass: float) -> MultiMotorLocomotive:
    """The train as the cooperative control knows it, its torques those at the axles.

    Parameters
    ----------
    train : Train
    mass : float [kg]
        Loaded, without the rotating part.
    """
    axles = train.axles
    n, radius = axles.count, axles.wheel_radius
    motor = max(train.max_tractive_effort, train.max_dynamic_braking_effort) / n
    return MultiMotorLocomotive(
        name=train.name,
        mass=mass + train.rotating_mass - n * axles.rotating_mass,
        axle_loads=(train.adhesive_weight(mass - train.mass) / n,) * n,
        inertia=axles.rotating_mass * radius**2,
        gear_ratio=1.0,
        wheel_radius=radius,
        resistance=train.resistance,
        torque_limit=motor * radius,
        total_torque=n * motor * radius,
    )


class CooperativeTraction:
    """Cooperative maximum-adhesion control of a train on a line; Zhao et al. (2025).

    The creep curve under each axle comes from the map, and from what slip speeds and efforts show
    (`RailEstimator`): the map gives what is likely, the wheels show what is so. Ahead the rail is
    as far from the map as it is here.

    Parameters
    ----------
    train : Train
    line : Line
        In the direction of travel.
    condition : TrackConditionMap, optional
        None: the rail is learnt only.
    layer : str
        Rail condition to read from the map.
    direction : {"forward", "reverse"}
        Of travel against the map's chainage.
    mass : float [kg], optional
        As weighed, without the rotating part; default: the empty train.

    Attributes
    ----------
    controller : CooperativeController
        Counts decisions that are not solved (`unsolved`).

    Raises
    ------
    InputError
        If the map is of another line or has no such layer.

    Examples
    --------
    >>> from trainlog.simulation.traction import DriveReading
    >>> import numpy as np
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> control = CooperativeTraction(train, line, condition=track, layer="wet")
    >>> reading = DriveReading(0.0, 500.0, 10.0, np.full(4, 10.2), np.full(4, 10e3), 60e3, 0.0)
    >>> efforts = control.efforts(reading)
    >>> efforts.shape, bool(efforts.sum() <= 60e3), control.unsolved
    ((4,), True, 0)
    """

    name, period = "cooperative", TUNING.period

    def __init__(
        self,
        train: Train,
        line: Line,
        *,
        condition: TrackConditionMap | None = None,
        layer: str = "wet",
        direction: str = "forward",
        mass: float | None = None,
    ) -> None:
        if condition is not None:
            condition.check_line(line.name, line.length, what="cooperative control")
        self._train, self._line = train, line
        self._map, self._reverse = condition, direction == "reverse"
        self._mass = train.mass if mass is None else mass
        self._model = drive_model(train, self._mass)
        seen = DriveSensors()
        self.controller = CooperativeController(self._model, TUNING)
        # Wheels that differ in diameter differ in speed at 20 m/s as if by noise.
        wheel = float(np.hypot(seen.wheel_speed_noise, 20.0 * seen.diameter_error))
        self._estimator = RailEstimator(self._model, TUNING, seen.speed_noise, wheel)
        if condition is not None:
            # Once for the whole line: a decision has a millisecond.
            self._mean, low = (
                np.log(condition.lower_bound(layer, condition.centres, sigmas, likely=True))
                for sigmas in (0.0, 1.0)
            )
            self._std = self._mean - low
        self._ahead = TUNING.period * (np.arange(TUNING.horizon) + 0.5)
        self._direction = 0.0

    @property
    def unsolved(self) -> int:
        """Decisions so far at which no program was solved."""
        return self.controller.unsolved

    def efforts(self, reading: DriveReading) -> FloatArray:
        """Efforts of the axles until the next decision, (n,) [N], negative in braking."""
        braking = reading.braking_effort > 0.0
        wanted = reading.braking_effort if braking else reading.tractive_effort
        if not wanted > 0.0:
            self._direction = 0.0
            return np.zeros(self._train.axles.count)
        direction = -1.0 if braking else 1.0
        here, ahead = self._mapped(reading)
        if direction != self._direction:
            self._direction = direction
            self._estimator.forget()
            self.controller.restart()
        if here is not None:
            self._estimator.expect(*here)
        torques = np.maximum(direction * reading.efforts, 0.0) * self._model.wheel_radius
        found = self._estimator.update(reading.speed, reading.wheel_speeds, torques, direction)
        rail, reference = self._rail(found, here, ahead)
        train, n, radius = self._train, self._train.axles.count, self._model.wheel_radius
        of = train.dynamic_braking_effort_limit if braking else train.tractive_effort_limit
        limits, total = np.full(n, float(of(reading.speed)) / n * radius), wanted * radius
        # Of the mean curve, as the median of the maximum is one of few.
        maximum = adhesion_at(peak_slips(found.rail), found.rail)
        bearing = maximum * self._model.loads * self._model.wheel_radius
        limits = shared_limits(bearing, limits, total)
        demand = Demand(
            rail, reference, limits, total, direction, torques, self._held_back(reading)
        )
        given = self.controller.torques(reading.speed, reading.wheel_speeds, demand)
        return direction * given / self._model.wheel_radius

    def _mapped(
        self, reading: DriveReading
    ) -> tuple[tuple[FloatArray, FloatArray] | None, FloatArray | None]:
        """Mean and deviation of the log maximum under each axle now; ahead the mean."""
        if self._map is None:
            return None, None
        way = reading.position + reading.speed * np.append(0.0, self._ahead)
        way = np.clip(way, 0.0, self._line.length)
        own = self._line.length - way if self._reverse else way
        # The rail under the front counts for all axles.
        bins = np.repeat(self._map.bin_of(own)[:, None], self._train.axles.count, axis=1)
        mean = self._mean[bins]
        return (mean[0], self._std[bins[0]]), mean[1:]

    def _rail(
        self,
        found: RailEstimate,
        here: tuple[FloatArray, FloatArray] | None,
        ahead: FloatArray | None,
    ) -> tuple[FloatArray, FloatArray]:
        """Creep curves and slip speeds to be sought, over the horizon."""
        horizon = TUNING.horizon
        reference = np.maximum(found.reference, LEAST_SLIP)
        rail = np.tile(found.rail, (horizon, 1, 1))
        slips = np.tile(reference, (horizon, 1))
        if here is None or ahead is None or not np.any(ahead != here[0]):
            return rail, slips
        maxima = np.clip(found.maximum * np.exp(ahead - here[0]), 0.02, 0.9)
        now = creep_coefficients(np.clip(found.maximum, 0.02, 0.9))
        then = creep_coefficients(maxima)
        # As much steeper as the rail here is than a rail of its maximum.
        rail *= then / now
        slips *= peak_slips(then) / peak_slips(now)
        return rail, slips

    def _held_back(self, reading: DriveReading) -> float:
        """Force against the train besides running resistance and motors [N]."""
        place = min(reading.position, self._line.length)
        track = float(self._train.track_force(self._line, place, self._mass))
        motors = max(-float(reading.efforts.sum()), 0.0)
        return track + max(reading.braking_effort - motors, 0.0)


def shared_limits(bearing: FloatArray, limits: FloatArray, total: float) -> FloatArray:
    """The most of each motor so that the motors together give the total and share it evenly.

    An even share, but of no rail more than `EVEN_UTILISATION` of what it bears, as long as the
    others can give the rest; then the same share of what each rail bears. Where a motor cannot,
    the others do. Tracking the slip speeds of the peaks alone does not share a total that is less
    than the rail gives: slip grows ever faster with effort, so some axles at their peak and the
    others without effort are nearer to their slip speeds than all of them halfway.

    Parameters
    ----------
    bearing : (n,) array
        The most that the rail bears; positive.
    limits : (n,) array
        Of the motors.
    total : float
        What is demanded of all, in the same unit.

    Returns
    -------
    (n,) array
        With the total as its sum; `limits` where the motors give no more than the total.

    Examples
    --------
    >>> import numpy as np
    >>> bearing, limits = np.array([40.0, 40.0, 20.0, 20.0]), np.full(4, 35.0)
    >>> shared_limits(bearing, limits, 60.0).tolist()
    [15.0, 15.0, 15.0, 15.0]
    >>> shared_limits(bearing, limits, 80.0).tolist()
    [24.0, 24.0, 16.0, 16.0]
    >>> shared_limits(bearing, limits, 110.0).tolist()
    [35.0, 35.0, 20.0, 20.0]
    """
    if total >= limits.sum():
        return limits
    proportional = _filled(bearing, limits, total)
    most = np.maximum(proportional, np.minimum(EVEN_UTILISATION * bearing, limits))
    return _filled(np.ones(limits.size), most, total)


def _filled(weights: FloatArray, limits: FloatArray, total: float) -> FloatArray:
    """A total shared in proportion to weights, but within limits, which give no less in all."""
    # First held back is the one with the least limit for its weight. The sum is concave in the
    # share: with fewer or more held back than are, the share comes out smaller.
    order = np.argsort(limits / weights)
    held, free = limits[order], weights[order]
    left = total - (np.cumsum(held) - held)
    share = np.max(left / np.cumsum(free[::-1])[::-1])
    return np.asarray(np.minimum(share * weights, limits))


class ReadhesionControl:
    """Slip control of each axle for itself, that knows neither the rail nor its peak.

    Each axle has an even share of the demand. One whose wheel runs away from the train gets less
    than the adhesion that it used at that moment, by a disturbance observer: effort less what turns
    the wheel faster. Once the wheel is back its effort is restored to most of that adhesion, kept
    there, and raised slowly until the demand is met or the wheel races again; as Kadowaki et al.
    (2007) on series 205-5000 of JR East.

    Parameters
    ----------
    train : Train

    Attributes
    ----------
    period : float [s]
        Time from one decision to the next.
    filter_time : float [s]
        Of the wheels' acceleration.
    acceleration : float [m/s²]
        Of a wheel against the train, from which on it begins to race, at `least_slip` or more.
    least_slip, most_slip : float [m/s]
        Below the one nothing is done, above the other always.
    cut : float
        Effort while the wheel comes back, over the adhesion that it used when it began to race.
    restored : float
        Effort once it is back, over the same.
    patience : float [s]
        In which the effort of a wheel that does not come back falls to a third.
    pause : float [s]
        For how long the restored effort is kept.
    ramp : float [1/s]
        How fast it then grows: share of the largest effort, a second.

    Examples
    --------
    >>> from trainlog.simulation.traction import DriveReading
    >>> import numpy as np
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> control = ReadhesionControl(train)
    >>> reading = DriveReading(0.0, 0.0, 10.0, np.full(4, 10.2), np.full(4, 15e3), 60e3, 0.0)
    >>> control.efforts(reading).tolist()
    [15000.0, 15000.0, 15000.0, 15000.0]
    """

    name = "readhesion"
    unsolved = 0
    period, filter_time = 0.02, 0.1
    acceleration, least_slip, most_slip = 2.0, 0.8, 3.0
    cut, restored, patience, pause, ramp = 0.6, 0.95, 0.5, 1.0, 0.1

    def __init__(self, train: Train) -> None:
        self._train, self._inertia = train, train.axles.rotating_mass
        n = train.axles.count
        self._slip = np.full(n, np.nan)
        self._rate, self._wheel_rate, self._wheels = np.zeros(n), np.zeros(n), np.full(n, np.nan)
        self._cap, self._held = np.full(n, np.inf), np.zeros(n)
        self._used, self._back = np.zeros(n), np.ones(n, dtype=bool)

    def efforts(self, reading: DriveReading) -> FloatArray:
        """Efforts of the axles until the next decision, (n,) [N], negative in braking."""
        n = self._cap.size
        braking = reading.braking_effort > 0.0
        direction = -1.0 if braking else 1.0
        if braking:
            most = float(self._train.dynamic_braking_effort_limit(reading.speed))
            wanted = min(reading.braking_effort, most) / n
        else:
            wanted = min(reading.tractive_effort, self._train.max_tractive_effort) / n
        slip = direction * (reading.wheel_speeds - reading.speed)
        self._differentiate(slip, direction * reading.wheel_speeds)
        observed = np.maximum(direction * reading.efforts - self._inertia * self._wheel_rate, 0.0)
        racing = self._back & (
            ((self._rate > self.acceleration) & (slip > self.least_slip)) | (slip > self.most_slip)
        )
        self._used[racing] = observed[racing]
        self._cap[racing], self._back[racing] = self.cut * observed[racing], False
        # A wheel that does not come back used less than was observed.
        self._used[~self._back] *= 1.0 - self.period / self.patience
        self._cap[~self._back] *= 1.0 - self.period / self.patience
        returned = ~self._back & (
            (slip < self.least_slip) | ((self._rate < 0.0) & (slip < self.most_slip))
        )
        self._cap[returned] = self.restored * self._used[returned]
        self._back[returned], self._held[returned] = True, 0.0
        self._held += self.period
        largest = self._train.max_tractive_effort / n
        grows = self._back & (self._held > self.pause)
        self._cap[grows] += self.ramp * self.period * largest
        self._cap[grows & (self._cap >= wanted)] = np.inf
        return np.asarray(direction * np.minimum(wanted, self._cap))

    def _differentiate(self, slip: FloatArray, wheels: FloatArray) -> None:
        """Filtered rates of slip and wheel speeds [m/s²]."""
        share = self.period / (self.filter_time + self.period)
        for rate, now, last in (
            (self._rate, slip, self._slip), (self._wheel_rate, wheels, self._wheels),
        ):  # fmt: skip
            change = np.where(np.isnan(last), 0.0, (now - last) / self.period)
            rate += share * (change - rate)
        self._slip, self._wheels = slip, wheels


def with_traction(
    scenarios: Iterable[Scenario],
    traction: TractionName,
    condition: TrackConditionMap | None = None,
    layer: str | None = None,
) -> list[Scenario]:
    """The same trips with a traction control in place of the plant's own slip protection.

    Parameters
    ----------
    scenarios : iterable of Scenario
    traction : {"cooperative", "readhesion"}
    condition : TrackConditionMap, optional
        That the cooperative control knows.
    layer : str, optional
        Of the map; default: the weather of each scenario.

    Raises
    ------
    InputError
        If the name is unknown, the map is of another line, or it has no layer of that name.

    Examples
    --------
    >>> import trainlog
    >>> from trainlog.simulation import draw_scenarios
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> with_traction(draw_scenarios(line, train, 1), "readhesion")[0].traction().name
    'readhesion'
    """
    if traction not in get_args(TractionName):
        raise InputError(
            f"traction control '{traction}' is unknown",
            remedy="one of cooperative, readhesion; none: the plant's own slip protection",
        )
    found = []
    for each in scenarios:
        make: Callable[[], TractionControl] = partial(ReadhesionControl, each.train)
        if traction == "cooperative":
            load = 0.0
            if each.sensors.load_error is not None:
                largest = each.train.max_load or LARGEST_LOAD
                load, _ = weighed_load(each.load, largest, each.sensors, each.seed)
            make = partial(
                CooperativeTraction, each.train, each.travelled, condition=condition,
                layer=layer or each.weather, direction=each.direction, mass=each.train.mass + load,
            )  # fmt: skip
        make()  # a map that does not fit is refused before anything is driven
        found.append(replace(each, traction=make))
    return found
