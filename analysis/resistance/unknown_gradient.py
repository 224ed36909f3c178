"""Coasting on a line whose gradients are not known: what can be identified then, and nothing else.

A held effort and a gradient look alike, so that coasting itself cannot be found: it must be known
from the lever or from a test's protocol. Over a piece of track of length L that a trip coasted
through from end to end, whatever its gradient does,

    (v_end² - v_start²) / 2 L = -d u - c0 - c1 <v> - c2 <v²>,       u = k g (mean gradient),

averages over the way, d = 1 along the line and -1 against it. Every piece has an unknown u of its
own. Hence

- the same piece coasted at different speeds gives c1 and c2, and the sum c0 + u of the piece;
- pieces coasted in both directions part c0 from u. Curves, which resist both ways, stay in c0;
- pieces coasted once give nothing.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from analysis.resistance.coast_down import Sources, check_not_empty, one_train, with_origin
from analysis.resistance.coasting_detection import SHORTEST
from analysis.resistance.coasting_fit import SHORTEST_RANGE
from analysis.resistance.curve import band_factor, curve_std
from analysis.resistance.motion import TOPICS, Motion, motion_of, smoothed_over
from analysis.resistance.regression import DRAG_STD
from analysis.view import Given
from estimators.regression import Free, regress
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import CoastDownResult, DragCurve, Identified, line_of
from trainlog.railway.line import Line
from trainlog.railway.resistance import LARGEST_STD, OVER_INERTIA, TERMS, basis
from trainlog.spans import runs_of
from trainlog.trip import LINE_ATTACHMENT, Trip, seconds
from trainlog.units import KMH

Spans = Sequence[tuple[float, float]]

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


@dataclass(frozen=True, eq=False)
class Passages:
    """Pieces that trips coasted through, one row a passage; arrays (n,).

    Attributes
    ----------
    trip : int array
    piece : int array
        Number of the piece along the line.
    way : array
        1 along the line, -1 against it.
    acceleration : array [m/s²]
        Mean over the way.
    curve : (n, p) array
        Means over the way of what each coefficient of the curve is multiplied by.
    noise : array [m/s²]
        Standard deviation that one end's speed brings in.
    joined : bool array
        Whether the trip's passage before ended where this one began.
    """

    trip: IntArray
    piece: IntArray
    way: FloatArray
    acceleration: FloatArray
    curve: FloatArray
    noise: FloatArray
    joined: BoolArray

    @property
    def speed(self) -> FloatArray:
        """Mean over the way [m/s]."""
        return self.curve[:, 1]


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
    _, train = one_train(sources.trips)
    found: dict[int, Passages] = {}
    refused: dict[int, str] = {}
    for number, trip in enumerate(sources.trips):
        try:
            motion = motion_of(trip)
            known = lever_at_rest(trip, motion) if spans is None else spans.get(trip.name, ())
            found[number] = passages(motion, known, number, _turned(trip, sources.line))
        except NotIdentifiableError as error:
            refused[number] = str(error)
    refused |= sources.again(list(found))
    parts = [each for number, each in found.items() if number not in refused]
    notes: list[dict[str, object]] = [
        {"trip": trip.name, "accepted": False, "reason": refused[number]}
        if number in refused
        else {"trip": trip.name, "accepted": True, "passages": int(found[number].piece.size)}
        for number, trip in enumerate(sources.trips)
    ]
    check_not_empty(
        parts, {str(each["trip"]): str(each["reason"]) for each in notes if "reason" in each}
    )
    rows = _joined(parts)
    _check_repeated(rows)
    return with_origin(replace(_solved(rows, notes), train=train), sources.digests)


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


def passages(motion: Motion, spans: Spans, trip: int, length: float | None) -> Passages:
    """The pieces of track that a trip coasted through from end to end.

    Parameters
    ----------
    motion : Motion
    spans : sequence of (float, float) [s]
    trip : int
        Its number.
    length : float [m] or None
        Of the line, if the trip ran against it; None if it ran along it.
    """
    way = 1.0 if length is None else -1.0
    place = motion.position if length is None else length - motion.position
    speed = smoothed_over(motion.time, motion.speed, AVERAGED)
    per_end = motion.noise / np.sqrt(max(2.0 * AVERAGED / motion.period, 1.0))
    rows: list[tuple[float, ...]] = []
    for begin, end in spans:
        inside = (motion.time >= begin + AVERAGED) & (motion.time <= end - AVERAGED)
        inside &= np.isfinite(place)
        if np.count_nonzero(inside) < 3 or not np.all(motion.usable[inside]):
            continue
        s, v = way * place[inside], speed[inside]
        s = np.maximum.accumulate(s + 1e-9 * np.arange(s.size))
        edges = np.arange(np.ceil(s[0] / PIECE), np.floor(s[-1] / PIECE) + 1.0)
        at = np.interp(edges * PIECE, s, v)
        area = np.array([_mean_over(s, column, edges) for column in basis(v).T])
        for k in range(edges.size - 1):
            piece = edges[k] if way > 0.0 else -edges[k + 1]
            gained = (at[k + 1] ** 2 - at[k] ** 2) / (2.0 * PIECE)
            noise = per_end * 0.5 * (at[k] + at[k + 1]) / PIECE
            rows.append((piece, gained, noise, float(k > 0), *area[:, k]))
    table = np.array(rows, dtype=np.float64).reshape(len(rows), 4 + len(TERMS))
    return Passages(
        trip=np.full(len(rows), trip),
        piece=table[:, 0].astype(np.int64),
        way=np.full(len(rows), way),
        acceleration=table[:, 1],
        curve=table[:, 4:],
        noise=table[:, 2],
        joined=table[:, 3] > 0.0,
    )


def _mean_over(s: FloatArray, values: FloatArray, edges: FloatArray) -> FloatArray:
    """Mean over each piece's way of values known at places."""
    return np.asarray(
        np.diff(np.interp(edges * PIECE, s, cumulative_trapezoid(values, s, initial=0.0))) / PIECE
    )


