"""A sender of forged datagrams, as fast as one thread can or at a given rate.

Run as `python -m tests.faults.flood HOST:PORT --rate 100000 --seconds 3`; prints the reached rate as JSON.
"""

import argparse
import ctypes
import json
import os
import secrets
import socket
import struct
import sys
import time
from dataclasses import asdict, dataclass

HEADER = struct.Struct("<2sBBIQQ")
"""Magic, version, kind, epoch, session, counter: docs/protocol.md."""
VERSION = 2
SEALED_BYTES, HELLO_BYTES = 190, 120
"""Sizes of a sealed frame of one axis, and of the first message of a handshake."""
BATCH = 100
"""Datagrams per system call."""


class _IoVector(ctypes.Structure):
    _fields_ = (("base", ctypes.c_void_p), ("length", ctypes.c_size_t))


class _Message(ctypes.Structure):
    _fields_ = (
        ("name", ctypes.c_void_p), ("name_length", ctypes.c_uint32), ("vectors", ctypes.c_void_p),
        ("vector_count", ctypes.c_size_t), ("control", ctypes.c_void_p), ("control_length", ctypes.c_size_t),
        ("flags", ctypes.c_int),
    )  # fmt: skip


class _Messages(ctypes.Structure):
    _fields_ = (("header", _Message), ("sent", ctypes.c_uint))


@dataclass(frozen=True, kw_only=True)
class Sent:
    """Number of sent datagrams and their time."""

    datagrams: int
    seconds: float

    @property
    def rate_hz(self) -> float:
        """Datagrams per second."""
        return self.datagrams / self.seconds


def sealed(session: int, counter: int) -> bytes:
    """Return the header of a frame of this session, and random bytes."""
    return HEADER.pack(b"HS", VERSION, 3, 0, session, counter) + secrets.token_bytes(SEALED_BYTES - HEADER.size)


def hello(session: int, _: int) -> bytes:
    """Return the header of the first message of a handshake, and random bytes."""
    return HEADER.pack(b"HS", VERSION, 1, 0, session, 0) + secrets.token_bytes(HELLO_BYTES - HEADER.size)


KINDS = {"frame": sealed, "hello": hello}


def flood(
    host: str, port: int, *, rate_hz: float, seconds: float, session: int, counter: int, kind: str = "frame"
) -> Sent:
    """Send batches by `sendmmsg`, each when it is due; late batches are caught up.

    Args:
        host: Address.
        port: Port.
        rate_hz: Datagrams per second; one thread may reach less.
        seconds: Duration in s.
        session: Session in each header.
        counter: Counter in the first header; each datagram of a batch has its own.
        kind: Kind in the header: "frame" or "hello".

    Raises:
        OSError: The system refused to send.
    """
    library = ctypes.CDLL(None, use_errno=True)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.connect((host, port))
        each = [KINDS[kind](session, counter + n) for n in range(BATCH)]
        length = len(each[0])
        room = ctypes.create_string_buffer(b"".join(each), BATCH * length)
        start = ctypes.addressof(room)
        vectors = (_IoVector * BATCH)(*(_IoVector(start + n * length, length) for n in range(BATCH)))
        messages = (_Messages * BATCH)()
        for n in range(BATCH):
            messages[n].header.vectors = ctypes.addressof(vectors[n])
            messages[n].header.vector_count = 1
        begun, datagrams, batches = time.perf_counter(), 0, 0
        while (now := time.perf_counter() - begun) < seconds:
            if (wait := batches * BATCH / rate_hz - now) > 0.0:
                time.sleep(wait)
            sent = library.sendmmsg(sender.fileno(), messages, BATCH, 0)
            if sent < 0:
                number = ctypes.get_errno()
                # Go on even if nobody listens any more.
                if number not in {111, 11, 105}:
                    raise OSError(number, os.strerror(number))
                sent = 0
            datagrams += sent
            batches += 1
        return Sent(datagrams=datagrams, seconds=time.perf_counter() - begun)


def main() -> int:
    """Flood as the command line requests."""
    parser = argparse.ArgumentParser(prog="python -m tests.faults.flood", description=__doc__)
    parser.add_argument("peer", help="HOST:PORT")
    parser.add_argument("--rate", type=float, default=1e5, help="datagrams a second, 1 to 1e7")
    parser.add_argument("--seconds", type=float, default=3.0, help="for how long, 0 to 60")
    parser.add_argument("--session", type=int, default=1, help="session in the headers")
    parser.add_argument("--counter", type=int, default=1_000_000, help="counter in the first header")
    parser.add_argument("--kind", choices=list(KINDS), default="frame", help="what they seem to be")
    arguments = parser.parse_args()
    if not (1.0 <= arguments.rate <= 1e7 and 0.0 < arguments.seconds <= 60.0):
        parser.error("--rate must be 1 to 1e7, --seconds above 0 and at most 60")
    host, port = arguments.peer.rsplit(":", 1)
    sent = flood(
        host, int(port), rate_hz=arguments.rate, seconds=arguments.seconds, session=arguments.session,
        counter=arguments.counter, kind=arguments.kind,
    )  # fmt: skip
    print(json.dumps({**asdict(sent), "rate_hz": sent.rate_hz}))
    return 0


if __name__ == "__main__":
    sys.exit(main())
