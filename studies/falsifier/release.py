"""A release as bounded numbers, as a row of a sweep, and as a scene."""

import itertools
from collections.abc import Sequence
from math import sqrt
from typing import Literal

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import (
    EnvironmentTable,
    LinksTable,
    OperatorTable,
    PusherTable,
    ReleaseTable,
    RunTable,
    Scene,
    SceneError,
)
from haptether.netsim import LinkSettings

Array = npt.NDArray[np.float64]

HAND_RATE = 138.0
"""Natural frequency of hand and device in rad/s; the hand then rests within 0.1 s."""
RESTS_AFTER_S = 0.15
ENGAGED_AFTER_S = 0.6
"""Time from engagement, with an arm, until its force has risen and the hand rests."""
AFTER_S = 0.1
"""Time for which a run continues after the last step of the push."""
TRAVEL_S = 0.5
"""The same without an energy controller: a small push, never detected, acts over the whole travel."""
FINENESS = 3
"""Power applied to numbers that give times, so that most of their range is short times."""
JITTER_OF_DELAY = 0.3
STRONGEST = 10.0
"""Largest grip strength over the held force."""


class ReleaseBounds(Struct, frozen=True, kw_only=True):
    """Bounds of a release."""

    steps: int = 8
    """Steps of the push after the release."""
    shortest_s: float = 5e-4
    """Least time in s from one step to the next."""
    longest_s: float = 0.1
    """Longest time in s from one step to the next, and from the end of the grip to the first."""
    span_s: float = 0.24
    """Longest time in s from the end of the grip to the last step."""
    decay_s: float = 0.05
    """Longest time in s over which the grip gives way."""
    delay_s: float = 0.2
    """Longest delay in s of a link direction, if the scene has a link."""
    jitter_s: float = 0.01
    """Largest standard deviation of the delay in s."""
    loss: float = 0.05
    """Largest fraction of lost packets."""
    push: Literal["auto", "any", "steady"] = "auto"
    """Push: "any" force up to the cap, "steady" (neither grows nor turns), or "auto" as covered by the bound."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("steps", 1, 40),
            ("shortest_s", 1e-5, 1.0),
            ("longest_s", self.shortest_s, 1.0),
            ("span_s", self.shortest_s * self.steps, 10.0),
            ("decay_s", 0.0, 1.0),
            ("delay_s", 0.0, 2.0),
            ("jitter_s", 0.0, 0.5),
            ("loss", 0.0, 0.9),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                message = f"{name} = {value}: must be between {low:g} and {high:g}"
                raise ValueError(message)


class Release(Struct, frozen=True, kw_only=True):
    """A hand holds a push and releases; the push continues in steps."""

    held_n: float
    """Held force in N."""
    decay_s: float
    """Time in s over which the grip gives way."""
    margin: float
    """Grip strength over the held force."""
    after_s: tuple[float, ...]
    """Times of the steps in s after the release, not before the end of the grip."""
    level_n: tuple[float, ...]
    """Push after each step in N."""
    direction: tuple[float, ...] = (1.0,)
    """Direction of hold and push: a unit vector over the axes."""
    delay_s: tuple[float, float] = (0.0, 0.0)
    """Delay in s of each direction of the link."""
    jitter_s: float = 0.0
    """Standard deviation of the delay in s."""
    loss: float = 0.0
    """Fraction of lost packets."""


class Releases:
    """All releases of a scene within bounds: its device, loop, link, arm and safety, with another hand and push."""

    def __init__(self, scene: Scene, bounds: ReleaseBounds) -> None:
        """Take the constant parts of the scene.

        Raises:
            SceneError: The scene is of kind "pose", or has no cap.
        """
        self.bounds, self.scene = bounds, scene
        if scene.master.kind == "pose":
            message = "[master] kind = pose: releases are searched for points and joints"
            raise SceneError(message)
        settings = scene.ejection_settings()
        self.cap_n = settings.max_force_n
        if not np.isfinite(self.cap_n):
            message = "[safety.limiter] enabled = false: without a cap no release is the worst"
            raise SceneError(message)
        self.after_s = AFTER_S if "wsc" in settings.controllers else TRAVEL_S
        self.mass_kg = max(settings.mass_kg)
        self.axes = len(settings.mass_kg)
        self.lightest = int(np.argmin(settings.mass_kg))
        self.has_link = scene.slave is not None and scene.link is not None
        window_s = settings.window * settings.period_s if "wsc" in settings.controllers else 0.0
        # An arm engages some time after the start of the run; times count from engagement.
        self.engaged_s = 0.0 if scene.slave is None else ENGAGED_AFTER_S + 2.0 * bounds.delay_s * self.has_link
        settled_s = self.engaged_s or RESTS_AFTER_S
        # At the release, the window of WSC holds only a resting hand.
        self.at_s = round(settled_s + window_s, 3)

    @property
    def free_s(self) -> float:
        """Longest time in s from a release to the end of its run."""
        return self.engaged_s + self.bounds.decay_s + self.bounds.span_s + self.after_s

    @property
    def size(self) -> int:
        """Number of parameters of a release."""
        return 3 + 2 * self.bounds.steps + (self.axes - 1) + 4 * self.has_link

    def of(self, numbers: Sequence[float] | Array) -> Release:
        """Release of numbers between 0 and 1."""
        bounds = self.bounds
        x = np.clip(np.asarray(numbers, dtype=float), 0.0, 1.0)
        held, steps = self.cap_n * (0.05 + 0.95 * x[0]), bounds.steps
        gaps, levels = x[3 : 3 + steps], x[3 + steps : 3 + 2 * steps]
        decay_s = bounds.decay_s * float(x[1])
        # A changing push under a hand would move it, and the hand would put energy in.
        first = bounds.longest_s * gaps[0] ** FINENESS
        later = bounds.shortest_s + (bounds.longest_s - bounds.shortest_s) * gaps[1:] ** FINENESS
        gone = np.cumsum(np.concatenate(([first], later)))
        if gone[-1] > bounds.span_s:
            # Compress the times proportionally, but keep the shortest distance between steps.
            least = bounds.shortest_s * np.arange(steps)
            gone = least + (gone - least) * (bounds.span_s - least[-1]) / (gone[-1] - least[-1])
        after = decay_s + gone
        level = held * np.cumprod(levels) if bounds.push == "steady" else self.cap_n * (2.0 * levels - 1.0)
        delay_s, jitter_s, loss = (0.0, 0.0), 0.0, 0.0
        if self.has_link:
            forward, backward, jitter, lost = map(float, x[-4:])
            delay_s = (bounds.delay_s * forward, bounds.delay_s * backward)
            # Bound the jitter so that a normally distributed delay stays non-negative.
            jitter_s = min(bounds.jitter_s, JITTER_OF_DELAY * min(delay_s)) * jitter
            loss = bounds.loss * lost
        return Release(
            held_n=float(held),
            decay_s=decay_s,
            margin=1.05 + (STRONGEST - 1.05) * float(x[2]) ** 2,
            after_s=tuple(map(float, after)),
            level_n=tuple(map(float, level)),
            direction=self._direction(x[3 + 2 * steps : 2 + 2 * steps + self.axes]),
            delay_s=delay_s,
            jitter_s=jitter_s,
            loss=loss,
        )

    def numbers(self, release: Release, *, fill: float = 0.5) -> Array:
        """Numbers of a release with any number of steps; surplus steps are dropped.

        `fill` is the value for missing steps, direction and link.
        """
        bounds, steps = self.bounds, self.bounds.steps
        x = np.full(self.size, fill)
        x[0] = (release.held_n / self.cap_n - 0.05) / 0.95
        x[1] = release.decay_s / bounds.decay_s if bounds.decay_s else 0.0
        x[2] = sqrt(max(release.margin - 1.05, 0.0) / (STRONGEST - 1.05))
        after = np.array(release.after_s[:steps])
        gaps = np.diff(after, prepend=release.decay_s)
        gaps[1:] -= bounds.shortest_s
        ranges = np.full(len(after), bounds.longest_s - bounds.shortest_s)
        ranges[:1] = bounds.longest_s
        x[3 : 3 + len(after)] = np.clip(gaps / ranges, 0.0, 1.0) ** (1.0 / FINENESS)
        level = np.array(release.level_n[:steps])
        if bounds.push == "steady":
            before = np.concatenate(([release.held_n], level))[:-1]
            shares = np.divide(level, before, out=np.zeros(len(level)), where=before > 0.0)
        else:
            shares = (level / self.cap_n + 1.0) / 2.0
        x[3 + steps : 3 + steps + len(level)] = shares
        clipped: Array = np.clip(x, 0.0, 1.0)
        return clipped

    def _direction(self, numbers: Array) -> tuple[float, ...]:
        """Unit vector of numbers between 0 and 1: slopes against the lightest axis, which is at 0.5 each."""
        along = np.zeros(self.axes)
        others = [axis for axis in range(self.axes) if axis != self.lightest]
        along[self.lightest] = 1.0
        along[others] = np.tan(np.pi / 2.0 * 0.99 * (2.0 * numbers - 1.0))
        along /= np.linalg.norm(along)
        return tuple(map(float, along))

    def samples(self, releases: Sequence[Release]) -> dict[str, Array]:
        """Releases as rows of a sweep of `scene_of` for any of them with all steps."""
        rows = [self._row(release) for release in releases]
        return {path: np.array([row[path] for row in rows]) for path in rows[0]}

    def _row(self, release: Release) -> dict[str, float]:
        row = {
            "operator.grip_strength_n": release.margin * release.held_n,
            "operator.release.decay_s": release.decay_s,
        }
        pushes = [(None, release.held_n), *self._pushes(release)]
        for place, (at_s, step_n) in enumerate(pushes):
            if at_s is not None:
                row[f"environment.pushers.{place}.at_s"] = at_s
            force = self._along(step_n, release)
            if isinstance(force, float):
                row[f"environment.pushers.{place}.force_n"] = force
            else:
                row |= {f"environment.pushers.{place}.force_n.{axis}": each for axis, each in enumerate(force)}
        if self.has_link:
            for direction, delay_s in zip(("forward", "backward"), release.delay_s, strict=True):
                row[f"link.{direction}.delay_s"] = delay_s
                row[f"link.{direction}.jitter_s"] = release.jitter_s
                row[f"link.{direction}.loss"] = release.loss
        return row

    def _pushes(self, release: Release) -> list[tuple[float, float]]:
        """Sending time and size of each step, so that none arrives before the release."""
        early = release.delay_s[1] if self.has_link else 0.0
        steps = zip(release.after_s, itertools.pairwise((release.held_n, *release.level_n)), strict=True)
        # Round to ns and nN, so that the written scene equals the run.
        return [(round(self.at_s + after - early, 9), round(new - old, 9)) for after, (old, new) in steps]

    def scene_of(self, release: Release, title: str = "", *, whole: bool = False) -> Scene:
        """Scene of a release; `whole` keeps steps without a change, for a sweep."""
        base = self.scene
        stiffness = HAND_RATE**2 * self.mass_kg
        pushes = [(0.0, release.held_n)]
        pushes += [(at, step) for at, step in self._pushes(release) if whole or step != 0.0]
        bounds = self.bounds
        latest_s = bounds.decay_s + bounds.span_s if whole else max(release.after_s, default=0.0)
        lasts_s = self.engaged_s + self.at_s + latest_s + self.after_s
        link = base.link
        if self.has_link:
            forward, backward = (
                LinkSettings(delay_s=delay_s, jitter_s=release.jitter_s, loss=release.loss)
                for delay_s in release.delay_s
            )
            link = LinksTable(forward=forward, backward=backward)
        return Scene(
            schema=1,
            title=title,
            run=RunTable(duration_s=round(lasts_s, 4), period_s=base.run.period_s, seed=base.run.seed),
            master=replace(base.master, position=None, velocity=0.0, driver=None, options={}),
            operator=OperatorTable(
                stiffness=stiffness,
                damping=2.0 * sqrt(stiffness * self.mass_kg),
                grip_strength_n=release.margin * release.held_n,
                release=ReleaseTable(at_s=self.at_s, decay_s=release.decay_s),
                clutch="auto" if base.slave is None else "once",
            ),
            slave=base.slave and replace(base.slave, position=None, device="simulated", options={}),
            environment=EnvironmentTable(
                pushers=tuple(PusherTable(at_s=at_s, force_n=self._along(force_n, release)) for at_s, force_n in pushes)
            ),
            link=link,
            coupling=base.coupling,
            security=None,
            safety=base.safety,
        )

    def _along(self, force_n: float, release: Release) -> "float | tuple[float, ...]":
        if self.axes == 1:
            return force_n
        return tuple(round(force_n * along, 9) for along in release.direction)
