"""A user's settings: units and time zone that are shown, and files that are taken by default.

They stand in one TOML file. Computing and files never depend on units and zone, which change what
the command line shows, nothing else.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainlog.declaration import meanings
from trainlog.display import SPEED_UNITS
from trainlog.errors import InputError, similar
from trainlog.formats.declared import parse_toml
from trainlog.formats.files import made_folder, read_bytes, write_bytes
from trainlog.formats.samples import SAMPLE

VARIABLE = "TRAINLOG_SETTINGS"
"""Environment variable that names another file."""


@dataclass(frozen=True)
class Settings:
    """What a user has set.

    Attributes
    ----------
    speed : str
        unit in which speeds are shown: km/h, m/s, mph
    zone : str
        time zone in which times are shown, such as Europe/Zurich
    line : str
        line file where a command is given none, or sample; empty: none
    train : str
        train file where a command is given none, or sample; empty: none
    results : str
        folder that the demo writes to
    catalogue : str
        catalogue of the fleet: a folder or a URL; empty: the folder catalogue

    Examples
    --------
    >>> Settings().speed, Settings().zone
    ('km/h', 'UTC')
    """

    speed: str = "km/h"
    zone: str = "UTC"
    line: str = ""
    train: str = ""
    results: str = "results"
    catalogue: str = ""


MEANINGS = meanings(Settings)
"""What each key sets."""


def settings_path(environment: Mapping[str, str] = os.environ) -> Path:
    """The file of the settings: named by `VARIABLE`, or in the platform's folder for such files.

    Examples
    --------
    >>> settings_path({"TRAINLOG_SETTINGS": "mine.toml"}).name
    'mine.toml'
    >>> settings_path({"XDG_CONFIG_HOME": "/etc/xdg"}).name
    'settings.toml'
    """
    if environment.get(VARIABLE):
        return Path(environment[VARIABLE])
    if sys.platform == "win32":
        folder = Path(environment.get("APPDATA") or Path.home() / "AppData" / "Roaming")
    elif sys.platform == "darwin":
        folder = Path.home() / "Library" / "Application Support"
    else:
        folder = Path(environment.get("XDG_CONFIG_HOME") or Path.home() / ".config")
    return folder / "trainlog" / "settings.toml"


def read_settings(path: str | Path | None = None) -> Settings:
    """The settings of a file; the defaults where there is none.

    Parameters
    ----------
    path : path, optional
        Default: `settings_path`.

    Raises
    ------
    InputError
        If a key or a value is none that is known; names the line and what is.

    Examples
    --------
    >>> read_settings("no-such-file.toml").speed
    'km/h'
    """
    file = settings_path() if path is None else Path(path)
    try:
        data = read_bytes(file) if file.exists() else b""
    except InputError as error:
        remedy = f"name another file of settings with {VARIABLE}"
        raise InputError(error.problem, file=file, remedy=remedy) from error
    return _checked(parse_toml(data, file=file), data.decode("utf-8-sig"), file)


def set_setting(key: str, value: str | None, path: str | Path | None = None) -> Path:
    """Set a key to a value, or with None to its default; the rest of the file stays as it is.

    Raises
    ------
    InputError
        If the key or the value is none that is known; the file then stays as it is.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = set_setting("speed", "mph", Path(folder) / "settings.toml")
    ...     read_settings(file).speed
    'mph'
    """
    file = settings_path() if path is None else Path(path)
    if key in ("line", "train") and value and not _named_sample(value):
        value = str(Path(value).resolve())
    _checked({key: getattr(Settings, key, "") if value is None else value}, "", None)
    text = file.read_text("utf-8-sig") if file.exists() else ""
    kept = [line for line in text.splitlines() if not _line_of(key).match(line)]
    if value is not None:
        kept.append(f"{key} = {json.dumps(value, ensure_ascii=False)}")
    new = "\n".join(kept) + "\n"
    _checked(parse_toml(new.encode(), file=file), new, file)
    try:
        made_folder(file.parent)
    except InputError as error:
        problem, remedy = f"its folder {error.problem}", f"name another file with {VARIABLE}"
        raise InputError(problem, file=file, remedy=remedy) from error
    write_bytes(file, new.encode())
    return file


def _checked(content: Mapping[str, Any], text: str, file: Path | None) -> Settings:
    for key, value in content.items():
        for problem, remedy in _problems(key, value):
            lines = (n for n, line in enumerate(text.splitlines(), 1) if _line_of(key).match(line))
            place = next((f"line {number}" for number in lines), None)
            raise InputError(problem, file=file, place=place, remedy=remedy)
    return Settings(**content)


def _line_of(key: str) -> re.Pattern[str]:
    return re.compile(rf"""\s*["']?{re.escape(key)}["']?\s*(=|\])|\s*\[{re.escape(key)}\]""")


def _problems(key: str, value: object) -> Iterator[tuple[str, str]]:
    """What is wrong with a setting, and the remedy."""
    if key not in MEANINGS:
        meant = "".join(f"did you mean '{each}'? " for each in similar(key, MEANINGS, most=1))
        yield f"'{key}' is not a setting", f"{meant}known: {', '.join(MEANINGS)}"
    elif not isinstance(value, str):
        yield f"{key} must be text, not {value}", f'write it as {key} = "{value}"'
    elif key == "speed" and value not in SPEED_UNITS:
        yield f"speed '{value}' is not a unit of speed", f"choose one of {', '.join(SPEED_UNITS)}"
    elif key == "zone":
        from trainlog.spans import zone_of

        try:
            zone_of(value)
        except InputError:
            yield f"zone '{value}' is not known", "name one as Europe/Zurich, or UTC"
    elif key == "results" and not value:
        yield "results is empty", "name a folder, such as results"
    elif (
        key in ("line", "train")
        and value
        and not _named_sample(value)
        and not Path(value).expanduser().is_file()
    ):
        yield f"'{value}' does not exist", "name a file, 'sample', or set it to '' for none"
    # Whether there is such a catalogue is found where it is opened.


def _named_sample(value: str) -> bool:
    return value == SAMPLE and not Path(value).is_file()
