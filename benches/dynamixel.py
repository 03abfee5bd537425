"""A cycle of a servo bus: a read of current, velocity and position of all servos, and a write of their goal currents.

Ours in Rust and from Python, `dynamixel2` (Rust, which has no fast read) and ROBOTIS' own client (Python), in turn on
one pseudo-terminal, where a process in Rust answers (`dynamixel/examples/bus_cycle.rs`): at once, or when the bytes
would have come at 1, 3 and 4 Mbit/s. Cycles begin at 500 Hz and at 1 kHz; a cycle that lasts until the next one begins
is an overrun. Without a wire they also run back to back. Those times depend on how the kernel's thread behind the
pseudo-terminal handles two writes in a row, which no loop makes.

Required: p50 of a cycle of ours without a wire, at either rate, at most 1.2 times that of `dynamixel2`, both by their
best round; six servos at 4 Mbit/s and 1 kHz without an overrun in at least one round: other loads of a shared machine
show in the other rounds.
"""

import json
import struct
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler  # type: ignore[import-untyped]

from _programs import built, running
from _report import add_number, bench_options, print_table, table_file, write_json
from haptether.dynamixel import DynamixelBus, SyncRead

EXAMPLE = "example: python benches/dynamixel.py --servos 7 --rounds 5 --json -"
BAUD = 4_000_000
"""Baud rate of the clients; a pseudo-terminal ignores it."""
WIRES = (0, 1_000_000, 3_000_000, 4_000_000)
"""Rates in bit/s; 0 answers at once."""
RATES = (500, 1000)
"""Cycle rates in Hz."""
PRESENT_CURRENT, MEASURED_BYTES = 126, 10
GOAL_CURRENT = 102
WARM_UP = 20
REQUIRED = 1.2
RUST = {"haptether, fast": "fast", "haptether": "sync", "dynamixel2": "dynamixel2"}
PYTHON = ("haptether in Python, fast", "dynamixel-sdk, fast", "dynamixel-sdk")
Cycle = Callable[[], None]


class Round(NamedTuple):
    """Consecutive cycles of one client."""

    taken_ms: list[float]
    """Time of each cycle."""
    overruns: int
    """Cycles that lasted until the next began."""


def rust_round(program: Path, client: str, path: str, *counts: int) -> Round:
    """Run a round of a Rust client: servos, cycles, rate in Hz."""
    command = [str(program), "run", client, path, *map(str, counts)]
    seen: dict[str, Any] = json.loads(subprocess.run(command, check=True, capture_output=True, timeout=120).stdout)
    return Round([taken / 1e6 for taken in seen["taken_ns"]], seen["overruns"])


def vendor_cycle(port: PortHandler, ids: list[int], *, fast: bool) -> Cycle:
    """Return a cycle of the vendor's client."""
    packets = PacketHandler(2.0)
    read = GroupSyncRead(port, packets, PRESENT_CURRENT, MEASURED_BYTES)
    write = GroupSyncWrite(port, packets, GOAL_CURRENT, 2)
    for servo_id in ids:
        read.addParam(servo_id)
        write.addParam(servo_id, [0, 0])
    transfer = read.fastSyncRead if fast else read.txRxPacket

    def cycle() -> None:
        # Its timeout is 34 ms; a process that waits for a processor may exceed it once.
        if transfer() != 0 and transfer() != 0:
            message = "a read of the vendor's client failed twice"
            raise RuntimeError(message)
        for servo_id in ids:
            read.getData(servo_id, PRESENT_CURRENT + 6, 4)
            write.changeParam(servo_id, [1, 0])
        write.txPacket()

    return cycle


def our_cycle(bus: DynamixelBus, ids: list[int]) -> Cycle:
    """Return a cycle of the extension's bus."""
    read = SyncRead(PRESENT_CURRENT, MEASURED_BYTES, ids)
    measured, goals = struct.Struct("<" + "hii" * len(ids)), struct.Struct(f"<{len(ids)}h")
    named = bytes(ids)

    def cycle() -> None:
        measured.unpack(bus.sync_read(read))
        bus.sync_write(GOAL_CURRENT, 2, named, goals.pack(*[1] * len(ids)))

    return cycle


def timed(cycle: Cycle, cycles: int, rate: int) -> Round:
    """Run a round of a Python client; each cycle begins at its due time."""
    for _ in range(WARM_UP):
        cycle()
    taken = []
    overruns = 0
    begin = time.perf_counter()
    for _ in range(cycles):
        if rate:
            begin += 1.0 / rate
            left = begin - time.perf_counter()
            if left < 0.0:
                # A late cycle does not delay the next one.
                overruns += 1
                begin -= left
            else:
                time.sleep(left)
        begun = time.perf_counter()
        cycle()
        taken.append(1e3 * (time.perf_counter() - begun))
    return Round(taken, overruns)


