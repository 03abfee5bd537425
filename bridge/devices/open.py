"""How the device of a loop is opened, held against its loop, and closed once."""

import contextlib
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

from haptether.bridge.interpreter import QUIET

if TYPE_CHECKING:
    from haptether.master import MasterDevice
    from haptether.slave import Gripper, SlaveDevice

PERIOD_SHARE = 0.01
"""How far the period of a device may be from that of its loop; no clock of one is off by as much."""

KEEPS = "KEEPS ITS LAST COMMAND, switch it off: "
"""Of a device that was not brought to rest."""

REST_ATTEMPTS = 5
"""How often a device whose driver has failed is brought to rest, where that fails."""
REST_EVERY_S = 2e-3
LEAVE_S = 1.0
"""How long rest and close of a driver may take that another thread blocks."""

BRIDGE = Path(__file__).parents[1]
"""Whose lines led to an exception of a driver, and say nothing about what is wrong with the driver."""


class DeviceError(RuntimeError):
    """A driver raised an exception, which is its cause, or paces its loop by another period."""

    place = ""
    """File, line and function of the exception; they end the text."""

    @property
    def brief(self) -> str:
        """The text without the place."""
        return str(self).removesuffix(f" ({self.place})")


POINT_KINDS = ("linear", "joints")
"""Kinds of scenes that a driver can be in which does not say."""


def check_kind(device: object, kind: str) -> None:
    """Refuses a driver that cannot be in a scene of this kind.

    Raises:
        DeviceError: It cannot.
    """
    kinds: tuple[str, ...] = getattr(device, "kinds", POINT_KINDS)
    if kind not in kinds:
        message = (
            f'{type(device).__name__}: a driver of {" or ".join(kinds)}: must be of "{kind}", the kind of the scene;'
            " take a scene or a driver of the same"
        )
        raise DeviceError(message)


def check_trigger(device: object, *, is_felt: bool) -> Callable[[float], None] | None:
    """What exerts the force at the trigger, in a scene where the finger feels it.

    Raises:
        DeviceError: The driver has nothing that does.
    """
    if not is_felt:
        return None
    write: Callable[[float], None] | None = getattr(device, "write_trigger", None)
    if write is None:
        message = (
            f"{type(device).__name__}: has no write_trigger, for a trigger that the finger feels: leave"
            " [master.gripper] out of the scene, or take another driver"
        )
        raise DeviceError(message)
    return write


@dataclass
class DeviceNotes:
    """Faults of a device, and acknowledgements by the operator beside it."""

    fault: str | None = None
    """The last one that the device reported."""
    acknowledged_s: float | None = None
    """When the operator acknowledged it, by `time.monotonic`; none once the loop has passed that on to the device."""
    realtime: str = ""
    """What the loop's thread got of the system, once it has begun."""
    closing: threading.Lock = field(default_factory=threading.Lock)
    """Whoever gets it closes the device, and nobody else does."""
    come_to_rest: Callable[[], None] = lambda: None
    """Writes zero force, or stops an arm."""
    is_at_rest: bool = True
    """Whether the device took that last; false from `open` on."""

    def rest(self) -> bool:
        """Brings the device to rest, again where that fails; returns whether it took it."""
        for _ in range(REST_ATTEMPTS):
            try:
                self.come_to_rest()
            except BaseException:  # Ctrl-C and a driver's own exit, too: whoever leaves does so without force
                time.sleep(REST_EVERY_S)
            else:
                self.is_at_rest = True
                return True
        return False


@contextlib.contextmanager
def opened(
    device: "MasterDevice | SlaveDevice", notes: DeviceNotes, key: str, period_s: float | None
) -> Iterator[None]:
    """Within it the device is open; its thread has the scheduling of before again after it.

    Args:
        device: What is driven.
        notes: Of its loop.
        key: Of the scene, that has the period.
        period_s: Of the loop in s; none where it is not known.

    Raises:
        DeviceError: It could not be opened, paces the loop by another period, or cannot keep this one.
    """
    try:
        try:
            device.open()
        finally:
            # Whatever it did by then: what leaves it from here on brings it to rest first.
            notes.is_at_rest = False
        if notes.closing.locked():
            # It was closed while it was not open yet.
            notes.rest()
            with contextlib.suppress(Exception):
                device.close()
            message = "opened when nobody waited for it any more"
            raise TimeoutError(message)
        check_period(device, key, period_s)
        QUIET.settle()
    except BaseException as error:
        # What it had opened by then, nobody else closes.
        close_once(device, notes)
        if isinstance(error, DeviceError) or not isinstance(error, Exception):
            raise
        raise failure(device, error) from error
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        # The loop has requested real time for this thread, which is the caller's.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, *before)
        close_once(device, notes)


def attach_gripper(gripper: "Gripper", device: "SlaveDevice") -> None:
    """Tells a gripper at which arm it is, before either is open.

    Raises:
        DeviceError: It cannot be at this arm.
    """
    if (attach := getattr(gripper, "attach", None)) is None:
        return
    try:
        attach(device)
    except Exception as error:
        raise failure(gripper, error) from error


