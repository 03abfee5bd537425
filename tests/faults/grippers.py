"""Faults of a gripper or its server while the gripper holds an object; over real sockets, on an emulated gripper."""

import time
from collections.abc import Callable

from tests.faults.rows import Complaints, Row
from tests.gripper.serving import MISBEHAVIOURS, Misbehaviour, Served, served
from tests.gripper.virtual import gripper, move

from haptether.slave import GripperSample, RobotiqGripper
from haptether.slave.robotiq.protocol import FAULTS, fault_text

REPLY_S = 0.2
SEEN_S = REPLY_S + 0.3
"""Longest time from a fault to its sample, in s: a reply that does not come, and one reading of each kind."""
PATIENCE_S = 10.0
WATCHED_S = 0.3
"""Time to watch after the fault, and after its acknowledgement, in s."""
STROKE_M = 0.085
RELEASES = 11
"""Fault code of the automatic release, which moves the jaws on purpose."""


def rows(limit_s: float = SEEN_S) -> list[Callable[[], Row]]:
    """Return all faults of a server or a gripper; `limit_s` bounds the time until a sample shows the fault."""
    of_server = [
        lambda misbehaves=misbehaves, name=name: _row(
            f"server of a gripper: {misbehaves.__name__.replace('_', ' ')}", name, misbehaves, 0, limit_s
        )
        for misbehaves, name in MISBEHAVIOURS
    ]
    of_gripper = [
        lambda flt=flt: _row(f"gripper: FLT {flt}, {FAULTS[flt][0]}", fault_text(flt), None, flt, limit_s)
        for flt in sorted(FAULTS)
        if flt != RELEASES
    ]
    return [*of_server, *of_gripper]


def _row(fault: str, name: str, misbehaves: Misbehaviour | None, flt: int, limit_s: float) -> Row:
    wrong = Complaints()
    with served(gripper(40.0)) as server:
        driver = RobotiqGripper(host="127.0.0.1", port=server.port, reply_timeout_s=REPLY_S)
        driver.open()
        try:
            driver.write(move(1.0, speed=1.5, force_n=100.0))
            held = _until(driver, lambda sample: sample.holds_object)
            before, counts = server.settings.copy(), server.gripper.read("POS")
            begun_s = time.monotonic()
            _befall(server, misbehaves, flt)
            seen = _until(driver, lambda sample: sample.fault is not None)
            reaction_s = time.monotonic() - begun_s
            # Lost activation shows as this text or as the fault, depending on which variable is read first.
            expected = (name, "not active: STA 0: ") if flt in {7, 10} else (name,)
            wrong.check(str(seen.fault).startswith(expected), f"the fault is {seen.fault}")
            wrong.check(seen.holds_object == held.holds_object, "it says that it holds nothing any more")
            driver.write(move(0.0))
            time.sleep(WATCHED_S)
            wrong.check(driver.read().fault == seen.fault, "the fault did not stay")
            _befall(server, None, 0)
            driver.acknowledge()
            time.sleep(WATCHED_S)
            wrong.check(server.settings == before, f"it was set {server.settings[len(before) :]}")
        finally:
            driver.close()
        moved = abs((server.gripper.read("POS") or 0) - (counts or 0)) / 227.0 * STROKE_M
    wrong.check(moved == 0.0, f"its jaws moved by {1e3 * moved:.1f} mm")
    wrong.check(reaction_s < limit_s, f"was seen after {reaction_s:.2f} s")
    return Row(
        fault=fault, how="calls", expected="a named fault that stays; the grip is kept, and nothing is set",
        measured=f"{str(seen.fault).partition(': ')[0]}, set nothing", reaction_s=reaction_s, limit_s=limit_s,
        moved_m=moved, complaints=wrong.all(),
    )  # fmt: skip


def _befall(server: Served, misbehaves: Misbehaviour | None, flt: int) -> None:
    server.misbehaves = misbehaves
    server.gripper.fail(flt)


def _until(driver: RobotiqGripper, holds: Callable[[GripperSample], bool]) -> GripperSample:
    end_s = time.monotonic() + PATIENCE_S
    while not holds(sample := driver.read()):
        if time.monotonic() > end_s:
            message = f"not within {PATIENCE_S} s: {sample}"
            raise TimeoutError(message)
        time.sleep(0.002)
    return sample
