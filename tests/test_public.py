"""The installed package: public names, errors, extras, versions of code, wheel, site of docs."""

from __future__ import annotations

import ast
import builtins
import copy
import doctest
import importlib
import inspect
import json
import os
import pickle
import re
import shutil
import subprocess
import symtable
import sys
import sysconfig
import venv
from pathlib import Path
from typing import Any
from urllib.parse import unquote, urlsplit

import pytest
from test_report_page import Outline

import analysis
from trainlog import DEFAULT_TRAIN, TrainlogError, sample, version
from trainlog.extras import EXTRAS
from trainlog.mcap import read_log

CHECKOUT = Path(__file__).parents[1]
sys.path.append(str(CHECKOUT / "docs" / "tools"))
from screenshot import browser_page, chromium  # noqa: E402

PACKAGES = ("trainlog", "analysis")
HEAVY = ("pandas", "cvxpy", "rerun", "numba")


@pytest.mark.parametrize("name", PACKAGES)
def test_every_public_name_is_there_documented_and_has_an_example(name):
    package = importlib.import_module(name)
    assert set(package.__all__) <= set(dir(package))
    public = {each: getattr(package, each) for each in package.__all__}
    assert [each for each, it in public.items() if not it.__doc__] == []
    assert [each for each, it in public.items() if callable(it) and ">>> " not in it.__doc__] == []


def test_importing_the_packages_loads_neither_pandas_nor_a_solver():
    code = f"import sys, {', '.join(PACKAGES)}; print([m for m in {HEAVY} if m in sys.modules])"
    ended = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert ended.stdout.strip() == "[]"


def test_examples_use_only_public_names_and_what_they_import():
    """What a reader of the reference can type: no names of the module that defines it."""
    documented = {}  # docstrings of every public name, and of its public methods
    for package in (*PACKAGES, "estimators"):
        for name in importlib.import_module(package).__all__:
            each = getattr(importlib.import_module(package), name)
            documented[f"{package}.{name}"] = each.__doc__
            for key, method in vars(each).items() if isinstance(each, type) else ():
                if not key.startswith("_"):
                    documented[f"{package}.{name}.{key}"] = getattr(method, "__doc__", None)
    examples = [(name, text) for name, text in documented.items() if ">>> " in (text or "")]
    assert len(examples) > 100
    wrong = {}
    for name, text in examples:
        parts = doctest.DocTestParser().get_examples(inspect.cleandoc(text))
        code = symtable.symtable("".join(each.source for each in parts), name, "exec")
        known = {*vars(builtins), *importlib.import_module(name.split(".")[0]).__all__}
        symbols = [each for table in (code, *code.get_children()) for each in table.get_symbols()]
        used = {each.get_name() for each in symbols if each.is_referenced() and each.is_global()}
        bound = {each.get_name() for each in code.get_symbols() if each.is_assigned()}
        bound |= {each.get_name() for each in code.get_symbols() if each.is_imported()}
        unknown = used - known - bound
        if unknown:
            wrong[name] = unknown
    assert wrong == {}


GIVEN: dict[str, Any] = {
    "problem": "is wrong",
    "file": "a.mcap",
    "place": "byte 3",
    "remedy": "mend it",
    "reason": "too short",
    "refused": {"run": analysis.TripRefusedError("too short", "only 90 s", place="km 1.0")},
}


def kinds() -> list[type[TrainlogError]]:
    """Every error of the three packages."""
    for package in ("trainlog", "analysis", "estimators"):
        for path in (CHECKOUT / package).rglob("*.py"):
            if re.search(r"^class \w+Error\(", path.read_text("utf-8"), re.MULTILINE):
                module = path.relative_to(CHECKOUT).with_suffix("").parts
                importlib.import_module(".".join(module))
    waiting, seen = [TrainlogError], []
    while waiting:
        kind = waiting.pop()
        seen.append(kind)
        waiting += kind.__subclasses__()
    return seen


def test_every_error_survives_pickling_and_copying():
    found = kinds()
    assert len(found) >= 11
    for kind in found:
        taken = inspect.signature(kind).parameters.values()
        named = [each.name for each in taken if each.kind is each.KEYWORD_ONLY]
        others = [GIVEN.get(each.name, each.name) for each in taken if each.name not in named]
        error = kind(*others, **{name: GIVEN[name] for name in named if name in GIVEN})
        for again in (pickle.loads(pickle.dumps(error)), copy.copy(error)):
            assert type(again) is kind
            assert str(again) == str(error)
            assert list(vars(again)) == list(vars(error))
            assert again.place == error.place
            assert again.remedy == error.remedy


