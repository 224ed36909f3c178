"""Coast-down of trains: running resistance over inertia from trips that recorded no efforts.

What coasting looks like is searched for in all trips at once: short stretches that prove nothing by
themselves do together. Each trip is then fitted alone. While a train coasts,

    dv/dt = -k a_track(s) - c0 - c1 v - c2 v²,      k = m / (m + m_rot),   c = R / (m + m_rot):

speeds alone show accelerations, never forces. The four parameters are those of the acceleration
form in `analysis.resistance` with gravity in the place of the effort: what the track does to each
kilogramme is what drives the train, and k stands where 1/m stood. Windows, noise model, outliers
and covariance are those of `analysis.resistance`.

The trips are combined as draws around a common curve (`analysis.resistance.combination`), so that
loads, weather and winds that differ widen the band instead of biasing it.

On a line whose gradients are not known a held effort and a gradient look alike, so that coasting
itself cannot be found: it must be known from the lever or from a test's protocol. Over a piece of
track of length L that a trip coasted through from end to end, whatever its gradient does,

    (v_end² - v_start²) / 2 L = -d u - c0 - c1 <v> - c2 <v²>,       u = k g (mean gradient),

averages over the way, d = 1 along the line and -1 against it. Every piece has an unknown u of its
own. Hence

- the same piece coasted at different speeds gives c1 and c2, and the sum c0 + u of the piece;
- pieces coasted in both directions part c0 from u. Curves, which resist both ways, stay in c0;
- pieces coasted once give nothing.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, ClassVar, TypeVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike
from scipy.integrate import cumulative_trapezoid

from analysis.resistance.coasting_detection import (
    SHORTEST,
    SPACING,
    TOPICS,
    Motion,
    Segment,
    blocks_of,
    detect,
    motion_of,
    smoothed_over,
)
from analysis.resistance.combination import BETWEEN_TRIPS, PRIOR_TRIPS, SOFTWARE, nodes_over, pooled
from analysis.resistance.curve import DragCurve
from analysis.resistance.fit import check_speeds
from analysis.resistance.noise import (
    CAUSES,
    WINDOW,
    Expected,
    NoiseParts,
    WindowPoints,
    Windows,
    build_windows,
)
from analysis.resistance.recording import Recording, gradient_pieces, track_slope
from analysis.resistance.regression import WindowFit, fit_windows
from analysis.view import Given, TripView, each_given, views_of
from estimators.regression import Free, regress
from trainlog.arrays import FloatArray, IntArray
from trainlog.display import counted, few, span
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats import railway
from trainlog.formats.files import sha256_of
from trainlog.formats.railway import CoastDownResult, Identified, recorded_load
from trainlog.identity import Known, same_drives, text_of
from trainlog.presentation import (
    DURATION,
    NUMBER,
    SHARE,
    SPEED,
    Band,
    Column,
    Presented,
    Quantity,
    Said,
    WordTable,
    new_table,
)
from trainlog.railway.line import Line
from trainlog.railway.network import unused
from trainlog.railway.resistance import (
    LARGEST_STD,
    OVER_INERTIA,
    OVER_MASS_STD,
    TERMS,
    TYPICAL,
    TYPICAL_STD,
    RunningResistance,
    basis,
    polynomial_in_words,
)
from trainlog.railway.train import Train
from trainlog.spans import runs_of
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip, seconds
from trainlog.units import GRAVITY, KMH, PER_MILLE

FINE = 0.2
"""The train's place is known so often [s]: gradients change between samples of the speed."""

SAMPLES = 5.0
"""Least number of samples of the speed in a window: with fewer, neighbouring ends err alike."""

LEAST_COASTING = 60.0
"""Less coasting than this [s] leaves no residuals to estimate the noise from."""

SHORTEST_RANGE = 3.0
"""Speeds that differ by less than this [m/s] are one speed."""

UNKNOWN_RATIO = (0.945, 0.02)
"""Mass over inertia of any train, and its standard deviation: rotating masses are 3 to 12 % of the
empty mass, less of the loaded one."""

RATIO_STD = 0.005
"""Standard deviation of mass over inertia where the train's file gives the rotating mass."""

FREE_RATIO_STD = 0.2
"""Standard deviation of mass over inertia [1] with which the data are asked for it: free."""

RATIO_BETWEEN = 0.005
"""Standard deviation of mass over inertia from trip to trip: loads differ."""

OUTLIER_SEGMENT = 4.0
"""A segment whose windows together are so many standard deviations off was not coasting."""

IMPLAUSIBLE = 21.0
"""Squared distance from `TYPICAL`, in standard deviations, beyond which no train has such a curve:
chance exceeds it once in 10,000 trains. A driver who holds one effort all day cannot be
distinguished from a train that coasts with another curve, unless no train has that curve."""

OTHER_MASS = 0.03
"""Share by which masses of trips differ that is stated where they are pooled."""

NAMES = (("mass_ratio", "1"), *OVER_INERTIA)
"""Parameters of the curve, in the order of its covariance, with their units."""

SPEEDS = 25
"""Rows of the curve's table."""

PIECE = 250.0
"""Length of a piece of track [m]."""

AVERAGED = 1.5
"""Speed is averaged over this time to either side [s]."""

LAG = 1.5
"""Effort is gone this long after the lever came to rest [s]."""

PLACE_STD = 0.0015
"""Standard deviation of a piece's acceleration by errors of its chainage [m/s²]: 3 m where the
gradient changes by 10 per mille."""

FEWEST_FREE = 5
"""Least number of passages beyond the unknowns: residuals show the noise."""

SAME_SPEED = 0.1
"""Passages whose speeds differ by less than this [m/s] had the same."""

PIECE_STD = 1.0
"""Standard deviation of a piece's deceleration by its gradient, beforehand [m/s²]: any."""

MERGED = "merged with the gradient: no piece was coasted in both directions"
WIDE = "pieces coasted in both directions give it to more than 10 % of the curve only"
"""Why c0 is not identified."""

Spans = Sequence[tuple[float, float]]
T = TypeVar("T")


