"""Recording from an MQTT broker: a real one (mosquitto), killed and started again."""

from __future__ import annotations

import json
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from killed import PATIENCE
from refusals import refused

import trainlog
from analysis.sfera import SferaOptions, write_sfera
from trainlog import InputError, Trip, sample
from trainlog.formats.sfera import read_sfera
from trainlog.formats.sfera_messages import Report, status_report, xml_of
from trainlog.ingest.live import LiveIngest, LiveOptions
from trainlog.ingest.pipeline import Given
from trainlog.ingest.sources import Subscription

sys.path.insert(0, str(Path(__file__).parents[1] / "sample_logs"))
from make_journey import DEPARTURE

JOURNEY = Path("sample_logs/CH_StGallen_Wil.sfera.zip")
MOSQUITTO = shutil.which("mosquitto") or shutil.which("mosquitto", path="/usr/sbin")

pytestmark = pytest.mark.skipif(
    MOSQUITTO is None, reason="the broker mosquitto is not installed (apt install mosquitto)"
)
mqtt = pytest.importorskip("paho.mqtt.client")


class Broker:
    """A broker that keeps sessions and messages on the disk."""

    def __init__(self, folder: Path) -> None:
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = int(free.getsockname()[1])
        self._file = folder / "mosquitto.conf"
        self._file.write_text(
            f"listener {self.port} 127.0.0.1\nallow_anonymous true\npersistence true\n"
            f"persistence_location {folder}/\nautosave_on_changes true\nautosave_interval 1\n"
            "max_queued_messages 0\nuser root\n"
        )
        self.start()

    def start(self) -> None:
        """Start it, and wait until it listens."""
        words = [MOSQUITTO, "-c", str(self._file)]
        self._process = subprocess.Popen(words, stderr=subprocess.DEVNULL)
        for _ in range(200):
            with socket.socket() as tried:
                if tried.connect_ex(("127.0.0.1", self.port)) == 0:
                    return
            time.sleep(0.05)
        raise AssertionError("mosquitto does not listen")

    def kill(self) -> None:
        """End it without a word."""
        self._process.send_signal(signal.SIGKILL)
        self._process.wait()


@pytest.fixture
def broker(tmp_path: Path) -> Iterator[Broker]:
    """A broker of one's own."""
    folder = tmp_path / "broker"
    folder.mkdir()
    found = Broker(folder)
    yield found
    found.kill()


class Publisher:
    """A train that publishes, and goes on where a broker was away."""

    def __init__(self, port: int, topic: str) -> None:
        self._topic = topic
        self._client = mqtt.Client(mqtt.CallbackAPIVersion.VERSION2, "train", clean_session=False)
        self._client.reconnect_delay_set(1, 1)
        self._client.connect("127.0.0.1", port)
        self._client.loop_start()
        self._client.on_publish = lambda *_: setattr(self, "left", self.left - 1)
        self.left = 0

    def publish(self, data: bytes) -> None:
        """Give a message to the broker, now or once it is there again."""
        self.left += 1
        self._client.publish(self._topic, data, qos=1)

    def close(self) -> None:
        """Wait until the broker has them all."""
        began = time.monotonic()
        while self.left and time.monotonic() - began < PATIENCE:
            time.sleep(0.02)
        self._client.disconnect()
        self._client.loop_stop()


def speed(second: int) -> bytes:
    time_of = f"2026-05-17T06:{second // 60:02d}:{second % 60:02d}Z"
    values = {"topic": "/train/state", "time": time_of, "position": 20.0 * second, "speed": 20.0}
    return json.dumps(values | {"sequence": second}).encode()


def recorded(source: Subscription, path: Path, idle: float) -> Trip:
    """The log of what a broker gives."""
    recording, live = LiveIngest.begun(path, Given(), LiveOptions(source.name))
    with recording:
        live.follow(source, idle=idle)
        live.close()
    return trainlog.read(path)


