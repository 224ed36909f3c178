"""IPOPT on the same transcription finds the same; the bound lies below both; the picture."""

from __future__ import annotations

import numpy as np
import pytest
from trajectory_cases import FLIRT, VIRM6, drawn, hilly_line, level_line, observed, optimised

from analysis.studies.cunillera_2022.model import phases_by_switching
from analysis.trajectory.discretisation import graded_mesh
from analysis.trajectory.instructions import Phase, phase_letters, phases_by_control
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.referee import refereed
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import sample

pytestmark = pytest.mark.usefixtures("unrenewed")


@pytest.mark.parametrize("objective", ["wheel", "line"])
def test_referee_agrees(objective: str) -> None:
    run = TrajectoryProblem(
        level_line(), VIRM6, observed(VIRM6, 1.0), running_time=1541.0, initial_speed=1.0,
        final_speed=10.0, objective=objective,  # type: ignore[arg-type]
    )  # fmt: skip
    found = optimise(run, OptimiserOptions(cells=120))
    result, excess = refereed(run, found)
    assert result.status == "Solve_Succeeded"
    assert abs(excess) <= 3e-6
    assert found.certificate["energy"] / (1.0 + excess) >= found.certificate["lower_bound"]


def test_referee_agrees_on_hills_with_several_configurations() -> None:
    run = TrajectoryProblem(
        hilly_line(), FLIRT, drawn(FLIRT, 3, seed=4, spread=0.04), reserve=0.15,
        initial_speed=2.0, final_speed=2.0,
    )  # fmt: skip
    result, excess = refereed(run, optimise(run, OptimiserOptions(cells=120)))
    assert result.solved
    assert abs(excess) <= 3e-5


def test_embedded_line_and_train_with_twelve_configurations() -> None:
    line = read_line(sample("CH_StGallen_Wil.line.json"))
    train = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    found = optimised(line, train, drawn(train, 12, seed=5), reserve=0.07)
    certificate = found.certificate
    assert certificate["gap"] <= 5e-4
    assert certificate["certified"]
    assert certificate["audit"]["lateness"] <= 1e-4
    assert certificate["audit"]["overspeed"] <= 1e-5
    assert certificate["audit"]["power"] <= 1.0 + 1e-6


def test_phases_by_control() -> None:
    traction = np.array([100.0, 60.0, 0.0, 0.0, 0.0, 40.0])
    braking = np.array([0.0, 0.0, 0.0, 30.0, 50.0, 25.0])
    phases = phases_by_control(traction, braking, np.full(6, 100.0), np.full(6, 50.0))
    assert phase_letters(phases) == "TPCHBP"
    switching = np.array([1.5, 1.0, 0.5, 0.0, -0.5, 1.0])
    assert phase_letters(phases_by_switching(switching)) == "TPCHBP"
    assert Phase.MAXIMUM_TRACTION.label == "maximum traction"


def test_mesh_goes_through_every_breakpoint_and_is_fine_where_speed_changes() -> None:
    positions = np.linspace(0.0, 1_000.0, 1_001)
    speeds = np.minimum(np.sqrt(2.0 * positions), 20.0)
    breakpoints = np.array([0.0, 333.3, 777.7, 1_000.0])
    mesh = graded_mesh(breakpoints, positions, speeds, 100)
    assert np.isin(breakpoints, mesh).all()
    assert abs(mesh.size - 1 - 100) <= 3
    step = np.diff(mesh)
    assert step[0] < 0.2 * step[-1]


def test_mesh_keeps_spare_cells_on_a_line_of_many_breakpoints() -> None:
    positions = np.linspace(0.0, 1_000.0, 1_001)
    speeds = np.minimum(np.sqrt(2.0 * positions), 20.0)
    breakpoints = np.linspace(0.0, 1_000.0, 101)
    assert graded_mesh(breakpoints, positions, speeds, 80).size - 1 >= 118
