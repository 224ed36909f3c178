"""Windows, and their noise: a trip's samples as one row of a linear regression every second or so.

The equation of motion of a train of mass m whose rotating parts carry the momentum p_rot,

    m dv/dt + dp_rot/dt = F - m a_track(s) - r · basis(v),

divided by m and integrated over a window gives the acceleration form

    Δv + ∫ a_track dt = 1/m (∫ F dt - Δp_rot) - r/m · ∫ basis(v) dt,

linear in 1/m and the coefficients r/m of running resistance. The measured speed change and the
gradient stand on the left, so that the regressors carry next to no noise: what Δp_rot brings in is
a tenth of the noise of Δv and biases 1/m by some 1e-6 of itself. Speed at a window's ends is
averaged over half a window to either side; the integrals are averaged alike, so that the equation
still holds exactly. The averages of one stretch lie side by side, so that every sample of the speed
counts: windows of 10 s whose ends are averaged over 1 s leave nine tenths of them unused, and a
trip on long pieces of gradient is then known a fifth less well.

Four independent causes, each of one unknown size, make the windows' errors correlated:

- noise of the measured speed: two windows that share an end share its error, with opposite signs;
- gradient errors of the map: one random offset for every piece of the gradient profile;
- position errors: one random shift for every change of gradient;
- noise of the recorded effort, in proportion to it.

The sizes are found by restricted maximum likelihood with a weak prior, so that a trip on a
perfect map is not charged for the map's errors, nor the other way round.

The windows are made white by a Kalman filter whose state is the error of the last end and the
offsets of those pieces and changes of gradient that the present window shares with others. A
piece enters the state with its first window and leaves it with its last: the filter is exact,
its state stays small, and the work is linear in the length of the trip.

The covariance C of generalised least squares depends on these sizes, which are estimates
themselves. From how C and the likelihood change with the logarithm of each size follow

- how well the sizes are known, and with them C: as many degrees of freedom as a chi-squared
  variable of C's relative variance has. Thousands of windows on a hundred pieces of gradient know
  the map's error from a hundred draws, not from thousands;
- what part of C each cause brings in: with V = sum of sigma_c² V_c,

      C X' V^-1 (sigma_c² V_c) V^-1 X C = 1/2 dC / d ln(sigma_c).

References
----------
Patterson, H. D., Thompson, R. (1971), Recovery of inter-block information when block sizes are
unequal, Biometrika 58(3): restricted likelihood.
de Jong, P. (1991), The diffuse Kalman filter, Annals of Statistics 19(2): the regressors are
filtered beside the observations.
Satterthwaite, F. E. (1946), An approximate distribution of estimates of variance components,
Biometrics Bulletin 2(6).
Giesbrecht, F. G., Burns, J. C. (1985), Two-stage analysis based on a mixed model, Biometrics
41(2): the same for restricted likelihood, with its information matrix.
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, NamedTuple

import numpy as np
from numba import njit
from scipy.integrate import cumulative_trapezoid
from scipy.sparse import csr_array

from analysis.resistance.recording import Recording
from trainlog.arrays import BoolArray, FloatArray, IntArray, numbered
from trainlog.railway.line import Line
from trainlog.spans import runs_of
from trainlog.units import GRAVITY

WINDOW = 1.0
"""Length of a window [s]; short beside the time a train takes over a piece of gradient."""

SAMPLES = 3.0
"""A window is at least so many samples long."""

SLIP_NOISE = 30.0
"""The momentum of wheels that slip is known so many times worse than the impulse of the effort: the
axles' share of the rotating mass is often assumed, and their speeds may be recorded late."""

PULLING = 0.01
"""Share of the largest effort from which on the motors pull."""

MERGED = 10.0
"""Length of the windows that are looked at, in pictures and tables [s]."""


