"""Make the sample consists.

    python sample_logs/make_consists.py -o sample_logs

Vehicles and running resistance are restated from what each consist's `source` names; what is not
published is in its `assumed`.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from trainlog.formats.railtoolkit import RollingVehicle
from trainlog.formats.railway import write_consist
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import Consist, ConsistBrake, Coupler, Vehicle

# Amirhosseini et al. (2024), section 5: 350 t, 250 kN, eq. (35).
PAPER_MASS, PAPER_EFFORT = 350e3, 250e3
PAPER_RESISTANCE = RunningResistance(2_090.0, 39.0, 0.675)


def rounded(resistance: RunningResistance) -> RunningResistance:
    """A resistance rounded to what a textbook's formula can mean."""
    return RunningResistance(
        round(resistance.r0, 1), round(resistance.r1, 2), round(resistance.r2, 4)
    )


def paper(count: int) -> Consist:
    """The train of Amirhosseini et al. (2024) in `count` equal vehicles; as one it is a point."""
    share = 1.0 / count
    wagon = Vehicle(
        "train" if count == 1 else "wagon",
        mass=PAPER_MASS * share,
        length=1.0 if count == 1 else 25.0,
        resistance=PAPER_RESISTANCE.scaled(share),
        max_tractive_effort=PAPER_EFFORT * share,
        max_braking_effort=PAPER_EFFORT * share,
    )
    coupler = Coupler(stiffness=10e6, nonlinearity=200.0, damping=200e3)
    return Consist(
        "train of Amirhosseini et al. (2024)"
        if count == 1
        else f"train of Amirhosseini et al. (2024), {count} wagons",
        (wagon,) * count,
        (coupler,) * (count - 1),
        brake=ConsistBrake(0.0, 0.0),  # acts at once in the paper's simulation
        source="Amirhosseini et al. (2024), section 5"
        + (": a single particle, eq. (10)" if count == 1 else ": eqs. (2)-(8), equal wagons"),
        assumed=()
        if count == 1
        else ("couplers: the paper gives eq. (4) without numbers", "length", "distribution"),
    )


def freight() -> Consist:
    """An electric locomotive and 24 four-axle wagons, loaded and empty ones in blocks."""
    unit = RollingVehicle(
        name="unit",
        vehicle_type="traction unit",
        length=18.9,
        mass=85e3,
        mass_traction=85e3,
        base_resistance=0.0025,
        air_resistance=0.006,
    )
    locomotive = Vehicle(
        "electric locomotive",
        mass=85e3,
        length=18.9,
        resistance=rounded(unit.resistance(0.0)),
        rotating_mass=0.15 * 85e3,
        max_tractive_effort=300e3,
        max_traction_power=5.6e6,
        max_braking_effort=85e3 * 0.9,
    )

    def wagon(name: str, load: float) -> Vehicle:
        rolling = RollingVehicle(
            name=name,
            vehicle_type="freight",
            length=19.04,
            mass=25e3,
            load_limit=59e3,
            base_resistance=0.0014,
            air_resistance=0.0039,
        )
        mass = rolling.mass + load
        return Vehicle(
            name,
            mass=mass,
            length=rolling.length,
            resistance=rounded(rolling.resistance(load)),
            rotating_mass=0.04 * rolling.mass,
            max_braking_effort=0.75 * mass if load else 0.9 * mass,
        )

    full, empty = wagon("loaded wagon", 59e3), wagon("empty wagon", 0.0)
    coupler = Coupler(
        stiffness=5e6,
        nonlinearity=10.0,
        damping=150e3,
        slack=0.005,
        buffing_stiffness=5.2e6,
        buffing_nonlinearity=2.4,
    )
    vehicles = (locomotive, *(full,) * 10, *(empty,) * 6, *(full,) * 8)
    return Consist(
        "freight train, 24 wagons",
        vehicles,
        (coupler,) * (len(vehicles) - 1),
        brake=ConsistBrake(0.8, 7.0, 250.0),
        source="wagon: Facs 124 (25 t, 59 t load, 19.04 m) with Strahl's resistance, as in"
        " railtoolkit's rolling stock; locomotive: class 185 (85 t, 300 kN, 5.6 MW, 18.9 m)."
        " Couplers: side buffers of 105 mm stroke that store 30 kJ each (UIC 526-1, EN 15551,"
        " category A), two in parallel and two in series, 1.2 MN at the end of the stroke; draw"
        " gear and screw coupling of the 1 MN class (EN 15566), two draw gears in series. Brake:"
        " position G, cylinders filled in 18 to 30 s (UIC 540), 95 % after 3 lags; propagation"
        " 250 m/s.",
        assumed=(
            "couplers.stiffness and couplers.nonlinearity of the draw gear: 600 kN at 110 mm",
            "couplers.damping: viscous, for the friction of the ring springs; 0.16 of critical for"
            " two loaded wagons",
            "couplers.slack: loosely coupled",
            "vehicles.max_braking_effort: 0.75 m/s² loaded, 0.9 m/s² empty and locomotive",
            "vehicles.rotating_mass",
            "brake.dead_time",
        ),
    )


