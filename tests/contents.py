"""Files that tests write."""

from collections.abc import Sequence
from pathlib import Path


def put(path: Path, content: bytes | str | Sequence[str]) -> Path:
    """The path, at which there is now this content: bytes, a text, or lines."""
    if not isinstance(content, bytes | str):
        content = "".join(f"{line}\n" for line in content)
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return path
