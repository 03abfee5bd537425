"""Values of a gripper from its servo's measurements: opening, force, object, and the effect of a hold."""

import struct
from typing import Any

import pytest

from haptether.dynamixel.arm import ArmFaultError, FaultKind, GripServo
from haptether.slave.dynamixel.gripper.driver import DynamixelGripper
from haptether.slave.dynamixel.gripper.options import dynamixel_gripper_options

OPTIONS = {"id": 7, "model": "XL330-M288", "open_rad": 0.2, "closed_rad": -0.8, "lever_m": 0.05}
RAD_PER_TICK = 2.0 * 3.141592653589793 / 4096.0
TICK_S = 0.004
CAP = 525
"""0.3 of 1.75 A, in units of 1 mA."""


def grip(**options: Any) -> GripServo:  # noqa: ANN401  # of the driver
    return GripServo(dynamixel_gripper_options({**OPTIONS, **options}).settings())


def ticks(rad: float) -> int:
    return round(rad / RAD_PER_TICK) + 2048


class Line:
    """A line that records sent writes and answers nothing."""

    def __init__(self) -> None:
        self.sent: list[tuple[int, bytes, bytes]] = []

    def sync_write(self, address: int, length: int, ids: bytes, sent: bytes) -> None:
        assert len(sent) == length * len(ids)
        self.sent.append((address, ids, sent))


def stand(servo: GripServo, rad: float, current: int, ticks_long: int = 40, begin_s: float = 0.0) -> None:
    """Keep the servo at an angle with a current for some ticks."""
    for index in range(ticks_long):
        servo.take((current, 0, ticks(rad)), begin_s + TICK_S * index)


@pytest.mark.parametrize(("opened", "closed"), [(0.2, -0.8), (-0.8, 0.2)])
def test_its_opening_is_between_its_ends_in_either_direction(opened: float, closed: float) -> None:
    servo = grip(open_rad=opened, closed_rad=closed)
    for position in (0.0, 0.25, 1.0):
        servo.take((0, 10, ticks(opened + position * (closed - opened))), 0.0)
        assert servo.position == pytest.approx(position, abs=RAD_PER_TICK)
    # 10 units of 0.229 rev/min over 1 rad, in the direction of closing.
    assert servo.velocity == pytest.approx((0.2398 if closed > opened else -0.2398), rel=1e-3)


def test_force_is_current_times_constant_over_lever() -> None:
    servo = grip(torque_constant=0.4)
    servo.take((-300, 0, ticks(0.0)), 0.0)
    assert servo.force_n == pytest.approx(0.3 * 0.4 / 0.05)
    assert servo.settings.most_n == pytest.approx(0.525 * 0.4 / 0.05)


@pytest.mark.parametrize(
    ("current", "is_object"),
    [(-CAP, True), (-430, True), (-300, False), (CAP, False)],
    ids=["at the cap", "near it", "below it", "the other way"],
)
def test_an_object_is_what_stops_jaws_that_press_with_their_cap(current: int, is_object: bool) -> None:
    servo = grip()
    servo.write(1.0, 1.0, 100.0)
    stand(servo, -0.3, current)
    assert servo.holds_object is is_object


def test_jaws_that_have_not_stood_long_that_move_or_that_have_arrived_hold_nothing() -> None:
    servo = grip()
    servo.write(1.0, 1.0, 100.0)
    stand(servo, -0.3, -CAP, 20)
    assert not servo.holds_object
    for index in range(60):
        servo.take((-CAP, -20, ticks(-0.3)), 1.0 + TICK_S * index)
    assert not servo.holds_object
    stand(servo, -0.79, -CAP, begin_s=2.0)
    assert not servo.holds_object


