"""How many random faults of the numerics the tests find.

    python benchmarks/structure/benchmark_mutants.py --count 200 --seed 1

A mutant is a copy of the checkout in which one operator, comparison, number or statement of one
module is another one; it is killed if the tests nearest to that module fail. The tests that ran the
line of the mutant are run, those of the quickest file first, then the others of these files. Those
that survive are listed with their place, and go through wider tests where ``--wider`` asks for it:
some are equivalent to the original, the others show which behaviour no test asks for.

Each run of tests is a fork of this process, which has loaded the packages that the tests need.
Kernels of the module are not compiled in the first run of a mutant: a failed assertion there kills
it; any other failure is asked of the compiled kernels.
"""

from __future__ import annotations

import argparse
import ast
import importlib
import json
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import FrameType
from typing import Any

import pytest

CHECKOUT = Path(__file__).resolve().parents[2]

NEAREST = {
    "estimators/regression.py": "estimators resistance_windows recorded_topics",
    "analysis/resistance/regression.py": "resistance_windows recorded_topics",
    "estimators/condition_passes.py": "condition_passes traction_map",
    "trainlog/catalogue/registration.py": "catalogue identity",
    "trainlog/formats/mapfile.py": "traction_map map_service map_export",
    "analysis/trajectory/audit.py": "trajectory_certificate trajectory_answers",
    "analysis/trajectory/bound.py": "trajectory_certificate trajectory_answers",
    "analysis/trajectory/instructions.py": "driver_advice advice_obeyed",
    "trainlog/ingest/clock.py": "ingest_time ingest_trips ingest_repair ingest_recorders live",
}
"""Modules, and the tests that a fault in them should fail, the quickest first."""

WIDER = {
    "estimators/regression.py": "coast_down studies resistance_fit golden",
    "analysis/resistance/regression.py": "coast_down resistance_fit comparison golden tunnels",
    "estimators/condition_passes.py": "map_export golden",
    "trainlog/catalogue/registration.py": "fleet_update results catalogue_sql",
    "trainlog/formats/mapfile.py": "network_maps samples golden",
    "analysis/trajectory/audit.py": "trajectory_limits",
    "analysis/trajectory/bound.py": "trajectory_limits",
    "analysis/trajectory/instructions.py": "sfera optimise_command trajectory_limits",
    "trainlog/ingest/clock.py": "golden",
}

COMPARISONS = {
    ast.Lt: ast.LtE, ast.LtE: ast.Lt, ast.Gt: ast.GtE, ast.GtE: ast.Gt, ast.Eq: ast.NotEq,
    ast.NotEq: ast.Eq, ast.In: ast.NotIn, ast.NotIn: ast.In, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
}  # fmt: skip
OPERATORS = {
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.FloorDiv: ast.Mult, ast.Mod: ast.Mult, ast.Pow: ast.Mult, ast.BitAnd: ast.BitOr,
    ast.BitOr: ast.BitAnd, ast.MatMult: ast.Mult,
}  # fmt: skip
NAMES = {"min": "max", "max": "min", "minimum": "maximum", "maximum": "minimum", "any": "all",
         "all": "any", "argmin": "argmax", "argmax": "argmin"}  # fmt: skip

SPARE = 25.0
"""Time [s] that tests may take beyond three times theirs without a change: else it is killed."""

MEMORY = 12 << 30
"""Most memory of one run [bytes]."""

LOADED = ("numpy", "scipy", "pandas", "numba", "llvmlite", "pyarrow", "sqlalchemy", "matplotlib")
"""Packages that are loaded before the forks: they take most of the time of a start."""


@dataclass(frozen=True)
class Mutant:
    """One change of one module: what stands from one offset to another, and what instead."""

    module: str
    line: int
    start: int
    end: int
    before: str
    after: str

    def applied(self, text: bytes) -> bytes:
        """The module's text with the change."""
        return text[: self.start] + self.after.encode() + text[self.end :]


def mutants_of(module: str, text: bytes) -> list[Mutant]:
    """All changes of a module, but those of annotations, messages and what is not executed."""
    offsets = [0]
    for line in text.splitlines(keepends=True):
        offsets.append(offsets[-1] + len(line))
    found = []
    for node, after in _changes(ast.parse(text)):
        start = offsets[node.lineno - 1] + node.col_offset
        end = offsets[(node.end_lineno or 0) - 1] + (node.end_col_offset or 0)
        before = text[start:end].decode()
        found.append(Mutant(module, node.lineno, start, end, before, after))
    return found


