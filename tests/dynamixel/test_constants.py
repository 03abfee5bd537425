"""Torque per ampere: limits in N m hold for each published constant, and a weight measures it for one servo."""

import re
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.dynamixel.emulated import emulated_bus
from tests.dynamixel.test_calibrate import Calibration
from tests.ur.stalls import anew_after_stalls

from haptether.dynamixel import SERVO_MODELS
from haptether.dynamixel.arm import GripServo, ServoSettings, read_calibration, write_calibration
from haptether.dynamixel.arm.weigh import GRAVITY, LEAST_UNITS, weighed_constant
from haptether.master.dynamixel import DynamixelMaster
from haptether.slave.dynamixel.driver import DynamixelSlave
from haptether.slave.dynamixel.gripper.options import dynamixel_gripper_options

ROOT = Path(__file__).parents[2]
ONE_JOINT = """
name = "one"
title = "One joint, without a link"
source = "of a test"
[[joints]]
name = "joint"
servo = 1
model = "{model}"
sign = 1
xyz_m = [0.0, 0.0, 0.0]
axis = [0.0, 1.0, 0.0]
low_rad = -2.0
high_rad = 2.0
"""
CURRENT = [model for model in SERVO_MODELS.values() if model.has_current_control]
PUBLISHED = [(model.name, one.nm_per_a) for model in CURRENT for one in model.published]


@pytest.mark.parametrize(
    ("name", "constants"),
    [("XC330-T288", (0.863, 0.967, 1.150)), ("XM430-W210", (1.304, 2.69)), ("XM430-W350", (1.783, 2.482))],
)
def test_what_is_published_is_known(name: str, constants: tuple[float, ...]) -> None:
    known = [one.nm_per_a for one in SERVO_MODELS[name].published]
    for constant in constants:
        assert any(abs(one - constant) < 1e-3 for one in known), constant
    assert SERVO_MODELS[name].largest_nm_per_a == max(known)


def test_the_documents_have_the_spread_of_each_model() -> None:
    text = (ROOT / "docs" / "dynamixel.md").read_text(encoding="utf-8")
    table = text.partition("### Torque per ampere")[2]
    lines = [[cell.strip() for cell in line.split("|")[1:-1]] for line in table.splitlines()]
    rows = {cells[0]: cells for cells in lines if len(cells) == 6}
    for model in CURRENT:
        known = [one.nm_per_a for one in model.published]
        _, nominal, least, most, ratio, _ = rows[model.name]
        assert [nominal, least, most] == [f"{one:.3f}" for one in (model.nominal_nm_per_a, min(known), max(known))]
        assert ratio == f"{model.nominal_nm_per_a / max(known):.2f}"


@pytest.mark.parametrize(("name", "true_nm_per_a"), PUBLISHED)
def test_no_published_constant_makes_more_of_a_force_than_its_limit(name: str, true_nm_per_a: float) -> None:
    settings = ServoSettings(servo_id=1, model=name)
    for limit in (0.05, 0.3, 1.0):
        assert limit / settings.most_nm_per_a * true_nm_per_a <= limit * (1.0 + 1e-12)
    way = {"id": 1, "model": name, "open_rad": 0.0, "closed_rad": 1.0, "lever_m": 0.05}
    grip = GripServo(dynamixel_gripper_options(way).settings())
    grip.write(1.0, 1.0, 2.0)
    assert SERVO_MODELS[name].current_unit_a is not None
    assert grip._cap_units * grip._unit_a * true_nm_per_a / 0.05 <= 2.0


