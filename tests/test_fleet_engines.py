"""Engines of a fleet's work, and what the single analyses of its trips give."""

from __future__ import annotations

import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import zlib
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest
from failing_analyses import DEADLY
from fleet_trips import TRIPS
from killed import PATIENCE
from killed_fleet import kept, recorded
from refusals import refused

import trainlog
from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.evidence import evidence_of_log, own_line
from analysis.comparison.driven import driven_trip
from analysis.fleet import engine
from analysis.fleet.analyses import ANALYSES, analyses_named
from analysis.fleet.engine import MPI, Dask, Engine
from analysis.fleet.update import UpdateOptions, update_fleet
from analysis.fleet.work import Batch
from analysis.resistance.fit import fit_trip
from analysis.view import TripView, view_of
from trainlog.catalogue import open_catalogue
from trainlog.errors import InputError, MissingExtraError
from trainlog.formats.mapfile import packed_evidence

pytestmark = pytest.mark.usefixtures("remembered")

TESTS = Path(__file__).parent
Started = Callable[[Path], AbstractContextManager[tuple[str, int]]]


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory, fleet_logs: Path) -> Path:
    """A catalogue of trips whose checks and passports were computed in one process."""
    folder = tmp_path_factory.mktemp("engines")
    for name in ("one", "killed"):
        with open_catalogue(folder / name) as catalogue:
            catalogue.add(fleet_logs)
            if name == "one":
                update_fleet(catalogue, ["passport", "checks"], UpdateOptions(workers=0))
    return folder


def free_port() -> int:
    with socket.socket() as bound:
        bound.bind(("127.0.0.1", 0))
        return int(bound.getsockname()[1])


@contextmanager
def dask_cluster(folder: Path) -> Iterator[tuple[str, int]]:
    """A scheduler and two workers; its address, and the process that has the workers."""
    address = f"tcp://127.0.0.1:{free_port()}"
    port = address.rpartition(":")[2]
    path = os.pathsep.join([str(TESTS), os.environ.get("PYTHONPATH", str(TESTS.parent))])

    def begun(*words: str) -> subprocess.Popen[bytes]:
        return subprocess.Popen(
            [sys.executable, "-m", "dask", *words, "--no-dashboard"], cwd=folder,
            env={**os.environ, "PYTHONPATH": path}, stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )  # fmt: skip

    scheduler = begun("scheduler", "--host", "127.0.0.1", "--port", port)
    workers = begun("worker", address, "--nworkers", "2", "--nthreads", "1")
    try:
        yield address, workers.pid
    finally:
        for process in (workers, scheduler):
            process.send_signal(signal.SIGTERM)
        for process in (workers, scheduler):
            with suppress(subprocess.TimeoutExpired):
                process.wait(20)
            process.kill()
            process.wait()


def when_ready(address: str, patience: float = PATIENCE) -> None:
    """Wait until two workers have come."""
    until = time.monotonic() + patience
    while time.monotonic() < until:
        try:
            with Dask(address) as dask:
                if dask.workers == 2:
                    return
        except InputError:
            time.sleep(0.2)
    raise AssertionError("no Dask")


@contextmanager
def dask_threads(folder: Path) -> Iterator[tuple[str, int]]:
    """A scheduler and two workers that are threads of this process, reached by TCP."""
    from distributed import LocalCluster

    with LocalCluster(
        n_workers=2, threads_per_worker=1, processes=False, protocol="tcp://",
        dashboard_address="127.0.0.1:0", local_directory=str(folder / "scratch"),
    ) as cluster:  # fmt: skip
        yield cluster.scheduler_address, os.getpid()


def test_a_fork_server_that_dies_is_no_interruption_by_the_user(monkeypatch):
    """What starting a worker raises then; the update goes on with a server of its own."""

    def refused_by_server(*_: object) -> None:
        raise EOFError

    monkeypatch.setattr(engine, "computed", abs)
    with engine.Processes(1) as processes:
        monkeypatch.setattr(processes._pool, "submit", refused_by_server)
        found = processes.submit(-1)
        assert isinstance(found.exception(PATIENCE), BrokenProcessPool)
        processes.renew()
        assert processes.submit(-1).result(PATIENCE) == 1


@pytest.mark.parametrize(
    "started", [dask_threads, pytest.param(dask_cluster, marks=pytest.mark.long)]
)
def test_dask_gives_the_same_bytes_as_one_process(place, tmp_path, fleet_logs, started):
    pytest.importorskip("distributed")
    with started(tmp_path) as (address, _):
        when_ready(address)
        with open_catalogue(tmp_path / "dask") as catalogue:
            catalogue.add(fleet_logs)
            options = UpdateOptions(scheduler=address, batch=1)
            found = update_fleet(catalogue, ["passport", "checks"], options)
    assert (found.engine, found.workers, found.trips) == ("Dask", 2, TRIPS)
    assert kept(tmp_path / "dask") == kept(place / "one")


