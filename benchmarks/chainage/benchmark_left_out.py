"""Whether chainage predicts real fixes that it was not given: phones on metro and trams.

    python benchmarks/chainage/benchmark_left_out.py [--data ../shared/data/aalto/device_data.csv]

Of each ride of the Aalto data on a line that at least three others drove, the line is built from
the other rides. Then fixes are left out, every fourth alone or all of every fourth stretch of some
minutes, and predicted: a prediction is right where it departs from the fix by less than 1.96
standard deviations of both, the fix's own being the larger of what the phone states and what was
estimated on the ride. Left-out fixes further than 100 m from the line are not judged, but counted.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from analysis.geometry.centre_line import geometry_of, line_of
from trainlog.errors import TrainlogError
from trainlog.ingest import ingest_each
from trainlog.ingest.chainage import estimated_state
from trainlog.ingest.profile import Profile
from trainlog.railway.geometry import beside, nearest_on, track_of
from trainlog.trip import Trip

PROFILE = Profile(format="trainlog/recorder-profile", version=1, name="none")

DATA = Path(__file__).parents[3] / "shared/data/aalto/device_data.csv"

GROUPS = {
    "metro to Vuosaari": (
        "007", "015", "016", "017", "024", "026", "034", "035", "036", "038", "045", "057", "077",
        "098",
    ),
    "tram 7A": ("006", "039", "050", "066"),
    "tram 9": ("014", "047", "060", "078", "079", "090", "094", "096"),
}  # fmt: skip
"""Rides of one line, by their number."""

FOLDS = 4


def left_out(seconds: np.ndarray, stretch: float, fold: int) -> np.ndarray:
    """Which fixes to leave out: every fourth, or those of every fourth stretch [s]."""
    number = np.floor(seconds / stretch).astype(int) if stretch else np.arange(seconds.size)
    out = number % FOLDS == fold
    out[[0, -1]] = False
    return out


def estimate(trip: Trip, line):
    """The estimate in the direction that the ride ran, and the line in that direction."""
    refused = None
    for way in (line, line.reversed()):
        try:
            found = estimated_state(trip, way, PROFILE)
        except TrainlogError as error:
            refused = refused or error
            continue
        if found.frame is not None:
            return way, found
    raise refused or TrainlogError("no estimate")


def predictions(trip: Trip, line, stretch: float):
    """Errors of predicted fixes, the bands, and how many were too far from the line."""
    fix = trip["/gnss/fix"].dropna(subset=["latitude"])
    time = fix.index.as_unit("ns").asi8
    seconds = (time - time[0]) / 1e9
    errors, bands, away = [], [], 0
    for fold in range(FOLDS):
        out = left_out(seconds, stretch, fold)
        if not out.any() or np.count_nonzero(~out) < 5:
            continue
        kept = fix[~out]
        kept.attrs = fix.attrs
        way, found = estimate(Trip({"/gnss/fix": kept}, trip.metadata), line)
        frame = found.frame
        at = (frame.index.as_unit("ns").asi8 - time[0]) / 1e9
        inside = out & (seconds >= at[0]) & (seconds <= at[-1])
        asked = seconds[inside]
        position = np.interp(asked, at, frame["position"])
        std = np.interp(asked, at, frame["position_std"])
        track = track_of(way.geometry)
        points = track.plane(
            fix["latitude"].to_numpy()[inside], fix["longitude"].to_numpy()[inside]
        )
        place, distance = nearest_on(track, points)
        near = distance < 100.0
        away += int(np.count_nonzero(~near))
        chainage, _ = beside(track, points, position)
        chainage = np.where(np.abs(place - position) < np.abs(chainage - position), place, chainage)
        noise = [
            found.metadata.get(f"receiver.{name}", 0.0) for name in ("position_std", "along_std")
        ]
        own = np.maximum(
            fix["horizontal_accuracy"].to_numpy()[inside], np.hypot(*map(float, noise))
        )
        errors.append((chainage - position)[near])
        bands.append(1.96 * np.hypot(std, own)[near])
    if not errors:
        return np.zeros(0), np.zeros(0), 0
    return np.concatenate(errors), np.concatenate(bands), away


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--data", type=Path, default=DATA)
    parser.add_argument("--verbose", action="store_true")
    options = parser.parse_args()
    rides = {trip.name.split("-")[1]: trip for trip in ingest_each(options.data)}
    print(f"{'line':20s} {'left out':>10s} rides refused  fixes  away  median [m]  95 % [m]   held")
    for name, numbers in GROUPS.items():
        lines = {}
        for number in numbers:
            others = [rides[other] for other in numbers if other != number]
            lines[number] = line_of(geometry_of(others), "others")
        for stretch in (0.0, 60.0, 180.0):
            errors, bands, away, refused = [], [], 0, 0
            for number in numbers:
                try:
                    error, band, far = predictions(rides[number], lines[number], stretch)
                except TrainlogError as reason:
                    refused += 1
                    if options.verbose:
                        print(f"    {number}: {reason}")
                    continue
                if options.verbose and error.size:
                    print(
                        f"    {number}: {error.size} fixes,"
                        f" median {np.median(np.abs(error)):.0f} m,"
                        f" held {np.mean(np.abs(error) <= band):.0%}"
                    )
                errors.append(error)
                bands.append(band)
                away += far
            error, band = np.concatenate(errors), np.concatenate(bands)
            left = f"{stretch:.0f} s" if stretch else "single"
            print(
                f"{name:20s} {left:>10s} {len(errors):5d}"
                f" {refused:7d} {error.size:6d} {away:5d} {np.median(np.abs(error)):11.0f}"
                f" {np.quantile(np.abs(error), 0.95):9.0f} {np.mean(np.abs(error) <= band):6.1%}",
                flush=True,
            )


if __name__ == "__main__":
    main()
