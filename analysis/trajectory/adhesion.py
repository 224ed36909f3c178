"""What a run counts on of a track-condition map, where, and with which risk: in words."""

from __future__ import annotations

import numpy as np
from pandas import Timestamp

from analysis.adhesion.demonstrated import risk_of_run
from analysis.trajectory.problem import TrajectoryProblem
from trainlog.arrays import FloatArray
from trainlog.condition import setting
from trainlog.railway import Trajectory
from trainlog.units import GRAVITY


def adhesion_demand(run: TrajectoryProblem, trajectory: Trajectory) -> FloatArray:
    """Most adhesion that any configuration asks for in each bin of the run's map; (n,) array.

    Traction of the powered axles, braking of all; 0 beyond the trajectory.
    """
    track = run.condition_map
    assert track is not None
    asked = np.maximum(*_asked(run, trajectory))
    places = trajectory.positions
    if run.direction == "reverse":
        places, asked = run.line.length - places[::-1], asked[::-1]
    found = np.zeros(track.bins)
    first = track.bin_of(places[:-1])
    last = track.bin_of(np.nextafter(places[1:], -np.inf))
    for cell in range(asked.size):
        here = slice(first[cell], last[cell] + 1)
        found[here] = np.maximum(found[here], asked[cell])
    return found


def _asked(run: TrajectoryProblem, trajectory: Trajectory) -> tuple[FloatArray, FloatArray]:
    """Most adhesion that any configuration asks for in traction and in braking; (n,) arrays."""
    masses = np.array([each.mass for each in trajectory.configurations])
    adhesive = min(run.train.adhesive_weight(mass - run.train.mass) for mass in masses.tolist())
    pull = trajectory.tractive_effort + 0.5 * np.abs(trajectory.tractive_effort_fall)
    braking = (trajectory.braking_effort / (GRAVITY * masses[:, None])).max(axis=0)
    return pull / adhesive, braking


def expected_when(time: Timestamp | None) -> str:
    """For which time a map's expectation holds."""
    return "right after the last evidence" if time is None else f"at {time.isoformat()}"


def read_words(risk: float | None, time: Timestamp | None, less: str) -> str:
    """How a map is read: with a risk, or what lasts or is expected `less` a margin."""
    when = expected_when(time)
    if risk is not None:
        return f"at most a risk of {risk:g} a place, as expected {when}"
    if time is None:
        return f"the lasting condition {less}"
    return f"what is expected {when}, with passing spots, {less}"


def adhesion_words(run: TrajectoryProblem, trajectory: Trajectory) -> list[str]:
    """How the map was read, over how many kilometres it limits, and the risk of the run.

    Without a map: the most adhesion that the run asks for, which nothing limits.

    Examples
    --------
    >>> import trainlog
    >>> from trainlog.railway import Configuration
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> alone = (Configuration.of(train),)
    >>> run = TrajectoryProblem(line, train, alone, condition_map=track, risk=0.05)
    >>> standing = Trajectory(
    ...     line.name, train.name, np.array([0.0, 500.0]), alone, np.zeros((1, 2)),
    ...     np.zeros((1, 2)), np.zeros(1), np.zeros((1, 1)), 100.0,
    ... )
    >>> adhesion_words(run, standing)[0]
    'adhesion: layer wet, at most a risk of 0.05 a place, as expected right after the last evidence'
    """
    track, usable = run.condition_map, run.usable
    if track is None or usable is None:
        pulling, braking = (each.max(initial=0.0) for each in _asked(run, trajectory))
        return [
            "adhesion: not limited, for want of a map; asks for up to"
            f" {pulling:.3f} in traction, {braking:.3f} in braking"
        ]
    when = expected_when(run.time)
    less = f"less {run.sigmas:g} standard deviations"
    ends = trajectory.positions[[0, -1]]
    start, end = run.line.length - ends[::-1] if run.direction == "reverse" else ends
    edges = track.bin_length * np.arange(track.bins + 1)
    km = np.diff(np.clip(edges, start, end)) / 1e3
    free = np.isinf(usable.values)
    parts = [
        (km[usable.seen].sum(), "known from slip"),
        (km[usable.demonstrated].sum(), "demonstrated without slip"),
        (km[usable.assumed & ~free].sum(), f"assumed, {run.assumed_adhesion:g}"),
        (km[free].sum(), "without a limit, for want of evidence (assumed-adhesion sets one)"),
    ]
    shares = ", ".join(f"{length:.1f} km {words}" for length, words in parts if length > 0.0)
    expected = track.layer(run.layer).expected(run.time)
    demand = np.where(expected.observed, adhesion_demand(run, trajectory), 0.0)
    risk = risk_of_run(expected, demand, track.bin_length, setting(track, "correlation_length"))
    low, high = (f"{100.0 * each:.2g} %" for each in risk)
    return [
        f"adhesion: layer {run.layer}, {read_words(run.risk, run.time, less)}",
        f"of {km.sum():.1f} km: {shares}",
        f"risk that a run finds less than it asks for somewhere, as expected {when}: {low} to"
        f" {high}, from the {km[usable.seen].sum():.1f} km known from slip alone",
    ]
