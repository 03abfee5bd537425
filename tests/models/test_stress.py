"""Loops far beyond physical settings: they end in time with finite numbers, and report time and cause of divergence."""

import time
from itertools import product
from typing import Any

import msgspec
import numpy as np
import pytest
from tests.scene.test_properties import check

from haptether.bridge import Run, Scene, SceneError, simulate, sweep

pytestmark = pytest.mark.slow

STIFF = 1e7
"""Stiffness in N/m: four orders above a wall that a hand can tell from steel."""
SHAPES: dict[str, dict[str, Any]] = {
    "plane": {"kind": "plane"},
    "sphere": {"kind": "sphere", "radius": 0.05},
    "box": {"kind": "box", "half_extents": 0.05},
    "spring": {"kind": "spring"},
}
"""Shapes whose surface, or whose spring's anchor, is at x = 0."""
MAX_OF_REAL_TIME = 100.0
"""Largest ratio of processor time to simulated time; processor time does not depend on other load."""


def run(raw: dict[str, Any]) -> Run:
    """Run a scene; check the invariants of every run, and a processor time of at most 100 times the duration."""
    scene = msgspec.convert(raw, Scene)
    begun_s = time.process_time()
    done = simulate(scene)
    took_s = time.process_time() - begun_s
    check(done, scene)
    simulated_s = done.metrics.ticks * scene.run.period_s
    assert took_s < 0.5 + MAX_OF_REAL_TIME * simulated_s, raw
    return done


def stressed(axes: int, has_arm: bool, *, shape: str, law: str, period_s: float, viscous: float) -> dict[str, Any]:
    """Press a device of one gram on the hardest contacts with a hand."""
    duration_s = 0.02 if period_s < 1e-3 else 0.5
    contact: dict[str, Any] = {"law": law, "stiffness": STIFF, "damping": 1.0}
    along = [1.0] + [0.0] * (axes - 1)
    placed = dict(SHAPES[shape])
    if shape in {"sphere", "box"}:
        placed["centre"] = [-0.05 * share for share in along]
    # A spring acts from the start.
    start = [(1e-5 if shape == "spring" else 1e-3) * share for share in along]
    if axes > 1 and shape != "spring":
        contact["friction"] = 0.5
    raw: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": duration_s, "period_s": period_s},
        "master": {"axes": axes, "mass_kg": 1e-3, "viscous": viscous, "velocity": -0.1},
        "operator": {
            "stiffness": 300.0, "damping": 1.0, "start": start, "legs": [{"duration_s": duration_s / 2, "end": -0.02}]
        },
        "environment": {"objects": [{"shape": placed, "contact": contact}]},
        "safety": {"estimator": {"kind": "backward-difference"}, "limiter": {"enabled": False}},
        "record": {},
    }  # fmt: skip
    if has_arm:
        link = {"delay_s": 0.005}
        raw["slave"] = {"control": "pd", "stiffness": 1e4, "mass_kg": 0.5}
        raw["link"] = {"forward": link, "backward": link}
    return raw


@pytest.mark.parametrize("has_arm", [False, True])
@pytest.mark.parametrize("axes", [1, 3])
def test_every_shape_law_and_rate_ends_with_numbers(axes: int, has_arm: bool) -> None:
    laws = ("kelvin-voigt", "hunt-crossley")
    for shape, law, period_s, viscous in product(SHAPES, laws, (1e-5, 1e-3, 2e-2), (-0.005, -0.5)):
        if (shape, law) != ("spring", "hunt-crossley"):
            run(stressed(axes, has_arm, shape=shape, law=law, period_s=period_s, viscous=viscous))


@pytest.mark.parametrize("axes", [1, 3])
def test_continuous_walls_end_with_numbers(axes: int) -> None:
    for period_s, viscous in product((1e-5, 1e-3, 2e-2), (-0.005, -0.5)):
        raw = stressed(axes, False, shape="plane", law="kelvin-voigt", period_s=period_s, viscous=viscous)
        raw["environment"]["objects"][0]["contact"] = {"stiffness": STIFF, "damping": 1.0}
        raw["environment"]["rendering"] = "continuous"
        run(raw)


