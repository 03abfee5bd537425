"""Form of samples: fields, shapes, finite numbers, and fields that every sample or no sample must have."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple, SupportsFloat, cast

from haptether.bridge.devices.check.finding import Finding
from haptether.bridge.devices.open import POINT_KINDS
from haptether.master import MasterSample
from haptether.slave import SlaveSample

Side = Literal["master", "slave"]
Kind = Literal["linear", "joints", "pose"]

AXES: dict[str, tuple[int, ...]] = {"linear": (1, 2, 3), "joints": (1, 2, 3, 4, 5, 6, 7), "pose": (3,)}
"""Allowed numbers of axes for each kind of side."""
NORM_ERROR = 1e-9
"""Allowed deviation of a quaternion norm from 1, same as in the tick."""
CHECKS = (
    "fields",
    "shapes",
    "finite numbers",
    "velocity at every sample or none",
    "time_s",
    "orientation",
    "buttons and trigger",
)
"""Names of the form checks."""
FIELDS, SHAPES, FINITE, ALWAYS, TIME, ORIENTATION, BUTTONS = CHECKS


class Reading(NamedTuple):
    """Numbers of a valid sample."""

    position: tuple[float, ...]
    velocity: tuple[float, ...] | None
    force: tuple[float, ...] | None
    orientation: tuple[float, ...] | None
    angular_velocity: tuple[float, ...] | None
    fault: str | None
    time_s: float | None = None


@dataclass
class Problem:
    """Error found in one or more samples."""

    text: str
    """Text for the first invalid sample."""
    first: int
    """Number of the first invalid sample, counted from 1."""
    count: int = 1


@dataclass
class SampleForm:
    """Check each sample against the form that the bridge accepts."""

    side: Side
    kind: Kind
    axes: int | None = None
    """Number of axes of the first sample."""
    samples: int = 0
    problems: dict[str, Problem] = field(default_factory=dict)
    faults: list[str] = field(default_factory=list)
    """Faults that the device reports."""
    trigger: tuple[float, float] | None = None
    """Smallest and largest trigger value."""
    has: dict[str, bool] = field(default_factory=dict)
    """Presence of each optional field in the first sample."""
    last_s: float | None = None
    """Time of the last sample on the device's own clock."""

    def take(self, sample: object) -> Reading | None:
        """Return the numbers of a sample, or None if the bridge would reject it."""
        self.samples += 1
        before = sum(problem.count for problem in self.problems.values())
        kind = MasterSample if self.side == "master" else SlaveSample
        try:
            values = dict(zip(kind._fields, cast("Iterable[object]", sample), strict=True))
        except (TypeError, ValueError):
            has = f"{len(sample)} values" if isinstance(sample, Sequence) else type(sample).__name__
            self._report(FIELDS, f"read() gives {has}: must be a {kind.__name__} ({', '.join(kind._fields)})")
            return None
        position = self._position(values["position"])
        if position is None or self.axes is None:
            return None
        read = self._optional(values, self.axes)
        self._check_norm(read.get("orientation"))
        self._check_buttons(values)
        fault = self._fault(values["fault"])
        time_s = self._time(values["time_s"], is_fault=fault is not None)
        if sum(problem.count for problem in self.problems.values()) > before:
            return None
        return Reading(
            position,
            read.get("velocity"),
            read.get("force"),
            read.get("orientation"),
            read.get("angular_velocity"),
            fault,
            time_s,
        )

    def _time(self, value: object, *, is_fault: bool) -> float | None:
        """Time of a sample; a device that reports a fault may have been restarted."""
        last_s, self.last_s = self.last_s, None
        if is_fault:
            self.has.pop("time_s", None)
            return None
        is_there = value is not None
        if self.has.setdefault("time_s", is_there) != is_there:
            self._report(TIME, "time_s is there at some samples and missing at others: must be at all or none")
        if not is_there:
            return None
        try:
            time_s = _number(value)
        except TypeError:
            time_s = math.nan
        if not math.isfinite(time_s):
            self._report(TIME, f"time_s = {_abridged(value)}: must be a finite number of seconds, or none")
            return None
        if last_s is not None and time_s < last_s:
            self._report(TIME, f"time_s = {time_s:g}: is before the last sample's, {last_s:g}: must not go back")
        self.last_s = time_s
        return time_s

    def _position(self, value: object) -> tuple[float, ...] | None:
        position = self._numbers("position", value, None)
        if position is None:
            return None
        if self.axes is None:
            if len(position) not in AXES[self.kind]:
                allowed = ", ".join(map(str, AXES[self.kind]))
                self._report(SHAPES, f'position has {len(position)} axes: a side of kind "{self.kind}" has {allowed}')
                return None
            self.axes = len(position)
        elif len(position) != self.axes:
            self._report(SHAPES, f"position has {len(position)} axes, that of the first sample {self.axes}")
            return None
        return position

    def _optional(self, values: dict[str, object], axes: int) -> dict[str, tuple[float, ...] | None]:
        """Return the optional fields of a sample and check that each is present in every sample or in none."""
        read: dict[str, tuple[float, ...] | None] = {}
        required = self._required()
        for name in ("velocity", "force", "orientation", "angular_velocity", "torque"):
            if name not in values:
                continue
            value = values[name]
            is_there = value is not None
            count = {"orientation": 4, "angular_velocity": 3, "torque": 3}.get(name, axes)
            read[name] = self._numbers(name, value, count) if is_there else None
            if not is_there and name in required:
                self._report(FIELDS, f'{name} is none: a {self.side} of kind "{self.kind}" has it at every sample')
            if name in {"velocity", "angular_velocity"} and self.has.setdefault(name, is_there) != is_there:
                self._report(ALWAYS, f"{name} is there at some samples and missing at others: must be at all or none")
        return read

    def _fault(self, fault: object) -> str | None:
        if fault is None:
            return None
        if not isinstance(fault, str):
            self._report(FIELDS, f"fault = {_abridged(fault)}: must be text, or none")
            return None
        if not self.faults or self.faults[-1] != fault:
            self.faults.append(fault)
        return fault

    def findings(self) -> list[Finding]:
        """Return one line for each of `CHECKS`."""
        if not self.samples:
            return [Finding(check, "unseen", "there was no sample") for check in CHECKS]
        found = []
        for check in CHECKS:
            problem = self.problems.get(check)
            if problem is None:
                found.append(Finding(check, "pass", f"{self.samples} samples{self._aside(check)}"))
            else:
                of = f"{problem.count} of {self.samples} samples, first in number {problem.first}"
                found.append(Finding(check, "mend", f"{problem.text} ({of})"))
        return found

    def _aside(self, check: str) -> str:
        if check == SHAPES:
            return f", {self.axes} {'axis' if self.axes == 1 else 'axes'}"
        if check == ALWAYS and not self.has.get("velocity"):
            return ", no velocity: it is estimated from the position"
        if check == TIME and not self.has.get("time_s"):
            return ", none: new samples are told by their positions"
        if check == BUTTONS and self.trigger is not None:
            return f", trigger from {self.trigger[0]:.2f} to {self.trigger[1]:.2f}"
        return ""

    def _required(self) -> tuple[str, ...]:
        if self.side == "master":
            return ("orientation",) if self.kind == "pose" else ()
        points = ("velocity", "force")
        return (*points, "orientation", "angular_velocity", "torque") if self.kind == "pose" else points

    def _report(self, check: str, text: str) -> None:
        problem = self.problems.get(check)
        if problem is None:
            self.problems[check] = Problem(text, self.samples)
        elif problem.first == self.samples:
            # Count each sample once.
            return
        else:
            problem.count += 1

    def _numbers(self, name: str, value: object, count: int | None) -> tuple[float, ...] | None:
        """Return the required count of numbers from a field; a scalar is accepted for one axis."""
        allowed = {None: "a number, or one for each axis", 1: "a number"}.get(count, f"a sequence of {count} numbers")
        try:
            numbers = tuple(_number(part) for part in (value if isinstance(value, Iterable) else [value]))
        except TypeError:
            self._report(SHAPES, f"{name} = {_abridged(value)}: must be {allowed}")
            return None
        single = isinstance(value, Iterable) or count in {None, 1}
        if not numbers or not single or (count is not None and len(numbers) != count):
            self._report(SHAPES, f"{name} = {_abridged(value)}: must be {allowed}")
            return None
        if not all(map(math.isfinite, numbers)):
            self._report(FINITE, f"{name} = {_abridged(value)}: must be finite; leave a sample out or report a fault")
            return None
        return numbers

    def _check_norm(self, orientation: tuple[float, ...] | None) -> None:
        if orientation is None:
            return
        norm = math.hypot(*orientation)
        if not abs(norm - 1.0) <= NORM_ERROR:
            self._report(
                ORIENTATION,
                f"its norm is {norm:.12g}: must be 1 to {NORM_ERROR:g}; divide w, x, y, z by the norm",
            )

    def _check_buttons(self, values: dict[str, object]) -> None:
        for name, kinds, allowed in (
            ("clutch", (bool,), "True, False or none"),
            ("buttons", (int,), "a whole number, bit n for button n, or none"),
        ):
            value = values.get(name)
            if value is not None and not isinstance(value, kinds):
                self._report(BUTTONS, f"{name} = {_abridged(value)}: must be {allowed}")
        buttons = values.get("buttons")
        if isinstance(buttons, int) and not 0 <= buttons < 2**32:
            self._report(BUTTONS, f"buttons = {buttons}: must be 0 to 2^32 - 1")
        trigger = values.get("trigger")
        if trigger is not None:
            try:
                number = _number(trigger)
            except TypeError:
                number = math.nan
            if not 0.0 <= number <= 1.0:
                self._report(BUTTONS, f"trigger = {_abridged(trigger)}: must be 0 (open) to 1 (closed), or none")
            else:
                low, high = self.trigger or (number, number)
                self.trigger = min(low, number), max(high, number)


def check_kinds(device: object) -> Finding:
    """Check that the driver's `kinds` are kinds of a scene."""
    kinds: object = getattr(device, "kinds", POINT_KINDS)
    allowed = ", ".join(AXES)
    if isinstance(kinds, str):
        return Finding("kinds", "mend", f'kinds = "{kinds}": a text: must be a tuple, ("{kinds}",)')
    if not isinstance(kinds, Iterable) or not (named := list(kinds)) or not set(named) <= set(AXES):
        return Finding("kinds", "mend", f"kinds = {_abridged(kinds)}: must be a tuple of {allowed}")
    said = "" if hasattr(device, "kinds") else ", by default"
    return Finding("kinds", "pass", f"{', '.join(named)}{said}")


def _number(value: object) -> float:
    if isinstance(value, str | bytes | bool) or value is None:
        raise TypeError
    return float(cast("SupportsFloat", value))


def _abridged(value: object) -> str:
    text = repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."
