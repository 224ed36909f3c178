"""What a track-condition map says of a time: lasting beside expected, spots, changes, the model."""

from __future__ import annotations

import re
from collections.abc import Hashable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from pandas import Timestamp
from scipy.special import ndtri

from analysis.adhesion.condition_table import (
    KM,
    LAYER,
    MAY_BE_CHANGE,
    NEAR,
    SPAN,
    bins_table,
    changes_table,
    chosen_layers,
    day_name,
    last_evidence,
    lowest_apart,
    met_words,
    probability_words,
    spots_table,
    with_ends,
)
from trainlog.arrays import BoolArray, FloatArray
from trainlog.condition import day_of_trip, known_before, left_out, setting
from trainlog.display import counted, few
from trainlog.errors import InputError, TrainlogError
from trainlog.formats.mapfile import MapFile
from trainlog.formats.railway import line_of, read_line
from trainlog.formats.samples import names, sample
from trainlog.mcap import read_log
from trainlog.presentation import (
    NUMBER,
    POSITION,
    Column,
    Presented,
    Said,
    WordTable,
    frame_table,
    new_table,
)
from trainlog.railway.condition import (
    SET_ASIDE,
    AdhesionEstimate,
    ConditionLayer,
    ModelParameter,
    TrackConditionMap,
)
from trainlog.railway.line import Line, StepProfile


@dataclass(frozen=True, eq=False)
class UsableAdhesion:
    """What may be counted on along a line; (n,) arrays by bin of the map.

    Attributes
    ----------
    bin_length : float [m]
    values : (n,) array
        Infinite where nothing is known and nothing is assumed.
    seen : (n,) bool array
        From the maximum itself, which slip in or near the bin has shown.
    demonstrated : (n,) bool array
        From what trips used without slip, more than would have been assumed.
    """

    bin_length: float
    values: FloatArray
    seen: BoolArray
    demonstrated: BoolArray

    @property
    def assumed(self) -> BoolArray:
        """Bins in which only an assumption is counted on; (n,)."""
        return np.asarray(~self.seen & ~self.demonstrated)

    @property
    def profile(self) -> StepProfile:
        """By position on the line."""
        starts = self.bin_length * np.arange(self.values.size, dtype=np.float64)
        return StepProfile(starts, self.values)


def usable_adhesion(
    track: TrackConditionMap,
    layer: str,
    *,
    sigmas: float = 1.0,
    risk: float | None = None,
    time: Timestamp | None = None,
    assumed: float = np.inf,
) -> UsableAdhesion:
    """What a map lets a controller count on.

    Where the map observed the maximum, its estimate less `sigmas` standard deviations; what was
    used without slip is part of that estimate. With a `risk`, what a trip at `time` finds there
    with probability ``1 - risk``. Elsewhere the more of what was demonstrated
    (`demonstrated_adhesion`) and of what is assumed.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas : float
        How cautious; with a risk it is not used.
    risk : float, optional
        Probability, for each place and trip, that there is less; what that means for a run of many
        places: `risk_of_run`.
    time : Timestamp, optional
        Of the run; see `TrackConditionMap.lower_bound`.
    assumed : float
        Where the map holds no evidence; by default there is no limit.

    Raises
    ------
    InputError
        If the map has no such layer, the assumption is not positive, or the risk is not between 0
        and 1.

    Examples
    --------
    >>> from trainlog.formats.mapfile import read_map
    >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
    >>> bold, careful = (usable_adhesion(track, "wet", risk=risk) for risk in (0.2, 0.01))
    >>> bool(np.all(bold.values[bold.seen] > careful.values[careful.seen]))
    True
    """
    if not (0.0 < assumed <= 1.0 or assumed == np.inf):
        raise InputError(
            f"an assumed adhesion must be above 0 and at most 1, not {assumed:g}",
            remedy="assume what the worst of rails would bear, 0.05 for instance",
        )
    known = track.lower_bound(layer, track.centres, sigmas, risk=risk, time=time)
    seen = np.isfinite(known)
    below = sigmas if risk is None else float(-ndtri(risk))
    # Where nothing limits anything, nothing demonstrated can be more.
    demonstrated = (
        demonstrated_adhesion(track, layer, below) if np.isfinite(assumed) else np.zeros(track.bins)
    )
    return UsableAdhesion(
        track.bin_length,
        np.where(seen, known, np.maximum(demonstrated, assumed)),
        seen,
        ~seen & (demonstrated > assumed),
    )


