"""Recording while the train runs: what a sender gives is in the log as ingesting its file gives it,
what it damages is counted and kept, and what ends the program costs a second at most."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
import warnings
from collections.abc import Iterator
from contextlib import nullcontext
from dataclasses import replace
from datetime import timedelta
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pandas as pd
import pytest
from contents import put
from killed import PATIENCE
from recorder_files import drive, nav_pvt, nmea_lines
from refusals import refused

import trainlog
from analysis.sfera import SferaOptions, write_sfera
from trainlog.errors import InputError
from trainlog.formats.sfera import read_sfera
from trainlog.formats.sfera_messages import Report, status_report, xml_of
from trainlog.ingest import ingest
from trainlog.ingest.live import MOST_KEPT, LiveIngest, LiveOptions, Numbering
from trainlog.ingest.pipeline import Given
from trainlog.ingest.sources import Datagrams, GrowingFile, Pipe, Subscription
from trainlog.ingest.stream import Framer, time_of
from trainlog.trip import Trip

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from make_journey import DEPARTURE

SAMPLES = Path("sample_logs")
PROFILE = SAMPLES / "recorder.profile.toml"
UBLOX = Path("trainlog/ingest/profiles/ublox.toml")
STATE = "/train/state"
EPOCH = 1_714_543_200


def recorded(path: Path, data: list[bytes], profile: Path | None = None) -> tuple[Trip, LiveIngest]:
    """The log of datagrams, in batches as they come at a high rate."""
    recording, live = LiveIngest.begun(path, Given(profile), LiveOptions())
    with recording:
        for first in range(0, len(data), 100):
            for each in data[first : first + 100]:
                live.take(each, whole=True)
            live.flush()
        live.close()
    return trainlog.read(path), live


MALFORMED = b"12;34", b"\xff\xfe\x00garbage", b'{"topic": "/train/state", "speed"', b"$GPRMC,12*00"
"""What is sent between the lines of a file, one after each 250 of them."""


def received(path: Path, file: Path) -> tuple[Trip, LiveIngest, Datagrams]:
    """The log of what is sent of a file as datagrams, with a pause."""

    def send() -> None:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out:
            for number, line in enumerate(file.read_bytes().splitlines()):
                out.sendto(line, ("127.0.0.1", source.port))
                if number and number % 250 == 0:
                    out.sendto(MALFORMED[number // 250 % 4], ("127.0.0.1", source.port))
                time.sleep(0.5 if number == 1500 else 1e-4)

    with Datagrams("0") as source:
        recording, live = LiveIngest.begun(path, Given(PROFILE), LiveOptions(source.name))
        sender = threading.Thread(target=send)
        with recording:
            sender.start()
            live.follow(source, idle=1.0)
            live.close()
        sender.join()
    return trainlog.read(path), live, source


def assert_as_ingested(found: Trip, expected: Trip, topics: list[str]) -> None:
    for topic in topics:
        left, right = found[topic], expected[topic]
        assert left.index.equals(right.index), topic
        pd.testing.assert_frame_equal(left, right, check_exact=True, check_flags=False)


def sample(second: float, **values: Any) -> bytes:
    return json.dumps({"topic": STATE, "time": EPOCH + second, **values}).encode()


def test_datagrams_of_a_recorder_give_what_its_file_gives(tmp_path):
    rows = (SAMPLES / "recorder.csv").read_bytes().splitlines(keepends=True)
    file = put(tmp_path / "part.csv", b"".join([rows[0], *rows[2001:4000]]))
    found, live, source = received(tmp_path / "live.mcap", file)
    expected = ingest(file, profile=PROFILE)
    assert source.lost == 0
    assert_as_ingested(found, expected, [STATE, "/train/controls", "/train/axles"])
    assert sum(live.malformed.values()) == 7
    assert live.lines == 2000 + 7
    stated = expected.metadata
    assert live.met["duplicates", ""] == int(stated["repair.duplicates"])
    assert live.met["empty", STATE + ".speed"] == int(stated["repair.empty./train/state.speed"])
    words = found["/events"]["message"]
    assert words.str.contains(r"malformed line \d+: 2 cells, the header has 16: 12;34").sum() == 1
    assert words.str.contains("ff fe 00 67 61 72").sum() == 2
    step = found.provenance[-1]
    assert (step["lines"], step["malformed"], step["closed"]) == ("2007", "7", "whole")


def test_rows_of_a_receiver_are_kept_as_they_came(tmp_path):
    """Whole seconds are not spread, nor is anything else done that ingesting does afterwards."""
    file = SAMPLES / "gnss.csv"
    found, live = recorded(tmp_path / "live.mcap", file.read_bytes().splitlines(), UBLOX)
    expected = ingest(file)
    stamps = found["/gnss/fix"].index
    assert (stamps == stamps.floor("s")).all()
    kept = found["/gnss/fix"].latitude.dropna().to_numpy()
    assert np.isin(expected["/gnss/fix"].latitude.dropna().to_numpy(), kept).all()
    assert expected.metadata["repair.spikes./gnss/motion.speed"] == "3"
    assert not {"spikes", "subsecond"} & {rule for rule, _ in live.met}
    assert live.longest_gap == pytest.approx(45.0, abs=1.1)


def test_a_stream_on_standard_input_is_kept_as_it_came(tmp_path, monkeypatch, shell, works):
    file = tmp_path / "part.csv"
    file.write_bytes(b"".join((SAMPLES / "recorder.csv").read_bytes().splitlines(True)[:600]))
    log, raw = tmp_path / "a.mcap", tmp_path / "raw.csv"
    words = ["record", "--from", "stdin", "-o", log, "--profile", PROFILE, "--raw", raw, "--json"]
    with file.open() as stream:
        monkeypatch.setattr(sys, "stdin", stream)
        stated = json.loads(works(*words))
    assert stated["messages"][STATE] == 599
    assert stated["malformed"] == {}
    assert raw.read_bytes() == file.read_bytes()
    assert_as_ingested(trainlog.read(log), ingest(raw, profile=PROFILE), [STATE, "/train/axles"])
    assert "exists already; choose another name" in " ".join(shell(*words[:-1])[2].split())


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no device that is always full")
def test_the_copy_of_the_stream_that_finds_no_space_is_named(tmp_path):
    file = tmp_path / "in.jsonl"
    file.write_bytes(sample(0.0, speed=1.0) + b"\n")
    recording, live = LiveIngest.begun(tmp_path / "a.mcap", Given(None), LiveOptions())
    with recording, GrowingFile(file) as source, Path("/dev/full").open("wb", buffering=0) as raw:
        said = "/dev/full: cannot be written: no space"
        refused(InputError, said, live.follow, source, raw=raw, idle=0.1)


def test_sentences_are_epochs_as_in_a_file(tmp_path):
    """Across midnight, with a damaged one between and GGA without a date."""
    pytest.importorskip("pynmeagps")
    driven = drive(60, 1.0)
    late = replace(driven, time=driven.time + (18 * 3600 - 30) * 10**9)
    lines = []
    for number in range(60):
        kinds = ("RMC", "GGA") if number % 3 == 0 else ("GGA",)
        lines += [each.encode() for each in nmea_lines(late.take(np.array([number])), kinds)]
    lines[40] = lines[40][:-2] + b"00"
    expected = ingest(put(tmp_path / "log.nmea", b"\r\n".join(lines) + b"\r\n"))
    found, live = recorded(tmp_path / "live.mcap", lines)
    assert_as_ingested(found, expected, ["/gnss/fix", "/gnss/motion"])
    assert live.malformed == {"an NMEA sentence whose checksum or cells are wrong": 1}


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_ubx_and_lines_are_taken_apart_wherever_the_stream_is_cut(size, tmp_path):
    driven = drive(10, 1.0)
    parts = [nav_pvt(driven, second) for second in range(10)]
    damaged = bytearray(parts[5])
    damaged[70] ^= 0x10
    stream = b"".join([*parts[:5], bytes(damaged), sample(3.5, speed=3.4) + b"\n", *parts[5:]])
    recording, live = LiveIngest.begun(tmp_path / "live.mcap", Given(), LiveOptions())
    with recording:
        for first in range(0, len(stream), size):
            live.take(stream[first : first + size])
            live.flush()
        live.take(b'{"topic": "/train/st')
        live.close()
    trip = trainlog.read(tmp_path / "live.mcap")
    assert trip["/gnss/motion"].speed.tolist() == pytest.approx(driven.speed.tolist())
    assert trip["/gnss/fix"].latitude.tolist() == pytest.approx(driven.latitude.tolist())
    assert dict(live.malformed) == {
        "a UBX message whose length or checksum is wrong": 1, "cut off": 1,
    }  # fmt: skip


WRONG = {
    b'{"topic": "/train/stat", "time": 1714543200, "speed": 1}': "did you mean '/train/state'",
    b'{"topic": "/train/state", "time": 1714543200, "sped": 1}': "did you mean 'speed'",
    b'{"topic": "/train/state", "time": 1714543200, "speed": "fast"}': "is 'fast', no number",
    b'{"topic": "/train/state", "time": "soon", "speed": 1}': "is not a time; write ISO 8601",
    b'{"topic": "/train/state", "time": 1714543200}': "has no values",
    b'{"topic": "/train/axles", "time": 1714543200, "wheel_speed": 1}': "must be a list",
    b'{"speed": 1': "no JSON",
    b"[1]": "no JSON object",
    b"12;13": "neither JSON, NMEA nor UBX; a row of a table needs a profile",
}


def test_each_malformed_line_is_kept_with_its_reason_and_of_many_some(tmp_path):
    lines, many = [sample(second, speed=10.0) for second in range(5)], MOST_KEPT + 50
    found, live = recorded(tmp_path / "live.mcap", [*lines[:4], *WRONG, lines[4]])
    words = found["/events"]["message"].tolist()
    for line, reason in WRONG.items():
        assert any(reason in word and line.decode() in word for word in words), reason
    assert sum(live.malformed.values()) == len(WRONG)
    assert len(found[STATE]) == 5
    found, live = recorded(tmp_path / "many.mcap", [*lines, *[b"?"] * many])
    assert sum(live.malformed.values()) == many
    assert found["/events"]["message"].str.startswith("malformed line ").sum() == MOST_KEPT
    assert any("50 of them not kept in the log" in each for each in live.sentences())


def test_reasons_that_hold_values_of_their_lines_are_bounded(tmp_path):
    lines = [sample(0.1 * n, speed=f"{n} km/h") for n in range(50)]
    late = b'{"topic": "/train/state", "time": "2027-13-28T00:00:00Z", "speed": 1}'
    _, live = recorded(tmp_path / "live.mcap", [sample(0.0, speed=1.0), late, *lines])
    said = "time '2027-13-28T00:00:00Z' is not a time; write ISO 8601, or a number since 1970"
    assert (live.malformed[said], live.malformed["other reasons"]) == (1, 41)


def test_nothing_is_driven_over_a_pause_of_the_stream(tmp_path):
    """20 s at 20 m/s, one hour without data, 20 s more."""
    times = [*np.arange(0.0, 20.0, 0.5), *np.arange(3_620.0, 3_640.0, 0.5)]
    _, live = recorded(tmp_path / "live.mcap", [sample(each, speed=20.0) for each in times])
    assert live.progress.distance == pytest.approx(2 * 19.5 * 20.0)


def test_json_of_a_profile_has_the_profiles_units(tmp_path):
    profile = tmp_path / "bus.toml"
    profile.write_text(
        'format = "trainlog/recorder-profile"\nversion = 1\nname = "bus"\n'
        '[time]\ncolumn = "t"\nformat = "epoch"\nunit = "ms"\n'
        '[columns]\n"/train/state.speed" = { column = "odo.v", unit = "km/h" }\n'
        '"/train/axles.wheel_speed" = { columns = ["w.1", "w.2"], unit = "km/h" }\n'
        '"/environment.speed_limit" = { value = 90, unit = "km/h" }\n'
    )
    lines = [
        json.dumps({"t": 1000 * (EPOCH + n), "odo": {"v": 36.0 + 3.6 * n}, "w": [36, 72]}).encode()
        for n in range(5)
    ]
    found, live = recorded(tmp_path / "live.mcap", [*lines, b'{"t": 5, "x": 1}'], profile)
    assert found[STATE].speed.to_numpy() == pytest.approx([10.0, 11.0, 12.0, 13.0, 14.0])
    assert found["/train/axles"].wheel_speed_2.to_numpy() == pytest.approx(20.0)
    assert sum(live.malformed.values()) == 1


def test_times_of_json_are_iso_or_counts():
    expected = pd.Timestamp("2024-05-01T06:00:00.25Z").value
    for given in (
        "2024-05-01T06:00:00.25Z", "2024-05-01T08:00:00.25+02:00", EPOCH + 0.25,
        (EPOCH + 0.25) * 1e3, 1000 * EPOCH + 250, expected // 1000, expected,
    ):  # fmt: skip
        assert time_of(given) == expected, given
    for wrong in (True, None, "noon", float("nan"), -5, 12, [1]):
        refused(ValueError, "is not a time", time_of, wrong)


def test_single_wild_times_are_dropped_and_named(tmp_path):
    """One before the others does not count, two between them neither."""
    lines = [sample(second, speed=10.0) for second in range(20)]
    lines[8], lines[12] = sample(86_400, speed=10.0), sample(-3_600, speed=10.0)
    found, live = recorded(tmp_path / "live.mcap", [sample(-1e8, speed=1.0), *lines])
    assert found.start == pd.Timestamp(EPOCH, unit="s", tz="UTC")
    assert len(found[STATE]) == 18
    assert live.met["clock_jump", ""] == 3
    assert found["/events"]["message"].str.contains("line 10 was not recorded: its time is").any()


@pytest.mark.parametrize("step", [1.0, 5.0])
def test_a_clock_that_is_set_back_goes_on_and_says_so(step, tmp_path):
    """Also in rows that come later."""
    truth = step * np.arange(240.0)
    stated = np.where(truth < 20.0 * step, truth, truth - 3600.0)
    lines = [sample(second, speed=0.5 * n) for n, second in enumerate(stated.tolist())]
    found, live = recorded(tmp_path / "live.mcap", lines)
    state = found[STATE]
    assert state.speed.tolist() == (0.5 * np.arange(240.0)).tolist()
    assert ((state.index - state.index[0]) / pd.Timedelta(seconds=1)).tolist() == truth.tolist()
    assert live.met["clock_step", ""] == 1
    assert found["/events"]["message"].str.contains("was set back by 3600 s").any()


@pytest.mark.parametrize(("count", "sound", "speed"), [(150, 11, 20.0), (300, 200, 0.0)])
def test_impossible_values_become_absent_and_a_wrong_unit_is_named(count, sound, speed, tmp_path):
    """A speed of 0 is one in any unit."""
    speeds = [speed] * sound + [200.0] * (count - sound)
    lines = [sample(n, speed=each, position=20.0 * n) for n, each in enumerate(speeds)]
    found, live = recorded(tmp_path / "live.mcap", lines)
    assert found[STATE].speed.isna().sum() == count - sound
    assert live.met["out_of_limits", "/train/state.speed"] == count - sound
    assert found["/events"]["message"].str.contains("check the unit of its column").sum() == 1


def test_what_the_sender_counted_and_did_not_arrive_is_lost():
    numbering = Numbering()
    numbering.take([5, 6, 7, 10, 11, 8, 11, 12])
    assert numbering.counts == {"lost": 1, "late": 1, "repeated": 1, "restarts": 0}
    numbering.take([5000, 1, 2, 3])
    assert numbering.counts == {"lost": 1 + 5000 - 13, "late": 1, "repeated": 1, "restarts": 1}


@pytest.mark.parametrize("size", [1 << 8, 1 << 16])
def test_a_counter_that_goes_round_is_no_restart(size):
    numbers = [number % size for number in range(size - 30, 3 * size + 10)]
    lost = numbers[:20] + numbers[22:33] + numbers[37:]
    late = [*lost[:27], lost[28], lost[27], *lost[29:]]  # the last of a round comes behind 0
    numbering = Numbering()
    numbering.take(late)
    assert numbering.counts == {"lost": 6, "late": 1, "repeated": 0, "restarts": 0}
    numbering.take([0])
    assert numbering.counts["restarts"] == 1


def test_a_growing_file_is_followed_through_rotation_and_cut_lines(tmp_path):
    path, framer = tmp_path / "recorder.jsonl", Framer()

    def lines_of(count: int) -> list[bytes]:
        found: list[bytes] = []
        deadline = time.monotonic() + PATIENCE
        while len(found) < count and time.monotonic() < deadline:
            for block in source.read(0.1):
                found += framer.cut(block)
        return found

    with GrowingFile(path) as source:
        path.write_bytes(b"one\ntw")
        assert lines_of(1) == [b"one"]
        with path.open("ab") as file:
            file.write(b"o\nthr")
        assert lines_of(1) == [b"two"]
        path.rename(path.with_suffix(".1"))  # logrotate: the last line was never finished
        path.write_bytes(b"four\n")
        assert lines_of(2) == [b"thr", b"four"]
        path.write_bytes(b"six\n")  # copytruncate
        time.sleep(0.2)
        with path.open("ab") as file:
            file.write(b"seven\n")
        assert lines_of(2)[-1] == b"seven"


def test_a_file_is_not_closed_while_a_slow_thread_reads_it(tmp_path, monkeypatch):
    path, failed = tmp_path / "recorder.jsonl", []
    about_to_read, goes_on = threading.Event(), threading.Event()
    path.write_bytes(b"one\n")

    class Slow(GrowingFile):
        def _take(self) -> bytes | None:
            if self._behind:
                about_to_read.set()
                goes_on.wait(PATIENCE)
            return super()._take()

    monkeypatch.setattr(threading, "excepthook", failed.append)
    with Slow(path) as source:
        assert source.read(PATIENCE) == [b"one\n"]
        assert about_to_read.wait(PATIENCE)
        thread = source._thread
        monkeypatch.setattr(source, "_thread", SimpleNamespace(join=lambda _: None))
    goes_on.set()
    thread.join(PATIENCE)
    assert not failed
    assert source._file.closed


def test_what_comes_at_the_very_end_of_a_source_is_recorded(tmp_path):
    class Late(Pipe):
        """Whose last block comes, and which ends, just after nothing was there to read."""

        def read(self, timeout: float) -> list[bytes]:
            blocks = super().read(0.0)
            if not self.ended:
                self._blocks.append(
                    b'{"topic":"/train/state","time":"2024-05-01T06:00Z","speed":1}\n'
                )
                self.ended = True
            return blocks

    recording, live = LiveIngest.begun(tmp_path / "a.mcap", Given(), LiveOptions("x"))
    with recording:
        live.follow(Late(BytesIO()))
        live.close()
    assert live.lines == 1


def test_addresses_that_are_none_are_refused():
    for wrong in ("", "host", "127.0.0.1", "1:99999"):
        refused(InputError, "is not an address; write PORT or HOST:PORT", Datagrams, wrong)
    with Datagrams("0") as source:
        assert source.name == f"UDP 127.0.0.1:{source.port}"
        refused(InputError, r"cannot listen to 127\.0\.0\.1", Datagrams, str(source.port))


@pytest.mark.skipif(sys.platform == "win32", reason="sends POSIX signals")
@pytest.mark.parametrize(
    "number",
    [
        signal.SIGKILL,
        *(pytest.param(n, marks=pytest.mark.long) for n in (signal.SIGTERM, signal.SIGINT)),
    ],
)
def test_what_ends_the_program_costs_a_second_at_most(number, tmp_path):
    log = tmp_path / "live.mcap"
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    words = ["record", "--from", "udp", str(port), "-o", str(log)]
    command = [sys.executable, "-m", "trainlog", *words]
    with (
        subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as program,
        socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as out,
    ):
        assert program.stdout.readline().startswith("recording UDP 127.0.0.1:")
        sent, stall = 0, 0.0  # the longest that a busy machine held up this process
        began = before = time.time()
        while time.time() - began < 1.6:
            stall, before = max(stall, time.time() - before), time.time()
            line = json.dumps(
                {"topic": STATE, "time": time.time(), "speed": 10.0, "sequence": sent}
            )
            out.sendto(line.encode(), ("127.0.0.1", port))
            sent += 1
            time.sleep(0.01)
        killed = time.time()
        os.kill(program.pid, number)
        said = program.communicate(timeout=PATIENCE)[0]
        status = program.returncode
    description = trainlog.describe(log)
    with pytest.warns(trainlog.DamageWarning) if number == signal.SIGKILL else nullcontext():
        state = trainlog.read(log)[STATE]
    last = state.index[-1].timestamp()
    if number == signal.SIGKILL:
        assert status == -signal.SIGKILL
        assert description.account.only_unclosed
        assert killed - last < 1.0 + stall
        return
    assert status == 0
    assert description.complete
    assert killed - last < 0.3 + stall
    assert f"{STATE}  {len(state):,}" in said
    assert "lost" not in said


def scalars_of(path: Path, entity: str) -> list[tuple[Any, float]]:
    """Time and value of every scalar that a replay holds of an entity, in the order of time."""
    chunk = pytest.importorskip("rerun.chunk")
    found = []
    for each in chunk.RrdReader(path).stream().to_chunks():
        if each.entity_path != entity:
            continue
        for row in each.to_record_batch().to_pylist():
            values = row.get("Scalars:scalars") or []
            found += [(row["time"], part) for part in values if np.isfinite(part)]
    return sorted(found)


def driven(recording: Any, seconds: int) -> None:
    for number in range(10 * seconds):
        at = (EPOCH * 10 + number) * 10**8
        recording.write(STATE, at, speed=0.1 * number, position=0.005 * number**2)
        recording.write("/train/controls", at, lever=0.5, tractive_effort=9e4)


def test_what_is_drawn_is_what_the_replay_of_the_log_draws(tmp_path):
    pytest.importorskip("rerun")
    log, drawn, replayed = (tmp_path / name for name in ("a.mcap", "live.rrd", "whole.rrd"))
    with (
        trainlog.record(log, flush=0.1, metadata={"trip": "a"}) as recording,
        trainlog.live_replay(recording, drawn) as drawing,
    ):
        for number in range(40):
            at = (EPOCH * 10 + number) * 10**8
            recording.write(STATE, at, speed=0.1 * number, position=0.005 * number**2)
            if number == 25:  # a topic that comes later is drawn, too
                recording.write("/train/controls", at, lever=0.5, tractive_effort=9e4)
            time.sleep(0.02)
    assert (drawing.drawn, drawing.dropped, drawing.problem) == (41, 0, "")
    trainlog.write_replay([trainlog.read(log)], replayed)
    for entity, count in (("/trips/a/speed/measured", 40), ("/trips/a/efforts/measured", 1)):
        left, right = scalars_of(drawn, entity), scalars_of(replayed, entity)
        assert len(left) == count
        assert left == right


class _Stuck:
    """A viewer that takes nothing until it is free."""

    def __init__(self, free: threading.Event) -> None:
        self._free = free

    def __getattr__(self, name: str) -> Any:
        return lambda *_, **__: self._free.wait(60.0)


def test_a_viewer_that_takes_nothing_does_not_delay_the_recording(tmp_path, monkeypatch):
    pytest.importorskip("rerun")
    from trainlog.replay import recording as live

    monkeypatch.setattr(live, "WAITING", 2)
    free = threading.Event()
    free.set()
    monkeypatch.setattr(live.rr, "RecordingStream", lambda *_, **__: _Stuck(free))
    monkeypatch.setattr(live, "_GrowingTrip", lambda *_: _Stuck(free))
    log = tmp_path / "a.mcap"
    with trainlog.record(log, flush=0.02) as recording:
        with trainlog.live_replay(recording, tmp_path / "live.rrd") as drawing:
            free.clear()
            for second in range(2):
                driven(recording, 1 + second)
                time.sleep(0.2)
            for number in range(40):
                recording.write("/imu", (EPOCH + number) * 10**9, specific_force_x=1.0)
                time.sleep(0.01)
            assert drawing.drawn == 0, "a sample was written after the viewer had been free"
            free.set()
        account = recording.account()
    assert account.dropped == account.waiting == {}
    assert drawing.dropped > 0
    assert f"{drawing.dropped:,} samples were not drawn; the log holds them" in drawing.sentences()
    assert drawing.drawn + drawing.dropped == sum(account.written.values())


def test_a_viewer_that_is_closed_ends_the_drawing_alone(tmp_path):
    pytest.importorskip("rerun")
    with (
        warnings.catch_warnings(record=True) as caught,
        trainlog.record(tmp_path / "a.mcap", flush=0.05) as recording,
        trainlog.live_replay(recording, tmp_path / "live.rrd") as drawing,
    ):
        warnings.simplefilter("always")
        drawing._viewer = subprocess.Popen([sys.executable, "-c", ""])
        drawing._viewer.wait()
        for _ in range(2):
            driven(recording, 1)
            time.sleep(0.4)
    assert "a.mcap is recorded, but no longer drawn: the viewer was closed" in [
        str(each.message) for each in caught
    ]
    assert len(trainlog.read(tmp_path / "a.mcap")[STATE]) == 20
    assert drawing.problem == "the viewer was closed"
    assert drawing.dropped >= 20


JOURNEY = SAMPLES / "CH_StGallen_Wil.sfera.zip"
MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")


class Broker:
    """A broker that keeps sessions and messages on the disk."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self._file = folder / "mosquitto.conf"
        self._file.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_location {folder}/\nautosave_on_changes true\nautosave_interval 1\n"
            "max_queued_messages 0\nuser root\n"
        )
        self.start()

    def start(self) -> None:
        """Start it, and wait until it listens."""
        words = [MOSQUITTO, "-c", str(self._file)]
        self._process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        for _ in range(200):
            with socket.socket() as tried:
                if tried.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError("mosquitto does not listen")

    def kill(self) -> None:
        """End it without a word."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """A broker of one's own."""
    if MOSQUITTO is None:
        pytest.skip("the broker mosquitto is not installed (apt install mosquitto)")
    folder = tmp_path / "broker"
    folder.mkdir()
    found = Broker(folder)
    yield found
    found.kill()


