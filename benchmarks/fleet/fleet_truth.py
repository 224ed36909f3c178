"""The truth of a simulated fleet: drawn anew from its `fleet.json`, and that of single trips."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pandas as pd

from trainlog import read_network
from trainlog.mcap import read_log
from trainlog.simulation import Fault, Fleet, draw_fleet
from trainlog.trip import SCENARIO_ATTACHMENT

PARAMETERS = ("r0", "r1", "r2")


def drawn_again(folder: Path) -> Fleet:
    """The fleet of a folder of `trainlog simulate fleet`.

    Raises
    ------
    ValueError
        If what is drawn now is not what the folder states.
    """
    known = json.loads((folder / "fleet.json").read_text())
    faults = [
        Fault(train["name"], fault["kind"], fault["size"], pd.Timestamp(fault["from"]).value)
        for train in known["trains"]
        for fault in train["faults"]
    ]
    fleet = draw_fleet(
        read_network(folder / "network.network.json"),
        len(known["trains"]),
        known["days"],
        known["trips"],
        known["seed"],
        faults,
        known["start"],
    )
    drawn = json.loads(json.dumps(fleet.truth()))
    if drawn != {name: known.get(name) for name in drawn}:
        raise ValueError(f"{folder / 'fleet.json'} is not what is drawn from its seed now")
    return fleet


def faults_of(fleet: Fleet) -> dict[str, Fault]:
    """The fault of each train that has one."""
    return {train.name: fault for train in fleet.trains for fault in train.faults}


def scenario_of(log: Path) -> dict[str, object]:
    """The truth that a log carries, which no analysis reads."""
    found = json.loads(read_log(log, topics=[]).attachments[SCENARIO_ATTACHMENT])
    assert isinstance(found, dict)
    return found


def curves_of(logs: pd.DataFrame, keep: Path | None) -> pd.DataFrame:
    """True r0, r1, r2 and mass of each trip, by key; kept in a file, so that logs are read once.

    Parameters
    ----------
    logs : DataFrame
        ``key`` and ``path``.
    keep : Path, optional
    """
    known = pd.DataFrame(columns=["key", *PARAMETERS, "mass"])
    if keep is not None and keep.exists():
        known = pd.read_parquet(keep)
    missing = logs[~logs["key"].isin(known["key"]) & logs["path"].notna()]
    rows = []
    for key, path in missing[["key", "path"]].itertuples(index=False):
        scenario = scenario_of(Path(path))
        rows.append({"key": key} | {name: scenario[name] for name in (*PARAMETERS, "mass")})
    if rows:
        known = pd.DataFrame(rows) if known.empty else pd.concat([known, pd.DataFrame(rows)])
        if keep is not None:
            keep.parent.mkdir(parents=True, exist_ok=True)
            known.to_parquet(keep)
    return known.set_index("key")


def check_rail(fleet: Fleet, logs: pd.DataFrame, count: int = 3) -> float:
    """Largest difference of the maximum adhesion of some trips drawn anew to that in their logs."""
    numbers = {fleet.name(number): number for number in range(fleet.trips)}
    chosen = logs[logs["path"].notna()].iloc[:: max(len(logs) // count, 1)]
    worst = 0.0
    for name, path in chosen[["name", "path"]].itertuples(index=False):
        stated = scenario_of(Path(path))["maximum_adhesion"]
        assert isinstance(stated, dict)
        drawn = fleet.scenario(numbers[name]).maximum_adhesion
        apart = np.abs(drawn(stated["positions"]) - np.array(stated["values"]))
        worst = max(worst, float(np.quantile(apart, 0.98)))
    return worst
