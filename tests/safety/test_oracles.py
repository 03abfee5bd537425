"""Observers and controllers against the paper's equations, reimplemented in NumPy.

Tolerances are bounds on rounding: u is half an ulp of 1, and each sum or product errs by at most u of its size. Trips
are not compared in ticks whose observer is within its bound of the threshold: both answers are right there.
"""

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.safety import (
    DeviceModel,
    HandGraspObserver,
    PassivityObserver,
    SafetyController,
    SafetyObserver,
    SafetySettings,
    VelocityForceObserver,
    WindowedSafetyObserver,
)

Array = npt.NDArray[np.float64]

U = 2.0**-53
DT = 1e-3
MASS = 0.157
TICKS = 300

axes_and_seed = given(axes=st.sampled_from((1, 2, 3, 4, 5, 6, 7)), seed=st.integers(0, 2**32))


def signals(axes: int, seed: int) -> tuple[Array, Array, Array]:
    """Return V, F_v and F_h: noise of changing strength, with rests."""
    random = np.random.default_rng(seed)
    strength = np.exp(random.normal(size=(3, TICKS, 1)))
    noise = random.normal(size=(3, TICKS, axes)) * strength * np.array([0.3, 2.0, 2.0])[:, None, None]
    noise[random.random((3, TICKS)) < 0.1] = 0.0
    velocity, rendered, grasp = noise
    return velocity, rendered, grasp


def dot(left: Array, right: Array) -> Array:
    return np.asarray((left * right).sum(axis=1))


def norm(vectors: Array) -> Array:
    return np.sqrt(dot(vectors, vectors))


def sum_so_far(power: Array) -> tuple[Array, Array]:
    """Return the sum of Eq. 9 up to each tick, and the permitted difference between NumPy's and ours."""
    sizes = np.cumsum(np.abs(power))
    # The oracle adds n terms, each rounded; ours compensates and errs by less.
    return DT * np.cumsum(power), DT * U * (2 * np.arange(len(power)) + 30) * sizes


def kinetic(velocity: Array, energy_ratio: float) -> Array:
    return np.asarray(MASS * dot(velocity, velocity) / (2 * energy_ratio))


