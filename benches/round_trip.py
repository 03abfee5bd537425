"""Round trip of authenticated frames through two endpoints on loopback, beside bare datagrams and other transports.

Required: p50 of a round trip in a secure session at most 1.3 times that of the fastest ping-pong of as many bytes in
the same run, whatever it is written in.

Every pair is pinned the same way: who pings to the first CPU of `--cpus`, who answers to the second. Without that the
scheduler puts one pair on one CPU and another on two, which differ threefold.

A round trip is what two ticks cost beyond waiting: tick, send, seal, UDP, open, receive, tick, send, seal, UDP, open,
receive (`bridge/examples/ping_pong.rs`, which has the bare one, too). The peers in Python send the same bytes and do
nothing with them: a socket, asyncio, and pyzmq (a PAIR over TCP, which is what it has for two ends).
"""

import argparse
import asyncio
import contextlib
import importlib
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from _programs import built
from _report import add_number, bench_options, print_table, table_file, write_json

EXAMPLE = "example: python benches/round_trip.py --json -"
BYTES = 164
"""Bytes of a sealed one-axis frame."""
REQUIRED = 1.3
WARM_UP = 500
PATIENCE_S = 30.0

Taken = npt.NDArray[np.float64]


@contextlib.contextmanager
def pinned(cpu: int) -> Iterator[None]:
    """This thread, and those that it starts meanwhile, on one CPU."""
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {cpu})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


# Each peer answers in its own process, sends its port to the bench, and ends after the expected number of pings.


def answered(name: str, cpu: int, port: Connection, pings: int) -> None:
    """Answers, on a CPU."""
    with pinned(cpu):
        PEERS[name][0](port, pings)


def answer_socket(port: Connection, pings: int) -> None:
    """Send each datagram back."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as there:
        there.settimeout(PATIENCE_S)
        there.bind(("127.0.0.1", 0))
        port.send(there.getsockname()[1])
        for _ in range(pings):
            data, source = there.recvfrom(2048)
            there.sendto(data, source)


def ping_socket(port: int, pings: int) -> Taken:
    """Return round trips in ns."""
    taken = np.empty(pings)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as here:
        here.settimeout(PATIENCE_S)
        here.connect(("127.0.0.1", port))
        for ping in range(pings):
            begun = time.perf_counter_ns()
            here.send(bytes(BYTES))
            here.recv(2048)
            taken[ping] = time.perf_counter_ns() - begun
    return taken


class Answering(asyncio.DatagramProtocol):
    """Sends each datagram back."""

    def __init__(self, pings: int) -> None:
        self.left = pings
        self.done = asyncio.get_running_loop().create_future()

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        self.transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Send the datagram back."""
        self.transport.sendto(data, addr)
        self.left -= 1
        if self.left == 0:
            self.done.set_result(None)


def answer_asyncio(port: Connection, pings: int) -> None:
    """Send each datagram back, in an event loop."""

    async def serve() -> None:
        loop = asyncio.get_running_loop()
        transport, protocol = await loop.create_datagram_endpoint(lambda: Answering(pings), ("127.0.0.1", 0))
        port.send(transport.get_extra_info("sockname")[1])
        await asyncio.wait_for(protocol.done, PATIENCE_S)
        # The last datagram may still wait in the loop.
        await asyncio.sleep(0.05)

    asyncio.run(serve())


class Asking(asyncio.DatagramProtocol):
    """Passes each datagram on."""

    def __init__(self) -> None:
        self.answers: asyncio.Queue[bytes] = asyncio.Queue()

    def datagram_received(self, data: bytes, _: tuple[str, int]) -> None:
        """Pass the datagram to the waiting task."""
        self.answers.put_nowait(data)


def ping_asyncio(port: int, pings: int) -> Taken:
    """Return round trips in ns."""
    taken = np.empty(pings)

    async def client() -> None:
        loop = asyncio.get_running_loop()
        transport, protocol = await loop.create_datagram_endpoint(Asking, remote_addr=("127.0.0.1", port))
        for ping in range(pings):
            begun = time.perf_counter_ns()
            transport.sendto(bytes(BYTES))
            await protocol.answers.get()
            taken[ping] = time.perf_counter_ns() - begun
        transport.close()

    asyncio.run(client())
    return taken


def pair() -> Any:  # noqa: ANN401  # pyzmq is not there where types are checked
    """Return a ZeroMQ socket with timeouts."""
    zmq = importlib.import_module("zmq")
    made = zmq.Context().socket(zmq.PAIR)
    made.setsockopt(zmq.RCVTIMEO, round(PATIENCE_S * 1e3))
    made.setsockopt(zmq.LINGER, 1000)
    return made


def answer_zmq(port: Connection, pings: int) -> None:
    """Send each message back over ZeroMQ."""
    there = pair()
    port.send(there.bind_to_random_port("tcp://127.0.0.1"))
    for _ in range(pings):
        there.send(there.recv())
    there.close()
    there.context.term()


