"""Telegrams, from a file, a capture or live, and MCAP files of other programs become trips."""

from __future__ import annotations

import json
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
from foreign_logs import FIX_2, IMU_2, START as FIRST, ForeignLog, json_log, schema_text
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from hypothesis import given, settings, strategies as st
from ingest_logs import HEAD, START, Run, clean_run, profile
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from mcap_trips import trip_of
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
from trainlog.mcap import DamageWarning, read_log, write_log

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


def layout(**telegram: Any) -> Profile:
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
    trip = ingest(put(tmp_path / "run.bin", b"".join(sent)), profile=layout())
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
    trip = ingest(path, profile=layout())
    assert len(trip[STATE]) == 100
    assert trip.metadata["not_used.telegrams of other kinds"] == "100"
    message = refused(
        InputError, "none of 200 telegrams", ingest, path, profile=layout(where={"kind": 9})
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
    trip = ingest(path, profile=layout(mark=mark))
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


def test_captures_of_other_kinds_are_read_alike_and_the_whole_packets_of_one_cut_off(tmp_path):
    run = clean_run(60, 0.5)
    packets = [(int(t), udp(each)) for t, each in zip(run.time, telegrams(run), strict=True)]
    bare = capture(tmp_path / "ip.pcap", [(at, each[14:]) for at, each in packets], link=101)
    newer = tmp_path / "run.pcapng"
    with newer.open("wb") as file:
        writer = dpkt.pcapng.Writer(file)
        for at, each in packets:
            writer.writepkt(each, at / 1e9)
    for path in (bare, newer):
        trip = ingest(path, profile=layout())
        assert np.array_equal(trip[STATE].index.as_unit("ns").asi8, run.time)
    path = capture(tmp_path / "run.pcap", packets)
    whole = path.read_bytes()
    path.write_bytes(whole[:-20])
    trip = ingest(path, profile=layout())
    assert len(trip[STATE]) == 59
    assert trip.metadata["not_used.packets that are not UDP datagrams"] == "1"
    path.write_bytes(whole[: -len(packets[-1][1]) - 7])
    trip = ingest(path, profile=layout())
    assert len(trip[STATE]) == 59
    assert trip.metadata["repair.truncated_rows"] == "1"
    path.write_bytes(whole[:40])
    refused(InputError, "has no telegram|cannot be read", ingest, path, profile=layout())


def test_live_datagrams_give_what_their_file_gives(tmp_path):
    run = clean_run(200, 0.1)
    sent = telegrams(run)
    expected = ingest(put(tmp_path / "run.bin", b"".join(sent)), profile=layout())
    with Datagrams("0") as source:
        out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        raw = (tmp_path / "raw.bin").open("wb")
        recording, live = LiveIngest.begun(
            tmp_path / "live.mcap", Given(layout()), LiveOptions(source.name)
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
    again = ingest(tmp_path / "raw.bin", profile=layout())
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
    refused(InputError, said, layout, **change)


def test_a_file_without_a_profile_or_of_another_length_is_refused(tmp_path):
    path = put(tmp_path / "run.bin", b"\x00" * 20)
    refused(InputError, "no profile describes", ingest, path, format="telegrams")
    refused(InputError, "has no telegram of 24 bytes", ingest, path, profile=layout(mark=""))
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


SHARED = Path(__file__).parents[2] / "shared" / "data" / "foreign_mcap"
SECOND = 10**9
LATE = -5 * SECOND
LOG = "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\n"
TWIST = schema_text(
    "std_msgs/Header header\ngeometry_msgs/Twist twist",
    std_msgs__Header="builtin_interfaces/Time stamp\nstring frame_id",
    geometry_msgs__Twist="geometry_msgs/Vector3 linear\ngeometry_msgs/Vector3 angular",
    geometry_msgs__Vector3="float64 x\nfloat64 y\nfloat64 z",
)
ODO = {"/train/state.speed": {"column": "/odo:v", "unit": "m/s"}}


def stamp(row, shift=0):
    return {"sec": FIRST // SECOND + row + shift, "nanosec": 0}


def ros2_log(path, rows=40):
    """Fixes that are lost for rows 10 to 12, an IMU that does not measure turning, and words."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        fix = writer.register_msgdef("sensor_msgs/msg/NavSatFix", FIX_2)
        imu = writer.register_msgdef("sensor_msgs/msg/Imu", IMU_2)
        twist = writer.register_msgdef("geometry_msgs/msg/TwistStamped", TWIST)
        log = writer.register_msgdef("rcl_interfaces/msg/Log", LOG)
        for row in range(rows):
            time = FIRST + row * SECOND
            lost = 10 <= row < 13
            message = {
                "header": {"stamp": stamp(row, -5)},
                "status": {"status": -1 if lost else 0},
                "latitude": 47.0 + row * 1e-4,
                "longitude": 8.0,
                "altitude": 400.0,
                "position_covariance": [4.0, 0, 0, 0, 4.0, 0, 0, 0, 9.0 if row else -1.0],
                "position_covariance_type": 0 if row == 1 else 2,
            }
            writer.write_message("/fix", fix, message, time, time + 1000)
            message = {
                "header": {"stamp": stamp(row)},
                "angular_velocity_covariance": [-1.0] + [0.0] * 8,
                "linear_acceleration": {"x": 0.1, "y": row, "z": 9.81},
            }
            writer.write_message("/imu", imu, message, time, time)
            linear = {"x": 3.0 * row / 40, "y": -4.0 * row / 40}
            message = {"header": {"stamp": stamp(row)}, "twist": {"linear": linear}}
            writer.write_message("/vel", twist, message, time, time)
        writer.write_message("/rosout", log, {"level": 30, "name": "node", "msg": "slip"}, FIRST)
        writer.finish()
    return path


def test_known_messages_need_no_profile(tmp_path):
    trip = ingest(ros2_log(tmp_path / "bag.mcap"))
    fix = trip["/gnss/fix"]
    assert len(fix) == 37
    assert fix["latitude"].iloc[0] == 47.0
    assert fix["horizontal_accuracy"].iloc[0] == 2.0
    assert np.isnan(fix["vertical_accuracy"].iloc[0])
    assert np.isnan(fix["horizontal_accuracy"].iloc[1])
    assert fix["vertical_accuracy"].iloc[2] == 3.0
    imu = trip["/imu"]
    assert imu["specific_force_y"].tolist() == list(range(40))
    assert imu["specific_force_z"].tolist() == [9.81] * 40
    assert imu["angular_rate_x"].isna().all()
    assert trip["/events"][["level", "message", "name"]].values.tolist() == [[3, "slip", "node"]]
    assert "/gnss/motion" not in trip
    report = report_of(trip)
    assert report.count("no_fix") == 3
    assert report.not_used == {"/vel": 40}
    assert trip.metadata["source./gnss/fix"] == "/fix"
    assert trip.metadata["clock"] == "log_time of the MCAP file"
    step = trip.provenance[0]
    assert step["format"] == "mcap"
    assert len(step["inputs"]["bag.mcap"]) == 64


def test_a_profile_maps_any_field_by_path_and_unit(tmp_path):
    columns = {
        "/gnss/motion.speed": {"column": "/vel:twist.linear", "unit": "m/s"},
        "/train/state.speed": {"column": "/odo:wheels[0].v", "unit": "km/h", "sign": -1},
        "/train/state.position": {"column": "/odo:at.km", "unit": "km", "scale": -1, "offset": 9},
        "/train/axles.wheel_speed": {
            "columns": ["/odo:wheels[0].v", "/odo:wheels[1].v"],
            "unit": "km/h",
            "sign": -1,
        },
        "/environment.air_temperature": {"value": 12, "unit": "degC"},
    }
    path = ros2_log(tmp_path / "bag.mcap")
    trip = ingest(path, profile=profile({"/gnss/motion.speed": columns["/gnss/motion.speed"]}))
    assert trip["/gnss/motion"]["speed"].iloc[-1] == pytest.approx(5.0 * 39 / 40)
    assert len(trip["/gnss/fix"]) == 37
    odometry = [
        {"wheels": [{"v": -36.0 - row}, {"v": -36.0}], "at": {"km": 5.0 - row * 0.01}}
        for row in range(20)
    ]
    log = ForeignLog(tmp_path / "odo.mcap")
    log.add(log.channel("/odo", "json"), [json.dumps(each).encode() for each in odometry], SECOND)
    del columns["/gnss/motion.speed"]
    trip = ingest(log.close(), profile=profile(columns))
    state = trip["/train/state"]
    assert state["speed"].iloc[0] == pytest.approx(10.0)
    assert state["position"].iloc[[0, -1]].tolist() == pytest.approx([4_000.0, 4_190.0])
    assert trip["/train/axles"]["wheel_speed_1"].iloc[9] == pytest.approx(12.5)
    assert trip["/environment"]["air_temperature"].iloc[0] == pytest.approx(285.15)


@pytest.mark.parametrize(
    ("column", "shift"),
    [("log_time", 0), ("publish_time", 1000), ("stamp", LATE), ("header.stamp", LATE)],
)
def test_time_can_be_that_of_the_log_or_of_the_message(tmp_path, column, shift):
    path = tmp_path / "fixes.mcap"
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        fix = writer.register_msgdef("sensor_msgs/msg/NavSatFix", FIX_2)
        for row in range(5):
            message = {"header": {"stamp": stamp(row, -5)}, "latitude": 47.0, "longitude": 8.0}
            time = FIRST + row * SECOND
            writer.write_message("/fix", fix, message, time, time + 1000)
        writer.finish()
    trip = ingest(path, profile=profile({}, time={"column": column}))
    assert trip["/gnss/fix"].index[0] == pd.Timestamp(FIRST + shift, unit="ns", tz="UTC")
    assert trip.metadata["clock"] == f"{column} of the MCAP file"


def test_time_as_a_number_in_the_message(tmp_path):
    messages = [{"t": 1_600_000_000_000 + 500 * row, "v": row} for row in range(9)]
    path = json_log(tmp_path / "odo.mcap", "/odo", messages)
    time = {"column": "t", "format": "epoch", "unit": "ms"}
    trip = ingest(path, profile=profile(ODO, time=time))
    assert trip["/train/state"].index[1] == pd.Timestamp(1_600_000_000.5, unit="s", tz="UTC")


def test_foxglove_fixes_and_logs_are_known(tmp_path):
    path = tmp_path / "foxglove.mcap"
    with path.open("wb") as stream:
        writer = ProtobufWriter(stream)
        for row in range(5):
            fix = LocationFix(latitude=47.0 + row * 1e-4, longitude=8.0, altitude=400.0)
            fix.position_covariance.extend([1.0, 0, 0, 0, 1.0, 0, 0, 0, 4.0])
            fix.position_covariance_type = LocationFix.DIAGONAL_KNOWN
            writer.write_message("/gps", fix, FIRST + row * SECOND)
        writer.write_message("/a", Log(level=Log.ERROR, message="first", name="x"), FIRST)
        writer.write_message("/b", Log(level=Log.INFO, message="second"), FIRST + SECOND)
        writer.finish()
    trip = ingest(path)
    assert trip["/gnss/fix"]["vertical_accuracy"].tolist() == [2.0] * 5
    assert trip["/events"]["message"].tolist() == ["first", "second"]
    assert trip["/events"]["level"].tolist() == [4, 2]
    write_log(trip, tmp_path / "trip.mcap")
    assert len(read_log(tmp_path / "trip.mcap")["/gnss/fix"]) == 5


def test_messages_that_cannot_be_decoded_are_counted(tmp_path):
    messages = [{"v": row} for row in range(9)]
    messages[4:5] = [b"{", b"[1]"]
    path = json_log(tmp_path / "odo.mcap", "/odo", messages)
    report = report_of(ingest(path, profile=profile(ODO)))
    assert (report.rows_read, report.rows_kept) == (10, 8)
    assert report.count("damaged_messages") == 2
    assert "it is not JSON" in report.findings[0].note
    strict = profile(ODO, repair={"damaged_messages": False})
    refused(InputError, "2 times 'damaged_messages'", ingest, path, profile=strict)


def test_absent_fields_and_what_cannot_be_mapped_are_refused(tmp_path):
    path = json_log(tmp_path / "odo.mcap", "/odo", [{"v": 1.0, "w": 2.0}, {"v": 1.0, "w": 2.0}])
    speed = {"unit": "m/s"}
    for column, problem in (
        ("/odo:speed", "topic /odo has no field 'speed'"),
        ("/odometry:v", "no topic '/odometry'; did you mean '/odo'"),
        ("v", "'v' does not say which topic it is of"),
    ):
        given = profile({"/train/state.speed": {"column": column, **speed}})
        refused(InputError, problem, ingest, path, profile=given)
    timed = profile(ODO, time={"column": "stamp"})
    refused(InputError, "no time 'stamp'", ingest, path, profile=timed)
    axles = profile({"/train/axles.wheel_speed": {"columns": ["/odo:v", "/other:w"], **speed}})
    refused(InputError, "fields of several topics", ingest, path, profile=axles)
    refused(InputError, r"its topics: /odo; give a profile", ingest, path)
    log = ForeignLog(tmp_path / "flat.mcap")
    log.add(log.channel("/flat", "flatbuffer"), [b"?"])
    wanted = {"/train/state.speed": {"column": "/flat:v", "unit": "m/s"}}
    said = "cannot be decoded: encoding 'flatbuffer'"
    refused(InputError, said, ingest, log.close(), profile=profile(wanted))
    write_log(trip_of(rows=20), tmp_path / "trip.mcap")
    said = "is a log of trainlog, and a trip as it is; give it"
    refused(InputError, said, ingest, tmp_path / "trip.mcap")


def test_two_receivers_are_not_mixed(tmp_path):
    log = ForeignLog(tmp_path / "two.mcap")
    schema = ("foxglove.LocationFix", "jsonschema", b"{}")
    fixes = [json.dumps({"latitude": 47.0 + r * 1e-4, "longitude": 8}).encode() for r in range(4)]
    log.add(log.channel("/left", "json", schema), fixes, SECOND)
    log.add(log.channel("/right", "json", schema), fixes, SECOND)
    path = log.close()
    refused(InputError, r"/gnss/fix can come from /left or /right; say under", ingest, path)
    chosen = {
        "/gnss/fix.latitude": {"column": "/right:latitude", "unit": "deg"},
        "/gnss/fix.longitude": {"column": "/right:longitude", "unit": "deg"},
    }
    assert ingest(path, profile=profile(chosen)).metadata["source./gnss/fix"] == "/right"


@pytest.mark.skipif(not SHARED.exists(), reason="the shared data is not here")
def test_the_talker_of_rosbag2_becomes_events():
    trip = ingest(SHARED / "rosbag2_py_test_resources_mcap_talker_talker.mcap")
    assert trip["/events"]["message"].iloc[0] == "Publishing: 'Hello, world! 0'"
    assert trip["/events"]["level"].tolist() == [2] * 10
    assert report_of(trip).not_used == {"/topic": 10}
    with pytest.raises(InputError, match="holds nothing that can be mapped by itself"):
        ingest(SHARED / "rosbag2_tests_resources_mcap_cdr_test_cdr_test_0.mcap")


def test_a_damaged_file_gives_what_is_readable_and_says_so(tmp_path):
    path = json_log(tmp_path / "odo.mcap", "/odo", [{"v": row % 7} for row in range(40_000)])
    data = path.read_bytes()
    path.write_bytes(data[: len(data) * 2 // 3])
    with pytest.warns(DamageWarning) as caught:
        trip = ingest(path, profile=profile(ODO))
    rows = len(trip["/train/state"])
    assert 0 < rows < 40_000
    assert trip["/train/state"]["speed"].tolist() == [row % 7 for row in range(rows)]
    assert caught[0].message.account.messages == rows
    assert "lost" in trip.metadata["damage"]
