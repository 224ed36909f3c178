"""The rules of repair, in the order in which they are applied; docs/ingest-rules.md has the table.

Those on rows and their time are in `trainlog.ingest.clock`; those on values are here.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np

from estimators.receiver import integral
from trainlog.arrays import BoolArray, FloatArray
from trainlog.errors import InputError
from trainlog.ingest import clock
from trainlog.ingest.clock import Result, gap_threshold, has_fix
from trainlog.ingest.frozen import blank_frozen
from trainlog.ingest.jumps import blank_spikes, report_steps, unwrap_counters
from trainlog.ingest.motion import (
    ACTS,
    EFFORTS,
    ENOUGH,
    FAR,
    FEW,
    GNSS_SPEED,
    MOVING,
    POSITION,
    SEVERAL,
    SPEED,
    SUSPECT,
    WHEEL_SPEED,
    agreement,
    driven_mass,
    plane,
    scale_of,
    seconds_of,
)
from trainlog.ingest.profile import Limits, Repair
from trainlog.ingest.recording import (
    MOST,
    NEARLY_ALL,
    NO_TIME,
    SELDOM,
    Finding,
    Raw,
    Table,
    base_name,
    field_of,
)
from trainlog.ingest.report import changes
from trainlog.topics import Bounds


def blank_without_fix(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Take away the values of a receiver in rows without a satellite fix."""
    fix = has_fix(table)
    if fix is None or fix.all():
        return table, []
    present = np.zeros(len(table), dtype=np.bool_)
    for name, values in table.signals.items():
        if name.startswith("/gnss/"):
            present |= np.isfinite(values)
    lost = ~fix & present
    found = table.found("no_fix", lost)
    for name in table.signals:
        if name.startswith("/gnss/"):
            table = table.without(name, lost)
    return table, found


def impossible(values: FloatArray, bounds: Bounds) -> tuple[BoolArray, BoolArray]:
    """Which values are beyond their bounds, and which show the unit: 0 is it in any unit.

    Examples
    --------
    >>> impossible(np.array([0.0, 3.0, 900.0, np.nan]), Bounds(0.0, 100.0, 10.0, 1.0))
    (array([False, False,  True, False]), array([False,  True,  True, False]))
    """
    return (values < bounds.low) | (values > bounds.high), np.isfinite(values) & (values != 0.0)


def blank_out_of_limits(table: Table, limits: Limits) -> Result:
    """Take away values that are physically impossible.

    Raises
    ------
    InputError
        If most values of a column are: then it is the unit that is wrong.
    """
    findings: list[Finding] = []
    for name, values in table.signals.items():
        bounds = limits.of(name)
        out, judged = impossible(values, bounds)
        count, present = np.count_nonzero(out), np.count_nonzero(judged)
        if not count:
            continue
        if count > MOST * present:
            unit = field_of(name)[2].unit
            first = int(np.argmax(out))
            raise InputError(
                f"{base_name(name)}: {count} of {present} values are impossible, the first is"
                f" {values[first]:.6g} {unit}, limits {bounds.low:.6g} to {bounds.high:.6g}",
                place=f"row {table.rows[first]}",
                remedy="check the unit, scale and sign of its column in the profile",
            )
        findings += table.found("out_of_limits", out, base_name(name))
        table = table.without(name, out)
    return table, findings


FACTOR = 2.0
"""Ratio of two columns beyond which they cannot be of the units that the profile gives."""

LEVER = "/train/controls.lever"


def refuse_inconsistent(table: Table, limits: Limits) -> Result:
    """Refuse a table whose columns contradict each other by a factor, or by sign.

    Raises
    ------
    InputError
        If distance and speed, or two speeds, differ by more than `FACTOR`, position runs against
        the direction of travel, or the train slows down whenever it is driven.
    """
    for _, ratio, problem in ratios(table, limits):
        if not 1.0 / FACTOR <= ratio <= FACTOR:
            raise InputError(
                problem,
                remedy="check the units of the two columns in the profile (km/h, m/s, km, m)",
            )
    _refuse_sign(table)
    return table, []


def ratios(table: Table, limits: Limits) -> Iterator[tuple[str, float, str]]:
    """Ratios of columns that should measure the same, each with the column and in words.

    Raises
    ------
    InputError
        If position runs against the direction of travel.
    """
    speed = table.signals.get(SPEED)
    if speed is not None:
        position = table.signals.get(POSITION)
        if position is not None:
            yield from _distance_ratio(table, position, speed, limits)
        for name, other in table.signals.items():
            if name == GNSS_SPEED or name.startswith(WHEEL_SPEED):
                found = agreement(other, speed, speed > MOVING)
                if found is not None and found.holds:
                    yield name, found.ratio, f"{name} is {found.ratio:.4g} times {SPEED}"
    points = plane(table)
    for name in (GNSS_SPEED, SPEED):
        if points is not None and name in table.signals:
            seconds, speed = seconds_of(table), table.signals[name]
            ratio = scale_of(seconds, points, speed)
            if np.isfinite(ratio) and np.ptp(integral(seconds, speed)[0]) > FAR:
                words = f"{name} is {ratio:.4g} times the speed at which the fixes move"
                yield name, ratio, words


