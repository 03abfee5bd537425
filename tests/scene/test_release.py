"""After a trip the force returns to a hand only: with nobody there, and with a hand that is back."""

from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest

from haptether.bridge import Run, Scene, SceneError, load_scene, scene_json, simulate
from haptether.cli.shared.ejection import release_law, release_line

RELEASE_S, DURATION_S = 1.0, 8.0
HELD = 16
"""Bit of `tripped` that marks the rest of an earlier trip."""
PUSH_N = 3.0


def released(*, remote: bool, operator: dict[str, Any], device: str = "phantom-desktop", **safety: Any) -> Run:  # noqa: ANN401
    """Run a lasting push with a hand that lets go at 1 s."""
    release = {"at_s": RELEASE_S, "decay_s": 0.02, "kind": "gain"}
    tables: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": DURATION_S},
        "master": {"device": device},
        "operator": {"stiffness": 600.0, "damping": 20.0, "release": release, **operator},
        "environment": {"pushers": [{"shape": "ramp", "at_s": 0.1, "rise_s": 0.6, "force_n": PUSH_N}]},
        "safety": {
            "controllers": ["wsc"], **safety,
        },
        "record": {},
    }  # fmt: skip
    if remote:
        tables["slave"] = {"control": "pd", "mass_kg": 2.0, "stiffness": 2000.0}
    return simulate(msgspec.convert(tables, Scene))


def force_after(run: Run, time_s: float) -> npt.NDArray[np.float64]:
    """Return the device force in N from a time on."""
    assert run.signals is not None
    time = np.asarray(run.signals["time_s"])
    force = np.asarray(run.signals["device_force"]).reshape(len(time), -1)
    later: npt.NDArray[np.float64] = force[time >= time_s, 0]
    return later


@pytest.mark.parametrize("clutch", [None, "once", "auto"], ids=["local", "once", "auto"])
def test_without_a_hand_there_is_one_trip_and_no_force_after_it(clutch: str | None) -> None:
    run = released(remote=clutch is not None, operator={"clutch": clutch} if clutch else {})
    assert [event.detail for event in run.events if event.kind == "trip"] == ["wsc"]
    # Damping and the probe remain, but nothing of the push.
    assert np.abs(force_after(run, RELEASE_S + 0.3)).max() < 1.2
    assert np.abs(force_after(run, 6.5 if clutch == "once" else DURATION_S - 0.1)).max() < 1e-2
    holds = [event for event in run.events if event.kind == "hold" and event.detail.startswith("master")]
    if clutch:
        assert holds[0].detail == "master: no hand was felt on the device after a push"
        # It is the fifth probe, of a second each.
        assert 4.0 < holds[0].time_s - RELEASE_S < 5.0


@pytest.mark.parametrize("remote", [False, True], ids=["local", "remote"])
def test_a_hand_that_takes_hold_again_has_its_force(*, remote: bool) -> None:
    run = released(remote=remote, operator={"regrasp": {"reaction_s": 0.3, "rise_s": 0.05}})
    assert not [event for event in run.events if event.kind == "hold"]
    # A hand that returns between two tries waits for the next one.
    back = force_after(run, RELEASE_S + 0.3 + 1.5)
    assert back.min() > 0.9 * PUSH_N


UNIONS = ("vfc", "hsc", "wsc", "hsc+wsc", "vfc+hsc+wsc", "hsc+pc", "vfc+hsc+wsc+pc")
"""Controllers that trip in `released` and in `remote_push`."""


@pytest.mark.parametrize("controllers", UNIONS)
@pytest.mark.parametrize(("stiffness", "damping"), [(80.0, 4.0), (150.0, 3.0), (600.0, 5.0)])
def test_a_hand_that_yields_has_its_force_all_the_same(controllers: str, stiffness: float, damping: float) -> None:
    regrasp = {"reaction_s": 0.4, "rise_s": 0.1}
    operator = {"stiffness": stiffness, "damping": damping, "regrasp": regrasp}
    run = released(remote=False, operator=operator, controllers=controllers.split("+"), hsc_force_threshold_n=1.0)
    assert force_after(run, RELEASE_S + 0.5 + 2.5).min() > 0.9 * PUSH_N
    trips = [event.time_s for event in run.events if event.kind == "trip" and event.detail != "pc"]
    assert [time_s for time_s in trips if time_s > RELEASE_S + 0.5] == []


