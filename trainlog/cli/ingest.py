"""The command that turns recordings into trips, and the profiles that it proposes."""

from __future__ import annotations

import shlex
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

import trainlog
from trainlog.cli.options import Written, line_or_network, pairs
from trainlog.cli.terminal import (
    about,
    console,
    current,
    paused,
    print_error,
    say,
    show,
    state,
    wrote,
)
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.processes import handled
from trainlog.progress import task
from trainlog.units import KMH, TIME, lasted

if TYPE_CHECKING:
    from trainlog.formats.sfera import SferaJourney
    from trainlog.ingest import Ingested, Proposal
    from trainlog.ingest.live import LiveIngest
    from trainlog.ingest.sources import Source
    from trainlog.mcap import Recording
    from trainlog.railway.line import Line
    from trainlog.railway.train import Train


def ingest(
    recordings: list[Path],
    /,
    *,
    output: Path,
    profile: Path | None = None,
    format: str | None = None,
    line: Path | None = None,
    network: Path | None = None,
    stations: str | None = None,
    train: Path | None = None,
    reverse: bool = False,
    set_: list[str] | None = None,
    accept: Annotated[bool, typer.Option("--accept", "--yes")] = False,
) -> None:
    """Convert recordings to trips; repairs are counted and kept in the log.

    A log has the name of its file or, if the file has several recordings, of its trip. One refused
    file does not stop the others; a table at the end lists the state of each. Unchanged recordings
    are not converted again.

    If no profile fits a table, one is proposed: a commented TOML file in the output folder. Check
    it, correct it and give it with [bold]--profile[/bold], or use it at once with
    [bold]--accept[/bold].

    With [bold]--network[/bold] each recording is matched to its route, and divided where the train
    turned back or left the network; an ambiguous route is refused.

    Exit status 0: every recording is a trip; 1: some are not, or a profile is proposed; 2: the only
    file given is not, or an option is not valid.

    Example: trainlog ingest recorder.csv --profile recorder.profile.toml -o results/recorded

    Parameters
    ----------
    recordings : RECORDINGS
        Recorded files, and folders of them: docs/ingest.md lists formats.
    output : FOLDER
        Folder for the logs.
    profile : FILE
        TOML profile: columns, units, signs, time format.
    format : FORMAT
        Name of the format, such as csv; default: detected.
    line : FILE
        Line of the trip, if known; or a network, as --network.
    network : FILE
        Network of the trip: fixes determine the route.
    stations : STATIONS
        With --network: stations of the route, separated by commas, or edge@km.
    train : FILE
        Train of the trip, if known.
    reverse
        All trips ran against the line's chainage; default: by the fixes of each, else by its stops
        and gradients.
    set_ : KEY=VALUE
        Facts that the file does not state, for all its trips: weather=wet, load=12000 (kg) or 12t,
        start_position=0.2km, or =stations: by the stops.
    accept
        Use the proposed profile if none fits.
    """
    from analysis.resistance.passport import with_estimated_passport
    from trainlog.ingest import Ingested, Outcome, ingest_all

    alone = len(recordings) == 1 and not recordings[0].is_dir()
    found: list[Outcome] = []
    the_train = None if train is None else trainlog.read_train(train)
    as_json = current().as_json
    the_line, routes = line_or_network(line, network, stations)
    options = {
        "--format": format,
        "--line": line,
        "--network": network,
        "--stations": stations,
        "--train": train,
    }
    pairs_given = [(option, str(each)) for option, each in options.items() if each is not None]
    pairs_given += [("--set", fact) for fact in set_ or []]
    given = [*(word for pair in pairs_given for word in pair), *["--reverse"] * reverse]
    proposals = Proposals(output, the_train, format, the_line, accept, as_json, given, recordings)
    try:
        result = ingest_all(
            recordings,
            output,
            profile,
            format=format,
            line=the_line,
            train=the_train,
            direction="reverse" if reverse else None,
            metadata=pairs(set_ or []),
            network=routes,
            each=lambda outcome, done, total: found.append(outcome),  # noqa: ARG005
            choose=proposals.profile_for,
            finish=with_estimated_passport if (line or network) and train else None,
        )
    except KeyboardInterrupt:
        _print_ingested(Ingested(output, tuple(found)), alone=False)
        raise
    if alone and not as_json and [each.state for each in found] == ["refused"]:
        if proposals.waiting:
            print_error(found[0].reason)
            raise typer.Exit(1)
        raise InputError(found[0].reason)
    _print_ingested(result, alone=alone)
    if result.failed:
        raise typer.Exit(1)


