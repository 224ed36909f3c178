"""Coast-down of one train from its trips: found together, fitted apart, combined.

What coasting looks like is searched for in all trips at once: short stretches that prove nothing by
themselves do together. Each trip is then fitted alone and the trips are combined as draws around a
common curve (`analysis.resistance.combination`), so that loads, weather and winds
that differ widen the band instead of biasing it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pandas as pd

from analysis.resistance.coasting_detection import (
    SPACING,
    TYPICAL,
    TYPICAL_STD,
    Segment,
    blocks_of,
    detect,
)
from analysis.resistance.coasting_fit import (
    Curve,
    MassRatio,
    TripCoastDown,
    fit_segments,
)
from analysis.resistance.combination import PRIOR_TRIPS, SOFTWARE, nodes_over, pooled
from analysis.resistance.fit import check_speeds
from analysis.resistance.motion import TOPICS, Motion, motion_of
from analysis.view import Given, each_given, views_of
from trainlog.arrays import FloatArray
from trainlog.display import counted, span
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.files import sha256_of
from trainlog.formats.railway import (
    CoastDownResult,
    DragCurve,
    Identified,
    line_of,
    read_line,
    recorded_load,
    train_of,
)
from trainlog.identity import Known, TripIdentity, same_drives, text_of
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
from trainlog.railway.resistance import LARGEST_STD, OVER_INERTIA, TERMS
from trainlog.railway.train import Train
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT, Trip
from trainlog.units import GRAVITY, KMH, PER_MILLE

RATIO_BETWEEN = 0.005
"""Standard deviation of mass over inertia from trip to trip: loads differ."""


IMPLAUSIBLE = 21.0
"""Squared distance from `TYPICAL`, in standard deviations, beyond which no train has such a curve:
chance exceeds it once in 10,000 trains. A driver who holds one effort all day cannot be
distinguished from a train that coasts with another curve, unless no train has that curve."""


OTHER_MASS = 0.03
"""Share by which masses of trips differ that is stated where they are pooled."""


def _segments_in_words(fit: TripCoastDown) -> Said:
    count, outliers = len(fit.segments), len(fit.outlier_segments)
    return Said(count, f"{count}" + f" ({counted(outliers, 'outlier')})" * bool(outliers))


def _half_band(fit: TripCoastDown) -> float:
    """Half the 95 % band over the curve, where that is least."""
    return 1.96 * float(np.min(fit.curve.share(np.linspace(*fit.curve.covered, 21))))


TRIP_COLUMNS = (
    Column("trip"),
    Column("speed from", of="source", rank=1),
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
        terms = [
            f"{value:.3g} {unit} v^{power}"
            for power, (value, (_, unit)) in enumerate(
                zip(self.curve.theta[1:], OVER_INERTIA, strict=True)
            )
        ]
        words = " + ".join(terms).replace(" v^0", "").replace("v^1", "v").replace("^2", "²")
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
        return with_origin(result_of(self), self.digests)


@dataclass(frozen=True, eq=False)
class Sources:
    """Trips that were given, and the files that they and the line came from.

    Attributes
    ----------
    trips : tuple of Trip
        In order of name; of several of one name the later ones are numbered. A log too long for
        the memory is several trips.
    line : Line or None
        For trips that carry none.
    digests : dict of str to str
        SHA-256 of the log of each trip that came from one, and of the file of the ``line``.
    logs : tuple of Path
        That were read.
    identities : tuple of TripIdentity or None
        Of the trips, in their order.
    """

    trips: tuple[Trip, ...]
    line: Line | None
    digests: dict[str, str]
    logs: tuple[Path, ...] = ()
    identities: tuple[TripIdentity | None, ...] = ()

    @staticmethod
    def of(
        trips: Given | Iterable[Given],
        line: Line | str | Path | None,
        topics: tuple[str, ...] = TOPICS,
    ) -> Sources:
        """The trips and the line given, read where they are paths."""
        found: list[tuple[Trip, str, TripIdentity | None]] = []
        logs: list[Path] = []
        for given in each_given(trips):
            digest = ""
            if isinstance(given, Path):
                logs.append(given)
                digest = sha256_of(given)
            found += [(v.trip, digest, v.identity) for v in views_of(given, topics)]
        found.sort(key=lambda each: (each[0].name, each[1], text_of(each[2])))
        every = _named_apart([trip for trip, _, _ in found])
        digests = {
            trip.name: digest for trip, (_, digest, _) in zip(every, found, strict=True) if digest
        }
        if isinstance(line, str | Path):
            digests["line"] = sha256_of(line)
            line = read_line(line)
        identities = tuple(identity for _, _, identity in found)
        return Sources(every, line, digests, tuple(logs), identities)

    def again(self, numbers: Sequence[int]) -> dict[int, str]:
        """Of the trips with these numbers those of a drive that another is of, with the reason."""
        known = []
        for number in numbers:
            name = self.trips[number].name
            order = (self.digests.get(name, ""), name)
            known.append(Known(name, self.identities[number], order))
        return {numbers[same.number]: same.sentence for same in same_drives(known)}

    @contextmanager
    def named_in_errors(self) -> Iterator[None]:
        """What the trips do not determine is reported with the logs that were read."""
        try:
            yield
        except NotIdentifiableError as error:
            if not self.logs:
                raise
            names = ", ".join(log.name for log in self.logs[:3])
            more = f" and {len(self.logs) - 3} more" if len(self.logs) > 3 else ""
            alone = len(self.logs) == 1
            raise NotIdentifiableError(
                error.problem if alone else f"{error.problem} (logs {names}{more})",
                file=self.logs[0] if alone else None,
                place=error.place,
                remedy=error.remedy,
            ) from error


def _named_apart(trips: Sequence[Trip]) -> tuple[Trip, ...]:
    """The trips, those of a name that was there before with a number."""
    seen: Counter[str] = Counter()
    found = []
    for trip in trips:
        seen[trip.name] += 1
        number = seen[trip.name]
        metadata = {**trip.metadata, "trip": f"{trip.name} ({number})"}
        found.append(trip if number == 1 else replace(trip, metadata=metadata))
    return tuple(found)


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
    known: `analysis.resistance.unknown_gradient.coast_down_without_gradient`.

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
    train, name = one_train(sources.trips)
    expected = MassRatio.expected(train)
    refused: dict[str, str] = {}
    found: dict[int, tuple[Motion, Line]] = {}
    for number, trip in enumerate(sources.trips):
        try:
            found[number] = _located(trip, sources.line)
        except NotIdentifiableError as error:
            refused[trip.name] = str(error)
    for number, reason in sources.again(list(found)).items():
        refused[sources.trips[number].name] = reason
        del found[number]
    moved = list(found.values())
    check_not_empty(moved, refused)
    strip_length = 0.0 if train is None else train.strip_length
    found_segments, evidence = _detected(moved, expected, strip_length)
    fits: list[TripCoastDown] = []
    for (motion, travelled), segments in zip(moved, found_segments, strict=True):
        try:
            fits.append(fit_segments(motion, travelled, segments, expected, strip_length))
        except NotIdentifiableError as error:
            refused[motion.trip] = str(error)
    check_not_empty(fits, refused)
    curve, between, ratio = combined(fits, expected)
    check_plausible(curve)
    check_supported(curve, speeds)
    used = {fit.trip for fit in fits}
    loads = [recorded_load(trip, train) for trip in sources.trips if trip.name in used]
    masses = [train.mass + load.value for load in loads if load is not None and train is not None]
    return CoastDown(
        name, curve, ratio, between, tuple(fits), refused, evidence, sources.digests,
        tuple(masses),
    )  # fmt: skip


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
    covered = (
        min(fit.curve.covered[0] for fit in fits),
        max(fit.curve.covered[1] for fit in fits),
    )
    ratio = _common_ratio(fits, expected)
    # Each trip's coefficients if it had this ratio, and what they would change with it.
    k = np.array([fit.free[0][0] for fit in fits])
    variance_k = np.array([fit.free[1][0, 0] for fit in fits])
    slopes = np.array([fit.free[1][1:, 0] / fit.free[1][0, 0] for fit in fits])
    given = np.array([fit.free[0][1:] for fit in fits]) + slopes * (ratio.value - k)[:, None]
    left = np.array([fit.free[1][1:, 1:] for fit in fits])
    left = left - np.einsum("k,ki,kj->kij", variance_k, slopes, slopes)
    nodes = nodes_over(np.linspace(*covered, len(TERMS)), given)
    back = np.linalg.inv(nodes)
    found = pooled(given @ nodes.T, nodes @ left @ nodes.T)
    variance = found.block(0, 0)
    weights = np.linalg.inv(found.within + nodes @ left @ nodes.T)
    slope = back @ variance @ np.einsum("kij,kj->i", weights, slopes @ nodes.T)
    theta = np.concatenate(([ratio.value], back @ found.mean))
    covariance = np.zeros((theta.size, theta.size))
    covariance[1:, 1:] = back @ variance @ back.T
    effect = np.concatenate(([1.0], slope)) * ratio.std
    curve = Curve(
        theta, covariance + np.outer(effect, effect), len(fits) - 1 + PRIOR_TRIPS, covered
    )
    return curve, back @ found.within @ back.T, ratio


def _common_ratio(fits: Sequence[TripCoastDown], expected: MassRatio) -> MassRatio:
    """Mass over inertia from all trips and what was expected of it."""
    k = np.array([fit.free[0][0] for fit in fits])
    information = 1.0 / (np.array([fit.free[1][0, 0] for fit in fits]) + RATIO_BETWEEN**2)
    data, prior = float(information.sum()), 1.0 / expected.std**2
    value = (float(information @ k) + prior * expected.value) / (data + prior)
    source = "data" if data > prior else expected.source
    return MassRatio(value, float((data + prior) ** -0.5), source)


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


def _located(trip: Trip, line: Line | None) -> tuple[Motion, Line]:
    """A trip's motion and the line as it travelled it."""
    motion = motion_of(trip)
    if not motion.has_position:
        raise NotIdentifiableError(
            f"trip '{trip.name}': where on the line the train was is not known",
            place="topics /estimates/state and /train/state",
            remedy="ingest the recording with --line, which turns satellite fixes into chainage",
        )
    way = travelled(trip, line)
    check_gradients(trip.name, way)
    return motion, way


