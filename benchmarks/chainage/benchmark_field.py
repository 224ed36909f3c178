"""Whether the bands of chainage and speed hold on receivers whose errors nothing assumes.

    python benchmarks/chainage/benchmark_field.py [--seeds 1] [--case NAME ...] [--rate S ...]

Kinematic trips of three trains (regional, freight, tram) on four lines: St.Gallen-Wil, a valley
line with a hairpin and a loop over itself, a tram's streets, and a path of OSRD's small
infrastructure (where that data set lies beside the checkout). Each case is one way in which a
receiver errs, each rate an interval between fixes. Errors are taken every second from the first to
the last row of the estimate, outages included. The last column is the share of the time at which
two such receivers on the same trip agree within both their bands.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests"))

from satellite_trips import PACES, Field, errors, paced, receive, streets, valley

from trainlog.errors import InputError
from trainlog.formats.railway import read_line
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.ingest.chainage import estimated_state
from trainlog.ingest.frozen import without_frozen
from trainlog.ingest.profile import Limits, Profile, Repair
from trainlog.ingest.receiver import judged_alone
from trainlog.ingest.recording import Table
from trainlog.ingest.rules import repaired
from trainlog.railway import Geometry, Line, Station, StepProfile
from trainlog.railway.geometry import to_plane

PROFILE = Profile(format="trainlog/recorder-profile", version=1, name="none")

CASES = {
    "clean": Field(memory=0.01, reflections=0.0, outages=0.0),
    "errors last 5 s": Field(memory=5.0),
    "errors last 60 s": Field(memory=60.0),
    "errors last 300 s": Field(memory=300.0),
    "accuracy x 0.2": Field(stated=0.2),
    "accuracy x 5": Field(stated=5.0),
    "phone, no speed": Field(noise=8.0, stated=0.0, speed="none"),
    "lasting speed errors": Field(speed="lasting", speed_stated=0.5),
    "speed 3 s late": Field(speed="late"),
    "replayed speeds": Field(noise=6.0, stated=0.5, speed="replayed", speed_stated=0.0),
    "frozen speeds": Field(speed="frozen"),
    "speed in knots as m/s": Field(speed="wrong unit"),
    "extrapolated fixes": Field(extrapolated=8.0),
    "extrapolated, no speed": Field(extrapolated=8.0, speed="none"),
    "phone, all of it": Field(
        noise=8.0, memory=60.0, stated=0.3, extrapolated=4.0, speed="replayed", speed_stated=0.0
    ),
    **{
        f"{places}{', no speed' if speed == 'none' else ''}": Field(places=places, speed=speed)
        for places in ("held", "replayed", "late", "jumping", "cold start")
        for speed in ("good", "none")
    },
    "phone, replayed": Field(
        noise=8.0, stated=0.5, speed="replayed", speed_stated=0.0, places="replayed"
    ),
}

RATES = (0.1, 0.2, 1.0, 11.0)

INFRASTRUCTURE = Path(__file__).parents[3] / "shared/data/osrd/infras/small_infra.json"

PATH = ("TA1", "TC3", "TD1", "TD3", "TH0", "TH1")


def osrd() -> Geometry | None:
    """A path over OSRD's small infrastructure, its chainage the length of its coordinates."""
    if not INFRASTRUCTURE.is_file():
        return None
    tracks = {one["id"]: one for one in json.loads(INFRASTRUCTURE.read_text())["track_sections"]}
    points = [point for name in PATH for point in tracks[name]["geo"]["coordinates"]]
    longitude, latitude = np.array(points).T
    plane = to_plane(latitude, longitude, (49.5, -0.25))
    steps = np.abs(np.diff(plane, prepend=plane[0]))
    kept = (steps > 1.0) | (np.arange(steps.size) == 0)
    return Geometry(np.cumsum(steps[kept]), latitude[kept], longitude[kept], "OSRD")


@dataclass(frozen=True, eq=False)
class Ride:
    """A line and a train on it."""

    name: str
    line: Line
    pace: str


