"""Descriptions of arms: refusals, and kinematics and gravity against closed forms, differences and Pinocchio."""

import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pinocchio as pin  # type: ignore[import-untyped]
import pytest

from haptether.dynamixel.description import ArmDescription, ArmDescriptionError, ArmKinematics, arm_names, load_arm

Array = npt.NDArray[np.float64]

TWO_LINKS = """
name = "two"
title = "Two links in a vertical plane"
source = "made up"

[[joints]]
name = "first"
servo = 1
model = "XM430-W350"
sign = 1
xyz_m = [0.0, 0.0, 0.0]
axis = [0.0, -1.0, 0.0]
low_rad = -3.0
high_rad = 3.0
coulomb_nm = 0.05
viscous_nm_s = 0.02
friction_source = "made up"
link = { mass_kg = 0.3, com_m = [0.1, 0.0, 0.0], source = "made up" }

[[joints]]
name = "second"
servo = 2
model = "XC330-T288"
sign = -1
offset_rad = 0.4
xyz_m = [0.25, 0.0, 0.0]
axis = [0.0, -1.0, 0.0]
low_rad = -2.5
high_rad = 2.5
near_rad = 0.5
coulomb_nm = 0.02
viscous_nm_s = 0.01
friction_source = "made up"
link = { mass_kg = 0.2, com_m = [0.08, 0.0, 0.0], source = "made up" }

[tool]
xyz_m = [0.2, 0.0, 0.0]

[trigger]
servo = 3
model = "XL330-M288"
open_rad = 0.6
closed_rad = -0.2
lever_m = 0.04
source = "made up"
"""


def pinocchio_of(arm: ArmDescription) -> pin.Model:
    """Build the same arm in Pinocchio."""
    model = pin.Model()
    model.gravity.linear = np.array(arm.gravity_m_s2)
    parent = 0
    for joint in arm.joints:
        placed = pin.SE3(np.eye(3), np.array(joint.xyz_m))
        parent = model.addJoint(parent, pin.JointModelRevoluteUnaligned(np.array(joint.axis)), placed, joint.name)
        if joint.link is not None:
            inertia = pin.Inertia(joint.link.mass_kg, np.array(joint.link.com_m), np.zeros((3, 3)))
            model.appendBodyToJoint(parent, inertia, pin.SE3.Identity())
    w, x, y, z = arm.tool.quat_wxyz
    placed = pin.SE3(pin.Quaternion(w, x, y, z).matrix(), np.array(arm.tool.xyz_m))
    model.addFrame(pin.Frame("tool", parent, 0, placed, pin.FrameType.OP_FRAME))
    return model


def close(seen: npt.ArrayLike, expected: npt.ArrayLike, atol: float) -> None:
    np.testing.assert_allclose(np.asarray(seen, dtype=float), np.asarray(expected, dtype=float), atol=atol, rtol=0.0)


def rotation(quat: list[float]) -> Array:
    w, x, y, z = quat
    return np.asarray(pin.Quaternion(w, x, y, z).matrix())


def postures(arm: ArmDescription, count: int = 25) -> list[Array]:
    random = np.random.default_rng(4)
    low, high = np.array([(joint.low_rad, joint.high_rad) for joint in arm.joints]).T
    return [random.uniform(low, high) for _ in range(count)]


@pytest.mark.parametrize("name", arm_names())
def test_it_agrees_with_pinocchio(name: str) -> None:
    arm = load_arm(name)
    kinematics, model = ArmKinematics(arm), pinocchio_of(arm)
    other, tool = model.createData(), model.getFrameId("tool")
    random = np.random.default_rng(1)
    for q in postures(arm):
        dq, wrench = random.normal(size=len(q)), random.normal(size=6)
        pin.computeJointJacobians(model, other, q)
        pin.updateFramePlacements(model, other)
        placed = other.oMf[tool]
        jacobian = pin.getFrameJacobian(model, other, tool, pin.LOCAL_WORLD_ALIGNED)
        position, quat, twist = kinematics.state(q, dq)
        close(position, placed.translation, atol=1e-12)
        close(rotation(quat), placed.rotation, atol=1e-12)
        close(twist, jacobian @ dq, atol=1e-12)
        close(kinematics.jacobian(q), jacobian, atol=1e-12)
        close(kinematics.torques(q, wrench), jacobian.T @ wrench, atol=1e-12)
        close(
            kinematics.gravity(q), pin.computeGeneralizedGravity(model, other, q), atol=1e-12
        )  # fmt: skip
        close(kinematics.link_inertia(q), np.diag(pin.crba(model, other, q)), atol=1e-12)


