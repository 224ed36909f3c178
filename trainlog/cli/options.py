"""Options and arguments of the commands, and how their values are read.

Parameters
----------
logs : LOGS
    Logs (.mcap), or folders of logs; a folder without logs: those in its subfolders.
line : FILE
    Line file, or 'sample'; default: as set.
train : FILE
    Train file, or 'sample'; default: as set.
catalogue : WHERE
    Folder or URL of the catalogue; default: as set, else the folder catalogue.
trips : WHERE
    Only trips that satisfy: "line = 'X' and weather = 'wet'".
from_ : TIME
    Only from this time on: 2024-05-01T06:00:00Z, 10s (after the start), end-5min.
to : TIME
    Only up to this time.
km : KM:KM
    Only while the train was between these kilometres, the operator's if the line has them: 3.2:7.5,
    3.2:, :7.5.
topic : TOPIC
    Only this topic; may be given several times.
at : TIME
    Time of the expected condition: 2026-11-22T06:00+01:00; only evidence of earlier days counts
    (UTC). Default: after the last evidence.
zone : ZONE
    Time zone of times without one: Europe/Zurich. Default: UTC.
layer : CONDITION
    Only this layer; may be given several times.
picture : FILE
    Also draw a picture into this file (.png).
risk : SHARE
    With --map: probability, per place and trip, of less adhesion than assumed at the time of the
    run, such as 0.05.
jobs : N
    Processes; default: one per processor.
seed : N
    Seed of random numbers; the same seed gives the same bytes.
"""

from __future__ import annotations

import inspect
import re
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from contextvars import ContextVar
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args, get_origin

import typer
from typer.models import ParameterInfo

import trainlog
from trainlog.cli.terminal import say
from trainlog.errors import InputError
from trainlog.units import (
    COUNT,
    DISTANCE,
    KILOMETRE,
    MASS,
    NANOSECONDS,
    NUMBER,
    SHARE,
    TIME,
    Measure,
    keyed,
)

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.ingest.routes import NetworkRoutes
    from trainlog.railway import Line, TrackConditionMap, Train
    from trainlog.trip import Trip


NETWORK_SUFFIX = ".network.json"
"""End of the names of network files."""


class ChosenTrips:
    """Marks the logs of a command: trips of a catalogue may be chosen in their place.

    `trainlog.cli.commands.Command` gives commands whose parameter is annotated with it the options
    ``--trips`` and ``--catalogue``.
    """


@dataclass(frozen=True)
class Written:
    """Marks a file to be written, whose name is checked before any work is done."""

    suffix: str = ".png"
    other: str = ""

    def read(self, given: str | Path, name: str) -> Path:  # noqa: ARG002
        """The file."""
        return destination(Path(given), self.suffix, self.other)


FOLDERS: ContextVar[ExitStack] = ContextVar("FOLDERS")
"""Those of the files that a command writes; one that was made and stays empty goes at its end."""

POSITIVE = COUNT.between(1.0)
"""At least one."""

Logs = Annotated[list[Path], ChosenTrips]
Picture = Annotated[Path | None, Written()]
Count = Annotated[int | None, POSITIVE]
Seed = Annotated[int, COUNT.between(0.0)]
Risk = Annotated[float | None, SHARE]

SHORT = {"--output": ["-o"], "--quiet": ["-q"]}
"""Options that have a letter, too."""


def described(docstring: str | None) -> tuple[str, dict[str, tuple[str, str]]]:
    r"""The text of a docstring, and of each parameter how its values are shown, and its words.

    Examples
    --------
    >>> described("Show a log.\n\nParameters\n----------\nlog : FILE\n    The log.")
    ('Show a log.', {'log': ('FILE', 'The log.')})
    """
    text, _, section = inspect.cleandoc(docstring or "").partition("\n\nParameters\n----------\n")
    found = {}
    for each in re.split(r"\n(?=\S)", section) if section else ():
        head, _, words = each.partition("\n")
        name, _, shown = head.partition(" : ")
        found[name] = shown, " ".join(words.split())
    return text, found