def demonstrated_adhesion(track: TrackConditionMap, layer: str, sigmas: float = 1.0) -> FloatArray:
    """Cautious bound of the maximum adhesion that trips demonstrated in each bin; 0 if none.

    The maximum of one trip scatters about that of the place by ``trip_std``, and what the model
    leaves out adds ``model_std``. Where n trips used a level without slip, it is therefore
    lowered by `sigmas` times ``sqrt(trip_std²/n + model_std²)`` of its logarithm; the best of all
    levels counts.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas : float

    Returns
    -------
    (n,) array

    Raises
    ------
    InputError
        If the map has no such layer.
    """
    trips = np.cumsum(track.layer(layer).evidence.censored[:, ::-1], axis=1)[:, ::-1]
    spread = np.hypot(
        setting(track, "trip_std") / np.sqrt(np.maximum(trips, 1.0)), setting(track, "model_std")
    )
    bound = np.where(trips > 0.0, track.levels * np.exp(-sigmas * spread), 0.0)
    return np.asarray(bound.max(axis=1))


def typical_adhesion(
    track: TrackConditionMap,
    layer: str,
    sigmas: float = 1.0,
    *,
    risk: float | None = None,
    time: Timestamp | None = None,
) -> float:
    """Cautious adhesion of the middle one of all places where slip has shown the maximum.

    An assumption for the rest of the line. Neighbouring bins are one place, represented by the
    lowest of their cautious estimates: a long slippery spot counts no more than a short one.
    Slip is met where the rail is worst, so that most of the line holds more; not all of it does.

    Parameters
    ----------
    track : TrackConditionMap
    layer : str
    sigmas, risk, time
        How cautious; as for `usable_adhesion`.

    Raises
    ------
    InputError
        If the map has no such layer, or has seen no maximum.
    """
    known = track.lower_bound(layer, track.centres, sigmas, risk=risk, time=time)
    seen = np.flatnonzero(np.isfinite(known))
    if seen.size == 0:
        raise InputError(
            f"map of line '{track.line}': no trip has shown the maximum adhesion of layer"
            f" '{layer}' anywhere",
            remedy="count in trips that met the limit, or assume an adhesion",
        )
    apart = np.diff(seen) * track.bin_length > setting(track, "correlation_length")
    places = np.split(known[seen], np.flatnonzero(apart) + 1)
    return float(np.median([place.min() for place in places]))


def risk_of_run(
    expected: AdhesionEstimate, demand: ArrayLike, bin_length: float, apart: float
) -> tuple[float, float]:
    """Bounds on the probability that a run asks for more than the rail holds somewhere.

    A risk of a place is not that of a run, which meets many. Bins that are nearer to each other
    than `apart` are one place, whose risk is taken as the largest of its bins'. The run's risk is
    at least the largest of all places, as if all shared one fate, and at most that of independent
    places, ``1 - prod(1 - p)``, as long as one bad place makes no other better (association of
    random variables: Esary, Proschan and Walkup, Ann. Math. Stat. 38, 1967).

    Parameters
    ----------
    expected : AdhesionEstimate
        Of each bin at the time of the run.
    demand : (n,) array
        Adhesion that the run asks for in each bin; 0 where it asks for none.
    bin_length, apart : float [m]

    Returns
    -------
    least, most : float

    Examples
    --------
    Two places at which the run asks for the quantile of 5 %:

    >>> rail = AdhesionEstimate(np.full(80, np.log(0.1)), np.full(80, 0.1), np.ones(80, bool))
    >>> demand = np.zeros(80)
    >>> demand[[10, 11, 60]] = rail.quantile(0.05)[0]
    >>> [round(each, 4) for each in risk_of_run(rail, demand, 25.0, 200.0)]
    [0.05, 0.0975]
    """
    asked = np.asarray(demand, dtype=np.float64)
    some = np.flatnonzero(asked > 0.0)
    if some.size == 0:
        return 0.0, 0.0
    risk = expected.at_bins(some).below(asked[some])
    starts = np.flatnonzero(np.diff(some, prepend=-np.inf) * bin_length > apart)
    places = np.maximum.reduceat(risk, starts)
    return float(places.max()), float(1.0 - np.prod(1.0 - places))


