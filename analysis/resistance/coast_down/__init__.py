"""Running resistance from coasting, where no efforts were recorded.

`coast_down` finds where trips coasted and fits the running resistance over inertia on the line's
gradients; `coast_down_without_gradient` tells what can be told where they are not known.
`coast_down_logs` and `coast_down_logs_without_gradient` do it for files.
"""

from analysis.resistance.coast_down.logs import (
    CoastDowns,
    coast_down_logs,
    coast_down_logs_without_gradient,
)
from analysis.resistance.coast_down.together import CoastDown, coast_down
from analysis.resistance.coast_down.unknown_gradient import coast_down_without_gradient

__all__ = [
    "CoastDown",
    "CoastDowns",
    "coast_down",
    "coast_down_logs",
    "coast_down_logs_without_gradient",
    "coast_down_without_gradient",
]
