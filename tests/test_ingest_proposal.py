"""Profiles proposed for tables of unknown layouts: what they read must be what was recorded."""

from __future__ import annotations

import json
import re
import shlex
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from recorder_layouts import Verdict, draw, judged, table
from typer.testing import CliRunner

from analysis import fit_trip
from trainlog.cli.main import app
from trainlog.errors import InputError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.ingest import Proposal, ingest, propose_profile
from trainlog.railway import RunningResistance
from trainlog.trip import Trip

SHARED = Path(__file__).parents[1] / ".." / "shared" / "data"
RECORDER = Path("sample_logs/recorder.csv")
LAYOUTS = range(500, 515)


def drive(count: int = 600, step: float = 1.0) -> pd.DataFrame:
    """A trip of a train of 200 t over level track: speeds up, runs, brakes, three times."""
    seconds = np.arange(count) * step
    rate = (
        0.6
        * np.sign(np.sin(2.0 * np.pi * seconds / 200.0))
        * (np.abs(np.sin(2.0 * np.pi * seconds / 200.0)) > 0.6)
    )
    speed = np.maximum(np.cumsum(rate) * step, 0.0)
    resistance = (3e3 + 60.0 * speed + 8.0 * speed**2) * (speed > 0)
    return pd.DataFrame(
        {
            "t": seconds,
            "v": speed,
            "s": np.cumsum(speed) * step,
            "F": 200e3 * rate + resistance,
        }
    )


def written(folder: Path, columns: dict[str, object], name: str = "run.csv") -> Path:
    path = folder / name
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
    return path


def field(proposal: Proposal, name: str) -> dict[str, str]:
    return dict(proposal.evidence.set_index("field").loc[name])


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> list[Verdict]:
    folder = tmp_path_factory.mktemp("layouts")
    return [judged(draw(folder, seed)) for seed in LAYOUTS]


def test_no_layout_is_read_wrongly_without_a_word(verdicts: list[Verdict]) -> None:
    wrong = [str(verdict) for verdict in verdicts if verdict.silently_wrong]
    assert not wrong, table(verdicts) + "\n".join(wrong)


def test_nine_of_ten_layouts_are_read_rightly(verdicts: list[Verdict]) -> None:
    right = sum(verdict.all_right for verdict in verdicts)
    others = [str(verdict) for verdict in verdicts if not verdict.all_right]
    assert right >= 0.9 * len(verdicts), table(verdicts) + "\n".join(others)


@pytest.mark.long
def test_three_hundred_layouts(tmp_path: Path) -> None:
    verdicts = [judged(draw(tmp_path, seed)) for seed in range(3_000, 3_300)]
    wrong = [str(verdict) for verdict in verdicts if verdict.silently_wrong]
    print(table(verdicts))
    assert len(wrong) <= 3, "\n".join(wrong)
    assert sum(verdict.all_right for verdict in verdicts) >= 0.95 * len(verdicts)


def test_every_column_is_used_or_listed(verdicts: list[Verdict]) -> None:
    for verdict in verdicts:
        proposal = verdict.proposal
        assert proposal is not None, verdict.refused
        assert proposal.profile.time is not None
        used = {n for c in proposal.profile.columns.values() for n in c.names}
        used |= set(proposal.profile.time.names)
        used |= set(proposal.profile.trip.columns.names)
        assert used | set(proposal.not_used) == set(proposal.names)


def test_the_sample_recorder_is_ingested_as_with_its_own_profile() -> None:
    proposal = propose_profile(RECORDER)
    assert proposal.profile.time is not None
    zoned = proposal.profile.model_copy(
        update={"time": proposal.profile.time.model_copy(update={"timezone": "Europe/Zurich"})}
    )
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    proposed, true = (
        ingest(RECORDER, profile, line=line, train=train, metadata={"load": "12000"})
        for profile in (zoned, "sample_logs/recorder.profile.toml")
    )
    assert list(proposed.topics) == list(true.topics)
    for name, frame in true.topics.items():
        pd.testing.assert_frame_equal(proposed[name], frame)
    assert curve(proposed) == curve(true)


def curve(trip: Trip) -> RunningResistance:
    return fit_trip(trip).resistance


def test_what_the_file_does_not_state_is_open() -> None:
    proposal = propose_profile(RECORDER)
    assert [question.split(":")[0] for question in proposal.open] == ["time zone"]
    assert "# open: or local time" in proposal.text


