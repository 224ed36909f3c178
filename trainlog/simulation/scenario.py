"""Scenarios: who drives what, where, in which weather; and the trips that come of them."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
import pandas as pd

from trainlog.arrays import FloatArray
from trainlog.display import as_text, counted
from trainlog.errors import InputError
from trainlog.formats.characteristic import characteristic_content
from trainlog.formats.railway import line_to_bytes, train_to_bytes
from trainlog.railway import Line, RunningResistance, StepProfile, Train, Trajectory
from trainlog.railway.adhesion import AdhesionCharacteristic
from trainlog.simulation.drivers import Driver, Habits, Observation, Stop, TimetableDriver, plan
from trainlog.simulation.plant import Plant
from trainlog.simulation.rail import HOUR, Rail, RailState, base_map, trip_profile
from trainlog.simulation.sensors import Instruments, Reading, Sensors, wheel_scales
from trainlog.simulation.traction import TractionLoop, TractionMaker
from trainlog.units import DAY, MINUTE, NANOSECONDS

START = pd.Timestamp("2024-10-07T06:00:00Z").value
"""When the first of several drawn trips begins [ns since 1970 UTC]."""

LARGEST_LOAD = 20_000.0
"""Of a train whose file states none [kg]."""

RAIL_CLEANING = (0.97, 0.99, 1.01, 1.03)
"""Adhesion of the powered axles from front to rear: each cleans the rail for the next."""

SURVEY_ERROR = 0.1e-3
"""Standard deviation of a line file's gradients, from element to element."""

SURVEYED_LENGTH = (500.0, 3000.0)
"""Lengths [m] over which one error of a gradient holds on elements longer than these: the heights
at their ends are known, so that a small error does not add up over a whole line."""

FIRST_DEPARTURE, LAST_DEPARTURE = 5 * HOUR, 23 * HOUR
"""Of the trains of a day [ns since its midnight]."""

Locator = Callable[[Reading], Observation]
"""From a reading of the train's instruments to what its driver knows."""


