"""The one table of topics: what a trip can hold, in which unit, and how to interpolate it.

The protobuf schemas in the log, the columns of the frames, the units in ``DataFrame.attrs``, the
limits of ingested values, the fields that a profile is proposed for, the curves of the replay and
the documentation are all made from this table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

from trainlog.errors import InputError

Interpolation = Literal["linear", "previous", "none"]
"""How a value between two samples is found: on a line, held since the last, or not at all."""

Each = Literal["", "powered axle", "vehicle", "coupler"]
"""What a field has one value for, if not for the whole train."""

USUAL = {"m/s": "km/h", "N": "kN", "V": "kV", "Pa": "bar", "K": "degC"}
"""Units in which people state quantities, where it is not the SI unit."""

STANDSTILL = 0.1
"""Recorded speed [m/s] up to which a train stands: wheel speeds of a train at rest are noise."""

SCHEMA_VERSION = 1
"""Raised when a field changes its meaning; new fields are added without raising it."""


@dataclass(frozen=True, slots=True)
class Bounds:
    """What a recorded value can be, and how fast it can change, in SI units.

    Attributes
    ----------
    low, high : float
        Smallest and largest possible value: others are errors of the recorder or of the unit.
    rate, tolerance : float
        Two values differ by at most ``tolerance + rate * (time between them)``, else one of them
        is a spike; an infinite rate means that spikes are not sought.
    """

    low: float = -math.inf
    high: float = math.inf
    rate: float = math.inf
    tolerance: float = 0.0


@dataclass(frozen=True, slots=True)
class Recorded:
    """How recorders call a field and write it: by this a profile is proposed for unknown columns.

    Attributes
    ----------
    words : str
        Names of the quantity in English, German and French, without accents, separated by blanks;
        the first one names it. Fields with the same first word share all their words. Words of up
        to three letters must be whole words of a column's name.
    qualifier : str
        Words of which a column's name must hold one as well; the first one names them.
    plausible : tuple of float
        Smallest and largest value [SI] that nearly all of a column must have; default: the bounds.
    integers : float
        Scale in which receivers write the field as integers, such as 0.001; 0 if they do not.
    """

    words: str
    qualifier: str = ""
    plausible: tuple[float, float] | None = None
    integers: float = 0.0


Colour = Literal[
    "limit", "measured", "satellites", "estimated", "planned", "true", "traction",
    "motor braking", "friction braking", "demand", "used", "terrain",
]  # fmt: skip
"""What a curve shows: curves of the same kind have the same colour."""


@dataclass(frozen=True, slots=True)
class Drawn:
    """How the replay draws a field: a line in the field's usual unit.

    Attributes
    ----------
    curve : str
        Panel and name, ``"efforts/demand"``; fields of a topic with the same curve are drawn
        together. A panel that `trainlog.replay.samples` does not list is added below the others.
    legend : str
        With ``{}`` for the number of the axle or coupler, each of which then has its own colour.
    colour : str
    down : bool
        Drawn downwards, as braking efforts are.
    std : str
        Field with the standard deviation, drawn as a band; none if empty.
    magnitude : bool
        Drawn without its sign.
    width : float
        Of the line [points].
    """

    curve: str
    legend: str
    colour: Colour
    down: bool = False
    std: str = ""
    magnitude: bool = False
    width: float = 1.5


@dataclass(frozen=True, slots=True)
class Field:
    """One quantity of a topic.

    Attributes
    ----------
    name : str
        Column of the frame and field of the message.
    unit : str
        SI unit; ``"1"`` for pure numbers, ``""`` for text and codes.
    meaning : str
        What it is, in the field's terms.
    interpolation : {"linear", "previous", "none"}
    each : {"", "powered axle", "vehicle", "coupler"}
        What has a value of its own: the frame then has columns ``name_1 … name_n``, front first.
    usual : str
        Unit in which people state it and recorders mostly write it; if empty that of `USUAL`.
    bounds : Bounds
        What a recorded value can be; unbounded by default.
    recorded : Recorded, optional
        How recorders call it, where its name alone shows what a column holds.
    drawn : Drawn, optional
        How the replay draws it; not at all if absent.

    Examples
    --------
    >>> import trainlog
    >>> trainlog.TopicField("pressure", "Pa", "of the oil").interpolation
    'linear'
    """

    name: str
    unit: str
    meaning: str
    interpolation: Interpolation = "linear"
    each: Each = ""
    usual: str = ""
    bounds: Bounds = Bounds()
    recorded: Recorded | None = None
    drawn: Drawn | None = None

    @property
    def usual_unit(self) -> str:
        """Unit in which it is shown to people."""
        return self.usual or USUAL.get(self.unit, self.unit or "1")

    @property
    def per_axle(self) -> bool:
        """Whether there are several values: one for each powered axle, vehicle or coupler."""
        return bool(self.each)


@dataclass(frozen=True, slots=True)
class Topic:
    """One stream of samples with a common clock.

    Attributes
    ----------
    name : str
        Channel name in the log.
    message : str
        Protobuf message; ``trainlog.*`` messages have one ``optional double`` a field (repeated
        for the axles), ``foxglove.*`` are the published Foxglove schemas.
    """

    name: str
    message: str
    meaning: str
    fields: tuple[Field, ...]

    def field(self, name: str) -> Field:
        """The field called `name`; KeyError if there is none."""
        for candidate in self.fields:
            if candidate.name == name:
                return candidate
        raise KeyError(name)

    @property
    def foxglove(self) -> bool:
        """Whether the message is one of Foxglove's published schemas."""
        return self.message.startswith("foxglove.")


