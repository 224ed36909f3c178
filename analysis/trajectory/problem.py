"""The trajectory problem: what is asked, and its arrays once the line is cut into cells.

Space is the independent variable. Every configuration has its own ``z = v²/2`` at the nodes
between the cells; the controls are constant in a cell. All forces are divided by one reference
inertia, so that efforts are accelerations and energies are in J/kg of that inertia::

    dz/ds = gain (u_f - u_b) - drag0 - drag1 v - drag2 v²,        paper 002, eq. (2)

with ``gain`` the reference inertia over the configuration's own.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from analysis.trajectory.dynamics import SUBSTEPS
from trainlog.errors import InputError
from trainlog.railway import Configuration, Line, StepProfile, TimingPoint, TrackConditionMap, Train
from trainlog.units import GRAVITY, KMH

FloatArray = NDArray[np.float64]
Braking = Literal["recourse", "common"]
Direction = Literal["forward", "reverse"]
Objective = Literal["wheel", "line", "expected"]

_BULGE_PARTS = 16

_SLOWEST = 1.0 / KMH
"""Least speed that must be permitted everywhere [m/s]."""


@dataclass(frozen=True, eq=False)
class Run:
    """One run between two stops: what is asked of the optimiser.

    Attributes
    ----------
    line : Line
    train : Train
    configurations : tuple of q Configuration
    start, end : float [m]
        Where on the line the run begins and ends.
    initial_speed, final_speed : float [m/s]
        The run ends at the final speed or below it.
    braking : str
        ``"recourse"``: each configuration brakes for itself (the driver closes the loop with the
        brake). ``"common"``: one braking effort for all, as printed in paper 002.
    objective : str
        ``"wheel"``: energy at the wheel rims without regeneration, paper 002, eq. (9).
        ``"line"``: energy taken from the line with efficiencies and regeneration, of the worst
        configuration, eq. (1). ``"expected"``: the same, as the mean of the configurations by
        their weights; all of them keep timetable and limits nevertheless.
    weights : tuple of float
        Of the configurations, for the expected energy; equal ones if empty.
    direction : str
        ``"reverse"`` if the line is travelled against the chainage in which the map is counted.
    condition : TrackConditionMap or None
    layer : str
        Rail condition to read from the map.
    sigmas : float
        How cautiously the map is read: the estimate less this many standard deviations.
    protected_length : float [m]
        Length of train to which a speed limit applies; 0 for its front alone.
    windows : tuple of TimingPoint
        Where it passes on the way, when and how fast; times count from the start of the run.
    """

    line: Line
    train: Train
    configurations: tuple[Configuration, ...]
    start: float
    end: float
    initial_speed: float = 0.0
    final_speed: float = 0.0
    braking: Braking = "recourse"
    objective: Objective = "wheel"
    condition: TrackConditionMap | None = None
    layer: str = "wet"
    sigmas: float = 2.0
    protected_length: float = 0.0
    windows: tuple[TimingPoint, ...] = ()
    weights: tuple[float, ...] = ()
    direction: Direction = "forward"

    def __post_init__(self) -> None:
        line, where = self.line, f"run on line '{self.line.name}'"
        if not self.configurations:
            raise InputError(f"{where}: no parameter configuration given")
        names = [configuration.name for configuration in self.configurations]
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise InputError(f"{where}: two configurations are called '{twice}'")
        if not 0.0 <= self.start < self.end <= line.length:
            raise InputError(
                f"{where}: from km {self.start / 1e3:.3f} to km {self.end / 1e3:.3f} is no section"
                f" of a line of {line.length / 1e3:.3f} km"
            )
        if not (self.initial_speed >= 0.0 and self.final_speed >= 0.0):
            raise InputError(f"{where}: initial and final speed must not be negative")
        if self.braking not in get_args(Braking) or self.objective not in get_args(Objective):
            raise InputError(
                f"{where}: no such braking '{self.braking}' or objective '{self.objective}'",
                remedy="braking is 'recourse' or 'common', objective 'wheel', 'line' or 'expected'",
            )
        if not (0.0 <= self.protected_length < np.inf):
            raise InputError(
                f"{where}: a protected length of {self.protected_length} m makes no sense",
                remedy="give 0 for the train's front, or the train's length",
            )
        self._check_windows(where)
        self._check_weights(where)
        if self.direction not in get_args(Direction):
            raise InputError(
                f"{where}: no such direction '{self.direction}'",
                remedy="give 'forward' or 'reverse'",
            )
        limit = float(self.permitted_speed(np.array([self.start]))[0])
        if self.initial_speed > limit:
            raise InputError(
                f"{where}: the initial speed {KMH * self.initial_speed:.1f} km/h is above the"
                f" {KMH * limit:.1f} km/h permitted at km {self.start / 1e3:.3f}"
            )
        if self.condition is not None and self.condition.line != line.name:
            raise InputError(
                f"{where}: the track-condition map is of line '{self.condition.line}'",
                remedy="give the map of this line",
            )
        if self.condition is not None and abs(self.condition.length - line.length) > 1.0:
            raise InputError(
                f"{where}: the track-condition map belongs to a line of"
                f" {self.condition.length / 1e3:.3f} km",
                remedy="give the map of this line and direction",
            )
        self._check_limits(where)

    def _check_windows(self, where: str) -> None:
        """Refuse passing points that are none, or out of order."""
        places = [self.start, *(point.position for point in self.windows), self.end]
        # The last may be the end itself: no configuration arrives earlier than that.
        if self.windows and self.windows[-1].position == self.end:
            places.pop()
        for before, place in pairwise(places):
            if not before < place:
                raise InputError(
                    f"{where}: the passing point at km {place / 1e3:.3f} does not come after"
                    f" km {before / 1e3:.3f}",
                    remedy="order the points by position, between the start and the end",
                )
        for point in self.windows:
            if point.highest_speed == 0.0:
                raise InputError(
                    f"{where}: the train stands at km {point.position / 1e3:.3f}, in the run",
                    remedy="a stop is where one run ends and the next begins: give a journey",
                )

    def _check_weights(self, where: str) -> None:
        """Refuse weights that are no probabilities of these configurations."""
        weights = np.array(self.weights)
        if not self.weights:
            return
        if weights.size != len(self.configurations) or not np.all(weights >= 0.0):
            raise InputError(
                f"{where}: {weights.size} weights for {len(self.configurations)} configurations",
                remedy="give one for each, none negative",
            )
        if not (np.isfinite(weights.sum()) and weights.sum() > 0.0):
            raise InputError(f"{where}: the weights add up to {weights.sum()}")

    def _check_limits(self, where: str) -> None:
        """Refuse a limit below walking pace, and a map that cannot be read as asked."""
        positions = self.breakpoints
        limit = self.permitted_speed(0.5 * (positions[:-1] + positions[1:]))
        if limit.min() < _SLOWEST:
            raise InputError(
                f"{where}: {KMH * limit.min():.2f} km/h permitted at"
                f" km {positions[int(np.argmin(limit))] / 1e3:.3f} is no speed to run at",
                remedy=f"permit at least {KMH * _SLOWEST:.0f} km/h, or end the run there",
            )
        if self.condition is None:
            return
        if not (0.0 <= self.sigmas < np.inf):
            raise InputError(
                f"{where}: {self.sigmas} standard deviations off the map make no sense",
                remedy="give 0 or more",
            )
        bins = self.condition.lower_bound(self.layer, self.condition.centres, self.sigmas)
        wrong = np.flatnonzero(~(bins > 0.0))
        if wrong.size:
            raise InputError(
                f"{where}: the track-condition map tells no adhesion at"
                f" km {self.condition.centres[wrong[0]] / 1e3:.3f}, which it says was observed",
                remedy="build the map again; places not observed are left out, not guessed",
            )

    @property
    def at_line(self) -> bool:
        """Whether energy counts at the line, not at the wheel."""
        return self.objective != "wheel"

    @property
    def limits(self) -> StepProfile:
        """The line's speed limits as the protected length of the train meets them [m/s]."""
        profile, length = self.line.speed_limits, self.protected_length
        if length == 0.0:
            return profile
        edges = np.unique(np.concatenate((profile.positions, profile.positions + length)))
        edges = np.concatenate(([0.0], edges[edges > 0.0]))
        behind = edges[:, None] - length
        under_train = (profile.positions <= edges[:, None]) & (
            np.append(profile.positions[1:], np.inf) > behind
        )
        return StepProfile(edges, np.where(under_train, profile.values, np.inf).min(axis=1))

    def permitted_speed(self, position: FloatArray) -> FloatArray:
        """Highest permitted speed [m/s] at each position: line and train."""
        return np.minimum(self.limits(position), self.train.max_speed)

    @property
    def breakpoints(self) -> FloatArray:
        """Positions [m] from start to end at which something about the line changes."""
        points = np.concatenate(
            (
                self.line.breakpoints,
                self.limits.positions,
                _inflections(self.line),
                [point.position for point in self.windows],
            )
        )
        inside = points[(points > self.start) & (points < self.end)]
        return np.unique(np.concatenate(([self.start], inside, [self.end])))

    def adhesion_at(self, positions: FloatArray) -> FloatArray:
        """Cautious maximum adhesion at each position; infinite where unknown."""
        if self.condition is None:
            return np.full(positions.shape, np.inf)
        own = self.line.length - positions if self.direction == "reverse" else positions
        return np.asarray(self.condition.lower_bound(self.layer, own, self.sigmas))

    def adhesion(self, positions: FloatArray) -> FloatArray:
        """Cautious maximum adhesion in each cell between `positions`; infinite where unknown."""
        cells = positions.size - 1
        if self.condition is None:
            return np.full(cells, np.inf)
        if self.direction == "reverse":
            # The map is counted in the line's own direction.
            turned = replace(self, direction="forward")
            return turned.adhesion(self.line.length - positions[::-1])[::-1]
        bins = self.condition.lower_bound(self.layer, self.condition.centres, self.sigmas)
        first = self.condition.bin_of(positions[:-1])
        last = self.condition.bin_of(np.nextafter(positions[1:], -np.inf))
        spans = np.column_stack((first, last + 1)).ravel()
        return np.asarray(np.minimum.reduceat(np.append(bins, np.inf), spans)[::2])


