"""What a file or a folder holds, recognised by its content and stated in a few lines."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from trainlog.display import counted
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.files import (
    LOOKED_AT,
    head_of,
    is_map,
    mistaken_json,
    refuse_workbook,
    stated_format,
)
from trainlog.formats.railway import read_network, route_of_path
from trainlog.presentation import Column, WordTable, facts_table, new_table

if TYPE_CHECKING:
    import pandas as pd

    from trainlog.mcap.description import LogDescription

MCAP = b"\x89MCAP"

RECORDED = ("a Parquet file", "an MDF file")
"""Other files that recorders write, as `mistaken_json` calls them."""


@dataclass(frozen=True)
class Contents:
    """What a file holds.

    Attributes
    ----------
    path : Path
    kind : str
        In words, such as ``"line"``.
    value : object
        What was read; None of a map, whose estimate takes a while.
    lines : tuple of str
        What else there is to state.
    """

    path: Path
    kind: str
    value: Any = None
    lines: tuple[str, ...] = field(default=())

    @property
    def summary(self) -> str:
        """One line."""
        words = repr(self.value).splitlines() if self.value is not None else []
        return (words or list(self.lines) or [""])[0]

    @property
    def text(self) -> str:
        """A few lines."""
        return "\n".join([repr(self.value)] * (self.value is not None) + list(self.lines))

    @property
    def damaged(self) -> bool:
        """Whether it is a log of which something is lost."""
        return self.kind == "log" and not self.value.complete

    def described(self) -> LogDescription:
        """Of a log what is in it, and which of its fields hold a value."""
        from trainlog.mcap.description import recorded_fields

        found: LogDescription = self.value
        return replace(found, recorded=recorded_fields(found))

    def parts(self, *, every: bool = False) -> Sequence[WordTable | str]:
        """What is shown of it; if `every`, of a map its trips, and of a log its repairs, too."""
        if self.kind == "log":
            return [*self.described().shown(), *self._passport(), *self.repairs(every=every)]
        if self.kind in ("consist", "network", "route"):
            shown: Sequence[WordTable | str] = self.value.shown()
            return shown
        if self.kind == "track-condition map":
            return _map_tables(self.path)[: 1 + every]
        return [f"{self.path}: {self.kind}", self.text]

    def repairs(self, *, every: bool = True) -> list[WordTable | str]:
        """Of a log that ingest made: its report and, if `every`, the raw value of each repair."""
        from trainlog.mcap import read_log

        trip = read_log(self.path, []) if every else None
        if trip is None or all(each.get("step") != "ingest" for each in trip.provenance):
            return []
        from trainlog.ingest import repairs_of, report_of

        frame = repairs_of(trip).drop(columns="table")
        for name in ("raw_time", "new_time"):
            frame[name] = frame[name].dt.strftime("%Y-%m-%dT%H:%M:%S.%fZ")
        table = new_table(
            "repairs, SI",
            Column("row"),
            Column("time, UTC", of=lambda row: _of_day(row["raw_time"])),
            Column("rule"),
            Column("column"),
            Column("was", of=_was),
            Column("is", of=_is),
            name="repairs",
            frame=frame,
        )
        rows = frame.astype(object).where(frame.notna(), None).to_dict("records")
        return [*report_of(trip).lines(), table.add_rows(rows)]

    def _passport(self) -> list[WordTable]:
        from trainlog.formats.railway import passport_of
        from trainlog.mcap import read_log
        from trainlog.trip import PASSPORT_ATTACHMENT

        if PASSPORT_ATTACHMENT not in (each.name for each in self.value.attachments):
            return []
        found = passport_of(read_log(self.path, []))
        assert found is not None
        return [facts_table(found.title, found.summary(), "passport")]


def _of_day(time: str | None) -> str:
    """The time of day of a time, to milliseconds."""
    return "" if time is None else time[11:23]


def _was(repair: dict[str, Any]) -> str:
    """What of a cell, or of a whole row, stood in the file."""
    value = repair["raw_value"]
    return repair["raw_text"] or ("" if value is None else f"{value:.9g}")


def _is(repair: dict[str, Any]) -> str:
    """What became of it."""
    time, value = repair["new_time"], repair["new_value"]
    if time != repair["raw_time"]:
        return "dropped" if time is None else _of_day(time)
    return ("absent" if _was(repair) else "") if value is None else f"{value:.9g}"


@dataclass(frozen=True)
class FolderEntry:
    """What one file of a folder is.

    Attributes
    ----------
    name, kind, summary : str
    damaged : bool
        Whether it is a log of which something is lost, or of which nothing can be read.
    """

    name: str
    kind: str
    summary: str
    damaged: bool = False


def contents_of(path: str | Path) -> Contents:
    """What a file or a folder holds, by its content and not by its name.

    Parameters
    ----------
    path : path
        A log or an MCAP file of another program, a line, network, train, consist, journey, profile,
        parameter set, coast-down, trajectory, passport, characteristic, forecast, track-condition
        map, a recorder's file, a trip as Parquet or CSV; or a route, ``NET#A,B,C``.

    Raises
    ------
    TrainlogError
        If it is missing, damaged, or of no format that trainlog knows; with file and remedy.

    Examples
    --------
    >>> contents_of("sample_logs/DE_Chemnitz_Cranzahl.line.json").kind
    'line'
    >>> contents_of("sample_logs/gnss.csv").summary
    'Recording: 6,847 rows read'
    """
    path = Path(path)
    if (named := route_of_path(path)) is not None:
        file, places = named
        return Contents(path, "route", read_network(file).route(*places))
    if path.is_dir():
        from trainlog.formats.trip_tables import read_parquet, trip_index

        kind = trip_index(path).FORMAT.partition("-")[2]
        names = {"parquet": "trip as Parquet", "csv": "trip as CSV"}
        return Contents(path, names[kind], read_parquet(path))
    head = head_of(path)
    if head.startswith(MCAP):
        from trainlog.mcap import describe

        return Contents(path, "log", describe(path))
    if is_map(head[:LOOKED_AT]):
        return Contents(path, "track-condition map", lines=(_map_summary(path),))
    if stated := stated_format(head[:LOOKED_AT]):
        return _of_format(path, stated)
    if head.startswith(b"MDF ") and b"trainlog.json" in path.read_bytes()[-65_536:]:
        from trainlog.formats.trip_tables import read_mdf_trip

        return Contents(path, "trip as MDF", read_mdf_trip(path))
    refuse_workbook(head[:LOOKED_AT], path)
    what = mistaken_json(head[:LOOKED_AT])
    if what is not None and what not in RECORDED:
        remedy = "show what it was made of; 'rerun FILE' opens replays, archives are unpacked"
        raise InputError(f"is {what}", file=path, remedy=remedy)
    if re.match(rb"\s*<(!doctype )?html", head, re.IGNORECASE):
        remedy = "open it in a browser; show the results that 'trainlog report' made it of"
        raise InputError("is a web page, such as a report", file=path, remedy=remedy)
    from trainlog.formats.imports import project_of

    if (project := project_of(path, head)) is not None:
        words = f"make files of it that trainlog takes: trainlog import {path} -o FOLDER"
        return Contents(path, project.removeprefix("a "), None, (words,))
    if head.startswith(b"PAR1"):
        from trainlog.formats.summaries import holds_summaries, read_summaries

        if holds_summaries(path):
            return _of_summaries(path, read_summaries(path))
    return _recorded(path)


def _of_summaries(path: Path, found: pd.DataFrame) -> Contents:
    """What a file of summaries of a fit holds."""
    trains = ", ".join(dict.fromkeys(filter(None, found["train"])))
    refused = int((found["refused"] != "").sum())
    words = (
        f"{counted(len(found), 'trip')} of {trains or 'no known train'}, {refused} refused",
        f"fit more trips with them: trainlog fit efforts {path} LOGS -o NAME.json",
    )
    return Contents(path, "summaries of a fit", None, words)


def _map_summary(path: Path) -> str:
    """What a map's file holds; its estimate, which would be stored there, is not made."""
    from trainlog.formats.mapfile import MapFile

    with MapFile(path) as file, file.unchanging():
        trips, days = file.amount()
        track = file.empty
    return (
        f"{track.line}, {track.length / 1e3:.1f} km: {counted(trips, 'trip')} of"
        f" {counted(days, 'day')}"
    )


