"""From recorded trips to the observed parameter set, with what it was made from."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

from analysis.resistance.combination import CommonFit, combine, parameter_set
from analysis.resistance.fit import TripFit, fit_trip
from trainlog import __version__
from trainlog.errors import NotIdentifiableError
from trainlog.formats.attached import train_of
from trainlog.formats.files import sha256_of
from trainlog.mcap.stretches import stretches
from trainlog.railway.configuration import ParameterSet
from trainlog.railway.train import Train

TOPICS = ("/train/state", "/train/controls", "/train/axles", "/gnss/motion")
"""What is read of each log."""


@dataclass(frozen=True, eq=False)
class Fits:
    """What a set of logs says about a train's running resistance.

    Attributes
    ----------
    trips : tuple of TripFit
        Accepted, by name.
    refused : dict of str to str
        Trips that do not determine the curve, and why.
    common : CommonFit
    parameters : ParameterSet
        The observed configurations, ready to be written.
    """

    trips: tuple[TripFit, ...]
    refused: dict[str, str]
    common: CommonFit
    parameters: ParameterSet


def fit_logs(logs: Iterable[Path], speeds: tuple[float, float] | None = None) -> Fits:
    """Fit each log, then all of them together.

    A log too long for the memory is fitted in stretches, each an observation of its own: over
    days the load and the weather change.

    Parameters
    ----------
    logs : iterable of path
        Read one after the other.
    speeds : (float, float) [m/s], optional
        Speeds between which the curve is asked for; see `fit_trip`.

    Raises
    ------
    NotIdentifiableError
        If no log determines the curve.
    LogError
        If a file is not a log, or a trip lacks its line or its train.
    InputError
        If the logs are of different trains, or a trip appears twice.
    """
    trips: list[TripFit] = []
    refused: dict[str, str] = {}
    digests: dict[str, str] = {}
    train: Train | None = None
    for path in logs:
        digest = sha256_of(path)
        for stretch in stretches(path, TOPICS):
            trip = stretch.named()
            digests[trip.name] = digest
            try:
                trips.append(fit_trip(trip, speeds))
                train = train_of(trip)
            except NotIdentifiableError as error:
                refused[trip.name] = str(error)
    if train is None:
        first = next(iter(refused.values()), "no log was given")
        raise NotIdentifiableError(
            f"no trip determines the running resistance; {first}",
            remedy="give more, or more varied, trips",
        )
    parameters = parameter_set(trips, train, refused)
    return Fits(
        trips=tuple(sorted(trips, key=lambda fit: fit.trip)),
        refused=refused,
        common=combine(trips),
        parameters=replace(
            parameters,
            details=[
                {**detail, "sha256": digests[detail["trip"]]} for detail in parameters.details
            ],
            provenance={
                "step": "fit",
                "software": f"trainlog {__version__}",
                "inputs": dict(sorted(digests.items())),
            },
        ),
    )
