"""The trains of a fleet: kinds, and vehicles that differ from their kind and from day to day.

A vehicle is more than its file says: it has a running resistance, a mass, brakes, wheels and a
recorder of its own. Wheels wear and are reprofiled, dirt gathers and is washed off, running gear
wears; faults come on a day, and may go on another. None of it is stated in a log's metadata.

Sizes: air drag is proportional to the air's density and grows with head wind as (v + w)², so that
15 K are 5 % of it and 1 m/s of wind at 25 m/s 8 %; running gear is stiffer in the cold, by some
per cent at 0 °C against 15 °C, and single trains of a kind differ by some per cent (P. Lukaszewicz
(2001), *Energy consumption and running time for trains*, KTH; B. P. Rochard and F. Schmid (2000),
A review of methods to measure and calculate train resistances, *Proc. IMechE F* 214, 185-199).
Wheels wear by a millimetre of diameter in 20,000 to 40,000 km and are turned every 150,000 to
250,000 km.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Literal, get_args

import numpy as np
import pandas as pd

from trainlog.errors import InputError
from trainlog.formats.railway import read_train
from trainlog.formats.samples import DEFAULT_TRAIN, sample
from trainlog.railway import EffortCurve, RunningResistance, Train
from trainlog.railway.train import Axles, Brake
from trainlog.simulation.sensors import Sensors
from trainlog.spans import utc
from trainlog.units import DAY, FORCE, KMH, MASS, SHARE, TIME, Measure, factor, keyed

FaultKind = Literal["dragging brake", "mass", "wheel diameter", "effort gain", "sensor delay"]

MEASURES: dict[FaultKind, Measure] = {
    "dragging brake": replace(FORCE, usual="", examples="2000N or 2kN"),
    "mass": replace(MASS, usual="", examples="3000kg or 3t"),
    "wheel diameter": replace(SHARE, examples="1% or 0.01"),
    "effort gain": replace(SHARE, examples="5% or 0.05"),
    "sensor delay": replace(TIME, usual="", examples="0.3s or 300ms"),
}
"""How each fault's size is written."""

_SHOWN_IN: dict[FaultKind, str] = {
    "dragging brake": "N", "mass": "kg", "wheel diameter": "%", "effort gain": "%",
    "sensor delay": "s",
}  # fmt: skip

LARGEST: dict[FaultKind, float] = {
    "dragging brake": 50e3,
    "mass": 50e3,
    "wheel diameter": 0.1,
    "effort gain": 0.5,
    "sensor delay": 5.0,
}
"""Sizes beyond which a fault is refused, in SI units."""

REFERENCE_TEMPERATURE = 288.15
"""Air temperature that running resistances are stated for [K]."""

COLD_SHARE = 0.003
"""By which resistance of the running gear grows for each kelvin below it."""

TRAIN_SPREAD = (0.06, 0.05, 0.045)
"""Standard deviations of the factors of the coefficients, between trains of a kind."""

TRIP_SPREAD = (0.015, 0.015, 0.008)
"""Between trips of a train, beside weather, dirt and wear."""

WEAR_SHARE, DIRT_SHARE = 0.04, 0.02
"""By which the running gear's part grows from one reprofiling to the next, and the air's from one
wash to the next."""

READINGS = 90
"""Days from one reading of a train's wheel diameters to the next."""


