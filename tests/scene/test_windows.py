"""Time windows of a scene: they include their first ns and end before their last, despite rounding."""

from typing import Any

import msgspec
import numpy as np
import pytest

from haptether.bridge import Run, Scene, simulate

BALL = {"shape": {"kind": "sphere", "centre": 5.0, "radius": 0.1}, "contact": {"stiffness": 1.0}}
ENGINES: dict[str, dict[str, Any]] = {
    "exact, plain": {},
    "exact, any objects": {"environment": {"objects": [BALL]}},
    "arm": {"slave": {}},
    "arm of velocity": {"slave": {"control": "velocity"}},
    "arm at 2 ms": {"slave": {"period_s": 2e-3}},
}
WINDOWS_MS = [(100, 200), (100, 700), (200, 100), (300, 300), (70, 20), (1, 1), (10, 290), (600, 138)]
"""Begin and length in ms. In binary, 0.1 s + 0.2 s is above 0.3 s, and 0.1 s + 0.7 s below 0.8 s."""


def pushed(engine: str, *pushers: dict[str, Any], duration_s: float = 0.9) -> Run:
    changed = ENGINES[engine]
    raw = {
        "schema": 1,
        "master": {"mass_kg": 0.5, "encoder_quantum": 0.0},
        "operator": {},
        "record": {},
        **changed,
        "run": {"duration_s": duration_s, **changed.get("run", {})},
        "environment": {**changed.get("environment", {}), "pushers": list(pushers)},
        "safety": {"limiter": {"enabled": False}},
    }
    return simulate(msgspec.convert(raw, Scene))


def ticks_ms(run: Run) -> list[int]:
    """Return the times in ms of the ticks at which the push acts, from the start of the pushers' time."""
    if "environment_force" not in run.signals:
        return [round(t) for t in run.signals.time_s[np.ravel(run.signals.rendered_force) != 0.0] * 1e3]
    engaged_s = next(event.time_s for event in run.events if event.kind == "engaged" and "slave" in event.detail)
    force = np.ravel(run.signals.environment_force)
    return [round(t) for t in (run.signals.slave_time_s[force != 0.0] - engaged_s) * 1e3]


@pytest.mark.parametrize("engine", ENGINES)
def test_a_push_lasts_as_many_ticks_as_it_says(engine: str) -> None:
    for at_ms, lasts_ms in WINDOWS_MS:
        run = pushed(engine, {"at_s": at_ms / 1000, "duration_s": lasts_ms / 1000, "force_n": 0.25})
        step = 2 if "2 ms" in engine else 1
        first = at_ms + at_ms % step
        assert ticks_ms(run) == list(range(first, at_ms + lasts_ms, step)), (at_ms, lasts_ms)


@pytest.mark.parametrize("engine", ENGINES)
def test_pushes_that_follow_one_another_are_one(engine: str) -> None:
    """Each tick belongs to exactly one of two consecutive pushes."""
    parts = [{"at_s": k / 10, "duration_s": 0.1, "force_n": 0.25} for k in range(1, 8)]
    whole, split = pushed(engine, {"at_s": 0.1, "duration_s": 0.7, "force_n": 0.25}), pushed(engine, *parts)
    name = "environment_force" if "environment_force" in whole.signals else "rendered_force"
    assert np.array_equal(whole.signals[name], split.signals[name])
    # The solver's steps end where a part ends: the difference is the rounding of some 1000 steps.
    assert np.abs(whole.signals.position - split.signals.position).max() < 1e-12


@pytest.mark.parametrize("at_s", [0.1, 0.3, 0.6, 0.7])
def test_a_hand_that_grips_at_once_does_so_at_its_tick(at_s: float) -> None:
    """Release, fall and reaction of 0.1 s + 0.2 s + 0.3 s end at the same tick as 0.6 s."""
    raw = {
        "schema": 1,
        "run": {"duration_s": 1.5},
        "master": {"mass_kg": 0.5, "position": 0.01},
        "operator": {
            "grip_strength_n": 2.0,
            "release": {"at_s": at_s, "decay_s": 0.2},
            "regrasp": {"reaction_s": 0.3, "rise_s": 0.0},
        },
        "record": {},
    }
    run = simulate(msgspec.convert(raw, Scene))
    held = np.ravel(run.signals.hand_force) != 0.0
    grips_ms = round(at_s * 1000) + 500
    assert not held[grips_ms - 1]
    assert held[grips_ms]


def test_times_of_ticks_are_the_numbers_that_a_scene_writes() -> None:
    for engine in ("exact, plain", "arm"):
        run = pushed(engine, duration_s=0.9)
        assert run.signals.time_s.tolist() == [n / 1000 for n in range(len(run.signals.time_s))]
