"""A field of the topic table is one entry: what becomes of it in the rest follows."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

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


def test_a_new_field_is_one_entry(tmp_path: Path) -> None:
    run = subprocess.run(
        [sys.executable, "-c", ADDED, str(tmp_path), str(TOOLS)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 0, run.stdout + run.stderr
