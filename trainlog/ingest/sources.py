"""Where a live recording comes from: datagrams, a broker, a pipe, a file that grows.

A thread takes what arrives, so that the operating system never has to drop it because the program
is busy; what waits to be decoded is bounded, and what does not fit is counted.
"""

from __future__ import annotations

import hashlib
import os
import socket
import struct
import sys
import threading
import time
from abc import ABC, abstractmethod
from collections import deque
from pathlib import Path
from queue import Empty, Queue
from typing import Any, BinaryIO, Self
from urllib.parse import unquote, urlsplit

from trainlog.errors import InputError
from trainlog.extras import load

HOST = "127.0.0.1"
"""Only programs of this computer can send to it."""

WAITING = 2**26
"""How much may wait to be decoded [bytes]."""

RECEIVE_BUFFER = 2**23
"""Asked for, for datagrams that arrive in bursts [bytes]; the system may give less."""

OVERFLOWS = 40
"""SO_RXQ_OVFL of Linux: each datagram states how many were dropped before it."""

WAITING_MESSAGES = 1000
"""How many messages may wait here; the broker keeps what comes behind them."""

AGAIN = 60.0
"""For so long after a connection was made [s] a broker, or a sender, may repeat messages."""

ANSWER = 10.0
"""How long a broker's answer is waited for [s]."""

POLL = 0.05
"""How often a file, and what has come, is looked at [s]."""

BLOCK = 2**16
"""Bytes that are read at a time. A datagram has fewer; more without a line's end are no line."""


class Source(ABC):
    """What is recorded, block by block; ended by its ``with`` block.

    Attributes
    ----------
    name : str
        In words.
    whole : bool
        Whether a block ends with the end of a line or message.
    lost : int
        Blocks that were not taken because too much waited, or that the system dropped.
    repeated : int
        Messages that a broker delivered again after a connection was lost; they are left out.
    late : float [s]
        By how much what is kept while a connection is lost may come later than the rest.
    ended : bool
        Whether nothing more comes.
    """

    whole = False
    late = 0.0

    def __init__(self, name: str) -> None:
        self.name, self.lost, self.repeated, self.ended = name, 0, 0, False
        self._blocks: deque[bytes] = deque()
        self._size = 0
        self._came = threading.Event()
        self._stopping = False
        self._problem: str = ""
        self._thread = threading.Thread(target=self._run, name="trainlog.source", daemon=True)

    def read(self, timeout: float) -> list[bytes]:
        """The blocks that have come; none if nothing comes for so long [s].

        Raises
        ------
        InputError
            If the source cannot be read any more; what came before was given.
        """
        if not self._blocks and not self.ended:
            self._came.wait(timeout)
        self._came.clear()
        blocks = [self._blocks.popleft() for _ in range(len(self._blocks))]
        self._size -= sum(map(len, blocks))
        if not blocks and self._problem:
            raise InputError(
                f"cannot be read any more: {self._problem}",
                file=self.name,
                remedy="ingest it again where the file can be read",
            )
        return blocks

    @abstractmethod
    def _take(self) -> bytes | None:
        """The next block; empty if nothing came for a while, None at the end."""

    def _run(self) -> None:
        try:
            while not self._stopping and (block := self._take()) is not None:
                if not block:
                    continue
                if self._size > WAITING:
                    self.lost += 1
                    continue
                self._blocks.append(block)
                self._size += len(block)
                self._came.set()
        except OSError as error:
            if not self._stopping:
                self._problem = error.strerror or str(error)
        finally:
            self.ended = True
            self._came.set()

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._stopping = True


