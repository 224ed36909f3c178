"""Attributes of a line by bin: every one against the line itself, looked at metre by metre."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from refusals import refused

from analysis.adhesion.condition_map import empty_map
from analysis.adhesion.condition_table import line_table
from trainlog.errors import InputError
from trainlog.formats.railway import read_line
from trainlog.formats.samples import sample
from trainlog.railway import CurvatureProfile, Line, Station, StepProfile, Tunnel


def made_up(**changes: object) -> Line:
    """A line that begins and ends its elements within bins, and whose last bin is short."""
    line = Line(
        "made up",
        1_010.0,
        (Station("A", 0.0), Station("B west", 502.0), Station("B", 510.0), Station("C", 1_010.0)),
        StepProfile([0.0, 333.0, 340.0], [30.0, 10.0, 25.0]),
        StepProfile([0.0, 410.0], [0.012, -0.004]),
        CurvatureProfile(
            [0.0, 205.0, 260.0, 400.0], [0.0, 0.0, -1 / 350, 0.0], [0, -1 / 350, 0, 0]
        ),
        (Tunnel(610.0, 4.0, 40.0),),
    )
    return replace(line, **changes)  # type: ignore[arg-type]


@pytest.mark.parametrize("name", ["made up", "CH_StGallen_Wil", "DE_Chemnitz_Cranzahl"])
def test_each_bin_states_what_the_line_is_within_it(name: str) -> None:
    line = made_up() if name == "made up" else read_line(sample(f"{name}.line.json"))
    table = line_table(line, empty_map(line))
    assert table["end_m"].iloc[-1] == line.length
    for row in table.iloc[:: max(1, len(table) // 150)].to_dict("records"):
        # Every centimetre of the bin, its last one left out: there the next begins.
        within = np.arange(row["start_m"], row["end_m"] - 0.005, 0.01)
        assert row["tunnel"] == bool(line.tunnel_cross_section(within).any())
        assert row["gradient_permil"] == pytest.approx(1e3 * line.gradient(within).mean(), abs=0.02)
        assert row["speed_limit_km_h"] == pytest.approx(3.6 * line.speed_limit(within).min())
        if line.curvatures is None:
            assert np.isnan(row["curvature_per_km"])
            continue
        sharpest = np.abs(line.curvature(within)).max()
        assert row["curvature_per_km"] == pytest.approx(1e3 * sharpest, rel=2e-3, abs=1e-6)


def test_what_the_line_does_not_state_is_not_a_number() -> None:
    line = made_up(curvatures=None, assumed=("gradients", "speed_limits", "stations"))
    table = line_table(line, empty_map(line))
    unknown = table[["gradient_permil", "curvature_per_km", "speed_limit_km_h"]]
    assert unknown.isna().all(axis=None)
    assert table.station.isna().all()


def test_a_map_of_another_line_is_refused() -> None:
    other = empty_map(made_up(name="other"))
    refused(InputError, "the map is of 'other'", line_table, made_up(), other)


def test_limits_of_both_directions_stand_where_they_differ() -> None:
    line = made_up(speed_limits_reverse=StepProfile([0.0, 600.0], [15.0, 35.0]))
    table = line_table(line, empty_map(line))
    assert table.speed_limit_km_h.iloc[[0, -1]].tolist() == pytest.approx([108.0, 90.0])
    assert table.speed_limit_reverse_km_h.iloc[[0, -1]].tolist() == pytest.approx([54.0, 126.0])
    unknown = replace(line, assumed=("speed_limits",))
    assert line_table(unknown, empty_map(line)).speed_limit_reverse_km_h.isna().all()
