"""The passport of a recorded trip: what its recorder lacks or gets wrong, with uncertainties."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Annotated, ClassVar, Literal

import numpy as np

from trainlog.declaration import ByName, Declared, Many, Number, Text, check
from trainlog.errors import InputError

Source = Literal["recorded", "estimated", "assumed"]
"""``"recorded"``: stated with the trip. ``"estimated"``: from the trip's own samples, and what was
assumed beforehand. ``"assumed"``: what holds for such trains; the trip does not show it."""


@dataclass(frozen=True, slots=True)
class Quantity:
    """A value of a passport with its standard deviation.

    Attributes
    ----------
    value : float
        NaN where there is none.
    std : float
        Standard deviation, in the value's unit; NaN where there is no value.
    source : {"recorded", "estimated", "assumed"}
    reason : str
        Why it was not estimated, where it is assumed.

    Examples
    --------
    >>> Quantity(2.0, 0.5, "estimated").band
    (1.02, 2.98)
    """

    value: Annotated[float, Number(gaps=True)]
    std: Annotated[float, Number(gaps=True)]
    source: Source
    reason: Annotated[str, Text(stated="written")] = ""

    def __post_init__(self) -> None:
        check(self)
        if self.std < 0.0:
            raise InputError(f"standard deviation {self.std} is negative", remedy="give 0 or more")

    @property
    def known(self) -> bool:
        """Whether there is a value."""
        return bool(np.isfinite(self.value))

    @property
    def band(self) -> tuple[float, float]:
        """Lower and upper end of the 95 % band."""
        return self.value - 1.96 * self.std, self.value + 1.96 * self.std

    def text(self, unit: str = "", factor: float = 1.0, digits: int = 2) -> str:
        """The value with its 95 % band, where it is from, and why it was not estimated.

        Examples
        --------
        >>> Quantity(140e3, 1e3, "estimated").text("t", 1e-3, 1)
        '140.0 ± 2.0 t, estimated'
        """
        ending = f": {self.reason}" if self.reason else ""
        if not self.known:
            return f"not known{ending}"
        size = f"{factor * self.value:.{digits}f} ± {1.96 * factor * self.std:.{digits}f}"
        return f"{f'{size} {unit}'.rstrip()}, {self.source}{ending}"


@dataclass(frozen=True, eq=False, repr=False)
class Passport(Declared):
    """What is known of a recorded trip beside its samples.

    Attributes
    ----------
    trip : str
    effort_delay : Quantity [s]
        By how much recorded efforts are late relative to the recorded motion.
    effort_gain : Quantity [1]
        Recorded over true effort, in total.
    mass : Quantity [kg]
        Of the loaded train, without the rotating part.
    load : Quantity [kg]
        Mass above that of the empty train.
    effort_over_mass : Quantity [1]
        Effort gain times the true mass, over the mass of the empty train: what the motion shows
        even where gain and load cannot be separated.
    axle_effort_ratio : Quantity [1]
        Sum of the recorded efforts of the powered axles over the recorded effort of the train.
    speed_noise : dict of str to Quantity [m/s]
        Noise of each recorded speed, by its column (``"/train/state.speed"``,
        ``"/train/axles.wheel_speed_1"``).
    wheel_factor : tuple of Quantity [1]
        Recorded over true speed of each recorded axle: a wrong wheel diameter.
    sample_time : dict of str to float [s]
        Median time between samples, by topic.
    findings : tuple of str
        What a reader should know, in sentences.
    creep_lead : Quantity [s]
        By how much efforts seem early to the motion, as wheels whose speeds are not recorded creep;
        `effort_delay` is without it, and its uncertainty is in that of `effort_delay`. 0 where the
        speeds of all powered wheels are recorded.

    Examples
    --------
    >>> from analysis import passport
    >>> found = passport("sample_logs/stopping.mcap")
    >>> len(found.wheel_factor), found.load.source
    (4, 'recorded')
    """

    FORMAT: ClassVar[str] = "trainlog/passport"

    trip: str
    effort_delay: Quantity
    effort_gain: Quantity
    mass: Quantity
    load: Quantity
    effort_over_mass: Quantity
    axle_effort_ratio: Quantity
    speed_noise: Annotated[Mapping[str, Quantity], ByName(stated="written")] = field(
        default_factory=dict
    )
    wheel_factor: Annotated[tuple[Quantity, ...], Many(stated="written")] = ()
    sample_time: Annotated[Mapping[str, float], ByName(stated="written")] = field(
        default_factory=dict
    )
    findings: Annotated[tuple[str, ...], Many(stated="written")] = ()
    creep_lead: Quantity = Quantity(0.0, 0.0, "recorded")

    @property
    def motion_delay(self) -> Quantity:
        """Delay [s] by which the efforts fit the recorded motion: `effort_delay` less `creep_lead`.

        The uncertainty of the lead is not in it.
        """
        late, lead = self.effort_delay, self.creep_lead
        std = float(np.sqrt(max(late.std**2 - lead.std**2, 0.0))) if late.known else late.std
        return replace(late, value=late.value - lead.value, std=std)

    @property
    def title(self) -> str:
        """Of which trip."""
        return f"Passport of trip '{self.trip}'"

    def summary(self) -> dict[str, str]:
        """Each quantity in words, by its name."""
        lead = {"creep lead": self.creep_lead.text("s")} if self.creep_lead.value else {}
        rows = {
            "±": "half the 95 % band, 1.96 standard deviations",
            "effort delay": self.effort_delay.text("s"),
            **lead,
            "effort gain": self.effort_gain.text(digits=3),
            "mass": self.mass.text("t", 1e-3, 1),
            "load": self.load.text("t", 1e-3, 1),
            "effort over mass": self.effort_over_mass.text(digits=3),
            "axle effort ratio": self.axle_effort_ratio.text(digits=3),
        }
        if self.speed_noise:
            rows["speed noise"] = _speeds(self.speed_noise)
        if self.wheel_factor:
            rows["wheel factors"] = ", ".join(
                f"{each.value:.4f} ± {1.96 * each.std:.4f}" if each.known else "not known"
                for each in self.wheel_factor
            )
        if self.sample_time:
            rows["sample times"] = ", ".join(
                f"{topic} {step:.3g} s" for topic, step in self.sample_time.items()
            )
        return rows | {
            f"finding {number}": each for number, each in enumerate(self.findings, start=1)
        }


def _speeds(noise: Mapping[str, Quantity]) -> str:
    """The noise of each recorded speed; of the axles the largest."""
    shown: dict[str, float] = {}
    for column, each in noise.items():
        topic = column.partition(".")[0]
        if each.known:
            shown[topic] = max(shown.get(topic, 0.0), each.value)
    return ", ".join(f"{topic} {value:.3f} m/s" for topic, value in shown.items()) or "not known"
