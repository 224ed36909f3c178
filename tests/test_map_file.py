"""The file of a map: what it keeps, which recordings of a drive count, and damage to it."""

from __future__ import annotations

import sqlite3
from dataclasses import replace
from functools import cache
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from map_bytes import map_from_bytes, opened
from refusals import refused
from test_traction_map import LINE, WAY, Rail, piece

import trainlog
from analysis.adhesion.condition_map import empty_map, recording_of, update, update_map
from analysis.adhesion.evidence import Evidence
from trainlog import InputError, read_map, sample, write_map
from trainlog.formats.mapfile import (
    MapFile,
    map_to_bytes,
    merge_files,
    pack,
    place_of,
    unpack,
    unpack_joined,
    whole_file,
)
from trainlog.identity import TripIdentity
from trainlog.railway.condition import ConditionLayer

pytestmark = pytest.mark.usefixtures("remembered")

SAMPLE = sample("CH_StGallen_Wil.map")


def drive(first: int, last: int) -> TripIdentity:
    """A recording of the minutes from `first` to `last` of one drive."""
    start, end = (pd.Timestamp(60 * n, unit="s", tz="UTC") for n in (first, last + 1))
    return TripIdentity(
        start, end, 600 * (last - first + 1), np.arange(first, last + 1).astype("u8")
    )


def part(seed: int, first: int, last: int) -> Evidence:
    """A recording of a part of one drive."""
    return replace(piece(seed, "wet"), recorded=drive(first, last))


def given_to(path: Path, pieces: list[Evidence]) -> None:
    with MapFile(path, empty_map(LINE)) as file:
        for each in pieces:
            file.append(recording_of(each))


def bytes_of(path: Path) -> bytes:
    """`map_to_bytes(read_map(path))`, but no estimate is made."""
    with MapFile(path) as file:
        rows = file.trips()
        trips = sorted((row.entry_whole for row in rows if row.counted), key=place_of)
        given = {name: known for name, (known, _) in file.summed(rows).evidence.items()}
        layers = {name: ConditionLayer.unestimated(known) for name, known in given.items()}
        return whole_file(replace(file.empty, layers=layers, trips=tuple(trips)))


def merged(folder: Path, paths: list[Path]) -> bytes:
    folder.mkdir(exist_ok=True)
    output = folder / f"merged-{len(list(folder.iterdir()))}.map"
    merge_files(paths, output)
    return output.read_bytes()


@pytest.fixture(scope="module")
def nine(tmp_path_factory: pytest.TempPathFactory) -> tuple[list[Evidence], bytes]:
    """Recordings, of one drive some, of which some replace others; the bytes of their file."""
    folder = tmp_path_factory.mktemp("nine")
    pieces = [piece(i, ("dry", "wet")[i % 2]) for i in range(4)]
    pieces += [
        part(10 + i, *ends) for i, ends in enumerate([(0, 9), (5, 20), (12, 40), (0, 2), (41, 60)])
    ]
    given_to(folder / "all.map", pieces)
    expected = merged(folder, [folder / "all.map"])
    assert map_to_bytes(read_map(folder / "all.map")) == map_to_bytes(map_from_bytes(expected))
    return pieces, expected


