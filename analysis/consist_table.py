"""What a consist is, as tables."""

from __future__ import annotations

from itertools import groupby
from typing import TypeVar

import numpy as np

from trainlog.presentation import WordTable, new_table
from trainlog.railway.consist import Consist, Coupler, Vehicle
from trainlog.units import KMH

Thing = TypeVar("Thing", Vehicle, Coupler)


def consist_tables(consist: Consist) -> list[WordTable]:
    """A consist as a person reads it: its vehicles, couplers and brake; equal ones together."""
    return [
        _overview(consist),
        _vehicles(consist),
        *([_couplers(consist)] if consist.couplers else []),
    ]


def _overview(consist: Consist) -> WordTable:
    table = new_table(consist.name, "quantity", "value", name="consist", show_header=False)
    table.add_row("vehicles", f"{len(consist.vehicles)}, {consist.length:.1f} m over couplers")
    rotating = sum(vehicle.rotating_mass for vehicle in consist.vehicles)
    table.add_row("mass", f"{consist.mass / 1e3:.1f} t, rotating part {rotating / 1e3:.1f} t")
    pulling = sum(vehicle.max_tractive_effort > 0.0 for vehicle in consist.vehicles)
    effort = consist.max_tractive_effort / 1e3
    table.add_row("traction", f"{effort:.0f} kN of {pulling} vehicle{'s' * (pulling != 1)}")
    brake, slowest = consist.brake, consist.dead_times.max()
    table.add_row(
        "brake",
        f"{consist.max_braking_effort / 1e3:.0f} kN, dead time {brake.dead_time:g} s at the front"
        f" and {slowest:.3g} s at the rear, lag {brake.lag:g} s",
    )
    resistance = consist.resistance
    at = ", ".join(f"{resistance(speed / KMH) / 1e3:.1f} kN at {speed} km/h" for speed in (50, 100))
    table.add_row("resistance", at)
    if consist.source:
        table.add_row("source", consist.source)
    for assumption in consist.assumed:
        table.add_row("assumed", assumption)
    return table


def _vehicles(consist: Consist) -> WordTable:
    table = new_table("Vehicles", "", "vehicle", "t", "m", "traction kN", "kW", "brake kN")
    for span, vehicle in _runs(consist.vehicles):
        power = vehicle.max_traction_power
        table.add_row(
            span,
            vehicle.name,
            f"{vehicle.mass / 1e3:.1f}",
            f"{vehicle.length:.1f}",
            f"{vehicle.max_tractive_effort / 1e3:.0f}" if vehicle.max_tractive_effort else "",
            f"{power / 1e3:.0f}" if vehicle.max_tractive_effort and np.isfinite(power) else "",
            f"{vehicle.max_braking_effort / 1e3:.0f}" if vehicle.max_braking_effort else "",
        )
    return table


def _couplers(consist: Consist) -> WordTable:
    table = new_table("Couplers", "", "draft MN/m", "1/m²", "buff MN/m", "1/m²", "kN s/m", "slack")
    for span, coupler in _runs(consist.couplers):
        numbers = (*coupler.draft, *coupler.buff)
        scales = (1e6, 1.0, 1e6, 1.0)
        table.add_row(
            span,
            *(f"{number / scale:g}" for number, scale in zip(numbers, scales, strict=True)),
            f"{coupler.damping / 1e3:g}",
            f"{coupler.slack * 1e3:g} mm",
        )
    return table


def _runs(things: tuple[Thing, ...]) -> list[tuple[str, Thing]]:
    """Each thing that differs from the one before, with the numbers of its equals."""
    found, first = [], 1
    for thing, group in groupby(things):
        last = first + len(list(group)) - 1
        found.append((f"{first}" if first == last else f"{first} to {last}", thing))
        first = last + 1
    return found
