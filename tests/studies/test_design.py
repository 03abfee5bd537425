"""Design checks: intervals against roots of delay equations, walls against published values, findings, the command."""

import itertools
import json
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.linalg import expm

from haptether.bridge import (
    Scene,
    load_scene,
    override_scene,
    register_controller,
    scene_json,
    scene_names,
    simulate,
)
from haptether.cli.entry import main
from haptether.cli.shared.design import design_lines
from haptether.cli.shared.ejection import bound_line
from haptether.safety import ejection_bound
from haptether.studies import (
    ContactLoop,
    Finding,
    Follower,
    check_scene,
    largest_delay_s,
    largest_wall_stiffness,
    scene_loops,
    stable_delays,
    stable_together,
)
from haptether.studies.design import remedy
from haptether.studies.design.contact import scene_numbers, touched
from haptether.studies.task import Task

ONE_RAVEN = "raven_drop"
"""One of the RAVEN scenes, which differ only in their attacks."""
Array = npt.NDArray[np.float64]
NODES = 40


def rightmost_root(loop: ContactLoop, delay_s: float) -> float:
    """Return the real part of the rightmost root of the loop's delay equation, by collocation at Chebyshev nodes.

    Source: Breda, Maset and Vermiglio 2005, "Pseudospectral differencing methods for characteristic roots".
    """
    top = loop.force_scale * loop.position_scale * np.array([loop.environment_damping, loop.environment_stiffness])
    bottom = np.array([loop.mass_kg, loop.damping, loop.hand_stiffness])
    if (arm := loop.follower) is not None:
        command = [arm.damping, arm.stiffness] if arm.follows_velocity else [arm.stiffness]
        top = np.polymul(top, command).astype(np.float64)
        inertia = [arm.mass_kg, arm.damping + loop.environment_damping, arm.stiffness + loop.environment_stiffness]
        bottom = np.polymul(bottom, inertia).astype(np.float64)
    order = len(bottom) - 1
    now, late = np.eye(order, k=1), np.zeros((order, order))
    now[-1] = -bottom[:0:-1] / bottom[0]
    late[-1, : len(top)] = -top[::-1] / bottom[0]
    nodes = np.cos(np.pi * np.arange(NODES + 1) / NODES)
    ends = np.where(np.isin(np.arange(NODES + 1), (0, NODES)), 2.0, 1.0) * (-1.0) ** np.arange(NODES + 1)
    apart = nodes[:, None] - nodes + np.eye(NODES + 1)
    slopes = np.outer(ends, 1.0 / ends) / apart
    slopes -= np.diag(slopes.sum(axis=1))
    whole = np.kron(2.0 / delay_s * slopes, np.eye(order))
    whole[:order] = 0.0
    whole[:order, :order], whole[:order, -order:] = now, late
    return float(np.linalg.eigvals(whole).real.max())


def loops() -> st.SearchStrategy[ContactLoop]:
    arms = st.builds(
        Follower, mass_kg=st.floats(0.5, 4.0), damping=st.floats(20.0, 300.0), stiffness=st.floats(300.0, 5000.0),
        follows_velocity=st.booleans(),
    )  # fmt: skip
    return st.builds(
        ContactLoop, mass_kg=st.floats(0.05, 1.0), damping=st.floats(0.5, 20.0), hand_stiffness=st.floats(0.0, 500.0),
        environment_stiffness=st.floats(20.0, 3000.0), environment_damping=st.floats(0.0, 5.0),
        force_scale=st.floats(0.1, 1.0), follower=st.none() | arms,
    )  # fmt: skip


@given(loops(), st.floats(0.001, 0.15))
def test_where_it_is_said_to_be_stable_no_root_is_to_the_right(loop: ContactLoop, delay_s: float) -> None:
    stable = stable_delays(loop, 0.2)
    edges = [edge for interval in stable for edge in interval]
    if any(abs(delay_s - edge) < 2e-3 * edge + 1e-5 for edge in edges):
        return  # on the edge the root is on the axis
    root = rightmost_root(loop, delay_s)
    assert (root < 0.0) == any(low <= delay_s < high for low, high in stable), (root, stable)


@given(loops())
def test_the_first_interval_ends_at_the_delay_margin(loop: ContactLoop) -> None:
    stable, margin_s = stable_delays(loop, 5.0), largest_delay_s(loop)
    if margin_s == 0.0:
        assert not stable or stable[0][0] > 0.0
    else:
        assert stable[0][0] == 0.0
        assert stable[0][1] == pytest.approx(min(margin_s, 5.0), rel=1e-9)


