"""Opening, checking and closing the device of a loop."""

import contextlib
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from decimal import ROUND_CEILING, Context
from pathlib import Path
from typing import TYPE_CHECKING

from haptether.bridge.interpreter import TUNING

if TYPE_CHECKING:
    from haptether.master import MasterDevice
    from haptether.slave import Gripper, SlaveDevice

PERIOD_SHARE = 0.01
"""Allowed relative difference between the period of a device and of its loop; larger than any clock error."""

KEEPS = "KEEPS ITS LAST COMMAND, switch it off: "
"""Message prefix for a device that was not brought to rest."""

REST_ATTEMPTS = 5
"""Number of attempts to bring a device to rest after its driver failed."""
REST_EVERY_S = 2e-3
LEAVE_S = 1.0
"""Time in s that rest and close may take if another thread blocks the driver; close also gets its `close_s`."""
CLOSE_S = 5.0
"""Time in s that a driver may take to close, beyond its `close_s`."""

BRIDGE = Path(__file__).parents[1]
"""Source folder whose lines are skipped when a driver exception is located."""


class DeviceError(RuntimeError):
    """Exception of a driver, stored as the cause, or a loop period that does not match the device."""

    place = ""
    """File, line and function of the exception; the text ends with them."""

    @property
    def brief(self) -> str:
        """Text without the location."""
        return str(self).removesuffix(f" ({self.place})")


POINT_KINDS = ("linear", "joints")
"""Default kinds of scenes for a driver that declares none."""


def check_kind(device: object, kind: str) -> None:
    """Refuse a driver that does not support this kind of scene.

    Raises:
        DeviceError: The driver does not support the kind.
    """
    kinds: tuple[str, ...] = getattr(device, "kinds", POINT_KINDS)
    if kind not in kinds:
        message = (
            f'{type(device).__name__}: a driver of {" or ".join(kinds)}: must be of "{kind}", the kind of the scene;'
            " take a scene or a driver of the same"
        )
        raise DeviceError(message)


def check_force(device: object, *, takes_force: bool) -> None:
    """Refuse a driver that does not take forces, for a scene whose arm does.

    Raises:
        DeviceError: The driver takes motions only.
    """
    name = type(device).__name__
    if getattr(device, "takes_force", False) is True and not callable(getattr(device, "write_force", None)):
        message = (
            f"{name}: takes_force = True, and no write_force: a driver of such an arm has both (docs/new_device.md)"
        )
        raise DeviceError(message)
    if takes_force and getattr(device, "takes_force", False) is not True:
        message = (
            f"[slave] takes_force = true: {name} takes only motions with these options: set mode to that for forces"
            " (dynamixel: current, ur: direct-torque), add takes_force and write_force to a driver of your own, or set"
            " takes_force = false"
        )
        raise DeviceError(message)


def check_trigger(device: object, *, is_felt: bool) -> Callable[[float], None] | None:
    """Return the method that exerts the trigger force, if the finger feels it in this scene.

    Raises:
        DeviceError: The driver has no such method.
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
    """Latest fault that the device reported."""
    acknowledged_s: float | None = None
    """Time of the operator's acknowledgement by `time.monotonic`; None after the loop has passed it to the device."""
    realtime: str = ""
    """Real-time settings granted to the loop thread, once it has begun."""
    closing: threading.Lock = field(default_factory=threading.Lock)
    """Lock taken by the one thread that closes the device."""
    come_to_rest: Callable[[], None] = lambda: None
    """Write zero force, or stop an arm."""
    is_at_rest: bool = True
    """True if the device accepted the last rest command; False from `open` on."""

    def rest(self) -> bool:
        """Bring the device to rest, with retries; return True on success."""
        for _ in range(REST_ATTEMPTS):
            try:
                self.come_to_rest()
            except BaseException:  # Ctrl-C and a driver's own exit must also remove the force
                time.sleep(REST_EVERY_S)
            else:
                self.is_at_rest = True
                return True
        return False


@contextlib.contextmanager
def opened(
    device: "MasterDevice | SlaveDevice", notes: DeviceNotes, key: str, period_s: float | None
) -> Iterator[None]:
    """Keep the device open inside the context; afterwards restore the scheduling of the thread.

    Args:
        device: Driver to open.
        notes: Notes of its loop.
        key: Scene key of the period.
        period_s: Loop period in s, or None if unknown.

    Raises:
        DeviceError: The device did not open, paces the loop by another period, or cannot keep this period.
    """
    try:
        try:
            device.open()
        finally:
            # `open` may have failed halfway; from here on every exit brings the device to rest first.
            notes.is_at_rest = False
        if notes.closing.locked():
            # Another thread closed the device before it was open.
            notes.rest()
            with contextlib.suppress(Exception):
                device.close()
            message = "opened when nobody waited for it any more"
            raise TimeoutError(message)
        check_period(device, key, period_s)
        TUNING.settle()
    except BaseException as error:
        # Close here the parts that a failed `open` had opened.
        close_once(device, notes)
        if isinstance(error, DeviceError) or not isinstance(error, Exception):
            raise
        raise failure(device, error) from error
    before = os.sched_getscheduler(0), os.sched_getparam(0)
    try:
        yield
    finally:
        # The loop requested real time for this thread, which belongs to the caller.
        with contextlib.suppress(OSError):
            os.sched_setscheduler(0, *before)
        close_once(device, notes)


