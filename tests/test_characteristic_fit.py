"""Fits of adhesion characteristics to measured points, and their files."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from simulated_line import flirt, hilly_line
from test_adhesion_characteristic import eurosprinter

import trainlog
from analysis import fit_adhesion_characteristic
from trainlog.cli.main import run
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.characteristic import CharacteristicFile, read_adhesion_points
from trainlog.formats.declared import file_content, thing_from_bytes, thing_to_bytes
from trainlog.railway.adhesion import (
    AdhesionCharacteristic,
    AdhesionPoints,
    AdhesionTable,
    CreepCurve,
    PolachCurve,
    creep_coefficients,
    polach_curve,
)
from trainlog.simulation import draw_scenarios


def magic_formula(slips: np.ndarray, maximum: float, optimum: float, form: float) -> np.ndarray:
    """Pacejka's curve: a form that no family of the fit has."""
    stiffness = np.tan(np.pi / (2.0 * form)) / optimum
    return maximum * np.sin(form * np.arctan(stiffness * slips))


@pytest.mark.parametrize(("curve", "optimum"), [(1, (0.0034, 0.016)), (2, (0.013, 0.019))])
def test_the_eurosprinter_curves(curve: int, optimum: tuple[float, float]) -> None:
    """At most 2 % of the maximum (RMS), where the plant's own shape misses by more than half."""
    creepage, adhesion = eurosprinter(curve)
    fit = fit_adhesion_characteristic(AdhesionPoints(creepage, adhesion), speed=10.0)
    found = fit.characteristic.over_creepage(creepage, 10.0)
    residual = np.sqrt(np.mean((found - adhesion) ** 2)) / adhesion.max()
    assert residual < 0.006
    assert fit.rms[fit.family] == pytest.approx(residual, rel=0.02)
    assert abs(fit.maximum - adhesion.max()) < 1.96 * fit.maximum_std < 0.01
    assert optimum[0] < fit.optimal_slip < optimum[1]
    assert fit.optimal_band[0] < creepage[np.argmax(adhesion)] < fit.optimal_band[1]
    a, b, scale = creep_coefficients(adhesion.max())
    slip = 10.0 * creepage
    own = scale * (np.exp(-a * slip) - np.exp(-b * slip))
    assert np.sqrt(np.mean((own - adhesion) ** 2)) / adhesion.max() > 0.5
    other = fit_adhesion_characteristic(AdhesionPoints(creepage, adhesion), "exponentials")
    assert other.rms["exponentials"] < 0.0225
    assert 1.96 * other.maximum_std > abs(other.maximum - adhesion.max())


def drawn(seed: int) -> tuple[AdhesionPoints, float, float, float]:
    """Points of a random curve of another form, with noise; its maximum, optimum, and speed."""
    rng = np.random.default_rng(seed)
    maximum, form = rng.uniform(0.05, 0.4), rng.uniform(1.2, 1.85)
    optimum, count = np.exp(rng.uniform(np.log(0.005), np.log(0.08))), int(rng.integers(12, 50))
    slips = np.linspace(0.05, rng.uniform(2.0, 10.0), count) * optimum
    noise = rng.choice([0.0, 0.01, 0.03]) * maximum * rng.uniform(0.5, 2.0, count)
    adhesions = magic_formula(slips, maximum, optimum, form)
    adhesions += noise * rng.standard_normal(count)
    order = rng.permutation(count)
    speed = rng.uniform(5.0, 40.0)
    return AdhesionPoints(slips[order], adhesions[order]), maximum, optimum, speed


def test_bands_hold_the_truth_of_curves_of_another_form() -> None:
    held, found, refused = [], [], 0
    for seed in range(10):
        points, maximum, optimum, speed = drawn(seed)
        try:
            fit = fit_adhesion_characteristic(points, speed=speed)
        except NotIdentifiableError:
            refused += 1
            continue
        low, high = fit.optimal_band
        held.append([abs(fit.maximum - maximum) < 1.96 * fit.maximum_std, low < optimum < high])
        found.append(fit.maximum / maximum - 1.0)
    assert refused <= 1
    assert np.all(np.mean(held, axis=0) >= 0.9)
    assert np.median(np.abs(found)) < 0.01


# --------------------------------------------------------------------------------------- files

CURVES = st.one_of(
    st.builds(
        lambda a, more, c, variable: CreepCurve(a, a * more, c, c, variable),
        st.floats(1e-3, 10.0), st.floats(1.1, 1e3), st.floats(0.01, 2.0),
        st.sampled_from(["creepage", "slip speed"]),
    ),
    st.builds(
        lambda k, held, ratio, mu, a, b: PolachCurve(k, held, ratio * held, mu, a, b),
        st.floats(1.0, 1e3), st.floats(0.01, 1.0), st.floats(0.01, 1.0), st.floats(0.01, 1.4),
        st.floats(0.01, 1.0), st.floats(0.0, 10.0),
    ),
    st.builds(
        lambda steps, adhesions, variable: AdhesionTable(
            np.cumsum(steps[: len(adhesions)]), np.array(adhesions[: len(steps)]), variable
        ),
        st.lists(st.floats(1e-4, 0.1), min_size=8, max_size=8),
        st.lists(st.floats(0.001, 1.0), min_size=3, max_size=8),
        st.sampled_from(["creepage", "slip speed"]),
    ),
)  # fmt: skip