def typed(function: Callable[..., None]) -> Callable[..., None]:
    """A command's function as typer takes it: what a person may give follows from its signature.

    Parameters before a ``/`` are arguments, the others options: ``from_`` is ``--from``. Docstrings
    state how the values are shown and what they are: the function's own, that of its module for
    its commands, or that of `trainlog.cli.options` for all. Values are read as people write them
    where a `Measure` stands in the annotation, and names of files are checked by `Written`.
    """
    text, own = described(function.__doc__)
    known = described(__doc__)[1] | described(sys.modules[function.__module__].__doc__)[1] | own
    given = inspect.signature(function, eval_str=True).parameters.values()
    leading = [each.name for each in given if each.kind is each.POSITIONAL_ONLY]
    parameters = [
        each.replace(
            kind=each.KEYWORD_ONLY, annotation=_typed(each, *known.get(each.name, ("", "")))
        )
        for each in given
    ]

    def call(**values: Any) -> None:
        function(*[values.pop(name) for name in leading], **values)

    call.__name__, call.__doc__ = function.__name__, text
    call.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    return call


def _typed(parameter: inspect.Parameter, shown: str, words: str) -> Any:
    """The annotation of a parameter with what typer is to know of it."""
    base, notes = parameter.annotation, getattr(parameter.annotation, "__metadata__", ())
    for note in notes:
        if isinstance(note, ParameterInfo):
            note.help = note.help or words
            return parameter.annotation
    if notes:
        base = base.__origin__
    name = f"--{parameter.name.strip('_').replace('_', '-')}"
    kinds = (base, *get_args(base))
    choices = next((get_args(kind) for kind in kinds if get_origin(kind) is Literal), ())
    given: dict[str, Any] = {"help": f"{words} ({', '.join(choices)})" if choices else words}
    if choices:
        # typer reads a Literal by pydantic, in words of its own.
        base = str
        given["parser"] = partial(_chosen, name, choices)
    for note in notes:
        if isinstance(note, Measure | Written):
            given["parser"] = partial(_read, note, name, int in kinds)
        if isinstance(note, Measure) and isinstance(parameter.default, float):
            given["show_default"] = note.shown(parameter.default)
    if parameter.kind is parameter.POSITIONAL_ONLY:
        info = typer.Argument(metavar=shown or parameter.name.upper(), **given)
    else:
        info = typer.Option(name, *SHORT.get(name, ()), metavar=shown or None, **given)
    return Annotated[base, info, *(note for note in notes if note is ChosenTrips)]


def _chosen(name: str, choices: Sequence[str], given: str) -> str:
    """One of some words."""
    if given not in choices:
        problem = f"{name}: '{given}' is not one of {', '.join(choices)}"
        raise InputError(problem, remedy="give one of these")
    return given


def _read(of: Measure | Written, name: str, whole: bool, given: Any) -> Any:
    value = of.read(given, name)
    return int(value) if whole and isinstance(value, float) else value


_RELATIVE = re.compile(r"(start|end)|(start\+|end-)?(\d+(?:\.\d+)?(?:ms|s|min|h))")


def times(
    start: str | None,
    end: str | None,
    span: Callable[[], tuple[pd.Timestamp, pd.Timestamp] | None],
) -> tuple[Any, Any] | None:
    """The time asked for; None if all.

    Parameters
    ----------
    start, end : str or None
        A time in ISO 8601, UTC unless it says otherwise, or one relative to the log: ``90s`` or
        ``start+90s`` after its first row, ``end-5min`` before its last.
    span : callable
        Gives the times of the log's first and last row; asked only if a word is relative.

    Raises
    ------
    InputError
        If a word is no time, or relative to a log without rows.
    """
    if start is None and end is None:
        return None
    return _moment(start, span), _moment(end, span)


def stretch(text: str | None, line: Line | None = None) -> tuple[float | None, float | None] | None:
    """The positions asked for [m], from kilometres as ``3.2:7.5``; None if all.

    Raises
    ------
    InputError
        If the text is not of that form, or the line has no such kilometre.
    """
    from trainlog.railway.line import section_of_km

    if text is None:
        return None
    start, colon, end = text.partition(":")
    if not colon:
        raise InputError(
            f"'{text}' must be a section of the line in km", remedy="write kilometres as 3.2:7.5"
        )
    named = f"section '{text}': kilometre"
    limits = [KILOMETRE.read(word, named) if word.strip() else None for word in (start, end)]
    if limits[0] is not None and limits[0] == limits[1]:
        raise InputError(
            f"'{text}' is not a part of a line, but one place",
            remedy="write kilometres as 3.2:7.5",
        )
    return section_of_km(line, limits[0], limits[1])


def line_of_log(log: Path, given: Line | None = None) -> Line | None:
    """The line that a log carries, or else the one given, as travelled; None without."""
    from trainlog.formats.railway import line_of
    from trainlog.trip import LINE_ATTACHMENT

    if log.suffix != ".mcap":
        return given
    bare = trainlog.read(log, [])
    if LINE_ATTACHMENT in bare.attachments:
        return line_of(bare)
    backwards = bare.metadata.get("direction") == "reverse"
    return given.reversed() if backwards and given is not None else given


