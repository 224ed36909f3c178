"""docs/formats.md names every key of every format."""

from __future__ import annotations

import sqlite3
from dataclasses import fields
from pathlib import Path

import pytest
from pydantic import BaseModel

from trainlog.formats.line import _JourneyFile
from trainlog.formats.linefile import LineFile, _Geometry, _Reference
from trainlog.formats.network import _Edge, _NetworkFile
from trainlog.formats.parameters import (
    ConfigurationPart,
    ResistancePart,
    _CoastDownFile,
    _CurvePart,
    _ParametersFile,
    _QuantityPart,
)
from trainlog.formats.samples import sample
from trainlog.formats.schema import File
from trainlog.formats.train import (
    BRAKING_PARAMETERS,
    _Axles,
    _Brake,
    _BrakingCurves,
    _ConsistBrake,
    _ConsistFile,
    _Coupler,
    _TrainFile,
    _Vehicle,
)
from trainlog.formats.trajectory import _TrajectoryFile
from trainlog.railway.evidence import DailyEvidence

TEXT = (Path(__file__).parents[1] / "docs" / "formats.md").read_text("utf-8")
SECTIONS: list[tuple[str, tuple[type[BaseModel], ...]]] = [
    ("## Line", (LineFile, _Geometry, _Reference)),
    ("## Network", (_NetworkFile, _Edge)),
    ("## Train", (_TrainFile, _Axles, _Brake, _BrakingCurves)),
    (
        "## Consist",
        (_ConsistFile, _ConsistBrake, _Vehicle, _Coupler),
    ),
    ("## Journey", (_JourneyFile,)),
    ("## Parameters", (_ParametersFile, ConfigurationPart, ResistancePart)),
    ("## Trajectory", (_TrajectoryFile,)),
    ("## Coast-down", (_CoastDownFile, _QuantityPart, _CurvePart)),
]


@pytest.mark.parametrize(("title", "models"), SECTIONS, ids=[title for title, _ in SECTIONS])
def test_every_key_is_described(title: str, models: tuple[type[BaseModel], ...]) -> None:
    section = TEXT.split(f"{title}\n")[1].split("\n## ")[0]
    for model in models:
        for name, field in model.model_fields.items():
            assert f"`{name}`" in section, name
            if issubclass(model, File):
                assert (f"*`{name}`*" in section) is not field.is_required(), name
    if title == "## Train":
        assert all(f"`{name}`" in section for name in BRAKING_PARAMETERS)


def test_every_format_is_in_the_list() -> None:
    for _, (model, *_others) in SECTIONS:
        assert issubclass(model, File)
        assert f"`{model.FORMAT}`" in TEXT
        assert (2 if model.FORMAT in ("trainlog/line", "trainlog/network") else 1) == model.VERSION


def test_every_table_and_column_of_a_map_is_described() -> None:
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
