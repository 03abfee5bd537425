"""Driver of a 3D Systems Touch: `touch`."""

import contextlib
import math
import sys
import time
from collections.abc import Sequence
from ctypes import CDLL
from typing import Any, Final, NamedTuple

from haptether._core import HdCallback
from haptether.checklist import Checklist
from haptether.master.device import MasterSample
from haptether.master.frame import REST, clipped, quaternion
from haptether.master.touch.checks import INKWELL, check_frames, examined, initialised
from haptether.master.touch.library import (
    CALIBRATION_NEEDS_HAND,
    FORCE_OUTPUT,
    FUNCTIONS,
    LOST,
    MAX_FORCE_CLAMPING,
    PRIORITY,
    VENDOR,
    error_text,
    first_error,
    frame_callback,
)
from haptether.master.touch.options import TouchOptions, touch_options
from haptether.master.vendor import BadSampleError, LostError, VendorDevice, load_library

MM: Final = 1e-3
END_S: Final = 0.1
"""Timeout in s of the last frame, with zero force."""
LOST_S: Final = 0.5
"""Time in s without a frame after which the scheduler counts as stopped."""
FARTHEST_M: Final = 1.0
"""Upper bound in m of the reach of any device."""


class Session(NamedTuple):
    """Device on the vendor's scheduler."""

    library: CDLL
    handle: int
    callback: HdCallback
    scheduled: int
    max_force_n: float


class Touch(VendorDevice[Session]):
    """Touch whose scheduler paces the loop; see `MasterDevice` and docs/haptic_devices.md.

    The vendor's thread calls `HdCallback`, which never waits for Python. It exerts the latest force, or zero if that is
    older than `watchdog_s`.

    Args:
        options: Fields of `TouchOptions`.

    Raises:
        ValueError: The options are invalid. `open` also raises `RefusedError` if the device is not ready.
    """

    paces = True

    def __init__(self, **options: Any) -> None:  # noqa: ANN401  # what a scene has
        self.options: TouchOptions = touch_options(options)
        super().__init__("touch", len(self.options.axes), turns=self.options.orientation)
        self.kinds: tuple[str, ...] = ("linear", "pose") if self.options.orientation else ("linear",)
        self._frame = self.options.frame
        self._tick = 0
        """Tick of the latest sample."""
        self._seen_s = 0.0
        self.starved_ticks = 0
        """Frames without force because this process provided none in time."""

    def _connect(self, checklist: Checklist) -> Session:
        library = load_library(VENDOR, self.options.library, FUNCTIONS, checklist)
        handle = initialised(library, self.options, checklist)
        callback = scheduled = None
        try:
            library.hdMakeCurrentDevice(handle)
            max_force_n, rate_hz = examined(library, self.options, checklist)
            callback = frame_callback(
                library, handle, watchdog_s=self.options.watchdog_s, max_force_n=max_force_n
            )  # fmt: skip
            library.hdEnable(FORCE_OUTPUT)
            library.hdEnable(MAX_FORCE_CLAMPING)
            scheduled = library.hdScheduleAsynchronous(callback.address, callback.context, PRIORITY)
            library.hdStartScheduler()
            error = first_error(library)
            if error is not None:
                what, _, remedy = error_text(*error).partition(": ")
                checklist.refuse("scheduler", what, remedy)
                checklist.finish()
            tick = check_frames(callback, rate_hz, checklist)
        except BaseException:
            _close(library, handle, callback, scheduled)
            raise
        checklist.ok("limit", f"{max_force_n:g} N, and none {1e3 * self.options.watchdog_s:g} ms after the last force")
        self.period_s = 1.0 / rate_hz
        self._tick, self._seen_s = tick, time.monotonic()
        return Session(library, handle, callback, scheduled, max_force_n)

    def _measure(self, session: Session) -> MasterSample:
        found = session.callback.wait(self._tick, self.options.sample_timeout_s)
        now_s = time.monotonic()
        if found is None:
            why = f"no frame of the vendor's scheduler within {self.options.sample_timeout_s:g} s"
            if now_s - self._seen_s > LOST_S:
                message = f"{why}, since {LOST_S:g} s"
                raise LostError(message)
            message = f"{why}: is this machine overloaded? acknowledge"
            raise BadSampleError(message)
        self._tick, transform, velocity, buttons, calibration, error, internal = found
        self._seen_s = now_s
        if error:
            wrong = error_text(error, internal)
            if error in LOST:
                raise LostError(wrong)
            message = f"{wrong}, acknowledge"
            raise BadSampleError(message)
        if calibration == CALIBRATION_NEEDS_HAND:
            message = f"not calibrated: {INKWELL}, acknowledge"
            raise BadSampleError(message)
        # Column-major: axes of the stylus, then its position.
        point = [MM * part for part in transform[12:15]]
        if not all(abs(part) <= FARTHEST_M for part in point) or not all(map(math.isfinite, velocity)):
            message = f"malformed sample: position {point}, velocity {velocity}: acknowledge"
            raise BadSampleError(message)
        turned = None
        if self.options.orientation:
            rows = [[transform[4 * column + row] for column in range(3)] for row in range(3)]
            try:
                turned = self._frame.orientation(quaternion(rows))
            except ValueError as wrong_orientation:
                message = f"malformed sample: {wrong_orientation}: acknowledge"
                raise BadSampleError(message) from None
        speed = self._frame.vector([MM * part for part in velocity]) if self.options.device_velocity else None
        return MasterSample(self._frame.position(point), speed, None, None, None, turned, None, buttons)

    def _exert(self, session: Session, force: Sequence[float], torque: Sequence[float]) -> None:  # noqa: ARG002
        # No motor turns the stylus.
        x, y, z = clipped(self._frame.to_device(force), session.max_force_n)
        session.callback.write((x, y, z))

    def _halt(self, session: Session) -> None:
        session.callback.write(REST)

    def _clear(self, session: Session) -> None:
        session.callback.acknowledge()

    def _release(self, session: Session) -> None:
        session.callback.write(REST)
        _close(session.library, session.handle, session.callback, session.scheduled)
        self.starved_ticks += session.callback.starved
        if session.callback.starved:
            ticks = session.callback.starved
            print(f"{self.name}: {ticks} frames without force: none came in time", file=sys.stderr, flush=True)


def _close(library: CDLL, handle: int, callback: HdCallback | None, scheduled: int | None) -> None:
    """End force and scheduler and close the device; each step runs even if an earlier one fails."""
    with contextlib.ExitStack() as steps:
        # Callbacks run in reverse order.
        steps.callback(first_error, library)
        steps.callback(library.hdDisableDevice, handle)
        steps.callback(library.hdDisable, FORCE_OUTPUT)
        steps.callback(library.hdMakeCurrentDevice, handle)
        if callback is not None and scheduled is not None:
            steps.callback(library.hdStopScheduler)
            steps.callback(library.hdUnschedule, scheduled)
            # Wait for the last frame, if any.
            steps.callback(callback.end, END_S)