class Publisher:
    """A train that publishes, and goes on where a broker was away."""

    def __init__(self, port: int, topic: str) -> None:
        mqtt = pytest.importorskip("paho.mqtt.client")
        self._topic = topic
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, "train", clean_session=False)
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        self._client.on_publish = lambda *_: setattr(self, "left", self.left - 1)
        self.left = 0

    def publish(self, data: bytes) -> None:
        """Give a message to the broker, now or once it is there again."""
        self.left += 1
        self._client.publish(self._topic, data, qos=1)

    def close(self) -> None:
        """Wait until the broker has them all."""
        began = time.monotonic()
        while self.left and time.monotonic() - began < PATIENCE:
            time.sleep(0.02)
        self._client.disconnect()
        self._client.loop_stop()


def speed(second: int) -> bytes:
    time_of = f"2026-05-17T06:{second // 60:02d}:{second % 60:02d}Z"
    values = {"topic": "/train/state", "time": time_of, "position": 20.0 * second, "speed": 20.0}
    return json.dumps(values | {"sequence": second}).encode()


def published(source: Subscription, path: Path, idle: float) -> Trip:
    """The log of what a broker gives."""
    recording, live = LiveIngest.begun(path, Given(), LiveOptions(source.name))
    with recording:
        live.follow(source, idle=idle)
        live.close()
    return trainlog.read(path)


