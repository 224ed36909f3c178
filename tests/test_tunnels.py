"""Resistance in tunnels is learned where a trip runs through any, whatever the file states."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from analysis.comparison.calculated import calculate
from analysis.resistance.fit import TripFit, fit_trip
from analysis.resistance.recording import TripRefusedError
from analysis.trajectory.optimiser import optimise
from analysis.trajectory.problem import OptimiserOptions, TrajectoryProblem
from analysis.trajectory.table import PlannedRun
from analysis.truth import truth_of
from trainlog.formats.railway import line_to_bytes, read_line, read_train, train_to_bytes
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.ttobench import read_track, read_train as read_published_train
from trainlog.mcap import read_log
from trainlog.railway import Line, Train, Tunnel
from trainlog.simulation import draw_scenarios, simulate
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip

pytestmark = pytest.mark.usefixtures("remembered")

PUBLISHED = Path(__file__).parents[2] / "shared" / "data" / "ttobench"

PAIRS = (
    (None, None),
    ("CH_Stadelhofen_Altstetten", "CH_Stadler_KISS_SBB"),
    ("00_reference", "NL_Intercity_VIRM6"),
)

SHARES = ((0.12, 0.04, 42.0), (0.3, 0.085, 55.0), (0.55, 0.03, 33.0), (0.75, 0.06, 42.0))
"""Place and length over that of the line, and cross-section [m²], of four tunnels."""


def trips(line: Line, train: Train, strength: float, count: int) -> Iterator[tuple[Trip, Train]]:
    """Trips of a train whose tunnels resist, and of whose tunnels its file states nothing."""
    # By another power of the section than the published coefficients have.
    law = tuple((area, strength * 14.0 * (30.0 / area) ** 1.3) for area in (30.0, 42.0, 60.0))
    true, shown = replace(train, tunnel_resistance=law), replace(train, tunnel_resistance=())
    tunnels = (Tunnel(at * line.length, long * line.length, area) for at, long, area in SHARES)
    for scenario in draw_scenarios(replace(line, tunnels=tuple(tunnels)), true, count, seed=5):
        trip = simulate(scenario)
        stated = {TRAIN_ATTACHMENT: train_to_bytes(shown)}
        yield replace(trip, attachments={**trip.attachments, **stated}), true


def test_tunnels_that_add_no_resistance_are_stated():
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    line = replace(line, tunnels=(Tunnel(1_000.0, 500.0, 40.0), Tunnel(2_400.0, 500.0, 40.0)))
    silent = replace(train, tunnel_resistance=())
    words = "km of tunnels add no resistance: the train file has no tunnel_resistance"
    assert words in silent.unknown_tunnels(line)[0]
    problem = TrajectoryProblem.nominal(line, silent, start=500.0, end=2_500.0)
    run = PlannedRun(problem, optimise(problem, OptimiserOptions(cells=30)))
    assert any(note.startswith(f"0.6 {words}") for note in run.notes)
    stated = replace(problem, train=replace(train, tunnel_resistance=((40.0, 5.0),)))
    assert not any(words in note for note in PlannedRun(stated, run.run).notes)
    trip = read_log(sample("nonstop.mcap"))
    files = {LINE_ATTACHMENT: line_to_bytes(line), TRAIN_ATTACHMENT: train_to_bytes(silent)}
    found = calculate(replace(trip, attachments={**trip.attachments, **files}), silent)
    assert f"1.0 {words}" in " ".join(found.notes)


def check(fit: TripFit, trip: Trip, true: Train) -> tuple[bool, bool]:
    """Whether the bands hold the curve of open track, and the resistance in the tunnels."""
    truth = truth_of(trip)
    speed = np.linspace(12.0, fit.asked[1], 20)
    low, high = fit.band(speed)
    curve = truth.resistance(speed)
    found = fit.tunnels
    held = []
    for section, expected in zip(found.sections, found.expected, strict=True):
        error = found.factor * expected - float(true.tunnel_coefficient(section))
        held.append(abs(error) < 1.96 * found.std * expected)
    return bool(np.mean((low <= curve) & (curve <= high)) > 0.9), all(held)


@pytest.mark.parametrize("strength", [pytest.param(0.6, marks=pytest.mark.long), 2.0])
def test_tunnels_spoil_no_curve_and_their_resistance_is_learned(strength):
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    ((trip, true),) = trips(line, train, strength, 1)
    fit = fit_trip(trip)
    assert check(fit, trip, true) == (True, True)
    assert "kg/m in 33 m²" in fit.summary()["tunnels"]
    assert "published tunnels" in fit.summary()["tunnels"]


@pytest.mark.long
@pytest.mark.skipif(not PUBLISHED.is_dir(), reason="TTOBench is not beside the checkout")
def test_tunnels_of_three_lines_and_trains():
    """Nine in ten bands hold, over three lines, three trains and three strengths."""
    curves, tunnels = [], []
    for track, vehicle in PAIRS:
        if track is None or vehicle is None:
            line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
        else:
            line = read_track(PUBLISHED / "tracks" / f"{track}.json")
            train = read_published_train(PUBLISHED / "trains" / f"{vehicle}.json")
        for strength in (0.6, 1.0, 2.0):
            for trip, true in trips(line, train, strength, 4):
                try:
                    held = check(fit_trip(trip), trip, true)
                except TripRefusedError:
                    continue
                curves.append(held[0])
                tunnels.append(held[1])
    assert len(curves) >= 18
    assert np.mean(curves) >= 0.9
    assert np.mean(tunnels) >= 0.9
