"""Runs without signals, whose sides do some ticks in a row, end like runs with signals, whose sides take turns."""

import msgspec
import pytest

from haptether.bridge import Scene, load_scene, override_scene, scene_names, simulate

pytestmark = pytest.mark.slow

MAX_S = 3.0


def remote() -> list[tuple[str, list[str]]]:
    """Return every shipped scene with an arm, and two with more parts."""
    found: list[tuple[str, list[str]]] = [
        (name, []) for name in scene_names(attacks=True) if load_scene(name).slave is not None
    ]
    more = [("felt_trigger", ["safety.gripper.controllers=[wsc]"]), ("pick_and_place", ["security.secure=true"])]
    return [*found, *more]


def without_signals(scene: Scene) -> Scene:
    return msgspec.structs.replace(scene, record=None)


def counted(report: object) -> object:
    """Return the values of a report, recursively."""
    if not type(report).__module__.startswith("haptether"):
        return report
    return {name: counted(getattr(report, name)) for name in dir(report) if not name.startswith("_")}


@pytest.mark.parametrize(("name", "overrides"), remote())
def test_a_run_without_signals_is_that_with_them(name: str, overrides: list[str]) -> None:
    scene = load_scene(name, overrides)
    scene = override_scene(scene, [f"run.duration_s={min(MAX_S, scene.run.duration_s)}"])
    in_turn = simulate(override_scene(scene, ["record.every=1"]))
    in_a_row = simulate(without_signals(scene))
    assert in_a_row.events == in_turn.events
    wall_time_s = in_turn.metrics.wall_time_s
    assert msgspec.structs.replace(in_a_row.metrics, wall_time_s=wall_time_s) == in_turn.metrics
    assert in_turn.reports is not None
    assert in_a_row.reports is not None
    assert [*map(counted, in_a_row.reports)] == [*map(counted, in_turn.reports)]
