"""Maps in the bytes of their files."""

import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from trainlog.formats.mapfile import MapFile
from trainlog.railway import TrackConditionMap


@contextmanager
def opened(data: bytes, name: str = "track.map") -> Iterator[MapFile]:
    """The map file of these bytes, which is written for it."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / name
        path.write_bytes(data)
        with MapFile(path) as file:
            yield file


def map_from_bytes(data: bytes) -> TrackConditionMap:
    with opened(data) as file:
        return file.read()
