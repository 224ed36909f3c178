"""Make the sample line and train from TTOBench's files.

    python sample_logs/make_line.py CH_StGallen_Wil.json CH_Stadler_FLIRT_TPF.json -o sample_logs

The line gets what the track file lacks: the stations between its ends, and coordinates from its
curvature. The train gets what the train file lacks: axles, brake and heaviest load, as assumptions.
"""

from __future__ import annotations

import argparse
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from trainlog.arrays import ComplexArray, FloatArray
from trainlog.errors import InputError
from trainlog.formats.railway import write_line, write_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN
from trainlog.formats.ttobench import read_track, read_train
from trainlog.railway.geometry import (
    SEMI_MAJOR_AXIS,
    from_plane,
    nearest_on,
    plane_curve,
    thinned,
    to_plane,
    track_of,
)
from trainlog.railway.line import Geometry, Line, Station
from trainlog.railway.train import Axles, Train

# The published kilometres of the line St.Gallen-Winterthur (de.wikipedia.org, "Bahnstrecke
# St. Gallen-Winterthur"): St.Gallen 80.46, Gossau SG 90.13, Flawil 95.33, Uzwil 100.94, Wil 110.62;
# they jump by 10 m before Flawil and by 210 m before Wil. Counted back from Wil, where the track
# ends, the published altitudes of the stations agree with the track's own profile within 1.3 m.
STATIONS = (
    Station("St.Gallen", 0.0),
    Station("Gossau SG", 9_286.1),
    Station("Flawil", 14_476.1),
    Station("Uzwil", 20_086.1),
    Station("Wil", 29_556.1),
)

# Gossau SG and Wil: the national coordinates 736973/252816 and 720805/258091 of their stations
# (de.wikipedia.org, "Bahnhof Gossau", "Bahnhof Wil"); Flawil and Uzwil: to about 100 m.
COORDINATES = {
    "Gossau SG": (47.41190, 9.25366),
    "Flawil": (47.4146, 9.1872),
    "Uzwil": (47.4370, 9.1330),
    "Wil": (47.46250, 9.04090),
}
"""Latitude and longitude [deg] of stations, by their names."""


@dataclass(frozen=True, slots=True)
class Anchor:
    """A point of the line whose coordinates are known.

    Attributes
    ----------
    position : float [m]
    latitude, longitude : float [deg]
    """

    position: float
    latitude: float
    longitude: float


@dataclass(frozen=True)
class Placement:
    """A plane curve laid on the earth.

    Attributes
    ----------
    geometry : Geometry
    heading : float [deg]
        Of the line's start, clockwise from north.
    scale : float
        Factor by which the curve was stretched to fit; near 1 where curve and anchors agree.
    residuals : (n,) array [m]
        Distance between each anchor and its point of the line.
    """

    geometry: Geometry
    heading: float
    scale: float
    residuals: FloatArray


def place(line: Line, anchors: tuple[Anchor, ...], tolerance: float = 0.5) -> Placement:
    """Lay the plane curve of a line on the earth by turning, shifting and scaling it.

    The similarity is the least-squares fit to the anchors on a plane that touches the ellipsoid
    at their mean.

    Parameters
    ----------
    line : Line
        With curvatures.
    anchors : tuple of Anchor
        At least two.
    tolerance : float [m]
        How far the geometry's straight pieces may lie from the curve.

    Raises
    ------
    InputError
        If the line has no curvatures, or there are fewer than two anchors.
    """
    if line.curvatures is None or len(anchors) < 2:
        raise InputError(
            f"line '{line.name}': placing it needs curvatures and two anchors",
            remedy="give the line curvatures and two anchors with coordinates",
        )
    positions, points = plane_curve(line.curvatures, line.length)
    latitudes = np.array([anchor.latitude for anchor in anchors])
    longitudes = np.array([anchor.longitude for anchor in anchors])
    origin = (float(latitudes.mean()), float(longitudes.mean()))
    targets = to_plane(latitudes, longitudes, origin)
    sources = np.interp([anchor.position for anchor in anchors], positions, points)
    factor, shift = similarity(sources, targets)
    scale, residuals = float(np.abs(factor)), np.abs(factor * sources + shift - targets)
    quality = (
        "reconstructed from the published curvature, fitted to the coordinates of"
        f" {len(anchors)} points (up to {residuals.max():.0f} m off, scale {scale:.4f});"
        " not surveyed"
    )
    latitude, longitude = from_plane(factor * points + shift, origin)
    # A geometry is straight in latitude and longitude, so it is thinned there.
    shrink = np.cos(np.radians(origin[0]))
    flat = SEMI_MAJOR_AXIS * (np.radians(longitude) * shrink + 1j * np.radians(latitude))
    kept = thinned(positions, flat, tolerance)
    geometry = Geometry(positions[kept], latitude[kept], longitude[kept], quality)
    heading = float(np.degrees(-np.angle(factor))) % 360.0
    return Placement(geometry, heading, scale, residuals)


