"""The study of Zhao et al. (2025): its runs, as logs, pictures and tables."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from itertools import groupby
from typing import Any, Literal

import numpy as np

from analysis.charts import (
    BLUE,
    GREY,
    INK,
    ORANGE,
    PALE,
    RED,
    SKY,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    Span,
)
from analysis.studies.report import StudyReport, study_trip
from analysis.studies.zhao_2025 import simulation as study
from analysis.studies.zhao_2025.simulation import (
    CASES,
    RESTORED,
    WET_SPAN,
    Case,
    Preset,
    Run,
)
from trainlog.arrays import FloatArray
from trainlog.formats.railway import train_to_bytes
from trainlog.presentation import Columns, WordTable, word_table
from trainlog.railway import Line, Station, StepProfile
from trainlog.railway.adhesion import DRY, WET
from trainlog.railway.train import Axles, Train
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_ADHESION,
    GNSS_MOTION,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
    TRUTH,
)
from trainlog.trip import TRAIN_ATTACHMENT, Trip
from trainlog.units import GRAVITY, KMH

SPANS = ((5.0, 10.0), (15.0, 20.0), (22.0, 25.0), (27.0, 30.0))
"""In which the axles have come to rest at their slip speeds [s]."""


STARTING = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)
"""At which the start of case 1 is listed [s]."""


def published_table() -> WordTable:
    """What Zhao et al. (2025) states of its cases."""
    of: Columns[Case] = {
        "case": lambda case: case.number,
        "": lambda case: case.name,
        "reached there": lambda case: case.published,
    }
    return word_table("Published; torques in N m", CASES, of)


def torque_table(runs: Sequence[Run]) -> WordTable:
    """Torques, adhesion in use and acceleration of each run, where its axles have come to rest.

    Parameters
    ----------
    runs : sequence of Run
    """
    of: Columns[tuple[Run, int]] = {
        "case": lambda row: "" if row[1] else row[0].case.number,
        "preset": lambda row: "" if row[1] else row[0].preset.key,
        "plant": lambda row: "" if row[1] else "Euler" if row[0].integration == "euler" else "RK4",
        "s": lambda row: "{:.0f}-{:.0f}".format(*SPANS[row[1]]),
        "torques N m": lambda row: _axles(_mean(row, row[0].torque), ".0f"),
        "slip m/s": lambda row: _axles(_mean(row, row[0].slip), ".2f"),
        "adhesion": lambda row: _axles(_mean(row, row[0].adhesion), ".4f"),
        "train m/s²": lambda row: f"{_mean(row, row[0].acceleration):.2f}",
        "unsolved": lambda row: "" if row[1] else f"{row[0].unsolved} of {row[0].decisions}",
    }
    rows = ((run, number) for run in runs for number in range(len(SPANS)))
    return word_table("Reached; means over each span", rows, of)


def _mean(row: tuple[Run, int], values: FloatArray) -> Any:
    run, number = row
    return run.mean(values, *SPANS[number])


def start_table(solved: Run, assumed: Run) -> WordTable:
    """How case 1 begins: solved from the first sample, and with the torque that is assumed there.

    Parameters
    ----------
    solved, assumed : Run
        Of case 1 in the paper's steps; see `first` of `simulation.run`.
    """
    rows = {"solved from 0 s on": solved, "u(0) assumed, eq. (19)": assumed}

    def at(when: float) -> Callable[[tuple[str, Run]], str]:
        def cell(row: tuple[str, Run]) -> str:
            k = np.searchsorted(row[1].time, when - 1e-9)
            return f"{row[1].torque[k, 0]:.0f} / {row[1].slip[k, 0]:.2f}"

        return cell

    of: Columns[tuple[str, Run]] = {"": lambda row: row[0]}
    of |= {f"{when:g} s": at(when) for when in STARTING}
    title = "Start of case 1; torque of each motor N m / slip m/s"
    return word_table(title, rows.items(), of)


def gain_table(runs: Mapping[str, Sequence[Run]]) -> WordTable:
    """What cooperation is worth: force, speed and way of each strategy.

    Parameters
    ----------
    runs : mapping of str to sequence of Run
        By strategy; the same runs in the same order.
    """

    def figures(number: int) -> Callable[[Sequence[Run]], str]:
        return lambda found: (
            f"{_force_and_way(found[number])} / {found[number].slip_work / 1e6:.2f}"
        )

    of: Columns[Sequence[Run]] = {
        "case": lambda found: found[0].case.number,
        "preset": lambda found: found[0].preset.key,
        "asked N m": lambda found: f"{found[0].total:.0f}",
        **{name: figures(number) for number, name in enumerate(runs)},
    }
    rows: Iterable[Sequence[Run]] = zip(*runs.values(), strict=True)
    title = "Force on the rail kN, 15-20 s / way m, 30 s / work of creep MJ, 30 s"
    return word_table(title, rows, of)


def _force_and_way(run: Run) -> str:
    return f"{run.mean(run.force, 15.0, 20.0) / 1e3:.1f} / {run.position[-1]:.1f}"


def _axles(values: np.ndarray, form: str) -> str:
    """Values of the axles; those that are alike are listed once: ``3 x 3934, 3349``."""
    groups = [(text, len([*alike])) for text, alike in groupby(f"{each:{form}}" for each in values)]
    return ", ".join(f"{count} x {text}" if count > 1 else text for text, count in groups)


AXLES = ((BLUE, 4.0), (SKY, 2.8), (ORANGE, 1.6), (RED, 0.7))
"""Colours and widths of the axles: those that run alike lie on one another."""

WHEN_WET = [Span(*WET_SPAN, SKY, opacity=0.12)]
"""Marks when the rail is wet."""


def _pair(left: Panel, right: Panel, title: str = "") -> list[Chart]:
    """Two panels over time beside each other."""
    return [
        Chart("time [s]", [left], title=title, width=0.5),
        Chart("time [s]", [right], width=0.5, beside=True),
    ]


def study_charts(runs: Sequence[Run]) -> dict[str, list[Chart]]:
    """The paper's figures of every run, by the files' names.

    Parameters
    ----------
    runs : sequence of Run
    """
    stepped = {(run.preset.key, run.case.number): run for run in runs if run.integration == "euler"}
    charts = {"figure-02-adhesion.png": [_curves()]}
    for run in (each for each in runs if each.integration != "euler"):
        key, number = run.preset.key, run.case.number
        name = f"figure-{number + 2:02d}-case-{number}-{key}.png"
        charts[name] = _case(run, stepped.get((key, number)))
    return charts


def _curves() -> Chart:
    """Fig. 2: adhesion coefficient over slip speed."""
    slip = np.linspace(0.0, 10.0, 401)
    curves, labels = list[Curve](), list[Label]()
    for curve, colour, name in ((DRY, RED, "dry"), (WET, BLUE, "wet")):
        at, peak = curve.peak_slip, curve.peak
        curves.append(Curve(name, slip, curve(slip), colour))
        curves.append(Curve("", [at], [peak], colour, "points", width=3.0))
        words = f"   {at:.2f} m/s, {peak:.3f}"
        labels.append(Label(at, words, peak + 0.01, side="left", size=8.0))
    panel = Panel("adhesion coefficient", curves, 1.3, limits=(0.0, 0.32), labels=labels)
    return Chart("slip speed [m/s]", [panel], title="Fig. 2  Creep curves", width=0.65)


def _case(run: Run, stepped: Run | None) -> list[Chart]:
    """Figs. 3-6: slip speeds and references, their errors, torques, adhesion coefficients.

    Where there is a run in the paper's steps, it is laid over as dots.
    """

    def panel(unit: str, title: str, values: str, wide: str = "", **options: Any) -> Panel:
        sought, found = (
            getattr(run, name).T if name else [None] * len(AXLES) for name in (wide, values)
        )
        curves = [Curve("", run.time, each, PALE, width=7.0) for each in sought if each is not None]
        kind: Literal["step", "line"] = "step" if values == "torque" else "line"
        curves += [
            Curve(f"axle {number}" if values == "slip" else "", run.time, each, colour, kind,
                  width=width)
            for number, (each, (colour, width)) in enumerate(zip(found, AXLES, strict=True), 1)
        ]  # fmt: skip
        if stepped is not None:
            dots = getattr(stepped, values).T
            curves += [Curve("", stepped.time, each, INK, "points", width=0.6) for each in dots]
        return Panel(unit, curves, 1.2, title, spans=WHEN_WET, **options)

    limit = run.preset.locomotive.torque_limit
    plant = "Runge-Kutta" if stepped is None else "Runge-Kutta; dots: Euler in steps of 0.1 s"
    title = (
        f"Fig. {run.case.number + 2}  Case {run.case.number}: {run.case.name}"
        f" ({run.preset.locomotive.name}; {plant})"
    )
    return [
        *_pair(
            panel("m/s", "(a)  Slip speed; wide: its reference", "slip", "reference"),
            panel("m/s", "(b)  Reference less slip speed", "slip_error"),
            title,
        ),
        *_pair(
            panel("N m", "(c)  Torque of the motors; dotted: limit of a motor", "torque",
                  rules=[Rule(limit, GREY, dash=":")], limits=(-0.03 * limit, 1.12 * limit)),
            panel("", "(d)  Adhesion coefficient; wide: the most the rail gives", "adhesion",
                  "maximum_adhesion"),
        ),
    ]  # fmt: skip


LENGTH = 2_500.0
"""Of the line [m]; the paper's locomotive comes about 1,000 m far."""

