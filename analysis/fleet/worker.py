"""Loads what the registered analyses run through, at once: imported by processes that compute.

The processes of `trainlog fleet update` are forked from one that has imported it; Dask's workers
do so where they are started with ``--preload analysis.fleet.worker``.
"""

from __future__ import annotations

import analysis.adhesion.condition_map
import analysis.adhesion.evidence
import analysis.fleet.checks
import analysis.fleet.driving
import analysis.fleet.work
import analysis.resistance.combination
import analysis.resistance.fit  # noqa: F401