def test_a_stiff_contact_has_pockets() -> None:
    loop = min(scene_loops(load_scene("pick_and_place")), key=largest_delay_s)
    stable = stable_delays(loop, 0.4)
    assert [round(edge * 1e3) for interval in stable for edge in interval] == [0, 30, 57, 131, 203, 233]
    inside = [0.5 * (low + high) for low, high in stable]
    between = [0.5 * (before[1] + after[0]) for before, after in itertools.pairwise(stable)]
    assert all(rightmost_root(loop, delay_s) < 0.0 for delay_s in inside)
    assert all(rightmost_root(loop, delay_s) > 0.0 for delay_s in [*between, 0.3])


def test_without_contact_nothing_oscillates_and_an_end_has_to_be_a_time() -> None:
    loop = ContactLoop(mass_kg=0.1, damping=1.0, hand_stiffness=100.0, environment_stiffness=0.0)
    assert stable_delays(loop, 0.5) == ((0.0, 0.5),)
    for wrong in (-1.0, float("inf"), float("nan")):
        with pytest.raises(ValueError, match="must be a number of at least 0"):
            stable_delays(loop, wrong)


# ---------------------------------------------------------------------------------------------------------- walls


@pytest.mark.parametrize(
    ("period_s", "late", "wall_damping", "stiffness"),
    [
        (1e-3, 0, 0.0, 1000.83), (1e-3, 1, 0.0, 333.80), (1e-3, 2, 0.0, 200.43), (1e-3, 5, 0.0, 91.33),
        (1e-3, 10, 0.0, 48.03), (1e-3, 50, 0.0, 10.30), (2e-3, 0, 0.0, 500.83), (2e-3, 10, 0.0, 24.22),
        (1e-3, 0, 2.0, 4905.3), (1e-3, 1, 2.0, 1632.0), (1e-3, 5, 2.0, 434.9), (2e-3, 10, 2.0, 100.9),
    ],
)  # fmt: skip
def test_a_sampled_wall_is_stable_to_the_published_stiffness(
    period_s: float, late: int, wall_damping: float, stiffness: float
) -> None:
    """M = 0.1 kg, b = 0.5 N s/m, exact first root on the unit circle, to the digits of the table."""
    found = largest_wall_stiffness(
        mass_kg=0.1, damping=0.5, hand_stiffness=0.0, wall_damping=wall_damping, period_s=period_s, late_ticks=late
    )
    assert found == pytest.approx(stiffness, rel=6e-4)


@given(
    st.tuples(st.floats(0.05, 0.5), st.floats(0.5, 10.0), st.floats(0.0, 500.0), st.floats(0.0, 1.0)),
    st.sampled_from([5e-4, 1e-3, 2e-3]),
    st.integers(0, 6),
)
def test_roots_of_the_sampled_loop_are_inside_below_it_and_outside_above(
    impedance: tuple[float, float, float, float], period_s: float, late: int
) -> None:
    mass_kg, damping, hand, share = impedance
    wall_damping = share * damping
    limit = largest_wall_stiffness(
        mass_kg=mass_kg, damping=damping, hand_stiffness=hand, wall_damping=wall_damping, period_s=period_s,
        late_ticks=late,
    )  # fmt: skip
    motion = np.array([[0.0, 1.0, 0.0], [-hand / mass_kg, -damping / mass_kg, 1.0 / mass_kg], [0.0, 0.0, 0.0]])
    step = expm(motion * period_s)

    def radius(stiffness: float) -> float:
        # State: x, V, the last x, then the forces in transit, the newest first.
        whole = np.zeros((3 + late, 3 + late))
        force = np.zeros(3 + late)
        force[0], force[2] = -stiffness - wall_damping / period_s, wall_damping / period_s
        acts = force if late == 0 else np.eye(3 + late)[2 + late]
        whole[:2, :2] = step[:2, :2]
        whole[:2] += np.outer(step[:2, 2], acts)
        whole[2, 0] = 1.0
        if late:
            whole[3] = force
            whole[4:, 3:-1] = np.eye(late - 1)
        return float(np.abs(np.linalg.eigvals(whole)).max())

    if limit == 0.0:
        return
    assert radius(0.995 * limit) < 1.0 + 1e-9
    assert radius(1.005 * limit) > 1.0


# ------------------------------------------------------------------------------------------------------- findings


VFC_OF_PAPER = ("safety.preset=paper", "safety.controllers=[vfc]")


def states(scene: str, overrides: tuple[str, ...] = (), **options: Any) -> dict[str, str]:  # noqa: ANN401
    return {
        one.name: one.state for one in check_scene(load_scene(scene, overrides), remedies=False, **options).findings
    }


