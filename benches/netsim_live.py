"""The live proxy beside one of asyncio: how exact its delays are, and how much it carries.

Required, at 20 ms each way: 1000 packets/s each way with a median error of at most 60 us and nothing early,
and 50000 packets/s each way without loss.

Load and sink are one process (`netsim/examples/load.rs`), which sends and receives in both directions and does
not sleep. The error is the time from its sending to its receiving beyond the delay, so it holds both hops through
the loopback interface and what the proxy takes. Where it is allowed, load and peers have real-time scheduling as the
proxy asks for it. uvloop is measured where it is installed.
"""

import argparse
import asyncio
import importlib
import importlib.util
import json
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import cast

from _programs import built
from _report import add_number, bench_options, print_requirements, print_table, table_file, write_json
from haptether.netsim import LinkSettings, Proxy, ProxyStatistics

EXAMPLE = "example: python benches/netsim_live.py --json -"
DELAY_S = 0.02
EXACT_HZ = 1000
RATES_HZ = (2_000, 4_000, 8_000, 10_000, 20_000, 30_000, 50_000, 70_000, 100_000)
REQUIRED_P50_US, REQUIRED_HZ = 60.0, 50_000
# Offered share of a rate above which the rate counts.
OFFERED = 0.98


# Peers


class Client(asyncio.DatagramProtocol):
    """Listens, delays, and forwards; answers go to the last sender."""

    transport: asyncio.DatagramTransport
    source: tuple[str, int]

    def __init__(self, delay_s: float) -> None:
        self.delay_s = delay_s
        self.loop = asyncio.get_running_loop()
        self.upstream: asyncio.DatagramTransport | None = None

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Keep the transport."""
        self.transport = cast("asyncio.DatagramTransport", transport)

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Forward to the peer."""
        self.source = addr
        if self.upstream is not None:
            self.loop.call_later(self.delay_s, self.upstream.sendto, data)


class Peer(asyncio.DatagramProtocol):
    """Return path."""

    def __init__(self, client: Client) -> None:
        self.client = client

    def datagram_received(self, data: bytes, addr: tuple[str, int]) -> None:
        """Forward to the client."""
        del addr
        client = self.client
        client.loop.call_later(client.delay_s, client.transport.sendto, data, client.source)


async def forward(listen: tuple[str, int], peer: tuple[str, int]) -> None:
    """Run a typical asyncio proxy until it is killed."""
    loop = asyncio.get_running_loop()
    _, client = await loop.create_datagram_endpoint(lambda: Client(DELAY_S), local_addr=listen)
    client.upstream, _ = await loop.create_datagram_endpoint(lambda: Peer(client), remote_addr=peer)
    print("ready", flush=True)
    await asyncio.Event().wait()


def be_peer(name: str, listen: str, peer: str) -> None:
    """Run such a proxy in this process."""
    ends = [(end.rpartition(":")[0], int(end.rpartition(":")[2])) for end in (listen, peer)]
    if name == "uvloop":
        importlib.import_module("uvloop").run(forward(*ends))
    else:
        asyncio.run(forward(*ends))


# Measurements


@dataclass(frozen=True, slots=True, kw_only=True)
class Direction:
    """One direction, measured by the load."""

    sent: int
    refused: int
    received: int
    early: int
    min_ns: int
    p50_ns: int
    p99_ns: int
    p999_ns: int
    max_ns: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Run:
    """One load through one proxy, with the proxy's own counts if it keeps them."""

    proxy: str
    rate_hz: int
    seconds: float
    ways: tuple[Direction, Direction]
    load_average: float
    scheduling: str | None = None
    own_p50_us: float | None = None
    own_p99_us: float | None = None
    own_early: int | None = None
    buffer_bytes: int | None = None

    @property
    def offered_hz(self) -> float:
        """Rate sent each way, the lesser of the two."""
        return min(direction.sent - direction.refused for direction in self.ways) / self.seconds

    @property
    def lost(self) -> int:
        """Lost packets of both directions."""
        return sum(direction.sent - direction.refused - direction.received for direction in self.ways)

    @property
    def early(self) -> int:
        """Packets that arrived before the end of the delay."""
        return sum(direction.early for direction in self.ways) + (self.own_early or 0)

    def error_us(self, quantile: str) -> float:
        """Return the time beyond the delay, the worse of the two directions."""
        worse_ns: int = max(getattr(direction, f"{quantile}_ns") for direction in self.ways)
        return worse_ns / 1e3 - DELAY_S * 1e6

    @property
    def carried(self) -> bool:
        """True if the whole rate was offered and all of it arrived."""
        return self.lost == 0 and self.offered_hz >= OFFERED * self.rate_hz


