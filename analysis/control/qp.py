"""Quadratic subproblems of model predictive control: condensed costs, constraints, DAQP.

The states ``[position, speed]`` of a linearised motion are eliminated (condensing), which leaves a
dense program in the changes of the inputs alone: levers, or efforts over inertia.
"""

# The decorator of numba carries no types.
# mypy: disable-error-code="untyped-decorator"

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from trainlog.arrays import FloatArray

SOFTNESS = 1e-7
"""Of the rows of a program: one over their quadratic weight."""

UNBOUNDED = 1e30
"""Bound of a row on the side on which it has none, as DAQP has it."""


@dataclass(frozen=True, eq=False)
class QPSubproblem:
    """``min 1/2 x'Hx + f'x`` in changes x of the inputs about which the motion is linearised.

    Attributes
    ----------
    hessian, gradient : (n, n), (n,) arrays
    rows : (m, n) array
        Of linear constraints.
    upper, lower : (n + m,) arrays
        Of the changes, hard; then of the rows.
    inputs : (n,) array
        About which the motion is linearised.
    soft : bool
        Whether the rows may be broken at a price (`SOFTNESS`).
    """

    hessian: FloatArray
    gradient: FloatArray
    rows: FloatArray
    upper: FloatArray
    lower: FloatArray
    inputs: FloatArray
    soft: bool = True


def solve(program: QPSubproblem) -> tuple[FloatArray, int]:
    """Solve a program by DAQP.

    Parameters
    ----------
    program : QPSubproblem

    Returns
    -------
    change : (n,) array
    status : int
        Positive where the optimum was found.

    Examples
    --------
    >>> import numpy as np
    >>> one = np.array([1.0])
    >>> program = QPSubproblem(np.eye(1), -one, np.ones((1, 1)), 0.5 * np.ones(2), -np.ones(2), one)
    >>> change, status = solve(program)
    >>> change.round(3).tolist(), status > 0
    ([0.5], True)
    """
    import daqp

    sense: NDArray[np.int32] = np.zeros(program.upper.size, dtype=np.int32)
    if program.soft:
        sense[program.gradient.size :] = 8
    answer: tuple[Any, ...] = daqp.solve(
        program.hessian, program.gradient, program.rows, program.upper, program.lower, sense,
        rho_soft=SOFTNESS,
    )  # fmt: skip
    return np.asarray(answer[0]), int(answer[2])


@njit(cache=True)
def terminal_weight(a: FloatArray, b: FloatArray, weight: float, effort: float) -> FloatArray:
    """Cost to go of the unconstrained regulator, by iterating Riccati's equation.

    Of ``x[k+1] = A x[k] + b u[k]`` with the stage cost ``weight x[0]² + effort u²``; (2, 2) array.
    """
    # In scalars: the products of arrays would take seconds to compile.
    a00, a01, a10, a11 = a[0, 0], a[0, 1], a[1, 0], a[1, 1]
    b0, b1 = b[0], b[1]
    p00, p01, p11 = weight, 0.0, 0.0
    for _ in range(60):
        # P A, then A' P A and A' P b; P is symmetric.
        x00, x01 = p00 * a00 + p01 * a10, p00 * a01 + p01 * a11
        x10, x11 = p01 * a00 + p11 * a10, p01 * a01 + p11 * a11
        c0, c1 = x00 * b0 + x10 * b1, x01 * b0 + x11 * b1
        over = effort + b0 * (p00 * b0 + p01 * b1) + b1 * (p01 * b0 + p11 * b1)
        n00 = a00 * x00 + a10 * x10 - c0 * c0 / over + weight
        n01 = a00 * x01 + a10 * x11 - c0 * c1 / over
        n11 = a01 * x01 + a11 * x11 - c1 * c1 / over
        change = max(abs(n00 - p00), abs(n01 - p01), abs(n11 - p11))
        if change < 1e-9 * max(abs(n00), abs(n01), abs(n11)):
            break
        p00, p01, p11 = n00, n01, n11
    p = np.empty((2, 2))
    p[0, 0], p[0, 1], p[1, 0], p[1, 1] = p00, p01, p01, p11
    return p


@njit(cache=True)
def tracking_cost(
    response: FloatArray, error: FloatArray, deviation: FloatArray, terminal: FloatArray,
    weight: float, effort: float,
) -> tuple[FloatArray, FloatArray]:  # fmt: skip
    """Hessian and gradient of the cost of following a reference.

    ``sum weight (position error)² + effort (input less its reference)²``, and the terminal cost.

    Parameters
    ----------
    response : (n + 1, 2, n) array
        Change of position and speed at each step with each input.
    error : (n + 1, 2) array
        Predicted states less those of the reference.
    deviation : (n,) array
        Inputs less those of the reference.
    terminal : (2, 2) array
        See `terminal_weight`.
    weight, effort : float

    Returns
    -------
    hessian, gradient : (n, n), (n,) arrays
    """
    n = deviation.size
    h, f = np.zeros((n, n)), np.zeros(n)
    for k in range(1, n + 1):
        for i in range(n):
            x = weight * response[k, 0, i]
            f[i] += x * error[k, 0]
            for j in range(i + 1):
                h[i, j] += x * response[k, 0, j]
    # The last position is in the terminal cost.
    first = terminal[0, 0] - weight
    last, gap = response[n], error[n]
    for i in range(n):
        x = first * last[0, i] + terminal[0, 1] * last[1, i]
        y = terminal[1, 0] * last[0, i] + terminal[1, 1] * last[1, i]
        f[i] += x * gap[0] + y * gap[1] + effort * deviation[i]
        h[i, i] += effort
        for j in range(i + 1):
            h[i, j] += x * last[0, j] + y * last[1, j]
            h[j, i] = h[i, j]
    return h, f


@njit(cache=True)
def speed_rows(
    least: FloatArray, most: FloatArray, response: FloatArray, states: FloatArray,
    free: FloatArray, squares: FloatArray, slopes: FloatArray,
) -> tuple[FloatArray, FloatArray, FloatArray]:  # fmt: skip
    """Rows that keep the square of the speed below a ceiling, and the speed from below 0.

    Parameters
    ----------
    least, most : (n,) arrays
        Bounds of the changes of the inputs.
    response : (n + 1, 2, n) array
    states : (n + 1, 2) array
        About which the motion is linearised.
    free : (n + 1, 2) array
        How far the motion without any change of the inputs is from there.
    squares : (n + 1,) array [m²/s²]
        Of the ceiling, at each state.
    slopes : (n + 1,) array [m/s²]
        How it changes with the position.

    Returns
    -------
    rows : (2n, n) array
    upper, lower : (3n,) arrays
        Bounds of the changes, then of the rows.
    """
    n = states.shape[0] - 1
    rows, upper, lower = np.empty((2 * n, n)), np.empty(3 * n), np.empty(3 * n)
    for k in range(n):
        upper[k], lower[k] = most[k], least[k]
    for k in range(1, n + 1):
        v, slope = states[k, 1], slopes[k]
        for j in range(n):
            rows[k - 1, j] = 2.0 * v * response[k, 1, j] - slope * response[k, 0, j]
            rows[n + k - 1, j] = response[k, 1, j]
        upper[n + k - 1] = squares[k] - v * v - 2.0 * v * free[k, 1] + slope * free[k, 0]
        lower[n + k - 1] = -UNBOUNDED
        upper[2 * n + k - 1] = UNBOUNDED
        lower[2 * n + k - 1] = -(v + free[k, 1])
    return rows, upper, lower
