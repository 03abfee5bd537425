"""Requests of a page to sides that answer late, or not at all."""

import asyncio
import json
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import pytest

from haptether.view.trial.hand import AGED, MAX_AGE_US, Aim, Grip, PageHand, Push

GRIP = {"do": "aim", "target": [0.0], "stiffness": 300.0, "damping": 8.0, "strength_n": 12.0}
PUSH = {"do": "push", "force": [3.5], "duration_s": 0.5}
LATE_S = 1.5e-6 * MAX_AGE_US


class Side:
    """Control socket of a side that takes all requests."""

    def __init__(self) -> None:
        self.status_s = 0.0
        """Time in s to answer a status."""
        self.taken: list[dict[str, Any]] = []
        self.took: list[tuple[Aim | Push, dict[str, int]]] = []
        self.is_open = True
        self.tasks: set[asyncio.Task[Any] | None] = set()

    async def answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.tasks.add(asyncio.current_task())
        while line := await reader.readline():
            request = json.loads(line)
            if request["do"] == "status":
                await asyncio.sleep(self.status_s)
            else:
                self.taken.append(request)
            answer = {"to": request["do"], "done": True, "token": len(self.taken), "ticks": 7, "text": ""}
            writer.write(json.dumps(answer).encode() + b"\n")
        writer.close()
        await writer.wait_closed()


def run(folder: Path, acts: Callable[[PageHand, Side], Coroutine[Any, Any, None]], *, answers: bool = True) -> Side:
    """Run a page against one side; return the side."""
    side = Side()

    async def served() -> None:
        path = folder / "side"
        server = await asyncio.start_unix_server(side.answer, path)
        async with server:
            hand = PageHand(
                Grip(), lambda _: path if answers else None, ("left",),
                lambda asked, ticks: side.took.append((asked, ticks)), lambda: side.is_open,
            )  # fmt: skip
            await acts(hand, side)
            hand.close()
            await asyncio.gather(*(task for task in side.tasks if task is not None))

    asyncio.run(served())
    return side


@pytest.mark.parametrize("request_", [GRIP, PUSH], ids=["grip", "push"])
def test_a_request_that_ages_while_a_side_is_asked_is_not_sent(tmp_path: Path, request_: dict[str, Any]) -> None:
    async def acts(hand: PageHand, side: Side) -> None:
        side.status_s = LATE_S
        answer = await hand.answer(json.dumps({**request_, "token": hand.token()}))
        assert (answer["done"], answer["text"]) == (False, f"left: {AGED}")
        # The hand opens all the same.
        side.status_s = 0.0
        assert (await hand.answer(json.dumps({**GRIP, "strength_n": 0.0, "token": answer["token"]})))["done"]

    side = run(tmp_path, acts)
    assert [request["do"] for request in side.taken] == ["aim"]
    assert side.taken[0]["strength_n"] == 0.0


def test_a_request_of_a_closed_page_is_not_sent(tmp_path: Path) -> None:
    async def acts(hand: PageHand, side: Side) -> None:
        side.is_open = False
        for request in (GRIP, PUSH):
            assert not (await hand.answer(json.dumps({**request, "token": hand.token()})))["done"]

    assert run(tmp_path, acts).taken == []


def test_a_page_uses_the_token_of_the_answer_before(tmp_path: Path) -> None:
    async def acts(hand: PageHand, side: Side) -> None:
        first = hand.token()
        assert (await hand.answer(json.dumps({**GRIP, "token": first})))["done"]
        for token in (first, 2**62, 0):
            for request in (GRIP, PUSH):
                refused = await hand.answer(json.dumps({**request, "token": token}))
                assert "the page was late" in refused["text"]
        assert (await hand.answer(json.dumps({**GRIP, "token": refused["token"]})))["done"]
        assert len(side.taken) == 2

    run(tmp_path, acts)


def test_a_grip_that_no_side_took_holds_nothing(tmp_path: Path) -> None:
    async def acts(hand: PageHand, side: Side) -> None:
        answer = await hand.answer(json.dumps({**GRIP, "token": hand.token()}))
        assert "does not answer" in answer["text"]
        assert not hand.is_gripping
        # It was never closed, so it need not open.
        answer = await hand.answer(json.dumps({**GRIP, "token": answer["token"]}))
        assert "does not answer" in answer["text"]
        assert [ticks for _, ticks in side.took] == [{}, {}]

    run(tmp_path, acts, answers=False)


def test_a_grip_that_the_sides_lose_must_open_first(tmp_path: Path) -> None:
    async def acts(hand: PageHand, side: Side) -> None:
        answer = await hand.answer(json.dumps({**GRIP, "token": hand.token()}))
        assert hand.is_gripping
        side.is_open = False
        answer = await hand.answer(json.dumps({**GRIP, "token": answer["token"]}))
        assert not hand.is_gripping
        side.is_open = True
        answer = await hand.answer(json.dumps({**GRIP, "token": answer["token"]}))
        assert "let go, and grip again" in answer["text"]
        answer = await hand.answer(json.dumps({**GRIP, "strength_n": 0.0, "token": answer["token"]}))
        assert (await hand.answer(json.dumps({**GRIP, "token": answer["token"]})))["done"]

    run(tmp_path, acts)
