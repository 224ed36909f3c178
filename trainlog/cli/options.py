"""Options and arguments of the commands, and how their values are read."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from trainlog.cli.terminal import console
from trainlog.errors import InputError
from trainlog.units import DISTANCE, KILOMETRE, MASS, NANOSECONDS, NUMBER, SHARE, TIME, Measure

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.ingest.routes import NetworkRoutes
    from trainlog.railway import Line, TrackConditionMap, Train
    from trainlog.simulation import Change
    from trainlog.trip import Trip


NETWORK_SUFFIX = ".network.json"
"""End of the names of network files."""


def measured(*names: str, of: Measure, help: str) -> Any:
    """An option whose value is written as people write it; a command gets it in the unit of `of`.

    A number that the command has for a default is in that unit, too.
    """

    def read(given: Any) -> float:
        return of.read(given, names[0])

    return typer.Option(*names, parser=read, metavar=of.noun.upper(), help=help)


def written(*names: str, suffix: str = ".png", help: str) -> Any:
    """An option that names a file to be written, which is checked before any work is done."""

    def read(given: Any) -> Path:
        return destination(Path(given), suffix)

    return typer.Option(*names, parser=read, metavar="FILE", help=help)


class ChosenTrips:
    """Marks the logs of a command: trips of a catalogue may be chosen in their place.

    `trainlog.cli.commands.Command` gives commands whose parameter is annotated with it the options
    ``--trips`` and ``--catalogue``.
    """


Logs = Annotated[
    list[Path],
    typer.Argument(help="Logs (.mcap), or folders of logs; of one without, those below it."),
    ChosenTrips,
]
CatalogueOption = Annotated[
    str | None,
    typer.Option(
        "--catalogue",
        metavar="WHERE",
        help="Folder or URL of the catalogue; default: as set, else the folder catalogue.",
    ),
]
TripsOption = Annotated[
    str | None,
    typer.Option(
        "--trips",
        metavar="WHERE",
        help="Only trips that this chooses: \"line = 'X' and weather = 'wet'\".",
    ),
]
CategoryOption = Annotated[
    str | None,
    typer.Option(
        "--category",
        metavar="NAME",
        help="Of trains, whose speed limits a network gets; 'none': those for all trains. Default:"
        " the lowest of all categories.",
    ),
]
LineOption = Annotated[
    Path | None, typer.Option("--line", help="Line file, or 'sample'; default: as set.")
]
TrainOption = Annotated[
    Path | None, typer.Option("--train", help="Train file, or 'sample'; default: as set.")
]

RiskOption = Annotated[
    float | None,
    measured(
        "--risk",
        of=SHARE,
        help="With --map: probability, for each place and trip, that there is less adhesion than"
        " is counted on, as the map expects it at the time of the run; such as 0.05.",
    ),
]
RunTimeOption = Annotated[
    str | None,
    typer.Option(
        "--at",
        help="With --map: time of the run, for which it is read: 2026-11-22T06:00Z. Default: where"
        " a risk is given right after its last evidence, else what lasts. Only evidence of days"
        " before counts (UTC).",
    ),
]
JobsOption = Annotated[
    int | None, typer.Option(min=1, help="Processes; default: one per processor.")
]
Seed = Annotated[int, typer.Option(min=0, help="Same seed, same bytes.")]
MapArgument = Annotated[Path, typer.Argument(metavar="MAP", help="Map file (.map).")]
MapOrFolder = Annotated[
    Path, typer.Argument(metavar="MAP", help="Map file (.map), or a network's folder of maps.")
]
LayersOption = Annotated[
    list[str] | None, typer.Option("--layer", help="Only this layer; may be given several times.")
]
AtOption = Annotated[
    str | None,
    typer.Option(
        "--at",
        help="Time of the expected condition: 2026-11-22T06:00+01:00; only evidence of days before"
        " its day counts (UTC). Default: right after the last day with evidence, with all of it.",
    ),
]
ZoneOption = Annotated[
    str | None,
    typer.Option("--zone", help="Zone of a time that states none: Europe/Zurich. Default: UTC."),
]

TopicOption = Annotated[
    list[str] | None, typer.Option("--topic", help="Only this topic; may be given several times.")
]
FromOption = Annotated[
    str | None,
    typer.Option(
        "--from",
        help="Only from this time on: 2024-05-01T06:00:00Z, 10s (after the start), end-5min.",
    ),
]
ToOption = Annotated[str | None, typer.Option("--to", help="Only up to this time.")]
KilometreOption = Annotated[
    str | None,
    typer.Option(
        "--km",
        help="Only while the train was between these kilometres, the operator's where the line has"
        " them: 3.2:7.5, 3.2:, :7.5.",
    ),
]


PictureOption = Annotated[
    Path | None, written("--picture", help="Draw it into this file (.png), too.")
]

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
    from trainlog.railway.kilometres import section_of_km

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
    from trainlog.mcap import read_log
    from trainlog.trip import LINE_ATTACHMENT

    if log.suffix != ".mcap":
        return given
    bare = read_log(log, [])
    if LINE_ATTACHMENT in bare.attachments:
        return line_of(bare)
    backwards = bare.metadata.get("direction") == "reverse"
    return given.reversed() if backwards and given is not None else given


def lasting_change(word: str, line: Line | None = None) -> Change:
    """A change of the rail, from ``km=10:14,date=2026-10-15,factor=1.3``, ``spots=0.2`` besides.

    Raises
    ------
    InputError
        If the text is not of that form.
    """
    from trainlog.simulation import Change
    from trainlog.spans import utc

    remedy = "write it as km=10:14,date=2026-10-15,factor=1.3"
    given: dict[str, str] = {}
    for part in word.split(","):
        key, equals, value = (each.strip() for each in part.partition("="))
        if not (equals and value) or key in given or key not in ("km", "date", "factor", "spots"):
            raise InputError(f"change '{word}': '{part}' is not understood", remedy=remedy)
        given[key] = value
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
    return Change(km[0], km[1], int(when.value), factor, spots)


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
    from trainlog.spans import check_zone, stamp_of, utc

    if zone is not None:
        check_zone(zone)
    stamp = stamp_of(at)
    if zone is None or stamp.tzinfo is not None:
        return utc(stamp)
    try:
        return utc(stamp.tz_localize(zone))
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"'{at}' is not one time in the zone '{zone}'",
            remedy="write it with its offset, as 2026-11-22T06:00+01:00",
        ) from error


def zone_assumed(at: str | None, zone: str | None) -> str:
    """That a time is taken for UTC, where it states no zone and none is given; else empty."""
    from trainlog.spans import stamp_of

    if at is None or zone is not None or stamp_of(at).tzinfo is not None:
        return ""
    return f"{at} states no zone: taken for UTC (--zone names another)"


def map_of_run(
    condition: Path, at: str | None, line: Line
) -> tuple[TrackConditionMap, pd.Timestamp | None]:
    """The map, made of the evidence of the days before the time of the run alone, and that time.

    What is left out is printed. Without a time all evidence counts. Of a network's folder of maps
    it is the map along the `line`, in its own direction.

    Raises
    ------
    InputError
        If the file is no map, the time is none, or no evidence is of a day before.
    """
    from trainlog.condition import known_before, left_out
    from trainlog.formats.condition import read_map

    if condition.is_dir():
        from analysis.network.maps import network_map

        track = network_map(condition).along(line)
    else:
        track = read_map(condition)
    time = moment(at, None)
    if time is None:
        return track, None
    words = left_out(track, time)
    if words:
        console.print(f"  {condition.name}: read {words}", soft_wrap=True)
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
    from trainlog.mcap import stream_log
    from trainlog.mcap.convert import span_of
    from trainlog.mcap.records import nothing_of

    known = None if km is None else line_of_log(log, line)
    time, position = times(start, end, lambda: span_of(log)), stretch(km, known)
    empty = True
    for piece in stream_log(log, topics, time=time, position=position, rows=rows):
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
    from trainlog.formats.railway import read_line, read_train
    from trainlog.formats.settings import read_settings

    known = read_settings()
    own_line = line or (Path(known.line).expanduser() if known.line else None)
    own_train = train or (Path(known.train).expanduser() if known.train else None)
    found = kept
    if own_line is not None and (line is not None or kept is None):
        found = read_line(own_line)
    if found is not None and own_train is not None:
        return found, read_train(own_train)
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
                "holds no sections of a journey",
                file=path,
                remedy="name a folder that 'trainlog plan --stops' wrote, or its files",
            )
        found += files
    return found


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
    from trainlog.formats.railway import read_line, read_network
    from trainlog.ingest.routes import NetworkRoutes, places_in

    if line is not None:
        refuse_rivals("--line is given", {"--network": network})
    if line is not None and line.name.endswith(NETWORK_SUFFIX):
        line, network = None, line
    if network is not None:
        return None, NetworkRoutes(read_network(network), places_in(stations or ""))
    refuse_rivals("they are those of a network", {"--stations": stations}, "or give --network")
    return None if line is None else read_line(line), None


def pairs(given: list[str]) -> dict[str, str]:
    """Metadata given as ``key=value``."""
    from trainlog.railway.train import check_load
    from trainlog.railway.weather import given_condition

    found = {}
    for word in given:
        key, equals, value = word.partition("=")
        if not (key and equals and value):
            raise InputError(f"'{word}' is not of the form key=value", remedy="as in weather=wet")
        if key not in FACTS:
            raise InputError(f"'{key}' is no known fact", remedy=f"known: {', '.join(FACTS)}")
        if key == "weather":
            value = given_condition(value)
        if key == "load":
            load = MASS.between(0.0).read(value, "load")
            check_load(load)
            value = value if value[-1:].isdigit() else f"{load:.0f}"
        found[key] = value
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


def destination(path: Path, suffix: str) -> Path:
    """A file to be written, checked before any work is done."""
    if path.suffix != suffix:
        raise InputError(
            f"is not the name of a {suffix} file", file=path, remedy=f"end it in {suffix}"
        )
    if path.is_dir() or not path.absolute().parent.is_dir():
        what = "is a folder" if path.is_dir() else "cannot be written: its folder does not exist"
        raise InputError(what, file=path, remedy="name a file in a folder that exists")
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
