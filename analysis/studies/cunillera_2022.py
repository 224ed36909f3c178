"""Robust minimax trajectories over an observed set, as printed and with own brakes.

Cunillera et al. (2022), *Train trajectory optimization under parametric uncertainty and robust
maximum principle analysis*, state the problem and its control phases and publish no figures. The
instances here are this study's own: the level reference line and the VIRM6 of TTOBench v1.5, three
configurations, and a downhill for the phase that level track does not have.

The paper's train has unit mass. So do the arrays of `analysis.trajectory.discretisation`, where all
is divided by the inertia: efforts are accelerations, powers W/kg, energies J/kg.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import get_args

import numpy as np
from numba import njit

from analysis.studies.report import StudyReport
from analysis.trajectory.discretisation import DiscreteProblem, discretise
from analysis.trajectory.envelope import braking_curves
from analysis.trajectory.instructions import Phase, phases_of
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import Braking, OptimiserOptions, TrajectoryProblem
from trainlog.arrays import FloatArray, IntArray
from trainlog.formats.railway import write_trajectory
from trainlog.presentation import Columns, WordTable, new_table, word_table
from trainlog.railway import (
    Configuration,
    Line,
    RunningResistance,
    Station,
    StepProfile,
    Train,
    Trajectory,
)
from trainlog.units import KMH

NOMINAL = "nominal"
"""The configuration a robust trajectory is compared with."""

TRAIN = Train(
    name="NL_Intercity_VIRM6",
    mass=391_000.0,
    rotating_mass_factor=0.06,
    resistance=RunningResistance(5_854.0, 74.16, 12.96),
    max_tractive_effort=213_900.0,
    max_traction_power=2_157_000.0,
    max_dynamic_braking_effort=142_500.0,
    max_dynamic_braking_power=3_616_000.0,
    max_pneumatic_braking_effort=273_500.0,
    max_speed=140.0 / KMH,
    max_deceleration=0.66,
    source="TTOBench v1.5, NL_Intercity_VIRM6 (BSD-2-Clause)",
)

SPREAD = {
    "easy": ((0.97, 1.0, 0.985), 1.01),
    NOMINAL: ((1.0, 1.0, 1.0), 1.0),
    "hard": ((1.03, 1.0, 1.015), 0.98),
}
"""Factors on the coefficients and on p_max: alpha of the paper, chosen here."""

SUBSTEPS = 20
"""Runge-Kutta sub-steps a cell of `driven`."""

SHORTEST = 3.0
"""Phases that last no longer are the cell in which one phase gives way to the next [s]."""


@dataclass(frozen=True, eq=False)
class Instance:
    """One problem: where, in what time, from and to which speed.

    Attributes
    ----------
    name : str
    line : Line
    running_time : float [s]
    initial_speed, final_speed : float [m/s]
        v_o and v_e of eq. (8), both above 0.
    """

    name: str
    line: Line
    running_time: float
    initial_speed: float = 1.0
    final_speed: float = 10.0

    def run(self, configurations: Sequence[Configuration], braking: Braking) -> TrajectoryProblem:
        """What is asked of the optimiser for these configurations."""
        return TrajectoryProblem(
            self.line, TRAIN, configurations, running_time=self.running_time,
            initial_speed=self.initial_speed, final_speed=self.final_speed, braking=braking,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Driven:
    """Where given efforts take each configuration; (q,) arrays unless said otherwise.

    Attributes
    ----------
    speeds, times : (q, n + 1) array [m/s], [s]
        At the nodes; speed 0 where it did not get to.
    energy : [J/kg]
        Eq. (4).
    power : [W/kg]
        Largest ``u_f v``.
    stands : [m]
        Where it came to a stand, infinite if it did not.
    """

    speeds: FloatArray
    times: FloatArray
    energy: FloatArray
    power: FloatArray
    stands: FloatArray


def configurations(spread: Mapping[str, tuple[tuple[float, float, float], float]] = SPREAD) -> (
    tuple[Configuration, ...]
):  # fmt: skip
    """The train with other running resistance and power.

    Parameters
    ----------
    spread : mapping of str to ((float, float, float), float)
        By name: factors on the coefficients, and on the largest power.
    """
    own = TRAIN.resistance
    return tuple(
        Configuration(
            name, TRAIN.mass, TRAIN.rotating_mass,
            own.scaled(*factors),
            TRAIN.max_traction_power * power,
        )
        for name, (factors, power) in spread.items()
    )  # fmt: skip


def level() -> Instance:
    """The level reference: 48.531 km, 140 km/h, 1541 s, from 1 to 10 m/s."""
    line = Line(
        name="level reference",
        length=48_531.0,
        stations=(Station("A", 0.0), Station("B", 48_531.0)),
        speed_limits=StepProfile(np.array([0.0]), np.array([140.0 / KMH])),
        gradients=StepProfile(np.array([0.0]), np.array([0.0])),
        source="TTOBench v1.5, 00_reference (BSD-2-Clause)",
    )
    return Instance("level", line, 1_541.0)


def downhill() -> Instance:
    """20 km with 6 km of 12 per mille down under a limit of 100 km/h: made up for this study.

    Gravity there exceeds the running resistance at the limit, so that the limit is held by the
    brake: cruising by partial braking.
    """
    line = Line(
        name="downhill",
        length=20_000.0,
        stations=(Station("A", 0.0), Station("B", 20_000.0)),
        speed_limits=StepProfile(np.array([0.0]), np.array([100.0 / KMH])),
        gradients=StepProfile(np.array([0.0, 8_000.0, 14_000.0]), np.array([0.0, -0.012, 0.0])),
        source="made up for the study of Cunillera et al. (2022)",
    )
    return Instance("downhill", line, 800.0)


def solved(
    instance: Instance, chosen: Sequence[Configuration], braking: Braking, *, cells: int = 500
) -> Trajectory:
    """The trajectory of least worst-case energy at the wheel rims, eq. (9)."""
    return optimise(instance.run(chosen, braking), OptimiserOptions(cells))


def questions(
    first: Instance, second: Instance, chosen: Sequence[Configuration]
) -> dict[str, tuple[Instance, Sequence[Configuration], Braking]]:
    """What the study asks, by name: each configuration alone, and all, on either instance."""
    alone: dict[str, tuple[Instance, Sequence[Configuration], Braking]] = {
        f"{first.name}-{each.name}": (first, [each], "common") for each in chosen
    }
    return alone | {
        f"{instance.name}-{braking}": (instance, chosen, braking)
        for instance in (first, second)
        for braking in get_args(Braking)
    }


def driven(
    instance: Instance,
    trajectory: Trajectory,
    chosen: Sequence[Configuration],
    *,
    braking: Braking = "common",
) -> Driven:
    """Eqs. (2) to (4) as printed, for any configurations under a trajectory's efforts.

    Traction is that of the trajectory, and no more than the configuration's power allows.

    Parameters
    ----------
    instance : Instance
    trajectory : Trajectory
    chosen : sequence of Configuration
        Also such as it was not made for.
    braking : str
        ``"common"``: the brake as planned. ``"recourse"``: each brakes as late as it may.
    """
    problem = discretise(instance.run(chosen, braking), trajectory.positions)
    curves = np.full((len(chosen), trajectory.positions.size), np.inf)
    brake = trajectory.braking_effort[0] / problem.reference
    if braking == "recourse":
        curves, brake = braking_curves(problem), np.zeros(brake.size)
    return Driven(
        *_driven(
            instance.initial_speed, trajectory.positions, problem.step,
            trajectory.tractive_effort / problem.reference,
            trajectory.tractive_effort_fall / problem.reference, brake, problem.mean_drag0,
            problem.drag1, problem.drag2, problem.power, curves,
        )
    )  # fmt: skip


@njit(cache=True)  # type: ignore[untyped-decorator]
def _driven(
    initial_speed: float, positions: FloatArray, step: FloatArray, traction: FloatArray,
    fall: FloatArray, braking: FloatArray, drag0: FloatArray, drag1: FloatArray, drag2: FloatArray,
    power: FloatArray, curves: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Runge-Kutta of order four on ``dv/ds = (u_f - u_b - r(v)) / v`` and ``dt/ds = 1 / v``."""
    q, n = drag0.shape
    speeds, times = np.zeros((q, n + 1)), np.full((q, n + 1), np.inf)
    energy, most, stands = np.zeros(q), np.zeros(q), np.full(q, np.inf)
    slopes, shares = np.zeros(4), np.array([0.0, 0.5, 0.5, 1.0])
    for a in range(q):
        v, t = initial_speed, 0.0
        speeds[a, 0], times[a, 0] = v, t
        for k in range(n):
            h = step[k] / SUBSTEPS
            for j in range(SUBSTEPS):
                wanted = traction[k] + fall[k] * (0.5 - (j + 0.5) / SUBSTEPS)
                pull = min(wanted, power[a] / v)
                pace = 0.0
                for stage in range(4):
                    at = v if stage == 0 else v + shares[stage] * h * slopes[stage - 1]
                    at = max(at, 1e-3)
                    net = pull - braking[k] - drag0[a, k] - (drag1[a] + drag2[a, k] * at) * at
                    slopes[stage] = net / at
                    pace += (1.0 if stage in (0, 3) else 2.0) / at
                v += h / 6.0 * (slopes[0] + 2.0 * slopes[1] + 2.0 * slopes[2] + slopes[3])
                if v <= 0.02:
                    stands[a] = positions[k] + j * h
                    break
                t += h / 6.0 * pace
                share = (j + 1.0) / SUBSTEPS
                curve = curves[a, k] + share * (curves[a, k + 1] - curves[a, k])
                v = min(v, np.sqrt(2.0 * curve))
                energy[a] += h * pull
                wanted = traction[k] + fall[k] * (0.5 - share)
                most[a] = max(most[a], min(wanted, pull) * v)
            if stands[a] < np.inf:
                break
            speeds[a, k + 1], times[a, k + 1] = v, t
    return speeds, times, energy, most, stands


