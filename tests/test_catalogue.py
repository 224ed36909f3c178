"""The catalogue of a fleet, on SQLite and on PostgreSQL: what it registers, answers and keeps."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pandas as pd
import pyarrow as pa
import pytest

import trainlog
from trainlog.catalogue import Catalogue, ResultOutcome, open_catalogue
from trainlog.errors import InputError

SAMPLES = Path("sample_logs")

Opener = Callable[..., Catalogue]


@pytest.fixture(params=["sqlite", "postgresql"])
def where(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Callable[[], Catalogue]]:
    """Opens the catalogue of a test, on each database; the same one each time."""
    opened: list[Catalogue] = []
    place: str | Path = tmp_path / "catalogue"
    if request.param == "postgresql":
        place = request.getfixturevalue("postgresql_place")

    def opener() -> Catalogue:
        opened.append(open_catalogue(place, results=_results(place, tmp_path)))
        return opened[-1]

    yield opener
    for each in opened:
        each.close()


def _results(place: str | Path, folder: Path) -> Path | None:
    return folder / "results" if isinstance(place, str) else None


@pytest.fixture
def logs(tmp_path: Path) -> Path:
    """A folder of three logs: two drives, and a part of one of them."""
    folder = tmp_path / "logs"
    (folder / "deep").mkdir(parents=True)
    shutil.copy(SAMPLES / "nonstop.mcap", folder)
    shutil.copy(SAMPLES / "stopping.mcap", folder / "deep")
    trip = trainlog.read(SAMPLES / "stopping.mcap")
    trainlog.write(trip.between(None, "2024-10-07T08:10"), folder / "part.mcap")
    return folder


def test_files_are_registered_once_and_the_fullest_recording_of_a_drive_counts(
    where: Callable[[], Catalogue], logs: Path
) -> None:
    catalogue = where()
    first, again = catalogue.add(logs), catalogue.add(logs)
    assert [each.state for each in first.outcomes] == ["new"] * 3
    assert [each.state for each in again.outcomes] == ["known"] * 3
    found = catalogue.query()
    assert found["name"].tolist() == ["trip-01", "trip-03"]
    assert found["path"].tolist()[1] == str(logs / "deep" / "stopping.mcap")
    assert catalogue.counts()["other recordings"] == 1
    trip = trainlog.read(SAMPLES / "stopping.mcap")
    row = found.iloc[1]
    assert (row["start"], row["end"], row["duration"]) == (trip.start, trip.end, trip.duration)
    assert row["topics"] == {name: len(frame) for name, frame in trip.topics.items() if len(frame)}
    assert catalogue.open(row) == trip


def test_a_moved_file_is_found_again_and_nothing_is_pending(
    where: Callable[[], Catalogue], logs: Path
) -> None:
    catalogue = where()
    catalogue.add(logs)
    todo = catalogue.pending("stops", "1")
    _record(catalogue, todo)
    (logs / "nonstop.mcap").rename(logs / "deep" / "elsewhere.mcap")
    added = catalogue.add(logs)
    assert [each.path for each in added.of("moved")] == [str(logs / "deep" / "elsewhere.mcap")]
    assert catalogue.query()["path"].tolist()[0] == str(logs / "deep" / "elsewhere.mcap")
    assert len(catalogue.pending("stops", "1")) == 0


def test_another_content_under_a_name_is_a_new_version_that_is_computed_again(
    where: Callable[[], Catalogue], logs: Path
) -> None:
    catalogue = where()
    catalogue.add(logs)
    _record(catalogue, catalogue.pending("stops", "1"))
    trip = trainlog.read(logs / "nonstop.mcap")
    heavier = replace(trip, metadata={**trip.metadata, "load": "40000"})
    trainlog.write(heavier, logs / "nonstop.mcap")
    assert [each.state for each in catalogue.add(logs).outcomes].count("version") == 1
    assert catalogue.query("load > '30 t'")["name"].tolist() == ["trip-01"]
    assert len(catalogue) == 2
    todo = catalogue.pending("stops", "1")
    assert todo["path"].tolist() == [str(logs / "nonstop.mcap")]
    assert len(catalogue.results("stops")) == 2
    _record(catalogue, todo, stops=7)
    assert sorted(catalogue.results("stops")["stops"]) == [1, 1, 7, 7]


def test_results_are_recorded_once_and_merged_in_the_order_of_trip(
    where: Callable[[], Catalogue], logs: Path
) -> None:
    catalogue, other = where(), where()
    catalogue.add(logs)
    todo = catalogue.pending("stops", "1", {"limit": 2.5})
    assert todo["key"].is_monotonic_increasing
    assert _record(catalogue, todo.iloc[[1]], {"limit": 2.5}) == 1
    assert _record(other, todo, {"limit": 2.5}, stops=99) == 1, "one of them was recorded before"
    assert len(other.pending("stops", "1", {"limit": 2.5})) == 0
    assert len(other.pending("stops", "2", {"limit": 2.5})) == 2
    assert len(other.pending("stops", "1", {"limit": 2.0})) == 2
    found = catalogue.results("stops")
    assert found["stops"].tolist() == [99, 99, 1, 1]
    assert found["key"].tolist() == [key for key in todo["key"] for _ in range(2)]
    assert set(found) == {"key", "stops", "train", "kind", "line", "start"}
    assert catalogue.compact("stops") == 2
    pd.testing.assert_frame_equal(other.results("stops"), found)
    files = list((catalogue.results_folder / "stops").iterdir())
    assert len(files) == 1


def test_a_table_that_does_not_hold_what_its_outcomes_state_is_refused(
    where: Callable[[], Catalogue], logs: Path
) -> None:
    catalogue = where()
    catalogue.add(logs)
    todo = catalogue.pending("stops", "1")
    outcomes = [ResultOutcome(row.key, row.sha256, rows=1) for row in todo.itertuples()]
    with pytest.raises(InputError, match="rows of trip"):
        catalogue.record("stops", "1", {}, outcomes, pa.table({"key": [todo["key"][0]]}))
    assert len(catalogue.pending("stops", "1")) == 2


def _record(
    catalogue: Catalogue,
    todo: pd.DataFrame,
    parameters: dict[str, float] | None = None,
    stops: int = 1,
) -> int:
    """Record two rows of each trip."""
    keys = [key for key in todo["key"] for _ in range(2)]
    table = pa.table({"key": keys, "stops": [stops] * len(keys)})
    done = [ResultOutcome(row.key, row.sha256, rows=2) for row in todo.itertuples()]
    return catalogue.record("stops", "1", parameters, done, table)