@pytest.mark.sampled(24)
@pytest.mark.parametrize(
    ("scene", "overrides", "name", "state"),
    [
        ("remote_push", (), "delay margin", "good"),
        ("pick_and_place", (), "delay margin", "warning"),
        ("pick_and_place", ("link.forward.delay_s=0.02", "link.backward.delay_s=0.02"), "delay margin", "bad"),
        ("pick_and_place", ("link.forward.delay_s=0.005", "link.backward.delay_s=0.005"), "delay margin", "not judged"),
        ("peg_in_hole", (), "delay margin", "not judged"),
        ("sliding_mass", (), "delay margin", "not judged"),
        ("felt_trigger", (), "delay margin", "not judged"),
        ("ur_pick", (), "delay margin", "not judged"),
        ("torque_release", (), "delay margin", "note"),
        ("valve", (), "delay margin", "not judged"),
        ("valve", ("coupling.force_scale=1",), "delay margin", "bad"),
        ("free_motion", (), "delay margin", None),
        ("paper_wall", (), "wall", "good"),
        ("paper_wall", ("environment.objects.0.contact.stiffness=9000",), "wall", "warning"),
        ("paper_wall", ("environment.objects.0.contact.stiffness=11000",), "wall", "bad"),
        ("paper_wall", ("environment.objects.0.contact.stiffness=11000",), "passive wall", "note"),
        ("remote_push", ("safety.controllers=[]",), "ejection", "bad"),
        ("paper_wall", ("safety.controllers=[hsc]",), "ejection", "bad"),
        ("remote_push", (), "ejection", "good"),
        ("remote_push", ("safety.preset=paper",), "ejection", "bad"),
        ("paper_wall", ("master.viscous=-0.05", "master.coulomb=0"), "ejection", "good"),
        ("paper_wall", ("master.viscous=-0.05", "master.coulomb=0", "safety.damping=0"), "ejection", "bad"),
        ("remote_push", ("safety.energy_threshold_j=-30",), "ejection", "bad"),
        ("remote_push", ("safety.limiter={enabled=false}",), "ejection", "bad"),
        ("free_motion", ("safety.controllers=[]",), "ejection", "note"),
        ("remote_push", ("environment={}", "safety.controllers=[]"), "ejection", "note"),
        ("remote_push", ("environment={}", "slave.device=ur"), "ejection", "good"),
        ("remote_push", ("environment={}", "slave.force_sensor.bias_n=0.1"), "ejection", "good"),
        ("remote_push", ("coupling.locked_axes=[0]",), "ejection", "note"),
        ("torque_release", ("safety.controllers=[]",), "ejection", None),
        ("torque_release", ("safety.controllers=[]",), "ejection of the handle", "bad"),
        ("torque_release", ("coupling.locks_rotation=true",), "ejection of the handle", None),
        ("torque_release", ("safety.rotation.controllers=[hsc]",), "ejection of the handle", "not judged"),
        ("felt_trigger", ("safety.controllers=[]",), "ejection of the trigger", "bad"),
        ("felt_trigger", ("safety.gripper.controllers=[vfc]",), "ejection of the trigger", "not judged"),
        ("remote_push", ("safety.limiter.max_force_n=40", "master.max_force_n=40"), "ejection", "bad"),
        ("remote_push", ("master.measures_velocity=true",), "ejection", "good"),
        ("remote_push", ("safety.controllers=[vfc]",), "vfc", "good"),
        ("remote_push", (*VFC_OF_PAPER, "safety.vfc_force_threshold_n=7"), "vfc", "warning"),
        ("remote_push", (*VFC_OF_PAPER, "safety.vfc_form=both"), "vfc", "warning"),
        ("remote_push", (*VFC_OF_PAPER, "safety.vfc_form=both", "safety.vfc_force_threshold_n=8"), "vfc",
         "bad"),
        ("remote_push", ("safety.controllers=[hsc]",), "hsc", "good"),
        ("remote_push", ("safety.controllers=[hsc]", "safety.hsc_force_threshold_n=8"), "hsc", "bad"),
        ("remote_push", ("safety.controllers=[hsc]", "safety.hsc_velocity_threshold=0",
                         "safety.hsc_force_threshold_n=0.1"), "hsc", "warning"),
        ("remote_push", ("safety.preset=paper",), "wsc", "good"),
        ("remote_push", (), "wsc", None),
        ("remote_push", ("safety.preset=paper", "operator.legs.0.duration_s=0.2"), "wsc", "warning"),
        ("remote_push", ("operator.grip_strength_n=5",), "grip", "warning"),
        ("remote_push", (), "grip", None),
        ("driving_network", (), "losses", "warning"),
        ("remote_push", (), "losses", "good"),
        ("remote_push", ("link.forward.loss=1",), "losses", None),
        ("remote_push", (), "link", "good"),
        ("remote_push", ("link.forward.loss=1",), "link", "bad"),
        ("remote_push", ("link.backward.loss=1",), "link", "bad"),
        ("remote_push", ("link.forward.delay_s=50",), "link", "bad"),
        ("remote_push", ("link.forward.delay_s=0.15", "link.forward.jitter_s=0.05"), "link", "warning"),
        ("driving_network", (), "link", "bad"),
        ("paper_wall", (), "link", None),
    ],
)  # fmt: skip
def test_a_finding_is_in_the_state_that_its_numbers_say(
    scene: str, overrides: tuple[str, ...], name: str, state: str | None
) -> None:
    assert states(scene, overrides).get(name) == state


