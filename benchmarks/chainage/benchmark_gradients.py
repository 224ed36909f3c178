"""Gradients of a line from the altitudes of rides, and coast-down of the rides on it.

    python benchmarks/chainage/benchmark_gradients.py [--published ../shared/data/ttobench]

Ten simulated trips of three trains on three lines, reduced to what a satellite receiver records.
Their altitudes err by what the simulated receiver errs, and wander between random levels of heavy
tails. The line is built from them; its gradients over 500 m are compared with the true line's, and
each ride is searched for coasting on the line that was built.
"""

from __future__ import annotations

import argparse
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1] / "recorded"))
from recordings import PAIRS, line_and_train

from analysis.geometry.centre_line import CentreLine, geometry_of, line_of
from analysis.resistance.coast_down import coast_down
from analysis.truth import truth_of
from estimators.centre_line import OVER
from trainlog.errors import NotIdentifiableError
from trainlog.ingest import profile_of
from trainlog.ingest.chainage import estimated_state
from trainlog.railway import Line, Train
from trainlog.railway.geometry import nearest_on, track_of
from trainlog.simulation import Sensors, draw_scenarios, simulate
from trainlog.trip import TRAIN_ATTACHMENT, Trip

PROFILE = profile_of({"format": "trainlog/recorder-profile", "version": 1, "name": "receiver"})


def receiver_only(trip: Trip, generator: np.random.Generator, size: float) -> Trip:
    """What a satellite receiver alone would have recorded."""
    fix = trip["/gnss/fix"].copy()
    fix.attrs = trip["/gnss/fix"].attrs
    time = (fix.index - fix.index[0]).total_seconds().to_numpy()
    turns = np.cumsum(generator.exponential(60.0, int(time[-1] / 20.0) + 10))
    levels = size * generator.standard_t(5, turns.size) / np.sqrt(5.0 / 3.0)
    fix["altitude"] += np.interp(time, turns, levels) + generator.normal(0.0, 10.0)
    return Trip(
        {"/gnss/fix": fix, "/gnss/motion": trip["/gnss/motion"]},
        {"trip": trip.name, "train": trip.metadata["train"]},
        attachments={TRAIN_ATTACHMENT: trip.attachments[TRAIN_ATTACHMENT]},
    )


def true_gradients(centre_line: CentreLine, line: Line) -> np.ndarray:
    """The true line's rise over the stretches of the line built, over their length."""
    track = track_of(line.geometry)
    ends = []
    for offset in (-0.5 * OVER, 0.5 * OVER):
        at = centre_line.heights.position + offset
        latitude, longitude = (
            np.interp(at, centre_line.position, values)
            for values in (centre_line.latitude, centre_line.longitude)
        )
        ends.append(nearest_on(track, track.plane(latitude, longitude))[0])
    places = np.arange(0.0, line.length + 1.0, 5.0)
    heights = np.concatenate(([0.0], np.cumsum(5.0 * line.gradients(places)[:-1])))
    return (np.interp(ends[1], places, heights) - np.interp(ends[0], places, heights)) / OVER


def located(ride: Trip, built: Line, line: Line, direction: str) -> Trip:
    """The ride with its chainage on the line that was built."""
    start = built.geometry.latitudes[0], built.geometry.longitudes[0]
    apart = [
        (start[0] - line.geometry.latitudes[end]) ** 2
        + (start[1] - line.geometry.longitudes[end]) ** 2
        for end in (0, -1)
    ]
    forward = (direction == "forward") == (apart[0] < apart[1])
    frame = estimated_state(ride, built if forward else built.reversed(), PROFILE).frame
    assert frame is not None
    stated = {**ride.metadata, "direction": "forward" if forward else "reverse"}
    return replace(ride.with_topic(frame), metadata=stated)


def tried(line: Line, train: Train, size: float, noise: float) -> list[str]:
    """One row of the table."""
    generator = np.random.default_rng(1)
    scenarios = draw_scenarios(line, train, 10, seed=11, sensors=Sensors(gnss_position_noise=noise))
    trips = [simulate(scenario) for scenario in scenarios]
    rides = [receiver_only(trip, generator, size) for trip in trips]
    centre_line = geometry_of(rides)
    heights = centre_line.heights
    error = heights.gradient - true_gradients(centre_line, line)
    inside = np.mean(np.abs(error) < 1.96 * heights.gradient_std)
    built = line_of(centre_line, "built")
    errors, held, reason = [], [], ""
    for ride, trip in zip(rides, trips, strict=True):
        try:
            found = coast_down(
                [located(ride, built, line, trip.metadata["direction"])], built
            ).curve
        except NotIdentifiableError as refusal:
            reason = str(refusal).partition(";")[2].strip() or str(refusal)
            continue
        truth = truth_of(trip)
        speeds = np.linspace(*found.supported, 30)
        true = truth.resistance(speeds) / (truth.mass + train.rotating_mass)
        low, high = found.band(speeds)
        errors.append(float(np.sqrt(np.mean((found(speeds) / true - 1.0) ** 2))))
        held.append(float(np.mean((low <= true) & (true <= high))))
    coasted = f"{len(errors)}/10"
    if errors:
        coasted += f" {np.median(errors):.1%} {np.mean(held):.2f}"
    return [
        f"{heights.sigma:.1f} m {heights.tau:.0f} s",
        f"{1e3 * np.sqrt(np.mean(error**2)):.2f} {inside:.2f}",
        f"{1e3 * centre_line.gradient_std:.2f}",
        f"{heights.widened:.2f}",
        coasted,
        "" if errors else reason[:90],
    ]


def main() -> None:
    """Print a row for each line and size of the errors."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--published", type=Path, default=Path("../shared/data/ttobench"))
    published = parser.parse_args().published.resolve()
    print(
        "line, train | altitudes err by, for | gradient RMS [per mille], in band | stated"
        " | widened | coast-down: fitted, error, in band | refused"
    )
    for size, noise in ((0.3, 0.2), (5.0, 2.5)):
        for pair in range(len(PAIRS) if published.exists() else 1):
            row = tried(*line_and_train(pair, published), size, noise)
            print(" | ".join([", ".join(PAIRS[pair]), *row]), flush=True)


if __name__ == "__main__":
    main()
