"""Running resistance and mass, identified from trips.

`fit_trip` fits one trip, `summarised` keeps what is needed of it, `combine` takes all of them,
`parameter_set` makes the observed configurations that a robust trajectory is computed for;
`fit` does all of it for trips, logs and summaries.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from trainlog.extras import names_on_first_use

if TYPE_CHECKING:
    from analysis.resistance.combination import (
        CommonFit as CommonFit,
        combine as combine,
        summarised as summarised,
    )
    from analysis.resistance.fit import (
        TripFit as TripFit,
        estimated_resistance as estimated_resistance,
        fit_trip as fit_trip,
    )
    from analysis.resistance.logs import Fits as Fits
    from analysis.resistance.observed import parameter_set as parameter_set
    from analysis.resistance.recording import TripRefusedError as TripRefusedError

if not TYPE_CHECKING:  # type checkers refuse names that are not listed above
    __all__, __getattr__, __dir__ = names_on_first_use(__name__, __file__)
