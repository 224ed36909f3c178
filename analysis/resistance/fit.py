"""Running resistance and mass of one trip, with the reason where they are not identifiable."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import pandas as pd
from numpy.typing import ArrayLike

from analysis.resistance.curve import (
    CURVE_COLUMNS,
    HEAD_WIND,
    RESISTANCE_COLUMN,
    DragCurve,
    curve_std,
)
from analysis.resistance.noise import (
    Expected,
    WindowPoints,
    Windows,
    build_windows,
    window_width,
)
from analysis.resistance.passport import (
    gain_words,
    passport,
    suspected_efforts,
    with_calibrated_efforts,
)
from analysis.resistance.recording import (
    Prepared,
    Reason,
    SpeedScale,
    Timeline,
    TripRefusedError,
    check_recorded,
    effort_times,
    prepare,
    scale_of,
    sound,
    tunnel_coefficient,
)
from analysis.resistance.regression import (
    DELAY_STD,
    LARGEST_CONDITION,
    Residuals,
    Stretch,
    WindowFit,
    fit_windows,
)
from analysis.view import Given, TripView, view_of
from trainlog.arrays import FloatArray, robust_std
from trainlog.display import span
from trainlog.errors import InputError
from trainlog.formats.files import sha256
from trainlog.formats.summaries import PARAMETERS
from trainlog.identity import text_of
from trainlog.presentation import MASS, NUMBER, POWER, Band, Column, Presented, WordTable, new_table
from trainlog.railway.line import Line, in_km
from trainlog.railway.passport import Passport
from trainlog.railway.resistance import LARGEST_STD, TERMS, RunningResistance, basis
from trainlog.railway.train import Train
from trainlog.resampling import interpolated
from trainlog.topics import ESTIMATED_RESISTANCE
from trainlog.trip import Trip, frame_of
from trainlog.units import KMH

TOPICS = (
    "/train/state", "/train/controls", "/train/axles", "/gnss/motion", "/environment",
    "/estimates/state",
)  # fmt: skip
"""What is read of each log."""

LOWEST_SPEED = 10.0
"""Lowest speed that is asked for unless the caller says otherwise [m/s]: below it a train is only
on its way from or to a stop, and running resistance is small beside the efforts. The fit's curve
and band go down to standstill all the same."""

LARGEST_GAIN_ERROR = 0.2
"""Recorded efforts that are further off than this share are not those of the train."""

SHORTEST_TIME = 200.0
"""Less usable time than this [s] is too short a trip."""

SLIPPED = 0.1
"""Share of a trip that slip masks from which on it is said why the trip is refused."""

TUNNEL_LAW_STD = 0.6
"""Standard deviation of the power of the cross-section by which tunnels resist."""

SLIP_UNSEEN = (
    "slip is not masked: not all axle speeds are recorded, and fewer than two samples a second do"
    " not show it in the efforts; where wheels slip the curve is 2 to 8 % too low at 20 km/h"
)
"""Of a trip; docs/fleet.md."""


@dataclass(frozen=True, eq=False)
class History:
    """What the recursion knew, every ten seconds.

    Attributes
    ----------
    time : (n,) DatetimeIndex
    speed : (n,) array [m/s]
    beta : (n, p) array
        Coefficients of the resistance, and mass.
    covariance : (n, p, p) array
    """

    time: pd.DatetimeIndex
    speed: FloatArray
    beta: FloatArray
    covariance: FloatArray


@dataclass(frozen=True, slots=True)
class TunnelResistance:
    """What the tunnels of a trip add to the quadratic term.

    Attributes
    ----------
    sections : (float, float) [m²]
        Smallest and largest cross-section that the trip ran through.
    expected : (float, float) [N/(m/s)²]
        Coefficient that was expected in them.
    source : str
        By what it was expected: ``"the train's file"`` or ``"published tunnels"``.
    factor, std : float
        The resistance over the expected one, and its standard deviation.
    """

    sections: tuple[float, float]
    expected: tuple[float, float]
    source: str
    factor: float
    std: float

    @staticmethod
    def of(view: TripView, prepared: Prepared, regression: WindowFit) -> TunnelResistance | None:
        """Of a trip; None if it ran through no tunnel."""
        if regression.tunnels is None:
            return None
        section = view.line.tunnel_cross_section(prepared.position[prepared.usable])
        ends = np.array([section[section > 0.0].min(), section.max()])
        low, high = tunnel_coefficient(view.train, ends).tolist()
        stated = bool(view.train.tunnel_resistance)
        factor, std = regression.tunnels
        law = 0.5 * TUNNEL_LAW_STD * float(np.log(ends[1] / ends[0]))
        return TunnelResistance(
            (float(ends[0]), float(ends[1])),
            (low, high),
            "the train's file" if stated else "published tunnels",
            factor,
            float(np.hypot(std, factor * law)),
        )

    @property
    def words(self) -> str:
        """The coefficient with its band, and what was expected."""
        said = []
        for section, expected in sorted(set(zip(self.sections, self.expected, strict=True))):
            value, half = self.factor * expected, 1.96 * self.std * expected
            said.append(f"{value:.1f} ± {half:.1f} kg/m in {section:.0f} m²")
        return f"{', '.join(said)} ({self.factor:.2f} times {self.source})"


@dataclass(frozen=True, eq=False, repr=False)
class TripFit(DragCurve, Presented):
    """Running resistance and mass as observed on one trip.

    Attributes
    ----------
    trip, train : str
    resistance : RunningResistance
        On straight, level, open track.
    mass : float [kg]
        Loaded, without the rotating part.
    covariance : (p, p) array
        Of the coefficients of the resistance and the mass [kg].
    freedom : int
        Degrees of freedom of the covariance: how well the noise's sizes are known.
    survey : (p, p) array
        The part of the covariance that errors of the line's gradients bring in; trips over the
        same line share them.
    gradients : str
        SHA-256 of the line's gradients as travelled: which trips share its errors.
    rotating_mass : float [kg]
        Taken from the train's file.
    max_power, max_power_std : float or None [W]
        From the stretches at the power limit; None if there was none.
    train_power : float [W]
        What the train's file states.
    asked : (float, float) [m/s]
        Speeds between which the curve was asked for.
    speed_range : (float, float) [m/s]
        Speeds that the windows cover.
    condition : float
        Column-normalised condition number of the regressors.
    scale : SpeedScale
        What measured speed was divided by.
    noise : dict of str to float
        Sizes of the noise: ``speed`` [m/s], ``gradient``, ``position`` [m], ``effort``.
    delay, brake_scale : float [s], [1]
        Of the recorded effort, and of the dynamic brake's.
    cluster_factor : float
        What the noise model's variances were multiplied by because neighbouring windows err
        together; 1 if they agree with it.
    residual_std : float
        Of the whitened residuals; 1 if the noise is what it is taken for.
    residual_correlation : float
        Between neighbouring whitened residuals; 0 if the model leaves nothing out.
    windows : dict of str to int
        ``used`` and left out as ``outlier``.
    masked : dict of str to float [s]
        Time masked, by reason.
    points : WindowPoints
    residuals : Residuals
    timeline : Timeline
        The trip at a glance, and what was masked.
    history : History
    identity : str
        Of the drive, by its recorded samples (`trainlog.identity`); empty if it is not known.
    passport : Passport or None
        By which the recorded efforts were corrected; what it does not know widens the band.
    notes : tuple of str
        What the recording does not show and the band does not hold, in words.
    wind_recorded : bool
        Whether the curve is that of still air; else it is that of the air of the day
        (`still_air`).
    tunnels : TunnelResistance or None
        What tunnels add to the curve, which is that of open track; None: the trip ran through none.
    """

    charts_by: ClassVar[str] = "analysis.resistance.plot:trip_fit_charts"

    trip: str
    train: str
    resistance: RunningResistance
    mass: float
    covariance: FloatArray
    freedom: int
    survey: FloatArray
    gradients: str
    rotating_mass: float
    max_power: float | None
    max_power_std: float | None
    train_power: float
    asked: tuple[float, float]
    speed_range: tuple[float, float]
    condition: float
    scale: SpeedScale
    noise: dict[str, float]
    delay: float
    brake_scale: float
    cluster_factor: float
    residual_std: float
    residual_correlation: float
    windows: dict[str, int]
    masked: dict[str, float]
    points: WindowPoints
    residuals: Residuals
    timeline: Timeline
    history: History
    identity: str = ""
    passport: Passport | None = None
    notes: tuple[str, ...] = ()
    wind_recorded: bool = False
    tunnels: TunnelResistance | None = None

    @property
    def title(self) -> str:
        """Train and trip."""
        return f"Running resistance of {self.train} on trip '{self.trip}'"

    def summary(self) -> dict[str, str]:
        """Curve, mass, power, and what they rest on."""
        power = "not shown: no lever or effort demand asks for more than is given"
        if self.max_power is not None and self.max_power_std is not None:
            power = f"{self.max_power / 1e3:.0f} ± {1.96 * self.max_power_std / 1e3:.0f} kW"
        notes = {"notes": "; ".join(self.notes)} if self.notes else {}
        efforts = {}
        if self.passport is not None:
            delay, gain = self.passport.effort_delay, self.passport.effort_gain
            efforts["efforts"] = (
                f"recorded {delay.value:.2f} ± {1.96 * delay.std:.2f} s late ({delay.source}),"
                f" {gain.value:.3f} ± {1.96 * gain.std:.3f} times ({gain.source})"
            )
        tunnels = {} if self.tunnels is None else {"tunnels": self.tunnels.words}
        low, high = (float(end) / 1e3 for end in self.still_air(self.asked[1]))
        top = f"{low:.1f} to {high:.1f} kN at {KMH * self.asked[1]:.0f} km/h"
        still = {} if self.wind_recorded else {"in still air": f"{top}, no wind is recorded"}
        return {
            "curve": self.words,
            **still,
            **tunnels,
            "mass": f"{self.mass / 1e3:.1f} ± {1.96 * self.mass_std / 1e3:.1f} t",
            "power": power,
            "speeds": f"{span(self.speed_range, KMH)} km/h, asked for {span(self.asked, KMH)} km/h",
            "windows": f"{self.windows['used']} used, {self.windows['outlier']} outliers",
            "masked": self.timeline.in_words(self.masked),
            **notes,
            **efforts,
        }

    def tables(self) -> list[WordTable]:
        """The row of a fit."""
        return [new_table(self.title, *COLUMNS, name="trips").add_rows([self])]

    def still_air(self, speed: ArrayLike) -> tuple[FloatArray, FloatArray]:
        """Lower and upper end [N] of the 95 % band of the resistance in still air.

        Where no wind is recorded, a head wind of `HEAD_WIND` may have blown: its air resistance,
        r2 (v + w)², makes r0 larger by r2 w² and r1 by 2 r2 w.

        Parameters
        ----------
        speed : array [m/s]
        """
        low, high = self.band(speed)
        if self.wind_recorded:
            return low, high
        value, v, wind = self.resistance(speed), np.asarray(speed), 1.96 * HEAD_WIND
        through, square = 2.0 * self.resistance.r2 * wind * v, self.resistance.r2 * wind**2
        return value - np.hypot(value - low, through + square), value + np.hypot(
            high - value, np.maximum(through - square, 0.0)
        )

    @property
    def own_survey(self) -> FloatArray:
        """The part of the curve's covariance that errors of the line's gradients bring in."""
        return self.survey[: len(TERMS), : len(TERMS)]

    @property
    def assumed_gain_std(self) -> float | None:
        """Standard deviation of the effort's gain, over it, where no recorded load shows it."""
        gain = None if self.passport is None else self.passport.effort_gain
        return gain.std / gain.value if gain is not None and gain.source == "assumed" else None

    @property
    def mass_std(self) -> float:
        """Standard deviation of the mass [kg]."""
        return float(np.sqrt(self.covariance[3, 3]))


