"""Linear mixed model of many trips of many trains, with heavy tails.

A trip i of a train shows values that are the sum of what the kind of train has in common, of
effects that it shares with others, and of what is its own:

    y_i = mean + sum over groups g of Z_gi u_g(i) + t_i + e_i,    e_i ~ N(0, variance_i).

The effects of a group of which the spread is looked for (trains, say) follow a multivariate
Student distribution, and so do the trips' own deviations t_i: a train or a trip that is unlike all
others counts little in what is said of the others, and is itself drawn less towards them. Effects
whose spread is known (errors of a line's survey) are normal.

All effects come of one system of equations (Henderson's mixed model equations); spreads and
weights of expectation maximisation, the Student distribution being a mixture of normal ones.

References
----------
Henderson, C. R. (1975), Best linear unbiased estimation and prediction under a selection model,
Biometrics 31(2), eq. (5).
Laird, N. M., Ware, J. H. (1982), Random-effects models for longitudinal data, Biometrics 38(4).
Pinheiro, J. C., Liu, C., Wu, Y. N. (2001), Efficient algorithms for robust estimation in linear
mixed-effects models using the multivariate t distribution, Journal of Computational and Graphical
Statistics 10(2), section 3.
Satterthwaite, F. E. (1946), An approximate distribution of estimates of variance components,
Biometrics Bulletin 2(6).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import lapack
from scipy.sparse import bsr_array, csr_array

from trainlog.arrays import BoolArray, FloatArray, IntArray

TAIL = 5.0
"""Degrees of freedom of the Student distributions of trains and of trips."""

ROUNDS = 200
"""Most extrapolations, of two steps of the expectation maximisation each."""

TOLERANCE = 1e-3
"""Relative change of the spreads in a step that ends the search, unless another is asked for."""

LONGEST_STEP = 16.0
"""Times a step of the expectation maximisation that an extrapolation goes at most."""


@dataclass(frozen=True, eq=False)
class Group:
    """Effects that trips share.

    Attributes
    ----------
    index : (k,) int array
        Number of the effect that each trip has, from 0 up; -1: none.
    count : int
        How many effects there are, also such as no trip has.
    loading : (k, d, d) array or None
        By which each trip has it; None: as it is.
    spread : (d, d) array
        Covariance of the effects: the expected one where it is looked for.
    prior : float
        The expected spread counts as so many effects; infinite: it is known.
    heavy : bool
        Whether the effects follow a Student distribution.
    """

    index: IntArray
    count: int
    loading: FloatArray | None
    spread: FloatArray
    prior: float = np.inf
    heavy: bool = False


@dataclass(frozen=True, eq=False)
class MixedEffects:
    """The effects of a mixed model, and their spreads.

    Attributes
    ----------
    mean : (d,) array
    effects : tuple of (count, d) arrays
        Of each group.
    covariance : (n, d, n, d) array
        Of the mean (first) and all effects, in the order of the groups.
    first : tuple of int
        Place of each group's first effect there.
    spreads : tuple of (d, d) arrays
        Of each group; of Student distributions the scale.
    within : (d, d) array
        Scale of the trips' own deviations.
    weights : (k,) array
        Of each trip; 1 for one like the others, towards 0 for one that is unlike them.
    """

    mean: FloatArray
    effects: tuple[FloatArray, ...]
    covariance: FloatArray
    first: tuple[int, ...]
    spreads: tuple[FloatArray, ...]
    within: FloatArray
    weights: FloatArray
    _model: _Model
    _equations: tuple[FloatArray, FloatArray]
    _trusts: tuple[FloatArray, ...]

    def left_out(self, trips: BoolArray) -> FloatArray:
        """What the other trips make of some trips (n, d) that are left out, with their spreads."""
        model = self._model
        left, right = self._equations
        mine = np.flatnonzero(trips)
        own_left, own_right = model.equations(self.within, self.weights, mine)
        effects, _ = model.solved(left - own_left, right - own_right)
        return model.expected(effects)[mine]

    def single(self) -> tuple[FloatArray, FloatArray]:
        """Each trip as its own errors leave it, (k, d), and its covariance (k, d, d).

        Drawn towards what mean and effects make of it by as much as its own variance warrants;
        Laird and Ware (1982), eq. (3.2).
        """
        gain, own = self._model.gains(self.within, self.weights)
        effects = np.concatenate([self.mean[None], *self.effects])
        expected = self._model.expected(effects)
        value = expected + np.einsum("kij,kj->ki", gain, self._model.values - expected)
        rest = np.eye(own.shape[-1]) - gain
        shared = self._model.uncertainty(self.covariance)
        found = own - gain @ own + rest @ shared @ rest.transpose(0, 2, 1)
        return value, 0.5 * (found + found.transpose(0, 2, 1))

    def without(self, group: int) -> FloatArray:
        """What mean and effects but those of a group make of all trips, (k, d)."""
        effects = np.concatenate([self.mean[None], *self.effects])
        first = self.first[group]
        effects[first : first + len(self.effects[group])] = 0.0
        return self._model.expected(effects)

    def block(self, one: int, other: int) -> FloatArray:
        """Covariance (d, d) of two effects, by their places."""
        return np.asarray(self.covariance[one, :, other, :])

    def of(self, group: int, number: int) -> tuple[FloatArray, FloatArray]:
        """Mean plus an effect of a group, and its covariance."""
        place = self.first[group] + number
        covariance = self.block(0, 0) + self.block(place, place)
        crossed = self.block(0, place)
        return self.mean + self.effects[group][number], covariance + crossed + crossed.T

    def rests_on(self, group: int, number: int) -> float:
        """Share of the covariance of `of` that follows the spread of the group.

        The relative change of its variances with those of the spread: 0 where an effect's own trips
        determine it, 1 where it is only known that effects differ by so much. With it follow the
        degrees of freedom (Satterthwaite 1946).
        """
        _, covariance = self.of(group, number)
        place = self.first[group]
        every = place + np.arange(len(self.effects[group]))
        with_all = self.covariance[0][:, every] + self.covariance[place + number][:, every]
        change = np.einsum("ikj,kjl,mkl->im", with_all, self._trusts[group], with_all)
        return float(np.trace(change) / np.trace(covariance))


def mixed_effects(
    values: FloatArray,
    variances: FloatArray,
    groups: Sequence[Group],
    within: FloatArray,
    prior_trips: float,
    *,
    tail: float = TAIL,
    tolerance: float = TOLERANCE,
) -> MixedEffects:
    """Mean and effects of trips.

    Parameters
    ----------
    values : (k, d) array
        Of about the same size in every column.
    variances : (k, d, d) array
        Of each trip's own error, without what the groups bring in.
    groups : sequence of Group
    within : (d, d) array
        Expected scale of the trips' own deviations.
    prior_trips : float
        This expectation counts as so many trips.
    tail : float
        Degrees of freedom of the Student distributions; infinite: all are normal.
    tolerance : float
        Relative change of the spreads in a step that ends the search.

    Examples
    --------
    Two trains of three trips, the last trip unlike the others:

    >>> y = np.array([[1.0], [1.1], [0.9], [2.0], [2.1], [9.0]])
    >>> train = Group(np.array([0, 0, 0, 1, 1, 1]), 2, None, np.eye(1), 2.0)
    >>> found = mixed_effects(y, np.full((6, 1, 1), 0.01), [train], 0.01 * np.eye(1), 2.0)
    >>> [round(float(found.of(0, number)[0][0]), 1) for number in (0, 1)], found.weights[5] < 0.1
    ([1.1, 2.1], np.True_)
    """
    model = _Model(values, variances, groups, tail)
    start = _State(
        within, [group.spread for group in groups], [np.ones(group.count) for group in groups],
        np.ones(len(values)),
    )  # fmt: skip
    state, found = start, model.solve(start)
    for _ in range(ROUNDS):
        states, change = [state], np.inf
        while len(states) < 3 and change >= tolerance:
            states.append(model.advanced(states[-1], found, within, prior_trips))
            found = model.solve(states[-1])
            change = _change(states[-2], states[-1])
        state = states[-1]
        if change < tolerance:
            break
        state = _extrapolated(*states)
        found = model.solve(state)
    spreads, heavies = state.spreads, state.heavies
    effects, covariance = found
    trusts = tuple(
        heavy[:, None, None] * np.linalg.inv(spread)
        for spread, heavy in zip(spreads, heavies, strict=True)
    )
    return MixedEffects(
        mean=effects[0],
        effects=tuple(
            effects[first : first + group.count]
            for first, group in zip(model.first, groups, strict=True)
        ),
        covariance=covariance,
        first=tuple(model.first),
        spreads=tuple(spreads),
        within=state.scale,
        weights=state.weights,
        _model=model,
        _equations=model.complete(state),
        _trusts=trusts,
    )


@dataclass(frozen=True, eq=False)
class _State:
    """Spreads, and the weights of trips, and of effects of groups, that follow from them."""

    scale: FloatArray
    spreads: list[FloatArray]
    heavies: list[FloatArray]
    weights: FloatArray

    @property
    def logarithms(self) -> FloatArray:
        """Matrix logarithms of all spreads, (n, d, d)."""
        tiny = np.finfo(np.float64).tiny
        spreads = np.stack([self.scale, *self.spreads])
        return of_eigenvalues(spreads, lambda values: np.log(np.maximum(values, tiny)))


def of_eigenvalues(
    matrices: FloatArray, function: Callable[[FloatArray], FloatArray]
) -> FloatArray:
    """Symmetric matrices (k, p, p) with a function of their eigenvalues in place of these."""
    values, vectors = np.linalg.eigh(matrices)
    return np.asarray((vectors * function(values)[:, None, :]) @ vectors.transpose(0, 2, 1))


def _change(one: _State, other: _State) -> float:
    """Largest relative change of a spread."""
    return max(
        float(np.max(np.abs(new - old)) / np.max(np.abs(old)))
        for new, old in zip([other.scale, *other.spreads], [one.scale, *one.spreads], strict=True)
    )


def _extrapolated(start: _State, one: _State, two: _State) -> _State:
    """Where three states in a row lead to.

    Varadhan, R., Roland, C. (2008), Simple and globally convergent methods for accelerating the
    convergence of any EM algorithm, Scandinavian Journal of Statistics 35(2), scheme S3; of
    the logarithms, so that spreads stay positive.
    """
    first, middle, last = start.logarithms, one.logarithms, two.logarithms
    step, bend = middle - first, last - 2.0 * middle + first
    length = float(np.linalg.norm(step) / max(float(np.linalg.norm(bend)), 1e-12))
    length = min(max(length, 1.0), LONGEST_STEP)
    found = of_eigenvalues(first + 2.0 * length * step + length**2 * bend, np.exp)
    return _State(found[0], list(found[1:]), two.heavies, two.weights)


Solution = tuple[FloatArray, FloatArray]
"""Effects (n, d) and their covariance (n, d, n, d), the mean first."""


class _Model:
    """The trips' values, and which effects they have."""

    def __init__(
        self, values: FloatArray, variances: FloatArray, groups: Sequence[Group], tail: float
    ) -> None:
        self.values, self.variances, self.groups, self.tail = values, variances, groups, tail
        counts = [group.count for group in groups]
        self.first = (1 + np.concatenate([[0], np.cumsum(counts)])[:-1]).astype(int).tolist()
        self.size = 1 + sum(counts)
        self.met = [
            np.bincount(group.index[group.index >= 0], minlength=group.count) > 0
            for group in groups
        ]
        k, d = values.shape
        one = np.broadcast_to(np.eye(d), (k, d, d))
        # The mean is an effect that every trip has.
        self.places = np.zeros((1 + len(groups), k), dtype=np.int64)
        self.loadings = np.zeros((1 + len(groups), k, d, d))
        self.loadings[0] = one
        for number, (first, group) in enumerate(zip(self.first, groups, strict=True), start=1):
            has = group.index >= 0
            self.places[number] = np.where(has, first + group.index, 0)
            self.loadings[number] = one if group.loading is None else group.loading
            self.loadings[number, ~has] = 0.0
        row = d * np.arange(k)[:, None, None] + np.arange(d)[:, None]
        column = d * self.places[:, :, None, None] + np.arange(d)
        at = [np.broadcast_to(each, self.loadings.shape).ravel() for each in (row, column)]
        self.design = csr_array((self.loadings.ravel(), at), shape=(k * d, self.size * d))
        self.design.eliminate_zeros()

    def solve(self, state: _State) -> Solution:
        """Mean and effects; Henderson (1975), eq. (5)."""
        return self.solved(*self.complete(state))

    def advanced(
        self, state: _State, found: Solution, within: FloatArray, prior_trips: float
    ) -> _State:
        """The state after a step of the expectation maximisation."""
        square = self.deviations(found, state.scale, state.weights)
        weights = self.trusted(square, state.scale)
        scale = _spread(square, weights, within, prior_trips)
        spreads, heavies = list(state.spreads), list(state.heavies)
        for number, group in enumerate(self.groups):
            if np.isinf(group.prior) or group.count == 0:
                continue
            square = self.squares(found, number)
            used = self.met[number]
            if group.heavy:
                heavies[number] = np.where(used, self.trusted(square, spreads[number]), 1.0)
            spreads[number] = _spread(
                square[used], heavies[number][used], group.spread, group.prior
            )
        return _State(scale, spreads, heavies, weights)

    def complete(self, state: _State) -> tuple[FloatArray, FloatArray]:
        """The equations of all trips, with what is known of the effects beforehand."""
        left, right = self.equations(state.scale, state.weights, np.arange(len(self.values)))
        for first, group, spread, heavy in zip(
            self.first, self.groups, state.spreads, state.heavies, strict=True
        ):
            here = first + np.arange(group.count)
            left[here, :, here, :] += heavy[:, None, None] * np.linalg.inv(spread)
        return left, right

    def equations(
        self, scale: FloatArray, weights: FloatArray, trips: IntArray
    ) -> tuple[FloatArray, FloatArray]:
        """What some trips add to both sides, (n, d, n, d) and (n, d)."""
        trust = np.linalg.inv(self.variances[trips] + scale / weights[trips, None, None])
        k, d = self.values[trips].shape
        design = self.design[(d * trips[:, None] + np.arange(d)).ravel()]
        trusted = bsr_array((trust, np.arange(k), np.arange(k + 1)), shape=(k * d, k * d)) @ design
        left = (trusted.T @ design).toarray().reshape(self.size, d, self.size, d)
        return left, (trusted.T @ self.values[trips].ravel()).reshape(self.size, d)

    def solved(self, left: FloatArray, right: FloatArray) -> Solution:
        """Effects and their covariance."""
        factor, singular = lapack.dpotrf(left.reshape(right.size, right.size))
        upper, _ = lapack.dpotri(factor)
        if singular:
            raise np.linalg.LinAlgError("the equations of mean and effects are singular")
        covariance = np.triu(upper) + np.triu(upper, 1).T
        return (covariance @ right.ravel()).reshape(right.shape), covariance.reshape(left.shape)

    def expected(self, effects: FloatArray) -> FloatArray:
        """What mean and effects make of each trip, (k, d)."""
        return np.asarray((self.design @ effects.ravel()).reshape(self.values.shape))

    def uncertainty(self, covariance: FloatArray) -> FloatArray:
        """Covariance of `expected`, (k, d, d)."""
        found = np.zeros_like(self.variances)
        for one, own in zip(self.places, self.loadings, strict=True):
            for other, its in zip(self.places, self.loadings, strict=True):
                found += own @ covariance[one, :, other, :] @ its.transpose(0, 2, 1)
        return found

    def gains(self, scale: FloatArray, weights: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Share of a difference that is a trip's own, and its variance, each (k, d, d)."""
        own = scale / weights[:, None, None]
        return own @ np.linalg.inv(self.variances + own), own

    def deviations(self, found: Solution, scale: FloatArray, weights: FloatArray) -> FloatArray:
        """Expected squares (k, d, d) of the trips' own deviations."""
        effects, covariance = found
        gain, own = self.gains(scale, weights)
        rest = np.einsum("kij,kj->ki", gain, self.values - self.expected(effects))
        square = rest[:, :, None] * rest[:, None, :] + own - gain @ own
        square += gain @ self.uncertainty(covariance) @ gain.transpose(0, 2, 1)
        return np.asarray(square)

    def squares(self, found: Solution, number: int) -> FloatArray:
        """Expected squares (count, d, d) of the effects of a group."""
        effects, covariance = found
        here = self.first[number] + np.arange(self.groups[number].count)
        own = effects[here]
        return np.asarray(own[:, :, None] * own[:, None, :] + covariance[here, :, here, :])

    def trusted(self, square: FloatArray, spread: FloatArray) -> FloatArray:
        """Weight of each draw of a Student distribution, of its expected square (n, d, d)."""
        if np.isinf(self.tail):
            return np.ones(len(square))
        distance = np.einsum("kij,ji->k", square, np.linalg.inv(spread))
        return np.asarray((self.tail + spread.shape[0]) / (self.tail + distance))


def _spread(
    square: FloatArray, weights: FloatArray, expected: FloatArray, prior: float
) -> FloatArray:
    """Scale of draws by their expected squares and weights."""
    total = np.einsum("k,kij->ij", weights, square) + prior * expected
    return np.asarray(total / (len(square) + prior))
