"""Format ``ublox``: the CSV that u-blox receivers' loggers write, five rows a second.

``Year,Month,Day,Hour,Minute,Second,nSAT,Lon,Lat,Alt1,Alt2,hAcc,vAcc,speed,speedAcc,PDOP,`` in the
receiver's own integers (UBX-NAV-PVT): 1e-7 degrees, millimetres, millimetres a second, PDOP times
100. Time has whole seconds only; the rule ``subsecond`` rebuilds the rest.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from trainlog.ingest.mapping import recording_of
from trainlog.ingest.profile import PROFILE_FORMAT, Column, Profile, TimeOptions
from trainlog.ingest.recording import Recording
from trainlog.ingest.tabular import open_text

TIME = ("Year", "Month", "Day", "Hour", "Minute", "Second")

LAYOUT = Profile(
    format=PROFILE_FORMAT,
    version=1,
    name="u-blox CSV",
    time=TimeOptions(columns=TIME, format="parts"),
    columns={
        "/gnss/fix.latitude": Column(column="Lat", unit="deg", scale=1e-7),
        "/gnss/fix.longitude": Column(column="Lon", unit="deg", scale=1e-7),
        # Alt1 is above the ellipsoid, Alt2 above mean sea level.
        "/gnss/fix.altitude": Column(column="Alt2", unit="mm"),
        "/gnss/fix.horizontal_accuracy": Column(column="hAcc", unit="mm"),
        "/gnss/fix.vertical_accuracy": Column(column="vAcc", unit="mm"),
        "/gnss/motion.speed": Column(column="speed", unit="mm/s"),
        "/gnss/motion.speed_accuracy": Column(column="speedAcc", unit="mm/s"),
        "/gnss/motion.satellites": Column(column="nSAT"),
        "/gnss/motion.pdop": Column(column="PDOP", scale=0.01),
    },
)
"""What the columns mean, in the words of a profile."""


def is_ublox(head: bytes) -> bool:
    """Whether a file begins with the header of this layout."""
    names = head.split(b"\n", 1)[0].removeprefix(b"\xef\xbb\xbf").decode("latin-1").split(",")
    return [name.strip() for name in names][: len(TIME) + 1] == [*TIME, "nSAT"]


def read_ublox(path: Path, profile: Profile | None) -> Recording:  # noqa: ARG001
    """Read a u-blox CSV; of a profile only what is not about columns is used, and that later.

    Raises
    ------
    InputError
        If the file does not hold the layout's columns.
    """
    text = open_text(path, LAYOUT.file)
    assert LAYOUT.time is not None
    names = [*TIME, *(name for column in LAYOUT.columns.values() for name in column.names)]
    found = recording_of(text.cells(names), LAYOUT, path)
    return replace(found, metadata={"clock": "GNSS, UTC"})
