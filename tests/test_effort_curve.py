"""Effort over speed: curves, where they come from, and how a train reads them."""

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from contents import put
from format_examples import effort_curves
from hypothesis import given, settings, strategies as st
from refusals import refused

from trainlog import DEFAULT_TRAIN, InputError, read_train, sample, write_train
from trainlog.formats import osrd, railtoolkit
from trainlog.formats.csv_tables import read_effort_curve
from trainlog.formats.imports import import_file
from trainlog.railway import EffortCurve

DATA = Path(__file__).parents[2] / "shared" / "data"
SHARED = pytest.mark.skipif(not DATA.is_dir(), reason="the shared data are not here")
FLIRT = read_train(sample(DEFAULT_TRAIN))
CURVE = EffortCurve(np.array([0.0, 10.0, 30.0]), np.array([100e3, 80e3, 20e3]))
quick = settings(max_examples=30)


# ---- the curve ----------------------------------------------------------------------------------


@quick
@given(effort_curves(1.0))
def test_its_approximations_bound_it(curve):
    fastest = 1.3 * float(curve.speeds[-1]) + 1.0
    v = np.unique(np.concatenate((np.linspace(0.0, fastest, 500), curve.speeds)))
    top = curve.efforts.max()
    below, dipless = curve.without_rise(v), curve.without_dip(v)
    assert np.all(below <= curve(v) + 1e-9 * top)
    assert np.all(np.diff(below) <= 1e-9 * top)
    assert np.all(dipless <= curve(v) + 1e-9 * top)
    slopes = np.diff(dipless)
    rising = np.flatnonzero(slopes > 1e-9 * top)
    assert rising.size == 0 or np.all(slopes[: rising[-1]] >= -1e-9 * top)
    _, offsets, powers = curve.tangents(fastest)
    with np.errstate(divide="ignore", invalid="ignore"):
        above = np.where(powers > 0.0, offsets + powers / v[1:, None], offsets).min(axis=1)
    assert np.all(powers >= 0.0)
    assert np.all(above >= curve(v[1:]) - 1e-9 * top)


@quick
@given(effort_curves(1.0), st.floats(0.01, 1.0))
def test_the_speed_at_an_effort_is_the_highest_that_gives_it(curve, share):
    falling = curve.without_rise
    effort = share * float(falling.efforts[0])
    speed = float(falling.speed_at(effort))
    assert falling(speed) == pytest.approx(effort, rel=1e-9)
    assert np.all(falling(speed * 1.001 + np.linspace(1e-3, 50.0, 50)) <= effort * (1.0 + 1e-9))


@pytest.mark.parametrize(
    ("speeds", "efforts", "words"),
    [
        ([0.0], [1.0], "two at least"),
        ([0.0, np.nan], [1.0, 1.0], "not a finite number"),
        ([0.0, 2.0], [1.0, np.inf], "not a finite number"),
        ([0.0, 3.0, 2.0], [1.0, 1.0, 1.0], "do not grow from 0"),
        ([0.0, 2.0], [1.0, -1.0], "negative"),
    ],
)
def test_curves_that_cannot_be_are_refused(speeds, efforts, words):
    refusal = refused(InputError, words, EffortCurve, np.array(speeds), np.array(efforts))
    assert refusal.remedy


# ---- a train with curves ------------------------------------------------------------------------


def test_the_least_of_curve_effort_and_power_counts():
    train = replace(FLIRT, traction_curve=CURVE, max_tractive_effort=90e3, max_traction_power=9e5)
    # By the largest effort, by the curve, by the power, by the curve.
    assert train.tractive_effort_limit([0.0, 10.0, 15.0, 30.0]) == pytest.approx(
        [90e3, 80e3, 60e3, 20e3]
    )
    braking = replace(FLIRT, dynamic_braking_curve=CURVE)
    assert braking.dynamic_braking_effort_limit([5.0, 30.0]).tolist() == [90e3, 20e3]


def test_a_curve_without_effort_at_standstill_is_refused():
    with pytest.raises(InputError, match="no tractive effort at standstill"):
        replace(FLIRT, traction_curve=EffortCurve(np.array([0.0, 9.0]), np.array([0.0, 1.0])))
    fading = EffortCurve(np.array([0.0, 3.0, 40.0]), np.array([0.0, 9e4, 2e4]))
    assert replace(FLIRT, dynamic_braking_curve=fading).dynamic_braking_effort_limit(0.0) == 0.0


