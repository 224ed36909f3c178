"""From an unknown table to a profile: proposed, with what each line of it rests on."""

from __future__ import annotations

import datetime
from collections.abc import Hashable, Iterator
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.formats.declared import toml_value
from trainlog.ingest.parts import parts_of
from trainlog.ingest.placing import OVERRUN, placed
from trainlog.ingest.profile import MISSING, Limits, Profile, Repair, TimeOptions, parse_profile
from trainlog.ingest.proposal.columns import EITHER_BRAKE, columns_of
from trainlog.ingest.proposal.layout import Layout, Reading, layout_of
from trainlog.ingest.proposal.times import Clock, clock_of
from trainlog.ingest.proposal.trips import PAUSE, trip_lines
from trainlog.ingest.proposal.vocabulary import meaning_of
from trainlog.ingest.proposal.work import Proposed, Work, said
from trainlog.ingest.recording import NO_TIME, Recording, base_name, field_of
from trainlog.ingest.registry import format_of, own_profile
from trainlog.ingest.rules import repaired
from trainlog.ingest.tabular import read_delimited, read_parquet
from trainlog.presentation import Presented
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.topics import RECORDED, TOPICS
from trainlog.trip import RECORDED_BRAKE
from trainlog.units import KMH, PER_MILLE

TABLES = ("csv", "parquet")
"""Formats whose files a profile can be proposed for."""

SHOWN = {
    "m": ("km", 1e-3, 3), "m/s": ("km/h", KMH, 1), "N": ("kN", 1e-3, 1), "K": ("°C", 1.0, 1),
    "deg": ("°", 1.0, 6), "V": ("kV", 1e-3, 2), "Pa": ("bar", 1e-5, 2), "m/s^2": ("m/s²", 1.0, 2),
}  # fmt: skip
"""Units of the preview: those of railway people, factor, decimals."""

STATED = ("scale", "offset", "part", "sign", "meaning", "notation")
"""Keys of a column that a profile holds where they are not the usual ones."""

PREVIEW = 3
"""Rows of the preview from the file's begin, and from where the train is fast."""


@dataclass(frozen=True, eq=False, repr=False)
class Proposal(Presented):
    """A profile proposed for a file.

    Attributes
    ----------
    path : Path
        The file.
    text : str
        The profile as a commented TOML file.
    profile : Profile
        The same, parsed.
    evidence : DataFrame
        A row a field: column, field, unit, why, check (what physics says, in numbers), alternative.
    preview : DataFrame
        First rows, and some of a moving train, as they would be read; km, km/h, kN.
    readings : tuple of Reading
        How the file is written, and its time.
    not_used : dict of str to str
        Columns that became no field, and why.
    one_file : bool
        Whether the profile holds for this file alone: it states the day of its start.
    names : tuple of str
        Columns of the file, by which files of the same layout are known.

    Examples
    --------
    >>> from trainlog.ingest import propose_profile
    >>> proposal = propose_profile("sample_logs/recorder.csv")
    >>> proposal.profile.columns["/train/state.speed"].unit
    'km/h'
    """

    path: Path
    text: str
    profile: Profile
    evidence: pd.DataFrame
    preview: pd.DataFrame
    readings: tuple[Reading, ...]
    not_used: dict[str, str]
    one_file: bool
    names: tuple[str, ...]

    @property
    def open(self) -> tuple[str, ...]:
        """What the data leave open: what was taken, and the alternative."""
        found = [
            f"{r.what}: {r.taken} ({r.why}); or {r.alternative}"
            for r in self.readings
            if r.alternative
        ]
        for row, unit in self._rows():
            if row["alternative"]:
                found += [
                    f"{row['column']}: {row['field']}{unit} ({row['why']}); or {row['alternative']}"
                ]
        return tuple(found)

    def _rows(self) -> Iterator[tuple[dict[Hashable, Any], str]]:
        """The rows of the evidence, each with its unit in brackets if it has one."""
        for row in self.evidence.to_dict("records"):
            yield row, f" [{row['unit']}]" if row["unit"] else ""

    def fits(self, path: str | Path) -> bool:
        """Whether another file has the same columns, so that the profile can be used for it."""
        if self.one_file:
            return False
        try:
            return layout_of(Path(path)).names == self.names
        except InputError:
            return False

    def lines(self) -> list[str]:
        """The proposal in words, a line each."""
        found = [f"{r.what}: {r.taken} ({r.why})" for r in self.readings]
        for row, unit in self._rows():
            reason = said(row["why"], row["check"])
            found.append(f"{row['column']} -> {row['field']}{unit}: {reason}")
        found += [f"not used: {name}: {why}" for name, why in self.not_used.items()]
        found += [f"open: {question}" for question in self.open]
        numbers = self.preview.set_index("row").T
        shown = numbers.map(lambda each: f"{each:.9g}" if isinstance(each, float) else str(each))
        return [
            *found,
            "as it would be read, by row of the file:",
            *(f"  {row}" for row in shown.to_string().splitlines()),
        ]

    @property
    def title(self) -> str:
        """The file."""
        return f"Proposed profile of {self.path.name}"

    def summary(self) -> dict[str, str]:
        """What was taken for what, and what is open."""
        rows = {reading.what: reading.taken for reading in self.readings}
        for row, unit in self._rows():
            rows[row["field"]] = f"{row['column']}{unit}"
        rows["not used"] = ", ".join(self.not_used) or "-"
        rows["open"] = counted(len(self.open), "reading")
        return rows