def phase_durations(trajectory: Trajectory, row: int = 0) -> dict[Phase, float]:
    """Seconds that a configuration spends in each phase that lasts, in their order."""
    phases, times = phases_of(trajectory, row), trajectory.times[row]
    starts = np.flatnonzero(np.diff(phases, prepend=-1))
    spent: dict[Phase, float] = {}
    for first, last in zip(starts, [*starts[1:], phases.size], strict=True):
        seconds = float(times[last] - times[first])
        if seconds > SHORTEST:
            phase = Phase(phases[first])
            spent[phase] = spent.get(phase, 0.0) + seconds
    return spent


def phases_by_switching(switching: FloatArray, band: float = 1e-3) -> IntArray:
    """Phase of each cell from the switching function ``sum of lambda_v / v``.

    Within `band` of 1 or of 0 the control is singular: cruising by partial traction or braking.
    """
    phase = np.full(switching.shape, int(Phase.COASTING))
    phase[switching > 1.0 - band] = Phase.CRUISING
    phase[switching > 1.0 + band] = Phase.MAXIMUM_TRACTION
    phase[switching < band] = Phase.PARTIAL_BRAKING
    phase[switching < -band] = Phase.MAXIMUM_BRAKING
    return phase


def phases_agree(trajectory: Trajectory, band: float = 1e-3) -> float:
    """Share of the cells whose phase by the switching function is that of the controls."""
    by_switching = phases_by_switching(np.asarray(trajectory.certificate["switching"]), band)
    return float(np.mean(by_switching == phases_of(trajectory, 0)))


