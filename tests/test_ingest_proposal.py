"""Profiles proposed for tables of unknown layouts: what they read must be what was recorded."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from contents import put
from refusals import refused
from simulated_line import KMH, flirt, hilly_line
from typer.testing import CliRunner

from trainlog.cli.main import app
from trainlog.errors import InputError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.ingest import NO_TIME, Proposal, ingest, propose_profile
from trainlog.ingest.tabular import read_delimited
from trainlog.railway import Axles, LineReference, RunningResistance, Train
from trainlog.simulation import draw_scenarios, simulate
from trainlog.trip import Trip

NAMES = """
time: Time, Timestamp, Date/Time, time | Zeit, Zeitstempel, Datum/Zeit | Horodatage, Date et heure
date: Date | Datum | Date
clock: Time, Time of day | Uhrzeit, Zeit | Heure
elapsed: t, Elapsed, Time | t, Laufzeit, Zeit | t, Temps
parts: Year, Month, Day, Hour, Minute, Second | Jahr, Monat, Tag, Stunde, Minute, Sekunde | \
Année, Mois, Jour, Heure, Minute, Seconde
speed: Speed, v, Velocity, v_act | Geschwindigkeit, V_Ist, Geschw., v Zug | Vitesse, v, Vit.
position: Distance, Odometer, Chainage, s | Weg, km, Kilometrierung | PK, Distance parcourue
traction: Tractive effort, F_traction, TE | Zugkraft, F_Zug, Z | Effort de traction, F_traction
signed: Traction/braking effort, Effort, F | Zug-/Bremskraft, F, Kraft | Effort, Effort à la jante
dynamic: Electric brake effort, F_ebrake | E-Bremskraft, F_ED | Freinage électrique, Frein élec.
pneumatic: Air brake effort, F_airbrake | Druckluftbremskraft, F_pn | Frein pneumatique
lever: Lever, Throttle handle | Fahrhebel, Fahrschalter | Manipulateur, Manip. traction
wheel: Axle {} speed, v_axle{} | v Achse {}, v_Rad{} | Vitesse essieu {}, v_essieu{}
turns: n{}, RPM_{} | Drehzahl {}, Radsatzdrehzahl {} | Rotation essieu {}, Régime essieu {}
latitude: lat, GPS latitude | Breite, lat | Latitude, lat
longitude: lon, GPS longitude | Länge, lon | Longitude, lon
altitude: alt, Elevation | Höhe, Höhe ü. M. | Altitude, alt
gnss_speed: GPS speed, Speed (GNSS) | GPS-Geschwindigkeit, v_GPS | Vitesse GPS
limit: Speed limit, v_max | Vmax, v zulässig | Vitesse limite, V max
set: Set speed, v_target | V_Soll, Sollgeschwindigkeit | Vitesse de consigne
temperature: Motor temperature | Trafotemperatur | Température moteur
door_state: DoorsOpen, Door_state | Türzustand | État portes
voltage: Line voltage, U_line | Fahrdrahtspannung, U_FD | Tension caténaire
number: Train number, Record id | Zugnummer, Zähler | Compteur
pressure: Brake pipe pressure, BP | Druck HLL | Pression CG
current: Motor current 1 | Strom FM1, Oberstrom | Courant moteur 1
demand: Traction demand, F_setpoint | Sollzugkraft | Consigne d'effort
remaining: Remaining way (distance) | Restweg, Restdistanz | Distance restante
mean: Average speed | Durchschnittsgeschwindigkeit | Vitesse moyenne
rate: Acceleration, a | Beschleunigung, a | Accélération
"""
"""What recorders call a quantity, in English, German and French."""

WORDS = {
    (language, key): each.split(", ")
    for key, _, names in (row.partition(": ") for row in NAMES.strip().splitlines())
    for language, each in zip(("en", "de", "fr"), names.split(" | "), strict=True)
}
TURNS = {"en": "rpm", "de": "1/min", "fr": "tr/min"}
SIZES = {"km/h": 3.6, "m/s": 1.0, "mph": 3.6 / 1.609344, "kn": 3.6 / 1.852} | {
    "m": 1.0, "km": 1e-3, "mi": 1.0 / 1609.344, "kN": 1e-3, "N": 1.0, "daN": 0.1,
}  # fmt: skip
"""Of one SI unit, in the units that recorders write."""

JUDGED = {
    "speed": "/train/state.speed",
    "position": "/train/state.position",
    "traction": "/train/controls.tractive_effort",
    "dynamic": "/train/controls.dynamic_braking_effort",
    "pneumatic": "/train/controls.pneumatic_braking_effort",
    "wheel": "/train/axles.wheel_speed_1",
    "latitude": "/gnss/fix.latitude",
    "longitude": "/gnss/fix.longitude",
}
"""Fields whose values are compared with the trip's."""


@cache
def trips() -> tuple[tuple[Train, Trip], ...]:
    """Three trains on two lines: a railcar, a double-decker of 400 t, a freight train."""
    short = read_line(sample(DEFAULT_LINE))
    heavy = flirt(
        name="double-decker", mass=400e3, resistance=RunningResistance(5e3, 90.0, 14.0),
        max_tractive_effort=300e3, max_traction_power=4e6, max_dynamic_braking_effort=280e3,
        max_dynamic_braking_power=4e6, max_pneumatic_braking_effort=3e6,
        axles=Axles(count=6, adhesive_mass=130e3, wheel_radius=0.46), max_load=60e3,
    )  # fmt: skip
    freight = flirt(
        name="freight", mass=1_500e3, resistance=RunningResistance(20e3, 200.0, 35.0),
        max_tractive_effort=300e3, max_traction_power=5.6e6, max_dynamic_braking_effort=150e3,
        max_dynamic_braking_power=5e6, max_pneumatic_braking_effort=6e6, max_speed=100 / KMH,
        axles=Axles(count=4, adhesive_mass=84e3, wheel_radius=0.625), max_acceleration=0.3,
        max_deceleration=0.5, max_load=100e3,
    )  # fmt: skip
    return tuple(
        (train, simulate(draw_scenarios(line, train, count=4, seed=5)[number]))
        for line, train, number in (
            (short, flirt(), 3),
            (hilly_line(), heavy, 1),
            (short, freight, 0),
        )
    )


