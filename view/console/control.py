"""Requests of a page at the control sockets of live sides."""

import asyncio
import contextlib
import json
from pathlib import Path
from typing import Any, Literal

import msgspec

ANSWER_S = 1.0
"""The thread that answers waits for nothing but a stop, and for that 0.3 s."""
MAX_ANSWER = 1 << 13


class Asked(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """What a page asks for."""

    id: int
    """Its own, which the answer bears."""
    side: Literal["master", "slave"]
    do: Literal[
        "status", "hold", "let_go", "release", "acknowledge",
        "force_scale", "torque_scale", "position_scale", "rotation_scale",
    ]  # fmt: skip
    held_ms: int | None = None
    token: int | None = None
    scale: float | None = None

    def request(self) -> dict[str, Any]:
        """As the control socket reads it."""
        given = {"held_ms": self.held_ms, "token": self.token, "scale": self.scale}
        return {"do": self.do} | {name: value for name, value in given.items() if value is not None}


class ControlConnection:
    """One page at one control socket: a hold belongs to its connection, and ends with it.

    Args:
        path: Of `--control`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """The answer to a request; one that there is no answer to says why, and closes the connection."""
        try:
            async with asyncio.timeout(ANSWER_S):
                if self._streams is None:
                    self._streams = await asyncio.open_unix_connection(self._path, limit=MAX_ANSWER)
                reader, writer = self._streams
                writer.write(json.dumps(request).encode() + b"\n")
                await writer.drain()
                line = await reader.readline()
                answer = json.loads(line)
                return dict(answer)
        except TimeoutError:
            text = "no answer within a second: the side hangs"
        except (OSError, ValueError) as error:
            text = f"nobody answers at {self._path}: {getattr(error, 'strerror', None) or 'the side has ended'}"
        self.close()
        return {"to": request.get("do", ""), "done": False, "text": text}

    def close(self) -> None:
        """Ends a hold, too."""
        if self._streams is not None:
            with contextlib.suppress(OSError):
                self._streams[1].close()
            self._streams = None


async def stop_all(paths: "dict[str, Path]") -> dict[str, dict[str, Any]]:
    """Stops every side at once, each by a connection of its own, behind no other request."""

    async def stop(path: Path) -> dict[str, Any]:
        connection = ControlConnection(path)
        answer = await connection.ask({"do": "stop"})
        connection.close()
        return answer

    answers = await asyncio.gather(*(stop(path) for path in paths.values()))
    return dict(zip(paths, answers, strict=True))
