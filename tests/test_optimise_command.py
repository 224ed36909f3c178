"""`trainlog plan`: what can be asked of one run at the keyboard."""

from __future__ import annotations

import json
import shutil
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from analysis.comparison.driven import driven_trip
from analysis.trajectory.problem import TrajectoryProblem, adhesion_demand, adhesion_words
from trainlog import Configuration, Trajectory, read_line, read_map, read_train, read_trajectory
from trainlog.cli import main as cli
from trainlog.cli.options import sections_in
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.mcap import read_log
from trainlog.units import GRAVITY, KMH

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds", "unpainted", "unrenewed")

SAMPLES = ("--line", "sample", "--train", "sample")
MAP = ("--map", sample("CH_StGallen_Wil.map"))
LINE, TRAIN = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))


@pytest.fixture(scope="module")
def observed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The set of one sample trip."""
    path = tmp_path_factory.mktemp("set") / "parameters.json"
    cli.run(["fit", str(sample("nonstop.mcap")), "-o", str(path)])
    return path


def asked(parameters: Path, folder: Path, *words: object) -> Trajectory:
    """The trajectory that the command writes."""
    output = folder / "trajectory.json"
    own = shutil.copy(parameters, folder)
    given = ("plan", own, *SAMPLES, "--set", "cells=40", *words, "-o", output)
    assert cli.run([str(word) for word in given]) == 0
    return read_trajectory(output)


def test_an_open_end_is_the_end_of_the_line_in_the_direction_of_travel(observed, tmp_path):
    found = asked(observed, tmp_path, "--reverse", "--km", "25:")
    assert (found.positions[0], found.positions[-1]) == (25_000.0, LINE.length)
    assert found.direction == "reverse"
    assert found.speeds[:, [0, -1]] == pytest.approx(0.0)


def test_limits_that_protect_the_whole_train_hold_until_its_end_has_passed(observed, tmp_path):
    reserve = ("--km", ":6", "--reserve", 1)
    front = asked(observed, tmp_path, *reserve)
    whole = asked(observed, tmp_path, *reserve, "--set", "protect=train")
    assert whole.provenance["settings"]["protected_length"] == TRAIN.length

    def over(found: Trajectory) -> float:
        """Most speed over what is permitted at the train's end."""
        places = np.arange(TRAIN.length, 6_000.0, 5.0)
        speeds = np.sqrt(np.interp(places, found.positions, found.speeds[0] ** 2))
        return float((speeds - LINE.speed_limit(places - TRAIN.length)).max())

    assert over(whole) <= 1e-3 < 0.1 < over(front)
    assert max(whole.certificate["least_time"]) > max(front.certificate["least_time"])


def test_a_map_read_with_more_caution_or_less_risk_leaves_less_adhesion(observed, tmp_path):
    at = ("--at", "2024-10-08T06:00Z")
    for read in (
        (("--set", "sigmas=0"), (), ("--set", "sigmas=4")),
        ((*at, "--set", "risk=0.2"), (*at, "--set", "risk=0.001")),
    ):
        found = [asked(observed, tmp_path, "--km", ":4", *MAP, *words) for words in read]
        for bold, careful in pairwise(found):
            assert max(bold.certificate["least_time"]) < max(careful.certificate["least_time"])
    stated = found[-1].provenance["settings"]["adhesion"]
    assert stated == {"layer": "wet", "risk": 0.001, "time": "2024-10-08T06:00:00+00:00"}


def test_the_risk_of_a_run_is_that_of_what_it_asks_for():
    track = read_map(sample("CH_StGallen_Wil.map"))
    alone, layer = (Configuration.of(TRAIN),), track.layer("wet")
    seen = int(np.flatnonzero(layer.observed)[0])
    places = np.array([seen, seen + 1, seen + 2]) * track.bin_length
    at_risk = float(layer.expected().quantile(0.05)[seen])
    pull = np.array([at_risk * TRAIN.adhesive_weight(), 0.0])
    for direction, course, own, pulls in (
        ("forward", LINE, places, pull),
        ("reverse", LINE.reversed(), LINE.length - places[::-1], pull[::-1]),
    ):
        drive = Trajectory(
            LINE.name, TRAIN.name, own, alone, np.zeros((1, 3)), np.zeros((1, 3)), pulls,
            np.zeros((1, 2)), 100.0, direction=direction,
        )  # fmt: skip
        run = TrajectoryProblem(
            course, TRAIN, alone, condition_map=track, risk=0.05, direction=direction
        )
        demand = adhesion_demand(run, drive)
        assert demand[seen] == pytest.approx(at_risk)
        said = "somewhere, as expected right after the last evidence: 5 % to"
        assert said in adhesion_words(run, drive)[2]


