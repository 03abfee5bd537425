"""Functions of the Force Dimension SDK used by the driver, through ctypes.

Signatures: dhdc.h of SDK 3.17.5. Return values: 0 is success; -1 is an error, detailed by `dhdErrorGetLast` on the same
thread; 1 (old values, TimeGuard) and 2 (motors saturated, the force was scaled) are successes.
"""

import math
import platform
from collections.abc import Mapping, Sequence
from ctypes import CDLL, POINTER, byref, c_bool, c_byte, c_char_p, c_double, c_int, c_ubyte, c_uint, c_ushort
from types import MappingProxyType
from typing import Any, Final

from haptether.master.vendor import Function, Vendor

VENDOR: Final = Vendor(
    title="Force Dimension SDK",
    names=("libdrd.so.3", "libdrd.so", "libdhd.so.3", "libdhd.so"),
    variable="FDSDK",
    below=(
        f"lib/release/lin-{platform.machine()}-gcc/libdrd.so*",
        f"lib/release/lin-{platform.machine()}-gcc/libdhd.so*",
    ),
    places=("/usr/local/lib/libdrd.so*", "/usr/local/lib/libdhd.so*", "~/.local/lib/libdrd.so*"),
    remedy=(
        "install the vendor's SDK 3.16 or later (https://www.forcedimension.com/software/sdk), and set FDSDK to its"
        " folder or the option library to its libdrd.so"
    ),
)
_D3 = (POINTER(c_double),) * 3
_ID = c_byte
FUNCTIONS: Final = (
    Function("dhdErrorGetLast", c_int),
    Function("dhdErrorGetLastStr", c_char_p),
    Function("dhdGetDeviceCount", c_int),
    Function("dhdOpenID", c_int, (_ID,)),
    Function("dhdOpenSerial", c_int, (c_int,)),
    Function("dhdClose", c_int, (_ID,)),
    Function("dhdStop", c_int, (_ID,)),
    Function("dhdEnableForce", c_int, (c_ubyte, _ID)),
    Function("dhdGetSystemType", c_int, (_ID,)),
    Function("dhdGetSystemName", c_char_p, (_ID,)),
    Function("dhdGetSerialNumber", c_int, (POINTER(c_ushort), _ID)),
    Function("dhdGetStatus", c_int, (POINTER(c_int), _ID)),
    Function("dhdGetDeviceAngleRad", c_int, (POINTER(c_double), _ID)),
    Function("dhdHasWrist", c_bool, (_ID,)),
    Function("dhdHasActiveWrist", c_bool, (_ID,)),
    Function("dhdHasGripper", c_bool, (_ID,)),
    Function("dhdHasActiveGripper", c_bool, (_ID,)),
    Function("dhdSetGravityCompensation", c_int, (c_int, _ID)),
    Function("dhdSetEffectorMass", c_int, (c_double, _ID)),
    Function("dhdGetButtonMask", c_uint, (_ID,)),
    Function("dhdGetPosition", c_int, (*_D3, _ID)),
    Function("dhdGetPositionAndOrientationFrame", c_int, (*_D3, POINTER(c_double), _ID)),
    Function("dhdGetLinearVelocity", c_int, (*_D3, _ID)),
    Function("dhdGetGripperGap", c_int, (POINTER(c_double), _ID)),
    Function("dhdSetForce", c_int, (*(c_double,) * 3, _ID)),
    Function("dhdSetForceAndTorqueAndGripperForce", c_int, (*(c_double,) * 7, _ID)),
    Function("dhdEnableExpertMode", c_int),
    Function("dhdSetWatchdog", c_int, (c_ubyte, _ID)),
    Function("dhdGetWatchdog", c_int, (POINTER(c_ubyte), _ID)),
)
ON: Final = 1
OFF: Final = 0
TIMEGUARD: Final = 1
STATUS: Final = 17
"""Number of values from `dhdGetStatus`; newer SDKs may return more."""
STATUS_ROOM: Final = 64
TIMEOUT: Final = 7
NOT_ENABLED: Final = 19
REMEDIES: Mapping[int, str] = MappingProxyType({
    2: "see its USB cable and its supply",
    3: "another program has it: end that",
    4: "may this user open its USB device? see the udev rule in docs/haptic_devices.md",
    5: "is it plugged in and on? see the udev rule in docs/haptic_devices.md",
    6: "its controller cannot do this",
    7: "see its USB cable, and what else is on that bus",
    12: "calibrate it: its end-effector into its rest position, until its light stops blinking",
    19: "forces are off at the device: its force button",
    20: "another program has it: end that",
})  # fmt: skip
"""Remedies by error number: dhdc.h, `dhd_errors`."""


