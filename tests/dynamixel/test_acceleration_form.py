"""Four-channel control in its acceleration form on two arms that take forces: free motion, and contact with walls."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from tests.dynamixel.test_force_follower import ARM, LEVER_M, first
from tests.dynamixel.virtual import TICK_S, Follower, World

from haptether.dynamixel.description import load_arm
from haptether.dynamixel.emulator import ArmLoad, HeldBy, JointSettings, servos_of

Array = npt.NDArray[np.float64]
KP, KD, OBSERVER = 800.0, 40.0, 50.0
"""Published gains in 1/s^2, 1/s and rad/s."""
INERTIA = 0.0082 + 0.5 * 0.15**2
PUBLISHED_KF = 0.5 / INERTIA
"""Published start (2 M)^-1: C2 = C3 = M K_f = 0.5."""
WALL_RAD = 0.3


@dataclass(frozen=True)
class Run:
    """Torques at each tick in N m."""

    hand: Array
    """Of the hand on the leader."""
    wall: Array
    """Of the wall on the follower."""
    apart: Array
    """Angle of the leader less that of the follower in rad."""
    gravity: Array
    """Of the weight on the leader."""
    speed: Array
    """Of the leader in rad/s."""


def arms(world: World, folder: Path, *, friction: bool, **options: Any) -> list[Follower]:  # noqa: ANN401  # of drivers
    path = folder / "lever-arm.toml"
    path.write_text(ARM)
    arm = load_arm(path)
    own = JointSettings.of(arm.joints[0].servo_model)
    coulomb, viscous = (own.coulomb, own.viscous) if friction else (0.0, 0.0)
    joint = msgspec.structs.replace(arm.joints[0], coulomb_nm=coulomb, viscous_nm_s=viscous)
    arm = msgspec.structs.replace(arm, joints=(joint,))
    found = []
    for port in ("leader", "follower"):
        servos = servos_of(arm, baud=4_000_000, firmware=52, start=[0.0])
        found.append(
            Follower(
                world, folder, servos, ArmLoad(arm, servos), port=port, description=str(path), max_speed=6.0,
                coulomb=[coulomb], viscous=[viscous], observer_bandwidth=OBSERVER, **options,
            )
        )  # fmt: skip
    return found


def coupled(
    world: World, folder: Path, kf: float, wall: float | None, *,
    wall_damping: float | None = None, hand: tuple[float, float] = (5.0, 0.1), to_rad: float = 0.5, move_s: float = 2.0, rest_s: float = 3.0,
    friction: bool = False, **options: Any,  # noqa: ANN401  # of drivers
) -> Run:  # fmt: skip
    """Couple two joints at 500 Hz; a hand of K, D turns the leader from 0 towards an angle, and keeps pressing there.

    Both sides: tau = M [K_p (x' - x) + K_d (v' - v) + K_f (f' + f)] - f, with f of the observers.
    """
    leader, follower = arms(world, folder, friction=friction, **options)
    if wall is not None:
        joint = follower.joint
        joint.stops, joint.stop_stiffness, joint.stop_damping = (-3.0, WALL_RAD), wall, wall_damping
    leader.joint.hand = HeldBy(
        goal_rad=to_rad, stiffness=hand[0], damping=hand[1], begin_s=world.clock.now_s, duration_s=move_s
    )  # fmt: skip
    rows = []
    for _ in range(round((move_s + rest_s) / TICK_S)):
        world.clock.wait(TICK_S)
        (x_m, v_m, f_m), (x_s, v_s, f_s) = first(leader.driver.read()), first(follower.driver.read())
        spring = INERTIA * (KP * (x_s - x_m) + KD * (v_s - v_m))
        forces = INERTIA * kf * (f_m + f_s)
        leader.driver.write_force((spring + forces - f_m,))
        follower.driver.write_force((-spring + forces - f_s,))
        rows.append(
            (
                leader.joint.hand_nm, follower.joint.stop_nm, leader.joint.position_rad - follower.joint.position_rad,
                leader.joint.load_nm, leader.joint.velocity_rad_s,
            )
        )  # fmt: skip
    return Run(*np.array(rows).T)
