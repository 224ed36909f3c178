"""From an unknown table to a profile: proposed, with what each line of it rests on."""

from __future__ import annotations

from collections.abc import Hashable, Iterable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from textwrap import TextWrapper
from typing import Any

import numpy as np
import pandas as pd

from trainlog.declaration import content_of
from trainlog.display import counted
from trainlog.errors import InputError, in_file
from trainlog.formats.declared import toml_value
from trainlog.ingest.matching import placed
from trainlog.ingest.motion import FAR, POSITION, speed_of
from trainlog.ingest.parts import parts_of
from trainlog.ingest.profile import MISSING, Limits, Profile, Repair, parse_profile
from trainlog.ingest.proposal.columns import (
    EITHER_BRAKE,
    PAUSE,
    Proposed,
    Work,
    columns_of,
    find_trips,
    keep_others,
    refuse_no_motion,
    said,
)
from trainlog.ingest.proposal.layout import Reading, clock_of, layout_of
from trainlog.ingest.proposal.vocabulary import meaning_of
from trainlog.ingest.recording import NO_TIME, Recording, field_of
from trainlog.ingest.registry import format_of, own_profile
from trainlog.ingest.rules import repaired
from trainlog.ingest.tabular import read_delimited, read_parquet
from trainlog.presentation import Presented
from trainlog.railway.line import Line
from trainlog.railway.train import Train
from trainlog.topics import TOPICS
from trainlog.trip import RECORDED_BRAKE
from trainlog.units import factor

TABLES = ("csv", "parquet")
"""Formats whose files a profile can be proposed for."""

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
        First rows, and some of a moving train, as they would be read, in the usual units.
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
                taken = f"{row['column']}: {row['field']}{unit} ({row['why']})"
                found.append(f"{taken}; or {row['alternative']}")
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
        At whose end a counter that falls is 0, and at whose stations the trips must stop, where
        their counter starts elsewhere.

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
    with in_file(source):
        layout = layout_of(source)
        units = zip(layout.names, layout.units, strict=True)
        meanings = {name: meaning_of(name, unit or None) for name, unit in units}
        clock = clock_of(layout, meanings)
        work = columns_of(layout, clock, meanings, train, line)
        find_trips(work)
        keep_others(work)
        refuse_no_motion(work)
        readings = [*layout.readings, *clock.readings, *work.readings]
        read = read_parquet if layout.format == "parquet" else read_delimited
        text, profile = _stated(work, readings)
        recording = read(source, profile)
        readings += _pauses(recording, profile, source.stem)
        text, profile = _stated(work, readings)
        if line is not None:
            readings += _start(parts_of(recording, profile, source.stem), line, train)
            text, profile = _stated(work, readings)
        rows = [
            {
                "column": ", ".join(each.column.names),
                "field": each.field,
                "unit": each.column.unit or "",
            }
            | {"why": each.why, "check": each.check, "alternative": each.alternative}
            for each in _ordered(work)
        ]
        return Proposal(
            source, text, profile, pd.DataFrame(rows), _preview(recording), tuple(readings),
            _not_used(work), clock.one_file, layout.names,
        )  # fmt: skip


def needs_profile(path: Path, format: str | None = None) -> bool:
    """Whether a file is a table that no format and no profile of the user's folder knows.

    Examples
    --------
    >>> needs_profile(Path("sample_logs/recorder.csv")), needs_profile(Path("sample_logs/gnss.csv"))
    (True, False)
    """
    return format_of(path, format).name in TABLES and own_profile(path) is None


def _ordered(work: Work) -> list[Proposed]:
    """What is proposed, in the order of the table of topics; a recorder's own comes last."""
    known = [f"{topic.name}.{item.name}" for topic in TOPICS.values() for item in topic.fields]
    places = {name: place for place, name in enumerate(known)}
    return sorted(work.proposed.values(), key=lambda each: places.get(each.field, len(known)))