def _power(fit: TripFit) -> Band | None:
    known = fit.max_power is not None and fit.max_power_std is not None
    return Band(fit.max_power or 0.0, fit.max_power_std or 0.0) if known else None


COLUMNS = (
    Column("trip"),
    *CURVE_COLUMNS,
    Column("mass", MASS, each=True, band=True, of=lambda fit: Band(fit.mass, fit.mass_std)),
    Column("power", POWER, band=True, of=_power),
    RESISTANCE_COLUMN,
    Column("windows", NUMBER, of=lambda fit: fit.windows["used"], rank=2),
)
"""Of the table of a fit: a row per trip."""


def fit_trip(
    trip: Given,
    speeds: tuple[float, float] | None = None,
    *,
    largest_std: float = LARGEST_STD,
) -> TripFit:
    """Fit running resistance and mass to a trip.

    Parameters
    ----------
    trip : Trip or path
        A trip at hand, or a log, with ``/train/state`` and ``/train/controls``, its line and its
        train; ``/train/axles`` and ``/gnss/motion`` make the fit sharper. A head wind in
        ``/environment`` is a part of the speed that the quadratic term counts: the curve is that
        of calm air.
    speeds : (float, float) [m/s], optional
        Speeds between which the curve is asked for, at most the highest that the line or the
        train allows; default 10 m/s to the line's highest speed that the train can do.
    largest_std : float, optional
        Standard deviation over the curve, at any of these speeds, beyond which a trip is refused.

    Returns
    -------
    TripFit

    Raises
    ------
    TripRefusedError
        If the trip does not determine the curve; the message says why.
    LogError
        If the trip lacks its line or its train, or time does not increase.
    InputError
        If the speeds are not finite, not in order, or higher than line and train allow; or the
        trip is neither a trip nor the path of a log.

    Examples
    --------
    >>> fit = fit_trip("sample_logs/nonstop.mcap")
    >>> bool(abs(fit.mass - 145e3) < 1e3), fit.windows["used"] > 800
    (True, True)
    """
    check_speeds(speeds)
    view = view_of(trip, TOPICS)
    check_recorded(view.located)
    name, line, train, scale = view.name, view.line, view.train, scale_of(view)
    known = effort_passport(view)
    corrected = with_calibrated_efforts(sound(view), known)
    prepared = prepare(view, corrected)
    origin = prepared.index[0]
    asked = _asked(speeds, line, train)
    width = window_width(prepared.time, effort_times(corrected))
    windows, timeline = build_windows(prepared, width), prepared.timeline
    _check_windows(name, windows, prepared)
    mass, mass_std = mass_prior(train)
    estimated = known.effort_delay.source == "estimated"
    delay_std = DELAY_STD if estimated else known.effort_delay.std
    try:
        regression = fit_windows(windows, mass, mass_std, Expected.on(line), delay_std, search=True)
    except np.linalg.LinAlgError as error:
        raise TripRefusedError(
            "condition",
            f"trip '{name}': no mass and no resistance explain the recorded speed and efforts",
            place="topic /train/controls",
            remedy="check that the efforts are those of this train on this trip",
            timeline=timeline,
        ) from error
    gain_std = known.effort_gain.std / known.effort_gain.value
    # If true speed is measured speed over kappa, r1, r2 and mass come out as r1/kappa, r2/kappa²
    # and m/kappa.
    effect = regression.beta * np.append(np.arange(len(TERMS)), 1.0) * scale.std
    covariance = regression.covariance + np.outer(effect, effect)
    unlike = [_stretch_words(each, timeline, view, origin) for each in regression.stretches]
    if regression.pulling is not None:
        force, std = regression.pulling
        unlike.append(
            f"efforts are {abs(force) / 1e3:.1f} ± {1.96 * std / 1e3:.1f} kN too"
            f" {'high' if force > 0.0 else 'low'} while pulling, by the motion while coasting:"
            " check their zero; left to itself"
        )
    without_gain, covariance = covariance, _with_gain(regression.beta, covariance, gain_std)
    used = windows.select(regression.kept)
    merged = used.merged()
    ends = np.searchsorted(used.end, merged.end)
    residual = regression.residual
    limit = power_limit(corrected, prepared, train, float(np.hypot(scale.std, gain_std)))
    fit = TripFit(
        trip=name,
        train=train.name,
        resistance=RunningResistance.of(regression.beta[:-1]),
        mass=float(regression.beta[-1]),
        covariance=covariance,
        freedom=round(regression.freedom),
        survey=regression.survey,
        gradients=surveyed_gradients(line),
        rotating_mass=train.rotating_mass,
        max_power=limit and limit[0],
        max_power_std=limit and limit[1],
        train_power=train.max_traction_power,
        asked=asked,
        speed_range=(float(used.mean_speed.min()), float(used.mean_speed.max())),
        condition=regression.condition,
        scale=scale,
        noise=regression.noise._asdict(),
        delay=known.effort_delay.value + regression.delay,
        brake_scale=regression.brake_scale,
        cluster_factor=regression.cluster_factor,
        residual_std=float(np.sqrt(residual @ residual / max(residual.size - len(PARAMETERS), 1))),
        residual_correlation=float(
            residual[1:] @ residual[:-1] / max(float(residual @ residual), 1e-300)
        ),
        windows={"used": used.count, "outlier": int(np.sum(~regression.kept))},
        masked=prepared.masked,
        points=regression.points(windows, float(regression.beta[-1])),
        residuals=Residuals(
            time=used.end,
            position=np.interp(used.end, timeline.time, timeline.position),
            speed=used.mean_speed,
            value=residual,
        ),
        timeline=timeline,
        history=History(
            time=origin + pd.to_timedelta(np.round(merged.end, 3), unit="s"),
            speed=merged.end_speed,
            beta=regression.history[ends],
            covariance=_with_gain(
                regression.history[ends], regression.history_covariance[ends], gain_std
            ),
        ),
        passport=known,
        notes=tuple(filter(None, (SLIP_UNSEEN * prepared.slip_unseen, gain_words(known), *unlike))),
        wind_recorded=prepared.wind_recorded,
        identity=text_of(view.identity),
        tunnels=TunnelResistance.of(view, prepared, regression),
    )
    try:
        _check_curve(name, regression, without_gain, unlike, asked, timeline, largest_std)
    except TripRefusedError as error:
        # Where the mass is not determined it may come out as negative, and adds to no other trip.
        error.fit = fit if fit.mass > 0.0 else None
        raise
    return fit


