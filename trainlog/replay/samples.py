"""The points of a replay: which curves there are, where the train was when, and how they are sent.

A curve takes its samples from one topic; which fields are drawn, how, in which unit, and whether a
value is held between samples, is in the table of topics (`trainlog.topics.Drawn`).

Every entity of a trip is put on three timelines, so that no view goes blank when the timeline is
changed: ``time`` is the log's UTC clock, ``elapsed`` the time since the trip began, ``position_m``
the chainage in whole metres, counted in the direction of travel: Rerun counts in whole numbers, and
of metres it shows ``#10 123`` at km 10.123. A timeline runs one way: what holds until the next
sample (a limit, a driving phase) would else hold over the wrong stretch. The position timeline is
that of `trainlog.resampling.TimeDistance`, which never decreases.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd
import rerun as rr
from numpy.typing import NDArray

from trainlog.arrays import FloatArray, IntArray
from trainlog.resampling import Nanoseconds, TimeDistance, interpolated
from trainlog.topics import (
    ESTIMATED_ADHESION,
    ESTIMATED_STATE,
    GNSS_MOTION,
    RECORDED,
    STANDSTILL,
    TOPICS,
    TRAIN_AXLES,
    TRAIN_CONTROLS,
    TRAIN_STATE,
    Topic,
    topic_of_frame,
)
from trainlog.trip import Trip, frame_of, nanoseconds
from trainlog.units import NANOSECONDS, factor

TIME, ELAPSED, POSITION = "time", "elapsed", "position_m"
"""Names of the timelines."""


@dataclass(frozen=True, eq=False)
class Instants:
    """When and where samples were taken.

    Attributes
    ----------
    start : int [ns since 1970 UTC]
        From which ``elapsed`` counts.
    time : (n,) int array [ns since 1970 UTC]
    position : (n,) array [m]
    """

    start: int
    time: Nanoseconds
    position: FloatArray

    def __len__(self) -> int:
        return int(self.time.size)

    def columns(self, rows: slice) -> list[Any]:
        """Rerun's time columns of these rows, one a timeline."""
        time = self.time[rows]
        metres = np.rint(self.position[rows]).astype(np.int64)
        return [
            rr.TimeColumn(TIME, timestamp=time.astype("datetime64[ns]")),
            rr.TimeColumn(ELAPSED, duration=(time - self.start).astype("timedelta64[ns]")),
            rr.TimeColumn(POSITION, sequence=metres),
        ]


@dataclass(frozen=True, eq=False)
class Clock(TimeDistance):
    """A trip's time and place, as Rerun's timelines have them."""

    def instants(self, time: Nanoseconds) -> Instants:
        """Time and place of samples taken at `time` [ns]."""
        return Instants(self.start, time, self.position_at(time))


Colour = tuple[int, int, int]
"""Red, green, blue, each 0 to 255."""

COLOURS: dict[str, Colour] = {
    "limit": (235, 90, 90),
    "measured": (90, 180, 240),
    "satellites": (0, 190, 160),
    "estimated": (245, 205, 70),
    "planned": (190, 140, 255),
    "true": (160, 160, 160),
    "traction": (90, 205, 120),
    "motor braking": (250, 160, 60),
    "friction braking": (235, 90, 90),
    "demand": (150, 150, 165),
    "used": (0, 200, 140),
    "terrain": (200, 165, 120),
}
"""Of each kind of curve (`trainlog.topics.Drawn`)."""

AXLES: tuple[Colour, ...] = ((90, 180, 240), (245, 160, 50), (0, 200, 140), (225, 130, 205))
TRIPS: tuple[Colour, ...] = (
    *AXLES,
    COLOURS["estimated"],
    COLOURS["planned"],
    (170, 205, 90),
    (120, 220, 220),
    (255, 140, 120),
    (150, 160, 255),
    (205, 170, 125),
    (180, 180, 190),
)


