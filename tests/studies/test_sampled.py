"""Means, shares and paired differences of a sweep: exact, or with the nominal coverage."""

import numpy as np
import pytest

from haptether.bridge import Sweep, sweep
from haptether.studies import sweep_summary
from haptether.studies.intervals import binomial_interval
from haptether.studies.sampled import bootstrap_interval


def table() -> Sweep:
    """Return two controllers, two delays, four seeds each, and one row that never engaged."""
    controllers = np.repeat(["none", "wsc"], 8)
    delays = np.tile(np.repeat([0.1, 0.2], 4), 2)
    seeds = np.tile([1.0, 2.0, 3.0, 4.0], 4)
    speeds = seeds + np.where(controllers == "wsc", -0.5 * delays, 0.0)
    speeds[3] = np.nan
    outcomes = np.where(np.isnan(speeds), "never-engaged", "complete")
    return Sweep(
        {"safety.controllers": controllers, "link.forward.delay_s": delays, "run.seed": seeds, "outcome": outcomes,
         "max_ejection_velocity": speeds, "false_trips": np.where(np.isnan(speeds), np.nan, seeds)}
    )  # fmt: skip


BY = ["safety.controllers", "link.forward.delay_s"]


def test_means_leave_out_what_was_not_measured() -> None:
    first, second, *_ = sweep_summary(table(), ["max_ejection_velocity"], BY)
    assert first.group == {"safety.controllers": "none", "link.forward.delay_s": 0.1}
    assert (first.rows, first.measured, first.mean) == (4, 3, 2.0)
    assert (second.rows, second.measured, second.mean) == (4, 4, 2.5)
    assert first.interval is not None
    assert 1.0 <= first.interval[0] < 2.0 < first.interval[1] <= 3.0
    assert first.pairs is None


def test_where_nothing_but_samples_varies_all_rows_are_one_combination() -> None:
    (row,) = sweep_summary(table(), ["false_trips"], [])
    assert (row.group, row.rows, row.measured, row.mean) == ({}, 16, 15, 36 / 15)


def test_shares_are_counted_and_their_interval_is_exact() -> None:
    quantities = ["max_ejection_velocity > 2", "outcome = complete", "false_trips<2"]
    found = {(row.quantity, *row.group.values()): row for row in sweep_summary(table(), quantities, BY)}
    above = found["max_ejection_velocity > 2", "none", 0.1]
    assert (above.measured, above.interval) == (3, binomial_interval(1, 3))
    assert above.mean == pytest.approx(1 / 3)
    assert found["outcome = complete", "none", 0.1].mean == 0.75
    assert found["outcome = complete", "wsc", 0.2].interval == binomial_interval(4, 4)
    assert found["false_trips<2", "none", 0.2].mean == 0.25


def test_differences_are_taken_sample_by_sample() -> None:
    found = sweep_summary(table(), ["max_ejection_velocity"], BY, baseline=("safety.controllers", "none"))
    of = {tuple(row.group.values()): row for row in found}
    assert of["none", 0.2].difference == 0.0
    # The seeds differ by 3 between rows, and not at all between pairs.
    for delay, pairs in ((0.1, 3), (0.2, 4)):
        row = of["wsc", delay]
        assert row.pairs == pairs
        assert row.difference == pytest.approx(-0.5 * delay)
        assert row.difference_interval == pytest.approx((-0.5 * delay, -0.5 * delay))


def test_the_bootstrap_holds_the_mean_as_often_as_it_says() -> None:
    rng = np.random.default_rng(5)
    held = 0
    for _ in range(200):
        low, high = bootstrap_interval(rng.exponential(1.0, 60), rng) or (0.0, 0.0)
        held += low <= 1.0 <= high
    # The known coverage for 60 exponential draws is 0.93; allow three standard deviations of 200 draws.
    assert 0.875 <= held / 200 <= 0.985
    assert bootstrap_interval(np.array([1.0]), rng) is None


@pytest.mark.parametrize(
    ("quantity", "by", "baseline", "said"),
    [
        ("speed", BY, None, "'speed': no column 'speed'"),
        ("outcome", BY, None, "is text: give a share"),
        ("outcome > 1", BY, None, "is text: must be outcome = VALUE"),
        (
            "outcome = complet",
            BY,
            None,
            "'outcome = complet': must be one of complete, settled, diverged, not-released, ",
        ),
        ("max_ejection_velocity>", BY, None, "must be METRIC > NUMBER, METRIC < NUMBER, METRIC = NUMBER or outcome"),
        ("max_ejection_velocity > fast", BY, None, "'fast' must be a number"),
        ("max_ejection_velocity > nan", BY, None, "must be a finite number"),
        ("max_ejection_velocity", ["outcome"], None, "by: outcome is what was measured"),
        ("max_ejection_velocity", BY, ("run.seed", 1.0), "baseline: run.seed is none of safety.controllers"),
        ("max_ejection_velocity", BY, ("safety.controllers", "hsc"), "must be of none, wsc"),
        ("max_ejection_velocity", BY[:1], ("safety.controllers", "none"), None),
    ],
)
def test_what_cannot_be_is_refused(
    quantity: str, by: list[str], baseline: tuple[str, object] | None, said: str | None
) -> None:
    if said is None:
        # The delay distinguishes the samples.
        assert all(row.pairs for row in sweep_summary(table(), [quantity], by, baseline=baseline))
        return
    with pytest.raises(ValueError, match=said):
        sweep_summary(table(), [quantity], by, baseline=baseline)


def test_of_a_sweep_that_was_run() -> None:
    rows = sweep(
        "paper_wall", {"safety.controllers": [[], ["wsc"]], "operator.stiffness": [300.0, 400.0], "run.seed": [1, 2]}
    )
    found = sweep_summary(
        rows, ["max_ejection_velocity>0.5"], ["safety.controllers"], baseline=("safety.controllers", "none")
    )
    assert [row.mean for row in found] == [1.0, 0.0]
    assert found[1].difference == -1.0
    assert found[1].pairs == 4
