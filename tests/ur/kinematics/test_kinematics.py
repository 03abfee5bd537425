"""UR arms: forward kinematics and Jacobian against pinocchio, golden poses and finite differences."""

import math

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.slave import UR_MODELS, UrCalibration, UrKinematics, UrModel, ur_model
from haptether.slave.ur.kinematics.chain import chain_transform, dh_rows
from haptether.slave.ur.kinematics.pose import pose_from_transform
from ur.arms import CALIBRATIONS, TOOL, PinocchioArm

Array = npt.NDArray[np.float64]

# Answers of a controller at q = (-1.6, -1.7, -2.2, -0.8, 1.6, 0), to the stored digits.
GOLDEN_Q = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
GOLDEN_ROTVEC = (0.045165, 3.112182, -0.019942)
GOLDEN_POSITION = {
    "ur3": (-0.117870, -0.269229, 0.166052),
    "ur5": (-0.119408, -0.431865, 0.159754),
    "ur10": (-0.179025, -0.606168, 0.249870),
    "ur3e": (-0.136267, -0.268768, 0.155742),
    "ur5e": (-0.143195, -0.436400, 0.215901),
    "ur10e": (-0.188636, -0.609886, 0.280194),
    "ur16e": (-0.183646, -0.439084, 0.292510),
    "ur20": (-0.219807, -0.795170, 0.437691),
    "ur30": (-0.214191, -0.602927, 0.369314),
}

ARMS: dict[str, tuple[UrModel, UrCalibration | None]] = {
    **{name: (model, None) for name, model in UR_MODELS.items()},
    **CALIBRATIONS,
}

# A hundred roundings of a reach of 2 m would be 4e-14. The common normals of a real arm are up to 446 m away. Each of
# the three places where they enter loses eps times that, 1e-13 m; 1e-12 covers these, too.
TIGHT = 1e-12


def postures(count: int, seed: int = 5) -> Array:
    return np.random.default_rng(seed).uniform(-2 * math.pi, 2 * math.pi, (count, 6))


@pytest.mark.parametrize("name", GOLDEN_POSITION)
def test_the_golden_poses(name: str) -> None:
    pose = pose_from_transform(UrKinematics(ur_model(name)).forward(GOLDEN_Q))
    # Half a unit of the last stored digit.
    np.testing.assert_allclose(pose, (*GOLDEN_POSITION[name], *GOLDEN_ROTVEC), rtol=0, atol=0.5001e-6)


@pytest.mark.parametrize(
    ("q", "position"),
    [
        (
            (
                -1.6007002035724085,
                -1.7271001974688929,
                -2.2029998938189906,
                -0.8079999128924769,
                1.5951000452041626,
                -0.03099996248354131,
            ),
            (-0.179925914147547, -0.606869755162764, 0.230789102067257),
        ),
        (
            (
                1.326450228691101,
                2.42600774765014648,
                5.95157289505004883,
                1.27409040927886963,
                -0.541052166615668,
                0.12217304855585098,
            ),
            (0.39922988003280424, 0.59688365069340565, -0.6677819040276375),
        ),
    ],
)
def test_the_vendors_simulator_has_its_tool_there(q: tuple[float, ...], position: tuple[float, ...]) -> None:
    # A UR10 in URSim, from the tests of the vendor's ROS driver. It uses 1.570796327 for pi/2: an error of 2e-10 rad
    # over 1.3 m and two such twists is 5e-10 m.
    np.testing.assert_allclose(UrKinematics(ur_model("ur10")).forward(q)[:3, 3], position, rtol=0, atol=5e-10)