def test_a_message_is_one_line_whatever_it_names():
    error = TrainlogError("trip 'a\nb' has no speed", file="c\r\nd.mcap", remedy="record it")
    assert str(error) == "c d.mcap: trip 'a b' has no speed; record it"
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_input_errors_state_a_remedy():
    """Those of a form state in the problem what a value must be; those of studies are few."""
    found = [
        f"{path.relative_to(CHECKOUT)}:{node.lineno}"
        for package in PACKAGES
        for path in sorted((CHECKOUT / package).rglob("*.py"))
        if re.search(r"\b(Input|Log)Error\(", text := path.read_text("utf-8"))
        for node in ast.walk(ast.parse(text))
        if isinstance(node, ast.Call)
        and isinstance(node.func, ast.Name)
        and node.func.id in ("InputError", "LogError")
        and not any(each.arg in ("remedy", None) for each in node.keywords)
    ]
    forms = [each for each in found if "/studies/" not in each]
    assert len(forms) <= 7, forms
    assert len(found) <= 18


WITHOUT = """
import sys
class Absent:
    def find_spec(self, name, *_):
        if name.partition(".")[0] in {modules}:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)
sys.meta_path.insert(0, Absent())
import importlib.util
found = importlib.util.find_spec
importlib.util.find_spec = lambda name, *_: None if name in {modules} else found(name)
{program}
"""

COMMANDS = """
import io, json
from contextlib import redirect_stderr
from trainlog.cli.main import main
ended = []
for words in {commands}:
    sys.argv = ["trainlog", *words]
    with redirect_stderr(io.StringIO()) as said:
        try:
            main()
        except SystemExit as error:
            ended.append((error.code, said.getvalue()))
print(json.dumps(ended))
"""

SAMPLES = ["--line", "sample", "--train", "sample"]


def without_extras(program: str, folder: Path, kept: str = "") -> subprocess.CompletedProcess[str]:
    """Run a program in a Python that has none of the extras' packages but one's."""
    absent = sorted(module for module, extra in EXTRAS.items() if extra != kept)
    code = WITHOUT.format(modules=absent, program=program)
    return subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True)


def test_logs_are_read_recorded_converted_and_shown_without_any_extra(tmp_path):
    log = str(sample("nonstop.mcap"))
    shown = [log, str(sample("CH_StGallen_Wil.line.json")), str(sample(DEFAULT_TRAIN))]
    commands = [["show", each] for each in shown]
    commands += [["convert", "copy.mcap", "-o", "table.parquet"]]
    commands += [["convert", "table.parquet", "-o", "again.mcap", "--from", "60s"]]
    program = f"""
import numpy as np, trainlog
trip = trainlog.read({log!r})
trainlog.write(trip, "copy.mcap")
assert trainlog.read("copy.mcap") == trip
with trainlog.record("recorded.mcap") as recording:
    recording.write("/train/state", 1_700_000_000_000_000_000, speed=3.0)
assert len(trainlog.read("recorded.mcap")["/train/state"]) == 1
import analysis, estimators
from trainlog.errors import MissingExtraError
for get in (lambda: analysis.fit, lambda: estimators.SlipDetector, lambda: trainlog.simulate):
    try:
        get()
    except MissingExtraError as error:
        assert str(error).endswith("pip install 'trainlog[learn]'"), error
    else:
        raise AssertionError
{COMMANDS.format(commands=commands)}
"""
    ended = without_extras(program, tmp_path)
    assert ended.returncode == 0, ended.stderr
    assert json.loads(ended.stdout.splitlines()[-1]) == [[0, ""]] * len(commands)
    assert len(read_log(tmp_path / "again.mcap")["/train/state"]) > 0


LEARN = (
    ["fit", str(sample("nonstop.mcap")), "-o", "fitted.json"],
    ["ingest", str(sample("recorder.csv")), "-o", "logs"],
    ["demo", "-o", "demo"],
)

