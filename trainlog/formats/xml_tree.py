"""XML files as trees of elements that know their line; without entities, so that none can grow."""

from __future__ import annotations

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from xml.parsers import expat

import numpy as np

from trainlog.errors import InputError
from trainlog.formats.files import read_bytes
from trainlog.formats.tracks import not_in_file
from trainlog.units import KMH


@dataclass(eq=False)
class Element:
    """An element of an XML file.

    Attributes
    ----------
    tag : str
        Without its namespace.
    namespace : str
    attributes : dict of str to str
    line : int
        At which it begins.
    children : list of Element
    """

    tag: str
    namespace: str
    attributes: dict[str, str]
    line: int
    children: list[Element] = field(default_factory=list)

    def __repr__(self) -> str:
        return f"<{self.tag}> at line {self.line}, {len(self.children)} children"

    @property
    def place(self) -> str:
        """Where it stands, as errors state it."""
        own = self.attributes.get("id")
        return f"line {self.line}, {self.tag}" + (f" '{own}'" if own else "")

    def all(self, *path: str) -> Iterator[Element]:
        """Descendants by the tags that lead to them."""
        if not path:
            yield self
            return
        for child in self.children:
            if child.tag == path[0]:
                yield from child.all(*path[1:])

    def first(self, *path: str) -> Element | None:
        """The first of `all`, if there is one."""
        return next(self.all(*path), None)

    def every(self) -> Iterator[Element]:
        """The element and all that stand in it, in the order of the file."""
        todo = [self]
        while todo:
            element = todo.pop()
            yield element
            todo += reversed(element.children)

    def text(self, name: str, default: str = "") -> str:
        """An attribute, stripped."""
        return self.attributes.get(name, default).strip()

    def error(self, problem: str, remedy: str | None = None) -> InputError:
        """What is wrong with the element, with its place."""
        return InputError(problem, place=self.place, remedy=remedy)

    def number(self, name: str, default: float | None = None) -> float:
        """An attribute as a finite number.

        Raises
        ------
        InputError
            If it is none, or missing without a default.
        """
        found = self.text(name)
        if not found and default is not None:
            return default
        try:
            value = float(found)
        except ValueError:
            value = np.nan
        if not np.isfinite(value):
            problem = f"{name} '{found}' is not a finite number" if found else f"has no {name}"
            raise self.error(problem, f"give {name} as a number")
        return value

    def speed(self, name: str) -> float:
        """An attribute in km/h that must be positive, as a speed limit [m/s]."""
        found = self.number(name)
        if found <= 0.0:
            raise self.error(f"{name} 0 could never be passed", "give the permitted speed")
        return found / KMH

    def missing(self, what: str, name: str) -> InputError:
        """The error for a reference to something that the file does not have."""
        return not_in_file(what, name, self.place)


def numbers_in(containers: Iterable[Element], held: Collection[str]) -> Counter[str]:
    """Numbers of what stands in containers whose tags are not among `held`, by tag."""
    counts = Counter[str]()
    for each in containers:
        if each.tag not in held:
            counts[each.tag] += len(each.children)
    return counts


def read_xml(path: str | Path) -> Element:
    """The root element of an XML file.

    Raises
    ------
    InputError
        If the file cannot be read, is no XML, or declares entities.

    Examples
    --------
    >>> import tempfile
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     file = Path(folder) / "small.xml"
    ...     _ = file.write_text('<a xmlns="urn:x"><b n="2"/></a>')
    ...     root = read_xml(file)
    >>> root.tag, root.namespace, root.first("b").number("n")
    ('a', 'urn:x', 2.0)
    """
    parser = expat.ParserCreate(namespace_separator=" ")
    top = Element("", "", {}, 0)
    open_elements = [top]

    def start(name: str, attributes: dict[str, str]) -> None:
        namespace, _, tag = name.rpartition(" ")
        plain = {key.rpartition(" ")[2]: value for key, value in attributes.items()}
        element = Element(tag, namespace, plain, parser.CurrentLineNumber)
        open_elements[-1].children.append(element)
        open_elements.append(element)

    def end(_: str) -> None:
        open_elements.pop()

    def entity(name: str, *_: Any) -> None:
        raise InputError(
            f"declares the entity '{name}'",
            file=path,
            place=f"line {parser.CurrentLineNumber}",
            remedy="remove it: a file that grows while it is read is refused",
        )

    parser.StartElementHandler = start
    parser.EndElementHandler = end
    parser.EntityDeclHandler = entity
    try:
        parser.Parse(read_bytes(path), True)
    except expat.ExpatError as error:
        raise InputError(
            f"is no XML: {expat.ErrorString(error.code)}",
            file=path,
            place=f"line {error.lineno}, column {error.offset + 1}",
            remedy="export it again; it may have been cut off",
        ) from error
    return top.children[0]
