"""Many recorded files at once: every one is tried, and what became of each is listed."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from contents import put
from killed import PATIENCE
from recorder_files import drive, gpx, gpx_text
from refusals import refused

from trainlog.errors import InputError
from trainlog.formats.samples import sample
from trainlog.ingest import Ingested, ingest_all
from trainlog.ingest.batch import files_of
from trainlog.ingest.pipeline import fingerprint
from trainlog.mcap import read_log, write_log


def states(result: Ingested) -> dict[str, str]:
    return {each.recording or each.file.name: each.state for each in result.outcomes}


@pytest.fixture
def campaign(tmp_path: Path) -> Path:
    """A folder from the field: recordings in folders of days, and what lies beside them."""
    folder = tmp_path / "campaign"
    for day, seed in (("day-1", 1), ("day-2", 2)):
        (folder / day).mkdir(parents=True)
        (folder / day / "run.gpx").write_text(gpx(seed).text, "utf-8")
    (folder / "day-1" / "gnss.csv").write_bytes(sample("gnss.csv").read_bytes())
    (folder / "day-1" / "recorder.profile.toml").write_bytes(
        sample("recorder.profile.toml").read_bytes()
    )
    (folder / "README.txt").write_text("Recorded in May, all on one train.\n", "utf-8")
    (folder / ".hidden.gpx").write_text("not to be looked at", "utf-8")
    (folder / "stopping.mcap").write_bytes(sample("stopping.mcap").read_bytes())
    (folder / "cut.gpx").write_text("<gpx><trk>", "utf-8")
    (folder / "empty.csv").write_bytes(b"")
    (folder / "noise.csv").write_bytes(np.random.default_rng(1).bytes(5000))
    return folder


def test_every_file_of_a_folder_is_tried_and_a_log_made_once(campaign, tmp_path):
    result = ingest_all(campaign, tmp_path / "logs")
    found = {each.file.relative_to(campaign).as_posix(): each.state for each in result.outcomes}
    assert found == {
        "README.txt": "passed_over",
        "cut.gpx": "refused",
        "day-1/gnss.csv": "repaired",
        "day-1/recorder.profile.toml": "passed_over",
        "day-1/run.gpx": "repaired",
        "day-2/run.gpx": "repaired",
        "empty.csv": "refused",
        "noise.csv": "refused",
        "stopping.mcap": "passed_over",
    }
    assert result.failed
    names = sorted(log.name for log in (tmp_path / "logs").iterdir())
    assert names == ["day-1_run.mcap", "day-2_run.mcap", "gnss.mcap"]
    for outcome in result.of("made", "repaired"):
        assert read_log(outcome.log).provenance[0]["inputs"][outcome.file.name]
    reasons = {each.file.name: each.reason for each in result.outcomes}
    assert "is not XML" in reasons["cut.gpx"]
    assert "is empty" in reasons["empty.csv"]
    assert reasons["stopping.mcap"] == "a log of trainlog"
    assert result.frame.shape == (9, 9)
    (fixes,) = (each for each in result.outcomes if each.file.name == "gnss.csv")
    assert fixes.repairs == {"subsecond": 5477, "spikes": 3, "gaps": 1}

    # What was made before is not made again.
    logs = tmp_path / "logs"
    before = {log: log.stat().st_mtime_ns for log in logs.iterdir()}
    again = ingest_all(campaign, logs)
    expected = {"made": 0, "repaired": 0, "unchanged": 3, "refused": 3, "passed_over": 3}
    assert again.counts == expected
    assert {log: log.stat().st_mtime_ns for log in logs.iterdir()} == before
    (fixes,) = (each for each in again.of("unchanged") if each.file.name == "gnss.csv")
    assert fixes.repairs["spikes"] == 3, "what was repaired then is stated again"


@pytest.mark.parametrize("what", ["facts", "direction", "content", "profile", "code", "log"])
def test_what_would_come_out_otherwise_is_made_again(what, tmp_path, monkeypatch):
    recording, profile = tmp_path / "recorder.csv", tmp_path / "recorder.profile.toml"
    rows = sample("recorder.csv").read_bytes().splitlines(keepends=True)[:3_000]
    recording.write_bytes(b"".join(rows))
    profile.write_bytes(sample("recorder.profile.toml").read_bytes())
    logs = tmp_path / "logs"
    first = ingest_all(recording, logs, profile)
    assert states(first) == {"recorder.csv": "repaired"}
    options: dict[str, object] = {}
    if what == "facts":
        options = {"metadata": {"load": "12000"}}
    elif what == "direction":
        options = {"direction": "reverse"}
    elif what == "content":
        recording.write_bytes(b"".join(rows[:2_000]))
    elif what == "profile":
        profile.write_text(f"{profile.read_text('utf-8')}\n# a remark\n", "utf-8")
    elif what == "code":
        other = lambda *given: fingerprint(*given) | {"code": "of another day"}  # noqa: E731
        monkeypatch.setattr("trainlog.ingest.batch.fingerprint", other)
    else:
        (log,) = logs.iterdir()
        log.write_bytes(log.read_bytes()[:-2000])
    second = ingest_all(recording, logs, profile, **options)
    assert states(second) == {"recorder.csv": "repaired"}
    names = {"recorder.mcap"} | ({second.outcomes[0].log.name} if what == "content" else set())
    assert {log.name for log in logs.iterdir()} == names
    assert len(names) == (2 if what == "content" else 1), "other content has a log of its own"


def test_equal_content_under_two_names_is_one_trip(tmp_path):
    for name in ("a.csv", "b.csv"):
        (tmp_path / name).write_bytes(sample("gnss.csv").read_bytes())
    result = ingest_all([tmp_path / "a.csv", tmp_path / "b.csv"], tmp_path / "logs")
    assert states(result) == {"a.csv": "repaired", "b.csv": "unchanged"}
    assert result.outcomes[1].reason == f"of the same content as {tmp_path / 'a.csv'}"
    assert [log.name for log in (tmp_path / "logs").iterdir()] == ["a.mcap"]


def test_a_file_renamed_or_given_twice_is_one(tmp_path):
    recording = put(tmp_path / "gnss.csv", sample("gnss.csv").read_bytes())
    assert len(files_of([recording, tmp_path, recording], tmp_path / "logs")) == 1
    ingest_all(recording, tmp_path / "logs")
    renamed = recording.rename(tmp_path / "ride.csv")
    assert states(ingest_all(renamed, tmp_path / "logs")) == {"ride.csv": "unchanged"}


def test_a_log_of_something_else_is_not_overwritten(tmp_path):
    logs = tmp_path / "logs"
    logs.mkdir()
    driven = read_log(sample("stopping.mcap"))
    write_log(driven, logs / "run.mcap")
    (tmp_path / "run.gpx").write_text(gpx(1).text, "utf-8")
    first = ingest_all(tmp_path / "run.gpx", logs)
    assert read_log(logs / "run.mcap") == driven
    other = first.outcomes[0].log
    assert other.name.startswith("run-")
    assert ingest_all(tmp_path / "run.gpx", logs).outcomes[0].log == other


def test_a_recording_that_has_grown_takes_its_logs_place(tmp_path):
    data, logs = sample("gnss.csv").read_bytes(), tmp_path / "logs"
    recording = put(tmp_path / "gnss.csv", data[: len(data) // 2])
    ingest_all(recording, logs)
    recording.write_bytes(data)
    assert states(ingest_all(recording, logs)) == {"gnss.csv": "repaired"}
    assert [log.name for log in logs.iterdir()] == ["gnss.mcap"]
    assert len(read_log(logs / "gnss.mcap")["/gnss/fix"]) == 6847


def test_of_a_file_with_several_recordings_each_is_listed(tmp_path):
    text = gpx_text(drive(60, 1.0, 1), parts=[[np.arange(30)], [np.arange(30, 60)]])
    logs = tmp_path / "logs"
    path = put(tmp_path / "day.gpx", text)
    assert states(ingest_all(path, logs)) == {"day-1": "made", "day-2": "made"}
    # The second track loses its times: no trip, and its earlier log stays.
    head, middle, tail = text.partition("</trk>")
    path.write_text(head + middle + tail.replace("<time>", "<at>").replace("</time>", "</at>"))
    again = ingest_all(path, logs)
    assert [each.state for each in again.of("refused")] == ["refused"]
    assert len(again.of("made", "repaired")) == 1
    assert {"day-1.mcap", "day-2.mcap"} <= {log.name for log in logs.iterdir()}


def test_a_reader_that_breaks_stops_no_other_file(campaign, tmp_path, monkeypatch):
    from trainlog.ingest import batch

    usual = batch.ingested

    def broken(path: Path, given: object) -> object:
        if path.name == "gnss.csv":
            raise ZeroDivisionError("a defect")
        return usual(path, given)

    monkeypatch.setattr(batch, "ingested", broken)
    result = ingest_all(campaign, tmp_path / "logs")
    (failed,) = (each for each in result.of("refused") if each.file.name == "gnss.csv")
    assert "ZeroDivisionError" in failed.reason
    assert result.counts["repaired"] == 2


def test_what_cannot_be_used_at_all_is_refused(tmp_path):
    (tmp_path / "none").mkdir()
    refused(InputError, "has no files", ingest_all, tmp_path / "none", tmp_path / "logs")
    with pytest.raises(InputError, match="does not exist"):
        ingest_all(sample("gnss.csv"), tmp_path / "logs", tmp_path / "absent.toml")
    with pytest.raises(InputError, match="no format 'gnns'"):
        ingest_all(sample("gnss.csv"), tmp_path / "logs", format="gnns")
    assert not (tmp_path / "logs").exists()


def test_the_command_lists_all_and_its_status_says_whether_any_failed(campaign, tmp_path, shell):
    logs = tmp_path / "logs"
    status, shown, _ = shell("ingest", campaign, "-o", logs)
    assert status == 1
    assert "day-2_run.mcap" in shown
    assert shown.count("refused: ") == 3
    assert shown.count("passed over: ") == 3
    assert "3 trips made, 3 of them with repairs; 3 refused; 3 files passed over." in shown
    status, shown, _ = shell("ingest", campaign, "-o", logs, "--json")
    assert status == 1
    found = json.loads(shown)
    assert (found["format"], found["version"]) == ("trainlog/ingest", 1)
    assert found["counts"]["unchanged"] == 3
    states = {each["state"] for each in found["recordings"]}
    assert states == {"unchanged", "refused", "passed_over"}
    for name in ("cut.gpx", "empty.csv", "noise.csv"):
        (campaign / name).unlink()
    assert shell("ingest", campaign, "-o", logs)[0] == 0


def test_interrupted_it_keeps_whole_logs_and_lists_them(tmp_path):
    folder, logs = tmp_path / "many", tmp_path / "logs"
    folder.mkdir()
    head = sample("gnss.csv").read_text("utf-8").splitlines()[:2_000]
    text = "\n".join(head)
    for number in range(100):
        (folder / f"{number:03d}.csv").write_text(f"{text}\n{'#' * number}", "utf-8")
    words = [sys.executable, "-m", "trainlog", "ingest", str(folder), "-o", str(logs)]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=dict(os.environ)
    ) as process:
        deadline = time.monotonic() + PATIENCE
        while len(list(logs.glob("[0-9]*.mcap"))) < 3 and time.monotonic() < deadline:
            time.sleep(0.02)
        process.send_signal(signal.SIGINT)
        shown, complaint = process.communicate(timeout=PATIENCE)
    assert process.returncode == 130, complaint
    kept = len(list(logs.glob("[0-9]*.mcap")))
    assert complaint == f"trainlog: interrupted: {kept} files written\n"
    finished = sorted(logs.iterdir())
    assert 3 <= len(finished) < 100
    # The last may have been written, and counted, just before it would have been listed.
    assert all(log.name in shown for log in finished[:-1])
    for log in finished:
        assert len(read_log(log)["/gnss/fix"]) > 1_500
