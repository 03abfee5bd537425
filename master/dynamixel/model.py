"""Model of a leader for the safety layer: m, b and c of `[master]`, from its description."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from haptether.dynamixel.description import ArmDescription, ArmKinematics


@dataclass(frozen=True, slots=True, kw_only=True)
class JointModel:
    """Model of each joint, for kind "joints"."""

    mass_kg: tuple[float, ...]
    """Inertia in kg m^2."""
    viscous: tuple[float, ...]
    """In N m s/rad."""
    coulomb: tuple[float, ...]
    """In N m."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PoseModel:
    """Model at the tool point, for kind "pose"; valid for one posture."""

    mass_kg: tuple[float, float, float]
    """Mass along x, y, z of the base."""
    inertia_kg_m2: tuple[float, float, float]
    """Inertia about x, y, z."""


def joint_model(
    arm: ArmDescription, q: Sequence[float] | None = None, *, inertia: Sequence[float] | None = None,
    friction_gain: float = 0.0,
) -> JointModel:  # fmt: skip
    """Return inertia and friction of the joints at a posture, with compensated friction removed.

    Args:
        arm: Description of the arm.
        q: Posture; by default the start posture.
        inertia: Inertia of each joint's motors and gears at the output in kg m^2; by default from the description.
        friction_gain: Compensated fraction of the friction.

    Raises:
        ValueError: The description lacks a value, which must be identified.
    """
    own = arm.motor_inertia(inertia)
    if not arm.knows_friction:
        message = f"{arm.name}: its friction is not known: identify it, and write it to the description"
        raise ValueError(message)
    carried = ArmKinematics(arm).link_inertia(_posture(arm, q))
    left = 1.0 - friction_gain
    return JointModel(
        mass_kg=tuple(one + link for one, link in zip(own, carried, strict=True)),
        viscous=tuple(left * (joint.viscous_nm_s or 0.0) for joint in arm.joints),
        coulomb=tuple(left * (joint.coulomb_nm or 0.0) for joint in arm.joints),
    )


def pose_model(
    arm: ArmDescription, q: Sequence[float] | None = None, *, inertia: Sequence[float] | None = None
) -> PoseModel:
    """Return the effective mass and inertia at the tool point along each direction: 1 / diag(J M^-1 J^T).

    M is diagonal, as in `ArmKinematics.link_inertia`.

    Source: O. Khatib, IEEE J. Robotics and Automation 3(1), 1987, section IV: effective mass.

    Raises:
        ValueError: Same as for `joint_model`, for inertia only.
    """
    own = arm.motor_inertia(inertia)
    posture = _posture(arm, q)
    kinematics = ArmKinematics(arm)
    joints = np.array(own) + kinematics.link_inertia(posture)
    jacobian = kinematics.jacobian(posture)
    mobility = np.diag(jacobian @ np.diag(1.0 / joints) @ jacobian.T)
    # A direction that no joint moves counts as heavy as the heaviest other one.
    lightest = np.maximum(mobility, 1e-3 * mobility.max())
    x, y, z, rx, ry, rz = (1.0 / lightest).tolist()
    return PoseModel(mass_kg=(x, y, z), inertia_kg_m2=(rx, ry, rz))


def _posture(arm: ArmDescription, q: Sequence[float] | None) -> list[float]:
    return [joint.start_rad for joint in arm.joints] if q is None else list(q)
