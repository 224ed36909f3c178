"""Maps of the edges of a network, or of lines, kept up to date from what workers computed.

The evidence of each trip is a result of the catalogue; which trips the maps hold is one, too: the
computation `MAPS`, without a table. A trip that was added when the process was killed before that
was recorded is added again, which changes nothing (`trainlog.formats.mapfile`).
"""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from analysis.adhesion.condition_map import empty_map_of
from analysis.network.maps import edge_map_path, map_files
from trainlog.formats.files import made_folder, write_bytes
from trainlog.formats.mapfile import MapFile, Recording, unpacked_evidence
from trainlog.identity import identity_from_text
from trainlog.progress import task
from trainlog.railway.evidence import DailyEvidence

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue, Computation

MAPS = "maps"
"""Folder of the maps beside the results, and the computation that states which trips they hold."""

MARK = "maps.json"
"""File in that folder: which code and parameters the evidence was made by."""

PAGE = 200
"""Trips that are added at once."""


@dataclass(frozen=True, slots=True)
class MapsUpdate:
    """What became of the maps.

    Attributes
    ----------
    folder : Path
        That holds them now.
    trips : int
        Whose evidence was added.
    edges : tuple of str
        Whose maps changed.
    complete : bool
        Whether the maps in `folder` are of this code; else the earlier ones stand until all trips
        were computed by it.
    """

    folder: Path
    trips: int = 0
    edges: tuple[str, ...] = ()
    complete: bool = True


def maps_folder(catalogue: Catalogue) -> Path:
    """Where the maps of a catalogue are: a file ``<edge>.map`` an edge of the network, or a line.

    Examples
    --------
    >>> import tempfile
    >>> from trainlog.catalogue import open_catalogue
    >>> with tempfile.TemporaryDirectory() as folder, open_catalogue(folder) as catalogue:
    ...     maps_folder(catalogue).name
    'maps'
    """
    return catalogue.results_folder.with_name(MAPS)


def update_maps(catalogue: Catalogue, evidence: Computation) -> MapsUpdate:
    """Add the evidence of all trips that the maps do not hold; one process at a time does.

    Where the evidence was made by other code than that of the maps, maps are built anew beside them
    and take their place when they hold all trips.

    Parameters
    ----------
    catalogue : Catalogue
    evidence : Computation
        Of the analysis "adhesion", that made the evidence.
    """
    with catalogue.alone(MAPS):
        work = _Maps(catalogue, evidence)
        work.tidy()
        left = work.leave()
        trips, edges = work.add()
        return MapsUpdate(work.standing, trips, tuple(sorted(edges | left)), work.finish())


