"""What a train or a line of a user's file can be: values beyond it come from a wrong unit.

The limits are wide, from a railcar of 5 t to a maglev, and still separate kg from t, N from kN, W
from kW and per cent from per mille. Logs keep what they were recorded with: their attachments are
not judged.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.railway.effort import EffortCurve
from trainlog.railway.line import Line
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Train
from trainlog.units import GRAVITY, KMH


@dataclass(frozen=True, slots=True)
class Plausible:
    """The range of a field.

    Attributes
    ----------
    low, high : float
        In SI.
    unit : str
        Unit of the message.
    scale : float
        That unit in SI.
    what : str
        What has such values.
    confused : tuple of (float, str)
        Factors by which a value is off when its unit is confused, each with the confusion.
    """

    low: float
    high: float
    unit: str
    scale: float
    what: str
    confused: tuple[tuple[float, str], ...] = ()

    def problem(self, value: float, place: str) -> InputError | None:
        """What is wrong with `value` [SI]; None if nothing is, or if it is not positive."""
        if not np.isfinite(value) or value <= 0.0 or self.low <= value <= self.high:
            return None
        likely = [cause for by, cause in self.confused if self.low <= value * by <= self.high]
        return InputError(
            f"{value / self.scale:.6g} {self.unit} is not plausible: {self.what}"
            f" {self.low / self.scale:g} to {self.high / self.scale:g} {self.unit}",
            place=place,
            remedy=f"{likely[0]}?" if likely else "check the value and its unit",
        )


_TONNES = (
    (1e3, "were t meant where the unit states kg"),
    (1e-3, "were kg meant where the unit states t"),
)
_KILO = (
    (1e3, "were k{0} meant where the unit states {0}"),
    (1e-3, "were {0} meant where the unit states k{0}"),
)
_NEWTONS = tuple((by, cause.format("N")) for by, cause in _KILO)
_WATTS = tuple((by, cause.format("W")) for by, cause in _KILO)
_MILLIMETRES = (
    (1e-3, "were mm meant where the unit states m"),
    (1e3, "were m meant where the unit states mm"),
)
_SPEED = (
    (KMH, "were m/s meant where the unit states km/h"),
    (1.0 / KMH, "were km/h meant where the unit states m/s"),
)

TRAIN = {
    "mass": Plausible(5e3, 2e7, "t", 1e3, "trains have", _TONNES),
    "rotating_mass_factor": Plausible(
        1e-3, 0.6, "%", 0.01, "rotating parts add",
        ((0.01, "was the percentage given as a pure number"),),
    ),
    "length": Plausible(5.0, 8e3, "m", 1.0, "trains have", _MILLIMETRES),
    "max_load": Plausible(50.0, 2e7, "t", 1e3, "trains carry", _TONNES),
    "max_speed": Plausible(5.0 / KMH, 650.0 / KMH, "km/h", 1.0 / KMH, "trains run", _SPEED),
    "max_acceleration": Plausible(0.005, 4.0, "m/s^2", 1.0, "trains reach"),
    "max_deceleration": Plausible(0.02, 6.0, "m/s^2", 1.0, "trains reach"),
    "max_tractive_effort": Plausible(1e3, 5e6, "kN", 1e3, "trains have", _NEWTONS),
    "max_traction_power": Plausible(1e4, 1e8, "kW", 1e3, "trains have", _WATTS),
    "max_dynamic_braking_effort": Plausible(1e2, 5e6, "kN", 1e3, "trains have", _NEWTONS),
    "max_dynamic_braking_power": Plausible(1e3, 2e8, "kW", 1e3, "trains have", _WATTS),
    "max_pneumatic_braking_effort": Plausible(1e2, 5e7, "kN", 1e3, "trains have", _NEWTONS),
}  # fmt: skip
"""By the field of a train file."""

LOAD = Plausible(50.0, 2e7, "kg", 1.0, "trains carry", _TONNES)
"""Load of a trip; 0 is an empty train."""

MOST_LOAD = 1.5
"""Times the mass of the empty train, that a load reaches at most where the train states no more."""

AXLES = {
    "wheel_radius": Plausible(0.15, 1.3, "m", 1.0, "wheels have a radius of", _MILLIMETRES),
    "rotating_mass": Plausible(5.0, 2e4, "t", 1e3, "a powered axle has", _TONNES),
}
"""By the field under ``axles``."""

GEOMETRY = {
    "wheelbase": Plausible(1.0, 6.0, "m", 1.0, "bogies have", _MILLIMETRES),
    "pivot_distance": Plausible(3.0, 25.0, "m", 1.0, "vehicles have", _MILLIMETRES),
    "link_height": Plausible(0.05, 2.0, "m", 1.0, "bodies are pulled at", _MILLIMETRES),
    "coupler_height": Plausible(0.3, 2.0, "m", 1.0, "couplers are at", _MILLIMETRES),
    "centre_height": Plausible(0.5, 3.0, "m", 1.0, "vehicles have their mass at", _MILLIMETRES),
}
"""By the field under ``axles.geometry``."""

AXLE_LOAD = Plausible(2e3, 4e4, "t", 1e3, "an axle carries", _TONNES)
"""Mass on one powered axle."""

RESISTANCE = Plausible(
    2e-4, 0.3, "per mille", 1e-3, "the running resistance of trains is, over their weight,",
    (*_NEWTONS, (1.0 / KMH, "was the speed in its coefficients m/s, not km/h")),
)  # fmt: skip
"""Running resistance at the highest speed over the weight."""

SPECIFIC_POWER = Plausible(0.02, 300.0, "W/kg", 1.0, "trains have", (*_WATTS, *_TONNES))
"""Traction power over the mass."""

MOST_ADHESION, MOST_BRAKING = 1.0, 2.0
"""Effort over the weight on the axles that transmit it: of motors, of the friction brake.

