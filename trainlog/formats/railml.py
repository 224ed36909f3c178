"""Infrastructure of railML 2 and 3 as a network; https://www.railml.org."""

from __future__ import annotations

from pathlib import Path

from trainlog.errors import InputError
from trainlog.formats import railml2, railml3
from trainlog.formats.declared import built
from trainlog.formats.tracks import EVERY_LIMIT, Infrastructure, LimitChoice
from trainlog.formats.xml_tree import Element, read_xml

VERSIONS = {
    "2009": "2.0",
    "2011": "2.1",
    "2013": "2.2",
    "2016": "2.3",
    "2018": "2.4",
    "2021": "2.5",
}
"""Versions of railML 2 by the year in their namespace."""


def read_railml(path: str | Path, limits: LimitChoice = EVERY_LIMIT) -> Infrastructure:
    """Read the infrastructure of a railML file, version 2 or 3, as a network.

    Tracks that follow each other without a choice are one edge. Stations are the operational points
    with a place on a track.

    Parameters
    ----------
    path : str or Path
    limits : LimitChoice, optional
        Which of its speed limits hold.

    Raises
    ------
    InputError
        If the file is no railML 2 or 3, has no infrastructure, or no limits of a category, or
        refers to what it does not have.

    Examples
    --------
    >>> read_railml("absent.xml")
    Traceback (most recent call last):
    trainlog.errors.InputError: absent.xml: does not exist; check the path
    """
    root = read_xml(path)
    version = version_of(root)
    if version is None:
        raise InputError(
            f"is no railML 2 or 3: its root is '{root.tag}'"
            + (f" of version {root.text('version')}" if root.text("version") else ""),
            file=path,
            remedy="export infrastructure as railML 2.2 to 2.5, or 3.1 to 3.3",
        )
    networks_of = railml2.networks_of if version.startswith("2") else railml3.networks_of
    return built(lambda: networks_of(root, version, Path(path).stem, limits), path)


def version_of(root: Element) -> str | None:
    """The version of railML that a file states, or that its namespace is of; None of others.

    Examples
    --------
    >>> version_of(Element("railml", "https://www.railml.org/schemas/2018", {}, 1))
    '2.4'
    """
    if root.tag.lower() != "railml":
        return None
    own = root.namespace.rstrip("/").rpartition("/")[2]
    version = root.text("version") or VERSIONS.get(own, own)
    return version if version.startswith(("2.", "3.")) else None
