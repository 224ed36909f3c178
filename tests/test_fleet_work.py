"""What changed between two versions over a fleet; engines of its work; the single analyses."""

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
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import psutil
import pytest
from failing_analyses import DEADLY
from fleet_trips import TRIPS
from killed import PATIENCE
from killed_updates import kept, recorded
from refusals import refused

import trainlog
from analysis import TripView, UpdateOptions, fit_trip, update_fleet, view_of
from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.evidence import evidence_of_log, own_line
from analysis.comparison.driven import driven_trip
from analysis.fleet import engine
from analysis.fleet.analyses import ANALYSES, analyses_named, computation_of
from analysis.fleet.diff import FleetDiff, Results, Version, compared, typed_parameters
from analysis.fleet.engine import MPI, Dask, Engine
from analysis.fleet.maps import evidence_of_row
from analysis.fleet.work import Batch
from trainlog.catalogue import Computation, open_catalogue
from trainlog.errors import InputError, MissingExtraError
from trainlog.formats.mapfile import packed_evidence

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

SIDES = tuple(Version(name, {"made up": Computation("made up", name)}) for name in "ab")

DAY = pd.Timestamp("2026-01-01", tz="UTC")


def made_up(trains: int = 5, trips: int = 40, seed: int = 1) -> pd.DataFrame:
    generator = np.random.default_rng(seed)
    count = trains * trips
    std = generator.uniform(100.0, 300.0, count)
    return pd.DataFrame(
        {
            "key": [f"{number:05d}" for number in range(count)],
            "trip": [f"trip-{number}" for number in range(count)],
            "train": [f"unit-{number // trips}" for number in range(count)],
            "kind": "unit",
            "line": [f"line {number % 3}" for number in range(count)],
            "start": DAY,
            "mass": 1e5 + std * generator.standard_t(4.0, count),
            "mass_std": std,
            "energy": generator.uniform(1e8, 2e8, count),
            "source": "recorded",
        }
    )


def outcomes_of(table: pd.DataFrame, refused: tuple[str, ...] = ()) -> pd.DataFrame:
    found = table[["key", "trip", "train", "kind", "line", "start"]].drop_duplicates("key")
    found = found.rename(columns={"trip": "name"})
    states = ["refused" if key in refused else "done" for key in found["key"]]
    reasons = ["too short" if key in refused else "" for key in found["key"]]
    return found.assign(state=states, reason=reasons)


def difference(one: pd.DataFrame, other: pd.DataFrame, name: str = "made up") -> FleetDiff:
    sides = (Results(each, outcomes_of(each)) for each in (one, other))
    return compared(*SIDES, {name: tuple(sides)})


def changed(column: str, change: Callable[[np.ndarray], np.ndarray]) -> FleetDiff:
    table = made_up()
    return difference(table, table.assign(**{column: change(table[column].to_numpy())}))


@pytest.mark.parametrize(
    ("column", "factor", "kind"),
    [
        ("mass", 1.0, "same"),
        ("mass", 1.0 + 1e-8, "rounding"),
        ("mass", 1.0 + 1e-4, "within"),
        ("mass", 1.01, "beyond"),
        ("energy", 1.0 + 1e-7, "rounding"),
        ("energy", 1.005, "within"),
        ("energy", 1.02, "beyond"),
        ("mass_std", 1.2, "within"),
    ],
)
def test_a_difference_is_of_the_class_that_its_band_gives(column, factor, kind):
    found = changed(column, lambda values: factor * values)
    assert found.trip_counts[kind].tolist() == [200]
    assert found.same == (kind == "same")
    if found.same:
        assert found.sentence == "every result of 200 trips is the same to the byte."
    assert found.beyond == (kind == "beyond")
    assert len(found.moved) == (200 if found.beyond else 0)
    if column == "mass_std":
        rows = found.estimates.set_index("estimate")
        assert rows.loc["mass", "band_ratio"] == pytest.approx(1.2)


