"""Examples in docstrings run as they stand, from a folder with the samples."""

import doctest
import importlib
import linecache
from pathlib import Path

import pytest

from trainlog.formats.samples import copy_samples

pytestmark = pytest.mark.usefixtures("remembered", "unpainted_page")

CHECKOUT = Path(__file__).parents[1]
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def modules() -> list[str]:
    """Modules of the three packages with an example in a docstring."""
    paths = (path for package in PACKAGES for path in sorted((CHECKOUT / package).rglob("*.py")))
    with_examples = [path for path in paths if ">>> " in path.read_text("utf-8")]
    parts = [path.relative_to(CHECKOUT).with_suffix("").parts for path in with_examples]
    return [".".join(each[:-1] if each[-1] == "__init__" else each) for each in parts]


PACKAGES = ("trainlog", "analysis", "estimators")
LONG = (
    *("analysis.adhesion.map_difference", "analysis.control.follow", "analysis.estimates"),
    *("analysis.fleet.update", "analysis.geometry.centre_line", "analysis.network.maps"),
    *("analysis.trajectory.journey", "analysis.trajectory.optimiser"),
    *("analysis.trajectory.referee", "trainlog.catalogue.catalogue"),
    *("trainlog.catalogue.querying", "trainlog.condition", "trainlog.formats.mapfile"),
    *("trainlog.formats.railway", "trainlog.ingest.proposal.proposal", "trainlog.mcap.convert"),
    "trainlog.simulation.fleet",
)  # modules whose examples take more than half a second


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("examples")
    copy_samples(made / "sample_logs")
    return made


@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=[pytest.mark.long] if name in LONG else []) for name in modules()],
)
def test_examples_run(name, folder, monkeypatch):
    monkeypatch.chdir(folder)
    # doctest looks with each example whether any file changed that a traceback may show.
    monkeypatch.setattr(linecache, "checkcache", lambda _=None: None)
    failed, tried = doctest.testmod(importlib.import_module(name), optionflags=FLAGS)
    assert failed == 0
    assert tried > 0, f"{name} has examples that doctest does not find"
