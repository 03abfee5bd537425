"""Press of a pair on a wall: its closed form, what `check` says of it, and the couplings that it compares."""

from typing import Any

import pytest
from tests.scene.two_sides import two_sides

from haptether.bridge import COUPLINGS, Scene, coupling_facts, load_scene, override_scene
from haptether.studies import check_scene
from haptether.studies.design.couplings import bearable_delays
from haptether.studies.design.finding import Finding
from haptether.studies.design.gains import pressed_couplings
from haptether.studies.design.press import press

HAND, WALL = 100.0, 2000.0
ARM = 4.0 * (2.0 * 3.141592653589793 * 15.0) ** 2


def pair(round_trip_s: float, kind: str, **changed: Any) -> Scene:  # noqa: ANN401  # tables as in TOML
    """Return a frictionless device and an arm over a link."""
    link = {"delay_s": round_trip_s / 2.0}
    tables: dict[str, Any] = {
        "master": {"device": None, "mass_kg": 0.157, "viscous": 0.0, "coulomb": 0.0, "encoder_quantum": 0.0},
        "operator": {"stiffness": HAND, "damping": 3.0},
        "environment": {"objects": [{"contact": {"stiffness": WALL}}]},
        "link": {"forward": link, "backward": link},
        "slave": {"period_s": 1e-3},
        "coupling": {"kind": kind, **changed},
    }
    tables["master"] = {key: value for key, value in tables["master"].items() if value is not None}
    return two_sides(**tables)


def contact(scene: Scene, *, remedies: bool = False) -> Finding:
    (found,) = (one for one in check_scene(scene, remedies=remedies).findings if one.name == "contact")
    return found


@pytest.mark.parametrize(
    ("kind", "round_trip_s"),
    [
        ("pd-damped", 0.04),
        ("pspm", 0.2),
        ("tdpa", 0.04),
        ("wave", 0.04),
        ("four-channel", 0.1),
        ("three-channel-grasp", 0.2),
    ],
)
def test_a_press_rests_at_the_closed_form(kind: str, round_trip_s: float) -> None:
    """`felt = (1/K_h + 1/K_e) / (1/K_h + C + 1/K_arm + 1/K_e)`, of a device without friction."""
    gains = {"pd-damped": {"stiffness": 60.0, "damping": 3.0}, "wave": {"play_out_s": 0.0}}.get(kind, {})
    seen = press(pair(round_trip_s, kind, **gains), WALL)
    facts = coupling_facts(
        kind, stiffness=gains.get("stiffness"), damping=gains.get("damping"), round_trip_s=round_trip_s
    )
    assert facts.compliance is not None
    rigid = 1.0 / HAND + 1.0 / WALL
    assert seen.outcome == "rests"
    assert seen.felt == pytest.approx(rigid / (rigid + facts.compliance + 1.0 / ARM), rel=2e-3)
    assert seen.behind == pytest.approx(seen.felt * seen.rigid * (facts.compliance + 1.0 / ARM), rel=2e-2, abs=1e-4)


def test_the_press_of_an_arm_that_takes_forces_has_no_arm_in_series() -> None:
    arm = ["slave.takes_force=true", "slave.mass_kg=1.0", "slave.viscous=3.0"]
    seen = press(override_scene(pair(0.04, "four-channel"), arm), WALL)
    assert seen.outcome == "rests"
    assert seen.felt == pytest.approx(1.0, rel=2e-3)
    assert abs(seen.behind) < 1e-5


@pytest.mark.parametrize(
    ("kind", "gains", "state", "text"),
    [
        ("pspm", {"stiffness": 300.0, "damping": 450.0}, "warning", "swings"),
        ("pspm", {"stiffness": 1e9, "damping": 3.0}, "warning", "does not reach"),
        ("pspm", {}, "good", "rests"),
        ("wave", {}, "good", "rests"),
        ("three-channel-grasp", {}, "good", "rests"),
    ],
)
def test_check_judges_gains_that_no_loop_describes(kind: str, gains: dict[str, float], state: str, text: str) -> None:
    scene = pair(0.04, kind, **gains)
    found = contact(scene, remedies=state == "warning")
    assert found.state == state
    assert text in found.text
    if state == "warning":
        assert found.changes
        assert contact(override_scene(scene, found.changes)).state == "good"


def test_a_link_on_which_the_ladder_holds_is_not_judged() -> None:
    scene = override_scene(pair(0.04, "pspm"), ["link.forward.loss=0.9", "link.backward.loss=0.9"])
    assert press(scene).outcome == "held"
    assert contact(scene).state == "not judged"


def test_every_coupling_is_pressed_with_gains_for_the_pair() -> None:
    scene = pair(0.02, "pspm", stiffness=1e9)
    found = {one.kind: one for one in pressed_couplings(scene, 0.5)}
    assert list(found) == [name for name, *_ in COUPLINGS]
    # The gains of the scene do not enter.
    assert "coupling.stiffness=1e+09" not in found["pspm"].changes
    assert found["pspm"].press.outcome == "rests"
    for kind in ("pd-damped", "pspm", "four-channel"):
        alone = press(override_scene(pair(0.02, kind), found[kind].changes), WALL)
        assert alone == found[kind].press
    assert found["pspm"].press.felt < found["four-channel"].press.felt


def test_the_largest_delay_of_a_coupling_without_a_loop_is_pressed() -> None:
    scene = pair(0.004, "three-channel-environment", environment_gain=0.5, impedance=3.0)
    margin_s, stable = bearable_delays(scene, 0.5)
    assert 0.0 < margin_s < 0.5
    assert stable[0] == (0.0, margin_s)
    for delay_s, rests in ((1.5 * margin_s, False), *((high, True) for _, high in stable)):
        ways = [f"link.{way}.delay_s={delay_s / 2.0!r}" for way in ("forward", "backward")]
        assert (press(override_scene(scene, ways), WALL).outcome == "rests") == rests
    assert bearable_delays(pair(0.004, "pspm"), 0.5)[1] == ((0.0, 0.5),)


@pytest.mark.parametrize("scene", ["ur_peg", "ur_pick", "remote_push", "felt_trigger", "alignment"])
def test_shipped_scenes_are_pressed(scene: str) -> None:
    """Their sides have other periods, joints or poses."""
    seen = press(override_scene(load_scene(scene), ["coupling.kind=pspm"]))
    assert seen.outcome == "rests"
    assert 0.05 < seen.felt < 1.05


def test_swings_without_contact_are_a_warning() -> None:
    """At a force scale of 0.02 spring and damper of the device are nearly nothing, and the hand drives the arm."""
    found = contact(override_scene(pair(0.01, "three-channel-grasp"), ["coupling.force_scale=0.02"]))
    assert found.state == "warning"
    assert "swings" in found.text


def test_couplings_to_which_an_operator_may_switch_are_pressed() -> None:
    scene = pair(0.04, "pd-damped", alternatives=[{"kind": "pspm"}], changes=[{"at_s": 1.0, "kind": "pspm"}])
    (found,) = (one for one in check_scene(scene, remedies=False).findings if one.name == "contact, pspm")
    assert found.state == "good"
    assert found.text == contact(pair(0.04, "pspm")).text
