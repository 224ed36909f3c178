"""The sample logs, line, train and map that come with trainlog."""

from __future__ import annotations

import os
from pathlib import Path

from trainlog.errors import InputError
from trainlog.formats.files import made_folder, read_bytes, write_bytes

DEFAULT_LINE = "CH_StGallen_Wil.line.json"
"""The line of the samples."""

DEFAULT_TRAIN = "CH_Stadler_FLIRT_TPF.train.json"
"""The train of the samples."""

SAMPLE = "sample"
"""Word that names the line or the train of the samples in place of a file."""

_PACKAGE = Path(__file__).resolve().parents[1]
_PLACES = (_PACKAGE / "sample_logs", _PACKAGE.parent / "sample_logs")


def folder() -> Path:
    """The folder of the samples: inside the installed package, or beside it in a checkout.

    Raises
    ------
    InputError
        If there is none.

    Examples
    --------
    >>> folder().name
    'sample_logs'
    """
    for place in _PLACES:
        if (place / DEFAULT_LINE).is_file():
            return place
    raise InputError(
        "the sample files are missing from this installation",
        file=_PLACES[0],
        remedy="install trainlog again, or name a line and a train",
    )


def sample(name: str) -> Path:
    """The path of the sample called `name`.

    Raises
    ------
    InputError
        If there is no such sample; lists those that there are.

    Examples
    --------
    >>> sample(DEFAULT_LINE).name
    'CH_StGallen_Wil.line.json'
    """
    path = folder() / name
    if not path.is_file():
        raise InputError(f"there is no sample '{name}'", remedy=f"there are {', '.join(names())}")
    return path


def file_or_sample(path: str | Path, name: str) -> str | Path:
    """The file that is given; for the word ``sample``, if no file is called so, the sample `name`.

    Examples
    --------
    >>> file_or_sample("sample", DEFAULT_TRAIN).name
    'CH_Stadler_FLIRT_TPF.train.json'
    >>> file_or_sample("my.train.json", DEFAULT_TRAIN)
    'my.train.json'
    """
    return sample(name) if str(path) == SAMPLE and not Path(path).is_file() else path


def names() -> list[str]:
    """Names of all samples, in alphabetical order.

    Examples
    --------
    >>> "nonstop.mcap" in names()
    True
    """
    return sorted(
        path.name
        for path in folder().iterdir()
        if path.is_file() and path.suffix != ".py" and not path.name.startswith(".")
    )


def copy_samples(output: str | os.PathLike[str]) -> list[Path]:
    """Copy all samples to the folder `output`, which is made if need be; the copies' paths.

    Raises
    ------
    InputError
        If the folder cannot be made or written to.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as target:
    ...     len(copy_samples(target)) == len(names())
    True
    """
    target = made_folder(output)
    for name in names():
        write_bytes(target / name, read_bytes(sample(name)))
    return [target / name for name in names()]
