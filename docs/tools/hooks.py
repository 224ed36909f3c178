"""Hooks of MkDocs: runs the pages that show what their code prints, and adds files of the checkout.

A page that begins with `pages.EXECUTED` is run in `build/pages`, once for each state of its
text and the code; pictures that it names and that its code writes become files of the site.
"""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from hashlib import sha256
from pathlib import Path
from posixpath import dirname, normpath, relpath
from shutil import rmtree
from typing import Any

from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files

CHECKOUT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(CHECKOUT), str(Path(__file__).parent)]

import pages  # noqa: E402
from sources import ADDED, STAMP, state_of  # noqa: E402

BUILT = CHECKOUT / "build" / "pages"
PACKAGES = ("trainlog", "analysis", "estimators")

_LINK = re.compile(r"(\]\()([^)#\s]+)((?:#[^)\s]*)?\))")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages that stand elsewhere, the files linked to, and what executed pages write."""
    for uri, path in ADDED.items():
        files.append(File.generated(config, uri, abs_src_path=str(CHECKOUT / path)))
    texts = {
        file.src_uri: Path(file.abs_src_path or "").read_text("utf-8")
        for file in files.documentation_pages()
    }
    _execute([uri for uri, text in texts.items() if text.startswith(pages.EXECUTED)])
    for uri, text in texts.items():
        for target in _targets(text):
            _add(files, config, uri, target)
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Files) -> str:  # noqa: ARG001
    """Put outputs behind the blocks of an executed page, and lead links to where files are."""
    uri = page.file.src_uri
    if markdown.startswith(pages.EXECUTED):
        kept = json.loads((_folder(uri) / "outputs.json").read_text("utf-8"))
        markdown = pages.with_outputs(markdown, [pages.Output(**each) for each in kept])
    return _LINK.sub(lambda found: found[1] + _lead(uri, found[2]) + found[3], markdown)


def on_post_build(config: Any) -> None:
    """State in the site what it was made of."""
    Path(config.site_dir, STAMP).write_text(state_of(CHECKOUT), "utf-8")


def _targets(text: str) -> list[str]:
    return [found[2] for found in _LINK.finditer(text) if "://" not in found[2]]


def _execute(uris: list[str]) -> None:
    """Run pages, two at a time, where their text or the code changed since they last ran."""
    code = sha256()
    for package in (*PACKAGES, "sample_logs"):
        for path in sorted((CHECKOUT / package).rglob("*")):
            if path.is_file() and path.suffix != ".pyc" and path.suffix not in (".nbi", ".nbc"):
                code.update(path.relative_to(CHECKOUT).as_posix().encode())
                code.update(path.read_bytes())
    code.update(Path(pages.__file__).read_bytes())

    def run(uri: str) -> str:
        text = (CHECKOUT / "docs" / uri).read_bytes()
        state = sha256(text + code.digest()).hexdigest()
        folder = _folder(uri)
        kept = folder / "state"
        if kept.exists() and kept.read_text("utf-8") == state:
            return ""
        rmtree(folder, ignore_errors=True)
        words = [sys.executable, pages.__file__, str(CHECKOUT / "docs" / uri), str(folder)]
        paths = os.pathsep.join(filter(None, (str(CHECKOUT), os.environ.get("PYTHONPATH"))))
        environment = {**os.environ, "PYTHONPATH": paths, "MPLBACKEND": "agg"}
        ended = subprocess.run(words, capture_output=True, text=True, env=environment)
        if ended.returncode:
            return f"{uri}: {ended.stdout}{ended.stderr}"
        kept.write_text(state, "utf-8")
        return ""

    with ThreadPoolExecutor(2) as pool:
        failed = [words for words in pool.map(run, uris) if words]
    if failed:
        raise PluginError("\n".join(failed))


def _folder(uri: str) -> Path:
    return BUILT / uri.removesuffix(".md").replace("/", "-")


def _add(files: Files, config: Any, uri: str, target: str) -> None:
    """Add the file that a page links to, where its code wrote it or the checkout holds it."""
    led = _lead(uri, target)
    place = normpath(f"{dirname(uri)}/{led}" if dirname(uri) else led)
    if files.get_file_from_path(place) is not None:
        return
    written, kept = _folder(uri) / target, _checkout_path(uri, target)
    if written.is_file():
        files.append(File.generated(config, place, abs_src_path=str(written)))
    elif led != target and kept is not None and kept.is_file():
        files.append(File.generated(config, place, content=kept.read_text("utf-8")))


def _checkout_path(uri: str, target: str) -> Path | None:
    """The file that a link means, if it is outside of the documentation."""
    base = CHECKOUT / "docs" / dirname(uri) if uri not in ADDED else (CHECKOUT / ADDED[uri]).parent
    return (base / target).resolve() if "://" not in target else None


def _lead(uri: str, target: str) -> str:
    """Where a link leads to on the site: a page, or the copy of a file of the checkout."""
    path = _checkout_path(uri, target)
    if path is None or not path.is_relative_to(CHECKOUT) or not path.is_file():
        return target
    name = path.relative_to(CHECKOUT).as_posix()
    known = {value: key for key, value in ADDED.items()} | {"README.md": "index.md"}
    if name in known:
        place = known[name]
    elif name.startswith("docs/"):
        place = name.removeprefix("docs/")
    else:
        place = f"source/{name}.txt"
    return relpath(place, dirname(uri) or ".")