def _print_ingested(result: Ingested, *, alone: bool) -> None:
    """Print what became of the recordings: of a single file with its report, else as a table."""
    if state(result.details()):
        return
    if not alone:
        show(result)
        return
    shown: set[str] = set()
    for each in result.of("made", "repaired", "unchanged"):
        assert each.log is not None
        assert each.report is not None
        if each.state == "unchanged":
            console.print(f"  {each.metadata['trip']}: {each.reason}")
            say(f"kept {each.log}")
            continue
        console.print(about(each.metadata, each.duration))
        route = f"route {each.metadata.get('line')}: "
        for what, words in {"direction": "direction ", "route": route, "motion": ""}.items():
            if f"{what}_evidence" in each.metadata:
                say(f"    {words}{each.metadata[f'{what}_evidence']}")
        lines = [line for line in each.report.lines() if line not in shown]
        console.print(*(f"    {line}" for line in lines), sep="\n")
        # What the file holds besides its trips is shown with the first of them.
        shown.update(line for line in lines if line.startswith("not used: "))
        wrote(each.log)
    for each in result.of("refused"):
        print_error(each.reason)
    if len(result.outcomes) > 1:
        console.print(result.sentence)


@dataclass
class Proposals:
    """The profiles that are proposed while files are ingested, one for each layout.

    Attributes
    ----------
    output : Path
        Folder that they are written to.
    train : Train, optional
        Whose mass the efforts must accelerate.
    format : str, optional
        Name of the format that the user gives.
    line : Line, optional
        On whose stations the trips are put where their counter starts elsewhere.
    accept : bool
        Whether they are used without asking.
    quiet : bool
        Nothing is shown, nobody is asked.
    given : list of str
        What the user gave besides files, profile and folder.
    recordings : list of Path
        Files and folders that the user gave.
    made : list of (Proposal, Path, bool)
        Each with its file, and whether the user agreed.
    """

    output: Path
    train: Train | None
    format: str | None
    line: Line | None
    accept: bool
    quiet: bool
    given: list[str] = field(default_factory=list)
    recordings: list[Path] = field(default_factory=list)
    made: list[tuple[Proposal, Path, bool]] = field(default_factory=list)

    @property
    def waiting(self) -> bool:
        """Whether a proposal waits for the user's agreement."""
        return any(not agreed for _, _, agreed in self.made)

    def profile_for(self, file: Path) -> Path | None:
        """The profile to read a file with; None where it needs none.

        Raises
        ------
        InputError
            If the file is no recording of a trip, or the user has not agreed to the proposal.
        """
        from trainlog.ingest import needs_profile, propose_profile

        if not needs_profile(file, self.format):
            return None
        for proposal, path, agreed in self.made:
            if proposal.fits(file):
                return self._used(file, path, agreed)
        proposal = propose_profile(file, self.train, self.line)
        path = self._written(proposal)
        agreed = self.accept or self._asked(proposal, path)
        self.made.append((proposal, path, agreed))
        return self._used(file, path, agreed)

    def _written(self, proposal: Proposal) -> Path:
        """Write a proposal; a profile that the user may have corrected stays as it is."""
        from trainlog.formats.files import write_bytes

        stem, data = proposal.path.stem, proposal.text.encode()
        path = self.output / f"{stem}.profile.toml"
        number = 2
        while path.exists() and path.read_bytes() != data:
            path = self.output / f"{stem}-{number}.profile.toml"
            number += 1
        write_bytes(path, data)
        if not self.quiet:
            console.print(f"{proposal.path}: no profile fits, this one is proposed:")
            for line in proposal.lines():
                say(f"  {line}")
            wrote(path)
        return path

    def _asked(self, proposal: Proposal, path: Path) -> bool:
        """Whether the user, at a terminal, agrees."""
        if self.quiet or not _at_terminal():
            return False
        with paused():
            return typer.confirm(f"Ingest {proposal.path.name} with {path}?", default=False)

    def _used(self, file: Path, path: Path, agreed: bool) -> Path:
        if agreed:
            return path
        first = next(proposal.path for proposal, made, _ in self.made if made == path)
        files = self.recordings if len(self.made) == 1 else [file]
        words = ["ingest", *map(str, files or [file]), "--profile", str(path)]
        words += ["-o", str(self.output), *self.given]
        remedy = f"check it, then: trainlog {shlex.join(words)}"
        raise InputError(
            f"no profile fits; one is proposed in {path}",
            file=file,
            remedy=remedy if first == file else f"as for {first}",
        )


