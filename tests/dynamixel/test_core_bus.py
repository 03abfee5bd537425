"""The extension's bus on an emulated one: its reads, its refusals, and the answers that it must reject."""

import struct
import time
from collections.abc import Iterator

import pytest
from tests.dynamixel.emulated import BAUD, EmulatedBus, emulated_bus

from haptether.dynamixel import SERVO_MODELS, DynamixelBus, ServoModel, SyncRead

pytestmark = pytest.mark.live

MODELS = list(SERVO_MODELS.values())
IDS = {model.name: 1 + index for index, model in enumerate(MODELS)}
XM, XL = IDS["XM430-W350"], IDS["XL330-M288"]
LED, GOAL_CURRENT, GOAL_POSITION, PRESENT_CURRENT, PRESENT_POSITION = 65, 102, 116, 126, 132
TIMEOUT_S = 0.2
"""Longest time of an answer on a loaded test machine."""
MEASURED = struct.Struct("<hii")
"""Present Current, Present Velocity, Present Position."""


@pytest.fixture(scope="module")
def shared() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", *(f"{IDS[model.name]}={model.name}" for model in MODELS)) as running:
        yield running


@pytest.fixture
def bus(emulated: EmulatedBus) -> Iterator[DynamixelBus]:
    opened = DynamixelBus(emulated.port, baud=BAUD, timeout_s=TIMEOUT_S)
    yield opened
    opened.close()


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_every_entry_is_read(bus: DynamixelBus, model: ServoModel) -> None:
    servo_id = IDS[model.name]
    assert bus.ping(servo_id) == (model.number, 52)
    for item in model.table.items:
        value = item.decoded(bus.read(servo_id, item.address, item.size))
        if item.address in range(9, 120) and not item.name.startswith("Goal ") and item.name != "Return Delay Time":
            assert value == item.default, item.name


@pytest.mark.parametrize("fast", [True, False])
def test_one_read_and_one_write_of_all(bus: DynamixelBus, fast: bool) -> None:
    ids = [servo_id for name, servo_id in IDS.items() if SERVO_MODELS[name].has_current_control]
    read = SyncRead(PRESENT_CURRENT, 10, ids, fast=fast)
    found = list(MEASURED.iter_unpack(bus.sync_read(read)))
    assert found == [(0, 0, 2048)] * len(ids)
    assert read.alerts == ()
    goals = [100 + servo_id for servo_id in ids]
    bus.sync_write(GOAL_CURRENT, 2, bytes(ids), struct.pack(f"<{len(ids)}h", *goals))
    written = bus.sync_read(SyncRead(GOAL_CURRENT, 2, ids, fast=fast))
    assert list(struct.unpack(f"<{len(ids)}h", written)) == goals


@pytest.mark.parametrize("fast", [True, False])
@pytest.mark.parametrize("fault", ["drop 1", "corrupt 1", "mute 1"])
def test_an_answer_that_goes_wrong_gives_no_value(
    emulated: EmulatedBus, bus: DynamixelBus, fault: str, fast: bool
) -> None:
    read = SyncRead(PRESENT_POSITION, 4, [XM, XL], fast=fast)
    emulated.do(f"place {XM} 0.5")
    emulated.do(f"place {XL} 0.5")
    before = bus.sync_read(read)
    emulated.do(fault)
    with pytest.raises((TimeoutError, RuntimeError)):
        bus.sync_read(read)
    assert read.alerts == ()
    # The next read is unaffected.
    assert bus.sync_read(read) == before


@pytest.mark.parametrize("fast", [True, False])
def test_a_silent_servo_is_named(emulated: EmulatedBus, bus: DynamixelBus, fast: bool) -> None:
    emulated.do(f"silent {XL} on")
    with pytest.raises(TimeoutError, match=f"id {XL} did not answer within 200 ms"):
        bus.ping(XL)
    # In a fast read no servo is known to have answered.
    named = XM if fast else XL
    with pytest.raises(TimeoutError, match=f"id {named} did not answer within 200 ms"):
        bus.sync_read(SyncRead(PRESENT_POSITION, 4, [XM, XL], fast=fast))
    assert bus.ping(XM) == (1020, 52)


def test_a_hardware_error_is_told_beside_the_values(emulated: EmulatedBus, bus: DynamixelBus) -> None:
    read = SyncRead(PRESENT_POSITION, 4, [XM, XL])
    emulated.do(f"hardware-error {XL} overload")
    assert len(bus.sync_read(read)) == 8
    assert read.alerts == (XL,)
    assert bus.write(XL, LED, b"\1") is True
    assert bus.write(XM, LED, b"\1") is False


@pytest.mark.parametrize(
    ("address", "written", "said"),
    [
        (11, b"\2", "data range error \\(4\\)"),
        (132, b"\0\0\0\0", "access error \\(7\\)"),
        (116, b"\0\0", "data length error \\(5\\)"),
        (102, b"\xff\x7f", "data limit error \\(6\\)"),
    ],
)
def test_what_a_servo_refuses_has_a_name(bus: DynamixelBus, address: int, written: bytes, said: str) -> None:
    with pytest.raises(RuntimeError, match=f"id {XM}: {said}"):
        bus.write(XM, address, written)


def test_a_value_like_a_header_comes_through(bus: DynamixelBus) -> None:
    address = SERVO_MODELS["XM430-W350"].table["Indirect Data 1"].address
    written = b"\xff\xff\xfd\x00\xff\xff\xfd\xfd"
    bus.write(XM, address, written)
    assert bus.read(XM, address, len(written)) == written
    assert bus.sync_read(SyncRead(address, len(written), [XM], fast=True)) == written
    assert bus.sync_read(SyncRead(address, len(written), [XM], fast=False)) == written


