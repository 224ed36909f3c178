"""SFERA: journeys in, advice and what was learned out; documents of our own."""

from __future__ import annotations

import datetime
import os
import re
from collections.abc import Callable
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from refusals import refused

from trainlog import InputError, Line, RunningResistance, Station, StepProfile, read_line
from trainlog.formats.railml import Element, parsed_xml
from trainlog.formats.sfera import SferaJourney, filled, read_sfera
from trainlog.formats.sfera_messages import (
    Constraint,
    Report,
    status_report,
    with_constraints,
    with_resistance,
    xml_of,
)
from trainlog.ingest import ingest

FILES = sorted((Path(__file__).parent / "data" / "sfera").glob("*.xml"))
DOCUMENTS = {each.stem: each.read_text("utf-8") for each in FILES}
"""A journey over segments A, B in reverse, and C; the characteristics of its train."""
A, B, C, JOURNEY, UNIT = DOCUMENTS.values()


def folder_with(folder: Path, **changed: str) -> Path:
    for name, text in (DOCUMENTS | changed).items():
        if text:
            (folder / f"{name}.xml").write_text(text, "utf-8")
    return folder


@pytest.fixture
def found(tmp_path: Path) -> SferaJourney:
    (journey,) = read_sfera(folder_with(tmp_path))
    return journey


def test_line_timetable_and_train_of_a_journey(found):
    """Segments follow each other in their direction; B is run over in reverse."""
    line, train = found.line, found.train
    assert line.length == 4_500.0
    at = [400.0, 1_200.0, 1_700.0, 2_500.0, 2_900.0, 3_100.0, 3_400.0, 3_900.0]
    limits = [60, 100, 100, 80, 80, 40, 80, 120]
    assert np.round(3.6 * line.speed_limit(at)).tolist() == limits
    # Uphill in the nominal direction is downhill against it.
    assert (1e3 * line.gradient([*at[:4], 3_900.0])).tolist() == [0.0, 0.0, -12.5, -5.0, 0.0]
    assert line.curvature([1_100.0, 2_500.0]).tolist() == pytest.approx([-1 / 500, -1 / 800])
    (tunnel,) = line.tunnels
    assert (tunnel.position, tunnel.length, tunnel.cross_section) == (2_100.0, 400.0, 48.0)
    assert [(each.name, each.position) for each in line.stations] == [
        ("Amstad", 100.0), ("Bergen", 3_200.0), ("c", 3_700.0), ("d", 4_400.0),
    ]  # fmt: skip
    # Kilometres jump where the stones say so.
    stones = line.reference.at([0.0, 1_000.0, 1_400.0, 1_600.0], 4_500.0)
    assert stones.tolist() == [12_000.0, 13_000.0, 13_400.0, 20_100.0]
    assert "gradients" in line.assumed
    assert {
        "speed restrictions at other times: 1", "temporary constraints (Wind): 1", "GuardRails: 1",
    } <= set(found.left_out)  # fmt: skip
    rows = [(p.position, p.earliest, p.latest, p.highest_speed) for p in found.journey.points]
    assert rows == [
        (100.0, 0.0, 0.0, 0.0),
        (3_200.0, 120.0, 180.0, 0.0),
        (3_200.0, 240.0, None, 0.0),
        (3_700.0, None, 360.0, None),
        (4_400.0, None, 480.0, 0.0),
    ]
    assert (train.mass, train.length, round(3.6 * train.max_speed)) == (122e3, 75.0, 160)
    assert train.rotating_mass_factor == pytest.approx(0.08)
    assert train.resistance == RunningResistance(2300.0, 61.2, 12.0)
    assert train.tractive_effort_limit([5.0, 160 / 3.6]).tolist() == pytest.approx([200e3, 58.5e3])
    assert train.max_deceleration == 0.7
    assert "max_acceleration" in train.assumed


