"""Server of the console: its files, its messages to each page, and requests of pages."""

import asyncio
import contextlib
import json
import math
import os
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import msgspec

from haptether.view.console.bodies import Bodies
from haptether.view.console.connections import MAX_KNOWN, MAX_UNKNOWN, Connections
from haptether.view.console.control import KEEP_S, Asked, ControlConnection, StopConnections
from haptether.view.console.feed import SideFeed
from haptether.view.console.guard import Guard
from haptether.view.console.recorder import FlightWatch
from haptether.view.console.rows import Rows

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.types import Scope
    from starlette.websockets import WebSocket

FILES = {
    "": ("page.html", "text/html; charset=utf-8"),
    "console.js": ("console.js", "text/javascript; charset=utf-8"),
    "renderer.js": ("../page/renderer.js", "text/javascript; charset=utf-8"),
    "ends.js": ("ends.js", "text/javascript; charset=utf-8"),
    "recorder.js": ("recorder.js", "text/javascript; charset=utf-8"),
    "console.css": ("console.css", "text/css; charset=utf-8"),
    "uplot.js": ("vendor/uPlot.iife.min.js", "text/javascript; charset=utf-8"),
    "uplot.css": ("vendor/uPlot.min.css", "text/css; charset=utf-8"),
}
ROW_S = 1.0 / 30
"""Period of chart rows and of messages to a page."""
RECORDERS_S = 0.5
"""Period at which flight recorder files are checked."""
ROWS = 150
"""Rows kept for a page; a slower page loses the oldest, and the loss is counted."""
WORDS_EVERY = 3
"""Every third message carries the words and numbers beside the charts."""
SEND_BUFFER = 1 << 16
"""Bytes that the system buffers for a page."""
MAX_PAGES = 8
MAX_ASKED = 32
"""Pending requests of a page; one more closes the page."""
MAX_MESSAGE = 4096
BACKLOG = 4
"""Connections accepted per round of the event loop; a request is read within a few rounds."""
WAITING = 512
"""Connections in the system's accept queue."""
DESCRIPTORS = MAX_UNKNOWN + MAX_KNOWN + 4 * BACKLOG + 64
"""Most descriptors in use: connections, those still closing, two control sockets for each page and for stops,
telemetry, files.
"""
END_S = 0.3
"""Time to tell the pages of the end."""


