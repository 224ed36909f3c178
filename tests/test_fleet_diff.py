"""What changed between two versions over a fleet: found where it is, and nowhere else."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from refusals import refused

from analysis.fleet.analyses import ANALYSES, computation_of
from analysis.fleet.diff import FleetDiff, Results, Version, compared, typed_parameters
from analysis.fleet.maps import evidence_of_row
from analysis.fleet.update import UpdateOptions, update_fleet
from analysis.view import TripView, view_of
from trainlog.catalogue import Computation, open_catalogue
from trainlog.errors import InputError
from trainlog.formats.mapfile import packed_evidence

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")

SIDES = tuple(Version(name, {"made up": Computation("made up", name)}) for name in "ab")

DAY = pd.Timestamp("2026-01-01", tz="UTC")


def made_up(trains: int = 5, trips: int = 40, seed: int = 1) -> pd.DataFrame:
    """A mass with its band, and an energy without, of each trip."""
    generator = np.random.default_rng(seed)
    count = trains * trips
    std = generator.uniform(100.0, 300.0, count)
    return pd.DataFrame(
        {
            "key": [f"{number:05d}" for number in range(count)],
            "trip": [f"trip-{number}" for number in range(count)],
            "train": [f"unit-{number // trips}" for number in range(count)],
            "kind": "unit",
            "line": [f"line {number % 3}" for number in range(count)],
            "start": DAY,
            "mass": 1e5 + std * generator.standard_t(4.0, count),
            "mass_std": std,
            "energy": generator.uniform(1e8, 2e8, count),
            "source": "recorded",
        }
    )


def outcomes_of(table: pd.DataFrame, refused: tuple[str, ...] = ()) -> pd.DataFrame:
    found = table[["key", "trip", "train", "kind", "line", "start"]].drop_duplicates("key")
    found = found.rename(columns={"trip": "name"})
    states = ["refused" if key in refused else "done" for key in found["key"]]
    reasons = ["too short" if key in refused else "" for key in found["key"]]
    return found.assign(state=states, reason=reasons)


def difference(one: pd.DataFrame, other: pd.DataFrame, name: str = "made up") -> FleetDiff:
    sides = (Results(each, outcomes_of(each)) for each in (one, other))
    return compared(*SIDES, {name: tuple(sides)})


def changed(column: str, change: Callable[[np.ndarray], np.ndarray]) -> FleetDiff:
    table = made_up()
    return difference(table, table.assign(**{column: change(table[column].to_numpy())}))


@pytest.mark.parametrize(
    ("column", "factor", "kind"),
    [
        ("mass", 1.0, "same"),
        ("mass", 1.0 + 1e-8, "rounding"),
        ("mass", 1.0 + 1e-4, "within"),
        ("mass", 1.01, "beyond"),
        ("energy", 1.0 + 1e-7, "rounding"),
        ("energy", 1.005, "within"),
        ("energy", 1.02, "beyond"),
        ("mass_std", 1.2, "within"),
    ],
)
def test_a_difference_is_of_the_class_that_its_band_gives(column, factor, kind):
    found = changed(column, lambda values: factor * values)
    assert found.trip_counts[kind].tolist() == [200]
    assert found.same == (kind == "same")
    if found.same:
        assert found.sentence == "every result of 200 trips is the same to the byte."
    assert found.beyond == (kind == "beyond")
    assert len(found.moved) == (200 if found.beyond else 0)
    if column == "mass_std":
        rows = found.estimates.set_index("estimate")
        assert rows.loc["mass", "band_ratio"] == pytest.approx(1.2)


def test_a_shift_too_small_for_any_trip_is_found_in_the_mean_of_its_train_alone():
    table = made_up()
    generator = np.random.default_rng(2)
    noise = 0.1 * table["mass_std"] * generator.standard_t(3.0, len(table))
    shifted = 0.7 * table["mass_std"] * (table["train"] == "unit-3")
    found = difference(table, table.assign(mass=table["mass"] + noise + shifted))
    assert len(found.moved) <= 2, "single trips but for the farthest of the noise are within"
    means = found.means[(found.means["of"] == "train") & found.means["beyond"]]
    assert means["name"].tolist() == ["unit-3"]
    shift, std = means[["shift", "shift_std"]].to_numpy()[0]
    own = table[table["train"] == "unit-3"]
    weight = own["mass_std"] ** -2
    assert shift == pytest.approx(
        float(0.7 * (weight * own["mass_std"]).sum() / weight.sum()), abs=4 * std
    )
    assert "unit-3" in [row["name"] for row in found.facts()["means"]]


def test_differences_that_scatter_around_zero_are_rarely_called_systematic():
    """Of twenty comparisons with 50 trains each, at a rate of one in twenty."""
    called = 0
    for seed in range(20):
        table = made_up(trains=50, trips=6, seed=seed)
        generator = np.random.default_rng(1_000 + seed)
        noise = 0.2 * table["mass_std"] * generator.standard_t(3.0, len(table))
        found = difference(table, table.assign(mass=table["mass"] + noise))
        called += bool(found.means["systematic"].any())
    assert called <= 4


def test_trips_that_one_side_alone_accepts_are_listed_with_the_reason():
    table = made_up()
    left = Results(table, outcomes_of(table))
    kept = table[~table["key"].isin(["00003", "00100"])]
    right = Results(kept, outcomes_of(table, refused=("00003", "00100")))
    found = compared(*SIDES, {"made up": (left, right)})
    assert found.verdicts[["trip", "first", "second"]].to_numpy().tolist() == [
        ["trip-3", "done", "refused: too short"],
        ["trip-100", "done", "refused: too short"],
    ]
    assert found.beyond
    assert found.trip_counts["beyond"].tolist() == [2]
    again = compared(*SIDES, {"made up": (right, left)})
    assert again.verdicts["first"].tolist() == 2 * ["refused: too short"]


@pytest.fixture(scope="module")
def adhesion() -> pd.DataFrame:
    """What the two sample trips show of the maximum adhesion."""
    frames = []
    for name in ("nonstop", "stopping"):
        trip = view_of(f"sample_logs/{name}.mcap")
        about = {"key": name, "train": "unit-1", "kind": "unit", "line": trip.line.name}
        frames.append(ANALYSES["adhesion"].table(trip).assign(**about, start=DAY))
    return pd.concat(frames, ignore_index=True)


def test_evidence_that_one_side_alone_has_is_listed_by_trip(adhesion):
    refused_all = outcomes_of(adhesion, refused=tuple(adhesion["key"]))
    sides = (
        Results(adhesion, outcomes_of(adhesion)),
        Results(pd.DataFrame({"key": []}), refused_all),
    )
    found = compared(*SIDES, {"adhesion": sides})
    assert found.verdicts["second"].tolist() == 2 * ["refused: too short"]
    assert found.places.empty


def test_a_place_of_the_map_that_moved_is_named(adhesion):
    def with_more_adhesion(data: bytes) -> bytes:
        """The same evidence, but for more adhesion at the onsets of 18 to 21 km."""
        daily = evidence_of_row(data)
        there = (daily.bin >= 720) & (daily.bin < 840)
        log = daily.weighted_log / np.where(daily.weight > 0.0, daily.weight, 1.0)
        moved = np.where(there, log + 0.4, log)
        changed = {"weighted_log": moved * daily.weight, "weighted_square": moved**2 * daily.weight}
        return zlib.compress(packed_evidence(replace(daily, **changed)))

    wet = adhesion["layer"] == "wet"
    changed = adhesion["evidence"].where(~wet, adhesion["evidence"].map(with_more_adhesion))
    found = difference(adhesion, adhesion.assign(evidence=changed), "adhesion")
    assert found.beyond
    places = found.places
    assert set(places["layer"]) == {"wet"}
    assert places["from_km"].min() > 17.0
    assert places["to_km"].max() < 22.0
    assert (places["second"] > 1.2 * places["first"]).all()
    assert "Places of the track-condition map" in " ".join(
        str(each.title) for each in found.tables()
    )


def counts_of(columns: dict[str, np.ndarray], name: str) -> pd.DataFrame:
    """A result of an analysis with its counts, of as many trips as there are."""
    table = made_up()
    count = len(next(iter(columns.values())))
    return table[["key", "trip", "train", "kind", "line", "start"]].head(count).assign(**columns)


def test_a_count_moves_beyond_its_band_by_more_than_its_chance():
    """Of n repairs the standard deviation by chance is the root of n; of none that of one."""
    before = np.array([0, 0, 1, 4, 100, 100, 10_000])
    after = np.array([1, 2, 2, 8, 119, 120, 10_195])
    found = difference(
        counts_of({"repairs": before}, "checks"), counts_of({"repairs": after}, "checks"), "checks"
    )
    moved = found.moved.set_index("trip")
    assert sorted(moved.index) == ["trip-1", "trip-3", "trip-5"]
    assert moved.loc["trip-5", "bands"] == pytest.approx(20 / (1.96 * 10))
    assert not moved["banded"].any()
    assert "figures without a band" in found.sentence


def test_what_parameters_change_by_definition_is_not_compared():
    columns = {"bins": np.array([40, 30, 20]), "bin_length": 25.0, "weight": 10.0}
    columns |= {"weighted_log": np.array([-20.0, -18.0, -16.0])}
    one = counts_of(columns, "adhesion")
    finer = one.assign(bins=one["bins"] // 2, bin_length=50.0)
    found = difference(one, finer, "adhesion")
    assert found.by_definition == ("number of bins",)
    assert not found.beyond
    assert "not compared, as the parameters change it: number of bins" in found.sentence
    # Of the same bins their number is compared, and so is the adhesion of the onsets.
    fewer = difference(one, finer.assign(bin_length=25.0), "adhesion")
    assert set(fewer.moved["estimate"]) == {"bins"}
    slipperier = difference(one, one.assign(weighted_log=one["weighted_log"] - 10.0), "adhesion")
    assert set(slipperier.moved["estimate"]) == {"maximum adhesion"}
    assert slipperier.moved["second"].max() == pytest.approx(np.exp(-2.6))
    assert slipperier.moved["bands"].min() == pytest.approx((np.e - 1) / 1.96 * 10**0.5)


# ------------------------------------------------------------------------------------- the command


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A catalogue of the sample trips."""
    place = tmp_path_factory.mktemp("fleet") / "catalogue"
    with open_catalogue(place) as catalogue:
        catalogue.add("sample_logs")
    return place