def check_gradients(trip: str, line: Line) -> None:
    """Refuse a line that only assumes its gradients, or states them too roughly.

    Raises
    ------
    NotIdentifiableError
        Coasting and a slight effort are distinguished only where gradients are known to half of
        the spacing of the levels of effort.
    """
    worst = 0.5 * SPACING / GRAVITY
    if line.survey is not None and line.survey.gradient_std > worst:
        raise NotIdentifiableError(
            f"trip '{trip}': the gradients of line '{line.name}' are known to"
            f" {PER_MILLE * line.survey.gradient_std:.1f} per mille only, and coasting cannot be"
            f" found from motion above {PER_MILLE * worst:.1f} per mille",
            remedy="give more rides or better altitudes when the line is built, or take what needs"
            " no gradients ('--gradient unknown')",
        )
    if "gradients" in line.assumed:
        raise NotIdentifiableError(
            f"trip '{trip}': the gradients of line '{line.name}' are not known",
            remedy="build the line from three or more rides whose receivers give altitudes, state"
            " its gradients, or take what needs none ('--gradient unknown')",
        )


def one_train(trips: Sequence[Trip]) -> tuple[Train | None, str]:
    """The train of all trips and its name, if they state it; None and empty if not.

    Raises
    ------
    InputError
        If the trips are of different trains.
    """
    trains = [train_of(trip) for trip in trips if TRAIN_ATTACHMENT in trip.attachments]
    called = {train.name for train in trains}
    called |= {trip.metadata["train"] for trip in trips if trip.metadata.get("train")}
    if len(called) > 1:
        raise InputError(
            f"trips of different trains: {', '.join(sorted(called))}",
            remedy="fit each train apart",
        )
    return (trains[0] if trains else None), next(iter(called), "")