def effort_passport(view: TripView) -> Passport:
    """The passport of a trip whose efforts can be those of its train.

    Raises
    ------
    TripRefusedError
        If no load and no ordinary error of a converter explains the motion under the efforts, or
        they are of another unit by it.
    """
    for found in view.once(suspected_efforts):
        raise TripRefusedError(
            "contradiction",
            f"trip '{view.name}': {found.note}",
            place=f"field {found.column}",
            remedy="ingest the recording again with it",
        )
    known = passport(view)
    gain = known.effort_gain.value
    if known.effort_over_mass.known and abs(gain - 1.0) > LARGEST_GAIN_ERROR:
        raise TripRefusedError(
            "contradiction",
            f"trip '{view.name}': the recorded efforts are {gain:.2g} times what the motion needs",
            place="topic /train/controls",
            remedy="check their unit and whether they are those of the whole train, and the mass"
            " in the train's file",
        )
    return known


def estimated_resistance(fit: TripFit) -> pd.DataFrame:
    """The ``/estimates/running_resistance`` topic: what the recursion knew as the trip went on.

    It begins when the curve at the present speed is known to 50 %.
    """
    history = fit.history
    v = history.speed
    at = basis(v)
    resistance = np.sum(history.beta[:, :-1] * at, axis=1)
    std = np.sqrt(np.einsum("ni,nij,nj->n", at, history.covariance[:, :-1, :-1], at))
    known = np.maximum.accumulate(std < 0.5 * resistance)
    return frame_of(
        ESTIMATED_RESISTANCE,
        pd.DatetimeIndex(history.time[known]),
        {
            **dict(zip(PARAMETERS, history.beta[known].T, strict=True)),
            "resistance": resistance[known],
            "resistance_std": std[known],
        },
    )


