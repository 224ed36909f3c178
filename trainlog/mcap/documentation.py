"""The table of topics as the page on the log shows it."""

from __future__ import annotations

from trainlog.topics import TOPICS, Topic


def topics_table() -> str:
    """Every topic with its fields, units, meanings and interpolation, as Markdown."""
    return "\n".join(_section(topic) for topic in TOPICS.values())


def _section(topic: Topic) -> str:
    rows = [
        f"### `{topic.name}`",
        "",
        f"{topic.meaning} Message `{topic.message}`.",
        "",
        "| field | unit | meaning | between samples |",
        "|---|---|---|---|",
    ]
    for field in topic.fields:
        name = f"`{field.name}`, one for each {field.each}" if field.each else f"`{field.name}`"
        meaning = field.meaning.replace("|", "\\|")
        rows.append(f"| {name} | {field.unit or '–'} | {meaning} | {field.interpolation} |")
    return "\n".join(rows) + "\n"
