"""Logs as folders of Parquet files and back, whole and in part."""

import csv
import json
import warnings
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pandas as pd
import pyarrow.parquet as pq
import pytest
from hypothesis import example, given, settings, strategies as st
from mcap.reader import make_reader
from refusals import refused

import trainlog
from tests.foreign_logs import json_log
from tests.mcap_trips import START, assert_same, trip_of, trips
from trainlog.cli.options import stretch, times
from trainlog.errors import InputError, LogError
from trainlog.formats import trip_tables
from trainlog.formats.trip_tables import CsvTripIndex, folder_writer, read_parquet, write_parquet
from trainlog.mcap import DamageWarning, convert as module, read_log, write_log
from trainlog.mcap.convert import convert, merge, span_of
from trainlog.topics import EVENTS, GNSS_FIX, TOPICS, TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip, frame_of

FOREIGN = Path(__file__).parents[2] / "shared" / "data" / "foreign_mcap"


@pytest.fixture(autouse=True)
def small_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "ROWS", 400)


def logged(folder: Path, topics: list[str]) -> Path:
    trip = trip_of(rows=200, topics=topics)
    position = 1000.0 + np.arange(200) * 10.0
    state = frame_of(TRAIN_STATE, trip[TRAIN_STATE.name].index, {"position": position})
    write_log(trip.with_topic(state), folder / "trip.mcap")
    return folder / "trip.mcap"


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return logged(tmp_path, [TRAIN_STATE.name, TRAIN_AXLES.name, GNSS_FIX.name, EVENTS.name])


