"""The layout in a recording: it shows what there is, and nothing that is not."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from refusals import refused
from replay_trips import condition_of, entities, made_trip, trajectory_of
from rerun.chunk import RrdReader

from trainlog import InputError, ReplayOptions, Trip, write_replay

COMPONENTS = {
    "class": "ViewBlueprint:class_identifier",
    "name": "ViewBlueprint:display_name",
    "contents": "ViewContents:query",
    "origin": "ViewBlueprint:space_origin",
}


@dataclass
class Layout:
    """What the blueprint of a recording says."""

    logged: dict[str, dict[str, Any]]

    def views(self) -> list[dict[str, Any]]:
        found = []
        for path, components in self.logged.items():
            if re.fullmatch(r"/view/[0-9a-f-]{36}", path) and COMPONENTS["class"] in components:
                both = components | self.logged[f"{path}/ViewContents"]
                found.append(
                    {key: both.get(name) for key, name in COMPONENTS.items()} | {"path": path}
                )
        return found

    def shown(self) -> set[str]:
        """Entity paths that views ask for, `$origin` filled in."""
        paths = set()
        for view in self.views():
            for line in view["contents"]:
                for query in line.splitlines():
                    paths.add(query.strip().removeprefix("+").strip().replace(
                        "$origin", (view["origin"] or [""])[0]))  # fmt: skip
        return paths


def layout_of(path: Path) -> Layout:
    reader = RrdReader(path)
    stored = reader.blueprints()
    assert len(stored) == 1
    assert stored[0].application_id == reader.recordings()[0].application_id == "trainlog"
    logged: dict[str, dict[str, Any]] = {}
    for chunk in reader.stream(store=stored[0]).to_chunks():
        batch = chunk.to_record_batch()
        kept = logged.setdefault(chunk.entity_path, {})
        for name in batch.schema.names:
            if ":" in name:
                kept[name] = batch[name][len(batch) - 1].as_py()
    return Layout(logged)


def matches(query: str, found: set[str]) -> bool:
    stem = query.removesuffix("/**")
    return any(name == stem or (stem != query and name.startswith(f"{stem}/")) for name in found)


@pytest.fixture(scope="module")
def trips() -> list[Trip]:
    return [made_trip(), made_trip("down", "reverse"), made_trip("up again")]


@pytest.mark.parametrize(("count", "beside"), [(1, False), (3, True)])
def test_every_view_has_something_to_show_and_everything_recorded_is_shown(
    trips, tmp_path, count, beside
):
    path = tmp_path / "replay.rrd"
    given = {"trajectory": trajectory_of(), "condition_map": condition_of()} if beside else {}
    write_replay(trips[:count], path, **given)
    layout, found = layout_of(path), set(entities(path))
    queries = layout.shown()
    assert queries
    assert [query for query in queries if not matches(query, found)] == []
    assert [name for name in found if not any(matches(q, {name}) for q in queries)] == []
    logged = layout.logged.values()
    tabs = [each for each in logged if each.get("ContainerBlueprint:container_kind") == [1]]
    assert tabs
    assert all(len(each["ContainerBlueprint:contents"]) > 1 for each in tabs), "none alone"
    titles = {
        value[0]
        for components in logged
        for name, value in components.items()
        if name.endswith(":display_name")
    }
    # Several trips have a tab each, and views over all.
    for several in ("up", "Speed forward [km/h]", "Lateness against "):
        others = titles - {"up: speed [km/h]"}
        assert any(title.startswith(several) for title in others) == (count > 1)
    # Without tiles no map asks for them.
    views = {view["class"][0]: view for view in layout.views()}
    assert "Map" not in views
    bounds = layout.logged[f"{views['2D']['path']}/VisualBounds2D"]["VisualBounds2D:range"][0]
    (left, right), (top, bottom) = bounds["x_range"], bounds["y_range"]
    assert left < 0.0 < 2000.0 < right < 3000.0
    assert top < 0.0 < bottom


def test_views_without_what_they_are_about_are_refused(tmp_path):
    trip, path = made_trip(), tmp_path / "replay.rrd"
    bare = replace(trip, topics={"/train/state": trip["/train/state"]}, attachments={})
    for view, said in (
        ("traction", r"nothing for the view 'traction'.*overview, driving"),
        ("tractoin", r"no view 'tractoin'.*overview, driving, traction"),
    ):
        refused(InputError, said, write_replay, [bare], path, options=ReplayOptions(view=view))
    assert not list(tmp_path.iterdir())
