"""Telegrams of a fixed layout: from a file, a capture, live; whole, damaged, wrongly described."""

from __future__ import annotations

import socket
import struct
import threading
from pathlib import Path
from typing import Any

import dpkt
import numpy as np
import pandas as pd
import pytest
from contents import put
from hypothesis import given, settings, strategies as st
from ingest_logs import HEAD, START, Run, clean_run
from refusals import refused

import trainlog
from trainlog.declaration import from_content
from trainlog.errors import InputError
from trainlog.ingest import ingest, profile_of, report_of
from trainlog.ingest.live import LiveIngest, LiveOptions
from trainlog.ingest.pipeline import Given
from trainlog.ingest.profile import Profile, TelegramOptions
from trainlog.ingest.sources import Datagrams
from trainlog.ingest.telegrams import columns_of, field_values

STATE = "/train/state"

LAYOUT: dict[str, Any] = {
    "length": 24,
    "byte_order": "big",
    "mark": "a55a",
    "where": {"kind": 7},
    "fields": {
        "kind": {"offset": 2, "type": "uint8"},
        "sequence": {"offset": 3, "type": "uint8"},
        "second": {"offset": 4, "type": "uint32"},
        "hundredth": {"offset": 8, "type": "uint8"},
        "flags": {"offset": 9, "type": "uint8", "bit": 4, "bits": 2, "words": {"1": "slip"}},
        "speed": {"offset": 10, "type": "uint16", "missing": [65535]},
        "distance": {"offset": 12, "type": "int32", "byte_order": "little"},
        "force": {"offset": 16, "type": "int16", "count": 2},
        "lever": {"offset": 20, "type": "float32"},
    },
}

PROFILE: dict[str, Any] = {
    **HEAD,
    "file": {"format": "telegrams"},
    "telegram": LAYOUT,
    "time": {"columns": ["second", "hundredth"], "format": "epoch", "fraction": 0.01},
    "columns": {
        "/train/state.speed": {"column": "speed", "unit": "cm/s"},
        "/train/state.position": {"column": "distance", "unit": "dm"},
        "/train/controls.tractive_effort": {"column": "force.1", "unit": "kN", "scale": 0.1},
        "/train/controls.dynamic_braking_effort": {"column": "force.2"}
        | {"unit": "kN", "scale": 0.1, "unproven": True},
        "/train/controls.lever": {"column": "lever", "unit": "%"},
        "/events.message": {"column": "flags"},
    },
}


def profile(**telegram: Any) -> Profile:
    return profile_of({**PROFILE, "telegram": {**LAYOUT, **telegram}})


def telegrams(run: Run, kind: int = 7) -> list[bytes]:
    """The run as a control system would send it, written number by number."""
    found = []
    for number, (time, speed, position) in enumerate(
        zip(run.time.tolist(), run.speed.tolist(), run.position.tolist(), strict=True)
    ):
        stamp = divmod(round(time / 1e7), 100)
        slips = 0b00010000 if number % 10 == 3 else 0b11000000
        cm, dm = round(speed * 100), round(position * 10)
        head = struct.pack(">HBBIBBH", 0xA55A, kind, number % 256, *stamp, slips, cm)
        tail = struct.pack(">hhf", 10 * number, 5, 50.0)
        found.append(head + struct.pack("<i", dm) + tail)
    return found


def udp(payload: bytes, port: int = 5005) -> bytes:
    datagram = struct.pack(">HHHH", 4000, port, 8 + len(payload), 0) + payload
    address = socket.inet_aton("10.0.0.1"), socket.inet_aton("10.0.0.2")
    head = struct.pack(">BBHHHBBH", 0x45, 0, 20 + len(datagram), 1, 0, 64, 17, 0)
    return bytes(12) + b"\x08\x00" + head + b"".join(address) + datagram