@dataclass(frozen=True, slots=True)
class Fault:
    """A fault of one train, from a time on, perhaps to another, on all of its trips or some.

    Attributes
    ----------
    train : str
    kind : {"dragging brake", "mass", "wheel diameter", "effort gain", "sensor delay"}
    size : float
        Dragging brake [N]; empty mass above what the file says [kg]; believed over true diameter,
        and recorded over true effort, less 1; delay of the recorded efforts [s], added to what
        the train's recorder has.
    start : int [ns since 1970 UTC]
    end : int, optional [ns since 1970 UTC]
        From which on it is gone.
    share : float
        Of the trips on which it shows, drawn trip by trip.

    Examples
    --------
    >>> import trainlog
    >>> fault = trainlog.TrainFault.of("train=flirt-03,dragging-brake=2000N,from=2026-10-12")
    >>> fault.kind, fault.size, fault.train
    ('dragging brake', 2000.0, 'flirt-03')
    """

    train: str
    kind: FaultKind
    size: float
    start: int
    end: int | None = None
    share: float = 1.0

    def __post_init__(self) -> None:
        if self.kind not in get_args(FaultKind):
            raise InputError(
                f"no such fault '{self.kind}'",
                remedy=f"it is one of {', '.join(get_args(FaultKind))}",
            )
        if not 0.0 < abs(self.size) <= LARGEST[self.kind]:
            raise InputError(
                f"fault of train '{self.train}': {self.kind} of {self.size:g}"
                f" {_SHOWN_IN[self.kind] if LARGEST[self.kind] > 1.0 else ''}".rstrip()
                + f" is not between 0 and {LARGEST[self.kind]:g}",
                remedy="check its unit",
            )
        if self.size < 0.0 and self.kind in ("dragging brake", "sensor delay"):
            raise InputError(
                f"fault of train '{self.train}': {self.kind} is negative", remedy="give its size"
            )
        if self.end is not None and self.end <= self.start:
            raise InputError(
                f"fault of train '{self.train}': ends before it begins",
                remedy="give a later to, or none",
            )
        if not 0.0 < self.share <= 1.0:
            raise InputError(
                f"fault of train '{self.train}': on {self.share:.0%} of its trips",
                remedy="give a share of more than 0 % and at most 100 %",
            )

    @property
    def words(self) -> str:
        """Its train, kind, size with its unit, first and last day, and share of the trips.

        Examples
        --------
        >>> import trainlog
        >>> fault = trainlog.TrainFault.of("train=flirt-03,dragging-brake=2kN,from=2026-10-12")
        >>> fault.words
        'flirt-03 dragging brake 2000 N from 2026-10-12'
        >>> of_words = trainlog.TrainFault.of
        >>> of_words("train=kiss-01,mass=3t,from=2026-10-12,to=2026-10-20,share=30%").words
        'kiss-01 mass 3000 kg from 2026-10-12 to 2026-10-20 on 30 % of its trips'
        """
        unit = _SHOWN_IN[self.kind]
        scale, _ = factor(unit, MEASURES[self.kind].unit)
        times = [pd.Timestamp(each, tz="UTC") for each in (self.start, self.end) if each]
        dates = [
            f"{each:%Y-%m-%d}" if each == each.normalize() else f"{each:%Y-%m-%d %H:%M} UTC"
            for each in times
        ]
        words = f"{self.train} {self.kind} {self.size / scale:g} {unit} from {' to '.join(dates)}"
        return words + f" on {100.0 * self.share:g} % of its trips" * (self.share < 1.0)

    @staticmethod
    def of(words: str) -> Fault:
        """A fault from ``train=flirt-03,dragging-brake=2000N,from=2026-10-12``.

        ``to=2026-10-20`` and ``share=30%`` may follow.

        Raises
        ------
        InputError
            If the text is not of that form.
        """
        remedy = "write it as train=flirt-03,dragging-brake=2000N,from=2026-10-12"
        known = {kind.replace(" ", "-"): kind for kind in get_args(FaultKind)}
        keys = ("train", "from", "to", "share", *known)
        given = keyed(words.split(","), keys, f"fault '{words}'", remedy)
        faults = [key for key in given if key in known]
        if "train" not in given or "from" not in given or len(faults) != 1:
            raise InputError(f"fault '{words}' needs a train, one fault and from", remedy=remedy)
        kind = known[faults[0]]
        times = dict[str, int]()
        for key in [each for each in ("from", "to") if each in given]:
            try:
                times[key] = int(utc(given[key]).value)
            except InputError:
                raise InputError(
                    f"fault '{words}': '{given[key]}' is not a date", remedy=remedy
                ) from None
        size = MEASURES[kind].read(given[faults[0]], f"fault '{words}': {faults[0]}")
        share = SHARE.read(given.get("share", "100%"), f"fault '{words}': share")
        return Fault(given["train"], kind, size, times["from"], times.get("to"), share)

    def shows(self, time: int, generator: np.random.Generator) -> bool:
        """Whether it shows on the trip that departs at a time [ns since 1970 UTC]."""
        there = self.start <= time and (self.end is None or time < self.end)
        return there and (self.share >= 1.0 or generator.random() < self.share)


@dataclass(frozen=True, slots=True)
class Recorder:
    """What a train's recorder holds, and how well.

    Attributes
    ----------
    sensors : Sensors
        Without what lasts of its wheels and efforts: that is the vehicle's.
    effort_gain : float
        Recorded over true effort.
    effort_delay : float [s]
    satellites, axles, acceleration, demands : bool
        Whether fixes, the single axles, the acceleration, and lever and demands are recorded.
    """

    sensors: Sensors
    effort_gain: float
    effort_delay: float
    satellites: bool
    axles: bool
    acceleration: bool
    demands: bool


