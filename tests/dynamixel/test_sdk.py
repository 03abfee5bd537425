"""The vendor's unmodified client on the emulated bus: every entry of every model, and every instruction."""

import termios
from collections.abc import Iterator
from pathlib import Path

import pytest
from dynamixel_sdk import (  # type: ignore[import-untyped]
    COMM_RX_CORRUPT,
    COMM_RX_TIMEOUT,
    COMM_SUCCESS,
    GroupBulkRead,
    GroupBulkWrite,
    GroupSyncRead,
    GroupSyncWrite,
)
from tests.dynamixel.emulated import EmulatedBus, VendorClient, emulated_bus, vendor_client

from haptether.dynamixel import SERVO_MODELS, Item, ServoModel

pytestmark = pytest.mark.live

MODELS = list(SERVO_MODELS.values())
IDS = {model.name: 1 + index for index, model in enumerate(MODELS)}
ACCESS, LIMIT, RANGE, LENGTH = 7, 6, 4, 5
XM, XL = IDS["XM430-W350"], IDS["XL330-M288"]
TORQUE, LED, GOAL_CURRENT, GOAL_POSITION, PRESENT_CURRENT, PRESENT_POSITION = 64, 65, 102, 116, 126, 132

OWN_VALUE = {
    "Operating Mode", "Secondary(Shadow) ID", "Drive Mode", "Temperature Limit", "Max Voltage Limit",
    "Min Voltage Limit",
}  # fmt: skip
"""Entries that change the servo's answers, or trip it, when their value changes."""


@pytest.fixture(scope="module")
def bus() -> Iterator[EmulatedBus]:
    with emulated_bus("--servos", *(f"{IDS[model.name]}={model.name}" for model in MODELS)) as running:
        yield running


@pytest.fixture(scope="module")
def port(bus: EmulatedBus) -> Iterator[VendorClient]:
    with vendor_client(bus.port) as client:
        yield client


@pytest.fixture
def client(bus: EmulatedBus, port: VendorClient) -> VendorClient:
    """Return the client, with all servos in their state after power-on."""
    bus.do("brown-out 0")
    return port


def unsigned(item: Item, value: int) -> int:
    return value % (1 << (8 * item.size))


@pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
def test_every_entry_is_read_and_written(client: VendorClient, model: ServoModel) -> None:
    servo_id = IDS[model.name]
    measured = range(120, 148)
    written = 0
    for item in model.table.items:
        value, result, error = client.read(servo_id, item.address, item.size)
        assert (result, error) == (COMM_SUCCESS, 0), item.name
        if item.address > 8 and item.address not in measured and not item.name.startswith("Goal "):
            expected = 0 if item.name == "Return Delay Time" else item.default
            assert value == unsigned(item, expected), item.name
        if not item.writable:
            assert client.write(servo_id, item.address, item.size, 0) == (COMM_SUCCESS, ACCESS), item.name
            continue
        if item.name in {"ID", "Baud Rate", "Status Return Level", "Torque Enable", "Bus Watchdog"}:
            continue
        if item.name in OWN_VALUE:
            assert client.write(servo_id, item.address, item.size, value) == (COMM_SUCCESS, 0)
            continue
        low = max(item.minimum, 0) if item.limit is None else 0
        high = (1 << (8 * item.size)) - 1 if item.maximum is None else item.maximum
        if item.name.startswith("Indirect Address"):
            high = LED
        if item.name.startswith("Indirect Data"):
            # The indirect address points to the LED now.
            high = 1
        if item.limit is not None or item.name == "Goal Position":
            high = 0
        for tried in (high, low):
            assert client.write(servo_id, item.address, item.size, tried) == (COMM_SUCCESS, 0), (item.name, tried)
            assert client.read(servo_id, item.address, item.size) == (tried, COMM_SUCCESS, 0), item.name
            written += 1
        if item.maximum is not None and item.name != "Goal Position" and item.maximum < (1 << (8 * item.size)) - 1:
            refused = client.write(servo_id, item.address, item.size, item.maximum + 1)
            assert refused == (COMM_SUCCESS, RANGE), item.name
        client.write(servo_id, item.address, item.size, value)
    assert written > 60