@dataclass(frozen=True, eq=False)
class Problem:
    """The arrays of a run, cut into n cells, for q configurations; per unit reference inertia.

    Attributes
    ----------
    positions : (n + 1,) array [m]
    step : (n,) array [m]
    reference : float [kg]
        The reference inertia.
    gain : (q,) array
        Reference inertia over the configuration's.
    drag0 : (q, n, SUBSTEPS + 1) array [m/s²]
        Gradient, curves and constant running resistance at the ends of equal parts of each cell.
    drag1 : (q,) array [1/s]
    drag2 : (q, n) array [1/m]
        With the tunnel's share.
    ceiling : (n + 1,) array [m²/s²]
        Largest permitted ``z`` at the nodes, so that the limit holds between them too.
    bulge : (n,) array [m²/s²]
        By how much ``z`` can rise above both ends of a cell inside it.
    traction : (n,) array [m/s²]
        Largest common tractive effort; eq. (6) with comfort and adhesion.
    power : (q,) array [W/kg]
        Largest tractive effort times speed; eq. (5).
    braking : (q, n) array [m/s²]
        Largest braking effort, all brakes together; eq. (7) with comfort and adhesion.
    friction, dynamic : (q, n) array [m/s²]
        What each kind of brake can do.
    dynamic_power : float [W/kg]
    weights : (q,) array
        Of the configurations in the expected energy; they add up to 1.
    initial, final : float [m²/s²]
        ``z`` at the start, and the most it may be at the end; eq. (8).
    floor : (n + 1,) array [m²/s²]
        Least ``z`` at the nodes; above 0 only where the train must pass fast enough.
    passed : (p,) array of int
        Nodes of the passing points.
    earliest, latest : (p,) array [s]
        When they may be passed; infinite where there is no bound.
    """

    run: Run
    positions: FloatArray
    step: FloatArray
    reference: float
    gain: FloatArray
    drag0: FloatArray
    drag1: FloatArray
    drag2: FloatArray
    ceiling: FloatArray
    bulge: FloatArray
    traction: FloatArray
    power: FloatArray
    braking: FloatArray
    friction: FloatArray
    dynamic: FloatArray
    dynamic_power: float
    initial: float
    final: float
    floor: FloatArray
    passed: NDArray[np.int64]
    earliest: FloatArray
    latest: FloatArray
    weights: FloatArray

    @property
    def shape(self) -> tuple[int, int]:
        """Number of configurations and of cells."""
        return self.drag2.shape[0], self.drag2.shape[1]

    @property
    def mean_drag0(self) -> FloatArray:
        """Mean of `drag0` over each cell, (q, n) [m/s²]."""
        ends = 0.5 * (self.drag0[:, :, 0] + self.drag0[:, :, -1])
        return np.asarray((self.drag0[:, :, 1:-1].sum(axis=2) + ends) / SUBSTEPS)

    @property
    def common(self) -> bool:
        """Whether all configurations share one braking effort."""
        return self.run.braking == "common"

    @property
    def final_ceiling(self) -> float:
        """Largest permitted ``z`` at the end [m²/s²]: the asked speed or the limit there."""
        return min(self.final, float(self.ceiling[-1]))

    def select(self, rows: Sequence[int]) -> Problem:
        """The same problem for some of the configurations; common limits stay those of all."""
        chosen = list(rows)
        arrays: dict[str, Any] = {
            name: getattr(self, name)[chosen]
            for name in (
                "gain", "drag0", "drag1", "drag2", "power", "braking", "friction", "dynamic",
                "weights"
            )
        }  # fmt: skip
        configurations = tuple(self.run.configurations[row] for row in chosen)
        return replace(self, run=replace(self.run, configurations=configurations), **arrays)


