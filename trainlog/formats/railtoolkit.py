"""Rolling stock and running paths of railtoolkit (schemas 2022.05 and 2024.07), in YAML.

https://railtoolkit.org/schema: rolling stock in tonnes, km/h and per mille, running paths as
sections with their permitted speed and resistance.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial, reduce
from operator import add
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
import yaml

from trainlog.declaration import (
    NOT_NEGATIVE,
    POSITIVE,
    Foreign,
    Many,
    Must,
    NotNegative,
    Number,
    Part,
    Positive,
    Text,
    from_content,
)
from trainlog.errors import InputError, in_file
from trainlog.formats.declared import built
from trainlog.formats.files import read_bytes
from trainlog.formats.ttobench import UNPUBLISHED, assumed_axles
from trainlog.railway import EffortCurve, Line, RunningResistance, Station, StepProfile, Train
from trainlog.units import GRAVITY, KMH, PER_MILLE

TONNE = 1e3

SCHEMA = "https://railtoolkit.org/schema/"

REFERENCE_SPEED = 100.0 / KMH
"""Speed at which the air resistance is given [m/s]."""

HEAD_WIND = 15.0 / KMH
"""Wind that is added to the speed in the air resistance of coaches and traction units [m/s]."""


@dataclass(frozen=True)
class _In(Number):
    """A number of the file in the unit that the schema states; in SI inside."""

    times: float = 1.0
    over: float = 1.0

    def read(self, found: Any, kind: Any = float) -> float:
        """The number in SI."""
        return super().read(found, kind) * self.times / self.over

    def words(self, value: Any) -> str:
        """The number as the file has it."""
        return f"{value * self.over / self.times:g}"


_Mass = Annotated[float, _In(times=TONNE, must=POSITIVE)]
_OverWeight = Annotated[float, _In(over=PER_MILLE, must=NOT_NEGATIVE)]


@dataclass(frozen=True)
class _Pairs(Many):
    """Pairs of speed [km/h] and effort [N]; a curve of effort inside."""

    def read(self, found: Any, kind: Any) -> EffortCurve:  # noqa: ARG002
        """The curve."""
        pairs = np.array(super().read(found, tuple[tuple[NotNegative, NotNegative], ...]))
        return EffortCurve(pairs[:, 0] / KMH, pairs[:, 1].copy())


class RollingVehicle(Foreign):
    """A vehicle of the rolling stock, with the names of the schema and in SI units.

    Its running resistance is given over its weight: after Strahl (wagons) and Sauthoff (coaches),
    and that of the traction unit, as in Wende, D. (2003), Fahrdynamik des Schienenverkehrs, pp.
    151-153. All are quadratic in speed, so that each is a `RunningResistance`.

    Attributes
    ----------
    name, id, vehicle_type : str
    length : float [m]
    mass, load_limit : float [kg]
        Empty mass, and the heaviest load.
    mass_traction : float or None [kg]
        On the powered axles, empty; None: all of it.
    rotation_mass : float or None
        Mass with the rotating part over mass; None: what is usual.
    base_resistance, rolling_resistance, air_resistance : float
        Over weight; of a traction unit the first is of its powered, the second of its carrying
        axles, of a coach the second grows with speed. The air's is at 100 km/h.
    speed_limit : float [m/s]
    a_braking : float or None [m/s²]
        Acceleration of service braking, negative.
    effort : EffortCurve or None
    """

    name: str
    id: Annotated[str, Text(stated="required")] = ""
    vehicle_type: Literal["traction unit", "freight", "passenger", "multiple unit"]
    length: Positive
    mass: _Mass
    load_limit: Annotated[float, _In(times=TONNE, must=NOT_NEGATIVE)] = 0.0
    mass_traction: _Mass | None = None
    rotation_mass: Annotated[
        float | None, Number(must=Must("is below 1", "give mass with rotating part over mass", 1.0))
    ] = None
    base_resistance: _OverWeight = 0.0
    rolling_resistance: _OverWeight = 0.0
    air_resistance: _OverWeight = 0.0
    speed_limit: Annotated[float, _In(over=KMH, must=POSITIVE)] = np.inf
    a_braking: float | None = None
    effort: Annotated[EffortCurve | None, _Pairs(least=3, key="tractive_effort")] = None

    @property
    def powered(self) -> bool:
        """Whether it pulls."""
        return self.vehicle_type in ("traction unit", "multiple unit")

    @property
    def adhesive_mass(self) -> float:
        """On the powered axles, empty [kg]; 0 without any."""
        stated = self.mass if self.mass_traction is None else self.mass_traction
        return stated if self.powered else 0.0

    @property
    def inertia_factor(self) -> float:
        """Mass with the rotating part over mass."""
        return self.rotation_mass or (1.09 if self.powered else 1.06)

    def resistance(self, load: float) -> RunningResistance:
        """Running resistance with `load` [kg] on board; Wende (2003), pp. 151 and 153."""
        # That of a unit is published for the unit as it is, whatever it carries.
        weight = GRAVITY * (self.mass if self.powered else self.mass + load)
        base, wind, linear = self.base_resistance * weight, HEAD_WIND, 0.0
        if self.powered:
            on_powered = self.base_resistance * self.adhesive_mass
            base = GRAVITY * (
                on_powered + self.rolling_resistance * (self.mass - self.adhesive_mass)
            )
        elif self.vehicle_type == "freight":  # Strahl
            wind = 0.0
        else:  # Sauthoff
            linear = self.rolling_resistance * weight / REFERENCE_SPEED
        air = self.air_resistance * weight / REFERENCE_SPEED**2
        return RunningResistance(base + air * wind**2, linear + 2.0 * air * wind, air)


Formation = tuple[str, tuple[RollingVehicle, ...]]
"""A name, and vehicles from the front to the rear."""


class _Train(Foreign):
    name: str
    id: str
    formation: Annotated[tuple[str, ...], Many(least=1)]


class _RollingStock(Foreign):
    trains: Annotated[tuple[_Train, ...] | None, Many(least=1)] = None
    vehicles: Annotated[tuple[RollingVehicle, ...] | None, Many(least=1)] = None


@dataclass(frozen=True)
class _Row(Part):
    """A section, perhaps as a list of position, speed and resistance."""

    def read(self, found: Any, kind: Any) -> Any:
        """The section."""
        if isinstance(found, list):
            if len(found) != 3:
                raise InputError(
                    "needs position, speed and resistance", remedy="give three values per section"
                )
            found = dict(zip(("position", "speed", "resistance"), found, strict=True))
        return super().read(found, kind)


class _Section(Foreign):
    position: float
    speed: Positive | None = None
    resistance: float | None = None


class _Path(Foreign):
    id: str
    name: str | None = None
    description: str | None = None
    characteristic_sections: Annotated[tuple[Annotated[_Section, _Row()], ...], Many(least=2)]


Identified = TypeVar("Identified", RollingVehicle, _Path)


class _Paths(Foreign):
    paths: Annotated[tuple[_Path, ...], Many(least=1)]


def read_rolling_stock(path: str | Path) -> tuple[dict[str, RollingVehicle], dict[str, Formation]]:
    """Vehicles and formations by their id; `coupled` makes a train of one.

    Raises
    ------
    InputError
        If the file is not rolling stock of railtoolkit; names the place and what is wrong.

    Examples
    --------
    >>> import tempfile
    >>> text = '''
    ... schema: https://railtoolkit.org/schema/rolling-stock.json
    ... schema_version: "2022.05"
    ... vehicles:
    ...   - {id: wagon, name: wagon, vehicle_type: freight, length: 14.0, mass: 22.0}
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "stock.yaml"
    ...     _ = path.write_text(text)
    ...     vehicles, formations = read_rolling_stock(path)
    >>> vehicles["wagon"].mass
    22000.0
    """
    with in_file(path):
        content = _content(path, "rolling-stock.json")
        stock = built(lambda: from_content(_RollingStock, content), path)
        if stock.trains is None and stock.vehicles is None:
            raise InputError("holds neither trains nor vehicles", remedy="add 'vehicles'")
        vehicles = _by_id(stock.vehicles or (), "vehicle")
        formations: dict[str, Formation] = {}
        for number, train in enumerate(stock.trains or ()):
            missing = [name for name in train.formation if name not in vehicles]
            if missing and stock.vehicles is not None:
                raise InputError(
                    f"vehicle '{missing[0]}' of train '{train.id}' is not in the file",
                    place=f"trains[{number}].formation",
                    remedy=f"vehicles: {', '.join(vehicles)}",
                )
            if not missing:
                parts = tuple(vehicles[name] for name in train.formation)
                formations[train.id] = train.name, parts
        return vehicles, formations


def read_running_paths(path: str | Path) -> dict[str, Line]:
    """Running paths as lines, by their id; the resistance of a section is its gradient.

    A line begins where its path does, and ends at the last section.

    Raises
    ------
    InputError
        If the file is not a running path of railtoolkit; names the place and what is wrong.

    Examples
    --------
    >>> import tempfile
    >>> text = '''
    ... schema: https://railtoolkit.org/schema/running-path.json
    ... schema_version: "2022.05"
    ... paths:
    ...   - id: short
    ...     characteristic_sections: [[0.0, 80, 0.0], [5000.0, 60, 5.0], [8000.0, 60, 5.0]]
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "path.yaml"
    ...     _ = path.write_text(text)
    ...     read_running_paths(path)["short"].length
    8000.0
    """
    content = _content(path, "running-path.json")
    with in_file(path):
        named = _by_id(built(lambda: from_content(_Paths, content), path).paths, "path")
    return {
        own: built(partial(_line, each, f"paths[{number}]"), path)
        for number, (own, each) in enumerate(named.items())
    }


def _by_id(things: Sequence[Identified], what: str) -> dict[str, Identified]:
    """Things of a file by their id, which none may share."""
    found: dict[str, Identified] = {}
    for number, each in enumerate(things):
        if each.id in found:
            raise InputError(
                f"{what} '{each.id}' comes twice",
                place=f"{what}s[{number}]",
                remedy="remove one of them",
            )
        found[each.id] = each
    return found


def train_of(
    paths: Sequence[str | Path], formation: str, loaded: float = 0.0, name: str | None = None
) -> Train:
    """A train of vehicles that stand in several files.

    Parameters
    ----------
    paths : sequence of str or Path
    formation : str
        Identifiers from the front to the rear: ``"DB_V90, 10 Facs124"``.
    loaded : float
        Share of the heaviest load that is on board.
    name : str, optional
        Default: the formation.

    Raises
    ------
    InputError
        As `read_rolling_stock`, or if a vehicle is in none of the files.
    """
    vehicles: dict[str, RollingVehicle] = {}
    for path in paths:
        vehicles |= read_rolling_stock(path)[0]
    parts: list[RollingVehicle] = []
    for word in filter(None, (part.strip() for part in formation.split(","))):
        number, _, rest = word.partition(" ")
        count, own = (int(number), rest.strip()) if number.isdigit() and rest else (1, word)
        if own not in vehicles or count < 1:
            raise InputError(
                f"formation '{formation}': no vehicle '{own}' in the files given",
                remedy=f"vehicles: {', '.join(vehicles)}; as in '1 locomotive, 20 wagon'",
            )
        parts += count * [vehicles[own]]
    return coupled(name or formation, parts, loaded)


def read_any(
    path: str | Path, loaded: float | None = None
) -> list[tuple[str, Line | Train, list[str]]]:
    """Every train or line of a file, by its id, and what of it the train or line does not hold.

    Trains are the formations of the file; without formations, its vehicles that pull, each alone.

    Parameters
    ----------
    path : str or Path
    loaded : float, optional
        Share of the heaviest load that is on board of a train.

    Raises
    ------
    InputError
        As `read_rolling_stock` and `read_running_paths`, or if nothing in the file pulls.
    """
    content = _yaml(path)
    if isinstance(content, dict) and content.get("schema") == SCHEMA + "running-path.json":
        return [(name, line, []) for name, line in read_running_paths(path).items()]
    vehicles, formations = read_rolling_stock(path)
    with in_file(path):
        absent = [each for each in content.get("trains") or () if each["id"] not in formations]
        if absent:
            raise InputError(
                f"the vehicles of train '{absent[0]['id']}' are not in the file",
                place="trains",
                remedy="import the files of its vehicles with --formation"
                f" '{', '.join(absent[0]['formation'])}'",
            )
        if not formations:
            formations = {
                name: (each.name, (each,))
                for name, each in vehicles.items()
                if each.powered and each.effort
            }
        if not formations:
            raise InputError(
                "no train in it has tractive effort",
                place="trains",
                remedy="add a formation with a traction unit or a multiple unit",
            )
        share = 0.0 if loaded is None else loaded
        return [
            (name, built(partial(coupled, *each, share), path), ["names of its vehicles"])
            for name, each in formations.items()
        ]


def coupled(name: str, vehicles: Sequence[RollingVehicle], loaded: float = 1.0) -> Train:
    """Vehicles coupled to a train that carries a share of its heaviest load.

    Where no vehicle states its deceleration it is 0.375 m/s², or 0.225 m/s² for freight; Brünger
    and Dahlhaus (2014), in *Railway Timetabling & Operations*, p. 74. Inertia has the factors of
    the vehicles, weighted by their empty mass. What is not published is listed in the train's
    ``assumed``.

    Raises
    ------
    InputError
        If no vehicle pulls, or the share is not between 0 and 1.
    """
    if not 0.0 <= loaded <= 1.0:
        raise InputError(
            f"a share of {loaded:g} of the load is not between 0 and 1",
            remedy="give 0 to 100 per cent",
        )
    curves = [each.effort for each in vehicles if each.powered and each.effort]
    if not curves:
        raise InputError(
            f"formation '{name}': no vehicle has tractive effort",
            remedy="add a traction unit or a multiple unit with its tractive effort",
        )
    mass, most = (
        sum(each.mass + share * each.load_limit for each in vehicles) for share in (loaded, 1.0)
    )
    factor = sum(each.inertia_factor * each.mass for each in vehicles)
    inertia = factor / sum(each.mass for each in vehicles) * mass
    knots = np.unique(np.concatenate([curve.speeds for curve in curves]))
    curve = EffortCurve(knots, np.asarray(sum(each(knots) for each in curves)))
    braking = [-each.a_braking for each in vehicles if each.a_braking is not None]
    passenger = any(each.vehicle_type in ("passenger", "multiple unit") for each in vehicles)
    deceleration = min(braking, default=0.375 if passenger else 0.225)
    effort, rotating = float(curve.efforts.max()), inertia / mass - 1.0
    axles = assumed_axles(mass, effort, rotating)
    adhesive = sum(each.adhesive_mass for each in vehicles)
    max_speed = min(each.speed_limit for each in vehicles)
    limited = np.isfinite(max_speed)
    return Train(
        name=name,
        source=f"railtoolkit rolling stock ({SCHEMA})"
        + f", {100.0 * loaded:g} per cent of its load on board" * (loaded > 0.0),
        mass=mass,
        rotating_mass_factor=rotating,
        resistance=reduce(add, (each.resistance(loaded * each.load_limit) for each in vehicles)),
        max_tractive_effort=effort,
        max_traction_power=curve.peak_power,
        max_pneumatic_braking_effort=deceleration * inertia,
        max_speed=max_speed if limited else float(curve.speeds[-1]),
        max_acceleration=effort / inertia,
        max_deceleration=deceleration,
        max_load=most - mass,
        length=round(sum(each.length for each in vehicles), 6),
        axles=replace(axles, adhesive_mass=min(adhesive, mass) or axles.adhesive_mass),
        traction_curve=curve,
        assumed=_ASSUMED if limited else ("max_speed", *_ASSUMED),
    )


_ASSUMED = ("max_acceleration", *UNPUBLISHED, "axles", "brake")
"""Fields of a train that railtoolkit does not know."""


def _yaml(path: str | Path) -> Any:
    with in_file(path):
        try:
            return yaml.safe_load(read_bytes(path))
        except yaml.YAMLError as error:
            mark = getattr(error, "problem_mark", None)
            raise InputError(
                f"is not YAML: {getattr(error, 'problem', None) or 'cannot be read'}",
                place=f"line {mark.line + 1}, column {mark.column + 1}" if mark else None,
                remedy="correct it there",
            ) from error
        except (RecursionError, UnicodeDecodeError, ValueError) as error:
            raise InputError("is not YAML", remedy="expected a railtoolkit file") from error


def _content(path: str | Path, schema: str) -> Any:
    with in_file(path):
        content = _yaml(path)
        found = content.get("schema") if isinstance(content, dict) else None
        if found != SCHEMA + schema:
            raise InputError(
                f"is not a {schema.removesuffix('.json').replace('-', ' ')} of railtoolkit",
                place="schema",
                remedy=f"expected {SCHEMA}{schema}",
            )
        version = content.get("schema_version")
        if version not in ("2022.05", "2024.07"):
            raise InputError(
                f"schema version {version!r} is not known"
                if version
                else "states no schema version",
                place="schema_version",
                remedy="expected 2022.05 or 2024.07",
            )
        return content


def _line(path: _Path, place: str) -> Line:
    sections = path.characteristic_sections
    where = f"{place}.characteristic_sections"
    repeated = [
        at for at, count in Counter(each.position for each in sections).items() if count > 1
    ]
    if repeated:
        raise InputError(
            f"two sections begin at {repeated[0]:g} m", place=where, remedy="remove one of them"
        )
    for number, each in enumerate(sections):
        if each.speed is None and each.resistance is None:
            raise InputError(
                "a section has neither speed nor resistance",
                place=f"{where}[{number}]",
                remedy="add one of them",
            )
    ordered = sorted(sections, key=lambda each: each.position)
    if ordered[0].speed is None:
        raise InputError("the first section has no speed", place=where, remedy="add it")
    start, end = ordered[0].position, ordered[-1].position
    positions = np.array([each.position - start for each in ordered[:-1]])
    # What a section does not give stays as it was before.
    speeds, resistances = [ordered[0].speed], [ordered[0].resistance or 0.0]
    for each in ordered[1:-1]:
        speeds.append(speeds[-1] if each.speed is None else each.speed)
        resistances.append(resistances[-1] if each.resistance is None else each.resistance)
    return Line(
        name=path.name or path.description or path.id,
        length=end - start,
        stations=(Station("start", 0.0), Station("end", end - start)),
        speed_limits=StepProfile(positions, np.array(speeds) / KMH),
        gradients=StepProfile(positions.copy(), np.array(resistances) / PER_MILLE),
        source=f"railtoolkit running path {path.id}",
    )
