"""Recorders' tables of many layouts, drawn at random, and whether a proposed profile reads them.

The words here are a recorder's maker's choice; nothing is taken from the proposal's vocabulary. A
field counts as right if the values that it gives are those of the trip, not if its words are.
"""

from __future__ import annotations

import io
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from simulated_line import KMH, flirt, hilly_line

from trainlog.errors import InputError
from trainlog.formats.railway import read_line
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.ingest import NO_TIME, Proposal, propose_profile
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
    columns: dict[str, str] = field(default_factory=dict)


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
    comma = features["decimal"]
    words = {"de": "%d.%m.%Y", "fr": "%d/%m/%Y", "en": "%d/%m/%Y"}
    day = words[features["language"]]
    millis = stamps.strftime("%f").str[:3]
    if kind == "iso z":
        writer.add(
            writer.name("time"), "", list(stamps.strftime("%Y-%m-%dT%H:%M:%S.") + millis + "Z")
        )
    elif kind == "iso":
        writer.add(writer.name("time"), "", list(stamps.strftime("%Y-%m-%d %H:%M:%S.") + millis))
    elif kind == "offset":
        local = stamps.tz_convert("Europe/Zurich")
        writer.add(
            writer.name("time"), "", list(local.strftime("%Y-%m-%dT%H:%M:%S.") + millis + "+02:00")
        )
    elif kind in ("local", "month first"):
        local = stamps.tz_convert("Europe/Zurich")
        pattern = "%m/%d/%Y" if kind == "month first" else day
        if kind == "month first":
            # The thirteenth or later decides.
            features["moved days"] = 10
            local = local + pd.Timedelta(days=10)
        writer.add(
            writer.name("time"), "", list(local.strftime(f"{pattern} %H:%M:%S{comma}") + millis)
        )
    elif kind == "date and clock":
        writer.add(writer.name("date"), "", list(stamps.strftime(day)))
        writer.add(writer.name("clock"), "", list(stamps.strftime("%H:%M:%S.") + millis))
    elif kind == "epoch s":
        writer.add(writer.name("time"), "", writer.text(time / 1e9, 3))
    elif kind == "epoch ms":
        writer.add(writer.name("time"), "", [str(t) for t in time // 1_000_000])
    elif kind == "elapsed":
        writer.add(writer.name("elapsed"), "s", writer.text((time - time[0]) / 1e9, 1))
    elif kind == "elapsed ms":
        writer.add(writer.name("elapsed"), "ms", [str(t) for t in (time - time[0]) // 1_000_000])
    elif kind == "clock alone":
        writer.add(writer.name("clock"), "", list(stamps.strftime("%H:%M:%S.") + millis))
    else:
        parts = {
            "en": ["Year", "Month", "Day", "Hour", "Minute", "Second"],
            "de": ["Jahr", "Monat", "Tag", "Stunde", "Minute", "Sekunde"],
            "fr": ["Année", "Mois", "Jour", "Heure", "Minute", "Seconde"],
        }[features["language"]]
        for name, code in zip(parts, ["%Y", "%m", "%d", "%H", "%M"], strict=False):
            writer.add(name, "", list(stamps.strftime(code)))
        seconds = stamps.second + stamps.microsecond / 1e6
        writer.add(parts[5], "", writer.text(np.asarray(seconds), 1))


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
    """The shares, in words."""
    buffer = io.StringIO()
    count = len(verdicts)
    right = sum(v.all_right for v in verdicts)
    wrong = [v for v in verdicts if v.silently_wrong]
    refused = [v for v in verdicts if v.refused]
    print(f"{count} layouts: all right {right / count:.1%}", file=buffer)
    opened = sum(v.all_right and v.open for v in verdicts)
    print(f"  of them with a field stated as open {opened / count:.1%}", file=buffer)
    stated = sum(not v.silently_wrong and "stated" in v.fields.values() for v in verdicts)
    print(f"wrong but stated as open {stated / count:.1%}", file=buffer)
    missing = sum("missing" in v.fields.values() for v in verdicts)
    print(f"a field not found (listed as not used) {missing / count:.1%}", file=buffer)
    print(f"refused {len(refused) / count:.1%}", file=buffer)
    print(f"silently wrong {len(wrong) / count:.1%}", file=buffer)
    return buffer.getvalue()
