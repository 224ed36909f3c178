"""The topics of a log and their fields, listed on its page: made from the table of topics.

python docs/tools/topic_table.py docs/log.md
"""

from __future__ import annotations

import math
import sys
from pathlib import Path

from trainlog.topics import TOPICS, Bounds, Field, Topic
from trainlog.units import factor

MARK = "<!-- made by docs/tools/topic_table.py -->\n\n"


def with_topics(page: str) -> str:
    """A page that ends with the table of topics."""
    return page.partition(MARK)[0] + MARK + topics_table()


def topics_table() -> str:
    """Every topic with its fields, units, meanings, interpolation and limits, as Markdown."""
    return "\n".join(_section(topic) for topic in TOPICS.values())


def _section(topic: Topic) -> str:
    rows = [
        f"### `{topic.name}`",
        "",
        f"{topic.meaning} Message `{topic.message}`.",
        "",
        "| field | unit | meaning |",
        "|---|---|---|",
    ]
    limited = any(item.bounds != Bounds() for item in topic.fields)
    if limited:
        rows[-2] += " limits |"
        rows[-1] += "---|"
    for item in topic.fields:
        name = f"`{item.name}`, per {item.each}" if item.each else f"`{item.name}`"
        if item.interpolation != "linear":
            name += f" ({item.interpolation})"
        meaning = item.meaning.replace("|", "\\|")
        row = f"| {name} | {item.unit or '–'} | {meaning} |"
        rows.append(f"{row} {_limits(item)} |" if limited else row)
    return "\n".join(rows) + "\n"


def _limits(item: Field) -> str:
    """What a recorded value can be, in its usual unit."""
    if item.bounds == Bounds():
        return ""
    unit, bounds = item.usual_unit, item.bounds
    slope, offset = factor(unit, item.unit)
    low, high = (f"{(each - offset) / slope:g}" for each in (bounds.low, bounds.high))
    shown = "" if unit == "1" else f" {unit}"
    text = f"{low} to {high}{shown}"
    if math.isfinite(bounds.rate):
        text += (
            f"; {bounds.rate / slope:g}{shown} per second over {bounds.tolerance / slope:g}{shown}"
        )
    return text


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]):
        path.write_text(with_topics(path.read_text("utf-8")), "utf-8")
