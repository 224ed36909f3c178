"""The command that records while the train runs."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import trainlog
from trainlog.cli.options import Written, line_or_network, pairs
from trainlog.cli.terminal import console, say, state, wrote
from trainlog.display import counted
from trainlog.errors import InputError
from trainlog.processes import handled
from trainlog.progress import task
from trainlog.units import KMH, TIME

if TYPE_CHECKING:
    from trainlog.ingest.live import LiveIngest
    from trainlog.ingest.sources import Source
    from trainlog.mcap import Recording

PORT = "5005"
"""Where datagrams are expected by default."""


def record(
    address: str | None = None,
    /,
    *,
    output: Annotated[Path, Written(".mcap")],
    from_: Literal["udp", "stdin", "file"],
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
    """Record what a recorder sends while the train runs: UDP, a pipe, or a file that grows.

    Taken are JSON objects, rows of a table that a profile describes, NMEA sentences and UBX
    messages, mixed. Without a profile JSON objects name a topic, its fields in SI units and their
    time: {"topic": "/train/state", "time": "2024-05-01T06:00:00.1Z", "speed": 21.3}.

    Ctrl-C (or SIGTERM) ends the log properly. A log is whole up to half a second before whatever
    ends this program otherwise. What is malformed or wrong in time is counted, and stands among the
    log's events; rules of repair that need what comes later are not applied: with
    [bold]--raw[/bold] the stream can be ingested again.

    Example: trainlog record --from udp 5005 -o today.mcap --profile recorder.profile.toml

    trainlog record --from file /var/log/gnss.nmea -o today.mcap --replay

    Parameters
    ----------
    output : FILE
        Log to write; must not exist.
    from_ : NAME
        Datagrams, standard input, or a file that grows.
    address : [ADDRESS|PATH]
        udp: PORT or HOST:PORT, default 127.0.0.1:5005, where only programs of this computer can
        send; 0.0.0.0:5005 listens on every network. file: its path.
    profile : FILE
        TOML profile: columns (or keys of JSON objects), units, time format.
    header : FILE
        File of this recorder with the header that the stream does not begin with.
    line : FILE
        Line it is driven on, if known.
    train : FILE
        Train that drives, if known.
    reverse
        The trip runs against the line's chainage.
    set_ : KEY=VALUE
        What the stream does not state: weather=wet, load=12t.
    sequence : SEQUENCE
        Column or key with which the sender counts its lines.
    raw : FILE
        Also write everything as it came to this file, which must not exist.
    idle : TIME
        End after this time of silence, once data have come; default: at Ctrl-C.
    replay
        Show the trip in the Rerun viewer as it is recorded.
    """
    from trainlog.ingest.live import LiveIngest, LiveOptions
    from trainlog.ingest.pipeline import Given

    source = _source(from_, address)
    the_line, network = line_or_network(line)
    given = Given(
        profile,
        line=the_line,
        train=None if train is None else trainlog.read_train(train),
        direction="reverse" if reverse else None,
        metadata=pairs(set_ or []),
        network=network,
    )
    options = LiveOptions(source.name, header, sequence)
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
    from trainlog.ingest.sources import Datagrams, GrowingFile, Pipe

    if origin == "udp":
        return Datagrams(address or PORT)
    if origin == "stdin":
        if address is not None:
            raise InputError(f"'{address}' goes with udp or file", remedy="leave it out")
        return Pipe()
    if address is None:
        raise InputError("--from file needs the path of the file", remedy="name it behind 'file'")
    return GrowingFile(address)


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
        "dropped": account.dropped, "lost": source.lost, **live.details(),
    }  # fmt: skip
    total, what = sum(account.written.values()), "datagrams" if source.whole else "blocks"
    sentences = [
        *(f"{topic}  {count:,}" for topic, count in account.written.items()),
        *live.sentences(),
        *[f"{source.lost:,} {what} lost before they could be read"] * bool(source.lost),
        *(f"{count:,} of {name} dropped" for name, count in account.dropped.items()),
        *([] if drawing is None else drawing.sentences()),
    ]
    if not state(found):
        console.print(
            f"  {counted(live.lines, 'line')} in {seconds:.1f} s: {total:,} messages of"
            f" {counted(len(account.written), 'topic')}, {live.progress.distance / 1e3:.3f} km"
        )
        for sentence in sentences:
            say(f"    {sentence}")
    wrote(output)