@dataclass(frozen=True, slots=True)
class Curve:
    """Lines that share a topic, hence a clock: one a field, or one an axle or coupler of a field.

    Attributes
    ----------
    entity : str
        Where it is kept below its trip; the first part is its panel.
    topic : Topic
    fields : tuple of str
    names : tuple of str
        Legend; lines of one name share an entry. Axles with ``{}`` in it, for the axle's number,
        each have their own entry and one of the colours `AXLES`.
    colours : tuple of Colour
    scales, offsets : tuple of float
        What is shown is the scale times the stored value, plus the offset.
    std : str
        Field with the standard deviation: a band of one deviation either side; none if empty.
    magnitude : bool
        Shown without its sign.
    width : float
        Of the lines, in points.
    """

    entity: str
    topic: Topic
    fields: tuple[str, ...]
    names: tuple[str, ...]
    colours: tuple[Colour, ...]
    scales: tuple[float, ...] = (1.0,)
    offsets: tuple[float, ...] = (0.0,)
    std: str = ""
    magnitude: bool = False
    width: float = 1.5

    @property
    def panel(self) -> str:
        """The panel that shows it."""
        return self.entity.partition("/")[0]

    @property
    def held(self) -> bool:
        """Whether a value holds until the next sample."""
        return {self.topic.field(name).interpolation for name in self.fields} == {"previous"}

    @property
    def per_axle(self) -> bool:
        """Whether there is one line an axle."""
        return self.topic.field(self.fields[0]).per_axle


def _curves(topic: Topic) -> Iterator[Curve]:
    """The curves of a topic: fields that are drawn under the same name are one."""
    drawn = [(field, field.drawn) for field in topic.fields if field.drawn is not None]
    for entity in dict.fromkeys(how.curve for _, how in drawn):
        fields, styles = zip(*(each for each in drawn if each[1].curve == entity), strict=True)
        units = [factor(field.usual_unit, field.unit) for field in fields]
        signs = [-1.0 if how.down else 1.0 for how in styles]
        scales = [
            round(1.0 / slope, 9) * sign for (slope, _), sign in zip(units, signs, strict=True)
        ]
        yield Curve(
            entity,
            topic,
            tuple(field.name for field in fields),
            tuple(how.legend for how in styles),
            tuple(COLOURS[how.colour] for how in styles),
            tuple(scales),
            tuple(-offset * scale for (_, offset), scale in zip(units, scales, strict=True)),
            styles[0].std,
            styles[0].magnitude,
            styles[0].width,
        )


CURVES: tuple[Curve, ...] = tuple(curve for topic in TOPICS.values() for curve in _curves(topic))
"""Every curve of the table of topics that a trip can have."""


SPEEDS_SHOWN = ("speed/measured", "speed/satellites", "speed/estimated")
"""A trip's own speed, of which trips over each other show the first that there is."""


SPEEDS: tuple[str, ...] = (TRAIN_STATE.name, GNSS_MOTION.name, ESTIMATED_STATE.name)
"""Topics with a trip's own speed, that which is shown first."""


@dataclass(frozen=True, slots=True)
class Panel:
    """One plot of a trip.

    Attributes
    ----------
    entity : str
        Everything below this part of the trip is shown.
    title : str
        What is shown, with its unit.
    share : float
        Of the height, against the other panels.
    from_zero : bool
        Whether the plot begins at 0.
    beside : bool
        Whether it stands on a tab of its own, with what else the train's recorder has.
    """

    entity: str
    title: str
    share: float
    from_zero: bool = False
    beside: bool = False


PANELS: tuple[Panel, ...] = (
    Panel("speed", "Speed [km/h]", 2.4, from_zero=True),
    Panel("efforts", "Efforts at the wheel rims [kN], braking downwards", 2.0),
    Panel("couplers", "In-train forces [kN], draft upwards, buff downwards", 2.0),
    Panel("slip", "Slip: wheel less train speed [km/h]", 2.0),
    Panel("adhesion", "Adhesion in use and maximum adhesion [1]", 1.7, from_zero=True),
    Panel("resistance", "Running resistance [kN]", 1.1, from_zero=True),
    Panel("gradient", "Gradient [‰], uphill positive", 1.1),
    Panel("voltage", "Line voltage [kV]", 1.0, beside=True),
    Panel("current", "Line current [A], negative when fed back", 1.0, beside=True),
    Panel("pressure", "Brake pressures [bar]", 1.0, from_zero=True, beside=True),
    Panel("doors", "Doors", 0.5, beside=True),
)
"""The plots of a trip from top to bottom; those without data are left out."""


