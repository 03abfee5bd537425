"""Drivers in Python that fail: exceptions, blocked calls, invalid numbers; over real sockets."""

import math
import secrets
import time
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt
from tests.faults.rows import Complaints, Row

from haptether.bridge import (
    DeviceError,
    DeviceRun,
    LiveMaster,
    LiveSlave,
    MasterLoop,
    MasterRun,
    MasterTrace,
    Scene,
    SlaveLoop,
    SlaveRun,
    SlaveTrace,
    ladder_reason,
    load_scene,
    scene_json,
)
from haptether.master import MasterSample
from haptether.safety import fault_message
from haptether.slave import SlaveSample

ENGAGED_WITHIN_S = 10.0
WATCHED_S = 0.6
"""Time in s for which both sides are watched after the fault: longer than the time to the stop."""
COUPLED = frozenset({"engaged", "stale"})
STILL = frozenset({"hold", "stop", "fault"})


class Broken(Exception):  # noqa: N818  # the exception of a foreign driver
    """A device that was unplugged."""


@dataclass
class InjectedFault:
    """A fault of a driver, injected once both sides have engaged."""

    kind: str = "none"
    blocked_s: float = 0.0
    at_s: float | None = None

    def meet(self) -> float:
        """Raise, block, or return the value that is added to the sample."""
        if self.kind == "none" or (self.at_s is not None and self.kind == "block"):
            return 0.0
        self.at_s = self.at_s or time.monotonic()
        if self.kind == "raise":
            raise Broken
        if self.kind == "block":
            time.sleep(self.blocked_s)
        return math.nan if self.kind == "nan" else 0.0


@dataclass
class PythonHand:
    """A master in Python: a hand that goes into the wall and trembles."""

    injected: InjectedFault = field(default_factory=InjectedFault)
    paces: bool = False
    forces: list[tuple[float, float]] = field(default_factory=list)
    opened: int = 0
    closed: int = 0

    def open(self) -> None:
        self.opened += 1
        self.begun_s = time.monotonic()

    def read(self) -> MasterSample:
        elapsed_s = time.monotonic() - self.begun_s
        depth_m = 0.04 * min(1.0, elapsed_s / 1.0) + 0.002 * math.sin(6.0 * elapsed_s)
        wrong = self.injected.meet()
        return MasterSample(0.02 - depth_m + wrong, fault="unplugged" if self.injected.kind == "fault" else None)

    def write(self, force: tuple[float, ...]) -> None:
        self.forces.append((time.monotonic(), force[0]))

    def close(self) -> None:
        self.closed += 1

    def acknowledge(self) -> None:
        self.injected = InjectedFault()


@dataclass
class PythonArm:
    """A slave in Python: an arm at its commanded position, on a spring of 100 N/m at 0."""

    injected: InjectedFault = field(default_factory=InjectedFault)
    paces: bool = False
    position: float = 0.02
    orders: list[tuple[float, str, float]] = field(default_factory=list)
    opened: int = 0
    closed: int = 0

    def open(self) -> None:
        self.opened += 1

    def read(self) -> SlaveSample:
        wrong = self.injected.meet()
        fault = "unplugged" if self.injected.kind == "fault" else None
        return SlaveSample(self.position + wrong, 0.0, max(0.0, -100.0 * self.position), fault)

    def write(self, position: tuple[float, ...], velocity: tuple[float, ...]) -> None:
        assert len(velocity) == 1
        self.position = position[0]
        self.orders.append((time.monotonic(), "move", position[0]))

    def stop(self) -> None:
        self.orders.append((time.monotonic(), "stop", self.position))

    def close(self) -> None:
        self.closed += 1

    def acknowledge(self) -> None:
        self.injected = InjectedFault()


@dataclass
class Seen:
    """Observations of both sides."""

    at_s: float
    states: dict[str, list[tuple[float, str]]]
    run: DeviceRun
    reasons: dict[str, list[str]]
    faults: dict[str, str | None]
    force: npt.NDArray[np.float64]
    """F_device over the ticks of the master."""
    skipped: int

    def after_s(self, side: str) -> float:
        """Return the time in s from the fault until a side was no longer coupled."""
        times = [at_s for at_s, state in self.states[side] if at_s >= self.at_s and state in STILL]
        return times[0] - self.at_s if times else math.inf

    def engaged_again(self, side: str) -> bool:
        """Return true if a side was coupled again after it had come to rest."""
        after = [state for at_s, state in self.states[side] if at_s >= self.at_s + self.after_s(side)]
        return any(state in COUPLED for state in after)


def scene() -> Scene:
    """Return the remote wall, without a push and without a network."""
    return load_scene("remote_push", ["environment.pushers=[]", "slave.max_acceleration=5.0", "operator.clutch=once"])


