"""Results as tables for people: km/h, km, kN, kWh, per mille."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from rich.box import SIMPLE_HEAD
from rich.console import Group
from rich.table import Table

from analysis.adhesion.condition_map import summary
from analysis.comparison.cost import JOULES_PER_KWH, Saving, punctuality, savings
from analysis.resistance import Fits
from analysis.resistance.diagnostics import diagnosed
from analysis.tables import WordTable
from analysis.truth import Truth, curve_error, map_error, truth_of
from trainlog.errors import InputError
from trainlog.formats.condition import read_map
from trainlog.formats.parameters import read_parameters
from trainlog.formats.trajectory import read_trajectory
from trainlog.mcap import read_log
from trainlog.mcap.convert import span_of
from trainlog.railway import TrackConditionMap, Trajectory
from trainlog.units import KMH, clock

if TYPE_CHECKING:
    # They bring the solvers, which most commands that print a table do without.
    from analysis.trajectory.journey import JourneyPlan
    from analysis.trajectory.optimiser import Front
    from analysis.trajectory.phases import AdvicePoint


def new_table(title: str, *columns: str, **options: Any) -> Table:
    """An empty table in the house's form."""
    table = WordTable(
        title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, **options
    )
    for column in columns:
        table.add_column(column, overflow="fold")
    return table


LISTED = 8
"""Configurations of a trajectory that are listed one by one."""

VOUCHED = ("Solve_Succeeded", "Solved_To_Acceptable_Level")
"""Words of IPOPT by which it vouches for what it found."""


def savings_table(pairs: Sequence[Saving]) -> Group:
    """What following the trajectory saved, pair by pair and together."""
    title = "Tractive energy at the wheel rims, running time, how often slip protection acted"
    table = new_table(
        title, "trip", "driver", "trajectory", "saved", "from the line", "behind it", "slips"
    )
    for pair in pairs:
        driver, own = pair.driver, pair.trajectory
        table.add_row(
            driver.name,
            f"{_kwh(driver.traction)}, {driver.running_time:.0f} s",
            f"{_kwh(own.traction)}, {own.running_time:.0f} s",
            f"{_kwh(pair.traction)}, {pair.traction / driver.traction:.1%}",
            _kwh(pair.line),
            "-" if own.late is None else f"{own.late:+.1f} s",
            " / ".join("-" if each.slips is None else f"{each.slips}" for each in (driver, own)),
        )
    spent, saved = total_saved(pairs)
    trips = "1 trip" if len(pairs) == 1 else f"{len(pairs)} trips"
    words = f"Saved on {trips}: {_kwh(saved)} of {_kwh(spent)}, {saved / spent:.1%};"
    words += f" {_kwh(sum(pair.line for pair in pairs))} from the line; {_times(pairs)}."
    return Group(table, words)


def total_saved(pairs: Sequence[Saving]) -> tuple[float, float]:
    """Tractive work of the drivers, and what the trajectory saved of it [J]."""
    return sum(pair.driver.traction for pair in pairs), sum(pair.traction for pair in pairs)


def fit_table(fits: Fits) -> Group:
    """Running resistance of each trip and of all together, with what it rests on."""
    title = f"Running resistance of {fits.common.train}: N, N/(m/s), N/(m/s)²"
    table = new_table(
        title, "trip", "r0", "r1", "r2", "mass", "power, kW", "kN at 80 km/h", "windows"
    )
    at = 80.0 / KMH
    for fit in fits.trips:
        table.add_row(
            fit.trip,
            *(_pm(b, s) for b, s in zip(fit.beta, np.sqrt(np.diag(fit.covariance)), strict=False)),
            f"{fit.mass / 1e3:.1f} ± {1.96 * fit.mass_std / 1e3:.1f} t",
            "-"
            if fit.max_power is None or fit.max_power_std is None
            else _pm(fit.max_power / 1e3, fit.max_power_std / 1e3),
            _pm(float(fit.resistance(at)) / 1e3, float(fit.std(at)) / 1e3),
            f"{fit.windows['used']}",
        )
    common = fits.common
    beta = (common.resistance.r0, common.resistance.r1, common.resistance.r2)
    table.add_section()
    table.add_row(
        "together",
        *(_pm(b, s) for b, s in zip(beta, np.sqrt(np.diag(common.covariance)), strict=True)),
        "",
        "",
        _pm(float(common.resistance(at)) / 1e3, float(common.std(at)) / 1e3),
        f"{sum(fit.windows['used'] for fit in fits.trips)}",
    )
    low, high = common.speed_range
    words = [
        "± is the 95 % band; a power is told where a trip reached it. Supported from"
        f" {low * KMH:.0f} to {high * KMH:.0f} km/h. The single coefficients are strongly"
        " correlated: trust the curve.",
    ]
    for fit in fits.trips:
        words += [f"{fit.trip}: {doubt}" for doubt in diagnosed(fit.residuals).doubts]
    words += [f"refused, {error.reason}: {error}" for error in fits.refused.values()]
    words += _set_told(fits)
    return Group(table, *words)


