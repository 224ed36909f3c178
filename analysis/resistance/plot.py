"""Charts of the running resistance: of many trips, of one, of the coast-down."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
from scipy.special import ndtri

from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    SKY,
    Cells,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    shades,
    worded,
)
from analysis.resistance.coast_down import CoastDown, TripCoastDown
from analysis.resistance.combination import CommonFit
from analysis.resistance.fit import TripFit
from analysis.resistance.logs import Fits
from analysis.resistance.recording import Timeline, TripRefusedError
from analysis.resistance.regression import LAGS, Residuals, diagnosed
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted
from trainlog.formats.railway import CoastDownResult
from trainlog.formats.summaries import PARAMETERS, parameters_of
from trainlog.railway import ParameterSet
from trainlog.railway.resistance import basis
from trainlog.units import KMH

KILONEWTON, TONNE = 1e3, 1e3

MOST_DRAWN = 300
"""More curves than this are not drawn."""

MOST_NAMED = 40
"""More trips than this are not named one by one."""

SHOWN = 4
"""Trips of a coast-down whose speed is drawn."""

MASKS = {"gap": GREY, "standstill": GREEN, "braking": ORANGE, "slip": PURPLE}
"""Colour of what is masked, by reason."""

SPEED = "speed [km/h]"


# ------------------------------------------------------------------------------------ many trips


def fits_charts(fits: Fits) -> list[Chart]:
    """What a set of trips says of the running resistance.

    Curves with the common band; the observed configurations over all trips; mass and power of
    each trip; correlation of the coefficients.
    """
    trips = counted(len(fits.common.trips), "trip")
    count = len(fits.drives) - len(fits.common.trips) - len(fits.same)
    refused = f", {count} refused" if count else ""
    title = f"{fits.common.train}: running resistance from {trips}{refused}"
    about = "correlation of the mean's coefficients"
    return [
        _together(fits, title),
        _observed(fits),
        *_per_trip(fits),
        correlation_chart(fits.common.covariance, about),
    ]


def _together(fits: Fits, title: str) -> Chart:
    """Windows of the trips fitted now, each trip's curve, the common one with its band."""
    common = fits.common
    speed = _speeds(common.asked)
    drag = common.resistance(speed)
    curves = list[Curve]()
    if fits.trips:
        seen = np.concatenate([fit.points.speed[fit.points.used] for fit in fits.trips])
        drag = np.concatenate([fit.points.value[fit.points.used] for fit in fits.trips])
        rows = _some(seen.size, 1_500)
        of = "" if rows.size == seen.size else f", {rows.size} of them drawn"
        curves.append(
            Curve(f"{seen.size} means over 10 s{of}", KMH * seen[rows], drag[rows] / KILONEWTON,
                  GREY, "points", width=1.2, opacity=0.5)
        )  # fmt: skip
    accepted = fits.drives[fits.drives["refused"] == ""]
    each = parameters_of(accepted)[_some(len(accepted), MOST_DRAWN), :-1] @ basis(speed).T
    label = _drawn("each trip", len(each), len(accepted))
    curves += _family(label, KMH * speed, each / KILONEWTON, SKY, 0.8)
    curves.append(_band_curve(common, speed, "all trips: mean and its 95 % band"))
    limits = _resistance_limits(common.resistance(speed), drag)
    return Chart(
        SPEED,
        [Panel("running resistance [kN]", curves, 1.6, limits=limits)],
        caption="The curve of all trips with the 95 % band of the mean, and those of each trip.",
        title=title,
        width=0.6,
    )


def _observed(fits: Fits) -> Chart:
    """The configurations' curves over the common one, and those of all trips."""
    common, found = fits.common, fits.parameters
    speed = _speeds(common.asked)
    mean = common.resistance(speed)
    spread = 100.0 * common.spread(speed) / mean
    betas = common.betas[_some(len(common.betas), MOST_DRAWN)]
    chosen = np.array([each.resistance(speed) for each in found.configurations])
    label = _drawn("each trip, drawn to the mean", len(betas), len(common.betas))
    curves = [
        Curve("between trips, 1σ", KMH * speed, spread, ORANGE, "area", -spread, opacity=0.35),
        *_family(label, KMH * speed, 100.0 * ((betas @ basis(speed).T) / mean - 1.0), PALE, 0.8),
        *_family("observed configurations", KMH * speed, 100.0 * (chosen / mean - 1.0), BLUE, 0.9),
    ]
    title = (
        f"{len(chosen)} configurations, worst case of {100.0 * found.cover['level']:.1f} % of trips"
    )
    return Chart(
        SPEED,
        [Panel("difference from the mean [%]", curves, 1.6, rules=[Rule(0.0)])],
        title=title, beside=True, width=0.4,
    )  # fmt: skip


