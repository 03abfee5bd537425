"""Properties of every signal: the law, symmetry and scaling of the observers, the limits."""

from collections.abc import Callable
from typing import Literal

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from haptether.safety import (
    DeviceModel,
    HandGraspObserver,
    Interventions,
    Limiter,
    LimiterSettings,
    SafetyController,
    SafetyObserver,
    SafetySettings,
    VelocityForceObserver,
    WindowedSafetyObserver,
)

Array = npt.NDArray[np.float64]
Name = Literal["vfc", "hsc", "wsc", "pc"]

U = 2.0**-53
DT = 1e-3
TICKS = 200

seeds = st.integers(0, 2**32)


def signals(axes: int, seed: int) -> tuple[Array, Array, Array]:
    """Return V, F_v and F_h."""
    random = np.random.default_rng(seed)
    strength = np.exp(random.normal(size=(3, TICKS, 1)))
    noise = random.normal(size=(3, TICKS, axes)) * strength * np.array([0.3, 2.0, 2.0])[:, None, None]
    velocity, rendered, grasp = noise
    return velocity, rendered, grasp


def observers(axes: int) -> list[Callable[[Array, Array, Array], Array]]:
    device = DeviceModel(mass_kg=0.157, axes=axes)
    return [
        VelocityForceObserver(axes=axes).run,
        VelocityForceObserver(form="both", axes=axes).run,
        HandGraspObserver(axes=axes).run,
        SafetyObserver(device).run,
        WindowedSafetyObserver(device, window=30).run,
    ]


def controlled(axes: int, names: list[Name], *given_signals: Array) -> Interventions:
    device = DeviceModel(mass_kg=0.157, axes=axes)
    return SafetyController(device, SafetySettings(names, window=30)).run(*given_signals)


@given(
    names=st.lists(st.sampled_from(("vfc", "hsc", "wsc")), unique=True),
    axes=st.sampled_from((1, 2, 3, 4, 5, 6, 7)),
    seed=seeds,
)
def test_the_law_acts_exactly_when_one_trips(names: list[Name], axes: int, seed: int) -> None:
    velocity, rendered, grasp = signals(axes, seed)
    interventions = controlled(axes, names, velocity, rendered, grasp)
    tripped = interventions.tripped != 0
    assert np.array_equal(interventions.safety_force, np.where(tripped[:, None], -rendered - 5.0 * velocity, 0.0))
    # While the controller acts, the device renders the damping alone.
    rounding = 2 * U * (abs(rendered) + 5.0 * abs(velocity))
    assert np.all(abs(interventions.device_force + 5.0 * velocity)[tripped] <= rounding[tripped])
    assert np.array_equal(interventions.device_force[~tripped], rendered[~tripped])
    alone = [controlled(axes, [name], velocity, rendered, grasp).tripped for name in names]
    assert np.array_equal(interventions.tripped, sum(alone, np.zeros(TICKS, dtype=np.uint8)))


def test_an_intervention_is_held_and_fades() -> None:
    settings = SafetySettings(["hsc"], damping=5.0, hold_off_s=0.005, release_ramp_s=0.004)
    controller = SafetyController(DeviceModel(mass_kg=0.157), settings)
    velocity, rendered = np.full(16, 0.2), np.full(16, 3.0)
    grasp = np.full(16, -3.0)
    grasp[2] = 0.0  # nobody holds at this one tick
    grasp[9] = 0.0  # and again while the first intervention fades
    interventions = controller.run(velocity, rendered, grasp)
    held = [1.0] * 5
    fading = [0.96, 0.84, 0.64, 0.36]  # 1 - s² with s in fifths
    gain = np.array([0.0, 0.0, *held, *fading[:2], *held, *fading[:2]])
    # Three roundings, of values below 8 N.
    assert np.all(abs(interventions.safety_force - gain * -4.0) <= 3 * U * 8.0)
    bits = np.where(gain > 0, 16, 0)
    bits[[2, 9]] = 2
    assert np.array_equal(interventions.tripped, bits)


