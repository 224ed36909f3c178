"""A drive is known by what was recorded of it, and counts once in fit, coast-down and map."""

from __future__ import annotations

import random
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings, strategies as st
from ingest_logs import profile as recorder_profile
from refusals import refused

from analysis import adhesion_map, coast_down, fit, geometry_of
from analysis.estimates import estimate_log
from analysis.resistance.combination import SAME_DRIVE
from trainlog import InputError, identity_of, recover, sample
from trainlog.formats.mapfile import MapFile, map_to_bytes, merged
from trainlog.identity import SHARED, Known, TripIdentity, identity_from_text, same_drives
from trainlog.ingest import ingest, ingest_each
from trainlog.mcap import read_log, write_log
from trainlog.mcap.convert import convert
from trainlog.mcap.reader import identity_of_log

pytestmark = pytest.mark.usefixtures("remembered", "few_rounds", "unpainted", "analysed_once")

AALTO = Path(__file__).parents[2] / "shared" / "data" / "aalto"
LOG = sample("nonstop.mcap")
WHOLE = read_log(LOG)
MIDDLE = WHOLE.start + (WHOLE.end - WHOLE.start) / 2


def reloaded(folder: Path) -> Path:
    """As ingested again under another name, with another load."""
    metadata = {**WHOLE.metadata, "load": "31000", "trip": "again"}
    write_log(replace(WHOLE, metadata=metadata), folder / "reloaded.mcap")
    return folder / "reloaded.mcap"


def estimated(folder: Path) -> Path:
    estimate_log(LOG, folder / "estimated.mcap")
    return folder / "estimated.mcap"


def first_half(folder: Path) -> Path:
    convert(LOG, folder / "first.mcap", time=(None, MIDDLE))
    return folder / "first.mcap"


def second_half(folder: Path) -> Path:
    convert(LOG, folder / "second.mcap", time=(MIDDLE, None))
    return folder / "second.mcap"


def converted(folder: Path) -> Path:
    """To Parquet and back, without the topics that fit and map do not read."""
    topics = ["/train/state", "/train/controls", "/train/axles", "/gnss/motion"]
    convert(LOG, folder / "trip.parquet", topics=topics)
    convert(folder / "trip.parquet", folder / "converted.mcap")
    return folder / "converted.mcap"


