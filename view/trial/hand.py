"""Hand of a page: its aims and pushes, forwarded to every pair."""

import asyncio
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from haptether.view.console.control import ControlConnection

EXPIRES_S = 0.4
"""Time in s after the last aim at which the hand opens; also the largest age of a page's token."""
MAX_AGE_US = round(EXPIRES_S * 1e6)
TOKEN_S = 0.3
"""Time in s for which a token of a side is used; the side accepts it for 0.4 s."""
OVER_S = 1.0 / 30
"""Duration in s of the leg to each target."""
NOT_THERE = "does not answer: it has ended, or is starting"
LATE = "the page was late: the hand has opened; let go, and grip again"
AGED = "took too long to answer, or the page has closed: once more"
Components = Annotated[tuple[Annotated[float, Meta(ge=-1e3, le=1e3)], ...], Meta(min_length=1, max_length=3)]
Bounded = Annotated[float, Meta(ge=0.0, le=1e4)]


class Aim(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="do", tag="aim"):
    """Target and grip of the hand; strength 0 is an open hand. The sides check the bounds."""

    token: int
    """Token of the last answer."""
    target: Components
    """Target in m."""
    stiffness: Bounded
    """K_h in N/m."""
    damping: Bounded
    """B_h in N s/m."""
    strength_n: Bounded
    """Grip strength in N."""


class Push(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True, tag_field="do", tag="push"):
    """Push of the remote arms."""

    token: int
    force: Components
    """Force on the tool in N."""
    duration_s: Bounded


def now_us() -> int:
    """Return the time of the tokens in us; it advances while the machine sleeps."""
    return time.clock_gettime_ns(time.CLOCK_BOOTTIME) // 1000


def is_late(asked: Aim | Push, at_us: int, issued: int | None) -> bool:
    """Return True if the token of a request is not the one issued last, or too old."""
    return asked.token != issued or at_us - asked.token > MAX_AGE_US


class Grip:
    """Decides whether an aim of a page may grip: at most one page aims, and a lapsed grip must open first.

    Times are in us on any clock.
    """

    def __init__(self) -> None:
        self._owner: object = None
        self._last_us = -MAX_AGE_US
        self._closed: set[object] = set()
        """Pages that must open before they grip, unless they hold the stylus."""

    def refusal(self, page: object, aim: Aim, at_us: int, issued: int | None) -> str | None:
        """Return the reason to refuse an aim, or None and take it; `issued` is the last token of the page."""
        gap_us = at_us - self._last_us
        if self._owner not in (page, None) and gap_us <= MAX_AGE_US:
            return "another page holds the stylus"
        if aim.strength_n > 0.0:
            # A late aim may still open the hand.
            if is_late(aim, at_us, issued):
                return LATE
            if page in self._closed and (self._owner is not page or gap_us > MAX_AGE_US):
                return "the aims stopped for more than 0.4 s: the hand has opened; let go, and grip again"
            self._closed.add(page)
        else:
            self._closed.discard(page)
        self._owner, self._last_us = page, at_us
        return None

    def is_gripping(self, page: object) -> bool:
        """Return True if a page holds the stylus."""
        return self._owner is page and page in self._closed

    def lapse(self, page: object = None) -> None:
        """Take the stylus from a page, by default from any; the page must open before it grips again."""
        if page in (self._owner, None):
            self._owner = None

    def leave(self, page: object) -> None:
        """Forget a page that has closed, or has not gripped."""
        self._closed.discard(page)
        if self._owner is page:
            self._owner = None