@pytest.mark.live
@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("name", "true_nm_per_a"),
    [("XC330-T288", 1.150), ("XC330-T288", 0.863), ("XM430-W210", 2.69), ("XM430-W210", 1.304), ("XM430-W350", 2.48)],
)
def test_a_leader_exerts_no_more_than_its_limit_whatever_its_servo_is(
    tmp_path: Path, name: str, true_nm_per_a: float
) -> None:
    path, limit_nm = tmp_path / "one.toml", 0.15
    path.write_text(ONE_JOINT.format(model=name))
    with emulated_bus("--arm", str(path), "--constants", f"1={true_nm_per_a}") as bus:
        bus.do("hand 1 0 40 1")
        leader = DynamixelMaster(port=bus.port, arm=str(path), ramp_s=0.1, watchdog_s=0.5, verify_watchdog=False)
        leader.open()
        try:
            end_s = time.monotonic() + 1.0
            exerted = [0.0]
            while time.monotonic() < end_s:
                leader.read()
                leader.write((limit_nm,))
                exerted.append(float(bus.servo(1)["torque_nm"]))
        finally:
            leader.close()
    assert max(exerted) <= limit_nm * 1.001
    # The ratio of this constant to the largest one and less than one unit of current reduce the torque.
    model = SERVO_MODELS[name]
    assert (
        max(exerted) > (limit_nm / model.largest_nm_per_a - model.table["Goal Current"].scale) * true_nm_per_a * 0.999
    )