def _at_terminal() -> bool:
    """Whether a user can be asked."""
    return console.is_terminal and sys.stdin.isatty()


PORT = "5005"
"""Where datagrams are expected by default."""


def record(
    address: str | None = None,
    /,
    *,
    output: Annotated[Path, Written(".mcap")],
    from_: Literal["udp", "mqtt", "stdin", "file"],
    profile: Path | None = None,
    header: Path | None = None,
    line: Path | None = None,
    train: Path | None = None,
    reverse: bool = False,
    set_: list[str] | None = None,
    sequence: str = "sequence",
    raw: Path | None = None,
    idle: Annotated[float | None, TIME.between(0.1)] = None,
    replay: bool = False,
) -> None:
    """Record a live source: UDP, MQTT, a pipe, or a growing file.

    Accepts JSON objects, rows of a table with a profile, NMEA sentences and UBX messages, also
    mixed; and status reports of SFERA. Without a profile JSON objects state a topic, a time, and
    fields in SI units: {"topic": "/train/state", "time": "2024-05-01T06:00:00.1Z", "speed": 21.3}.

    Ctrl-C (or SIGTERM) closes the log. After any other end the log is complete except for the last
    half second. Malformed and out-of-order data are counted, and listed in the events of the log.
    Rules of repair that need later data are not applied: keep the stream with [bold]--raw[/bold]
    and ingest it.

    Example: trainlog record --from udp 5005 -o today.mcap --profile recorder.profile.toml

    trainlog record --from file /var/log/gnss.nmea -o today.mcap --replay

    Parameters
    ----------
    output : FILE
        Log to write; must not exist.
    from_ : NAME
        Datagrams, messages of a broker, standard input, or a growing file.
    address : [ADDRESS|PATH]
        udp: PORT or HOST:PORT, default 127.0.0.1:5005, open to programs of this computer only;
        0.0.0.0:5005 listens on every network. mqtt: HOST[:PORT]/TOPIC, with the extra mqtt. file:
        its path.
    profile : FILE
        TOML profile: columns (or keys of JSON objects), units, time format.
    header : FILE
        File of this recorder with the header that the stream lacks.
    line : FILE
        Line of the trip, if known; or the journey of SFERA of the reporting train.
    train : FILE
        Train of the trip, if known.
    reverse
        The trip runs against the line's chainage.
    set_ : KEY=VALUE
        Facts that the stream does not state: weather=wet, load=12t.
    sequence : SEQUENCE
        Column or key with the sender's line number.
    raw : FILE
        Also write the unchanged stream to this file, which must not exist.
    idle : TIME
        End after this time of silence, once data have come; default: at Ctrl-C.
    replay
        Show the trip in the Rerun viewer while it is recorded.
    """
    from trainlog.ingest.live import LiveIngest, LiveOptions
    from trainlog.ingest.pipeline import Given

    source, journey = _source(from_, address), _journey(line)
    the_line, network = line_or_network(line) if journey is None else (journey.line, None)
    given = Given(
        profile,
        line=the_line,
        train=None if train is None else trainlog.read_train(train),
        direction="reverse" if reverse else None,
        metadata=pairs(set_ or []),
        network=network,
    )
    options = LiveOptions(source.name, header, sequence, journey)
    began = time.monotonic()
    with ExitStack() as stack, ending() as stopped:
        recording, live = LiveIngest.begun(output, given, options)
        stack.enter_context(recording)
        copy = None if raw is None else stack.enter_context(_raw(raw))
        drawing = _drawing(recording, stack) if replay else None
        step = stack.enter_context(task("recording", unit="line"))
        stack.enter_context(source)
        console.print(f"recording {source.name}; Ctrl-C ends it")

        def each() -> None:
            step(live.lines, note=_noted(live, source))

        live.follow(source, stopped=stopped, idle=idle, each=each, raw=copy)
        live.close(time.time_ns())
    _summary(output, recording, live, source, time.monotonic() - began, drawing)


