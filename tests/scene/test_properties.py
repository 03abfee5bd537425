"""Any valid scene runs, gives finite results, and gives the same ones again: alone, in threads and in lanes."""

import math
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import HealthCheck, assume, example, given, seed, settings
from hypothesis import strategies as st
from tests.faults.signals import ALIGNING, ENGAGED, STALE
from tests.scene.poses import is_rigid, raw_poses
from tests.scene.strategies import Raw, raw_scenes, real, scenes

from haptether.bridge import Run, Scene, SceneError, simulate, sweep
from haptether.bridge.scene.tables.session import CouplingTable

Array = npt.NDArray[np.float64]

pytestmark = pytest.mark.slow

EXAMPLES, POSES, SWEEPS = (400, 100, 20) if settings().max_examples < 1000 else (4000, 2000, 200)
"""Number of examples of the profiles `fast` and `slow`."""
SEED = 20260
SLOW = settings(suppress_health_check=[HealthCheck.too_slow, HealthCheck.data_too_large, HealthCheck.filter_too_much])

OBSERVED_BY = {"velocity_force": "vfc", "grasp": "hsc", "windowed_energy_j": "wsc", "energy_j": "pc"}
"""Signals that are NaN unless their controller watches."""


def bad_numbers(run: Run, scene: Scene) -> list[str]:
    """Return the signals and metrics that are not finite where they must be."""
    bad = []
    for name, signal in run.signals.items():
        finite = np.isfinite(signal)
        if name == "age_s":
            # There is no age before the first frame.
            finite |= np.isnan(signal) & (np.cumsum(finite) == 0)
        elif name == "exerted_force":
            # There is none while the arm follows a position.
            finite |= np.isnan(signal)
        elif name == "gripper_command":
            # There is no command before the first one.
            finite |= np.isnan(signal) & (np.cumsum(finite) == 0)
        elif name in OBSERVED_BY and OBSERVED_BY[name] not in scene.safety.controllers:
            finite |= np.isnan(signal)
        if not finite.all():
            bad.append(name)
    metrics: dict[str, Any] = msgspec.to_builtins(run.metrics)
    return bad + [name for name, value in metrics.items() if isinstance(value, float) and not math.isfinite(value)]


def check(run: Run, scene: Scene) -> None:
    """Assert the properties of every run."""
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
    """Return the whole run except its duration."""
    metrics = msgspec.to_builtins(run.metrics)
    del metrics["wall_time_s"]
    return {name: signal.tobytes() for name, signal in run.signals.items()}, run.events, metrics


def scene_of(**tables: Any) -> Raw:  # noqa: ANN401  # tables as TOML has them
    return {"schema": 1, "record": {}, **tables}


@seed(SEED)
@settings(SLOW, max_examples=EXAMPLES, derandomize=False, database=None)
@given(raw=raw_scenes())
# A release that ends within rounding before a tick: the rest of the tick was below the resolution of the clock.
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
# The square of this speed underflows to 0: friction had no direction.
@example(
    raw=scene_of(
        run={"duration_s": 0.05, "period_s": 5e-3}, master={"device": "phantom-omni", "axes": 3, "velocity": 1e-256}
    )
)
# Friction whose direction turned faster than its series predicted.
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


# ---------------------------------------------------------------------------------------------------------- poses

ROUNDING = 1e-9
ANGLE = 1e-7
"""Rounding in rad of an angle near 0."""
LONGEST_FADE_S = 0.1


def turns(signal: Array, by: int = 1) -> Array:
    """Return the angles in rad between orientations `by` ticks apart."""
    products = np.abs(np.sum(signal[by:] * signal[:-by], axis=1))
    turned: Array = 2.0 * np.arccos(np.minimum(products, 1.0))
    return turned


def number(bound: float | str) -> float:
    return math.inf if isinstance(bound, str) else bound