def watch(
    device: PythonHand | PythonArm, injected: InjectedFault, then: Callable[[DeviceRun], None] | None = None
) -> Seen:
    """Run a side in Python against a native one, and inject a fault into its driver once both have engaged."""
    spec, key = scene_json(scene()), secrets.token_bytes(32)
    master: LiveMaster | MasterRun
    slave: LiveSlave | SlaveRun
    run: MasterRun | SlaveRun
    if isinstance(device, PythonHand):
        slave = LiveSlave(spec, listen="127.0.0.1:0", run_id=1, key=key)
        master = run = MasterRun(device, MasterLoop(spec, peer=slave.address, run_id=2, key=key))
    else:
        loop = SlaveLoop(spec, listen="127.0.0.1:0", run_id=1, key=key)
        slave = run = SlaveRun(device, loop)
        master = LiveMaster(spec, peer=loop.address, run_id=2, key=key)
    states: dict[str, list[tuple[float, str]]] = {"master": [], "slave": []}

    def look() -> None:
        for name, side in (("master", master), ("slave", slave)):
            if not states[name] or states[name][-1][1] != side.state:
                states[name].append((time.monotonic(), side.state))

    def until(done: Callable[[], bool], seconds: float) -> bool:
        end_s = time.monotonic() + seconds
        while time.monotonic() < end_s and not done():
            look()
            time.sleep(0.0005)
        return done()

    assert until(lambda: master.state == slave.state == "engaged", ENGAGED_WITHIN_S), (master.state, slave.state)
    # Wait until the hand is in the wall.
    until(lambda: False, 1.2)
    device.injected = injected
    begun_s = time.monotonic()
    until(lambda: False, WATCHED_S + injected.blocked_s)
    if then is not None:
        then(run)
        until(lambda: False, 0.3)
    look()
    near, near_report = master.finish()
    far, far_report = slave.finish()
    reports = {"master": near_report, "slave": far_report}
    # Each side has its own trace.
    traces: dict[str, MasterTrace | SlaveTrace] = {"master": near, "slave": far}
    return Seen(
        at_s=injected.at_s or begun_s,
        states=states,
        run=run,
        reasons={
            name: [ladder_reason(int(code)) for code in dict.fromkeys(trace.reason.tolist()) if code]
            for name, trace in traces.items()
        },
        faults={
            name: fault_message(int(trace.fault[-1])) if int(trace.fault[-1]) else None
            for name, trace in traces.items()
        },
        force=near.device_force,
        skipped=reports["master" if isinstance(device, PythonHand) else "slave"].skipped,
    )


def raising(side: str, limit_s: float) -> Row:
    """Measure a driver that raises an exception."""
    device = PythonHand() if side == "master" else PythonArm()
    seen = watch(device, InjectedFault("raise"))
    found = Complaints()
    peer = "slave" if side == "master" else "master"
    error = seen.run.error
    found.check(isinstance(error, DeviceError) and isinstance(error.__cause__, Broken), f"the run ended by {error!r}")
    found.check(seen.faults[side] == "the device failed", f"fault: {seen.faults[side]}")
    found.check("peer has a fault" in seen.reasons[peer], f"{peer}: {seen.reasons[peer]}")
    found.check(not seen.engaged_again(peer), f"the {peer} engaged again")
    found.check((device.opened, device.closed) == (1, 1), f"opened {device.opened}, closed {device.closed} times")
    if isinstance(device, PythonHand):
        found.check(device.forces[-1][1] == 0.0, f"{device.forces[-1][1]:g} N left on the device")
        found.check(max(force for _, force in device.forces) > 1.0, "there was no force before it")
    else:
        found.check(device.orders[-1][1] == "stop", f"commanded last: {device.orders[-1]}")
    took_s = seen.after_s(peer)
    found.check(took_s <= limit_s, f"the {peer} held after {took_s:g} s")
    return Row(
        fault=f"exception in the {side}'s driver", how="calls", expected="zero force or stop; fault; the peer holds",
        measured=f"fault: {seen.faults[side]}; {peer}: peer has a fault", reaction_s=took_s, limit_s=limit_s,
        force_n=abs(float(seen.force[-1])), complaints=found.all(),
    )  # fmt: skip


def blocking(side: str, blocked_s: float, limit_s: float) -> Row:
    """Measure a driver that blocks in `read`, then goes on."""
    device = PythonHand() if side == "master" else PythonArm()
    injected = InjectedFault("block", blocked_s)
    seen = watch(device, injected)
    found = Complaints()
    peer = "slave" if side == "master" else "master"
    found.check(seen.run.error is None, f"the run ended by {seen.run.error!r}")
    for name in (side, peer):
        found.check(seen.after_s(name) < math.inf, f"the {name} did not hold")
        found.check(not seen.engaged_again(name), f"the {name} engaged again by itself")
    period_s = 1e-3
    found.check(seen.skipped >= blocked_s / period_s - 2, f"{seen.skipped} ticks left out")
    took_s = seen.after_s(peer)
    found.check(took_s <= limit_s, f"the {peer} held after {took_s:g} s")
    late_s = seen.after_s(side) - blocked_s
    found.check(late_s <= limit_s, f"the {side} held {late_s:g} s after it woke")
    force_n = float(np.abs(seen.force[-100:]).max())
    found.check(force_n == 0.0, f"{force_n:g} N at the end")
    return Row(
        fault=f"the {side}'s driver blocks for {blocked_s * 1e3:.0f} ms", how="calls",
        expected="both hold; backlog discarded; no engagement", measured=f"held; {seen.skipped} ticks left out",
        reaction_s=took_s, limit_s=limit_s, force_n=force_n, complaints=found.all(),
    )  # fmt: skip