def _set_told(fits: Fits) -> list[str]:
    """What the observed set stands for."""
    found = fits.parameters
    words = (
        f"{len(found.configurations)} configurations stand for {found.cover['trips']} trips: their"
        f" worst case bounds {found.cover['level']:.1%} of trips like these"
    )
    if found.cover["level"] < found.cover["asked"]:
        words += f", fewer than the {found.cover['asked']:.1%} asked for"
    known = f"{fits.known} logs were not read: their summaries are known." if fits.known else ""
    return [f"{words}.", *([known] if known else [])]


def map_table(track: TrackConditionMap) -> Group:
    """What a track-condition map knows, layer by layer, with its lowest spots."""
    title = f"Track condition of {track.line}, {track.bin_length:.0f} m bins"
    lowest = "lowest maximum adhesion (95 % band)"
    table = new_table(title, "rail", "trips", "slip events", "observed", lowest)
    for layer in summary(track):
        spots = [
            f"km {spot.position / 1e3:.3f}: {spot.adhesion:.3f} ({spot.low:.3f} to {spot.high:.3f})"
            for spot in layer.lowest
        ]
        share = layer.observed_bins / layer.bins
        table.add_row(
            layer.layer,
            str(layer.trips),
            str(layer.events),
            f"{layer.observed_length / 1e3:.1f} km, {share:.0%}",
            "\n".join(spots) or "nothing observed",
        )
    return Group(table, "Elsewhere demand never met the limit: there the map says nothing.")


def trajectory_table(trajectory: Trajectory) -> Group:
    """A trajectory and its certificate."""
    certificate = trajectory.certificate
    audit = certificate["audit"]
    title = f"Robust trajectory on {trajectory.line}, {trajectory.train}"
    facts = new_table(title, "", "", show_header=False)
    least = max(certificate["least_time"])
    reserve = f"{certificate['reserve']:.1%} over {least:.1f} s ({clock(least)})"
    deciding = f"{len(trajectory.configurations)}, deciding: {_some(certificate['active'])}"
    bound = f"at least {_kwh(certificate['lower_bound'])}"
    cells = f"{certificate['grid']['cells']} cells"
    agreed = certificate.get("agreement", {})
    shares = ", ".join(f"{name} {share:.2%}" for name, share in agreed.items())
    rows = (
        (
            "timetable",
            f"{trajectory.running_time:.1f} s ({clock(trajectory.running_time)}), {reserve}",
        ),
        ("configurations", deciding),
        (trajectory.energy_told, f"{_kwh(certificate['energy'])}, {bound}"),
        ("optimality gap", f"{certificate['gap']:.3%} of the problem on {cells}"),
        ("latest arrival", f"{_never(audit['lateness']):.4f} s after the timetable"),
        ("speed over the limit", f"{_never(audit['overspeed']) * KMH:.5f} km/h"),
        ("power", f"{audit['power']:.6f} of the limit at most"),
        ("adhesion", _share(audit["adhesion"])),
        ("controls as the maximum principle asks", shares or "not told"),
    )
    for row in rows:
        facts.add_row(*row)
    if "referee" in certificate:
        judge = certificate["referee"]
        words = f"{_kwh(judge['energy'])}, ours {judge['difference']:+.4%}"
        if judge["status"] not in VOUCHED:
            words += f"; {judge['name']} stopped before it was sure: its last point, no proof"
        facts.add_row(f"second opinion by {judge['name']}", words)
    table = new_table(
        "Energy of each configuration",
        *("configuration", "mass", "arrival", "top speed", "at the wheels", "from the line"),
    )
    energies = certificate["wheel_energy"], certificate["line_energy"]
    order = np.argsort(-np.asarray(energies[trajectory.objective != "wheel"]), kind="stable")
    for row in order[:LISTED]:
        configuration = trajectory.configurations[row]
        table.add_row(
            configuration.name,
            f"{configuration.mass / 1e3:.1f} t",
            f"{trajectory.times[row, -1]:.2f} s",
            f"{trajectory.speeds[row].max() * KMH:.1f} km/h",
            *(_kwh(each[row]) for each in energies),
        )
    rest = len(order) - LISTED
    return Group(facts, table, *([f"and {rest} more"] if rest > 0 else []))