TRAIN_STATE = Topic(
    "/train/state",
    "trainlog.TrainState",
    "The train's own odometry.",
    (
        Field(
            "position",
            "m",
            "chainage of the train's front, positive in the direction of travel",
            bounds=Bounds(-1e6, 1e7, rate=150.0, tolerance=20.0),
        ),
        Field(
            "speed",
            "m/s",
            "speed over ground from the wheels",
            bounds=Bounds(-1.0, 150.0, rate=5.0, tolerance=2.0),
            drawn=Drawn("speed/measured", "wheels", "measured", width=2.5),
        ),
        Field(
            "acceleration",
            "m/s^2",
            "longitudinal acceleration",
            bounds=Bounds(-6.0, 6.0),
            recorded=Recorded("acceleration accel beschleunigung beschl a acc"),
        ),
    ),
)

TRAIN_CONTROLS = Topic(
    "/train/controls",
    "trainlog.TrainControls",
    "Demands of the driver, and efforts of the train.",
    (
        Field(
            "lever",
            "1",
            "combined lever: 1 full traction, -1 full service braking",
            "previous",
            bounds=Bounds(-1.05, 1.05),
            recorded=Recorded(
                "lever handle fahrhebel fahrschalter fahrbremshebel hebel hebelstellung throttle "
                "manipulateur manip controller commande fahrstufe notch cran"
            ),
        ),
        Field(
            "tractive_effort_demand",
            "N",
            "tractive effort asked for",
            "previous",
            bounds=Bounds(0.0, 3e6),
            drawn=Drawn("efforts/demand", "demanded", "demand", width=1.0),
        ),
        Field(
            "braking_effort_demand",
            "N",
            "braking effort asked for",
            "previous",
            bounds=Bounds(0.0, 6e6),
            drawn=Drawn("efforts/demand", "demanded", "demand", down=True, width=1.0),
        ),
        Field(
            "tractive_effort",
            "N",
            "tractive effort at the wheel rims",
            bounds=Bounds(0.0, 3e6),
            drawn=Drawn("efforts/measured", "traction", "traction"),
        ),
        Field(
            "dynamic_braking_effort",
            "N",
            "braking effort of the traction motors",
            bounds=Bounds(0.0, 3e6),
            drawn=Drawn("efforts/measured", "motor braking", "motor braking", down=True),
        ),
        Field(
            "pneumatic_braking_effort",
            "N",
            "braking effort of the friction brakes",
            bounds=Bounds(0.0, 6e6),
            drawn=Drawn("efforts/measured", "friction braking", "friction braking", down=True),
        ),
    ),
)