class SideHand:
    """Requests with tokens at one side, on a connection of its own: closing it opens the hand.

    Args:
        path: Socket of `--control`.
    """

    def __init__(self, path: Path) -> None:
        self._connection = ControlConnection(path)
        self._token: int | None = None
        self._until_s = 0.0

    async def ask(self, request: dict[str, Any], may_send: Callable[[], bool]) -> dict[str, Any]:
        """Return the answer to a request, sent with the newest token of the side.

        A side may take a second to give a token, so `may_send` is called just before the request is sent.
        """
        if self._token is None or time.monotonic() > self._until_s:
            status = await self._connection.ask({"do": "status"})
            if not status.get("done"):
                return {"done": False, "text": NOT_THERE}
            self._keep(status)
        if not may_send():
            return {"done": False, "text": AGED}
        answer = await self._connection.ask({**request, "token": self._token})
        self._keep(answer)
        return answer

    def _keep(self, answer: dict[str, Any]) -> None:
        # A refused request has no token: the next one begins with a status.
        self._token = answer.get("token")
        self._until_s = time.monotonic() + TOKEN_S

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()


class PageHand:
    """Forwards the aims and pushes of a page to all bridges.

    Args:
        grip: Shared by all pages.
        path_of: Returns the control socket of a side, None without one.
        pairs: Names of the pairs.
        took: Called with each aim or push and the ticks of the sides that accepted it, by pair.
        is_open: Returns True while the page is connected.
    """

    def __init__(self, grip: Grip, path_of: Callable[[str], Path | None], pairs: tuple[str, ...],
                 took: Callable[[Aim | Push, dict[str, int]], None], is_open: Callable[[], bool]) -> None:  # fmt: skip
        self._grip = grip
        self._path_of = path_of
        self._pairs = pairs
        self._took = took
        self._is_open = is_open
        self._hands: dict[str, SideHand] = {}
        self._token: int | None = None

    @property
    def is_gripping(self) -> bool:
        """True if the page holds the stylus."""
        return self._grip.is_gripping(self)

    def token(self) -> int:
        """Return the token of the next request; it replaces the one before."""
        self._token = now_us()
        return self._token

    async def answer(self, text: str) -> dict[str, Any]:
        """Return the answer to a request of the page, with the token of the next one.

        Raises:
            msgspec.DecodeError: Not a request.
        """
        asked = msgspec.json.decode(text, type=Aim | Push)
        was_gripping = self.is_gripping
        is_opening = isinstance(asked, Aim) and asked.strength_n == 0.0
        if isinstance(asked, Aim):
            refused = self._grip.refusal(self, asked, now_us(), self._token)
            side, values = "master", msgspec.structs.asdict(asked) | {"do": "aim", "over_s": OVER_S}
        else:
            refused = "the page was late: once more" if is_late(asked, now_us(), self._token) else None
            side, values = "slave", msgspec.structs.asdict(asked) | {"do": "push"}
        answers: Mapping[str, dict[str, Any]] = {}
        if refused is None:
            del values["token"]

            def may_send() -> bool:
                return is_opening or (self._is_open() and not is_late(asked, now_us(), self._token))

            found = await asyncio.gather(*(self._ask(f"{pair}.{side}", values, may_send) for pair in self._pairs))
            answers = dict(zip(self._pairs, found, strict=True))
            ticks = {pair: answer["ticks"] for pair, answer in answers.items() if answer["done"]}
            self._took(asked, ticks)
            if isinstance(asked, Aim) and not ticks:
                (self._grip.lapse if was_gripping else self._grip.leave)(self)
            texts = {name: answer["text"] for name, answer in answers.items() if not answer["done"]}
            refused = "; ".join(f"{name}: {text}" for name, text in texts.items()) or None
        return {"to": values["do"], "done": refused is None, "text": refused or "", "token": self.token()}

    async def _ask(self, side: str, values: dict[str, Any], may_send: Callable[[], bool]) -> dict[str, Any]:
        if side not in self._hands:
            path = self._path_of(side)
            if path is None:
                return {"done": False, "text": NOT_THERE}
            self._hands[side] = SideHand(path)
        return await self._hands[side].ask(values, may_send)

    def close(self) -> None:
        """Close all connections, which opens the hands."""
        self._grip.leave(self)
        for hand in self._hands.values():
            hand.close()
