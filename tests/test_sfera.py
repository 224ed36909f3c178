"""SFERA: journeys in; advice, conditions, resistance and reports out; documents of our own."""

from __future__ import annotations

import datetime
import os
import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from zipfile import ZipFile

import numpy as np
import pytest
from refusals import refused
from trip_parts import without

import trainlog
from analysis import OptimiserOptions, TrajectoryProblem, journey_advice, optimise, sfera
from analysis.sfera import advised, low_adhesion, write_sfera
from trainlog import InputError, Line, RunningResistance, Station, StepProfile, read_line
from trainlog.formats.railml import Element, parsed_xml
from trainlog.formats.railway import write_parameters, write_trajectory
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
from trainlog.railway import Configuration, ParameterSet, Train, Trajectory
from trainlog.railway.condition import AdhesionForecast
from trainlog.topics import TRAIN_SLIP_PROTECTION
from trainlog.trip import frame_of

sys.path.insert(0, str(Path(__file__).parents[1] / "benchmarks" / "trajectory"))
sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from benchmark_random import random_problem
from make_journey import DEPARTURE, documents_of, write_journey

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


def checked(data: bytes) -> Element:
    """A document; by the schema, where the variable SFERA_XSD names it."""
    if path := os.environ.get("SFERA_XSD"):
        etree = pytest.importorskip("lxml.etree")
        etree.XMLSchema(etree.parse(path)).assertValid(etree.fromstring(data))
    return parsed_xml(data, "written.xml")


def test_constraints_come_back_where_they_were_put(tmp_path, found):
    """Over the end of A and all of B into C, travelled A forward, B in reverse, C forward."""
    given = [
        Constraint(500.0, 3_700.0, "ASR", {"ASR_Speed": "30"}, "AdditionalSpeedRestriction"),
        Constraint(2_200.0, 2_300.0, "ASR", {"ASR_Speed": "25"}, "AdditionalSpeedRestriction"),
    ]
    profile = with_constraints(found.profile, found.segments, given, "ASR")
    data = xml_of(profile)
    checked(data)
    (again,) = read_sfera(folder_with(tmp_path, jp=data.decode()))
    at = [450.0, 550.0, 2_100.0, 2_250.0, 3_650.0, 3_750.0]
    assert (3.6 * again.line.speed_limit(at)).round().tolist() == [60, 30, 30, 25, 30, 120]
    assert again.profile.text("JP_Version") == "4"
    assert again.journey == found.journey


def test_what_was_learned_comes_back_as_the_next_version_of_its_train(tmp_path):
    element = parsed_xml(UNIT.encode(), "tc.xml")
    learned = RunningResistance(1_987.6, 45.1, 9.87)
    data = xml_of(with_resistance(element, learned))
    checked(data)
    jp = JOURNEY.replace('TC_VersionMinor="0"', 'TC_VersionMinor="1"')
    (again,) = read_sfera(folder_with(tmp_path, tc=data.decode(), jp=jp))
    assert (again.train.mass, again.train.resistance) == (122e3, learned)


def test_a_report_states_where_the_train_is_in_its_segment(found):
    time = datetime.datetime(2026, 5, 17, 6, 32, 5, tzinfo=datetime.UTC)
    report = Report(time, 2_400.0, 22.5, slips=True)
    message = checked(xml_of(status_report(report, found.segments, found.profile, "unit 17")))
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


KMH = 3.6
CUTS = [9_286.1, 14_476.1, 20_086.1]