def test_a_shift_too_small_for_any_trip_is_found_in_the_mean_of_its_train_alone():
    table = made_up()
    generator = np.random.default_rng(2)
    noise = 0.1 * table["mass_std"] * generator.standard_t(3.0, len(table))
    shifted = 0.7 * table["mass_std"] * (table["train"] == "unit-3")
    found = difference(table, table.assign(mass=table["mass"] + noise + shifted))
    assert len(found.moved) <= 2, "single trips but for the farthest of the noise are within"
    means = found.means[(found.means["of"] == "train") & found.means["beyond"]]
    assert means["name"].tolist() == ["unit-3"]
    shift, std = means[["shift", "shift_std"]].to_numpy()[0]
    own = table[table["train"] == "unit-3"]
    weight = own["mass_std"] ** -2
    expected = float(0.7 * (weight * own["mass_std"]).sum() / weight.sum())
    assert shift == pytest.approx(expected, abs=4 * std)
    assert "unit-3" in [row["name"] for row in found.facts()["means"]]


def test_differences_that_scatter_around_zero_are_rarely_called_systematic():
    """Of twenty comparisons with 50 trains each, at a rate of one in twenty."""
    called = 0
    for seed in range(20):
        table = made_up(trains=50, trips=6, seed=seed)
        generator = np.random.default_rng(1_000 + seed)
        noise = 0.2 * table["mass_std"] * generator.standard_t(3.0, len(table))
        found = difference(table, table.assign(mass=table["mass"] + noise))
        called += bool(found.means["systematic"].any())
    assert called <= 4


def test_trips_that_one_side_alone_accepts_are_listed_with_the_reason():
    table = made_up()
    left = Results(table, outcomes_of(table))
    kept = table[~table["key"].isin(["00003", "00100"])]
    right = Results(kept, outcomes_of(table, refused=("00003", "00100")))
    found = compared(*SIDES, {"made up": (left, right)})
    assert found.verdicts[["trip", "first", "second"]].to_numpy().tolist() == [
        ["trip-3", "done", "refused: too short"],
        ["trip-100", "done", "refused: too short"],
    ]
    assert found.beyond
    assert found.trip_counts["beyond"].tolist() == [2]
    again = compared(*SIDES, {"made up": (right, left)})
    assert again.verdicts["first"].tolist() == 2 * ["refused: too short"]


@pytest.fixture(scope="module")
def adhesion() -> pd.DataFrame:
    """What the two sample trips show of the maximum adhesion."""
    frames = []
    for name in ("nonstop", "stopping"):
        trip = view_of(f"sample_logs/{name}.mcap")
        about = {"key": name, "train": "unit-1", "kind": "unit", "line": trip.line.name}
        frames.append(ANALYSES["adhesion"].table(trip).assign(**about, start=DAY))
    return pd.concat(frames, ignore_index=True)


def test_evidence_that_one_side_alone_has_is_listed_by_trip(adhesion):
    refused_all = outcomes_of(adhesion, refused=tuple(adhesion["key"]))
    nothing = Results(pd.DataFrame({"key": []}), refused_all)
    sides = Results(adhesion, outcomes_of(adhesion)), nothing
    found = compared(*SIDES, {"adhesion": sides})
    assert found.verdicts["second"].tolist() == 2 * ["refused: too short"]
    assert found.places.empty


def test_a_place_of_the_map_that_moved_is_named(adhesion):
    def with_more_adhesion(data: bytes) -> bytes:
        """The same evidence, but for more adhesion at the onsets of 18 to 21 km."""
        daily = evidence_of_row(data)
        there = (daily.bin >= 720) & (daily.bin < 840)
        log = daily.weighted_log / np.where(daily.weight > 0.0, daily.weight, 1.0)
        moved = np.where(there, log + 0.4, log)
        changed = {"weighted_log": moved * daily.weight, "weighted_square": moved**2 * daily.weight}
        return zlib.compress(packed_evidence(replace(daily, **changed)))

    wet = adhesion["layer"] == "wet"
    changed = adhesion["evidence"].where(~wet, adhesion["evidence"].map(with_more_adhesion))
    found = difference(adhesion, adhesion.assign(evidence=changed), "adhesion")
    assert found.beyond
    places = found.places
    assert set(places["layer"]) == {"wet"}
    assert places["from_km"].min() > 17.0
    assert places["to_km"].max() < 22.0
    assert (places["second"] > 1.2 * places["first"]).all()
    titles = " ".join(str(each.title) for each in found.tables())
    assert "Places of the track-condition map" in titles


