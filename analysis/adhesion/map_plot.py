"""Pictures of a track-condition map: its state, its differences, the history of a place."""

from __future__ import annotations

import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.colors import to_rgba
from matplotlib.figure import Figure
from numpy.typing import ArrayLike

from analysis.adhesion.condition_table import (
    bin_edges,
    check_course,
    day_name,
    last_evidence,
    shown,
)
from analysis.plotting import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    dress,
    headline,
    km_axis,
    new_figure,
    write_figure,
)
from trainlog.arrays import BoolArray, FloatArray
from trainlog.condition import known_before
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.railway.condition import (
    ConditionChange,
    ConditionLayer,
    PassingSpot,
    TrackConditionMap,
)
from trainlog.railway.line import Line

if TYPE_CHECKING:
    from analysis.adhesion.map_difference import MapDifference
    from analysis.adhesion.map_history import PlaceHistory


COLOURS = {"dry": ORANGE, "wet": BLUE}
"""Of the layers; others are drawn in ink."""

LABELLED = 8
"""Spots, and changes, of a layer that are labelled with their dates: the likeliest."""

GONE = 0.005
"""Spots that lie there less likely than this are drawn pale, and not labelled."""

LABELS = 0.36
"""Share of the height of an axes that is kept free of data for labels, where there are any."""

FAINTEST = 0.45
"""Opacity of a spot that has gone; one that surely lies there is opaque."""

DAY = pd.Timedelta(days=1)

LABEL_SPACE = 0.022
"""Share of the width that a label beside a vertical line takes."""


def draw_map(
    track: TrackConditionMap,
    path: str | Path,
    truth: Mapping[str, ArrayLike] | None = None,
    *,
    line: Line | None = None,
    at: pd.Timestamp | None = None,
    part: tuple[float, float] | None = None,
) -> None:
    """Draw lasting beside expected maximum adhesion where it was observed; grey where it was not.

    Each has its 95 % band. Passing spots and lasting changes are marked with their dates.

    Parameters
    ----------
    track : TrackConditionMap
    path : path
        PNG file.
    truth : mapping of str to (bins,) array, optional
        True maximum adhesion a bin, by layer, to compare with.
    line : Line, optional
        Gives the stations.
    at : Timestamp, optional
        Time of the expected condition; only evidence of the days before its day counts
        (`trainlog.condition.known_before`). Default: right after the last evidence, with all of it.
    part : (2,) tuple of float [m], optional
        Chainage of the ends of the part that is drawn; default: all of the line.

    Raises
    ------
    InputError
        If the map has no layer yet, no evidence is of a day before, or the line is another.
    """
    if not track.layers:
        raise InputError(
            f"map of line '{track.line}' has no layer to draw", remedy="count a trip in first"
        )
    if line is not None:
        check_course(track, line)
    if at is not None:
        track = known_before(track, at)
    start, end = sorted(part or (0.0, track.length))
    count = len(track.layers)
    figure = new_figure(13.0, 1.2 + 3.0 * count + 0.9 * (line is not None))
    heights = [3.0] * count + [0.9] * (line is not None)
    every = np.atleast_1d(
        figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    ).tolist()
    axes = every[:count]
    for place, (name, layer) in zip(axes, track.layers.items(), strict=True):
        known = None if truth is None or name not in truth else np.asarray(truth[name])
        _draw_layer(place, track, name, layer, known, at, (start, end))
        dress(place, x="", y="maximum adhesion", title=_title(track, name, layer))
        place.set_ylim(0.0, _with_labels(place, _top(track, at)))
        place.tick_params(labelbottom=True)
    _legend(figure, axes)
    if line is not None:
        _draw_stations(axes, every[-1], line, (start, end))
    km_axis(axes[-1], line)
    axes[-1].set_xlim(start / 1e3, end / 1e3)
    now = at or last_evidence(track)
    when = "" if now is None else f"; expected at {now:%Y-%m-%d %H:%M} UTC"
    headline(figure, f"{track.line}: maximum adhesion, {track.bin_length:.0f} m bins{when}")
    write_figure(figure, path)


