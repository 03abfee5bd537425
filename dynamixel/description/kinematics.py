"""Kinematics of a described arm: tool pose, velocity and gravity torques."""

from collections.abc import Sequence
from importlib import import_module
from typing import Any, TypeAlias

import numpy as np
import numpy.typing as npt

from haptether.dynamixel.description.tables import ArmDescription
from haptether.extras import require

Symbol: TypeAlias = Any
"""A casadi.SX."""
Array: TypeAlias = npt.NDArray[np.float64]
Numbers: TypeAlias = Sequence[float] | Array


class _Function:
    """CasADi function on preallocated memory.

    `Function.buffer()` takes the addresses once, and no matrix is allocated.
    """

    __slots__ = ("_given", "_kept", "_run", "found")

    def __init__(self, name: str, arguments: Sequence[Symbol], results: Sequence[Symbol]) -> None:
        casadi = _casadi()
        function = casadi.Function(name, list(arguments), casadi.cse([casadi.densify(result) for result in results]))
        buffer, self._run = function.buffer()
        given: tuple[Any, ...] = tuple(np.zeros(argument.numel()) for argument in arguments)
        found: tuple[Any, ...] = tuple(np.zeros(result.numel()) for result in results)
        for index, array in enumerate(given):
            buffer.set_arg(index, memoryview(array))
        for index, array in enumerate(found):
            buffer.set_res(index, memoryview(array))
        # CasADi stores the addresses, but does not keep the arrays alive.
        self._kept = (function, buffer, given, found)
        self._given = given
        self.found: tuple[Any, ...] = tuple(memoryview(array) for array in found)

    def __call__(self, *vectors: Numbers) -> None:
        for target, vector in zip(self._given, vectors, strict=True):
            target[:] = vector
        self._run()