def mass_prior(train: Train) -> tuple[float, float]:
    """Mass that is expected before the trip and its standard deviation [kg]: weak.

    Half the largest load, give or take all of it; 15 % of the empty mass where no largest load is
    stated.
    """
    largest = train.max_load or 0.15 * train.mass
    return train.mass + 0.5 * largest, largest


def check_speeds(speeds: tuple[float, float] | None) -> None:
    """Refuse speeds that bound no range.

    Parameters
    ----------
    speeds : (float, float) [m/s] or None

    Raises
    ------
    InputError
        Unless 0 <= lowest < highest and both are finite.
    """
    if speeds is None:
        return
    try:
        low, high = (float(speed) for speed in speeds)
    except (TypeError, ValueError):
        low = high = np.nan
    if not 0.0 <= low < high < np.inf:
        raise InputError(
            f"speeds {speeds!r} must be a lowest and a higher, finite speed of 0 or more, in m/s",
            remedy="give for instance speeds=(10.0, 30.0)",
        )


def _asked(speeds: tuple[float, float] | None, line: Line, train: Train) -> tuple[float, float]:
    """Speeds [m/s] between which the curve is asked for."""
    limits = float(np.max(line.speed_limits.values)), train.max_speed
    if speeds is None:
        return LOWEST_SPEED, min(limits)
    low, high = (float(speed) for speed in speeds)
    if high > max(limits):
        raise InputError(
            f"speeds ({low:g}, {high:g}) m/s exceed what line and train allow,"
            f" {max(limits):.1f} m/s ({KMH * max(limits):.0f} km/h)",
            remedy="give the speeds in m/s, not in km/h",
        )
    return low, high


