"""Any valid scene runs, gives numbers, and gives the same ones again: alone, in threads and in lanes."""

import math
from typing import Any

import msgspec
import numpy as np
import pytest
from hypothesis import HealthCheck, assume, example, given, seed, settings
from hypothesis import strategies as st
from tests.scene.strategies import Raw, raw_scenes, real, scenes

from haptether.bridge import Run, Scene, SceneError, simulate, sweep

pytestmark = pytest.mark.slow

EXAMPLES = 1000
SEED = 20260
SLOW = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much])

OBSERVED_BY = {"velocity_force": "vfc", "grasp": "hsc", "windowed_energy_j": "wsc", "energy_j": "pc"}
"""Signals that are NaN unless their controller watches."""


def bad_numbers(run: Run, scene: Scene) -> list[str]:
    """Signals and metrics that are no numbers where they must be."""
    bad = []
    for name, signal in run.signals.items():
        finite = np.isfinite(signal)
        if name == "age_s":
            # Before the first frame there is none.
            finite |= np.isnan(signal) & (np.cumsum(finite) == 0)
        elif name in OBSERVED_BY and OBSERVED_BY[name] not in scene.safety.controllers:
            finite |= np.isnan(signal)
        if not finite.all():
            bad.append(name)
    metrics: dict[str, Any] = msgspec.to_builtins(run.metrics)
    return bad + [name for name, value in metrics.items() if isinstance(value, float) and not math.isfinite(value)]


def check(run: Run, scene: Scene) -> None:
    """What holds of every run."""
    assert bad_numbers(run, scene) == []
    ends = [event for event in run.events if event.kind == "diverged"]
    assert run.metrics.diverged == bool(ends)
    assert run.metrics.ticks <= round(scene.run.duration_s / scene.run.period_s) + 1
    if ends:
        (end,) = ends
        assert end.time_s == max(event.time_s for event in run.events)
        assert end.time_s <= (run.metrics.ticks + 1) * scene.run.period_s
        assert end.detail
    else:
        assert not any(event.kind == "fault" for event in run.events)


def fingerprint(run: Run) -> tuple[dict[str, bytes], tuple[object, ...], dict[str, Any]]:
    """All of a run but how long it took."""
    metrics = msgspec.to_builtins(run.metrics)
    del metrics["wall_time_s"]
    return {name: signal.tobytes() for name, signal in run.signals.items()}, run.events, metrics


def scene_of(**tables: Any) -> Raw:  # noqa: ANN401  # tables as TOML has them
    return {"schema": 1, "record": {}, **tables}


@seed(SEED)
@settings(SLOW, max_examples=EXAMPLES, derandomize=False, database=None)
@given(raw=raw_scenes())
# A release that ends a rounding before a tick, where less was left of the tick than the clock can tell.
@example(
    raw=scene_of(
        run={"duration_s": 0.1, "period_s": 5e-3},
        master={"mass_kg": 0.1},
        operator={
            "start": 0.01,
            "legs": [{"duration_s": 0.1, "end": 0.0}],
            "release": {"at_s": 0.0, "decay_s": 0.04, "kind": "gain"},
        },
    )
)
# A speed whose square is 0: friction along it had no direction.
@example(
    raw=scene_of(
        run={"duration_s": 0.05, "period_s": 5e-3}, master={"device": "phantom-omni", "axes": 3, "velocity": 1e-256}
    )
)
# Friction whose direction turned faster than its series said.
@example(
    raw=scene_of(
        run={"duration_s": 0.4, "period_s": 2e-3},
        master={"device": "phantom-desktop", "axes": 3, "coulomb": 0.07448222660652905},
        operator={
            "start": [0.0, 7.487637331828287e-150, 0.0],
            "legs": [{"duration_s": 0.08333764190232808, "end": 0.0227403702885714}],
        },
    )
)
def test_any_valid_scene_gives_numbers(raw: Raw) -> None:
    scene = msgspec.convert(raw, Scene)
    check(simulate(scene), scene)


@seed(SEED)
@settings(SLOW, max_examples=60, derandomize=False, database=None)
@given(scene=scenes())
def test_the_same_scene_gives_the_same_bytes(scene: Scene) -> None:
    assert fingerprint(simulate(scene)) == fingerprint(simulate(scene))


@st.composite
def grids(draw: st.DrawFn, scene: Scene) -> dict[str, list[float]]:
    """Values for two or three numbers that the scene has."""
    ranges = {
        "master.mass_kg": (0.05, 2.0),
        "safety.velocity_threshold": (0.01, 2.0),
        "safety.energy_threshold_j": (-0.1, -1e-4),
        "safety.hold_off_s": (0.0, 0.3),
    }
    if scene.operator is not None:
        ranges |= {"operator.stiffness": (10.0, 1000.0), "operator.damping": (0.1, 20.0)}
    if scene.environment is not None and scene.environment.objects:
        ranges["environment.objects.0.contact.stiffness"] = (0.0, 3000.0)
    if scene.slave is not None:
        ranges |= {"coupling.force_scale": (0.1, 5.0), "slave.mass_kg": (0.1, 10.0)}
    paths = draw(st.lists(st.sampled_from(sorted(ranges)), min_size=2, max_size=3, unique=True))
    return {path: draw(st.lists(real(*ranges[path]), min_size=2, max_size=3, unique=True)) for path in paths}


@pytest.mark.parametrize("shared", [True, False])
@seed(SEED)
@settings(SLOW, max_examples=50, derandomize=False, database=None)
@given(data=st.data())
def test_a_sweep_is_its_rows_whatever_carries_them(shared: bool, data: st.DataObject) -> None:
    scene = data.draw(scenes(shared=shared))
    grid = data.draw(grids(scene))
    try:
        alone = sweep(scene, grid, threads=1, lanes=False)
    except SceneError:
        # Numbers that do not go together, such as a mass that is a list.
        assume(False)
    for threads, lanes in ((2, False), (1, True), (2, True)):
        other = sweep(scene, grid, threads=threads, lanes=lanes)
        assert list(other.columns) == list(alone.columns)
        for name, column in alone.columns.items():
            assert column.tobytes() == other[name].tobytes(), (name, threads, lanes)
    for row in list(alone.rows())[:4]:
        run = simulate(scene, overrides=[f"{path}={row[path]!r}" for path in grid])
        metrics = msgspec.to_builtins(run.metrics)
        for name in set(metrics) & set(row):
            assert row[name] == metrics[name] or (name == "diverged" and row[name] is None), name