@dataclass(frozen=True, eq=False)
class Windows:
    """Rows of the regression, in order of time.

    Attributes
    ----------
    start, end : (n,) array [s]
        Middles of the averaged ends.
    y : (n,) array [m/s]
        Speed change plus integral of the track's deceleration.
    x : (n, p) array
        Impulse of the effort [N s], and minus the integrals of what the coefficients of running
        resistance are multiplied by: 1, v and v² (of a speed through the air).
    end_speed : (n,) array [m/s]
        Averaged at the end.
    braking : (n,) array [N s]
        Impulse of the dynamic brake: what a wrong scale of its effort does.
    tunnel : (n,) array [N s]
        Impulse of what tunnels are expected to add to the resistance.
    momentum : (n,) array [kg m/s]
        Change of the rotating parts' momentum, already taken off the impulse.
    effort_change : (n,) array [N]
        Between the ends: what a delay of the recorded effort does.
    effort_square : (n,) array [N² s²]
        Sum of the squared impulses of the samples: what noise of the recorded effort does; the
        momentum of wheels that slip counts `SLIP_NOISE` times.
    between : (n,) array [N² s²]
        Variance of the impulse by what the effort did between two of its samples.
    sections, edges : (n, k) sparse array
        Seconds in each piece of the gradient profile, and change of `y` by a metre of position
        error around each change of gradient.
    """

    start: FloatArray
    end: FloatArray
    y: FloatArray
    x: FloatArray
    end_speed: FloatArray
    braking: FloatArray
    tunnel: FloatArray
    momentum: FloatArray
    effort_change: FloatArray
    effort_square: FloatArray
    between: FloatArray
    sections: csr_array
    edges: csr_array

    @property
    def count(self) -> int:
        """Number of windows."""
        return int(self.y.size)

    @property
    def duration(self) -> FloatArray:
        """Length of each window [s]."""
        return self.end - self.start

    @property
    def mean_speed(self) -> FloatArray:
        """Mean speed in each window [m/s]."""
        return np.asarray(self.x[:, 2] / self.x[:, 1])

    @property
    def pulled(self) -> FloatArray:
        """Length of each window [s] in which the motors pull, else 0."""
        force = (self.x[:, 0] + self.momentum + self.braking + self.tunnel) / self.duration
        pulls = force > PULLING * np.max(force, initial=0.0)
        return np.where(pulls & (self.braking <= 0.0), self.duration, 0.0)

    def select(self, kept: BoolArray) -> Windows:
        """Some of the windows."""
        return Windows(*(getattr(self, item.name)[kept] for item in fields(self)))

    def merged(self) -> Windows:
        """Neighbours that join made into windows of `MERGED`, or as near as the stretch allows.

        Without `sections` and `edges`, which only their noise needs.
        """
        if not self.count:
            return self
        joined = np.append(False, self.start[1:] - self.end[:-1] < 1e-6)
        stretch = np.flatnonzero(~joined)
        number = np.arange(self.count) - np.repeat(stretch, np.diff(np.append(stretch, self.count)))
        together = max(round(MERGED / float(np.median(self.duration))), 1)
        first = np.flatnonzero(number % together == 0)
        last = np.append(first[1:], self.count) - 1
        summing = csr_array(
            (np.ones(self.count), np.arange(self.count), np.append(first, self.count))
        )
        ends: dict[str, Any] = {
            "start": self.start[first],
            "end": self.end[last],
            "end_speed": self.end_speed[last],
            "sections": self.sections[:0],
            "edges": self.edges[:0],
        }
        sums = {
            item.name: summing @ getattr(self, item.name)
            for item in fields(self)
            if item.name not in ends
        }
        return Windows(**ends, **sums)


@dataclass(frozen=True, eq=False)
class WindowPoints:
    """The data as points of a drag curve, one for every ten seconds; (n,) arrays.

    Attributes
    ----------
    speed : array [m/s]
    value, std : array [N], or [m/s²] where the train coasted
        Mean running resistance over this time, or that over inertia, from these windows alone and
        the fitted mass, or mass over inertia.
    used : bool array
        False for outliers, which stand alone.
    """

    speed: FloatArray
    value: FloatArray
    std: FloatArray
    used: BoolArray