def surveyed_gradients(line: Line) -> str:
    """Which survey a line's gradients are of: their digest; of a route the shares of its edges.

    Trips on different routes meet the same errors where they run over an edge in one direction.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> nodes = (trainlog.Node("St. Gallen"), trainlog.Node("Wil"))
    >>> edge = trainlog.Edge("850", line, "St. Gallen", "Wil")
    >>> surveyed_gradients(trainlog.Network("one", nodes, (edge,)).route("Wil", "Gossau SG").line)
    '{"850, 29556.1 m, reverse": 1.0}'
    """
    if not line.legs:
        numbers = np.stack([line.gradients.positions, line.gradients.values])
        return sha256(numbers.astype("<f8").tobytes())
    shares: dict[str, float] = {}
    for leg in line.legs:
        way = "forward" if leg.forward else "reverse"
        key = f"{leg.edge}, {leg.edge_length:.1f} m, {way}"
        shares[key] = shares.get(key, 0.0) + leg.length / line.length
    rounded = {key: round(share, 6) for key, share in sorted(shares.items())}
    return json.dumps(rounded, ensure_ascii=False)


def _with_gain(beta: FloatArray, covariance: FloatArray, gain_std: float) -> FloatArray:
    """Covariances (..., p, p) of parameters (..., p) with the uncertainty of the effort's gain.

    All of them are in the measure of the effort: a gain 1 % too high makes each 1 % too high.
    """
    return np.asarray(covariance + gain_std**2 * beta[..., :, None] * beta[..., None, :])


