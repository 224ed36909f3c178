"""The study of Amirhosseini et al. (2024): its runs, as logs, pictures and tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import ArrayLike

from analysis.charts import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Chart, Curve, Panel
from analysis.studies.amirhosseini_2024 import simulation as study
from analysis.studies.amirhosseini_2024.simulation import PERIOD, SPEED_NOISE, VARIANTS, Run, worst
from analysis.studies.report import StudyReport, study_trip
from trainlog.arrays import FloatArray, IntArray
from trainlog.formats.declared import thing_to_bytes
from trainlog.presentation import Columns, WordTable, new_table, word_table
from trainlog.railway.resistance import TERMS
from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_RESISTANCE,
    REFERENCE,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_STATE,
    TRUTH,
    Topic,
)
from trainlog.trip import Trip
from trainlog.units import KMH

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
            (
                "first wagon"
                if any(vehicle.max_tractive_effort == 0.0 for vehicle in run.train.vehicles)
                else "every wagon"
            )
            + (", ε below 0" if run.train.couplers[0].nonlinearity < 0.0 else "")
        ),
        "one particle": lambda run: _shown(exact[run.variant.name].figures),
        "eight wagons": lambda run: _shown(run.figures),
        "largest draft / buff": lambda run: (
            f"{run.coupler_forces.max() / 1e3:.1f} / {-run.coupler_forces.min() / 1e3:.1f}"
        ),
    }
    title = "Eight wagons, eqs. (2)-(9): the same errors, and the couplers' forces (kN)"
    return word_table(title, coupled, of)


def claims_table(exact: Mapping[str, Run], obstructed: Run) -> WordTable:
    """What section 5 states in words of figures 9, 10, 13 and 14, and eq. (6) with all its terms.

    Parameters
    ----------
    exact : mapping of str to Run
        By name of the variant.
    obstructed : Run
        The scalar variant on a line with a curve in a tunnel.
    """
    scalar, spatial = exact["scalar"], exact["spatial reset"]
    off, steps = np.abs(scalar.estimate - scalar.resistance), np.diff(scalar.slope_force)
    worst, most = int(np.argmax(off)), int(np.argmax(np.abs(steps)))
    jumps, sways = (
        [figure(run) / 1e3 for run in (scalar, spatial)]
        for figure in (lambda run: np.abs(np.diff(run.effort)).max(), effort_sway)
    )
    table = new_table("Statements of section 5 of the paper", "statement", "published", "reached")
    for row in (
        ("scalar: settled after an edge, at most [s]", "30", f"{settling(scalar):.1f}"),
        (
            "scalar: largest error of the estimate [kN] at km",
            "at the largest disturbance",
            f"{off[worst] / 1e3:.1f} at {scalar.position[worst] / 1e3:.2f};"
            f" {abs(steps[most]) / 1e3:.1f} at {scalar.position[most] / 1e3:.2f}",
        ),
        (
            "largest jump of the effort, scalar / spatial reset [kN]",
            "less with the scalar",
            f"{jumps[0]:.1f} / {jumps[1]:.1f}",
        ),
        (
            "sway of the effort in the 30 s after each edge, the same [kN]",
            "more with the scalar",
            f"{sways[0]:.1f} / {sways[1]:.1f}",
        ),
        (
            "largest effort, the same [kN]",
            "within 250",
            f"{np.abs(scalar.effort).max() / 1e3:.1f} / {np.abs(spatial.effort).max() / 1e3:.1f}",
        ),
        (
            "eq. (6), curve of 400 m in 3 km of tunnel: errors",
            "not run",
            _shown(obstructed.figures),
        ),
    ):
        table.add_row(*row)
    return table


def _edges(run: Run) -> IntArray:
    """Samples after which the slope has changed."""
    return np.flatnonzero(np.abs(np.diff(run.slope_force)) > 1e3) + 1


def settling(run: Run, within: float = 100.0) -> float:
    """Longest time after an edge until the estimate stays within so many newtons [s]."""
    off = np.abs(run.estimate - run.resistance)
    off[run.speed < 0.05] = 0.0  # at standstill nothing resists
    parts = np.split(off > within, _edges(run))
    return PERIOD * max(int(np.flatnonzero(part).max(initial=-1)) + 1 for part in parts)


def effort_sway(run: Run, span: float = 30.0) -> float:
    """Up and down of the effort beyond its change, in a time [s] after each edge; the sum [N]."""
    rows = [run.effort[edge : edge + round(span / PERIOD) + 1] for edge in _edges(run) - 1]
    return float(sum(np.abs(np.diff(row)).sum() - abs(row[-1] - row[0]) for row in rows))


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


COLOURS = dict(zip((v.name for v in VARIANTS), (GREEN, BLUE, RED, ORANGE), strict=True))
"""Of the variants."""

SECONDS = "time [s]"


def study_charts(runs: Mapping[str, Run]) -> dict[str, list[Chart]]:
    """The paper's figures by the names of their files.

    Parameters
    ----------
    runs : mapping of str to Run
        With exact speed, by name of the variant.
    """
    timed, spatial = runs["time reset"], runs["spatial reset"]
    return {
        "figures-01-03-profile.png": _profile(spatial),
        "figures-04-05-time-reset.png": _learning(timed, "Figs. 4 and 5"),
        "figures-06-09-spatial-reset.png": _learning(spatial, "Figs. 6 to 9"),
        "figures-10-14-scalar.png": _scalar(runs["scalar"]),
    }


def _profile(run: Run) -> list[Chart]:
    """Figs. 1-3: speed over position and over time, force of the slopes."""
    desired, slopes = KMH * run.target_speed, run.slope_force / 1e3
    over_km = Curve("", run.target_position / 1e3, desired)
    return [
        Chart("km", [Panel("km/h", [over_km], title="Fig. 1  Desired speed over position")]),
        Chart(
            SECONDS,
            [
                Panel("km/h", [Curve("", run.time, desired)], 1.0, "Fig. 2  The same over time"),
                Panel("kN", [Curve("", run.time, slopes, RED, "step")], 1.0,
                      "Fig. 3  Force of the slopes, f2"),
            ],
        ),
    ]  # fmt: skip


def _estimate(run: Run, truth: FloatArray, found: FloatArray, unit: str, title: str) -> Panel:
    """An estimate beside the truth; one that has not settled would hide the rest."""
    curves = [
        Curve("true", run.time, truth, GREY, width=2.5),
        Curve("estimated", run.time, found, width=1.0),
    ]
    settled = np.concatenate([truth, found[found.size // 6 :]])
    margin = 0.1 * max(float(np.ptp(settled)), 1e-9)
    limits = (float(settled.min()) - margin, float(settled.max()) + margin)
    return Panel(unit, curves, title=title, limits=limits)


def _learning(run: Run, title: str) -> list[Chart]:
    """Estimates of a0 + f2, a1, a2; errors of position and speed; the control signal."""
    true = [run.coefficients[:, 0] + run.slope_force, *run.coefficients.T[1:]]
    named = ((1e3, "kN", "a0 + f2"), (1.0, "N/(m/s)", "a1"), (1.0, "N/(m/s)²", "a2"))
    panels = [
        _estimate(run, truth / scale, found / scale, unit, f"Estimate of {name}")
        for truth, found, (scale, unit, name) in zip(true, run.theta.T, named, strict=False)
    ]
    return [Chart(SECONDS, [*panels, *_errors(run)], title=title)]


def _scalar(run: Run) -> list[Chart]:
    """Figs. 10-14: the sum of all resistances, errors, control, error of the estimate."""
    off = Curve("", run.time, (run.estimate - run.resistance) / 1e3, PURPLE, width=0.8)
    panels = [
        _estimate(run, run.resistance / 1e3, run.estimate / 1e3, "kN", "All resistances together"),
        *_errors(run),
        Panel("kN", [off], title="Error of the estimate"),
    ]
    return [Chart(SECONDS, panels, title="Figs. 10 to 14")]


def _errors(run: Run) -> list[Panel]:
    colour = COLOURS[run.variant.name]
    return [
        Panel(unit, [Curve("", run.time, values, colour, width=0.9)], title=title)
        for values, unit, title in (
            (run.position_error, "m", "Position error"),
            (run.speed_error, "m/s", "Speed error"),
            (run.effort / 1e3, "kN", "Control signal"),
        )
    ]


SHIFTS = 5
"""Positions of the slopes within one sample."""


def main(report: StudyReport, seed: int) -> None:
    """Run every estimator with exact and with measured speed, shifted slopes, and eight wagons."""
    scalar, spatial = VARIANTS[:2]
    tracks = [study.line(float(shift)) for shift in study.edge_shifts(SHIFTS)[1:]]
    plans = [
        *((variant, 0.0, None) for variant in VARIANTS),
        *((variant, SPEED_NOISE, None) for variant in VARIANTS),
        *((spatial, 0.0, track) for track in tracks),
        (scalar, 0.0, study.line(curved_tunnel=True)),
    ]
    runs = [
        study.run(variant, noise=noise, track=track, seed=seed)
        for variant, noise, track in report.track(plans, "driving")
    ]
    count = len(VARIANTS)
    exact = {run.variant.name: run for run in runs[:count]}
    measured = {run.variant.name: run for run in runs[count : 2 * count]}
    trains = [study.eight_wagons(), study.eight_wagons(first_pulls=True)]
    softening = study.eight_wagons(first_pulls=True, softening=True)
    coupled = [
        study.run(variant, train=train, seed=seed)
        for variant, train in report.track(
            [*((variant, each) for variant in (scalar, spatial) for each in trains),
             (scalar, softening)],
            "driving eight wagons",
        )
    ]  # fmt: skip
    for run in (*runs[: 2 * count], *coupled):
        report.log(trip_of(run, seed))
    report.draw(study_charts(exact))
    shifted = [exact[spatial.name], *runs[2 * count : -1]]
    report.show(
        errors_table(exact, measured, {spatial.name: shifted}),
        claims_table(exact, runs[-1]),
        coefficients_table(exact, measured),
        eight_wagons_table(exact, coupled),
    )


def trip_of(run: Run, seed: int) -> Trip:
    """The log of one run.

    In ``/estimates/running_resistance`` ``r0`` is the estimate of a0 + f2, the slope included, as
    eq. (24) has it; the scalar variant knows only the sum, which stands in ``resistance``.
    """
    slopes = run.track
    estimates = {"resistance": run.estimate}
    if run.variant.parameters == 3:
        estimates |= dict(zip(TERMS, run.theta.T, strict=True))
    else:
        estimates["resistance_std"] = run.theta_std[:, 0]
    traction, braking = np.maximum(run.effort, 0.0), np.maximum(-run.effort, 0.0)
    running = run.resistance - run.slope_force
    targets = [study.target(now) for now in run.time]
    needed = study.MASS * np.array([each.acceleration for each in targets]) + run.resistance
    topics: dict[Topic, dict[str, ArrayLike]] = {
        TRAIN_STATE: {"position": run.position, "speed": run.measured_speed},
        TRAIN_CONTROLS: {
            "tractive_effort_demand": traction,
            "braking_effort_demand": braking,
            "tractive_effort": traction,
            "dynamic_braking_effort": braking,
            "pneumatic_braking_effort": 0.0,
        },
        ENVIRONMENT: {
            "gradient": slopes.gradient(run.position),
            "speed_limit": slopes.speed_limit(run.position),
        },
        ESTIMATED_RESISTANCE: {**estimates, "mass": study.MASS},
        REFERENCE: {
            "speed": run.target_speed,
            "tractive_effort": np.maximum(needed, 0.0),
            "braking_effort": np.maximum(-needed, 0.0),
        },
        TRUTH: {"position": run.position, "speed": run.speed, "running_resistance": running},
    }
    if run.train.couplers:
        topics[TRAIN_COUPLERS] = {"force": run.coupler_forces}
    return study_trip(
        name_of(run),
        run.train.name,
        slopes,
        run.time,
        topics,
        (
            "study rls-sliding-mode",
            {"seed": seed, "variant": run.variant.name, "speed_noise": run.noise},
        ),
        attachments={"consist.json": thing_to_bytes(run.train)},
        metadata={"seed": str(seed), "study": "Amirhosseini et al. (2024), section 5"},
    )


def name_of(run: Run) -> str:
    """Name of a run: its variant, whether its train has couplers, and whether speed is measured."""
    name = run.variant.name.replace(" ", "-")
    if run.train.couplers:
        alone = any(each.max_tractive_effort == 0.0 for each in run.train.vehicles)
        name += "-8-wagons-first-pulls" if alone else "-8-wagons"
        name += "-softening" if run.train.couplers[0].nonlinearity < 0.0 else ""
    return f"{name}-measured" if run.noise else name
