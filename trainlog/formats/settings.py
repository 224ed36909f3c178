"""A user's settings: units and time zone that are shown, and files that are taken by default.

They stand in one TOML file. Computing and files never depend on units and zone, which change what
the command line shows, nothing else.
"""

from __future__ import annotations

import json
import os
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from trainlog.display import SPEED_UNITS
from trainlog.errors import InputError, similar
from trainlog.formats.declared import parse_toml
from trainlog.formats.files import write_bytes
from trainlog.formats.samples import SAMPLE

VARIABLE = "TRAINLOG_SETTINGS"
"""Environment variable that names another file."""


@dataclass(frozen=True)
class Settings:
    """What a user has set.

    Attributes
    ----------
    speed : str
        Unit in which speeds are shown: ``"km/h"``, ``"m/s"`` or ``"mph"``.
    zone : str
        Time zone in which times are shown: ``"UTC"``, ``"Europe/Zurich"``.
    line, train : str
        Files that are taken where a command is given none, or ``"sample"``; empty: none.
    results : str
        Folder that the demo writes to.
    catalogue : str
        Catalogue of the fleet, a folder or a URL; empty: the folder ``catalogue``.

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


MEANINGS = {
    "speed": f"unit in which speeds are shown: {', '.join(SPEED_UNITS)}",
    "zone": "time zone in which times are shown, such as Europe/Zurich",
    "line": "line file where a command is given none, or sample; empty: none",
    "train": "train file where a command is given none, or sample; empty: none",
    "results": "folder that the demo writes to",
    "catalogue": "catalogue of the fleet: a folder or a URL; empty: the folder catalogue",
}
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
        data = file.read_bytes()
    except FileNotFoundError:
        return Settings()
    except OSError as error:
        raise InputError(
            f"cannot be read: {error.strerror or error}",
            file=file,
            remedy=f"name another file of settings with {VARIABLE}",
        ) from error
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
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(
            f"its folder cannot be made: {error.strerror or error}",
            file=file,
            remedy=f"name another file with {VARIABLE}",
        ) from error
    write_bytes(file, new.encode())
    return file


def _checked(content: Mapping[str, Any], text: str, file: Path | None) -> Settings:
    for key, value in content.items():
        problem = _problem(key, value)
        if problem is not None:
            lines = (n for n, line in enumerate(text.splitlines(), 1) if _line_of(key).match(line))
            number = next(lines, None)
            place = f"line {number}" if number is not None else None
            raise InputError(problem[0], file=file, place=place, remedy=problem[1])
    return Settings(**content)


def _line_of(key: str) -> re.Pattern[str]:
    return re.compile(rf"""\s*["']?{re.escape(key)}["']?\s*(=|\])|\s*\[{re.escape(key)}\]""")


def _problem(key: str, value: object) -> tuple[str, str] | None:
    """What is wrong with a key and its value, and the remedy; None if nothing is."""
    if key not in MEANINGS:
        meant = "".join(f"did you mean '{each}'? " for each in similar(key, MEANINGS, most=1))
        return f"'{key}' is no setting", f"{meant}known: {', '.join(MEANINGS)}"
    if not isinstance(value, str):
        return f"{key} must be text, not {value}", f'write it as {key} = "{value}"'
    if key == "speed" and value not in SPEED_UNITS:
        return f"speed '{value}' is no unit that is shown", f"choose of {', '.join(SPEED_UNITS)}"
    if key == "zone" and not _is_zone(value):
        return f"zone '{value}' is not known", "name one as Europe/Zurich, or UTC"
    if key == "results" and not value:
        return "results is empty", "name a folder, such as results"
    named = key in ("line", "train") and value and not _named_sample(value)
    if named and not Path(value).expanduser().is_file():
        return f"'{value}' does not exist", "name a file, 'sample', or set it to '' for none"
    # Whether there is such a catalogue is found where it is opened.
    return None


def _is_zone(value: str) -> bool:
    from zoneinfo import ZoneInfo

    try:
        ZoneInfo(value)
    except (KeyError, ValueError, OSError):
        return False
    return True


def _named_sample(value: str) -> bool:
    return value == SAMPLE and not Path(value).is_file()
