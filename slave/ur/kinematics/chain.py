"""Kinematic chain of a UR arm: Denavit-Hartenberg parameters with deltas of one unit, as numbers and CasADi symbols.

`base_from_tool = T_1(q_1) ... T_6(q_6) flange_from_tool` with `T_i = Rz(q_i + theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`.

`calibration.toml` holds the deltas of one unit from its model. Its four keys are those of the controller's
`calibration.conf`, six numbers each, in m and rad:

    delta_theta = [2.1e-5, 0.97, -1.86, 0.89, 5.7e-5, -7.5e-5]
    delta_a = [3.9e-4, 0.184, 0.145, -6.4e-5, 7.8e-6, 0.0]
    delta_d = [4.0e-5, 278.2, -183.7, -94.5, 3.0e-4, 1.2e-4]
    delta_alpha = [-2.7e-4, 1.3e-3, -3.2e-3, 6.5e-4, -5.9e-4, 0.0]

Axes 2, 3 and 4 are nearly parallel. Their common normals, the reference of `d` and `theta`, are therefore
ill-conditioned and may be hundreds of metres away, compensated by the next row. These rows have wide individual bounds,
and the whole chain has a narrow one.

Source: J. Denavit, R. S. Hartenberg, "A Kinematic Notation for Lower-Pair Mechanisms", J. Applied Mechanics 22, 1955,
in the form of Universal Robots, "DH Parameters for calculations of kinematics and dynamics"; Universal Robots' ROS
driver, `ur_calibration`, "algorithm": for the reason of such rows.
"""

import itertools
import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import msgspec
import numpy as np

from haptether.input_file import read_text
from haptether.slave.ur.kinematics.models import Six, UrModel
from haptether.slave.ur.kinematics.pose import Array
from haptether.slave.ur.kinematics.symbolic import Symbol, casadi_module

MAX_BYTES: Final = 1 << 16
"""Largest calibration file in bytes."""
NOT_ROTATION: Final = 1e-9
"""Allowed deviation of a tool's rotation from orthonormality."""

