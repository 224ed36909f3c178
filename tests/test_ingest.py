"""A simulated trip, written as foreign recorders write, comes back as it was."""

from __future__ import annotations

import hashlib
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from simulated_line import flirt, hilly_line, level_line

from trainlog import InputError, Trip, __version__, draw_scenarios, report_of, sample, simulate
from trainlog.formats.railway import line_of, train_of
from trainlog.ingest import PROFILE_ATTACHMENT, ingest
from trainlog.mcap import read_log, write_log
from trainlog.trip import LINE_ATTACHMENT, TRAIN_ATTACHMENT

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from foreign_recorders import write_recorder_csv, write_ublox_csv

PROFILE = sample("recorder.profile.toml")

LINE, TRAIN = hilly_line(), flirt()


@pytest.fixture(scope="module")
def driven() -> Trip:
    return simulate(draw_scenarios(LINE, TRAIN, 1, 7)[0])


def test_the_vehicle_recorders_file_comes_back(tmp_path, driven):
    """Within the file's own quantisation, and every defect counted."""
    path = tmp_path / "recorder.csv"
    defects = write_recorder_csv(driven, path)
    read = ingest(path, profile=PROFILE, line=LINE, train=TRAIN)
    report = report_of(read)
    assert report.rows_read == defects.rows
    assert report.counts == {
        "duplicates": defects.duplicates,
        "time_backwards": defects.backwards,
        "empty": defects.missing,
        "out_of_limits": defects.outliers,
        "gaps": defects.gaps,
    }
    assert report.rows_dropped == defects.duplicates
    steps = {"position": 0.05, "speed": 0.005 / 3.6, "lever": 0.0005, "wheel_speed": 0.005 / 3.6}
    for topic in ("/train/state", "/train/controls", "/train/axles"):
        old, new = driven[topic], read[topic]
        assert new.index.isin(old.index).all()
        old = old.loc[new.index]
        for column in new.columns:
            bound = steps.get(column.rstrip("_1234"), 50.0)
            if column in ("acceleration", "tractive_effort_demand", "braking_effort_demand"):
                assert new[column].isna().all(), "the recorder does not keep it"
                continue
            lost = new[column].isna()
            assert lost.sum() == (defects.missing + defects.outliers) * (column == "speed")
            error = np.abs(new[column] - old[column])[~lost]
            assert error.max() <= bound * (1.0 + 1e-9), f"{topic}.{column}"


def test_the_ublox_file_comes_back(tmp_path, driven):
    """Times to the nanosecond although the file has whole seconds; values to the last digit."""
    path = tmp_path / "gnss.csv"
    defects = write_ublox_csv(driven, path)
    read = ingest(path)
    report = report_of(read)
    assert report.rows_read == report.rows_kept == defects.rows
    assert report.count("gaps") == defects.gaps
    wild = report.count("spikes") + report.count("out_of_limits")
    assert wild == defects.outliers > 0
    for topic in ("/gnss/fix", "/gnss/motion"):
        old, new = driven[topic], read[topic]
        pd.testing.assert_index_equal(new.index, old.index, exact=False)
        for column in new.columns:
            known = new[column].notna()
            assert known.sum() == len(new) - (defects.outliers if column == "speed" else 0)
            np.testing.assert_allclose(new[column][known], old[column][known], rtol=0, atol=5e-9)


def test_what_was_done_is_reported_in_metadata_and_provenance(tmp_path, driven):
    path = tmp_path / "recorder.csv"
    write_recorder_csv(driven, path)
    stated = {"operator": "SOB", "weather": "wet"}
    trip = ingest(path, PROFILE, line=LINE, train=TRAIN, direction="reverse", metadata=stated)
    write_log(trip, tmp_path / "trip.mcap")
    kept, report = read_log(tmp_path / "trip.mcap"), report_of(trip)
    assert kept.metadata == trip.metadata
    known = {
        **stated, "trip": "recorder", "line": LINE.name, "train": TRAIN.name,
        "direction": "reverse", "start": trip.start.isoformat(),
        "repair.duplicates": str(report.count("duplicates")),
        "repair.empty./train/state.speed": str(report.count("empty")),
        "rows.dropped": str(report.rows_dropped),
    }  # fmt: skip
    assert {name: kept.metadata.get(name) for name in known} == known
    assert report_of(kept) == report
    assert line_of(kept).stations[0].name == "Dorf"
    assert train_of(kept).mass == TRAIN.mass
    (step,) = kept.provenance
    known = {"step": "ingest", "format": "csv", "software": f"trainlog {__version__}"}
    assert {name: step[name] for name in known} == known
    files = {"recorder.csv": path.read_bytes(), PROFILE_ATTACHMENT: PROFILE.read_bytes()}
    files |= {name: kept.attachments[name] for name in (LINE_ATTACHMENT, TRAIN_ATTACHMENT)}
    assert kept.attachments[PROFILE_ATTACHMENT] == files[PROFILE_ATTACHMENT]
    found = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
    assert {name: step["inputs"][name] for name in files} == found


def test_a_line_that_the_train_runs_out_of_is_refused():
    short = replace(level_line(5_000.0, limit=30.0), name="short")
    with pytest.raises(InputError, match=r"recorder\.csv: positions reach km 29\..*line 'short'"):
        ingest(sample("recorder.csv"), profile=PROFILE, line=short)
    long, before = replace(short, name="long", length=40_000.0), {"start_position": "-20000"}
    with pytest.raises(InputError, match=r"positions reach km -20\.0.*line 'long' begins at km 0"):
        ingest(sample("recorder.csv"), profile=PROFILE, line=long, metadata=before)