class TestSet:
    @settings(max_examples=4)
    @given(
        order=st.permutations(range(9)), cuts=st.lists(st.integers(0, 9), min_size=2, max_size=2)
    )
    def test_any_order_grouping_and_division_into_files_gives_the_same_bytes(
        self, nine, order, cuts, tmp_path_factory
    ):
        """Recordings of one drive among them, of which some replace others."""
        pieces, expected = nine
        folder = tmp_path_factory.mktemp("maps")
        a, b = sorted(cuts)
        shuffled = [pieces[i] for i in order]
        paths = []
        for number, group in enumerate((shuffled[:a], shuffled[a:b], shuffled[b:])):
            # A recording may be given to several files.
            paths.append(folder / f"{number}.map")
            given_to(paths[-1], [*group, shuffled[0]])
        assert merged(folder, paths) == expected
        assert merged(folder, paths[::-1]) == expected
        pair = folder / "pair.map"
        merge_files(paths[:2], pair)
        assert merged(folder, [pair, paths[2]]) == expected

    def test_the_file_gives_the_map_that_is_made_in_memory(self, tmp_path):
        pieces = [piece(i, ("dry", "wet")[i % 2]) for i in range(6)]
        given_to(tmp_path / "a.map", pieces)
        known, _ = update(empty_map(LINE), pieces)
        assert bytes_of(tmp_path / "a.map") == map_to_bytes(known)
        assert map_to_bytes(read_map(tmp_path / "a.map")) == map_to_bytes(known)
        again = read_map(tmp_path / "a.map")
        assert map_to_bytes(again) == map_to_bytes(known), "with the estimate that was kept"
        np.testing.assert_array_equal(again.layer("wet").log_mean, known.layer("wet").log_mean)

    def test_a_trip_that_is_taken_out_leaves_the_map_that_never_had_it(self, tmp_path):
        pieces = [piece(1), piece(2), part(10, 0, 9), part(11, 0, 40)]
        given_to(tmp_path / "all.map", pieces)
        given_to(tmp_path / "never.map", [pieces[0], pieces[2]])
        with MapFile(tmp_path / "all.map") as file:
            assert file.amount()[0] == 3
            assert file.remove([pieces[1].trip, pieces[3].trip]) == 2
            assert file.amount()[0] == 2  # the shorter recording of the drive counts now
        assert bytes_of(tmp_path / "all.map") == bytes_of(tmp_path / "never.map")
        given_to(tmp_path / "all.map", [pieces[3], pieces[1]])
        given_to(tmp_path / "once.map", pieces)
        assert bytes_of(tmp_path / "all.map") == bytes_of(tmp_path / "once.map")

    def test_what_cannot_be_taken_out_changes_nothing(self, tmp_path):
        path = tmp_path / "a.map"
        given_to(path, [piece(1), piece(2)])
        with MapFile(path) as file:
            one = piece(1).trip
            refused(
                InputError, r"a\.map: the map has no trip 'nobody'", file.remove, [one, "nobody"]
            )
            file.compact(40_000)
            refused(InputError, "was compacted", file.remove, [one])
            assert file.amount()[0] == 2

    def test_a_log_in_two_layers_is_refused(self, tmp_path):
        given_to(tmp_path / "a.map", [piece(1, "dry")])
        given_to(tmp_path / "b.map", [piece(1, "wet")])
        with pytest.raises(InputError, match=r"counts trip 'trip-1' as 'wet', another .* as 'dry'"):
            merged(tmp_path, [tmp_path / "a.map", tmp_path / "b.map"])

    def test_maps_that_differ_are_not_merged_and_files_are_not_replaced(self, tmp_path):
        given_to(tmp_path / "a.map", [piece(1)])
        with MapFile(tmp_path / "b.map", empty_map(LINE, settings={"trip_std": 0.2})):
            pass
        a, b, c = (tmp_path / f"{name}.map" for name in "abc")
        refused(InputError, r"b\.map: .* differ in settings", merge_files, [a, b], c)
        refused(InputError, r"a\.map: exists already", merge_files, [b], a)
        refused(InputError, "no map was given", merge_files, [], c)
        assert not c.exists()


