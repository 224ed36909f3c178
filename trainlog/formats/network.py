"""The file of a network, ``"trainlog/network"``; docs/formats.md describes its keys.

They follow from the declaration of `Network`. Beside it, an edge may name the file of its line.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

from trainlog.declaration import from_content, gathered, placed
from trainlog.errors import InputError
from trainlog.formats.declared import body_of, built, read_thing, write_thing
from trainlog.formats.files import read_bytes
from trainlog.railway.line import Line
from trainlog.railway.network import Network


def network_from_bytes(data: bytes, *, file: str | Path = "network.json") -> Network:
    """The network in the bytes of a network file; `file` is what errors call it.

    Files of lines that it names are looked for beside `file`.

    Raises
    ------
    InputError
        If they are not a network file, naming the place and the remedy.
    """
    return _network(data, file, judged=False)


def _network(data: bytes, file: str | Path, judged: bool) -> Network:
    body = body_of(Network, data, file)
    return built(lambda: from_content(Network, _with_lines(body, Path(file).parent), judged), file)


def _with_lines(body: dict[str, Any], folder: Path) -> dict[str, Any]:
    """What a network's file states, with each edge's line and name, wherever they stand."""
    edges = body.get("edges")
    if not isinstance(edges, list):
        return body

    def whole(number: int) -> Any:
        try:
            return _edge(edges[number], folder)
        except InputError as error:
            raise InputError.listing(placed(error, f"edges[{number}]")) from error

    return body | {
        "edges": gathered(*(lambda number=number: whole(number) for number in range(len(edges))))
    }


def _edge(edge: Any, folder: Path) -> Any:
    """An edge with its line, from a file if one is named, and the line's name if it has none."""
    if not isinstance(edge, dict):
        return edge
    rest = {key: value for key, value in edge.items() if key != "file"}
    line, file = rest.get("line"), edge.get("file")
    if (line is None) == (file is None):
        raise InputError(
            "needs either a line or the file of one", remedy="give one of 'line' and 'file'"
        )
    if file is not None:
        line = rest["line"] = read_thing(Line, folder / str(file))
    if rest.get("name") is None:
        rest["name"] = line.name if isinstance(line, Line) else _name_of(line)
    return rest


def _name_of(line: Any) -> Any:
    return line.get("name") if isinstance(line, dict) else None


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
    return _network(read_bytes(path), path, judged=True)


def write_network(network: Network, path: str | Path) -> None:
    """Write a network file, whole or not at all; as TOML if its name ends so.

    Examples
    --------
    >>> from pathlib import Path
    >>> import tempfile
    >>> import trainlog
    >>> from trainlog import Edge, Node
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (Node("St. Gallen"), Node("Wil"))
    >>> network = Network("one", nodes, (Edge("only", line, "St. Gallen", "Wil"),))
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     write_network(network, Path(folder) / "one.network.json")
    ...     trainlog.read_line(f"{folder}/one.network.json#Wil,St. Gallen").name
    'Wil - St. Gallen'
    """
    write_thing(network, path, Network)


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
