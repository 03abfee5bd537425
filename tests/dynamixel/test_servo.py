"""One emulated servo in virtual time: its refusals, its motion, its bus watchdog and its protections."""

import math
from collections.abc import Callable

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.dynamixel import SERVO_MODELS, OperatingMode
from haptether.dynamixel.control_table import RAD_PER_TICK
from haptether.dynamixel.emulator import HardwareError, Joint, JointSettings, Servo, set_stops
from haptether.dynamixel.emulator.protocol import ErrorNumber

NONE, ACCESS, RANGE = ErrorNumber.NONE, ErrorNumber.ACCESS, ErrorNumber.DATA_RANGE
LIMIT, LENGTH, FAIL = ErrorNumber.DATA_LIMIT, ErrorNumber.DATA_LENGTH, ErrorNumber.RESULT_FAIL


class World:
    """A servo and its clock."""

    def __init__(self, model: str = "XM430-W350", position_rad: float = 0.0) -> None:
        self.servo = Servo(SERVO_MODELS[model], 1, position_rad=position_rad)
        self.now_s = 100.0
        self.servo.heard(self.now_s)
        self.servo.advance(self.now_s)

    def write(self, name: str, value: int) -> ErrorNumber:
        item = self.servo.model.table[name]
        self.servo.heard(self.now_s)
        return self.servo.write(item.address, item.encoded(value), self.now_s)

    def run(self, duration_s: float, heard: bool = True) -> None:
        for _ in range(round(duration_s / 0.01)):
            self.now_s += 0.01
            if heard:
                self.servo.heard(self.now_s)
            self.servo.advance(self.now_s)

    def value(self, name: str) -> int:
        return self.servo.value(name)

    def torque_on(self, mode: OperatingMode) -> None:
        assert self.write("Operating Mode", mode) == NONE
        assert self.write("Torque Enable", 1) == NONE


@pytest.mark.parametrize(
    ("name", "value", "torque", "error"),
    [
        ("Operating Mode", 0, False, NONE),
        ("Operating Mode", 0, True, ACCESS),
        ("Operating Mode", 2, False, RANGE),
        ("Homing Offset", 100, True, ACCESS),
        ("Current Limit", 1194, False, RANGE),
        ("Goal Current", 1193, True, NONE),
        ("Goal Current", -1193, True, NONE),
        ("Goal Current", 1194, True, LIMIT),
        ("Goal PWM", 886, True, LIMIT),
        ("Goal Velocity", -201, True, LIMIT),
        ("Goal Position", 4096, True, LIMIT),
        ("Goal Position", -1, True, LIMIT),
        ("Torque Enable", 2, False, RANGE),
        ("LED", 1, True, NONE),
        ("Present Position", 0, False, ACCESS),
        ("Bus Watchdog", -1, False, RANGE),
        ("Bus Watchdog", 127, False, NONE),
        ("Shutdown", 0, False, NONE),
    ],
)
def test_what_may_be_written(name: str, value: int, torque: bool, error: ErrorNumber) -> None:
    world = World()
    if torque:
        assert world.write("Torque Enable", 1) == NONE
    before = world.value(name)
    assert world.write(name, value) == error
    assert world.value(name) == (value if error == NONE else before)


@pytest.mark.parametrize(
    ("address", "written", "error"),
    [
        (116, bytes(2), LENGTH),
        (118, bytes(2), LENGTH),
        (104, bytes(16), NONE),
        (104, bytes(17), ACCESS),
        (66, b"\0", ACCESS),
        (64, b"\1\1", NONE),
        (64, b"\1\2", RANGE),
        (64, b"", LENGTH),
        (661, b"\0\0", ACCESS),
        (65535, b"\0", ACCESS),
    ],
)
def test_writes_of_several_entries_do_all_or_nothing(address: int, written: bytes, error: ErrorNumber) -> None:
    world = World()
    before = world.servo.read(0, 120)
    assert world.servo.write(address, written, world.now_s) == error
    assert error == NONE or world.servo.read(0, 120) == before


@pytest.mark.parametrize("model", ["XL430-W250", "XC430-W150"])
def test_without_current_control_there_are_no_current_modes(model: str) -> None:
    world = World(model)
    assert world.write("Operating Mode", OperatingMode.CURRENT) == RANGE
    assert world.write("Operating Mode", OperatingMode.CURRENT_BASED_POSITION) == RANGE
    assert world.servo.write(102, b"\0\0", 0.0) == ACCESS


