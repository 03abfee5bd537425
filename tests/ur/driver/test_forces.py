"""Forces of the UR driver at an emulated arm in virtual time: contact, free motion, bounds, stops and faults."""

import math
import time
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation
from tests.ur.virtual import START, World
from tests.ur.virtual_driver import WorldDriven

from haptether.slave import SlaveSample, UrKinematics, UrSlave, ur_model
from haptether.slave.ur.forces import SOFT, ToolForces
from haptether.slave.ur.kinematics.constraints import ToolCone
from haptether.slave.ur.kinematics.pose import pose_from_transform, quat_wxyz_from_rotvec
from haptether.slave.ur.modes import DirectTorque, ur_mode
from haptether.slave.ur.options import UrOptions, ur_options
from haptether.slave.ur.state import UrState

Array = npt.NDArray[np.float64]
Command = Callable[[SlaveSample], None]

pytestmark = pytest.mark.slow

MODEL = ur_model("ur5e")
OPTIONS = UrOptions(host="fake")
INERTIA = np.array(MODEL.max_torque) / 50.0
"""Joint inertia of the emulator in kg m²."""
FRICTION = 0.05 * np.array(MODEL.max_torque) / np.array(MODEL.max_speed)
PERIOD_S = 0.002
HEARD_S = 4 * PERIOD_S
"""Longest time from a sample to the torque that it leads to: its package, the command, the next control cycle."""
SPRING_HZ = math.sqrt(OPTIONS.joint_stiffness / INERTIA[0])
"""Natural frequency of the held directions in rad/s: all joints have the same within 7 %."""
SPRINGS = OPTIONS.joint_stiffness * np.array((1.0, 1.0, 1.0, 0.2, 0.2, 0.2))
SETTLE_S = 4.0
WALL_N_M = 2000.0
WALL_N_S_M = 2.0 * math.sqrt(10.0 * WALL_N_M)
"""Critical damping of a tool of 10 kg."""
CLAMP = 60.0, 6.0
"""N m/rad, N m s/rad."""
GAP_M = 0.005
AT_REST = (0.0, 0.0, 0.0)


def wall(axes: int) -> World:
    """Return an arm 5 mm before a wall in -x, or before three walls in -x, -y and -z."""
    contact = f"contact = {{ stiffness = {WALL_N_M}, damping = {WALL_N_S_M} }}"
    planes = [
        f"{{ shape = {{ kind = 'plane', normal = {np.eye(3)[row, :axes].tolist()} }}, {contact} }}"
        for row in range(axes)
    ]
    place = GAP_M if axes == 1 else [GAP_M] * 3
    scene = "remote_push" if axes == 1 else "three_axis_box"
    given = [f"environment.objects=[{', '.join(planes)}]", f"slave.position={place}"]
    if axes == 1:
        given.append("environment.pushers=[]")
    return World("5.26", scene=scene, overrides=given, upload=False)


def free(start: tuple[float, ...] = START) -> World:
    """Return an arm in free space."""
    return World("5.26", start=start, upload=False)


def mobility(q: tuple[float, ...] = START) -> Array:
    """Return the inverse inertia of the emulated tool, (6, 6)."""
    jacobian = UrKinematics(MODEL).forward_and_jacobian(q)[1]
    return np.array(jacobian / INERTIA @ jacobian.T)


def settled(
    walls: int,
    *,
    clamped: bool = False,
    share: float = 1.0,
    coupling: tuple[float, float] = (0.0, 0.0),
    seconds: float = SETTLE_S,
) -> float:
    """Return the remainder after a time in s of a deviation of the arm in contact: `e^-(s t)` of its slowest mode.

    The eigenvalues are those of `I q'' = -(b + D) q' - K q` at the start. K and D are those of the walls, of the
    clamp, or else of the springs that hold the directions without a wall, times a share. A coupling adds N/m and N s/m.
    """
    jacobian = np.array(UrKinematics(MODEL).forward_and_jacobian(START)[1])
    rows = np.eye(6)
    touched = rows[:walls]
    at_tool = (WALL_N_M + coupling[0]) * touched.T @ touched
    damping = (WALL_N_S_M + coupling[1]) * touched.T @ touched
    if clamped:
        at_tool[3:, 3:], damping[3:, 3:] = CLAMP[0] * np.eye(3), CLAMP[1] * np.eye(3)
    else:
        held = rows[walls:] if walls == 1 else rows[3:]
        springs = share * held.T @ np.linalg.inv(held @ (jacobian / SPRINGS) @ jacobian.T @ held.T) @ held
        at_tool = at_tool + springs
        damping = damping + springs * OPTIONS.joint_damping / OPTIONS.joint_stiffness
    stiff = jacobian.T @ at_tool @ jacobian / INERTIA[:, np.newaxis]
    damped = (jacobian.T @ damping @ jacobian + np.diag(FRICTION)) / INERTIA[:, np.newaxis]
    modes = np.linalg.eigvals(np.block([[np.zeros((6, 6)), np.eye(6)], [-stiff, -damped]]))
    return math.exp(modes.real.max() * seconds)


