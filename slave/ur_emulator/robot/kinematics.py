"""Kinematics of the arm with its present tool."""

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from haptether.slave.ur.kinematics.arm import UrKinematics
from haptether.slave.ur.kinematics.chain import cos_sin, dh_rows
from haptether.slave.ur.kinematics.inverse import UrInverse
from haptether.slave.ur.kinematics.pose import pose_from_transform, transform_from_pose

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.models import UrModel

Array = npt.NDArray[np.float64]
Joints = tuple[float, ...]
"""One number for each joint."""
Six = tuple[float, ...]
Three = tuple[float, ...]

MIN_SINGULAR_VALUE = 1e-6
"""Singular value of the Jacobian, in m and rad per rad, below which a tool velocity has no joint velocity."""


def six(values: Array) -> Six:
    """Return six Python floats."""
    return tuple(values.tolist())


class ArmKinematics:
    """Kinematics; poses are those of the tool in the base frame, as `x y z rx ry rz` in m and rad.

    Args:
        model: The arm, without calibration.
    """

    def __init__(self, model: "UrModel") -> None:
        self._forward = UrKinematics(model)
        self._inverse = UrInverse(model)
        self._model = model
        self._rows = dh_rows(model)
        self.tcp_offset: Six = (0.0,) * 6
        self._tool: Array = np.eye(4)
        self._tool_inverse: Array = np.eye(4)

    def set_tcp(self, offset: Six) -> None:
        """Set the pose of the tool in the flange frame."""
        self.tcp_offset = offset
        self._tool = transform_from_pose(offset)
        self._tool_inverse = np.linalg.inv(self._tool).astype(np.float64)

    def flange_pose(self, q: Joints) -> Six:
        """Return the flange pose."""
        return six(pose_from_transform(self._forward.forward(q)))

    def pose(self, q: Joints, offset: Six | None = None) -> Six:
        """Return the pose of the tool, or of a tool with another offset."""
        tool = self._tool if offset is None else transform_from_pose(offset)
        return six(pose_from_transform(self._forward.forward(q) @ tool))

    def flange_rotation(self, tool: Array) -> Array:
        """Return base_from_flange, (3, 3), from base_from_tool, (4, 4)."""
        rotation: Array = tool[:3, :3] @ self._tool[:3, :3].T
        return rotation

    def lever(self, tool: Array) -> Array:
        """Return the vector from the flange to the tool in m, in the base frame, (3,), from base_from_tool, (4, 4)."""
        lever: Array = self.flange_rotation(tool) @ self._tool[:3, 3]
        return lever

    def elbow(self, q: Joints, qd: Joints) -> tuple[Three, Three]:
        """Return position in m and velocity in m/s of the upper arm's end in the base frame: `p_2` of the DH chain.

        `p = o_1 + R_1 (a_2 cos q_2, a_2 sin q_2, d_2)`, `v = qd_1 z_0 x p + qd_2 z_1 x (p - o_1)`.

        Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 2.52 and 3.30.
        """
        rows = self._rows
        c1, s1 = math.cos(q[0] + rows.theta[0]), math.sin(q[0] + rows.theta[0])
        c2, s2 = math.cos(q[1] + rows.theta[1]), math.sin(q[1] + rows.theta[1])
        ca, sa = cos_sin(rows.alpha[0])
        u, v, w = rows.a[1] * c2, rows.a[1] * s2, rows.d[1]
        # Relative to the shoulder.
        x = c1 * u - s1 * ca * v + s1 * sa * w
        y = s1 * u + c1 * ca * v - c1 * sa * w
        z = sa * v + ca * w
        px, py, pz = x + rows.a[0] * c1, y + rows.a[0] * s1, z + rows.d[0]
        ax, ay, az = qd[1] * s1 * sa, -qd[1] * c1 * sa, qd[1] * ca
        velocity = (ay * z - az * y - qd[0] * py, az * x - ax * z + qd[0] * px, ax * y - ay * x)
        return (px, py, pz), velocity

    def transform_and_jacobian(self, q: Joints) -> tuple[Array, Array]:
        """Return base_from_tool, (4, 4), and the tool Jacobian, (6, 6): velocity over angular velocity."""
        flange, jacobian = self._forward.forward_and_jacobian(q)
        lever = flange[:3, :3] @ self._tool[:3, 3]
        moved = np.array(jacobian)
        x, y, z = lever.tolist()
        # v_tool = v_flange + omega x lever
        moved[:3] -= np.array(((0.0, -z, y), (z, 0.0, -x), (-y, x, 0.0))) @ jacobian[3:]
        return flange @ self._tool, moved

    def jacobian_rate(self, q: Joints, qd: Joints) -> Array:
        """Return the time derivative of the tool Jacobian, (6, 6), by central differences.

        The relative error is about 1e-9: 1e-10 from the third derivative, 1e-11 from rounding.
        """
        step = 1e-5
        ahead, behind = (
            self.transform_and_jacobian(tuple(a + sign * step * v for a, v in zip(q, qd, strict=True)))[1]
            for sign in (1.0, -1.0)
        )
        return (ahead - behind) / (2.0 * step)

    def tool_velocity(self, q: Joints, qd: Joints) -> Six:
        """Return velocity in m/s and angular velocity in rad/s of the tool, in the base frame."""
        _, jacobian = self.transform_and_jacobian(q)
        return six(jacobian @ np.array(qd))

    def joint_velocity(self, q: Joints, velocity: Six) -> Joints | None:
        """Return joint velocities in rad/s for a tool velocity; None at a singularity."""
        _, jacobian = self.transform_and_jacobian(q)
        try:
            rates = np.linalg.solve(jacobian, np.array(velocity))
        except np.linalg.LinAlgError:
            return None
        return six(rates) if float(np.abs(rates).max()) < 1.0 / MIN_SINGULAR_VALUE else None

    def inverse(self, pose: Six, near: Joints) -> Joints | None:
        """Return the joint angles nearest to `near` for a tool pose; None if it is out of reach."""
        flange = transform_from_pose(pose) @ self._tool_inverse
        found = self._inverse.nearest(flange, np.array(near))
        return None if found is None else six(found)

    def is_within_limits(self, q: Joints) -> bool:
        """Return True if every joint is within its position limits."""
        model = self._model
        return all(
            low <= angle <= high for low, angle, high in zip(model.position_min, q, model.position_max, strict=True)
        )
