"""Who may connect, and beside whom."""

import rtde_control  # type: ignore[import-not-found]  # they have no stubs
import rtde_receive  # type: ignore[import-not-found]
from tests.ur.clients.scenario import START, Result, scenario


@scenario
def two_controls(host: str) -> Result:
    """A second control client beside a first, which then goes and comes back."""
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
    """A control client in the upper range of the registers."""
    flags = rtde_control.RTDEControlInterface.FLAG_UPLOAD_SCRIPT
    flags |= rtde_control.RTDEControlInterface.FLAG_UPPER_RANGE_REGISTERS
    control = rtde_control.RTDEControlInterface(host, 500.0, flags)
    moved = control.moveJ([*START[:5], 0.1], 2.0, 8.0)
    offset = control.getTCPOffset()
    control.stopScript()
    return {"moved": moved, "offset": offset}


@scenario
def connect_control(host: str) -> Result:
    """Only connects."""
    try:
        control = rtde_control.RTDEControlInterface(host)
    except RuntimeError as error:
        return {"refused": str(error)}
    control.stopScript()
    return {"refused": ""}
