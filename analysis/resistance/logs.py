"""From recorded trips, and summaries of earlier ones, to the observed parameter set."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import chain
from pathlib import Path

import numpy as np
import pandas as pd

from analysis.resistance.combination import SOFTWARE, CommonFit, combine, summarised
from analysis.resistance.fit import TripFit, fit_evidence, fit_trip, origin_of
from analysis.resistance.observed import COVER, LISTED, parameter_set
from analysis.resistance.recording import (
    ScaleSamples,
    SpeedScale,
    TripRefusedError,
    calibrated,
    check_recorded,
    scale_samples,
)
from analysis.resistance.windows import Evidence, part_of, within
from trainlog.errors import InputError, LogError, NotIdentifiableError
from trainlog.formats.attached import line_of, train_of
from trainlog.formats.files import sha256, sha256_of
from trainlog.formats.summaries import SUFFIX, merged, read_summaries
from trainlog.mcap import read_log
from trainlog.mcap.stretches import stretches
from trainlog.railway.configuration import ParameterSet
from trainlog.trip import Trip, seconds

TOPICS = ("/train/state", "/train/controls", "/train/axles", "/gnss/motion")
"""What is read of each log."""


class AllRefusedError(NotIdentifiableError):
    """No trip determines the curve.

    Attributes
    ----------
    refused : dict of str to TripRefusedError
        Why, by trip, of the logs that were read now.
    """

    def __init__(
        self,
        problem: str,
        *,
        remedy: str | None = None,
        refused: dict[str, TripRefusedError],
    ) -> None:
        super().__init__(problem, remedy=remedy)
        self.refused = refused


@dataclass(frozen=True, eq=False)
class Fits:
    """What a set of logs says about a train's running resistance.

    Attributes
    ----------
    trips : tuple of TripFit
        Fitted now and accepted, by name; not those whose summaries were known.
    refused : dict of str to TripRefusedError
        Trips fitted now that do not determine the curve, and why.
    known : int
        Logs that were not read because a summary of theirs was given.
    summaries : DataFrame
        All trips, fitted now or known; see `trainlog.formats.summaries`.
    common : CommonFit
    parameters : ParameterSet
        The observed configurations, ready to be written.
    """

    trips: tuple[TripFit, ...]
    refused: dict[str, TripRefusedError]
    known: int
    summaries: pd.DataFrame
    common: CommonFit
    parameters: ParameterSet


def fit_logs(
    paths: Iterable[Path],
    speeds: tuple[float, float] | None = None,
    *,
    cover: float = COVER,
    most: int | None = None,
) -> Fits:
    """Fit each log, then all of them together, with the trips of which summaries are given.

    Parameters
    ----------
    paths : iterable of path
        Logs, read one after the other, and files of summaries (``.parquet``). A log is not read,
        but for its SHA-256, after summaries that hold it.
    speeds : (float, float) [m/s], optional
        Speeds between which the curve is asked for; see `fit_trip`.
    cover, most
        Of the observed set; see `parameter_set`.

    Raises
    ------
    AllRefusedError
        If no trip determines the curve; it holds why each does not.
    LogError
        If a file is not a log, or a trip lacks its line or its train.
    InputError
        If the logs are of different trains, a trip appears twice, or a file of summaries is none.
    """
    earlier: list[pd.DataFrame] = []
    held: set[str] = set()
    trips: list[TripFit] = []
    refused: dict[str, TripRefusedError] = {}
    digests: dict[str, str] = {}
    trains: dict[str, str] = {}
    known = 0
    for path in paths:
        if path.suffix == SUFFIX:
            earlier.append(read_summaries(path))
            held |= set(earlier[-1]["sha256"]) - {""}
            continue
        digest = sha256_of(path)
        if digest in held:
            known += 1
            continue
        about = read_log(path, [])
        if about.name in digests:
            raise InputError(
                f"trip '{about.name}' is given twice", file=path, remedy="give each trip once"
            )
        digests[about.name] = digest
        try:
            trips.append(fit_log(path, speeds))
        except TripRefusedError as error:
            refused[about.name] = error
            trains[about.name] = _train_name(about)
    rows = summarised(trips, refused, trains=trains, digests=digests)
    summaries = merged([*earlier, rows])
    if not (summaries["refused"] == "").any():
        first = next(iter(summaries["message"]), "no log was given")
        others = len(summaries) - 1
        raise AllRefusedError(
            f"no trip determines the running resistance; {first}"
            + (f"; nor do the other {others}" if others > 0 else ""),
            remedy="give longer or more varied trips; 'trainlog fit --per-trip FOLDER' draws why"
            " each was refused",
            refused=refused,
        )
    parameters = parameter_set(summaries, cover=cover, most=most)
    return Fits(
        trips=tuple(sorted(trips, key=lambda fit: fit.trip)),
        refused=refused,
        known=known,
        summaries=summaries,
        common=combine(summaries),
        parameters=replace(parameters, provenance=_provenance(summaries)),
    )


def fit_log(path: Path, speeds: tuple[float, float] | None = None) -> TripFit:
    """Fit the trip of a log, of any length: the windows of all its stretches make one fit.

    What comes out is what `fit_trip` makes of the whole, but for windows at the border between
    two stretches.

    Parameters
    ----------
    path : path
    speeds : (float, float) [m/s], optional
        See `fit_trip`.

    Raises
    ------
    TripRefusedError, LogError
        As `fit_trip`.
    InputError
        As `trainlog.mcap.read_log`.
    """
    parts = stretches(path, TOPICS)
    first = next(parts)
    if first.count == 1:
        return fit_trip(first.trip, speeds)
    line, train = line_of(first.trip), train_of(first.trip)
    scale, origin = _calibration(path)
    name = first.trip.name
    evidence = Evidence.of(
        part_of(part.trip, line, train, scale, origin, part.span)
        for part in chain([first], parts)
        if _has_samples(part.trip)
    )
    return fit_evidence(evidence, name, line, train, scale, origin, speeds)


def _has_samples(trip: Trip) -> bool:
    """Whether a part of a trip has anything to be fitted; a trip without any is refused before."""
    return all(name in trip and len(trip[name]) > 1 for name in TOPICS[:2])


def _calibration(path: Path) -> tuple[SpeedScale, pd.Timestamp]:
    """Speed scale of a long log, and its first sample."""
    pieces: list[ScaleSamples] = []
    origin: pd.Timestamp | None = None
    name = ""
    refusal: TripRefusedError | None = None
    for part in stretches(path, TOPICS):
        try:
            check_recorded(part.trip)
        except TripRefusedError as error:
            refusal = error
            continue
        origin, name = origin or origin_of(part.trip), part.trip.name
        state = part.trip["/train/state"]
        measured, position = (state[n].to_numpy(np.float64) for n in ("speed", "position"))
        inside = within(pd.DatetimeIndex(state.index), part.span)
        time = seconds(state, origin)
        pieces.append(scale_samples(part.trip, time, measured, position, inside, origin))
    if origin is None:
        raise refusal or LogError("holds no samples", file=path, remedy="record it again")
    return calibrated(name, pieces), origin


def _provenance(summaries: pd.DataFrame) -> dict[str, object]:
    """What was fitted; of very many trips one digest over those of all logs."""
    digests = summaries["sha256"].tolist()
    names = [str(name) for name in summaries["trip"]]
    step: dict[str, object] = {"step": "fit", "software": SOFTWARE}
    if len(names) <= LISTED and len(set(names)) == len(names):
        return step | {"inputs": dict(zip(names, digests, strict=True))}
    together = sha256("\n".join(sorted(digests)).encode())
    return step | {"inputs": {"trips": len(names), "sha256 of sorted sha256": together}}


def _train_name(trip: Trip) -> str:
    try:
        return train_of(trip).name
    except LogError:
        return trip.metadata.get("train", "")