SPOT_SEPARATION = 250.0
"""Two low spots count as two when they are at least this far from each other [m]."""

LOGARITHMS = {
    "mean": "median of normal rail",
    "slippery_mean": "median of slippery places",
    "spot_mean": "median of passing spots",
}
"""Parameters of the model that are means of logarithms of adhesion; a table has the medians."""

SPREADS = ("std", "slippery_std", "trip_std", "spot_std")
"""Parameters that are standard deviations of logarithms of adhesion."""

LOWEST = 5
"""Of the lowest places of a layer so many are listed."""

LISTED = 12
"""Spots, and changes, of a layer that a table lists; the likeliest first."""


Row = Mapping[Hashable, Any]

STATE_COLUMNS = (
    LAYER,
    Column("trips", NUMBER),
    Column("onsets measured", NUMBER, key="onsets"),
    Column(
        "observed",
        of=lambda row: (
            f"{row['observed_m'] / 1e3:.1f} km, {row['observed_bins'] / row['bins']:.0%}"
        ),
    ),
    Column(
        "last evidence",
        of=lambda row: row["last_day"] if isinstance(row["last_day"], str) else "none",
    ),
)

PLACE_COLUMNS = (
    LAYER,
    KM,
    NEAR,
    with_ends("lasting", "adhesion"),
    with_ends("expected", "expected"),
    Column(
        "spot",
        of=lambda row: f"{row['spot_probability']:.0%}" if row["spot_probability"] > 0.0 else "",
        rank=1,
    ),
)

SPOT_COLUMNS = (
    LAYER,
    SPAN,
    NEAR,
    with_ends("adhesion", "adhesion"),
    Column("met", of=lambda row: met_words(row["first_day"], row["last_day"])),
    Column("last evidence there", of=lambda row: _day(row["checked_day"]), rank=1),
)

CHANGE_COLUMNS = (
    LAYER,
    SPAN,
    NEAR,
    Column(
        "on (95 %)",
        of=lambda row: f"{_day(row['day'])} ({_day(row['earliest'])} to {_day(row['latest'])})",
    ),
    with_ends("before", "before"),
    with_ends("after", "after"),
)

MODEL_COLUMNS = (
    LAYER,
    Column(
        "parameter",
        of=lambda row: LOGARITHMS.get(row["parameter"], row["parameter"].replace("_", " ")),
    ),
    Column("value", of=lambda row: _digits(_value(row)[0], 3)),
    Column("standard deviation", of=lambda row: _std_in_words(row)),
    Column("unit", of=lambda row: _unit_in_words(row)),
    Column("from", of="source"),
)


