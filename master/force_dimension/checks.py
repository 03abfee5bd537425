"""Checklist before a Force Dimension device exerts a force, and evaluation of its status during a run."""

import math
from ctypes import CDLL
from typing import Final, NamedTuple

from haptether.checklist import Checklist
from haptether.master.force_dimension.library import OFF, ON, Dhd, DhdError, checked
from haptether.master.force_dimension.models import MODELS, Model
from haptether.master.force_dimension.options import WATCHDOG_STEP_S, ForceDimensionOptions

POWER, CONNECTED, STARTED, RESET, FORCE, ERROR, WRIST_STARTED, OFF_CAUSE = 0, 1, 2, 3, 5, 9, 12, 14
"""Indices of `dhdGetStatus`: dhdc.h."""
STATUS: Final = (
    (POWER, 1, "no power", "is its supply on?"),
    (CONNECTED, 1, "not connected", "see its USB cable"),
    (STARTED, 1, "not started", "switch it off and on"),
    (RESET, 0, "not calibrated", "put its end-effector into its rest position, until its light stops blinking"),
    (ERROR, 0, "error of its controller", "switch it off and on"),
)
"""Required value of each status number, fault otherwise, and remedy."""
OFF_CAUSES: Final = {
    1: "force button: forces were switched off at the device: switch them on there, acknowledge",
    2: "over-speed: it braked, as it was faster than its own limit: hold it, acknowledge",
    3: "watchdog: its controller got no new force in time: is this machine overloaded? acknowledge",
    4: "forces are off: a program has switched them off: end that, acknowledge",
    5: "USB: its controller saw the connection end: see the cable, acknowledge",
    6: "dead-man switch: press it, acknowledge",
}
"""Faults by the cause in the status: dhdc.h, `DHD_FORCE_OFF_`."""


class Abilities(NamedTuple):
    """Detected abilities."""

    model: Model
    wrist: bool
    active_wrist: bool
    gripper: bool
    """True if the gripper is the trigger."""
    has_wrench: bool
    """True if forces use the call that also takes torque and gripper force."""
    watchdog: bool
    max_force_n: float
    max_torque_n_m: float
    max_gripper_force_n: float


def status_fault(status: list[int], *, exerts: bool) -> str | None:
    """Return the fault of the device, or None.

    Args:
        status: Numbers from `dhdGetStatus`.
        exerts: True if its forces were switched on.
    """
    for index, wanted, fault, remedy in STATUS:
        if status[index] != wanted:
            return f"{fault}: {remedy}, acknowledge"
    if exerts and status[FORCE] != 1:
        return OFF_CAUSES.get(status[OFF_CAUSE], "forces are off, and it says no cause: see the device, acknowledge")
    return None


def opened(library: CDLL, options: ForceDimensionOptions, checklist: Checklist) -> Dhd:
    """Open the selected device without force.

    Raises:
        RefusedError: There is no device, the selection is ambiguous, or it cannot be opened.
    """
    count = library.dhdGetDeviceCount()
    if options.serial is None:
        checklist.check(
            "devices", str(count), good=count == 1,
            remedy="give serial, that of one of them" if count > 1
            else "is it plugged in and on, and may this user open it? see the udev rule in docs/haptic_devices.md",
        )  # fmt: skip
        checklist.finish()
    try:
        if options.serial is None:
            device = Dhd(library, checked(library, "dhdOpenID", library.dhdOpenID(0)))
        else:
            device = Dhd(library, checked(library, "dhdOpenSerial", library.dhdOpenSerial(options.serial)))
    except DhdError as error:
        checklist.refuse("open", str(error), error.remedy)
        checklist.finish()
        raise
    return device


