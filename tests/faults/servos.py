"""An arm of servos whose bus, servos or process fail while it exerts force; on an emulated bus."""

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from typing import Any

from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.faults.rows import Complaints, Row

from haptether.dynamixel.arm import ArmSettings, FaultKind, ServoArm, ServoSettings

PATIENCE_S = 10.0
STARTED_S = 30.0
ASKED_S = 1.0
"""Time in s in which each silent servo is searched for."""
WATCHED_S = 0.3
"""Time in s after the fault, in which no current comes back."""
CURRENT_A = 0.1
SERVOS = ("1=XM430-W350", "2=XL330-M288")
FAULTS: tuple[tuple[str, str, tuple[FaultKind, ...]], ...] = (
    ("unplugged", "unplug", (FaultKind.UNPLUGGED,)),
    ("all answers mute", "mute 1000000", (FaultKind.BROWN_OUT,)),
    ("one servo mute", "silent 2 on", (FaultKind.SILENT,)),
    ("a bit wrong in each answer", "corrupt 1000000", (FaultKind.UNREADABLE, FaultKind.SILENT, FaultKind.BROWN_OUT)),
    ("a byte lost of each answer", "drop 1000000", (FaultKind.UNREADABLE, FaultKind.SILENT, FaultKind.BROWN_OUT)),
    ("brown-out", "brown-out 1", (FaultKind.BROWN_OUT,)),
    ("brown-out that nobody hears", "brown-out 0", (FaultKind.REBOOTED,)),
    ("input voltage", "hardware-error 2 input-voltage", (FaultKind.INPUT_VOLTAGE,)),
    ("overheating", "temperature 2 90", (FaultKind.OVERHEATING,)),
    ("encoder", "hardware-error 2 encoder", (FaultKind.ENCODER,)),
    ("electrical shock", "hardware-error 2 electrical-shock", (FaultKind.ELECTRICAL_SHOCK,)),
    ("overload", "hardware-error 2 overload", (FaultKind.OVERLOAD,)),
)
"""Name of the fault, the control line that causes it, and its possible kinds."""
ENDS = ("SIGINT", "exception", "SIGKILL", "SIGSTOP")
CLIENT = """
import sys, time
from tests.faults.servos import CURRENT_A, arm_on

arm = arm_on(sys.argv[1], patient=sys.argv[3] == "patient")
arm.open()
begin = time.monotonic()
try:
    while time.monotonic() - begin < 60.0:
        if arm.read():
            arm.write_currents([CURRENT_A, CURRENT_A])
        time.sleep(0.001)
        if sys.argv[2] == "exception" and time.monotonic() - begin > 0.5:
            print("now", flush=True)
            raise ValueError("of whoever uses it")
finally:
    arm.close()
"""


def arm_on(port: str, *, patient: bool) -> ServoArm:
    """Return an arm with two joints led by currents; patient if other work may halt them."""
    servos = tuple(ServoSettings(servo_id=int(one.partition("=")[0]), model=one.partition("=")[2]) for one in SERVOS)
    limits: dict[str, Any] = {"timeout_s": 0.1, "lost_after_s": 0.2, "watchdog_s": 1.0} if patient else {}
    return ServoArm(ArmSettings(port=port, servos=servos, ramp_s=0.0, release_s=0.0, **limits), report=lambda _: None)


def rows(*, patient: bool = False) -> list[Callable[[], Row]]:
    """Return each fault of bus and servos, then each end of a process."""
    return [
        *(lambda name=name, line=line, kinds=kinds: _row(name, line, kinds, patient) for name, line, kinds in FAULTS),
        *(lambda end=end: _ended(end, patient) for end in ENDS),
    ]


class _Watch:
    """A thread that notes when no servo has current any more."""

    def __init__(self, emulated: EmulatedBus) -> None:
        self.begun_s = time.monotonic()
        self.ended_s: float | None = None
        self._emulated = emulated
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def _look(self) -> None:
        while time.monotonic() - self.begun_s < PATIENCE_S:
            if at_rest(self._emulated):
                self.ended_s = time.monotonic()
                return
            time.sleep(0.001)

    def finish(self) -> float | None:
        """Return the time in s until no servo had current; None if some still have it."""
        self._thread.join(PATIENCE_S + 1.0)
        return None if self.ended_s is None else self.ended_s - self.begun_s