def _draw_layer(
    axes: Axes,
    track: TrackConditionMap,
    name: str,
    layer: ConditionLayer,
    truth: FloatArray | None,
    at: pd.Timestamp | None,
    part: tuple[float, float],
) -> None:
    colour = COLOURS.get(name, INK)
    edges = bin_edges(track) / 1e3
    centres = 0.5 * (edges[:-1] + edges[1:])
    _shade_unobserved(axes, edges, layer.observed)
    if truth is not None:
        axes.stairs(truth, edges, baseline=None, color=INK, linewidth=0.8, label="truth")
    used = np.fmax.reduce(np.where(layer.evidence.censored > 0.0, track.levels, np.nan), axis=1)
    axes.stairs(
        used, edges, baseline=None, color=GREY, alpha=0.8, linewidth=1.0, label="used without slip"
    )
    # Bins are narrow on a long line: estimates are drawn as points with bars, side by side.
    expected = layer.expected(at)
    for estimate, ink, width, words in (
        (expected, PURPLE, 3.2, "expected, 95 % band"),
        (layer, colour, 1.4, f"{name} lasting, 95 % band"),
    ):
        middle, low, high = shown(estimate)
        seen = np.isfinite(middle)
        axes.vlines(
            centres[seen],
            low[seen],
            high[seen],
            color=ink,
            alpha=0.45 if estimate is expected else 0.6,
            linewidth=width,
            label=words,
        )
        if estimate is expected:  # the ends of the wider band stay visible before the other
            ends: dict[str, Any] = {
                "marker": "_",
                "markersize": 4.0,
                "markeredgewidth": 1.2,
                "zorder": 3.0,
            }
            for limit in (low, high):
                axes.plot(centres[seen], limit[seen], linestyle="", color=ink, **ends)
        size = 2.0 if estimate is expected else 4.0
        axes.plot(centres[seen], middle[seen], ".", color=ink, markersize=size)
    slips = layer.events > 0
    axes.plot(
        centres[slips],
        np.full(np.count_nonzero(slips), 0.025),
        "|",
        transform=axes.get_xaxis_transform(),
        color=RED,
        markersize=7,
        label="slip",
    )
    _draw_marks(axes, track, layer, at, part)


def _legend(figure: Figure, axes: Sequence[Axes]) -> None:
    """One legend for all axes, below them."""
    found: dict[str, Any] = {}
    for place in axes:
        handles, words = place.get_legend_handles_labels()
        found = dict(zip(words, handles, strict=True)) | found
    figure.legend(
        found.values(),
        found.keys(),
        loc="outside lower center",
        fontsize=8,
        frameon=False,
        ncols=len(found),
    )


def _shade_unobserved(axes: Axes, edges: FloatArray, observed: BoolArray) -> None:
    axes.fill_between(
        edges,
        0.0,
        1.0,
        where=np.append(~observed, False),
        step="post",
        transform=axes.get_xaxis_transform(),
        color=PALE,
        alpha=0.45,
        linewidth=0,
        label="not observed",
    )


def _draw_marks(
    axes: Axes,
    track: TrackConditionMap,
    layer: ConditionLayer,
    at: pd.Timestamp | None,
    part: tuple[float, float],
) -> None:
    """Passing spots at their adhesion, the fainter the less likely they still lie there; changes.

    A change is an arrow from the lasting level before it to the one after.
    """
    now = at or last_evidence(track)
    spots = layer.spots if now is not None else ()
    alive = [0.0 if now is None else spot.alive(now) for spot in spots]
    if spots:
        axes.hlines(
            [spot.adhesion for spot in spots],
            [spot.start / 1e3 for spot in spots],
            [spot.end / 1e3 for spot in spots],
            color=[to_rgba(RED, FAINTEST + (1.0 - FAINTEST) * share) for share in alive],
            linewidth=1.2,
        )
        axes.scatter(
            [0.5e-3 * (spot.start + spot.end) for spot in spots],
            [spot.adhesion for spot in spots],
            marker="v",
            s=26,
            color=[to_rgba(RED, FAINTEST + (1.0 - FAINTEST) * share) for share in alive],
            linewidths=0,
        )
        axes.scatter([], [], marker="v", s=26, color=RED, linewidths=0, label="passing spot")
    for each in layer.changes:
        middle = 0.5e-3 * (each.start + each.end)
        axes.annotate(
            "",
            xy=(middle, each.after),
            xytext=(middle, each.before),
            arrowprops={"arrowstyle": "->", "color": GREEN, "linewidth": 1.6},
        )
    if layer.changes:
        axes.plot([], [], color=GREEN, linewidth=1.6, label="lasting change")
    texts = [f"changed {day_name(each.day)}" for each in layer.changes]
    texts += [f"{day_name(each.last)}, {p:.0%}" for each, p in zip(spots, alive, strict=True)]
    parts: list[ConditionChange | PassingSpot] = [*layer.changes, *spots]
    place = np.array([0.5e-3 * (each.start + each.end) for each in parts])
    # Changes first, then the spots that are likeliest there; none of those that are gone.
    rank = np.array([2.0] * len(layer.changes) + alive)
    labelled = (rank >= GONE) & (place >= part[0] / 1e3) & (place <= part[1] / 1e3)
    chosen = np.flatnonzero(labelled)
    texts = [texts[i] for i in chosen]
    _label(axes, LABEL_SPACE * (part[1] - part[0]) / 1e3, place[chosen], texts, rank[chosen])


