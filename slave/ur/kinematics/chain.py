"""The chain of a UR arm: its Denavit-Hartenberg rows with the deltas of one unit, in numbers and in CasADi symbols.

`base_from_tool = T_1(q_1) ... T_6(q_6) flange_from_tool` with `T_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`.

Source: J. Denavit, R. S. Hartenberg, "A Kinematic Notation for Lower-Pair Mechanisms", J. Applied Mechanics 22, 1955,
in the form of Universal Robots, "DH Parameters for calculations of kinematics and dynamics".
"""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, TypeAlias

import numpy as np
import numpy.typing as npt

from haptether.slave.ur.kinematics.models import Six, UrModel
from haptether.slave.ur.kinematics.symbolic import Symbol, casadi_module

if TYPE_CHECKING:
    from haptether.slave.ur.kinematics.calibration import UrCalibration

Array: TypeAlias = npt.NDArray[np.float64]

NOT_ROTATION = 1e-9


@dataclass(frozen=True, slots=True)
class DhRows:
    """Denavit-Hartenberg rows of a unit: `theta` is added to the joint angle. m, rad."""

    theta: Six
    a: Six
    d: Six
    alpha: Six


def dh_rows(model: UrModel, calibration: "UrCalibration | None" = None) -> DhRows:
    """The rows of the model with the deltas of the unit added."""
    if calibration is None:
        return DhRows((0.0,) * 6, model.a, model.d, model.alpha)
    return DhRows(
        calibration.delta_theta,
        _sum(model.a, calibration.delta_a),
        _sum(model.d, calibration.delta_d),
        _sum(model.alpha, calibration.delta_alpha),
    )


def _sum(nominal: Six, delta: Six) -> Six:
    n1, n2, n3, n4, n5, n6 = (one + other for one, other in zip(nominal, delta, strict=True))
    return n1, n2, n3, n4, n5, n6