def _distance_ratio(
    table: Table, position: FloatArray, speed: FloatArray, limits: Limits
) -> Iterator[tuple[str, float, str]]:
    """Compare the change of position with the integral of speed, gaps left out."""
    known = np.isfinite(position) & np.isfinite(speed)
    seconds = seconds_of(table)[known]
    step = np.diff(seconds)
    whole = step <= gap_threshold(table.time, limits)
    moves = np.diff(position[known])
    bounds = limits.of(POSITION)
    leaps = whole & (np.abs(moves) > bounds.tolerance + bounds.rate * step)
    if np.count_nonzero(leaps) <= FEW * np.count_nonzero(whole):
        # Steps to another chainage are no unit.
        whole &= ~leaps
    moved = float(np.sum(moves[whole]))
    driven = float(np.sum(np.diff(integral(seconds, speed[known])[0])[whole]))
    if driven < FAR:
        return
    if moved < -FAR:
        raise InputError(
            f"{POSITION} falls by {-moved:.0f} m while the train drives {driven:.0f} m",
            remedy="position grows in the direction of travel: set sign = -1, and offset to"
            " minus the line's length, for its column in the profile",
        )
    yield POSITION, moved / driven, f"{POSITION} moves {moved:.0f} m, {SPEED} gives {driven:.0f} m"


def _refuse_sign(table: Table) -> None:
    """Refuse efforts, or a lever, that the train's acceleration runs against."""
    speed = table.signals.get(SPEED)
    if speed is None:
        return
    present = [name for name in EFFORTS if name in table.signals]
    if EFFORTS[0] in present:
        sizes = [np.nan_to_num(table.signals[name]) for name in present]
        _refuse_against(table, speed, sizes[0] - sum(sizes[1:]), " and ".join(present))
    lever = table.signals.get(LEVER)
    if lever is not None:
        _refuse_against(table, speed, np.nan_to_num(lever), LEVER)


def _refuse_against(table: Table, speed: FloatArray, push: FloatArray, name: str) -> None:
    strong = np.abs(push) >= ACTS * np.max(np.abs(push))
    driven = driven_mass(seconds_of(table), np.where(strong, push, np.nan), speed)
    if driven.decides and driven.correlation < 0.0:
        raise InputError(
            f"the train slows down whenever {name} would drive it"
            f" (correlation {driven.correlation:.2f})",
            remedy="check sign and part of the columns of the efforts and of the lever in the"
            " profile: traction speeds a train up",
        )


CONFUSIONS = {
    1.609: "miles an hour taken for km/h",
    1.852: "knots taken for km/h",
    1.944: "m/s taken for knots",
    1.152: "knots taken for miles an hour",
}
"""Ratios that units of speed have."""


def suspect_units(table: Table, limits: Limits) -> Result:
    """Report columns that disagree by a factor that is too small to be refused."""
    findings: list[Finding] = []
    for name, ratio, problem in ratios(table, limits):
        size = max(ratio, 1.0 / ratio)
        if size < SUSPECT:
            continue
        nearest = min(CONFUSIONS, key=lambda known: abs(known - size))
        likely = f": {CONFUSIONS[nearest]}?" if abs(nearest / size - 1.0) < 0.02 else ""
        findings.append(Finding("unit_suspected", 1, (), base_name(name), problem + likely))
    return table, findings


def find_quantised(table: Table, limits: Limits) -> Result:  # noqa: ARG001
    """Report columns whose steps are coarser than what they measure changes between two samples."""
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
    if moving.size < 2 * ENOUGH:
        return None
    within = change[moving[0] : moving[-1] + 1]
    size = np.abs(within[within != 0.0])
    step = float(np.median(size))
    single: BoolArray = np.abs(size - step) <= FEW * step
    held = float(np.mean(within == 0.0))
    levels = (float(np.max(known)) - float(np.min(known))) / step
    if held < SELDOM or float(np.mean(single)) < NEARLY_ALL or levels < SEVERAL:
        return None
    return step


@dataclass(frozen=True, slots=True)
class Rule:
    """A rule of repair.

    Attributes
    ----------
    name : str
        As in [repair] of the profile and in the report.
    off : {"refuse", "keep"}
        What happens to the defect when the rule is switched off: the file is refused, or the
        defect stays.
    apply : callable, optional
        ``apply(table, limits)`` gives the table that is left and what was found; absent for rules
        that the format's reader applies while it splits the file.
    """

    name: str
    off: Literal["refuse", "keep"]
    apply: Callable[[Table, Limits], Result] | None = None


