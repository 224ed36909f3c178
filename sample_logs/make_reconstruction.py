"""Make the sample line Chemnitz-Cranzahl: a reconstruction from published kilometres.

    python sample_logs/make_reconstruction.py -o sample_logs

Kilometres and altitudes of the stations are those of the lines 6258 (to Flöha), 6644 (to
Annaberg-Buchholz) and 6623 (to Cranzahl) in de.wikipedia.org, "Bahnstrecke Dresden-Werdau",
"Annaberg-Buchholz unt Bf-Flöha" and "Vejprty-Annaberg-Buchholz unt Bf"; altitudes that are
not published there are interpolated, and the places of Hilbersdorf and Niederwiesa are rough. The
highest speeds (100, 80 and 60 km/h) and the steepest gradients (15.4 and 18 per mille) are the
lines' own; where lower speeds hold, and how the gradient is spread between two stations, is made
up.
"""

from __future__ import annotations

import argparse
from itertools import pairwise
from pathlib import Path

import numpy as np

from trainlog.formats.railway import write_line
from trainlog.railway.line import Line, Station, StepProfile

NAME = "DE_Chemnitz_Cranzahl.line.json"

# Chainage [m] from Chemnitz Hbf, altitude [m].
STATIONS = (
    ("Chemnitz Hbf", 0.0, 309.0),
    ("Chemnitz-Hilbersdorf", 2_900.0, 303.0),
    ("Niederwiesa", 8_300.0, 291.0),
    ("Flöha", 12_300.0, 278.0),
    ("Flöha-Plaue", 13_700.0, 282.0),
    ("Erdmannsdorf-Augustusburg", 16_491.0, 294.0),
    ("Hennersdorf (Sachs)", 21_105.0, 300.0),
    ("Witzschdorf", 23_695.0, 310.0),
    ("Waldkirchen (Erzgeb)", 25_295.0, 318.0),
    ("Zschopau Ost", 27_365.0, 328.0),
    ("Zschopau", 29_053.0, 336.0),
    ("Wilischthal", 31_665.0, 340.0),
    ("Scharfenstein", 34_535.0, 354.0),
    ("Warmbad", 39_115.0, 373.0),
    ("Wolkenstein", 42_055.0, 392.0),
    ("Thermalbad Wiesenbad", 47_405.0, 433.0),
    ("Wiesa (Erzgeb)", 50_169.0, 468.0),
    ("Annaberg-Buchholz unt Bf", 55_514.0, 537.0),
    ("Annaberg-Buchholz Mitte", 57_296.0, 557.0),
    ("Annaberg-Buchholz Süd", 58_481.0, 574.0),
    ("Sehma", 60_935.0, 605.0),
    ("Cranzahl", 64_266.0, 654.0),
)

LENGTH = 64_400.0

# Where each permitted speed [km/h] begins [m].
SPEEDS = (
    (0.0, 50), (900.0, 80), (2_600.0, 100), (11_600.0, 60), (12_900.0, 70), (14_900.0, 80),
    (18_200.0, 60), (19_300.0, 80), (22_400.0, 70), (24_500.0, 80), (26_600.0, 60),
    (30_100.0, 80), (32_600.0, 70), (36_300.0, 80), (38_200.0, 60), (40_300.0, 80),
    (41_500.0, 70), (43_800.0, 80), (46_600.0, 60), (48_300.0, 70), (51_300.0, 80),
    (54_700.0, 50), (56_100.0, 60), (61_800.0, 50), (62_700.0, 60),
)  # fmt: skip

LEVEL = 80.0
"""Level track on either side of a station [m]: the rules for building railways allow station tracks
2.5 per mille at most (EBO § 7), and where they are steeper is not published."""

SHARES = (0.95, 1.05, 1.07, 0.93, 1.03, 0.97)
"""How the mean gradient between two stations varies from piece to piece."""

PIECE = 450.0
"""Length of a piece of constant gradient, about [m]."""


def gradients() -> StepProfile:
    """Level at the stations; between them pieces that reach the altitude of the next."""
    positions, values = [0.0], [0.0]
    for (_, start, low), (_, end, high) in pairwise(STATIONS):
        first, last = start + LEVEL, end - LEVEL
        count = max(2, round((last - first) / PIECE))
        edges = np.round(np.linspace(first, last, count + 1))
        shares = np.resize(SHARES, count)
        rise = shares * np.diff(edges) / np.sum(shares * np.diff(edges)) * (high - low)
        positions.extend([*edges[:-1], edges[-1]])
        values.extend([*np.round(rise / np.diff(edges), 5), 0.0])
    return StepProfile(np.array(positions), np.array(values))


def reconstruction() -> Line:
    """The sample line."""
    starts, speeds = np.array(SPEEDS, dtype=np.float64).T
    return Line(
        name="DE_Chemnitz_Cranzahl (reconstruction)",
        length=LENGTH,
        stations=tuple(Station(name, position) for name, position, _ in STATIONS),
        speed_limits=StepProfile(starts, speeds / 3.6),
        gradients=gradients(),
        altitude=STATIONS[0][2],
        source=(
            "reconstruction, not the data of Hauck et al. (2023), whose map is lost: kilometres and"
            " altitudes of the stations, highest speeds and steepest gradients from the articles on"
            " the lines 6258, 6644 and 6623 in de.wikipedia.org; where lower speeds hold and how"
            " gradients are spread between stations is made up"
        ),
    )


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    write_line(reconstruction(), parser.parse_args().output / NAME)
