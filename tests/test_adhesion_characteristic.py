"""Adhesion characteristics: families behind one interface, and the plant that runs on them."""

import csv
import json
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from contents import put
from hypothesis import assume, given, settings, strategies as st
from refusals import refused
from scipy.integrate import solve_ivp
from scipy.optimize import minimize_scalar
from simulated_line import flirt, hilly_line, level_line, steps

import trainlog
from analysis import fit_adhesion_characteristic
from analysis.adhesion.slip import onset
from estimators.adhesion import AdhesionObserver, SlipDetector, impulse, smoothed_force, train_speed
from estimators.creep_curve import estimate_creep_curve
from estimators.linear_gaussian import LinearGaussian, random_walk_slope
from trainlog import AdhesionTable, CreepCurve, PolachCurve, draw_scenarios, polach_curve
from trainlog.arrays import FloatArray
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.characteristic import CharacteristicFile, read_adhesion_points
from trainlog.formats.declared import thing_from_bytes, thing_to_bytes
from trainlog.railway import RunningResistance, StepProfile
from trainlog.railway.adhesion import (
    DRY,
    WET,
    AdhesionCharacteristic,
    AdhesionPoints,
    creep_coefficients,
)
from trainlog.simulation.dynamics import WHEELS
from trainlog.simulation.plant import Plant

CREEP = Path(__file__).parents[2] / "shared" / "data" / "creep" / "eurosprinter_creep_curves.csv"


def eurosprinter(curve: int) -> np.ndarray:
    """Creepages, adhesions and rolling speeds [m/s] of one of CONTACT's curves, (3, 30)."""
    if not CREEP.exists():
        pytest.skip("the CONTACT creep curves are not beside the checkout")
    with CREEP.open(encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["curve"] == str(curve)]
    names = ("long_creepage", "traction_coeff", "rolling_speed_mps")
    return np.array([[float(row[name]) for name in names] for row in rows]).T


def polach_adhesion(creepage: float, speed: float, condition: str) -> float:
    """Polach (2005), eqs. (2) to (6), with its table 1, written once more from the paper."""
    k_a, k_s, mu_0, a, b = {
        "dry": (1.00, 0.40, 0.55, 0.40, 0.60),
        "wet": (0.30, 0.10, 0.30, 0.40, 0.20),
    }[condition]
    mu = mu_0 * ((1.0 - a) * np.exp(-b * creepage * speed) + a)
    eps = np.pi / 4.0 * 300.0 * creepage / mu
    return 2.0 * mu / np.pi * (k_a * eps / (1.0 + (k_a * eps) ** 2) + np.arctan(k_s * eps))


FAMILIES: dict[str, AdhesionCharacteristic] = {
    "wet rail of Zhao et al.": WET,
    "double exponential over creepage": CreepCurve(2.46, 203.0, 0.325, 0.325, "creepage"),
    "Polach, dry": polach_curve("dry"),
    "Polach, wet": polach_curve("wet"),
    "table over creepage": AdhesionTable(
        np.array([0.004, 0.01, 0.016, 0.05, 0.25]), np.array([0.20, 0.30, 0.31, 0.28, 0.19])
    ),
    "table over slip speed": AdhesionTable(
        np.array([0.05, 0.2, 0.5, 2.0]), np.array([0.10, 0.15, 0.14, 0.1]), "slip speed"
    ),
}

family = pytest.mark.parametrize("curve", FAMILIES.values(), ids=FAMILIES.keys())


@pytest.mark.parametrize("condition", ["dry", "wet"])
@pytest.mark.parametrize("speed", [5.0, 20.0, 60.0])
def test_polach_with_the_published_parameters(condition, speed):
    curve = polach_curve(condition)
    creepages = np.geomspace(1e-4, 0.5, 50)
    expected = [polach_adhesion(s, speed, condition) for s in creepages]
    np.testing.assert_allclose(curve.over_creepage(creepages, speed), expected, rtol=1e-12)
    best = minimize_scalar(
        lambda s: -polach_adhesion(s, speed, condition), bounds=(1e-4, 0.1), method="bounded",
        options={"xatol": 1e-9},
    )  # fmt: skip
    assert curve.maximum(speed) == pytest.approx(-best.fun, rel=1e-9)
    assert curve.optimal_creepage(speed) == pytest.approx(best.x, rel=1e-3)
    assert curve.optimal_slip_speed(speed) == pytest.approx(best.x * speed, rel=1e-3)


