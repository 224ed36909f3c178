"""What following a trajectory saved, as a table for people."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from rich.console import Group

from analysis.comparison.cost import Saving
from analysis.tables import kwh, new_table


def savings_table(pairs: Sequence[Saving]) -> Group:
    """What following the trajectory saved, pair by pair and together."""
    title = "Tractive energy at the wheel rims, running time, how often slip protection acted"
    table = new_table(
        title, "trip", "driver", "trajectory", "saved", "from the line", "behind it", "slips"
    )
    for pair in pairs:
        driver, own = pair.driver, pair.trajectory
        table.add_row(
            driver.name,
            f"{kwh(driver.traction)}, {driver.running_time:.0f} s",
            f"{kwh(own.traction)}, {own.running_time:.0f} s",
            f"{kwh(pair.traction)}, {pair.traction / driver.traction:.1%}",
            kwh(pair.line),
            "-" if own.late is None else f"{own.late:+.1f} s",
            " / ".join("-" if each.slips is None else f"{each.slips}" for each in (driver, own)),
        )
    spent, saved = total_saved(pairs)
    trips = "1 trip" if len(pairs) == 1 else f"{len(pairs)} trips"
    words = f"Saved on {trips}: {kwh(saved)} of {kwh(spent)}, {saved / spent:.1%};"
    words += f" {kwh(sum(pair.line for pair in pairs))} from the line; {running_times(pairs)}."
    return Group(table, words)


def total_saved(pairs: Sequence[Saving]) -> tuple[float, float]:
    """Tractive work of the drivers, and what the trajectory saved of it [J]."""
    return sum(pair.driver.traction for pair in pairs), sum(pair.traction for pair in pairs)


def running_times(pairs: Sequence[Saving]) -> str:
    """Mean running times of both, in words."""
    driver = np.mean([pair.driver.running_time for pair in pairs])
    trajectory = np.mean([pair.trajectory.running_time for pair in pairs])
    return f"{trajectory:.0f} s on the trajectory against {driver:.0f} s on average"