def _per_trip(fits: Fits) -> list[Chart]:
    """Mass and power of each trip with their 95 % bands; of many trips the distribution."""
    accepted = fits.drives[fits.drives["refused"] == ""]
    mass = accepted["mass"].to_numpy(np.float64) / TONNE
    if len(accepted) > MOST_NAMED:
        counts, edges = np.histogram(mass, bins=40)
        bars = Curve(
            "", 0.5 * (edges[1:] + edges[:-1]), counts, SKY, "bars", width=np.diff(edges)[0]
        )
        title = f"mass of {counted(len(accepted), 'trip')}"
        return [Chart("mass [t]", [Panel("trips", [bars])], title=title, width=0.6)]
    std = np.sqrt(accepted["covariance_mass_mass"].to_numpy(np.float64)) / TONNE
    power = accepted["max_power"].to_numpy(np.float64) / 1e3
    shown = [("mass [t]", mass, std, BLUE)]
    if np.isfinite(power).any():
        shown.append(("power [kW]", power, accepted["max_power_std"].to_numpy() / 1e3, ORANGE))
    rows = np.arange(len(accepted))
    names = accepted["trip"].tolist()
    return [
        Chart(
            what,
            [
                Panel(
                    "",
                    [
                        Curve("", value, rows, colour, "points", value - 1.96 * each,
                              value + 1.96 * each, width=1.6, across=True)
                    ],
                    max(1.0, 0.06 * len(rows)),
                    rows=names if number == 0 else [" "] * len(names),
                )
            ],
            title=what.split(" ")[0] + (", 95 % band" if number == 0 else " where it was reached"),
            span=_reach(value, each), beside=number > 0, width=0.34 if number == 0 else 0.26,
        )
        for number, (what, value, each, colour) in enumerate(shown)
    ]  # fmt: skip


def _reach(value: FloatArray, std: FloatArray) -> tuple[float, float]:
    """Ends of an axis that has all bands."""
    low, high = np.nanmin(value - 1.96 * std), np.nanmax(value + 1.96 * std)
    margin = 0.05 * float(high - low) or 1.0
    return float(low) - margin, float(high) + margin


def correlation_chart(covariance: FloatArray, title: str) -> Chart:
    """The correlation that a covariance (p, p) of `PARAMETERS` says, as coloured cells."""
    std = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(std, std)
    names = PARAMETERS[: std.size]
    edges = np.arange(std.size + 1) - 0.5
    words = np.array([[f"{value:.2f}" for value in row] for row in correlation])
    cells = Cells(edges, edges, shades(correlation, "RdBu_r", (-1.0, 1.0)), words=words)
    return Chart(
        "", [Panel("", [cells], 1.1, rows=names, limits=(std.size - 0.5, -0.5))],
        title=title, span=(-0.5, std.size - 0.5),
        ticks=list(enumerate(names)), beside=True, width=0.4,
    )  # fmt: skip


def residual_charts(trips: Sequence[TripFit]) -> list[Chart]:
    """What the fits of trips did not explain, in standard deviations, over the speed."""
    if not trips:
        return []
    x, y = (
        np.concatenate([getattr(each.residuals, name) for each in trips])
        for name in ("speed", "value")
    )
    of = np.concatenate([np.repeat(each.trip, each.residuals.value.size) for each in trips])
    order = np.argsort(x, kind="stable")
    rows = order[_some(order.size, 2_000)]
    hover = {
        "trip": [str(each) for each in of[rows]],
        "speed": worded("{:.0f} km/h", KMH * x[rows]),
        "residual": worded("{:+.2f} σ", y[rows]),
    }
    curve = Curve("", KMH * x[rows], y[rows], SKY, "points", hover=hover, width=1.0)
    return [
        Chart(
            "speed, km/h", [Panel("residual, σ", [curve], 1.1)],
            caption="What the fit did not explain: nearly always within 2 σ and without a trend, if"
            " the noise is as the model has it.",
        )
    ]  # fmt: skip