def test_all_are_written_to_and_none_answers(bus: DynamixelBus) -> None:
    assert DynamixelBus.BROADCAST == 254
    assert bus.write(254, LED, b"\1") is False
    assert set(bus.sync_read(SyncRead(LED, 1, list(IDS.values())))) == {1}
    with pytest.raises(ValueError, match="id 254: must be 0 to 252"):
        bus.ping(254)


def test_a_reboot(emulated: EmulatedBus, bus: DynamixelBus) -> None:
    bus.write(XM, LED, b"\1")
    bus.reboot(XM)
    with pytest.raises(TimeoutError):
        bus.ping(XM)
    assert emulated.servo(XM)["restarts"] >= 1


def test_current_ends_with_the_client(emulated: EmulatedBus, bus: DynamixelBus) -> None:
    table = SERVO_MODELS["XM430-W350"].table
    for name, value in (
        ("Operating Mode", 0),
        ("Goal Current", 100),
        ("Bus Watchdog", 10),
        ("Torque Enable", 1),
    ):
        bus.write(XM, table[name].address, table[name].encoded(value))
    read = SyncRead(PRESENT_CURRENT, 10, [XM])
    end = time.monotonic() + 5.0
    while MEASURED.unpack(bus.sync_read(read))[0] < 90:
        assert time.monotonic() < end
    # Nobody sends any more.
    end = time.monotonic() + 5.0
    # The model of the motor follows in its next step.
    while (servo := emulated.servo(XM))["bus_watchdog"] != -1 or servo["current_a"] != 0.0:
        assert time.monotonic() < end, servo
        time.sleep(0.02)
    with pytest.raises(RuntimeError, match="data range error"):
        bus.write(XM, GOAL_CURRENT, b"\x64\0")
    bus.write(XM, table["Torque Enable"].address, b"\0")
    bus.write(XM, table["Operating Mode"].address, b"\3")


def test_a_brown_out_is_silence_and_then_no_torque(emulated: EmulatedBus, bus: DynamixelBus) -> None:
    bus.write(XM, SERVO_MODELS["XM430-W350"].table["Torque Enable"].address, b"\1")
    emulated.do("brown-out 0.5")
    with pytest.raises(TimeoutError):
        bus.ping(XM)
    end = time.monotonic() + 5.0
    while True:
        try:
            bus.ping(XM)
            break
        except TimeoutError:
            assert time.monotonic() < end
    assert bus.read(XM, 64, 1) == b"\0"


@pytest.mark.parametrize(
    ("baud", "timeout_s", "said"),
    [
        (300, 0.02, "baud = 300: must be 1200 to 10000000 bit/s"),
        (BAUD, 0.0, "timeout_s = 0: must be 0.001 to 10 s"),
        (BAUD, float("nan"), "timeout_s = NaN: must be"),
    ],
)
def test_impossible_settings_are_refused(emulated: EmulatedBus, baud: int, timeout_s: float, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DynamixelBus(emulated.port, baud=baud, timeout_s=timeout_s)


@pytest.mark.parametrize(
    ("length", "ids", "said"),
    [
        (4, [], "no servo is named"),
        (4, [1, 1], "id 1 is named twice"),
        (0, [1], "length 0"),
        (4, [253], "id 253: must be 0 to 252"),
        (200, [1, 2, 3, 4, 5, 6], "must be at most 1024"),
        (1, list(range(33)), "33 servos in one read: must be at most 32"),
    ],
)
def test_impossible_reads_are_refused(length: int, ids: list[int], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        SyncRead(PRESENT_POSITION, length, ids)


def test_a_port_has_one_controller(emulated: EmulatedBus, bus: DynamixelBus) -> None:
    assert bus.ping(XM)
    with pytest.raises(OSError, match="another process has the port"):
        DynamixelBus(emulated.port, baud=BAUD)
    bus.close()
    with pytest.raises(ValueError, match="is closed"):
        bus.ping(XM)
    again = DynamixelBus(emulated.port, baud=BAUD)
    assert again.ping(XM)
    again.close()


def test_a_port_that_is_none() -> None:
    with pytest.raises(FileNotFoundError, match="No such file or directory: '/dev/no-such-port'"):
        DynamixelBus("/dev/no-such-port", baud=BAUD)


def test_an_unplugged_port_is_an_error_at_once() -> None:
    with emulated_bus("--servos", "1=XM430-W350") as emulated:
        bus = DynamixelBus(emulated.port, baud=BAUD, timeout_s=1.0)
        assert bus.ping(1)
        emulated.do("unplug")
        with pytest.raises(OSError, match="Input/output error"):
            bus.ping(1)


def test_a_late_answer_is_not_taken_for_that_to_the_next_instruction() -> None:
    # Each answer is 300 ms late, after the timeout of 200 ms.
    with emulated_bus("--servos", "1=XM430-W350", "--latency-ms", "300") as emulated:
        bus = DynamixelBus(emulated.port, baud=BAUD, timeout_s=TIMEOUT_S)
        for entry in (PRESENT_POSITION, PRESENT_CURRENT):
            with pytest.raises(TimeoutError):
                bus.sync_read(SyncRead(entry, 4, [1]))
        bus.close()
        patient = DynamixelBus(emulated.port, baud=BAUD, timeout_s=2.0)
        assert patient.sync_read(SyncRead(PRESENT_POSITION, 4, [1])) == (2048).to_bytes(4, "little")
        patient.close()
