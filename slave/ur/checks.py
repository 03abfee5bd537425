"""The checklist before a UR arm moves, and the way back to it after a fault.

Each line says what was found, and what to do where it is refused.
"""

import math
import time
from typing import TYPE_CHECKING, Final

from haptether.checklist import Checklist, RefusedError
from haptether.slave.ur.connection import RtdeConnection, RtdeConnectionError
from haptether.slave.ur.options import UrOptions
from haptether.slave.ur.services import (
    DASHBOARD_PORT,
    SCRIPT_PORT,
    DashboardError,
    Probe,
    ProbeError,
    check_script_port,
    end_control_script,
    is_in_remote_control,
    probe,
    query_dashboard,
    resolved,
    unlock_protective_stop,
)
from haptether.slave.ur.state import (
    FULL_SPEED,
    PROTECTIVE_BIT,
    SLIDER,
    RobotMode,
    RuntimeState,
    SafetyMode,
    UrState,
    mode_text,
)

if TYPE_CHECKING:
    from collections.abc import Callable

OLDEST: Final = {3: (3, 15), 5: (5, 4)}
"""Before these, registers or status bits that the library needs are missing. Other series are not supported."""
REMOTE_SINCE: Final = (5, 6)
POLYSCOPE_X: Final = 10
TOOL_M: Final = 1e-4
"""How far what was set as tool may be from what the controller says it has, in m and rad."""
MODEL_M: Final = 0.03
"""Farthest that the chosen model's tool may be from the controller's: calibrations are millimetres."""
UNLOCK_AFTER_S: Final = 5.0
"""The controller refuses before."""
UNLOCKED_WITHIN_S: Final = 3.0


class UrRefusedError(RefusedError):
    """The arm is not to be moved now."""


ENABLE: Final = "is the {} enabled (Settings > Security > Services)?"
REACHABLE: Final = "is it on, in this network, and RTDE not disabled in its security settings?"


def check_address(host: str, checklist: Checklist) -> str:
    """The controller's address, which is not looked up again.

    Raises:
        UrRefusedError: It has none.
    """
    try:
        address = resolved(host)
    except ProbeError as error:
        checklist.refuse("address", str(error), "is the name right, and is there a name server? take its IPv4 address")
        raise UrRefusedError("; ".join(checklist.refused)) from None
    if address != host:
        checklist.ok("address", address)
    return address


def check_before(options: UrOptions, checklist: Checklist) -> Probe:
    """What can be seen before anything is sent: controller, version, modes, stops, program, remote control.

    Raises:
        UrRefusedError: The arm is not ready.
    """
    host = options.host
    try:
        seen = probe(host)
    except ProbeError as error:
        checklist.refuse("reachable", str(error), REACHABLE)
        raise UrRefusedError("; ".join(checklist.refused)) from None
    checklist.ok("reachable", f"{seen.rate_hz:.0f} packages/s")
    check_version(seen, checklist)
    check_services(seen, host, checklist)
    check_state(seen, checklist)
    check_program(seen, host, checklist)
    checklist.finish()
    return seen


def check_version(seen: Probe, checklist: Checklist) -> None:
    """Check that the driver supports the software of the controller.

    Raises:
        UrRefusedError: It does not; the services of the next checks may not exist.
    """
    version = seen.version[:2]
    oldest = OLDEST.get(version[0])
    remedy = "needs 3.15 (CB3), or 5.4 and later of PolyScope 5"
    if version[0] >= POLYSCOPE_X:
        remedy += ": PolyScope X has no dashboard server, the second means to stop the arm"
    checklist.check("software", seen.version_text, good=oldest is not None and version >= oldest, remedy=remedy)
    checklist.finish()


def check_services(seen: Probe, host: str, checklist: Checklist) -> None:
    """Check that the controller takes scripts and its dashboard server answers."""
    try:
        check_script_port(host)
        checklist.ok("scripts", f"port {SCRIPT_PORT}")
    except ProbeError as error:
        checklist.refuse("scripts", str(error), ENABLE.format("Real-Time Client interface"))
    try:
        if seen.version[:2] < REMOTE_SINCE:
            query_dashboard(host, "programState")
            checklist.ok("dashboard", f"port {DASHBOARD_PORT}")
            return
        remote = is_in_remote_control(host)
    except DashboardError as error:
        checklist.refuse("dashboard", str(error), ENABLE.format("dashboard server"))
        return
    checklist.check(
        "remote control", "on" if remote else "off", good=remote,
        remedy="switch the pendant to Remote Control (Settings > System > Remote Control enables it)",
    )  # fmt: skip