def hanging(side: str, limit_s: float) -> Row:
    """Measure a driver that blocks in `read` for longer than the watch waits: the fault names it."""
    device = PythonHand() if side == "master" else PythonArm()
    seen = watch(device, InjectedFault("block", 1.2))
    found = Complaints()
    peer = "slave" if side == "master" else "master"
    named = "has not returned for 0.5 s"
    found.check(seen.run.error is None, f"the run ended by {seen.run.error!r}")
    found.check(named in (seen.run.cause() or ""), f"the {side} says {seen.run.cause()}")
    found.check(seen.faults[side] == "the device failed", f"fault: {seen.faults[side]}")
    for name in (side, peer):
        found.check(not seen.engaged_again(name), f"the {name} engaged again by itself")
    took_s, named_s = seen.after_s(peer), seen.after_s(side)
    found.check(took_s <= limit_s, f"the {peer} held after {took_s:g} s")
    found.check(named_s <= 1.0 + limit_s, f"the {side} named it after {named_s:g} s")
    force_n = float(np.abs(seen.force[-100:]).max())
    found.check(force_n == 0.0, f"{force_n:g} N at the end")
    return Row(
        fault=f"the {side}'s driver does not return for 1.2 s", how="calls",
        expected="fault that names it; no engagement", measured=f"named after {named_s:.2f} s; the {peer} held",
        reaction_s=took_s, limit_s=limit_s, force_n=force_n, complaints=found.all(),
    )  # fmt: skip


def bad_number(side: str, limit_s: float) -> Row:
    """Measure NaN in a sample: the fault stays until it is acknowledged and the numbers are valid."""
    device = PythonHand() if side == "master" else PythonArm()
    after: list[str] = []

    def acknowledge(run: DeviceRun) -> None:
        after.append(run.state)
        run.acknowledge()
        time.sleep(0.1)
        after.append(run.state)

    seen = watch(device, InjectedFault("nan"), acknowledge)
    found = Complaints()
    peer = "slave" if side == "master" else "master"
    found.check(seen.run.error is None, f"the run ended by {seen.run.error!r}")
    found.check(after[0] == "fault", f"the {side} stood in {after[0]}")
    found.check(after[1] == "disengaged", f"acknowledged, it stands in {after[1]}")
    found.check("peer has a fault" in seen.reasons[peer], f"{peer}: {seen.reasons[peer]}")
    took_s = seen.after_s(peer)
    found.check(took_s <= limit_s, f"the {peer} held after {took_s:g} s")
    force_n = float(np.abs(seen.force[-100:]).max())
    found.check(force_n == 0.0, f"{force_n:g} N at the end")
    return Row(
        fault=f"NaN from the {side}'s driver", how="calls", expected="fault until acknowledged; the peer holds",
        measured=f"fault, then {after[1]}", reaction_s=took_s, limit_s=limit_s, force_n=force_n, complaints=found.all(),
    )  # fmt: skip


def says_so(side: str, limit_s: float) -> Row:
    """Measure a device that reports a fault."""
    device = PythonHand() if side == "master" else PythonArm()
    seen = watch(device, InjectedFault("fault"))
    found = Complaints()
    peer = "slave" if side == "master" else "master"
    found.check(seen.run.error is None, f"the run ended by {seen.run.error!r}")
    found.check(seen.faults[side] == "the device failed", f"fault: {seen.faults[side]}")
    found.check(seen.run.notes.fault == "unplugged", f"reported: {seen.run.notes.fault}")
    if isinstance(device, PythonArm):
        stops = [kind for _, kind, _ in device.orders].count("stop")
        found.check(stops == 2, f"stopped {stops} times: once at the fault, once at the end")
    took_s = seen.after_s(peer)
    found.check(took_s <= limit_s, f"the {peer} held after {took_s:g} s")
    return Row(
        fault=f"the {side}'s device says that it has failed", how="calls", expected="fault, told; the peer holds",
        measured=f"{seen.faults[side]}: {seen.run.notes.fault}", reaction_s=took_s, limit_s=limit_s,
        complaints=found.all(),
    )  # fmt: skip


def rows(limit_s: float = 0.05) -> list[Callable[[], Row]]:
    """Return all measurements; a side has `limit_s` to react, which includes the watcher's period."""

    def each(measure: Callable[[str, float], Row], side: str, limit: float) -> Callable[[], Row]:
        return lambda: measure(side, limit)

    def blocked(side: str, limit_s: float) -> Row:
        return blocking(side, 0.06, limit_s)

    measures = (raising, bad_number, says_so, blocked, hanging)
    return [each(measure, side, limit_s) for measure in measures for side in ("master", "slave")]
