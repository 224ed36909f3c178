"""Maps of the edges of a network, or of lines, kept up to date from what workers computed.

The evidence of each trip is a result of the catalogue; which trips the maps hold is one, too: the
computation `MAPS`, without a table. A trip that was added when the process was killed before that
was recorded is added again, which changes nothing (`trainlog.formats.mapfile`).

Edges are brought up to date side by side, by the processes that computed the trips; of each edge
the evidence of old trips is then replaced by sums of days. Neither depends on which process does
it, nor on how trips came, as long as trips agree.
"""

from __future__ import annotations

import json
import shutil
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pandas as pd

from analysis.adhesion.condition_map import empty_map_of
from analysis.fleet.engine import Engine, InProcess, run
from analysis.network.maps import edge_map_path, map_files
from trainlog.errors import InputError
from trainlog.formats.files import made_folder, write_bytes
from trainlog.formats.mapfile import MapFile, Recording, unpacked_evidence
from trainlog.identity import identity_from_text
from trainlog.progress import task
from trainlog.railway.evidence import DailyEvidence

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue, Computation, ResultOutcome

MAPS = "maps"
"""Folder of the maps beside the results, and the computation that states which trips they hold."""

MARK = "maps.json"
"""File in that folder: which code and parameters the evidence was made by."""

PAGE = 200
"""Trips that are asked for at once; so many are added by this process."""

PAGES = 5
"""So many pages are added at once, by all processes."""

SEVERAL = 20
"""Maps up to which this process sums up what is old."""

KEPT = 30
"""So many of the latest trips of each rail condition on an edge, and fewer than so many before
them, are compared with each other and with trips that come; of earlier ones sums are kept."""


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


def update_maps(
    catalogue: Catalogue, evidence: Computation, engine: Callable[[], Engine] = InProcess
) -> MapsUpdate:
    """Add the evidence of all trips that the maps do not hold; one update at a time does.

    Where the evidence was made by other code than that of the maps, maps are built anew beside them
    and take their place when they hold all trips.

    Parameters
    ----------
    catalogue : Catalogue
    evidence : Computation
        Of the analysis "adhesion", that made the evidence.
    engine : callable, optional
        Gives the engine whose processes share the work where there is much; those that do not run
        on this computer leave it to this process.
    """
    with catalogue.alone(MAPS):
        work = _Maps(catalogue, evidence, engine)
        work.tidy()
        left = work.leave()
        trips, edges = work.add()
        work.compact()
        return MapsUpdate(work.standing, trips, tuple(sorted(edges | left)), work.finish())


@dataclass(frozen=True)
class EdgeWork:
    """What one worker is to do with the map of an edge.

    Attributes
    ----------
    path : Path
        Of the map.
    rows : DataFrame or None
        Evidence of trips that is to be added.
    kept : int
        Where nothing is added: latest trips whose evidence is not summed up.
    """

    path: Path
    rows: pd.DataFrame | None = None
    kept: int = 0

    @property
    def jobs(self) -> tuple[EdgeWork]:
        """All of it is one."""
        return (self,)

    def computed(self) -> None:
        """Do it."""
        if self.rows is None:
            with MapFile(self.path) as file:
                file.compact(kept=self.kept)
            return
        edge, length, bin_length = self.rows[["edge", "edge_length", "bin_length"]].iloc[0]
        with MapFile(self.path, empty_map_of(edge, float(length), float(bin_length))) as file:
            file.append_all([_recording(each) for _, each in self.rows.groupby(["key", "trip"])])

    def alone(self, job: EdgeWork) -> EdgeWork:
        """It by itself."""
        return job

    def died(self, job: EdgeWork, reason: str) -> None:
        """Refuse to go on without an edge."""
        raise InputError(
            f"cannot be brought up to date: {reason}",
            file=job.path,
            remedy="what was finished is kept: free some memory and update again",
        )