# -------------------------------------------------------------------------------------------------------- contact


@pytest.mark.thorough
def test_a_force_along_one_axis_is_that_of_the_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, wall(1))
    assert driven.driver.takes_force
    home = driven.world.vector("actual_TCP_pose")
    for force in (-12.0, -3.0, -30.0):
        sample = driven.run(SETTLE_S, driven.push(force))[-1]
        # At rest J'(F + W_h + F_e) = 0, and W_h has no part along the axis: equal up to the settling springs.
        assert sample.force == pytest.approx(-force, abs=30.0 * settled(1))
        assert sample.position == pytest.approx(home[0] - GAP_M + force / WALL_N_M, abs=1e-6)
    assert 30.0 * settled(1) < 1e-3
    # The contact is straight ahead, so nothing loads the other directions.
    pose = driven.world.vector("actual_TCP_pose")
    assert pose[1:3] == pytest.approx(home[1:3], abs=1e-5)
    assert turned(pose, home) < 1e-5
    driven.driver.close()


def test_a_force_of_three_axes_is_that_of_the_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, wall(3), axes=3)
    home = driven.world.vector("actual_TCP_pose")
    force = (-8.0, -5.0, -11.0)
    sample = driven.run(SETTLE_S, driven.push(*force))[-1]
    assert sample.force == pytest.approx([-part for part in force], abs=11.0 * settled(3))
    assert 11.0 * settled(3) < 0.02
    # The springs of the orientation balance no part of it.
    assert turned(driven.world.vector("actual_TCP_pose"), home) < 1e-3
    driven.driver.close()


@pytest.mark.thorough
def test_a_force_and_a_moment_are_those_of_the_contact(monkeypatch: pytest.MonkeyPatch) -> None:
    """The tool touches three walls, and a clamp holds its orientation."""
    world = wall(3)
    assert world.line.answer(f"clamp {CLAMP[0]} {CLAMP[1]}", 0.0) == "ok"
    driven = WorldDriven(monkeypatch, world, axes=3)
    home = world.vector("actual_TCP_pose")
    force, moment = (-8.0, -5.0, -11.0), (0.6, -0.8, 0.3)
    sample = driven.run(SETTLE_S, driven.push(*force, torque=moment))[-1]
    assert sample.force == pytest.approx([-part for part in force], abs=11.0 * settled(3, clamped=True))
    assert sample.torque == pytest.approx([-part for part in moment], abs=11.0 * settled(3, clamped=True))
    assert 11.0 * settled(3, clamped=True) < 5e-3
    assert turned(world.vector("actual_TCP_pose"), home) == pytest.approx(np.linalg.norm(moment) / CLAMP[0], abs=1e-4)
    driven.driver.close()


def held_compliance() -> Array:
    """Return the compliance of the joint springs at the tool along y, z and the rotation, with x free, (5, 5)."""
    jacobian = np.array(UrKinematics(MODEL).forward_and_jacobian(START)[1])
    return np.array(((jacobian / SPRINGS) @ jacobian.T)[1:, 1:])


def turned(pose: tuple[float, ...], home: tuple[float, ...]) -> float:
    """Return the angle between two poses in rad."""
    return float((Rotation.from_rotvec(pose[3:]) * Rotation.from_rotvec(home[3:]).inv()).magnitude())


# ---------------------------------------------------------------------------------------------------- free motion


def test_a_free_arm_accelerates_by_its_inertia_and_feels_no_force(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free(), axes=3)
    force = np.array((3.0, -2.0, 4.0))
    seconds = 0.1
    samples = driven.run(seconds, driven.push(*force.tolist(), torque=AT_REST))
    _, jacobian = UrKinematics(MODEL).forward_and_jacobian(START)
    torque = jacobian[:3].T @ force

    def velocity(t: float) -> Array:
        """Return the tool velocity of joints that start from rest: `I q'' = tau - b q'`."""
        return np.array(jacobian[:3] @ (torque / FRICTION * -np.expm1(-FRICTION / INERTIA * t)))

    along = force / np.linalg.norm(force)
    # The last sample shows the torques of all but the last cycles.
    assert velocity(seconds - HEARD_S) @ along < np.array(samples[-1].velocity) @ along < velocity(seconds) @ along
    # Friction takes 4 % of F/m in that time, at b/I = 0.8 /s.
    acceleration = np.linalg.norm(force) * (along @ mobility()[:3, :3] @ along)
    assert velocity(seconds) @ along == pytest.approx(acceleration * seconds, rel=0.05)
    # F_e contains neither the commanded force nor the inertia.
    assert max(np.abs(sample.force).max() for sample in samples) == 0.0
    driven.driver.close()


