"""The record of a trial: aims, clutch and pushes become a scene that repeats them."""

import threading
from collections.abc import Callable
from pathlib import Path

import pytest

from haptether.bridge import (
    TelemetryChange,
    TelemetryEnd,
    TelemetryHello,
    TelemetrySample,
    load_scene,
    override_scene,
    simulate,
)
from haptether.cli.view.trial.record import LONGEST_S, TrialRecord
from haptether.private_file import write_private
from haptether.studies.task import Task
from haptether.view.trial.hand import Aim, Push
from haptether.view.trial.server import Choice, Network

PERIOD_NS = 1_000_000
WRITE = "haptether.cli.view.trial.record.write_private"


class StandIn:
    """Bridges without processes."""

    runs = 1
    network = Network(delay_s=0.0, jitter_s=0.0, loss=0.0)
    choice = Choice(controllers={"left": "wsc", "right": "wsc"})

    def changes(self, _pair: str, _choice: Choice) -> tuple[str, ...]:
        return ('safety.controllers=["wsc"]',)


def hello(side: str, process: int = 0) -> TelemetryHello:
    return TelemetryHello(schema=1, side=side, security="secure", process=process, signals=[])


def change(tick: int, signal: str, to: str | bool) -> TelemetryChange:
    return TelemetryChange(time_ns=tick * PERIOD_NS, signal=signal, from_=not to, to=to)


def sample(tick: int) -> TelemetrySample:
    return TelemetrySample(time_ns=tick * PERIOD_NS, ticks=16, dropped=0, unsent_changes=0, signals={})


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


def test_hands_of_a_task_hold_along_the_recorded_grips(recorded: Callable[[bool], Path]) -> None:
    """`evaluate` lets many hands follow the aims, and lets go by itself."""
    path = recorded(False)
    task = Task(str(path), 0.1)
    assert any("along the aims of its grips" in remark for remark in task.replaced())
    held, repeated = simulate(task.held), simulate(path)
    assert not [event for event in held.events if event.kind == "release"]
    assert held.metrics.peak_device_force == pytest.approx(repeated.metrics.peak_device_force, rel=0.2)
    speeds = [run.metrics.max_ejection_velocity or 0.0 for run in (held, repeated)]
    assert speeds[0] < 0.3 * speeds[1]


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


def aim(target: float = 0.02, strength_n: float = 12.0) -> Aim:
    return Aim(token=0, target=(target,), stiffness=300.0, damping=8.0, strength_n=strength_n)


def push(force_n: float) -> Push:
    return Push(token=0, force=(force_n,), duration_s=2.0)


def end() -> TelemetryEnd:
    return TelemetryEnd(time_ns=400 * PERIOD_NS)


def begun(folder: Path, *overrides: str, pairs: tuple[str, ...] = ("left",)) -> tuple[TrialRecord, StandIn]:
    """Return a record of pairs that are engaged and pressed, each with one aim."""
    bridges = StandIn()
    record = TrialRecord(bridges, override_scene(load_scene("try"), overrides), folder)
    for pair in pairs:
        for side in ("slave", "master"):
            record.hear(pair, hello(side, 1), None)
        record.hear(pair, hello("master", 1), change(100, "clutch", to=True))
        record.hear(pair, hello("slave", 1), change(200, "state", to="engaged"))
    record.took(aim(), dict.fromkeys(pairs, 300))
    return record, bridges


def rows(folder: Path, name: str = "left") -> list[list[float]]:
    """Return times and strengths of the recorded aims."""
    lines = (folder / f"{name}-aims.csv").read_text(encoding="utf-8").splitlines()[1:]
    cells = [line.split(",") for line in lines]
    return [[float(line[0]), float(line[-1])] for line in cells]