def travelled(trip: Trip, line: Line | None) -> Line:
    """The line as the trip met it: the given one, or the one that the trip carries.

    Raises
    ------
    LogError
        If there is none.
    """
    if line is None or LINE_ATTACHMENT in trip.attachments:
        return line_of(trip)
    return line.travelled(trip.metadata.get("direction"))


def _detected(
    moved: Sequence[tuple[Motion, Line]], expected: MassRatio, strip_length: float
) -> tuple[list[tuple[Segment, ...]], float]:
    blocks = []
    for motion, line in moved:
        track = line.track_acceleration(np.nan_to_num(motion.position), strip_length)
        track[~np.isfinite(motion.position)] = np.nan
        blocks.append(blocks_of(motion, track))
    return detect(blocks, (expected.value, expected.std))


def check_not_empty(found: Sequence[object], refused: dict[str, str]) -> None:
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


NAMES = (("mass_ratio", "1"), *OVER_INERTIA)
"""Parameters of the curve, in the order of its covariance, with their units."""

SPEEDS = 25
"""Rows of the curve's table."""


def result_of(found: CoastDown) -> CoastDownResult:
    """The file's content; the provenance is added by whoever read the files."""
    curve = found.curve
    std = np.sqrt(np.diag(curve.covariance))
    reason = None if found.ratio.source == "data" else f"expected: {found.ratio.source}"
    return CoastDownResult(
        train=found.train,
        gradient="line",
        quantities=tuple(
            Identified(name, unit, float(value), float(deviation), reason if not number else None)
            for number, ((name, unit), value, deviation) in enumerate(
                zip(NAMES, curve.theta, std, strict=True)
            )
        ),
        covariance=curve.covariance,
        curve=table_of(found),
        trips=[trip_detail(fit) for fit in found.trips] + refusals(found.refused),
    )


