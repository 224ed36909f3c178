"""Python and commands in README and docs run as they stand, in a folder with the samples."""

from __future__ import annotations

import importlib
import re
import shlex
from pathlib import Path

import pytest

from trainlog.cli import main as cli
from trainlog.formats.samples import copy_samples
from trainlog.mcap import records
from trainlog.topics import TOPICS

pytestmark = pytest.mark.usefixtures("remembered_estimates")

CHECKOUT = Path(__file__).parents[1]
PAGES = sorted([CHECKOUT / "README.md", *(CHECKOUT / "docs").glob("*.md")])


def blocks(page: Path) -> str:
    """All blocks of a page marked ``python``, in order, as one program."""
    return "\n".join(re.findall(r"^```python\n(.*?)^```", page.read_text("utf-8"), re.M | re.S))


@pytest.mark.parametrize(
    "page", [page for page in PAGES if blocks(page)], ids=lambda page: page.name
)
def test_examples_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy_samples(tmp_path / "sample_logs")
    monkeypatch.chdir(tmp_path)
    exec(compile(blocks(page), str(page), "exec"), {"__name__": "__main__"})


def commands(page: Path) -> list[list[str]]:
    """All commands in blocks of a page marked ``sh``, in order, as words."""
    found = re.findall(r"^```sh\n(.*?)^```", page.read_text("utf-8"), re.M | re.S)
    return [shlex.split(line) for line in "".join(found).splitlines()]


@pytest.mark.parametrize(
    "page", [page for page in PAGES if commands(page)], ids=lambda page: page.name
)
def test_commands_run(page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    copy_samples(tmp_path / "sample_logs")
    monkeypatch.chdir(tmp_path)
    for program, *words in commands(page):
        assert program == "trainlog"
        assert cli.run(words) == 0


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_between_pages_lead_somewhere(page: Path) -> None:
    for target in re.findall(r"\]\(([^)#\s]+)", page.read_text("utf-8")):
        if not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"


def resolved(dotted: str) -> object:
    """The module, class or function of a dotted name."""
    parts = dotted.split(".")
    for count in range(len(parts), 0, -1):
        try:
            found: object = importlib.import_module(".".join(parts[:count]))
        except ModuleNotFoundError:
            continue
        for name in parts[count:]:
            found = getattr(found, name)
        return found
    raise ModuleNotFoundError(dotted)


NAME = re.compile(r"`((?:trainlog|analysis|estimators)(?:\.\w+)+)(?:\([^`]*)?`")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_names_of_the_code_exist(page: Path) -> None:
    # Names of messages and metadata records look alike.
    messages = {topic.message for topic in TOPICS.values()}
    messages |= {value for name, value in vars(records).items() if name.endswith("_RECORD")}
    for dotted in set(NAME.findall(page.read_text("utf-8"))) - messages:
        resolved(dotted)
