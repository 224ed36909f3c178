"""Updates of a map as a service: several at once, killed, repeated, with bad and damaged logs."""

from __future__ import annotations

import json
import os
import re
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import killed_updaters
import pytest
from killed import in_own_process
from simulated_line import flirt, level_line
from test_traction_map import LINE
from trip_parts import without

import trainlog
from analysis import update_map
from analysis.adhesion.condition_map import adhesion_map, empty_map, naming_log
from trainlog import LogError, NotRecordedError, Trip, draw_scenarios, read_map, simulate
from trainlog.formats.mapfile import MapFile, Row, map_to_bytes
from trainlog.mcap import write_log
from trainlog.railway.evidence import DailyEvidence

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds", "analysed_once")

SHORT = level_line(5_000.0)

Content = tuple[str, list[Row], dict[str, DailyEvidence]]


def content(path: Path) -> Content:
    """All that a map is made from: its header, its rows, and the evidence of each layer."""
    with MapFile(path) as file:
        rows = file.trips()
        evidence = {name: each for name, (each, _) in file.summed(rows).evidence.items()}
        return repr(file.empty), rows, evidence


@pytest.fixture(scope="module")
def appended(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Of five updaters that begin one map at once and end, and of such that are killed."""
    folder = tmp_path_factory.mktemp("appended")
    return in_own_process("killed_updaters.append_by_all", folder, 5, (0, 6), (3, 8))[0]


class TestProcesses:
    def test_killed_updaters_lose_nothing_that_they_acknowledged(self, appended):
        """What killed processes had acknowledged must be there, once.

        Each was given recordings of its own, some that others were given, too, and recordings of
        one drive that replace each other.
        """
        found = appended[1]
        assert found["killed"] >= 3
        stated = [seed for one in found["stated"] for seed in one]
        assert len(set(stated)) > 1
        assert all(len(set(one)) == len(one) for one in found["stated"])
        path, again = Path(found["map"]), Path(found["map"]).with_name("again.map")
        with MapFile(path) as file:
            names = [row.known.name for row in file.trips()]
        assert len(set(names)) == len(names), "a trip is there twice"
        assert {f"trip-{seed}" for seed in stated} <= set(names), "an acknowledged trip is missing"
        # The map is that of the recordings which it holds, whatever happened on the way.
        with MapFile(again, empty_map(LINE)) as file:
            for name in sorted(names, reverse=True):
                file.append(killed_updaters.recording_of(int(name.removeprefix("trip-"))))
        assert content(path) == content(again)

    def test_updaters_that_begin_one_map_at_once_lose_nothing(self, appended):
        """Before, two at once lost a trip in ten of ten tries."""
        found = appended[0]
        assert (found["killed"], found["ended"]) == (0, 5)
        assert {len(one) for one in found["stated"]} == {12}
        names = {f"trip-{seed}" for one in found["stated"] for seed in one}
        assert len(names) == 5 * 6 + 6
        path = Path(found["map"])
        with MapFile(path) as file:
            assert sorted(row.known.name for row in file.trips()) == sorted(names)
        assert not list(path.parent.glob(".*"))


@pytest.fixture(scope="module")
def trips() -> list[Trip]:
    return [simulate(each) for each in draw_scenarios(SHORT, flirt(), 3, seed=1)]


@pytest.fixture(scope="module")
def written(trips: list[Trip], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder of three logs that came a while ago; not to be changed."""
    folder = tmp_path_factory.mktemp("logs")
    for trip in trips:
        write_log(trip, folder / f"{trip.name}.mcap")
        os.utime(folder / f"{trip.name}.mcap", (1_700_000_000, 1_700_000_000))
    return folder


@pytest.fixture(scope="module")
def updated(written: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map of the three logs; not to be changed."""
    path = tmp_path_factory.mktemp("updated") / "a.map"
    assert len(update_map(written, path).added) == 3
    return path


@pytest.fixture
def logs(written: Path, tmp_path: Path) -> Path:
    """The folder of three logs, and the test's own."""
    return Path(shutil.copytree(written, tmp_path / "logs"))


@pytest.fixture
def path(updated: Path, tmp_path: Path) -> Path:
    """The map of three logs, and the test's own."""
    return Path(shutil.copy(updated, tmp_path / "three.map"))


class TestCommandsAtOnce:
    @pytest.mark.long
    def test_killed_commands_lose_nothing_that_they_stated(self, logs, updated, tmp_path):
        """Five commands update one map from one folder at once: all are killed, then all end."""
        rounds, _ = in_own_process("killed_updaters.kill_and_update", tmp_path, logs, 5, 8)
        assert sum(found["killed"] for found in rounds) >= 20
        for found in rounds:
            added = re.findall(r"trip '([^']+)' added to", "\n".join(found["stated"]))
            assert added
            assert len(set(added)) == len(added), "a trip was stated as added twice"
            assert len(set(found["counted"])) == len(found["counted"]), "a trip is there twice"
            assert set(added) <= set(found["counted"]), "an acknowledged trip is missing"
            for status, shown, complaint in found["ended"]:
                assert (status, complaint) == (0, "")
                assert "the map holds 3 trips" in shown[-1]
            assert content(Path(found["map"])) == content(updated)


class TestUpdate:
    def test_the_map_is_that_of_all_logs_at_once(self, logs, updated, tmp_path):
        path = tmp_path / "a.map"
        for log in sorted(logs.iterdir(), reverse=True):
            assert len(update_map(log, path).added) == 1
        assert content(path) == content(updated)
        assert map_to_bytes(read_map(path)) == map_to_bytes(adhesion_map(logs).track)
        before = path.read_bytes()
        again = update_map(logs, path)
        assert again.sentence == "0 trips added, 3 held already; the map holds 3 trips of 1 day"
        assert path.read_bytes() == before

    def test_logs_that_have_not_changed_are_not_read(self, logs, tmp_path, monkeypatch):
        path = tmp_path / "a.map"
        update_map(logs, path)
        read: list[Path] = []
        monkeypatch.setattr(
            "analysis.adhesion.condition_map.sha256_of", lambda log: read.append(log) or "0" * 64
        )
        assert len(update_map(logs, path).of("held")) == 3
        assert read == []
        os.utime(logs / "trip-02.mcap", (1_700_000_001, 1_700_000_001))
        monkeypatch.undo()
        assert len(update_map(logs, path).of("held")) == 3

    def test_the_readable_part_of_a_damaged_log_counts_with_its_account(self, written, tmp_path):
        whole = (written / "trip-01.mcap").read_bytes()
        damaged = tmp_path / "damaged.mcap"
        damaged.write_bytes(whole[: 2 * len(whole) // 3])
        path = tmp_path / "a.map"
        with pytest.warns(trainlog.mcap.DamageWarning):
            found = update_map(damaged, path)
        assert "is damaged" in found.added[0].damage
        entry = read_map(path).trips[0]
        assert entry["damage"] == found.added[0].damage
        # The whole log, when it comes, counts in its place.
        found = update_map(written / "trip-01.mcap", path)
        assert found.added[0].replaced == ("trip-01",)
        assert map_to_bytes(read_map(path)) == map_to_bytes(
            adhesion_map(written / "trip-01.mcap").track
        )


class TestCommand:
    def test_a_layer_is_known_or_given_as_new_and_what_it_overrides_is_stated(
        self, written, tmp_path, shell, works
    ):
        log, path = written / "trip-01.mcap", tmp_path / "wil.map"
        recorded = trainlog.read(log).metadata["weather"]
        status, _, complaint = shell("map", "update", log, "--map", path, "--layer", "nass")
        assert status == 2
        assert "'nass' is not known; known: dry, wet, damp, " in complaint
        assert not path.exists()
        shown = works("map", "update", log, "--map", path, "--layer", "new:nass")
        assert f"added to 'nass', though it states '{recorded}'" in shown
        assert f"1 trip that states '{recorded}' counts as 'nass', as given" in shown
        # Then it is known, and what agrees with the log is no matter.
        other = tmp_path / "other.map"
        works("map", "update", log, "--map", path, "--layer", "nass")
        assert "states" not in shell("map", "update", log, "--map", other, "--layer", recorded)[1]

    def test_a_log_that_stays_bad_is_reported_once(self, logs, path, shell):
        """Every night the same folder: a mail on the first, and when something changes."""
        bad, words = logs / "bad.mcap", ("map", "update", logs, "--map", path)

        def give(data: bytes) -> None:
            bad.write_bytes(data)
            os.utime(bad, (1_700_000_000 + len(data), 1_700_000_000))

        give(b"anything at all")
        held = "0 trips added, 3 held already"
        status, shown, complaint = shell(*words)
        assert (status, shown) == (1, f"{held}, 1 refused; the map holds 3 trips of 1 day\n")
        assert "bad.mcap, byte 0: is not an MCAP file but text" in complaint
        before = f"{held}, 1 refused before (--retry states why); the map holds 3 trips of 1 day\n"
        assert shell(*words) == (0, before, "")
        bad.rename(logs / "moved.mcap")
        assert shell(*words) == (0, before, "")
        (logs / "moved.mcap").unlink()
        with MapFile(path) as file:
            assert not {"bad.mcap", "moved.mcap"} & {log.name for log in file.unchanged_logs()}
        give(b"")  # its content changes: reported again, once
        status, _, complaint = shell(*words)
        assert status == 1
        assert "bad.mcap, byte 0: is empty" in complaint
        assert shell(*words)[0] == 0
        assert shell(*words, "--retry")[0] == 1
        status, shown, _ = shell("map", "update", bad, "--map", path)
        assert (status, shown) == (0, before.replace(held, "0 trips added"))

    def test_a_train_that_never_records_axles_is_listed_and_fails_no_night(
        self, logs, trips, path, tmp_path, shell, works
    ):
        """Unlike a log whose axles may have been lost with its damage."""
        metadata = {**trips[0].metadata, "trip": "without", "train": "bare"}
        del metadata["weather"]  # the speeds that are missing go before the rail condition
        log = logs / "without.mcap"
        write_log(replace(without(trips[0], "/train/axles"), metadata=metadata), log)
        words = ("map", "update", logs, "--map", path)
        status, shown, complaint = shell(*words)
        assert (status, complaint) == (0, "")
        assert "1 refused before" in works(*words)
        status, shown, _ = shell(*words, "--retry", "--json")
        found = json.loads(shown)
        assert (status, found["not_recorded"], found["refused"]) == (0, 1, 0)
        assert {each["outcome"] for each in found["logs"]} == {"held", "not recorded"}
        for network in (False, True):
            place = tmp_path / ("maps" if network else "new.map")
            place.mkdir() if network else None
            assert shell("map", "update", log, "--map", place)[0] == 2, "there is no map"
            said = shell("map", "update", log, "--map", place, "-q")[2]
            assert said.startswith(f"trainlog: {place}: is not made: a map needs the speed of a")
            assert "1 without axle speeds" in works("map", "update", logs, "--map", place)
        # A topic that the log has, but that was not read, is another matter.
        missing = NotRecordedError("no such topic")
        for topic, kind in (("/train/axles", NotRecordedError), ("/train/controls", LogError)):
            missing.topic = topic
            with pytest.raises(LogError, match="no such topic") as caught, naming_log(log):
                raise missing
            assert type(caught.value) is kind
        data = log.read_bytes()
        (logs / "cut.mcap").write_bytes(data[: len(data) * 2 // 3])
        status, shown, complaint = shell(*words)
        assert (status, "1 refused," in shown) == (1, True)
        assert "cut.mcap: trip 'without' has no topic /train/axles" in complaint

    def test_maps_are_merged_and_compacted(self, written, path, tmp_path, works):
        every = sorted(written.iterdir())
        parts = tmp_path / "a.map", tmp_path / "b.map"
        shutil.copy(path, parts[0])
        with MapFile(parts[0]) as file:
            file.remove(["trip-03"])
        works("map", "update", *every[1:], "--map", parts[1])
        one, other = tmp_path / "one.map", tmp_path / "other.map"
        assert "the map holds 3 trips of 1 day" in works("map", "merge", *parts, "-o", one)
        works("map", "merge", path, "-o", other)
        assert one.read_bytes() == other.read_bytes()
        shown = works("map", "compact", one, "--before", "2100-01-01")
        assert shown.splitlines()[0] == "3 recordings compacted"
        rows, others = content(one), content(other)
        assert rows[2] == others[2]
        assert [row.entry for row in rows[1]] == [row.entry for row in others[1]]


def test_a_trip_that_is_added_without_evidence_is_named_with_the_reason(tmp_path, works):
    trip = trainlog.read(trainlog.sample("nonstop.mcap"))
    axles, controls = trip["/train/axles"], trip["/train/controls"]
    none = {name: 0.0 for name in axles if name.startswith("wheel_effort_")}
    efforts = controls.assign(tractive_effort=float("nan"))
    write_log(trip.with_topic(axles.assign(**none)).with_topic(efforts), tmp_path / "none.mcap")
    shown = works("map", "update", tmp_path / "none.mcap", "--map", tmp_path / "wil.map")
    assert ": no evidence; " in " ".join(shown.split())
    assert "the map holds 1 trip of 0 days" in shown