def _map_tables(path: Path) -> list[WordTable]:
    """What a map's file holds, and its recordings by the names that `map remove` takes."""
    from trainlog.condition import day_of_trip
    from trainlog.formats.mapfile import MapFile

    with MapFile(path) as file, file.unchanging():
        track, layers, trips = file.empty, file.contents(), file.trips()
    length = f"{track.length / 1e3:.1f} km, {track.bins} bins of {track.bin_length:g} m"
    counts = sum(number for number, _ in layers.values())
    more = len(trips) - counts
    beside = f"; {counted(more, 'recording')} more of drives that count" if more else ""
    every = sorted({day for _, days in layers.values() for day in days})
    facts = {
        "line": f"{track.line}, {length}",
        "trips": f"{counted(counts, 'trip')}, {_period(every)}{beside}",
    }
    for layer, (number, days) in layers.items():
        facts[f"layer {layer}"] = f"{counted(number, 'trip')}, {_period(days)}"
    table = new_table("", "trip", "rail\ncondition", "days", "counts")
    for row in trips:
        days = [day for day in row.days if row.first_day is not None]
        if not days:  # compacted, or without evidence: the day on which it ran
            ran = day_of_trip(json.loads(row.entry))
            days = [] if ran is None else [ran]
        words = " to ".join(dict.fromkeys(str(np.datetime64(day, "D")) for day in days))
        counts_too = "yes" if row.counted else "no"
        table.add_row(row.known.name, row.layer, words or "not known", counts_too)
    return [facts_table(path.name, facts, "map"), table]


def _period(days: list[int]) -> str:
    """Days since 1970-01-01: how many, the first and the last."""
    ends = dict.fromkeys(str(np.datetime64(day, "D")) for day in (*days[:1], *days[-1:]))
    return f"{counted(len(days), 'day')}, {' to '.join(ends)}" if days else "no evidence"


