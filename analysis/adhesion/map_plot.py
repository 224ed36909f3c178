"""Charts of a track-condition map: its state, its differences, the history of a place.

The state of a map is a strip a rail condition along the line, coloured by the adhesion that may be
counted on, and the detail of the lowest places: of a line of 30 km slip shows a twentieth.
"""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pandas as pd

from analysis.adhesion.condition_table import bins_table, day_name, last_evidence, lowest_apart
from analysis.charts import (
    BLUE,
    GREEN,
    GREY,
    INK,
    ORANGE,
    PALE,
    PURPLE,
    RED,
    Cells,
    Chart,
    Curve,
    Label,
    Panel,
    Rule,
    Span,
    days_of,
)
from trainlog.arrays import FloatArray
from trainlog.condition import known_before
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.railway.condition import (
    ADHESION_CLASSES,
    ADHESION_COLOURS,
    ConditionChange,
    ConditionLayer,
    PassingSpot,
    TrackConditionMap,
    adhesion_class,
)
from trainlog.railway.line import Line, km_words
from trainlog.spans import runs_of

if TYPE_CHECKING:
    from analysis.adhesion.map_difference import MapDifference, PlaceHistory


COLOURS = {"dry": ORANGE, "wet": BLUE}
"""Of the layers; others are drawn in ink."""

LOWEST = 5
"""Places that are named and shown in detail."""

APART = 400.0
"""Two of them lie at least so far from each other [m]."""

AROUND = 200.0
"""What a detail shows on either side of its place [m]."""

LEAST_SHOWN = 0.005
"""Share of the line's length that an observed piece of a strip takes at least: to be seen."""

LABELLED = 8
"""Spots, and changes, of a layer that are labelled with their dates: the likeliest."""

GONE = 0.005
"""Spots that lie there less likely than this are drawn pale, and not labelled."""

LABEL_SPACE = 0.022
"""Share of the width that a label beside a vertical line takes."""


def map_charts(
    track: TrackConditionMap,
    *,
    line: Line | None = None,
    at: pd.Timestamp | None = None,
    part: tuple[float, float] | None = None,
) -> list[Chart]:
    """The strips of a map, and the detail of its lowest places.

    What may be counted on is the lower end of the 95 % band of what is expected. Passing spots and
    lasting changes are marked with their dates.

    Parameters
    ----------
    track : TrackConditionMap
    line : Line, optional
        Gives the stations and the operator's kilometres.
    at : Timestamp, optional
        Time of the expected condition; only evidence of the days before its day counts
        (`trainlog.condition.known_before`). Default: right after the last evidence, with all of it.
    part : (2,) tuple of float [m], optional
        Chainage of the ends of the part that is drawn; default: all of the line.

    Raises
    ------
    InputError
        If the map has no layer yet, no evidence is of a day before, or the line is another.

    Examples
    --------
    >>> import trainlog
    >>> charts = map_charts(trainlog.read_map("sample_logs/CH_StGallen_Wil.map"))
    >>> charts[1].title.splitlines()
    ['1: km 20.175', 'dry 0.113 to 0.388', 'wet 0.062 to 0.174']
    """
    if not track.layers:
        raise InputError(
            f"map of line '{track.line}' has no layer to draw", remedy="count a trip in first"
        )
    if line is not None:
        track.check_line(line.name, line.length)
    if at is not None:
        track = known_before(track, at)
    start, end = sorted(part or (0.0, track.length))
    bins = bins_table(track, line, at)
    bins = bins[(bins["end_m"] > start) & (bins["start_m"] < end)]
    rows = lowest_bins(bins)
    places = (0.5 * (rows["start_m"] + rows["end_m"])).tolist()
    now = at or last_evidence(track)
    when = "" if now is None else f"; expected at {now:%Y-%m-%d %H:%M} UTC"
    panels = [
        _strip(track, name, at, (start, end), places, bins[bins["layer"] == name])
        for name in track.layers
    ]
    strips = Chart(
        "km",
        panels,
        caption="Colours: maximum adhesion to count on, the lower end of the 95 % band; where"
        " several bins share a place that can be seen, the lowest. Grey: nothing was observed, the"
        " map has no estimate. Numbers: the lowest places. Spots: the last day on which they were"
        " met, and the probability that they are still there.",
        span=(start / 1e3, end / 1e3),
        line=line,
        title=f"{track.line}: maximum adhesion to count on, {track.bin_length:.0f} m bins{when}",
    )
    details = [
        detail(track, number, place, bins, line) for number, place in enumerate(places, start=1)
    ]
    return [strips, *details]