@pytest.mark.thorough
def test_the_directions_that_are_not_commanded_are_held(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free(), max_speed=1.0)
    home = driven.world.vector("actual_TCP_pose")
    force, away = 10.0, []

    def push(_: SlaveSample) -> None:
        driven.driver.write_force((force,))
        away.append(np.subtract(driven.world.vector("actual_TCP_pose")[1:3], home[1:3]))

    driven.run(0.4, push)
    # A force along x accelerates the free tool sideways by a; its spring then deflects by a / w², swings by 1.16 times
    # that, and the inertia changes by a fifth on the way.
    sideways = force * np.linalg.norm(mobility()[1:3, 0]) / SPRING_HZ**2
    assert 0.3 * sideways < np.linalg.norm(away, axis=1).max() < 1.16 * 1.2 * sideways
    assert driven.world.vector("actual_TCP_pose")[0] - home[0] > 10.0 * sideways
    # At rest it is back in its line.
    driven.run(1.0, lambda sample: driven.driver.write_force((-40.0 * float(sample.velocity),)))  # type: ignore[arg-type]
    driven.run(SETTLE_S, driven.push(0.0))
    pose = driven.world.vector("actual_TCP_pose")
    assert pose[1:3] == pytest.approx(home[1:3], abs=1e-5)
    assert turned(pose, home) < 1e-5
    driven.driver.close()


@pytest.mark.thorough
def test_a_push_from_the_side_meets_the_springs(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free())
    home = driven.world.vector("actual_TCP_pose")
    driven.world.environment.push((0.0, 6.0, 0.0), 100.0)
    driven.run(SETTLE_S, driven.push(0.0))
    aside = driven.world.vector("actual_TCP_pose")[1] - home[1]
    # Its compliance is that of the joint springs, without the part along the free axis.
    assert aside == pytest.approx(6.0 * held_compliance()[0, 0], rel=0.05)
    driven.driver.close()


# --------------------------------------------------------------------------------------------------------- bounds


def test_the_largest_force_and_moment_bound_the_command(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, wall(3), axes=3, max_force=10.0, torque_share=0.8)
    sample = driven.run(SETTLE_S, driven.push(-60.0, -20.0, -40.0))[-1]
    want = 10.0 / math.hypot(60.0, 20.0, 40.0) * np.array((60.0, 20.0, 40.0))
    assert sample.force == pytest.approx(want, abs=10.0 * settled(3))
    driven.driver.close()


@pytest.mark.thorough
def test_torques_are_scaled_down_together(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, wall(3), axes=3, torque_share=0.02)
    force = np.array((-8.0, -5.0, -11.0))
    sample = driven.run(SETTLE_S, driven.push(*force.tolist()))[-1]
    assert np.abs(driven.torques).max(axis=0) == pytest.approx(
        np.minimum(np.abs(driven.torques).max(axis=0), 0.02 * np.array(MODEL.max_torque))
    )
    jacobian = UrKinematics(MODEL).forward_and_jacobian(driven.world.vector("actual_q"))[1]
    share = 1.0 / (np.abs(jacobian[:3].T @ force) / (0.02 * np.array(MODEL.max_torque))).max()
    assert 0.1 < share < 0.9
    # The contact has the direction of the command.
    assert sample.force == pytest.approx(-share * force, abs=11.0 * settled(3, share=share))
    driven.driver.close()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("force", [4.0, 40.0])
def test_a_force_makes_the_tool_no_faster_than_its_limit(monkeypatch: pytest.MonkeyPatch, force: float) -> None:
    driven = WorldDriven(monkeypatch, free(), max_speed=0.1)
    samples = driven.run(1.2, driven.push(force))
    speeds = np.array([sample.velocity for sample in samples])
    # The force fades before the limit; within the loop's delay it may still gain a thirtieth.
    assert speeds.max() < 0.1 * 1.03
    assert speeds[-1] > 0.05
    # It does not swing: the last speeds are steady.
    assert np.ptp(speeds[-100:]) < 0.005
    driven.driver.close()


@pytest.mark.thorough
def test_a_moment_turns_the_tool_no_faster_than_its_limit(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free(), axes=3, max_angular_speed=0.4)
    samples = driven.run(1.0, driven.push(*AT_REST, torque=(0.0, 0.0, 2.0)))
    speeds = np.array([sample.angular_velocity for sample in samples])
    assert np.linalg.norm(speeds, axis=1).max() < 0.4 * 1.03
    assert speeds[-1, 2] > 0.3
    driven.driver.close()


@pytest.mark.thorough
def test_a_faster_tool_is_damped(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free(), max_speed=0.05)
    driven.run(0.1, driven.push(0.0))
    driven.world.environment.push((60.0, 0.0, 0.0), 0.05)
    driven.run(0.07, driven.push(20.0))
    fast = abs(driven.world.vector("actual_TCP_speed")[0])
    assert fast > 0.12
    driven.run(0.1, driven.push(20.0))
    # Damping of 20 /s leaves e^-2 of the excess, friction less; the emulator's inertia is the nominal one.
    slower = driven.world.vector("actual_TCP_speed")[0]
    assert 0.04 < slower < 0.05 + (fast - 0.05) * math.exp(-20.0 * (0.1 - HEARD_S))
    driven.driver.close()


