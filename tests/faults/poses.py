"""Invalid orientations, an arm without a pose, and unknown buttons; over real sockets."""

import math
import secrets
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from tests.faults.drivers import COUPLED, ENGAGED_WITHIN_S, STILL
from tests.faults.rows import Complaints, Row

from haptether.bridge import (
    DeviceError,
    MasterLoop,
    MasterRun,
    MasterTrace,
    SlaveLoop,
    SlaveRun,
    SlaveTrace,
    load_scene,
    override_scene,
    scene_json,
)
from haptether.master import MasterSample
from haptether.safety import fault_message
from haptether.slave import GripperCommand, GripperSample, SlaveSample

Vector = tuple[float, ...]
Orientation = tuple[float, ...] | None

STILL_THERE: Vector = (0.0, 0.0, 0.0)
UPRIGHT: Vector = (1.0, 0.0, 0.0, 0.0)
NONE: dict[str, Vector] = {
    "NaN": (math.nan, 0.0, 0.0, 0.0),
    "zeros": (0.0, 0.0, 0.0, 0.0),
    "+Inf": (math.inf, 0.0, 0.0, 0.0),
    "of length 1.1": (1.1, 0.0, 0.0, 0.0),
}
"""Invalid unit quaternions."""
FAULTS = {"orientation is not a finite number", "orientation is no unit quaternion: its norm is not 1 to 1e-9"}
LED_S = 0.5
"""Time from the engagement to the fault, in s: longer than the fade-in."""
WATCHED_S = 0.5
ATTEMPTS = 3
CLUTCH, GRIPPER = 1 << 4, 1 << 0
PRESS_S = 0.06
"""Length of a press, in s. A contact that was open for less than 20 ms counts as a bounce."""

SCENE = override_scene(
    load_scene("torque_release", ["link={}"]),
    ["environment.torques=[]", "operator.clutch=once", "slave.gripper={speed = 10.0}"],
)
SPEC = scene_json(SCENE)
WITH_BUTTONS = scene_json(override_scene(SCENE, ["master.buttons={clutch = 4, gripper = 0}"]))


@dataclass
class Hand:
    """Device with buttons that turns slowly about z."""

    paces = False
    kinds = ("pose",)
    orientation: Orientation = None
    """Replaces the measured orientation."""
    buttons: int | None = 0
    wrenches: list[tuple[float, Vector, Vector]] = field(default_factory=list)

    def open(self) -> None:
        self.begun_s = time.monotonic()

    def read(self) -> MasterSample:
        half = 0.05 * math.sin(3.0 * (time.monotonic() - self.begun_s))
        turned = self.orientation or (math.cos(half), 0.0, 0.0, math.sin(half))
        return MasterSample(STILL_THERE, STILL_THERE, orientation=turned, buttons=self.buttons)

    def write(self, force: Vector, torque: Vector | None = None) -> None:
        assert torque is not None
        self.wrenches.append((time.monotonic(), force, torque))

    def close(self) -> None:
        pass

    def acknowledge(self) -> None:
        self.orientation = None


@dataclass
class Arm:
    """Arm that is always at its commanded pose, against 0.05 N m."""

    paces = False
    kinds = ("pose",)
    orientation: Orientation = None
    is_lost: bool = False
    turned: Vector = UPRIGHT
    orders: list[tuple[float, Orientation]] = field(default_factory=list)
    """Time and commanded orientation; None for a stop."""

    def open(self) -> None:
        pass

    def read(self) -> SlaveSample:
        turned = None if self.is_lost else self.orientation or self.turned
        return SlaveSample(STILL_THERE, STILL_THERE, (0.5, 0.0, 0.0), None, turned, STILL_THERE, (0.0, 0.0, 0.05))

    def write(
        self, position: Vector, velocity: Vector, orientation: Orientation = None, angular_velocity: Orientation = None
    ) -> None:
        assert len(position) == len(velocity) == 3
        assert orientation is not None
        assert angular_velocity is not None
        self.turned = orientation
        self.orders.append((time.monotonic(), orientation))

    def stop(self) -> None:
        self.orders.append((time.monotonic(), None))

    def close(self) -> None:
        pass

    def acknowledge(self) -> None:
        self.orientation = None


@dataclass
class Jaws:
    """Gripper that is always at its commanded position, up to an object at 0.7."""

    orders: list[tuple[float, float]] = field(default_factory=list)
    """Time and commanded position: 0 open to 1 closed."""
    position: float = 0.0

    def open(self) -> None:
        pass

    def read(self) -> GripperSample:
        holds = self.position >= 0.7
        force_n = 30.0 if holds else 0.0
        return GripperSample(position=self.position, velocity=0.0, force_n=force_n, holds_object=holds)

    def write(self, command: GripperCommand) -> None:
        self.orders.append((time.monotonic(), command.position))
        self.position = min(command.position, 0.7)

    def hold(self) -> None:
        pass

    def close(self) -> None:
        pass