def test_the_passivity_controller_has_the_share_that_an_intervention_leaves() -> None:
    random = np.random.default_rng(0)
    velocity, rendered = random.uniform(0.2, 0.5, 16), np.full(16, 3.0)
    grasp = np.full(16, -3.0)  # against the motion, so PC acts at every tick
    grasp[2] = 0.0

    def force(*names: Name) -> Array:
        settings = SafetySettings(names, hold_off_s=0.003, release_ramp_s=0.004)
        controller = SafetyController(DeviceModel(mass_kg=0.157), settings)
        return controller.run(velocity, rendered, grasp).safety_force

    gain = np.array([0.0, 0.0, 1.0, 1.0, 1.0, 0.96, 0.84, 0.64, 0.36, *[0.0] * 7])
    passivity = force("pc")
    assert np.all(passivity < 0)
    expected = gain * (-rendered - 5.0 * velocity) + (1 - gain) * passivity
    # About six roundings, of forces below 25 N (50 N s/m at 0.5 m/s).
    assert np.all(abs(force("hsc", "pc") - expected) <= 8 * U * 25.0)


@pytest.mark.parametrize("axes", [2, 3, 4, 5, 6, 7])
@given(seed=seeds)
def test_motion_along_one_axis_is_the_scalar_case(axes: int, seed: int) -> None:
    flat = [signal[:, 0] for signal in signals(1, seed)]
    along = seed % axes
    wide = [np.zeros((TICKS, axes)) for _ in flat]
    for vector, scalar in zip(wide, flat, strict=True):
        vector[:, along] = scalar
    for scalar_run, vector_run in zip(observers(1), observers(axes), strict=True):
        assert np.array_equal(scalar_run(*flat), vector_run(*wide))
    names: list[Name] = ["vfc", "hsc", "wsc", "pc"]
    scalar_interventions, vector_interventions = controlled(1, names, *flat), controlled(axes, names, *wide)
    assert np.array_equal(scalar_interventions.tripped, vector_interventions.tripped)
    expected = np.zeros((TICKS, axes))
    expected[:, along] = scalar_interventions.safety_force
    assert np.array_equal(vector_interventions.safety_force, expected)
    device = DeviceModel.phantom_desktop(axes)
    grasp = DeviceModel.phantom_desktop().grasp_force(*flat)
    assert np.array_equal(device.grasp_force(*wide)[:, along], grasp)


@given(seed=seeds)
def test_a_rotation_of_the_frame_changes_no_observer_and_turns_the_force(seed: int) -> None:
    straight = signals(3, seed)
    rotation = Rotation.random(rng=np.random.default_rng(seed)).as_matrix()
    rotated = [signal @ rotation.T for signal in straight]
    velocity, rendered, grasp = (np.linalg.norm(signal, axis=1) for signal in straight)
    # An entry of the matrix is off by about 8 u. A rotated component adds 3 products and 2 sums: together less than 32
    # u of the length of the vector. In a product of two vectors this counts twice, and their own 6 roundings are far
    # below the rest up to 100 u.
    vector, product = 32 * U, 100 * U
    moving = 0.157 * velocity**2
    power = DT * np.cumsum(grasp * velocity)
    # Sums of n terms add n roundings of the sum; the window's sums add up to two windows more.
    sums = (product + U * (2 * TICKS + 60)) * power + product * moving
    bounds = [
        product * velocity * rendered / 0.6,
        product * (velocity / 0.6 + rendered),
        product * rendered / (grasp + 1e-3),
        sums,
        sums,
    ]
    for run, run_again, bound in zip(observers(3), observers(3), bounds, strict=True):
        assert np.all(abs(run(*straight) - run_again(*rotated)) <= bound)

    for name, bound in zip(("vfc", "hsc", "wsc"), (bounds[0], bounds[2], bounds[4]), strict=True):
        names: list[Name] = [name]  # type: ignore[list-item]
        left, right = controlled(3, names, *straight), controlled(3, names, *rotated)
        seen = {"vfc": left.velocity_force, "hsc": left.grasp, "wsc": left.windowed_energy_j}[name]
        threshold = {"vfc": 1.0, "hsc": 1.5, "wsc": -0.03}[name]
        assert seen is not None
        clear = abs(seen - threshold) > bound
        if name == "hsc":
            clear &= abs(rendered - 0.1) > vector * rendered
        assert np.array_equal(left.tripped[clear], right.tripped[clear])
        slack = vector * (rendered + 5.0 * velocity)
        error = abs(left.safety_force @ rotation.T - right.safety_force).max(axis=1)
        # One slack is for the rotated inputs, one for the rotation of the result.
        assert np.all((error <= 2 * slack)[clear])