@cache
def rides() -> tuple[Ride, ...]:
    found = [
        Ride("St.Gallen-Wil, regional", read_line(sample(DEFAULT_LINE)), "regional"),
        Ride("valley, freight", line_on(valley()), "freight"),
        Ride("streets, tram", line_on(streets()), "tram"),
    ]
    path = osrd()
    return (*found, *([Ride("OSRD, regional", line_on(path), "regional")] if path else []))


def line_on(geometry: Geometry) -> Line:
    length = float(geometry.positions[-1])
    return Line(
        "made up", length, (Station("A", 0.0), Station("B", length)),
        StepProfile(np.zeros(1), np.array([45.0])), StepProfile(np.zeros(1), np.zeros(1)),
        geometry=geometry,
    )  # fmt: skip


@dataclass
class Sums:
    """What was found in one case, over its trips."""

    position: list
    speed: list
    aside: list
    refused: list
    narrow: list
    agree: list
    spent: float = 0.0

    def line(self) -> str:
        """The case's line of the table."""
        if not self.position:
            return f"{'':>38s} all refused: {self.refused[0]}"
        error, std = (np.concatenate(x) for x in zip(*self.position, strict=True))
        fast, fast_std = (np.concatenate(x) for x in zip(*self.speed, strict=True))
        size = np.abs(error)
        agree = f"{np.mean(np.concatenate(self.agree)):6.1%}" if self.agree else "     -"
        return (
            f"{np.median(size):7.1f} {np.quantile(size, 0.95):7.0f} {size.max():7.0f}"
            f" {np.mean(size <= 1.96 * std):7.1%} {np.median(1.96 * std):7.1f}"
            f"   {np.median(np.abs(fast)):5.2f} {np.mean(np.abs(fast) <= 1.96 * fast_std):7.1%}"
            f" {np.median(1.96 * fast_std):6.2f}  {np.mean(self.aside):6.1%} {len(self.refused):4d}"
            f"  {len(self.narrow):3d}/{len(self.position)}   {agree}   {self.spent:5.1f}"
        )


def estimated(ride: Ride, run, field: Field, seed: int):
    trip, truth = receive(ride.line.geometry, run, field, seed)
    start = time.process_time()
    # As ingest does: values that freeze are no measurements.
    estimate = estimated_state(without_frozen(trip)[0], ride.line, PROFILE)
    return trip, truth, estimate, time.process_time() - start


def agreement(one, other) -> np.ndarray:
    """Where two estimates of a trip agree within both bands."""
    first, second = (e.frame.index.as_unit("ns").asi8 for e in (one, other))
    even = np.arange(max(first[0], second[0]), min(first[-1], second[-1]), 1_000_000_000)
    values = [
        np.interp((even - even[0]) / 1e9, (times - even[0]) / 1e9, estimate.frame[name])
        for estimate, times in ((one, first), (other, second))
        for name in ("position", "position_std")
    ]
    return np.abs(values[0] - values[2]) <= 1.96 * np.hypot(values[1], values[3])


def case(field: Field, seeds: int, verbose: bool) -> Sums:
    sums = Sums([], [], [], [], [], [])
    for ride in rides():
        for seed in range(1, seeds + 1):
            length = float(ride.line.geometry.positions[-1])
            run = paced(length, PACES[ride.pace], seed)
            found = []
            for receiver in (seed, 100 + seed):
                try:
                    trip, truth, estimate, spent = estimated(ride, run, field, receiver)
                except InputError as error:
                    sums.refused.append(str(error))
                    if verbose:
                        print(f"    {ride.name}: refused, {error}")
                    continue
                sums.spent += spent
                if estimate.frame is None:
                    sums.refused.append("no estimate")
                    continue
                found.append(estimate)
                position = errors(estimate.frame, truth, "position")
                speed = errors(estimate.frame, truth, "speed")
                sums.position.append(position)
                sums.speed.append(speed)
                count = sum(f.count for f in estimate.findings if f.column == "/gnss/fix")
                sums.aside.append(count / len(trip["/gnss/fix"]))
                held = [np.mean(np.abs(e) <= 1.96 * s) for e, s in (position, speed)]
                if min(held) < 0.9:
                    sums.narrow.append(ride.name)
                if verbose:
                    print(
                        f"    {ride.name} {receiver}: median {np.median(np.abs(position[0])):.1f}"
                        f" max {np.abs(position[0]).max():.0f} m, held {held[0]:.1%} {held[1]:.1%}"
                        f" band {np.median(position[1]):.1f} {np.median(speed[1]):.2f}"
                        f" {[(f.rule, f.column[6:], f.count, f.note) for f in estimate.findings]}"
                        f" {estimate.metadata}"
                    )
            if len(found) == 2:
                sums.agree.append(agreement(*found))
    return sums