def test_a_stated_unit_that_contradicts_mechanics_is_open(tmp_path: Path) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "F [kN]": run.F})
    effort = field(propose_profile(path), "/train/controls.tractive_effort")
    assert effort["unit"] == "N"
    assert effort["alternative"] == "kN, as the file states"


def test_the_train_decides_between_units(tmp_path: Path) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "F": run.F})
    unknown = field(propose_profile(path), "/train/controls.tractive_effort")
    assert (unknown["unit"], unknown["alternative"]) == ("N", "daN or lbf")
    train = read_train(sample(DEFAULT_TRAIN))
    known = field(propose_profile(path, train), "/train/controls.tractive_effort")
    assert (known["unit"], known["alternative"]) == ("N", "")


def test_a_table_without_names_is_read_by_what_its_columns_do(tmp_path: Path) -> None:
    run = drive()
    stamps = pd.Timestamp("2024-05-01T06:00:00") + pd.to_timedelta(run.t, unit="s")
    frame = pd.DataFrame({"t": stamps, "x": run.v * 3.6, "y": run.s})
    path = tmp_path / "bare.csv"
    frame.to_csv(path, index=False, header=False, float_format="%.6g")
    trip = ingest(path, propose_profile(path).profile)
    np.testing.assert_allclose(trip["/train/state"]["speed"], run.v, atol=1e-3)
    np.testing.assert_allclose(trip["/train/state"]["position"], run.s, atol=0.1)


@pytest.mark.parametrize(
    ("columns", "remedy"),
    [
        ({"t": "1,0", "v": "2,5"}, "write it with semicolons"),
        ({"t [min]": "1.0", "v [km/h]": "2.5"}, "which a profile cannot read"),
    ],
)
def test_what_no_profile_can_read_is_refused(
    tmp_path: Path, columns: dict[str, str], remedy: str
) -> None:
    rows = [",".join(f'"{number}{cell[1:]}"' for cell in columns.values()) for number in range(50)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    with pytest.raises(InputError, match=remedy):
        propose_profile(path)


def test_south_west_in_degrees_and_minutes(tmp_path: Path) -> None:
    run = drive()
    stamps = pd.Timestamp("2024-05-01T06:00:00Z") + pd.to_timedelta(run.t, unit="s")
    path = written(
        tmp_path,
        {
            "time": stamps,
            "lat": 3330.0 + run.s / 1853.25,
            "NS": "S",
            "lon": 7040.0,
            "EW": "W",
            "speed [kn]": run.v * 1.943844,
        },
    )
    fix = ingest(path, propose_profile(path).profile)["/gnss/fix"]
    assert fix["latitude"].iloc[0] == pytest.approx(-33.5)
    assert fix["longitude"].iloc[0] == pytest.approx(-70.0 - 40.0 / 60.0)


def test_a_distance_that_contradicts_the_speed_is_not_used(tmp_path: Path) -> None:
    run = drive()
    noise = np.random.default_rng(1).uniform(0.0, 9_000.0, len(run))
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "Weg [m]": noise})
    proposal = propose_profile(path)
    assert "/train/state.position" not in proposal.profile.columns
    assert "does not follow the speed" in proposal.not_used["Weg [m]"]


