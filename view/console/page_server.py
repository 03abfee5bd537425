"""Server of the pages on live sides: files, messages to each page, and requests of pages."""

import asyncio
import contextlib
import json
import math
import os
import secrets
import socket
import threading
import time
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import msgspec

from haptether.view.console.connections import MAX_KNOWN, MAX_UNKNOWN, Connections
from haptether.view.console.control import KEEP_S, Asked, ControlConnection, StopConnections
from haptether.view.console.feed import Listener, SideFeed
from haptether.view.console.guard import Guard
from haptether.view.console.pair import Pair
from haptether.view.console.recorder import FlightWatch
from haptether.view.console.rows import Rows

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute
    from starlette.types import Scope
    from starlette.websockets import WebSocket

HERE = Path(__file__).parent
SHARED = {
    "operator.js": HERE / "operator.js",
    "sides.js": HERE / "sides.js",
    "charts.js": HERE / "charts.js",
    "recorder.js": HERE / "recorder.js",
    "console.css": HERE / "console.css",
    "uplot.js": HERE / "vendor/uPlot.iife.min.js",
    "uplot.css": HERE / "vendor/uPlot.min.css",
}
"""Files of every page by their address."""
KINDS = {".html": "text/html", ".js": "text/javascript", ".css": "text/css"}
ROW_S = 1.0 / 30
"""Interval in s of chart rows and of messages to a page."""
RECORDERS_S = 0.5
"""Interval in s between checks of the flight recorder files."""
ROWS = 150
"""Rows kept for a page; a slower page loses the oldest, counted."""
WORDS_EVERY = 3
"""Text and numbers beside the charts are sent with every third message."""
SEND_BUFFER = 1 << 16
"""System send buffer per page in bytes."""
MAX_PAGES = 8
MAX_ASKED = 32
"""Limit of queued requests of a page; a page with more is closed."""
MAX_MESSAGE = 4096
MAX_REASON = 123
"""Largest reason of a close in bytes."""
BACKLOG = 4
"""Connections accepted per round of the event loop; a request is read within a few rounds."""
WAITING = 512
"""Listen backlog."""
DESCRIPTORS = MAX_UNKNOWN + MAX_KNOWN + 4 * BACKLOG + 64
"""Largest number of descriptors: connections, those about to close, and two control sockets per page, stop connections,
telemetry and files.
"""
END_S = 0.3
"""Time in s to notify pages of the end."""


