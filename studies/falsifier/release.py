"""A release as numbers within stated bounds, as a row of a sweep, and as a scene."""

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
"""In rad/s: how stiff the hand is, beside the device; it then rests within 0.1 s."""
RESTS_AFTER_S = 0.15
ENGAGED_AFTER_S = 0.6
"""With an arm: from engagement until its force has come in and the hand rests."""
AFTER_S = 0.1
"""How long a run goes on after the last step of the push."""
TRAVEL_S = 0.5
"""The same where nobody watches energy: a small push that is never seen works over the whole travel."""
JITTER_OF_DELAY = 0.3
STRONGEST = 10.0
"""Grip strength over the force that is held, where the hand lets go at once."""


class ReleaseBounds(Struct, frozen=True, kw_only=True):
    """What a release may be."""

    steps: int = 8
    """Steps of the push after the release."""
    shortest_s: float = 5e-4
    """Least time in s from one step to the next."""
    longest_s: float = 0.03
    """Longest time in s from one step to the next, and to the first from when the hand has gone."""
    decay_s: float = 0.05
    """Longest time in s in which the grip gives way."""
    delay_s: float = 0.2
    """Longest delay in s of a direction of the link, where the scene has one."""
    jitter_s: float = 0.01
    """Largest standard deviation of the delay in s."""
    loss: float = 0.05
    """Largest share of packets that are lost."""
    push: Literal["auto", "any", "steady"] = "auto"
    """Any force up to the cap, or one that neither grows nor turns; "auto" is what the bound holds for."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("steps", 1, 40),
            ("shortest_s", 1e-5, 1.0),
            ("longest_s", self.shortest_s, 1.0),
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
    """A hand that holds a push lets go, and the push goes on in steps."""

    held_n: float
    """What it holds, in N."""
    decay_s: float
    """Time in s in which its grip gives way."""
    margin: float
    """Grip strength over what it holds."""
    after_s: tuple[float, ...]
    """When the push steps, in s after the release; not before the hand has gone."""
    level_n: tuple[float, ...]
    """What it becomes, in N."""
    delay_s: tuple[float, float] = (0.0, 0.0)
    """Delay in s of either direction of the link."""
    jitter_s: float = 0.0
    """Its standard deviation."""
    loss: float = 0.0
    """Share of packets that are lost."""


class Releases:
    """All releases of a scene within bounds: its device, loop, link, arm and safety, another hand and push."""

    def __init__(self, scene: Scene, bounds: ReleaseBounds) -> None:
        """Takes what is kept of the scene.

        Raises:
            SceneError: A scene of kind "pose", or without a cap.
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
        self.axis = int(np.argmin(settings.mass_kg))
        self.has_link = scene.slave is not None and scene.link is not None
        window_s = settings.window * settings.period_s if "wsc" in settings.controllers else 0.0
        settled_s = RESTS_AFTER_S if scene.slave is None else ENGAGED_AFTER_S + 2.0 * bounds.delay_s * self.has_link
        # What the window of WSC holds is then of a hand at rest.
        self.at_s = round(settled_s + window_s, 3)

    @property
    def size(self) -> int:
        """How many numbers describe a release."""
        return 3 + 2 * self.bounds.steps + 4 * self.has_link

    def of(self, numbers: Sequence[float] | Array) -> Release:
        """The release of numbers between 0 and 1."""
        bounds = self.bounds
        x = np.clip(np.asarray(numbers, dtype=float), 0.0, 1.0)
        held, steps = self.cap_n * (0.05 + 0.95 * x[0]), bounds.steps
        gaps, levels = x[3 : 3 + steps], x[3 + steps : 3 + 2 * steps]
        decay_s = bounds.decay_s * float(x[1])
        # While a hand is still there, a push that changes would have it move, and so put energy in.
        first = decay_s + bounds.longest_s * gaps[0]
        later = bounds.shortest_s + (bounds.longest_s - bounds.shortest_s) * gaps[1:] ** 2
        after = np.cumsum(np.concatenate(([first], later)))
        level = held * np.cumprod(levels) if bounds.push == "steady" else self.cap_n * (2.0 * levels - 1.0)
        delay_s, jitter_s, loss = (0.0, 0.0), 0.0, 0.0
        if self.has_link:
            forward, backward, jitter, lost = map(float, x[-4:])
            delay_s = (bounds.delay_s * forward, bounds.delay_s * backward)
            # Of a normal delay that is never negative.
            jitter_s = min(bounds.jitter_s, JITTER_OF_DELAY * min(delay_s)) * jitter
            loss = bounds.loss * lost
        return Release(
            held_n=float(held),
            decay_s=decay_s,
            margin=1.05 + (STRONGEST - 1.05) * float(x[2]) ** 2,
            after_s=tuple(map(float, after)),
            level_n=tuple(map(float, level)),
            delay_s=delay_s,
            jitter_s=jitter_s,
            loss=loss,
        )

    def samples(self, releases: Sequence[Release]) -> dict[str, Array]:
        """Releases as rows of a sweep of `scene_of` any of them with all steps."""
        rows = [self._row(release) for release in releases]
        return {path: np.array([row[path] for row in rows]) for path in rows[0]}

    def _row(self, release: Release) -> dict[str, float]:
        pushes = self._pushes(release)
        force = "force_n" if self.axes == 1 else f"force_n.{self.axis}"
        row = {
            "operator.grip_strength_n": release.margin * release.held_n,
            "operator.release.decay_s": release.decay_s,
            f"environment.pushers.0.{force}": release.held_n,
        }
        for place, (at_s, step_n) in enumerate(pushes, 1):
            row[f"environment.pushers.{place}.at_s"] = at_s
            row[f"environment.pushers.{place}.{force}"] = step_n
        if self.has_link:
            for direction, delay_s in zip(("forward", "backward"), release.delay_s, strict=True):
                row[f"link.{direction}.delay_s"] = delay_s
                row[f"link.{direction}.jitter_s"] = release.jitter_s
                row[f"link.{direction}.loss"] = release.loss
        return row

    def _pushes(self, release: Release) -> list[tuple[float, float]]:
        """When each step is sent, and by how much it steps: so that none arrives before the release."""
        early = release.delay_s[1] if self.has_link else 0.0
        steps = zip(release.after_s, itertools.pairwise((release.held_n, *release.level_n)), strict=True)
        # In whole ns and nN: what is written is what was run.
        return [(round(self.at_s + after - early, 9), round(new - old, 9)) for after, (old, new) in steps]

    def scene_of(self, release: Release, title: str = "", *, whole: bool = False) -> Scene:
        """The scene of a release; `whole` keeps steps that change nothing, for a sweep."""
        base = self.scene
        stiffness = HAND_RATE**2 * self.mass_kg
        pushes = [(0.0, release.held_n)]
        pushes += [(at, step) for at, step in self._pushes(release) if whole or step != 0.0]
        bounds = self.bounds
        latest_s = bounds.decay_s + bounds.steps * bounds.longest_s if whole else max(release.after_s, default=0.0)
        lasts_s = self.at_s + latest_s + self.after_s
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
                pushers=tuple(PusherTable(at_s=at_s, force_n=self._along(force_n)) for at_s, force_n in pushes)
            ),
            link=link,
            coupling=base.coupling,
            security=None,
            safety=base.safety,
        )

    def _along(self, force_n: float) -> "float | tuple[float, ...]":
        """A force along the lightest axis."""
        if self.axes == 1:
            return force_n
        return tuple(force_n if axis == self.axis else 0.0 for axis in range(self.axes))
