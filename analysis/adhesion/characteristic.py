"""Fit of an adhesion characteristic to measured points of adhesion over slip.

Nonlinear least squares of a family (`trainlog.railway.adhesion`) in unbounded parameters, from
several starts. What the answer is uncertain by has two parts: noise of the points, whose variance
is estimated from second differences of the residuals (Gasser et al. (1986)) and raised where
neighbours err alike, and what the family's form misses, the rest of the residuals.

References
----------
Gasser, T., Sroka, L., Jennen-Steinmetz, C. (1986), Residual variance and residual pattern in
nonlinear regression, Biometrika 73, 625-633. Burnham, K. P., Anderson, D. R. (2002), Model
selection and multimodel inference: the criterion (AICc) by which a family is chosen.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from analysis.charts import BLUE, GREY, RED, Chart, Curve, Panel, Span
from trainlog.arrays import FloatArray
from trainlog.display import counted
from trainlog.errors import InputError, NotIdentifiableError
from trainlog.formats.characteristic import read_adhesion_points
from trainlog.presentation import Presented
from trainlog.railway.adhesion import (
    AdhesionCharacteristic,
    AdhesionPoints,
    CreepCurve,
    PolachCurve,
)
from trainlog.units import KMH

Family = Literal["polach", "exponentials"]
"""`PolachCurve`, or `CreepCurve`: the form of Ishikawa and Kawamura, and of Zhao et al. (2025)."""

ASSUMED_SPEED = 10.0
"""Train speed [m/s] of points over creepage that state none: falling friction depends on it."""

MOST_SPEED = 200.0
"""Train speeds are below this [m/s]."""

RISING = 0.02
"""Share of the maximum by which the adhesion may still rise beyond the points: with more they do
not show the maximum."""

FORM_FACTOR, LEAST_FORM = 1.5, 0.15
"""What a form misses at the maximum over what it misses on average (RMS), and the least share of
the residuals' variance that counts as missed: noise and form cannot be distinguished exactly."""

DRAWS = 400
"""Parameters drawn for the interval of the optimal slip."""


@dataclass(frozen=True, eq=False, repr=False)
class CharacteristicFit(Presented):
    """An adhesion characteristic fitted to points, and how well it is known.

    Attributes
    ----------
    characteristic : AdhesionCharacteristic
    family : str
    points : AdhesionPoints
    speed : float [m/s]
        Train speed of the points (median), at which maximum and optimum are stated; NaN where none
        is known and none needed.
    maximum, maximum_std : float
        Maximum adhesion and its standard deviation.
    optimal_slip : float [1] or [m/s]
        Slip of the maximum, creepage or slip speed as the points have it.
    optimal_band : (float, float) [1] or [m/s]
        Its 95 % interval; the upper end is infinite where the adhesion does not fall beyond.
    rms : dict of str to float
        Root mean square of the residuals over the maximum, by family that could be fitted.
    findings : tuple of str
        What the points do not show, in sentences.
    """

    charts_by: ClassVar[str] = "analysis.adhesion.characteristic:characteristic_charts"

    characteristic: AdhesionCharacteristic
    family: str
    points: AdhesionPoints
    speed: float
    maximum: float
    maximum_std: float
    optimal_slip: float
    optimal_band: tuple[float, float]
    rms: dict[str, float]
    findings: tuple[str, ...]

    @property
    def title(self) -> str:
        """The family."""
        return f"Adhesion characteristic: {NAMES[self.family]}"

    def summary(self) -> dict[str, str]:
        """Maximum, optimum, slope, and what each family leaves of the points."""
        of = counted(self.points.slips.size, "point")
        rows = {
            "maximum adhesion": f"{self.maximum:.4f} ± {1.96 * self.maximum_std:.4f}",
            f"optimal {self.points.variable}": self.optimum_in_words(),
            "residuals": f"{100.0 * self.rms[self.family]:.2f} % of the maximum (RMS) of {of}",
        }
        if np.isfinite(self.speed):
            curve = self.characteristic
            slope = float(curve.slope(0.0, self.speed)) * self.speed / 100.0
            rows["slope at no slip"] = f"{slope:.3f} per per cent of creepage"
            best = float(curve.optimal_slip_speed(self.speed))
            if np.isfinite(self.optimal_band[1]):
                at = f"optimal slip speed at {KMH * self.speed:.0f} km/h"
                rows[at] = f"{KMH * best:.3g} km/h"
        return rows | {
            f"residuals: {NAMES[name]}": f"{100.0 * rms:.2f} % of the maximum (RMS)"
            for name, rms in self.rms.items()
            if name != self.family
        }

    def facts(self) -> dict[str, Any]:
        """The family, and what is kept of the fit."""
        return {"family": self.family, "fit": self.provenance()}

    @property
    def notes(self) -> tuple[str, ...]:
        """What the points do not show."""
        return self.findings

    def optimum_in_words(self) -> str:
        """The optimal slip and its interval in the units of railway people."""
        low, high = self.optimal_band
        scale, unit = (100.0, "%") if self.points.variable == "creepage" else (KMH, "km/h")
        end = f"to {scale * high:.3g}" if np.isfinite(high) else "up, flat beyond"
        return f"{scale * self.optimal_slip:.3g} {unit} ({scale * low:.3g} {end})"

    def provenance(self) -> dict[str, Any]:
        """What is kept of the fit in the characteristic's file."""
        low, high = self.optimal_band
        return {
            "points": int(self.points.slips.size),
            "speed": float(self.speed) if np.isfinite(self.speed) else None,
            "maximum": self.maximum,
            "maximum_std": self.maximum_std,
            "optimal_slip": self.optimal_slip,
            "optimal_band": [low, high if np.isfinite(high) else None],
            "rms": dict(self.rms),
            "findings": list(self.findings),
        }