def test_a_table_keeps_the_shape_of_its_points():
    creepage, adhesion, _ = eurosprinter(2)
    table = AdhesionTable(creepage, adhesion)
    np.testing.assert_allclose(table.over_creepage(creepage, 10.0), adhesion, rtol=1e-12)
    dense = table.over_creepage(np.linspace(0.0, 0.25, 20_001), 10.0)
    # One maximum, where it was measured: no overshoot between the points.
    assert dense.max() == pytest.approx(adhesion.max(), rel=1e-9)
    assert table.optimal_creepage(10.0) == pytest.approx(0.016, rel=1e-4)
    turns = np.count_nonzero(np.diff(np.sign(np.diff(dense))))
    assert turns == 1
    assert table.over_creepage(0.6, 10.0) == pytest.approx(adhesion[-1])


@family
@settings(max_examples=40)
@given(slip=st.floats(-20.0, 20.0), speed=st.floats(0.0, 60.0))
def test_it_is_odd_and_never_beyond_its_maximum(curve, slip, speed):
    at = float(curve(slip, speed))
    assert at == -float(curve(-slip, speed))
    assert abs(at) <= float(curve.maximum(speed)) * (1.0 + 1e-9)
    assert at * slip >= 0.0


@family
@settings(max_examples=40)
@given(share=st.floats(0.01, 5.0), speed=st.floats(3.0, 60.0))
def test_slopes_are_those_of_the_curve_and_vanish_at_the_optimum(curve, share, speed):
    best = float(curve.optimal_slip_speed(speed))
    slip, small = share * best, 1e-5 * best
    assume(slip / speed < 0.9)
    secant = (float(curve(slip + small, speed)) - float(curve(slip - small, speed))) / (2.0 * small)
    scale = float(curve.maximum(speed)) / best
    assert float(curve.slope(slip, speed)) == pytest.approx(secant, abs=5e-3 * scale)
    assert float(curve.slope(best, speed)) == pytest.approx(0.0, abs=5e-3 * scale)
    assert float(curve.slope(0.0, speed)) > scale


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: polach_curve("dry")(1.0), "needs the train's speed"),
        (lambda: WET.optimal_creepage(), "needs the train's speed"),
        (lambda: polach_curve("icy"), "rail condition 'icy' is unknown"),
        (lambda: PolachCurve(300.0, 0.1, 0.3, 0.3), "slip factor <= adhesion factor"),
        (lambda: PolachCurve(300.0, 0.3, 0.1, 0.3, 1.2), "friction ratio <= 1"),
        (lambda: PolachCurve(300.0, 0.3, 0.1, 0.3, 0.4, -1.0), "friction decay >= 0"),
        (lambda: AdhesionTable(np.array([0.1, 0.2]), np.array([0.1, 0.2])), "three pairs"),
        (lambda: AdhesionTable(np.array([0.0, 0.1, 0.2]), np.full(3, 0.1)), "do not grow"),
        (lambda: AdhesionTable(np.array([0.1, 0.2, 0.3]), np.full(3, -0.1)), "between 0 and 1.5"),
        (lambda: CreepCurve(0.1, 1.0, 1.0, 1.0, "slip"), "over 'slip' is unknown"),
    ],
)
def test_what_is_no_characteristic_is_refused(make, message):
    refused(InputError, message, make)


@pytest.mark.parametrize("curve", [None, polach_curve("wet"), FAMILIES["table over creepage"]])
@settings(max_examples=5)
@given(st.lists(st.floats(-250e3, 250e3), min_size=3, max_size=6), st.floats(0.05, 0.4))
def test_energy_and_momentum_are_conserved_on_any_characteristic(curve, efforts, peak):
    rail = steps((0.0, 0.3), (300.0, peak), (900.0, 0.25), (2_000.0, 0.8 * peak), (3_000.0, 0.3))
    plant = Plant.of(hilly_line(), flirt(), mass=130e3, maximum_adhesion=rail, characteristic=curve)
    state = plant.at()
    for effort in (150e3, *efforts):
        plant.advance(state, max(effort, 0.0), max(-effort, 0.0), 2_000, 2_000)
    p, works = plant.parameters, state.works
    kinetic = 0.5 * p.body_inertia * state.speed**2
    kinetic += 0.5 * p.axle_inertia * float(np.sum(state.wheel_speeds**2))
    gained = works["traction"] - sum(v for k, v in works.items() if k != "traction")
    total = sum(abs(value) for value in works.values())
    assert total > 1e6
    # Between the points of its table a characteristic has edges, which cost accuracy.
    assert abs(kinetic - gained) <= 2e-6 * total

    rolling = flirt(resistance=RunningResistance(0.0, 0.0, 0.0))
    free = Plant.of(level_line(), rolling, characteristic=curve)
    state = free.at(0.0, 20.0)
    state.wheel_speeds[:] = [26.0, 21.0, 15.0, 20.5]
    p = free.parameters
    before = p.body_inertia * state.speed + p.axle_inertia * float(state.wheel_speeds.sum())
    free.advance(state, 0.0, 0.0, 2_000, 2_000)
    after = p.body_inertia * state.speed + p.axle_inertia * float(state.wheel_speeds.sum())
    assert after == pytest.approx(before, rel=1e-12)
    assert np.all(state.works["slip"] >= 0.0)


