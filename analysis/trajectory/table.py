"""Trajectories, journeys, fronts and driver advice as tables for people: km/h, km, kWh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd

from analysis.trajectory.advice import JourneyAdvice, driver_table, journey_advice
from analysis.trajectory.problem import adhesion_words
from trainlog.display import at_most, counted, few, lateness
from trainlog.formats.files import csv_bytes, write_bytes
from trainlog.presentation import (
    DURATION,
    ENERGY,
    MASS,
    POSITION,
    SECOND_WORTH,
    SHARE,
    SPEED,
    Column,
    Presented,
    Said,
    WordTable,
    facts_table,
    kwh,
    new_table,
    overspeed,
)
from trainlog.railway import Line, Trajectory
from trainlog.railway.line import in_km, station_at
from trainlog.units import JOULES_PER_KWH, KMH, clock

if TYPE_CHECKING:
    # They bring the solvers, which a table of a trajectory's file does without.
    from analysis.trajectory.journey import JourneyPlan
    from analysis.trajectory.problem import TrajectoryProblem

FROM_START = replace(POSITION, unit="")
"""A position under a heading that says km."""

LISTED = 8
"""Configurations of a trajectory that are listed one by one."""


MORE_CELLS = 1.5
"""More than so many times the cells asked for are stated."""


@dataclass(frozen=True, eq=False, repr=False)
class PlannedRun(Presented):
    """A planned run from stop to stop: certificates of its sections, and the driver's advice.

    Attributes
    ----------
    problem : TrajectoryProblem
    run : Trajectory or JourneyPlan
    """

    problem: TrajectoryProblem
    run: Trajectory | JourneyPlan

    @property
    def title(self) -> str:
        """Train and line."""
        return f"Plan for {self.run.train} on {self.run.line}"

    @property
    def sections(self) -> tuple[Trajectory, ...]:
        """The trajectories from stop to stop."""
        return (self.run,) if isinstance(self.run, Trajectory) else self.run.sections

    @cached_property
    def advice(self) -> JourneyAdvice:
        """What the driver is to do where."""
        return journey_advice(self.sections, self.problem.line)

    def summary(self) -> Mapping[str, str]:
        """The run in a few lines."""
        return self.run.summary()

    def facts(self) -> dict[str, Any]:
        """What the sections keep by their certificates, and the advice."""
        kept = [certified(each) for each in self.sections]
        return {"trajectories": kept, "advice": self.advice.facts()["advice"]}

    def tables(self) -> list[WordTable]:
        """Certificate and configurations of each section, the advice, the sections of a journey."""
        several = len(self.sections) > 1
        found = list[WordTable]()
        for each in self.sections:
            found += trajectory_table(each, section_name(each, self.problem.line) * several)
        found.append(driver_table(self.advice))
        if not isinstance(self.run, Trajectory):
            found.append(journey_table(self.run, self.problem.line))
        return found

    @property
    def notes(self) -> list[str]:
        """What adhesion each section counts on, and what of line and train is assumed."""
        found = [words for each in self.sections for words in adhesion_words(self.problem, each)]
        for what, names in (
            ("line", self.problem.line.assumed),
            ("train", self.problem.train.assumed),
        ):
            assumed = ", ".join(name.replace("_", " ") for name in names)
            found += [f"Assumed of the {what}: {assumed}."] if assumed else []
        ends = (each.positions[[0, -1]].tolist() for each in (self.sections[0], self.sections[-1]))
        (start, _), (_, end) = ends
        found += self.problem.train.unknown_tunnels(self.problem.line, start, end)
        if any(not each.protected_length for each in self.sections):
            length = self.problem.train.length
            state = "" if length else "state the length in the train file and "
            of = f" of {length:.0f} m" if length else ""
            found.append(
                f"Speed limits apply to the train's front; for its whole length{of},"
                f" {state}plan with --set protect=train."
            )
        permitted = float(self.problem.permitted_speed(np.array([self.problem.end]))[0])
        if self.problem.final_speed > permitted:
            found.append(
                f"The final speed of {KMH * self.problem.final_speed:.0f} km/h is above the"
                f" {KMH * permitted:.0f} km/h permitted at the end, which holds."
            )
        for each in self.sections:
            asked, cells = each.provenance["settings"]["cells"], each.positions.size - 1
            if cells > MORE_CELLS * asked:
                found.append(
                    f"The grid has {cells} cells, more than the {asked} asked for: at least one per"
                    " step of limits and gradients."
                )
        return list(dict.fromkeys(found))


def write_profile(found: JourneyAdvice, path: Path) -> None:
    """Write speed, efforts and energy over the kilometres as CSV, whole or not at all.

    Kilometres are the operator's; time and energy at the wheels count from the departure. Each row
    has the efforts behind its place, and the configuration that it is of: the one that arrives
    last in its section.
    """
    parts, used = [], 0.0
    for each, departs in zip(found.sections, found.departures.tolist(), strict=True):
        places, row = each.positions, each.latest
        energy = used + np.append(0.0, np.cumsum(each.tractive_effort * np.diff(places)))
        used = float(energy[-1])
        braking = each.braking_effort[row, each.cell_of(places)]
        columns = {
            "section": section_name(each, found.line),
            "km": in_km(found.line, places),
            "time [s]": (departs + each.times[row]).round(2),
            "speed [km/h]": (KMH * each.speeds[row]).round(2),
            "tractive effort [kN]": (each.tractive_effort_at(places) / 1e3).round(3),
            "braking effort [kN]": (braking / 1e3).round(3),
            "energy at the wheels [kWh]": (energy / JOULES_PER_KWH).round(4),
            "configuration": each.configurations[row].name,
        }
        parts.append(pd.DataFrame(columns))
    table = pd.concat(parts, ignore_index=True)
    steps = np.concatenate([np.abs(np.diff(part["km"])) for part in parts])
    digits = int(np.clip(np.ceil(-np.log10(max(steps.min(), 1e-6))), 3, 6))
    table["km"] = [f"{place:.{digits}f}" for place in table["km"]]
    if len(parts) == 1:
        del table["section"]
    write_bytes(path, csv_bytes(table))


def section_name(section: Trajectory, line: Line | None) -> str:
    """From where to where it runs: ``"Aach to Berg"``, by the kilometre where no station is."""
    ends = section.positions[[0, -1]]
    places = zip(ends.tolist(), in_km(line, ends).tolist(), strict=True)
    named = ((line and station_at(line, place)) or f"km {km:.3f}" for place, km in places)
    return " to ".join(named)


def trajectory_table(trajectory: Trajectory, section: str = "") -> list[WordTable]:
    """A trajectory and its certificate, headed by its section of a journey."""
    certificate = trajectory.certificate
    audit = certificate["audit"]
    least = max(certificate["least_time"])
    reserve = f"{certificate['reserve']:.1%} over {least:.1f} s ({clock(least)})"
    deciding = f"{len(trajectory.configurations)}, deciding: {few(certificate['active'], 4)}"
    bound = kwh(certificate["lower_bound"])
    agreed = certificate.get("agreement", {})
    shares = ", ".join(f"{name} {share:.2%}" for name, share in agreed.items())
    rows = {
        "timetable": (
            f"{trajectory.running_time:.1f} s ({clock(trajectory.running_time)}), {reserve}"
        ),
        "planned for": trajectory.planned_for or "not known",
        "forces": trajectory.model or "not known",
        "configurations": deciding,
        trajectory.energy_label: f"{kwh(certificate['energy'])}, at least {bound}",
        "optimality gap": _gap(trajectory),
        **_referee(trajectory),
        "latest arrival": lateness(audit["lateness"]),
        "speed over the limit": f"{overspeed(audit['overspeed'])}, {trajectory.limits_kept}",
        "power": f"{audit['power']:.1%} of the limit at most",
        "adhesion": _adhesion(trajectory),
        "optimality check (Pontryagin)": shares or "not known",
    }
    of = f" {section}" if section else ""
    facts = facts_table(f"Robust trajectory{of} on {trajectory.line}, {trajectory.train}", rows)
    every = trajectory.configurations
    wheel, drawn = (np.asarray(certificate[name]) for name in ("wheel_energy", "line_energy"))
    arrival = replace(DURATION, digits=2)
    table = new_table(
        f"Energy of each configuration{of and ','}{of}",
        Column("configuration", of=lambda row: every[row].name),
        Column("mass", MASS, each=True, of=lambda row: every[row].mass),
        Column("arrival", arrival, each=True, of=lambda row: trajectory.times[row, -1]),
        Column("top speed", SPEED, each=True, of=lambda row: trajectory.speeds[row].max()),
        Column("at the wheels", ENERGY, "wheel_energy", each=True, of=lambda row: wheel[row]),
        Column("from the line", ENERGY, "line_energy", each=True, of=lambda row: drawn[row]),
        name="configurations",
    )
    order = np.argsort(-(wheel if trajectory.objective == "wheel" else drawn), kind="stable")
    return [facts, table.add_rows(order.tolist(), LISTED)]


def certified(trajectory: Trajectory) -> dict[str, Any]:
    """What a trajectory keeps by its certificate, as data: SI units end the keys."""
    certificate = trajectory.certificate
    audit = certificate["audit"]
    return {
        "line": trajectory.line,
        "train": trajectory.train,
        "direction": trajectory.direction,
        "planned_for": trajectory.planned_for,
        "forces": trajectory.model,
        "running_time_s": trajectory.running_time,
        "least_time_s": max(certificate["least_time"]),
        "energy_J": certificate["energy"],
        "lower_bound_J": certificate["lower_bound"],
        "gap": certificate["gap"],
        "certified": certificate["certified"],
        "referee_energy_J": certificate.get("referee", {}).get("energy"),
        "lateness_s": audit["lateness"],
        "overspeed_m_s": audit["overspeed"],
        "protected_length_m": trajectory.protected_length,
        "share_of_power": audit["power"],
        "share_of_adhesion": audit["adhesion"],
        "deciding": list(certificate["active"]),
    }


def _gap(trajectory: Trajectory) -> str:
    """How far from the least energy a trajectory is at most."""
    certificate = trajectory.certificate
    cells = counted(certificate["grid"]["cells"], "cell")
    words = f"{at_most(certificate['gap'])} on {cells}"
    return words if certificate["certified"] else f"{words}; not certified"


def _referee(trajectory: Trajectory) -> dict[str, str]:
    """What IPOPT found on the same cells, where it was asked."""
    found = trajectory.certificate.get("referee")
    if found is None:
        return {}
    words = f"no optimum ({found['status']})"
    if found["solved"]:
        way = "more" if found["excess"] >= 0.0 else "less"
        words = f"{kwh(found['energy'])}; the plan takes {abs(100.0 * found['excess']):.4f} % {way}"
    return {"IPOPT on the same cells": words}


def journey_table(plan: JourneyPlan, line: Line | None = None) -> WordTable:
    """Sections of a journey: when, how much, and what a second is worth in each.

    With its line, as travelled, in the operator's kilometres.
    """
    certificate, first = plan.certificate, plan.sections[0]
    costliest, mixed = certificate["costliest"], bool(certificate["mixture"])
    title = (
        f"Journey {plan.journey.name} on {plan.journey.line}: {plan.energy_label}"
        f" {kwh(certificate['energy'])}, at least {kwh(certificate['lower_bound'])} at these"
        f" times; other times might save {certificate['other_times_might_save']:.2%}"
    )
    table = new_table(
        title,
        Column("from km", FROM_START, key="start"),
        Column("departs", DURATION, each=True),
        Column("to km", FROM_START, key="end"),
        Column("arrives", DURATION, each=True),
        Column("energy", ENERGY, each=True),
        Column("gap", replace(SHARE, digits=3), each=True),
        Column("saved per extra second", SECOND_WORTH, each=True, key="worth_of_a_second"),
        name="sections",
        caption=f"highest energy of a configuration: {kwh(certificate['costliest_energy'])},"
        f" {costliest}" + ("; the energies listed are its own" if mixed else ""),
    )
    row = first.index_of(costliest)
    for each, departs, arrives in zip(plan.sections, plan.departures, plan.arrivals, strict=True):
        found = each.certificate
        price = sum(found["time_price"].values())
        table.add_cells(
            _km(line, each.positions[0]),
            float(departs),
            _km(line, each.positions[-1]),
            float(arrives),
            float(found["line_energy"][row] if mixed else found["energy"]),
            Said(found["gap"], at_most(found["gap"])),
            float(price),
        )
    return table


def _km(line: Line | None, position: float) -> Said:
    """A position, shown by its kilometre."""
    return Said(float(position), FROM_START.words(1e3 * float(in_km(line, position)), unit=False))


def _adhesion(trajectory: Trajectory) -> str:
    """How much of the adhesion that was counted on a trajectory asks for."""
    share = trajectory.certificate["audit"]["adhesion"]
    if share:
        return f"{share:.1%} of the adhesion counted on at most"
    by_map = trajectory.provenance.get("settings", {}).get("adhesion")
    return "planned by a map that limits it nowhere" if by_map else "no limit, no map given"
