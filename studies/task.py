"""A bundled scene as a task: the same work by many hands, held throughout or let go under force, at any round trip."""

from collections.abc import Iterable
from math import exp, log
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import (
    LegTable,
    LinksTable,
    OperatorTable,
    RecordTable,
    ReleaseTable,
    RotationSafetyTable,
    Scene,
    Sweep,
    TremorTable,
    load_scene,
    override_scene,
    simulate,
)
from haptether.netsim import LinkSettings

Array = npt.NDArray[np.float64]

THRESHOLD_TASKS = (
    "free_motion",
    "paper_wall",
    "active_force",
    "moving_wall",
    "sliding_mass",
    "remote_push",
    "three_axis_box",
    "peg_in_hole",
    "pick_and_place",
    "valve",
)
"""Bundled scenes in which a hand works."""
SOFTENED = {"valve": ("coupling.force_scale=0.25",)}
"""Scenes that are felt stiffer than hands are: with a delay the loop rings whoever watches."""

DECAY_S = 0.05
"""Time in s in which a grip gives way: what a hand that loses a stylus takes (paper section 4.3)."""
STRENGTH_N = 12.0
"""Grip strength in N until then, above all caps."""
JITTER_OF_DELAY = 0.1
"""Standard deviation of a delay over itself, of a scene whose link has jitter."""
HELD_SHARE = 0.5
"""Share of the largest force of a task above which a hand is let go."""
STROKES = 3
"""Out of contact, in again and out again: a hand that withdraws before a late force is what trips falsely."""
STIFFER = 1.25
"""Stiffness of a hand over what it feels, at least: below 1 the loop with delay rings whoever watches."""


class HandBounds(Struct, frozen=True, kw_only=True):
    """What hands may be; numbers are drawn evenly, stiffness, damping and pace evenly in their logarithm."""

    stiffness: tuple[float, float] = (200.0, 600.0)
    """K in N/m; from 1.25 times what is felt on."""
    damping: tuple[float, float] = (8.0, 25.0)
    """B in N s/m."""
    pace: tuple[float, float] = (0.75, 1.4)
    """Duration of each stroke over that of the scene; 1 where a gripper has a course of its own."""
    withdrawal_s: tuple[float, float] = (0.3, 1.2)
    """Duration in s of a stroke back to the start, and of the next one in."""
    tremor_m: tuple[float, float] = (2e-5, 2e-4)
    """Amplitude of the tremor in m."""
    tremor_hz: tuple[float, float] = (8.0, 12.0)
    """Its frequency in Hz (Elble and Koller 1990)."""


class Network(Struct, frozen=True, kw_only=True):
    """What a network does beside its mean delay, the same both ways."""

    name: str
    jitter: float = 0.0
    """Standard deviation of a delay over itself, of a gamma law that forgets itself within 0.1 s."""
    loss: float = 0.0
    """Share of packets that are lost."""
    mean_burst: float = 1.0
    """Mean number of packets that are lost together."""

    def link(self, delay_s: float) -> LinkSettings:
        """One direction of it."""
        settings = LinkSettings(delay_s=delay_s)
        if self.jitter > 0.0 and delay_s > 0.0:
            settings = replace(settings, jitter_s=self.jitter * delay_s, distribution="gamma")
        if self.loss > 0.0:
            settings = replace(settings, loss=self.loss, mean_burst=self.mean_burst)
        return settings


class NotEngagedError(ValueError):
    """Master and slave of a task never engage."""