Published friction brakes of 10 m/s² stand for "whatever the rail transmits".
"""

MOST_BESIDE = 10.0
"""Times the stated largest effort, that a curve of effort reaches at most, and its inverse."""

DELAY = 120.0
"""Dead time and lag of a friction brake [s]."""


def implausible_train(values: Mapping[str, Any]) -> Iterator[InputError]:
    """What of a train's `values` [SI], by the fields of its file, cannot be meant.

    Not all of them need be there.
    """
    wrong = set()
    for name, plausible in TRAIN.items():
        problem = plausible.problem(values.get(name) or 0.0, name)
        if problem is not None:
            wrong.add(name)
            yield problem
    axles, brake = values.get("axles"), values.get("brake")
    if axles is not None:
        for name, plausible in AXLES.items():
            problem = plausible.problem(getattr(axles, name), f"axles.{name}")
            if problem is not None:
                yield problem
        geometry = axles.geometry
        for name, plausible in GEOMETRY.items() if geometry is not None else ():
            problem = plausible.problem(getattr(geometry, name), f"axles.geometry.{name}")
            if problem is not None:
                yield problem
        problem = AXLE_LOAD.problem(axles.adhesive_mass / axles.count, "axles.adhesive_mass")
        if problem is not None:
            wrong.add("axles")
            yield problem
    if brake is not None:
        for name in ("dead_time", "lag"):
            if getattr(brake, name) > DELAY:
                yield InputError(
                    f"{getattr(brake, name):g} s is not plausible: at most {DELAY:g} s",
                    place=f"brake.{name}",
                    remedy="check the value and its unit",
                )
    yield from _implausible_curves(values)
    mass = values.get("mass") or 0.0
    if mass > 0.0 and "mass" not in wrong:
        yield from _against_mass({k: v for k, v in values.items() if k not in wrong}, mass)


def _implausible_curves(values: Mapping[str, Any]) -> Iterator[InputError]:
    """Curves of effort that contradict the largest effort beside them, or reach odd speeds."""
    for name, stated in (
        ("traction_curve", "max_tractive_effort"),
        ("dynamic_braking_curve", "max_dynamic_braking_effort"),
    ):
        curve, effort = values.get(name), values.get(stated) or 0.0
        if curve is None:
            continue
        speeds, efforts = (curve.speeds, curve.efforts) if isinstance(curve, EffortCurve) else curve
        if np.size(speeds) == 0:
            continue
        top = float(np.max(efforts))
        if effort > 0.0 and not effort / MOST_BESIDE <= top <= effort * MOST_BESIDE:
            yield InputError(
                f"its largest effort, {top / 1e3:.6g} kN, contradicts {stated},"
                f" {effort / 1e3:.6g} kN",
                place=name,
                remedy="check the units of both (N or kN)",
            )
        problem = TRAIN["max_speed"].problem(float(np.max(speeds)), name)
        if problem is not None:
            yield problem


def _against_mass(values: Mapping[str, Any], mass: float) -> Iterator[InputError]:
    """What does not go with a plausible mass [kg]."""
    axles, speed = values.get("axles"), values.get("max_speed") or 0.0
    adhesive = mass if axles is None else axles.adhesive_mass
    if adhesive > 1.001 * mass:
        yield InputError(
            f"{adhesive / 1e3:.6g} t on the powered axles are more than the train's mass of"
            f" {mass / 1e3:.6g} t",
            place="axles.adhesive_mass",
            remedy="give what rests on all powered axles together, train empty",
        )
    for name, share, carried, carrier in (
        ("max_tractive_effort", MOST_ADHESION, adhesive, "the powered axles"),
        ("max_dynamic_braking_effort", MOST_ADHESION, adhesive, "the powered axles"),
        ("max_pneumatic_braking_effort", MOST_BRAKING, mass, "the train"),
    ):
        effort, weight = values.get(name) or 0.0, GRAVITY * carried
        if effort > share * weight > 0.0:
            yield InputError(
                f"{effort / 1e3:.6g} kN is not plausible: it is {effort / weight:.3g} times the"
                f" weight on {carrier}, {weight / 1e3:.6g} kN",
                place=name,
                remedy="check the effort, the mass and their units (N or kN, kg or t)",
            )
    power = SPECIFIC_POWER.problem(
        (values.get("max_traction_power") or 0.0) / mass, "max_traction_power"
    )
    if power is not None:
        yield power
    resistance = values.get("running_resistance")
    if resistance is not None and speed > 0.0:
        curve = RunningResistance(resistance.r0, resistance.r1, resistance.r2)
        problem = RESISTANCE.problem(float(curve(speed)) / (GRAVITY * mass), "running_resistance")
        if problem is not None:
            yield problem


def check_train(train: Train) -> None:
    """Refuse a train that cannot be meant; fields that are assumed are not judged.

    Raises
    ------
    InputError
        That lists each field with its value, what is plausible, and the likely cause.

    Examples
    --------
    >>> from dataclasses import replace
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> check_train(train)
    >>> check_train(replace(train, mass=122.0, max_load=0.0))  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: mass: 0.122 t is not plausible: trains have 5 to 20000 t; were t...
    """
    values = vars(train) | {"running_resistance": train.resistance}
    problems = [
        problem
        for problem in implausible_train(values)
        if str(problem.place).partition(".")[0] not in train.assumed
    ]
    if problems:
        raise InputError.listing(problems)


def check_load(load: float, train: Train | None = None) -> None:
    """Refuse a load [kg] that cannot be meant: of any train, or of the one that is known.

    Raises
    ------
    InputError
        That names the load, what is plausible, and the likely cause.

    Examples
    --------
    >>> check_load(11_700.0)
    >>> check_load(11.7)  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.InputError: load: 11.7 kg is not plausible: trains carry 50 to 2e+07 kg; were...
    """
    problem = LOAD.problem(load, "load")
    if problem is not None:
        raise problem
    most = np.inf if train is None else max(MOST_LOAD * train.mass, train.max_load or 0.0)
    if not 0.0 <= load <= most:
        against = f" for a train of {train.mass:.0f} kg" if train is not None else ""
        raise InputError(
            f"load {load:.0f} kg is not plausible{against}",
            remedy="is it the mass of the loaded train, or is its unit another than kg?",
        )


LINE = {
    "length": Plausible(20.0, 2e7, "km", 1e3, "lines have",
                        ((1e3, "were km meant where the unit states m"),
                         (1e-3, "were m meant where the unit states km"))),
}  # fmt: skip
"""By the field of a line file."""

LIMIT = Plausible(1.0 / KMH, 600.0 / KMH, "km/h", 1.0 / KMH, "speed limits are", _SPEED)
STEEPEST_MEAN = 0.08
"""Mean size of the gradients of a whole line; only rack railways exceed it."""

LOWEST, HIGHEST = -1_000.0, 6_000.0
"""Altitudes [m] between which there are railways."""

LEAST_EXTENT = 0.005
"""Share of a line's length that its rows cover at least, where there are several."""


