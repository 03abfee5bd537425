"""The engine against closed forms, a recursion in extended precision, and SciPy's DOP853 piece by piece."""

from functools import cache

import numpy as np
import pytest
from msgspec.structs import replace

from _piecewise import integrate, recursion
from _stepped import Method, step
from haptether.bridge import Run, Scene
from work_precision import (
    CONTACTS,
    bounce_error,
    bounces,
    held,
    path,
    press,
    ran,
    release_errors,
    rub,
    throw,
    thrown,
)

reference = cache(integrate)


def times(run: Run, kind: str) -> list[float]:
    return [event.time_s for event in run.events if event.kind == kind]


def test_an_undamped_wall_throws_at_sqrt_k_over_m_d() -> None:
    errors = release_errors()
    assert min(errors) == 10.0
    assert max(errors) == pytest.approx(1e6)
    assert max(errors.values()) < 1e-12


def test_an_undamped_bounce_keeps_its_energy_over_ten_thousand_contacts() -> None:
    error, contacts = bounce_error()
    assert contacts >= CONTACTS
    assert error < 1e-12


def test_the_throw_is_its_closed_form() -> None:
    run, truth = ran(throw()), thrown(throw())
    # Rounding of x, at most 1.4 m.
    assert np.abs(run.signals.position - truth.position).max() < 1e-15
    assert np.abs(run.signals.velocity - truth.velocity).max() < 4e-15
    assert times(run, "free") == pytest.approx(truth.left_s, rel=1e-14)


# DOP853 agrees with itself at other steps to 3e-15 m and 2e-13 m/s (the damped wall is stiffest).
@pytest.mark.parametrize("scene", [bounces(), path(), press(), rub()], ids=["bounces", "path", "press", "rub"])
def test_the_motion_is_that_of_dop853(scene: Scene) -> None:
    run, truth = ran(scene), reference(scene)
    assert np.abs(run.signals.position - truth.position).max() < 2e-14
    assert np.abs(run.signals.velocity - truth.velocity).max() < 1e-12
    assert times(run, "contact") == pytest.approx(truth.met_s, abs=1e-13)
    assert times(run, "free") == pytest.approx(truth.left_s, abs=1e-13)


def test_the_scenes_have_what_they_are_for() -> None:
    """Check the scenes: one without a bounce, or a grip without a slip, would prove nothing."""
    assert len(reference(bounces()).met_s) == 18
    velocity = reference(rub()).velocity
    assert np.count_nonzero(velocity == 0.0) > 10
    still = ran(replace(press(), operator=path().operator)).signals.velocity
    assert np.abs(still).max() < 0.2 < np.abs(ran(press()).signals.velocity).max()


def test_a_held_wall_is_its_recursion() -> None:
    run, truth = ran(held()), recursion(held())
    assert np.abs(run.signals.position - truth.position).max() < 1e-16
    assert np.abs(run.signals.velocity - truth.velocity).max() < 1e-14


@pytest.mark.parametrize(
    ("method", "order"),
    [("semi-implicit-euler", 1), ("velocity-verlet", 2), ("rk4", 4)],
)
def test_a_method_of_the_bench_has_its_order(method: Method, order: int) -> None:
    """Check the order of each method: a wrong reference would flatter the engine."""
    scene = path()
    truth = reference(scene)
    coarse, fine = (
        float(np.abs(step(scene, method, step_s).position - truth.position).max()) for step_s in (1e-3, 5e-4)
    )
    # The kinks of the path lie on step boundaries, so that each method keeps its order.
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.1)