def capture(path: Path, packets: list[tuple[int, bytes]], link: int = 1) -> Path:
    """A pcap file of packets with their times [ns]; 1: Ethernet, 101: IP alone."""
    data = struct.pack("<IHHiIII", 0xA1B2C3D4, 2, 4, 0, 0, 65535, link)
    for time, packet in packets:
        seconds, rest = divmod(time, 10**9)
        data += struct.pack("<IIII", seconds, rest // 1000, len(packet), len(packet)) + packet
    path.write_bytes(data)
    return path


def test_a_file_of_telegrams_gives_what_was_sent(tmp_path):
    run = clean_run(300, 0.2)
    sent = telegrams(run)
    sent[20] = sent[20][:10] + b"\xff\xff" + sent[20][12:]  # the number for no value
    trip = ingest(put(tmp_path / "run.bin", b"".join(sent)), profile=profile())
    state, controls = trip[STATE], trip["/train/controls"]
    assert np.array_equal(state.index.as_unit("ns").asi8, run.time)
    assert np.flatnonzero(state["speed"].isna()).tolist() == [20]
    assert report_of(trip).counts["empty"] == 1
    assert np.nanmax(np.abs(state["speed"].to_numpy() - run.speed)) <= 0.005 + 1e-9
    assert np.abs(state["position"].to_numpy() - run.position).max() <= 0.05 + 1e-9
    assert controls["tractive_effort"].tolist()[:3] == [0.0, 1000.0, 2000.0]
    assert set(controls["lever"]) == {0.5}
    # Bits 4 and 5 are 1 in every tenth telegram; 0 is no word.
    assert trip["/events"]["message"].tolist() == ["slip"] * 30
    stated = trip.metadata["unproven_units"]
    assert stated == "/train/controls.dynamic_braking_effort [kN]"


def test_telegrams_of_other_kinds_are_counted(tmp_path):
    run = clean_run(100, 1.0)
    mixed = [each for pair in zip(telegrams(run), telegrams(run, 8), strict=True) for each in pair]
    path = put(tmp_path / "run.bin", b"".join(mixed))
    trip = ingest(path, profile=profile())
    assert len(trip[STATE]) == 100
    assert trip.metadata["not_used.telegrams of other kinds"] == "100"
    message = refused(
        InputError, "none of 200 telegrams", ingest, path, profile=profile(where={"kind": 9})
    )
    assert "check where" in str(message)


@pytest.mark.parametrize(
    ("cut", "lost", "mark"),
    [
        ((1197, 1200), {49}, ""),
        ((490, 497), {20}, "a55a"),
        ((500, 507), {20, 21}, "a55a"),
        ((0, 5), {0}, "a55a"),
        # Which of the two lacks octets cannot be decided.
        ((24, 47), {0, 1}, "a55a"),
        ((1190, 1200), {49}, "a55a"),
    ],
)
def test_a_damaged_file_is_read_on_and_what_is_lost_counted(tmp_path, cut, lost, mark):
    run = clean_run(50, 1.0)
    whole = b"".join(telegrams(run))
    path = put(tmp_path / "run.bin", whole[: cut[0]] + whole[cut[1] :])
    trip = ingest(path, profile=profile(mark=mark))
    kept = [at for at in range(50) if at not in lost]
    assert np.array_equal(trip[STATE].index.as_unit("ns").asi8, run.time[kept])
    assert trip.metadata["repair.truncated_rows"] == "1"


def test_a_capture_gives_the_time_of_arrival(tmp_path):
    run = clean_run(60, 0.5)
    packets = [(int(t), udp(each)) for t, each in zip(run.time, telegrams(run), strict=True)]
    packets[10:10] = [
        (int(run.time[10]), udp(b"short")),
        (int(run.time[10]), udp(telegrams(run)[0], port=9)),
        (int(run.time[10]), bytes(12) + b"\x08\x06" + bytes(28)),
        (int(run.time[10]), udp(telegrams(run)[10])[:-9]),
    ]
    path = capture(tmp_path / "run.pcap", packets)
    by_arrival = {**PROFILE, "telegram": {**LAYOUT, "port": 5005}}
    by_arrival["time"] = {"column": "arrival", "format": "epoch", "unit": "ns"}
    trip = ingest(path, profile=profile_of(by_arrival))
    assert np.array_equal(trip[STATE].index.as_unit("ns").asi8, run.time)
    assert trip.metadata["not_used.datagrams of 5 bytes"] == "1"
    assert trip.metadata["not_used.datagrams to port 9"] == "1"
    assert trip.metadata["not_used.packets that are not UDP datagrams"] == "2"
    plain = put(tmp_path / "run.bin", b"".join(telegrams(run)))
    refused(InputError, "no time of arrival", ingest, plain, profile=profile_of(by_arrival))


def test_captures_of_other_kinds_are_read_alike(tmp_path):
    run = clean_run(30, 0.5)
    packets = [(int(t), udp(each)) for t, each in zip(run.time, telegrams(run), strict=True)]
    bare = capture(tmp_path / "ip.pcap", [(at, each[14:]) for at, each in packets], link=101)
    newer = tmp_path / "run.pcapng"
    with newer.open("wb") as file:
        writer = dpkt.pcapng.Writer(file)
        for at, each in packets:
            writer.writepkt(each, at / 1e9)
    for path in (bare, newer):
        trip = ingest(path, profile=profile())
        assert np.array_equal(trip[STATE].index.as_unit("ns").asi8, run.time)


def test_a_capture_that_is_cut_off_gives_its_whole_packets(tmp_path):
    run = clean_run(60, 0.5)
    packets = [(int(t), udp(each)) for t, each in zip(run.time, telegrams(run), strict=True)]
    path = capture(tmp_path / "run.pcap", packets)
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    trip = ingest(path, profile=profile())
    assert len(trip[STATE]) == 59
    assert trip.metadata["not_used.packets that are not UDP datagrams"] == "1"
    path.write_bytes(whole[: -len(packets[-1][1]) - 7])
    trip = ingest(path, profile=profile())
    assert len(trip[STATE]) == 59
    assert trip.metadata["repair.truncated_rows"] == "1"
    path.write_bytes(whole[:40])
    refused(InputError, "has no telegram|cannot be read", ingest, path, profile=profile())


def test_live_datagrams_give_what_their_file_gives(tmp_path):
    run = clean_run(200, 0.1)
    sent = telegrams(run)
    expected = ingest(put(tmp_path / "run.bin", b"".join(sent)), profile=profile())
    with Datagrams("0") as source:
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        raw = (tmp_path / "raw.bin").open("wb")
        recording, live = LiveIngest.begun(
            tmp_path / "live.mcap", Given(profile()), LiveOptions(source.name)
        )

        def send() -> None:
            for number, each in enumerate(sent):
                if number == 100:
                    out.sendto(b"no telegram", ("127.0.0.1", source.port))
                if number != 150:
                    out.sendto(each, ("127.0.0.1", source.port))

        sender = threading.Thread(target=send)
        with recording, out, raw:
            sender.start()
            live.follow(source, idle=0.5, raw=raw)
            live.close()
        sender.join()
    found = trainlog.read(tmp_path / "live.mcap")
    pd.testing.assert_frame_equal(
        found[STATE], expected[STATE].drop(expected[STATE].index[150]), check_flags=False
    )
    assert live.malformed == {"no telegram of the profile's layout": 1}
    assert live.numbering.counts["lost"] == 1
    # What was kept as it came is ingested like any file; one beside the odd datagram is in doubt.
    again = ingest(tmp_path / "raw.bin", profile=profile())
    rest = found[STATE].drop(found[STATE].index[99])
    pd.testing.assert_frame_equal(again[STATE], rest, check_flags=False)


CODES = {"int8": "b", "uint16": "H", "int32": "i", "uint64": "Q", "float32": "f", "float64": "d"}


@settings(max_examples=40)
@given(st.lists(st.sampled_from([*CODES]), min_size=1, max_size=6), st.booleans(), st.data())
def test_every_number_is_read_as_it_was_packed(kinds, big, data):
    values = []
    for kind in kinds:
        if kind.startswith("float"):
            width = int(kind.removeprefix("float"))
            drawn = st.floats(width=width, allow_nan=False, allow_infinity=False)
        else:
            drawn = st.integers(int(np.iinfo(kind).min), int(np.iinfo(kind).max))
        values.append(data.draw(drawn))
    packed = struct.pack("<>"[big] + "".join(CODES[kind] for kind in kinds), *values)
    offset, fields = 0, {}
    for number, kind in enumerate(kinds):
        fields[f"f{number}"] = {"offset": offset, "type": kind}
        offset += np.dtype(kind).itemsize
    content = {"length": len(packed), "byte_order": "big" if big else "little", "fields": fields}
    options = from_content(TelegramOptions, content)
    octets = np.frombuffer(packed, np.uint8)[None, :]
    found = [field_values(octets, options.fields[name], options)[0, 0].item() for name in fields]
    assert found == values
    assert columns_of(octets, list(fields), options).num_rows == 1


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"length": 23}, "field 'lever' ends at byte 24; the telegram has 23"),
        ({"mark": "xyz"}, "mark 'xyz' must be hexadecimal digits"),
        ({"where": {"kinds": 7}}, "no field 'kinds'; did you mean 'kind'"),
        ({"fields": {"speed": {"offset": 0, "type": "uint12"}}}, "type 'uint12' is not known"),
        ({"fields": {"speed": {"offset": 0, "type": "float32", "bit": 1}}}, "for whole numbers"),
        ({"fields": {"speed": {"offset": 0, "type": "uint8", "bit": 8}}}, "has no bit 8"),
        ({"fields": {"speed": {"offset": 0, "type": "uint8"}}, "where": {}}, "no field 'force.1'"),
    ],
)
def test_a_layout_that_cannot_be_is_refused(change, said):
    refused(InputError, said, profile, **change)