def _with_labels(axes: Axes, top: float) -> float:
    """The upper end of an adhesion axis, with space for its labels above the data."""
    return (
        top / (1.0 - LABELS) if axes.texts and any(each.get_text() for each in axes.texts) else top
    )


def _label(axes: Axes, space: float, place: FloatArray, texts: list[str], rank: FloatArray) -> None:
    """Write upright labels below the top of the axes, the highest in rank first, none on another.

    Parameters
    ----------
    space : float [km]
        Between two labels.
    """
    taken: list[float] = []
    for i in np.argsort(-rank, kind="stable"):
        if len(taken) < LABELLED and all(abs(place[i] - other) >= space for other in taken):
            axes.text(
                place[i],
                0.98,
                texts[i],
                transform=axes.get_xaxis_transform(),
                rotation=90,
                ha="center",
                va="top",
                fontsize=7,
                color=INK,
            )
            taken.append(float(place[i]))


def _draw_stations(
    axes: Sequence[Axes], strip: Axes, line: Line, part: tuple[float, float] | None = None
) -> None:
    """A dotted line at each station, and their names on a strip below; ends first."""
    start, end = (each / 1e3 for each in part or (0.0, line.length))
    space = LABEL_SPACE * (end - start)
    taken: list[float] = []
    inner = sorted(line.stations[1:-1], key=lambda each: each.position)
    for each in (line.stations[0], line.stations[-1], *inner):
        if not start <= each.position / 1e3 <= end:
            continue
        at = each.position / 1e3
        for place in axes:
            place.axvline(at, color=GREY, linewidth=0.6, linestyle=":", zorder=0.5)
        if all(abs(at - other) >= space for other in taken):
            taken.append(at)
            shown_at = min(max(at, start + 0.25 * space), end - 0.25 * space)
            strip.text(shown_at, 1.0, each.name, rotation=90, ha="center", va="top", fontsize=7)
    strip.set_axis_off()


def draw_difference(found: MapDifference, path: str | Path, *, line: Line | None = None) -> None:
    """Draw both estimates of a difference over km, with the sections that changed shaded.

    Raises
    ------
    InputError
        If no bin was observed in both.
    """
    names = list(dict.fromkeys(found.bins["layer"]))
    if not names:
        raise InputError(
            f"{found.before} and {found.after} observed no bin both: there is nothing to draw",
            remedy="choose other dates or maps",
        )
    figure = new_figure(13.0, 1.2 + 3.0 * len(names) + 0.9 * (line is not None))
    heights = [3.0] * len(names) + [0.9] * (line is not None)
    every = np.atleast_1d(
        figure.subplots(len(heights), 1, sharex=True, height_ratios=heights)
    ).tolist()
    axes = every[: len(names)]
    for place, name in zip(axes, names, strict=True):
        rows = found.bins[found.bins["layer"] == name]
        centres = 0.5e-3 * (rows["start_m"] + rows["end_m"]).to_numpy()
        colour = COLOURS.get(name, INK)
        for side, words, ink, width in (
            ("before", "before", GREY, 3.2),
            ("after", f"{name} after", colour, 1.4),
        ):
            low, high = rows[f"{side}_low"], rows[f"{side}_high"]
            place.vlines(
                centres,
                low,
                high,
                color=ink,
                alpha=0.5,
                linewidth=width,
                label=f"{words}, 95 % band",
            )
            place.plot(centres, rows[side], ".", color=ink, markersize=3.0)
        sections = found.sections[found.sections["layer"] == name]
        for each in sections.to_dict("records"):
            up = each["difference"] > 0.0
            place.axvspan(
                each["start_m"] / 1e3,
                each["end_m"] / 1e3,
                color=GREEN if up else RED,
                alpha=0.25,
                linewidth=0.8,
                label="higher" if up else "lower",
            )
        texts = [f"{change:+.3f}" for change in sections["difference"]]
        middle = 0.5e-3 * (sections["start_m"] + sections["end_m"]).to_numpy()
        size = sections["difference"].abs().to_numpy()
        _label(place, LABEL_SPACE * _reach(found, line), middle, texts, size)
        dress(place, x="", y="maximum adhesion", title=f"{name}: {len(rows)} bins in both")
        highest = rows[["before_high", "after_high"]].to_numpy().max()
        place.set_ylim(0.0, _with_labels(place, max(0.4, 0.1 * np.ceil(10.0 * highest))))
        place.tick_params(labelbottom=True)
    _legend(figure, axes)
    if line is not None:
        _draw_stations(axes, every[-1], line)
    km_axis(axes[-1], line)
    axes[-1].set_xlim(0.0, _reach(found, line))
    compared = f"{found.line}: {found.before}, and {found.after}"
    headline(figure, "\n".join([compared, *textwrap.wrap(found.sentence, 140)]))
    write_figure(figure, path)