def test_a_change_of_mode_sets_the_goal_current_to_its_limit() -> None:
    world = World()
    assert world.write("Goal Current", 0) == NONE
    assert world.write("Position P Gain", 1) == NONE
    assert world.write("Operating Mode", OperatingMode.CURRENT) == NONE
    assert world.value("Goal Current") == 1193
    assert world.value("Position P Gain") == 800


@pytest.mark.parametrize("mode", [OperatingMode.POSITION, OperatingMode.CURRENT_BASED_POSITION])
@pytest.mark.parametrize("model", ["XM430-W350", "XL330-M288", "XM540-W270"])
def test_positions_are_reached(mode: OperatingMode, model: str) -> None:
    world = World(model)
    world.torque_on(mode)
    assert world.write("Goal Position", 3000) == NONE
    world.run(2.0)
    assert world.value("Present Position") == pytest.approx(3000, abs=3)
    assert world.servo.joint.position_rad == pytest.approx(952 * RAD_PER_TICK, abs=5e-3)
    assert (world.value("Moving"), world.value("Moving Status")) == (0, 1)


@pytest.mark.parametrize("mode", [OperatingMode.POSITION, OperatingMode.CURRENT_BASED_POSITION])
def test_a_profile_goes_to_a_position_at_its_speed(mode: OperatingMode) -> None:
    """Check positions and speed: 1000 ticks are 1.534 rad; 20 units of 0.229 rev/min are 0.48 rad/s."""
    world = World()
    world.torque_on(mode)
    assert world.write("Profile Velocity", 20) == NONE
    assert world.write("Goal Position", 3048) == NONE
    world.run(1.6)
    assert world.value("Present Velocity") == pytest.approx(20, abs=1)
    assert world.servo.joint.position_rad == pytest.approx(0.48 * 1.6, abs=0.05)
    world.run(2.0)
    assert world.value("Present Position") == pytest.approx(3048, abs=3)


@pytest.mark.parametrize("stiffness", [None, 2.0])
@pytest.mark.parametrize("goal", [3000, 1000])
def test_a_stop_bears_the_current_of_its_cap(goal: int, stiffness: float | None) -> None:
    world = World("XL330-M288")
    joint = world.servo.joint
    set_stops(joint, ["-0.2", "0.2", *([] if stiffness is None else [str(stiffness)])])
    world.torque_on(OperatingMode.CURRENT_BASED_POSITION)
    assert world.write("Goal Current", 300) == NONE
    assert world.write("Goal Position", goal) == NONE
    world.run(1.0)
    sign = 1 if goal > 2048 else -1
    # J = 2e-3 s^2 times the stall torque; friction takes a part of the pressing torque.
    deep = 0.3 * joint.constant_nm_per_a / (stiffness or 5e5 * joint.settings.inertia)
    assert sign * joint.position_rad == pytest.approx(0.2 + deep, abs=0.2 * deep)
    assert world.value("Present Current") == sign * 300
    assert joint.velocity_rad_s == pytest.approx(0.0, abs=1e-3)
    joint.stops = None
    world.run(1.0)
    assert world.value("Present Position") == pytest.approx(goal, abs=3)


@pytest.mark.parametrize("ratio", [0.0, 0.2, None])
def test_a_joint_rebounds_from_a_stop_by_its_damping(ratio: float | None) -> None:
    model = SERVO_MODELS["XL330-M288"]
    inertia, stiffness = 1e-3, 2.0
    joint = Joint(model, JointSettings(inertia=inertia, viscous=0.0, coulomb=0.0))
    damping = [] if ratio is None else [f"{2.0 * ratio * math.sqrt(inertia * stiffness):.9f}"]
    set_stops(joint, ["-1", "0", f"{stiffness:g}", *damping])
    joint.velocity_rad_s = 2.0
    joint.advance(0.0, None)
    pushed = 0.0
    for index in range(1, 200):
        joint.advance(1e-3 * index + 1e-6, None)
        pushed += 1e-3 * joint.stop_nm
    # The implicit step adds w dt / 2 to the ratio.
    total = (math.sqrt(0.5) if ratio is None else ratio) + 0.5e-3 * math.sqrt(stiffness / inertia)
    expected = -2.0 * math.exp(-math.pi * total / math.sqrt(1.0 - total**2))
    assert joint.velocity_rad_s == pytest.approx(expected, abs=0.1)
    # The torque of the stop is what has turned it around.
    assert pushed == pytest.approx(inertia * (joint.velocity_rad_s - 2.0), rel=1e-9)