@pytest.mark.parametrize("controllers", UNIONS)
def test_the_hand_of_the_remote_push_that_holds_again_has_its_force(controllers: str) -> None:
    for seed in (1, 2, 3):
        overrides = [f"safety.controllers=[{controllers.replace('+', ',')}]", f"run.seed={seed}", "run.duration_s=7"]
        run = simulate("remote_push", overrides=[*overrides, "operator.regrasp={reaction_s=0.9, rise_s=0.1}"])
        assert not [event for event in run.events if event.kind in {"hold", "stop"}]
        # The hand presses the wall of 100 N/m again.
        assert force_after(run, 6.5).min() > 2.0


@pytest.mark.parametrize(
    ("safety", "said"),
    [
        ({"probe_force_n": 0.3}, "probe_force_n"),
        ({"probe_force_n": -1.0}, "probe_force_n"),
        ({"probe_force_n": 8.0}, "at most what the limiter lets the device exert, 7.9"),
        ({"probe_threshold": 0.0}, "probe_threshold"),
        ({"probe_threshold": 1.0}, "probe_threshold"),
    ],
)
def test_a_probe_that_decides_nothing_is_refused(safety: dict[str, Any], said: str) -> None:
    with pytest.raises((SceneError, msgspec.ValidationError), match=said):
        released(remote=False, operator={}, **safety)


def table(master: dict[str, Any], **safety: Any) -> dict[str, Any]:  # noqa: ANN401  # any setting
    """Return the resolved table `[safety]`."""
    scene = {"schema": 1, "master": master, "safety": {"controllers": ["wsc"], **safety}}
    resolved: dict[str, Any] = msgspec.json.decode(scene_json(msgspec.convert(scene, Scene)))["safety"]
    return resolved


@pytest.mark.parametrize(
    ("master", "safety", "force_n", "tries"),
    [
        ({"device": "phantom-desktop"}, {}, 0.6, 5),
        # 0.12 m/s mu: 2 c / r_th must be less.
        ({"device": "phantom-desktop"}, {"damping": 3.0}, 0.0, 5),
        ({"device": "phantom-desktop"}, {"damping": 3.5, "probe_threshold": 0.25}, 0.42, 5),
        ({"device": "phantom-desktop"}, {"probe_force_n": 0.0}, 0.0, 5),
        ({"device": "phantom-desktop"}, {"probe_force_n": 0.8, "release_tries": 0}, 0.8, 0),
        ({"device": "phantom-desktop"}, {"damping": 0.0}, 0.0, 5),
        ({"device": "touch"}, {}, 0.0, 5),
        ({"mass_kg": 0.2, "coulomb": 0.06}, {}, 0.6, 5),
        ({"mass_kg": 0.2, "coulomb": 0.061}, {}, 0.0, 5),
        # The device exerts less than the probe needs.
        ({"mass_kg": 0.2, "max_force_n": 0.6}, {}, 0.6, 5),
        ({"mass_kg": 0.2, "max_force_n": 0.59}, {}, 0.0, 5),
        ({"mass_kg": 0.2}, {"limiter": {"max_force_n": 0.5}}, 0.0, 5),
        ({"device": "dynamixel-leader", "kind": "joints"}, {}, 0.0, 5),
        ({"mass_kg": 0.02, "coulomb": 0.01, "kind": "joints"}, {}, 0.48, 5),
    ],
)
def test_by_default_a_hand_is_asked_for_unless_friction_hides_it(
    master: dict[str, Any], safety: dict[str, float], force_n: float, tries: int
) -> None:
    resolved = table(master, **safety)
    assert resolved["probe_force_n"] == pytest.approx(force_n, abs=1e-12)
    assert (resolved["hold_off_s"], resolved["release_ramp_s"], resolved["release_tries"]) == (0.1, 0.2, tries)


