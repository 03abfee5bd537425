"""Starts and changes of several pairs, without processes."""

import time
from pathlib import Path
from typing import Any

import pytest
from tests.view.trial.tried import CHOICE, NAMES, Running

from haptether.cli.view.trial import bridges
from haptether.cli.view.trial.bridges import TrialBridges
from haptether.view.trial.server import Network

FIRST = Network(delay_s=0.02, jitter_s=0.001, loss=0.0)
NEXT = Network(delay_s=0.1, jitter_s=0.001, loss=0.0)


def stand_in(folder: Path) -> TrialBridges:
    return TrialBridges("try", (), FIRST, names=NAMES, folder=folder, record=None, stopped=Running())


@pytest.mark.parametrize("failure", [OSError("no answer"), ValueError("refused")])
def test_a_network_that_one_proxy_refuses_changes_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, failure: Exception
) -> None:
    delays: dict[str, float] = {}

    def ask(path: str, change: dict[str, Any], *, patience_s: float) -> dict[str, Any]:  # noqa: ARG001
        delay_s = change["forward"]["delay_s"]
        if "right" in path and delay_s == NEXT.delay_s:
            if isinstance(failure, OSError):
                raise failure
            return {"ok": False, "error": str(failure)}
        delays[Path(path).stem] = delay_s
        return {"ok": True}

    monkeypatch.setattr(bridges, "ask_control", ask)
    with stand_in(tmp_path) as found:
        with pytest.raises(type(failure), match=str(failure)):
            found.change(NEXT)
        assert delays == {"left": FIRST.delay_s, "right": FIRST.delay_s}
        assert found.network == FIRST


def test_a_failed_start_waits_for_every_pair(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Without it, another pair starts a process after all were ended."""
    over: list[str] = []

    def start(_: TrialBridges, pair: str, _choice: object) -> None:
        if pair == "left":
            message = "left did not start"
            raise RuntimeError(message)
        time.sleep(0.3)
        over.append(pair)

    monkeypatch.setattr(TrialBridges, "_start", start)
    with stand_in(tmp_path) as found:
        with pytest.raises(RuntimeError, match="left did not start"):
            found.start(CHOICE)
        assert over == ["right"]
