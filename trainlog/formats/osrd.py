"""Rolling stock of OSRD, the Open Source Railway Designer (railjson), as trains.

https://osrd.fr: SI units without declaration; the tractive effort as tables over speed, one or more
for each electrification.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from trainlog.errors import InputError
from trainlog.formats.files import read_json
from trainlog.formats.schema import built, checked
from trainlog.formats.ttobench import assumed_axles
from trainlog.railway import EffortCurve, RunningResistance, Train

Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

_ASSUMED = (
    "max_dynamic_braking_effort",
    "max_dynamic_braking_power",
    "max_pneumatic_braking_effort",
    "efficiency_traction",
    "efficiency_regeneration",
    "max_load",
    "axles",
    "brake",
)
"""Fields of a train that OSRD does not know."""


class _Part(BaseModel):
    model_config = ConfigDict(extra="ignore", frozen=True)


class _Curve(_Part):
    speeds: list[NotNegative]
    max_efforts: list[NotNegative]

    def curve(self, place: str) -> EffortCurve:
        try:
            return EffortCurve(np.array(self.speeds), np.array(self.max_efforts))
        except InputError as error:
            raise InputError(error.problem, place=place, remedy=error.remedy) from error


class _Conditional(_Part):
    cond: dict[str, Any]
    curve: _Curve


class _Mode(_Part):
    curves: list[_Conditional] = []
    default_curve: _Curve
    is_electric: bool = False


class _EffortCurves(_Part):
    default_mode: str
    modes: Annotated[dict[str, _Mode], Field(min_length=1)]


class _Davis(_Part):
    type: Literal["davis"]
    A: NotNegative
    B: NotNegative
    C: NotNegative


class _Gamma(_Part):
    type: Literal["CONST", "MAX"]
    value: Positive


class _RollingStock(_Part):
    """Keys that are not known are passed over and listed."""

    name: str = Field(min_length=1)
    railjson_version: str
    mass: Positive
    length: Positive
    max_speed: Positive
    comfort_acceleration: Positive
    inertia_coefficient: Annotated[float, Field(ge=1.0, allow_inf_nan=False)]
    rolling_resistance: _Davis
    effort_curves: _EffortCurves
    gamma: _Gamma | None = None
    const_gamma: Positive | None = None

    @property
    def deceleration(self) -> float:
        """Of service braking [m/s²]."""
        if self.const_gamma is not None:
            return self.const_gamma
        if self.gamma is None:
            raise InputError("is missing", place="gamma", remedy="give the deceleration [m/s²]")
        return self.gamma.value

    def chosen(self, electrification: str | None) -> tuple[str, _Mode]:
        """The electrification and its efforts."""
        curves = self.effort_curves
        name = electrification or curves.default_mode
        if name not in curves.modes:
            raise InputError(
                f"has no tractive effort for electrification '{name}'",
                place="effort_curves.modes",
                remedy=f"choose one of {', '.join(curves.modes)}",
            )
        return name, curves.modes[name]

    def train(self, electrification: str | None) -> Train:
        """The train with the efforts of one electrification."""
        name, mode = self.chosen(electrification)
        curve = mode.default_curve.curve(f"effort_curves.modes.{name}.default_curve")
        rotating = self.inertia_coefficient - 1.0
        effort = float(curve.efforts.max())
        return Train(
            name=self.name,
            source=f"OSRD rolling stock (railjson {self.railjson_version}), electrification {name}",
            mass=self.mass,
            rotating_mass_factor=rotating,
            resistance=RunningResistance(
                self.rolling_resistance.A, self.rolling_resistance.B, self.rolling_resistance.C
            ),
            max_tractive_effort=effort,
            max_traction_power=curve.peak_power,
            max_pneumatic_braking_effort=self.deceleration * self.mass * self.inertia_coefficient,
            max_speed=self.max_speed,
            max_acceleration=self.comfort_acceleration,
            max_deceleration=self.deceleration,
            length=self.length,
            axles=assumed_axles(self.mass, effort, rotating),
            traction_curve=curve,
            assumed=_ASSUMED,
        )

    def dropped(self, electrification: str | None) -> list[str]:
        """What of the file the train does not hold, in words."""
        name, mode = self.chosen(electrification)
        others = [each for each in self.effort_curves.modes if each != name]
        found = [f"efforts of electrification {', '.join(others)}"] if others else []
        if mode.curves:
            conditions = sorted({key for each in mode.curves for key in each.cond})
            found.append(f"{len(mode.curves)} efforts by {', '.join(conditions)}")
        return found


def is_rolling_stock(content: Any) -> bool:
    """Whether JSON content looks like rolling stock of OSRD."""
    return isinstance(content, dict) and {"railjson_version", "effort_curves"} <= content.keys()


def read_train(path: str | Path, electrification: str | None = None) -> tuple[Train, list[str]]:
    """The train of a file of rolling stock, and what of the file it does not hold.

    The friction brake gives the deceleration that OSRD plans with; dynamic brake, axles and
    efficiencies are not published, and listed in the train's ``assumed``.

    Parameters
    ----------
    path : str or Path
    electrification : str, optional
        One of the file's; default: that which the file calls its default. Of its efforts those
        without a condition are taken (comfort, power restriction, electrical profile).

    Returns
    -------
    train : Train
    dropped : list of str

    Raises
    ------
    InputError
        If the file is no such rolling stock, or has no efforts for the electrification.

    Examples
    --------
    >>> read_train("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    content = read_json(path)
    if not is_rolling_stock(content):
        raise InputError(
            "is not rolling stock of OSRD",
            file=path,
            remedy="expected the keys 'railjson_version' and 'effort_curves'",
        )
    stock = checked(_RollingStock, content, path)
    train = built(lambda: stock.train(electrification), path)
    used = _RollingStock.model_fields.keys()
    unused = sorted(key for key in content if key not in used)
    dropped = stock.dropped(electrification)
    return train, dropped + ([f"keys {', '.join(unused)}"] if unused else [])
