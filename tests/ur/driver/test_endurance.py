"""Rules for repeating an endurance run of a UR controller."""

from typing import Any

import pytest
from tests.ur.endurance import attempted, is_disturbed

SECONDS, PROCESSORS = 60.0, 2


def run(*, good: bool, stolen_s: float) -> dict[str, Any]:
    return {"good": good, "stolen_s": stolen_s}


@pytest.mark.parametrize(
    ("good", "stolen_s", "anew"),
    [
        # 1 % of a minute of two processors is 1.2 s.
        (False, 0.0, False),
        (False, 1.2, False),
        (False, 1.21, True),
        (True, 0.0, False),
        (True, 30.0, False),
    ],
)
def test_only_what_the_host_disturbed_is_measured_anew(good: bool, stolen_s: float, anew: bool) -> None:
    assert is_disturbed(run(good=good, stolen_s=stolen_s), SECONDS, PROCESSORS) is anew


BAD, DISTURBED, GOOD = run(good=False, stolen_s=0.1), run(good=False, stolen_s=2.0), run(good=True, stolen_s=2.0)


@pytest.mark.parametrize(
    ("runs", "made"),
    [
        ([GOOD], 1),
        ([BAD, GOOD], 1),
        ([DISTURBED, GOOD], 2),
        # A bad run that the host did not disturb counts, whatever came before.
        ([DISTURBED, BAD, GOOD], 2),
        ([DISTURBED, DISTURBED, DISTURBED, GOOD], 3),
    ],
)
def test_the_last_attempt_counts_and_all_are_reported(runs: list[dict[str, Any]], made: int) -> None:
    waiting = iter(runs)
    figures = attempted(lambda: next(waiting), 3, SECONDS, PROCESSORS)
    assert figures == {**runs[made - 1], "attempts": runs[:made]}


def test_one_attempt_is_one() -> None:
    assert attempted(lambda: dict(DISTURBED), 1, SECONDS, PROCESSORS)["attempts"] == [DISTURBED]
