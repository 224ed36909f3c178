"""``--json`` on every command: one object of a documented form, and nothing else, on stdout.

The schemas are renewed by ``pytest tests/test_cli_json.py --renew-golden``; the difference is
reviewed like code.
"""

import json
import shutil
from collections.abc import Iterator
from functools import reduce
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from trainlog.formats.samples import copy_samples

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds", "unpainted_page", "unrenewed")

CHECKOUT = Path(__file__).parents[1]
SCHEMAS = CHECKOUT / "docs" / "command-line.schemas.json"

COMMANDS = """
new samples -o sample_logs
new line -o my.line.toml
import sample_logs/CH_Stadler_FLIRT_TPF.train.json --set mass-model=homogeneous_strip -o imported
ingest sample_logs/gnss.csv -o recorded
show recorded/gnss.mcap --all
show sample_logs --check
convert cut.mcap -o whole.mcap
simulate drive --line sample --train sample --count 1 -o trips
simulate fleet drawn:1 --trains 1 --days 1 --count 1 --jobs 1 -o fleet
fit efforts sample_logs -o parameters.json
estimate sample_logs/nonstop.mcap -o estimated
fit coasting sample_logs/nonstop.mcap -o coast-down.json
fit adhesion curve.csv -o wet.json
map update sample_logs --map wil.map
map show sample_logs/CH_StGallen_Wil.map --at 2024-10-09T06:00Z --model
map forecast sample_logs/CH_StGallen_Wil.map -o forecast.csv
map score forecast.csv sample_logs
map diff wil.map sample_logs/CH_StGallen_Wil.map
map show sample_logs/CH_StGallen_Wil.map --km 12.3 --layer wet --days 2
map export wil.map -o map.csv
new network --from sample_logs/CH_StGallen_Wil.line.json -o one.network.json
show one.network.json
new line --from one.network.json#Flawil,Uzwil -o route.line.json
show one.network.json#Flawil,Uzwil
convert one.network.json -o one.geojson
map merge wil.map sample_logs/CH_StGallen_Wil.map -o both.map
map remove wil.map trip-01
map compact both.map --before 2024-10-08
plan parameters.json --line sample --train sample --set cells=30 -o trajectory.json
settings
show sample_logs/nonstop.mcap
convert sample_logs/nonstop.mcap -o part.mcap --km 3:5
convert sample_logs/nonstop.mcap -o rest.mcap --km 5:8
convert part.mcap rest.mcap -o whole-again.mcap
convert part.mcap -o part.parquet
fleet add sample_logs --catalogue fleet
fleet show --catalogue fleet
fleet show --catalogue fleet --problems
fleet show --catalogue fleet --by train
fleet show --catalogue fleet --by kind
fleet show --catalogue fleet --by line
fleet show --catalogue fleet --by edge
fleet show --catalogue fleet --by day
fleet show --catalogue fleet --by weather
fleet query tables --catalogue fleet
fleet query --catalogue fleet select/**/key,duration/**/as/**/duration_s/**/from/**/trips
fleet query --catalogue fleet weather='wet'
fleet query -o trips.csv --catalogue fleet
fleet refresh --catalogue fleet
show --check --trips all --catalogue fleet
fleet update --catalogue fleet --workers 0
fleet diff now now --catalogue fleet --analysis checks
fleet trains --catalogue fleet -o trains
report fleet -o fleet.html
fleet remove --catalogue fleet weather='wet'
compare trips sample_logs
compare calculated sample_logs/nonstop.mcap --model sample_logs/CH_Stadler_FLIRT_TPF.train.json
advice trajectory.json --onto sample_logs/nonstop.mcap -o advised.mcap
advice trajectory.json --departure 07:12 -o advice.html
replay part.mcap rest.mcap -o parts.rrd
report part.mcap -o part.html
report sample_logs
record --from file lines.jsonl --idle 0.1 -o live.mcap
new line --from sample_logs/nonstop.mcap -o built.line.json
docs --list
docs adhesion --path
demo -o demonstrated
demo --fleet -o demonstrated-fleet
"""  # run one after the other, with the samples at hand

NAMED = {
    *("labels", "layers", "passport", "repairs", "counts", "rms", "topics", "metadata", "rows"),
    *("explained", "messages", "dropped", "malformed", "not_used"),
}  # keys of objects whose own keys are names that the data give

STEPS = [
    ["new", "samples", "-o", "copied"],
    ["show", "--check", "cut.mcap", "sample_logs/nonstop.mcap"],
]  # commands of the demos, of which the last finds damage; those of their own take minutes

COMMON = ("command", "status", "notes", "written")  # keys of every command

Schema = dict[str, Any]