def check_program(seen: Probe, host: str, checklist: Checklist) -> None:
    """Check that no program plays. A control script without a client is ended, unless something was refused."""
    what, plays = mode_text(RuntimeState, seen.runtime_state), seen.runtime_state == RuntimeState.PLAYING
    remedy = "somebody else's program plays: stop it on the pendant"
    if plays and not checklist.refused:
        try:
            if end_control_script(host):
                checklist.ok("program", "the control script of an earlier run played without a client: it is ended")
                return
        except ProbeError as error:
            remedy = str(error)
    checklist.check("program", what, good=not plays, remedy=remedy)


def check_state(seen: Probe, checklist: Checklist) -> None:
    """Robot mode, safety mode and speed slider."""
    robot_mode, safety_mode = seen.robot_mode, seen.safety_mode
    checklist.check(
        "robot mode", mode_text(RobotMode, robot_mode), good=robot_mode == RobotMode.RUNNING,
        remedy="power the arm on and release its brakes on the pendant",
    )  # fmt: skip
    # Reduced is normal with the lower limits of a zone: those are the controller's to keep.
    good = safety_mode == SafetyMode.NORMAL and not seen.safety_bits & ~0b11
    stopped = safety_mode == SafetyMode.PROTECTIVE_STOP
    checklist.check(
        "safety mode", mode_text(SafetyMode, safety_mode), good=good,
        remedy="find the cause, clear the tool, unlock it on the pendant" if stopped
        else "bring it to normal on the pendant, at full speed limits",
    )  # fmt: skip
    checklist.check(
        "speed slider", f"{100.0 * seen.speed_fraction:.0f} %", good=seen.speed_fraction >= FULL_SPEED, remedy=SLIDER
    )


def check_after(
    options: UrOptions, connection: RtdeConnection, checklist: Checklist, *, sensor: bool = True
) -> UrState:
    """What needs the control script: payload, tool, watchdog, force sensor.

    Args:
        options: Of the driver.
        connection: Connected, its script playing.
        checklist: Takes the lines.
        sensor: Whether to zero the force sensor: not where the tool may touch something.

    Raises:
        UrRefusedError: Something was refused.
    """
    steps: list[tuple[str, str, Callable[[], str]]] = []
    if options.payload_kg is not None:
        steps.append(("payload", "is it within what the arm carries?", lambda: _payload(options, connection)))
    else:
        checklist.ok("payload", "as set on the pendant")
    steps.append(("tool", "set it on the pendant, or in the options", lambda: _tool(options, connection)))
    if sensor and options.zero_ft_sensor:
        remedy = "the tool must touch nothing; zero_ft_sensor = false leaves it"
        steps.append(("force sensor", remedy, lambda: _zero(connection)))
    # Last: from then on this side must be heard.
    steps.append(
        ("watchdog", "without it nothing stops the arm when this side dies", lambda: _watchdog(options, connection))
    )
    for what, remedy, step in steps:
        try:
            checklist.ok(what, step())
        except RtdeConnectionError as error:
            checklist.refuse(what, str(error), remedy)
            # What follows would only wait for the same.
            break
    checklist.finish()
    return connection.state()


def check_model(distance_m: float, options: UrOptions, checklist: Checklist) -> None:
    """Whether the arm is the one that the options name.

    Raises:
        UrRefusedError: The tool of that model would be elsewhere.
    """
    checklist.check(
        "model", f"{options.model}, its tool {1e3 * distance_m:.1f} mm from where the controller has it",
        good=distance_m <= MODEL_M, remedy="model or tool is that of another arm",
    )  # fmt: skip
    checklist.finish()


def check_workspace(beyond_m: float, beyond_rad: float, options: UrOptions, checklist: Checklist) -> None:
    """Whether the tool is inside the planes, and its axis in the cone, that the options name.

    Raises:
        UrRefusedError: It is outside by more than a first command may be away.
    """
    if options.tool_cone is not None:
        checklist.check(
            "tool cone", "the tool's axis " + (f"{beyond_rad:.3f} rad outside" if beyond_rad > 0.0 else "inside"),
            good=beyond_rad <= options.max_turn, remedy="turn the tool back, or mend tool_cone",
        )  # fmt: skip
    if not options.workspace:
        checklist.ok("workspace", "no planes in the options: the controller's own safety planes alone")
        checklist.finish()
        return
    planes = f"{len(options.workspace)} plane{'s' if len(options.workspace) > 1 else ''}"
    checklist.check(
        "workspace", f"{planes}, the tool " + (f"{1e3 * beyond_m:.1f} mm outside" if beyond_m > 0.0 else "inside"),
        good=beyond_m <= options.max_jump, remedy="move the tool inside, or mend the planes",
    )  # fmt: skip
    checklist.finish()