def attach_gripper(gripper: "Gripper", device: "SlaveDevice") -> None:
    """Tell a gripper its arm, before either is open.

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
    """Keep the gripper, if any, open inside the context; it keeps its grip however the context ends.

    Args:
        gripper: Gripper to open, or None.
        device: Arm of the gripper; both may share a bus.

    Raises:
        DeviceError: The gripper did not open, or does not fit this arm.
    """
    if gripper is None:
        yield
        return
    attach_gripper(gripper, device)
    try:
        gripper.open()
    except Exception as error:
        # Close here the parts that a failed `open` had opened.
        with contextlib.suppress(Exception):
            gripper.close()
        raise failure(gripper, error) from error
    try:
        yield
    finally:
        with contextlib.suppress(Exception):
            gripper.close()


def check_period(device: "MasterDevice | SlaveDevice", key: str, period_s: float | None) -> None:
    """Refuse a device that paces a loop by a period of its own: limits, filters and fades would all be of another.

    It also refuses a device whose bus takes longer than a period. Before a device is open its times may be None, which
    passes.

    Raises:
        DeviceError: Gives both periods and the remedy.
    """
    cycle_s: float | None = getattr(device, "cycle_s", None)
    if period_s is not None and cycle_s is not None and cycle_s > period_s:
        least_s = rounded_up(cycle_s)
        message = (
            f"{key} = {period_s:g}: a cycle on the bus of this device takes {1e3 * least_s:g} ms: must be at least "
            f"{least_s:g}; raise it, or the rate of the bus"
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


def rounded_up(seconds: float) -> float:
    """Return a number of three digits that is not below the given one."""
    return float(Context(prec=3, rounding=ROUND_CEILING).create_decimal(repr(float(seconds))))


def close_once(device: "MasterDevice | SlaveDevice", notes: DeviceNotes) -> None:
    """Bring the device to rest if needed, and close it unless another thread does."""
    if notes.closing.acquire(blocking=False):
        if not notes.is_at_rest:
            notes.rest()
        try:
            device.close()
        except Exception as error:  # no caller is left to handle it
            text = error.brief if isinstance(error, DeviceError) else f"{type(device).__name__}: {error}"
            print(f"not closed: {text}", file=sys.stderr, flush=True)


def lowering_s(device: object) -> float:
    """Return the time in s for which `close` lowers an arm by the driver's own `close_s`; 0 without it."""
    seconds: float | None = getattr(device, "close_s", None)
    return seconds or 0.0


def await_closed(thread: threading.Thread, device: object, notes: DeviceNotes) -> None:
    """Wait for a loop thread that closes its device: it may take its `close_s` and 5 s, but it may also hang."""
    if thread.is_alive() and notes.closing.locked():
        thread.join(CLOSE_S + lowering_s(device))


def give_up(device: object) -> None:
    """Tell a device that opens to raise an exception soon; a driver without `give_up` is waited for."""
    if callable(method := getattr(device, "give_up", None)):
        # The caller ends the device however it fails.
        with contextlib.suppress(Exception):
            method()


def leave_blocked(device: "MasterDevice | SlaveDevice", notes: DeviceNotes) -> None:
    """Leave a driver with a blocked method: rest and close run on separate threads, for 1 s and what close needs."""
    calls: tuple[tuple[Callable[[], object], float], ...] = (
        (notes.rest, LEAVE_S),
        (lambda: close_once(device, notes), LEAVE_S + lowering_s(device)),
    )
    for call, limit_s in calls if not notes.is_at_rest else calls[1:]:
        beside = threading.Thread(target=call, name="haptether-leave", daemon=True)
        beside.start()
        beside.join(limit_s)


def failure(device: object, error: BaseException, *, rests: bool = True) -> DeviceError:
    """Return an exception of a driver with the driver's name and the source line.

    Args:
        device: Driver, or its factory if construction failed.
        error: Exception that the driver raised.
        rests: True if the device was brought to rest nevertheless.
    """
    name, kind = getattr(device, "__name__", type(device).__name__), type(error).__name__
    try:
        text = str(error)
    except Exception:  # a driver's own class may fail to format; the peer must still be notified
        text = ""
    place = _place(device, error)
    failed = DeviceError(
        f"{name}: {'' if rests else KEEPS}{kind}" + (f": {text}" if text else "") + (f" ({place})" if place else "")
    )
    failed.place = place
    return failed


def fault_text(fault: object) -> str:
    """Return the fault text of a device in the form that the loop accepts."""
    if not isinstance(fault, str):
        message = f"fault = {fault!r}: must be a text, or None"
        raise TypeError(message)
    return encodable(fault)


def encodable(text: str) -> str:
    """Replace characters that UTF-8 cannot encode, for example in invalid file names."""
    return text.encode("utf-8", "backslashreplace").decode()


def _place(device: object, error: BaseException) -> str:
    """Return file, line and function of an exception: innermost in the driver's own file, else in the code it calls."""
    module = getattr(device, "__module__", type(device).__module__)
    own = getattr(sys.modules.get(module), "__file__", None)
    steps = [(frame.f_code, line) for frame, line in traceback.walk_tb(error.__traceback__)]
    steps = [(code, line) for code, line in steps if BRIDGE not in Path(code.co_filename).parents]
    if steps:
        code, line = next((step for step in reversed(steps) if step[0].co_filename == own), steps[-1])
    elif (read := getattr(getattr(type(device), "read", None), "__code__", None)) is not None:
        # The loop rejected the return value of `read`, so point to `read`.
        code, line = read, read.co_firstlineno
    else:
        return ""
    file = code.co_filename
    with contextlib.suppress(ValueError, OSError):
        file = min(file, os.path.relpath(file), key=len)
    return f"{file}:{line}, in {code.co_name}"
