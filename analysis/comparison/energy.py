"""Energy of trips made comparable: at the same load and the same running time.

The forces on the train at given speeds follow from a model of its running resistance. For the
speeds of a trip the model gives the tractive work that they need, at any mass; with all speeds
times a factor, at any running time. What the model finds between the trip as it was and at another
load and time is added to what was recorded.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from scipy.ndimage import uniform_filter1d

from analysis.comparison.driven import DrivenTrip
from analysis.resistance.curve import HEAD_WIND
from trainlog.arrays import FloatArray
from trainlog.presentation import Band
from trainlog.railway import Line, ParameterSet, RunningResistance, Train

FIT = "fit"
"""Name of a model that was fitted; else it is that of a train's file."""

RESISTANCE_SHARE = 0.3
"""Standard deviation of the resistance of a train's file, over its value."""

TRIP_SPREAD = 0.05
"""Standard deviation of the resistance from trip to trip, over its value, without the wind."""

RECORDED_WIND = 1.0
"""Standard deviation of a recorded head wind [m/s]: gusts, and the train in its own air."""

PRIOR_TRIPS = 4
"""Trips that what is known of such differences beforehand counts for."""

NORMALISING_SHARE = 0.2
"""Standard deviation of what load and time are found to change, over that change: a driver with
another load or more time does not keep all speeds in proportion."""

LARGEST_TIME_CHANGE = 0.15
"""Running times further apart than this share are not made comparable."""

STEP = 20.0
"""Length over which forces are averaged [m]."""


@dataclass(frozen=True, eq=False)
class ForceModel:
    """Forces on a train: its running resistance with an uncertainty, the line, its mass.

    Attributes
    ----------
    name : str
        Where the resistance is from.
    train : Train
    line : Line
        As travelled.
    resistance : RunningResistance
    covariance : (p, p) array
        Of the coefficients for a trip that has not been seen.
    """

    name: str
    train: Train
    line: Line
    resistance: RunningResistance
    covariance: FloatArray

    @staticmethod
    def of(
        train: Train, line: Line, model: ParameterSet | None, wind_std: float | None = None
    ) -> ForceModel:
        """The model of a fit, or of the train's file where there is none.

        The head wind [m/s] is what it is from trip to trip, unless `wind_std` states it; a file
        whose trips' wind is stated is taken at its word.

        Raises
        ------
        InputError
            If the fit is of another train.
        """
        if model is not None:
            model.check_train(train.name)
            # Common running resistance of a fit, and its covariance for one more trip.
            betas = np.array([each.resistance.coefficients for each in model.configurations])
            common = (
                RunningResistance.of(betas.mean(axis=0)) if model.common is None else model.common
            )
            none = np.zeros((betas.shape[1], betas.shape[1]))
            known = none if model.common_covariance is None else model.common_covariance
            if model.common_covariance is None and len(betas) == 1:
                known = RESISTANCE_SHARE**2 * np.outer(betas[0], betas[0])
            off = betas - common.coefficients
            # Few trips hardly show how much they differ: what they differ by anyway counts as some.
            weight = PRIOR_TRIPS + len(betas) - 1
            spread = trip_spread(common, HEAD_WIND if wind_std is None else wind_std)
            between = (PRIOR_TRIPS * spread + off.T @ off) / weight
            covariance = known + between * weight / (weight - 2)
            return ForceModel(FIT, train, line, common, covariance)
        own = train.resistance
        spread = RESISTANCE_SHARE**2 * np.outer(own.coefficients, own.coefficients)
        if wind_std is not None:
            spread = trip_spread(own, wind_std)
        return ForceModel("train's file", train, line, own, spread)

    @property
    def principal_axes(self) -> FloatArray:
        """Changes of the coefficients by a standard deviation of each principal axis, in rows."""
        variances, axes = np.linalg.eigh(self.covariance)
        return np.asarray((axes * np.sqrt(np.maximum(variances, 0.0))).T)

    def tunnels(self, position: FloatArray) -> FloatArray:
        """Extra quadratic term [N/(m/s)²] in tunnels."""
        return self.train.tunnel_coefficient(self.line.tunnel_cross_section(position))