def propose_profile(
    path: str | Path, train: Train | None = None, line: Line | None = None
) -> Proposal:
    """Propose a profile for a table of an unknown layout.

    Encoding, delimiter, decimal mark, header and units are read from the cells; columns by their
    names and units in English, German and French; each is checked by mechanics: the speed must
    integrate to the distance and to the way between satellite fixes, efforts must accelerate a
    train's mass, wheels must turn as fast as the train runs. What the data leave open is stated.

    Parameters
    ----------
    path : path
        Delimited text or Parquet.
    train : Train, optional
        Whose mass the efforts must accelerate; without it, any train's.
    line : Line, optional
        At whose stations the trips must stop, where their counter starts elsewhere.

    Raises
    ------
    InputError
        If the file is no table, or is no recording of a trip, with the reason.

    Examples
    --------
    >>> proposal = propose_profile("sample_logs/recorder.csv")
    >>> speed = proposal.evidence.set_index("field").loc["/train/state.speed"]
    >>> speed["column"], speed["unit"]
    ('V_kmh', 'km/h')
    >>> [question.split(":")[0] for question in proposal.open][:1]
    ['time zone']
    """
    source = Path(path)
    layout = layout_of(source)
    meanings = {
        name: meaning_of(name, unit or None)
        for name, unit in zip(layout.names, layout.units, strict=True)
    }
    clock = clock_of(layout, meanings)
    work = columns_of(layout, clock, meanings, train)
    # Those of a recorder's own come last.
    known = [f"{topic.name}.{item.name}" for topic in TOPICS.values() for item in topic.fields]
    places = {name: place for place, name in enumerate(known)}
    proposed = sorted(work.proposed.values(), key=lambda each: places.get(each.field, len(known)))
    not_used = layout.unnamed | {
        name: work.left[name] for name in layout.names if name in work.left
    }
    readings = (*layout.readings, *clock.readings, *work.readings, *work.trips.readings)
    read = read_parquet if layout.format == "parquet" else read_delimited

    def stated(more: list[str]) -> tuple[str, Profile]:
        text = "\n".join([_toml(work, proposed, readings, not_used), *more, ""])
        name = f"the profile proposed for {source.name}"
        return text, parse_profile(text.encode(), file=name)

    text, profile = stated([])
    recording = read(source, profile)
    pauses = _pauses(recording, profile, source.stem)
    if pauses is not None:
        readings = (*readings, pauses)
        text, profile = stated(_pause_lines(pauses))
    start = None if line is None else _start(parts_of(recording, profile, source.stem), line, train)
    if start is not None:
        readings = (*readings, start)
        text, profile = stated([] if pauses is None else _pause_lines(pauses))
    refused = _refused(parts_of(recording, profile, source.stem))
    if refused is not None:
        readings = (*readings, refused)
    return Proposal(
        source, text, profile, _evidence(proposed), _preview(recording), readings, not_used,
        clock.one_file, layout.names,
    )  # fmt: skip


def needs_profile(path: Path, format: str | None = None) -> bool:
    """Whether a file is a table that no format and no profile of the user's folder knows.

    Examples
    --------
    >>> needs_profile(Path("sample_logs/recorder.csv")), needs_profile(Path("sample_logs/gnss.csv"))
    (True, False)
    """
    return format_of(path, format).name in TABLES and own_profile(path) is None


def _evidence(proposed: list[Proposed]) -> pd.DataFrame:
    names = ["field", "unit", "why", "check", "alternative"]
    rows = [[", ".join(each.columns), *(getattr(each, n) for n in names)] for each in proposed]
    return pd.DataFrame(rows, columns=["column", *names])