# Per joint; several times the published calibrations of real arms (446 m, 7.2 rad, 0.63 m, 0.014 rad).
LIMITS: Final[dict[str, Six]] = {
    "delta_theta": (0.1, 12.6, 12.6, 12.6, 0.1, 0.1),
    "delta_a": (0.02, 2.0, 2.0, 0.02, 0.02, 0.02),
    "delta_d": (0.02, 2000.0, 2000.0, 2000.0, 0.02, 0.02),
    "delta_alpha": (0.05, 0.05, 0.05, 0.05, 0.05, 0.05),
}
# Largest deviation of a mounted arm from its model; published ones are millimetres and mrad.
MAX_M: Final = 0.05
MAX_RAD: Final = 0.05
NONE: Final[Six] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class UrCalibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Deltas to the Denavit-Hartenberg parameters of a model, base to flange.

    Raises:
        ValueError: A delta is not finite, or larger than on any arm.
    """

    delta_theta: Six = NONE
    """rad."""
    delta_a: Six = NONE
    """m."""
    delta_d: Six = NONE
    """m."""
    delta_alpha: Six = NONE
    """rad."""

    def __post_init__(self) -> None:
        for key, limits in LIMITS.items():
            deltas: Six = getattr(self, key)
            if len(deltas) != 6:
                message = f"{key} has {len(deltas)} numbers: must have 6"
                raise ValueError(message)
            for joint, (delta, limit) in enumerate(zip(deltas, limits, strict=True), start=1):
                if not (math.isfinite(delta) and abs(delta) <= limit):
                    message = f"{key} of joint {joint} = {delta!r}: must be finite and within +-{limit:g}"
                    raise ValueError(message)

    def check(self, model: UrModel) -> None:
        """Refuse deltas that do not fit this model, in particular those of another model.

        Raises:
            ValueError: The tool would deviate from the model by more than 0.05 m or 0.05 rad.
        """
        metres, radians = deviation(dh_rows(model, self), dh_rows(model))
        if metres > MAX_M or radians > MAX_RAD:
            message = (
                f"deltas move the flange of a {model.name} by {metres:.3g} m and {radians:.3g} rad: "
                f"must be at most {MAX_M:g} m and {MAX_RAD:g} rad"
            )
            raise ValueError(message)


def read_calibration(path: Path | str, model: UrModel) -> UrCalibration:
    """Read the deltas from a `calibration.toml` and check them against a model; an absent key is six zeros.

    Raises:
        ValueError: Not TOML, an unknown key, a wrong length, a number that is not finite or absurdly large, or deltas
            of another model; names file and key.
        OSError: The file cannot be read.
    """
    try:
        table = tomllib.loads(read_text(path, MAX_BYTES))
        if not table:
            message = f"is empty: must have one or more of {', '.join(UrCalibration.__struct_fields__)}"
            raise ValueError(message)
        calibration = msgspec.convert(table, UrCalibration)
        calibration.check(model)
    except ValueError as error:
        # ValidationError of msgspec and TOMLDecodeError of tomllib are ValueErrors.
        message = f"{path}: {error}"
        raise ValueError(message) from None
    return calibration


@dataclass(frozen=True, slots=True)
class DhRows:
    """Denavit-Hartenberg parameters of a unit in m and rad; `theta` is added to the joint angle."""

    theta: Six
    a: Six
    d: Six
    alpha: Six


def dh_rows(model: UrModel, calibration: UrCalibration | None = None) -> DhRows:
    """Return the parameters of the model plus the deltas of the unit."""
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
    """Return the tool as a homogeneous transform, shape (4, 4); by default the flange.

    Raises:
        ValueError: Not a rigid transform within 1e-9.
    """
    if flange_from_tool is None:
        return np.eye(4)
    tool = np.array(flange_from_tool, dtype=np.float64)
    rigid = tool.shape == (4, 4) and bool(np.isfinite(tool).all()) and tool[3].tolist() == [0.0, 0.0, 0.0, 1.0]
    if rigid:
        rotation = tool[:3, :3]
        off = float(np.abs(rotation.T @ rotation - np.eye(3)).max())
        rigid = off <= NOT_ROTATION and float(np.linalg.det(rotation)) > 0
    if not rigid:
        message = f"tool = {tool.tolist()}: must be a (4, 4) rigid transform, last row (0, 0, 0, 1)"
        raise ValueError(message)
    return tool


def cos_sin(angle: float) -> tuple[float, float]:
    """Return cosine and sine, exact at multiples of a right angle, which keeps zero terms out of the chain."""
    quarters = angle / (math.pi / 2)
    if quarters == round(quarters):
        return ((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarters) % 4]
    return math.cos(angle), math.sin(angle)


def chain_transform(rows: DhRows, q: Array | Sequence[float], flange_from_tool: Array | None = None) -> Array:
    """Return base_from_tool, shape (4, 4), in NumPy: for set-up and verification, too slow for loops."""
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
    """Return the largest deviation of two chains in m and rad over 64 postures that bend every joint both ways."""
    metres = radians = 0.0
    for q in itertools.product((-1.1, 0.7), repeat=6):
        one, other = chain_transform(rows, q), chain_transform(others, q)
        metres = max(metres, float(np.linalg.norm(one[:3, 3] - other[:3, 3])))
        # |R1 - R2| (Frobenius) = 2 sqrt(2) sin(t/2), well conditioned for small t.
        apart = float(np.linalg.norm(one[:3, :3] - other[:3, :3])) / math.sqrt(8)
        radians = max(radians, 2 * math.asin(min(apart, 1.0)))
    return metres, radians


@dataclass(frozen=True, slots=True)
class Chain:
    """Chain in CasADi symbols, as functions of `q`."""

    q: Symbol
    """Joint angles, (6, 1)."""
    transform: Symbol
    """base_from_tool, (4, 4)."""
    jacobian: Symbol
    """Geometric Jacobian of the tool point in the base frame: linear over angular velocity, (6, 6)."""
    joint_frames: tuple[tuple[Symbol, Symbol], ...]
    """Rotation (3, 3) and origin (3, 1) of each link frame in the base, after its joint."""


def symbolic_chain(rows: DhRows, flange_from_tool: Array) -> Chain:
    """Return forward kinematics and geometric Jacobian as expressions.

    Column i is `(z x (p - o), z)` with the axis z of joint i and a point o on it. o is the start of link i (`d_i` along
    the axis), so that `p - o` is summed from the tool backwards, without terms that cancel in exact arithmetic.

    Source: B. Siciliano et al., "Robotics: Modelling, Planning and Control", 2009, Eq. 3.30.
    """
    casadi = casadi_module()
    q = casadi.SX.sym("q", 6)
    rotation, origin = casadi.SX.eye(3), casadi.SX.zeros(3)
    axes, steps, frames = [], [], []
    for i in range(6):
        angle = q[i] + rows.theta[i]
        c, s = casadi.cos(angle), casadi.sin(angle)
        ca, sa = cos_sin(rows.alpha[i])
        x, y, z = rotation[:, 0], rotation[:, 1], rotation[:, 2]
        rotated_x, rotated_y = c * x + s * y, c * y - s * x
        axes.append(z)
        steps.append((rows.a[i] * rotated_x, rows.d[i] * z))
        rotation = casadi.horzcat(rotated_x, ca * rotated_y + sa * z, ca * z - sa * rotated_y)
        origin = origin + rows.d[i] * z + rows.a[i] * rotated_x
        frames.append((rotation, origin))

    reach = casadi.mtimes(rotation, casadi.SX(casadi.DM(flange_from_tool[:3, 3])))
    position = origin + reach
    columns = []
    for z, (along_x, along_z) in zip(reversed(axes), reversed(steps), strict=True):
        reach = reach + along_x
        columns.append(casadi.vertcat(casadi.cross(z, reach), z))
        reach = reach + along_z
    base_from_tool = casadi.mtimes(rotation, casadi.SX(casadi.DM(flange_from_tool[:3, :3])))
    last = casadi.SX(casadi.DM([[0.0, 0.0, 0.0, 1.0]]))
    return Chain(
        q=q,
        transform=casadi.densify(casadi.vertcat(casadi.horzcat(base_from_tool, position), last)),
        jacobian=casadi.densify(casadi.horzcat(*reversed(columns))),
        joint_frames=tuple(frames),
    )


def jacobian_determinant(jacobian: Symbol) -> Symbol:
    """Return the determinant of a (6, 6) Jacobian by Laplace expansion along its linear rows, exact at 0.

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
