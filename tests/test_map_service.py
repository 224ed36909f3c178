"""Updates of a map as a service: several at once, killed, repeated, with bad and damaged logs."""

from __future__ import annotations

import json
import os
import pickle
import re
import shutil
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest
from simulated_line import flirt, hilly_line
from test_map_file import part, recording
from test_traction_map import LINE, piece
from typer.testing import CliRunner

import trainlog
from analysis import update_map
from analysis.adhesion.condition_map import adhesion_map, empty_map, update
from trainlog.cli.main import app
from trainlog.errors import InputError
from trainlog.formats.condition import map_to_bytes, read_map
from trainlog.formats.mapfile import MapFile
from trainlog.formats.samples import sample
from trainlog.mcap import write_log
from trainlog.simulation import draw_scenarios, simulate
from trainlog.trip import Trip

APPEND = [sys.executable, str(Path(__file__).with_name("append_recordings.py"))]


def process(path: Path, recordings: Path) -> subprocess.Popen[str]:
    """A process that adds recordings to a map; ready to begin when this returns."""
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1])}
    started = subprocess.Popen(
        [*APPEND, str(path), str(recordings)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
    )
    assert started.stdout is not None
    assert started.stdout.readline() == "ready\n"
    return started


def kill_and_add(folder: Path, updaters: int, kills: int, each: int) -> None:
    """Kill processes at random instants; what they had acknowledged must be there, once.

    Each process is given recordings of its own, some that others are given, too, and recordings of
    one drive that replace each other.
    """
    path, rng = folder / "a.map", np.random.default_rng(1)
    empty = empty_map(LINE)
    shared = [part(900 + n, 3 * n, 3 * n + 9 + n) for n in range(5)] + [piece(990, "wet")]
    given: dict[str, object] = {}
    acknowledged: Counter[str] = Counter()
    number = killed = 0
    while killed < kills:
        running = []
        for _ in range(updaters):
            pieces = [piece(1000 + each * number + n, ("dry", "wet")[n % 2]) for n in range(each)]
            pieces[2:2] = shared
            given |= {found.trip: found for found in pieces}
            recordings = folder / f"{number}.pickle"
            recordings.write_bytes(pickle.dumps((empty, list(map(recording, pieces)))))
            running.append(process(path, recordings))
            number += 1
        time.sleep(float(rng.uniform(0.0, 0.02 * each * updaters)))
        for each_one in running:
            each_one.kill()
            shown, complaint = each_one.communicate()
            assert complaint == ""
            acknowledged.update(shown.split())
            killed += each_one.returncode != 0
            time.sleep(float(rng.uniform(0.0, 0.01)))
        if path.exists():
            with MapFile(path) as file:
                file.trips()
    assert len(acknowledged) > kills // 2
    with MapFile(path) as file:
        rows = file.trips()
        names = [row.known.name for row in rows]
    assert len(set(names)) == len(names), "a trip is there twice"
    assert set(acknowledged) <= set(names), "an acknowledged trip is missing"
    # The map is that of the recordings which it holds, whatever happened on the way.
    with MapFile(folder / "b.map", empty) as file:
        for name in sorted(names, reverse=True):
            file.append(recording(given[name]))  # type: ignore[arg-type]
    assert map_to_bytes(read_map(path)) == map_to_bytes(read_map(folder / "b.map"))


class TestProcesses:
    def test_killed_updaters_lose_nothing_that_they_acknowledged(self, tmp_path: Path) -> None:
        kill_and_add(tmp_path, updaters=3, kills=5, each=6)

    @pytest.mark.long
    def test_a_hundred_kills_of_five_updaters(self, tmp_path: Path) -> None:
        kill_and_add(tmp_path, updaters=5, kills=100, each=20)

    def test_updaters_that_begin_one_map_at_once_lose_nothing(self, tmp_path: Path) -> None:
        """Before, two at once lost a trip in ten of ten tries."""
        empty, pieces = empty_map(LINE), [piece(n) for n in range(12)]
        running = []
        for number in range(3):
            recordings = tmp_path / f"{number}.pickle"
            own = list(map(recording, pieces[number::3]))
            recordings.write_bytes(pickle.dumps((empty, own)))
            running.append(process(tmp_path / "a.map", recordings))
        for each in running:
            assert each.communicate()[1] == ""
            assert each.returncode == 0
        assert map_to_bytes(read_map(tmp_path / "a.map")) == map_to_bytes(update(empty, pieces)[0])
        assert not list(tmp_path.glob(".*"))


def updater(logs: Path, path: Path) -> subprocess.Popen[str]:
    """The command, as cron runs it."""
    words = [sys.executable, "-m", "trainlog", "map", "update", str(logs), "--map", str(path)]
    environment = {**os.environ, "PYTHONPATH": str(Path(__file__).parents[1]), "COLUMNS": "200"}
    return subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=environment
    )


