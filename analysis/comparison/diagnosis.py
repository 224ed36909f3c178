"""What of a model is wrong: one coefficient of the resistance, or the mass, named with its factor.

A trip with efforts is fitted by itself (`analysis.resistance.fit.fit_trip`): its curve hardly
depends on the resistance of the train's file. What trips differ by beside that, a head wind that is
not recorded above all, is a part of the difference that is no error of the file. What is left is
explained by a change of one coefficient at a time; the change that leaves least is named, with
those that explain it nearly as well: of the linear term also a steady wind. The mass shows in the
gain of the efforts, by which both are found in one. Several trips are taken together: their winds
differ, an error of the file does not.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.stats import f as f_distribution

from analysis.comparison.energy import TRIP_SPREAD, ForceModel
from analysis.resistance.fit import TripFit, fit_trip
from trainlog.arrays import FloatArray
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.railway import recorded_load
from trainlog.railway import Train
from trainlog.railway.passport import Quantity
from trainlog.trip import Trip

SURE = 0.999
"""Probability with which a difference of the curve must not be chance."""

FALSE_ALARMS = 0.1
"""Share of trips that contradicted a right file, by the mass or by the curve, as measured."""

ALIKE = 3.84
"""Rise of chi-squared up to which another coefficient explains as well."""

OWN_SPREAD = 0.1
"""Standard deviation of each coefficient of a file, over its value, that is no error of it."""

LEAST_FACTOR = 1.25
"""Smaller factors of a coefficient are within what trains of a kind and days differ by."""

CONVERTER_STD, MASS_SURE = 0.03, 2.4
"""Standard deviation of the gain of an ordinary recorder's efforts, and how many of it, together
with what the trip leaves open, a gain must differ from 1 by to be that of a wrong mass."""


@dataclass(frozen=True, slots=True)
class Wrong:
    """A quantity of a model that the trip contradicts.

    Attributes
    ----------
    name : str
        ``"r0"``, ``"r1"``, ``"r2"``, ``"running resistance"`` (more than one) or ``"mass"``.
    factor, factor_std : float
        What the model states over what the trip shows, and its standard deviation.
    alternatives : tuple of str
        What explains the same nearly as well.
    """

    name: str
    factor: float
    factor_std: float
    alternatives: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """In a sentence."""
        size = f"{self.factor:.2f} ± {1.96 * self.factor_std:.2f} times what the trip shows"
        others = f" (or {' or '.join(self.alternatives)})" if self.alternatives else ""
        return f"{self.name} is {size}{others}"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What of a model is wrong.

    Attributes
    ----------
    wrong : tuple of Wrong
    not_judged : str
        Why nothing can be said, if so.
    judged_trips : int
        How many trips it rests on.
    false_alarms : float
        Share of trips that contradict a right file by chance, about.
    """

    wrong: tuple[Wrong, ...] = ()
    not_judged: str = ""
    judged_trips: int = 1
    false_alarms: float = FALSE_ALARMS

    @property
    def words(self) -> str:
        """In a sentence."""
        if self.not_judged:
            return f"not judged: {self.not_judged}"
        if not self.wrong:
            return "nothing that the trip contradicts"
        return "; ".join(each.words for each in self.wrong)


@dataclass(frozen=True, eq=False)
class Evidence:
    """What a trip shows of a model.

    Attributes
    ----------
    model : ForceModel
    of_file : bool
        The model is the train's file, whose coefficients have no covariance of their own.
    wind_std : float [m/s]
        Of the head wind as far as it is not recorded.
    gain : Quantity
        Of the efforts, as the passport finds it with the train's mass.
    load : float or None [kg]
        As recorded.
    fit : TripFit or None
        Of the trip by itself.
    reason : str
        Why there is none, if so.
    """

    model: ForceModel
    of_file: bool
    wind_std: float
    gain: Quantity
    load: float | None
    fit: TripFit | None
    reason: str = ""

    @staticmethod
    def of(
        trip: Trip, model: ForceModel, gain: Quantity, wind_std: float, *, of_file: bool
    ) -> Evidence:
        """What a trip shows that carries the train of the model."""
        load = recorded_load(trip, model.train)
        found = Evidence(model, of_file, wind_std, gain, None if load is None else load.value, None)
        try:
            # A curve that is known roughly still contradicts one that is far off.
            return replace(found, fit=fit_trip(trip, largest_std=np.inf))
        except TrainlogError as error:
            return replace(found, reason=str(error).partition(";")[0])


def diagnosed(evidence: Sequence[Evidence]) -> Diagnosis:
    """What trips contradict of a model.

    Raises
    ------
    InputError
        If there is none, or they are of different trains.
    """
    if len({each.model.train.name for each in evidence}) != 1:
        raise InputError(
            "trips of one train are judged together",
            remedy="give those of one train",
        )
    train = evidence[0].model.train
    heavy = wrong_mass(train, [(each.load, each.gain) for each in evidence])
    wrong = () if heavy is None else (heavy,)
    fitted = [each for each in evidence if each.fit is not None]
    if not fitted:
        return Diagnosis(wrong, "" if wrong else evidence[0].reason, len(evidence))
    # A wrong mass makes the gain, and with it all forces, wrong by its factor.
    coefficient = _wrong_coefficient(fitted, 1.0 if heavy is None else heavy.factor)
    wrong = wrong if coefficient is None else (*wrong, coefficient)
    return Diagnosis(wrong, "", len(fitted))