class DhdError(Exception):
    """Call that returned -1.

    Args:
        call: Name of the call.
        number: Number from `dhdErrorGetLast`.
        text: Text from `dhdErrorGetLastStr`.
    """

    def __init__(self, call: str, number: int, text: str) -> None:
        super().__init__(f"{call}: error {number}, {text}")
        self.number = number

    @property
    def remedy(self) -> str:
        """Remedy of the error."""
        return REMEDIES.get(self.number, "see the vendor's own demonstrations")


class Dhd:
    """One open device; each call may raise `DhdError`.

    Args:
        library: Vendor library with its types.
        device_id: Device number of the SDK.
    """

    def __init__(self, library: CDLL, device_id: int) -> None:
        self._library = library
        self._id = device_id
        self._point = c_double(), c_double(), c_double()
        self._into = tuple(map(byref, self._point))
        self._matrix = (c_double * 9)()
        self._gap = c_double()
        self._status = (c_int * STATUS_ROOM)()

    def call(self, name: str, *arguments: Any) -> int:  # noqa: ANN401  # as ctypes takes them
        """Call a function whose last argument is the device, and return its result."""
        return checked(self._library, name, getattr(self._library, name)(*arguments, self._id))

    def has(self, what: str) -> bool:
        """Return True if the device has a `Wrist`, `ActiveWrist`, `Gripper` or `ActiveGripper`."""
        return bool(getattr(self._library, f"dhdHas{what}")(self._id))

    def name(self) -> str:
        """Return the SDK's name of the device."""
        return (self._library.dhdGetSystemName(self._id) or b"?").decode(errors="replace")

    def serial(self) -> int | None:
        """Return the serial number; None if the model does not report one."""
        number = c_ushort()
        return None if self._library.dhdGetSerialNumber(byref(number), self._id) < 0 else number.value

    def base_angle_rad(self) -> float:
        """Return the rotation of the base plate in rad, as used by the SDK."""
        self.call("dhdGetDeviceAngleRad", byref(self._gap))
        return self._gap.value

    def status(self) -> list[int]:
        """Return the numbers of `dhdGetStatus`."""
        self.call("dhdGetStatus", self._status)
        return self._status[:STATUS]

    def position(self) -> tuple[bool, list[float]]:
        """Return a freshness flag and the position in m."""
        returned = self.call("dhdGetPosition", *self._into)
        return returned != TIMEGUARD, self._three()

    def pose(self) -> tuple[bool, list[float], list[list[float]]]:
        """Return a freshness flag, the position in m, and the rotation matrix of the handle by rows."""
        self._matrix[0] = math.nan
        returned = self.call("dhdGetPositionAndOrientationFrame", *self._into, self._matrix)
        rows = self._matrix[:]
        return returned != TIMEGUARD, self._three(), [rows[0:3], rows[3:6], rows[6:9]]

    def velocity(self) -> list[float]:
        """Return the velocity in m/s."""
        self.call("dhdGetLinearVelocity", *self._into)
        return self._three()

    def gripper_gap(self) -> float:
        """Return the gripper opening in m."""
        self.call("dhdGetGripperGap", byref(self._gap))
        return self._gap.value

    def buttons(self) -> int:
        """Return the button mask; bit n is button n."""
        return int(self._library.dhdGetButtonMask(self._id))

    def watchdog(self) -> int:
        """Return the watchdog time in steps of 125 µs."""
        steps = c_ubyte()
        self.call("dhdGetWatchdog", byref(steps))
        return steps.value

    def set_wrench(self, force: Sequence[float], torque: Sequence[float], gripper_force: float) -> None:
        """Set force in N, torque in N m and gripper force in N."""
        self.call("dhdSetForceAndTorqueAndGripperForce", *force, *torque, gripper_force)

    def set_force(self, force: Sequence[float]) -> None:
        """Set the force in N of a device without wrist and gripper."""
        self.call("dhdSetForce", *force)

    def _three(self) -> list[float]:
        return [part.value for part in self._point]


def checked(library: CDLL, call: str, returned: int) -> int:
    """Return the result unless it signals an error.

    Raises:
        DhdError: The result signals an error.
    """
    if returned < 0:
        text = (library.dhdErrorGetLastStr() or b"?").decode(errors="replace")
        raise DhdError(call, library.dhdErrorGetLast(), text)
    return returned
