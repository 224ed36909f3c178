"""The first difference between two files of one kind, in values and not in bytes.

Another processor rounds the last bit of a sum or of an exponential differently. Files that were
made on different machines are therefore compared to `TOLERANCE` of the largest value of a column;
only two runs on one machine are compared byte by byte.
"""

import json
import re
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np

import trainlog

TOLERANCE = 1e-9
"""Share of the largest value of a column by which files from two machines may differ."""

HASH = re.compile(r"[0-9a-f]{64}")
"""A SHA-256: of bytes that may differ in the last bit of a number."""


def first_difference(found: Path, kept: Path, tolerance: float = TOLERANCE) -> str | None:
    """Where two files differ by more than `tolerance`, in one line; None where they agree.

    Logs, JSON and maps are compared value by value, columns and lists of numbers as a whole, CSV
    to one unit in the last written digit, everything else byte by byte.
    """
    if kept.suffix in (".mcap", ".json", ".map"):
        return _of_json(_content(found), _content(kept), tolerance)
    if kept.suffix == ".csv":
        return _of_csv(found, kept)
    return None if found.read_bytes() == kept.read_bytes() else "the bytes differ"


def _content(path: Path) -> Any:
    """All values of a file, as JSON would hold them."""
    if path.suffix == ".json":
        return json.loads(path.read_bytes())
    if path.suffix == ".mcap":
        trip = trainlog.read(path)
        topics = {name: frame.to_dict("list") for name, frame in trip.topics.items()}
        times = {name: frame.index.asi8.tolist() for name, frame in trip.topics.items()}
        attached = {name: json.loads(data) for name, data in trip.attachments.items()}
        own = {"metadata": dict(trip.metadata), "provenance": trip.provenance}
        return topics | {"times": times, "attachments": attached} | json.loads(json.dumps(own))
    track = trainlog.read_map(path)
    layers = {
        name: {
            each.name: np.asarray(getattr(part, each.name)).tolist()
            for part in (layer, layer.evidence)
            for each in fields(part)
            if each.name in ("log_mean", "log_std", "observed") or part is layer.evidence
        }
        for name, layer in track.layers.items()
    }
    facts = {name: getattr(track, name) for name in ("line", "length", "settings", "trips")}
    return json.loads(json.dumps({**facts, "levels": track.levels.tolist(), "layers": layers}))


def _of_numbers(found: np.ndarray, kept: np.ndarray, tolerance: float) -> str | None:
    """Two columns of numbers; NaN equals NaN."""
    largest = float(np.max(np.abs(kept[np.isfinite(kept)]), initial=0.0))
    off = np.where((found == kept) | (np.isnan(found) & np.isnan(kept)), 0.0, np.abs(found - kept))
    beyond = ~(off <= tolerance * largest)
    if not beyond.any():
        return None
    row = int(np.flatnonzero(beyond)[0])
    return f"row {row} is {found[row]!r}, kept {kept[row]!r} ({int(beyond.sum())} rows)"


def _of_json(found: Any, kept: Any, tolerance: float, path: str = "") -> str | None:
    if isinstance(kept, dict) and isinstance(found, dict):
        if list(found) != list(kept):
            return f"{path}: keys {list(found)}, kept {list(kept)}"
        pairs = [(f"{path}/{key}", found[key], kept[key]) for key in kept]
    elif isinstance(kept, list) and isinstance(found, list):
        if len(found) != len(kept):
            return f"{path}: {len(found)} entries, kept {len(kept)}"
        if kept and all(isinstance(each, float) for each in kept + found):
            difference = _of_numbers(np.array(found), np.array(kept), tolerance)
            return f"{path}: {difference}" if difference else None
        pairs = [(f"{path}/{i}", *both) for i, both in enumerate(zip(found, kept, strict=True))]
    elif isinstance(kept, float) and isinstance(found, float):
        difference = _of_numbers(np.array([found]), np.array([kept]), tolerance)
        return f"{path}: {difference}" if difference else None
    else:
        hashes = isinstance(kept, str) and HASH.fullmatch(kept) and HASH.fullmatch(str(found))
        return None if found == kept or hashes else f"{path}: {found!r}, kept {kept!r}"
    for place, new, old in pairs:
        if difference := _of_json(new, old, tolerance, place):
            return difference
    return None


def _of_csv(found: Path, kept: Path) -> str | None:
    """Cell by cell; a number may differ by one in its last written digit."""
    new, old = (path.read_text("utf-8").splitlines() for path in (found, kept))
    if len(new) != len(old):
        return f"{len(new)} rows, kept {len(old)}"
    separator = ";" if ";" in old[0] else ","
    for row, (is_now, was) in enumerate(zip(new, old, strict=True), 1):
        cells = [line.split(separator) for line in (is_now, was)]
        if len(cells[0]) != len(cells[1]) or not all(map(_rounded_alike, *cells)):
            return f"row {row} is {is_now!r}, kept {was!r}"
    return None


def _rounded_alike(found: str, kept: str) -> bool:
    if found == kept:
        return True
    found, kept = found.replace(",", "."), kept.replace(",", ".")
    try:
        off = abs(float(found) - float(kept))
    except ValueError:
        return False
    return off <= 1.001 * 10.0 ** -len(kept.partition(".")[2])