def test_a_restriction_without_an_end_holds_to_that_of_its_segment(tmp_path):
    """As published journeys have them; places beyond a segment that no train calls at are left."""
    outside = '<TimingPoint TP_ID="e" location="1800"/></SP_Points>'
    jp = JOURNEY.replace('startLocation="200" endLocation="500"', 'startLocation="200"')
    c = C.replace("</SP_Points>", outside)
    (journey,) = read_sfera(folder_with(tmp_path, jp=jp, c=c))
    limits = 3.6 * journey.line.speed_limit([2_100.0, 3_250.0, 3_400.0])
    assert limits.round().tolist() == [40, 40, 80]
    assert "places outside of their segment: 1" in journey.left_out
    assert any("for want of an end" in each for each in journey.assumed)


def test_times_that_nobody_can_keep_are_no_timetable(tmp_path):
    """As in published journeys; line and train come in."""
    late = JOURNEY.replace("T06:38:00Z", "T06:33:30Z")
    (journey,) = read_sfera(folder_with(tmp_path, jp=late))
    assert journey.journey is None
    assert journey.train is not None
    said = "it asks the train to be at km 4.400 by 210 s, and not to leave a place before until 240"
    assert any(said in each for each in journey.left_out)


@pytest.mark.parametrize(
    ("stated", "instead", "words"),
    [
        ('rolloutCoefficientA="2300"', "", "train 'unit': its characteristics lack rollout coef"),
        (r'trainWeight="\d+"', 'trainWeight="0"', "train 'unit': its characteristics lack weight"),
        (r"(?s)<TC_Features.*</TC_Features>", "", ": it has no characteristics"),
    ],
)
def test_too_few_characteristics_are_named(tmp_path, stated, instead, words):
    (journey,) = read_sfera(folder_with(tmp_path, tc=re.sub(stated, instead, UNIT)))
    assert journey.train is None
    assert any(words in each for each in journey.left_out)


TWICE = '"B" SP_VersionMajor="1" SP_Direction="Reverse"'
ENTITY = '<!DOCTYPE a [<!ENTITY x SYSTEM "file:///etc/passwd">]><JourneyProfile/>'


@pytest.mark.parametrize(
    ("changed", "said"),
    [
        ({"b": ""}, "refers to segment 'B' of 0099, which is not given"),
        ({"b": B.replace('Major="1"', 'Major="3"')}, r"in version 1\.0; given is version 3\.0"),
        ({"a": A.replace('"2000"', '"-5"', 1)}, "SP_Length -5 m is not positive"),
        ({"a": A.replace('location="800"', 'location="8000"')}, "8000 m is not in its segment"),
        ({"a": A.replace("12.5", "steep")}, "gradientValue 'steep' is not a finite number"),
        ({"a": A[:200]}, "is not XML"),
        ({"jp": JOURNEY.replace("T06:33:00Z", "T26:33:00Z")}, "is not a time"),
        ({"jp": JOURNEY.replace(">2026-05-17<", ">17.5.<")}, "'17.5.' is not a date"),
        ({"jp": JOURNEY.replace("PT1M", "soon")}, "'soon' is not a duration"),
        ({"jp": JOURNEY.replace('TP_ID="d"', 'TP_ID="x"')}, "refers to the timing point 'x'"),
        ({"jp": JOURNEY.replace('"C" SP_VersionMajor="2"', TWICE)}, "twice in the same direction"),
        ({"jp": ENTITY}, "declares the entity"),
        ({"b": B.replace('SSP_Speed="80"', 'SSP_Speed="0"')}, "SSP_Speed 0 km/h lets no train run"),
        ({"jp": JOURNEY.replace('"Reverse"', '"Backward"')}, "SP_Direction 'Backward' is unknown"),
        ({"jp": JOURNEY.replace('"Valid"', '"Invalid"')}, "states JP_Status 'Invalid'"),
        ({"b": "<Segment/>"}, "which is not given; b.xml holds none"),
    ],
)  # fmt: skip
def test_malformed_documents_are_one_line(tmp_path, changed, said):
    error = refused(InputError, said, read_sfera, folder_with(tmp_path, **changed))
    assert error.file is not None
    assert error.remedy


