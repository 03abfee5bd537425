"""Numbers with a likely error of unit, and all others."""

import pytest

from haptether.bridge import load_scene, scene_names, unusual_numbers


def test_no_shipped_scene_has_one() -> None:
    assert {name: found for name in scene_names(attacks=True) if (found := unusual_numbers(load_scene(name)))} == {}


@pytest.mark.parametrize(
    ("path", "value", "said"),
    [
        ("link.forward.delay_s", "50", "s, and beyond the usual 2; did you mean 0.05 (50 ms)?"),
        ("link.backward.delay_s", "2500", "s, and beyond the usual 2; did you mean 0.0025 (2500 us)?"),
        ("operator.legs.0.end", "-45", "m, and beyond the usual 3; did you mean -0.045 (-45 mm)?"),
        ("safety.energy_threshold_j", "-30", "J, and beyond the usual 1; did you mean -0.03 (-30 mJ)?"),
        ("safety.limiter.max_force_n", "790", "N, and beyond the usual 200; did you mean 0.79 (790 mN)?"),
        ("environment.objects.0.contact.stiffness", "1e+09", "N/m, and beyond the usual 1e+08"),
    ],
)
def test_a_number_in_another_unit_is_reported(path: str, value: str, said: str) -> None:
    assert unusual_numbers(load_scene("remote_push", [f"{path}={value}"])) == [f"{path} = {value}: {said}"]


@pytest.mark.parametrize("change", ["link.forward.delay_s=2", "safety.energy_threshold_j=-1", "operator.stiffness=2e4"])
def test_usual_numbers_are_not_reported(change: str) -> None:
    assert unusual_numbers(load_scene("remote_push", [change])) == []


def test_positions_of_joints_are_no_metres() -> None:
    changes = ["master.kind=joints", "safety.velocity_threshold=8", "link.forward.delay_s=50"]
    assert unusual_numbers(load_scene("remote_push", changes)) == [
        "link.forward.delay_s = 50: s, and beyond the usual 2; did you mean 0.05 (50 ms)?"
    ]
