"""Results as values: compared, kept, handed on; a trip as analyses see it, whole or in parts."""

from __future__ import annotations

import csv
import importlib
import io
import json
import pickle
import pkgutil
import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import jsonschema
import numpy as np
import pandas as pd
import pytest
from fleet_trips import later
from refusals import refused
from rich.console import Console

import analysis
import analysis.adhesion.slip as slip_module
import analysis.resistance.coasting_detection as motion_module
import trainlog
from analysis import adhesion_map, coast_down, fit, fit_trip, geometry_of, view as module
from analysis.adhesion.condition_map import UpdatedMap
from analysis.estimates import estimate_log, with_estimates
from analysis.fleet.diff import fleet_diff
from analysis.fleet.trains import fleet_trains
from analysis.network.maps import NetworkMap
from analysis.reports.answers import verdict
from analysis.resistance.recording import TripRefusedError
from analysis.trajectory.journey import JourneyPlan
from analysis.trajectory.optimiser import Front
from analysis.trajectory.table import PlannedRun
from trainlog import AdhesionPoints, InputError, LogError, LogWriter, frame_of, write_parameters
from trainlog.catalogue import open_catalogue
from trainlog.cli.terminal import as_json_text
from trainlog.declaration import Declared
from trainlog.display import text_of_cell
from trainlog.ingest import ingest_all, propose_profile
from trainlog.mcap import read_log, write_log
from trainlog.mcap.reader import rows_of_log
from trainlog.presentation import (
    ADHESION,
    MASS,
    SPEED,
    Band,
    Column,
    Ends,
    Presented,
    WordTable,
    new_table,
)
from trainlog.topics import ESTIMATED_STATE, GNSS_MOTION, TRAIN_STATE

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

LOG = trainlog.sample("nonstop.mcap")

DATA = Path(__file__).parent / "data"


@pytest.fixture(scope="module")
def fitted():
    return analysis.fit([LOG])


def test_a_fit_goes_straight_into_set_and_calculation(fitted):
    (fit,) = fitted.trips
    wanted = analysis.parameter_set([fit])
    expected = analysis.calculate(LOG, wanted)
    for given in (fit, fitted):
        found = analysis.parameter_set(given)
        assert found.configurations == wanted.configurations
        calculated = analysis.calculate(LOG, given)
        assert calculated.total("calculated_work") == expected.total("calculated_work")
    refused(trainlog.InputError, r"\(str\) was given where", analysis.calculate, LOG, "params.json")