@dataclass(frozen=True, eq=False, repr=False)
class MapState(Presented):
    """What a track-condition map says of a time.

    Attributes
    ----------
    track : TrackConditionMap
    line : Line or None
    at : Timestamp or None
        Of the expected condition, UTC; None of a map without evidence.
    last_evidence : Timestamp or None
        End of the last day with evidence, UTC.
    layers : DataFrame
        A row a layer: trips, onsets, observed length, last day with evidence.
    lowest : DataFrame
        The lowest places, least lasting or expected adhesion first; a row as of
        `analysis.bins_table`, with the nearest station.
    model : DataFrame
        A row a layer and parameter of the model: value, standard deviation, of a mean of logarithms
        its ``median`` as an adhesion, too, and its ``source``:
        "estimated" from the evidence, "mostly assumed" where the evidence weighs less than what
        was assumed beforehand, "assumed" where it has no part.
    spots, changes : DataFrame
        A row a passing spot, with the probability that it lies there then; a row a lasting change.
    trips : DataFrame
        A row a trip that counts: ``layer``, ``trip`` (its name), ``day`` of its middle, UTC.
    notes : tuple of str
        What holds where nothing was observed, what the recorders lacked, in which layers no lasting
        change was found, and which later evidence is left out, in sentences.
    """

    track: TrackConditionMap
    line: Line | None
    at: pd.Timestamp | None
    last_evidence: pd.Timestamp | None
    layers: pd.DataFrame
    lowest: pd.DataFrame
    model: pd.DataFrame
    spots: pd.DataFrame
    changes: pd.DataFrame
    trips: pd.DataFrame
    notes: tuple[str, ...] = ()

    @property
    def title(self) -> str:
        """The map."""
        return self.track.title

    def summary(self) -> dict[str, str]:
        """That of the map, and the time that it is of."""
        at = "no evidence" if self.at is None else f"expected at {self.at:%Y-%m-%d %H:%M} UTC"
        return self.track.summary() | {"time": at}

    def facts(self) -> dict[str, Any]:
        """Line and times."""
        last = self.last_evidence
        return {
            "line": self.track.line,
            "length_m": self.track.length,
            "expected_at": None if self.at is None else self.at.isoformat(),
            "last_evidence": None if last is None else _last_day(last),
            "evidence_ends": None if last is None else last.isoformat(),
        }

    def tables(self) -> list[WordTable]:
        """Layers, lowest places, spots and changes; the model is shown on request."""
        at = "" if self.at is None else f", expected at {self.at:%Y-%m-%d %H:%M} UTC"
        title = f"Track condition of {self.track.line}, {self.track.bin_length:.0f} m bins"
        layers = new_table(title, *STATE_COLUMNS, name="layers", frame=self.layers)
        lowest = new_table(
            f"Lowest maximum adhesion{at}", *PLACE_COLUMNS, name="lowest", frame=self.lowest
        )
        model = new_table("Model", *MODEL_COLUMNS, name="model", frame=self.model, usual=False)
        changes = new_table(
            "Changes of the lasting condition", *CHANGE_COLUMNS, name="changes", frame=self.changes
        )
        return [
            layers.add_rows(self.layers.to_dict("records")),
            lowest.add_rows(self.lowest.to_dict("records")),
            self._spots(),
            _listed(changes, self.changes, "log_odds"),
            model.add_rows(self.model.to_dict("records")),
            frame_table("trips", self.trips),
        ]

    def _spots(self) -> WordTable:
        still = "still there" if self.at is None else f"there on {self.at:%Y-%m-%d %H:%M}"
        doubtful = bool(len(self.spots)) and self.spots["may_be_change"].any()
        table = new_table(
            "Passing spots, the likeliest first",
            *SPOT_COLUMNS,
            Column(still, key="probability", of=_still_there),
            name="spots",
            frame=self.spots,
            caption=f"* {MAY_BE_CHANGE}" if doubtful else None,
        )
        return _listed(table, self.spots, "probability")


def map_state(
    track: TrackConditionMap,
    at: pd.Timestamp | None = None,
    *,
    line: Line | None = None,
    layers: Sequence[str] | None = None,
) -> MapState:
    """What a map says of a time: the lowest places, the model, spots and changes.

    Parameters
    ----------
    track : TrackConditionMap
    at : Timestamp, optional
        Without a zone it is UTC. Only evidence of the days before its day counts, which is stated
        in the notes (`trainlog.condition.known_before`). Default: right after the last evidence,
        with all of it.
    line : Line, optional
        Gives the stations and the operator's kilometres.
    layers : sequence of str, optional
        Default: all.

    Raises
    ------
    InputError
        If the map has no such layer, no evidence is of a day before, or the line is another.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> state = map_state(track, line=trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json"))
    >>> state.lowest.query("layer == 'wet'")["near"].tolist()[:2]
    ['0.9 km after Uzwil', 'at Flawil']
    """
    if line is not None:
        track.check_line(line.name, line.length)
    if at is not None and at.tzinfo is None:
        at = at.tz_localize("UTC")
    track = replace(track, layers=chosen_layers(track, layers))
    without = left_out(track, at)
    if at is not None:
        track = known_before(track, at)
    chosen, last = track.layers, last_evidence(track)
    names = list(chosen)
    every = [each for each in summary(track, 0) if each.layer in names]
    days = [track.layer(each.layer).evidence.days for each in every]
    return MapState(
        track=track,
        line=line,
        at=at or last,
        last_evidence=last,
        layers=pd.DataFrame(
            {
                "layer": [each.layer for each in every],
                "trips": [each.trips for each in every],
                "onsets": [each.events for each in every],
                "observed_m": [round(each.observed_length, 3) for each in every],
                "observed_bins": [each.observed_bins for each in every],
                "bins": [each.bins for each in every],
                "last_day": [day_name(int(each[-1])) if each.size else None for each in days],
            }
        ),
        lowest=_lowest(track, line, at, list(chosen)),
        model=_model(chosen),
        spots=spots_table(track, line, at, list(chosen)),
        changes=changes_table(track, line, list(chosen)),
        trips=_trips(track),
        notes=(
            *map_words(track),
            *_without_changes(chosen),
            *filter(None, [without]),
        ),
    )