@pytest.mark.parametrize("suffix", [".parquet", ".csv"])
def test_a_log_goes_to_tables_and_back_without_losing_a_byte(suffix, tmp_path):
    log = logged(tmp_path, [name for name in TOPICS if name != "/estimates/state"])
    folder = tmp_path / f"trip{suffix}"
    done = convert(log, folder)
    trip = read_log(log)
    assert_same(trip, read_parquet(folder))
    assert span_of(log) == span_of(folder) == (trip.start, trip.end)
    assert done.rows[TRAIN_STATE.name] == 200
    convert(folder, tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == log.read_bytes()


def test_a_log_goes_to_mdf_and_back(log, tmp_path):
    library = pytest.importorskip("asammdf")
    done = convert(log, tmp_path / "trip.mf4")
    assert done.rows[TRAIN_STATE.name] == 200
    trip = read_log(log)
    with library.MDF(tmp_path / "trip.mf4") as mdf:
        signal = mdf.get("position", group=next(iter(mdf.channels_db["position"]))[0])
    assert signal.unit == "m"
    assert signal.samples.tolist() == trip[TRAIN_STATE.name]["position"].tolist()
    convert(tmp_path / "trip.mf4", tmp_path / "again.mcap")
    assert (tmp_path / "again.mcap").read_bytes() == log.read_bytes()
    convert(tmp_path / "trip.mf4", tmp_path / "part.mcap", position=(1205.0, 1555.0))
    assert_same(trip.within(1205.0, 1555.0), read_log(tmp_path / "part.mcap"))
    assert span_of(tmp_path / "trip.mf4") == span_of(log)


def test_a_text_that_mdf_would_cut_is_refused(tmp_path):
    """At the character NUL, which ends a text there; Parquet keeps it."""
    pytest.importorskip("asammdf")
    events = {"level": [2], "name": ["note"], "message": ["a\x00b"]}
    write_log(Trip({EVENTS.name: frame_of(EVENTS, [START], events)}), tmp_path / "trip.mcap")
    with pytest.raises(LogError, match=r"trip\.mf4: /events has a text with the character NUL"):
        convert(tmp_path / "trip.mcap", tmp_path / "trip.mf4")
    assert not (tmp_path / "trip.mf4").exists()
    convert(tmp_path / "trip.mcap", tmp_path / "trip.parquet")
    assert read_parquet(tmp_path / "trip.parquet")[EVENTS.name]["message"].tolist() == ["a\x00b"]


def test_a_measurement_file_that_is_none_or_of_others_is_refused(tmp_path):
    library = pytest.importorskip("asammdf")
    (tmp_path / "cut.mf4").write_bytes(b"MDF     4.10")
    with pytest.raises(InputError, match="is not a readable measurement file"):
        convert(tmp_path / "cut.mf4", tmp_path / "again.mcap")
    mdf = library.MDF(version="4.10")
    mdf.append([library.Signal(np.arange(3.0), np.arange(3.0), name="v", unit="m/s")])
    mdf.save(tmp_path / "other.mf4")
    mdf.close()
    with pytest.raises(InputError, match="is a measurement file of another program; 'trainlog ing"):
        convert(tmp_path / "other.mf4", tmp_path / "again.mcap")
    assert not (tmp_path / "again.mcap").exists()


FORMULAS = ("=1+1", "'=x", "''=x", "-5", "'s", "\t=a", "\r@a", "+49", "@b", "-")

CELLS = st.fixed_dictionaries(
    {
        "speed": st.floats(width=64),
        "message": st.text(st.characters(codec="utf-8", exclude_characters="\0"))
        | st.sampled_from(FORMULAS),
        "level": st.integers(0, 5),
    }
)


@given(st.lists(CELLS, min_size=1, max_size=20), st.integers(0, 2**62))
@settings(max_examples=12)
def test_whatever_a_cell_holds_comes_back_from_csv(rows, start):
    time = start + np.arange(len(rows))
    words = {name: [row[name] for row in rows] for name in ("level", "message")}
    state = frame_of(TRAIN_STATE, time, {"speed": [row["speed"] for row in rows]})
    trip = Trip({TRAIN_STATE.name: state, EVENTS.name: frame_of(EVENTS, time, words)})
    with TemporaryDirectory() as parent:
        with folder_writer(Path(parent) / "trip.csv", CsvTripIndex) as writer:
            writer.add(trip)
        found = read_parquet(Path(parent) / "trip.csv")
        with (Path(parent) / "trip.csv" / "events.csv").open(encoding="utf-8", newline="") as file:
            cells = [row["message"] for row in csv.DictReader(file)]
    assert found == trip
    # No spreadsheet program takes a text for a formula.
    assert not any(cell.startswith(("=", "+", "-", "@", "\t", "\r")) for cell in cells)
    speeds = found[TRAIN_STATE.name].speed.to_numpy(), trip[TRAIN_STATE.name].speed.to_numpy()
    assert np.array_equal(np.signbit(speeds[0]), np.signbit(speeds[1]) & ~np.isnan(speeds[1]))


DAMAGE = {
    "fast": (b",1010,", b",fast,", "CSV conversion error to double"),
    "unsorted": (b"22:13:21", b"21:13:21", r"row \d+: time runs backwards; sort the rows"),
    "another column": (b'"position [m]"', b'"place [m]"', "has no column position; it has time, p"),
}


@pytest.mark.parametrize("case", DAMAGE)
def test_a_csv_file_that_was_damaged_is_named(case, log, tmp_path):
    convert(log, tmp_path / "trip.csv")
    file = tmp_path / "trip.csv" / "train_state.csv"
    old, new, problem = DAMAGE[case]
    file.write_bytes(file.read_bytes().replace(old, new, 1))
    caught = refused(LogError, problem, convert, tmp_path / "trip.csv", tmp_path / "again.mcap")
    assert caught.file == file
    assert not (tmp_path / "again.mcap").exists()


def damage(path: Path, chunks: slice) -> None:
    data = bytearray(path.read_bytes())
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    for index in sorted(summary.chunk_indexes, key=lambda each: each.chunk_start_offset)[chunks]:
        data[index.chunk_start_offset + index.chunk_length - 5] ^= 0xFF
    path.write_bytes(data)


@pytest.mark.parametrize("suffix", [".mcap", ".parquet"])
@pytest.mark.parametrize("foreign", [False, True])
def test_a_log_without_one_readable_message_is_refused(suffix, foreign, tmp_path):
    source = tmp_path / "log.mcap"
    if foreign:
        json_log(source, "/things", [{"x": 1}])
    else:
        write_log(trip_of(rows=20), source)
    damage(source, slice(None))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", DamageWarning)
        with pytest.raises((LogError, InputError)) as caught:
            convert(source, tmp_path / f"made{suffix}")
    assert caught.value.file == source
    assert list(tmp_path.iterdir()) == [source]


@pytest.mark.parametrize(
    ("target", "part", "error", "said"),
    [
        ("part.mcap", {"position": (9e6, None)}, LogError, "nothing of the part asked for; see"),
        ("part.mcap", {"topics": ["/mood"]}, LogError, "has no topic /mood; it holds"),
        ("part.zip", {}, InputError, r"end it in .mcap, .mf4, .parquet or .csv"),
        ("trip.mcap", {}, InputError, "would be overwritten"),
    ],
)
def test_what_cannot_be_converted_leaves_nothing_behind(target, part, error, said, log):
    before = log.read_bytes()
    refused(error, said, convert, log, log.parent / target, **part)
    assert list(log.parent.iterdir()) == [log]
    assert log.read_bytes() == before


@pytest.mark.skipif(not FOREIGN.exists(), reason="the files of other programs are not here")
def test_logs_of_other_programs_become_parquet(tmp_path):
    source = FOREIGN / "rosbag2_py_test_resources_mcap_talker_talker.mcap"
    done = convert(source, tmp_path / "talker.parquet")
    talk = pd.read_parquet(tmp_path / "talker.parquet" / "topic.parquet")
    assert talk["data"].iloc[0].startswith("Hello")
    assert done.rows["/topic"] == len(talk) > 0
    with pytest.raises(InputError, match=r"log of another program.*ingest"):
        convert(source, tmp_path / "talker.mcap")
    with pytest.raises(InputError, match="where the train was is not known"):
        convert(source, tmp_path / "part.parquet", position=(0.0, 1.0))
    assert list(tmp_path.iterdir()) == [tmp_path / "talker.parquet"]


FIRST, LAST = pd.Timestamp("2024-05-01T06:00:00Z"), pd.Timestamp("2024-05-01T07:00:00Z")


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("2024-05-01T06:10:00Z", FIRST + pd.Timedelta(minutes=10)),
        ("2024-05-01 06:10", FIRST + pd.Timedelta(minutes=10)),
        ("2024-05-01T08:10:00+02:00", FIRST + pd.Timedelta(minutes=10)),
        ("10s", FIRST + pd.Timedelta(seconds=10)),
        ("start+1.5min", FIRST + pd.Timedelta(seconds=90)),
        ("250ms", FIRST + pd.Timedelta(milliseconds=250)),
        ("end-5min", LAST - pd.Timedelta(minutes=5)),
        ("end", LAST),
        ("start", FIRST),
        ("1h", LAST),
    ],
)
def test_times_are_absolute_or_relative_to_the_log(word, meant):
    assert times(word, None, lambda: (FIRST, LAST)) == (meant, None)
    assert times(None, word, lambda: (FIRST, LAST)) == (None, meant)


