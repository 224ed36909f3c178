"""Forward-backward passes over the places and the days of a line's track condition.

Two time scales. What lasts is a Markov process along the line: normal rail and slippery places
(two classes that alternate), in each of which the logarithm of the maximum adhesion is an
Ornstein-Uhlenbeck process. It is solved on a grid of levels, so that the likelihood of a bin may
have any form (Kitagawa 1987, JASA 82(400), section 2). What passes is a hidden Markov chain over
the days of a bin: no spot, or a spot of some level that began before and may last; besides, single
trips meet spots that are gone the same day. A spot covers several bins: its indicators are coupled
along the line, day by day. The chains of places and of days exchange messages until they agree
(loopy belief propagation: Murphy, Weiss and Jordan 1999, UAI).
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.lib.stride_tricks import as_strided

from trainlog.arrays import BoolArray, FloatArray, IntArray

FAST = {"reassoc", "contract", "nsz"}
"""Freedom of the compiler to add up in another order, so that sums are vectorised."""


def diagonals_of(kernels: FloatArray) -> tuple[IntArray, FloatArray]:
    """Half band width of each kernel; diagonals of the kernels, and of the kernels transposed.

    Diagonal ``d`` of class ``c`` holds ``kernels[c, j + d - edge, j]`` at ``j``; `edge` is the
    largest half width.
    """
    classes, size, _ = kernels.shape
    cells = np.arange(size)
    half = np.max(np.abs(cells[:, None] - cells) * (kernels > 0.0), axis=(1, 2))
    edge = int(half.max())
    bands = np.zeros((2, classes, size + 2 * edge, size))
    bands[:, :, edge : edge + size] = kernels, kernels.transpose(0, 2, 1)
    *others, down, right = bands.strides
    shape = (2, classes, 2 * edge + 1, size)
    return half, as_strided(bands, shape, (*others, down, down + right)).copy()


@njit(cache=True, error_model="numpy", fastmath=FAST)  # type: ignore[untyped-decorator]
def _banded(diagonals: FloatArray, half: int, given: FloatArray, out: FloatArray) -> None:
    """``out[j] = sum_d diagonals[d, j] given[j + d]`` over the diagonals of half a band width."""
    edge = diagonals.shape[0] // 2
    for j in range(out.size):
        out[j] = 0.0
    for d in range(edge - half, edge + half + 1):
        row, shifted = diagonals[d], given[d : d + out.size]
        for j in range(out.size):
            out[j] += row[j] * shifted[j]


@njit(cache=True, error_model="numpy", fastmath=FAST)  # type: ignore[untyped-decorator]
def _product(one: FloatArray, other: FloatArray) -> float:
    """Sum of the products of two arrays, (n,)."""
    total = 0.0
    for i in range(one.size):
        total += one[i] * other[i]
    return total


@njit(cache=True, error_model="numpy", fastmath=FAST)  # type: ignore[untyped-decorator]
def along_line(
    likelihood: FloatArray,
    flat: BoolArray,
    share: FloatArray,
    start: FloatArray,
    half: IntArray,
    diagonals: FloatArray,
    switch: FloatArray,
    fresh: BoolArray,
    likelihood_only: bool,
) -> tuple[float, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Forward-backward over bins of several classes on a grid.

    Parameters
    ----------
    likelihood : (n, k) array
        Of each bin by level, largest 1.
    flat : (n,) bool array
        Bins that are left out of `moves` and `held`: they hold no evidence to speak of.
    share : (c,) array
        Stationary probability of each class.
    start : (c, k) array
        Stationary distribution of the level in each class.
    half, diagonals : arrays
        Transition of the level within each class, as `diagonals_of` gives it.
    switch : (c, c) array
        Transition between classes.
    fresh : (c, c) bool array
        Whether the level is drawn anew from the other's `start`; else it goes on.
    likelihood_only : bool
        Then the other answers are empty.

    Returns
    -------
    log_likelihood : float
    cavity : (n, k) array
        Distribution of each bin's level from all other bins.
    low : (n,) array
        Posterior probability of the last class.
    moves : (c, c) array
        Expected transitions between classes.
    held : (c, k) array
        Sum of the posterior probability of each class and level.
    """
    bins, size = likelihood.shape
    classes, edge = share.size, half.max()
    inner = slice(edge, edge + size)
    ahead = np.empty((1 if likelihood_only else bins, classes, size))
    # With cells of 0 on either side, which the diagonals reach.
    now, behind = np.zeros((classes, size + 2 * edge)), np.zeros((classes, size + 2 * edge))
    moved, back = np.empty((classes, size)), np.empty((classes, size))
    mass, drawn_from = np.zeros(classes), np.zeros(classes)
    log_likelihood = 0.0
    for b in range(bins):
        into = 0 if likelihood_only else b
        for c in range(classes):
            if b > 0:
                _banded(diagonals[0, c], half[c], now[c], moved[c])
        for c in range(classes):
            drawn, here = 0.0 if b > 0 else share[c], ahead[into, c]
            here[:] = 0.0
            for other in range(classes):
                if b > 0 and fresh[other, c]:
                    drawn += switch[other, c] * mass[other]
                elif b > 0 and switch[other, c] > 0.0:
                    here += switch[other, c] * moved[other]
            here += drawn * start[c]
        for c in range(classes):
            now[c, inner] = ahead[into, c] * likelihood[b]
            mass[c] = _product(ahead[into, c], likelihood[b])
        scale = mass.sum()
        log_likelihood += np.log(scale)
        mass /= scale
        now /= scale
    held, moves = np.zeros((classes, size)), np.zeros((classes, classes))
    known = 0 if likelihood_only else bins
    cavity, low = np.zeros((known, size)), np.zeros(known)
    behind[:, inner] = 1.0
    joint = np.zeros((classes, classes))
    for b in range(known - 1, -1, -1):
        for c in range(classes):
            here, given = ahead[b, c], behind[c, inner]
            cavity[b] += here * given
            given *= likelihood[b]
            mass[c], drawn_from[c] = _product(here, given), _product(start[c], given)
        cavity[b] /= cavity[b].sum()
        low[b] = mass[classes - 1] / mass.sum()
        if not flat[b]:
            held += ahead[b] * behind[:, inner] / mass.sum()
        if b == 0:
            break
        for c in range(classes):
            _banded(diagonals[1, c], half[c], behind[c], back[c])
        for c in range(classes):
            given, drawn = behind[c, inner], 0.0
            given[:] = 0.0
            for to in range(classes):
                if fresh[c, to]:
                    drawn += switch[c, to] * drawn_from[to]
                elif switch[c, to] > 0.0:
                    given += switch[c, to] * back[to]
            given += drawn
            if not (flat[b] and flat[b - 1]):
                left = ahead[b - 1, c] * likelihood[b - 1]
                for to in range(classes):
                    met = drawn_from[to] * left.sum() if fresh[c, to] else _product(left, back[to])
                    joint[c, to] = switch[c, to] * met
        if not (flat[b] and flat[b - 1]):
            moves += joint / joint.sum()
        behind /= behind.max()
    return log_likelihood, cavity, low, moves, held