def window_width(*times: FloatArray) -> float:
    """Length [s] of the windows of a recording with speeds and efforts at these times [s], (n,).

    Several samples of each, or the errors of neighbouring windows are alike.
    """
    steps = (float(np.median(np.diff(time))) for time in times if time.size > 1)
    return max(WINDOW, SAMPLES * max(steps, default=0.0))


def build_windows(recording: Recording, width: float | None = None) -> Windows:
    """Cut the usable stretches of a recording into windows.

    Parameters
    ----------
    recording : Recording
    width : float [s], optional
        Of a window; default: `window_width`.

    Returns
    -------
    Windows
        None of them (`count` 0) if no stretch is long enough.
    """
    time = recording.time
    width = width or window_width(time)
    # Each usable stretch cut into equal windows.
    first, last = np.array(runs_of(recording.usable), dtype=np.int64).reshape(-1, 2).T
    begin, finish = time[first] + 0.5 * width, time[last - 1] - 0.5 * width
    pieces = np.maximum(np.floor((finish - begin) / width + 1e-6), 0.0).astype(int)
    stretch, number = numbered(pieces)
    lengths = ((finish - begin) / np.maximum(pieces, 1))[stretch]
    start = begin[stretch] + number * lengths
    end = start + lengths
    of = recording
    forces = np.column_stack([of.effort, of.track, of.braking, of.tunnel, of.curve])
    integrals = cumulative_trapezoid(forces, time, axis=0, initial=0.0)
    plain = np.column_stack([of.speed, of.rotating_momentum, of.effort, of.slip_momentum])
    at_end = _averaged(time, plain, end, width)
    change = at_end - _averaged(time, plain, start, width)
    integral = _averaged(time, integrals, end, width) - _averaged(time, integrals, start, width)
    steps = np.gradient(time) if time.size > 1 else np.zeros(time.size)
    squares = np.column_stack([of.effort**2 * steps, of.between])
    squares = cumulative_trapezoid(squares, time, axis=0, initial=0.0)
    square, between = (_at(time, squares, end) - _at(time, squares, start)).T
    return Windows(
        start=start,
        end=end,
        y=change[:, 0] + integral[:, 1],
        x=np.column_stack([integral[:, 0] - change[:, 1], -integral[:, 4:]]),
        end_speed=at_end[:, 0],
        braking=integral[:, 2],
        tunnel=integral[:, 3],
        momentum=change[:, 1],
        effort_change=change[:, 2],
        effort_square=square + (SLIP_NOISE * change[:, 3]) ** 2,
        between=between,
        sections=_by_group(recording, np.ones(time.size), recording.section, start, end),
        edges=_by_group(recording, recording.track_slope, recording.nearest_edge, start, end),
    )


def _at(time: FloatArray, values: FloatArray, instants: FloatArray) -> FloatArray:
    """Values (m, c) on the straight lines between samples (n, c)."""
    index = np.clip(np.searchsorted(time, instants, side="right") - 1, 0, time.size - 2)
    share = ((instants - time[index]) / (time[index + 1] - time[index]))[:, None]
    return np.asarray((1.0 - share) * values[index] + share * values[index + 1])


def _averaged(
    time: FloatArray, values: FloatArray, instants: FloatArray, width: float
) -> FloatArray:
    """Mean (m, c) over half of `width` to either side of `instants` of sampled values (n, c)."""
    return integral_between(time, values, instants - 0.5 * width, instants + 0.5 * width) / width


def integral_between(
    time: FloatArray, values: FloatArray, low: FloatArray, high: FloatArray
) -> FloatArray:
    """Integral (m, c) from instants to others of the straight lines between samples (n, c)."""
    whole = cumulative_trapezoid(values, time, axis=0, initial=0.0)
    return _integral_up_to(time, values, whole, high) - _integral_up_to(time, values, whole, low)