@pytest.mark.parametrize("arm", ARMS)
@pytest.mark.parametrize("tool", [np.eye(4), TOOL], ids=["flange", "tool"])
def test_pinocchio_agrees(arm: str, tool: Array) -> None:
    model, calibration = ARMS[arm]
    ours, theirs = UrKinematics(model, calibration, tool), PinocchioArm(model, calibration, tool)
    for q in postures(50):
        transform, jacobian = ours.forward_and_jacobian(q)
        expected, expected_jacobian = theirs.forward_and_jacobian(q)
        np.testing.assert_allclose(transform, expected, rtol=0, atol=TIGHT)
        np.testing.assert_allclose(jacobian, expected_jacobian, rtol=0, atol=TIGHT)
        np.testing.assert_array_equal(ours.forward(q), transform)
        np.testing.assert_allclose(chain_transform(dh_rows(model, calibration), q, tool), expected, rtol=0, atol=TIGHT)


@pytest.mark.parametrize("arm", ["ur3", "ur5e", "ur20", "ur5"])
def test_pinocchio_has_the_same_change_of_the_jacobian(arm: str) -> None:
    model, calibration = ARMS[arm]
    ours, theirs = UrKinematics(model, calibration, TOOL), PinocchioArm(model, calibration, TOOL)
    for q, qd in zip(postures(20), postures(20, seed=6) / 2, strict=True):
        # A velocity of 3 rad/s multiplies the error of the Jacobian.
        found = ours.rates(q, qd).jacobian_dot
        np.testing.assert_allclose(found, theirs.jacobian_dot(q, qd), rtol=0, atol=20 * TIGHT)


@pytest.mark.parametrize("arm", ARMS)
def test_the_time_derivatives_are_those_of_differences(arm: str) -> None:
    model, calibration = ARMS[arm]
    ours, h = UrKinematics(model, calibration, TOOL), 1e-5
    # Central differences: h^2/6 of a third derivative, at most about (sum |qd|)^3 = 60 times the reach, and the
    # rounding (up to 1e-13 m for far common normals) over 2 h.
    bound = h**2 / 6 * 60 * 2 + 3e-13 / h
    for q, qd in zip(postures(20), np.random.default_rng(7).uniform(-1, 1, (20, 6)), strict=True):
        after, before = (ours.forward_and_jacobian(q + sign * h * qd)[1].copy() for sign in (1, -1))
        slope = (ours.manipulability(q + h * qd) - ours.manipulability(q - h * qd)) / (2 * h)
        rates = ours.rates(q, qd)
        np.testing.assert_allclose(rates.jacobian_dot, (after - before) / (2 * h), rtol=0, atol=bound)
        assert rates.manipulability_rate == pytest.approx(slope, rel=0, abs=bound)


def test_the_jacobian_is_the_difference_of_the_pose() -> None:
    ours, h = UrKinematics(ur_model("ur5e"), tool=TOOL), 1e-5
    for q in postures(20):
        jacobian = ours.forward_and_jacobian(q)[1].copy()
        here = ours.forward(q).copy()
        for joint in range(6):
            step = h * np.eye(6)[joint]
            after, before = ours.forward(q + step).copy(), ours.forward(q - step).copy()
            change = (after - before) / (2 * h)
            spin = change[:3, :3] @ here[:3, :3].T
            omega = np.array((spin[2, 1], spin[0, 2], spin[1, 0]))
            # h^2/6 of a reach of 1.2 m, and eps/h.
            np.testing.assert_allclose(jacobian[:, joint], [*change[:3, 3], *omega], rtol=0, atol=1e-10)


@pytest.mark.parametrize("arm", ARMS)
def test_manipulability_is_the_determinant_for_every_tool(arm: str) -> None:
    model, calibration = ARMS[arm]
    bare, with_tool = UrKinematics(model, calibration), UrKinematics(model, calibration, TOOL)
    for q in postures(20):
        jacobian = with_tool.forward_and_jacobian(q)[1]
        expected = math.sqrt(max(np.linalg.det(jacobian @ jacobian.T), 0.0))
        # The square root of a determinant of JJ' that is off by 1e-15 times its largest terms, about 10 m^6.
        assert with_tool.manipulability(q) == pytest.approx(expected, rel=1e-6, abs=1e-7)
        assert with_tool.manipulability(q) == pytest.approx(abs(np.linalg.det(jacobian)), rel=1e-9, abs=1e-12)
        assert bare.manipulability(q) == with_tool.manipulability(q)