NEGLIGIBLE = 40.0
"""Log likelihoods by so much smaller than another add nothing to it."""

WIDE, OFTEN = 3.0, 0.15
"""Some measurements scatter by this factor more, and how often: their errors are not normal."""


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def emissions(
    onset: FloatArray,
    used_start: IntArray,
    used_level: IntArray,
    used_trips: FloatArray,
    log_tail: FloatArray,
    levels: FloatArray,
    spot: FloatArray,
    trip_std: float,
    met: float,
    near: FloatArray,
    place: IntArray,
    astray: float,
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Log likelihood of each row (a bin on a day) by level: without spot, and with a short one.

    Parameters
    ----------
    onset : (r, 4) array
        Trips with onsets; their mean, variance about it, and mean variance of one's error.
    used_start : (r + 1,) int array
        Where each row's entries of `used_level` and `used_trips` begin.
    log_tail : (levels, k) array
        Log probability that a trip's maximum is at least a level, by lasting level.
    levels : (k,) array
    spot : (k,) array
        Distribution of the level of spots.
    met : float
        Short spots that a trip meets in a bin.
    near : (m, k) array
        Distribution of the level that the neighbours of a bin with onsets have.
    place : (r,) int array
        Row's bin in `near`.
    astray : float
        Probability that an onset was in a neighbour of its bin.

    Returns
    -------
    plain, short : (r, k) array
    number : (r, k) array
        Trips that met short spots, expected where any did.
    """
    rows, size = onset.shape[0], levels.size
    plain = np.zeros((rows, size))
    short, number = np.full((rows, size), -np.inf), np.ones((rows, size))
    beyond = np.maximum(1.0 - np.cumsum(spot), 0.0)
    for r in range(rows):
        bearing, trips = np.zeros(size), onset[r, 0]
        for e in range(used_start[r], used_start[r + 1]):
            trips += used_trips[e]
            bearing += used_trips[e] * log_tail[used_level[e]]
        count = int(onset[r, 0])
        if count == 0:
            plain[r] = bearing
            continue
        mean, scatter = onset[r, 1], onset[r, 2]
        variance = trip_std**2 + onset[r, 3]
        wide = (WIDE * trip_std) ** 2 + onset[r, 3]
        constant = -0.5 * np.log(2.0 * np.pi * variance)
        large = -0.5 * np.log(2.0 * np.pi * wide)
        apart = (mean - levels) ** 2 + scatter
        narrow = np.log(1.0 - OFTEN) + count * (constant - 0.5 * apart / variance)
        plain[r] = bearing + np.logaddexp(
            narrow, np.log(OFTEN) + count * (large - 0.5 * apart / wide)
        )
        # The lowest k of the onsets were of short spots, each of its own or all of one, or in a
        # neighbouring bin; the others as ever.
        shared = 0.5 * met
        for k in range(1, count + 1):
            shared *= k / (trips - k + 1.0)
            if 6 < k < count:
                continue
            high = mean + np.sqrt(scatter * k / (count - k)) if k < count else 0.0
            below = mean - np.sqrt(scatter * (count - k) / k)
            inner = scatter if k == count else 0.0
            one = 1.0 / np.sqrt(2.0 * np.pi * variance)
            all_of = np.exp((k - 1) * constant - 0.5 * np.log(k) - 0.5 * k * inner / variance)
            all_of *= shared * np.sqrt(k) * one
            passed, passed_all, strayed = 0.0, 0.0, 0.0
            for i in range(size):
                away = (below - levels[i]) ** 2 / variance
                if away < 60.0:
                    strayed += near[place[r], i] * np.exp(-0.5 * away)
            strayed = k * np.log(astray * one * strayed + 1e-300)
            for i in range(size):
                away = 0.5 * (below - levels[i]) ** 2 / variance
                here, here_all = one * np.exp(-away), all_of * np.exp(-k * away)
                passed += spot[i] * here
                passed_all += spot[i] * here_all
                own = (met * (passed + beyond[i] * here)) ** k
                value = own + passed_all + beyond[i] * here_all
                value = np.log(value + 1e-300)
                others = bearing[i]
                if k < count:
                    others += (count - k) * (constant - 0.5 * (high - levels[i]) ** 2 / variance)
                value, other = value + others, strayed + others
                if other > plain[r, i] - NEGLIGIBLE:
                    plain[r, i] = np.logaddexp(plain[r, i], other)
                top = max(short[r, i], value)
                if top > -np.inf:
                    kept, new = np.exp(short[r, i] - top), np.exp(value - top)
                    short[r, i] = top + np.log(kept + new)
                    number[r, i] += (k - number[r, i]) * new / (kept + new)
    return plain, short, number


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _log_mean_exp(values: FloatArray, weights: FloatArray) -> float:
    top = values.max()
    return float(top + np.log((weights * np.exp(values - top)).sum()))


def blurred(probability: FloatArray, std: FloatArray, step: float) -> FloatArray:
    """Each row of probabilities on a grid, with a normal error of its own added; (n, k) array."""
    size = probability.shape[1]
    half = np.minimum((4.5 * std / step).astype(np.int64) + 1, size - 1)
    away = np.arange(int(half.max()) + 1)
    kernel = np.exp(-0.5 * (away * step / std[:, None]) ** 2)
    kernel[away > half[:, None]] = 0.0
    sides = np.cumsum(kernel, axis=1)
    cells = np.arange(size)
    reach = [np.minimum(each, away[-1]) for each in (cells, size - 1 - cells)]
    share = probability / (sides[:, reach[0]] + sides[:, reach[1]] - kernel[:, :1])
    out = kernel[:, :1] * share
    for g in range(1, away.size):
        moved = kernel[:, g : g + 1] * share
        out[:, g:] += moved[:, :-g]
        out[:, :-g] += moved[:, g:]
    return np.asarray(out / out.sum(axis=1, keepdims=True))


@njit(cache=True, error_model="numpy", fastmath=FAST)  # type: ignore[untyped-decorator]
def over_days(
    bin_start: IntArray,
    day: FloatArray,
    plain: FloatArray,
    short: FloatArray,
    message: FloatArray,
    cavity: FloatArray,
    levels: FloatArray,
    cells: IntArray,
    spot: FloatArray,
    occupied: float,
    life: float,
    lasting: FloatArray,
    with_cut: bool,
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray, FloatArray, FloatArray]:
    """Forward-backward over the days of each bin, for each lasting level.

    Parameters
    ----------
    bin_start : (m + 1,) int array
        Rows of each bin.
    day : (r,) array
    plain, short : (r, k) array
        Of `emissions`.
    message : (r,) array
        Log odds of a spot in the row, from its neighbours along the line.
    cavity : (m, k) array
        Distribution of each bin's lasting level from all other bins.
    cells : (s,) int array
        Cells of the grid that are the levels of lasting spots.
    spot : (s,) array
        Distribution over them.
    occupied, life : float
        Share of the time in which a spot lies in a bin, and how long one stays [days].
    lasting : (k,) array
        Distribution of the lasting level before any evidence.
    with_cut : bool
        Whether `cut` is asked for; else it is 0.

    Returns
    -------
    log_likelihood : (m, k) array
        Of the lasting level.
    present, long : (r,) array
        Posterior probability of any spot in the row, and of one that lasts.
    state : (m, s) array
        Probability of a lasting spot of each level in the end.
    turnover : (4,) array
        Expected births, days without a spot, deaths, days with one.
    cut : (r,) array
        Log likelihood ratio of a lasting level that is another from the row on; 0 in a bin's first.
    """
    bins, size, states = bin_start.size - 1, levels.size, cells.size
    rows = day.size
    log_likelihood = np.empty((bins, size))
    present, long = np.zeros(rows), np.zeros(rows)
    state = np.zeros((bins, states))
    turnover, cut = np.zeros(4), np.zeros(rows)
    for b in range(bins):
        first, last = bin_start[b], bin_start[b + 1]
        count = last - first
        none = np.empty(count)
        spots = np.empty((count, states))
        none_now = np.empty(count)
        shorts = np.empty(count)
        long_at = np.empty((count, size))
        short_at = np.empty((count, size))
        final = np.empty((size, states))
        back = np.empty(states)
        emitted = np.empty(states)
        shift, stays, raised = np.empty(count), np.ones(count), np.empty(count)
        bears, meets = np.empty((count, size)), np.empty((count, size))
        turned = np.zeros((size, 4))
        before_cut = np.zeros((count, size))
        after_cut = np.zeros((count, size))
        for r in range(first, last):
            n = r - first
            shift[n] = max(plain[r].max(), short[r].max() + message[r])
            raised[n] = np.exp(message[r])
            if n > 0:
                stays[n] = np.exp(-(day[r] - day[r - 1]) / life)
            bears[n] = np.exp(plain[r] - shift[n])
            meets[n] = np.exp(short[r] + message[r] - shift[n])
        for i in range(size):
            # Spots above the lasting level change nothing: only those below are states.
            held = 0
            below = 0.0
            while held < states and cells[held] < i:
                below += spot[held]
                held += 1
            free, total = 1.0 - occupied * below, 0.0
            for j in range(held):
                # A neighbour's spot makes one here likelier once, when it begins: it is the same
                # spot on all its days.
                spots[0, j] = occupied * spot[j] * raised[0]
            empty = free
            log_like = 0.0
            for n in range(count):
                if n > 0:
                    stay, alive = stays[n], 0.0
                    for j in range(held):
                        alive += spots[n - 1, j]
                    before = none[n - 1]
                    empty = before * (1.0 - occupied * below * (1.0 - stay)) + (
                        alive * (1.0 - stay) * (1.0 - occupied * below)
                    )
                    for j in range(held):
                        spots[n, j] = spots[n - 1, j] * stay + (
                            (before + alive) * (1.0 - stay) * occupied * spot[j] * raised[n]
                        )
                a, c = bears[n, i], meets[n, i]
                none_now[n] = a
                shorts[n] = c
                total = empty * (a + c)
                for j in range(held):
                    spots[n, j] *= bears[n, cells[j]]
                    total += spots[n, j]
                total = max(total, 1e-280)
                none[n] = empty * (a + c) / total
                for j in range(held):
                    spots[n, j] /= total
                before_cut[n, i] = log_like
                log_like += np.log(total) + shift[n]
            log_likelihood[b, i] = log_like
            for j in range(states):
                final[i, j] = spots[count - 1, j] if j < held else 0.0
            free = 1.0
            for j in range(held):
                back[j] = 1.0
            scale = 0.0
            for n in range(count - 1, -1, -1):
                alive, norm = 0.0, 0.0
                for j in range(held):
                    alive += spots[n, j] * back[j]
                norm = max(alive + none[n] * free, 1e-300)
                long_at[n, i] = alive / norm
                short_at[n, i] = (
                    (1.0 - alive / norm) * shorts[n] / max(none_now[n] + shorts[n], 1e-300)
                )
                if n > 0:
                    stay = stays[n]
                    open_ = (none_now[n] + shorts[n]) * free
                    drawn, kept = 0.0, 0.0
                    for j in range(held):
                        emitted[j] = bears[n, cells[j]] * back[j]
                        drawn += occupied * spot[j] * emitted[j] * raised[n]
                        kept += spots[n - 1, j] * stay * emitted[j]
                    rest = (1.0 - stay) * (drawn + (1.0 - occupied * below) * open_)
                    if with_cut:
                        fresh = max(drawn + (1.0 - occupied * below) * open_, 1e-290)
                        after_cut[n, i] = scale + shift[n] + np.log(fresh)
                    alive = 1.0 - none[n - 1]
                    born = none[n - 1] * (1.0 - stay) * drawn
                    died = alive * (1.0 - stay) * (1.0 - occupied * below) * open_
                    calm = none[n - 1] * open_ * (stay + (1.0 - stay) * (1.0 - occupied * below))
                    kept += alive * (1.0 - stay) * drawn
                    every = max(born + died + calm + kept, 1e-300)
                    elapsed = life * (1.0 - stay)
                    turned[i, 0] += born / every
                    turned[i, 1] += elapsed * (born + calm) / every
                    turned[i, 2] += died / every
                    turned[i, 3] += elapsed * (died + kept) / every
                    free = stay * open_ + rest
                    top = free
                    for j in range(held):
                        back[j] = stay * emitted[j] + rest
                        top = max(top, back[j])
                    top = max(top, 1e-280)
                    if with_cut:
                        scale += np.log(top) + shift[n]
                    free /= top
                    for j in range(held):
                        back[j] /= top
        weight = cavity[b] * np.exp(log_likelihood[b] - log_likelihood[b].max())
        weight /= weight.sum()
        for n in range(count):
            long[first + n] = _product(weight, long_at[n])
            present[first + n] = long[first + n] + _product(weight, short_at[n])
        whole = _log_mean_exp(log_likelihood[b], lasting)
        for n in range(1, count if with_cut else 0):
            cut[first + n] = (
                _log_mean_exp(before_cut[n], lasting) + _log_mean_exp(after_cut[n], lasting) - whole
            )
        for i in range(size):
            turnover += weight[i] * turned[i]
            state[b] += weight[i] * final[i]
    return log_likelihood, present, long, state, turnover, cut


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _passed(
    message: float, odds: float, base: float, other: float, tie: float, alike: float
) -> float:
    """Message to a row with prior `other` from its neighbour with prior `base`."""
    lift = message + odds
    spot = 1.0 / (1.0 + (1.0 - base) / base * np.exp(-lift))
    one = spot * (tie + (1.0 - tie) * other) * alike + (1.0 - spot) * (1.0 - tie) * other
    none = spot * (1.0 - tie) * (1.0 - other) + (1.0 - spot) * (tie + (1.0 - tie) * (1.0 - other))
    return float(np.log(one / none) - np.log(other / (1.0 - other)))


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def beside(
    order: IntArray,
    day: IntArray,
    place: IntArray,
    odds: FloatArray,
    prior: FloatArray,
    level: FloatArray,
    noise: FloatArray,
    keep: float,
    spot_mean: float,
    spot_std: float,
) -> FloatArray:
    """Log odds that a row's neighbours on the same day give it, over those without them.

    Parameters
    ----------
    order : (r,) int array
        Rows by day and place.
    day, place : (r,) int array
        Day, bin.
    odds : (r,) array
        Log odds that each row's own evidence gives a spot.
    prior : (r,) array
        Probability of a spot before any evidence.
    level : (r,) array
        Mean log adhesion of the row's onsets; NaN without one.
    noise : (r,) array
        Its variance.
    keep : float
        Correlation of the indicators of neighbouring bins, and of the levels within a spot.
    spot_mean, spot_std : float
    """
    rows = order.size
    forward, message = np.zeros(rows), np.zeros(rows)
    alike = np.ones(rows)
    for n in range(1, rows):
        r, other = order[n], order[n - 1]
        if day[r] == day[other]:
            tie = keep ** (place[r] - place[other])
            if np.isfinite(level[r]) and np.isfinite(level[other]):
                one, two = spot_std**2 + noise[r], spot_std**2 + noise[other]
                share = tie * spot_std**2 / np.sqrt(one * two)
                a, b = (
                    (level[r] - spot_mean) / np.sqrt(one),
                    (level[other] - spot_mean) / np.sqrt(two),
                )
                rest = 1.0 - share**2
                alike[n] = np.exp(
                    -0.5 * (share**2 * (a * a + b * b) - 2.0 * share * a * b) / rest
                ) / np.sqrt(rest)
            forward[n] = _passed(forward[n - 1], odds[other], prior[other], prior[r], tie, alike[n])
    backward = 0.0
    for n in range(rows - 1, -1, -1):
        r = order[n]
        if n < rows - 1 and day[order[n + 1]] == day[r]:
            other = order[n + 1]
            tie = keep ** (place[other] - place[r])
            backward = _passed(backward, odds[other], prior[other], prior[r], tie, alike[n + 1])
        else:
            backward = 0.0
        message[r] = forward[n] + backward
    return message