def test_what_is_measured_is_that_of_the_last_time_however_it_is_read() -> None:
    world = World()
    world.torque_on(OperatingMode.CURRENT)
    assert world.write("Goal Current", 500) == NONE
    for _ in range(5):
        world.now_s += 0.01
        world.servo.heard(world.now_s)
        world.servo.move(world.now_s)
        by_name = world.value("Present Position")
        _, read = world.servo.read(132, 4)
        assert int.from_bytes(read, "little") == by_name
    assert by_name == round(world.servo.joint.position_rad / RAD_PER_TICK) + 2048 != 2048


def test_current_is_torque() -> None:
    world = World()
    world.torque_on(OperatingMode.CURRENT)
    assert world.write("Goal Current", 0) == NONE
    world.run(0.5)
    assert world.servo.joint.velocity_rad_s == 0.0
    assert world.write("Goal Current", 100) == NONE
    world.run(0.05)
    assert world.value("Present Current") == 100
    joint = world.servo.joint
    assert joint.torque_nm == pytest.approx(0.269 * 4.1 / 2.3)
    assert joint.velocity_rad_s > 0.0
    # An opposite torque of the same size holds the joint in place.
    world.run(1.0)
    joint.pushed_nm, joint.velocity_rad_s = -joint.torque_nm, 0.0
    position = joint.position_rad
    world.run(0.5)
    assert joint.position_rad == position


def test_the_goal_current_bounds_the_torque_of_mode_5() -> None:
    world = World()
    world.torque_on(OperatingMode.CURRENT_BASED_POSITION)
    assert world.write("Goal Current", 50) == NONE
    assert world.write("Goal Position", 4000) == NONE
    highest = 0
    for _ in range(100):
        world.run(0.01)
        highest = max(highest, abs(world.value("Present Current")))
    assert highest == 50


@pytest.mark.parametrize("goal", [-100, 60])
def test_velocities_are_reached(goal: int) -> None:
    world = World()
    world.torque_on(OperatingMode.VELOCITY)
    assert world.write("Goal Velocity", goal) == NONE
    world.run(1.0)
    assert world.value("Present Velocity") == pytest.approx(goal, rel=0.2)
    assert math.copysign(1.0, world.servo.joint.position_rad) == math.copysign(1.0, goal)


def test_torque_off_lets_it_run_free() -> None:
    world = World()
    world.torque_on(OperatingMode.POSITION)
    world.servo.joint.pushed_nm = 0.5
    world.run(0.5)
    held = world.servo.joint.position_rad
    assert abs(held) < 0.3
    assert world.write("Torque Enable", 0) == NONE
    world.run(0.5)
    assert world.servo.joint.position_rad > held + 1.0
    assert world.value("Present Current") == 0


def test_torque_on_holds_where_it_is() -> None:
    world = World(position_rad=0.5)
    assert world.write("Goal Position", 1000) == NONE
    world.torque_on(OperatingMode.POSITION)
    world.run(0.5)
    assert world.servo.joint.position_rad == pytest.approx(0.5, abs=2e-3)


@pytest.mark.parametrize(
    ("mode", "set_goal"),
    [
        (OperatingMode.CURRENT, lambda world: world.write("Goal Current", 200)),
        (OperatingMode.VELOCITY, lambda world: world.write("Goal Velocity", 100)),
        (OperatingMode.EXTENDED_POSITION, lambda world: world.write("Goal Position", 100_000)),
    ],
)
def test_the_bus_watchdog_stops_it(mode: OperatingMode, set_goal: Callable[[World], ErrorNumber]) -> None:
    world = World()
    assert world.write("Bus Watchdog", 5) == NONE
    # The watchdog has no effect before torque is on.
    world.run(1.0, heard=False)
    assert world.value("Bus Watchdog") == 5
    world.torque_on(mode)
    assert set_goal(world) == NONE
    world.run(1.0)
    moving = world.servo.joint.position_rad
    assert moving > 1.0
    assert world.value("Bus Watchdog") == 5
    world.run(0.09, heard=False)
    assert world.value("Bus Watchdog") == 5
    world.run(0.03, heard=False)
    assert world.value("Bus Watchdog") == -1
    assert world.servo.read(98, 1) == (NONE, b"\xff")
    world.run(1.0, heard=False)
    assert world.value("Present Current") == pytest.approx(0, abs=20)
    assert world.value("Present Velocity") == 0
    # The servo refuses goals until the watchdog is set to 0.
    for name in ("Goal PWM", "Goal Current", "Goal Velocity", "Goal Position"):
        assert world.write(name, 0) == RANGE
    assert world.write("Bus Watchdog", 5) == RANGE
    assert world.write("Bus Watchdog", 0) == NONE
    assert set_goal(world) == NONE
    world.run(1.0, heard=False)
    assert world.value("Bus Watchdog") == 0