class Datagrams(Source):
    """UDP datagrams.

    Parameters
    ----------
    address : str
        ``PORT``, or ``HOST:PORT``; without a host only this computer can send.

    Raises
    ------
    InputError
        If it is no address, or it cannot be listened to.
    """

    whole = True

    def __init__(self, address: str) -> None:
        host, _, port = address.rpartition(":")
        if not port.isdigit() or int(port) > 65_535:
            raise InputError(
                f"'{address}' is not an address", remedy="write PORT or HOST:PORT, such as 5005"
            )
        host = host.strip("[]") or HOST
        family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._socket = socket.socket(family, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
        try:
            self._socket.bind((host, int(port)))
        except OSError as error:
            self._socket.close()
            raise InputError(
                f"cannot listen to {host}:{port}: {(error.strerror or str(error)).lower()}",
                remedy="choose another port, or an address of this computer",
            ) from error
        self._counts = sys.platform == "linux"
        if self._counts:
            self._socket.setsockopt(socket.SOL_SOCKET, OVERFLOWS, 1)
        self._socket.settimeout(POLL)
        self._dropped = 0
        bound = self._socket.getsockname()
        self.port = int(bound[1])
        super().__init__(f"UDP {bound[0]}:{self.port}")

    def _take(self) -> bytes | None:
        try:
            if not self._counts:
                return self._socket.recv(BLOCK)
            data, about, _, _ = self._socket.recvmsg(BLOCK, 64)
        except TimeoutError:
            return b""
        for level, kind, value in about:
            if level == socket.SOL_SOCKET and kind == OVERFLOWS:
                (dropped,) = struct.unpack("=I", value[:4])
                self.lost += dropped - self._dropped
                self._dropped = dropped
        return data

    def __exit__(self, *error: object) -> None:
        self._stopping = True
        self._thread.join(2.0)
        self._socket.close()


class BrokerSession:
    """A session at an MQTT broker, by the package paho-mqtt (extra ``mqtt``).

    The broker keeps the session while this program, or the connection, is away.

    Parameters
    ----------
    address : str
        ``HOST[:PORT]/TOPIC``, such as ``localhost/trains/17``; or as an address of ``mqtt://`` or
        ``mqtts://``, with ``USER@``. A password is that of the variable MQTT_PASSWORD.
    role : str
        What is done there; with the topic it names the session.

    Raises
    ------
    InputError
        If it is no address, or the broker does not answer or refuses.
    """

    def __init__(self, address: str, role: str) -> None:
        mqtt = load("paho.mqtt.client")
        parts = urlsplit(address if "://" in address else f"mqtt://{address}")
        self.topic, host = unquote(parts.path.lstrip("/")), parts.hostname
        if parts.scheme not in ("mqtt", "mqtts") or not self.topic or not host:
            raise InputError(
                f"'{address}' is not a topic of a broker",
                remedy="write HOST[:PORT]/TOPIC, such as localhost/trains/17",
            )
        secure = parts.scheme == "mqtts"
        self.port = parts.port or (8883 if secure else 1883)
        self.host = host
        session = f"{role} {socket.gethostname()} {self.topic}".strip()
        session = hashlib.sha256(session.encode()).hexdigest()
        self.client = mqtt.Client(
            mqtt.CallbackAPIVersion.VERSION2, f"trainlog-{session[:12]}", clean_session=False
        )
        if parts.username:
            password = os.environ.get("MQTT_PASSWORD")
            self.client.username_pw_set(unquote(parts.username), password)
        if secure:
            self.client.tls_set()
        self.client.reconnect_delay_set(1, 10)
        self.client.on_connect = self._connected
        self._answer: Queue[str] = Queue()

    def start(self, what: str) -> None:
        """Connect, and wait for the answer; `what` cannot be done without."""
        problem = ""
        try:
            self.client.connect(self.host, self.port)
            self.client.loop_start()
            problem = self._answer.get(timeout=ANSWER)
        except (OSError, Empty) as error:
            problem = "no answer" if isinstance(error, Empty) else error.strerror or str(error)
        if problem:
            self.client.loop_stop()
            raise InputError(
                f"the broker {self.host}:{self.port} cannot be {what}: {problem.lower()}",
                remedy="start it, or correct its address, the user, or MQTT_PASSWORD",
            )

    def connected(self) -> None:
        """What is to be done with each new connection."""

    def _connected(self, _client: Any, _data: Any, _flags: Any, reason: Any, _more: Any) -> None:
        if not reason.is_failure:
            self.connected()
        self._answer.put(str(reason) if reason.is_failure else "")

    def stop(self) -> None:
        """End the connection; the broker keeps the session."""
        self.client.disconnect()
        self.client.loop_stop()


class Publication(BrokerSession):
    """Messages given to an MQTT broker, each once it is taken (quality of service 1).

    See `BrokerSession`. While the broker is away messages wait, and go out when it is there again.
    """

    def __init__(self, address: str) -> None:
        super().__init__(address, "publish")
        if any(each in self.topic for each in "+#"):
            raise InputError(
                f"'{self.topic}' is not a topic for publishing: it has a wildcard",
                remedy="name one topic, without + and #",
            )
        self._given, self._taken = 0, 0
        self.client.on_publish = self._published
        self.start("published to")

    def _published(self, *_: Any) -> None:
        self._taken += 1

    def publish(self, message: bytes) -> None:
        """Give it a message."""
        self._given += 1
        self.client.publish(self.topic, message, qos=1)

    def close(self, patience: float = ANSWER) -> int:
        """End, after at most `patience` [s]; how many messages the broker has not taken."""
        ends = time.monotonic() + patience
        while self._taken < self._given and time.monotonic() < ends:
            time.sleep(0.02)
        self.stop()
        return self._given - self._taken


class Subscription(Source, BrokerSession):
    """Messages of a topic from an MQTT broker; see `BrokerSession`.

    The broker keeps what is published with quality of service 1 or 2 while this program, or the
    connection, is away. The topic may have wildcards: ``localhost/trains/+/reports``.

    Raises
    ------
    InputError
        If it is no address, or the broker does not answer or refuses.
    """

    whole = True
    late = 3600.0

    def __init__(self, address: str) -> None:
        BrokerSession.__init__(self, address, "")
        Source.__init__(self, f"MQTT {self.host}:{self.port}/{self.topic}")
        self._messages: Queue[bytes] = Queue(WAITING_MESSAGES)
        self._recent: deque[bytes] = deque(maxlen=WAITING_MESSAGES)
        self._since = -AGAIN
        self.client.on_message = self._arrived
        self.start("subscribed to")

    def connected(self) -> None:
        """Subscribe; again with each new connection, if the broker has forgotten the session."""
        self._since = time.monotonic()
        self.client.subscribe(self.topic, qos=1)

    def _arrived(self, _client: Any, _data: Any, message: Any) -> None:
        """Take a message; after a connection was lost not those that came before."""
        mark = hashlib.sha256(message.payload).digest()
        again = message.dup or time.monotonic() - self._since < AGAIN
        if again and mark in self._recent:
            self.repeated += 1
            return
        self._recent.append(mark)
        self._messages.put(message.payload)

    def _take(self) -> bytes | None:
        try:
            return self._messages.get(timeout=POLL)
        except Empty:
            return b""

    def __exit__(self, *error: object) -> None:
        self._stopping = True
        self.stop()
        self._thread.join(2.0)


class Pipe(Source):
    """A stream that another program writes, such as standard input."""

    def __init__(self, stream: BinaryIO | None = None) -> None:
        super().__init__("standard input")
        self._stream = stream or sys.stdin.buffer

    def _take(self) -> bytes | None:
        return os.read(self._stream.fileno(), BLOCK) or None


class GrowingFile(Source):
    """A file that another program writes; followed by its name when it is replaced.

    It is read from its begin. Where a recorder goes on in a new file of the same name (rotation),
    the old one is read to its end first; a file that became shorter is read from its begin again.
    """

    def __init__(self, path: str | Path) -> None:
        super().__init__(str(path))
        self._path = Path(path)
        if self._path.is_dir():
            raise InputError("is a folder", file=path, remedy="name a file in it")
        if not self._path.parent.is_dir():
            raise InputError("does not exist", file=self._path.parent, remedy="check the path")
        self._file: BinaryIO | None = None
        self._behind = b""

    def _take(self) -> bytes | None:
        if self._file is None:
            try:
                self._file = self._path.open("rb", buffering=0)
            except FileNotFoundError:  # not written yet, or being replaced
                time.sleep(POLL)
                return b""
        block = self._file.read(BLOCK)
        if block:
            self._behind = block[-1:]
            return block
        here = os.fstat(self._file.fileno())
        if here.st_size < self._file.seek(0, os.SEEK_CUR):
            self._file.seek(0)
            return self._between()
        try:
            there = self._path.stat()
        except FileNotFoundError:
            time.sleep(POLL)
            return b""
        if (here.st_dev, here.st_ino) != (there.st_dev, there.st_ino):
            # What was written between the last look and the renaming comes first.
            rest = self._file.read()
            if rest:
                self._behind = rest[-1:]
                return rest
            self._file.close()
            self._file = None
            return self._between()
        time.sleep(POLL)
        return b""

    def _between(self) -> bytes:
        """What parts the last line of one file, perhaps cut, from the first of the next."""
        cut, self._behind = self._behind not in (b"", b"\n"), b""
        return b"\n" if cut else b""

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        self._thread.join(2.0)

    def _run(self) -> None:
        super()._run()
        if self._file is not None:
            self._file.close()