def front_table(front: Front) -> Table:
    """Energy against running time, and what a second more saves."""
    first = front.trajectories[0]
    table = new_table(
        f"Running time on {first.line}, {first.train}, against {first.energy_told}",
        *("running time", "reserve", "energy", "gap", "a second more saves"),
    )
    for each, price in zip(front.trajectories, front.prices, strict=True):
        certificate = each.certificate
        table.add_row(
            f"{each.running_time:.1f} s",
            f"{certificate['reserve']:.1%}",
            _kwh(certificate["energy"]),
            f"{certificate['gap']:.3%}",
            f"{price / 3.6e3:.1f} Wh",
        )
    return table


def journey_table(plan: JourneyPlan) -> Table:
    """Sections of a journey: when, how much, and what a second is worth in each."""
    certificate, first = plan.certificate, plan.sections[0]
    dearest, mixed = certificate["dearest"], bool(certificate["mixture"])
    title = (
        f"Journey {plan.journey.name} on {plan.journey.line}:"
        f" {'worst-case energy from the line' if mixed else first.energy_told}"
        f" {_kwh(certificate['energy'])}, at least {_kwh(certificate['lower_bound'])} at these"
        f" times; other times might save {certificate['other_times_might_save']:.2%}"
    )
    table = new_table(
        title,
        *("from km", "departs", "to km", "arrives", "energy", "gap", "a second is worth"),
        caption=f"{dearest} takes most in all, {_kwh(certificate['dearest_energy'])}"
        + ("; energies are its own" if mixed else ""),
        caption_justify="left",
    )
    row = first.index_of(dearest)
    for each, departs, arrives in zip(plan.sections, plan.departures, plan.arrivals, strict=True):
        found = each.certificate
        price = sum(found["time_price"].values())
        table.add_row(
            f"{each.positions[0] / 1e3:.3f}",
            f"{departs:.1f} s",
            f"{each.positions[-1] / 1e3:.3f}",
            f"{arrives:.1f} s",
            _kwh(found["line_energy"][row] if mixed else found["energy"]),
            f"{found['gap']:.3%}",
            f"{price / 3.6e3:.1f} Wh",
        )
    return table


def advice_table(points: Sequence[AdvicePoint]) -> Table:
    """Driver advice: where to do what."""
    table = new_table("Driver advice", "km", "time", "speed", "advice", "until")
    for point in points:
        table.add_row(
            f"{point.position / 1e3:.3f}",
            clock(point.time),
            f"{KMH * point.speed:.0f} km/h",
            point.words,
            f"{KMH * point.until:.0f} km/h",
        )
    return table


def results_table(folder: Path) -> Group:
    """What a folder of results says: the fit, the map, the trajectory, the energy saved.

    Simulated trips are judged against their truth.

    Raises
    ------
    InputError
        If the folder holds no results.
    """
    if not folder.is_dir():
        raise InputError(
            "is a file" if folder.exists() else "does not exist",
            file=folder,
            remedy="name the folder that holds the results",
        )
    logs = sorted((folder / "trips").glob("*.mcap"))
    # What a simulation knows is attached: no topic has to be read for it.
    found_truths = (truth_of(read_log(log, topics=[])) for log in logs)
    truths = [truth for truth in found_truths if truth is not None]
    table = new_table(f"Results in {folder}", "", "result", "in")
    rows = [
        _recorded(folder, logs),
        _fitted(folder / "parameters.json", truths),
        _mapped(folder / "map.json", truths),
        *_planned(folder / "trajectory.json"),
        _saved(folder / "driven", logs),
        _followed(folder),
    ]
    found = [row for row in rows if row is not None]
    if not found:
        raise InputError(
            "holds no results",
            file=folder,
            remedy="they are looked for as 'trainlog demo' leaves them: logs in trips/ and driven/,"
            " parameters.json, map.json, trajectory.json",
        )
    for row in found:
        table.add_row(*row)
    return Group(table)


def _recorded(folder: Path, logs: Sequence[Path]) -> tuple[str, str, str] | None:
    if not logs:
        return None
    spans = [span for span in map(span_of, logs) if span is not None]
    hours = sum((end - start).total_seconds() for start, end in spans) / 3600.0
    return "recorded", f"{len(logs)} trips, {hours:.1f} h", str(folder / "trips")