@pytest.mark.long
def test_dask_goes_on_when_its_workers_die(place):
    pytest.importorskip("distributed")
    with dask_cluster(place) as (address, pid):
        when_ready(address)
        with open_catalogue(place / "killed") as catalogue:
            found = update_fleet(catalogue, [DEADLY], UpdateOptions(scheduler=address, batch=2))
            assert found.counts["deadly"].done == TRIPS - 1
            (problem,) = found.problems
            assert Path(problem.path).stem == "trip-002"
            psutil.Process(pid).children(recursive=True)[0].kill()
            more = update_fleet(catalogue, ["checks"], UpdateOptions(scheduler=address, batch=1))
            assert more.counts["checks"].done == TRIPS


@pytest.mark.long
def test_a_scheduler_that_dies_ends_the_update_and_fails_no_trip(tmp_path, fleet_logs):
    pytest.importorskip("distributed")
    with open_catalogue(tmp_path / "dask") as catalogue, dask_cluster(tmp_path) as (address, _):
        catalogue.add(fleet_logs)
        when_ready(address)
        options = UpdateOptions(scheduler=address, batch=1)
        killing = threading.Thread(target=kill_scheduler, args=(address, catalogue.place))
        killing.start()
        with pytest.raises(InputError, match="scheduler does not answer any more"):
            update_fleet(catalogue, None, options)
        killing.join()
        found = update_fleet(catalogue, ["checks"], UpdateOptions(workers=0)).counts["checks"]
        assert (found.known + found.done, found.failed) == (TRIPS, 0)


def kill_scheduler(address: str, catalogue: str) -> None:
    """Kill the scheduler as soon as anything is recorded."""
    while not recorded(catalogue):
        time.sleep(0.05)
    for process in psutil.Process().children():
        if {"scheduler", address.rpartition(":")[2]} <= set(process.cmdline()):
            process.kill()


def test_a_scheduler_that_does_not_answer_is_named(monkeypatch):
    pytest.importorskip("distributed")
    monkeypatch.setattr(engine, "PATIENCE", 0.3)
    address = f"tcp://127.0.0.1:{free_port()}"
    refused(InputError, f"no Dask scheduler answers at {address}", Dask, address)


def test_workers_of_dask_that_were_missing_a_moment_do_not_end_an_update(monkeypatch):
    pytest.importorskip("distributed")

    class Client:
        """Of a scheduler without workers."""

        status = "running"

        def scheduler_info(self, n_workers: int) -> dict[str, object]:
            return {"workers": {}}

    with ThreadPoolExecutor(1) as executor:
        dask = Dask.__new__(Dask)
        Engine.__init__(dask, executor, 1)
        vars(dask).update(_client=Client(), _since=0.0)
        now = [1e3]
        monkeypatch.setattr(engine.time, "monotonic", lambda: now[0])
        dask.check()
        # They are back, and finish a batch.
        engine.run(dask, iter([Batch((), ())]), lambda batch, result: None)
        now[0] += 10 * engine.WITHOUT_WORKERS
        dask.check()
        now[0] += 1.1 * engine.WITHOUT_WORKERS
        refused(InputError, "has no workers any more", dask.check)


