"""The format ``"trainlog/passport"``: the passport of a recorded trip, attached to its log."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

import numpy as np
from pydantic import Field

from trainlog.formats.schema import File, Part, built
from trainlog.railway.passport import Passport, Quantity, Source


class _QuantityPart(Part):
    value: float | None = None
    std: float | None = None
    source: Source
    reason: str = ""

    def quantity(self) -> Quantity:
        """The quantity that the part describes; NaN what is missing."""
        value, std = (np.nan if each is None else each for each in (self.value, self.std))
        return Quantity(value, std, self.source, self.reason)

    @staticmethod
    def of(quantity: Quantity) -> _QuantityPart:
        """The part that describes a quantity."""
        value, std = (
            float(each) if np.isfinite(each) else None for each in (quantity.value, quantity.std)
        )
        return _QuantityPart.model_construct(
            value=value, std=std, source=quantity.source, reason=quantity.reason
        )


class _PassportFile(File):
    FORMAT: ClassVar[str] = "trainlog/passport"

    trip: str
    effort_delay: _QuantityPart
    effort_gain: _QuantityPart
    mass: _QuantityPart
    load: _QuantityPart
    effort_over_mass: _QuantityPart
    axle_effort_ratio: _QuantityPart
    speed_noise: dict[str, _QuantityPart] = Field(default_factory=dict)
    wheel_factor: list[_QuantityPart] = Field(default_factory=list)
    sample_time: dict[str, float] = Field(default_factory=dict)
    findings: list[str] = Field(default_factory=list)
    creep_lead: _QuantityPart | None = None

    def passport(self) -> Passport:
        """The passport that the file describes."""
        single = {name: getattr(self, name).quantity() for name in _SINGLE}
        return Passport(
            trip=self.trip,
            **single,
            speed_noise={name: part.quantity() for name, part in self.speed_noise.items()},
            wheel_factor=tuple(part.quantity() for part in self.wheel_factor),
            sample_time=self.sample_time,
            findings=tuple(self.findings),
            **({} if self.creep_lead is None else {"creep_lead": self.creep_lead.quantity()}),
        )

    @staticmethod
    def of(passport: Passport) -> _PassportFile:
        """The file that describes a passport."""
        return _PassportFile.holding(
            passport,
            **{name: _QuantityPart.of(getattr(passport, name)) for name in _SINGLE},
            speed_noise={n: _QuantityPart.of(each) for n, each in passport.speed_noise.items()},
            wheel_factor=[_QuantityPart.of(each) for each in passport.wheel_factor],
            sample_time=dict(passport.sample_time),
            findings=list(passport.findings),
            creep_lead=_QuantityPart.of(passport.creep_lead) if passport.creep_lead.value else None,
        )


_SINGLE = (
    "effort_delay",
    "effort_gain",
    "mass",
    "load",
    "effort_over_mass",
    "axle_effort_ratio",
)
"""Fields that hold one quantity each."""


def passport_from_bytes(data: bytes, *, file: str | Path = "passport.json") -> Passport:
    """The passport in the bytes of its file; `file` is what errors call it.

    Raises
    ------
    InputError
        If they are not a passport file, naming the place and the remedy.

    Examples
    --------
    >>> passport_from_bytes(b"")
    Traceback (most recent call last):
    trainlog.errors.InputError: passport.json: is empty; expected JSON
    """
    return built(_PassportFile.from_bytes(data, file).passport, file)


def passport_to_bytes(passport: Passport) -> bytes:
    """The bytes of the passport's file: doubles exact, the same passport gives the same bytes.

    Examples
    --------
    >>> unknown = Quantity(float("nan"), float("nan"), "assumed", "no efforts recorded")
    >>> passport = Passport("trip 1", *6 * [unknown])
    >>> passport_from_bytes(passport_to_bytes(passport)).effort_gain.reason
    'no efforts recorded'
    """
    return _PassportFile.of(passport).to_bytes()