@dataclass(frozen=True, slots=True)
class MassRatio:
    """Mass over inertia (mass and rotating mass), with where it comes from.

    Attributes
    ----------
    value, std : float
    source : str
        ``"train file"``, ``"any train"``, or ``"data"`` where the recording itself determines it.
    """

    value: float
    std: float
    source: str

    @staticmethod
    def expected(train: Train | None) -> MassRatio:
        """What is known before any data: from the train's file, or of any train."""
        if train is None:
            return MassRatio(*UNKNOWN_RATIO, "any train")
        masses = np.array([train.mass, train.mass + train.max_load])
        ends = masses / (masses + train.rotating_mass)
        std = float(np.hypot(0.5 * (ends[1] - ends[0]), RATIO_STD))
        return MassRatio(float(np.mean(ends)), std, "train file")


@dataclass(frozen=True, eq=False)
class Curve(DragCurve):
    """Running resistance over inertia, c(v) = c0 + c1 v + c2 v², with mass over inertia k.

    Attributes
    ----------
    theta : (4,) array
        k, c0 [m/s²], c1 [1/s], c2 [1/m].
    covariance : (4, 4) array
    freedom : float
        Degrees of freedom of the covariance: how well the noise's sizes are known.
    covered : (float, float) [m/s]
        Speeds at which the train coasted.
    supported : (float, float) [m/s] or None
        Those of them at which the curve is known to `LARGEST_STD`; None if it is known nowhere,
        or at one speed only.
    """

    theta: FloatArray
    covariance: FloatArray
    freedom: float
    covered: tuple[float, float]

    @cached_property
    def supported(self) -> tuple[float, float] | None:
        """See above."""
        speed = np.linspace(*self.covered, 121)
        known = self.share(speed) <= LARGEST_STD
        ranges = [(float(speed[first]), float(speed[last - 1])) for first, last in runs_of(known)]
        widest = max(ranges, key=lambda ends: ends[1] - ends[0], default=(0.0, 0.0))
        return widest if widest[1] - widest[0] >= SHORTEST_RANGE else None

    @cached_property
    def resistance(self) -> RunningResistance:  # type: ignore[override]
        """c0, c1 and c2: the deceleration of the coasting train on level track [m/s²]."""
        return RunningResistance.of(self.theta[1:])

    def __call__(self, speed: ArrayLike) -> FloatArray:
        """Deceleration of the coasting train on level track [m/s²] at each speed [m/s]."""
        return self.resistance(speed)

    @property
    def own_covariance(self) -> FloatArray:
        """Of c0, c1 and c2."""
        return self.covariance[1:, 1:]

    @property
    def band_range(self) -> tuple[float, float]:
        """Speeds [m/s] at which the train coasted."""
        return self.covered

    def share(self, speed: ArrayLike) -> FloatArray:
        """Standard deviation over the curve; infinite where the curve is not positive."""
        value = self(speed)
        share = self.std(speed) / np.maximum(value, 1e-12)
        return np.where(value > 0.0, share, np.inf)

    def per_weight(self, speed: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Running resistance over weight and its standard deviation [1]; R / (m g) = c / (k g).

        It needs k, whose uncertainty is in the standard deviation.
        """
        v = np.asarray(speed, dtype=np.float64)
        value = self(v) / self.theta[0] / GRAVITY
        slope = np.concatenate(
            [-(value / self.theta[0])[..., None], basis(v) / (self.theta[0] * GRAVITY)], axis=-1
        )
        variance = np.einsum("...i,ij,...j->...", slope, self.covariance, slope)
        return np.asarray(value), np.asarray(np.sqrt(variance))

    @property
    def table(self) -> railway.DragCurve | None:
        """The curve over the speeds that the data support, as files hold it."""
        if self.supported is None:
            return None
        speed = np.linspace(*self.supported, SPEEDS)
        return railway.DragCurve(speed, self(speed), *self.band(speed))


@dataclass(frozen=True, eq=False)
class TripCoastDown:
    """Running resistance over inertia as one trip's coasting shows it.

    Attributes
    ----------
    motion : Motion
    curve : Curve
    ratio : MassRatio
        Mass over inertia as the curve has it.
    free : (array (4,), array (4, 4))
        The curve's parameters and covariance from the data alone, mass over inertia free.
    segments : tuple of Segment
        That were used.
    outlier_segments : tuple of Segment
        Found as coasting, and left out because they contradict the others.
    windows : dict of str to int
        ``used`` and left out as ``outlier``.
    noise : dict of str to float
        Sizes of the noise: ``speed`` [m/s], ``gradient``, ``position`` [m].
    cluster_factor : float
        What the noise model's variances were multiplied by because neighbouring windows err
        together.
    residual_std : float
        Of the whitened residuals; 1 if the noise is what it is taken for.
    points : WindowPoints
    """

    motion: Motion
    curve: Curve
    ratio: MassRatio
    free: tuple[FloatArray, FloatArray]
    segments: tuple[Segment, ...]
    outlier_segments: tuple[Segment, ...]
    windows: dict[str, int]
    noise: dict[str, float]
    cluster_factor: float
    residual_std: float
    points: WindowPoints

    @property
    def trip(self) -> str:
        """Its name."""
        return self.motion.trip

    @property
    def coasted(self) -> float:
        """Time [s] in the segments used."""
        return float(sum(segment.duration for segment in self.segments))

    @property
    def detail(self) -> dict[str, Any]:
        """What files note of it."""
        names, stds = [name for name, _ in NAMES], np.sqrt(np.diag(self.curve.covariance))
        supported = self.curve.supported
        return {
            "trip": self.trip,
            "accepted": True,
            "speed_from": self.motion.source,
            "coasted": self.coasted,
            "covered": list(self.curve.covered),
            "supported": None if supported is None else list(supported),
            "fitted": dict(zip(names, self.curve.theta.tolist(), strict=True)),
            "fitted_std": dict(zip(names, stds.tolist(), strict=True)),
            "windows": self.windows,
            "noise": self.noise,
            "cluster_factor": self.cluster_factor,
            "residual_std": self.residual_std,
            "segments": [self._where(each) for each in self.segments],
            "outlier_segments": [self._where(each) for each in self.outlier_segments],
        }

    def _where(self, segment: Segment) -> dict[str, Any]:
        """When, where and how fast a segment was."""
        motion, ends = self.motion, [segment.start, segment.end]
        speed, position = (
            np.interp(ends, motion.time, each) for each in (motion.speed, motion.position)
        )
        return {
            "start": (motion.start + pd.Timedelta(seconds=round(segment.start, 3))).isoformat(),
            "duration": round(segment.duration, 3),
            "position": np.round(position, 1).tolist(),
            "speed": np.round(speed, 3).tolist(),
            "probability": round(segment.probability, 4),
        }


def _segments_in_words(fit: TripCoastDown) -> Said:
    count, outliers = len(fit.segments), len(fit.outlier_segments)
    return Said(count, f"{count}" + f" ({counted(outliers, 'outlier')})" * bool(outliers))


def _half_band(fit: TripCoastDown) -> float:
    """Half the 95 % band over the curve, where that is least."""
    return 1.96 * float(np.min(fit.curve.share(np.linspace(*fit.curve.covered, 21))))


TRIP_COLUMNS = (
    Column("trip"),
    Column("speed from", of=lambda fit: fit.motion.source, rank=1),
    Column("segments", NUMBER, of=_segments_in_words),
    Column("coasted", replace(DURATION, digits=0), each=True),
    Column("slowest", replace(SPEED, digits=0), of=lambda fit: fit.curve.covered[0]),
    Column("fastest", replace(SPEED, digits=0), of=lambda fit: fit.curve.covered[1]),
    Column("windows", NUMBER, of=lambda fit: fit.windows["used"], rank=1),
    Column("half band", SHARE, each=True, of=_half_band),
)
"""Of a trip's coasting."""


def _reach(curve: Curve, speed: float) -> float:
    """Half the 95 % band of the whole curve [m/s²]."""
    below, above = curve.band(speed)
    return 0.5 * float(above - below)


def _over_weight(of: tuple[Curve, float], scale: float) -> Band:
    """Over the weight at a speed; `scale` times it."""
    curve, speed = of
    weight, std = (float(part) for part in curve.per_weight(speed))
    factor = _reach(curve, speed) / float(curve.std(speed))
    return Band(scale * weight, scale * factor * std / 1.96)


CURVE_COLUMNS = (
    Column("speed", replace(SPEED, digits=0), of=lambda at: at[1]),
    Column(
        "over inertia, m/s²",
        Quantity("m_s2", ""),
        key="over_inertia",
        band=True,
        of=lambda at: Band(float(at[0](at[1])), _reach(*at) / 1.96),
    ),
    Column(
        "over weight",
        Quantity("", "per mille", PER_MILLE),
        band=True,
        of=lambda at: _over_weight(at, 1.0),
    ),
    Column("over mass", Quantity("N_kg", "N/t", 1e3), band=True,
           of=lambda at: _over_weight(at, GRAVITY)),
)  # fmt: skip
"""Of a curve and a speed [m/s]."""


@dataclass(frozen=True, eq=False, repr=False)
class CoastDown(Presented):
    """What the coasting of a train shows of its running resistance.

    Attributes
    ----------
    train : str
        Empty where the trips do not state it.
    curve : Curve
        Common to the trips; of one trip its own.
    ratio : MassRatio
    between : (3, 3) array
        Covariance of one trip's coefficients around the common ones; 0 for a single trip.
    trips : tuple of TripCoastDown
        In order of name.
    refused : dict of str to str
        Trips that contribute nothing, and why.
    evidence : float
        Gain in log-likelihood by coasting over no coasting at all, all trips together.
    digests : dict of str to str
        SHA-256 of the files that it was made from; see `Sources`.
    masses : tuple of float [kg]
        Of the loaded train on the trips used, where train and load are recorded.
    """

    charts_by: ClassVar[str] = "analysis.resistance.plot:coast_down_charts"

    train: str
    curve: Curve
    ratio: MassRatio
    between: FloatArray
    trips: tuple[TripCoastDown, ...]
    refused: dict[str, str]
    evidence: float
    digests: dict[str, str]
    masses: tuple[float, ...] = ()

    @property
    def title(self) -> str:
        """Train, and how many trips were used."""
        used = counted(len(self.trips), "trip")
        return f"Coasting of {self.train or 'a train'}: {used} used, {len(self.refused)} refused"

    def summary(self) -> dict[str, str]:
        """What coasted, and the curve."""
        values = (f"{value:.3g}" for value in self.curve.theta[1:])
        words = polynomial_in_words(values, (unit for _, unit in OVER_INERTIA))
        known = self.curve.supported
        segments = sum(len(fit.segments) for fit in self.trips)
        return {
            "coasted": f"{sum(fit.coasted for fit in self.trips):.0f} s in {segments} segments",
            "curve": f"{words}, over inertia",
            "supported": "at no speed" if known is None else f"{span(known, KMH)} km/h",
            "mass over inertia": f"{self.ratio.value:.3f} ± {1.96 * self.ratio.std:.3f}"
            f" ({self.ratio.source})",
        }

    def tables(self) -> list[WordTable]:
        """Each trip's coasting; the common curve at rounded speeds, with its 95 % band."""
        trips = new_table(f"Coasting of {self.train or 'a train'}", *TRIP_COLUMNS, name="trips")
        curve, (low, high) = self.curve, self.curve.supported or self.curve.covered
        at = np.arange(np.ceil(KMH * low / 10.0) * 10.0, KMH * high + 1e-9, 10.0) / KMH
        speeds = at if at.size else np.array([0.5 * (low + high)])
        title = "Running resistance of the coasting train, with its 95 % band"
        table = new_table(title, *CURVE_COLUMNS, name="curve")
        return [
            trips.add_rows(self.trips),
            table.add_rows((curve, float(speed)) for speed in speeds),
        ]

    @property
    def notes(self) -> list[str]:
        """What the columns mean, on what they rest, and why trips were refused."""
        return [
            "'Half band' is half the 95 % interval of the trip's own curve where it is known best.",
            *self._pooled,
            _ratio(self.ratio),
            *(f"refused: {reason}" for reason in self.refused.values()),
        ]

    @property
    def _pooled(self) -> Iterator[str]:
        """What the band of several trips holds beside those of each, and masses that differ."""
        if len(self.trips) > 1:
            yield (
                "The common curve's band is wider: it holds what the trips differ by, such as wind,"
                " load and weather."
            )
        low, high = min(self.masses, default=0.0), max(self.masses, default=0.0)
        if high > (1.0 + OTHER_MASS) * low:
            yield (
                f"The train's mass is from {low / 1e3:.0f} to {high / 1e3:.0f} t on these trips:"
                " resistance over inertia is less for a heavier train, and the curve one of a"
                " middle mass; fit trips of one load for a curve of that load."
            )

    @property
    def result(self) -> CoastDownResult:
        """What it amounts to, ready to be written."""
        curve, stds = self.curve, np.sqrt(np.diag(self.curve.covariance)).tolist()
        reasons = [None if self.ratio.source == "data" else f"expected: {self.ratio.source}"]
        reasons += len(TERMS) * [None]
        values = zip(NAMES, curve.theta.tolist(), stds, reasons, strict=True)
        refused = [
            {"trip": name, "accepted": False, "reason": reason}
            for name, reason in sorted(self.refused.items())
        ]
        found = CoastDownResult(
            train=self.train,
            gradient="line",
            quantities=tuple(Identified(*name, *rest) for name, *rest in values),
            covariance=curve.covariance,
            curve=curve.table,
            trips=[fit.detail for fit in self.trips] + refused,
        )
        return with_origin(found, self.digests)


@dataclass(frozen=True, eq=False)
class Sources:
    """Trips that were given, and the files that they and the line came from.

    Attributes
    ----------
    views : tuple of TripView
        In order of name; of several of one name the later ones are numbered. A log too long for
        the memory is several trips. Those that carried no line carry the one that was given.
    digests : dict of str to str
        SHA-256 of the log of each trip that came from one, and of the file of the ``line``.
    """

    views: tuple[TripView, ...]
    digests: dict[str, str]

    @staticmethod
    def of(
        trips: Given | Iterable[Given],
        line: Line | str | Path | None,
        topics: tuple[str, ...] = TOPICS,
    ) -> Sources:
        """The trips and the line given, read where they are paths."""
        logs: dict[Path | None, str] = {}
        found: list[TripView] = []
        for given in each_given(trips):
            if isinstance(given, Path):
                logs[given] = sha256_of(given)
            found += views_of(given, topics)
        found.sort(key=lambda view: (view.name, logs.get(view.path, ""), text_of(view.identity)))
        digests: dict[str, str] = {}
        if isinstance(line, str | Path):
            digests["line"] = sha256_of(line)
            line = railway.read_line(line)
        attached = {} if line is None else {LINE_ATTACHMENT: railway.line_to_bytes(line)}
        views, taken = [], set[str]()
        for view in found:
            name = unused(view.name, taken)
            trip = replace(
                view.trip,
                metadata={**view.trip.metadata, "trip": name},
                attachments=attached | view.trip.attachments,
            )
            views.append(replace(view, trip=trip, _made={}))
            if view.path in logs:
                digests[name] = logs[view.path]
        return Sources(tuple(views), digests)

    @property
    def train(self) -> tuple[Train | None, str]:
        """The train of all trips and its name, if they state it; None and empty if not.

        Raises
        ------
        InputError
            If the trips are of different trains.
        """
        trains = [view.train for view in self.views if TRAIN_ATTACHMENT in view.trip.attachments]
        called = {view.trip.metadata.get("train", "") for view in self.views} - {""}
        called |= {train.name for train in trains}
        if len(called) > 1:
            raise InputError(
                f"trips of different trains: {', '.join(sorted(called))}",
                remedy="fit each train apart",
            )
        return (trains[0] if trains else None), next(iter(called), "")

    def made(self, make: Callable[[TripView], T]) -> tuple[dict[str, T], dict[str, str]]:
        """What a function makes of each drive, by trip; the trips not used, with the reason.

        Raises
        ------
        NotIdentifiableError
            If no trip can be used.
        """
        found: dict[str, T] = {}
        refused: dict[str, str] = {}
        for view in self.views:
            try:
                found[view.name] = make(view)
            except NotIdentifiableError as error:
                refused[view.name] = str(error)
        orders = {view.name: (self.digests.get(view.name, ""), view.name) for view in self.views}
        known = [
            Known(view.name, view.identity, orders[view.name])
            for view in self.views
            if view.name in found
        ]
        for same in same_drives(known):
            refused[same.trip] = same.sentence
            del found[same.trip]
        check_not_empty(found, refused)
        return found, refused

    @contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """What the trips do not determine is reported with the logs that were read."""
        try:
            yield
        except NotIdentifiableError as error:
            logs = list(dict.fromkeys(view.path for view in self.views if view.path is not None))
            if not logs:
                raise
            names = few([log.name for log in logs], 3)
            alone = len(logs) == 1
            raise NotIdentifiableError(
                error.problem if alone else f"{error.problem} (logs {names})",
                file=logs[0] if alone else None,
                place=error.place,
                remedy=error.remedy,
            ) from error


def with_origin(result: CoastDownResult, digests: dict[str, str]) -> CoastDownResult:
    """The result with the SHA-256 of the files that it was made from, if there are any."""
    if not digests:
        return result
    known = [
        {**trip, "sha256": digests[trip["trip"]]} if trip["trip"] in digests else trip
        for trip in result.trips
    ]
    step = {"step": "coast-down", "software": SOFTWARE, "inputs": digests}
    return replace(result, trips=known, provenance=step)


def coast_down(
    trips: Given | Iterable[Given],
    line: Line | str | Path | None = None,
    speeds: tuple[float, float] | None = None,
) -> CoastDown:
    """Running resistance over inertia from trips of one train that recorded no efforts.

    Where the train coasted is found from its motion and the line's gradients. Where these are not
    known: `coast_down_without_gradient`.

    Parameters
    ----------
    trips : Trip, path, or iterable of them
        Trips at hand, logs and folders of logs, with ``/gnss/motion`` or ``/train/state``, and
        chainage; efforts are not looked at. Of several trips of one drive the fullest that can be
        used is (`trainlog.identity`); the others are listed among the refused.
    line : Line or path, optional
        In its own direction, for trips that carry none; default: the one that each trip carries.
    speeds : (float, float) [m/s], optional
        Speeds between which the curve must be known; default: wherever it is.

    Returns
    -------
    CoastDown

    Raises
    ------
    NotIdentifiableError
        If there is no speed or no chainage, no coasting is found, the train coasted too shortly or
        at one speed only, or the curve is not known to 10 % at the speeds asked for.
    InputError
        If the trips are of different trains, or the speeds are not finite or not in order.
    LogError
        If a trip carries no line and none is given.

    Examples
    --------
    >>> found = coast_down("sample_logs/nonstop.mcap")
    >>> bool(found.curve.supported[1] > 25.0)
    True
    """
    check_speeds(speeds)
    sources = Sources.of(trips, line)
    with sources.named_in_errors():
        return _coast_down(sources, speeds)


def _coast_down(sources: Sources, speeds: tuple[float, float] | None) -> CoastDown:
    train, name = sources.train
    expected = MassRatio.expected(train)
    strip_length = 0.0 if train is None else train.strip_length
    located, refused = sources.made(_located)
    blocks = []
    for motion, line in located.values():
        track = line.track_acceleration(np.nan_to_num(motion.position), strip_length)
        blocks.append(blocks_of(motion, np.where(np.isfinite(motion.position), track, np.nan)))
    found, evidence = detect(blocks, (expected.value, expected.std))
    fits: list[TripCoastDown] = []
    for (trip, (motion, line)), segments in zip(located.items(), found, strict=True):
        try:
            fits.append(fit_segments(motion, line, segments, expected, strip_length))
        except NotIdentifiableError as error:
            refused[trip] = str(error)
    check_not_empty(fits, refused)
    curve, between, ratio = combined(fits, expected)
    check_plausible(curve)
    check_supported(curve, speeds)
    used = {fit.trip for fit in fits}
    loads = [recorded_load(view.trip, train) for view in sources.views if view.name in used]
    masses = [train.mass + load.value for load in loads if load is not None and train is not None]
    return CoastDown(
        name, curve, ratio, between, tuple(fits), refused, evidence, sources.digests,
        tuple(masses),
    )  # fmt: skip


def _located(view: TripView) -> tuple[Motion, Line]:
    """A trip's motion and the line as it travelled it."""
    motion = motion_of(view.trip)
    known = np.isfinite(motion.position[motion.usable])
    if not known.any() or np.mean(known) <= 0.5:
        raise NotIdentifiableError(
            f"trip '{view.name}': where on the line the train was is not known",
            place="topics /estimates/state and /train/state",
            remedy="ingest the recording with --line, which turns satellite fixes into chainage",
        )
    # Refuse a line that only assumes its gradients, or states them too roughly.
    line = view.line
    worst = 0.5 * SPACING / GRAVITY
    if line.survey is not None and line.survey.gradient_std > worst:
        raise NotIdentifiableError(
            f"trip '{view.name}': the gradients of line '{line.name}' are known to"
            f" {PER_MILLE * line.survey.gradient_std:.1f} per mille only, and coasting cannot be"
            f" found from motion above {PER_MILLE * worst:.1f} per mille",
            remedy="give more rides or better altitudes when the line is built, or take what needs"
            " no gradients ('--gradient unknown')",
        )
    if "gradients" in line.assumed:
        raise NotIdentifiableError(
            f"trip '{view.name}': the gradients of line '{line.name}' are not known",
            remedy="build the line from three or more rides whose receivers give altitudes, state"
            " its gradients, or take what needs none ('--gradient unknown')",
        )
    return motion, line


def fit_segments(
    motion: Motion,
    line: Line,
    segments: tuple[Segment, ...],
    expected: MassRatio,
    strip_length: float = 0.0,
) -> TripCoastDown:
    """Fit the coasting segments of a trip.

    Parameters
    ----------
    motion : Motion
    line : Line
        As travelled.
    segments : tuple of Segment
        In order of time.
    expected : MassRatio
        Mass over inertia before the trip.
    strip_length : float [m]
        Over which gradients and curves are averaged; 0 for a mass point.

    Raises
    ------
    NotIdentifiableError
        If the segments are too short together, or all at one speed.
    """
    outliers: tuple[Segment, ...] = ()
    width = max(WINDOW, SAMPLES * motion.period)
    # How noisy the speed is was seen on the whole trip, not only where it coasts.
    ordinary = Expected.on(line)
    speed_noise = motion.noise * np.sqrt(motion.period / width)
    noise = replace(ordinary, sizes=ordinary.sizes._replace(speed=speed_noise))
    while True:
        windows = build_windows(coasting_recording(motion, line, segments, strip_length), width)
        _check_windows(motion, windows)
        # In the acceleration form k stands in the place of 1/m.
        fitted = fit_windows(
            windows, 1.0 / expected.value, FREE_RATIO_STD / expected.value**2, noise
        )
        used = windows.select(fitted.kept)
        starts = np.array([segment.start for segment in segments])
        owner = np.searchsorted(starts, 0.5 * (used.start + used.end), side="right") - 1
        worst = _outlier_segment(len(segments), owner, fitted)
        if worst is None:
            break
        outliers += (segments[worst],)
        segments = segments[:worst] + segments[worst + 1 :]
    theta, covariance = fitted.over_mass
    # Efforts that were taken for coasting: with the probability that a segment was not coasting
    # it carried the nearest level of effort, to either side.
    held = used.duration[:, None] * (owner[:, None] == np.arange(len(segments)))
    rows = NoiseParts.of(used, 1.0).whiten(fitted.noise, np.column_stack([used.x, held]))
    terms = used.x.shape[1]
    moved = fitted.over_mass[1] @ rows[:, :terms].T @ rows[:, terms:] / fitted.cluster_factor
    doubt = np.array([1.0 - segment.probability for segment in segments])
    covariance = covariance + np.asarray((moved * doubt * SPACING**2) @ moved.T)
    effect = theta * np.append(1.0, 1.0 - np.arange(len(TERMS))) * motion.scale.std
    free = theta, covariance + np.outer(effect, effect)
    theta, covariance, ratio = with_ratio(*free, expected)
    covered = (float(used.mean_speed.min()), float(used.mean_speed.max()))
    residual = fitted.residual
    return TripCoastDown(
        motion=motion,
        curve=Curve(theta, covariance, fitted.freedom, covered),
        ratio=ratio,
        free=free,
        segments=segments,
        outlier_segments=outliers,
        windows={"used": used.count, "outlier": int(np.sum(~fitted.kept))},
        noise=dict(zip(CAUSES[:3], fitted.noise[:3], strict=True)),
        cluster_factor=fitted.cluster_factor,
        residual_std=float(np.sqrt(residual @ residual / max(residual.size - theta.size, 1))),
        points=fitted.points(windows),
    )


def coasting_recording(
    motion: Motion, line: Line, segments: tuple[Segment, ...], strip_length: float = 0.0
) -> Recording:
    """What the windows of `analysis.resistance` are cut from: gravity drives, nothing brakes."""
    # Between the samples, too, if they are far apart: gradients change there.
    parts = max(round(motion.period / FINE), 1)
    samples = np.arange(motion.time.size)
    time = np.interp(np.arange((samples.size - 1) * parts + 1) / parts, samples, motion.time)
    inside = np.zeros(time.size, dtype=bool)
    for segment in segments:
        inside |= (time >= segment.start) & (time <= segment.end)
    position = np.interp(time, motion.time, np.nan_to_num(motion.position))
    section, nearest = gradient_pieces(line, position)
    nothing = np.zeros(time.size)
    usable = motion.usable & np.isfinite(motion.position)
    between = np.interp(time, motion.time, usable.astype(np.float64))
    speed = np.interp(time, motion.time, motion.speed)
    return Recording(
        time=time,
        speed=speed,
        curve=basis(speed),
        effort=-line.track_acceleration(position, strip_length),
        braking=nothing,
        rotating_momentum=nothing,
        slip_momentum=nothing,
        between=nothing,
        tunnel=nothing,
        track=nothing,
        track_slope=track_slope(line, position, strip_length),
        section=section,
        nearest_edge=nearest,
        # Between two samples both have to be usable.
        usable=inside & (between > 1.0 - 1e-9),
    )


def with_ratio(
    theta: FloatArray, covariance: FloatArray, expected: MassRatio
) -> tuple[FloatArray, FloatArray, MassRatio]:
    """Parameters (4,) and covariance (4, 4) once mass over inertia is expected to be something.

    Its source is the data if they determine it better than what was expected.
    """
    gain = covariance[:, 0] / (covariance[0, 0] + expected.std**2)
    updated = theta + gain * (expected.value - theta[0])
    left = covariance - np.outer(gain, covariance[0])
    by_data = covariance[0, 0] < expected.std**2
    source = "data" if by_data else expected.source
    return updated, left, MassRatio(float(updated[0]), float(np.sqrt(left[0, 0])), source)


def _check_windows(motion: Motion, windows: Windows) -> None:
    total = float(windows.duration.sum())
    if total < LEAST_COASTING:
        raise NotIdentifiableError(
            f"trip '{motion.trip}': coasts for {total:.0f} s that can be used,"
            f" {LEAST_COASTING:.0f} s are needed",
            remedy="give a trip that coasts for longer, or more trips",
        )
    reach = float(np.ptp(windows.mean_speed))
    if reach < SHORTEST_RANGE:
        at = float(np.mean(windows.mean_speed))
        raise NotIdentifiableError(
            f"trip '{motion.trip}': coasts at one speed only, {KMH * at:.0f} km/h within"
            f" {KMH * reach:.0f} km/h",
            remedy="give coasting from high speed down to low speed, or several speeds",
        )


def _outlier_segment(count: int, owner: IntArray, fitted: WindowFit) -> int | None:
    """The segment, of `count`, that contradicts the others most, if any does beyond chance."""
    if count < 3:
        return None
    total = np.bincount(owner, fitted.residual, minlength=count)
    size = np.maximum(np.bincount(owner, minlength=count), 1) * fitted.cluster_factor
    z = np.abs(total) / np.sqrt(size)
    return int(np.argmax(z)) if z.max() > OUTLIER_SEGMENT else None


def combined(
    fits: Sequence[TripCoastDown], expected: MassRatio
) -> tuple[Curve, FloatArray, MassRatio]:
    """The curve common to several fits, its covariance from trip to trip, and mass over inertia.

    Parameters
    ----------
    fits : sequence of TripCoastDown
    expected : MassRatio
        Mass over inertia before any data; it counts once, not once a trip.
    """
    if len(fits) == 1:
        return fits[0].curve, np.zeros((len(TERMS), len(TERMS))), fits[0].ratio
    ends = np.array([fit.curve.covered for fit in fits])
    covered = float(ends.min()), float(ends.max())
    # Mass over inertia and curve at some speeds, each over what it usually is from trip to trip.
    nodes = np.zeros((len(NAMES), len(NAMES)))
    nodes[0, 0] = BETWEEN_TRIPS / RATIO_BETWEEN
    curves = np.array([fit.curve.theta[1:] for fit in fits])
    nodes[1:, 1:] = nodes_over(np.linspace(*covered, len(TERMS)), curves)
    values, variances = (np.array(each) for each in zip(*(fit.free for fit in fits), strict=True))
    found = pooled(values @ nodes.T, nodes @ variances @ nodes.T)
    back = np.linalg.inv(nodes)
    between = (back @ found.within @ back.T)[1:, 1:]
    mean, covariance = back @ found.mean, back @ found.block(0, 0) @ back.T
    theta, covariance, ratio = with_ratio(mean, covariance, expected)
    return Curve(theta, covariance, len(fits) - 1 + PRIOR_TRIPS, covered), between, ratio


def check_plausible(curve: Curve) -> None:
    """Refuse a curve that no coasting train has.

    Raises
    ------
    NotIdentifiableError
        If it is further from that of usual trains than trains are from each other.
    """
    off = curve.theta[1:] - np.array(TYPICAL)
    spread = curve.covariance[1:, 1:] + np.diag(np.square(TYPICAL_STD))
    if off @ np.linalg.solve(spread, off) <= IMPLAUSIBLE:
        return
    speed = 0.5 * (curve.covered[0] + curve.covered[1])
    raise NotIdentifiableError(
        "no coasting was found: what recurs most is a motion that no coasting train has (at"
        f" {KMH * speed:.0f} km/h {float(curve(speed)):.3f} m/s², at standstill"
        f" {float(curve(0.0)):.3f} m/s²); some effort was held",
        remedy="give a recording in which the train rolls freely for tens of seconds",
    )


def check_supported(curve: Curve, speeds: tuple[float, float] | None) -> None:
    """Refuse a curve that is not known where it is asked for.

    Raises
    ------
    NotIdentifiableError
        If it is not known to `LARGEST_STD` at a speed asked for, or nowhere; or if the train never
        coasted at such a speed.
    """
    low, high = curve.covered
    if speeds is not None and (speeds[0] < low - 0.1 or speeds[1] > high + 0.1):
        raise NotIdentifiableError(
            f"asked for {KMH * speeds[0]:.0f} to {KMH * speeds[1]:.0f} km/h, coasted from"
            f" {KMH * low:.0f} to {KMH * high:.0f} km/h",
            remedy="ask for speeds at which the train coasted",
        )
    if speeds is None and curve.supported is not None:
        return
    speed = np.linspace(*(speeds or curve.covered), 61)
    share = curve.share(speed)
    worst, best = int(np.argmax(share)), int(np.argmin(share))
    if share[worst] <= LARGEST_STD:
        return
    at = worst if speeds is not None else best
    known = f"{100.0 * share[at]:.0f} %" if np.isfinite(share[at]) else "100 %"
    raise NotIdentifiableError(
        f"at {KMH * speed[at]:.0f} km/h the running resistance is uncertain by {known} (standard"
        f" deviation; at most {100.0 * LARGEST_STD:.0f} % is accepted)",
        remedy="give more trips, longer coasting, or a narrower range of speeds",
    )


def check_not_empty(found: Sequence[object] | dict[str, T], refused: dict[str, str]) -> None:
    """Refuse trips of which none is of use, with the reason for the first.

    Raises
    ------
    NotIdentifiableError
        If nothing was found.
    """
    if found:
        return
    first = next(iter(refused.values()), "no trip was given")
    more = len(refused) - 1
    others = f" (and {counted(more, 'more trip')} refused)" if more > 0 else ""
    raise NotIdentifiableError(f"no trip shows the running resistance by coasting{others}; {first}")


def _ratio(ratio: MassRatio) -> str:
    origin = {
        "data": "determined by how the train coasts on different gradients",
        "train file": "expected from the train's file; the data do not determine it better",
        "any train": "assumed, as no train file is there; the data do not determine it better",
    }[ratio.source]
    return (
        f"Mass over inertia {ratio.value:.3f} ± {1.96 * ratio.std:.3f}: {origin}. The columns over"
        " weight and over mass rest on it."
    )


# -------------------------------------------------------------------------- gradient unknown


def coast_down_without_gradient(
    trips: Given | Iterable[Given],
    line: Line | str | Path | None = None,
    spans: Mapping[str, Spans] | None = None,
) -> CoastDownResult:
    """What coasting shows of running resistance where the gradient is not known.

    Parameters
    ----------
    trips : Trip, path, or iterable of them
        Of one train, with speed and chainage: trips at hand, logs and folders of logs.
    line : Line or path, optional
        For trips that carry none; only its length is used, to count trips against it back.
    spans : mapping of str to sequence of (float, float) [s], optional
        When each trip coasted, since the first sample of its speed; default: where the recorded
        lever was at rest.

    Returns
    -------
    CoastDownResult
        c0, c1 and c2, each with its value or the reason why it is not identified, the curve where
        all of it is, and the sum of c0 and gradient of each piece.

    Raises
    ------
    NotIdentifiableError
        If it is not known where the trips coasted, or no piece of track was coasted at different
        speeds, or the speeds' differences do not determine the resistance to 10 %.
    InputError
        If the trips are of different trains.

    Examples
    --------
    >>> coast_down_without_gradient("sample_logs/nonstop.mcap")  # doctest: +ELLIPSIS
    Traceback (most recent call last):
    trainlog.errors.NotIdentifiableError: sample_logs/nonstop.mcap: with the gradient unknown,...
    """
    sources = Sources.of(trips, line, (*TOPICS, "/train/controls"))
    with sources.named_in_errors():
        return _without_gradient(sources, spans)


def _without_gradient(sources: Sources, spans: Mapping[str, Spans] | None) -> CoastDownResult:
    _, train = sources.train

    def passed(view: TripView) -> pd.DataFrame:
        motion = motion_of(view.trip)
        known = lever_at_rest(view.trip, motion) if spans is None else spans.get(view.name, ())
        if view.backwards and LINE_ATTACHMENT not in view.trip.attachments:
            raise NotIdentifiableError(
                f"trip '{view.name}' ran against a line whose length is not known",
                remedy="give the line, so that its chainage can be counted the other way",
            )
        return passages(motion, known, view.line.length if view.backwards else None)

    found, refused = sources.made(passed)
    notes: list[dict[str, object]] = [
        {"trip": view.name, "accepted": True, "passages": len(found[view.name])}
        if view.name in found
        else {"trip": view.name, "accepted": False, "reason": refused[view.name]}
        for view in sources.views
    ]
    rows = pd.concat(found.values(), ignore_index=True)
    # Refuse passages of which none repeats a piece at another speed, or hardly any do.
    piece = rows["piece"]
    count = piece.value_counts()
    again = int(count[count > 1].sum())
    if again - int((count > 1).sum()) - len(TERMS) < FEWEST_FREE:
        raise NotIdentifiableError(
            f"with the gradient unknown, {len(piece)} passages over {len(count)} pieces of"
            f" {PIECE:.0f} m, {again} of them over a piece coasted more than once, do"
            " not separate resistance from gradient",
            remedy="give the line's gradients, or more trips that coast over the same track",
        )
    return with_origin(replace(_solved(rows), train=train, trips=notes), sources.digests)


def lever_at_rest(trip: Trip, motion: Motion) -> list[tuple[float, float]]:
    """When the recorded lever was at rest for long enough [s on the motion's clock].

    Raises
    ------
    NotIdentifiableError
        If no lever was recorded.
    """
    controls = trip.topics.get("/train/controls")
    if controls is None or not controls["lever"].notna().any():
        raise NotIdentifiableError(
            f"trip '{trip.name}': with the gradient unknown, coasting looks like any held effort,"
            " and no lever was recorded",
            place="topic /train/controls, column lever",
            remedy="give the line's gradients, or say when the train coasted",
        )
    time = seconds(controls, motion.start)
    rest = controls["lever"].to_numpy(dtype=np.float64) == 0.0
    spans = [(float(time[first]) + LAG, float(time[last - 1])) for first, last in runs_of(rest)]
    return [span for span in spans if span[1] - span[0] >= SHORTEST]


def passages(motion: Motion, spans: Spans, length: float | None) -> pd.DataFrame:
    """The pieces of track that a trip coasted through from end to end.

    Parameters
    ----------
    motion : Motion
    spans : sequence of (float, float) [s]
    length : float [m] or None
        Of the line, if the trip ran against it; None if it ran along it.

    Returns
    -------
    DataFrame
        A row a passage: number of the ``piece`` along the line; ``way``, 1 along the line and -1
        against it; ``acceleration`` [m/s²], mean over the way; ``noise`` [m/s²], standard deviation
        that one end's speed brings in; ``joined``, whether the passage before ended where this one
        begins; and for each of `TERMS` the mean over the way of what it is multiplied by.

    Raises
    ------
    NotIdentifiableError
        If there is none.
    """
    way = 1.0 if length is None else -1.0
    place = motion.position if length is None else length - motion.position
    speed = smoothed_over(motion.time, motion.speed, AVERAGED)
    per_end = motion.noise / np.sqrt(max(2.0 * AVERAGED / motion.period, 1.0))
    parts = []
    for begin, end in spans:
        inside = (motion.time >= begin + AVERAGED) & (motion.time <= end - AVERAGED)
        inside &= np.isfinite(place)
        if np.count_nonzero(inside) < 3 or not np.all(motion.usable[inside]):
            continue
        s, v = way * place[inside], speed[inside]
        s = np.maximum.accumulate(s + 1e-9 * np.arange(s.size))
        edges = np.arange(np.ceil(s[0] / PIECE), np.floor(s[-1] / PIECE) + 1.0)
        at = np.interp(edges * PIECE, s, v)
        area = cumulative_trapezoid(basis(v), s, axis=0, initial=0.0)
        means = [np.diff(np.interp(edges * PIECE, s, each)) / PIECE for each in area.T]
        part = pd.DataFrame(dict(zip(TERMS, means, strict=True)))
        part["piece"] = (edges[:-1] if way > 0.0 else -edges[1:]).astype(np.int64)
        part["acceleration"] = np.diff(at**2) / (2.0 * PIECE)
        part["noise"] = per_end * 0.5 * (at[1:] + at[:-1]) / PIECE
        part["joined"] = part.index > 0
        parts.append(part)
    if not parts:
        raise NotIdentifiableError(
            f"trip '{motion.trip}': coasted through no piece of {PIECE:.0f} m from end to end",
            remedy="give trips that coast for longer",
        )
    return pd.concat(parts).assign(way=way)


def _whitened(rows: pd.DataFrame, columns: FloatArray) -> FloatArray:
    """Columns with their noise made independent: joined passages share an end's speed."""
    noise = rows["noise"].to_numpy(np.float64)
    shared = np.where(rows["joined"][1:], -noise[1:] * noise[:-1], 0.0)
    covariance = np.diag(2.0 * noise**2 + PLACE_STD**2) + np.diag(shared, 1) + np.diag(shared, -1)
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), columns))