def _not_used(work: Work) -> dict[str, str]:
    left = {name: work.left[name] for name in work.layout.names if name in work.left}
    return work.layout.unnamed | left


def _start(parts: list[Recording], line: Line, train: Train | None) -> list[Reading]:
    """Where the trips begin on the line, if their counter starts elsewhere; none if it does not."""
    shown = []
    for part in parts:
        try:
            table = repaired(part.tables[0], Limits(), Repair())[0]
        except InputError:
            continue
        position = table.signals.get(POSITION)
        if position is None or not np.isfinite(position).any():
            return []
        if np.nanmin(position) > -FAR and np.nanmax(position) < line.length + FAR:
            return []
        try:
            shown.append(placed(table, line, train, None, by_stations=True).evidence)
        except InputError as error:
            what, remedy = "as the counter has it", error.remedy or ""
            return [Reading("start position", what, error.problem, remedy)]
    why = f"the counter starts elsewhere than line '{line.name}'; {'; '.join(shown[:4])}"
    return [Reading("start position", "stations", why)] if shown else []


def _pauses(recording: Recording, profile: Profile, stem: str) -> list[Reading]:
    """The trips that pauses part; none if there are no such pauses."""
    limits = replace(profile.limits, pause=PAUSE)
    parts = parts_of(recording, replace(profile, limits=limits), stem)
    if len(parts) == len(parts_of(recording, profile, stem)):
        return []
    spans = [part.tables[0].time for part in parts[:6]]
    spans = [pd.to_datetime(time[time != NO_TIME]) for time in spans]
    shown = ", ".join(f"{time.min():%H:%M} to {time.max():%H:%M}" for time in spans)
    shown += ", ..." if len(parts) > 6 else ""
    why = f"no rows, or standstill, for more than {PAUSE / 60.0:.0f} min between them"
    other = "one trip: leave out pause under [limits]"
    return [Reading("pauses", f"{len(parts)} trips (UTC): {shown}", why, other)]


def _preview(recording: Recording) -> pd.DataFrame:
    """Rows as they would be read, in the usual units."""
    table = recording.tables[0]
    fast = 0
    speed = speed_of(table)
    if speed is not None:
        fast = int(np.nanargmax(speed >= 0.9 * np.nanpercentile(speed, 98)))
    rows = np.unique(np.add.outer([0, fast], np.arange(PREVIEW)).clip(0, len(table) - 1))
    columns: dict[str, object] = {"row": table.rows[rows]}
    for name, values in table.signals.items():
        topic, label, item = field_of(name)
        unit = item.usual_unit if item.unit else "1"
        slope, offset = factor(unit, item.unit or "1")
        label = f"gnss {label}" if topic.name == "/gnss/motion" else label
        label = label if unit == "1" else f"{label} [{unit}]"
        columns[label] = np.round((values[rows] - offset) / slope, 6 if unit == "deg" else 3)
    columns |= {name.rpartition(".")[2]: words[rows] for name, words in table.texts.items()}
    times = np.where(table.time[rows] > 0, table.time[rows], NO_TIME)
    return pd.DataFrame(columns, index=pd.DatetimeIndex(times, tz="UTC", name="time"))


# ------------------------------------------------------------------------------ the commented TOML


def _stated(work: Work, readings: list[Reading]) -> tuple[str, Profile]:
    """The profile as commented TOML, and as it is read."""
    text = "\n".join(_toml(work, {reading.what: reading for reading in readings})) + "\n"
    name = f"the profile proposed for {work.layout.path.name}"
    return text, parse_profile(text.encode(), file=name)