NAMES = {
    "polach": "Polach (2005), falling friction",
    "exponentials": "double exponential (Ishikawa and Kawamura)",
}


def fit_adhesion_characteristic(
    points: AdhesionPoints | str | Path,
    family: Family | None = None,
    *,
    speed: float | None = None,
    clean_stiffness: float | None = None,
) -> CharacteristicFit:
    """Fit an adhesion characteristic to measured points.

    Parameters
    ----------
    points : AdhesionPoints or path
        A path: CSV, see `trainlog.formats.characteristic.read_adhesion_points`.
    family : {"polach", "exponentials"}, optional
        Default: the one that explains the points better for its number of parameters (AICc).
    speed : float [m/s], optional
        Train speed of points that do not state theirs; of others it is refused.
    clean_stiffness : float, optional
        Slope of the clean contact over creepage, from which Polach's k_A is then stated. From the
        points only its product with k_A can be found; by default the product, with a k_A of 1.

    Returns
    -------
    CharacteristicFit

    Raises
    ------
    InputError
        If the points are none, or lack what the family needs.
    NotIdentifiableError
        If they do not determine the maximum; with the reason.

    Examples
    --------
    >>> from trainlog import AdhesionPoints
    >>> import numpy as np
    >>> creepage = np.geomspace(0.001, 0.3, 25)
    >>> adhesion = 0.3 * np.sin(1.6 * np.arctan(60.0 * creepage))  # of another form
    >>> fit = fit_adhesion_characteristic(AdhesionPoints(creepage, adhesion), speed=10.0)
    >>> print(f"{fit.maximum:.3f} at {100.0 * fit.optimal_slip:.1f} %")
    0.299 at 2.5 %
    """
    if isinstance(points, AdhesionPoints):
        return _fitted(points, family, speed, clean_stiffness)
    try:
        return _fitted(read_adhesion_points(points), family, speed, clean_stiffness)
    except NotIdentifiableError as error:
        raise NotIdentifiableError(error.problem, file=points, remedy=error.remedy) from error


