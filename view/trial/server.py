"""Server of `haptether try`: one page for several pairs, whose hand is a pointer."""

import asyncio
import contextlib
import json
import time
from collections.abc import Callable, Coroutine, Iterable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Protocol

import msgspec
from msgspec import Meta, Struct
from msgspec.structs import asdict

from haptether.bridge import TelemetryHello, TelemetryMessage
from haptether.view.console.page_server import DESCRIPTORS, MAX_MESSAGE, MAX_PAGES, PageServer, close_reason, texts
from haptether.view.console.pair import Pair
from haptether.view.trial.hand import Aim, Grip, PageHand, Push
from haptether.view.trial.releases import Releases

if TYPE_CHECKING:
    from starlette.requests import Request
    from starlette.responses import Response
    from starlette.routing import BaseRoute
    from starlette.websockets import WebSocket

HERE = Path(__file__).parent
FILES = {
    "": HERE / "page.html",
    "try.css": HERE / "try.css",
    **{f"{name}.js": HERE / f"{name}.js" for name in ("hand", "pad", "lessons", "try")},
}
MAX_SIDES = 4
STOPPED = "STOP was pressed before the bridges had started: press Restart"
MIN_WALL, MAX_WALL = 10.0, 1000.0
"""Bounds of the stiffness of the wall in N/m."""
MAX_DELAY_S, MAX_JITTER_S, MAX_LOSS = 0.5, 0.05, 0.5
"""Bounds of the network; the lower ones are 0."""