def _turned(trip: Trip, line: Line | None) -> float | None:
    """Length of the line [m] if the trip ran against it, None if along it."""
    if trip.metadata.get("direction") != "reverse":
        return None
    if LINE_ATTACHMENT in trip.attachments:
        return line_of(trip).length
    if line is not None:
        return line.length
    raise NotIdentifiableError(
        f"trip '{trip.name}' ran against a line whose length is not known",
        remedy="give the line, so that its chainage can be counted the other way",
    )


def _joined(parts: Sequence[Passages]) -> Passages:
    names = ("trip", "piece", "way", "acceleration", "curve", "noise", "joined")
    return Passages(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def _check_repeated(rows: Passages) -> None:
    """Refuse passages of which none repeats a piece at another speed, or hardly any do."""
    pieces, count = np.unique(rows.piece, return_counts=True)
    again = np.isin(rows.piece, pieces[count > 1])
    free = int(again.sum()) - int((count > 1).sum()) - 3
    if free < FEWEST_FREE:
        raise NotIdentifiableError(
            f"with the gradient unknown, {rows.piece.size} passages over {pieces.size} pieces of"
            f" {PIECE:.0f} m, {int(again.sum())} of them over a piece coasted more than once, do"
            " not separate resistance from gradient",
            remedy="give the line's gradients, or more trips that coast over the same track",
        )


def _whitened(rows: Passages, columns: FloatArray) -> FloatArray:
    """Columns with their noise made independent: joined passages share an end's speed."""
    covariance = np.diag(2.0 * rows.noise**2 + PLACE_STD**2)
    behind = np.flatnonzero(rows.joined[1:]) + 1
    shared = -rows.noise[behind] * rows.noise[behind - 1]
    covariance[behind, behind - 1] = covariance[behind - 1, behind] = shared
    return np.asarray(np.linalg.solve(np.linalg.cholesky(covariance), columns))


def _solved(rows: Passages, notes: list[dict[str, object]]) -> CoastDownResult:
    pieces, member = np.unique(rows.piece, return_inverse=True)
    along = -np.where(member[:, None] == np.arange(pieces.size), rows.way[:, None], 0.0)
    white = _whitened(rows, np.column_stack([-rows.curve, along, rows.acceleration]))
    stds = np.append(DRAG_STD, np.full(pieces.size, PIECE_STD))
    free = [Free(str(k), white[:, k], std) for k, std in enumerate(stds.tolist())]
    found = regress(white[:, -1], free)
    ways = np.zeros((2, pieces.size), dtype=np.bool_)
    ways[(rows.way > 0.0).astype(np.int64), member] = True
    both = bool(ways.all(axis=0).any())
    left = max(rows.piece.size - pieces.size - len(TERMS) + 1 - both, 1)
    found = found.wider(np.sqrt(max(1.0, float(found.residual @ found.residual) / left)))
    estimate, covariance = found.estimate, found.covariance
    _check_differences(rows, member, estimate, covariance)
    known = _curve(rows, estimate, covariance, left) if both else None
    quantities = _quantities(estimate, covariance, both, known is not None)
    kept = [number for number in range(len(TERMS)) if quantities[number].value is not None]
    return CoastDownResult(
        train="",
        gradient="unknown",
        quantities=quantities,
        covariance=covariance[np.ix_(kept, kept)],
        curve=known,
        trips=notes,
        pieces=_pieces(rows, pieces, estimate, covariance, known is not None),
    )


def _check_differences(
    rows: Passages, member: IntArray, estimate: FloatArray, covariance: FloatArray
) -> None:
    """Refuse speeds that do not differ, or differences that are not known to 10 %."""
    low, high = np.quantile(rows.speed, [0.05, 0.95])
    speeds = pd.Series(rows.speed).groupby(member)
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


def _curve(
    rows: Passages, estimate: FloatArray, covariance: FloatArray, free: int
) -> DragCurve | None:
    """The whole curve, if it is known to 10 % somewhere."""
    speed = np.linspace(float(rows.speed.min()), float(rows.speed.max()), 61)
    value = basis(speed) @ estimate[: len(TERMS)]
    std = curve_std(covariance[: len(TERMS), : len(TERMS)], speed)
    known = (value > 0.0) & (std <= LARGEST_STD * value)
    if not known.any() or np.ptp(speed[known]) < SHORTEST_RANGE:
        return None
    ends = float(speed[known][0]), float(speed[known][-1])
    reach = band_factor(covariance[: len(TERMS), : len(TERMS)], ends, free) * std[known]
    return DragCurve(speed[known], value[known], value[known] - reach, value[known] + reach)


def _quantities(
    estimate: FloatArray, covariance: FloatArray, both: bool, known: bool
) -> tuple[Identified, ...]:
    std = np.sqrt(np.diag(covariance)[: len(TERMS)])
    merged = "merged with the gradient: no piece was coasted in both directions"
    wide = "pieces coasted in both directions give it to more than 10 % of the curve only"
    values = zip(OVER_INERTIA, estimate.tolist(), std.tolist(), strict=False)
    first, *others = (Identified(*names, value, size) for names, value, size in values)
    if known:
        first = replace(first, reason="with the curves' resistance")
    else:
        first = replace(first, value=None, std=None, reason=wide if both else merged)
    return first, *others


def _pieces(
    rows: Passages,
    pieces: IntArray,
    estimate: FloatArray,
    covariance: FloatArray,
    parted: bool,
) -> list[dict[str, object]]:
    """Of each piece coasted more than once: c0 plus or, apart from c0, the gradient's part."""
    found: list[dict[str, object]] = []
    for number, piece in enumerate(pieces.tolist()):
        here = rows.piece == piece
        if np.count_nonzero(here) < 2:
            continue
        way = float(rows.way[here][0])
        pick = np.zeros(estimate.size)
        pick[3 + number] = 1.0 if parted else way
        pick[0] = 0.0 if parted else 1.0
        found.append(
            {
                "position": [PIECE * piece, PIECE * (piece + 1)],
                "direction": "forward" if way > 0.0 or parted else "reverse",
                "passages": int(np.count_nonzero(here)),
                "speed": [float(rows.speed[here].min()), float(rows.speed[here].max())],
                "quantity": "gradient" if parted else "c0 and gradient",
                "deceleration": float(pick @ estimate),
                "std": float(np.sqrt(pick @ covariance @ pick)),
            }
        )
    return found
