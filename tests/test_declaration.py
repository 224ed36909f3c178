"""What follows from a declaration: one more field of a train, stated in one place."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Any

import pytest
from contents import put
from refusals import refused

from trainlog import InputError, Line, Train, read_line, read_train, sample
from trainlog.declaration import NOT_NEGATIVE, Quantity, check_plausible, entries, meanings
from trainlog.formats.declared import file_content, read_thing, write_thing


@dataclass(frozen=True, eq=False, repr=False)
class DwellTrain(Train):
    """A train that states its shortest stop.

    Attributes
    ----------
    least_dwell : float [s]
        Shortest stop at a station.
    """

    least_dwell: Annotated[
        float,
        Quantity(
            "s",
            "s",
            (0.5, 60, "stops take"),
            must=NOT_NEGATIVE,
            usual=3.0,
            shown="stops: {} at least",
        ),
    ] = 0.0


def dwell_train(**changes: Any) -> DwellTrain:
    flirt = read_train(sample("CH_Stadler_FLIRT_TPF.train.json"))
    known = {each.name: getattr(flirt, each.name) for each in fields(Train)}
    return DwellTrain(**known | changes)


@pytest.mark.parametrize("name", ["dwell.train.json", "dwell.train.toml"])
def test_a_new_field_is_written_and_read(tmp_path, name):
    train = dwell_train(least_dwell=2.5)
    write_thing(train, tmp_path / name, DwellTrain)
    assert file_content(train)["least_dwell"] == {"value": 2.5, "unit": "s"}
    assert read_thing(DwellTrain, tmp_path / name) == train
    assert read_thing(DwellTrain, tmp_path / name) != dwell_train(least_dwell=2.0)


@pytest.mark.parametrize(
    ("value", "unit", "message"),
    [
        (-1, "s", "least_dwell: -1 s is negative; give 0 or more"),
        (4, "m", "least_dwell.unit: unit 'm' cannot be read as s"),
        (400, "s", "least_dwell: 400 s is not plausible: stops take 0.5 to 60 s; check the value"),
        ("x", "s", "least_dwell.value: must be a valid number"),
    ],
)
def test_the_new_field_is_checked(tmp_path, value, unit, message):
    content = file_content(dwell_train()) | {"least_dwell": {"value": value, "unit": unit}}
    path = put(tmp_path / "dwell.train.json", json.dumps(content))
    caught = refused(InputError, "", read_thing, DwellTrain, path)
    assert str(caught).startswith(f"{path}, {message}")


def test_what_is_assumed_is_not_judged():
    refused(InputError, "stops take", check_plausible, dwell_train(least_dwell=100.0))
    check_plausible(dwell_train(least_dwell=100.0, assumed=("least_dwell",)))


@pytest.mark.parametrize("kind", [Train, Line])
def test_each_field_of_a_docstring_is_a_field(kind):
    named = {name for entry in entries(kind) for name in entry.names}
    assert set(meanings(kind)) <= named


def test_a_network_in_place_of_a_line_asks_for_a_route(tmp_path):
    file = put(tmp_path / "small.network.json", '{"format": "trainlog/network", "version": 1}')
    with pytest.raises(InputError, match=r"name a route of the network: '.*json#FROM,TO'"):
        read_line(file)
    refused(InputError, "check which file is meant", read_train, file)


ADDED = """
import sys
from dataclasses import replace
from pathlib import Path

from trainlog import topics
from trainlog.topics import Bounds, Drawn, Field, Recorded

added = Field(
    "oil_flow", "m^3/s", "flow of the transformer's oil", usual="l/min",
    bounds=Bounds(0.0, 0.02), recorded=Recorded("oelstrom oil", plausible=(0.0, 0.01)),
    drawn=Drawn("oil", "oil of the transformer", "terrain"),
)
topic = topics.TRAIN_SUPPLY
topics.TRAIN_SUPPLY = replace(topic, fields=(*topic.fields, added))
topics.TOPICS[topic.name] = topics.TRAIN_SUPPLY

import trainlog
from trainlog.formats.samples import sample
from trainlog.ingest import ingest, propose_profile
from trainlog.replay.samples import curves_of, panels_of

sys.path.insert(0, sys.argv[2])
from topic_table import topics_table

folder = Path(sys.argv[1])
lines = sample("recorder.csv").read_text("utf-8").splitlines()[:1500]
lines[0] += ";Ölstrom [l/min]"
lines[1:] = [f"{line};{90 + at % 7},0" for at, line in enumerate(lines[1:])]
lines[800] = lines[800].rpartition(";")[0] + ";5000,0"  # beyond its bounds
path = folder / "oil.csv"
path.write_text("\\n".join(lines) + "\\n", "utf-8")

profile = propose_profile(path).profile
column = profile.columns["/train/supply.oil_flow"]
assert (column.names, column.unit) == (("Ölstrom [l/min]",), "l/min"), column
trip = ingest(path, profile)
flow = trip["/train/supply"]["oil_flow"]
assert abs(flow.iloc[0] * 60e3 - 90.0) < 1e-9, flow
assert flow.max() < 0.02, flow
assert trip.metadata["repair.out_of_limits./train/supply.oil_flow"] == "1", trip.metadata

trainlog.write(trip, folder / "oil.mcap")
assert trainlog.read(folder / "oil.mcap")["/train/supply"].equals(trip["/train/supply"])
trainlog.write_parquet(trip, folder / "oil")
assert trainlog.read_parquet(folder / "oil")["/train/supply"].equals(trip["/train/supply"])

(curve,) = [curve for curve in curves_of(trip) if curve.entity == "oil"]
assert round(curve.scales[0]) == 60_000 and not curve.held
assert [panel.title for panel in panels_of(trip) if panel.entity == "oil"] == ["Oil [l/min]"]
assert "| `oil_flow` | m^3/s |" in topics_table() and "0 to 1200 l/min" in topics_table()
"""


TOOLS = Path(__file__).parents[1] / "docs" / "tools"


def test_a_new_field_is_one_entry(tmp_path):
    run = subprocess.run(
        [sys.executable, "-c", ADDED, str(tmp_path), str(TOOLS)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
