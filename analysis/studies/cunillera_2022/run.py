"""The study of Cunillera et al. (2022): its answers as trajectories, pictures and tables."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from analysis.studies.cunillera_2022 import model as study
from analysis.studies.report import StudyReport
from analysis.trajectory.discretisation import discretise
from analysis.trajectory.instructions import Phase
from trainlog.formats.railway import write_trajectory
from trainlog.presentation import Columns, WordTable, new_table, word_table
from trainlog.railway import Configuration, Trajectory
from trainlog.units import KMH


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


def printed_table(instance: study.Instance, common: Trajectory) -> WordTable:
    """Eqs. (2) to (8) as printed, integrated for every configuration under the common efforts.

    Parameters
    ----------
    instance : Instance
    common : Trajectory
        With common braking.
    """
    chosen = common.configurations
    found = study.driven(instance, common, chosen)
    problem = discretise(instance.run(chosen, "common"), common.positions)
    table = new_table("Eqs. (2)-(8) integrated as printed under u_f and u_b", "", "")
    energies = ", ".join(f"{energy:.6f}" for energy in found.energy)
    table.add_row("E(s_e), eq. (4): the same for all [J/kg]", energies)
    for name, excess in study.as_printed(problem, common, found).items():
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
            found = study.phase_durations(row[1])
            return f"{found[phase]:.0f}" if phase in found else "–"

        return cell

    of: Columns[tuple[str, Trajectory]] = {
        "": lambda row: row[0],
        **{phase.label: spent(phase) for phase in Phase},
        "controls as the sum asks": lambda row: (
            f"{min(row[1].certificate['agreement'].values()):.1%}"
        ),
        "phase by both the same": lambda row: f"{study.phases_agree(row[1]):.1%}",
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
    of: Columns[tuple[str, study.Cruise]] = {
        "": lambda row: row[0],
        "cruising speed [km/h]": lambda row: f"{KMH * row[1].speed:.2f}",
        "multiplier": lambda row: f"{row[1].price:.6f}",
        "analytic": lambda row: f"{row[1].analytic:.6f}",
        "apart": lambda row: f"{abs(row[1].price / row[1].analytic - 1.0):.1e}",
    }
    title = "Cruising on level track: lambda_t of the configuration that decides [J/(kg s)]"
    return word_table(title, ((name, study.cruise(found)) for name, found in answers), of)


def others_table(
    instance: study.Instance,
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
        study.driven(instance, nominal, chosen),
        study.driven(instance, nominal, chosen, braking="recourse"),
        study.driven(instance, common, chosen),
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


def _late(found: study.Driven, row: int, running_time: float) -> str:
    if found.stands[row] < float("inf"):
        return f"stands at km {found.stands[row] / 1e3:.3f}"
    return f"{found.times[row, -1] - running_time:+.1f}"


def _end(found: study.Driven, row: int) -> str:
    return f"{KMH * found.speeds[row, -1]:.1f}"


def main(report: StudyReport, cells: int) -> None:
    """Optimise for each configuration alone and for all, and judge every answer.

    Parameters
    ----------
    report : StudyReport
    cells : int
        Of the grid.
    """
    level, slope, chosen = study.level(), study.downhill(), study.configurations()
    asked = study.questions(level, slope, chosen)
    answers: dict[str, Trajectory] = {}
    for name, (instance, some, braking) in report.track(asked.items(), "optimising"):
        answers[name] = found = study.solved(instance, some, braking, cells=cells)
        path = report.folder / f"{name}.json"
        write_trajectory(found, path)
        report.keep(path)
        report.draw({f"{name}.png": found.charts(line=instance.line)})
    alone = {each.name: answers[f"level-{each.name}"] for each in chosen}
    common, recourse = answers["level-common"], answers["level-recourse"]
    nominal = alone[study.NOMINAL]
    on_level = [pair for pair in answers.items() if pair[1].line == level.line.name]
    report.show(
        price_table(alone, common, recourse),
        printed_table(level, common),
        phases_table(list(answers.items())),
        cruise_table(on_level),
        others_table(level, nominal, common, chosen),
    )
