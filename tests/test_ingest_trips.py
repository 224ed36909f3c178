"""Files of several trips and many files at once: what became of each, its load and place."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
from contents import put
from killed import PATIENCE
from recorder_files import gpx
from refusals import refused
from simulated_line import level_line

from trainlog import DEFAULT_TRAIN, read, read_train, sample
from trainlog.errors import InputError
from trainlog.ingest import Ingested, batch, ingest, ingest_all, propose_profile, report_of
from trainlog.ingest.batch import files_of
from trainlog.ingest.matching import gradients_in, placed
from trainlog.ingest.motion import SURE
from trainlog.ingest.pipeline import fingerprint
from trainlog.ingest.recording import Table
from trainlog.mcap import read_log, write_log
from trainlog.railway.line import Line, Station, StepProfile

BEGIN = np.datetime64("2025-03-11T05:30:00", "ms")


@dataclass(frozen=True)
class Run:
    """A trip of the generator: a day's second, stops [m] from its start, facts."""

    number: str
    begin: int
    stops: tuple[float, ...]
    payload: float
    weather: str
    top: float = 22.0


RUNS = (
    Run("RE 3105", 0, (3100.0, 7400.0, 9800.0), 9400.0, "trocken"),
    Run("RE 3109", 4_200, (3100.0, 7400.0, 9800.0), 3100.0, "nass", 17.0),
    Run("RE 3113", 9_000, (3100.0, 9800.0), 12250.0, "nass", 25.0),
)