def set_charts(found: ParameterSet) -> list[Chart]:
    """The running resistance of each configuration of a set, and of all trips together."""
    speed = np.linspace(0.0, max(found.speed_range[1], 10.0), 120)
    shown = [("each configuration", each.resistance, SKY, 0.9) for each in found.configurations]
    if found.common is not None:
        shown.append(("all trips", found.common, BLUE, 2.0))
    curves = list[Curve]()
    for label, drag, colour, width in shown:
        value = np.asarray(drag(speed)) / KILONEWTON
        hover = {
            "speed": worded("{:.0f} km/h", KMH * speed),
            "resistance": worded("{:.2f} kN", value),
        }
        curves.append(Curve(label, KMH * speed, value, colour, hover=hover, width=width))
    title = f"configurations of {found.train}"
    return [Chart("speed, km/h", [Panel("running resistance, kN", curves, 1.6, title)])]


# -------------------------------------------------------------------------------------- one trip


def trips_charts(
    trips: Sequence[TripFit], refused: Mapping[str, TripRefusedError]
) -> dict[str, Sequence[Chart]]:
    """The charts of every trip that was fitted or refused, by the names of their files."""
    charts: dict[str, Sequence[Chart]] = {each.trip: each.charts() for each in trips}
    charts |= {trip: [refused_chart(trip, each)] for trip, each in refused.items()}
    # The trips' names, as far as files can have them.
    names = {trip: re.sub(r"[^\w .()+-]", "_", trip) or "trip" for trip in charts}
    return {f"{names[trip]}.png": each for trip, each in charts.items()}


def trip_fit_charts(fit: TripFit) -> list[Chart]:
    """The fit of one trip, and what the residuals say of it.

    Curve with its band, what was learnt as the trip went on; residuals over time and speed, their
    correlation and distribution; correlation of the parameters; what was masked.
    """
    diagnosis, residuals = diagnosed(fit.residuals), fit.residuals
    doubts = "\n".join(diagnosis.doubts) or "residuals as the noise model expects them"
    value = residuals.value
    return [
        _data(fit),
        _learning(fit),
        _residual_chart("time [min]", residuals.time / 60.0, value, doubts, width=0.66),
        correlation_chart(fit.covariance, "correlation"),
        _residual_chart(
            SPEED, KMH * residuals.speed, value, _p(diagnosis.flatness, "flat"), width=0.33
        ),
        _neighbours(residuals, _p(diagnosis.independence, "independent")),
        _distribution(residuals, _p(diagnosis.normality, "normal")),
        timeline_chart(fit.timeline, "what was masked, and why"),
    ]


def refused_chart(trip: str, refusal: TripRefusedError) -> Chart:
    """Why a trip was refused: the reason, and what was masked over the trip."""
    title = f"{trip}: refused, {refusal.reason}\n{textwrap.fill(str(refusal), 130)}"
    if refusal.timeline is None or not refusal.timeline.time.size:
        nothing = Label(0.5, "nothing of it can be drawn", 0.5)
        return Chart("", [Panel("", [], 0.6, labels=[nothing], bare=True)], title=title)
    return timeline_chart(refusal.timeline, title)


def timeline_chart(timeline: Timeline, title: str) -> Chart:
    """Speed over time, and below it what was masked, a bar for each reason."""
    minutes = timeline.time / 60.0
    panels = [Panel(SPEED, [Curve("", minutes, KMH * timeline.speed, width=1.0)], from_zero=True)]
    if timeline.masks:
        bars = [
            Curve("", minutes, np.where(mask, row + 0.4, np.nan), MASKS.get(reason, GREY), "area",
                  np.full(mask.size, row - 0.4))
            for row, (reason, mask) in enumerate(timeline.masks.items())
        ]  # fmt: skip
        names = [
            f"{timeline.named(reason)} {float(mask.mean()):.0%}"
            for reason, mask in timeline.masks.items()
        ]
        panels.append(Panel("", bars, 0.1 + 0.1 * len(bars), rows=names))
    return Chart("time [min]", panels, title=title)