def tool_transform(flange_from_tool: Array | Sequence[Sequence[float]] | None) -> Array:
    """The tool as a homogeneous transform, shape (4, 4); without one it is the flange.

    Raises:
        ValueError: Not a rigid transform within 1e-9.
    """
    if flange_from_tool is None:
        return np.eye(4)
    tool = np.array(flange_from_tool, dtype=np.float64)
    rigid = tool.shape == (4, 4) and bool(np.isfinite(tool).all()) and tool[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    if rigid:
        turn = tool[:3, :3]
        rigid = float(np.abs(turn.T @ turn - np.eye(3)).max()) <= NOT_ROTATION and float(np.linalg.det(turn)) > 0
    if not rigid:
        message = f"tool = {tool.tolist()}: must be a (4, 4) rigid transform, last row (0, 0, 0, 1)"
        raise ValueError(message)
    return tool


def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine, exact at multiples of a right angle, which keeps terms that are zero out of the chain."""
    quarters = angle / (math.pi / 2)
    if quarters == round(quarters):
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(angle), math.sin(angle)


def chain_transform(rows: DhRows, q: Array | Sequence[float], flange_from_tool: Array | None = None) -> Array:
    """The tool in the base, shape (4, 4), in plain NumPy: for set-up and as a second opinion, not for loops."""
    base_from_link = np.eye(4)
    for angle, offset, a, d, alpha in zip(q, rows.theta, rows.a, rows.d, rows.alpha, strict=True):
        (c, s), (ca, sa) = cos_sin(angle + offset), cos_sin(alpha)
        base_from_link = base_from_link @ np.array(
            (
                (c, -s * ca, s * sa, a * c),
                (s, c * ca, -c * sa, a * s),
                (0.0, sa, ca, d),
                (0.0, 0.0, 0.0, 1.0),
            )
        )
    return base_from_link if flange_from_tool is None else base_from_link @ flange_from_tool


def deviation(rows: DhRows, others: DhRows) -> tuple[float, float]:
    """How far two chains come apart, in m and rad, over 64 postures that bend every joint both ways."""
    metres = radians = 0.0
    for q in itertools.product((-1.1, 0.7), repeat=6):
        one, other = chain_transform(rows, q), chain_transform(others, q)
        metres = max(metres, float(np.linalg.norm(one[:3, 3] - other[:3, 3])))
        # |R1 - R2| (Frobenius) = 2 sqrt(2) sin(t/2), well conditioned where t is small.
        apart = float(np.linalg.norm(one[:3, :3] - other[:3, :3])) / math.sqrt(8)
        radians = max(radians, 2 * math.asin(min(apart, 1.0)))
    return metres, radians


@dataclass(frozen=True, slots=True)
class Chain:
    """The chain in CasADi symbols: all are functions of `q`."""

    q: Symbol
    """Joint angles, (6, 1)."""
    transform: Symbol
    """base_from_tool, (4, 4)."""
    jacobian: Symbol
    """Geometric, of the tool point in the base frame: rows are linear over angular velocity, (6, 6)."""
    joint_frames: tuple[tuple[Symbol, Symbol], ...]
    """Rotation (3, 3) and origin (3, 1) of each link's frame in the base, after its joint."""


def symbolic_chain(rows: DhRows, flange_from_tool: Array) -> Chain:
    """Forward kinematics and geometric Jacobian as expressions.

    Column i is `(z x (p - o), z)` with the axis z of joint i and a point o on it. The point is the one that the link
    i reaches from (`d_i` along the axis), so that `p - o` is summed up from the tool backwards and terms that cancel
    in exact arithmetic do not occur.

    Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 3.30.
    """
    casadi = casadi_module()
    q = casadi.SX.sym("q", 6)
    turn, origin = casadi.SX.eye(3), casadi.SX.zeros(3)
    axes, steps, frames = [], [], []
    for i in range(6):
        angle = q[i] + rows.theta[i]
        c, s = casadi.cos(angle), casadi.sin(angle)
        ca, sa = cos_sin(rows.alpha[i])
        x, y, z = turn[:, 0], turn[:, 1], turn[:, 2]
        turned_x, turned_y = c * x + s * y, c * y - s * x
        axes.append(z)
        steps.append((rows.a[i] * turned_x, rows.d[i] * z))
        turn = casadi.horzcat(turned_x, ca * turned_y + sa * z, ca * z - sa * turned_y)
        origin = origin + rows.d[i] * z + rows.a[i] * turned_x
        frames.append((turn, origin))

    reach = casadi.mtimes(turn, casadi.SX(casadi.DM(flange_from_tool[:3, 3])))
    position = origin + reach
    columns = []
    for z, (along_x, along_z) in zip(reversed(axes), reversed(steps), strict=True):
        reach = reach + along_x
        columns.append(casadi.vertcat(casadi.cross(z, reach), z))
        reach = reach + along_z
    rotation = casadi.mtimes(turn, casadi.SX(casadi.DM(flange_from_tool[:3, :3])))
    last = casadi.SX(casadi.DM([[0.0, 0.0, 0.0, 1.0]]))
    return Chain(
        q=q,
        transform=casadi.densify(casadi.vertcat(casadi.horzcat(rotation, position), last)),
        jacobian=casadi.densify(casadi.horzcat(*reversed(columns))),
        joint_frames=tuple(frames),
    )


def jacobian_determinant(jacobian: Symbol) -> Symbol:
    """Determinant of a (6, 6) Jacobian by Laplace's expansion along its linear rows: a polynomial, exact where it is 0.

    `det J = sum over the 20 choices S of 3 columns of sign(S) det(J_linear[S]) det(J_angular[not S])`.

    Source: R. A. Horn, C. R. Johnson, "Matrix Analysis", 2013, section 0.8.9.
    """
    casadi = casadi_module()
    linear, angular = jacobian[:3, :], jacobian[3:, :]
    total = casadi.SX(0)
    for chosen in itertools.combinations(range(6), 3):
        others = [column for column in range(6) if column not in chosen]
        sign = (-1) ** (sum(chosen) - 3)
        total += sign * _triple(linear, chosen) * _triple(angular, others)
    return total


def _triple(block: Symbol, columns: Sequence[int]) -> Symbol:
    casadi = casadi_module()
    first, second, third = (block[:, column] for column in columns)
    return casadi.dot(first, casadi.cross(second, third))
