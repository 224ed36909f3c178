"""Profiles proposed for tables of unknown layouts: what they read must be what was recorded."""

from __future__ import annotations

import json
import re
import shlex
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from simulated_line import KMH, flirt, hilly_line
from typer.testing import CliRunner

from analysis import fit_trip
from trainlog.cli.main import app
from trainlog.errors import InputError
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, sample
from trainlog.ingest import NO_TIME, Proposal, ingest, propose_profile
from trainlog.ingest.tabular import read_delimited, read_parquet
from trainlog.railway import Axles, Line, RunningResistance, Train
from trainlog.simulation import draw_scenarios, simulate
from trainlog.trip import Trip

NAMES: dict[str, dict[str, list[str]]] = {
    "en": {
        "time": ["Time", "Timestamp", "Recorded at (time)", "Date/Time", "time"],
        "date": ["Date"],
        "clock": ["Time", "Time of day"],
        "elapsed": ["t", "Elapsed", "Time"],
        "speed": ["Speed", "v", "Train speed", "Velocity", "v_act", "Actual speed"],
        "position": ["Distance", "Position", "Odometer", "Chainage", "s", "Mileage"],
        "traction": ["Tractive effort", "F_traction", "TE", "Traction force", "Traction"],
        "signed": ["Traction/braking effort", "Effort", "F", "Tractive-braking force"],
        "dynamic": ["Electric brake effort", "Dynamic brake", "F_ebrake", "ED brake force"],
        "pneumatic": ["Air brake effort", "Friction brake force", "F_airbrake", "Pneumatic brake"],
        "lever": ["Lever", "Master controller", "Throttle handle"],
        "wheel": ["Axle {} speed", "v_axle{}", "Wheel speed {}", "WheelSpeed{}"],
        "turns": ["n{}", "Axle {} revs", "Wheelset {} rotation", "RPM_{}"],
        "wheel_effort": ["Axle {} effort", "F_axle{}"],
        "latitude": ["lat", "Latitude", "GPS latitude", "gps_lat"],
        "longitude": ["lon", "Longitude", "GPS longitude", "gps_lon"],
        "altitude": ["alt", "Altitude", "Elevation", "Height"],
        "gnss_speed": ["GPS speed", "gps_v", "Speed (GNSS)"],
        "limit": ["Speed limit", "v_max", "Permitted speed"],
        "set": ["Set speed", "v_target"],
        "temperature": ["Motor temperature", "Temp transformer"],
        "door_state": ["DoorsOpen", "Door_state"],
        "voltage": ["Line voltage", "Catenary voltage", "U_line"],
        "number": ["Train number", "Record id"],
        "pressure": ["Brake pipe pressure", "BP"],
        "current": ["Motor current 1", "Line current"],
        "demand": ["Traction demand", "Requested effort", "F_setpoint"],
        "remaining": ["Remaining way (distance)", "Remaining distance"],
        "mean": ["Average speed", "Mean speed"],
        "rate": ["Acceleration", "a"],
    },
    "de": {
        "time": ["Zeit", "Zeitstempel", "Datum/Zeit", "Datum Uhrzeit"],
        "date": ["Datum"],
        "clock": ["Uhrzeit", "Zeit"],
        "elapsed": ["t", "Laufzeit", "Zeit"],
        "speed": ["Geschwindigkeit", "v", "V_Ist", "Istgeschwindigkeit", "Geschw.", "v Zug"],
        "position": ["Weg", "km", "Wegstrecke", "Strecke", "Kilometrierung", "Position", "s"],
        "traction": ["Zugkraft", "F_Zug", "Z", "Antriebskraft"],
        "signed": ["Zug-/Bremskraft", "F", "Kraft", "Zug- und Bremskraft"],
        "dynamic": ["Bremskraft elektrisch", "E-Bremskraft", "F_ED", "Elektr. Bremskraft"],
        "pneumatic": ["Bremskraft mechanisch", "Druckluftbremskraft", "F_pn", "Reibungsbremskraft"],
        "lever": ["Fahrhebel", "Fahrschalter", "Fahrbremshebel"],
        "wheel": ["v Achse {}", "Radsatz {} Geschwindigkeit", "v_Rad{}"],
        "turns": ["Drehzahl {}", "n{}", "Drehzahl Achse {}", "Radsatzdrehzahl {}"],
        "wheel_effort": ["F Achse {}", "Zugkraft Achse {}"],
        "latitude": ["Breite", "lat", "Breitengrad"],
        "longitude": ["Länge", "lon", "Längengrad"],
        "altitude": ["Höhe", "Hoehe", "Höhe ü. M."],
        "gnss_speed": ["GPS-Geschwindigkeit", "v_GPS"],
        "limit": ["Vmax", "Höchstgeschwindigkeit", "v zulässig"],
        "set": ["V_Soll", "Sollgeschwindigkeit"],
        "temperature": ["Temperatur Motor 1", "Trafotemperatur"],
        "door_state": ["Türen", "Türzustand"],
        "voltage": ["Fahrdrahtspannung", "U_FD"],
        "number": ["Zugnummer", "Zähler"],
        "pressure": ["Druck HLL", "Hauptluftleitung"],
        "current": ["Strom FM1", "Oberstrom"],
        "demand": ["Sollzugkraft", "Zugkraft Sollwert"],
        "remaining": ["Restweg", "Restdistanz"],
        "mean": ["Durchschnittsgeschwindigkeit", "v mittel"],
        "rate": ["Beschleunigung", "a"],
    },
    "fr": {
        "time": ["Horodatage", "Temps", "Date et heure"],
        "date": ["Date"],
        "clock": ["Heure"],
        "elapsed": ["t", "Temps"],
        "speed": ["Vitesse", "v", "Vitesse réelle", "Vitesse train", "Vit."],
        "position": ["Distance", "PK", "Distance parcourue", "Abscisse", "Point kilométrique"],
        "traction": ["Effort de traction", "Effort traction", "F_traction"],
        "signed": ["Effort", "Effort traction/freinage", "F", "Effort à la jante"],
        "dynamic": ["Freinage électrique", "Effort de freinage dynamique", "Frein élec."],
        "pneumatic": ["Frein pneumatique", "Effort de freinage mécanique"],
        "lever": ["Manipulateur", "Manip. traction"],
        "wheel": ["Vitesse essieu {}", "v_essieu{}", "Vitesse roue {}"],
        "turns": ["Rotation essieu {}", "n{}", "Régime essieu {}"],
        "wheel_effort": ["Effort essieu {}"],
        "latitude": ["lat", "Latitude"],
        "longitude": ["lon", "Longitude"],
        "altitude": ["Altitude", "alt"],
        "gnss_speed": ["Vitesse GPS"],
        "limit": ["Vitesse limite", "V max"],
        "set": ["Vitesse de consigne", "Consigne vitesse"],
        "temperature": ["Température moteur", "Temp. transfo"],
        "door_state": ["Portes", "État portes"],
        "voltage": ["Tension caténaire", "Tension ligne"],
        "number": ["Numéro de train", "Compteur"],
        "pressure": ["Pression CG", "Pression conduite"],
        "current": ["Courant moteur 1", "Courant ligne"],
        "demand": ["Consigne d'effort", "Effort demandé"],
        "remaining": ["Distance restante"],
        "mean": ["Vitesse moyenne"],
        "rate": ["Accélération", "a"],
    },
}  # fmt: skip

