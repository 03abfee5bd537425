"""Four-channel control in its acceleration form on two arms that take forces: free motion, and contact with walls."""

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from tests.dynamixel.test_force_follower import ARM, UNIT_NM, WALLS, first
from tests.dynamixel.virtual import TICK_S, Follower, World

from haptether.dynamixel.description import load_arm
from haptether.dynamixel.emulator import ArmLoad, HeldBy, JointSettings, servos_of

pytestmark = pytest.mark.slow

DOCUMENT = Path(__file__).parents[2] / "docs/dynamixel.md"
Array = npt.NDArray[np.float64]
KP, KD, OBSERVER = 800.0, 40.0, 50.0
"""Published gains in 1/s^2, 1/s and rad/s."""
INERTIA = 0.0082 + 0.5 * 0.15**2
PUBLISHED_KF = 0.5 / INERTIA
"""Published start (2 M)^-1: C2 = C3 = M K_f = 0.5."""
SMALL = 0.1
"""Share of that for a small force gain: C = 0.05."""
WALL_RAD = 0.3
MOVING_RAD_S = 0.05
"""Two units of Present Velocity, as in the tests of a leader alone."""


@dataclass(frozen=True)
class Run:
    """Signals at each tick; torques are in N m."""

    hand: Array
    """Torque of the hand on the leader."""
    wall: Array
    """Torque of the wall on the follower."""
    apart: Array
    """Angle of the leader less that of the follower in rad."""
    gravity: Array
    """Torque of the weight on the leader."""
    speed: Array
    """Speed of the leader in rad/s."""


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
    wall_damping: float | None = None, hand: tuple[float, float] = (5.0, 0.1),
    to_rad: float = 0.5, move_s: float = 2.0, rest_s: float = 3.0,
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


@cache
def run(kf_share: float, wall: str | None = None, **options: Any) -> Run:  # noqa: ANN401  # of `coupled`
    """Return a run with a share of the published force gain; by default the wall has no damping."""
    stiffness = None if wall is None else WALLS[wall]
    with pytest.MonkeyPatch.context() as patched, TemporaryDirectory() as folder:
        return coupled(
            World(patched), Path(folder), kf_share * PUBLISHED_KF, stiffness, **{"wall_damping": 0.0, **options}
        )


def swung(kf_share: float, *, friction: bool = False, gain: float = 0.0) -> Run:
    """Lead both arms slowly by a stiff hand, as in the tests of a leader alone."""
    return run(
        kf_share, hand=(200.0, 2.0), to_rad=1.0, move_s=6.0, rest_s=1.0,
        friction=friction, friction_gain=gain, friction_speed=0.03,
    )  # fmt: skip


def share_of_gravity(run: Run, *, moving: bool) -> float:
    """Return the root mean square of the hand's torque as a share of that of gravity."""
    felt = run.hand[np.abs(run.speed) > MOVING_RAD_S] if moving else run.hand
    return float(np.sqrt(np.mean(felt**2) / np.mean(run.gravity**2)))


def rows() -> list[str]:
    """Return the table of the document."""
    lines = []
    for kf_share in (SMALL, 1.0, 2.0, 4.0):
        cells = [
            f"{kf_share * PUBLISHED_KF * INERTIA:g}",
            f"{100.0 * share_of_gravity(swung(kf_share), moving=False):.1f} %",
        ]
        for wall in WALLS:
            hand, pressed = run(kf_share, wall).hand[-500:], -run(kf_share, wall).wall[-500:]
            ripple = np.ptp(pressed)
            calm = f"{hand.mean():.3f}, {pressed.mean():.3f}, {ripple:.3f}"
            cells.append(calm if ripple < 0.1 * pressed.mean() else "chatters")
        lines.append(f"| {' | '.join(cells)} |")
    return lines


def test_the_document_has_these_figures() -> None:
    text = DOCUMENT.read_text(encoding="utf-8")
    for line in rows():
        assert line in text, line


def test_free_motion_of_both_arms_needs_under_5_percent_of_gravity() -> None:
    """Check the effort: 1.8 %."""
    free = swung(1.0)
    assert 0.005 < share_of_gravity(free, moving=False) < 0.05
    assert np.abs(free.apart).max() < 0.005


@pytest.mark.parametrize(("gain", "low", "high"), [(0.9, 0.03, 0.05), (0.0, 0.25, 0.45)])
def test_friction_is_felt_by_what_is_left_of_it_over_the_force_gain(gain: float, low: float, high: float) -> None:
    """Check the effort while the arms move: 4.7 % with 0.9 of the friction compensated, 35 % without."""
    assert low < share_of_gravity(swung(1.0, friction=True, gain=gain), moving=True) < high


def test_a_small_force_gain_makes_the_arms_heavy() -> None:
    """Check the effort: 12 %, from the felt inertia 1 / K_f of 20 M, and from whole units of current over C."""
    assert 0.08 < share_of_gravity(swung(SMALL), moving=True) < 0.16


@pytest.mark.parametrize("wall", WALLS)
@pytest.mark.parametrize("kf_share", [1.0, SMALL])
def test_the_hand_feels_the_torque_of_a_wall_without_damping(wall: str, kf_share: float) -> None:
    pressing = run(kf_share, wall)
    hand, pressed = pressing.hand[-500:], -pressing.wall[-500:]
    # Two sides, each with a truncated command and a rounded measurement, over 2 C; and the measurements themselves.
    tolerance = 1.5 * UNIT_NM / (kf_share * PUBLISHED_KF * INERTIA) + UNIT_NM
    assert hand.mean() == pytest.approx(pressed.mean(), abs=tolerance)
    # Hand and wall in series: the coupling adds no compliance.
    expected = (0.5 - WALL_RAD) / (1.0 / 5.0 + 1.0 / WALLS[wall])
    assert 0.5 * (hand.mean() + pressed.mean()) == pytest.approx(expected, abs=tolerance)
    assert max(np.ptp(hand), np.ptp(pressed)) < 0.1 * expected
    assert np.abs(pressing.apart[-500:]).max() < 0.003


@pytest.mark.parametrize("wall", WALLS)
def test_four_times_the_published_force_gain_chatters_on_a_wall_without_damping(wall: str) -> None:
    assert np.ptp(run(4.0, wall).wall[-500:]) > 0.5


def test_four_times_the_published_force_gain_settles_on_a_damped_wall() -> None:
    damped = run(4.0, "2000 N/m", wall_damping=None)
    assert np.ptp(damped.wall[-500:]) < 0.1
    assert damped.hand[-500:].mean() == pytest.approx(-damped.wall[-500:].mean(), abs=2.5 * UNIT_NM)
