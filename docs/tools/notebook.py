"""The developer's tutorial as a notebook: prose and Python blocks as cells, without outputs.

python docs/tools/notebook.py docs/tutorials/developer.md developer.ipynb
"""

from __future__ import annotations

import json
import re
import sys
from hashlib import sha256
from pathlib import Path
from typing import Any

_PARTS = re.compile(r"^```python\n(.*?)^```\n", re.M | re.S)
_FIRST = re.compile(r"\A<!--.*?-->\n")
_PICTURE = re.compile(r"^!\[[^\]]*\]\([^)]*\)\n", re.M)
_LINK = re.compile(r"\[([^\]]*)\]\((?!https?:)[^)]*\)")


def from_page(text: str) -> dict[str, Any]:
    """A notebook (nbformat 4.5) of a page; the same page, the same notebook."""
    text = _FIRST.sub("", text)
    cells: list[dict[str, Any]] = []
    for number, part in enumerate(_PARTS.split(text)):
        # Pictures are made by the cells; the pages that it refers to are not beside a notebook.
        source = (part if number % 2 else _LINK.sub(r"\1", _PICTURE.sub("", part))).strip("\n")
        if not source.strip():
            continue
        cell: dict[str, Any] = {
            "cell_type": "code" if number % 2 else "markdown",
            "id": sha256(f"{len(cells)} {source}".encode()).hexdigest()[:8],
            "metadata": {},
            "source": source.splitlines(keepends=True),
        }
        if number % 2:
            cell |= {"execution_count": None, "outputs": []}
        cells.append(cell)
    kernel = {"display_name": "Python 3", "language": "python", "name": "python3"}
    metadata = {"kernelspec": kernel, "language_info": {"name": "python"}}
    return {"cells": cells, "metadata": metadata, "nbformat": 4, "nbformat_minor": 5}


def written(notebook: dict[str, Any]) -> str:
    """The text of a notebook's file."""
    return json.dumps(notebook, indent=1, ensure_ascii=False) + "\n"


if __name__ == "__main__":
    page, target = map(Path, sys.argv[1:])
    target.write_text(written(from_page(page.read_text("utf-8"))), "utf-8")
