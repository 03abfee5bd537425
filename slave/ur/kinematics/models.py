"""UR arm models: geometry, limits and flange sensor.

Denavit-Hartenberg parameters in the vendor's convention, `T_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)`, in the frame
that the controller calls base (ROS's `base_link` is that frame rotated by pi about z).

Source: Universal Robots, "DH Parameters for calculations of kinematics and dynamics" (geometry, link masses), "Max.
joint torques", and the vendor's ROS description, `config/<model>/joint_limits.yaml` (speeds, torques); data sheets
(sensor).
"""

import math
from dataclasses import dataclass
from typing import Final

Six = tuple[float, float, float, float, float, float]
"""One value per joint, from base to flange."""


@dataclass(frozen=True, slots=True, kw_only=True)
class WrenchSensor:
    """Force (N) and torque (N m) measurement at the tool; None if the vendor states no value."""

    force_range_n: float | None
    force_precision_n: float | None
    force_accuracy_n: float
    torque_range_nm: float | None
    torque_precision_nm: float | None
    torque_accuracy_nm: float
    measured: bool
    """True if measured by a flange sensor, False if estimated from motor currents."""


@dataclass(frozen=True, slots=True, kw_only=True)
class UrModel:
    """Arm by its data sheet; `UrCalibration` holds the deltas of one unit."""

    name: str
    a: Six
    """Link lengths in m."""
    d: Six
    """Link offsets in m."""
    alpha: Six
    """Link twists in rad."""
    position_min: Six
    """Smallest joint angles in rad, -inf for an unlimited joint."""
    position_max: Six
    """Largest joint angles in rad."""
    max_speed: Six
    """rad/s."""
    max_torque: Six
    """N m."""
    link_masses_kg: Six
    wrench: WrenchSensor
    source: str


ALPHA: Final[Six] = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)

GEOMETRY: Final[dict[str, tuple[float, float, float, float, float, float]]] = {
    # d1, a2, a3, d4, d5, d6 in m
    "ur3": (0.1519, -0.24365, -0.21325, 0.11235, 0.08535, 0.0819),
    "ur5": (0.089159, -0.425, -0.39225, 0.10915, 0.09465, 0.0823),
    "ur10": (0.1273, -0.612, -0.5723, 0.163941, 0.1157, 0.0922),
    "ur3e": (0.15185, -0.24355, -0.2132, 0.13105, 0.08535, 0.0921),
    "ur5e": (0.1625, -0.425, -0.3922, 0.1333, 0.0997, 0.0996),
    "ur10e": (0.1807, -0.6127, -0.57155, 0.17415, 0.11985, 0.11655),
    "ur16e": (0.1807, -0.4784, -0.36, 0.17415, 0.11985, 0.11655),
    "ur20": (0.2363, -0.8620, -0.7287, 0.2010, 0.1593, 0.1543),
    "ur30": (0.2363, -0.6370, -0.5037, 0.2010, 0.1593, 0.1543),
}

MASSES_KG: Final[dict[str, Six]] = {
    "ur3": (2.0, 3.42, 1.26, 0.8, 0.8, 0.35),
    "ur5": (3.7, 8.393, 2.33, 1.219, 1.219, 0.1879),
    "ur10": (7.1, 12.7, 4.27, 2.0, 2.0, 0.365),
    "ur3e": (1.98, 3.4445, 1.437, 0.871, 0.805, 0.261),
    "ur5e": (3.761, 8.058, 2.846, 1.37, 1.3, 0.365),
    "ur10e": (7.369, 13.051, 3.989, 2.1, 1.98, 0.615),
    "ur16e": (7.369, 10.45, 4.321, 2.18, 2.033, 0.907),
    # An older sheet gives 0.846 kg for the last link of the UR20.
    "ur20": (16.343, 29.632, 7.879, 3.054, 3.126, 0.926),
    "ur30": (16.343, 28.542, 7.156, 3.054, 3.126, 0.926),
}

SPEEDS_DEG_S: Final[dict[str, Six]] = {
    "ur3": (180, 180, 180, 360, 360, 360),
    "ur5": (180, 180, 180, 180, 180, 180),
    "ur10": (120, 120, 180, 180, 180, 180),
    "ur3e": (180, 180, 180, 360, 360, 360),
    "ur5e": (180, 180, 180, 180, 180, 180),
    "ur10e": (120, 120, 180, 180, 180, 180),
    "ur16e": (120, 120, 180, 180, 180, 180),
    "ur20": (120, 120, 150, 210, 210, 210),
    "ur30": (120, 120, 150, 210, 210, 210),
}

