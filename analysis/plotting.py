"""One look for all pictures: colours, sizes, how a figure is begun and written."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal

from matplotlib import rc_context
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.ticker import Formatter, Locator

from trainlog.formats.files import atomic_write
from trainlog.railway.kilometres import km_ticks
from trainlog.railway.line import Line

BLUE, ORANGE, GREEN, RED, PURPLE, SKY = (
    "#0072b2",
    "#e69f00",
    "#009e73",
    "#d55e00",
    "#8e5ea2",
    "#56b4e9",
)
"""Colours that colour-blind readers can distinguish (Okabe and Ito)."""

INK, GREY, PALE = "#222222", "#7f7f7f", "#d0d0d0"
"""Text and lines; data in the background; grids."""

DOTS_PER_INCH = 150


def new_figure(width: float = 9.0, height: float = 5.0) -> Figure:
    """An empty figure of `width` by `height` [inch] on an Agg canvas; needs no display."""
    figure = Figure(figsize=(width, height), layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    return figure


def headline(figure: Figure, text: str, *, colour: str = INK, size: float = 11.0) -> None:
    """Write what a figure shows above it, on the left."""
    figure.suptitle(text, x=0.01, ha="left", fontsize=size, color=colour)


Corner = Literal["upper left", "upper right", "lower left", "lower right"]


def legend(axes: Axes, place: Corner = "upper left", **options: Any) -> None:
    """Draw the legend in the common look; further `options` as of matplotlib."""
    axes.legend(fontsize=8, frameon=False, loc=place, **options)


def dress(axes: Axes, *, x: str, y: str, title: str = "") -> Axes:
    """Label an axes and give it the common look."""
    axes.set_xlabel(x, color=INK)
    axes.set_ylabel(y, color=INK)
    if title:
        axes.set_title(title, loc="left", fontsize=10, color=INK)
    axes.grid(visible=True, color=PALE, linewidth=0.6)
    axes.set_axisbelow(True)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(GREY)
    axes.tick_params(colors=INK, labelsize=9)
    return axes


class _Kilometres(Locator):
    """Ticks at round operator's kilometres of an axis that holds chainage [km]."""

    def __init__(self, line: Line) -> None:
        self.line = line

    def __call__(self) -> list[float]:
        low, high = self.axis.get_view_interval()  # type: ignore[union-attr]
        return self.tick_values(low, high)

    def tick_values(self, vmin: float, vmax: float) -> list[float]:
        places: list[float] = (km_ticks(self.line, 1e3 * vmin, 1e3 * vmax)[0] / 1e3).tolist()
        return places


class _KilometreLabels(Formatter):
    """Labels of such ticks."""

    def __init__(self, line: Line) -> None:
        self.line = line

    def __call__(self, x: float, pos: int | None = None) -> str:  # noqa: ARG002
        low, high = self.axis.get_view_interval()  # type: ignore[union-attr]
        places, labels = km_ticks(self.line, 1e3 * low, 1e3 * high)
        known: dict[float, str] = dict(zip((places / 1e3).tolist(), labels, strict=True))
        return known.get(x, "")


def km_axis(axes: Axes, line: Line | None, label: str = "km") -> None:
    """Label an axis of chainage [km] with the operator's kilometres, where the line has them."""
    if line is None or line.reference is None:
        axes.set_xlabel(label, color=INK)
        return
    axes.xaxis.set_major_locator(_Kilometres(line))
    axes.xaxis.set_major_formatter(_KilometreLabels(line))
    axes.set_xlabel(label.removesuffix(" in the direction of travel"), color=INK)


def write_figure(figure: Figure, path: str | Path) -> None:
    """Write a figure as PNG, or as SVG if the path ends so: whole or not at all.

    The same figure gives the same bytes. An SVG has no background, so that it stands on a page of
    any colour.
    """
    with atomic_write(path) as temporary:
        if Path(path).suffix == ".svg":
            with rc_context({"svg.hashsalt": "trainlog"}):
                about = {"Date": None, "Creator": None}
                figure.savefig(temporary, format="svg", transparent=True, metadata=about)
            return
        figure.savefig(temporary, format="png", dpi=DOTS_PER_INCH, metadata={"Software": None})
