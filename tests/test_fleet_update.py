"""Bringing a fleet up to date: what is new, once, whatever goes wrong meanwhile."""

import json
import os
import shutil
import signal
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path

import pandas as pd
import pytest
from failing_analyses import DEADLY, DEADLY_AFTER, WRONG
from fleet_trips import TRIPS, later, short_trips
from killed import in_own_process
from killed_updates import (
    ANALYSES as TWO,
    POINTS,
    grow_old,
    kept,
    kill_at_random,
    maps_in,
    rows_by_trip,
)
from refusals import refused

import trainlog
from analysis.adhesion.condition_map import update_map
from analysis.fleet import maps, update
from analysis.fleet.analyses import ANALYSES, computation_of
from analysis.fleet.engine import Processes
from analysis.fleet.maps import maps_folder, update_maps
from analysis.fleet.update import FleetUpdate, UpdateOptions, fleet_status, update_fleet
from trainlog.catalogue import Catalogue, open_catalogue
from trainlog.catalogue.results import STATES
from trainlog.errors import InputError
from trainlog.formats.mapfile import MapFile, read_map

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

HERE = UpdateOptions(workers=0)


@pytest.fixture
def place(tmp_path: Path, fleet_logs: Path) -> Path:
    """A catalogue of the trips, whose logs may be changed."""
    shutil.copytree(fleet_logs, tmp_path / "logs")
    with open_catalogue(tmp_path / "catalogue") as catalogue:
        catalogue.add(tmp_path / "logs")
    return tmp_path / "catalogue"


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory, fleet_logs: Path) -> dict[str, bytes]:
    """The files of results of one update in one process."""
    folder = tmp_path_factory.mktemp("undisturbed")
    with open_catalogue(folder) as catalogue:
        catalogue.add(fleet_logs)
        found = update_fleet(catalogue, None, HERE)
        assert found.trips == TRIPS
        assert set(found.counts) == set(ANALYSES)
    return kept(folder)


def updated(place: Path | str, *analyses: object, **options: object) -> FleetUpdate:
    given = {"workers": 0, **options}
    with open_catalogue(place) as catalogue:
        return update_fleet(catalogue, analyses or None, UpdateOptions(**given))


def results(place: Path, analysis: str) -> pd.DataFrame:
    with open_catalogue(place) as catalogue:
        return catalogue.results(analysis)


def test_two_workers_give_the_same_bytes_as_one_process(place, undisturbed):
    found = updated(place, workers=2, batch=1)
    assert (found.engine, found.workers, found.trips) == ("processes", 2, TRIPS)
    assert kept(place) == undisturbed


def test_threads_as_any_executor_give_the_same_bytes(place, undisturbed):
    with ThreadPoolExecutor(2) as executor:
        analyses = ("adhesion", "checks")
        found = updated(place, *analyses, workers=None, executor=executor, batch=2)
    assert found.engine == "executor"
    names = [name for name in undisturbed if name.endswith(".map") or name.startswith(analyses)]
    assert kept(place) == {name: undisturbed[name] for name in names}


def test_nothing_is_computed_twice(place, monkeypatch):
    assert updated(place, "checks", where="weather = 'wet'").trips == TRIPS // 2
    assert updated(place, "checks").trips == TRIPS - TRIPS // 2
    monkeypatch.setattr("analysis.fleet.work.computed", None)
    folder = place / "results" / "checks"
    old, new = (folder / f".{name}-0123abcd.parquet" for name in ("dead", "written-now"))
    for each in (old, new):
        each.touch()
    os.utime(old, (0, 0))
    again = updated(place, "checks")
    assert (old.exists(), new.exists()) == (False, True), "a killed process left it"
    assert again.trips == 0
    assert again.sentence == "nothing new"
    assert again.counts["checks"].known == TRIPS
    refused(InputError, "several engines", UpdateOptions, workers=2, scheduler="tcp://somewhere:1")
    refused(InputError, "batch of 0 trips", UpdateOptions, batch=0)