@pytest.mark.parametrize("name", arm_names())
def test_jacobian_and_gravity_are_derivatives(name: str) -> None:
    arm = load_arm(name)
    kinematics = ArmKinematics(arm)
    zero = np.zeros(len(arm.joints))
    for q in postures(arm, 5):
        jacobian, gravity = kinematics.jacobian(q), kinematics.gravity(q)
        for index in range(len(q)):
            step = np.zeros(len(q))
            step[index] = 1e-6
            (after, turned, _), (before, from_quat, _) = (
                kinematics.state(q + step, zero),
                kinematics.state(q - step, zero),
            )
            close((np.array(after) - np.array(before)) / 2e-6, jacobian[:3, index], atol=1e-8)
            skew = (rotation(turned) - rotation(from_quat)) / 2e-6 @ rotation(kinematics.state(q, zero)[1]).T
            close((skew[2, 1], skew[0, 2], skew[1, 0]), jacobian[3:, index], atol=1e-8)
            slope = (kinematics.energy(q + step) - kinematics.energy(q - step)) / 2e-6
            assert gravity[index] == pytest.approx(slope, abs=1e-8)


@pytest.mark.parametrize("name", arm_names())
def test_gravity_is_bounded_by_what_is_said(name: str) -> None:
    arm = load_arm(name)
    kinematics = ArmKinematics(arm)
    most = np.array(kinematics.most_gravity())
    seen = np.max([np.abs(kinematics.gravity(q)) for q in postures(arm, 200)], axis=0)
    assert (seen <= most + 1e-12).all()
    assert arm.knows_masses == bool(most.any())


def test_the_orientation_does_not_jump() -> None:
    arm = load_arm("gello-ur")
    kinematics = ArmKinematics(arm)
    before = None
    for angle in np.linspace(-6.0, 6.0, 400):
        _, quat, _ = kinematics.state([angle, -1.0, 1.0, angle, 0.5, angle], [0.0] * 6)
        assert math.hypot(*quat) == pytest.approx(1.0, abs=1e-12)
        if before is not None:
            assert np.abs(np.array(quat) - before).max() < 0.1
        before = np.array(quat)


@pytest.mark.parametrize("q", [(0.0, 0.0), (0.3, -0.8), (-1.2, 2.0)])
def test_two_links_have_their_closed_form(two: ArmDescription, q: tuple[float, float]) -> None:
    """Siciliano et al. 2009, Eq. 7.82; the axes point along -y, so that a positive angle lifts."""
    kinematics = ArmKinematics(two)
    a, b = q
    g, (m1, l1, a1), (m2, l2, a2) = 9.81, (0.3, 0.1, 0.25), (0.2, 0.08, 0.2)
    expected = ((m1 * l1 + m2 * a1) * g * math.cos(a) + m2 * l2 * g * math.cos(a + b), m2 * l2 * g * math.cos(a + b))
    close(kinematics.gravity(q), expected, atol=1e-12)
    position, _, _ = kinematics.state(q, (0.0, 0.0))
    place = (a1 * math.cos(a) + a2 * math.cos(a + b), 0.0, a1 * math.sin(a) + a2 * math.sin(a + b))
    close(position, place, atol=1e-12)
    inertia = (m1 * l1**2 + m2 * (a1**2 + l2**2 + 2 * a1 * l2 * math.cos(b)), m2 * l2**2)
    close(kinematics.link_inertia(q), inertia, atol=1e-12)