def test_words_that_are_no_time_are_refused():
    for word in ("soon", "10", "end+5s", "start-5s", "-5s", "5 parsec", ""):
        refused(InputError, "is not a time; write it as", times, word, None, lambda: (FIRST, LAST))
    for word in ("99999999999h", "end-3000000h"):
        said = "is further than time stamps reach; the log begins"
        refused(InputError, said, times, word, None, lambda: (FIRST, LAST))
    refused(InputError, "has no rows", times, "10s", None, lambda: None)


def test_stretches_are_kilometres():
    assert stretch("3.2:7.5") == (3200.0, 7500.0)
    assert stretch("3:") == (3000.0, None)
    assert stretch(":7.5") == (None, 7500.0)
    assert stretch("3.2 km:7500m") == (3200.0, 7500.0)
    for wrong in ("3.2", "a:b", "1:2:3", "", "nan:3", "1:inf"):
        refused(InputError, "(section of the line in km|valid kilometre); write", stretch, wrong)


@pytest.mark.parametrize("suffix", [".mcap", pytest.param(".parquet", marks=pytest.mark.long)])
def test_what_a_damaged_log_lost_stays_with_what_is_made_of_it(suffix, log, tmp_path):
    """Also where it shows only on the way: the last chunk of several fails its checksum."""
    trip, minutes = read_log(log), {}
    for name, frame in trip.topics.items():
        parts = [frame.set_axis(frame.index + pd.Timedelta(minutes=2 * k)) for k in range(4)]
        minutes[name] = pd.concat(parts)
        minutes[name].attrs = frame.attrs
    long = tmp_path / "long.mcap"
    write_log(Trip(minutes, trip.metadata, trip.provenance), long)
    damage(long, slice(-1, None))
    with pytest.warns(DamageWarning) as caught:
        convert(long, tmp_path / f"made{suffix}")
    account = caught[0].message.account
    made = (read_log if suffix == ".mcap" else read_parquet)(tmp_path / f"made{suffix}")
    step = made.provenance[-1]
    assert step["step"] == "read damaged log"
    assert step["account"] == account.details()
    rows = sum(len(frame) for frame in made.topics.values())
    assert step["account"]["messages"] == rows == account.messages
    whole = sum(len(frame) for frame in minutes.values())
    assert step["account"]["messages_lost"] == whole - rows > 0