TRAIN_AXLES = Topic(
    "/train/axles",
    "trainlog.TrainAxles",
    "The powered axles, one value each.",
    (
        Field(
            "wheel_speed",
            "m/s",
            "circumferential speed of the wheels",
            each="powered axle",
            # Spinning wheels gain 10 m/s² and more: only what no wheel can do is a spike.
            bounds=Bounds(-1.0, 150.0, rate=40.0, tolerance=5.0),
        ),
        Field(
            "wheel_effort",
            "N",
            "motor torque over wheel radius, positive in traction, negative in braking",
            each="powered axle",
            bounds=Bounds(-3e5, 3e5),
        ),
    ),
)

TRAIN_SLIP_PROTECTION = Topic(
    "/train/slip_protection",
    "trainlog.SlipProtection",
    "Action of the slip protection of the powered axles.",
    (
        Field(
            "active",
            "1",
            "axles on which it acts; where that is not recorded 1 while it acts anywhere, else 0",
            "previous",
        ),
    ),
)

SLIP_PROTECTION = "slip protection"
"""Name, or beginning of the message, of an event that reports that slip protection acts."""

TRAIN_VEHICLES = Topic(
    "/train/vehicles",
    "trainlog.TrainVehicles",
    "The vehicles of a consist from front to rear, one value each.",
    (
        Field("chainage", "m", "chainage of the vehicle's middle", each="vehicle"),
        Field("speed", "m/s", "speed over ground", each="vehicle"),
        Field("tractive_effort", "N", "tractive effort at the wheel rims", each="vehicle"),
        Field("braking_effort", "N", "braking effort at the wheel rims", each="vehicle"),
    ),
)

TRAIN_COUPLERS = Topic(
    "/train/couplers",
    "trainlog.TrainCouplers",
    "The couplers of a consist from front to rear, one value each.",
    (
        Field(
            "force",
            "N",
            "in-train force, positive when pulled apart",
            each="coupler",
            drawn=Drawn("couplers", "coupler {}", "measured", width=1.0),
        ),
        Field(
            "stretch",
            "m",
            "how far the vehicles are apart over rest, negative when pushed together",
            each="coupler",
        ),
    ),
)

GNSS_FIX = Topic(
    "/gnss/fix",
    "foxglove.LocationFix",
    "Satellite position (WGS 84).",
    (
        Field(
            "latitude",
            "deg",
            "geodetic latitude, north positive",
            bounds=Bounds(-90.0, 90.0),
            recorded=Recorded("latitude lat breitengrad breite nord"),
        ),
        Field(
            "longitude",
            "deg",
            "geodetic longitude, east positive",
            bounds=Bounds(-180.0, 180.0),
            recorded=Recorded("longitude lon lng long laengengrad laenge ost"),
        ),
        Field(
            "altitude",
            "m",
            "height above the ellipsoid or sea level, as the receiver gives it",
            bounds=Bounds(-500.0, 9000.0, rate=20.0, tolerance=100.0),
            recorded=Recorded(
                "altitude alt elevation ele height hoehe hauteur seehoehe",
                plausible=(-450.0, 5500.0),
                integers=1e-3,
            ),
        ),
        Field(
            "horizontal_accuracy",
            "m",
            "standard deviation of each horizontal axis",
            bounds=Bounds(0.0, 1e5),
            recorded=Recorded(
                "hacc accuracy genauigkeit precision horizontalaccuracy",
                plausible=(0.0, 2000.0),
                integers=1e-3,
            ),
        ),
        Field(
            "vertical_accuracy",
            "m",
            "standard deviation of the altitude",
            bounds=Bounds(0.0, 1e5),
            recorded=Recorded(
                "vacc verticalaccuracy altitudeaccuracy hoehengenauigkeit precisionverticale",
                plausible=(0.0, 2000.0),
                integers=1e-3,
            ),
        ),
    ),
)