@pytest.mark.long
def test_a_broker_that_is_killed_and_started_again_loses_nothing(broker, tmp_path):
    """Of 600 messages at 200 a second; the broker is killed twice, the recorder is left alone."""
    with Subscription(f"127.0.0.1:{broker.port}/trains/17") as source:
        train = Publisher(broker.port, "trains/17")

        def send() -> None:
            for second in range(600):
                if second in (200, 400):
                    broker.kill()
                    broker.start()
                train.publish(speed(second))
                time.sleep(0.005)
            train.close()

        sending = threading.Thread(target=send)
        sending.start()
        state = recorded(source, tmp_path / "a.mcap", 6.0)["/train/state"]
        sending.join(PATIENCE)
    assert source.lost == 0
    assert state.position.to_numpy().tolist() == [20.0 * second for second in range(600)]


def test_what_comes_while_the_recorder_is_away_is_kept_for_it(broker, tmp_path):
    address = f"127.0.0.1:{broker.port}/trains/%2B/reports"
    with Subscription(address):
        pass
    train = Publisher(broker.port, "trains/17/reports")
    for second in range(30):
        train.publish(speed(second))
    train.close()
    with Subscription(address) as source:
        assert len(recorded(source, tmp_path / "a.mcap", 1.0)["/train/state"]) == 30


def test_status_reports_of_sfera_are_recorded_as_they_come(broker, tmp_path, works):
    """The command, with the sample's journey; the same as ingesting the archive of the reports."""
    (journey,) = read_sfera(JOURNEY)
    log, topic = tmp_path / "a.mcap", f"127.0.0.1:{broker.port}/trains/17"
    with Subscription(topic):
        pass
    train = Publisher(broker.port, "trains/17")
    for number in range(100):
        report = Report(
            DEPARTURE + timedelta(seconds=5 * number), 100.0 * number, 20.0, slips=40 < number < 45
        )
        train.publish(xml_of(status_report(report, journey.segments, journey.profile, "unit")))
    train.publish(b"<broken")
    train.close()
    words = ["record", topic, "--from", "mqtt", "--line", str(JOURNEY), "--idle", "1s"]
    works(*words, "-o", log)
    trip = trainlog.read(log)
    assert trip["/train/state"].position.to_numpy().tolist() == pytest.approx(
        [100.0 * number for number in range(100)], abs=1e-3
    )
    events = trip["/events"]
    assert (events.name == "slip protection").sum() == 1
    assert events.message.str.contains("malformed line 101").sum() == 1
    assert trip.metadata["line"] == journey.line.name


def test_a_trip_is_published_as_it_ran_and_recorded_again(broker, tmp_path, works):
    topic = f"127.0.0.1:{broker.port}/trains/17"
    with Subscription(topic):
        pass
    options = SferaOptions(every=10.0, publish=topic, pace=2000.0)
    began = time.monotonic()
    said = write_sfera([sample("nonstop.mcap")], JOURNEY, tmp_path / "reports.zip", options)
    lasted = time.monotonic() - began
    words = ["record", topic, "--from", "mqtt", "--line", str(JOURNEY), "--idle", "1s"]
    works(*words, "-o", tmp_path / "a.mcap")
    state = trainlog.read(tmp_path / "a.mcap")["/train/state"]
    assert len(state) == said["published"] == said["reports"]
    own = trainlog.read(sample("nonstop.mcap"))["/train/state"]
    run = (own.index[-1] - own.index[0]).total_seconds()
    assert lasted > 0.9 * run / 2000.0
    assert state.position.iloc[-1] == pytest.approx(own.position.dropna().iloc[-1], abs=300.0)


def test_what_is_no_broker_or_cannot_be_published_is_one_line(tmp_path):
    for address, said in (
        ("", "'' is not a topic of a broker"),
        ("localhost", "'localhost' is not a topic of a broker"),
        ("http://localhost/a", "is not a topic of a broker"),
        ("127.0.0.1:1/a", "the broker 127.0.0.1:1 cannot be subscribed to: connection refused"),
    ):
        assert refused(InputError, said, Subscription, address).remedy
    for given, address, said in (
        (tmp_path / "forecast.csv", "localhost/a", "--publish goes with a trip"),
        (sample("nonstop.mcap"), "localhost/trains/+", "has a wildcard"),
        (sample("nonstop.mcap"), "127.0.0.1:1/a", "127.0.0.1:1 cannot be published to: connection"),
    ):
        options = SferaOptions(publish=address)
        refused(InputError, said, write_sfera, [given], JOURNEY, tmp_path / "a.zip", options)
    assert not list(tmp_path.iterdir())