def _check_windows(name: str, windows: Windows, prepared: Prepared) -> None:
    masked, total = prepared.masked, prepared.duration
    usable = float(np.sum(windows.duration))
    if usable >= SHORTEST_TIME:
        return
    kinds: tuple[Reason, ...] = ("gap", "standstill", "braking", "slip")
    worst = max(kinds, key=lambda reason: masked[reason])
    raise TripRefusedError(
        worst if masked[worst] > 0.5 * total else "too short",
        f"trip '{name}': only {usable:.0f} s can be used of {total:.0f} s"
        f" (masked: {prepared.timeline.in_words(masked)})",
        remedy=f"running resistance needs {SHORTEST_TIME:.0f} s free of friction braking",
        timeline=prepared.timeline,
    )


def _stretch_words(found: Stretch, timeline: Timeline, view: TripView, origin: pd.Timestamp) -> str:
    """Where and when a trip is unlike itself, by how much, and what was made of it."""
    ends = np.array([found.start, found.end])
    places = np.interp(ends, timeline.time, timeline.position)
    km = in_km(view.own_line, view.line.length - places if view.backwards else places)
    first, last = (f"{origin + pd.Timedelta(each, 's'):%H:%M:%S}" for each in ends)
    more = "more" if found.force > 0.0 else "less"
    # Of two long parts either may be the unlike one.
    drags = found.force > 0.0 or found.ambiguous
    causes = "a dragging brake, wind" if drags else "wind, slip that is not recorded"
    inside = view.line.tunnel_cross_section(np.linspace(places[0], places[1], 50))
    causes += ", a tunnel" * bool(np.mean(inside > 0.0) > 0.5)
    made = "the band holds both" if found.ambiguous else "left to itself"
    return (
        f"from km {km[0]:.1f} to {km[1]:.1f} ({first} to {last} UTC) the train needs"
        f" {abs(found.force) / 1e3:.1f} ± {1.96 * found.std / 1e3:.1f} kN {more} than elsewhere:"
        f" {causes}, or wrong gradients; {made}"
    )