@dataclass(frozen=True)
class Cruise:
    """Cruising by partial traction: the sum of all ``lambda_v / v`` stays 1.

    On level track ``d(lambda_v / v)/ds = (lambda_v / v) r'(v) / v - lambda_t / v³``. Where the sum
    over the configurations does not change, that gives one ``lambda_t`` from the others; of a
    configuration alone it is ``V² r'(V)``.

    Attributes
    ----------
    speed : float [m/s]
        Of the configuration that decides.
    price : float [J/(kg s)]
        Its ``lambda_t``: the multiplier of the running time.
    analytic : float [J/(kg s)]
    """

    speed: float
    price: float
    analytic: float


def cruise(trajectory: Trajectory) -> Cruise:
    """The multiplier of the time of the configuration that decides, while all cruise."""
    certificate = trajectory.certificate
    prices, costates = certificate["time_price"], certificate["costates"]
    decides = max(prices, key=prices.get)
    row = trajectory.index_of(decides)
    cells = np.flatnonzero(phases_of(trajectory, row) == Phase.CRUISING)[3:-3]
    lengths = np.diff(trajectory.positions)[cells]
    changes = np.zeros(cells.size)
    for name, costate in costates.items():
        other = trajectory.index_of(name)
        v = 0.5 * (trajectory.speeds[other, cells] + trajectory.speeds[other, cells + 1])
        configuration = trajectory.configurations[other]
        resistance, inertia = configuration.resistance, configuration.inertia
        _, linear, quadratic = resistance.parabola
        slope = (linear + 2.0 * quadratic * v) / inertia
        changes += np.asarray(costate)[cells] * slope / v
        if name != decides:
            changes -= prices[name] / inertia / v**3
    v = 0.5 * (trajectory.speeds[row, cells] + trajectory.speeds[row, cells + 1])
    return Cruise(
        speed=float(v @ lengths / lengths.sum()),
        price=prices[decides] / trajectory.configurations[row].inertia,
        analytic=float(np.median(changes * v**3)),
    )


