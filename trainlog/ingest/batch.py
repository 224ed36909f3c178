"""Many recorded files at once: every one is tried, and what became of each is listed.

What was made before of the same content, by the same code, with the same profile, line, train and
facts is not made again; the provenance of the logs in the output folder decides that.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd

from trainlog.display import counted
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.files import check_kept, head_of, output_folder, refuse_workbook, sha256_of
from trainlog.formats.trip_tables import INDEX_FILE
from trainlog.identity import TripIdentity, identity_of
from trainlog.ingest.pipeline import (
    PROFILE_ATTACHMENT,
    PROFILE_OBJECT_ATTACHMENT,
    Direction,
    Given,
    check_given,
    fingerprint,
    ingested,
)
from trainlog.ingest.profile import Profile
from trainlog.ingest.proposal.layout import NoRecordingError, looks_like_table
from trainlog.ingest.recording import SHOWN, Report, report_of
from trainlog.ingest.registry import formats
from trainlog.ingest.routes import NETWORK_INPUT, NetworkRoutes, routes_of
from trainlog.mcap import describe, write_log
from trainlog.mcap.reader import about_log, identity_of_log
from trainlog.presentation import NUMBER, Column, Presented, WordTable, new_table
from trainlog.progress import note, task
from trainlog.railway.line import Line
from trainlog.railway.network import Network
from trainlog.railway.train import Train
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.version import __version__

State = Literal["made", "repaired", "unchanged", "refused", "passed_over"]

STATES: dict[State, str] = {
    "made": "made, nothing to repair",
    "repaired": "made, with repairs",
    "unchanged": "made before of the same content in the same way",
    "refused": "became no trip",
    "passed_over": "no recording",
}
"""What can become of a recording."""

RECORDED = {
    ".csv", ".tsv", ".dat", ".gpx", ".log", ".mcap", ".mdf", ".mf4", ".nmea", ".parquet", ".txt",
    ".ubx",
}  # fmt: skip
"""Suffixes of recordings: a file in a folder that has one is refused where it cannot be read."""

DOCUMENTS = {
    ".bib", ".bmp", ".docx", ".gif", ".htm", ".html", ".ipynb", ".jpeg", ".jpg", ".json", ".md",
    ".pdf", ".png", ".pptx", ".py", ".rrd", ".rst", ".sh", ".svg", ".toml", ".webp", ".yaml",
    ".yml",
}  # fmt: skip
"""Suffixes of what lies beside recordings: profiles, lines, trains, manuals, pictures."""

_ATTACHED = (
    PROFILE_ATTACHMENT,
    PROFILE_OBJECT_ATTACHMENT,
    LINE_ATTACHMENT,
    TRAIN_ATTACHMENT,
    NETWORK_INPUT,
)
"""Inputs of a trip that are no recorded files."""


@dataclass(frozen=True)
class Outcome:
    """What became of a recorded file, or of one of its recordings.

    Attributes
    ----------
    file : Path
    state : {"made", "repaired", "unchanged", "refused", "passed_over"}
        See `STATES`.
    recording : str
        Its name, where the file holds several.
    log : Path or None
        That holds the trip.
    reason : str
        Why it was refused or passed over; how a trip came to be unchanged.
    report : Report or None
        What was read, kept and repaired.
    metadata : dict of str to str
        Of the trip.
    duration : float or None [s]
        Of a trip that was made now.
    """

    file: Path
    state: State
    recording: str = ""
    log: Path | None = None
    reason: str = ""
    report: Report | None = None
    metadata: Mapping[str, str] = field(default_factory=dict)
    duration: float | None = None

    @property
    def repairs(self) -> dict[str, int]:
        """How often each rule was applied."""
        return {} if self.report is None else self.report.counts

    def details(self) -> dict[str, Any]:
        """The outcome as JSON holds it."""
        report = self.report
        return {
            "file": str(self.file),
            "recording": self.recording or None,
            "state": self.state,
            "trip": self.metadata.get("trip"),
            "log": None if self.log is None else str(self.log),
            "rows_read": None if report is None else report.rows_read,
            "rows_kept": None if report is None else report.rows_kept,
            "repairs": self.repairs,
            "reason": self.reason or None,
        }


def _name(each: Outcome) -> str:
    return f"{each.file.name}, {each.recording}" if each.recording else each.file.name


def _repairs(each: Outcome) -> str:
    if each.state == "unchanged":
        return each.reason if each.reason.startswith("of") else "unchanged"
    return ", ".join(f"{rule} {count:,}" for rule, count in each.repairs.items()) or "nothing"


TRIP_COLUMNS = (
    Column("recording", of=_name),
    Column("log", of=lambda each: "" if each.log is None else each.log.name),
    Column("rows kept", NUMBER, of=lambda each: each.report and each.report.rows_kept),
    Column("repaired", of=_repairs, rank=1),
)
"""Of what became of a recording."""


@dataclass(frozen=True, eq=False, repr=False)
class Ingested(Presented):
    """What became of all files.

    Attributes
    ----------
    output : Path
        Folder of the logs.
    outcomes : tuple of Outcome
        In the order of the files.
    """

    output: Path
    outcomes: tuple[Outcome, ...]

    @property
    def title(self) -> str:
        """What became of the recordings."""
        return f"Ingested: {self.sentence}"

    def summary(self) -> dict[str, str]:
        """The first that were refused."""
        return {each.recording or each.file.name: each.reason for each in self.of("refused")[:8]}

    def tables(self) -> list[WordTable]:
        """Each trip with its log and repairs."""
        title = f"Logs in {self.output}"
        made = self.of("made", "repaired", "unchanged")
        return [new_table(title, *TRIP_COLUMNS, name="trips").add_rows(made)]

    @property
    def notes(self) -> list[str]:
        """What was refused and passed over, with reasons."""
        words = [
            ": ".join(filter(None, ["refused", each.recording, each.reason]))
            for each in self.of("refused")
        ]
        for each in self.of("made", "repaired", "unchanged"):
            direction = each.metadata.get("direction_evidence", "")
            motion = each.metadata.get("motion_evidence", "")
            words += [f"{_name(each)}: direction {direction}"] if "assumed" in direction else []
            words += [f"{_name(each)}: {motion}"] if motion else []
        others = self.of("passed_over")
        words += [f"passed over: {each.file}: {each.reason}" for each in others[:SHOWN]]
        if len(others) > SHOWN:
            words.append(f"passed over: {len(others) - SHOWN} more files")
        return words

    def sentences(self) -> list[str]:
        """What was refused and passed over; all of it in a line."""
        return [*self.notes, f"{self.sentence}."]

    def of(self, *states: State) -> list[Outcome]:
        """The outcomes of some states."""
        return [each for each in self.outcomes if each.state in states]

    @property
    def counts(self) -> dict[State, int]:
        """How many there are of each state."""
        found = Counter(each.state for each in self.outcomes)
        return {state: found[state] for state in STATES}

    @property
    def failed(self) -> bool:
        """Whether a recording became no trip."""
        return bool(self.counts["refused"])

    @property
    def sentence(self) -> str:
        """All of them in a line."""
        count = self.counts
        made = count["made"] + count["repaired"]
        words = [f"{counted(made, 'trip')} made, {count['repaired']} of them with repairs"]
        words += [f"{count['unchanged']} unchanged"] if count["unchanged"] else []
        words += [f"{count['refused']} refused"]
        if count["passed_over"]:
            words.append(f"{counted(count['passed_over'], 'file')} passed over")
        return "; ".join(words)

    @property
    def frame(self) -> pd.DataFrame:
        """One row an outcome, with the keys of `details` as columns."""
        keys = list(Outcome(Path(), "made").details())
        return pd.DataFrame([each.details() for each in self.outcomes], columns=keys)

    def details(self) -> dict[str, Any]:
        """What ``trainlog ingest --json`` prints; docs/ingest.md describes it."""
        return {
            "format": "trainlog/ingest",
            "version": 1,
            "software": f"trainlog {__version__}",
            "output": str(self.output),
            "counts": self.counts,
            "recordings": [each.details() for each in self.outcomes],
        }


def ingest_all(
    paths: str | Path | Iterable[str | Path],
    output: str | Path,
    profile: str | Path | Profile | None = None,
    *,
    format: str | None = None,
    line: Line | None = None,
    train: Train | None = None,
    direction: Direction | None = None,
    metadata: Mapping[str, str] | None = None,
    network: Network | NetworkRoutes | None = None,
    each: Callable[[Outcome, int, int], object] | None = None,
    choose: Callable[[Path], str | Path | Profile | None] | None = None,
    finish: Callable[[Trip], Trip] | None = None,
) -> Ingested:
    """Turn recorded files into logs; one that cannot be used does not keep the others from it.

    A log is named after its file or, where the file holds several recordings, after its trip.
    Logs of files of one name have their folders' names before; a log that holds something else is
    not overwritten.

    Parameters
    ----------
    paths : path, or iterable of them
        Files, and folders, of which every file is taken, those of folders in them, too. Files of a
        folder that are no recordings are passed over, hidden ones left out.
    output : path
        Folder for the logs.
    profile, format, line, train, direction, metadata, network
        As for `ingest`, the same for all files.
    each : callable, optional
        Called with each outcome, the number of files that are finished, and that of all.
    choose : callable, optional
        Gives the profile of a file, where `profile` is none; an `InputError` that it raises is why
        the file is refused. See `trainlog.ingest.propose_profile`.
    finish : callable, optional
        Makes of each trip the one that is written.

    Returns
    -------
    Ingested

    Raises
    ------
    InputError
        If there is no file, the profile or the format is none, or the output cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     first = ingest_all("sample_logs/gnss.csv", folder)
    ...     again = ingest_all("sample_logs/gnss.csv", folder)
    >>> first
    Ingested: 1 trip made, 1 of them with repairs; 0 refused
    >>> again.frame[["state", "rows_kept"]].values.tolist()
    [['unchanged', 6847]]
    """
    given = Given(profile, format, line, train, direction, metadata, routes_of(network))
    check_given(given)
    target = Path(output)
    every = [paths] if isinstance(paths, str | Path) else paths
    files = files_of([Path(path) for path in every], target)
    if not files:
        raise InputError("no recording was given", remedy="name files or folders")
    found: list[Outcome] = []
    sizes = [0 if reason else _size(file) for file, reason in files]
    with output_folder(target), task("ingesting", sum(sizes), "B") as step:
        recordings = [file for file, reason in files if not reason]
        named = frozenset(Path(path).resolve() for path in every)
        batch = _Batch(target, given, recordings, named, choose, finish)
        for number, (file, reason) in enumerate(files, start=1):
            place = f", {number} of {counted(len(files), 'file')}" if len(files) > 1 else ""
            step(sum(sizes[: number - 1]), note=f"reading {file.name}{place}")
            outcomes = [Outcome(file, "passed_over", reason=reason)] if reason else batch.make(file)
            for outcome in outcomes:
                found.append(outcome)
                if each is not None:
                    each(outcome, number, len(files))
    return Ingested(target, tuple(found))


def _size(path: Path) -> int:
    """Of a file, or of all in a folder [bytes]; 0 if it is not there, which is stated later."""
    try:
        files = path.rglob("*") if path.is_dir() else [path]
        return sum(each.stat().st_size for each in files)
    except OSError:
        return 0


def files_of(paths: Iterable[Path], output: Path) -> list[tuple[Path, str]]:
    """Files given and those of folders given, each once, with why it is passed over, if it is.

    Raises
    ------
    InputError
        If a folder holds no file.
    """
    found: dict[Path, tuple[Path, str]] = {}
    for path in paths:
        if not path.is_dir():
            found.setdefault(path.resolve(), (path, ""))
            continue
        held = [(file, no_recording(file)) for file in _files_in(path, output.resolve())]
        if not held:
            raise InputError(
                "the folder has no files", file=path, remedy="name files, or another folder"
            )
        for file, reason in held:
            found.setdefault(file.resolve(), (file, reason))
    return list(found.values())


def _files_in(folder: Path, output: Path) -> Iterator[Path]:
    """The files of a folder and of those in it, in order of name; a trip as Parquet is one."""
    for path in sorted(folder.iterdir()):
        if path.name.startswith(".") or (path.is_dir() and path.resolve() == output):
            continue
        if path.is_dir() and not (path / INDEX_FILE).is_file():
            yield from _files_in(path, output)
        else:
            yield path


def no_recording(file: Path) -> str:
    """Why a file found in a folder is no recording; empty if it may be one.

    Examples
    --------
    >>> no_recording(Path("sample_logs/recorder.profile.toml"))
    'its name ends in .toml'
    >>> no_recording(Path("sample_logs/stopping.mcap"))
    'a log of trainlog'
    >>> no_recording(Path("sample_logs/gnss.csv"))
    ''
    """
    suffix = file.suffix.lower()
    if file.is_dir():
        return "a trip as Parquet"
    if suffix in DOCUMENTS:
        return f"its name ends in {suffix}"
    try:
        head = head_of(file)
        refuse_workbook(head, file)
    except InputError as error:
        return "" if suffix in RECORDED else f"{error.problem}; {error.remedy}"
    name = next((item.name for item in formats().values() if item.recognises(head)), "")
    if name == "mcap":
        with suppress(LogError):
            if describe(file).schema_version is not None:
                return "a log of trainlog"
    if name == "csv" and suffix not in (".csv", ".tsv") and not looks_like_table(head):
        return "text without a table"
    return "" if name or suffix in RECORDED else "of no format that trainlog knows"


@dataclass
class _Made:
    """A log in the output folder that ingest made, and how."""

    log: Path
    trip: Trip
    step: dict[str, Any]
    whole: bool

    @property
    def recording(self) -> str:
        """Its name, where the file holds several."""
        return str(self.step.get("recording", ""))

    @property
    def recorded(self) -> dict[str, str]:
        """SHA-256 of the recorded files by name."""
        inputs = self.step.get("inputs", {})
        return {name: digest for name, digest in inputs.items() if name not in _ATTACHED}

    def is_of(self, mark: dict[str, Any], file: Path) -> bool:
        """Whether it is what this file would give; `mark` is its `fingerprint`."""
        given = dict(mark["inputs"])
        digest = given.pop(file.name)
        own = next((name for name, each in self.recorded.items() if each == digest), None)
        attached = {n: each for n, each in self.step["inputs"].items() if n in _ATTACHED}
        here = {key: self.step.get(key) for key in mark} | {"inputs": attached}
        if not self.whole or own is None or here != mark | {"inputs": given}:
            return False
        # A table of rides beside the fixes belongs to what was read.
        return all(
            (file.parent / name).is_file() and sha256_of(file.parent / name) == each
            for name, each in self.recorded.items()
            if name != own
        )


@dataclass
class _Batch:
    """The output folder, what it holds, and what was done so far."""

    output: Path
    given: Given
    files: list[Path]
    named: frozenset[Path]
    choose: Callable[[Path], str | Path | Profile | None] | None = None
    finish: Callable[[Trip], Trip] | None = None

    def __post_init__(self) -> None:
        self._names = distinct_names(self.files)
        self._taken: dict[Path, Path] = {}
        self._read_with: dict[Path, Path] = {}
        logs = map(_made, sorted(self.output.glob("*.mcap")))
        self._by_log = {made.log: made for made in logs if made is not None}

    def make(self, file: Path) -> Iterator[Outcome]:
        """Make the logs of a file, and say what became of each of its recordings."""
        other = self._read_with.get(file.resolve())
        if other is not None:
            yield Outcome(file, "passed_over", reason=f"read with {other}")
            return
        try:
            yield from self._made_of(file)
        except NoRecordingError as error:
            in_folder = file.resolve() not in self.named
            yield Outcome(file, "passed_over" if in_folder else "refused", reason=str(error))
        except TrainlogError as error:
            yield Outcome(file, "refused", reason=str(error))
        except OSError as error:
            reason = f"{file}: {(error.strerror or str(error)).lower()}"
            yield Outcome(file, "refused", reason=reason)
        except Exception as error:  # noqa: BLE001  (a defect of a reader must not stop the others)
            reason = f"{file}: could not be read ({type(error).__name__}: {error})"
            yield Outcome(file, "refused", reason=f"{reason}; report this as a defect")

    def _made_of(self, file: Path) -> Iterator[Outcome]:
        given = self.given
        if self.choose is not None and given.profile is None:
            given = replace(given, profile=self.choose(file))
        mark, digest = fingerprint(file, given), sha256_of(file)
        known = [each for each in self._by_log.values() if digest in each.recorded.values()]
        before = {
            each.recording: each for each in known if mark is not None and each.is_of(mark, file)
        }
        if before and len(before) == next(iter(before.values())).step.get("recordings", 1):
            yield from (self._unchanged(file, made) for made in before.values())
            return
        # Logs of the same content that a file of another name gave, however it was read.
        copies = [each for each in known if each.log.exists()]
        if copies and not before and not any(file.name in each.recorded for each in copies):
            for made in copies:
                first = next(iter(made.recorded), made.log.name)
                reason = (
                    f"of the same content as {first}, of which {made.log.name} is made; not made"
                    f" again (to make it anew in another way, give {first}; or another folder)"
                )
                yield self._kept(file, made, reason)
            return
        for name, outcome in ingested(file, given):
            if isinstance(outcome, TrainlogError):
                yield Outcome(file, "refused", name, reason=str(outcome))
            elif name in before:
                yield self._unchanged(file, before[name])
            else:
                yield self._written(file, name, digest, outcome)

    def _unchanged(self, file: Path, made: _Made) -> Outcome:
        first = self._taken.setdefault(made.log, file)
        same = f"of the same content as {first}"
        return self._kept(file, made, STATES["unchanged"] if first == file else same)

    def _kept(self, file: Path, made: _Made, reason: str) -> Outcome:
        self._note_inputs(file, made.recorded)
        report, known = report_of(made.trip), made.trip.metadata
        return Outcome(file, "unchanged", made.recording, made.log, reason, report, known)

    def _written(self, file: Path, name: str, digest: str, trip: Trip) -> Outcome:
        if self.finish is not None:
            note(f"estimating what the recorder of {file.name} lacks")
            trip = self.finish(trip)
        log = self._log(file, name, digest, trip)
        note(f"writing {log.name}")
        write_log(trip, log)
        self._taken[log] = file
        bare = Trip({}, trip.metadata, trip.provenance)
        made = _Made(log, bare, trip.provenance[0], whole=True)
        self._by_log[log] = made
        self._note_inputs(file, made.recorded)
        report = report_of(bare)
        state: State = "repaired" if report.counts else "made"
        return Outcome(file, state, name, log, "", report, trip.metadata, trip.duration)

    def _note_inputs(self, file: Path, recorded: Mapping[str, str]) -> None:
        """Files that were read with this one are not read again by themselves."""
        for name in recorded:
            beside = file.with_name(name)
            if beside.resolve() != file.resolve():
                self._read_with[beside.resolve()] = file

    def _log(self, file: Path, name: str, digest: str, trip: Trip) -> Path:
        """The log to write: none that holds anything else, and none of the recordings."""
        plain = re.sub(r"[^\w.+-]+", "_", name) if name else self._names[file]
        identity = identity_of(trip)
        ends = ["", f"-{digest[:8]}", *(f"-{digest[:8]}-{number}" for number in range(2, 1_000))]
        for log in (self.output / f"{plain}{end}.mcap" for end in ends):
            check_kept(self.files, log)
            held = self._by_log.get(log)
            again = held is not None and held.recording == name
            if again and held is not None and digest not in held.recorded.values():
                again = file.name in held.recorded and _grown(log, identity)
            if log not in self._taken and (again or not log.exists()):
                return log
        raise InputError(f"no name is left for {plain}", file=file, remedy="name another folder")


def _grown(log: Path, identity: TripIdentity | None) -> bool:
    """Whether a log holds the beginning of a drive that was recorded on."""
    before = identity_of_log(log)
    if before is None or identity is None or identity.samples < before.samples:
        return False
    # The last minute was not whole.
    both = np.intersect1d(before.blocks, identity.blocks).size
    return both > 0 and both >= before.blocks.size - 1


def _made(log: Path) -> _Made | None:
    """What ingest made; None of another log, and of one that something was added to."""
    try:
        trip = about_log(log)
    except TrainlogError:
        return None
    steps = [step for step in trip.provenance if step.get("step") != "read damaged log"]
    if [step.get("step") for step in steps] not in (["ingest"], ["ingest", "passport"]):
        return None
    return _Made(log, trip, steps[0], whole=len(steps) == len(trip.provenance))


def distinct_names(files: list[Path]) -> dict[Path, str]:
    """Names for what is made of files: their own, preceded by their folders' where needed.

    Examples
    --------
    >>> names = distinct_names([Path("may/1/run.csv"), Path("may/2/run.csv"), Path("may/day.csv")])
    >>> list(names.values())
    ['1_run', '2_run', 'day']
    """
    by_stem: dict[str, list[Path]] = {}
    for file in files:
        by_stem.setdefault(file.stem, []).append(file.absolute())
    found: dict[Path, str] = {}
    for file in files:
        own = file.absolute()
        others = [one for one in by_stem[file.stem] if one.parent != own.parent]
        depth, most = 0, len(own.parts) - 2
        while depth < most and any(_folders(one, depth) == _folders(own, depth) for one in others):
            depth += 1
        found[file] = "_".join((*_folders(own, depth), file.stem))
    return found


def _folders(file: Path, depth: int) -> tuple[str, ...]:
    """The innermost folders of a file, so many of them."""
    parts = file.parent.parts[1:]
    return parts[len(parts) - depth :] if depth < len(parts) else parts