def kill_and_update(logs: Path, folder: Path, rounds: int, updaters: int = 5) -> int:
    """Commands that update one map from one folder at once: all are killed, then all may end.

    Returns how many were killed before they had ended.
    """
    expected = map_to_bytes(adhesion_map(logs).track)
    rng, killed = np.random.default_rng(2), 0
    for number in range(rounds):
        path = folder / f"killed-{number}.map"
        running = [updater(logs, path) for _ in range(updaters)]
        assert running[0].stdout is not None
        first = running[0].stdout.readline()
        time.sleep(float(rng.uniform(0.0, 0.3)))
        for each in running:
            each.kill()
        # What is buffered with the first line is not in what `communicate` returns.
        first += running[0].stdout.read()
        shown = first + "".join(each.communicate()[0] for each in running)
        killed += sum(each.returncode != 0 for each in running)
        added = re.findall(r"trip '([^']+)' added to", shown)
        assert len(set(added)) == len(added), "a trip was stated as added twice"
        with MapFile(path) as file:
            names = [row.known.name for row in file.trips() if row.counted]
        assert len(set(names)) == len(names), "a trip is there twice"
        assert set(added) <= set(names), "an acknowledged trip is missing"
        running = [updater(logs, path) for _ in range(updaters)]
        for each in running:
            shown, complaint = each.communicate()
            assert (each.returncode, complaint) == (0, "")
            assert f"the map holds {len(list(logs.iterdir()))} trips" in shown
        assert map_to_bytes(read_map(path)) == expected
    return killed


@pytest.fixture(scope="module")
def trips() -> list[Trip]:
    return [simulate(each) for each in draw_scenarios(hilly_line(), flirt(), 3, seed=1)]


@pytest.fixture
def logs(trips: list[Trip], tmp_path: Path) -> Path:
    """A folder of three logs that came a while ago."""
    folder = tmp_path / "logs"
    folder.mkdir()
    for trip in trips:
        write_log(trip, folder / f"{trip.name}.mcap")
        os.utime(folder / f"{trip.name}.mcap", (1_700_000_000, 1_700_000_000))
    return folder


class TestCommandsAtOnce:
    @pytest.mark.long
    def test_killed_commands_lose_nothing_that_they_stated(
        self, logs: Path, tmp_path: Path
    ) -> None:
        assert kill_and_update(logs, tmp_path, rounds=4) >= 10