@dataclass(frozen=True, slots=True)
class Condition:
    """What a vehicle is at a time.

    Attributes
    ----------
    resistance : RunningResistance
        In still air at `REFERENCE_TEMPERATURE`, a dragging brake included.
    mass : float [kg]
        Empty.
    wheel_factors : tuple of float
        Believed over true diameter, as `Sensors.wheel_factors`.
    effort_gain : float
    effort_delay : float [s]
    """

    resistance: RunningResistance
    mass: float
    wheel_factors: tuple[float, ...]
    effort_gain: float
    effort_delay: float


@dataclass(frozen=True, eq=False)
class FleetTrain:
    """One train of a fleet.

    Attributes
    ----------
    name, kind : str
    train : Train
        As its operator knows it: the kind's values under the vehicle's name.
    resistance : RunningResistance
        Of the clean train with fresh wheels, in still air at `REFERENCE_TEMPERATURE`.
    mass, rotating_mass : float [kg]
        Of the empty train.
    max_power : float [W]
    brake : Brake
    recorder : Recorder
    wear : dict of str to float
        ``daily_distance`` [m], ``reprofiled_every`` [m], ``reprofiled_at`` the start of time [m]
        before it, ``diameter_per_distance`` [1], ``washed_every`` and ``washed_at`` [d].
    axle_factors : tuple of float
        Of each powered axle's believed over true diameter, beside what all share.
    faults : tuple of Fault
    seed : int
    number : int
    """

    name: str
    kind: str
    train: Train
    resistance: RunningResistance
    mass: float
    rotating_mass: float
    max_power: float
    brake: Brake
    recorder: Recorder
    wear: dict[str, float]
    axle_factors: tuple[float, ...]
    faults: tuple[Fault, ...]
    seed: int
    number: int

    def at(self, time: int) -> Condition:
        """What the vehicle is at a time [ns since 1970 UTC]."""
        wear = self.wear
        days = time / DAY
        run = wear["daily_distance"] * days + wear["reprofiled_at"]
        cycle, since = divmod(run, wear["reprofiled_every"])
        worn = since / wear["reprofiled_every"]
        dirt = ((days + wear["washed_at"]) % wear["washed_every"]) / wear["washed_every"]
        rough = 1.0 + WEAR_SHARE * worn
        resistance = self.resistance.scaled(rough, rough, 1.0 + DIRT_SHARE * dirt)
        resistance += RunningResistance(self._fault("dragging brake", time), 0.0, 0.0)
        # Diameters are read when wheels are turned and every few months; they wear in between.
        period = wear["daily_distance"] * READINGS
        reading, after = divmod(since, period)
        misread = np.random.default_rng([self.seed, 32, self.number, int(cycle), int(reading)])
        diameter = 2.0 * self.train.axles.wheel_radius
        common = 1.0 + 6e-4 * misread.standard_normal()
        common *= 1.0 + wear["diameter_per_distance"] * after / diameter
        common *= 1.0 + self._fault("wheel diameter", time)
        return Condition(
            resistance,
            self.mass + self._fault("mass", time),
            (float(common), *(float(common) * each for each in self.axle_factors)),
            self.recorder.effort_gain * (1.0 + self._fault("effort gain", time)),
            self.recorder.effort_delay + self._fault("sensor delay", time),
        )

    def _fault(self, kind: FaultKind, time: int) -> float:
        """Size of the faults of a kind that there are at a time."""
        found = 0.0
        for number, each in enumerate(self.faults):
            drawn = np.random.default_rng([self.seed, 34, self.number, number, time])
            found += each.size * (each.kind == kind and each.shows(time, drawn))
        return found

    def truth(self) -> dict[str, Any]:
        """What the vehicle is, for the file of a fleet's truth."""
        return {
            "name": self.name,
            "kind": self.kind,
            **self.resistance.terms,
            "mass": self.mass,
            "rotating_mass": self.rotating_mass,
            "max_power": self.max_power,
            "brake": asdict(self.brake),
            "recorder": asdict(self.recorder) | {"sensors": self.recorder.sensors.known()},
            "wear": self.wear,
            "axle_factors": list(self.axle_factors),
            "faults": [
                {
                    "kind": each.kind,
                    "size": each.size,
                    "from": pd.Timestamp(each.start, tz="UTC").isoformat(),
                    **({"to": pd.Timestamp(each.end, tz="UTC").isoformat()} if each.end else {}),
                    **({"share": each.share} if each.share < 1.0 else {}),
                }
                for each in self.faults
            ],
        }


