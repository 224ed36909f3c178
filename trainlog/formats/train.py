"""The files of trains and consists, ``"trainlog/train"`` and ``"trainlog/consist"``.

Their keys follow from the declarations of `Train` and `Consist`; docs/formats.md describes them.
"""

from __future__ import annotations

from pathlib import Path

from trainlog.declaration import Column
from trainlog.formats.declared import (
    built,
    read_thing,
    thing_from_bytes,
    thing_to_bytes,
    write_thing,
)
from trainlog.formats.headed import read_headed
from trainlog.formats.samples import DEFAULT_TRAIN, file_or_sample
from trainlog.railway.consist import Consist
from trainlog.railway.effort import EffortCurve
from trainlog.railway.train import Train


def train_from_bytes(data: bytes, *, file: str | Path = "train.json") -> Train:
    """The train in the bytes of a train file; `file` is what errors call it."""
    return thing_from_bytes(Train, data, file)


def train_to_bytes(train: Train) -> bytes:
    """The bytes of the train's file: the same train gives the same bytes."""
    return thing_to_bytes(train)


def read_train(path: str | Path) -> Train:
    """Read a train file, JSON or TOML; errors as `read_thing`.

    Parameters
    ----------
    path : path
        Of a train file; or ``"sample"``: a Stadler FLIRT.

    Examples
    --------
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> train.name, train.mass
    ('CH_Stadler_FLIRT_TPF', 122000.0)
    """
    return read_thing(Train, file_or_sample(path, DEFAULT_TRAIN))


def write_train(train: Train, path: str | Path) -> None:
    """Write a train file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_train(train, Path(folder) / "copy.train.json")
    ...     read_train(Path(folder) / "copy.train.json") == train
    True
    """
    write_thing(train, path, Train)


def read_consist(path: str | Path) -> Consist:
    """Read a consist file, JSON or TOML; errors as `read_thing`.

    Examples
    --------
    >>> consist = read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> consist.name, len(consist.vehicles), len(consist.couplers)
    ('freight train, 24 wagons', 25, 24)
    """
    return read_thing(Consist, path)


def write_consist(consist: Consist, path: str | Path) -> None:
    """Write a consist file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> consist = read_consist("sample_logs/freight_24_wagons.consist.json")
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_consist(consist, Path(folder) / "copy.consist.json")
    ...     read_consist(Path(folder) / "copy.consist.json").name
    'freight train, 24 wagons'
    """
    write_thing(consist, path, Consist)


_COLUMNS = Column("speed", "km/h", "m/s"), Column("effort", "kN", "N")
_EXPECTED = "give a header such as 'speed [km/h];effort [kN]'"


def read_effort_curve(path: str | Path) -> EffortCurve:
    r"""The curve in a CSV file: speeds in the first column, efforts in the second.

    Columns are separated by semicolons, tabs or commas; with the first two a decimal comma is read,
    too. Empty lines and lines that begin with ``#`` are passed over.

    Raises
    ------
    InputError
        If the file is not such a table; with the line and the remedy.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "curve.csv"
    ...     _ = path.write_text("speed [km/h];effort [kN]\n0;200\n50,4;150,5\n")
    ...     read_effort_curve(path).efforts.tolist()
    [200000.0, 150500.0]
    """
    table = read_headed(path, _EXPECTED)
    table.identify_in_order(*(each.name for each in _COLUMNS))
    values = [table.quantity(each, required=True) for each in _COLUMNS]
    table.check()
    return built(lambda: EffortCurve(*values), path)
