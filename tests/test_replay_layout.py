"""The layout in a recording: it shows what there is, and nothing that is not."""

from __future__ import annotations

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from replay_trips import condition_of, entities, made_trip, trajectory_of
from rerun.chunk import RrdReader

from trainlog.errors import InputError
from trainlog.replay import ReplayOptions, write_replay
from trainlog.trip import Trip

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


@pytest.mark.parametrize(
    ("count", "beside"),
    [
        (1, False),
        (3, True),
        *(
            pytest.param(*each, marks=pytest.mark.long)
            for each in ((2, False), (3, False), (1, True), (2, True))
        ),
    ],
)
def test_every_view_has_something_to_show(
    trips: list[Trip], tmp_path: Path, count: int, beside: bool
) -> None:
    path = tmp_path / "replay.rrd"
    write_replay(
        trips[:count],
        path,
        trajectory=trajectory_of() if beside else None,
        condition_map=condition_of() if beside else None,
    )
    layout, found = layout_of(path), set(entities(path))
    assert layout.shown()
    assert [query for query in layout.shown() if not matches(query, found)] == []


def test_everything_recorded_is_shown(trips: list[Trip], tmp_path: Path) -> None:
    path = tmp_path / "replay.rrd"
    write_replay(trips, path, trajectory=trajectory_of(), condition_map=condition_of())
    queries = layout_of(path).shown()
    hidden = [name for name in entities(path) if not any(matches(q, {name}) for q in queries)]
    assert hidden == []


@pytest.mark.parametrize("count", [1, 3])
def test_several_trips_have_a_tab_each_and_views_over_all(
    trips: list[Trip], tmp_path: Path, count: int
) -> None:
    path = tmp_path / f"{count}.rrd"
    write_replay(trips[:count], path)
    logged = layout_of(path).logged.values()
    tabs = [each for each in logged if each.get("ContainerBlueprint:container_kind") == [1]]
    assert tabs
    assert all(len(each["ContainerBlueprint:contents"]) > 1 for each in tabs), "none alone"
    titles = {
        value[0]
        for components in logged
        for name, value in components.items()
        if name.endswith(":display_name")
    }
    for several in ("up", "Speed forward [km/h]", "Lateness against up [s]: late above 0, early"):
        assert any(title.startswith(several) for title in titles - {"up: speed [km/h]"}) == (
            count > 1
        )


def test_views_without_what_they_are_about_are_refused(tmp_path: Path) -> None:
    trip, path = made_trip(), tmp_path / "replay.rrd"
    bare = replace(trip, topics={"/train/state": trip["/train/state"]}, attachments={})
    write_replay([bare], path)
    path.unlink()
    with pytest.raises(InputError, match=r"nothing for the view 'traction'.*overview, driving"):
        write_replay([bare], path, options=ReplayOptions(view="traction"))
    with pytest.raises(InputError, match=r"no view 'tractoin'.*overview, driving, traction"):
        write_replay([bare], path, options=ReplayOptions(view="tractoin"))
    assert not list(tmp_path.iterdir())


def test_without_tiles_there_is_no_map_that_asks_for_them(
    trips: list[Trip], tmp_path: Path
) -> None:
    path = tmp_path / "replay.rrd"
    write_replay(trips, path, condition_map=condition_of())
    layout = layout_of(path)
    classes = {view["class"][0] for view in layout.views()}
    assert "2D" in classes
    assert "Map" not in classes
    plan = next(view for view in layout.views() if view["class"] == ["2D"])
    bounds = layout.logged[f"{plan['path']}/VisualBounds2D"]["VisualBounds2D:range"][0]
    (left, right), (top, bottom) = bounds["x_range"], bounds["y_range"]
    assert left < 0.0 < 2000.0 < right < 3000.0
    assert top < 0.0 < bottom
