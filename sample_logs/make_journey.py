"""Make the sample journey of SFERA 4.00 from the sample line and train.

    python sample_logs/make_journey.py -o sample_logs/CH_StGallen_Wil.sfera.zip

A segment from station to station, every second one against its direction. The timetable is that of
the sample trip without stops.
"""

from __future__ import annotations

import argparse
import datetime
from collections.abc import Sequence
from itertools import pairwise
from pathlib import Path
from zipfile import ZIP_DEFLATED, ZipFile, ZipInfo

import numpy as np

from trainlog.formats.files import atomic_write
from trainlog.formats.railml import Element
from trainlog.formats.railway import read_line, read_train
from trainlog.formats.sfera_messages import new, utc, xml_of
from trainlog.railway import Line, Train
from trainlog.railway.line import station_at
from trainlog.units import KMH

DEPARTURE = datetime.datetime(2026, 5, 17, 6, 30, tzinfo=datetime.UTC)
RUNNING_TIME = 1_185.0


def documents_of(line: Line, cuts: Sequence[float], train: Train | None = None) -> dict[str, bytes]:
    """The journey, its segments and the characteristics of its train, by file name."""
    edges = [0.0, *cuts, line.length]
    found, references = dict[str, bytes](), list[Element]()
    for number, (begin, end) in enumerate(pairwise(edges)):
        backwards = number % 2 == 1
        part = line.section(begin, end)
        part = part.reversed() if backwards else part
        places = {"first": begin} if end < line.length else {"first": begin, "last": end}
        names = {which: station_at(line, at) for which, at in places.items()}
        name = f"S{number}"
        found[f"segment-{number}.xml"] = xml_of(_segment(name, part, names, backwards=backwards))
        stated = {"SP_ID": name, "SP_VersionMajor": "1"}
        if backwards:
            stated["SP_Direction"] = "Reverse"
        references.append(new("SegmentProfileReference", stated, _zone()))
    _calls(references)
    if train is not None:
        company = new("TC_RU_ID", content="1099")
        of = {"TC_ID": "unit", "TC_VersionMajor": "1", "TC_VersionMinor": "0"}
        references[0].children.append(new("TrainCharacteristicsRef", of, company))
        found["train.xml"] = xml_of(_characteristics(train))
    number_of = new(
        "OTN_ID", None, new("teltsi_Company", content="1099"),
        new("teltsi_OperationalTrainNumber", content="17"),
        new("teltsi_StartDate", content="2026-05-17"),
    )  # fmt: skip
    about = {"JP_Status": "Valid", "JP_Version": "1"}
    profile = new("JourneyProfile", about, new("TrainIdentification", None, number_of), *references)
    return found | {"journey.xml": xml_of(profile)}


def write_journey(folder: Path, line: Line, cuts: Sequence[float], train: Train) -> Path:
    """The documents in a folder."""
    folder.mkdir(exist_ok=True)
    for name, data in documents_of(line, cuts, train).items():
        (folder / name).write_bytes(data)
    return folder


def _zone() -> Element:
    return new("SP_Zone", None, new("IM_ID", content="0099"))


def _calls(references: list[Element]) -> None:
    """Departure at the first segment's begin, arrival at the last one's end."""
    leaves, arrives = (utc(DEPARTURE + datetime.timedelta(seconds=s)) for s in (0.0, RUNNING_TIME))
    departure = new("StoppingPointDepartureDetails", {"departureTime": leaves})
    rows = [(references[0], "first", {}, [departure])]
    rows.append((references[-1], "last", {"TP_latestArrivalTime": arrives}, []))
    for reference, which, times, children in rows:
        point = new("TP_ID_Reference", {"TP_ID": f"{reference.text('SP_ID')}-{which}"})
        stated = {"TP_StopSkipPass": "Stopping_Point", **times}
        place = new("TimingPointReference", None, point)
        reference.children.append(new("TimingPointConstraints", stated, place, *children))


