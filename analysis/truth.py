"""How far estimates are from the truth of simulated trips.

A simulated trip carries its truth beside what the sensors saw. No analysis reads it; it serves to
judge them. Truth belongs to a trip by what was recorded, never by its name.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np

from trainlog.arrays import FloatArray
from trainlog.errors import InputError, LogError, TrainlogError
from trainlog.formats.files import sha256_of
from trainlog.formats.railway import line_of, train_of
from trainlog.identity import SHARED, TripIdentity
from trainlog.mcap import read_log
from trainlog.mcap.reader import identity_of_log
from trainlog.railway import RunningResistance, StepProfile, TrackConditionMap
from trainlog.railway.resistance import TERMS
from trainlog.trip import SCENARIO_ATTACHMENT, Trip

SLOWEST = 5.0
"""Drag curves are compared from this speed [m/s] up."""


@dataclass(frozen=True, eq=False)
class Truth:
    """What a simulated trip truly was.

    Attributes
    ----------
    trip, line, train, weather : str
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
    line: str
    train: str
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
    """The truth of a simulated trip; None for a recorded one.

    Raises
    ------
    LogError
        If what the trip carries is not the truth of a simulation, or it lacks its line or train.
    """
    data = trip.attachments.get(SCENARIO_ATTACHMENT)
    if data is None:
        return None
    line, train = line_of(trip), train_of(trip)

    def profile(name: str) -> StepProfile:
        return StepProfile(np.array(stated[name]["positions"]), np.array(stated[name]["values"]))

    try:
        stated = json.loads(data)
        return Truth(
            trip=trip.name,
            line=line.name,
            train=train.name,
            weather=stated["weather"],
            mass=stated["mass"],
            resistance=RunningResistance.of(stated[name] for name in TERMS),
            max_power=stated["max_power"],
            maximum_adhesion=profile("maximum_adhesion"),
            top_speed=min(float(line.speed_limits.values.max()), train.max_speed),
            lasting_adhesion=profile("lasting_adhesion") if "lasting_adhesion" in stated else None,
        )
    except (ValueError, TypeError, KeyError) as error:
        raise LogError(
            f"trip '{trip.name}': its truth cannot be read",
            place=SCENARIO_ATTACHMENT,
            remedy="simulate the trip again",
        ) from error


@dataclass(frozen=True, eq=False)
class SimulatedLogs:
    """The truth of the simulated trips among logs, found by what was recorded.

    Attributes
    ----------
    logs : sequence of path

    Examples
    --------
    >>> from pathlib import Path
    >>> log = Path("sample_logs/nonstop.mcap")
    >>> known = SimulatedLogs([log])
    >>> known.truth(sha256_of(log)).mass > 120e3, known.truth("of another log")
    (True, None)
    """

    logs: Sequence[Path]

    @cached_property
    def _truths(self) -> dict[Path, Truth]:
        """What a simulation knows is attached: no topic has to be read for it."""
        found = {}
        for log in self.logs:
            try:
                truth = truth_of(read_log(log, topics=[]))
            except TrainlogError:  # such a log has no truth by which anything could be judged
                continue
            if truth is not None:
                found[log] = truth
        return found

    @cached_property
    def _by_digest(self) -> dict[str, Truth]:
        return {sha256_of(log): truth for log, truth in self._truths.items()}

    @cached_property
    def _by_drive(self) -> list[tuple[TripIdentity, Truth]]:
        every = ((identity_of_log(log), truth) for log, truth in self._truths.items())
        return [(identity, truth) for identity, truth in every if identity is not None]

    def truth(self, sha256: str, identity: TripIdentity | None = None) -> Truth | None:
        """The truth of a log, or of the drive where it is a copy; None if it is not among these.

        Parameters
        ----------
        sha256 : str
            Of the log; empty if it is not known.
        identity : TripIdentity, optional
            Of the drive.
        """
        if not self._truths:
            return None
        truth = self._by_digest.get(sha256)
        if truth is not None or identity is None:
            return truth
        return next((t for own, t in self._by_drive if own.shared(identity) > SHARED), None)


def curve_error(found: RunningResistance, truth: Sequence[Truth]) -> float:
    """Root mean square of the relative error of a drag curve against the mean of true ones.

    Speeds reach up to the lowest of the top speeds.

    Raises
    ------
    InputError
        If no truth is given.
    """
    if not truth:
        raise InputError(
            "no truth is given to judge the drag curve by", remedy="give simulated trips"
        )
    speeds = min(truth, key=lambda each: each.top_speed).speeds
    true = np.mean([each.resistance(speeds) for each in truth], axis=0)
    return float(np.sqrt(np.mean((found(speeds) / true - 1.0) ** 2)))


def true_adhesion(track: TrackConditionMap, layer: str, truths: Iterable[Truth]) -> FloatArray:
    """True maximum adhesion per bin: the logarithmic mean over the layer's trips, (bins,).

    Raises
    ------
    InputError
        If no trip of the layer is among them.
    """
    # A few points a bin, so that a profile with its own steps is averaged over the bin.
    shares = (np.arange(5) + 0.5) / 5.0
    positions = np.minimum(
        (np.arange(track.bins)[:, None] + shares) * track.bin_length, track.length
    )
    logs = [np.log(t.maximum_adhesion(positions)) for t in truths if t.weather == layer]
    if not logs:
        raise InputError(
            f"no truth is given of a trip in the condition '{layer}'",
            remedy="give simulated trips of that rail condition",
        )
    return np.asarray(np.exp(np.mean(logs, axis=(0, 2))))


def map_error(track: TrackConditionMap, truths: Sequence[Truth]) -> tuple[float, int]:
    """Root mean square error of maximum adhesion in the bins with slip events, and their number.

    Of the layers of which the truth of a trip is given.

    Raises
    ------
    InputError
        If there is none, or no bin of them has slip events.
    """
    known = {truth.weather for truth in truths}
    errors = [
        (layer.maximum_adhesion - true_adhesion(track, name, truths))[layer.events > 0]
        for name, layer in track.layers.items()
        if name in known
    ]
    together = np.concatenate([np.zeros(0), *errors])
    if not together.size:
        raise InputError(
            "no bin with slip events is of a rail condition whose truth is given",
            remedy="give the simulated trips that the map was made from",
        )
    return float(np.sqrt(np.mean(together**2))), together.size