@dataclass(frozen=True, eq=False)
class Scenario:
    """Everything that determines a simulated trip.

    Attributes
    ----------
    name : str
    line : Line
        In its own direction.
    train : Train
        As its file says; what the train truly is on this trip follows.
    direction : {"forward", "reverse"}
    weather : str
        The rail's condition: ``"dry"``, ``"wet"``, ``"leaves"`` ...
    mass : float [kg]
        Loaded, without the rotating part.
    rotating_mass : float [kg]
    resistance : RunningResistance
    max_power : float [W]
    maximum_adhesion : StepProfile
        Along the line in its own direction.
    characteristic : AdhesionCharacteristic or None
        Shape of the adhesion over slip, see `Plant.of`; None: that of Zhao et al. (2025).
    survey_error : StepProfile or None
        True gradient less that of the line's file, along the line in its own direction.
    stops : tuple of Stop
        Positions in the direction of travel; ignored when a trajectory is followed.
    habits : Habits
    sensors : Sensors
    seed : int
        Of the sensors' noise.
    start : int [ns since 1970 UTC]
    temperature : float [K]
    trajectory : Trajectory or None
        To follow instead of the timetable.
    row : int
        The trajectory's configuration that the train is in.
    follows : callable or None
        Makes the driver who follows the trajectory.
    locates : callable or None
        Makes the locator that gives that driver place and speed, from the train's sensors and the
        place where it starts; None: he sees the true motion.
    traction : callable or None
        Makes the traction control; None: the plant's own slip protection.
    state : RailState or None
        What lasts and what passes of `maximum_adhesion`, where it is drawn over days.

    Examples
    --------
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> scenario = draw_scenarios(line, train, 1, seed=3)[0]
    >>> scenario.mass >= train.mass, scenario.direction
    (True, 'forward')
    """

    name: str
    line: Line
    train: Train
    direction: str
    weather: str
    mass: float
    rotating_mass: float
    resistance: RunningResistance
    max_power: float
    maximum_adhesion: StepProfile
    survey_error: StepProfile | None = None
    stops: tuple[Stop, ...] = ()
    habits: Habits = field(default_factory=Habits)
    sensors: Sensors = field(default_factory=Sensors)
    seed: int = 0
    start: int = START
    temperature: float = 285.0
    trajectory: Trajectory | None = None
    row: int = 0
    follows: Callable[[], Driver] | None = None
    locates: Callable[[Sensors, float], Locator] | None = None
    traction: TractionMaker | None = None
    state: RailState | None = None
    characteristic: AdhesionCharacteristic | None = None

    def __repr__(self) -> str:
        rows = {
            "train": f"{self.train.name}, {self.mass / 1e3:.1f} t, {self.max_power / 1e3:.0f} kW",
            "line": f"{self.line.name}, {self.direction}, {self.weather} rail",
            "driver": "follows a trajectory"
            if self.trajectory is not None
            else f"keeps a timetable with {counted(len(self.stops), 'stop')}",
            "seed": f"{self.seed}",
        }
        return as_text(f"Scenario '{self.name}'", rows)

    def __post_init__(self) -> None:
        if self.direction not in ("forward", "reverse"):
            raise InputError(
                f"scenario '{self.name}': direction '{self.direction}' is unknown",
                remedy="give 'forward' or 'reverse'",
            )
        if (self.trajectory is None) != (self.follows is None):
            raise InputError(
                f"scenario '{self.name}': a trajectory and the driver who follows it go together",
                remedy="give both or none",
            )

    @property
    def load(self) -> float:
        """Mass above that of the empty train [kg]."""
        return self.mass - self.train.mass

    @property
    def travelled(self) -> Line:
        """The line in the direction of travel."""
        return self.line.travelled(self.direction)

    @property
    def rail(self) -> StepProfile:
        """Maximum adhesion in the direction of travel."""
        if self.direction == "forward":
            return self.maximum_adhesion
        return self.maximum_adhesion.reversed(self.line.length)

    @property
    def ground(self) -> Line:
        """The line in the direction of travel as it truly lies."""
        if self.survey_error is None:
            return self.travelled
        positions = np.union1d(self.line.gradients.positions, self.survey_error.positions)
        gradients = self.line.gradients(positions) + self.survey_error(positions)
        true = replace(self.line, gradients=StepProfile(positions, gradients))
        return true.travelled(self.direction)

    def plant(self) -> Plant:
        """The train on its line."""
        return self.plant_of(self.train)

    def plant_of(self, train: Train) -> Plant:
        """A train on the scenario's line, with all that the scenario states of its own."""
        count = train.axles.count
        cleaning = np.interp(
            np.linspace(0.0, 1.0, count), np.linspace(0.0, 1.0, 4), np.array(RAIL_CLEANING)
        )
        return Plant.of(
            self.ground,
            train,
            mass=self.mass,
            rotating_mass=self.rotating_mass,
            resistance=self.resistance,
            max_power=self.max_power,
            maximum_adhesion=self.rail,
            characteristic=self.characteristic,
            axle_adhesion=cleaning if count > 1 else None,
        )

    def traction_loop(self, plant: Plant) -> TractionLoop | None:
        """The traction control on a plant; None: the plant's own slip protection."""
        if self.traction is None:
            return None
        return TractionLoop(self.traction(), plant, seed=self.seed)

    def driver(self) -> Driver:
        """Who drives."""
        if self.follows is not None:
            return self.follows()
        return TimetableDriver(self.travelled, self.train, self.stops, self.habits, self.mass)

    def driver_observation(self, start: float) -> Callable[[Observation], Observation]:
        """What its driver sees of the true motion of a train that starts at `start` [m]."""
        if self.locates is None:
            return lambda motion: motion
        generator = np.random.default_rng(self.seed)
        # The recorder's generator begins with the wheels, too: they are the same.
        scale, _ = wheel_scales(self.train.axles.count, self.sensors, generator)
        instruments = Instruments(self.travelled, self.sensors, start, scale, generator)
        locator = self.locates(self.sensors, start)
        return lambda motion: locator(
            instruments.read(motion.time, motion.position, motion.speed, motion.acceleration)
        )

    def metadata(self) -> dict[str, str]:
        """What the log states besides what every simulated trip's does."""
        return {}

    def files(self) -> tuple[bytes, bytes]:
        """The files of line and train that the log carries."""
        return line_to_bytes(self.line), train_to_bytes(self.train)

    def truth(self) -> bytes:
        """The scenario as JSON: what estimators must not see and tests judge them by."""
        content: dict[str, Any] = {
            "format": "trainlog/scenario",
            "version": 1,
            "name": self.name,
            "line": self.line.name,
            "train": self.train.name,
            "direction": self.direction,
            "weather": self.weather,
            "seed": self.seed,
            "mass": self.mass,
            "load": self.load,
            "rotating_mass": self.rotating_mass,
            **self.resistance.terms,
            "max_power": self.max_power,
            "maximum_adhesion": _as_json(self.maximum_adhesion),
            "survey_error": None if self.survey_error is None else _as_json(self.survey_error),
            "stops": [asdict(stop) for stop in self.stops],
            "habits": asdict(self.habits),
            "sensors": self.sensors.known(),
        }
        if self.characteristic is not None:
            content["characteristic"] = characteristic_content(self.characteristic)
        if self.trajectory is not None:
            content["configuration"] = self.trajectory.configurations[self.row].name
        if self.state is not None:
            content["lasting_adhesion"] = _as_json(self.state.lasting)
            content["conditions"] = self.state.weather.known()
            content["spots"] = self.state.spots.to_dict("records")
        return (json.dumps(content, indent=1, ensure_ascii=False) + "\n").encode()