@family
def test_the_plant_agrees_with_an_adaptive_solver(curve):
    """The same equations with the characteristic itself, scaled to the rail at every speed."""
    peak, effort, train = 0.2, 30e3, flirt()
    plant = Plant.of(level_line(), train, maximum_adhesion=steps((0.0, peak)), characteristic=curve)
    p = plant.parameters

    def slope(_: float, y: np.ndarray) -> list[float]:
        _, speed, wheel, lagged = y
        contact = float(curve(wheel - speed, speed) / curve.maximum(speed)) * peak * p.axle_weight
        drag = float(train.resistance(speed))
        turning = (lagged - contact) / p.axle_inertia
        return [speed, (4.0 * contact - drag) / p.body_inertia, turning, (effort - lagged) / 0.1]

    peer = solve_ivp(slope, (0.0, 10.0), [0.0, 8.0, 8.0, 0.0], method="LSODA", rtol=1e-8, atol=1e-8)
    state = plant.at(0.0, 8.0)
    plant.advance(state, 4.0 * effort, 0.0, 2_000, 2_000)
    np.testing.assert_allclose(state.values[[0, 1]], peer.y[:2, -1], rtol=1e-5)
    slip, expected = state.values[WHEELS] - state.speed, peer.y[2, -1] - peer.y[1, -1]
    assert slip == pytest.approx(expected, rel=5e-3)


def magic_formula(slips: np.ndarray, maximum: float, optimum: float, form: float) -> np.ndarray:
    """Pacejka's curve: a form that no family of the fit has."""
    stiffness = np.tan(np.pi / (2.0 * form)) / optimum
    return maximum * np.sin(form * np.arctan(stiffness * slips))


@pytest.mark.parametrize(("curve", "optimum"), [(1, (0.0034, 0.016)), (2, (0.013, 0.019))])
def test_the_eurosprinter_curves(curve, optimum):
    """At most 2 % of the maximum (RMS), where the plant's own shape misses by more than half."""
    creepage, adhesion, _ = eurosprinter(curve)
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


def test_bands_hold_the_truth_of_curves_of_another_form():
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
def test_files_give_back_what_was_written(curve):
    data = thing_to_bytes(CharacteristicFile.of(curve, {}))
    again = thing_from_bytes(CharacteristicFile, data).characteristic
    assert thing_to_bytes(CharacteristicFile.of(again, {})) == data
    assert type(again) is type(curve)
    slips = np.geomspace(1e-4, 0.9, 20)
    np.testing.assert_allclose(again(slips, 20.0), curve(slips, 20.0), rtol=1e-9)


def written(folder: Path, text: str) -> Path:
    return put(folder / "curve.csv", text)


def test_points_in_the_units_of_their_header(tmp_path):
    braking = written(tmp_path, "slip speed [km/h]\tmu [%]\tspeed [km/h]\n-3,6\t-12\t72\n")
    points = read_adhesion_points(braking)
    assert (points.slips.item(), points.adhesions.item()) == pytest.approx((1.0, 0.12))
    assert points.speeds.item() == pytest.approx(20.0)
    assert points.variable == "slip speed"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("creepage;adhesion\n1;0.2\n", "'creepage' has no unit"),
        ("creepage [1];adhesion\n1;0.2\n4;0.2\n", r"beyond 2 \(200 %\).*state its unit"),
        ("creepage [%];adhesion\n1;0.2\n2;20\n", "line 3, column 'adhesion': 20 is not below 1.5"),
        ("creepage [%];adhesion\n1;0.2\n2;nan\n", "line 3, column 'adhesion': 'nan' is not a"),
        ("creepage [%];adhesion\n1;-0.2\n", r"line 2: slip and adhesion have opposite signs"),
        ("creepage [%];adhesion\n1;x\n", r"line 2, column 'adhesion': 'x' is not a number"),
        ("force [kN];adhesion\n1;0.2\n", "'kN' cannot be read as m/s"),
        ("creepage [%]\n1\n", "has 1 column, expected"),
    ],
)
def test_tables_that_would_mislead_are_refused(tmp_path, text, message):
    refused(InputError, message, read_adhesion_points, written(tmp_path, text))