def counts_of(columns: dict[str, np.ndarray], name: str) -> pd.DataFrame:
    """A result of an analysis with its counts, of as many trips as there are."""
    table = made_up()
    count = len(next(iter(columns.values())))
    return table[["key", "trip", "train", "kind", "line", "start"]].head(count).assign(**columns)


def test_a_count_moves_beyond_its_band_by_more_than_its_chance():
    """Of n repairs the standard deviation by chance is the root of n; of none that of one."""
    before = np.array([0, 0, 1, 4, 100, 100, 10_000])
    after = np.array([1, 2, 2, 8, 119, 120, 10_195])
    sides = (counts_of({"repairs": each}, "checks") for each in (before, after))
    found = difference(*sides, "checks")
    moved = found.moved.set_index("trip")
    assert sorted(moved.index) == ["trip-1", "trip-3", "trip-5"]
    assert moved.loc["trip-5", "bands"] == pytest.approx(20 / (1.96 * 10))
    assert not moved["banded"].any()
    assert "figures without a band" in found.sentence


def test_what_parameters_change_by_definition_is_not_compared():
    columns = {"bins": np.array([40, 30, 20]), "bin_length": 25.0, "weight": 10.0}
    columns |= {"weighted_log": np.array([-20.0, -18.0, -16.0])}
    one = counts_of(columns, "adhesion")
    finer = one.assign(bins=one["bins"] // 2, bin_length=50.0)
    found = difference(one, finer, "adhesion")
    assert found.by_definition == ("number of bins",)
    assert not found.beyond
    assert "not compared, as the parameters change it: number of bins" in found.sentence
    # Of the same bins their number is compared, and so is the adhesion of the onsets.
    fewer = difference(one, finer.assign(bin_length=25.0), "adhesion")
    assert set(fewer.moved["estimate"]) == {"bins"}
    slipperier = difference(one, one.assign(weighted_log=one["weighted_log"] - 10.0), "adhesion")
    assert set(slipperier.moved["estimate"]) == {"maximum adhesion"}
    assert slipperier.moved["second"].max() == pytest.approx(np.exp(-2.6))
    assert slipperier.moved["bands"].min() == pytest.approx((np.e - 1) / 1.96 * 10**0.5)


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    place = tmp_path_factory.mktemp("fleet") / "catalogue"
    with open_catalogue(place) as catalogue:
        catalogue.add("sample_logs")
    return place


def test_results_of_other_code_that_differ_are_named(place, tmp_path, monkeypatch, shell):
    """By code whose checks state durations that are 2 % too long."""
    checks = ANALYSES["checks"]

    def longer(trip: TripView, **given: object) -> pd.DataFrame:
        return checks.table(trip).assign(duration=1.02 * checks.table(trip)["duration"])

    with monkeypatch.context() as patch, open_catalogue(place) as catalogue:
        other = replace(computation_of(checks), code="0123456789abcdef")
        patch.setattr("analysis.fleet.update.computation_of", lambda _: other)
        update_fleet(catalogue, [replace(checks, run=longer)], UpdateOptions(workers=0))
    words = ("--catalogue", place, "--analysis", "checks", "--workers", 0)
    status, printed, complaint = shell(
        "fleet", "diff", "now", "01234567", *words, "-o", tmp_path / "changes", "--json"
    )
    assert (status, complaint) == (1, "")
    found = json.loads(printed)
    assert {(each["estimate"], each["trip"]) for each in found["moved"]} == {
        ("duration", "trip-01"), ("duration", "trip-03"),
    }  # fmt: skip
    moved = [each["second"] / each["first"] for each in found["moved"]]
    assert moved == pytest.approx([1.02, 1.02])
    assert len(pd.read_csv(tmp_path / "changes" / "moved.csv")) == 2
    assert shell("fleet", "diff", "01234567", "now", *words)[0] == 1
    assert shell("fleet", "diff", "now", "now", *words)[0] == 0


def test_parameters_that_change_the_bins_of_a_map(place, tmp_path, shell):
    words = ("--catalogue", place, "--workers", 0, "--trips", "weather = 'wet'")
    words += ("-o", tmp_path / "changes")
    status, shown, _ = shell("fleet", "diff", "now", "adhesion.bin_length=50", *words)
    assert status == 0, "no estimate moved beyond its band"
    assert "as the parameters change it: number of bins." in shown
    assert "weighted_log" not in shown, "sums over other bins differ by definition"
    assert "resistance" not in shown, "the other analyses have no other parameters"
    assert "<h2>" in (tmp_path / "changes" / "diff.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("side", "message"),
    [
        ("no-such-version", "no results of a version 'no-such-version'; it has results of: "),
        ("adhesion.bins=3", "has no parameter 'bins'; it has bin_length"),
        ("adhesion.bin_length=-5", "adhesion.bin_length is -5; give a positive number, in SI"),
        ("adhesion.bin_length=x", "adhesion.bin_length is 'x'; give a positive number"),
        ("resistance.speeds=30", "resistance.speeds is 30; give two numbers, as [5, 40]"),
        ("resistance.speeds=[40, 5]", "speeds is [40, 5]; give two numbers, as [5, 40]"),
    ],
)
def test_what_is_no_version_is_refused(place, side, message, shell):
    refused(InputError, r"no analysis 'resistence'.*resistance", typed_parameters, "resistence.a=3")
    refused(InputError, r"'speeds=3' is not a parameter", typed_parameters, "speeds=3")
    status, _, complaint = shell("fleet", "diff", "now", side, "--catalogue", place)
    assert (status, complaint.count("\n")) == (2, 1)
    assert message in complaint


def test_texts_that_differ_are_listed_but_no_estimate_moved():
    table = made_up()
    sources = table["source"].where(table["key"] != "00007", "assumed")
    found = difference(table, table.assign(source=sources))
    assert not found.beyond
    words = found.words[["trip", "estimate", "second"]].to_numpy().tolist()
    assert words == [["trip-7", "source", "assumed"]]


TESTS = Path(__file__).parent


@pytest.fixture(scope="module")
def computed(tmp_path_factory: pytest.TempPathFactory, fleet_logs: Path) -> dict[str, bytes]:
    """Results of one process."""
    place = tmp_path_factory.mktemp("engines")
    with open_catalogue(place) as catalogue:
        catalogue.add(fleet_logs)
        update_fleet(catalogue, ["passport", "checks"], UpdateOptions(workers=0))
    return kept(place)


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
def test_dask_gives_the_same_bytes_as_one_process(computed, tmp_path, fleet_logs, started):
    pytest.importorskip("distributed")
    with started(tmp_path) as (address, _):
        when_ready(address)
        with open_catalogue(tmp_path / "dask") as catalogue:
            catalogue.add(fleet_logs)
            options = UpdateOptions(scheduler=address, batch=1)
            found = update_fleet(catalogue, ["passport", "checks"], options)
    assert (found.engine, found.workers, found.trips) == ("Dask", 2, TRIPS)
    assert kept(tmp_path / "dask") == computed


@pytest.mark.long
def test_dask_goes_on_when_its_workers_die(tmp_path, fleet_logs):
    pytest.importorskip("distributed")
    with dask_cluster(tmp_path) as (address, pid):
        when_ready(address)
        with open_catalogue(tmp_path / "dask") as catalogue:
            catalogue.add(fleet_logs)
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
        said = "scheduler does not answer any more"
        refused(InputError, said, update_fleet, catalogue, None, options)
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
def test_mpi_gives_the_same_bytes_as_one_process(computed, tmp_path, fleet_logs):
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
    assert kept(tmp_path / "mpi") == computed


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
