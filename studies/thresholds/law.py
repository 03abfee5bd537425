"""Laws whose thresholds are compared: a controller, fixed fields, and a swept threshold."""

from msgspec import Struct


class ThresholdLaw(Struct, frozen=True, kw_only=True):
    """A controller whose threshold is swept."""

    name: str
    """Name in the table."""
    controller: str
    source: str
    """Origin: "paper" or "ours"."""
    threshold: str
    """Swept field of `[safety]`."""
    unit: str
    values: tuple[float, ...]
    """Values, most sensitive first."""
    fixed: dict[str, float | str] = {}
    """Other fields of `[safety]`."""
    default: float | None = None
    """Default value: the paper's, or for ours that of a scene; None if not among the values."""


ENERGIES_J = (-0.005, -0.01, -0.02, -0.03, -0.05, -0.08)
FORCES_N = (0.1, 0.3, 0.5, 1.0, 1.5, 2.0, 3.0)
GRASPS = (1.2, 1.5, 2.0, 3.0)
SPEEDS = (0.1, 0.2, 0.3, 0.45, 0.6)

THRESHOLD_LAWS: tuple[ThresholdLaw, ...] = (
    ThresholdLaw(
        name="WSC, w 100", controller="wsc", source="paper", threshold="energy_threshold_j", unit="J",
        values=ENERGIES_J, fixed={"preset": "paper"}, default=-0.03,
    ),
    ThresholdLaw(
        name="WSC, w 25", controller="wsc", source="ours", threshold="energy_threshold_j", unit="J",
        values=ENERGIES_J, fixed={"preset": "paper", "window": 25},
    ),
    ThresholdLaw(
        name="WSC, w 25, F_w 0.1", controller="wsc", source="ours", threshold="energy_threshold_j", unit="J",
        values=ENERGIES_J, fixed={"preset": "paper", "window": 25, "wsc_force_threshold_n": 0.1},
    ),
    ThresholdLaw(
        name="WSC, w 10, F_w 0.1", controller="wsc", source="ours", threshold="energy_threshold_j", unit="J",
        values=ENERGIES_J, fixed={"preset": "paper", "window": 10, "wsc_force_threshold_n": 0.1},
    ),
    ThresholdLaw(
        name="HSC over F_t", controller="hsc", source="paper", threshold="hsc_force_threshold_n", unit="N",
        values=FORCES_N, fixed={"preset": "paper"}, default=0.1,
    ),
    ThresholdLaw(
        name="HSC over zeta", controller="hsc", source="paper", threshold="grasp_threshold", unit="1",
        values=GRASPS, fixed={"preset": "paper", "hsc_force_threshold_n": 1.0}, default=1.5,
    ),
    ThresholdLaw(
        name="HSC, V_s 0.05", controller="hsc", source="ours", threshold="hsc_force_threshold_n", unit="N",
        values=FORCES_N, fixed={"preset": "paper", "hsc_velocity_threshold": 0.05}, default=0.3,
    ),
    ThresholdLaw(
        name="VFC, as printed", controller="vfc", source="paper", threshold="velocity_threshold", unit="m/s",
        values=SPEEDS, fixed={"preset": "paper"}, default=0.6,
    ),
    ThresholdLaw(
        name="VFC, both", controller="vfc", source="paper", threshold="velocity_threshold", unit="m/s",
        values=SPEEDS, fixed={"preset": "paper", "vfc_form": "both"}, default=0.6,
    ),
    ThresholdLaw(
        name="VFC, both, F_t 0.3", controller="vfc", source="ours", threshold="velocity_threshold", unit="m/s",
        values=SPEEDS, fixed={"preset": "paper", "vfc_form": "both", "vfc_force_threshold_n": 0.3},
    ),
)  # fmt: skip
"""Laws compared by default."""
