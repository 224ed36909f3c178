"""Files of other projects as files of this one: what ``trainlog import`` does with each."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

from trainlog.declaration import check_plausible
from trainlog.errors import InputError
from trainlog.formats import osrd, railtoolkit, sfera, ttobench
from trainlog.formats.declared import built, thing_from_bytes, write_thing
from trainlog.formats.files import parse_json, read_bytes
from trainlog.formats.railml import read_railml
from trainlog.formats.tracks import LEVEL, Infrastructure, LimitChoice
from trainlog.railway import EffortCurve, Journey, Line, Train
from trainlog.railway.network import Network
from trainlog.railway.resistance import CurveFormula
from trainlog.railway.train import AccelerationLimits, MassModel

Thing = Line | Train | Journey | Network
"""What a file of another project can become."""


@dataclass(frozen=True)
class Imported:
    """A file written, and what of its source it does not hold.

    Attributes
    ----------
    path : Path
    dropped : list of str
    assumed : list of str
        What its source leaves open; of networks.
    """

    path: Path
    dropped: list[str] = field(default_factory=list)
    assumed: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class ImportOptions:
    """What a train's own file leaves open.

    Attributes
    ----------
    electrification : str or None
        Of a train with efforts for several; default: that which its file calls its default.
    traction_curve, braking_curve : EffortCurve or None
        Efforts over speed, in the place of the file's.
    mass_model, acceleration_limits : str or None
        Of a train: see `Train`.
    curve_resistance : str or None
        Of a line: see `Line`.
    loaded : float
        Share of the heaviest load that is on board of a formation of railtoolkit.
    category : str or None
        Of trains, whose speed limits infrastructure gets; see `networks_in`.
    limit : float or None [m/s]
        Of infrastructure, where its file states no speed limit; see `networks_in`.
    gradients_known : bool
        Whether track is level where the file of a line or network states no gradient: a fact then,
        and no assumption, which identification refuses.
    line : Line or None
        Whose gradients, curves and tunnels a journey's line gets where SFERA states none.
    """

    electrification: str | None = None
    traction_curve: EffortCurve | None = None
    braking_curve: EffortCurve | None = None
    mass_model: MassModel | None = None
    acceleration_limits: AccelerationLimits | None = None
    curve_resistance: CurveFormula | None = None
    loaded: float | None = None
    category: str | None = None
    limit: float | None = None
    gradients_known: bool = False
    line: Line | None = None

    @property
    def of_train(self) -> dict[str, Any]:
        """What is given for a train, by name."""
        names = ("traction_curve", "braking_curve", "mass_model", "acceleration_limits")
        return {name: getattr(self, name) for name in names if getattr(self, name) is not None}

    def applied(self, thing: Thing, path: str | Path) -> Thing:
        """A line or a train as the options state it.

        Raises
        ------
        InputError
            If an option is for the other of the two.
        """
        curved = [] if self.curve_resistance is None else ["curve_resistance"]
        for kind, changes in ((Train, [*self.of_train]), (Line, curved)):
            if changes and not isinstance(thing, kind):
                what = kind.__name__.lower()
                raise InputError(
                    f"is not a {what}: {changes[0].replace('_', ' ')} cannot go into it",
                    file=path,
                    remedy=f"give it with a {what} alone",
                )
        if isinstance(thing, Train):
            chosen = {n: each for n, each in self.of_train.items() if not n.endswith("curve")}
            return replace(with_curves(thing, self.traction_curve, self.braking_curve), **chosen)
        if isinstance(thing, Line) and self.curve_resistance is not None:
            thing = replace(thing, curve_resistance=self.curve_resistance)
        if self.gradients_known and isinstance(thing, Line):
            return _level(thing)
        if self.gradients_known and isinstance(thing, Network):
            edges = [replace(edge, line=_level(edge.line)) for edge in thing.edges]
            return replace(thing, edges=tuple(edges))
        return thing


def _level(line: Line) -> Line:
    """The line, whose gradients are known: level where its source states none."""
    return replace(line, assumed=tuple(name for name in line.assumed if name != "gradients"))


def with_curves(
    train: Train, traction: EffortCurve | None = None, braking: EffortCurve | None = None
) -> Train:
    """The train with these curves; its largest efforts and powers are those of the curves.

    Examples
    --------
    >>> import numpy as np
    >>> from trainlog.formats.railway import read_train
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> curve = EffortCurve(np.array([0.0, 10.0, 45.0]), np.array([180e3, 150e3, 40e3]))
    >>> with_curves(train, curve).tractive_effort_limit([0.0, 10.0]).tolist()
    [180000.0, 150000.0]
    """
    changes: dict[str, Any] = {}
    for curve, held, effort, power in (
        (traction, "traction_curve", "max_tractive_effort", "max_traction_power"),
        (
            braking,
            "dynamic_braking_curve",
            "max_dynamic_braking_effort",
            "max_dynamic_braking_power",
        ),
    ):
        if curve is not None:
            changes |= {held: curve, effort: float(curve.efforts.max()), power: curve.peak_power}
    assumed = tuple(name for name in train.assumed if name not in changes)
    return replace(train, assumed=assumed, **changes)


def import_file(
    path: str | Path,
    folder: str | Path,
    options: ImportOptions | None = None,
    taken: Collection[Path] = (),
) -> list[Imported]:
    """Write a file of TTOBench, OSRD, railtoolkit or railML anew in the project's own formats.

    A line or train file of the project itself is taken, too, where an option changes it.

    Parameters
    ----------
    path : str or Path
        A track, train or journey of TTOBench, rolling stock or infrastructure of OSRD (JSON),
        rolling stock or running paths of railtoolkit (YAML), infrastructure of railML (XML), or
        journeys of SFERA (XML, a folder or zip archive).
    folder : str or Path
        For the files, for example ``CH_StGallen_Wil.line.json``.
    options : ImportOptions, optional
    taken : collection of Path
        Files that must not be written again, such as those of another source.

    Raises
    ------
    InputError
        If the file cannot be read or used, the new one cannot be written, or an option does not
        fit it. Nothing is written then.

    Examples
    --------
    >>> import_file("absent.json", "railway")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.json: does not exist; check the path
    """
    options = options or ImportOptions()
    stem = Path(path).stem.removesuffix(".train").removesuffix(".line")
    found = _things(path, options)
    written, things = [], dict[Path, Thing]()
    for name, thing, dropped, assumed in found:
        thing = built(lambda thing=thing: options.applied(thing, path), path)  # type: ignore[misc]
        built(partial(check_plausible, thing), path)
        kind = type(thing).__name__.lower()
        target = Path(folder) / f"{stem if len(found) == 1 else name}.{kind}.json"
        if target in taken or target in things:
            raise InputError(
                f"would be written as {target.name}, as another one was",
                file=path,
                remedy="give them in two calls, with different folders",
            )
        things[target] = thing
        known = [each for each in assumed if each.startswith(LEVEL) and options.gradients_known]
        written.append(Imported(target, dropped, [each for each in assumed if each not in known]))
    for target, thing in things.items():
        built(partial(_write, thing, target), path)
    return written


def project_of(path: str | Path, start: bytes) -> str | None:
    """What file of another project it is, in words; None of a file that `import_file` refuses.

    Parameters
    ----------
    path : str or Path
    start : bytes
        How the file begins.
    """
    words = start.removeprefix(b"\xef\xbb\xbf").lstrip()
    if railtoolkit.SCHEMA.encode() in start and words[:1] != b"{":
        return "a file of railtoolkit (YAML)"
    if sfera.is_sfera(words):
        return "a document of SFERA (XML)"
    if words[:1] == b"<":
        return "infrastructure of railML (XML)" if b"railml" in words[:2000].lower() else None
    if words[:1] != b"{":
        return None
    try:
        content = parse_json(read_bytes(path), file=path)
        if osrd.is_infrastructure(content):
            return "infrastructure of OSRD (JSON)"
        if osrd.is_rolling_stock(content):
            return "rolling stock of OSRD (JSON)"
        return f"a {ttobench.detect(path)} of TTOBench (JSON)"
    except InputError:
        return None


def import_formation(
    paths: Sequence[str | Path],
    formation: str,
    folder: str | Path,
    options: ImportOptions | None = None,
    name: str | None = None,
) -> Imported:
    """Write a train of vehicles that stand in several files of railtoolkit.

    Parameters
    ----------
    paths : sequence of str or Path
        Rolling stock of railtoolkit (YAML).
    formation : str
        Identifiers of its vehicles from the front to the rear, with a number where there are
        several: ``"DB_V90, 10 Facs124"``.
    folder : str or Path
        For the train file.
    options : ImportOptions, optional
    name : str, optional
        Of the train and its file; default: the formation.

    Raises
    ------
    InputError
        If a file cannot be read, or a vehicle is in none of them.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.formats.railway import read_train
    >>> text = '''
    ... schema: https://railtoolkit.org/schema/rolling-stock.json
    ... schema_version: "2022.05"
    ... vehicles:
    ...   - {id: unit, name: unit, vehicle_type: multiple unit, length: 42.0, mass: 68.0,
    ...      speed_limit: 120, tractive_effort: [[0, 78000], [20, 60000], [120, 15000]]}
    ... '''
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     stock = Path(folder) / "stock.yaml"
    ...     _ = stock.write_text(text)
    ...     written = import_formation([stock], "2 unit", folder, name="double")
    ...     read_train(written.path).length
    84.0
    """
    options = options or ImportOptions()
    train = railtoolkit.train_of(paths, formation, options.loaded or 0.0, name)
    target = Path(folder) / f"{name or '-'.join(formation.replace(',', ' ').split())}.train.json"
    _write(options.applied(train, paths[0]), target)
    return Imported(target, ["names of its vehicles"])


_ONLY = {
    "loaded": ("is not a formation of railtoolkit", "leave the load out; add it to a plan"),
    "electrification": (
        "has no efforts by electrification",
        "leave the electrification out; it is for rolling stock of OSRD",
    ),
    "category": (
        "has no speed limits by category of train",
        "leave the category out; it is for infrastructure of OSRD and railML, and for SFERA",
    ),
    "line": ("is not a journey of SFERA", "leave the line out"),
}
"""Options that fit some files alone: what the others are, and the remedy."""


def _refuse(path: str | Path, options: ImportOptions, *names: str) -> None:
    """Refuse options that do not fit a file."""
    for name in names:
        if getattr(options, name) is not None:
            problem, remedy = _ONLY[name]
            raise InputError(problem, file=path, remedy=remedy)


def _things(
    path: str | Path, options: ImportOptions
) -> list[tuple[str, Thing, list[str], list[str]]]:
    """Everything in the file: a name, the thing, what it does not hold, and what is assumed."""
    if Path(path).is_dir() and not sfera.is_source(path):
        raise InputError("is a folder without documents of SFERA", file=path, remedy="name a file")
    if sfera.is_source(path):
        _refuse(path, options, "loaded")
        return [row for each in _journeys(path, options) for row in each]
    _refuse(path, options, "line")
    if Path(path).suffix.lower() in (".yaml", ".yml"):
        _refuse(path, options, "electrification", "category")
        return [(*each, []) for each in railtoolkit.read_any(path, options.loaded)]
    _refuse(path, options, "loaded")
    data = read_bytes(path)
    if (infra := networks_in(path, data, options.limit, options.category)) is not None:
        _refuse(path, options, "electrification")
        # The file's account stands with its first network.
        accounts = [(infra.left_out, infra.assumed), *([([], [])] * (len(infra.networks) - 1))]
        return [
            (f"{Path(path).stem}-{number}", each, *account)
            for number, (each, account) in enumerate(
                zip(infra.networks, accounts, strict=True), start=1
            )
        ]
    _refuse(path, options, "category")
    content = parse_json(data, file=path)
    if osrd.is_rolling_stock(content):
        train, dropped = osrd.read_train(path, options.electrification)
        return [(train.name, train, dropped, [])]
    _refuse(path, options, "electrification")
    own = content.get("format") if isinstance(content, dict) else None
    thing: Thing
    if own == Train.FORMAT and options.of_train:
        thing = thing_from_bytes(Train, data, path)
    elif own == Line.FORMAT and options.curve_resistance is not None:
        thing = thing_from_bytes(Line, data, path)
    else:
        thing = ttobench.import_file(path)
    return [(thing.name, thing, [], [])]


def _journeys(
    path: str | Path, options: ImportOptions
) -> Iterator[list[tuple[str, Thing, list[str], list[str]]]]:
    """Line, journey and train of each journey of SFERA documents."""
    limits = LimitChoice(options.category, options.limit)
    for found in sfera.read_sfera(path, limits, options.electrification):
        line, said = found.line, list[str]()
        if options.line is not None:
            line, said = built(partial(sfera.filled, line, options.line), path)
        name = re.sub(r"[^\w.-]+", "-", found.name).lstrip(".")
        yield [(name, line, found.left_out, [*found.assumed, *said])] + [
            (name, thing, [], []) for thing in (found.journey, found.train) if thing is not None
        ]


def networks_in(
    path: str | Path,
    data: bytes | None = None,
    limit: float | None = None,
    category: str | None = None,
) -> Infrastructure | None:
    """The networks of a file of infrastructure, and an account of it; None of other files.

    Parameters
    ----------
    path : str or Path
        Of OSRD (JSON) or railML (XML); recognised by its content.
    data : bytes, optional
        Its content, where it is known.
    limit : float, optional [m/s]
        Where the file states none; default: the lowest that it states anywhere.
    category : str, optional
        Of trains, whose limits hold, or ``"none"``: those for all trains; default: the lowest of
        all categories.

    Raises
    ------
    InputError
        If the file cannot be read or used, or states no limits of the category.
    """
    limits = LimitChoice(category, limit)
    data = read_bytes(path) if data is None else data
    if data.removeprefix(b"\xef\xbb\xbf").lstrip()[:1] == b"<":
        return read_railml(path, limits)
    if osrd.is_infrastructure(parse_json(data, file=path)):
        return osrd.read_infrastructure(path, limits)
    return None


def _write(thing: Thing, target: Path) -> None:
    check_plausible(thing)
    write_thing(thing, target, type(thing))
