"""A robust trajectory with its certificate, and energy against running time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.active_set import (
    Answer,
    finer_guess,
    first_guess,
    outstanding,
    search,
)
from analysis.trajectory.audit import Audit, audit
from analysis.trajectory.certificate import best_bound, certificate_of, refereed
from analysis.trajectory.discretisation import (
    BRAKING_WEIGHT,
    REGAINING_WEIGHT,
    DiscreteProblem,
    discretise,
    graded_mesh,
)
from analysis.trajectory.envelope import Envelope, fastest_run
from analysis.trajectory.feasibility import check_time
from analysis.trajectory.problem import Braking, Direction, Objective, TrajectoryProblem
from analysis.trajectory.rollout import BESIDE_LEAST, least_time_together
from trainlog.errors import InfeasibleError, InputError, TrainlogError
from trainlog.railway import Configuration, Line, TimingPoint, TrackConditionMap, Train, Trajectory

FloatArray = NDArray[np.float64]

FEWEST_CELLS, MOST_CELLS = 20, 20_000
"""Of the grid; far more than a line has metres to tell apart costs hours and gains nothing."""

SCOUTING_CELLS = 120
"""Of the coarse grid on which the active configurations are found."""

REFINEMENTS = 3
"""How often a grid whose answer does not pass the audit is made twice as fine."""


def optimise(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    *,
    running_time: float | None = None,
    reserve: float = 0.07,
    start: float = 0.0,
    end: float | None = None,
    initial_speed: float = 0.0,
    final_speed: float = 0.0,
    braking: Braking = "recourse",
    objective: Objective = "wheel",
    condition_map: TrackConditionMap | None = None,
    layer: str = "wet",
    sigmas: float = 2.0,
    assumed_adhesion: float = np.inf,
    protected_length: float = 0.0,
    weights: Sequence[float] = (),
    windows: Sequence[TimingPoint] = (),
    direction: Direction = "forward",
    cells: int = 500,
    referee: bool = False,
) -> Trajectory:
    """Trajectory of least worst-case energy that every configuration can follow; paper 002.

    Parameters
    ----------
    line : Line
        In the direction of travel.
    train : Train
    configurations : sequence of Configuration
        The observed set.
    running_time : float, optional [s]
        What the timetable allows. Without it, the least time of the slowest configuration and
        `reserve` on top.
    reserve : float
        Part of the least time. With 0 the run takes the least time in which all arrive together
        under one common traction: some 1e-6 of it more than the slowest by itself, or more.
    start, end : float, optional [m]
        Section of the line; without them the whole line.
    initial_speed, final_speed : float [m/s]
    braking : {"recourse", "common"}
        Each configuration brakes for itself, or all brake alike as the paper has it.
    objective : {"wheel", "line", "expected"}
        Energy at the wheel rims without regeneration, as the paper has it; or energy from the
        line with the train's efficiencies and its dynamic brake, of the worst configuration or as
        expected with `weights`; of more than twelve few then stand for the others.
    weights : sequence of float
        Of the configurations, for the expected energy; equal without them.
    condition_map : TrackConditionMap, optional
        Limits efforts to the adhesion that the map cautiously promises where it was observed.
    layer : str
        Rail condition to read from the map.
    sigmas : float
        Standard deviations taken off the map's estimate.
    assumed_adhesion : float
        What is counted on where the map tells nothing, unless more was borne there without slip;
        infinite for no limit.
    protected_length : float [m]
        Length of train that a speed limit protects: 0 for its front, ``train.length`` for all.
    windows : sequence of TimingPoint
        When and how fast it may pass points on the way; times count from the start of the run.
    direction : {"forward", "reverse"}
        Of travel against the chainage of the line's file. `line` is given in the direction of
        travel all the same (`Line.reversed`), and so is every position here.
    cells : int
        Cells of the grid, about; a line with many breakpoints gets more.
    referee : bool
        Have IPOPT solve the same problem too, and put what it found into the certificate.

    Returns
    -------
    Trajectory
        With a certificate: the audit of every configuration, the lower bound and the gap.

    Raises
    ------
    InfeasibleError
        If no trajectory keeps the timetable or the speeds asked for; with the figures.
    InputError
        If an argument makes no sense.
    TrainlogError
        If the result does not pass its own audit.

    Notes
    -----
    The lower bound holds for the problem cut into these cells. With common braking,
    configurations that differ by a few per cent in resistance cannot all stop at one place; the
    error tells the lowest end speed they can all reach.
    """
    _check_arguments(running_time, reserve, cells)
    run = TrajectoryProblem(
        line, train, tuple(configurations), start, line.length if end is None else end,
        initial_speed, final_speed, braking, objective,
        condition_map, layer, sigmas, protected_length, tuple(windows),
        tuple(weights), direction, assumed_adhesion,
    )  # fmt: skip
    fastest = fastest_run(run)
    slowest = int(np.argmax(fastest.times))
    least_time = float(fastest.times[slowest])
    if running_time is None:
        running_time = (1.0 + reserve) * least_time
        if reserve == 0.0:
            together = least_time_together(
                discretise(run, _mesh(run, run.breakpoints, fastest, cells))
            )
            running_time = least_time * (1.0 + BESIDE_LEAST)
            # Under one braking effort for all there may be no such time; the search tells why.
            if np.isfinite(together):
                running_time = max(together, running_time)
    try:
        check_time(run, fastest, running_time)
        problem, answer, rollout, coarser = _audited(run, fastest, running_time, cells)
    except InfeasibleError as refusal:
        raise _with_time_to_allow(refusal, run, fastest, running_time, cells) from None
    bound = best_bound(problem, answer, fastest.at(problem.positions), running_time)
    traction = answer.plan.traction * problem.reference
    brakes = answer.plan.braking * problem.reference
    certificate = certificate_of(problem, answer, bound, fastest, rollout, running_time, coarser)
    if referee:
        certificate["referee"] = refereed(problem, answer, running_time)
    speeds = rollout.speeds
    if final_speed == 0.0:
        speeds[:, -1] = 0.0  # the audit found them to stand there
    return Trajectory(
        line=line.name,
        train=train.name,
        positions=problem.positions,
        configurations=run.configurations,
        speeds=speeds,
        times=rollout.times,
        tractive_effort=traction,
        tractive_effort_fall=2.0 * problem.taper.fall * problem.reference,
        braking_effort=brakes,
        running_time=running_time,
        direction=direction,
        certificate=certificate,
        provenance={
            "method": "cone relaxation and sequential quadratic programs, paper 002",
            "settings": {
                "start": run.start,
                "end": run.end,
                "initial_speed": initial_speed,
                "final_speed": final_speed,
                "braking": braking,
                "objective": objective,
                "weights": list(run.weights),
                "adhesion": None if condition_map is None else _reading(run),
                "protected_length": protected_length,
                "windows": [asdict(point) for point in run.windows],
                "cells": cells,
            },
        },
    )


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
    together = least_time_together(discretise(run, _mesh(run, run.breakpoints, fastest, cells)))
    if not running_time < together < np.inf:
        return refusal
    return InfeasibleError(
        refusal.problem,
        file=refusal.file,
        place=refusal.place,
        remedy=f"allow at least {np.ceil(together):.0f} s",
    )


def _mesh(run: TrajectoryProblem, through: FloatArray, fastest: Envelope, cells: int) -> FloatArray:
    speeds = fastest.speeds[int(np.argmax(fastest.times))]
    weight = REGAINING_WEIGHT if run.at_line else BRAKING_WEIGHT
    return graded_mesh(through, fastest.positions, speeds, cells, weight)


def _audited(
    run: TrajectoryProblem, fastest: Envelope, running_time: float, cells: int
) -> tuple[DiscreteProblem, Answer, Audit, tuple[int, float] | None]:
    """The problem on its grid, its answer, the audit that the answer passed, and a coarser grid's.

    A grid too coarse for the line shows in the audit; then it is made finer. It is made finer once
    where a configuration by itself seems not to keep a time longer than its least. Of the coarser
    grid told are the number of its cells and the energy [J/kg], where there was one.
    """
    # Hundreds of gradients would make as many cells; a sketch blurs them.
    many = run.breakpoints.size > SCOUTING_CELLS // 2
    through = run.hard_breakpoints if many else run.breakpoints
    sketch = _mesh(run, through, fastest, SCOUTING_CELLS)
    found, words = None, ""
    finer = [cells * 2**times for times in range(REFINEMENTS + 1)]
    for count in [each for each in finer if each <= MOST_CELLS]:
        positions = _mesh(run, run.breakpoints, fastest, count)
        problem, envelope = discretise(run, positions), fastest.at(positions)
        if found is None and sketch.size < 0.6 * positions.size:
            found = _scouted(run, fastest, sketch, running_time)
        guess = first_guess(problem, envelope, running_time)
        if found is not None:
            guess = finer_guess(found, sketch, problem, range(problem.shape[0]))
        try:
            answer = search(problem, guess, envelope, running_time)
        except InfeasibleError:
            if problem.shape[0] > 1 or count > cells:
                raise
            continue
        traction = answer.plan.traction * problem.reference
        taper = answer.problem.taper.fall * problem.reference
        rollout = audit(run, positions, traction, taper, answer.plan.braking * problem.reference)
        failures = rollout.failures(run, running_time)
        if not failures:
            coarser = None if found is None else (sketch.size - 1, found.solution.energy)
            return answer.problem, answer, rollout, coarser
        words = failures[0] + (f" and {len(failures) - 1} more" if len(failures) > 1 else "")
    raise TrainlogError(
        f"the trajectory does not pass its audit: {words}",
        remedy="more cells, or more reserve",
    )


def _scouted(
    run: TrajectoryProblem, fastest: Envelope, positions: FloatArray, running_time: float
) -> Answer | None:
    """The optimum on a coarse grid: first for the configurations that stand out, then for all.

    None if it has no optimum: that of the fine grid may have one, and else it explains itself.
    """
    problem, speeds = discretise(run, positions), fastest.at(positions)
    rows = outstanding(problem, fastest.times)
    some = problem.select(rows)
    try:
        guess = first_guess(some, speeds[rows], running_time)
        answer = search(some, guess, speeds[rows], running_time, coarse=True)
        if len(rows) == problem.shape[0]:
            return answer
        guess = finer_guess(answer, positions, problem, rows)
        return search(problem, guess, speeds, running_time, coarse=True)
    except InfeasibleError:
        return None


def _reading(run: TrajectoryProblem) -> dict[str, str | float]:
    """How the track-condition map was read."""
    told: dict[str, str | float] = {"layer": run.layer, "sigmas": run.sigmas}
    if np.isfinite(run.assumed_adhesion):
        told["assumed"] = run.assumed_adhesion
    return told


def _check_arguments(running_time: float | None, reserve: float, cells: int) -> None:
    """Refuse numbers that no timetable and no grid has."""
    if running_time is not None and not (running_time > 0.0 and np.isfinite(running_time)):
        raise InputError(
            f"trajectory: a running time of {running_time} s makes no sense",
            remedy="give the timetable's running time in seconds",
        )
    if not (reserve >= 0.0 and np.isfinite(reserve)):
        raise InputError(
            f"trajectory: a reserve of {reserve:.0%} makes no sense", remedy="give 0 or more"
        )
    if not FEWEST_CELLS <= cells <= MOST_CELLS:
        raise InputError(
            f"trajectory: {cells} cells make no sense",
            remedy=f"give {FEWEST_CELLS} to {MOST_CELLS}",
        )


RESERVES = (0.02, 0.03, 0.04, 0.05, 0.07, 0.1, 0.13, 0.17, 0.22, 0.3)
"""Over the least time; closer where the front is steep."""


@dataclass(frozen=True, eq=False)
class Front:
    """Least energies for several running times.

    Attributes
    ----------
    trajectories : tuple of m Trajectory
        Each with its certificate, shortest running time first.
    least_time : float [s]
        Of the slowest configuration by itself.
    """

    trajectories: tuple[Trajectory, ...]
    least_time: float

    @property
    def times(self) -> FloatArray:
        """Running times, (m,) [s]."""
        return np.array([each.running_time for each in self.trajectories])

    @property
    def energies(self) -> FloatArray:
        """Worst-case (or expected) energies, (m,) [J]."""
        return np.array([each.certificate["energy"] for each in self.trajectories])

    @property
    def bounds(self) -> FloatArray:
        """Lower bounds of the energies, (m,) [J]."""
        return np.array([each.certificate["lower_bound"] for each in self.trajectories])

    @property
    def prices(self) -> FloatArray:
        """What a second more saves, from the multipliers of the running time, (m,) [J/s]."""
        return np.array(
            [sum(each.certificate["time_price"].values()) for each in self.trajectories]
        )


def energy_against_time(
    line: Line,
    train: Train,
    configurations: Sequence[Configuration],
    *,
    reserves: Sequence[float] = RESERVES,
    **options: Any,
) -> Front:
    """Least energy for several reserves over the least time.

    Parameters
    ----------
    line, train, configurations
        As for `optimise`.
    reserves : sequence of float
        Parts of the least time. Those that cannot be kept together are left out.
    **options
        What else `optimise` takes, the same for every point.

    Raises
    ------
    InputError
        If there are no reserves.
    InfeasibleError
        If not one of them can be kept.
    """
    if not len(reserves):
        raise InputError("front: no reserves are given")
    found: list[Trajectory] = []
    failure: InfeasibleError | None = None
    for reserve in sorted(set(reserves)):
        try:
            found.append(optimise(line, train, configurations, reserve=reserve, **options))
        except InfeasibleError as error:
            failure = error
    if not found:
        assert failure is not None
        raise failure
    return Front(tuple(found), max(found[0].certificate["least_time"]))
