"""The files of lines, networks, trains, journeys, trajectories and learnt results; new ones.

Their keys follow from their declarations in `trainlog.railway`; docs/formats.md describes them.
"""

from __future__ import annotations

import textwrap
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.declaration import (
    Array,
    Declared,
    Form,
    Many,
    Problems,
    content_beside,
    entries,
    example,
    from_content,
    meanings,
)
from trainlog.display import counted, span
from trainlog.errors import InputError, LogError
from trainlog.formats.csv_tables import read_line_table
from trainlog.formats.declared import (
    as_toml,
    body_of,
    built,
    file_content,
    read_thing,
    thing_from_bytes,
    thing_to_bytes,
    write_thing,
)
from trainlog.formats.files import read_bytes, sha256, to_bytes, write_bytes
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, file_or_sample
from trainlog.presentation import PLAIN, Band, Column, Said, WordTable, new_table
from trainlog.railway.line import Line
from trainlog.railway.network import Network
from trainlog.railway.passport import Passport, Quantity
from trainlog.railway.train import Consist, ParameterSet, Train
from trainlog.railway.trajectory import Journey, Trajectory
from trainlog.trip import LINE_ATTACHMENT, PASSPORT_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.units import KMH
from trainlog.version import __version__


def line_from_bytes(data: bytes, *, file: str | Path = "line.json") -> Line:
    """The line in the bytes of a line file; `file` is what errors call it."""
    return thing_from_bytes(Line, data, file)


def line_to_bytes(line: Line) -> bytes:
    """The bytes of the line's file: the same line gives the same bytes."""
    return thing_to_bytes(line)


def read_line(path: str | Path) -> Line:
    """Read a line file, JSON or TOML, or a route of a network; errors as `read_thing`.

    Parameters
    ----------
    path : path
        Of a line file; or ``"sample"``: St.Gallen-Wil; or of a network file, ``#`` and the places
        of a route with commas between them: ``"my.network.json#Wil,Gossau"``, see
        `trainlog.Network.route`.

    Examples
    --------
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> line.name, line.length
    ('CH_StGallen_Wil', 29556.1)
    """
    path = file_or_sample(path, DEFAULT_LINE)
    wanted = route_of_path(path)
    if wanted is not None:
        return read_network(wanted[0]).route(*wanted[1]).line
    return read_thing(Line, path)


def write_line(line: Line, path: str | Path) -> None:
    """Write a line file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_line(line, Path(folder) / "copy.line.json")
    ...     read_line(Path(folder) / "copy.line.json").name
    'CH_StGallen_Wil'
    """
    write_thing(line, path, Line)


