"""Every end of every driver leaves zero force or a stop: end of run, exception, Ctrl-C, refusal, lost connection."""

import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import pytest
from tests.dynamixel.emulated import EmulatedBus, emulated_bus
from tests.dynamixel.test_description import TWO_LINKS
from tests.haptic.emulated import emulated_service
from tests.haptic.standins import Standin, built
from tests.ur.fake_rtde import START_POSE, Arm, install
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import MasterLoop, MasterRun, load_scene, scene_json
from haptether.bridge.devices.check.report import DeviceCheck
from haptether.bridge.devices.loop import drive_master, drive_slave
from haptether.bridge.devices.open import DeviceError
from haptether.master import MasterSample
from haptether.master.dynamixel import DynamixelMaster
from haptether.master.force_dimension import ForceDimension
from haptether.master.inverse3 import Inverse3
from haptether.master.touch import Touch
from haptether.slave import SlaveSample, UrSlave
from haptether.slave.dynamixel.driver import DynamixelSlave

pytestmark = pytest.mark.live

PATIENCE_S = 10.0
TICKS = 20
FORCE = (0.5, 0.3, -0.2)


@dataclass
class Loop:
    """A loop that has the device exert something, and ends as requested."""

    order: tuple[Any, ...]
    axes: int
    kind: str = "linear"
    wrong: BaseException | None = None
    begins: bool = True
    trigger_force: float | None = None
    gripper_command: None = None
    ticks: int = 0
    finished: bool = False
    said: list[str] = field(default_factory=list)

    def begin(self, _driver: str = "") -> str:
        if not self.begins:
            message = "real time is required and refused"
            raise OSError(message)
        return "none"

    def step(self, *_sample: object, **_rest: object) -> tuple[Any, ...] | None:
        self.ticks += 1
        if self.ticks <= TICKS:
            return self.order
        if self.wrong is not None:
            raise self.wrong
        return None

    def wait(self) -> None:
        time.sleep(0.002)

    def take_acknowledgement(self) -> bool:
        return False

    def announce_end(self) -> None:
        self.said.append("end")

    def fail(self, text: str) -> None:
        self.said.append(text)


class Failing:
    """A driver one of whose methods raises after some calls, once the device has executed the call."""

    def __init__(self, driver: Any, method: str, error: BaseException, after: int) -> None:  # noqa: ANN401
        self._driver, self._method, self._error, self._left = driver, method, error, after

    def __getattr__(self, name: str) -> Any:  # noqa: ANN401
        found = getattr(self._driver, name)
        if name != self._method:
            return found

        def fails(*arguments: object) -> object:
            result = found(*arguments)
            self._left -= 1
            if self._left == 0:
                raise self._error
            return result

        return fails


class Plain:
    """A driver of another package: a device that keeps its last command, and closes without a reset."""

    paces = False

    def __init__(self) -> None:
        self.kept: object = 0.0
        self.calls: list[str] = []

    def open(self) -> None:
        self.kept = FORCE
        self.calls.append("open")

    def write(self, force: tuple[float, ...], _velocity: tuple[float, ...] | None = None) -> None:
        self.kept = force if any(force) else 0.0

    def close(self) -> None:
        self.calls.append("close")


class PlainMaster(Plain):
    """A haptic device of another package."""

    def read(self) -> MasterSample:
        return MasterSample((0.0, 0.0, 0.0))


class PlainSlave(Plain):
    """An arm of another package."""

    def read(self) -> SlaveSample:
        return SlaveSample((0.0, 0.0, 0.0), (0.0,) * 3, (0.0,) * 3)

    def stop(self) -> None:
        self.kept = 0.0


@dataclass
class Device:
    """A driver, its loop, and the tests for an acting and for a resting device."""

    driver: Any
    loop: Callable[[], Loop]
    acts: Callable[[], bool]
    rests: Callable[[], bool]
    lose: Callable[[], object] | None = None
    """Makes the driver give up during a read."""


def master(order: tuple[float, ...] = FORCE, kind: str = "linear") -> Callable[[], Loop]:
    return lambda: Loop(order=order, axes=len(order), kind=kind)


class Parts:
    """Processes and libraries that simulate devices, each started once."""

    def __init__(self, stack: ExitStack, folder: Path) -> None:
        self.stack, self.folder = stack, folder
        self._begun: dict[str, Any] = {}

    def once(self, name: str, begin: Callable[[], Any]) -> Any:  # noqa: ANN401  # of any kind
        if name not in self._begun:
            self._begun[name] = begin()
        return self._begun[name]

    def bus(self, name: str, *arguments: str) -> EmulatedBus:
        begun: EmulatedBus = self.once(name, lambda: self.stack.enter_context(emulated_bus(*arguments)))
        return begun.as_new()