def lasting_change(word: str, line: Line | None = None) -> trainlog.RailChange:
    """A change of the rail, from ``km=10:14,date=2026-10-15,factor=1.3``, ``spots=0.2`` besides.

    Raises
    ------
    InputError
        If the text is not of that form.
    """
    from trainlog.spans import utc

    remedy = "write it as km=10:14,date=2026-10-15,factor=1.3"
    keys = ("km", "date", "factor", "spots")
    given = keyed(word.split(","), keys, f"change '{word}'", remedy)
    for names in ("km", "date", "factor or spots"):
        if not given.keys() & set(names.split(" or ")):
            raise InputError(f"change '{word}' has no {names}", remedy=remedy)
    km = stretch(re.sub(r"(?<=[0-9.])-", ":", given["km"], count=1), line)
    if km is None or km[0] is None or km[1] is None:
        raise InputError(f"change '{word}': km needs both ends", remedy=remedy)
    try:
        when = utc(given["date"])
    except InputError:
        raise InputError(f"change '{word}' has no such date", remedy=remedy) from None
    factor, spots = (
        NUMBER.read(given.get(name, "1"), f"change '{word}': {name}")
        for name in ("factor", "spots")
    )
    return trainlog.RailChange(km[0], km[1], int(when.value), factor, spots)


def _moment(
    word: str | None, span: Callable[[], tuple[pd.Timestamp, pd.Timestamp] | None]
) -> pd.Timestamp | None:
    if word is None:
        return None
    from trainlog.spans import utc

    found = _RELATIVE.fullmatch(word.strip())
    if found is None:
        try:
            return utc(word)
        except InputError as error:
            raise InputError(
                error.problem, remedy="write it as 2024-05-01T06:00:00Z, 10s, or end-5min"
            ) from error
    import pandas as pd

    known = span()
    if known is None:
        raise InputError(f"'{word}' has no meaning: the log has no rows", remedy="leave it out")
    edge, sign, given = found.groups()
    try:
        distance = pd.Timedelta(round(TIME.read(given or "0s") * NANOSECONDS), "ns")
        return known[1] - distance if "end" in (edge, sign and sign[:3]) else known[0] + distance
    except (OverflowError, pd.errors.OutOfBoundsDatetime, pd.errors.OutOfBoundsTimedelta) as error:
        raise InputError(
            f"'{word}' is further than time stamps reach",
            remedy=f"the log begins {known[0]:%Y-%m-%dT%H:%M:%SZ} and ends "
            f"{known[1]:%Y-%m-%dT%H:%M:%SZ}",
        ) from error


def moment(at: str | None, zone: str | None) -> pd.Timestamp | None:
    """A time as given by ``--at`` and ``--zone``, in UTC.

    Raises
    ------
    InputError
        If it is no time, the zone is unknown, or the time is skipped or comes twice there.
    """
    if at is None:
        return None
    import pandas as pd

    from trainlog.spans import times_of

    return pd.Timestamp(times_of(at, zone)[0], tz="UTC")


def zone_assumed(at: str | None, zone: str | None) -> str:
    """That a time is taken for UTC, where it states no zone and none is given; else empty."""
    from trainlog.spans import stamp_of

    if at is None or zone is not None or stamp_of(at).tzinfo is not None:
        return ""
    return f"{at} states no zone: taken for UTC (--zone names another)"


def map_of_run(
    condition: Path, at: str | None, line: Line, direction: str = ""
) -> tuple[TrackConditionMap, pd.Timestamp | None]:
    """The map, made of the evidence of the days before the time of the run alone, and that time.

    What is left out is printed. Without a time all evidence counts. Of a network's folder of maps
    it is the map along the `line`, in its own direction. With the `direction` of the run layers of
    the other one are left out.

    Raises
    ------
    InputError
        If the file is no map, the time is none, or no evidence is of a day before.
    """
    from trainlog.condition import known_before, left_out

    if condition.is_dir():
        from analysis.network.maps import network_map

        track = network_map(condition).along(line)
    else:
        track = trainlog.read_map(condition)
    track = track.travelled(direction) if direction else track
    time = moment(at, None)
    if time is None:
        return track, None
    words = left_out(track, time)
    if words:
        say(f"  {condition.name}: read {words}")
    return known_before(track, time), time