def test_a_file_without_a_profile_or_of_another_length_is_refused(tmp_path):
    path = put(tmp_path / "run.bin", b"\x00" * 20)
    refused(InputError, "no profile describes", ingest, path, format="telegrams")
    refused(InputError, "has no telegram of 24 bytes", ingest, path, profile=profile(mark=""))
    pcap = capture(tmp_path / "run.pcap", [(START, udp(b"x" * 20))])
    refused(InputError, "no profile describes", ingest, pcap)


def flirt(second: float, speed: float, acceleration: float, effort: float) -> bytes:
    """A status telegram of a Stadler FLIRT, number by number from the published layout."""
    whole = int(second)
    data = bytearray(184)
    struct.pack_into(">IB", data, 7, whole, round((second - whole) * 100))
    data[12] = int(second * 2) % 256
    struct.pack_into("<f", data, 16, speed * 3.6)
    struct.pack_into("<f", data, 28, acceleration)
    struct.pack_into("<f", data, 52, effort / 1e3)
    struct.pack_into("<4f", data, 56, *[effort * speed / 4e3] * 4)
    struct.pack_into("<f", data, 104, 4.9)
    struct.pack_into("<H", data, 144, 251)
    struct.pack_into("<h", data, 166, -35)
    struct.pack_into("<B", data, 170, round(speed * 3.6))
    struct.pack_into("<ff", data, 172, 6012.5, 2445.25)
    return bytes(data)