@pytest.fixture(scope="module")
def results(tmp_path_factory, fitted) -> dict[type, Presented]:
    """One result of each class that is presented, made of the samples."""
    folder = tmp_path_factory.mktemp("results")
    shutil.copy(LOG, folder / "nonstop.mcap")
    logs = [LOG, trainlog.sample("stopping.mcap")]
    trip = trainlog.read(LOG)
    track = trainlog.read_map(trainlog.sample("CH_StGallen_Wil.map"))
    line = trainlog.read_line(trainlog.sample("CH_StGallen_Wil.line.json"))
    train = trainlog.read_train(trainlog.sample("CH_Stadler_FLIRT_TPF.train.json"))
    coasted = analysis.coast_down([LOG])
    creepage = np.linspace(0.001, 0.06, 60)
    curve = AdhesionPoints(creepage, 0.5 * 0.012 * creepage / (0.012**2 + creepage**2))
    problem = analysis.TrajectoryProblem(
        line, train, [trainlog.Configuration.of(train)], end=9_286.1
    )
    plan = analysis.optimise(problem, analysis.OptimiserOptions(cells=30))
    energies = dict.fromkeys(("energy", "costliest_energy"), plan.certificate["energy"])
    bound = {"lower_bound": plan.certificate["lower_bound"], "mixture": {}}
    about = {"costliest": plan.configurations[0].name, "other_times_might_save": 0.0}
    gap = {"gap": plan.certificate["gap"]}
    still = {"lowest_speed": 0.0, "highest_speed": 0.0}
    ends = (trainlog.TimingPoint(0.0, latest=0.0, **still), trainlog.TimingPoint(9_286.1, **still))
    journey = trainlog.Journey("a journey", line.name, ends)
    times = np.array([0.0]), np.array([plan.running_time])
    with open_catalogue(folder / "fleet") as catalogue:
        added = catalogue.add(folder)
        refreshed = catalogue.refresh()
        options = analysis.UpdateOptions(workers=0)
        updated = analysis.update_fleet(catalogue, ["checks"], options)
        status = analysis.fleet_status(catalogue, ["checks"])
        compared = fleet_diff(catalogue, "now", "now", analyses=["checks"], workers=0)
    rows = pd.read_parquet(DATA / "fleet_trips.parquet")
    fleet = fleet_trains(rows[rows["kind"] == "flirt"].head(40).reset_index(drop=True))
    recorded = folder / "recorder.csv"
    rows_of_it = trainlog.sample("recorder.csv").read_bytes().splitlines(True)[:2_000]
    recorded.write_bytes(b"".join(rows_of_it))
    two_days = analysis.adhesion_map([trip, later(trip, pd.Timedelta(days=2))]).track
    write_parameters(fitted.parameters, folder / "parameters.json")
    (kind, *_) = fleet.resistance
    start, end = trainlog.Node("St. Gallen"), trainlog.Node("Wil")
    edge = trainlog.Edge("850", line, start.name, end.name)
    ingested = ingest_all(trainlog.sample("gnss.csv"), folder / "ingested")
    found: list[Presented] = [
        *(fitted, fitted.trips[0], fitted.common, fitted.parameters, coasted, coasted.result),
        *(analysis.slip(LOG), analysis.passport(LOG), analysis.fit_adhesion_characteristic(curve)),
        *(track, analysis.map_state(track, line=line), UpdatedMap(track, ("a",))),
        analysis.map_difference(analysis.adhesion_map(logs[1]).track, track),
        analysis.map_history(track, 9_680.0, "wet"),
        *(analysis.update_map([LOG], folder / "wil.map"), analysis.score_rolling(two_days)),
        NetworkMap(folder, None, {track.line: track}),
        *(analysis.compare(logs), analysis.calculate(LOG, fitted)),
        analysis.compare_groups(
            trip, replace(trip, metadata={**trip.metadata, "configuration": trip.name})
        ),
        *(plan, Front((plan,), plan.running_time), PlannedRun(problem, plan)),
        PlannedRun(problem, plan).advice,
        JourneyPlan(journey, (plan,), *times, {**energies, **bound, **about, **gap}),
        *(added, refreshed, updated, status, compared, trainlog.mcap.describe(LOG)),
        *(fleet, fleet.resistance, kind, kind.mean),
        *(ingested, next(each.report for each in ingested.outcomes if each.report)),
        analysis.report(folder),
        trainlog.Network("one", (start, end), (edge,)).route("St. Gallen", "Wil"),
        *(trip, trainlog.identity_of(trip), analysis.geometry_of([trip])),
        propose_profile(recorded),
    ]
    return {type(each): each for each in found}


def presented() -> list[type]:
    """Every class of results; declared things are looked at in their own tests."""
    for package in (trainlog, analysis):
        for each in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not each.name.endswith("__main__"):
                importlib.import_module(each.name)
    found, left = [], [Presented]
    while left:
        left += (below := left.pop().__subclasses__())
        found += [each for each in below if each.__module__.startswith(("trainlog.", "analysis."))]
    return [each for each in found if not issubclass(each, Declared)]


def printed(width: int, *shown: object) -> str:
    """What a terminal of `width` columns shows."""
    console = Console(width=width, file=io.StringIO())
    console.print(*shown, sep="\n")
    return str(console.file.getvalue())


def test_every_result_is_looked_at(results):
    assert not {each.__qualname__ for each in presented()} - {each.__qualname__ for each in results}