@pytest.fixture(scope="module")
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Parts]:
    with ExitStack() as stack:
        yield Parts(stack, tmp_path_factory.mktemp("parts"))


@pytest.fixture
def devices(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> Callable[[str], Device]:
    return lambda name: MAKERS[name](parts, monkeypatch)


def inverse3(parts: Parts, _patch: pytest.MonkeyPatch) -> Device:
    service = parts.once("inverse3", lambda: parts.stack.enter_context(emulated_service()))

    def sent() -> list[float]:
        return cast("list[float]", service.status()["sent"])

    return Device(
        Inverse3(**service.options), master(), lambda: any(sent()), lambda: not any(sent()),
        lambda: service.do("drop 1"),
    )  # fmt: skip


def force_dimension(parts: Parts, _patch: pytest.MonkeyPatch) -> Device:
    dhd = parts.once("dhd", lambda: Standin(built("force_dimension/dhd.c", parts.folder)))
    dhd.reset()
    dhd.set(watchdog_slack=50.0)
    return Device(
        ForceDimension(library=str(dhd.path), watchdog_s=0.0318), master(), lambda: any(dhd.force()),
        lambda: not any(dhd.force()) and dhd.get("force") == 0, lambda: dhd.fail("dhdGetPosition", 2),
    )  # fmt: skip


def touch(parts: Parts, _patch: pytest.MonkeyPatch) -> Device:
    hd = parts.once("hd", lambda: Standin(built("touch/hd.c", parts.folder)))
    hd.reset()
    return Device(
        Touch(library=str(hd.path), watchdog_s=0.05, sample_timeout_s=0.018), master(), lambda: any(hd.force()),
        lambda: not any(hd.force()), lambda: hd.error(0x0302),
    )  # fmt: skip


def torque_is_off(bus: EmulatedBus) -> bool:
    return not any(servo["torque"] for servo in bus.status()["servos"])


PATIENT = {"timeout_s": 0.05, "watchdog_s": 0.5, "ramp_s": 0.1, "verify_watchdog": False}


def leader(parts: Parts, _patch: pytest.MonkeyPatch | None = None) -> Device:
    path = parts.folder / "two.toml"
    path.write_text(TWO_LINKS)
    bus = parts.bus("leader", "--arm", str(path))
    for servo in bus.status()["servos"]:
        bus.do(f"hand {servo['id']} {servo['position_rad']} 40 1")
    return Device(
        DynamixelMaster(port=bus.port, arm=str(path), **PATIENT), master((0.05, 0.02), "joints"),
        lambda: not torque_is_off(bus), lambda: torque_is_off(bus), lambda: bus.do("silent 2 on"),
    )  # fmt: skip


def follower(parts: Parts, _patch: pytest.MonkeyPatch) -> Device:
    path = parts.folder / "arm.toml"
    path.write_text('[[servo]]\nid = 1\nmodel = "XM430-W350"\n[[servo]]\nid = 2\nmodel = "XL330-M288"\n')
    bus = parts.bus("follower", "--servos", "1=XM430-W350", "2=XL330-M288")
    return Device(
        DynamixelSlave(port=bus.port, arm=str(path), release_s=0.0, **PATIENT),
        lambda: Loop(order=("move", (0.05, 0.05), (0.0, 0.0)), axes=2, kind="joints"),
        lambda: not torque_is_off(bus), lambda: torque_is_off(bus), lambda: bus.do("silent 2 on"),
    )  # fmt: skip


def ur(parts: Parts, patch: pytest.MonkeyPatch) -> Device:
    arm = Arm()
    install(patch, arm)
    parts.stack.callback(arm.released.set)
    moves = ("speedL", "servoL", "servoJ")

    def stopped() -> bool:
        last = max((index for index, name in enumerate(arm.names) if name in moves), default=-1)
        return any(name.endswith("Stop") for name in arm.names[last + 1 :])

    return Device(
        UrSlave(host="fake", mode="speedl"), lambda: Loop(order=("move", (START_POSE[0],), (0.0,)), axes=1),
        lambda: any(name in moves for name in arm.names), stopped,
    )  # fmt: skip


def plain(kind: type[Plain], order: tuple[Any, ...]) -> Callable[..., Device]:
    def made(_parts: Parts, _patch: pytest.MonkeyPatch) -> Device:
        driver = kind()
        return Device(driver, lambda: Loop(order=order, axes=3), lambda: driver.kept != 0.0, lambda: driver.kept == 0.0)

    return made


MAKERS: dict[str, Callable[..., Device]] = {
    "inverse3": inverse3,
    "force-dimension": force_dimension,
    "touch": touch,
    "dynamixel leader": leader,
    "dynamixel follower": follower,
    "ur": ur,
    "another master": plain(PlainMaster, FORCE),
    "another slave": plain(PlainSlave, ("move", FORCE, (0.0,) * 3)),
}
UNPLUGGED = OSError(19, "No such device")
WAYS: dict[str, tuple[str, str, BaseException | None, int]] = {
    "end": ("", "", None, 0),
    "read raises": ("driver", "read", UNPLUGGED, TICKS),
    "write raises": ("driver", "write", UNPLUGGED, TICKS),
    "the first write raises": ("driver", "write", UNPLUGGED, 1),
    "Ctrl-C in read": ("driver", "read", KeyboardInterrupt(), TICKS),
    "exit in write": ("driver", "write", SystemExit(1), TICKS),
    "open raises": ("driver", "open", UNPLUGGED, 1),
    "Ctrl-C in open": ("driver", "open", KeyboardInterrupt(), 1),
    "the loop raises": ("loop", "step", TypeError("of a sample"), 0),
    "the loop does not begin": ("loop", "begin", None, 0),
    "another period": ("period", "", None, 0),
}
"""Object and method that raise, the exception, and the number of calls before it."""


def left_at_rest(device: Device, way: str) -> None:
    """Drive a device until it ends this way, and assert that it comes to rest."""
    whose, method, error, after = WAYS[way]
    loop, driver, period_s = device.loop(), device.driver, None
    if whose == "driver":
        driver = Failing(driver, method, cast("BaseException", error), after)
    elif whose == "loop":
        loop.wrong, loop.begins = error, method != "begin"
    elif whose == "period":
        driver = type("Paced", (), {"__getattr__": lambda _, name: getattr(device.driver, name)})()
        driver.paces, driver.period_s, period_s = True, 0.5, 0.001
    drives = drive_slave if hasattr(driver, "stop") else drive_master
    if way == "end":
        drives(driver, loop, period_s=period_s)  # type: ignore[arg-type]  # what it needs of a loop
    else:
        with pytest.raises((DeviceError, OSError, KeyboardInterrupt, SystemExit)):
            drives(driver, loop, period_s=period_s)  # type: ignore[arg-type]
    end_s = time.monotonic() + PATIENCE_S
    while not device.rests():
        assert time.monotonic() < end_s, f"{way}: it keeps its last command"
        time.sleep(0.01)


@pytest.mark.parametrize("way", WAYS)
@pytest.mark.parametrize("name", [name for name in MAKERS if name.startswith("another")])
def test_a_device_of_any_driver_is_left_at_rest(devices: Callable[[str], Device], name: str, way: str) -> None:
    device = devices(name)
    left_at_rest(device, way)
    assert device.driver.calls == ["open", "close"]


@pytest.mark.parametrize("way", ["end", "read raises", "write raises", "Ctrl-C in read", "the loop raises"])
@pytest.mark.parametrize("name", [name for name in MAKERS if not name.startswith("another")])
@anew_after_stalls
def test_a_device_of_ours_is_left_at_rest(devices: Callable[[str], Device], name: str, way: str) -> None:
    device = devices(name)
    acted = False

    class Watched(Loop):
        def step(self, *sample: object, **rest: object) -> tuple[Any, ...] | None:
            nonlocal acted
            acted = acted or (self.ticks >= TICKS // 2 and device.acts())
            return super().step(*sample, **rest)

    made = device.loop
    device.loop = lambda: Watched(**vars(made()))
    left_at_rest(device, way)
    assert acted, "nothing was exerted before"


@pytest.mark.parametrize("name", ["inverse3", "force-dimension", "touch", "dynamixel leader", "dynamixel follower"])
@anew_after_stalls
def test_a_driver_that_gives_up_leaves_its_device_at_rest(devices: Callable[[str], Device], name: str) -> None:
    """The device rests before it is closed: a run goes on until its fault is acknowledged, which may be much later."""
    device = devices(name)
    driver, order = device.driver, device.loop().order
    command = order[1:] if order[0] == "move" else (order,)
    driver.open()
    try:
        end_s = time.monotonic() + PATIENCE_S
        while not device.acts():
            assert time.monotonic() < end_s
            if driver.read().fault is not None:
                # A late machine can cause this fault.
                driver.acknowledge()
            driver.write(*command)
            time.sleep(0.002)
        assert device.lose is not None
        device.lose()
        while driver.read().fault is None:
            assert time.monotonic() < end_s
            driver.write(*command)
            time.sleep(0.002)
        for _ in range(TICKS):
            driver.write(*command)
            driver.read()
        while not device.rests():
            assert time.monotonic() < end_s, "it keeps its last command"
            driver.read()
            time.sleep(0.01)
    finally:
        driver.close()


class Lowered(PlainMaster):
    """An arm with torque from its first `read` on, which `close` lowers for longer than the end of a run waits."""

    close_s = 0.3

    def __init__(self) -> None:
        super().__init__()
        self.blocks = ""
        self.entered, self.let = threading.Event(), threading.Event()

    def _block(self, method: str) -> None:
        if self.blocks == method:
            self.entered.set()
            self.let.wait(PATIENCE_S)

    def open(self) -> None:
        self._block("open")
        self.calls.append("open")

    def read(self) -> MasterSample:
        self.kept = FORCE
        self.calls.append("read")
        self._block("read")
        return MasterSample(0.0)

    def write(self, force: tuple[float, ...], _velocity: tuple[float, ...] | None = None) -> None:
        pass

    def close(self) -> None:
        time.sleep(self.close_s)
        self.kept = 0.0
        self.calls.append("close")


def master_run(device: Any) -> MasterRun:  # noqa: ANN401  # of any kind
    scene = scene_json(load_scene("remote_push", ["environment.pushers=[]"]))
    return MasterRun(device, MasterLoop(scene, peer="127.0.0.1:9", run_id=1, insecure=True))


def give_up(device: Lowered) -> None:
    run = master_run(device)
    assert device.entered.wait(PATIENCE_S)
    threading.Timer(0.05, device.let.set).start()
    run.give_up()
    assert run.finished


def finish(device: Lowered) -> None:
    run = master_run(device)
    until(lambda: "read" in device.calls)
    device.let.set()
    run.finish()
    assert run.finished


def end_alone(device: Lowered) -> None:
    check = DeviceCheck(device, "master", "linear")
    until(lambda: "read" in device.calls)
    device.let.set()
    check.end()
    assert check.ended
    closed = next(finding for finding in check.findings() if finding.check == "close()")
    assert closed.verdict == "pass", closed


def until(done: Callable[[], bool]) -> None:
    end_s = time.monotonic() + PATIENCE_S
    while not done():
        assert time.monotonic() < end_s
        time.sleep(0.01)


@pytest.mark.parametrize(("leave", "blocks"), [(give_up, "open"), (give_up, "read"), (finish, ""), (end_alone, "")])
def test_a_close_gets_the_time_that_its_driver_states(
    monkeypatch: pytest.MonkeyPatch, leave: Callable[[Lowered], None], blocks: str
) -> None:
    devices = "haptether.bridge.devices"
    for name in ("loop.GIVE_UP_S", "loop.JOIN_S", "standalone.LEAVE_S", "open.LEAVE_S"):
        monkeypatch.setattr(f"{devices}.{name}", 0.15)
    for module in ("open", "check.report"):
        monkeypatch.setattr(f"{devices}.{module}.CLOSE_S", 0.2)
    device = Lowered()
    device.blocks = blocks
    leave(device)
    assert device.kept == 0.0, "it keeps its torque"
    assert device.calls[-1] == "close"
    if blocks == "open":
        assert device.calls == ["open", "close"], "it was given torque after the stop"


def test_ctrl_c_while_a_leader_opens_ends_without_torque(parts: Parts, tmp_path: Path) -> None:
    device = leader(parts)
    options = "".join(f"{key} = {str(value).lower()}\n" for key, value in PATIENT.items())
    scene = tmp_path / "leader.toml"
    scene.write_text(
        f"""schema = 1
[master]
kind = "joints"
axes = 2
mass_kg = [0.02, 0.03]
driver = "dynamixel"
[master.options]
port = "{device.driver.options.port}"
arm = "{parts.folder / "two.toml"}"
{options}
[slave]
[safety]
controllers = ["wsc"]
"""
    )
    process = subprocess.Popen(
        [sys.executable, "-m", "haptether", "master", "--scene", str(scene), "--peer", "127.0.0.1:9", "--insecure"],
        stdin=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert process.stderr is not None
        said = ""
        while "took torque" not in said:
            part = process.stderr.readline()
            assert part, said
            said += part
        process.send_signal(signal.SIGINT)
        _, rest = process.communicate(timeout=60)
    finally:
        process.kill()
        process.wait()
    said += rest
    assert process.returncode in {0, 130}, said
    assert "NOT known to be closed" not in said
    assert device.rests(), said