def driven(run: Run, step: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    """Distance [m] and speed [m/s]: constant rates, one minute at every stop."""
    distance, speed = [0.0] * 20, [0.0] * 20
    for stop in run.stops:
        while (left := stop - distance[-1]) > 0.5:
            most = min(speed[-1] + 0.6 * step, run.top, np.sqrt(2.0 * 0.5 * left))
            speed.append(max(most, 0.3))
            distance.append(min(distance[-1] + 0.5 * (speed[-1] + speed[-2]) * step, stop))
        distance += [stop] * 60
        speed += [0.0] * 60
    return np.array(distance), np.array(speed)


def table(runs: tuple[Run, ...], *, numbered: bool = True, counter: float = 54_321.0) -> str:
    """Comma-separated, English names, miles an hour: another recorder than in other tests."""
    names = ["Timestamp", *(["Train no."] if numbered else []), "Odometer (m)", "Speed (mph)"]
    lines = [",".join([*names, "Payload [kg]", "Wetter", "Cabin noise [dB]", "Oil level [mm]"])]
    for run in runs:
        distance, speed = driven(run)
        for second, (way, fast) in enumerate(zip(distance, speed, strict=True)):
            time = BEGIN + np.timedelta64(1000 * (run.begin + second), "ms")
            cells = [str(time).replace("T", " "), *([run.number] if numbered else [])]
            cells += [f"{counter + way:.1f}", f"{fast / 0.44704:.2f}", f"{run.payload:.0f}"]
            cells += [run.weather, "61", f"{40 + second % 7}"]
            lines.append(",".join(cells))
        counter += distance[-1]
    return "\n".join(lines) + "\n"


def written(folder: Path, text: str, name: str = "week.csv") -> Path:
    return put(folder / name, text)


def test_numbered_trips_become_logs_with_their_load_and_weather(tmp_path):
    file = written(tmp_path, table(RUNS))
    proposal = propose_profile(file)
    assert any("RE 3105, RE 3109, RE 3113" in line for line in proposal.lines())
    result = ingest_all(file, tmp_path / "logs", proposal.profile)
    names = [each.log.name for each in result.outcomes if each.log]
    assert names == [f"week-RE_{number}.mcap" for number in (3105, 3109, 3113)]
    for run, each in zip(RUNS, result.outcomes, strict=True):
        trip = read(each.log)
        assert trip.metadata["trip_number"] == run.number
        assert float(trip.metadata["load"]) == run.payload
        assert trip.metadata["weather"] == {"trocken": "dry", "nass": "wet"}[run.weather]
        assert np.ptp(trip["/train/state"].position) == pytest.approx(run.stops[-1], abs=0.2)
        # A quantity without a field is kept.
        assert trip["/recorded/other"]["oil_level"].max() == pytest.approx(0.046)
    # No row of the file is lost between the trips.
    assert sum(each.report.rows_read for each in result.outcomes if each.report) == sum(
        len(driven(run)[0]) for run in RUNS
    )


def test_pauses_part_trips_that_no_column_numbers(tmp_path):
    file = written(tmp_path, table(RUNS, numbered=False))
    proposal = propose_profile(file)
    assert proposal.profile.limits.pause == 900.0
    assert any("3 trips" in line for line in proposal.lines())
    result = ingest_all(file, tmp_path / "logs", proposal.profile)
    assert [each.recording for each in result.outcomes] == ["week-01", "week-02", "week-03"]
    assert [each.metadata["load"] for each in result.outcomes] == ["9400", "3100", "12250"]


def test_a_standstill_with_rows_parts_trips_and_keeps_every_row(tmp_path):
    distance, speed = driven(RUNS[0])
    still = 2_400
    rows = ["Time,Speed (km/h),Distance (m)"]
    way = np.concatenate([distance, np.full(still, distance[-1]), distance[-1] + distance])
    fast = np.concatenate([speed, np.zeros(still), speed])
    for second, (s, v) in enumerate(zip(way, fast, strict=True)):
        rows.append(f"{BEGIN + np.timedelta64(1000 * second, 'ms')},{3.6 * v:.2f},{s:.1f}")
    file = written(tmp_path, "\n".join(rows), "day.csv")
    result = ingest_all(file, tmp_path / "logs", propose_profile(file).profile)
    assert [each.recording for each in result.outcomes] == ["day-01", "day-02"]
    reports = [each.report for each in result.outcomes if each.report]
    assert sum(report.rows_kept for report in reports) == way.size
    lengths = [report.rows_kept for report in reports]
    assert abs(lengths[0] - lengths[1]) < 120


def test_a_clock_that_leaps_while_the_train_runs_parts_no_trip(tmp_path):
    text = table(RUNS[:1], numbered=False).splitlines()
    late = [line.replace("2025-03-11", "2025-03-12") for line in text[180:]]
    file = written(tmp_path, "\n".join([*text[:180], *late]))
    result = ingest_all(file, tmp_path / "logs", propose_profile(file).profile)
    assert len(result.outcomes) == 1


def test_a_load_that_changes_within_a_trip_is_not_used(tmp_path):
    file = written(tmp_path, table(RUNS))
    profile = propose_profile(file).profile
    columns = replace(profile.trip.columns, number=None)
    whole = replace(profile, trip=replace(profile.trip, columns=columns))
    trip = ingest(file, whole)
    assert "load" not in trip.metadata
    assert any("changes within the trip" in what for what in report_of(trip).not_used)


def test_a_copy_under_another_name_is_skipped(tmp_path):
    file = written(tmp_path, table(RUNS))
    profile = propose_profile(file).profile
    logs = tmp_path / "logs"
    ingest_all(file, logs, profile)
    copy = written(tmp_path, file.read_text(encoding="utf-8"), "copy.csv")
    other = replace(profile, name="read in another way")
    again = ingest_all(copy, logs, other)
    assert [each.state for each in again.outcomes] == ["unchanged"] * 3
    assert "same content as week.csv" in again.outcomes[0].reason
    assert len(list(logs.glob("*.mcap"))) == 3
    # The file itself may be read in another way.
    assert {each.state for each in ingest_all(file, logs, other).outcomes} <= {"made", "repaired"}


STATIONS = (500.0, 3600.0, 7900.0, 10_300.0)


def railway(length: float = 11_000.0, *, level: bool = False) -> Line:
    """A line of four stations that lie otherwise from its other end, rising and falling."""
    slopes = [0.0, 0.0] if level else [0.004, -0.009, 0.012, -0.002, 0.007]
    places = np.linspace(0.0, length, len(slopes), endpoint=False)
    stations = tuple(Station(f"S{number}", at) for number, at in enumerate(STATIONS))
    gradients = StepProfile(places, np.array(slopes))
    return level_line(length, limit=40.0, name="valley", stations=stations, gradients=gradients)


def test_a_counter_that_starts_elsewhere_is_placed_by_the_stops_of_each_trip(tmp_path):
    back = replace(RUNS[1], number="RE 3110", stops=(2400.0, 6700.0, 9800.0))
    file = written(tmp_path, table((RUNS[0], back)))
    line = railway()
    proposal = propose_profile(file, line=line)
    assert proposal.profile.trip.start_position == "stations"
    result = ingest_all(file, tmp_path / "logs", proposal.profile, line=line)
    trips = [read(each.log) for each in result.outcomes if each.log]
    assert [trip.metadata["direction"] for trip in trips] == ["forward", "reverse"]
    assert [round(trip["/train/state"].position.min()) for trip in trips] == [500, 700]
    assert "4 of 4 stops at stations reverse" in trips[1].metadata["direction_evidence"]


def test_stops_that_match_no_station_leave_the_start_open(tmp_path):
    other = replace(RUNS[0], stops=(1500.0, 4000.0, 8_800.0))
    file = written(tmp_path, table((other,)))
    line = railway()
    proposal = propose_profile(file, line=line)
    assert proposal.profile.trip.start_position is None
    assert any("start_position" in question for question in proposal.open)
    refused(InputError, r"start_position=0\.2km", ingest, file, proposal.profile, line=line)
    trip = ingest(file, proposal.profile, line=line, metadata={"start_position": "150"})
    assert trip["/train/state"].position.min() == pytest.approx(150.0)


def over_gradients(travelled: Line, mass: float, noise: float = 2e3) -> Table:
    """A run whose efforts [N] follow the gradients, but for noise."""
    rng = np.random.default_rng(3)
    time = np.arange(0.0, 420.0, 0.5)
    speed = 24.0 + 5.0 * np.sin(time / 23.0) + 2.0 * np.sin(time / 7.0)
    place = 400.0 + np.cumsum(speed) * 0.5
    slope = travelled.gradient(np.clip(place - 40.0, 0.0, travelled.length))
    force = mass * (1.06 * np.gradient(speed, time) + 9.81 * slope)
    force = 1.05 * (force + 3e3 + 90.0 * speed + 7.0 * speed**2) + rng.normal(0.0, noise, time.size)
    signals = {
        "/train/state.position": place,
        "/train/state.speed": speed + rng.normal(0.0, 0.05, time.size),
        "/train/controls.tractive_effort": np.maximum(force, 0.0),
        "/train/controls.dynamic_braking_effort": np.maximum(-force, 0.0),
    }
    return Table((time * 1e9).astype(np.int64), np.arange(time.size), signals)


@pytest.mark.parametrize("way", ["forward", "reverse"])
def test_the_direction_of_a_trip_without_stops_shows_in_its_gradients(way):
    line, train = railway(), read_train(sample(DEFAULT_TRAIN))
    # Mass, resistance and scale of the efforts are not those of the train's file.
    samples = over_gradients(line if way == "forward" else line.reversed(), 1.13 * train.mass)
    assert placed(samples, line, train, None, by_stations=False).direction == way
    other = "reverse" if way == "forward" else "forward"
    assert placed(samples, line, train, other, by_stations=False).direction == way
    level = placed(samples, railway(level=True), train, None, by_stations=False)
    assert level.direction == ""
    assert "assumed" in level.evidence


def test_gradients_that_favour_a_direction_by_less_than_certainty_do_not_decide_it():
    line, train = railway(), read_train(sample(DEFAULT_TRAIN))
    samples = over_gradients(line, 1.13 * train.mass, noise=33e3)
    ways = [gradients_in(samples, each, train, None) for each in (line, line.reversed())]
    forward, reverse = (each.squares for each in ways)
    assert 8.0 < ways[0].windows / 6.0 * np.log(reverse / forward) < SURE
    assert placed(samples, line, train, None, by_stations=False).direction == ""


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


def test_a_file_copied_renamed_or_given_twice_is_one(tmp_path):
    logs = tmp_path / "logs"
    recording = put(tmp_path / "a.csv", sample("gnss.csv").read_bytes())
    assert len(files_of([recording, tmp_path, recording], logs)) == 1
    result = ingest_all([recording, put(tmp_path / "b.csv", recording.read_bytes())], logs)
    assert states(result) == {"a.csv": "repaired", "b.csv": "unchanged"}
    assert result.outcomes[1].reason == f"of the same content as {recording}"
    renamed = recording.rename(tmp_path / "ride.csv")
    assert states(ingest_all(renamed, logs)) == {"ride.csv": "unchanged"}
    assert [log.name for log in logs.iterdir()] == ["a.mcap"]


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


def test_a_reader_that_breaks_stops_no_other_file(campaign, tmp_path, monkeypatch):
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
