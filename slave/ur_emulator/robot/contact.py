"""Environment of the tool, and the force sensor in the flange."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING, Final

import numpy as np

from haptether._core import ForceSensor
from haptether.slave.ur.kinematics.pose import Vector, rotvec_from_matrix
from haptether.slave.ur_emulator.robot.kinematics import Array, Six, Three

if TYPE_CHECKING:
    from haptether._core import SceneTouch

TORQUE_SHARE: Final = 0.1
"""Noise of a torque in N m per noise of a force in N."""


class ToolEnvironment:
    """Forces on the tool: a scene around it, at rest until `engage`, pushes and a clamp on command.

    The scene's axes are those of the base. The tool position at `anchor` is the start of the scene's arm. Before
    `engage` the scene's time stands still and its pushers do not push.

    Args:
        scene: The scene's environment; None for free space.
    """

    def __init__(self, scene: "SceneTouch | None" = None) -> None:
        self._scene = scene
        self._origin: tuple[float, ...] | None = None
        self._engaged_at_s = math.inf
        self._push: Vector = (0.0, 0.0, 0.0)
        self._push_until_s = -math.inf
        self._clamp = (0.0, 0.0)
        """Stiffness in N m/rad and damping in N m s/rad of the clamp."""
        self._clamped: Array | None = None
        """Orientation at which the clamp is at rest; None until it is known."""
        self._now_s = 0.0

    @property
    def engaged(self) -> bool:
        """Return True while the scene's time runs."""
        return self._engaged_at_s <= self._now_s

    def engage(self) -> None:
        """Start the scene's time, once."""
        if not self.engaged:
            self._engaged_at_s = self._now_s
            if self._scene is not None:
                self._scene.start_pushers(0.0)

    def reset(self) -> None:
        """Restore the initial scene without a push, not engaged; it is anchored again at the tool's next position."""
        if self._scene is not None:
            self._scene.reset()
        self._origin = None
        self._engaged_at_s = math.inf
        self._push_until_s = -math.inf
        self.clamp(0.0)

    def anchor(self, position: Sequence[float]) -> None:
        """Anchor the scene: its arm starts at this position in m, in the base frame."""
        start = (0.0,) * 3 if self._scene is None else self._scene.start
        self._origin = tuple(p - s for p, s in zip(position, start, strict=True))

    def push(self, force: Vector, duration_s: float) -> None:
        """Add a force in N on the tool for a time; it replaces the previous push."""
        self._push, self._push_until_s = force, self._now_s + duration_s

    def clamp(self, stiffness: float, damping: float = 0.0) -> None:
        """Hold the tool's present orientation by a spring in N m/rad and a damper in N m s/rad; 0 N m/rad ends it."""
        self._clamp, self._clamped = (stiffness, damping), None

    def moment(self, rotation: Array, angular_velocity: Sequence[float]) -> Vector:
        """Return the clamp's moment in N m about the tool point, in the base frame: `k log(R_0 R') - d w`.

        Args:
            rotation: base_from_tool, (3, 3).
            angular_velocity: In rad/s, (3,).
        """
        stiffness, damping = self._clamp
        if stiffness == 0.0:
            return 0.0, 0.0, 0.0
        if self._clamped is None:
            self._clamped = rotation.copy()
        turned = rotvec_from_matrix(self._clamped @ rotation.T)
        x, y, z = (stiffness * a - damping * w for a, w in zip(turned, angular_velocity, strict=True))
        return x, y, z

    def force(self, time_s: float, position: Sequence[float], velocity: Sequence[float]) -> Vector:
        """Return the force in N on the tool, in the base frame."""
        self._now_s = time_s
        push = self._push if time_s < self._push_until_s else (0.0, 0.0, 0.0)
        if self._scene is None:
            return push
        fx, fy, fz = self._scene.force(self._scene_time(time_s), self._in_scene(position), velocity)
        return fx + push[0], fy + push[1], fz + push[2]

    def advance(self, time_s: float, step_s: float, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Move the yielding parts of the scene over a step."""
        if self._scene is not None and self._engaged_at_s <= time_s:
            self._scene.advance(self._scene_time(time_s), step_s, self._in_scene(position), velocity)

    def _scene_time(self, time_s: float) -> float:
        return max(0.0, time_s - self._engaged_at_s) if math.isfinite(self._engaged_at_s) else 0.0

    def _in_scene(self, position: Sequence[float]) -> tuple[float, ...]:
        if self._origin is None:
            self.anchor(position)
        return tuple(p - o for p, o in zip(position, self._origin or (), strict=True))


class WrenchSensing:
    """Force and torque sensor: bias, noise, and the offset that zero_ftsensor sets.

    Args:
        noise_n: Standard deviation of the forces in N; torques have a tenth of it, in N m.
        bias: Three offsets in N, three in N m.
        seed: Seed of the noise.

    Raises:
        ValueError: A number is not finite, or the deviation is negative.
    """

    def __init__(self, noise_n: float = 0.0, bias: Six = (0.0,) * 6, seed: int = 0) -> None:
        self._force = ForceSensor(noise_n=noise_n, bias_n=list(bias[:3]), seed=seed)
        self._torque = ForceSensor(noise_n=TORQUE_SHARE * noise_n, bias_n=list(bias[3:]), seed=seed ^ 1 << 63)
        self.offset: Six = (0.0,) * 6
        self.external: Six | None = None
        """Wrench of a client's sensor, which replaces this one; None without."""
        self._last: Six = (0.0,) * 6
        self._samples = 0

    def sample(self, wrench: Six) -> Six:
        """Return the next sample of a wrench in N and N m at the tool, in the base frame, minus the offset."""
        if self.external is None:
            force = self._force.sample(wrench[:3], self._samples)
            self._last = (*force, *self._torque.sample(wrench[3:], self._samples))
            self._samples += 1
        else:
            self._last = self.external
        return tuple([w - o for w, o in zip(self._last, self.offset, strict=True)])

    def raw(self, flange_rotation: Array, lever: Array, weight: Array, cog: Three) -> Six:
        """Return ft_raw_wrench: the last sample at the flange in its frame, with the payload and without the offset.

        Args:
            flange_rotation: base_from_flange, (3, 3).
            lever: Vector from the flange to the tool in m, in the base frame, (3,).
            weight: Weight of the payload in N, in the base frame, (3,).
            cog: The payload's centre of gravity in m, in the flange frame.
        """
        force, torque = self._last[:3], self._last[3:]
        gravity = weight @ flange_rotation
        # np.cross takes longer than all the rest.
        about_flange = np.array(_cross(lever.tolist(), force)) + torque
        about_cog = _cross(cog, gravity.tolist())
        return (*(force @ flange_rotation + gravity).tolist(), *(about_flange @ flange_rotation + about_cog).tolist())

    def zero(self) -> None:
        """Make the last sample zero (zero_ftsensor)."""
        self.offset = self._last


def _cross(a: Three, b: Three) -> Three:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