@dataclass(frozen=True, eq=False)
class Plan:
    """A trajectory in the making: all controls and where they lead.

    Attributes
    ----------
    z : (q, n + 1) array [m²/s²]
    traction : (n,) array [m/s²]
        Per unit reference inertia, as the efforts below.
    braking, dynamic : (q, n) array [m/s²]
        All brakes together, and the dynamic brake's part in it.
    """

    z: FloatArray
    traction: FloatArray
    braking: FloatArray
    dynamic: FloatArray


def inside(positions: FloatArray, parts: int) -> FloatArray:
    """Positions [m] of the ends of equal parts of each cell, (n, parts + 1).

    The outermost lie a trifle inside the cell, on its own side of whatever changes at a node.
    """
    shares = np.clip(np.linspace(0.0, 1.0, parts + 1), 1e-9, 1.0 - 1e-9)
    return np.asarray(positions[:-1, None] + np.diff(positions)[:, None] * shares)


def _inflections(line: Line) -> FloatArray:
    """Positions [m] inside the curve elements at which one bend turns into the opposite one."""
    profile = line.curvatures
    if profile is None:
        return np.empty(0)
    turns = profile.start * profile.end < 0.0
    first, last = profile.start[turns], profile.end[turns]
    ends = np.append(profile.positions[1:], line.length)[turns]
    begins = profile.positions[turns]
    return np.asarray(begins + (ends - begins) * first / (first - last))


