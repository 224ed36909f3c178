"""How far estimates moved: of single trips by their band, of means by the scatter of the shifts."""

from __future__ import annotations

from typing import Any

import numpy as np
import pandas as pd
from scipy.special import stdtr

from analysis.adhesion.map_difference import q_values
from analysis.fleet.diff_estimates import Values
from trainlog.arrays import BoolArray, FloatArray, IntArray

REACH = 1.96
"""Standard deviations of a band to one side."""

ROUNDING, ROUNDING_OF_BAND = 1e-6, 1e-3
"""Share of a value, and of its standard deviation, that rounding moves on other machines."""

WITHOUT_BAND = 0.01
"""Share of a value, or of the root mean square over all trips where that is more, that counts as
the band of a figure that is no count and has none of its own."""

RATE = 0.05
"""False discovery rate among the means over several trips."""

LEAST_TRIPS = 3
"""Of which a mean is judged."""

CLASSES = ("same", "rounding", "within", "beyond")
"""Of a difference: the same to the bit, within rounding, within the band, beyond the band."""

MOVED = (
    "analysis", "estimate", "unit", "key", "trip", "train", "kind", "place", "start",
    "first", "second", "std", "bands", "banded",
)  # fmt: skip
MEANS = (
    "analysis", "estimate", "unit", "of", "name", "trips", "moved", "value", "value_std",
    "shift", "shift_std", "bands", "p", "q", "systematic", "beyond",
)  # fmt: skip


def classes_of(mine: Values, its: Values) -> tuple[IntArray, FloatArray]:
    """Of each row the class of its difference, and the half width of its band."""
    a, b = mine.value, its.value
    difference = np.abs(b - a)
    std = np.fmin(np.where(mine.std > 0.0, mine.std, np.nan), its.std)
    std = np.where(std > 0.0, std, np.where(mine.std > 0.0, mine.std, np.nan))
    finite = a[np.isfinite(a)]
    typical = float(np.sqrt(np.mean(np.square(finite)))) if finite.size else 0.0
    size = np.fmax(np.abs(a), np.abs(b))
    rounding = ROUNDING * np.fmax(size, 1e-3 * typical) + ROUNDING_OF_BAND * np.nan_to_num(std)
    band = np.where(np.isfinite(std), REACH * std, WITHOUT_BAND * np.fmax(size, typical))
    found = np.full(a.size, CLASSES.index("beyond"))  # given by one side alone
    found[difference <= band] = CLASSES.index("within")
    found[difference <= rounding] = CLASSES.index("rounding")
    # A band that changed alone is no move of its estimate, but not the same either.
    equal = (a == b) | (np.isnan(a) & np.isnan(b))
    alike = (mine.std == its.std) | (np.isnan(mine.std) & np.isnan(its.std))
    found[equal] = CLASSES.index("within")
    near = np.abs(its.std - mine.std) <= 2.0 * ROUNDING_OF_BAND * mine.std
    found[equal & near] = CLASSES.index("rounding")
    found[equal & alike] = CLASSES.index("same")
    return found, band


def moved_rows(
    name: str,
    estimate: str,
    unit: str,
    about: pd.DataFrame,
    mine: Values,
    its: Values,
    band: FloatArray,
    rows: BoolArray,
) -> pd.DataFrame:
    """The rows of an estimate that moved beyond its band, by how many bands."""
    with np.errstate(divide="ignore", invalid="ignore"):
        bands = np.abs(its.value - mine.value)[rows] / band[rows]
    stated: dict[str, Any] = {
        "first": mine.value[rows],
        "second": its.value[rows],
        "std": mine.std[rows],
    }
    stated |= {"bands": np.where(np.isnan(bands), np.inf, bands)}
    stated |= {"banded": (mine.stated | its.stated)[rows]}
    return about.assign(analysis=name, estimate=estimate, unit=unit, **stated)


def mean_shifts(
    about: pd.DataFrame,
    estimate: str,
    unit: str,
    mine: Values,
    its: Values,
    classes: IntArray,
) -> pd.DataFrame:
    """The mean of a difference over all trips, over those of each train and of each place.

    Weighted by the precision of the first side, where it states one; a count by its own chance
    would weigh the small ones most, so that each counts alike. The standard error of the
    shift is that of the differences' own scatter; that of the mean value the larger of what the
    bands and the scatter of the values give.
    """
    both = np.isfinite(mine.value) & np.isfinite(its.value)
    banded = both & np.isfinite(mine.std) & mine.stated
    use = banded if banded.any() else both
    a, d = mine.value[use], (its.value - mine.value)[use]
    weight = mine.std[use] ** -2 if banded.any() else np.ones(a.size)
    moved = (classes > CLASSES.index("rounding"))[use]
    parts = []
    for of, names in (
        ("all trips", np.full(a.size, "all", dtype=object)),
        ("train", about["train"].to_numpy(object)[use]),
        ("place", about["place"].to_numpy(object)[use]),
    ):
        codes, labels = pd.factorize(names, sort=True)
        if of != "all trips" and len(labels) < 2:
            continue
        kept = codes >= 0
        sums = [
            np.bincount(codes[kept], each[kept], len(labels))
            for each in (np.ones(a.size), weight, weight * a, weight * d, moved * 1.0)
        ]
        count, total = sums[0], sums[1]
        value, shift = sums[2] / total, sums[3] / total
        scatter = [
            np.bincount(codes[kept], (weight**2 * (each - mean[codes]) ** 2)[kept], len(labels))
            for each, mean in ((a, value), (d, shift))
        ]
        spread = np.sqrt(count / np.maximum(count - 1, 1))
        value_std, shift_std = (spread * np.sqrt(each) / total for each in scatter)
        if banded.any():
            value_std = np.fmax(value_std, np.sqrt(1.0 / total))
        if mine.counted:
            chance = np.bincount(codes[kept], (mine.std[use] ** 2)[kept], len(labels))
            value_std = np.fmax(value_std, np.sqrt(chance) / total)
        parts.append(
            pd.DataFrame(
                {
                    "estimate": estimate, "unit": unit, "of": of, "name": labels,
                    "trips": count.astype(np.int64), "moved": sums[4].astype(np.int64),
                    "value": value, "value_std": value_std, "shift": shift, "shift_std": shift_std,
                }
            )
        )  # fmt: skip
    return pd.concat(parts, ignore_index=True)


def judged(means: pd.DataFrame) -> pd.DataFrame:
    """Means with the probability of their shift by chance, and what follows."""
    shift, std = (means[name].to_numpy(np.float64) for name in ("shift", "shift_std"))
    freedom = np.maximum(means["trips"].to_numpy(np.float64) - 1.0, 1.0)
    # A shift that is the same in all trips but for rounding has no scatter to be judged by.
    std = np.fmax(std, ROUNDING * np.abs(means["value"].to_numpy(np.float64)))
    with np.errstate(divide="ignore", invalid="ignore"):
        score = np.where(shift == 0.0, 0.0, np.abs(shift) / std)
        bands = np.abs(shift) / (REACH * means["value_std"].to_numpy(np.float64))
    judged = means["trips"].to_numpy() >= LEAST_TRIPS
    p = np.where(judged, 2.0 * stdtr(freedom, -score), 1.0)
    q = np.ones(p.size)
    q[judged] = q_values(p[judged])
    systematic = q <= RATE
    bands = np.where(shift == 0.0, 0.0, bands)
    found = means.assign(
        bands=bands, p=p, q=q, systematic=systematic, beyond=systematic & (bands > 1.0)
    )
    order = found.sort_values(["beyond", "bands"], ascending=False, ignore_index=True)
    return order[list(MEANS)]
