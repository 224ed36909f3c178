"""Results as values: compared, kept, handed to the next function."""

from __future__ import annotations

import json
import pickle

import numpy as np
import pytest

import analysis
import trainlog
from analysis.reports.page import Page, Section
from trainlog.values import same_values

pytestmark = pytest.mark.usefixtures("remembered_estimates")

LOG = trainlog.sample("nonstop.mcap")


@pytest.fixture(scope="module")
def fitted():  # type: ignore[no-untyped-def]
    return analysis.fit([LOG])


@pytest.mark.long
def test_a_map_equals_itself_read_again_and_no_other() -> None:
    path = trainlog.sample("CH_StGallen_Wil.map")
    first, second = trainlog.read_map(path), trainlog.read_map(path)
    assert first == second
    second.layers["wet"].log_mean[3] += 1e-9
    assert first != second
    assert first != "a map"


def test_a_fit_equals_its_pickled_copy(fitted) -> None:  # type: ignore[no-untyped-def]
    (fit,) = fitted.trips
    again = pickle.loads(pickle.dumps(fit))
    assert again == fit
    again.covariance[0, 0] *= 1.001
    assert again != fit


def test_arrays_of_other_types_shapes_and_values_differ() -> None:
    assert not same_values(np.zeros(2), [0.0, 0.0])
    assert not same_values({"a": 1.0}, {"b": 1.0})
    assert not same_values((1.0, 2.0), (1.0,))
    assert same_values(np.array(["a"]), np.array(["a"]))
    assert same_values([float("nan"), None], [float("nan"), None])


def test_a_fit_goes_straight_into_set_and_calculation(fitted) -> None:  # type: ignore[no-untyped-def]
    (fit,) = fitted.trips
    wanted = analysis.parameter_set([fit])
    for given in (fit, fitted):
        found = analysis.parameter_set(given)
        assert found.configurations == wanted.configurations
        calculated = analysis.calculate(LOG, given)
        expected = analysis.calculate(LOG, wanted)
        assert calculated.total("calculated_work") == expected.total("calculated_work")
    with pytest.raises(trainlog.InputError, match=r"\(str\) was given where"):
        analysis.calculate(LOG, "params.json")


def test_a_report_of_what_is_no_path_is_refused(fitted, tmp_path) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(trainlog.InputError, match="a Fits was given where a str or Path"):
        analysis.write_report(fitted, tmp_path / "fit.html")
    assert not (tmp_path / "fit.html").exists()


def test_a_page_prints_its_contents_in_few_lines() -> None:
    picture = "<svg>" + "0" * 100_000
    page = Page("nonstop", "", [Section("Stops and stations", [picture])])
    assert "Stops and stations" in repr(page)
    assert len(repr(page)) < 1_000
    assert len(repr(page.sections[0])) < 200


def test_resistance_at_one_speed_is_a_number_and_at_several_an_array() -> None:
    curve = trainlog.RunningResistance(2000.0, 50.0, 10.0)
    assert isinstance(curve(30.0), float)
    assert json.loads(json.dumps({"resistance": curve(30)})) == {"resistance": 12500.0}
    assert curve([0.0, 30.0]).tolist() == [2000.0, 12500.0]
    assert curve(np.zeros((2, 3))).shape == (2, 3)
