"""Positions and values that jump: single ones, runs of several, and the sample after them."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from ingest_logs import plain_profile, plain_rows, write
from recorder_files import MTK_HEADER, Drive, drive, mtk_rows

from trainlog.ingest import ingest, repairs_of, report_of
from trainlog.ingest.jumps import spikes

METRE = 1.0 / 111_195.0


def moved(run: Drive, places: np.ndarray, metres: np.ndarray, hdop: float | None = None) -> Drive:
    """The drive with fixes that lie beside it to the north."""
    latitude, stated = run.latitude.copy(), run.hdop.copy()
    latitude[places] += metres * METRE
    if hdop is not None:
        stated[places] = hdop
    return Drive(run.time, latitude, run.longitude, run.altitude, run.speed, stated, run.satellites)


def read_drive(tmp_path: Path, run: Drive, *, speed: bool = True) -> tuple[np.ndarray, object]:
    """Which fixes are absent, and the report."""
    rows = mtk_rows(run)
    if not speed:
        rows = [",".join([*row.split(",")[:10], "", row.split(",")[11]]) for row in rows]
    path = tmp_path / "run.csv"
    path.write_text("\n".join([MTK_HEADER, *rows]) + "\n", "ascii")
    trip = ingest(path)
    return trip["/gnss/fix"]["latitude"].isna().to_numpy(), report_of(trip)


@pytest.mark.parametrize("speed", [True, False])
@pytest.mark.parametrize(("rate", "metres"), [(1.0, 234.0), (5.0, -400.0), (10.0, 3_000.0)])
def test_fixes_beside_the_way_go(tmp_path: Path, rate: float, speed: bool, metres: float) -> None:
    """234 m beside it with a stated accuracy of 713 m; single ones and runs of several."""
    run = drive(round(600 * rate), rate, 2)
    places = np.array([40, 90, 91, 150, 151, 152, 153, 200, 202, len(run) - 30])
    absent, report = read_drive(tmp_path, moved(run, places, metres, 713 / 3), speed=speed)
    assert np.flatnonzero(absent).tolist() == places.tolist()
    assert report.count("spikes", "/gnss/fix.latitude") == places.size
    assert report.rows_dropped == 0


def test_a_poor_fix_where_the_train_may_be_stays(tmp_path: Path) -> None:
    run = drive(900, 1.0, 3)
    absent, report = read_drive(tmp_path, moved(run, np.array([100, 300]), 15.0, 713 / 3))
    assert not absent.any()
    assert report.count("spikes") == 0


@pytest.mark.parametrize("rate", [1.0, 5.0])
def test_fixes_that_come_back_from_an_outage_elsewhere_stay(tmp_path: Path, rate: float) -> None:
    """What was 150 m off before the tunnel, for a minute, is not judged by a jump."""
    run = drive(round(600 * rate), rate, 4)
    off = np.arange(round(200 * rate), round(260 * rate))
    absent, _ = read_drive(tmp_path, moved(run, off, 150.0))
    assert not absent.any()


def test_a_frozen_speed_makes_no_fix_a_jump(tmp_path: Path) -> None:
    """Between two outages there are a few sound fixes; the speed says that the train creeps."""
    run = drive(600, 1.0, 5)
    speed = run.speed.copy()
    speed[100:500] = 0.8
    frozen = Drive(
        run.time, run.latitude, run.longitude, run.altitude, speed, run.hdop, run.satellites
    )
    fast = 250 + int(np.argmax(run.speed[250:450]))
    seen = np.r_[0 : fast - 25, fast : fast + 3, fast + 28 : 600]
    absent, report = read_drive(tmp_path, frozen.take(seen))
    assert not absent.any()
    assert report.count("frozen", "/gnss/motion.speed") > 250


@pytest.mark.parametrize(
    ("length", "size"), [(1, 30.0), (2, -15.0), (3, 60.0), (4, 30.0), (5, -15.0), (7, 60.0)]
)
def test_runs_of_wild_speeds_go_and_the_sample_after_stays(
    tmp_path: Path, length: int, size: float
) -> None:
    rows = plain_rows(200)
    wild = [50, 120]
    for first in wild:
        for place in range(first, first + length):
            stamp, speed, position = rows[place].split(",")
            rows[place] = f"{stamp},{max(0.0, float(speed) + size):.3f},{position}"
    trip = ingest(write(tmp_path / "run.csv", rows), profile=plain_profile())
    absent = np.flatnonzero(trip["/train/state"]["speed"].isna())
    assert absent.tolist() == [place for first in wild for place in range(first, first + length)]
    assert len(repairs_of(trip)) == 2 * length == report_of(trip).count("spikes")


def test_a_value_that_stays_where_it_jumped_is_no_spike() -> None:
    time = np.arange(0.0, 60.0, 0.1)
    values = np.where(time < 30.0, 5.0, 300.0)
    assert not spikes(time, values, 1.0, 2.0).any()
    values[:20] = 900.0
    assert np.flatnonzero(spikes(time, values, 1.0, 2.0)).tolist() == list(range(20))
