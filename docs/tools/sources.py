"""What the documentation's site is made of, and whether a built one is of today's files."""

from __future__ import annotations

from hashlib import sha256
from pathlib import Path

STAMP = "sources.sha256"
"""File of a site that states what it was made of."""

ADDED = {
    "contributing.md": "CONTRIBUTING.md",
    "changes.md": "CHANGELOG.md",
    "samples.md": "sample_logs/README.md",
}
"""Pages that stand elsewhere in the checkout."""

_FOLDERS = ("docs", "trainlog", "analysis", "estimators", "sample_logs")
_FILES = ("mkdocs.yml", "CHANGELOG.md", "CONTRIBUTING.md")
_LEFT_OUT = ("__pycache__", "sample_logs", "documentation_pages")


def sources(checkout: Path) -> list[Path]:
    """Files that the site depends on, in order."""
    found = [checkout / name for name in _FILES]
    for folder in _FOLDERS:
        for path in sorted((checkout / folder).rglob("*")):
            inner = path.relative_to(checkout / folder).parts
            if path.is_file() and not set(inner) & set(_LEFT_OUT):
                found.append(path)
    return found


def state_of(checkout: Path) -> str:
    """SHA-256 of all sources, with their names."""
    state = sha256()
    for path in sources(checkout):
        state.update(path.relative_to(checkout).as_posix().encode())
        state.update(sha256(path.read_bytes()).digest())
    return state.hexdigest()


def site_of(checkout: Path) -> Path | None:
    """The built site, if it was made of the files as they are now."""
    site = checkout / "build" / "site"
    stamp = site / STAMP
    if stamp.is_file() and stamp.read_text("utf-8") == state_of(checkout):
        return site
    return None
