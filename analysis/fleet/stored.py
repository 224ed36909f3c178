"""Stored summaries of a catalogue's trips, which stand for their logs in a fit."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import pandas as pd

from analysis.fleet.analyses import ANALYSES
from analysis.fleet.codes import computation_of
from trainlog.formats.summaries import COLUMNS

if TYPE_CHECKING:
    from trainlog.catalogue import Catalogue


def stored_summaries(catalogue: Catalogue, where: str | None) -> tuple[pd.DataFrame, list[Path]]:
    """Summaries of trips that are stored, and the logs of those of which none is.

    Parameters
    ----------
    catalogue : Catalogue
    where : str or None
        As for `Catalogue.query`.

    Returns
    -------
    DataFrame
        Of the analysis "resistance" by the present code and its ordinary parameters, with the
        columns of `trainlog.formats.summaries.COLUMNS`.
    list of Path
        Of all other trips, whose logs must be read.

    Raises
    ------
    InputError
        As `Catalogue.paths`.
    """
    resistance = computation_of(ANALYSES["resistance"])
    paths = catalogue.paths(where)
    names = [column.name for column in COLUMNS]
    found = catalogue.results(resistance, where=where)
    if found.empty:
        return pd.DataFrame(columns=names), paths
    pending = catalogue.pending(resistance, where=where)
    unknown = {str(Path(path)) for path in pending["path"]}
    summaries = found[names]
    for column in COLUMNS:
        if column.kind == "text":
            summaries = summaries.assign(**{column.name: summaries[column.name].fillna("")})
    return summaries, [path for path in paths if str(path) in unknown]
