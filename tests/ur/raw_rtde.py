"""A small RTDE client from the guide alone: names without a trailing comma, PAUSE and START, several recipes."""

import socket
import struct
from typing import Any, Self

CODES = {
    "BOOL": "?", "UINT8": "B", "UINT32": "I", "UINT64": "Q", "INT32": "i", "DOUBLE": "d",
    "VECTOR3D": "3d", "VECTOR6D": "6d", "VECTOR6INT32": "6i", "VECTOR6UINT32": "6I",
}  # fmt: skip


def frame(kind: str, payload: bytes = b"") -> bytes:
    """Build a frame of the protocol."""
    return struct.pack(">HB", 3 + len(payload), ord(kind)) + payload


class Client:
    """One connection; every wait has a timeout."""

    def __init__(self, host: str, version: int = 2, patience_s: float = 5.0) -> None:
        self.socket = socket.create_connection((host, 30004), patience_s)
        self.socket.settimeout(patience_s)
        self.version = 1
        self._waiting = b""
        self._types: list[str] = []
        self._names: list[str] = []
        if version != 1:
            try:
                assert self.request("V", struct.pack(">H", version)) == b"\x01"
            except BaseException:
                self.socket.close()
                raise
            self.version = version

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.socket.close()

    def send(self, kind: str, payload: bytes = b"") -> None:
        """Send a frame."""
        self.socket.sendall(frame(kind, payload))

    def next(self) -> tuple[str, bytes]:
        """Return type and payload of the next frame; raise if the connection was closed."""
        while len(self._waiting) < 3 or len(self._waiting) < int.from_bytes(self._waiting[:2], "big"):
            received = self.socket.recv(1 << 16)
            if not received:
                raise ConnectionResetError
            self._waiting += received
        size = int.from_bytes(self._waiting[:2], "big")
        kind, payload = chr(self._waiting[2]), self._waiting[3:size]
        self._waiting = self._waiting[size:]
        return kind, payload

    def request(self, kind: str, payload: bytes = b"") -> bytes:
        """Send a request and return its answer; skip data packages before it."""
        self.send(kind, payload)
        while True:
            got, answer = self.next()
            if got == kind:
                return answer
            assert got == "U", f"a frame of type {got} before the answer to {kind}"

    def controller_version(self) -> tuple[int, ...]:
        """Return major, minor, bugfix and build."""
        return struct.unpack(">4I", self.request("v"))

    def outputs(self, names: list[str], rate_hz: float = 125.0) -> tuple[int | None, list[str]]:
        """Set up outputs; return the number of the recipe (None in version 1) and the types."""
        head = struct.pack(">d", rate_hz) if self.version == 2 else b""
        answer = self.request("O", head + ",".join(names).encode())
        number = answer[0] if self.version == 2 else None
        types = answer[1 if self.version == 2 else 0 :].decode().split(",")
        self._names, self._types = names, types
        return number, types

    def inputs(self, names: list[str]) -> tuple[int, list[str]]:
        """Set up inputs; return the number of the recipe and the types."""
        answer = self.request("I", ",".join(names).encode())
        return answer[0], answer[1:].decode().split(",")

    def start(self) -> bool:
        """Start the data packages."""
        return self.request("S") == b"\x01"

    def pause(self) -> bool:
        """Pause the data packages."""
        return self.request("P") == b"\x01"

    def write(self, recipe: int, types: str, *numbers: float) -> None:
        """Write inputs; `types` as in `struct`."""
        self.send("U", struct.pack(f">B{types}", recipe, *numbers))

    def package(self) -> dict[str, Any]:
        """Return the next data package."""
        kind, payload = self.next()
        assert kind == "U"
        if self.version == 2:
            assert payload[0] == 1
            payload = payload[1:]
        layout = ">" + "".join(CODES[name] for name in self._types)
        assert len(payload) == struct.calcsize(layout)
        values: dict[str, Any] = {}
        numbers = list(struct.unpack(layout, payload))
        for name, kind_name in zip(self._names, self._types, strict=True):
            count = int(CODES[kind_name][:-1] or 1)
            values[name] = numbers[0] if count == 1 else tuple(numbers[:count])
            del numbers[:count]
        return values

    def until(self, **wanted: object) -> dict[str, Any]:
        """Return the first package with these values."""
        for _ in range(5000):
            package = self.package()
            if all(package[name] == value for name, value in wanted.items()):
                return package
        message = f"{wanted} never arrived"
        raise TimeoutError(message)