UNITS = {
    "speed": {"km/h": 3.6, "m/s": 1.0, "mph": 3.6 / 1.609344, "kn": 3.6 / 1.852},
    "length": {"m": 1.0, "km": 1e-3, "mi": 1.0 / 1609.344},
    "force": {"kN": 1e-3, "N": 1.0, "daN": 0.1},
}
"""Of one SI unit, in the units that recorders write."""

TURNS = {"en": "rpm", "de": "1/min", "fr": "tr/min"}

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
def trips() -> tuple[tuple[Line, Train, Trip], ...]:
    """Three trains on three lines: a railcar, a double-decker of 400 t, a freight train."""
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
    made = []
    for line, train, number in ((short, flirt(), 3), (hilly_line(), heavy, 1), (short, freight, 0)):
        if train.name == "freight":
            line = line.part(4_000.0, 20_000.0) if hasattr(line, "part") else line
        scenario = draw_scenarios(line, train, count=4, seed=5)[number]
        made.append((line, train, simulate(scenario)))
    return tuple(made)


@dataclass
class Layout:
    """A drawn layout and what a right reading of it gives.

    Attributes
    ----------
    features : dict
        What was drawn, for messages.
    truth : dict of str to (n,) array
        By key of `JUDGED`, SI, row by row; NaN where the file has no value.
    time : (n,) int64 array [ns]
        UTC.
    zone_known, day_known : bool
        Whether the file states its zone and its day.
    """

    path: Path
    features: dict[str, Any]
    truth: dict[str, np.ndarray]
    time: np.ndarray
    zone_known: bool
    day_known: bool
    train: Train


def sampled(trip: Trip, step: float) -> dict[str, np.ndarray]:
    """What a recorder with one clock sees of a trip, SI."""
    state, controls, axles = (trip[f"/train/{name}"] for name in ("state", "controls", "axles"))
    fix, motion = trip["/gnss/fix"], trip["/gnss/motion"]
    every = max(1, round(step / 0.1))
    rows = np.arange(0, len(state), every)
    at = state.index.as_unit("ns").asi8[rows]
    found = {"time": at}
    for key, frame, column in (
        ("position", state, "position"), ("speed", state, "speed"),
        ("traction", controls, "tractive_effort"), ("dynamic", controls, "dynamic_braking_effort"),
        ("pneumatic", controls, "pneumatic_braking_effort"), ("lever", controls, "lever"),
    ):  # fmt: skip
        found[key] = frame[column].to_numpy()[rows]
    for name in axles.columns:
        found[name] = axles[name].to_numpy()[rows]
    seconds, fixes = at.astype(float), fix.index.as_unit("ns").asi8.astype(float)
    for key in ("latitude", "longitude", "altitude"):
        found[key] = np.interp(seconds, fixes, fix[key].to_numpy())
    moving = motion.index.as_unit("ns").asi8.astype(float)
    found["gnss_speed"] = np.interp(seconds, moving, motion["speed"].to_numpy())
    return found


class _Writer:
    """Draws a layout and writes the table."""

    def __init__(self, seed: int) -> None:
        self.rng = np.random.default_rng(seed)
        self.features: dict[str, Any] = {"seed": seed}
        self.columns: list[tuple[str, str, list[str]]] = []
        self.truth: dict[str, np.ndarray] = {}

    def pick(self, what: str, choices: list[Any]) -> Any:
        chosen = choices[int(self.rng.integers(len(choices)))]
        self.features[what] = chosen
        return chosen

    def name(self, key: str) -> str:
        words = NAMES[self.features["language"]][key]
        return str(words[int(self.rng.integers(len(words)))])

    def text(self, values: np.ndarray, digits: int) -> list[str]:
        cells = [f"{value:.{digits}f}" if np.isfinite(value) else "" for value in values]
        if self.features["decimal"] == ",":
            cells = [cell.replace(".", ",") for cell in cells]
        return cells

    def add(self, label: str, unit: str, cells: list[str]) -> None:
        self.columns.append((label, unit, cells))


def draw(folder: Path, seed: int) -> Layout:
    """A recorder's table of a layout that the seed draws."""
    writer = _Writer(seed)
    pick = writer.pick
    _, train, trip = trips()[pick("trip", [0, 1, 2])]
    pick("language", ["en", "de", "fr"])
    pick("delimiter", [";", ",", "\t", "|"])
    decimals = ["."] if writer.features["delimiter"] == "," else [".", ","]
    pick("decimal", decimals)
    units = pick("units", ["brackets", "round brackets", "suffix", "line", "slash", "none"])
    seen = sampled(trip, pick("step", [0.5, 1.0, 2.0]))
    # The recorder's odometer begins anywhere.
    seen["position"] = seen["position"] + pick("begin", [0.0, 0.0, 12_345.0, 250_000.0])
    _add_time(writer, seen["time"])
    clocks = len(writer.columns)
    _add_motion(writer, seen)
    _add_efforts(writer, seen)
    _add_wheels(writer, seen, train)
    _add_fixes(writer, seen)
    _add_others(writer, seen)
    columns = writer.columns
    if pick("shuffled", [False, True]):
        order = writer.rng.permutation(len(columns) - clocks) + clocks
        columns = columns[:clocks] + [columns[i] for i in order]
    path = _written(writer, folder, columns, units)
    rows = np.arange(seen["time"].size)
    if "removed" in writer.features:
        begin, end = writer.features["removed"]
        rows = np.delete(rows, np.arange(begin, end))
    if "swapped rows" in writer.features:
        at = writer.features["swapped rows"]
        rows[at], rows[at + 1] = rows[at + 1], rows[at]
    writer.truth = {key: values[rows] for key, values in writer.truth.items()}
    seen["time"] = seen["time"][rows]
    return Layout(
        path, writer.features, writer.truth, seen["time"], writer.features["zone known"],
        writer.features["day known"], train,
    )  # fmt: skip


