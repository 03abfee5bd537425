"""Description of a live run, from the telemetry of one side or both."""

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
import numpy.typing as npt

from haptether.bridge import (
    LADDER_STATES,
    Event,
    Metrics,
    Run,
    TelemetryCause,
    TelemetryChange,
    TelemetryEnd,
    TelemetryHello,
    TelemetryLost,
    TelemetryMessage,
    TelemetrySample,
    tripped_names,
)
from haptether.view.scene3d.arms import arms_of
from haptether.view.scene3d.description import Description, Moment, described
from haptether.view.scene3d.extent import (
    ARROW_SHARE,
    FORCES,
    JOINT_SHARE,
    TORQUES,
    Extent,
    axes_of,
    extents,
    is_joints,
    nice_above,
    points_of,
    stops,
)
from haptether.view.scene3d.history import History
from haptether.view.scene3d.settings import scene_of_settings
from haptether.view.scene3d.timeline import timeline_of

Array = npt.NDArray[np.float64]

TELEMETRY_HZ = 60
MAX_EVENTS = 256
STATES = {state: code for code, state in enumerate(LADDER_STATES)}
TIMES = {"master": "time_s", "slave": "slave_time_s"}
SHARED = ("environment_", "gripper", "holds_object")
"""Prefixes of slave signals without a counterpart at the master."""
MOVING = {"hand": ("position",), "robot": ("slave_position", "slave_command")}
"""Position signals of each end."""
ROOM = 0.3
"""Room around the range of motion so far, as a fraction of it."""
STANDARD_N, STANDARD_N_M = 5.0, 0.2
"""Force and torque drawn at full length until a larger one occurs."""


