"""Torque of the environment from currents: on emulated servos in virtual time, where the applied torque is known."""

from pathlib import Path

import numpy as np
import pytest

from haptether.dynamixel import SERVO_MODELS, OperatingMode
from haptether.dynamixel.arm import ServoSettings
from haptether.dynamixel.control_table import RAD_PER_TICK, RAD_S_PER_UNIT
from haptether.dynamixel.emulator import JointSettings, Servo
from haptether.slave.dynamixel.torque import JointTorque

DOCUMENT = Path(__file__).parents[2] / "docs/dynamixel.md"
MODELS = ("XL330-M288", "XM430-W350")
SHARES = (0.0, 0.01, 0.05, 0.1, 0.2, 0.4)
"""Applied torques as shares of the stall torque."""
SPEED_RAD_S = 0.5
STEP_S = 0.002


def estimated(model_name: str, applied_nm: float, speed_rad_s: float, *, compensated: bool) -> float:
    """Return the estimated torque on an emulated joint that holds an angle, or follows one at a speed."""
    model = SERVO_MODELS[model_name]
    load = JointSettings.of(model)
    servo = Servo(model, 1, position_rad=0.0)
    table = model.table
    now_s = 0.0

    def write(name: str, value: int) -> None:
        servo.heard(now_s)
        assert not servo.write(table[name].address, table[name].encoded(value), now_s)

    write("Operating Mode", OperatingMode.CURRENT_BASED_POSITION)
    write("Torque Enable", 1)
    begin = servo.value("Present Position")
    settings = ServoSettings(servo_id=1, model=model_name, mode=OperatingMode.CURRENT_BASED_POSITION)
    torque = JointTorque(
        [settings],
        coulomb=[load.coulomb] if compensated else (),
        viscous=[load.viscous] if compensated else (),
        filter_hz=5.0,
    )
    servo.joint.pushed_nm = applied_nm
    told = 0.0
    for step in range(round(1.5 / STEP_S)):
        now_s = step * STEP_S
        servo.heard(now_s)
        servo.advance(now_s)
        write("Goal Position", begin + round(speed_rad_s * now_s / RAD_PER_TICK))
        current = servo.value("Present Current") * (model.current_unit_a or 0.0)
        velocity = servo.value("Present Velocity") * RAD_S_PER_UNIT
        told = float(torque.of(np.array([current]), np.array([velocity]), STEP_S)[0])
    return told


def rows() -> list[str]:
    """Return the table of the document."""
    lines = []
    for name in MODELS:
        stall = SERVO_MODELS[name].recommended.torque_nm
        for share in SHARES:
            told = [
                estimated(name, share * stall, speed, compensated=compensated)
                for speed in (0.0, SPEED_RAD_S)
                for compensated in (False, True)
            ]
            cells = " | ".join(f"{value + 0.0:.3f}" for value in told)
            lines.append(f"| {name} | {share * stall:.3f} | {cells} |")
    return lines


def test_the_document_has_what_the_emulator_gives() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for line in rows():
        assert line in text, line


@pytest.mark.parametrize("model", MODELS)
@pytest.mark.parametrize("share", [-0.4, -0.1, 0.1, 0.4])
def test_moving_friction_is_taken_out_and_standing_it_is_the_error(model: str, share: float) -> None:
    stall = SERVO_MODELS[model].recommended.torque_nm
    friction = JointSettings.of(SERVO_MODELS[model]).coulomb
    applied = share * stall
    for speed in (SPEED_RAD_S, -SPEED_RAD_S):
        moving = estimated(model, applied, speed, compensated=True)
        assert moving == pytest.approx(applied, abs=0.015 * stall)
        raw = estimated(model, applied, speed, compensated=False)
        # Without compensation, the friction of the gear appears as a push against the motion.
        assert abs(raw - applied) > 0.9 * friction
    standing = estimated(model, applied, 0.0, compensated=True)
    # The estimate is at most the applied torque, and too low at most by the friction.
    assert abs(standing) <= abs(applied) + 0.005 * stall
    assert abs(standing - applied) <= 2.0 * friction + 0.005 * stall


def test_what_has_no_current_tells_nothing() -> None:
    servo = ServoSettings(servo_id=1, model="XL430-W250", mode=OperatingMode.EXTENDED_POSITION)
    torque = JointTorque([servo], coulomb=[0.1])
    assert torque.of(np.array([np.nan]), np.array([1.0]), 0.01) == [0.0]


def test_the_filter_is_of_first_order() -> None:
    servo = ServoSettings(servo_id=1, model="XM430-W350")
    torque = JointTorque([servo], constant=[1.0], filter_hz=1.0)
    assert torque.of(np.array([0.0]), np.array([0.0]), 0.1) == [0.0]
    # 1 - exp(-2 pi 0.1).
    assert torque.of(np.array([-1.0]), np.array([0.0]), 0.1) == pytest.approx([0.4665], abs=1e-4)
