"""The code of a page of the documentation: what it is, and what it prints, shows and writes.

    python docs/tools/pages.py docs/gallery.md build/pages/gallery

runs the page in a folder with the samples and leaves there what it printed (`outputs.json`) and
wrote.
"""

from __future__ import annotations

import ast
import io
import json
import os
import re
import shlex
import sys
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from dataclasses import asdict, dataclass
from html import escape
from pathlib import Path
from typing import Any

EXECUTED = "<!-- executed -->\n"
"""First line of a page whose blocks are followed by what they print and show."""

COLUMNS = 110
"""Of what commands print on a page."""

_FENCE = re.compile(r"^```(python|sh)\n(.*?)^```\n", re.M | re.S)


@dataclass(frozen=True)
class Block:
    """Code on a page.

    Attributes
    ----------
    language : str
        ``python`` or ``sh``.
    code : str
    end : int
        Place in the page's text behind the block.
    """

    language: str
    code: str
    end: int


@dataclass(frozen=True)
class Output:
    """What a block printed, and the HTML form of the value of its last line."""

    printed: str = ""
    html: str = ""


def blocks_of(text: str) -> list[Block]:
    """Blocks of a page marked ``python`` or ``sh``, in order."""
    return [Block(found[1], found[2], found.end()) for found in _FENCE.finditer(text)]


def commands_of(block: Block) -> list[list[str]]:
    """Commands of a block, as words; a line that ends in a backslash goes on in the next."""
    lines = block.code.replace("\\\n", " ").splitlines()
    return [shlex.split(line, comments=True) for line in lines if line.strip()]


def execute(text: str) -> Iterator[Output]:
    """Run the blocks of a page one after the other in the current folder.

    Python blocks share their names. Commands run in this process, as users type them.

    Raises
    ------
    ValueError
        If a command is not trainlog's.
    RuntimeError
        If a command ends with another exit status than 0.
    """
    names: dict[str, Any] = {"__name__": "__main__"}
    for block in blocks_of(text):
        html = ""
        with _printed() as printed:
            try:
                if block.language == "python":
                    html = _run_python(block.code, names)
                else:
                    for words in commands_of(block):
                        _run_command(words)
            except Exception as error:
                error.add_note(f"in this block:\n{block.code}")
                raise
        yield Output(printed.getvalue().rstrip(), html)


@contextmanager
def _printed() -> Iterator[io.StringIO]:
    from trainlog.cli.terminal import console

    before, console.width = console.width, COLUMNS
    try:
        with redirect_stdout(io.StringIO()) as printed:
            yield printed
    finally:
        console.width = before


def _run_python(code: str, names: dict[str, Any]) -> str:
    """Run a block; the HTML form of its last line, where that is an expression."""
    tree = ast.parse(code)
    last = tree.body.pop() if tree.body and isinstance(tree.body[-1], ast.Expr) else None
    exec(compile(tree, "page", "exec"), names)
    if last is None:
        return ""
    value = eval(compile(ast.Expression(last.value), "page", "eval"), names)  # type: ignore[attr-defined]
    if value is None:
        return ""
    form = getattr(value, "_repr_html_", None)
    return form() if form is not None else f"<pre>{escape(repr(value))}</pre>"


def _run_command(words: list[str]) -> None:
    from trainlog.cli import main

    if words[0] != "trainlog":
        raise ValueError(f"{words[0]} is not trainlog")
    status = main.run(words[1:])
    if status:
        raise RuntimeError(f"{shlex.join(words)} ended with exit status {status}")


def with_outputs(text: str, outputs: list[Output]) -> str:
    """The page with what each block printed and showed behind it."""
    parts, begin = [], 0
    for block, output in zip(blocks_of(text), outputs, strict=True):
        parts.append(text[begin : block.end])
        shown = "".join(
            f"<pre>{escape(words)}</pre>" if words is output.printed else words
            for words in (output.printed, output.html)
            if words
        )
        if shown:
            # One HTML block: an empty line would end it.
            parts.append(
                "\n<div class='output'>" + shown.replace("\n\n", "\n&#8203;\n") + "</div>\n"
            )
        begin = block.end
    return "".join([*parts, text[begin:]])


def main(page: Path, folder: Path) -> None:
    """Run a page in a folder and keep its outputs there."""
    from trainlog.formats.samples import copy_samples

    text = page.read_text("utf-8")
    folder.mkdir(parents=True, exist_ok=True)
    copy_samples(folder / "sample_logs")
    os.chdir(folder)
    outputs = [asdict(output) for output in execute(text)]
    Path("outputs.json").write_text(json.dumps(outputs), "utf-8")


if __name__ == "__main__":
    main(Path(sys.argv[1]).resolve(), Path(sys.argv[2]))