def _check_curve(
    name: str,
    regression: WindowFit,
    covariance: FloatArray,
    unlike: list[str],
    asked: tuple[float, float],
    timeline: Timeline,
    largest_std: float,
) -> None:
    """Refuse parts that differ by more than the band may hold, and a curve that is not known."""
    speed = np.linspace(*asked, 61)
    curve = RunningResistance.of(regression.beta[:-1])(speed)
    for found, said in zip(regression.stretches, unlike, strict=False):
        if found.ambiguous and 0.5 * abs(found.force) > largest_std * float(np.min(curve)):
            raise TripRefusedError(
                "contradiction",
                f"trip '{name}': {said.rpartition(';')[0]}",
                remedy="find out which part is right, and fit that part alone",
                timeline=timeline,
            )
    if regression.condition > LARGEST_CONDITION:
        raise TripRefusedError(
            "condition",
            f"trip '{name}': speed and effort vary too little to determine"
            f" {', '.join(regression.inseparable)} (condition number {regression.condition:.0f}, at"
            f" most {LARGEST_CONDITION:.0f})",
            remedy=_slip_words(timeline)
            or "a trip with starts, coasting and several speeds, or several trips at other speeds",
            timeline=timeline,
        )
    std = curve_std(covariance[:-1, :-1], speed)
    share = np.where(curve > 0.0, std / np.maximum(curve, 1e-9), np.inf)
    worst = int(np.argmax(share))
    if share[worst] > largest_std:
        known = f"{100.0 * min(share[worst], 1.0):.3g} %"
        known += " or more" if share[worst] > 1.0 else ""
        raise TripRefusedError(
            "excitation",
            f"trip '{name}': at {KMH * speed[worst]:.0f} km/h the running resistance is uncertain"
            f" by {known} (standard deviation; at most {100.0 * largest_std:.0f} % is accepted)",
            remedy=_slip_words(timeline) or "give a trip that stays near this speed for longer",
            timeline=timeline,
        )


def _slip_words(timeline: Timeline) -> str | None:
    """What a trip would need that slip masks more of than `SLIPPED`."""
    lost = timeline.masks["slip"]
    if not np.mean(lost) > SLIPPED:
        return None
    return (
        f"{timeline.named('slip')} masked {np.sum(lost)} s, which the speeds of all powered axles,"
        " recorded twice a second at least, would keep"
    )


# -------------------------------------------------------------------------- largest traction power

SHORTEST = 5.0
"""Shorter time at the limit than this [s] is not used."""

LIMIT_SPEED = 8.0
"""Below this speed [m/s] effort is limited by adhesion or by the motors, not by power."""

AVERAGED = 2.0
"""Efforts are averaged over this time [s]."""

LASTING = 6.0
"""Averages that lie so far apart [s] count as independent: then 39 of 40 simulated limits lie
within their 95 % band."""

PLATEAU = 0.03
"""Power within this share of the highest counts as the same limit."""

SPEED_RANGE = 2.0
"""Power must stay the same while speed changes by this [m/s]; a limit of effort does not."""

STEEP = 0.5
"""Relative fall of a curve of effort over the relative rise of speed, from which its efforts show
the power; where power alone limits it is 1."""

UNEVEN = 0.08
"""Relative scatter of the power that efforts on a curve show, beyond which several limits acted."""

FULL_LEVER = 0.99
"""From this lever position on all the traction there is is asked for."""

WEAKEST = 0.5
"""Share of the train's stated power below which another limit (adhesion, a fault) is at work."""