def curves_of(trip: Trip) -> tuple[Curve, ...]:
    """Every curve that a trip can have, those of a recorder's own topics among them."""
    own = _own_fields(trip)
    units = _units(own)
    curves = []
    for number, (topic, name) in enumerate(own):
        panel = f"recorded_{units.index(topic.field(name).unit) + 1}"
        entity = f"{panel}/{topic.name.removeprefix(RECORDED)}/{name}"
        colour = TRIPS[number % len(TRIPS)]
        curves.append(Curve(entity, topic, (name,), (name.replace("_", " "),), (colour,)))
    return CURVES + tuple(curves)


def panels_of(trip: Trip) -> tuple[Panel, ...]:
    """The plots of a trip from top to bottom; of a recorder's own topics one a unit."""
    own = (
        Panel(f"recorded_{number}", f"Recorded [{unit}]", 1.0, beside=True)
        for number, unit in enumerate(_units(_own_fields(trip)), start=1)
    )
    listed = {panel.entity for panel in PANELS}
    units = {
        curve.panel: curve.topic.field(curve.fields[0]).usual_unit
        for curve in CURVES
        if curve.panel not in listed
    }
    return (
        *PANELS,
        *(
            Panel(name, f"{name.replace('_', ' ').capitalize()} [{unit}]", 1.0, beside=True)
            for name, unit in units.items()
        ),
        *own,
    )


def _own_fields(trip: Trip) -> list[tuple[Topic, str]]:
    """The fields of a recorder's own topics, each with its topic."""
    names = sorted(name for name in trip.topics if name.startswith(RECORDED))
    topics = [topic_of_frame(trip[name].attrs) for name in names]
    return [(topic, field.name) for topic in topics for field in topic.fields]


def _units(fields: list[tuple[Topic, str]]) -> list[str]:
    """The units of fields, each once."""
    return list(dict.fromkeys(topic.field(name).unit for topic, name in fields))


def legend(curve: Curve, lines: int) -> tuple[list[str], list[Colour]]:
    """Name and colour of each of `lines` lines of a curve."""
    if not curve.per_axle:
        return list(curve.names), list(curve.colours)
    (name,), (colour,) = curve.names, curve.colours
    apart = "{}" in name
    return (
        [name.format(axle) for axle in range(1, lines + 1)],
        [AXLES[axle % len(AXLES)] if apart else colour for axle in range(lines)],
    )


GAP_PERIODS = 5.0
"""Samples that are this many median periods apart have a gap between them."""

SHORTEST_GAP = NANOSECONDS
"""Shorter pauses are never a gap [ns]."""

APPLIED = 0.02
"""Share of its largest value from which an effort or a lever counts as applied."""


@dataclass(frozen=True, eq=False)
class Samples:
    """The points of a curve.

    Attributes
    ----------
    time : (n,) int array [ns since 1970 UTC]
    ordinates : (n, lines) array
        In the curve's unit; NaN breaks the line.
    variances : (n, lines) array or None
        In that unit squared.
    """

    time: Nanoseconds
    ordinates: FloatArray
    variances: FloatArray | None = None

    def broken_at(self, rows: Any, time: Any) -> Samples:
        """With a row of NaN, which breaks the line, before each of these rows, at these times."""
        variances = self.variances
        return Samples(
            np.insert(self.time, rows, time),
            np.insert(self.ordinates, rows, np.nan, axis=0),
            None if variances is None else np.insert(variances, rows, np.nan, axis=0),
        )


class Pen:
    """Makes the points of a curve piece by piece, with no seams between the pieces.

    Nothing comes before the first piece in which there is anything to show.
    """

    def __init__(self, curve: Curve) -> None:
        self._curve = curve
        self._last = 0
        self._longest: float | None = None
        self._begun = False

    def samples(self, trip: Trip) -> Samples | None:
        """The points of the next piece; None if it has nothing to show."""
        curve = self._curve
        values = shown_values(curve, trip)
        if values is None or not (self._begun or np.isfinite(values).any()):
            return None
        frame = trip[curve.topic.name]
        variances = (_block(frame, [curve.std]) * curve.scales) ** 2 if curve.std else None
        points = Samples(nanoseconds(frame), values, variances)
        if self._longest is None:
            self._longest = longest_pause(points.time)
        points = broken(points, self._longest, self._last if self._begun else None)
        self._begun, self._last = True, int(points.time[-1])
        return thinned(points) if curve.held else points


