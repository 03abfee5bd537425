"""Loop of a side with a Python driver: `read -> tick -> write -> wait`, one extension call per tick."""

import atexit
import contextlib
import gc
import threading
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, ClassVar

from haptether._core import LoopReport, MasterLoop, MasterTrace, SlaveLoop, SlaveTrace
from haptether.bridge.devices.open import (
    KEEPS,
    DeviceError,
    DeviceNotes,
    await_closed,
    check_kind,
    check_trigger,
    encodable,
    failure,
    fault_text,
    give_up,
    leave_blocked,
    opened,
    opened_gripper,
)
from haptether.bridge.interpreter import TUNING
from haptether.slave import GripperCommand

if TYPE_CHECKING:
    from haptether._core import _LiveSide
    from haptether.master import MasterDevice
    from haptether.slave import Gripper, SlaveDevice
else:
    _LiveSide = object

JOIN_S = 10.0
"""Time in s that the end of a run waits for a driver to begin its close."""
LOOK_S = 0.05
"""Interval in s of the check for a blocked driver call."""
PROMPT_S = 0.25
"""Longest valid age in s of an acknowledgement when the loop reads it."""
NO_WRENCH = ((0.0,) * 3,) * 2
GIVE_UP_S = 1.0
"""Time in s that a driver may still take to open its device after the run is given up."""


def drive_master(
    device: "MasterDevice", loop: MasterLoop, notes: DeviceNotes | None = None, *, period_s: float | None = None
) -> None:
    """Run the loop of a master with its device to the end.

    Opens the device here. At the end the device exerts no force and is closed.

    Args:
        device: Driver of the haptic device.
        loop: Loop in the extension.
        notes: Faults of the device, and acknowledgements by the operator beside it; by default new ones.
        period_s: Period of the scene's loop in s; an open device with another period is refused. By default any is
            accepted.

    Raises:
        DeviceError: The device has another period, or the driver raised an exception. The force was removed and the
            slave notified.
        OSError: Real time is required and refused.
    """
    notes = notes or DeviceNotes()
    check_kind(device, loop.kind)
    turns = loop.kind == "pose"
    write: Callable[..., None] = device.write
    write_trigger = check_trigger(device, is_felt=loop.trigger_force is not None)
    rest = NO_WRENCH if turns else ((0.0,) * loop.axes,)

    def step() -> bool:
        position, velocity, clutch, fault, trigger, orientation, angular_velocity, buttons, time_s = device.read()
        if fault is not None:
            notes.fault = fault = fault_text(fault)
        force = loop.step(
            position, velocity, clutch, fault=fault, trigger=trigger,
            orientation=orientation, angular_velocity=angular_velocity, buttons=buttons, time_s=time_s,
        )  # fmt: skip
        if force is None:
            return False
        if turns:
            write(*force)
        else:
            write(force)
        if write_trigger is not None:
            write_trigger(loop.trigger_force or 0.0)
        return True

    def come_to_rest() -> None:
        try:
            write(*rest)
        finally:
            if write_trigger is not None:
                write_trigger(0.0)

    notes.come_to_rest = come_to_rest
    with opened(device, notes, "[run] period_s", period_s):
        _drive(device, loop, notes, step)