class TestCompaction:
    def test_the_map_stays_the_same(self, tmp_path):
        pieces = [piece(i, ("dry", "wet")[i % 2]) for i in range(8)]
        path = tmp_path / "a.map"
        given_to(path, pieces[:6])
        before = bytes_of(path)
        with MapFile(path) as file:
            assert file.compact(20_002) == 4
            assert file.compact(20_002) == 0
            assert file.amount() == (6, 3)
        assert bytes_of(path) == before
        given_to(path, pieces[6:])
        with MapFile(path) as file:
            assert file.compact(99_999) == 4
        given_to(tmp_path / "whole.map", pieces)
        assert bytes_of(path) == bytes_of(tmp_path / "whole.map")

    def test_the_latest_trips_of_each_condition_are_kept(self, tmp_path):
        """How many is decided by the trips that are there, not by how they came."""
        pieces = [
            replace(piece(i, ("dry", "wet")[i % 4 == 0]), recorded=drive(100 * i, 100 * i + 9))
            for i in range(18)
        ]
        summed = []
        for name, groups in (("once", [pieces]), ("twice", [pieces[5:], pieces[:5]])):
            path = tmp_path / f"{name}.map"
            for group in groups:
                given_to(path, group)
                with MapFile(path) as file:
                    file.compact(kept=4)
                    assert not file.beyond(4)
            with MapFile(path) as file:
                left = [row for row in file.trips() if row.evidence is None]
            summed.append(sorted(row.key for row in left))
            # Of 13 dry trips 8; of 5 wet ones none.
            assert [row.layer for row in left] == ["dry"] * 8
            assert max(row.start or 0 for row in left) < 100 * 12 * 60 * 10**9
        assert summed[0] == summed[1]
        given_to(tmp_path / "whole.map", pieces)
        assert bytes_of(tmp_path / "once.map") == bytes_of(tmp_path / "whole.map")
        assert bytes_of(tmp_path / "twice.map") == bytes_of(tmp_path / "whole.map")

    def test_sums_of_weeks_are_those_of_their_days(self, tmp_path):
        """Of old days; no sum changes, no day is dated before its evidence, none of late ones."""
        rail, path = Rail(5), tmp_path / "a.map"
        trips = [rail.trip(5 * number) for number in range(100)]
        with MapFile(path, empty_map(WAY)) as file:
            file.append_all([recording_of(each) for each in trips])
            days = file.summed(file.trips()).evidence["wet"][0]
            assert file.compact(kept=1) == 99
            assert file.compact(10**6) == 1
            (found,) = file.sums().values()
            assert file.contents()["wet"] == (100, days.days.tolist())
        newest = int(days.days[-1])
        np.testing.assert_array_equal(found.censored, days.censored)
        for name in ("trips", "events", "weight", "weighted_log", "weighted_square", "common"):
            np.testing.assert_allclose(found.by_bin(name), days.by_bin(name), rtol=1e-12)
        assert found.between(newest - 119, newest) == days.between(newest - 119, newest)
        old = found.days[found.days < newest - 120 - 7]
        assert np.all((old + 1) % 7 == 0)
        assert np.all((old[old < newest - 365 - 28] + 1) % 28 == 0)
        for day in (newest - 400, newest - 200):
            assert found.between(0, day).events.sum() <= days.between(0, day).events.sum()

    def test_a_log_is_still_known_and_its_drive_decided(self, tmp_path):
        path = tmp_path / "a.map"
        given_to(path, [part(1, 0, 9), part(2, 0, 20)])
        with MapFile(path) as file:
            file.compact(99_999)
            assert file.append(recording_of(part(1, 0, 9))).held
            assert file.append(recording_of(part(2, 0, 20))).held
            fuller = file.append(recording_of(part(3, 0, 40)))
        assert not fuller.counted
        assert "which is counted already" in fuller.reason
        assert [trip["trip"] for trip in read_map(path).trips] == ["trip-2"]

    def test_sums_that_share_a_drive_are_not_merged(self, tmp_path):
        for name, found in (("a", part(1, 0, 9)), ("b", part(1, 0, 9)), ("c", part(2, 0, 20))):
            given_to(tmp_path / f"{name}.map", [found])
            with MapFile(tmp_path / f"{name}.map") as file:
                file.compact(99_999)
        given_to(tmp_path / "d.map", [part(1, 0, 9), part(3, 0, 30)])
        a, b, c, d = (tmp_path / f"{name}.map" for name in "abcd")
        said = "trip 'trip-1' in its sums, and so has another"
        refused(InputError, said, merged, tmp_path, [a, b])
        refused(InputError, "the sums of several maps hold one drive", merged, tmp_path, [a, c])
        both = map_from_bytes(merged(tmp_path / "out", [a, d]))
        assert [trip["trip"] for trip in both.trips] == ["trip-1"]
        assert merged(tmp_path / "out", [d, a]) == merged(tmp_path / "out", [a, d])


