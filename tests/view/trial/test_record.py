"""The record of a trial: aims, clutch and pushes become a scene that repeats them."""

from collections.abc import Callable
from pathlib import Path

import pytest

from haptether.bridge import TelemetryChange, TelemetryHello, load_scene, simulate
from haptether.cli.view.trial.record import TrialRecord
from haptether.view.trial.hand import Aim, Push
from haptether.view.trial.server import Choice, Network

PERIOD_NS = 1_000_000


class StandIn:
    """Bridges without processes."""

    runs = 1
    network = Network(delay_s=0.0, jitter_s=0.0, loss=0.0)
    choice = Choice(controllers={"left": "wsc"})

    def changes(self, _pair: str, _choice: Choice) -> tuple[str, ...]:
        return ('safety.controllers=["wsc"]',)


def hello(side: str) -> TelemetryHello:
    return TelemetryHello(schema=1, side=side, security="secure", signals=[])


def change(tick: int, signal: str, to: str | bool) -> TelemetryChange:
    return TelemetryChange(time_ns=tick * PERIOD_NS, signal=signal, from_=not to, to=to)


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[[bool], Path]:
    def record(is_pushed: bool) -> Path:
        record = TrialRecord(StandIn(), load_scene("try"), tmp_path)
        for side in ("slave", "master"):
            record.hear("left", hello(side), None)
        record.hear("left", hello("master"), change(100, "clutch", to=True))
        # The slave began 50 ticks earlier.
        record.hear("left", hello("slave"), change(160, "state", to="engaged"))
        for tick in range(300, 2000, 20):
            target = 0.02 - 0.065 * min(1.0, (tick - 300) / 1000)
            aim = Aim(token=0, target=(target,), stiffness=300.0, damping=8.0, strength_n=12.0 * (tick < 1900))
            record.took(aim, {"left": tick, "right": tick})
        if is_pushed:
            record.took(Push(token=0, force=(3.5,), duration_s=0.5), {"left": 1160})
        record.close()
        return tmp_path / "left.toml"

    return record


def test_a_recorded_release_throws_the_stylus_when_it_was_let_go(recorded: Callable[[bool], Path]) -> None:
    path = recorded(False)
    scene = load_scene(path)
    assert scene.run.duration_s == pytest.approx(1.98 + 2.0)
    run = simulate(path)
    time_s, position, speed = (run.signals[name] for name in ("time_s", "position", "velocity"))
    assert position[time_s < 1.9].min() < -0.03
    assert 1.9 < time_s[abs(speed).argmax()] < 2.1


def test_a_folder_can_be_moved(recorded: Callable[[bool], Path], tmp_path: Path) -> None:
    path = recorded(False)
    moved = tmp_path / "moved"
    moved.mkdir()
    for one in (path, path.with_name("left-aims.csv")):
        one.rename(moved / one.name)
    assert load_scene(moved / "left.toml").operator is not None


def test_a_recorded_push_counts_from_the_engagement(recorded: Callable[[bool], Path]) -> None:
    scene = load_scene(recorded(True))
    assert scene.environment is not None
    (push,) = scene.environment.pushers
    assert push.at_s == pytest.approx(1.0)
    assert (push.duration_s, push.force_n) == (0.5, (3.5,))