def _integral_up_to(
    time: FloatArray, values: FloatArray, whole: FloatArray, instants: FloatArray
) -> FloatArray:
    index = np.clip(np.searchsorted(time, instants, side="right") - 1, 0, time.size - 2)
    into = (instants - time[index])[:, None]
    slope = (values[index + 1] - values[index]) / (time[index + 1] - time[index])[:, None]
    return np.asarray(whole[index] + into * (values[index] + 0.5 * slope * into))


def _by_group(
    recording: Recording, values: FloatArray, group: IntArray, start: FloatArray, end: FloatArray
) -> csr_array:
    """Integral (m, k) over each window of the `values` that belong to each group; k numbers it."""
    member = np.maximum(group, 0)
    time = recording.time
    step = np.zeros(time.size)
    step[1:] += 0.5 * np.diff(time)
    step[:-1] += 0.5 * np.diff(time)
    row = np.searchsorted(start, time, side="right") - 1
    inside = (row >= 0) & recording.usable
    inside[inside] &= time[inside] < end[row[inside]]
    # Entries on the same row and column are summed.
    return csr_array(
        ((values * step)[inside], (row[inside], member[inside])),
        shape=(start.size, int(member.max(initial=0)) + 1),
    )


# ------------------------------------------------------------------------------------- their noise

FLOOR = 1e-4
"""Smallest standard deviation of a window [m/s], so that exact data stay solvable."""


LONGEST_APART = 600.0
"""A piece that the train comes back to after more than this [s] counts as another piece, as it
does in another trip: the errors of a line that a train runs up and down all day would otherwise
all stay in the filter's state."""


class NoiseModel(NamedTuple):
    """Standard deviation of each cause of noise.

    Attributes
    ----------
    speed : float [m/s]
        Of the speed averaged at a window's end.
    gradient : float
        Of the gradient of one piece of the profile.
    position : float [m]
        Of the chainage at a change of gradient.
    effort : float
        Of one sample's effort, over the effort.
    """

    speed: float
    gradient: float
    position: float
    effort: float


CAUSES = NoiseModel._fields
"""The causes, in the order of `NoiseModel`."""

PRIOR = NoiseModel(speed=0.01, gradient=0.5e-3, position=10.0, effort=0.01)
"""Where the search begins: an ordinary survey and odometer."""

PRIOR_WIDTH = NoiseModel(speed=0.5, gradient=1.5, position=1.5, effort=1.0)
"""Standard deviation of the natural logarithm of each size around what is expected."""

SURVEYED_WIDTH = 0.2
"""The same of a gradient error that the line's file states: trusted to a fifth."""


@dataclass(frozen=True, slots=True)
class Expected:
    """What is expected of the sizes before a trip.

    Attributes
    ----------
    sizes : NoiseModel
    width : NoiseModel
        Standard deviation of the natural logarithm of each.
    """

    sizes: NoiseModel = PRIOR
    width: NoiseModel = PRIOR_WIDTH

    @staticmethod
    def on(line: Line) -> Expected:
        """On a line, whose file may state how well its gradients are known."""
        if line.survey is None:
            return Expected()
        return Expected(
            PRIOR._replace(gradient=line.survey.gradient_std),
            PRIOR_WIDTH._replace(gradient=SURVEYED_WIDTH),
        )


