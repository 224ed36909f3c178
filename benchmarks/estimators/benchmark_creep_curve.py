"""Where the unscented filter of the creep curve wins over the observer, and where it does not.

    python benchmarks/estimators/benchmark_creep_curve.py [--trips 6] [--seed 3]

Wet trips of a unit over the sample line, with the adhesion characteristic of the simulator, with
Polach's of wet and of dry rail and with Ishikawa and Kawamura's over creepage, all with the same
maximum adhesion along the line. At each slip event that measured the maximum:

maximum   at the onset: plateau of the observer's adhesion before the largest slip, beside the
          maximum of the unscented filter, and both as `SlipAnalysis.creep_curves` joins them; error
          over the truth, share in 95 %
slope     of the characteristic at the largest slip [s/m]: the observer's adhesion regressed on the
          slip speed over half a second, beside the filter's
in use    adhesion at every sample of the slip: the observer's, beside the filter's curve at the
          slip speed of the sample

Also printed: processor time of each for an event.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace

import numpy as np

from analysis.adhesion.slip import (
    CURVE_AFTER,
    CURVE_BEFORE,
    CURVE_SPEED_STD,
    adhesion_noise,
    slip,
    wheel_noise,
)
from estimators import creep_curve
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.railway.adhesion import CreepCurve, polach_curve
from trainlog.simulation import Scenario, draw_scenarios, drive, recorded
from trainlog.simulation.plant import Plant
from trainlog.trip import seconds

CHARACTERISTICS = {
    "Zhao": None,
    "Polach wet": polach_curve("wet"),
    "Polach dry": polach_curve("dry"),
    "Ishikawa-Kawamura": CreepCurve(2.46, 203.0, 0.325, 0.325, "creepage"),
}


@dataclass
class Errors:
    """Relative errors (maximum, in use) or errors [s/m] (slope), by method, with deviations."""

    rows: dict[tuple[str, str], list[tuple[float, float]]] = field(default_factory=dict)

    def add(self, what: str, method: str, error: float, std: float = np.nan) -> None:
        """Count one error that is known."""
        if np.isfinite(error):
            self.rows.setdefault((what, method), []).append((error, std))

    def line(self, what: str, method: str) -> str:
        """The errors of one method, in words."""
        found = np.array(self.rows[what, method])
        error, std = found.T
        known = np.isfinite(std)
        share = np.mean(np.abs(error[known]) < 1.96 * std[known]) if known.any() else np.nan
        return (
            f"{what:8s} {method:9s} {len(error):6d}  RMS {np.sqrt(np.mean(error**2)):7.4f}"
            f"  median size {np.median(np.abs(error)):7.4f}  mean {error.mean():+8.4f}"
            f"  in 95 % {share:6.3f}"
        )


def row_at(plant: Plant, position: float):
    """Row of the rail's table at a position in the direction of travel."""
    return plant.rail[max(np.searchsorted(plant.rail[:, 0], position, side="right") - 1, 0)]


def truth_at(
    scenario: Scenario, plant: Plant, position: float, slip_speed: float, speed: float, axle: int
):
    """Adhesion and its slope [s/m] of the plant at a slip of one axle, both not negative."""
    row = row_at(plant, position)
    relative = plant.weights[axle] / plant.parameters.axle_weight
    if scenario.characteristic is None:
        curve = CreepCurve(row[2], row[3], row[4], row[4])
        scale = relative
    else:
        curve = scenario.characteristic
        scale = relative * row[1] / float(curve.maximum(speed))
    return scale * float(curve(slip_speed, speed)), scale * float(curve.slope(slip_speed, speed))


def one_trip(scenario: Scenario, errors: Errors, spent: list[float]) -> None:
    run = drive(scenario)
    trip = recorded(scenario, run)
    trip = replace(trip, metadata={**trip.metadata, "load": f"{scenario.load:.0f}"})
    found = slip(trip)
    plant = scenario.plant()
    speed = run.samples[:, plant.columns.index("speed")]
    wheels = run.samples[:, [i for i, n in enumerate(plant.columns) if "wheel_speed_" in n]]
    true_slip, place = np.abs(wheels - speed[:, None]), run.samples[:, 0]
    noise = adhesion_noise(seconds(trip["/train/axles"]), found.adhesion)
    slip_std = float(np.hypot(wheel_noise(found.slip_speed), CURVE_SPEED_STD))
    clock = run.seconds
    both = found.events.join(found.creep_curves())
    for event in both[both["measured"]].to_dict("records"):
        axle, sign = event["axle"] - 1, np.sign(event["peak_slip"])
        onset, peak, release = (
            int(found.time.get_loc(event[name])) for name in ("onset", "peak", "release")
        )
        start = int(found.time.get_loc(event["start"]))
        first = int(np.searchsorted(clock, clock[start] - CURVE_BEFORE))
        last = min(release, int(np.searchsorted(clock, clock[peak] + CURVE_AFTER)))
        part = slice(first, last)
        own, used = sign * found.slip_speed[part, axle], sign * found.adhesion[part, axle]
        began = time.process_time()
        curve = creep_curve.estimate_creep_curve(clock[part], own, used, noise, slip_std)
        spent.append(time.process_time() - began)
        relative = plant.weights[axle] / plant.parameters.axle_weight
        top = relative * row_at(plant, place[onset])[1]
        errors.add(
            "maximum", "observer", event["adhesion"] / top - 1.0, event["adhesion_std"] / top
        )
        known = np.flatnonzero(np.isfinite(curve.maximum))
        if not known.size:
            continue
        at = known[np.argmin(np.abs(known - (onset - first)))]
        maximum, std = curve.maximum[at], curve.maximum_std[at]
        errors.add("maximum", "unscented", maximum / top - 1.0, std / top)
        errors.add("maximum", "both", event["maximum"] / top - 1.0, event["maximum_std"] / top)
        place_at = known[np.argmax(own[known])]
        _, slope = truth_at(
            scenario, plant, place[first + place_at], true_slip[first + place_at, axle],
            speed[first + place_at], axle,
        )  # fmt: skip
        errors.add("slope", "unscented", curve.slope[place_at] - slope, curve.slope_std[place_at])
        near = slice(max(place_at - 2, 0), place_at + 3)
        spread = own[near] - own[near].mean()
        errors.add("slope", "observer", spread @ used[near] / (spread @ spread) - slope)
        for k in known[known >= start - first]:
            true, _ = truth_at(
                scenario,
                plant,
                place[first + k],
                true_slip[first + k, axle],
                speed[first + k],
                axle,
            )
            errors.add("in use", "observer", used[k] / true - 1.0)
            errors.add("in use", "unscented", curve.adhesion[k] / true - 1.0)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--trips", type=int, default=6)
    parser.add_argument("--seed", type=int, default=3)
    options = parser.parse_args()
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    drawn = draw_scenarios(line, train, 4 * options.trips, seed=options.seed)
    wet = [each for each in drawn if each.weather == "wet"][: options.trips]
    for name, characteristic in CHARACTERISTICS.items():
        errors, spent = Errors(), list[float]()
        for scenario in wet:
            one_trip(replace(scenario, characteristic=characteristic), errors, spent)
        print(f"{name}: {1e3 * np.mean(spent):.1f} ms an event")
        for what, method in errors.rows:
            print(f"  {errors.line(what, method)}", flush=True)


if __name__ == "__main__":
    main()