@contextlib.contextmanager
def opened_gripper(gripper: "Gripper | None", device: "SlaveDevice") -> Iterator[None]:
    """Within it the gripper is open, if there is one; whatever ends it, the gripper keeps its grip.

    Args:
        gripper: What is opened.
        device: The arm that it is at, on whose bus it may be.

    Raises:
        DeviceError: It could not be opened, or cannot be at this arm.
    """
    if gripper is None:
        yield
        return
    attach_gripper(gripper, device)
    try:
        gripper.open()
    except Exception as error:
        # What it had opened by then, nobody else closes.
        with contextlib.suppress(Exception):
            gripper.close()
        raise failure(gripper, error) from error
    try:
        yield
    finally:
        with contextlib.suppress(Exception):
            gripper.close()


def check_period(device: "MasterDevice | SlaveDevice", key: str, period_s: float | None) -> None:
    """Refuses a device that paces a loop by a period of its own: limits, filters and fades would all be of another.

    It also refuses a device whose bus takes longer than a period. Before a device is open its times may be None, which
    passes.

    Raises:
        DeviceError: With both periods and the remedy.
    """
    cycle_s: float | None = getattr(device, "cycle_s", None)
    if period_s is not None and cycle_s is not None and cycle_s > period_s:
        message = (
            f"{key} = {period_s:g}: a cycle on the bus of this device takes {1e3 * cycle_s:.3g} ms: must be at least "
            f"{cycle_s:.3g}; raise it, or the rate of the bus"
        )
        raise DeviceError(message)
    seen_s: float | None = getattr(device, "period_s", None)
    if period_s is None or seen_s is None or not device.paces:
        return
    if not abs(seen_s - period_s) <= PERIOD_SHARE * period_s:
        message = (
            f"{key} = {period_s:g}: {type(device).__name__} gives a sample each {seen_s:g} s and paces the loop: "
            f"set {key} = {seen_s:g}"
        )
        raise DeviceError(message)


def close_once(device: "MasterDevice | SlaveDevice", notes: DeviceNotes) -> None:
    """Brings it to rest, unless it is, and closes it, unless somebody does already."""
    if notes.closing.acquire(blocking=False):
        if not notes.is_at_rest:
            notes.rest()
        try:
            device.close()
        except Exception as error:  # nobody is left to whom it could be raised
            text = error.brief if isinstance(error, DeviceError) else f"{type(device).__name__}: {error}"
            print(f"not closed: {text}", file=sys.stderr, flush=True)


def leave_blocked(device: "MasterDevice | SlaveDevice", notes: DeviceNotes) -> None:
    """Leaves a driver one of whose methods does not return: rest and close, each on a thread of its own, for 1 s."""
    calls: tuple[Callable[[], object], ...] = (notes.rest, lambda: close_once(device, notes))
    for call in calls if not notes.is_at_rest else calls[1:]:
        beside = threading.Thread(target=call, name="haptether-leave", daemon=True)
        beside.start()
        beside.join(LEAVE_S)


def failure(device: object, error: BaseException, *, rests: bool = True) -> DeviceError:
    """An exception of a driver, with the driver's name and the line of it that led there.

    Args:
        device: What is driven; where its making failed, what was to make it.
        error: What the driver raised.
        rests: Whether the device was brought to rest nevertheless.
    """
    name, kind = getattr(device, "__name__", type(device).__name__), type(error).__name__
    try:
        text = str(error)
    except Exception:  # a driver's own class: the other side must learn of it all the same
        text = ""
    place = _place(device, error)
    failed = DeviceError(
        f"{name}: {'' if rests else KEEPS}{kind}" + (f": {text}" if text else "") + (f" ({place})" if place else "")
    )
    failed.place = place
    return failed


def fault_text(fault: object) -> str:
    """What a device says is wrong with it, as the loop can take it."""
    if not isinstance(fault, str):
        message = f"fault = {fault!r}: must be a text, or None"
        raise TypeError(message)
    return encodable(fault)


def encodable(text: str) -> str:
    """The text without what UTF-8 has not, as in names of files that are none."""
    return text.encode("utf-8", "backslashreplace").decode()


def _place(device: object, error: BaseException) -> str:
    """File, line and function of an exception: the innermost of the driver's own file, else of whatever it called."""
    module = getattr(device, "__module__", type(device).__module__)
    own = getattr(sys.modules.get(module), "__file__", None)
    steps = [(frame.f_code, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    steps = [(code, line) for code, line in steps if BRIDGE not in Path(code.co_filename).parents]
    if steps:
        code, line = next((step for step in reversed(steps) if step[0].co_filename == own), steps[-1])
    elif (read := getattr(getattr(type(device), "read", None), "__code__", None)) is not None:
        # The loop refused what `read` returned: this is where it was made.
        code, line = read, read.co_firstlineno
    else:
        return ""
    file = code.co_filename
    with contextlib.suppress(ValueError, OSError):
        file = min(file, os.path.relpath(file), key=len)
    return f"{file}:{line}, in {code.co_name}"
