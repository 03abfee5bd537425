"""Forward kinematics, Jacobian, manipulability and their time derivatives of a UR arm.

The expressions are CasADi's. Each is compiled when it is first used; what is not used costs nothing.
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
    """How the Jacobian and the manipulability change while the joints move."""

    jacobian_dot: Array
    """dJ/dt, (6, 6)."""
    manipulability_rate: float
    """d/dt of the manipulability in m^3/s; at a singularity, where that has a kink, of one of its two sides or 0."""


class UrKinematics:
    """Kinematics of one UR arm, for one thread.

    A returned array is the same memory at every call: **the next call of that method overwrites it**. Copy what is to
    be kept. It lies column after column and cannot be written to. Joint angles are best given as float64 arrays; any
    other sequence is converted first.

    Args:
        model: The arm.
        calibration: Deltas of this unit; without them the arm is as its data sheet has it.
        tool: flange_from_tool, (4, 4); without it the tool is the flange.

    Raises:
        ValueError: The deltas are not of such an arm, or the tool is not a rigid transform. From every method: an
            argument is not six finite numbers.
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
        """Its Denavit-Hartenberg rows, with the deltas."""
        self.tool = tool_transform(tool)
        """flange_from_tool, (4, 4)."""

    @cached_property
    def chain(self) -> Chain:
        """The expressions, to build others from."""
        return symbolic_chain(self.rows, self.tool)

    def forward(self, q: Numbers) -> Array:
        """base_from_tool, (4, 4), at the joint angles q in rad, (6,)."""
        function = self._forward
        function.one(q)
        return function.results[0]

    def forward_and_jacobian(self, q: Numbers) -> tuple[Array, Array]:
        """base_from_tool, (4, 4), and the geometric Jacobian, (6, 6), at the joint angles q in rad, (6,).

        `(v, w) = J qd`: velocity of the tool point in m/s over angular velocity in rad/s, both in the base frame.

        Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 3.30.
        """
        function = self._forward_and_jacobian
        function.one(q)
        transform, jacobian = function.results
        return transform, jacobian

    def manipulability(self, q: Numbers) -> float:
        """`sqrt(det(J J')) = |det J|` at the joint angles q in rad, (6,): 0 at a singularity, the same for every tool.

        In m^3: linear and angular velocity are mixed as they stand, so compare values of one arm only.

        Source: T. Yoshikawa, "Manipulability of Robotic Mechanisms", Int. J. Robotics Research 4(2), 1985, Eq. 13.
        """
        function = self._manipulability
        function.one(q)
        value: float = function.numbers[0][0]
        return value

    def rates(self, q: Numbers, qd: Numbers) -> Rates:
        """dJ/dt and d/dt of the manipulability at the joint angles q in rad and speeds qd in rad/s, (6,) each.

        Directional derivatives along qd of the expressions themselves, so exact.
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
        """Of the Jacobian, as an expression."""
        casadi = casadi_module()
        # The determinant is the same for every point of the last link. On the last axis, where the two wrist axes
        # meet, most terms of its expansion are zero.
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
