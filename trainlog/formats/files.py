"""Files on disk: written whole or not at all, read with errors that name the place."""

from __future__ import annotations

import errno
import hashlib
import json
import os
import re
import secrets
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NoReturn

from trainlog.errors import InputError
from trainlog.formats.mistaken import LOOKED_AT, mistaken_json

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
    """
    target = Path(os.path.realpath(path))
    if target.exists() and not target.is_file():
        raise InputError("exists and is not a file", file=path, remedy="choose another name")
    temporary = target.with_name(f".{target.stem}-{secrets.token_hex(4)}{target.suffix}")
    try:
        temporary.touch(exist_ok=False)
    except OSError as error:
        _refuse_writing(path, error)
    try:
        yield temporary
        if sync:
            _flush_to_disk(temporary)
        temporary.replace(target)
    except OSError as error:
        temporary.unlink(missing_ok=True)
        # An error about another file, say an input, is not ours to explain.
        about = {None, str(temporary), str(target)}
        if error.errno in _REMEDIES and error.filename in about:
            _refuse_writing(path, error)
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
        _refuse_writing(path, error)
    try:
        yield temporary
        for file in temporary.rglob("*"):
            if file.is_file():
                _flush_to_disk(file)
        if target.exists():
            target.rename(older)
        temporary.rename(target)
    except OSError as error:
        if error.errno in _REMEDIES and str(error.filename or temporary).startswith(str(temporary)):
            _refuse_writing(path, error)
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


def read_bytes(path: str | Path) -> bytes:
    """The content of a file.

    Raises
    ------
    InputError
        If it is missing, a folder, or may not be read.
    """
    try:
        return Path(path).read_bytes()
    except OSError as error:
        refuse_reading(path, error)


def made_folder(path: str | os.PathLike[str]) -> Path:
    """A folder to write to, made if need be.

    Raises
    ------
    InputError
        If it cannot be made.
    """
    made = Path(path)
    try:
        made.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"cannot be made: {(error.strerror or str(error)).lower()}",
            file=made,
            remedy="choose another folder",
        ) from error
    return made


def sha256(data: bytes) -> str:
    """SHA-256 of `data`, as 64 hexadecimal digits."""
    return hashlib.sha256(data).hexdigest()


def sha256_of(path: str | Path) -> str:
    """SHA-256 of a file's content, as 64 hexadecimal digits; errors as `read_bytes`."""
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
    """
    try:
        text = data.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        found = mistaken_json(data[:LOOKED_AT])
        problem = "is not UTF-8 text" if found is None else f"is not JSON but {found}"
        raise InputError(
            problem, file=file, place=f"byte {error.start}", remedy="expected JSON"
        ) from error
    if not text.strip():
        raise InputError("is empty", file=file, remedy="expected JSON")
    try:
        return json.loads(text, parse_constant=_refuse_constant, object_pairs_hook=_object)
    except json.JSONDecodeError as error:
        ends = error.pos >= len(text.rstrip())
        raise InputError(
            "the file ends in the middle: truncated?" if ends else f"is not JSON: {error.msg}",
            file=file,
            place=f"line {error.lineno}, column {error.colno}",
            remedy="copy the file again" if ends else "correct it there or just before",
        ) from error
    except InputError as error:
        place = error.place or _constant_place(text)
        raise InputError(error.problem, file=file, place=place, remedy=error.remedy) from error
    except RecursionError as error:
        raise InputError("is nested too deeply", file=file, remedy="expected JSON") from error


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


def _refuse_writing(path: str | Path, error: OSError) -> NoReturn:
    raise writing_error(path, error) from error


def writing_error(path: str | Path, error: OSError) -> InputError:
    """The error that says why a file cannot be written, and what to do about it."""
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
