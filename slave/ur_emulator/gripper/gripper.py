"""Gripper of an emulated arm: its registers, its jaws and the object between them; a state machine without a clock.

Source: Robotiq, 2F-85 and 2F-140 instruction manual, for registers and faults. The manual does not publish some facts.
Assumptions: speed and force are linear in their counts; the time to detect a contact; the speed of an activation.
"""

import math
from dataclasses import dataclass
from typing import Final

from haptether.slave.robotiq.models import MAX_COUNT, RobotiqModel, Scale

RESET, ACTIVATING, ACTIVE = 0, 1, 3
"""Values of STA."""
MOVING, CONTACT_OPENING, CONTACT_CLOSING, ARRIVED = range(4)
"""Values of OBJ."""
RELEASING, RELEASED = 11, 15
"""FLT during and after an automatic release."""
FAULTS: Final = frozenset({0, 5, *range(7, 16)})
UNPOWERED: Final = frozenset({7, 10})
"""Faults that reset the gripper."""
CONTACT_S: Final = 0.03
"""Time that the jaws press on an object before OBJ shows it."""
ACTIVATION_S: Final = 1.0
"""Time in s for each direction of the stroke: closed, then open."""
RELEASE_M_S: Final = 0.02
WRITABLE: Final = {
    "ACT": 1, "GTO": 1, "ATR": 1, "ADR": 1, "ARD": 1, "FOR": MAX_COUNT, "SPE": MAX_COUNT, "POS": MAX_COUNT,
    "SID": MAX_COUNT,
}  # fmt: skip
"""Registers that clients write, and the largest value of each."""
START: Final = {"ACT": 0, "GTO": 0, "ATR": 0, "ADR": 1, "ARD": 0, "FOR": 0, "SPE": 0, "POS": 0, "SID": 9}


@dataclass(frozen=True, slots=True, kw_only=True)
class GrippedObject:
    """Object between the jaws or around them.

    Raises:
        ValueError: No width, or no stiffness.
    """

    width_m: float
    """Width between the jaws at first contact."""
    inside: bool = False
    """True if the jaws meet the object from inside, as they open."""
    stiffness_n_per_m: float = math.inf

    def __post_init__(self) -> None:
        if not (math.isfinite(self.width_m) and self.width_m >= 0.0):
            message = f"width {self.width_m:g} m: must be finite and 0 or more"
            raise ValueError(message)
        if not self.stiffness_n_per_m > 0.0:
            message = f"stiffness {self.stiffness_n_per_m:g} N/m: must be positive"
            raise ValueError(message)


@dataclass(frozen=True, slots=True, kw_only=True)
class GripperSettings:
    """Gripper, object between its jaws, and initial state.

    Raises:
        ValueError: The object is wider than the stroke.
    """

    model: RobotiqModel
    grips: GrippedObject | None = None
    active: bool = False
    """True if the gripper starts activated, with open jaws."""

    def __post_init__(self) -> None:
        check_fits(self.grips, self.model)


def check_fits(grips: GrippedObject | None, model: RobotiqModel) -> None:
    """Check that an object fits between the jaws.

    Raises:
        ValueError: The object is wider than the stroke.
    """
    if grips is not None and grips.width_m > model.stroke_m:
        message = (
            f"{1e3 * grips.width_m:g} mm: must be 0 to {1e3 * model.stroke_m:g} mm: a {model.name} opens no further"
        )
        raise ValueError(message)


