"""Table, picture and data of a recorded trip beside what a model calculates for it."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from analysis.charts import BLUE, GREY, INK, ORANGE, Chart, Curve, Panel, Rule
from analysis.comparison.calculated import Calculation, distinct
from analysis.comparison.diagnosis import Diagnosis
from analysis.comparison.prediction import WIDEST
from trainlog.display import counted
from trainlog.presentation import WordTable, new_table
from trainlog.units import JOULES_PER_KWH, KMH


def calculation_words(found: Calculation) -> list[str]:
    """What the model does not determine, and what of it is wrong."""
    parts = list[str]()
    for quantity, sections in found.not_determined.items():
        parts.append(
            f"the {found.model} does not determine the {quantity} of {', '.join(sections)}: half"
            f" the 95 % band is more than {WIDEST:.0%} of the value, or reaches down to a stand"
        )
    parts.append(f"bands: {found.wind_words}")
    parts.append(
        f"{found.model} against trip '{found.trip}': {found.words}"
        f" ({alarms_words(found.diagnosis)})"
    )
    return parts + [f"{found.trip}: {note}" for note in found.notes]


def alarms_words(found: Diagnosis) -> str:
    """How often a right model is contradicted by chance."""
    return f"about {found.false_alarms:.0%} of trips contradict a right one"


def together_words(found: Sequence[Calculation], together: Diagnosis) -> str:
    """What several trips together contradict of the model."""
    every, found = len(found), distinct(found)
    trips = counted(len(found), "trip")
    if every > len(found):
        trips += f" ({every - len(found)} given twice, counted once)"
    words = f"{found[0].model} against {trips} together: {together.words}"
    outside = [each.trip for each in found if each.outside]
    of = f"{len(outside)} of them ({', '.join(outside)})" if outside else ""
    return words + (f"; sections of {of} are outside of the 95 % band" if outside else "")


def sections_table(found: Calculation) -> WordTable:
    """Running time, speed and tractive work of each section, measured and calculated."""
    table = new_table(
        f"Trip '{found.trip}' against the {found.model}: ± is half the 95 % band",
        "section",
        "time measured [s]",
        "calculated",
        "speed off (RMS)",
        "wheels measured [kWh]",
        "calculated",
        "off",
    )
    for name, row in found.table.iterrows():
        work = row["work"]
        off = work / row["calculated_work"] - 1.0 if row["calculated_work"] else math.nan
        sure = bool(row["work_determined"])
        timed = bool(row["time_determined"])
        known = math.isfinite(row["calculated_time"]) and timed
        needed = _with_band(row["calculated_work"], row["work_std"], JOULES_PER_KWH, 2)
        took = _with_band(row["calculated_time"], row["time_std"], 1.0, 1)
        table.add_row(
            str(name),
            f"{row['time']:.1f}",
            took if timed else "not determined",
            f"{KMH * row['speed_rms']:.1f} km/h" if known else "-",
            f"{work / JOULES_PER_KWH:.2f}" if math.isfinite(work) else "-",
            needed if sure else "not determined",
            f"{off:+.1%}" if math.isfinite(off) and sure else "-",
        )
    return table


def _with_band(value: float, std: float, unit: float, digits: int) -> str:
    if not math.isfinite(value):
        return "-"
    return f"{value / unit:.{digits}f} ± {1.96 * std / unit:.{digits}f}"


def explained_table(found: Calculation) -> WordTable:
    """Share of the squared residual work that each cause explains."""
    table = new_table(
        f"Residuals: {found.residual / JOULES_PER_KWH:.3f} kWh (RMS) in 500 m; explained by",
        "cause",
        "share",
    )
    for name, share in found.explained.items():
        table.add_row(name, f"{share:.0%}")
    return table


def calculation_data(found: Calculation) -> dict[str, Any]:
    """A calculation as data for JSON, in SI units."""
    names = {
        "first": "first_m",
        "last": "last_m",
        "time": "time_s",
        "calculated_time": "calculated_time_s",
        "time_std": "time_std_s",
        "speed_rms": "speed_rms_m_s",
        "work": "work_J",
        "calculated_work": "calculated_work_J",
        "work_std": "work_std_J",
    }
    return {
        "trip": found.trip,
        "model": found.model,
        "sections": found.table.rename(columns=names).reset_index().to_dict("records"),
        "outside": found.outside,
        "verdict": found.words,
        "notes": list(found.notes),
        "explained": found.explained,
        "residual_rms_J": found.residual,
        "wind_recorded": found.wind_recorded,
        "wind_std_m_s": found.wind_std,
        **diagnosis_data(found.diagnosis),
    }


def diagnosis_data(found: Diagnosis) -> dict[str, Any]:
    """What of a model is wrong as data for JSON."""
    return {
        "judged_trips": found.trips,
        "wrong": [
            {
                "name": each.name,
                "factor": each.factor if np.isfinite(each.factor) else None,
                "factor_std": each.std if np.isfinite(each.std) else None,
                "alternatives": list(each.alternatives),
            }
            for each in found.wrong
        ],
        "not_judged": found.reason,
        "false_alarms": found.false_alarms,
    }


def calculation_charts(found: Calculation) -> list[Chart]:
    """Measured and calculated speed along the line, their difference, and the works."""
    place = found.position / 1e3
    speeds = [Curve("measured", place, KMH * found.speed, INK, width=1.4)]
    off = list[Curve]()
    if found.efforts:
        middle, reach = KMH * found.calculated_speed, 1.96 * KMH * found.speed_std
        label = "calculated with the recorded efforts"
        low, high, less = middle - reach, middle + reach, KMH * found.speed
        speeds.append(Curve(label, place, middle, BLUE, "line", low, high, width=1.2, dash="--"))
        off.append(
            Curve("95 % band", place, middle - less, BLUE, "line", low - less, high - less)
        )  # fmt: skip
    along = Chart(
        "km in the direction of travel",
        [
            Panel("speed [km/h]", speeds, 1.3, from_zero=True),
            Panel("calculated less\nmeasured [km/h]", off, 0.8, rules=[Rule(0.0)]),
        ],
        f"Measured and calculated speed of trip {found.trip} over kilometres.",
        line=found.line,
        title=f"Trip '{found.trip}' against the {found.model}: {found.words}",
    )
    rows = np.arange(len(found.table), dtype=np.float64)
    measured, expected, std = (
        found.table[name].to_numpy() / JOULES_PER_KWH
        for name in ("work", "calculated_work", "work_std")
    )
    ends = expected - 1.96 * std, expected + 1.96 * std
    bars = [Curve("calculated, 95 % band", rows + 0.18, expected, ORANGE, "bars", width=0.34)]
    if found.efforts:
        bars.insert(0, Curve("measured", rows - 0.18, measured, GREY, "bars", width=0.34))
    bars.append(Curve("", rows + 0.18, expected, INK, "points", *ends, width=0.5))
    top = 1.3 * float(np.nanmax(np.append(ends[1], measured)))
    works = Chart(
        "", [Panel("tractive work [kWh]", bars, 0.8, limits=(0.0, top))],
        "Measured and calculated tractive work, section by section.",
        ticks=[(float(row), str(name)) for row, name in zip(rows, found.table.index, strict=True)],
        span=(-0.6, rows.size - 0.4),
    )  # fmt: skip
    return [along, works]
