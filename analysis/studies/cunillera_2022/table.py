"""Tables: what robust trajectories cost, and what they are good for."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from analysis.studies.cunillera_2022 import model as study
from analysis.trajectory.discretisation import discretise
from analysis.trajectory.phases import Phase
from trainlog.presentation import WordTable, new_table
from trainlog.railway import Configuration, Trajectory
from trainlog.units import KMH


def configurations_table(instance: study.Instance) -> WordTable:
    """The observed set, per unit mass as the paper has it.

    Parameters
    ----------
    instance : Instance
    """
    table = new_table(
        f"Configurations, unit mass ({instance.line.source}; spread chosen here)",
        "alpha",
        "r0 [mm/s²]",
        "r1 [1e-4/s]",
        "r2 [1e-5/m]",
        "p_max [W/kg]",
    )
    for each in study.configurations():
        resistance, inertia = each.resistance, each.inertia
        table.add_row(
            each.name,
            f"{1e3 * resistance.r0 / inertia:.3f}",
            f"{1e4 * resistance.r1 / inertia:.3f}",
            f"{1e5 * resistance.r2 / inertia:.3f}",
            f"{each.max_power / inertia:.3f}",
        )
    return table


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
    table = new_table(
        f"Price of robustness: energy at the wheel rims in {common.running_time:.0f} s",
        "",
        "J/kg",
        "at least",
        "gap",
        *(f"over {name} alone" for name in alone),
        "arrivals [s]",
        "end speeds [km/h]",
    )
    rows = {
        **{f"{name} alone": each for name, each in alone.items()},
        "robust, common braking (the paper)": common,
        "robust, recourse": recourse,
    }
    for name, found in rows.items():
        mine = _per_mass(found)
        table.add_row(
            name,
            f"{mine:.2f}",
            f"{_per_mass(found, 'lower_bound'):.2f}",
            f"{found.certificate['gap']:.4%}",
            *(f"{mine / _per_mass(each) - 1.0:+.2%}" for each in alone.values()),
            " / ".join(f"{time:.1f}" for time in found.times[:, -1]),
            " / ".join(f"{KMH * speed:.1f}" for speed in found.speeds[:, -1]),
        )
    return table


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
    table = new_table(
        "Section 3: phases by control, in seconds, and by the sum of lambda_v / v",
        "",
        *(phase.label for phase in Phase),
        "controls as the sum asks",
        "phase by both the same",
    )
    for name, found in answers:
        spent = study.phase_durations(found)
        agreed = found.certificate["agreement"]
        table.add_row(
            name,
            *(f"{spent[phase]:.0f}" if phase in spent else "–" for phase in Phase),
            f"{min(agreed.values()):.1%}",
            f"{study.phases_agree(found):.1%}",
        )
    return table


def cruise_table(answers: Sequence[tuple[str, Trajectory]]) -> WordTable:
    """The multiplier of the time against its analytic value.

    Parameters
    ----------
    answers : sequence of (str, Trajectory)
        On level track, under their names.
    """
    table = new_table(
        "Cruising on level track: lambda_t of the configuration that decides [J/(kg s)]",
        "",
        "cruising speed [km/h]",
        "multiplier",
        "analytic",
        "apart",
    )
    for name, found in answers:
        cruise = study.cruise(found)
        table.add_row(
            name,
            f"{KMH * cruise.speed:.2f}",
            f"{cruise.price:.6f}",
            f"{cruise.analytic:.6f}",
            f"{abs(cruise.price / cruise.analytic - 1.0):.1e}",
        )
    return table


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
    table = new_table(
        "Efforts that were optimal for the nominal configuration, and the robust ones",
        "driven by",
        "nominal: late [s]",
        f"end speed, asked {KMH * instance.final_speed:.0f} [km/h]",
        "nominal, brake its own: late [s]",
        "robust: late [s]",
        "end speed [km/h]",
    )
    ways = (
        study.driven(instance, nominal, chosen),
        study.driven(instance, nominal, chosen, braking="recourse"),
        study.driven(instance, common, chosen),
    )
    for row, each in enumerate(chosen):
        planned, own, robust = (
            (_late(way, row, instance.running_time), _end(way, row)) for way in ways
        )
        table.add_row(each.name, *planned, own[0], *robust)
    return table


def ends_table(ends: Sequence[tuple[float, float | None, Trajectory]]) -> WordTable:
    """What a wider observed set costs, and how slow one brake for all can make it.

    Parameters
    ----------
    ends : sequence of (float, float or None, Trajectory)
        Spread of the running resistance, lowest common end speed [m/s], and the trajectory with
        a brake each.
    """
    table = new_table(
        "Sets whose running resistance differs evenly",
        "spread",
        "lowest end speed, common braking",
        "robust, recourse [J/kg]",
    )
    for share, speed, found in ends:
        reached = "none in this time" if speed is None else f"{KMH * speed:.1f} km/h"
        table.add_row(f"±{share:.0%}", reached, f"{_per_mass(found):.2f}")
    return table


def _per_mass(found: Trajectory, key: str = "energy") -> float:
    """J/kg, the paper's unit mass; these configurations have one inertia."""
    return float(found.certificate[key]) / found.configurations[0].inertia


def _late(found: study.Driven, row: int, running_time: float) -> str:
    if found.stands[row] < float("inf"):
        return f"stands at km {found.stands[row] / 1e3:.3f}"
    return f"{found.times[row, -1] - running_time:+.1f}"


def _end(found: study.Driven, row: int) -> str:
    return f"{KMH * found.speeds[row, -1]:.1f}"