def _without_changes(layers: Mapping[str, ConditionLayer]) -> Iterator[str]:
    """In which layers no lasting change was found, and how many bins could have shown it best."""
    for name, each in layers.items():
        if not each.changes:
            by_day = np.unique(np.stack((each.evidence.bin, each.evidence.day)), axis=1)[0]
            places = int(np.count_nonzero(np.bincount(by_day, minlength=1) > 1))
            where = counted(places, "bin") if places else "no bin"
            have = "has" if places <= 1 else "have"
            yield f"{name}: no lasting change found; {where} {have} onsets of two days or more."


def _trips(track: TrackConditionMap) -> pd.DataFrame:
    every = [each for each in track.trips if each["layer"] in track.layers]
    days = [day_of_trip(each) for each in every]
    return pd.DataFrame(
        {
            "layer": [str(each["layer"]) for each in every],
            "trip": [str(each["trip"]) for each in every],
            "day": [None if day is None else day_name(day) for day in days],
        },
        dtype=object,
    )


def _lowest(
    track: TrackConditionMap,
    line: Line | None,
    at: pd.Timestamp | None,
    names: list[str],
) -> pd.DataFrame:
    """The lowest bins of each layer, lasting or expected, apart from each other."""
    rows = bins_table(track, line, at, names)
    least = np.fmin(rows["adhesion"], rows["expected"])
    chosen: list[int] = []
    for name in names:
        own = rows["observed"] & (rows["layer"] == name)
        chosen += lowest_apart(rows["start_m"], least, own, SPOT_SEPARATION, LOWEST)
    return rows.loc[chosen].reset_index(drop=True)


def _model(layers: dict[str, ConditionLayer]) -> pd.DataFrame:
    every = [(name, each) for name, layer in layers.items() for each in layer.model.values()]
    return pd.DataFrame(
        {
            "layer": [name for name, _ in every],
            "parameter": [each.name for _, each in every],
            "value": np.array([each.value for _, each in every], dtype=np.float64),
            "std": np.array([each.std for _, each in every], dtype=np.float64),
            "unit": [
                "ln(adhesion)" if each.name in LOGARITHMS or each.name in SPREADS else each.unit
                for _, each in every
            ],
            "median": np.array(
                [np.exp(each.value) if each.name in LOGARITHMS else np.nan for _, each in every],
                dtype=np.float64,
            ),
            "source": [_source(each) for _, each in every],
        }
    )


def _source(parameter: ModelParameter) -> str:
    """Where a parameter is from; one that is assumed has nothing that the evidence moved."""
    moved = np.isfinite(parameter.std) and parameter.std > 0.0
    return "mostly assumed" if parameter.source == "assumed" and moved else parameter.source


def _listed(table: WordTable, rows: pd.DataFrame, rank: str) -> WordTable:
    """A table with the first rows by rank of each layer, and the number of the others."""
    for name, every in rows.groupby("layer", sort=False):
        listed = every.sort_values(rank, ascending=False, kind="stable")
        table.add_rows(listed[:LISTED].to_dict("records"))
        if len(every) > LISTED:
            table.add_row(str(name), f"and {len(every) - LISTED} more")
    return table