def read_journey(path: str | Path) -> Journey:
    """Read a journey file, JSON or TOML; errors as `read_thing`.

    Examples
    --------
    >>> read_journey("absent.journey.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.journey.json: does not exist; check the path
    """
    return read_thing(Journey, path)


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> from trainlog import TimingPoint
    >>> journey = Journey("R 1", "short", (TimingPoint(0.0), TimingPoint(9e3, latest=600.0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_journey(journey, Path(folder) / "r1.journey.json")
    ...     read_journey(Path(folder) / "r1.journey.json") == journey
    True
    """
    write_thing(journey, path, Journey)


def network_from_bytes(data: bytes, *, file: str | Path = "network.json") -> Network:
    """The network in the bytes of a network file; `file` is what errors call it.

    Files of lines that it names are looked for beside `file`.

    Raises
    ------
    InputError
        If they are not a network file, naming the place and the remedy.
    """
    return _network(data, file, judged=False)


def _network(data: bytes, file: str | Path, judged: bool) -> Network:
    body = body_of(Network, data, file)
    return built(lambda: from_content(Network, _with_lines(body, Path(file).parent), judged), file)


def _with_lines(body: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What a network's file states, with each edge's line and name, wherever they stand."""
    problems, whole = Problems(), []
    edges = body.get("edges")
    for number, edge in enumerate(edges if isinstance(edges, list) else ()):
        if not isinstance(edge, dict):
            whole.append(edge)
            continue
        with problems.at(f"edges[{number}]"):
            rest = {key: value for key, value in edge.items() if key != "file"}
            if (rest.get("line") is None) == (edge.get("file") is None):
                raise InputError(
                    "needs either a line or the file of one", remedy="give one of 'line' and 'file'"
                )
            line = rest.get("line")
            if line is None:
                line = rest["line"] = read_thing(Line, folder / str(edge["file"]))
            if rest.get("name") is None:
                named = {"name": line.name} if isinstance(line, Line) else line
                rest["name"] = named.get("name") if isinstance(named, dict) else None
            whole.append(rest)
    problems.check()
    return body | ({"edges": whole} if isinstance(edges, list) else {})


def read_network(path: str | Path) -> Network:
    """Read a network file, JSON or TOML.

    Raises
    ------
    InputError
        If the file cannot be read, or cannot be meant: edges that lead nowhere, names that come
        twice, parts that are not connected, implausible lines. All that is wrong is listed.

    Examples
    --------
    >>> read_network("absent.network.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.network.json: does not exist; check the path
    """
    return _network(read_bytes(path), path, judged=True)


def write_network(network: Network, path: str | Path) -> None:
    """Write a network file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> import trainlog
    >>> from trainlog import Edge, Node
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (Node("St. Gallen"), Node("Wil"))
    >>> network = Network("one", nodes, (Edge("only", line, "St. Gallen", "Wil"),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_network(network, Path(folder) / "one.network.json")
    ...     trainlog.read_line(f"{folder}/one.network.json#Wil,St. Gallen").name
    'Wil - St. Gallen'
    """
    write_thing(network, path, Network)


def route_of_path(path: str | Path) -> tuple[Path, tuple[str, ...]] | None:
    """The file and the places of a route that a path names; None if it names a file.

    Examples
    --------
    >>> route_of_path("my.network.json#Wil, Gossau")
    (PosixPath('my.network.json'), ('Wil', 'Gossau'))
    >>> route_of_path("my.line.json") is None
    True
    """
    text = str(path)
    file, mark, places = text.partition("#")
    if not mark or not file.lower().endswith((".json", ".toml")) or Path(text).exists():
        return None
    separator = ";" if ";" in places else ","
    return Path(file), tuple(each.strip() for each in places.split(separator) if each.strip())


def train_from_bytes(data: bytes, *, file: str | Path = "train.json") -> Train:
    """The train in the bytes of a train file; `file` is what errors call it."""
    return thing_from_bytes(Train, data, file)


def train_to_bytes(train: Train) -> bytes:
    """The bytes of the train's file: the same train gives the same bytes."""
    return thing_to_bytes(train)


def read_train(path: str | Path) -> Train:
    """Read a train file, JSON or TOML; errors as `read_thing`.

    Parameters
    ----------
    path : path
        Of a train file; or ``"sample"``: a Stadler FLIRT.

    Examples
    --------
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train.name, train.mass
    ('CH_Stadler_FLIRT_TPF', 122000.0)
    """
    return read_thing(Train, file_or_sample(path, DEFAULT_TRAIN))


def write_train(train: Train, path: str | Path) -> None:
    """Write a train file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_train(train, Path(folder) / "copy.train.json")
    ...     read_train(Path(folder) / "copy.train.json") == train
    True
    """
    write_thing(train, path, Train)


def read_consist(path: str | Path) -> Consist:
    """Read a consist file, JSON or TOML; errors as `read_thing`.

    Examples
    --------
    >>> consist = read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> consist.name, len(consist.vehicles), len(consist.couplers)
    ('freight train, 24 wagons', 25, 24)
    """
    return read_thing(Consist, path)


def write_consist(consist: Consist, path: str | Path) -> None:
    """Write a consist file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> consist = read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_consist(consist, Path(folder) / "copy.consist.json")
    ...     read_consist(Path(folder) / "copy.consist.json").name
    'freight train, 24 wagons'
    """
    write_thing(consist, path, Consist)


def read_trajectory(path: str | Path) -> Trajectory:
    """Read a trajectory file; errors as `read_thing`.

    Examples
    --------
    >>> read_trajectory("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return read_thing(Trajectory, path)


def write_trajectory(trajectory: Trajectory, path: str | Path) -> None:
    """Write a trajectory file, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> import trainlog
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> nominal = trainlog.Configuration.of(train)
    >>> trajectory = Trajectory(
    ...     "line", train.name, np.array([0.0, 500.0, 1000.0]), (nominal,),
    ...     np.array([[0.0, 20.0, 0.0]]), np.array([[0.0, 50.0, 100.0]]),
    ...     np.array([53e3, 0.0]), np.array([[0.0, 53e3]]), 100.0,
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_trajectory(trajectory, f"{folder}/trajectory.json")
    ...     again = read_trajectory(f"{folder}/trajectory.json")
    >>> again.running_time
    100.0
    """
    write_thing(trajectory, path, Trajectory)


def read_parameters(path: str | Path) -> ParameterSet:
    """Read a parameters file; errors as `read_thing`.

    Examples
    --------
    >>> read_parameters("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return read_thing(ParameterSet, path)


def write_parameters(parameters: ParameterSet, path: str | Path) -> None:
    """Write a parameters file, whole or not at all.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> from trainlog import Configuration, RunningResistance
    >>> resistance = RunningResistance(2000.0, 50.0, 8.0)
    >>> empty = Configuration("empty", 122e3, 9e3, resistance, 2.6e6)
    >>> found = ParameterSet("FLIRT", (empty,), speed_range=(5.0, 40.0))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_parameters(found, Path(folder) / "flirt.parameters.json")
    ...     read_parameters(Path(folder) / "flirt.parameters.json").configurations[0].mass
    122000.0
    """
    write_thing(parameters, path, ParameterSet)


Gradient = Literal["line", "unknown"]
"""Whether the gradient was taken from the line or was an unknown of its own."""


@dataclass(frozen=True, slots=True)
class Identified:
    """A quantity that the data determine, or the reason why they do not.

    Attributes
    ----------
    name, unit : str
    value, std : float or None
        None where the data do not determine it.
    reason : str or None
        Why not; or, with a value, where it comes from if not from the data.
    """

    name: str
    unit: str
    value: float | None = None
    std: float | None = None
    reason: str | None = None


@dataclass(frozen=True, eq=False)
class DragCurve:
    """Deceleration of the coasting train on level track, with its 95 % band; arrays (n,).

    Attributes
    ----------
    speeds : array [m/s]
        Those that the data support, increasing.
    deceleration, low, high : array [m/s²]
    """

    speeds: Annotated[FloatArray, Array("m/s")]
    deceleration: Annotated[FloatArray, Array("m/s^2")]
    low: Annotated[FloatArray, Array("m/s^2")]
    high: Annotated[FloatArray, Array("m/s^2")]

    def __repr__(self) -> str:
        return f"DragCurve: {span(self.speeds, KMH)} km/h, {span(self.deceleration, 1e3)} mm/s²"


def _value(quantity: Identified) -> Band | Said:
    if quantity.value is None or quantity.std is None:
        return Said(None, "not identified")
    return Band(quantity.value, quantity.std)


QUANTITY_COLUMNS = (
    Column("quantity", of="name"),
    Column("unit"),
    Column("value", PLAIN, band=True, of=_value),
    Column("", key="reason", of=lambda each: each.reason or ""),
)
"""Of an `Identified`."""


@dataclass(frozen=True, eq=False, repr=False)
class CoastDownResult(Declared):
    """What was learnt of running resistance from coasting.

    Attributes
    ----------
    train : str
        Empty where the recordings do not name it.
    gradient : {"line", "unknown"}
    quantities : tuple of Identified
        Those that were sought, identified or not.
    covariance : (p, p) array
        Of the quantities that have a value, in their order.
    curve : DragCurve or None
        None where it is not identified.
    trips : list of dict
        One a trip: segments, noise, SHA-256, or the reason of its refusal.
    pieces : list of dict
        With the gradient unknown: pieces of track and what was found of each.
    provenance : dict
    """

    charts_by: ClassVar[str] = "analysis.resistance.plot:result_charts"
    __hash__ = Declared.__hash__

    FORMAT: ClassVar[str] = "trainlog/coast-down"

    train: str
    gradient: Gradient
    quantities: Annotated[tuple[Identified, ...], Many(least=1)]
    covariance: Annotated[FloatArray, Array("", 2)]
    curve: DragCurve | None = None
    trips: Annotated[list[dict[str, Any]], Many(stated="written")] = field(default_factory=list)
    pieces: Annotated[list[dict[str, Any]], Many(stated="written")] = field(default_factory=list)
    provenance: Annotated[dict[str, Any], Form(stated="written")] = field(default_factory=dict)

    def problems(self) -> Iterator[InputError]:
        """A covariance that is not of the quantities."""
        known = sum(each.value is not None for each in self.quantities)
        if self.covariance.shape != (known, known):
            yield InputError(
                f"needs {known} rows of {known} numbers, one for each quantity that has a value",
                place="covariance",
                remedy="give a row and a column for each of them",
            )

    def __getitem__(self, name: str) -> Identified:
        """The quantity of that name; KeyError if there is none."""
        for quantity in self.quantities:
            if quantity.name == name:
                return quantity
        raise KeyError(name)

    @property
    def title(self) -> str:
        """Train, trips and whether the gradient was known."""
        train = f" of '{self.train}'" if self.train else ""
        return f"Coast-down{train}, {counted(len(self.trips), 'trip')}, gradient: {self.gradient}"

    def summary(self) -> dict[str, str]:
        """Each quantity with its standard deviation, or why it is not identified."""
        rows = {each.name: _in_words(each) for each in self.quantities}
        if self.curve is not None:
            rows["drag curve"] = f"{span(self.curve.speeds, KMH)} km/h"
        return rows

    def tables(self) -> list[WordTable]:
        """What is identified, and why the rest is not."""
        title = f"Running resistance over inertia, gradient {self.gradient}"
        return [new_table(title, *QUANTITY_COLUMNS, name="quantities").add_rows(self.quantities)]

    @property
    def notes(self) -> list[str]:
        """What it rests on, in sentences."""
        words = [f"{counted(len(self.pieces), 'piece')} of track coasted more than once."]
        words = words if self.gradient == "unknown" else []
        words += [f"refused: {trip['reason']}" for trip in self.trips if not trip["accepted"]]
        if self.curve is not None:
            low, high = (KMH * float(self.curve.speeds[end]) for end in (0, -1))
            words.append(f"The whole curve is supported from {low:.0f} to {high:.0f} km/h.")
        return words


def _in_words(quantity: Identified) -> str:
    if quantity.value is None:
        return f"not identified: {quantity.reason}"
    std = "" if quantity.std is None else f", standard deviation {quantity.std:.2g}"
    return f"{quantity.value:.5g} {quantity.unit}{std}"


def read_coast_down(path: str | Path) -> CoastDownResult:
    """Read a coast-down file; errors as `read_thing`.

    Examples
    --------
    >>> read_coast_down("absent.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    return read_thing(CoastDownResult, path)


def write_coast_down(result: CoastDownResult, path: str | Path) -> None:
    """Write a coast-down file, whole or not at all.

    Examples
    --------
    >>> import tempfile
    >>> import numpy as np
    >>> mass = Identified("mass", "kg", None, None, "coasting gives resistance by mass only")
    >>> result = CoastDownResult("FLIRT", "line", (mass,), np.zeros((0, 0)))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_coast_down(result, Path(folder) / "flirt.json")
    ...     read_coast_down(Path(folder) / "flirt.json").train
    'FLIRT'
    """
    write_thing(result, path, CoastDownResult)


MAX_LOAD_SHARE = 0.25
"""Largest load over the empty mass where the train's file states none."""

WEIGHING_SHARE, WEIGHING_OFFSET = 0.03, 0.02
"""Standard deviation of a recorded load: this share of the load, and this share of the largest."""

KEPT = 64
"""Lines and trains that are kept, so that the analyses of a trip read its attachments once."""


def line_of(trip: Trip) -> Line:
    """The line that the trip was driven on, as the train met it.

    A trip whose metadata say ``direction: reverse`` gets the line reversed, so that its chainage
    grows in the direction of travel.

    Raises
    ------
    LogError
        If the trip carries no line, or its direction is neither ``forward`` nor ``reverse``.
    InputError
        If the attachment is not a line file.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> line_of(read_log("sample_logs/nonstop.mcap")).name
    'CH_StGallen_Wil'
    """
    data = _attachment(trip, LINE_ATTACHMENT)
    direction = trip.metadata.get("direction", "forward")
    if direction not in ("forward", "reverse"):
        raise LogError(
            f"trip '{trip.name}': direction is '{direction}'",
            remedy="metadata 'direction' must be 'forward' or 'reverse'",
        )
    try:
        return travelled_line(data, direction == "reverse")
    except InputError:
        return line_from_bytes(data, file=_called(trip, LINE_ATTACHMENT))


@lru_cache(KEPT)
def travelled_line(data: bytes, backwards: bool) -> Line:
    """The line in the bytes of a line file, in the direction of travel; trips of one share it."""
    line = line_from_bytes(data)
    return line.reversed() if backwards else line


def line_of_plan(trajectory: Trajectory) -> Line | None:
    """The line that a trajectory was planned on, in its direction of travel.

    None of trajectories whose file an earlier version wrote: it does not hold the line.

    Raises
    ------
    InputError
        If what the file holds is not a line.

    Examples
    --------
    >>> import trainlog
    >>> from analysis import OptimiserOptions, TrajectoryProblem, optimise
    >>> line = trainlog.read_line("sample").reversed()
    >>> train = trainlog.read_train("sample")
    >>> nominal = [trainlog.Configuration.of(train)]
    >>> problem = TrajectoryProblem(line, train, nominal, end=9_286.1, direction="reverse")
    >>> line_of_plan(optimise(problem, OptimiserOptions(60))).stations[0].name
    'Wil'
    """
    kept = trajectory.provenance.get("line")
    if kept is None:
        return None
    return line_from_bytes(to_bytes(kept), file=f"the line in the trajectory on {trajectory.line}")


def train_of(trip: Trip) -> Train:
    """The train that made the trip, empty.

    Raises
    ------
    LogError
        If the trip carries no train.
    InputError
        If the attachment is not a train file.

    Examples
    --------
    >>> from trainlog.mcap import read_log
    >>> train_of(read_log("sample_logs/nonstop.mcap")).name
    'CH_Stadler_FLIRT_TPF'
    """
    data = _attachment(trip, TRAIN_ATTACHMENT)
    try:
        return _train(data)
    except InputError:
        return train_from_bytes(data, file=_called(trip, TRAIN_ATTACHMENT))


@lru_cache(KEPT)
def _train(data: bytes) -> Train:
    return train_from_bytes(data)


def passport_of(trip: Trip) -> Passport | None:
    """The passport that is stored with the trip; None if there is none.

    Raises
    ------
    InputError
        If the attachment is not a passport file.

    Examples
    --------
    >>> passport_of(Trip({})) is None
    True
    """
    data = trip.attachments.get(PASSPORT_ATTACHMENT)
    if data is None:
        return None
    return thing_from_bytes(Passport, data, file=_called(trip, PASSPORT_ATTACHMENT))


def with_passport(trip: Trip, passport: Passport) -> Trip:
    """A copy of the trip that carries the passport, in the place of the one it may have.

    Examples
    --------
    >>> from analysis import passport
    >>> from trainlog.mcap import read_log
    >>> trip = read_log("sample_logs/nonstop.mcap")
    >>> passport_of(with_passport(trip, passport(trip))).trip
    'trip-01'
    """
    data = thing_to_bytes(passport)
    carried = replace(trip, attachments={**trip.attachments, PASSPORT_ATTACHMENT: data})
    return carried.with_step(
        "passport", software=f"trainlog {__version__}", outputs={PASSPORT_ATTACHMENT: sha256(data)}
    )


def recorded_load(trip: Trip, train: Train | None = None) -> Quantity | None:
    """The load [kg] that a trip's metadata state, with its uncertainty; None without.

    Parameters
    ----------
    trip : Trip
    train : Train, optional
        Its largest load sizes the offset of the weighing.

    Raises
    ------
    LogError
        If ``load`` or ``load_std`` is not a mass.

    Examples
    --------
    >>> recorded_load(Trip({}, {"load": "12000", "load_std": "500"})).band
    (11020.0, 12980.0)
    """
    load = _stated(trip, "load")
    if load is None:
        return None
    std = _stated(trip, "load_std")
    if std is None:
        largest = largest_load(train) if train is not None else 0.0
        std = float(np.hypot(WEIGHING_SHARE * load, WEIGHING_OFFSET * largest))
    return Quantity(load, std, "recorded")


def _stated(trip: Trip, key: str) -> float | None:
    """A mass [kg] among the metadata."""
    stated = trip.metadata.get(key)
    if not stated:
        return None
    try:
        mass = float(stated)
    except ValueError:
        mass = np.nan
    if not (np.isfinite(mass) and mass >= 0.0):
        raise LogError(
            f"trip '{trip.name}': {key} '{stated}' is not a mass in kg",
            remedy=f"correct metadata '{key}' when the log is made",
        )
    return mass


def largest_load(train: Train) -> float:
    """Largest load of a train [kg]; a share of its mass where its file states none.

    Examples
    --------
    >>> from trainlog import DEFAULT_TRAIN, read_train, sample
    >>> largest_load(read_train(sample(DEFAULT_TRAIN)))
    25000.0
    """
    return train.max_load or MAX_LOAD_SHARE * train.mass


def _attachment(trip: Trip, name: str) -> bytes:
    try:
        return trip.attachments[name]
    except KeyError:
        raise LogError(
            f"trip '{trip.name}' has no {name}",
            remedy=f"attachments present: {', '.join(trip.attachments) or 'none'};"
            " 'trainlog ingest --line FILE --train FILE' attaches them when it makes the log",
        ) from None


def _called(trip: Trip, name: str) -> str:
    return f"{name} of trip '{trip.name}'"


Kind = Literal["line", "train", "journey", "profile"]


def template(kind: Kind, *, line: Line | None = None) -> str:
    """The text of a new file: TOML with comments that is valid as it is.

    Parameters
    ----------
    kind : {"line", "train", "journey", "profile"}
    line : Line, optional
        What a line's file holds, in place of an example.

    Examples
    --------
    >>> print(template("journey")[:59])
    # A journey. Units can be replaced by any of the same kind:
    """
    if kind == "profile":
        return Path(__file__).with_name("profile.toml").read_text("utf-8")
    declared: dict[str, type[Declared]] = {"line": Line, "train": Train, "journey": Journey}
    return template_of(declared[kind], line)


def template_of(kind: type[Declared], thing: Declared | None = None) -> str:
    """The text of a new file of a declared thing, with what its docstring says of each key.

    Parameters
    ----------
    kind : type
    thing : optional
        What the file holds; default: the usual values, and at the end, as comments, those of the
        tables that may be added.
    """
    word, meant = kind.__name__.lower(), meanings(kind)
    head = (
        f"A {word}. Units can be replaced by any of the same kind: kg for t, km for m, m/s for"
        " km/h.\ndocs/formats.md describes every key."
    )
    if word in ("line", "train"):
        other = "train" if word == "line" else "line"
        head += f" Check it:\ntrainlog simulate drive --{word} THIS --{other} sample -o trips"
    notes: dict[str, str] = {}
    for entry in entries(kind):
        words = "\n".join(textwrap.wrap(meant.get(entry.names[0], ""), 96))
        # What is said of several keys stands before the first.
        notes[entry.key] = "" if words in notes.values() else words
    text = as_toml(file_content(thing or example(kind)), {"": head} | notes)
    added = {} if thing is not None else content_beside(kind)
    if not added:
        return text
    lines = as_toml(added, notes).splitlines()
    return (
        text + "\n# What may be added:\n" + "".join(f"# {each}".rstrip() + "\n" for each in lines)
    )


def write_template(
    kind: Kind, path: str | Path, *, table: str | Path | None = None, name: str | None = None
) -> Path:
    """Write a new file to be edited; nothing that exists is overwritten.

    Parameters
    ----------
    kind : {"line", "train", "journey", "profile"}
    path : str or Path
        Ends in .toml; a line that is made from a table may be .json.
    table : str or Path, optional
        CSV of a line's rows; see `read_line_table`.
    name : str, optional
        Of a line from a table; default: the table's.

    Raises
    ------
    InputError
        If the name ends otherwise, the file exists, or the table cannot be used.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.railway import read_train
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     read_train(write_template("train", Path(folder) / "mine.train.toml")).name
    'Example unit'
    """
    path = Path(path)
    if table is not None and kind != "line":
        raise InputError(
            f"a {kind} cannot be made from a table",
            remedy=f"'trainlog ingest {table} -o FOLDER' proposes one from the recording"
            if kind == "profile"
            else "leave out the table; it is for a line's chainage, gradients and limits",
        )
    suffixes = (".toml", ".json") if table is not None else (".toml",)
    if path.suffix not in suffixes:
        raise InputError(
            f"is not the name of a {' or '.join(suffixes)} file",
            file=path,
            remedy=f"end it in {suffixes[0]}, which has comments",
        )
    if path.exists():
        raise InputError("exists", file=path, remedy="choose another name, or remove it first")
    line = None if table is None else read_line_table(table, name=name)
    if line is not None and path.suffix == ".json":
        write_thing(line, path, Line)
    else:
        write_bytes(path, template(kind, line=line).encode())
    return path