def at_rest(emulated: EmulatedBus) -> bool:
    """Return true if no servo has current."""
    return all(servo["current_a"] == 0.0 for servo in emulated.status()["servos"])


def _row(name: str, line: str, kinds: tuple[FaultKind, ...], patient: bool) -> Row:
    wrong = Complaints()
    limit_s = 3.0 if patient else 0.5
    with emulated_bus("--servos", *SERVOS) as emulated:
        arm = arm_on(emulated.port, patient=patient)
        arm.open()
        try:
            end_s = time.monotonic() + PATIENCE_S
            while any(servo["current_a"] == 0.0 for servo in emulated.status()["servos"]):
                arm.read()
                arm.write_currents([CURRENT_A, CURRENT_A])
                wrong.check(time.monotonic() < end_s, "no current before the fault")
                if time.monotonic() > end_s:
                    break
            emulated.do(line)
            watch = _Watch(emulated)
            while arm.fault is None and time.monotonic() < end_s + PATIENCE_S:
                if arm.read():
                    arm.write_currents([CURRENT_A, CURRENT_A])
                time.sleep(0.001)
            took_s = watch.finish()
            # Silent servos are searched for once there is no torque, by the following reads.
            asked_s = time.monotonic() + ASKED_S
            while time.monotonic() < asked_s:
                arm.read()
            fault, kind = arm.fault, arm.fault_kind
            wrong.check(kind in kinds, f"the fault is {fault}")
            wrong.check(took_s is not None and took_s < limit_s, f"no current after {took_s} s")
            _stays(arm, emulated, fault, wrong)
        finally:
            arm.close()
    return Row(
        fault=f"servos: {name}", how="calls", expected="a named fault that stays; no current in any servo",
        measured=str(kind), reaction_s=took_s, limit_s=limit_s, complaints=wrong.all(),
    )  # fmt: skip


def _stays(arm: ServoArm, emulated: EmulatedBus, fault: str | None, wrong: Complaints) -> None:
    until_s = time.monotonic() + WATCHED_S
    while time.monotonic() < until_s:
        arm.read()
        arm.write_currents([CURRENT_A, CURRENT_A])
        wrong.check(arm.fault == fault, f"the fault became {arm.fault}")
        wrong.check(at_rest(emulated), "current came back")


def _ended(end: str, patient: bool) -> Row:
    wrong = Complaints()
    # A killed process sends nothing: its servos wait for the time of their watchdog.
    limit_s = 3.0 if patient else 0.5
    with emulated_bus("--servos", *SERVOS) as emulated:
        command = [sys.executable, "-c", CLIENT, emulated.port, end, "patient" if patient else "-"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as process:
            try:
                end_s = time.monotonic() + STARTED_S
                while at_rest(emulated) and time.monotonic() < end_s:
                    time.sleep(0.002)
                wrong.check(time.monotonic() < end_s, "no current before the end")
                if end == "exception":
                    assert process.stdout is not None
                    process.stdout.readline()
                else:
                    os.kill(process.pid, getattr(signal, end))
                took_s = _Watch(emulated).finish()
                wrong.check(took_s is not None and took_s < limit_s, f"no current after {took_s} s")
                if end in {"SIGINT", "exception"}:
                    process.wait(PATIENCE_S)
                    off = not any(servo["torque"] for servo in emulated.status()["servos"])
                    wrong.check(off, "a servo keeps its torque")
                    measured = "torque off"
                else:
                    fired = all(servo["bus_watchdog"] == -1 for servo in emulated.status()["servos"])
                    wrong.check(fired, "a bus watchdog did not fire")
                    measured = "bus watchdogs fired"
            finally:
                process.kill()
    return Row(
        fault=f"servos: {end} of the process", how="processes", expected="no current in any servo", measured=measured,
        reaction_s=took_s, limit_s=limit_s, complaints=wrong.all(),
    )  # fmt: skip
