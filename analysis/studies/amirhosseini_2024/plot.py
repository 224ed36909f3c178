"""The figures of Amirhosseini et al. (2024), as charts of runs of `simulation`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from analysis.charts import BLUE, GREEN, GREY, ORANGE, PURPLE, RED, Chart, Curve, Panel
from analysis.studies.amirhosseini_2024.simulation import VARIANTS, Run
from trainlog.arrays import FloatArray
from trainlog.units import KMH

COLOURS = dict(zip((v.name for v in VARIANTS), (GREEN, BLUE, RED, ORANGE), strict=True))
"""Of the variants."""

SECONDS = "time [s]"


def study_charts(
    runs: Mapping[str, Run], measured: Mapping[str, Run], coupled: Sequence[Run]
) -> dict[str, list[Chart]]:
    """The paper's figures, and comparisons that it has not, by the names of the files.

    Parameters
    ----------
    runs : mapping of str to Run
        With exact speed, by name of the variant.
    measured : mapping of str to Run
        The same with measured speed.
    coupled : sequence of Run
        With eight wagons.
    """
    timed, spatial = runs["time reset"], runs["spatial reset"]
    return {
        "figures-01-03-profile.png": _profile(spatial),
        "figures-04-05-time-reset.png": _learning(timed, "Figs. 4 and 5"),
        "figures-06-09-spatial-reset.png": _learning(spatial, "Figs. 6 to 9"),
        "figures-10-14-scalar.png": _scalar(runs["scalar"]),
        "measured-speed.png": _measured(runs, measured),
        "eight-wagons.png": _wagons(runs, coupled),
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


def _measured(runs: Mapping[str, Run], measured: Mapping[str, Run]) -> list[Chart]:
    """Position error with exact and with measured speed, of every variant."""
    noise = next(iter(measured.values())).noise
    panels = [
        Panel(
            "position error [m]",
            [
                Curve(f"{name}: {run.figures[0]:.2f} m", run.time, run.position_error,
                      COLOURS[name], width=1.0)
                for name, run in group.items()
            ],
            title=title,
        )
        for group, title in (
            (runs, "Exact speed"), (measured, f"Measured speed, σ = {noise:g} m/s"),
        )
    ]  # fmt: skip
    return [Chart(SECONDS, panels)]


def _wagons(runs: Mapping[str, Run], coupled: Sequence[Run]) -> list[Chart]:
    """Position error beside that of the single particle, and the range of the couplers' forces."""
    panels = list[Panel]()
    for run in coupled:
        name = run.variant.name
        alone = any(vehicle.max_tractive_effort == 0.0 for vehicle in run.train.vehicles)
        what = f"{name}, {'the first wagon pulls' if alone else 'every wagon pulls'}"
        errors = [
            Curve("one particle", runs[name].time, runs[name].position_error, GREY),
            Curve("eight wagons", run.time, run.position_error, COLOURS[name]),
        ]
        low, high = (end(run.coupler_forces / 1e3, axis=1) for end in (np.min, np.max))
        forces = Curve("", run.time, high, COLOURS[name], "area", low)
        panels += [
            Panel("m", errors, title=f"Position error: {what}"),
            Panel("kN", [forces], title="From the least to the largest of the couplers' forces"),
        ]
    return [Chart(SECONDS, panels)]
