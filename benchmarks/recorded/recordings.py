"""Simulated trips as recorders write them, and the defects that recorders have.

A recording is a table, a profile that reads it, and how it is written as text. A defect is a
function that spoils a sound recording; nothing in it comes from the rules that repair it.
"""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.formats.ttobench import read_track, read_train as read_published_train
from trainlog.railway import CurvatureProfile, Geometry, Line, Train
from trainlog.railway.geometry import from_plane
from trainlog.simulation import Run, Scenario, Sensors, draw_scenarios, drive, recorded
from trainlog.trip import Trip
from trainlog.units import KMH

SECOND = 1_000_000_000
SEED = 7

PAIRS = (
    ("St.Gallen-Wil", "FLIRT"),
    ("Stadelhofen-Altstetten", "KISS"),
    ("00_reference", "VIRM6"),
)
"""Line and train of the trips."""


def made_up_course(length: float) -> tuple[Geometry, CurvatureProfile]:
    """Bends of 1,500 m and straights: these lines are published without coordinates."""
    s = np.arange(0.0, length + 10.0, 10.0)
    curvature = np.clip(3.0 * np.sin(s / 600.0), -1.0, 1.0) / 1500.0
    heading = 0.3 + np.concatenate(([0.0], np.cumsum(curvature * 10.0)))
    middle = 0.5 * (heading[1:] + heading[:-1])
    points = np.concatenate(([0.0], np.cumsum(10.0 * np.exp(1j * middle))))[: s.size]
    latitude, longitude = from_plane(points, (47.0, 9.0))
    bends = CurvatureProfile(s[:-2], curvature[:-2], curvature[1:-1])
    return Geometry(s, latitude, longitude, "made up"), bends


@cache
def line_and_train(pair: int, published: Path) -> tuple[Line, Train]:
    """Line and train of a pair; all but the first from the TTOBench library."""
    if pair == 0:
        return read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    track, train = (
        ("CH_Stadelhofen_Altstetten", "CH_Stadler_KISS_SBB"),
        ("00_reference", "NL_Intercity_VIRM6"),
    )[pair - 1]
    line = read_track(published / "tracks" / f"{track}.json")
    geometry, curvatures = made_up_course(line.length)
    line = replace(line, geometry=geometry, curvatures=curvatures)
    return line, read_published_train(published / "trains" / f"{train}.json")


@cache
def driven(pair: int, published: Path) -> tuple[tuple[Scenario, Run, Trip], ...]:
    """A trip on dry rail and two stopping trips on wet rail, and what truly happened.

    They carry much: what takes the empty train for the loaded one is far off.
    """
    line, train = line_and_train(pair, published)
    found = []
    for number, share in ((0, 0.8), (2, 0.9), (3, 0.6)):
        scenario = draw_scenarios(line, train, 4, seed=SEED, sensors=Sensors())[number]
        load = share * (train.max_load or 0.2 * train.mass)
        scenario = replace(scenario, mass=train.mass + load)
        run = drive(scenario)
        found.append((scenario, run, recorded(scenario, run)))
    return tuple(found)


@dataclass
class Recording:
    """A recorder's file before it is written."""

    table: pd.DataFrame
    profile: dict[str, Any]
    rng: np.random.Generator
    trip: Trip
    lines: list[Callable[[list[str]], list[str]]] = field(default_factory=list)
    """What happens to the lines of text at last, the header first."""
    rate: float = 10.0
    clocks: tuple[float, ...] = (0.0,)
    """What the recorder's clock may be ahead by [s]: of two clocks either may be taken."""

    @property
    def axles(self) -> int:
        """How many axles are recorded."""
        return sum(name.startswith("axle_speed") for name in self.table.columns)

    def seconds(self) -> np.ndarray:
        """Since the first row [s]."""
        return (self.table["time"].to_numpy() - self.table["time"].iloc[0]) / SECOND

    def moving(self, length: float) -> tuple[int, int]:
        """Rows of a stretch of `length` [s] in which the train moves throughout."""
        rows = int(length * self.rate)
        still = np.concatenate(([0], np.cumsum(self.table["speed"].to_numpy() < 30.0)))
        free = np.flatnonzero(still[rows:] - still[:-rows] == 0)
        begin = int(self.rng.choice(free))
        return begin, begin + rows

    def written(self, path: Path) -> None:
        """Write the file."""
        table = self.table.copy()
        if "time" in table:
            stamps = pd.DatetimeIndex(table.pop("time").to_numpy().view("datetime64[ns]"))
            table.insert(0, "Time", stamps.strftime("%Y-%m-%dT%H:%M:%S.%f").str[:-3])
        text = table.to_csv(index=False, float_format="%.8g", lineterminator="\n")
        lines = text.splitlines()
        for change in self.lines:
            lines = change(lines)
        path.write_text("\n".join(lines) + "\n", "utf-8")


