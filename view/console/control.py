"""Requests of a page to the control sockets of live sides."""

import asyncio
import contextlib
import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import msgspec

ANSWER_S = 1.0
"""Timeout of an answer; the answering thread waits only for a stop, 0.3 s."""
MAX_ANSWER = 1 << 13
RETRY_S = 0.01
MAX_TRIES = 100
"""Attempts of a stop; the timeout comes first."""
KEEP_S = 0.5
"""Interval of status requests on a connection kept for stops."""


class Asked(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Request of a page."""

    id: int
    """Chosen by the page; the answer carries it."""
    side: Literal["master", "slave"]
    do: Literal[
        "status", "hold", "let_go", "release", "acknowledge",
        "force_scale", "torque_scale", "position_scale", "rotation_scale",
    ]  # fmt: skip
    held_ms: int | None = None
    token: int | None = None
    scale: float | None = None

    def request(self) -> dict[str, Any]:
        """The request as the control socket reads it."""
        given = {"held_ms": self.held_ms, "token": self.token, "scale": self.scale}
        return {"do": self.do} | {name: value for name, value in given.items() if value is not None}


class ControlConnection:
    """Connection of one page to one control socket; closing it ends its hold.

    Args:
        path: The socket given with `--control`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a request; on failure, return the reason and close the connection.

        A side closes the most idle of too many connections. A request that meets this is repeated on a new connection,
        a stop for up to a second. Requests are idempotent.
        """
        text = "no answer within a second: the side hangs"
        try:
            async with asyncio.timeout(ANSWER_S):
                for _ in range(MAX_TRIES if request["do"] == "stop" else 2):
                    try:
                        answer = await self._answer(request)
                    except (FileNotFoundError, ConnectionRefusedError) as error:
                        text = f"nobody answers at {self._path}: {error.strerror}"
                        break
                    except (OSError, ValueError) as error:
                        why = getattr(error, "strerror", None) or "the side has ended"
                        text = f"nobody answers at {self._path}: {why}"
                    else:
                        if answer.get("to") == request["do"]:
                            return answer
                        text = str(answer.get("text"))
                    self.close()
                    await asyncio.sleep(RETRY_S)
        except TimeoutError:
            pass
        self.close()
        return {"to": request["do"], "done": False, "text": text}

    async def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        if self._streams is None:
            self._streams = await asyncio.open_unix_connection(self._path, limit=MAX_ANSWER)
        reader, writer = self._streams
        writer.write(json.dumps(request).encode() + b"\n")
        await writer.drain()
        return msgspec.json.decode(await reader.readline(), type=dict[str, Any])

    def close(self) -> None:
        """Close the connection; also ends a hold."""
        if self._streams is not None:
            with contextlib.suppress(OSError):
                self._streams[1].close()
            self._streams = None


class StopConnections:
    """A connection to every control socket, opened in advance so that a stop never waits for the console.

    Args:
        paths: The sockets given with `--control`.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        self._paths = list(dict.fromkeys(paths))
        self._kept: dict[Path, ControlConnection] = {}
        self.sides: dict[str, Path] = {}
        """Control socket of each side that answers."""

    async def keep(self) -> None:
        """Ask each side for its status: connects sides that start later and keeps connections from being idle."""
        await asyncio.gather(*map(self._keep, self._paths))

    async def _keep(self, path: Path) -> None:
        connection = self._take(path)
        try:
            answer = await connection.ask({"do": "status"})
        finally:
            self._kept[path] = connection
        if answer.get("done"):
            self.sides[str(answer.get("side"))] = path

    def _take(self, path: Path) -> ControlConnection:
        """Take the connection for one request; a new one while it is in use."""
        return self._kept.pop(path, None) or ControlConnection(path)

    async def stop_all(self) -> dict[str, dict[str, Any]]:
        """Stop every side at once."""
        answers = await asyncio.gather(*map(self._stop, self._paths))
        return {str(path): answer for path, answer in zip(self._paths, answers, strict=True)}

    async def _stop(self, path: Path) -> dict[str, Any]:
        connection = self._take(path)
        answer = await connection.ask({"do": "stop"})
        connection.close()
        return answer

    def close(self) -> None:
        """Close all connections."""
        for connection in self._kept.values():
            connection.close()
