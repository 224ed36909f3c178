"""Load transfer between the axles: moments, the plant that has it, and what analyses make of it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused
from simulated_line import flirt, hilly_line, level_line
from slip_truth import Seen, seen

from analysis.adhesion.slip import slip
from trainlog.arrays import FloatArray
from trainlog.errors import InputError
from trainlog.formats.railway import train_to_bytes
from trainlog.railway import Axles, Train
from trainlog.railway.train import AxleGeometry, axle_loads, load_transfer
from trainlog.simulation import draw_scenarios
from trainlog.simulation.plant import Plant
from trainlog.trip import TRAIN_ATTACHMENT

GEOMETRY = AxleGeometry(2.6, 9.5, 0.6, 1.0, 1.6)


def with_geometry(geometry: AxleGeometry | None = GEOMETRY, **axles: object) -> Train:
    return flirt(axles=Axles(**{"geometry": geometry, **axles}))  # type: ignore[arg-type]


lengths = st.floats(0.3, 3.0)


class TestMoments:
    @settings(max_examples=40)
    @given(
        st.builds(
            AxleGeometry, st.floats(1.5, 4.0), st.floats(6.0, 14.0), lengths, lengths, lengths,
            st.integers(2, 3),
        ),
        st.lists(st.floats(-60e3, 60e3), min_size=6, max_size=6),
        st.floats(-2.0, 2.0),
    )  # fmt: skip
    def test_a_vehicle_is_in_equilibrium(
        self, geometry: AxleGeometry, forces: list[float], specific: float
    ) -> None:
        """About the rail: loads times their places, coupler force and inertia at their heights."""
        count = 2 * geometry.axles_per_bogie
        pull, mass = np.array(forces[:count]), count * 18e3
        transfer = load_transfer(geometry, count, mass)
        change = transfer[:, :-1] @ pull + transfer[:, -1] * specific
        assert change.sum() == pytest.approx(0.0, abs=1e-6)
        inertia = mass * specific
        coupler = pull.sum() - inertia
        offsets = np.linspace(0.5, -0.5, geometry.axles_per_bogie) * geometry.wheelbase
        middle = 0.5 * geometry.pivot_distance
        places = np.concatenate([offsets + middle, offsets - middle])
        moment = coupler * geometry.coupler_height + inertia * geometry.centre_height
        assert -change @ places == pytest.approx(moment, abs=1e-3)

    def test_a_locomotive_by_hand(self) -> None:
        """240 kN at the rails, all of it at the coupler: 120 kN × 0.6 m / 2.6 m a bogie, and
        240 kN × 0.4 m / 9.5 m of the body, shared by two axles."""
        transfer = load_transfer(GEOMETRY, 4, 84e3)
        bogie, body = 120e3 * 0.6 / 2.6, 240e3 * 0.4 / 9.5 / 2.0
        expected = [-bogie - body, bogie - body, -bogie + body, bogie + body]
        np.testing.assert_allclose(transfer[:, :4] @ np.full(4, 60e3), expected)


class TestPlant:
    def test_the_loads_are_those_of_the_moments(self) -> None:
        """On a rail at whose limit the axles pull: what each transmits is its load times that."""
        train = with_geometry()
        plant = Plant.of(level_line(), train, maximum_adhesion=None)
        state = plant.at(50_000.0, 10.0)
        rows = plant.advance(state, 190e3, 0.0, steps=400)
        found = dict(zip(plant.columns, rows.T, strict=True))
        seconds = plant.parameters.step * np.arange(400)
        wheels = np.column_stack([found[f"wheel_speed_{i}"] for i in range(1, 5)])
        efforts = np.column_stack([found[f"wheel_effort_{i}"] for i in range(1, 5)])
        turning = train.axles.rotating_mass * np.gradient(wheels, seconds, axis=0)
        force = (efforts - turning)[100:-1]
        transfer = train.load_transfer()
        assert transfer is not None
        static = train.adhesive_weight() / 4
        loads = axle_loads(transfer, static, force, found["acceleration"][100:-1])
        a, b, scale = plant.rail[0, 2:]
        slip_speed = (wheels - found["speed"][:, None])[100:-1]
        adhesion = scale * (np.exp(-a * slip_speed) - np.exp(-b * slip_speed))
        # Where an effort is cut the difference of wheel speeds takes no account of the kink.
        off = np.abs(force / (adhesion * loads) - 1.0)
        assert np.quantile(off, 0.9) < 2e-3
        assert off.max() < 0.05
        assert loads.min() < 0.93 * static


@pytest.fixture(scope="module")
def wet() -> Seen:
    return seen(draw_scenarios(hilly_line(), with_geometry(), 3, seed=1)[2])


@pytest.fixture(scope="module")
def even() -> Seen:
    """The same trip of a plant whose loads stay."""
    return seen(draw_scenarios(hilly_line(), with_geometry(None), 3, seed=1)[2])


class TestAnalysis:
    def errors(self, each: Seen, geometry: AxleGeometry | None) -> tuple[FloatArray, ...]:
        """Relative errors at measured onsets, their stated deviations, and the axles.

        Not where the rail changes within the 10 m to which the place of an onset is known.
        """
        train = train_to_bytes(with_geometry(geometry))
        trip = replace(each.trip, attachments={**each.trip.attachments, TRAIN_ATTACHMENT: train})
        events = slip(trip).events
        events = events[events["measured"]]
        places = events["position"].to_numpy()
        around = [each.scenario.maximum_adhesion(places + off) for off in (-10.0, 0.0, 10.0)]
        clear = np.ptp(around, axis=0) < 0.1 * around[1]
        events, truth = events[clear], around[1][clear]
        used, std = events["adhesion"].to_numpy(), events["adhesion_std"].to_numpy()
        whole = np.hypot(std, events["transfer_std"].to_numpy())
        return used / truth - 1.0, std / truth, whole / truth, events["axle"].to_numpy()

    def apart(self, error: FloatArray, axle: FloatArray) -> float:
        """By how much the leading axle is known less right than the last."""
        return float(np.median(error[axle == 4]) - np.median(error[axle == 1]))

    def test_geometry_makes_it_as_good_as_without_transfer(self, wet: Seen, even: Seen) -> None:
        error, std, whole, axle = self.errors(wet, GEOMETRY)
        best, _, _, of_axle = self.errors(even, None)
        assert error.size > 100
        assert np.sqrt(np.mean(error**2)) < 1.1 * np.sqrt(np.mean(best**2))
        assert abs(self.apart(error, axle) - self.apart(best, of_axle)) < 0.02
        assert np.mean(np.abs(error) < 1.96 * std) > 0.95
        np.testing.assert_array_equal(std, whole)

    def test_without_it_the_band_allows_for_the_transfer(self, wet: Seen, even: Seen) -> None:
        error, std, whole, axle = self.errors(wet, None)
        best, _, _, of_axle = self.errors(even, None)
        assert self.apart(error, axle) > self.apart(best, of_axle) + 0.05
        assert np.sqrt(np.mean(error**2)) > 1.2 * np.sqrt(np.mean(best**2))
        assert np.median(np.sqrt(whole**2 - std**2)) > 0.02
        assert np.mean(np.abs(error) < 1.96 * whole) > 0.97


class TestFile:
    @pytest.mark.parametrize(
        ("change", "words"),
        [
            ({"wheelbase": 0.0}, "wheelbase"),
            ({"link_height": -0.1}, "link_height"),
            ({"axles_per_bogie": 1}, "axles_per_bogie: 1 is less than 2"),
            ({"powered_bogies": 3}, "powered_bogies: 3 is not 1 or 2"),
            ({"pivot_distance": np.nan}, "pivot_distance"),
        ],
    )
    def test_impossible_geometry_is_refused(self, change: dict[str, float], words: str) -> None:
        refused(InputError, words, replace, GEOMETRY, **change)