def _fitted(
    given: AdhesionPoints,
    family: Family | None,
    speed: float | None,
    clean_stiffness: float | None,
) -> CharacteristicFit:
    """The fit of points, or the reason why there is none."""
    if speed is not None:
        if not 0.0 < speed < MOST_SPEED:
            raise InputError(
                f"train speed {speed:g} m/s is not between 0 and {MOST_SPEED:g} m/s",
                remedy="give the speed in m/s, not in km/h",
            )
        if given.speeds is not None:
            raise InputError(
                "the points state their train speeds, and one is given (--speed)",
                remedy="leave one of the two out",
            )
        given = replace(given, speeds=np.full(given.slips.size, speed))
    if given.slips.size < 5:
        raise NotIdentifiableError(
            f"{given.slips.size} points do not determine a characteristic",
            remedy="give five at least",
        )
    if not np.max(given.adhesions) > 0.0:
        raise InputError(
            "points of adhesion: none is positive",
            remedy="give points with slip and adhesion above 0",
        )
    findings: list[str] = []
    wanted: list[Family] = ["polach", "exponentials"] if family is None else [family]
    fitted: dict[str, _Solution] = {}
    reasons: list[str] = []
    for each in wanted:
        problem, notes = _problem(each, given, clean_stiffness)
        if problem is None:
            reasons += notes
            continue
        fitted[each] = _solved(problem)
        if each == "polach":
            findings += notes
    if not fitted:
        raise NotIdentifiableError("; ".join(reasons))
    best = min(fitted, key=lambda name: fitted[name].criterion)
    if best != "polach":
        findings = reasons
    elif given.speeds is not None and np.ptp(given.speeds) < 0.1 * np.mean(given.speeds):
        findings.append("points of one train speed: how the curve changes with it is Polach's law")
    return _judged(best, fitted, given, findings)


@dataclass(frozen=True, eq=False)
class _Problem:
    """A family on given points: residuals of unbounded parameters."""

    slips: FloatArray
    adhesions: FloatArray
    speeds: FloatArray
    curve: Callable[[FloatArray], AdhesionCharacteristic]
    starts: tuple[FloatArray, ...]
    width: FloatArray
    """Of a weak prior around each start, which holds what the points do not show."""

    def residuals(self, theta: FloatArray) -> FloatArray:
        return self.curve(theta).adhesion_over(self.slips, self.speeds) - self.adhesions


@dataclass(frozen=True, eq=False)
class _Solution:
    problem: _Problem
    theta: FloatArray
    covariance: FloatArray
    noise: float
    form: float
    """Standard deviation at the maximum of what the form misses, beyond noise."""

    @property
    def residuals(self) -> FloatArray:
        return self.problem.residuals(self.theta)

    @property
    def rms(self) -> float:
        return float(np.sqrt(np.mean(self.residuals**2)))

    @property
    def criterion(self) -> float:
        """Akaike's, for few points."""
        n, k = self.residuals.size, self.theta.size + 1
        return float(n * np.log(self.rms**2 + 1e-18) + 2.0 * k * n / max(n - k - 1, 0.5))

    @property
    def curve(self) -> AdhesionCharacteristic:
        return self.problem.curve(self.theta)


def _problem(
    family: Family, points: AdhesionPoints, clean_stiffness: float | None
) -> tuple[_Problem | None, list[str]]:
    """The problem of a family, and what is to be stated of it; None where it cannot be put."""
    top = int(np.argmax(points.adhesions))
    peak, slip = float(points.adhesions[top]), float(points.slips[top])
    speeds = np.full(points.slips.size, np.nan) if points.speeds is None else points.speeds
    if family == "exponentials":
        starts = []
        for ratio in (2.0, 15.0, 100.0, 1e3):
            a = np.log(ratio) / ((ratio - 1.0) * slip)
            height = np.exp(-a * slip) - np.exp(-ratio * a * slip)
            starts.append(np.log([a, ratio - 1.0, peak / height]))
        variable = points.variable

        def exponentials(theta: FloatArray) -> AdhesionCharacteristic:
            a, more, c = np.exp(np.clip(theta, -30.0, 30.0)).tolist()
            return CreepCurve(a, a * (1.0 + more) + 1e-12, c, c, variable)

        return _Problem(
            points.slips, points.adhesions, speeds, exponentials, tuple(starts), np.full(3, 20.0)
        ), []
    notes = []
    if points.slips.size < 7:
        return None, ["Polach's curve needs seven points at least"]
    if points.speeds is None:
        if points.variable == "slip speed":
            return None, ["Polach's curve is over creepage: without the train's speed not fitted"]
        notes.append(
            f"train speed not stated: the fall of the friction holds for {ASSUMED_SPEED:g} m/s"
        )
        speeds = np.full(points.slips.size, ASSUMED_SPEED)
    creepages = points.slips if points.variable == "creepage" else points.slips / speeds

    def polach(theta: FloatArray) -> AdhesionCharacteristic:
        stiffness, friction, decay = np.exp(np.clip(theta[[0, 2, 4]], -20.0, 20.0)).tolist()
        ratio, left = (1.0 / (1.0 + np.exp(-np.clip(theta[[1, 3]], -30.0, 30.0)))).tolist()
        clean = clean_stiffness or stiffness
        return PolachCurve(
            clean, min(stiffness / clean, 1.0), min(ratio * stiffness / clean, 1.0),
            min(friction, 1.49), left, decay,
        )  # fmt: skip

    steep = np.max(points.adhesions / creepages)
    starts = []
    for decay in (0.05, 0.3, 2.0, 10.0):
        for ratio in (-1.0, 1.0):
            guess = [np.log(1.5 * steep), ratio, np.log(1.2 * peak), 0.0, np.log(decay)]
            starts.append(np.array(guess))
    width = np.array([5.0, 4.0, 2.0, 4.0, 4.0])
    return _Problem(creepages, points.adhesions, speeds, polach, tuple(starts), width), notes


