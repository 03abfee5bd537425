"""Checklist before a UR arm moves, and recovery after a fault.

Each line gives a finding, and a remedy for each refusal.
"""

import math
import time
from typing import TYPE_CHECKING, Final

from haptether.checklist import Checklist, RefusedError
from haptether.printed import printed
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
    from collections.abc import Callable, Sequence

OLDEST: Final = {3: (3, 15), 5: (5, 4)}
"""Oldest supported versions: earlier ones lack registers or status bits that the library needs. Other series are not
supported.
"""
REMOTE_SINCE: Final = (5, 6)
DIRECT_TORQUE_SINCE: Final = (5, 26)
POLYSCOPE_X: Final = 10
TOOL_M: Final = 1e-4
"""Largest difference between set and reported tool, in m and rad."""
MODEL_M: Final = 0.03
"""Largest distance in m between the model's and the controller's tool; calibrations are millimetres."""
UNLOCK_AFTER_S: Final = 5.0
"""The controller refuses earlier."""
UNLOCKED_WITHIN_S: Final = 3.0


class UrRefusedError(RefusedError):
    """The arm must not move now."""


ENABLE: Final = "is the {} enabled (Settings > Security > Services)?"
STARTED: Final = (
    "does a popup or the log of the pendant name a cause, or does another client or a fieldbus use the registers?"
    " remove it, then start again"
)
REACHABLE: Final = "is it on, in this network, and RTDE not disabled in its security settings?"


def check_address(host: str, checklist: Checklist) -> str:
    """Resolve the controller's address once.

    Raises:
        UrRefusedError: There is no address.
    """
    try:
        address = resolved(host)
    except ProbeError as error:
        checklist.refuse("address", str(error), "is the name right, and is there a name server? take its IPv4 address")
        raise _refused(checklist) from None
    if address != host:
        checklist.ok("address", address)
    return address


def check_before(options: UrOptions, checklist: Checklist) -> Probe:
    """Check everything visible before sending: controller, version, modes, stops, program, remote control.

    Raises:
        UrRefusedError: The arm is not ready.
    """
    host = options.host
    try:
        seen = probe(host)
    except ProbeError as error:
        checklist.refuse("reachable", str(error), REACHABLE)
        raise _refused(checklist) from None
    checklist.ok("reachable", f"{seen.rate_hz:.0f} packages/s")
    check_version(seen, options.mode, checklist)
    check_services(seen, host, checklist)
    check_state(seen, checklist)
    check_program(seen, host, checklist)
    checklist.finish()
    return seen


def check_version(seen: Probe, mode: str, checklist: Checklist) -> None:
    """Check that the driver supports the controller software, and the software the mode of the options.

    Raises:
        UrRefusedError: Unsupported; the services of the next checks may not exist.
    """
    version = seen.version[:2]
    oldest = OLDEST.get(version[0])
    remedy = "needs 3.15 (CB3), or 5.4 and later of PolyScope 5"
    if version[0] >= POLYSCOPE_X:
        remedy += ": PolyScope X has no dashboard server, the second means to stop the arm"
    good = oldest is not None and version >= oldest
    if good and mode == "direct-torque" and version < DIRECT_TORQUE_SINCE:
        good, remedy = False, "mode = 'direct-torque' needs 5.26 or later: take servoj"
    checklist.check("software", seen.version_text, good=good, remedy=remedy)
    checklist.finish()


def check_services(seen: Probe, host: str, checklist: Checklist) -> None:
    """Check that the controller accepts scripts and its dashboard server answers."""
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
    """Check that no program plays. End a control script without a client, unless an item was refused."""
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
    """Check robot mode, safety mode and speed slider."""
    robot_mode, safety_mode = seen.robot_mode, seen.safety_mode
    checklist.check(
        "robot mode", mode_text(RobotMode, robot_mode), good=robot_mode == RobotMode.RUNNING,
        remedy="power the arm on and release its brakes on the pendant",
    )  # fmt: skip
    # Reduced mode is normal within a zone's lower limits, which the controller enforces.
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