def _start(parts: list[Recording], line: Line, train: Train | None) -> Reading | None:
    """Where the trips begin on the line, if their counter starts elsewhere; None if it does not."""
    shown = []
    for part in parts:
        try:
            table = repaired(part.tables[0], Limits(), Repair())[0]
        except InputError:
            continue
        position = table.signals.get("/train/state.position")
        if position is None or not np.isfinite(position).any():
            return None
        low, high = np.nanmin(position), np.nanmax(position)
        if low > -OVERRUN and high < line.length + OVERRUN:
            return None
        try:
            place = placed(table, line, train, None, by_stations=True)
        except InputError as error:
            return Reading(
                "start position", "as the counter has it", error.problem, error.remedy or ""
            )
        shown.append(place.evidence)
    why = f"the counter starts elsewhere than line '{line.name}'; {'; '.join(shown[:4])}"
    return Reading("start position", "stations", why) if shown else None


def _pauses(recording: Recording, profile: Profile, stem: str) -> Reading | None:
    """The trips that pauses part; None if there are no such pauses."""
    limits = profile.limits.model_copy(update={"pause": PAUSE})
    parts = parts_of(recording, profile.model_copy(update={"limits": limits}), stem)
    if len(parts) == len(parts_of(recording, profile, stem)):
        return None
    spans = [part.tables[0].time for part in parts]
    known = [time[time != NO_TIME] for time in spans]
    shown = ", ".join(
        f"{pd.Timestamp(time.min()):%H:%M} to {pd.Timestamp(time.max()):%H:%M}"
        for time in known[:6]
    )
    shown += ", ..." if len(known) > 6 else ""
    return Reading(
        "pauses", f"{len(parts)} trips (UTC): {shown}",
        f"no rows, or standstill, for more than {PAUSE / 60.0:.0f} min between them",
        "one trip: leave out pause under [limits]",
    )  # fmt: skip


def _pause_lines(pauses: Reading) -> list[str]:
    return [
        "",
        "[limits]",
        *_wrapped(f"{pauses.why}: {pauses.taken}"),
        *_wrapped(f"open: or {pauses.alternative}"),
        f"pause = {PAUSE:.0f}  # s",
    ]


def _refused(parts: list[Recording]) -> Reading | None:
    """What the rules of repair would refuse of the file, read so."""
    for table in [table for part in parts for table in part.tables]:
        try:
            repaired(table, Limits(), Repair())
        except InputError as error:
            return Reading("the file as a whole", "is refused", error.problem, error.remedy or "")
    return None


def _preview(recording: Recording) -> pd.DataFrame:
    """Rows as they would be read, in units of railway people."""
    table = recording.tables[0]
    count = len(table)
    first = np.arange(min(PREVIEW, count))
    middle = count // 2
    speed = table.signals.get("/train/state.speed", table.signals.get("/gnss/motion.speed"))
    if speed is not None and np.isfinite(speed).any():
        middle = int(np.nanargmax(speed >= 0.9 * np.nanpercentile(speed, 98)))
    later = np.arange(middle, min(middle + PREVIEW, count))
    rows = np.unique(np.concatenate([first, later]))
    columns: dict[str, object] = {"row": table.rows[rows]}
    for name, values in table.signals.items():
        if name.startswith(RECORDED):
            columns[name.removeprefix(RECORDED)] = np.round(values[rows], 3)
            continue
        si = field_of(name)[2].unit
        unit, size, digits = SHOWN.get(si, (si, 1.0, 3))
        if base_name(name) == "/environment.gradient":
            unit, size, digits = "‰", PER_MILLE, 1
        elif name.startswith("/gnss/fix") and si == "m":
            unit, size, digits = "m", 1.0, 1
        shown = values[rows] * size - (273.15 if si == "K" else 0.0)
        label = name.rpartition(".")[2]
        label = f"gnss {label}" if name.startswith("/gnss/motion.speed") else label
        columns[f"{label} [{unit}]" if unit not in ("", "1") else label] = np.round(shown, digits)
    columns |= {name.rpartition(".")[2]: words[rows] for name, words in table.texts.items()}
    known = np.where(table.time[rows] > 0, table.time[rows], np.iinfo(np.int64).min)
    return pd.DataFrame(columns, index=pd.DatetimeIndex(known, tz="UTC", name="time"))


