"""Inverse kinematics of UR arms: all eight branches in closed form, or the one nearest to where the arm was.

The emulated controller answers with it. The driver does not need it: an arm is led from where its joints are, and joint
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

    The closed form is right to rounding (1e-14 m and rad), at singularities too. With a calibration there is none: its
    postures are the starts of a Newton iteration on the unit's own chain, which ends within 5e-13 m and rad. Beside
    singularities, where the postures of the unit are far from those of the model, `all` may then miss a branch.

    Args:
        model: The arm; its `position_min` and `position_max` are the limits of `nearest`.
        calibration: Deltas of this unit; without them the arm is as its data sheet has it.
        tool: flange_from_tool, (4, 4); without it the tool is the flange.

    Raises:
        ValueError: The deltas are not of such an arm, or the tool is not a rigid transform.

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
        """Why the last call of `nearest` found no posture; empty if it found one."""
        self._solver = UrInverseSolver(
            _rows(dh_rows(model)),
            None if calibration is None else _rows(dh_rows(model, calibration)),
            model.position_min,
            model.position_max,
            tool_transform(tool),
        )

    def all(self, base_from_tool: Matrix) -> Array:
        """Every posture that has the tool there, (n, 6) in rad, n up to 8; n is 0 where the arm does not reach.

        Each joint is within -pi to pi, whatever its limits; multiples of 2 pi are for the caller to add. Two branches
        that meet at a singularity are there twice. Where q5 is 0 or pi, q6 is free, and any.

        Args:
            base_from_tool: Rigid transform, (4, 4). A rotation in single precision is moved to the nearest one.

        Raises:
            ValueError: Not a rigid transform within 1e-6.
        """
        return self._solver.all(_float64(base_from_tool))

    def nearest(self, base_from_tool: Matrix, q_near: Numbers) -> Array | None:
        """The posture within the limits that is nearest to `q_near`, or None: then `reason` says why.

        Nearest by the sum of squares over the joints, each with the multiple of 2 pi that its limits allow. Where q5 is
        0 or pi, q6 stays as near to where it was as the reach allows. Where two branches meet (arm stretched or folded,
        wrist over the base's axis), the arm may leave on either: give where it is about to be, and it goes straight
        through.

        Args:
            base_from_tool: Rigid transform, (4, 4). A rotation in single precision is moved to the nearest one.
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
