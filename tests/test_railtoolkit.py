"""Rolling stock and running paths of railtoolkit, and the running times of TrainRuns.jl."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from contents import put
from refusals import refused

from trainlog.cli import main as cli
from trainlog.errors import InputError
from trainlog.formats.railtoolkit import (
    RollingVehicle,
    coupled,
    read_any,
    read_rolling_stock,
    read_running_paths,
)
from trainlog.railway import EffortCurve, Line, Train
from trainlog.railway.motion import timetable_run
from trainlog.units import GRAVITY

DATA = Path(__file__).parents[2] / "shared" / "data"
SHARED = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")

CASES = [
    (train, path)
    for train in ("local", "freight", "longdistance")
    for path in ("const", "slope", "speed")
]

EFFORT = EffortCurve(np.array([0.0, 10.0, 30.0]), np.array([100e3, 80e3, 20e3]))
UNIT = RollingVehicle(
    name="unit",
    vehicle_type="multiple unit",
    length=40.0,
    mass=60e3,
    mass_traction=40e3,
    rotation_mass=1.1,
    base_resistance=0.003,
    rolling_resistance=0.0015,
    air_resistance=0.004,
    effort=EFFORT,
)

WAGON = RollingVehicle(
    name="wagon", vehicle_type="freight", length=19.0, mass=25e3, load_limit=59e3,
    base_resistance=0.0014, air_resistance=0.0039,
)  # fmt: skip


def train_of(file: str, loaded: float = 1.0) -> Train:
    """The train of one of the files of TrainRuns, loaded to a share."""
    ((_, train, _),) = read_any(DATA / "trainruns" / "trains" / f"{file}.yaml", loaded)
    assert isinstance(train, Train)
    return train


def shortest_time(line: Line, train: Train, step: float) -> float:
    """Running time [s] at full effort, in steps of about so many metres."""
    run = timetable_run(
        line, train, 0.0, line.length, deceleration=train.max_deceleration, lever=1.0, step=step
    )
    return run.running_time


@SHARED
@pytest.mark.parametrize(("train", "path"), CASES)
def test_running_times_of_trainruns(train, path):
    line = read_running_paths(DATA / "trainruns" / "paths" / f"{path}.yaml")[path]
    snapshot = (DATA / "trainruns" / "snapshots" / f"{train}_{path}.csv").read_text()
    expected, given = float(snapshot.split()[1]), train_of(train)
    # With the step of 20 m that TrainRuns takes.
    assert shortest_time(line, given, 20.0) == pytest.approx(expected, rel=2e-3)
    # Its steps begin with their acceleration and so gain a little: the limit lies higher.
    assert 0.0 < shortest_time(line, given, 0.5) / expected - 1.0 < 6e-3


@SHARED
def test_a_share_of_the_load_beyond_all_of_it_is_refused():
    with pytest.raises(InputError, match=r"a share of 1\.5 of the load is not between 0 and 1"):
        train_of("local", 1.5)


@SHARED
@pytest.mark.parametrize(
    "file", sorted((DATA / "railtoolkit_schema" / "test").glob("*/invalid/*.yaml")), ids=str
)
def test_every_invalid_case_is_refused_with_what_is_wrong(file):
    read = read_rolling_stock if "rolling-stock" in file.parts else read_running_paths
    expected = {
        "length": "'length' is missing",
        "mass": "'mass' is missing",
        "formation_empty": "trains[0].formation",
        "formation_missing": "'formation' is missing",
        "train_id": "'id' is missing",
        "train_name": "'name' is missing",
        "vehicle_id": "'id' is missing",
        "vehicle_name": "'name' is missing",
        "vehicle_type": "vehicles[0].vehicle_type",
        "minimal": "neither trains nor vehicles",
        "not_unique_CS": "two sections begin at 0 m",
        "missing_sections": "'characteristic_sections' is missing",
        "not_null_speed": "is not positive",
        "missing_id": "'id' is missing",
        "not_unique_path": "path '1' comes twice",
        "no_two_items_section": "at least 2 items",
        "incomplete_section": "neither speed nor resistance",
    }[file.stem]
    refusal = refused(InputError, "", read, file)
    assert expected in str(refusal)
    assert file.name in str(refusal)


@SHARED
def test_every_valid_case_is_read():
    folder = DATA / "railtoolkit_schema"
    for file in sorted((folder / "test" / "rolling-stock" / "valid").glob("*.yaml")):
        read_rolling_stock(file)
    for file in sorted((folder / "test" / "running-path" / "valid").glob("*.yaml")):
        assert read_running_paths(file)
    vehicles, formations = read_rolling_stock(folder / "rolling-stock.example.yaml")
    assert coupled(*formations["RB50-1"], 0.0).mass == 2 * 68e3
    assert vehicles["BR642"].a_braking == -0.4253
    line = read_running_paths(folder / "running-path.example.yaml")["example"]
    assert line.speed_limit(0.0) == pytest.approx(160 / 3.6)
    assert line.gradient(2_500.0) == pytest.approx(2e-3)


def test_strahl_and_sauthoff_say_what_wende_prints():
    speed = np.linspace(0.0, 50.0, 11)
    strahl = GRAVITY * 84e3 * (1.4 + 3.9 * (3.6 * speed / 100.0) ** 2) / 1e3
    assert WAGON.resistance(59e3)(speed) == pytest.approx(strahl)
    coach = RollingVehicle(
        name="coach",
        vehicle_type="passenger",
        length=26.8,
        mass=50e3,
        load_limit=20e3,
        base_resistance=0.002,
        rolling_resistance=0.000715,
        air_resistance=0.00364,
    )
    sauthoff = 2.0 + 0.715 * 3.6 * speed / 100.0 + 3.64 * ((3.6 * speed + 15.0) / 100.0) ** 2
    assert coach.resistance(0.0)(speed) == pytest.approx(GRAVITY * 50e3 * sauthoff / 1e3)
    air = 4.0 * ((3.6 * speed + 15.0) / 100.0) ** 2
    expected = GRAVITY * (3.0 * 40e3 + 1.5 * 20e3 + air * 60e3) / 1e3
    assert UNIT.resistance(0.0)(speed) == pytest.approx(expected)


def test_a_formation_adds_its_vehicles_up():
    wagon = replace(WAGON, speed_limit=27.0)
    empty, half = (coupled("train", (UNIT, wagon, wagon), share) for share in (0.0, 0.5))
    assert empty.length == 78.0
    assert empty.mass == 110e3
    assert half.mass == 169e3
    assert empty.max_speed == 27.0
    assert empty.mass + empty.rotating_mass == pytest.approx(60e3 * 1.1 + 50e3 * 1.06)
    assert empty.tractive_effort_limit(20.0) == pytest.approx(50e3)
    assert empty.max_deceleration == 0.375
    refused(InputError, "no vehicle has tractive effort", coupled, "wagons", (wagon,))


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a: [1", "is not YAML.*line 1|is not YAML"),
        ("", "is not a running path of railtoolkit"),
        ("schema: x", "is not a running path"),
        (
            "schema: https://railtoolkit.org/schema/running-path.json\nschema_version: '1999.01'",
            "version '1999.01' is not known",
        ),
        ("\x00\x01", "is not YAML"),
        ("[" * 1_000, "is not YAML"),
    ],
)
def test_other_files_are_refused(tmp_path, text, words):
    refused(InputError, words, read_running_paths, put(tmp_path / "odd.yaml", text))


STOCK = """
schema: https://railtoolkit.org/schema/rolling-stock.json
schema_version: "2022.05"
vehicles:
"""
LOCOMOTIVE = (
    STOCK + "  - {id: V90, name: V90, vehicle_type: traction unit, length: 14, mass: 80,"
    " mass_traction: 80, speed_limit: 80, rotation_mass: 1.09, base_resistance: 2.2,"
    " air_resistance: 10, tractive_effort: [[0, 180000], [20, 100000], [80, 25000]]}\n"
)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("v90.yaml", "--formation", "V90, 3 Fals"), "no vehicle 'Fals' in the files given"),
        (("v90.yaml", "--formation", "V90, 0 V90"), "no vehicle 'V90' in the files"),
        (("v90.yaml", "--set", "curve-resistance=roeckl"), "is not a line: curve resistance"),
        (("path.yaml", "--set", "mass-model=mass_point"), "is not a train: mass model cannot go"),
        (("train.yaml",), "the vehicles of train 'ore' are not in the file.*--formation 'V90, F'"),
    ],
    ids=lambda given: " ".join(given) if isinstance(given, tuple) else "",
)
def test_what_an_import_cannot_use_is_refused(words, message, tmp_path):
    (tmp_path / "v90.yaml").write_text(LOCOMOTIVE)
    (tmp_path / "train.yaml").write_text(
        STOCK.replace("vehicles:", "trains: [{id: ore, name: ore, formation: [V90, F]}]")
    )
    rows = (f"      - {{position: {at}, speed: 80}}\n" for at in (0, 900))
    (tmp_path / "path.yaml").write_text(
        "schema: https://railtoolkit.org/schema/running-path.json\nschema_version: '2024.07'\n"
        f"paths:\n  - id: here\n    characteristic_sections:\n{''.join(rows)}"
    )
    with pytest.raises(InputError, match=message):
        cli.run(["import", str(tmp_path / words[0]), *words[1:], "-o", str(tmp_path / "out")])
    assert not list(tmp_path.glob("out/*"))
