"""The regression over the windows of a trip: `estimators.regression`, with its noise.

The windows are whitened (`analysis.resistance.noise`), so that their regression is generalised
least squares. Handed one by one to the UD-factorised recursion of `estimators.regression` they give
what was known on the way.

Two errors of the recorded efforts are estimated along as nuisances, with a prior: a delay against
the speed, and a wrong scale of the dynamic brake against traction. So is the resistance of tunnels
where a trip runs through any: how many times what is expected of it.

The covariance is that of the noise model, made larger where neighbouring windows err together
more than the model says (wind, say): the cluster-robust covariance, clusters being stretches of
consecutive windows, gives the factor.

`diagnosed` judges the residuals: whitened, they should be independent, normal, of unit variance,
and have nothing to do with speed. Where they are not, the band holds less than it states.

References
----------
Ljung, G. M., Box, G. E. P. (1978), On a measure of lack of fit in time series models, Biometrika
65(2): the statistic over several lags.
Jarque, C. M., Bera, A. K. (1987), A test for normality of observations and regression residuals,
International Statistical Review 55(2).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from analysis.resistance.noise import (
    PRIOR,
    Expected,
    Likelihood,
    NoiseModel,
    NoiseParts,
    WindowPoints,
    Windows,
    estimate_noise,
    shares,
)
from estimators.regression import Cut, Free, RecursiveLeastSquares, Regression, regress
from trainlog.arrays import BoolArray, FloatArray, IntArray
from trainlog.railway.resistance import OVER_MASS_STD, TERMS

LARGEST_CONDITION = 300.0
"""Column-normalised condition number beyond which the parameters cannot be separated."""

LAGS = 10
"""Neighbours over which correlation is looked for."""

DOUBTFUL = 1e-3
"""Probability below which a property is called missing; trips are many, false alarms few."""

RESIDUAL_STD_RANGE = (0.7, 1.4)
"""Standard deviation outside this range means that the noise is not as large as estimated."""


@dataclass(frozen=True, eq=False)
class Residuals:
    """Whitened residuals of the windows used; (n,) arrays.

    Attributes
    ----------
    time : array [s]
        End of the window since the trip's first sample.
    position : array [m]
    speed : array [m/s]
        Mean over the window.
    value : array [1]
    """

    time: FloatArray
    position: FloatArray
    speed: FloatArray
    value: FloatArray

    def correlation(self, lags: int = LAGS) -> FloatArray:
        """Autocorrelation (lags,) of the residuals, from lag 1."""
        value = self.value - self.value.mean()
        power = max(float(value @ value), 1e-300)
        lags = min(lags, value.size - 1)
        return np.array([value[k:] @ value[:-k] / power for k in range(1, lags + 1)])


@dataclass(frozen=True, slots=True)
class Diagnosis:
    """What the residuals of a trip say about its fit.

    Attributes
    ----------
    std : float
        Should be 1.
    independence, normality, flatness : float
        Probability of residuals at least so strange, if they are independent (Ljung and Box),
        normal (Jarque and Bera), and do not rise or fall with speed (Spearman).
    doubts : tuple of str
        What is missing, in words; empty if nothing is.
    """

    std: float
    independence: float
    normality: float
    flatness: float
    doubts: tuple[str, ...]


def diagnosed(residuals: Residuals) -> Diagnosis:
    """What the residuals say; at least three of them."""
    value = residuals.value
    count = value.size
    std = float(np.sqrt(np.mean(value**2)))
    from scipy.stats import chi2, jarque_bera, spearmanr

    correlation = residuals.correlation()
    lags = np.arange(1, correlation.size + 1)
    statistic = count * (count + 2.0) * float(np.sum(correlation**2 / (count - lags)))
    independence = float(chi2.sf(statistic, correlation.size))
    spread = float(np.ptp(value)) > 0.0
    normality = float(jarque_bera(value).pvalue) if spread else 1.0
    moving = spread and float(np.ptp(residuals.speed)) > 0.0
    flatness = float(spearmanr(residuals.speed, value).pvalue) if moving else 1.0
    doubts = []
    if not RESIDUAL_STD_RANGE[0] <= std <= RESIDUAL_STD_RANGE[1]:
        doubts.append(f"residuals of {std:.2f} standard deviations: the noise is misjudged")
    if independence < DOUBTFUL:
        doubts.append(
            "neighbouring windows err together: something lasting is left out (wind, map, effort)"
        )
    if normality < DOUBTFUL:
        doubts.append("residuals are not normal: a few windows are far off")
    if flatness < DOUBTFUL:
        doubts.append("residuals change with speed: the curve is not a parabola, or speed is off")
    return Diagnosis(std, independence, normality, flatness, tuple(doubts))


DELAY_STD = 0.05
"""Standard deviation of the delay of recorded efforts [s]: half a sample at 10 Hz."""

BRAKE_SCALE_STD = 0.02
"""Standard deviation of the dynamic brake's recorded effort over that of traction."""

