"""Draw what is left of the map, and of the energy saved, where trains report less.

    python benchmarks/fleet/draw_reports.py FOLDER CATALOGUE [...] [--energy FIGURES.csv]
        [-o docs/images]

FOLDER and CATALOGUES as for `benchmark_report_energy.py`, whose figures are drawn, too.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib.pyplot as plt
import numpy as np
import pandas as pd
from fleet_truth import drawn_again

from analysis.fleet.maps import maps_folder
from analysis.network.maps import network_map
from trainlog.catalogue import open_catalogue
from trainlog.simulation import Fleet

SENT = {"fleet": "as recorded", "1-s": "a row a second", "5-s": "a row every 5 s"}
"""What each catalogue's trains sent."""


def draw_maps(fleet: Fleet, catalogues: list[Path], edge: str, layer: str, output: Path) -> None:
    """The true adhesion along an edge, and what each catalogue's map holds of it."""
    figure, rows = plt.subplots(
        len(catalogues), 1, figsize=(10, 2.4 * len(catalogues)), sharex=True, sharey=True,
        layout="constrained",
    )  # fmt: skip
    for axes, where in zip(np.atleast_1d(rows), catalogues, strict=True):
        with open_catalogue(str(where)) as catalogue:
            track = network_map(maps_folder(catalogue)).maps[edge]
        own, km = track.layers[layer], track.centres / 1e3
        seen = own.evidence.by_bin("trips") > 0
        low, high = (np.where(seen, own.quantile(share), np.nan) for share in (0.025, 0.975))
        axes.step(km, fleet.rail(edge).lasting(layer, fleet.start)(track.centres), "k",
                  where="mid", linewidth=0.9, label="true")  # fmt: skip
        middle = np.where(seen, np.exp(own.log_mean), np.nan)
        axes.errorbar(km, middle, (middle - low, high - middle), fmt=".", color="tab:blue",
                      markersize=4, linewidth=0.8, label="map, 95 % band")  # fmt: skip
        name = where.name.removeprefix("catalogue-")
        axes.set_title(f"{SENT.get(name, name)}: slip in {int(seen.sum())} bins", loc="left")
        axes.set_ylabel("maximum adhesion")
        axes.grid(alpha=0.3)
    axes.set_xlabel(f"{edge}, {layer} [km]")
    axes.set_ylim(0.0, 0.35)
    axes.legend(loc="upper right")
    figure.savefig(output, dpi=110)


def draw_energy(figures: Path, output: Path) -> None:
    """Work of traction beside that of plans without anything learned, and lateness, by train."""
    frame = pd.read_csv(figures)
    wide = frame.pivot_table(index="train", columns="way", values=["work", "late"], sort=False)
    ways = [way for way in frame["way"].unique() if way.endswith("map")]
    figure, (work, late) = plt.subplots(1, 2, figsize=(10, 4), layout="constrained")
    place = np.arange(len(wide))
    for number, way in enumerate(["nothing", *ways]):
        name = SENT.get(way.partition(",")[0], "nothing learned")
        shift = (number - len(ways) / 2) * 0.2
        colour = "0.6" if way == "nothing" else f"C{number - 1}"
        part = 100.0 * (wide["work", way] / wide["work", "nothing"] - 1.0)
        work.barh(place + shift, part, 0.2, color=colour, label=name)
        late.barh(place + shift, wide["late", way], 0.2, color=colour)
    for axes in (work, late):
        axes.set_yticks(place, list(wide.index))
        axes.invert_yaxis()
        axes.grid(alpha=0.3, axis="x")
    work.set_xlabel("work of traction beside nothing learned [%]")
    late.set_xlabel("late at the end [s]")
    work.legend(fontsize="small")
    figure.savefig(output, dpi=110)


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("folder", type=Path)
    parser.add_argument("catalogues", type=Path, nargs="+")
    parser.add_argument("--energy", type=Path)
    parser.add_argument("--edge", help="default: the one with the most slips")
    parser.add_argument("--layer", default="leaves")
    parser.add_argument("-o", "--output", type=Path, default=Path("docs/images"))
    options = parser.parse_args()
    fleet = drawn_again(options.folder)
    with open_catalogue(str(options.catalogues[0])) as catalogue:
        maps = network_map(maps_folder(catalogue)).maps
    edge = options.edge or max(maps, key=lambda each: maps[each].layers[options.layer].events.sum())
    draw_maps(fleet, options.catalogues, edge, options.layer, options.output / "reports-map.png")
    if options.energy is not None:
        draw_energy(options.energy, options.output / "reports-energy.png")


if __name__ == "__main__":
    main()
