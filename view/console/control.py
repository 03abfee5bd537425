"""Requests of a page to the control sockets of live sides."""

import asyncio
import contextlib
import json
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from haptether.view.console.pair import Pair, side_id

ANSWER_S = 1.0
"""Timeout of an answer in s; the answering thread waits at most 0.3 s, for a stop."""
MAX_ANSWER = 1 << 13
RETRY_S = 0.01
"""Delay in s before a request without an answer is retried."""
MAX_TRIES = 100
"""Attempts for a stop; the timeout ends them earlier."""
KEEP_S = 0.5
"""Interval in s of status requests on a connection kept for a stop."""


class Asked(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Request of a page."""

    id: int
    """Identifier chosen by the page; the answer repeats it."""
    side: Annotated[str, msgspec.Meta(pattern=r"^([a-z]{1,16}\.)?(master|slave)$")]
    """Identifier of the side, see `side_id`."""
    do: Literal[
        "status", "hold", "let_go", "release", "acknowledge",
        "force_scale", "torque_scale", "position_scale", "rotation_scale", "coupling",
    ]  # fmt: skip
    held_ms: int | None = None
    token: int | None = None
    scale: float | None = None
    kind: str | None = None

    def request(self) -> dict[str, Any]:
        """Return the request in the form of the control socket."""
        given = {"held_ms": self.held_ms, "token": self.token, "scale": self.scale, "kind": self.kind}
        return {"do": self.do} | {name: value for name, value in given.items() if value is not None}


class ControlConnection:
    """Connection of one page to one control socket; a hold ends with its connection.

    Args:
        path: Socket of `--control`.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._streams: tuple[asyncio.StreamReader, asyncio.StreamWriter] | None = None

    async def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Return the answer to a request; on failure return the reason and close the connection.

        A side closes its idlest connection when there are too many. Such a request is retried on a new connection, a
        stop for up to a second. Requests are idempotent.
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
        """Close the connection, which also ends a hold."""
        if self._streams is not None:
            with contextlib.suppress(OSError):
                self._streams[1].close()
            self._streams = None


class StopConnections:
    """Permanent connections to all control sockets, so that a stop never waits for one.

    Args:
        pairs: Pairs with the sockets of `--control`.
    """

    def __init__(self, pairs: Iterable[Pair]) -> None:
        self._paths = {path: pair.name for pair in pairs for path in pair.control}
        self._kept: dict[Path, ControlConnection] = {}
        self.sides: dict[str, Path] = {}
        """Control sockets by the identifier of their side."""

    async def keep(self) -> None:
        """Request the status of each side, which connects to new sides and keeps connections active."""
        await asyncio.gather(*map(self._keep, self._paths))

    async def _keep(self, path: Path) -> None:
        connection = self._take(path)
        try:
            answer = await connection.ask({"do": "status"})
        finally:
            self._kept[path] = connection
        if answer.get("done"):
            self.sides[side_id(self._paths[path], str(answer.get("side")))] = path

    def _take(self, path: Path) -> ControlConnection:
        """Take the kept connection for one request; create another while it is in use."""
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