def unstable(axes: int, has_arm: bool) -> dict[str, Any]:
    """Return a spring far above the stability bound of its rate and its delay."""
    raw: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": 20.0},
        "master": {"axes": axes, "mass_kg": 0.1, "viscous": 0.5, "position": 1e-3},
        "environment": {"objects": [{"shape": {"kind": "spring"}, "contact": {"stiffness": 5000.0}}]},
        "safety": {"limiter": {"enabled": False}},
        "record": {},
    }
    if has_arm:
        raw["slave"] = {"control": "pd", "stiffness": 800.0, "damping": 80.0, "mass_kg": 2.0}
        raw["link"] = {"forward": {"delay_s": 0.02}, "backward": {"delay_s": 0.02}}
        raw["environment"]["pushers"] = [{"at_s": 0.3, "duration_s": 0.05, "force_n": 1.0}]
    return raw


@pytest.mark.parametrize("has_arm", [False, True])
@pytest.mark.parametrize("axes", [1, 3])
def test_a_loop_that_diverges_says_when_and_why_and_stops(axes: int, has_arm: bool) -> None:
    done = run(unstable(axes, has_arm))
    assert done.metrics.diverged
    end = done.events[-1]
    assert end.kind == "diverged"
    assert end.detail.startswith(("the device", "the arm", "fault of the"))
    assert done.metrics.ticks < 20_000
    assert np.abs(done.signals["position"]).max() <= 10.0


@pytest.mark.parametrize("has_arm", [False, True])
@pytest.mark.parametrize("period_s", [2.4e-5, 1.1e-4, 1e-3])
def test_what_is_too_stiff_is_taken_coarsely_and_reported_at_any_rate(period_s: float, has_arm: bool) -> None:
    """Use a spring that drags a body of 0.3 g with 2e5 N s/m: a rate of 7e8 / s. Short ticks make no difference."""
    raw = unstable(3, has_arm)
    raw["run"] = {"duration_s": 100 * period_s, "period_s": period_s}
    drags = {"stiffness": 5e3, "damping": 2e5}
    raw["environment"]["objects"] = [
        {"shape": {"kind": "spring"}, "contact": drags, "body": {"mass_kg": 3e-4, "velocity": 5.0}}
    ]
    done = run(raw)
    assert any(event.kind == "coarse" for event in done.events) or done.metrics.diverged


def test_an_arm_that_meets_impossible_numbers_has_diverged() -> None:
    raw = unstable(1, True)
    raw["environment"]["objects"][0] = {
        "shape": {"kind": "spring", "anchor": 0.5}, "contact": {"stiffness": STIFF}
    }  # fmt: skip
    done = run(raw)
    assert done.metrics.diverged
    assert "fault of the slave: environment force exceeds 10000 N" in done.events[-1].detail


def test_an_arm_that_leaves_its_room_has_diverged() -> None:
    raw = unstable(1, True)
    raw["run"]["diverged_position"] = 0.02
    raw["environment"]["objects"] = []
    raw["environment"]["pushers"] = [{"force_n": 100.0}]
    done = run(raw)
    assert done.events[-1].detail.startswith("the arm was 2.0")


def test_long_delays_lose_nothing_and_stay_finite() -> None:
    """Put more frames in flight than a network queue holds: in virtual time the queue grows as needed."""
    raw = unstable(1, True)
    raw["run"] = {"duration_s": 2.2, "period_s": 1e-5}
    raw["link"] = {"forward": {"delay_s": 1.0}, "backward": {"delay_s": 1.0}}
    raw["record"] = {"every": 100}
    done = run(raw)
    kinds = [event.kind for event in done.events]
    assert "engaged" in kinds
    assert "lost" not in kinds
    assert "hold" not in kinds


