"""A program that sends a recorded file as datagrams, in accelerated time, as real senders do.

It leaves datagrams out, sends malformed ones between, and pauses, where its arguments say so.
"""

from __future__ import annotations

import argparse
import socket
import time
from pathlib import Path

MALFORMED = (
    b"12;34",
    b"\xff\xfe\x00garbage",
    b'{"topic": "/train/state", "speed"',
    b"$GPRMC,12*00",
)


def main() -> None:
    """Send the file."""
    parser = argparse.ArgumentParser()
    parser.add_argument("file", type=Path)
    parser.add_argument("port", type=int)
    parser.add_argument("--rate", type=float, default=10_000.0, help="lines a second")
    parser.add_argument("--malformed", type=int, default=0, help="one after so many lines")
    parser.add_argument("--pause", type=int, default=0, help="half a second after so many lines")
    parser.add_argument("--number", action="store_true", help="a sequence number before each line")
    parser.add_argument("--leave-out", type=int, default=0, help="each so many-th line")
    given = parser.parse_args()
    out = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    to = ("127.0.0.1", given.port)
    began, paused = time.monotonic(), 0.0
    for number, line in enumerate(given.file.read_bytes().splitlines()):
        if given.leave_out and number and number % given.leave_out == 0:
            continue
        prefix = (b"sequence;" if not number else b"%d;" % number) if given.number else b""
        out.sendto(prefix + line, to)
        if given.malformed and number and number % given.malformed == 0:
            out.sendto(MALFORMED[(number // given.malformed) % len(MALFORMED)], to)
        if given.pause and number and number % given.pause == 0:
            time.sleep(0.5)
            paused += 0.5
        ahead = number / given.rate - (time.monotonic() - began - paused)
        if ahead > 0.002:
            time.sleep(ahead)


if __name__ == "__main__":
    main()
