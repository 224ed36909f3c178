"""The samples are what their README says, and can be made again, value for value."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from same_values import TOLERANCE, first_difference

import trainlog
from analysis.truth import truth_of
from trainlog.formats.files import sha256_of
from trainlog.formats.samples import copy_samples, folder, names

pytestmark = pytest.mark.usefixtures("remembered")

CHECKOUT = Path(__file__).parents[1]

MADE = (
    "nonstop.mcap",
    "stopping.mcap",
    "recorder.csv",
    "gnss.csv",
    "CH_StGallen_Wil.map",
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("samples")
    runpy.run_path(str(CHECKOUT / "sample_logs" / "make_logs.py"))["make"](output)
    return output


def test_the_consists_are_made_again(tmp_path: Path) -> None:
    runpy.run_path(str(CHECKOUT / "sample_logs" / "make_consists.py"))["make"](tmp_path)
    made = sorted(path.name for path in tmp_path.iterdir())
    assert made == [name for name in names() if name.endswith(".consist.json")]
    assert {name: first_difference(tmp_path / name, folder() / name) for name in made} == (
        dict.fromkeys(made)
    )


def test_the_command_in_the_readme_makes_them_again(made: Path) -> None:
    differences = {name: first_difference(made / name, folder() / name) for name in MADE}
    assert differences == dict.fromkeys(MADE)


@pytest.mark.long
def test_two_runs_on_one_machine_give_the_same_bytes(made: Path, tmp_path: Path) -> None:
    runpy.run_path(str(CHECKOUT / "sample_logs" / "make_logs.py"))["make"](tmp_path)
    same = {name: sha256_of(made / name) == sha256_of(tmp_path / name) for name in MADE}
    assert same == dict.fromkeys(MADE, True)


def test_a_difference_beyond_rounding_is_reported(tmp_path: Path) -> None:
    trip = trainlog.read(folder() / "nonstop.mcap")
    frame = trip["/truth"].copy()
    largest = float(np.abs(frame["speed"]).max())
    column = frame.columns.get_loc("speed")
    for share, expected in ((0.1, False), (10.0, True)):
        changed = frame.copy()
        changed.iloc[7, column] += share * TOLERANCE * largest
        changed.attrs = frame.attrs
        trainlog.write(trip.with_topic(changed), tmp_path / "changed.mcap")
        found = first_difference(tmp_path / "changed.mcap", folder() / "nonstop.mcap")
        assert (found is not None) == expected, found
        assert found is None or found.startswith("/truth: speed: row 7 is")


def test_the_readme_names_every_sample() -> None:
    text = (folder() / "README.md").read_text("utf-8")
    assert [name for name in names() if f"`{name}`" not in text and name != "README.md"] == []


def test_they_are_small() -> None:
    assert sum((folder() / name).stat().st_size for name in names()) < 10_000_000


def test_the_trips_are_what_their_names_say() -> None:
    nonstop, stopping = (trainlog.read(folder() / f"{n}.mcap") for n in ("nonstop", "stopping"))
    arrivals = [
        trip["/events"].message.str.startswith("arrival").sum() for trip in (nonstop, stopping)
    ]
    assert arrivals == [1, 4]
    assert nonstop.metadata["weather"] == "dry"
    assert stopping["/events"].message.str.contains("slip").any()
    assert truth_of(nonstop) is not None


def test_copies_are_exact(tmp_path: Path) -> None:
    for copy in copy_samples(tmp_path):
        assert sha256_of(copy) == sha256_of(folder() / copy.name)
