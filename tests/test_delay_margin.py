"""How much delay a coupling bears, against the closed forms and tables of docs and literature."""

import math

import pytest

from haptether.bridge import run_bridge
from haptether.studies import ContactLoop, Follower, largest_delay_s

DELAYS_S = (1e-3, 10e-3, 20e-3, 50e-3, 100e-3, 200e-3, 500e-3)
# Critical stiffness of m x'' + b x' + K x(t - T) = 0 in N/m, four digits.
DELAYED_SPRING = {
    (0.1, 0.5): (500.4, 50.41, 25.41, 10.40, 5.374, 2.837, 1.256),
    (0.1, 5.0): (5041, 537.4, 283.7, 125.6, 67.92, 36.09, 15.13),
    (1.0, 5.0): (5004, 504.1, 254.1, 103.9, 53.74, 28.37, 12.56),
}
SLOW_ARM = Follower(mass_kg=2.0, damping=80.0, stiffness=800.0, follows_velocity=True)


@pytest.mark.parametrize(("mass_kg", "damping"), DELAYED_SPRING)
def test_a_delayed_spring_oscillates_at_its_critical_stiffness(mass_kg: float, damping: float) -> None:
    for stiffness, delay_s in zip(DELAYED_SPRING[mass_kg, damping], DELAYS_S, strict=True):
        found_s = largest_delay_s(ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness))
        # The table has four digits; K goes as 1/T or weaker, so T has them times at most two.
        assert found_s == pytest.approx(delay_s, rel=1e-3)


@pytest.mark.parametrize("stiffness", [0.3, 7.0, 200.0, 1e4])
@pytest.mark.parametrize("damping", [0.05, 2.0, 40.0])
def test_it_is_the_closed_form(stiffness: float, damping: float) -> None:
    mass_kg = 0.157
    # w² of |m (jw)² + b jw| = K, and T = atan(b / (m w)) / w.
    ratio = damping**2 / (2.0 * mass_kg**2)
    frequency = math.sqrt(-ratio + math.hypot(ratio, stiffness / mass_kg))
    expected_s = math.atan2(damping, mass_kg * frequency) / frequency
    loop = ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness)
    assert largest_delay_s(loop) == pytest.approx(expected_s, rel=1e-7)
    scaled = ContactLoop(mass_kg=mass_kg, damping=damping, environment_stiffness=stiffness / 4.0, force_scale=4.0)
    assert largest_delay_s(scaled) == pytest.approx(expected_s, rel=1e-7)


@pytest.mark.parametrize(
    ("force_scale", "delay_s"),
    [
        (0.334, 2e-3), (0.284, 5e-3), (0.232, 10e-3), (0.178, 20e-3), (0.124, 50e-3), (0.0988, 100e-3),
        (0.0739, 200e-3), (0.0358, 500e-3),
    ],
)  # fmt: skip
def test_an_arm_that_follows_slowly_is_part_of_the_loop(force_scale: float, delay_s: float) -> None:
    loop = ContactLoop(
        mass_kg=0.1, damping=5.0, environment_stiffness=1000.0, force_scale=force_scale, follower=SLOW_ARM
    )
    # Scales of three digits, delays to which they are up to three times as sensitive.
    assert largest_delay_s(loop) == pytest.approx(delay_s, rel=0.01)


@pytest.mark.parametrize(
    ("damping", "stiffness", "critical"),
    [(1, 1e2, 0.45), (1, 1e4, 0.054), (5, 1e2, 3.23), (5, 1e3, 0.383), (20, 1e3, 3.61), (20, 1e5, 0.0945)],
)
def test_beyond_the_scale_that_no_delay_bears_it_bears_none(damping: float, stiffness: float, critical: float) -> None:
    def at(force_scale: float) -> float:
        return largest_delay_s(
            ContactLoop(
                mass_kg=0.1,
                damping=damping,
                environment_stiffness=stiffness,
                force_scale=force_scale,
                follower=SLOW_ARM,
            )
        )

    assert at(0.98 * critical) > 0.0
    assert at(1.02 * critical) == 0.0


def test_a_soft_wall_under_a_firm_hand_bears_any_delay() -> None:
    loop = ContactLoop(mass_kg=0.157, damping=8.0, hand_stiffness=300.0, environment_stiffness=100.0)
    assert largest_delay_s(loop) == math.inf


def test_the_arm_of_check_link_is_the_simulated_one() -> None:
    from haptether.cli.check_link import simulated_arm
    from haptether.slave import Arm

    assert simulated_arm().stiffness == pytest.approx(Arm().stiffness, rel=1e-12)


@pytest.mark.parametrize(("share", "grows"), [(0.7, False), (1.4, True)])
def test_the_bridge_in_virtual_time_oscillates_beyond_it(share: float, grows: bool) -> None:
    """The same loop, sampled, with a hand that holds: calm below what it bears, growing above."""
    import numpy as np

    from haptether.bridge import MasterSettings, SlaveSettings
    from haptether.cli.check_link import simulated_loop
    from haptether.cli.options import START_M
    from haptether.master import Hand, HapticDevice
    from haptether.netsim import LinkSettings
    from haptether.safety import LimiterSettings
    from haptether.slave import Arm, Wall

    stiffness = 400.0
    bearable_s = largest_delay_s(simulated_loop(stiffness, 1.0))
    # Both sides sample and hold for 2.5 ms in all, see `judge_link` for 1.5 of it; the rest waits for ticks.
    link = LinkSettings(delay_s=(share * bearable_s - 2.5e-3) / 2.0)
    hand = Hand(stiffness=300.0, damping=8.0, strength_n=1e3, start=START_M, legs=[(1.2, -0.045, "minimum-jerk")])
    master = MasterSettings(
        HapticDevice.phantom_desktop(encoder_quantum=0.0), hand, limiter=LimiterSettings(max_force_n=1e3)
    )
    slave = SlaveSettings(Arm(), Wall(stiffness=stiffness), position=START_M)
    trace, *_ = run_bridge(master, slave, forward=link, backward=link, duration_s=4.0)
    velocity = np.abs(trace.velocity)
    early, late = (float(velocity[(trace.time_s > at) & (trace.time_s < at + 0.5)].max()) for at in (1.7, 3.4))
    if grows:
        assert late > 0.1
    else:
        assert late < 1e-3 or late < 0.5 * early
