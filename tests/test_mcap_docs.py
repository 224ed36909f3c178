"""The page on the log says what the code does."""

from __future__ import annotations

import sys
from pathlib import Path

from trainlog.topics import TOPICS

DOCS = Path(__file__).parents[1] / "docs"
sys.path.insert(0, str(DOCS / "tools"))

from topic_table import topics_table, with_topics  # noqa: E402


def test_the_page_ends_with_todays_table_of_topics() -> None:
    page = (DOCS / "log.md").read_text("utf-8")
    assert page == with_topics(page), "run docs/tools/topic_table.py docs/log.md"


def test_the_table_names_every_field_once() -> None:
    table = topics_table()
    fields = sum(len(topic.fields) for topic in TOPICS.values())
    assert table.count("\n| `") == fields
    assert table.count("### `/") == len(TOPICS)