def test_a_force_does_not_pass_a_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    world = free()
    home = world.controller.robot.measured.pose[0]
    level = home - 0.04
    driven = WorldDriven(monkeypatch, world, workspace=[[1.0, 0.0, 0.0, level]])
    samples = driven.run(3.0, driven.push(-25.0))
    x = np.array([sample.position for sample in samples])
    # Nominal inertia and a delay of 8 ms at 20 /s: it arrives, and swings beyond by less than a millimetre.
    assert x.min() > level - 1e-3
    assert x[-1] == pytest.approx(level, abs=1e-3)
    # A pull away from it is not weakened.
    taken = len(driven.torques)
    driven.run(0.02, driven.push(10.0))
    jacobian = UrKinematics(MODEL).forward_and_jacobian(driven.world.vector("actual_q"))[1]
    assert driven.torques[-1] == pytest.approx((10.0 * jacobian[0]).tolist(), abs=0.3)
    assert len(driven.torques) > taken
    driven.driver.close()


@pytest.mark.thorough
def test_a_plane_stays_where_it_is_while_forces_and_motions_alternate(monkeypatch: pytest.MonkeyPatch) -> None:
    world = free()
    level = world.controller.robot.measured.pose[0] - 0.005
    driven = WorldDriven(monkeypatch, world, workspace=[[1.0, 0.0, 0.0, level]])
    driven.run(0.5, driven.push(-25.0))
    world.environment.push((-20.0, 0.0, 0.0), 100.0)
    deepest = []
    for _ in range(10):
        driven.run(0.2, driven.push(-25.0))
        deepest.append(level - world.vector("actual_TCP_pose")[0])
        driven.run(0.02, lambda _: driven.driver.write((level,), (0.0,)))
    # Somebody presses the tool beyond it; each time the spring is that of the plane of the options.
    assert 0.005 < deepest[-1] < 1.2 * 20.0 * mobility()[0, 0] / 100.0
    driven.driver.close()


@pytest.mark.thorough
def test_a_tool_pushed_through_a_plane_is_pushed_back(monkeypatch: pytest.MonkeyPatch) -> None:
    world = free()
    level = world.controller.robot.measured.pose[0] - 0.01
    driven = WorldDriven(monkeypatch, world, workspace=[[1.0, 0.0, 0.0, level]])
    driven.run(1.0, driven.push(-25.0))
    driven.world.environment.push((-20.0, 0.0, 0.0), 1.0)
    (*_, last) = driven.run(1.0, driven.push(-25.0))
    assert isinstance(last.position, float)
    mass = 1.0 / mobility()[0, 0]
    # The spring beyond it is m w² of the nominal inertia, w = 10 /s.
    assert level - last.position == pytest.approx(20.0 / (mass * 100.0), rel=0.2)
    assert driven.run(2.0, driven.push(-25.0))[-1].position == pytest.approx(level, abs=1e-3)
    driven.driver.close()


@pytest.mark.thorough
def test_a_moment_does_not_pass_the_cone(monkeypatch: pytest.MonkeyPatch) -> None:
    world = free()
    x, y, z = world.controller.robot.measured.tool[:3, 2].tolist()
    driven = WorldDriven(monkeypatch, world, axes=3, tool_cone=[x, y, z, 0.15])
    cone = ToolCone.around(x, y, z, 0.15)
    tilts = []

    def push(sample: SlaveSample) -> None:
        assert sample.orientation is not None
        w, x, y, z = sample.orientation
        tilts.append(cone.tilt((w, x, y, z))[0])
        # The point stays by a spring of this test.
        place, speed = np.array(sample.position), np.array(sample.velocity)
        driven.driver.write_force(tuple((400.0 * (home - place) - 60.0 * speed).tolist()), (0.6, 0.0, 0.0))

    home = np.array(world.controller.robot.measured.pose[:3])
    driven.run(2.5, push)
    assert 0.14 < max(tilts) < 0.155
    assert tilts[-1] == pytest.approx(0.15, abs=0.005)
    driven.driver.close()


def test_a_moment_does_not_pass_the_end_of_a_joint(monkeypatch: pytest.MonkeyPatch) -> None:
    last = MODEL.position_max[5]
    driven = WorldDriven(monkeypatch, free((*START[:5], last - 0.2)), axes=3)
    axis = driven.world.controller.robot.measured.tool[:3, 2]
    moment = (0.5 * axis).tolist()
    driven.run(2.0, driven.push(*AT_REST, torque=(moment[0], moment[1], moment[2])))
    # Beyond the end the emulator stops the arm, and the driver faults.
    assert last - 0.01 < driven.world.vector("actual_q")[5] < last
    driven.driver.close()