class Network(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Network of all pairs, the same each way."""

    delay_s: Annotated[float, Meta(ge=0.0, le=MAX_DELAY_S)] = 0.05
    """Mean delay in s."""
    jitter_s: Annotated[float, Meta(ge=0.0, le=MAX_JITTER_S)] = 0.005
    """Standard deviation of the delay in s."""
    loss: Annotated[float, Meta(ge=0.0, le=MAX_LOSS)] = 0.01
    """Probability of loss."""


class Choice(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Settings of the bridges that a restart applies."""

    wall_stiffness: Annotated[float, Meta(ge=MIN_WALL, le=MAX_WALL)] = 100.0
    """Stiffness of the wall in N/m."""
    controllers: dict[str, str] = {}
    """Controller by pair; "none" for none."""


class Bridges(Protocol):
    """Pairs of processes behind the page. All calls may block for seconds."""

    @property
    def pairs(self) -> tuple[Pair, ...]:
        """Pairs with their sockets, whose paths are the same after a restart."""

    @property
    def controllers(self) -> tuple[str, ...]:
        """Possible controllers of a pair."""

    def start(self, choice: Choice) -> None:
        """End the sides of all pairs that run, and start them; their clutches are open.

        Raises:
            RuntimeError: A side did not start.
        """

    def change(self, network: Network) -> None:
        """Change the network of all pairs.

        Raises:
            OSError: A proxy does not answer.
        """


class Record(Protocol):
    """Record of the acts of a person. No call may wait for a disk."""

    def took(self, asked: Aim | Push, ticks: dict[str, int]) -> None:
        """Take an aim or a push with the ticks of the sides that accepted it, by pair."""

    def opened(self, after_s: float) -> None:
        """Open the hands this time in s after the last aim, because their page has closed."""

    def hear(self, pair: str, hello: TelemetryHello, message: TelemetryMessage | None) -> None:
        """Take a message of a side, or the start of its run."""

    def change(self, network: Network) -> None:
        """Take a change of the network."""


class Trial(PageServer):
    """Several pairs, led by the pointer of one page.

    Args:
        bridges: Processes behind the page.
        choice: First settings.
        network: First network.
        record: Record of what a person does; None without one.
        port: Port on 127.0.0.1; 0 lets the system choose.

    Raises:
        OSError: The port is in use, or there are too few descriptors.
    """

    descriptors = DESCRIPTORS + 2 * MAX_PAGES * MAX_SIDES
    """Each page has two connections to every side: one for commands, one for its hand."""

    def __init__(self, bridges: Bridges, choice: Choice, network: Network, *, record: Record | None = None,
                 port: int = 0) -> None:  # fmt: skip
        self._bridges = bridges
        self._names = tuple(pair.name for pair in bridges.pairs)
        self._record = record
        self._releases = Releases(self._names)
        self._grip = Grip()
        self._aiming = 0
        self._is_gripped = False
        self._aimed_s = 0.0
        """Monotonic time in s of the last aim that a side took."""
        self._stops = 0
        """Number of stops requested."""
        self._choice, self._network = choice, network
        self._phase = ("running", "")
        self._changing = asyncio.Lock()
        super().__init__(bridges.pairs, FILES, {name: partial(self._hear, name) for name in self._names}, port=port)
        self._state = self._shown()

    def routes(self) -> "Iterable[BaseRoute]":
        """Return the routes of the hand and of the settings."""
        from starlette.routing import Route, WebSocketRoute

        return [
            WebSocketRoute("/hand", self._hand),
            Route("/restart", self._restart, methods=["POST"]),
            Route("/network", self._set_network, methods=["POST"]),
        ]

    def parts(self) -> dict[str, Any]:
        """Return measurements and settings."""
        return {**super().parts(), "releases": self._releases.rows, "trial": self._state}

    def _hear(self, pair: str, hello: TelemetryHello, message: TelemetryMessage | None = None, /) -> None:
        self._releases.take(pair, hello, message)
        if self._record is not None:
            self._record.hear(pair, hello, message)

    def _shown(self) -> dict[str, Any]:
        phase, text = self._phase
        return {
            "phase": phase,
            "text": text,
            "pairs": self._names,
            "controllers": self._bridges.controllers,
            "choice": asdict(self._choice),
            "network": asdict(self._network),
        }

    def _enter(self, phase: str, text: str = "") -> None:
        self._phase = (phase, text)
        self._state = self._shown()

    def _took(self, asked: Aim | Push, ticks: dict[str, int]) -> None:
        if self._record is not None:
            self._record.took(asked, ticks)
        if isinstance(asked, Push):
            self._releases.begin("push", dict.fromkeys(ticks), asdict(self._network))
        else:
            if self._is_gripped and asked.strength_n == 0.0:
                self._releases.begin("let go", ticks, asdict(self._network))
            self._is_gripped = bool(ticks) and asked.strength_n > 0.0
            if ticks:
                self._aimed_s = time.monotonic()

    def _took_away(self) -> None:
        """Record and measure the release of a hand whose page has closed."""
        self._is_gripped = False
        if self._record is not None:
            self._record.opened(time.monotonic() - self._aimed_s)
        self._releases.begin("let go", dict.fromkeys(self._names), asdict(self._network))

    async def _hand(self, page: "WebSocket") -> None:
        """Take aims and pushes of a page, each with the token of the last answer; at its end the hands open."""
        from starlette.websockets import WebSocketDisconnect

        await page.accept()
        if self._aiming >= MAX_PAGES:
            await page.close(1013, f"{MAX_PAGES} pages are open: close one")
            return
        self._aiming += 1
        connection = page.scope["state"]["connection"]
        hand = PageHand(self._grip, self.path_of, self._names, self._took, lambda: not connection.is_closing())
        try:
            async with self.kept(page):
                with contextlib.suppress(WebSocketDisconnect, RuntimeError):
                    await self._lead(page, hand)
        finally:
            if hand.is_gripping:
                self._took_away()
            hand.close()
            self._aiming -= 1

    async def _lead(self, page: "WebSocket", hand: PageHand) -> None:
        await page.send_text(json.dumps({"to": "begin", "done": True, "text": "", "token": hand.token()}))
        async for text in texts(page):
            try:
                answer = await hand.answer(text)
            except msgspec.DecodeError as error:
                await page.close(1008, close_reason(f"no request: {error}"))
                return
            await page.send_text(json.dumps(answer))

    async def _restart(self, request: "Request") -> "Response":
        """Restart all pairs with other settings, disengaged."""
        return await self._carried_out(request, Choice, partial(self._started, self._stops))

    def begin_stop(self) -> "asyncio.Task[dict[str, dict[str, Any]]]":
        """Begin a stop, or return the running one; a restart that was requested before ends with a stop, too."""
        self._stops += 1
        return super().begin_stop()

    async def _started(self, stops: int, choice: Choice) -> None:
        names, possible = set(self._names), self._bridges.controllers
        if set(choice.controllers) != names or not set(choice.controllers.values()) <= set(possible):
            message = f"controllers = {choice.controllers}: must be for each of {', '.join(sorted(names))} one of "
            raise ValueError(message + ", ".join(possible))
        if self._stops != stops:
            raise RuntimeError(STOPPED)
        self._enter("restarting")
        try:
            await asyncio.to_thread(self._bridges.start, choice)
        except Exception as error:
            self._enter("failed", str(error))
            raise RuntimeError(str(error)) from error
        self._choice = choice
        self._is_gripped = False
        self._grip.lapse()
        self._enter("running")
        if self._stops != stops:
            # The stop came before the sides had sockets. A stop that is still under way may have missed them.
            await self.stop()
            await self.stop()
            raise RuntimeError(STOPPED)

    async def _set_network(self, request: "Request") -> "Response":
        return await self._carried_out(request, Network, self._networked)

    async def _networked(self, network: Network) -> None:
        await asyncio.to_thread(self._bridges.change, network)
        self._network = network
        if self._record is not None:
            self._record.change(network)
        self._enter(*self._phase)

    async def _carried_out(
        self, request: "Request", kind: type[Any], work: Callable[[Any], Coroutine[Any, Any, None]]
    ) -> "Response":
        """Carry out one change at a time, even if its page closes; answer with `done` and `text`."""
        from starlette.requests import ClientDisconnect
        from starlette.responses import Response

        async def locked(change: object) -> None:
            async with self._changing:
                await work(change)

        text = ""
        try:
            body = b""
            async for part in request.stream():
                body += part
                if len(body) > MAX_MESSAGE:
                    message = f"request: longer than {MAX_MESSAGE} bytes"
                    raise ValueError(message)
            await asyncio.shield(asyncio.create_task(locked(msgspec.json.decode(body, type=kind))))
        except (msgspec.DecodeError, ValueError, OSError, RuntimeError) as error:
            text = str(error)
        except ClientDisconnect:
            text = "the page has closed"
        return Response(json.dumps({"done": not text, "text": text}), media_type="application/json")
