"""MCAP files of other programs become trips: known messages by themselves, others by a profile."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from foreign_logs import FIX_2, IMU_2, START, ForeignLog, json_log, schema_text
from foxglove_schemas_protobuf.LocationFix_pb2 import LocationFix
from foxglove_schemas_protobuf.Log_pb2 import Log
from ingest_logs import profile
from mcap_protobuf.writer import Writer as ProtobufWriter
from mcap_ros2.writer import Writer as Ros2Writer
from mcap_trips import trip_of
from refusals import refused

from trainlog.errors import InputError
from trainlog.ingest import ingest, report_of
from trainlog.mcap import DamageWarning, read_log, write_log

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


def stamp(row, shift=0):
    return {"sec": START // SECOND + row + shift, "nanosec": 0}


def ros2_log(path, rows=40):
    """Fixes that are lost for rows 10 to 12, an IMU that does not measure turning, and words."""
    with path.open("wb") as stream:
        writer = Ros2Writer(stream)
        fix = writer.register_msgdef("sensor_msgs/msg/NavSatFix", FIX_2)
        imu = writer.register_msgdef("sensor_msgs/msg/Imu", IMU_2)
        twist = writer.register_msgdef("geometry_msgs/msg/TwistStamped", TWIST)
        log = writer.register_msgdef("rcl_interfaces/msg/Log", LOG)
        for row in range(rows):
            time = START + row * SECOND
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
        writer.write_message("/rosout", log, {"level": 30, "name": "node", "msg": "slip"}, START)
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
            time = START + row * SECOND
            writer.write_message("/fix", fix, message, time, time + 1000)
        writer.finish()
    trip = ingest(path, profile=profile({}, time={"column": column}))
    assert trip["/gnss/fix"].index[0] == pd.Timestamp(START + shift, unit="ns", tz="UTC")
    assert trip.metadata["clock"] == f"{column} of the MCAP file"


def test_time_as_a_number_in_the_message(tmp_path):
    messages = [{"t": 1_600_000_000_000 + 500 * row, "v": row} for row in range(9)]
    path = json_log(tmp_path / "odo.mcap", "/odo", messages)
    wanted = {"/train/state.speed": {"column": "/odo:v", "unit": "m/s"}}
    time = {"column": "t", "format": "epoch", "unit": "ms"}
    trip = ingest(path, profile=profile(wanted, time=time))
    assert trip["/train/state"].index[1] == pd.Timestamp(1_600_000_000.5, unit="s", tz="UTC")


def test_foxglove_fixes_and_logs_are_known(tmp_path):
    path = tmp_path / "foxglove.mcap"
    with path.open("wb") as stream:
        writer = ProtobufWriter(stream)
        for row in range(5):
            fix = LocationFix(latitude=47.0 + row * 1e-4, longitude=8.0, altitude=400.0)
            fix.position_covariance.extend([1.0, 0, 0, 0, 1.0, 0, 0, 0, 4.0])
            fix.position_covariance_type = LocationFix.DIAGONAL_KNOWN
            writer.write_message("/gps", fix, START + row * SECOND)
        writer.write_message("/a", Log(level=Log.ERROR, message="first", name="x"), START)
        writer.write_message("/b", Log(level=Log.INFO, message="second"), START + SECOND)
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
    wanted = {"/train/state.speed": {"column": "/odo:v", "unit": "m/s"}}
    report = report_of(ingest(path, profile=profile(wanted)))
    assert (report.rows_read, report.rows_kept) == (10, 8)
    assert report.count("damaged_messages") == 2
    assert "it is not JSON" in report.findings[0].note
    strict = profile(wanted, repair={"damaged_messages": False})
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
    known = {"/train/state.speed": {"column": "/odo:v", **speed}}
    timed = profile(known, time={"column": "stamp"})
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
    wanted = {"/train/state.speed": {"column": "/odo:v", "unit": "m/s"}}
    with pytest.warns(DamageWarning) as caught:
        trip = ingest(path, profile=profile(wanted))
    rows = len(trip["/train/state"])
    assert 0 < rows < 40_000
    assert trip["/train/state"]["speed"].tolist() == [row % 7 for row in range(rows)]
    assert caught[0].message.account.messages == rows
    assert "lost" in trip.metadata["damage"]