def check_hand(run: Run, scene: Scene) -> None:
    """Assert zero force and torque on an uncoupled hand, and bounded ones otherwise."""
    signals = run.signals
    coupled = np.isin(signals["state"], [ENGAGED, STALE])
    ticks = np.arange(len(coupled))
    last = np.maximum.accumulate(np.where(coupled, ticks, -1))
    faded = (ticks - last) * scene.run.period_s > LONGEST_FADE_S + 2.0 * scene.run.period_s
    faded |= last < 0
    for name in {"device_force", "device_torque", "trigger_device_force"} & set(signals):
        assert not signals[name][faded].any(), name
    rotation, limiter = scene.safety.rotation, scene.safety.limiter
    if limiter.enabled and rotation is not None and rotation.max_torque_n_m is not None:
        torque = np.linalg.norm(signals["device_torque"], axis=1)
        assert torque.max(initial=0.0) <= rotation.max_torque_n_m * (1.0 + ROUNDING)


def check_finger(run: Run, scene: Scene) -> None:
    """Assert that a felt trigger only opens, at most by its scale of the jaw force, and within its bounds."""
    assert ("trigger_device_force" in run.signals) == (scene.master.gripper is not None)
    trigger = scene.master.gripper
    if trigger is None or "gripper_force" not in run.signals:
        return
    rendered, force = run.signals["trigger_rendered_force"], run.signals["trigger_device_force"]
    strongest = np.nan_to_num(run.signals["gripper_force"]).max(initial=0.0)
    assert rendered.max(initial=0.0) <= 0.0
    assert rendered.min(initial=0.0) >= -trigger.force_scale * strongest * (1.0 + ROUNDING)
    assert np.abs(force).max(initial=0.0) <= trigger.max_force_n * (1.0 + ROUNDING)
    # Only the bound on the power may speed its growth up beyond its own bound; unloading is free.
    grows = np.abs(rendered[1:]) - np.abs(rendered[:-1])
    assert grows.max(initial=0.0) <= trigger.max_slew_n_per_s * scene.run.period_s * (1.0 + 1e-6) + ROUNDING


def check_alignment(run: Run, coupling: CouplingTable) -> None:
    """Assert that before engagement the arm turns at most at the alignment's speed, about a fixed point."""
    signals = run.signals
    aligning = signals["slave_state"] == ALIGNING
    command, tool = signals["slave_command_orientation"], signals["slave_orientation"]
    # Before the first command it equals the tool's orientation.
    commanded = (command != tool).any(axis=1)
    turning = aligning[1:] & aligning[:-1] & commanded[:-1]
    if coupling.alignment is None:
        assert (command[1:] == command[:-1])[turning].all()
        return
    elapsed_s = np.diff(signals["slave_time_s"])
    assert (turns(command) <= coupling.alignment.speed * elapsed_s * (1.0 + 1e-6) + ANGLE)[turning].all()
    point = signals["slave_command"]
    assert (point[1:] == point[:-1])[turning].all()


def check_arm(run: Run, scene: Scene) -> None:
    """Assert that commands are orientations within the bounds of speed and turn, and constant while nobody leads."""
    signals = run.signals
    if "slave_state" not in signals:
        # The run diverged at its first tick.
        return
    assert scene.slave is not None
    coupling = scene.coupling or CouplingTable()
    period_s = scene.slave.period_s or scene.run.period_s
    speed, turn = number(coupling.command_angular_speed), number(coupling.command_turn)
    state, command = signals["slave_state"], signals["slave_command_orientation"]
    coupled = np.isin(state, [ENGAGED, STALE])
    # A record has one tick or several, as many as the master's ticks.
    elapsed_s = np.diff(signals["slave_time_s"])
    # Before the first command it equals the tool's orientation.
    began = np.cumsum(coupled) > 0
    led = began[:-1] & coupled[1:]
    assert (turns(command) <= speed * elapsed_s * (1.0 + 1e-6) + ANGLE)[led].all()
    stays = began[:-1] & ~coupled[1:] & (state[1:] == state[:-1]) & (state[1:] != ALIGNING)
    assert (command[1:] == command[:-1])[stays].all()
    check_alignment(run, coupling)
    if turn < math.pi and speed < math.inf:
        # A stop comes to rest at its current set point, at most one period further.
        first = np.broadcast_to(signals["slave_orientation"][0], command.shape)
        out = turns(np.stack([first, command], axis=1).reshape(-1, 4))[::2]
        assert out[began].max(initial=0.0) <= turn + speed * period_s + ANGLE
    if (gripper := scene.slave.gripper) is not None:
        orders = signals["gripper_command"]
        known = orders[~np.isnan(orders)]
        assert ((known >= 0.0) & (known <= 1.0)).all()
        way = np.nan_to_num(np.abs(np.diff(orders)))
        assert (way <= gripper.speed * elapsed_s * (1.0 + 1e-6) + ROUNDING).all()
        assert not way[~coupled[1:] & ~coupled[:-1]].any()