def power_limit(
    trip: Trip, prepared: Prepared, train: Train, scale_std: float
) -> tuple[float, float] | None:
    """Traction power at the wheel rims where the train was at its limit.

    More effort was asked for there than was given. Efforts are averaged; wheels that slip and
    transients are left out. The wheels' own speed counts where it is recorded: it is the motors
    that are limited. Where no effort demand is recorded, a full lever asks for more than is given;
    what the effort of adhesion or of the motors limits then is left out, as its power is not the
    same at all speeds.

    Parameters
    ----------
    trip : Trip
        Its efforts in time and size.
    prepared : Prepared
    train : Train
    scale_std : float
        Standard deviation of the speed scale; the power has the same on top.

    Returns
    -------
    tuple or None
        The power and its standard deviation [W]; None if the train was not at its power limit for
        `SHORTEST` at least.
    """
    controls, index = trip["/train/controls"], prepared.index
    step = float(np.median(np.diff(prepared.time)))
    width = max(1, round(AVERAGED / step))
    power = _moving_average(_power_at(trip, index, prepared, train), width)
    steady = prepared.usable & (prepared.slip_momentum == 0.0)
    limited = steady & (prepared.speed > LIMIT_SPEED) & np.isfinite(power)
    if controls["tractive_effort_demand"].notna().any():
        demand, effort = (
            _moving_average(interpolated(controls, name, index), width)
            for name in ("tractive_effort_demand", "tractive_effort")
        )
        limited &= demand > 1.01 * effort
    else:
        limited &= interpolated(controls, "lever", index) >= FULL_LEVER
    # A limit that lasts: true for the whole averaging time around the sample.
    limited &= _moving_average(limited.astype(np.float64), width) > 0.999
    power, speed = power[limited], prepared.speed[limited]
    if train.traction_curve is not None:
        # A train with a share of the power has each effort of its curve at that share of its speed.
        # Where effort hardly falls with the speed it says nothing of the power, and is left out.
        curve = train.traction_curve.without_rise
        power, speed = power[power > 0.0], speed[power > 0.0]
        effort = power / speed
        reached = curve.speed_at(effort)
        known = (reached > 0.0) & (-curve.slope(reached) * reached >= STEEP * effort)
        share, power, speed = speed[known] / reached[known], power[known], speed[known]
        # Whichever limits more needs the larger share: the curve or the stated power.
        power = np.maximum(share * train.max_traction_power, power)
    if power.size * step < SHORTEST:
        return None
    plateau = power > (1.0 - PLATEAU) * float(np.quantile(power, 0.98))
    if train.traction_curve is not None and power.size:
        # All of it shows the same share, and more scattered: the highest would be the noise's.
        middle = float(np.median(power))
        spread = robust_std(power - middle)
        if spread > UNEVEN * middle:
            return None
        plateau = np.abs(power - middle) < max(PLATEAU * middle, 3.0 * spread)
    found, speeds = float(np.median(power[plateau])), speed[plateau]
    time = float(np.count_nonzero(plateau) * step)
    lasts = time >= SHORTEST and np.ptp(speeds) >= SPEED_RANGE
    if not lasts or found <= WEAKEST * train.max_traction_power:
        return None
    scatter = robust_std(power[plateau] - found)
    # Averages overlap, and what scatters lasts longer than one of them.
    own = 1.2533 * scatter / np.sqrt(max(time / LASTING, 1.0))
    return found, float(np.hypot(own, scale_std * found))


def _power_at(trip: Trip, index: pd.DatetimeIndex, prepared: Prepared, train: Train) -> np.ndarray:
    """Power of the motors [W] at each sample; by the axles if speed and effort of all are there."""
    if "/train/axles" in trip:
        axles = trip["/train/axles"]
        efforts = [n.rpartition("_")[2] for n in axles.columns if n.startswith("wheel_effort_")]
        numbers = [n for n in efforts if f"wheel_speed_{n}" in axles]
        products = [
            interpolated(axles, f"wheel_effort_{n}", index)
            * interpolated(axles, f"wheel_speed_{n}", index)
            for n in numbers
        ]
        if (
            len(products) >= max(train.axles.count, 1)
            and np.isfinite(np.sum(products, axis=0)).any()
        ):
            return np.asarray(np.sum(products, axis=0) / prepared.scale.factor)
    effort = interpolated(trip["/train/controls"], "tractive_effort", index)
    return np.asarray(effort * prepared.speed)


def _moving_average(values: np.ndarray, width: int) -> np.ndarray:
    """Centred mean over `width` samples; NaN where it would reach beyond the data."""
    return pd.Series(values).rolling(width, center=True).mean().to_numpy()
