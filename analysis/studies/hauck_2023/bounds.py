"""What no driver can do better on a rail: lateness, and distance from a reference."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from analysis.studies.hauck_2023.run import AXLE_ADHESION, SHORTEST_DWELL, Plan, Run
from analysis.studies.hauck_2023.section import Section, fastest_unweighed, least_time

FloatArray = NDArray[np.float64]


def least_lateness(
    sections: Sequence[Section],
    mass: float,
    delay: float,
    least: Callable[[Section, float, float], float] = least_time,
) -> FloatArray:
    """Bound on how late [s] a train of one mass arrives that left the first stop late.

    From the least time of every section under (7), without any reserve, and the shortest dwell;
    below 0 where it could be early.

    Parameters
    ----------
    sections : sequence of Section
    mass : float [kg]
    delay : float [s]
    least : callable
        `least_time` or `least_time_unweighed`.
    """
    late, bound = delay, []
    for section in sections:
        bound.append(late + least(section, mass, _rotating(section)) - section.duration)
        planned = section.destination.departure - section.destination.arrival
        late = max(bound[-1] + SHORTEST_DWELL - planned, 0.0)
    return np.array(bound, dtype=np.float64)


def least_deviation(plan: Plan, run: Run) -> FloatArray:
    """Bound on the largest distance [m] from its reference, section by section.

    Of any driver who leaves when `run` did, does not know the mass, and arrives no later than the
    timetable or `run`, whichever is later. Nobody is faster anywhere than the fastest run; so
    nobody is ahead of it, nor behind the one like it that leaves as late as it may. What of the
    reference lies outside these two cannot be reached.

    Parameters
    ----------
    plan : tuple of Reference
        With the map of the rail that the train met.
    run : Run

    Returns
    -------
    (k,) array
        0 where the reference lies between them.
    """
    found = []
    for number, reference in enumerate(plan):
        section = reference.section
        begins, here = section.origin.departure, run.section == number
        fast = fastest_unweighed(section, run.mass, _rotating(section))
        time, aim = run.time[here] - begins, run.target[here, 0]
        leaves = run.departures[number] - begins
        arrives = max(section.duration, run.arrivals[number + 1] - begins, leaves + fast.duration)
        most = np.interp(time - leaves, fast.times, fast.positions)
        least = np.interp(time - (arrives - fast.duration), fast.times, fast.positions)
        found.append(max(float(np.max(aim - most)), float(np.max(least - aim)), 0.0))
    return np.array(found, dtype=np.float64)


def _rotating(section: Section) -> float:
    """Of the simulated train [kg]."""
    return section.train.on_axles(AXLE_ADHESION.size).rotating_mass
