"""Reports as pages and tables: what they hold, that names stay text, what bad input does."""

from __future__ import annotations

import re
import shutil
import sys
from collections.abc import Iterator
from dataclasses import replace
from html.parser import HTMLParser
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, strategies as st
from refusals import refused
from report_folder import SCRIPT, hostile_trip, make_folder, planned
from rich.console import Console

from analysis import ReportOptions, TripView, adhesion_map, coast_down, fit, report, write_report
from analysis.charts import Chart, Curve, Panel, figure_of, rows_to_draw
from analysis.comparison.driven import driven_trip
from analysis.comparison.groups import trip_cost
from analysis.reports import build, page as pages
from analysis.reports.answers import verdict
from analysis.reports.build import kind_of
from analysis.reports.page import DARK, LIGHT, Page, Section
from analysis.reports.trip import Motion, Zone, known_zone, station_calls
from analysis.truth import curve_error, map_error, true_adhesion
from trainlog import DEFAULT_LINE, InputError, TrainlogError, read_map, sample, write_map
from trainlog.formats.railway import (
    line_of,
    write_coast_down,
    write_parameters,
    write_trajectory,
)
from trainlog.formats.summaries import write_summaries
from trainlog.ingest.recording import Finding, Report
from trainlog.mcap import read_log, write_log
from trainlog.presentation import kwh, new_table
from trainlog.railway import RunningResistance
from trainlog.trip import SCENARIO_ATTACHMENT

sys.path.append(str(Path(__file__).parents[1] / "docs" / "tools"))
from screenshot import browser_page, chromium

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds")