def test_every_result_prints_few_lines_is_json_of_its_schema_equals_its_copy_and_is_drawn(results):
    for kind, result in results.items():
        lines = repr(result).splitlines()
        assert 1 <= len(lines) <= 10, kind
        assert lines[0] == result.title, kind
        html = result._repr_html_()
        assert html.startswith("<div><b>"), kind
        assert len(html) < 100_000, kind
        assert max(map(len, printed(60, *result.shown()).splitlines())) <= 60, kind
        assert pickle.loads(pickle.dumps(result)) == result, kind
        assert result != 1, kind
        document = json.loads(as_json_text(result.data()))
        assert document, kind
        jsonschema.validate(document, result.schema())
        if kind.charts_by:
            assert all(each.has_data() for each in result.plot().axes), kind


def test_every_table_of_a_result_is_the_same_read_again_from_csv(results):
    for kind, result in results.items():
        for table in result.tables():
            rows = table.data
            read = list(csv.DictReader(io.StringIO(table.to_csv())))
            assert len(read) == len(rows), (kind, table.name)
            for row, data in zip(read, rows, strict=True):
                for key, value in data.items():
                    if isinstance(value, float) and np.isfinite(value):
                        assert float(row[key]) == value, (kind, table.name, key)
                    elif isinstance(value, str):
                        assert text_of_cell(row[key]) == value, (kind, table.name, key)


RUN_COLUMNS = (
    Column("train"),
    Column("top speed", SPEED, of="top"),
    Column("mass", MASS, band=True, rank=1),
    Column("adhesion", ADHESION, rank=2),
)


@dataclass(frozen=True)
class Run:
    train: str
    top: float
    mass: Band | None
    adhesion: Ends | None


@dataclass(frozen=True, eq=False, repr=False)
class Runs(Presented):
    runs: tuple[Run, ...]

    @property
    def title(self) -> str:
        return f"{len(self.runs)} runs"

    def summary(self) -> dict[str, str]:
        return {run.train: SPEED.words(run.top) for run in self.runs}

    def tables(self) -> list[WordTable]:
        return [new_table("Runs", *RUN_COLUMNS, name="runs").add_rows(self.runs)]

    @property
    def notes(self) -> tuple[str, ...]:
        return ("± is the 95 % band.",)


@pytest.mark.parametrize("width", [110, 120, 130])
def test_short_cells_are_whole_where_columns_that_stand_closer_have_space(width):
    heads = ("key", "trip", "train", "line", "start", "time", "km", "weather", "load, t")
    table = new_table("Trips", *(Column(head) for head in heads))
    table.add_row(
        "2999b8a2", "flirt-01-2026-11-20-0614", "flirt-01", "Weissegg - Buchburg",
        "2026-11-20 06:14 UTC", "21:58 min", "0.0 to 29.6", "frost", "11.4",
    )  # fmt: skip
    said = printed(width, table)
    assert "0.0 to 29.6" in said
    assert all(word in said for word in ("2999b8a2", "flirt-01-2026-11-20-0614"))
    assert max(map(len, said.splitlines())) <= width


def runs() -> Runs:
    adhesion = Ends(0.15, 0.1, 0.2)
    first = Run("train 0", 20.0, None, adhesion)
    return Runs((first, Run("train 1", 21.0, Band(80e3, 1e3), adhesion)))


def test_a_notebook_shows_title_tables_and_notes_escaped():
    html = runs()._repr_html_()
    assert all(words in html for words in ("<b>2 runs</b>", "top speed, km/h", "95 % band"))
    hostile = Runs((Run("<script>", 1.0, None, None),))
    assert "<script>" not in hostile._repr_html_()
    refused(InputError, "Runs has no plot; print it, or use its attributes", runs().plot)