def part_of(
    log: Path,
    start: str | None,
    end: str | None,
    km: str | None,
    rows: int,
    topics: Any = None,
    line: Line | None = None,
) -> Iterator[Trip]:
    """The part of a log that is asked for, in pieces of at most `rows` rows.

    `topics` as for `trainlog.mcap.stream_log`; `line` counts the kilometres of a log that carries
    none.

    Raises
    ------
    LogError
        If the log cannot be read, or nothing of it is in that part.
    """
    from trainlog.mcap.convert import span_of
    from trainlog.mcap.records import nothing_of

    known = None if km is None else line_of_log(log, line)
    time, position = times(start, end, lambda: span_of(log)), stretch(km, known)
    empty = True
    for piece in trainlog.stream(log, topics, time=time, position=position, rows=rows):
        empty = empty and not any(map(len, piece.topics.values()))
        yield piece
    if empty and (time, position) != (None, None):
        raise nothing_of(log)


def line_and_train(
    line: Path | None, train: Path | None, kept: Line | None = None
) -> tuple[Line, Train]:
    """Line and train from the files named, or those that the user has set.

    Where no line is named, the one that is `kept` with something else goes before the user's.

    Raises
    ------
    InputError
        If one of them is neither given nor set, or cannot be read.
    """
    from trainlog.formats.settings import read_settings

    known = read_settings()
    own_line = line or (Path(known.line).expanduser() if known.line else None)
    own_train = train or (Path(known.train).expanduser() if known.train else None)
    found = kept
    if own_line is not None and (line is not None or kept is None):
        found = trainlog.read_line(own_line)
    if found is not None and own_train is not None:
        return found, trainlog.read_train(own_train)
    missing = [name for name, own in (("line", found), ("train", own_train)) if own is None]
    files = " ".join(f"--{name} FILE" for name in missing)
    samples = " ".join(f"--{name} sample" for name in missing)
    raise InputError(
        f"no {' and no '.join(missing)} {'is' if len(missing) == 1 else 'are'} given",
        remedy=f"give {files}; for a trial {samples}; 'trainlog settings' sets what is taken"
        " by default",
    )


def logs_in(paths: list[Path]) -> list[Path]:
    """The logs named, and those in the folders named, or else below them, in order of name."""
    from trainlog.formats.files import logs_of

    return [log for path in paths for log in logs_of(path)]


def named_apart(picture: Path | None, names: Sequence[str]) -> list[Path]:
    """The pictures of several things: with their names added where there are more than one."""
    if picture is None or len(names) < 2:
        return [] if picture is None else [picture]
    return [picture.with_stem(f"{picture.stem}-{name}") for name in names]


def sections_in(paths: list[Path]) -> list[Path]:
    """The trajectory files named, and those of a journey's sections in the folders named.

    Raises
    ------
    InputError
        If a folder holds none.
    """
    found = list[Path]()
    for path in paths:
        inside = path.glob("section-*.json") if path.is_dir() else [path]
        files = sorted(inside, key=lambda each: (len(each.name), each.name))
        if not files:
            raise InputError(
                "has no sections of a journey",
                file=path,
                remedy="name a folder that 'trainlog plan --stops' wrote, or its files",
            )
        found += files
    return found


Choices = dict[str, tuple["Measure | tuple[str, ...]", str]]
"""What ``--set KEY=VALUE`` sets of a command: how a key's value is read, and what it is."""


def settings_of(words: Sequence[str], choices: Choices) -> dict[str, Any]:
    """The settings of words ``KEY=VALUE``.

    Raises
    ------
    InputError
        If a key is unknown or given twice, or its value cannot be read.

    Examples
    --------
    >>> from trainlog.units import SPEED
    >>> settings_of(["speed=72", "side=left"], {"speed": (SPEED, ""), "side": (("left",), "")})
    {'speed': 20.0, 'side': 'left'}
    """
    found: dict[str, Any] = {}
    for key, value in keyed(words, choices, "--set", "write KEY=VALUE").items():
        of, name = choices[key][0], f"--set {key}"
        found[key] = _chosen(name, of, value) if isinstance(of, tuple) else of.read(value, name)
    return found


def set_option(choices: Choices) -> Any:
    """The option ``--set KEY=VALUE``, with its keys in the help."""
    keys = "; ".join(
        f"{name}{'=' + ' | '.join(of) if isinstance(of, tuple) else ''} ({help})"
        for name, (of, help) in choices.items()
    )
    return typer.Option("--set", metavar="KEY=VALUE", help=f"May be given several times: {keys}.")