def trip_spread(resistance: RunningResistance, wind_std: float = HEAD_WIND) -> FloatArray:
    """Covariance of the coefficients from trip to trip: `TRIP_SPREAD` and a head wind [m/s].

    Air resistance is that of the speed and the wind together: ``r2 (v + w)²``.
    """
    own = resistance.coefficients
    covariance = TRIP_SPREAD**2 * np.outer(own, own)
    covariance[1, 1] += (2.0 * resistance.r2 * wind_std) ** 2
    covariance[0, 0] += 2.0 * (resistance.r2 * wind_std**2) ** 2
    return np.asarray(covariance)


def normalised_energy(trip: DrivenTrip, reference: DrivenTrip, model: ForceModel) -> Band | None:
    """Tractive work of a trip as it would have been with the load and time of a reference.

    Parameters
    ----------
    trip, reference : DrivenTrip
        From the same station to the same.
    model : ForceModel

    Returns
    -------
    Band or None
        None where efforts or a load are not recorded, or the running times (without stands)
        differ by more than `LARGEST_TIME_CHANGE`.
    """
    if "traction" not in trip.sums or not (trip.mass.known and reference.mass.known):
        return None
    if trip.unknown():
        return None
    recorded = float(trip.sums["traction"][-1])
    ratio = float(trip.running[-1] / reference.running[-1])
    if abs(ratio - 1.0) > LARGEST_TIME_CHANGE:
        return None
    mass, other = trip.mass.value, reference.mass.value

    own = needed_work(trip, model, mass)
    by_load = needed_work(trip, model, other) - own
    by_time = needed_work(trip, model, other, ratio) - by_load - own
    changes = by_load + by_time
    spread = [
        needed_work(trip, varied, other, ratio) - needed_work(trip, varied, mass) - changes
        for axis in model.principal_axes
        for varied in [
            replace(model, resistance=RunningResistance.of(model.resistance.coefficients + axis))
        ]
    ]
    slope = by_load / (other - mass) if other != mass else 0.0
    weighed = slope * np.hypot(trip.mass.std, reference.mass.std)
    gain = trip.gain.std / trip.gain.value * recorded if trip.gain.known else 0.0
    unlike = NORMALISING_SHARE * np.hypot(by_load, by_time)
    std = float(np.sqrt(np.sum(np.square(spread)) + weighed**2 + gain**2 + unlike**2))
    return Band(recorded + changes, std)


def needed_work(trip: DrivenTrip, model: ForceModel, mass: float, factor: float = 1.0) -> float:
    """Tractive work [J] that the speeds of a trip, all times `factor`, need with a mass [kg]."""
    first, last = trip.covered
    nodes = np.linspace(first, last, max(2, round((last - first) / STEP) + 1))
    speed = factor * smooth_speed(trip, nodes)
    middle, step = 0.5 * (nodes[1:] + nodes[:-1]), np.diff(nodes)
    squared = 0.5 * (speed[1:] ** 2 + speed[:-1] ** 2)
    kinetic = 0.5 * (mass + model.train.rotating_mass) * np.diff(speed**2)
    force = model.resistance(np.sqrt(squared)) + model.tunnels(middle) * squared
    force = force + model.train.track_force(model.line, middle, mass)
    return float(np.maximum(kinetic + force * step, 0.0).sum())


def smooth_speed(trip: DrivenTrip, nodes: FloatArray) -> FloatArray:
    """Speed of a trip at nodes [m/s], without its noise; zero where it stands."""
    steps = np.diff(trip.time)
    width = max(1, round(2.0 / float(np.median(steps))))
    speed = uniform_filter1d(trip.speed, width, mode="nearest")
    found = trip.at(speed, nodes)
    for stand in trip.stands:
        found[np.argmin(np.abs(nodes - stand.position))] = 0.0
    return np.asarray(found)
