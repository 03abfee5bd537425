"""Checklist before a Touch exerts a force."""

import time
from ctypes import CDLL
from typing import Final

from haptether._core import HdCallback
from haptether.checklist import Checklist
from haptether.master.touch.library import (
    CALIBRATED,
    CALIBRATION_NEEDS_HAND,
    CALIBRATION_NEEDS_UPDATE,
    CALIBRATION_STYLE,
    CONTINUOUS_FORCE,
    ENCODER_RESET,
    INVALID_HANDLE,
    MAX_FORCE,
    MODEL,
    OUTPUT_AXES,
    SERIAL_NUMBER,
    UPDATE_RATE,
    VENDOR_NAME,
    double,
    error_text,
    first_error,
    integer,
    text,
)
from haptether.master.touch.options import TouchOptions

INKWELL: Final = "put the stylus into the inkwell for 3 s, take it out, and see Touch_Diagnostic"
RATES: Final = range(400, 4001)
"""Possible scheduler rates in Hz."""
LOOKED_S: Final = 0.2
"""Duration in s of a rate measurement."""
LOOKS: Final = 5
"""Number of measurements, in case another process takes the processor."""
RATE_SHARE: Final = 0.25
"""Allowed relative deviation; the next scheduler rate is farther away."""
FIRST_S: Final = 2.0


def initialised(library: CDLL, options: TouchOptions, checklist: Checklist) -> int:
    """Initialise the device and return its handle.

    Raises:
        RefusedError: The device is not available.
    """
    first_error(library)
    handle = library.hdInitDevice(options.device_name.encode() or None)
    error = first_error(library)
    shown = options.device_name or "the default one"
    if error is not None:
        what, _, remedy = error_text(*error).partition(": ")
        checklist.refuse("device", f"{shown}: {what}", remedy)
    elif handle == INVALID_HANDLE:
        checklist.refuse("device", f"{shown}: no handle", "run the vendor's Touch_Setup as this user")
    if checklist.refused and handle != INVALID_HANDLE:
        library.hdDisableDevice(handle)
    checklist.finish()
    return int(handle)


def examined(library: CDLL, options: TouchOptions, checklist: Checklist) -> tuple[float, int]:
    """Return the force limit in N and the rate in Hz of the current, ready device.

    Raises:
        RefusedError: The device is not ready.
    """
    serial = text(library, SERIAL_NUMBER)
    checklist.ok("device", f"{text(library, VENDOR_NAME)} {text(library, MODEL)}, serial number {serial}")
    force_axes = integer(library, OUTPUT_AXES)
    checklist.check(
        "force axes", str(force_axes), good=force_axes >= 3, remedy="must be 3: the device must exert forces",
    )  # fmt: skip
    if options.orientation:
        checklist.ok("torque", "none is exerted: the stylus is turned and does not turn")
    _check_calibration(library, checklist)
    most_n, continuous_n = double(library, MAX_FORCE), double(library, CONTINUOUS_FORCE)
    checklist.check(
        "force", f"the device says at most {most_n:g} N, {continuous_n:g} N without end", good=0.1 <= most_n <= 50.0,
        remedy="must be 0.1 to 50 N: is it a device of the vendor's?",
    )  # fmt: skip
    rate_hz = integer(library, UPDATE_RATE)
    checklist.check("rate", f"{rate_hz} Hz", good=rate_hz in RATES, remedy="must be 400 to 4000 Hz: see Touch_Setup")
    error = first_error(library)
    if error is not None:
        what, _, remedy = error_text(*error).partition(": ")
        checklist.refuse("device", what, remedy)
    checklist.finish()
    return min(options.max_force_n, most_n), rate_hz


def check_frames(callback: HdCallback, rate_hz: int, checklist: Checklist) -> int:
    """Return the number of the latest frame after frames arrive at the library's rate.

    Raises:
        RefusedError: Frames do not arrive at that rate.
    """
    first = callback.wait(0, FIRST_S)
    if first is None:
        checklist.refuse("scheduler", f"no frame within {FIRST_S:g} s", "does Touch_Diagnostic show the device moving?")
        checklist.finish()
        raise TimeoutError
    for _ in range(LOOKS):
        begun_s = time.monotonic()
        time.sleep(LOOKED_S)
        past_s = time.monotonic() - begun_s
        last = callback.wait(first[0], 0.0) or first
        seen_hz = (last[0] - first[0]) / past_s
        good = abs(seen_hz - rate_hz) <= RATE_SHARE * rate_hz
        if good:
            break
        first = last
    checklist.check(
        "scheduler", f"{seen_hz:.0f} frames a second", good=good,
        remedy=f"must be {rate_hz}, as the library says: end what else loads this machine",
    )  # fmt: skip
    *_, calibration, error, internal = last
    if error:
        what, _, remedy = error_text(error, internal).partition(": ")
        checklist.refuse("first frames", what, remedy)
    if calibration == CALIBRATION_NEEDS_HAND:
        checklist.refuse("calibration", "needs a hand", INKWELL)
    checklist.finish()
    return last[0]


def _check_calibration(library: CDLL, checklist: Checklist) -> None:
    status = library.hdCheckCalibration()
    if status == CALIBRATION_NEEDS_UPDATE:
        style = integer(library, CALIBRATION_STYLE)
        if not style & ENCODER_RESET:
            # Calibration in the inkwell or automatic: nothing moves.
            library.hdUpdateCalibration(style)
            status = library.hdCheckCalibration()
    found = {CALIBRATED: "done", CALIBRATION_NEEDS_UPDATE: "needs an update", CALIBRATION_NEEDS_HAND: "needs a hand"}
    checklist.check(
        "calibration", found.get(status, f"0x{status:04X}"), good=status == CALIBRATED, remedy=INKWELL,
    )  # fmt: skip
