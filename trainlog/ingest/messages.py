"""What the readers of receivers' messages share: optional parsers, damaged messages, many kinds."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

import numpy as np

from trainlog.errors import InputError
from trainlog.ingest.recording import SHOWN_ROWS, Finding, Raw

MAX_DAMAGED = 0.5
"""Share of messages that cannot be read beyond which it is another kind of file."""


def extra(module: str) -> Any:
    """A parser library that only the extra ``recorders`` brings.

    Raises
    ------
    InputError
        If it is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        raise InputError(
            f"needs the package {module}, which is not installed",
            remedy='pip install "trainlog[recorders]"',
        ) from error


@dataclass
class Messages:
    """Messages as they are read: which are damaged, which are of no use, and how many there are.

    Attributes
    ----------
    read : int
        All messages.
    others : Counter
        Messages of kinds that say nothing of the trip, by name.
    """

    read: int = 0
    others: Counter[str] = field(default_factory=Counter)
    damaged_rows: list[int] = field(default_factory=list)
    damaged_text: list[str] = field(default_factory=list)

    def damaged(self, row: int, text: str) -> None:
        """Count a message that cannot be read."""
        self.damaged_rows.append(int(row))
        self.damaged_text.append(text)

    def findings(self) -> tuple[Finding, ...]:
        """The finding that messages are damaged; none if there are none.

        Raises
        ------
        InputError
            If most of them are.
        """
        count = len(self.damaged_rows)
        if not count:
            return ()
        if count > MAX_DAMAGED * self.read:
            raise InputError(
                f"{count} of {self.read} messages are damaged",
                place=f"row {self.damaged_rows[0]}",
                remedy="copy the file again; is it of this format?",
            )
        rows = tuple(sorted(self.damaged_rows)[:SHOWN_ROWS])
        return (Finding("damaged_messages", count, rows),)

    def raw(self) -> tuple[Raw, ...]:
        """The damaged messages as they stood in the file."""
        if not self.damaged_rows:
            return ()
        rows: Sequence[int] = self.damaged_rows
        text = np.array(self.damaged_text, dtype=np.object_)
        return (Raw("damaged_messages", "", np.array(rows, dtype=np.int64), text),)