class _Maps:
    """Maps of one code, being brought up to date."""

    def __init__(
        self, catalogue: Catalogue, evidence: Computation, engine: Callable[[], Engine]
    ) -> None:
        self.catalogue, self.about, self._engine = catalogue, evidence, engine
        self.own = replace(evidence, analysis=MAPS)
        self.standing = maps_folder(catalogue)
        self._next = self.standing.with_name(f"{MAPS}.next")
        self._old = self.standing.with_name(f"{MAPS}.old")
        self.mark = {"format": "trainlog/fleet-maps", "code": evidence.code}
        self.mark |= evidence.parameters

    def leave(self) -> set[str]:
        """Take out trips whose logs were overwritten or removed; the edges whose maps changed.

        Where such a trip is in sums, the map is to be made anew of the evidence of the others.
        """
        logs, edges = self.catalogue.forget_overwritten(self.own), set[str]()
        for folder in (self.standing, self._next):
            for path in map_files(folder) if _mark_of(folder) == self.mark else ():
                with MapFile(path) as file:
                    summed = file.logs(summed=True)
                    if summed <= logs:
                        gone, trips = file.keep_only(logs), file.amount()[0]
                    else:
                        again = sorted(summed | file.logs(summed=False))
                        for first in range(0, len(again), PAGE // 2):
                            self._forget(_chosen(again[first : first + PAGE // 2], "sha256"))
                        gone, trips = len(again), 0
                    if gone:
                        edges.add(file.empty.line)
                if not trips:
                    path.unlink()
        return edges

    def _forget(self, where: str | None = None) -> None:
        """Let trips wait for the maps again."""
        self.catalogue.forget(self.own, where=where, states=("done", "refused", "failed"))

    def add(self) -> tuple[int, set[str]]:
        """Add what is missing; how many trips, and which edges they ran over."""
        folder, count, edges = self._folder(), 0, set[str]()
        waiting = self.catalogue.standing(self.own)["pending"]
        if not waiting:
            return 0, set()
        with task("mapping", waiting, "trip") as step:
            pages = self._pages()
            while several := list(islice(pages, PAGES)):
                rows = pd.concat([rows for rows, _ in several])
                by_edge = () if rows.empty else rows.groupby("edge", sort=True)
                parts = {str(edge): part for edge, part in by_edge}
                work = [EdgeWork(edge_map_path(folder, edge), parts[edge]) for edge in parts]
                self._do(work, few=len(several) == 1)
                edges |= set(parts)
                for _, outcomes in several:
                    self.catalogue.record(self.own, outcomes)
                    count += len(outcomes)
                    step(count)
        return count, edges

    def _pages(self) -> Iterator[tuple[pd.DataFrame, list[ResultOutcome]]]:
        """Evidence of trips that is known and not in the maps, with what is recorded of them."""
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
                rows = self.catalogue.results(self.about, where=_chosen(known["key"]))
                given = known[["key", "sha256"]].to_numpy().tolist()
                yield rows, [ResultOutcome(*each) for each in given]

    def compact(self) -> None:
        """Replace the evidence of old trips by sums of days."""
        work = []
        for path in map_files(self._folder()):
            with MapFile(path) as file:
                if file.beyond(KEPT):
                    work.append(EdgeWork(path, kept=KEPT))
        self._do(work, few=len(work) <= SEVERAL)

    def _do(self, work: Sequence[EdgeWork], *, few: bool) -> None:
        """Do what is to be done of each edge, side by side where it is not little."""
        engine = InProcess() if few or len(work) < 2 else self._engine()
        run(engine if engine.is_here else InProcess(), iter(work), lambda *_: None)

    def _folder(self) -> Path:
        """The folder whose maps are of this code; begun anew if there is none."""
        for folder in (self.standing, self._next):
            if _mark_of(folder) == self.mark:
                return folder
        self._forget()
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


def _chosen(values: Any, column: str = "key") -> str:
    """An expression that chooses trips by their keys, or what else distinguishes them."""
    return f"{column} in ({', '.join(repr(str(value)) for value in values)})"


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