class ArmKinematics:
    """Functions of the joint angles q of one arm. Not thread-safe.

    R_i = R_(i-1) Rot(axis_i, q_i), o_i = o_(i-1) + R_(i-1) xyz_i; the quaternion is composed in the same way, which
    makes it continuous in q.

    Args:
        arm: Description of the arm.
    """

    def __init__(self, arm: ArmDescription) -> None:
        casadi = _casadi()
        self.arm = arm
        self.joints = n = len(arm.joints)
        q, dq, wrench = casadi.SX.sym("q", n), casadi.SX.sym("dq", n), casadi.SX.sym("w", 6)
        quat: Symbol = casadi.SX([1.0, 0.0, 0.0, 0.0])
        origin: Symbol = casadi.SX.zeros(3)
        axes, points, energy, inertia = [], [], casadi.SX(0), [casadi.SX(0)] * n
        gravity = casadi.SX(list(arm.gravity_m_s2))
        for index, joint in enumerate(arm.joints):
            rotation = _rotation(casadi, quat)
            origin = origin + casadi.mtimes(rotation, casadi.SX(list(joint.xyz_m)))
            axes.append(casadi.mtimes(rotation, casadi.SX(list(joint.axis))))
            points.append(origin)
            half = 0.5 * q[index]
            turn = casadi.vertcat(casadi.cos(half), casadi.sin(half) * casadi.SX(list(joint.axis)))
            quat = _product(casadi, quat, turn)
            if joint.link is None:
                continue
            com = origin + casadi.mtimes(_rotation(casadi, quat), casadi.SX(list(joint.link.com_m)))
            energy = energy - joint.link.mass_kg * casadi.dot(gravity, com)
            for k in range(index + 1):
                inertia[k] = inertia[k] + joint.link.mass_kg * casadi.sumsqr(casadi.cross(axes[k], com - points[k]))
        tool = origin + casadi.mtimes(_rotation(casadi, quat), casadi.SX(list(arm.tool.xyz_m)))
        quat = _product(casadi, quat, casadi.SX(list(arm.tool.quat_wxyz)))
        columns = [
            casadi.vertcat(casadi.cross(axis, tool - point), axis) for axis, point in zip(axes, points, strict=True)
        ]
        jacobian = casadi.horzcat(*columns)
        weight = casadi.gradient(energy, q)
        self._state = _Function("state", (q, dq), (tool, quat, casadi.mtimes(jacobian, dq)))
        self._weight = _Function("weight", (q,), (weight, casadi.vertcat(*inertia)))
        self._jacobian = _Function("jacobian", (q,), (jacobian, energy))
        self._reflect = _Function("reflect", (q, wrench), (casadi.mtimes(jacobian.T, wrench),))

    def state(self, q: Numbers, dq: Numbers) -> tuple[list[float], list[float], list[float]]:
        """Return tool point in m, orientation w, x, y, z, and twist (linear, angular) in the base frame."""
        self._state(q, dq)
        position, quat, twist = self._state.found
        return position.tolist(), quat.tolist(), twist.tolist()

    def gravity(self, q: Numbers) -> list[float]:
        """Return dV/dq in N m: joint torques that hold the arm; links without a mass weigh nothing.

        Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 7.39.
        """
        self._weight(q)
        weight: list[float] = self._weight.found[0].tolist()
        return weight

    def link_inertia(self, q: Numbers) -> list[float]:
        """Return the diagonal of the mass matrix in kg m^2.

        Links are point masses; motors, gears and own inertia are excluded.
        """
        self._weight(q)
        inertia: list[float] = self._weight.found[1].tolist()
        return inertia

    def torques(self, q: Numbers, wrench: Numbers) -> list[float]:
        """Return J^T w in N m for a wrench (force, torque) at the tool point in the base frame.

        Also valid at singular configurations; bounded by the wrench and the arm's reach.

        Source: ibid., Eq. 3.111.
        """
        self._reflect(q, wrench)
        torques: list[float] = self._reflect.found[0].tolist()
        return torques

    def jacobian(self, q: Numbers) -> Array:
        """Return the geometric Jacobian of the tool point in the base frame, shape (6, n): linear, angular.

        Too slow for loops.
        """
        self._jacobian(q)
        return np.array(self._jacobian.found[0]).reshape((6, self.joints), order="F")

    def energy(self, q: Numbers) -> float:
        """Return the potential energy V in J, 0 with all masses at the base origin."""
        self._jacobian(q)
        return float(self._jacobian.found[1][0])

    def most_gravity(self) -> list[float]:
        """Return an upper bound of each joint's gravity torque in N m at any q: masses times largest distances."""
        arm = self.arm
        strength = float(np.linalg.norm(arm.gravity_m_s2))
        most = []
        for first in range(self.joints):
            torque, reach = 0.0, 0.0
            for index in range(first, self.joints):
                joint = arm.joints[index]
                reach += float(np.linalg.norm(joint.xyz_m)) if index > first else 0.0
                if joint.link is not None:
                    torque += strength * joint.link.mass_kg * (reach + float(np.linalg.norm(joint.link.com_m)))
            most.append(torque)
        return most


def _casadi() -> Any:  # noqa: ANN401  # a module
    require("kinematics of an arm of servos", "casadi", extra="dynamixel")
    return import_module("casadi")


def _rotation(casadi: Any, quat: Symbol) -> Symbol:  # noqa: ANN401  # a module
    w, x, y, z = quat[0], quat[1], quat[2], quat[3]
    return casadi.vertcat(
        casadi.horzcat(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)),
        casadi.horzcat(2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)),
        casadi.horzcat(2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)),
    )


def _product(casadi: Any, one: Symbol, other: Symbol) -> Symbol:  # noqa: ANN401  # a module
    """Return the Hamilton product."""
    w, v, s, u = one[0], one[1:4], other[0], other[1:4]
    return casadi.vertcat(w * s - casadi.dot(v, u), w * u + s * v + casadi.cross(v, u))
