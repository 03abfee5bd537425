"""Benches: the compared programs run on the same processors."""

import argparse
import io
import itertools
import multiprocessing
import os
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from _report import add_number, bench_options, in_turns, print_table

BENCHES = Path(__file__).resolve().parents[2] / "benches"


@pytest.fixture
def round_trip(monkeypatch: pytest.MonkeyPatch) -> Any:  # noqa: ANN401  # the module is outside a package
    monkeypatch.syspath_prepend(str(BENCHES))
    return pytest.importorskip("round_trip")


@pytest.mark.live
@pytest.mark.parametrize("name", ["Python socket", "asyncio"])
def test_who_pings_and_who_answers_are_pinned_while_they_do(
    round_trip: Any,  # noqa: ANN401  # the module is outside a package
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    before = os.sched_getaffinity(0)
    near, far = min(before), max(before)
    answer, ping = round_trip.PEERS[name]
    seen = []

    def look(port: int, pings: int) -> Any:  # noqa: ANN401  # an array
        (child,) = multiprocessing.active_children()
        assert child.pid is not None
        seen.append((os.sched_getaffinity(0), os.sched_getaffinity(child.pid)))
        return ping(port, pings)

    monkeypatch.setitem(round_trip.PEERS, name, (answer, look))
    taken = round_trip.measured(name, 100, (near, far))
    assert len(taken) == 100
    assert seen == [({near}, {far})]
    assert os.sched_getaffinity(0) == before


@pytest.mark.parametrize("text", ["0", "0,", "a,b", "0,1,2", "0,1000000"])
def test_cpus_that_there_are_not_are_refused(round_trip: Any, text: str) -> None:  # noqa: ANN401  # as above
    with pytest.raises(argparse.ArgumentTypeError, match=f"{text}: must be two of 0"):
        round_trip.two_cpus(text)


@pytest.mark.parametrize("default", [5, 5.0])
@pytest.mark.parametrize(("given", "is_taken"), [("2", True), ("9", True), ("1", False), ("10", False), ("nan", False)])
def test_a_number_outside_its_range_is_refused(
    default: float, given: str, *, is_taken: bool, capsys: pytest.CaptureFixture[str]
) -> None:
    options = bench_options(None, "")
    add_number(options, "--turns", default, "turns of each", least=2, most=9)
    if is_taken:
        assert options.parse_args(["--turns", given]).turns == type(default)(given)
        return
    with pytest.raises(SystemExit):
        options.parse_args(["--turns", given])
    assert f"argument --turns: {given}: must be at least 2" in capsys.readouterr().err or given == "nan"


def test_works_take_turns_by_a_clock_of_their_own() -> None:
    order: list[str] = []
    clock = itertools.count(step=7)
    works = {name: partial(order.append, name) for name in "ab"}
    assert in_turns(works, range(3), clock.__next__) == {"a": [7, 7, 7], "b": [7, 7, 7]}
    assert order == ["a", "b"] * 3


def test_columns_of_numbers_are_aligned_to_the_right_and_words_to_the_left() -> None:
    out = io.StringIO()
    print_table(("", "us", "load", "note"), [("ours", "1.5", None, "met"), ("theirs", 22, 0.1, "missed")], out)
    assert out.getvalue().splitlines() == [
        "         us  load  note",
        "ours    1.5     -  met",
        "theirs   22   0.1  missed",
    ]
