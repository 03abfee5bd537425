"""States of a soft stop: the transitions between its phases, and their absence for all other events."""

from collections.abc import Callable, Iterator
from typing import Any

import pytest
from tests.ur.fake_rtde import PLAYING, START_POSE, START_Q, STOPPED

from haptether.slave.ur.modes import ServoL
from haptether.slave.ur.motion import Motion
from haptether.slave.ur.options import ur_options
from haptether.slave.ur.state import UrState
from haptether.slave.ur.stop import STILL_S, Phase, SoftStop
from haptether.slave.ur.worker import Call


class Connection:
    """A connection that makes no call by itself."""

    def __init__(self) -> None:
        self.worker: Any = self
        self.control: Any = object()
        self.idled: Call | None = None
        self.stuck: Call | None = None
        self.started: list[Call] = []
        self.streamed: list[str] = []

    def stream(self, name: str, _order: object, _idle: object) -> None:
        self.streamed.append(name)

    def start(self, name: str, order: Callable[[Any], bool], limit_s: float) -> Call:
        self.started.append(Call(name, lambda: order(None), limit_s))
        return self.started[-1]

    def pause(self) -> Call:
        """Make the call of its thread during silence."""
        self.idled = Call("stop", lambda: True, 1.0)
        self.idled.perform()
        return self.idled

    def cut(self) -> None:
        self.control = None


class Stopped:
    """A soft stop with its packages."""

    def __init__(self) -> None:
        self.connection = Connection()
        self.soft_stop = SoftStop(self.connection, "127.0.0.1", lambda _: None)  # type: ignore[arg-type]
        self._timestamp = 10.0

    def state(self, qd: float = 0.0, runtime_state: int = PLAYING) -> UrState:
        """Return the next package."""
        self._timestamp += 0.002
        six = (0.0,) * 6
        return UrState(
            self._timestamp, START_Q, START_Q, (qd, *six[1:]), START_POSE, six, six, 7, 1, 1, runtime_state, 1.0
        )

    def package(self, *, qd: float = 0.0, runtime_state: int = PLAYING, stale: bool = False) -> str | None:
        """Check a package; return the fault."""
        return self.soft_stop.check(self.state(qd, runtime_state), stale=stale)

    def rests(self) -> None:
        """Send packages of joints that rest just long enough."""
        for _ in range(int(STILL_S / 0.002) + 2):
            assert self.package() is None

    @property
    def phase(self) -> Phase:
        return self.soft_stop.phase

    def stop(self) -> Call:
        self.soft_stop.stop(lambda _: True)
        return self.connection.started[-1]


@pytest.fixture
def stopped(monkeypatch: pytest.MonkeyPatch) -> Iterator[Stopped]:
    monkeypatch.setattr("haptether.slave.ur.stop.end_program", lambda _: None)
    stopped = Stopped()
    yield stopped
    stopped.soft_stop.close()


def test_an_arm_is_at_rest_once_its_stop_was_answered_and_its_joints_rested(stopped: Stopped) -> None:
    soft_stop = stopped.soft_stop
    assert (stopped.phase, soft_stop.ready, soft_stop.commanded, soft_stop.heard) == (Phase.AT_REST, True, False, False)
    soft_stop.begin()
    assert (stopped.phase, soft_stop.ready, soft_stop.commanded, soft_stop.heard) == (Phase.MOVING, True, True, True)
    call = stopped.stop()
    # The joints rest, but the library has not answered: a package may be older than the stop.
    stopped.rests()
    assert (stopped.phase, soft_stop.ready, soft_stop.commanded, soft_stop.heard) == (
        Phase.STOPPING,
        False,
        False,
        True,
    )
    call.perform()
    assert not soft_stop.heard
    assert stopped.package(qd=0.3) is None
    assert stopped.phase is Phase.STOPPING
    stopped.rests()
    assert (stopped.phase, soft_stop.ready) == (Phase.AT_REST, True)


def test_nothing_is_stopped_that_is_not_led(stopped: Stopped) -> None:
    stopped.soft_stop.stop(lambda _: True)
    assert stopped.connection.started == []
    assert stopped.phase is Phase.AT_REST


