"""Curves of effort over speed as CSV: two columns with their units in the header."""

from __future__ import annotations

from pathlib import Path

from trainlog.declaration import Column
from trainlog.formats.declared import built
from trainlog.formats.headed import read_headed
from trainlog.railway import EffortCurve

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