def _toml(
    work: Work, proposed: list[Proposed], readings: tuple[Reading, ...], not_used: dict[str, str]
) -> str:
    """The profile as commented TOML."""
    layout, clock = work.layout, work.clock
    found = {reading.what: reading for reading in readings}
    lines = [
        *_wrapped(
            f"Proposed by trainlog from {layout.path.name}. Comments say what each line rests on;"
            " 'open' marks what the data do not decide. docs/ingest.md explains the keys."
        ),
        'format = "trainlog/recorder-profile"',
        "version = 1",
        f"name = {toml_value('Proposed from ' + layout.path.name)}",
        "",
    ]
    if layout.format == "csv" and layout.options.header and not clock.one_file:
        used = [*clock.options.names, *(name for each in proposed for name in each.columns)]
        used += work.trips.columns.names
        lines += [
            "# Files with these columns are recognised (folder TRAINLOG_PROFILES).",
            "[detect]",
        ]
        lines += [f"columns = {toml_value(tuple(dict.fromkeys(used)))}", ""]
    lines += _file_section(layout, found)
    lines += _time_section(clock)
    lines.append("[columns]")
    for reading in readings:
        if reading.what.startswith("column "):
            lines += _wrapped(f"{reading.what}: {reading.taken}: {reading.why}")
    for each in proposed:
        lines += _column_lines(each)
    if not_used:
        lines += ["", "# Not used:"]
        lines += [f"#   {toml_value(name)}: {_plain(why)}" for name, why in not_used.items()]
    if any(EITHER_BRAKE in each.alternative for each in proposed):
        lines += [
            "",
            "[metadata]",
            "# Trips state what is open of the brake. Remove this if it is the dynamic brake's:",
            f"{RECORDED_BRAKE} = {toml_value('may be ' + EITHER_BRAKE)}",
        ]
    lines += [
        "",
        "[trip]",
        "# What the file does not state, and fit, slip and map need:",
        '# load = { value = 12, unit = "t" }',
        '# weather = "dry"',
        '# direction = "forward"',
    ]
    start = found.get("start position")
    if start is not None:
        lines += _wrapped(f"{start.what}: {start.taken}: {start.why}")
        lines += _wrapped(f"open: {start.alternative}") if start.alternative else []
    if start is not None and not start.alternative:
        lines.append('start_position = "stations"  # of each trip; or { value = 0.2, unit = "km" }')
    else:
        lines.append(
            '# start_position = { value = 0.2, unit = "km" }  # or "stations": by its stops'
        )
    return "\n".join([*lines, *trip_lines(work.trips)])


def _key(name: str, value: Any, why: str = "") -> str:
    """A line that states a value, and why."""
    return f"{name} = {toml_value(value)}" + (f"  # {_plain(why)}" if why else "")


def _file_section(layout: Layout, found: dict[str, Reading]) -> list[str]:
    options = layout.options
    lines = ["[file]", _key("format", layout.format)]
    if layout.format == "csv":
        whats = {"encoding": "encoding", "delimiter": "delimiter", "decimal": "decimal mark"}
        lines += [_key(key, getattr(options, key), found[what].why) for key, what in whats.items()]
        lines.append(_key("header", 1 if options.header is None else options.header))
        if options.skip_after_header:
            note = f"a line of units: {found['units'].why}" if "units" in found else ""
            lines.append(_key("skip_after_header", options.skip_after_header, note))
        if options.missing != MISSING:
            lines.append(_key("missing", options.missing, found["missing values"].why))
    return [*lines, ""]


def _time_section(clock: Clock) -> list[str]:
    lines = ["[time]"]
    for reading in clock.readings:
        lines += _wrapped(f"{reading.what}: {reading.taken}: {reading.why}")
        if reading.alternative:
            lines += _wrapped(f"open: or {reading.alternative}")
    options = clock.options
    single = options.column is not None
    lines.append(_key("column", options.column) if single else _key("columns", options.columns))
    default = TimeOptions(column="time")
    for key in ("format", "unit", "timezone"):
        value = getattr(options, key)
        if value != getattr(default, key) or (key == "timezone" and options.format != "epoch"):
            lines.append(_key(key, value))
    if any(each.what == "time zone" and each.alternative for each in clock.readings):
        lines += [
            "# Trips state this assumption. Correct timezone, or remove this line if it is right:",
            _key("assumed_timezone", options.timezone),
        ]
    if isinstance(options.start, datetime.datetime):
        lines.append(f"start = {options.start.isoformat()}")
    if options.date is not None:
        lines.append(f"date = {options.date.isoformat()}")
    return [*lines, ""]


def _column_lines(each: Proposed) -> list[str]:
    lines = _wrapped(said(each.why, each.check))
    if each.alternative:
        lines += _wrapped(f"open: or {each.alternative}")
    several = each.field.startswith("/train/axles.")
    keys: dict[str, Any] = {"columns": each.columns} if several else {"column": each.columns[0]}
    keys |= {"unit": each.unit} if each.unit else {}
    for item in fields(each):
        if item.name in STATED and getattr(each, item.name) != item.default:
            keys[item.name] = getattr(each, item.name)
    return [*lines, f'"{each.field}" = {toml_value(keys)}']


def _plain(text: str) -> str:
    return " ".join(text.split())


def _wrapped(text: str) -> list[str]:
    """A comment, broken at 100 columns."""
    lines, line = [], "#"
    for word in text.split():
        if len(line) + 1 + len(word) > 100:
            lines.append(line)
            line = "#"
        line += f" {word}"
    return [*lines, line]
