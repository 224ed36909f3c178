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
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from scipy.integrate import cumulative_trapezoid

from analysis.resistance.coast_down import SHORTEST_RANGE, Curve, Sources, with_origin
from analysis.resistance.coasting_detection import (
    SHORTEST,
    TOPICS,
    Motion,
    motion_of,
    smoothed_over,
)
from analysis.view import Given, TripView
from estimators.regression import Free, regress
from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import NotIdentifiableError
from trainlog.formats.railway import CoastDownResult, Identified
from trainlog.railway.line import Line
from trainlog.railway.resistance import LARGEST_STD, OVER_INERTIA, OVER_MASS_STD, TERMS, basis
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

MERGED = "merged with the gradient: no piece was coasted in both directions"
WIDE = "pieces coasted in both directions give it to more than 10 % of the curve only"
"""Why c0 is not identified."""


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
    _check_repeated(rows["piece"])
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


def _check_repeated(piece: pd.Series) -> None:
    """Refuse passages of which none repeats a piece at another speed, or hardly any do."""
    count = piece.value_counts()
    again = int(count[count > 1].sum())
    if again - int((count > 1).sum()) - len(TERMS) < FEWEST_FREE:
        raise NotIdentifiableError(
            f"with the gradient unknown, {len(piece)} passages over {len(count)} pieces of"
            f" {PIECE:.0f} m, {again} of them over a piece coasted more than once, do"
            " not separate resistance from gradient",
            remedy="give the line's gradients, or more trips that coast over the same track",
        )


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
