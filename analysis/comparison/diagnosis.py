"""What of a model is wrong: one coefficient of the resistance, or the mass, named with its factor.

A trip with efforts is fitted by itself (`analysis.resistance.fit.fit_trip`): its curve hardly
depends on the resistance of the train's file. The difference from the model is explained by a
change of one coefficient at a time; the change that leaves least is named, with those that explain
it nearly as well: of the linear term also a steady wind. The mass shows in the gain of the efforts,
by which both are found in one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from analysis.comparison.energy import TRIP_SPREAD, ForceModel
from analysis.resistance.fit import fit_trip
from trainlog.errors import TrainlogError
from trainlog.formats.attached import recorded_load
from trainlog.railway import Train
from trainlog.railway.passport import Quantity
from trainlog.trip import Trip

FloatArray = NDArray[np.float64]

SURE = 0.999
"""Probability with which a difference must not be chance."""

ALIKE = 3.84
"""Rise of chi-squared up to which another coefficient explains as well."""

OWN_SPREAD = 0.1
"""Standard deviation of each coefficient of a file, over its value, that is no error of it."""

LEAST_FACTOR = 1.25
"""Smaller factors of a coefficient are within what trains of a kind and days differ by."""

MASS_SHARE = 0.05
"""Gains that differ from 1 by more than this, beyond their band, are those of a wrong mass."""


@dataclass(frozen=True, slots=True)
class Wrong:
    """A quantity of a model that the trip contradicts.

    Attributes
    ----------
    name : str
        ``"r0"``, ``"r1"``, ``"r2"``, ``"running resistance"`` (more than one) or ``"mass"``.
    factor, std : float
        What the model states over what the trip shows, and its standard deviation.
    alternatives : tuple of str
        What explains the same nearly as well.
    """

    name: str
    factor: float
    std: float
    alternatives: tuple[str, ...] = ()

    @property
    def words(self) -> str:
        """In a sentence."""
        size = f"{self.factor:.2f} ± {1.96 * self.std:.2f} times what the trip shows"
        others = f" (or {' or '.join(self.alternatives)})" if self.alternatives else ""
        return f"{self.name} is {size}{others}"


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What of a model is wrong.

    Attributes
    ----------
    wrong : tuple of Wrong
    reason : str
        Why nothing can be said, if so.
    """

    wrong: tuple[Wrong, ...] = ()
    reason: str = ""

    @property
    def words(self) -> str:
        """In a sentence."""
        if self.reason:
            return f"not judged: {self.reason}"
        if not self.wrong:
            return "nothing that the trip contradicts"
        return "; ".join(each.words for each in self.wrong)


def diagnosed(trip: Trip, model: ForceModel, gain: Quantity, *, of_file: bool) -> Diagnosis:
    """What a trip contradicts of a model.

    Parameters
    ----------
    trip : Trip
        Carrying the train of the model.
    model : ForceModel
    gain : Quantity
        Of the efforts, as the passport finds it with the train's mass.
    of_file : bool
        The model is the train's file, whose coefficients have no covariance of their own.
    """
    train = model.train
    try:
        fit = fit_trip(trip)
    except TrainlogError as error:
        heavy = wrong_mass(trip, train, gain)
        return Diagnosis((heavy,)) if heavy else Diagnosis((), str(error).partition(";")[0])
    found = []
    heavy = wrong_mass(trip, train, gain)
    # A wrong mass makes the gain, and with it all forces, wrong by its factor.
    factor = 1.0 if heavy is None else heavy.factor
    if heavy is not None:
        found.append(heavy)
    own = np.array([model.resistance.r0, model.resistance.r1, model.resistance.r2])
    spread = fit.covariance[:3, :3] / factor**2
    if not of_file:
        spread = spread + model.covariance
    else:
        # Of the coefficients as they may be: those of a wrong file are too large or too small.
        size = np.minimum(own, np.maximum(fit.beta, 0.1 * own))
        spread = spread + np.diag((OWN_SPREAD * size) ** 2)
        spread = spread + TRIP_SPREAD**2 * np.outer(size, size)
    coefficient = _coefficient(own, fit.beta / factor, spread)
    if coefficient is not None:
        found.append(coefficient)
    return Diagnosis(tuple(found))


def wrong_mass(trip: Trip, train: Train, gain: Quantity) -> Wrong | None:
    """The mass of the train's file, if the motion with it needs efforts of another size."""
    load = recorded_load(trip, train)
    if load is None or gain.source != "estimated":
        return None
    off = abs(1.0 / gain.value - 1.0)
    if off < MASS_SHARE or off < 2.6 * gain.std / gain.value:
        return None
    # The recorded load is no part of what may be wrong.
    shown = (train.mass + load.value + train.rotating_mass) * gain.value - load.value
    factor = (train.mass + train.rotating_mass) / shown
    return Wrong("mass", factor, factor * gain.std / gain.value, ("recorded efforts",))


def _coefficient(own: FloatArray, shown: FloatArray, spread: FloatArray) -> Wrong | None:
    """The coefficient whose change explains most of the difference; None if there is none."""
    precision = np.linalg.inv(spread)
    off = own - shown
    whole = float(off @ precision @ off)
    if whole < chi2.ppf(SURE, 3):
        return None
    changes = (precision @ off) / np.diag(precision)
    left = whole - changes**2 * np.diag(precision)
    best = int(np.argmin(left))
    true = own - changes
    names = ("r0", "r1", "r2")
    if left[best] > chi2.ppf(SURE, 2):
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
