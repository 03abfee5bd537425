"""Forward kinematics, Jacobian, manipulability and their time derivatives of a UR arm.

CasADi expressions, each compiled on first use.
"""

from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import NamedTuple

import numpy as np

from haptether.slave.ur.kinematics.chain import (
    Chain,
    UrCalibration,
    dh_rows,
    jacobian_determinant,
    symbolic_chain,
    tool_transform,
)
from haptether.slave.ur.kinematics.models import UrModel
from haptether.slave.ur.kinematics.pose import Array, Numbers
from haptether.slave.ur.kinematics.symbolic import Buffered, Symbol, casadi_module


class Rates(NamedTuple):
    """Time derivatives of Jacobian and manipulability."""

    jacobian_dot: Array
    """dJ/dt, (6, 6)."""
    manipulability_rate: float
    """d/dt of the manipulability in m^3/s; at a singularity, where it has a kink, the value of one side or 0."""


class UrKinematics:
    """Kinematics of one UR arm, for one thread.

    A returned array is the same memory at every call: **the next call of that method overwrites it**. Copy it to keep
    it. It is column-major and read-only. Float64 arrays of joint angles are fastest; other sequences are converted.

    Args:
        model: Model of the arm.
        calibration: Deltas of this unit; by default the data sheet applies.
        tool: flange_from_tool, (4, 4); by default the flange.

    Raises:
        ValueError: The deltas do not fit the model, or the tool is not a rigid transform. Every method: an argument is
            not six finite numbers.
    """

    def __init__(
        self,
        model: UrModel,
        calibration: UrCalibration | None = None,
        tool: Array | Sequence[Sequence[float]] | None = None,
    ) -> None:
        if calibration is not None:
            calibration.check(model)
        self.model = model
        self.calibration = calibration
        self.rows = dh_rows(model, calibration)
        """Denavit-Hartenberg parameters with deltas."""
        self.tool = tool_transform(tool)
        """flange_from_tool, (4, 4)."""

    @cached_property
    def chain(self) -> Chain:
        """Expressions for further use."""
        return symbolic_chain(self.rows, self.tool)

    def forward(self, q: Numbers) -> Array:
        """Return base_from_tool, (4, 4), at joint angles q in rad, (6,)."""
        function = self._forward
        function.one(q)
        return function.results[0]

    def forward_and_jacobian(self, q: Numbers) -> tuple[Array, Array]:
        """Return base_from_tool, (4, 4), and the geometric Jacobian, (6, 6), at joint angles q in rad, (6,).

        `(v, w) = J qd`: velocity of the tool point in m/s over angular velocity in rad/s, both in the base frame.

        Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 3.30.
        """
        function = self._forward_and_jacobian
        function.one(q)
        transform, jacobian = function.results
        return transform, jacobian

    def manipulability(self, q: Numbers) -> float:
        """Return `sqrt(det(J J')) = |det J|` at joint angles q in rad, (6,): 0 at a singularity.

        In m^3: linear and angular velocity are mixed without scaling, so compare values of one arm only.
        The tool does not matter.

        Source: T. Yoshikawa, "Manipulability of Robotic Mechanisms", Int. J. Robotics Research 4(2), 1985, Eq. 13.
        """
        function = self._manipulability
        function.one(q)
        value: float = function.numbers[0][0]
        return value

    def rates(self, q: Numbers, qd: Numbers) -> Rates:
        """Return dJ/dt and d/dt of the manipulability at joint angles q in rad and speeds qd in rad/s, (6,) each.

        Exact directional derivatives of the expressions along qd.
        """
        function = self._rates
        function.all(q, qd)
        return Rates(function.results[0], function.numbers[1][0])

    @cached_property
    def _forward(self) -> Buffered:
        return Buffered("forward", [self.chain.q], [self.chain.transform])

    @cached_property
    def _forward_and_jacobian(self) -> Buffered:
        chain = self.chain
        return Buffered("forward_and_jacobian", [chain.q], [chain.transform, chain.jacobian])

    @cached_property
    def determinant(self) -> Symbol:
        """Determinant of the Jacobian as an expression."""
        casadi = casadi_module()
        # The determinant is equal for every point of the last link. On the last axis, at the intersection of two wrist
        # axes, most terms of its expansion are zero.
        rows = self.rows
        a, d = (*rows.a[:5], 0.0), (*rows.d[:5], 0.0)
        bare = symbolic_chain(replace(rows, a=a, d=d), np.eye(4))
        return casadi.substitute(jacobian_determinant(bare.jacobian), bare.q, self.chain.q)

    @cached_property
    def _manipulability(self) -> Buffered:
        casadi = casadi_module()
        return Buffered("manipulability", [self.chain.q], [casadi.fabs(self.determinant)])

    @cached_property
    def _rates(self) -> Buffered:
        casadi = casadi_module()
        chain, determinant = self.chain, self.determinant
        qd = casadi.SX.sym("qd", 6)
        jacobian_dot = casadi.jtimes(chain.jacobian, chain.q, qd)
        rate = casadi.sign(determinant) * casadi.jtimes(determinant, chain.q, qd)
        return Buffered("rates", [chain.q, qd], [jacobian_dot, rate])