def _changes(tree: ast.AST) -> Iterator[tuple[ast.expr | ast.stmt, str]]:
    for node in ast.iter_child_nodes(tree):
        if isinstance(node, ast.Raise | ast.Import | ast.ImportFrom | ast.JoinedStr | ast.arg):
            continue
        if isinstance(node, ast.If) and "TYPE_CHECKING" in ast.unparse(node.test):
            continue
        if isinstance(node, ast.expr):
            yield from ((node, after) for after in _expressions(node))
        if isinstance(node, ast.AugAssign) or (
            isinstance(node, ast.Expr) and isinstance(node.value, ast.Call)
        ):
            yield node, "pass"
        if isinstance(node, ast.ClassDef | ast.FunctionDef):
            defaults = node.args.defaults if isinstance(node, ast.FunctionDef) else []
            for each in [*node.body, *defaults]:
                yield from _changes(ast.Expression(each))  # type: ignore[arg-type]
        elif isinstance(node, ast.AnnAssign):
            if node.value is not None:
                yield from _changes(ast.Expression(node.value))
        else:
            yield from _changes(node)


def _expressions(node: ast.expr) -> Iterator[str]:
    """Other expressions in the place of one."""
    if isinstance(node, ast.Compare) and type(node.ops[0]) in COMPARISONS:
        changed = COMPARISONS[type(node.ops[0])]()
        yield ast.unparse(ast.Compare(node.left, [changed, *node.ops[1:]], node.comparators))
    if isinstance(node, ast.BinOp) and type(node.op) in OPERATORS:
        other = ast.BinOp(node.left, OPERATORS[type(node.op)](), node.right)
        yield f"({ast.unparse(other)})"
    if isinstance(node, ast.UnaryOp):
        yield f"({ast.unparse(node.operand)})"
    if isinstance(node, ast.BoolOp):
        changed_to = ast.Or() if isinstance(node.op, ast.And) else ast.And()
        yield f"({ast.unparse(ast.BoolOp(changed_to, node.values))})"
    if isinstance(node, ast.Constant) and isinstance(node.value, bool | int | float):
        yield _number(node.value)
    if isinstance(node, ast.Name) and node.id in NAMES:
        yield NAMES[node.id]
    if isinstance(node, ast.Attribute) and node.attr in NAMES:
        yield f"{ast.unparse(node.value)}.{NAMES[node.attr]}"


def _number(value: float | bool) -> str:
    if isinstance(value, bool):
        return str(not value)
    return repr(value + 1) if isinstance(value, int) or value == 0.0 else repr(2.0 * value)


def _copy(folder: Path) -> None:
    """The checkout's files and compiled kernels, as they are now, in another folder."""
    left_out = shutil.ignore_patterns(".git", ".venv", "build", "dist", ".*_cache", ".hypothesis")
    shutil.copytree(CHECKOUT, folder, ignore=left_out, symlinks=True)
    shared = CHECKOUT.parent / "shared"
    if shared.exists():
        (folder.parent / "shared").symlink_to(shared)


class Watcher:
    """A plugin of pytest: times of tests, the lines of a module that each ran, the first failure.

    Parameters
    ----------
    module : str, optional
        The file whose lines are watched; None: only failures.
    """

    def __init__(self, module: str | None = None) -> None:
        self.module = module
        self.lines: dict[str, set[int]] = {}
        self.seconds: dict[str, float] = {}
        self.failed, self.error = "", ""
        self._now = ""

    def _calls(self, frame: FrameType, *_: object) -> Any:
        if frame.f_code.co_filename == self.module:
            return self._steps(frame)
        return None

    def _steps(self, frame: FrameType, *_: object) -> Any:
        self.lines.setdefault(self._now, set()).add(frame.f_lineno)
        return self._steps

    def pytest_sessionstart(self) -> None:
        """Have failing examples not be made smaller, which takes minutes."""
        from hypothesis import Phase, settings  # which pytest is to load first

        known = settings.get_profile("trainlog")
        settings.register_profile("mutants", known, phases=(Phase.explicit, Phase.generate))
        settings.load_profile("mutants")

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Iterator[None]:
        """Watch a test."""
        began, self._now = time.monotonic(), item.nodeid
        if self.module is not None:
            sys.settrace(self._calls)
        result = yield
        sys.settrace(None)
        self.seconds[item.nodeid] = time.monotonic() - began
        return result

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: Any) -> Iterator[None]:
        """Watch a fixture: what one of several tests runs is of all tests of the file."""
        before = self._now
        if fixturedef.scope != "function":
            self._now = ""
        try:
            return (yield)
        finally:
            self._now = before

    def pytest_exception_interact(self, node: Any, call: Any) -> None:
        """Keep the first failure."""
        self.failed = self.failed or node.nodeid
        self.error = self.error or call.excinfo.typename