def drive_slave(
    device: "SlaveDevice",
    loop: SlaveLoop,
    notes: DeviceNotes | None = None,
    *,
    period_s: float | None = None,
    gripper: "Gripper | None" = None,
) -> None:
    """Run the loop of a slave with its arm to the end.

    Opens arm and gripper here and closes both at the end. The arm is then stopped and the gripper keeps its grip. A
    gripper fault is a fault of this side.

    Args:
        device: Driver of the arm.
        loop: Loop in the extension.
        notes: As for `drive_master`.
        period_s: As for `drive_master`.
        gripper: Driver of the gripper; by default none.

    Raises:
        DeviceError: The device has another period, or the driver raised an exception. The arm was stopped and the
            master notified.
        OSError: Real time is required and refused.
    """
    notes = notes or DeviceNotes()
    check_kind(device, loop.kind)
    write: Callable[..., None] = device.write
    exert: Callable[..., None] = getattr(device, "write_force", _takes_no_force)
    before = "wait"
    jaws = None if gripper is None else LoopGripper(gripper)

    def step() -> bool:
        nonlocal before
        position, velocity, force, fault, orientation, angular_velocity, torque, time_s = device.read()
        if jaws is None:
            measured = None
        else:
            measured, wrong = jaws.read()
            fault = wrong if fault is None else fault
        if fault is not None:
            notes.fault = fault = fault_text(fault)
        order = loop.step(
            position, velocity, force, fault=fault, gripper=measured,
            orientation=orientation, angular_velocity=angular_velocity, torque=torque, time_s=time_s,
        )  # fmt: skip
        if order is None:
            return False
        kind, *command = order
        if kind == "move":
            write(*command)
        elif kind == "exert":
            exert(*command)
        elif kind == "stop" and before in {"move", "exert"}:
            device.stop()
        before = kind
        # Write the arm first, so that it has stopped whatever the gripper driver does.
        if jaws is not None:
            jaws.write(loop.gripper_command)
        return True

    def come_to_rest() -> None:
        try:
            device.stop()
        finally:
            # A gripper that fails to hold still keeps its grip, and is closed next.
            if gripper is not None:
                with contextlib.suppress(Exception):
                    gripper.hold()

    notes.come_to_rest = come_to_rest
    # Close the arm first, because a gripper driver may be slow.
    with opened_gripper(gripper, device), opened(device, notes, "[slave] period_s", period_s):
        _drive(device, loop, notes, step, gripper=gripper)


def _takes_no_force(*_: object) -> None:
    message = "has no `write_force`, and the scene has [slave] takes_force = true"
    raise TypeError(message)


class LoopGripper:
    """Gripper of an arm, as the loop reads and commands it."""

    def __init__(self, gripper: "Gripper") -> None:
        self._gripper = gripper
        self._moves = False

    def read(self) -> tuple[tuple[float, float, float, bool], str | None]:
        """Return position, velocity in 1/s, force in N and the object flag, and the gripper's fault."""
        try:
            sample = self._gripper.read()
        except Exception as error:
            raise failure(self._gripper, error) from error
        fault = None if sample.fault is None else f"gripper: {sample.fault}"
        return (sample.position, sample.velocity, sample.force_n, sample.holds_object), fault

    def write(self, command: tuple[float, float, float] | None) -> None:
        """Command position, speed in 1/s and force in N; with None the gripper keeps its grip."""
        try:
            if command is not None:
                position, speed, force_n = command
                self._gripper.write(GripperCommand(position=position, speed=speed, force_n=force_n))
            elif self._moves:
                self._gripper.hold()
        except Exception as error:
            raise failure(self._gripper, error) from error
        self._moves = command is not None


def _drive(
    device: "MasterDevice | SlaveDevice",
    loop: MasterLoop | SlaveLoop,
    notes: DeviceNotes,
    step: Callable[[], bool],
    *,
    gripper: "Gripper | None" = None,
) -> None:
    """Step an open device until `step` reports the end; bring the device to rest in every case."""
    name = type(device).__name__
    realtime = loop.begin(name if gripper is None else f"{name} or {type(gripper).__name__}")
    TUNING.prioritise()
    notes.realtime = realtime
    wait = None if device.paces else loop.wait
    try:
        # A run that was stopped while its device opened does not read it: the first read may give an arm its torque.
        while not loop.finished:
            if loop.take_acknowledgement():
                # Acknowledged through the control socket.
                notes.acknowledged_s = time.monotonic()
            if notes.acknowledged_s is not None:
                _acknowledge(device, loop, notes, notes.acknowledged_s, gripper)
            if not step():
                break
            if wait is not None:
                wait()
        notes.come_to_rest()
        notes.is_at_rest = True
        loop.announce_end()
    except BaseException as error:
        # Applies to Ctrl-C too: first the device, then the peer.
        rests = notes.rest()
        if not isinstance(error, Exception):
            loop.fail(f"{type(device).__name__}: {'' if rests else KEEPS}{type(error).__name__}")
            if not rests:
                error.add_note(KEEPS)
            raise
        if isinstance(error, DeviceError) and rests:
            # Error of the gripper, which the message names.
            loop.fail(encodable(str(error)))
            raise
        failed = failure(device, error, rests=rests)
        loop.fail(encodable(str(failed)))
        raise failed from error