def of(findings: tuple[Finding, ...], name: str) -> Finding | None:
    return next((one for one in findings if one.name == name), None)


def held_with(scene: Scene, finding: Finding, findings: tuple[Finding, ...]) -> Finding | None:
    """Return the finding once its remedy is applied; fail if it is no better, or another is worse."""
    again = check_scene(override_scene(scene, finding.changes), remedies=False).findings
    after = of(again, finding.name)
    assert after is None or ORDER[after.state] > ORDER[finding.state] or (
        after.state == finding.state and after.value is not None
        and (finding.value is None or after.value < finding.value)
    ), (finding, after)  # fmt: skip
    for one in again:
        before = of(findings, one.name)
        if one.name != finding.name and one.state in {"bad", "warning"}:
            assert before is not None, one
            assert ORDER[one.state] >= ORDER[before.state], (before, one)
    return after


ORDER = {"bad": 0, "warning": 1, "not judged": 2, "good": 3, "note": 3}


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    "name", [name for name in scene_names(attacks=True) if not name.startswith("raven_") or name == ONE_RAVEN]
)
def test_every_shipped_scene_can_be_checked_and_what_its_remedies_change_mends_it(name: str) -> None:
    scene = load_scene(name)
    found = check_scene(scene).findings
    assert found
    for one in found:
        assert (one.remedy is not None) == (one.state in {"bad", "warning"})
        assert one.remedy is None or all(change in one.remedy for change in one.changes)
        if one.changes:
            held_with(scene, one, found)


@pytest.mark.sampled(3)
@pytest.mark.parametrize(
    ("scene", "overrides", "name", "changed"),
    [
        # If the limiter is off and WSC is on, WSC is no remedy.
        ("remote_push", ("safety.limiter={enabled=false}",), "ejection", "safety.limiter.enabled=true"),
        ("remote_push", ("safety.limiter={enabled=false}", "safety.controllers=[]"), "ejection", "controllers=[wsc]"),
        ("remote_push", ("safety.estimator={kind=adaptive-window}",), "ejection", "dual-kalman"),
        ("remote_push", ("safety.estimator={kind=kalman}",), "ejection", "safety.e"),
        # F_w without stops removes the bound.
        ("paper_wall", ("safety.wsc_force_threshold_n=0.1",), "ejection", "safety.wsc_force_threshold_n=0"),
        ("paper_wall", ("safety.controllers=[hsc]",), "ejection", "wsc"),
        ("remote_push", ("safety.preset=paper",), "ejection", "safety.preset=measured"),
        ("paper_wall", ("environment.rendering=continuous",), "ejection", "environment.rendering=sampled"),
        ("paper_wall", ("master.viscous=-0.05", "master.coulomb=0", "safety.damping=0"), "ejection", "damping=5"),
        ("remote_push", ("safety.limiter.max_force_n=40",), "ejection", "safety.limiter.max_force_n=7.9"),
        ("remote_push", ("safety.energy_threshold_j=-30",), "ejection", "safety.energy_threshold_j=-0.1"),
        # A threshold that mends WSC would remove the bound of the device, which has no stops.
        ("remote_push", ("safety.preset=paper", "operator.legs.0.duration_s=0.2"), "wsc", None),
        ("free_motion", ("safety.preset=paper",), "wsc", "safety.wsc_force_threshold_n=0.1"),
        ("paper_wall", ("environment.objects.0.contact.stiffness=11000",), "wall", "stiffness=80"),
        ("remote_push", (*VFC_OF_PAPER, "safety.vfc_force_threshold_n=7"), "vfc", "threshold_n=6.5"),
        ("remote_push", ("safety.controllers=[hsc]", "safety.hsc_force_threshold_n=8"), "hsc", "threshold_n=1"),
        ("remote_push", ("operator.grip_strength_n=5",), "grip", "safety.limiter.max_force_n=5"),
        ("driving_network", (), "losses", "safety.ladder.hold_after_s=0.05"),
        ("remote_push", ("link.forward.loss=1",), "link", None),
    ],
)  # fmt: skip
def test_a_remedy_is_what_its_finding_needs(
    scene: str, overrides: tuple[str, ...], name: str, changed: str | None
) -> None:
    before = load_scene(scene, overrides)
    found = check_scene(before).findings
    finding = of(found, name)
    assert finding is not None
    assert finding.remedy is not None
    if changed is None:
        assert finding.changes == ()
        return
    assert any(changed in change for change in finding.changes), finding
    held_with(before, finding, found)


