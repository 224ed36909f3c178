"""Tables and summaries for people: nothing is lost, and words stay whole while there is space."""

from __future__ import annotations

import re
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import given, strategies as st
from refusals import refused
from rich.console import Console

from analysis import adhesion_map, coast_down, fit, report
from analysis.truth import curve_error, map_error, true_adhesion
from trainlog.errors import InputError
from trainlog.formats.mapfile import read_map, write_map
from trainlog.formats.railway import write_coast_down, write_parameters
from trainlog.formats.samples import DEFAULT_LINE, sample
from trainlog.mcap import read_log, write_log
from trainlog.presentation import new_table
from trainlog.railway import RunningResistance
from trainlog.trip import SCENARIO_ATTACHMENT

pytestmark = pytest.mark.usefixtures("remembered", "unpainted_page")

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