@pytest.mark.long
def test_a_broker_that_is_killed_and_started_again_loses_nothing(broker, tmp_path):
    """Of 600 messages at 200 a second; the broker is killed twice, the recorder is left alone."""
    with Subscription(f"127.0.0.1:{broker.port}/trains/17") as source:
        train = Publisher(broker.port, "trains/17")

        def send() -> None:
            for second in range(600):
                if second in (200, 400):
                    broker.kill()
                    broker.start()
                train.publish(speed(second))
                time.sleep(0.005)
            train.close()

        sending = threading.Thread(target=send)
        sending.start()
        state = published(source, tmp_path / "a.mcap", 6.0)["/train/state"]
        sending.join(PATIENCE)
    assert source.lost == 0
    assert state.position.to_numpy().tolist() == [20.0 * second for second in range(600)]


def test_what_comes_while_the_recorder_is_away_is_kept_for_it(broker, tmp_path):
    address = f"127.0.0.1:{broker.port}/trains/%2B/reports"
    with Subscription(address):
        pass
    train = Publisher(broker.port, "trains/17/reports")
    for second in range(30):
        train.publish(speed(second))
    train.close()
    with Subscription(address) as source:
        assert len(published(source, tmp_path / "a.mcap", 1.0)["/train/state"]) == 30


