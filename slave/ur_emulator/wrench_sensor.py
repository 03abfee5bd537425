"""The force and torque sensor in the flange."""

import numpy as np
import numpy.typing as npt

from haptether._core import ForceSensor

Array = npt.NDArray[np.float64]
Six = tuple[float, ...]
Vector = tuple[float, ...]
TORQUE_SHARE = 0.1
"""Noise of a torque in N m, of that of a force in N."""


class WrenchSensing:
    """What the sensor makes of a wrench: bias, noise, and the offset that zero_ftsensor sets.

    Args:
        noise_n: Standard deviation of the forces in N; torques have a tenth of it, in N m.
        bias: Three offsets in N, three in N m.
        seed: Of the noise: the same seed gives the same.

    Raises:
        ValueError: A number that is not finite, or a negative deviation.
    """

    def __init__(self, noise_n: float = 0.0, bias: Six = (0.0,) * 6, seed: int = 0) -> None:
        self._force = ForceSensor(noise_n=noise_n, bias_n=list(bias[:3]), seed=seed)
        self._torque = ForceSensor(noise_n=TORQUE_SHARE * noise_n, bias_n=list(bias[3:]), seed=seed ^ 1 << 63)
        self.offset: Six = (0.0,) * 6
        self.external: Six | None = None
        """The wrench of a sensor of a client's, which then counts instead."""
        self._last: Six = (0.0,) * 6
        self._samples = 0

    def sample(self, wrench: Six) -> Six:
        """The next sample of a wrench in N and N m at the tool, in the frame of the base, less the offset."""
        if self.external is None:
            force = self._force.sample(wrench[:3], self._samples)
            self._last = (*force, *self._torque.sample(wrench[3:], self._samples))
            self._samples += 1
        else:
            self._last = self.external
        return tuple([w - o for w, o in zip(self._last, self.offset, strict=True)])

    def raw(self, flange_turn: Array, lever: Array, weight: Array, cog: Vector) -> Six:
        """The last sample at the flange and in its frame, with the payload and without the offset: ft_raw_wrench.

        Args:
            flange_turn: Rotation base_from_flange, (3, 3).
            lever: From the flange to the tool in m, in the frame of the base, (3,).
            weight: Of the payload in N, in the frame of the base, (3,).
            cog: The payload's centre of gravity in m, in the frame of the flange.
        """
        force, torque = self._last[:3], self._last[3:]
        hangs = weight @ flange_turn
        # Not numpy's product, which takes longer than all the rest.
        about_flange = np.array(_cross(lever.tolist(), force)) + torque
        about_cog = _cross(cog, hangs.tolist())
        return (*(force @ flange_turn + hangs).tolist(), *(about_flange @ flange_turn + about_cog).tolist())

    def zero(self) -> None:
        """zero_ftsensor: what it shows now becomes zero."""
        self.offset = self._last


def _cross(a: Vector, b: Vector) -> Vector:
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