def _toml(work: Work, found: dict[str, Reading]) -> Iterator[str]:
    layout, clock, trips = work.layout, work.clock, work.trips
    proposed, not_used = _ordered(work), _not_used(work)
    yield from _note(
        f"Proposed by trainlog from {layout.path.name}. Comments say what each line rests on;"
        " 'open' marks what the data do not decide. docs/ingest.md explains the keys."
    )
    title = f"Proposed from {layout.path.name}"
    yield from _keys(format="trainlog/recorder-profile", version=1, name=title)
    if layout.format == "csv" and layout.options.header and not clock.one_file:
        used = [*clock.options.names, *(name for each in proposed for name in each.column.names)]
        yield "\n# Files with these columns are recognised (folder TRAINLOG_PROFILES)."
        yield "[detect]"
        yield from _keys(columns=tuple(dict.fromkeys([*used, *trips.names])))
    yield "\n[file]"
    written = {key: getattr(layout.options, key) for key in _IN_FILE}
    usual = {"skip_after_header": 0, "missing": MISSING}
    for key, value in written.items() if layout.format == "csv" else [("format", "parquet")]:
        if value != usual.get(key, ""):
            why = found[_IN_FILE[key]].why if _IN_FILE[key] in found else ""
            yield from (f"{line}  # {why}" if why else line for line in _keys(**{key: value}))
    yield "\n[time]"
    yield from _notes(clock.readings)
    options = content_of(clock.options)
    if clock.options.format != "epoch":
        options["timezone"] = clock.options.timezone
    yield from _keys(**options)
    if "time zone" in found and found["time zone"].alternative:
        yield "# Trips state this assumption. Correct timezone, or remove this line if it is right:"
        yield from _keys(assumed_timezone=clock.options.timezone)
    yield "\n[columns]"
    yield from _notes(r for r in work.readings if r.what.startswith("column "))
    for each in proposed:
        yield from _note(said(each.why, each.check), each.alternative)
        column = toml_value(content_of(each.column))
        yield f"{toml_value(each.field)} = {column}"
    if not_used:
        yield "\n# Not used:"
        yield from (f"#   {toml_value(n)}: {' '.join(why.split())}" for n, why in not_used.items())
    if any(EITHER_BRAKE in each.alternative for each in proposed):
        yield "\n[metadata]"
        yield "# Trips state what is open of the brake. Remove this if it is the dynamic brake's:"
        yield from _keys(**{RECORDED_BRAKE: f"may be {EITHER_BRAKE}"})
    yield "\n[trip]"
    yield "# What the file does not state, and fit, slip and map need:"
    yield '# load = { value = 12, unit = "t" }'
    yield '# weather = "dry"'
    yield '# direction = "forward"'
    start = found.get("start position")
    yield from _notes([start] if start else [])
    if start is not None and not start.alternative:
        yield 'start_position = "stations"  # of each trip; or { value = 0.2, unit = "km" }'
    else:
        yield '# start_position = { value = 0.2, unit = "km" }  # or "stations": by its stops'
    if trips.names:
        yield "\n[trip.columns]"
        yield from _notes(found[what] for what in ("trips", "load", "weather") if what in found)
        yield from _keys(**content_of(trips))
    if "pauses" in found:
        yield "\n[limits]"
        yield from _notes([found["pauses"]])
        yield f"pause = {PAUSE:.0f}  # s"


_IN_FILE = {
    "format": "", "encoding": "encoding", "delimiter": "delimiter", "decimal": "decimal mark",
    "thousands": "thousands mark",
    "header": "", "skip_after_header": "units", "missing": "missing values",
}  # fmt: skip
"""Keys under [file], and what is read to know each."""


def _keys(**values: Any) -> list[str]:
    return [f"{name} = {toml_value(value)}" for name, value in values.items()]


def _notes(readings: Iterable[Reading]) -> Iterator[str]:
    for each in readings:
        yield from _note(f"{each.what}: {each.taken}: {each.why}", each.alternative)


_COMMENT = TextWrapper(
    100, initial_indent="# ", subsequent_indent="# ", break_long_words=False, break_on_hyphens=False
)


def _note(text: str, alternative: str = "") -> list[str]:
    """A comment, and what the data allow as well."""
    return _COMMENT.wrap(text) + _COMMENT.wrap(f"open: or {alternative}" if alternative else "")
