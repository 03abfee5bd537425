"""Rows that differ only in their controllers run together until one intervenes: the numbers stay the same."""

from typing import Any

import numpy as np
import pytest

from haptether.bridge import load_scene, override_scene, simulate, sweep
from haptether.bridge.scene.sweeps.design import design_of

CHOICES: list[Any] = [[], ["wsc"], ["hsc"], ["wsc", "hsc", "vfc", "pc"]]
METRICS = (
    "max_ejection_velocity",
    "peak_device_force",
    "time_to_trip_s",
    "passivity_min_j",
    "position_rmse_m",
    "force_rmse_n",
)


@pytest.mark.parametrize("scene", ["remote_push", "three_axis_box", "torque_release", "paper_wall"])
def test_a_sweep_of_controllers_is_its_simulations(scene: str) -> None:
    seeds = [1, 4]
    found = sweep(scene, {"safety.controllers": CHOICES, "run.seed": seeds})
    alone = [
        simulate(override_scene(load_scene(scene), [f"safety.controllers={choice}", f"run.seed={seed}"])).metrics
        for choice in CHOICES
        for seed in seeds
    ]
    for name in METRICS:
        one_by_one = np.array([np.nan if (value := getattr(one, name)) is None else value for one in alone])
        np.testing.assert_array_equal(found[name], one_by_one, err_msg=name)
    # Controllers intervene in different ways, so that the comparison has content.
    different = {tuple(found[name][row] for name in METRICS) for row in range(len(found))}
    assert len(different) >= 2 * len(seeds) or scene == "torque_release"


def test_a_choice_that_cannot_be_is_refused_and_the_others_are_run() -> None:
    choices: list[Any] = [["wsc"], ["none-of-these"], []]
    found = sweep("remote_push", {"safety.controllers": choices, "run.seed": [1, 2]})
    assert found["outcome"].tolist()[2:4] == ["refused"] * 2
    assert "none-of-these" in found["reason"][2]
    alone = sweep("remote_push", {"safety.controllers": [["wsc"], []], "run.seed": [1, 2]})
    kept = [0, 1, 4, 5]
    np.testing.assert_array_equal(found["max_ejection_velocity"][kept], alone["max_ejection_velocity"])


def test_progress_grows_to_the_rows_at_most() -> None:
    done: list[int] = []
    sweep("remote_push", {"safety.controllers": CHOICES, "run.seed": list(range(1, 101))}, progress=done.append)
    assert done
    assert done == sorted(done)
    assert done[-1] <= 400


@pytest.mark.parametrize(
    ("grid", "samples", "first", "size", "end"),
    [
        # Three choices of 20 samples are 60 rows.
        ({"link.forward.delay_s": [0.1, 0.2, 0.3], "safety.controllers": [[], ["wsc"], ["hsc"]]}, 20, 0, 64, 120),
        ({"link.forward.delay_s": [0.1, 0.2, 0.3], "safety.controllers": [[], ["wsc"], ["hsc"]]}, 20, 120, 64, 180),
        # These are too many to keep together.
        ({"link.forward.delay_s": [0.1, 0.2], "safety.controllers": [[], ["wsc"], ["hsc"]]}, 100, 0, 64, 64),
        # All of them may run together.
        ({"safety.window": [50, 60], "link.forward.delay_s": [0.1, 0.2]}, 50, 0, 64, 200),
        # None may run together.
        ({"link.forward.delay_s": [0.1, 0.2]}, 100, 0, 64, 64),
    ],
)
def test_batches_part_no_rows_that_may_begin_alike(
    grid: dict[str, Any], samples: int, first: int, size: int, end: int
) -> None:
    design = design_of(grid, {"run.seed": [float(seed) for seed in range(samples)]})
    assert design.end_of_batch(first, size) == end