def test_documents_too_large_are_refused(tmp_path, monkeypatch):
    """In a folder as in an archive."""
    largest = max(len(text.encode()) for text in DOCUMENTS.values())
    monkeypatch.setattr("trainlog.formats.sfera.LARGEST", largest)
    read_sfera(folder_with(tmp_path))
    with ZipFile(tmp_path / "all.zip", "w") as archive:
        archive.write(tmp_path / "jp.xml", "jp.xml")
    monkeypatch.setattr("trainlog.formats.sfera.LARGEST", largest - 1)
    for given in (tmp_path, tmp_path / "all.zip"):
        refused(InputError, "documents of up to 0 MB are read", read_sfera, given)


def test_times_without_a_zone_are_taken_as_utc_and_counted(tmp_path):
    words = "times without a zone, taken as UTC"
    (stated,) = read_sfera(folder_with(tmp_path))
    assert not any(words in each for each in stated.assumed)
    (found,) = read_sfera(folder_with(tmp_path, jp=JOURNEY.replace("06:33:00Z", "06:33:00")))
    assert f"{words}: 1" in found.assumed
    assert found.journey == stated.journey


def test_two_journeys_of_one_name_do_not_overwrite_each_other(tmp_path, shell):
    """The second is refused, a third comes in."""
    folders = [tmp_path / name for name in ("one", "two", "three")]
    for number, folder in enumerate(folders):
        folder.mkdir()
        jp = JOURNEY.replace("4711", "../../17") if number == 2 else JOURNEY
        folder_with(folder, jp=jp, b=B.replace('"80"', f'"{80 - number}"'))
    words = ["import", *map(str, folders), "-o", str(tmp_path / "out")]
    status, shown, complaint = shell(*words)
    assert status == 1
    assert "two: would be written as 1099-4711-2026-05-17.line.json" in complaint
    assert sorted(each.name for each in (tmp_path / "out").glob("*.line.json")) == [
        "1099-..-..-17-2026-05-17.line.json", "1099-4711-2026-05-17.line.json",
    ]  # fmt: skip
    line = read_line(tmp_path / "out" / "1099-4711-2026-05-17.line.json")
    assert round(3.6 * float(line.speed_limit([3_450.0])[0])) == 80
    assert "GuardRails" in shown


def test_a_line_of_ours_fills_what_the_journey_lacks(tmp_path, found):
    """By stations of the same names; our line runs the other way, and a little longer."""
    own = Line(
        name="ours",
        length=5_000.0,
        stations=(Station("d", 600.0), Station("Bergen", 1_805.0), Station("Amstad", 4_920.0)),
        speed_limits=StepProfile(np.zeros(1), np.array([40.0])),
        gradients=StepProfile(np.array([0.0, 1_200.0]), np.array([4e-3, -7e-3])),
    )
    line, said = filled(found.line, own)
    # Ours climbs 7 per mille from Amstad on until 1,200 m, then falls by 4.
    slopes = 1e3 * line.gradient([50.0, 500.0, 3_000.0, 4_300.0, 4_450.0])
    assert slopes.tolist() == [0, 7, 7, -4, 0]
    assert "gradients" in line.assumed
    assert said[0] == "gradients from line 'ours', km 0.100 to km 4.400"
    assert said[1:] == ["level and straight elsewhere", "places by the names of stations"]


@pytest.fixture(scope="session")
def valid() -> Callable[[Element], bytes]:
    """Writes a document; checked against the schema where the variable SFERA_XSD names it."""
    path = os.environ.get("SFERA_XSD")
    schema = None
    if path:
        etree = pytest.importorskip("lxml.etree")
        schema = etree.XMLSchema(etree.parse(path))

    def written(element: Element) -> bytes:
        data = xml_of(element)
        if schema is not None:
            schema.assertValid(etree.fromstring(data))
        return data

    return written


def test_constraints_come_back_where_they_were_put(tmp_path, found, valid):
    """Over the end of A and all of B into C, travelled A forward, B in reverse, C forward."""
    given = [
        Constraint(500.0, 3_700.0, "ASR", {"ASR_Speed": "30"}, "AdditionalSpeedRestriction"),
        Constraint(2_200.0, 2_300.0, "ASR", {"ASR_Speed": "25"}, "AdditionalSpeedRestriction"),
    ]
    profile = with_constraints(found.profile, found.segments, given, "ASR")
    (again,) = read_sfera(folder_with(tmp_path, jp=valid(profile).decode()))
    at = [450.0, 550.0, 2_100.0, 2_250.0, 3_650.0, 3_750.0]
    assert (3.6 * again.line.speed_limit(at)).round().tolist() == [60, 30, 30, 25, 30, 120]
    assert again.profile.text("JP_Version") == "4"
    assert again.journey == found.journey