def test_a_spring_five_seconds_late_diverges() -> None:
    local = unstable(1, False)
    local["run"]["duration_s"] = 100.0
    local["environment"]["delay_ticks"] = 5000
    assert run(local).metrics.diverged
    remote = unstable(1, True)
    remote["run"]["duration_s"] = 100.0
    # A press waits for 5 s: with a round trip of the same length it never engages.
    remote["link"] = {"forward": {"delay_s": 2.5}, "backward": {"delay_s": 2.5}}
    assert run(remote).metrics.outcome == "never-engaged"
    remote["link"] = {"forward": {"delay_s": 2.4}, "backward": {"delay_s": 2.4}}
    assert run(remote).metrics.diverged


@pytest.mark.thorough
def test_ten_million_ticks() -> None:
    """A free oscillation keeps its energy over 1e7 ticks: at K = b / T the wall's held force returns the loss by b."""
    raw: dict[str, Any] = {
        "schema": 1,
        "run": {"duration_s": 100.0, "period_s": 1e-5},
        "master": {"mass_kg": 0.1, "viscous": 0.0005, "position": 1e-3, "measures_velocity": True},
        "environment": {"objects": [{"shape": {"kind": "spring"}, "contact": {"stiffness": 100.0}}]},
        "safety": {"signals": "true", "limiter": {"enabled": False}},
        "record": {"every": 1000},
    }
    done = run(raw)
    assert done.metrics.ticks == 10_000_000
    position, velocity = done.signals["position"], done.signals["velocity"]
    energy = 0.5 * 0.1 * velocity**2 + 50.0 * position**2
    assert energy[-1000:].mean() == pytest.approx(energy[:1000].mean(), rel=2e-3)


def test_a_diverged_row_is_marked_in_a_sweep() -> None:
    scene = msgspec.convert(unstable(1, False), Scene)
    stiffness = [10.0, 400.0, 2000.0, 5000.0, STIFF]
    for lanes in (True, False):
        table = sweep(scene, {"environment.objects.0.contact.stiffness": stiffness}, threads=1, lanes=lanes)
        assert table["diverged"].tolist() == [False, False, True, True, True]


@pytest.mark.parametrize(
    ("contact", "message"),
    [
        ({"law": "hunt-crossley"}, "[environment.objects.0.contact] law: a spring is linear"),
        ({"friction": 0.5}, "[environment.objects.0.contact] friction = 0.5: must be 0 for a spring"),
    ],
)
def test_a_spring_has_no_surface_and_no_other_law(contact: dict[str, Any], message: str) -> None:
    raw = unstable(3, False)
    raw["environment"]["objects"][0]["contact"] |= contact
    with pytest.raises(SceneError) as refused:
        run(raw)
    assert str(refused.value).startswith(message)


def test_points_of_a_recording_are_apart() -> None:
    raw = unstable(1, False)
    raw["operator"] = {"recorded": {"time_s": [0.0, 1e-300], "values": [0.0, 1.0]}}
    with pytest.raises(SceneError, match="at least 1e-09 s after the time before it"):
        run(raw)
    raw["operator"] = {"recorded": {"time_s": [1e-300, 0.1], "values": [0.0, 0.001]}}
    run(raw)


def test_a_normal_of_any_length_is_a_direction() -> None:
    raw = unstable(3, False)
    raw["run"]["duration_s"] = 0.1
    ends = []
    for length in (1.0, 1e-200, 1e8):
        shape = {"kind": "plane", "normal": [-0.6 * length, 0.8 * length, 0.0]}
        raw["environment"]["objects"] = [{"shape": shape, "contact": {"stiffness": 100.0}}]
        ends.append(run(raw).signals["position"][-1])
    assert np.allclose(ends, ends[0], rtol=0.0, atol=1e-12)