GNSS_MOTION = Topic(
    "/gnss/motion",
    "trainlog.GnssMotion",
    "Satellite speed over ground and the receiver's own quality figures.",
    (
        Field(
            "speed",
            "m/s",
            "speed over ground (Doppler)",
            bounds=Bounds(0.0, 150.0, rate=5.0, tolerance=3.0),
            drawn=Drawn("speed/satellites", "satellites", "satellites"),
        ),
        Field(
            "speed_accuracy",
            "m/s",
            "standard deviation of the speed",
            usual="m/s",
            bounds=Bounds(0.0, 1e4),
            recorded=Recorded(
                "sacc speedacc speedaccuracy geschwindigkeitsgenauigkeit",
                plausible=(0.0, 50.0),
                integers=1e-3,
            ),
        ),
        Field(
            "satellites",
            "1",
            "satellites used",
            "previous",
            bounds=Bounds(0.0, 200.0),
            recorded=Recorded(
                "satellites satelliten sats nsat numsv numsat anzahlsat", plausible=(0.0, 80.0)
            ),
        ),
        Field(
            "pdop",
            "1",
            "position dilution of precision",
            "previous",
            bounds=Bounds(0.0, 100.0),
            recorded=Recorded("pdop", integers=1e-2),
        ),
    ),
)

ENVIRONMENT = Topic(
    "/environment",
    "trainlog.Environment",
    "The line under the train and the air around it.",
    (
        Field(
            "speed_limit",
            "m/s",
            "permitted speed at the position",
            "previous",
            bounds=Bounds(0.0, 150.0),
            drawn=Drawn("speed/limit", "limit", "limit"),
        ),
        Field(
            "gradient",
            "1",
            "rise over run at the train's front, uphill positive",
            "previous",
            usual="permil",
            bounds=Bounds(-0.2, 0.2),
            recorded=Recorded(
                "gradient slope grade neigung steigung gefaelle pente declivite rampe",
                plausible=(-0.08, 0.08),
            ),
            drawn=Drawn("gradient", "gradient", "terrain", width=2.0),
        ),
        Field(
            "curvature",
            "1/m",
            "signed curvature of the track, as the line file gives it",
            bounds=Bounds(-0.05, 0.05),
            recorded=Recorded("curvature kruemmung courbure", plausible=(-0.02, 0.02)),
        ),
        Field(
            "air_temperature",
            "K",
            "outside air temperature",
            bounds=Bounds(213.15, 333.15),
            recorded=Recorded(
                "temperature temperatur temp t",
                qualifier="outside ambient aussen exterieure exterieur ext external",
                plausible=(228.0, 333.0),
            ),
        ),
        Field(
            "head_wind",
            "m/s",
            "wind against the direction of travel",
            usual="m/s",
            bounds=Bounds(-60.0, 60.0),
        ),
    ),
)

EVENTS = Topic(
    "/events",
    "foxglove.Log",
    "Events, as text.",
    (
        Field("level", "", "foxglove.Log level: 1 debug, 2 info, 3 warning, 4 error", "none"),
        Field(
            "message",
            "",
            "what happened",
            "none",
            recorded=Recorded(
                "message meldung ereignis event evenement bemerkung remark comment kommentar"
            ),
        ),
        Field("name", "", "which part of the train or the software says so", "none"),
    ),
)