def _data(fit: TripFit) -> Chart:
    speed = _speeds(fit.asked)
    points, used = fit.points, fit.points.used
    value, std = points.value / KILONEWTON, points.std / KILONEWTON
    curves = [
        Curve(f"{int(used.sum())} means over 10 s, with their noise", KMH * points.speed[used],
              value[used], GREY, "points", (value - std)[used], (value + std)[used], width=1.6)
    ]  # fmt: skip
    if not used.all():
        label = f"{int((~used).sum())} outliers, axes out"
        curves.append(
            Curve(
                label, KMH * points.speed[~used], value[~used], RED, "points", mark="x", width=2.5
            )
        )
    curves.append(_band_curve(fit, speed, "fitted, 95 % band of the whole curve"))
    title = (
        f"{fit.train}, {fit.trip}: running resistance\n"
        f"{fit.resistance}, mass {fit.mass / TONNE:.1f} ± {1.96 * fit.mass_std / TONNE:.1f} t"
    )
    limits = _resistance_limits(fit.resistance(speed), points.value[used])
    return Chart(
        SPEED, [Panel("running resistance [kN]", curves, 1.5, limits=limits)],
        title=title, width=0.66,
    )  # fmt: skip


def _learning(fit: TripFit) -> Chart:
    """Resistance at the highest speed asked for and mass, as the recursion learnt them."""
    top = fit.asked[1]
    at = basis(top)
    history = fit.history
    minutes = np.asarray((history.time - history.time[0]).total_seconds()) / 60.0
    final = float(fit.resistance(top))
    drag = history.beta[:, :-1] @ at / final
    std = np.sqrt(np.einsum("i,nij,j->n", at, history.covariance[:, :-1, :-1], at)) / final
    curves = [
        Curve(f"resistance at {KMH * top:.0f} km/h, ±2σ", minutes, drag, BLUE, "line",
              drag - 2.0 * std, drag + 2.0 * std),
        Curve(f"mass ({fit.mass / TONNE:.1f} t)", minutes, history.beta[:, -1] / fit.mass, ORANGE),
    ]  # fmt: skip
    title = "learnt as the trip went on"
    return Chart(
        "time [min]", [Panel("over the final estimate", curves, 1.5, limits=(0.7, 1.3))],
        title=title, beside=True, width=0.34,
    )  # fmt: skip


def _residual_chart(what: str, x: FloatArray, y: FloatArray, title: str, *, width: float) -> Chart:
    """Residuals, with the lines that 95 of 100 normal ones keep."""
    rules = [Rule(0.0), *(Rule(each, GREY, dash="--") for each in (-1.96, 1.96))]
    curve = Curve("", x, y, SKY, "points", width=1.2)
    return Chart(
        what, [Panel("residual [σ]", [curve], 1.0, rules=rules)],
        title=title, width=width,
    )  # fmt: skip


def _neighbours(residuals: Residuals, title: str) -> Chart:
    """Autocorrelation, with the bounds that 95 of 100 independent residuals keep."""
    correlation = residuals.correlation(2 * LAGS)
    bound = 1.96 / np.sqrt(max(residuals.value.size, 1))
    reach = max(0.2, 1.1 * float(np.max(np.abs(correlation), initial=0.0)))
    bars = Curve("", np.arange(1, correlation.size + 1), correlation, SKY, "bars", width=0.8)
    rules = [Rule(0.0), *(Rule(each, GREY, dash="--") for each in (-bound, bound))]
    return Chart(
        "lag [windows]",
        [Panel("autocorrelation", [bars], 1.0, limits=(-reach, reach), rules=rules)],
        title=title, beside=True, width=0.33,
        span=(0.4, correlation.size + 0.6),
    )  # fmt: skip


def _distribution(residuals: Residuals, title: str) -> Chart:
    """Quantiles of the residuals over those of the normal distribution."""
    value = np.sort(residuals.value)
    expected = ndtri((np.arange(value.size) + 0.5) / value.size)
    reach = float(np.max(np.abs(expected), initial=1.0))
    ends = np.array([-reach, reach])
    curves = [
        Curve("", expected, value, SKY, "points", width=1.2),
        Curve("", ends, ends, INK, width=0.8),
    ]
    return Chart(
        "normal quantile", [Panel("residual [σ]", curves)],
        title=title, beside=True, width=0.33,
    )  # fmt: skip


