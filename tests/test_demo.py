"""The demo, from end to end: every command runs, and the results keep their promises."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from contextlib import nullcontext
from pathlib import Path

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Chunk
from mcap.stream_reader import StreamReader, get_chunk_data_stream
from painting import without_painting
from rich.console import Console

import trainlog
from analysis.comparison.groups import compare_groups, punctuality
from analysis.truth import curve_error, map_error, truth_of
from trainlog.cli import demo, main as cli
from trainlog.display import at_most
from trainlog.errors import InputError
from trainlog.formats.mapfile import read_map
from trainlog.formats.railway import line_of, read_parameters, read_trajectory
from trainlog.mcap import describe

pytestmark = pytest.mark.usefixtures("remembered")

NONSTOP = "trip-01"
"""Configuration of a trip without a stop, to which the driven one is compared."""

DRIVEN = {NONSTOP: 1, "all": 12}
"""Trips along the trajectory, by the configurations that drive it."""


@pytest.fixture(scope="module", params=[NONSTOP, pytest.param("all", marks=pytest.mark.long)])
def results(request: pytest.FixtureRequest, made_once: Callable[..., Path]) -> Path:
    """Results of the demo's commands; of "all" configurations one drives it, unless long.

    Unless long, its pictures are not painted, as they are in the tests of pictures.
    """

    def run(step: list[str]) -> int:
        return cli.run([request.param if word == "all" else word for word in step])

    def make(folder: Path) -> None:
        with (
            (folder / "reported.txt").open("w", encoding="utf-8") as reported,
            nullcontext() if request.param == "all" else without_painting(),
        ):
            demo.run_demo(folder / "results", Console(file=reported, width=110), run)

    return made_once(f"demo-{request.param}", make) / "results"


def logs(results: Path) -> list[Path]:
    return sorted(results.glob("*/*.mcap"))


def test_twelve_trips_two_recordings_and_the_driven_ones_are_logged(
    results: Path, request: pytest.FixtureRequest
) -> None:
    assert len(list((results / "trips").glob("*.mcap"))) == 12
    assert {p.stem for p in (results / "recorded").glob("*.mcap")} == {"recorder", "gnss"}
    driven = DRIVEN[request.node.callspec.params["results"]]
    assert len(list((results / "driven").glob("*.mcap"))) == driven


def test_every_log_opens_in_the_official_reader(results: Path) -> None:
    """Of one in each folder every chunk passes its checksum; of the smallest all are read."""
    smallest, *_ = every = sorted(logs(results), key=lambda log: log.stat().st_size)
    of_folders = {log.parent: log for log in every}.values()
    for log in every:
        with log.open("rb") as stream:
            summary = make_reader(stream, validate_crcs=True).get_summary()
            assert summary is not None
            assert summary.statistics.message_count == sum(t.count for t in describe(log).topics)
            if log not in of_folders:
                continue
            stream.seek(0)
            records = StreamReader(stream, emit_chunks=True, validate_crcs=True).records
            chunks = [record for record in records if isinstance(record, Chunk)]
            assert len(chunks) == len(summary.chunk_indexes)
            assert all(each.uncompressed_crc != 0 for each in chunks)
            for chunk in chunks:
                get_chunk_data_stream(chunk, validate_crc=True)
    with smallest.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        read = sum(1 for _ in reader.iter_messages())
        assert read == sum(topic.count for topic in describe(smallest).topics)


def test_the_observed_set_holds_the_truth(results: Path) -> None:
    found = read_parameters(results / "parameters.json")
    truths = {log.stem: truth_of(trainlog.read(log)) for log in (results / "trips").glob("*.mcap")}
    known = [truth for truth in truths.values() if truth is not None]
    assert len(found.configurations) >= 11
    for configuration in found.configurations:
        truth = truths[configuration.name]
        assert truth is not None
        assert curve_error(configuration.resistance, [truth]) <= 0.08
        # The load is not recorded: the mass is known as well as the gain of the efforts is.
        assert configuration.mass == pytest.approx(truth.mass, rel=0.02)
    assert found.common is not None
    assert curve_error(found.common, known) <= 0.02


def test_the_map_is_right_where_wheels_slipped_and_silent_elsewhere(results: Path) -> None:
    track = read_map(results / "wil.map")
    truths = [truth_of(trainlog.read(log)) for log in (results / "trips").glob("*.mcap")]
    error, bins = map_error(track, [truth for truth in truths if truth is not None])
    assert bins >= 30
    assert error <= 0.03
    assert set(track.layers) == {"dry", "wet"}
    for layer in track.layers.values():
        assert layer.observed[layer.events > 0].all()
        assert np.isnan(layer.maximum_adhesion[~layer.observed]).all()
        assert (~layer.observed).any()


def test_the_trajectory_keeps_its_certificate(results: Path) -> None:
    trajectory = read_trajectory(results / "trajectory.json")
    observed = read_parameters(results / "parameters.json")
    assert len(trajectory.configurations) == len(observed.configurations)
    certificate = trajectory.certificate
    assert 0.0 <= certificate["gap"] <= 0.002
    audit = certificate["audit"]
    assert audit["lateness"] <= 0.01
    assert audit["overspeed"] <= 1e-3
    assert audit["power"] <= 1.0 + 1e-4
    assert audit["adhesion"] <= 1.0 + 1e-4


def test_driving_it_saves_energy_against_the_drivers(
    results: Path, request: pytest.FixtureRequest
) -> None:
    trips, driven = (
        [trainlog.read(log) for log in sorted((results / folder).glob("*.mcap"))]
        for folder in ("trips", "driven")
    )
    pairs = compare_groups(trips, driven).pairs
    assert len(pairs) >= min(2, DRIVEN[request.node.callspec.params["results"]])
    saved = sum(pair.traction for pair in pairs) / sum(pair.driver.traction for pair in pairs)
    assert 0.05 < saved < 0.4
    for trip in driven:
        limit = trip["/environment"].speed_limit.max()
        assert trip["/truth"].speed.max() <= limit + 0.3
        assert trip["/reference"].speed.notna().any()


def test_readme_states_what_the_demo_shows(results: Path, request: pytest.FixtureRequest) -> None:
    """Its gap, and, where all configurations drove, its savings and how often wheels slipped."""
    certificate = read_trajectory(results / "trajectory.json").certificate
    gap = f"{at_most(certificate['gap'])} above the theoretical minimum"
    root = Path(demo.__file__).parents[2]
    readme = " ".join((root / "README.md").read_text("utf-8").split())
    validation = " ".join((root / "docs" / "validation.md").read_text("utf-8").split())
    assert gap in readme
    assert gap in validation
    if request.node.callspec.params["results"] != "all":
        return
    saved = compare_groups(results / "trips", results / "driven").saved_words
    shares = re.findall(r"[\d.]+% (?:at the wheel rims|from the line)", saved)
    assert len(shares) == 2
    blind = punctuality(sorted((results / "driven-blind").glob("*.mcap"))).slips
    for share in shares:
        assert share in readme
        assert share in validation
    assert f"acts {blind} times" in readme


def test_with_the_map_trips_are_on_time_and_hardly_slip(
    results: Path, request: pytest.FixtureRequest
) -> None:
    known, blind = (
        punctuality(sorted((results / folder).glob("*.mcap")))
        for folder in ("driven", "driven-blind")
    )
    assert known.trips == blind.trips == DRIVEN[request.node.callspec.params["results"]]
    # The one that is off most; a train that stops two metres short creeps for a second or two.
    assert abs(known.late) <= 2.5
    assert known.slips <= 0.1 * blind.slips
    for log in (results / "driven").glob("*.mcap"):
        trip = trainlog.read(log)
        truth, line = trip["/truth"], line_of(trip)
        assert np.max(truth.speed - line.speed_limit(np.minimum(truth.position, line.length))) <= 0
        # By its own odometry and balises, which are good to half a metre.
        assert abs(truth.position.iloc[-1] - line.length) <= 1.0


def test_every_result_says_what_it_was_made_from(results: Path) -> None:
    for name in ("parameters.json", "trajectory.json"):
        provenance = json.loads((results / name).read_text("utf-8"))["provenance"]
        assert provenance
    assert len(read_map(results / "wil.map").trips) == 12
    for log in logs(results):
        assert describe(log).provenance


def test_a_folder_of_other_files_is_left_alone(tmp_path: Path) -> None:
    kept = tmp_path / "trips" / "mine.mcap"
    kept.parent.mkdir()
    kept.write_bytes(b"mine")
    with pytest.raises(InputError, match="not the demo's; name a new folder"):
        demo.run_demo(tmp_path, Console(quiet=True), cli.run)
    assert kept.read_bytes() == b"mine"


def test_the_demo_can_be_repeated(tmp_path: Path) -> None:
    ran: list[list[str]] = []
    for _ in range(2):
        demo.run_demo(tmp_path / "results", Console(quiet=True), ran.append)
        (tmp_path / "results" / "stale.json").write_text("{}")
    assert ran == demo.commands(tmp_path / "results") * 2
    demo.run_demo(tmp_path / "results", Console(quiet=True), ran.append)
    assert not (tmp_path / "results" / "stale.json").exists()


def test_pictures_and_the_replay_are_there(results: Path) -> None:
    for name in ("parameters.png", "wil.png", "trajectory.png"):
        assert (results / name).read_bytes().startswith(b"\x89PNG")
    assert (results / "replay.rrd").read_bytes()[:4] == b"RRF2"