class PageServer:
    """Running sides shown to pages of this machine.

    A subclass adds files, routes, tasks and message parts of its own page.

    Args:
        pairs: Pairs of sides.
        files: Files of the page by their address, in addition to `SHARED`; "" is the page itself.
        listeners: Receivers of the telemetry by pair.
        port: Port on 127.0.0.1; 0 lets the system choose.

    Raises:
        OSError: The port is in use, or there are too few descriptors.
    """

    descriptors = DESCRIPTORS
    """Largest number of descriptors needed."""

    def __init__(self, pairs: Sequence[Pair], files: Mapping[str, Path], listeners: Mapping[str, Listener], *,
                 port: int = 0) -> None:  # fmt: skip
        _check_descriptors(self.descriptors)
        self._socket = socket.create_server(("127.0.0.1", port), backlog=BACKLOG)
        # Data that a page does not read waits here, not in the system.
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
        self.port: int = self._socket.getsockname()[1]
        self._token = secrets.token_urlsafe(24)
        self.feeds = [
            SideFeed(path, f"side {number}", listeners[pair.name], pair.name)
            for pair in pairs
            for number, path in enumerate(pair.telemetry, start=1)
        ]
        self._connections = Connections()
        self._controls = StopConnections(pairs)
        self._paths = {**SHARED, **files}
        self._files: dict[str, tuple[bytes, str]] = {}
        self._recorders = [FlightWatch(path, pair.name) for pair in pairs for path in pair.flight]
        self.flights: list[dict[str, Any]] = []
        """Flight records of the last hold or end of each side; the list is replaced on every write."""
        self.rows = Rows(ROWS)
        self._words: list[dict[str, Any]] = []
        self._pages = 0
        self._stopping: asyncio.Task[dict[str, dict[str, Any]]] | None = None
        """Latest stop; it continues if its page closes."""
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
                # The caller decides when to end.
                yield

            async def startup(self, sockets: list[socket.socket] | None = None) -> None:
                await super().startup(sockets)
                # `asyncio` accepts as many connections at once as its backlog; a larger backlog holds no descriptors
                # here.
                for listening in sockets or ():
                    listening.listen(WAITING)

        connections = self._connections

        class Counted(H11Protocol):
            def connection_made(self, transport: asyncio.Transport) -> None:  # type: ignore[override]  # as there
                super().connection_made(transport)
                # Every request has it in its scope, including a WebSocket.
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
            # Do not log paths, because they contain the token.
            access_log=False,
            log_level="error",
            server_header=False,
            timeout_graceful_shutdown=1,
        )
        server = Server(config)

        async def run() -> None:
            # Connect before serving, so that no request can take the resources of a stop.
            await self._controls.keep()
            works = (self._sample(), self._end(server, stopped), self._keep_controls(), *self.works())
            tasks = [asyncio.create_task(work) for work in works]
            try:
                await server.serve(sockets=[self._socket])
            finally:
                for task in tasks:
                    task.cancel()
                await asyncio.gather(*tasks, return_exceptions=True)
                self._controls.close()
                # The transports close in the next round of the event loop.
                await asyncio.sleep(0)

        self._files = _files(self._paths)
        threading.Thread(target=self._read_recorders, name="console-flights", daemon=True).start()
        for feed in self.feeds:
            feed.start()
        try:
            asyncio.run(run())
        finally:
            self._ended.set()
            for feed in self.feeds:
                feed.close()
            self._socket.close()

    def works(self) -> Iterable[Coroutine[Any, Any, None]]:
        """Return further tasks of the event loop; they end with the server."""
        return ()

    def routes(self) -> "Iterable[BaseRoute]":
        """Return further routes."""
        return ()

    def parts(self) -> dict[str, Any]:
        """Return message parts; a page receives each again once it is another object."""
        return {"flights": self.flights}

    def watched(self, *, by_pages: bool) -> None:
        """Take a note that the first page has opened or the last has closed."""

    async def _end(self, server: Any, stopped: Callable[[], bool]) -> None:  # noqa: ANN401  # of a library of an extra
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
                *(Route(f"/{name}", self._file) for name in self._paths),
                Route("/stop", self._stop, methods=["POST"]),
                WebSocketRoute("/live", self._live),
                *self.routes(),
            ]
        )

    async def _file(self, request: "Request") -> "Response":
        from starlette.responses import Response

        text, kind = self._files[request.url.path.strip("/")]
        return Response(text, media_type=kind)

    async def _stop(self, _: "Request") -> "Response":
        """Stop for a page whose WebSocket does not answer."""
        from starlette.responses import Response

        return Response(json.dumps(await self.stop()), media_type="application/json")

    async def _sample(self) -> None:
        """Sample one row of all sides, 30 times per second."""
        due = time.monotonic()
        while True:
            if self.rows.newest % WORDS_EVERY == 0:
                self._words = [feed.summary() for feed in self.feeds]
            row: dict[str, Any] = {"t": time.monotonic() - self._begun_s}
            for feed in self.feeds:
                if values := feed.take_row():
                    row[feed.id] = values
            self.rows.add(row)
            due = max(due + ROW_S, time.monotonic() - ROW_S)
            await asyncio.sleep(max(0.0, due - time.monotonic()))

    def _read_recorders(self) -> None:
        """Run on a thread that nothing waits for, so that a hanging disk delays neither a stop nor the end."""
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
        self.watched(by_pages=True)
        try:
            async with self.kept(page), _Page(page, self) as one:
                await one.serve()
        finally:
            self._pages -= 1
            self.watched(by_pages=self._pages > 0)

    @contextlib.asynccontextmanager
    async def kept(self, page: "WebSocket") -> AsyncIterator[None]:
        """Keep the connection of an open WebSocket inside the context."""
        self._connections.keep(page.scope["state"]["connection"])
        try:
            yield
        finally:
            self._connections.admit(page.scope["state"]["connection"], time.monotonic())

    def path_of(self, side: str) -> Path | None:
        """Return the control socket of a side by its identifier; None if it was not given or has not answered."""
        return self._controls.sides.get(side)

    def message_since(self, row: int) -> tuple[int, dict[str, Any]]:
        """Return the row number and the message that follow row `row`."""
        new, lost = self.rows.since(row)
        message: dict[str, Any] = {"kind": "rows", "rows": new, "lost": lost}
        if self.rows.newest // WORDS_EVERY != row // WORDS_EVERY:
            message["sides"] = self._words
        return self.rows.newest, message

    async def stop(self) -> dict[str, dict[str, Any]]:
        """Stop every controlled side, even if the requesting page disappears."""
        return await asyncio.shield(self.begin_stop())

    def begin_stop(self) -> "asyncio.Task[dict[str, dict[str, Any]]]":
        """Begin a stop, or return the running one."""
        if self._stopping is None or self._stopping.done():
            self._stopping = asyncio.create_task(self._controls.stop_all())
        return self._stopping