SPEEDS = {
    **{
        f"{speed} speeds": Field(speed=speed)
        for speed in ("good", "late", "frozen", "stuck", "wild")
    },
    **{f"good speeds, {places} fixes": Field(places=places) for places in ("held", "replayed")},
    "stuck speeds, held fixes": Field(speed="stuck", places="held"),
}
"""Recorders without a line, whose speeds the rules of repair judge by the fixes."""


def kept_speeds(field: Field, seeds: int) -> str:
    """Which speeds the rules keep, where no line is known: those that are off, and good ones."""
    off, good, blanked, wrong, count = 0.0, 0.0, 0.0, 0.0, 0.0
    for ride in rides():
        for seed in range(1, seeds + 1):
            run = paced(float(ride.line.geometry.positions[-1]), PACES[ride.pace], seed)
            trip, truth = receive(ride.line.geometry, run, field, seed)
            frame = trip["/gnss/fix"].join(trip["/gnss/motion"])
            time = frame.index.as_unit("ns").asi8
            signals = {
                f"/gnss/{'motion' if name == 'speed' else 'fix'}.{name}": frame[name].to_numpy()
                for name in ("latitude", "longitude", "horizontal_accuracy", "speed")
            }
            table = Table(time, np.arange(time.size), signals)
            kept = judged_alone(repaired(table, Limits(), Repair())[0])[0]
            speed = np.full(time.size, np.nan)
            speed[kept.samples] = kept.signals["/gnss/motion.speed"]
            seconds = (truth.index.as_unit("ns").asi8 - time[0]) / 1e9
            error = np.abs(
                signals["/gnss/motion.speed"]
                - np.interp((time - time[0]) / 1e9, seconds, truth["speed"])
            )
            used = np.isfinite(speed)
            off += np.count_nonzero(used & (error > 2.0))
            wrong += np.count_nonzero(used & (error > 10.0))
            count += np.count_nonzero(used)
            good += np.count_nonzero(error < 1.0)
            blanked += np.count_nonzero(~used & (error < 1.0))
    shares = (100.0 * off / count, 100.0 * wrong / count, 100.0 * blanked / good)
    return "  ".join(f"{share:8.2f}" for share in shares)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--case", nargs="*", default=list(CASES))
    parser.add_argument("--rate", type=float, nargs="*", default=RATES)
    parser.add_argument("--verbose", action="store_true")
    parser.add_argument("--speeds", action="store_true", help="kept without a line, instead")
    options = parser.parse_args()
    if options.speeds:
        print(f"{'case':28s} {'every':>6s}  > 2 m/s  > 10 m/s  good, blanked [%]")
        for name, field in SPEEDS.items():
            for interval in options.rate:
                shares = kept_speeds(replace(field, interval=interval), options.seeds)
                print(f"{name:28s} {interval:6.1f}  {shares}", flush=True)
        return
    print(
        f"{'':24s} {'every':>6s}  position [m]                              speed [m/s]"
        f"\n{'case':24s} {'[s]':>6s}  median    95 %     max    held    band"
        f"   median    held   band   aside refused <90 %   agree     CPU"
    )
    for name in options.case:
        for interval in options.rate:
            sums = case(replace(CASES[name], interval=interval), options.seeds, options.verbose)
            print(f"{name:24s} {interval:6.1f} {sums.line()}", flush=True)


if __name__ == "__main__":
    main()