def _segment(name: str, line: Line, names: dict[str, str], *, backwards: bool) -> Element:
    """A line as a segment in its own direction, with the names at its ends as it is run over."""
    points = list[Element]()
    for which, station in names.items():
        at = line.length if (which == "last") != backwards else 0.0
        called = [new("TP_Name", {"name": station})] if station else []
        stated = {"TP_ID": f"{name}-{which}", "location": f"{at:.10g}"}
        points.append(new("TimingPoint", stated, *called))
    limits, gradients = line.speed_limits, line.gradients
    speeds = new("StaticSpeedProfile")
    for at, value in zip(limits.positions.tolist(), limits.values.tolist(), strict=True):
        tag = "StaticSpeedProfileChange" if at else "StaticSpeedProfileStart"
        where = {"location": f"{at:.10g}"} if at else {}
        speeds.children.append(new(tag, {"SSP_Speed": f"{KMH * value:.10g}", **where}))
    slopes = new("Gradient")
    for at, value in zip(gradients.positions.tolist(), gradients.start.tolist(), strict=True):
        where = {"location": f"{at:.10g}"} if at else {}
        way = {"gradientDirection": "Uphill" if value >= 0.0 else "Downhill"}
        stated = {"gradientValue": f"{1e3 * abs(value):.10g}", **way, **where}
        slopes.children.append(new("GradientChange" if at else "GradientStart", stated))
    about = {"SP_ID": name, "SP_VersionMajor": "1", "SP_Length": f"{line.length:.10g}"}
    return new(
        "SegmentProfile", about, _zone(), new("SP_Points", None, *points),
        new("SP_Characteristics", None, speeds, slopes), *_kilometres(line),
    )  # fmt: skip


def _kilometres(line: Line) -> list[Element]:
    if line.reference is None:
        return []
    at = np.array([0.0, line.length])
    km = line.reference.at(at, line.length) / 1e3
    stones = [
        new(
            "KilometreReferencePoint", {"location": f"{place:.10g}"},
            new("KM_Reference", {"kmRef": f"{value:.10g}"}),
        )
        for place, value in zip(at.tolist(), km.tolist(), strict=True)
    ]  # fmt: skip
    return [new("SP_ContextInformation", None, *stones)]


def _characteristics(train: Train) -> Element:
    speeds = np.linspace(0.0, train.max_speed, 30)
    points = [
        new(
            "TractionForceCurveDataPoint",
            {"speed": f"{KMH * v:.6g}", "tractionForce": f"{f:.6g}"},
        )
        for v, f in zip(speeds.tolist(), train.tractive_effort_limit(speeds).tolist(), strict=True)
    ]
    supply = new("Electrical", {"voltageValue": "15000", "frequency": "16.7"})
    curve = new("TractionForceCurve", None, *points, new("TFC_TractionType", None, supply))
    features = {
        "trainLength": "75",
        "trainWeight": f"{train.mass / 1e3:.0f}",
        "trainMaxSpeed": f"{KMH * train.max_speed:.0f}",
        "rotatingMassFactor": f"{1.0 + train.rotating_mass_factor:.4g}",
        "rolloutCoefficientA": f"{train.resistance.r0:.6g}",
        "rolloutCoefficientB": f"{train.resistance.r1:.6g}",
        "rolloutCoefficientC": f"{train.resistance.r2:.6g}",
    }
    about = {"TC_ID": "unit", "TC_VersionMajor": "1", "TC_VersionMinor": "0"}
    company = new("TC_RU_ID", content="1099")
    return new("TrainCharacteristics", about, company, new("TC_Features", features, curve))


def main() -> None:
    """The command at the top."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    output = parser.parse_args().output
    line, train = read_line("sample"), read_train("sample")
    cuts = [each.position for each in line.stations[1:-1]]
    with atomic_write(output) as path, ZipFile(path, "w", ZIP_DEFLATED) as archive:
        for name, data in documents_of(line, cuts, train).items():
            # The same bytes whenever it is made.
            archive.writestr(ZipInfo(name), data, ZIP_DEFLATED)


if __name__ == "__main__":
    main()