def test_an_object_is_lost_by_slipping_or_by_a_goal_on_its_other_side() -> None:
    servo = grip()
    for lost in ("slips", "is let go"):
        servo.write(1.0, 1.0, 100.0)
        stand(servo, -0.3, -CAP)
        assert servo.holds_object
        # A slightly lower force or a nearer goal does not lose the object.
        servo.write(0.6, 1.0, 1.0)
        servo.take((-100, 0, ticks(-0.31)), 1.0)
        assert servo.holds_object, lost
        if lost == "slips":
            servo.take((-CAP, -20, ticks(-0.37)), 1.1)
        else:
            servo.write(0.3, 1.0, 1.0)
            servo.take((-CAP, 0, ticks(-0.3)), 1.1)
        assert not servo.holds_object, lost


def test_a_hold_stops_jaws_that_move_and_keeps_the_force_of_those_that_press() -> None:
    line = Line()
    servo = grip()
    servo.write(1.0, 1.0, 2.0)
    servo.send(line)  # type: ignore[arg-type]
    # No object is detected yet, but the jaws press: a stop there would drop it.
    servo.take((-400, 0, ticks(-0.3)), 0.0)
    servo.hold()
    assert not servo.is_due
    for index in range(3):
        servo.take((-50, -30, ticks(-0.3)), TICK_S * index)
    servo.hold()
    assert servo.is_due
    assert struct.unpack("<i", servo.goal)[0] == ticks(-0.3)


def test_unmeasured_gripper_is_not_moved() -> None:
    """A refused arm ends in `close`; unmeasured jaws may hold an object and must not move."""
    servo = grip()
    servo.hold()
    assert not servo.is_due


def test_force_and_speed_are_cut_to_what_it_may() -> None:
    line = Line()
    servo = grip(max_speed=1.0)
    # 1 N at 0.05 m with the largest published constant, 0.378 N m/A.
    for force_n, speed, cap, units in ((1e4, 100.0, CAP, 41), (1.0, 0.5, 132, 20), (0.0, 1e-6, 1, 1)):
        servo.write(1.0, speed, force_n)
        servo.send(line)  # type: ignore[arg-type]
        address, ids, sent = line.sent.pop()
        assert (address, ids) == (102, bytes((7,)))
        assert struct.unpack("<hiIIi", sent) == (cap, 0, 0, units, ticks(-0.8))
    # An unchanged command is not sent again.
    servo.write(1.0, 1e-6, 0.0)
    servo.send(line)  # type: ignore[arg-type]
    assert not line.sent


def test_nothing_is_sent_to_one_with_a_fault() -> None:
    servo = grip()
    servo.fail(ArmFaultError(FaultKind.OVERLOAD, "servo 7"))
    servo.write(1.0, 1.0, 1.0)
    assert not servo.is_due


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"model": "XL430-W250"}, "XL430-W250 must have one of 4"),
        ({"model": "AX-12"}, "model = 'AX-12': must be one of"),
        ({"closed_rad": 0.25}, "closed_rad = 0.25: must be 0.1 to 6 rad from open_rad = 0.2"),
        ({"closed_rad": 6.5}, "closed_rad = 6.5: must be 0.1 to 6 rad from"),
        ({"lever_m": 0.0}, "lever_m = 0.0: must be"),
        ({"cap_a": 2.0}, "cap_a = 2: a XL330-M288 must be above 0 and at most 1.75 A"),
        ({"id": 253}, "id = 253: must be"),
        ({"force": 1.0}, "force = 1.0: is no option"),
    ],
)
def test_options_that_cannot_be(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match="gripper = dynamixel") as refused:
        DynamixelGripper(**{**OPTIONS, **options})
    assert said in str(refused.value)


def test_an_option_that_is_missing_is_named() -> None:
    with pytest.raises(ValueError, match="lever_m is missing: must be torque of the servo over force of the jaws"):
        DynamixelGripper(**{key: value for key, value in OPTIONS.items() if key != "lever_m"})


def test_it_is_at_an_arm_of_servos_alone() -> None:
    gripper = DynamixelGripper(**OPTIONS)
    with pytest.raises(ValueError, match="device must be dynamixel, not object"):
        gripper.attach(object())
    with pytest.raises(ValueError, match=r"attach\(arm\) comes before open\(\)"):
        gripper.open()