STATE = TRAIN_STATE.name


@pytest.fixture
def whole() -> Trip:
    return trip_of(rows=200, topics=[STATE, GNSS_FIX.name, EVENTS.name])


def written(trip: Trip, path: Path) -> Path:
    write_log(trip, path)
    return path


@pytest.mark.parametrize(("cuts", "order"), [((0.5,), 1), ((0.2, 0.21, 0.9), -1)])
def test_parts_in_any_order_are_the_whole(cuts, order, whole, tmp_path):
    """Each instant of a cut is in both parts, and once in the whole."""
    length = whole.end - whole.start
    edges = [None, *(whole.start + share * length for share in cuts), None]
    pieces = [whole.between(*ends) for ends in pairwise(edges)]
    parts = [written(each, tmp_path / f"{n}.mcap") for n, each in enumerate(pieces)][::order]
    done = merge(parts, tmp_path / "whole.mcap")
    found = read_log(tmp_path / "whole.mcap")
    assert found == whole
    assert done.rows == {name: len(frame) for name, frame in whole.topics.items()}
    step = found.provenance[-1]
    assert step["step"] == "merge"
    assert len(step["inputs"]) == len(parts)
    assert [each["file"] for each in step["others"]] == [path.name for path in parts[1:]]


def test_topics_of_several_recorders_come_together(whole, tmp_path):
    axles = trip_of(rows=150, topics=[TRAIN_AXLES.name, EVENTS.name])
    second = Trip(axles.topics, whole.metadata | {"clock": "another"}, ({"step": "its own"},))
    paths = [written(whole, tmp_path / "a.mcap"), written(second, tmp_path / "b.mcap")]
    merge(paths, tmp_path / "both.mcap")
    found = read_log(tmp_path / "both.mcap")
    assert found[STATE].equals(whole[STATE])
    assert found[TRAIN_AXLES.name].equals(axles[TRAIN_AXLES.name])
    every = pd.concat([whole[EVENTS.name], axles[EVENTS.name]]).reset_index().drop_duplicates()
    assert len(found[EVENTS.name]) == len(every)
    assert found.metadata["clock"] == whole.metadata.get("clock", "another")
    (other,) = found.provenance[-1]["others"]
    assert other["provenance"] == [{"step": "its own"}]
    assert other["metadata"]["clock"] == "another"


def test_different_samples_of_a_topic_are_refused_or_one_log_is_preferred(whole, tmp_path):
    state = whole[STATE].copy()
    state["speed"] = state["speed"] + 1.0
    other = replace(whole.with_topic(state), provenance=())
    paths = [written(whole, tmp_path / "a.mcap"), written(other, tmp_path / "b.mcap")]
    with pytest.raises(LogError, match=r"b.mcap: holds other samples of /train/state than .*a.mca"):
        merge(paths, tmp_path / "both.mcap")
    assert not (tmp_path / "both.mcap").exists()
    for path, trip in zip(paths, (whole, other), strict=True):
        done = merge(paths, tmp_path / "both.mcap", prefer=path)
        found = read_log(tmp_path / "both.mcap")[STATE]
        assert_same(Trip({STATE: found}), Trip({STATE: trip[STATE]}))
        assert done.left_out[STATE] + done.repeated[STATE] == 200
        assert done.left_out[STATE] > 100