def test_a_pause_ends_with_the_next_command_and_the_next_silence_is_another(stopped: Stopped) -> None:
    soft_stop = stopped.soft_stop
    soft_stop.begin()
    for _ in range(2):
        stopped.connection.pause()
        soft_stop.update()
        assert (stopped.phase, soft_stop.ready, soft_stop.commanded) == (Phase.PAUSING, False, True)
        # The watchdog hears nothing else meanwhile.
        assert not soft_stop.heard
        stopped.rests()
        assert (stopped.phase, soft_stop.ready, soft_stop.commanded) == (Phase.PAUSED, True, True)
        soft_stop.begin()
        assert stopped.phase is Phase.MOVING
    assert stopped.connection.started == []


def test_what_is_read_of_a_pause_does_not_change_it(stopped: Stopped) -> None:
    soft_stop = stopped.soft_stop
    soft_stop.begin()
    stopped.connection.pause()
    for _ in range(2):
        assert (stopped.phase, soft_stop.ready, soft_stop.stopping, soft_stop.heard) == (
            Phase.MOVING,
            True,
            False,
            True,
        )
    # A package shows it as well.
    assert stopped.package(qd=0.3) is None
    assert (stopped.phase, soft_stop.ready, soft_stop.stopping, soft_stop.heard) == (Phase.PAUSING, False, True, False)


def test_nothing_is_commanded_while_the_arm_pauses(stopped: Stopped) -> None:
    options = ur_options({"host": "fake", "axes": 3, "mode": "servol"})
    motion = Motion(options, stopped.connection, stopped.soft_stop, ServoL(options, 0.002), 0.002, report=print)  # type: ignore[arg-type]

    def send() -> list[str]:
        motion.send(stopped.state(), START_POSE[:3], (0.0, 0.0, 0.0))
        return stopped.connection.streamed

    assert send() == ["servoL"]
    stopped.connection.pause()
    # The command itself sees it, before any package.
    assert send() == ["servoL"]
    assert (stopped.phase, stopped.soft_stop.ready) == (Phase.PAUSING, False)
    stopped.rests()
    assert send() == ["servoL", "servoL"]
    assert (stopped.phase, stopped.soft_stop.ready) == (Phase.MOVING, True)


@pytest.mark.parametrize("rests", [False, True])
def test_a_pause_can_be_stopped_for_good(stopped: Stopped, rests: bool) -> None:
    stopped.soft_stop.begin()
    stopped.connection.pause()
    stopped.soft_stop.update()
    assert stopped.soft_stop.stopping
    if rests:
        stopped.rests()
    stopped.stop().perform()
    assert stopped.phase is Phase.STOPPING
    stopped.rests()
    assert (stopped.phase, stopped.soft_stop.commanded) == (Phase.AT_REST, False)


@pytest.mark.parametrize(
    ("runtime_state", "stale", "why"),
    [(PLAYING, False, "was not acknowledged"), (STOPPED, False, None), (STOPPED, True, "was not acknowledged")],
)
def test_a_refused_stop_matters_where_the_program_may_play(
    stopped: Stopped, runtime_state: int, stale: bool, why: str | None
) -> None:
    stopped.soft_stop.begin()
    stopped.soft_stop.stop(lambda _: False)
    stopped.connection.started[-1].perform()
    assert stopped.package(runtime_state=runtime_state, stale=stale) == why
    # It is reported once.
    assert stopped.package(runtime_state=runtime_state, stale=stale) is None


def test_what_is_cut_is_not_led_until_it_was_acknowledged(stopped: Stopped) -> None:
    soft_stop = stopped.soft_stop
    soft_stop.begin()
    soft_stop.cut()
    assert (stopped.phase, soft_stop.ready, soft_stop.commanded, soft_stop.heard) == (Phase.CUT, False, False, False)
    assert stopped.connection.control is None
    assert stopped.package(qd=0.3) is None
    (call,) = soft_stop.acknowledge()
    assert call.name == "end of the program"
    assert stopped.phase is Phase.AT_REST
