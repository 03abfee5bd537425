"""Checklist before a gripper is commanded: findings, and a remedy for each refusal."""

import time
from collections.abc import Callable, Generator
from statistics import median
from typing import Final

from haptether.checklist import Checklist, RefusedError
from haptether.slave.robotiq.activation import ActivationError, activation
from haptether.slave.robotiq.options import RobotiqOptions
from haptether.slave.robotiq.protocol import (
    ACTIVE,
    CLEAR,
    CONTACT,
    FAULTS,
    REACTIVATION,
    Request,
    fault_text,
    get,
    set_,
)
from haptether.slave.robotiq.session import START
from haptether.slave.robotiq.wire import Wire
from haptether.slave.ur.services import ProbeError, resolved

LOOKS: Final = 5
"""Number of measured round trips."""
SLOW_S: Final = 0.1
MOVES: Final = "the activation opens and closes its jaws once: are hands and parts out of them?"


def check_address(host: str, checklist: Checklist) -> str:
    """Resolve the controller's address once.

    Raises:
        RefusedError: There is no address.
    """
    try:
        return resolved(host)
    except ProbeError as error:
        checklist.refuse("address", str(error), "is the name right, and is there a name server? take its IPv4 address")
        raise RefusedError("; ".join(checklist.refused)) from None


def check_gripper(
    wire: Wire,
    options: RobotiqOptions,
    checklist: Checklist,
    *,
    ask: Callable[[str], bool],
    pause: Callable[[float], None] = time.sleep,
) -> dict[str, int]:
    """Check server, fault, activation and jaws; return the initial values of a session.

    Args:
        wire: Connection to the server.
        options: Options of the driver.
        checklist: Takes the lines.
        ask: Asks for permission to move the jaws for an activation, with the reason.
        pause: Sleeps for a time in s.

    Raises:
        RefusedError: The gripper is not ready, and was not activated.
        WireError: The server does not answer.
    """
    took_s = []
    for _ in range(LOOKS):
        begun_s = time.monotonic()
        wire.exchange(get("STA"))
        took_s.append(time.monotonic() - begun_s)
    checklist.check(
        "server", f"answers within {1e3 * median(took_s):.1f} ms", good=median(took_s) < SLOW_S,
        remedy=f"must be within {1e3 * SLOW_S:g} ms: see the network, and what else asks it",
    )  # fmt: skip
    checklist.finish()
    choose(wire, options)
    if options.slave_id is not None:
        checklist.ok("gripper", f"slave id {options.slave_id}")
    state, flt = _read(wire, "STA"), _read(wire, "FLT")
    if flt and flt not in REACTIVATION:
        what, _, remedy = fault_text(flt).rpartition(": ")
        checklist.refuse("fault", what, remedy)
        checklist.finish()
    if state == ACTIVE and not flt:
        checklist.ok("active", f"STA {state}")
    else:
        _activate(wire, checklist, f"FLT {flt}: {FAULTS[flt][0]}" if flt else f"STA {state}", ask, pause)
    values = look(wire)
    position, holds = options.scale.position(values["POS"]), values["GTO"] == 1 and values["OBJ"] in CONTACT
    checklist.ok("jaws", f"{100.0 * position:.0f} % closed, {'on an object' if holds else 'on nothing'}")
    return values


def choose(wire: Wire, options: RobotiqOptions) -> None:
    """Select the gripper that the options name, if any.

    Raises:
        WireError: The server does not answer.
    """
    if options.slave_id is not None:
        wire.exchange(set_({"SID": options.slave_id}))


def look(wire: Wire) -> dict[str, int]:
    """Return the initial values of a session with an active gripper, without motion.

    Raises:
        RefusedError: The gripper is not active, or has a fault.
        WireError: The server does not answer.
    """
    values = {variable: _read(wire, variable) for variable in START}
    if values["FLT"]:
        raise RefusedError(fault_text(values["FLT"]))
    if values["STA"] != ACTIVE:
        message = f"not active: STA {values['STA']}: {CLEAR}"
        raise RefusedError(message)
    return values


def _activate(
    wire: Wire, checklist: Checklist, found: str, ask: Callable[[str], bool], pause: Callable[[float], None]
) -> None:
    if not ask(f"{found}: {MOVES}"):
        checklist.refuse("active", f"no, {found}", f"it would move, and was not allowed to: {CLEAR}")
        checklist.finish()
    try:
        perform(wire, activation(), pause)
    except ActivationError as error:
        checklist.refuse("active", f"{found}, and could not be activated", str(error))
        checklist.finish()
    checklist.ok("active", f"activated, was {found.partition(': ')[0]}")


def perform(wire: Wire, steps: Generator[Request | float, int | None, None], pause: Callable[[float], None]) -> None:
    """Send the requests of an activation, and sleep for yielded times in s.

    Raises:
        ActivationError: The activation failed.
        WireError: The server does not answer.
    """
    value: int | None = None
    while True:
        try:
            step = steps.send(value)
        except StopIteration:
            return
        value = None
        if isinstance(step, Request):
            value = wire.exchange(step)
        else:
            pause(step)


def _read(wire: Wire, variable: str) -> int:
    value = wire.exchange(get(variable))
    assert value is not None
    return value