def ping_zmq(port: int, pings: int) -> Taken:
    """Return round trips in ns."""
    taken = np.empty(pings)
    here = pair()
    here.connect(f"tcp://127.0.0.1:{port}")
    for ping in range(pings):
        begun = time.perf_counter_ns()
        here.send(bytes(BYTES))
        here.recv()
        taken[ping] = time.perf_counter_ns() - begun
    here.close()
    here.context.term()
    return taken


PEERS: dict[str, tuple[Callable[[Connection, int], None], Callable[[int, int], Taken]]] = {
    "Python socket": (answer_socket, ping_socket),
    "asyncio": (answer_asyncio, ping_asyncio),
    "pyzmq": (answer_zmq, ping_zmq),
}


def measured(name: str, pings: int, cpus: tuple[int, int]) -> Taken:
    """Return the round trips of a Python peer in ns, pinged and answered on these CPUs."""
    near, far = cpus
    here, there = multiprocessing.Pipe()
    # Not forked: a copy of this process would share the peers' threads.
    arguments = (name, far, there, pings + WARM_UP)
    process = multiprocessing.get_context("spawn").Process(target=answered, args=arguments, daemon=True)
    process.start()
    if not here.poll(PATIENCE_S):
        message = f"{name}: did not open its socket within {PATIENCE_S:g} s"
        raise RuntimeError(message)
    with pinned(near):
        taken = PEERS[name][1](here.recv(), pings + WARM_UP)[WARM_UP:]
    process.join(PATIENCE_S)
    return taken


def two_cpus(text: str) -> tuple[int, int]:
    """Two CPUs that this process may run on.

    Raises:
        ArgumentTypeError: Others, or another number of them.
    """
    allowed = sorted(os.sched_getaffinity(0))
    cpus = [cpu for part in text.split(",") for cpu in allowed if str(cpu) == part]
    if len(cpus) != 2 or text.count(",") != 1:
        message = f"{text}: must be two of {', '.join(map(str, allowed))}, as in {allowed[0]},{allowed[-1]}"
        raise argparse.ArgumentTypeError(message)
    return cpus[0], cpus[1]


def main() -> int:
    """Measure, print the table, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--turns", 6, "turns of each", most=100)
    add_number(options, "--pings", 5000, "round trips of each turn", least=100, most=20_000)
    allowed = sorted(os.sched_getaffinity(0))
    options.add_argument(
        "--cpus", type=two_cpus, default=(allowed[0], allowed[1 % len(allowed)]), metavar="PING,ANSWER",
        help="CPUs of every pair, the same twice for one; default %(default)s",
    )  # fmt: skip
    arguments = options.parse_args()
    ping_pong = built("ping_pong")

    rounds: dict[str, list[Taken]] = {}
    for _ in range(arguments.turns):
        ended = subprocess.run(
            [str(ping_pong), "1", str(arguments.pings), *map(str, arguments.cpus)],
            check=True,
            capture_output=True,
            text=True,
            timeout=300,
        )
        for kind, runs in json.loads(ended.stdout).items():
            rounds.setdefault(kind, []).extend(np.array(samples, dtype=np.float64) for samples in runs)
        for name in PEERS:
            try:
                rounds.setdefault(name, []).append(measured(name, arguments.pings, arguments.cpus))
            except ModuleNotFoundError:
                rounds.pop(name)
                print(f"{name} is not installed: left out", file=sys.stderr)

    names = {"bare": "bare UDP, Rust", "insecure": "endpoints, in the clear", "secure": "endpoints, secure session"}
    taken = {kind: np.concatenate(runs) / 1e3 for kind, runs in rounds.items()}
    p50 = {kind: float(np.percentile(each, 50)) for kind, each in taken.items()}
    fastest = min(("bare", *(name for name in PEERS if name in p50)), key=p50.__getitem__)
    out = table_file(arguments.json)
    near, far = arguments.cpus
    print(
        f"round trip in us, {arguments.turns} turns of {arguments.pings}, {BYTES} bytes, CPU {near} to CPU {far}\n",
        file=out,
    )
    figures = {}
    for kind, each in taken.items():
        p99, p999 = (float(np.percentile(each, share)) for share in (99, 99.9))
        ratio = p50[kind] / p50[fastest]
        figures[kind] = {"p50_us": p50[kind], "p99_us": p99, "p999_us": p999, "p50_times_fastest": ratio}
    lines = (
        (names.get(kind, kind), *(f"{us:.1f}" for us in list(of.values())[:3]), f"{of['p50_times_fastest']:.2f}")
        for kind, of in figures.items()
    )
    print_table(("", "p50", "p99", "p99.9", "p50, times fastest"), lines, out)
    is_met = figures["secure"]["p50_times_fastest"] <= REQUIRED
    what = f"p50 of a secure round trip at most {REQUIRED} times the fastest without endpoints"
    print(f"\nrequired {what} ({names.get(fastest, fastest)}): {'met' if is_met else 'MISSED'}", file=out)
    report = {"bytes": BYTES, "cpus": arguments.cpus, "fastest": fastest, "figures": figures, "met": {what: is_met}}
    write_json(arguments.json, report)
    return 0 if is_met else 1


if __name__ == "__main__":
    sys.exit(main())
