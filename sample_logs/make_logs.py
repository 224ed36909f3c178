"""Make the sample logs and the sample map from the sample line and train.

    python sample_logs/make_logs.py -o sample_logs

Everything is simulated: the scenarios are those of ``trainlog simulate drive --seed 1``.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from foreign_recorders import write_recorder_csv, write_ublox_csv

from analysis.adhesion.condition_map import adhesion_map
from trainlog.formats.mapfile import write_map
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import write_log
from trainlog.simulation import draw_scenarios, simulate

LOGS = {"trip-01": "nonstop.mcap", "trip-03": "stopping.mcap"}
"""Logs: a dry trip from St.Gallen to Wil without a stop, and a wet one that calls everywhere."""

RECORDED = "trip-05"
"""The dry stopping trip of which only a vehicle's recorder and a satellite receiver are left."""

MAPPED = ("trip-01", "trip-03", "trip-05", "trip-07", "trip-09", "trip-11")
"""Trips that the map was rebuilt from."""


def make(output: Path) -> None:
    """Write the samples to the folder `output`."""
    output.mkdir(parents=True, exist_ok=True)
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    logs = []
    for scenario in draw_scenarios(line, train, count=12, seed=1):
        if scenario.name not in MAPPED:
            continue
        trip = simulate(scenario)
        log = output / LOGS.get(scenario.name, f"{scenario.name}.mcap")
        write_log(trip, log)
        logs.append(log)
        if scenario.name == RECORDED:
            write_recorder_csv(trip, output / "recorder.csv")
            write_ublox_csv(trip, output / "gnss.csv")
    track = adhesion_map(logs).track
    write_map(track, output / "CH_StGallen_Wil.map")
    for log in logs:
        if log.name not in LOGS.values():
            log.unlink()


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    make(parser.parse_args().output)