ESTIMATED_STATE = Topic(
    "/estimates/state",
    "trainlog.EstimatedState",
    "Smoothed train state.",
    (
        Field("position", "m", "chainage of the train's front"),
        Field("position_std", "m", "its standard deviation"),
        Field(
            "speed",
            "m/s",
            "speed over ground",
            drawn=Drawn("speed/estimated", "estimated", "estimated", std="speed_std", width=1.0),
        ),
        Field("speed_std", "m/s", "its standard deviation"),
        Field("acceleration", "m/s^2", "longitudinal acceleration"),
        Field("acceleration_std", "m/s^2", "its standard deviation"),
    ),
)

ESTIMATED_RESISTANCE = Topic(
    "/estimates/running_resistance",
    "trainlog.EstimatedResistance",
    "Running resistance R = r0 + r1 v + r2 v² as learnt up to each instant.",
    (
        Field("r0", "N", "constant term", "previous"),
        Field("r1", "N/(m/s)", "linear term", "previous"),
        Field("r2", "N/(m/s)^2", "quadratic term", "previous"),
        Field("mass", "kg", "train mass without the rotating part", "previous"),
        Field(
            "resistance",
            "N",
            "R at the present speed",
            "previous",
            drawn=Drawn("resistance/estimated", "estimated", "estimated", std="resistance_std"),
        ),
        Field("resistance_std", "N", "its standard deviation", "previous"),
    ),
)

ESTIMATED_ADHESION = Topic(
    "/estimates/adhesion",
    "trainlog.EstimatedAdhesion",
    "Adhesion in use and slip of each powered axle.",
    (
        Field(
            "adhesion",
            "1",
            "force between wheel and rail over axle load",
            each="powered axle",
            drawn=Drawn("adhesion/used", "in use", "used", magnitude=True, width=1.0),
        ),
        Field(
            "slip_speed",
            "m/s",
            "wheel speed minus train speed",
            each="powered axle",
            drawn=Drawn("slip", "axle {}", "measured", width=1.0),
        ),
    ),
)

REFERENCE = Topic(
    "/reference",
    "trainlog.Reference",
    "The trajectory that the train was asked to follow, at its position.",
    (
        Field(
            "speed",
            "m/s",
            "reference speed",
            drawn=Drawn("speed/reference", "reference", "planned", width=2.0),
        ),
        Field(
            "tractive_effort",
            "N",
            "reference tractive effort",
            "previous",
            drawn=Drawn("efforts/reference", "reference", "planned"),
        ),
        Field(
            "braking_effort",
            "N",
            "reference braking effort",
            "previous",
            drawn=Drawn("efforts/reference", "reference", "planned", down=True),
        ),
        Field("lateness", "s", "time behind the reference, negative when early"),
    ),
)

TRUTH = Topic(
    "/truth",
    "trainlog.Truth",
    "Simulated trips only: the truth, for comparison with estimates.",
    (
        Field("position", "m", "true chainage of the train's front"),
        Field("speed", "m/s", "true speed over ground"),
        Field("acceleration", "m/s^2", "true acceleration"),
        Field(
            "running_resistance",
            "N",
            "true R(v), without gradient, curves and tunnels",
            drawn=Drawn("resistance/true", "true (simulated)", "true", width=1.0),
        ),
        Field(
            "maximum_adhesion",
            "1",
            "true maximum adhesion under the powered axles",
            drawn=Drawn("adhesion/true", "true maximum (simulated)", "true", width=1.0),
        ),
        Field("energy", "J", "tractive work at the wheel rims since departure"),
    ),
)

_SHAKEN, _TURNED = Bounds(-200.0, 200.0), Bounds(-40.0, 40.0)
"""Of accelerations and rates of turn."""

