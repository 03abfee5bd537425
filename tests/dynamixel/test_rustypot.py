"""A second client with its own codec and register table on the emulated bus: the registers agree."""

from collections.abc import Iterator

import pytest
from tests.dynamixel.emulated import BAUD, EmulatedBus, emulated_bus

from haptether.dynamixel import SERVO_MODELS

pytest.importorskip("rustypot")  # no wheel for the newest Python yet
from rustypot import Xl330PyController

pytestmark = pytest.mark.live

MODEL = SERVO_MODELS["XL330-M288"]
IDS = [1, 2, 5]
START_RAD = 0.5
OTHER_NAME = {
    # Registers of other families of servos, or of firmware with a backup.
    "acceleration_limit": None, "torque_limit": "Current Limit", "moving_speed": "Velocity Limit", "backup_ready": None,
    "secondary_id": "Secondary(Shadow) ID",
}  # fmt: skip
"""Registers that the client names differently; None: this model has no such register."""


@pytest.fixture(scope="module")
def bus() -> Iterator[EmulatedBus]:
    servos = [f"{servo_id}=XL330-M288" for servo_id in IDS]
    with emulated_bus("--servos", *servos, "--start", str(START_RAD), "0", "0") as running:
        yield running


@pytest.fixture(scope="module")
def client(bus: EmulatedBus) -> Iterator[Xl330PyController]:
    controller = Xl330PyController(bus.port, BAUD, 1.0)
    yield controller
    controller.close()


def test_its_table_has_the_addresses_of_ours() -> None:
    ours = {item.name.lower().replace(" ", "_"): item for item in MODEL.table.items}
    compared = 0
    for register in Xl330PyController.registers():
        name = OTHER_NAME.get(register.name, register.name)
        # The client's indirect data are those of firmware before 46.
        if name is None or name.startswith("indirect_data"):
            continue
        item = ours[name.lower().replace(" ", "_")]
        assert (item.address, item.size) == (register.addr, register.size), register.name
        compared += 1
    assert compared > 50


def test_it_finds_the_servos_and_their_models(client: Xl330PyController) -> None:
    assert client.scan(list(range(8))) == dict.fromkeys(IDS, MODEL.number)
    assert client.broadcast_scan() == dict.fromkeys(IDS, MODEL.number)
    assert client.ping(IDS[0])
    assert not client.ping(IDS[-1] + 1)


def test_it_reads_and_writes_what_the_servo_has(bus: EmulatedBus, client: Xl330PyController) -> None:
    first = IDS[0]
    assert client.read_register(first, "present_position") == pytest.approx(2048 + START_RAD * 4096 / 6.2831853, abs=1)
    assert client.read_register(first, "firmware_version") == 52
    for name, value in {"led": 1, "position_p_gain": 777, "goal_current": -123, "velocity_limit": 200}.items():
        client.write_register(first, name, value)
        assert client.read_register(first, name) == value, name
    client.sync_write_register(IDS, "goal_current", [-3, 0, 7])
    assert client.sync_read_register(IDS, "goal_current") == [-3, 0, 7]
    client.sync_write_register(IDS, "torque_enable", [1, 0, 1])
    # A write to several servos has no answer; the read that follows proves its effect.
    assert client.sync_read_register(IDS, "torque_enable") == [1, 0, 1]
    assert [bus.servo(servo_id)["torque"] for servo_id in IDS] == [True, False, True]
    client.sync_write_register(IDS, "torque_enable", [0, 0, 0])


@pytest.mark.parametrize("fast", [False, True], ids=["read of each", "fast read"])
def test_it_reads_several_at_once(client: Xl330PyController, *, fast: bool) -> None:
    client.set_fast_sync_read(fast)
    client.sync_write_register(IDS, "position_d_gain", [11, 22, 33])
    assert client.sync_read_register(IDS, "position_d_gain") == [11, 22, 33]


def test_what_the_servo_refuses_it_sees(client: Xl330PyController) -> None:
    limit_exceeded = 6
    current_limit = client.read_register(IDS[0], "current_limit")
    assert client.write_register_with_error(IDS[0], "goal_current", current_limit + 1) == limit_exceeded
