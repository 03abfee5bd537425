"""Stability limits of simulated loops against closed forms; `benches/stability.py` has all rows of the tables."""

from functools import cache

import numpy as np
import pytest

from stability import (
    Case,
    damped_plant,
    delayed_spring,
    measure,
    spring_cases,
    teleoperator_case,
    teleoperator_cases,
    wall_cases,
)

pytestmark = pytest.mark.slow

TOLERANCE = 0.01
"""Relative tolerance of the simulated against the closed form; measured errors are within 0.5 %."""


@cache
def all_cases() -> dict[str, Case]:
    return {case.name: case for make in (wall_cases, spring_cases, teleoperator_cases) for case in make()}


def test_closed_forms_give_the_printed_figures() -> None:
    """Figures have 2 to 6 printed digits: the tolerance is half of the last digit, or 1 % of a figure of two digits."""
    for case in all_cases().values():
        assert case.printed is not None
        assert case.closed.gain == pytest.approx(case.printed, rel=3e-3), case.name
        assert case.sampled.gain == pytest.approx(case.closed.gain, rel=5e-3), case.name


def spectral_radius(stiffness: float, damping: float, period_s: float, late: int) -> float:
    """Return the largest root of the wall's loop: `(z - 1)(z - a) z^(d + 1) + (K z + B (z - 1) / T) (g_1 z + g_0)`."""
    mass_kg, viscous = 0.1, 0.5
    a = np.exp(-viscous / mass_kg * period_s)
    glide = (1.0 - a) * mass_kg / viscous
    position, velocity = (period_s - glide) / viscous, glide / mass_kg
    free = np.polymul([1.0, -1.0], [1.0, -a])
    response = np.array([position, glide * velocity - position * a])
    force = np.array([stiffness + damping / period_s, -damping / period_s])
    loop = np.polyadd(np.polymul(free, [1.0] + [0.0] * (late + 1)), np.polymul(force, response))
    return float(np.abs(np.roots(loop)).max())


def test_the_first_root_leaves_the_unit_circle_at_the_critical_stiffness() -> None:
    for case in wall_cases():
        late = int(case.name.split(" late")[0].split()[-1])
        damping = float(case.name.split("B ")[1])
        below, above = (
            spectral_radius(share * case.closed.gain, damping, case.period_s, late) for share in (1 - 1e-6, 1 + 1e-6)
        )
        assert below < 1.0 < above, case.name


def test_the_delayed_spring_has_the_limits_of_a_heavy_and_a_light_mass() -> None:
    for delay_s, mass_kg, limit in ((0.01, 1e4, 5.0 / 0.01), (0.5, 1e-4, 0.5 * np.pi * 5.0 / 0.5)):
        assert delayed_spring(mass_kg, 5.0, delay_s).gain == pytest.approx(limit, rel=1e-3)


@pytest.mark.parametrize(
    "name",
    [
        "wall, T 1 ms, 0 late, B 0",
        "wall, T 1 ms, 0 late, B 2",
        "wall, T 1 ms, 5 late, B 2",
        "wall, T 1 ms, 50 late, B 0",
        "wall, T 2 ms, 10 late, B 2",
        "delayed spring, m 0.1, b 0.5, 10 ms",
        "delayed spring, m 0.1, b 5, 500 ms",
        "delayed spring, m 1, b 5, 100 ms",
        "position-force, round trip 2 ms",
        "position-force, round trip 20 ms",
        "position-force, round trip 100 ms",
        "position-force, round trip 500 ms",
        "position-force, B_m 1, K_e 100000",
    ],
)
def test_a_simulated_loop_is_stable_up_to_its_closed_form(name: str) -> None:
    row = measure(all_cases()[name], tolerance=2e-3)
    assert abs(row.error) < TOLERANCE, row


@pytest.mark.sampled(2)
@pytest.mark.parametrize("number", [0, 1, 2, 3])
def test_position_force_is_stable_up_to_the_ratio_of_the_masses(number: int) -> None:
    """At 0.1 ms the loop is two periods late: up to 3 % less gain. The tight tolerance is to the sampled form."""
    fine = all_cases()[f"position-force, plant {number}, M_m / M_s"]
    coarse = [case for case in teleoperator_cases(within=0.04) if case.name == fine.name]
    row = measure(coarse[0], tolerance=2e-3)
    assert row.simulated == pytest.approx(row.sampled, rel=TOLERANCE)
    assert row.simulated == pytest.approx(row.closed, rel=0.05)
    assert row.ticks <= 1_000_000


def test_damping_at_the_master_moves_the_edge_as_the_closed_form_says() -> None:
    case = teleoperator_case("damped", damped_plant(20.0, 1e3), 0.0, None, within=0.05)
    row = measure(case, tolerance=2e-3)
    assert row.simulated == pytest.approx(row.sampled, rel=TOLERANCE)
