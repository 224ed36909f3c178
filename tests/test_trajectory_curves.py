"""Trajectories of trains whose effort over speed is a curve: within it everywhere, and bounded."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from trajectory_cases import FLIRT, VIRM6, drawn, hilly_line, level_line, optimised

from analysis.trajectory import active_set
from analysis.trajectory.audit import Audit, audit
from analysis.trajectory.envelope import fastest_run
from analysis.trajectory.optimiser import GAP_TOLERANCE
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.railway import Configuration, EffortCurve, Train, Trajectory

LINES = {"level": level_line(12_000.0, (0, 140), (5_000, 90), (9_000, 120)), "hilly": hilly_line()}


def curve(*points: tuple[float, float]) -> EffortCurve:
    """Points in km/h and kN."""
    speeds, efforts = np.array(points).T
    return EffortCurve(speeds / 3.6, 1e3 * efforts)


LINEAR = curve((0, 200), (47, 190), (72, 120), (108, 60), (160, 35))
"""Falls faster than a power lets it."""

STEPPED = curve((0, 200), (36, 195), (43, 150), (90, 100), (94, 60), (165, 52))
FADING = curve((0, 0), (7, 100), (29, 150), (72, 110), (162, 50))
"""A dynamic brake that fades towards the stop, too."""

BUMPED = curve((0, 180), (36, 120), (72, 80), (90, 95), (108, 80), (162, 35))
"""Rises once, as no plan may count on in a cell that it passes."""

TRAINS = {
    "linear": replace(FLIRT, traction_curve=LINEAR),
    "stepped": replace(FLIRT, traction_curve=STEPPED, dynamic_braking_curve=FADING),
    "bumped": replace(VIRM6, traction_curve=BUMPED, dynamic_braking_curve=BUMPED),
}


def within(train: Train, trajectory: Trajectory) -> FloatArray:
    """Largest traction over what each configuration's own curve gives, at both ends of cells."""
    ends = [
        (trajectory.tractive_effort + half * trajectory.tractive_effort_fall, nodes)
        for half, nodes in ((0.5, slice(0, -1)), (-0.5, slice(1, None)))
    ]
    return np.array(
        [
            max(
                float((effort / train.tractive_effort_limit(speeds[nodes], each.max_power)).max())
                for effort, nodes in ends
            )
            for each, speeds in zip(trajectory.configurations, trajectory.speeds, strict=True)
        ]
    )


@pytest.mark.parametrize(
    ("train", "line"), [("linear", "hilly"), ("stepped", "level"), ("bumped", "level")]
)
def test_plans_stay_within_the_curve_and_pass_their_audit(train, line):
    configurations = drawn(TRAINS[train], 2, seed=3, spread=0.05)
    trajectory = optimised(LINES[line], TRAINS[train], configurations, reserve=0.1, cells=80)
    certificate = trajectory.certificate
    assert certificate["audit"]["passed"]
    assert certificate["audit"]["effort"] <= 1.0 + 1e-6
    assert certificate["audit"]["braking"] <= 1.0 + 1e-6
    # A plan leaves out what rises again, which the bound counts; the certificate states it.
    assert -1e-6 <= certificate["gap"] <= (5e-3 if train == "bumped" else GAP_TOLERANCE)
    excess = certificate["energy"] - certificate["lower_bound"]
    assert certificate["certified"] == (excess <= certificate["tolerance"])
    assert np.all(within(TRAINS[train], trajectory) <= 1.0 + 1e-6)


@pytest.mark.usefixtures("unrenewed")
@pytest.mark.parametrize("kind", ["effort", "braking"])
def test_what_an_audit_finds_beyond_a_curve_is_taken_off_it(kind, monkeypatch):
    """As for a train that gives a ten-thousandth less than its curve states."""

    def less(answer: active_set.Answer) -> Audit:
        found = driven(answer)
        return replace(found, **{kind: 1.0001 * getattr(found, kind)})

    driven = active_set.driven
    monkeypatch.setattr(active_set, "driven", less)
    # All braking is dynamic, and goes with its curve at high speeds.
    train = replace(
        FLIRT, traction_curve=LINEAR, dynamic_braking_curve=curve((0, 90), (60, 60), (162, 20)),
        max_pneumatic_braking_effort=1.0,
    )  # fmt: skip
    trajectory = optimised(LINES["level"], train, drawn(train, 2, seed=3), reserve=0.1, cells=80)
    used = within(train, trajectory).max()
    if kind == "braking":
        fastest = np.maximum(trajectory.speeds[:, :-1], trajectory.speeds[:, 1:])
        most = 1.0 + train.dynamic_braking_effort_limit(fastest)
        used = (trajectory.braking_effort / most).max()
    assert 0.999 < used <= 1.0 / 1.0001 + 1e-6