def test_manipulability_vanishes_at_the_singularities() -> None:
    ours = UrKinematics(ur_model("ur5e"))
    wrist, elbow = (0.3, -1.2, 1.4, 0.2, 0.0, 0.5), (0.3, -1.2, 0.0, 0.2, 1.1, 0.5)
    # cos^2 + sin^2 of rounded numbers, times the reaches.
    assert ours.manipulability(wrist) == pytest.approx(0, abs=1e-16)
    assert ours.manipulability(elbow) == pytest.approx(0, abs=1e-16)


@given(st.lists(st.floats(-7, 7), min_size=6, max_size=6))
def test_every_way_to_give_the_angles_gives_the_same(q: list[float]) -> None:
    ours = UrKinematics(ur_model("ur3e"))
    expected = ours.forward(np.array(q)).copy()
    strided = np.zeros((6, 2))
    strided[:, 0] = q
    for same in (q, tuple(q), strided[:, 0]):
        np.testing.assert_array_equal(ours.forward(same), expected)


def test_results_are_overwritten_and_cannot_be_written_to() -> None:
    ours = UrKinematics(ur_model("ur3e"))
    first = ours.forward(np.zeros(6))
    kept = first.copy()
    assert ours.forward(np.ones(6)) is first
    assert not np.array_equal(first, kept)
    with pytest.raises(ValueError, match="read-only"):
        first[0, 0] = 1.0


@pytest.mark.parametrize("position", range(6))
@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_bad_angle_is_refused(position: int, bad: float) -> None:
    q = np.ones(6)
    q[position] = bad
    # A tool for which the last joint does not turn the first axis.
    ours = UrKinematics(ur_model("ur3e"), tool=np.eye(4)[[2, 0, 1, 3]])
    for call in (ours.forward, ours.forward_and_jacobian, ours.manipulability):
        with pytest.raises(ValueError, match="must be finite"):
            call(q)
    with pytest.raises(ValueError, match="must be finite"):
        ours.rates(np.ones(6), q)


@pytest.mark.parametrize("bad", [[1.0] * 5, [1.0] * 7, np.ones((6, 1)), np.ones(1), 1.0, []])
def test_a_wrong_length_is_refused(bad: list[float]) -> None:
    with pytest.raises(ValueError, match="must be 6 numbers"):
        UrKinematics(ur_model("ur3e")).forward(bad)


def test_a_tool_must_be_rigid() -> None:
    for bad in (np.eye(3), 2 * np.eye(4), np.diag((1.0, 1.0, -1.0, 1.0)), np.full((4, 4), math.nan)):
        with pytest.raises(ValueError, match="rigid"):
            UrKinematics(ur_model("ur3e"), tool=bad)


def test_a_model_that_is_not_there() -> None:
    with pytest.raises(ValueError, match=r"model = 'ur4': must be one of ur3, ur5, .*ur30"):
        ur_model("ur4")
    assert ur_model("UR5e") is ur_model("ur5e")


def test_the_models_of_raised_payload_are_the_same_arms() -> None:
    for same, arm in (("ur7e", "ur5e"), ("ur12e", "ur10e")):
        one, other = ur_model(same), ur_model(arm)
        for field in ("a", "d", "alpha", "max_speed", "max_torque", "link_masses_kg"):
            assert getattr(one, field) == getattr(other, field)


def test_what_is_not_asked_for_is_not_built() -> None:
    ours = UrKinematics(ur_model("ur3e"))
    assert "chain" not in vars(ours)
    ours.forward(np.zeros(6))
    assert {"_forward", "chain"} <= set(vars(ours))
    assert not {"_forward_and_jacobian", "_manipulability", "_rates"} & set(vars(ours))
