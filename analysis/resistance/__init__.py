"""Running resistance and mass, identified from trips.

`fit_trip` fits one trip, `combine` all of them, `parameter_set` makes the observed configurations
that a robust trajectory is computed for; `fit_logs` does all three for files.
"""

from analysis.resistance.combination import CommonFit, combine, parameter_set
from analysis.resistance.fit import TripFit, estimated_resistance, fit_trip
from analysis.resistance.logs import Fits, fit_logs

__all__ = [
    "CommonFit",
    "Fits",
    "TripFit",
    "combine",
    "estimated_resistance",
    "fit_logs",
    "fit_trip",
    "parameter_set",
]