@pytest.mark.long
def test_mpi_gives_the_same_bytes_as_one_process(place, tmp_path, fleet_logs):
    workers = 2
    pytest.importorskip("mpi4py")
    mpiexec = Path(sys.executable).with_name("mpiexec")
    found = str(mpiexec) if mpiexec.exists() else shutil.which("mpiexec")
    if found is None:
        pytest.skip("mpiexec is not installed")
    with open_catalogue(tmp_path / "mpi") as catalogue:
        catalogue.add(fleet_logs)
    command = [found, "-n", str(workers + 1), sys.executable]
    command += ["-m", "mpi4py.futures", "-m", "trainlog"]
    command += ["fleet", "update", "--mpi", "--catalogue", str(tmp_path / "mpi"), "--batch", "1"]
    command += ["--analysis", "passport", "--analysis", "checks"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
    if done.returncode != 0 and "trainlog" not in done.stderr:
        pytest.skip(f"mpiexec does not run here: {done.stderr.strip()[-200:]}")
    assert done.returncode == 0, done.stderr
    assert f"by MPI, {workers} worker" in done.stdout
    assert kept(tmp_path / "mpi") == kept(place / "one")


def test_an_extra_that_is_missing_is_named(monkeypatch):
    monkeypatch.setattr("trainlog.extras.find_spec", lambda _: None)
    refused(MissingExtraError, "distributed, which is not installed", Dask, "tcp://127.0.0.1:1")
    refused(MissingExtraError, "mpi4py, which is not installed", MPI)


LOGS = ("sample_logs/nonstop.mcap", "sample_logs/stopping.mcap")
DOCS = Path(__file__).parents[1] / "docs"


def one(name: str, trip: TripView | str) -> pd.DataFrame:
    given = view_of(trip) if isinstance(trip, str) else trip
    return ANALYSES[name].table(given)


def test_each_table_has_the_columns_that_are_declared_and_documented():
    page = (DOCS / "fleet.md").read_text("utf-8")
    trip = view_of(LOGS[0])
    for analysis in ANALYSES.values():
        table = analysis.arrow([("k", analysis.table(trip))])
        assert table.column_names == ["key", *(column.name for column in analysis.columns)]
        assert table.num_rows == 1
        assert table.schema.equals(analysis.schema, check_metadata=True)
        part = re.search(rf"### `{analysis.name}`\n(.*?)\n##", page, re.DOTALL)
        assert part is not None, f"{analysis.name} is not in docs/fleet.md"
        for column in analysis.columns if analysis.name != "resistance" else ():
            row = f"| `{column.name}` | {column.unit} | {column.meaning} |"
            assert row in part[1], row


def test_results_are_those_of_the_single_analyses():
    """Of the fit, of the map, and of times and works."""
    log = LOGS[1]
    row, fit = one("resistance", log).iloc[0], fit_trip(log)
    assert [row["r0"], row["r1"], row["r2"], row["mass"]] == [*fit.beta.tolist(), fit.mass]
    assert (row["identity"], row["refused"]) == (fit.identity, "")
    row = one("adhesion", log).iloc[0]
    piece = evidence_of_log(Path(log), empty_map(own_line(trainlog.read(log, []))))
    assert zlib.decompress(row["evidence"]) == packed_evidence(piece.daily)
    assert row["layer"] == row["main_layer"] == piece.layer
    assert row["onsets"] == piece.daily.events.sum() > 0
    assert json.loads(row["entry"])["weather"] == piece.details["weather"]
    row, trip = one("driving", log).iloc[0], driven_trip(log)
    assert row["running_time"] == pytest.approx(trip.running[-1], abs=0.2)
    assert row["dwell"] == pytest.approx(trip.duration - trip.running[-1], abs=0.2)
    assert row["traction"] == pytest.approx(np.ptp(trip.sums["traction"]), rel=1e-4)
    assert row["stops"] == len(trip.stands) - 2
    lost = [name for name in row.index if name.startswith("lost_")]
    late = row["running_time"] - row["shortest_time"]
    assert row[lost].sum() == pytest.approx(late, abs=0.4)
    assert late > 0.0


def test_a_trip_that_is_refused_has_a_row_with_the_reason():
    trip = view_of(LOGS[1])
    short = TripView(trip.trip.between("2024-10-07T08:01", "2024-10-07T08:03"))
    row = one("resistance", short).iloc[0]
    assert row["refused"] != ""
    assert "trip-03" in row["message"]
    assert np.isnan(row["mass"])


def test_checks_list_what_is_wrong_with_a_recording():
    trip = trainlog.read(LOGS[1])
    state, axles = trip["/train/state"].copy(), trip["/train/axles"].copy()
    state = state.drop(state.index[4000:4300])
    axles.iloc[6000:6600, 0] = axles.iloc[6000, 0]
    controls = trip["/train/controls"].assign(pneumatic_braking_effort=np.nan)
    worse = trip.with_topic(state).with_topic(axles).with_topic(controls)
    sound, row = (one("checks", TripView(each)).iloc[0] for each in (trip, worse))
    assert (sound["gaps"], sound["frozen"], sound["missing"]) == (0, "", "")
    assert row["gaps"] == 1
    assert row["longest_gap"] == pytest.approx(30.1)
    assert row["missing"] == "pneumatic braking effort"
    assert "/train/axles.wheel_speed" in row["frozen"]
    assert row["frozen_samples"] == 599


def test_parameters_are_part_of_what_identifies_a_result():
    coarse = ANALYSES["adhesion"].with_parameters(bin_length=100.0)
    assert coarse.digest != ANALYSES["adhesion"].digest
    fine, rough = (each.table(view_of(LOGS[0])) for each in (ANALYSES["adhesion"], coarse))
    assert fine["bins"][0] > 2 * rough["bins"][0]
    given = ANALYSES["resistance"].with_parameters(speeds=(5, 40.0), largest_std=0.2)
    assert given.parameters == {"speeds": (5, 40.0), "largest_std": 0.2}
    refused(InputError, "no parameter 'bins'", ANALYSES["adhesion"].with_parameters, bins=3)
    # An analysis of one's own takes whatever it declares.
    own = replace(coarse, name="mine", parameters={"layer": "wet", "window": 10.0, "ends": None})
    given = {"layer": "dry", "window": 0, "ends": "a to b"}
    assert own.with_parameters(**given).parameters == given
    refused(InputError, "no analysis 'energy'", analyses_named, ["energy"])