class Console:
    """Live sides, shown to pages of this machine.

    Args:
        telemetry: Sockets of `--telemetry`.
        control: Sockets of `--control`; each side says which it is.
        flight: Files of `--flight`.
        port: Port on 127.0.0.1; 0 lets the system choose.

    Raises:
        OSError: The port is taken, or there are too few descriptors.
    """

    def __init__(self, telemetry: Sequence[Path], control: Sequence[Path], *, flight: Sequence[Path] = (),
                 port: int = 0) -> None:  # fmt: skip
        _check_descriptors()
        self._socket = socket.create_server(("127.0.0.1", port), backlog=BACKLOG)
        # Small send buffer: rows for a slow page wait in `Rows`, not in the system.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self.port: int = self._socket.getsockname()[1]
        self._token = secrets.token_urlsafe(24)
        self.bodies = Bodies()
        self.feeds = [SideFeed(path, f"side {number}", self.bodies) for number, path in enumerate(telemetry, start=1)]
        self._connections = Connections()
        self._controls = StopConnections(control)
        self._files: dict[str, tuple[bytes, str]] = {}
        self._recorders = [FlightWatch(path) for path in flight]
        self.flights: list[dict[str, Any]] = []
        """Recording of each side at its last hold or end; a new list after each write."""
        self.rows = Rows(ROWS)
        self._words: list[dict[str, Any]] = []
        self._pages = 0
        self._stopping: asyncio.Task[dict[str, dict[str, Any]]] | None = None
        """The newest stop; it continues when its page closes."""
        self._begun_s = time.monotonic()
        self._ended = threading.Event()

    @property
    def address(self) -> str:
        """Address for the browser."""
        return f"http://127.0.0.1:{self.port}/{self._token}/"

    def serve(self, stopped: Callable[[], bool]) -> None:
        """Serve until `stopped` returns True; the loops of the sides are not affected."""
        import uvicorn
        from uvicorn.protocols.http.h11_impl import H11Protocol

        class Server(uvicorn.Server):
            @contextlib.contextmanager
            def capture_signals(self) -> Iterator[None]:
                # Signals are the caller's: `stopped` ends the server.
                yield

            async def startup(self, sockets: list[socket.socket] | None = None) -> None:
                await super().startup(sockets)
                # `asyncio` accepts as many per round as `backlog`. A longer system queue holds no descriptors here.
                for listening in sockets or ():
                    listening.listen(WAITING)

        connections = self._connections

        class Counted(H11Protocol):
            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as in uvicorn
                super().connection_made(transport)
                # The scope of each request, WebSockets included, carries it.
                self.app_state = {"connection": transport}
                connections.add(transport, time.monotonic())

        def admit(scope: "Scope") -> None:
            connections.admit(scope["state"]["connection"], time.monotonic())

        config = uvicorn.Config(
            Guard(self._application(), self.port, self._token, admit),
            http=Counted,
            backlog=BACKLOG,
            ws="websockets-sansio",
            ws_max_size=MAX_MESSAGE,
            ws_per_message_deflate=False,
            lifespan="off",
            # No access log: the path holds the token.
            access_log=False,
            log_level="error",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        server = Server(config)

        async def run() -> None:
            # Connect the stops before serving, so that no request can take their descriptors.
            await self._controls.keep()
            works = (self._sample(), self._end(server, stopped), self._keep_controls())
            tasks = [asyncio.create_task(work) for work in works]
            try:
                await server.serve(sockets=[self._socket])
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                self._controls.close()
                # The connections close in the next round of the event loop.
                await asyncio.sleep(0)

        self._files = _files()
        self.bodies.start()
        threading.Thread(target=self._read_recorders, name="console-flights", daemon=True).start()
        for feed in self.feeds:
            feed.start()
        try:
            asyncio.run(run())
        finally:
            self._ended.set()
            for feed in self.feeds:
                feed.close()
            self.bodies.close()
            self._socket.close()

    async def _end(self, server: Any, stopped: Callable[[], bool]) -> None:  # noqa: ANN401  # type of an optional library
        while not stopped():
            self._connections.close_late(time.monotonic())
            await asyncio.sleep(0.05)
        server.should_exit = True
        await asyncio.sleep(END_S)
        # Do not wait for a page that reads nothing.
        self._connections.close_late(math.inf)

    async def _keep_controls(self) -> None:
        while True:
            await asyncio.sleep(KEEP_S)
            await self._controls.keep()

    def _application(self) -> "Starlette":
        from starlette.applications import Starlette
        from starlette.routing import Route, WebSocketRoute

        return Starlette(
            routes=[
                *(Route(f"/{name}", self._file) for name in FILES),
                Route("/bodies", self._geometry),
                Route("/stop", self._stop, methods=["POST"]),
                WebSocketRoute("/live", self._live),
            ]
        )

    async def _file(self, request: "Request") -> "Response":
        from starlette.responses import Response

        text, kind = self._files[request.url.path.strip("/")]
        return Response(text, media_type=kind)

    async def _geometry(self, _: "Request") -> "Response":
        from starlette.responses import Response

        return Response(self.bodies.geometry, media_type="application/json")

    async def _stop(self, _: "Request") -> "Response":
        """Stop by HTTP, for a page whose WebSocket does not answer."""
        from starlette.responses import Response

        return Response(json.dumps(await self.stop()), media_type="application/json")

    async def _sample(self) -> None:
        """Add a row of all sides 30 times a second."""
        due = time.monotonic()
        while True:
            if self.rows.newest % WORDS_EVERY == 0:
                self._words = [feed.summary() for feed in self.feeds]
            row: dict[str, Any] = {"t": time.monotonic() - self._begun_s}
            for feed in self.feeds:
                if values := feed.take_row():
                    row[feed.side] = values
            self.rows.add(row)
            due = max(due + ROW_S, time.monotonic() - ROW_S)
            await asyncio.sleep(max(0.0, due - time.monotonic()))

    def _read_recorders(self) -> None:
        """Run on a thread that nothing waits for: a hung disk delays neither a stop nor the end."""
        while not self._ended.wait(RECORDERS_S):
            news = [one.read() for one in self._recorders]
            if any(news):
                self.flights = [one.content for one in self._recorders if one.content is not None]

    async def _live(self, page: "WebSocket") -> None:
        await page.accept()
        if self._pages >= MAX_PAGES:
            await page.send_text(json.dumps({"kind": "refused", "text": f"{MAX_PAGES} pages are open: close one"}))
            await page.close(1013)
            return
        self._pages += 1
        self.bodies.is_watched = True
        self._connections.keep(page.scope["state"]["connection"])
        try:
            async with _Page(page, self) as one:
                await one.serve()
        finally:
            self._connections.admit(page.scope["state"]["connection"], time.monotonic())
            self._pages -= 1
            self.bodies.is_watched = self._pages > 0

    def path_of(self, side: str) -> Path | None:
        """Control socket of a side; None if none was given or it has not answered."""
        return self._controls.sides.get(side)

    def message_since(self, row: int) -> tuple[int, dict[str, Any]]:
        """Newest row number, and the message for a page that has rows up to `row`."""
        new, lost = self.rows.since(row)
        message: dict[str, Any] = {"kind": "rows", "rows": new, "lost": lost}
        if self.rows.newest // WORDS_EVERY != row // WORDS_EVERY:
            message["sides"] = self._words
        return self.rows.newest, message

    async def stop(self) -> dict[str, dict[str, Any]]:
        """Stop every controlled side, even if the requesting page closes."""
        return await asyncio.shield(self.begin_stop())

    def begin_stop(self) -> "asyncio.Task[dict[str, dict[str, Any]]]":
        """Begin a stop, or return the stop in progress."""
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.create_task(self._controls.stop_all())
        return self._stopping


def _check_descriptors() -> None:
    """Check that enough descriptors are free, by opening and closing that many.

    Raises:
        OSError: There are too few.
    """
    taken: list[int] = []
    try:
        while len(taken) < DESCRIPTORS:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        message = f"the console needs {DESCRIPTORS} free descriptors, and {len(taken)} are left: raise `ulimit -n`"
        raise OSError(error.errno, message) from None
    finally:
        for descriptor in taken:
            os.close(descriptor)


def _files() -> dict[str, tuple[bytes, str]]:
    """Read the page's files and types in advance: no disk delays a stop."""
    found = {path: ((Path(__file__).parent / name).read_bytes(), kind) for path, (name, kind) in FILES.items()}
    text, kind = found[""]
    return {**found, "": (text.replace(b"COLOURS", json.dumps(_colours()).encode(), 1), kind)}


def _colours() -> dict[str, str]:
    """Colours of the charts, the same as in every figure."""
    from haptether.view.style.colours import AXES, CONTROLLERS, SIGNALS

    controllers = {name: colour for name, (colour, _) in CONTROLLERS.items()}
    return {**controllers, **SIGNALS, "safety": AXES[3]}


class _Page(contextlib.AbstractAsyncContextManager["_Page"]):
    """An open page: its messages and its requests, each in its own task."""

    def __init__(self, page: "WebSocket", console: Console) -> None:
        self._page = page
        self._console = console
        self._asked: asyncio.Queue[Asked] = asyncio.Queue(MAX_ASKED)
        self._connections: dict[str, ControlConnection] = {}
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        for work in (self._show(), self._answer_all()):
            self._tasks.add(asyncio.create_task(work))
        return self

    async def __aexit__(self, *_: object) -> None:
        for connection in self._connections.values():
            connection.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def serve(self) -> None:
        """Take the page's requests until it closes."""
        async for text in self._texts():
            if text == '{"do":"stop"}':
                # A stop skips the request queue. It starts here because the task that awaits its answer may be
                # cancelled.
                stopping = self._console.begin_stop()
                task = asyncio.create_task(self._say_stopped(stopping))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
                continue
            try:
                self._asked.put_nowait(msgspec.json.decode(text, type=Asked))
            except (msgspec.DecodeError, asyncio.QueueFull) as error:
                reason = "too many requests" if isinstance(error, asyncio.QueueFull) else f"no request: {error}"
                await self._page.close(1008, reason[:100])
                return

    async def _texts(self) -> AsyncIterator[str]:
        from starlette.websockets import WebSocketDisconnect

        with contextlib.suppress(WebSocketDisconnect, KeyError, RuntimeError):
            while True:
                yield await self._page.receive_text()

    async def _send(self, message: dict[str, Any]) -> None:
        from starlette.websockets import WebSocketDisconnect

        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            async with self._sending:
                await self._page.send_text(json.dumps(message, separators=(",", ":")))

    async def _show(self) -> None:
        row, drawn, explained = self._console.rows.newest, None, None
        while True:
            # A page that does not read blocks here; the rows that it misses are counted.
            row, message = self._console.message_since(row)
            frame = self._console.bodies.frame
            if frame is not drawn:
                message["bodies"] = drawn = frame
            if (flights := self._console.flights) is not explained:
                message["flights"] = explained = flights
            await self._send(message)
            await asyncio.sleep(ROW_S)

    async def _say_stopped(self, stopping: "asyncio.Task[dict[str, dict[str, Any]]]") -> None:
        await self._send({"kind": "stopped", "answers": await asyncio.shield(stopping)})

    async def _answer_all(self) -> None:
        while True:
            asked = await self._asked.get()
            answer = await self._answer(asked)
            await self._send({"kind": "answer", "id": asked.id, **answer})

    async def _answer(self, asked: Asked) -> dict[str, Any]:
        if asked.side not in self._connections:
            path = self._console.path_of(asked.side)
            if path is None:
                text = f"no --control of the {asked.side} was given, or nobody answers there"
                return {"to": asked.do, "done": False, "text": text}
            self._connections[asked.side] = ControlConnection(path)
        return await self._connections[asked.side].ask(asked.request())
