"""Calibration deltas of one arm: real files are read; impossible deltas are refused with file and key."""

from pathlib import Path

import msgspec
import pytest

from haptether.slave import UrCalibration, UrKinematics, UrModel, read_calibration, ur_model
from haptether.slave.ur.kinematics.chain import deviation, dh_rows
from ur.arms import CALIBRATIONS

ZEROS = "0.0, 0.0, 0.0, 0.0, 0.0"


def as_toml(calibration: UrCalibration) -> str:
    return "".join(f"{key} = {list(values)}\n" for key, values in msgspec.structs.asdict(calibration).items())


@pytest.mark.parametrize("arm", CALIBRATIONS)
def test_a_real_calibration_is_read_and_small(arm: str, tmp_path: Path) -> None:
    model, calibration = CALIBRATIONS[arm]
    file = tmp_path / "calibration.toml"
    file.write_text(as_toml(calibration), encoding="utf-8")
    assert read_calibration(file, model) == calibration
    metres, radians = deviation(dh_rows(model, calibration), dh_rows(model))
    # However far away its common normals are, a real arm deviates by millimetres and mrad; and it does deviate.
    assert 1e-4 < metres < 0.02
    assert 1e-5 < radians < 0.02


def test_whole_numbers_and_absent_keys_will_do(tmp_path: Path) -> None:
    file = tmp_path / "calibration.toml"
    file.write_text("delta_a = [0, 0, 0, 0, 0, 0]", encoding="utf-8")
    assert read_calibration(file, ur_model("ur3")) == UrCalibration()


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (f"delta_b = [0.0, {ZEROS}]", "unknown field `delta_b`"),
        ("delta_a = [0.0]", "length 6.*delta_a"),
        (f"delta_a = [0.0, 0.0, {ZEROS}]", "length 6.*delta_a"),
        (f"delta_a = ['0', {ZEROS}]", r"Expected `float`, got `str`.*delta_a\[0\]"),
        ("delta_a = 0.0", "Expected `array`.*delta_a"),
        (f"delta_a = [nan, {ZEROS}]", "delta_a of joint 1 = nan"),
        (f"delta_theta = [{ZEROS}, -inf]", "delta_theta of joint 6 = -inf"),
        (f"delta_d = [0.03, {ZEROS}]", r"delta_d of joint 1 = 0.03: must be finite and within \+-0.02"),
        (f"delta_d = [0.0, 3000.0, {ZEROS[5:]}]", "delta_d of joint 2 = 3000.0"),
        (f"delta_alpha = [1.5707, {ZEROS}]", "delta_alpha of joint 1"),
        # Each delta is within its own bounds, and no other delta compensates it.
        (f"delta_d = [0.0, 200.0, {ZEROS[5:]}]", "deltas move the flange of a ur3 by 200 m"),
        (f"delta_theta = [0.0, 1.0, {ZEROS[5:]}]", "1 rad: must be at most"),
        ("delta_a = [0.0", "calibration.toml: "),
    ],
)
def test_what_is_wrong_is_named(text: str, message: str, tmp_path: Path) -> None:
    file = tmp_path / "calibration.toml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ValueError, match=rf"calibration\.toml: .*{message}" if "toml" not in message else message):
        read_calibration(file, ur_model("ur3"))


def test_deltas_of_another_arm_are_refused() -> None:
    # The UR10's far calibration shortens an upper arm by 0.632 m; a UR5's is 0.425 m long.
    _, calibration = CALIBRATIONS["ur10 far"]
    with pytest.raises(ValueError, match="deltas move the flange of a ur5"):
        UrKinematics(ur_model("ur5"), calibration)


def test_arms_are_distinguished_only_as_far_as_they_differ() -> None:
    model: UrModel = ur_model("ur10")
    _, calibration = CALIBRATIONS["ur10 near"]
    calibration.check(model)
    UrCalibration().check(model)
