"""A fleet's logs on disk: trips in parallel processes; what is there already is not made again."""

from __future__ import annotations

import json
import os
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

from trainlog.errors import InfeasibleError, InputError
from trainlog.formats.csv_tables import write_weather
from trainlog.formats.files import made_folder, read_bytes, write_bytes
from trainlog.formats.railway import write_network, write_train
from trainlog.mcap import write_log
from trainlog.processes import in_processes
from trainlog.progress import task
from trainlog.simulation.fleet import Fleet, as_recorded
from trainlog.simulation.recording import drive, recorded
from trainlog.version import __version__, code_version_of

TRUTH_FILE = "fleet.json"
"""What the fleet truly is; no analysis reads it."""

NETWORK_FILE = "network.network.json"

BATCH = 10
"""Trips that a process is given at once."""


class Made(NamedTuple):
    """What became of one trip.

    Attributes
    ----------
    number : int
    name : str
    duration, distance : float [s], [m]
    size : int [B]
    reason : str
        Why there is no log; empty: there is.
    """

    number: int
    name: str
    duration: float = 0.0
    distance: float = 0.0
    size: int = 0
    reason: str = ""


@dataclass
class FleetLogs:
    """What was made of a fleet.

    Attributes
    ----------
    made, kept : int
        Logs made now, and those that there were.
    stuck : list of Made
        Trips that did not arrive, with the reason.
    duration, distance : float [s], [m]
        Of the trips made.
    size : int [B]
    elapsed : float [s]
        On the wall.
    codes : tuple of str
        Versions of the code that made the logs, those of earlier runs first.
    """

    made: int = 0
    kept: int = 0
    stuck: list[Made] = field(default_factory=list)
    duration: float = 0.0
    distance: float = 0.0
    size: int = 0
    elapsed: float = 0.0
    codes: tuple[str, ...] = ()

    def add(self, each: Made) -> None:
        """Count what became of a trip."""
        if each.reason:
            self.stuck.append(each)
            return
        self.made += 1
        self.duration += each.duration
        self.distance += each.distance
        self.size += each.size


def log_path(folder: str | Path, fleet: Fleet, number: int) -> Path:
    """The log of a trip: in the folder of its train."""
    return Path(folder) / fleet.train_of(number).name / f"{fleet.name(number)}.mcap"


def write_trip(fleet: Fleet, number: int, folder: str | Path) -> Made:
    """Drive one trip and write its log.

    A train that does not arrive leaves none.
    """
    scenario = fleet.scenario(number)
    try:
        run = drive(scenario)
    except InfeasibleError as error:
        return Made(number, scenario.name, reason=str(error))
    trip = as_recorded(recorded(scenario, run), fleet.train_of(number))
    path = log_path(folder, fleet, number)
    write_log(trip, path)
    distance = scenario.stops[-1].position - scenario.stops[0].position
    return Made(number, scenario.name, trip.duration, distance, path.stat().st_size)


def write_fleet(fleet: Fleet, folder: str | Path, jobs: int | None = None) -> FleetLogs:
    """Write all logs of a fleet, and beside them network, trains, weather and truth.

    Logs that are there already are kept: an interrupted run goes on where it ended. The bytes do
    not depend on `jobs`.

    Parameters
    ----------
    fleet : Fleet
    folder : path
    jobs : int, optional
        Processes; default: one a processor.

    Raises
    ------
    InputError
        If the folder holds another fleet, or cannot be written to.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.simulation import draw_fleet, draw_network
    >>> fleet = draw_fleet(draw_network(seed=1, lines=3), trains=2, days=1, trips=2)
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = write_fleet(fleet, folder, jobs=1)
    ...     second = write_fleet(fleet, folder, jobs=1)
    >>> first.made, second.made, second.kept
    (2, 0, 2)
    """
    begun = time.perf_counter()
    jobs = (os.cpu_count() or 1) if jobs is None else jobs
    if jobs < 1:
        raise InputError(f"cannot work in {jobs} processes", remedy="give 1 or more")
    target = made_folder(folder)
    earlier = _write_beside(fleet, target)
    found = FleetLogs()
    missing = []
    for number in range(fleet.trips):
        if log_path(target, fleet, number).exists():
            found.kept += 1
        else:
            missing.append(number)
    found.codes = tuple(earlier) if not missing else _state_code(target, earlier)
    batches = [missing[at : at + BATCH] for at in range(0, len(missing), BATCH)]
    done = 0
    with task("driving", total=len(missing), unit="trip") as step:
        for made in in_processes(_write_trips, (fleet, target), batches, jobs):
            for each in made:
                found.add(each)
                done += 1
                step(done, note=each.name)
    found.elapsed = time.perf_counter() - begun
    return found


def _write_beside(fleet: Fleet, folder: Path) -> list[str]:
    """Network, trains, weather and truth; refused where the folder holds those of another fleet.

    Returns
    -------
    list of str
        Versions of the code that logs in the folder were made by.
    """
    truth = json.loads(json.dumps(fleet.truth()))
    place = folder / TRUTH_FILE
    known = _stated(place) if place.exists() else {}
    if known and {name: known.get(name) for name in truth} != truth:
        raise InputError(
            "the folder holds another fleet",
            file=place,
            remedy="name another folder, or repeat the same seed, trains, days, trips and faults",
        )
    for each in fleet.trains:
        own = made_folder(folder / each.name)
        for left_over in own.glob(".*.mcap"):
            # Of a process that was killed while it wrote.
            left_over.unlink(missing_ok=True)
    if known:
        return list(known.get("code", ["not stated"]))
    write_network(fleet.network, folder / NETWORK_FILE)
    for each in fleet.trains:
        write_train(each.train, made_folder(folder / "trains") / f"{each.name}.train.json")
    for edge in fleet.network.edges:
        name = edge.name.replace("/", "_")
        write_weather(fleet.rail(edge.name).table, made_folder(folder / "weather") / f"{name}.csv")
    _write_truth(place, truth | {"software": f"trainlog {__version__}", "code": []})
    return []


def _stated(place: Path) -> dict[str, Any]:
    """The truth beside the logs of a folder; empty where it is none."""
    try:
        found = json.loads(read_bytes(place))
    except ValueError:
        found = None
    return found if isinstance(found, dict) else {"format": ""}


def _write_truth(place: Path, truth: dict[str, Any]) -> None:
    write_bytes(place, (json.dumps(truth, indent=1, ensure_ascii=False) + "\n").encode())


def _state_code(folder: Path, earlier: list[str]) -> tuple[str, ...]:
    """State beside the logs, before any is made, that the present code makes some of them."""
    code = code_version_of(__name__)
    if code not in earlier:
        place = folder / TRUTH_FILE
        truth = _stated(place)
        _write_truth(
            place, truth | {"software": f"trainlog {__version__}", "code": [*earlier, code]}
        )
        return (*earlier, code)
    return tuple(earlier)


def _write_trips(given: tuple[Fleet, Path], numbers: list[int]) -> list[Made]:
    fleet, folder = given
    return [write_trip(fleet, number, folder) for number in numbers]
