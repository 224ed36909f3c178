"""The demo, from end to end: every command runs, and the results keep their promises."""

import json
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from painting import without_painting
from refusals import refused
from rich.console import Console
from test_cli import commands as every_command, context_of

import trainlog
from analysis.comparison.groups import compare_groups, punctuality
from analysis.truth import curve_error, map_error, truth_of
from trainlog import InputError, describe, read_map, read_parameters, read_trajectory
from trainlog.cli import demo, main as cli
from trainlog.cli.commands import DEFAULT
from trainlog.display import at_most
from trainlog.formats.railway import line_of

pytestmark = pytest.mark.usefixtures("remembered")


@pytest.fixture(scope="module", params=[3, pytest.param(12, marks=pytest.mark.long)])
def results(request: pytest.FixtureRequest, made_once: Callable[..., Path]) -> Path:
    """Results of the demo's commands; of three trips, which one configuration drives, unless long.

    Unless long, its pictures are not painted, as they are in the tests of pictures.
    """
    # The driven one is compared to a trip of its configuration that does not stop: trip-01.
    changed = {} if request.param == 12 else {"12": str(request.param), "all": "trip-01"}
    coarse = {"plan": ["--set", "cells=40"]} if changed else {}

    def make(folder: Path) -> None:
        with (
            (folder / "reported.txt").open("w", encoding="utf-8") as reported,
            without_painting() if changed else nullcontext(),
        ):
            demo.run_demo(
                folder / "results",
                Console(file=reported, width=110),
                lambda step: cli.run([changed.get(w, w) for w in step] + coarse.get(step[0], [])),
            )

    return made_once(f"demo-{request.param}", make) / "results"


def logs(results: Path, folder: str = "trips") -> list[Path]:
    return sorted((results / folder).glob("*.mcap"))


def test_every_result_is_there_and_says_what_it_was_made_from(results):
    assert {p.stem for p in (results / "recorded").glob("*.mcap")} == {"recorder", "gnss"}
    assert len(logs(results, "driven")) == (12 if len(logs(results)) == 12 else 1)
    for name in ("parameters.json", "trajectory.json"):
        assert json.loads((results / name).read_text("utf-8"))["provenance"]
    assert len(read_map(results / "wil.map").trips) == len(logs(results))
    for log in results.glob("*/*.mcap"):
        assert describe(log).provenance
    trajectory = read_trajectory(results / "trajectory.json")
    observed = read_parameters(results / "parameters.json").configurations
    assert len(trajectory.configurations) == len(observed)
    assert 0.0 <= trajectory.certificate["gap"] <= 0.002
    for name in ("parameters.png", "wil.png", "trajectory.png"):
        assert (results / name).read_bytes().startswith(b"\x89PNG")
    assert (results / "replay.rrd").read_bytes()[:4] == b"RRF2"


def test_the_observed_set_holds_the_truth(results):
    found = read_parameters(results / "parameters.json")
    truths = {log.stem: truth_of(trainlog.read(log)) for log in logs(results)}
    known = [truth for truth in truths.values() if truth is not None]
    assert len(found.configurations) >= len(logs(results)) - 1
    for configuration in found.configurations:
        truth = truths[configuration.name]
        assert curve_error(configuration.resistance, [truth]) <= 0.08
        # The load is not recorded: the mass is known as well as the gain of the efforts is.
        assert configuration.mass == pytest.approx(truth.mass, rel=0.02)
    assert curve_error(found.common, known) <= 0.02


def test_the_map_is_right_where_wheels_slipped_and_silent_elsewhere(results):
    track = read_map(results / "wil.map")
    truths = [truth_of(trainlog.read(log)) for log in logs(results)]
    error, bins = map_error(track, [truth for truth in truths if truth is not None])
    assert bins >= 10
    assert error <= 0.03
    assert set(track.layers) == {"dry", "wet"}
    for layer in track.layers.values():
        assert layer.observed[layer.events > 0].all()
        assert np.isnan(layer.maximum_adhesion[~layer.observed]).all()
        assert (~layer.observed).any()


