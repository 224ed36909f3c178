"""The samples are what their README says, and can be made again byte for byte."""

from __future__ import annotations

import runpy
from pathlib import Path

import pytest

import trainlog
from analysis.truth import truth_of
from trainlog.formats.samples import copy_samples, folder, names

CHECKOUT = Path(__file__).parents[1]

MADE = (
    "nonstop.mcap",
    "stopping.mcap",
    "recorder.csv",
    "gnss.csv",
    "CH_StGallen_Wil.map.json",
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
    for name in made:
        assert (tmp_path / name).read_bytes() == (folder() / name).read_bytes()


@pytest.mark.parametrize("name", MADE)
def test_the_command_in_the_readme_makes_them_again(made: Path, name: str) -> None:
    assert (made / name).read_bytes() == (folder() / name).read_bytes()


def test_nothing_else_is_left_behind(made: Path) -> None:
    assert sorted(path.name for path in made.iterdir()) == sorted(MADE)


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
        assert copy.read_bytes() == (folder() / copy.name).read_bytes()
