"""Conditions that the paper leaves open: factors, their ranges, and the runs that vary them."""

from collections.abc import Callable, Iterator
from itertools import product
from typing import Literal

import msgspec

from haptether.safety import EstimatorKind
from haptether.studies.operator import Operator
from haptether.studies.paper.report import Change

DESKTOP_QUANTUM = 2.3e-5
"""Nominal resolution of a PHANTOM Desktop in m."""

Clock = Literal["begin", "motion", "end"]
"""Moment of the release: the hand begins to release, the stylus begins to move, or the hand has gone."""

CLOCKS: tuple[Clock, ...] = ("begin", "motion", "end")

ESTIMATORS: dict[str, Callable[[float], EstimatorKind]] = {
    "kalman": lambda quantum: EstimatorKind.kalman(jerk_density=10.0, quantum_m=quantum),
    "dual-kalman": lambda quantum: EstimatorKind.dual_kalman(
        velocity_jerk_density=1000.0, jerk_density=10.0, quantum_m=quantum
    ),
    "savitzky-golay": lambda _: EstimatorKind.savitzky_golay(degree=2, window=15),
    "low-pass": lambda _: EstimatorKind.low_pass(cutoff_hz=30.0),
    "adaptive-window": lambda quantum: EstimatorKind.adaptive_window(noise_bound_m=quantum),
    "backward-difference": lambda _: EstimatorKind.backward_difference(),
}
"""Estimators for an encoder quantum in m, as compared in docs/ejection_bound.md; defaults are never changed."""


class Conditions(msgspec.Struct, frozen=True, kw_only=True):
    """Open conditions of an experiment; the defaults are the declared ones."""

    operator: Operator = Operator()
    encoder_quantum: float = 0.0
    """Resolution in m; 0 measures position and velocity exactly, without an estimator."""
    estimator: str = "kalman"
    """Key of `ESTIMATORS`."""
    coulomb: float = 0.038
    """c in N, of the device and of the controller's model."""
    mass_kg: float = 0.157
    """m in kg, of both."""
    device_delay: int = 0
    """Delay of the device's force in ticks, unknown to the controllers."""
    hsc_force_threshold_n: float = 0.1
    """F_t of HSC in N (Eq. 14)."""
    mev_within_s: float = 0.5
    """Time in s after the release in which the MEV of a press is searched; a second throw may be later."""
    clock: Clock = "begin"
    """Moment of the release for times after it."""


class Factor(msgspec.Struct, frozen=True, kw_only=True):
    """One open condition: its range, and its effect on the conditions."""

    name: str
    title: str
    values: tuple[float | str, ...]
    apply: Callable[[Conditions, float | str], Conditions]
    unit: str = ""
    scale: float = 1.0
    """Factor from the SI unit to the printed unit."""
    only: tuple[str, ...] = ()
    """Sources of the rows that it may explain; empty for all."""

    def text(self, value: float | str) -> str:
        """Value in words."""
        if isinstance(value, str):
            return f"{self.title} {value}"
        return f"{self.title} {value * self.scale:g}{' ' if self.unit else ''}{self.unit}"


def _operator(field: str) -> Callable[[Conditions, float | str], Conditions]:
    def apply(conditions: Conditions, value: float | str) -> Conditions:
        operator = msgspec.structs.replace(conditions.operator, **{field: value})
        return msgspec.structs.replace(conditions, operator=operator)

    return apply


def _condition(field: str) -> Callable[[Conditions, float | str], Conditions]:
    return lambda conditions, value: msgspec.structs.replace(conditions, **{field: value})


def _hand_gain(conditions: Conditions, value: float | str) -> Conditions:
    declared = conditions.operator
    operator = msgspec.structs.replace(
        declared, stiffness=declared.stiffness * float(value), damping=declared.damping * float(value)
    )
    return msgspec.structs.replace(conditions, operator=operator)


def _estimator(conditions: Conditions, value: float | str) -> Conditions:
    if value == "exact":
        return msgspec.structs.replace(conditions, encoder_quantum=0.0)
    return msgspec.structs.replace(conditions, encoder_quantum=DESKTOP_QUANTUM, estimator=str(value))