def chosen_logs(where: str, catalogue: str | None) -> list[Path]:
    """The logs of the trips that an expression chooses in a catalogue; ``all`` chooses all.

    Raises
    ------
    InputError
        If there is no such catalogue, the expression is not understood, no trip is found, or the
        logs of some have vanished.
    """
    from trainlog.catalogue import open_catalogue

    with open_catalogue(catalogue, create=False) as opened:
        return opened.paths(None if where.strip().lower() == "all" else where)


def chosen_summaries(where: str, catalogue: str | None) -> list[Path]:
    """Stored summaries of the trips that are chosen, as a file, and the logs of those without one.

    The file lasts as long as the program. Errors as `chosen_logs`.
    """
    import atexit
    import shutil
    import tempfile

    from analysis.fleet.analyses import stored_summaries
    from trainlog.catalogue import open_catalogue
    from trainlog.formats.summaries import SUFFIX, write_summaries

    with open_catalogue(catalogue, create=False) as opened:
        asked = None if where.strip().lower() == "all" else where
        summaries, logs = stored_summaries(opened, asked)
    if summaries.empty:
        return logs
    folder = tempfile.mkdtemp(prefix="trainlog-")
    atexit.register(shutil.rmtree, folder, ignore_errors=True)
    path = Path(folder) / f"summaries{SUFFIX}"
    write_summaries(summaries, path)
    return [path, *logs]


FACTS = ("trip", "weather", "load", "clock", "start_position", "stations")
"""What can be said of a recorded trip that its file does not state."""


def line_or_network(
    line: Path | None, network: Path | None = None, stations: str | None = None
) -> tuple[Line | None, NetworkRoutes | None]:
    """The line that is given, or the network."""
    from trainlog.ingest.routes import NetworkRoutes, places_in

    if line is not None:
        refuse_rivals("--line is given", {"--network": network})
    if line is not None and line.name.endswith(NETWORK_SUFFIX):
        line, network = None, line
    if network is not None:
        return None, NetworkRoutes(trainlog.read_network(network), places_in(stations or ""))
    refuse_rivals("they are those of a network", {"--stations": stations}, "or give --network")
    return None if line is None else trainlog.read_line(line), None


def pairs(given: list[str]) -> dict[str, str]:
    """Metadata given as ``key=value``."""
    from trainlog.railway.train import check_load
    from trainlog.railway.weather import given_condition

    found = {}
    for key, value in keyed(given, FACTS, "--set", "write it as weather=wet").items():
        found[key] = given_condition(value) if key == "weather" else value
        if key == "load":
            load = MASS.between(0.0).read(value, "load")
            check_load(load)
            found[key] = value if value[-1:].isdigit() else f"{load:.0f}"
        if key == "start_position" and value != "stations":
            found[key] = f"{_START.read(value, key):g}"
    return found


_START = replace(
    DISTANCE, examples="200, 0.2km or stations (where the stops match those of the line)"
)


def refuse_rivals(why: str, given: Mapping[str, object], remedy: str = "") -> None:
    """Refuse options that contradict another one, or that its mode ignores; None is not given.

    Raises
    ------
    InputError
        With the names of those that are given.
    """
    named = " and ".join(name for name, value in given.items() if value is not None)
    if named:
        raise InputError(
            f"{named} cannot be taken: {why}",
            remedy=" ".join(filter(None, (f"leave out {named}", remedy))),
        )


def destination(path: Path, suffix: str, other: str = "") -> Path:
    """A file to be written, checked before any work is done; it may end in another suffix, too.

    Its folder is made if need be.
    """
    if not path.suffix or path.suffix not in (suffix, other):
        wanted = " or ".join(filter(None, (suffix, other)))
        raise InputError(
            f"is not the name of a {wanted} file", file=path, remedy=f"end it in {wanted}"
        )
    from trainlog.formats.files import output_folder

    if path.is_dir():
        raise InputError("is a folder", file=path, remedy="name a file in it")
    if (folders := FOLDERS.get(None)) is not None:  # none where a command is read but not run
        folders.enter_context(output_folder(path.absolute().parent))
    return path


def distinct(names: list[str], files: list[Path]) -> None:
    """Refuse files whose results would have the same name, so that none overwrites another."""
    first: dict[str, Path] = {}
    for name, file in zip(names, files, strict=True):
        if name in first:
            raise InputError(
                f"has the same name as {first[name]}, and so would what is made of it",
                file=file,
                remedy="give them in two calls, with different folders",
            )
        first[name] = file
