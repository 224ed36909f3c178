"""Load transfer between the axles: what it does to adhesion and map, known and not known.

    python benchmarks/map/load_transfer.py [--trips 3] [--seed 5] [--high]

Trips of three trains over three lines, wet and dry, driven by a plant whose axle loads change with
effort and gradient (two powered bogies a vehicle; with ``--high`` the bodies are pulled at 0.9 m
instead of 0.5 m), on a rail, with a drive and static axle loads that no analysis assumes. The same
logs are analysed with a train file that does not state the geometry of the axles, and with one that
states it, each length 5 to 10 % wrong. Printed are the errors of the adhesion at single onsets over
the truth there, of all axles and of the first of each bogie; how many lie within 1.96 standard
deviations, without and with that of an unknown load transfer; and of the map, in the bins with
onsets, root mean square error and the share in the 95 % band.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path

import numpy as np
from defects import LIBRARY, OtherRail, driven

from analysis.adhesion.condition_map import adhesion_map
from analysis.adhesion.slip import slip
from analysis.truth import true_adhesion, truth_of
from trainlog.formats.railway import read_line, train_to_bytes
from trainlog.formats.samples import sample
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway import Train
from trainlog.railway.train import AxleGeometry
from trainlog.simulation import draw_scenarios
from trainlog.trip import TRAIN_ATTACHMENT, Trip

LOW = AxleGeometry(2.6, 9.5, 0.5, 1.0, 1.6)
STATED = AxleGeometry(2.75, 9.0, 0.53, 1.04, 1.5)


def scenarios(library: Path, trips: int, seed: int, geometry: AxleGeometry) -> list[OtherRail]:
    pairs = [
        ("tracks/CH_StGallen_Wil.json", "trains/CH_Stadler_FLIRT_TPF.json"),
        (None, "trains/CH_Stadler_KISS_SBB.json"),
        ("tracks/00_reference.json", "trains/NL_Intercity_VIRM6.json"),
    ]
    found = []
    for number, (track, file) in enumerate(pairs):
        line = (
            read_line(sample("DE_Chemnitz_Cranzahl.line.json"))
            if track is None
            else read_track(library / track)
        )
        train = whole_vehicles(read_train(library / file), geometry)
        drawn = draw_scenarios(line, train, 4 * trips, seed=seed + number)
        for weather in ("wet", "dry"):
            for each in [s for s in drawn if s.weather == weather][:trips]:
                known = {name: getattr(each, name) for name in each.__dataclass_fields__}
                known |= {"name": f"{train.name}-{each.name}"}
                known["habits"] = replace(each.habits, lever=1.0, deceleration=0.65)
                found.append(OtherRail(**known))
    return found


def whole_vehicles(train: Train, geometry: AxleGeometry) -> Train:
    """The train with its powered axles in vehicles of four."""
    own = train.axles
    count = 4 * -(-own.count // 4)
    rotating = own.rotating_mass * own.count / count
    return replace(
        train, axles=replace(own, count=count, rotating_mass=rotating, geometry=geometry)
    )


def analysed(trip: Trip, geometry: AxleGeometry | None, scenario: OtherRail) -> Trip:
    train = scenario.train
    file = replace(train, axles=replace(train.axles, geometry=geometry))
    return replace(trip, attachments={**trip.attachments, TRAIN_ATTACHMENT: train_to_bytes(file)})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--library", type=Path, default=LIBRARY)
    parser.add_argument("--trips", type=int, default=3, help="of each line and weather")
    parser.add_argument("--seed", type=int, default=5)
    parser.add_argument("--high", action="store_true", help="bodies pulled at 0.9 m")
    options = parser.parse_args()
    true, stated = LOW, STATED
    if options.high:
        true, stated = replace(LOW, link_height=0.9), replace(STATED, link_height=0.96)
    every = scenarios(options.library, options.trips, options.seed, true)
    trips = [(scenario, driven(scenario).trip) for scenario in every]
    print("geometry    weather  onsets  off mean  off RMS  first of bogie  in 1.96  with transfer")
    for name, geometry in (("not known", None), ("stated", stated)):
        for weather in ("wet", "dry"):
            rows = [onsets(analysed(trip, geometry, s), s) for s, trip in trips
                    if s.weather == weather]  # fmt: skip
            off, std, wide, first = np.concatenate(rows).T
            print(
                f"{name:10s}  {weather:7s}  {off.size:6d}  {off.mean():+8.3f}"
                f"  {np.sqrt(np.mean(off**2)):7.3f}  {off[first > 0].mean():+14.3f}"
                f"  {np.mean(np.abs(off) < 1.96 * std):7.3f}"
                f"  {np.mean(np.abs(off) < 1.96 * wide):13.3f}"
            )
    print("\ngeometry    weather  bins     RMSE  off mean  in 95 % band")
    for name, geometry in (("not known", None), ("stated", stated)):
        errors = {"wet": [], "dry": []}
        for line in dict.fromkeys(s.line.name for s in every):
            part = [(s, analysed(t, geometry, s)) for s, t in trips if s.line.name == line]
            track = adhesion_map([trip for _, trip in part]).track
            truths = [truth_of(trip) for _, trip in part]
            for weather, layer in track.layers.items():
                seen = layer.events > 0
                truth = true_adhesion(track, weather, truths)[seen]
                log_error = layer.log_mean[seen] - np.log(truth)
                score = log_error / layer.log_std[seen]
                off = layer.maximum_adhesion[seen] - truth
                errors[weather].append(np.column_stack([off, log_error, score]))
        for weather, found in errors.items():
            off, log_error, score = np.concatenate(found).T
            print(
                f"{name:10s}  {weather:7s}  {off.size:4d}  {np.sqrt(np.mean(off**2)):7.4f}"
                f"  {log_error.mean():+8.3f}  {np.mean(np.abs(score) < 1.96):12.3f}"
            )


def onsets(trip: Trip, scenario: OtherRail) -> np.ndarray:
    """Relative error, its deviations and whether the axle is the first of its bogie, (n, 4)."""
    events = slip(trip).events
    events = events[events["measured"]]
    truth = scenario.maximum_adhesion(events["position"].to_numpy())
    static = (events["adhesion_std"] / events["adhesion"]).to_numpy()
    moved = (events["transfer_std"] / events["adhesion"]).to_numpy()
    first = (events["axle"].to_numpy() % 2) * 1.0
    off = events["adhesion"].to_numpy() / truth - 1.0
    return np.column_stack([off, static, np.hypot(static, moved), first])


if __name__ == "__main__":
    main()
