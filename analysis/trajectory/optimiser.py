"""A robust trajectory with its certificate, and energy against running time."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from analysis.trajectory.active_set import (
    Answer,
    NotFoundError,
    initial_guess,
    interpolated_guess,
    paced_grid,
    search,
    searched,
    split_where_slow,
)
from analysis.trajectory.audit import Audit
from analysis.trajectory.bound import (
    CLOSE,
    MULTIPLIERS,
    ContinuousBound,
    closest_bound,
    continuous_bound,
    costate_seconds,
)
from analysis.trajectory.convex import (
    Multipliers,
    NoSolutionError,
    OutOfTimeError,
    Relaxation,
    relaxation_seconds,
    time_left,
    time_limit,
    worked,
)
from analysis.trajectory.discretisation import (
    BRAKING_WEIGHT,
    REGAINING_WEIGHT,
    DiscreteProblem,
    Plan,
    discretise,
    graded_mesh,
    most_efforts,
    refined_mesh,
)
from analysis.trajectory.envelope import (
    Envelope,
    Floor,
    closer,
    fastest_run,
    floor_of,
    least_paced_time,
    paced_envelope,
)
from analysis.trajectory.feasibility import MOST_TIME, UnprovenError, check_time
from analysis.trajectory.instructions import agreement, phase_letters, phases_by_control
from analysis.trajectory.problem import (
    DEFAULT_OPTIONS,
    MOST_CELLS,
    OptimiserOptions,
    TrajectoryProblem,
)
from analysis.trajectory.rollout import LEAST_TIME_MARGIN, least_time_together
from analysis.trajectory.sqp import NEGLIGIBLE_ENERGY
from trainlog.arrays import FloatArray
from trainlog.display import at_most, counted
from trainlog.errors import InfeasibleError, InputError, TrainlogError
from trainlog.formats.declared import file_content
from trainlog.presentation import (
    DURATION,
    ENERGY,
    SECOND_WORTH,
    SHARE,
    Column,
    Presented,
    Said,
    WordTable,
    new_table,
)
from trainlog.progress import note, task, track
from trainlog.railway import Trajectory
from trainlog.units import JOULES_PER_KWH

if TYPE_CHECKING:
    from analysis.trajectory.journey import JourneyPlan

_HURRIED = 1.2
"""Times the least time up to which the cone relaxation bounds plans of several best."""

_CARRIED = 0.01
"""Part of what the efforts of all are worth from which a configuration matters to the bound."""

_BOUND_TIME = 2.0
"""Time that the best costates have at least [s], that an answer has its gap."""


def gap_of(energy: float, bound: float) -> float:
    """By how much an energy is above a lower bound at most, relative; both in J/kg."""
    # Down a hill next to no energy may be needed: a part of it would mean nothing.
    return (energy - bound) / max(abs(bound), NEGLIGIBLE_ENERGY)


def best_bound(
    answer: Answer,
    fastest: Envelope,
    running_time: float,
    seconds: float = np.inf,
    *,
    last: bool = False,
) -> ContinuousBound:
    """Lower bound of the energy of all trajectories.

    By the multipliers of the optimum for the configurations that are active. Where it does not come
    close, by two costates about the plan; of several near the least time, where the traction of one
    limits that of the others, by the multipliers of the cone relaxation.

    Parameters
    ----------
    answer : Answer
    fastest : Envelope
        Of all configurations.
    running_time : float [s]
    seconds : float
        Processor time that is left for closer bounds; one that is likely to take longer waits.
    last : bool
        Whether the cells stay as they are: then all that there is time for is tried.
    """
    problem, solution, rows = answer.problem, answer.solution, list(answer.active)
    of, plan, multipliers = problem.select(rows), solution.plan, solution.multipliers
    counted = problem.weights > 0.0
    counted[rows] = False
    stand_in = problem.run.objective == "expected" and bool(counted.any())
    if stand_in:
        of, plan, multipliers = problem, answer.plan, _of_all(problem, rows, multipliers)
        rows = list(range(problem.shape[0]))
    own, run = closer(problem.run, fastest, tuple(rows)), problem.run
    floor: Floor | None = None

    def bound(multipliers: Multipliers, plan: Plan, *, jointly: bool = True) -> ContinuousBound:
        given = of, plan, multipliers, own, running_time, run, floor
        return continuous_bound(*given, jointly=jointly)

    def of_costates(seconds: float) -> ContinuousBound | None:
        best: ContinuousBound | None = None
        ends, carried = worked() + seconds, np.abs(multipliers.pull).sum(axis=1)
        most = everyone = tuple(range(len(rows)))
        # The energy counts whichever of several takes the most: those that hardly matter can wait.
        if run.objective != "expected":
            most = tuple(np.flatnonzero(carried >= _CARRIED * carried.sum()).tolist())
        for few in dict.fromkeys((most, everyone)):
            part, left, limits = of.select(few), ends - worked(), (own, floor)
            if costate_seconds(part) > left:
                break
            if few != everyone:
                names = tuple(rows[each] for each in few)
                limits = closer(run, fastest, names), floor_of(run, fastest, names, running_time)
            given = part, plan.select(few), limits[0], running_time, run, limits[1]
            other = closest_bound(*given, enough=enough, seconds=left)
            if other is not None:
                best = other if best is None else max(best, other, key=lambda each: each.value)
            if best and solution.energy - best.value <= tolerated(best.value, fastest):
                break
        return best

    def of_relaxation(seconds: float) -> ContinuousBound | None:
        if stand_in or len(rows) == 1 or floor is None or relaxation_seconds(of) > seconds:
            return None
        speeds = fastest.at(of.positions)[rows]
        try:
            with time_limit(max(time_left(), _BOUND_TIME)):
                # The costate between the cells is that of a plan: this one, or the relaxed one.
                relaxed = Relaxation(of, speeds, floor.at(of.positions)).least_energy(running_time)
        except (NoSolutionError, OutOfTimeError):
            return None
        others = [bound(relaxed.multipliers, each) for each in (plan, relaxed.plan)]
        best = max(others, key=lambda each: each.value)
        return replace(best, excess=others[0].excess, source=f"cone relaxation: {relaxed.status}")

    found = bound(multipliers, plan, jointly=False)
    enough = CLOSE * max(abs(found.value), 0.1 * tolerated(found.value, fastest) / GAP_TOLERANCE)
    if solution.energy - found.value <= enough:
        return found
    if not stand_in:
        floor = floor_of(run, fastest, answer.active, running_time)
    found, begun = bound(multipliers, plan), worked()
    seconds = min(seconds, max(time_left(), _BOUND_TIME))
    sources = [of_costates, of_relaxation]
    if len(rows) > 1 and is_hurried(fastest, running_time):
        sources = [of_relaxation, of_costates][: 1 + last]
    for source in sources:
        missing = solution.energy - found.value
        if missing > tolerated(found.value, fastest) or (
            found.source == MULTIPLIERS and missing > enough
        ):
            other = source(seconds - (worked() - begun))
            found = max(found, other or found, key=lambda each: each.value)
    return found


def is_hurried(fastest: Envelope, running_time: float) -> bool:
    """Whether all speeds are nearly the fastest, and so between close chords in the relaxation."""
    return running_time < _HURRIED * float(fastest.times.max())


def _of_all(problem: DiscreteProblem, rows: list[int], multipliers: Multipliers) -> Multipliers:
    """Those of all configurations: each has its share of those of the one that stood for it."""
    at = problem.nearest(rows)
    share = problem.weights / np.maximum(np.bincount(at, problem.weights)[at], 1e-300)
    found = {
        name: values[at] * share.reshape(-1, *(1,) * (values.ndim - 1))
        for name, values in vars(multipliers).items()
    }
    return Multipliers(**found)


GAP_TOLERANCE = 2e-3
"""Largest gap between energy and lower bound that is called certified."""

_FLOOR = 5e-3
"""Part of the kinetic energy at top speed within which an energy is certified, however little it
is itself: nobody plans below a hundredth of a kWh."""


_INEXACT, _BROKEN = 1e-4, "no trajectories: this one takes less"
"""Part of the bound by which its quadrature may be above a plan, and the scope of one that is
farther above."""


def tolerated(bound: float, fastest: Envelope) -> float:
    """By how much an energy may exceed its lower bound and be called certified; all in J/kg."""
    return max(GAP_TOLERANCE * abs(bound), _FLOOR * 0.5 * float(fastest.speeds.max()) ** 2)


def energy_of_audit(answer: Answer, rollout: Audit) -> float:
    """What a run minimises, as its audit found it [J]."""
    run = answer.problem.run
    energies = rollout.line_energy if run.at_line else rollout.wheel_energy
    if run.objective == "expected":
        return float(answer.problem.weights @ energies)
    return float(energies.max())


WORST = ("shortfall", "end_speed", "overspeed", "power", "effort", "braking", "adhesion")
"""What the audit states of each configuration, and the certificate of the worst."""


def certificate_of(
    answer: Answer,
    bound: ContinuousBound,
    fastest: Envelope,
    rollout: Audit,
    running_time: float,
) -> dict[str, Any]:
    """What was found, how, and how good it is; plain numbers, energies in joules."""
    problem, run, solution = answer.problem, answer.problem.run, answer.solution
    energy = energy_of_audit(answer, rollout)
    gap = gap_of(energy / problem.reference, bound.value)
    names = [configuration.name for configuration in run.configurations]
    enough = tolerated(bound.value, fastest)
    missing = energy / problem.reference - bound.value
    broken = missing < -_INEXACT * abs(bound.value)
    return {
        "energy": energy,
        "lower_bound": bound.value * problem.reference,
        "gap": gap,
        "tolerance": enough * problem.reference,
        "certified": bool(missing <= enough and not broken),
        "bound_holds_for": _BROKEN if broken else "all trajectories" + _left_out(answer),
        "wheel_energy": rollout.wheel_energy.tolist(),
        "line_energy": rollout.line_energy.tolist(),
        "hardest": names[int(np.argmax(rollout.arrival))],
        "least_time": fastest.times.tolist(),
        "reserve": running_time / float(fastest.times.max()) - 1.0,
        "audit": {
            "passed": True,
            "substeps": rollout.substeps,
            "arrival": rollout.arrival.tolist(),
            "lateness": float(rollout.arrival.max()) - running_time,
            **{name: float(getattr(rollout, name).max()) for name in WORST},
            **_passings(run, rollout),
        },
        "solver": {
            "statuses": list(answer.statuses),
            "bound": bound.source,
            "iterations": len(answer.statuses),
            "turns": answer.turns,
        },
        "active": [names[row] for row in answer.active],
        "time_price": {
            names[row]: float(price) * problem.reference
            for row, price in zip(answer.active, solution.multipliers.time, strict=True)
        },
        "departure_price": float(solution.departure_price.sum()) * problem.reference,
        "grid": {
            "cells": problem.shape[1],
            "shortest": float(problem.step.min()),
            "longest": float(problem.step.max()),
        },
        "costates": {
            names[row]: costate.tolist()
            for row, costate in zip(
                answer.active, solution.multipliers.pull / problem.step, strict=True
            )
        },
        "switching": solution.switching.tolist(),
        "switching_levels": dict(zip(("traction", "braking"), run.effort_prices, strict=True)),
        "agreement": _agreement(problem, answer),
        "phases": _phases(problem, answer),
    }


def _left_out(answer: Answer) -> str:
    """What the bound cannot hold: time that the train has to lose, where a second costs nothing."""
    multipliers = answer.solution.multipliers
    left = multipliers.opening - multipliers.convex().opening
    if left.max(initial=0.0) <= 1e-3 * float(answer.solution.time_price.max()):
        return ""
    return ", early passing allowed where the train has to lose time"


def _agreement(problem: DiscreteProblem, answer: Answer) -> dict[str, float]:
    """Share of the cells in which the controls are those that the switching function asks for.

    The brake of each active configuration by its own part of the function; where the dynamic brake
    feeds back it pays at two levels, and is left out.
    """
    run, solution, part = problem.run, answer.solution, problem.select(answer.active)
    pull, brake = most_efforts(part, solution.plan)
    level, _ = run.effort_prices
    found = {"traction": agreement(solution.plan.traction, pull, solution.switching - level)}
    if not run.at_line:
        own = -solution.multipliers.pull / part.step
        braking = solution.plan.braking
        if problem.common:
            own, braking, brake = own.sum(axis=0), braking[0], brake[0]
        found["braking"] = agreement(braking, brake, own)
    return found


def _passings(run: TrajectoryProblem, rollout: Audit) -> dict[str, float]:
    """The worst that the audit found at the passing points, where there are any."""
    if not run.windows:
        return {}
    worst = {"early": rollout.early, "tardy": rollout.tardy, "slow": rollout.slow}
    return {name: float(values.max()) for name, values in worst.items() if values.max() > -np.inf}


def _phases(problem: DiscreteProblem, answer: Answer) -> list[str]:
    """The phase of each cell for each configuration, one letter a cell."""
    plan = answer.plan
    pull, brake = most_efforts(problem, plan)
    return [
        phase_letters(phases_by_control(plan.traction, plan.braking[row], pull, brake[row]))
        for row in range(problem.shape[0])
    ]


# -------------------------------------------------------------------------------------- the search

COARSE_CELLS = 120
"""Of the coarse grid on which the active configurations are found."""

_IN_HAND = 2e-3
"""Part of the running time that a run at a constant pace has in hand."""

_FAST = 1.05
"""Times the least at one pace that such a run takes at most: slow ones lead to poor plans."""

REFINEMENTS, _AS_LATE = 3, 0.9
"""How often a grid whose answer does not pass the audit is made twice as fine; and times the delay
on the grid before, beyond which finer ones do not bring a plan in time."""

RENEWALS, FINER_RENEWALS = 3, 2
"""How often cells are laid anew about the plan found; and how often more while the gap is too large
to certify. Every other time they are twice as many; and on while the energy falls."""

TOGETHER = 6_000
"""Cells of all configurations that count in the program of an expected energy, at first."""

_FINE = 4_000
"""Cells of all active configurations of several, up to which cells are laid anew."""

_CUT, _STALLED, _LOWER = 0.7, 0.95, 2e-4
"""Times what is missing before, up to which more is tried, and beyond which two times are the last;
and the part of the energy."""

_LONGER = 2.5
"""Times the time that twice as many cells take."""

EFFORT, _LITTLE_LEFT, _LONGEST = 17.0, 12.0, 19.0
"""Processor time of programs and bounds after which nothing is begun that improves a plan, or a
certified one; and no first bound [s]."""

_SHORT = 3.0
"""Time of a cone program that does not wait for further cells, though they take less [s]."""


def optimise(problem: TrajectoryProblem, options: OptimiserOptions = DEFAULT_OPTIONS) -> Trajectory:
    """Trajectory of least worst-case energy that every configuration can follow.

    Parameters
    ----------
    problem : TrajectoryProblem
        The run, its configurations, and what is minimised.
    options : OptimiserOptions

    Returns
    -------
    Trajectory
        With a certificate: the audit of every configuration, the lower bound and the gap.

    Raises
    ------
    InfeasibleError
        If no trajectory keeps the timetable or the speeds asked for; with the figures.
    InputError
        If so much time is given that the train would stand on the way.
    TrainlogError
        If the result does not pass its own audit.

    Notes
    -----
    Cunillera et al. (2022), eq. (1) to (10). The lower bound holds for the problem cut into these
    cells. With common braking, configurations that differ by a few per cent in resistance cannot
    all stop at one place; the error states the lowest end speed found. A refusal is a proof, unless
    it is an `analysis.trajectory.feasibility.UnprovenError`.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.railway import Configuration
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> loads = [Configuration.of(train, load, f"{load / 1e3:.0f} t") for load in (0.0, 12e3)]
    >>> problem = TrajectoryProblem(line, train, loads, end=9_613.0, running_time=370.0)
    >>> trajectory = optimise(problem, OptimiserOptions(cells=100))
    >>> trajectory.certificate["certified"]
    True
    >>> round(trajectory.certificate["energy"] / 3.6e6, 1)  # kWh
    32.6
    """
    count = counted(len(problem.configurations), "configuration")
    with (
        task(f"optimising for {count}", options.time_limit, "s"),
        time_limit(options.time_limit),
    ):
        return _optimised(problem, options)


def _optimised(asked: TrajectoryProblem, options: OptimiserOptions) -> Trajectory:
    problem, begun = asked, worked()
    if len(problem.configurations) == 1:
        # One brakes for all, and so for itself: then its brake may follow the speed it meets.
        problem = replace(problem, braking="recourse")
    fastest = fastest_run(problem)
    running_time = _running_time(problem, fastest, options.cells)
    try:
        check_time(problem, fastest, running_time)
        found = _audited(
            problem, fastest, running_time, _first_cells(problem, options.cells), begun
        )
        found, bound = _renewed(found, fastest, running_time, options, begun)
    except InfeasibleError as refusal:
        raise _with_time_to_allow(refusal, problem, fastest, running_time, options.cells) from None
    discrete, answer = found.problem, found.answer
    certificate = certificate_of(answer, bound, fastest, found.audit, running_time)
    speeds = found.audit.speeds
    if problem.final_speed == 0.0:
        speeds[:, -1] = 0.0  # the audit found them to stand there
    return Trajectory(
        line=problem.line.name,
        train=problem.train.name,
        positions=discrete.positions,
        configurations=tuple(problem.configurations),
        speeds=speeds,
        times=found.audit.times,
        tractive_effort=answer.plan.traction * discrete.reference,
        tractive_effort_fall=2.0 * discrete.taper.fall * discrete.reference,
        braking_effort=answer.plan.braking * discrete.reference,
        running_time=running_time,
        direction=problem.direction,
        certificate=certificate,
        provenance={
            "method": "cone relaxation and sequential quadratic programs, Cunillera et al. (2022)",
            "settings": _settings(asked, options),
            "line": file_content(problem.line),
        },
    )


def _first_cells(problem: TrajectoryProblem, cells: int) -> int:
    """Cells of the first grid: fewer where all of many configurations are in the program.

    Not where the line's own steps make most of the cells.
    """
    few = max(COARSE_CELLS, TOGETHER // len(problem.configurations))
    if problem.objective != "expected" or 2 * problem.breakpoints.size > few:
        return cells
    return min(cells, few)


def _running_time(problem: TrajectoryProblem, fastest: Envelope, cells: int) -> float:
    """The running time asked for [s]: as given, or the least time and the reserve."""
    if problem.running_time is not None:
        return problem.running_time
    least_time = float(fastest.times.max())
    if problem.reserve > 0.0:
        return (1.0 + problem.reserve) * least_time
    together = _time_together(problem, fastest, cells)
    # Under one braking effort for all there may be no such time; the search states why.
    return max(together if np.isfinite(together) else 0.0, least_time * (1.0 + LEAST_TIME_MARGIN))


def _time_together(problem: TrajectoryProblem, fastest: Envelope, cells: int) -> float:
    """Time in which all keep one common traction [s]; infinite if one would stand on the way."""
    discrete = discretise(problem, _mesh(problem, problem.breakpoints, fastest, cells))
    together = least_time_together(discrete, fastest.at(discrete.positions))
    return together if together <= MOST_TIME * float(fastest.times.max()) else np.inf


def _settings(problem: TrajectoryProblem, options: OptimiserOptions) -> dict[str, Any]:
    """What was asked for, for the provenance."""
    settings: dict[str, Any] = {
        name: getattr(problem, name)
        for name in ("start", "end", "initial_speed", "final_speed", "braking", "objective")
    }
    adhesion: dict[str, str | float] | None = None
    if problem.condition_map is not None:
        adhesion = {"layer": problem.layer}
        adhesion |= {"sigmas": problem.sigmas} if problem.risk is None else {"risk": problem.risk}
        if problem.time is not None:
            adhesion["time"] = problem.time.isoformat()
        if np.isfinite(problem.assumed_adhesion):
            adhesion["assumed"] = problem.assumed_adhesion
    return settings | {
        "planned_for": problem.planned_for,
        "curve_resistance": problem.line.curve_resistance,
        "mass_model": problem.train.mass_model,
        "acceleration_limits": problem.train.acceleration_limits,
        "weights": list(problem.weights),
        "adhesion": adhesion,
        "protected_length": problem.protected_length,
        "windows": [asdict(point) for point in problem.windows],
        "cells": options.cells,
    }


def _with_time_to_allow(
    refusal: InfeasibleError,
    run: TrajectoryProblem,
    fastest: Envelope,
    running_time: float,
    cells: int,
) -> InfeasibleError:
    """The refusal; where time is missing, with a time that all keep under one common traction."""
    if running_time > 1.01 * float(fastest.times.max()) or run.windows:
        return refusal
    together = _time_together(run, fastest, cells)
    if not running_time < together < np.inf:
        return refusal
    return type(refusal)(
        refusal.problem,
        file=refusal.file,
        place=refusal.place,
        remedy=f"allow at least {np.ceil(together):.0f} s",
    )


def _mesh(run: TrajectoryProblem, through: FloatArray, fastest: Envelope, cells: int) -> FloatArray:
    speeds = fastest.speeds[int(np.argmax(fastest.times))]
    weight = REGAINING_WEIGHT if run.at_line else BRAKING_WEIGHT
    graded = graded_mesh(through, fastest.positions, speeds, cells, weight)
    return fastest.split_on_climbs(graded)


@dataclass(frozen=True, eq=False)
class _Audited:
    """An answer that passed its audit.

    Attributes
    ----------
    answer : Answer
    audit : Audit
    later : float [s]
        By how much the audit arrives later than the programs do.
    """

    answer: Answer
    audit: Audit
    later: float

    @property
    def problem(self) -> DiscreteProblem:
        return self.answer.problem

    @property
    def energy(self) -> float:
        """What was minimised [J/kg]."""
        return energy_of_audit(self.answer, self.audit) / self.problem.reference


def _renewed(
    found: _Audited,
    fastest: Envelope,
    running_time: float,
    options: OptimiserOptions,
    begun: float,
) -> tuple[_Audited, ContinuousBound]:
    """The best plan, on cells laid anew where the bound of the last states that it loses most.

    As long as that takes away a third of what is missing, or lowers the energy, every other time on
    twice as many cells; where it does not, on twice as many, and on until it is certified. Nothing
    is tried that is likely to end later than `EFFORT` after `begun`.
    """
    cells = found.problem.shape[1]
    active = len(found.answer.active)
    finest = max(2 * cells, options.cells, _FINE // active) if active > 1 else MOST_CELLS

    def for_bound() -> float:
        return _LONGEST - (worked() - begun)

    # One large program begun at the optimum takes as long as one begun elsewhere.
    taken = (worked() - begun) / (1.0 + (len(found.answer.solution.statuses) > 1))
    # New cells lower the energy, too: a closer bound that takes longer waits for them. For a common
    # brake near the least time its multipliers have to show where cells are too long.
    hurried = found.problem.common and is_hurried(fastest, running_time)
    first = for_bound() if hurried else taken
    bound = best_bound(found.answer, fastest, running_time, first)
    last, excess = found, bound.excess
    lower, stalled = False, 0
    for number in itertools.count():
        missing = found.energy - bound.value
        enough = options.tolerance * max(abs(bound.value), NEGLIGIBLE_ENERGY)
        if lower:
            enough = min(enough, _LOWER * abs(bound.value))
        elif number >= RENEWALS + FINER_RENEWALS:
            break
        elif number >= RENEWALS:
            enough = max(enough, tolerated(bound.value, fastest))
        now = worked()
        certified = missing <= tolerated(bound.value, fastest)
        least = _LITTLE_LEFT if certified else EFFORT
        if missing <= enough or time_left() <= 0.0 or now - begun + taken > least:
            break
        note(f"the gap is {gap_of(found.energy, bound.value):.3%}; cells are laid anew")
        again = _searched_again(last, excess, cells, fastest, running_time)
        if again is None:
            # The same cells would end as badly again; others are tried whatever they may take.
            if 2 * cells > finest:
                break
            cells, taken = 2 * cells, 0.0
            continue
        lower = again.energy < (1.0 - _LOWER) * found.energy
        taken = worked() - now
        # While the energy falls the bound only guides the cells; closer ones can wait.
        left = 0.0 if lower else for_bound() if hurried else max(taken, _SHORT)
        other = best_bound(again.answer, fastest, running_time, left)
        last, excess = again, other.excess
        # On these cells what bounds best would take too long.
        given_up = not lower and other.source == MULTIPLIERS != bound.source
        bound = max(bound, other, key=lambda each: each.value)
        found = min(found, again, key=lambda each: each.energy)
        left_over = found.energy - bound.value
        stalled = stalled + 1 if not lower and left_over > _STALLED * missing else 0
        if lower or left_over <= _CUT * missing:
            if number % 2 == 1 and 2 * cells <= finest:
                cells, taken = 2 * cells, _LONGER * taken
            continue
        if given_up or stalled > 1:
            break
        if 2 * cells > finest:
            if left_over <= tolerated(bound.value, fastest):
                break
            continue
        cells, taken = 2 * cells, _LONGER * taken
    missing = found.energy - bound.value
    asked = hurried or bound.source != MULTIPLIERS
    waits = number == 0 and missing > enough and not asked
    waits |= missing > tolerated(bound.value, fastest)
    if waits and time_left() > 0.0:
        other = best_bound(found.answer, fastest, running_time, for_bound(), last=True)
        bound = max(bound, other, key=lambda each: each.value)
    return found, bound


def _searched_again(
    found: _Audited, excess: FloatArray, cells: int, fastest: Envelope, running_time: float
) -> _Audited | None:
    """The optimum on other cells, begun from the one found; None where it does not end well."""
    run = found.problem.run
    nodes, z = found.problem.positions, found.answer.plan.z
    positions = refined_mesh(run.breakpoints, nodes, excess, cells)
    planned = np.array([np.interp(positions, nodes, row) for row in z])
    problem = discretise(run, split_where_slow(positions, planned))
    guess = interpolated_guess(found.answer, nodes, problem)
    try:
        return _Audited(*searched(problem, guess, fastest, running_time, found.later))
    except TrainlogError:
        return None


def _audited(
    run: TrajectoryProblem, fastest: Envelope, running_time: float, cells: int, begun: float
) -> _Audited:
    """The optimum on a grid on which it passes its audit.

    A grid too coarse for the line shows in the audit, or in that a configuration by itself seems
    not to keep a time longer than its least. Where the search about the fastest run fails, one
    about a run at a constant pace follows, and then a finer grid.
    """
    # Hundreds of gradients would make as many cells; the coarse grid blurs them.
    many = run.breakpoints.size > COARSE_CELLS // 2
    through = run.hard_breakpoints if many else run.breakpoints
    coarse = _mesh(run, through, fastest, COARSE_CELLS)
    found: Answer | None = None
    failures, late = list[TrainlogError](), np.nan
    grids = (cells * 2**times for times in range(REFINEMENTS + 1))
    for count in [each for each in grids if each <= MOST_CELLS]:
        positions = _mesh(run, run.breakpoints, fastest, count)
        problem, speeds = discretise(run, positions), fastest.at(positions)
        if found is None and coarse.size < 0.6 * positions.size:
            found = _coarse_optimum(run, fastest, coarse, running_time)
        guess = initial_guess(problem, speeds, running_time)
        if found is not None:
            guess = interpolated_guess(found, coarse, problem)
        try:
            return _Audited(*searched(problem, guess, fastest, running_time))
        except TrainlogError as failure:
            failures.append(failure)
        safe = _paced(run, running_time, count)
        if safe is not None:
            return safe
        as_late = False
        if problem.common and isinstance(failures[-1], NotFoundError):
            as_late, late = failures[-1].late > _AS_LATE * late, failures[-1].late
            failures[-1] = failures[-1].why()
            if not isinstance(failures[-1], UnprovenError):
                raise failures[-1]
        ended = time_left() <= 0.0 and isinstance(failures[-1], (NotFoundError, UnprovenError))
        if as_late or ended or worked() - begun > EFFORT:
            break
    raise failures[0].why() if isinstance(failures[0], NotFoundError) else failures[0]


def _paced(run: TrajectoryProblem, running_time: float, cells: int) -> _Audited | None:
    """An answer on a grid about a run at a constant pace; None if there is none.

    Its grid costs a little of its time, so the pace has a little in hand.
    """
    time = min((1.0 - _IN_HAND) * running_time, _FAST * least_paced_time(run))
    paced = paced_envelope(run, time)
    if paced is None:
        return None
    problem = paced_grid(run, _mesh(run, run.breakpoints, paced, cells), paced, running_time)
    if problem is None:
        return None
    guess = initial_guess(problem, paced.at(problem.positions), running_time)
    try:
        return _Audited(*searched(problem, guess, paced, running_time))
    except TrainlogError:
        return None


def _coarse_optimum(
    run: TrajectoryProblem, fastest: Envelope, positions: FloatArray, running_time: float
) -> Answer | None:
    """The optimum on a coarse grid, and with it the configurations that decide.

    None if it has no optimum: that of the fine grid may have one, and else it explains itself.
    """
    problem, speeds = discretise(run, positions), fastest.at(positions)
    guess = initial_guess(problem, speeds, running_time)
    try:
        return search(problem, guess, speeds, running_time, coarse=True)
    except InfeasibleError:
        return None


RESERVES = (0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.13, 0.17, 0.22, 0.3)
"""Over the least time; closer where the front is steep."""


FRONT_COLUMNS = (
    Column("running time", DURATION, each=True, of=lambda point: point[0].running_time),
    Column("reserve", SHARE, each=True, of=lambda point: point[0].certificate["reserve"]),
    Column("energy", ENERGY, each=True, of=lambda point: point[0].certificate["energy"]),
    Column(
        "gap",
        replace(SHARE, digits=3),
        each=True,
        of=lambda point: Said(point[0].certificate["gap"], at_most(point[0].certificate["gap"])),
    ),
    Column(
        "a second more saves",
        SECOND_WORTH,
        each=True,
        key="saved_by_a_second",
        of=lambda point: float(point[1]),
    ),
)
"""Of a trajectory, and what each extra second saves [W]."""


@dataclass(frozen=True, eq=False, repr=False)
class Front(Presented):
    """Least energies for several running times.

    Printing it lists them.

    Attributes
    ----------
    runs : tuple of m Trajectory or JourneyPlan
        Each with its certificate, shortest running time first.
    least_time : float [s]
        Of the slowest configuration by itself, in motion.
    """

    charts_by: ClassVar[str] = "analysis.trajectory.plot:front_charts"

    runs: tuple[Trajectory | JourneyPlan, ...]
    least_time: float

    @property
    def title(self) -> str:
        """Train, line and energy."""
        first = self.runs[0]
        return f"Energy against time of {first.train} on {first.line}, {first.energy_label}"

    def tables(self) -> list[WordTable]:
        """Energy against running time, and what each extra second saves."""
        first = self.runs[0]
        title = f"Running time on {first.line}, {first.train}, against {first.energy_label}"
        points = zip(self.runs, self.prices, strict=True)
        return [new_table(title, *FRONT_COLUMNS, name="front").add_rows(points)]

    def summary(self) -> dict[str, str]:
        """Energies at some of the times."""
        rows = {"least time": f"{self.least_time:.1f} s"}
        shown = np.unique(np.linspace(0, self.times.size - 1, 8).astype(int)).tolist()
        for row in shown:
            rows[f"{self.times[row]:.1f} s"] = (
                f"{self.energies[row] / JOULES_PER_KWH:.2f} kWh,"
                f" {1e3 * self.prices[row] / JOULES_PER_KWH:.1f} Wh a second"
            )
        return rows

    @property
    def times(self) -> FloatArray:
        """Running times, (m,) [s]."""
        return np.array([each.running_time for each in self.runs])

    @property
    def energies(self) -> FloatArray:
        """Worst-case (or expected) energies, (m,) [J]."""
        return np.array([each.certificate["energy"] for each in self.runs])

    @property
    def prices(self) -> FloatArray:
        """What a second more saves, from the multipliers of the running time, (m,) [J/s]."""
        return np.array([sum(each.certificate["time_price"].values()) for each in self.runs])


def energy_against_time(
    problem: TrajectoryProblem,
    reserves: Sequence[float] = RESERVES,
    options: OptimiserOptions = DEFAULT_OPTIONS,
    *,
    solve: Callable[..., Trajectory | JourneyPlan] = optimise,
    known: Sequence[Trajectory | JourneyPlan] = (),
) -> Front:
    """Least energy for several reserves over the least time.

    Parameters
    ----------
    problem : TrajectoryProblem
        Its own running time and reserve do not count.
    reserves : sequence of float
        Parts of the least time. Those that cannot be kept together are left out.
    options : OptimiserOptions
    solve : callable
        Plans the run of a problem under ``options``: `optimise`, or `optimise_journey` with its
        journey.
    known : sequence of Trajectory or JourneyPlan
        Runs that are planned already.

    Raises
    ------
    InputError
        If there are no reserves.
    InfeasibleError
        If not one of them can be kept.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> from trainlog.railway import Configuration
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> problem = TrajectoryProblem(line, train, [Configuration.of(train)], end=9_613.0)
    >>> front = energy_against_time(problem, (0.05, 0.1), OptimiserOptions(cells=60))
    >>> bool(front.energies[0] > front.energies[1])
    True
    """
    if not len(reserves):
        raise InputError("front: no reserves are given", remedy="give parts of the least time")
    found: list[Trajectory | JourneyPlan] = []
    failure: InfeasibleError | None = None
    for reserve in track(sorted(set(reserves)), "optimising", "running time"):
        try:
            run = replace(problem, running_time=None, reserve=reserve)
            found.append(solve(run, options=options))
        except InfeasibleError as error:
            failure = error
    if not found:
        assert failure is not None
        raise failure
    runs = sorted([*known, *found], key=lambda each: each.running_time)
    return Front(tuple(runs), max(runs[0].certificate["least_time"]))