@pytest.mark.thorough
def test_the_arm_is_kept_clear_of_itself(monkeypatch: pytest.MonkeyPatch) -> None:
    world = free()
    x, y, _ = world.controller.robot.measured.pose[:3]
    inward = -np.array((x, y, 0.0)) / math.hypot(x, y)
    driven = WorldDriven(monkeypatch, world, axes=3)
    joints = driven.driver._motion.mode.joints  # type: ignore[union-attr]
    assert joints is not None
    nearest = []

    def push(_: SlaveSample) -> None:
        driven.driver.write_force(tuple((20.0 * inward).tolist()))
        nearest.append(joints.distances(driven.world.vector("actual_q"))[0].min())

    driven.run(3.0, push)
    assert nearest[0] > 0.05
    # The margin of 10 mm is within the distance.
    assert -0.002 < min(nearest) < 0.01
    driven.driver.close()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("axes", [1, 3])
def test_a_singular_wrist_softens_the_springs_and_no_joint_jumps(monkeypatch: pytest.MonkeyPatch, axes: int) -> None:
    driven = WorldDriven(monkeypatch, free((*START[:4], 0.02, 0.0)), axes=axes)
    rates = []

    def push(_: SlaveSample) -> None:
        driven.driver.write_force((8.0, 0.0, 0.0)[:axes])
        rates.append(driven.world.vector("actual_qd"))

    driven.run(0.8, push)
    assert np.abs(np.diff(rates, axis=0)).max() < 0.3 * 50.0 * PERIOD_S
    assert (np.abs(rates).max(axis=0) < 0.55 * np.array(MODEL.max_speed)).all()
    assert driven.world.playing
    driven.driver.close()


def law(q: tuple[float, ...], **given: Any) -> tuple[ToolForces, UrState]:  # noqa: ANN401
    """Return the law of forces that holds an arm at rest, and the state of that arm."""
    mode = ur_mode(ur_options({"host": "fake", "mode": "direct-torque"} | given), PERIOD_S, (0.0,) * 6)
    assert isinstance(mode, DirectTorque)
    x, y, z, *rotvec = pose_from_transform(UrKinematics(MODEL).forward(q)).tolist()
    state = UrState(1.0, q, q, (0.0,) * 6, (x, y, z, *rotvec), (0.0,) * 6, (0.0,) * 6, 7, 1, 1, 2, 1.0)
    mode.begin(state)
    mode.forces.hold((x, y, z), quat_wxyz_from_rotvec(rotvec))
    return mode.forces, state


def test_the_springs_are_soft_where_the_wrist_is_singular() -> None:
    away = 2e-3
    # Damped least squares: a deviation of `e` needs at most `K e / (2 s)`, at a singular value of s = 0.05.
    most = OPTIONS.joint_stiffness * away / (2.0 * SOFT)
    for q5 in (0.0, 1e-6, 1e-3, 0.05):
        q = (*START[:4], q5, 0.0)
        # The wrench that no joint feels, and an axis across it, so that all of it is held.
        *_, lost = np.linalg.svd(UrKinematics(MODEL).forward_and_jacobian(q)[1])[0].T
        axis = np.cross(lost[:3], (0.0, 0.0, 1.0))
        forces, state = law(q, axis=axis.tolist())
        turn = Rotation.from_rotvec(away * lost[3:]) * Rotation.from_rotvec(state.pose[3:])
        place = np.array(state.pose[:3]) + away * lost[:3]
        away_state = state._replace(pose=(*place.tolist(), *turn.as_rotvec().tolist()))
        torque = np.abs(forces.torque(AT_REST, None, away_state))
        assert torque.max() < most
        # Away from the singularity the springs are there.
        assert torque.max() > (0.5 if q5 == 0.05 else 0.0)


def test_a_joint_at_half_its_largest_speed_is_not_accelerated() -> None:
    forces, state = law(START, axes=3, max_angular_speed=6.0)
    moment = (0.0, 0.0, -2.0)
    free = forces.torque(AT_REST, moment, state)
    assert free[5] > 1.0
    excess, speed = 0.1, 0.5 * MODEL.max_speed[5]
    fast = forces.torque(AT_REST, moment, state._replace(qd=(*(0.0,) * 5, speed + excess)))
    # Damping of 20 /s on the nominal inertia, and no torque that accelerates.
    assert fast[5] == pytest.approx(-20.0 * INERTIA[5] * excess)
    slow = forces.torque(AT_REST, moment, state._replace(qd=(*(0.0,) * 5, speed - 1.0)))
    assert slow == pytest.approx(free)