def _reach(found: MapDifference, line: Line | None) -> float:
    """Right end of the km axis."""
    return (float(found.bins["end_m"].max()) if line is None else line.length) / 1e3


def draw_history(found: PlaceHistory, path: str | Path) -> None:
    """Draw the evidence of a place over time, and the estimate as it was known by day.

    Raises
    ------
    InputError
        If there is no evidence there.
    """
    if found.onsets.empty and found.used.empty and found.known.empty:
        raise InputError(
            f"{found.title}: there is no evidence to draw", remedy="choose another place or layer"
        )
    figure = new_figure(11.0, 4.6)
    axes = figure.subplots()
    onsets, used = found.onsets, found.used
    days = pd.concat([each["day"] for each in (found.known, onsets, used) if not each.empty])
    end = days.max() + DAY
    # What is known last is drawn to the end of the last day with evidence.
    known = found.known
    if not known.empty:
        known = pd.concat([known, known[-1:].assign(day=end)], ignore_index=True)
    for each in found.spots.to_dict("records"):
        axes.axvspan(
            each["first_day"],
            each["last_day"] + DAY,
            color=RED,
            alpha=0.12,
            linewidth=0,
            label="passing spot met",
        )
    if not known.empty:
        _draw_known(axes, found, known)
    axes.plot(
        found.used["day"], found.used["level"], "^", color=GREY, markersize=4,
        label="used without slip",
    )  # fmt: skip
    axes.errorbar(
        onsets["day"],
        onsets["adhesion"],
        [onsets["adhesion"] - onsets["low"], onsets["high"] - onsets["adhesion"]],
        fmt="o",
        color=RED,
        markersize=4,
        linewidth=1.0,
        capsize=2,
        label="onsets of slip, 95 %",
    )
    for each in found.changes.to_dict("records"):
        axes.axvspan(each["earliest"], each["latest"], color=GREEN, alpha=0.2, linewidth=0)
        axes.axvline(each["day"], color=GREEN, linewidth=1.4, label="lasting change")
    dress(axes, x="", y="maximum adhesion")
    axes.set_ylim(bottom=0.0)
    axes.set_xlim(right=end)
    figure.autofmt_xdate()
    _legend(figure, [axes])
    words = f"{found.title}. {found.unmeasured}".removesuffix(". ")
    headline(figure, textwrap.fill(words, 120))
    write_figure(figure, path)


def _draw_known(axes: Axes, found: PlaceHistory, known: pd.DataFrame) -> None:
    """The estimates as they were known by day, to the right end of the picture."""
    for prefix, value, ink, words in (
        ("expected_", "expected", PURPLE, "expected then, 95 % band"),
        ("", "adhesion", COLOURS.get(found.layer, INK), "lasting as known then, 95 % band"),
    ):
        low, high = known[f"{prefix}low"], known[f"{prefix}high"]
        if prefix:  # an outline: over each other two bands would have a colour of neither
            dashed: dict[str, Any] = {
                "drawstyle": "steps-post",
                "linestyle": "--",
                "color": ink,
                "linewidth": 1.0,
            }
            axes.plot(known["day"], low, label=words, **dashed)
            axes.plot(known["day"], high, **dashed)
        else:
            axes.fill_between(
                known["day"], low, high, step="post", color=ink, alpha=0.3, linewidth=0, label=words
            )
        axes.plot(known["day"], known[value], drawstyle="steps-post", color=ink, linewidth=1.4)
        axes.plot(found.known["day"][-1:], found.known[value][-1:], ".", color=ink)


def _title(track: TrackConditionMap, name: str, layer: ConditionLayer) -> str:
    trips = sum(trip["layer"] == name for trip in track.trips)
    share = float(np.mean(layer.observed))
    onsets = int(layer.events.sum())
    lacking = [trip["notes"] for trip in track.trips if trip["layer"] == name and trip.get("notes")]
    words = f"\n{len(lacking)} of them: {_noted(lacking)}" if lacking else ""
    of = f"{counted(trips, 'trip')}, {counted(onsets, 'onset')} of slip"
    return f"{name}: {of}, {share:.1%} observed{words}"


def _noted(notes: Sequence[Sequence[str]]) -> str:
    """What recorders lacked, each note once, as long as there is space for it."""
    each = dict.fromkeys(note for of_trip in notes for note in of_trip)
    return textwrap.shorten("; ".join(each), 150, placeholder=" ...")


def _top(track: TrackConditionMap, at: pd.Timestamp | None) -> float:
    """Upper end of the adhesion axis: the highest band drawn, in tenths."""
    tops = [
        float(np.nanmax(shown(estimate)[2], initial=0.0))
        for layer in track.layers.values()
        for estimate in (layer, layer.expected(at))
        if estimate.observed.any()
    ]
    return max(0.4, 0.1 * float(np.ceil(10.0 * max(tops, default=0.0))))