TUNNEL_STD = 0.7
"""Standard deviation of the resistance that tunnels add, over what is expected of it."""

CUT = Cut(5.0, apart=9, rounds=60)
"""Of windows. Each round leaves out one at least, and most trips take one to three."""

_BLOCK = 4096
"""Windows whose history is made at once."""

CLUSTER = 80.0
"""Windows that begin within the same so many seconds form a cluster: one or two kilometres."""


OFFSET_STD = 0.03
"""Prior standard deviation of the force over mass [m/s²] by which a stretch is unlike the rest: a
brake that drags, or a gradient 3 per mille wrong."""

OFFSET_SHARE = 0.15
"""Standard deviation of r0 where efforts have an offset while pulling, as a share of it: the gain
of the efforts and their delay take up a part."""

STRETCHES = 3
"""Most stretches that are unlike the rest."""

PIECES = 60
"""Of a trip, at whose ends stretches begin and end."""

UNLIKE = 3.0, 16.0
"""Standard deviations of a stretch's force from which on it is looked at, and log odds of such a
stretch to none from which on it counts: some 1,800 are tried."""

LEAST_FORCE = 0.006
"""Force over mass [m/s²] below which a stretch is like the rest: surveys err by as much. Pulling is
spread over the whole trip, and an offset of it has no such bound."""


