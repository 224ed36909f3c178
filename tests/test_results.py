"""Results as values: compared, kept, handed to the next function."""

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
from refusals import refused
from rich.console import Console

import analysis
import trainlog
from analysis.adhesion.condition_map import UpdatedMap
from analysis.fleet.diff import fleet_diff
from analysis.fleet.trains import fleet_trains
from analysis.network.maps import NetworkMap
from analysis.trajectory.journey import JourneyPlan
from analysis.trajectory.optimiser import Front
from analysis.trajectory.table import PlannedRun
from trainlog.catalogue import open_catalogue
from trainlog.cli.terminal import as_json_text
from trainlog.declaration import Declared
from trainlog.display import text_of_cell
from trainlog.errors import InputError
from trainlog.formats.railway import write_parameters
from trainlog.ingest import ingest_all, propose_profile
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
from trainlog.railway.adhesion import AdhesionPoints

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
    with pytest.raises(trainlog.InputError, match=r"\(str\) was given where"):
        analysis.calculate(LOG, "params.json")


# --------------------------------------------------------------- every result, in all its forms


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
    later = {
        name: frame.set_axis(frame.index + pd.Timedelta(days=2))
        for name, frame in trip.topics.items()
    }
    two_days = analysis.adhesion_map([trip, replace(trip, topics=later)]).track
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
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if not module.name.endswith("__main__"):
                importlib.import_module(module.name)
    found, left = [], [Presented]
    while left:
        left += (below := left.pop().__subclasses__())
        found += [each for each in below if each.__module__.startswith(("trainlog.", "analysis."))]
    return [each for each in found if not issubclass(each, Declared)]


def test_every_result_is_looked_at(results):
    assert not {each.__qualname__ for each in presented()} - {each.__qualname__ for each in results}


def test_every_result_prints_few_lines_and_is_json_of_its_schema_and_equals_its_copy(results):
    for kind, result in results.items():
        lines = repr(result).splitlines()
        assert 1 <= len(lines) <= 10, kind
        assert lines[0] == result.title, kind
        html = result._repr_html_()
        assert html.startswith("<div><b>"), kind
        assert len(html) < 100_000, kind
        console = Console(width=60, file=io.StringIO())
        with console.capture() as captured:
            console.print(*result.shown(), sep="\n")
        assert max(map(len, captured.get().splitlines())) <= 60, kind
        assert pickle.loads(pickle.dumps(result)) == result, kind
        assert result != 1, kind
        document = json.loads(as_json_text(result.data()))
        assert document, kind
        jsonschema.validate(document, result.schema())


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


def test_every_result_with_charts_has_a_figure_with_data(results):
    for kind, result in results.items():
        if kind.charts_by:
            assert all(each.has_data() for each in result.plot().axes), kind


# ------ What follows from a result's declaration: text, HTML, JSON with its schema, CSV, pictures


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


def test_a_fit_states_the_band_that_its_picture_has(fitted):
    low, high = fitted.common.band(80.0 / 3.6)
    assert f"wider: {low / 1e3:.4g} to {high / 1e3:.4g} kN at 80 km/h" in fitted.notes[0]


def test_trips_of_one_doubt_share_a_sentence(fitted):
    first = replace(fitted.trips[0], notes=("no wheel is recorded",))
    both = replace(fitted, trips=(first, replace(first, trip="other")))
    assert f"{first.trip}, other: no wheel is recorded" in both.notes


def test_names_are_broken_before_numbers():
    table = new_table("", Column("train"), Column("at 80 km/h"), Column("note"))
    table.add_cells("one more train", "9.47 ± 0.33", "not compared with any other")
    console = Console(width=38, file=io.StringIO())
    with console.capture() as captured:
        console.print(table)
    assert "9.47 ± 0.33" in captured.get()


def test_a_narrow_terminal_leaves_out_the_least_important_columns_and_names_them():
    (table,) = runs().tables()
    for width, shown, left_out in (
        (80, "80.0 ± 2.0", ""),
        (34, "80.0 ± 2.0", "not shown in 34 columns: adhesion"),
        (24, "72.0", "mass, t, adhesion"),
    ):
        console = Console(width=width, file=io.StringIO())
        with console.capture() as captured:
            console.print(table)
        words = " ".join(captured.get().split())
        assert shown in words
        assert left_out in words
        assert ("not shown" in words) == (width < 80)