def _as_json(profile: StepProfile) -> dict[str, Any]:
    """A profile along the line in its own direction, for JSON."""
    arrays = {"positions": profile.positions, "values": profile.values}
    return {"direction": "forward"} | {name: array.tolist() for name, array in arrays.items()}


def draw_scenarios(
    line: Line,
    train: Train,
    count: int = 12,
    seed: int = 1,
    sensors: Sensors | None = None,
) -> list[Scenario]:
    """Draw trips of one train over one line, in both directions and in dry and wet weather.

    Load, running resistance, power, driver and timetable vary from trip to trip; the slippery
    places of the line stay.

    Parameters
    ----------
    line : Line
    train : Train
        Without a stated largest load, up to 20 t are loaded.
    count : int
    seed : int
        The same seed draws the same trips.
    sensors : Sensors, optional

    Raises
    ------
    InputError
        If `count` is not positive or the line has no two stations.

    Examples
    --------
    >>> from trainlog.formats.railway import read_line
    >>> from trainlog.formats.railway import read_train
    >>> line = read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> [(each.direction, each.weather) for each in draw_scenarios(line, train, 3)]
    [('forward', 'dry'), ('reverse', 'dry'), ('forward', 'wet')]
    """
    if count < 1:
        raise InputError(f"cannot draw {count} scenarios", remedy="give a count of 1 or more")
    _check(line, [train])
    sensors = sensors or Sensors()
    bases = {weather: base_map(line, weather, seed) for weather in ("dry", "wet")}
    survey = survey_error(line, seed)
    scenarios = []
    for number in range(count):
        weather = ("dry", "dry", "wet", "wet")[number % 4]
        rail = partial(trip_profile, line, bases[weather], weather)
        own = np.random.default_rng([seed, 3, number])
        drawn = _drawn(line, train, number, weather, rail, own)
        scenarios.append(replace(drawn, survey_error=survey, sensors=sensors))
    return scenarios