def test_driving_it_saves_energy_against_the_drivers(results):
    trips, driven = ([trainlog.read(x) for x in logs(results, y)] for y in ("trips", "driven"))
    pairs = compare_groups(trips, driven).pairs
    assert len(pairs) >= min(2, len(driven))
    saved = sum(pair.traction for pair in pairs) / sum(pair.driver.traction for pair in pairs)
    assert 0.05 < saved < 0.4
    for trip in driven:
        limit = trip["/environment"].speed_limit.max()
        assert trip["/truth"].speed.max() <= limit + 0.3
        assert trip["/reference"].speed.notna().any()


@pytest.mark.long
@pytest.mark.parametrize("results", [12], indirect=True)
def test_readme_states_what_the_demo_shows(results):
    """Its gap, its savings and how often wheels slipped."""
    certificate = read_trajectory(results / "trajectory.json").certificate
    gap = f"{at_most(certificate['gap'])} above the theoretical minimum"
    root = Path(demo.__file__).parents[2]
    readme = " ".join((root / "README.md").read_text("utf-8").split())
    validation = " ".join((root / "docs" / "validation.md").read_text("utf-8").split())
    assert gap in readme
    assert gap in validation
    saved = compare_groups(results / "trips", results / "driven").saved_words
    shares = re.findall(r"[\d.]+% (?:at the wheel rims|from the line)", saved)
    assert len(shares) == 2
    blind = punctuality(logs(results, "driven-blind")).slips
    for share in shares:
        assert share in readme
        assert share in validation
    assert f"acts {blind} times" in readme


def test_with_the_map_trips_are_on_time_and_hardly_slip(results):
    known, blind = (punctuality(logs(results, each)) for each in ("driven", "driven-blind"))
    assert known.trips == blind.trips == len(logs(results, "driven"))
    # The one that is off most; a train that stops two metres short creeps for a second or two.
    assert abs(known.late) <= 2.5
    # A map of three trips knows less than one of twelve.
    assert known.slips <= (0.1 if len(logs(results)) == 12 else 0.5) * blind.slips
    for log in logs(results, "driven"):
        trip = trainlog.read(log)
        truth, line = trip["/truth"], line_of(trip)
        assert np.max(truth.speed - line.speed_limit(np.minimum(truth.position, line.length))) <= 0
        # By its own odometry and balises, which are good to half a metre.
        assert abs(truth.position.iloc[-1] - line.length) <= 1.0


def test_a_folder_of_other_files_is_left_alone(tmp_path):
    kept = tmp_path / "trips" / "mine.mcap"
    kept.parent.mkdir()
    kept.write_bytes(b"mine")
    said = "not the demo's; name a new folder"
    refused(InputError, said, demo.run_demo, tmp_path, Console(quiet=True), cli.run)
    assert kept.read_bytes() == b"mine"


def test_the_demo_can_be_repeated(tmp_path):
    ran: list[list[str]] = []
    for _ in range(2):
        demo.run_demo(tmp_path / "results", Console(quiet=True), ran.append)
        (tmp_path / "results" / "stale.json").write_text("{}")
    assert ran == demo.commands(tmp_path / "results") * 2
    demo.run_demo(tmp_path / "results", Console(quiet=True), ran.append)
    assert not (tmp_path / "results" / "stale.json").exists()


def test_commands_of_the_fleets_demo_are_public_and_two_trains_have_faults():
    known = dict(every_command())
    for words in demo.fleet_commands(Path("out")):
        two = " ".join(words[:2])
        name = two if two in known else f"{words[0]} {DEFAULT.get(words[0], '')}".strip()
        parameters = known[name].get_params(context_of(name, known[name]))
        options = {option for each in parameters for option in each.opts}
        assert {word for word in words if word.startswith("--")} <= options, words
    words = demo.fleet_commands(Path("out"))[0]
    assert len({word.partition(",")[0] for word in words if word.startswith("train=")}) == 2


@pytest.mark.long
def test_the_demo_of_a_fleet_runs(tmp_path):
    results = tmp_path / "results"
    steps = demo.fleet_commands(results, trips=24)
    demo.run_demo(results, Console(quiet=True), cli.run, steps, demo.FLEET_THEN)
    for name in ("trajectory.json", "fleet.html", "trains/trains.json"):
        assert (results / name).is_file()