def test_ping_and_broadcast_ping(client: VendorClient) -> None:
    for model in MODELS:
        number, result, error = client.packets.ping(client.port, IDS[model.name])
        assert (number, result, error) == (model.number, COMM_SUCCESS, 0)
    assert client.packets.ping(client.port, 200)[1] == COMM_RX_TIMEOUT
    found, result = client.packets.broadcastPing(client.port)
    assert result == COMM_SUCCESS
    assert found == {IDS[model.name]: [model.number, 52] for model in MODELS}


def test_sync_reads_and_writes(client: VendorClient) -> None:
    goals = {XM: 2500, XL: 1500, IDS["XL430-W250"]: 1000}
    write = GroupSyncWrite(client.port, client.packets, GOAL_POSITION, 4)
    for servo_id, goal in goals.items():
        assert write.addParam(servo_id, list(goal.to_bytes(4, "little")))
    assert write.txPacket() == COMM_SUCCESS
    read = GroupSyncRead(client.port, client.packets, GOAL_POSITION, 4)
    for servo_id in goals:
        assert read.addParam(servo_id)
    for transfer in (read.txRxPacket, read.fastSyncRead):
        assert transfer() == COMM_SUCCESS
        assert {servo_id: read.getData(servo_id, GOAL_POSITION, 4) for servo_id in goals} == goals


def test_a_missing_servo_ends_sync_reads(client: VendorClient) -> None:
    read = GroupSyncRead(client.port, client.packets, PRESENT_POSITION, 4)
    for servo_id in (XM, 200, XL):
        read.addParam(servo_id)
    assert read.txRxPacket() == COMM_RX_TIMEOUT
    # A part of the answer arrives.
    assert read.fastSyncRead() == COMM_RX_CORRUPT
    assert not read.isAvailable(XM, PRESENT_POSITION, 4)


def test_bulk_reads_and_writes(client: VendorClient) -> None:
    write = GroupBulkWrite(client.port, client.packets)
    assert write.addParam(XM, LED, 1, [1])
    assert write.addParam(XL, GOAL_POSITION, 4, list((1234).to_bytes(4, "little")))
    assert write.txPacket() == COMM_SUCCESS
    read = GroupBulkRead(client.port, client.packets)
    assert read.addParam(XM, LED, 1)
    assert read.addParam(XL, GOAL_POSITION, 4)
    for transfer in (read.txRxPacket, read.fastBulkRead):
        assert transfer() == COMM_SUCCESS
        assert read.getData(XM, LED, 1) == 1
        assert read.getData(XL, GOAL_POSITION, 4) == 1234


def test_registered_writes(client: VendorClient) -> None:
    assert client.packets.regWriteTxRx(client.port, XM, LED, 1, [1]) == (COMM_SUCCESS, 0)
    assert client.read(XM, LED, 1)[0] == 0
    assert client.read(XM, 69, 1)[0] == 1
    # Send to all servos: this client does not read the answer of a single one.
    assert client.packets.action(client.port, 0xFE) == COMM_SUCCESS
    assert client.read(XM, LED, 1)[0] == 1
    assert client.read(XM, 69, 1)[0] == 0


def test_eeprom_is_locked_while_torque_is_on(client: VendorClient) -> None:
    assert client.write(XM, 11, 1, 0) == (COMM_SUCCESS, 0)
    assert client.write(XM, TORQUE, 1, 1) == (COMM_SUCCESS, 0)
    assert client.write(XM, 11, 1, 3) == (COMM_SUCCESS, ACCESS)
    assert client.write(XM, GOAL_CURRENT, 2, 1193) == (COMM_SUCCESS, 0)
    assert client.write(XM, GOAL_CURRENT, 2, -1194) == (COMM_SUCCESS, LIMIT)
    assert client.write(XM, GOAL_CURRENT, 2, 0) == (COMM_SUCCESS, 0)
    assert client.write(XM, TORQUE, 1, 0) == (COMM_SUCCESS, 0)
    assert client.write(XM, 11, 1, 3) == (COMM_SUCCESS, 0)