def test_what_was_learned_comes_back_as_the_next_version(tmp_path, valid):
    element = parsed_xml(UNIT.encode(), "tc.xml")
    learned = RunningResistance(1_987.6, 45.1, 9.87)
    text = valid(with_resistance(element, learned)).decode()
    jp = JOURNEY.replace('TC_VersionMinor="0"', 'TC_VersionMinor="1"')
    (again,) = read_sfera(folder_with(tmp_path, tc=text, jp=jp))
    assert (again.train.mass, again.train.resistance) == (122e3, learned)


def test_a_report_states_where_the_train_is_in_its_segment(found, valid):
    time = datetime.datetime(2026, 5, 17, 6, 32, 5, tzinfo=datetime.UTC)
    report = Report(time, 2_400.0, 22.5, slips=True)
    written = valid(status_report(report, found.segments, found.profile, "unit 17"))
    message = parsed_xml(written, "report.xml")
    own = message.first("B2G_EventPayload", "B2G_StatusReport", "PositionSpeed")
    # 400 m from the end of B, which is run over in reverse.
    assert (own.text("SP_ID"), own.number("location"), own.number("speed")) == ("B", 1_100.0, 81.0)
    (status,) = message.all("B2G_EventPayload", "B2G_StatusReport")
    assert status.text("slipSlideReported") == "true"


def reports_of(found: SferaJourney, folder: Path, *, every: float = 5.0) -> Path:
    """An archive of a journey and the reports of a train that runs over it at 72 km/h."""
    start = datetime.datetime(2026, 5, 17, 6, 30, tzinfo=datetime.UTC)
    with ZipFile(folder / "reports.zip", "w") as archive:
        for name, text in DOCUMENTS.items():
            archive.writestr(f"{name}.xml", text)
        for number, at in enumerate(np.arange(100.0, 4_400.0, 20.0 * every)):
            time = start + datetime.timedelta(seconds=every * number)
            report = Report(time, float(at), 20.0, slips=bool(2_000.0 < at < 2_300.0))
            message = status_report(report, found.segments, found.profile, "unit 17")
            archive.writestr(f"report-{number:04d}.xml", xml_of(message))
    return folder / "reports.zip"


def test_reports_of_a_train_are_a_recording(tmp_path, found):
    trip = ingest(reports_of(found, tmp_path))
    state = trip["/train/state"]
    assert state.position.to_numpy()[[0, -1]].tolist() == [100.0, 4_300.0]
    assert np.ptp(np.diff(state.position)) < 0.01
    assert set(state.speed.round(6)) == {20.0}
    (event,) = trip["/events"].query("name == 'slip protection'").index
    assert state.position.loc[event] == pytest.approx(2_100.0)
    assert trip.metadata["line"] == found.line.name


def test_reports_of_others_and_broken_ones_are_counted_and_put_on_no_other_line(tmp_path, found):
    archive = reports_of(found, tmp_path)
    time = datetime.datetime(2026, 5, 17, 6, 31, tzinfo=datetime.UTC)
    message = xml_of(
        status_report(Report(time, 900.0, 20.0), found.segments, found.profile, "unit 17")
    )
    with ZipFile(archive, "a") as more:
        more.writestr("other.xml", message.replace(b"4711", b"4712"))
        more.writestr("old.xml", message.replace(b'JP_Version="3"', b'JP_Version="2"'))
        more.writestr("broken.xml", message[:-30])
    trip = ingest(archive)
    stated = trip.metadata["not_used"]
    assert "reports of other trains (1)" in stated
    assert "reports by another version than 3 (1)" in stated
    assert trip.metadata["repair.damaged_messages"] == "1"
    other = read_line("sample_logs/CH_StGallen_Wil.line.json")
    refused(InputError, "count along the journey's line 'Amstad - d'", ingest, archive, line=other)