@settings(max_examples=60)
@given(CURVES)
def test_files_give_back_what_was_written(curve: AdhesionCharacteristic) -> None:
    data = thing_to_bytes(CharacteristicFile.of(curve, {}))
    again = thing_from_bytes(CharacteristicFile, data).characteristic
    assert thing_to_bytes(CharacteristicFile.of(again, {})) == data
    assert type(again) is type(curve)
    slips = np.geomspace(1e-4, 0.9, 20)
    np.testing.assert_allclose(again(slips, 20.0), curve(slips, 20.0), rtol=1e-9)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"table_over_creepage": None, "polach": None}, "describes 0 characteristics"),
        ({"polach": {"stiffness": 300}}, "300 has no unit"),
        ({"friction": 0.3}, "unknown key 'friction'"),
        ({"version": 2}, "version 2 is newer"),
    ],
)
def test_files_that_are_no_characteristic_are_refused(
    change: dict[str, object], message: str
) -> None:
    content = file_content(CharacteristicFile.of(polach_curve("wet"), {})) | change
    content = {key: value for key, value in content.items() if value is not None}
    with pytest.raises(InputError, match=message) as caught:
        thing_from_bytes(CharacteristicFile, json.dumps(content).encode(), "wet.json")
    assert "wet.json" in str(caught.value)


def written(folder: Path, text: str) -> Path:
    path = folder / "curve.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_points_in_the_units_of_their_header(tmp_path: Path) -> None:
    braking = written(tmp_path, "slip speed [km/h]\tmu [%]\tspeed [km/h]\n-3,6\t-12\t72\n")
    points = read_adhesion_points(braking)
    assert (points.slips.item(), points.adhesions.item()) == pytest.approx((1.0, 0.12))
    assert points.speeds is not None
    assert points.speeds.item() == pytest.approx(20.0)
    assert points.variable == "slip speed"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("creepage;adhesion\n1;0.2\n", "'creepage' has no unit"),
        ("creepage [1];adhesion\n1;0.2\n4;0.2\n", r"beyond 2 \(200 %\).*state its unit"),
        (
            "creepage [%];adhesion\n1;0.2\n2;20\n",
            r"line 3, column 'adhesion': 20 is not below 1.5; state its unit",
        ),
        (
            "creepage [%];adhesion\n1;0.2\n2;nan\n",
            r"line 3, column 'adhesion': 'nan' is not a number",
        ),
        ("creepage [%];adhesion\n1;-0.2\n", r"line 2: slip and adhesion have opposite signs"),
        ("creepage [%];adhesion\n1;x\n", r"line 2, column 'adhesion': 'x' is not a number"),
        ("force [kN];adhesion\n1;0.2\n", "'kN' cannot be read as m/s"),
        ("creepage [%]\n1\n", "has 1 column, expected"),
    ],
)
def test_tables_that_would_mislead_are_refused(tmp_path: Path, text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_adhesion_points(written(tmp_path, text))


@pytest.mark.usefixtures("unpainted")
def test_from_measured_points_to_a_trip_on_that_rail(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    slips = np.linspace(0.2, 20.0, 40)
    adhesions = magic_formula(slips, 0.2, 2.0, 1.5)
    rows = "\n".join(f"{s:.3f};{mu:.5f};72" for s, mu in zip(slips, adhesions, strict=True))
    path = written(tmp_path, f"creepage [%];adhesion;speed [km/h]\n{rows}\n")
    output = tmp_path / "rail.json"
    assert run(["fit", "adhesion", str(path), "-o", str(output)]) == 0
    shown = capsys.readouterr().out
    stated = re.search(r"maximum adhesion +([0-9.]+) ± ", shown)
    assert stated is not None
    assert float(stated[1]) == pytest.approx(0.2, rel=0.01)
    assert output.with_suffix(".png").is_file()
    rail = trainlog.read_characteristic(output)
    assert rail.optimal_creepage(20.0) == pytest.approx(0.02, rel=0.1)
    content = json.loads(output.read_bytes())
    assert content["provenance"]["maximum"] == pytest.approx(0.2, rel=0.01)

    # The command hands it to the plant; a short line keeps the test short.
    scenarios = draw_scenarios(hilly_line(), flirt(), 3, seed=1)[2:]
    monkeypatch.setattr("trainlog.simulation.draw_scenarios", lambda *_, **__: scenarios)
    folder = tmp_path / "trips"
    arguments = [
        "simulate",
        "drive",
        "--count",
        "1",
        "--characteristic",
        str(output),
        "-o",
        str(folder),
    ]
    arguments += ["--line", "sample", "--train", "sample"]
    assert run(arguments) == 0
    (log,) = folder.glob("*.mcap")
    truth = json.loads(trainlog.read(log).attachments["scenario.json"])
    assert truth["characteristic"]["polach"] == content["polach"]
    assert run([*arguments[:5], "polach-dry", *arguments[6:]]) == 0
    with pytest.raises(InputError, match="'icy' is unknown; give a file, or one of polach-dry"):
        run([*arguments[:5], "icy", *arguments[6:]])


def test_slip_speeds_of_a_train_of_known_speed_are_fitted_over_creepage() -> None:
    slip = np.linspace(0.02, 4.0, 40)
    wet = polach_curve("wet")
    points = AdhesionPoints(slip, wet(slip, 15.0), "slip speed")
    known = fit_adhesion_characteristic(points, speed=15.0)
    assert known.family == "polach"
    assert known.maximum == pytest.approx(float(wet.maximum(15.0)), rel=2e-3)
    assert known.optimal_slip == pytest.approx(float(wet.optimal_slip_speed(15.0)), rel=0.05)
    unknown = fit_adhesion_characteristic(points)
    assert unknown.family == "exponentials"
    assert any("without the train's speed" in each for each in unknown.findings)
    with pytest.raises(NotIdentifiableError, match="without the train's speed"):
        fit_adhesion_characteristic(points, "polach")
