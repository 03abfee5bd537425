"""A client of the URCap's server that behaves like GELLO's gripper class, written without our driver.

It compares `ack` byte by byte and sets four variables at once. It waits without a time limit until PRE echoes, and then
until OBJ is no longer 0. It finds its range by opening and closing. The timeout of the socket belongs to the test.

Source: the description of wuphilipp/gello_software (MIT), by its behaviour on the wire.
"""

import socket
import time

ACK = b"ack"
OPENED, ACTIVE = 3, 3


class GelloClient:
    """Client that connects on construction.

    Args:
        host: The controller.
        port: Of the URCap's server.
        limit_s: Of each reply.
    """

    def __init__(self, host: str, port: int = 63352, limit_s: float = 5.0) -> None:
        self.lowest, self.highest = 0, 255
        self._socket = socket.create_connection((host, port), limit_s)

    def close(self) -> None:
        self._socket.close()

    def set_variables(self, **values: int) -> bool:
        pairs = " ".join(f"{name} {value}" for name, value in values.items())
        self._socket.sendall(f"SET {pairs}\n".encode())
        # The client takes the bytes of one call as the reply.
        return self._socket.recv(1024) == ACK

    def get_variable(self, name: str) -> int:
        self._socket.sendall(f"GET {name}\n".encode())
        named, value = self._socket.recv(1024).decode("utf-8").split()
        assert named == name, f"asked for {name}, and {named} came"
        return int(value)

    def reset(self) -> None:
        assert self.set_variables(ACT=0)
        assert self.set_variables(ATR=0)
        while self.get_variable("ACT") != 0 or self.get_variable("STA") != 0:
            assert self.set_variables(ACT=0)
            assert self.set_variables(ATR=0)
        time.sleep(0.5)

    def activate(self, *, calibrates: bool = True) -> None:
        if self.get_variable("STA") != ACTIVE:
            self.reset()
            assert self.set_variables(ACT=1)
            time.sleep(1.0)
            while self.get_variable("ACT") != 1 or self.get_variable("STA") != ACTIVE:
                time.sleep(0.01)
        if calibrates:
            self.calibrate()

    def calibrate(self) -> None:
        position, status = self.move_and_wait(0, 64, 1)
        assert status == OPENED, f"opening: OBJ {status}"
        position, status = self.move_and_wait(255, 64, 1)
        assert status == OPENED, f"closing: OBJ {status}"
        self.highest = position
        position, status = self.move_and_wait(0, 64, 1)
        assert status == OPENED, f"opening again: OBJ {status}"
        self.lowest = position

    def move(self, position: int, speed: int, force: int) -> tuple[bool, int]:
        within = [min(max(0, value), 255) for value in (position, speed, force)]
        within[0] = min(max(within[0], self.lowest), self.highest)
        done = self.set_variables(POS=within[0], SPE=within[1], FOR=within[2], GTO=1)
        time.sleep(0.008)
        return done, within[0]

    def move_and_wait(self, position: int, speed: int, force: int) -> tuple[int, int]:
        done, requested = self.move(position, speed, force)
        assert done, "no ack"
        while self.get_variable("PRE") != requested:
            time.sleep(0.001)
        while (status := self.get_variable("OBJ")) == 0:
            pass
        return self.get_variable("POS"), status
