"""The format of a network, ``"trainlog/network"``; docs/formats.md describes its keys."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from trainlog.errors import InputError
from trainlog.formats.files import check_written, read_bytes, write_bytes
from trainlog.formats.linefile import LineFile
from trainlog.formats.schema import MISSING, Column, File, Part, Table, built, gathered
from trainlog.railway.line import Line
from trainlog.railway.network import Edge, Network, Node

_Nodes = Annotated[
    tuple[Any, ...],
    Table(
        (
            Column("name"),
            Column("kind"),
            Column("latitude", "deg", "deg", MISSING),
            Column("longitude", "deg", "deg", MISSING),
        )
    ),
]


class _Edge(Part):
    name: str | None = None
    start: str
    end: str
    line: LineFile | None = None
    file: str | None = None

    def built_line(self, folder: Path, plausible: bool) -> Line:
        """The line, from the file beside the network's if it is named; refused if implausible."""
        if (self.line is None) == (self.file is None):
            raise InputError(
                "needs either a line or the file of one", remedy="give one of 'line' and 'file'"
            )
        if self.line is not None:
            problems = LineFile.implausible(dict(self.line)) if plausible else []
            if problems:
                raise InputError.listing(problems)
            return self.line.line()
        path = folder / str(self.file)
        line: Line = LineFile.read(read_bytes(path), path)
        return line

    def edge(self, folder: Path, plausible: bool) -> Edge:
        """The edge; its name is the line's where it has none of its own."""
        line = self.built_line(folder, plausible)
        return Edge(self.name or line.name, line, self.start, self.end)


class _NetworkFile(File):
    FORMAT: ClassVar[str] = "trainlog/network"
    VERSION: ClassVar[int] = LineFile.VERSION

    name: str = Field(min_length=1)
    source: str = ""
    nodes: _Nodes
    edges: list[_Edge]
    turns: dict[str, list[list[str]]] | None = None

    @property
    def version_needed(self) -> int:
        """That of the lines which the file holds."""
        return max((each.line.version_needed for each in self.edges if each.line), default=1)

    def network(self, folder: Path, plausible: bool) -> Network:
        """The network that the file describes; files of lines are looked for in `folder`."""
        edges = (partial(self._edge, n, folder, plausible) for n in range(len(self.edges)))
        made = gathered(self._turns, *edges)
        return Network(self.name, self._nodes(), tuple(made[1:]), made[0], self.source)

    def _edge(self, number: int, folder: Path, plausible: bool) -> Edge:
        """One edge, whose errors name where it stands."""
        try:
            return self.edges[number].edge(folder, plausible)
        except InputError as error:
            raise InputError.listing(
                [
                    InputError(
                        each.problem if each.file is None else f"{each.file}: {each.problem}",
                        place=f"edges[{number}]" + (f".{each.place}" if each.place else ""),
                        remedy=each.remedy,
                    )
                    for each in error.each
                ]
            ) from error

    def _nodes(self) -> tuple[Node, ...]:
        names, kinds, latitudes, longitudes = self.nodes
        return tuple(
            Node(name, kind, *(None if np.isnan(each) else float(each) for each in where))
            for name, kind, *where in zip(names, kinds, latitudes, longitudes, strict=True)
        )

    def _turns(self) -> dict[str, tuple[tuple[str, str], ...]]:
        found: dict[str, tuple[tuple[str, str], ...]] = {}
        for node, pairs in (self.turns or {}).items():
            for number, pair in enumerate(pairs):
                if len(pair) != 2:
                    raise InputError(
                        f"names {len(pair)} edges",
                        place=f"turns.{node}[{number}]",
                        remedy="name the two between which trains can pass",
                    )
            found[node] = tuple((pair[0], pair[1]) for pair in pairs)
        return found

    @staticmethod
    def of(network: Network) -> _NetworkFile:
        """The file that describes a network."""
        nodes, turns = network.nodes, network.turns
        missing = [
            [np.nan if value is None else value for value in each]
            for each in ([n.latitude for n in nodes], [n.longitude for n in nodes])
        ]
        return _NetworkFile.holding(
            network,
            nodes=([n.name for n in nodes], [n.kind for n in nodes], *missing),
            edges=[
                _Edge.holding(edge, name=None, line=LineFile.of(edge.line), file=None)
                for edge in network.edges
            ],
            turns={node: [list(pair) for pair in pairs] for node, pairs in turns.items()} or None,
        )


def network_from_bytes(data: bytes, *, file: str | Path = "network.json") -> Network:
    """The network in the bytes of a network file; `file` is what errors call it.

    Files of lines that it names are looked for beside `file`.

    Raises
    ------
    InputError
        If they are not a network file, naming the place and the remedy.
    """
    return _network(data, file, plausible=False)


def _network(data: bytes, file: str | Path, plausible: bool) -> Network:
    parsed = _NetworkFile.from_bytes(data, file)
    return built(lambda: parsed.network(Path(file).parent, plausible), file)


def network_to_bytes(network: Network) -> bytes:
    """The bytes of the network's file: the same network gives the same bytes."""
    return _NetworkFile.of(network).to_bytes()


def read_network(path: str | Path) -> Network:
    """Read a network file, JSON or TOML.

    Raises
    ------
    InputError
        If the file cannot be read, or cannot be meant: edges that lead nowhere, names that come
        twice, parts that are not connected, implausible lines. All that is wrong is listed.

    Examples
    --------
    >>> read_network("absent.network.json")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.network.json: does not exist; check the path
    """
    return _network(read_bytes(path), path, plausible=True)


def write_network(network: Network, path: str | Path) -> None:
    """Write a network file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (Node("St. Gallen"), Node("Wil"))
    >>> network = Network("one", nodes, (Edge("only", line, "St. Gallen", "Wil"),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_network(network, Path(folder) / "one.network.json")
    ...     trainlog.read_line(f"{folder}/one.network.json#Wil,St. Gallen").name
    'Wil - St. Gallen'
    """
    check_written(network, Network)
    write_bytes(path, _NetworkFile.of(network).bytes_for(path))


def route_of_path(path: str | Path) -> tuple[Path, tuple[str, ...]] | None:
    """The file and the places of a route that a path names; None if it names a file.

    Examples
    --------
    >>> route_of_path("my.network.json#Wil, Gossau")
    (PosixPath('my.network.json'), ('Wil', 'Gossau'))
    >>> route_of_path("my.line.json") is None
    True
    """
    text = str(path)
    file, mark, places = text.partition("#")
    if not mark or not file.lower().endswith((".json", ".toml")) or Path(text).exists():
        return None
    separator = ";" if ";" in places else ","
    return Path(file), tuple(each.strip() for each in places.split(separator) if each.strip())