def test_logs_of_two_trips_are_refused(whole, tmp_path):
    for key in ("train", "line", "direction"):
        first = replace(whole, metadata=whole.metadata | {key: "one"})
        second = replace(whole, metadata=whole.metadata | {key: "two"})
        paths = [written(first, tmp_path / "a.mcap"), written(second, tmp_path / "b.mcap")]
        with pytest.raises(LogError, match=f"states {key} 'two', .*a.mcap states 'one'"):
            merge(paths, tmp_path / "both.mcap")
    refused(InputError, "name two logs at least", merge, paths[:1], tmp_path / "both.mcap")
    refused(InputError, "given twice", merge, [paths[0], paths[0]], tmp_path / "both.mcap")
    refused(InputError, "would be overwritten", merge, paths, paths[0])


def test_what_logs_disagree_on_is_left_out_and_attachments_are_kept(whole, tmp_path):
    first = replace(whole, metadata=whole.metadata | {"load": "1000"}, attachments={"n": b"1"})
    second = Trip({}, {"load": "2000"}, (), {"n": b"2", "m": b"3"})
    paths = [written(first, tmp_path / "a.mcap"), written(second, tmp_path / "b.mcap")]
    done = merge(paths, tmp_path / "both.mcap")
    found = read_log(tmp_path / "both.mcap")
    assert "load" not in found.metadata
    assert found.attachments == {"n": b"1", "b/n": b"2", "m": b"3"}
    assert done.notes == [
        "load is left out, the logs state 1000 and 2000",
        f"attachment n of {paths[1]} differs: kept as b/n",
    ]


def test_the_commands_cut_and_merge(tmp_path, works):
    log = "sample_logs/nonstop.mcap"
    parts = [tmp_path / f"{number}.mcap" for number in range(2)]
    works("convert", log, "-o", parts[0], "--to", "600s")
    works("convert", log, "-o", parts[1], "--from", "600s")
    shown = works("convert", *parts, "-o", tmp_path / "again.mcap")
    assert "1 row of /train/state in two logs alike: kept once" in shown
    again, whole = trainlog.read(tmp_path / "again.mcap"), trainlog.read(log)
    assert again == whole
    assert again.attachments == whole.attachments
    assert np.all(again[STATE].index == whole[STATE].index)


STATE_COLUMNS = frame_of(TRAIN_STATE, START + np.arange(3), {"speed": [1.0, 2.0, 3.0]})


def contents(folder: Path) -> dict[str, bytes]:
    files = [path for path in folder.rglob("*") if path.is_file()]
    return {str(path.relative_to(folder)): path.read_bytes() for path in files}


def write_pieces(pieces: Iterator[Trip], folder: Path) -> None:
    with folder_writer(folder) as writer:
        for piece in pieces:
            writer.add(piece)


def interrupted() -> Iterator[Trip]:
    yield trip_of(rows=3)
    raise KeyboardInterrupt


@settings(max_examples=20)
@given(trip=trips())
@example(trip=Trip({}, attachments={"timetable.xls": b"\xd0\xcf\x11\xe0"}))
@example(trip=trip_of(rows=0))
@example(trip=trip_of(rows=1))
@example(trip=trip_of(rows=100))
def test_any_trip_comes_back_to_the_last_bit(tmp_path_factory, trip):
    folder = tmp_path_factory.mktemp("parquet") / "trip.parquet"
    write_parquet(trip, folder)
    assert_same(trip, read_parquet(folder))


def test_frames_of_other_programs_come_back(tmp_path):
    index = pd.DatetimeIndex([1, 2], tz="UTC", name="time").as_unit("ns")
    frame = pd.DataFrame(
        {
            "pose.x": np.array([1, 2], dtype=np.float32),
            "count": np.array([1, 2], dtype=np.uint16),
            "on": [True, False],
            "frame_id": ["map", "odom"],
            "raw": [b"\x00\xff", b""],
            "sequence": pd.array([2**63 - 1, None], dtype="Int64"),
            "valid": pd.array([True, None], dtype="boolean"),
        },
        index=index,
    )
    trip = Trip({"/robot/pose": frame, "/robot_pose": frame, "/ROBOT/pose": frame})
    write_parquet(trip, tmp_path / "other.parquet")
    back = read_parquet(tmp_path / "other.parquet")
    assert list(back.topics) == list(trip.topics)
    for name in trip.topics:
        pd.testing.assert_frame_equal(back[name], frame)