def check_connection(options: UrOptions, connection: RtdeConnection, checklist: Checklist) -> "Sequence[float]":
    """Connect and check that the control script starts; return the tool of the options, or else of the pendant.

    Raises:
        UrRefusedError: The library does not connect, or the script does not start in time or does not answer.
    """
    try:
        connection.connect()
        tool: Sequence[float] = options.tool or connection.setting("tool", connection.control.getTCPOffset)
    except RtdeConnectionError as error:
        checklist.refuse("control script", str(error), STARTED)
        raise _refused(checklist) from None
    checklist.ok("control script", "plays")
    return tool


def check_after(
    options: UrOptions, connection: RtdeConnection, checklist: Checklist, *, sensor: bool = True
) -> UrState:
    """Check what needs the control script: payload, tool, watchdog, force sensor.

    Args:
        options: Options of the driver.
        connection: Connection with a playing script.
        checklist: Takes the lines.
        sensor: True to zero the force sensor; False if the tool may be in contact.

    Raises:
        UrRefusedError: An item was refused.
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
    # Last, because from then on the controller must hear this side.
    steps.append(
        ("watchdog", "without it nothing stops the arm when this side dies", lambda: _watchdog(options, connection))
    )
    for what, remedy, step in steps:
        try:
            checklist.ok(what, step())
        except RtdeConnectionError as error:
            checklist.refuse(what, str(error), remedy)
            # Later steps would only time out too.
            break
    checklist.finish()
    return connection.state()


def check_model(distance_m: float, options: UrOptions, checklist: Checklist) -> None:
    """Check that the arm is the model that the options name.

    Raises:
        UrRefusedError: The tool of that model would be at another position.
    """
    checklist.check(
        "model", f"{options.model}, its tool {1e3 * distance_m:.1f} mm from where the controller has it",
        good=distance_m <= MODEL_M, remedy="model or tool is that of another arm",
    )  # fmt: skip
    checklist.finish()


def check_workspace(beyond_m: float, beyond_rad: float, options: UrOptions, checklist: Checklist) -> None:
    """Check that the tool is within the planes, and its axis within the cone, of the options.

    Raises:
        UrRefusedError: The tool is outside by more than the largest distance of a first command.
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
    """Unlock a protective stop, reconnect and upload the script again, as needed.

    Does not power on the arm; people beside the arm must clear emergency and safeguard stops. The force sensor is not
    zeroed, because the tool may be in contact.

    Args:
        options: Options of the driver.
        connection: Connections in any state.
        stopped_at_s: Time of the fault on the monotonic clock.

    Raises:
        Exception: The remaining obstacle; the arm does not move.
    """
    seen = _unlocked(options.host, probe(options.host), stopped_at_s)
    # The raised error has what is refused.
    checklist = Checklist(options.host, lambda _: None)
    check_state(seen, checklist)
    check_services(seen, options.host, checklist)
    checklist.finish()
    if (
        connection.control is None
        and seen.runtime_state == RuntimeState.PLAYING
        and not end_control_script(options.host)
    ):
        # Our program has ended, and connecting would stop another one started meanwhile.
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
    # Stay silent: the program must end.
    try:
        connection.await_state(
            "the program ends in silence", lambda state: state.runtime_state != RuntimeState.PLAYING, period_s + 1.0
        )
    except RtdeConnectionError as error:
        message = f"does not bite: {error}"
        raise RtdeConnectionError(message) from None
    # The driver arms it again with its first sample, and is heard from then on.
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


def _refused(checklist: Checklist) -> UrRefusedError:
    """Return the error of a list that ends here."""
    return UrRefusedError(printed("; ".join(checklist.refused)))


def _text(pose: object) -> str:
    return "(" + ", ".join(f"{part:g}" for part in pose) + ")"  # type: ignore[attr-defined]  # numbers