def _add_time(writer: _Writer, time: np.ndarray) -> None:
    kind = writer.pick(
        "time",
        ["iso z", "iso", "offset", "local", "date and clock", "epoch s", "epoch ms", "elapsed",
         "elapsed ms", "parts", "month first", "clock alone"],
    )  # fmt: skip
    stamps = pd.DatetimeIndex(time, tz="UTC")
    features = writer.features
    features["zone known"] = kind in ("iso z", "offset", "epoch s", "epoch ms")
    features["day known"] = kind not in ("elapsed", "elapsed ms", "clock alone")
    comma, language = features["decimal"], features["language"]
    day = "%d.%m.%Y" if language == "de" else "%d/%m/%Y"
    millis = stamps.strftime("%f").str[:3]
    local = stamps.tz_convert("Europe/Zurich")
    if kind == "month first":
        # The thirteenth or later decides.
        features["moved days"] = 10
        local = local + pd.Timedelta(days=10)
    written = {
        "iso z": lambda: stamps.strftime("%Y-%m-%dT%H:%M:%S.") + millis + "Z",
        "iso": lambda: stamps.strftime("%Y-%m-%d %H:%M:%S.") + millis,
        "offset": lambda: local.strftime("%Y-%m-%dT%H:%M:%S.") + millis + "+02:00",
        "local": lambda: local.strftime(f"{day} %H:%M:%S{comma}") + millis,
        "month first": lambda: local.strftime(f"%m/%d/%Y %H:%M:%S{comma}") + millis,
        "date and clock": lambda: stamps.strftime("%H:%M:%S.") + millis,
        "clock alone": lambda: stamps.strftime("%H:%M:%S.") + millis,
        "epoch s": lambda: writer.text(time / 1e9, 3),
        "epoch ms": lambda: [str(t) for t in time // 1_000_000],
        "elapsed": lambda: writer.text((time - time[0]) / 1e9, 1),
        "elapsed ms": lambda: [str(t) for t in (time - time[0]) // 1_000_000],
    }
    if kind == "parts":
        names = {
            "en": ["Year", "Month", "Day", "Hour", "Minute", "Second"],
            "de": ["Jahr", "Monat", "Tag", "Stunde", "Minute", "Sekunde"],
            "fr": ["Année", "Mois", "Jour", "Heure", "Minute", "Seconde"],
        }[language]
        for name, code in zip(names, ["%Y", "%m", "%d", "%H", "%M"], strict=False):
            writer.add(name, "", list(stamps.strftime(code)))
        seconds = stamps.second + stamps.microsecond / 1e6
        writer.add(names[5], "", writer.text(np.asarray(seconds), 1))
        return
    if kind == "date and clock":
        writer.add(writer.name("date"), "", list(stamps.strftime(day)))
    label = "elapsed" if "elapsed" in kind else "clock" if "clock" in kind else "time"
    unit = {"elapsed": "s", "elapsed ms": "ms"}.get(kind, "")
    writer.add(writer.name(label), unit, list(written[kind]()))


def _add_motion(writer: _Writer, seen: dict[str, np.ndarray]) -> None:
    unit = writer.pick("speed", ["km/h", "km/h", "m/s", "mph", "kn"])
    size = UNITS["speed"][unit]
    writer.add(writer.name("speed"), unit, writer.text(seen["speed"] * size, 2))
    writer.truth["speed"] = seen["speed"]
    if writer.pick("odometer", [True, True, True, False]):
        unit = writer.pick("length", ["m", "km", "mi"])
        size = UNITS["length"][unit]
        falling = writer.pick("falling", [False, False, True])
        position = seen["position"]
        shown = 300_000.0 - position if falling else position
        writer.add(
            writer.name("position"), unit, writer.text(shown * size, 1 if unit == "m" else 4)
        )
        writer.truth["position"] = position


def _add_efforts(writer: _Writer, seen: dict[str, np.ndarray]) -> None:
    kind = writer.pick("efforts", ["three", "three", "signed", "signed and air", "none"])
    unit = writer.pick("force", ["kN", "kN", "N", "daN"])
    if kind == "none":
        return
    size = UNITS["force"][unit]
    noise = writer.rng.normal(0.0, 300.0, seen["traction"].size)
    braking = -1.0 if writer.pick("braking negative", [False, True]) else 1.0
    if kind == "three":
        writer.add(writer.name("traction"), unit, writer.text(seen["traction"] * size, 2))
        writer.add(writer.name("dynamic"), unit, writer.text(braking * seen["dynamic"] * size, 2))
    else:
        turned = -1.0 if writer.pick("traction negative", [False, False, True]) else 1.0
        net = (seen["traction"] - seen["dynamic"] + noise) * turned
        writer.add(writer.name("signed"), unit, writer.text(net * size, 2))
    if kind != "signed":
        writer.add(
            writer.name("pneumatic"), unit, writer.text(braking * seen["pneumatic"] * size, 2)
        )
        writer.truth["pneumatic"] = seen["pneumatic"]
    writer.truth["traction"] = seen["traction"]
    writer.truth["dynamic"] = seen["dynamic"]
    if writer.pick("lever", [False, True]):
        scale = writer.pick("lever scale", [1.0, 100.0])
        writer.add(
            writer.name("lever"), "%" if scale > 1.0 else "", writer.text(seen["lever"] * scale, 3)
        )


def _add_wheels(writer: _Writer, seen: dict[str, np.ndarray], train: Train) -> None:
    kind = writer.pick("wheels", ["none", "speeds", "turns", "motor turns"])
    if kind == "none":
        return
    key = "wheel" if kind == "speeds" else "turns"
    label = writer.name(key)
    if kind == "speeds":
        unit = writer.features["speed"]
        size = UNITS["speed"][unit]
    else:
        unit = TURNS[writer.features["language"]]
        size = 60.0 / (2.0 * np.pi * train.axles.wheel_radius)
        size *= 4.37 if kind == "motor turns" else 1.0
    for axle in range(1, train.axles.count + 1):
        writer.add(label.format(axle), unit, writer.text(seen[f"wheel_speed_{axle}"] * size, 2))
    writer.truth["wheel"] = seen["wheel_speed_1"]


def _add_fixes(writer: _Writer, seen: dict[str, np.ndarray]) -> None:
    kind = writer.pick("fixes", ["none", "degrees", "integers", "minutes", "swapped"])
    if kind == "none":
        return
    north, east = seen["latitude"], seen["longitude"]
    if kind == "integers":
        cells = [[str(round(v * 1e7)) for v in values] for values in (north, east)]
    elif kind == "minutes":
        whole = [np.floor(values) * 100.0 + 60.0 * (values % 1.0) for values in (north, east)]
        cells = [writer.text(values, 5) for values in whole]
    else:
        cells = [writer.text(values, 7) for values in (north, east)]
    if kind == "swapped":
        cells.reverse()
    writer.add(writer.name("latitude"), "", cells[0])
    writer.add(writer.name("longitude"), "", cells[1])
    writer.truth["latitude"], writer.truth["longitude"] = north, east
    if writer.pick("altitude", [False, True]):
        writer.add(writer.name("altitude"), "m", writer.text(seen["altitude"], 1))
    if writer.pick("gnss speed", [False, True]):
        unit = writer.pick("gnss unit", ["km/h", "m/s", "kn"])
        size = UNITS["speed"][unit]
        writer.add(writer.name("gnss_speed"), unit, writer.text(seen["gnss_speed"] * size, 2))


def _add_others(writer: _Writer, seen: dict[str, np.ndarray]) -> None:
    rng, count = writer.rng, seen["time"].size
    warm = 60.0 + np.cumsum(rng.normal(0.0, 0.05, count))
    stands = seen["speed"] < 0.3
    limit = np.repeat([22.2, 33.3, 25.0, 40.0], count // 4 + 1)[:count]
    mean = np.cumsum(seen["speed"]) / np.arange(1, count + 1)
    others = {
        "temperature": ("°C", writer.text(warm, 1)),
        "door_state": ("", ["open" if still else "closed" for still in stands]),
        "voltage": ("kV", writer.text(15.0 + rng.normal(0.0, 0.2, count), 2)),
        "number": ("", ["4711"] * count),
        "pressure": ("bar", writer.text(5.0 - 1.2 * (seen["pneumatic"] > 1e3), 2)),
        "current": ("A", writer.text(np.abs(seen["traction"] - seen["dynamic"]) / 400.0, 1)),
        "set": ("km/h", writer.text(0.9 * limit * KMH, 0)),
        "limit": ("km/h", writer.text(limit * KMH, 0)),
        "mean": ("km/h", writer.text(mean * KMH, 1)),
        "remaining": ("m", writer.text(seen["position"].max() - seen["position"], 0)),
        "demand": ("kN", writer.text(np.roll(seen["traction"], -1) / 1e3, 1)),
        "rate": ("m/s²", writer.text(np.gradient(seen["speed"], seen["time"] / 1e9), 3)),
    }
    for key in others:
        if rng.random() < 0.35:
            unit, cells = others[key]
            writer.add(writer.name(key), unit, cells)


def _written(
    writer: _Writer, folder: Path, columns: list[tuple[str, str, list[str]]], units: str
) -> Path:
    features = writer.features
    mark = features["delimiter"]
    labels, spelt = [], []
    for label, unit, _ in columns:
        shown = {
            "brackets": f"{label} [{unit}]", "round brackets": f"{label} ({unit})",
            "suffix": f"{label}_{unit.replace('/', '')}", "slash": f"{label} / {unit}",
        }.get(units, label)  # fmt: skip
        # A lonely "%" or "tr/min" is no suffix.
        plain = units == "suffix" and not unit.replace("/", "").isalpha()
        labels.append(label if not unit or plain else shown)
        spelt.append(f"[{unit}]" if unit and units == "line" else "")
    seen: dict[str, int] = {}
    for place, label in enumerate(labels):
        seen[label] = seen.get(label, 0) + 1
        if seen[label] > 1:
            labels[place] = f"{label} {seen[label]}"
    preamble = writer.pick("preamble", [0, 0, 1, 3])
    lines = [f"Recorder {number + 7}, software 4.{number}" for number in range(preamble)]
    lines.append(mark.join(labels))
    if units == "line":
        lines.append(mark.join(spelt))
    cells = [list(each) for _, _, each in columns]
    _spoil(writer, cells)
    lines += [mark.join(row) for row in zip(*cells, strict=True)]
    lines = _damage(writer, lines, len(lines) - len(cells[0]))
    encoding = writer.pick("encoding", ["utf-8", "utf-8-sig", "cp1252", "utf-16"])
    path = folder / f"run-{features['seed']}.csv"
    path.write_bytes(
        ("\r\n" if writer.pick("crlf", [False, True]) else "\n").join(lines).encode(encoding)
    )
    return path


def _damage(writer: _Writer, lines: list[str], first: int) -> list[str]:
    """What happens to recordings: a gap, a row that was cut off, rows out of order."""
    kind = writer.pick("damage", ["none", "none", "gap", "cut off", "out of order"])
    middle = (first + len(lines)) // 2
    if kind == "gap":
        writer.features["removed"] = (middle - first, middle - first + 20)
        return lines[:middle] + lines[middle + 20 :]
    if kind == "cut off":
        writer.features["removed"] = (len(lines) - first - 1, len(lines) - first)
        return [*lines[:-1], lines[-1][: len(lines[-1]) // 2]]
    if kind == "out of order":
        lines[middle], lines[middle + 1] = lines[middle + 1], lines[middle]
        writer.features["swapped rows"] = middle - first
    return lines


def _spoil(writer: _Writer, cells: list[list[str]]) -> None:
    """Leave out some cells, by the recorder's word for it."""
    word = writer.pick("missing", ["", "NaN", "---", "n/a", "ungültig"])
    for column in cells:
        if len(set(column[:50])) > 2 and writer.rng.random() < 0.3 and ":" not in column[0]:
            for row in writer.rng.choice(len(column) - 1, 5, replace=False) + 1:
                if "-" not in column[0][1:] and "/" not in column[0]:
                    column[row] = word


@dataclass
class Verdict:
    """What a proposal made of a layout.

    Attributes
    ----------
    fields : dict of str to str
        ``"right"``, ``"missing"``, ``"stated"`` (wrong, but stated as open) or ``"wrong"``.
    open : bool
        Whether a right reading of a judged field was stated as open.
    refused : str
        Why there is no proposal.
    """

    layout: Layout
    fields: dict[str, str]
    open: bool = False
    refused: str = ""
    proposal: Proposal | None = None

    @property
    def all_right(self) -> bool:
        return not self.refused and set(self.fields.values()) == {"right"}

    @property
    def silently_wrong(self) -> list[str]:
        return [name for name, how in self.fields.items() if how == "wrong"]

    def __str__(self) -> str:
        bad = {name: how for name, how in self.fields.items() if how != "right"}
        return f"{self.layout.features}: {self.refused or bad}"


def judged(layout: Layout, *, with_train: bool = False) -> Verdict:
    """Propose a profile for a layout and compare what it reads with what happened."""
    try:
        proposal = propose_profile(layout.path, layout.train if with_train else None)
    except InputError as error:
        return Verdict(layout, {}, refused=str(error))
    read = read_parquet if layout.path.suffix == ".parquet" else read_delimited
    table = read(layout.path, proposal.profile).tables[0]
    fields = {"time": _time(layout, table.time, proposal)}
    opened = False
    for key, target in JUDGED.items():
        name = target.removesuffix("_1")
        values = table.signals.get(target)
        if key not in layout.truth:
            continue
        row = proposal.evidence[proposal.evidence["field"] == name]
        stated = bool(len(row)) and bool(row["alternative"].iloc[0])
        if values is None:
            effort = key in ("traction", "dynamic", "pneumatic")
            still = float(np.nanmax(np.abs(layout.truth[key]))) < 2e3
            fields[key] = "right" if effort and still else "missing"
            continue
        good = _same(layout.truth[key], values, key)
        fields[key] = "right" if good else "stated" if stated else "wrong"
        opened |= good and stated
    return Verdict(layout, fields, opened, "", proposal)


def _same(truth: np.ndarray, values: np.ndarray, key: str) -> bool:
    known = np.isfinite(values) & np.isfinite(truth)
    if key == "position":
        # From which zero the recorder counts is its own affair.
        values = values - np.nanmedian(values[known] - truth[known])
    scale = 1e-2 if key in ("latitude", "longitude") else float(np.percentile(np.abs(truth), 95))
    error = np.abs(values[known] - truth[known])
    return bool(known.sum() > 0.8 * truth.size and np.median(error) <= 0.01 * scale) and bool(
        np.percentile(error, 95) <= 0.05 * scale
    )


def _time(layout: Layout, time: np.ndarray, proposal: Proposal) -> str:
    """Times must be right but for what the file does not state, and that must be stated."""
    known = time != NO_TIME
    moved = layout.features.get("moved days", 0) * 86_400_000_000_000
    off = time[known] - layout.time[known] - moved
    opened = {reading.what for reading in proposal.readings if reading.alternative}
    if known.mean() < 0.95 or float(np.ptp(off)) > 2e6:
        return "stated" if "time" in opened else "wrong"
    shift = float(np.median(off)) / 1e9
    if abs(shift) < 0.01:
        return "right"
    if not layout.day_known:
        return "right" if "day" in opened else "wrong"
    if not layout.zone_known and abs(shift) == 7200.0:
        return "right" if "time zone" in opened else "wrong"
    return "stated" if {"date", "time"} & opened else "wrong"


def table(verdicts: list[Verdict]) -> str:
    """How many of the layouts are read how."""
    return "\n".join(
        f"{what}: {sum(bool(how) for how in found) / len(verdicts):.1%}"
        for what, found in {
            "all right": [v.all_right for v in verdicts],
            "of them with a field stated as open": [v.all_right and v.open for v in verdicts],
            "a field not found": ["missing" in v.fields.values() for v in verdicts],
            "refused": [v.refused for v in verdicts],
            "silently wrong": [v.silently_wrong for v in verdicts],
        }.items()
    )


SHARED = Path(__file__).parents[1] / ".." / "shared" / "data"
RECORDER = Path("sample_logs/recorder.csv")
LAYOUTS = range(500, 510)


def drive(count: int = 600, step: float = 1.0) -> pd.DataFrame:
    """A trip of a train of 200 t over level track: speeds up, runs, brakes, three times."""
    seconds = np.arange(count) * step
    rate = (
        0.6
        * np.sign(np.sin(2.0 * np.pi * seconds / 200.0))
        * (np.abs(np.sin(2.0 * np.pi * seconds / 200.0)) > 0.6)
    )
    speed = np.maximum(np.cumsum(rate) * step, 0.0)
    resistance = (3e3 + 60.0 * speed + 8.0 * speed**2) * (speed > 0)
    return pd.DataFrame(
        {
            "t": seconds,
            "v": speed,
            "s": np.cumsum(speed) * step,
            "F": 200e3 * rate + resistance,
        }
    )


def written(folder: Path, columns: dict[str, object], name: str = "run.csv") -> Path:
    path = folder / name
    pd.DataFrame(columns).to_csv(path, index=False, float_format="%.9g")
    return path


def field(proposal: Proposal, name: str) -> dict[str, str]:
    return dict(proposal.evidence.set_index("field").loc[name])


@pytest.fixture(scope="module")
def verdicts(tmp_path_factory: pytest.TempPathFactory) -> list[Verdict]:
    folder = tmp_path_factory.mktemp("layouts")
    return [judged(draw(folder, seed)) for seed in LAYOUTS]


def test_no_layout_is_read_wrongly_without_a_word(verdicts: list[Verdict]) -> None:
    wrong = [str(verdict) for verdict in verdicts if verdict.silently_wrong]
    assert not wrong, table(verdicts) + "\n".join(wrong)


def test_nine_of_ten_layouts_are_read_rightly(verdicts: list[Verdict]) -> None:
    right = sum(verdict.all_right for verdict in verdicts)
    others = [str(verdict) for verdict in verdicts if not verdict.all_right]
    assert right >= 0.9 * len(verdicts), table(verdicts) + "\n".join(others)


@pytest.mark.long
def test_three_hundred_layouts(tmp_path: Path) -> None:
    verdicts = [judged(draw(tmp_path, seed)) for seed in range(3_000, 3_300)]
    wrong = [str(verdict) for verdict in verdicts if verdict.silently_wrong]
    print(table(verdicts))
    assert len(wrong) <= 3, "\n".join(wrong)
    assert sum(verdict.all_right for verdict in verdicts) >= 0.95 * len(verdicts)


def test_every_column_is_used_or_listed(verdicts: list[Verdict]) -> None:
    for verdict in verdicts:
        proposal = verdict.proposal
        assert proposal is not None, verdict.refused
        assert proposal.profile.time is not None
        used = {n for c in proposal.profile.columns.values() for n in c.names}
        used |= set(proposal.profile.time.names)
        used |= set(proposal.profile.trip.columns.names)
        assert used | set(proposal.not_used) == set(proposal.names)


def test_the_sample_recorder_is_ingested_as_with_its_own_profile() -> None:
    proposal = propose_profile(RECORDER)
    assert proposal.profile.time is not None
    zoned = proposal.profile.model_copy(
        update={"time": proposal.profile.time.model_copy(update={"timezone": "Europe/Zurich"})}
    )
    line, train = read_line(sample(DEFAULT_LINE)), read_train(sample(DEFAULT_TRAIN))
    proposed, true = (
        ingest(RECORDER, profile, line=line, train=train, metadata={"load": "12000"})
        for profile in (zoned, "sample_logs/recorder.profile.toml")
    )
    assert list(proposed.topics) == list(true.topics)
    for name, frame in true.topics.items():
        pd.testing.assert_frame_equal(proposed[name], frame)
    assert curve(proposed) == curve(true)


def curve(trip: Trip) -> RunningResistance:
    return fit_trip(trip).resistance


def test_what_the_file_does_not_state_is_open() -> None:
    proposal = propose_profile(RECORDER)
    assert [question.split(":")[0] for question in proposal.open] == ["time zone"]
    assert "# open: or local time" in proposal.text


def test_a_stated_unit_that_contradicts_mechanics_is_open(tmp_path: Path) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "F [kN]": run.F})
    effort = field(propose_profile(path), "/train/controls.tractive_effort")
    assert effort["unit"] == "N"
    assert effort["alternative"] == "kN, as the file states"


def test_the_train_decides_between_units(tmp_path: Path) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "F": run.F})
    unknown = field(propose_profile(path), "/train/controls.tractive_effort")
    assert (unknown["unit"], unknown["alternative"]) == ("N", "daN or lbf")
    train = read_train(sample(DEFAULT_TRAIN))
    known = field(propose_profile(path, train), "/train/controls.tractive_effort")
    assert (known["unit"], known["alternative"]) == ("N", "")


def test_a_table_without_names_is_read_by_what_its_columns_do(tmp_path: Path) -> None:
    run = drive()
    stamps = pd.Timestamp("2024-05-01T06:00:00") + pd.to_timedelta(run.t, unit="s")
    frame = pd.DataFrame({"t": stamps, "x": run.v * 3.6, "y": run.s})
    path = tmp_path / "bare.csv"
    frame.to_csv(path, index=False, header=False, float_format="%.6g")
    trip = ingest(path, propose_profile(path).profile)
    np.testing.assert_allclose(trip["/train/state"]["speed"], run.v, atol=1e-3)
    np.testing.assert_allclose(trip["/train/state"]["position"], run.s, atol=0.1)


@pytest.mark.parametrize(
    ("columns", "remedy"),
    [
        ({"t": "1,0", "v": "2,5"}, "write it with semicolons"),
        ({"t [min]": "1.0", "v [km/h]": "2.5"}, "which a profile cannot read"),
    ],
)
def test_what_no_profile_can_read_is_refused(
    tmp_path: Path, columns: dict[str, str], remedy: str
) -> None:
    rows = [",".join(f'"{number}{cell[1:]}"' for cell in columns.values()) for number in range(50)]
    path = tmp_path / "run.csv"
    path.write_text("\n".join([",".join(columns), *rows]) + "\n")
    with pytest.raises(InputError, match=remedy):
        propose_profile(path)


def test_south_west_in_degrees_and_minutes(tmp_path: Path) -> None:
    run = drive()
    stamps = pd.Timestamp("2024-05-01T06:00:00Z") + pd.to_timedelta(run.t, unit="s")
    path = written(
        tmp_path,
        {
            "time": stamps,
            "lat": 3330.0 + run.s / 1853.25,
            "NS": "S",
            "lon": 7040.0,
            "EW": "W",
            "speed [kn]": run.v * 1.943844,
        },
    )
    fix = ingest(path, propose_profile(path).profile)["/gnss/fix"]
    assert fix["latitude"].iloc[0] == pytest.approx(-33.5)
    assert fix["longitude"].iloc[0] == pytest.approx(-70.0 - 40.0 / 60.0)


def test_a_distance_that_contradicts_the_speed_is_not_used(tmp_path: Path) -> None:
    run = drive()
    noise = np.random.default_rng(1).uniform(0.0, 9_000.0, len(run))
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "Weg [m]": noise})
    proposal = propose_profile(path)
    assert "/train/state.position" not in proposal.profile.columns
    assert "does not follow the speed" in proposal.not_used["Weg [m]"]


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
def test_day_and_month(tmp_path: Path, days: list[str], pattern: str, opened: bool) -> None:
    run = drive()
    half = len(run) // len(days)
    stamps = pd.Timestamp("2024-01-01T23:55:00") + pd.to_timedelta(run.t, unit="s")
    day = [days[min(row // half, len(days) - 1)] for row in range(len(run))]
    if len(days) > 1:
        day = [days[int(stamp.day > 1)] for stamp in stamps]
    else:
        stamps = stamps - pd.Timedelta(hours=5)
    path = written(
        tmp_path,
        {"Date": day, "Time": stamps.dt.strftime("%H:%M:%S"), "Speed [km/h]": run.v * 3.6},
    )
    proposal = propose_profile(path)
    assert proposal.profile.time is not None
    assert proposal.profile.time.format == f"{pattern} %H:%M:%S"
    assert any(question.startswith("date") for question in proposal.open) == opened


@pytest.mark.parametrize("pattern", ["%Y%m%dT%H%M%SZ", "%Y%m%d%H%M%S", "%d-%b-%Y %H:%M:%S"])
def test_times_whose_parts_are_known_by_their_order(tmp_path: Path, pattern: str) -> None:
    truth = pd.date_range("2024-05-01T06:00:00Z", periods=300, freq="s")
    speed = 60.0 + 20.0 * np.sin(np.arange(300) / 30.0)
    rows = [f"{at},{v:.1f}" for at, v in zip(truth.strftime(pattern), speed, strict=True)]
    path = tmp_path / "run.csv"
    path.write_text("Time,Speed [km/h]\n" + "\n".join(rows) + "\n")
    trip = ingest(path, profile=propose_profile(path).profile)
    assert (trip["/train/state"].index == truth).all()


@pytest.mark.parametrize(("zone", "hours"), [("Z", 0), ("z", 0), ("+02", 2), (" -0330", -3.5)])
def test_a_zone_is_known_alike_in_tables_and_tracks(
    tmp_path: Path, zone: str, hours: float
) -> None:
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
    track = tmp_path / "run.gpx"
    track.write_text(f"<gpx><trk><trkseg>{points}</trkseg></trk></gpx>", "utf-8")
    trips = ingest(path, proposal.profile), ingest(track)
    assert {trip.start for trip in trips} == {
        pd.Timestamp("2024-05-01T06:00:00Z") - pd.Timedelta(hours=hours)
    }
    assert trips[1].metadata["clock"] == "GNSS, UTC"


@pytest.mark.parametrize("name", ["ENGINE_RUN_TINE ()", "Run time since engine start [s]"])
@pytest.mark.parametrize("rows", [1, 3])
def test_the_run_time_of_an_engine_is_a_time(tmp_path: Path, name: str, rows: int) -> None:
    """OBD loggers count whole seconds since the start, with one or several rows each."""
    run = drive(300 * rows, 1.0 / rows)
    engine = 50.0 + np.random.default_rng(1).uniform(0.0, 1.0, 300 * rows)
    columns = {name: np.repeat(np.arange(137, 437), rows), "VEHICLE_SPEED ()": 3.6 * run.v}
    path = written(tmp_path, columns | {"Abgastemperatur [°C]": engine})
    state = ingest(path, propose_profile(path).profile)["/train/state"]
    assert len(state) == 300 * rows
    apart = (state.index - state.index[0]).total_seconds().to_numpy()
    assert np.abs(apart - np.arange(300 * rows) / rows).max() < 0.01


def test_parquet_with_typed_times(tmp_path: Path) -> None:
    run = drive()
    path = tmp_path / "run.parquet"
    stamps = pd.Timestamp("2024-05-01T06:00:00Z") + pd.to_timedelta(run.t, unit="s")
    pd.DataFrame({"stamp": stamps, "vitesse": run.v * 3.6, "distance": run.s}).to_parquet(path)
    proposal = propose_profile(path)
    assert field(proposal, "/train/state.speed")["unit"] == "km/h"
    trip = ingest(path, proposal.profile)
    np.testing.assert_allclose(trip["/train/state"]["speed"], run.v, atol=1e-9)


def test_a_timetable_is_no_trip(tmp_path: Path) -> None:
    rows = 40
    path = written(
        tmp_path,
        {
            "Station": [f"S{number}" for number in range(rows)],
            "Arrival": [
                f"{6 + number // 12:02d}:{5 * (number % 12):02d}" for number in range(rows)
            ],
            "km": np.arange(rows) * 4.2,
        },
    )
    with pytest.raises(InputError, match="lie 300 s apart, as in a timetable"):
        propose_profile(path)


@pytest.mark.parametrize("beside", ["fixes", "distance"])
@pytest.mark.parametrize(("unit", "size"), [("km/h", 3.6), ("rpm", 60.0 / (2.0 * np.pi * 0.43))])
def test_wheel_speeds_are_kept_where_no_speed_is_recorded(
    tmp_path: Path, beside: str, unit: str, size: float
) -> None:
    run = drive()
    where = {"lat": 47.0 + run.s / 111_195.0, "lon": 9.0}
    where = where if beside == "fixes" else {"distance [m]": run.s}
    wheels = {f"wheel speed {axle} [{unit}]": run.v * size for axle in (1, 2)}
    path = written(tmp_path, {"t [s]": run.t, **where, **wheels})
    trip = ingest(path, propose_profile(path).profile)
    found = trip["/train/axles"][["wheel_speed_1", "wheel_speed_2"]].to_numpy()
    assert np.abs(found - run.v.to_numpy()[:, None]).max() < 0.02 * run.v.max()


@pytest.mark.parametrize(
    ("delimiter", "thousands", "decimal", "digits"),
    [(",", ",", ".", 1), (";", ".", ",", 1), (";", "'", ".", 0), ("\t", ".", ",", 0)],
)
def test_marks_between_thousands_are_read(
    tmp_path: Path, delimiter: str, thousands: str, decimal: str, digits: int
) -> None:
    run = drive()
    marks = str.maketrans({",": thousands, ".": decimal})
    lines = [delimiter.join(["t [s]", "Speed [km/h]", "Distance [m]"])]
    for second, speed, way in zip(run.t, 3.6 * run.v, run.s, strict=True):
        cells = f"{speed:.1f}".translate(marks), f"{way:,.{digits}f}".translate(marks)
        lines.append(delimiter.join([f"{second:.0f}", cells[0], f'"{cells[1]}"']))
    path = tmp_path / "run.csv"
    path.write_text("\n".join(lines) + "\n", "utf-8")
    profile = propose_profile(path).profile
    position = ingest(path, profile)["/train/state"]["position"]
    assert run.s.max() > 1_000.0
    assert np.abs(position.to_numpy() - run.s.to_numpy()).max() < 0.51
    wrong = profile.model_copy(update={"file": profile.file.model_copy(update={"thousands": ""})})
    if (thousands, digits) != (".", 0):  # else they are read as decimals
        with pytest.raises(InputError, match=f"thousands = .{re.escape(thousands)}. under"):
            ingest(path, wrong)


def test_a_unit_that_no_other_column_shows_is_unproven(tmp_path: Path) -> None:
    run = drive()
    alone = {"t [s]": run.t, "Speed [mph]": 2.23694 * run.v}
    for columns, unproven in ((alone, "/train/state.speed [mph]"), (alone | {"s [m]": run.s}, "")):
        path = written(tmp_path, columns)
        trip = ingest(path, propose_profile(path).profile)
        assert trip.metadata.get("unproven_units", "") == unproven


def test_text_and_tables_without_motion_are_refused(tmp_path: Path) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "Temperature [°C]": 20.0 + run.v})
    with pytest.raises(InputError, match="no column is a speed, a distance or a satellite"):
        propose_profile(path)
    words = tmp_path / "words.txt"
    words.write_text("Dear all,\nthe train was late again.\nRegards\n")
    with pytest.raises(InputError, match="is not a table"):
        propose_profile(words)


def test_a_receiver_under_other_names_is_read_as_the_known_one(tmp_path: Path) -> None:
    lines = Path("sample_logs/gnss.csv").read_text().splitlines()[:4000]
    names = "Jahr,Monat,Tag,Stunde,Minute,Sekunde,Satelliten,Laenge,Breite,Hoehe 1,Hoehe 2,"
    names += "hAcc,vAcc,v,sAcc,PDOP,"
    path = tmp_path / "receiver.csv"
    path.write_text("\n".join([names, *lines[1:]]) + "\n")
    known = tmp_path / "known.csv"
    known.write_text("\n".join(lines) + "\n")
    proposal = propose_profile(path)
    # The receiver has two altitudes; which of them is meant is open.
    assert field(proposal, "/gnss/fix.altitude")["alternative"] == "'Hoehe 2'"
    proposed, true = ingest(path, proposal.profile), ingest(known)
    for topic in ("/gnss/fix", "/gnss/motion"):
        for column in set(true[topic]) & set(proposed[topic]) - {"altitude"}:
            pd.testing.assert_series_equal(proposed[topic][column], true[topic][column])
    assert {"latitude", "longitude", "altitude"} <= set(proposed["/gnss/fix"])


def test_a_user_at_a_terminal_is_asked(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    run = drive()
    path = written(tmp_path, {"t [s]": run.t, "v [km/h]": run.v * 3.6, "s [m]": run.s})
    monkeypatch.setattr("trainlog.cli.ingest._at_terminal", lambda: True)
    refused = CliRunner().invoke(app, ["ingest", str(path), "-o", str(tmp_path / "out")], "n\n")
    assert refused.exit_code == 1
    assert "with " + str(tmp_path / "out" / "run.profile.toml") in " ".join(refused.output.split())
    agreed = CliRunner().invoke(app, ["ingest", str(path), "-o", str(tmp_path / "out")], "y\n")
    assert agreed.exit_code == 0, agreed.output
    assert (tmp_path / "out" / "run.mcap").is_file()


@pytest.mark.skipif(not SHARED.is_dir(), reason="needs the public data")
@pytest.mark.parametrize(
    ("name", "reason"),
    [
        ("creep/eurosprinter_creep_curves.csv", "no column is a time that goes forward"),
        ("aalto/device_data.csv", "does it hold several devices"),
        ("aalto/device_models.csv", "no column is a time that goes forward"),
    ],
)
def test_public_tables_that_are_no_trip(name: str, reason: str) -> None:
    with pytest.raises(InputError, match=reason):
        propose_profile(SHARED / name)


def test_the_command_proposes_and_then_ingests(tmp_path: Path) -> None:
    run = drive()
    (tmp_path / "in").mkdir()
    stamps = pd.Timestamp("2024-05-01T06:00:00") + pd.to_timedelta(run.t, unit="s")
    for number in (1, 2):
        day = stamps + pd.Timedelta(days=number)
        columns = {"Zeit (UTC)": day, "v [km/h]": run.v * 3.6, "Weg [m]": run.s + number}
        path = written(tmp_path / "in", columns, f"run-{number}.csv")
    output = tmp_path / "out"
    command = CliRunner()
    given = ["ingest", str(path), "-o", str(output)]
    options = ["--train", str(sample("CH_Stadler_FLIRT_TPF.train.json")), "--set", "load=12 t"]
    options.append("--reverse")
    stated = command.invoke(app, [*given, *options])
    assert f"-o {output} {shlex.join(options)}" in " ".join(stated.output.split())
    first = command.invoke(app, given)
    assert first.exit_code == 1, first.output
    proposed = output / "run-2.profile.toml"
    assert f"--profile {proposed} -o {output}" in " ".join(first.output.split())
    assert not list(output.glob("*.mcap"))
    again = command.invoke(app, [*given, "--profile", str(proposed)])
    assert again.exit_code == 0, again.output
    # Of a folder, one proposal for all files of a layout.
    whole = command.invoke(
        app, ["ingest", str(tmp_path / "in"), "-o", str(tmp_path / "all"), "--accept", "--json"]
    )
    assert whole.exit_code == 0, whole.output
    assert json.loads(whole.stdout)["counts"]["refused"] == 0
    assert sorted(each.name for each in (tmp_path / "all").iterdir()) == [
        "run-1.mcap",
        "run-1.profile.toml",
        "run-2.mcap",
    ]


@pytest.mark.parametrize("hours", [-4.0, 0.0, 3.0, 5.75])
def test_a_unix_time_beside_a_local_one_decides_its_zone(tmp_path: Path, hours: float) -> None:
    """The column of local time comes first, has tenths of a second, and names no zone."""
    truth = pd.date_range("2024-05-01T20:00:00Z", periods=900, freq="500ms")
    local = (truth + pd.Timedelta(hours=hours)).strftime("%Y-%m-%d %H:%M:%S.%f")
    speed = 60.0 + 20.0 * np.sin(np.arange(900) / 60.0)
    way = np.cumsum(speed / 3.6) * 0.5
    rows = [
        f"{at[:-5]},{unix + 1},{v:.1f},{s:.0f}"
        for at, unix, v, s in zip(local, truth.as_unit("ns").asi8 // 10**9, speed, way, strict=True)
    ]
    path = tmp_path / "run.csv"
    path.write_text("local_datetime,unix,speed [km/h],distance [m]\n" + "\n".join(rows) + "\n")
    proposal = propose_profile(path)
    trip = ingest(path, profile=proposal.profile)
    assert trip.start == truth[0]
    assert not any("time zone" in question for question in proposal.open)