def test_csv_and_frame_hold_the_rows_in_si_units():
    found = runs()
    read = pd.read_csv(io.StringIO(found.to_csv()))
    assert read["top_speed_m_s"].tolist() == [20.0, 21.0]
    assert read["mass_std_kg"].isna().tolist() == [True, False]
    assert found.to_frame().attrs["units"]["top_speed_m_s"] == "m/s"
    refused(KeyError, "no table 'days'; it has runs", found.to_csv, name="days")


def test_a_fit_states_the_band_that_its_picture_has_and_a_doubt_of_several_trips_once(fitted):
    low, high = fitted.common.band(80.0 / 3.6)
    assert f"wider: {low / 1e3:.4g} to {high / 1e3:.4g} kN at 80 km/h" in fitted.notes[0]
    # Trips of one doubt share a sentence.
    first = replace(fitted.trips[0], notes=("no wheel is recorded",))
    both = replace(fitted, trips=(first, replace(first, trip="other")))
    assert f"{first.trip}, other: no wheel is recorded" in both.notes


def test_names_are_broken_before_numbers():
    table = new_table("", Column("train"), Column("at 80 km/h"), Column("note"))
    table.add_cells("one more train", "9.47 ± 0.33", "not compared with any other")
    assert "9.47 ± 0.33" in printed(38, table)


def test_a_narrow_terminal_leaves_out_the_least_important_columns_and_names_them():
    (table,) = runs().tables()
    for width, shown, left_out in (
        (80, "80.0 ± 2.0", ""),
        (34, "80.0 ± 2.0", "not shown in 34 columns: adhesion"),
        (24, "72.0", "mass, t, adhesion"),
    ):
        words = " ".join(printed(width, table).split())
        assert shown in words
        assert left_out in words
        assert ("not shown" in words) == (width < 80)