def test_gello_stands_as_a_ur_does_where_its_angles_are_zero() -> None:
    """With all angles zero, a UR's arm lies along -x, and the axis of its third wrist joint along -y."""
    arm = load_arm("gello-ur")
    kinematics = ArmKinematics(arm)
    position, quat, _ = kinematics.state([0.0] * 6, [0.0] * 6)
    assert position[0] < -0.4
    close(rotation(quat)[:, 2], (0.0, -1.0, 0.0), atol=1e-12)


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ('name = "two"', 'name = "two"\nweight = 3', "unknown field `weight`"),
        ("sign = -1", "sign = 2", "`sign` = 2: must be 1 or -1 - at `$.joints[1]`"),
        ("xyz_m = [0.25, 0.0, 0.0]", "xyz_m = [25.0, 0.0, 0.0]", "`xyz_m` = 25: must be -2 to 2 - at `$.joints[1]`"),
        ("axis = [0.0, -1.0, 0.0]", "axis = [0.0, -1.1, 0.0]", "`axis` = [0.0, -1.1, 0.0]: must be of length 1"),
        ("axis = [0.0, -1.0, 0.0]", "axis = [0.0, nan, 0.0]", "`axis` = [0.0, nan, 0.0]: must be of length 1"),
        ("mass_kg = 0.3", "mass_kg = 0.0", "`float` > 0.0 - at `$.joints[0].link.mass_kg`"),
        ("mass_kg = 0.3", "weighs = 0.3", "$.joints[0].link"),
        ('model = "XC330-T288"', 'model = "XC331"', "`model` = 'XC331': must be one of XL330-M077"),
        ("servo = 2", "servo = 1", "`servo` = 1 is given twice"),
        ("low_rad = -3.0", "low_rad = 3.5", "`low_rad` = 3.5: must be below `high_rad` = 3"),
        ("near_rad = 0.5", "near_rad = 2.8", "`near_rad` = 2.8: must be -2.5 to 2.5 - at `$.joints[1]`"),
        ("coulomb_nm = 0.05\n", "", "`coulomb_nm` and `viscous_nm_s`: must both be there"),
        ('friction_source = "made up"\n', "", "`friction_source` is missing"),
        ("closed_rad = -0.2", "closed_rad = 0.6", "`closed_rad` = 0.6: must be at least 0.01 rad from `open_rad`"),
        (
            "[tool]",
            "[tool]\nquat_wxyz = [1.0, 1.0, 0.0, 0.0]",
            "`quat_wxyz` = [1.0, 1.0, 0.0, 0.0]: must be",
        ),
        ('name = "two"', 'name = "two"\ngravity_m_s2 = [0.0, 0.0, -98.1]', "`gravity_m_s2` = [0.0, 0.0, -98.1]"),
        ('name = "two"', "name = ", "Invalid value"),
    ],
)
def test_bad_descriptions_are_refused(old: str, new: str, said: str, tmp_path: Path) -> None:
    assert old in TWO_LINKS
    path = tmp_path / "arm.toml"
    path.write_text(TWO_LINKS.replace(old, new, 1))
    with pytest.raises(ArmDescriptionError) as refused:
        load_arm(path)
    assert said in str(refused.value)
    assert str(path) in str(refused.value)


def test_a_name_that_is_none_is_refused() -> None:
    with pytest.raises(ArmDescriptionError, match="must be a file, or one of aloha-wx250s, factr, gello-ur, koch-v1-1"):
        load_arm("gelo")


def test_what_is_not_known_is_said() -> None:
    koch = load_arm("koch-v1-1")
    assert not koch.knows_masses
    assert any("no gravity compensation" in note for note in koch.notes)
    for name in arm_names():
        arm = load_arm(name)
        assert arm.name == name
        assert arm.source
        assert arm.notes
        assert not arm.knows_friction
