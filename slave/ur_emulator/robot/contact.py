"""What the tool touches: the environment of a scene, and pushes that are asked for while the emulator runs."""

import math
from collections.abc import Sequence
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether._core import SceneTouch
    from haptether.slave.ur_emulator.touch import Vector


class ToolEnvironment:
    """A scene around the tool, at rest until `engage`, and extra pushes.

    The scene's coordinates run along the axes of the base; the tool's place when the scene is anchored is where the
    scene's arm starts. Before `engage` the scene's time stands still at its begin and its pushers do not push.

    Args:
        scene: The scene's environment; None for free space.
    """

    def __init__(self, scene: "SceneTouch | None" = None) -> None:
        self._scene = scene
        self._origin: tuple[float, ...] | None = None
        self._engaged_at_s = math.inf
        self._push: Vector = (0.0, 0.0, 0.0)
        self._push_until_s = -math.inf
        self._now_s = 0.0

    @property
    def engaged(self) -> bool:
        """Whether the scene's time runs."""
        return self._engaged_at_s <= self._now_s

    def engage(self) -> None:
        """The scene's time begins now, once."""
        if not self.engaged:
            self._engaged_at_s = self._now_s
            if self._scene is not None:
                self._scene.start_pushers(0.0)

    def reset(self) -> None:
        """The scene as at first, not engaged, anchored anew where the tool is next; no push."""
        if self._scene is not None:
            self._scene.reset()
        self._origin = None
        self._engaged_at_s = math.inf
        self._push_until_s = -math.inf

    def anchor(self, position: Sequence[float]) -> None:
        """The tool's place in m, in the frame of the base, is where the scene's arm starts."""
        start = (0.0,) * 3 if self._scene is None else self._scene.start
        self._origin = tuple(p - s for p, s in zip(position, start, strict=True))

    def push(self, force: "Vector", duration_s: float) -> None:
        """An extra force in N on the tool from now on, for a time; it takes the place of the one before."""
        self._push, self._push_until_s = force, self._now_s + duration_s

    def force(self, time_s: float, position: Sequence[float], velocity: Sequence[float]) -> "Vector":
        """See `Touch`."""
        self._now_s = time_s
        push = self._push if time_s < self._push_until_s else (0.0, 0.0, 0.0)
        if self._scene is None:
            return push
        fx, fy, fz = self._scene.force(self._scene_time(time_s), self._placed(position), velocity)
        return fx + push[0], fy + push[1], fz + push[2]

    def advance(self, time_s: float, step_s: float, position: Sequence[float], velocity: Sequence[float]) -> None:
        """See `Touch`."""
        if self._scene is not None and self._engaged_at_s <= time_s:
            self._scene.advance(self._scene_time(time_s), step_s, self._placed(position), velocity)

    def _scene_time(self, time_s: float) -> float:
        return max(0.0, time_s - self._engaged_at_s) if math.isfinite(self._engaged_at_s) else 0.0

    def _placed(self, position: Sequence[float]) -> tuple[float, ...]:
        if self._origin is None:
            self.anchor(position)
        return tuple(p - o for p, o in zip(position, self._origin or (), strict=True))