class Outline(HTMLParser):
    """Tags with their attributes."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags = list[tuple[str, dict[str, str | None]]]()
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))

    def values(self, *names: str) -> list[str]:
        """What attributes of these names hold."""
        return [known[name] or "" for _, known in self.tags for name in names if name in known]


@pytest.fixture(scope="module")
def trip_page(tmp_path_factory: pytest.TempPathFactory) -> str:
    folder = tmp_path_factory.mktemp("trip")
    write_log(hostile_trip(), folder / "run.mcap")
    write_report(
        folder / "run.mcap", folder / "run.html", ReportOptions(zone=Zone("Europe/Zurich"))
    )
    return (folder / "run.html").read_text("utf-8")


def test_a_map_names_the_trips_that_it_states_something_of(tmp_path):
    track = adhesion_map(sample("nonstop.mcap")).track
    (known,) = track.trips
    noted = replace(track, trips=({**known, "notes": ["set aside: by hand"]},))
    write_map(noted, tmp_path / "a.map")
    write_report(tmp_path / "a.map", tmp_path / "a.html")
    assert "dry, trip-01: set aside: by hand" in (tmp_path / "a.html").read_text("utf-8")


@pytest.mark.parametrize(
    ("moment", "times"),
    [
        ("2026-10-25T00:59:59.6Z", ["02:00:00", "03:00:00"]),
        ("2026-03-29T00:59:59.6Z", ["03:00:00", "04:00:00"]),
    ],
)
def test_times_are_stated_while_clocks_are_set(moment, times):
    moments = pd.DatetimeIndex([moment, pd.Timestamp(moment) + pd.Timedelta("1h")])
    zone = Zone("Europe/Zurich")
    assert zone.times(moments) == [zone.time(each) for each in moments] == times
    assert zone.date(moments[0]) == f"{moment[:10]} {times[0]}"


def test_a_page_refers_to_nothing_outside_and_names_from_a_log_stay_text(trip_page):
    outline = Outline(trip_page)
    tags = [tag for tag, _ in outline.tags]
    references = outline.values("src", "href", "xlink:href", "action", "data")
    assert all(each.startswith(("#", "data:")) for each in references)
    assert not {"iframe", "object", "embed", "form", "base"} & set(tags)
    policy = re.search(r'Content-Security-Policy" content="([^"]*)"', trip_page)
    rules = dict(each.split(None, 1) for each in policy[1].split("; "))
    assert rules["default-src"] == "'none'"
    # The scripts of the page alone, by their digests.
    assert re.fullmatch(r"('sha256-[\w+/=]+' ?)+", rules["script-src"])
    assert not [name for _, known in outline.tags for name in known if name.startswith("on")]
    assert SCRIPT not in trip_page
    assert "&lt;script&gt;document.title=" in trip_page
    assert "<img src=x" not in trip_page
    # BokehJS, the script that calls it, and the data of two charts.
    assert tags.count("script") == 4


def test_headings_pictures_and_identifiers_are_for_all_readers(trip_page):
    outline = Outline(trip_page)
    pictures = [known for tag, known in outline.tags if tag in ("svg", "img")]
    assert all(known.get("aria-label") or known.get("alt") for known in pictures)
    headings = [int(tag[1]) for tag, _ in outline.tags if re.fullmatch(r"h[1-6]", tag)]
    assert headings[0] == headings.count(1) == 1
    assert all(after <= before + 1 for before, after in pairwise(headings))
    identifiers = outline.values("id")
    assert len(identifiers) == len(set(identifiers))
    assert '<html lang="en"' in trip_page


def _luminance(colour: str) -> float:
    parts = [int(colour[i : i + 2], 16) / 255.0 for i in (1, 3, 5)]
    linear = [
        each / 12.92 if each <= 0.04045 else ((each + 0.055) / 1.055) ** 2.4 for each in parts
    ]
    return float(np.dot([0.2126, 0.7152, 0.0722], linear))


@pytest.mark.parametrize("colours", [LIGHT, DARK], ids=["light", "dark"])
def test_text_has_the_contrast_that_wcag_asks_for(colours):
    least = {"ink": 7.0, "soft": 4.5, "link": 4.5, "blue": 3.0, "red": 3.0}
    for ground in ("paper", "shade"):
        for name in least:
            high, low = sorted((_luminance(colours[name]), _luminance(colours[ground])))[::-1]
            assert (high + 0.05) / (low + 0.05) >= least[name], (name, ground)


def test_a_report_begins_with_five_answers_and_states_what_the_command_line_states(trip_page):
    first = trip_page[trip_page.index('id="section-1"') : trip_page.index('id="section-2"')]
    assert "<h2>Summary</h2>" in first
    questions = re.findall(r'<th scope="row"[^>]*>([^<]*)</th>', first)
    assert questions == [
        "trips", "recording", "slippery places", "energy",
        "next steps",
    ]  # fmt: skip
    assert "29.6 km in 23:07 min, 3 stops on the way" in first
    assert "good: whole, without gaps, nothing doubtful" in first
    assert "trainlog map update run.mcap" in first
    cost = trip_cost(hostile_trip())
    assert kwh(cost.traction) in first
    assert kwh(cost.line) in first
    # In the clock of the timetable: the sample left at 08:00 UTC, 10:00 in Zürich.
    assert "2024-10-07 10:00:00 Europe/Zurich" in trip_page
    (row,) = re.findall(r'<th scope="row">Gossau SG</th>(.*?)</tr>', trip_page)[:1]
    assert "10:06:17" in row
    assert "10:06:58" in row


def test_calls_at_stations_agree_with_the_events_of_the_log():
    trip = read_log(sample("stopping.mcap"))
    calls = station_calls(Motion.of(trip), line_of(trip))
    assert [call.name for call in calls] == [each.name for each in line_of(trip).stations]
    events = trip["/events"]
    for call in calls[:-1]:
        said = events[events["message"] == f"departure from {call.name}"]
        assert len(said) == 1
        # The brakes are released before it moves.
        assert abs((call.departure - said.index[0]).total_seconds()) < 3.0
    # As long as a comparison of trips counts.
    dwells = {stand.station: stand.duration for stand in driven_trip(trip).stands}
    for call in calls[1:-1]:
        assert call.dwell == pytest.approx(dwells[call.name], abs=0.5)
    assert calls[0].arrival is None
    assert calls[-1].departure is None


@pytest.mark.usefixtures("unpainted_page")
def test_a_fit_is_shown_with_its_trips_and_an_edited_one_with_a_doubt(tmp_path):
    fits = fit(sample("nonstop.mcap"))
    write_parameters(fits.parameters, tmp_path / "set.json")
    alone = write_report(tmp_path / "set.json", tmp_path / "alone.html")
    assert len(alone.sections) == 2
    assert "is not beside it" in (tmp_path / "alone.html").read_text("utf-8")
    write_summaries(fits.summaries, tmp_path / "set.parquet")
    whole = write_report(tmp_path / "set.json", tmp_path / "whole.html")
    titles = [each.title for each in whole.sections]
    assert titles[:2] == ["Summary", "Running resistance"]
    assert titles[2:4] == ["Trips of the fit", "Observed set"]
    options = ReportOptions(logs=(sample("nonstop.mcap"),))
    write_report(tmp_path / "set.json", tmp_path / "logs.html", options)
    assert "What the fit did not explain" in (tmp_path / "logs.html").read_text("utf-8")
    first = fits.parameters.configurations[0]
    heavier = replace(fits.parameters, configurations=(replace(first, mass=first.mass + 5e3),))
    write_parameters(heavier, tmp_path / "set.json")
    write_report(tmp_path / "set.json", tmp_path / "doubt.html")
    assert "gives another set than set.json holds" in (tmp_path / "doubt.html").read_text("utf-8")


@pytest.mark.usefixtures("unpainted_page")
def test_a_fit_is_shown_with_refused_trips_and_names_its_file(tmp_path):
    trip = read_log(sample("stopping.mcap"))
    idle = trip["/train/controls"].assign(tractive_effort=0.0)
    idle.attrs = trip["/train/controls"].attrs
    given = [read_log(sample("nonstop.mcap")), trip.with_topic(idle)]
    fits = fit(given)
    assert list(fits.refused) == [trip.name]
    write_parameters(fits.parameters, tmp_path / "my set.json")
    write_summaries(fits.summaries, tmp_path / "my set.parquet")
    write_report(tmp_path / "my set.json", tmp_path / "page.html")
    page = (tmp_path / "page.html").read_text("utf-8")
    assert "1 of 2 trips determine the curve; refused: not recorded: 1" in page
    assert "trainlog plan &#x27;my set.json&#x27; --line LINE" in page


@pytest.mark.usefixtures("unpainted_page")
def test_a_damaged_log_is_shown_as_far_as_it_is_readable_and_says_so(tmp_path):
    data = sample("nonstop.mcap").read_bytes()
    (tmp_path / "cut.mcap").write_bytes(data[: 2 * len(data) // 3])
    with pytest.warns(UserWarning, match=r"cut\.mcap"):
        write_report(tmp_path / "cut.mcap", tmp_path / "cut.html")
    text = (tmp_path / "cut.html").read_text("utf-8")
    assert 'class="warning"' in text
    assert "Speed and efforts" in text


def test_what_is_no_result_is_one_error_and_no_page(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "notes.txt").write_text("nothing")
    (tmp_path / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(99))
    (tmp_path / "none.json").write_text('{"format": "trainlog/trajectory", "version": 1}')
    for name, words in (
        ("empty", "has no result"),
        ("notes.txt", "is not a result for a report"),
        ("broken.mcap", "broken.mcap"),
        ("none.json", "none.json"),
        ("missing.mcap", "does not exist"),
    ):
        page = tmp_path / "page.html"
        refused(TrainlogError, re.escape(words), write_report, tmp_path / name, page)
        assert not page.exists()
    assert kind_of(sample("CH_StGallen_Wil.map")) == "map"
    refused(InputError, "but a line file", kind_of, sample("CH_StGallen_Wil.line.json"))
    for unknown in ("Europe/Wil", "", "+02:00:30", "UTC+02:75", "-01:00.5"):
        refused(InputError, "is not a time zone", known_zone, unknown)


@pytest.mark.usefixtures("unpainted_page")
def test_a_bad_file_of_a_folder_is_stated_by_its_name_with_status_1(tmp_path, shell):
    pages = []
    for place in ("here", "there"):
        folder = tmp_path / place / "results"
        folder.mkdir(parents=True)
        write_trajectory(planned(), folder / "plan.json")
        (folder / "none.mcap").write_text("nothing")
        output = tmp_path / f"{place}.html"
        status, _, complaint = shell("report", folder, "-o", output)
        assert status == 1
        assert complaint.count("\n") == 1
        assert "not shown: none.mcap: none.mcap" in complaint
        pages.append(output.read_bytes())
    # Where the folder stands makes no difference.
    assert pages[0] == pages[1]
    assert str(tmp_path).encode() not in pages[0]


def test_without_bokeh_the_page_has_still_pictures_and_says_so(tmp_path, monkeypatch):
    for module in (build, pages):
        monkeypatch.setattr(module, "find_spec", lambda _: None)
    write_trajectory(planned(), tmp_path / "plan.json")
    write_report(tmp_path / "plan.json", tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    assert "<script" not in text
    assert "script-src 'none'" in text
    assert "pip install &#x27;trainlog[report]&#x27;" in text
    assert text.count("<svg") == 1
    assert len(text) < 1_000_000


def test_a_page_that_would_be_too_large_stands_still(tmp_path, monkeypatch):
    x = np.linspace(0.0, 10.0, 50)
    curves = [Curve("speed", x, x**2, hover={"km": ["1"] * 50})]
    page = Page("Curve", "", [Section("Chart", [Chart("km", [Panel("km/h", curves)])])])
    monkeypatch.setattr("analysis.reports.page.LARGEST", 500_000)
    page.write(tmp_path / "page.html")
    text = (tmp_path / "page.html").read_text("utf-8")
    assert "stand still here" in text
    assert "<script" not in text
    monkeypatch.setattr("analysis.reports.page.LARGEST", 5_000)
    refused(InputError, "the report would have", page.write, tmp_path / "page.html")
    assert (tmp_path / "page.html").read_text("utf-8") == text


def test_the_legend_of_a_narrow_chart_alone_is_inside_it():
    names = [f"maximum adhesion {number}" for number in range(4)]
    panel = Panel("adhesion", [Curve(name, [0.0, 1.0], [0.0, 1.0]) for name in names])
    figure = figure_of(Chart("km", [panel], width=0.2))
    figure.canvas.draw()
    legend = figure.axes[0].get_legend().get_window_extent()
    assert figure.bbox.x0 <= legend.x0
    assert legend.x1 <= figure.bbox.x1


def test_thinning_keeps_every_peak_and_both_ends():
    rng = np.random.default_rng(1)
    values = rng.normal(size=200_000)
    values[[123_456, 7]] = 50.0, -50.0
    rows = rows_to_draw(values)
    assert {0, 7, 123_456, values.size - 1} <= set(rows.tolist())
    assert rows.size < 4_000
    gap = values.copy()
    gap[1_000:150_000] = np.nan
    assert np.nanmax(gap[rows_to_draw(gap)]) == np.nanmax(gap)


@pytest.mark.usefixtures("unpainted_page")
def test_a_summary_states_what_is_not_known_and_why(tmp_path):
    trip = read_log(sample("stopping.mcap"))
    controls = trip["/train/controls"]
    kept = (controls.index < controls.index[6_000]) | (controls.index > controls.index[6_200])
    topics = {name: frame for name, frame in trip.topics.items() if name != "/train/axles"}
    lineless = {name: data for name, data in trip.attachments.items() if name != "line.json"}
    topics |= {"/train/controls": controls[kept]}
    write_log(replace(trip, topics=topics), tmp_path / "a.mcap")
    write_log(replace(trip, attachments=lineless), tmp_path / "b.mcap")
    write_report(tmp_path / "a.mcap", tmp_path / "a.html")
    page = (tmp_path / "a.html").read_text("utf-8")
    first = page[page.index('id="section-1"') : page.index('id="section-2"')]
    assert "nan" not in first
    assert "energy not known: no effort for 20 s: km" in first
    assert "not known: no wheel speeds recorded" in first
    # Without a line it is asked for, before a fit.
    write_report(tmp_path / "b.mcap", tmp_path / "b.html")
    page = (tmp_path / "b.html").read_text("utf-8")
    assert "b.mcap has no line: trainlog ingest RECORDING --line LINE -o FOLDER" in page
    assert "fit the running resistance: " not in page


def test_the_verdict_on_a_recording_gives_its_reasons():
    trip = read_log(sample("stopping.mcap"))
    state = trip["/train/state"]

    def without(first: int, last: int) -> pd.DataFrame:
        return state[(state.index < state.index[first]) | (state.index > state.index[last])]

    for changed, level, said in (
        ({}, 0, "good"),
        ({"/train/state": without(4_000, 4_500)}, 1, "1 gap, 50 s in all"),
        ({"/train/state": without(2_000, 8_000)}, 2, "1 gap"),
        ({"/train/axles": None}, 0, "not recorded: wheel speeds, wheel efforts"),
        ({"/train/state": state.assign(position=np.nan)}, 2, "not recorded: position"),
    ):
        topics = {**trip.topics, **changed}
        kept = {name: frame for name, frame in topics.items() if frame is not None}
        found = verdict(replace(trip, topics=kept))
        assert (found.level, said in str(found)) == (level, True), str(found)
    damaged = verdict(TripView(trip, damage="12 messages are lost."))
    assert str(damaged) == "usable with reservations: 12 messages are lost"


def test_a_speed_is_off_against_what_it_was_compared_with_unless_the_clock_is_doubtful():
    """Without satellites, and with speeds that are 3 % too high."""
    trip = read_log(sample("stopping.mcap"))
    state = trip["/train/state"]
    topics = {name: each for name, each in trip.topics.items() if "gnss" not in name}
    faster = state.assign(speed=1.03 * state["speed"])
    fast = replace(trip, topics={**topics, "/train/state": faster})
    assert re.search(r"is \+[23]\.\d% off, compared with recorded distance", str(verdict(fast)))
    for rule, counter in (
        ("clock_jump", ""),
        ("position_steps", " or the counter of the distance"),
    ):
        # As if ingest had made it with such a finding.
        made_by = Report(10_000, 10_000, (Finding(rule, 3, (1,)),))
        step = {"step": "ingest", "report": made_by.details()}
        made = replace(fast, metadata=fast.metadata | made_by.metadata(), provenance=(step,))
        assert "% off" not in str(verdict(made))
        assert f"the clock{counter} is doubtful ({rule}=3)" in str(verdict(made))
        assert verdict(made).level == 1


@pytest.mark.usefixtures("unpainted_page")
def test_the_report_of_a_folder_begins_with_answers_and_ends_with_its_files(tmp_path):
    (tmp_path / "trips").mkdir()
    for name in ("a.mcap", "b.mcap"):
        shutil.copy(sample("nonstop.mcap"), tmp_path / "trips" / name)
    write_trajectory(planned(), tmp_path / "plan.json")
    page = write_report(tmp_path, tmp_path.parent / "page.html")
    (answers,) = page.sections[0].parts
    said = dict(answers.rows)
    assert said["trips"].startswith("recorded: 1 trip, 0.3 h; 1 recording more of these drives")
    assert said["recording"] == "2 good"
    assert "trajectory: " in said["energy"]
    assert "kWh a trip of traction at the wheel rims" in said["energy"]
    assert said["slippery places"].startswith("slip protection acted on 2 of 2 trips")
    files, made_of = page.sections[-1].parts[:2]
    assert [row[0] for row in files.rows] == ["plan.json", "trips/a.mcap", "trips/b.mcap"]
    assert ["trips/a.mcap", "simulate"] in [list(row[:2]) for row in made_of.rows]
    assert not any("{" in cell for row in made_of.rows for cell in row)


def test_a_trip_with_a_course_is_drawn():
    trip = read_log(sample("stopping.mcap"))
    assert all(axes.has_data() for axes in trip.plot().axes)
    silent = replace(trip, topics={"/events": trip["/events"]})
    refused(InputError, "no speed with a position is recorded", silent.plot)


HEADINGS = ("section", "timetable s", "least of a reference s", "iterations of IPOPT", "least s")
ROW = ("Chemnitz Hbf - Chemnitz-Hilbersdorf", "222", "204.7", "41 (of 5000)", "180.2")


def printed(width: int) -> list[str]:
    """The lines of the table on a page of `width` columns."""
    table = new_table("A table", *HEADINGS)
    table.add_row(*ROW)
    console = Console(width=width)
    with console.capture() as captured:
        console.print(table)
    return captured.get().splitlines()


@given(width=st.integers(30, 220))
def test_however_narrow_the_page_words_stay_whole_and_what_is_left_out_is_named(width):
    lines = printed(width)
    assert max(map(len, lines)) <= width
    shown = " ".join(lines).replace(",", " ").split()
    assert all(word in shown for head in HEADINGS for word in head.split())
    assert all(word in shown for word in ROW[0].split())
    left_out = " ".join(lines).partition("not shown in")[2]
    for head, cell in zip(HEADINGS, ROW, strict=True):
        kept = all(word in shown for word in cell.split())
        assert kept or head in " ".join(left_out.split())


def test_what_cannot_be_compared_is_stated_among_the_results(tmp_path):
    trip = read_log(sample("nonstop.mcap"))
    backwards = {**trip.metadata, "direction": "reverse"}
    followed = {**trip.metadata, "trip": "driven", "configuration": "nominal"}
    for folder, metadata in (("trips", backwards), ("driven", followed)):
        (tmp_path / folder).mkdir()
        write_log(replace(trip, metadata=metadata), tmp_path / folder / "log.mcap")
    rows = {subject: words for subject, words, _ in report(tmp_path).rows}
    assert rows["recorded"].startswith("1 trip")
    assert rows["energy saved"].startswith("not compared: no trip that followed the trajectory")
    assert "not summed up: trip 'driven' followed no trajectory" in rows["following"]


def test_results_of_any_name_are_summed_up_by_their_format(tmp_path):
    log = sample("nonstop.mcap")
    found = fit(log)
    write_parameters(found.parameters, tmp_path / "campaign.json")
    write_coast_down(coast_down([log]).result, tmp_path / "coasted.json")
    shutil.copy(sample(DEFAULT_LINE), tmp_path / "ours.json")
    (tmp_path / "other.json").write_text('{"format": "another/parameters"}')
    rows = {Path(place).name: (subject, words) for subject, words, place in report(tmp_path).rows}
    assert set(rows) == {"campaign.json", "coasted.json", "ours.json"}
    subject, words = rows["campaign.json"]
    assert subject == "running resistance"
    (one,) = found.parameters.configurations
    assert f"mass {one.mass / 1e3:.1f} t" in words
    assert f"power {one.max_power / 1e3:.0f} kW (the train file's)" in words
    assert re.search(r"resistance [\d.]+ ± [\d.]+ kN at \d+ km/h", words)
    assert "resistance over inertia" in rows["coasted.json"][1]
    assert rows["ours.json"] == ("line", "CH_StGallen_Wil, 29.56 km")


def test_truth_belongs_to_a_trip_by_what_was_recorded(tmp_path):
    """Not by its name: unrelated simulated logs are called trip-01, too."""
    log = sample("nonstop.mcap")
    write_parameters(fit(log).parameters, tmp_path / "parameters.json")
    write_map(adhesion_map(log).track, tmp_path / "wil.map")
    (tmp_path / "trips").mkdir()
    own = shutil.copy(log, tmp_path / "trips" / "renamed.mcap")
    rows = {subject: words for subject, words, _ in report(tmp_path).rows}
    assert re.search(r"drag curve off by [\d.]+% for one trip", rows["running resistance"])
    assert re.search(r"maximum adhesion off by 0\.\d+ RMS", rows["track condition"])
    other = read_log(sample("stopping.mcap"))
    write_log(replace(other, metadata={**other.metadata, "trip": "trip-01"}), own)
    rows = {subject: words for subject, words, _ in report(tmp_path).rows}
    assert "drag curve" not in rows["running resistance"]
    assert "off by" not in rows["track condition"]
    # Nor does a truth of another trip lead to an error.
    write_log(other, own)
    broken = {**other.attachments, SCENARIO_ATTACHMENT: b"{}"}
    write_log(replace(other, attachments=broken), tmp_path / "trips" / "broken.mcap")
    assert "off by" not in " ".join(words for _, words, _ in report(tmp_path).rows)
    track, curve = read_map(sample("CH_StGallen_Wil.map")), RunningResistance(1.0, 0.0, 0.0)
    refused(InputError, "truth is given", curve_error, curve, [])
    refused(InputError, "truth is given", map_error, track, [])
    refused(InputError, "truth is given", true_adhesion, track, "wet", [])


def test_a_drive_counts_once_and_its_copies_beside_it(tmp_path):
    place = tmp_path / "october"
    place.mkdir()
    for name in ("nonstop", "stopping"):
        shutil.copy(sample(f"{name}.mcap"), place / f"{name}.mcap")
    trip = read_log(sample("stopping.mcap"))
    write_log(trip.between(None, "2024-10-07T08:15"), place / "copy.mcap")
    assert report(place).rows[0][1] == "2 trips, 0.7 h; 1 recording more of these drives"


PAGE_WIDTH, PAGE_HEIGHT = 688, 1009
"""What A4 has within the margins [px], 96 to the inch."""

CANVASES = """() => {
    const found = [];
    const walk = (root) => {
        for (const each of root.querySelectorAll("*")) {
            if (each.tagName === "CANVAS" && each.width > 0) found.push(each);
            if (each.shadowRoot) walk(each.shadowRoot);
        }
    };
    walk(document);
    return found.map((canvas) => {
        const data = canvas.getContext("2d").getImageData(0, 0, canvas.width, canvas.height).data;
        const colours = new Set();
        for (let i = 0; i < data.length; i += 4 * 37) colours.add(data.slice(i, i + 4).join(","));
        return {width: canvas.width, height: canvas.height, colours: colours.size,
                corner: [...data.slice(12 * canvas.width + 12, 12 * canvas.width + 16)]};
    });
}"""
"""Of each canvas: its size, the colours in it, and the colour near its corner."""

TOOLTIP = """() => {
    const texts = [];
    const walk = (root) => {
        for (const each of root.querySelectorAll("*")) {
            if (each.classList.contains("bk-Tooltip") && each.getClientRects().length)
                texts.push(each.shadowRoot ? each.shadowRoot.textContent : each.textContent);
            if (each.shadowRoot) walk(each.shadowRoot);
        }
    };
    walk(document);
    return texts.join(" ");
}"""


class Opened:
    """A report in the browser, with all that it complained of and asked for."""

    def __init__(self, browser: Any, file: Path, scheme: str) -> None:
        self.page = browser.new_page(viewport={"width": 1200, "height": 900}, color_scheme=scheme)
        self.complaints, self.requests = list[str](), list[str]()
        self.page.on("console", lambda said: self._heard(said.type, said.text))
        self.page.on("pageerror", lambda error: self.complaints.append(str(error)))
        self.page.on("request", lambda asked: self.requests.append(asked.url))
        self.page.goto(file.as_uri())
        self.page.wait_for_selector("html.drawn", timeout=30_000)
        self.page.wait_for_timeout(300)

    def _heard(self, kind: str, words: str) -> None:
        # How fast BokehJS reads its canvases back is not ours to say.
        if kind in ("error", "warning") and not words.startswith("Canvas2D: Multiple readback"):
            self.complaints.append(words)


@pytest.fixture(scope="module")
def page_file(tmp_path_factory: pytest.TempPathFactory, remembered: None) -> Path:
    """The report on a folder with results of every kind, and a file that is none."""
    del remembered
    folder = make_folder(tmp_path_factory.mktemp("browser") / "results")
    write_report(folder, folder.parent / "report.html")
    return folder.parent / "report.html"


@pytest.fixture(scope="module")
def light(page_file: Path) -> Iterator[Opened]:
    with browser_page() as page:
        yield Opened(page.context.browser, page_file, "light")


@pytest.mark.long
@pytest.mark.skipif(chromium() is None, reason="there is no Chromium")
class TestBrowser:
    """Drawn, light and dark, under the pointer and printed; no network."""

    def test_every_picture_is_drawn_light_and_dark_and_nothing_is_asked_for(self, light, page_file):
        dark = Opened(light.page.context.browser, page_file, "dark")
        assert SCRIPT in light.page.inner_text("main"), "a name that is a script is only shown"
        grounds = {}
        for name, opened in (("light", light), ("dark", dark)):
            assert opened.complaints == []
            assert opened.requests == [page_file.as_uri()]
            sizes = opened.page.locator("figure svg, figure img").evaluate_all(
                "all => all.filter(each => !each.closest('.still'))"
                ".map(each => [each.getBoundingClientRect().width,"
                " each.tagName === 'IMG' ? each.naturalHeight : each.getBBox().height])"
            )
            assert all(width > 200 and height > 50 for width, height in sizes)
            canvases = opened.page.evaluate(CANVASES)
            plots = opened.page.locator(".plot").count()
            assert len(sizes) + plots >= 9
            # Above each chart lies one for what the pointer shows, which is empty as yet.
            charts = [each for each in canvases if each["height"] > 80 and each["corner"][3]]
            assert len(charts) >= plots
            assert all(each["colours"] >= 3 for each in charts)
            grounds[name] = {tuple(each["corner"]) for each in charts}
        # A chart has the ground of its page.
        assert grounds["light"] == {(255, 255, 255, 255)}
        assert grounds["dark"] == {(22, 24, 28, 255)}

    def test_the_pointer_shows_values_and_a_name_in_the_legend_hides_its_curve(self, light):
        plot = light.page.locator(".plot").first
        plot.scroll_into_view_if_needed()
        box = plot.bounding_box()
        assert light.page.evaluate(TOOLTIP) == ""
        for share in (0.4, 0.5):
            light.page.mouse.move(box["x"] + share * box["width"], box["y"] + 0.5 * box["height"])
        light.page.wait_for_timeout(300)
        shown = light.page.evaluate(TOOLTIP)
        assert re.search(r"\d km/h", shown)
        assert "kN" in shown
        key = light.page.locator(".key", has_text="permitted speed").first
        visible = """() => [...Bokeh.documents].flatMap(each => [...each._all_models.values()])
            .filter(each => each.name === "permitted speed").map(each => each.visible)"""
        before = light.page.evaluate(visible)
        key.click()
        assert light.page.evaluate(visible).count(False) == 1
        key.click()
        assert light.page.evaluate(visible) == before

    def test_printed_pages_cut_no_row_and_no_picture(self, light):
        light.page.set_viewport_size({"width": PAGE_WIDTH, "height": PAGE_HEIGHT})
        light.page.emulate_media(media="print")
        whole = light.page.locator("figure, tr").evaluate_all(
            "all => all.map(each => [getComputedStyle(each).breakInside,"
            " each.getBoundingClientRect().height])"
        )
        assert {rule for rule, _ in whole} == {"avoid"}
        assert max(height for _, height in whole) <= PAGE_HEIGHT
        wide = light.page.locator(".table").evaluate_all(
            "all => all.filter(each => each.scrollWidth > each.clientWidth + 1).length"
        )
        assert wide == 0
        stills = light.page.locator(".still").evaluate_all(
            "all => all.map(each => each.getBoundingClientRect().height)"
        )
        assert min(stills) > 100
        assert light.page.locator(".plot").first.is_hidden()
        shown = light.page.locator("thead").first.evaluate("each => getComputedStyle(each).display")
        assert shown == "table-header-group"
        pdf = light.page.pdf(prefer_css_page_size=True)
        boxes = re.findall(rb"/MediaBox\s*\[0 0 ([\d.]+) ([\d.]+)\]", pdf)
        assert len(boxes) >= 8
        # A4, in points.
        assert {(round(float(a)), round(float(b))) for a, b in boxes} <= {(595, 842), (596, 842)}
        light.page.emulate_media(media="screen")
        light.page.set_viewport_size({"width": 1200, "height": 900})

    def test_on_a_narrow_screen_tables_scroll_and_charts_are_drawn_to_the_width(self, light):
        light.page.set_viewport_size({"width": 390, "height": 800})
        details = light.page.locator("details")
        details.evaluate_all("all => all.forEach(each => each.open = true)")
        light.page.wait_for_timeout(1_500)
        try:
            assert light.page.evaluate("() => document.documentElement.scrollWidth") <= 390
            wide = light.page.locator(".table").evaluate_all(
                "all => all.filter(each => each.scrollWidth > each.clientWidth + 1)"
                ".map(each => getComputedStyle(each).overflowX)"
            )
            assert set(wide) == {"auto"}
            charts = [each for each in light.page.evaluate(CANVASES) if each["height"] > 80]
            assert charts
            assert all(200 < each["width"] <= 390 for each in charts)
        finally:
            details.evaluate_all("all => all.forEach(each => each.open = false)")
            light.page.set_viewport_size({"width": 1200, "height": 900})
            light.page.wait_for_timeout(500)

    def test_details_are_folded_on_a_screen_and_open_in_print(self, light):
        seen = "all => all.map(each => each.checkVisibility())"
        folded = light.page.locator("details .inner")
        assert not any(folded.evaluate_all(seen))
        light.page.emulate_media(media="print")
        printed = folded.evaluate_all(seen)
        light.page.emulate_media(media="screen")
        assert all(printed)
        # The contents lead into what is folded, and open it.
        light.page.locator("nav a").last.click()
        light.page.wait_for_timeout(200)
        assert folded.evaluate_all(seen)[-1]