@pytest.mark.parametrize("factor", [1e3, 1e-3])
def test_a_curve_in_another_unit_than_it_states_is_refused(factor, tmp_path):
    curve = EffortCurve(CURVE.speeds, factor * CURVE.efforts)
    write_train(replace(FLIRT, traction_curve=curve), tmp_path / "odd.train.json")
    with pytest.raises(InputError, match=r"traction_curve: its largest effort.*contradicts"):
        read_train(tmp_path / "odd.train.json")


# ---- CSV ----------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    "text",
    [
        "speed [km/h],effort [kN]\n0,100\n36,80\n108,20\n",
        "v [km/h];F_Zug [kN]\n0;100,0\n36;80\n108;20\n\n",
        "# measured\nspeed (m/s)\teffort (N)\n0\t100000\n10\t80000\n30\t20000\n",
        "\ufeffspeed [km/h];effort [kN];;\n0;100;;\n36;80;;\n108;20;;\n",
    ],
)
def test_curves_are_read_from_csv(text, tmp_path):
    found = read_effort_curve(put(tmp_path / "curve.csv", text))
    assert found.speeds == pytest.approx(CURVE.speeds)
    assert found.efforts == pytest.approx(CURVE.efforts)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("", "is empty"),
        ("speed;effort\n0;1\n", "column 'speed' has no unit"),
        ("speed [km/h];effort [kN];more [N]\n0;1;2\n", "has 3 columns"),
        ("speed [km/h];effort [kN]\n0;1\nx;2\n", "line 3, column 'speed': 'x' is not a number"),
        ("speed [km/h];effort [kN]\n0;100\n0;90\n", "speeds do not grow"),
        ("speed [km/h];effort [t]\n0;100\n9;90\n", "unit"),
        ("speed [km/h];effort [kN]\n", "two at least"),
    ],
)
def test_bad_csv_is_refused_with_the_place(text, words, tmp_path):
    refusal = refused(InputError, words, read_effort_curve, put(tmp_path / "curve.csv", text))
    assert refusal.remedy
    assert "curve.csv" in str(refusal)


# ---- OSRD and railtoolkit -----------------------------------------------------------------------


@SHARED
@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"mass": -1}, "mass"),
        ({"gamma": None}, "gamma"),
        ({"rolling_resistance": {"type": "davis", "A": 1}}, r"rolling_resistance\.B"),
        ({"effort_curves": {"default_mode": "x", "modes": {}}}, "modes"),
    ],
)
def test_bad_rolling_stock_is_refused_with_the_place(changes, words, tmp_path):
    known = json.loads((DATA / "osrd/rolling_stocks/electric_rolling_stock.json").read_text())
    (tmp_path / "stock.json").write_text(json.dumps(known | changes))
    refused(InputError, words, osrd.read_train, tmp_path / "stock.json")


@SHARED
@pytest.mark.parametrize("name", ["electric", "fast", "short_slow"])
def test_the_trains_of_osrd_are_imported(name, tmp_path):
    path = DATA / "osrd" / "rolling_stocks" / f"{name}_rolling_stock.json"
    (written,) = import_file(path, tmp_path)
    train = read_train(written.path)
    published = json.loads(path.read_text())
    curves = published["effort_curves"]
    table = curves["modes"][curves["default_mode"]]["default_curve"]
    assert train.traction_curve.speeds == pytest.approx(table["speeds"], rel=1e-13)
    assert train.traction_curve.efforts == pytest.approx(table["max_efforts"], rel=1e-13)
    assert train.tractive_effort_limit(0.0) == pytest.approx(table["max_efforts"][0])
    assert (train.mass, train.length) == (published["mass"], published["length"])
    assert any("startup_acceleration" in each for each in written.dropped)


@SHARED
def test_the_traction_units_of_railtoolkit_are_imported(tmp_path):
    folder = DATA / "rolling_stock"
    for path in (*folder.glob("traction-unit/*.yaml"), *folder.glob("multiple-unit/*.yaml")):
        vehicles, _ = railtoolkit.read_rolling_stock(path)
        (vehicle,) = vehicles.values()
        (written,) = import_file(path, tmp_path)
        train = read_train(written.path)
        v = np.linspace(0.0, train.max_speed, 77)
        assert train.tractive_effort_limit(v) == pytest.approx(vehicle.effort(v), rel=1e-9)
        assert train.resistance(20.0) == pytest.approx(vehicle.resistance(0.0)(20.0))
    with pytest.raises(InputError, match="no train in it has tractive effort"):
        import_file(folder / "freight-wagon" / "Facs124.yaml", tmp_path)