def test_the_telegram_of_a_flirt_becomes_a_trip(tmp_path):
    seconds = START / 1e9 + np.arange(0.0, 120.0, 0.5)
    motion = seconds - seconds[0]
    speed = 15.0 + 10.0 * np.sin(motion / 20.0)
    acceleration = 0.5 * np.cos(motion / 20.0)
    path = tmp_path / "status.bin"
    every = zip(seconds, speed, acceleration, strict=True)
    path.write_bytes(b"".join(flirt(t, v, a, 138_600.0 * a) for t, v, a in every))
    trip = ingest(path, format="stadler_flirt")
    state = trip[STATE]
    assert np.abs(state["speed"].to_numpy() - speed).max() < 1e-5
    assert np.abs(state["acceleration"].to_numpy() - acceleration).max() < 1e-6
    drive = trip["/train/controls"]
    force = drive["tractive_effort"] - drive["dynamic_braking_effort"]
    assert np.abs(force.to_numpy() - 138_600.0 * acceleration).max() < 0.1
    power = sum(trip["/recorded/motors"][f"power_{n}"] for n in range(1, 5))
    assert np.abs(power.to_numpy() - force.to_numpy() * speed).max() < 10.0
    assert trip["/train/brakes"]["brake_pipe_pressure"].iloc[0] == pytest.approx(4.9e5, rel=1e-6)
    assert trip["/train/supply"]["line_voltage"].iloc[0] == pytest.approx(25.1e3)
    assert trip["/environment"]["air_temperature"].iloc[0] == pytest.approx(269.65)
    fix = trip["/gnss/fix"].iloc[0]
    assert (fix["latitude"], fix["longitude"]) == pytest.approx((60 + 12.5 / 60, 24 + 45.25 / 60))
    assert "tractive_effort [kN]" in trip.metadata["unproven_units"]


