"""Live recording: nothing is lost silently; one that is killed loses what its last flush lacks."""

from __future__ import annotations

import os
import signal
import struct
import subprocess
import sys
import threading
import time
import time as clock
import warnings
from collections.abc import Callable
from multiprocessing import get_context
from multiprocessing.connection import Connection
from multiprocessing.forkserver import ensure_running
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pandas as pd
import pytest
from mcap.exceptions import McapError
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader
from mcap_trips import ATTACHMENTS, METADATA, START, assert_same, trip_of
from refusals import refused

import trainlog
from trainlog.errors import InputError, LogError
from trainlog.mcap import DamageWarning, OverloadWarning, Recording, read_log, write_log, writer
from trainlog.topics import EVENTS, TOPICS, TRAIN_AXLES, TRAIN_STATE
from trainlog.trip import Trip
from trainlog.units import lasted

STATE, AXLES = TRAIN_STATE.name, TRAIN_AXLES.name


def until(true: Callable[[], bool]) -> None:
    """Wait for the recorder's thread."""
    for _ in range(6000):
        if true():
            return
        clock.sleep(0.01)
    raise AssertionError("waited for a minute")


def values_at(frame: pd.DataFrame, rows: int | slice) -> dict[str, Any]:
    """Arguments of `write`: by field, those of axles together."""
    topic = TOPICS[frame.attrs["topic"]]
    return {
        field.name: frame.filter(regex=f"^{field.name}_[0-9]+$").to_numpy()[rows]
        if field.per_axle
        else frame[field.name].to_numpy()[rows]
        for field in topic.fields
    }


def play(trip: Trip, log: Recording, block: int | None = None) -> None:
    """Record a trip sample by sample, or in blocks."""
    for name, frame in trip.topics.items():
        times = frame.index.as_unit("ns").asi8
        for row in range(0, len(frame), block or 1):
            if name == EVENTS.name:
                log.event(*frame.iloc[row].tolist(), time=int(times[row]))
            elif block is None:
                log.write(name, int(times[row]), **values_at(frame, row))
            else:
                rows = slice(row, row + block)
                log.write(name, times[rows], **values_at(frame, rows))


@pytest.mark.parametrize("block", [None, 7])
def test_what_is_recorded_reads_back(block, tmp_path):
    topics = [name for name in TOPICS if block is None or name != EVENTS.name]
    trip = trip_of(rows=60, topics=topics)
    with trainlog.record(
        tmp_path / "log.mcap", metadata=METADATA, attachments=ATTACHMENTS, flush=0.01
    ) as log:
        play(trip, log, block)
    found = read_log(tmp_path / "log.mcap")
    (step,) = found.provenance
    assert step["step"] == "record"
    expected = {name: frame for name, frame in trip.topics.items() if len(frame)}
    read = {name: frame for name, frame in found.topics.items() if len(frame)}
    assert_same(
        Trip(read, found.metadata, (), found.attachments),
        Trip(expected, trip.metadata, (), trip.attachments),
    )
    account = log.account()
    assert account.written == dict.fromkeys(expected, 60)
    assert account.waiting == account.dropped == {}


def test_the_file_is_whole_and_numbers_the_samples_as_they_came(tmp_path):
    rng = np.random.default_rng(1)
    order = rng.permutation(3000)
    with trainlog.record(tmp_path / "log.mcap", flush=0.02) as log:
        for number, late in enumerate(order.tolist()):
            log.write(STATE, START + late, speed=float(number))
            if number % 700 == 0:
                until(lambda so_far=number + 1: log.account().written.get(STATE) == so_far)
    with (tmp_path / "log.mcap").open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        messages = [m for _, c, m in reader.iter_messages(log_time_order=False) if c.topic == STATE]
        summary = reader.get_summary()
    assert {m.sequence: m.log_time - START for m in messages} == dict(enumerate(order.tolist()))
    assert len(summary.chunk_indexes) > 3
    frame = read_log(tmp_path / "log.mcap")[STATE]
    assert frame.index.equals(pd.to_datetime(START + np.arange(3000), utc=True))
    assert frame["speed"].tolist() == np.argsort(order).tolist()


