"""Running resistance and mass, identified from trips.

`fit_trip` fits one trip, `summarised` keeps what is needed of it, `combine` takes all of them,
`parameter_set` makes the observed configurations that a robust trajectory is computed for;
`fit` does all of it for trips, logs and summaries.
"""

from analysis.resistance.combination import CommonFit, combine, summarised
from analysis.resistance.fit import TripFit, estimated_resistance, fit_trip
from analysis.resistance.logs import Fits
from analysis.resistance.observed import parameter_set
from analysis.resistance.recording import TripRefusedError

__all__ = [
    "CommonFit",
    "Fits",
    "TripFit",
    "TripRefusedError",
    "combine",
    "estimated_resistance",
    "fit_trip",
    "parameter_set",
    "summarised",
]
