"""TTOBench's tracks, trains and journeys: read from and written in the library's own layout.

D. Kouzoupis, I. Pendharkar, F. Corman: TTOBench - an Open-Source Library for Train Trajectory
Optimization. Operations Research Forum 4 (2023), 67. doi:10.1007/s43069-023-00248-x. The layout
is that of version 1.5, which has tunnels, ETCS braking data and journeys.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any, Literal, TypeVar

from trainlog.errors import InputError
from trainlog.formats import journey as journey_format
from trainlog.formats import line as line_format
from trainlog.formats import train as train_format
from trainlog.formats.files import read_json, write_bytes
from trainlog.formats.layout import to_bytes
from trainlog.formats.schema import built, checked, dumped
from trainlog.formats.ttobench_layout import JourneyLayout, Layout, TrackLayout, TrainLayout
from trainlog.railway.journey import Journey
from trainlog.railway.line import Line
from trainlog.railway.train import Train

Kind = Literal["track", "train", "journey"]

_TELLING_KEYS: dict[str, Kind] = {"timing points": "journey", "stops": "track", "mass": "train"}


def detect(path: str | Path) -> Kind:
    """Which kind of TTOBench file it is.

    Raises
    ------
    InputError
        If the file cannot be read or is none of the three.
    """
    return _detect(read_json(path), path)


def import_file(path: str | Path) -> Line | Train | Journey:
    """Read a TTOBench file of any kind; errors as `detect` and as the reader of that kind."""
    kind = detect(path)
    if kind == "track":
        return read_track(path)
    return read_train(path) if kind == "train" else read_journey(path)


def convert(path: str | Path, output: str | Path) -> Path:
    """Write a TTOBench file anew in the project's own format, into the folder `output`.

    Returns
    -------
    Path
        The file written, for example ``CH_StGallen_Wil.line.json``.

    Raises
    ------
    InputError
        If the file cannot be read or used, or the new one cannot be written.
    """
    found = import_file(path)
    target = Path(output) / Path(path).stem
    if isinstance(found, Line):
        target = target.with_name(f"{target.name}.line.json")
        line_format.write_line(found, target)
    elif isinstance(found, Train):
        target = target.with_name(f"{target.name}.train.json")
        train_format.write_train(found, target)
    else:
        target = target.with_name(f"{target.name}.journey.json")
        journey_format.write_journey(found, target)
    return target


def read_track(path: str | Path) -> Line:
    """Read a track. Its stops have no names: they are called by their kilometre, "km 0.000".

    Raises
    ------
    InputError
        If the file cannot be read, a key is unknown or missing, a unit is of the wrong kind or a
        value makes no sense; names the place.
    """
    return built(_read(TrackLayout, "track", path).line, path)


def read_train(path: str | Path) -> Train:
    """Read a train; what the file does not give is listed in the train's ``assumed``.

    Acceleration and deceleration without a limit are limited by the train's effort over its mass.

    Raises
    ------
    InputError
        As `read_track`; also for trains whose efficiency is a table of losses.
    """
    return built(_read(TrainLayout, "train", path).train, path)


def read_journey(path: str | Path) -> Journey:
    """Read a journey; errors as `read_track`."""
    return built(_read(JourneyLayout, "journey", path).journey, path)


def write_track(line: Line, path: str | Path) -> None:
    """Write a line as a track.

    The layout has no place for names of stations and for coordinates.

    Raises
    ------
    InputError
        If the line does not begin and end at a station, as the layout demands, or the file cannot
        be written.
    """
    _write(TrackLayout.of(line), path)


def write_train(train: Train, path: str | Path) -> None:
    """Write a train, without the fields that are ``assumed``.

    The layout has no place for loads, axles and the brake's delays.
    """
    _write(TrainLayout.of(train), path)


def write_journey(journey: Journey, path: str | Path) -> None:
    """Write a journey."""
    _write(JourneyLayout.of(journey), path)


_Layout = TypeVar("_Layout", bound=Layout)


def _read(model: type[_Layout], kind: Kind, path: str | Path) -> _Layout:
    content = read_json(path)
    found = _detect(content, path)
    if found != kind:
        raise InputError(f"is a TTOBench {found}, expected a {kind}", file=path)
    return checked(model, content, path)


def _write(layout: Layout, path: str | Path) -> None:
    write_bytes(path, to_bytes(dumped(layout)))


def _detect(content: Any, path: str | Path) -> Kind:
    if isinstance(content, dict):
        for key, kind in _TELLING_KEYS.items():
            if key in content:
                return kind
        if "format" in content:
            raise InputError(
                f"is a {content['format']} file already", file=path, remedy="use it as it is"
            )
    raise InputError(
        "is neither a track nor a train nor a journey of TTOBench",
        file=path,
        remedy="a track has 'stops', a train 'mass', a journey 'timing points'",
    )