def test_the_time_of_the_bus_watchdog_does_not_depend_on_when_it_is_looked_at() -> None:
    world = World()
    world.torque_on(OperatingMode.CURRENT)
    assert world.write("Goal Current", 100) == NONE
    assert world.write("Bus Watchdog", 2) == NONE
    other = World()
    other.torque_on(OperatingMode.CURRENT)
    assert other.write("Goal Current", 100) == NONE
    assert other.write("Bus Watchdog", 2) == NONE
    world.run(0.4, heard=False)
    other.now_s += 0.4
    other.servo.advance(other.now_s)
    assert other.value("Bus Watchdog") == -1
    assert other.servo.joint.position_rad == pytest.approx(world.servo.joint.position_rad, abs=0.02)


@pytest.mark.parametrize("error", list(HardwareError))
def test_hardware_errors_last_until_a_reboot(error: HardwareError) -> None:
    world = World()
    world.torque_on(OperatingMode.POSITION)
    world.servo.fail(error)
    # Shutdown is 52: overload, electrical shock, overheating.
    shuts_down = bool(error & 52)
    assert world.servo.torque is not shuts_down
    assert world.servo.alert == 0x80
    assert world.write("Torque Enable", 0) == NONE
    assert world.write("Torque Enable", 1) == (FAIL if shuts_down else NONE)
    world.servo.reboot(world.now_s)
    assert not world.servo.is_listening(world.now_s + 0.1)
    assert world.servo.is_listening(world.now_s + 0.2)
    assert (world.servo.alert, world.servo.torque) == (0, False)


def test_temperature_and_voltage_beyond_their_limits_are_hardware_errors() -> None:
    world = World()
    world.torque_on(OperatingMode.POSITION)
    world.servo.temperature_c = 81.0
    world.run(0.01)
    assert (world.value("Hardware Error Status"), world.servo.torque) == (HardwareError.OVERHEATING, False)
    world.servo.temperature_c = 30.0
    world.run(0.01)
    assert world.value("Hardware Error Status") == HardwareError.OVERHEATING
    world.servo.voltage_v = 9.4
    world.run(0.01)
    assert world.value("Hardware Error Status") == HardwareError.OVERHEATING | HardwareError.INPUT_VOLTAGE
    assert world.value("Present Input Voltage") == 94


def test_a_reboot_forgets_ram_and_keeps_eeprom() -> None:
    world = World()
    for name, value in (("Operating Mode", 4), ("Homing Offset", 50), ("LED", 1), ("Bus Watchdog", 3)):
        assert world.write(name, value) == NONE
    assert world.write("Torque Enable", 1) == NONE
    world.servo.reboot(world.now_s)
    assert (world.value("Operating Mode"), world.value("Homing Offset")) == (4, 50)
    assert (world.value("LED"), world.value("Bus Watchdog"), world.value("Torque Enable")) == (0, 0, 0)
    assert world.servo.restarts == 1


@pytest.mark.parametrize(
    ("position_rad", "mode", "drive_mode", "offset", "ticks"),
    [
        (0.0, 3, 0, 0, 2048),
        (0.5, 3, 0, 0, 2048 + 326),
        (0.5, 3, 1, 0, 2048 - 326),
        (0.5, 3, 0, 1000, 3048 + 326),
        # Slightly more than one turn: the encoder covers one turn only.
        (2.0 * math.pi + 0.1, 3, 0, 0, 2048 + 65),
        (-math.pi - 0.1, 4, 0, 0, 4096 - 65),
    ],
)
def test_positions_at_power_on(position_rad: float, mode: int, drive_mode: int, offset: int, ticks: int) -> None:
    world = World(position_rad=position_rad)
    assert world.write("Operating Mode", mode) == NONE
    assert world.write("Drive Mode", drive_mode) == NONE
    assert world.write("Homing Offset", offset) == NONE
    world.servo.reboot(world.now_s)
    world.servo.advance(world.now_s + 1.0)
    assert world.value("Present Position") == ticks


