"""Running resistance and mass, identified from trips.

`fit_trip` fits one trip, `summarised` keeps what is needed of it, `combine` takes all of them,
`parameter_set` makes the observed configurations that a robust trajectory is computed for;
`fit_logs` does all of it for files.
"""

from analysis.resistance.combination import CommonFit, combine, summarised
from analysis.resistance.fit import TripFit, estimated_resistance, fit_trip
from analysis.resistance.logs import Fits, fit_logs
from analysis.resistance.observed import parameter_set
from analysis.resistance.recording import TripRefusedError

__all__ = [
    "CommonFit",
    "Fits",
    "TripFit",
    "TripRefusedError",
    "combine",
    "estimated_resistance",
    "fit_logs",
    "fit_trip",
    "parameter_set",
    "summarised",
]
