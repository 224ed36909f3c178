"""The embedded line and train: found, sensible, and made again byte for byte."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from refusals import refused

from trainlog.errors import InputError
from trainlog.formats import samples
from trainlog.formats.railway import line_to_bytes, read_line, read_train, train_to_bytes
from trainlog.railway.geometry import plane_curve, similarity, to_plane

ROOT = Path(__file__).parents[1]
LIBRARY = ROOT.parent / "shared" / "data" / "ttobench"
TRACK = LIBRARY / "tracks" / "CH_StGallen_Wil.json"
TRAIN = LIBRARY / "trains" / "CH_Stadler_FLIRT_TPF.json"
needs_library = pytest.mark.skipif(not TRACK.is_file(), reason="the TTOBench library is not here")


def make_line() -> ModuleType:
    spec = importlib.util.spec_from_file_location("make_line", ROOT / "sample_logs/make_line.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@needs_library
def test_line_and_train_are_made_again_byte_for_byte(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "argv", ["make_line", str(TRACK), str(TRAIN), "-o", str(tmp_path)])
    make_line().main()
    for name in (samples.DEFAULT_LINE, samples.DEFAULT_TRAIN):
        assert (tmp_path / name).read_bytes() == samples.sample(name).read_bytes()
    assert "scale 1.000" in capsys.readouterr().out


def test_line_and_train_stand_in_canonical_form() -> None:
    line, train = (samples.sample(name) for name in (samples.DEFAULT_LINE, samples.DEFAULT_TRAIN))
    assert line_to_bytes(read_line(line)) == line.read_bytes()
    assert train_to_bytes(read_train(train)) == train.read_bytes()


def test_the_drawn_line_is_within_half_a_metre_of_its_curve() -> None:
    line = read_line(samples.sample(samples.DEFAULT_LINE))
    assert line.curvatures is not None
    assert line.geometry is not None
    assert line.geometry.positions[-1] == line.length
    positions, points = plane_curve(line.curvatures, line.length, step=5.0)
    drawn = to_plane(*line.geometry.at(positions), (47.43, 9.18))
    factor, shift = similarity(points, drawn)
    assert np.abs(factor * points + shift - drawn).max() < 0.5
    assert line.geometry.positions.size < 600


def test_a_missing_sample_is_reported_with_those_that_there_are(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    refused(InputError, r"there is no sample 'x'; there are .*FLIRT", samples.sample, "x")
    monkeypatch.setattr(samples, "_PLACES", (tmp_path,))
    with pytest.raises(InputError, match="the sample files are missing from this installation"):
        samples.sample(samples.DEFAULT_LINE)


def test_samples_are_copied(tmp_path: Path) -> None:
    copies = samples.copy_samples(tmp_path / "new" / "samples")
    assert [copy.name for copy in copies] == samples.names()
    assert all(copy.read_bytes() == samples.sample(copy.name).read_bytes() for copy in copies)
    assert samples.DEFAULT_TRAIN in samples.names()
    assert not any(name.endswith(".py") for name in samples.names())
    (tmp_path / "file").touch()
    with pytest.raises(InputError, match=r"cannot be made: .*; choose another folder"):
        samples.copy_samples(tmp_path / "file" / "below")