def test_a_motion_across_the_axis_takes_no_force_along_it() -> None:
    forces, state = law(START, max_speed=0.1, joint_damping=0.0, torque_share=0.8)
    jacobian = np.array(UrKinematics(MODEL).forward_and_jacobian(START)[1])
    across, along = (np.linalg.solve(jacobian, of) for of in np.eye(6)[[1, 0]])
    for qd, share in ((0.3 * across + 0.04 * along, 1.0), (0.3 * along, 0.0)):
        moving = state._replace(qd=tuple(qd.tolist()))
        added = np.subtract(forces.torque((10.0, 0.0, 0.0), None, moving), forces.torque(AT_REST, None, moving))
        assert added == pytest.approx(10.0 * share * jacobian[0], abs=1e-9)


# -------------------------------------------------------------------------------------------- refusals and switches


@pytest.mark.sampled(2)
@pytest.mark.parametrize(
    ("axes", "force", "torque", "said"),
    [
        (1, (math.nan,), None, "commanded force = [nan]: must be 1 finite numbers: see the master"),
        (1, (math.inf,), None, "must be 1 finite numbers"),
        (1, (1.0, 0.0, 0.0), None, "must be 1 finite numbers"),
        (3, (1.0, math.nan, 0.0), None, "must be 3 finite numbers"),
        (3, (1.0, 0.0, 0.0), (0.0, math.nan, 0.0), "commanded torque = [0.0, nan, 0.0]: must be 3 finite numbers"),
        (1, (1.0,), (0.1, 0.0, 0.0), "commanded a torque along one axis: axes = 3 in the options takes poses"),
    ],
)
def test_a_force_that_cannot_be_is_a_fault_and_ends_the_push(
    monkeypatch: pytest.MonkeyPatch,
    axes: int,
    force: tuple[float, ...],
    torque: tuple[float, float, float] | None,
    said: str,
) -> None:
    driven = WorldDriven(monkeypatch, free(), axes=axes)
    driven.run(0.05, driven.push(*(5.0, 0.0, 0.0)[:axes]))
    sent = len(driven.torques)
    driven.step(driven.push(*force, torque=torque))
    sample = driven.step()
    assert said in str(sample.fault)
    # A good force has no effect before the fault is acknowledged.
    driven.driver.write_force((5.0, 0.0, 0.0)[:axes])
    driven.until(lambda _: driven.driver._soft_stop.phase.name == "AT_REST")
    assert len(driven.torques) == sent
    assert np.abs(driven.world.vector("actual_qd")).max() < 1e-6
    driven.driver.acknowledge()
    driven.until(lambda _: driven.driver._recovery is None and driven.driver._watchdog.armed)
    driven.until(lambda _: len(driven.torques) > sent, driven.push(*(5.0, 0.0, 0.0)[:axes]))
    driven.driver.close()


@pytest.mark.parametrize("mode", ["servoj", "servol", "speedl"])
def test_other_modes_take_no_force(monkeypatch: pytest.MonkeyPatch, mode: str) -> None:
    driven = WorldDriven(monkeypatch, free(), mode=mode)
    assert not UrSlave(host="fake", mode=mode).takes_force
    driven.driver.write_force((1.0,))
    assert f"commanded a force: mode = '{mode}' takes positions" in str(driven.step().fault)
    driven.driver.close()


def test_a_stop_ends_the_push_and_a_force_after_it_begins_from_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free())
    driven.run(0.25, driven.push(12.0))
    assert abs(driven.world.vector("actual_TCP_speed")[0]) > 0.1
    driven.driver.stop()
    sent = len(driven.torques)

    def push(_: SlaveSample) -> None:
        if driven.driver._soft_stop.stopping:
            driven.driver.write_force((12.0,))

    # A force has no effect until the arm rests.
    driven.until(lambda _: not driven.driver._soft_stop.stopping, push)
    rest = driven.world.vector("actual_TCP_pose")
    assert len(driven.torques) == sent
    driven.run(0.5)
    assert driven.world.vector("actual_TCP_pose") == pytest.approx(rest, abs=1e-6)
    driven.run(0.02, driven.push(0.0))
    # It holds the pose at which it rests, not that before the stop.
    assert np.abs(driven.torques[sent:]).max() < 0.05
    driven.driver.close()


def test_a_stop_in_contact_holds_and_presses_no_more(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, wall(1))
    driven.run(2.0, driven.push(-20.0))
    at = driven.step(driven.push(-20.0)).position
    driven.driver.stop()
    samples = driven.run(1.0)
    # It stays where it was pressed, within the deflection of stiff joints.
    assert samples[-1].position == pytest.approx(at, abs=2e-4)
    assert 15.0 < np.max([sample.force for sample in samples]) < 20.5
    driven.driver.close()