def _p(probability: float, what: str) -> str:
    return f"{what}: p = {probability:.2g}"


# ------------------------------------------------------------------------------------ coast-down


def coast_down_charts(found: CoastDown) -> list[Chart]:
    """The coasting segments over speed and distance; the curve, its band and the windows."""
    shown = sorted(found.trips, key=lambda fit: -fit.coasted)[:SHOWN]
    refused = f", {len(found.refused)} refused" if found.refused else ""
    title = (
        f"{found.train or 'train'}: running resistance from the coasting of"
        f" {counted(len(found.trips), 'trip')}{refused}"
    )
    # Trips drive over places of their own: each has a chart.
    segments = [_segments(fit) for fit in shown]
    return [_coasting_curve(found, title), *segments]


def _segments(fit: TripCoastDown) -> Chart:
    motion = fit.motion
    kilometre, speed = motion.position / 1e3, KMH * motion.speed
    curves = [Curve("speed", kilometre, speed, GREY, width=0.7)]
    for segments, colour, label in (
        (fit.segments, BLUE, "coasting"),
        (fit.outlier_segments, RED, "left out: contradicts the others"),
    ):
        inside = np.zeros(speed.size, dtype=np.bool_)
        for segment in segments:
            inside |= (motion.time >= segment.start) & (motion.time <= segment.end)
        if inside.any():
            lone = np.where(inside, speed, np.nan)
            curves.append(Curve(label, kilometre, lone, colour, width=2.2))
    title = f"{fit.trip}: coasting for {fit.coasted:.0f} s"
    return Chart(
        "chainage [km]", [Panel(SPEED, curves, 0.7, from_zero=True)],
        title=title,
    )  # fmt: skip


def _coasting_curve(found: CoastDown, title: str) -> Chart:
    curve = found.curve
    speed, value, std, used = (
        np.concatenate([getattr(fit.points, name) for fit in found.trips])
        for name in ("speed", "value", "std", "used")
    )
    label = f"{int(used.sum())} windows of 10 s and less, with the speed's noise"
    curves = [
        Curve(label, KMH * speed[used], value[used], GREY, "points", (value - std)[used],
              (value + std)[used], width=1.2, opacity=0.6 if len(found.trips) < 4 else 0.3)
    ]  # fmt: skip
    if not np.all(used):
        curves.append(
            Curve("outliers, left out", KMH * speed[~used], value[~used], ORANGE, "points",
                  mark="x", width=2.5)
        )  # fmt: skip
    low, high = curve.covered
    every = np.linspace(low, high, 120)
    below, above = curve.band(every)
    whole = Curve("95 % band of it all", KMH * every, curve(every), SKY, "line", below, above,
                  width=1.2, dash="--")  # fmt: skip
    curves.append(whole)
    if curve.supported is not None:
        known = np.linspace(*curve.supported, 120)
        ends = f"{KMH * known[0]:.0f} to {KMH * known[-1]:.0f} km/h"
        curves.append(Curve(f"curve, supported {ends}", KMH * known, curve(known), BLUE, width=2.0))
    ratio = found.ratio
    top = 1.6 * float(np.max(curve(every)))
    words = f"mass over inertia {ratio.value:.3f} ± {1.96 * ratio.std:.3f} ({ratio.source})"
    return Chart(
        SPEED,
        [Panel("running resistance over inertia [m/s²]", curves, 1.6, words, limits=(0.0, top))],
        title=title,
    )