def recording(trip: Trip, load: float, seed: int) -> Recording:
    """A recorder that lacks nothing: odometry, efforts, axles and satellites at 10 Hz."""
    state, controls, axles = (trip[f"/train/{name}"] for name in ("state", "controls", "axles"))
    fix, motion = trip["/gnss/fix"], trip["/gnss/motion"]
    columns: dict[str, Any] = {
        "time": state.index.as_unit("ns").asi8,
        "distance": state["position"],
        "speed": state["speed"] * KMH,
        "traction": controls["tractive_effort"] / 1e3,
        "ebrake": controls["dynamic_braking_effort"] / 1e3,
        "airbrake": controls["pneumatic_braking_effort"] / 1e3,
    }
    count = sum(name.startswith("wheel_speed") for name in axles.columns)
    for i in range(1, count + 1):
        columns[f"axle_speed_{i}"] = axles[f"wheel_speed_{i}"] * KMH
        columns[f"axle_effort_{i}"] = axles[f"wheel_effort_{i}"] / 1e3
    table = pd.DataFrame({name: np.asarray(values) for name, values in columns.items()})
    rows = np.searchsorted(columns["time"], fix.index.as_unit("ns").asi8)
    for name, values in {
        "latitude": fix["latitude"],
        "longitude": fix["longitude"],
        "accuracy": fix["horizontal_accuracy"],
        "gnss_speed": motion["speed"] * KMH,
        "gnss_speed_accuracy": motion["speed_accuracy"],
    }.items():
        column = np.full(len(table), np.nan)
        column[rows] = values.to_numpy()
        table[name] = column
    profile = {
        "format": "trainlog/recorder-profile",
        "version": 1,
        "name": "vehicle recorder",
        "time": {"column": "Time"},
        "columns": {
            "/train/state.position": {"column": "distance", "unit": "m"},
            "/train/state.speed": {"column": "speed", "unit": "km/h"},
            "/train/controls.tractive_effort": {"column": "traction", "unit": "kN"},
            "/train/controls.dynamic_braking_effort": {"column": "ebrake", "unit": "kN"},
            "/train/controls.pneumatic_braking_effort": {"column": "airbrake", "unit": "kN"},
            "/train/axles.wheel_speed": {
                "columns": [f"axle_speed_{i}" for i in range(1, count + 1)],
                "unit": "km/h",
            },
            "/train/axles.wheel_effort": {
                "columns": [f"axle_effort_{i}" for i in range(1, count + 1)],
                "unit": "kN",
            },
            "/gnss/fix.latitude": {"column": "latitude", "unit": "deg"},
            "/gnss/fix.longitude": {"column": "longitude", "unit": "deg"},
            "/gnss/fix.horizontal_accuracy": {"column": "accuracy", "unit": "m"},
            "/gnss/motion.speed": {"column": "gnss_speed", "unit": "km/h"},
            "/gnss/motion.speed_accuracy": {"column": "gnss_speed_accuracy", "unit": "m/s"},
        },
        "trip": {
            "weather": trip.metadata["weather"],
            "direction": trip.metadata["direction"],
            "load": {"value": round(load), "unit": "kg"},
        },
    }
    return Recording(table, profile, np.random.default_rng(seed), trip)


Defect = Callable[[Recording], Recording]
DEFECTS: dict[str, Defect] = {}
"""By the words of the table that is printed."""


