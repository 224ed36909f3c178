"""Tables that put what a study reached beside what its paper published."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich.table import Table

from analysis.studies.amirhosseini_2024.run import Run, worst
from analysis.tables import new_table

Figures = tuple[float | None, float | None, float | None]


def rls_sliding_mode_table(
    exact: Mapping[str, Run],
    measured: Mapping[str, Run],
    shifted: Mapping[str, Sequence[Run]],
) -> Table:
    """Largest errors of paper 004: published, reached, and with measured speed.

    Parameters
    ----------
    exact, measured : mapping of str to Run
        By name of the variant.
    shifted : mapping of str to sequence of Run
        Runs with the slopes shifted within one sample: their worst is told too.
    """
    table = new_table(
        "Paper 004: largest errors of position (m) and speed (m/s), error at the stop (m)",
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


def eight_wagons_table(exact: Mapping[str, Run], coupled: Sequence[Run]) -> Table:
    """The multi-particle train under the paper's control, beside the single particle.

    Parameters
    ----------
    exact : mapping of str to Run
        Of the single particle, by name of the variant.
    coupled : sequence of Run
        Of the eight wagons.
    """
    table = new_table(
        "Paper 004, eqs. (2)-(9): eight wagons; the same errors, and the couplers' forces (kN)",
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
