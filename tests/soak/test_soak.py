"""A short soak, and proof that a soak can fail."""

import pytest
from tests.soak.__main__ import soak, table
from tests.soak.memory import ALLOWED_BYTES, growth

pytestmark = pytest.mark.live

KIB = 1024


@pytest.mark.parametrize(
    ("name", "samples", "is_flat"),
    [
        ("constant", [40_000 * KIB] * 600, True),
        # Memory grows only during the warm-up.
        ("warm-up", [min(n, 290) * 100 * KIB for n in range(600)], True),
        ("a step of an allocator", [1000 * KIB + (64 * KIB if n > 450 else 0) for n in range(600)], True),
        ("two of them", [1000 * KIB + (128 * KIB if n > 450 else 0) for n in range(600)], False),
        ("half a byte a tick", [1000 * KIB + n * 500 for n in range(600)], False),
        ("it shrinks by as much", [2000 * KIB - n * 500 for n in range(600)], False),
        ("a tenth of a byte a tick", [1000 * KIB + n * 100 for n in range(600)], True),
        ("a saw that comes back", [1000 * KIB + n % 10 * 300 * KIB for n in range(600)], True),
    ],
)
def test_flat_is_what_neither_grows_nor_shrinks(name: str, samples: list[int], is_flat: bool) -> None:
    assert growth(samples, 1.0).is_flat is is_flat, name


def test_a_long_soak_allows_as_much_for_each_five_minutes() -> None:
    assert growth([0] * 20, 1.0).allowed_bytes == ALLOWED_BYTES
    assert growth([0] * 600, 1.0).allowed_bytes == ALLOWED_BYTES
    assert growth([0] * 6000, 1.0).allowed_bytes == 10 * ALLOWED_BYTES


@pytest.mark.thorough
def test_a_short_soak_samples_three_processes() -> None:
    """Flat memory shows only later, once each page of the rings has been touched."""
    lines: list[str] = []
    result = soak(12.0, lines.append)
    assert list(result["processes"]) == ["slave", "network", "master"]
    shown = table(result)
    for name, one in result["processes"].items():
        assert "ended_early" not in one, shown
        assert name in shown
        assert len(one["sampled_bytes"]) == len(lines) == 12
        # An interpreter with NumPy is within these bounds.
        assert all(5e6 < held < 2e9 for held in one["sampled_bytes"])
    for name in ("slave", "master"):
        one = result["processes"][name]
        assert one["report"]["ticks"] + one["report"]["skipped_ticks"] > 9000
        # The outside count also includes cycles that were late but not skipped.
        assert one["late_cycles"] < one["report"]["ticks"]
