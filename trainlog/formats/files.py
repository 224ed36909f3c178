"""Files on disk: written whole or not at all, read with errors that name the place."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Any, NoReturn

from trainlog.declaration import plain as plain, shortest as shortest
from trainlog.display import cell_of
from trainlog.errors import InputError, in_file

if TYPE_CHECKING:
    import pandas as pd

_REMEDIES = {
    errno.ENOENT: "create its folder first",
    errno.ENOTDIR: "create its folder first",
    errno.EACCES: "choose a folder you may write to, and close programs that hold the file open",
    errno.EPERM: "choose a folder you may write to",
    errno.EROFS: "choose a folder you may write to",
    errno.ENOSPC: "free some space on the disk and try again",
    errno.EDQUOT: "free some of your quota and try again",
    errno.EFBIG: "write to a file system that holds files of this size",
    errno.ENAMETOOLONG: "choose a shorter name",
}

_FILE_SUFFIXES = {
    ".csv", ".gpx", ".html", ".json", ".map", ".mcap", ".mf4", ".nmea", ".parquet", ".png", ".rrd",
    ".toml", ".txt",
}  # fmt: skip
"""Suffixes of files that trainlog reads or writes: no folder is made that has one of them."""


_noted: list[list[Path]] = []
"""Lists of files that took their place, one for each that asked for it."""


@contextmanager
def noting_files(files: list[Path]) -> Iterator[None]:
    """Append to `files` each file and folder that takes its place while the block runs.

    Examples
    --------
    >>> import tempfile
    >>> files = []
    >>> with tempfile.TemporaryDirectory() as folder, noting_files(files):
    ...     write_bytes(Path(folder) / "note.txt", b"whole")
    >>> [path.name for path in files]
    ['note.txt']
    """
    _noted.append(files)
    try:
        yield
    finally:
        _noted[:] = [each for each in _noted if each is not files]


def _note(path: str | Path) -> None:
    """State to those who asked that a file took its place."""
    for files in _noted:
        files.append(Path(path))


@contextmanager
def atomic_write(path: str | Path, *, sync: bool = True) -> Iterator[Path]:
    """Write a file whole or not at all.

    Yields a temporary path beside the target, with the target's suffix. When the block succeeds
    the temporary file takes the target's place; when it fails, also by interruption, the temporary
    file is removed and an older target stays as it was.

    Parameters
    ----------
    path : path
    sync : bool
        Whether to wait until the disk has the file before it takes its place, so that it is whole
        after a power cut too. Without, it is whole whatever becomes of this program.

    Raises
    ------
    InputError
        If the folder is missing or read-only, the disk is full, or the target is not a file.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_write(Path(folder) / "note.txt") as temporary:
    ...         _ = temporary.write_text("whole or not at all")
    ...     [path.name for path in Path(folder).iterdir()]
    ['note.txt']
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise InputError("exists and is not a file", file=path, remedy="choose another name")
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        raise writing_error(path, error) from error
    try:
        yield temporary
        if sync:
            _flush_to_disk(temporary)
        temporary.replace(target)
        _note(path)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        # An error about another file, such as an input, is passed on as it is.
        about = {None, str(temporary), str(target)}
        if error.errno in _REMEDIES and error.filename in about:
            raise writing_error(path, error) from error
        raise
    except BaseException:
        temporary.unlink(missing_ok=True)
        raise


