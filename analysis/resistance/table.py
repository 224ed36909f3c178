"""Running resistance as tables for people: of the fits, and of what coasting showed."""

from __future__ import annotations

import numpy as np
from rich.console import Group
from rich.table import Table

from analysis.resistance.coast_down import CoastDown
from analysis.resistance.logs import Fits
from analysis.resistance.regression import diagnosed
from analysis.tables import new_table, with_band
from trainlog.formats.parameters import CoastDownResult
from trainlog.units import GRAVITY, KMH, PER_MILLE


def fit_table(fits: Fits) -> Group:
    """Running resistance of each trip and of all together, with what it rests on."""
    title = f"Running resistance of {fits.common.train}: N, N/(m/s), N/(m/s)²"
    table = new_table(
        title, "trip", "r0", "r1", "r2", "mass", "power, kW", "kN at 80 km/h", "windows"
    )
    at = 80.0 / KMH
    for fit in fits.trips:
        table.add_row(
            fit.trip,
            *(
                with_band(b, s)
                for b, s in zip(fit.beta, np.sqrt(np.diag(fit.covariance)), strict=False)
            ),
            f"{fit.mass / 1e3:.1f} ± {1.96 * fit.mass_std / 1e3:.1f} t",
            "-"
            if fit.max_power is None or fit.max_power_std is None
            else with_band(fit.max_power / 1e3, fit.max_power_std / 1e3),
            with_band(float(fit.resistance(at)) / 1e3, float(fit.std(at)) / 1e3),
            f"{fit.windows['used']}",
        )
    common = fits.common
    beta = (common.resistance.r0, common.resistance.r1, common.resistance.r2)
    table.add_section()
    table.add_row(
        "together",
        *(with_band(b, s) for b, s in zip(beta, np.sqrt(np.diag(common.covariance)), strict=True)),
        "",
        "",
        with_band(float(common.resistance(at)) / 1e3, float(common.std(at)) / 1e3),
        f"{sum(fit.windows['used'] for fit in fits.trips)}",
    )
    low, high = common.speed_range
    words = [
        "± is the 95 % band; a power is given where a trip reached it. Supported from"
        f" {low * KMH:.0f} to {high * KMH:.0f} km/h. The single coefficients are strongly"
        " correlated: trust the curve.",
    ]
    for fit in fits.trips:
        words += [f"{fit.trip}: {doubt}" for doubt in diagnosed(fit.residuals).doubts]
    words += [f"refused, {error.reason}: {error}" for error in fits.refused.values()]
    words += _observed_set(fits)
    return Group(table, *words)


def _observed_set(fits: Fits) -> list[str]:
    """What the observed set stands for."""
    found = fits.parameters
    words = (
        f"{len(found.configurations)} configurations stand for {found.cover['trips']} trips: their"
        f" worst case bounds {found.cover['level']:.1%} of trips like these"
    )
    if found.cover["level"] < found.cover["asked"]:
        words += f", fewer than the {found.cover['asked']:.1%} asked for"
    known = f"{fits.known} logs were not read: their summaries are known." if fits.known else ""
    return [f"{words}.", *([known] if known else [])]


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
            f"{len(fit.segments)}"
            + (f" ({len(fit.outlier_segments)} outliers)" if fit.outlier_segments else ""),
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
        value = "not identified"
        if each.value is not None and each.std is not None:
            value = f"{each.value:.3g} ± {1.96 * each.std:.2g}"
        table.add_row(each.name, each.unit, value, each.reason or "")
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
        "data": "determined by how the train coasts on different gradients",
        "train file": "expected from the train's file; the data do not determine it better",
        "any train": "assumed, as no train file is there; the data do not determine it better",
    }[ratio.source]
    return (
        f"Mass over inertia {ratio.value:.3f} ± {1.96 * ratio.std:.3f}: {origin}. The columns over"
        " weight and over mass rest on it."
    )