def _still_there(row: Row) -> Said:
    mark = " *" if row["may_be_change"] else ""
    return Said(row["probability"], probability_words(row["probability"]) + mark)


def _value(row: Row) -> tuple[float, float]:
    """Value and standard deviation of a parameter of the model, as it is shown."""
    value, std = float(row["value"]), float(row["std"])
    if row["parameter"] not in LOGARITHMS:
        return value, std
    # Read as an adhesion: the logarithm's deviation is one in proportion.
    return float(np.exp(value)), float(np.exp(value)) * std


def _std_in_words(row: Row) -> str:
    std = _value(row)[1]
    return _digits(std, 2) if np.isfinite(std) and std > 0.0 else ""


def _unit_in_words(row: Row) -> str:
    if row["parameter"] in LOGARITHMS:
        return "adhesion"
    return "" if row["unit"] == "1" else str(row["unit"])


def _digits(value: float, digits: int) -> str:
    """A number to so many digits, without an exponent."""
    return np.format_float_positional(
        float(f"{value:.{digits}g}"), fractional=False, trim="-", precision=digits
    )


def _last_day(end: pd.Timestamp) -> str:
    """The day that ends then."""
    return _day(end - pd.Timedelta(days=1))


def _day(time: Any) -> str:
    return f"{time:%Y-%m-%d}"


def line_of_map(track: TrackConditionMap, given: Path | None, condition: Path) -> Line | None:
    """The line of a map: the one given, a sample, or that of a log the map was made from.

    Parameters
    ----------
    track : TrackConditionMap
    given : path, optional
        A line file, or a log that carries its line.
    condition : path
        The file of the map.

    Returns
    -------
    Line or None
        None if there is none of these, or no such log is where it was.

    Raises
    ------
    InputError
        If what is given is no line, or another than the map's.
    """
    if given is not None:
        line = _line_of_log(given) if given.suffix == ".mcap" else read_line(given)
        track.check_line(line.name, line.length)
        return line
    for name in names():
        if name.endswith(".line.json"):
            line = read_line(sample(name))
            if (line.name, line.length) == (track.line, track.length):
                return line
    with MapFile(condition) as opened:
        for log in opened.unchanged_logs():
            with suppress(TrainlogError):
                line = _line_of_log(log)
                track.check_line(line.name, line.length)
                return line
    return None


def _line_of_log(log: Path) -> Line:
    """The line that a log carries, in its own direction."""
    trip = read_log(log, topics=[])
    line = line_of(trip)
    return line.reversed() if trip.metadata.get("direction") == "reverse" else line


# ---------------------------------------------------------------------------------- summary


@dataclass(frozen=True, slots=True)
class Spot:
    """A low spot: chainage [m], maximum adhesion there and the ends of its 95 % band."""

    position: float
    adhesion: float
    low: float
    high: float


UNMEASURED = (
    "Onsets that did not measure the maximum: the axle's effort neither fell nor was cut, is not"
    " known, or is known of the whole train only and another axle had slipped just before."
)
"""Why slip events do not show the maximum."""