def _solved(problem: _Problem) -> _Solution:
    """The best of the starts, and how well the points determine it."""
    from scipy.optimize import least_squares

    scale = 0.01 * float(np.max(problem.adhesions))

    def cost(theta: FloatArray, centre: FloatArray) -> FloatArray:
        # Weaker than one point of a hundredth of the maximum's error by far.
        prior = 1e-2 * (theta - centre) / problem.width
        return np.concatenate([problem.residuals(theta) / scale, prior])

    found = [
        least_squares(cost, start, args=(start,), method="trf", x_scale="jac", max_nfev=400)
        for start in problem.starts
    ]
    best = min(found, key=lambda each: float(each.cost))
    theta, jacobian = best.x, best.jac[: problem.slips.size] * scale
    residuals = problem.residuals(theta)
    noise = _noise(problem.slips, residuals)
    n, p = residuals.size, theta.size
    mean_square = float(np.mean(residuals**2))
    form = FORM_FACTOR * float(np.sqrt(max(mean_square - noise**2, LEAST_FORM * mean_square)))
    variance = float(np.sum(residuals**2)) / max(n - p, 1)
    information = jacobian.T @ jacobian / variance + np.diag(problem.width**-2.0)
    return _Solution(problem, theta, np.linalg.inv(information), noise, form)


def _noise(slips: FloatArray, residuals: FloatArray) -> float:
    """Standard deviation of the noise, from second differences of the residuals along the slip."""
    ordered = residuals[np.argsort(slips, kind="stable")]
    return float(np.sqrt(np.mean(np.diff(ordered, 2) ** 2) / 6.0))


def _judged(
    best: str, fitted: dict[str, _Solution], points: AdhesionPoints, findings: list[str]
) -> CharacteristicFit:
    """What the best solution says of maximum and optimum; refused where it says too little."""
    solution = fitted[best]
    speeds = solution.problem.speeds
    speed = float(np.median(speeds)) if np.all(np.isfinite(speeds)) else np.nan
    largest = float(points.slips.max())
    grid = np.concatenate(
        [np.geomspace(1e-3 * points.slips.min(), largest, 600), largest * np.geomspace(1, 5, 200)]
    )
    over = _over(solution.curve, points.variable, grid, speed)
    within = over[:600]
    top = int(np.argmax(within))
    maximum, slip = float(within[top]), float(grid[top])
    beyond = float(over.max())
    unit = "%" if points.variable == "creepage" else "m/s"
    end = f"{largest * (100.0 if unit == '%' else 1.0):.3g} {unit}"
    if beyond > (1.0 + RISING) * maximum:
        raise NotIdentifiableError(
            f"adhesion still rises at the largest {points.variable}, {end}: the maximum is not"
            " shown",
            remedy="measure further into slip",
        )
    if np.count_nonzero(points.slips < 0.8 * slip) < 2:
        raise NotIdentifiableError(
            "fewer than two points lie below the maximum: the rise to it is not shown",
            remedy=f"measure at less {points.variable}",
        )
    std, band = _uncertainty(solution, points.variable, grid, speed)
    if band[1] >= largest:
        band = (band[0], np.inf)
        findings = [
            *findings,
            f"no fall beyond the maximum is shown up to {end}: the optimum has a lower end only",
        ]
    std = float(np.hypot(std, beyond - maximum))
    scale = {name: each.rms / maximum for name, each in fitted.items()}
    return CharacteristicFit(
        solution.curve, best, points, speed, maximum, std, slip, band, scale, tuple(findings)
    )