def test_a_value_that_the_client_does_not_stuff(bus: EmulatedBus, client: VendorClient) -> None:
    before = bus.status()["unstuffed"]
    # 0x00FDFFFF exceeds the largest goal; the refusal proves that all bytes have arrived.
    assert client.write(XM, GOAL_POSITION, 4, 0x00FDFFFF) == (COMM_SUCCESS, RANGE)
    assert bus.status()["unstuffed"] == before + 1
    # An indirect address may hold any byte: the bus stuffs an answer that contains a header.
    indirect = SERVO_MODELS["XM430-W350"].table["Indirect Data 1"].address
    assert client.packets.writeTxRx(client.port, XM, indirect, 4, [0xFF, 0xFF, 0xFD, 0x00]) == (COMM_SUCCESS, 0)
    assert client.read(XM, indirect, 4) == (0x00FDFFFF, COMM_SUCCESS, 0)


def test_lengths_and_addresses_that_there_are_not(client: VendorClient) -> None:
    assert client.write(XM, GOAL_POSITION, 2, 1) == (COMM_SUCCESS, LENGTH)
    assert client.write(XM, 150, 1, 1) == (COMM_SUCCESS, ACCESS)
    assert client.read(XM, 700, 1)[1:] == (COMM_SUCCESS, ACCESS)
    assert client.packets.factoryReset(client.port, XM, 0xFF) == (COMM_SUCCESS, 1)


def test_reboot_and_hardware_errors(bus: EmulatedBus, client: VendorClient) -> None:
    assert client.write(XM, TORQUE, 1, 1) == (COMM_SUCCESS, 0)
    bus.do(f"hardware-error {XM} overload")
    assert client.read(XM, TORQUE, 1) == (0, COMM_SUCCESS, 0x80)
    assert client.read(XM, 70, 1) == (0x20, COMM_SUCCESS, 0x80)
    assert client.write(XM, TORQUE, 1, 1) == (COMM_SUCCESS, 0x81)
    assert client.packets.reboot(client.port, XM) == (COMM_SUCCESS, 0x80)
    while client.packets.ping(client.port, XM)[1] != COMM_SUCCESS:
        pass
    assert client.read(XM, 70, 1) == (0, COMM_SUCCESS, 0)
    assert client.write(XM, TORQUE, 1, 1) == (COMM_SUCCESS, 0)


@pytest.mark.parametrize("fault", ["drop", "corrupt", "mute"])
def test_an_answer_that_goes_wrong(bus: EmulatedBus, client: VendorClient, fault: str) -> None:
    bus.do(f"{fault} 1")
    assert client.read(XM, PRESENT_POSITION, 4)[1] != COMM_SUCCESS
    assert client.read(XM, PRESENT_POSITION, 4)[1:] == (COMM_SUCCESS, 0)


def test_a_client_of_another_rate_gets_no_answer(bus: EmulatedBus, client: VendorClient) -> None:
    assert client.port.setBaudRate(1_000_000)
    try:
        assert bus.status()["baud"] == 1_000_000
        assert client.packets.ping(client.port, XM)[1] == COMM_RX_TIMEOUT
    finally:
        assert client.port.setBaudRate(4_000_000)
    assert client.packets.ping(client.port, XM)[1] == COMM_SUCCESS


def test_the_servos_can_be_set_to_another_rate(client: VendorClient) -> None:
    assert client.write(XM, 8, 1, 3) == (COMM_SUCCESS, 0)
    assert client.packets.ping(client.port, XM)[1] == COMM_RX_TIMEOUT
    assert client.port.setBaudRate(1_000_000)
    try:
        assert client.packets.ping(client.port, XM)[1] == COMM_SUCCESS
        assert client.write(XM, 8, 1, 6) == (COMM_SUCCESS, 0)
    finally:
        assert client.port.setBaudRate(4_000_000)
    assert client.packets.ping(client.port, XM)[1] == COMM_SUCCESS


def test_unplug_and_plug() -> None:
    with emulated_bus("--servos", "1=XM430-W350") as bus:
        with vendor_client(bus.port) as client:
            assert client.packets.ping(client.port, 1)[1] == COMM_SUCCESS
            bus.do("unplug")
            with pytest.raises((OSError, termios.error), match="Input/output error"):
                client.packets.ping(client.port, 1)
        path = bus.do("plug")
        assert Path(path).exists()
        with vendor_client(path) as client:
            assert client.packets.ping(client.port, 1)[1] == COMM_SUCCESS
