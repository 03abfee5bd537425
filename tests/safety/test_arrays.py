"""A call with arrays equals the calls sample by sample, for any layout and split of the arrays."""

import itertools
import re
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.safety import (
    DeviceModel,
    Estimator,
    EstimatorKind,
    HandGraspObserver,
    Intervention,
    Interventions,
    Limiter,
    LimiterSettings,
    PassivityObserver,
    SafetyController,
    SafetyObserver,
    SafetySettings,
    VelocityForceObserver,
    WindowedSafetyObserver,
)

Array = npt.NDArray[Any]

AXES = (1, 2, 3, 4, 5, 6, 7)
TICKS = 60
QUANTUM = 2.3e-5
INTERVENTION = (
    "safety_force",
    "device_force",
    "tripped",
    "fault",
    "velocity_force",
    "grasp",
    "windowed_energy_j",
    "energy_j",
)


class Machine(NamedTuple):
    """A class with `step` and `run`, and the conversion of its results to a tuple."""

    build: Callable[[int], Any]
    names: tuple[str, ...]
    run: Callable[..., tuple[Any, ...]]
    step: Callable[..., tuple[Any, ...]]


def observer(build: Callable[[int], Any]) -> Machine:
    return Machine(
        build,
        ("velocity", "rendered_force", "grasp_force"),
        lambda machine, *arrays: (machine.run(*arrays),),
        lambda machine, *samples: (machine.step(*samples),),
    )


def estimator(kind: EstimatorKind) -> Machine:
    return Machine(
        lambda axes: Estimator(kind, axes=axes),
        ("position", "device_force"),
        lambda machine, *arrays: machine.run(*arrays),
        lambda machine, position, force: (*machine.step(position), machine.align(force)),
    )


def intervention(result: Intervention | Interventions) -> tuple[Any, ...]:
    return tuple(getattr(result, name) for name in INTERVENTION)


# A window, a hold-off and a ramp shorter than the arrays, so that the arrays cover all of them.
SETTINGS = SafetySettings(["vfc", "hsc", "wsc", "pc"], window=20, hold_off_s=0.002, release_ramp_s=0.002)
LIMITS = LimiterSettings(max_slew_n_per_s=2000.0, max_power_w=2.0, ramp_in_s=0.01)

MACHINES = {
    "default": estimator(EstimatorKind()),
    "backward": estimator(EstimatorKind.backward_difference()),
    "low-pass": estimator(EstimatorKind.low_pass(cutoff_hz=40.0)),
    "window-end": estimator(EstimatorKind.adaptive_window(noise_bound_m=QUANTUM, max_window=8)),
    "window-best": estimator(EstimatorKind.adaptive_window(noise_bound_m=QUANTUM, fit="best")),
    "savitzky-golay": estimator(EstimatorKind.savitzky_golay(degree=3, window=7)),
    "dual-kalman": estimator(
        EstimatorKind.dual_kalman(velocity_jerk_density=1000.0, jerk_density=10.0, quantum_m=QUANTUM)
    ),
    "kalman": estimator(EstimatorKind.kalman(jerk_density=100.0, quantum_m=QUANTUM)),
    "vfo": observer(lambda axes: VelocityForceObserver(axes=axes)),
    "vfo-both": observer(lambda axes: VelocityForceObserver(form="both", axes=axes)),
    "hgo": observer(lambda axes: HandGraspObserver(axes=axes)),
    "so": observer(lambda axes: SafetyObserver(DeviceModel.phantom_desktop(axes))),
    "wso": observer(lambda axes: WindowedSafetyObserver(DeviceModel.phantom_desktop(axes), window=20)),
    "po": Machine(
        lambda axes: PassivityObserver(axes=axes),
        ("position", "held_force"),
        lambda machine, *arrays: (machine.run(*arrays),),
        lambda machine, *samples: (machine.step(*samples),),
    ),
    "controller": Machine(
        lambda axes: SafetyController(DeviceModel.phantom_desktop(axes), SETTINGS),
        ("velocity", "rendered_force", "grasp_force"),
        lambda machine, *arrays: intervention(machine.run(*arrays)),
        lambda machine, *samples: intervention(machine.step(*samples)),
    ),
    "controller-aligned": Machine(
        lambda axes: SafetyController(DeviceModel.phantom_desktop(axes), SETTINGS),
        ("velocity", "rendered_force", "grasp_force", "aligned_rendered_force"),
        lambda machine, *arrays: intervention(machine.run(*arrays)),
        lambda machine, *samples: intervention(machine.step(*samples)),
    ),
    "limiter": Machine(
        lambda axes: Limiter(LIMITS, axes=axes),
        ("force", "velocity"),
        lambda machine, *arrays: machine.run(*arrays),
        lambda machine, *samples: machine.step(*samples),
    ),
}
"""Each class that takes arrays, and each estimator."""


