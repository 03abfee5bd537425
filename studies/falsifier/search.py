"""Search for the worst release, and for the simplest one that is nearly as bad."""

import importlib
import importlib.util
import itertools
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import numpy.typing as npt
from msgspec import Struct
from msgspec.structs import replace

from haptether.bridge import Scene, override_scene, simulate, sweep
from haptether.extras import require
from haptether.safety import EjectionBound, ejection_bound, rising_push
from haptether.studies.falsifier.release import STRONGEST, Release, ReleaseBounds, Releases

Array = npt.NDArray[np.float64]

POPULATION = 48
"""Releases per generation, which fills the lanes of the batch engine."""
SPREAD = 0.3
"""Initial spread as a fraction of each value's range."""
NEAR = 0.1
"""Initial spread of a search that starts at a known bad release."""
STALLED = 30
"""Generations without improvement before a restart."""
KEPT = 0.98
"""Fraction of the speed that a simpler release must keep."""
DIGITS = 3


class Falsified(Struct, frozen=True, kw_only=True):
    """Worst release found, and its distance to the bound."""

    scene: Scene
    """Release as a simplified scene."""
    release: Release
    """Release as numbers."""
    speed: float
    """Largest speed in m/s of `scene` after the release."""
    worst: float
    """Largest speed in m/s of all tried releases."""
    bound: EjectionBound
    """Bound on the speed of any release."""
    margin: float | None
    """Bound minus `worst` in m/s; negative if exceeded, None without a bound."""
    tried: int
    """Number of tried releases."""
    seed: int
    interrupted: bool
    """True if the user ended the search."""


def falsify(
    scene: Scene,
    *,
    controllers: tuple[str, ...] | None = None,
    bounds: ReleaseBounds | None = None,
    seconds: float = 60.0,
    tries: int | None = None,
    seed: int = 1,
    threads: int | None = None,
    progress: Callable[[int, float], None] | None = None,
) -> Falsified:
    """Search for the release that makes a scene's device fastest, by CMA-ES with restarts.

    Device, loop, link, arm and safety come from the scene; hand and push are searched within bounds.

    Args:
        scene: Scene under test.
        controllers: Active controllers; by default those of the scene.
        bounds: Bounds of hand, push and link; by default `ReleaseBounds()`.
        seconds: Duration of the search; the simplification takes at most as long again.
        tries: Number of releases that also ends the search; the result then depends only on the seed.
        seed: Seed of the search, 1 or more.
        threads: Number of threads; by default the number of processors.
        progress: If given, called with the number of tried releases and the largest speed in m/s.

    Raises:
        SceneError: The scene has no such releases, or is invalid.
        ValueError: A value is out of bounds.
        ImportError: cma (extra `analysis`) is not installed.

    Source: Hansen and Ostermeier 2001 (CMA-ES); Zeller and Hildebrandt 2002 (shrinking by removal of parts).
    """
    for name, value in (("seed", seed), ("tries", tries)):
        if value is not None and value < 1:
            message = f"{name} = {value}: must be 1 or more"
            raise ValueError(message)
    if not seconds > 0.0:
        message = f"seconds = {seconds}: must be above 0"
        raise ValueError(message)
    if controllers is not None:
        scene = override_scene(scene, [f"safety.controllers=[{','.join(controllers)}]"])
    bounds = bounds or ReleaseBounds()
    bound = ejection_bound(scene, free_s=Releases(scene, bounds).free_s)
    if bounds.push == "auto":
        bounds = replace(bounds, push="steady" if bound.controller == "hsc" else "any")
    search = _Search(Releases(scene, bounds), threads, progress)
    begun = time.perf_counter()

    def is_over() -> bool:
        return time.perf_counter() - begun >= seconds or (tries is not None and search.tried >= tries)

    interrupted = False
    try:
        search.run(seed, is_over)
    except KeyboardInterrupt:
        interrupted = True
    if search.best is None:
        message = "it was ended before the first releases had been tried"
        raise RuntimeError(message)
    release, found = search.best, search.speed
    try:
        release = search.simplified(found, time.perf_counter() + seconds)
    except KeyboardInterrupt:
        interrupted = True
    said = f"Worst release found against {' + '.join(scene.safety.controllers) or 'nobody'}"
    simple = search.releases.scene_of(release, said)
    seen = simulate(simple).metrics.max_ejection_velocity
    return Falsified(
        scene=simple,
        release=release,
        speed=seen or 0.0,
        worst=max(found, seen or 0.0),
        bound=bound,
        margin=None if bound.speed is None else bound.speed - max(found, seen or 0.0),
        tried=search.tried,
        seed=seed,
        interrupted=interrupted,
    )


