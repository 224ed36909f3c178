"""Figures that are made but not painted, which takes half a second each."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest


@contextmanager
def without_painting() -> Iterator[None]:
    """Figures are written as the beginning of a file of their kind."""
    from matplotlib.figure import Figure

    def written(_: Figure, path: Path, format: str = "png", **__: object) -> None:
        path.write_bytes(b"<svg></svg>" if format == "svg" else b"\x89PNG\r\n\x1a\n")

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(Figure, "savefig", written)
        yield