def _fitted(path: Path, truths: Sequence[Truth]) -> tuple[str, str, str] | None:
    if not path.exists():
        return None
    found = read_parameters(path)
    words = f"{len(found.configurations)} configurations"
    if truths and found.common is not None:
        by_name = {truth.trip: truth for truth in truths}
        pairs = [(c, by_name[c.name]) for c in found.configurations if c.name in by_name]
        single = np.median([curve_error(c.resistance, [truth]) for c, truth in pairs])
        together = curve_error(found.common, [truth for _, truth in pairs])
        words += (
            f"; drag curve off by {single:.1%} for one trip (median),"
            f" {together:.1%} for all together"
        )
    return "running resistance", words, str(path)


def _mapped(path: Path, truths: Sequence[Truth]) -> tuple[str, str, str] | None:
    if not path.exists():
        return None
    track = read_map(path)
    layers = summary(track)
    events = sum(layer.events for layer in layers)
    words = f"{events} slip events, " + ", ".join(
        f"{layer.observed_length / 1e3:.1f} km {layer.layer}" for layer in layers
    )
    if truths and events:
        error, bins = map_error(track, truths)
        words += f" observed; maximum adhesion off by {error:.3f} RMS in {bins} bins with events"
    return "track condition", words, str(path)


def _planned(path: Path) -> tuple[tuple[str, str, str], ...]:
    if not path.exists():
        return ()
    trajectory = read_trajectory(path)
    certificate = trajectory.certificate
    audit = certificate["audit"]
    energy = (
        f"{trajectory.energy_told} {_kwh(certificate['energy'])} over"
        f" {len(trajectory.configurations)} configurations in {trajectory.running_time:.0f} s"
    )
    proof = (
        f"gap {certificate['gap']:.3%}, latest arrival {_never(audit['lateness']):.4f} s after"
        f" the timetable, speed {_never(audit['overspeed']) * KMH:.5f} km/h over the limit"
    )
    return ("trajectory", energy, str(path)), ("certificate", proof, "")


def _saved(folder: Path, logs: Sequence[Path]) -> tuple[str, str, str] | None:
    followed = sorted(folder.glob("*.mcap"))
    if not (followed and logs):
        return None
    pairs = savings(logs, followed)
    driver, saved = total_saved(pairs)
    words = (
        f"{_kwh(saved / len(pairs))} a trip, {saved / driver:.1%} of the drivers' tractive energy"
        f" ({len(pairs)} trips, {_times(pairs)})"
    )
    return "energy saved", words, str(folder)


def _followed(folder: Path) -> tuple[str, str, str] | None:
    """How punctual the trips on the trajectory were, with the map and without."""
    told = []
    for name, how in (("driven", "with the map"), ("driven-blind", "without")):
        logs = sorted((folder / name).glob("*.mcap"))
        if logs:
            found = punctuality(logs)
            told.append(
                f"{how} at most {abs(found.late):.1f} s from the trajectory on arrival, slip"
                f" protection acts {found.slips} times on {found.trips} trips"
            )
    return ("following", "; ".join(told), str(folder / "driven")) if told else None


def _pm(value: float, std: float, unit: str = "") -> str:
    """A value with its 95 % band, to the digits that the band leaves meaningful."""
    reach = 1.96 * std
    digits = max(0, 1 - math.floor(math.log10(reach))) if reach > 0.0 else 1
    return f"{value:.{digits}f} ± {reach:.{digits}f}{unit}"


def _times(pairs: Sequence[Saving]) -> str:
    """Mean running times of both, in words."""
    driver = np.mean([pair.driver.running_time for pair in pairs])
    trajectory = np.mean([pair.trajectory.running_time for pair in pairs])
    return f"{trajectory:.0f} s on the trajectory against {driver:.0f} s on average"


def _never(excess: float) -> float:
    """An excess as people read it: nothing rather than a negative or a minus zero."""
    return excess if excess > 0.0 else 0.0


def _share(adhesion: float) -> str:
    return f"{adhesion:.6f} of what the map promises at most" if adhesion else "no map was used"


def _kwh(energy: float) -> str:
    return f"{energy / JOULES_PER_KWH:.2f} kWh"


def _some(names: Sequence[str]) -> str:
    return ", ".join(names[:4]) + (f" and {len(names) - 4} more" if len(names) > 4 else "")