@pytest.mark.usefixtures("unpainted")
def test_from_measured_points_to_a_trip_on_that_rail(tmp_path, works, monkeypatch):
    slips = np.linspace(0.2, 20.0, 40)
    adhesions = magic_formula(slips, 0.2, 2.0, 1.5)
    rows = "\n".join(f"{s:.3f};{mu:.5f};72" for s, mu in zip(slips, adhesions, strict=True))
    path = written(tmp_path, f"creepage [%];adhesion;speed [km/h]\n{rows}\n")
    output = tmp_path / "rail.json"
    shown = works("fit", "adhesion", path, "-o", output)
    stated = re.search(r"maximum adhesion +([0-9.]+) ± ", shown)
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
    options = ("--count=1", "--line=sample", "--train=sample", "--characteristic", output)
    works("simulate", "drive", *options, "-o", folder)
    (log,) = folder.glob("*.mcap")
    truth = json.loads(trainlog.read(log).attachments["scenario.json"])
    assert truth["characteristic"]["polach"] == content["polach"]


@pytest.mark.parametrize(
    ("slips", "words"),
    [
        (np.linspace(0.0005, 0.009, 25), "still rises at the largest creepage"),
        (np.linspace(0.04, 0.1, 15), "below the maximum"),
        (np.array([0.001, 0.002]), "2 points do not determine"),
    ],
)
def test_points_that_do_not_determine_a_curve_are_refused(slips, words):
    points = AdhesionPoints(slips, magic_formula(slips, 0.25, 0.02, 1.6))
    refused(NotIdentifiableError, words, fit_adhesion_characteristic, points, speed=10.0)


def test_slip_speeds_of_a_train_of_known_speed_are_fitted_over_creepage():
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


AXLES, ROTATING_MASS, AXLE_LOAD = 4, 2_000.0, 16_000.0 * 9.81
FORCE_RATE = 0.12 * AXLE_LOAD


@dataclass(frozen=True)
class Run:
    """What was measured on the axles of a plant twenty times a second, and the truth [SI]."""

    time: FloatArray
    speed: FloatArray
    wheel_speed: FloatArray
    wheel_effort: FloatArray
    true_wheel_speed: FloatArray
    adhesion: FloatArray
    inertia: float


def run(base, *, curve=DRY, demand=0.26, speed=8.0, climb=0.1, seconds=200.0, seed=0):
    """A plant that pulls with an adhesion of `demand` uphill, on a rail of about `base`."""
    rng = np.random.default_rng(seed)
    places = np.arange(0.0, 40_000.0, 100.0)
    rail = StepProfile(places, base * np.exp(0.12 * rng.standard_normal(places.size)))
    train = flirt(max_traction_power=20e6, resistance=RunningResistance(0.0, 0.0, 0.0))
    plant = Plant.of(level_line(gradient=climb), train, maximum_adhesion=rail, characteristic=curve)
    state = plant.at(0.0, speed)
    rows = plant.advance(state, AXLES * demand * AXLE_LOAD, 0.0, round(seconds / 0.005), 10)
    found = dict(zip(plant.columns, rows.T, strict=True))
    wheel, effort = (
        np.column_stack([found[f"{kind}_{axle + 1}"] for axle in range(AXLES)])
        for kind in ("wheel_speed", "wheel_effort")
    )
    used = curve(wheel - found["speed"][:, None]) / curve.peak * rail(found["position"])[:, None]
    measured = wheel + 0.03 * rng.standard_normal(wheel.shape)
    time, inertia = 0.05 * np.arange(len(wheel)), plant.parameters.body_inertia
    return Run(time, found["speed"], measured, effort, wheel, used, inertia)


def rms(values: FloatArray) -> float:
    return float(np.sqrt(np.mean(values**2)))


def smoothed(plant: Run, noise: float) -> FloatArray:
    measured = plant.time, plant.wheel_speed, plant.wheel_effort
    return smoothed_force(*measured, ROTATING_MASS, noise, FORCE_RATE).force / AXLE_LOAD


