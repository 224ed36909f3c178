"""Kilometres that people read and type are the operator's, the same everywhere."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from refusals import refused

from analysis.adhesion.slip import SlipAnalysis, slip
from analysis.reports import trip as report
from trainlog import DEFAULT_LINE, InputError, Line, LineReference, read_line, sample, write_line
from trainlog.cli.options import part_of
from trainlog.formats.railway import line_to_bytes
from trainlog.mcap import read_log, write_log
from trainlog.presentation import WordTable
from trainlog.railway.line import in_km, km_ticks, position_of
from trainlog.trip import LINE_ATTACHMENT

PLAIN = read_line(sample(DEFAULT_LINE))
LENGTH = PLAIN.length
FLAWIL = 14_476.1
JUMP = 12_000.0

KILOMETRES: dict[str, tuple[LineReference, Callable[[float], float]]] = {
    "rising": (
        LineReference("412", [0.0], [61_200.0], [61_200.0 + LENGTH]),
        lambda s: 61.2 + s / 1e3,
    ),
    "falling": (
        LineReference("850", [0.0], [85_700.0], [85_700.0 - LENGTH]),
        lambda s: 85.7 - s / 1e3,
    ),
    "jump": (
        LineReference(
            "11", [0.0, JUMP], [40_000.0, 53_500.0], [40_000.0 + JUMP, 41_500.0 + LENGTH]
        ),
        lambda s: (40.0 if s < JUMP else 41.5) + s / 1e3,
    ),
}
"""How three operators count the same line, and the same by hand from the chainage [m]."""


@pytest.fixture(
    scope="module",
    params=[
        pytest.param(each, marks=[pytest.mark.long] if each == "rising" else [])
        for each in KILOMETRES
    ],
)
def counted(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> tuple[Path, Line, Callable[[float], float]]:
    """A folder with the sample trip that stops, and its line, counted in one of the ways."""
    reference, expected = KILOMETRES[request.param]
    line = replace(PLAIN, reference=reference)
    folder = tmp_path_factory.mktemp(request.param)
    trip = read_log(sample("stopping.mcap"))
    attached = {**trip.attachments, LINE_ATTACHMENT: line_to_bytes(line)}
    write_log(replace(trip, attachments=attached), folder / "trip.mcap")
    write_line(line, folder / "own.line.json")
    return folder, line, expected


pytestmark = pytest.mark.usefixtures("remembered", "unpainted")


@pytest.fixture(autouse=True)
def wide_terminal(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "200")


def test_a_part_of_a_log_is_chosen_by_the_same_kilometres(counted, shell):
    folder, _, expected = counted
    log, out = folder / "trip.mcap", folder / "part.mcap"
    part = f"{expected(9_286.1):.3f}:{expected(FLAWIL):.3f}"
    assert shell("convert", log, "-o", out, "--km", part)[0] == 0
    chosen = read_log(out)["/train/state"]["position"]
    assert (chosen.min(), chosen.max()) == pytest.approx((9_286.1, FLAWIL), abs=10.0)
    replayed = [each["/train/state"]["position"] for each in part_of(log, None, None, part, 10**6)]
    assert replayed[0].min() == chosen.min()
    assert replayed[-1].max() == chosen.max()
    commands = (
        ("convert", log, "-o", folder / "none.mcap", "--km", "3:7"),
        ("replay", log, "-o", folder / "none.rrd", "--km", "3:7"),
        (
            *("plan", "--line", folder / "own.line.json", "--train", "sample"),
            *("-o", folder / "t.json", "--km", "3:7"),
        ),
    )
    reach = f"its kilometres are {expected(0.0):.3f} to {expected(LENGTH):.3f}"
    for words in commands:
        status, _, problem = shell(*words)
        assert status == 2, words
        assert "has no km 3" in problem
        assert reach in problem


@pytest.mark.parametrize("name", KILOMETRES)
def test_a_kilometre_gives_its_place_again(name):
    reference, expected = KILOMETRES[name]
    line = replace(PLAIN, reference=reference)
    for place in np.linspace(0.0, LENGTH, 50).tolist():
        assert float(in_km(line, place)) == pytest.approx(expected(place))
        assert position_of(line, expected(place)) == pytest.approx(place, abs=1e-6)
    places, labels = km_ticks(line, 0.0, LENGTH)
    assert [float(each) for each in labels] == pytest.approx([expected(s) for s in places])


def test_a_kilometre_that_a_jump_leaves_out_is_refused():
    line = replace(PLAIN, reference=KILOMETRES["jump"][0])
    refused(InputError, r"no km 52\.7; .* jump from 52\.000 to 53\.500", position_of, line, 52.7)


@pytest.mark.parametrize("counted", ["jump"], indirect=True)
def test_a_report_names_a_place_by_the_same_kilometre(counted, monkeypatch):
    folder, _, expected = counted
    found = list[SlipAnalysis]()
    monkeypatch.setattr(report, "slip", lambda trip: found.append(slip(trip)) or found[-1])
    sections = report.trip_sections(folder / "trip.mcap")
    tables = {
        section.title: [part for part in section.parts if isinstance(part, WordTable)]
        for section in sections
    }
    (stops,) = tables["Stops and stations"]
    names, kilometres = ([each[column] for each in stops.words] for column in (0, 1))
    row = names.index("Flawil")
    assert float(kilometres[row]) == pytest.approx(expected(FLAWIL), abs=0.02)
    events = tables["Slip"][-1]
    listed = [float(each[1]) for each in events.words]
    places = [expected(each) for each in found[0].events["position"]]
    assert listed
    assert all(min(abs(each - place) for place in places) < 0.001 for each in listed)
