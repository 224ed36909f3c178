"""The train as a plant: built from a line and a train, advanced under a demand.

`Plant` prepares the tables that the compiled dynamics (`trainlog.simulation.dynamics`) walks
along; `PlantState` is where the train is.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from functools import cached_property

import numpy as np

from trainlog.arrays import FloatArray, IntArray
from trainlog.errors import InputError
from trainlog.railway import Line, RunningResistance, StepProfile, Train
from trainlog.railway.adhesion import DRY, LEAST_SPEED, AdhesionCharacteristic, creep_coefficients
from trainlog.railway.resistance import EffortCurve, arrays_of
from trainlog.simulation import dynamics
from trainlog.simulation.dynamics import (
    CURVE,
    HEAVIEST,
    LEAST_SLIP,
    SAMPLE,
    SLIP_STEP,
    SLIPS,
    WHEELS,
    WORKS,
    PlantParameters,
)
from trainlog.units import GRAVITY

NO_EFFORTS = np.zeros(0)
"""For the compiled code: no traction control, but the slip protection of the plant."""

HOLDING = 0.7
"""Braking effort of a standing train over its mass [m/s²]; holds on 70 per mille."""

CURVE_SPEEDS = np.geomspace(LEAST_SPEED, 120.0, 36)
"""Train speeds [m/s] at which a characteristic that depends on the speed is tabulated."""

MOST_PARTS = 100
"""Into which a step of integration is cut at low speed on a steep characteristic."""


@dataclass(frozen=True)
class Drive:
    """How the drive and its anti-slip control behave.

    Attributes
    ----------
    motor_lag : float [s]
        First-order lag of the motor torque.
    braking_fade_speed : float [m/s]
        Below it the dynamic brake fades out in proportion to speed.
    holding_speed : float [m/s]
        Below it a holding brake is applied unless traction is demanded; 0: the train has none.
    slip_threshold, slip_release : float [m/s]
        Slip speed at which the effort of an axle is taken off, and at which it is re-applied.
    slip_delay : float [s]
        How long a wheel slips before that.
    slip_reapply : float
        Where the quick re-application ends: share of the effort at which the wheel slipped.
    slip_ramp : float [1/s]
        Slow re-application: share of the largest effort, a second.
    """

    motor_lag: float = 0.1
    braking_fade_speed: float = 3.0
    holding_speed: float = 0.0
    slip_threshold: float = 3.0
    slip_delay: float = 0.3
    slip_release: float = 1.0
    slip_reapply: float = 0.7
    slip_ramp: float = 0.06


@dataclass
class PlantState:
    """Where the train is and what its drive and brakes are doing; changed by `Plant.advance`.

    Attributes
    ----------
    values : (3 + 2n + 6,) array
        Position [m], train speed [m/s], friction braking effort [N], n wheel speeds [m/s], n
        lagged motor efforts [N] and the works of `dynamics.WORKS` [J].
    slip_memory : (3, n) array [N], [N], [s]
    friction_delay : (k,) array [N]
    places : (3 + n,) int array
    """

    values: FloatArray
    slip_memory: FloatArray
    friction_delay: FloatArray
    places: IntArray

    @property
    def position(self) -> float:
        """Chainage [m]."""
        return float(self.values[dynamics.POSITION])

    @property
    def speed(self) -> float:
        """Train speed [m/s]."""
        return float(self.values[dynamics.SPEED])

    @property
    def wheel_speeds(self) -> FloatArray:
        """Circumferential speed of the powered wheels [m/s]."""
        return self.values[WHEELS : WHEELS + self.slip_memory.shape[1]]

    @property
    def motor_efforts(self) -> FloatArray:
        """Efforts of the motors, lagged [N]; power and curves limit them further."""
        n = self.slip_memory.shape[1]
        return self.values[WHEELS + n : WHEELS + 2 * n]

    @property
    def works(self) -> dict[str, float]:
        """Work of each force since the beginning [J]."""
        return dict(zip(WORKS, self.values[-len(WORKS) :].tolist(), strict=True))


@dataclass(frozen=True)
class Plant:
    """One train on one line on one trip.

    Build it with `Plant.of`; the attributes are the tables and constants of the compiled code.
    """

    parameters: PlantParameters
    track: FloatArray
    rail: FloatArray
    weights: FloatArray
    length: float = field(default=np.inf)
    traction_curve: FloatArray = field(default_factory=lambda: _axle_curve(None, 1))
    braking_curve: FloatArray = field(default_factory=lambda: _axle_curve(None, 1))
    curves: FloatArray = field(default_factory=lambda: curve_table(None))
    over_creepage: bool = False
    transfer: FloatArray = field(default_factory=lambda: np.empty((0, 1)))

    @cached_property
    def _constants(self) -> FloatArray:
        return np.array(self.parameters, dtype=np.float64)

    @staticmethod
    def of(
        line: Line,
        train: Train,
        *,
        mass: float | None = None,
        rotating_mass: float | None = None,
        resistance: RunningResistance | None = None,
        max_power: float | None = None,
        maximum_adhesion: StepProfile | None = None,
        characteristic: AdhesionCharacteristic | None = None,
        axle_adhesion: FloatArray | None = None,
        drive: Drive | None = None,
        step: float = 0.005,
    ) -> Plant:
        """Prepare a train for a line.

        Parameters
        ----------
        line : Line
            As travelled.
        train : Train
        mass : float [kg], optional
            Loaded, without the rotating part; default: the empty train.
        rotating_mass : float [kg], optional
            Of all rotating parts; default: the train's own.
        resistance : RunningResistance, optional
        max_power : float [W], optional
        maximum_adhesion : StepProfile, optional
            By position; default: the dry rail of Zhao et al. (2025) everywhere.
        characteristic : AdhesionCharacteristic, optional
            Shape of the adhesion over slip, scaled at every train speed to the maximum adhesion
            there; default: the curves of Zhao et al. (2025), see `creep_coefficients`.
        axle_adhesion : (n,) array, optional
            Adhesion of each axle over the profile's; default 1.
        drive : Drive, optional
        step : float [s]
            Of the integration.

        Raises
        ------
        InputError
            For a train that cannot be, or a step too coarse for the axles' inertia.

        Examples
        --------
        >>> from trainlog.formats.railway import read_line
        >>> from trainlog.formats.railway import read_train
        >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
        >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
        >>> plant = Plant.of(line, train, mass=130_000.0)
        >>> state = plant.at(position=500.0)
        >>> _ = plant.advance(state, tractive_effort=100e3, braking_effort=0.0, steps=2_000)
        >>> f"{state.speed:.2f} m/s after {state.position - 500.0:.1f} m"
        '7.15 m/s after 32.8 m'
        """
        drive = drive or Drive()
        axles = train.axles
        mass = train.mass if mass is None else mass
        rotating = train.rotating_mass if rotating_mass is None else rotating_mass
        resistance = resistance or train.resistance
        power = train.max_traction_power if max_power is None else max_power
        if maximum_adhesion is None:
            maximum_adhesion = StepProfile(np.zeros(1), np.array([DRY.peak]))
        check_train(train, mass, rotating, power, step)
        weight = GRAVITY * axles.adhesive_mass * mass / train.mass
        rail = rail_table(maximum_adhesion)
        relative = np.ones(axles.count) if axle_adhesion is None else np.asarray(axle_adhesion)
        if relative.shape != (axles.count,) or np.any(relative <= 0.0):
            raise InputError(
                f"train '{train.name}': adhesion of the axles needs {axles.count} positive values",
                remedy="give one maximum adhesion per axle",
            )
        parameters = PlantParameters(
            mass=mass,
            body_inertia=mass + rotating - axles.count * axles.rotating_mass,
            axle_inertia=axles.rotating_mass,
            axle_weight=weight / axles.count,
            trailing_weight=GRAVITY * mass - weight,
            **dict(zip(("r0", "r1", "r2"), resistance.parabola, strict=True)),
            axle_effort=train.max_tractive_effort / axles.count,
            axle_power=power / axles.count,
            axle_braking_effort=train.max_dynamic_braking_effort / axles.count,
            axle_braking_power=train.max_dynamic_braking_power / axles.count,
            friction_effort=train.max_pneumatic_braking_effort,
            friction_dead_time=train.brake.dead_time,
            friction_lag=max(train.brake.lag, 2.0 * step),
            holding_effort=HOLDING * mass if drive.holding_speed > 0.0 else 0.0,
            **asdict(drive),
            step=step,
        )
        transfer = train.load_transfer(mass - train.mass)
        plant = Plant(
            parameters,
            track_table(line, train),
            rail,
            relative * parameters.axle_weight,
            line.length,
            _axle_curve(train.traction_curve_with(power), axles.count),
            _axle_curve(train.dynamic_braking_curve, axles.count),
            curve_table(characteristic),
            characteristic is not None and characteristic.variable == "creepage",
            transfer if transfer is not None else np.empty((0, 1)),
        )
        plant.check_step()
        return plant

    @property
    def axles(self) -> int:
        """Number of powered axles."""
        return int(self.weights.size)

    @property
    def columns(self) -> tuple[str, ...]:
        """Names of the columns that `advance` returns."""
        numbers = range(1, self.axles + 1)
        return (
            *SAMPLE,
            *(f"wheel_speed_{i}" for i in numbers),
            *(f"wheel_effort_{i}" for i in numbers),
        )

    def check_step(self) -> None:
        """Refuse a step that cannot resolve how fast creep pulls a wheel to the train's speed."""
        stiffness = float(np.max(self.rail[:, 4] * (self.rail[:, 3] - self.rail[:, 2])))
        parts = 1
        if self.curves.size:
            stiffness = float(np.max(self.rail[:, 1]) * np.max(self.curves[:, 2]))
            stiffness /= LEAST_SPEED if self.over_creepage else 1.0
            parts = MOST_PARTS
        p = self.parameters
        heaviest = float(self.weights.max()) * (HEAVIEST if self.transfer.size else 1.0)
        rate = stiffness * heaviest * (1.0 / p.axle_inertia + 1.0 / p.body_inertia)
        rate /= parts
        if p.step * rate > 1.0:
            raise InputError(
                f"step of {1e3 * p.step:g} ms is too coarse for axles of"
                f" {p.axle_inertia:g} kg rotating mass",
                remedy=f"use at most {1e3 / rate:.1f} ms",
            )

    def at(self, position: float = 0.0, speed: float = 0.0) -> PlantState:
        """The state of a train at `position` [m] rolling at `speed` [m/s] without effort.

        At standstill the friction brake is applied.
        """
        if not (0.0 <= position <= self.length and speed >= 0.0):
            raise InputError(
                f"a train cannot start at km {position / 1e3:.3f} with {speed} m/s",
                remedy=f"the line ends at km {self.length / 1e3:.3f}; speed must not be negative",
            )
        n = self.axles
        values = np.zeros(WHEELS + 2 * n + len(WORKS))
        values[dynamics.POSITION] = position
        values[dynamics.SPEED] = speed
        values[WHEELS : WHEELS + n] = speed
        steps = round(self.parameters.friction_dead_time / self.parameters.step)
        delay = np.zeros(steps)
        if speed == 0.0:
            hold = min(HOLDING * self.parameters.mass, self.parameters.friction_effort)
            values[dynamics.FRICTION] = hold
            delay[:] = hold
        return PlantState(values, np.zeros((3, n)), delay, np.zeros(3 + n, dtype=np.int64))

    def advance(
        self,
        state: PlantState,
        tractive_effort: float,
        braking_effort: float,
        steps: int,
        every: int = 1,
        efforts: FloatArray | None = None,
        most_dynamic: float = np.inf,
    ) -> FloatArray:
        """Let `steps` integration steps pass under one demand; `state` is changed in place.

        Parameters
        ----------
        state : PlantState
        tractive_effort, braking_effort : float [N]
            Demand for the whole train; braking overrules traction.
        steps : int
        every : int
            Steps between two recorded samples.
        efforts : (n,) array [N], optional
            Of each axle, negative in braking, by a `TractionControl`; default: an even share of the
            demand, under the plant's own slip protection. They are kept within what one motor
            gives and, together, within the demand.
        most_dynamic : float [N]
            The part of the braking effort that the motors give at most; see `Demand`.

        Raises
        ------
        InputError
            If there is not one finite effort for each axle.

        Returns
        -------
        (ceil(steps / every), columns) array
            Samples taken before every `every`-th step, the first at the beginning; see `columns`.
        """
        given = NO_EFFORTS
        if efforts is not None:
            given = self._within(efforts, tractive_effort, braking_effort, most_dynamic)
        out = np.empty((-(-steps // every), len(SAMPLE) + 2 * self.weights.size))
        dynamics.advance(
            state.values,
            float(tractive_effort),
            float(braking_effort),
            float(most_dynamic),
            given,
            steps,
            every,
            out,
            self.track,
            self.rail,
            self.curves,
            self.over_creepage,
            self.weights,
            self.transfer,
            state.slip_memory,
            state.friction_delay,
            state.places,
            self.traction_curve,
            self.braking_curve,
            self._constants,
        )
        return out

    def _within(
        self, efforts: FloatArray, traction: float, braking: float, most_dynamic: float
    ) -> FloatArray:
        """Efforts of a traction control [N], within what a motor gives and what is demanded."""
        given = np.asarray(efforts, dtype=np.float64)
        if given.shape != self.weights.shape or not np.all(np.isfinite(given)):
            raise InputError(
                f"traction control: efforts {given.tolist()} are not {self.axles} finite numbers",
                remedy="give one effort for each powered axle, negative in braking",
            )
        p = self.parameters
        if braking > 0.0:
            kept = np.clip(given, -p.axle_braking_effort, 0.0)
            demand = min(braking, most_dynamic)
        else:
            kept, demand = np.clip(given, 0.0, p.axle_effort), max(traction, 0.0)
        total = abs(float(kept.sum()))
        return kept if total <= demand else kept * (demand / total)


def _axle_curve(curve: EffortCurve | None, axles: int) -> FloatArray:
    """Speeds [m/s] and efforts of one of the axles [N], (2, m)."""
    speeds, efforts = arrays_of(curve)
    return np.ascontiguousarray(np.stack((speeds, efforts / axles)))


def check_train(train: Train, mass: float, rotating: float, power: float, step: float) -> None:
    """Refuse trains that cannot be.

    Raises
    ------
    InputError
    """
    axles = train.axles
    where = f"train '{train.name}'"
    if not (mass > 0.0 and power > 0.0 and step > 0.0):
        raise InputError(
            f"{where}: mass {mass} kg, power {power} W and step {step} s must be positive",
            remedy="give values above 0",
        )
    if axles.count < 1 or not axles.rotating_mass > 0.0:
        raise InputError(
            f"{where}: needs at least one powered axle with a rotating mass",
            remedy="give the train axles with a rotating mass",
        )
    # Where the train has no rotating mass, that of its axles is part of its mass.
    largest = rotating or mass
    if axles.count * axles.rotating_mass > largest:
        raise InputError(
            f"{where}: {axles.count} powered axles of {axles.rotating_mass:g} kg rotating mass"
            f" exceed the train's {largest:g} kg in all",
            remedy="state the train's rotating_mass_factor, or the rotating_mass of its axles",
        )
    if not 0.0 < axles.adhesive_mass <= train.mass:
        raise InputError(
            f"{where}: {axles.adhesive_mass:g} kg cannot rest on the powered axles of a train of"
            f" {train.mass:g} kg",
            remedy="state the adhesive mass of this train's axles",
        )


def track_table(line: Line, train: Train) -> FloatArray:
    """Track under the train: one row a piece between two breakpoints of the line.

    Returns
    -------
    (n, 8) array
        Start [m], sine of the gradient, curvature at the start [1/m], its change [1/m²], the
        tunnel's quadratic resistance [N/(m/s)²], the change of the sine [1/m], and k and b of the
        curve resistance [m].
    """
    start, _, sine, climb, curvature, bend, coefficient, offset = line.pieces(train.strip_length)
    tunnel = train.tunnel_coefficient(line.tunnel_cross_section(start))
    return np.ascontiguousarray(
        np.column_stack([start, sine, curvature, bend, tunnel, climb, coefficient, offset])
    )


def rail_table(maximum_adhesion: StepProfile) -> FloatArray:
    """Adhesion along the line: one row a step of the profile.

    The creep curve is that of `creep_coefficients`.

    Returns
    -------
    (n, 5) array
        Start [m], maximum adhesion, a and b [s/m], and the common factor of both exponentials.

    Raises
    ------
    InputError
        If an adhesion is not between 0 and 1.
    """
    peak = maximum_adhesion.values
    if np.any((peak <= 0.0) | (peak >= 1.0)):
        bad = int(np.argmax((peak <= 0.0) | (peak >= 1.0)))
        at = maximum_adhesion.positions[bad] / 1e3
        raise InputError(
            f"maximum adhesion {peak[bad]} at km {at:.3f} is not between 0 and 1",
            remedy="give values such as 0.2",
        )
    columns = [maximum_adhesion.positions, peak, *creep_coefficients(peak).T]
    return np.ascontiguousarray(np.column_stack(columns))


def curve_table(characteristic: AdhesionCharacteristic | None) -> FloatArray:
    """An adhesion characteristic relative to its maximum: one row a train speed.

    Returns
    -------
    (n, 3 + SLIPS) array
        As `dynamics.CURVE` lists; without rows where there is no characteristic.

    Raises
    ------
    InputError
        If the characteristic gives no adhesion.
    """
    width = len(CURVE) + SLIPS
    if characteristic is None:
        return np.empty((0, width))
    over_creepage = characteristic.variable == "creepage"
    speeds = CURVE_SPEEDS if characteristic.needs_speed else CURVE_SPEEDS[:1]
    slips = LEAST_SLIP * np.expm1(SLIP_STEP * np.arange(SLIPS))
    found = characteristic.adhesion_at(slips, speeds[:, None])
    peaks = found.max(axis=1, keepdims=True)
    if not np.all((peaks > 0.0) & np.isfinite(peaks)):
        raise InputError(
            "adhesion characteristic: has no maximum above 0",
            remedy="give a characteristic with adhesion above 0",
        )
    relative = found / peaks
    steepest = np.max(np.diff(relative, axis=1) / np.diff(slips), axis=1)
    units = speeds if over_creepage else np.ones(speeds.size)
    return np.ascontiguousarray(np.column_stack([speeds, units, steepest, relative]))