@dataclass(frozen=True)
class Run:
    """What became of a run of tests.

    Attributes
    ----------
    passed : bool
    failed, error : str
        The first test that failed, and its exception.
    seconds : dict
        Time of each test.
    lines : dict
        Lines of the module that each test ran; those of fixtures of several tests under "".
    packages : list of str
        Modules of `LOADED` that the tests need.
    """

    passed: bool
    failed: str = ""
    error: str = ""
    seconds: dict[str, float] | None = None
    lines: dict[str, list[int]] | None = None
    packages: tuple[str, ...] = ()


def run_tests(
    folder: Path, tests: Sequence[str], limit: float, module: str = "", compiled: bool = True
) -> Run:
    """Run tests of a copy in a fork; `module` is the file whose lines are watched.

    Without `compiled` the kernels of `module` run as Python and no line is watched.
    """
    answer = folder.parent / "answer.json"
    answer.unlink(missing_ok=True)
    child = os.fork()
    if child == 0:
        status = 70
        try:
            os.setsid()
            status = _in_child(folder, tests, module, compiled, answer)
        except BaseException:  # noqa: BLE001 - nothing of a fork comes back into this process
            traceback.print_exc()
        finally:
            os._exit(status)
    ends = time.monotonic() + limit
    while not (ended := os.waitpid(child, os.WNOHANG))[0]:
        if time.monotonic() > ends:
            os.killpg(child, signal.SIGKILL)
            os.waitpid(child, 0)
            return Run(False, "not ended", "AssertionError")
        time.sleep(0.02)
    if os.waitstatus_to_exitcode(ended[1]) == 70:
        raise SystemExit(f"a run of tests went wrong: {answer.with_suffix('.txt').read_text()}")
    if not answer.exists():
        return Run(False, f"process ended with status {ended[1]}", "AssertionError")
    return Run(**json.loads(answer.read_bytes()))