TOP_SPEED = 200.0 / KMH
"""Of line and locomotive [m/s]; the runs know no limit but the motors'."""

SPEED_STD = 0.01
"""Stated of the train speed [m/s], which the controller knows exactly."""


def main(report: StudyReport) -> None:
    """Run the cases as published, and without cooperation."""
    runs = [
        study.run(case, preset, integration=integration)
        for case, preset, integration in report.track(study.PLANS, "driving")
    ]
    for run in runs:
        report.log(trip_of(run))
    assumed = study.run(study.CASES[0], integration="euler", first=study.FIRST_TORQUE)
    compared = {
        strategy: [study.run(*plan, strategy=strategy) for plan in study.COMPARED]
        for strategy in report.track(study.STRATEGIES, "comparing")
    }
    report.draw(study_charts(runs))
    report.show(
        published_table(), start_table(runs[0], assumed), torque_table(runs), gain_table(compared)
    )


def trip_of(run: Run) -> Trip:
    """The log of one run.

    The train speed that the controller sees stands in ``/gnss/motion``: all axles are driven, and
    ``/train/state`` has the mean of their wheels. ``/estimates/adhesion`` holds what the
    controller knows, here the truth.
    """
    locomotive = run.preset.locomotive
    effort = locomotive.effort_per_torque * run.torque
    rate = np.diff(run.time, prepend=0.0)
    energy = np.cumsum(np.r_[0.0, (effort * run.wheel_speed).sum(axis=1)[:-1]] * rate)
    return study_trip(
        name_of(run),
        locomotive.name,
        line(),
        run.time,
        {
            TRAIN_STATE: {
                "position": run.position,
                "speed": run.wheel_speed.mean(axis=1),
                "acceleration": run.acceleration,
            },
            TRAIN_CONTROLS: {
                "tractive_effort_demand": locomotive.effort_per_torque * locomotive.total_torque,
                "braking_effort_demand": 0.0,
                "tractive_effort": effort.sum(axis=1),
                "dynamic_braking_effort": 0.0,
                "pneumatic_braking_effort": 0.0,
            },
            TRAIN_AXLES: {"wheel_speed": run.wheel_speed, "wheel_effort": effort},
            GNSS_MOTION: {"speed": run.speed, "speed_accuracy": SPEED_STD},
            ENVIRONMENT: {"speed_limit": TOP_SPEED, "gradient": 0.0, "curvature": 0.0},
            ESTIMATED_ADHESION: {"adhesion": run.adhesion, "slip_speed": run.slip},
            TRUTH: {
                "position": run.position,
                "speed": run.speed,
                "acceleration": run.acceleration,
                "running_resistance": locomotive.resistance(run.speed),
                "maximum_adhesion": run.maximum_adhesion.mean(axis=1),
                "energy": energy,
            },
        },
        (
            "study cooperative-adhesion",
            {
                "case": run.case.number,
                "preset": run.preset.key,
                "strategy": run.strategy,
                "integration": run.integration,
            },
        ),
        attachments={TRAIN_ATTACHMENT: train_to_bytes(train(run.preset))},
        metadata={
            "load": "0",
            "traction_control": run.strategy,
            "traction_decisions": str(run.decisions),
            "traction_unsolved": str(run.unsolved),
            "study": "Zhao et al. (2025), section 4",
        },
        events=_events(run.case),
    )