def passenger() -> Consist:
    """An electric locomotive and eight coaches, tightly coupled."""
    unit = RollingVehicle(
        name="unit",
        vehicle_type="traction unit",
        length=18.9,
        mass=84e3,
        mass_traction=84e3,
        base_resistance=0.0025,
        air_resistance=0.006,
    )
    locomotive = Vehicle(
        "electric locomotive",
        mass=84e3,
        length=18.9,
        resistance=rounded(unit.resistance(0.0)),
        rotating_mass=0.15 * 84e3,
        max_tractive_effort=300e3,
        max_traction_power=5.6e6,
        max_braking_effort=84e3 * 1.0,
    )
    rolling = RollingVehicle(
        name="coach",
        vehicle_type="passenger",
        length=26.8,
        mass=50e3,
        load_limit=8e3,
        base_resistance=0.002,
        rolling_resistance=0.000715,
        air_resistance=0.00364,
    )
    coach = Vehicle(
        "coach",
        mass=58e3,
        length=26.8,
        resistance=rounded(rolling.resistance(8e3)),
        rotating_mass=0.06 * 50e3,
        max_braking_effort=58e3 * 1.1,
    )
    coupler = Coupler(
        stiffness=8e6,
        nonlinearity=10.0,
        damping=200e3,
        buffing_stiffness=6e6,
        buffing_nonlinearity=2.5,
    )
    return Consist(
        "passenger train, 8 coaches",
        (locomotive, *(coach,) * 8),
        (coupler,) * 8,
        brake=ConsistBrake(0.5, 1.3, 280.0),
        source="coach: Twindexx Vario (26.8 m, 50 t, and 8 t of passengers), with Sauthoff's"
        " resistance; locomotive: Traxx P160 (84 t, 300 kN, 5.6 MW, 18.9 m), both as in"
        " railtoolkit's rolling stock. Couplers: screw couplings drawn"
        " tight until the buffers (110 mm stroke, EN 15551) touch, hence without slack. Brake:"
        " position R, cylinders filled in 3 to 5 s (UIC 540), 95 % after 3 lags; propagation"
        " 280 m/s.",
        assumed=(
            "couplers: stiffer than a freight train's, 0.2 of critical damping for two coaches",
            "vehicles.max_braking_effort: 1.1 m/s², locomotive 1.0 m/s²",
            "vehicles.rotating_mass",
            "brake.dead_time",
        ),
    )


def multiple_unit() -> Consist:
    """Eight cars, every other one powered, semi-permanent couplers, electric brake control."""

    def car(name: str, effort: float) -> Vehicle:
        return Vehicle(
            name,
            mass=52e3,
            length=25.0,
            resistance=RunningResistance(500.0, 6.0, 0.85),
            rotating_mass=0.06 * 52e3,
            max_tractive_effort=effort,
            max_traction_power=2e6 if effort else float("inf"),
            max_braking_effort=52e3 * 1.1,
        )

    motor, trailer = car("motor car", 75e3), car("trailer car", 0.0)
    coupler = Coupler(stiffness=40e6, nonlinearity=0.0, damping=800e3)
    return Consist(
        "electric multiple unit, 8 cars",
        (trailer, motor, motor, trailer, trailer, motor, motor, trailer),
        (coupler,) * 7,
        brake=ConsistBrake(0.3, 0.4),
        source="a long-distance multiple unit with distributed traction: 8 cars of 52 t and 25 m,"
        " 300 kN, 8 MW, electro-pneumatic brake on every car at once",
        assumed=(
            "all of it: rounded figures of the kind, not of one train",
            "couplers: semi-permanent, 40 MN/m, 0.4 of critical damping for two cars",
        ),
    )


CONSISTS = {
    "amirhosseini_2024.consist.json": lambda: paper(1),
    "amirhosseini_2024_8_wagons.consist.json": lambda: paper(8),
    "freight_24_wagons.consist.json": freight,
    "passenger_8_coaches.consist.json": passenger,
    "multiple_unit_8_cars.consist.json": multiple_unit,
}
"""The files by name."""


def make(output: Path) -> None:
    """Write the consists into the folder `output`."""
    output.mkdir(parents=True, exist_ok=True)
    for name, consist in CONSISTS.items():
        write_consist(consist(), output / name)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    make(parser.parse_args().output)