def discretise(run: Run, positions: FloatArray) -> Problem:
    """Cut `run` into cells between `positions`.

    Parameters
    ----------
    positions : (n + 1,) array [m]
        From the run's start to its end, through all of its breakpoints.
    """
    train, step = run.train, np.diff(positions)
    middle = positions[:-1] + 0.5 * step
    masses = np.array([c.mass for c in run.configurations])[:, None]
    inertia = np.array([c.inertia for c in run.configurations])
    reference = float(inertia.max())
    gain = reference / inertia

    track = run.line.track_acceleration(inside(positions, SUBSTEPS))
    coefficients = np.array(
        [[c.resistance.r0, c.resistance.r1, c.resistance.r2] for c in run.configurations]
    )
    tunnel = train.tunnel_coefficient(run.line.tunnel_cross_section(middle))
    limit = run.permitted_speed(middle)
    lowest = np.minimum(np.append(limit, np.inf), np.insert(limit, 0, np.inf))
    # Between its ends a cell's speed rises above them where the track's force changes in the cell.
    bulge = _bulge(run, positions)
    highest = np.maximum(np.append(bulge, 0.0), np.insert(bulge, 0, 0.0))
    ceiling = 0.5 * lowest**2 - highest
    ceiling[0] = max(ceiling[0], 0.5 * run.initial_speed**2)
    passed = np.searchsorted(positions, [point.position for point in run.windows])
    floor = np.zeros(positions.size)
    for node, point in zip(passed.tolist(), run.windows, strict=True):
        if point.highest_speed is not None:
            ceiling[node] = min(ceiling[node], 0.5 * point.highest_speed**2)
        floor[node] = 0.5 * (point.lowest_speed or 0.0) ** 2
    efforts = effort_limits(run, positions)
    return Problem(
        run=run,
        positions=positions,
        step=step,
        reference=reference,
        gain=gain,
        drag0=(coefficients[:, :1, None] + masses[:, :, None] * track) / inertia[:, None, None],
        drag1=coefficients[:, 1] / inertia,
        drag2=(coefficients[:, 2:] + tunnel) / inertia[:, None],
        ceiling=ceiling,
        bulge=bulge,
        traction=efforts.traction.min(axis=0) / reference,
        power=np.array([c.max_power for c in run.configurations]) / reference,
        braking=efforts.braking / reference,
        friction=efforts.friction / reference,
        dynamic=efforts.dynamic / reference,
        dynamic_power=train.max_dynamic_braking_power / reference,
        initial=0.5 * run.initial_speed**2,
        final=0.5 * run.final_speed**2,
        floor=floor,
        passed=passed.astype(np.int64),
        earliest=_bounds([point.earliest for point in run.windows], -np.inf),
        latest=_bounds([point.latest for point in run.windows], np.inf),
        weights=_probabilities(run),
    )