def signals(machine: Machine, axes: int, seed: int = 0, ticks: int = TICKS) -> list[Array]:
    """Return one array per argument: positions walk on an encoder's grid, the rest is noise."""
    random = np.random.default_rng(seed)
    walk = np.round(np.cumsum(random.normal(size=(ticks, axes)) * 3.0, axis=0)) * QUANTUM
    scale = {"velocity": 0.5, "rendered_force": 3.0, "grasp_force": 3.0}
    arrays = []
    for name in machine.names:
        noise = random.normal(size=(ticks, axes)) * scale.get(name, 5.0)
        noise[random.random(ticks) < 0.3] = 0.0
        arrays.append(walk if name == "position" else noise)
    return arrays


def same(left: tuple[Any, ...], right: tuple[Any, ...]) -> None:
    """Check that all results have the same type and shape, and the same bits."""
    assert len(left) == len(right)
    for a, b in zip(left, right, strict=True):
        assert (a.dtype, a.shape) == (b.dtype, b.shape)
        assert a.tobytes() == b.tobytes()


machines = pytest.mark.parametrize("name", MACHINES)
every_axes = pytest.mark.parametrize("axes", AXES)


@machines
@every_axes
def test_a_run_equals_its_steps(name: str, axes: int) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, axes)
    whole = machine.run(machine.build(axes), *arrays)
    stepped = machine.build(axes)
    for tick in range(TICKS):
        results = machine.step(stepped, *(list(array[tick]) for array in arrays))
        for result, one in zip(whole, results, strict=True):
            assert result[tick].tobytes() == np.asarray(one, dtype=result.dtype).tobytes()
            assert result[tick].shape == np.shape(one)


@machines
def test_one_axis_is_also_a_float_and_a_flat_array(name: str) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, 1)
    matrix = machine.run(machine.build(1), *arrays)
    flat = machine.run(machine.build(1), *(array[:, 0] for array in arrays))
    same(flat, tuple(result.reshape(TICKS) for result in matrix))
    stepped = machine.build(1)
    for tick in range(TICKS):
        results = machine.step(stepped, *(float(array[tick, 0]) for array in arrays))
        for result, one in zip(flat, results, strict=True):
            assert result[tick].tobytes() == np.asarray(one, dtype=result.dtype).tobytes()


@given(
    name=st.sampled_from(sorted(MACHINES)),
    axes=st.sampled_from(AXES),
    seed=st.integers(0, 2**32),
    cuts=st.lists(st.integers(0, TICKS), max_size=3),
)
def test_a_run_may_be_cut_anywhere(name: str, axes: int, seed: int, cuts: list[int]) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, axes, seed)
    whole = machine.run(machine.build(axes), *arrays)
    state = machine.build(axes)
    edges = [0, *sorted(cuts), TICKS]
    pieces = [
        machine.run(state, *(array[begin:end] for array in arrays))
        for begin, end in itertools.pairwise(edges)
        if end > begin
    ]
    same(tuple(np.concatenate(column) for column in zip(*pieces, strict=True)), whole)


def every_other(array: Array) -> Array:
    wide = np.full((2 * array.shape[0], 3 * array.shape[1]), np.nan)
    wide[::2, ::3] = array
    return wide[::2, ::3]


def backwards(array: Array) -> Array:
    return np.ascontiguousarray(array[::-1, ::-1])[::-1, ::-1]


def read_only(array: Array) -> Array:
    copy = array.copy()
    copy.flags.writeable = False
    return copy


def unaligned(array: Array) -> Array:
    raw = np.frombuffer(b"x" + array.tobytes(), dtype=np.float64, offset=1)
    assert not raw.flags.aligned
    return raw.reshape(array.shape)


def packed(array: Array) -> Array:
    """Return a field of packed records: its strides are not multiples of eight bytes."""
    records = np.zeros(array.shape, dtype=[("flag", "u1"), ("value", "f8")])
    records["value"] = array
    return records["value"]


LAYOUTS: dict[str, Callable[[Array], Array]] = {
    "fortran": np.asfortranarray,
    "every-other": every_other,
    "backwards": backwards,
    "read-only": read_only,
    "unaligned": unaligned,
    "packed": packed,
}


@machines
@pytest.mark.parametrize("layout", LAYOUTS)
@pytest.mark.parametrize("axes", [1, 3, 7])
def test_the_layout_of_an_array_changes_nothing(name: str, layout: str, axes: int) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, axes)
    laid = [LAYOUTS[layout](array) for array in arrays]
    assert all(np.array_equal(a, b) for a, b in zip(arrays, laid, strict=True))
    same(machine.run(machine.build(axes), *laid), machine.run(machine.build(axes), *arrays))


def test_the_grasp_force_knows_no_layout() -> None:
    device = DeviceModel.phantom_desktop(3)
    arrays = np.random.default_rng(0).normal(size=(3, TICKS, 3))
    expected = device.grasp_force(*arrays)
    for layout in LAYOUTS.values():
        assert np.array_equal(device.grasp_force(*(layout(array) for array in arrays)), expected)


@machines
@every_axes
def test_an_empty_run_gives_empty_arrays_and_changes_nothing(name: str, axes: int) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, axes)
    state = machine.build(axes)
    results = machine.run(state, *(array[:0] for array in arrays))
    expected = machine.run(machine.build(axes), *arrays)
    for empty, full in zip(results, expected, strict=True):
        assert (empty.dtype, empty.shape) == (full.dtype, (0, *full.shape[1:]))
    same(machine.run(state, *arrays), expected)


