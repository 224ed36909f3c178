"""Running resistance from coasting, where no efforts were recorded.

`coast_down` finds where trips coasted and fits the running resistance over inertia;
`coast_down_logs` does it for files.
"""

from analysis.coast_down.logs import CoastDowns, coast_down_logs
from analysis.coast_down.together import CoastDown, coast_down

__all__ = ["CoastDown", "CoastDowns", "coast_down", "coast_down_logs"]
