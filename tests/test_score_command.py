"""The commands `trainlog map forecast` and `trainlog map score`."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from refusals import refused
from test_forecast_scores import BINS, FIRST, TRACK, evidence

from analysis.verification.scoring import Score, score_rolling
from trainlog.cli.main import run
from trainlog.cli.terminal import as_json_text
from trainlog.condition import estimated
from trainlog.errors import InputError
from trainlog.formats.mapfile import read_map, write_map
from trainlog.formats.samples import copy_samples
from trainlog.railway.condition import ConditionLayer, TrackConditionMap
from trainlog.railway.evidence import DailyEvidence

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds", "unpainted")

FORECAST = """line,layer,from [km],to [km],valid from,valid to,issued,quantile 0.05,quantile 0.5
CH_StGallen_Wil,,0,15,2024-10-07,2024-10-08,2024-10-06T18:00Z,0.08,0.2
CH_StGallen_Wil,,15,29,2024-10-07,2024-10-08,2024-10-06T18:00Z,0.1,0.25
"""


@cache
def month() -> TrackConditionMap:
    """Twelve days on a line with a place that always slips, and one that slips for three days."""
    days = []
    generator = np.random.default_rng(1)
    for day in range(12):
        met = {i: 0.08 * float(np.exp(0.05 * generator.standard_normal())) for i in range(20, 26)}
        if 5 <= day < 8:
            met |= dict.fromkeys(range(100, 104), 0.06)
        used = {i: 8 for i in range(10, BINS - 10) if i not in met}
        days.append(evidence(FIRST + day, met, used))
    layer = ConditionLayer.unestimated(DailyEvidence.total(days))
    return estimated(replace(TRACK, layers={"wet": layer}))


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = tmp_path_factory.mktemp("score")
    copy_samples(made)
    write_map(month(), made / "month.map")
    (made / "stated.csv").write_text(FORECAST)
    known = read_map(next(made.glob("CH_StGallen_Wil.map*")))
    layers = {}
    for name, layer in known.layers.items():
        one = layer.evidence
        earlier = replace(one, day=one.day - 3, used_day=one.used_day - 3)
        layers[name] = ConditionLayer.unestimated(earlier)
    write_map(estimated(replace(known, layers=layers, trips=())), made / "earlier.map")
    return made


@pytest.fixture
def scored(works: Callable[..., str]) -> Callable[..., dict[str, Any]]:
    return lambda *words: json.loads(works("map", "score", *words, "--json"))


@cache
def first_days() -> TrackConditionMap:
    """The month up to its seventh day, not estimated."""
    known = month().layer("wet").evidence.between(0, FIRST + 6)
    return replace(month(), layers={"wet": ConditionLayer.unestimated(known)})


@pytest.fixture(scope="module")
def first_scored() -> Score:
    return score_rolling(first_days())


@pytest.fixture(scope="module")
def rolling() -> tuple[Score, list[tuple[int, int]]]:
    """The month scored day by day, and the days that were reported meanwhile."""
    days: list[tuple[int, int]] = []
    return score_rolling(month(), None, lambda *each: days.append(each)), days


def test_each_day_is_forecast_from_the_days_before_alone(rolling, first_scored):
    found, days = rolling
    long = found.layers["wet"]
    assert list(dict.fromkeys(days)) == [(day, 11) for day in range(1, 12)]
    short = first_scored.layers["wet"]
    # What came later does not change how a day was forecast; only the demand uses all days.
    np.testing.assert_allclose(long.scores[: short.days.size, 0], short.scores[:, 0])
    assert long.days[0] == FIRST + 1
    # The spot of three days was not foreseen on its first day.
    spot, steady = (np.flatnonzero(long.days == FIRST + day)[0] for day in (5, 4))
    assert long.alarms[spot, 0, 4] < long.slips[spot]
    assert long.alarms[steady, 0, 4] == long.slips[steady] == 6.0
    # Nor does persistence know it before its second day.
    persistence = long.scores[:, 2, 0]
    assert persistence[spot] < 0.0 < persistence[[steady, spot + 1]].min()


def test_a_map_is_scored_day_by_day(folder, first_scored, scored):
    picture = folder / "score.png"
    write_map(estimated(first_days()), folder / "first.map")
    found = scored(folder / "first.map", "--rolling", "--picture", picture)
    assert picture.exists()
    wet = found["layers"]["wet"]
    assert wet["days"] == first_scored.layers["wet"].days.size == 6
    assert wet["log_score_onsets_gain_over_prior_low"] > 0.0
    common = {"command": "map score", "status": 0, "written": [str(picture)]}
    assert json.loads(as_json_text(first_scored.data())) | common == found


def test_the_forecast_of_anyone_is_scored(folder, scored):
    path = folder / "forecast.csv"
    path.write_text(FORECAST)
    found = scored(path, folder / "stopping.mcap", folder / "nonstop.mcap")
    whole = found["layers"]["all"]
    assert whole["onsets"] > 0
    # Beyond km 29 nothing is forecast, and on another day nothing at all.
    assert whole["unknown_used"] > 0
    path.write_text(
        FORECAST.replace("2024-10-08", "2024-10-09").replace("2024-10-07", "2024-10-08")
    )
    silent = scored(path, folder / "stopping.mcap")["layers"]["all"]
    assert silent["onsets"] == 0
    assert silent["log_score_onsets"] is None
    assert (silent["days"], silent["days_known"], silent["train_km_known"]) == (1, 0, 0.0)
    outside = "1 of 1 day (1 of 1 trip) lie outside the forecast's validity, 2024-10-08T00:00Z to"
    words = scored(path, folder / "stopping.mcap", "--picture", folder / "silent.png")
    assert words["notes"][0].startswith(outside)
    path.write_text(FORECAST.replace("CH_StGallen_Wil", "Foo").replace(",15,29,", ",15,99,"))
    with pytest.raises(InputError, match=r"2 problems: .*line 2: .*'Foo'.*line 3: .*'Foo'"):
        run(["map", "score", str(path), str(folder / "stopping.mcap")])


def test_a_rail_condition_that_the_forecast_lacks_is_refused_and_another_than_the_logs_stated(
    folder, scored
):
    known, log, path = folder / "earlier.map", folder / "stopping.mcap", folder / "wet.csv"
    path.write_text(FORECAST.replace(",,", ",wet,"))
    for forecast, layer, words in (
        (known, "snow", r"has no layer 'snow'; layers present: .*wet"),
        (path, "snow", r"no row for rail condition 'snow'; rail conditions present: wet"),
        (path, "wett", r"did you mean 'wet'\?"),
    ):
        refused(InputError, words, run, ["map", "score", str(forecast), str(log), "--layer", layer])
    path.write_text(FORECAST)
    found = scored(path, log, "--layer", "leaves")
    assert found["notes"][0] == (
        "trip 'trip-03': scored in 'leaves' as given; the log states 'wet'"
    )
    path.write_text(FORECAST.replace(",,", ",dry,"))
    notes = scored(path, log)["notes"]
    assert notes[0] == "no forecast for rail condition 'wet': there all is unknown"


def test_a_maps_forecast_in_a_file_scores_as_the_map(folder, scored, works):
    path, known = folder / "own.csv", folder / "earlier.map"
    works("map", "forecast", known, "--at", "2024-10-07", "--hours", "24", "-o", path)
    stated = scored(known, folder / "stopping.mcap")
    assert stated["notes"][0].startswith("1 day: too few for bands")
    own = stated["layers"]["all"]
    file = scored(path, folder / "stopping.mcap")["layers"]["all"]
    assert file["onsets"] == own["onsets"]
    assert file["used"] == own["used"]
    for what in ("onsets", "used"):
        one, other = (each[f"log_score_{what}"] for each in (own, file))
        assert one == pytest.approx(other, abs=0.1)


@pytest.mark.parametrize(
    ("words", "problem"),
    [
        (("month.map", "--rolling", "--weather", "stopping.mcap"), "leave out --weather"),
        (("month.map",), "nothing to compare the forecast with"),
        (("month.map", "stopping.mcap", "--rolling"), "scores a map on its own days"),
        (("stated.csv", "--rolling"), "scores a map on its own days"),
        (("month.map", "--rolling", "--layer", "dry"), "no layer 'dry'"),
        (("month.map", "stopping.mcap"), "no trip|is of line"),
    ],
)
def test_what_cannot_be_scored_is_refused(folder, words, problem):
    names = [str(folder / word) if "." in word else word for word in words]
    refused(InputError, problem, run, ["map", "score", *names])
