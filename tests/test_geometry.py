"""The plane curve of a line and its place on the earth."""

from __future__ import annotations

import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings, strategies as st
from scipy.integrate import solve_ivp
from simulated_line import level_line

from trainlog.errors import InputError
from trainlog.formats.ttobench import read_track
from trainlog.railway import CurvatureProfile, Line
from trainlog.railway.geometry import from_plane, plane_curve, to_plane

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from make_line import Anchor, place

TRACK = (
    Path(__file__).parents[2] / "shared" / "data" / "ttobench" / "tracks" / "CH_StGallen_Wil.json"
)
needs_track = pytest.mark.skipif(not TRACK.is_file(), reason="the TTOBench library is not here")


def profile(*elements: tuple[float, float, float]) -> CurvatureProfile:
    positions, start, end = (np.array(column) for column in zip(*elements, strict=True))
    return CurvatureProfile(positions, start, end)


def line(curvatures: CurvatureProfile | None, length: float) -> Line:
    return replace(level_line(length, limit=20.0), curvatures=curvatures)


@settings(max_examples=30)
@given(
    st.lists(
        st.tuples(st.floats(5.0, 300.0), st.floats(-0.006, 0.006), st.floats(-0.006, 0.006)),
        min_size=1,
        max_size=8,
    )
)
def test_any_curve_is_exact_to_a_millimetre(elements):
    widths = np.array([element[0] for element in elements])
    starts = np.concatenate(([0.0], np.cumsum(widths)[:-1]))
    length = float(widths.sum())
    curves = CurvatureProfile(
        starts, np.array([e[1] for e in elements]), np.array([e[2] for e in elements])
    )
    positions, points = plane_curve(curves, length)
    assert np.all(np.diff(positions) <= 25.0 + 1e-9)
    assert set(starts) <= set(positions)
    state = np.zeros(3)
    for start, width, (_, first, last) in zip(starts, widths, elements, strict=True):
        reference = solve_ivp(
            lambda s, y, a=first, b=last, w=width: [
                np.sin(y[2]),
                np.cos(y[2]),
                a + (b - a) * s / w,
            ],
            (0.0, width),
            state,
            rtol=1e-11,
            atol=1e-9,
        )
        state = reference.y[:, -1]
        end = np.interp(start + width, positions, points)
        assert abs(end - complex(state[0], state[1])) < 1e-3


def test_the_plane_and_the_earth_are_inverse():
    origin = (47.4, 9.2)
    east, north = np.meshgrid(np.linspace(-3e4, 3e4, 7), np.linspace(-3e4, 3e4, 7))
    points = (east + 1j * north).ravel()
    latitudes, longitudes = from_plane(points, origin)
    assert to_plane(latitudes, longitudes, origin) == pytest.approx(points, abs=1e-4)


def test_a_minute_of_arc_has_its_published_length():
    """At 45 degrees on WGS 84 a degree is 111.132 km of latitude and 78.847 km of longitude."""
    half, origin = 1.0 / 120.0, (45.0, 9.0)
    north = to_plane(45.0 + half, 9.0, origin) - to_plane(45.0 - half, 9.0, origin)
    east = to_plane(45.0, 9.0 + half, origin) - to_plane(45.0, 9.0 - half, origin)
    assert complex(north) == pytest.approx(1j * 111_132.0 / 60.0, abs=0.02)
    assert complex(east) == pytest.approx(78_847.0 / 60.0, abs=0.02)


def test_a_placed_line_meets_anchors_that_agree_with_it():
    bends = profile((0.0, 0.0, 0.0), (3000.0, 0.0, 0.001), (3200.0, 0.001, 0.001))
    length, origin = 6000.0, (47.4, 9.2)
    positions, points = plane_curve(bends, length)
    turned = points * np.exp(-1j * np.radians(230.0)) + (200.0 - 300.0j)
    marks = [0, positions.size // 2, positions.size - 1]
    latitudes, longitudes = from_plane(turned[marks], origin)
    anchors = tuple(
        Anchor(float(positions[mark]), float(latitude), float(longitude))
        for mark, latitude, longitude in zip(marks, latitudes, longitudes, strict=True)
    )
    placed = place(line(bends, length), anchors, tolerance=0.01)
    assert placed.residuals.max() < 0.05
    assert placed.scale == pytest.approx(1.0, abs=1e-5)
    assert placed.heading == pytest.approx(230.0, abs=0.05)
    at = placed.geometry.at(positions)
    assert np.abs(to_plane(*at, origin) - turned).max() < 0.02


def test_a_line_without_curvature_or_anchors_cannot_be_placed():
    anchors = (Anchor(0.0, 47.4, 9.2), Anchor(100.0, 47.4, 9.3))
    with pytest.raises(InputError, match="placing it needs curvatures and two anchors"):
        place(line(None, 100.0), anchors)
    with pytest.raises(InputError, match="placing it needs curvatures and two anchors"):
        place(line(profile((0.0, 0.0, 0.0)), 100.0), anchors[:1])


ANCHORS = (
    Anchor(9_286.1, 47.41190, 9.25366),
    Anchor(14_476.1, 47.4146, 9.1872),
    Anchor(20_086.1, 47.4370, 9.1330),
    Anchor(29_556.1, 47.46250, 9.04090),
)


@needs_track
def test_positive_radii_bend_to_the_right():
    """The library's convention, confirmed: with the other sign the stations lie far off."""
    track = read_track(TRACK)
    curves = track.curvatures
    mirrored = replace(
        track, curvatures=CurvatureProfile(curves.positions, -curves.start, -curves.end)
    )
    right, left = place(track, ANCHORS), place(mirrored, ANCHORS)
    assert right.residuals.max() < 300.0
    assert abs(right.scale - 1.0) < 1e-3
    assert left.residuals.max() > 1000.0
    assert abs(left.scale - 1.0) > 5e-3
