"""The track-condition map: maximum adhesion along a line, by rail condition.

A map is a set of layers (``"dry"``, ``"wet"`` ...). Each layer has an estimate for every bin of the
line, its uncertainty, whether it was observed at all, and the evidence it was made from, which adds
up in any order so that trips can be processed apart and merged.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from pandas import Timestamp

from trainlog.arrays import BoolArray, FloatArray, IntArray, same_values
from trainlog.display import counted, span
from trainlog.errors import InputError
from trainlog.presentation import Presented
from trainlog.railway.evidence import DailyEvidence

BIN_LENGTH = 25.0
"""Length of a bin [m]."""

ADHESION_BOUNDS = (0.05, 0.08, 0.12, 0.20)
"""Maximum adhesion between the classes in which maps are shown."""

ADHESION_COLOURS = ("#d73a3a", "#f0803c", "#f2c14e", "#74b9dc", "#3a74b8")
"""Of the classes, from the lowest: readers who see no red and green distinguish them, on white
and on black."""

ADHESION_CLASSES = (
    f"below {ADHESION_BOUNDS[0]:.2f}",
    *(f"{low:.2f} to {high:.2f}" for low, high in pairwise(ADHESION_BOUNDS)),
    f"from {ADHESION_BOUNDS[-1]:.2f}",
)
"""Their names."""


DIRECTIONS = "forward", "reverse"

SET_ASIDE = "set aside: "
"""How the note of a trip begins whose evidence does not count."""


def layer_of(layer: str, direction: str) -> str:
    """Name of a layer of one direction.

    Examples
    --------
    >>> layer_of("wet", "reverse"), condition_of_layer("wet reverse"), condition_of_layer("wet")
    ('wet reverse', 'wet', 'wet')
    """
    return f"{layer} {direction}"


def condition_of_layer(layer: str) -> str:
    """The rail condition of a layer, be it of one direction."""
    condition, _, direction = layer.rpartition(" ")
    return condition if direction in DIRECTIONS else layer


def adhesion_class(adhesion: ArrayLike) -> IntArray:
    """Class of each maximum adhesion, counted from the lowest.

    Examples
    --------
    >>> [ADHESION_CLASSES[each] for each in adhesion_class([0.03, 0.05, 0.3])]
    ['below 0.05', '0.05 to 0.08', 'from 0.20']
    """
    return np.searchsorted(ADHESION_BOUNDS, np.asarray(adhesion), side="right")


@dataclass(frozen=True, eq=False)
class AdhesionEstimate:
    """What is known of the maximum adhesion of each bin.

    Attributes
    ----------
    log_mean, log_std : (n,) array
        Natural logarithm of the maximum adhesion and its standard deviation.
    observed : (n,) bool array
        Whether evidence in or near the bin determines the estimate. Where it is false the
        estimate is only the prior: it must not be shown as data.
    log_levels : (k,) array, optional
        Increasing; None: the logarithm is normal.
    probability : (n, k) array, optional
        That the logarithm of the maximum is next to each of `log_levels`; rows sum up to 1.
    """

    log_mean: FloatArray
    log_std: FloatArray
    observed: BoolArray
    log_levels: FloatArray | None = None
    probability: FloatArray | None = None

    def __eq__(self, other: object) -> bool:
        return same_values(self, other) if isinstance(other, AdhesionEstimate) else NotImplemented

    __hash__ = None  # type: ignore[assignment]

    @property
    def maximum_adhesion(self) -> FloatArray:
        """Estimate of the maximum adhesion a bin, NaN where nothing was observed."""
        estimate: FloatArray = np.exp(self.log_mean)
        return np.asarray(np.where(self.observed, estimate, np.nan), dtype=np.float64)

    def below(self, adhesion: ArrayLike) -> FloatArray:
        """Probability that the maximum is below an adhesion, by bin; (n,) array.

        Parameters
        ----------
        adhesion : float, (n,) array, or (k, 1) array
            With the last, (k, n) probabilities.
        """
        log = np.log(np.asarray(adhesion, dtype=np.float64))
        # Imported where it is used: an update that finds nothing new begins without it.
        from scipy.special import ndtr

        if self.log_levels is None or self.probability is None:
            return np.asarray(ndtr((log - self.log_mean) / self.log_std))
        edges, cumulated = self._cumulated
        step = np.clip(np.searchsorted(edges, log, side="right") - 1, 0, edges.size - 2)
        share = np.clip((log - edges[step]) / (edges[step + 1] - edges[step]), 0.0, 1.0)
        rows = np.arange(self.log_mean.size)
        low, high = cumulated[rows, step], cumulated[rows, step + 1]
        return np.asarray(low + share * (high - low))

    def quantile(self, share: float) -> FloatArray:
        """Adhesion below which the maximum lies with probability `share`, by bin; (n,) array.

        Raises
        ------
        InputError
            If the share is not between 0 and 1.
        """
        if not 0.0 < share < 1.0:
            raise InputError(
                f"a quantile's share must be between 0 and 1, not {share:g}",
                remedy="write 0.05 for 5 %",
            )
        from scipy.special import ndtri

        if self.log_levels is None or self.probability is None:
            return np.asarray(np.exp(self.log_mean + ndtri(share) * self.log_std))
        edges, cumulated = self._cumulated
        step = np.clip((cumulated < share).sum(axis=1) - 1, 0, edges.size - 2)
        rows = np.arange(step.size)
        low, high = cumulated[rows, step], cumulated[rows, step + 1]
        part = np.clip((share - low) / np.maximum(high - low, 1e-300), 0.0, 1.0)
        return np.asarray(np.exp(edges[step] + part * (edges[step + 1] - edges[step])))

    def cautious(self, sigmas: float) -> FloatArray:
        """Adhesion as far down in the distribution as `sigmas` deviations of a normal one; (n,).

        Examples
        --------
        >>> known = AdhesionEstimate(np.log([0.2]), np.array([0.1]), np.array([True]))
        >>> known.cautious(2.0).round(3)
        array([0.164])
        """
        if self.log_levels is None or self.probability is None:
            return np.asarray(np.exp(self.log_mean - sigmas * self.log_std))
        from scipy.special import ndtr

        return self.quantile(float(np.clip(ndtr(-sigmas), 1e-12, 1.0 - 1e-12)))

    def log_density(self, adhesion: ArrayLike) -> FloatArray:
        """Logarithm of the density of the logarithm of the maximum, by bin; (n,) array.

        Minus infinity where the estimate holds an adhesion for impossible.

        Parameters
        ----------
        adhesion : float or (n,) array
        """
        log = np.broadcast_to(np.log(np.asarray(adhesion, dtype=np.float64)), self.log_mean.shape)
        if self.log_levels is None or self.probability is None:
            z = (log - self.log_mean) / self.log_std
            return np.asarray(-0.5 * z**2 - np.log(self.log_std) - 0.5 * np.log(2.0 * np.pi))
        edges, _ = self._cumulated
        levels = self.log_levels
        # Linear between the levels, so that a coarse grid costs little.
        step = np.clip(np.searchsorted(levels, log, side="right") - 1, 0, levels.size - 2)
        share = np.clip((log - levels[step]) / (levels[step + 1] - levels[step]), 0.0, 1.0)
        rows, width = np.arange(log.size), np.diff(edges)
        low = self.probability[rows, step] / width[step]
        high = self.probability[rows, step + 1] / width[step + 1]
        density = low + share * (high - low)
        inside = (log >= edges[0]) & (log <= edges[-1]) & (density > 0.0)
        found = np.log(density, where=inside, out=np.full(log.shape, -np.inf))
        return np.asarray(found, dtype=np.float64)

    def at_bins(self, bins: ArrayLike) -> AdhesionEstimate:
        """The estimate of some bins, in their order; a bin may be named more than once.

        Parameters
        ----------
        bins : (m,) int array
        """
        rows = np.asarray(bins, dtype=np.int64)
        return AdhesionEstimate(
            self.log_mean[rows],
            self.log_std[rows],
            self.observed[rows],
            self.log_levels,
            None if self.probability is None else self.probability[rows],
        )

    @cached_property
    def _cumulated(self) -> tuple[FloatArray, FloatArray]:
        """Edges between the levels, (k + 1,), and the probability below each, (n, k + 1)."""
        assert self.log_levels is not None
        assert self.probability is not None
        middle = 0.5 * (self.log_levels[1:] + self.log_levels[:-1])
        first, last = 2.0 * self.log_levels[0] - middle[0], 2.0 * self.log_levels[-1] - middle[-1]
        edges = np.concatenate(([first], middle, [last]))
        sums = np.cumsum(self.probability, axis=1)
        return edges, np.concatenate((np.zeros((sums.shape[0], 1)), sums), axis=1)


@dataclass(frozen=True, slots=True)
class PassingSpot:
    """A slippery place that was there for some days.

    Attributes
    ----------
    start, end : float [m]
    adhesion, low, high : float
        Maximum adhesion in it and the ends of its 95 % band.
    first, last : int
        Days of the first and the last trip that met it, counted from 1970-01-01 in UTC.
    checked : int
        Day of the last evidence in it.
    present : float
        Probability that it was still there at the end of that day.
    life : float [days]
        Expected from then on.
    """

    start: float
    end: float
    adhesion: float
    low: float
    high: float
    first: int
    last: int
    checked: int
    present: float
    life: float

    def alive(self, time: Timestamp) -> float:
        """Probability that it is there at a time after the last evidence.

        Examples
        --------
        >>> met = PassingSpot(100.0, 175.0, 0.08, 0.07, 0.1, 20_000, 20_000, 20_000, 0.9, 3.0)
        >>> [round(met.alive(Timestamp(day, tz="UTC")), 2) for day in ("2024-10-05", "2024-11-01")]
        [0.9, 0.0]
        """
        return self.present * float(np.exp(-days_after(self.checked, time) / self.life))


@dataclass(frozen=True, slots=True)
class ConditionChange:
    """A change of the lasting condition: a rail that was ground, trees that were cut.

    Attributes
    ----------
    start, end : float [m]
    day : int
        The first day after it with evidence, most probably; counted from 1970-01-01 in UTC.
    earliest, latest : int
        Days that hold it with 95 % probability.
    before, after : float
        Lasting maximum adhesion.
    before_std, after_std : float
        Standard deviations of their logarithms.
    significance : float
        Natural logarithm of the odds that there was a change there at all.
    """

    start: float
    end: float
    day: int
    earliest: int
    latest: int
    before: float
    after: float
    before_std: float
    after_std: float
    significance: float


@dataclass(frozen=True, slots=True)
class ModelParameter:
    """A number of the model behind a layer's estimate.

    Attributes
    ----------
    name, unit : str
    value, std : float
    source : {"estimated", "assumed"}
        "estimated" where the layer's evidence weighs more than what was assumed beforehand; else
        "assumed", though the evidence may have moved it: what it did not has no deviation.
    """

    name: str
    unit: str
    value: float
    std: float
    source: str


def _above(probability: FloatArray) -> FloatArray:
    """Probability of each level or a higher one; (n, k) array."""
    return np.asarray(np.cumsum(probability[:, ::-1], axis=1)[:, ::-1])


def spread_on_grid(probability: FloatArray, levels: FloatArray, std: float) -> FloatArray:
    """Each row of probabilities on an even grid with a normal error added; (n, k) array.

    Examples
    --------
    >>> spread_on_grid(np.array([[0.0, 1.0, 0.0]]), np.array([0.0, 0.1, 0.2]), 0.1).round(2)
    array([[0.27, 0.45, 0.27]])
    """
    kernel = np.exp(-0.5 * ((levels[:, None] - levels[None, :]) / std) ** 2)
    return np.asarray(probability @ (kernel / kernel.sum(axis=1, keepdims=True)))


def band_of(probability: FloatArray, levels: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean, and a deviation of which 1.96 reach both ends of the 95 % band, by row.

    Of a normal distribution it is the standard deviation; of one with two modes, low if there was a
    spot and high if there was none, the larger one of the two sides.

    Examples
    --------
    >>> levels = np.arange(-4.0, 0.0, 0.02)
    >>> normal = np.exp(-0.5 * ((levels + 2.0) / 0.1) ** 2)
    >>> mean, std = band_of(normal[None] / normal.sum(), levels)
    >>> mean.round(3), std.round(2)
    (array([-2.]), array([0.1]))
    """
    mean = probability @ levels
    nothing = np.zeros(mean.size)
    given = AdhesionEstimate(mean, nothing, nothing > 0, levels, probability)
    low, high = np.log(given.quantile(0.025)), np.log(given.quantile(0.975))
    return mean, np.maximum(high - mean, mean - low) / 1.96


