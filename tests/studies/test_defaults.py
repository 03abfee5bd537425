"""Default thresholds of `[safety]`, and the project's own checks of the shipped scenes."""

from math import sqrt

import pytest

from haptether.bridge import Scene, SceneError, load_scene, override_scene, scene_json, scene_names, simulate, sweep
from haptether.bridge.scene.resolve import MEASURED_THRESHOLDS, MEASURED_WSC_SPEED, PAPER_THRESHOLDS, spec_of
from haptether.cli.live.sides import baseline_scene
from haptether.safety import THROWN_SPEED, SafetySettings
from haptether.studies import check_at_once, check_scene, evaluate
from haptether.studies.evaluation.result import EVALUATED_NETWORKS

THRESHOLDS = tuple(PAPER_THRESHOLDS)
PAPER_SCENES = ("paper_wall", "active_force")
STOPS = "master.stops=[-0.08, 0.08]"


def thresholds(scene: Scene) -> dict[str, float | str]:
    safety = spec_of(scene)["safety"]
    return {name: safety[name] for name in THRESHOLDS}


def speed_of(scene: Scene) -> float:
    """Return V_w in m/s: the speed from which WSC trips for a free device."""
    safety, mass_kg = spec_of(scene)["safety"], min(spec_of(scene)["master"]["mass_kg"])
    return sqrt(2.0 * safety["energy_ratio"] * -safety["energy_threshold_j"] / mass_kg)


def bare(*overrides: str) -> Scene:
    return load_scene("paper_wall", ["safety={controllers = [wsc]}", *overrides])


def test_the_preset_of_the_paper_is_that_of_the_safety_crate() -> None:
    paper = thresholds(bare("safety.preset=paper"))
    assert SafetySettings(["wsc"], **paper) == SafetySettings(["wsc"])  # type: ignore[arg-type]
    assert SafetySettings(["wsc"], **{**paper, "window": 99}) != SafetySettings(["wsc"])  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("overrides", "force_n"),
    [([], 0.0), ([STOPS], 0.005), ([STOPS, "master.mass_kg=0.05"], 0.005), ([STOPS, "safety.energy_ratio=0.3"], 0.005)],
)
def test_measured_thresholds_are_the_default_and_follow_from_the_device(overrides: list[str], force_n: float) -> None:
    scene = bare(*overrides)
    assert thresholds(scene) == thresholds(override_scene(scene, ["safety.preset=measured"]))
    assert speed_of(scene) == pytest.approx(MEASURED_WSC_SPEED)
    assert thresholds(scene)["wsc_force_threshold_n"] == force_n
    for name in MEASURED_THRESHOLDS.keys() - {"energy_ratio"}:
        assert thresholds(scene)[name] == MEASURED_THRESHOLDS[name]


@pytest.mark.parametrize("preset", ["measured", "paper"])
def test_a_threshold_that_a_scene_states_is_that_of_no_preset(preset: str) -> None:
    stated = {"energy_threshold_j": -0.017, "window": 33, "hsc_force_threshold_n": 0.0, "wsc_force_threshold_n": 0.07}
    scene = bare(f"safety.preset={preset}", *(f"safety.{name}={value}" for name, value in stated.items()))
    assert thresholds(scene).items() >= stated.items()
    assert b"preset" not in scene_json(scene)


def test_of_joints_the_thresholds_are_those_of_the_paper() -> None:
    scene = bare("master.kind=joints")
    assert thresholds(scene) == dict(PAPER_THRESHOLDS)


def test_a_preset_that_there_is_not_is_refused() -> None:
    with pytest.raises(SceneError, match=r'\[safety\] preset = "papr": must be'):
        bare("safety.preset=papr")


@pytest.mark.parametrize("path", ["master.mass_kg", "safety.energy_ratio"])
def test_a_sweep_has_the_thresholds_that_follow_from_each_row(path: str) -> None:
    values = [0.1, 0.2]
    rows = sweep("remote_push", {path: values})["max_ejection_velocity"]
    alone = [simulate("remote_push", overrides=[f"{path}={value}"]).metrics.max_ejection_velocity for value in values]
    assert rows.tolist() == alone


@pytest.mark.parametrize("name", scene_names())
def test_no_shipped_scene_is_bad_by_design(name: str) -> None:
    """Check the design only. The links take a run of a minute each: docs/choosing.md has their table."""
    scene = load_scene(name)
    assert not [finding.text for finding in check_at_once(scene) if finding.state == "bad"]
    assert (scene.safety.preset == "paper") == (name in PAPER_SCENES)


@pytest.mark.parametrize("controller", ["hsc", "wsc"])
def test_the_live_default_is_stable_and_bounded(controller: str) -> None:
    scene = baseline_scene(controller=controller)  # type: ignore[arg-type]
    found = {finding.name: finding for finding in check_scene(scene, remedies=False).findings}
    assert found["delay margin"].state in {"good", "note"}
    # HSC does not see a push of less than F_t: its bound comes from the travel.
    assert (found["ejection"].state == "good") == (controller == "wsc")


def test_the_shipped_push_trips_no_hand_that_holds_and_throws_none() -> None:
    """Compare: WSC with the paper's thresholds trips 2 and 3 times here, at 0 and at 100 ms."""
    steady = [network for network in EVALUATED_NETWORKS if network.name == "steady"]
    found = evaluate(
        ["remote_push"], controllers=["wsc"], round_trips_s=[0.0, 0.1], networks=steady, hands=2, releases=2
    )
    assert [(cell.false_trips, cell.thrown, cell.undetected) for cell in found.cells] == [(0, 0, 0)] * 2
    assert all(cell.max_speed is not None and cell.max_speed < 0.7 * THROWN_SPEED for cell in found.cells)