def _check_descriptors(needed: int) -> None:
    """Allocate as many descriptors as the server needs at most, and release them.

    Raises:
        OSError: There are too few descriptors.
    """
    taken: list[int] = []
    try:
        while len(taken) < needed:
            taken.append(os.open(os.devnull, os.O_RDONLY))
    except OSError as error:
        message = f"the console needs {needed} free descriptors, and {len(taken)} are left: raise `ulimit -n`"
        raise OSError(error.errno, message) from None
    finally:
        for descriptor in taken:
            os.close(descriptor)


def _files(paths: Mapping[str, Path]) -> dict[str, tuple[bytes, str]]:
    """Read the files of the page and their types before serving, so that no disk delays a stop."""
    found = {name: (path.read_bytes(), f"{KINDS[path.suffix]}; charset=utf-8") for name, path in paths.items()}
    text, kind = found[""]
    return {**found, "": (text.replace(b"COLOURS", json.dumps(_colours()).encode(), 1), kind)}


def _colours() -> dict[str, str]:
    """Return the chart colours, same as in figures."""
    from haptether.view.style.colours import AXES, CONTROLLERS, SIGNALS

    controllers = {name: colour for name, (colour, _) in CONTROLLERS.items()}
    return {**controllers, **SIGNALS, "safety": AXES[3]}


def close_reason(text: str) -> str:
    """Return a text cut to the length that a WebSocket may give as its reason.

    Source: RFC 6455, section 5.5.
    """
    return text.encode()[:MAX_REASON].decode(errors="ignore")


async def texts(page: "WebSocket") -> AsyncIterator[str]:
    """Yield the texts that a page sends until it is closed."""
    from starlette.websockets import WebSocketDisconnect

    with contextlib.suppress(WebSocketDisconnect, KeyError, RuntimeError):
        while True:
            yield await page.receive_text()


class _Page(contextlib.AbstractAsyncContextManager["_Page"]):
    """Open page; sending and receiving run in separate tasks."""

    def __init__(self, page: "WebSocket", server: PageServer) -> None:
        self._page = page
        self._server = server
        self._asked: asyncio.Queue[Asked] = asyncio.Queue(MAX_ASKED)
        self._connections: dict[str, ControlConnection] = {}
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()

    async def __aenter__(self) -> Self:
        for work in (self._show(), self._answer_all()):
            self._tasks.add(asyncio.create_task(work))
        return self

    async def __aexit__(self, *_: object) -> None:
        # A hold ends with its page.
        for connection in self._connections.values():
            connection.close()
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)

    async def serve(self) -> None:
        """Take requests of the page until it is closed."""
        async for text in texts(self._page):
            if text == '{"do":"stop"}':
                # Bypass the queue, and begin here because the awaiting task may be cancelled.
                stopping = self._server.begin_stop()
                task = asyncio.create_task(self._say_stopped(stopping))
                self._tasks.add(task)
                task.add_done_callback(self._tasks.discard)
                continue
            try:
                self._asked.put_nowait(msgspec.json.decode(text, type=Asked))
            except (msgspec.DecodeError, asyncio.QueueFull) as error:
                reason = "too many requests" if isinstance(error, asyncio.QueueFull) else f"no request: {error}"
                await self._page.close(1008, close_reason(reason))
                return

    async def _send(self, message: dict[str, Any]) -> None:
        from starlette.websockets import WebSocketDisconnect

        with contextlib.suppress(WebSocketDisconnect, RuntimeError):
            async with self._sending:
                await self._page.send_text(json.dumps(message, separators=(",", ":")))

    async def _show(self) -> None:
        row, shown = self._server.rows.newest, dict[str, Any]()
        while True:
            # Blocks while the page does not read; the missed rows are counted.
            row, message = self._server.message_since(row)
            parts = self._server.parts()
            message |= {name: part for name, part in parts.items() if part is not shown.get(name)}
            shown = parts
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
            path = self._server.path_of(asked.side)
            if path is None:
                text = f"no --control of the {asked.side} was given, or nobody answers there"
                return {"to": asked.do, "done": False, "text": text}
            self._connections[asked.side] = ControlConnection(path)
        return await self._connections[asked.side].ask(asked.request())