@pytest.mark.parametrize("delay_s", [0.02, 0.05])
def test_the_scale_that_is_advised_is_the_largest_that_bears_it(delay_s: float) -> None:
    overrides = (f"link.forward.delay_s={delay_s}", f"link.backward.delay_s={delay_s}")
    scene = load_scene("pick_and_place", overrides)
    found = check_scene(scene).findings
    finding = of(found, "delay margin")
    assert finding is not None
    (change,) = finding.changes
    scale = float(change.partition("=")[2])
    after = held_with(scene, finding, found)
    # A body that jaws hold is not in the loop.
    assert after is not None
    assert after.state == "not judged"
    # The scene has 0.2; 0.19506 is the largest scale that is stable for any delay.
    assert 0.18 < scale < 0.19506


def test_a_changed_scale_is_lowered_with_the_first() -> None:
    scene = load_scene("pick_and_place", ["coupling.changes=[{at_s=1.0,force_scale=0.5}]"])
    found = check_scene(scene).findings
    finding = of(found, "delay margin")
    assert finding is not None
    assert [change.partition("=")[0] for change in finding.changes] == [
        "coupling.force_scale", "coupling.changes.0.force_scale",
    ]  # fmt: skip
    held_with(scene, finding, found)


def test_a_handle_that_is_said_to_ring_does_and_with_the_remedy_does_not() -> None:
    """A hand moves a valve's tool by 1 cm, which the valve resists: the force oscillates, or dies away."""
    scene = load_scene(
        "valve", ["coupling.force_scale=1", "operator.legs=[{duration_s=1.0,end=[0.0,0.0,0.01]}]", "run.duration_s=2.5"]
    )
    finding = of(check_scene(scene).findings, "delay margin")
    assert finding is not None
    assert finding.state == "bad"
    for changes, rings in (((), True), (finding.changes, False)):
        force = np.asarray(simulate(override_scene(scene, changes)).signals["device_force"]).reshape(2500, -1)
        late = np.linalg.norm(force, axis=1)[1500:]
        assert (np.ptp(late) > 1.0) == rings


@pytest.mark.parametrize(
    ("scene", "overrides", "stiffness", "beyond"),
    [
        ("free_motion", (), 0.0, ""),
        ("remote_push", (), 100.0, ""),
        ("peg_in_hole", (), 1e5, "hole"),
        ("valve", (), 1e4, "handle"),
        ("pick_and_place", (), 1e4, "body"),
        ("sliding_mass", (), 200.0, "mass"),
        # Slope 1.5 F / d at F = 7.9 N of F = K d^1.5, with d = (7.9 / 1e5)^(2/3).
        ("paper_wall", ("environment.objects.0.contact={law=hunt-crossley,stiffness=1e5}",),
         1.5 * 7.9 / (7.9 / 1e5) ** (2 / 3), ""),
        # Without a limiter nothing bounds the force.
        ("paper_wall",
         ("environment.objects.0.contact={law=hunt-crossley,stiffness=1e5}", "safety.limiter={enabled=false}"),
         1.5 * 7.9 / (7.9 / 1e5) ** (2 / 3), ""),
        ("remote_push", ("environment.objects.0.shape={kind=spring}",), 100.0, ""),
    ],
)  # fmt: skip
def test_touched_stiffness_is_the_same_for_the_loop_and_for_the_hands_of_a_task(
    scene: str, overrides: tuple[str, ...], stiffness: float, beyond: str
) -> None:
    loaded = load_scene(scene, overrides)
    found = touched(loaded, scene_numbers(loaded))
    assert found.stiffness == pytest.approx(stiffness)
    assert beyond in "; ".join(found.beyond)
    assert bool(beyond) == bool(found.beyond)
    coupling = loaded.coupling
    scale = 1.0 if loaded.slave is None or coupling is None else coupling.force_scale * coupling.position_scale
    servo = loaded.slave.stiffness if loaded.slave is not None else None
    assert Task(loaded, 0.1).felt_stiffness() == pytest.approx(scale * min(stiffness, servo or stiffness))