def shown_values(curve: Curve, trip: Trip) -> FloatArray | None:
    """The ordinates of a curve, (n, lines), in its unit; None if there is no sample of it."""
    if curve.topic.name not in trip or trip[curve.topic.name].empty:
        return None
    frame = trip[curve.topic.name]
    names = list(curve.fields)
    if curve.per_axle:
        names = [name for name in frame.columns if name.startswith(f"{names[0]}_")]
    if not names:
        return None
    values = _block(frame, names) * curve.scales + curve.offsets
    return np.abs(values) if curve.magnitude else values


def longest_pause(time: Nanoseconds) -> float | None:
    """Samples further apart than this [ns] have a gap between them; None of a single sample."""
    if time.size < 2:
        return None
    return max(GAP_PERIODS * float(np.median(np.diff(time))), SHORTEST_GAP)


def broken(points: Samples, longest: float | None = None, before: int | None = None) -> Samples:
    """A row of NaN after each sample that is followed by a gap in time, so that the line breaks.

    Parameters
    ----------
    points : Samples
    longest : float [ns], optional
        What is longer is a gap. Default: `longest_pause` of the points.
    before : int [ns since 1970 UTC], optional
        Time of the last sample before these: the line breaks after it, too.
    """
    if longest is None:
        longest = longest_pause(points.time)
    if longest is None:
        return points
    if before is not None and points.time[0] - before > longest:
        points = points.broken_at(0, before + 1)
    gaps = np.flatnonzero(np.diff(points.time) > longest) + 1
    if before is not None:
        gaps = gaps[points.time[gaps - 1] != before + 1]
    return points.broken_at(gaps, points.time[gaps - 1] + 1)


def thinned(points: Samples) -> Samples:
    """The samples on either side of each change, which is all that a held value needs."""
    variances = points.variances
    every = points.ordinates if variances is None else np.hstack((points.ordinates, variances))
    kept = changes(every)
    return Samples(
        points.time[kept], points.ordinates[kept], None if variances is None else variances[kept]
    )


def changes(values: FloatArray) -> IntArray:
    """Rows on either side of each change of any column, the first and the last, of (n, columns)."""
    same = np.all((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1])), 1)
    kept = np.ones(len(values), dtype=np.bool_)
    kept[1:-1] = ~(same[1:] & same[:-1])
    return np.flatnonzero(kept)


def with_slip(trip: Trip, state: pd.DataFrame | None) -> Trip:
    """The trip with slip speeds: wheel less train speed, where no estimate of them is recorded.

    `state` is the train's state from before the trip's first sample to behind its last.
    """
    if ESTIMATED_ADHESION.name in trip or TRAIN_AXLES.name not in trip or state is None:
        return trip
    axles = trip[TRAIN_AXLES.name]
    wheels = _block(axles, [name for name in axles.columns if name.startswith("wheel_speed_")])
    train = interpolated(state, "speed", pd.DatetimeIndex(axles.index))
    return trip.with_topic(
        frame_of(ESTIMATED_ADHESION, nanoseconds(axles), {"slip_speed": wheels - train[:, None]})
    )


def phases(
    trip: Trip, state: pd.DataFrame | None, largest: FloatArray
) -> tuple[Nanoseconds, NDArray[np.str_]] | None:
    """When the train changed between traction, coasting, braking and standstill, and to which.

    The lever decides, which has no noise; without one the efforts asked for, then those given.
    None if the trip records none of them.

    Parameters
    ----------
    trip : Trip
        Or a piece of one.
    state : DataFrame or None
        The train's state from before the piece's first sample to behind its last.
    largest : (3,) array
        `largest_pulls` of the whole trip.
    """
    if TRAIN_CONTROLS.name not in trip or trip[TRAIN_CONTROLS.name].empty:
        return None
    frame = trip[TRAIN_CONTROLS.name]
    known = [each for each in zip(_pulls(frame), largest.tolist(), strict=True) if each[1] > 0.0]
    if not known:
        return None
    pull, most = known[0]
    pull = np.where(np.abs(pull) < APPLIED * most, 0.0, pull)
    phase = np.select([pull > 0.0, pull < 0.0], ["traction", "braking"], default="coasting")
    if state is not None:
        speed = interpolated(state, "speed", pd.DatetimeIndex(frame.index))
        phase = np.where(speed < STANDSTILL, "standstill", phase)
    phase = np.where(np.isnan(pull), "", phase)
    changed = np.concatenate(([True], phase[1:] != phase[:-1]))
    return nanoseconds(frame)[changed], phase[changed]