def recover(options: UrOptions, connection: RtdeConnection, stopped_at_s: float) -> UrState:
    """Unlocks a protective stop, connects again and uploads the script again, as far as each is needed.

    It powers nothing on and leaves emergency and safeguard stops to people beside the arm. The force sensor stays as it
    is: the tool may touch something.

    Args:
        options: Of the driver.
        connection: Its connections, in whatever state.
        stopped_at_s: When the fault was seen, on the monotonic clock.

    Raises:
        Exception: What still stands against it; the arm stays where it is.
    """
    seen = _unlocked(options.host, probe(options.host), stopped_at_s)
    checklist = Checklist(options.host)
    check_state(seen, checklist)
    check_services(seen, options.host, checklist)
    checklist.finish()
    if (
        connection.control is None
        and seen.runtime_state == RuntimeState.PLAYING
        and not end_control_script(options.host)
    ):
        # Ours has ended: to connect would stop what somebody has started meanwhile.
        message = "a program plays that is not ours: stop it on the pendant, then acknowledge again"
        raise RtdeConnectionError(message)
    connection.connect()
    return check_after(options, connection, checklist, sensor=False)


def _payload(options: UrOptions, connection: RtdeConnection) -> str:
    control = connection.control
    cog = list(options.payload_cog or (0.0, 0.0, 0.0))
    connection.setting("payload", lambda: control.setPayload(options.payload_kg, cog))
    return f"{options.payload_kg:g} kg"


def _tool(options: UrOptions, connection: RtdeConnection) -> str:
    control = connection.control
    if options.tool is not None:
        connection.setting("tool", lambda: control.setTcp(list(options.tool or ())))
    seen = connection.setting("tool", control.getTCPOffset)
    if options.tool is not None and max(abs(a - b) for a, b in zip(seen, options.tool, strict=True)) > TOOL_M:
        message = f"is {_text(seen)} after {_text(options.tool)} was set"
        raise RtdeConnectionError(message)
    return f"{_text(seen)} (m, rad)"


def _watchdog(options: UrOptions, connection: RtdeConnection) -> str:
    period_s = 1.0 / options.watchdog_hz
    if not options.verify_watchdog:
        return f"{options.watchdog_hz:g} Hz, not tried"
    connection.setting("watchdog", lambda: connection.control.setWatchdog(options.watchdog_hz))
    # Silence: the program must end.
    try:
        connection.await_state(
            "the program ends in silence", lambda state: state.runtime_state != RuntimeState.PLAYING, period_s + 1.0
        )
    except RtdeConnectionError as error:
        message = f"does not bite: {error}"
        raise RtdeConnectionError(message) from None
    # The driver arms it again with its first sample, from when on it is heard.
    connection.upload()
    return f"{options.watchdog_hz:g} Hz, tried: it ends the program"


def _zero(connection: RtdeConnection) -> str:
    before = math.hypot(*connection.state().wrench[:3])
    connection.setting("zero_ftsensor", connection.control.zeroFtSensor)
    return f"zeroed, showed {before:.1f} N"


def _unlocked(host: str, seen: Probe, stopped_at_s: float) -> Probe:
    if not seen.safety_bits & PROTECTIVE_BIT:
        return seen
    left_s = UNLOCK_AFTER_S - (time.monotonic() - stopped_at_s)
    if left_s > 0.0:
        message = f"protective stop: can be unlocked in {left_s:.1f} s: inspect its cause, then acknowledge again"
        raise RtdeConnectionError(message)
    unlock_protective_stop(host)
    end_s = time.monotonic() + UNLOCKED_WITHIN_S
    while seen.safety_bits & PROTECTIVE_BIT:
        if time.monotonic() > end_s:
            message = f"protective stop: still there {UNLOCKED_WITHIN_S:g} s after it was unlocked: see the pendant"
            raise RtdeConnectionError(message)
        seen = probe(host)
    return seen


def _text(pose: object) -> str:
    return "(" + ", ".join(f"{part:g}" for part in pose) + ")"  # type: ignore[attr-defined]  # numbers