def resistance_of_trip(
    known: RunningResistance, temperature: float, head_wind: float, generator: np.random.Generator
) -> RunningResistance:
    """A vehicle's running resistance on one trip.

    Air drag goes with the air's density (pressure varies by 1 %) and with the square of the speed
    against the wind; the running gear is stiffer in the cold.

    Parameters
    ----------
    known : RunningResistance
        In still air at `REFERENCE_TEMPERATURE`.
    temperature : float [K]
    head_wind : float [m/s]
        Against the train, on average over the trip.
    generator : numpy.random.Generator
    """
    own = 1.0 + np.array(TRIP_SPREAD) * np.clip(generator.standard_normal(3), -2.5, 2.5)
    density = REFERENCE_TEMPERATURE / temperature * (1.0 + 0.008 * generator.standard_normal())
    cold = 1.0 + COLD_SHARE * max(REFERENCE_TEMPERATURE - temperature, 0.0)
    return known.scaled(cold, cold, density).scaled(*own).in_wind(head_wind)


def kinds() -> dict[str, Train]:
    """The three kinds of train of a fleet.

    ``flirt``: the sample's multiple unit of four cars. ``kiss``: the double-deck multiple unit
    CH_Stadler_KISS_SBB of TTOBench (Kouzoupis; BSD-2-Clause). ``traxx``: an electric locomotive
    and five double-deck coaches of railtoolkit's rolling stock (CC-BY-4.0), Bombardier Traxx 2
    (P160), four DABpza, one DBpbzfa, with the running resistance that follows from them. What is
    not published there is listed in their `assumed`.
    """
    flirt = read_train(sample(DEFAULT_TRAIN))
    kiss = Train(
        name="CH_Stadler_KISS_SBB",
        mass=297e3,
        rotating_mass_factor=0.1,
        resistance=RunningResistance(5672.025, 25.449525 * KMH, 1.21104 * KMH**2),
        max_tractive_effort=400e3,
        max_traction_power=6e6,
        max_dynamic_braking_effort=400e3,
        max_dynamic_braking_power=6e6,
        max_pneumatic_braking_effort=2970e3,
        max_speed=160.0 / KMH,
        max_acceleration=1.1,
        max_deceleration=1.1,
        efficiency_traction=0.9,
        efficiency_regeneration=0.9,
        max_load=60e3,
        length=150.0,
        axles=Axles(count=8, adhesive_mass=150e3, wheel_radius=0.46, rotating_mass=2_400.0),
        brake=Brake(0.6, 0.5),
        seats=535,
        coaches=6,
        source="library TTOBench v1.3; created by Dimitris Kouzoupis; license BSD 2-Clause License",
        assumed=("length", "max_load", "axles", "brake"),
    )
    speeds = np.array([0.0, *range(66, 161, 2)])
    # 300 kN up to the speed at which the locomotive has its 5542 kW.
    efforts = np.minimum(300e3, 19_950e3 / np.maximum(speeds, 1.0))
    traxx = Train(
        name="DE_Traxx_5_double_deck",
        mass=343e3,
        rotating_mass_factor=0.0674,
        resistance=RunningResistance(7466.44, 218.679, 18.4238),
        max_tractive_effort=300e3,
        max_traction_power=19_950e3 / KMH,
        max_dynamic_braking_effort=150e3,
        max_dynamic_braking_power=19_950e3 / KMH,
        max_pneumatic_braking_effort=380e3,
        max_speed=160.0 / KMH,
        max_acceleration=0.8,
        max_deceleration=0.9,
        efficiency_traction=0.85,
        efficiency_regeneration=0.8,
        max_load=100e3,
        length=153.4,
        axles=Axles(count=4, adhesive_mass=85e3, wheel_radius=0.625, rotating_mass=2_600.0),
        brake=Brake(1.2, 1.2),
        traction_curve=EffortCurve(speeds / KMH, efforts),
        coaches=5,
        source="railtoolkit rolling stock (https://railtoolkit.org/schema/), CC-BY-4.0:"
        " Bombardier_Traxx_2_P160, 4 DABpza68, DABpza668",
        assumed=(
            "max_acceleration",
            "max_deceleration",
            "max_dynamic_braking_effort",
            "max_dynamic_braking_power",
            "max_pneumatic_braking_effort",
            "efficiency_traction",
            "efficiency_regeneration",
            "axles",
            "brake",
        ),
    )
    return {"flirt": flirt, "kiss": kiss, "traxx": traxx}


