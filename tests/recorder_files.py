"""Files of the recorders met in the field, with their defects: pure functions of a seed."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import pandas as pd

START = pd.Timestamp("2024-05-01T06:00:00Z").value
SECOND = 1_000_000_000


@dataclass(frozen=True)
class Drive:
    """A drive over smooth ground: what a receiver with no errors would tell."""

    time: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    altitude: np.ndarray
    speed: np.ndarray
    hdop: np.ndarray
    satellites: np.ndarray

    def __len__(self) -> int:
        return self.time.size

    def take(self, index: np.ndarray) -> Drive:
        return Drive(*(getattr(self, name)[index] for name in self.__dataclass_fields__))


def drive(count: int, rate: float, seed: int = 0) -> Drive:
    """A train going east at 5 to 35 m/s, `rate` fixes a second."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(count) / rate
    phase = rng.uniform(0.0, 6.0)
    speed = 20.0 + 15.0 * np.sin(0.02 * seconds + phase)
    distance = 20.0 * seconds + 750.0 * (np.cos(phase) - np.cos(0.02 * seconds + phase))
    return Drive(
        START + np.round(seconds * SECOND).astype(np.int64),
        np.round(47.4 + 0.01 * np.sin(distance / 5e3), 7),
        np.round(9.3 + distance / 75_300.0, 7),
        np.round(600.0 + 0.01 * distance, 1),
        np.round(speed, 2),
        np.round(rng.uniform(0.7, 2.5, count), 1),
        rng.integers(5, 14, count),
    )


@dataclass
class Recorded:
    """A file and what is wrong with it."""

    text: str
    truth: Drive
    """The samples that the file still holds, in the order of time."""
    defects: dict[str, int] = field(default_factory=dict)


def stamps(time: np.ndarray, offset: str = "Z") -> list[str]:
    shift = pd.Timedelta(0) if offset == "Z" else pd.Timedelta(offset.lstrip("+") + ":00")
    local = pd.DatetimeIndex(time) + shift
    return [f"{text}{offset}" for text in local.strftime("%Y-%m-%dT%H:%M:%S")]


EXTENSIONS = {
    "1.0": "<speed>{v}</speed>",
    "garmin": (
        "<extensions><gpxtpx:TrackPointExtension><gpxtpx:speed>{v}</gpxtpx:speed>"
        "</gpxtpx:TrackPointExtension></extensions>"
    ),
    "osmand": "<extensions><osmand:speed>{v}</osmand:speed></extensions>",
    "plain": "<extensions><speed>{v}</speed></extensions>",
    "none": "",
}
"""Where GPX files keep the speed."""


def gpx_text(
    run: Drive,
    *,
    speed: str = "1.0",
    offset: str = "Z",
    parts: list[list[np.ndarray]] | None = None,
) -> str:
    """A GPX file; `parts` are the indexes of the points of each segment of each track."""
    version = "1.0" if speed == "1.0" else "1.1"
    told = stamps(run.time, offset)
    points = [
        f'<trkpt lat="{run.latitude[i]:.7f}" lon="{run.longitude[i]:.7f}">'
        f"<ele>{run.altitude[i]:.1f}</ele><time>{told[i]}</time>"
        + (f"<speed>{run.speed[i]:.2f}</speed>" if speed == "1.0" else "")
        + f"<sat>{run.satellites[i]}</sat><hdop>{run.hdop[i]:.1f}</hdop><vdop>1.5</vdop>"
        + (EXTENSIONS[speed].format(v=f"{run.speed[i]:.2f}") if speed != "1.0" else "")
        + "</trkpt>"
        for i in range(len(run))
    ]
    tracks = []
    for number, segments in enumerate(parts or [[np.arange(len(run))]], start=1):
        body = "\n</trkseg><trkseg>\n".join("\n".join(points[i] for i in s) for s in segments)
        tracks.append(f"<trk><name>track {number}</name><trkseg>\n{body}\n</trkseg></trk>")
    spaces = (
        f' xmlns="http://www.topografix.com/GPX/{version.replace(".", "/")}"'
        ' xmlns:gpxtpx="http://www.garmin.com/xmlschemas/TrackPointExtension/v2"'
        ' xmlns:osmand="https://osmand.net"'
    )
    return (
        f'<?xml version="1.0" encoding="UTF-8"?>\n<gpx version="{version}" creator="logger 7"'
        f'{spaces}>\n<wpt lat="47.0" lon="9.0"><name>station</name></wpt>\n'
        + "\n".join(tracks)
        + "\n</gpx>\n"
    )


def gpx(seed: int, *, speed: str = "1.0", offset: str = "Z") -> Recorded:
    """30 minutes at 1 Hz: up to 30 time stamps run backwards, gaps of up to 1700 s."""
    rng = np.random.default_rng(seed)
    run = drive(5000, 1.0, seed)
    keep = np.ones(len(run), dtype=bool)
    gaps = rng.integers(1, 3)
    for gap in range(gaps):
        begin = 1000 + 2000 * gap + rng.integers(0, 100)
        keep[begin : begin + rng.integers(30, 1700)] = False
    truth = run.take(np.flatnonzero(keep))
    order = np.arange(len(truth))
    step = np.diff(truth.time)
    calm = [i for i in range(5, len(truth) - 5, 8) if step[i - 2 : i + 3].max() == SECOND]
    swaps = rng.choice(calm, rng.integers(1, 31), replace=False)
    for place in swaps:
        order[[place, place + 1]] = order[[place + 1, place]]
    text = gpx_text(truth.take(order), speed=speed, offset=offset)
    return Recorded(text, truth, {"time_backwards": swaps.size, "gaps": int(gaps)})


MTK_HEADER = "Year,Month,Day,Hour,Minute,Second,nSAT,Lon,Lat,Alt,Speed,HDOP"


def mtk(seed: int, *, before: int = 3000, scaled: bool = False) -> Recorded:
    """3 minutes at 10 Hz with whole seconds; before the first fix the date is 2000,0,0."""
    rng = np.random.default_rng(seed)
    truth = drive(1800, 10.0, seed)
    rows = [f"2000,0,0,0,0,{i // 10 % 60},0,0,0,0,0,9999" for i in range(before)]
    for i, stamp in enumerate(pd.DatetimeIndex(truth.time)):
        place = (truth.longitude[i], truth.latitude[i])
        lon, lat = (f"{round(1e7 * x)}" if scaled else f"{x:.7f}" for x in place)
        rows.append(
            f"{stamp.year},{stamp.month},{stamp.day},{stamp.hour},{stamp.minute},{stamp.second},"
            f"{truth.satellites[i]},{lon},{lat},{truth.altitude[i]:.1f},{truth.speed[i]:.2f},"
            f"{round(100 * truth.hdop[i])}"
        )
    wild = before + rng.choice(np.arange(50, 1750, 20), rng.integers(1, 6), replace=False)
    for place in wild:
        cells = rows[place].split(",")
        cells[10] = "80.00"
        rows[place] = ",".join(cells)
    text = "\n".join([MTK_HEADER, *rows]) + "\n"
    return Recorded(text, truth, {"before_first_fix": before, "spikes": wild.size})
