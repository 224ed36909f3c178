"""What becomes of map and running resistance where an assumption does not hold.

    python benchmarks/map/broken_assumptions.py [--only "dry as wet" ...] [--trips 12] [--seed 5]

Trips of three trains over three lines run on a rail of another creep curve than the estimators
assume, with other axle loads and another slip protection (`defects.py`). One assumption is broken a
row. Of maps: bins with onsets, the mean of the logarithm of the estimate over the truth ("bias",
above 0 the map states more than there is), its root mean square, and the share of the truth in the
95 % band, of all bins, of those of one trip and of those of three trips or more. Of fits: the
relative error of the curve at 80 km/h and the band stated for it. "said" counts what is stated of
it: trips set aside, notes, refusals.
"""

from __future__ import annotations

import argparse
import hashlib
import pickle
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from defects import AXLES, LIBRARY, STATE, OtherRail, with_frame
from trips import _code as code_of_trips

from analysis.adhesion.condition_map import adhesion_map
from analysis.resistance.fit import TripFit, fit_trip
from analysis.resistance.regression import diagnosed
from trainlog.errors import TrainlogError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.ttobench import read_track, read_train as read_foreign_train
from trainlog.railway import Line, RunningResistance, StepProfile, Train
from trainlog.simulation import Scenario, draw_scenarios, simulate
from trainlog.simulation.rail import base_map, bin_centres, spot
from trainlog.trip import Trip
from trainlog.units import KMH

HOUR = pd.Timedelta("1h")
DAY = pd.Timedelta("1D")
BIN = 25.0


def railways(library: Path, heaviest: str = "CH_Stadler_FLIRT_TPF") -> list[tuple[Line, Train]]:
    """A line and a train each; the sample's alone where the library is not there."""
    found = [(read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN)))]
    if library.is_dir():
        tracks, trains = library / "tracks", library / "trains"
        found += [
            (
                read_track(tracks / "CH_Stadelhofen_Altstetten.json"),
                read_foreign_train(trains / "CH_Stadler_KISS_SBB.json"),
            ),
            (
                read_track(tracks / "00_reference.json"),
                read_foreign_train(trains / f"{heaviest}.json"),
            ),
        ]
    return found


def other_rail(scenario: Scenario, number: int, **changes: Any) -> OtherRail:
    """The scenario on another creep curve, on a day of its own, driven to the limit."""
    known = {name: getattr(scenario, name) for name in Scenario.__dataclass_fields__}
    known["habits"] = replace(scenario.habits, lever=1.0, deceleration=0.65)
    known["start"] = scenario.start + number * DAY.value
    known["name"] = f"{scenario.weather}-{number:02d}"
    return OtherRail(**{**known, **changes})


# ---------------------------------------------------------------------------------------- maps


@dataclass(frozen=True)
class Case:
    """Trips of one line, what the map is given of them, and the truth.

    Attributes
    ----------
    scenarios : list of OtherRail
    spoil : callable
        Of a recorded trip and its number, what the map is given.
    truth : callable
        Of the bins' centres and the layer or direction, the lasting maximum adhesion.
    """

    scenarios: list[OtherRail]
    truth: Callable[[np.ndarray, str], np.ndarray]
    spoil: Callable[[Trip, int], Trip] = field(default=lambda trip, _: trip)


def lasting(line: Line, weather: str, seed: int) -> StepProfile:
    """What every trip in that weather meets, without its own spots."""
    base = base_map(line, weather, seed)
    return StepProfile(bin_centres(base.size) - 0.5 * BIN, base)


def wet(line: Line, train: Train, count: int, seed: int) -> list[OtherRail]:
    """So many wet trips in both directions."""
    drawn = [s for s in draw_scenarios(line, train, 2 * count + 2, seed) if s.weather == "wet"]
    return [other_rail(each, number) for number, each in enumerate(drawn[:count])]


def scaled(scenario: OtherRail, factor: float) -> OtherRail:
    profile = scenario.maximum_adhesion
    return replace(
        scenario, maximum_adhesion=StepProfile(profile.positions, profile.values * factor)
    )


def clean(line: Line, train: Train, count: int, seed: int) -> Case:
    base = lasting(line, "wet", seed)
    return Case(wet(line, train, count, seed), lambda centres, _: base(centres))


def double_line(line: Line, train: Train, count: int, seed: int) -> Case:
    """Reverse trips run on another track whose rail holds 30 % less."""
    base = lasting(line, "wet", seed)
    ways = {"forward": 1.0, "reverse": 0.7}
    trips = [scaled(each, ways[each.direction]) for each in wet(line, train, count, seed)]
    return Case(trips, lambda centres, way: base(centres) * ways.get(way, 1.0))


