"""Which code a result of an analysis belongs to."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING

from trainlog.formats.files import sha256
from trainlog.version import code_version, code_version_of

if TYPE_CHECKING:
    from analysis.fleet.analyses import FleetAnalysis
    from trainlog.catalogue import Computation

_WORK = "analysis.fleet.work"
"""Module from which all code is imported that a registered analysis runs through."""


def code_of(analysis: FleetAnalysis) -> str:
    """Version of the code of an analysis: of all modules that it can run through, and of no other.

    What draws, reports, plans or keeps results may change without results being computed anew. Of
    an analysis that is not a part of trainlog: of its own file, and all of trainlog.

    Examples
    --------
    >>> from analysis.fleet.analyses import ANALYSES
    >>> code_of(ANALYSES["checks"]) == code_version_of("analysis.fleet.work")
    True
    """
    module = analysis.run.__module__
    if module.partition(".")[0] in ("analysis", "trainlog"):
        return code_version_of(_WORK)
    file = getattr(sys.modules.get(module), "__file__", None)
    own = Path(file).read_bytes() if file else b""
    return sha256(code_version().encode() + own)[:16]


def computation_of(analysis: FleetAnalysis) -> Computation:
    """The analysis by its present code, as a catalogue keeps what it gives."""
    from trainlog.catalogue import Computation

    return Computation(analysis.name, code_of(analysis), analysis.parameters)