@pytest.fixture(scope="module")
def without_estimates(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of a file that processes add to and none has read: most of them are evidence."""
    path = tmp_path_factory.mktemp("good") / "a.map"
    given_to(path, [piece(i, ("dry", "wet")[i % 2]) for i in range(6)] + [part(9, 0, 9)])
    return path.read_bytes()


@pytest.fixture(scope="module")
def good(without_estimates: bytes, tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """The bytes of that file with the estimate that a reader kept."""
    path = put(tmp_path_factory.mktemp("good") / "a.map", without_estimates)
    read_map(path)
    return path.read_bytes()


def changed(path: Path, words: str, *values: object) -> int:
    """Change a database by a statement; how many rows that concerned."""
    database = sqlite3.connect(path)
    count = database.execute(words, values).rowcount
    database.commit()
    database.close()
    return count


class TestDamage:
    """Never another map, and never a traceback: the same map, or one line that names the file."""

    @staticmethod
    @cache
    def content(data: bytes) -> object:
        """All that a map is made from."""
        with pytest.MonkeyPatch.context() as patch, opened(data, "f.map") as file:
            # Whether trips agree follows from their evidence, and takes longer than to read it.
            patch.setattr("trainlog.condition.reconciled", lambda *_, **__: None)
            trips = file.trips()
            layers = file.summed(trips).evidence
            return repr(file.empty), trips, {name: known for name, (known, _) in layers.items()}

    def check(self, data: bytes, good: bytes) -> bool:
        """Whether the data are refused; else they must give the good map."""
        try:
            found = self.content(data)
        except InputError as error:
            message = str(error)
        else:
            assert found == self.content(good)
            return False
        assert "f.map" in message
        assert "\n" not in message
        return True

    def test_changed_bytes(self, good, without_estimates):
        rng = np.random.default_rng(1)
        found = 0
        for whole in (good, without_estimates):
            for place in rng.choice(len(whole), 50, replace=False):
                data = bytearray(whole)
                data[place] ^= 1 << int(rng.integers(8))
                found += self.check(bytes(data), whole)
        assert found > 5

    def test_truncation(self, good):
        for end in range(0, len(good) - 1, 2_039):
            # Of the last page an end that holds nothing may be missing.
            assert self.check(good[:end], good) or end > len(good) - 4_096

    def test_pages_of_zeros_and_of_another_place(self, good):
        for start in range(0, len(good), 4_096):
            assert self.check(good[:start] + bytes(4_096) + good[start + 4_096 :], good) or start
            data = good[:start] + good[:4_096] + good[start + 4_096 :]
            assert self.check(data, good) or data == good or start

    def test_rows_that_were_changed_or_removed_by_hand(self, good, tmp_path):
        for number, (words, message) in enumerate((
            ("DELETE FROM trips WHERE key LIKE '%3'", "entries are missing"),
            ("DELETE FROM trips", "entries are missing"),
            ("UPDATE trips SET layer = 'leaves' WHERE layer = 'wet'", "its entry was changed"),
            ("UPDATE trips SET counted = 0", "its entry was changed"),
            ("UPDATE trips SET entry = x'00'", "its entry was changed"),
            ("UPDATE trips SET identity = 7 WHERE identity IS NOT NULL", "its entry was changed"),
            ("UPDATE header SET value = '\"far\"' WHERE key = 'line'", "its header was changed"),
            ("DELETE FROM header WHERE key = 'levels'", "database: is damaged"),
            ("DELETE FROM evidence", r"evidence [0-9a-f]{16}: is damaged"),
            ("UPDATE evidence SET data = (SELECT max(data) FROM evidence)", "its checksum fails"),
            ("DROP TABLE trips", "no such table: trips"),
        )):  # fmt: skip
            path = put(tmp_path / f"{number}.map", good)
            changed(path, words)
            with pytest.raises(InputError, match=message) as caught:
                read_map(path)
            assert "build the map anew from the logs" in str(caught.value)

    def test_an_estimate_that_was_changed_is_made_again(self, good, tmp_path):
        for number, data in enumerate((b"", b"x" * 40)):
            path = put(tmp_path / f"{number}.map", good)
            assert changed(path, "UPDATE estimates SET data = ?", data) == 2
            found, expected = (each.layer("wet") for each in (read_map(path), map_from_bytes(good)))
            np.testing.assert_array_equal(found.log_mean, expected.log_mean)


class TestOtherFiles:
    def refused(self, path: Path) -> str:
        with pytest.raises(InputError) as caught:
            read_map(path)
        assert str(caught.value).startswith(str(path))
        return str(caught.value)

    def test_each_is_named_with_the_remedy(self, tmp_path):
        path = tmp_path / "a.map"
        assert "does not exist" in self.refused(path)
        for data, message in (
            (b"", "is empty; build the map anew from the logs: trainlog map update LOGS"),
            (b'{"format": "trainlog/condition", "version": 1}', "of an earlier version (JSON)"),
            (b'{"format": "trainlog/line"}', "is not a track-condition map but a trainlog/line"),
            (b"\x89MCAP0\r\n", "is not a track-condition map but a log (MCAP)"),
            (b"PAR1", "but a Parquet file"),
            (b"anything", "is not a track-condition map; name a map that"),
        ):
            path.write_bytes(data)
            assert message in self.refused(path)
        path.unlink()
        path.mkdir()
        assert "is a folder" in self.refused(path)

    def test_a_database_of_something_else(self, tmp_path):
        path = tmp_path / "a.map"
        changed(path, "CREATE TABLE messages (data BLOB)")
        before = path.read_bytes()
        assert "is an SQLite database, but has no track-condition map" in self.refused(path)
        refused(InputError, "has no track-condition map", MapFile, path, empty_map(LINE))
        assert path.read_bytes() == before

    def test_a_newer_version(self, tmp_path):
        path = put(tmp_path / "a.map", SAMPLE.read_bytes())
        changed(path, "PRAGMA user_version = 2")
        assert self.refused(path).endswith(
            "follows version 2 of the format of maps, this trainlog knows 1; update trainlog"
        )

    def test_a_map_given_for_a_log_or_for_json_is_named(self):
        with pytest.raises(trainlog.LogError, match="not an MCAP file but a track-condition map"):
            trainlog.read(SAMPLE)
        refused(InputError, "is not JSON but a track-condition map", trainlog.read_line, SAMPLE)

    def test_reading_changes_no_file_that_was_written_whole(self, tmp_path):
        path = tmp_path / "a.map"
        write_map(update(empty_map(LINE), [piece(1)])[0], path)
        before = path.read_bytes()
        read_map(path)
        assert path.read_bytes() == before
        given_to(path, [piece(2)])
        read_map(path)
        size = path.stat().st_mtime_ns
        read_map(path)
        assert path.stat().st_mtime_ns == size, "the estimate is kept once"


class TestPacked:
    @settings(max_examples=40)
    @given(
        st.lists(st.integers(-(2**62), 2**62), max_size=20),
        st.lists(st.floats(), max_size=20),
        st.lists(st.booleans(), max_size=20),
    )
    def test_arrays_survive_to_the_last_bit(self, whole, real, true):
        arrays = {
            "whole": np.array(whole, dtype=np.int64),
            "real": np.array(real, dtype=np.float64),
            "true": np.array(true, dtype=np.bool_),
            "rows": np.array([real, real], dtype=np.float64),
        }
        facts, found = unpack(pack({"a": [1, "b"]}, arrays))
        assert facts == {"a": [1, "b"]}
        for name, array in arrays.items():
            assert found[name].dtype == array.dtype
            assert found[name].shape == array.shape
            assert found[name].tobytes() == array.tobytes()

    @settings(max_examples=40)
    @given(
        st.lists(
            st.lists(st.one_of(st.integers(-3, 300), st.integers(-(2**50), 2**50)), max_size=6),
            min_size=1,
            max_size=6,
        )
    )
    def test_arrays_of_many_are_joined(self, lists):
        kept = [
            {
                "whole": np.array(each, dtype=np.int64),
                "in order": np.sort(np.array(each, dtype=np.int64)),
                "real": np.array(each, dtype=np.float64) / 3.0,
                "one": np.full(len(each), float(len(each))),
            }
            for each in lists
        ]
        facts, found = unpack_joined([pack({"n": n}, each) for n, each in enumerate(kept)])
        assert facts == [{"n": n} for n in range(len(lists))]
        for name in kept[0]:
            expected = np.concatenate([each[name] for each in kept])
            assert found[name].dtype == expected.dtype
            assert found[name].tobytes() == expected.tobytes()


def test_a_trip_in_memory_is_no_log_of_a_map(tmp_path):
    trip = trainlog.read(sample("nonstop.mcap"))
    for each in (trip, [trip]):
        refused(InputError, "is updated from logs", update_map, each, tmp_path / "own.map")
