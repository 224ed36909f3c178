"""How large the code is, and how much of it a command executes.

    python benchmarks/structure/benchmark_structure.py

Prints modules and code lines (without docstrings, comments and blanks) by folder, the public names,
and for each command the modules and functions of the three packages that it executes once its
kernels are compiled. ``--checkout`` measures another checkout, for a comparison.
"""

from __future__ import annotations

import argparse
import ast
import io
import json
import os
import subprocess
import sys
import tempfile
import tokenize
from collections import Counter
from pathlib import Path

from rich.console import Console
from rich.table import Table

CHECKOUT = Path(__file__).resolve().parents[2]
PACKAGES = ("trainlog", "analysis", "estimators")

LAYOUT = {
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
}
"""Tokens that are not code."""

PRELUDE = """
import json, sys
seen = set()
def profile(frame, event, _):
    if event == "call":
        code = frame.f_code
        file = code.co_filename
        for package in ("trainlog", "analysis", "estimators"):
            if f"/{package}/" in file and "site-packages" not in file:
                if code.co_name != "<module>" and not code.co_name.startswith("<"):
                    seen.add((file, code.co_qualname, code.co_firstlineno))
                return
"""

READ = """
import trainlog
log = "sample_logs/stopping.mcap"
trainlog.read(log)
sys.setprofile(profile)
trainlog.read(log)
sys.setprofile(None)
"""

COMMAND = """
from trainlog.cli.main import run
run({words})
sys.setprofile(profile)
run({words})
sys.setprofile(None)
"""

REPORT = """
print(json.dumps([len({file for file, *_ in seen}), len(seen)]), file=sys.stderr)
"""

COMMANDS = {
    "fit": ["fit", "sample_logs/stopping.mcap", "-o", "{folder}/fit.json"],
    "slip and map update": [
        "map",
        "update",
        "sample_logs/stopping.mcap",
        "--map",
        "{folder}/m.map",
    ],
    "optimise": [
        *("plan", "{folder}/fit.json", "--line", "sample", "--train", "sample"),
        *("-o", "{folder}/trajectory.json"),
    ],
    "replay": ["replay", "sample_logs/stopping.mcap", "-o", "{folder}/r.rrd"],
}


def code_lines(source: str) -> int:
    """Lines with code: no docstrings, comments or blanks."""
    lines: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(source).readline):
        if token.type not in LAYOUT:
            lines.update(range(token.start[0], token.end[0] + 1))
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
            node
        ):
            first = node.body[0]
            lines.difference_update(range(first.lineno, (first.end_lineno or 0) + 1))
    return len(lines)


def sizes(checkout: Path) -> Table:
    """Modules and code lines by folder."""
    modules, code = Counter[str](), Counter[str]()
    for package in PACKAGES:
        for path in sorted((checkout / package).rglob("*.py")):
            parts = path.relative_to(checkout).parts
            for key in ("/".join(parts[: min(2, len(parts) - 1)]), f"{package}, all", "all"):
                modules[key] += 1
                code[key] += code_lines(path.read_text("utf-8"))
    table = Table("folder", "modules", "code lines")
    for key in sorted(modules):
        table.add_row(key, str(modules[key]), f"{code[key]:,}")
    return table


def executed(checkout: Path, program: str) -> tuple[int, int]:
    """Modules and functions of the packages that a program executes where it is profiled."""
    environment = {**os.environ, "PYTHONPATH": str(checkout)}
    ended = subprocess.run(
        [sys.executable, "-c", PRELUDE + program + REPORT],
        cwd=checkout,
        env=environment,
        capture_output=True,
        text=True,
        check=True,
    )
    modules, functions = json.loads(ended.stderr.strip().splitlines()[-1])
    return modules, functions


def main(checkout: Path, cli: str) -> None:
    """Print the tables."""
    console = Console(width=100)
    console.print(sizes(checkout))
    table = Table("what", "modules executed", "functions executed")
    table.add_row("read", *map(str, executed(checkout, READ)))
    with tempfile.TemporaryDirectory() as folder:
        for name, words in COMMANDS.items():
            given = [word.format(folder=folder) for word in words]
            program = COMMAND.format(words=given).replace("trainlog.cli.main", cli)
            table.add_row(name, *map(str, executed(checkout, program)))
    console.print(table)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--checkout", type=Path, default=CHECKOUT)
    parser.add_argument("--cli", default="trainlog.cli.main", help="Module with the function run.")
    arguments = parser.parse_args()
    main(arguments.checkout, arguments.cli)
