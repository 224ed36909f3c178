"""How far estimates are from the truth of simulated trips.

A simulated trip carries its truth beside what the sensors saw. No analysis reads it; it serves to
judge them.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.formats.attached import train_of
from trainlog.railway import RunningResistance, StepProfile, TrackConditionMap
from trainlog.trip import SCENARIO_ATTACHMENT, Trip

SLOWEST = 5.0
"""Drag curves are compared from this speed [m/s] up."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated trip truly was.

    Attributes
    ----------
    trip, weather : str
    mass : float [kg]
    resistance : RunningResistance
    max_power : float [W]
    maximum_adhesion : StepProfile
        Along the line in its own direction.
    top_speed : float [m/s]
        Of the line for this train.
    lasting_adhesion : StepProfile or None
        What lasts of the maximum adhesion in that weather, where the rail was drawn over days.
    """

    trip: str
    weather: str
    mass: float
    resistance: RunningResistance
    max_power: float
    maximum_adhesion: StepProfile
    top_speed: float
    lasting_adhesion: StepProfile | None = None

    @property
    def speeds(self) -> FloatArray:
        """Speeds at which drag curves are compared [m/s]."""
        return np.linspace(SLOWEST, self.top_speed, 60)


def truth_of(trip: Trip) -> Truth | None:
    """The truth of a simulated trip; None for a recorded one."""
    data = trip.attachments.get(SCENARIO_ATTACHMENT)
    if data is None:
        return None
    from trainlog.formats.attached import line_of

    stated = json.loads(data)

    def profile(name: str) -> StepProfile:
        return StepProfile(np.array(stated[name]["positions"]), np.array(stated[name]["values"]))

    return Truth(
        trip=trip.name,
        weather=stated["weather"],
        mass=stated["mass"],
        resistance=RunningResistance(stated["r0"], stated["r1"], stated["r2"]),
        max_power=stated["max_power"],
        maximum_adhesion=profile("maximum_adhesion"),
        top_speed=min(float(line_of(trip).speed_limits.values.max()), train_of(trip).max_speed),
        lasting_adhesion=profile("lasting_adhesion") if "lasting_adhesion" in stated else None,
    )


def curve_error(found: RunningResistance, truth: Sequence[Truth]) -> float:
    """Root mean square of the relative error of a drag curve against the mean of true ones."""
    speeds = truth[0].speeds
    true = np.mean([each.resistance(speeds) for each in truth], axis=0)
    return float(np.sqrt(np.mean((found(speeds) / true - 1.0) ** 2)))


def true_adhesion(track: TrackConditionMap, layer: str, truths: Iterable[Truth]) -> FloatArray:
    """True maximum adhesion a bin: the logarithmic mean over the layer's trips, (bins,)."""
    # A few points a bin, so that a profile with its own steps is averaged over the bin.
    shares = (np.arange(5) + 0.5) / 5.0
    positions = np.minimum(
        (np.arange(track.bins)[:, None] + shares) * track.bin_length, track.length
    )
    logs = [np.log(t.maximum_adhesion(positions)) for t in truths if t.weather == layer]
    return np.asarray(np.exp(np.mean(logs, axis=(0, 2))))


def map_error(track: TrackConditionMap, truths: Sequence[Truth]) -> tuple[float, int]:
    """Root mean square error of maximum adhesion in the bins with slip events, and their number."""
    errors = [
        (layer.maximum_adhesion - true_adhesion(track, name, truths))[layer.events > 0]
        for name, layer in track.layers.items()
    ]
    together = np.concatenate(errors)
    return float(np.sqrt(np.mean(together**2))), together.size