def implausible_line(values: Mapping[str, Any]) -> Iterator[InputError]:
    """What of a line's `values` [SI], by the fields of its file, cannot be meant."""
    length = values.get("length") or 0.0
    for name, plausible in LINE.items():
        problem = plausible.problem(values.get(name) or 0.0, name)
        if problem is not None:
            yield problem
    for name in ("speed_limits", "speed_limits_reverse"):
        if values.get(name) is None:
            continue
        limits = np.asarray(values[name][1], dtype=np.float64)
        wild = np.flatnonzero((limits > 0.0) & ((limits < LIMIT.low) | (limits > LIMIT.high)))
        if wild.size:
            problem = LIMIT.problem(float(limits[wild[0]]), f"{name}.values[{wild[0]}][1]")
            if problem is not None:
                yield problem
    altitude = values.get("altitude") or 0.0
    if not LOWEST <= altitude <= HIGHEST:
        yield InputError(
            f"{altitude:.6g} m is not plausible: railways lie between {LOWEST:g} and {HIGHEST:g} m",
            place="altitude",
            remedy="check the value and its unit",
        )
    if values.get("gradients") is not None and length > 0.0:
        positions, gradients = (np.asarray(x, dtype=np.float64) for x in values["gradients"])
        yield from _implausible_gradients(positions, gradients, length)
        yield from _implausible_chainage(values, length)