class NoiseParts(NamedTuple):
    """How each cause of noise enters the windows, at unit size.

    Attributes
    ----------
    joined : (n,) bool array
        Whether a window begins where the one before it ends.
    effort, between : (n,) array [(m/s)²]
        Variance by noise of the effort, over its square, and between its samples.
    first_entry : (n + 1,) int array
        Where the entries of each window begin in the four arrays that follow.
    value : (e,) array
        What one offset of a piece, or shift of a change of gradient, does to the window.
    position : (e,) bool array
        Whether it is a shift of a change of gradient.
    slot : (e,) int array
        Its place in the filter's state, from 1; place 0 is the error of the window's start.
    fresh : (e,) bool array
        Whether it enters the state with this window.
    slots : int
        Size of the state.
    """

    joined: BoolArray
    effort: FloatArray
    between: FloatArray
    first_entry: IntArray
    value: FloatArray
    position: BoolArray
    slot: IntArray
    fresh: BoolArray
    slots: int

    @staticmethod
    def of(windows: Windows, mass: float) -> NoiseParts:
        """The parts for these windows.

        Parameters
        ----------
        windows : Windows
        mass : float [kg]
            To turn effort into acceleration; 10 % off does not matter.
        """
        from scipy.sparse import hstack

        groups = hstack([GRAVITY * windows.sections, windows.edges], format="csr")
        groups.eliminate_zeros()
        groups.sort_indices()
        column = groups.indices.astype(np.int64)
        # Number of the passage that each entry belongs to, (e,): columns cut at `LONGEST_APART`.
        time = np.repeat(windows.start, np.diff(groups.indptr))
        order = np.argsort(column, kind="stable")
        begins = np.ones(column.size, dtype=bool)
        begins[1:] = np.diff(column[order]) > 0
        begins[1:] |= np.diff(time[order]) > LONGEST_APART
        passage = np.empty(column.size, dtype=np.int64)
        passage[order] = np.cumsum(begins) - 1
        count = int(passage.max(initial=-1)) + 1
        slot, fresh, slots = _slots(groups.indptr.astype(np.int64), passage, count)
        joined = np.zeros(windows.count, dtype=bool)
        joined[1:] = windows.start[1:] - windows.end[:-1] < 1e-6
        return NoiseParts(
            joined=joined,
            effort=windows.effort_square / mass**2,
            between=windows.between / mass**2,
            first_entry=groups.indptr.astype(np.int64),
            value=groups.data.astype(np.float64),
            position=column >= windows.sections.shape[1],
            slot=slot,
            fresh=fresh,
            slots=slots,
        )

    def whiten(self, noise: NoiseModel, columns: FloatArray) -> FloatArray:
        """Columns (n, c) of the regression, their noise made independent and of unit variance.

        A whitened row depends on that window and earlier ones only, so that least squares over
        the first k rows is the answer after k windows.
        """
        return np.asarray(_whitened(self, noise, np.ascontiguousarray(columns, np.float64))[0])


@dataclass(frozen=True, eq=False)
class Likelihood:
    """Restricted likelihood of the noise's sizes, and what is expected of them.

    Sizes are given by their place: natural logarithm over what is expected, in units of `width`.

    Attributes
    ----------
    parts : NoiseParts
    columns : (n, p + 1) array
        Regressors, and last the left-hand side.
    prior : (p, p + 1) array
        What is known of the parameters, as further rows of unit variance.
    expected : Expected
        Where the search begins, and towards what it is drawn.
    """

    parts: NoiseParts
    columns: FloatArray
    prior: FloatArray
    expected: Expected = field(default_factory=Expected)

    @property
    def width(self) -> FloatArray:
        """Standard deviation of the natural logarithm of each size around what is expected."""
        return np.array(self.expected.width)

    def sizes(self, place: FloatArray) -> NoiseModel:
        """The sizes at a place (4,)."""
        return NoiseModel(*np.exp(np.log(self.expected.sizes) + self.width * place).tolist())

    def place(self, noise: NoiseModel) -> FloatArray:
        """Where the sizes are, (4,)."""
        return np.asarray(np.log(np.divide(noise, self.expected.sizes)) / self.width)

    def square(self, place: FloatArray) -> tuple[FloatArray, float]:
        """Products (p + 1, p + 1) of the whitened columns, and half the log determinant."""
        white, log_determinant = _whitened(self.parts, self.sizes(place), self.columns)
        return white.T @ white + self.prior.T @ self.prior, log_determinant

    def deviance(self, place: FloatArray) -> float:
        """Minus the logarithm of likelihood times what is expected, up to a constant."""
        return self.deviance_of(place, *self.square(place))

    def deviance_of(self, place: FloatArray, square: FloatArray, log_determinant: float) -> float:
        """The deviance of products that are at hand."""
        # The triangle of [X y]: its last entry is the norm of the residual.
        scale = np.sqrt(np.maximum(np.diag(square), np.finfo(np.float64).tiny))
        triangle = scale * np.diag(np.linalg.cholesky(square / np.outer(scale, scale)))
        deviance = log_determinant + np.sum(np.log(triangle[:-1])) + 0.5 * triangle[-1] ** 2
        return float(deviance + 0.5 * place @ place)