RULES = (
    Rule("truncated_rows", "refuse"),
    Rule("damaged_messages", "refuse"),
    Rule("not_a_number", "refuse"),
    Rule("empty", "refuse"),
    Rule("newest_first", "refuse"),
    Rule("before_first_fix", "keep", clock.drop_before_first_fix),
    Rule("time_unreadable", "refuse", clock.drop_unreadable_time),
    Rule("clock_step", "keep", clock.undo_clock_steps),
    Rule("clock_step_suspected", "keep", clock.suspect_clock_steps),
    Rule("clock_jump", "refuse", clock.drop_clock_jumps),
    Rule("time_backwards", "refuse", clock.sort_time),
    Rule("duplicates", "refuse", clock.drop_duplicates),
    Rule("subsecond", "keep", clock.rebuild_subsecond),
    Rule("same_time", "refuse", clock.merge_same_time),
    Rule("no_fix", "keep", blank_without_fix),
    Rule("out_of_limits", "keep", blank_out_of_limits),
    Rule("counter", "keep", unwrap_counters),
    Rule("spikes", "keep", blank_spikes),
    Rule("frozen", "keep", blank_frozen),
    Rule("position_steps", "keep", report_steps),
    Rule("inconsistent", "keep", refuse_inconsistent),
    Rule("unit_suspected", "keep", suspect_units),
    Rule("quantised", "keep", find_quantised),
    Rule("gaps", "keep", clock.count_gaps),
    Rule("direction", "refuse"),
    Rule("contradicted", "keep"),
    Rule("off_line", "keep"),
    Rule("slip", "keep"),
    Rule("position_offset", "keep"),
)
"""Every rule by the order of its application; the last three where chainage is estimated."""


def refuse_switched_off(findings: tuple[Finding, ...], repair: Repair) -> None:
    """Refuse what the reader repaired although its rule is switched off.

    Raises
    ------
    InputError
        With the first row concerned.
    """
    for rule in RULES:
        if rule.off == "refuse" and not getattr(repair, rule.name):
            for finding in findings:
                if finding.rule == rule.name:
                    _refuse(finding)


def repaired(
    table: Table, limits: Limits, repair: Repair, least: int = 2
) -> tuple[Table, list[Finding], list[Raw]]:
    """Apply the rules, one after the other.

    Parameters
    ----------
    least : int
        Rows that have to be left: a trip needs 2, one table among several none.

    Returns
    -------
    Table, list of Finding, list of Raw
        What is left, what was met, and how what was changed stood before.

    Raises
    ------
    InputError
        If a defect cannot be repaired, or its rule is switched off and it cannot stay.
    """
    findings: list[Finding] = []
    changed: list[Raw] = []
    for rule in RULES:
        if rule.apply is None:
            continue
        wanted = getattr(repair, rule.name)
        if not wanted and rule.off == "keep":
            continue
        before = table
        table, found = rule.apply(before, limits)
        if found and not wanted:
            _refuse(found[0])
        findings += found
        changed += changes(rule.name, before, table)
        if len(table) < least:
            raise _too_short(before, table, rule.name)
        if not len(table):
            break
    return table, findings, changed


def _too_short(before: Table, table: Table, rule: str) -> InputError:
    every = f"rows {before.rows[0]} to {before.rows[-1]}" if len(before) else None
    if rule == "before_first_fix" and not len(table):
        fixed = np.count_nonzero(fix) if (fix := clock.has_fix(before)) is not None else 0
        dated = np.count_nonzero(before.time != NO_TIME)
        remedy = "the receiver never saw the sky; nothing can be made of this file"
        if fixed:
            remedy = (
                "the date or the time is missing: check the columns under [time] of the profile"
            )
        return InputError(
            f"no row has both a time and a satellite fix ({fixed} have a fix, {dated} a time)",
            place=every,
            remedy=remedy,
        )
    if rule == "time_unreadable" and not len(table):
        return InputError(
            "no row has a time that can be read",
            place=every,
            remedy="check the columns, format and unit under [time] of the profile",
        )
    return InputError(
        f"{len(table)} row is left after rule '{rule}', a trip needs 2",
        place=f"row {table.rows[0]}" if len(table) else None,
        remedy="check the time column; was the recorder stopped at once?",
    )


def _refuse(finding: Finding) -> None:
    where = f", column {finding.column}" if finding.column else ""
    raise InputError(
        f"{finding.count} times '{finding.rule}', which the profile does not let be repaired",
        place=f"row {finding.rows[0]}{where}" if finding.rows else None,
        remedy=f"correct the file, or set {finding.rule} = true under [repair]",
    )