def test_results_of_other_code_that_differ_are_named(place, tmp_path, monkeypatch, shell):
    """By code whose checks state durations that are 2 % too long."""
    checks = ANALYSES["checks"]

    def longer(trip: TripView, **given: object) -> pd.DataFrame:
        return checks.table(trip).assign(duration=1.02 * checks.table(trip)["duration"])

    with monkeypatch.context() as patch, open_catalogue(place) as catalogue:
        other = replace(computation_of(checks), code="0123456789abcdef")
        patch.setattr("analysis.fleet.update.computation_of", lambda _: other)
        update_fleet(catalogue, [replace(checks, run=longer)], UpdateOptions(workers=0))
    words = ("--catalogue", place, "--analysis", "checks", "--workers", 0)
    status, printed, complaint = shell(
        "fleet", "diff", "now", "01234567", *words, "-o", tmp_path / "changes", "--json"
    )
    assert (status, complaint) == (1, "")
    found = json.loads(printed)
    assert {(each["estimate"], each["trip"]) for each in found["moved"]} == {
        ("duration", "trip-01"), ("duration", "trip-03"),
    }  # fmt: skip
    moved = [each["second"] / each["first"] for each in found["moved"]]
    assert moved == pytest.approx([1.02, 1.02])
    assert len(pd.read_csv(tmp_path / "changes" / "moved.csv")) == 2
    assert shell("fleet", "diff", "01234567", "now", *words)[0] == 1
    assert shell("fleet", "diff", "now", "now", *words)[0] == 0