def similarity(sources: ComplexArray, targets: ComplexArray) -> tuple[complex, complex]:
    """The factor and shift for which ``factor * sources + shift`` is nearest to `targets`.

    Examples
    --------
    >>> similarity(np.array([0.0, 1.0j]), np.array([1.0, 3.0 + 0.0j]))
    (-2j, (1+0j))
    """
    centred = sources - sources.mean()
    factor = np.vdot(centred, targets - targets.mean()) / np.vdot(centred, centred)
    return complex(factor), complex(targets.mean() - factor * sources.mean())


def sample_line(track: str | Path) -> tuple[Line, Placement]:
    """The sample line from TTOBench's ``CH_StGallen_Wil.json``, and how it was placed."""
    line = read_track(track)
    anchors = tuple(
        Anchor(station.position, *COORDINATES[station.name])
        for station in STATIONS
        if station.name in COORDINATES
    )
    placed = place(line, anchors, tolerance=0.4)
    geometry = replace(
        placed.geometry,
        positions=np.round(placed.geometry.positions, 3),
        latitudes=np.round(placed.geometry.latitudes, 7),
        longitudes=np.round(placed.geometry.longitudes, 7),
    )
    source = (
        f"{line.source}; description Stations between the ends are approximate: from the line's"
        " published kilometres, counted back from Wil, by which the track begins 0.38 km west of"
        " St.Gallen station"
    )
    return replace(line, stations=STATIONS, geometry=geometry, source=source), placed


def sample_train(file: str | Path) -> Train:
    """The sample train from TTOBench's ``CH_Stadler_FLIRT_TPF.json``."""
    train = read_train(file)
    assumptions = (
        "Assumed, not published: 4 powered axles that carry 72 t of the empty train, wheels of"
        " 0.86 m, 2.2 t of rotating mass a powered axle (the rest of the 12.2 t in the trailing"
        " ones), a friction brake with 0.6 s of dead time and 0.4 s of lag, and 25 t of heaviest"
        " load (two passengers a seat)"
    )
    return replace(
        train,
        max_load=25_000.0,
        axles=Axles(count=4, adhesive_mass=72_000.0, wheel_radius=0.43, rotating_mass=2_200.0),
        source=f"{train.source}; description {assumptions}",
    )


def main() -> None:
    """Write both files and print how well the line lies."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("track", type=Path, help="TTOBench's CH_StGallen_Wil.json")
    parser.add_argument("train", type=Path, help="TTOBench's CH_Stadler_FLIRT_TPF.json")
    parser.add_argument("-o", "--output", type=Path, default=Path(__file__).parent)
    arguments = parser.parse_args()
    line, placed = sample_line(arguments.track)
    write_line(line, arguments.output / DEFAULT_LINE)
    write_train(sample_train(arguments.train), arguments.output / DEFAULT_TRAIN)
    print(f"heading {placed.heading:.2f} degrees, scale {placed.scale:.5f}")
    track = track_of(placed.geometry)
    for station, residual in zip(STATIONS[1:], placed.residuals, strict=True):
        point = track.plane(*([each] for each in COORDINATES[station.name]))
        position, distance = (each.item() for each in nearest_on(track, point))
        print(
            f"{station.name}: {residual:.0f} m off at km {station.position / 1e3:.3f},"
            f" nearest at km {position / 1e3:.3f}, {distance:.0f} m away"
        )


if __name__ == "__main__":
    main()