def test_a_motion_after_a_force_continues_from_the_arm(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free())
    driven.run(0.3, driven.push(10.0))
    sample = driven.step(driven.push(10.0))
    speed, at = sample.velocity, sample.position
    assert isinstance(speed, float)
    assert isinstance(at, float)
    assert speed > 0.1
    pushed = len(driven.torques)
    jacobian = np.array(UrKinematics(MODEL).forward_and_jacobian(driven.world.vector("actual_q"))[1])
    # The goal is 50 mm behind the arm.
    goal = at - 0.05
    samples = driven.run(3.0, lambda _: driven.driver.write((goal,), (0.0,)))
    torques, speeds = np.array(driven.torques[pushed:]), np.array([s.velocity for s in samples])
    # The first order asks for the present velocity, changed by 5 m/s² for a period, and a period of motion ahead. From
    # rest its dampers would brake with 30 N m s/rad times the joint speeds at once, ten times as much.
    asked = np.linalg.solve(jacobian, (OPTIONS.max_acceleration * PERIOD_S, 0.0, 0.0, 0.0, 0.0, 0.0))
    ahead = np.linalg.solve(jacobian, (speed * PERIOD_S, 0.0, 0.0, 0.0, 0.0, 0.0))
    damped = SPRINGS * OPTIONS.joint_damping / OPTIONS.joint_stiffness
    assert np.abs(torques[0]).max() < (damped * np.abs(asked) + SPRINGS * np.abs(ahead)).max()
    assert np.abs(np.diff(speeds)).max() < 2.0 * OPTIONS.max_acceleration * PERIOD_S
    assert speeds.max() < speed + 0.02
    assert samples[-1].position == pytest.approx(goal, abs=1e-3)
    driven.driver.close()


@pytest.mark.thorough
def test_a_force_after_a_motion_keeps_the_load_of_the_other_directions(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free())
    home = driven.world.vector("actual_TCP_pose")
    driven.world.environment.push((0.0, 0.0, -6.0), 100.0)
    driven.run(2.0, lambda _: driven.driver.write((home[0],), (0.0,)))
    sagged = driven.world.vector("actual_TCP_pose")[2] - home[2]
    assert sagged < -1e-3
    driven.run(0.05, driven.push(0.0))
    # The springs keep their load, and with x free they are a little softer.
    soon = driven.world.vector("actual_TCP_pose")[2] - home[2]
    assert soon == pytest.approx(sagged, rel=0.1)
    driven.run(SETTLE_S, driven.push(0.0))
    sagged = driven.world.vector("actual_TCP_pose")[2] - home[2]
    assert sagged == pytest.approx(-6.0 * held_compliance()[1, 1], rel=0.05)
    driven.driver.close()


@pytest.mark.thorough
def test_poses_and_forces_may_alternate(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free(), axes=3)
    sample = driven.step()
    begin, orientation = sample.position, sample.orientation
    assert orientation is not None
    assert isinstance(begin, tuple)

    def lead(_: SlaveSample) -> None:
        driven.driver.write(begin, AT_REST, tuple(orientation), AT_REST)

    driven.run(0.2, lead)
    driven.run(0.3, driven.push(4.0, 0.0, 0.0, torque=(0.1, 0.0, 0.0)))
    # From there the tool comes back, with its rotation, although the first command is far away.
    driven.run(3.0, lead)
    home = driven.world.vector("actual_TCP_pose")
    assert home[:3] == pytest.approx(begin, abs=1e-3)
    held = driven.step(lead).orientation
    assert held == pytest.approx(orientation, abs=1e-3)
    # Without a moment the orientation of that moment is held.
    driven.run(0.3, driven.push(0.0, 0.0, 0.0, torque=(0.2, 0.0, 0.0)))
    moved = driven.world.vector("actual_TCP_pose")
    assert turned(moved, home) > 0.01
    driven.run(2.0, driven.push(0.0, 0.0, 0.0))
    assert turned(driven.world.vector("actual_TCP_pose"), moved) < 0.5 * turned(moved, home) + 0.05
    assert np.abs(driven.world.vector("actual_TCP_speed")[3:]).max() < 1e-2
    driven.driver.close()


def test_a_motion_far_from_the_tool_after_a_force_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free())
    driven.run(0.1, driven.push(0.0))
    at = driven.step(driven.push(0.0)).position
    assert isinstance(at, float)
    sample = driven.until(
        lambda sample: sample.fault is not None, lambda _: driven.driver.write((at + 3.0,), (0.0,))
    )  # fmt: skip
    assert str(sample.fault).startswith("commanded 3000.0 mm away from the tool after a force")
    driven.driver.close()


# ------------------------------------------------------------------------------------------------ silence and faults


@pytest.mark.parametrize("in_contact", [True, False])
def test_the_watchdog_ends_a_push(monkeypatch: pytest.MonkeyPatch, in_contact: bool) -> None:
    world = wall(1) if in_contact else free()
    driven = WorldDriven(monkeypatch, world)
    driven.run(0.3, driven.push(-15.0))
    # This side is gone: neither driver nor library make another call.
    ended = world.controller.now_s
    while world.playing:
        world.cycles(1)
        assert world.controller.now_s < ended + 0.2
    assert 0.1 - PERIOD_S <= world.controller.now_s - ended <= 0.1 + HEARD_S
    world.seconds(0.5)
    rest = world.vector("actual_TCP_pose")
    world.seconds(0.5)
    assert world.vector("actual_TCP_pose") == pytest.approx(rest, abs=1e-9)
    assert max(map(abs, world.vector("actual_qd"))) < 1e-6
    driven.driver.close()