JOINTS = ("master.kind=joints", "operator.legs=[]")


def test_speeds_of_joints_are_in_rad_s_and_held_against_a_limit_that_was_given_only() -> None:
    scene = load_scene("remote_push", JOINTS)
    found = check_scene(scene, remedies=False).findings
    assert not [one for one in found if "m/s" in one.text.replace("rad/s", "") or " N/m" in one.text]
    finding, limited = of(found, "ejection"), of(check_scene(scene, speed=0.5, remedies=False).findings, "ejection")
    assert finding is not None
    assert limited is not None
    assert (finding.state, finding.limit, finding.unit) == ("not judged", None, "rad/s")
    assert (limited.state, limited.limit, limited.unit) == ("bad", 0.5, "rad/s")
    assert finding.value == limited.value
    assert states("remote_push", (*JOINTS, "safety.controllers=[]"))["ejection"] == "bad"
    assert states("remote_push", (*JOINTS, "safety.controllers=[vfc]"))["vfc"] == "note"


def test_a_live_start_says_what_is_bad_and_names_the_command_for_the_rest() -> None:
    scene = load_scene("remote_push", changes := ["operator.grip_strength_n=5", "safety.controllers=[]"])
    before = scene_json(scene)
    lines = list(design_lines(scene, "remote_push", changes))
    assert [line.partition(":")[0] for line in lines] == [
        "BAD  ejection", "warn grip", "the rest, and what mends it",
    ]  # fmt: skip
    assert lines[-1].endswith(
        "haptether check remote_push --set operator.grip_strength_n=5 --set 'safety.controllers=[]'"
    )
    assert all("\n" not in line for line in lines)
    assert scene_json(scene) == before
    # A scene from options alone has no command.
    assert list(design_lines(scene, None)) == lines[:-1]
    assert list(design_lines(load_scene("paper_wall"), "paper_wall")) == []