SHORT = 0.25
"""Share of a trip up to which what is unlike the rest is left to itself."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """A stretch of a trip whose force is unlike that of the rest.

    Attributes
    ----------
    start, end : float [s]
    share : float
        Of the time that is used.
    force, std : float [N]
        By which the running resistance there is larger than elsewhere.
    """

    start: float
    end: float
    share: float
    force: float = 0.0
    std: float = 0.0

    @property
    def ambiguous(self) -> bool:
        """Whether it is not short beside the rest: either may be the unlike one."""
        return self.share > SHORT

    def inside(self, windows: Windows) -> BoolArray:
        """Which windows lie in it."""
        return np.asarray((windows.start >= self.start) & (windows.end <= self.end))


@dataclass(frozen=True, eq=False)
class WindowFit:
    """Running resistance and mass from a set of windows.

    Attributes
    ----------
    beta : (p,) array
        Coefficients of the running resistance, and mass [kg].
    covariance : (p, p) array
    over_mass : (array (p,), array (p, p))
        1/m and the coefficients over the mass, with their covariance.
    survey : (p, p) array
        What the map's errors bring into it.
    freedom : float
        Degrees of freedom of the covariance: how well the noise's sizes are known.
    history, history_covariance : (n, p), (n, p, p) array
        The same after each window used.
    delay, brake_scale : float [s], [1]
        The nuisances: how late efforts were recorded, and the dynamic brake's over their size.
    noise : NoiseModel
    cluster_factor : float
        What the noise model's variances were multiplied by; 1 if the windows agree with it.
    residual : (n,) array
        Whitened residuals.
    kept : (windows,) bool array
        Which windows were used; the others are outliers.
    condition : float
        Column-normalised condition number of the regressors.
    inseparable : tuple of str
        Coefficients that take part in what is above `LARGEST_CONDITION`, and the mass if it does or
        is not positive: with hardly any acceleration that of the noise alone remains.
    stretches : tuple of Stretch
        Each with a force of its own.
    tunnels : (float, float), optional
        Resistance that tunnels add over what is expected of it, and its standard deviation; None:
        the trip ran through none.
    pulling : (float, float), optional [N]
        By how much recorded efforts are too high while pulling, and its standard deviation; None:
        pulling and coasting agree.
    """

    beta: FloatArray
    covariance: FloatArray
    over_mass: tuple[FloatArray, FloatArray]
    survey: FloatArray
    freedom: float
    history: FloatArray
    history_covariance: FloatArray
    delay: float
    brake_scale: float
    noise: NoiseModel
    cluster_factor: float
    residual: FloatArray
    kept: BoolArray
    condition: float
    inseparable: tuple[str, ...]
    stretches: tuple[Stretch, ...] = ()
    tunnels: tuple[float, float] | None = None
    pulling: tuple[float, float] | None = None

    def points(self, windows: Windows, unit: float = 1.0) -> WindowPoints:
        """The windows as points of the curve over the mass, times a unit.

        Those that were used are joined, outliers stand one by one.
        """
        mass, parts = self.beta[-1], []
        joined = windows.select(self.kept).merged()
        for part in (joined, windows.select(~self.kept)):
            impulse = part.x[:, 0] + self.delay * part.effort_change
            impulse = impulse + (self.brake_scale - 1.0) * part.braking
            if self.pulling is not None:
                impulse = impulse - self.pulling[0] * part.pulled
            value = (impulse / mass - part.y) / part.duration
            effort = (self.noise.effort**2 * part.effort_square + part.between) / mass**2
            std = np.sqrt(2.0 * self.noise.speed**2 + effort) / part.duration
            parts.append(np.stack([part.mean_speed, unit * value, unit * std]))
        speed, value, std = np.hstack(parts)
        return WindowPoints(speed, value, std, np.arange(speed.size) < joined.count)


class White:
    """Windows whitened by noise whose sizes are given, or found of those that are used.

    Parameters
    ----------
    windows : Windows
    mass : float [kg]
        To turn effort into acceleration.
    free : sequence of Free
    left : (n,) array [m/s]
        Left-hand side.
    noise : NoiseModel or Expected
    """

    def __init__(
        self,
        windows: Windows,
        mass: float,
        free: Sequence[Free],
        left: FloatArray,
        noise: NoiseModel | Expected,
    ) -> None:
        self.windows, self.mass, self.noise = windows, mass, PRIOR
        self.expected = noise
        self.columns = np.column_stack([*(each.column for each in free), left])
        self.prior = np.column_stack(
            [np.diag([1.0 / each.std for each in free]), [each.mean / each.std for each in free]]
        )

    def __call__(self, kept: BoolArray) -> FloatArray:
        """Regressors and left-hand side of the windows used."""
        self.used = self.windows.select(kept)
        parts, columns = NoiseParts.of(self.used, self.mass), self.columns[kept]
        if isinstance(self.expected, NoiseModel):
            self.noise = self.expected
        else:
            self.likelihood = Likelihood(parts, columns, self.prior, self.expected)
            self.noise = estimate_noise(self.likelihood)
        return parts.whiten(self.noise, columns)


def fit_windows(
    windows: Windows,
    mass: float,
    mass_std: float,
    expected_noise: Expected | None = None,
    delay_std: float = DELAY_STD,
    *,
    search: bool = False,
    stretches: tuple[Stretch, ...] = (),
    pulling: bool = False,
) -> WindowFit:
    """Fit the windows: inverse mass, curve, delay, scale of the brake over mass, and more.

    Parameters
    ----------
    windows : Windows
        At least a handful; refusing too few is the caller's business.
    mass, mass_std : float [kg]
        What is known beforehand; weak.
    expected_noise : Expected, optional
        Where the search for the noise begins, and towards what it is drawn.
    delay_std : float [s]
        Of the delay of the efforts, beforehand.
    search : bool
        Whether to look for stretches whose force is unlike that of the rest. Each has a force of
        its own; where it is not short beside the rest, r0 is between both, and its band holds both.
    stretches : tuple of Stretch
        That are known already.
    pulling : bool
        Whether efforts while pulling have an offset of their own; a search sets it where they
        contradict the motion while coasting.

    Returns
    -------
    WindowFit
    """
    free = [
        Free("1/m", windows.x[:, 0], mass_std / mass**2, 1.0 / mass),
        *(Free(*each) for each in zip(TERMS, windows.x[:, 1:].T, OVER_MASS_STD, strict=True)),
        Free("delay", windows.effort_change, delay_std / mass),
        Free("brake", windows.braking, BRAKE_SCALE_STD / mass),
    ]
    if windows.tunnel.any():
        free.append(Free("tunnel", -windows.tunnel, TUNNEL_STD / mass))
    if pulling:
        free.append(Free("pulling", -windows.pulled, OFFSET_STD))
    for number, each in enumerate(stretches):
        free.append(Free(str(number), -windows.duration * each.inside(windows), OFFSET_STD))
    white = White(windows, mass, free, windows.y, expected_noise or Expected())
    found = regress(white, free, CUT)
    more = None
    if search and len(stretches) < STRETCHES and not any(each.ambiguous for each in stretches):
        more = _unlike(white.used, white.likelihood, white.noise, found.rows.shape[1])
    if more is not None:
        return fit_windows(
            windows, mass, mass_std, expected_noise, delay_std,
            search=True, stretches=(*stretches, more), pulling=pulling,
        )  # fmt: skip
    if search and not pulling and _contradicted(white, found):
        return fit_windows(
            windows, mass, mass_std, expected_noise, delay_std, search=True, pulling=True
        )
    _, ratio, _ = found.clustered(white.used.start // CLUSTER)
    factor = max(1.0, ratio)
    found, size = found.wider(np.sqrt(factor)), len(TERMS) + 1
    beta, covariance = _history(free, found.rows, factor)
    own_force = []
    for number, each in enumerate(stretches):
        force, std = found.over(str(number), "1/m")
        own_force.append(replace(each, force=force, std=std))
    half = 0.5 * sum(each.force for each in own_force if each.ambiguous)
    beta[:, 0] += half
    covariance[:, 0, 0] += half**2
    offset = found.over("pulling", "1/m") if pulling else None
    if offset is not None:
        covariance[:, 0, 0] += (OFFSET_SHARE * offset[0]) ** 2
    freedom, survey = shares(white.likelihood, white.noise)
    _, survey = _physical(found.estimate[None], factor * survey[None])
    tunnels = None
    if windows.tunnel.any():
        beyond, std = found.over("tunnel", "1/m")
        tunnels = 1.0 + beyond, std
    return WindowFit(
        beta=beta[-1],
        covariance=covariance[-1],
        over_mass=(found.estimate[:size], found.covariance[:size, :size]),
        survey=survey[0],
        freedom=max(min(freedom, len(found.rows) - beta.shape[1]), 1.0),
        history=beta,
        history_covariance=covariance,
        delay=found.over("delay", "1/m")[0],
        brake_scale=1.0 + found.over("brake", "1/m")[0],
        noise=white.noise,
        cluster_factor=factor,
        residual=found.residual,
        kept=found.kept,
        **_separated(white.used.x, float(beta[-1, -1])),
        stretches=tuple(own_force),
        tunnels=tunnels,
        pulling=offset,
    )


def _contradicted(white: White, found: Regression) -> bool:
    """Whether windows in which the motors pull need another force than the others."""
    rows, likelihood, pulled = found.rows[:, :-1], white.likelihood, white.used.pulled
    own = likelihood.parts.whiten(white.noise, pulled[:, None])[:, 0]
    scaled = rows / np.maximum(np.linalg.norm(rows, axis=0), np.finfo(float).tiny)
    own = own - scaled @ np.linalg.lstsq(scaled, own)[0]
    if not (own @ found.residual) ** 2 > UNLIKE[0] ** 2 * float(own @ own):
        return False
    return _odds(likelihood, white.noise, -pulled, found.rows.shape[1])[0] > UNLIKE[1]


def _unlike(used: Windows, likelihood: Likelihood, noise: NoiseModel, count: int) -> Stretch | None:
    """The stretch whose force is most unlike that of the rest; None if none is.

    Forces of all stretches are tried at a gradient error that is not made larger by them; whether
    there is one is asked of the likelihoods, each with noise of its own. `count` is that of the
    columns of the likelihood.
    """
    if used.count < 4 * PIECES:
        return None
    small = noise._replace(gradient=min(noise.gradient, likelihood.expected.sizes.gradient))
    edges = np.linspace(0, used.count, PIECES + 1).astype(np.int64)
    for _ in range(2):
        score, first, last = _best_stretch(used, likelihood, small, edges)
        if score < UNLIKE[0] ** 2:
            return None
        near = np.linspace(-1.0, 1.0, PIECES // 3) * used.count / PIECES
        fine = np.concatenate([first + near, last + near, [0, used.count]])
        edges = np.unique(np.clip(fine, 0, used.count).astype(np.int64))
    if 2 * (last - first) > used.count and (first == 0 or last == used.count):
        # The shorter one of two parts is the unlike one.
        first, last = (last, used.count) if first == 0 else (0, first)
    share = float(used.duration[first:last].sum() / used.duration.sum())
    found = Stretch(float(used.start[first]), float(used.end[last - 1]), share)
    column = -used.duration * found.inside(used)
    odds, force = _odds(likelihood, noise, column, count)
    return found if odds > UNLIKE[1] and abs(force) > LEAST_FORCE else None


def _odds(
    likelihood: Likelihood, noise: NoiseModel, column: FloatArray, count: int
) -> tuple[float, float]:
    """Log odds of one parameter more, each with its own noise, and its estimate over the mass."""
    prior = np.vstack([likelihood.prior, np.zeros(count)])
    own = np.append(np.zeros(count - 1), 1.0 / OFFSET_STD)
    unlike = replace(
        likelihood,
        columns=np.insert(likelihood.columns, count - 1, column, axis=1),
        prior=np.insert(prior, count - 1, own, axis=1),
    )
    odds = likelihood.deviance(likelihood.place(noise)) - np.log(OFFSET_STD)
    with_it = estimate_noise(unlike)
    odds -= unlike.deviance(unlike.place(with_it))
    square, _ = unlike.square(unlike.place(with_it))
    return odds, float(np.linalg.solve(square[:-1, :-1], square[:-1, -1])[count - 1])


def _best_stretch(
    used: Windows, likelihood: Likelihood, noise: NoiseModel, edges: IntArray
) -> tuple[float, int, int]:
    """Of stretches between any two edges the one whose force is surest not to be 0.

    Its squared standard deviations, and the first window and the one behind the last.
    """
    pieces = edges.size - 1
    piece = np.repeat(np.arange(pieces), np.diff(edges))
    own = np.where(piece[:, None] == np.arange(pieces), -used.duration[:, None], 0.0)
    white = likelihood.parts.whiten(noise, np.column_stack([likelihood.columns, own]))
    count = likelihood.columns.shape[1]
    known = np.vstack([white[:, :count], likelihood.prior])
    own = np.vstack([white[:, count:], np.zeros((likelihood.prior.shape[0], pieces))])
    # What the parameters explain is taken out of both.
    basis = np.linalg.qr(known[:, :-1] / np.linalg.norm(known[:, :-1], axis=0))[0]
    left, own = (each - basis @ (basis.T @ each) for each in (known[:, -1], own))
    square = np.pad(np.cumsum(np.cumsum(own.T @ own, axis=0), axis=1), ((1, 0), (1, 0)))
    product = np.append(0.0, np.cumsum(own.T @ left))
    first, last = np.triu_indices(pieces + 1, 1)
    size = square[last, last] - 2.0 * square[first, last] + square[first, first]
    # Next to nothing is left of the force of the whole trip.
    shown = size > 1e-3 * (square[last, last] + square[first, first])
    moved = (product[last] - product[first]) ** 2
    score = np.where(shown, moved / np.where(shown, size, 1.0), 0.0)
    best = int(np.argmax(score))
    return float(score[best]), int(edges[first[best]]), int(edges[last[best]])


def _separated(x: FloatArray, mass: float) -> dict[str, Any]:
    """Condition number of regressors with their columns normalised; and which it does not separate.

    The latter have most of their variance from small singular values (Belsley, Kuh and Welsch 1980,
    Regression Diagnostics).
    """
    names = np.array(["mass", *TERMS])
    norms = np.linalg.norm(x, axis=0)
    if np.any(norms == 0.0):
        return {"condition": float("inf"), "inseparable": tuple(names[norms == 0.0].tolist())}
    _, singular, parts = np.linalg.svd(x / norms, full_matrices=False)
    variance = (parts / np.maximum(singular, 1e-300)[:, None]) ** 2
    small = singular * LARGEST_CONDITION < singular[0]
    taking = variance[small].sum(axis=0) > 0.5 * variance.sum(axis=0)
    taking[0] |= mass <= 0.0
    condition = float(singular[0] / singular[-1]) if singular[-1] > 0.0 else float("inf")
    return {"condition": condition, "inseparable": tuple(names[taking].tolist())}


def _history(
    free: Sequence[Free], rows: FloatArray, factor: float
) -> tuple[FloatArray, FloatArray]:
    """Resistance and mass after each window (n, p), and their covariance times `factor`.

    In blocks: a log of days has a hundred thousand windows.
    """
    recursion = RecursiveLeastSquares(
        [each.std for each in free], prior_mean=[each.mean for each in free]
    )
    size = len(TERMS) + 1
    beta, covariance = np.empty((len(rows), size)), np.empty((len(rows), size, size))
    for first in range(0, len(rows), _BLOCK):
        part = slice(first, first + _BLOCK)
        theta, spread = recursion.record(rows[part, :-1], rows[part, -1])
        beta[part], covariance[part] = _physical(theta, factor * spread)
    return beta, covariance


def _physical(theta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """From the acceleration form to the curve's coefficients and the mass, with the covariance."""
    inverse_mass, curve = theta[:, :1], np.arange(len(TERMS))
    beta = np.column_stack([theta[:, 1 + curve] / inverse_mass, 1.0 / inverse_mass])
    jacobian = np.zeros((len(theta), curve.size + 1, theta.shape[1]))
    jacobian[:, :, 0] = -beta / inverse_mass
    jacobian[:, curve, 1 + curve] = 1.0 / inverse_mass
    return beta, jacobian @ covariance @ jacobian.transpose(0, 2, 1)