@contextmanager
def atomic_folder(path: str | Path, marker: str) -> Iterator[Path]:
    """Write a folder of files whole or not at all.

    Yields a new folder beside the target. When the block succeeds it takes the target's place;
    when it fails it is removed and an older target stays as it was.

    Parameters
    ----------
    path : path
    marker : str
        File that makes a folder one of this kind: only such a folder, or none, is replaced.

    Raises
    ------
    InputError
        If something else is at the target, or the folder cannot be written.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     with atomic_folder(Path(folder) / "trip", marker="index.json") as temporary:
    ...         _ = (temporary / "index.json").write_text("{}")
    ...     [path.name for path in Path(folder, "trip").iterdir()]
    ['index.json']
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not (target / marker).is_file():
        raise InputError(
            f"exists and is not a folder with {marker} that could be replaced",
            file=path,
            remedy="choose another name",
        )
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    older = temporary.with_name(f"{temporary.name}.old")
    try:
        temporary.mkdir()
    except OSError as error:
        raise writing_error(path, error) from error
    try:
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                _flush_to_disk(file)
        if target.exists():
            target.rename(older)
        temporary.rename(target)
        _note(path)
    except OSError as error:
        if error.errno in _REMEDIES and str(error.filename or temporary).startswith(str(temporary)):
            raise writing_error(path, error) from error
        raise
    finally:
        if older.exists() and not target.exists():
            older.rename(target)
        shutil.rmtree(older, ignore_errors=True)
        shutil.rmtree(temporary, ignore_errors=True)


def write_bytes(path: str | Path, data: bytes) -> None:
    """Write `data` to `path`, whole or not at all; errors as `atomic_write`."""
    with atomic_write(path) as temporary:
        temporary.write_bytes(data)


def csv_bytes(frame: pd.DataFrame, **options: Any) -> bytes:
    r"""A table as CSV in UTF-8, without the index; no text in it is a spreadsheet's formula.

    Parameters
    ----------
    frame : DataFrame
    **options
        Of `DataFrame.to_csv`.

    Examples
    --------
    >>> import pandas as pd
    >>> csv_bytes(pd.DataFrame({"trip": ["=1+1", "-"], "off": ["-2.5", 1]}))
    b"trip,off\n'=1+1,-2.5\n'-,1\n"
    """
    shown = frame.rename(columns=cell_of)
    for number, kind in enumerate(frame.dtypes):
        if kind.kind == "O":
            shown.isetitem(number, [cell_of(each) for each in frame.iloc[:, number]])
    return str(shown.to_csv(index=False, lineterminator="\n", **options)).encode()


def read_bytes(path: str | Path, *, any_kind: bool = False) -> bytes:
    """The content of a file.

    Parameters
    ----------
    path : path
    any_kind : bool
        Whether it may be a workbook, as an attachment of a trip may.

    Raises
    ------
    InputError
        If it is missing, a folder, a workbook of a spreadsheet program, or may not be read.
    """
    try:
        data = Path(path).read_bytes()
    except OSError as error:
        refuse_reading(path, error)
    if not any_kind:
        refuse_workbook(data[:LOOKED_AT], path)
    return data


def refuse_workbook(start: bytes, file: str | Path) -> None:
    """Refuse a file that begins as a workbook of Excel or another spreadsheet program.

    Raises
    ------
    InputError

    Examples
    --------
    >>> refuse_workbook(b"PK....[Content_Types].xml", "curve.xlsx")
    Traceback (most recent call last):
    trainlog.errors.InputError: curve.xlsx: is a workbook, not text; save its sheet as CSV
    """
    if _is_workbook(start):
        raise InputError("is a workbook, not text", file=file, remedy="save its sheet as CSV")


def _is_workbook(start: bytes) -> bool:
    parts = (b"[Content_Types].xml", b"docProps/", b"xl/", b"opendocument.spreadsheet")
    return start.startswith(b"\xd0\xcf\x11\xe0") or (
        start.startswith(b"PK") and any(part in start for part in parts)
    )


def logs_below(folder: Path) -> list[Path]:
    """The logs of a folder and the folders in it, however deep; hidden ones are passed over."""
    every = (log for log in folder.rglob("*.mcap") if log.is_file())
    return sorted(
        log for log in every if not any(s.startswith(".") for s in log.relative_to(folder).parts)
    )


def logs_of(path: Path) -> list[Path]:
    """The logs of a folder in order of name; a file stands for itself.

    Where the folder itself holds none, those in the folders below it, however deep, are found.

    Raises
    ------
    InputError
        If the folder holds no log.
    """
    found = (sorted(path.glob("*.mcap")) or logs_below(path)) if path.is_dir() else [path]
    if not found:
        raise InputError(
            "the folder has no logs (*.mcap)",
            file=path,
            remedy="name another folder, or make logs of recordings with 'trainlog ingest'",
        )
    return found


def check_kind(value: object, *kinds: type, remedy: str | None = None) -> None:
    """Refuse what is given where something of another kind is expected.

    Raises
    ------
    InputError
        If `value` is of none of the `kinds`; names what was given.

    Examples
    --------
    >>> check_kind(3, str, Path)
    Traceback (most recent call last):
    trainlog.errors.InputError: 3 (int) was given where a str or Path is expected
    """
    if isinstance(value, kinds):
        return
    shown = repr(value) if isinstance(value, str | int | float | Path) or value is None else ""
    expected = " or ".join(kind.__name__ for kind in kinds)
    named = f"{shown[:80]} ({type(value).__name__})" if shown else f"a {type(value).__name__}"
    raise InputError(f"{named} was given where a {expected} is expected", remedy=remedy)


def check_written(value: object, kind: type) -> None:
    """Refuse to write what is not of the kind that a file holds.

    Raises
    ------
    InputError
        If it is not.
    """
    check_kind(value, kind, remedy=f"give the {kind.__name__} first, then the path")


def check_kept(inputs: Iterable[Path], output: Path) -> None:
    """Refuse an output that is one of the inputs, under whatever name.

    Raises
    ------
    InputError
        If it is; names the input.
    """
    for path in inputs:
        if output.exists() and path.exists() and output.samefile(path):
            raise InputError("would be overwritten", file=path, remedy="name another output")


def made_folder(path: str | os.PathLike[str]) -> Path:
    """A folder to write to, made if need be.

    Raises
    ------
    InputError
        If it cannot be made, or its name is that of a file.
    """
    made = Path(path)
    suffix = made.suffix or made.name
    if suffix.lower() in _FILE_SUFFIXES and not made.is_dir():
        raise InputError(
            f"is the name of a {suffix} file, and a folder is needed",
            file=made,
            remedy=f"name a folder, such as {made.with_name(made.stem.lstrip('.'))}",
        )
    try:
        made.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot be made: {(error.strerror or str(error)).lower()}",
            file=made,
            remedy="choose another folder",
        ) from error
    return made


@contextmanager
def output_folder(path: str | os.PathLike[str]) -> Iterator[Path]:
    """A folder to write several files to, made if need be; nothing is left of it if none came.

    Raises
    ------
    InputError
        As `made_folder`.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as results:
    ...     with output_folder(Path(results) / "trips") as folder:
    ...         pass  # nothing is written
    ...     folder.exists()
    False
    """
    wanted = Path(path)
    missing = [folder for folder in (wanted, *wanted.parents) if not folder.exists()]
    try:
        yield made_folder(wanted)
    finally:
        for folder in missing:
            # Fails if something is in it: then it stays.
            with suppress(OSError):
                folder.rmdir()


def sha256(data: bytes) -> str:
    """SHA-256 of `data`, as 64 hexadecimal digits.

    Examples
    --------
    >>> sha256(b"trainlog")[:16]
    '225659941706fabe'
    """
    return hashlib.sha256(data).hexdigest()


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's content, as 64 hexadecimal digits; errors as `read_bytes`.

    Examples
    --------
    >>> path = "sample_logs/gnss.csv"
    >>> sha256_of(path) == sha256(read_bytes(path))
    True
    """
    try:
        with Path(path).open("rb") as stream:
            return hashlib.file_digest(stream, "sha256").hexdigest()
    except OSError as error:
        refuse_reading(path, error)