def days_after(day: int, time: Timestamp) -> float:
    """Days from the end of a day, counted from 1970-01-01 in UTC, to a time; not less than 0.

    A time without a zone is taken for UTC.

    Examples
    --------
    >>> days_after(20_000, Timestamp("2024-10-06T12:00"))
    1.5
    """
    zoned = time.tz_localize("UTC") if time.tzinfo is None else time
    return max(zoned.timestamp() / 86_400.0 - (day + 1), 0.0)


@dataclass(frozen=True, eq=False)
class ConditionLayer(AdhesionEstimate):
    """Maximum adhesion in one rail condition: the estimate, and the evidence it was made from.

    The estimate, inherited, is that of the lasting condition: what the rail is without the spots
    that pass.

    Attributes
    ----------
    evidence : DailyEvidence
    spots : tuple of PassingSpot
        By place.
    changes : tuple of ConditionChange
        By place; the estimate is what holds after them.
    model : dict of str to ModelParameter
        The numbers behind the estimate, by name.
    passing : (4, n) array, optional
        Spots as the last evidence of each bin left them: its day, the probability that a spot lay
        there at its end, and mean and standard deviation of the logarithm of its adhesion.
    """

    evidence: DailyEvidence = field(kw_only=True)
    spots: tuple[PassingSpot, ...] = field(default=(), kw_only=True)
    changes: tuple[ConditionChange, ...] = field(default=(), kw_only=True)
    model: dict[str, ModelParameter] = field(default_factory=dict, kw_only=True)
    passing: FloatArray | None = field(default=None, kw_only=True)

    @staticmethod
    def unestimated(evidence: DailyEvidence) -> ConditionLayer:
        """A layer of which only the evidence is known; `trainlog.condition.estimated` makes more.

        Examples
        --------
        >>> layer = ConditionLayer.unestimated(DailyEvidence.none(3, 2))
        >>> layer.log_mean.tolist(), layer.observed.tolist()
        ([nan, nan, nan], [False, False, False])
        """
        unknown = np.full(evidence.bins, np.nan)
        return ConditionLayer(
            unknown, unknown, np.zeros(evidence.bins, dtype=np.bool_), evidence=evidence
        )

    def expected(self, time: Timestamp | None = None) -> AdhesionEstimate:
        """The condition that a run at a time meets, passing spots and trip-to-trip spread included.

        A spot that was there at the last evidence is still there with a probability that falls
        by 1/e each life of a spot; elsewhere spots come as often as they have come so far.

        Parameters
        ----------
        time : Timestamp, optional
            Default: right after the last evidence. For a time before it this is what is known now,
            later evidence included; `trainlog.condition.known_before` is the map as it was then.

        Examples
        --------
        >>> import trainlog
        >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
        >>> later = track.layer("wet").expected(Timestamp("2024-12-24T18:00"))
        >>> later.log_mean.shape
        (1183,)
        """
        if self.log_levels is None or self.probability is None or self.passing is None:
            return AdhesionEstimate(
                self.log_mean, self.log_std, self.observed, self.log_levels, self.probability
            )
        model = {name: each.value for name, each in self.model.items()}
        day, present, log_mean, log_std = self.passing
        days = self.evidence.days
        last = int(days[-1]) if days.size else 0
        # At the end of the last day with evidence, if no time is given.
        now = float(last + 1) if time is None else days_after(0, time) + 1.0
        gone = np.exp(-np.maximum(now - (day + 1.0), 0.0) / model["spot_life"])
        known = present * gone
        fresh = np.clip(model["spot_share"] * (1.0 - gone) + model["spots_met"], 0.0, 1.0 - known)
        trip = model["trip_std"]
        levels = self.log_levels
        lasting = spread_on_grid(self.probability, levels, trip)
        above = _above(lasting)
        probability = (1.0 - known - fresh)[:, None] * lasting
        met = (
            (known, log_mean, np.hypot(log_std, trip)),
            (fresh, model["spot_mean"], np.hypot(model["spot_std"], trip)),
        )
        for share, mean, std in met:
            mean, std = np.broadcast_to(mean, share.shape), np.broadcast_to(std, share.shape)
            density = np.exp(-0.5 * ((levels - mean[:, None]) / std[:, None]) ** 2) + 1e-12
            density /= density.sum(axis=1, keepdims=True)
            # A spot bounds what the rail bears: the lower one of the two is met.
            lower = -np.diff(above * _above(density), axis=1, append=0.0)
            probability += share[:, None] * lower
        return AdhesionEstimate(*band_of(probability, levels), self.observed, levels, probability)

    @property
    def events(self) -> FloatArray:
        """Onsets of slip measured in each bin."""
        return self.evidence.by_bin("events")


