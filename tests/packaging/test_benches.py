"""Benches: the compared programs run on the same processors."""

import argparse
import multiprocessing
import os
from pathlib import Path
from typing import Any

import pytest

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