def read_json(path: str | Path) -> Any:
    """The value that a JSON file holds; errors as `read_bytes` and `parse_json`."""
    return parse_json(read_bytes(path), file=path)


def parse_json(data: bytes, *, file: str | Path) -> Any:
    """The value that the bytes of a JSON file hold.

    Stricter than the standard library where that would hide a mistake: a key that comes twice in
    one object, and NaN or Infinity, which JSON does not have, are refused.

    Parameters
    ----------
    data : bytes
    file : path
        What to call the file in errors.

    Raises
    ------
    InputError
        With line and column where the text ceases to be JSON.

    Examples
    --------
    >>> parse_json(b'{"a": 1, "a": 2}', file="x.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: x.json, a: comes twice in one object; remove one of them
    """
    with in_file(file):
        try:
            text = data.decode("utf-8-sig")
        except UnicodeDecodeError as error:
            place = f"byte {error.start}"
            if error.reason == "unexpected end of data":
                raise _truncated(place) from error
            found = mistaken_json(data[:LOOKED_AT])
            problem = "is not UTF-8 text" if found is None else f"is not JSON but {found}"
            raise InputError(problem, place=place, remedy="expected JSON") from error
        if not text.strip():
            raise InputError("is empty", remedy="expected JSON")
        try:
            return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_object)
        except json.JSONDecodeError as error:
            place = f"line {error.lineno}, column {error.colno}"
            if _ends_in_the_middle(error):
                raise _truncated(place) from error
            remedy = "correct it there or just before"
            raise InputError(f"is not JSON: {error.msg}", place=place, remedy=remedy) from error
        except InputError as error:
            place = error.place or _constant_place(text)
            raise InputError(error.problem, place=place, remedy=error.remedy) from error
        except (RecursionError, ValueError) as error:
            raise too_large(error, "JSON") from error


