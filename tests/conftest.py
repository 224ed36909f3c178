"""Settings of the tests, and what their command line adds."""

from __future__ import annotations

import pytest
from hypothesis import settings

# A slow machine, or a first call that compiles, is no failure.
settings.register_profile("trainlog", deadline=None)
settings.load_profile("trainlog")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--renew-golden",
        action="store_true",
        help="write what the golden replays give now as their references; review the difference",
    )