def test_a_check_that_fails_at_a_live_start_is_one_line(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(_: Scene) -> None:
        message = "no\nnumber"
        raise ZeroDivisionError(message)

    monkeypatch.setattr("haptether.studies.check_at_once", fail)
    assert list(design_lines(load_scene("remote_push"), "remote_push")) == ["not checked by design: no number"]


def test_more_than_three_axes_are_joints() -> None:
    overrides = (
        "master.axes=4",
        "master.encoder_quantum=1e-4",
        "environment={}",
        "operator.legs=[]",
        "slave.device=ur",
    )
    line = bound_line(scene := load_scene("remote_push", overrides), ejection_bound(scene))
    assert "rad/s" in line


def test_a_link_that_holds_is_reported_with_rate_and_reason() -> None:
    """An outage of 0.5 s once in 10 s causes one hold each."""
    outage = '[{ times = { kind = "periodic", at_s = 5.0, period_s = 10.0, duration_s = 0.5 } }]'
    found = check_scene(load_scene("remote_push", [f"link.forward.outages={outage}"])).findings
    (finding,) = (one for one in found if one.name == "link")
    # Six in a minute.
    assert finding.value == 360.0
    assert "silent" in finding.text


def once(*times: tuple[float, float]) -> str:
    """Return outages of the forward link, each as its time and duration in s."""
    listed = ", ".join(
        f'{{ times = {{ kind = "once", at_s = {at_s}, duration_s = {duration_s} }} }}' for at_s, duration_s in times
    )
    return f"link.forward.outages=[{listed}]"


@pytest.mark.parametrize(
    ("times", "state", "said"),
    [
        ([(2.0, 0.01)], "good", "an outage of 10 ms at 2 s: the ladder bears it"),
        ([(2.0, 0.04)], "warning", "the ladder holds at 2.07 s (slave: peer is silent)"),
        ([(2.0, 0.3)], "bad", "the ladder holds at 2.07 s, and stops ("),
        ([(2.0, 0.3), (70.0, 0.04)], "bad", "the ladder holds at 2.07 s, 70.1 s, and stops ("),
        ([(2.0, 1e6)], "bad", "the arm stays stopped until a person acts"),
    ],
)
def test_what_a_link_does_once_is_no_rate(times: list[tuple[float, float]], state: str, said: str) -> None:
    found = check_scene(load_scene("remote_push", [once(*times)]), remedies=False).findings
    link, outage = of(found, "link"), of(found, "outage")
    assert link is not None
    assert outage is not None
    assert (link.state, link.value) == ("good", 0.0)
    assert (outage.state, outage.text.count("an hour")) == (state, 0)
    assert said in outage.text


def test_an_outage_that_is_longer_than_any_hold_after_has_advice_that_says_so() -> None:
    short, long = (
        of(check_scene(load_scene("remote_push", [once((2.0, duration_s))])).findings, "outage")
        for duration_s in (0.04, 0.3)
    )
    assert short is not None
    assert short.changes == ("safety.ladder.hold_after_s=0.05",)
    assert long is not None
    assert not any("hold_after_s=" in change for change in long.changes)
    assert long.remedy is not None
    assert "hold_after_s bears at most 0.1 s" in long.remedy


@pytest.mark.parametrize(
    ("link", "state", "said"),
    [
        ({"jitter_s": 0.0}, "good", "over its delay alone and in 4 runs over the whole link"),
        ({"jitter_s": 0.004}, "warning", "over its delay alone the ladder bears it, and holds in 2 of 4 runs"),
    ],
)
def test_an_outage_counts_with_jitter_and_loss_of_its_link(link: dict[str, float], state: str, said: str) -> None:
    """With 20 ms of patience an outage of 20 ms causes no hold, unless 4 ms of jitter add to it."""
    overrides = [once((2.0, 0.02)), *(f"link.forward.{key}={value}" for key, value in link.items())]
    outage = of(check_scene(load_scene("remote_push", overrides), remedies=False).findings, "outage")
    assert outage is not None
    assert outage.state == state
    assert said in outage.text


def test_where_the_link_itself_holds_as_often_an_outage_is_not_judged() -> None:
    periodic = '{ times = { kind = "periodic", at_s = 2.5, period_s = 2.0, duration_s = 0.04 } }'
    outage = '{ times = { kind = "once", at_s = 2.0, duration_s = 0.001 } }'
    scene = load_scene("remote_push", [f"link.forward.outages=[{periodic}, {outage}]"])
    found = of(check_scene(scene, remedies=False).findings, "outage")
    assert found is not None
    assert found.state == "not judged"
    assert "holds as often without it" in found.text


def test_what_begins_late_is_not_judged_and_what_ends_late_is_run_to_its_end() -> None:
    late = check_scene(load_scene("remote_push", [once((600.0, 0.3))]), remedies=False).findings
    later = of(late, "later outage")
    assert later is not None
    assert later.state == "not judged"
    assert "an outage of 300 ms at 600 s: it begins after the 600 s" in later.text
    assert of(late, "outage") is None
    # 80 ms cause a hold and no stop; the outage ends after 600 s.
    ending = of(check_scene(load_scene("remote_push", [once((599.95, 0.08))]), remedies=False).findings, "outage")
    assert ending is not None
    assert ending.state == "warning"
    slow = "link.backward.timeline=[{ at_s = 1.0, delay_s = 0.06, ramp_s = 1e5 }]"
    lasting = of(check_scene(load_scene("remote_push", [slow]), remedies=False).findings, "outage")
    assert lasting is not None
    assert lasting.state == "not judged"
    assert "lasts longer than the 1200 s" in lasting.text


@pytest.mark.parametrize(
    ("override", "said"),
    [
        ("link.slave_clock={ step_s = 0.5, step_at_s = 6.0 }", "a clock that is not set while the two are coupled"),
        ("link.backward.timeline=[{ at_s = 3.0, delay_s = 0.4 }]", "a smaller change of the delay, or a slower one"),
    ],
)
def test_advice_is_of_what_happens(override: str, said: str) -> None:
    found = of(check_scene(load_scene("remote_push", [override])).findings, "outage")
    assert found is not None
    assert found.remedy is not None
    assert said in found.remedy
    assert "a shorter" not in found.remedy


def test_changes_of_delay_and_of_a_clock_are_looked_at_once() -> None:
    overrides = [
        "link.backward.timeline=[{ at_s = 3.0, delay_s = 0.4 }]",
        "link.slave_clock={ step_s = 0.5, step_at_s = 6.0 }",
    ]
    outage = of(check_scene(load_scene("remote_push", overrides), remedies=False).findings, "outage")
    assert outage is not None
    assert outage.state == "bad"
    assert "backward a delay of 400 ms from 3 s on, the slave's clock is set forward by 0.5 s at 6 s" in outage.text
    assert of(check_scene(load_scene("remote_push"), remedies=False).findings, "outage") is None


class Brake:
    """A custom controller, about which nothing is known."""

    def step(self, tick: object) -> None:
        """Never intervenes."""


@pytest.mark.parametrize("controllers", ["[]", "[wsc]", "[hsc,wsc]"])
def test_custom_controller_has_no_bound_and_measuring_is_advised(controllers: str) -> None:
    register_controller("brake", Brake)
    scene = load_scene(
        "remote_push",
        [f"safety.controllers={controllers}", "safety.research.controller=brake", "master.measures_velocity=true"],
    )
    ejection = of(check_scene(scene).findings, "ejection")
    assert ejection is not None
    assert (ejection.state, ejection.value, ejection.changes) == ("not judged", None, ())
    assert "no bound on the speed after a release is known of brake" in ejection.text
    assert ejection.remedy is not None
    assert "haptether falsify" in ejection.remedy
    assert "haptether evaluate --controller none brake" in ejection.remedy


def test_axes_that_differ_are_stable_where_all_of_them_are() -> None:
    scene = load_scene("pick_and_place", ["master.mass_kg=[0.05,0.4,0.4]"])
    several = scene_loops(scene)
    assert len({loop.mass_kg for loop in several}) == 2
    together = stable_together(several, 0.4)
    for delay_s in np.linspace(0.002, 0.398, 100):
        inside = all(any(low <= delay_s <= high for low, high in stable_delays(loop, 0.4)) for loop in several)
        assert inside == any(low <= delay_s <= high for low, high in together), delay_s
    assert stable_together([], 0.4) == ((0.0, 0.4),)


def test_losses_hold_as_often_as_a_chain_of_two_states_says() -> None:
    """Runs of at least k lost packets, counted in a million packets of the chain."""
    loss, burst, packets = 0.05, 4.0, 20
    rng = np.random.default_rng(1)
    lost, runs, length = False, 0, 0
    leaves, enters = 1.0 / burst, loss / (1.0 - loss) / burst
    for draw in rng.random(1_000_000):
        lost = draw >= leaves if lost else draw < enters
        length = length + 1 if lost else 0
        runs += length == packets
    forward = (f"link.forward.loss={loss}", f"link.forward.mean_burst={burst}")
    overrides = (*forward, "link.backward.loss=0", "safety.ladder.hold_after_s=0.02")
    (finding,) = (one for one in check_scene(load_scene("remote_push", overrides)).findings if one.name == "losses")
    assert finding.value is not None
    # The count has a Poisson law.
    assert finding.value * 1000.0 / 3600.0 == pytest.approx(runs, abs=4.0 * np.sqrt(runs))
    assert runs > 20


def test_the_command_says_bad_by_its_status(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "peg_in_hole", "--json", "-"]) == 0
    said = json.loads(capsys.readouterr().out)
    assert {one["state"] for one in said["findings"]} == {"good", "note", "not judged"}
    assert main(["check", "peg_in_hole"]) == 0
    out = capsys.readouterr().out
    assert "?    delay margin: not judged: contact with 100000 N/m" in out
    assert out.splitlines()[-1] == "nothing bad, 2 not judged"
    assert main(["check", "paper_wall"]) == 0
    assert capsys.readouterr().out.splitlines()[-1] == "nothing bad, room everywhere"
    assert main(["check", "remote_push", "--set", "safety.controllers=[]"]) == 1
    out = capsys.readouterr().out
    assert "BAD  ejection" in out
    assert "mend: safety.controllers=[wsc]" in out


@pytest.mark.parametrize("speed", ["0", "-1", "nan", "inf"])
def test_invalid_speed_is_refused_with_its_meaning(speed: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", "remote_push", "--speed", speed]) == 2
    said = " ".join(capsys.readouterr().err.split())
    assert f"speed = {float(speed):g}: must be above 0 and finite" in said
    assert "in m/s above which a device that was let go counts as thrown" in said


def test_a_remedy_that_mends_is_not_cut_down_to_one_that_does_not(monkeypatch: pytest.MonkeyPatch) -> None:
    """Both changes together remove the finding; either alone only improves it."""
    both = ("run.duration_s=1", "run.seed=7")
    monkeypatch.setattr(remedy, "_candidates", lambda *_: iter([both]))
    bad = Finding(name="wall", state="bad", text="", value=10.0, limit=1.0)

    def judge(scene: Scene, /, *, link: bool) -> tuple[Finding, ...]:  # noqa: ARG001  # there is no link
        changed = (scene.run.duration_s == 1.0) + (scene.run.seed == 7)
        return () if changed == 2 else (msgspec.structs.replace(bad, value=10.0 - changed),)

    (found,) = remedy.with_remedies(load_scene("paper_wall"), (bad,), judge, None)
    assert found.changes == both
