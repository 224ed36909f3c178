"""docs/formats.md names every key of every format."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import BaseModel

from trainlog.formats.condition import _Evidence, _Layer, _MapFile
from trainlog.formats.line import _Geometry, _JourneyFile, _LineFile, _Reference
from trainlog.formats.parameters import (
    ConfigurationPart,
    ResistancePart,
    _CoastDownFile,
    _CurvePart,
    _ParametersFile,
    _QuantityPart,
)
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

TEXT = (Path(__file__).parents[1] / "docs" / "formats.md").read_text("utf-8")
SECTIONS: list[tuple[str, tuple[type[BaseModel], ...]]] = [
    ("## Line", (_LineFile, _Geometry, _Reference)),
    ("## Train", (_TrainFile, _Axles, _Brake, _BrakingCurves)),
    (
        "## Consist",
        (_ConsistFile, _ConsistBrake, _Vehicle, _Coupler),
    ),
    ("## Journey", (_JourneyFile,)),
    ("## Parameters", (_ParametersFile, ConfigurationPart, ResistancePart)),
    ("## Trajectory", (_TrajectoryFile,)),
    ("## Coast-down", (_CoastDownFile, _QuantityPart, _CurvePart)),
    ("## Track-condition map", (_MapFile, _Layer, _Evidence)),
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
        assert model.VERSION == 1