@pytest.mark.parametrize(
    ("overrides", "said"),
    [
        ([], None),
        (
            ["master.device=touch"],
            "a cap of 3.3 N leave no room to probe for a hand: after a trip the force comes back to",
        ),
        (["master.device=touch", "safety.release_tries=0"], "comes back by time"),
        (
            ["master.device=touch", "safety.probe_force_n=0"],
            "probe_force_n = 0: after a trip the force comes back to one",
        ),
        (
            ["safety.probe_force_n=0", "safety.release_tries=0"],
            "probe_force_n = 0: after a trip the force comes back by time",
        ),
        (["master.device=touch", "safety.controllers=[pc]"], None),
        (["safety.damping=0"], "no probe for a hand: after a trip the force stays away until a person presses"),
        (["safety.limiter.max_force_n=0.5"], "a cap of 0.5 N leave no room to probe for a hand"),
    ],
)
def test_a_command_says_where_no_hand_is_probed_for(overrides: list[str], said: str | None) -> None:
    line = release_line(load_scene("remote_push", overrides))
    assert line == said if said is None else said in (line or "")


@pytest.mark.parametrize(
    ("overrides", "by"),
    [
        ([], "hand"),
        (["safety.probe_force_n=0"], "hand"),
        (["safety.probe_force_n=0", "safety.release_tries=0"], "time"),
        (["safety.damping=0"], "never"),
    ],
)
def test_json_has_what_brings_the_force_back(overrides: list[str], by: str) -> None:
    law = release_law(load_scene("remote_push", overrides))
    assert law is not None
    assert law["returns"] == by


def test_without_an_arm_nobody_can_press() -> None:
    line = release_line(load_scene("free_motion", ["safety.damping=0"]))
    assert line == "without damping there is no probe for a hand: after a trip the force stays away"


@pytest.mark.parametrize("clutch", [None, "once"], ids=["local", "once"])
@pytest.mark.parametrize("tries", [1, 3])
def test_where_friction_hides_a_hand_nothing_comes_back_to_nobody(tries: int, clutch: str | None) -> None:
    run = released(
        remote=clutch is not None,
        operator={"clutch": clutch} if clutch else {},
        device="phantom-omni",
        release_tries=tries,
    )
    assert run.signals is not None
    unsafe = (np.asarray(run.signals["tripped"]).astype(int) & ~HELD) != 0
    trips = np.asarray(run.signals["time_s"])[1:][unsafe[1:] & ~unsafe[:-1]]
    assert trips.max() - trips[0] < 0.1
    assert np.abs(force_after(run, trips[0] + 0.5)).max() < 1e-2
    holds = [event for event in run.events if event.kind == "hold" and event.detail.startswith("master")]
    assert [event.detail for event in holds] == (
        ["master: no hand was felt on the device after a push"] if clutch else []
    )
    # The hold-off, plus a second for each try.
    assert all(tries < hold.time_s - trips[0] < tries + 1.3 for hold in holds)


def test_where_friction_hides_a_hand_one_that_moves_has_its_force_again() -> None:
    legs = [{"duration_s": 0.4, "end": side} for side in (0.0, 0.0, 0.0, 0.03, -0.03, 0.03, -0.03, 0.03, 0.0)]
    run = released(
        remote=True,
        operator={"clutch": "once", "regrasp": {"reaction_s": 0.2, "rise_s": 0.05}, "legs": legs},
        device="phantom-omni",
    )
    assert not [event for event in run.events if event.kind == "hold"]
    assert force_after(run, 4.0).min() > 0.9 * PUSH_N


