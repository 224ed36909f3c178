"""Measured against calculated: what a fit or a train's file predicts for a recorded trip.

The recorded efforts, in time and size by the trip's passport, drive the train of the model along
the recorded positions. Between the stops the speed follows from the equation of motion by
position,

    d(v²)/ds = 2 (F - R(v, w) - m a_track(s)) / (m + m_rot),

started with the recorded speed in each section, and with it the running time; w is the head wind
where it is recorded. The energy at the
wheels follows from the recorded speeds instead: what the efforts must have done is the change of
kinetic energy, the work against the track and the work against the running resistance.

Both have bands of what is not known: the running resistance of a trip that was not seen, a wind
that is not recorded, the mass,
the gain of the efforts, the gradients, the speed itself.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from analysis.comparison.diagnosis import Diagnosis, Evidence, diagnosed
from analysis.comparison.prediction import (
    WIDEST,
    Cells,
    explained_by,
    inputs_of,
    predicted,
    variants_of,
)
from analysis.comparison.sections import with_units
from analysis.given import Given, trip_of
from analysis.resistance.fit import TripFit
from analysis.resistance.observed import FitOfTrips, parameter_set
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.files import check_kind
from trainlog.formats.railway import train_to_bytes
from trainlog.presentation import (
    DURATION,
    ENERGY,
    SHARE,
    SPEED,
    Band,
    Column,
    Presented,
    Said,
    WordTable,
    new_table,
)
from trainlog.railway import Line, ParameterSet, Train
from trainlog.trip import TRAIN_ATTACHMENT
from trainlog.units import JOULES_PER_KWH


def _calculated(row: Mapping[str, Any], name: str) -> Band | str:
    determined = row[f"{name}_determined"]
    return Band(row[f"calculated_{name}"], row[f"{name}_std"]) if determined else "not determined"


def _off(row: Mapping[str, Any]) -> Said | None:
    off = row["work"] / row["calculated_work"] - 1.0 if row["calculated_work"] else math.nan
    known = math.isfinite(off) and row["work_determined"]
    return Said(off, f"{off:+.1%}") if known else None


SECTIONS = (
    Column("section"),
    Column("time measured", DURATION, of="time"),
    Column("calculated", DURATION, of=lambda row: _calculated(row, "time")),
    Column(
        "speed off (RMS)",
        SPEED,
        of=lambda row: row["speed_rms"] if row["time_determined"] else None,
    ),
    Column("wheels measured", ENERGY, of="work"),
    Column("calculated", ENERGY, of=lambda row: _calculated(row, "work")),
    Column("off", SHARE, of=_off),
)
"""Of a section of a trip: measured and calculated time and work."""


@dataclass(frozen=True, eq=False, repr=False)
class Calculation(Presented):
    """A recorded trip beside what a model calculates for it.

    Attributes
    ----------
    trip, model : str
    table : DataFrame
        By section, SI units: ``first``, ``last`` [m]; ``time`` (in motion), ``calculated_time``,
        ``time_std`` [s]: up to `SLOWEST` and in gaps of the recording the recorded time counts;
        ``speed_rms`` [m/s] of the difference; ``work``, ``calculated_work``, ``work_std`` [J]:
        tractive work at the wheel rims, NaN where speed or efforts are not known;
        ``time_determined``, ``work_determined``: whether half a band is at most `WIDEST` of its
        value, and for a time no speed on the way down to 0.
    position, speed, calculated_speed, speed_std : (n,) array [m], [m/s]
        Where `SLOWEST` was exceeded; NaN elsewhere.
    explained : dict of str to float
        Share of the squared residual work, in windows of `WINDOW`, that each cause explains; what
        is left is ``"unexplained"``. They add up to 1.
    residual : float [J]
        Root mean square of the residual work in a window.
    diagnosis : Diagnosis
        What of the model is wrong, as far as the trip shows it.
    evidence : Evidence
        On which that rests; for `judged_together`.
    wind_std : float [m/s]
        Of the head wind, as far as it is not recorded, that the bands assume.
    wind_recorded : bool
    efforts : bool
        Whether efforts are recorded; without, there is a calculated energy alone.
    notes : tuple of str
    line : Line or None
        As travelled: its kilometres are shown.
    """

    charts_by: ClassVar[str] = "analysis.comparison.plot:calculation_charts"

    trip: str
    model: str
    table: pd.DataFrame
    position: FloatArray
    speed: FloatArray
    calculated_speed: FloatArray
    speed_std: FloatArray
    explained: dict[str, float]
    residual: float
    diagnosis: Diagnosis
    evidence: Evidence
    wind_std: float
    wind_recorded: bool = False
    efforts: bool = True
    notes: tuple[str, ...] = ()
    line: Line | None = None

    @property
    def title(self) -> str:
        """Trip and model."""
        return f"Trip '{self.trip}' against the {self.model}"

    def facts(self) -> dict[str, Any]:
        """What explains the residuals, and what of the model is wrong."""
        return {
            "trip": self.trip,
            "model": self.model,
            "outside": self.outside,
            "verdict": self.words,
            "explained": self.explained,
            "residual_rms_J": self.residual,
            "wind_recorded": self.wind_recorded,
            "wind_std_m_s": self.wind_std,
            **asdict(self.diagnosis),
        }

    def tables(self) -> list[WordTable]:
        """Sections, and what explains the residuals."""
        sections = new_table(
            f"{self.title}: ± is half the 95 % band",
            *SECTIONS,
            name="sections",
            frame=with_units(self.table.reset_index()),
        ).add_rows(self.table.reset_index().to_dict("records"))
        explained = new_table(
            f"Residuals: {self.residual / JOULES_PER_KWH:.3f} kWh (RMS) in 500 m; explained by",
            "cause",
            "share",
        )
        for name, share in self.explained.items():
            explained.add_row(name, f"{share:.0%}")
        return [sections, *([explained] if self.efforts else [])]

    def sentences(self) -> list[str]:
        """What the model does not determine, and what the trip contradicts."""
        alarms = f"about {self.diagnosis.false_alarms:.0%} of trips contradict a right one"
        return [
            *(
                f"the {self.model} does not determine the {quantity} of {', '.join(sections)}: half"
                f" the 95 % band is more than {WIDEST:.0%} of the value, or reaches down to a stand"
                for quantity, sections in self.not_determined.items()
            ),
            f"bands: {self.wind_words}",
            f"{self.model} against trip '{self.trip}': {self.words} ({alarms})",
            *(f"{self.trip}: {note}" for note in self.notes),
        ]

    def summary(self) -> dict[str, str]:
        """Work and time, calculated and measured."""
        rows = {}
        total, std = self.total("calculated_work"), self.total_std("work_std")
        rows["tractive work"] = f"{total / JOULES_PER_KWH:.1f} ± {1.96 * std / JOULES_PER_KWH:.1f}"
        rows["tractive work"] += " kWh calculated"
        if self.efforts:
            rows["tractive work"] += f", {self.total('work') / JOULES_PER_KWH:.1f} kWh measured"
            sure = self.table[self.table["time_determined"]]
            times = float(sure["calculated_time"].sum()), float(sure["time"].sum())
            rows["running time"] = f"{times[0]:.0f} s calculated, {times[1]:.0f} s measured"
            shares = sorted(self.explained.items(), key=lambda item: -item[1])
            rows["residuals"] = ", ".join(f"{name} {share:.0%}" for name, share in shares[:4])
        rows["wind"] = self.wind_words
        rows["model"] = self.words
        return rows

    def same_drive(self, other: Calculation) -> bool:
        """Whether two are of the same recording."""
        pairs = (self.position, other.position), (self.speed, other.speed)
        return all(np.array_equal(a, b, equal_nan=True) for a, b in pairs)

    @property
    def words(self) -> str:
        """What the trip contradicts of the model, in a sentence."""
        if not self.outside:
            return self.diagnosis.words
        where = f"contradicted in {', '.join(self.outside)} (outside of the 95 % band)"
        if self.diagnosis.wrong:
            return f"{where}: {self.diagnosis.words}"
        reason = self.diagnosis.not_judged
        return where + (
            f"; which coefficient is {self.diagnosis.words}"
            if reason
            else "; no coefficient or mass by itself explains it"
        )

    @property
    def not_determined(self) -> dict[str, list[str]]:
        """By quantity, the sections of which the model says less than half."""
        found = {
            words: self.table.index[~self.table[f"{name}_determined"]].tolist()
            for name, words in (("time", "running time"), ("work", "tractive work"))
        }
        return {words: sections for words, sections in found.items() if sections}

    @property
    def wind_words(self) -> str:
        """What the bands assume of the wind, in words."""
        known = "recorded" if self.wind_recorded else "not recorded"
        return f"head wind {known}, ± {1.96 * self.wind_std:.1f} m/s assumed"

    def total(self, column: str) -> float:
        """Sum of a column of the table."""
        return float(self.table[column].sum())

    def total_std(self, column: str) -> float:
        """Standard deviation of the sum: what a trip has in common errs alike in all sections."""
        return float(self.table[column].sum())

    @property
    def outside(self) -> list[str]:
        """Sections whose measured time or work lies outside of the 95 % band."""
        if not self.efforts:
            return []
        table = self.table
        times = (table["time"] - table["calculated_time"]).abs() > 1.96 * table["time_std"]
        works = (table["work"] - table["calculated_work"]).abs() > 1.96 * table["work_std"]
        return table.index[times | works].tolist()


def calculate(
    trip: Given,
    model: ParameterSet | Train | FitOfTrips | TripFit,
    *,
    wind_std: float | None = None,
) -> Calculation:
    """What a fit or a train's file predicts for a recorded trip, section by section.

    Parameters
    ----------
    trip : Trip or path
        With its line and train; with efforts, or else only its energy is calculated.
    model : ParameterSet, Fits, TripFit or Train
        A fit of trips or of one trip: its common curve, with what trips differ by. A train's
        file: at its word, with what trips differ by
        (`analysis.comparison.energy.trip_spread`); its mass counts as well.
    wind_std : float [m/s], optional
        Standard deviation of the head wind as far as it is not recorded, as for a day of known
        weather. Default: `RECORDED_WIND` where it is recorded, else `HEAD_WIND`.

    Returns
    -------
    Calculation

    Raises
    ------
    InputError
        If the fit is of another train, or the wind's standard deviation is negative.
    LogError
        If the trip lacks line, train or chainage.

    Examples
    --------
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> found = calculate("sample_logs/stopping.mcap", train)
    >>> found.diagnosis.wrong
    ()
    >>> bool(abs(found.total("work") / found.total("calculated_work") - 1.0) < 0.03)
    True
    """
    check_kind(model, ParameterSet, Train, FitOfTrips, TripFit)
    if isinstance(model, FitOfTrips):
        model = model.parameters
    elif isinstance(model, TripFit):
        model = parameter_set([model])
    whole = trip_of(trip)
    if isinstance(model, Train):
        whole = replace(
            whole, attachments={**whole.attachments, TRAIN_ATTACHMENT: train_to_bytes(model)}
        )
    if wind_std is not None and not 0.0 <= wind_std < np.inf:
        raise InputError(
            f"a standard deviation of the head wind of {wind_std:g} m/s",
            remedy="give 0 or more, in m/s",
        )
    inputs = inputs_of(whole, model, wind_std)
    cells = Cells.of(inputs)
    variants = variants_of(inputs)
    table, speeds, spread = predicted(inputs, cells, variants)
    efforts = inputs.efforts
    explained, residual = explained_by(inputs, cells) if efforts else ({}, 0.0)
    of_file = isinstance(model, Train)
    evidence = Evidence.of(
        inputs.trip, inputs.model, inputs.shown_gain, inputs.wind_std, of_file=of_file
    )
    return Calculation(
        trip=inputs.driven.name,
        model=inputs.model.name,
        table=table,
        position=cells.nodes,
        speed=np.where(cells.fast & ~cells.inside_gap, cells.speed, np.nan),
        calculated_speed=np.where(cells.fast, speeds, np.nan),
        speed_std=np.where(cells.fast, spread, np.nan),
        explained=explained,
        residual=residual,
        diagnosis=diagnosed([evidence]),
        evidence=evidence,
        wind_std=inputs.wind_std,
        wind_recorded=inputs.windy,
        efforts=efforts,
        notes=inputs.driven.notes,
        line=inputs.driven.line,
    )


def judged_together(found: Sequence[Calculation]) -> Diagnosis:
    """What several trips contradict of the model that calculated them.

    The same drive given twice counts once.

    Raises
    ------
    InputError
        If there is none, or they are of different trains.
    """
    return diagnosed([each.evidence for each in distinct(found)])


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


def distinct(found: Sequence[Calculation]) -> list[Calculation]:
    """One calculation of each drive: recorded speeds of two are never alike throughout."""
    kept: list[Calculation] = []
    for each in found:
        if not any(each.same_drive(other) for other in kept):
            kept.append(each)
    return kept