def _over(
    curve: AdhesionCharacteristic, variable: str, slips: FloatArray, speed: float
) -> FloatArray:
    """A characteristic over the slip of the points."""
    if curve.variable != variable:  # points over slip speed, Polach's curve over creepage
        slips = slips / speed
    return curve.adhesion_over(slips, np.asarray(speed))


def _uncertainty(
    solution: _Solution, variable: str, grid: FloatArray, speed: float
) -> tuple[float, tuple[float, float]]:
    """Standard deviation of the maximum, and 95 % interval of the slip at which it is."""
    within = grid[:600]
    own = _over(solution.curve, variable, within, speed)
    # How the curve moves with each parameter; drawn curves are linear in them.
    small = 1e-4
    moves = np.array(
        [
            _over(solution.problem.curve(solution.theta + step), variable, within, speed) - own
            for step in small * np.eye(solution.theta.size)
        ]
    )
    normal = np.random.default_rng(0).standard_normal((DRAWS, solution.theta.size))
    drawn = normal @ np.linalg.cholesky(solution.covariance).T @ (moves / small)
    std = float(np.hypot(np.std(drawn[:, int(np.argmax(own))]), solution.form))
    low, high = np.quantile(within[np.argmax(own + drawn, axis=1)], [0.025, 0.975])
    flat = within[own >= own.max() - 1.96 * solution.form]
    return std, (float(min(low, flat[0])), float(max(high, flat[-1])))


def characteristic_charts(fit: CharacteristicFit) -> list[Chart]:
    """Measured points of adhesion over slip, the curve fitted to them, and its maximum."""
    points = fit.points
    over_creepage = points.variable == "creepage"
    scale, unit = (100.0, "%") if over_creepage else (KMH, "km/h")
    speed = None if np.isnan(fit.speed) else fit.speed
    last = 1.02 * float(points.slips.max())
    near = min(4.0 * fit.optimal_slip, last)
    slips = np.unique(np.concatenate([np.linspace(0.0, end, 400) for end in (near, last)]))
    curve = fit.characteristic
    adhesion = curve.over_creepage(slips, speed or 1.0) if over_creepage else curve(slips, speed)
    low, high = fit.optimal_band
    reach = 1.96 * fit.maximum_std
    curves = [
        Curve("measured", scale * points.slips, points.adhesions, GREY, "points", width=1.6),
        Curve(NAMES[fit.family], scale * slips, adhesion, BLUE, width=1.4),
        Curve("maximum, 95 % band", [scale * fit.optimal_slip], [fit.maximum], RED, "points",
              [fit.maximum - reach], [fit.maximum + reach], width=2.5),
    ]  # fmt: skip
    top = 1.15 * max(fit.maximum, float(points.adhesions.max()))
    at = f" at {KMH * speed:.0f} km/h" if speed is not None else ""
    title = (
        f"Adhesion characteristic: maximum {fit.maximum:.3f} ± {reach:.3f},"
        f" optimal {points.variable} {fit.optimum_in_words()}{at}"
    )
    return [
        Chart(
            f"{points.variable} [{unit}]",
            [
                Panel(
                    "adhesion", curves, 1.1, words, limits=(0.0, top),
                    spans=[Span(scale * low, scale * min(high, end), label="optimum, 95 % band")],
                )
            ],
            span=(0.0, scale * end), title="" if number else title, width=0.5, beside=number > 0,
        )
        for number, (words, end) in enumerate((("up to the maximum", near), ("all points", last)))
    ]  # fmt: skip
