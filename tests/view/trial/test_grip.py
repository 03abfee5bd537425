"""Who may grip: one page, with a fresh token, and after a lapse only from an open hand."""

import pytest

from haptether.view.trial.hand import MAX_AGE_US, Aim, Grip

MS = 1000


def aim(strength_n: float, token: int) -> Aim:
    return Aim(token=token, target=(0.0,), stiffness=300.0, damping=5.0, strength_n=strength_n)


@pytest.mark.parametrize(
    ("acts", "refused"),
    [
        # Page, time in ms, age of the token in ms, strength in N.
        ([("a", 0, 0, 6.0), ("a", 400, 400, 6.0)], None),
        ([("a", 0, 401, 6.0)], "the page was late"),
        ([("a", 0, 0, 6.0), ("a", 900, 900, 0.0), ("a", 910, 0, 6.0)], None),
        ([("a", 0, 0, 6.0), ("a", 401, 0, 6.0)], "the aims stopped for more than 0.4 s"),
        ([("a", 0, 0, 6.0), ("a", 500, 0, 0.0), ("a", 510, 0, 6.0)], None),
        # An open hand may rest.
        ([("a", 0, 0, 6.0), ("a", 10, 0, 0.0), ("a", 5000, 0, 6.0)], None),
        ([("a", 0, 0, 6.0), ("b", 400, 0, 6.0)], "another page holds the stylus"),
        ([("a", 0, 0, 6.0), ("b", 400, 0, 0.0)], "another page holds the stylus"),
        ([("a", 0, 0, 6.0), ("b", 401, 0, 6.0)], None),
        # The first page returns after the second has held.
        ([("a", 0, 0, 6.0), ("b", 401, 0, 6.0), ("a", 802, 0, 6.0)], "the aims stopped for more than 0.4 s"),
        ([("a", 0, 0, 6.0), ("b", 401, 0, 6.0), ("a", 802, 0, 0.0), ("a", 803, 0, 6.0)], None),
    ],
)
def test_aims_of_pages(acts: list[tuple[str, int, int, float]], refused: str | None) -> None:
    grip = Grip()
    for page, at_ms, age_ms, strength_n in acts:
        at_us = (10_000 + at_ms) * MS
        asked = aim(strength_n, at_us - age_ms * MS)
        found = grip.refusal(page, asked, at_us, asked.token)
    if refused is None:
        assert found is None
    else:
        assert found is not None
        assert found.startswith(refused)


def test_a_page_that_leaves_holds_nothing() -> None:
    grip = Grip()
    assert grip.refusal("a", aim(6.0, MAX_AGE_US), MAX_AGE_US, MAX_AGE_US) is None
    assert grip.is_gripping("a")
    grip.leave("a")
    assert not grip.is_gripping("a")
    assert grip.refusal("b", aim(6.0, MAX_AGE_US), MAX_AGE_US + 1, MAX_AGE_US) is None


def test_a_grip_lapses_when_its_sides_restart() -> None:
    grip = Grip()
    at_us = MAX_AGE_US
    assert grip.refusal("a", aim(6.0, at_us), at_us, at_us) is None
    grip.lapse("b")
    assert grip.is_gripping("a")
    grip.lapse()
    assert not grip.is_gripping("a")
    # Another page may take the stylus, and the first must let go of its button.
    refused = grip.refusal("a", aim(6.0, at_us), at_us, at_us)
    assert refused is not None
    assert "let go, and grip again" in refused
    assert grip.refusal("b", aim(6.0, at_us), at_us, at_us) is None


@pytest.mark.parametrize("token", [0, MAX_AGE_US - 1, MAX_AGE_US + 1, 2**62])
def test_a_token_other_than_the_last_opens_only(token: int) -> None:
    grip = Grip()
    assert grip.refusal("a", aim(6.0, token), MAX_AGE_US, MAX_AGE_US) is not None
    assert grip.refusal("a", aim(0.0, token), MAX_AGE_US, MAX_AGE_US) is None