class _Maps:
    """Maps of one code, being brought up to date."""

    def __init__(self, catalogue: Catalogue, evidence: Computation) -> None:
        self.catalogue, self.about = catalogue, evidence
        self.own = replace(evidence, analysis=MAPS)
        self.standing = maps_folder(catalogue)
        self._next = self.standing.with_name(f"{MAPS}.next")
        self._old = self.standing.with_name(f"{MAPS}.old")
        self.mark = {"format": "trainlog/fleet-maps", "code": evidence.code}
        self.mark |= evidence.parameters

    def leave(self) -> set[str]:
        """Take out trips whose logs were overwritten or removed; the edges whose maps changed."""
        logs, edges = self.catalogue.forget_overwritten(self.own), set[str]()
        for folder in (self.standing, self._next):
            for path in map_files(folder) if _mark_of(folder) == self.mark else ():
                with MapFile(path) as file:
                    if file.keep_only(logs):
                        edges.add(file.empty.line)
                    trips, _ = file.amount()
                if not trips:
                    path.unlink()
        return edges

    def add(self) -> tuple[int, set[str]]:
        """Add what is missing; how many trips, and which edges they ran over."""
        folder, count, edges = self._folder(), 0, set[str]()
        waiting = self.catalogue.standing(self.own)["pending"]
        if not waiting:
            return 0, set()
        with task("mapping", waiting, "trip") as step:
            for page, outcomes in self._pages():
                edges |= self._added(folder, self._evidence(page))
                self.catalogue.record(self.own, outcomes)
                count += len(outcomes)
                step(count)
        return count, edges

    def _pages(self) -> Iterator[tuple[list[str], list[Any]]]:
        """Keys of trips whose evidence is known and not in the maps, with what is recorded."""
        from trainlog.catalogue import ResultOutcome

        last = ""
        while True:
            page = self.catalogue.pending(self.own, page=(last, PAGE))
            if page.empty:
                return
            last = str(page["key"].iloc[-1])
            unknown = self.catalogue.pending(self.about, where=_chosen(page["key"]))
            known = page[~page["key"].isin(unknown["key"])]
            if len(known):
                given = known[["key", "sha256"]].to_numpy().tolist()
                yield [key for key, _ in given], [ResultOutcome(*each) for each in given]

    def _evidence(self, keys: list[str]) -> pd.DataFrame:
        return self.catalogue.results(self.about, where=_chosen(keys))

    def _added(self, folder: Path, rows: pd.DataFrame) -> set[str]:
        """Add the evidence of trips to the maps of their edges."""
        if rows.empty:
            return set()
        for edge, part in rows.groupby("edge", sort=True):
            first = part.iloc[0]
            empty = empty_map_of(str(edge), float(first["edge_length"]), float(first["bin_length"]))
            with MapFile(edge_map_path(folder, str(edge)), empty) as file:
                file.append_all([_recording(each) for _, each in part.groupby(["key", "trip"])])
        return set(rows["edge"])

    def _folder(self) -> Path:
        """The folder whose maps are of this code; begun anew if there is none."""
        for folder in (self.standing, self._next):
            if _mark_of(folder) == self.mark:
                return folder
        self.catalogue.forget(self.own, states=("done", "refused", "failed"))
        shutil.rmtree(self._next, ignore_errors=True)
        folder = self._next if self.standing.exists() else self.standing
        made_folder(folder)
        write_bytes(folder / MARK, json.dumps(self.mark, sort_keys=True).encode())
        return folder

    def tidy(self) -> None:
        """Do what a process that was killed left to be done."""
        if self._old.exists() and not self.standing.exists() and self._next.exists():
            self._next.rename(self.standing)
        shutil.rmtree(self._old, ignore_errors=True)
        for folder in (self.standing, self._next):
            for begun in folder.glob(".*.map"):
                begun.unlink(missing_ok=True)

    def finish(self) -> bool:
        """Put new maps in the place of those of other code, if they hold all trips."""
        if _mark_of(self.standing) == self.mark:
            return True
        if _mark_of(self._next) != self.mark or self.catalogue.standing(self.own)["pending"]:
            return False
        if self.standing.exists():
            self.standing.rename(self._old)
        self._next.rename(self.standing)
        shutil.rmtree(self._old, ignore_errors=True)
        return True


def _chosen(keys: Any) -> str:
    """An expression that chooses trips by their keys."""
    return f"key in ({', '.join(repr(str(key)) for key in keys)})"


def _mark_of(folder: Path) -> Mapping[str, Any] | None:
    try:
        found: Mapping[str, Any] = json.loads((folder / MARK).read_text("utf-8"))
    except (OSError, ValueError):
        return None
    return found


def _recording(rows: pd.DataFrame) -> Recording:
    """What a map keeps of a trip on an edge, from its rows, one a rail condition."""
    first = rows.iloc[0]
    entry = json.loads(first["entry"]) | {"identity": first["identity"]}
    evidence = {
        str(layer): evidence_of_row(data)
        for layer, data in zip(rows["layer"], rows["evidence"], strict=True)
    }
    identity = identity_from_text(first["identity"])
    return Recording(first["main_layer"], entry, identity, int(first["steps"]), evidence)


def evidence_of_row(data: bytes) -> DailyEvidence:
    """The evidence in a row of the table ``adhesion``.

    Examples
    --------
    >>> from analysis.fleet.analyses import ANALYSES
    >>> from analysis.view import view_of
    >>> table = ANALYSES["adhesion"].table(view_of("sample_logs/nonstop.mcap"))
    >>> found = evidence_of_row(table["evidence"][0])
    >>> int(found.events.sum()) == int(table["onsets"][0])
    True
    """
    return unpacked_evidence([zlib.decompress(data)])