MISSING = (
    (["replay", str(sample("nonstop.mcap")), "-o", "out.rrd"], "replay"),
    (["plan", "fit.json", "-o", "out.json"], "plan"),
    (["simulate", "follow", "out.json", *SAMPLES, "-o", "driven"], "plan"),
    (["study", "robust-minimax", "-o", "study"], "plan"),
)
"""Commands that need a package, and its extra."""


@pytest.mark.parametrize("kept", [pytest.param("", marks=pytest.mark.long), "learn"])
def test_a_missing_extra_is_one_line_with_the_command_that_installs_it(kept, tmp_path):
    missing = MISSING if kept else [(words, "learn") for words in LEARN]
    (tmp_path / "fit.json").write_text("{}")
    (tmp_path / "out.json").write_text("{}")
    program = COMMANDS.format(commands=[words for words, _ in missing])
    done = without_extras(program, tmp_path, kept)
    assert done.returncode == 0, done.stderr
    ended = json.loads(done.stdout.splitlines()[-1])
    for (status, said), (words, extra) in zip(ended, missing, strict=True):
        assert status == 2, words
        (line,) = said.strip().splitlines()
        assert line.endswith(f"which is not installed; pip install 'trainlog[{extra}]'"), words
    assert not list(tmp_path.glob("*.rrd"))


def test_each_extra_lists_its_packages():
    text = (CHECKOUT / "pyproject.toml").read_text("utf-8")
    for module, extra in EXTRAS.items():
        section = text.partition(f"\n{extra} = [")[2].partition("]\n")[0]
        assert module in section, f"{module} is not in the extra {extra}"


def test_all_modules_that_are_loaded_where_analyses_run_are_part_of_the_version():
    script = """
import sys
from pathlib import Path
from analysis.fleet.work import Batch, Job, computed
from analysis.fleet.analyses import ANALYSES
from trainlog.formats.files import sha256_of
analyses = tuple(ANALYSES.values())
path = Path("sample_logs/nonstop.mcap").absolute()
job = Job("nonstop", sha256_of(path), str(path), tuple(range(len(analyses))))
result = computed(Batch((job,), analyses))
assert not result.unread
assert all(each.state == "done" for part in result.outcomes for each in part)
print(*(name for name in sys.modules if name.startswith(("trainlog", "analysis", "estimators"))))
"""
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    loaded = {name for name in done.stdout.split() if version._file_of(name)}
    assert len(loaded) > 80
    known = version._modules_behind("analysis.fleet.work")
    assert loaded <= known


WRITTEN = {
    "def use():\n    import trainlog.other  # noqa: F401\n": True,
    "import os, trainlog.other as short\n": True,
    "try: import trainlog.other\nexcept ImportError: pass\n": True,
    "from .other import one\n": True,
    "from . import (\n    other,  # (see there)\n)\n": True,
    "from trainlog.rest import (\n    rest,  # a (note)\n    one,\n)\nfrom .other import*\n": True,
    "from trainlog \\\n    import other\n": True,
    "x = 'it\\'s'  # it's\nif x: from trainlog import other; x = 1\n": True,
    "from trainlog.rest import first\n": True,
    "from trainlog.rest import *\n": True,
    "import trainlog.rest as rest\n": True,
    '"""\nfrom trainlog import other\n"""\n': False,
    "# import trainlog.other\nx = 'import trainlog.other'\n": False,
    "if TYPE_CHECKING:  # cycle\n    from trainlog.other import (\n        one,\n    )\n": False,
    "from trainlog.rest import second\n": False,
}


@pytest.mark.parametrize("text", WRITTEN)
def test_an_import_counts_however_it_is_written(text, tmp_path, monkeypatch):
    package = tmp_path / "trainlog"
    (package / "rest").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "rest" / "__init__.py").write_text(
        "from trainlog.extras import names_on_first_use\n"
        "if TYPE_CHECKING:\n    from trainlog.other import one\n"
        "    from trainlog.third import second as second\n    first = one\n"
        "__all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)\n"
    )
    (package / "other.py").write_text("one = 1\n")
    (package / "third.py").write_text("second = 1\n")
    (package / "user.py").write_text(text)
    monkeypatch.setattr(version, "_SOURCE", tmp_path)
    monkeypatch.setattr(version, "_on_first_use", version._on_first_use.__wrapped__)
    before = version.code_version_of.__wrapped__("trainlog.user")
    (package / "other.py").write_text("one = 2\n")
    assert (version.code_version_of.__wrapped__("trainlog.user") != before) is WRITTEN[text]