@pytest.fixture(scope="module")
def wil(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A journey over St.Gallen-Wil."""
    folder = tmp_path_factory.mktemp("wil") / "journey"
    line, train = trainlog.read_line("sample"), trainlog.read_train("sample")
    return write_journey(folder, line, CUTS, train)


@pytest.fixture(scope="module")
def plan(wil: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A trajectory over the whole of it."""
    (journey,) = read_sfera(wil)
    file = tmp_path_factory.mktemp("plan") / "trajectory.json"
    write_trajectory(planned(journey, journey.train), file)
    return file


def planned(journey: SferaJourney, train: Train) -> Trajectory:
    problem = TrajectoryProblem(journey.line, train, [Configuration.of(train)], end=20_086.1)
    return optimise(problem, OptimiserOptions(150))


def constraints_in(journey: SferaJourney, tag: str) -> Iterator[tuple[float, float, Element]]:
    """From where to where [m] along the journey its constraints of a kind reach, per segment."""
    for segment in journey.segments:
        for each in segment.reference.all("TemporaryConstraints"):
            found = each.first(tag)
            if found is None:
                continue
            back, length = segment.reverse, segment.length
            first = each.number("startLocation", length if back else 0.0)
            last = each.number("endLocation", 0.0 if back else length)
            ends = (segment.begin + (length - at if back else at) for at in (first, last))
            yield *ends, found


def test_a_line_as_a_journey_comes_back_as_the_line(wil):
    line, (journey,) = trainlog.read_line("sample"), read_sfera(wil)
    at = np.arange(1.0, line.length, 7.0)
    assert np.array_equal(journey.line.speed_limit(at), line.speed_limit(at))
    assert np.allclose(journey.line.gradient(at), line.gradient(at), atol=1e-12)
    for name, data in documents_of(line, CUTS, trainlog.read_train("sample")).items():
        assert checked(data).tag, name


@pytest.mark.usefixtures("unrenewed")
@pytest.mark.parametrize(("number", "apart"), [(3, 25.0), (8, 0.0)])
def test_advice_keeps_to_limits_and_changes_seldom(number, apart, tmp_path):
    """Of random lines and trains: nowhere above a limit, no change too soon, nothing left out."""
    problem = random_problem(number)
    cuts = (problem.line.length * np.array([0.2, 0.55, 0.6])).tolist()
    (journey,) = read_sfera(write_journey(tmp_path / "in", problem.line, cuts, problem.train))
    end = min(problem.end, journey.line.length)
    found = optimise(replace(problem, line=journey.line, end=end), OptimiserOptions(100))
    rows = advised(journey_advice([found], journey.line), journey, changes_apart=apart)
    profile = with_constraints(
        journey.profile, journey.segments, sfera.advice_constraints(rows), "AdvisedSpeed"
    )
    (tmp_path / "in" / "journey.xml").write_bytes(xml_of(profile))
    checked(xml_of(profile))
    (again,) = read_sfera(tmp_path / "in")
    covered = np.zeros(int(problem.line.length) + 1, dtype=bool)
    for first, last, stated in constraints_in(again, "AdvisedSpeed"):
        within = np.arange(np.ceil(first), np.floor(last - 1e-6) + 1)
        limits = KMH * problem.line.limits_over(found.protected_length)(within)
        assert stated.number("optimalSpeed", 0.0) <= limits.min(initial=np.inf) + 1e-6
        covered[within.astype(int)] = True
    places = np.arange(np.ceil(found.positions[0]), np.floor(found.positions[-1])).astype(int)
    assert covered[places].mean() > 0.999
    times = [each.time for each in rows]
    assert np.diff(times).min(initial=np.inf) >= apart


def test_brief_advice_neither_replaces_another_nor_holds_a_train_at_its_stop(
    plan, wil, monkeypatch
):
    """Behind each change one that follows sooner: at the same speed, a higher one, a departure.

    Coasting behind traction waits, but for a limit below the speed that the traction leads to.
    """
    (journey,), traction = read_sfera(wil), sfera.Phase.MAXIMUM_TRACTION
    rows = [
        (0.0, 1_000.0, 0.0, 60.0, sfera.Phase.COASTING, False, 40),
        (1_000.0, 1_100.0, 60.0, 65.0, traction, False, 77),
        (1_100.0, 8_000.0, 65.0, 365.0, sfera.Phase.CRUISING, True, 77),
        (8_000.0, 8_100.0, 365.0, 370.0, sfera.Phase.CRUISING, True, 60),
        (8_100.0, 9_100.0, 370.0, 420.0, traction, False, 90),
        (9_100.0, 9_120.0, 420.0, 424.0, sfera.Phase.MAXIMUM_BRAKING, False, 0),
        (9_120.0, 9_200.0, 426.0, 432.0, traction, False, 90),
        (9_200.0, 9_700.0, 432.0, 472.0, sfera.Phase.COASTING, False, 80, 100.0),
        (9_700.0, 9_800.0, 472.0, 477.0, traction, False, 85),
        (9_800.0, 10_000.0, 477.0, 500.0, sfera.Phase.COASTING, False, 70, 80.0),
    ]
    monkeypatch.setattr(sfera, "_divided", lambda *_: [sfera.Advised(*row) for row in rows])
    found = advised(journey_advice([trainlog.read_trajectory(plan)]), journey)
    assert [(each.begin, each.end, each.time, each.speed, each.hold) for each in found] == [
        (0.0, 1_000.0, 0.0, 40, False),
        (1_000.0, 8_000.0, 60.0, 77, True),
        (8_000.0, 8_200.0, 365.0, 60, True),
        (8_200.0, 9_100.0, 375.0, 90, False),
        (9_100.0, 9_120.0, 420.0, 0, False),
        (9_120.0, 9_250.0, 426.0, 90, False),
        (9_250.0, 9_700.0, 436.0, 80, False),
        (9_700.0, 10_000.0, 472.0, 70, False),
    ]


def test_there_is_no_advice_for_what_lies_behind(plan, wil, tmp_path):
    options = sfera.SferaOptions(passed=11_000.0)
    write_sfera([plan], wil, tmp_path / "ahead.xml", options)
    message = checked((tmp_path / "ahead.xml").read_bytes())
    every = list(message.all("G2B_EventPayload", "C_DAS_C_Advice"))
    (journey,) = read_sfera(wil)
    whole = advised(journey_advice([trainlog.read_trajectory(plan)]), journey)
    assert len(every) == sum(each.end > 11_001.0 for each in whole)
    info = next(every[0].all("SegmentProfileInfo"))
    # In the second segment, run over in reverse from its end at 9,286.1 m on.
    assert (info.text("SP_ID"), info.number("startLocation")) == ("S1", pytest.approx(3_476.1))
    assert every[-1].text("adviceType") == "StopAdvice"
    assert "optimalSpeed" not in every[-1].attributes


def with_segments(journey: Path, folder: Path) -> None:
    for file in journey.glob("[!j]*.xml"):
        shutil.copy(file, folder)


def test_advice_replaces_that_of_the_version_before(plan, wil, tmp_path):
    write_sfera([plan], wil, tmp_path / "once.xml")
    with_segments(wil, tmp_path)
    found = write_sfera([plan], tmp_path / "once.xml", tmp_path / "twice.xml")
    once, twice = (checked((tmp_path / name).read_bytes()) for name in ("once.xml", "twice.xml"))
    assert found["version"] == "3"
    assert twice.text("JP_Version") == "3"
    assert [e.attributes for e in once.every() if e.tag == "AdvisedSpeed"] == [
        e.attributes for e in twice.every() if e.tag == "AdvisedSpeed"
    ]
    assert any(each.tag == "PowerAdvice" for each in twice.every())


def forecast_of(
    line: str, values: list[float], layers: list[str] | None = None
) -> AdhesionForecast:
    count, day = len(values), 86_400 * 10**9
    start = 1_000.0 * np.arange(count)
    begins = np.full(count, 20_590 * day)
    layer = tuple(layers or ["wet"] * count)
    none = np.zeros(0), np.zeros((count, 0))
    return AdhesionForecast(
        line, start, start + 1_000.0, begins, begins + day, begins, layer,
        np.array([0.05]), np.array(values)[:, None], *none,
    )  # fmt: skip


def test_low_adhesion_is_stated_where_the_forecast_knows_it(wil, tmp_path):
    """Of a line of ours in the other direction; equal neighbours are one, dry and unknown none."""
    own = replace(trainlog.read_line("sample").reversed(), name="ours")
    (journey,) = read_sfera(wil)
    values = [np.nan] * 12 + [0.04, 0.04, 0.1, 0.3, np.nan, 0.02]
    rows = low_adhesion(forecast_of("ours", values), journey, own, layer="wet")
    length = own.length
    assert [
        (round(each.begin), round(each.end), each.attributes["lowAdhesionCategory"])
        for each in rows
    ] == [
        (round(length - 18_000), round(length - 17_000), "Extremely Low Adhesion"),
        (round(length - 15_000), round(length - 14_000), "Dry Rail (Low)"),
        (round(length - 14_000), round(length - 12_000), "Very Low Adhesion"),
    ]
    profile = with_constraints(journey.profile, journey.segments, rows, "Low_Adhesion")
    checked(xml_of(profile))
    (tmp_path / "journey.xml").write_bytes(xml_of(profile))
    with_segments(wil, tmp_path)
    (again,) = read_sfera(tmp_path / "journey.xml")
    found = list(constraints_in(again, "LowAdhesion"))
    assert round(sum(last - first for first, last, _ in found)) == 4_000
    times = {each.attributes.get("startTime") for each in again.profile.every()}
    assert times == {None, "2026-05-17T00:00:00Z"}


def test_a_forecast_for_another_day_is_named(wil, tmp_path):
    """The journey is of 2026-05-17."""
    given = wil, tmp_path / "low.xml", sfera.SferaOptions(layer="wet")
    line, table = read_sfera(wil)[0].line.name, tmp_path / "forecast.csv"
    for day, said in (("17", None), ("18", "2026-05-18, the journey is of 2026-05-17")):
        table.write_text(
            "line,layer,from [km],to [km],valid from,valid to,issued,quantile 0.05\n"
            f"{line},wet,1.0,2.0,2026-05-{day}T04:00Z,2026-05-{day}T09:00Z,2026-05-16T00:00Z,0.06\n"
        )
        assert write_sfera([table], *given).get("dated") == said


def test_a_forecast_by_conditions_asks_which_one(wil):
    (journey,) = read_sfera(wil)
    forecast = forecast_of(journey.line.name, [0.04, 0.05], ["wet", "dry"])
    other = replace(forecast, line="other")
    for given, options, said in (
        (forecast, {}, "each for one rail condition.*name one with --layer: dry, wet"),
        (forecast, {"layer": "wet", "probability": 0.5}, "does not state the quantile 0.5"),
        (other, {"layer": "wet"}, "it is of line 'other'"),
    ):
        refused(InputError, said, low_adhesion, given, journey, **options)


def test_a_trip_becomes_reports_and_a_trip_again(wil, tmp_path):
    """The sample's trip: half a second of time, and what 5 s without a report hide."""
    log = Path("sample_logs/nonstop.mcap")
    found = write_sfera([log], wil, tmp_path / "reports.zip")
    trip, again = trainlog.read("sample_logs/nonstop.mcap"), ingest(tmp_path / "reports.zip")
    assert found["reports"] == len(again["/train/state"])
    assert found["dated"] == "2024-10-07, the journey is of 2026-05-17"
    state, own = again["/train/state"], trip["/train/state"]
    when, known = (each.index.as_unit("ns").asi8 for each in (state, own))
    place = np.interp(when, known, own.position)
    assert np.abs(state.position - place).max() < 0.5
    assert np.abs(state.speed - np.interp(when, known, own.speed)).max() < 0.05
    assert again.metadata["line"] == read_sfera(wil)[0].line.name


def test_a_train_reports_nothing_of_a_gap(wil):
    """Nor of an instant before its first sample."""
    (journey,), trip = read_sfera(wil), trainlog.read("sample_logs/nonstop.mcap")
    own = trip["/train/state"]
    passed = (own.index - own.index[0]).total_seconds()
    kept = (passed > 100.6) & ~((passed > 300.0) & (passed < 800.0))
    part = trip.with_topic(own[kept])
    times = [each.time for each in sfera.reports_of(part, journey, trainlog.read_line("sample"))]
    since = np.array([(each - own.index[0]).total_seconds() for each in times])
    assert 100.6 < since[0] < 101.6
    assert not np.any((since > 300.0) & (since < 800.0))
    assert np.diff(times).max().total_seconds() == pytest.approx(500.0, abs=5.0)


def test_slips_that_only_their_own_topic_records_are_reported(wil):
    """At 100 s for 3 s; not known where nothing records them."""
    (journey,), line = read_sfera(wil), trainlog.read_line("sample")
    trip = without(trainlog.read("sample_logs/nonstop.mcap"), "/events")
    own = trip["/train/state"].index
    passed = (own - own[0]).total_seconds().to_numpy()
    acts = frame_of(
        TRAIN_SLIP_PROTECTION, own, {"active": ((passed >= 100.0) & (passed < 103.0)) * 1.0}
    )
    found = sfera.reports_of(trip.with_topic(acts), journey, line)
    (slips,) = [(each.time - own[0]).total_seconds() for each in found if each.slips]
    assert slips == pytest.approx(100.0, abs=5.0)
    assert {each.slips for each in found} == {True, False}
    assert {each.slips for each in sfera.reports_of(trip, journey, line)} == {None}


def test_what_was_learned_is_the_next_version(wil, tmp_path):
    train = trainlog.read_train("sample")
    common = RunningResistance(1_987.0, 40.0, 10.0)
    learned = ParameterSet(train.name, (Configuration.of(train),), common, np.eye(3))
    write_parameters(learned, tmp_path / "fitted.json")
    found = write_sfera([tmp_path / "fitted.json"], wil, tmp_path / "unit.xml")
    element = checked((tmp_path / "unit.xml").read_bytes())
    features = element.first("TC_Features")
    assert [features.number(f"rolloutCoefficient{each}") for each in "ABC"] == [1_987.0, 40.0, 10.0]
    assert found["version_of_characteristics"] == element.text("TC_VersionMinor") == "1"
    alone = replace(learned, common=None, common_covariance=None)
    write_parameters(alone, tmp_path / "alone.json")
    given = [tmp_path / "alone.json"], wil, tmp_path / "x.xml"
    refused(InputError, "no fit of all trips", write_sfera, *given)
    assert not given[2].exists()


@pytest.mark.parametrize(
    ("source", "changes", "said"),
    [
        ("sample_logs/README.md", {}, "cannot be written to SFERA"),
        ("sample_logs/nonstop.mcap", {}, "is not the name of a .zip file"),
        ("sample_logs/CH_StGallen_Wil.map", {}, "but a map file"),
        ("plan", {"layer": "wet"}, "--layer goes with a forecast"),
        ("plan", {"passed": 20_086.1}, "the plan ends at km 20.086"),
        ("plan", {"passed": 40_000.0}, "the plan ends at km 20.086"),
        ("plan", {"line": "shorter"}, "is planned on line"),
        ("plan", {"line": "slower"}, "the journey's limit is 40 km/h"),
        ("plan", {"line": "two"}, "holds 2 journeys"),
    ],
)
def test_what_does_not_fit_is_refused(wil, plan, tmp_path, source, changes, said):
    """A slower journey has the same name and length, and a limit of 40 km/h on its way."""
    line, train, journey = trainlog.read_line("sample"), trainlog.read_train("sample"), wil
    limits = replace(line.speed_limits, values=line.speed_limits.values.copy())
    limits.values[3] = 40.0 / KMH
    match changes.pop("line", None):
        case "shorter":
            journey = write_journey(tmp_path / "in", line.section(0.0, 21_000.0), [9_000.0], train)
        case "slower":
            journey = write_journey(
                tmp_path / "in", replace(line, speed_limits=limits), CUTS, train
            )
        case "two":
            journey = shutil.copytree(wil, tmp_path / "in")
            other = (journey / "journey.xml").read_text().replace(">17<", ">18<")
            (journey / "other.xml").write_text(other)
    results = [plan if source == "plan" else Path(source)]
    options = sfera.SferaOptions(**changes)
    error = refused(InputError, said, write_sfera, results, journey, tmp_path / "x.xml", options)
    assert error.remedy
    assert not (tmp_path / "x.xml").exists()


def test_the_command_writes_the_next_version(wil, plan, tmp_path, works):
    file = tmp_path / "advised.xml"
    assert "advised speeds" in works("sfera", plan, "--journey", wil, "-o", file)
    assert checked(file.read_bytes()).text("JP_Version") == "2"
    assert DEPARTURE.year == 2026