def defect(words: str) -> Callable[[Defect], Defect]:
    def named(function: Defect) -> Defect:
        DEFECTS[words] = function
        return function

    return named


@defect("none")
def clean(made: Recording) -> Recording:
    return made


# How the file is written


@defect("header with five empty cells more")
def trailing_cells(made: Recording) -> Recording:
    made.lines.append(lambda lines: [lines[0] + ",,,,,", *lines[1:]])
    return made


@defect("rows end at their last value")
def short_rows(made: Recording) -> Recording:
    made.lines.append(lambda lines: [lines[0], *(line.rstrip(",") for line in lines[1:])])
    return made


# Values that freeze


def frozen(made: Recording, columns: list[str], length: float) -> Recording:
    begin, end = made.moving(length)
    for name in columns:
        column = made.table[name].to_numpy(copy=True)
        known = column[:begin][np.isfinite(column[:begin])]
        present = np.isfinite(column[begin:end])
        column[begin:end][present] = known[-1]
        made.table[name] = column
    return made


@defect("speed frozen for 60 s")
def frozen_speed(made: Recording) -> Recording:
    return frozen(made, ["speed"], 60.0)


@defect("satellite speed frozen for 90 s")
def frozen_satellite_speed(made: Recording) -> Recording:
    return frozen(made, ["gnss_speed"], 90.0)


@defect("satellite position frozen for 90 s")
def frozen_position(made: Recording) -> Recording:
    return frozen(made, ["latitude", "longitude"], 90.0)


@defect("speed of axle 1 frozen for 60 s")
def frozen_axle(made: Recording) -> Recording:
    return frozen(made, ["axle_speed_1"], 60.0)


@defect("tractive effort frozen for 60 s")
def frozen_effort(made: Recording) -> Recording:
    return frozen(made, ["traction"], 60.0)


# Clocks


def stepped(made: Recording, seconds: float, *, whole: bool) -> Recording:
    time = made.table["time"].to_numpy(copy=True)
    begin, _ = made.moving(60.0)
    made.clocks = (0.0, seconds)
    time[begin:] += round(seconds * SECOND)
    if whole:
        time = time // SECOND * SECOND
    made.table["time"] = time
    return made


@defect("clock set back by 2 s")
def step_back(made: Recording) -> Recording:
    return stepped(made, -2.0, whole=False)


@defect("clock set back by 2 s, whole seconds")
def step_back_whole(made: Recording) -> Recording:
    return stepped(made, -2.0, whole=True)


@defect("clock set on by 18 s")
def step_on(made: Recording) -> Recording:
    return stepped(made, 18.0, whole=False)


@defect("clock set on by 18 s, whole seconds")
def step_on_whole(made: Recording) -> Recording:
    return stepped(made, 18.0, whole=True)


@defect("date 2000-00-00 for the first 5 min")
def no_date(made: Recording) -> Recording:
    rows = int(300.0 * made.rate)

    def spoilt(lines: list[str]) -> list[str]:
        return [
            "2000-00-00" + line[10:] if 0 < number <= rows else line
            for number, line in enumerate(lines)
        ]

    made.lines.append(spoilt)
    return made


@defect("dates 1024 weeks early")
def rollover(made: Recording) -> Recording:
    made.table["time"] -= 1024 * 7 * 86_400 * SECOND
    made.clocks = (0.0, -1024.0 * 7.0 * 86_400.0)
    return made


# Counters


@defect("distance starts anew at 0")
def restarted(made: Recording) -> Recording:
    begin, _ = made.moving(60.0)
    distance = made.table["distance"].to_numpy(copy=True)
    distance[begin:] -= distance[begin]
    made.table["distance"] = distance
    return made


@defect("distance wraps at 6,553.6 m")
def wrapped_short(made: Recording) -> Recording:
    made.table["distance"] = made.table["distance"].clip(lower=0.0) % 6553.6
    return made


@defect("distance wraps at 10 km")
def wrapped(made: Recording) -> Recording:
    made.table["distance"] = made.table["distance"].clip(lower=0.0) % 10_000.0
    return made


# Satellites