@dataclass
class Rig:
    """Both sides, each with a driver in Python."""

    hand: Hand
    arm: Arm
    jaws: Jaws
    master: MasterRun
    slave: SlaveRun

    def until(self, done: Callable[[], bool], seconds: float = ENGAGED_WITHIN_S) -> float:
        """Wait for a condition; return the elapsed time in s, infinite after a timeout."""
        begun_s = time.monotonic()
        while not done():
            if time.monotonic() - begun_s > seconds:
                return math.inf
            time.sleep(0.0005)
        return time.monotonic() - begun_s

    def are_engaged(self) -> bool:
        return self.master.state == self.slave.state == "engaged"

    def engaged(self, press: Callable[[], None] | None = None) -> None:
        """Wait until both sides have been coupled for a while; press again if a delay of the machine held them."""
        for _ in range(ATTEMPTS):
            self.until(self.are_engaged)
            time.sleep(LED_S)
            if self.are_engaged():
                return
            (press or self.master.press_clutch)()
        message = f"they do not engage: {self.master.state}, {self.slave.state}"
        raise TimeoutError(message)

    def side(self, name: str) -> MasterRun | SlaveRun:
        return self.master if name == "master" else self.slave

    def finish(self) -> tuple[MasterTrace, SlaveTrace]:
        self.master.stop()
        near, _ = self.master.finish()
        self.slave.stop()
        far, _ = self.slave.finish()
        return near, far

    def turned_after(self, at_s: float) -> float:
        """Return the largest turn of the commands after a time of the monotonic clock, in rad."""
        later = np.array([turned for ordered_s, turned in self.arm.orders if ordered_s > at_s and turned is not None])
        if not len(later):
            return 0.0
        apart = [np.linalg.norm(later - sign * later[0], axis=1) for sign in (1.0, -1.0)]
        return float(4.0 * np.arcsin(np.minimum(*apart) / 2.0).max())


@contextmanager
def rig(spec: bytes) -> Iterator[Rig]:
    """Run both sides over loopback."""
    hand, arm, jaws, key = Hand(), Arm(), Jaws(), secrets.token_bytes(32)
    loop = SlaveLoop(spec, listen="127.0.0.1:0", run_id=1, key=key)
    slave = SlaveRun(arm, loop, gripper=jaws)
    master = MasterRun(hand, MasterLoop(spec, peer=loop.address, run_id=2, key=key, patience_s=ENGAGED_WITHIN_S))
    of_both = Rig(hand, arm, jaws, master, slave)
    try:
        yield of_both
    finally:
        master.stop()
        slave.stop()


BRAKED_S = 0.3
"""Time from a hold to rest, in s: 2.5 rad/s at 25 rad/s², with a margin."""


def no_orientation(side: str, limit_s: float) -> Row:
    """An invalid orientation yields neither a wrench nor a motion, and a fault that stays until it is acknowledged."""
    found, faults = Complaints(), set()
    took_s, turned_rad, wrench = 0.0, 0.0, 0.0
    peer = "slave" if side == "master" else "master"
    for name, none in NONE.items():
        with rig(SPEC) as both:
            both.engaged()
            found.check(np.linalg.norm(both.hand.wrenches[-1][2]) > 0.01, f"{name}: no torque before it")
            at_s = time.monotonic()
            driver = both.hand if side == "master" else both.arm
            driver.orientation = none
            took_s = max(took_s, both.until(lambda: both.side(peer).state in STILL, 2.0))
            time.sleep(WATCHED_S)
            state = both.side(side).state
            found.check(state == "fault", f"{name}: the {side} stood in {state}")
            both.side(side).acknowledge()
            time.sleep(0.1)
            state = both.side(side).state
            found.check(state == "disengaged", f"{name}: acknowledged, it stands in {state}")
            turned_rad = max(turned_rad, both.turned_after(at_s + BRAKED_S))
            late = [one for wrote_s, *pair in both.hand.wrenches if wrote_s > at_s + limit_s for one in pair]
            if side == "master":
                wrench = max([wrench, *(float(np.abs(one).max()) for one in late)])
            near, far = both.finish()
        trace: MasterTrace | SlaveTrace = near if side == "master" else far
        # The acknowledgement clears the last fault; earlier ticks keep it.
        faults |= {str(fault_message(int(code))) for code in set(trace.fault.tolist()) if code}
    found.check(faults == FAULTS, f"faults: {sorted(faults)}")
    found.check(took_s <= limit_s, f"the {peer} held after {took_s:g} s")
    found.check(turned_rad == 0.0, f"the command turned by {turned_rad:g} rad while nobody was coupled")
    found.check(wrench == 0.0, f"{wrench:g} N or N m on the hand")
    return Row(
        fault=f"{', '.join(NONE)} as an orientation from the {side}'s driver", how="calls",
        expected="fault until acknowledged; the peer holds", measured="; ".join(sorted(faults)), reaction_s=took_s,
        limit_s=limit_s, force_n=wrench if side == "master" else None, complaints=found.all(),
    )  # fmt: skip


