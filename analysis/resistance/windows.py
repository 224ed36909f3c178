"""Windows: a trip's samples as one row of a linear regression every second or so.

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
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from scipy.sparse import csr_array

from analysis.resistance.recording import Recording
from trainlog.arrays import BoolArray, FloatArray, IntArray, numbered
from trainlog.spans import runs_of

WINDOW = 1.0
"""Length of a window [s]; short beside the time a train takes over a piece of gradient."""

SAMPLES = 3.0
"""A window is at least so many samples long."""

SLIP_NOISE = 30.0
"""The momentum of wheels that slip is known so many times worse than the impulse of the effort: the
axles' share of the rotating mass is often assumed, and their speeds may be recorded late."""

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


def window_width(time: FloatArray) -> float:
    """Length [s] of the windows of a recording with samples at these times [s], (n,).

    Several samples of the speed, or the errors of neighbouring ends are alike.
    """
    step = float(np.median(np.diff(time))) if time.size > 1 else 0.0
    return max(WINDOW, SAMPLES * step)


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
    start, end = _window_ends(time, recording.usable, width)
    integrals = _integral(
        time,
        np.column_stack(
            [
                recording.effort,
                recording.track,
                recording.braking,
                recording.tunnel,
                recording.curve,
            ]
        ),
    )
    plain = np.column_stack(
        [
            recording.speed,
            recording.rotating_momentum,
            recording.effort,
            recording.slip_momentum,
        ]
    )
    at_end = _averaged(time, plain, end, width)
    change = at_end - _averaged(time, plain, start, width)
    integral = _averaged(time, integrals, end, width) - _averaged(time, integrals, start, width)
    steps = np.gradient(time) if time.size > 1 else np.zeros(time.size)
    squares = _integral(time, (recording.effort**2 * steps)[:, None])
    square = (_at(time, squares, end) - _at(time, squares, start))[:, 0]
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
        sections=_by_group(recording, np.ones(time.size), recording.section, start, end),
        edges=_by_group(recording, recording.track_slope, recording.nearest_edge, start, end),
    )


def _window_ends(
    time: FloatArray, usable: BoolArray, window: float
) -> tuple[FloatArray, FloatArray]:
    """Start and end of every window [s]: each usable stretch cut into equal windows."""
    first, end = np.array(runs_of(usable), dtype=np.int64).reshape(-1, 2).T
    begin, finish = time[first] + 0.5 * window, time[end - 1] - 0.5 * window
    length = finish - begin
    pieces = np.maximum(np.floor(length / window + 1e-6), 0.0).astype(int)
    stretch, number = numbered(pieces)
    width = (length / np.maximum(pieces, 1))[stretch]
    start = begin[stretch] + number * width
    return start, start + width


def _integral(time: FloatArray, values: FloatArray) -> FloatArray:
    """Running integral (n, c) of sampled values (n, c) by the trapezoidal rule."""
    pieces = 0.5 * (values[1:] + values[:-1]) * np.diff(time)[:, None]
    return np.concatenate((np.zeros((1, values.shape[1])), np.cumsum(pieces, axis=0)))


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
    whole = _integral(time, values)
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