def test_the_dynamic_brake_asks_its_adhesion_of_the_powered_axles():
    """Up to its effort and to what a map leaves it; friction gives the rest on all axles."""
    track, alone = read_map(sample("CH_StGallen_Wil.map")), (Configuration.of(TRAIN),)
    places = np.array([0.0, 500.0, 1_000.0])
    for brake in (90e3, 300e3):
        run = TrajectoryProblem(LINE, TRAIN, alone, end=1_000.0)
        drive = Trajectory(
            LINE.name, TRAIN.name, places, alone, np.array([[10.0, 10.0, 0.0]]), np.zeros((1, 3)),
            np.zeros(2), np.array([[0.0, brake]]), 100.0,
        )  # fmt: skip
        powered = min(brake, TRAIN.max_dynamic_braking_effort) / TRAIN.adhesive_weight()
        assert f"0.000 in traction, {powered:.3f} in braking" in adhesion_words(run, drive)[0]
        mapped = TrajectoryProblem(
            LINE, TRAIN, alone, end=1_000.0, condition_map=track, assumed_adhesion=0.1
        )
        asked_for = adhesion_demand(mapped, drive)[track.bin_of(np.array([750.0]))[0]]
        left = min(powered, float(mapped.adhesion(places)[1]))
        whole = brake / (GRAVITY * TRAIN.mass)
        assert asked_for == pytest.approx(max(left, whole))


def test_a_train_file_alone_is_planned_for_and_the_result_states_it(tmp_path, works):
    output, trips = tmp_path / "trajectory.json", tmp_path / "trips"
    rail = ("--train", sample(DEFAULT_TRAIN), "--line", sample(DEFAULT_LINE))
    works("plan", *rail, "--set", "load=8t", "--km", ":4", "--set", "cells=40", "-o", output)
    found = read_trajectory(output)
    assert found.configurations == (Configuration.of(TRAIN, 8_000.0),)
    assert found.planned_for in repr(found)
    assert "without a band" in found.planned_for
    # The same in Python, and the trajectory can be followed.
    asked_for = TrajectoryProblem.nominal(LINE, TRAIN, load=8e3, end=4e3)
    assert asked_for.configurations == found.configurations
    works("simulate", "follow", output, *SAMPLES, "-o", trips)
    assert (trips / "driven-nominal.mcap").is_file()


def test_values_are_taken_as_people_write_them(observed, tmp_path):
    words = ("--km", "3.2km:7500m", "--set", "initial-speed=20m/s", "--set", "final-speed=36 km/h")
    written = asked(observed, tmp_path, *words, "--running-time", "4:30")
    plain = ("--km", "3.2:7.5", "--set", "initial-speed=72", "--set", "final-speed=36")
    same = asked(observed, tmp_path, *plain, "--running-time", 270)
    assert written.running_time == same.running_time == 270.0
    assert np.array_equal(written.speeds, same.speeds)
    assert (same.positions[0], same.positions[-1]) == (3200.0, 7500.0)
    assert same.speeds[:, 0] == pytest.approx(72 / KMH, abs=1e-9)
    assert np.all(same.speeds[:, -1] <= 36 / KMH + 1e-5)
    reserve = [asked(observed, tmp_path, "--km", ":4", "--reserve", each) for each in ("7%", "7")]
    assert reserve[0].running_time == reserve[1].running_time


def test_a_run_between_two_stations_is_one_file_and_one_between_three_a_folder(tmp_path, works):
    coarse = (*SAMPLES, "--set", "cells=20", "--set", "load=8t")
    stops = ("--stops", "Gossau SG, Flawil", "--running-time", "4:40")
    works("plan", *coarse, *stops, "-o", tmp_path / "a.json")
    found = read_trajectory(tmp_path / "a.json")
    assert found.running_time == pytest.approx(280.0, abs=1.0)
    three = ("--stops", "Gossau SG,Flawil,Uzwil", "--set", "dwell=30", "--reserve", "7%,3%")
    document = json.loads(works("plan", *coarse, *three, "-o", tmp_path / "b", "--json"))
    assert {each.name for each in (tmp_path / "b").iterdir()} == {
        *("section-1.json", "section-1.png", "section-2.json", "section-2.png"),
        "energy-over-time.png",
    }
    front = document["front"]
    assert [each["reserve"] for each in front] == pytest.approx([0.03, 0.07], abs=1e-4)
    assert front[0]["energy_J"] > front[1]["energy_J"]
    # What a second saves is the slope of the energies, to the bend between them.
    slope = np.diff([each["energy_J"] for each in front])[0]
    slope /= np.diff([each["running_time_s"] for each in front])[0]
    assert front[1]["saved_by_a_second_W"] < -slope < front[0]["saved_by_a_second_W"]
    arrivals = [each["time_s"] for each in document["advice"] if each["event"] == "arrives"]
    assert arrivals[-1] == pytest.approx(front[1]["running_time_s"], abs=0.1)
    # A trip is compared with the whole, which stands in Flawil for half a minute.
    words = ("compare", sample("stopping.mcap"), "--reference", tmp_path / "b", "--json")
    trips = {each["trip"]: each for each in json.loads(works(*words))["trips"]}
    assert trips["trajectory"]["duration_s"] == pytest.approx(arrivals[-1], abs=0.1)
    assert trips["advice obeyed"]["last_m"] == pytest.approx(20_086.0, abs=10.0)
    assert trips["trip-03"]["lost_s"] > 30.0