def too_large(error: Exception, kind: str) -> InputError:
    """The refusal of a text that Python's parser gives up: nested too deeply, or a huge number."""
    deep = isinstance(error, RecursionError)
    problem = "is nested too deeply" if deep else "holds a number of thousands of digits"
    return InputError(problem, remedy=f"expected {kind} of one of trainlog's files")


def _truncated(place: str) -> InputError:
    problem = "the file ends in the middle: truncated?"
    return InputError(problem, place=place, remedy="copy the file again")


def _ends_in_the_middle(error: json.JSONDecodeError) -> bool:
    """Whether the text ceases to be JSON because it ends: in a string, a word, or between two."""
    if error.msg.startswith("Unterminated string"):
        return True
    rest = error.doc[error.pos :].rstrip()
    return error.msg != "Extra data" and re.fullmatch(r"[\w.+\\-]*", rest) is not None


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    found = dict(pairs)
    if len(found) < len(pairs):
        names = [name for name, _ in pairs]
        twice = next(name for name in names if names.count(name) > 1)
        raise InputError("comes twice in one object", place=twice, remedy="remove one of them")
    return found


def _refuse_constant(name: str) -> NoReturn:
    raise InputError(f"{name} is not a JSON number", remedy="give a finite number, or leave it out")


def _constant_place(text: str) -> str:
    """Where the first NaN or Infinity stands that is not part of a string."""
    found = (m for m in re.finditer(r'"(?:\\.|[^"\\])*"|NaN|-?Infinity', text) if m[0][0] != '"')
    start = next(found).start()
    return (
        f"line {text.count(chr(10), 0, start) + 1}, column {start - text.rfind(chr(10), 0, start)}"
    )


def _flush_to_disk(path: Path) -> None:
    with path.open("rb+") as stream:
        os.fsync(stream.fileno())


def writing_error(path: str | Path, error: OSError) -> InputError:
    """The error that states why a file cannot be written, and what to do about it."""
    reason = (error.strerror or str(error)).lower()
    if not Path(path).absolute().parent.is_dir():
        reason = "its folder does not exist"
    remedy = _REMEDIES.get(error.errno or 0, "choose another place")
    return InputError(f"cannot be written: {reason}", file=path, remedy=remedy)


def refuse_reading(path: str | Path, error: OSError) -> NoReturn:
    """Raise the InputError for a file that the operating system does not let us read."""
    if isinstance(error, FileNotFoundError):
        raise InputError("does not exist", file=path, remedy="check the path") from error
    if Path(path).is_dir():
        raise InputError("is a folder", file=path, remedy="name a file in it") from error
    reason = (error.strerror or str(error)).lower()
    raise InputError(f"cannot be read: {reason}", file=path, remedy="check the path") from error


_WIDTH = 96
"""Longest line of a small object [characters]; rows of tables may be longer."""


