"""The samples are what their README says, and can be made again, value for value."""

import runpy
import sys
from pathlib import Path

import numpy as np
import pytest
from refusals import refused
from same_values import TOLERANCE, first_difference

import trainlog
from analysis.truth import truth_of
from trainlog.errors import InputError
from trainlog.formats import samples
from trainlog.formats.railway import line_to_bytes, read_line, read_train, train_to_bytes
from trainlog.formats.samples import DEFAULT_LINE, DEFAULT_TRAIN, folder, names, sample
from trainlog.railway.geometry import plane_curve, to_plane

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from make_line import similarity

pytestmark = pytest.mark.usefixtures("remembered")

SCRIPTS = Path(__file__).parents[1] / "sample_logs"
LIBRARY = Path(__file__).parents[2] / "shared" / "data" / "ttobench"
TRACK = LIBRARY / "tracks" / "CH_StGallen_Wil.json"
TRAIN = LIBRARY / "trains" / "CH_Stadler_FLIRT_TPF.json"
MADE = ("nonstop.mcap", "stopping.mcap", "recorder.csv", "gnss.csv", "CH_StGallen_Wil.map")


@pytest.mark.parametrize("script", ["make_logs", "make_consists"])
def test_the_scripts_make_them_again(script, tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(str(SCRIPTS))  # as where they are run by their paths
    runpy.run_path(str(SCRIPTS / f"{script}.py"))["make"](tmp_path)
    consists = [name for name in names() if name.endswith(".consist.json")]
    made = MADE if script == "make_logs" else consists
    differences = {name: first_difference(tmp_path / name, folder() / name) for name in made}
    assert differences == dict.fromkeys(made)


@pytest.mark.skipif(not TRACK.is_file(), reason="the TTOBench library is not here")
def test_line_and_train_are_made_again_byte_for_byte(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["make_line", str(TRACK), str(TRAIN), "-o", str(tmp_path)])
    runpy.run_path(str(SCRIPTS / "make_line.py"))["main"]()
    for name in (DEFAULT_LINE, DEFAULT_TRAIN):
        assert (tmp_path / name).read_bytes() == sample(name).read_bytes()
    assert "scale 1.000" in capsys.readouterr().out


def test_a_difference_beyond_rounding_is_reported(tmp_path):
    trip = trainlog.read(folder() / "nonstop.mcap")
    frame = trip["/truth"]
    for share in (0.1, 10.0):
        changed = frame.copy()
        changed.iloc[7, frame.columns.get_loc("speed")] += share * TOLERANCE * frame["speed"].max()
        trainlog.write(trip.with_topic(changed), tmp_path / "changed.mcap")
        found = first_difference(tmp_path / "changed.mcap", folder() / "nonstop.mcap")
        assert (found or "none").startswith("//truth/speed: row 7 is" if share > 1.0 else "none")


def test_they_are_what_the_readme_and_their_names_say():
    text = (folder() / "README.md").read_text("utf-8")
    assert [name for name in names() if f"`{name}`" not in text and name != "README.md"] == []
    nonstop, stopping = (trainlog.read(folder() / f"{n}.mcap") for n in ("nonstop", "stopping"))
    for trip, count in ((nonstop, 1), (stopping, 4)):
        assert trip["/events"].message.str.startswith("arrival").sum() == count
    assert nonstop.metadata["weather"] == "dry"
    assert stopping["/events"].message.str.contains("slip").any()
    assert truth_of(nonstop) is not None


def test_the_line_is_in_canonical_form_and_drawn_within_half_a_metre_of_its_curve():
    line = read_line(sample(DEFAULT_LINE))
    assert line_to_bytes(line) == sample(DEFAULT_LINE).read_bytes()
    assert train_to_bytes(read_train(sample(DEFAULT_TRAIN))) == sample(DEFAULT_TRAIN).read_bytes()
    positions, points = plane_curve(line.curvatures, line.length, step=5.0)
    drawn = to_plane(*line.geometry.at(positions), (47.43, 9.18))
    factor, shift = similarity(points, drawn)
    assert np.abs(factor * points + shift - drawn).max() < 0.5
    assert line.geometry.positions.size < 600


def test_samples_are_copied_and_a_missing_one_is_reported(tmp_path, monkeypatch):
    copies = samples.copy_samples(tmp_path / "new" / "samples")
    assert [copy.name for copy in copies] == names()
    assert all(copy.read_bytes() == sample(copy.name).read_bytes() for copy in copies)
    assert not any(name.endswith(".py") for name in names())
    (tmp_path / "file").touch()
    below = tmp_path / "file" / "below"
    refused(InputError, "cannot be made: .*; choose another folder", samples.copy_samples, below)
    refused(InputError, r"there is no sample 'x'; there are .*FLIRT", sample, "x")
    monkeypatch.setattr(samples, "_PLACES", (tmp_path,))
    refused(InputError, "sample files are missing from this installation", sample, DEFAULT_LINE)