def test_a_measured_constant_takes_the_place_of_what_is_published(tmp_path: Path) -> None:
    measured = ServoSettings(
        servo_id=1, model="XM430-W210", torque_constant=1.4, torque_constant_uncertainty=0.05
    )  # fmt: skip
    assert (measured.nm_per_a, measured.most_nm_per_a) == pytest.approx((1.4, 1.45))
    arm, unit = tmp_path / "one.toml", tmp_path / "unit.toml"
    arm.write_text(ONE_JOINT.format(model="XM430-W210"))
    write_calibration(unit, 4_000_000, (measured,))
    _, (found,) = read_calibration(unit)
    assert (found.torque_constant, found.torque_constant_uncertainty) == pytest.approx((1.4, 0.05))
    options: dict[str, Any] = {"port": "/dev/null", "arm": str(arm)}
    assert DynamixelMaster(**options).most_nm[0] == pytest.approx(0.3 * 3.209 * 2.69, rel=1e-3)
    assert DynamixelMaster(**options, calibration=str(unit)).most_nm[0] == pytest.approx(0.3 * 3.209 * 1.45, rel=1e-3)
    assert DynamixelSlave(port="/dev/null", arm=str(unit))._torque._constant[0] == pytest.approx(1.4)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"torque_constant": 0.0}, "torque_constant = 0: must be above 0"),
        ({"torque_constant": 21.0}, "torque_constant = 21: must be above 0 and at most 20 N m/A"),
        ({"torque_constant_uncertainty": 0.1}, "torque_constant_uncertainty = 0.1: must be 0 to torque_constant"),
        ({"torque_constant": 1.0, "torque_constant_uncertainty": -0.1}, "must be 0 to torque_constant"),
    ],
)
def test_constants_that_cannot_be(given: dict[str, float], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        ServoSettings(servo_id=1, model="XM430-W210", **given)  # type: ignore[arg-type]


# ---------------------------------------------------------------------------------------------------- a known weight

SERVO = ServoSettings(servo_id=1, model="XM430-W350")
UNIT_A = 2.69e-3


@given(
    st.floats(0.5, 3.0), st.floats(0.2, 1.0), st.floats(-0.3, 0.3), st.floats(0.0, 0.5), st.floats(0.0, 0.3),
    st.lists(st.floats(-0.5, 0.5), min_size=12, max_size=12),
)  # fmt: skip
def test_friction_and_the_weight_of_the_arm_drop_out(  # noqa: PLR0917
    constant: float, load_nm: float, own_nm: float, coulomb_nm: float, with_load: float, noise: list[float]
) -> None:
    """Check the equation with noise, I = (tau +- (c + mu |tau|)) / K_t up and down, each off by half a unit at most."""
    ways = iter(noise)

    def cycles(tau: float) -> list[tuple[float, float]]:
        rubs = coulomb_nm + with_load * abs(tau)
        return [
            ((tau + rubs) / constant + UNIT_A * next(ways), (tau - rubs) / constant + UNIT_A * next(ways))
            for _ in range(3)
        ]

    found = weighed_constant(SERVO, load_nm, 0.0, cycles(own_nm), cycles(own_nm + load_nm))
    assert abs(found.nm_per_a - constant) <= found.uncertainty_nm_per_a + 1e-9
    assert found.uncertainty_nm_per_a < 0.1 * constant


@pytest.mark.parametrize(
    ("change_a", "scatter_a", "said"),
    [
        (
            0.5 * LEAST_UNITS * UNIT_A,
            0.0,
            "the weight of 0.500 N m changes its current by 26.9 mA: must be 54 mA or more",
        ),
        (0.2, 0.05, r"is certain to \d+ % only: must be 15 % or less: take a heavier weight"),
    ],
)
def test_a_weight_that_says_too_little_is_refused(change_a: float, scatter_a: float, said: str) -> None:
    without = [(0.1, -0.1)] * 3
    changed = [(0.1 + change_a + by, -0.1 + change_a + by) for by in (-scatter_a, 0.0, scatter_a)]
    with pytest.raises(ValueError, match=said):
        weighed_constant(SERVO, 0.5, 0.02, without, changed)


@pytest.mark.live
@pytest.mark.sampled(1)
@pytest.mark.parametrize("true_nm_per_a", [1.3, 2.48])
@anew_after_stalls
def test_calibrate_measures_a_constant_with_a_weight(tmp_path: Path, true_nm_per_a: float) -> None:
    path, mass, lever = tmp_path / "arm.toml", 0.5, 0.12
    write_calibration(path, 4_000_000, (SERVO, ServoSettings(servo_id=2, model="XL330-M288", sign=-1)))
    with emulated_bus("--servos", "1=XM430-W350", "2=XL330-M288", "--constants", f"1={true_nm_per_a}") as bus:
        # The arm's own weight.
        bus.do("push 1 -0.1")
        run = Calibration(bus, path, "--weigh", "1", "--mass", str(mass), "--lever", str(lever), ids=())
        try:
            run.until("clamp the base")
            run.enter()
            run.until("it holds")
            run.enter()
            run.until("hang 0.5 kg")
            bus.do(f"push 1 {-0.1 - mass * GRAVITY * lever}")
            run.enter()
            run.until("hold the arm, take the weight off")
            bus.do("push 1 -0.1")
            run.enter()
            status, said = run.end()
        finally:
            run.close()
        assert status == 0, said
        assert not any(servo["torque"] for servo in bus.status()["servos"])
    _, (weighed, other) = read_calibration(path)
    assert weighed.torque_constant is not None
    assert weighed.torque_constant == pytest.approx(true_nm_per_a, rel=0.03)
    assert abs(weighed.torque_constant - true_nm_per_a) <= weighed.torque_constant_uncertainty
    assert weighed.most_nm_per_a >= true_nm_per_a
    assert other.torque_constant is None
    match = re.search(r"servo 1: ([\d.]+) \+- ([\d.]+) N m/A; published of a XM430-W350: 1\.778 to 2\.482", said)
    assert match, said


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--weigh", "1", "--mass", "0.5"], "lever is missing: with --weigh it must be above 0 and at most 2 m"),
        (["--weigh", "1", "--mass", "-1", "--lever", "0.1"], "mass = -1: with --weigh it must be above 0"),
        (["--weigh", "7", "--mass", "1", "--lever", "0.1"], "weigh = 7: must be a servo of"),
        (["--weigh", "3", "--mass", "1", "--lever", "0.1"], "a XL430-W250 measures no current"),
        (["--weigh", "2", "--mass", "1", "--lever", "0.1"], "turns its joint with servo 4: take them off"),
        (["--weigh", "1", "--mass", "1", "--lever", "0.1", "--tolerance", "0.5"], "tolerance = 0.5: must be 0 to 0.1"),
    ],
)
def test_what_cannot_be_weighed(tmp_path: Path, arguments: list[str], said: str) -> None:
    path = tmp_path / "arm.toml"
    servos = (
        SERVO, ServoSettings(servo_id=2, model="XM430-W350", shadows=(4,)),
        ServoSettings(servo_id=3, model="XL430-W250", mode=4),  # type: ignore[arg-type]
    )  # fmt: skip
    write_calibration(path, 4_000_000, servos)
    command = [sys.executable, "-m", "haptether", "dynamixel", "calibrate", "/dev/null", str(path), "--yes", *arguments]
    done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2, done.stderr
    assert said in done.stderr