class _Search:
    """Best release so far, and state of the search."""

    def __init__(self, releases: Releases, threads: int | None, progress: Callable[[int, float], None] | None) -> None:
        self.releases, self.threads, self.progress = releases, threads, progress
        self.best: Release | None = None
        self.numbers: Array = np.zeros(releases.size)
        self.speed = 0.0
        self.tried = 0
        self.rising = () if releases.bounds.push == "steady" else rising_push(releases.scene)

    def speeds(self, tried: list[Release]) -> Array:
        """Return the speed of each release in m/s; 0 if not measured."""
        base = self.releases.scene_of(tried[0], whole=True)
        wanted = "max_ejection_velocity"
        seen = sweep(base, samples=self.releases.samples(tried), threads=self.threads, metrics=[wanted])[wanted]
        found: Array = np.nan_to_num(np.asarray(seen, dtype=np.float64))
        self.tried += len(tried)
        place = int(np.argmax(found))
        if self.best is None or found[place] > self.speed:
            self.best, self.speed = tried[place], float(found[place])
        if self.progress is not None:
            self.progress(self.tried, self.speed)
        return found

    def run(self, seed: int, is_over: Callable[[], bool]) -> None:
        """Restart at different points until the search is over."""
        require("a search", "cma")
        cma: Any = importlib.import_module("cma")
        rng = np.random.default_rng(seed)
        while self.best is None or not is_over():
            start, spread = self._start(rng)
            options = {
                "bounds": [0.0, 1.0],
                "popsize": POPULATION,
                "seed": int(rng.integers(1, 2**31)),
                "verbose": -9,
                "verb_log": 0,
                "verb_disp": 0,
            }
            strategy = cma.CMAEvolutionStrategy(start, spread, options)
            best, since = 0.0, 0
            while (self.best is None or not is_over()) and since < STALLED and not strategy.stop():
                numbers = strategy.ask()
                before = self.speed
                speeds = self.speeds([self.releases.of(each) for each in numbers])
                if self.speed > before:
                    self.numbers = np.asarray(numbers[int(np.argmax(speeds))])
                strategy.tell(numbers, (-speeds).tolist())
                since = 0 if speeds.max() > best * 1.001 else since + 1
                best = max(best, float(speeds.max()))

    def _start(self, rng: np.random.Generator) -> tuple[Array, float]:
        """Return start and spread of a search: random, alternating, by the bound's worst push, or near the best."""
        kind = rng.integers(4)
        if kind == 0 and self.best is not None:
            return self._near_the_best(rng), NEAR
        if kind == 1 and len(self.rising):
            return self._rising(rng), NEAR
        start = rng.uniform(0.1, 0.9, self.releases.size)
        start[:3] = (0.9, 0.1, 0.9)
        steps = self.releases.bounds.steps
        if kind == 2:
            start[3 : 3 + steps] = rng.uniform(0.1, 0.5)
            start[3 + steps : 3 + 2 * steps] = np.where((np.arange(steps) + rng.integers(2)) % 2 == 0, 0.1, 0.9)
        return start, SPREAD

    def _near_the_best(self, rng: np.random.Generator) -> Array:
        """Return the best release so far with an additional step to vary."""
        assert self.best is not None
        release = self.best
        steps = self.releases.bounds.steps
        ends = (release.decay_s, *release.after_s)
        place = int(rng.integers(steps))
        level = (release.held_n, *release.level_n)[place]
        after = rng.uniform(ends[place], ends[place + 1]) if place + 1 < len(ends) else ends[-1]
        added = replace(
            release,
            after_s=(*release.after_s[:place], float(after), *release.after_s[place:])[:steps],
            level_n=(*release.level_n[:place], level, *release.level_n[place:])[:steps],
        )
        numbers = self.releases.numbers(added)
        beyond = 3 + 2 * steps
        # Keep direction and link.
        numbers[beyond:] = self.numbers[beyond:]
        return numbers

    def _rising(self, rng: np.random.Generator) -> Array:
        """Return a push that brings the device near its threshold, then the one with the largest lead of V over V^."""
        releases = self.releases
        cap_n, period_s = releases.cap_n, releases.scene.run.period_s
        slow_n, lasts_s = cap_n * rng.uniform(-0.1, 1.0) ** 3, rng.uniform(0.0, 0.1) ** 2 * 10.0
        times, levels = [0.0], [slow_n]
        for tick, (old, new) in enumerate(itertools.pairwise((0.0, *self.rising))):
            # A growing force is requested at once.
            if np.sign(new) != np.sign(old):
                times.append(lasts_s + tick * period_s)
                levels.append(cap_n * float(np.sign(new)))
        room = releases.bounds.steps
        times, levels = times[:1] + times[1:][1 - room :], levels[:1] + levels[1:][1 - room :]
        release = Release(
            held_n=cap_n * rng.uniform(0.1, 1.0),
            decay_s=0.0,
            margin=STRONGEST,
            after_s=tuple(times),
            level_n=tuple(levels),
        )
        return releases.numbers(release)

    def simplified(self, speed: float, until_s: float) -> Release:
        """Return the simplest release that keeps most of a speed, by repeated removal of parts and rounding.

        Args:
            speed: Speed in m/s.
            until_s: Deadline by `time.perf_counter`.
        """
        assert self.best is not None
        release, least = self.best, KEPT * speed
        while True:
            simpler = [
                each
                for each in _simpler(release, self.releases.cap_n)
                if _parts(each) < _parts(release) and each.decay_s <= min(each.after_s, default=0.0)
            ]
            if not simpler or time.perf_counter() >= until_s:
                return _without_idle_steps(release)
            kept = [each for each, seen in zip(simpler, self.speeds(simpler), strict=True) if seen >= least]
            if not kept:
                return _without_idle_steps(release)
            release = min(kept, key=_parts)