def _source(origin: str, address: str | None) -> Source:
    from trainlog.ingest.sources import Datagrams, GrowingFile, Pipe, Subscription

    if origin == "udp":
        return Datagrams(address or PORT)
    if origin == "mqtt":
        return Subscription(address or "")
    if origin == "stdin":
        if address is not None:
            raise InputError(f"'{address}' goes with udp or file", remedy="leave it out")
        return Pipe()
    if address is None:
        raise InputError("--from file needs the path of the file", remedy="name it behind 'file'")
    return GrowingFile(address)


def _journey(line: Path | None) -> SferaJourney | None:
    """The journey of SFERA that is given in place of a line's file."""
    from trainlog.formats.sfera import is_source, read_journey

    return read_journey(line) if line is not None and is_source(line) else None


@contextmanager
def ending() -> Iterator[Callable[[], bool]]:
    """Ctrl-C and SIGTERM end a recording in place of this program."""
    asked = threading.Event()
    with handled(lambda *_: asked.set(), signal.SIGINT, signal.SIGTERM):
        yield asked.is_set


@contextmanager
def _raw(path: Path) -> Iterator[Any]:
    from trainlog.formats.files import writing_error

    try:
        file = path.open("xb", buffering=0)
    except FileExistsError as error:
        raise InputError("exists already", file=path, remedy="choose another name") from error
    except OSError as error:
        raise writing_error(path, error) from error
    with file:
        yield file


def _noted(live: LiveIngest, source: Source) -> str:
    """Where the train is, how fast, and what is wrong with what came."""
    progress, malformed = live.progress, sum(live.malformed.values())
    parts = [f"{progress.distance / 1e3:.3f} km"] if progress.time is not None else []
    parts += [f"{progress.speed * KMH:.1f} km/h"] if progress.speed is not None else []
    parts += [f"{malformed:,} malformed"] if malformed else []
    parts += [f"{source.lost:,} lost"] if source.lost else []
    return ", ".join(parts)


def _drawing(recording: Recording, stack: ExitStack) -> Any:

    drawing = stack.enter_context(trainlog.live_replay(recording))
    say(drawing.where)
    return drawing


def _summary(
    output: Path,
    recording: Recording,
    live: LiveIngest,
    source: Source,
    seconds: float,
    drawing: Any,
) -> None:
    """State what became of what came."""
    account = recording.account()
    found = {
        "log": output, "duration_s": seconds, "messages": account.written,
        "dropped": account.dropped, "lost": source.lost, "repeated": source.repeated,
        **live.details(),
    }  # fmt: skip
    total, what = sum(account.written.values()), "datagrams" if source.whole else "blocks"
    sentences = [
        *(f"{topic}  {count:,}" for topic, count in account.written.items()),
        *live.sentences(),
        *[f"{source.lost:,} {what} lost before they could be read"] * bool(source.lost),
        *[f"{source.repeated:,} messages that came twice left out"] * bool(source.repeated),
        *(f"{count:,} of {name} dropped" for name, count in account.dropped.items()),
        *([] if drawing is None else drawing.sentences()),
    ]
    if not state(found):
        console.print(
            f"  {counted(live.lines, 'line')} in {lasted(seconds)}: {total:,} messages of"
            f" {counted(len(account.written), 'topic')}, {live.progress.distance / 1e3:.3f} km"
        )
        for sentence in sentences:
            say(f"    {sentence}")
    wrote(output)