def as_printed(problem: DiscreteProblem, trajectory: Trajectory, found: Driven) -> dict[str, float]:
    """Largest excess over each constraint of the paper, eqs. (5) to (8); not positive if kept.

    Parameters
    ----------
    problem : DiscreteProblem
        Of the configurations that were driven.
    trajectory : Trajectory
    found : Driven
        Under its efforts as planned.
    """
    traction = trajectory.tractive_effort + 0.5 * np.abs(trajectory.tractive_effort_fall)
    traction /= problem.reference
    braking = trajectory.braking_effort[0] / problem.reference
    return {
        "(5) power [W/kg]": float((found.power - problem.power).max()),
        "(6) traction [m/s²]": float((traction - problem.traction).max()),
        "(7) braking [m/s²]": float((braking - problem.braking.min(axis=0)).max()),
        "(8) v(s_e) [m/s]": float(found.speeds[:, -1].max()) - problem.run.final_speed,
        "(8) t(s_e) [s]": float(found.times[:, -1].max()) - trajectory.running_time,
    }


# ------------------------------------------------ its answers as trajectories, pictures and tables


def price_table(
    alone: Mapping[str, Trajectory], common: Trajectory, recourse: Trajectory
) -> WordTable:
    """What each configuration needs by itself, and what all together cost.

    Parameters
    ----------
    alone : mapping of str to Trajectory
        Of each configuration by itself.
    common, recourse : Trajectory
        Of all, with one braking effort and with a brake each.
    """
    rows = {
        **{f"{name} alone": each for name, each in alone.items()},
        "robust, common braking (the paper)": common,
        "robust, recourse": recourse,
    }

    def over(own: Trajectory) -> Callable[[tuple[str, Trajectory]], str]:
        return lambda row: f"{_per_mass(row[1]) / _per_mass(own) - 1.0:+.2%}"

    of: Columns[tuple[str, Trajectory]] = {
        "": lambda row: row[0],
        "J/kg": lambda row: f"{_per_mass(row[1]):.2f}",
        "at least": lambda row: f"{_per_mass(row[1], 'lower_bound'):.2f}",
        "gap": lambda row: f"{row[1].certificate['gap']:.4%}",
        **{f"over {name} alone": over(each) for name, each in alone.items()},
        "arrivals [s]": lambda row: " / ".join(f"{time:.1f}" for time in row[1].times[:, -1]),
        "end speeds [km/h]": lambda row: " / ".join(
            f"{KMH * speed:.1f}" for speed in row[1].speeds[:, -1]
        ),
    }
    title = f"Price of robustness: energy at the wheel rims in {common.running_time:.0f} s"
    return word_table(title, rows.items(), of)


def printed_table(instance: Instance, common: Trajectory) -> WordTable:
    """Eqs. (2) to (8) as printed, integrated for every configuration under the common efforts.

    Parameters
    ----------
    instance : Instance
    common : Trajectory
        With common braking.
    """
    chosen = common.configurations
    found = driven(instance, common, chosen)
    problem = discretise(instance.run(chosen, "common"), common.positions)
    table = new_table("Eqs. (2)-(8) integrated as printed under u_f and u_b", "", "")
    energies = ", ".join(f"{energy:.6f}" for energy in found.energy)
    table.add_row("E(s_e), eq. (4): the same for all [J/kg]", energies)
    for name, excess in as_printed(problem, common, found).items():
        table.add_row(f"most over {name}", f"{excess:.1e}")
    return table