JOURNEY = ("--stops", "Uzwil,Flawil,Gossau SG", "--reverse", "--set", "dwell=30")


def test_a_table_has_the_whole_run_by_kilometre(tmp_path, works):
    words = (*JOURNEY, "--set", "cells=20")
    works("plan", *SAMPLES, *words, "-o", tmp_path / "run.csv", "-q")
    assert [each.name for each in tmp_path.iterdir()] == ["run.csv"]
    works("plan", *SAMPLES, *words, "-o", tmp_path / "run")
    names = ["Uzwil to Flawil", "Flawil to Gossau SG"]
    table = pd.read_csv(tmp_path / "run.csv")
    assert table.columns.tolist() == [
        *("section", "km", "time [s]", "speed [km/h]", "tractive effort [kN]"),
        *("braking effort [kN]", "energy at the wheels [kWh]", "configuration"),
    ]
    assert table["section"].unique().tolist() == names
    assert not table.duplicated(["section", "km"]).any()
    works("convert", tmp_path / "run", "-o", tmp_path / "again.csv")
    assert (tmp_path / "again.csv").read_bytes() == (tmp_path / "run.csv").read_bytes()
    works("advice", tmp_path / "run", "-o", tmp_path / "advice.html")
    stops = pd.read_csv(tmp_path / "advice.csv").query("event == 'departs'")["station"]
    assert stops.tolist() == ["Uzwil", "Flawil"]
    sections = [read_trajectory(tmp_path / "run" / f"section-{each}.json") for each in (1, 2)]
    energy = sum(each.certificate["wheel_energy"][0] for each in sections) / 3.6e6
    assert table["energy at the wheels [kWh]"].iloc[-1] == pytest.approx(energy, rel=1e-4)
    standing = table[table["speed [km/h]"] == 0.0]
    assert standing["km"].tolist() == pytest.approx([9.470, 15.080, 15.080, 20.270], abs=1e-3)
    assert standing["time [s]"].diff().iloc[2] == pytest.approx(30.0, abs=0.02)


def test_what_ipopt_finds_on_the_same_cells_is_stated(observed, tmp_path):
    """IPOPT knows nothing of the search: it lies above the bound and near the plan."""
    found = asked(observed, tmp_path, "--km", ":4", "--set", "referee=yes").certificate
    stated = found["referee"]
    assert stated["solved"]
    assert abs(stated["excess"]) < 1e-4
    assert stated["energy"] >= found["lower_bound"]
    assert stated["energy"] == pytest.approx(found["energy"], rel=1e-4)
    assert "referee" not in asked(observed, tmp_path, "--km", ":4").certificate


def test_the_plan_of_a_journey_is_followed_section_by_section(tmp_path, works):
    plan = tmp_path / "plan"
    works("plan", *SAMPLES, *JOURNEY, "--set", "cells=20", "-o", plan)
    files = sections_in([plan])
    works("simulate", "follow", plan, "--train", "sample", "-o", tmp_path / "driven")
    trips = sorted((read_log(log) for log in (tmp_path / "driven").glob("*.mcap")),
                   key=lambda trip: trip.start)  # fmt: skip
    assert len(trips) == len(files) == 2
    for trip, file in zip(trips, files, strict=True):
        section = read_trajectory(file)
        position = trip["/train/state"]["position"]
        ends = position.iloc[0], position.iloc[-1]
        assert ends == pytest.approx(section.positions[[0, -1]], abs=15.0)
        # One running time, that of the plan: without what is recorded at both stands.
        took = driven_trip(trip).duration
        assert took == pytest.approx(section.running_time, rel=0.05)
        assert took < trip.duration
    assert all(b.start - a.start > pd.Timedelta("100s") for a, b in pairwise(trips))


@pytest.mark.parametrize("protect", ["front", "train"])
def test_what_of_a_plan_is_less_than_it_seems_is_stated(protect, tmp_path, works):
    """Limits kept at the front alone, and a final speed that is not permitted there."""
    words = ["plan", *SAMPLES, "--km", "20:", "--set", "cells=60", "--set", f"protect={protect}"]
    fast = ["--set", "final-speed=500"] if protect == "front" else []
    shown = works(*words, *fast, "-o", tmp_path / "plan.json", "--json")
    notes = json.loads(shown)["notes"]
    for begins in ("Speed limits apply to the train's front", "The final speed of 500 km/h is"):
        assert any(note.startswith(begins) for note in notes) == (protect == "front")