def draw_days(
    rail: Rail,
    trains: Sequence[Train],
    trips_a_day: int = 4,
    seed: int | None = None,
    sensors: Sensors | None = None,
) -> list[Scenario]:
    """Draw the trips of every day that a rail lasts, from 5:00 to 23:00.

    The trains take turns, in both directions. What they meet is the rail at the time of their
    departure: the weather and the spots of that hour.

    Parameters
    ----------
    rail : Rail
    trains : sequence of Train
    trips_a_day : int
        Departures are evenly spaced, but for a few minutes.
    seed : int, optional
        Of loads, drivers and timetables; default: the rail's.
    sensors : Sensors, optional

    Raises
    ------
    InputError
        If a train has no brake, the line no two stations, or there are no trips or no trains.

    Examples
    --------
    >>> import trainlog
    >>> from trainlog.simulation.rail import Rail
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> rail = Rail.draw(line, days=3, start="2026-10-01", seed=1)
    >>> trips = draw_days(rail, [train], trips_a_day=2)
    >>> [trip.name for trip in trips[:3]]
    ['2026-10-01-0504', '2026-10-01-2300', '2026-10-02-0500']
    """
    if trips_a_day < 1 or not trains:
        raise InputError(
            f"cannot draw {trips_a_day} trips a day of {counted(len(trains), 'train')}",
            remedy="give 1 trip and 1 train or more",
        )
    line = rail.line
    _check(line, trains)
    seed = rail.seed if seed is None else seed
    survey = survey_error(line, seed)
    scenarios = []
    for number in range(rail.days * trips_a_day):
        own = np.random.default_rng([seed, 17, number])
        start = _departure(rail.start, number, trips_a_day, own)
        state, profile = rail.state(start), rail.profile(start, number)
        # Trains take turns, and each goes in both directions.
        train = trains[(number // 2) % len(trains)]

        def met(_: np.random.Generator, profile: StepProfile = profile) -> StepProfile:
            return profile

        drawn = _drawn(line, train, number, state.weather.condition, met, own)
        scenarios.append(
            replace(
                drawn,
                name=f"{pd.Timestamp(start):%Y-%m-%d-%H%M}",
                survey_error=survey,
                sensors=sensors or Sensors(),
                start=start,
                temperature=state.weather.temperature,
                state=state,
            )
        )
    return scenarios


def _departure(first: int, number: int, trips_a_day: int, generator: np.random.Generator) -> int:
    """When trip `number` begins [ns since 1970 UTC], on a whole minute."""
    day, turn = divmod(number, trips_a_day)
    headway = (LAST_DEPARTURE - FIRST_DEPARTURE) / max(trips_a_day - 1, 1)
    jitter = generator.uniform(-1.0, 1.0) * min(10 * MINUTE, 0.3 * headway)
    since = np.clip(FIRST_DEPARTURE + turn * headway + jitter, FIRST_DEPARTURE, LAST_DEPARTURE)
    return first + day * DAY + MINUTE * round(float(since) / MINUTE)


def _check(line: Line, trains: Sequence[Train], fewest: int = 2) -> None:
    """Refuse a line with too few stations, and trains that could never stop."""
    if len(line.stations) < fewest:
        raise InputError(
            f"line '{line.name}' has fewer than two stations",
            remedy="give the line two stations or more",
        )
    for train in trains:
        if not train.max_braking_effort > 0.0:
            raise InputError(
                f"train '{train.name}' has no brake: its braking efforts are all 0",
                remedy="give the efforts of its dynamic or its friction brake",
            )


def survey_error(line: Line, seed: int) -> StepProfile:
    """What the line's file says wrongly of its gradients, for all trips.

    One error an element; longer elements are cut at random into `SURVEYED_LENGTH`.
    """
    generator = np.random.default_rng([seed, 5])
    edges = line.gradients.positions
    errors = SURVEY_ERROR * generator.standard_normal(edges.size)
    positions: list[FloatArray] = []
    values: list[FloatArray] = []
    for start, end, error in zip(edges, np.append(edges[1:], line.length), errors, strict=True):
        positions.append(np.array([start]))
        values.append(np.array([error]))
        if end - start > SURVEYED_LENGTH[1]:
            steps = generator.uniform(*SURVEYED_LENGTH, int((end - start) / SURVEYED_LENGTH[0]))
            cuts = start + np.cumsum(steps)
            cuts = cuts[cuts < end]
            positions.append(cuts)
            values.append(SURVEY_ERROR * generator.standard_normal(cuts.size))
    return StepProfile(np.concatenate(positions), np.concatenate(values))


def _drawn(
    line: Line,
    train: Train,
    number: int,
    weather: str,
    rail: Callable[[np.random.Generator], StepProfile],
    generator: np.random.Generator,
) -> Scenario:
    """Trip `number` of a series, in a rail condition."""
    direction = "forward" if number % 2 == 0 else "reverse"
    travelled = line.travelled(direction)
    scale = 1.0 + np.clip(0.07 * generator.standard_normal(3), -0.15, 0.15)
    nominal = train.resistance
    load = np.round(generator.uniform(0.0, train.max_load or LARGEST_LOAD), -2)
    # Trains that run through and trains that call, in both directions and in any weather.
    calling = (number // 4 + number // 2) % 2 == 1
    stations = travelled.stations[1:-1] if calling else ()
    kept = generator.uniform(size=len(stations)) < generator.choice([0.7, 1.0])
    calls = [station for station, stop in zip(stations, kept, strict=True) if stop]
    habits = drawn_habits(generator, wet=weather != "dry")
    return Scenario(
        name=f"trip-{number + 1:02d}",
        line=line,
        train=train,
        direction=direction,
        weather=weather,
        mass=train.mass + float(load),
        rotating_mass=train.rotating_mass,
        resistance=nominal.scaled(*scale),
        max_power=train.max_traction_power * float(generator.uniform(0.92, 1.0)),
        maximum_adhesion=rail(generator),
        stops=plan(
            travelled,
            train,
            (travelled.stations[0], *calls, travelled.stations[-1]),
            reserve=float(generator.uniform(0.08, 0.13)),
        ),
        habits=habits,
        seed=int(generator.integers(2**31)),
        start=START + number * 3600 * NANOSECONDS,
        temperature=float(np.round(generator.uniform(278.0, 288.0), 1)),
    )


def drawn_habits(generator: np.random.Generator, wet: bool) -> Habits:
    """A driver, more careful on any rail that is not dry."""
    return Habits(
        lever=min(1.0, float(generator.uniform(0.45, 0.8) if wet else generator.uniform(0.7, 1.2))),
        lever_rate=float(generator.uniform(0.15, 0.35)),
        margin=float(generator.uniform(0.4, 1.2)),
        deceleration=float(generator.uniform(0.5, 0.65) if wet else generator.uniform(0.55, 0.8)),
        reaction=float(generator.uniform(0.6, 1.1)),
        coasting=float(generator.uniform(1.5, 4.0)),
        coasting_spacing=float(generator.uniform(2500.0, 6000.0)),
        dwell=float(generator.uniform(25.0, 40.0)),
    )


def trajectory_scenarios(
    trajectory: Trajectory,
    line: Line,
    train: Train,
    names: Iterable[str],
    follows: Callable[[], Driver],
    seed: int = 1,
    *,
    weather: str = "dry",
    locates: Callable[[Sensors, float], Locator] | None = None,
) -> list[Scenario]:
    """Scenarios in which trains in certain configurations follow a trajectory.

    Parameters
    ----------
    trajectory : Trajectory
    line : Line
        In its own direction.
    train : Train
    names : iterable of str
        Configurations of the trajectory.
    follows : callable
        Makes the driver of each trip.
    seed : int
    weather : {"dry", "wet"}
    locates : callable, optional
        See `Scenario`.

    Raises
    ------
    InputError
        If the trajectory has no such configuration or leaves the line.

    Examples
    --------
    >>> import numpy as np
    >>> import trainlog
    >>> line = trainlog.read_line("sample_logs/CH_StGallen_Wil.line.json")
    >>> train = trainlog.read_train("sample_logs/CH_Stadler_FLIRT_TPF.train.json")
    >>> nominal = trainlog.Configuration.of(train)
    >>> trajectory = trainlog.Trajectory(
    ...     line.name, train.name, np.array([0.0, 500.0, 1000.0]), (nominal,),
    ...     np.array([[0.0, 20.0, 0.0]]), np.array([[0.0, 50.0, 100.0]]),
    ...     np.array([53e3, 0.0]), np.array([[0.0, 53e3]]), 100.0,
    ... )
    >>> from analysis.control.follow import Follower
    >>> driver = lambda: Follower(trajectory, line, train)
    >>> driven = trajectory_scenarios(trajectory, line, train, ["nominal"], driver)
    >>> [each.name for each in driven]
    ['driven-nominal']
    """
    trajectory.check_run(line, train)
    _check(line, [train], fewest=0)
    base, survey = base_map(line, weather, seed), survey_error(line, seed)
    scenarios = []
    for number, name in enumerate(names):
        row = trajectory.index_of(name)
        configuration = trajectory.configurations[row]
        generator = np.random.default_rng([seed, 4, number])
        scenarios.append(
            Scenario(
                name=f"driven-{name}",
                line=line,
                train=train,
                direction=trajectory.direction,
                weather=weather,
                mass=configuration.mass,
                rotating_mass=configuration.rotating_mass,
                resistance=configuration.resistance,
                max_power=configuration.max_power,
                maximum_adhesion=trip_profile(line, base, weather, generator),
                survey_error=survey,
                seed=int(generator.integers(2**31)),
                start=START + (24 + number) * 3600 * NANOSECONDS,
                trajectory=trajectory,
                row=row,
                follows=follows,
                locates=locates,
            )
        )
    return scenarios
