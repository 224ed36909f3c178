"""What following a trajectory saved, as a table for people."""

from __future__ import annotations

from rich.console import Group

from analysis.comparison.cost import Comparison
from analysis.tables import kwh, new_table


def savings_table(found: Comparison) -> Group:
    """What following the trajectory saved, pair by pair and together."""
    pairs = found.pairs
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
    spent, saved = found.total_saved
    trips = "1 trip" if len(pairs) == 1 else f"{len(pairs)} trips"
    words = f"Saved on {trips}: {kwh(saved)} of {kwh(spent)}, {saved / spent:.1%};"
    words += f" {kwh(sum(pair.line for pair in pairs))} from the line; {running_times(found)}."
    return Group(table, words)


def running_times(found: Comparison) -> str:
    """Mean running times of both, in words."""
    driver, trajectory = found.running_times
    return f"{trajectory:.0f} s on the trajectory against {driver:.0f} s on average"