def test_a_hanging_disk_holds_up_no_aim(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    answers, reached = threading.Event(), threading.Event()

    def slow(path: Path, content: bytes) -> None:
        reached.set()
        assert answers.wait(2.0)
        write_private(path, content)

    monkeypatch.setattr(WRITE, slow)
    record, bridges = begun(tmp_path)
    record.hear("left", hello("master", 1), end())
    assert reached.wait(20.0)
    record.took(aim(), {"left": 320})
    record.change(Network())
    record.hear("left", hello("master", 1), change(400, "clutch", to=False))
    # The disk has not answered yet.
    assert not (tmp_path / "left-aims.csv").exists()
    answers.set()
    record.close()
    assert bridges.runs == 1
    assert rows(tmp_path) == [[0.3, 12.0]]


def test_a_disk_that_never_answers_is_reported(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answers = threading.Event()
    monkeypatch.setattr(WRITE, lambda *_: answers.wait(20.0))
    monkeypatch.setattr("haptether.cli.view.trial.record.CLOSE_S", 0.2)
    record, _ = begun(tmp_path)
    record.close()
    assert "the disk does not answer" in capsys.readouterr().err
    answers.set()


def test_later_delays_are_repeated_and_other_changes_noted(tmp_path: Path) -> None:
    record, bridges = begun(tmp_path)
    for tick, network in (
        (2000, Network(delay_s=0.2, jitter_s=0.0, loss=0.0)),
        (2500, Network(delay_s=0.2, jitter_s=0.0, loss=0.0)),
        (3000, Network(delay_s=0.1, jitter_s=0.0, loss=0.1)),
    ):
        record.hear("left", hello("master", 1), sample(tick))
        record.change(network)
    record.took(aim(), {"left": 4000})
    record.close()
    scene = load_scene(tmp_path / "left.toml")
    assert scene.link is not None
    for link in (scene.link.forward, scene.link.backward):
        assert link is not None
        assert (link.delay_s, link.loss) == (bridges.network.delay_s, 0.0)
        assert [(one.at_s, one.delay_s) for one in link.timeline or ()] == [(2.0, 0.2), (3.0, 0.1)]
    assert "jitter or loss was changed later" in (tmp_path / "left.toml").read_text(encoding="utf-8")


def test_a_press_after_the_last_aim_is_repeated(tmp_path: Path) -> None:
    record, _ = begun(tmp_path)
    for tick, to in ((5000, False), (9000, True)):
        record.hear("left", hello("master", 1), change(tick, "clutch", to=to))
    record.close()
    scene = load_scene(tmp_path / "left.toml")
    assert scene.operator is not None
    assert scene.operator.clutch == ((0.1, 5.0), (9.0, 11.0))
    assert scene.run.duration_s == pytest.approx(11.0)


def test_a_pair_that_cannot_be_written_spares_the_other(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "left-aims.csv").mkdir()
    record, _ = begun(tmp_path, pairs=("left", "right"))
    record.close()
    assert "record: left: the aims are not kept: " in capsys.readouterr().err
    assert rows(tmp_path, "right") == [[0.3, 12.0]]
    assert load_scene(tmp_path / "right.toml").run.duration_s == pytest.approx(2.3)


def test_aims_of_a_new_master_are_not_of_the_old_run(tmp_path: Path) -> None:
    record, bridges = begun(tmp_path)
    bridges.runs = 2
    record.took(aim(), {"left": 10})
    record.hear("left", hello("master", 2), None)
    record.took(aim(strength_n=1.0), {"left": 20})
    record.close()
    assert rows(tmp_path) == [[0.3, 12.0]]
    assert rows(tmp_path, "left-2") == [[0.02, 1.0]]


def test_telemetry_that_connects_again_continues_the_run(tmp_path: Path) -> None:
    record, _ = begun(tmp_path)
    record.hear("left", hello("master", 1), None)
    record.took(aim(strength_n=1.0), {"left": 320})
    record.close()
    assert rows(tmp_path) == [[0.3, 12.0], [0.32, 1.0]]
    scene = load_scene(tmp_path / "left.toml")
    assert scene.operator is not None
    assert scene.operator.clutch == ((0.1, 2.32),)


def test_a_push_ends_at_the_next_and_counts_the_periods_of_the_slave(tmp_path: Path) -> None:
    record, _ = begun(tmp_path, "slave.period_s=0.002")
    for tick, force_n in ((500, 3.5), (750, 1.0), (750, 2.0), (3000, 4.0)):
        record.took(push(force_n), {"left": tick})
    record.close()
    scene = load_scene(tmp_path / "left.toml")
    assert scene.environment is not None
    pushers = scene.environment.pushers
    # The sides engaged 0.2 s after the slave's start.
    assert [one.at_s for one in pushers] == pytest.approx([0.8, 1.3, 5.8])
    assert [one.duration_s for one in pushers] == pytest.approx([0.5, 2.0, 2.0])
    assert [one.force_n for one in pushers] == [(3.5,), (2.0,), (4.0,)]
    assert scene.run.duration_s == pytest.approx(8.0)


@pytest.mark.parametrize(("after_s", "found"), [(0.1, [[0.3, 12.0], [0.4, 0.0]]), (0.5, [[0.3, 12.0]])])
def test_the_hand_of_a_closed_page_opens(tmp_path: Path, after_s: float, found: list[list[float]]) -> None:
    record, _ = begun(tmp_path)
    record.opened(after_s)
    # An open hand stays as it is.
    record.opened(after_s)
    record.close()
    assert rows(tmp_path) == [pytest.approx(row) for row in found]


def test_a_long_run_keeps_its_first_hour_and_says_so(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    record, _ = begun(tmp_path)
    record.took(aim(), {"left": round(LONGEST_S * 1e3) + 1})
    record.close()
    assert rows(tmp_path) == [[0.3, 12.0]]
    assert "acts after 3600 s are not recorded" in (tmp_path / "left.toml").read_text(encoding="utf-8")
    assert "left: the scene has the aims of the first 3600 s" in capsys.readouterr().err
