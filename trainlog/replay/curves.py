"""What the replay draws: the curves of the table of topics, and a table of panels.

A curve takes its samples from one topic; which fields are drawn, how, in which unit, and whether a
value is held between samples, is in the table of topics (`trainlog.topics.Drawn`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from trainlog.topics import RECORDED, TOPICS, Topic, topic_of_frame
from trainlog.trip import Trip
from trainlog.units import factor

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

AXLES: tuple[Colour, ...] = (
    (90, 180, 240),
    (245, 160, 50),
    (0, 200, 140),
    (225, 130, 205),
)
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


PHASES: dict[str, Colour] = {
    "traction": (45, 140, 75),
    "coasting": (95, 100, 120),
    "braking": (185, 85, 45),
    "standstill": (45, 45, 50),
}
"""Driving phases and their colours."""


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


def _further_panels() -> tuple[Panel, ...]:
    """Panels that curves name and `PANELS` does not list: titled by name and unit."""
    listed = {panel.entity for panel in PANELS}
    units = {
        curve.panel: curve.topic.field(curve.fields[0]).usual_unit
        for curve in CURVES
        if curve.panel not in listed
    }
    return tuple(
        Panel(name, f"{name.replace('_', ' ').capitalize()} [{unit}]", 1.0, beside=True)
        for name, unit in units.items()
    )


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
    return (*PANELS, *_further_panels(), *own)


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