class Task:
    """A scene as a task, at one round trip.

    Args:
        name: Of a bundled scene, the path of one, or a scene.
        round_trip_s: Both delays of a link together, or by how much a force without an arm is late.
        overrides: Fields of the scene to change first.
        network: What the link does; by default what the scene's does, with a jitter of a tenth of its delay.
        by_time: Whether an intervention ends by time, so that each is an event, instead of as the scene says.
    """

    def __init__(
        self,
        name: str | Scene,
        round_trip_s: float,
        overrides: Iterable[str] = (),
        *,
        network: Network | None = None,
        by_time: bool = True,
    ) -> None:
        if isinstance(name, Scene):
            scene, name = override_scene(name, overrides), name.title or "scene"
        else:
            scene = load_scene(name, (*SOFTENED.get(Path(name).stem, ()), *overrides))
        if scene.operator is None:
            message = f"{name}: nobody holds its device"
            raise ValueError(message)
        self.name, self.round_trip_s, self.base = name, round_trip_s, scene
        self.operator: OperatorTable = scene.operator
        self.network, self.by_time = network, by_time
        self.strokes = 0
        self.held = self._late(self._held())
        self.engaged_s = 0.0

    def _held(self) -> Scene:
        """It with a hand that never lets go, and nothing recorded."""
        operator = replace(self.operator, release=None, grip_strength_n=None, tremor=TremorTable(), legs=self._legs())
        if operator.rotation is not None:
            operator = replace(operator, rotation=replace(operator.rotation, release=None))
        safety = self.base.safety
        if self.by_time:
            safety = replace(safety, hold_off_s=0.1, release_ramp_s=0.2, probe_force_n=0.0, release_tries=0)
        run = replace(self.base.run, duration_s=round(self.base.run.duration_s + self.strokes, 3))
        return replace(self.base, operator=operator, safety=safety, run=run, record=None, security=None)

    def _legs(self) -> tuple[LegTable, ...]:
        """The path of the scene, and where it only goes in, back out and in and out again."""
        legs = self.operator.legs
        self.strokes = 0
        if not legs or self.operator.trigger or legs[-1].end == self.operator.start:
            return legs
        self.strokes = STROKES
        ends = (self.operator.start, legs[-1].end)
        return legs + tuple(LegTable(duration_s=1.0, end=ends[place % 2]) for place in range(STROKES))

    def _late(self, scene: Scene) -> Scene:
        """It with forces that come back after the round trip."""
        delay_s = 0.5 * self.round_trip_s
        if scene.slave is not None and self.network is not None:
            link = self.network.link(delay_s)
            return replace(scene, link=LinksTable(forward=link, backward=link))
        if scene.slave is not None:

            def direction(link: LinkSettings | None) -> LinkSettings:
                link = link or LinkSettings()
                jitter_s = JITTER_OF_DELAY * delay_s if link.jitter_s else 0.0
                return replace(link, delay_s=delay_s, jitter_s=jitter_s)

            old = scene.link or LinksTable()
            links = LinksTable(forward=direction(old.forward), backward=direction(old.backward))
            return replace(scene, link=links)
        if scene.environment is None:
            return scene
        ticks = round(self.round_trip_s / scene.run.period_s)
        return replace(scene, environment=replace(scene.environment, delay_ticks=ticks))

    def watched(self, scene: Scene, controllers: str | None, fixed: dict[str, float | str]) -> Scene:
        """A scene with controllers, separated by commas, or with none."""
        names = controllers or ""
        changes = [f"safety.{key}={value}" for key, value in fixed.items()]
        return override_scene(scene, [f"safety.controllers=[{names}]", *changes])

    def felt_stiffness(self) -> float:
        """Stiffness in N/m that the hand feels at most: of what is touched, or of an arm's servo if that is softer."""
        contacts = [0.0]
        if (environment := self.base.environment) is not None:
            contacts += [each.contact.stiffness for each in environment.objects]
            contacts += [each.contact.stiffness for each in environment.holes]
        felt = max(contacts)
        if (slave := self.base.slave) is None:
            return felt
        if slave.stiffness is not None:
            felt = min(felt, slave.stiffness) if felt else slave.stiffness
        coupling = self.base.coupling
        return felt if coupling is None else felt * coupling.force_scale * coupling.position_scale

    def hands(self, count: int, seed: int, bounds: HandBounds) -> dict[str, Array]:
        """Hands as rows of a sweep: the same for the same seed, whatever the round trip."""
        rng = np.random.default_rng([seed, *Path(self.name).stem.encode()])
        softest = max(bounds.stiffness[0], STIFFER * self.felt_stiffness())
        pace = _log_uniform(rng, bounds.pace, count)
        rows = {
            "operator.stiffness": _log_uniform(rng, (softest, max(softest, bounds.stiffness[1])), count),
            "operator.damping": _log_uniform(rng, bounds.damping, count),
            "operator.tremor.amplitude": rng.uniform(*bounds.tremor_m, count),
            "operator.tremor.frequency_hz": rng.uniform(*bounds.tremor_hz, count),
            "run.seed": rng.integers(1, 2**31, count).astype(np.float64),
        }
        if not self.operator.trigger:
            for place, leg in enumerate(self.operator.legs):
                rows[f"operator.legs.{place}.duration_s"] = leg.duration_s * pace
        withdrawal_s = _log_uniform(rng, bounds.withdrawal_s, count)
        for stroke in range(self.strokes):
            rows[f"operator.legs.{len(self.operator.legs) + stroke}.duration_s"] = withdrawal_s
        return rows

    def lasting(self, bounds: HandBounds) -> Scene:
        """The held task, as long as its slowest hand needs."""
        slowest = 1.0 if self.operator.trigger or not self.operator.legs else bounds.pace[1]
        longest_s = self.base.run.duration_s * slowest + self.strokes * bounds.withdrawal_s[1]
        duration_s = round(longest_s + 2.0 * self.round_trip_s, 3)
        return replace(self.held, run=replace(self.held.run, duration_s=duration_s))

    def release_times(self, count: int) -> tuple[float, ...]:
        """When a hand is let go, in s: spread over the time in which more than half of the largest force is felt."""
        recorded = replace(self.watched(self.held, None, {}), record=RecordTable())
        run = simulate(recorded)
        force = run.signals["device_force"]
        size = np.abs(force) if force.ndim == 1 else np.linalg.norm(force, axis=-1)
        engaged_s = [event.time_s for event in run.events if event.kind == "engaged"]
        if self.base.slave is not None and not engaged_s:
            message = (
                f"{self.name}: at a round trip of {self.round_trip_s:g} s the two do not engage, so nothing is held"
            )
            raise NotEngagedError(message)
        self.engaged_s = min(engaged_s, default=0.0)
        time_s = run.signals["time_s"] - self.engaged_s
        pressed = time_s[(size >= HELD_SHARE * size.max()) & (size > 0.0) & (time_s > 0.0)]
        if pressed.size == 0:
            return ()
        shares = (np.arange(count) + 0.5) / count
        return tuple(round(float(pressed[int(share * pressed.size)]), 3) for share in shares)

    def let_go(self, at_s: float, after_s: float) -> Scene:
        """The task in which the hand lets go at a time, and `after_s` of what follows the grip."""
        # The grip of a hand that turns as well is of its rotation, too.
        release = ReleaseTable(at_s=at_s, decay_s=DECAY_S)
        operator = replace(self.held.operator or self.operator, release=release, grip_strength_n=STRENGTH_N)
        if operator.rotation is not None:
            turned = replace(release, kind="gain")
            operator = replace(operator, rotation=replace(operator.rotation, release=turned))
        lasts_s = self.engaged_s + at_s + DECAY_S + after_s
        return replace(self.held, operator=operator, run=replace(self.held.run, duration_s=round(lasts_s, 3)))


def ejection_speeds(scene: Scene, found: Sweep) -> Array:
    """Largest speed in m/s after each release of a sweep: of the device, or of a handle that turns at its lever."""
    speed = np.nan_to_num(np.asarray(found["max_ejection_velocity"], dtype=np.float64))
    if "max_ejection_rate" in found.columns:
        lever_m = (scene.safety.rotation or RotationSafetyTable()).lever_m
        rate = np.nan_to_num(np.asarray(found["max_ejection_rate"], dtype=np.float64))
        speed = np.maximum(speed, rate * lever_m)
    return speed


def _log_uniform(rng: np.random.Generator, bounds: tuple[float, float], count: int) -> Array:
    low, high = map(log, bounds)
    drawn: Array = np.array([exp(value) for value in rng.uniform(low, high, count)])
    return drawn
