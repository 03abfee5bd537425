"""Sessions of RTDE with an emulated controller, byte by byte and without a socket."""

import struct
from collections.abc import Iterable
from typing import TYPE_CHECKING

from tests.ur.raw_rtde import frame

from haptether.slave.ur_emulator import ControllerVersion
from haptether.slave.ur_emulator.rtde.session import RtdeSession
from haptether.slave.ur_emulator.rtde.variables import RtdeInputs, inputs_of, outputs_of

if TYPE_CHECKING:
    from haptether.slave.ur_emulator.rtde.variables import Value

E_SERIES = ControllerVersion(5, 11, 10, 108)
CB3 = ControllerVersion(3, 15, 8, 106339)


class Controller:
    """State that connections share."""

    def __init__(self, version: ControllerVersion = E_SERIES) -> None:
        self.version = version
        self.inputs = RtdeInputs(inputs_of(version))
        self.types = outputs_of(version)
        self.outputs: dict[str, Value] = {name: kind.zero for name, kind in self.types.items()}
        self.log: list[str] = []
        self._numbers = iter(range(1, 100))

    def session(self, protocol: int = 2) -> RtdeSession:
        rate_hz = self.version.rate_hz
        number = next(self._numbers)
        session = RtdeSession(
            number, rate_hz, lambda: self.version, self.inputs, self.outputs, self.types, self.log.append
        )
        if protocol == 2:
            assert session.receive(frame("V", b"\x00\x02")) == frame("V", b"\x01")
        return session


def outputs_request(names: Iterable[str], rate_hz: float = 500.0) -> bytes:
    return frame("O", struct.pack(">d", rate_hz) + ",".join(names).encode())


def inputs_request(names: Iterable[str]) -> bytes:
    return frame("I", ",".join(names).encode())