def table_of(found: CoastDown) -> DragCurve | None:
    """The curve over the speeds that the data support."""
    supported = found.curve.supported
    if supported is None:
        return None
    speed = np.linspace(*supported, SPEEDS)
    low, high = found.curve.band(speed)
    return DragCurve(speed, found.curve(speed), low, high)


def trip_detail(fit: TripCoastDown) -> dict[str, Any]:
    """What is noted of a trip that was fitted."""
    motion = fit.motion
    return {
        "trip": fit.trip,
        "accepted": True,
        "speed_from": fit.source,
        "coasted": fit.coasted,
        "covered": list(fit.curve.covered),
        "supported": None if fit.curve.supported is None else list(fit.curve.supported),
        "fitted": {
            name: float(value) for (name, _), value in zip(NAMES, fit.curve.theta, strict=True)
        },
        "fitted_std": {
            name: float(value)
            for (name, _), value in zip(NAMES, np.sqrt(np.diag(fit.curve.covariance)), strict=True)
        },
        "windows": fit.windows,
        "noise": fit.noise,
        "cluster_factor": fit.cluster_factor,
        "residual_std": fit.residual_std,
        "segments": [segment_detail(motion, segment) for segment in fit.segments],
        "outlier_segments": [segment_detail(motion, segment) for segment in fit.outlier_segments],
    }


def segment_detail(motion: Motion, segment: Segment) -> dict[str, Any]:
    """When, where and how fast a coasting segment was."""
    ends = np.array([segment.start, segment.end])
    speed = np.interp(ends, motion.time, motion.speed)
    position = np.interp(ends, motion.time, motion.position)
    return {
        "start": str((motion.start + pd.Timedelta(seconds=round(segment.start, 3))).isoformat()),
        "duration": round(segment.duration, 3),
        "position": np.round(position, 1).tolist(),
        "speed": np.round(speed, 3).tolist(),
        "probability": round(segment.probability, 4),
    }


def refusals(refused: dict[str, str]) -> list[dict[str, Any]]:
    """What is noted of trips that contribute nothing."""
    return [
        {"trip": name, "accepted": False, "reason": reason}
        for name, reason in sorted(refused.items())
    ]


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
