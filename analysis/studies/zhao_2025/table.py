"""Tables of `simulation`: what was reached beside Zhao et al. (2025)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.studies.zhao_2025.simulation import CASES, Run
from trainlog.presentation import WordTable, new_table

SPANS = ((5.0, 10.0), (15.0, 20.0), (22.0, 25.0), (27.0, 30.0))
"""In which the axles have come to rest at their slip speeds [s]."""


STARTING = (0.0, 0.1, 0.2, 0.5, 1.0, 2.0)
"""At which the start of case 1 is listed [s]."""


def published_table() -> WordTable:
    """What Zhao et al. (2025) states of its cases."""
    table = new_table("Published; torques in N m", "case", "", "reached there")
    for case in CASES:
        table.add_row(str(case.number), case.name, case.published)
    return table


def torque_table(runs: Sequence[Run]) -> WordTable:
    """Torques, adhesion in use and acceleration of each run, where its axles have come to rest.

    Parameters
    ----------
    runs : sequence of Run
    """
    table = new_table(
        "Reached; means over each span",
        "case",
        "preset",
        "plant",
        "s",
        "torques N m",
        "slip m/s",
        "adhesion",
        "train m/s²",
        "unsolved",
    )
    for run in runs:
        plant = "Euler" if run.integration == "euler" else "RK4"
        head = (str(run.case.number), run.preset.key, plant)
        for number, (start, end) in enumerate(SPANS):
            table.add_row(
                *(head if number == 0 else ("", "", "")),
                f"{start:.0f}-{end:.0f}",
                _axles(run.mean(run.torque, start, end), ".0f"),
                _axles(run.mean(run.slip, start, end), ".2f"),
                _axles(run.mean(run.adhesion, start, end), ".4f"),
                f"{run.mean(run.acceleration, start, end):.2f}",
                f"{run.unsolved} of {run.decisions}" if number == 0 else "",
            )
    return table


def start_table(solved: Run, assumed: Run) -> WordTable:
    """How case 1 begins: solved from the first sample, and with the torque that is assumed there.

    Parameters
    ----------
    solved, assumed : Run
        Of case 1 in the paper's steps; see `first` of `simulation.run`.
    """
    table = new_table(
        "Start of case 1; torque of each motor N m / slip m/s",
        "",
        *(f"{when:g} s" for when in STARTING),
    )
    for name, run in (("solved from 0 s on", solved), ("u(0) assumed, eq. (19)", assumed)):
        rows = np.searchsorted(run.time, np.array(STARTING) - 1e-9)
        table.add_row(name, *(f"{run.torque[k, 0]:.0f} / {run.slip[k, 0]:.2f}" for k in rows))
    return table


def gain_table(runs: Mapping[str, Sequence[Run]]) -> WordTable:
    """What cooperation is worth: force, speed and way of each strategy.

    Parameters
    ----------
    runs : mapping of str to sequence of Run
        By strategy; the same runs in the same order.
    """
    table = new_table(
        "Force on the rail kN, 15-20 s / way m, 30 s / work of creep MJ, 30 s",
        "case",
        "preset",
        "asked N m",
        *runs,
    )
    for found in zip(*runs.values(), strict=True):
        first = found[0]
        table.add_row(
            str(first.case.number),
            first.preset.key,
            f"{first.total:.0f}",
            *(
                f"{run.mean(run.force, 15.0, 20.0) / 1e3:.1f} / {run.position[-1]:.1f}"
                f" / {run.slip_work / 1e6:.2f}"
                for run in found
            ),
        )
    return table


def knowledge_table(runs: Mapping[str, Sequence[Run | None]]) -> WordTable:
    """What it is worth to know the rail.

    Parameters
    ----------
    runs : mapping of str to sequence of Run or None
        By what is known of the rail; the same runs in the same order.
    """
    table = new_table(
        "By what is known of the rail: force on it kN, 15-20 s / way m, 30 s; speeds measured",
        "case",
        "",
        "asked N m",
        *runs,
    )
    for found in zip(*runs.values(), strict=True):
        first = next(run for run in found if run is not None)
        cells = [
            ""
            if run is None
            else f"{run.mean(run.force, 15.0, 20.0) / 1e3:.1f} / {run.position[-1]:.1f}"
            for run in found
        ]
        table.add_row(str(first.case.number), first.case.name, f"{first.total:.0f}", *cells)
    return table


def _axles(values: np.ndarray, form: str) -> str:
    """Values of the axles; those that are alike are listed once: ``3 x 3934, 3349``."""
    texts = [f"{value:{form}}" for value in values]
    groups: list[list[str]] = []
    for text in texts:
        if groups and groups[-1][0] == text:
            groups[-1].append(text)
        else:
            groups.append([text])
    return ", ".join(f"{len(each)} x {each[0]}" if len(each) > 1 else each[0] for each in groups)