def test_status_reports_of_sfera_are_recorded_as_they_come(broker, tmp_path, works):
    """The command, with the sample's journey; the same as ingesting the archive of the reports."""
    (journey,) = read_sfera(JOURNEY)
    log, topic = tmp_path / "a.mcap", f"127.0.0.1:{broker.port}/trains/17"
    with Subscription(topic):
        pass
    train = Publisher(broker.port, "trains/17")
    for number in range(100):
        report = Report(
            DEPARTURE + timedelta(seconds=5 * number), 100.0 * number, 20.0, slips=40 < number < 45
        )
        train.publish(xml_of(status_report(report, journey.segments, journey.profile, "unit")))
    train.publish(b"<broken")
    train.close()
    words = ["record", topic, "--from", "mqtt", "--line", str(JOURNEY), "--idle", "1s"]
    works(*words, "-o", log)
    trip = trainlog.read(log)
    assert trip["/train/state"].position.to_numpy().tolist() == pytest.approx(
        [100.0 * number for number in range(100)], abs=1e-3
    )
    events = trip["/events"]
    assert (events.name == "slip protection").sum() == 1
    assert events.message.str.contains("malformed line 101").sum() == 1
    assert trip.metadata["line"] == journey.line.name


def test_a_trip_is_published_as_it_ran_and_recorded_again(broker, tmp_path, works):
    topic = f"127.0.0.1:{broker.port}/trains/17"
    with Subscription(topic):
        pass
    options = SferaOptions(every=10.0, publish=topic, pace=2000.0)
    began = time.monotonic()
    said = write_sfera([SAMPLES / "nonstop.mcap"], JOURNEY, tmp_path / "reports.zip", options)
    lasted = time.monotonic() - began
    words = ["record", topic, "--from", "mqtt", "--line", str(JOURNEY), "--idle", "1s"]
    works(*words, "-o", tmp_path / "a.mcap")
    state = trainlog.read(tmp_path / "a.mcap")["/train/state"]
    assert len(state) == said["published"] == said["reports"]
    own = trainlog.read(SAMPLES / "nonstop.mcap")["/train/state"]
    run = (own.index[-1] - own.index[0]).total_seconds()
    assert lasted > 0.9 * run / 2000.0
    assert state.position.iloc[-1] == pytest.approx(own.position.dropna().iloc[-1], abs=300.0)


def test_what_is_no_broker_or_cannot_be_published_is_one_line(tmp_path):
    pytest.importorskip("paho.mqtt.client")
    for address, said in (
        ("", "'' is not a topic of a broker"),
        ("localhost", "'localhost' is not a topic of a broker"),
        ("http://localhost/a", "is not a topic of a broker"),
        ("127.0.0.1:1/a", "the broker 127.0.0.1:1 cannot be subscribed to: connection refused"),
    ):
        assert refused(InputError, said, Subscription, address).remedy
    for given, address, said in (
        (tmp_path / "forecast.csv", "localhost/a", "--publish goes with a trip"),
        (SAMPLES / "nonstop.mcap", "localhost/trains/+", "has a wildcard"),
        (
            SAMPLES / "nonstop.mcap",
            "127.0.0.1:1/a",
            "127.0.0.1:1 cannot be published to: connection",
        ),
    ):
        options = SferaOptions(publish=address)
        refused(InputError, said, write_sfera, [given], JOURNEY, tmp_path / "a.zip", options)
    assert not list(tmp_path.iterdir())