def _of_format(path: Path, stated: str) -> Contents:
    """What a file of trainlog's own formats holds."""
    from trainlog.formats import railway
    from trainlog.formats.characteristic import read_characteristic
    from trainlog.formats.declared import read_thing
    from trainlog.ingest.profile import read_profile
    from trainlog.railway.passport import Passport

    others: dict[str, tuple[str, Callable[[Path], Any]]] = {
        "characteristic": ("adhesion characteristic", read_characteristic),
        "passport": ("passport", partial(read_thing, Passport)),
        "recorder-profile": ("profile", read_profile),
    }
    name = stated.removeprefix("trainlog/")
    kind, read = others.get(name, ("parameter set" if name == "parameters" else name, None))
    read = read or getattr(railway, f"read_{name.replace('-', '_')}", None)
    if read is None:
        raise InputError(
            f"is a {stated} file, which is not shown",
            file=path,
            remedy="it is part of a trip or folder: show that",
        )
    return Contents(path, kind, read(path))


def _recorded(path: Path) -> Contents:
    """What a recorder's file holds, as far as that is known without a profile."""
    from trainlog.ingest.proposal.layout import layout_of
    from trainlog.ingest.recording import Recording
    from trainlog.ingest.registry import format_of, own_profile

    mine = own_profile(path)
    chosen = format_of(path, None)
    ingest = f"make a trip of it with: trainlog ingest {path} -o FOLDER"
    if mine is None and (chosen.layout == "own" or chosen.profile is not None):
        read = chosen.read(path, chosen.profile)
        recordings = (read,) if isinstance(read, Recording) else tuple(read)
        if len(recordings) == 1:
            return Contents(path, f"recording ({chosen.name})", recordings[0], (ingest,))
        names = [str(each.metadata.get("trip", "")) for each in recordings]
        shown = f"{len(names)} recordings: {', '.join(names[:6])}{', ...' * (len(names) > 6)}"
        return Contents(path, f"recordings ({chosen.name})", None, (shown, ingest))
    if chosen.name == "csv":
        try:
            table = layout_of(path)
        except InputError as error:
            raise InputError(
                "is text of no format that trainlog knows",
                file=path,
                remedy="give a table, a recorder's file, or a file that trainlog made; 'trainlog"
                " import' takes those of TTOBench, OSRD and railtoolkit",
            ) from error
        names = [*table.names, *table.unnamed]
        shown = f"{table.rows.size} rows of {len(names)} columns: {', '.join(names)}"
        remedy = f"{ingest}; a profile is proposed where none fits"
        return Contents(path, "table of a recorder", None, (shown, remedy))
    lines = (f"needs a profile that says what is what; {ingest} --profile PROFILE",)
    return Contents(path, f"recording ({chosen.name})", None, lines)


def folder_contents(folder: Path) -> list[FolderEntry]:
    """What each file of a folder is, in order of name; hidden ones left out.

    Examples
    --------
    >>> rows = folder_contents(Path("sample_logs"))
    >>> [row.kind for row in rows if row.name == "nonstop.mcap"]
    ['log']
    """
    found = []
    for path in sorted(folder.iterdir()):
        if path.name.startswith("."):
            continue
        if path.is_dir() and not (path / "trip.json").exists():
            entries = f"{len(list(path.iterdir()))} entries"
            found.append(FolderEntry(f"{path.name}/", "folder", entries))
            continue
        try:
            contents = contents_of(path)
        except TrainlogError as error:
            log = path.suffix == ".mcap"
            found.append(FolderEntry(path.name, "not shown", error.problem, damaged=log))
            continue
        words = contents.summary
        if contents.kind == "log":
            words = _log_in_words(contents.value)
        found.append(FolderEntry(path.name, contents.kind, words, contents.damaged))
    if not found:
        raise InputError("is an empty folder", file=folder, remedy="name another one")
    return found


def _log_in_words(log: LogDescription) -> str:
    """Line, train, length and day of a log, and its messages if nothing of it is lost."""
    known = [log.metadata.get(key, "") for key in ("line", "train", "direction")]
    if log.position_span is not None:
        known.append(f"{(log.position_span[1] - log.position_span[0]) / 1e3:.1f} km")
    known += [] if log.first is None else [f"{log.first:%Y-%m-%d %H:%M} UTC"]
    state = f"{log.count:,} messages" if log.complete else log.account.sentence
    return ", ".join(filter(None, [*known, state]))


def draw_contents(contents: Contents, path: Path) -> None:
    """Draw what a file holds.

    Raises
    ------
    InputError
        If there is no picture of it.
    """
    from analysis.charts import draw

    value = contents.value
    if contents.kind == "log":
        from trainlog.mcap import read_log

        value = read_log(contents.path)
    if not getattr(value, "charts_by", ""):
        raise InputError(
            f"there is no picture of a {contents.kind}",
            file=contents.path,
            remedy="see it in the browser with --open, or with 'trainlog report'",
        )
    draw(value, path)
