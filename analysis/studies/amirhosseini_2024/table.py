"""Tables that put what a study reached beside what its paper published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.studies.amirhosseini_2024.simulation import Run, worst
from trainlog.arrays import FloatArray
from trainlog.presentation import WordTable, new_table

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
    table = new_table(
        "Largest errors of position (m) and speed (m/s), error at the stop (m)",
        "estimator",
        "published",
        "reached",
        "slopes shifted within a sample",
        "speed measured",
    )
    for name, run in exact.items():
        others = shifted.get(name)
        table.add_row(
            name,
            _published(run.variant.published),
            _shown(run.figures),
            _shown(worst(others)) if others else "",
            _shown(measured[name].figures),
        )
    return table


def coefficients_table(exact: Mapping[str, Run], measured: Mapping[str, Run]) -> WordTable:
    """How far the single coefficients are from the true ones, beside figure 6 of the paper.

    The error of an estimate is the median of its amount after the first `SETTLED` seconds, as a
    share of the mean true value: after each reset it is far greater for a while.

    Parameters
    ----------
    exact, measured : mapping of str to Run
        By name of the variant; those that estimate three coefficients are listed.
    """
    table = new_table(
        f"Estimated coefficients after {SETTLED:g} s: median error over the mean true value (%)",
        "estimator",
        "speed",
        "a0 + f2",
        "a1",
        "a2",
        "their sum",
    )
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
    table = new_table(
        "Eight wagons, eqs. (2)-(9): the same errors, and the couplers' forces (kN)",
        "estimator",
        "traction",
        "one particle",
        "eight wagons",
        "largest draft / buff",
    )
    for run in coupled:
        alone = any(vehicle.max_tractive_effort == 0.0 for vehicle in run.train.vehicles)
        forces = run.coupler_forces / 1e3
        table.add_row(
            run.variant.name,
            "first wagon" if alone else "every wagon",
            _shown(exact[run.variant.name].figures),
            _shown(run.figures),
            f"{forces.max():.1f} / {-forces.min():.1f}",
        )
    return table


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
