"""What the replay draws: one table of curves, one of panels.

A curve takes its samples from one topic; whether it is held between samples is the topic table's
rule. Speeds are shown in km/h, efforts in kN, gradients per mille; braking points downwards.
"""

from __future__ import annotations

from dataclasses import dataclass

from trainlog.topics import (
    ENVIRONMENT,
    ESTIMATED_ADHESION,
    ESTIMATED_RESISTANCE,
    ESTIMATED_STATE,
    GNSS_MOTION,
    RECORDED,
    REFERENCE,
    TRAIN_BRAKES,
    TRAIN_CONTROLS,
    TRAIN_COUPLERS,
    TRAIN_DOORS,
    TRAIN_STATE,
    TRAIN_SUPPLY,
    TRUTH,
    Topic,
    topic_of_frame,
)
from trainlog.trip import Trip
from trainlog.units import KMH, PER_MILLE

Colour = tuple[int, int, int]
"""Red, green, blue, each 0 to 255."""

KILO = 1e-3
"""Kilonewtons in one newton."""

BAR = 1e-5
"""Bar in one pascal."""

LIMIT: Colour = (235, 90, 90)
MEASURED: Colour = (90, 180, 240)
SATELLITES: Colour = (0, 190, 160)
ESTIMATED: Colour = (245, 205, 70)
PLANNED: Colour = (190, 140, 255)
TRUE: Colour = (160, 160, 160)
TRACTION: Colour = (90, 205, 120)
MOTOR_BRAKING: Colour = (250, 160, 60)
FRICTION_BRAKING: Colour = (235, 90, 90)
DEMAND: Colour = (150, 150, 165)
USED: Colour = (0, 200, 140)
TERRAIN: Colour = (200, 165, 120)
AXLES: tuple[Colour, ...] = (
    (90, 180, 240),
    (245, 160, 50),
    (0, 200, 140),
    (225, 130, 205),
)
TRIPS: tuple[Colour, ...] = (
    *AXLES,
    ESTIMATED,
    PLANNED,
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
class Stroke:
    """One field of a topic as a line; a field ``per_axle`` gives one line an axle or coupler.

    Attributes
    ----------
    field : str
    name : str
        Legend; lines of one name share an entry. Axles with ``{}`` in it, for the axle's number,
        each have their own entry and one of the colours `AXLES`.
    colour : Colour
    scale : float
        Shown over stored value.
    """

    field: str
    name: str
    colour: Colour
    scale: float = 1.0


@dataclass(frozen=True, slots=True)
class Curve:
    """Lines that share a topic, hence a clock.

    Attributes
    ----------
    entity : str
        Where it is kept below its trip; the first part is its panel.
    topic : Topic
    strokes : tuple of Stroke
    std : str or None
        Field with the standard deviation: a band of one deviation either side.
    magnitude : bool
        Shown without its sign.
    width : float
        Of the lines, in points.
    """

    entity: str
    topic: Topic
    strokes: tuple[Stroke, ...]
    std: str | None = None
    magnitude: bool = False
    width: float = 1.5

    @property
    def panel(self) -> str:
        """The panel that shows it."""
        return self.entity.partition("/")[0]

    @property
    def held(self) -> bool:
        """Whether a value holds until the next sample."""
        rules = {self.topic.field(stroke.field).interpolation for stroke in self.strokes}
        return rules == {"previous"}

    @property
    def per_axle(self) -> bool:
        """Whether there is one line an axle."""
        return self.topic.field(self.strokes[0].field).per_axle


CURVES: tuple[Curve, ...] = (
    Curve("speed/limit", ENVIRONMENT, (Stroke("speed_limit", "limit", LIMIT, KMH),)),
    Curve("speed/reference", REFERENCE, (Stroke("speed", "reference", PLANNED, KMH),), width=2.0),
    Curve("speed/satellites", GNSS_MOTION, (Stroke("speed", "satellites", SATELLITES, KMH),)),
    Curve("speed/measured", TRAIN_STATE, (Stroke("speed", "wheels", MEASURED, KMH),), width=2.5),
    Curve(
        "speed/estimated",
        ESTIMATED_STATE,
        (Stroke("speed", "estimated", ESTIMATED, KMH),),
        std="speed_std",
        width=1.0,
    ),
    Curve(
        "efforts/demand",
        TRAIN_CONTROLS,
        (
            Stroke("tractive_effort_demand", "demanded", DEMAND, KILO),
            Stroke("braking_effort_demand", "demanded", DEMAND, -KILO),
        ),
        width=1.0,
    ),
    Curve(
        "efforts/reference",
        REFERENCE,
        (
            Stroke("tractive_effort", "reference", PLANNED, KILO),
            Stroke("braking_effort", "reference", PLANNED, -KILO),
        ),
    ),
    Curve(
        "efforts/measured",
        TRAIN_CONTROLS,
        (
            Stroke("tractive_effort", "traction", TRACTION, KILO),
            Stroke("dynamic_braking_effort", "motor braking", MOTOR_BRAKING, -KILO),
            Stroke("pneumatic_braking_effort", "friction braking", FRICTION_BRAKING, -KILO),
        ),
    ),
    Curve("couplers", TRAIN_COUPLERS, (Stroke("force", "coupler {}", AXLES[0], KILO),), width=1.0),
    Curve("slip", ESTIMATED_ADHESION, (Stroke("slip_speed", "axle {}", AXLES[0], KMH),), width=1.0),
    Curve(
        "adhesion/used",
        ESTIMATED_ADHESION,
        (Stroke("adhesion", "in use", USED),),
        magnitude=True,
        width=1.0,
    ),
    Curve(
        "adhesion/true",
        TRUTH,
        (Stroke("maximum_adhesion", "true maximum (simulated)", TRUE),),
        width=1.0,
    ),
    Curve(
        "resistance/true",
        TRUTH,
        (Stroke("running_resistance", "true (simulated)", TRUE, KILO),),
        width=1.0,
    ),
    Curve(
        "resistance/estimated",
        ESTIMATED_RESISTANCE,
        (Stroke("resistance", "estimated", ESTIMATED, KILO),),
        std="resistance_std",
    ),
    Curve(
        "gradient", ENVIRONMENT, (Stroke("gradient", "gradient", TERRAIN, PER_MILLE),), width=2.0
    ),
    Curve("voltage", TRAIN_SUPPLY, (Stroke("line_voltage", "line voltage", MEASURED, KILO),)),
    Curve("current", TRAIN_SUPPLY, (Stroke("line_current", "line current", TRACTION),)),
    Curve(
        "pressure",
        TRAIN_BRAKES,
        (
            Stroke("brake_pipe_pressure", "brake pipe", MEASURED, BAR),
            Stroke("brake_cylinder_pressure", "brake cylinders", FRICTION_BRAKING, BAR),
        ),
    ),
    Curve("doors", TRAIN_DOORS, (Stroke("release", "doors released", USED),)),
)
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


def curves_of(trip: Trip) -> tuple[Curve, ...]:
    """Every curve that a trip can have, those of a recorder's own topics among them."""
    own = _own_fields(trip)
    units = _units(own)
    curves = []
    for number, (topic, name) in enumerate(own):
        stroke = Stroke(name, name.replace("_", " "), TRIPS[number % len(TRIPS)])
        entity = f"{_panel_of(topic, name, units)}/{topic.name.removeprefix(RECORDED)}/{name}"
        curves.append(Curve(entity, topic, (stroke,)))
    return CURVES + tuple(curves)


def panels_of(trip: Trip) -> tuple[Panel, ...]:
    """The plots of a trip from top to bottom; of a recorder's own topics one a unit."""
    return PANELS + tuple(
        Panel(f"recorded_{number}", f"Recorded [{unit}]", 1.0, beside=True)
        for number, unit in enumerate(_units(_own_fields(trip)), start=1)
    )


def _own_fields(trip: Trip) -> list[tuple[Topic, str]]:
    """The fields of a recorder's own topics, each with its topic."""
    names = sorted(name for name in trip.topics if name.startswith(RECORDED))
    topics = [topic_of_frame(trip[name].attrs) for name in names]
    return [(topic, field.name) for topic in topics for field in topic.fields]


def _units(fields: list[tuple[Topic, str]]) -> list[str]:
    """The units of fields, each once."""
    return list(dict.fromkeys(topic.field(name).unit for topic, name in fields))


def _panel_of(topic: Topic, name: str, units: list[str]) -> str:
    return f"recorded_{units.index(topic.field(name).unit) + 1}"


def legend(curve: Curve, lines: int) -> tuple[list[str], list[Colour]]:
    """Name and colour of each of `lines` lines of a curve."""
    if curve.per_axle:
        (stroke,) = curve.strokes
        apart = "{}" in stroke.name
        return (
            [stroke.name.format(axle) for axle in range(1, lines + 1)],
            [AXLES[axle % len(AXLES)] if apart else stroke.colour for axle in range(lines)],
        )
    return [stroke.name for stroke in curve.strokes], [stroke.colour for stroke in curve.strokes]