def test_silence_of_the_loop_ends_a_push(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free())
    arm, world = driven.arm, driven.world
    monkeypatch.setattr("haptether.slave.ur.stop.SILENCE_S", 0.02)
    driven.until(lambda sample: abs(float(sample.velocity)) > 0.1, driven.push(12.0))  # type: ignore[arg-type]
    # Nothing calls the driver any more; its thread stops the arm, while the controller's time passes.
    end_s = time.monotonic() + 20.0
    while "stopJ" not in arm.names:
        assert time.monotonic() < end_s
        time.sleep(1e-3)
    monkeypatch.setattr("haptether.slave.ur.stop.SILENCE_S", 20.0)
    sent = len(driven.torques)
    driven.until(lambda _: driven.driver._soft_stop.phase.name == "PAUSED")
    assert max(map(abs, world.vector("actual_qd"))) < 1e-3
    assert len(driven.torques) == sent
    # The next force starts from rest there.
    driven.run(0.02, driven.push(0.0))
    assert np.abs(driven.torques[sent:]).max() < 0.05
    driven.driver.close()


def test_a_fault_ends_the_push_until_it_is_acknowledged(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, wall(1))
    driven.run(1.0, driven.push(-15.0))
    assert driven.world.line.answer("stop-program", 0.0) == "ok"
    sample = driven.until(lambda sample: sample.fault is not None, driven.push(-15.0))
    assert str(sample.fault).startswith("the control script is stopped")
    sent = len(driven.torques)
    rest = driven.world.vector("actual_TCP_pose")
    for _ in range(100):
        driven.step()
        driven.driver.write_force((-15.0,))
    assert len(driven.torques) == sent
    assert driven.world.vector("actual_TCP_pose") == pytest.approx(rest, abs=1e-4)
    driven.driver.acknowledge()
    driven.until(lambda _: driven.driver._recovery is None and driven.driver._watchdog.armed)
    sample = driven.run(SETTLE_S, driven.push(-15.0))[-1]
    assert sample.force == pytest.approx(15.0, abs=15.0 * settled(1))
    driven.driver.close()


def test_an_arm_that_is_pushed_off_its_line_is_a_fault(monkeypatch: pytest.MonkeyPatch) -> None:
    driven = WorldDriven(monkeypatch, free(), max_speed=0.05, joint_stiffness=30.0)
    driven.run(0.1, driven.push(0.0))
    driven.world.environment.push((0.0, 0.0, -30.0), 100.0)
    sample = driven.until(lambda sample: sample.fault is not None, driven.push(0.0))
    assert "the arm is pushed off its place: 3" in str(sample.fault)
    assert "(allowed 38 mm)" in str(sample.fault)
    driven.driver.close()


# ------------------------------------------------------------------------------------------------------- couplings


@pytest.mark.sampled(1)
@pytest.mark.parametrize(("stiffness", "damping"), [(300.0, 20.0), (800.0, 60.0)])
def test_a_computed_force_settles_at_the_closed_form(
    monkeypatch: pytest.MonkeyPatch, stiffness: float, damping: float
) -> None:
    """`F_c = K (x' - x) + B (v' - v)`, as in position-force and P+d: a master presses 20 mm into the wall."""
    driven = WorldDriven(monkeypatch, wall(1))
    home = driven.world.vector("actual_TCP_pose")[0]
    wall_m, depth_m, speed = home - GAP_M, 0.02, 0.05
    begun_s = driven.arm.monotonic()

    def couple(sample: SlaveSample) -> None:
        assert isinstance(sample.position, float)
        assert isinstance(sample.velocity, float)
        moved = min(speed * (driven.arm.monotonic() - begun_s), GAP_M + depth_m)
        rate = speed if moved < GAP_M + depth_m else 0.0
        force = stiffness * (home - moved - sample.position) + damping * (-rate - sample.velocity)
        driven.driver.write_force((force,))

    samples = driven.run(SETTLE_S, couple)
    # Both springs are in series: K_e K/(K_e + K) times the depth.
    want = WALL_N_M * stiffness / (WALL_N_M + stiffness) * depth_m
    rest_s = SETTLE_S - (GAP_M + depth_m) / speed
    error = want * settled(1, coupling=(stiffness, damping), seconds=rest_s)
    assert error < 1e-3
    assert samples[-1].force == pytest.approx(want, abs=error)
    assert samples[-1].position == pytest.approx(wall_m - want / WALL_N_M, abs=error / WALL_N_M)
    # The path to it: no rebound from the wall after the end of the motion.
    late = np.array([sample.force for sample in samples[len(samples) // 2 :]])
    assert 0.9 * want < late.min() <= late.max() < 1.1 * want
    driven.driver.close()