def free_address() -> str:
    """Return a free address."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return f"127.0.0.1:{probe.getsockname()[1]}"


def put_first(pid: int) -> None:
    """Raise the scheduling priority if allowed: other loads should not affect the measurement."""
    with suppress(PermissionError):
        os.sched_setscheduler(pid, os.SCHED_RR, os.sched_param(1))


@contextmanager
def peer_proxy(name: str, listen: str, peer: str) -> Iterator[None]:
    """Run such a proxy in its own process."""
    command = [sys.executable, __file__, "--as-peer", name, listen, peer]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        put_first(process.pid)
        assert process.stdout is not None
        process.stdout.readline()
        try:
            yield
        finally:
            process.kill()


def offer(load: Path, listen: str, peer: str, rate_hz: int, seconds: float) -> tuple[Direction, Direction]:
    """Run the load."""
    command = [str(load), listen, peer, str(rate_hz), str(seconds), str(DELAY_S)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        put_first(process.pid)
        said = process.communicate()[0]
    if process.returncode != 0:
        raise SystemExit(process.returncode)
    seen = json.loads(said)
    return Direction(**seen["forward"]), Direction(**seen["backward"])


def measure(load: Path, name: str, rate_hz: int, seconds: float) -> Run:
    """Measure one rate through one proxy."""
    listen, peer = free_address(), free_address()
    load_average = os.getloadavg()[0]
    if name != "haptether":
        with peer_proxy(name, listen, peer):
            directions = offer(load, listen, peer, rate_hz, seconds)
        return Run(proxy=name, rate_hz=rate_hz, seconds=seconds, ways=directions, load_average=load_average)
    link = LinkSettings(delay_s=DELAY_S)
    proxy = Proxy(listen=listen, forward=peer, forward_link=link, backward_link=link)
    try:
        directions = offer(load, listen, peer, rate_hz, seconds)
    finally:
        own: ProxyStatistics = proxy.stop()
    return Run(
        proxy=name,
        rate_hz=rate_hz,
        seconds=seconds,
        ways=directions,
        load_average=load_average,
        scheduling=own.scheduling,
        own_p50_us=own.scheduling_error_p50_s * 1e6,
        own_p99_us=own.scheduling_error_p99_s * 1e6,
        own_early=own.early,
        buffer_bytes=own.receive_buffer_bytes,
    )


def ramp(load: Path, name: str, seconds: float) -> list[Run]:
    """Raise the rate until packets are lost or the load cannot offer it."""
    runs = []
    for rate_hz in RATES_HZ:
        runs.append(measure(load, name, rate_hz, seconds))
        if not runs[-1].carried:
            break
    return runs


def main() -> int:
    """Measure, print the table, and print if the requirement is met."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--seconds", 10.0, "of the exactness run", least=0.1, most=600.0)
    add_number(options, "--ramp-seconds", 3.0, "of each rate", least=0.1, most=600.0)
    options.add_argument("--as-peer", nargs=3, help=argparse.SUPPRESS)
    arguments = options.parse_args()
    if arguments.as_peer:
        be_peer(*arguments.as_peer)
        return 0

    out = table_file(arguments.json)
    load = built("load")
    names = ["haptether", "asyncio"]
    if importlib.util.find_spec("uvloop") is not None:
        names.append("uvloop")

    print(f"{EXACT_HZ} packets/s each way, {DELAY_S * 1e3:g} ms each way: error in us, worse way\n", file=out)
    exact = {name: measure(load, name, EXACT_HZ, arguments.seconds) for name in names}
    errors = (
        (name, *(f"{run.error_us(at):.1f}" for at in ("p50", "p99", "p999", "max")), run.early, run.lost,
         *(us and f"{us:.1f}" for us in (run.own_p50_us, run.own_p99_us)), run.scheduling, f"{run.load_average:.1f}")
        for name, run in exact.items()
    )  # fmt: skip
    heads = ("", "p50", "p99", "p99.9", "max", "early", "lost", "own p50", "own p99", "thread", "load average")
    print_table(heads, errors, out)

    print("\npackets/s each way, until one is lost or the load falls behind\n", file=out)
    ramps = {name: ramp(load, name, arguments.ramp_seconds) for name in names}
    offered = (
        (name, run.rate_hz, f"{run.offered_hz:.0f}", run.lost, f"{run.error_us('p99'):.0f}", f"{run.load_average:.1f}")
        for name, runs in ramps.items()
        for run in runs
    )
    print_table(("", "asked", "offered", "lost", "p99 us", "load average"), offered, out)
    carried = {name: max((run.rate_hz for run in runs if run.carried), default=0) for name, runs in ramps.items()}

    ours = exact["haptether"]
    met = {
        f"median error at most {REQUIRED_P50_US:g} us": ours.error_us("p50") <= REQUIRED_P50_US,
        "nothing early": ours.early + sum(run.early for run in ramps["haptether"]) == 0,
        f"{REQUIRED_HZ} packets/s each way": carried["haptether"] >= REQUIRED_HZ,
    }
    print("\ncarried each way: " + ", ".join(f"{name} {rate}" for name, rate in carried.items()), file=out)
    status = print_requirements(met, out)
    write_json(
        arguments.json,
        {
            "delay_s": DELAY_S,
            "exact": [asdict(run) for run in exact.values()],
            "ramps": [asdict(run) for runs in ramps.values() for run in runs],
            "carried_hz": carried,
            "met": met,
        },
    )
    return status


if __name__ == "__main__":
    sys.exit(main())