def result_charts(result: CoastDownResult) -> list[Chart]:
    """The curve of a coast-down; with the gradient unknown beside it each piece's sum."""
    if result.curve is not None and not result.pieces:
        return [replace(_curve_without_gradient(result), beside=False, width=1.0)]
    curves = list[Curve]()
    for way, colour in (("forward", BLUE), ("reverse", ORANGE)):
        pieces = [piece for piece in result.pieces if piece["direction"] == way]
        if pieces:
            value = np.array([piece["deceleration"] for piece in pieces])
            reach = 1.96 * np.array([piece["std"] for piece in pieces])
            curves.append(
                Curve(f"{pieces[0]['quantity']}, {way}, 95 %",
                      [np.mean(piece["position"]) / 1e3 for piece in pieces], value, colour,
                      "points", value - reach, value + reach, width=1.6)
            )  # fmt: skip
    title = "Coasting with the gradient unknown"
    pieces_chart = Chart(
        "chainage [km]", [Panel("deceleration [m/s²]", curves, 1.6, "of each piece of track")],
        title=title, width=0.6,
    )  # fmt: skip
    return [pieces_chart, _curve_without_gradient(result)]


def _curve_without_gradient(result: CoastDownResult) -> Chart:
    """The curve, or what it is without its constant part."""
    curve = result.curve
    if curve is not None:
        speed, value, low, high = curve.speeds, curve.deceleration, curve.low, curve.high
        what, title = (
            "running resistance over inertia [m/s²]",
            "all of it, by pieces coasted both ways" if result.pieces else "with its 95 % band",
        )
    else:
        growth = [each.value or 0.0 for each in result.quantities[1:]]
        ends = np.array([piece["speed"] for piece in result.pieces])
        lowest = float(ends.min())
        speed = np.linspace(lowest, float(ends.max()), 81)
        at = (basis(speed) - basis(lowest))[:, 1:]
        value = at @ growth
        std = np.sqrt(np.einsum("ni,ij,nj->n", at, result.covariance, at))
        low, high = value - 1.96 * std, value + 1.96 * std
        what = f"more than at {KMH * lowest:.0f} km/h [m/s²]"
        title = "growth with speed; c0 is merged with the gradient"
    hover = {
        "speed": worded("{:.0f} km/h", KMH * speed),
        "value": worded("{:.1f} mm/s²", 1e3 * value),
        "95 % band": worded("{:.1f} to {:.1f} mm/s²", 1e3 * low, 1e3 * high),
    }
    line = Curve("curve, 95 %", KMH * speed, value, BLUE, "line", low, high, hover, 1.8)
    return Chart(SPEED, [Panel(what, [line], 1.6, title)], beside=True, width=0.4)  # fmt: skip


# ----------------------------------------------------------------------------------------- parts


def _band_curve(fit: TripFit | CommonFit, speed: FloatArray, label: str) -> Curve:
    """A drag curve over the speed with its band."""
    low, high = (each / KILONEWTON for each in fit.band(speed))
    value = fit.resistance(speed) / KILONEWTON
    hover = {
        "speed": worded("{:.0f} km/h", KMH * speed),
        "resistance": worded("{:.2f} kN", value),
        "95 % band": worded("{:.2f} to {:.2f} kN", low, high),
    }
    return Curve(label, KMH * speed, value, BLUE, "line", low, high, hover, 1.8)


def _family(label: str, x: FloatArray, rows: FloatArray, colour: str, width: float) -> list[Curve]:
    """Curves of one kind, with breaks between them, as one."""
    if not len(rows):
        return []
    gap = np.full((len(rows), 1), np.nan)
    along = np.column_stack([np.broadcast_to(x, rows.shape), gap]).ravel()
    return [Curve(label, along, np.column_stack([rows, gap]).ravel(), colour, width=width)]


def _resistance_limits(curve: FloatArray, points: FloatArray) -> tuple[float, float]:
    """Range of the axis [kN]: the curve and nearly all points."""
    low, high = np.quantile(points, [0.02, 0.98])
    top = max(float(high), 1.15 * float(curve.max()))
    return min(float(low), 0.0) / KILONEWTON, top / KILONEWTON


def _speeds(asked: tuple[float, float]) -> FloatArray:
    """From standstill to the highest speed asked for [m/s]."""
    return np.linspace(0.0, asked[1], 120)


def _some(count: int, most: int) -> IntArray:
    """Rows to draw: all, or `most` evenly spaced ones."""
    spaced = np.linspace(0, count - 1, min(count, most))
    return np.unique(np.round(spaced).astype(np.int64))


def _drawn(what: str, drawn: int, count: int) -> str:
    return what if drawn == count else f"{what} ({drawn} of {count} drawn)"