def schema_of(value: Any, key: str = "") -> Schema:
    """A schema that fits a value, and others of its kind."""
    if isinstance(value, bool):
        return {"type": ["boolean"]}
    if isinstance(value, int | float):
        return {"type": ["number", "null"]}
    if isinstance(value, str):
        return {"type": ["string", "null"]}
    if key == "steps":  # of a demo: what each of its commands prints
        return {"type": ["array"], "items": {"type": ["object"], "required": sorted(COMMON)}}
    if isinstance(value, list):
        items: Schema = {}
        for each in value:
            items = merged(items, schema_of(each))
        return {"type": ["array"], "items": items}
    if isinstance(value, dict) and key in NAMED:
        inner: Schema = {}
        for each in value.values():
            inner = merged(inner, schema_of(each))
        return {"type": ["object"], "additionalProperties": inner}
    if isinstance(value, dict):
        parts = {name: schema_of(each, name) for name, each in value.items()}
        closed = {"required": sorted(parts), "additionalProperties": False}
        return {"type": ["object"], "properties": parts, **closed}
    return {"type": ["null"]}


def merged(one: Schema, other: Schema) -> Schema:
    """A schema that fits what either fits."""
    if not one or not other:
        return one or other
    found: Schema = {"type": sorted({*one["type"], *other["type"]})}
    if "properties" in one or "properties" in other:
        parts = one.get("properties", {}), other.get("properties", {})
        names = sorted({*parts[0], *parts[1]})
        found["properties"] = {
            name: merged(*(each.get(name, {}) for each in parts)) for name in names
        }
        known = [set(each["required"]) for each in (one, other) if "required" in each]
        found["required"] = sorted(set.intersection(*known))
    for key in ("items", "additionalProperties"):
        if parts := [each[key] for each in (one, other) if key in each]:
            found[key] = reduce(merged, parts)
    return found


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A folder with the samples, a damaged log, and points of an adhesion characteristic."""
    folder = tmp_path_factory.mktemp("json")
    copy_samples(folder / "sample_logs")
    log = (folder / "sample_logs" / "nonstop.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(log[: len(log) // 3])
    slips = [0.001 * each for each in range(1, 60)]
    points = [f"{s},{0.25 * 2 * 0.012 * s / (0.012**2 + s**2)}" for s in slips]
    rows = [
        {"topic": "/train/state", "time": f"2024-05-01T06:00:0{each}Z", "speed": 20.0 + each}
        for each in range(3)
    ]
    (folder / "lines.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
    (folder / "curve.csv").write_text("creepage [1],adhesion [1]\n" + "\n".join(points) + "\n")
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        yield folder


def test_each_command_prints_one_object_of_its_documented_form(folder, monkeypatch, request, shell):
    found: dict[str, Schema] = {}
    renew = request.config.getoption("--renew-golden")
    known = {} if renew else json.loads(SCHEMAS.read_text("utf-8"))
    monkeypatch.setattr("trainlog.cli.terminal.SILENCE", 3600.0)
    monkeypatch.setattr("trainlog.cli.demo.commands", lambda _: STEPS)
    monkeypatch.setattr("trainlog.cli.demo.fleet_commands", lambda *_, **__: STEPS)
    for line in COMMANDS.split("\n")[1:-1]:
        status, printed, complaint = shell(*line.split(), "--json")
        assert status in (0, 1), (line, complaint)
        assert all(each.startswith("trainlog: ") for each in complaint.splitlines()), line
        document = json.loads(printed, parse_constant=pytest.fail)
        assert document["status"] == status
        assert line.startswith(document["command"])
        assert all(Path(each).exists() for each in document["written"]), line
        name = document["command"]
        found[name] = merged(found.get(name, {}), schema_of(document))
        if not renew:
            for each in (document, *document.get("steps", [])):
                jsonschema.Draft202012Validator(known[each["command"]]).validate(each)
    if renew:
        text = json.dumps(dict(sorted(found.items())), indent=1, ensure_ascii=False)
        SCHEMAS.write_text(text + "\n", encoding="utf-8")


def test_the_schemas_state_what_all_commands_have():
    for schema in json.loads(SCHEMAS.read_text("utf-8")).values():
        jsonschema.Draft202012Validator.check_schema(schema)
        assert set(COMMON) <= set(schema["required"])


def test_an_error_with_json_is_one_object_on_standard_error(tmp_path, shell):
    words = ["fit", tmp_path / "no.mcap", "-o", tmp_path / "p.json"]
    status, printed, complaint = shell(*words, "--json")
    assert (status, printed) == (2, "")
    stated = {"problem": "does not exist", "file": str(tmp_path / "no.mcap"), "place": None}
    stated["remedy"] = "check the path"
    assert json.loads(complaint) == {"status": 2, "error": stated}
    assert shell(*words)[2].startswith("trainlog: ")
    complaint = shell("show", "--colour", "--json")[2]
    assert json.loads(complaint)["error"]["problem"].startswith("No such option: --colour")
    profile = tmp_path / "two.profile.toml"
    profile.write_text('format = "trainlog/recorder-profile"\nversion = 1\nname = 3\nother = 4\n')
    error = json.loads(shell("show", profile, "--json")[2].splitlines()[-1])["error"]
    assert len(error["problems"]) == 2


def test_quiet_prints_errors_only(folder, shell):
    (folder / "two").mkdir()
    shutil.copy(folder / "cut.mcap", folder / "two" / "cut.mcap")
    (folder / "two" / "empty.mcap").touch()
    status, printed, complaint = shell("show", "--check", "two", "-q")
    assert (status, printed) == (1, "")
    assert complaint.count("\n") == 1
    assert "empty.mcap" in complaint