def _without_idle_steps(release: Release) -> Release:
    """Return the release without ineffective steps."""
    steps = zip(release.after_s, itertools.pairwise((release.held_n, *release.level_n)), strict=True)
    kept = [(after, new) for after, (old, new) in steps if new != old]
    return replace(release, after_s=tuple(after for after, _ in kept), level_n=tuple(new for _, new in kept))


def _parts(release: Release) -> float:
    """Return the complexity of a release: steps, then digits."""
    levels = (release.held_n, *release.level_n)
    steps = sum(new != old for old, new in itertools.pairwise(levels))
    numbers = (
        release.decay_s,
        release.margin,
        *release.after_s,
        *levels,
        *release.delay_s,
        release.jitter_s,
        release.loss,
    )
    return 100.0 * steps + sum(len(f"{number:.12g}".strip("0.")) for number in numbers)


def _simpler(release: Release, cap_n: float) -> Iterator[Release]:
    """Yield the releases that are one step simpler."""
    levels = (release.held_n, *release.level_n)
    for place in range(1, len(levels)):
        if levels[place] != levels[place - 1]:
            # Remove a step: keep the previous level, also for following equal ones.
            changed = list(levels)
            old = changed[place]
            for later in range(place, len(levels)):
                if changed[later] != old:
                    break
                changed[later] = changed[place - 1]
            yield replace(release, level_n=tuple(changed[1:]))
    whole = tuple(_nearest(level, (-cap_n, 0.0, cap_n)) for level in release.level_n)
    yield replace(release, level_n=whole)
    for place, level in enumerate(release.level_n):
        for near in (_nearest(level, (-cap_n, 0.0, cap_n)), _rounded(level)):
            changed = list(release.level_n)
            changed[place] = near
            yield replace(release, level_n=tuple(changed))
        after = list(release.after_s)
        after[place] = round(after[place], 3)
        yield replace(release, after_s=tuple(after))
    yield replace(release, after_s=tuple(round(after, 3) for after in release.after_s))
    yield replace(release, held_n=cap_n)
    yield replace(release, held_n=_rounded(release.held_n))
    yield replace(release, decay_s=0.0, margin=STRONGEST)
    yield replace(release, decay_s=round(release.decay_s, 3))
    yield replace(release, margin=_rounded(release.margin))
    yield replace(release, delay_s=(0.0, 0.0), jitter_s=0.0, loss=0.0)
    yield replace(release, jitter_s=0.0)
    yield replace(release, loss=0.0)
    yield replace(release, delay_s=(0.0, release.delay_s[1]), jitter_s=0.0)
    yield replace(release, delay_s=(round(release.delay_s[0], 3), round(release.delay_s[1], 3)))


def _nearest(level: float, levels: tuple[float, ...]) -> float:
    return min(levels, key=lambda one: abs(one - level))


def _rounded(value: float) -> float:
    """Round to three digits."""
    return float(f"{value:.{DIGITS}g}")