ZTBUS = (
    "time_iso,time_unix,electric_powerDemand,gnss_altitude,gnss_course,gnss_latitude,gnss_longitude,"
    "itcs_busRoute,itcs_numberOfPassengers,itcs_stopName,odometry_articulationAngle,"
    "odometry_steeringAngle,odometry_vehicleSpeed,odometry_wheelSpeed_fl,odometry_wheelSpeed_fr,"
    "odometry_wheelSpeed_ml,odometry_wheelSpeed_mr,odometry_wheelSpeed_rl,odometry_wheelSpeed_rr,"
    "status_doorIsOpen,status_gridIsAvailable,status_haltBrakeIsActive,status_parkBrakeIsActive,"
    "temperature_ambient,traction_brakePressure,traction_tractionForce"
)


def test_a_mission_of_ztbus_needs_no_profile(tmp_path):
    run = clean_run(120, 1.0)
    stamps = pd.DatetimeIndex(run.time - run.time % 10**9, tz="UTC")
    force = 19e3 * np.gradient(run.speed)
    rows = [ZTBUS]
    for number, (at, speed, effort) in enumerate(zip(stamps, run.speed, force, strict=True)):
        passengers = "NaN" if number == 5 else "31"
        latitude = np.radians(47.37) + run.position[number] / 6_371_000.0
        rows.append(
            f"{at.strftime('%Y-%m-%dT%H:%M:%SZ')},{at.value // 10**9},{effort * speed + 5e3:.1f},"
            f"410.2,0.1,{latitude:.9f},{np.radians(8.54):.9f},33,{passengers},-,0.01,-0.02,"
            f"{speed:.3f},{speed:.3f},{speed * 1.01:.3f},{speed:.3f},{speed:.3f},{speed:.3f},"
            f"{speed:.3f},0,1,0,0,285.15,{2e5 if effort < 0 else 0:.0f},{effort:.1f}"
        )
    trip = ingest(put(tmp_path / "B183_2024-05-01.csv", rows))
    assert trip.provenance[0]["format"] == "ztbus"
    assert np.abs(trip[STATE]["speed"].to_numpy() - run.speed).max() < 1e-6
    drive = trip["/train/controls"]
    found = drive["tractive_effort"] - drive["dynamic_braking_effort"]
    assert np.abs(found.to_numpy() - force).max() < 0.06
    assert trip["/train/axles"].filter(like="wheel_speed").shape == (120, 3)
    assert trip["/gnss/fix"]["latitude"].iloc[0] == pytest.approx(47.37, abs=1e-6)
    own = trip["/recorded/ztbus"]
    assert own["passengers"].isna().sum() == 1
    assert own["brake_pressure"].max() == 2e5
