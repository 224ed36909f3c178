"""The audit: it agrees with other integrators, and it catches what is wrong."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from trajectory_cases import (
    FLIRT,
    VIRM6,
    drawn,
    hilly_line,
    level_line,
    observed,
    optimised,
    slippery,
    steps,
)

from analysis.trajectory.audit import Audit, audit
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.errors import TrainlogError
from trainlog.railway import Line, Trajectory
from trainlog.units import GRAVITY


@pytest.fixture(scope="module")
def hilly() -> Trajectory:
    return optimised(hilly_line(), FLIRT, observed(FLIRT, 0.9, 1.0, 1.1), reserve=0.1, cells=200)


def run_of(trajectory: Trajectory, **changes: object) -> TrajectoryProblem:
    line = hilly_line()
    run = TrajectoryProblem(line, FLIRT, trajectory.configurations)
    return replace(run, **changes)


def audited(
    trajectory: Trajectory, traction: float = 1.0, braking: float = 1.0, **changes: object
) -> tuple[Audit, list[str]]:
    run = run_of(trajectory, **changes)
    found = audit(
        run,
        trajectory.positions,
        traction * trajectory.tractive_effort,
        0.5 * traction * trajectory.tractive_effort_fall,
        braking * trajectory.braking_effort,
    )
    return found, found.failures(run, trajectory.running_time)


def test_the_optimiser_s_own_answer_passes(hilly: Trajectory) -> None:
    found, failures = audited(hilly)
    assert failures == []
    # A trifle early is allowed, late is not.
    assert -5e-3 <= found.arrival.max() - hilly.running_time <= 1e-4
    assert found.shortfall.max() <= 1e-4


@pytest.mark.parametrize(
    ("traction", "braking", "words"),
    [
        (1.01, 1.0, "exceeds the power"),
        (0.99, 1.0, "arrives late"),
        (1.0, 1.02, "stops short"),
        (1.0, 0.98, "too fast at the end"),
        (1.0, 1.02, "exceeds the brake"),
        (1.01, 1.0, "exceeds the permitted speed"),
        (1.6, 1.0, "exceeds the traction"),
    ],
)
def test_tampered_efforts_are_caught(
    hilly: Trajectory, traction: float, braking: float, words: str
) -> None:
    _, failures = audited(hilly, traction, braking)
    assert any(words in failure for failure in failures), failures


def test_slippery_rail_is_caught(hilly: Trajectory) -> None:
    _, failures = audited(hilly, condition_map=slippery(hilly_line(), (0.0, 500.0, 0.05)))
    assert any("exceeds the adhesion" in failure for failure in failures)


def test_heavier_train_is_caught(hilly: Trajectory) -> None:
    heavier = tuple(replace(c, mass=1.02 * c.mass) for c in hilly.configurations)
    _, failures = audited(hilly, configurations=heavier)
    assert any("too fast at the end" in failure for failure in failures)


def test_audit_agrees_with_an_integrator_in_time(hilly: Trajectory) -> None:
    """An adaptive integrator in time, forces from the line itself, cell by cell."""
    line, row = hilly_line(), 2
    configuration = hilly.configurations[row]

    def motion(
        _t: float, state: NDArray[np.float64], cell: int, low: float, high: float
    ) -> list[float]:
        position, speed = state
        inside = np.array([np.clip(position, low, high)])
        effort = hilly.tractive_effort_at(inside) - hilly.braking_effort[row, cell]
        drag = configuration.resistance(speed) + configuration.mass * line.track_acceleration(
            inside
        )
        tunnel = FLIRT.tunnel_coefficient(line.tunnel_cross_section(inside))
        return [speed, float((effort - drag - tunnel * speed**2)[0] / configuration.inertia)]

    time, speed = 0.0, 0.0
    for k in range(hilly.positions.size - 5):
        start, end = hilly.positions[k], hilly.positions[k + 1]

        def at_end(_t: float, state: NDArray[np.float64], *_: float, goal: float = end) -> float:
            return float(state[0] - goal)

        at_end.terminal = True  # type: ignore[attr-defined]
        found = solve_ivp(
            motion, (0.0, 200.0), [start, speed], events=at_end, rtol=1e-10, atol=1e-10,
            args=(k, start + 1e-9, end - 1e-9),
        )  # fmt: skip
        time += float(found.t_events[0][0])
        speed = float(found.y_events[0][0][1])
        assert speed == pytest.approx(hilly.speeds[row, k + 1], abs=1e-5)
    assert time == pytest.approx(hilly.times[row, -5], abs=1e-4)


def test_line_energy_of_the_audit_is_efforts_times_efficiency(hilly: Trajectory) -> None:
    found, _ = audited(hilly)
    step = np.diff(hilly.positions)
    assert found.wheel_energy == pytest.approx(float(hilly.tractive_effort @ step))
    most = hilly.braking_effort @ step * FLIRT.efficiency_regeneration
    spent = found.wheel_energy / FLIRT.efficiency_traction
    assert np.all(found.line_energy >= spent - most - 1.0)
    assert np.all(found.line_energy < spent)


def test_no_answer_leaves_that_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    def failing(self: Audit, run: TrajectoryProblem, running_time: float) -> list[str]:
        return ["configuration 'x1' arrives late by [s] 3"]

    monkeypatch.setattr(Audit, "failures", failing)
    with pytest.raises(TrainlogError, match="does not pass its audit: configuration 'x1'"):
        optimised(hilly_line(), FLIRT, observed(FLIRT, 1.0), cells=60)


@st.composite
def lines(draw: st.DrawFn) -> Line:
    """Lines of 3 to 12 km with up to five limits and gradients that a train can climb."""
    length = draw(st.floats(3_000.0, 12_000.0))
    count = draw(st.integers(1, 5))
    edges = [0.0, *sorted(draw(st.lists(
        st.floats(200.0, length - 200.0), min_size=count - 1, max_size=count - 1,
        unique_by=lambda s: round(s / 50.0),
    )))]  # fmt: skip
    limits = draw(st.lists(st.floats(12.0, 45.0), min_size=count, max_size=count))
    slopes = draw(st.lists(st.floats(-0.025, 0.025), min_size=count, max_size=count))
    return replace(
        level_line(length),
        speed_limits=steps(*zip(edges, limits, strict=True)),
        gradients=steps(*zip(edges, slopes, strict=True)),
    )


@settings(max_examples=12, deadline=None)
@given(
    line=lines(),
    train=st.sampled_from([FLIRT, VIRM6]),
    reserve=st.floats(0.05, 0.5),
    seed=st.integers(0, 1000),
    objective=st.sampled_from(["wheel", "line"]),
)
def test_any_run_passes_its_audit_and_respects_its_bound(
    line: Line, train: object, reserve: float, seed: int, objective: str
) -> None:
    configurations = drawn(train, 2, seed=seed, spread=0.05)  # type: ignore[arg-type]
    found = optimised(
        line,
        train,  # type: ignore[arg-type]
        configurations,
        reserve=reserve,
        objective=objective,  # type: ignore[arg-type]
        cells=80,
    )
    certificate = found.certificate
    assert certificate["energy"] >= certificate["lower_bound"] * (1.0 - 1e-6)
    assert certificate["audit"]["lateness"] <= 1e-4
    assert np.all(found.speeds[:, [0, -1]] == 0.0)
    assert np.all(found.speeds[:, 1:-1] > 0.0)
    assert np.all(np.diff(found.times, axis=1) > 0.0)
    assert np.all(np.isfinite(found.times))


def test_adhesion_of_the_audit_counts_the_weight(hilly: Trajectory) -> None:
    found, _ = audited(hilly, condition_map=slippery(hilly_line()))
    cautious = 0.30 * np.exp(-2.0 * 0.05)
    for row, configuration in enumerate(hilly.configurations):
        traction = hilly.tractive_effort.max() / FLIRT.adhesive_weight(0.0)
        braking = hilly.braking_effort[row].max() / (GRAVITY * configuration.mass)
        assert found.adhesion[row] == pytest.approx(max(traction, braking) / cautious)