class TestUpdate:
    def test_the_map_is_that_of_all_logs_at_once(self, logs: Path, tmp_path: Path) -> None:
        path = tmp_path / "a.map"
        for log in sorted(logs.iterdir(), reverse=True):
            assert len(update_map(log, path).added) == 1
        assert map_to_bytes(read_map(path)) == map_to_bytes(adhesion_map(logs).track)
        before = path.read_bytes()
        again = update_map(logs, path)
        assert again.sentence == "0 trips added, 3 held already; the map holds 3 trips of 1 day"
        assert path.read_bytes() == before

    def test_logs_that_have_not_changed_are_not_read(
        self, logs: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        path = tmp_path / "a.map"
        update_map(logs, path)
        read: list[Path] = []
        monkeypatch.setattr(
            "analysis.adhesion.updating.sha256_of", lambda log: read.append(log) or "0" * 64
        )
        assert len(update_map(logs, path).of("held")) == 3
        assert read == []
        os.utime(logs / "trip-02.mcap", (1_700_000_001, 1_700_000_001))
        monkeypatch.undo()
        assert len(update_map(logs, path).of("held")) == 3

    def test_a_bad_log_is_listed_and_the_others_are_added(self, logs: Path, tmp_path: Path) -> None:
        (logs / "a-bad.mcap").write_bytes(b"PAR1 and more")
        shutil.copy(sample("nonstop.mcap"), logs / "trip-02b.mcap")
        seen = []
        found = update_map(logs, tmp_path / "a.map", report=lambda each: seen.append(each.outcome))
        assert seen == ["refused", "added", "added", "refused", "added"]
        assert found.sentence == "3 trips added, 2 refused; the map holds 3 trips of 1 day"
        assert "is not an MCAP file but a Parquet file" in found.refused[0].reason
        assert "keep one map a line" in found.refused[1].reason

    def test_the_readable_part_of_a_damaged_log_counts_with_its_account(
        self, logs: Path, tmp_path: Path
    ) -> None:
        whole = (logs / "trip-01.mcap").read_bytes()
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(whole[: 2 * len(whole) // 3])
        path = tmp_path / "a.map"
        with pytest.warns(trainlog.mcap.DamageWarning):
            found = update_map(damaged, path)
        assert "is damaged" in found.added[0].damage
        entry = read_map(path).trips[0]
        assert entry["damage"] == found.added[0].damage
        # The whole log, when it comes, counts in its place.
        found = update_map(logs / "trip-01.mcap", path)
        assert found.added[0].replaced == ("trip-01",)
        assert map_to_bytes(read_map(path)) == map_to_bytes(
            adhesion_map(logs / "trip-01.mcap").track
        )

    def test_a_fuller_recording_replaces_a_poorer_one_and_a_poorer_one_nothing(
        self, trips: list[Trip], logs: Path, tmp_path: Path
    ) -> None:
        start = trips[0]["/train/state"].index[0]
        half = trips[0].between(None, start + 0.5 * (trips[0]["/train/state"].index[-1] - start))
        write_log(half, tmp_path / "half.mcap")
        orders = ([tmp_path / "half.mcap", logs], [logs, tmp_path / "half.mcap"])
        maps = []
        for number, order in enumerate(orders):
            path = tmp_path / f"{number}.map"
            found = [update_map(each, path) for each in order]
            maps.append(map_to_bytes(read_map(path)))
            assert found[-1].trips == 3
        assert maps[0] == maps[1] == map_to_bytes(adhesion_map(logs).track)
        assert "the same drive as 'trip-01" in found[-1].of("same drive")[0].reason


class TestCommand:
    def run(self, *words: object) -> tuple[int, str, str]:
        result = CliRunner().invoke(app, [str(word) for word in words])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
        return result.exit_code, result.stdout, result.stderr

    def test_a_folder_day_by_day(self, logs: Path, tmp_path: Path) -> None:
        """As cron gives it: the same folder, to which logs are added."""
        path, later = tmp_path / "a.map", tmp_path / "later.mcap"
        (logs / "trip-03.mcap").rename(later)
        status, shown, _ = self.run("map", "update", logs, "--map", path)
        lines = shown.splitlines()
        assert (status, len(lines)) == (0, 3)
        assert lines[0] == "  trip 'trip-01' added to 'dry'"
        assert lines[-1] == "2 trips added; the map holds 2 trips of 1 day"
        later.rename(logs / "trip-03.mcap")
        (logs / "bad.mcap").write_bytes(b"")
        status, shown, complaint = self.run("map", "update", logs, "--map", path)
        assert status == 1
        assert shown.splitlines()[-1] == (
            "1 trip added, 2 held already, 1 refused; the map holds 3 trips of 1 day"
        )
        assert "bad.mcap, byte 0: is empty" in complaint
        (logs / "bad.mcap").unlink()
        status, shown, complaint = self.run("map", "update", logs, "--map", path, "--json")
        found = json.loads(shown)
        assert (status, complaint) == (0, "")
        assert (found["added"], found["held"], found["trips"], found["days"]) == (0, 3, 3, 1)
        assert {each["outcome"] for each in found["logs"]} == {"held"}

    def test_nothing_usable_is_an_error(self, tmp_path: Path) -> None:
        bad = tmp_path / "bad.mcap"
        bad.write_bytes(b"anything at all")
        status, _, complaint = self.run("map", "update", bad, bad, "--map", tmp_path / "a.map")
        assert status == 2
        assert complaint.count("bad.mcap") == 2
        assert not (tmp_path / "a.map").exists()

    def test_what_is_no_map_is_named_and_kept(self, logs: Path, tmp_path: Path) -> None:
        earlier = b'{"format": "trainlog/condition", "version": 1}'
        for name, data, message in (
            ("a.map.json", earlier, "of an earlier version (JSON); build the map anew from the"),
            ("a.map", earlier, "of an earlier version (JSON); build the map anew from the"),
            ("b.map", (logs / "trip-01.mcap").read_bytes(), "but a log (MCAP); name a map that"),
            ("trip.mcap", (logs / "trip-01.mcap").read_bytes(), "but a log (MCAP); name a map"),
            ("empty.map", b"", "is empty; build the map anew from the logs"),
        ):
            path = tmp_path / name
            path.write_bytes(data)
            with pytest.raises(InputError) as found:
                self.run("map", "update", logs, "--map", path)
            assert message in str(found.value)
            assert str(path) in str(found.value)
            assert path.read_bytes() == data

    def test_info_lists_what_a_map_holds(self, logs: Path, tmp_path: Path) -> None:
        path = tmp_path / "a.map"
        assert self.run("map", "update", logs, "--map", path)[0] == 0
        before = path.read_bytes()
        status, shown, _ = self.run("info", path, sample("CH_StGallen_Wil.map"))
        assert status == 0
        assert path.read_bytes() == before
        words = " ".join(shown.split())
        assert f"line {hilly_line().name}, " in words
        assert "trips 3 trips, 1 day, 2" in words
        assert "layer dry" in words
        assert "line CH_StGallen_Wil, 29.6 km, 1183 bins of 25 m" in words
        track = read_map(sample("CH_StGallen_Wil.map"))
        assert f"trips {len(track.trips)} trips" in words

    def test_maps_are_merged_and_compacted(self, logs: Path, tmp_path: Path) -> None:
        every = sorted(logs.iterdir())
        for name, given in (("a", every[:2]), ("b", every[1:]), ("all", every)):
            assert self.run("map", "update", *given, "--map", tmp_path / f"{name}.map")[0] == 0
        one, other = tmp_path / "one.map", tmp_path / "other.map"
        parts = tmp_path / "a.map", tmp_path / "b.map"
        status, shown, _ = self.run("map", "merge", *parts, "-o", one)
        assert status == 0
        assert "the map holds 3 trips of 1 day" in shown
        assert self.run("map", "merge", tmp_path / "all.map", "-o", other)[0] == 0
        assert one.read_bytes() == other.read_bytes()
        status, shown, _ = self.run("map", "compact", one, "--before", "2100-01-01")
        assert (status, shown.splitlines()[0]) == (0, "3 recordings compacted")
        assert map_to_bytes(read_map(one)) == map_to_bytes(read_map(other))

    def test_it_imports_neither_pictures_nor_solvers(self, logs: Path, tmp_path: Path) -> None:
        code = (
            "import sys; from trainlog.cli.main import run;"
            f"run(['map', 'update', {str(logs)!r}, '--map', {str(tmp_path / 'a.map')!r}]);"
            "print(sorted({'matplotlib', 'cvxpy', 'casadi', 'filterpy'} & set(sys.modules)))"
        )
        shown = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True).stdout
        assert shown.splitlines()[-1] == "[]"
