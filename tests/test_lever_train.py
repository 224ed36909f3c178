"""The train of Hauck et al. (2023) and the sample line it runs on."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from refusals import refused

from analysis.studies.hauck_2023 import model as dynamics
from analysis.studies.hauck_2023.model import PUBLISHED_TRAIN
from trainlog.errors import InputError
from trainlog.formats.railway import line_to_bytes, read_line
from trainlog.formats.samples import sample
from trainlog.units import GRAVITY

LINE = "DE_Chemnitz_Cranzahl.line.json"


def test_resistance_on_a_gradient_by_hand() -> None:
    sine, speed, mass = 0.01, 20.0, 78_200.0
    cosine = np.sqrt(1.0 - sine**2)
    by_hand = 0.5 * 1.2041 * 0.85 * 10.0 * speed**2 + mass * GRAVITY * (sine + 0.002 * cosine)
    assert -mass * dynamics.drift(speed, sine, mass, PUBLISHED_TRAIN) == pytest.approx(by_hand)


@settings(max_examples=40)
@given(
    speed=st.floats(0.0, 33.0),
    sine=st.floats(-0.03, 0.03),
    grip=st.floats(0.03, 0.4),
    share=st.floats(0.0, 1.0),
    load=st.floats(0.0, 1.0),
)
def test_levers_within_the_bounds_keep_the_constraints_at_every_mass(
    speed: float, sine: float, grip: float, share: float, load: float
) -> None:
    low, high = dynamics.lever_bounds(speed, sine, grip, PUBLISHED_TRAIN)
    lever = low + share * (high - low)
    mass = PUBLISHED_TRAIN.light + load * (PUBLISHED_TRAIN.heavy - PUBLISHED_TRAIN.light)
    gained = dynamics.acceleration(speed, lever, sine, mass, PUBLISHED_TRAIN)
    held = float(PUBLISHED_TRAIN.full_effort(speed)) * abs(lever) / mass
    assert abs(gained) <= PUBLISHED_TRAIN.comfort + 1e-9
    assert held <= grip * GRAVITY + 1e-9
    assert abs(lever) <= 1.0


def test_a_mass_beyond_the_range_is_refused() -> None:
    refused(InputError, "cannot weigh 90 t", PUBLISHED_TRAIN.check_mass, 90_000.0)


def test_the_reconstructed_line_is_made_again_byte_for_byte() -> None:
    script = Path(__file__).parents[1] / "sample_logs" / "make_reconstruction.py"
    made = runpy.run_path(str(script))["reconstruction"]()
    assert line_to_bytes(made) == sample(LINE).read_bytes()


def test_the_reconstructed_line_says_what_it_is_and_keeps_the_published_facts() -> None:
    line = read_line(sample(LINE))
    assert line.source.startswith("reconstruction, not the data of Hauck et al. (2023)")
    altitudes = {each.name: float(line.altitudes(each.position)) for each in line.stations}
    assert altitudes["Zschopau"] == pytest.approx(336.0, abs=0.5)
    assert altitudes["Cranzahl"] == pytest.approx(654.0, abs=0.5)
    assert line.speed_limits.values.max() * 3.6 == pytest.approx(100.0)
    assert np.abs(line.gradients.values).max() < 0.018
    assert len(line.stations) == 22