def orientations(run: Run) -> list[str]:
    """Return the names of the orientation signals."""
    return [name for name in run.signals if name.endswith("orientation")]


def simulated(raw: Raw) -> Run | None:
    """Run a valid scene; return None if the expected field is refused."""
    try:
        return simulate(msgspec.convert(raw, Scene))
    except SceneError as error:
        bodies = [raw["master"]["rotation"], raw["slave"]["tool"]]
        rigid = all(is_rigid(body["inertia_kg_m2"]) for body in bodies)
        place = "slave or environment: rate of tool and world" if rigid else "inertia_kg_m2 = "
        if place not in str(error):
            raise
        return None


@seed(SEED)
@settings(SLOW, max_examples=POSES, derandomize=False, database=None)
@given(raw=raw_poses())
def test_any_scene_of_poses_runs_or_is_refused_by_its_place(raw: Raw) -> None:
    run = simulated(raw)
    if run is None:
        return
    scene = msgspec.convert(raw, Scene)
    check(run, scene)
    for name in orientations(run):
        norms = np.linalg.norm(run.signals[name].reshape(-1, 4), axis=1)
        assert np.abs(norms - 1.0).max(initial=0.0) <= ROUNDING, name
    check_hand(run, scene)
    check_finger(run, scene)
    check_arm(run, scene)


@seed(SEED)
@settings(SLOW, max_examples=60, derandomize=False, database=None)
@given(raw=raw_poses())
def test_the_same_scene_of_poses_gives_the_same_bytes(raw: Raw) -> None:
    run, again = simulated(raw), simulated(raw)
    assert (run is None) == (again is None)
    assert run is None or again is None or fingerprint(run) == fingerprint(again)


@st.composite
def grids(draw: st.DrawFn, scene: Scene) -> dict[str, list[float]]:
    """Draw values for two or three numbers of the scene."""
    ranges = {
        "master.mass_kg": (0.05, 2.0),
        "safety.velocity_threshold": (0.01, 2.0),
        "safety.energy_threshold_j": (-0.1, -1e-4),
        "safety.hold_off_s": (0.0, 0.3),
    }
    if scene.operator is not None and scene.operator.aims is None:
        # Aims replace the numbers of the hand.
        ranges |= {"operator.stiffness": (10.0, 1000.0), "operator.damping": (0.1, 20.0)}
    if scene.environment is not None and scene.environment.objects:
        ranges["environment.objects.0.contact.stiffness"] = (0.0, 3000.0)
    if scene.slave is not None:
        ranges |= {"coupling.force_scale": (0.1, 5.0), "slave.mass_kg": (0.1, 10.0)}
    paths = draw(st.lists(st.sampled_from(sorted(ranges)), min_size=2, max_size=3, unique=True))
    return {path: draw(st.lists(real(*ranges[path]), min_size=2, max_size=3, unique=True)) for path in paths}


@pytest.mark.parametrize("arm", [True, False])
@seed(SEED)
@settings(SLOW, max_examples=SWEEPS, derandomize=False, database=None)
@given(data=st.data())
def test_a_sweep_is_its_rows_whatever_carries_them(arm: bool, data: st.DataObject) -> None:
    scene = data.draw(scenes(arm=arm))
    grid = data.draw(grids(scene))
    try:
        alone = sweep(scene, grid, threads=1, lanes=False)
    except SceneError:
        # The numbers contradict each other, for example a mass that is a list.
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