@machines
@every_axes
def test_shapes_are_refused_by_name(name: str, axes: int) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, axes)
    allowed = "(n_ticks, 1) or (n_ticks,)" if axes == 1 else f"(n_ticks, {axes})"
    wrong = [np.zeros((TICKS, axes + 1)), np.zeros((TICKS, axes, 1)), np.zeros(())]
    if axes > 1:
        wrong += [np.zeros((TICKS, axes - 1)), np.zeros(TICKS), np.zeros((axes, TICKS))]
    for place, argument in enumerate(machine.names):
        for array in wrong:
            given_arrays = [*arrays[:place], array, *arrays[place + 1 :]]
            seen = f"{argument}: shape {list(array.shape)}, must be {allowed}"
            with pytest.raises(ValueError, match=f"^{re.escape(seen)}$"):
                machine.run(machine.build(axes), *given_arrays)


@machines
@every_axes
def test_lengths_are_refused_by_name(name: str, axes: int) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, axes)
    for place, argument in enumerate(machine.names[1:], start=1):
        given_arrays = [*arrays[:place], arrays[place][:-1], *arrays[place + 1 :]]
        seen = f"{argument}: {TICKS - 1} ticks, must have {TICKS}"
        with pytest.raises(ValueError, match=f"^{seen}$"):
            machine.run(machine.build(axes), *given_arrays)


@machines
@pytest.mark.parametrize("dtype", ["float32", ">f8", "int64", "complex128", "object", "bool"])
def test_other_types_than_float64_are_refused(name: str, dtype: str) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, 3)
    for place, argument in enumerate(machine.names):
        given_arrays = [*arrays[:place], arrays[place].astype(dtype), *arrays[place + 1 :]]
        with pytest.raises(TypeError, match=f"{dtype}(.|\n)*float64") as refused:
            machine.run(machine.build(3), *given_arrays)
        assert argument in "".join([str(refused.value), *refused.value.__notes__])


@machines
def test_samples_of_another_number_of_axes_are_refused_by_name(name: str) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, 3)
    for place, argument in enumerate(machine.names):
        for wrong, count in [([0.0, 0.0], "2 values"), (0.0, "1 value"), ([], "0 values")]:
            samples: list[Any] = [list(array[0]) for array in arrays]
            samples[place] = wrong
            with pytest.raises(ValueError, match=f"^{argument}: {count}, must have 3$"):
                machine.step(machine.build(3), *samples)


@pytest.mark.parametrize("name", ["so", "wso", "po", "controller", "limiter"])
def test_a_reset_forgets_all(name: str) -> None:
    machine = MACHINES[name]
    arrays = signals(machine, 2)
    state = machine.build(2)
    fresh = machine.run(state, *arrays)
    assert any(a.tobytes() != b.tobytes() for a, b in zip(machine.run(state, *arrays), fresh, strict=True))
    state.reset()
    same(machine.run(state, *arrays), fresh)


def test_the_rendered_force_is_its_own_alignment_unless_given() -> None:
    velocity, rendered, grasp = signals(MACHINES["controller"], 3)
    build = MACHINES["controller"].build
    alone = build(3).run(velocity, rendered, grasp)
    same(intervention(build(3).run(velocity, rendered, grasp, rendered)), intervention(alone))
    same(intervention(build(3).run(velocity, rendered, grasp, None)), intervention(alone))


def test_forces_do_not_touch_the_motion() -> None:
    for name, machine in MACHINES.items():
        if isinstance(machine.build(2), Estimator):
            position, force = signals(machine, 2)
            alone = machine.build(2).run(position)
            assert alone[2] is None, name
            same(alone[:2], machine.build(2).run(position, force)[:2])


def test_an_observer_that_no_controller_reads_is_not_computed() -> None:
    device = DeviceModel.phantom_desktop()
    zero = np.zeros(3)
    columns = {
        "vfc": "velocity_force",
        "hsc": "grasp",
        "wsc": "windowed_energy_j",
        "pc": "energy_j",
    }
    for chosen in ("vfc", "hsc", "wsc", "pc"):
        controller = SafetyController(device, SafetySettings([chosen]))
        run, step = controller.run(zero, zero, zero), controller.step(0.0, 0.0, 0.0)
        for name, column in columns.items():
            assert (getattr(run, column) is not None) == (name == chosen)
            assert np.isnan(getattr(step, column)) == (name != chosen)


@pytest.mark.parametrize("axes", [0, 8])
def test_no_other_number_of_axes(axes: int) -> None:
    builds: list[Callable[[int], Any]] = [
        lambda axes: DeviceModel(mass_kg=1.0, axes=axes),
        DeviceModel.phantom_desktop,
        *(MACHINES[name].build for name in ("kalman", "vfo", "hgo", "po", "limiter")),
    ]
    for build in builds:
        with pytest.raises(ValueError, match=f"^axes = {axes}: must be 1 to 7$"):
            build(axes)