IMU = Topic(
    "/imu",
    "trainlog.Imu",
    "Inertial measurement unit, in the axes of its own housing.",
    (
        Field(
            "specific_force_x",
            "m/s^2",
            "acceleration less gravity along the first axis",
            bounds=_SHAKEN,
        ),
        Field("specific_force_y", "m/s^2", "the same along the second axis", bounds=_SHAKEN),
        Field("specific_force_z", "m/s^2", "the same along the third axis", bounds=_SHAKEN),
        Field("angular_rate_x", "rad/s", "rate of turn about the first axis", bounds=_TURNED),
        Field("angular_rate_y", "rad/s", "rate of turn about the second axis", bounds=_TURNED),
        Field("angular_rate_z", "rad/s", "rate of turn about the third axis", bounds=_TURNED),
    ),
)

TRAIN_SUPPLY = Topic(
    "/train/supply",
    "trainlog.TrainSupply",
    "Electrical supply at the pantograph or the collector shoe.",
    (
        Field(
            "line_voltage",
            "V",
            "voltage of the line; effective where it alternates",
            bounds=Bounds(-60e3, 60e3),
            recorded=Recorded(
                "voltage spannung tension u volt",
                qualifier=(
                    "line catenary catenaire fahrdraht fd pantograph pantographe "
                    "stromabnehmer ligne oberleitung netz ober overhead"
                ),
                plausible=(-100.0, 40e3),
            ),
            drawn=Drawn("voltage", "line voltage", "measured"),
        ),
        Field(
            "line_current",
            "A",
            "current from the line, negative when fed back",
            bounds=Bounds(-20e3, 20e3),
            recorded=Recorded(
                "current strom courant i ampere", qualifier="line", plausible=(-6e3, 6e3)
            ),
            drawn=Drawn("current", "line current", "traction"),
        ),
    ),
)

TRAIN_BRAKES = Topic(
    "/train/brakes",
    "trainlog.TrainBrakes",
    "Pressures of the pneumatic brake, above that of the air around.",
    (
        Field(
            "brake_pipe_pressure",
            "Pa",
            "pressure in the brake pipe",
            bounds=Bounds(-1e5, 1.6e6),
            recorded=Recorded(
                "pressure druck pression hll hauptluftleitung bp bc p",
                qualifier="pipe hll bp cg conduite hauptluftleitung hauptleitung hl",
                plausible=(-1e5, 1.2e6),
            ),
            drawn=Drawn("pressure", "brake pipe", "measured"),
        ),
        Field(
            "brake_cylinder_pressure",
            "Pa",
            "pressure in the brake cylinders",
            bounds=Bounds(-1e5, 1.6e6),
            recorded=Recorded(
                "pressure",
                qualifier="cylinder cylindre bc bz zylinder bremszylinder cyl cf c",
                plausible=(-1e5, 1.2e6),
            ),
            drawn=Drawn("pressure", "brake cylinders", "friction braking"),
        ),
    ),
)

TRAIN_DOORS = Topic(
    "/train/doors",
    "trainlog.TrainDoors",
    "The doors.",
    (
        Field(
            "release",
            "1",
            "1 while the doors are released, 0 while they are not",
            "previous",
            bounds=Bounds(0.0, 1.0),
            drawn=Drawn("doors", "doors released", "used"),
        ),
    ),
)

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        TRAIN_STATE,
        TRAIN_CONTROLS,
        TRAIN_AXLES,
        TRAIN_SLIP_PROTECTION,
        TRAIN_VEHICLES,
        TRAIN_COUPLERS,
        GNSS_FIX,
        GNSS_MOTION,
        ENVIRONMENT,
        EVENTS,
        ESTIMATED_STATE,
        ESTIMATED_RESISTANCE,
        ESTIMATED_ADHESION,
        REFERENCE,
        TRUTH,
        IMU,
        TRAIN_SUPPLY,
        TRAIN_BRAKES,
        TRAIN_DOORS,
    )
}
"""Every topic of trainlog by channel name, in the order in which they are shown."""

RECORDED = "/recorded/"
"""Names of topics that a recorder has of its own begin with this; the log describes their fields
as it does those of the table."""