def test_parameters_that_change_the_bins_of_a_map(place, tmp_path, shell):
    words = ("--catalogue", place, "--workers", 0, "--trips", "weather = 'wet'")
    words += ("-o", tmp_path / "changes")
    status, shown, _ = shell("fleet", "diff", "now", "adhesion.bin_length=50", *words)
    assert status == 0, "no estimate moved beyond its band"
    assert "as the parameters change it: number of bins." in shown
    assert "weighted_log" not in shown, "sums over other bins differ by definition"
    assert "resistance" not in shown, "the other analyses have no other parameters"
    assert "<h2>" in (tmp_path / "changes" / "diff.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("side", "message"),
    [
        ("no-such-version", "no results of a version 'no-such-version'; it has results of: "),
        ("adhesion.bins=3", "has no parameter 'bins'; it has bin_length"),
        (
            "adhesion.bin_length=-5",
            "adhesion.bin_length is -5; give a positive number, in SI units",
        ),
        ("adhesion.bin_length=x", "adhesion.bin_length is 'x'; give a positive number"),
        ("resistance.speeds=30", "resistance.speeds is 30; give two numbers, as [5, 40]"),
        ("resistance.speeds=[40, 5]", "speeds is [40, 5]; give two numbers, as [5, 40]"),
    ],
)
def test_what_is_no_version_is_refused(place, side, message, shell):
    refused(InputError, r"no analysis 'resistence'.*resistance", typed_parameters, "resistence.a=3")
    refused(InputError, r"'speeds=3' is not a parameter", typed_parameters, "speeds=3")
    status, _, complaint = shell("fleet", "diff", "now", side, "--catalogue", place)
    assert (status, complaint.count("\n")) == (2, 1)
    assert message in complaint


def test_texts_that_differ_are_listed_but_no_estimate_moved():
    table = made_up()
    other = table.assign(
        source=["assumed" if key == "00007" else "recorded" for key in table["key"]]
    )
    found = difference(table, other)
    assert not found.beyond
    assert found.words[["trip", "estimate", "second"]].to_numpy().tolist() == [
        ["trip-7", "source", "assumed"]
    ]
