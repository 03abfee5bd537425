"""Changes while both sides run: scales, axes and times of the ladder; live in `test_live.py`."""

from typing import Any

import numpy as np
import pytest

from haptether.bridge import Run, SceneError, load_scene, override_scene, simulate

HALF = 0.5**0.5


def stroke(*overrides: str) -> Run:
    """Run a hand that moves in free space along x, then y and z, on a perfect link."""
    free = ["environment.objects=[]", "link.forward.delay_s=0", "link.backward.delay_s=0", "run.duration_s=2.9"]
    return simulate("three_axis_box", overrides=[*free, *overrides])


def displacements(run: Run) -> tuple[Any, Any]:
    """Return the final displacements of master and slave."""
    return tuple(run.signals[name][-1] - run.signals[name][0] for name in ("position", "slave_position"))


def test_the_slave_follows_in_its_own_frame() -> None:
    hand, arm = displacements(stroke())
    assert arm == pytest.approx(hand, abs=1e-3)
    # A quarter turn about z takes x to y and y to -x.
    run = stroke(f"coupling.quat_wxyz=[{HALF!r}, 0, 0, {HALF!r}]")
    hand, arm = displacements(run)
    assert arm == pytest.approx([-hand[1], hand[0], hand[2]], abs=1e-3)
    assert abs(arm[0]) > 0.02
    assert run.metrics.position_rmse_m is not None
    assert run.metrics.position_rmse_m < 2e-3, "measured in the frame of the slave"


def test_a_locked_axis_stays_where_it_is() -> None:
    run = stroke("coupling.locked_axes=[1]", "coupling.position_scale=2.0")
    hand, arm = displacements(run)
    assert not np.ptp(run.signals["slave_command"][:, 1])
    assert arm[[0, 2]] == pytest.approx(2.0 * hand[[0, 2]], abs=2e-3)


def test_changes_come_at_their_time_and_move_nothing_by_themselves() -> None:
    changes = "[{at_s=1.2, position_scale=3.0}, {at_s=1.5, locked_axes=[2]}, {at_s=2.0, quat_wxyz=[0, 0, 0, 1]}]"
    baseline, run = stroke(), stroke(f"coupling.changes={changes}")
    at = {time_s: int(np.searchsorted(run.signals["slave_time_s"], time_s - 1e-9)) for time_s in (1.2, 1.5, 2.0)}
    command, before = run.signals["slave_command"], baseline.signals["slave_command"]
    # The tick of the change still has the old command.
    assert np.array_equal(command[: at[1.2] + 1], before[: at[1.2] + 1])
    steps, baseline_steps = np.diff(command, axis=0), np.diff(before, axis=0)
    fade = 200
    share = np.clip(np.arange(1, 300) / fade, 0.0, 1.0)[:, None]
    fading = slice(at[1.2], at[1.2] + 299)
    assert steps[fading] == pytest.approx((1.0 + 2.0 * share) * baseline_steps[fading], abs=1e-6)
    # A map fades out and in within twice the time, and its axes never leap.
    locked = slice(at[1.5] + 2 * fade + 1, at[2.0] - 1)
    assert not steps[locked, 2].any()
    assert steps[locked, :2] == pytest.approx(3.0 * baseline_steps[locked, :2], abs=1e-6)
    assert not steps[at[1.5] + fade + 1 :, 2].any()
    rotated = slice(at[2.0] + 2 * fade + 1, None)
    assert steps[rotated, :2] == pytest.approx(-3.0 * baseline_steps[rotated, :2], abs=1e-6)
    most = 3.0 * np.abs(baseline_steps).max() / fade + 3.0 * np.abs(np.diff(baseline_steps, axis=0)).max()
    assert np.abs(np.diff(steps, axis=0)).max() <= most, "the velocity has no step"


def test_a_force_scale_that_changes_is_felt_and_measured() -> None:
    # A scale of 1.5 stays below the 7.9 N of the device.
    for scale in (0.5, 1.5):
        run = simulate(
            "remote_push",
            overrides=[f"coupling.changes=[{{at_s=1.5, force_scale={scale}}}]", "run.duration_s=1.9", "link={}"],
        )
        measured = run.signals["environment_force"][:-1]
        felt = run.signals["rendered_force"][1:]
        count = min(len(measured), len(felt))
        for tick, share in ((1400, 0.0), (1600, 0.5), (count - 1, 1.0)):
            assert felt[tick] == pytest.approx((1.0 + share * (scale - 1.0)) * measured[tick], rel=0.03), (scale, tick)
        most = 1.5 * max(scale, 1.0) * np.abs(measured[1500:count]).max() / 200
        assert np.abs(np.diff(felt[1495:count])).max() <= most


def test_a_ladder_with_other_times() -> None:
    outage = 'link.forward.outages=[{times={kind="once", at_s=1.0, duration_s=0.06}}]'
    held = simulate("remote_push", overrides=[outage, "run.duration_s=1.5"])
    assert "hold" in {event.kind for event in held.events}
    patient = simulate(
        "remote_push",
        overrides=[outage, "run.duration_s=1.5", "safety.ladder={hold_after_s=0.1, extrapolate_s=0.02}"],
    )
    assert "hold" not in {event.kind for event in patient.events}
    assert {3.0} <= set(patient.signals["slave_state"]), "stale meanwhile"


def test_a_command_is_kept_within_its_reach() -> None:
    run = stroke("coupling.command_reach=0.01")
    displacement = run.signals["slave_command"] - run.signals["slave_command"][0]
    assert np.linalg.norm(displacement, axis=1).max() == pytest.approx(0.01, rel=1e-9)


def test_a_scene_with_changes_is_overridden_like_any_other() -> None:
    scene = override_scene(load_scene("remote_push"), ["coupling.changes=[{at_s=1.0, force_scale=0.5}]"])
    changed = override_scene(scene, ["coupling.changes.0.force_scale=0.25"])
    assert changed.coupling is not None
    assert changed.coupling.changes[0].force_scale == 0.25


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ("stale_after_s=0.02", "hold_after"),
        ("hold_after_s=0.101", "hold_after"),
        ("stop_after_s=0.01", "stop_after"),
        ("extrapolate_s=0.016", "extrapolate"),
        ("fade_out_s=0.2", "fade_out"),
        ("fade_in_s=0.1", "fade_in"),
        ("hold_after_s=nan", "hold_after_s = nan"),
    ],
)
def test_times_out_of_order_or_range_are_refused(given: str, said: str) -> None:
    with pytest.raises(SceneError, match=said):
        simulate("remote_push", overrides=[f"safety.ladder.{given}"])