def _probabilities(run: Run) -> FloatArray:
    weights = np.array(run.weights or np.ones(len(run.configurations)))
    return np.asarray(weights / weights.sum())


def _bounds(values: Sequence[float | None], without: float) -> FloatArray:
    return np.array([without if value is None else value for value in values], dtype=np.float64)


def _bulge(run: Run, positions: FloatArray) -> FloatArray:
    """By how much ``z`` can rise above both ends inside a cell of changing curvature, (n,)."""
    track = run.line.track_acceleration(inside(positions, _BULGE_PARTS))
    parts = 0.5 * (track[:, :-1] + track[:, 1:])
    spared = np.cumsum(parts.mean(axis=1, keepdims=True) - parts, axis=1).max(axis=1)
    bulge = np.maximum(spared, 0.0) * np.diff(positions) / _BULGE_PARTS
    return np.where(np.ptp(track, axis=1) > 1e-9, bulge, 0.0)


@dataclass(frozen=True, eq=False)
class EffortLimits:
    """Largest efforts [N] of each configuration in each cell, power apart; (q, n) arrays."""

    traction: FloatArray
    braking: FloatArray
    friction: FloatArray
    dynamic: FloatArray


def effort_limits(run: Run, positions: FloatArray) -> EffortLimits:
    """Efforts that machine, comfort and adhesion allow in the cells between `positions`.

    Traction and the dynamic brake act on the powered axles, all brakes together on every axle.
    """
    train, adhesion = run.train, run.adhesion(positions)
    mass = np.array([[c.mass] for c in run.configurations])
    inertia = np.array([[c.inertia] for c in run.configurations])
    adhesive = np.array([[train.adhesive_weight(c.mass - train.mass)] for c in run.configurations])
    on_powered, on_all = adhesion * adhesive, adhesion * GRAVITY * mass

    def least(*limits: FloatArray | float) -> FloatArray:
        return np.broadcast_to(np.minimum.reduce(np.broadcast_arrays(*limits)), on_all.shape)

    comfort = train.max_deceleration * inertia
    return EffortLimits(
        traction=least(train.max_tractive_effort, train.max_acceleration * inertia, on_powered),
        braking=least(train.max_braking_effort, comfort, on_all),
        friction=least(train.max_pneumatic_braking_effort, comfort, on_all),
        dynamic=least(train.max_dynamic_braking_effort, comfort, on_powered),
    )