@axes_and_seed
def test_eq_1_velocity_and_force(axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    observer = VelocityForceObserver(velocity_threshold=0.7, force_threshold_n=1.3, axes=axes)
    seen = observer.run(velocity, rendered, grasp)
    expected = dot(velocity, rendered) / (0.7 * 1.3)
    # On both sides: a product and a sum per axis, a product of the thresholds, a division.
    bound = U * (4 * axes + 4) * dot(abs(velocity), abs(rendered)) / (0.7 * 1.3)
    assert np.all(abs(seen - expected) <= bound)


@axes_and_seed
def test_eq_1_as_the_text_reads_it(axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    observer = VelocityForceObserver(velocity_threshold=0.7, force_threshold_n=1.3, form="both", axes=axes)
    seen = observer.run(velocity, rendered, grasp)
    force = norm(rendered)
    pushed = np.where(force > 0, force, 1.0)
    along = dot(velocity, rendered) / pushed
    expected = np.where(force > 0, np.minimum(along / 0.7, force / 1.3), 0.0)
    # As above, with the norm's roundings added; |V·F| / |F| <= |V|.
    bound = U * (8 * axes + 16) * (norm(velocity) / 0.7 + force / 1.3)
    assert np.all(abs(seen - expected) <= bound)


@axes_and_seed
def test_eq_4_grasp_force(axes: int, seed: int) -> None:
    velocity, acceleration, force = signals(axes, seed)
    random = np.random.default_rng(seed)
    mass = random.uniform(0.05, 0.5, axes)
    viscous = random.normal(size=axes)
    coulomb = random.uniform(0.0, 0.1, axes)
    device = DeviceModel(mass_kg=list(mass), viscous=list(viscous), coulomb=list(coulomb), axes=axes)
    seen = device.grasp_force(velocity, acceleration, force)
    speed = norm(velocity)[:, None]
    # sign(V) of a vector is its direction; for one axis it is the sign.
    direction = velocity / np.where(speed > 0, speed, 1.0)
    if axes == 1:
        assert np.array_equal(direction, np.sign(velocity))
    parts = [mass * acceleration, viscous * velocity, coulomb * direction, -force]
    # A part has four roundings (the root halves the norm's), their sum three, twice.
    bound = U * (2 * axes + 16) * sum(abs(part) for part in parts)
    assert np.all(abs(seen - sum(parts)) <= bound)


@axes_and_seed
def test_eq_5_hand_grasp(axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    seen = HandGraspObserver(grasp_floor_n=0.002, axes=axes).run(velocity, rendered, grasp)
    expected = norm(rendered) / (norm(grasp) + 0.002)
    # A norm of n axes has n roundings under the root, which halves them, and one of the root.
    assert np.all(abs(seen - expected) <= U * (2 * axes + 8) * expected)


@axes_and_seed
def test_eq_9_safety(axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    device = DeviceModel(mass_kg=MASS, axes=axes)
    seen = SafetyObserver(device, energy_ratio=0.4).run(velocity, rendered, grasp)
    power, size = dot(grasp, velocity), dot(abs(grasp), abs(velocity))
    total, bound = sum_so_far(power)
    bound += DT * U * 2 * axes * np.cumsum(size)
    moving = kinetic(velocity, 0.4)
    bound += U * (4 * axes + 10) * moving + 2 * U * abs(seen)
    assert np.all(abs(seen - (total - moving)) <= bound)


@given(
    axes=st.sampled_from((1, 3, 7)),
    seed=st.integers(0, 2**32),
    window=st.one_of(st.integers(1, 40), st.integers(TICKS - 1, 2 * TICKS)),
)
def test_eq_11_windowed_safety(axes: int, seed: int, window: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    device = DeviceModel(mass_kg=MASS, axes=axes)
    observer = WindowedSafetyObserver(device, energy_ratio=0.4, window=window)
    seen = observer.run(velocity, rendered, grasp)
    power, size = dot(grasp, velocity), dot(abs(grasp), abs(velocity))
    for n in range(1, TICKS + 1):
        first = n - window + 1 if n >= window else 1
        moving = float(kinetic(velocity[n - 1 : n], 0.4)[0])
        expected = DT * power[first - 1 : n].sum() - moving
        # The running sum lives for at most two windows. It has that many additions and subtractions, none of a sum
        # larger than all that passed in that time.
        passed = size[max(0, n - 2 * window) : n]
        bound = DT * U * (4 * len(passed) + 4 * axes + 4) * passed.sum()
        bound += U * (4 * axes + 10) * moving + 2 * U * abs(expected)
        assert abs(seen[n - 1] - expected) <= bound


@axes_and_seed
def test_the_passivity_observer_sums_exact_work(axes: int, seed: int) -> None:
    position, force, _ = signals(axes, seed)
    seen = PassivityObserver(axes=axes).run(position, force)
    # A force held at tick n did its work from n - 1 to n.
    work = dot(force[1:], np.diff(position, axis=0))
    expected = -np.concatenate([[0.0], np.cumsum(work)])
    sizes = np.concatenate([[0.0], np.cumsum(dot(abs(force[1:]), abs(np.diff(position, axis=0))))])
    assert np.all(abs(seen - expected) <= U * (2 * TICKS + 4 * axes + 4) * sizes)


@axes_and_seed
def test_eq_12_passivity_controller(axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    # Pushes of the hand against the motion make E_so oscillate around 0.
    grasp -= 0.3 * velocity
    device = DeviceModel(mass_kg=MASS, axes=axes)
    max_damping = 30.0
    controller = SafetyController(device, SafetySettings(["pc"], pc_max_damping=max_damping, energy_ratio=0.5))
    interventions = controller.run(velocity, rendered, grasp)
    total, bound = sum_so_far(dot(grasp, velocity))
    energy = total - kinetic(velocity, 0.5)
    bound += U * (4 * axes + 10) * (np.cumsum(DT * dot(abs(grasp), abs(velocity))) + abs(energy))
    bound += U * (4 * axes + 10) * kinetic(velocity, 0.5)
    assert interventions.energy_j is not None
    assert np.all(abs(interventions.energy_j - energy) <= bound)

    squared = np.where(dot(velocity, velocity) > 0, dot(velocity, velocity), np.inf)
    # The paper's -E / (V dT) counts a force against the motion; along +x it is E / (V dT).
    damping = np.minimum(np.maximum(-energy, 0.0) / (squared * DT), max_damping)
    expected = -damping[:, None] * velocity
    # The error of the damping is that of the energy; the damping is continuous at both of its bounds.
    slack = bound / (squared * DT) + U * (4 * axes + 10) * damping
    assert np.all(abs(interventions.safety_force - expected) <= slack[:, None] * abs(velocity))
    clear = abs(energy) > bound
    assert np.array_equal((interventions.tripped == 8)[clear], (np.any(expected != 0, axis=1))[clear])
    assert {0, 8} == set(interventions.tripped.tolist())


def judged(name: str, velocity: Array, rendered: Array, grasp: Array) -> tuple[Array, npt.NDArray[np.bool_]]:
    """Return how far each tick is beyond the threshold, and a mask of ticks that rounding cannot have decided."""
    if name == "vfc":
        beyond = dot(velocity, rendered) / (0.6 * 1.0) - 1.0
        size = 1.0 + dot(abs(velocity), abs(rendered)) / 0.6
    elif name == "hsc":
        ratio = norm(rendered) / (norm(grasp) + 1e-3)
        # Both conditions must hold; the smaller margin decides.
        beyond = np.minimum(ratio - 1.5, norm(rendered) - 0.1)
        size = 1.0 + ratio + norm(rendered)
    else:
        power = dot(grasp, velocity)
        window = np.array([power[max(0, n - 99) : n + 1].sum() for n in range(TICKS)])
        beyond = -0.03 - (DT * window - kinetic(velocity, 0.5))
        size = 0.03 + DT * np.cumsum(abs(power)) * TICKS + kinetic(velocity, 0.5)
    # 100 covers every count of roundings above.
    return beyond, abs(beyond) > 100 * U * size


@pytest.mark.parametrize(("name", "bit"), [("vfc", 1), ("hsc", 2), ("wsc", 4)])
@axes_and_seed
def test_eq_2_13_14_cancel_and_damp(name: str, bit: int, axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    device = DeviceModel(mass_kg=MASS, axes=axes)
    interventions = SafetyController(device, settings(name)).run(velocity, rendered, grasp)
    beyond, clear = judged(name, velocity, rendered, grasp)
    unsafe = beyond > 0
    assert np.array_equal((interventions.tripped == bit)[clear], unsafe[clear])
    assert 0 < unsafe.sum() < TICKS, "the signals do not reach both branches"
    # Both sides have the same two roundings: the results are bit-identical.
    law = np.where((interventions.tripped == bit)[:, None], -rendered - 5.0 * velocity, 0.0)
    assert np.array_equal(interventions.safety_force, law)
    assert np.array_equal(interventions.device_force, rendered + law)


@axes_and_seed
def test_s_h_compares_forces_of_the_same_lateness(axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    aligned = 0.7 * rendered + 0.3 * np.roll(rendered, 1, axis=0)
    device = DeviceModel(mass_kg=MASS, axes=axes)
    controller = SafetyController(device, SafetySettings(["hsc"]))
    interventions = controller.run(velocity, rendered, grasp, aligned)
    # Eq. 5 and 14 use the force aligned with F_h; the cancelled force is F_v of this tick.
    assert interventions.grasp is not None
    ratio = norm(aligned) / (norm(grasp) + 1e-3)
    assert np.all(abs(interventions.grasp - ratio) <= U * (2 * axes + 8) * ratio)
    beyond, clear = judged("hsc", velocity, aligned, grasp)
    # F_t must hold for the force of this tick as well: nothing is cancelled if nothing is rendered.
    pushing = norm(rendered) > 0.1
    assert np.array_equal((interventions.tripped == 2)[clear], ((beyond > 0) & pushing)[clear])
    law = np.where((interventions.tripped == 2)[:, None], -rendered - 5.0 * velocity, 0.0)
    assert np.array_equal(interventions.safety_force, law)


def settings(name: str) -> SafetySettings:
    """Return settings of the controller alone, with the paper's thresholds."""
    match name:
        case "vfc":
            return SafetySettings(["vfc"])
        case "hsc":
            return SafetySettings(["hsc"])
        case _:
            return SafetySettings(["wsc"])