def test_a_common_brake_stops_a_train_whose_dynamic_brake_fades():
    train = TRAINS["stepped"]
    trajectory = optimised(
        LINES["hilly"], train, [Configuration.of(train)], reserve=0.08, braking="common", cells=100
    )
    assert trajectory.certificate["certified"]
    assert np.all(within(train, trajectory) <= 1.0 + 1e-6)


@pytest.mark.usefixtures("unrenewed")
def test_without_its_curve_a_train_would_be_asked_for_more_than_it_gives():
    """Effort and power alone ask this train for 54 kN where it gives 48."""
    known = replace(
        FLIRT,
        max_tractive_effort=100e3,
        max_traction_power=1.35e6,
        traction_curve=curve((0, 100), (36, 96), (90, 48), (140, 26)),
    )
    at = 25.0
    alone = replace(known, traction_curve=None)
    assert float(alone.tractive_effort_limit(at)) == pytest.approx(54e3)
    assert float(known.tractive_effort_limit(at)) == pytest.approx(48e3)
    configurations = [Configuration.of(known)]
    line = LINES["level"]
    blind = optimised(line, alone, configurations, reserve=0.05, cells=80)
    assert blind.certificate["audit"]["passed"]
    run = TrajectoryProblem(line, known, configurations)
    refused = audit(
        run, blind.positions, blind.tractive_effort, 0.5 * blind.tractive_effort_fall,
        blind.braking_effort,
    )  # fmt: skip
    assert refused.effort[0] > 1.1
    assert any("exceeds the traction" in each for each in refused.failures(run, np.inf))
    seeing = optimised(line, known, configurations, reserve=0.05, cells=80)
    assert np.all(within(known, seeing) <= 1.0 + 1e-6)
    assert seeing.certificate["audit"]["effort"] <= 1.0 + 1e-6


@pytest.mark.usefixtures("unrenewed")
def test_a_curve_that_is_the_hyperbola_gives_what_effort_and_power_give():
    speeds = np.linspace(0.0, 50.0, 501)
    hyperbola = EffortCurve(speeds, FLIRT.tractive_effort_limit(speeds))
    same = replace(FLIRT, traction_curve=hyperbola, max_traction_power=3.0 * 2.6e6)
    results = []
    for train in (FLIRT, same):
        run = TrajectoryProblem(LINES["hilly"], train, [Configuration.of(train)])
        plan = optimised(
            LINES["hilly"], train, [Configuration.of(train)], running_time=400.0, cells=60
        )
        results.append((float(fastest_run(run).times[0]), plan.certificate["energy"]))
    assert results[1] == pytest.approx(results[0], rel=2e-4)


def test_the_fastest_run_of_a_linear_curve_is_that_of_its_closed_form():
    """Without resistance ``dv/dt = a (1 - v/w)``: after t the speed is ``w (1 - exp(-a t/w))``."""
    train = replace(
        FLIRT,
        resistance=replace(FLIRT.resistance, r0=0.0, r1=0.0, r2=0.0),
        traction_curve=curve((0, 100), (200, 0)),
        max_speed=50.0,
    )
    line = level_line(6_000.0, (0, 180))
    run = TrajectoryProblem(line, train, [Configuration.of(train)], final_speed=50.0)
    fastest = fastest_run(run)
    a, w = 100e3 / (train.mass + train.rotating_mass), 200.0 / 3.6
    v = fastest.speeds[0, 1:]
    needed = -w / a * (v + w * np.log1p(-v / w))
    np.testing.assert_allclose(needed[40:500], fastest.positions[41:501], rtol=1e-6)