def test_turns_count_until_they_are_cleared() -> None:
    world = World()
    world.torque_on(OperatingMode.EXTENDED_POSITION)
    assert world.write("Goal Position", 3 * 4096) == NONE
    world.run(0.5)
    assert world.servo.clear_turns() == FAIL
    world.run(8.0)
    assert world.value("Present Position") == pytest.approx(3 * 4096, abs=3)
    assert world.servo.clear_turns() == NONE
    world.servo.advance(world.now_s)
    assert 0 <= world.value("Present Position") < 4096


def test_a_reversed_servo_turns_the_other_way() -> None:
    world = World()
    assert world.write("Drive Mode", 1) == NONE
    world.torque_on(OperatingMode.CURRENT)
    assert world.write("Goal Current", 100) == NONE
    world.run(0.2)
    assert world.servo.joint.position_rad < 0.0
    assert world.value("Present Current") == 100
    assert world.value("Present Position") > 2048


def test_indirect_addresses_join_what_lies_apart() -> None:
    world = World("XL330-M288")
    table = world.servo.model.table
    for index, address in enumerate([116, 117, 118, 119, 102, 103]):
        assert world.write(f"Indirect Address {1 + index}", address) == NONE
    data = table["Indirect Data 1"].address
    goals = (1000).to_bytes(4, "little") + (77).to_bytes(2, "little")
    assert world.servo.write(data, goals, world.now_s) == NONE
    assert (world.value("Goal Position"), world.value("Goal Current")) == (1000, 77)
    assert world.servo.read(data, 6) == (NONE, goals)
    # Half an entry is invalid.
    assert world.servo.write(data, goals[:2], world.now_s) == LENGTH
    # Indirect access bypasses neither a lock nor a limit.
    assert world.servo.write(data, (5000).to_bytes(4, "little"), world.now_s) == LIMIT
    assert world.write("Indirect Address 1", 11) == RANGE


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"inertia": 0.0}, "inertia = 0: must be finite and positive"),
        ({"viscous": -1.0}, "viscous = -1: must be finite and 0 or more"),
        ({"coulomb": math.nan}, "coulomb = nan: must be finite and 0 or more"),
    ],
)
def test_impossible_loads_are_refused(fields: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        JointSettings(**{"inertia": 1.0, "viscous": 0.0, "coulomb": 0.0, **fields})


@pytest.mark.parametrize(
    ("servo_id", "baud", "firmware", "said"),
    [
        (253, 57600, 52, "id 253: must be 0 to 252"),
        (1, 4_500_000, 52, "a XL330-M288 must have one of"),
        (1, 57600, 256, "firmware = 256: must be 0 to 255"),
    ],
)
def test_impossible_servos_are_refused(servo_id: int, baud: int, firmware: int, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        Servo(SERVO_MODELS["XL330-M288"], servo_id, baud=baud, firmware=firmware)


@given(
    model=st.sampled_from(sorted(SERVO_MODELS)),
    acts=st.lists(
        st.one_of(
            st.tuples(st.integers(0, 700), st.binary(min_size=0, max_size=8)),
            st.tuples(st.sampled_from([64, 98, 100, 102, 104, 116, 11]), st.binary(min_size=1, max_size=4)),
            st.floats(0.0, 2.0),
        ),
        max_size=30,
    ),
)
def test_whatever_is_written_it_stays_finite(model: str, acts: list[tuple[int, bytes] | float]) -> None:
    servo = Servo(SERVO_MODELS[model], 1)
    now_s = 0.0
    servo.advance(now_s)
    for act in acts:
        if isinstance(act, float):
            now_s += act
            servo.advance(now_s)
        else:
            servo.heard(now_s)
            servo.write(*act, now_s)
        joint = servo.joint
        assert all(map(math.isfinite, (joint.position_rad, joint.velocity_rad_s, joint.torque_nm)))
        assert abs(joint.torque_nm) <= servo.model.recommended.torque_nm * (1.0 + 1e-9)
        assert servo.torque or joint.torque_nm == 0.0 or not isinstance(act, float)