def jump(made: Recording, size: float, rows: int, times: int) -> Recording:
    metre = np.degrees(1.0 / 6_371_000.0)
    known = np.flatnonzero(np.isfinite(made.table["latitude"]))
    latitude, accuracy = (made.table[n].to_numpy(copy=True) for n in ("latitude", "accuracy"))
    for begin in made.rng.choice(known.size - rows, times, replace=False):
        places = known[begin : begin + rows]
        latitude[places] += size * metre
        accuracy[places] = 3.0 * size
    made.table["latitude"], made.table["accuracy"] = latitude, accuracy
    return made


@defect("10 fixes 234 m beside the line")
def jumps(made: Recording) -> Recording:
    return jump(made, 234.0, 1, 10)


@defect("5 bursts of 2 s, 60 m beside the line")
def bursts(made: Recording) -> Recording:
    return jump(made, 60.0, 10, 5)


@defect("fixes reckoned on for 40 s, then none for 2 min")
def dead_reckoned(made: Recording) -> Recording:
    begin, end = made.moving(40.0)
    table = made.table
    known = np.flatnonzero(np.isfinite(table["latitude"]))
    before = known[known < begin][-10:]
    seconds = made.seconds()
    for name in ("latitude", "longitude"):
        column = table[name].to_numpy(copy=True)
        rate = (column[before[-1]] - column[before[0]]) / (seconds[before[-1]] - seconds[before[0]])
        rows = known[(known >= begin) & (known < end)]
        column[rows] = column[before[-1]] + rate * (seconds[rows] - seconds[before[-1]])
        column[end : end + int(120.0 * made.rate)] = np.nan
        table[name] = column
    for name in ("gnss_speed", "accuracy", "gnss_speed_accuracy"):
        column = table[name].to_numpy(copy=True)
        column[end : end + int(120.0 * made.rate)] = np.nan
        table[name] = column
    return made


@defect("stated accuracies a quarter of the true ones")
def optimistic(made: Recording) -> Recording:
    made.table["accuracy"] /= 4.0
    made.table["gnss_speed_accuracy"] /= 4.0
    return made


def satellites_only(made: Recording) -> Recording:
    made.profile["columns"] = {
        name: column
        for name, column in made.profile["columns"].items()
        if name.startswith("/gnss/")
    }
    made.table = made.table[
        ["time", *(column["column"] for column in made.profile["columns"].values())]
    ]
    made.table = made.table[np.isfinite(made.table["latitude"])].reset_index(drop=True)
    made.rate = 5.0
    return made


@defect("satellites alone, 5 Hz")
def satellites(made: Recording) -> Recording:
    return satellites_only(made)


@defect("phone: 1 Hz, speeds 3 s old, errors that last")
def phone(made: Recording) -> Recording:
    made = satellites_only(made)
    made.table = made.table.iloc[::5].reset_index(drop=True)
    made.rate = 1.0
    table, rng = made.table, made.rng
    metre = np.degrees(1.0 / 6_371_000.0)
    memory, size = np.exp(-1.0 / 90.0), 8.0
    for name in ("latitude", "longitude"):
        error = rng.standard_t(4, len(table)) * size / np.sqrt(2.0)
        error[1:] *= np.sqrt(1.0 - memory**2)
        for k in range(1, error.size):
            error[k] += memory * error[k - 1]
        table[name] += metre * error
    table["gnss_speed"] = table["gnss_speed"].shift(3).bfill()
    table["accuracy"] = 4.0
    table["gnss_speed_accuracy"] = 0.3
    return made


# What a recorder lacks


def dropped(made: Recording, fields: tuple[str, ...]) -> Recording:
    made.profile["columns"] = {
        name: column for name, column in made.profile["columns"].items() if name not in fields
    }
    return made


@defect("load unknown")
def no_load(made: Recording) -> Recording:
    del made.profile["trip"]["load"]
    return made


@defect("axle efforts empty")
def no_axle_efforts(made: Recording) -> Recording:
    for i in range(1, made.axles + 1):
        made.table[f"axle_effort_{i}"] = np.nan
    return made


@defect("axle efforts zero")
def zero_axle_efforts(made: Recording) -> Recording:
    for i in range(1, made.axles + 1):
        made.table[f"axle_effort_{i}"] = 0.0
    return made