def _acknowledge(
    device: "MasterDevice | SlaveDevice",
    loop: MasterLoop | SlaveLoop,
    notes: DeviceNotes,
    acknowledged_s: float,
    gripper: "Gripper | None",
) -> None:
    notes.acknowledged_s = None
    if time.monotonic() - acknowledged_s > PROMPT_S:
        return
    notes.fault = None
    for mended in (device, gripper):
        if (mend := getattr(mended, "acknowledge", None)) is not None:
            mend()
    # A loop that has ended has nothing to acknowledge.
    with contextlib.suppress(RuntimeError):
        loop.acknowledge()


class DeviceRun(_LiveSide):
    """Loop and device on a separate thread, with the interface of `LiveMaster` and `LiveSlave`.

    Args:
        device: Driver of the device.
        loop: Loop in the extension.
        drive: Runs the loop with the device to its end, and fills in the notes.
    """

    _FROM_LOOP: ClassVar = frozenset(
        {
            "address",
            "cause",
            "flight",
            "ineffective_presses",
            "is_answered",
            "kind",
            "recording",
            "security_events",
            "start_is_void",
            "state",
            "ticks",
        }
    )
    """Attributes forwarded to the loop for users of `LiveMaster` or `LiveSlave`."""

    def __init__(
        self,
        device: "MasterDevice | SlaveDevice",
        loop: MasterLoop | SlaveLoop,
        drive: Callable[[DeviceNotes], None],
    ) -> None:
        self.notes = DeviceNotes()
        self.error: Exception | None = None
        """Exception that ended the loop, or None."""
        self._device = device
        self._loop = loop
        self._drive = drive
        self._thread = threading.Thread(target=self._run, name="haptether-loop", daemon=True)
        # Garbage collection would run on any thread that allocates, including the loop; `poll` collects the young
        # generation instead.
        TUNING.begin()
        self._quieted = threading.Lock()
        # At process exit, bring the device to rest before its thread is killed.
        atexit.register(self._leave)
        self._thread.start()

    def _leave(self) -> None:
        """End the loop; if the driver blocks, other threads bring the device to rest and close it."""
        self._loop.stop()
        end_s = time.monotonic() + JOIN_S
        while self._thread.is_alive() and time.monotonic() < end_s and not self._loop.is_blocked:
            self._thread.join(LOOK_S)
        await_closed(self._thread, self._device, self.notes)
        if self._thread.is_alive():
            leave_blocked(self._device, self.notes)

    def _run(self) -> None:
        try:
            self._drive(self.notes)
        except Exception as error:  # raised by the reader at the end of the run
            self.error = error
        except BaseException as error:  # a driver's own KeyboardInterrupt or SystemExit, which nothing else catches
            self.error = failure(self._device, error, rests=KEEPS not in getattr(error, "__notes__", ()))
        finally:
            self._loop.stop()
            self._unquiet()

    if not TYPE_CHECKING:  # otherwise a type checker would accept any name

        def __getattr__(self, name: str) -> object:
            if name in self._FROM_LOOP:
                return getattr(self._loop, name)
            message = f"{type(self).__name__!r} object has no attribute {name!r}"
            raise AttributeError(message, name=name, obj=self)

    def ready(self) -> bool:
        """True if the device is open and its loop runs, or the loop has ended."""
        return bool(self.notes.realtime) or self.finished

    def poll(self) -> int:
        """Collect the young generation and return the number of ticks in the trace."""
        gc.collect(0)
        return self._loop.poll()

    @property
    def finished(self) -> bool:
        """True if the loop has ended, even if its driver has not returned."""
        return not self._thread.is_alive() or (self._loop.finished and self._loop.is_blocked)

    @property
    def realtime(self) -> str:
        """Real-time settings that the system granted to the loop thread; empty until the device is open."""
        return self.notes.realtime

    def acknowledge(self) -> None:
        """Acknowledge that the fault is fixed; release and press the clutch next. Expires after 0.25 s."""
        self.notes.acknowledged_s = time.monotonic()

    def stop(self) -> None:
        """Request the loop to end after its current tick."""
        self._loop.stop()

    def give_up(self) -> None:
        """End a run whose device does not open; if `open` does not return within 1 s, close the device here.

        A device that opened meanwhile is closed by its loop, which gets the time for that.
        """
        self._loop.stop()
        give_up(self._device)
        self._thread.join(GIVE_UP_S)
        await_closed(self._thread, self._device, self.notes)
        atexit.unregister(self._leave)
        if self._thread.is_alive():
            leave_blocked(self._device, self.notes)
            # An `open` that its close has ended returns at once.
            self._thread.join(GIVE_UP_S)
        self._unquiet()

    def _unquiet(self) -> None:
        # Executed once: at the end of the run, or when the run is given up.
        if self._quieted.acquire(blocking=False):
            TUNING.end()

    def _end(self) -> None:
        self._leave()
        atexit.unregister(self._leave)
        self._unquiet()
        if self._thread.is_alive():
            kept = "" if self.notes.is_at_rest else KEEPS
            self.error = DeviceError(f"{type(self._device).__name__}: {kept}the driver has not returned")


