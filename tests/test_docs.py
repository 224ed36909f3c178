"""The documentation: its code runs as it stands, its links lead somewhere, nothing is missing."""

import importlib
import re
import sys
from pathlib import Path
from typing import Any

import pytest
from matplotlib.figure import Figure
from refusals import refused

from trainlog.cli.settings import Documentation
from trainlog.errors import InputError
from trainlog.formats.samples import copy_samples
from trainlog.mcap import records
from trainlog.topics import TOPICS

pytestmark = pytest.mark.usefixtures("remembered")

CHECKOUT = Path(__file__).parents[1]
DOCS = CHECKOUT / "docs"
sys.path.append(str(DOCS / "tools"))
import notebook  # noqa: E402
import pages  # noqa: E402
import sources  # noqa: E402
from topic_table import with_topics  # noqa: E402

PAGES = sorted([CHECKOUT / "README.md", *DOCS.rglob("*.md")])
LONG = (
    *("catalogue.md", "comparison.md", "engineer.md", "gallery.md", "how-to.md", "network.md"),
    *("planner.md", "sfera.md", "simulation.md", "track-condition-map.md", "trajectories.md"),
)  # pages whose code takes more than a second and a half, but the developer's tutorial
TUTORIAL = DOCS / "tutorials" / "developer.md"
PAINTED = Figure.savefig
LINK = re.compile(r"\]\(([^)#\s]+)")


@pytest.mark.usefixtures("unpainted_page")
@pytest.mark.parametrize(
    "page",
    [
        pytest.param(page, marks=[pytest.mark.long] if page.name in LONG else [], id=page.name)
        for page in PAGES
        if pages.blocks_of(page.read_text("utf-8"))
    ],
)
def test_code_runs(page, tmp_path, monkeypatch):
    """Of the pictures that a page writes, those that it shows are painted, too."""
    shown, unpainted = LINK.findall(page.read_text("utf-8")), Figure.savefig

    def written(figure: Figure, path: str | Path, **given: Any) -> None:
        # Commands write under another name first, as ".map-0a1b2c3d.png".
        name = re.sub(r"^\.(.*)-[^-]*$", r"\1", Path(path).stem)
        known = any(name == Path(each).stem for each in shown)
        (PAINTED if known else unpainted)(figure, Path(path), **given)

    monkeypatch.setattr(Figure, "savefig", written)
    copy_samples(tmp_path / "sample_logs")
    monkeypatch.chdir(tmp_path)
    text = page.read_text("utf-8")
    outputs = list(pages.execute(text))
    assert len(outputs) == len(pages.blocks_of(text))
    if text.startswith(pages.EXECUTED):
        for target in LINK.findall(text):
            if target.endswith((".png", ".html")) and not (page.parent / target).is_file():
                assert (tmp_path / target).stat().st_size > 5_000, target
    if page == TUTORIAL:
        kinds = "Trip ", "Line ", "Train ", "Track-condition map ", "Running res", "Trajectory "
        for title in kinds:
            begins = re.compile(rf"<div><b>{title}|<table><caption[^>]*><b>{title}")
            assert any(begins.match(output.html) for output in outputs), title


def test_the_notebook_is_the_tutorial():
    """To renew it: python docs/tools/notebook.py docs/tutorials/developer.md THE_NOTEBOOK."""
    kept = TUTORIAL.with_suffix(".ipynb").read_text("utf-8")
    assert kept == notebook.written(notebook.from_page(TUTORIAL.read_text("utf-8")))


def test_the_page_on_logs_ends_with_todays_table_of_topics():
    page = (DOCS / "log.md").read_text("utf-8")
    assert page == with_topics(page), "run docs/tools/topic_table.py docs/log.md"


PACKAGES = ("trainlog", "analysis", "estimators")


def test_the_reference_has_every_public_name_once():
    text = "".join(page.read_text("utf-8") for page in sorted((DOCS / "reference").glob("*.md")))
    listed = re.findall(r"^::: (\S+)$", text, re.M)
    packages = {p: importlib.import_module(p) for p in (*PACKAGES, "trainlog.catalogue")}
    public = [f"{package}.{name}" for package, m in packages.items() for name in m.__all__]
    assert sorted(listed) == sorted(public)


def test_every_page_is_in_the_navigation():
    text = (CHECKOUT / "mkdocs.yml").read_text("utf-8").partition("\nnav:\n")[2]
    missing = [
        page.relative_to(DOCS).as_posix()
        for page in DOCS.rglob("*.md")
        if not re.search(rf"[ :]{re.escape(page.relative_to(DOCS).as_posix())}$", text, re.M)
    ]
    assert missing == []


def test_validation_states_what_the_studies_reach():
    """The figures of the papers' systems are those of the page whose tables are tested."""
    studies = (DOCS / "studies.md").read_text("utf-8")
    validation = (DOCS / "validation.md").read_text("utf-8")
    section = validation.partition("## The published systems")[2].partition("\n## ")[0]
    stated = set(re.findall(r"\d+\.\d{2,}(?:e-\d+)?", section))
    assert len(stated) > 8
    assert {number for number in stated if number not in studies} == set()