class EmulatedGripper:
    """Registers of the URCap server; `advance` moves the jaws until a time.

    Args:
        settings: The gripper.
    """

    def __init__(self, settings: GripperSettings) -> None:
        self.settings = settings
        self.silent = False
        """True if the server answers nothing, on command."""
        self._scale = Scale(settings.model, settings.model.counts)
        self._now_s = 0.0
        self.reset()

    def reset(self) -> None:
        """Restore the initial state except for the time."""
        opened, _ = self._scale.counts
        self.grips = self.settings.grips
        self.silent = False
        self._registers = dict(START)
        self._state = RESET
        self._fault = 0
        self._object = ARRIVED
        self._counts = float(opened)
        self._pressed_s = 0.0
        self._touching = False
        self._activation_closes = False
        if self.settings.active:
            self._registers["ACT"] = 1
            self._state = ACTIVE

    # ---------------------------------------------------------------------------------------------------- values

    def read(self, variable: str) -> int | None:
        """Return a register; None if it does not exist."""
        shown = {
            "POS": round(self._counts),
            # Also without GTO: clients wait for PRE before they set GTO.
            "PRE": self._registers["POS"],
            "STA": self._state,
            "OBJ": self._object,
            "FLT": self._fault,
        }
        return shown.get(variable, self._registers.get(variable))

    def write(self, values: dict[str, int]) -> None:
        """Set registers in their order, each within its range."""
        for variable, value in values.items():
            before, self._registers[variable] = self._registers[variable], value
            match variable, before, value:
                case "ACT", 0, 1:
                    self._fault = 0
                    self._state, self._activation_closes = ACTIVATING, True
                case "ACT", _, 0:
                    self._state = RESET
                case "POS", _, _:
                    self._begin()
                case "GTO", 0, 1:
                    self._begin()
                case "ATR", 0, 1 if self._state == ACTIVE and self._fault == 0:
                    self._fault = RELEASING
                case "ADR", _, _:
                    self._registers["ARD"] = 1 - value
                case "ARD", _, _:
                    self._registers["ADR"] = 1 - value
                case _:
                    pass

    def fail(self, fault: int) -> None:
        """Cause a fault, a value of FLT, on command; 0 ends it.

        Raises:
            ValueError: The gripper has no such fault.
        """
        if fault not in FAULTS:
            message = f"{fault}: must be one of {' '.join(map(str, sorted(FAULTS)))}"
            raise ValueError(message)
        self._fault = fault
        if fault in UNPOWERED:
            self._state, self._registers["ACT"] = RESET, 0

    def put(self, grips: GrippedObject | None) -> None:
        """Replace the object (None for no object); the jaws do not meet one that is wider than their present opening.

        Raises:
            ValueError: The object is wider than the stroke.
        """
        check_fits(grips, self.settings.model)
        self.grips = grips
        self._touching = False

    def figures(self) -> dict[str, object]:
        """State for `status`."""
        return {
            "model": self.settings.model.name,
            "registers": {variable: self.read(variable) for variable in (*START, "PRE", "STA", "OBJ", "FLT")},
            "width_m": (1.0 - self._scale.position(round(self._counts))) * self.settings.model.stroke_m,
            "object_m": None if self.grips is None else self.grips.width_m,
            "force_n": self._force_n if self._touching else 0.0,
        }

    # ---------------------------------------------------------------------------------------------------- motion

    def advance(self, now_s: float) -> None:
        """Move the jaws until a time in s."""
        step_s, self._now_s = now_s - self._now_s, now_s
        opened, closed = self._scale.counts
        if self._state == ACTIVATING:
            self._advance_activation(step_s)
        elif self._state == ACTIVE and self._fault == RELEASING:
            target = opened if self._registers["ADR"] else closed
            if self._moved(target, self._counts_per_s(RELEASE_M_S), step_s) != MOVING:
                self._fault = RELEASED
        elif self._state == ACTIVE and self._fault == 0 and self._registers["GTO"]:
            low, high = self.settings.model.speed_m_s
            speed_m_s = low + (high - low) * self._registers["SPE"] / MAX_COUNT
            target = min(max(self._registers["POS"], opened), closed)
            self._object = self._moved(target, self._counts_per_s(speed_m_s), step_s)

    def _advance_activation(self, step_s: float) -> None:
        opened, closed = self._scale.counts
        target = closed if self._activation_closes else opened
        if self._moved(target, (closed - opened) / ACTIVATION_S, step_s) == MOVING:
            return
        if self._activation_closes:
            self._activation_closes = False
        else:
            self._state, self._object = ACTIVE, ARRIVED

    def _begin(self) -> None:
        self._object = MOVING
        self._pressed_s = 0.0

    def _moved(self, target: float, counts_per_s: float, step_s: float) -> int:
        """Move the jaws towards a target for a time; return the resulting OBJ."""
        closes = target > self._counts
        stop = self._stop(closes=closes)
        blocked = stop is not None and (stop < target if closes else stop > target)
        aim = stop if blocked and stop is not None else target
        way = aim - self._counts
        reach = counts_per_s * step_s
        if abs(way) > reach:
            self._counts += math.copysign(reach, way)
            self._pressed_s, self._touching = 0.0, False
            return MOVING
        self._counts = aim
        self._touching = blocked
        if not blocked:
            return ARRIVED
        self._pressed_s += step_s
        if self._pressed_s < CONTACT_S:
            return MOVING
        return CONTACT_CLOSING if closes else CONTACT_OPENING

    def _stop(self, *, closes: bool) -> float | None:
        """Return the count at which the object stops the jaws; None if they do not meet it."""
        grips = self.grips
        if grips is None or grips.inside is closes:
            return None
        met = self._count_at(grips.width_m)
        yields = self._counts_per_s(self._force_n / grips.stiffness_n_per_m)
        stop = met + yields if closes else met - yields
        beyond = self._counts > stop if closes else self._counts < stop
        if not beyond:
            return stop
        # With less force than before, the object stays compressed.
        return self._counts if self._touching else None

    @property
    def _force_n(self) -> float:
        return self._scale.force_n(self._registers["FOR"])

    def _count_at(self, width_m: float) -> float:
        opened, closed = self._scale.counts
        return closed - (closed - opened) * width_m / self.settings.model.stroke_m

    def _counts_per_s(self, m_per_s: float) -> float:
        opened, closed = self._scale.counts
        return m_per_s * (closed - opened) / self.settings.model.stroke_m