@pytest.mark.parametrize(
    ("days", "pattern", "opened"),
    [
        (["03/04/2024"], "%d/%m/%Y", True),
        (["13/04/2024"], "%d/%m/%Y", False),
        (["04/13/2024"], "%m/%d/%Y", False),
        (["03.04.2024"], "%d.%m.%Y", False),
        (["04/12/2024", "05/12/2024"], "%d/%m/%Y", False),
    ],
)
def test_day_and_month(tmp_path: Path, days: list[str], pattern: str, opened: bool) -> None:
    run = drive()
    half = len(run) // len(days)
    stamps = pd.Timestamp("2024-01-01T23:55:00") + pd.to_timedelta(run.t, unit="s")
    day = [days[min(row // half, len(days) - 1)] for row in range(len(run))]
    if len(days) > 1:
        day = [days[int(stamp.day > 1)] for stamp in stamps]
    else:
        stamps = stamps - pd.Timedelta(hours=5)
    path = written(
        tmp_path,
        {"Date": day, "Time": stamps.dt.strftime("%H:%M:%S"), "Speed [km/h]": run.v * 3.6},
    )
    proposal = propose_profile(path)
    assert proposal.profile.time is not None
    assert proposal.profile.time.format == f"{pattern} %H:%M:%S"
    assert any(question.startswith("date") for question in proposal.open) == opened


@pytest.mark.parametrize("pattern", ["%Y%m%dT%H%M%SZ", "%Y%m%d%H%M%S", "%d-%b-%Y %H:%M:%S"])
def test_times_whose_parts_are_known_by_their_order(tmp_path: Path, pattern: str) -> None:
    truth = pd.date_range("2024-05-01T06:00:00Z", periods=300, freq="s")
    speed = 60.0 + 20.0 * np.sin(np.arange(300) / 30.0)
    rows = [f"{at},{v:.1f}" for at, v in zip(truth.strftime(pattern), speed, strict=True)]
    path = tmp_path / "run.csv"
    path.write_text("Time,Speed [km/h]\n" + "\n".join(rows) + "\n")
    trip = ingest(path, profile=propose_profile(path).profile)
    assert (trip["/train/state"].index == truth).all()


@pytest.mark.parametrize(("zone", "hours"), [("Z", 0), ("z", 0), ("+02", 2), (" -0330", -3.5)])
def test_a_zone_is_known_alike_in_tables_and_tracks(
    tmp_path: Path, zone: str, hours: float
) -> None:
    run = drive(120)
    times = pd.Timestamp("2024-05-01T06:00:00") + pd.to_timedelta(run.t, "s")
    stated = [f"{time:%Y-%m-%dT%H:%M:%S}{zone}" for time in times]
    path = written(tmp_path, {"Zeit": stated, "Speed [m/s]": run.v})
    proposal = propose_profile(path)
    assert not any("zone" in question for question in proposal.open)
    points = "".join(
        f'<trkpt lat="{47.0 + 1e-5 * way}" lon="9.0"><time>{time}</time></trkpt>'
        for time, way in zip(stated, run.s, strict=True)
    )
    track = tmp_path / "run.gpx"
    track.write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>", "utf-8")
    trips = ingest(path, proposal.profile), ingest(track)
    assert {trip.start for trip in trips} == {
        pd.Timestamp("2024-05-01T06:00:00Z") - pd.Timedelta(hours=hours)
    }
    assert trips[1].metadata["clock"] == "GNSS, UTC"


@pytest.mark.parametrize("name", ["ENGINE_RUN_TINE ()", "Run time since engine start [s]"])
@pytest.mark.parametrize("rows", [1, 3])
def test_the_run_time_of_an_engine_is_a_time(tmp_path: Path, name: str, rows: int) -> None:
    """OBD loggers count whole seconds since the start, with one or several rows each."""
    run = drive(300 * rows, 1.0 / rows)
    engine = 50.0 + np.random.default_rng(1).uniform(0.0, 1.0, 300 * rows)
    columns = {name: np.repeat(np.arange(137, 437), rows), "VEHICLE_SPEED ()": 3.6 * run.v}
    path = written(tmp_path, columns | {"Abgastemperatur [°C]": engine})
    state = ingest(path, propose_profile(path).profile)["/train/state"]
    assert len(state) == 300 * rows
    apart = (state.index - state.index[0]).total_seconds().to_numpy()
    assert np.abs(apart - np.arange(300 * rows) / rows).max() < 0.01


def test_parquet_with_typed_times(tmp_path: Path) -> None:
    run = drive()
    path = tmp_path / "run.parquet"
    stamps = pd.Timestamp("2024-05-01T06:00:00Z") + pd.to_timedelta(run.t, unit="s")
    pd.DataFrame({"stamp": stamps, "vitesse": run.v * 3.6, "distance": run.s}).to_parquet(path)
    proposal = propose_profile(path)
    assert field(proposal, "/train/state.speed")["unit"] == "km/h"
    trip = ingest(path, proposal.profile)
    np.testing.assert_allclose(trip["/train/state"]["speed"], run.v, atol=1e-9)


def test_a_timetable_is_no_trip(tmp_path: Path) -> None:
    rows = 40
    path = written(
        tmp_path,
        {
            "Station": [f"S{number}" for number in range(rows)],
            "Arrival": [
                f"{6 + number // 12:02d}:{5 * (number % 12):02d}" for number in range(rows)
            ],
            "km": np.arange(rows) * 4.2,
        },
    )
    with pytest.raises(InputError, match="lie 300 s apart, as in a timetable"):
        propose_profile(path)


@pytest.mark.parametrize("beside", ["fixes", "distance"])
@pytest.mark.parametrize(("unit", "size"), [("km/h", 3.6), ("rpm", 60.0 / (2.0 * np.pi * 0.43))])
def test_wheel_speeds_are_kept_where_no_speed_is_recorded(
    tmp_path: Path, beside: str, unit: str, size: float
) -> None:
    run = drive()
    where = {"lat": 47.0 + run.s / 111_195.0, "lon": 9.0}
    where = where if beside == "fixes" else {"distance [m]": run.s}
    wheels = {f"wheel speed {axle} [{unit}]": run.v * size for axle in (1, 2)}
    path = written(tmp_path, {"t [s]": run.t, **where, **wheels})
    trip = ingest(path, propose_profile(path).profile)
    found = trip["/train/axles"][["wheel_speed_1", "wheel_speed_2"]].to_numpy()
    assert np.abs(found - run.v.to_numpy()[:, None]).max() < 0.02 * run.v.max()


@pytest.mark.parametrize(
    ("delimiter", "thousands", "decimal", "digits"),
    [(",", ",", ".", 1), (";", ".", ",", 1), (";", "'", ".", 0), ("\t", ".", ",", 0)],
)
def test_marks_between_thousands_are_read(
    tmp_path: Path, delimiter: str, thousands: str, decimal: str, digits: int
) -> None:
    run = drive()
    marks = str.maketrans({",": thousands, ".": decimal})
    lines = [delimiter.join(["t [s]", "Speed [km/h]", "Distance [m]"])]
    for second, speed, way in zip(run.t, 3.6 * run.v, run.s, strict=True):
        cells = f"{speed:.1f}".translate(marks), f"{way:,.{digits}f}".translate(marks)
        lines.append(delimiter.join([f"{second:.0f}", cells[0], f'"{cells[1]}"']))
    path = tmp_path / "run.csv"
    path.write_text("\n".join(lines) + "\n", "utf-8")
    profile = propose_profile(path).profile
    position = ingest(path, profile)["/train/state"]["position"]
    assert run.s.max() > 1_000.0
    assert np.abs(position.to_numpy() - run.s.to_numpy()).max() < 0.51
    wrong = profile.model_copy(update={"file": profile.file.model_copy(update={"thousands": ""})})
    if (thousands, digits) != (".", 0):  # else they are read as decimals
        with pytest.raises(InputError, match=f"thousands = .{re.escape(thousands)}. under"):
            ingest(path, wrong)


def test_a_unit_that_no_other_column_shows_is_unproven(tmp_path: Path) -> None:
    run = drive()
    alone = {"t [s]": run.t, "Speed [mph]": 2.23694 * run.v}
    for columns, unproven in ((alone, "/train/state.speed [mph]"), (alone | {"s [m]": run.s}, "")):
        path = written(tmp_path, columns)
        trip = ingest(path, propose_profile(path).profile)
        assert trip.metadata.get("unproven_units", "") == unproven


def test_text_and_tables_without_motion_are_refused(tmp_path: Path) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "Temperature [°C]": 20.0 + run.v})
    with pytest.raises(InputError, match="no column is a speed, a distance or a satellite"):
        propose_profile(path)
    words = tmp_path / "words.txt"
    words.write_text("Dear all,\nthe train was late again.\nRegards\n")
    with pytest.raises(InputError, match="is not a table"):
        propose_profile(words)


def test_a_receiver_under_other_names_is_read_as_the_known_one(tmp_path: Path) -> None:
    lines = Path("sample_logs/gnss.csv").read_text().splitlines()[:4000]
    names = "Jahr,Monat,Tag,Stunde,Minute,Sekunde,Satelliten,Laenge,Breite,Hoehe 1,Hoehe 2,"
    names += "hAcc,vAcc,v,sAcc,PDOP,"
    path = tmp_path / "receiver.csv"
    path.write_text("\n".join([names, *lines[1:]]) + "\n")
    known = tmp_path / "known.csv"
    known.write_text("\n".join(lines) + "\n")
    proposal = propose_profile(path)
    # The receiver has two altitudes; which of them is meant is open.
    assert field(proposal, "/gnss/fix.altitude")["alternative"] == "'Hoehe 2'"
    proposed, true = ingest(path, proposal.profile), ingest(known)
    for topic in ("/gnss/fix", "/gnss/motion"):
        for column in set(true[topic]) & set(proposed[topic]) - {"altitude"}:
            pd.testing.assert_series_equal(proposed[topic][column], true[topic][column])
    assert {"latitude", "longitude", "altitude"} <= set(proposed["/gnss/fix"])


def test_a_user_at_a_terminal_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "s [m]": run.s})
    monkeypatch.setattr("trainlog.cli.ingest._at_terminal", lambda: True)
    refused = CliRunner().invoke(app, ["ingest", str(path), "-o", str(tmp_path / "out")], "n\n")
    assert refused.exit_code == 1
    assert "with " + str(tmp_path / "out" / "run.profile.toml") in " ".join(refused.output.split())
    agreed = CliRunner().invoke(app, ["ingest", str(path), "-o", str(tmp_path / "out")], "y\n")
    assert agreed.exit_code == 0, agreed.output
    assert (tmp_path / "out" / "run.mcap").is_file()


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the public data")
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("creep/eurosprinter_creep_curves.csv", "no column is a time that goes forward"),
        ("aalto/device_data.csv", "does it hold several devices"),
        ("aalto/device_models.csv", "no column is a time that goes forward"),
    ],
)
def test_public_tables_that_are_no_trip(name: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        propose_profile(SHARED / name)


def test_the_command_proposes_and_then_ingests(tmp_path: Path) -> None:
    run = drive()
    (tmp_path / "in").mkdir()
    stamps = pd.Timestamp("2024-05-01T06:00:00") + pd.to_timedelta(run.t, unit="s")
    for number in (1, 2):
        day = stamps + pd.Timedelta(days=number)
        columns = {"Zeit (UTC)": day, "v [km/h]": run.v * 3.6, "Weg [m]": run.s + number}
        path = written(tmp_path / "in", columns, f"run-{number}.csv")
    output = tmp_path / "out"
    command = CliRunner()
    given = ["ingest", str(path), "-o", str(output)]
    options = ["--train", str(sample("CH_Stadler_FLIRT_TPF.train.json")), "--set", "load=12 t"]
    options.append("--reverse")
    stated = command.invoke(app, [*given, *options])
    assert f"-o {output} {shlex.join(options)}" in " ".join(stated.output.split())
    first = command.invoke(app, given)
    assert first.exit_code == 1, first.output
    proposed = output / "run-2.profile.toml"
    assert f"--profile {proposed} -o {output}" in " ".join(first.output.split())
    assert not list(output.glob("*.mcap"))
    again = command.invoke(app, [*given, "--profile", str(proposed)])
    assert again.exit_code == 0, again.output
    # Of a folder, one proposal for all files of a layout.
    whole = command.invoke(
        app, ["ingest", str(tmp_path / "in"), "-o", str(tmp_path / "all"), "--accept", "--json"]
    )
    assert whole.exit_code == 0, whole.output
    assert json.loads(whole.stdout)["counts"]["refused"] == 0
    assert sorted(each.name for each in (tmp_path / "all").iterdir()) == [
        "run-1.mcap",
        "run-1.profile.toml",
        "run-2.mcap",
    ]


@pytest.mark.parametrize("hours", [-4.0, 0.0, 3.0, 5.75])
def test_a_unix_time_beside_a_local_one_decides_its_zone(tmp_path: Path, hours: float) -> None:
    """The column of local time comes first, has tenths of a second, and names no zone."""
    truth = pd.date_range("2024-05-01T20:00:00Z", periods=900, freq="500ms")
    local = (truth + pd.Timedelta(hours=hours)).strftime("%Y-%m-%d %H:%M:%S.%f")
    speed = 60.0 + 20.0 * np.sin(np.arange(900) / 60.0)
    way = np.cumsum(speed / 3.6) * 0.5
    rows = [
        f"{at[:-5]},{unix + 1},{v:.1f},{s:.0f}"
        for at, unix, v, s in zip(local, truth.as_unit("ns").asi8 // 10**9, speed, way, strict=True)
    ]
    path = tmp_path / "run.csv"
    path.write_text("local_datetime,unix,speed [km/h],distance [m]\n" + "\n".join(rows) + "\n")
    proposal = propose_profile(path)
    trip = ingest(path, profile=proposal.profile)
    assert trip.start == truth[0]
    assert not any("time zone" in question for question in proposal.open)