def python_round(client: str, path: str, servos: int, cycles: int, rate: int) -> Round:
    """Run a round of a Python client."""
    ids = list(range(1, 1 + servos))
    if client.startswith("haptether"):
        bus = DynamixelBus(path, baud=BAUD, timeout_s=0.5)
        seen = timed(our_cycle(bus, ids), cycles, rate)
        bus.close()
        return seen
    port = PortHandler(path)
    if not (port.openPort() and port.setBaudRate(BAUD)):
        message = f"{path}: the vendor's client cannot open it"
        raise RuntimeError(message)
    seen = timed(vendor_cycle(port, ids, fast="fast" in client), cycles, rate)
    port.closePort()
    return seen


def wire_ms(servos: int, wire: int, *, fast: bool) -> float:
    """Return the wire time of a cycle in ms at 10 bits per byte: the read with its answers, and the write."""
    answers = 8 + servos * (MEASURED_BYTES + 4) if fast else servos * (11 + MEASURED_BYTES)
    return 1e3 * 10 * (14 + servos + answers + 14 + 3 * servos) / wire if wire else 0.0


def main() -> int:
    """Print p50, p99 and overruns of each client; return 1 if a requirement does not hold."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--servos", 6, "how many servos", most=20)
    add_number(options, "--rounds", 5, "rounds of each client", most=50)
    add_number(options, "--cycles", 1000, "cycles of a round", least=100, most=20_000)
    chosen = options.parse_args()
    program = built("bus_cycle")
    cases = [(0, 0), *((wire, rate) for wire in WIRES for rate in RATES)]
    seen: dict[tuple[int, int, str], list[Round]] = {}
    out = table_file(chosen.json)
    for wire, rate in cases:
        with running(str(program), "answer", str(chosen.servos), str(wire)) as path:
            for _ in range(chosen.rounds):
                for client in (*RUST, *PYTHON):
                    counts = chosen.servos, chosen.cycles, rate
                    if client in RUST:
                        one = rust_round(program, RUST[client], path, *counts)
                    else:
                        one = python_round(client, path, *counts)
                    seen.setdefault((wire, rate, client), []).append(one)
        print(f"done: {wire / 1e6:g} Mbit/s, {rate} Hz", file=sys.stderr)

    print(f"{chosen.servos} servos, {chosen.rounds} rounds of {chosen.cycles} cycles; ms of the best round", file=out)
    rows = []
    for (wire, rate, client), rounds in seen.items():
        overruns = [one.overruns for one in rounds]
        row: dict[str, Any] = {
            "wire_bit_s": wire,
            "rate_hz": rate,
            "client": client,
            "p50_ms": min(float(np.percentile(one.taken_ms, 50)) for one in rounds),
            "p99_ms": min(float(np.percentile(one.taken_ms, 99)) for one in rounds),
            "wire_ms": wire_ms(chosen.servos, wire, fast="fast" in client),
            "overruns": overruns,
        }
        rows.append(row)
    lines = (
        (row["client"], row["wire_bit_s"] / 1e6 or None, row["rate_hz"] or None,
         f"{row['p50_ms']:.4f}", f"{row['p99_ms']:.4f}", f"{row['wire_ms']:.3f}",
         f"{min(row['overruns'])} {max(row['overruns'])}" if row["rate_hz"] else None)
        for row in rows
    )  # fmt: skip
    heads = ("client", "wire Mbit/s", "rate Hz", "p50", "p99", "wire", "overruns, least and most")
    print_table(heads, lines, out)
    p50 = {(row["rate_hz"], row["client"]): row["p50_ms"] for row in rows if row["wire_bit_s"] == 0}
    ratios = {
        rate: {
            client: p50[rate, client] / p50[rate, "dynamixel2"] for client in (*RUST, *PYTHON) if client != "dynamixel2"
        }
        for rate in (0, *RATES)
    }
    fits = min(one.overruns for one in seen[4_000_000, 1000, "haptether, fast"]) == 0
    rates = ("back to back", *(f"{rate} Hz" for rate in RATES))
    lines_of_ratios = ((client, *(f"{of[client]:.2f}" for of in ratios.values())) for client in ratios[0])
    print_table(("times dynamixel2, without a wire", *rates), lines_of_ratios, out)
    overran = "no overrun in one round at least" if fits else "overruns in each round"
    print(f"{chosen.servos} servos at 4 Mbit/s and 1 kHz: {overran}", file=out)
    good = fits and all(ratios[rate][client] <= REQUIRED for rate in RATES for client in RUST if client != "dynamixel2")
    print("required: holds" if good else "required: DOES NOT HOLD", file=out)
    write_json(chosen.json, {"servos": chosen.servos, "rows": rows, "ratios": ratios, "holds": good})
    return 0 if good else 1


if __name__ == "__main__":
    sys.exit(main())