@defect("only total efforts, no axle's")
def total_effort(made: Recording) -> Recording:
    return dropped(made, ("/train/axles.wheel_effort",))


@defect("no pneumatic braking effort")
def no_pneumatic(made: Recording) -> Recording:
    return dropped(made, ("/train/controls.pneumatic_braking_effort",))


@defect("no distance")
def no_distance(made: Recording) -> Recording:
    return dropped(made, ("/train/state.position",))


@defect("no satellites")
def no_satellites(made: Recording) -> Recording:
    return dropped(made, tuple(n for n in made.profile["columns"] if n.startswith("/gnss/")))


EFFORTS = ("traction", "ebrake", "airbrake")


def late(made: Recording, delay: float) -> Recording:
    seconds = made.seconds()
    for name in made.table.columns:
        if name in EFFORTS or name.startswith("axle_effort"):
            made.table[name] = np.interp(seconds - delay, seconds, made.table[name])
    return made


def scaled(made: Recording, gain: float, *, total: bool = True) -> Recording:
    for name in made.table.columns:
        if (name in EFFORTS and total) or name.startswith("axle_effort"):
            made.table[name] *= gain
    return made


@defect("efforts 0.2 s late")
def late_short(made: Recording) -> Recording:
    return late(made, 0.2)


@defect("efforts 0.5 s late")
def late_long(made: Recording) -> Recording:
    return late(made, 0.5)


@defect("efforts 10 % too high")
def gain(made: Recording) -> Recording:
    return scaled(made, 1.1)


@defect("efforts 10 % too high, 0.3 s late, load unknown")
def gain_late(made: Recording) -> Recording:
    return no_load(late(scaled(made, 1.1), 0.3))


@defect("axle efforts 0.8 times the total")
def contradicting(made: Recording) -> Recording:
    return scaled(made, 0.8, total=False)


@defect("one axle speed a bogie")
def one_a_bogie(made: Recording) -> Recording:
    columns = made.profile["columns"]
    for name in ("wheel_speed", "wheel_effort"):
        column = columns[f"/train/axles.{name}"]
        column["columns"] = [
            each if number % 2 == 0 else "" for number, each in enumerate(column["columns"])
        ]
    return made


def slower(made: Recording, every: int) -> Recording:
    made.table = made.table.iloc[::every].reset_index(drop=True)
    made.rate /= every
    return made


@defect("1.7 Hz")
def two_hertz(made: Recording) -> Recording:
    return slower(made, 6)


@defect("1 Hz")
def one_hertz(made: Recording) -> Recording:
    return slower(made, 10)


@defect("1 Hz, satellites' values held for 0.5 s")
def held_hertz(made: Recording) -> Recording:
    satellites = [n for n in made.table if n.startswith(("gnss", "latitude", "longitude", "accu"))]
    made.table[satellites] = made.table[satellites].shift(5).ffill(limit=4)
    return slower(made, 10)


@defect("noise of wheel speeds 0.3 m/s")
def noisy_wheels(made: Recording) -> Recording:
    for name in made.table.columns:
        if name.startswith("axle_speed"):
            speed = made.table[name].to_numpy()
            noise = 0.3 * KMH * made.rng.standard_normal(speed.size)
            made.table[name] = np.where(speed > 0.0, np.maximum(speed + noise, 0.0), 0.0)
    return made


@defect("wheels 1.5 % too large, axle 2 3 %")
def worn(made: Recording) -> Recording:
    for name in made.table.columns:
        if name.startswith("axle_speed") or name == "speed":
            made.table[name] *= 0.97 if name == "axle_speed_2" else 0.985
    return made


@defect("speed in whole km/h, efforts in whole kN")
def coarse(made: Recording) -> Recording:
    for name in made.table.columns:
        if name.startswith("axle_") or name in ("speed", *EFFORTS):
            made.table[name] = made.table[name].round()
    return made


def spoilt(words: str, trip: Trip, load: float, seed: int) -> Recording:
    """The recording of a trip with a defect."""
    made = recording(trip, load, seed)
    made.profile = deepcopy(made.profile)
    return DEFECTS[words](made)
