"""A consist's run over a line: what the study shows is what the train did."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from simulated_line import level_line, steps

from analysis.studies.in_train_forces import simulation as study
from trainlog.cli.main import run as command
from trainlog.errors import InputError
from trainlog.formats.railway import read_consist, write_consist, write_line
from trainlog.formats.samples import sample
from trainlog.railway.train import Consist

SHORT = replace(
    level_line(2_400.0),
    gradients=steps((0.0, 0.0), (600.0, 0.015), (900.0, -0.015), (1_200.0, 0.0)),
)


def passenger(coaches: int = 2) -> Consist:
    whole = read_consist(sample("passenger_8_coaches.consist.json"))
    return replace(whole, vehicles=whole.vehicles[: coaches + 1], couplers=whole.couplers[:coaches])


@pytest.fixture(scope="module")
def run() -> study.ConsistRun:
    return study.run(passenger(), SHORT, speed=15.0)


def test_the_train_starts_brakes_halts_and_brakes_in_an_emergency(run: study.ConsistRun) -> None:
    assert [name for _, name in run.phases] == [
        "start and run",
        "full service braking",
        "halt",
        "start again",
        "emergency braking",
        "end",
    ]
    # It keeps the speed and gains on the descent what 4.5 m of height give at most.
    assert 14.0 < run.speeds.max() < np.sqrt(15.0**2 + 2.0 * 9.81 * 4.5)
    for name in ("halt", "end"):
        assert np.all(run.speeds[run.phase(name)][5:100] < 0.01)
    assert run.residual <= 1e-9


def test_the_couplers_carry_what_accelerates_the_vehicles_behind_them(
    run: study.ConsistRun,
) -> None:
    """Newton's law for the last coach, from what is recorded alone."""
    coach = run.consist.vehicles[-1]
    calm = slice(200, 400)  # level, under traction
    acceleration = np.gradient(run.speeds[:, -1], run.time)[calm]
    needed = coach.inertia * acceleration + coach.resistance(run.speeds[calm, -1])
    np.testing.assert_allclose(run.forces[calm, -1], needed, atol=0.05 * needed.max())


def test_the_command_runs_a_file(tmp_path: Path) -> None:
    file = tmp_path / "short.consist.json"
    write_consist(passenger(1), file)
    assert command(["show", str(file)]) == 0
    write_line(SHORT, tmp_path / "line.json")
    options = ["--line", str(tmp_path / "line.json"), "--speed", "60", "-o", str(tmp_path)]
    assert command(["study", "consist", str(file), *options]) == 0
    assert (tmp_path / "short.mcap").is_file()
    assert (tmp_path / "short.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    ("consist", "speed", "words"),
    [
        (passenger(0), 15.0, "is a single particle: there are no forces in it"),
        (passenger(), 0.0, "must be positive, not 0 km/h"),
        (
            read_consist(sample("freight_24_wagons.consist.json")),
            9.0,
            "is too short for a train of",
        ),
    ],
)
def test_what_cannot_be_driven_is_refused(consist: Consist, speed: float, words: str) -> None:
    refused(InputError, words, study.run, consist, SHORT, speed=speed)
