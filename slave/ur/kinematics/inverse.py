"""Inverse kinematics of UR arms: all eight branches in closed form, or the one nearest to a posture.

Used by the emulated controller. The driver does not need it: it starts from the arm's joint angles, and joint
velocities (`streaming`) never leave the branch.
"""

from collections.abc import Sequence
from typing import TypeAlias

import numpy as np

from haptether._core import UrInverseSolver
from haptether.slave.ur.kinematics.chain import DhRows, UrCalibration, dh_rows, tool_transform
from haptether.slave.ur.kinematics.models import UrModel
from haptether.slave.ur.kinematics.pose import Array, Numbers

Matrix: TypeAlias = Array | Sequence[Sequence[float]]


class UrInverse:
    """Inverse kinematics of one UR arm.

    The closed form is exact to rounding (1e-14 m and rad), also at singularities. With a calibration its postures start
    a Newton iteration on the unit's chain, which ends within 5e-13 m and rad. Near singularities, where postures of
    unit and model differ strongly, `all` may then miss a branch.

    Args:
        model: Model of the arm; its `position_min` and `position_max` are the limits of `nearest`.
        calibration: Deltas of this unit; by default the data sheet applies.
        tool: flange_from_tool, (4, 4); by default the flange.

    Raises:
        ValueError: The deltas do not fit the model, or the tool is not a rigid transform.

    Source: K. P. Hawkins, "Analytic Inverse Kinematics for the Universal Robots UR-5/UR-10 Arms", Georgia Institute of
    Technology, 2013; N. Yamashita, M. Fukushima, "On the Rate of Convergence of the Levenberg-Marquardt Method", 2001.
    """

    def __init__(
        self,
        model: UrModel,
        calibration: UrCalibration | None = None,
        tool: Matrix | None = None,
    ) -> None:
        if calibration is not None:
            calibration.check(model)
        self.model = model
        self.calibration = calibration
        self.reason = ""
        """Reason why the last call of `nearest` found no posture; empty on success."""
        self._solver = UrInverseSolver(
            _rows(dh_rows(model)),
            None if calibration is None else _rows(dh_rows(model, calibration)),
            model.position_min,
            model.position_max,
            tool_transform(tool),
        )

    def all(self, base_from_tool: Matrix) -> Array:
        """Return every posture for a tool pose, (n, 6) in rad, n up to 8; n is 0 out of reach.

        Each joint is within -pi to pi regardless of its limits; the caller adds multiples of 2 pi. Two branches that
        meet at a singularity appear twice. If q5 is 0 or pi, q6 is arbitrary.

        Args:
            base_from_tool: Rigid transform, (4, 4). A single-precision rotation is orthonormalised.

        Raises:
            ValueError: Not a rigid transform within 1e-6.
        """
        return self._solver.all(_float64(base_from_tool))

    def nearest(self, base_from_tool: Matrix, q_near: Numbers) -> Array | None:
        """Return the posture within the limits nearest to `q_near`, or None with a `reason`.

        Minimises the sum of squares over the joints, with multiples of 2 pi within the limits. If q5 is 0 or pi, q6
        stays as close as the reach allows. Where two branches meet (stretched or folded arm, wrist over the base axis),
        either may follow; pass a predicted posture to pass straight through.

        Args:
            base_from_tool: Rigid transform, (4, 4). A single-precision rotation is orthonormalised.
            q_near: Joint angles in rad, (6,).

        Raises:
            ValueError: Not a rigid transform within 1e-6, or not six finite numbers.
        """
        try:
            found = self._solver.nearest(base_from_tool, q_near)  # type: ignore[arg-type]
        except TypeError:
            found = self._solver.nearest(_float64(base_from_tool), _float64(q_near))
        if isinstance(found, str):
            self.reason = found
            return None
        self.reason = ""
        return found


def _rows(rows: DhRows) -> tuple[Sequence[float], Sequence[float], Sequence[float], Sequence[float]]:
    return rows.theta, rows.a, rows.d, rows.alpha


def _float64(values: Matrix | Numbers) -> Array:
    return np.asarray(values, dtype=np.float64)