def sampled(trip: Trip, step: float) -> dict[str, np.ndarray]:
    """What a recorder with one clock sees of a trip, SI."""
    frames = [trip[f"/train/{name}"] for name in ("state", "controls", "axles")]
    seen = pd.concat(frames, axis=1).iloc[:: max(1, round(step / 0.1))]
    names = {"tractive": "traction", "dynamic_braking": "dynamic", "pneumatic_braking": "pneumatic"}
    seen = seen.rename(columns={f"{long}_effort": key for long, key in names.items()})
    found = {name: seen[name].to_numpy() for name in seen}
    found["time"] = seen.index.as_unit("ns").asi8
    for topic in ("/gnss/fix", "/gnss/motion"):
        known = trip[topic].index.as_unit("ns").asi8.astype(float)
        for name in {"latitude", "longitude", "altitude", "speed"} & set(trip[topic]):
            key = "gnss_speed" if name == "speed" else name
            found[key] = np.interp(found["time"].astype(float), known, trip[topic][name])
    return found


class Layout:
    """A recorder's table of a layout that the seed draws, and what a right reading of it gives."""

    def __init__(self, folder: Path, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.features: dict[str, Any] = {"seed": seed}
        self.columns: list[tuple[str, str, list[str]]] = []
        self.truth: dict[str, np.ndarray] = {}
        self.train, trip = trips()[self.pick("trip", 0, 1, 2)]
        self.language = self.pick("language", "en", "de", "fr")
        mark = self.pick("delimiter", ";", ",", "\t", "|")
        self.decimal = self.pick("decimal", ".", "." if mark == "," else ",")
        units = self.pick("units", "brackets", "round brackets", "suffix", "line", "slash", "none")
        seen = self.seen = sampled(trip, self.pick("step", 0.5, 1.0, 2.0))
        # The recorder's odometer begins anywhere.
        seen["position"] = seen["position"] + self.pick("begin", 0.0, 0.0, 12_345.0, 250_000.0)
        self.time = seen["time"]
        self.add_time()
        clocks = len(self.columns)
        for add in (self.add_motion, self.add_efforts, self.add_wheels, self.add_fixes):
            add()
        self.add_others()
        if self.pick("shuffled", False, True):
            order = self.rng.permutation(len(self.columns) - clocks) + clocks
            self.columns[clocks:] = [self.columns[i] for i in order]
        lines, first = self.lines(mark, units)
        rows = np.arange(self.time.size)
        middle, last = (first + len(lines)) // 2 - first, rows.size - 1
        damage = self.pick("damage", "none", "none", "gap", "cut off", "out of order")
        if damage == "gap":
            rows = np.delete(rows, np.arange(middle, middle + 20))
        elif damage == "cut off":
            lines[-1] = lines[-1][: len(lines[-1]) // 2]
        elif damage == "out of order":
            rows[[middle, middle + 1]] = rows[[middle + 1, middle]]
        lines = [*lines[:first], *(lines[first + row] for row in rows)]
        rows = rows[:last] if damage == "cut off" else rows
        self.truth = {key: values[rows] for key, values in self.truth.items()}
        self.time = self.time[rows]
        self.path = folder / f"run-{seed}.csv"
        end = "\r\n" if self.pick("crlf", False, True) else "\n"
        encoding = self.pick("encoding", "utf-8", "utf-8-sig", "cp1252", "utf-16")
        self.path.write_bytes(end.join(lines).encode(encoding))

    def pick(self, what: str, *choices: Any) -> Any:
        self.features[what] = choices[int(self.rng.integers(len(choices)))]
        return self.features[what]

    def add(self, key: str, unit: str, cells: list[str], axle: int = 0) -> None:
        words = WORDS[self.language, key]
        # All axles have one word.
        word = words[self.features["seed"] % len(words) if axle else self.rng.integers(len(words))]
        self.columns.append((word.format(axle), unit, cells))

    def text(self, values: np.ndarray, digits: int) -> list[str]:
        return [f"{value:.{digits}f}".replace(".", self.decimal) for value in values]

    def shown(
        self, key: str, unit: str, values: np.ndarray, digits: int = 2, axle: int = 0
    ) -> None:
        self.add(key, unit, self.text(values * SIZES[unit], digits), axle)

    def add_time(self) -> None:
        kind = self.pick(
            "time", "iso z", "iso", "offset", "local", "date and clock", "epoch s", "epoch ms",
            "elapsed", "elapsed ms", "parts", "month first", "clock alone",
        )  # fmt: skip
        stamps = pd.DatetimeIndex(self.time, tz="UTC")
        day = "%d.%m.%Y" if self.language == "de" else "%d/%m/%Y"
        millis = stamps.strftime("%f").str[:3]
        local = stamps.tz_convert("Europe/Zurich")
        comma = f" %H:%M:%S{self.decimal}"
        # The thirteenth or later decides.
        later = local + pd.Timedelta(days=10)
        since = self.time - self.time[0]
        if kind == "parts":
            seconds = np.asarray(stamps.second + stamps.microsecond / 1e6)
            cells = [list(stamps.strftime(code)) for code in ("%Y", "%m", "%d", "%H", "%M")]
            cells.append(self.text(seconds, 1))
            names = WORDS[self.language, "parts"]
            self.columns += [(name, "", each) for name, each in zip(names, cells, strict=True)]
            return
        if kind == "date and clock":
            self.add("date", "", list(stamps.strftime(day)))
        written: dict[str, tuple[str, str, Any]] = {
            "iso z": ("time", "", stamps.strftime("%Y-%m-%dT%H:%M:%S.") + millis + "Z"),
            "iso": ("time", "", stamps.strftime("%Y-%m-%d %H:%M:%S.") + millis),
            "offset": ("time", "", local.strftime("%Y-%m-%dT%H:%M:%S.") + millis + "+02:00"),
            "local": ("time", "", local.strftime(day + comma) + millis),
            "month first": ("time", "", later.strftime("%m/%d/%Y" + comma) + millis),
            "date and clock": ("clock", "", stamps.strftime("%H:%M:%S.") + millis),
            "clock alone": ("clock", "", stamps.strftime("%H:%M:%S.") + millis),
            "epoch s": ("time", "", self.text(self.time / 1e9, 3)),
            "epoch ms": ("time", "", map(str, self.time // 1_000_000)),
            "elapsed": ("elapsed", "s", self.text(since / 1e9, 1)),
            "elapsed ms": ("elapsed", "ms", map(str, since // 1_000_000)),
        }
        key, unit, cells = written[kind]
        self.add(key, unit, list(cells))

    def add_motion(self) -> None:
        self.truth["speed"] = self.seen["speed"]
        self.shown(
            "speed", self.pick("speed", "km/h", "km/h", "m/s", "mph", "kn"), self.seen["speed"]
        )
        if self.pick("odometer", True, True, True, False):
            unit, position = self.pick("length", "m", "km", "mi"), self.seen["position"]
            self.truth["position"] = position
            way = 300_000.0 - position if self.pick("falling", False, False, True) else position
            self.shown("position", unit, way, 1 if unit == "m" else 4)

    def add_efforts(self) -> None:
        kind = self.pick("efforts", "three", "three", "signed", "signed and air", "none")
        unit = self.pick("force", "kN", "kN", "N", "daN")
        if kind == "none":
            return
        efforts = {key: self.seen[key] for key in ("traction", "dynamic", "pneumatic")}
        braking = -1.0 if self.pick("braking negative", False, True) else 1.0
        if kind == "three":
            self.shown("traction", unit, efforts["traction"])
            self.shown("dynamic", unit, braking * efforts["dynamic"])
        else:
            turned = -1.0 if self.pick("traction negative", False, False, True) else 1.0
            noise = self.rng.normal(0.0, 300.0, self.time.size)
            net = efforts["traction"] - efforts["dynamic"] + noise
            self.shown("signed", unit, turned * net)
        if kind != "signed":
            self.shown("pneumatic", unit, braking * efforts["pneumatic"])
        else:
            del efforts["pneumatic"]
        self.truth |= efforts
        if self.pick("lever", False, True):
            scale = self.pick("lever scale", 1.0, 100.0)
            cells = self.text(self.seen["lever"] * scale, 3)
            self.add("lever", "%" if scale > 1.0 else "", cells)

    def add_wheels(self) -> None:
        kind = self.pick("wheels", "none", "speeds", "turns", "motor turns")
        if kind == "none":
            return
        size = 60.0 / (2.0 * np.pi * self.train.axles.wheel_radius)
        size *= 4.37 if kind == "motor turns" else 1.0
        for axle in range(1, self.train.axles.count + 1):
            speed = self.seen[f"wheel_speed_{axle}"]
            if kind == "speeds":
                self.shown("wheel", self.features["speed"], speed, axle=axle)
            else:
                self.add("turns", TURNS[self.language], self.text(speed * size, 2), axle)
        self.truth["wheel"] = self.seen["wheel_speed_1"]

    def add_fixes(self) -> None:
        kind = self.pick("fixes", "none", "degrees", "integers", "minutes", "swapped")
        if kind == "none":
            return
        self.truth |= {key: self.seen[key] for key in ("latitude", "longitude")}
        cells = []
        for values in (self.seen["latitude"], self.seen["longitude"]):
            if kind == "integers":
                cells.append([str(round(v * 1e7)) for v in values])
            elif kind == "minutes":
                cells.append(self.text(np.floor(values) * 100.0 + 60.0 * (values % 1.0), 5))
            else:
                cells.append(self.text(values, 7))
        self.add("latitude", "", cells[kind == "swapped"])
        self.add("longitude", "", cells[kind != "swapped"])
        if self.pick("altitude", False, True):
            self.shown("altitude", "m", self.seen["altitude"], 1)
        if self.pick("gnss speed", False, True):
            unit = self.pick("gnss unit", "km/h", "m/s", "kn")
            self.shown("gnss_speed", unit, self.seen["gnss_speed"])

    def add_others(self) -> None:
        rng, seen, count = self.rng, self.seen, self.time.size
        limit = np.repeat([22.2, 33.3, 25.0, 40.0], count // 4 + 1)[:count]
        others: dict[str, tuple[str, Any, int]] = {
            "temperature": ("°C", 60.0 + np.cumsum(rng.normal(0.0, 0.05, count)), 1),
            "door_state": ("", ["open" if each < 0.3 else "closed" for each in seen["speed"]], 0),
            "voltage": ("kV", 15.0 + rng.normal(0.0, 0.2, count), 2),
            "number": ("", ["4711"] * count, 0),
            "pressure": ("bar", 5.0 - 1.2 * (seen["pneumatic"] > 1e3), 2),
            "current": ("A", np.abs(seen["traction"] - seen["dynamic"]) / 400.0, 1),
            "set": ("km/h", 0.9 * limit * KMH, 0),
            "limit": ("km/h", limit * KMH, 0),
            "mean": ("km/h", np.cumsum(seen["speed"]) / np.arange(1, count + 1) * KMH, 1),
            "remaining": ("m", seen["position"].max() - seen["position"], 0),
            "demand": ("kN", np.roll(seen["traction"], -1) / 1e3, 1),
            "rate": ("m/s²", np.gradient(seen["speed"], self.time / 1e9), 3),
        }
        for key, (unit, values, digits) in others.items():
            if rng.random() < 0.35:
                cells = values if isinstance(values, list) else self.text(values, digits)
                self.add(key, unit, cells)

    def lines(self, mark: str, units: str) -> tuple[list[str], int]:
        """The lines of the file, and at which its rows begin."""
        forms = {"brackets": "{} [{}]", "round brackets": "{} ({})", "slash": "{} / {}"}
        shown, labels = list[str](), list[str]()
        for label, unit, _ in self.columns:
            form, bare = forms.get(units, "{}") if unit else "{}", unit.replace("/", "")
            if units == "suffix" and bare.isalpha():  # a lonely "%" or "tr/min" is no suffix
                form = f"{{}}_{bare}"
            shown.append(form.format(label, unit))
            again = shown.count(shown[-1])
            labels.append(shown[-1] if again == 1 else f"{shown[-1]} {again}")
        preamble = self.pick("preamble", 0, 0, 1, 3)
        lines = [f"Recorder {number + 7}, software 4.{number}" for number in range(preamble)]
        lines.append(mark.join(labels))
        if units == "line":
            lines.append(mark.join(f"[{unit}]" if unit else "" for _, unit, _ in self.columns))
        cells = [list(each) for *_, each in self.columns]
        word = self.pick("missing", "", "NaN", "---", "n/a", "ungültig")
        for column in cells:
            spared = any(sign in column[0] for sign in ":/") or "-" in column[0][1:]
            if len(set(column[:50])) > 2 and self.rng.random() < 0.3 and not spared:
                for row in self.rng.choice(len(column) - 1, 5, replace=False) + 1:
                    column[row] = word
        return lines + [mark.join(row) for row in zip(*cells, strict=True)], len(lines)


@dataclass
class Verdict:
    """By field "right", "missing", "stated" (wrong, but as open), "wrong" or why there is none."""

    layout: Layout
    fields: dict[str, str]
    proposal: Proposal | None = None

    @property
    def all_right(self) -> bool:
        return set(self.fields.values()) == {"right"}

    def __str__(self) -> str:
        bad = {name: how for name, how in self.fields.items() if how != "right"}
        return f"{self.layout.features}: {bad}"


def judged(layout: Layout) -> Verdict:
    """Propose a profile for a layout and compare what it reads with what happened."""
    try:
        proposal = propose_profile(layout.path)
    except InputError as error:
        return Verdict(layout, {"refused": str(error)})
    table = read_delimited(layout.path, proposal.profile).tables[0]
    fields = {"time": of_time(layout, table.time, proposal)}
    for key, truth in layout.truth.items():
        target = JUDGED[key]
        values = table.signals.get(target)
        row = proposal.evidence[proposal.evidence["field"] == target.removesuffix("_1")]
        stated = bool(len(row)) and bool(row["alternative"].iloc[0])
        if values is None:
            still = float(np.nanmax(np.abs(truth))) < 2e3
            effort = key in ("traction", "dynamic", "pneumatic")
            fields[key] = "right" if effort and still else "missing"
        elif same(truth, values, key):
            fields[key] = "right"
        else:
            fields[key] = "stated" if stated else "wrong"
    return Verdict(layout, fields, proposal)


def same(truth: np.ndarray, values: np.ndarray, key: str) -> bool:
    known = np.isfinite(values) & np.isfinite(truth)
    if key == "position":
        # From which zero the recorder counts is its own affair.
        values = values - np.nanmedian(values[known] - truth[known])
    scale = 1e-2 if key in ("latitude", "longitude") else float(np.percentile(np.abs(truth), 95))
    error = np.abs(values[known] - truth[known]) / scale
    return known.sum() > 0.8 * truth.size and bool(
        np.median(error) <= 0.01 and np.percentile(error, 95) <= 0.05
    )


def of_time(layout: Layout, time: np.ndarray, proposal: Proposal) -> str:
    """Times must be right but for what the file does not state, and that must be stated."""
    kind = layout.features["time"]
    known = time != NO_TIME
    moved = 10 * 86_400_000_000_000 * (kind == "month first")
    off = time[known] - layout.time[known] - moved
    opened = {reading.what for reading in proposal.readings if reading.alternative}
    if known.mean() < 0.95 or float(np.ptp(off)) > 2e6:
        return "stated" if "time" in opened else "wrong"
    shift = float(np.median(off)) / 1e9
    if abs(shift) < 0.01:
        return "right"
    if kind in ("elapsed", "elapsed ms", "clock alone"):
        return "right" if "day" in opened else "wrong"
    if kind not in ("iso z", "offset", "epoch s", "epoch ms") and abs(shift) == 7200.0:
        return "right" if "time zone" in opened else "wrong"
    return "stated" if {"date", "time"} & opened else "wrong"


RECORDER = Path("sample_logs/recorder.csv")
LAYOUTS = range(500, 510)


def drive(count: int = 600, step: float = 1.0) -> pd.DataFrame:
    """A trip of a train of 200 t over level track: speeds up, runs, brakes, three times."""
    seconds = np.arange(count) * step
    swing = np.sin(2.0 * np.pi * seconds / 200.0)
    rate = 0.6 * np.sign(swing) * (np.abs(swing) > 0.6)
    speed = np.maximum(np.cumsum(rate) * step, 0.0)
    effort = 200e3 * rate + (3e3 + 60.0 * speed + 8.0 * speed**2) * (speed > 0)
    return pd.DataFrame({"t": seconds, "v": speed, "s": np.cumsum(speed) * step, "F": effort})


RUN = drive()
TRAIN = read_train(sample(DEFAULT_TRAIN))
STAMPS = pd.Timestamp("2024-05-01T06:00:00Z") + pd.to_timedelta(RUN.t, unit="s")


def written(folder: Path, columns: dict[str, object], name: str = "run.csv") -> Path:
    path = folder / name
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
    return path


def field(proposal: Proposal, name: str) -> dict[str, str]:
    return dict(proposal.evidence.set_index("field").loc[name])


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> list[Verdict]:
    folder = tmp_path_factory.mktemp("layouts")
    return [judged(Layout(folder, seed)) for seed in LAYOUTS]


def assert_right(verdicts: list[Verdict], share: float, wrong: int) -> None:
    """At least a share of the layouts is read rightly, and no more are wrong without a word."""
    others = [each for each in verdicts if not each.all_right]
    said = "\n".join(map(str, others))
    assert len(others) <= (1.0 - share) * len(verdicts), said
    assert sum("wrong" in each.fields.values() for each in others) <= wrong, said


def test_nine_of_ten_layouts_are_read_rightly_and_none_wrongly(verdicts):
    assert_right(verdicts, 0.9, 0)


@pytest.mark.long
def test_three_hundred_layouts(tmp_path):
    assert_right([judged(Layout(tmp_path, seed)) for seed in range(3_000, 3_300)], 0.95, 3)


def test_every_column_is_used_or_listed(verdicts):
    for verdict in verdicts:
        proposal = verdict.proposal
        assert proposal is not None, str(verdict)
        used = {n for c in proposal.profile.columns.values() for n in c.names}
        used |= set(proposal.profile.time.names)
        used |= set(proposal.profile.trip.columns.names)
        assert used | set(proposal.not_used) == set(proposal.names)


def test_the_sample_recorder_is_ingested_as_with_its_own_profile():
    proposal = propose_profile(RECORDER)
    assert [question.split(":")[0] for question in proposal.open] == ["time zone"]
    assert "# open: or local time" in proposal.text
    zoned = replace(proposal.profile, time=replace(proposal.profile.time, timezone="Europe/Zurich"))
    line = read_line(sample(DEFAULT_LINE))
    proposed, true = (
        ingest(RECORDER, profile, line=line, train=TRAIN, metadata={"load": "12000"})
        for profile in (zoned, "sample_logs/recorder.profile.toml")
    )
    assert list(proposed.topics) == list(true.topics)
    for name, frame in true.topics.items():
        pd.testing.assert_frame_equal(proposed[name], frame)


@pytest.mark.parametrize(
    ("columns", "train", "expected"),
    [
        ({"v [km/h]": 3.6 * RUN.v, "F [kN]": RUN.F}, None, ["N", "kN, as the file states"]),
        ({"v [km/h]": 3.6 * RUN.v, "F": RUN.F}, None, ["N", "daN or lbf"]),
        ({"v [km/h]": 3.6 * RUN.v, "F": RUN.F}, TRAIN, ["N", ""]),
        # Miles, mph and pounds are one choice: in km, km/h and newtons the train is too light.
        (
            {"TE": 0.18 * RUN.F, "speed": RUN.v / 0.44704, "distance": RUN.s / 1609.344},
            TRAIN,
            ["N", "lbf", "km", "mile", "km/h", "mph"],
        ),
        (
            {"TE": 0.1 * RUN.F, "speed": RUN.v, "distance": RUN.s / 1609.344},
            None,
            ["daN", "lbf or N", "mile", "", "m/s", ""],
        ),
    ],
)
def test_a_unit_is_open_as_far_as_mechanics_and_the_train_leave_it(
    tmp_path, columns, train, expected
):
    proposal = propose_profile(written(tmp_path, {"t [s]": RUN.t, **columns}), train)
    names = ["controls.tractive_effort", "state.position", "state.speed"][: len(expected) // 2]
    found = [field(proposal, f"/train/{name}") for name in names]
    assert [row[key] for row in found for key in ("unit", "alternative")] == expected


@pytest.mark.parametrize("name", ["Zeit", "Zeit (local)", "time (local)"])
@pytest.mark.parametrize(("first", "zone"), [("01:55", "Europe/Berlin"), ("02:10", "UTC")])
def test_a_trip_in_the_night_in_which_the_clocks_change_is_read(tmp_path, name, first, zone):
    """Without a step back nothing shows which of two hours it is: the zone stays open."""
    run = drive(count=4500 if zone != "UTC" else 600)
    begin = pd.Timestamp(f"2024-10-27 {first}").tz_localize("Europe/Berlin", ambiguous=True)
    local = (begin + pd.to_timedelta(run.t, unit="s")).dt.tz_localize(None)
    columns = {name: local.astype(str), "Geschwindigkeit [km/h]": 3.6 * run.v, "Weg [m]": run.s}
    proposal = propose_profile(written(tmp_path, columns))
    assert proposal.profile.time.timezone == (zone if "local" in name else "UTC")
    assert any(each.startswith("time zone: ") for each in proposal.open)


def test_a_distance_that_falls_ends_at_0_of_a_line_that_is_known(tmp_path):
    line = read_line(sample(DEFAULT_LINE))
    columns = {"km": (line.length - 4e3 - RUN.s) / 1e3, "v [m/s]": RUN.v}
    path = written(tmp_path, {"t [s]": RUN.t, **columns})
    for known, start, opened in ((line, 4e3, False), (None, 443.9, True)):
        proposal = propose_profile(path, line=known)
        trip = ingest(path, proposal.profile)
        assert trip["/train/state"].position.iloc[0] == pytest.approx(start, abs=1.0)
        assert ("offset" in field(proposal, "/train/state.position")["alternative"]) is opened


@pytest.mark.parametrize("falls", [True, False])
def test_positions_are_the_operators_kilometres_where_those_of_the_line_fit(tmp_path, falls):
    line = read_line(sample(DEFAULT_LINE))
    ends = np.array([[90e3], [90e3 - line.length]])
    line = replace(line, reference=LineReference("7", np.zeros(1), *ends))
    km = (90e3 - 3e3 - RUN.s if falls else 90e3 - line.length + 3e3 + RUN.s) / 1e3
    path = written(tmp_path, {"t [s]": RUN.t, "km": km, "v [m/s]": RUN.v})
    trip = ingest(path, propose_profile(path, line=line).profile, line=line)
    assert trip["/train/state"].position.iloc[0] == pytest.approx(3e3, abs=1.0)
    # Falling kilometres of a line whose kilometres fall do not suggest the other direction.
    assert "--reverse" not in trip.metadata["direction_evidence"]


def test_kilometres_that_the_profile_turns_wrongly_are_refused_with_the_other_sign(tmp_path):
    path = written(tmp_path, {"t [s]": RUN.t, "km": (90e3 - RUN.s) / 1e3, "v [m/s]": RUN.v})
    profile = propose_profile(path).profile
    turned = written(tmp_path, {"t [s]": RUN.t, "km": RUN.s / 1e3, "v [m/s]": RUN.v})
    with pytest.raises(InputError, match="-1, or 1 where it is -1"):
        ingest(turned, profile)


@pytest.mark.parametrize("word", ["65535", "65535.000", "6553.50", "-32768.0", "327.670"])
def test_a_number_for_no_value_is_known_with_any_zeros_behind_it(tmp_path, word):
    speed = [f"{value:.3f}" for value in 3.6 * RUN.v]
    speed[100:600:100] = [word] * 5
    path = written(tmp_path, {"t [s]": RUN.t, "s [m]": RUN.s, "v [km/h]": speed})
    proposal = propose_profile(path)
    assert field(proposal, "/train/state.speed")["unit"] == "km/h"
    trip = ingest(path, proposal.profile)
    assert trip["/train/state"].speed.isna().sum() == 5


def test_a_table_without_names_is_read_by_what_its_columns_do(tmp_path):
    frame = pd.DataFrame({"t": STAMPS.dt.tz_localize(None), "x": RUN.v * 3.6, "y": RUN.s})
    path = tmp_path / "bare.csv"
    frame.to_csv(path, index=False, header=False, float_format="%.6g")
    trip = ingest(path, propose_profile(path).profile)
    np.testing.assert_allclose(trip["/train/state"]["speed"], RUN.v, atol=1e-3)
    np.testing.assert_allclose(trip["/train/state"]["position"], RUN.s, atol=0.1)


def test_south_west_in_degrees_and_minutes(tmp_path):
    places = {"lat": 3330.0 + RUN.s / 1853.25, "NS": "S", "lon": 7040.0, "EW": "W"}
    path = written(tmp_path, {"time": STAMPS, **places, "speed [kn]": RUN.v * 1.943844})
    fix = ingest(path, propose_profile(path).profile)["/gnss/fix"]
    assert fix["latitude"].iloc[0] == pytest.approx(-33.5)
    assert fix["longitude"].iloc[0] == pytest.approx(-70.0 - 40.0 / 60.0)


@pytest.mark.parametrize(
    ("columns", "reason"),
    [
        ({"v [m/s]": 15.0 + 0.0 * RUN.t, "a [m/s2]": np.sin(RUN.t / 9.0)}, "not the speed's"),
        ({"speed [m/s]": RUN.v, "wheel speed": -RUN.v}, "-1 times the train's speed"),
        (
            {
                "v [km/h]": RUN.v * 3.6,
                "Weg [m]": np.random.default_rng(1).uniform(0.0, 9e3, len(RUN)),
            },
            "does not follow the speed",
        ),
    ],
)
def test_a_column_that_contradicts_the_speed_is_not_used(tmp_path, columns, reason):
    proposal = propose_profile(written(tmp_path, {"Time [s]": RUN.t, **columns}))
    assert len(proposal.profile.columns) == 1
    assert reason in proposal.not_used[list(columns)[1]]


@pytest.mark.parametrize(
    ("days", "pattern", "opened"),
    [
        (["03/04/2024"], "%d/%m/%Y", True),
        (["13/04/2024"], "%d/%m/%Y", False),
        (["04/13/2024"], "%m/%d/%Y", False),
        (["03.04.2024"], "%d.%m.%Y", False),
        (["04/12/2024", "05/12/2024"], "%d/%m/%Y", False),
    ],
)
def test_day_and_month(tmp_path, days, pattern, opened):
    stamps = pd.Timestamp("2024-01-01T23:55:00") + pd.to_timedelta(RUN.t, unit="s")
    if len(days) == 1:
        stamps -= pd.Timedelta(hours=5)
    day = [days[int(stamp.day > 1)] for stamp in stamps]
    path = written(
        tmp_path, {"Date": day, "Time": stamps.dt.strftime("%H:%M:%S"), "Speed [km/h]": RUN.v * 3.6}
    )
    proposal = propose_profile(path)
    assert proposal.profile.time.format == f"{pattern} %H:%M:%S"
    assert any(question.startswith("date") for question in proposal.open) == opened


@pytest.mark.parametrize("pattern", ["%Y%m%dT%H%M%SZ", "%Y%m%d%H%M%S", "%d-%b-%Y %H:%M:%S"])
def test_times_whose_parts_are_known_by_their_order(tmp_path, pattern):
    truth = pd.date_range("2024-05-01T06:00:00Z", periods=300, freq="s")
    speed = 60.0 + 20.0 * np.sin(np.arange(300) / 30.0)
    rows = [f"{at},{v:.1f}" for at, v in zip(truth.strftime(pattern), speed, strict=True)]
    path = put(tmp_path / "run.csv", ["Time,Speed [km/h]", *rows])
    trip = ingest(path, profile=propose_profile(path).profile)
    assert (trip["/train/state"].index == truth).all()


@pytest.mark.parametrize(("zone", "hours"), [("Z", 0), ("z", 0), ("+02", 2), (" -0330", -3.5)])
def test_a_zone_is_known_alike_in_tables_and_tracks(tmp_path, zone, hours):
    run = drive(120)
    times = pd.Timestamp("2024-05-01T06:00:00") + pd.to_timedelta(run.t, "s")
    stated = [f"{time:%Y-%m-%dT%H:%M:%S}{zone}" for time in times]
    path = written(tmp_path, {"Zeit": stated, "Speed [m/s]": run.v})
    proposal = propose_profile(path)
    assert not any("zone" in question for question in proposal.open)
    points = "".join(
        f'<trkpt lat="{47.0 + 1e-5 * way}" lon="9.0"><time>{time}</time></trkpt>'
        for time, way in zip(stated, run.s, strict=True)
    )
    track = put(tmp_path / "run.gpx", f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>")
    trips = ingest(path, proposal.profile), ingest(track)
    assert {trip.start for trip in trips} == {
        pd.Timestamp("2024-05-01T06:00:00Z") - pd.Timedelta(hours=hours)
    }
    assert trips[1].metadata["clock"] == "GNSS, UTC"


@pytest.mark.parametrize("name", ["ENGINE_RUN_TINE ()", "Run time since engine start [s]"])
@pytest.mark.parametrize("rows", [1, 3])
def test_the_run_time_of_an_engine_is_a_time(tmp_path, name, rows):
    """OBD loggers count whole seconds since the start, with one or several rows each."""
    run = drive(300 * rows, 1.0 / rows)
    engine = 50.0 + np.random.default_rng(1).uniform(0.0, 1.0, 300 * rows)
    columns = {name: np.repeat(np.arange(137, 437), rows), "VEHICLE_SPEED ()": 3.6 * run.v}
    path = written(tmp_path, columns | {"Abgastemperatur [°C]": engine})
    state = ingest(path, propose_profile(path).profile)["/train/state"]
    assert len(state) == 300 * rows
    apart = (state.index - state.index[0]).total_seconds().to_numpy()
    assert np.abs(apart - np.arange(300 * rows) / rows).max() < 0.01


def test_parquet_with_typed_times(tmp_path):
    path = tmp_path / "run.parquet"
    pd.DataFrame({"stamp": STAMPS, "vitesse": RUN.v * 3.6, "distance": RUN.s}).to_parquet(path)
    proposal = propose_profile(path)
    assert field(proposal, "/train/state.speed")["unit"] == "km/h"
    trip = ingest(path, proposal.profile)
    np.testing.assert_allclose(trip["/train/state"]["speed"], RUN.v, atol=1e-9)


@pytest.mark.parametrize("beside", ["fixes", "distance"])
@pytest.mark.parametrize(("unit", "size"), [("km/h", 3.6), ("rpm", 60.0 / (2.0 * np.pi * 0.43))])
def test_wheel_speeds_are_kept_where_no_speed_is_recorded(tmp_path, beside, unit, size):
    where = {"lat": 47.0 + RUN.s / 111_195.0, "lon": 9.0}
    where = where if beside == "fixes" else {"distance [m]": RUN.s}
    wheels = {f"wheel speed {axle} [{unit}]": RUN.v * size for axle in (1, 2)}
    path = written(tmp_path, {"t [s]": RUN.t, **where, **wheels})
    trip = ingest(path, propose_profile(path).profile)
    found = trip["/train/axles"][["wheel_speed_1", "wheel_speed_2"]].to_numpy()
    assert np.abs(found - RUN.v.to_numpy()[:, None]).max() < 0.02 * RUN.v.max()


@pytest.mark.parametrize(
    ("delimiter", "thousands", "decimal", "digits"),
    [(",", ",", ".", 1), (";", ".", ",", 1), (";", "'", ".", 0), ("\t", ".", ",", 0)],
)
def test_marks_between_thousands_are_read(tmp_path, delimiter, thousands, decimal, digits):
    marks = str.maketrans({",": thousands, ".": decimal})
    lines = [delimiter.join(["t [s]", "Speed [km/h]", "Distance [m]"])]
    for second, speed, way in zip(RUN.t, 3.6 * RUN.v, RUN.s, strict=True):
        cells = f"{speed:.1f}".translate(marks), f"{way:,.{digits}f}".translate(marks)
        lines.append(delimiter.join([f"{second:.0f}", cells[0], f'"{cells[1]}"']))
    path = put(tmp_path / "run.csv", lines)
    profile = propose_profile(path).profile
    position = ingest(path, profile)["/train/state"]["position"]
    assert RUN.s.max() > 1_000.0
    assert np.abs(position.to_numpy() - RUN.s.to_numpy()).max() < 0.51
    wrong = replace(profile, file=replace(profile.file, thousands=""))
    if (thousands, digits) != (".", 0):  # else they are read as decimals
        refused(InputError, f"thousands = .{re.escape(thousands)}. under", ingest, path, wrong)


def test_a_unit_that_no_other_column_shows_is_unproven(tmp_path):
    alone = {"t [s]": RUN.t, "Speed [mph]": 2.23694 * RUN.v}
    for columns, unproven in ((alone, "/train/state.speed [mph]"), (alone | {"s [m]": RUN.s}, "")):
        path = written(tmp_path, columns)
        trip = ingest(path, propose_profile(path).profile)
        assert trip.metadata.get("unproven_units", "") == unproven


CELLS = [(str(row), f"{20.0 + row % 7}", f"S{row}", f"6:{row:02d}") for row in range(50)]
NO_TRIP = {
    "t,v\n" + "".join(f'"{t},0","{v[:-2]},5"\n' for t, v, *_ in CELLS): "write it with semicolons",
    "t [min],v [km/h]\n" + "".join(f"{t},{v}\n" for t, v, *_ in CELLS): "which a profile cannot",
    "t [s],Temperature [°C]\n" + "".join(f"{t},{v}\n" for t, v, *_ in CELLS): (
        "no column is a speed, a distance or a satellite"
    ),
    "Dear all,\nthe train was late again.\nRegards\n": "is not a table",
    "Station,Arrival,km\n" + "".join(f"{s},{at},{t}\n" for t, _, s, at in CELLS): (
        "lie 60 s apart, as in a timetable"
    ),
}


@pytest.mark.parametrize("text", NO_TRIP, ids=range(len(NO_TRIP)))
def test_what_no_profile_can_read_or_is_no_trip_is_refused(tmp_path, text):
    refused(InputError, NO_TRIP[text], propose_profile, put(tmp_path / "run.csv", text))


def test_a_receiver_under_other_names_is_read_as_the_known_one(tmp_path):
    lines = Path("sample_logs/gnss.csv").read_text().splitlines()[:4000]
    names = "Jahr,Monat,Tag,Stunde,Minute,Sekunde,Satelliten,Laenge,Breite,Hoehe 1,Hoehe 2,"
    names += "hAcc,vAcc,v,sAcc,PDOP,"
    path = put(tmp_path / "receiver.csv", [names, *lines[1:]])
    known = put(tmp_path / "known.csv", lines)
    proposal = propose_profile(path)
    # The receiver has two altitudes; which of them is meant is open.
    assert field(proposal, "/gnss/fix.altitude")["alternative"] == "'Hoehe 2'"
    proposed, true = ingest(path, proposal.profile), ingest(known)
    for topic in ("/gnss/fix", "/gnss/motion"):
        for column in set(true[topic]) & set(proposed[topic]) - {"altitude"}:
            pd.testing.assert_series_equal(proposed[topic][column], true[topic][column])
    assert {"latitude", "longitude", "altitude"} <= set(proposed["/gnss/fix"])


def test_a_user_at_a_terminal_is_asked(tmp_path, monkeypatch):
    path = written(tmp_path, {"t [s]": RUN.t, "v [km/h]": RUN.v * 3.6, "s [m]": RUN.s})
    monkeypatch.setattr("trainlog.cli.ingest._at_terminal", lambda: True)
    refused = CliRunner().invoke(app, ["ingest", str(path), "-o", str(tmp_path / "out")], "n\n")
    assert refused.exit_code == 1
    assert "with " + str(tmp_path / "out" / "run.profile.toml") in " ".join(refused.output.split())
    agreed = CliRunner().invoke(app, ["ingest", str(path), "-o", str(tmp_path / "out")], "y\n")
    assert agreed.exit_code == 0, agreed.output
    assert (tmp_path / "out" / "run.mcap").is_file()


def test_public_tables_that_are_no_trip():
    folder = Path(__file__).parents[1] / ".." / "shared" / "data" / "aalto"
    if not folder.is_dir():
        pytest.skip("needs the public data")
    for name, reason in (
        ("device_data.csv", "does it hold several devices"),
        ("device_models.csv", "no column is a time that goes forward"),
    ):
        refused(InputError, reason, propose_profile, folder / name)


def test_the_command_proposes_and_then_ingests(tmp_path, shell, works):
    (tmp_path / "in").mkdir()
    for number in (1, 2):
        day = STAMPS.dt.tz_localize(None) + pd.Timedelta(days=number)
        columns = {"Zeit (UTC)": day, "v [km/h]": RUN.v * 3.6, "Weg [m]": RUN.s + number}
        path = written(tmp_path / "in", columns, f"run-{number}.csv")
    output = tmp_path / "out"
    given = ["ingest", path, "-o", output]
    options = ["--train", str(sample("CH_Stadler_FLIRT_TPF.train.json")), "--set", "load=12 t"]
    options.append("--reverse")
    said = shell(*given, *options)[2]
    assert f"-o {output} {shlex.join(options)}" in " ".join(said.split())
    status, _, said = shell(*given)
    assert status == 1
    proposed = output / "run-2.profile.toml"
    assert f"--profile {proposed} -o {output}" in " ".join(said.split())
    assert not list(output.glob("*.mcap"))
    works(*given, "--profile", proposed)
    # Of a folder, one proposal for all files of a layout.
    status, said, _ = shell("ingest", tmp_path / "in", "-o", tmp_path / "asked")
    said = " ".join(said.split())
    assert status == 1
    assert said.count(f"then: trainlog ingest {tmp_path / 'in'} --profile") == 1
    assert f"as for {tmp_path / 'in' / 'run-1.csv'}" in said
    words = ("ingest", tmp_path / "in", "-o", tmp_path / "all", "--accept", "--json")
    assert json.loads(works(*words))["counts"]["refused"] == 0
    assert sorted(each.name for each in (tmp_path / "all").iterdir()) == [
        "run-1.mcap",
        "run-1.profile.toml",
        "run-2.mcap",
    ]


@pytest.mark.parametrize("hours", [-4.0, 0.0, 3.0, 5.75])
def test_a_unix_time_beside_a_local_one_decides_its_zone(tmp_path, hours):
    """The column of local time comes first, has tenths of a second, and names no zone."""
    truth = pd.date_range("2024-05-01T20:00:00Z", periods=900, freq="500ms")
    local = (truth + pd.Timedelta(hours=hours)).strftime("%Y-%m-%d %H:%M:%S.%f")
    speed = 60.0 + 20.0 * np.sin(np.arange(900) / 60.0)
    way = np.cumsum(speed / 3.6) * 0.5
    rows = [
        f"{at[:-5]},{unix + 1},{v:.1f},{s:.0f}"
        for at, unix, v, s in zip(local, truth.as_unit("ns").asi8 // 10**9, speed, way, strict=True)
    ]
    path = put(tmp_path / "run.csv", ["local_datetime,unix,speed [km/h],distance [m]", *rows])
    proposal = propose_profile(path)
    trip = ingest(path, profile=proposal.profile)
    assert trip.start == truth[0]
    assert not any("time zone" in question for question in proposal.open)