SHARES = {"flirt": 0.4, "kiss": 0.3, "traxx": 0.3}
"""Of the trains of a fleet, by kind."""


def draw_trains(count: int, seed: int, faults: Sequence[Fault] = ()) -> tuple[FleetTrain, ...]:
    """Draw the trains of a fleet; the same seed draws the same ones, whatever their faults.

    Raises
    ------
    InputError
        If `count` is not between 1 and 999, or a fault is that of another train.

    Examples
    --------
    >>> [each.name for each in draw_trains(4, seed=1)]
    ['flirt-01', 'kiss-01', 'traxx-01', 'flirt-02']
    """
    if not 1 <= count <= 999:
        raise InputError(f"cannot draw {count} trains", remedy="give 1 to 999")
    known, numbers = kinds(), dict.fromkeys(SHARES, 0)
    found = []
    for number in range(count):
        # Whatever the count, each kind has its share: the next is of the kind that lacks most.
        kind = max(SHARES, key=lambda name: SHARES[name] * (number + 1) - numbers[name])
        numbers[kind] += 1
        name = f"{kind}-{numbers[kind]:02d}"
        own = tuple(each for each in faults if each.train == name)
        found.append(_drawn(name, kind, known[kind], own, seed, number))
    names = [each.name for each in found]
    for fault in faults:
        if fault.train not in names:
            raise InputError(
                f"fault of train '{fault.train}': the fleet has no such train",
                remedy=f"it has {', '.join(names)}",
            )
    return tuple(found)


def _drawn(
    name: str, kind: str, train: Train, faults: tuple[Fault, ...], seed: int, number: int
) -> FleetTrain:
    """One train, by numbers of its own."""
    generator = np.random.default_rng([seed, 31, number])
    spread = np.array(TRAIN_SPREAD) * np.clip(generator.standard_normal(3), -2.2, 2.2)
    nominal = train.resistance
    every = float(generator.uniform(150e6, 250e6))
    wear = {
        "daily_distance": float(generator.uniform(250e3, 450e3)),
        "reprofiled_every": every,
        "reprofiled_at": float(generator.uniform(0.0, every)),
        "diameter_per_distance": float(1e-3 / generator.uniform(20e6, 40e6)),
        "washed_every": float(generator.uniform(9.0, 16.0)),
        "washed_at": float(generator.uniform(0.0, 16.0)),
    }
    weighs = generator.uniform() < 0.7
    sensors = Sensors(
        speed_noise=float(generator.uniform(0.015, 0.05)),
        acceleration_noise=float(generator.uniform(0.02, 0.05)),
        effort_noise=float(generator.uniform(0.005, 0.015)),
        effort_resolution=float(generator.choice((100.0, 200.0, 500.0))),
        diameter_error=4e-4,
        gnss_position_noise=float(generator.uniform(1.5, 4.0)),
        load_error=float(generator.uniform(0.015, 0.035)) if weighs else None,
    )
    recorder = Recorder(
        sensors,
        effort_gain=1.0 + 0.015 * float(np.clip(generator.standard_normal(), -2.0, 2.0)),
        effort_delay=float(np.round(generator.uniform(0.0, 0.3), 2)),
        satellites=bool(generator.uniform() < 0.8),
        axles=bool(generator.uniform() < 0.8),
        acceleration=bool(generator.uniform() < 0.8),
        demands=bool(generator.uniform() < 0.85),
    )
    return FleetTrain(
        name,
        kind,
        replace(train, name=name),
        nominal.scaled(*(1.0 + spread)),
        mass=train.mass * (1.0 + 0.007 * float(np.clip(generator.standard_normal(), -2.0, 2.0))),
        rotating_mass=train.rotating_mass * float(generator.uniform(0.96, 1.04)),
        max_power=train.max_traction_power * float(generator.uniform(0.95, 1.0)),
        brake=Brake(
            float(np.round(train.brake.dead_time * generator.uniform(0.85, 1.2), 2)),
            float(np.round(train.brake.lag * generator.uniform(0.85, 1.2), 2)),
        ),
        recorder=recorder,
        wear=wear,
        axle_factors=tuple(
            1.0 + 3e-4 * float(each) for each in generator.standard_normal(train.axles.count)
        ),
        faults=faults,
        seed=seed,
        number=number,
    )