def _in_child(folder: Path, tests: Sequence[str], module: str, compiled: bool, to: Path) -> int:
    resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
    os.chdir(folder)
    sys.path.insert(0, str(folder))
    os.environ |= {"PYTHONPATH": str(folder), "CI": "1"}
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)
    said = os.open(to.with_suffix(".txt"), os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    os.dup2(said, 1)
    os.dup2(said, 2)
    watcher = Watcher(str(folder / module) if module and compiled else None)
    if not compiled:
        _without_compiling(module)
    status = pytest.main(["-q", "-x", "-p", "no:cacheprovider", *tests], plugins=[watcher])
    found = {
        "passed": status == 0,
        "failed": watcher.failed,
        "error": watcher.error,
        "seconds": watcher.seconds,
        "lines": {test: sorted(lines) for test, lines in watcher.lines.items()},
        "packages": [name for name in sys.modules if name.split(".")[0] in LOADED],
    }
    to.write_text(json.dumps(found))
    return 0


def _without_compiling(module: str) -> None:
    """Import a module with its kernels as they are written; they warn as little as compiled."""
    import numba
    import numpy as np

    def kept(*_: object, **__: object) -> Callable[[Any], Any]:
        return lambda function: function

    np.seterr(all="ignore")
    usual, numba.njit = numba.njit, kept
    try:
        importlib.import_module(module.removesuffix(".py").replace("/", "."))
    finally:
        numba.njit = usual


@dataclass(frozen=True)
class Nearest:
    """The tests nearest to a module: which lines each runs, and how long they take.

    Attributes
    ----------
    lines, seconds : dict
        Of each test.
    kernels : bool
        Whether the module has compiled functions, whose lines are not seen.
    """

    lines: dict[str, set[int]]
    seconds: dict[str, float]
    kernels: bool

    def of(self, line: int) -> list[str]:
        """Tests that run a line, by file and the one with the quickest test first; else all."""
        hit = [each for each in self.seconds if line in self.lines[each]] or [*self.seconds]
        quickest: dict[str, float] = {}
        for each in hit:
            file = each.split("::")[0]
            quickest[file] = min(quickest.get(file, float("inf")), self.seconds[each])
        # In a file in its own order, by which its tests share what they make once.
        return sorted(hit, key=lambda each: quickest[each.split("::")[0]])

    def limit(self, tests: Sequence[str]) -> float:
        """Most time that tests may take [s]."""
        return SPARE + 3.0 * sum(self.seconds[each] for each in tests)


def _files(names: str) -> list[str]:
    return [f"tests/test_{each}.py" for each in names.split()]


def nearest(folder: Path, module: str) -> Nearest:
    """Run the nearest tests of a module without a change."""
    lines, seconds, packages = dict[str, set[int]](), dict[str, float](), list[str]()
    for file in _files(NEAREST[module]):
        run = run_tests(folder, [file], 900.0, module)
        if not run.passed:
            raise SystemExit(f"{file} fails without a change: {run.failed} {run.error}")
        seconds |= run.seconds or {}
        found = run.lines or {}
        for test in run.seconds or {}:
            lines[test] = {*found.get(test, ()), *found.get("", ())}
        packages += run.packages
    for name in packages:
        try:
            importlib.import_module(name)
        except ImportError:  # it is loaded in each fork then
            continue
    return Nearest(lines, seconds, b"njit(" in (CHECKOUT / module).read_bytes())


def _killed_by(folder: Path, mutant: Mutant, tests: Nearest, wider: bool) -> str:
    """The first test that fails with a mutant; empty if none does."""
    near, first = tests.of(mutant.line), _files(NEAREST[mutant.module])[0]
    if tests.kernels:
        own = [each for each in near if each.startswith(first)]
        run = run_tests(folder, own, tests.limit(own), mutant.module, compiled=False)
        if not run.passed and run.error == "AssertionError":
            return run.failed
    run = run_tests(folder, near, tests.limit(near))
    # What a test made once, others of its file look at without running the line again.
    files = {each.split("::")[0] for each in near}
    rest = [each for each in tests.seconds if each not in near]
    if run.passed and (beside := [each for each in rest if each.split("::")[0] in files]):
        run = run_tests(folder, beside, tests.limit(beside))
    if run.passed and wider:
        run = run_tests(folder, [*rest, *_files(WIDER[mutant.module])], 1800.0)
    return "" if run.passed else run.failed


def main() -> None:
    """Draw mutants, run the tests on each, print a table and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--module", nargs="*", help="only of these modules")
    parser.add_argument("--wider", action="store_true", help="wider tests for survivors")
    parser.add_argument("--line", type=int, nargs="*", help="only of these lines")
    given = parser.parse_args()
    texts = {each: (CHECKOUT / each).read_bytes() for each in NEAREST}
    possible = {each: mutants_of(each, texts[each]) for each in NEAREST}
    share = given.count / sum(map(len, possible.values()))
    modules = given.module or list(NEAREST)
    count, killed, survivors = Counter[str](), Counter[str](), list[Mutant]()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "checkout"
        _copy(folder)
        for module in modules:
            every = possible[module]
            if given.line:
                chosen = [each for each in every if each.line in given.line]
            else:
                chosen = random.Random(f"{given.seed} {module}").sample(
                    every, round(share * len(every))
                )
            if not chosen:
                continue
            tests = nearest(folder, module)
            for mutant in sorted(chosen, key=lambda each: each.start):
                began = time.monotonic()
                (folder / module).write_bytes(mutant.applied(texts[module]))
                by = _killed_by(folder, mutant, tests, given.wider)
                count[module] += 1
                killed[module] += bool(by)
                survivors += [] if by else [mutant]
                print(
                    f"{module}:{mutant.line} {mutant.before[:60]!r} -> {mutant.after[:60]!r}:"
                    f" {f'killed by {by}' if by else 'survives'}"
                    f" ({time.monotonic() - began:.0f} s)",
                    flush=True,
                )
            (folder / module).write_bytes(texts[module])
    print(f"\n{'module':40s} mutants killed")
    for each in modules:
        print(f"{each:40s} {count[each]:7d} {killed[each]:6d}")
    print(f"{'all':40s} {sum(count.values()):7d} {sum(killed.values()):6d}")
    for mutant in survivors:
        print(f"survives: {mutant.module}:{mutant.line} {mutant.before!r} -> {mutant.after!r}")


if __name__ == "__main__":
    main()