def name_of(run: Run) -> str:
    """Name of a run: its case, its preset, and what is unusual of it."""
    words = [f"case-{run.case.number}", run.preset.key]
    if run.strategy != "cooperative":
        words.append(run.strategy.replace(" ", "-"))
    if run.integration == "euler":
        words.append("euler")
    return "-".join(words)


def line() -> Line:
    """Straight and level."""
    return Line(
        name="straight and level",
        length=LENGTH,
        stations=(Station("start", 0.0), Station("end", LENGTH)),
        speed_limits=StepProfile(np.zeros(1), np.array([TOP_SPEED])),
        gradients=StepProfile(np.zeros(1), np.zeros(1)),
        source="Zhao et al. (2025), which states no line",
    )


def train(preset: Preset) -> Train:
    """Locomotive and train as one train file: axles, resistance, limits at the wheel rims."""
    locomotive = preset.locomotive
    effort = locomotive.effort_per_torque * locomotive.total_torque
    rotating = locomotive.axles * locomotive.rotating_mass
    return Train(
        name=locomotive.name,
        mass=locomotive.mass,
        rotating_mass_factor=rotating / locomotive.mass,
        resistance=locomotive.resistance,
        max_tractive_effort=effort,
        max_traction_power=effort * TOP_SPEED,
        max_speed=TOP_SPEED,
        max_acceleration=3.0,
        length=20.0,
        axles=Axles(
            count=locomotive.axles,
            adhesive_mass=float(locomotive.loads.sum()) / GRAVITY,
            wheel_radius=locomotive.wheel_radius,
            rotating_mass=locomotive.rotating_mass,
        ),
        source="Zhao et al. (2025), table 2, and what is chosen beside it",
    )


def _events(case: Case) -> list[tuple[float, str, str]]:
    axles = "axle" if len(case.wet) == 1 else "axles"
    which = f"{axles} {', '.join(str(axle) for axle in case.wet)}"
    found = [
        (0.0, "departure", "train"),
        (WET_SPAN[0], f"wet rail under {which}", "rail"),
        (WET_SPAN[1], f"dry rail under {which}", "rail"),
    ]
    if case.fails:
        found.append((WET_SPAN[0], "motor 4 fails", "drive"))
        found.append((RESTORED, "motor 4 works again", "drive"))
    return sorted(found)