def lowest_bins(bins: pd.DataFrame, most: int = LOWEST) -> pd.DataFrame:
    """The bins with the lowest adhesion to count on; those of one line apart from each other."""
    observed = bins[bins["observed"]]
    middle = 0.5 * (observed["start_m"] + observed["end_m"])
    # Lines are further apart than any place of one from another.
    place = middle + 1e9 * pd.factorize(observed["line"])[0]
    rows = lowest_apart(place, observed["expected_low"], np.ones(len(place)), APART, most)
    return observed.iloc[rows]


def low_by_bin(track: TrackConditionMap, bins: pd.DataFrame) -> FloatArray:
    """The adhesion to count on of each bin of a map, NaN where rows of `bins_table` have none."""
    low = np.full(track.bins, np.nan)
    low[bins["bin"].to_numpy()] = bins["expected_low"].to_numpy(np.float64)
    return low


def strip_cells(
    track: TrackConditionMap, low: FloatArray, least: float, span: tuple[float, float]
) -> Cells:
    """A strip along a map: the adhesion to count on, pieces as long as `least` [m] at least."""
    edges = track.edges / 1e3
    shown = _widened(low, max(round(least / track.bin_length), 1))
    colours = np.array(
        ["" if np.isnan(each) else ADHESION_COLOURS[adhesion_class(each)] for each in shown]
    )
    hover = {
        "km": [f"{each:.3f}" for each in edges[:-1].tolist()],
        "to count on": ["not observed" if np.isnan(each) else f"{each:.3f}" for each in shown],
    }
    names = dict(zip(ADHESION_CLASSES, ADHESION_COLOURS, strict=True))
    return Cells(edges, span, colours[None, :], names, hover=hover)


def _strip(
    track: TrackConditionMap,
    name: str,
    at: pd.Timestamp | None,
    part: tuple[float, float],
    places: Sequence[float],
    bins: pd.DataFrame,
) -> Panel:
    """A layer along the line: coloured where it was observed, its spots and changes above."""
    layer = track.layers[name]
    low = low_by_bin(track, bins)
    cells = strip_cells(track, low, LEAST_SHOWN * (part[1] - part[0]), (0.0, 0.45))
    first = name == next(iter(track.layers))
    cells = cells if first else replace(cells, names={})
    ground = Span(0.0, 0.45, PALE, "not observed" * first, 0.8, across=True)
    marks, labels = _marks(layer, at or last_evidence(track), part)
    numbers = [
        Label(place / 1e3, str(number), 0.86 if labels else 0.6, size=9.0)
        for number, place in enumerate(places, start=1)
        if np.isfinite(low[int(track.bin_of(place))])
    ]
    return Panel(
        "", [cells, *marks], 1.0 if labels else 0.42, _title(track, name, layer),
        limits=(0.0, 2.4 if labels else 0.95), labels=[*numbers, *labels],
        spans=[ground], bare=True,
    )  # fmt: skip