def test_slip_is_two_samples_above_then_until_half():
    slip = np.array([0.0, 1.6, 0.2, 1.6, 1.7, 1.2, 0.8, 0.74, 1.4])[:, None]
    found = SlipDetector(1, 0.05).update(slip)[:, 0]
    assert found.tolist() == [False] * 4 + [True, True, True, False, False]


class TestObserver:
    @given(st.integers(0, 2**31), st.integers(1, 5))
    @settings(max_examples=8)
    def test_it_is_the_linear_gaussian_filter(self, seed, axles):
        """The engine of all models, on uneven steps with speeds and efforts missing."""
        rng = np.random.default_rng(seed)
        count = 200
        time = np.cumsum(rng.uniform(0.02, 0.5, count))
        speed = 20.0 + rng.standard_normal((count, axles)).cumsum(axis=0)
        effort = 20e3 * rng.standard_normal((count, axles))
        speed[rng.random(speed.shape) < 0.2] = np.nan
        held = effort.copy()
        for row, axle in np.argwhere(rng.random(effort.shape) < 0.2):
            if row:
                effort[row, axle] = np.nan
        for row in range(1, count):
            lost = np.isnan(effort[row])
            held[row] = np.where(lost, held[row - 1], effort[row])
        found = AdhesionObserver(axles, ROTATING_MASS, 0.03, FORCE_RATE).update(time, speed, effort)
        steps = np.diff(time)
        shift = np.zeros((count - 1, axles, 2))
        shift[:, :, 0] = 0.5 * (held[1:] + held[:-1]) * (steps / ROTATING_MASS)[:, None]
        transition, noise = random_walk_slope(steps, FORCE_RATE, -1.0 / ROTATING_MASS)
        model = LinearGaussian(transition, noise, np.array([[[1.0, 0.0]]]), shift=shift)
        known = ~np.isnan(speed[0])
        first = np.where(known, 0.03, 100.0) ** 2
        spread = np.stack([np.diag(each) for each in np.column_stack(
            [first, FORCE_RATE**2 + effort[0] ** 2]
        )])  # fmt: skip
        start = np.column_stack([np.nan_to_num(speed[0]), effort[0]])
        plain = model.filter(speed[1:, :, None], 0.03**2, start, spread)
        np.testing.assert_allclose(found.force[1:], plain.means[:, :, 1], rtol=1e-9, atol=1e-4)
        np.testing.assert_allclose(found.std[1:], plain.std[:, :, 1], rtol=1e-9)

    @pytest.mark.parametrize(("curve", "base", "demand"), [(DRY, 0.28, 0.25), (WET, 0.15, 0.14)])
    def test_adhesion_in_and_out_of_slip(self, curve, base, demand):
        plant = run(base, curve=curve, demand=demand, climb=0.48 * demand)
        error = smoothed(plant, 0.03) - plant.adhesion
        slips = np.abs(plant.true_wheel_speed - plant.speed[:, None]) > 1.5
        assert slips.any()
        assert rms(error[~slips]) < 0.006
        assert rms(error[slips]) < 0.008

    def test_refuses_bad_input(self):
        one, many = np.ones((1, 1)), np.ones((4, 1))
        refused(InputError, "rotating mass must be", AdhesionObserver, 1, 0.0, 0.05, FORCE_RATE)
        refused(InputError, "speed noise must be", AdhesionObserver, 1, 1.0, np.nan, FORCE_RATE)
        update = AdhesionObserver(1, ROTATING_MASS, 0.05, FORCE_RATE).update
        said = "row 2: adhesion observer: time must increase"
        refused(InputError, said, update, np.array([0.0, 1.0, 2.0, 2.0]), many, many)
        update(np.array([5.0]), one, one)
        refused(InputError, "row 0", update, np.array([4.0]), one, one)
        refused(InputError, "do not fit", update, np.arange(3.0), many[:2], many[:2])


@pytest.mark.parametrize("satellites", [True, False])
def test_train_speed_while_all_axles_slip_at_once(satellites):
    plant = run(0.22, speed=2.0, climb=0.0, seconds=60.0)
    slip = plant.true_wheel_speed - plant.speed[:, None]
    assert np.min(slip, axis=1).max() > 3.0
    reference = np.full(plant.time.size, np.nan)
    if satellites:
        noise = 0.1 * np.random.default_rng(0).standard_normal(reference[::4].size)
        reference[::4] = plant.speed[::4] + noise
    # What is given of brake and resistance is wrong by 8 per mille of the train's weight.
    other = np.full(plant.time.size, -0.008 * 9.81 * plant.inertia)
    gained = impulse(plant.time, plant.wheel_speed, plant.wheel_effort, other, ROTATING_MASS)
    wheels, std = (plant.wheel_speed, smoothed(plant, 0.03)), np.full(plant.time.size, 0.1)
    found = train_speed(plant.time, *wheels, 0.03, gained / plant.inertia, reference, std)
    limit = 0.03 if satellites else 0.25
    assert rms(found.speed - plant.speed) < limit
    assert np.max(np.abs(found.speed - plant.speed)) < 3.0 * limit


