"""One cycle of a servo bus: a read of current, velocity and position of all servos, and a write of their goal currents.

The bus of the extension beside ROBOTIS' own client, on the same emulated servos behind a pseudo-terminal, one after
the other in each round. The emulator is a process in Python, whose time is in both figures: what is compared is what
the clients add to it. A pseudo-terminal has no wire time; `wire_ms` is what the bytes take at 4 Mbit/s on top.
"""

import struct
import subprocess
import sys
import time
from collections.abc import Callable

import numpy as np
from dynamixel_sdk import GroupSyncRead, GroupSyncWrite, PacketHandler, PortHandler  # type: ignore[import-untyped]

from _report import bench_options, table_file, write_json
from haptether.dynamixel import DynamixelBus, SyncRead

EXAMPLE = "example: python benches/dynamixel.py --servos 7 --rounds 5 --json -"
BAUD = 4_000_000
PRESENT_CURRENT, MEASURED_BYTES = 126, 10
GOAL_CURRENT = 102
WARM_UP = 20
Cycle = Callable[[], None]


def emulator(servos: int) -> "subprocess.Popen[str]":
    """An emulated bus as a process."""
    named = [f"{1 + index}=XM430-W350" for index in range(servos)]
    command = [sys.executable, "-m", "haptether", "dynamixel-emulator", "--control", "-", "--servos", *named]
    return subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)


def vendor_cycle(port: PortHandler, ids: list[int], fast: bool) -> Cycle:
    """A cycle of the vendor's client."""
    packets = PacketHandler(2.0)
    read = GroupSyncRead(port, packets, PRESENT_CURRENT, MEASURED_BYTES)
    write = GroupSyncWrite(port, packets, GOAL_CURRENT, 2)
    for servo_id in ids:
        read.addParam(servo_id)
        write.addParam(servo_id, [0, 0])
    transfer = read.fastSyncRead if fast else read.txRxPacket

    def cycle() -> None:
        if transfer() != 0:
            message = "a read of the vendor's client failed"
            raise RuntimeError(message)
        for servo_id in ids:
            read.getData(servo_id, PRESENT_CURRENT + 6, 4)
            write.changeParam(servo_id, [1, 0])
        write.txPacket()

    return cycle


def our_cycle(bus: DynamixelBus, ids: list[int], fast: bool) -> Cycle:
    """A cycle of the extension's bus."""
    read = SyncRead(PRESENT_CURRENT, MEASURED_BYTES, ids, fast=fast)
    measured, goals = struct.Struct("<" + "hii" * len(ids)), struct.Struct(f"<{len(ids)}h")
    named = bytes(ids)

    def cycle() -> None:
        measured.unpack(bus.sync_read(read))
        bus.sync_write(GOAL_CURRENT, 2, named, goals.pack(*[1] * len(ids)))

    return cycle


def taken_ms(cycle: Cycle, cycles: int) -> list[float]:
    """How long each cycle took."""
    for _ in range(WARM_UP):
        cycle()
    taken = []
    for _ in range(cycles):
        begun = time.perf_counter()
        cycle()
        taken.append(1e3 * (time.perf_counter() - begun))
    return taken


def wire_ms(servos: int, fast: bool) -> float:
    """Bytes of a cycle at 10 bits each: instruction and answers of the read, and the write."""
    answers = 8 + servos * (MEASURED_BYTES + 4) if fast else servos * (11 + MEASURED_BYTES)
    return 1e3 * 10 * (14 + servos + answers + 14 + 3 * servos) / BAUD


def main() -> int:
    """Prints p50 and p99 of each client."""
    options = bench_options(__doc__, EXAMPLE)
    options.add_argument("--servos", type=int, default=6, help="how many servos (6)")
    options.add_argument("--rounds", type=int, default=5, help="rounds of each client (5)")
    options.add_argument("--cycles", type=int, default=500, help="cycles of a round (500)")
    chosen = options.parse_args()
    ids = list(range(1, 1 + chosen.servos))
    taken: dict[str, list[float]] = {}
    process = emulator(chosen.servos)
    try:
        assert process.stdout is not None
        path = process.stdout.readline().partition(" on ")[2].partition(" at ")[0]
        for _ in range(chosen.rounds):
            for fast in (True, False):
                kind = "fast sync read" if fast else "sync read"
                bus = DynamixelBus(path, baud=BAUD, timeout_s=0.5)
                taken.setdefault(f"haptether, {kind}", []).extend(taken_ms(our_cycle(bus, ids, fast), chosen.cycles))
                bus.close()
                port = PortHandler(path)
                if not (port.openPort() and port.setBaudRate(BAUD)):
                    message = f"{path}: the vendor's client cannot open it"
                    raise RuntimeError(message)
                taken.setdefault(f"dynamixel-sdk, {kind}", []).extend(
                    taken_ms(vendor_cycle(port, ids, fast), chosen.cycles)
                )
                port.closePort()
    finally:
        process.terminate()
        process.wait()
    report = {
        "servos": chosen.servos,
        "clients": {
            name: {
                "p50_ms": float(np.percentile(times, 50)),
                "p99_ms": float(np.percentile(times, 99)),
                "wire_ms": wire_ms(chosen.servos, "fast" in name),
            }
            for name, times in taken.items()
        },
    }
    out = table_file(chosen.json)
    print(f"{chosen.servos} servos, {chosen.rounds * chosen.cycles} cycles each", file=out)
    for name, figures in report["clients"].items():
        print(
            f"{name:32} p50 {figures['p50_ms']:7.3f} ms, p99 {figures['p99_ms']:7.3f} ms, "
            f"on a wire {figures['wire_ms']:.3f} ms more",
            file=out,
        )
    write_json(chosen.json, report)
    return 0


if __name__ == "__main__":
    sys.exit(main())