FACTORS: dict[str, Factor] = {
    factor.name: factor
    for factor in (
        Factor(
            name="release_s", title="release time", unit="ms", scale=1e3, apply=_operator("release_s"),
            values=tuple(ms * 1e-3 for ms in range(0, 101, 5)),
        ),
        Factor(
            name="release_kind", title="release of the", values=("strength", "gain"), apply=_operator("release_kind")
        ),
        Factor(name="grip_margin", title="grip margin", values=(1.1, 1.25, 1.5, 2.0), apply=_operator("grip_margin")),
        Factor(name="hand_gain", title="hand gain times", values=(0.5, 1.0, 2.0), apply=_hand_gain),
        Factor(name="hold_s", title="hold", unit="s", values=(0.1, 0.25, 0.5, 1.0, 2.0), apply=_operator("hold_s")),
        Factor(
            name="first_s", title="first part of the press in", unit="s", values=(0.5, 0.75, 1.0, 1.5),
            apply=_operator("first_s"),
        ),
        Factor(name="estimator", title="estimator", values=("exact", *ESTIMATORS), apply=_estimator),
        Factor(name="coulomb", title="friction", unit="N", values=(0.0, 0.038, 0.06), apply=_condition("coulomb")),
        Factor(
            name="device_delay", title="force late by", unit="ms", values=(0, 1, 2, 3),
            apply=lambda conditions, value: msgspec.structs.replace(conditions, device_delay=int(value)),
        ),
        Factor(
            name="hsc_force_threshold_n", title="F_t of HSC", unit="N", values=(0.05, 0.1, 0.2, 0.3),
            apply=_condition("hsc_force_threshold_n"),
        ),
        Factor(
            name="mev_within_s", title="MEV within", unit="ms", scale=1e3, values=(0.12, 0.2, 0.5),
            apply=_condition("mev_within_s"),
        ),
        Factor(name="clock", title="clock from", values=CLOCKS, apply=_condition("clock")),
        Factor(
            name="mass_kg", title="mass", unit="kg", values=(0.045, 0.055, 0.065, 0.08, 0.157), only=("Fig. 12",),
            apply=_condition("mass_kg"),
        ),
    )
}  # fmt: skip
"""Factors by name.

- Release time, kind, grip margin, gain of the hand, hold: the paper says that a hand lets go "suddenly" and once "e.g.
  50 ms". A gain of the hand scales its stiffness and its damping.
- Estimator, and delay of the force: neither is in the paper. Up to 3 ticks is our choice.
- Friction: the paper's c is another paper's; 0.06 N is the vendor's bound on the backdrive friction.
- F_t of HSC: the paper has "e.g. < 0.1 N". Time of the search for an MEV: the paper's curves end somewhere.
- Mass: 0.157 kg was fitted to Fig. 5 and so does not explain it. The paper's section 5 also has the vendor's 0.045 kg.
  The mass may therefore explain only Fig. 12, where no wall pushes.
"""

RELEASES: tuple[Change, ...] = (
    {"release_kind": "gain"},
    {"grip_margin": 1.25},
    {"grip_margin": 1.5},
    {"grip_margin": 2.0},
)
"""Kinds of release in the grid; the grip margin does not affect a release of the gain."""

GRID: tuple[Change, ...] = (
    *(
        {**release, "release_s": ms * 1e-3, "estimator": estimator}
        for release, ms, estimator in product(RELEASES, (10, 30, 50, 70, 85, 100), ("exact", "kalman"))
    ),
    {"device_delay": 1, "mev_within_s": 0.12},
    {"device_delay": 2, "mev_within_s": 0.12},
    {"device_delay": 3, "mev_within_s": 0.12},
)
"""Runs with several factors: those of the release, and those that make a first throw larger than a second."""


READINGS = ("mev_within_s", "clock")
"""Factors that change the reading of a run, not the run."""


def single_changes() -> Iterator[Change]:
    """Yield changes of one factor at a time."""
    for factor in FACTORS.values():
        for value in factor.values:
            yield {factor.name: value}


def design() -> list[Change]:
    """All runs of the sensitivity, before readings."""
    return [*single_changes(), *GRID]


def changed(conditions: Conditions, change: Change) -> Conditions:
    """Conditions with a change applied."""
    for name, value in change.items():
        conditions = FACTORS[name].apply(conditions, value)
    return conditions


def change_text(change: Change) -> str:
    """Change in words."""
    return ", ".join(FACTORS[name].text(value) for name, value in change.items()) or "as declared"


MET_BY: dict[str, Change] = {
    "Fig. 6": {"release_kind": "gain", "release_s": 0.07},
    "Fig. 8 vfc-both": {"release_s": 0.085, "estimator": "kalman"},
    "Fig. 9": {"grip_margin": 2.0, "release_s": 0.1, "estimator": "kalman"},
    "Fig. 10": {"mev_within_s": 0.12},
    "Fig. 11 hsc": {"release_s": 0.1, "estimator": "kalman"},
    "Fig. 11 wsc": {"grip_margin": 1.25, "release_s": 0.07, "mev_within_s": 0.12},
    "Table 1": {"device_delay": 1, "mev_within_s": 0.12},
    "Fig. 12": {"mass_kg": 0.055},
}
"""Runs of the design that meet all numbers of an experiment at once, where the declared run does not. The rows' notes
cite them, and a test verifies them.
"""
