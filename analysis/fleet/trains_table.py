"""What a fleet shows of its trains, as tables."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from analysis.fleet.drift import Drift
from analysis.fleet.resistance import KindResistance, TrainResistance
from analysis.fleet.trains import FleetTrains
from analysis.fleet.unlike import Finding, Limit
from trainlog.display import counted
from trainlog.presentation import FORCE, NUMBER, SHARE, Band, Column, Said, WordTable, new_table
from trainlog.units import KMH

AT = 80.0 / KMH
"""Speed [m/s] at which trains are compared."""

COLUMNS = (
    Column("train"),
    Column("kind"),
    Column("trips", NUMBER),
    Column("at 80 km/h", FORCE, key="resistance_at_80_km_h", band=True),
    Column("against its kind", SHARE, key="against_kind", band=True),
    Column("drift a month", SHARE, key="drift_a_month", band=True),
    Column("wheels a month", SHARE, key="wheels_a_month", band=True),
    Column("findings"),
)


def trains_table(found: FleetTrains) -> WordTable:
    """Resistance of each train, and its drift."""
    table = new_table("Trains of the fleet", *COLUMNS, name="trains")
    for kind in found.resistance:
        for train in (*kind.trains, kind.another):
            table.add_cells(*_cells(found, kind, train))
    table.caption = "± half the 95 % band"
    return table


def _cells(found: FleetTrains, kind: KindResistance, train: TrainResistance) -> tuple[Any, ...]:
    mean, value = float(kind.mean.resistance(AT)), float(train.resistance(AT))
    # The band of a Student distribution, as the standard deviation of which a table shows 1.96.
    std = float(train.reach(AT)) / 1.96
    if not train.train:
        trend = _drift(found, "", kind.kind, "size of the curve")
        wheels = _drift(found, "", kind.kind, "speed scale")
        name = f"another {kind.kind}"
        against = Band(0.0, std / mean) if kind.compared else None
        return name, kind.kind, 0, Band(value, std), against, trend, wheels, ""
    what = ", ".join(each.what for each in found.of(train.train))
    return (
        train.train,
        kind.kind,
        train.trips,
        Band(value, std),
        Band(value / mean - 1.0, std / mean) if kind.compared else None,
        _drift(found, train.train, kind.kind, "size of the curve"),
        _drift(found, train.train, kind.kind, "speed scale"),
        what,
    )


def _drift(found: FleetTrains, train: str, kind: str, channel: str) -> Band | None:
    for each in found.drift:
        if (each.train, each.kind, each.channel) == (train, kind, channel):
            known = np.isfinite(each.trend)
            return Band(each.trend, each.factor / 1.96 * each.trend_std) if known else None
    return None


FINDINGS = (
    Column("train"),
    Column("what"),
    Column("since"),
    Column("first trip"),
    Column("seen within trips", NUMBER, key="seen_within_trips"),
    Column("compared with", key="against"),
    Column("p", NUMBER),
)


def findings_table(found: FleetTrains) -> WordTable:
    """Trains that are not like the others, or like themselves before."""
    unlike = found.unlike
    title = (
        f"{counted(len(unlike.findings), 'finding')} in {unlike.train_months:.1f} months of trains"
    )
    table = new_table(title, *FINDINGS, name="findings")
    for each in unlike.findings:
        cause = str(each.explanation)
        table.add_cells(
            each.train,
            cause,
            f"{each.since:%Y-%m-%d %H:%M}",
            each.trip,
            each.trips,
            each.against,
            Said(each.p, f"{each.p:.0e}"),
        )
    table.caption = (
        f"A healthy train raises an alarm in at most {100.0 * unlike.rate:g} % of months."
    )
    if not unlike.findings:
        table.caption += " None raised one; what would not be seen is listed by kind."
    for step in unlike.steps:
        table.caption += f"\n{step.train}: {step}, since {step.since:%Y-%m-%d %H:%M}"
    return table


LIMITS = (
    Column("kind"),
    Column("fault"),
    Column("a change within five trips", key="change"),
    Column("from its first trip on", key="constant"),
    Column("not at all on", key="blind"),
)


def limits_table(found: FleetTrains) -> WordTable:
    """What would not be seen: of each kind, on the train on which least is seen."""
    table = new_table("Smallest faults that are seen", *LIMITS, name="limits")
    for kind in found.resistance:
        names = {each.train for each in kind.trains}
        for channel, name in NAMES.items():
            limits = [
                each
                for each in found.unlike.limits
                if each.train in names and each.channel == channel
            ]
            blind = [each for each in limits if not np.isfinite(each.change)]
            reason = f"{counted(len(blind), 'train')}: {blind[0].reason}" if blind else ""
            change, constant = (
                _limit(limits, [getattr(each, which) for each in limits])
                for which in ("change", "constant")
            )
            table.add_cells(kind.kind, name, change, constant, reason)
    table.caption = (
        "A fault of this size is seen in 9 of 10 cases, on the train of the kind that shows it"
        " least."
    )
    return table


NAMES = {
    "constant resistance": "dragging brake",
    "size of the curve": "running resistance",
    "effort gain": "effort gain, mass",
    "speed scale": "wheel diameter",
    "effort delay": "sensor delay",
    "speed noise": "speed noise",
}
"""Faults by the channel that shows them."""


def _limit(limits: Sequence[Limit], sizes: Sequence[float]) -> str:
    known = [size for size in sizes if np.isfinite(size)]
    if not known:
        return "-"
    size, unit = max(known), limits[0].unit
    if unit == "N":
        return f"{size / 1e3:.1f} kN"
    return f"{size:.2f} s" if unit == "s" else f"{100.0 * size:.1f} %"


def trains_data(found: FleetTrains) -> dict[str, Any]:
    """What was found, as JSON: numbers in SI units."""
    return {
        "format": "trainlog/fleet-trains",
        "version": 1,
        "kinds": [_kind_data(kind) for kind in found.resistance],
        "findings": [_finding_data(each) for each in found.unlike.findings],
        "false_alarms_per_train_and_month": found.unlike.rate,
        "train_months": found.unlike.train_months,
        "limits": [
            {
                "train": each.train,
                "channel": each.channel,
                "unit": each.unit,
                "change": _number(each.change),
                "constant": _number(each.constant),
                "reason": each.reason,
            }
            for each in found.unlike.limits
        ],
        "steps": [
            {
                "train": each.train,
                "channel": each.channel,
                "unit": each.unit,
                "size": each.size,
                "deviations": each.deviations,
                "since": each.since.isoformat(),
                "trips": each.trips,
            }
            for each in found.unlike.steps
        ],
        "drift": [_drift_data(each) for each in found.drift],
    }


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _curve_data(curve: TrainResistance) -> dict[str, Any]:
    r = curve.resistance
    return {
        "train": curve.train,
        "trips": curve.trips,
        "r0": r.r0,
        "r1": r.r1,
        "r2": r.r2,
        "covariance": curve.covariance.tolist(),
        "freedom": float(curve.freedom),
        "asked": list(curve.asked),
    }


def _kind_data(kind: KindResistance) -> dict[str, Any]:
    return {
        "kind": kind.kind,
        "mean": _curve_data(kind.mean),
        "another": _curve_data(kind.another),
        "compared": kind.compared,
        "between_trains": kind.between.tolist(),
        "between_trips": kind.within.tolist(),
        "trains": [_curve_data(each) for each in kind.trains],
    }


def _finding_data(each: Finding) -> dict[str, Any]:
    causes: Sequence[Any] = (each.explanation.cause, *each.explanation.others)
    return {
        "train": each.train,
        "kind": each.kind,
        "what": each.what,
        "explained": each.explanation.explained,
        "causes": [
            {
                "what": cause.what,
                "size": cause.size,
                "std": cause.std,
                "unit": cause.unit,
                "probability": cause.probability,
            }
            for cause in causes
        ],
        "since": each.since.isoformat(),
        "trip": each.trip,
        "between": [when.isoformat() for when in each.between],
        "noticed": each.noticed.isoformat(),
        "trips": each.trips,
        "against": each.against,
        "channel": each.channel,
        "p": each.p,
    }


def _drift_data(each: Drift) -> dict[str, Any]:
    return {
        "train": each.train,
        "kind": each.kind,
        "channel": each.channel,
        "unit": each.unit,
        "trend_a_month": _number(each.trend),
        "trend_std": _number(each.trend_std),
        "band_factor": _number(each.factor),
        "season": _number(each.season),
        "season_std": _number(each.season_std),
        "highest_month": each.highest or None,
        "months": each.months,
        "steps": [when.isoformat() for when in each.steps],
        "reason": each.reason,
    }
