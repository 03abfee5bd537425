"""References for the bench of UR kinematics: the chain in extended precision, and minima with verified conditions."""

import numpy as np
import numpy.typing as npt

from haptether.slave import QuadraticProgram
from haptether.slave.ur.kinematics.chain import DhRows, cos_sin

Array = npt.NDArray[np.float64]
Extended = npt.NDArray[np.longdouble]

TIGHT = 1e-12
ABSENT = 1e30


def extended_chain(rows: DhRows, q: Array) -> tuple[Extended, Extended]:
    """Return base_from_flange (n, 4, 4) and geometric Jacobian (n, 6, 6) of n postures in 80 bits, joint by joint."""
    count = len(q)
    base_from_link = np.broadcast_to(np.eye(4, dtype=np.longdouble), (count, 4, 4)).copy()
    axes, origins = [], []
    for joint in range(6):
        angle = q[:, joint].astype(np.longdouble) + np.longdouble(rows.theta[joint])
        c, s = np.cos(angle), np.sin(angle)
        twist = np.longdouble(rows.alpha[joint])
        exact = set(cos_sin(rows.alpha[joint])) <= {-1.0, 0.0, 1.0}
        ca, sa = cos_sin(rows.alpha[joint]) if exact else (np.cos(twist), np.sin(twist))
        step = np.zeros((count, 4, 4), dtype=np.longdouble)
        step[:, 0] = np.stack((c, -s * ca, s * sa, np.longdouble(rows.a[joint]) * c), axis=-1)
        step[:, 1] = np.stack((s, c * ca, -c * sa, np.longdouble(rows.a[joint]) * s), axis=-1)
        step[:, 2, 1:] = (sa, ca, np.longdouble(rows.d[joint]))
        step[:, 3, 3] = 1
        axes.append(base_from_link[:, :3, 2])
        origins.append(base_from_link[:, :3, 3])
        base_from_link = np.einsum("nij,njk->nik", base_from_link, step)
    place = base_from_link[:, :3, 3]
    columns = [
        np.concatenate((np.cross(axis, place - origin), axis), axis=-1)
        for axis, origin in zip(axes, origins, strict=True)
    ]
    return base_from_link, np.stack(columns, axis=-1)


def apart(one: Extended, other: Extended) -> tuple[Array, Array]:
    """Return the distances of poses (n, 4, 4) in m and rad: `|R1 - R2| = 2 sqrt(2) sin(t/2)` in Frobenius' norm."""
    metres = np.linalg.norm((one[:, :3, 3] - other[:, :3, 3]).astype(np.float64), axis=-1)
    turned = np.linalg.norm((one[:, :3, :3] - other[:, :3, :3]).astype(np.float64), axis=(1, 2))
    return metres, 2 * np.arcsin(np.minimum(turned / np.sqrt(8), 1.0))


def residual(program: QuadraticProgram, x: Array, multipliers: Array) -> float:
    """Return the largest residual of the conditions of Karush, Kuhn and Tucker.

    Source: S. Boyd, L. Vandenberghe, "Convex Optimization", 2004, section 5.5.3.
    """
    constraints = np.vstack((np.eye(6), program.rows))
    values = constraints @ x
    gradient = program.hessian @ x + program.linear + constraints.T @ multipliers
    infeasible = np.maximum(values - program.upper, program.lower - values).clip(min=0)
    slack = np.where(multipliers > 0, program.upper - values, np.where(multipliers < 0, values - program.lower, 0.0))
    return float(max(np.abs(gradient).max(), infeasible.max(), np.abs(multipliers * slack).max()))


def minimum(program: QuadraticProgram, multipliers: Array) -> Array:
    """Return the minimum on the bounds that multipliers name, refined in 80 bits, and proven to be the global minimum.

    A strictly convex program has one point that satisfies the conditions, from any source of the bounds.
    """
    constraints = np.vstack((np.eye(6), program.rows))
    active = np.abs(multipliers) > TIGHT
    bounds = np.where(multipliers > 0, program.upper, program.lower)[active]
    count = int(active.sum())
    system = np.zeros((6 + count, 6 + count))
    system[:6, :6] = program.hessian
    system[:6, 6:] = constraints[active].T
    system[6:, :6] = constraints[active]
    right = np.concatenate((-program.linear, bounds))
    found = np.zeros(6 + count, dtype=np.longdouble)
    for _ in range(4):
        left = right.astype(np.longdouble) - system.astype(np.longdouble) @ found
        found = found + np.linalg.solve(system, left.astype(np.float64))
    x = found[:6].astype(np.float64)
    proven = np.zeros(len(multipliers))
    proven[active] = found[6:].astype(np.float64)
    if residual(program, x, proven) > TIGHT or not (np.sign(proven) == np.sign(multipliers * active)).all():
        message = "the reference is not the minimum"
        raise AssertionError(message)
    return x
