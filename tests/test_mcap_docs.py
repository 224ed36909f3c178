"""The page on the log says what the code does."""

from __future__ import annotations

from pathlib import Path

import pytest

from trainlog.mcap.description import topics_table
from trainlog.topics import TOPICS

PAGE = Path(__file__).parents[1] / "docs" / "log.md"


def test_the_page_ends_with_todays_table_of_topics(request: pytest.FixtureRequest) -> None:
    before, mark, table = PAGE.read_text("utf-8").partition("topics_table() -->\n\n")
    if request.config.getoption("--renew-golden"):
        PAGE.write_text(before + mark + topics_table(), "utf-8")
    else:
        assert table == topics_table()


def test_the_table_names_every_field_once() -> None:
    table = topics_table()
    fields = sum(len(topic.fields) for topic in TOPICS.values())
    assert table.count("\n| `") == fields
    assert table.count("### `/") == len(TOPICS)
