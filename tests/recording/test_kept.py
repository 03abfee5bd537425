"""Contents of a recording, kind by kind. The words of a live driver: `tests/live/test_true_cause.py`."""

from collections.abc import Callable

import numpy as np
import pytest

import haptether
from haptether.bridge import (
    LADDER_STATES,
    OBSERVED_SIGNALS,
    Recording,
    load_scene,
    read_recording,
    scene_json,
    simulate,
    tripped_names,
)

ALL = "safety.controllers=[vfc, hsc, wsc, pc]"
RUNS = {
    "push": ("remote_push", [ALL, "safety.limiter.max_force_n=5", "run.duration_s=3"]),
    "gripper": ("pick_and_place", ["run.duration_s=3"]),
    "felt": ("felt_trigger", ["run.duration_s=3"]),
    "pose": ("peg_in_hole", ["run.duration_s=2"]),
}


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str, str], Recording]:
    """Return a function that returns the recording of one side of a run in virtual time."""
    folder = tmp_path_factory.mktemp("kept")
    made: dict[tuple[str, str], Recording] = {}

    def of(run: str, side: str) -> Recording:
        if (run, side) not in made:
            scene, overrides = RUNS[run]
            paths = folder / f"{run}-master.mcap", folder / f"{run}-slave.mcap"
            simulate(scene, overrides=overrides, record=paths)
            made.update({(run, path.stem.partition("-")[2]): read_recording(path) for path in paths})
        return made[run, side]

    return of


KEPT: dict[str, tuple[str, str, list[str]]] = {
    "what moved, measured and true": ("push", "master", ["position", "true_position", "velocity"]),
    "what was felt": ("push", "master", ["rendered_force", "safety_force", "device_force", "grasp_force"]),
    "what decided over it": ("push", "master", ["received_force", "requested_force", "gain"]),
    "trips": ("push", "master", ["tripped"]),
    "what observers saw": ("push", "master", [observed.signal for observed in OBSERVED_SIGNALS.values()]),
    "bounds that acted": ("push", "master", ["acted"]),
    "the hand of a model": ("push", "master", ["hand_force"]),
    "the link": ("push", "master", ["age_s", "round_trip_s", "clutch"]),
    "the arm": ("push", "slave", ["position", "command", "environment_force"]),
    "the link at the arm": ("push", "slave", ["age_s", "round_trip_s", "clutch"]),
    "the trigger": ("gripper", "master", ["trigger"]),
    "a felt trigger": ("felt", "master", ["trigger_velocity", "trigger_rendered_force", "trigger_device_force"]),
    "the gripper": ("gripper", "slave", ["gripper", "gripper_command", "gripper_force", "holds_object"]),
    "a pose of the hand": (
        "pose", "master", ["orientation", "true_orientation", "angular_velocity", "rendered_torque", "device_torque",
                           "received_torque", "requested_torque", "grasp_torque", "hand_torque"],
    ),
    "a pose of the arm": ("pose", "slave", ["orientation", "command_orientation", "environment_torque"]),
}  # fmt: skip


@pytest.mark.parametrize("what", KEPT)
def test_a_recording_keeps(what: str, recorded: Callable[[str, str], Recording]) -> None:
    run, side, names = KEPT[what]
    recording = recorded(run, side)
    for name in names:
        values = recording.signals[name]
        known = values[np.isfinite(values.astype(np.float64))]
        assert len(known), name
        assert known.astype(np.float64).any(), f"{name}: nothing but 0"
        assert recording.meanings[name], name


@pytest.mark.parametrize("side", ["master", "slave"])
@pytest.mark.parametrize("run", ["push", "gripper", "pose"])
def test_a_recording_says_scene_version_and_states(
    run: str, side: str, recorded: Callable[[str, str], Recording]
) -> None:
    recording = recorded(run, side)
    scene, overrides = RUNS[run]
    assert recording.scene == scene_json(load_scene(scene, overrides))
    assert recording.version == haptether.__version__
    assert (recording.side, recording.whole) == (side, True)
    assert {"aligning", "engaged"} <= set(recording.signals["state"]) <= set(LADDER_STATES)
    assert {"engaged"} <= set(recording.signals["peer_state"])
    assert "both sides aligned" in set(recording.signals["reason"])


@pytest.mark.parametrize("controller", OBSERVED_SIGNALS)
def test_bits_and_signals_of_controllers_are_those_of_the_binary(controller: str) -> None:
    run = simulate("remote_push", overrides=[f"safety.controllers=[{controller}]", "run.duration_s=3.5"])
    trips = [event for event in run.events if event.kind == "trip"]
    assert trips
    for event in trips:
        # The names come from Rust, the bits from its trace.
        bits = int(run.signals.tripped[np.searchsorted(run.signals.time_s, event.time_s - 1e-9)])
        assert tripped_names(bits) == tuple(event.detail.split()) == (controller,)
    bits = int(np.bitwise_or.reduce(run.signals.tripped.astype(np.int64)))
    assert set(tripped_names(bits)) <= {controller, "held"}
    for name, observed in OBSERVED_SIGNALS.items():
        assert np.isfinite(run.signals[observed.signal]).any() == (name == controller), name