def test_times_of_every_kind(tmp_path):
    at = pd.Timestamp(START, tz="Europe/Zurich")
    index = pd.DatetimeIndex([at, at])
    with trainlog.record(tmp_path / "log.mcap") as log:
        log.write(STATE, START, speed=1)
        log.write(STATE, np.int64(START), speed=np.float32(1))
        log.write(STATE, at, speed=np.array(1.0))
        log.write(STATE, pd.Timestamp(START), speed=1.0)
        log.write(STATE, at.to_pydatetime(), speed=True)
        log.write(STATE, np.datetime64(START, "ns"), speed=1.0)
        log.write(STATE, index, speed=[1.0, 1.0])
        log.write(STATE, index.tz_convert(None).to_numpy().astype("M8[us]"), speed=[1, 1])
        log.write(STATE, np.empty(0, dtype=np.int64), speed=[])
        log.write(STATE, START + 1, speed=None, position=2.0)
    frame = read_log(tmp_path / "log.mcap")[STATE]
    assert frame.index.equals(pd.to_datetime([START] * 10 + [START + 1], utc=True))
    np.testing.assert_array_equal(frame["speed"], [1.0] * 10 + [np.nan])
    np.testing.assert_array_equal(frame["position"], [np.nan] * 10 + [2.0])