@dataclass(frozen=True, eq=False, repr=False)
class TrackConditionMap(Presented):
    """Maximum adhesion along a line.

    Attributes
    ----------
    line : str
        Name of the line.
    length : float [m]
    bin_length : float [m]
    levels : (k,) array
        Adhesion levels of the censoring histograms.
    layers : dict of str to ConditionLayer
        By rail condition; where directions differ, ``"wet forward"`` and ``"wet reverse"``.
    trips : tuple of dict
        Provenance: name and SHA-256 of every log counted in, and its layer.

    Examples
    --------
    >>> import trainlog
    >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
    >>> track.bins, sorted(track.layers)
    (1183, ['dry', 'wet'])
    >>> track.lower_bound("wet", [5_000.0]).shape
    (1,)
    """

    charts_by: ClassVar[str] = "analysis.adhesion.map_plot:map_charts"

    line: str
    length: float
    bin_length: float
    levels: FloatArray
    layers: dict[str, ConditionLayer]
    trips: tuple[dict[str, Any], ...] = ()
    settings: dict[str, float] = field(default_factory=dict)

    @property
    def title(self) -> str:
        """Line, bins and trips."""
        return (
            f"Track-condition map of line '{self.line}', {counted(self.bins, 'bin')} of"
            f" {self.bin_length:g} m, from {counted(len(self.trips), 'trip')}"
        )

    def summary(self) -> dict[str, str]:
        """What each layer holds."""
        rows = {}
        for name, layer in self.layers.items():
            known = layer.maximum_adhesion[layer.observed]
            slips = counted(int(layer.events.sum()), "slip event")
            rows[name] = f"{counted(known.size, 'bin')} observed, {slips}" + (
                f", maximum adhesion {span(known, 1.0, 3)}" if known.size else ""
            )
            rows[name] += f", {counted(len(layer.spots), 'passing spot')}" * bool(layer.spots)
            rows[name] += f", {counted(len(layer.changes), 'lasting change')}" * bool(layer.changes)
        lacking = sum(bool(trip.get("notes")) for trip in self.trips)
        if lacking:
            rows["recorders"] = f"of {counted(lacking, 'trip')} lack something of what is needed"
        days = [int(day) for each in self.layers.values() for day in each.evidence.days[-1:]]
        if days:
            rows["evidence"] = f"up to {np.datetime64(max(days), 'D')}"
        return rows or {"layers": "none"}

    @property
    def bins(self) -> int:
        """Number of bins."""
        return int(np.ceil(self.length / self.bin_length))

    @property
    def centres(self) -> FloatArray:
        """Position of each bin's centre [m]."""
        return np.asarray((np.arange(self.bins) + 0.5) * self.bin_length, dtype=np.float64)

    @property
    def edges(self) -> FloatArray:
        """Ends of the bins [m]; (bins + 1,) array. The last bin ends with the line."""
        return np.asarray(np.minimum(np.arange(self.bins + 1) * self.bin_length, self.length))

    @property
    def days(self) -> IntArray:
        """Days with evidence in any layer, increasing; see `DailyEvidence`."""
        every = [layer.evidence.days for layer in self.layers.values()]
        return np.unique(np.concatenate([np.zeros(0, dtype=np.int64), *every]))

    def check_line(self, line: str, length: float, within: float = 1e-3, what: str = "") -> None:
        """Refuse to be used on another line.

        Parameters
        ----------
        line : str
        length : float [m]
        within : float [m]
            By which the lengths may differ; 0 for evidence, whose bins must be those of the map.
        what : str
            Trip or run that is on that line; begins the message.

        Raises
        ------
        InputError
            If the map is of a line of another name or length.
        """
        if line != self.line or abs(length - self.length) > within:
            raise InputError(
                f"{what}{': ' * bool(what)}the map is of line '{self.line}', {self.length:g} m,"
                f" not of '{line}', {length:g} m",
                remedy="give the map of that line",
            )

    def layer(self, name: str) -> ConditionLayer:
        """The layer called `name`.

        Raises
        ------
        InputError
            If the map has no such layer.
        """
        try:
            return self.layers[name]
        except KeyError:
            raise InputError(
                f"map of line '{self.line}' has no layer '{name}'",
                remedy=f"layers present: {', '.join(self.layers) or 'none'}",
            ) from None

    def travelled(self, direction: str) -> TrackConditionMap:
        """The map for trips in a direction: layers of that direction by their rail condition alone.

        Examples
        --------
        >>> import trainlog
        >>> track = trainlog.read_map("sample_logs/CH_StGallen_Wil.map")
        >>> from dataclasses import replace
        >>> apart = replace(track, layers={"wet reverse": track.layers["wet"]})
        >>> list(apart.travelled("reverse").layers), list(apart.travelled("forward").layers)
        (['wet'], [])
        """
        layers = {
            condition_of_layer(name): layer
            for name, layer in self.layers.items()
            if name in (condition_of_layer(name), layer_of(condition_of_layer(name), direction))
        }
        return replace(self, layers=layers)

    def bin_of(self, position: ArrayLike) -> IntArray:
        """Index of the bin that holds each position [m]; ends are extended."""
        index = np.floor(np.asarray(position, dtype=np.float64) / self.bin_length)
        return np.clip(index, 0, self.bins - 1).astype(np.int64)

    def lower_bound(
        self,
        layer: str,
        position: ArrayLike,
        sigmas: float = 2.0,
        *,
        risk: float | None = None,
        time: Timestamp | None = None,
        likely: bool = False,
    ) -> FloatArray:
        """Cautious maximum adhesion at each position: the estimate less `sigmas` deviations.

        With a `risk` it is instead the adhesion that a trip at `time` finds at that place with
        probability ``1 - risk``, of what is expected then (`ConditionLayer.expected`).
        Infinite where the layer was not observed: the map says nothing there.

        Parameters
        ----------
        layer : str
        position : (n,) array [m]
        sigmas : float
            Standard deviations taken off; with a risk it is not used.
        risk : float, optional
            Probability, for each place and trip, that there is less.
        time : Timestamp, optional
            Of the run: what is expected then; default: the lasting condition, or with a risk what
            is expected right after the last evidence.
        likely : bool
            Whether, where the layer was not observed, what its own places and its neighbours make
            likely holds, with the larger deviation of that. It is an expectation, right for a
            driver or controller that sees the train slip and eases off, not to be shown as data.
            What a plan rests on must not be guessed: `analysis.adhesion.map_state` takes there
            only what a trip bore without slip, or an assumption that is called one.

        Raises
        ------
        InputError
            If the map has no such layer, or the risk is not between 0 and 1.

        Examples
        --------
        >>> import numpy as np
        >>> from trainlog.formats.mapfile import read_map
        >>> track = read_map("sample_logs/CH_StGallen_Wil.map")
        >>> seen = track.centres[track.layer("wet").observed][:2]
        >>> track.lower_bound("wet", seen).round(4).tolist()
        [0.132, 0.113]
        >>> bool(np.all(track.lower_bound("wet", seen, risk=0.5) > track.lower_bound("wet", seen)))
        True
        """
        chosen = self.layer(layer)
        known = chosen if risk is None and time is None else chosen.expected(time)
        if risk is not None and not 0.0 < risk < 1.0:
            raise InputError(
                f"a risk must be between 0 and 1, not {risk:g}",
                remedy="give 0.05 for one trip in twenty that finds less adhesion at a place",
            )
        cautious = known.cautious(sigmas) if risk is None else known.quantile(risk)
        index = self.bin_of(position)
        return np.asarray(np.where(known.observed[index] | likely, cautious[index], np.inf))


