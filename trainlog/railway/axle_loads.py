"""Load transfer between the powered axles: what efforts and gradients do to their loads.

A vehicle is pulled at the rails and held back at its couplers and its centre of gravity, higher up.
The moment lifts its leading axles and presses on its trailing ones. Bogie by bogie, the force on
its axles acts on the body at the height of the link between them, which tilts the bogie; and the
body tilts by what its couplers and its own inertia and weight downhill make of the rest. The loads
follow from the equilibrium of moments of bogies and body, as in textbooks of running dynamics
(Wende, D. (2003), Fahrdynamik des Schienenverkehrs; Steimel, A. (2014), Electric traction):

    bogie of force F_B:   dQ_i = -h_z F_B x_i / sum x_j²
    body of force F:      dQ   = -+((h_K - h_z) F + (h_S - h_K) m_v (a + g sin alpha)) / L

a bogie and an end, positive at the trailing one. `x_i` is an axle's distance ahead of the bogie's
middle, `L` the distance of the pivots, `h_z`, `h_K`, `h_S` the heights of link, coupler and centre
of gravity, `m_v` the vehicle's mass. ``a + g sin alpha`` is what an accelerometer along the track
shows: on a gradient that a train climbs steadily, all of it is the gradient.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np
from numpy.typing import ArrayLike

from trainlog.arrays import FloatArray
from trainlog.declaration import NOT_NEGATIVE, POSITIVE, Declared, Must, Quantity, Whole
from trainlog.errors import InputError

LEAST_LOAD = 0.05
"""Share of its static load that an axle keeps at least: a wheel does not lift off."""


TWO_OR_MORE = Must("is less than 2", "a bogie has two axles at least", low=2.0)
ONE_OR_TWO = Must("is not 1 or 2", "a vehicle has one or two powered bogies", low=1.0, high=2.0)


def _length(low: float, high: float, whose: str, must: Must = NOT_NEGATIVE) -> Quantity:
    """A length [m] with its plausible range."""
    return Quantity("m", "m", (low, high, whose), must=must)


@dataclass(frozen=True, slots=True)
class AxleGeometry(Declared):
    """Where the powered axles of a train stand, and how high the forces act on their vehicles.

    The axles are counted from the front in the direction of travel. A vehicle of one powered bogie
    has it at the outer end of the train: leading in the first half of them, trailing in the second.

    Attributes
    ----------
    wheelbase : float [m]
        Between the first and the last axle of a bogie.
    pivot_distance : float [m]
        Between the two bogies of a vehicle.
    link_height : float [m]
        Of the link that pulls the body, above the rail; low links transfer less load.
    coupler_height, centre_height : float [m]
        Of the couplers, and of the vehicle's centre of gravity.
    axles_per_bogie : int
    powered_bogies : int
        Of each powered vehicle, 1 or 2.

    Raises
    ------
    InputError
        If a length is not positive, or the counts cannot be.

    Examples
    --------
    >>> AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6).axles_per_bogie
    2
    """

    wheelbase: Annotated[float, _length(1, 6, "bogies have", POSITIVE)]
    pivot_distance: Annotated[float, _length(3, 25, "vehicles have", POSITIVE)]
    link_height: Annotated[float, _length(0.05, 2, "bodies are pulled at")]
    coupler_height: Annotated[float, _length(0.3, 2, "couplers are at")]
    centre_height: Annotated[float, _length(0.5, 3, "vehicles have their mass at")]
    axles_per_bogie: Annotated[int, Whole(must=TWO_OR_MORE, stated="written")] = 2
    powered_bogies: Annotated[int, Whole(must=ONE_OR_TWO, stated="written")] = 2

    def vehicles(self, axles: int) -> int:
        """Number of powered vehicles that `axles` powered axles make.

        Raises
        ------
        InputError
            If they do not fill whole vehicles.

        Examples
        --------
        >>> AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6).vehicles(8)
        2
        """
        each = self.axles_per_bogie * self.powered_bogies
        if axles % each:
            raise InputError(
                f"{axles} powered axles are not whole vehicles of {self.powered_bogies} powered"
                f" bogies with {self.axles_per_bogie} axles",
                remedy="correct count, axles_per_bogie or powered_bogies",
            )
        return axles // each


def load_transfer(geometry: AxleGeometry, axles: int, adhesive_mass: float) -> FloatArray:
    """Change of the axle loads for each newton at an axle, and for the specific force.

    Parameters
    ----------
    geometry : AxleGeometry
    axles : int
        Powered axles of the train.
    adhesive_mass : float [kg]
        That rests on all of them, loaded.

    Returns
    -------
    (axles, axles + 1) array [1], [kg]
        Row i: how the load of axle i [N] changes with the forces between rail and axles [N],
        positive in traction, and, in the last column, with ``a + g sin alpha`` [m/s²].

    Raises
    ------
    InputError
        If the axles do not fill whole vehicles.

    Examples
    --------
    A locomotive of four axles that pulls with 60 kN at each: the leading axle loses most.

    >>> transfer = load_transfer(AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6), 4, 84e3)
    >>> (transfer[:, :4] @ np.full(4, 60e3) / 1e3).round(1).tolist()
    [-32.0, 21.3, -21.3, 32.0]
    """
    g, vehicles = geometry, geometry.vehicles(axles)
    m, bogies = g.axles_per_bogie, g.powered_bogies
    mass = adhesive_mass / vehicles * (2 / bogies)
    ahead = np.linspace(0.5, -0.5, m) * g.wheelbase
    tilt = -np.outer(ahead / np.sum(ahead**2), np.full(m, g.link_height))
    transfer = np.zeros((axles, axles + 1))
    for vehicle in range(vehicles):
        body = slice(vehicle * m * bogies, (vehicle + 1) * m * bogies)
        for bogie in range(bogies):
            rows = slice(body.start + bogie * m, body.start + (bogie + 1) * m)
            leads = bogie == 0 if bogies == 2 else vehicle < vehicles / 2
            share = (-1.0 if leads else 1.0) / (g.pivot_distance * m)
            transfer[rows, body] += share * (g.coupler_height - g.link_height)
            transfer[rows, -1] = share * (g.centre_height - g.coupler_height) * mass
            transfer[rows, rows] += tilt
    return transfer


def axle_loads(
    transfer: FloatArray, static: ArrayLike, forces: ArrayLike, specific_force: ArrayLike
) -> FloatArray:
    """Loads of the axles [N], at least `LEAST_LOAD` of the static ones.

    Parameters
    ----------
    transfer : (axles, axles + 1) array
        Of `load_transfer`.
    static : float or (axles,) array [N]
        Loads of the train at rest on the level.
    forces : (..., axles) array [N]
        Between rail and axles, positive in traction.
    specific_force : (...) array [m/s²]
        Acceleration and what the gradient takes: ``a + g sin alpha``.

    Examples
    --------
    >>> transfer = load_transfer(AxleGeometry(2.7, 9.0, 0.6, 1.0, 1.6), 4, 84e3)
    >>> loads = axle_loads(transfer, 206e3, np.full(4, 60e3), 0.3)
    >>> (loads / 1e3).round(1).tolist(), round(float(loads.sum()) / 1e3)
    ([173.2, 226.5, 185.5, 238.8], 824)
    """
    pull, force = np.asarray(forces, dtype=np.float64), np.asarray(specific_force)
    changed = np.asarray(static) + pull @ transfer[:, :-1].T + force[..., None] * transfer[:, -1]
    return np.asarray(np.maximum(changed, LEAST_LOAD * np.asarray(static)))