@pytest.mark.parametrize(
    ("arguments", "values", "said"),
    [
        (("/train/mood", START), {"speed": 1.0}, "no topic /train/mood"),
        ((STATE, START), {"mood": 1.0}, "no field mood"),
        ((STATE, START), {}, "has no values"),
        ((STATE, START), {"speed": "fast"}, "not a number"),
        ((STATE, START), {"speed": -np.inf}, "speed holds an infinite number"),
        ((STATE, [START] * 2), {"speed": [1.0, np.inf]}, "sample 2 of .* holds an infinite number"),
        ((STATE, [START, START]), {"speed": np.inf}, "sample 1 of .* holds an infinite number"),
        ((STATE, [START, START]), {"speed": [1.0, "12"]}, "speed holds text"),
        ((AXLES, START), {"wheel_speed": [1.0, np.inf, 2.0]}, "wheel_speed holds an infinite"),
        ((STATE, START), {"speed": [1.0, 2.0]}, r"shape \(2,\), where the time asks for \(\)"),
        ((STATE, [START, START]), {"speed": 1.0}, r"shape \(\), where the time asks for \(2,\)"),
        ((STATE, -1), {"speed": 1.0}, "not a time"),
        ((STATE, 2**63), {"speed": 1.0}, "not a time"),
        ((STATE, "noon"), {"speed": 1.0}, "not a time"),
        ((STATE, [[START]]), {"speed": 1.0}, "not a time"),
        ((AXLES, START), {"wheel_speed": [1.0, 2.0]}, r"asks for \(3,\)"),
        ((AXLES, START), {"wheel_speed": [1, 2, 3, 4], "wheel_effort": [1, 2]}, "asks for"),
        (("/reference", START), {"wheel_speed": [1.0]}, "no field wheel_speed"),
        ((EVENTS.name, START), {"level": 2, "message": "x"}, r"record them with event\(\)"),
        ((9, "x"), {"time": START}, "9 is not a level"),
        ((1, "\ud800"), {"time": START}, "UTF-8"),
        ((1, 5), {"time": START}, "ordinary text"),
        ((1, "x"), {"time": [START]}, "one time"),
        ((1, "x"), {"time": -5}, "not a time"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(arguments, values, said, tmp_path):
    with trainlog.record(tmp_path / "log.mcap") as log:
        log.write(STATE, START, speed=1.0)
        log.write(AXLES, START, wheel_speed=[1.0, 2.0, 3.0], wheel_effort=(4.0, 5.0, 6.0))
        caught = refused(
            LogError, said, log.event if "time" in values else log.write, *arguments, **values
        )
        log.write(STATE, START + 1, speed=2.0)
    assert caught.file == tmp_path / "log.mcap"
    assert caught.remedy
    found = read_log(tmp_path / "log.mcap")
    assert found[STATE]["speed"].tolist() == [1.0, 2.0]
    assert found[AXLES].to_numpy().tolist() == [[1.0, 2.0, 3.0, 4.0, 5.0, 6.0]]


@pytest.fixture
def gate(monkeypatch: pytest.MonkeyPatch) -> threading.Event:
    """A disk that takes no chunk before the gate is opened."""
    opened = threading.Event()
    compress = writer.packed

    def held(content: memoryview, start: int, end: int) -> Chunk:
        if threading.current_thread().name == "trainlog.record":
            assert opened.wait(30)
        return compress(content, start, end)

    monkeypatch.setattr(writer, "packed", held)
    return opened


def test_overload_is_counted_and_reported(gate, tmp_path):
    row = 8 * (2 + len(TRAIN_STATE.fields))
    log = trainlog.record(tmp_path / "log.mcap", flush=0.01, queue=100 * row)
    log.write(STATE, START, speed=0.0)
    until(lambda: log._waiting == 0)
    # The thread holds the first sample; a hundred more fit into the queue.
    for number in range(1, 151):
        log.write(STATE, START + number, speed=float(number))
    log.write(STATE, START + np.arange(151, 161), speed=np.arange(151.0, 161.0))
    log.event(2, "this does not fit", time=START + 160)
    account = log.account()
    assert account.dropped == {STATE: 60, EVENTS.name: 1}
    assert account.waiting == {STATE: 101}
    gate.set()
    until(lambda: log.account().written.get(STATE) == 101)
    log.write(STATE, START + 161, speed=161.0)
    with pytest.warns(OverloadWarning, match="1 of /events, 60 of /train/state"):
        log.close()
    assert log.account().written == {STATE: 102, EVENTS.name: 2}
    found = read_log(tmp_path / "log.mcap")
    assert found[STATE]["speed"].tolist() == [*range(101), 161]
    reported = found[EVENTS.name]
    assert reported["level"].tolist() == [3, 3]
    span = "from 2023-11-14T22:13:20.000000101 to 2023-11-14T22:13:20.000000160"
    assert reported["message"].tolist() == [
        f"60 samples of /train/state dropped: the queue was full {span}",
        "1 samples of /events dropped: the queue was full from "
        "2023-11-14T22:13:20.000000160 to 2023-11-14T22:13:20.000000160",
    ]
    assert reported.index[0].value == START + 101
    with (tmp_path / "log.mcap").open("rb") as stream:
        reader = make_reader(stream)
        numbers = [
            message.sequence
            for _, channel, message in reader.iter_messages()
            if channel.topic == STATE
        ]
        records = [record.metadata for record in reader.iter_metadata()]
    # The numbers state exactly which are missing.
    assert numbers == [*range(101), 161]
    closed = {"closed": "whole", f"dropped.{STATE}": "60", f"dropped.{EVENTS.name}": "1"}
    assert closed in records
    write_log(found, tmp_path / "derived.mcap")
    assert read_log(tmp_path / "derived.mcap").provenance[-1].items() >= closed.items()


def test_many_threads_may_write(tmp_path):
    def work(number: int) -> None:
        for row in range(500):
            log.write(STATE, START + row, speed=float(number))
            log.event(1, f"{number}", time=START + row)

    with trainlog.record(tmp_path / "log.mcap", flush=0.01) as log:
        threads = [threading.Thread(target=work, args=(number,)) for number in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    found = read_log(tmp_path / "log.mcap")
    assert found[STATE]["speed"].value_counts().to_dict() == dict.fromkeys(range(4), 500)
    assert found[EVENTS.name]["message"].value_counts().to_dict() == dict.fromkeys("0123", 500)


def test_a_file_that_exists_is_never_overwritten(tmp_path):
    (tmp_path / "log.mcap").write_text("precious")
    refused(InputError, "exists already", trainlog.record, tmp_path / "log.mcap")
    assert (tmp_path / "log.mcap").read_text() == "precious"
    with pytest.raises(InputError, match="its folder does not exist"):
        trainlog.record(tmp_path / "gone" / "log.mcap")
    for options in ({"flush": 0.0}, {"flush": float("nan")}, {"queue": 0}):
        refused(InputError, r"is (0|nan)", trainlog.record, tmp_path / "new.mcap", **options)
    refused(LogError, "not text", trainlog.record, tmp_path / "new.mcap", metadata={"load": 5})
    assert [path.name for path in tmp_path.iterdir()] == ["log.mcap"]


def test_an_exception_closes_the_file_properly(tmp_path):
    with (
        pytest.raises(ZeroDivisionError),
        trainlog.record(tmp_path / "log.mcap", flush=60.0, sync=True) as log,
    ):
        log.write(STATE, START, speed=1.0 / len(list(tmp_path.glob("*.txt"))))
    refused(LogError, "is closed", log.write, STATE, START, speed=1.0)
    log.close()
    assert read_log(tmp_path / "log.mcap").name == "unnamed"


@pytest.mark.skipif(sys.platform == "win32", reason="open files cannot be removed there")
@pytest.mark.parametrize("replaced", [False, True])
def test_a_file_taken_away_is_reported(replaced, tmp_path):
    log = trainlog.record(tmp_path / "log.mcap", flush=0.01)
    (tmp_path / "log.mcap").unlink()
    if replaced:
        (tmp_path / "log.mcap").write_text("another")
    until(lambda: log._failure is not None)
    refused(InputError, "cannot be written", log.write, STATE, START, speed=1.0)
    refused(InputError, "cannot be written", log.event, 1, "x")
    refused(InputError, "cannot be written", log.close)
    if replaced:
        assert (tmp_path / "log.mcap").read_text() == "another"


# A limit on the size of files is to a program what a full disk is: a write that fails half way.
LIMITED = """
import resource, sys
import numpy as np
import trainlog
from trainlog.errors import InputError
from trainlog.topics import TRAIN_STATE
random = np.random.default_rng(1)
trip = trainlog.read(sys.argv[1])
numbers = {"speed": np.random.default_rng(2).random(60_000)}
large = trainlog.Trip({"/train/state": trainlog.frame_of(TRAIN_STATE, np.arange(60_000), numbers)})
log = trainlog.record("log.mcap", flush=0.05)
def record():
    for number in range(100_000):
        log.write("/train/state", (number * 50 + np.arange(50)) * 10**8, speed=random.random(50))
for limit, call in (
    (800_000, record),
    (800_000, log.close),
    (500_000, lambda: trainlog.write(large, "trip.mcap")),
    (500_000, lambda: trainlog.write(large, "trip.mcap", sync=True)),
    (200_000, lambda: trainlog.write_replay([trip], "full.rrd")),
):
    resource.setrlimit(resource.RLIMIT_FSIZE, (limit, 800_000))
    try:
        call()
    except InputError as error:
        print(error)
account = log.account()
print(account.written["/train/state"], account.waiting["/train/state"] > 0)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="limits of file sizes are POSIX's")
def test_a_full_disk_is_reported_and_what_was_written_stays(tmp_path):
    """Of a recording; a log and a replay are written whole or leave what there was."""
    write_log(trip_of(rows=3), tmp_path / "trip.mcap")
    before = (tmp_path / "trip.mcap").read_bytes()
    words = [sys.executable, "-c", LIMITED, str(trainlog.sample("nonstop.mcap"))]
    path = os.pathsep.join(filter(None, [os.environ.get("PYTHONPATH"), str(Path.cwd())]))
    run = subprocess.run(
        words, capture_output=True, text=True, check=True, cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": path},
    )  # fmt: skip
    recorded, closed, *written, replayed, account = run.stdout.splitlines()
    assert recorded == closed
    assert recorded.startswith("log.mcap: cannot be written: file too large")
    said = "cannot be written: file too large; write to a file system that holds files of this size"
    assert written == [f"trip.mcap: {said}"] * 2
    assert "full.rrd: cannot be written to its end: is the disk full?; free some" in replayed
    count, lost = account.split()
    assert lost == "True"
    assert (tmp_path / "trip.mcap").read_bytes() == before
    assert sorted(each.name for each in tmp_path.iterdir()) == ["log.mcap", "trip.mcap"]
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of the missing summary, if there was no space for it
        state = read_log(tmp_path / "log.mcap")[STATE]
    assert len(state) == int(count) > 0
    np.testing.assert_array_equal(state["speed"], np.random.default_rng(1).random(len(state)))
    kept = lasted(0.1 * (len(state) - 1))
    assert f"file too large; the log up to there is whole: {kept}; write to a file" in recorded


@pytest.mark.parametrize("seconds", [1_735_689_600, [1_735_689_600, 1_735_689_601]])
def test_times_in_seconds_are_recorded_with_one_warning(seconds, tmp_path):
    with trainlog.record(tmp_path / "log.mcap") as log:
        speed = 1.0 if isinstance(seconds, int) else [1.0, 2.0]
        with pytest.warns(UserWarning, match="1970-01-01.*nanoseconds"):
            log.write("/train/state", seconds, speed=speed)
        log.write("/train/state", seconds, speed=speed)


FLUSH, MARGIN = 0.05, 0.5
"""Period of the recording, and how late its thread may come to write on a busy machine [s]."""

REPORT = struct.Struct("<dqq")
"""When, how many samples of each topic were given until then, how many of them were written."""


def numbered(number: Any) -> dict[str, dict[str, Any]]:
    """What the sample with this number says: of the train's state, and of its axles."""
    axles = np.stack([np.cos(number + axle) for axle in range(4)], axis=-1)
    state = {"speed": np.sin(number), "position": number * 0.5}
    return {"/train/state": state, "/train/axles": {"wheel_speed": axles}}


def record(path: str, pipe: Connection) -> None:
    """Record samples of two topics, one by one and in blocks, and report it, until killed."""
    with trainlog.record(path, flush=FLUSH, metadata={"trip": "cut short"}) as log:
        number = 0
        while True:
            for _ in range(2):
                block = np.arange(number, number + 20)
                log.write("/train/axles", START + block * 1000, **numbered(block)["/train/axles"])
                for each in block.tolist():
                    log.write("/train/state", START + each * 1000,
                              **numbered(each)["/train/state"])  # fmt: skip
                number += 20
            written = log.account().written
            least = min(written.get(name, 0) for name in numbered(0))
            pipe.send_bytes(REPORT.pack(time.monotonic(), number, least))
            time.sleep(0.004)


def killed(path: Path, after: float) -> tuple[int, int]:
    """Start a recorder and kill it; how many samples the file must hold, and how many it may.

    It must hold what the recorder itself says it has written, and all that it was given longer
    than a flush period, and the margin, ago. A server that has everything loaded starts it.
    """
    context = get_context("forkserver")
    context.set_forkserver_preload([__name__])
    # The server looks for what it loads beforehand where the environment says, and there alone.
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", str(Path(__file__).parent), prepend=os.pathsep)
        ensure_running()
    pipe, theirs = context.Pipe(duplex=False)
    process = context.Process(target=record, args=(str(path), theirs), daemon=True)
    process.start()
    theirs.close()
    reports = [REPORT.unpack(pipe.recv_bytes())]
    end = time.monotonic() + after
    while (left := end - time.monotonic()) > 0.0:
        if pipe.poll(left):
            reports.append(REPORT.unpack(pipe.recv_bytes()))
    process.kill()
    moment = time.monotonic()
    try:
        while True:
            reports.append(REPORT.unpack(pipe.recv_bytes()))
    except EOFError:
        process.join()
    old = [given for at, given, _ in reports if at < moment - FLUSH - MARGIN]
    # Behind the last report it may have been given another round.
    return max([written for _, _, written in reports] + old), reports[-1][1] + 40


def check(path: Path, must: int, may: int) -> None:
    """The file holds the first samples, as many as it must, each as it was given."""
    if not must and not officially(path):
        refused(LogError, "no message of it is readable", read_log, path)
        return
    with pytest.warns(DamageWarning) as caught:
        trip = read_log(path)
    account = caught.list[0].message
    assert isinstance(account, DamageWarning)
    counts = {name: len(trip[name]) if name in trip.topics else 0 for name in numbered(0)}
    assert account.account.messages == officially(path) == sum(counts.values())
    assert trip.metadata == {"trip": "cut short"}
    for name, expected in numbered(np.arange(may)).items():
        if not counts[name]:
            continue
        times = trip[name].index.as_unit("ns").asi8
        assert (times == START + np.arange(counts[name]) * 1000).all()
        for field, values in expected.items():
            columns = trip[name].filter(regex=f"^{field}(_[0-9]+)?$").to_numpy()
            np.testing.assert_array_equal(columns, values[: len(times)].reshape(len(times), -1))
    assert must <= min(counts.values()) <= max(counts.values()) <= may


def officially(path: Path) -> int:
    """How many messages the official reader finds before the end of what was written."""
    count = 0
    with path.open("rb") as stream:
        try:
            for record in StreamReader(stream, validate_crcs=True).records:
                count += type(record).__name__ == "Message"
        except McapError:
            pass
    return count


@pytest.mark.skipif(not hasattr(signal, "SIGKILL"), reason="programs are killed otherwise there")
@pytest.mark.parametrize("kills", [3, pytest.param(1000, marks=pytest.mark.long)])
def test_recorders_killed_at_many_moments(tmp_path, kills):
    random = Random(kills)
    total = 0
    for number in range(kills):
        path = tmp_path / f"{number}.mcap"
        must, may = killed(path, random.uniform(0.0, 0.9))
        check(path, must, may)
        total += must
        path.unlink()
    assert total > 0
