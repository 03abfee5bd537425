"""Driver of a Force Dimension device: `force-dimension`."""

import contextlib
import math
import time
from collections.abc import Sequence
from typing import Any, Final

from haptether.checklist import Checklist
from haptether.master.device import MasterSample
from haptether.master.force_dimension.checks import Abilities, examined, opened, status_fault
from haptether.master.force_dimension.library import (
    FUNCTIONS,
    NOT_ENABLED,
    ON,
    TIMEOUT,
    VENDOR,
    Dhd,
    DhdError,
)
from haptether.master.force_dimension.options import ForceDimensionOptions, force_dimension_options
from haptether.master.frame import REST, Vector, clipped, quaternion
from haptether.master.vendor import BadSampleError, LostError, VendorDevice, load_library

STATUS_EVERY: Final = 4
"""Interval of status checks in samples."""
OLD: Final = 20
"""Number of consecutive samples marked old by the SDK that is a fault."""
FARTHEST_M: Final = 1.0
"""Upper bound in m of the reach of any device."""
GAP_S: Final = 0.002
"""Time in s between two positions, which the SDK needs for a velocity."""


class Session:
    """Open device, and whether its forces are on."""

    def __init__(self, device: Dhd, found: Abilities) -> None:
        self.device = device
        self.found = found
        self.exerts = False
        self.samples = 0
        self.old = 0
        self.force: Vector = REST
        """Last exerted force, with its torque, in the device frame."""
        self.torque: Vector = REST