def estimate_noise(likelihood: Likelihood) -> NoiseModel:
    """Size of each cause of noise by restricted maximum likelihood."""
    from scipy.optimize import minimize

    start = np.concatenate((np.zeros((1, 4)), -0.5 * np.eye(4)))
    found = minimize(
        likelihood.deviance,
        start[0],
        method="Nelder-Mead",
        options={"xatol": 0.02, "fatol": 0.02, "maxfev": 400, "initial_simplex": start},
    )
    return likelihood.sizes(np.asarray(found.x))


@njit(cache=True)  # type: ignore[untyped-decorator]
def _slots(
    first_entry: IntArray, column: IntArray, columns: int
) -> tuple[IntArray, BoolArray, int]:
    """A place in the state for each column of a sparse matrix, from its first row to its last.

    Returns the place of each entry, whether it is its column's first, and the number of places.
    """
    rows = first_entry.size - 1
    last = np.full(columns, -1)
    for k in range(rows):
        for e in range(first_entry[k], first_entry[k + 1]):
            last[column[e]] = k
    place = np.full(columns, -1)
    free = np.empty(columns, dtype=np.int64)
    waiting, slots = 0, 1
    slot = np.empty(column.size, dtype=np.int64)
    fresh = np.zeros(column.size, dtype=np.bool_)
    for k in range(rows):
        for e in range(first_entry[k], first_entry[k + 1]):
            c = column[e]
            if place[c] < 0:
                fresh[e] = True
                if waiting:
                    waiting -= 1
                    place[c] = free[waiting]
                else:
                    place[c] = slots
                    slots += 1
            slot[e] = place[c]
        for e in range(first_entry[k], first_entry[k + 1]):
            if last[column[e]] == k:
                free[waiting] = place[column[e]]
                waiting += 1
    return slot, fresh, slots


@njit(cache=True, error_model="numpy")  # type: ignore[untyped-decorator]
def _whitened(
    parts: NoiseParts, noise: NoiseModel, columns: FloatArray
) -> tuple[FloatArray, float]:
    """Innovations over their standard deviations, and half the sum of the log variances.

    The state's mean is one for each column; its covariance is the same for all.
    """
    joined, first_entry, value = parts.joined, parts.first_entry, parts.value
    slot, fresh, slots = parts.slot, parts.fresh, parts.slots
    own = noise.effort**2 * parts.effort + parts.between + FLOOR**2
    speed = noise.speed**2
    variance = np.where(parts.position, noise.position**2, noise.gradient**2)
    out = np.empty_like(columns)
    number = columns.shape[1]
    mean = np.zeros((slots, number))
    covariance = np.zeros((slots, slots))
    gain = np.zeros(slots)
    logarithm = 0.0
    for k in range(columns.shape[0]):
        begin, end = first_entry[k], first_entry[k + 1]
        if not joined[k]:
            covariance[0, :] = 0.0
            covariance[:, 0] = 0.0
            covariance[0, 0] = speed
            mean[0] = 0.0
        for e in range(begin, end):
            if fresh[e]:
                covariance[slot[e], :] = 0.0
                covariance[:, slot[e]] = 0.0
                covariance[slot[e], slot[e]] = variance[e]
                mean[slot[e]] = 0.0
        # The window's error: its end's less its start's, and what its pieces bring in.
        for i in range(slots):
            gain[i] = -covariance[i, 0]
        for e in range(begin, end):
            for i in range(slots):
                gain[i] += covariance[i, slot[e]] * value[e]
        total = own[k] + speed - gain[0]
        for e in range(begin, end):
            total += value[e] * gain[slot[e]]
        logarithm += np.log(total)
        precision = 1.0 / total
        root = np.sqrt(precision)
        for c in range(number):
            innovation = columns[k, c] + mean[0, c]
            for e in range(begin, end):
                innovation -= value[e] * mean[slot[e], c]
            out[k, c] = innovation * root
            innovation *= precision
            for i in range(1, slots):
                mean[i, c] += gain[i] * innovation
            mean[0, c] = speed * innovation
        # The end's error takes the place of the start's.
        for i in range(1, slots):
            weight = gain[i] * precision
            for j in range(1, slots):
                covariance[i, j] -= weight * gain[j]
            covariance[0, i] = -weight * speed
            covariance[i, 0] = covariance[0, i]
        covariance[0, 0] = speed - speed * speed * precision
    return out, 0.5 * logarithm