def test_same_trip_same_bytes_whatever_the_pieces(tmp_path, monkeypatch):
    monkeypatch.setattr(trip_tables, "ROWS", 16)
    trip = trip_of(rows=100)
    write_parquet(trip, tmp_path / "whole.parquet")
    parts = (
        {name: frame.iloc[first : first + 7] for name, frame in trip.topics.items()}
        for first in range(0, 100, 7)
    )
    write_pieces((replace(trip, topics=part) for part in parts), tmp_path / "pieces.parquet")
    assert contents(tmp_path / "whole.parquet") == contents(tmp_path / "pieces.parquet")
    state = pq.ParquetFile(tmp_path / "pieces.parquet" / "train_state.parquet")
    assert state.metadata.num_row_groups == 7
    described = state.schema_arrow.field("speed").metadata
    assert described[b"unit"] == b"m/s"
    assert b"speed over ground" in described[b"meaning"]
    assert str(state.schema_arrow.field("time").type) == "timestamp[ns, tz=UTC]"
    assert state.read()["speed"].null_count == trip[TRAIN_STATE.name]["speed"].isna().sum() > 0
    assert_same(trip, read_parquet(tmp_path / "pieces.parquet"))


def test_only_the_topics_and_columns_asked_for_are_read(tmp_path):
    trip = trip_of(rows=5)
    write_parquet(trip, tmp_path / "trip.parquet")
    for other in (tmp_path / "trip.parquet").glob("gnss*.parquet"):
        other.write_bytes(b"")  # what is not asked for is not opened
    back = read_parquet(tmp_path / "trip.parquet", [EVENTS.name, TRAIN_STATE.name, "/unheard"])
    assert list(back.topics) == [TRAIN_STATE.name, EVENTS.name]
    asked = {STATE: ["speed", "unheard"], TRAIN_AXLES.name: None}
    some = read_parquet(tmp_path / "trip.parquet", asked)
    pd.testing.assert_frame_equal(some[TRAIN_STATE.name], trip[TRAIN_STATE.name][["speed"]])
    assert some[TRAIN_STATE.name].attrs["units"] == {"speed": "m/s"}
    assert len(some[TRAIN_AXLES.name].columns) == 8
    one = read_parquet(tmp_path / "trip.parquet", {TRAIN_STATE.name: "speed"})
    assert list(one[TRAIN_STATE.name].columns) == ["speed"]


@pytest.mark.parametrize(
    ("trip", "said"),
    [
        (Trip({TRAIN_STATE.name: STATE_COLUMNS.reset_index(drop=True)}), "not indexed by time"),
        (Trip({TRAIN_STATE.name: STATE_COLUMNS.iloc[::-1]}), "runs backwards"),
        (Trip({TRAIN_STATE.name: STATE_COLUMNS.assign(speed=[1.0, "two", 3.0])}), "cannot hold"),
        (Trip({STATE: pd.concat([STATE_COLUMNS, STATE_COLUMNS], axis=1)}), "cannot hold"),
        (Trip({}, provenance=({"step": float("nan")},)), "cannot be written"),
        (Trip({}, {"trip": "\ud800"}), "cannot be written"),
    ],
)
def test_what_cannot_be_written_is_refused_and_leaves_no_folder(trip, said, tmp_path):
    caught = refused(LogError, said, write_parquet, trip, tmp_path / "trip.parquet")
    assert caught.file == tmp_path / "trip.parquet"
    assert caught.remedy
    assert list(tmp_path.iterdir()) == []


