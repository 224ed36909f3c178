"""docs/formats.md names every key of every format."""

from __future__ import annotations

import sqlite3
from dataclasses import fields
from pathlib import Path

import pytest

from trainlog.declaration import Declared, entries
from trainlog.formats.railway import CoastDownResult, DragCurve, Identified
from trainlog.formats.samples import sample
from trainlog.railway.evidence import DailyEvidence
from trainlog.railway.line import Geometry, Line, LineReference, Survey
from trainlog.railway.network import Edge, Network
from trainlog.railway.resistance import RunningResistance
from trainlog.railway.train import (
    BRAKING_PARAMETERS,
    AxleGeometry,
    Axles,
    Brake,
    BrakingCurves,
    Configuration,
    Consist,
    ConsistBrake,
    Coupler,
    ParameterSet,
    Train,
    Vehicle,
)
from trainlog.railway.trajectory import Journey, Trajectory

TEXT = (Path(__file__).parents[1] / "docs" / "formats.md").read_text("utf-8")
SECTIONS: list[tuple[str, tuple[type, ...]]] = [
    ("## Line", (Line, Survey, Geometry, LineReference)),
    ("## Network", (Network, Edge)),
    ("## Train", (Train, Axles, AxleGeometry, Brake, BrakingCurves)),
    ("## Consist", (Consist, ConsistBrake, Vehicle, Coupler)),
    ("## Journey", (Journey,)),
    ("## Parameters", (ParameterSet, Configuration, RunningResistance)),
    ("## Trajectory", (Trajectory,)),
    ("## Coast-down", (CoastDownResult, Identified, DragCurve)),
]


@pytest.mark.parametrize(("title", "models"), SECTIONS, ids=[title for title, _ in SECTIONS])
def test_every_key_is_described(title, models):
    section = TEXT.split(f"{title}\n")[1].split("\n## ")[0]
    for model in models:
        for entry in entries(model):
            assert f"`{entry.key}`" in section, entry.key
            if issubclass(model, Declared) and model.FORMAT:
                assert (f"*`{entry.key}`*" in section) is not entry.required, entry.key
    if title == "## Train":
        assert all(f"`{name}`" in section for name in BRAKING_PARAMETERS)


def test_every_format_is_in_the_list():
    for _, (model, *_others) in SECTIONS:
        assert issubclass(model, Declared)
        assert f"`{model.FORMAT}`" in TEXT
        assert (2 if model.FORMAT in ("trainlog/line", "trainlog/network") else 1) == model.VERSION


def test_every_table_and_column_of_a_map_is_described():
    section = TEXT.split("## Track-condition map\n")[1].split("\n## ")[0]
    database = sqlite3.connect(sample("CH_StGallen_Wil.map"))
    tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'").fetchall()
    assert len(tables) == 6
    for (table,) in tables:
        assert f"`{table}`" in section, table
        for _, column, *_others in database.execute(f"PRAGMA table_info({table})"):
            assert f"`{column}`" in section, (table, column)
    for (key,) in database.execute("SELECT key FROM header"):
        assert f"`{key}`" in section, key
    for name in (each.name for each in fields(DailyEvidence)):
        assert f"`{name}`" in section, name
