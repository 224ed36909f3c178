"""Forecasts of adhesion as CSV: what is read, what is refused, and what they are worth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from contents import put
from refusals import refused

from analysis.verification.forecasts import forecast_of, stated_forecast
from analysis.verification.scores import climatology
from trainlog import InputError, TrackConditionMap, read_forecast, read_map, sample, write_forecast

pytestmark = pytest.mark.usefixtures("remembered")

HEADER = "line,layer,from [km],to [km],valid from,valid to,issued,quantile 0.05,quantile 0.5"
ROW = "CH_StGallen_Wil,wet,1,2,2026-11-22T00:00Z,2026-11-23T00:00Z,2026-11-21T18:00Z,0.08,0.12"
NOON = pd.Timestamp("2026-11-22T12:00Z")


@pytest.fixture(scope="module")
def track() -> TrackConditionMap:
    return read_map(sample("CH_StGallen_Wil.map"))


def written(folder: Path, *rows: str, header: str = HEADER) -> Path:
    return put(folder / "forecast.csv", (header, *rows))


def test_a_row_is_a_distribution_through_its_points(tmp_path, track):
    found = stated_forecast(read_forecast(written(tmp_path, ROW)), track)("wet", NOON)
    assert np.flatnonzero(found.observed).tolist() == list(range(40, 80))
    here = found.at_bins([50])
    assert here.below(0.08)[0] == pytest.approx(0.05, abs=0.01)
    assert here.below(0.12)[0] == pytest.approx(0.5, abs=0.03)
    # Beyond its points it is shaped as the climatology is.
    usual = climatology(track, "wet").at_bins([50])
    upper = (here.below(0.2)[0] - 0.5) / 0.5
    expected = (usual.below(0.2)[0] - usual.below(0.12)[0]) / (1.0 - usual.below(0.12)[0])
    assert upper == pytest.approx(expected, abs=0.05)


def test_a_row_holds_in_its_time_and_rail_condition_and_the_last_issued_counts(tmp_path, track):
    later = ROW.replace("2026-11-21T18:00Z", "2026-11-21T23:00Z").replace("0.12", "0.16")
    anyone = ROW.replace(",wet,", ",,").replace(",1,2,", ",0,5,").replace("0.12", "0.3")
    forecaster = stated_forecast(read_forecast(written(tmp_path, ROW, later, anyone)), track)
    found = forecaster("wet", NOON)
    assert found.below(0.16)[50] == pytest.approx(0.5, abs=0.03)
    assert found.below(0.3)[10] == pytest.approx(0.5, abs=0.03)
    dry = forecaster("dry", NOON)
    assert dry.below(0.3)[50] == pytest.approx(0.5, abs=0.03)
    assert forecaster("wet", pd.Timestamp("2026-11-23T00:00Z")) is None
    assert forecaster("wet", pd.Timestamp("2026-11-21T23:59Z")) is None


BAD = [
    (HEADER, ROW.replace(",1,2,", ",2,1,"), "line 2", "must end behind its beginning"),
    (HEADER, ROW.replace("0.08", "8"), "line 2", "not in per cent"),
    (HEADER, ROW.replace("0.08", "0"), "line 2", "an adhesion above 0"),
    (HEADER, ROW.replace("0.08", "low"), "line 2", "'low' is not a number"),
    (HEADER, ROW.replace("0.08", "0.2"), "line 2", "must grow with the adhesion"),
    (HEADER, ROW.replace("2026-11-23T00:00Z", "2026-11-21T00:00Z"), "line 2", "correct the times"),
    (HEADER, ROW.replace("2026-11-23T00:00Z", "tomorrow"), "line 2", "'tomorrow' is not a time"),
    (HEADER, ROW.replace("2026-11-21T18", "2026-11-22T18"), "line 2", "issued after"),
    (HEADER, ROW.replace("CH_StGallen_Wil", ""), "line 2", "has no line"),
    (HEADER, f"{ROW}\n{ROW.replace('CH_StGallen_Wil', 'A-B')}", "is for 2 lines", "a file a line"),
    (HEADER, ROW.replace(",wet,", ",wett,"), "line 2", "did you mean 'wet'?"),
    (HEADER, f"{ROW},0.4", "line 2", "10 cells"),
    (HEADER.replace("[km]", ""), ROW, "line 1", "has no unit"),
    (HEADER.replace("from [km]", "from [mile]"), ROW, "line 1", "in neither of km, m"),
    (HEADER.replace("valid to", "until"), ROW, "line 1", "'until' is not known"),
    (HEADER.replace("issued", "valid from"), ROW, "line 1", "are both of the valid from"),
    (HEADER.replace("0.5", "50"), ROW, "line 1", "must be between 0 and 1"),
    (HEADER, "", "has no row", "add one"),
    ("line,from [km],to [km],valid from,valid to", "A,0,1,2026-11-22,2026-11-23", "line 1", "nei"),
]


@pytest.mark.parametrize(("header", "row", "place", "words"), BAD)
def test_bad_rows_are_named(tmp_path, header, row, place, words):
    path = written(tmp_path, row, header=header)
    caught = refused(InputError, "", read_forecast, path)
    for each in (str(path), place, words):
        assert each in str(caught)


def test_all_that_is_wrong_is_listed_at_once(tmp_path):
    wrong = ROW.replace("0.08,0.12", "8,low").replace(",wet,", ",wett,").replace(",1,2,", ",2,1,")
    foo = ROW.replace("CH_StGallen_Wil", "Foo")
    path = written(tmp_path, wrong, foo, ROW.replace(",1,2,", ",1,99,"))
    caught = refused(InputError, "", read_forecast, path, "CH_StGallen_Wil", 29_525.0)
    listed = [(each.place, str(each)) for each in caught.each]
    assert [place for place, _ in listed] == [
        "line 2, column 'layer'",
        "line 2",
        "line 2, column 'quantile 0.05'",
        "line 2, column 'quantile 0.5'",
        "line 3",
        "line 4",
    ]
    for (_, words), expected in zip(
        listed,
        ("did you mean 'wet'", "must end behind", "not in per cent", "'low' is not a number",
         "is for line 'Foo'", r"reaches km 99.000"),
        strict=True,
    ):  # fmt: skip
        assert expected in words
    with pytest.raises(InputError, match=r"5 problems: .*is for 2 lines: CH_StGallen_Wil, Foo"):
        read_forecast(path)


def test_two_forecasts_of_one_place_and_time_are_refused(tmp_path, track):
    both = read_forecast(written(tmp_path, ROW, ROW.replace(",1,2,", ",1.5,3,")))
    with pytest.raises(InputError, match=r"line 3 and forecast.csv, line 2 both hold .* km 1\.500"):
        stated_forecast(both, track)("wet", NOON)


def test_a_forecast_for_another_line_is_refused(tmp_path, track):
    other = read_forecast(written(tmp_path, ROW.replace("CH_StGallen_Wil", "A-B")))
    with pytest.raises(InputError, match="is for line 'A-B', the trips ran on 'CH_StGallen_Wil'"):
        stated_forecast(other, track)
    beyond = read_forecast(written(tmp_path, ROW.replace(",1,2,", ",1,99,")))
    with pytest.raises(InputError, match=r"reaches km 99\.000, the line ends at km 29"):
        stated_forecast(beyond, track)


def test_what_a_map_expects_survives_the_file(tmp_path, track):
    path = tmp_path / "forecast.csv"
    write_forecast(forecast_of(track, NOON, hours=6.0), path)
    read = stated_forecast(read_forecast(path), track)
    for layer in track.layers:
        own, found = track.layer(layer).expected(NOON), read(layer, NOON)
        np.testing.assert_array_equal(found.observed, own.observed)
        seen = np.flatnonzero(own.observed)
        for adhesion in (0.06, 0.1, 0.15, 0.3):
            # Between two quantiles that are written, a twentieth apart or a tenth.
            np.testing.assert_allclose(
                found.at_bins(seen).below(adhesion), own.at_bins(seen).below(adhesion), atol=0.05
            )
    assert read("wet", NOON + pd.Timedelta(hours=6)) is None
    refused(InputError, "hours above 0", forecast_of, track, NOON, hours=0.0)