TORQUES_NM: Final[dict[str, Six]] = {
    "ur3": (56, 56, 28, 12, 12, 12),
    "ur5": (150, 150, 150, 28, 28, 28),
    "ur10": (330, 330, 150, 56, 56, 56),
    "ur3e": (54, 54, 28, 9, 9, 9),
    "ur5e": (150, 150, 150, 28, 28, 28),
    "ur10e": (330, 330, 150, 54, 54, 54),
    "ur16e": (330, 330, 150, 54, 54, 54),
    "ur20": (738, 738, 433, 107, 107, 107),
    "ur30": (738, 738, 433, 107, 107, 107),
}


def _sensor(
    force: tuple[float | None, float | None, float],
    torque: tuple[float | None, float | None, float],
    *,
    measured: bool = True,
) -> WrenchSensor:
    """Return a sensor from range, precision and accuracy."""
    return WrenchSensor(
        force_range_n=force[0],
        force_precision_n=force[1],
        force_accuracy_n=force[2],
        torque_range_nm=torque[0],
        torque_precision_nm=torque[1],
        torque_accuracy_nm=torque[2],
        measured=measured,
    )


# Estimated from motor currents: the vendor's forum states an accuracy, but no range or precision.
ESTIMATED: Final = _sensor((None, None, 10.0), (None, None, 5.0), measured=False)

SENSORS: Final[dict[str, WrenchSensor]] = {
    "ur3": ESTIMATED,
    "ur5": ESTIMATED,
    "ur10": ESTIMATED,
    "ur3e": _sensor((30, 2.0, 3.5), (10, 0.1, 0.1)),
    "ur5e": _sensor((50, 3.5, 4.0), (10, 0.2, 0.3)),
    "ur10e": _sensor((100, 5.0, 5.5), (10, 0.2, 0.5)),
    "ur16e": _sensor((160, 5.0, 5.5), (10, 0.2, 0.5)),
    "ur20": _sensor((200, 5.0, 10.0), (20, 0.2, 0.5)),
    "ur30": _sensor((200, 5.0, 10.0), (20, 0.2, 0.5)),
}

# Higher payload on the arm of another model. The vendor's ROS description has equal masses for both of a pair, and for
# the UR12e equal joint speeds and torques; ur-analytic-ik 0.1.0 has equal geometry. Equal speeds and torques of the
# UR7e, and equal sensors of both, are inferred, not from a data sheet.
SAME_ARM: Final = {"ur7e": "ur5e", "ur12e": "ur10e"}

ENDLESS_WRIST: Final = frozenset({"ur3", "ur3e"})

VENDOR: Final = "Universal Robots, DH parameters for calculations of kinematics and dynamics; ROS description"


def _model(name: str) -> UrModel:
    arm = SAME_ARM.get(name, name)
    d1, a2, a3, d4, d5, d6 = GEOMETRY[arm]
    last = math.inf if arm in ENDLESS_WRIST else math.tau
    v1, v2, v3, v4, v5, v6 = (math.radians(speed) for speed in SPEEDS_DEG_S[arm])
    return UrModel(
        name=name,
        a=(0.0, a2, a3, 0.0, 0.0, 0.0),
        d=(d1, 0.0, 0.0, d4, d5, d6),
        alpha=ALPHA,
        # ROS's narrower elbow range is a planner convention; the controller allows a full turn.
        position_min=(-math.tau, -math.tau, -math.tau, -math.tau, -math.tau, -last),
        position_max=(math.tau, math.tau, math.tau, math.tau, math.tau, last),
        max_speed=(v1, v2, v3, v4, v5, v6),
        max_torque=TORQUES_NM[arm],
        link_masses_kg=MASSES_KG[arm],
        wrench=SENSORS[arm],
        source=VENDOR if arm == name else f"{VENDOR}; the arm of the {arm}",
    )


UR_MODELS: Final[dict[str, UrModel]] = {
    name: _model(name)
    for name in ("ur3", "ur5", "ur10", "ur3e", "ur5e", "ur7e", "ur10e", "ur12e", "ur16e", "ur20", "ur30")
}
"""Arms by name."""


MAX_PAYLOAD_KG: Final = {
    "ur3": 3.0, "ur5": 5.0, "ur10": 10.0, "ur3e": 3.0, "ur5e": 5.0, "ur7e": 7.5, "ur10e": 12.5, "ur12e": 12.5,
    "ur16e": 16.0, "ur20": 25.0, "ur30": 35.0,
}  # fmt: skip
"""Largest payload of each arm from data sheets; for UR20 and UR30 near the flange only."""


def ur_model(name: str) -> UrModel:
    """Return an arm by its case-insensitive name.

    Raises:
        ValueError: The arm does not exist.
    """
    found = UR_MODELS.get(name.lower())
    if found is None:
        message = f"model = {name!r}: must be one of {', '.join(UR_MODELS)}"
        raise ValueError(message)
    return found