def _solved(rows: pd.DataFrame) -> CoastDownResult:
    pieces, member = np.unique(rows["piece"].to_numpy(np.int64), return_inverse=True)
    way, basis_of = rows["way"].to_numpy(np.float64), rows[list(TERMS)].to_numpy(np.float64)
    along = -np.where(member[:, None] == np.arange(pieces.size), way[:, None], 0.0)
    white = _whitened(rows, np.column_stack([-basis_of, along, rows["acceleration"]]))
    stds = np.append(OVER_MASS_STD, np.full(pieces.size, PIECE_STD))
    free = [Free(str(k), white[:, k], std) for k, std in enumerate(stds.tolist())]
    found = regress(white[:, -1], free)
    ways = rows.groupby("piece")["way"]
    both = bool((ways.max() > ways.min()).any())
    left = max(len(rows) - pieces.size - len(TERMS) + 1 - both, 1)
    found = found.wider(np.sqrt(max(1.0, float(found.residual @ found.residual) / left)))
    estimate, covariance = found.estimate, found.covariance
    speed = basis_of[:, 1]
    _check_differences(speed, member, estimate, covariance)
    own = np.pad(covariance[: len(TERMS), : len(TERMS)], ((1, 0), (1, 0)))
    theta = np.append(1.0, estimate[: len(TERMS)])
    curve = Curve(theta, own, left, (float(speed.min()), float(speed.max()))) if both else None
    table = None if curve is None else curve.table
    first, *others = (
        Identified(*names, float(estimate[k]), found.std(str(k)))
        for k, names in enumerate(OVER_INERTIA)
    )
    if table is not None:
        first = replace(first, reason="with the curves' resistance")
    else:
        first = replace(first, value=None, std=None, reason=WIDE if both else MERGED)
    kept = slice(0 if table is not None else 1, len(TERMS))
    return CoastDownResult(
        train="",
        gradient="unknown",
        quantities=(first, *others),
        covariance=covariance[kept, kept],
        curve=table,
        pieces=_pieces(rows, estimate, covariance, table is not None),
    )