def test_a_press_of_the_clutch_is_a_hand_where_friction_hides_it() -> None:
    # Nobody holds until a person presses again; then a resting hand has its force.
    run = released(
        remote=True,
        operator={"clutch": "auto", "regrasp": {"reaction_s": 1.4, "rise_s": 0.05}},
        device="phantom-omni",
        release_tries=1,
    )
    assert "master: no hand was felt on the device after a push" in {event.detail for event in run.events}
    assert force_after(run, 7.0).min() > 0.9 * PUSH_N


def test_a_hand_that_is_there_keeps_its_force_however_often_it_trips() -> None:
    # Trips more than a second apart are not tries of one intervention.
    tables = {
        "schema": 1,
        "run": {"duration_s": 9.0},
        "master": {"device": "phantom-omni"},
        "operator": {
            "stiffness": 300.0, "damping": 8.0,
            "legs": [{"duration_s": 0.1, "end": side} for _ in range(4) for side in [0.1] * 10 + [0.0] * 10],
        },
        "environment": {"pushers": [{"force_n": 1.0}]},
        "safety": {"controllers": ["wsc"], "preset": "paper"},
        "record": {},
    }  # fmt: skip
    run = simulate(msgspec.convert(tables, Scene))
    assert len([event for event in run.events if event.kind == "trip"]) == 4
    assert force_after(run, 8.8).max() > 0.5


@pytest.mark.parametrize("shares", [True, False])
def test_a_torque_that_friction_hides_comes_back_to_nobody_for_ever(*, shares: bool) -> None:
    # Nobody watches the force, so its probe decides nothing; a torque of 0.1 N m lasts.
    run = simulate(
        "torque_release",
        overrides=[
            "safety.controllers=[]", "safety.rotation.controllers=[wsc]", "master.rotation.coulomb=4e-3",
            "run.duration_s=9", "operator.clutch=once", "environment.torques.0.duration_s=10", "record={}",
            f"safety.rotation.shares_trips={str(shares).lower()}",
        ],
    )  # fmt: skip
    assert run.signals is not None
    assert "trip" in {event.kind for event in run.events}
    holds = [event.detail for event in run.events if event.kind == "hold" and event.detail.startswith("master")]
    assert holds == ["master: no hand was felt on the device after a push"]
    late = np.asarray(run.signals["time_s"]) > 8.5
    assert np.abs(np.asarray(run.signals["device_torque"])[late]).max() < 1e-2


@pytest.mark.parametrize(
    ("master", "rotation", "least", "most"),
    [
        # 0.096 m/s at a lever of 0.05 m, minus friction and the remaining ramp of a tenth of a second.
        ({"inertia_kg_m2": 4e-4}, {}, 1.4, 1.92),
        # mu is at most I / 5 dT, and the probe is weaker by the same factor.
        ({"inertia_kg_m2": 2e-5}, {}, 1.4, 1.92),
        ({"inertia_kg_m2": 4e-4}, {"damping": 6e-3}, 0.9, 1.92),
    ],
)
def test_a_probe_of_a_torque_turns_a_free_handle_as_slowly_whatever_its_damping(
    master: dict[str, float], rotation: dict[str, float], least: float, most: float
) -> None:
    overrides = [
        "safety.controllers=[]",
        "safety.rotation.controllers=[wsc]",
        "safety.rotation.shares_trips=false",
        "record={}",
    ]
    overrides += ["run.duration_s=3", "environment.torques.0.duration_s=8", "master.rotation.coulomb=0"]
    overrides += [f"master.rotation.{name}={value}" for name, value in master.items()]
    overrides += [f"safety.rotation.{name}={value}" for name, value in rotation.items()]
    run = simulate("torque_release", overrides=overrides)
    assert run.signals is not None
    trip_s = next(event.time_s for event in run.events if event.kind == "trip")
    rate = np.linalg.norm(np.asarray(run.signals["angular_velocity"]), axis=-1)
    assert least < rate[np.asarray(run.signals["time_s"]) > trip_s + 0.3].max() < most
