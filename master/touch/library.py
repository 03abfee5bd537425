"""Functions of OpenHaptics HDAPI used by the driver, through ctypes.

Signatures and codes: hdDefines.h, hdDevice.h and hdScheduler.h of OpenHaptics 3, and pyOpenHaptics 1.0.1.
"""

import ctypes
from collections.abc import Mapping
from ctypes import CDLL, POINTER, c_char_p, c_double, c_int, c_uint, c_ulong, c_ushort, c_void_p
from types import MappingProxyType
from typing import Final

from haptether._core import HdCallback
from haptether.master.vendor import Function, Vendor

VENDOR: Final = Vendor(
    title="OpenHaptics",
    names=("libHD.so", "libHD.so.3.4", "libHD.so.3"),
    variable="OH_SDK_BASE",
    below=("libHD/*/lib*/libHD.so*", "usr/lib/libHD.so*", "lib/libHD.so*"),
    places=("/usr/lib/libHD.so*", "/usr/lib64/libHD.so*", "/usr/local/lib/libHD.so*"),
    remedy=(
        "install the vendor's OpenHaptics for Linux, Developer Edition, and its Touch device driver"
        " (https://support.3dsystems.com), or set the option library to its libHD.so"
    ),
)
INVALID_HANDLE: Final = 0xFFFFFFFF
FORCE_OUTPUT: Final = 0x4000
MAX_FORCE_CLAMPING: Final = 0x4001
OUTPUT_AXES: Final = 0x2554
CALIBRATION_STYLE: Final = 0x2555
UPDATE_RATE: Final = 0x2600
MAX_FORCE: Final = 0x2603
CONTINUOUS_FORCE: Final = 0x2604
MODEL, VENDOR_NAME, SERIAL_NUMBER = 0x2501, 0x2503, 0x2504
PRIORITY: Final = 0x7FFF
"""`HD_DEFAULT_SCHEDULER_PRIORITY`."""
CALIBRATED, CALIBRATION_NEEDS_UPDATE, CALIBRATION_NEEDS_HAND = 0x5000, 0x5001, 0x5002
ENCODER_RESET: Final = 1
"""Calibration style that takes the current pose as the neutral one."""
TOO_MANY: Final = 32
"""Errors removed from the stack per call."""


class ErrorInfo(ctypes.Structure):
    """`HDErrorInfo`."""

    _fields_ = (("code", c_uint), ("internal", c_int), ("device", c_uint))
    code: int
    internal: int


FUNCTIONS: Final = (
    Function("hdInitDevice", c_uint, (c_char_p,)),
    Function("hdDisableDevice", None, (c_uint,)),
    Function("hdMakeCurrentDevice", None, (c_uint,)),
    Function("hdBeginFrame", None, (c_uint,)),
    Function("hdEndFrame", None, (c_uint,)),
    Function("hdEnable", None, (c_uint,)),
    Function("hdDisable", None, (c_uint,)),
    Function("hdGetIntegerv", None, (c_uint, POINTER(c_int))),
    Function("hdGetDoublev", None, (c_uint, POINTER(c_double))),
    Function("hdSetDoublev", None, (c_uint, POINTER(c_double))),
    Function("hdGetString", c_char_p, (c_uint,)),
    Function("hdGetError", ErrorInfo),
    Function("hdCheckCalibration", c_uint),
    Function("hdUpdateCalibration", None, (c_uint,)),
    Function("hdScheduleAsynchronous", c_ulong, (c_void_p, c_void_p, c_ushort)),
    Function("hdUnschedule", None, (c_ulong,)),
    Function("hdStartScheduler", None),
    Function("hdStopScheduler", None),
)
FRAME: Final = (
    "hdMakeCurrentDevice", "hdBeginFrame", "hdEndFrame", "hdGetDoublev", "hdGetIntegerv", "hdSetDoublev", "hdGetError",
    "hdCheckCalibration",
)  # fmt: skip
"""Functions that a frame needs, in the order of `HdCallback`."""

ERRORS: Mapping[int, tuple[str, str]] = MappingProxyType({
    0x104: ("bad handle", "is the name of the device that of Touch_Setup?"),
    0x200: ("warm motors", "let it cool down"),
    0x201: ("force too large", "lower max_force_n"),
    0x202: ("force impulse too large", "lower stiffness and max_force_n"),
    0x203: ("too fast", "hold it, and move it slower"),
    0x204: ("force error", "see the vendor's Touch_Diagnostic"),
    0x300: ("device fault", "see the vendor's Touch_Diagnostic"),
    0x301: ("already initialised", "end the other program that has it"),
    0x302: ("communication", "see its USB cable and supply, and the udev rule in docs/haptic_devices.md"),
    0x303: ("communication set-up", "run the vendor's Touch_Setup as this user, which pairs the device"),
    0x304: ("timer", "end what else loads this machine"),
    0x400: ("frame begun twice", "end the other program that has it"),
    0x401: ("frame ended twice", "end the other program that has it"),
    0x402: ("frame error", "see the vendor's Touch_Diagnostic"),
    0x600: ("licence", "install the vendor's licence"),
})  # fmt: skip
"""Error texts and remedies. Source of the codes: hdDefines.h."""
LOST: Final = frozenset({0x104, 0x300, 0x301, 0x302, 0x303, 0x304, 0x600})
"""Errors that require reopening the device."""


def error_text(code: int, internal: int) -> str:
    """Return the text and remedy of an error."""
    what, remedy = ERRORS.get(code, ("error", "see the vendor's Touch_Diagnostic"))
    return f"{what} (0x{code:04X}, internal {internal}): {remedy}"


def first_error(library: CDLL) -> tuple[int, int] | None:
    """Return the first error since the last call with its internal code; clear the others."""
    first = None
    for _ in range(TOO_MANY):
        error = library.hdGetError()
        if error.code == 0:
            break
        first = first or (error.code, error.internal)
    return first


def integer(library: CDLL, code: int) -> int:
    """Return an integer parameter of the current device."""
    # Large enough for any parameter.
    values = (c_int * 16)()
    library.hdGetIntegerv(code, values)
    return values[0]


def double(library: CDLL, code: int) -> float:
    """Return a floating-point parameter of the current device."""
    values = (c_double * 16)()
    library.hdGetDoublev(code, values)
    return values[0]


def text(library: CDLL, code: int) -> str:
    """Return a text parameter of the current device."""
    return (library.hdGetString(code) or b"?").decode(errors="replace")


def frame_callback(library: CDLL, device: int, *, watchdog_s: float, max_force_n: float) -> HdCallback:
    """Return the scheduler callback of this device."""
    addresses = [ctypes.cast(getattr(library, name), c_void_p).value or 0 for name in FRAME]
    return HdCallback(addresses, device, watchdog_s=watchdog_s, max_force_n=max_force_n)
