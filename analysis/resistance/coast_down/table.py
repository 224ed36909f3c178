"""What coasting showed, as tables for people: km/h, per mille, N/t."""

from __future__ import annotations

import numpy as np
from rich.console import Group
from rich.table import Table

from analysis.reporting import new_table
from analysis.resistance.coast_down import CoastDown
from trainlog.formats.parameters import CoastDownResult
from trainlog.units import GRAVITY, KMH, PER_MILLE


def coast_down_table(found: CoastDown) -> Group:
    """Each trip's coasting, the common curve with its band, and what was refused."""
    table = new_table(
        f"Coasting of {found.train or 'a train'}",
        "trip",
        "speed from",
        "segments",
        "coasted",
        "km/h",
        "windows",
        "off by",
    )
    for fit in found.trips:
        low, high = fit.curve.covered
        speed = np.linspace(low, high, 21)
        share = float(np.min(fit.curve.share(speed)))
        table.add_row(
            fit.trip,
            fit.source,
            f"{len(fit.segments)}" + (f" ({len(fit.strays)} strays)" if fit.strays else ""),
            f"{fit.coasted:.0f} s",
            f"{KMH * low:.0f} to {KMH * high:.0f}",
            f"{fit.windows['used']}",
            f"{196.0 * share:.1f} %" if np.isfinite(share) else "-",
        )
    words = [
        "'Off by' is half the 95 % interval of the trip's own curve where it is known best.",
        _ratio(found),
    ]
    words += [f"refused: {reason}" for reason in found.refused.values()]
    return Group(table, _curve(found), *words)


def without_gradient_table(result: CoastDownResult) -> Group:
    """What is identified with the gradient unknown, and why the rest is not."""
    table = new_table(
        "Running resistance over inertia, gradient unknown", "quantity", "unit", "value", ""
    )
    for each in result.quantities:
        told = "not identified"
        if each.value is not None and each.std is not None:
            told = f"{each.value:.3g} ± {1.96 * each.std:.2g}"
        table.add_row(each.name, each.unit, told, each.reason or "")
    words = [f"{len(result.pieces)} pieces of track were coasted more than once."]
    words += [f"refused: {trip['reason']}" for trip in result.trips if not trip["accepted"]]
    if result.curve is not None:
        low, high = (KMH * float(result.curve.speeds[end]) for end in (0, -1))
        words.append(f"The whole curve is supported from {low:.0f} to {high:.0f} km/h.")
    return Group(table, *words)


def _curve(found: CoastDown) -> Table:
    """The common curve at rounded speeds."""
    curve = found.curve
    low, high = curve.supported or curve.covered
    table = new_table(
        "Running resistance of the coasting train, with its 95 % band",
        "km/h",
        "over inertia [m/s²]",
        "over weight [per mille]",
        "over mass [N/t]",
    )
    at = np.arange(np.ceil(KMH * low / 10.0) * 10.0, KMH * high + 1e-9, 10.0) / KMH
    for speed in at if at.size else np.array([0.5 * (low + high)]):
        value, (below, above) = float(curve(speed)), curve.band(speed)
        weight, std = (float(part) for part in curve.per_weight(speed))
        reach = 0.5 * float(above - below)
        factor = reach / float(curve.std(speed))
        table.add_row(
            f"{KMH * speed:.0f}",
            f"{value:.4f} ± {reach:.4f}",
            f"{PER_MILLE * weight:.2f} ± {PER_MILLE * factor * std:.2f}",
            f"{1e3 * GRAVITY * weight:.1f} ± {1e3 * GRAVITY * factor * std:.1f}",
        )
    return table


def _ratio(found: CoastDown) -> str:
    ratio = found.ratio
    origin = {
        "data": "told by how the train coasts on different gradients",
        "train file": "expected from the train's file; the data do not tell it better",
        "any train": "assumed, as no train file is there; the data do not tell it better",
    }[ratio.source]
    return (
        f"Mass over inertia {ratio.value:.3f} ± {1.96 * ratio.std:.3f}: {origin}. The columns over"
        " weight and over mass rest on it."
    )