OTHER = """
import sys
from analysis.fleet.update import UpdateOptions, update_fleet
from trainlog.catalogue import open_catalogue
with open_catalogue(sys.argv[1]) as catalogue:
    with catalogue.claims() as claim:
        assert all(map(claim, sys.argv[2:]))
        print("taken", flush=True)
        input()
    update_fleet(catalogue, ["checks"], UpdateOptions(workers=0))
"""


@pytest.mark.parametrize("killed", [True, False])
def test_trips_that_another_update_computes_are_left_to_it_as_long_as_it_runs(
    place, monkeypatch, killed
):
    with open_catalogue(place) as catalogue:
        keys = sorted(catalogue.pending(computation_of(ANALYSES["checks"]))["key"])
    other = subprocess.Popen(
        [sys.executable, "-c", OTHER, str(place), *keys[:2]],
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    with other:
        assert other.stdout.readline() == "taken\n"
        waited = []

        def end_other(_: float) -> None:
            waited.append(len(results(place, "checks")))
            if killed:
                other.kill()
            else:
                other.stdin.write("\n")
                other.stdin.flush()
            other.wait()

        monkeypatch.setattr("analysis.fleet.update.time.sleep", end_other)
        found = updated(place, "checks")
    assert waited == [TRIPS - 2]
    assert found.trips == (TRIPS if killed else TRIPS - 2)
    assert found.counts["checks"].pending == 0
    assert found.counts["checks"].known == (0 if killed else 2)
    assert sorted(results(place, "checks")["key"]) == keys


def test_what_another_update_records_before_the_first_trip_is_known(place, monkeypatch):
    jobs = update._Update._jobs

    def after_other(self):
        monkeypatch.setattr(update._Update, "_jobs", jobs)
        assert updated(place, "checks", where="weather = 'wet'").trips == TRIPS // 2
        return jobs(self)

    monkeypatch.setattr(update._Update, "_jobs", after_other)
    found = updated(place, "checks")
    counts = found.counts["checks"]
    assert (found.trips, counts.known, counts.pending) == (TRIPS // 2, TRIPS // 2, 0)


def test_other_code_and_other_parameters_are_computed_anew(place, monkeypatch):
    updated(place, "adhesion", "checks")
    coarse = ANALYSES["adhesion"].with_parameters(bin_length=100.0)
    assert updated(place, coarse).trips == TRIPS
    assert updated(place, "adhesion", "checks").trips == 0
    other = replace(computation_of(ANALYSES["checks"]), code="0123456789abcdef")
    monkeypatch.setattr("analysis.fleet.update.computation_of", lambda _: other)
    assert updated(place, "checks").trips == TRIPS


def test_a_trip_that_goes_wrong_is_listed_and_stops_no_other(place):
    found = updated(place, WRONG)
    counts = found.counts["wrong"]
    assert (counts.done, counts.refused, counts.failed) == (TRIPS - 2, 1, 1)
    reasons = {Path(each.path).stem: (each.state, each.reason) for each in found.problems}
    assert reasons["trip-001"] == ("refused", "trip 'trip-001' is not wanted")
    state, reason = reasons["trip-002"]
    assert state == "failed"
    assert reason.startswith("ZeroDivisionError: no samples at all (failing_analyses.py, line")
    with open_catalogue(place) as catalogue:
        known = fleet_status(catalogue, [WRONG])
        states = {each.name: each.state for each in known.problems}
    assert states == {"trip-001": "refused", "trip-002": "failed"}
    assert updated(place, WRONG).trips == 0
    assert updated(place, WRONG, retry=True).trips == 2


@pytest.mark.parametrize(
    "analysis", [DEADLY, pytest.param(DEADLY_AFTER, marks=pytest.mark.long)], ids=lambda it: it.name
)
def test_a_trip_that_ends_its_worker_is_named_and_stops_no_other(place, analysis, monkeypatch):
    monkeypatch.setattr("analysis.fleet.engine.PATIENCE", 1.0)
    found = updated(place, analysis, workers=2, batch=3)
    assert found.counts[analysis.name].done == TRIPS - 1
    (problem,) = found.problems
    assert Path(problem.path).stem == "trip-002"
    assert problem.state == "failed"
    assert "worker that computed it died each time" in problem.reason
    assert sorted(results(place, analysis.name)["trip"]) == [
        f"trip-{number:03d}" for number in range(TRIPS) if number != 2
    ]


def test_a_log_that_cannot_be_read_is_named_and_tried_again(place, tmp_path):
    gone, changed = (tmp_path / "logs" / f"trip-00{number}.mcap" for number in (0, 3))
    gone.rename(tmp_path / "elsewhere.mcap")
    shutil.copy(tmp_path / "logs" / "trip-001.mcap", changed)
    found = updated(place, "checks")
    reasons = {Path(each.path).stem: each.reason for each in found.problems}
    assert found.unread == 2
    assert "cannot read it" in reasons["trip-000"]
    assert "changed since it was registered" in reasons["trip-003"]
    (tmp_path / "elsewhere.mcap").rename(gone)
    assert updated(place, "checks").counts["checks"].done == 1


def test_trips_whose_logs_are_gone_are_counted_apart(place, tmp_path, works):
    first, *_ = sorted((tmp_path / "logs").rglob("*.mcap"))
    first.unlink()
    with open_catalogue(place) as catalogue:
        catalogue.refresh()
        assert fleet_status(catalogue, ["checks"]).gone == catalogue.gone() == 1
    known = ("--catalogue", place, "--analysis", "checks", "--json")
    for words in (("fleet", "show"), ("fleet", "update", "--workers", "0")):
        assert json.loads(works(*words, *known))["gone"] == 1


@pytest.mark.usefixtures("analysed_once")
def test_a_log_overwritten_or_removed_leaves_the_maps(place, undisturbed, tmp_path, monkeypatch):
    monkeypatch.setattr(maps, "KEPT", 1)
    (name,) = (name for name in undisturbed if name.endswith(".map"))
    logs = sorted((tmp_path / "logs").glob("*.mcap"))
    updated(place, "adhesion")
    every = [each["trip"] for each in read_map(place / "maps" / name).trips]

    def again() -> list[str]:
        with open_catalogue(place) as catalogue:
            catalogue.add(tmp_path / "logs")
        updated(place, "adhesion")
        (tmp_path / name).unlink(missing_ok=True)
        update_map(tmp_path / "logs", tmp_path / name)
        found, made = (read_map(folder / name) for folder in (place / "maps", tmp_path))
        with MapFile(place / "maps" / name) as file:
            assert file.logs(summed=True)
        assert found.trips == made.trips
        assert {n: layer.evidence for n, layer in found.layers.items()} == {
            n: layer.evidence for n, layer in made.layers.items()
        }
        return [each["trip"] for each in found.trips]

    content = logs[0].read_bytes()
    logs[0].write_bytes(logs[1].read_bytes())
    assert len(again()) == len(every) - 1
    logs[0].write_bytes(content)
    assert again() == every
    with open_catalogue(place) as catalogue:
        gone = catalogue.query(columns=["key", "name"]).iloc[0]
        catalogue.remove(f"key = '{gone['key']}'")
    updated(place, "adhesion")
    assert gone["name"] not in [each["trip"] for each in read_map(place / "maps" / name).trips]


def test_edges_are_updated_side_by_side_with_the_same_result(place, fleet_logs, monkeypatch):
    logs = [trainlog.read(log) for log in sorted(fleet_logs.glob("*.mcap"))]
    for number, name in enumerate(("second", "third"), 1):
        for trip in (later(each, pd.Timedelta(days=20 * number)) for each in logs):
            line = json.loads(trip.attachments["line.json"]) | {"name": name}
            attachments = {**trip.attachments, "line.json": json.dumps(line).encode()}
            metadata = {**trip.metadata, "line": name, "trip": f"{name}-{trip.name}"}
            moved = replace(trip, metadata=metadata, attachments=attachments)
            trainlog.write(moved, place.parent / "logs" / f"{moved.name}.mcap")
    with open_catalogue(place) as catalogue:
        catalogue.add(place.parent / "logs")
        monkeypatch.setattr(maps, "KEPT", 1)
        about, folder = computation_of(ANALYSES["adhesion"]), maps_folder(catalogue)
        update_fleet(catalogue, ["adhesion"], HERE)
        alone = maps_in(folder)
        assert len(alone) == 3
        monkeypatch.setattr(maps, "PAGE", 2)
        monkeypatch.setattr(maps, "SEVERAL", 0)
        asked = []
        with Processes(2) as processes:

            def engine() -> Processes:
                asked.append(len(asked))
                if asked == [0]:
                    processes.submit(Killing())
                return processes

            shutil.rmtree(folder)
            assert update_maps(catalogue, about, engine).trips == 3 * TRIPS
        assert len(asked) >= 2
        assert maps_in(folder) == alone
        for path in folder.glob("*.map"):
            with MapFile(path) as file:
                assert len(file.logs(summed=True)) == 2


@dataclass(frozen=True)
class Killing:
    """Work that kills its worker."""

    jobs: tuple[int, ...] = ()

    def computed(self) -> None:
        os.kill(os.getpid(), signal.SIGKILL)

    def alone(self, job):
        return self

    def died(self, job: int, reason: str) -> None: ...


def test_maps_of_other_code_stand_until_all_is_computed_anew(place, undisturbed, monkeypatch):
    assert updated(place, "adhesion").maps is not None
    with open_catalogue(place) as catalogue:
        adhesion, folder = ANALYSES["adhesion"], maps_folder(catalogue)
        before = maps_in(folder)
        other = replace(computation_of(adhesion), code="0123456789abcdef")
        monkeypatch.setattr("analysis.fleet.update.computation_of", lambda _: other)
        wet = UpdateOptions(workers=0, where="weather = 'wet'")
        assert not update_fleet(catalogue, ["adhesion"], wet).maps.complete
        assert maps_in(folder) == before
        assert "0123456789abcdef" not in (folder / "maps.json").read_text()
        assert update_fleet(catalogue, ["adhesion"], HERE).maps.complete
        assert "0123456789abcdef" in (folder / "maps.json").read_text()
        assert maps_in(folder) == before
        assert not folder.with_name("maps.next").exists()
        shutil.rmtree(folder)  # built anew from the results, without a log being read
        again = update_maps(catalogue, other)
        assert again.trips == TRIPS
        assert maps_in(folder) == before


def places(server, folder, request, *names):
    """Catalogues of their own on a database, that keep their results below a folder."""
    if server == "sqlite":
        return {name: str(folder / name) for name in names}
    url = request.getfixturevalue("postgresql_place")
    found = {name: f"{url}_{name}" for name in names}
    for name, place in found.items():
        open_catalogue(place, results=folder / name / "results").close()
    return found


@pytest.mark.parametrize(
    ("server", "kills", "trips"),
    [
        ("sqlite", 2, TRIPS),
        *(pytest.param(each, 100, 12, marks=pytest.mark.long) for each in ("sqlite", "postgresql")),
    ],
)
def test_an_update_killed_at_random_counts_each_trip_once(server, kills, trips, tmp_path, request):
    short_trips(tmp_path / "logs", trips)
    place = places(server, tmp_path, request, "one", "many")
    for at in place.values():
        with open_catalogue(at) as known:
            known.add(tmp_path / "logs")
    updated(place["one"], *TWO)
    left, seed = kills, 28
    while left > 0:
        done = kill_at_random(place["many"], left, seed, TWO)
        assert done["orphans"] == 0
        # A trip whose workers died three times failed.
        assert updated(place["many"], *TWO, retry=True).counts["checks"].pending == 0
        assert {count for _, count in rows_by_trip(place["many"])} == {len(TWO) + 1}
        grow_old(tmp_path / "many" / "results")
        updated(place["many"], *TWO)
        assert kept(tmp_path / "many") == kept(tmp_path / "one")
        left, seed = left - done["parent"] - done["worker"], seed + 1
        with open_catalogue(place["many"]) as known:
            for each in TWO:
                known.forget(computation_of(ANALYSES[each]), states=STATES)
        shutil.rmtree(tmp_path / "many" / "maps")


@pytest.mark.long
@pytest.mark.parametrize("server", ["sqlite", "postgresql"])
@pytest.mark.parametrize(("each", "at_random", "together"), [(10, 20, 1), (3, 20, 2)])
def test_kills_at_each_point_leave_the_same(server, each, at_random, together, tmp_path, request):
    short_trips(tmp_path / "logs", 6)
    place = places(server, tmp_path, request, "one", "many")
    with open_catalogue(place["one"]) as known:
        known.add(tmp_path / "logs")
    assert updated(place["one"], *TWO).trips == 6
    given = place["many"], tmp_path / "many" / "results", tmp_path / "logs"
    fell, said = in_own_process("killed_updates.run", *given, each, at_random, together)
    assert not said, "an update complained"
    print(json.dumps(fell, indent=1))
    assert {point: fell["named"].get(point, 0) for point in POINTS} == dict.fromkeys(POINTS, each)
    assert sum(fell["random"].values()) == at_random
    assert {count for _, count in rows_by_trip(place["many"])} == {2 * len(TWO) + 2}, "two codes"
    grow_old(tmp_path / "many" / "results")
    updated(place["many"], *TWO)
    assert kept(tmp_path / "many") == kept(tmp_path / "one")
    assert not list((tmp_path / "many" / "maps").glob(".*"))
    with open_catalogue(place["many"]) as known:
        assert len(known.results("checks")) == 6


@pytest.mark.long
def test_a_full_disk_ends_an_update_by_one_error_and_the_next_completes_it(tmp_path, request):
    short_trips(tmp_path / "logs", 4)
    disk = tmp_path / "disk"
    disk.mkdir()
    mount = ["mount", "-t", "tmpfs", "-o", "size=4m", "tmpfs", str(disk)]
    if subprocess.run(mount, capture_output=True, check=False).returncode:
        pytest.skip("no small disk can be mounted here")
    request.addfinalizer(lambda: subprocess.run(["umount", str(disk)], check=False))
    with open_catalogue(tmp_path / "one") as known:
        known.add(tmp_path / "logs")
    assert updated(tmp_path / "one", *TWO).trips == 4
    full = set()
    for free in (0, 8, 32, 64, 128, 160, 200, 260, 320, 340, 360, 380):
        with open_catalogue(disk / "many") as known:
            known.add(tmp_path / "logs")
        space = os.statvfs(disk)
        left = space.f_bavail * space.f_frsize - free * 1024
        (disk / "filler").write_bytes(bytes(left))
        try:
            updated(disk / "many", *TWO)
        except InputError as error:
            full.add((Path(str(error.file)).suffix, error.problem, error.remedy))
        assert not list((disk / "many" / "results").rglob(".*.parquet")), "nothing half"
        (disk / "filler").unlink()
        assert updated(disk / "many", *TWO).counts["checks"].pending == 0
        grow_old(disk / "many" / "results")
        updated(disk / "many", *TWO)
        assert kept(disk / "many") == kept(tmp_path / "one")
        shutil.rmtree(disk / "many")
    assert any("cannot be written" in problem for _, problem, _ in full)
    assert any("the database refuses" in problem for _, problem, _ in full)
    assert all("free some space" in str(remedy) for _, _, remedy in full)


def test_a_fleet_is_asked_for_page_by_page(place, monkeypatch):
    monkeypatch.setattr("analysis.fleet.update.PAGE", 2)
    asked = []
    pending = Catalogue.pending

    def noted(*given: object, **named: object) -> pd.DataFrame:
        asked.append(pending(*given, **named))
        return asked[-1]

    monkeypatch.setattr(Catalogue, "pending", noted)
    assert updated(place, "checks", "passport", batch=1).trips == TRIPS
    assert max(map(len, asked)) == 2