class LiveDescription:
    """Description of a live run, updated by telemetry messages, without socket or clock.

    `description` has parts and meshes as from `describe`. They change with `generation`: at the first sample, or when a
    motion or force exceeds the drawn range.

    Args:
        hellos: Hello of the master, the slave, or both in any order.
        title: Title; by default that of a live run.
        arm: Arm of the slave: a UR, or a servo description by name or path; settings do not name it.
        leader: Arm of the master: a servo description by name or path.
        history_s: Length of trails and time line in s.

    Raises:
        ValueError: Two hellos are of the same side, or there is no such arm.
    """

    def __init__(
        self, *hellos: TelemetryHello, title: str = "", arm: str = "", leader: str = "", history_s: float = 20.0
    ) -> None:
        sides = [hello.side for hello in hellos]
        if sorted(sides) not in (["master"], ["slave"], ["master", "slave"]):
            message = f"telemetry of {' and '.join(sides) or 'no side'}: must be of master, slave, or one of each"
            raise ValueError(message)
        self.sides = tuple(sides)
        self.time_s = 0.0
        """Time of the newest sample, on the master's clock if the master is present."""
        self.lost_ticks = 0
        """Ticks lost because this reader was too slow."""
        self.generation = 0
        """Incremented whenever `description` has other parts or sizes."""
        self.events: deque[Event] = deque(maxlen=MAX_EVENTS)
        """The newest events."""
        self._ended: set[str] = set()
        self._reason: dict[str, str] = {}
        self._offset_s: dict[str, float] = {}
        settings = next((hello.scene for hello in hellos if hello.scene), None)
        self._scene = scene_of_settings(settings)
        self._arms = arms_of(self._scene, arm=arm, leader=leader)
        self._title = title or f"live: {' and '.join(sides)}, Haptether {hellos[0].version}".strip(" ,")
        self._kinds = {hello.side: {one.name: one.kind for one in hello.signals} for hello in hellos}
        self._has_gripper = False
        self._most = max(2, round(history_s * TELEMETRY_HZ))
        sizes: dict[str, int] = {}
        for hello in hellos:
            sizes[TIMES[hello.side]] = 0
            for signal in hello.signals:
                if (name := self._name(hello.side, signal.name)) is not None:
                    sizes[name] = signal.size if signal.kind == "axes" and signal.size > 1 else 0
        if "device_force" in sizes:
            sizes["device_force_peak"] = 0
        self._history = History(sizes, self._most)
        self.description: Description
        """Description to draw; its time line is that of the last `refresh`."""
        self._low: dict[str, Array] = {}
        self._high: dict[str, Array] = {}
        self._joints = is_joints(self._history, self._scene)
        """True if positions are angles and forces are torques."""
        corners = stops(self._scene, axes_of(self._history))
        if corners is not None and not self._joints and "slave" in self.sides:
            # Before it moves, assume that the robot moves as far as the hand can.
            self._low["robot"], self._high["robot"] = corners
        self._peaks = {
            "force": dict.fromkeys(("hand", "robot"), STANDARD_N),
            "torque": dict.fromkeys(("hand", "robot"), STANDARD_N_M),
        }
        self._build()

    @property
    def has_ended(self) -> bool:
        """True if the loops of all sides ended in good order."""
        return self._ended == set(self.sides)

    @property
    def has_begun(self) -> bool:
        """True once each side has sent a sample."""
        return all(self._history.has_begun(TIMES[side]) for side in self.sides)

    def ended(self, side: str) -> bool:
        """True if the loop of a side ended in good order."""
        return side in self._ended

    def take(self, message: TelemetryMessage, side: str | None = None, *, received_s: float = 0.0) -> None:
        """Take a message.

        Args:
            message: Message of `TelemetryReader`.
            side: Its side; optional if there is only one.
            received_s: Arrival time on any monotonic clock; it aligns the times of two sides.

        Raises:
            ValueError: There is no such side.
        """
        of = self.sides[0] if side is None and len(self.sides) == 1 else side
        if of not in self.sides:
            text = f"side = {side!r}: must be {' or '.join(map(repr, self.sides))}"
            raise ValueError(text)
        match message:
            case TelemetrySample():
                self._sample(of, message, received_s)
            case TelemetryChange(signal="state"):
                reason = self._reason.get(of, "")
                self._note(of, message.time_ns, str(message.to), f"{of}: {reason}" if reason else of)
            case TelemetryChange(signal="reason"):
                self._reason[of] = str(message.to)
                if self.events and self.events[-1].kind in STATES and self.events[-1].detail.startswith(of):
                    # The reason arrives with its state.
                    last = self.events.pop()
                    self.events.append(Event(last.time_s, last.kind, f"{of}: {message.to}"))
            case TelemetryChange(signal="tripped" | "rotation_tripped", from_=before, to=now):
                new = tripped_names(int(now) & ~int(before))
                if new and not int(before):
                    self._note(of, message.time_ns, "trip", " ".join(new))
            case TelemetryChange(signal="holds_object", to=to):
                self._note(of, message.time_ns, "grip" if to else "drop", "")
            case TelemetryCause():
                self._note(of, message.time_ns, "cause", f"{message.at}: {message.text}")
            case TelemetryLost(ticks=ticks):
                self.lost_ticks += ticks
            case TelemetryEnd():
                self._ended.add(of)
            case _:
                pass

    def _note(self, side: str, time_ns: int, kind: str, detail: str) -> None:
        shift_s = 0.0
        if side == "slave" and "master" in self._offset_s:
            shift_s = self._offset_s.get("slave", self._offset_s["master"]) - self._offset_s["master"]
        self.events.append(Event(time_ns * 1e-9 + shift_s, kind, detail))

    def at_now(self) -> Moment:
        """Poses, trails and status at the newest sample."""
        return self.description.at(self.time_s)

    def refresh(self) -> Description:
        """Description with an updated time line; moving parts need no refresh."""
        self.description = replace(self.description, timeline=timeline_of(self._history, tuple(self.events)))
        return self.description

    def _name(self, side: str, name: str) -> str | None:
        """Name in a run of a signal of a side; None if it is not drawn."""
        kinds = self._kinds[side]
        if f"true_{name}" in kinds or (name.startswith("hand_") and "true_position" not in kinds):
            # The force of a real hand is unknown.
            return None
        if name.startswith("gripper") and not self._has_gripper:
            return None
        if name == "holds_object" and not self._has_gripper:
            return None
        if kinds[name] == "name" and name not in {"state", "peer_state"}:
            return None
        name = name.removeprefix("true_")
        return name if side == "master" or name.startswith(SHARED) else f"slave_{name}"

    def _sample(self, side: str, sample: TelemetrySample, received_s: float) -> None:
        time_s = sample.time_ns * 1e-9
        # The fastest message gives the best estimate of the clock offset.
        self._offset_s[side] = min(self._offset_s.get(side, math.inf), received_s - time_s)
        if side == "slave" and "master" in self.sides:
            if "master" not in self._offset_s:
                return
            time_s += self._offset_s["slave"] - self._offset_s["master"]
        if side == "slave" and not self._has_gripper and _known(sample.signals.get("gripper")):
            self._begin_gripper()
        time = TIMES[side]
        if self._history.has_begun(time):
            time_s = max(time_s, float(self._history[time][-1]))
        is_first = not self._history.has_begun(time)
        row: dict[str, Any] = {time: time_s}
        for signal, kind in self._kinds[side].items():
            if (name := self._name(side, signal)) is not None and signal in sample.signals:
                row[name] = _last(sample.signals[signal], kind, name in self._history and self._history[name].ndim > 1)
        if "device_force" in row and side == "master":
            axes = sample.signals["device_force"]
            row["device_force_peak"] = max(
                (max(abs(low or 0.0), abs(high or 0.0)) for low, high, _ in axes), default=0.0
            )
        self._history.append(time, row)
        self.time_s = max(self.time_s, time_s)
        if self._grows(row) or is_first:
            self._build()

    def _begin_gripper(self) -> None:
        """Keep the gripper's signals from its first position on."""
        self._has_gripper = True
        names = [self._name("slave", name) for name in self._kinds["slave"]]
        self._history.add({name: 0 for name in names if name is not None and name not in self._history})

    def _grows(self, row: Mapping[str, Any]) -> bool:
        """True if a motion or force exceeds the drawn range."""
        grown = False
        for station, names in MOVING.items():
            of: Extent = self._extents[station]
            for name in () if self._joints else names:
                at = _vector(row.get(name))
                if at is None:
                    continue
                low, high = self._low.get(station, at), self._high.get(station, at)
                self._low[station], self._high[station] = np.minimum(low, at), np.maximum(high, at)
                beyond = np.maximum(of.low - at, at - of.high).max()
                grown = grown or bool(beyond > 0.02 * of.size)
        for station, kind, forces in _FORCES:
            for name in forces:
                if self._joints:
                    torques = np.atleast_1d(np.asarray(row.get(name, math.nan), dtype=np.float64))
                    grown = self._pushes("torque", station, float(np.abs(torques).max())) or grown
                elif (vector := _vector(row.get(name))) is not None:
                    grown = self._pushes(kind, station, float(np.linalg.norm(vector))) or grown
        return grown

    def _pushes(self, kind: str, station: str, norm: float) -> bool:
        """True if a force exceeds the drawn range."""
        if not norm > self._peaks[kind][station]:
            return False
        self._peaks[kind][station] = nice_above(1.2 * norm)
        return True

    def _build(self) -> None:
        run = Run(
            scene=self._title, seed=0, version="", signals=self._history, events=(), metrics=Metrics()
        )  # fmt: skip
        known = extents([(run, self._scene)], self._arms)
        self._extents = {station: self._roomy(station, of) for station, of in known.items()}
        whole = described(run, self._scene, self._title, self._extents, self._arms)
        status = type(whole.status)(self._history, self.events, self._scene)
        self.description = replace(whole, status=status, figures="")
        self.refresh()
        self.generation += 1

    def _roomy(self, station: str, of: Extent) -> Extent:
        """Extent with the motion and forces so far, and room beyond."""
        low, high = of.low, of.high
        if station in self._low:
            seen_low, seen_high = self._low[station], self._high[station]
            room = ROOM * np.where(seen_high > seen_low, max(0.0, float((seen_high - seen_low).max())), 0.0)
            low, high = np.minimum(low, seen_low - room), np.maximum(high, seen_high + room)
        size = max(of.size, float((high - low).max()))
        torque_share = JOINT_SHARE if self._joints else ARROW_SHARE
        return replace(
            of, low=low, high=high, size=size,
            metres_per_newton=ARROW_SHARE * size / self._peaks["force"][station],
            metres_per_newton_metre=torque_share * size / self._peaks["torque"][station],
        )  # fmt: skip


_FORCES = [
    (station, kind, names) for kind, of in (("force", FORCES), ("torque", TORQUES)) for station, names in of.items()
]


def _known(value: Any) -> bool:  # noqa: ANN401  # by the kind of the signal
    return isinstance(value, list) and value[-1] is not None


def _last(value: Any, kind: str, has_axes: bool) -> Any:  # noqa: ANN401
    """Last value as a number, or one per axis; of bits those of any tick, so that none is missed."""
    match kind:
        case "axes":
            numbers = [math.nan if axis[2] is None else axis[2] for axis in value]
            return numbers if has_axes else numbers[0]
        case "number":
            return math.nan if value[2] is None else value[2]
        case "bits":
            return float(value[0])
        case "name":
            return float(STATES.get(value, 0))
        case _:
            return float(value)


def _vector(value: Any) -> Array | None:  # noqa: ANN401  # a number, or one per axis
    if value is None:
        return None
    vector = points_of(np.atleast_1d(np.asarray(value, dtype=np.float64))[None])[0]
    return vector if np.isfinite(vector).all() else None