def wrong_mass(train: Train, weighed: Sequence[tuple[float | None, Quantity]]) -> Wrong | None:
    """The mass of the train's file, if motions with it need efforts of another size.

    Parameters
    ----------
    train : Train
    weighed : sequence of (float or None, Quantity)
        The recorded load [kg] and gain of the efforts of each trip.
    """
    known = [
        (load, gain) for load, gain in weighed if load is not None and gain.source == "estimated"
    ]
    if not known:
        return None
    weights = np.array([(gain.value / gain.std) ** 2 for _, gain in known])
    ratios = np.array([1.0 / gain.value for _, gain in known])
    # One recorder's efforts err alike on all trips.
    std = float(np.hypot(weights.sum() ** -0.5, CONVERTER_STD))
    if abs(float(np.average(ratios, weights=weights)) - 1.0) < MASS_SURE * std:
        return None
    # The recorded load is no part of what may be wrong.
    own = train.mass + train.rotating_mass
    shown = np.array([(own + load) * gain.value - load for load, gain in known])
    factor = own / float(np.average(shown, weights=weights))
    return Wrong("mass", factor, factor * std, ("recorded efforts",))


def _wrong_coefficient(fitted: Sequence[Evidence], factor: float) -> Wrong | None:
    """The coefficient that trips contradict, their efforts and curves over a factor."""
    model = fitted[0].model
    own = model.resistance.coefficients
    fits = [each.fit for each in fitted if each.fit is not None]
    betas = np.array([fit.beta for fit in fits]) / factor
    single = np.array([fit.covariance[:3, :3] for fit in fits]) / factor**2
    if fitted[0].of_file:
        rough = _mean(betas, single)[0]
        # Of the coefficients as they may be: those of a wrong file are too large or too small.
        size = np.minimum(own, np.maximum(rough, 0.1 * own))
        single = single + TRIP_SPREAD**2 * np.outer(size, size)
        for row, each in enumerate(fitted):
            single[row, 1, 1] += (2.0 * size[2] * each.wind_std) ** 2
            single[row, 0, 0] += 2.0 * (size[2] * each.wind_std**2) ** 2
        common = np.diag((OWN_SPREAD * size) ** 2)
    else:
        common = model.covariance
    shown, variance = _mean(betas, single)
    if len(fits) > 1:
        off = betas - shown
        scatter = np.einsum("ni,nij,nj", off, np.linalg.inv(single), off) / (3 * (len(fits) - 1))
        variance = variance * max(1.0, float(scatter))
        # Trips over one line share the errors of its gradients.
        variance = variance + np.mean([fit.survey[:3, :3] for fit in fits], axis=0) / factor**2
    freedom = float(sum(fit.freedom for fit in fits))
    return _coefficient(own, shown, common + variance, freedom)


def _mean(values: FloatArray, variances: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Weighted mean (3,) of values (n, 3), and its covariance."""
    weights = np.linalg.inv(variances)
    variance = np.linalg.inv(weights.sum(axis=0))
    return variance @ np.einsum("nij,nj->i", weights, values), variance


def _coefficient(
    own: FloatArray, shown: FloatArray, spread: FloatArray, freedom: float
) -> Wrong | None:
    """The coefficient whose change explains most of the difference; None if there is none."""
    precision = np.linalg.inv(spread)
    off = own - shown
    whole = float(off @ precision @ off)
    if whole < 3.0 * f_distribution.ppf(SURE, 3, freedom):
        return None
    changes = (precision @ off) / np.diag(precision)
    left = whole - changes**2 * np.diag(precision)
    best = int(np.argmin(left))
    true = own - changes
    names = ("r0", "r1", "r2")
    if left[best] > 2.0 * f_distribution.ppf(SURE, 2, freedom):
        scale = float(own @ precision @ shown / (own @ precision @ own))
        std = float(1.0 / np.sqrt(own @ precision @ own))
        return Wrong("running resistance", 1.0 / scale, std / scale**2)
    factor = own[best] / true[best] if true[best] > 0.0 else np.inf
    if 1.0 / LEAST_FACTOR < factor < LEAST_FACTOR:
        return None
    std = float(factor / max(true[best], 1e-9) / np.sqrt(precision[best, best]))
    others = [names[row] for row in range(3) if row != best and left[row] < left[best] + ALIKE]
    if "r1" in (names[best], *others):
        # Air resistance of a wind w is r2 (v + w)²: to the motion it is a linear term.
        others.append(f"a head wind of {-changes[1] / (2.0 * max(shown[2], 1e-9)):.0f} m/s")
    return Wrong(names[best], float(factor), std, tuple(others))