def to_bytes(value: Any) -> bytes:
    """Lay out a value as JSON: the same value gives the same bytes.

    Lists of plain values stand on one line, lists of lists one row a line, small objects on one
    line. Floats are written with the fewest digits that read back as the same double.

    Raises
    ------
    InputError
        If the value holds NaN, infinity or something JSON has no word for; names the key.

    Examples
    --------
    >>> print(to_bytes({"unit": "m", "values": [[0.0, 1.5], [2, 3]]}).decode(), end="")
    {
      "unit": "m",
      "values": [
        [0.0, 1.5],
        [2, 3]
      ]
    }
    """
    return ("".join(_pieces(value, 0)) + "\n").encode()


def _pieces(value: Any, depth: int) -> Iterator[str]:
    flat = _one_line(value)
    if flat is not None:
        yield flat
        return
    inner = "  " * (depth + 1)
    opening, closing = "{}" if isinstance(value, dict) else "[]"
    items = value.items() if isinstance(value, dict) else ((None, item) for item in value)
    separator = opening
    for key, item in items:
        yield f"{separator}\n{inner}"
        if key is not None:
            yield f"{_text(key)}: "
        yield from _pieces(item, depth + 1)
        separator = ","
    yield f"\n{'  ' * depth}{closing}"


def _one_line(value: Any) -> str | None:
    """`value` on one line, or None if it should be broken up."""
    if isinstance(value, dict):
        parts = [_one_line(item) for item in value.values()]
        if any(part is None or part.startswith(("[", "{")) for part in parts):
            return None if value else "{}"
        text = ", ".join(f"{_text(key)}: {part}" for key, part in zip(value, parts, strict=True))
        return f"{{{text}}}" if len(text) <= _WIDTH else None
    if isinstance(value, list):
        if any(isinstance(item, dict | list) for item in value):
            return None
        return f"[{', '.join(map(_text, value))}]"
    return _text(value)


def _text(value: Any) -> str:
    return json.dumps(value, ensure_ascii=False, allow_nan=False)


HEAD = 65_536
"""So many bytes of a file are read to find out which format it has."""


def head_of(path: Path) -> bytes:
    """What a file begins with; InputError if it is empty or cannot be read."""
    head = beginning(path, HEAD)
    if not head:
        raise InputError("is empty", file=path, remedy="was the recorder stopped at once?")
    return head


LOOKED_AT = 4096
"""So many bytes from the beginning show what a file is."""

_INGEST = "'trainlog ingest' makes logs of recordings"
_UNPACK = "unpack it first"
_BAG = "'mcap convert', of the MCAP project, makes an MCAP file of it"

_BEGINNINGS = (
    (
        b"PAR1",
        "a Parquet file",
        "'trainlog convert FOLDER.parquet -o trip.mcap' makes a log of a converted one, "
        "'trainlog ingest' of a recording; summaries of a fit are for 'trainlog fit'",
    ),
    (
        b"RRF",
        "a recording of the Rerun viewer",
        "'rerun FILE' opens it; 'trainlog replay' takes the logs that it shows",
    ),
    (b"#ROSBAG", "a bag of ROS 1", _BAG),
    (b"SQLite format 3", "an SQLite database, as bags of ROS 2 are", _BAG),
    (b"MDF ", "an MDF file", _INGEST),
    (b"\x1f\x8b", "compressed with gzip", _UNPACK),
    (b"\x28\xb5\x2f\xfd", "compressed with zstd", _UNPACK),
    (b"PK\x03\x04", "a ZIP archive", _UNPACK),
    (b"\x89PNG", "a picture", "give the log that it shows"),
)
_MCAP = b"\x89MCAP"
_FORMAT = re.compile(rb"""["']?format["']?\s*[:=]\s*["'](trainlog/[a-z_-]{1,40})["']""")


def beginning(path: Path, most: int = LOOKED_AT) -> bytes:
    """The first bytes of a file, by which it is recognised.

    Raises
    ------
    InputError
        If it cannot be read.
    """
    try:
        with path.open("rb") as file:
            return file.read(most)
    except OSError as error:
        refuse_reading(path, error)


