"""Rolling stock and running paths of railtoolkit, and the running times of TrainRuns.jl."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
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
from trainlog.formats.railway import read_train, read_trajectory
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


def train_of(file: str, loaded: float = 1.0) -> Train:
    """The train of one of the files of TrainRuns, loaded to a share."""
    ((_, train, _),) = read_any(DATA / "trainruns" / "trains" / f"{file}.yaml", loaded)
    assert isinstance(train, Train)
    return train


def published(train: str, path: str) -> float:
    text = (DATA / "trainruns" / "snapshots" / f"{train}_{path}.csv").read_text()
    return float(text.split()[1])


def shortest_time(line: Line, train: Train, step: float) -> float:
    """Running time [s] at full effort, in steps of about so many metres."""
    run = timetable_run(
        line, train, 0.0, line.length, deceleration=train.max_deceleration, lever=1.0, step=step
    )
    return run.running_time


@SHARED
@pytest.mark.parametrize(("train", "path"), CASES)
def test_running_times_of_trainruns(train: str, path: str) -> None:
    line = read_running_paths(DATA / "trainruns" / "paths" / f"{path}.yaml")[path]
    expected, given = published(train, path), train_of(train)
    # With the step of 20 m that TrainRuns takes.
    assert shortest_time(line, given, 20.0) == pytest.approx(expected, rel=2e-3)
    # Its steps begin with their acceleration and so gain a little: the limit lies higher.
    assert 0.0 < shortest_time(line, given, 0.5) / expected - 1.0 < 6e-3


@SHARED
@pytest.mark.parametrize(("train", "path"), [each for each in CASES if each[1] != "speed"])
def test_what_a_step_gains_is_in_proportion_to_it(train: str, path: str) -> None:
    """Why converged times differ from the published ones: those have the error of a 20 m step."""
    line = read_running_paths(DATA / "trainruns" / "paths" / f"{path}.yaml")[path]
    given = train_of(train)
    whole, half, quarter = (shortest_time(line, given, step) for step in (20.0, 10.0, 5.0))
    converged = 2.0 * quarter - half
    # Half of the step leaves half of the error, where limits do not change inside a step.
    assert (converged - half) / (converged - whole) == pytest.approx(0.5, abs=0.1)
    # What the published times lack to the converged ones is that error.
    assert published(train, path) + converged - whole == pytest.approx(converged, rel=2e-3)


@SHARED
def test_a_share_of_the_load_beyond_all_of_it_is_refused() -> None:
    with pytest.raises(InputError, match=r"a share of 1\.5 of the load is not between 0 and 1"):
        train_of("local", 1.5)


@SHARED
@pytest.mark.parametrize(
    "file", sorted((DATA / "railtoolkit_schema" / "test").glob("*/invalid/*.yaml")), ids=str
)
def test_every_invalid_case_is_refused_with_what_is_wrong(file: Path) -> None:
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
def test_every_valid_case_is_read() -> None:
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


@SHARED
def test_all_vehicles_of_the_rolling_stock_are_read() -> None:
    files = sorted((DATA / "rolling_stock").glob("*/*.yaml"))
    vehicles = [next(iter(read_rolling_stock(file)[0].values())) for file in files]
    assert len(vehicles) == 8
    assert sum(vehicle.powered for vehicle in vehicles) == 3
    for vehicle in vehicles:
        assert 1.0 < vehicle.inertia_factor < 1.2
        specific = vehicle.resistance(0.0)(100.0 / 3.6) / (GRAVITY * vehicle.mass)
        assert 1e-3 < specific < 20e-3


def test_strahl_and_sauthoff_say_what_wende_prints() -> None:
    speed = np.linspace(0.0, 50.0, 11)
    wagon = RollingVehicle(
        name="wagon",
        vehicle_type="freight",
        length=19.0,
        mass=25e3,
        load_limit=59e3,
        base_resistance=0.0014,
        air_resistance=0.0039,
    )
    strahl = GRAVITY * 84e3 * (1.4 + 3.9 * (3.6 * speed / 100.0) ** 2) / 1e3
    assert wagon.resistance(59e3)(speed) == pytest.approx(strahl)
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


def test_a_formation_adds_its_vehicles_up() -> None:
    wagon = RollingVehicle(
        name="wagon",
        vehicle_type="freight",
        length=19.0,
        mass=25e3,
        load_limit=59e3,
        speed_limit=27.0,
    )
    empty, half = (coupled("train", (UNIT, wagon, wagon), share) for share in (0.0, 0.5))
    assert empty.length == 78.0
    assert empty.mass == 110e3
    assert half.mass == 169e3
    assert empty.max_speed == 27.0
    assert empty.mass + empty.rotating_mass == pytest.approx(60e3 * 1.1 + 50e3 * 1.06)
    assert empty.tractive_effort_limit(20.0) == pytest.approx(50e3)
    assert empty.max_deceleration == 0.375
    refused(InputError, "no vehicle has tractive effort", coupled, "wagons", (wagon,))


def path_file(folder: Path, sections: str) -> Path:
    file = folder / "path.yaml"
    file.write_text(
        "schema: https://railtoolkit.org/schema/running-path.json\nschema_version: '2024.07'\n"
        f"paths:\n  - id: here\n    characteristic_sections:\n{sections}"
    )
    return file


def test_a_section_keeps_what_it_does_not_say(tmp_path: Path) -> None:
    file = path_file(
        tmp_path,
        "      - {position: 100, speed: 90, resistance: 5}\n"
        "      - {position: 600, speed: 60}\n"
        "      - {position: 900, resistance: -3}\n"
        "      - {position: 1100, speed: 90}\n",
    )
    line = read_running_paths(file)["here"]
    assert line.length == 1_000.0
    assert line.speed_limits.values == pytest.approx(np.array([25.0, 60 / 3.6, 60 / 3.6]))
    assert line.gradients.values == pytest.approx(np.array([0.005, 0.005, -0.003]))


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
def test_other_files_are_refused(tmp_path: Path, text: str, words: str) -> None:
    file = tmp_path / "odd.yaml"
    file.write_text(text)
    refused(InputError, words, read_running_paths, file)


@pytest.mark.parametrize(
    ("speeds", "efforts", "words"),
    [
        ([], [], "needs pairs"),
        ([1.0, 2.0], [1.0, 1.0], "do not grow from 0"),
        ([0.0, 2.0, 2.0], [1.0, 1.0, 1.0], "do not grow from 0"),
        ([0.0, 2.0], [1.0, -1.0], "negative"),
    ],
)
def test_effort_curves_that_cannot_be_are_refused(
    speeds: list[float], efforts: list[float], words: str
) -> None:
    refused(InputError, words, EffortCurve, np.array(speeds), np.array(efforts))


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
WAGON = (
    STOCK + "  - {id: Facs, name: Facs, vehicle_type: freight, length: 19, mass: 25,"
    " load_limit: 59, speed_limit: 100, rotation_mass: 1.03, base_resistance: 1.4,"
    " air_resistance: 3.9}\n"
)


@pytest.mark.usefixtures("unpainted")
def test_a_formation_of_several_files_is_planned_for_from_the_keyboard(tmp_path: Path) -> None:
    (tmp_path / "v90.yaml").write_text(LOCOMOTIVE)
    (tmp_path / "facs.yaml").write_text(WAGON)
    path_file(
        tmp_path,
        "      - {position: 0, speed: 80, resistance: 0}\n"
        "      - {position: 3000, speed: 60, resistance: 4}\n"
        "      - {position: 6000, speed: 60}\n",
    )
    files = [str(tmp_path / name) for name in ("v90.yaml", "facs.yaml", "path.yaml")]
    out = ["-o", str(tmp_path)]
    made = ["--formation", "ore: V90, 10 Facs", "--loaded", "50"]
    strip = ["--set", "mass-model=homogeneous_strip"]
    assert cli.run(["import", *files[:2], *made, *strip, *out]) == 0
    assert cli.run(["import", files[2], "--set", "curve-resistance=roeckl", *out]) == 0
    train = read_train(tmp_path / "ore.train.json")
    assert (train.length, train.mass, train.max_load) == (204.0, 625e3, 295e3)
    assert train.strip_length == 204.0
    # Half of the load: 545 t of wagons at 1.4 per mille, the locomotive at 2.2.
    wind = 10e-3 * 80e3 * GRAVITY * 0.15**2
    assert train.resistance(0.0) == pytest.approx(GRAVITY * (545 * 1.4 + 80 * 2.2) + wind)
    assert train.tractive_effort_limit([0.0, 20 / 3.6]) == pytest.approx([180e3, 100e3])
    line = tmp_path / "path.line.json"
    plan = ["--train", str(tmp_path / "ore.train.json"), "--line", str(line), "--set", "cells=60"]
    assert cli.run(["plan", *plan, "-o", str(tmp_path / "plan.json")]) == 0
    found = read_trajectory(tmp_path / "plan.json")
    assert found.certificate["certified"]
    assert found.model == ("curve resistance roeckl, homogeneous strip, gross acceleration limits")


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
def test_what_an_import_cannot_use_is_refused(
    words: tuple[str, ...], message: str, tmp_path: Path
) -> None:
    (tmp_path / "v90.yaml").write_text(LOCOMOTIVE)
    (tmp_path / "train.yaml").write_text(
        STOCK.replace("vehicles:", "trains: [{id: ore, name: ore, formation: [V90, F]}]")
    )
    rows = (f"      - {{position: {at}, speed: 80}}\n" for at in (0, 900))
    path_file(tmp_path, "".join(rows))
    with pytest.raises(InputError, match=message):
        cli.run(["import", str(tmp_path / words[0]), *words[1:], "-o", str(tmp_path / "out")])
    assert not list(tmp_path.glob("out/*"))