def check_line(line: Line) -> None:
    """Refuse a line that cannot be meant; errors as `check_train`.

    Examples
    --------
    >>> import trainlog
    >>> check_line(trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json"))
    """
    stations = [station.position for station in line.stations]
    against = line.speed_limits_reverse
    tables = {
        "stations": ((), stations),
        "speed_limits": (line.speed_limits.positions, line.speed_limits.values),
        "speed_limits_reverse": None if against is None else (against.positions, against.values),
        "gradients": (line.gradients.positions, line.gradients.values),
    }
    problems = list(implausible_line({"length": line.length, "altitude": line.altitude} | tables))
    if problems:
        raise InputError.listing(problems)


def _implausible_gradients(
    positions: FloatArray, gradients: FloatArray, length: float
) -> Iterator[InputError]:
    if positions.size == 0 or np.any(np.diff(positions) <= 0.0) or np.any(np.abs(gradients) > 0.2):
        return
    widths = np.diff(np.append(positions, max(length, positions[-1])))
    mean = float(np.sum(np.abs(gradients) * widths)) / max(float(np.sum(widths)), 1e-9)
    rise = np.cumsum(gradients * widths)
    if mean > STEEPEST_MEAN and length > 1e3:
        problem = f"are {1e3 * mean:.0f} per mille on the whole line's average"
    elif np.ptp(rise) > HIGHEST - LOWEST:
        problem = f"make the line rise by {np.ptp(rise):.0f} m"
    else:
        return
    yield InputError(
        f"{problem}: not plausible",
        place="gradients",
        remedy="were per mille meant where the unit states '%'?",
    )


def _implausible_chainage(values: Mapping[str, Any], length: float) -> Iterator[InputError]:
    """Rows of a line that all lie at its start: chainage in km whose unit states m."""
    tables = ("speed_limits", "speed_limits_reverse", "gradients", "curvatures", "tunnels")
    found = [np.asarray(values[name][0]) for name in tables if values.get(name) is not None]
    if values.get("stations") is not None:
        found.append(np.asarray(values["stations"][1], dtype=np.float64))
    positions = np.concatenate(found)
    if np.unique(positions).size >= 5 and np.max(positions) < LEAST_EXTENT * length:
        yield InputError(
            f"all positions lie within {np.max(positions):.6g} m of a line of {length:.6g} m:"
            " not plausible",
            place="units.position",
            remedy="were km meant where the unit states m?",
        )
