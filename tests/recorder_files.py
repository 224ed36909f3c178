"""Files of the recorders met in the field, with their defects: pure functions of a seed."""

from dataclasses import dataclass, field, replace

import numpy as np
import pandas as pd

START = pd.Timestamp("2024-05-01T06:00:00Z").value
SECOND = 1_000_000_000


@dataclass(frozen=True)
class Drive:
    """A drive over smooth ground: what a receiver with no errors would give."""

    time: np.ndarray
    latitude: np.ndarray
    longitude: np.ndarray
    altitude: np.ndarray
    speed: np.ndarray
    hdop: np.ndarray
    satellites: np.ndarray

    def __len__(self) -> int:
        return self.time.size

    def take(self, index):
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
        np.round(600.0 + 0.01 * distance, 3),
        np.round(speed, 2),
        np.round(rng.uniform(0.7, 2.5, count), 1),
        rng.integers(5, 14, count),
    )


@dataclass
class Recorded:
    """A file and what is wrong with it."""

    text: str
    truth: Drive  # the samples that the file still holds, in the order of time
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
}  # where GPX files keep the speed


def gpx_text(run, *, speed="1.0", offset="Z", parts=None):
    """A GPX file; `parts` are the indexes of the points of each segment of each track."""
    version = "1.0" if speed == "1.0" else "1.1"
    stated = stamps(run.time, offset)
    points = [
        f'<trkpt lat="{run.latitude[i]:.7f}" lon="{run.longitude[i]:.7f}">'
        f"<ele>{run.altitude[i]:.3f}</ele><time>{stated[i]}</time>"
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


def mtk_rows(run: Drive, scaled: bool = False) -> list[str]:
    """The rows of an MTK logger: whole seconds, however many rows there are in one."""
    rows = []
    for i, stamp in enumerate(pd.DatetimeIndex(run.time)):
        place = (run.longitude[i], run.latitude[i])
        lon, lat = (f"{round(1e7 * x)}" if scaled else f"{x:.7f}" for x in place)
        rows.append(
            f"{stamp.year},{stamp.month},{stamp.day},{stamp.hour},{stamp.minute},{stamp.second},"
            f"{run.satellites[i]},{lon},{lat},{run.altitude[i]:.3f},{run.speed[i]:.2f},"
            f"{round(100 * run.hdop[i])}"
        )
    return rows


UBLOX_HEADER = (
    "Year,Month,Day,Hour,Minute,Second,nSAT,Lon,Lat,Alt1,Alt2,hAcc,vAcc,speed,speedAcc,PDOP,"
)


def ublox_text(run: Drive, before: tuple[str, ...] | list[str] = ()) -> str:
    """The file of a u-blox logger: whole seconds, places and sizes as whole numbers."""
    rows = [
        f"{t.year},{t.month},{t.day},{t.hour},{t.minute},{t.second},{run.satellites[i]},"
        f"{round(1e7 * run.longitude[i])},{round(1e7 * run.latitude[i])},"
        f"{round(1e3 * run.altitude[i])},{round(1e3 * run.altitude[i])},3000,5000,"
        f"{round(1e3 * run.speed[i])},100,{round(100 * run.hdop[i])},"
        for i, t in enumerate(pd.DatetimeIndex(run.time))
    ]
    return "\n".join([UBLOX_HEADER, *before, *rows]) + "\n"


def mtk(seed: int, *, before: int = 3000, scaled: bool = False) -> Recorded:
    """3 minutes at 10 Hz with whole seconds; before the first fix the date is 2000,0,0."""
    rng = np.random.default_rng(seed)
    truth = drive(1800, 10.0, seed)
    rows = [f"2000,0,0,0,0,{i // 10 % 60},0,0,0,0,0,9999" for i in range(before)]
    rows += mtk_rows(truth, scaled)
    wild = before + rng.choice(np.arange(50, 1750, 20), rng.integers(1, 6), replace=False)
    for place in wild:
        cells = rows[place].split(",")
        cells[10] = "80.00"
        rows[place] = ",".join(cells)
    text = "\n".join([MTK_HEADER, *rows]) + "\n"
    return Recorded(text, truth, {"before_first_fix": before, "spikes": wild.size})


def mtk_at_rest(seed: int, *, moving: int = 60, resting: int = 400, again: float = 0.6) -> Recorded:
    """At 10 Hz, a drive and a longer rest in which rows repeat the row before at random."""
    rng = np.random.default_rng(seed)
    run = drive(10 * (moving + resting), 10.0, seed)
    source = np.arange(len(run))
    rest = np.arange(10 * moving, len(run))
    source[rest] = np.where(rng.random(rest.size) < again, -1, rest)
    source = np.maximum.accumulate(source)
    held = run.take(np.minimum(source, 10 * moving))
    # What a receiver at rest still reports is noise.
    jitter = 1e-7 * rng.integers(-9, 9, len(run))[source] * (source >= 10 * moving)
    latitude = np.round(held.latitude + jitter, 7)
    speed = held.speed * (source < 10 * moving)
    truth = replace(held, time=run.time, latitude=latitude, speed=speed)
    return Recorded("\n".join([MTK_HEADER, *mtk_rows(truth)]) + "\n", truth)


def checked(body: str) -> str:
    """An NMEA sentence with its checksum."""
    total = 0
    for character in body.encode("ascii"):
        total ^= character
    return f"${body}*{total:02X}"


def _degrees(value: float, width: int) -> str:
    whole = int(abs(value))
    return f"{whole:0{width}d}{60.0 * (abs(value) - whole):09.6f}"


def nmea_lines(run, kinds=("RMC", "GGA", "GST", "VTG", "GSV")):
    """The sentences of each fix, one fix after the other."""
    lines = []
    for i, stamp in enumerate(pd.DatetimeIndex(run.time)):
        of_day = stamp.strftime("%H%M%S.") + f"{stamp.microsecond // 10_000:02d}"
        place = f"{_degrees(run.latitude[i], 2)},N,{_degrees(run.longitude[i], 3)},E"
        knots = run.speed[i] * 3600.0 / 1852.0
        sentences = {
            "RMC": f"GNRMC,{of_day},A,{place},{knots:.6f},90.0,{stamp:%d%m%y},,,A",
            "GGA": (
                f"GNGGA,{of_day},{place},1,{run.satellites[i]:02d},{run.hdop[i]:.1f},"
                f"{run.altitude[i]:.3f},M,47.9,M,,"
            ),
            "GNS": (
                f"GNGNS,{of_day},{place},AN,{run.satellites[i]:02d},{run.hdop[i]:.1f},"
                f"{run.altitude[i]:.3f},47.9,,"
            ),
            "GST": f"GNGST,{of_day},5.0,,,,3.0,4.0,6.0",
            "VTG": f"GNVTG,90.0,T,,M,{knots:.6f},N,{3.6 * run.speed[i]:.6f},K,A",
            "ZDA": f"GNZDA,{of_day},{stamp:%d,%m,%Y},00,00",
            "GSV": "GPGSV,1,1,01,07,79,048,42",
        }
        lines += [checked(sentences[kind]) for kind in kinds]
    return lines


def ubx(kind: bytes, payload: bytes) -> bytes:
    body = kind + len(payload).to_bytes(2, "little") + payload
    first = second = 0
    for octet in body:
        first = (first + octet) & 0xFF
        second = (second + first) & 0xFF
    return b"\xb5\x62" + body + bytes((first, second))


ACKNOWLEDGED = ubx(b"\x05\x01", b"\x06\x8a")


def nav_pvt(run: Drive, i: int, *, valid: bool = True, fixed: bool = True) -> bytes:
    """UBX-NAV-PVT of a fix, its time rounded to seconds and the rest in `nano`."""
    import struct

    stamp = pd.Timestamp(run.time[i]).round("s")
    nano = int(run.time[i] - stamp.value)
    payload = struct.pack(
        "<IHBBBBBBIiBBBBiiiiIIiiiiiIIHHIiHH",
        0, stamp.year, stamp.month, stamp.day, stamp.hour, stamp.minute, stamp.second,
        7 if valid else 0, 30, nano, 3 if fixed else 0, 1 if fixed else 0, 0,
        int(run.satellites[i]), round(1e7 * run.longitude[i]), round(1e7 * run.latitude[i]),
        round(1e3 * run.altitude[i]) + 47_900, round(1e3 * run.altitude[i]), 2_000, 3_000,
        0, 0, 0, round(1e3 * run.speed[i]), 0, 100, 0, 130, 0, 0, 0, 0, 0,
    )  # fmt: skip
    return ubx(b"\x01\x07", payload)


def since_start(nanoseconds: int) -> str:
    """``HH:MM:SS.ffffff``."""
    seconds, micro = divmod(nanoseconds // 1_000, 1_000_000)
    return f"{seconds // 3600:02d}:{seconds // 60 % 60:02d}:{seconds % 60:02d}.{micro:06d}"


@dataclass
class HexLines:
    """A file of hex lines, and what its samples were."""

    text: str
    fixes: Drive
    utc: np.ndarray  # true time of the samples of the IMU [ns]
    words: np.ndarray  # (n, 6) their words


def hexlines(seed: int, seconds: int = 30, rate: int = 100, drift: float = 20e-6) -> HexLines:
    """IMU at `rate`, fixes at 1 Hz from the fifth second on, lines out of order by up to 0.4 s."""
    rng = np.random.default_rng(seed)
    fixes = drive(seconds, 1.0, seed)
    count = seconds * rate
    utc = START + (np.arange(count) * (SECOND // rate)).astype(np.int64)
    words = rng.integers(-3000, 3000, (count, 6)).astype("<i2")
    logger = 43_000_000_000 + ((utc - START) * (1.0 + drift)).astype(np.int64)
    lines = [
        (stamp + rng.uniform(0.0, 2e8), f"{since_start(int(stamp))},I,{row.tobytes().hex()}")
        for stamp, row in zip(logger, words, strict=True)
    ]
    for i in range(len(fixes)):
        stamp = 43_000_000_000 + int((fixes.time[i] - START) * (1.0 + drift)) + 1_000
        message = nav_pvt(fixes, i, valid=i >= 5, fixed=i >= 5)
        lines.append((stamp + 4e8, f"{since_start(stamp)},U,{message.hex()}"))
        lines.append((stamp + 4e8, f"{since_start(stamp)},U,{ACKNOWLEDGED.hex()}"))
    lines.sort(key=lambda line: line[0])
    text = "\n".join(line for _, line in lines) + "\n"
    return HexLines(text, fixes.take(np.arange(5, seconds)), utc, words)