def largest_pulls(frame: pd.DataFrame) -> FloatArray:
    """Largest magnitude of the lever, of the effort asked for, and of that given; (3,)."""
    found = [np.nanmax(np.abs(pull), initial=0.0) for pull in _pulls(frame)]
    return np.array(found, dtype=np.float64)


def _pulls(frame: pd.DataFrame) -> tuple[FloatArray, ...]:
    """The lever, the effort asked for, and that given, braking negative; (n,) each."""
    full = frame.reindex(columns=[field.name for field in TRAIN_CONTROLS.fields])
    demand = full["tractive_effort_demand"] - full["braking_effort_demand"]
    given = full["tractive_effort"].fillna(0.0) - full[
        ["dynamic_braking_effort", "pneumatic_braking_effort"]
    ].sum(axis=1)
    return tuple(each.to_numpy(dtype=np.float64) for each in (full["lever"], demand, given))


def _block(frame: pd.DataFrame, names: list[str]) -> FloatArray:
    """Columns side by side; those that an older log does not have are unknown."""
    return frame.reindex(columns=names).to_numpy(dtype=np.float64)


ROWS = 10_000
"""Rows a chunk: larger ones are slower to write and to draw."""


def path_of(*parts: str) -> str:
    """Entity path of these parts, whatever characters they hold."""
    return str(rr.new_entity_path(list(parts)))


def send_static(recording: Any, entity: str, what: Any) -> None:
    """Log something that holds at all times and places."""
    recording.log(entity, what, static=True, strict=True)


def send_rows(
    recording: Any, entity: str, instants: Instants, columns: Callable[[slice], Any]
) -> None:
    """Send the rows of an entity; `columns` makes Rerun's columns of a slice of them."""
    for first in range(0, len(instants), ROWS):
        rows = slice(first, first + ROWS)
        recording.send_columns(entity, instants.columns(rows), columns(rows), strict=True)


def send_curve(
    recording: Any,
    entity: str,
    instants: Instants,
    points: Samples,
    *,
    names: list[str],
    colours: list[Colour],
    width: float = 1.5,
    held: bool = False,
) -> None:
    """Send the points of a curve and how it is drawn: lines, or with variances bands as well."""
    # Rerun counts a plot's ticks from its first sample: they fall on whole kilometres with it.
    instants, points = from_whole_kilometre(instants), points.broken_at(0, points.time[0])
    style = {
        "names": names,
        "colors": np.array(colours, dtype=np.uint8),
        "widths": [width] * len(names),
        "interpolation_mode": "StepAfter" if held else "Linear",
        # Seen from afar Rerun shows the mean of neighbouring samples: a limit that was never in
        # force on either side of each change, and slips that never were as high.
        "aggregation_policy": "Off" if held else "MinMax",
    }
    style_of = rr.SeriesLines if points.variances is None else rr.Measurements.from_fields
    send_static(recording, entity, style_of(**style))
    send_samples(recording, entity, instants, points)


def send_samples(recording: Any, entity: str, instants: Instants, points: Samples) -> None:
    """Send further points of a curve."""

    def columns(rows: slice) -> Any:
        values = _rows(points.ordinates[rows])
        if points.variances is None:
            return rr.Scalars.columns(scalars=values)
        return rr.Measurements.columns(values=values, variances=_rows(points.variances[rows]))

    send_rows(recording, entity, instants, columns)


def send_dots(
    recording: Any,
    entity: str,
    instants: Instants,
    values: FloatArray,
    *,
    name: str,
    colour: Colour,
) -> None:
    """Send values, (n,), that are drawn as dots in a plot."""
    style = rr.SeriesPoints(names=name, colors=np.array([colour]), marker_sizes=3.0)
    send_static(recording, entity, style)
    send_rows(recording, entity, instants, lambda rows: rr.Scalars.columns(scalars=values[rows]))


def from_whole_kilometre(instants: Instants) -> Instants:
    """The same with one more, before them, at the whole kilometre before the first position."""
    first = np.floor(instants.position.min() / 1e3) * 1e3
    return Instants(
        instants.start,
        np.insert(instants.time, 0, instants.time[0]),
        np.insert(instants.position, 0, first),
    )


def _rows(block: FloatArray) -> FloatArray:
    """A block as Rerun partitions it: one column flat, several as they are."""
    return np.ascontiguousarray(block[:, 0] if block.shape[1] == 1 else block)