class ForceDimension(VendorDevice[Session]):
    """Omega, delta or sigma device; see `MasterDevice` and docs/haptic_devices.md.

    Forces are off and the motors brake from `open` to the first `write`, and from a fault to the first `write` after
    its acknowledgement. While forces are on, the controller's watchdog is armed.

    Args:
        options: Fields of `ForceDimensionOptions`.

    Raises:
        ValueError: The options are invalid. `open` also raises `RefusedError` if the device is not ready.
    """

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: ForceDimensionOptions = force_dimension_options(options)
        super().__init__("force-dimension", len(self.options.axes), turns=self.options.wrist)
        self.kinds: tuple[str, ...] = ("linear", "pose") if self.options.wrist else ("linear",)
        self.exerts_by_itself = self.options.gravity_compensation
        """The SDK adds gravity compensation to every force, including zero."""
        self._frame = self.options.frame
        self._trigger_n = 0.0
        if self.options.gripper_open_m is not None:
            self.write_trigger = self._write_trigger

    def _connect(self, checklist: Checklist) -> Session:
        library = load_library(VENDOR, self.options.library, FUNCTIONS, checklist)
        library.dhdEnableExpertMode()
        device = opened(library, self.options, checklist)
        try:
            session = Session(device, examined(device, self.options, checklist))
            if self.options.device_velocity:
                device.position()
                time.sleep(GAP_S)
                device.position()
        except DhdError as error:
            _close(device)
            checklist.refuse("device", str(error), error.remedy)
            checklist.finish()
            raise
        except BaseException:
            _close(device)
            raise
        self._trigger_n = 0.0
        return session

    def _measure(self, session: Session) -> MasterSample:
        device, options = session.device, self.options
        try:
            turned = velocity = trigger = None
            if options.wrist:
                fresh, point, matrix = device.pose()
                turned = self._frame.orientation(quaternion(matrix))
            else:
                fresh, point = device.position()
            if options.device_velocity:
                velocity = self._frame.vector(_finite("velocity", device.velocity()))
            if options.gripper_open_m is not None:
                (gap,) = _finite("gripper", [device.gripper_gap()])
                share = (options.gripper_open_m - gap) / (options.gripper_open_m - options.gripper_closed_m)
                trigger = min(max(share, 0.0), 1.0)
            buttons = device.buttons()
            status = device.status() if session.samples % STATUS_EVERY == 0 else None
        except DhdError as error:
            raise _failed(error) from None
        except ValueError as error:
            message = f"malformed sample: {error}: acknowledge"
            raise BadSampleError(message) from None
        session.samples += 1
        session.old = 0 if fresh else session.old + 1
        wrong = None if status is None else status_fault(status, exerts=session.exerts)
        if session.old >= OLD:
            wrong = f"no new position: {OLD} in a row were old: see its USB cable, acknowledge"
        if not all(abs(part) <= FARTHEST_M for part in point):
            wrong = f"malformed sample: position {point}: must be within {FARTHEST_M:g} m: acknowledge"
        if wrong is not None:
            raise BadSampleError(wrong)
        return MasterSample(self._frame.position(point), velocity, None, None, trigger, turned, None, buttons)

    def _exert(self, session: Session, force: Sequence[float], torque: Sequence[float]) -> None:
        found = session.found
        session.force = _three(clipped(self._frame.to_device(force), found.max_force_n))
        session.torque = REST
        if found.active_wrist and self.options.wrist:
            session.torque = _three(clipped(self._frame.to_device(torque), found.max_torque_n_m))
        begins, session.exerts = not session.exerts, True
        try:
            if begins:
                session.device.call("dhdEnableForce", ON)
            self._send(session)
            if begins and found.watchdog:
                session.device.call("dhdSetWatchdog", self.options.watchdog_steps)
        except DhdError as error:
            raise self._refused(session, error) from None

    @staticmethod
    def _refused(session: Session, error: DhdError) -> LostError | BadSampleError:
        """Return the error for a refused force; the status says why forces are off."""
        if error.number == NOT_ENABLED:
            with contextlib.suppress(DhdError):
                fault = status_fault(session.device.status(), exerts=True)
                if fault is not None:
                    return BadSampleError(fault)
        return _failed(error)

    def _write_trigger(self, force_n: float) -> None:
        """Set the finger force in N, positive closing; applied with the next `write`, zero at once."""
        before, self._trigger_n = self._trigger_n, force_n if math.isfinite(force_n) else 0.0
        session = self._session
        if self._trigger_n == 0.0 and before != 0.0 and session is not None and session.exerts and self._fault is None:
            try:
                self._send(session)
            except DhdError as error:
                failed = self._refused(session, error)
                (self._lose if isinstance(failed, LostError) else self._latch)(str(failed))

    def _send(self, session: Session) -> None:
        found = session.found
        if not found.has_wrench:
            session.device.set_force(session.force)
            return
        most = found.max_gripper_force_n
        gripper_n = self.options.gripper_sign * min(max(self._trigger_n, -most), most) if found.gripper else 0.0
        session.device.set_wrench(session.force, session.torque, gripper_n)

    def _halt(self, session: Session) -> None:
        self._trigger_n = 0.0
        session.force = session.torque = REST
        if session.exerts:
            session.exerts = not _stop(session.device, watchdog=session.found.watchdog)

    def _release(self, session: Session) -> None:
        self._trigger_n = 0.0
        session.force = session.torque = REST
        with contextlib.suppress(Exception):
            if session.exerts:
                self._send(session)
        session.exerts = False
        _close(session.device, watchdog=session.found.watchdog)


def _stop(device: Dhd, *, watchdog: bool) -> bool:
    """End all force; the motors brake, so that the device does not fall. Return True if the device accepted it."""
    try:
        device.call("dhdStop")
    except DhdError:
        # The watchdog stays armed and ends the force instead.
        return False
    if watchdog:
        with contextlib.suppress(DhdError):
            device.call("dhdSetWatchdog", 0)
    return True


def _close(device: Dhd, *, watchdog: bool = False) -> None:
    with contextlib.suppress(Exception):
        _stop(device, watchdog=watchdog)
    with contextlib.suppress(DhdError):
        device.call("dhdClose")


def _failed(error: DhdError) -> LostError | BadSampleError:
    text = f"{error}: {error.remedy}"
    # After a late answer, or forces switched off at the device, the connection is still valid.
    return BadSampleError(f"{text}, acknowledge") if error.number in {TIMEOUT, NOT_ENABLED} else LostError(text)


def _finite(name: str, values: list[float]) -> list[float]:
    if not all(map(math.isfinite, values)):
        message = f"{name} {values}: must be finite"
        raise ValueError(message)
    return values


def _three(vector: Sequence[float]) -> Vector:
    x, y, z = vector
    return x, y, z