@given(seed=seeds, axes=st.sampled_from((1, 3)), power=st.integers(-6, 2))
def test_energy_scales_with_the_square(seed: int, axes: int, power: int) -> None:
    # A power of two rounds nothing, so scaled signals give scaled results bit for bit. Larger powers would exceed the
    # plausible range.
    s = 2.0**power
    device = DeviceModel(mass_kg=0.157, axes=axes)
    unscaled = signals(axes, seed)
    scaled = [s * signal for signal in unscaled]
    for observer in (
        lambda: SafetyObserver(device),
        lambda: WindowedSafetyObserver(device, window=30),
    ):
        assert np.array_equal(observer().run(*scaled), s * s * observer().run(*unscaled))
    interventions = [
        SafetyController(device, SafetySettings(["wsc"], window=30, energy_threshold_j=-0.03 * scale * scale)).run(
            *given_signals
        )
        for scale, given_signals in ((1.0, unscaled), (s, scaled))
    ]
    assert interventions[0].tripped.any()
    assert np.array_equal(interventions[0].tripped, interventions[1].tripped)
    assert np.array_equal(interventions[1].safety_force, s * interventions[0].safety_force)


@given(seed=seeds, quiet=st.integers(1, 90), window=st.integers(1, 60))
def test_a_rest_before_the_signals_only_shifts_the_window(seed: int, quiet: int, window: int) -> None:
    device = DeviceModel(mass_kg=0.157)
    velocity, rendered, grasp = (signal[:, 0] for signal in signals(1, seed))
    rest = np.zeros(quiet)
    first = WindowedSafetyObserver(device, window=window).run(velocity, rendered, grasp)
    later = WindowedSafetyObserver(device, window=window).run(
        *(np.concatenate([rest, signal]) for signal in (velocity, rendered, grasp))
    )
    assert not later[:quiet].any()
    # The running sum is then renewed at other ticks. It errs by u for each addition and subtraction of up to two
    # windows, of sums no larger than all that passed.
    passed = np.convolve(abs(grasp * velocity), np.ones(2 * window))[:TICKS]
    bound = DT * U * (8 * window + 8) * passed + 4 * U * abs(first)
    assert np.all(abs(later[quiet:] - first) <= bound)


OPEN = {"max_force_n": 1e3, "max_slew_n_per_s": 1e9, "max_power_w": 1e6, "ramp_in_s": 0.0}


