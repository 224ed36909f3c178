"""How many random faults of the numerics the tests find.

    python benchmarks/structure/benchmark_mutants.py --count 200 --seed 1

A mutant is a copy of the checkout in which one operator, comparison, number or statement of one
module is another one; it is killed if the tests nearest to that module fail. Those that survive are
listed with their place, and go through the wider tests where ``--wider`` asks for it: some are
equivalent to the original, the others show which behaviour no test asks for.
"""

from __future__ import annotations

import argparse
import ast
import os
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

CHECKOUT = Path(__file__).resolve().parents[2]

NEAREST = {
    "analysis/resistance/regression.py": "resistance_windows resistance_fit passport coast_down",
    "estimators/rls.py": "rls resets estimators resistance_windows",
    "estimators/condition_passes.py": "condition_passes condition_field traction_map",
    "trainlog/catalogue/registration.py": "identity catalogue catalogue_versions",
    "trainlog/formats/mapfile.py": "map_file merge map_service map_views",
    "analysis/trajectory/audit.py": "trajectory_audit trajectory_certificate trajectory_answers",
    "analysis/trajectory/bound.py": "trajectory_certificate trajectory_random",
    "trainlog/ingest/clock.py": "ingest_time ingest_trips ingest_repair ingest live",
}
"""Modules, and the tests that a fault in them should fail, the quickest first."""

WIDER = {
    "analysis/resistance/regression.py": "resistance_together resistance_diagnostics calculated"
    " golden tunnels",
    "estimators/rls.py": "study_rls_sliding_mode resistance_fit golden",
    "estimators/condition_passes.py": "map_views map_difference traction_map_figures golden",
    "trainlog/catalogue/registration.py": "fleet_update results catalogue_sql",
    "trainlog/formats/mapfile.py": "network_maps traction_map formats_samples golden",
    "analysis/trajectory/audit.py": "trajectory_many trajectory_limits trajectory_curves",
    "analysis/trajectory/bound.py": "trajectory_answers trajectory_curves trajectory_many",
    "trainlog/ingest/clock.py": "ingest_recorders ingest_formats golden",
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

WAIT = 900.0
"""Most that the tests of one mutant may take [s]: one that never ends is killed."""


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
        if isinstance(node, ast.FunctionDef):
            for each in [*node.body, *node.args.defaults]:
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
    """The checkout's files, as they are now, in another folder."""
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=CHECKOUT, capture_output=True, check=True
    ).stdout.decode()
    for name in filter(None, listed.split("\0")):
        source, target = CHECKOUT / name, folder / name
        if source.is_file():
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes(source.read_bytes())
    shared = CHECKOUT.parent / "shared"
    if shared.exists():
        (folder.parent / "shared").symlink_to(shared)


def _passes(folder: Path, tests: str) -> tuple[bool, str]:
    """Whether tests pass in a copy, and the first that fails."""
    files = [f"tests/test_{each}.py" for each in tests.split()]
    environment = {**os.environ, "PYTHONPATH": str(folder)}
    environment.pop("PYTHONDONTWRITEBYTECODE", None)
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", *files]
    try:
        ended = subprocess.run(
            command, cwd=folder, env=environment, capture_output=True, text=True, timeout=WAIT
        )
    except subprocess.TimeoutExpired:
        return False, "not ended"
    failed = [line for line in ended.stdout.splitlines() if line.startswith(("FAILED", "ERROR"))]
    return ended.returncode == 0, (failed[0].split(" - ")[0] if failed else "")


def main() -> None:
    """Draw mutants, run the tests on each, print a table and the survivors."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--count", type=int, default=200)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--module", help="only of this module")
    parser.add_argument("--wider", action="store_true", help="wider tests for survivors")
    parser.add_argument("--line", type=int, help="only of this line")
    given = parser.parse_args()
    modules = [given.module] if given.module else list(NEAREST)
    texts = {each: (CHECKOUT / each).read_bytes() for each in modules}
    possible = [mutant for each in modules for mutant in mutants_of(each, texts[each])]
    if given.line:
        possible = [each for each in possible if each.line == given.line]
    drawn = random.Random(given.seed).sample(possible, min(given.count, len(possible)))
    count, killed, survivors = Counter[str](), Counter[str](), list[Mutant]()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary) / "checkout"
        _copy(folder)
        for each in modules:
            passed, first = _passes(folder, NEAREST[each])
            if not passed:
                raise SystemExit(f"the tests of {each} fail without a change: {first}")
        for number, mutant in enumerate(drawn, 1):
            began = time.monotonic()
            text = mutant.applied(texts[mutant.module])
            (folder / mutant.module).write_bytes(text)
            passed, first = _passes(folder, NEAREST[mutant.module])
            if passed and given.wider:
                passed, first = _passes(folder, WIDER[mutant.module])
            (folder / mutant.module).write_bytes(texts[mutant.module])
            count[mutant.module] += 1
            killed[mutant.module] += not passed
            survivors += [mutant] if passed else []
            state = "survives" if passed else f"killed by {first}"
            print(
                f"{number:4d} {mutant.module}:{mutant.line} {mutant.before[:60]!r} ->"
                f" {mutant.after[:60]!r}: {state} ({time.monotonic() - began:.0f} s)",
                flush=True,
            )
    print(f"\n{'module':40s} mutants killed")
    for each in modules:
        print(f"{each:40s} {count[each]:7d} {killed[each]:6d}")
    print(f"{'all':40s} {sum(count.values()):7d} {sum(killed.values()):6d}")
    for mutant in survivors:
        print(f"survives: {mutant.module}:{mutant.line} {mutant.before!r} -> {mutant.after!r}")


if __name__ == "__main__":
    main()