def stated_format(start: bytes) -> str:
    """How a file of trainlog names its format, in JSON or TOML; empty without.

    Examples
    --------
    >>> stated_format(b'{"format": "trainlog/line", "version": 1')
    'trainlog/line'
    """
    found = _FORMAT.search(start)
    return found[1].decode() if found else ""


def mistaken_log(start: bytes) -> tuple[str, str]:
    """What a file is that was given for a log and is none, and the remedy.

    Parameters
    ----------
    start : bytes
        The beginning of a file that is no MCAP file; `LOOKED_AT` bytes are enough.

    Returns
    -------
    tuple of str
        What is wrong and the remedy, for a `LogError`.

    Examples
    --------
    >>> mistaken_log(b"#ROSBAG V2.0")[0]
    'is not an MCAP file but a bag of ROS 1'
    """
    if not start:
        return "is empty", "give another log; was the recorder stopped at once?"
    if is_map(start):
        return "is not an MCAP file but a track-condition map", "'trainlog map show' shows it"
    if _is_workbook(start):
        return "is not an MCAP file but a workbook", f"save its sheet as CSV; {_INGEST}"
    for beginning, what, remedy in _BEGINNINGS:
        if start.startswith(beginning):
            return f"is not an MCAP file but {what}", remedy
    if start.lstrip(b"\xef\xbb\xbf \t\r\n")[:1] in (b"{", b"["):
        ours = _FORMAT.search(start)
        what = f"a {ours[1].decode()} file" if ours else "a JSON file"
        remedy = "give the logs (.mcap) of the trips themselves" if ours else _INGEST
        return f"is not an MCAP file but {what}", remedy
    if _is_text(start):
        return "is not an MCAP file but text", _INGEST
    return "is not an MCAP file", "expected a log in the MCAP format"


def mistaken_json(start: bytes) -> str | None:
    """What a file is that was given for JSON, from its beginning; None if that does not show it."""
    if start.startswith(_MCAP):
        return "a log (MCAP)"
    if is_map(start):
        return "a track-condition map"
    return next((what for beginning, what, _ in _BEGINNINGS if start.startswith(beginning)), None)


_MAP = b"tlmp"
"""SQLite's application_id of a track-condition map."""


def is_map(start: bytes) -> bool:
    """Whether a file with this beginning is a track-condition map."""
    return start.startswith(b"SQLite format 3\0") and start[68:72] == _MAP


def refuse_map(path: Path, remedy: str) -> None:
    """Refuse a track-condition map where another file is expected.

    Raises
    ------
    InputError
    """
    if path.is_file() and is_map(beginning(path)):
        raise InputError("is a track-condition map", file=path, remedy=remedy)


def mistaken_map(start: bytes) -> tuple[str, str]:
    """What a file is that was given for a map and is none, from its beginning, and the remedy.

    Examples
    --------
    >>> mistaken_map(b'{"format": "trainlog/condition", "version": 1}')[0]
    'is a track-condition map of an earlier version (JSON)'
    """
    anew = "build the map anew from the logs: trainlog map update LOGS --map NAME.map"
    ours = _FORMAT.search(start)
    if not start:
        return "is empty", anew
    if ours and ours[1] == b"trainlog/condition":
        return "is a track-condition map of an earlier version (JSON)", anew
    found = f"a {ours[1].decode()} file" if ours else mistaken_json(start)
    what = f"is not a track-condition map but {found}" if found else "is not a track-condition map"
    return what, "name a map that 'trainlog map update' made"


def _is_text(start: bytes) -> bool:
    """Whether it is text in UTF-8, its last character cut, or in a code page of Windows."""
    try:
        words = start[: max(1, len(start) - 3)].decode()
    except UnicodeDecodeError as error:
        if error.start < len(start) - 8:
            # Most bytes are printed ASCII, and the others can be letters of cp1252.
            controls = any(byte < 0x20 and byte not in b"\t\r\n" for byte in start)
            letters = sum(byte >= 0x80 for byte in start) < 0.3 * len(start)
            return letters and not controls and 0x7F not in start
        words = start[: error.start].decode()
    return bool(words) and all(sign.isprintable() or sign in "\t\r\n" for sign in words)