@dataclass(frozen=True, eq=False)
class AdhesionForecast:
    """What is expected of sections of a line, in spans of time; (n,) arrays, a row each.

    Attributes
    ----------
    line : str
    start, end : (n,) array [m]
        Chainage.
    valid_from, valid_to : (n,) int array [ns since 1970 UTC]
        The end does not belong to it.
    issued : (n,) int array [ns since 1970 UTC]
        When the row was issued.
    layer : tuple of str
        Rail condition for which each holds; empty: for any.
    shares : (k,) array
        Increasing, between 0 and 1.
    quantiles : (n, k) array
        Adhesion below which the maximum lies with the probability `shares`; NaN: not stated.
    thresholds : (j,) array
        Increasing adhesion.
    below : (n, j) array
        Probability that the maximum is below `thresholds`; NaN: not stated. A row that states
        nothing is a forecast of unknown.
    place : tuple of str
        Where each row stands in its file.
    """

    line: str
    start: FloatArray
    end: FloatArray
    valid_from: IntArray
    valid_to: IntArray
    issued: IntArray
    layer: tuple[str, ...]
    shares: FloatArray
    quantiles: FloatArray
    thresholds: FloatArray
    below: FloatArray
    place: tuple[str, ...] = ()

    def __repr__(self) -> str:
        return f"Adhesion forecast for line '{self.line}', {counted(self.start.size, 'row')}"

    def in_force(self, time: pd.Timestamp) -> BoolArray:
        """Which rows are valid at a time and were issued by then; (n,) array.

        Examples
        --------
        >>> day = np.array([0]), np.array([86_400 * 10**9]), np.array([0])
        >>> forecast = AdhesionForecast(
        ...     "A-B", np.array([0.0]), np.array([500.0]), *day, ("wet",), np.array([0.5]),
        ...     np.array([[0.1]]), np.zeros(0), np.zeros((1, 0)),
        ... )
        >>> [forecast.in_force(pd.Timestamp(hours, unit="h")).tolist() for hours in (23, 24)]
        [[True], [False]]
        """
        now = time.as_unit("ns").value
        return np.asarray(
            (self.valid_from <= now) & (now < self.valid_to) & (self.issued <= now), dtype=np.bool_
        )

    def rows_at(self, layer: str, time: pd.Timestamp, positions: FloatArray) -> IntArray:
        """The row that holds at each position; (m,) int array, -1 where there is none.

        Rows for the rail condition go before those for any; of several the one issued last counts,
        if it was issued by then.

        Parameters
        ----------
        layer : str
        time : Timestamp
        positions : (m,) array [m]

        Raises
        ------
        InputError
            If two rows say different things of one place and time.
        """
        own = np.array([each in ("", layer) for each in self.layer], dtype=np.bool_)
        rows = np.flatnonzero(own & self.in_force(time))
        special = np.array([self.layer[row] != "" for row in rows.tolist()], dtype=np.bool_)
        rows = rows[np.lexsort((self.issued[rows], special))]
        found = np.full(positions.size, -1, dtype=np.int64)
        for row in rows.tolist():
            here = (positions >= self.start[row]) & (positions < self.end[row])
            for other in np.unique(found[here & (found >= 0)]).tolist():
                if self.layer[row] == self.layer[other] and self.issued[row] == self.issued[other]:
                    raise InputError(
                        f"forecast for line '{self.line}': {self._place(row)} and"
                        f" {self._place(other)} both hold at {time.isoformat()} from"
                        f" km {max(self.start[row], self.start[other]) / 1e3:.3f}",
                        remedy="leave one out, or state when each was issued",
                    )
            found[here] = row
        return found

    def _place(self, row: int) -> str:
        return self.place[row] if self.place else f"row {row + 1}"

    def points(self, row: int) -> tuple[FloatArray, FloatArray]:
        """Adhesion and the probability that the maximum is below it, as a row states; increasing.

        Raises
        ------
        InputError
            If more adhesion is stated with less probability.

        Examples
        --------
        >>> day = np.array([0]), np.array([86_400 * 10**9]), np.array([0])
        >>> forecast = AdhesionForecast(
        ...     "A-B", np.array([0.0]), np.array([500.0]), *day, ("wet",), np.array([0.05, 0.5]),
        ...     np.array([[0.08, 0.12]]), np.array([0.1]), np.array([[0.2]]),
        ... )
        >>> [each.tolist() for each in forecast.points(0)]
        [[0.08, 0.1, 0.12], [0.05, 0.2, 0.5]]
        """
        adhesion = np.concatenate((self.quantiles[row], self.thresholds))
        probability = np.concatenate((self.shares, self.below[row]))
        stated = np.isfinite(adhesion) & np.isfinite(probability)
        adhesion, probability = adhesion[stated], probability[stated]
        order = np.lexsort((probability, adhesion))
        adhesion, probability = adhesion[order], probability[order]
        falls = np.flatnonzero(np.diff(probability) < 0.0)
        if falls.size:
            at = int(falls[0])
            raise InputError(
                f"states probability {probability[at]:g} of less than {adhesion[at]:g}, and"
                f" {probability[at + 1]:g} of less than {adhesion[at + 1]:g}",
                place=self._place(row),
                remedy="quantiles and probabilities must grow with the adhesion",
            )
        return adhesion, probability