_WORD = re.compile(r"[a-z][a-z0-9_]*")


def recorded_topic(name: str, fields: Iterable[Field]) -> Topic:
    """A topic of a recorder's own: any quantities with units, beside those of the table.

    Parameters
    ----------
    name : str
        ``"/recorded/"`` and words of small letters, digits and underscores, parted by ``/``.
    fields : iterable of Field
        One number each; named in the same way.

    Raises
    ------
    InputError
        If the name or that of a field is written otherwise, a field comes twice, or there is none.

    Examples
    --------
    >>> import trainlog
    >>> force = trainlog.TopicField("force", "N", "contact force")
    >>> pantograph = recorded_topic("/recorded/pantograph", [force])
    >>> pantograph.message
    'trainlog.recorded.Pantograph'
    """
    words = name.removeprefix(RECORDED).split("/")
    if not name.startswith(RECORDED) or not all(_WORD.fullmatch(word) for word in words):
        raise InputError(
            f"'{name}' is not the name of a recorder's own topic",
            remedy=f"write it as {RECORDED}pantograph, in small letters, digits and underscores",
        )
    listed = tuple(fields)
    names = [field.name for field in listed]
    for field in names:
        if not _WORD.fullmatch(field) or names.count(field) > 1:
            problem = "comes twice" if names.count(field) > 1 else "is not the name of a field"
            raise InputError(
                f"'{field}' of {name} {problem}",
                remedy="name each field once, in small letters, digits and underscores",
            )
    if not names:
        raise InputError(f"{name} has no fields", remedy="give it one or more")
    parts = [part.capitalize() for word in words for part in word.split("_")]
    return Topic(name, f"trainlog.recorded.{''.join(parts)}", "Of the recorder's own.", listed)


def topic_of_frame(attrs: Mapping[Any, Any]) -> Topic:
    """The topic of a frame with these ``attrs``: of the table, or a recorder's own.

    Raises
    ------
    KeyError
        If they name no topic, or one that is neither.

    Examples
    --------
    >>> topic_of_frame({"topic": "/train/state"}).message
    'trainlog.TrainState'
    >>> own = topic_of_frame({"topic": "/recorded/oil", "units": {"pressure": "Pa"}})
    >>> own.field("pressure").unit
    'Pa'
    """
    name = attrs["topic"]
    if name in TOPICS or not str(name).startswith(RECORDED):
        return TOPICS[name]
    meanings, between = attrs.get("meanings", {}), attrs.get("interpolation", {})
    return recorded_topic(
        name,
        (
            Field(field, unit, meanings.get(field, ""), between.get(field, "linear"))
            for field, unit in attrs["units"].items()
        ),
    )


def attributes(topic: Topic, columns: Iterable[str]) -> dict[Any, Any]:
    """The ``attrs`` of a topic's frame with these columns.

    Examples
    --------
    >>> attributes(TRAIN_DOORS, ["release"])
    {'topic': '/train/doors', 'units': {'release': '1'}}
    """
    fields = {name: column_field(topic, name) for name in columns}
    attrs: dict[Any, Any] = {
        "topic": topic.name,
        "units": {name: field.unit for name, field in fields.items()},
    }
    if topic.name.startswith(RECORDED):
        attrs["meanings"] = {name: field.meaning for name, field in fields.items()}
        attrs["interpolation"] = {name: field.interpolation for name, field in fields.items()}
    return attrs


def column_field(topic: Topic, column: str) -> Field:
    """The field that a frame's column belongs to (``wheel_speed_3`` → ``wheel_speed``).

    Raises
    ------
    KeyError
        If the topic has no such column.
    """
    stem, _, axle = column.rpartition("_")
    for field in topic.fields:
        if field.name == column and not field.per_axle:
            return field
        if field.per_axle and field.name == stem and axle.isdigit() and int(axle) > 0:
            return field
    raise KeyError(column)