class MasterRun(DeviceRun):
    """Master and its device on a separate thread; arguments as for `drive_master`."""

    def __init__(self, device: "MasterDevice", loop: MasterLoop, *, period_s: float | None = None) -> None:
        super().__init__(device, loop, lambda notes: drive_master(device, loop, notes, period_s=period_s))
        self._master = loop

    def press_clutch(self) -> None:
        """Release the clutch for 0.1 s and press it again at the operator's command; void if read late."""
        self._master.press_clutch()

    def finish(self) -> tuple[MasterTrace, LoopReport]:
        """End the loop and return all ticks and its report; `error` holds the exception that ended it, if any.

        Raises:
            RuntimeError: The run was already finished.
        """
        self._end()
        return self._master.finish()


class SlaveRun(DeviceRun):
    """Slave and its arm on a separate thread; arguments as for `drive_slave`."""

    def __init__(
        self,
        device: "SlaveDevice",
        loop: SlaveLoop,
        *,
        period_s: float | None = None,
        gripper: "Gripper | None" = None,
    ) -> None:
        # Set before the loop starts on its thread.
        self._gripper = gripper
        super().__init__(
            device, loop, lambda notes: drive_slave(device, loop, notes, period_s=period_s, gripper=gripper)
        )
        self._slave = loop

    def give_up(self) -> None:
        """Give up as for any device; close a gripper first while it opens, which ends an activation."""
        if self._gripper is not None:
            with contextlib.suppress(Exception):
                self._gripper.close()
        super().give_up()

    def allow_takeover(self) -> None:
        """Allow another master to begin after 2 s of silence of the previous one, at the slave operator's command."""
        self._slave.allow_takeover()

    def finish(self) -> tuple[SlaveTrace, LoopReport]:
        """End the loop and return all ticks and its report; `error` holds the exception that ended it, if any.

        Raises:
            RuntimeError: The run was already finished.
        """
        self._end()
        return self._slave.finish()