INSIDE = ("PYTHONPATH", "PYTHONDONTWRITEBYTECODE")
OUTSIDE = {key: value for key, value in os.environ.items() if key not in INSIDE}
"""The environment of somebody who knows nothing of the checkout."""


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    command = [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory"]
    subprocess.run([*command, folder], cwd=CHECKOUT, check=True, capture_output=True, timeout=300)
    (built,) = folder.glob("trainlog-*.whl")
    return built


def environment(folder: Path) -> tuple[Path, Path]:
    """A fresh environment, without pip: its Python and its site-packages."""
    venv.create(folder)
    scripts = folder / ("Scripts" if os.name == "nt" else "bin")
    python = scripts / ("python.exe" if os.name == "nt" else "python")
    base = {"base": str(folder), "platbase": str(folder)}
    return python, Path(sysconfig.get_path("purelib", "venv", base))


def install(python: Path, *arguments: str, timeout: float) -> None:
    """Install into the environment of `python`, by the pip that runs here."""
    pip = [sys.executable, "-m", "pip", "--python", str(python), "install", "--quiet"]
    subprocess.run([*pip, *arguments], check=True, capture_output=True, timeout=timeout)


def trainlog(python: Path, *arguments: str, cwd: Path) -> str:
    command = [python.with_name("trainlog" + python.suffix), *arguments]
    where = {"cwd": cwd, "timeout": 300, "env": OUTSIDE}
    done = subprocess.run(command, capture_output=True, text=True, **where)
    assert done.returncode == 0, done.stderr
    return done.stdout


def installed_works(python: Path, folder: Path) -> None:
    trainlog(python, "new", "samples", "-o", "samples", cwd=folder)
    logs = sorted((folder / "samples").glob("*.mcap"))
    assert logs
    assert "/train/state" in trainlog(python, "show", str(logs[0]), cwd=folder)
    page, *rest = trainlog(python, "docs", "planner", "--path", cwd=folder).splitlines()
    assert Path(page).is_relative_to(python.parents[1])
    assert "# Planner: " in Path(page).read_text("utf-8") or page.endswith(".html")
    assert page.endswith(".html") != any("make docs" in line for line in rest)


def test_the_wheel_runs_outside_the_checkout(wheel, tmp_path):
    python, site = environment(tmp_path / "environment")
    install(python, "--no-deps", "--no-index", "--no-compile", str(wheel), timeout=300)
    # Third-party packages come from the environment that runs the tests; trainlog does not, as
    # its editable install is not followed from here.
    (site / "third_party.pth").write_text(sysconfig.get_path("purelib") + "\n")
    installed_works(python, tmp_path)


@pytest.mark.long
def test_the_wheel_declares_all_it_needs(wheel, tmp_path):
    python, _ = environment(tmp_path / "environment")
    install(python, str(wheel), timeout=1800)
    installed_works(python, tmp_path)


MOST_BYTES = 25_000_000
LOUD, LOCAL = ("error", "warning"), ("file:", "data:", "blob:")
ABORTED = "net::ERR_ABORTED"


@pytest.fixture(scope="module")
def checkout(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the checkout with its site built, which must not give a single warning."""
    copy = tmp_path_factory.mktemp("site") / "checkout"
    names = (".git", ".venv", "build", "dist", "results", "__pycache__", ".*_cache", ".hypothesis")
    shutil.copytree(CHECKOUT, copy, ignore=shutil.ignore_patterns(*names))
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet"]
    known = {**OUTSIDE, "NO_MKDOCS_2_WARNING": "1"}
    done = subprocess.run(
        command, cwd=copy, capture_output=True, text=True, timeout=1200, env=known
    )
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    return copy


@pytest.fixture(scope="module")
def site(checkout: Path) -> Path:
    return checkout / "build" / "site"


@pytest.mark.long
def test_every_link_leads_to_a_file_and_a_place_in_it(site):
    pages = {path: Outline(path.read_text("utf-8")) for path in site.rglob("*.html")}
    anchors = {path: set(page.values("id", "name")) for path, page in pages.items()}
    lost = []
    for page, outline in pages.items():
        if page.name == "404.html":  # for servers: its links begin at their root
            continue
        for target in outline.values("href", "src"):
            parts = urlsplit(target)
            if parts.scheme:
                continue
            path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
            path = path / "index.html" if path.is_dir() else path
            fragment = unquote(parts.fragment)
            known = anchors.get(path)
            if not path.is_file() or (known is not None and fragment and fragment not in known):
                lost.append(f"{page.relative_to(site)}: {target}")
    assert lost == []
    assert len(pages) > 30
    assert sum(path.stat().st_size for path in site.rglob("*") if path.is_file()) < MOST_BYTES


@pytest.mark.long
def test_executed_pages_show_what_their_code_printed_and_drew(site):
    engineer = (site / "tutorials" / "engineer.html").read_text("utf-8")
    assert re.search(r"Running resistance of CH_Stadler_FLIRT_TPF: N", engineer)
    developer = (site / "tutorials" / "developer.html").read_text("utf-8")
    assert "<b>Track-condition map of line" in developer
    gallery = (site / "gallery.html").read_text("utf-8")
    assert len(re.findall(r"<img [^>]*src=", gallery)) >= 13


@pytest.mark.long
@pytest.mark.skipif(chromium() is None, reason="there is no Chromium")
def test_pages_are_whole_in_a_browser_without_a_network(site):
    """No errors on the console, no request to anywhere else, every picture drawn."""
    wrong = []
    with browser_page(viewport={"width": 1280, "height": 900}) as page:
        page.on("console", lambda said: said.type in LOUD and wrong.append((page.url, said.text)))
        page.on("pageerror", lambda error: wrong.append((page.url, str(error))))
        # The next page aborts what the one before still loads.
        page.on(
            "requestfailed",
            lambda asked: asked.failure == ABORTED or wrong.append((page.url, asked.url)),
        )
        page.on("request", lambda asked: asked.url.startswith(LOCAL) or wrong.append(asked.url))
        for path in sorted(site.rglob("*.html")):
            if path.name == "404.html":
                continue
            page.goto(path.as_uri())
            empty = "[...document.images].filter(i => !(i.complete && i.naturalWidth)).length"
            assert page.evaluate(empty) == 0, path
            wide = page.evaluate("document.documentElement.scrollWidth - innerWidth")
            assert wide <= 0, f"{path.name} is {wide} px wider than the window"
    assert wrong == []


@pytest.mark.long
@pytest.mark.skipif(chromium() is None, reason="there is no Chromium")
def test_the_search_finds_a_word_without_a_server(site):
    with browser_page() as page:
        page.goto((site / "index.html").as_uri())
        page.keyboard.press("/")
        page.wait_for_selector(".md-search__input:focus")
        page.keyboard.type("recursive least squares")
        page.wait_for_selector(".md-search-result__item", timeout=10_000)
        assert page.locator(".md-search-result__item").count() >= 3
        found = page.locator(".md-search-result__list").inner_text().lower()
        assert "recursive" in found


@pytest.mark.long
def test_a_wheel_made_after_the_site_holds_it_and_opens_it(checkout, tmp_path):
    """The wheel is that of the source distribution, as `python -m build` makes both."""
    make = [sys.executable, "-m", "build", "--no-isolation", "--outdir", str(tmp_path / "dist")]
    done = subprocess.run([*make, str(checkout)], capture_output=True, text=True, timeout=600)
    assert done.returncode == 0, done.stdout + done.stderr
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    python, packages = environment(tmp_path / "environment")
    install(python, "--no-deps", "--no-index", str(wheel), timeout=300)
    (packages / "third_party.pth").write_text(sysconfig.get_path("purelib") + "\n")
    page = trainlog(python, "docs", "planner", "--path", cwd=tmp_path).strip()
    assert Path(page).parts[-4:] == ("documentation_pages", "site", "tutorials", "planner.html")
    assert Path(page).is_relative_to(python.parents[1])
    place = trainlog(python, "docs", "analysis.fit", "--path", cwd=tmp_path).strip()
    assert place.endswith("reference/resistance.html#analysis.fit")
    assert "tutorials/planner" in trainlog(python, "docs", "--list", cwd=tmp_path)