STEP = 0.25
"""Of the differences, in standard deviations of what is expected of a size."""

PARAMETERS_OF_INTEREST = 4
"""The first so many parameters are estimated; those after them are nuisance parameters."""


def shares(likelihood: Likelihood, noise: NoiseModel) -> tuple[float, FloatArray]:
    """How well a covariance is known, and what the map's errors bring into it.

    Parameters
    ----------
    likelihood : Likelihood
    noise : NoiseModel
        Where it is greatest.

    Returns
    -------
    freedom : float
        Degrees of freedom.
    survey : (p, p) array
        The part of the covariance that errors of the map's gradients bring in, and of where they
        change.
    """
    centre, unit = likelihood.place(noise), STEP * np.eye(len(CAUSES))
    here = likelihood.deviance(centre)
    ahead, behind = ([_judged(likelihood, z) for z in centre + sign * unit] for sign in (1.0, -1.0))
    curvature = np.empty(unit.shape)
    change = np.empty(len(CAUSES))
    survey = np.zeros_like(ahead[0][1])
    for k, cause in enumerate(CAUSES):
        (up, larger), (down, smaller) = ahead[k], behind[k]
        curvature[k, k] = (up - 2.0 * here + down) / STEP**2
        change[k] = (_size(larger) - _size(smaller)) / (2.0 * STEP)
        if cause in ("gradient", "position"):
            survey += (larger - smaller) / (4.0 * STEP * likelihood.width[k])
        for other in range(k):
            both = likelihood.deviance(centre + unit[k] + unit[other])
            cross = both - ahead[k][0] - ahead[other][0] + here
            curvature[k, other] = curvature[other, k] = cross / STEP**2
    # No less is known than before the trip.
    values, vectors = np.linalg.eigh(curvature)
    variance = float(np.sum((vectors.T @ change) ** 2 / np.maximum(values, 1.0)))
    return 2.0 / max(variance, 1e-12), survey


def _judged(likelihood: Likelihood, place: FloatArray) -> tuple[float, FloatArray]:
    """The deviance, and the covariance (p, p) of all parameters."""
    square, log_determinant = likelihood.square(place)
    size = np.sqrt(np.diag(square)[:-1])
    both = np.outer(size, size)
    covariance = np.linalg.inv(square[:-1, :-1] / both) / both
    return likelihood.deviance_of(place, square, log_determinant), covariance


def _size(covariance: FloatArray) -> float:
    """Logarithm of a covariance's size: mean over the parameters that are asked for."""
    count = PARAMETERS_OF_INTEREST
    return float(np.linalg.slogdet(covariance[:count, :count])[1]) / count