def test_only_such_a_folder_is_replaced(tmp_path):
    folder = tmp_path / "trip.parquet"
    write_parquet(trip_of(rows=5), folder)
    write_parquet(trip_of(rows=7), folder)
    assert_same(read_parquet(folder), trip_of(rows=7))
    assert list(tmp_path.iterdir()) == [folder]
    (tmp_path / "photos").mkdir()
    (tmp_path / "photos" / "dog.jpg").write_bytes(b"dog")
    (tmp_path / "file").write_bytes(b"")
    for other in ("photos", "file"):
        with pytest.raises(InputError, match=r"is not a folder with trip\.json") as caught:
            write_parquet(trip_of(rows=5), tmp_path / other)
        assert caught.value.file == tmp_path / other
    assert (tmp_path / "photos" / "dog.jpg").read_bytes() == b"dog"


def test_a_failed_write_leaves_the_older_folder(tmp_path):
    folder = tmp_path / "trip.parquet"
    write_parquet(trip_of(rows=5), folder)
    before = contents(folder)
    no_time = Trip({TRAIN_STATE.name: STATE_COLUMNS.reset_index(drop=True)})
    refused(LogError, "not indexed by time", write_parquet, no_time, folder)
    other = [Trip({STATE: each}) for each in (STATE_COLUMNS, STATE_COLUMNS[["speed"]])]
    refused(LogError, "/train/state changes its columns", write_pieces, other, folder)
    with pytest.raises(KeyboardInterrupt):
        write_pieces(interrupted(), folder)
    assert contents(folder) == before
    assert list(tmp_path.iterdir()) == [folder]


def test_folders_that_hold_no_trip_are_named(tmp_path):
    (tmp_path / "file").write_bytes(b"")
    for name, said in (("nothing", "does not exist"), ("file", "not a folder"), ("", "no trip")):
        caught = refused(InputError, said, read_parquet, tmp_path / name)
        assert caught.remedy


@pytest.fixture
def written_folder(tmp_path: Path) -> Path:
    write_parquet(trip_of(rows=50), tmp_path / "trip.parquet")
    return tmp_path / "trip.parquet"


def test_damaged_files_are_named(written_folder):
    state = written_folder / "train_state.parquet"
    whole = state.read_bytes()
    for name, damaged in {
        "cut": whole[:-9],
        "empty": b"",
        "of other rows": (written_folder / "events.parquet").read_bytes()[:100] + whole[100:],
    }.items():
        state.write_bytes(damaged)
        caught = refused(LogError, "is damaged", read_parquet, written_folder)
        assert caught.file == state, name
        assert caught.remedy
    state.unlink()
    refused(LogError, r"train_state.*missing", read_parquet, written_folder)
    state.write_bytes(whole)
    (written_folder / "attachments" / "0001-line.json").write_bytes(b"{}")
    refused(LogError, r"0001-line.json: is damaged", read_parquet, written_folder)


@settings(max_examples=25)
@given(st.data())
def test_a_flipped_bit_is_found_or_harmless(tmp_path_factory, data):
    folder = tmp_path_factory.mktemp("parquet") / "trip.parquet"
    trip = trip_of(rows=50, topics=[TRAIN_STATE.name, EVENTS.name])
    write_parquet(trip, folder)
    file = folder / data.draw(st.sampled_from(["train_state.parquet", "events.parquet"]))
    content = bytearray(file.read_bytes())
    content[data.draw(st.integers(0, len(content) - 1))] ^= 1 << data.draw(st.integers(0, 7))
    file.write_bytes(content)
    try:
        back = read_parquet(folder)
    except LogError as error:
        named = error.file
    else:
        named = file
        assert_same(trip, back)
    assert named == file


@pytest.mark.parametrize(
    ("change", "error", "said"),
    [
        ({"format": "trainlog/line"}, InputError, "format 'trainlog/line'"),
        ({"version": 2}, InputError, "newer"),
        ({"schema_version": 99}, InputError, "schema_version"),
        ({"topics": [{"topic": "/a"}]}, InputError, "missing"),
        ({"topics": [{"topic": "/a", "file": "../../x", "footer": ""}]}, LogError, "outside"),
        ({"topics": [{"topic": "/a", "file": "trip.json", "footer": ""}]}, LogError, "damaged"),
    ],
)
def test_an_index_that_does_not_fit_is_refused(change, error, said, written_folder):
    index = json.loads((written_folder / "trip.json").read_text())
    (written_folder / "trip.json").write_text(json.dumps(index | change))
    caught = refused(error, said, read_parquet, written_folder)
    assert caught.file is not None
