"""Forecasts of adhesion as CSV; docs/adhesion-forecast-verification.md defines the columns."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np

from trainlog.declaration import Column, Must
from trainlog.errors import InputError
from trainlog.formats.files import check_written
from trainlog.formats.headed import read_headed, write_headed, written_time
from trainlog.railway.forecast import AdhesionForecast
from trainlog.railway.weather import check_condition
from trainlog.spans import utc

_LENGTHS = Column("from", "km", "m"), Column("to", "km", "m")
_COLUMNS = (
    Column("line"),
    Column("layer"),
    *_LENGTHS,
    *map(Column, ("valid from", "valid to", "issued")),
)
_REQUIRED = ("line", "from", "to", "valid from", "valid to")
_MUST = {
    "quantile": Must(
        "is not plausible",
        "give an adhesion above 0 to 1, not in per cent",
        high=1.0,
        above=True,
    ),
    "below": Must("is not plausible", "give a probability from 0 to 1, not in per cent", high=1.0),
}
"""Kinds of columns that have a number in their name, and what their values must be."""

_EXPECTED = (
    "give a header such as 'line,layer,from [km],to [km],valid from,valid to,"
    "quantile 0.05,quantile 0.5,quantile 0.95', or 'below 0.08' for a probability"
)
_NUMBERED = re.compile(r"(quantile|below)\s+(\d*\.?\d+(?:e[+-]?\d+)?)")


def read_forecast(
    path: str | Path, line: str | None = None, length: float = np.inf
) -> AdhesionForecast:
    r"""Read a forecast of adhesion.

    Parameters
    ----------
    path : str or Path
    line : str, optional
        For which it must be; default: any.
    length : float [m]
        Beyond which no section may reach.

    Raises
    ------
    InputError
        If the file is not such a table. All that is wrong in its rows is listed, with line and
        remedy.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "forecast.csv"
    ...     _ = path.write_text(
    ...         "line,from [km],to [km],valid from,valid to,below 0.08\n"
    ...         "A-B,0,1.5,2026-11-22T00:00Z,2026-11-23T00:00Z,0.2\n"
    ...     )
    ...     read_forecast(path)
    Adhesion forecast for line 'A-B', 1 row
    """
    table = read_headed(path, _EXPECTED)
    numbered: dict[str, dict[float, str]] = {"quantile": {}, "below": {}}

    def name_of(word: str) -> str | None:
        found = _NUMBERED.fullmatch(word)
        if found is None:
            return word if word in [each.name for each in _COLUMNS] else None
        number = float(found[2])
        if not 0.0 < number < 1.0:
            table.refuse(f"column '{word}' must be between 0 and 1")
        return numbered[found[1]].setdefault(number, f"{found[1]} {number!r}")

    table.identify(name_of, _REQUIRED)
    if not any(numbered.values()):
        table.refuse("forecasts neither a quantile nor a probability")
    for each in _LENGTHS:
        if table.unit(table.columns[each.name]) not in ("km", "m"):
            table.refuse(
                f"column '{each.name}' is in neither of km, m",
                "convert the lengths, and name the columns 'from [km]' and 'to [km]'",
            )
    lines = table.cells("line", str, "", required=True)
    layers = table.cells("layer", check_condition, "")
    start, end = (table.quantity(each, required=True) for each in _LENGTHS)

    def time(cell: str) -> np.datetime64:
        try:
            return utc(cell).to_datetime64()
        except InputError as error:
            raise InputError(error.problem, remedy="write it as 2026-11-22T06:00:00Z") from error

    first, last, issued = (
        np.array(table.cells(name, time, np.datetime64("NaT"), name in _REQUIRED), dtype="M8[ns]")
        for name in ("valid from", "valid to", "issued")
    )
    issued = np.where(np.isnat(issued), first, issued)
    several = sorted({*lines} - {""})
    if line is None and len(several) > 1:
        words = f"is for {len(several)} lines: {', '.join(several[:3])}"
        table.problems.append((0, InputError(words, remedy="give a file a line")))
    for row, (number, _) in enumerate(table.rows):
        if line is not None and lines[row] not in ("", line):
            words = f"the forecast is for line '{lines[row]}', the trips ran on '{line}'"
            table.note(number, words, "give the forecast for the line of the trips")
        elif end[row] > length:
            reach, km = end[row] / 1e3, length / 1e3
            words = f"the forecast reaches km {reach:.3f}, the line ends at km {km:.3f}"
            table.note(number, words, "count kilometres from the line's beginning")
        if start[row] < 0.0 or start[row] >= end[row] or end[row] < 0.0:
            words = f"a section from km {start[row] / 1e3:g} to km {end[row] / 1e3:g}"
            remedy = "it must end behind its beginning, and begin at km 0 or later"
            table.note(number, words, remedy)
        if first[row] >= last[row]:
            table.note(number, "is valid to a time before its beginning", "correct the times")
        if issued[row] > first[row]:
            remedy = "a forecast is issued before; state as valid only what was left"
            table.note(number, "was issued after it became valid", remedy)
    stated = {
        kind: np.reshape(
            [
                table.quantity(Column(known[each], "1", "1", must=_MUST[kind]), "1")
                for each in sorted(known)
            ],
            (-1, len(table.rows)),
        ).T
        for kind, known in numbered.items()
    }
    found = AdhesionForecast(
        several[0] if several else "",
        start,
        end,
        valid_from=first.view(np.int64),
        valid_to=last.view(np.int64),
        issued=issued.view(np.int64),
        layer=tuple(layers),
        shares=np.array(sorted(numbered["quantile"])),
        quantiles=stated["quantile"],
        thresholds=np.array(sorted(numbered["below"])),
        below=stated["below"],
        place=tuple(f"{Path(path).name}, line {number}" for number, _ in table.rows),
    )
    for row, (number, _) in enumerate(table.rows):
        try:
            found.points(row)
        except InputError as error:
            table.note(number, error.problem, error.remedy)
    table.check()
    return found


def write_forecast(forecast: AdhesionForecast, path: str | Path) -> None:
    """Write a forecast of adhesion, whole or not at all; lengths in km, times in UTC.

    Examples
    --------
    >>> from pathlib import Path
    >>> from trainlog.railway.forecast import AdhesionForecast
    >>> import numpy as np
    >>> import tempfile
    >>> day = np.array([0]), np.array([86_400 * 10**9]), np.array([0])
    >>> forecast = AdhesionForecast(
    ...     "A-B", np.array([0.0]), np.array([500.0]), *day, ("wet",), np.array([0.05, 0.5]),
    ...     np.array([[0.08, 0.12]]), np.zeros(0), np.zeros((1, 0)),
    ... )
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     path = Path(folder) / "forecast.csv"
    ...     write_forecast(forecast, path)
    ...     print(path.read_text().splitlines()[1])
    A-B,wet,0.000,0.500,1970-01-01T00:00:00Z,1970-01-02T00:00:00Z,1970-01-01T00:00:00Z,0.08,0.12
    """
    check_written(forecast, AdhesionForecast)
    times = (forecast.valid_from, forecast.valid_to, forecast.issued)
    columns = [
        [forecast.line] * forecast.start.size,
        forecast.layer,
        *([f"{each / 1e3:.3f}" for each in ends] for ends in (forecast.start, forecast.end)),
        *([written_time(each) for each in known.tolist()] for known in times),
        *(
            ["" if np.isnan(each) else f"{each:.6g}" for each in stated]
            for stated in (*forecast.quantiles.T, *forecast.below.T)
        ),
    ]
    numbered = [
        *(Column(f"quantile {share:g}") for share in forecast.shares),
        *(Column(f"below {level:g}") for level in forecast.thresholds),
    ]
    write_headed(path, (*_COLUMNS, *numbered), zip(*columns, strict=True))
