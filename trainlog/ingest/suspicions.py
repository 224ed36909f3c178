"""What looks wrong but may be right: told, never changed."""

from __future__ import annotations

import numpy as np

from trainlog.ingest.checks import ratios
from trainlog.ingest.clock import Result
from trainlog.ingest.profile import Limits
from trainlog.ingest.recording import BoolArray, Finding, FloatArray, Table, base_name, field_of

SUSPECT = 1.15
"""Ratio of two columns from which on their units are suspected."""

CONFUSIONS = {
    1.609: "miles an hour taken for km/h",
    1.852: "knots taken for km/h",
    1.944: "m/s taken for knots",
    1.152: "knots taken for miles an hour",
}
"""Ratios that units of speed have."""

LEAST_LEVELS = 5
"""Levels that a column must take before it is said to be quantised."""

LEAST_CHANGES = 20
"""Changes that it must show."""

HELD = 0.3
"""Share of its samples that must repeat the one before."""

ONE_STEP = 0.9
"""Share of its changes that must be by one step."""

ROUNDING = 0.01
"""Share of a step by which the digits that a file keeps may change it."""


def tell_units(table: Table, limits: Limits) -> Result:
    """Tell columns that disagree by a factor that is too small to be refused."""
    findings: list[Finding] = []
    for name, ratio, problem in ratios(table, limits):
        size = max(ratio, 1.0 / ratio)
        if size < SUSPECT:
            continue
        nearest = min(CONFUSIONS, key=lambda known: abs(known - size))
        likely = f": {CONFUSIONS[nearest]}?" if abs(nearest / size - 1.0) < 0.02 else ""
        findings.append(Finding("unit_suspected", 1, (), base_name(name), problem + likely))
    return table, findings


def tell_quantised(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Tell columns whose steps are coarser than what they measure changes between two samples."""
    findings: list[Finding] = []
    for name, values in table.signals.items():
        item = field_of(name)[2]
        if item.interpolation != "linear":
            continue
        step = quantum(values)
        if step is not None:
            cells = np.isfinite(values)
            note = f"steps of {step:.4g} {item.unit}"
            findings += table.found("quantised", cells, base_name(name), note)
    return table, [Finding(f.rule, f.count, (), f.column, f.note) for f in findings]


def quantum(values: FloatArray) -> float | None:
    """The step of a column that moves by one step at a time; None if it does not.

    Parameters
    ----------
    values : (n,) array
        NaN where absent.
    """
    known = values[np.isfinite(values)]
    change = np.diff(known)
    moving = np.flatnonzero(change)
    if moving.size < LEAST_CHANGES:
        return None
    within = change[moving[0] : moving[-1] + 1]
    size = np.abs(within[within != 0.0])
    step = float(np.median(size))
    single: BoolArray = np.abs(size - step) <= ROUNDING * step
    held = float(np.mean(within == 0.0))
    levels = (float(np.max(known)) - float(np.min(known))) / step
    if held < HELD or float(np.mean(single)) < ONE_STEP or levels < LEAST_LEVELS:
        return None
    return step