def _check_differences(
    speed: FloatArray, member: IntArray, estimate: FloatArray, covariance: FloatArray
) -> None:
    """Refuse speeds that do not differ, or differences that are not known to 10 %."""
    low, high = np.quantile(speed, [0.05, 0.95])
    speeds = pd.Series(speed).groupby(member)
    if float((speeds.max() - speeds.min()).max()) < SAME_SPEED:
        raise NotIdentifiableError(
            "with the gradient unknown, resistance cannot be identified: each piece of"
            " track was coasted at one and the same speed",
            remedy="give the line's gradients, or trips that coast over the same track at"
            " different speeds",
        )
    change = (basis(high) - basis(low))[1:]
    gained = float(change @ estimate[1 : len(TERMS)])
    std = float(np.sqrt(change @ covariance[1 : len(TERMS), 1 : len(TERMS)] @ change))
    if high - low >= SHORTEST_RANGE and std <= LARGEST_STD * gained:
        return
    share = f"{100.0 * std / gained:.0f} %" if gained > 0.0 else "100 %"
    raise NotIdentifiableError(
        f"with the gradient unknown, the difference of resistance from {KMH * low:.0f} to"
        f" {KMH * high:.0f} km/h is uncertain by {share} (standard deviation; at most"
        f" {100.0 * LARGEST_STD:.0f} % is accepted)",
        remedy="give the line's gradients, or more trips that coast over the same track at"
        " different speeds",
    )


def _pieces(
    rows: pd.DataFrame, estimate: FloatArray, covariance: FloatArray, parted: bool
) -> list[dict[str, object]]:
    """Of each piece coasted more than once: c0 plus or, apart from c0, the gradient's part."""
    found: list[dict[str, object]] = []
    for number, (_, here) in enumerate(rows.groupby("piece")):
        if len(here) < 2:
            continue
        way = 1.0 if parted else float(here["way"].iloc[0])
        pick = np.zeros(estimate.size)
        pick[len(TERMS) + number] = way
        pick[0] = 0.0 if parted else 1.0
        found.append(
            {
                "position": [PIECE * float(here["piece"].iloc[0] + end) for end in (0, 1)],
                "direction": "forward" if way > 0.0 else "reverse",
                "passages": len(here),
                "speed": [float(here[TERMS[1]].min()), float(here[TERMS[1]].max())],
                "quantity": "gradient" if parted else "c0 and gradient",
                "deceleration": float(pick @ estimate),
                "std": float(np.sqrt(pick @ covariance @ pick)),
            }
        )
    return found