def phases_table(answers: Sequence[tuple[str, Trajectory]]) -> WordTable:
    """The phases of section 3, and how far they are those of the switching function.

    Parameters
    ----------
    answers : sequence of (str, Trajectory)
        Under their names.
    """

    def spent(phase: Phase) -> Callable[[tuple[str, Trajectory]], str]:
        def cell(row: tuple[str, Trajectory]) -> str:
            found = phase_durations(row[1])
            return f"{found[phase]:.0f}" if phase in found else "–"

        return cell

    of: Columns[tuple[str, Trajectory]] = {
        "": lambda row: row[0],
        **{phase.label: spent(phase) for phase in Phase},
        "controls as the sum asks": lambda row: (
            f"{min(row[1].certificate['agreement'].values()):.1%}"
        ),
        "phase by both the same": lambda row: f"{phases_agree(row[1]):.1%}",
    }
    title = "Section 3: phases by control, in seconds, and by the sum of lambda_v / v"
    return word_table(title, answers, of)


def cruise_table(answers: Sequence[tuple[str, Trajectory]]) -> WordTable:
    """The multiplier of the time against its analytic value.

    Parameters
    ----------
    answers : sequence of (str, Trajectory)
        On level track, under their names.
    """
    of: Columns[tuple[str, Cruise]] = {
        "": lambda row: row[0],
        "cruising speed [km/h]": lambda row: f"{KMH * row[1].speed:.2f}",
        "multiplier": lambda row: f"{row[1].price:.6f}",
        "analytic": lambda row: f"{row[1].analytic:.6f}",
        "apart": lambda row: f"{abs(row[1].price / row[1].analytic - 1.0):.1e}",
    }
    title = "Cruising on level track: lambda_t of the configuration that decides [J/(kg s)]"
    return word_table(title, ((name, cruise(found)) for name, found in answers), of)


def others_table(
    instance: Instance,
    nominal: Trajectory,
    common: Trajectory,
    chosen: Sequence[Configuration],
) -> WordTable:
    """The optimum for the nominal configuration, driven by the others; beside it the robust one.

    Parameters
    ----------
    instance : Instance
    nominal, common : Trajectory
        For the nominal configuration alone, and for all.
    chosen : sequence of Configuration
        That drive.
    """
    own, braked, robust = (
        driven(instance, nominal, chosen),
        driven(instance, nominal, chosen, braking="recourse"),
        driven(instance, common, chosen),
    )
    late = instance.running_time
    of: Columns[int] = {
        "driven by": lambda row: chosen[row].name,
        "nominal: late [s]": lambda row: _late(own, row, late),
        f"end speed, asked {KMH * instance.final_speed:.0f} [km/h]": lambda row: _end(own, row),
        "nominal, brake its own: late [s]": lambda row: _late(braked, row, late),
        "robust: late [s]": lambda row: _late(robust, row, late),
        "end speed [km/h]": lambda row: _end(robust, row),
    }
    title = "Efforts that were optimal for the nominal configuration, and the robust ones"
    return word_table(title, range(len(chosen)), of)


def _per_mass(found: Trajectory, key: str = "energy") -> float:
    """J/kg, the paper's unit mass; these configurations have one inertia."""
    return float(found.certificate[key]) / found.configurations[0].inertia


def _late(found: Driven, row: int, running_time: float) -> str:
    if found.stands[row] < float("inf"):
        return f"stands at km {found.stands[row] / 1e3:.3f}"
    return f"{found.times[row, -1] - running_time:+.1f}"


def _end(found: Driven, row: int) -> str:
    return f"{KMH * found.speeds[row, -1]:.1f}"


def main(report: StudyReport, cells: int) -> None:
    """Optimise for each configuration alone and for all, and judge every answer.

    Parameters
    ----------
    report : StudyReport
    cells : int
        Of the grid.
    """
    flat, slope, chosen = level(), downhill(), configurations()
    asked = questions(flat, slope, chosen)
    answers: dict[str, Trajectory] = {}
    for name, (instance, some, braking) in report.track(asked.items(), "optimising"):
        answers[name] = found = solved(instance, some, braking, cells=cells)
        path = report.folder / f"{name}.json"
        write_trajectory(found, path)
        report.keep(path)
        report.draw({f"{name}.png": found.charts(line=instance.line)})
    alone = {each.name: answers[f"level-{each.name}"] for each in chosen}
    common, recourse = answers["level-common"], answers["level-recourse"]
    nominal = alone[NOMINAL]
    on_level = [pair for pair in answers.items() if pair[1].line == flat.line.name]
    report.show(
        price_table(alone, common, recourse),
        printed_table(flat, common),
        phases_table(list(answers.items())),
        cruise_table(on_level),
        others_table(flat, nominal, common, chosen),
    )
