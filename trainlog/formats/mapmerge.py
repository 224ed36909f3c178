"""One map's file from several: the same recordings give the same bytes."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.files import write_bytes
from trainlog.formats.mapdatabase import INSERT, amount_in, insert_sums, new_database, serialized
from trainlog.formats.mapfile import MapFile, reasons_of
from trainlog.formats.recordings import Row
from trainlog.identity import overlapping, same_drives
from trainlog.railway.condition import TrackConditionMap
from trainlog.railway.evidence import DailyEvidence


def merge_files(paths: Sequence[str | Path], output: str | Path) -> tuple[int, int]:
    """One file from the files of several maps of one line; trips that several hold count once.

    The same recordings give the same bytes, however they are divided between the files. Which
    recording of a drive counts is decided anew among all.

    Parameters
    ----------
    paths : sequence of path
        At least one.
    output : path
        A new file.

    Returns
    -------
    trips, days : int
        How many trips the new map counts, and of how many days.

    Raises
    ------
    InputError
        If the maps differ in line, bins or settings, have sums of one drive in common, count a
        log in different layers, or the output exists.
    """
    if not paths:
        raise InputError("no map was given", remedy="name the files to merge")
    if Path(output).exists():
        raise InputError(
            "exists already",
            file=output,
            remedy="name a new file: processes may be adding to this one",
        )
    empty: TrackConditionMap | None = None
    rows: dict[str, Row] = {}
    blobs: dict[str, bytes] = {}
    sums: dict[str, list[DailyEvidence]] = {}
    for path in paths:
        with MapFile(path) as file, file.unchanging():
            _check_alike(empty, file.empty, path)
            empty = file.empty
            for row in file.trips():
                rows[row.key] = _chosen(rows.get(row.key), row, path)
            blobs.update(file.blobs())
            for layer, piece in file.sums().items():
                sums.setdefault(layer, []).append(piece)
    assert empty is not None
    decided = _decided([rows[key] for key in sorted(rows)])
    with new_database(empty) as database:
        database.executemany(INSERT, (row.full for row in decided))
        used = sorted({digest for row in decided for digest in row.pieces.values()})
        database.executemany("INSERT INTO evidence VALUES (?, ?)", ((d, blobs[d]) for d in used))
        totals = {layer: DailyEvidence.total(sums[layer]) for layer in sorted(sums)}
        for layer, total in totals.items():
            insert_sums(database, layer, total)
        found = amount_in(database, totals.values())
        write_bytes(output, serialized(database, in_order=True))
    return found


def _chosen(first: Row | None, second: Row, path: str | Path) -> Row:
    """Which of two rows of one recording is used, whatever their order."""
    if first is None:
        return second
    name = str(json.loads(second.entry).get("trip", ""))
    if first.layer != second.layer:
        raise InputError(
            f"counts trip '{name}' as '{second.layer}', another of the maps as '{first.layer}'",
            file=path,
            remedy="build one map from the logs instead",
        )
    fixed = [row for row in (first, second) if row.evidence is None and row.counted]
    if len(fixed) == 2:
        raise InputError(
            f"has trip '{name}' in its sums, and so has another of the maps",
            file=path,
            remedy="build one map from the logs instead",
        )
    if fixed:
        return fixed[0]
    kept = [row for row in (first, second) if row.evidence is not None] or [first, second]
    return min(kept, key=lambda row: (str(row.evidence), row.entry))


def _decided(rows: Sequence[Row]) -> list[Row]:
    """The rows, each with whether it counts."""
    known = [row for row in rows if row.identity]
    several = [known[number] for number in overlapping([str(row.identity) for row in known])]
    sums = [row for row in several if row.evidence is None and row.counted]
    apart = same_drives([row.known._replace(held=False) for row in sums])
    if apart:
        raise InputError(
            f"the sums of several maps hold one drive: {apart[0].sentence}",
            remedy="build one map from the logs instead",
        )
    reasons = reasons_of(several)
    alone = {row.key for row in rows} - {row.key for row in several}
    found = []
    for row in rows:
        counts = row.key in alone or row.key not in reasons
        changes = row.evidence is not None and bool(row.counted) != counts
        found.append(row._replace(counted=int(counts)) if changes else row)
    return found


def _check_alike(first: TrackConditionMap | None, second: TrackConditionMap, path: object) -> None:
    """Refuse to merge maps that differ in more than their trips."""
    for name in ("line", "length", "bin_length", "settings", "levels"):
        if first is not None and not np.array_equal(getattr(first, name), getattr(second, name)):
            raise InputError(
                f"track-condition maps differ in {name}:"
                f" {getattr(first, name)} and {getattr(second, name)}",
                file=str(path),
                remedy="merge maps of one line that were made with the same settings",
            )