def lost_pose(limit_s: float) -> Row:
    """An arm whose driver loses the orientation of its tool is stopped, and its run ends."""
    found = Complaints()
    with rig(SPEC) as both:
        both.engaged()
        at_s = time.monotonic()
        both.arm.is_lost = True
        took_s = both.until(lambda: both.master.state in STILL, 2.0)
        time.sleep(WATCHED_S)
        found.check(not {both.master.state} & COUPLED, f"the master stands in {both.master.state}")
        error = both.slave.error
        found.check(isinstance(error, DeviceError), f"the slave's run ended by {error!r}")
        found.check("orientation is missing" in str(error), f"it says {error}")
        found.check(both.arm.orders[-1][1] is None, f"commanded last: {both.arm.orders[-1]}")
        turned_rad = both.turned_after(at_s + BRAKED_S)
        wrench = max(float(np.abs(one).max()) for one in both.hand.wrenches[-1][1:])
        both.finish()
    found.check(turned_rad == 0.0, f"the command turned by {turned_rad:g} rad after it")
    found.check(wrench == 0.0, f"{wrench:g} N or N m left on the hand")
    found.check(took_s <= limit_s, f"the master held after {took_s:g} s")
    return Row(
        fault="the arm's driver does not know its pose", how="calls", expected="stop; the run ends; the master holds",
        measured="DeviceError: the orientation is missing", reaction_s=took_s, limit_s=limit_s, force_n=wrench,
        complaints=found.all(),
    )  # fmt: skip


def unknown_buttons(limit_s: float) -> Row:
    """An unknown button leaves the clutch open, and no gap in the data presses it; the gripper stays in place."""
    found = Complaints()
    with rig(WITH_BUTTONS) as both:
        hand = both.hand
        both.until(lambda: both.master.is_answered)

        def press() -> None:
            hand.buttons = 0
            time.sleep(PRESS_S)
            hand.buttons = CLUTCH

        press()
        both.engaged(press)
        hand.buttons = CLUTCH | GRIPPER
        time.sleep(0.3)
        at_s = time.monotonic()
        hand.buttons = None
        took_s = both.until(lambda: not {both.master.state, both.slave.state} & COUPLED, 2.0)
        time.sleep(PRESS_S)
        for word, expected in ((CLUTCH | GRIPPER, "disengaged"), (None, "disengaged"), (CLUTCH, "disengaged")):
            hand.buttons = word
            time.sleep(0.2)
            state = both.master.state
            found.check(state == expected, f"{word}: the master stands in {state}")
        turned_rad = both.turned_after(at_s + BRAKED_S)
        hand.buttons = 0
        time.sleep(PRESS_S)
        pressed_s = time.monotonic()
        hand.buttons = CLUTCH
        again_s = both.until(both.are_engaged, 2.0)
        both.finish()
    before = [to for ordered_s, to in both.jaws.orders if ordered_s <= at_s]
    apart = [to for ordered_s, to in both.jaws.orders if at_s + limit_s < ordered_s < pressed_s]
    found.check(again_s < math.inf, "seen open and pressed, it did not engage")
    found.check(took_s <= limit_s, f"the two were apart after {took_s:g} s")
    found.check(turned_rad == 0.0, f"the command turned by {turned_rad:g} rad while they were apart")
    found.check(before[-1:] == [1.0], f"closed, the gripper was led to {before[-1:]}")
    found.check(not apart, f"apart, the gripper was led to {apart[-1:]}")
    found.check(both.jaws.position == 0.7, f"it opened from what it held at 0.7 to {both.jaws.position:g}")
    return Row(
        fault="the buttons of the device become unknown", how="calls",
        expected="disengaged until seen open and pressed; the grip is kept",
        measured=f"disengaged; engages {again_s * 1e3:.0f} ms after a press", reaction_s=took_s, limit_s=limit_s,
        complaints=found.all(),
    )  # fmt: skip


def rows(limit_s: float = 0.05) -> list[Callable[[], Row]]:
    """Return all rows; `limit_s` bounds the reaction of a side, polling by the watcher included."""
    orientations = [partial(no_orientation, side, limit_s) for side in ("master", "slave")]
    return [*orientations, partial(lost_pose, limit_s), partial(unknown_buttons, limit_s)]