def dry_as_wet(line: Line, train: Train, count: int, seed: int) -> Case:
    """Among the wet trips 5 ran in the dry; all are labelled wet."""
    trips = wet(line, train, count - 3, seed)
    drawn = [s for s in draw_scenarios(line, train, 12, seed) if s.weather == "dry"][:5]
    trips += [other_rail(each, number) for number, each in enumerate(drawn)]
    base = lasting(line, "wet", seed)
    return Case(
        trips,
        lambda centres, _: base(centres),
        lambda trip, _: replace(trip, metadata={**trip.metadata, "weather": "wet"}),
    )


def held_values(trip: Trip, number: int) -> Trip:
    """A wheel's speed, or all efforts of an axle, rest for a minute, three times."""
    generator = np.random.default_rng([3, number])

    def stuck(frame: pd.DataFrame) -> pd.DataFrame:
        speeds = [name for name in frame if name.startswith("wheel_speed_")]
        efforts = [name for name in frame if "effort" in name]
        moving = np.flatnonzero(np.median(frame[speeds], axis=1) > 8.0)
        clock = frame.index.asi8
        for turn in range(3):
            first = int(generator.choice(moving[: -moving.size // 10]))
            rows = np.flatnonzero((clock >= clock[first]) & (clock < clock[first] + 60_000_000_000))
            column = (speeds, efforts)[(turn + number) % 2][int(generator.integers(len(speeds)))]
            frame.loc[frame.index[rows], column] = frame[column].iloc[first]
        return frame

    return with_frame(trip, AXLES, stuck)


def stuck_values(line: Line, train: Train, count: int, seed: int) -> Case:
    return replace(clean(line, train, count, seed), spoil=held_values)


def moved_clock(trip: Trip, shift: pd.Timedelta) -> Trip:
    """The trip with all times later."""
    topics = {}
    for name, frame in trip.topics.items():
        later = frame.set_axis(frame.index + shift)
        later.attrs = frame.attrs
        topics[name] = later
    return replace(trip, topics=topics)


def wrong_dates(
    line: Line, train: Train, count: int, seed: int, shift: pd.Timedelta = 9 * HOUR
) -> Case:
    """Half of the trips are dated wrong."""
    return replace(
        clean(line, train, count, seed),
        spoil=lambda trip, number: moved_clock(trip, shift) if number % 4 > 1 else trip,
    )


def placed(trip: Trip, number: int, away: float = 60.0) -> Trip:
    """Every second trip is placed so far off [m], in the line's own direction."""
    if number % 4 not in (0, 3):
        return trip
    step = away if trip.metadata.get("direction") != "reverse" else -away
    for topic in (STATE, "/estimates/state"):
        if topic in trip:
            trip = with_frame(
                trip, topic, lambda frame: frame.assign(position=frame["position"] + step)
            )
    return trip


def misplaced(line: Line, train: Train, count: int, seed: int) -> Case:
    return replace(clean(line, train, count, seed), spoil=placed)


def creeping(line: Line, train: Train, count: int, seed: int) -> Case:
    """Slippery places creep by 15 m a trip; what holds is what the middle trip meets."""
    generator = np.random.default_rng([seed, 77])
    trips = wet(line, train, count, seed)
    centres = bin_centres(base_map(line, "wet", seed).size)
    starts = np.arange(400.0, line.length - 800.0, 900.0) + generator.uniform(0.0, 200.0)
    depths = generator.uniform(0.08, 0.13, starts.size)

    def rail(number: float, own: np.ndarray | None = None) -> np.ndarray:
        logarithm = np.full(centres.size, np.log(0.175)) if own is None else own
        for start, depth in zip(starts + 15.0 * number, depths, strict=True):
            logarithm = np.minimum(logarithm, spot(centres, start, 200.0, depth))
        return np.exp(logarithm)

    moved = []
    for number, each in enumerate(trips):
        noise = 0.03 * generator.standard_normal(centres.size // 8 + 1)
        own = np.log(0.175) + np.interp(np.arange(centres.size) / 8.0, np.arange(noise.size), noise)
        profile = StepProfile(centres - 0.5 * BIN, rail(number, own))
        moved.append(replace(each, maximum_adhesion=profile))
    middle = StepProfile(centres - 0.5 * BIN, rail(0.5 * (len(trips) - 1)))
    return Case(moved, lambda places, _: middle(places))


def heavy_tailed(line: Line, train: Train, count: int, seed: int) -> Case:
    """All that a trip meets is better or worse by a factor: Student's t with 2 degrees, 0.08."""
    generator = np.random.default_rng([seed, 78])
    factors = np.exp(0.08 * generator.standard_t(2.0, count)).clip(0.5, 1.6)
    trips = [scaled(e, f) for e, f in zip(wet(line, train, count, seed), factors, strict=True)]
    base = lasting(line, "wet", seed)
    return Case(trips, lambda centres, _: base(centres))


MAPS: dict[str, Callable[..., Case]] = {
    "clean": clean,
    "other track 30 % lower": double_line,
    "dry as wet": dry_as_wet,
    "values stuck for a minute": stuck_values,
    "half dated 9 h wrong": wrong_dates,
    "half dated 26 years wrong": partial(wrong_dates, shift=-26 * 365 * DAY),
    "every second trip 60 m off": misplaced,
    "spots creep 15 m a trip": creeping,
    "heavy-tailed factor": heavy_tailed,
}


def simulated(scenario: OtherRail, cache: Path | None) -> Trip:
    """The recorded trip, kept by all that it depends on."""
    if cache is None:
        return stated(scenario)
    key = hashlib.sha256(code_of_trips() + scenario.truth() + scenario.files()[0])
    key.update(str((scenario.start, scenario.habits)).encode() + scenario.files()[1])
    kept = cache / f"{key.hexdigest()[:32]}.trip"
    if not kept.exists():
        cache.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps(stated(scenario)))
    found: Trip = pickle.loads(kept.read_bytes())
    return found


def stated(scenario: OtherRail) -> Trip:
    trip = simulate(scenario)
    return replace(trip, metadata={**trip.metadata, "load": f"{scenario.load:.0f}"})


def map_row(name: str, options: argparse.Namespace) -> str:
    """Errors of one row, over the lines."""
    error, std, trips, said = [], [], [], []
    extra = ""
    for line, train in railways(options.library):
        case = MAPS[name](line, train, options.trips, options.seed)
        given = [
            case.spoil(simulated(each, options.cache), number)
            for number, each in enumerate(case.scenarios)
        ]
        try:
            found = adhesion_map(given)
        except TrainlogError as refused:
            said.append(f"refused: {refused}")
            continue
        track = found.track
        said += [*found.notes, *found.skipped]
        for layer_name, layer in track.layers.items():
            if not (layer.events > 0).any():
                continue
            seen = layer.events > 0
            way = layer_name.rpartition(" ")[2]
            true = case.truth(track.centres, way)
            ways = getattr(layer, "ways", None)
            both = [(way, layer)] if not ways else list(ways.items())
            for way, each in both:
                seen = each.events > 0
                true = case.truth(track.centres, way)
                error += [(each.log_mean - np.log(true))[seen]]
                std += [each.log_std[seen]]
                trips += [each.evidence.by_bin("trips")[seen]]
        days = track.days
        extra = f"  {days[-1] - days[0] + 1} days" if days.size else ""
    if not error:
        return f"{name:28s} refused\n" + "\n".join(f"    {each[:200]}" for each in said)
    e, s, n = (np.concatenate(each) for each in (error, std, trips))
    inside = np.abs(e) < 1.96 * s

    def share(rows: np.ndarray) -> str:
        return f"{inside[rows].mean():5.2f}" if rows.any() else "    -"

    unsafe = np.mean(e > 1.96 * s)
    return (
        f"{name:28s}{e.size:5d}{e.mean():+8.3f}{np.sqrt(np.mean(e**2)):7.3f}"
        f"  {share(n > 0)} {share(n == 1)} {share(n >= 3)}  {unsafe:5.3f}{extra}"
        + "".join(f"\n    {each[:160]}" for each in dict.fromkeys(said))
    )


# ---------------------------------------------------------------------------------------- fits


@dataclass(frozen=True)
class Fitted:
    """A fit or why there is none, and the truth."""

    fit: TripFit | None
    true: RunningResistance
    refused: str = ""


def straight(line: Line, train: Train, count: int, seed: int) -> Iterator[OtherRail]:
    """Dry trips on a line whose gradients are known."""
    drawn = [s for s in draw_scenarios(line, train, 2 * count + 2, seed) if s.weather == "dry"]
    for number, each in enumerate(drawn[:count]):
        known = {name: getattr(each, name) for name in Scenario.__dataclass_fields__}
        yield OtherRail(**{**known, "name": f"fit-{number}", "steeper": 1.0})


def slope(scenario: OtherRail, start: float, end: float, value: float) -> OtherRail:
    """The true gradient is steeper by `value` from one place to another."""
    before = scenario.survey_error
    assert before is not None
    places = np.union1d(before.positions, [start, end])
    values = before(places) + value * ((places >= start) & (places < end))
    return replace(scenario, survey_error=StepProfile(places, values))


def unbroken(scenario: OtherRail) -> OtherRail:
    return scenario


def dragging(scenario: OtherRail) -> OtherRail:
    """A brake drags in the second half of the way: 60 % of the running resistance at 80 km/h."""
    force = 0.6 * float(scenario.resistance(80.0 / KMH))
    half, end = 0.5 * scenario.line.length, scenario.line.length
    forward = scenario.direction == "forward"
    place = (half, end) if forward else (0.0, half)
    sign = 1.0 if forward else -1.0
    return slope(scenario, *place, sign * force / (9.81 * scenario.mass))


def head_wind(scenario: OtherRail, wind: float = 8.0) -> OtherRail:
    """Of 8 m/s, not recorded: r2 (v + w)² for r2 v²."""
    still = scenario.resistance
    blown = RunningResistance(
        still.r0 + still.r2 * wind**2, still.r1 + 2.0 * still.r2 * wind, still.r2
    )
    return replace(scenario, resistance=blown)


def wrong_gradient(scenario: OtherRail) -> OtherRail:
    """By 2 per mille over 3 km."""
    start = 0.4 * scenario.line.length
    return slope(scenario, start, min(start + 3000.0, scenario.line.length), 2e-3)


FITS: dict[str, Callable[[OtherRail], OtherRail]] = {
    "fits, clean": unbroken,
    "a brake drags, half the way": dragging,
    "head wind 8 m/s": head_wind,
    "gradient 2 per mille, 3 km": wrong_gradient,
}


def without_wind(trip: Trip) -> Trip:
    """Without the anemometer."""
    topics = {name: frame for name, frame in trip.topics.items() if name != "/environment"}
    return replace(trip, topics=topics)


def fit_row(name: str, options: argparse.Namespace) -> str:
    at = 80.0 / KMH
    rows, refused, said = [], [], []
    for line, train in railways(options.library, "NL_Intercity_VIRM6"):
        for number, each in enumerate(straight(line, train, options.fits, options.seed)):
            still = each.resistance
            trip = without_wind(simulated(FITS[name](each), options.cache))
            try:
                fit = fit_trip(trip)
            except TrainlogError as error:
                refused.append(str(error))
                continue
            low, high = (float(end) for end in fit.still_air(at))
            true, value = float(still(at)), float(fit.resistance(at))
            rows.append((value / true - 1.0, 0.5 * (high - low) / true, low < true < high))
            doubts = (*fit.notes, *diagnosed(fit.residuals).doubts)
            said += [f"{train.name}, {number}: {words}" for words in doubts]
    found = np.array(rows, dtype=float).reshape(-1, 3)
    text = f"{name:28s}{len(rows):3d} fits {len(refused):2d} refused"
    if len(rows):
        text += (
            f"   off {100 * np.mean(found[:, 0]):+6.1f} % (worst"
            f" {100 * found[np.argmax(np.abs(found[:, 0])), 0]:+.1f} %)   stated"
            f" +- {100 * np.median(found[:, 1]):.1f} %   in band {np.mean(found[:, 2]):.2f}"
        )
    lines = [f"\n    refused: {each[:200]}" for each in dict.fromkeys(refused)]
    return text + "".join(lines) + "".join(f"\n    {each[:200]}" for each in said)


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--only", nargs="+", choices=[*MAPS, *FITS], default=[*MAPS, *FITS])
    parser.add_argument("--trips", type=int, default=12, help="of each line, for a map")
    parser.add_argument("--fits", type=int, default=2, help="trips of each line, for fits")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--library", type=Path, default=LIBRARY)
    parser.add_argument("--cache", type=Path, help="folder for simulated trips")
    options = parser.parse_args()
    print(f"{'':28s} bins    bias    rms    all   one    3+  unsafe", flush=True)
    for name in options.only:
        begun = time.perf_counter()
        row = map_row(name, options) if name in MAPS else fit_row(name, options)
        print(f"{row}\n    {time.perf_counter() - begun:.0f} s", flush=True)


if __name__ == "__main__":
    main()