def forces(axes: int, seed: int) -> tuple[Array, Array]:
    """Return a requested force, in steps and drifts, and V."""
    random = np.random.default_rng(seed)
    steps = np.repeat(random.normal(size=(TICKS // 10, axes)), 10, axis=0) * 8.0
    return steps + random.normal(size=(TICKS, axes)), random.normal(size=(TICKS, axes)) * 0.6


@given(axes=st.sampled_from((1, 2, 3, 4, 5, 6, 7)), seed=seeds)
def test_the_limiter_holds_cap_power_and_growth(axes: int, seed: int) -> None:
    cap, growth, power, ramp = 7.9, 1.0, 3.0, 20
    settings = LimiterSettings(max_force_n=cap, max_slew_n_per_s=growth / DT, max_power_w=power, ramp_in_s=ramp * DT)
    requested, velocity = forces(axes, seed)
    force, acted = Limiter(settings, axes=axes).run(requested, velocity)
    sizes = np.linalg.norm(force, axis=1)
    speeds = np.linalg.norm(velocity, axis=1)
    rounding = 8 * (axes + 4) * U
    assert np.all(sizes <= cap * (1 + rounding))
    delivered = (force * velocity).sum(axis=1)
    assert np.all(delivered <= power + rounding * (cap * speeds + power))

    last = np.vstack([np.zeros(axes), force[:-1]])
    assert np.all(sizes <= np.linalg.norm(last, axis=1) + growth + rounding * cap)
    # The reference is the nearest point between the last force and zero: force beyond it is growth.
    squared = (last * last).sum(axis=1)
    share = np.clip((last * force).sum(axis=1) / np.where(squared > 0, squared, 1.0), 0.0, 1.0)
    grown = np.linalg.norm(force - share[:, None] * last, axis=1)
    free = acted & 4 == 0
    assert np.all(grown[free] <= growth + rounding * cap)

    # Each bit says that its bound acted; without any bit the force passes unchanged.
    assert set(acted[:ramp] & 8) == {8}
    assert not (acted[ramp:] & 8).any()
    assert not force[0].any(), "a force rises from zero"
    clipped = acted & 1 != 0
    assert np.array_equal(clipped[ramp:], np.linalg.norm(requested[ramp:], axis=1) > cap * (1 + rounding))
    bound_by_power = acted & 4 != 0
    assert np.all(abs(delivered[bound_by_power] - power) <= rounding * (cap * 5.0 + power))
    assert np.array_equal(force[acted == 0], requested[acted == 0])
    assert {0, 2} <= set((acted & 2).tolist())
    assert {0, 4} <= set((acted & 4).tolist())


@given(axes=st.sampled_from((1, 3)), seed=seeds)
def test_an_open_limiter_changes_nothing(axes: int, seed: int) -> None:
    requested, velocity = forces(axes, seed)
    force, acted = Limiter(LimiterSettings(**OPEN), axes=axes).run(requested, velocity)
    assert np.array_equal(force, requested)
    assert not acted.any()


def test_the_limiter_bounds_one_thing_at_a_time() -> None:
    requested, still = np.full(4, 10.0), np.zeros(4)
    for key, value, velocity, expected, bit in [
        ("max_force_n", 4.0, still, [4.0, 4.0, 4.0, 4.0], 1),
        ("max_slew_n_per_s", 3000.0, still, [3.0, 6.0, 9.0, 10.0], 2),
        ("max_power_w", 3.0, still + 2.0, [1.5, 1.5, 1.5, 1.5], 4),
        ("ramp_in_s", 0.004, still, [0.0, 2.5, 5.0, 7.5], 8),
    ]:
        force, acted = Limiter(LimiterSettings(**OPEN | {key: value})).run(requested, velocity)
        # A few roundings of values up to 10 N.
        assert np.all(abs(force - expected) <= 8 * U * 10.0), key
        assert np.array_equal(acted != 0, force != requested), key
        assert set(acted.tolist()) <= {0, bit}, key


def test_unloading_is_free_and_a_reversal_is_not() -> None:
    limiter = Limiter(LimiterSettings(**OPEN | {"max_slew_n_per_s": 1000.0}))
    requested = np.array([1.0, 2.0, 3.0, 0.5, -3.0, 0.0])
    force, acted = limiter.run(requested, np.zeros(6))
    assert np.all(abs(force - [1.0, 2.0, 3.0, 0.5, -1.0, 0.0]) <= 8 * U * 3.0)
    assert acted.tolist() == [0, 0, 0, 0, 2, 0]