def test_validation_names_benchmarks_that_there_are():
    text = (DOCS / "validation.md").read_text("utf-8")
    named = set(re.findall(r"python (benchmarks/\S+\.py)", text))
    assert len(named) > 20
    assert {name for name in named if not (CHECKOUT / name).is_file()} == set()
    # A figure that two pages state ends up different on them.
    naming = {page.name for page in DOCS.rglob("*.md") if "benchmarks/" in page.read_text("utf-8")}
    assert naming == {"validation.md"}


def anchors_of(page: Path) -> set[str]:
    """Places in a page as the site names them."""
    from pymdownx.slugs import slugify

    text = re.sub(r"^```.*?^```", "", page.read_text("utf-8"), flags=re.M | re.S)
    titles = [words.replace("`", "") for words in re.findall(r"^#+ (.*)$", text, re.M)]
    plain = [re.sub(r"\[([^]]*)\]\([^)]*\)", r"\1", words) for words in titles]
    return {slugify(case="lower")(words, "-") for words in plain}


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_links_lead_to_files_and_places_that_there_are(page):
    text = page.read_text("utf-8")
    for target in LINK.findall(text):
        made = text.startswith(pages.EXECUTED) and target.endswith((".png", ".html"))
        if not made and not target.startswith(("http:", "https:")):
            assert (page.parent / target).exists(), f"{page.name} links to {target}"
    for target, place in re.findall(r"\]\(([^)#\s:]*)#([^)\s]+)\)", text):
        other = (page.parent / target).resolve() if target else page
        assert place in anchors_of(other), f"{page.name} links to {target}#{place}"


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


def test_names_of_the_code_exist():
    # Names of messages, metadata records and files look alike.
    messages = {topic.message for topic in TOPICS.values()}
    messages |= {value for name, value in vars(records).items() if name.endswith("_RECORD")}
    messages |= {"trainlog.json"}  # a file's name
    named = {dotted for page in PAGES for dotted in NAME.findall(page.read_text("utf-8"))}
    for dotted in named - messages:
        resolved(dotted)


STUDIES = {"H": "hauck_2023", "A": "amirhosseini_2024", "C": "cunillera_2022", "Z": "zhao_2025"}


def test_every_part_of_a_paper_names_code_that_is_there_and_a_result():
    text = (DOCS / "papers.md").read_text("utf-8")
    rows = [line.strip("|").split("|") for line in text.splitlines() if line.startswith("| ")]
    parts = [[cell.strip() for cell in row] for row in rows if len(row) == 4 and "`" in row[1]]
    assert len(parts) > 60
    for part, where, result, why in parts:
        first, _, rest = where.strip("`").partition(".")
        study = f"analysis.studies.{STUDIES.get(first)}.{rest}"
        resolved(study if first in STUDIES else where.strip("`"))
        assert result in ("as printed", "corrected", "reached", "differs", "not run"), part
        assert why or result in ("as printed", "reached"), part


@pytest.fixture(params=["site", "source"])
def installed(request: pytest.FixtureRequest, tmp_path: Path) -> Documentation:
    """Documentation as an installation has it: a built site, or Markdown."""
    built = request.param == "site"
    folder = tmp_path / request.param
    for name in ("index", "tutorials/planner", "reference/logs"):
        path = folder / f"{name}.{'html' if built else 'md'}"
        path.parent.mkdir(parents=True, exist_ok=True)
        source = (DOCS / f"{name}.md").read_text("utf-8")
        html = '<h1 id="a">A title &amp; more<a class="headerlink" href="#a">¶</a></h1>'
        html = f'<div class="md-content">{html}</div>'
        path.write_text(html + '<h2 id="trainlog.read">read</h2>' if built else source, "utf-8")
    return Documentation(folder, built)


def test_pages_are_found_by_name_and_by_what_they_describe(installed):
    assert installed.place()[0].stem == "index"
    assert installed.place("planner") == installed.place("tutorials/planner")
    page, anchor = installed.place("read")
    assert page.stem == "logs"
    assert anchor == ("trainlog.read" if installed.built else "")
    titles = dict(installed.titles())
    assert titles["index"] == ("A title & more" if installed.built else "trainlog")
    refused(InputError, r"no page 'palnner'.*near to it: planner", installed.place, "palnner")


def test_a_site_of_other_files_is_not_put_into_the_wheel(tmp_path):
    for folder in ("docs", "build/site", "sample_logs"):
        (tmp_path / folder).mkdir(parents=True)
    for name in ("mkdocs.yml", "CHANGELOG.md", "CONTRIBUTING.md", "docs/index.md"):
        (tmp_path / name).write_text("today", "utf-8")
    assert sources.site_of(tmp_path) is None
    stamp = tmp_path / "build" / "site" / sources.STAMP
    stamp.write_text(sources.state_of(tmp_path), "utf-8")
    assert sources.site_of(tmp_path) == tmp_path / "build" / "site"
    (tmp_path / "docs" / "index.md").write_text("tomorrow", "utf-8")
    assert sources.site_of(tmp_path) is None