class TestOnset:
    def test_a_flat_top_is_averaged(self):
        rng = np.random.default_rng(1)
        used = np.concatenate((np.linspace(0.05, 0.1, 20), np.full(40, 0.1)))
        used += 0.003 * rng.standard_normal(60)
        top, fell = onset(used, noise=0.003)
        assert used[top].mean() == pytest.approx(0.1, abs=0.0015)
        assert used.max() > 0.105
        assert not fell

    def test_measured_creep_curves(self):
        """Curves after a measurement peak at 0.16 m/s and lie flat or fall slowly beyond."""
        creepage, adhesion, speed = eurosprinter(2)
        time = np.arange(0.0, 12.0, 0.05)
        wheel, used, effort = climb(creepage * speed, adhesion, time)
        noise = 0.02 * np.random.default_rng(3).standard_normal(wheel.shape)
        force = smoothed_force(time, wheel + noise, effort, ROTATING_MASS, 0.02, FORCE_RATE)
        force = force.force / AXLE_LOAD
        assert rms(force[20:-20] - used[20:-20]) < 0.008
        peak = int(np.argmax(wheel[:, 0]))
        window = force[peak - 60 : peak, 0]
        top, fell = onset(window, noise=0.004)
        assert fell
        assert window[top].mean() == pytest.approx(adhesion.max(), rel=0.03)


def climb(slip, adhesion, time):
    """An axle of a train at 10 m/s whose effort rises slowly until it slips away, then is cut."""
    fine = 1e-3
    steps = round((time[1] - time[0]) / fine)
    wheel, effort, cut = 10.0, 0.25 * AXLE_LOAD, False
    speeds, used, efforts = [], [], []
    for k in range(len(time) * steps):
        cut |= wheel - 10.0 > 2.2
        wanted = AXLE_LOAD * min(0.25 + 0.01 * k * fine, 0.35) * (0.3 if cut else 1.0)
        effort += (wanted - effort) * fine / 0.1
        now = float(np.interp(wheel - 10.0, slip, adhesion, left=0.0))
        if k % steps == 0:
            speeds.append(wheel)
            used.append(now)
            efforts.append(effort)
        wheel += fine * (effort - now * AXLE_LOAD) / ROTATING_MASS
    return np.array(speeds)[:, None], np.array(used)[:, None], np.array(efforts)[:, None]


@pytest.mark.parametrize("friction", [0.2, 0.25, 0.3])
@pytest.mark.parametrize(("floor", "decay"), [(0.4, 0.2), (0.4, 0.6), (0.6, 0.3)])
def test_the_maximum_of_polachs_curves_is_found(friction, floor, decay):
    slip = np.linspace(0.0, 6.0, 300)
    curve = PolachCurve(40.0 / np.pi, 1.0, 0.4, friction, floor, decay)(slip, 10.0)
    time = np.arange(0.0, 14.0, 0.1)
    wheel, _, effort = climb(slip, curve, time)
    rng = np.random.default_rng(3)
    wheel = wheel + 0.02 * rng.standard_normal(wheel.shape)
    force = smoothed_force(time, wheel, effort, ROTATING_MASS, 0.02, FORCE_RATE)
    slip_speed = wheel[:, 0] - 10.0
    peak = int(np.argmax(slip_speed))
    part = slice(max(peak - 20, 0), peak + 5)
    used = force.force[part, 0] / AXLE_LOAD
    found = estimate_creep_curve(time[part], slip_speed[part], used, 0.005, 0.04)
    middle = int(np.argmin(np.abs(slip_speed[part] - slip[np.argmax(curve)])))
    error = found.maximum[middle] - curve.max()
    assert abs(error) < 0.12 * curve.max()
    assert abs(error) < 3.0 * found.maximum_std[middle]
    top = int(np.argmax(slip_speed[part]))
    slope = float(np.interp(slip_speed[part][top], slip, np.gradient(curve, slip)))
    assert abs(found.slope[top] - slope) < 3.0 * found.slope_std[top]