def recovered(folder: Path) -> Path:
    """What is left of it after it was cut at some byte."""
    data = LOG.read_bytes()
    at = random.Random(folder.name).randrange(len(data) // 2, len(data) - 1000)
    (folder / "cut.broken").write_bytes(data[:at])
    recover(folder / "cut.broken", folder / "recovered.mcap")
    return folder / "recovered.mcap"


def overwritten(folder: Path) -> Path:
    """A log with a damaged place in its middle: some chunk is lost."""
    data = bytearray(LOG.read_bytes())
    at = random.Random(folder.name).randrange(len(data) // 3, len(data) // 2)
    data[at : at + 64] = bytes(64)
    (folder / "overwritten.mcap").write_bytes(data)
    return folder / "overwritten.mcap"


VERSIONS = (reloaded, estimated, first_half, second_half, converted, recovered, overwritten)
EQUAL = ("reloaded", "estimated", "converted")
"""Versions that hold all that was recorded."""


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {make.__name__: make(tmp_path_factory.mktemp(make.__name__)) for make in VERSIONS}


@pytest.mark.filterwarnings("ignore::trainlog.mcap.DamageWarning")
class TestIdentity:
    def test_a_drive_is_recognised_in_every_form(self, versions):
        whole = identity_of(WHOLE)
        for name, path in versions.items():
            found = identity_of_log(path)
            if name in EQUAL:
                assert found == whole
                continue
            assert found.samples < whole.samples
            # The minute in which it was cut, on one side and the other, is no whole one.
            lost = found.blocks.size - np.intersect1d(found.blocks, whole.blocks).size
            assert lost <= 2, name
            assert whole.shared(found) > 0.8

    def test_a_table_in_other_units_is_the_same_drive(self, tmp_path):
        """As CSV in km/h, in local time, with the load and the line not known."""
        state = WHOLE["/train/state"]
        times = pd.DatetimeIndex(state.index).tz_convert("Europe/Zurich")
        table = pd.DataFrame({"t": times.map(pd.Timestamp.isoformat), "v": 3.6 * state["speed"]})
        table.to_csv(tmp_path / "run.csv", index=False)
        columns = {"/train/state.speed": {"column": "v", "unit": "km/h"}}
        profile = recorder_profile(columns, time={"column": "t"})
        found, whole = identity_of(ingest(tmp_path / "run.csv", profile)), identity_of(WHOLE)
        np.testing.assert_array_equal(found.blocks, whole.blocks)
        assert same_drives([Known("table", found), Known("log", whole)])

    def test_what_recorded_neither_speed_nor_place_has_none(self):
        assert identity_of(replace(WHOLE, topics={"/events": WHOLE["/events"]})) is None
        assert identity_from_text("") is None
        refused(InputError, "is not the identity of a trip", identity_from_text, "2024-10-07 1 x")


@pytest.mark.skipif(not AALTO.is_dir(), reason="the Aalto data are not beside the checkout")
def test_rides_that_were_recorded_are_all_different(tmp_path):
    """Rides of a few phones, a fix every 11 s: none is another; each is known by its half."""
    rides = list(ingest_each(AALTO / "device_data.csv"))
    identities = [identity_of(ride) for ride in rides]
    known = [Known(ride.name, one) for ride, one in zip(rides, identities, strict=True)]
    assert len(known) == 73
    assert same_drives(known) == []
    again = [replace(ride, provenance=()) for ride in rides if ride.duration > 600.0]
    assert len(again) > 5
    for ride in again:
        part = identity_of(ride.between(None, ride.start + 0.6 * (ride.end - ride.start)))
        (found,) = same_drives([*known, Known("part", part)])
        assert (found.trip, found.of) == ("part", ride.name)


def drive(minutes: range, samples: int = 600) -> TripIdentity:
    """A made-up drive: its minutes are its numbers."""
    blocks = np.array(minutes, dtype=np.uint64)
    midnight = pd.Timestamp("2024-01-01", tz="UTC")
    ends = (midnight + pd.Timedelta(each, "min") for each in (minutes[0], minutes[-1] + 1))
    return TripIdentity(*ends, samples, blocks)


class TestSameDrives:
    @settings(max_examples=50)
    @given(order=st.permutations(range(6)))
    def test_what_is_left_out_does_not_depend_on_the_order(self, order):
        trips = [
            Known("whole", drive(range(100)), ("b",)),
            Known("copy", drive(range(100)), ("a",)),
            Known("first", drive(range(50)), ("c",)),
            Known("other", drive(range(200, 260)), ("d",)),
            Known("fuller", drive(range(200, 260), samples=601), ("e",)),
            Known("unknown", None, ("f",)),
        ]
        found = same_drives([trips[number] for number in order])
        left_out = {each.trip: each.of for each in found}
        assert left_out == {"whole": "copy", "first": "copy", "other": "fuller"}

    def test_parts_that_hardly_overlap_are_both_used(self):
        """Recorders that begin a new file each hour repeat the last minute or two."""
        hours = [range(0, 62), range(60, 122), range(120, 180)]
        assert all(len(set(a) & set(b)) <= SHARED * 60 for a, b in pairwise(hours))
        assert same_drives([Known(str(hour), drive(hour)) for hour in hours]) == []

    def test_the_recorded_file_decides_where_rules_have_moved_the_times(self):
        """A leap second found: no minute is as it was, but the file is the same."""
        one = replace(drive(range(60)), source="a")
        delay = pd.Timedelta(18, "s")
        moved = replace(drive(range(100, 160)), source="a", start=one.start, end=one.end + delay)
        (found,) = same_drives([Known("one", one), Known("moved", moved)])
        assert (found.trip, found.of) == ("moved", "one")
        later = replace(drive(range(60, 90)), source="a")
        assert same_drives([Known("one", one), Known("later", later)]) == []
        other = replace(moved, source="b")
        assert same_drives([Known("one", one), Known("other", other)]) == []


@pytest.mark.filterwarnings("ignore::trainlog.mcap.DamageWarning")
def test_a_fit_uses_a_drive_once_in_whatever_form(versions):
    """Which of two loads is right the samples do not say; that they differ is stated."""
    alone = fit([LOG])
    every = fit([LOG, *(path for name, path in versions.items() if name != "reloaded")])
    assert len(every.common.trips) == 1
    assert every.common.freedom == alone.common.freedom
    speed = np.linspace(0.0, 40.0, 9)
    np.testing.assert_array_equal(every.common.band(speed), alone.common.band(speed))
    assert len(every.same) + len(every.refused) == len(versions) - 1
    assert len(every.same) >= 4
    assert len(every.parameters.configurations) == 1
    assert every.parameters.cover["refused"][SAME_DRIVE] == len(every.same)
    both = fit([LOG, versions["reloaded"], versions["converted"]])
    (used,) = both.common.trips
    single = fit(versions["reloaded"]) if used == "again" else alone
    assert both.common.resistance == single.common.resistance
    np.testing.assert_array_equal(both.common.covariance, single.common.covariance)
    assert sum("the loads that were given differ" in words for words in both.same) in (1, 2)


@pytest.mark.filterwarnings("ignore::trainlog.mcap.DamageWarning")
def test_a_map_uses_a_drive_once_in_whatever_form(versions):
    alone = adhesion_map([LOG]).track
    paths = [LOG, *(versions[name] for name in ("estimated", "converted", "recovered"))]
    every = adhesion_map(paths)
    assert len(every.track.trips) == 1
    assert len(every.reasons) == 3
    for name, layer in alone.layers.items():
        found = every.track.layer(name)
        assert found.evidence == layer.evidence
        for field in ("events", "log_mean", "log_std"):
            np.testing.assert_array_equal(getattr(found, field), getattr(layer, field))
    assert map_to_bytes(adhesion_map(paths[::-1]).track) == map_to_bytes(every.track)
    # Its halves are two.
    halves = [versions["first_half"], versions["second_half"]]
    both = adhesion_map(halves).track
    assert len(both.trips) == 2
    whole = adhesion_map([LOG], both)
    assert whole.skipped == (WHOLE.name,)
    assert map_to_bytes(whole.track) == map_to_bytes(both)
    apart = [adhesion_map([half]).track for half in halves]
    with merged(map(MapFile.of_map, apart)) as together:
        assert map_to_bytes(together.read()) == map_to_bytes(both)
    twice = map(MapFile.of_map, (apart[0], alone))
    refused(InputError, "the sums of several maps hold one drive", merged, twice)


def test_a_line_rests_on_each_drive_once(versions):
    """Read twice, a ride would halve the variance of the centre line and of its gradients."""
    alone = geometry_of([WHOLE])
    again = replace(WHOLE, metadata={**WHOLE.metadata, "trip": "again"})
    found = geometry_of([again, WHOLE, read_log(versions["first_half"])])
    assert found.used == ("again",)
    assert {name for name, _ in found.refused} == {WHOLE.name}
    assert all("the same drive as 'again'" in reason for _, reason in found.refused)
    np.testing.assert_array_equal(found.std, alone.std)


def test_coast_down_uses_a_drive_once(versions):
    alone = coast_down([LOG])
    found = coast_down([LOG, versions["converted"], versions["first_half"]])
    assert len(found.trips) == 1
    assert len(found.refused) == 2
    assert all("same drive" in reason for reason in found.refused.values())
    np.testing.assert_array_equal(found.curve.theta, alone.curve.theta)
    np.testing.assert_array_equal(found.curve.covariance, alone.curve.covariance)
