"""Allowed connections, alone and beside other clients."""

import rtde_control  # type: ignore[import-not-found]  # no stubs
import rtde_receive  # type: ignore[import-not-found]
from tests.ur.clients.scenario import START, Result, scenario


@scenario
def two_controls(host: str) -> Result:
    """Connect a second control client beside the first, which then disconnects and reconnects."""
    first = rtde_control.RTDEControlInterface(host)
    try:
        rtde_control.RTDEControlInterface(host)
        refused = ""
    except RuntimeError as error:
        refused = str(error)
    receive = rtde_receive.RTDEReceiveInterface(host)
    first.disconnect()
    receive.disconnect()
    states = [first.reconnect(), receive.reconnect(), first.moveJ(list(START), 0.5, 1.0)]
    first.stopScript()
    return {"refused": refused, "states": states}


@scenario
def upper_registers(host: str) -> Result:
    """Connect a control client in the upper range of the registers."""
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
    flags |= rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
    control = rtde_control.RTDEControlInterface(host, 500.0, flags)
    moved = control.moveJ([*START[:5], 0.1], 2.0, 8.0)
    offset = control.getTCPOffset()
    control.stopScript()
    return {"moved": moved, "offset": offset}


@scenario
def connect_control(host: str) -> Result:
    """Connect only."""
    try:
        control = rtde_control.RTDEControlInterface(host)
    except RuntimeError as error:
        return {"refused": str(error)}
    control.stopScript()
    return {"refused": ""}
