"""Two sides of a comparison: which code, with which parameters, computes the trips of a fleet."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
import tarfile
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TYPE_CHECKING, Any

from analysis.fleet.analyses import ANALYSES, analyses_named
from analysis.fleet.codes import code_of, computation_of
from trainlog.catalogue import Computation
from trainlog.errors import InputError
from trainlog.progress import note

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue

PRESENT = "now"
"""Names the code that runs."""

_ARCHIVED = ("trainlog", "analysis", "estimators", "sample_logs")
"""Folders of a revision that are needed to compute trips."""

_STATED = (
    "import json; from analysis.fleet.analyses import ANALYSES;"
    " from analysis.fleet.codes import code_of;"
    " print(json.dumps({'codes': {name: code_of(each) for name, each in ANALYSES.items()},"
    " 'parameters': {name: dict(each.parameters) for name, each in ANALYSES.items()}}))"
)
"""What another installation is asked for: its version and the parameters of its analyses."""

_DIGEST = re.compile(r"[0-9a-f]{6,16}")


@dataclass(frozen=True)
class Version:
    """What computes the trips on one side of a comparison.

    Attributes
    ----------
    name : str
        As it was asked for.
    computations : mapping of str to Computation
        Of each analysis that it has, as results are recorded.
    command : tuple of str
        That runs its trainlog; empty for the code that runs, and where nothing can be run.
    environment : mapping of str to str
        With which.
    present : bool
        Whether it is the code that runs.
    """

    name: str
    computations: Mapping[str, Computation]
    command: tuple[str, ...] = ()
    environment: Mapping[str, str] = field(default_factory=dict)
    present: bool = False

    def __str__(self) -> str:
        if "=" in self.name:  # the code that runs, as on the other side: the parameters differ
            return self.name
        known = ", ".join(sorted({each.code for each in self.computations.values()}))
        return known if known.startswith(self.name) else f"{self.name} ({known})"


@contextmanager
def opened_version(name: str, catalogue: Catalogue) -> Iterator[Version]:
    """One side of a comparison, by its name; what is unpacked for it lasts as long as the context.

    Parameters
    ----------
    name : str
        ``now``; parameters of the code that runs (``adhesion.bin_length=50``, several divided by
        commas); a folder with another checkout, or the Python of another environment; the
        beginning of a version of which the catalogue has results; or a revision of the repository
        in which the present code stands.
    catalogue : Catalogue

    Raises
    ------
    InputError
        If it is none of these, or cannot be run.
    """
    found = _here(name, catalogue)
    if found is not None:
        yield found
        return
    with tempfile.TemporaryDirectory(prefix="trainlog-version-") as scratch:
        yield _elsewhere(name, Path(scratch))


def _here(name: str, catalogue: Catalogue) -> Version | None:
    """A version that needs no other code, or whose results are there."""
    if name == PRESENT or "=" in name:
        own = {each: computation_of(analysis) for each, analysis in ANALYSES.items()}
        for each, values in parameters_of(name if "=" in name else "").items():
            own[each] = computation_of(ANALYSES[each].with_parameters(**values))
        return Version(name, own, present=True)
    if not _DIGEST.fullmatch(name) or Path(name).exists():
        return None
    made = catalogue.computations()
    made = made[made["code"].str.startswith(name)]
    codes = sorted(set(made["code"]))
    if len(codes) > 1:
        raise InputError(
            f"'{name}' begins the versions {' and '.join(codes)}", remedy="give more of its digits"
        )
    if not codes:
        return None
    first = made.drop_duplicates("analysis")
    about = first[["analysis", "code", "parameters"]].to_numpy().tolist()
    latest = {each[0]: Computation(*each) for each in about}
    present = {each: code_of(ANALYSES[each]) if each in ANALYSES else "" for each in latest}
    return Version(name, latest, present=set(present.values()) == set(codes))


def parameters_of(text: str) -> dict[str, dict[str, Any]]:
    """Parameters of analyses, as they are typed.

    Raises
    ------
    InputError
        If it is no list of ``analysis.parameter=value``.

    Examples
    --------
    >>> parameters_of("adhesion.bin_length=50, resistance.speeds=[5, 40]")
    {'adhesion': {'bin_length': 50}, 'resistance': {'speeds': [5, 40]}}
    """
    found: dict[str, dict[str, Any]] = {}
    for part in filter(None, re.split(r",\s*(?=\w+\.\w+=)", text.strip())):
        match = re.fullmatch(r"(\w+)\.(\w+)=(.*)", part.strip())
        if match is None:
            raise InputError(
                f"'{part}' is no parameter of an analysis",
                remedy="write analysis.parameter=value, such as adhesion.bin_length=50",
            )
        analysis, parameter, value = match.groups()
        analyses_named([analysis])
        try:
            given = json.loads(value)
        except json.JSONDecodeError:
            given = value
        found.setdefault(analysis, {})[parameter] = given
    return found


def _elsewhere(name: str, scratch: Path) -> Version:
    """A version of code that stands in another place, or in the repository's history."""
    path = Path(name).expanduser()
    if path.is_dir():
        if not (path / "trainlog" / "version.py").is_file():
            raise InputError(
                "holds no code of trainlog", file=path, remedy="name the folder of a checkout"
            )
        return _asked(name, sys.executable, path.resolve(), scratch)
    if path.is_file():
        return _asked(name, str(path.absolute()), None, scratch)
    checkout = Path(__file__).parents[2]
    archived = _git(checkout, "archive", "--format=tar", name, "--", *_ARCHIVED)
    if archived is None:
        raise InputError(
            f"'{name}' is no version: no path, no revision of {checkout}, and the catalogue has no"
            " results of code that begins so",
            remedy=f"give '{PRESENT}', parameters (analysis.parameter=value), a checkout, the"
            " Python of an environment, a revision, or a version of results",
        )
    with tarfile.open(fileobj=BytesIO(archived)) as tar:
        tar.extractall(scratch / "code", filter="data")
    return _asked(name, sys.executable, scratch / "code", scratch)


