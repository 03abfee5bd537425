"""Activation of a gripper, in virtual time: its requests, its duration and its end."""

import pytest
from tests.gripper.virtual import gripper, performed, reply

from haptether.slave.robotiq.activation import ActivationError, activation
from haptether.slave.robotiq.protocol import Request, get
from haptether.slave.ur_emulator import EmulatedGripper


class Watched(EmulatedGripper):
    """Emulated gripper that records its settings and may ignore some."""

    sets: tuple[dict[str, int], ...] = ()
    ignored: frozenset[str] = frozenset()
    """Variables whose settings have no effect."""

    def write(self, values: dict[str, int]) -> None:
        self.sets = (*self.sets, values)
        if not self.ignored & values.keys():
            super().write(values)


def watched(**of: object) -> Watched:
    return Watched(gripper(**of).settings)  # type: ignore[arg-type]


def test_it_resets_waits_and_activates() -> None:
    of = watched(active=False)
    took_s = performed(of, activation())
    assert of.sets == ({"ACT": 0}, {"ATR": 0}, {"ACT": 1})
    assert reply(of, get("STA")) == 3
    # 0.5 s of pause, 2 s of motion, and a reading every 0.1 s.
    assert 2.4 < took_s < 2.8
    assert of.read("POS") == 3


@pytest.mark.parametrize("flt", [5, 7, 10, 12, 13, 14, 15])
def test_it_ends_the_faults_that_an_activation_ends(flt: int) -> None:
    of = watched()
    of.fail(flt)
    performed(of, activation())
    assert (of.read("STA"), of.read("FLT")) == (3, 0)


def test_a_reset_that_is_dropped_is_repeated() -> None:
    of = watched()
    of.ignored = frozenset({"ACT"})
    steps = activation()
    value: int | None = None
    for _ in range(30):
        step = steps.send(value)
        value = reply(of, step) if isinstance(step, Request) else None
    assert of.sets.count({"ACT": 0}) > 3
    assert {"ACT": 1} not in of.sets
    of.ignored = frozenset()
    # Continue after the last step, answered or waited for.
    while True:
        try:
            step = steps.send(value)
        except StopIteration:
            break
        value = reply(of, step) if isinstance(step, Request) else None
        if not isinstance(step, Request):
            of.advance(of._now_s + step)
    assert of.read("STA") == 3


@pytest.mark.parametrize(
    ("ignored", "flt", "said", "limit_s"),
    [
        ("ACT", 0, "reset: ACT 1 and STA 3 after 5 s: must both be 0", 6.0),
        ("", 13, "FLT 13: its activation failed: see that nothing is between the jaws", 5.0),
        ("", 8, "FLT 8: it is too hot", 5.0),
    ],
)
def test_it_gives_up_and_says_why(ignored: str, flt: int, said: str, limit_s: float) -> None:
    of = watched()
    of.ignored = frozenset({ignored})

    def failing() -> None:
        steps, value = activation(), None
        now_s = 0.0
        while now_s < limit_s:
            step = steps.send(value)
            value = reply(of, step) if isinstance(step, Request) else None
            if not isinstance(step, Request):
                now_s += step
                of.advance(now_s)
            if of.sets[-1:] == ({"ACT": 1},):
                of.fail(flt)

    with pytest.raises(ActivationError, match=said):
        failing()


def test_one_that_never_ends_is_given_up() -> None:
    answers, waited_s = {"ACT": 0, "STA": 0, "FLT": 0}, [0.0]

    def answered() -> None:
        steps, value = activation(), None
        while waited_s[0] < 60.0:
            step = steps.send(value)
            if not isinstance(step, Request):
                waited_s[0] += step
            elif step.text == b"SET ACT 1\n":
                answers.update(ACT=1, STA=1)
            value = answers[step.reads] if isinstance(step, Request) and step.reads is not None else None

    with pytest.raises(ActivationError, match="ACT 1 and STA 1 after 16 s: must be 1 and 3"):
        answered()
    assert 16.0 < waited_s[0] < 18.0