@pytest.fixture(scope="module")
def there_and_back(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The sample trip twice, an hour apart, as one recording."""
    trip = read_log(LOG)
    path = tmp_path_factory.mktemp("long") / "long.mcap"
    with LogWriter(path) as writer:
        writer.add(trip)
        writer.add(later(trip, pd.Timedelta("1h")))
    return path


@pytest.mark.parametrize("call", [fit, adhesion_map, coast_down, geometry_of])
def test_infinite_numbers_are_refused_by_every_analysis(call):
    trip = read_log(LOG)
    for name in ("/train/state", "/gnss/motion"):
        frame = trip[name].copy()
        frame.iloc[100:105, frame.columns.get_loc("speed")] = np.inf
        said = f"{name}, column speed: trip 'trip-01' holds 5 infinite numbers; give NaN"
        refused(LogError, said, call, [trip.with_topic(frame)])


def test_the_chainage_of_satellites_serves_where_none_is_recorded():
    trip = read_log(LOG)
    state = trip["/train/state"]
    position = state["position"].to_numpy()
    known = {"position": position, "position_std": np.full(len(position), 2.0)}
    found = frame_of(ESTIMATED_STATE, pd.DatetimeIndex(state.index), known)
    without = state.assign(position=np.nan)
    without.attrs = state.attrs
    located = trip.with_topic(without).with_topic(found)
    assert fit_trip(located).resistance(25.0) == pytest.approx(fit_trip(trip).resistance(25.0))
    kept, refusals = with_estimates(located)
    pd.testing.assert_frame_equal(kept["/estimates/state"], found)
    assert kept["/train/state"]["position"].isna().all(), "what is not recorded stays so"
    assert not any("running resistance" in each for each in refusals)
    assert "position" not in str(verdict(located))
    said = "the fit needs it: map its column, or ingest fixes with a line"
    refused(TripRefusedError, said, fit_trip, trip.with_topic(without))


def test_parts_of_a_long_log_leave_out_no_sample_and_share_none(there_and_back):
    whole = read_log(there_and_back, ["/train/state", "/train/axles"])
    held = rows_of_log(there_and_back, module.TOPICS)
    for rows in (held - 1, held // 7):
        parts = [part.trip for part in module.views_of(there_and_back, module.TOPICS, rows=rows)]
        for topic in whole:
            pd.testing.assert_frame_equal(pd.concat([part[topic] for part in parts]), whole[topic])
        assert len(parts) == len(module.parts_of(there_and_back, held, rows))
        assert max(sum(map(len, part.topics.values())) for part in parts) < 1.5 * rows


def test_maps_and_coasting_take_all_parts_of_a_long_log(there_and_back, monkeypatch):
    alone = adhesion_map(LOG).track
    coasted = coast_down(LOG)
    monkeypatch.setattr(
        module, "ROWS", rows_of_log(LOG, (*slip_module.TOPICS, "/environment")) + 1_000
    )
    both = adhesion_map(there_and_back).track
    assert [each["trip"] for each in both.trips] == ["trip-01"]
    for name, layer in alone.layers.items():
        np.testing.assert_array_equal(both.layers[name].events, 2 * layer.events)
    monkeypatch.setattr(module, "ROWS", rows_of_log(LOG, motion_module.TOPICS) + 1_000)
    twice = coast_down(there_and_back)
    assert len(twice.trips) == 2 * len(coasted.trips)


def test_estimates_of_a_long_log_keep_what_was_recorded(there_and_back, monkeypatch, tmp_path):
    monkeypatch.setattr(module, "ROWS", rows_of_log(LOG) + 1_000)
    assert estimate_log(there_and_back, tmp_path / "parts.mcap") == ()
    parts, recorded = read_log(tmp_path / "parts.mcap"), read_log(there_and_back)
    assert parts.name == recorded.name
    for name in ("/train/state", "/train/axles", "/gnss/fix"):
        pd.testing.assert_frame_equal(parts[name], recorded[name], check_exact=True)
    estimated = parts["/estimates/state"]
    assert estimated.index.equals(recorded["/train/state"].index)
    error = estimated["speed"] - recorded["/truth"]["speed"].to_numpy()
    assert np.sqrt(np.mean(error**2)) < 0.05


def test_a_long_log_without_positions_is_parted_by_its_speed(there_and_back, tmp_path):
    motion = read_log(there_and_back, [GNSS_MOTION.name])
    write_log(motion, tmp_path / "speeds.mcap")
    rows = len(motion[GNSS_MOTION.name])
    views = list(module.views_of(tmp_path / "speeds.mcap", rows=rows // 2 + 100))
    assert len(views) == 2
    together = pd.concat([view.trip[GNSS_MOTION.name] for view in views])
    pd.testing.assert_frame_equal(together, motion[GNSS_MOTION.name])
    fixes = read_log(there_and_back, ["/gnss/fix"])
    write_log(fixes, tmp_path / "fixes.mcap")
    parts = module.views_of(tmp_path / "fixes.mcap", rows=100)
    refused(LogError, "knows neither position nor speed", next, parts)


def test_a_long_log_is_parted_where_the_train_turned_back(tmp_path):
    """Out and back, with falling chainage on the way back: two runs, not one every few metres."""
    trip = read_log(LOG, [TRAIN_STATE.name])
    state = trip[TRAIN_STATE.name]
    length = float(state["position"].iloc[-1])
    back = state.assign(position=length - state["position"])
    back.index = state.index + (state.index[-1] - state.index[0]) + pd.Timedelta("2min")
    with LogWriter(tmp_path / "both.mcap") as writer:
        writer.add(trip)
        writer.add(trip.with_topic(back))
        again = state.set_axis(back.index + (back.index[-1] - back.index[0]) + pd.Timedelta("2min"))
        writer.add(trip.with_topic(again))
    rows = len(state) + 1_000
    views = list(module.views_of(tmp_path / "both.mcap", [TRAIN_STATE.name], rows=rows))
    ends = [view.trip[TRAIN_STATE.name]["position"].iloc[[0, -1]].tolist() for view in views]
    assert len(views) == 3
    for (first, last), way in zip(ends, (1, -1, 1), strict=True):
        assert way * (last - first) > 0.95 * length
