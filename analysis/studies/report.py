"""What the studies share: a run as a trip, and tables that are printed and written as Markdown."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from analysis.charts import Chart, draw_all
from trainlog import __version__
from trainlog.arrays import FloatArray
from trainlog.formats.files import atomic_write, made_folder, sha256
from trainlog.formats.railway import line_to_bytes
from trainlog.mcap import write_log
from trainlog.presentation import WordTable
from trainlog.progress import track
from trainlog.railway import Line
from trainlog.topics import EVENTS, Topic
from trainlog.trip import LINE_ATTACHMENT, Trip, frame_of
from trainlog.units import NANOSECONDS

if TYPE_CHECKING:
    from rich.console import Console

Item = TypeVar("Item")

START = 1_735_689_600 * 10**9
"""When the runs begin [ns]: 2025-01-01, so that the same run gives the same bytes."""

INFO = 2
"""Level of an event, see `trainlog.topics.EVENTS`."""

TABLES = "tables.md"
"""All tables of a study, in its folder."""


@dataclass
class StudyReport:
    """Shows how far a study is and what it found, and keeps what it wrote.

    Attributes
    ----------
    folder : Path
        Where logs, pictures and tables go; made if need be.
    console : rich.console.Console
        That tables and sentences are printed on.
    files : list of Path
        That were written.
    """

    folder: Path
    console: Console
    files: list[Path] = field(default_factory=list)
    _parts: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        made_folder(self.folder)

    def track(self, items: Iterable[Item], description: str) -> Iterator[Item]:
        """The items one by one, with a bar that shows how many are done."""
        yield from track(list(items), description, "run")

    def show(self, *parts: WordTable | str) -> None:
        """Print tables and sentences, and write all so far to `TABLES`.

        A table takes the place of an earlier one of the same title, which it continues.
        """
        for part in parts:
            self.console.print(part, highlight=False)
            if isinstance(part, WordTable):
                self._parts[str(part.title)] = as_markdown(part)
            else:
                self._parts[part] = f"{part}\n"
        path = self.folder / TABLES
        with atomic_write(path) as temporary:
            temporary.write_text("\n".join(self._parts.values()), encoding="utf-8")
        self.keep(path)

    def log(self, trip: Trip, name: str = "") -> Path:
        """Write a trip under a name, by default its own."""
        path = self.folder / f"{name or trip.metadata['trip']}.mcap"
        write_log(trip, path)
        self.keep(path)
        return path

    def draw(self, pictures: Mapping[str, Sequence[Chart]]) -> None:
        """Draw charts, by the names of the pictures' files."""
        self.keep(*draw_all(pictures, self.folder))

    def keep(self, *paths: Path) -> None:
        """Count files as written by the study."""
        self.files += [path for path in paths if path not in self.files]


def as_markdown(table: WordTable) -> str:
    """A table in Markdown, its title in bold above it.

    Examples
    --------
    >>> from trainlog.presentation import new_table
    >>> table = new_table("Speeds", "train", "km/h")
    >>> table.add_row("A", "80.0")
    >>> print(as_markdown(table))
    **Speeds**
    <BLANKLINE>
    | train | km/h |
    |---|---|
    | A | 80.0 |
    <BLANKLINE>
    """
    rows = [table.heads, *table.words]
    lines = [f"| {' | '.join(' '.join(cell.split()) for cell in row)} |" for row in rows]
    lines.insert(1, "|" + "---|" * len(table.heads))
    return "\n".join([f"**{' '.join(str(table.title).split())}**", "", *lines, ""])


def study_trip(
    name: str,
    train: str,
    line: Line,
    time: FloatArray,
    topics: Mapping[Topic, Mapping[str, ArrayLike]],
    step: tuple[str, Mapping[str, Any]],
    *,
    attachments: Mapping[str, bytes],
    metadata: Mapping[str, str] | None = None,
    events: Sequence[tuple[float, str, str]] = (),
) -> Trip:
    """The trip of a simulated run.

    Parameters
    ----------
    name, train : str
    line : Line
    time : (n,) array [s]
    topics : mapping of Topic to mapping of str to array_like
        Fields of each; a single value holds throughout.
    step : (str, mapping)
        The command that made it and its settings, for the provenance.
    attachments : mapping of str to bytes
        Besides the line.
    metadata : mapping of str to str, optional
        Beyond what every run has.
    events : sequence of (float, str, str)
        Time [s], message, and who says so.
    """
    everything = {LINE_ATTACHMENT: line_to_bytes(line), **attachments}
    facts = {
        "trip": name,
        "train": train,
        "line": line.name,
        "direction": "forward",
        "clock": "UTC, simulated",
        "start": "2025-01-01T00:00:00+00:00",
        "software": f"trainlog {__version__}",
    }
    frames = {topic.name: _frame(topic, time, fields) for topic, fields in topics.items()}
    if events:
        when, messages, names = (np.array(each) for each in zip(*events, strict=True))
        words = {"message": messages.astype(object), "name": names.astype(object)}
        frames[EVENTS.name] = _frame(EVENTS, when, {"level": INFO, **words})
    command, settings = step
    return Trip(frames, facts | dict(metadata or {}), (), everything).with_step(
        command,
        software=f"trainlog {__version__}",
        **settings,
        inputs={key: sha256(data) for key, data in everything.items()},
    )


def _frame(topic: Topic, time: FloatArray, fields: Mapping[str, ArrayLike]) -> pd.DataFrame:
    values = {
        key: value if np.ndim(value) else np.full(time.size, value) for key, value in fields.items()
    }
    return frame_of(topic, START + np.round(time * NANOSECONDS).astype(np.int64), values)