def _widened(low: FloatArray, least: int) -> FloatArray:
    """Values by bin, where what is known is at least `least` bins wide: the lowest of them."""
    shown = low.copy()
    for begin, end in runs_of(np.isfinite(low)):
        lack = max(least - (end - begin), 0)
        first, last = max(begin - lack // 2, 0), min(end + lack - lack // 2, low.size)
        if lack:
            shown[first:last] = np.fmin(shown[first:last], np.nanmin(low[begin:end]))
            continue
        # Of a long piece each short stretch has its lowest value.
        for at in range(begin, end, least):
            stretch = slice(at, min(at + least, end))
            shown[stretch] = np.nanmin(low[stretch])
    return shown


def _marks(
    layer: ConditionLayer, now: pd.Timestamp | None, part: tuple[float, float]
) -> tuple[list[Curve], list[Label]]:
    """Spots and changes above a strip; those that are likeliest there with their dates."""
    spots = layer.spots if now is not None else ()
    alive = [0.0 if now is None else spot.alive(now) for spot in spots]
    every: list[ConditionChange | PassingSpot] = [*layer.changes, *spots]
    middle = np.array([0.5e-3 * (each.start + each.end) for each in every])
    texts = [f"changed {day_name(each.day)}" for each in layer.changes]
    texts += [f"{day_name(each.last)}, {p:.0%}" for each, p in zip(spots, alive, strict=True)]
    # Changes first, then the spots that are likeliest there; none of those that are gone.
    rank = np.array([2.0] * len(layer.changes) + alive)
    within = (middle >= part[0] / 1e3) & (middle <= part[1] / 1e3)
    chosen = np.flatnonzero((rank >= GONE) & within)
    labels = labels_apart(
        middle[chosen], [texts[i] for i in chosen], rank[chosen], (part[1] - part[0]) / 1e3
    )
    curves = list[Curve]()
    for words, colour, mark, first, last in (
        ("lasting change", GREEN, "s", 0, len(layer.changes)),
        ("passing spot", RED, "v", len(layer.changes), len(every)),
    ):
        rows = [i for i in range(first, last) if within[i]]
        for sure in (True, False):
            some = [i for i in rows if bool(rank[i] >= GONE) is sure]
            name, ink = (words, colour) if sure else (f"{words}, gone", GREY)
            hover = {name: [texts[i] for i in some]}
            level = np.full(len(some), 0.58)
            curve = Curve(
                name, middle[some], level, ink, "points", mark=mark, width=3.2, hover=hover
            )
            curves += [curve] * bool(some)
    return curves, labels


def labels_apart(
    place: FloatArray, texts: Sequence[str], rank: FloatArray, width: float
) -> list[Label]:
    """Upright labels at the top of a panel, the highest in rank first, none on another."""
    found = list[Label]()
    for i in np.argsort(-rank, kind="stable").tolist():
        apart = all(abs(place[i] - other.x) >= LABEL_SPACE * width for other in found)
        if len(found) < LABELLED and apart:
            found.append(Label(float(place[i]), texts[i], upright=True))
    return found


def detail(
    track: TrackConditionMap,
    number: int,
    place: float,
    bins: pd.DataFrame,
    line: Line | None,
    edge: str = "",
) -> Chart:
    """One of the lowest places: what is expected there, with its band, and what was used."""
    here = bins[(bins["end_m"] > place - AROUND) & (bins["start_m"] < place + AROUND)]
    at = ", ".join(filter(None, (edge, km_words(line, place - 0.5 * track.bin_length))))
    curves, words = list[Curve](), [f"{number}: {at}"]
    first = number == 1
    for name in track.layers:
        rows = here[here["layer"] == name]
        km, colour = rows["start_m"].to_numpy(np.float64) / 1e3, COLOURS.get(name, INK)
        curves.append(
            Curve(f"{name}, used without slip", km, rows["used_without_slip"], colour,
                  "step", width=0.9, opacity=0.8)
        )  # fmt: skip
        seen = rows[rows["observed"]]
        middle = 0.5e-3 * (seen["start_m"] + seen["end_m"]).to_numpy(np.float64)
        low, high = (seen[f"expected_{each}"].to_numpy(np.float64) for each in ("low", "high"))
        hover = {
            "km": [f"{each:.3f}" for each in seen["start_km"]],
            "rail": [name] * len(seen),
            "expected": [f"{each:.3f}" for each in seen["expected"]],
            "lasting": [f"{each:.3f}" for each in seen["adhesion"]],
            "95 % band": [f"{a:.3f} to {b:.3f}" for a, b in zip(low, high, strict=True)],
            "onsets of slip": [str(int(each)) for each in seen["events"]],
        }
        if len(seen):
            curves.append(
                Curve(f"{name}, expected, 95 %", middle, seen["expected"], colour,
                      "points", low, high, hover, 2.0)
            )  # fmt: skip
        own = seen[(seen["start_m"] <= place) & (seen["end_m"] >= place)]
        for row in own.to_dict("records"):
            words[1:1] = [str(row["near"])] * bool(len(words) == 1 and row["near"])
            words.append(f"{name} {row['expected_low']:.3f} to {row['expected_high']:.3f}")
    top = max(0.2, 0.1 * float(np.ceil(10.0 * bins["expected_high"].max())))
    return Chart(
        "km", [Panel("maximum adhesion" * first, curves, 0.9, limits=(0.0, top))],
        span=((place - AROUND) / 1e3, (place + AROUND) / 1e3), line=line, places=(),
        title="\n".join(words), beside=not first, width=0.24 if first else 0.2,
    )  # fmt: skip


def difference_charts(found: MapDifference, *, line: Line | None = None) -> list[Chart]:
    """Both estimates of a difference over km, with the sections that changed shaded.

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
    reach = (float(found.bins["end_m"].max()) if line is None else line.length) / 1e3
    compared = f"{found.line}: {found.before}, and {found.after}"
    return [
        Chart(
            "km",
            [_changed(found, name, reach) for name in names],
            span=(0.0, reach),
            line=line,
            title=f"{compared}\n{found.sentence}",
        )
    ]


def _changed(found: MapDifference, name: str, reach: float) -> Panel:
    rows = found.bins[found.bins["layer"] == name]
    centres = 0.5e-3 * (rows["start_m"] + rows["end_m"]).to_numpy()
    colour = COLOURS.get(name, INK)
    curves = [
        Curve(words, centres, rows[side], ink, "points", rows[f"{side}_low"], rows[f"{side}_high"])
        for side, words, ink in (
            ("before", "before, 95 % band", GREY),
            ("after", f"{name} after, 95 % band", colour),
        )
    ]
    sections = found.sections[found.sections["layer"] == name]
    spans = dict[str, Span]()
    every = list[Span]()
    for each in sections.to_dict("records"):
        words = "higher" if each["difference"] > 0.0 else "lower"
        ink = GREEN if words == "higher" else RED
        ends = each["start_m"] / 1e3, each["end_m"] / 1e3
        every.append(Span(*ends, ink, words if words not in spans else "", 0.25))
        spans[words] = every[-1]
    middle = 0.5e-3 * (sections["start_m"] + sections["end_m"]).to_numpy()
    texts = [f"{change:+.3f}" for change in sections["difference"]]
    labels = labels_apart(middle, texts, sections["difference"].abs().to_numpy(), reach)
    highest = max(0.4, 0.1 * float(np.ceil(10.0 * rows[["before_high", "after_high"]].max().max())))
    return Panel(
        "maximum adhesion", curves, 1.2, f"{name}: {counted(len(rows), 'bin')} in both",
        limits=(0.0, highest * (1.3 if labels else 1.0)), spans=every, labels=labels,
    )  # fmt: skip


def history_charts(found: PlaceHistory) -> list[Chart]:
    """The evidence of a place over time, and the estimate as it was known by day.

    Raises
    ------
    InputError
        If there is no evidence there.
    """
    if found.onsets.empty and found.used.empty and found.known.empty:
        raise InputError(
            f"{found.title}: there is no evidence to draw", remedy="choose another place or layer"
        )
    onsets, used, known = found.onsets, found.used, found.known
    days = np.concatenate([days_of(each["day"]) for each in (known, onsets, used)])
    first, end = days.min(), days.max() + 1.0
    spans = [
        Span(float(first), float(last) + 1.0, RED, "" if number else "passing spot met", 0.12)
        for number, (first, last) in enumerate(
            zip(days_of(found.spots["first_day"]), days_of(found.spots["last_day"]), strict=True)
        )
    ]
    changes = found.changes
    spans += [
        Span(float(first), float(last), GREEN, "", 0.2)
        for first, last in zip(
            days_of(changes["earliest"]), days_of(changes["latest"]), strict=True
        )
    ]
    rules = [
        Rule(float(day), GREEN, "" if number else "lasting change", upright=True, width=1.4)
        for number, day in enumerate(days_of(changes["day"]))
    ]
    marks = [
        Curve("used without slip", days_of(used["day"]), used["level"], GREY, "points", mark="^",
              width=2.0),
        Curve("onsets of slip, 95 %", days_of(onsets["day"]), onsets["adhesion"], RED, "points",
              onsets["low"], onsets["high"], width=2.0),
    ]  # fmt: skip
    panel = Panel(
        "maximum adhesion", [*_known(found, end), *(each for each in marks if np.size(each.x))],
        1.6, from_zero=True, spans=spans, rules=rules,
    )  # fmt: skip
    words = f"{found.title}. {found.unmeasured}".removesuffix(". ")
    return [
        Chart("", [panel], dates=True,
              span=(first - 0.02 * (end - first), end), title=textwrap.fill(words, 120))
    ]  # fmt: skip


def _known(found: PlaceHistory, end: float) -> list[Curve]:
    """The estimates as they were known by day, the last up to the end of its day."""
    known = found.known
    if known.empty:
        return []
    known = pd.concat([known, known[-1:]], ignore_index=True)
    day = days_of(known["day"])
    day[-1] = end
    colour = COLOURS.get(found.layer, INK)
    return [
        Curve("lasting as known then, 95 % band", day, known["adhesion"], colour, "step",
              known["low"], known["high"]),
        Curve("expected then, 95 % band", day, known["expected"], PURPLE, "step", width=1.4),
        Curve("", day, known["expected_low"], PURPLE, "step", width=1.0, dash="--"),
        Curve("", day, known["expected_high"], PURPLE, "step", width=1.0, dash="--"),
    ]  # fmt: skip


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