def examined(device: Dhd, options: ForceDimensionOptions, checklist: Checklist) -> Abilities:
    """Check identity, abilities and readiness; forces are off afterwards.

    Raises:
        RefusedError: The device is not ready, or lacks an ability that the options require.
        DhdError: The device does not answer.
    """
    device.call("dhdEnableForce", OFF)
    model = MODELS.get(device.call("dhdGetSystemType"), Model(device.name()))
    serial = device.serial()
    checklist.ok("device", f"{device.name()}, {'serial number ' + str(serial) if serial else 'no serial number'}")
    status = device.status()
    fault = status_fault(status, exerts=False)
    if fault is None:
        checklist.ok("status", "on, calibrated")
    else:
        what, _, remedy = fault.removesuffix(", acknowledge").partition(": ")
        checklist.refuse("status", what, remedy)
    checklist.ok(
        "frame", f"base plate at {math.degrees(device.base_angle_rad()):.0f}°, as the SDK takes it: x to the user, y to"
        " the right, z up only where that is how it stands",
    )  # fmt: skip
    found = _abilities(device, model, options, checklist)
    if options.wrist and found.wrist:
        started = "initialised" if status[WRIST_STARTED] == 1 else "not said to be initialised: see that it turns right"
        checklist.ok("wrist", started)
    checklist.finish()
    _gravity(device, options, checklist)
    watchdog = _watchdog(device, options, checklist)
    checklist.finish()
    return found._replace(watchdog=watchdog)


def _abilities(device: Dhd, model: Model, options: ForceDimensionOptions, checklist: Checklist) -> Abilities:
    wrist, active_wrist = device.has("Wrist"), device.has("ActiveWrist")
    gripper, active_gripper = device.has("Gripper"), device.has("ActiveGripper")
    if options.wrist:
        checklist.check("wrist", "there" if wrist else "none", good=wrist, remedy="leave out the option wrist")
        if wrist and not active_wrist:
            checklist.ok("torque", "none is exerted: its wrist is turned and does not turn")
    if options.gripper_open_m is not None:
        checklist.check(
            "gripper", "with a motor" if active_gripper else "without a motor" if gripper else "none",
            good=active_gripper, remedy="leave out the option gripper_open_m",
        )  # fmt: skip
    force_n = _least(options.max_force_n, model.max_force_n)
    torque_n_m = _least(options.max_torque_n_m, model.max_torque_n_m)
    gripper_n = _least(options.max_gripper_force_n, model.max_gripper_force_n)
    known = "" if model.max_force_n is None else f"; CHAI3D has {model.max_force_n:g} N for this model"
    checklist.ok("force", f"at most {force_n:g} N{known}")
    has_wrench = wrist or gripper
    is_trigger = options.gripper_open_m is not None
    return Abilities(model, wrist, active_wrist, is_trigger, has_wrench, False, force_n, torque_n_m, gripper_n)


def _gravity(device: Dhd, options: ForceDimensionOptions, checklist: Checklist) -> None:
    if options.effector_mass_kg is not None:
        device.call("dhdSetEffectorMass", options.effector_mass_kg)
    device.call("dhdSetGravityCompensation", ON if options.gravity_compensation else OFF)
    text = "on: the SDK adds the device's weight to each force" if options.gravity_compensation else "off: it falls"
    checklist.ok("gravity compensation", text)


def _watchdog(device: Dhd, options: ForceDimensionOptions, checklist: Checklist) -> bool:
    """Test the watchdog and leave it off; the first force arms it."""
    try:
        device.call("dhdSetWatchdog", options.watchdog_steps)
        seen = device.watchdog()
        device.call("dhdSetWatchdog", 0)
    except DhdError as error:
        checklist.check(
            "watchdog", f"none ({error})", good=not options.require_watchdog,
            remedy="a killed process may leave its last force on: another device, or require_watchdog = false",
        )  # fmt: skip
        return False
    seen_s, asked_s = WATCHDOG_STEP_S * seen, WATCHDOG_STEP_S * options.watchdog_steps
    checklist.check(
        "watchdog", f"{1e3 * seen_s:g} ms without a force", good=seen == options.watchdog_steps,
        remedy=f"must be {1e3 * asked_s:g} ms, as was asked for: set watchdog_s = {seen_s:g}",
    )  # fmt: skip
    return True


def _least(asked: float, known: float | None) -> float:
    return asked if known is None else min(asked, known)
