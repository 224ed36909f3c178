"""Tables that put what a study reached beside what its paper published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.studies.amirhosseini_2024.simulation import Run, worst
from trainlog.arrays import FloatArray
from trainlog.presentation import Columns, WordTable, new_table, word_table

Figures = tuple[float | None, float | None, float | None]

SETTLED = 200.0
"""After which the coefficients are judged [s]."""


def errors_table(
    exact: Mapping[str, Run],
    measured: Mapping[str, Run],
    shifted: Mapping[str, Sequence[Run]],
) -> WordTable:
    """Largest errors of Amirhosseini et al. (2024): published, reached, and with measured speed.

    Parameters
    ----------
    exact, measured : mapping of str to Run
        By name of the variant.
    shifted : mapping of str to sequence of Run
        Runs with the slopes shifted within one sample, of which the worst is stated.
    """
    of: Columns[tuple[str, Run]] = {
        "estimator": lambda row: row[0],
        "published": lambda row: _published(row[1].variant.published),
        "reached": lambda row: _shown(row[1].figures),
        "slopes shifted within a sample": lambda row: (
            _shown(worst(shifted[row[0]])) if shifted.get(row[0]) else ""
        ),
        "speed measured": lambda row: _shown(measured[row[0]].figures),
    }
    title = "Largest errors of position (m) and speed (m/s), error at the stop (m)"
    return word_table(title, exact.items(), of)


def coefficients_table(exact: Mapping[str, Run], measured: Mapping[str, Run]) -> WordTable:
    """How far the single coefficients are from the true ones, beside figure 6 of the paper.

    The error of an estimate is the median of its amount after the first `SETTLED` seconds, as a
    share of the mean true value: after each reset it is far greater for a while.

    Parameters
    ----------
    exact, measured : mapping of str to Run
        By name of the variant; those that estimate three coefficients are listed.
    """
    title = f"Estimated coefficients after {SETTLED:g} s: median error over the mean true value (%)"
    names = ("a0 + f2", "a1", "a2", "their sum")
    table = new_table(title, "estimator", "speed", *names)
    for speed, runs in (("exact", exact), ("measured", measured)):
        for name, run in runs.items():
            if run.variant.parameters == 3:
                errors = coefficient_errors(run)
                table.add_row(name, speed, *(f"{100.0 * error:.1f}" for error in errors))
    return table


def coefficient_errors(run: Run) -> FloatArray:
    """Relative median errors of a0 + f2, a1, a2 and of the sum of all resistances; (4,) array."""
    true = np.column_stack([run.coefficients, run.resistance])
    true[:, 0] += run.slope_force
    late = run.time > SETTLED
    error = np.column_stack([run.theta, run.estimate])[late] - true[late]
    mean = np.abs(true[late]).mean(axis=0)
    return np.asarray(np.median(np.abs(error), axis=0) / mean)


def eight_wagons_table(exact: Mapping[str, Run], coupled: Sequence[Run]) -> WordTable:
    """The multi-particle train under the paper's control, beside the single particle.

    Parameters
    ----------
    exact : mapping of str to Run
        Of the single particle, by name of the variant.
    coupled : sequence of Run
        Of the eight wagons.
    """
    of: Columns[Run] = {
        "estimator": lambda run: run.variant.name,
        "traction": lambda run: (
            "first wagon"
            if any(vehicle.max_tractive_effort == 0.0 for vehicle in run.train.vehicles)
            else "every wagon"
        ),
        "one particle": lambda run: _shown(exact[run.variant.name].figures),
        "eight wagons": lambda run: _shown(run.figures),
        "largest draft / buff": lambda run: (
            f"{run.coupler_forces.max() / 1e3:.1f} / {-run.coupler_forces.min() / 1e3:.1f}"
        ),
    }
    title = "Eight wagons, eqs. (2)-(9): the same errors, and the couplers' forces (kN)"
    return word_table(title, coupled, of)


def _published(figures: Figures) -> str:
    if figures == (None, None, None):
        return "not tried"
    if figures[1:] == (None, None):
        return f"more than {figures[0]:g}"
    return _shown(figures)


def _shown(figures: Figures) -> str:
    digits = (2, 3, 4)
    return " / ".join(
        "–" if value is None else f"{value:.{count}f}"
        for value, count in zip(figures, digits, strict=True)
    )