@dataclass(frozen=True, slots=True)
class LayerSummary:
    """What a layer of a map amounts to.

    Attributes
    ----------
    layer : str
    trips : int
    observed_bins, bins : int
    observed_length : float [m]
    events : int
        Onsets of slip that measured the maximum.
    lowest : tuple of Spot
        Least adhesion first, at least `SPOT_SEPARATION` apart.
    unmeasured : int
        Slip events that did not show the maximum (`UNMEASURED`).
    incomplete : int
        Trips on which slips may have gone unseen.
    notes : dict of str to tuple of str
        What the recorders of the trips lacked, as first met, with the trips of which that holds.
    """

    layer: str
    trips: int
    observed_bins: int
    bins: int
    observed_length: float
    events: int
    lowest: tuple[Spot, ...]
    unmeasured: int = 0
    incomplete: int = 0
    notes: dict[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def elsewhere(self) -> str:
        """What holds where nothing was observed, in words."""
        if not self.unmeasured and not self.incomplete:
            return "Where nothing was observed, demand never met the limit: no estimate."
        words = "Where nothing was observed, the map has no estimate"
        if self.unmeasured:
            measured = counted(self.events, "onset")
            words += f"; {measured} of slip measured the maximum, {self.unmeasured} others did not"
        if self.incomplete:
            words += f"; on {counted(self.incomplete, 'trip')} slips may have gone unseen"
        return words + "."


def summary(track: TrackConditionMap, spots: int = 5) -> tuple[LayerSummary, ...]:
    """What each layer of a map amounts to, with its lowest spots."""
    return tuple(
        LayerSummary(
            layer=name,
            trips=sum(trip["layer"] == name for trip in track.trips),
            observed_bins=int(np.count_nonzero(layer.observed)),
            bins=track.bins,
            observed_length=observed_length(track, layer),
            events=int(layer.events.sum()),
            lowest=tuple(
                _spot(track, layer, int(row))
                for row in lowest_apart(
                    track.centres, layer.log_mean, layer.observed, SPOT_SEPARATION, spots
                )
            ),
            **_recorded(track, name),
        )
        for name, layer in track.layers.items()
    )


def _recorded(track: TrackConditionMap, layer: str) -> dict[str, Any]:
    """What the trips of a layer lacked: the last fields of `LayerSummary`."""
    trips = [trip for trip in track.trips if trip["layer"] == layer]
    first: dict[str, str] = {}
    found: dict[str, list[str]] = {}
    for trip in trips:
        for note in trip.get("notes", ()):
            # Notes of one kind differ in their numbers only.
            kind = "".join(re.split(r"[-\d., ]+", note))
            found.setdefault(first.setdefault(kind, note), []).append(str(trip["trip"]))
    return {
        "unmeasured": sum(int(trip.get("unmeasured", 0)) for trip in trips),
        "incomplete": sum(trip.get("complete") is False for trip in trips),
        "notes": {note: tuple(names) for note, names in found.items()},
    }


def observed_length(track: TrackConditionMap, layer: ConditionLayer) -> float:
    """Length of the observed bins [m]; the last bin ends with the line."""
    return float(np.diff(track.edges)[layer.observed].sum())


def _spot(track: TrackConditionMap, layer: ConditionLayer, row: int) -> Spot:
    mean, band = layer.log_mean[row], 1.96 * layer.log_std[row]
    ends = (float(np.exp(each)) for each in (mean, mean - band, mean + band))
    return Spot(float(track.centres[row]), *ends)


def map_words(track: TrackConditionMap) -> list[str]:
    """What holds where nothing was observed, and what the recorders lacked, in sentences."""
    every = summary(track)
    words = [
        each.elsewhere if len(every) == 1 else f"{each.layer}: {each.elsewhere}" for each in every
    ]
    if len({each.elsewhere for each in every}) <= 1:
        words = [each.elsewhere for each in every[:1]]
    words += [UNMEASURED] * any(each.unmeasured for each in every)
    for each in every:
        for note, trips in each.notes.items():
            if note.startswith(SET_ASIDE):
                continue
            words.append(f"{each.layer}, {few(trips, 1)}: {note}")
    return words + [
        f"trip '{trip['trip']}' is {note}"
        for trip in track.trips
        for note in trip.get("notes", ())
        if note.startswith(SET_ASIDE)
    ]


def _spots_in_words(layer: LayerSummary) -> str:
    spots = [
        f"km {spot.position / 1e3:.3f}: {spot.adhesion:.3f} ({spot.low:.3f} to {spot.high:.3f})"
        for spot in layer.lowest
    ]
    return "\n".join(spots) or "nothing observed"


def _observed(layer: LayerSummary) -> Said:
    share = layer.observed_bins / layer.bins
    words = f"{layer.observed_length / 1e3:.1f} km, {share:.0%}"
    return Said(layer.observed_length, words)


LAYER_COLUMNS = (
    Column("rail\ncondition", key="layer"),
    Column("trips", NUMBER),
    Column("onsets measured", NUMBER, key="onsets", of="events"),
    Column("observed", POSITION, each=True, of=_observed),
    Column("lowest maximum adhesion (95 % band)", key="lowest", of=_spots_in_words, rank=1),
)