def _git(folder: Path, *words: str) -> bytes | None:
    """What git prints; None if it refuses, or is not there."""
    try:
        done = subprocess.run(["git", "-C", str(folder), *words], capture_output=True, check=False)
    except OSError:
        return None
    return done.stdout if done.returncode == 0 else None


def _asked(name: str, python: str, checkout: Path | None, scratch: Path) -> Version:
    """The version of other code, which states itself what it is."""
    environment = {each: value for each, value in os.environ.items() if each != "PYTHONPATH"}
    environment |= {"PYTHONDONTWRITEBYTECODE": "1", "PYTHONSAFEPATH": "1"}
    # What was compiled is known by the file of a function alone, not by what it calls.
    environment["NUMBA_CACHE_DIR"] = str(scratch / "compiled")
    if checkout is not None:
        environment["PYTHONPATH"] = str(checkout)
    try:
        done = subprocess.run(
            [python, "-c", _STATED], env=environment, capture_output=True, text=True, check=False
        )
    except OSError as error:
        raise InputError(f"cannot be run: {error.strerror}", file=python) from error
    if done.returncode:
        raise InputError(
            f"'{name}' cannot compute a fleet: {_last_line(done.stderr)}",
            remedy="it must be a version of trainlog that has 'trainlog fleet update'",
        )
    stated = json.loads(done.stdout.splitlines()[-1])
    command = (python, "-m", "trainlog")
    known = {
        each: Computation(each, code, stated["parameters"][each])
        for each, code in stated["codes"].items()
    }
    return Version(name, known, command, environment)


def _last_line(text: str) -> str:
    lines = [line.strip() for line in text.splitlines() if line.strip()]
    return lines[-1] if lines else "it states no reason"


def ensure_results(
    version: Version,
    catalogue: Catalogue,
    place: str,
    analyses: Sequence[str],
    where: str | None = None,
    workers: int | None = None,
) -> None:
    """Compute what is not there yet of the trips on one side of a comparison.

    Parameters
    ----------
    version : Version
    catalogue : Catalogue
    place : str
        As another process opens the catalogue: a folder, or a URL.
    analyses : sequence of str
        Names.
    where : str, optional
        As for `Catalogue.query`.
    workers : int, optional

    Raises
    ------
    InputError
        If the other version cannot compute it.
    """
    missing = [
        name for name in analyses if len(catalogue.pending(version.computations[name], where=where))
    ]
    if not missing:
        return
    note(str(version))
    if version.present:
        from analysis.fleet.update import UpdateOptions, update_fleet

        asked = [
            ANALYSES[name].with_parameters(**version.computations[name].parameters)
            for name in missing
        ]
        update_fleet(catalogue, asked, UpdateOptions(workers, where=where))
        return
    if not version.command:
        raise InputError(
            f"the catalogue has no results of {version} for all of the trips",
            remedy="name its checkout or revision, so that they can be computed, or fewer trips",
        )
    words = [*version.command, "fleet", "update", "--catalogue", place, "--quiet"]
    words += [word for name in missing for word in ("--analysis", name)]
    words += [] if where is None else ["--trips", where]
    words += [] if workers is None else ["--workers", str(workers)]
    done = subprocess.run(
        words, env=dict(version.environment), capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, 1):
        raise InputError(f"{version} could not compute the trips: {_last_line(done.stderr)}")
