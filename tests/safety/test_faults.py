"""Invalid numbers are refused at their entry: a fault or a refusal names the value, and the state stays unchanged."""

import re
from collections.abc import Callable
from typing import Any

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
    Interventions,
    Limiter,
    LimiterSettings,
    PassivityObserver,
    SafetyController,
    SafetyObserver,
    SafetySettings,
    VelocityForceObserver,
    WindowedSafetyObserver,
    fault_message,
)

Array = npt.NDArray[np.float64]

TICKS = 40
BOUNDS = {"position": (1e3, "m"), "velocity": (1e3, "m/s")}
"""Largest valid magnitude of a measurement; for every force it is 1e4 N."""
COLUMNS = ("safety_force", "device_force", "tripped", "fault")
OBSERVED = ("velocity_force", "grasp", "windowed_energy_j", "energy_j")

SETTINGS = SafetySettings(["vfc", "hsc", "wsc", "pc"], window=10, hold_off_s=0.003, release_ramp_s=0.003)


def bad_numbers(signal: str) -> dict[float, str]:
    """Return invalid numbers of a signal, each with its message."""
    bound, unit = BOUNDS.get(signal, (1e4, "N"))
    name = signal.replace("_", " ")
    absurd = f"{name} exceeds {bound:.0f} {unit}"
    return {
        np.nan: f"{name} is not a finite number",
        np.inf: f"{name} is not a finite number",
        -np.inf: f"{name} is not a finite number",
        float(np.nextafter(bound, np.inf)): absurd,
        -2.0 * bound: absurd,
        1e300: absurd,
    }


def signals(count: int, axes: int, seed: int) -> list[Array]:
    random = np.random.default_rng(seed)
    return list(random.normal(size=(count, TICKS, axes)))


def controller(axes: int) -> SafetyController:
    return SafetyController(DeviceModel.phantom_desktop(axes), SETTINGS)


def columns(interventions: Interventions, kept: npt.NDArray[np.intp] | slice = slice(None)) -> list[npt.NDArray[Any]]:
    return [getattr(interventions, name)[kept] for name in (*COLUMNS, *OBSERVED)]


def assert_same(left: list[npt.NDArray[Any]], right: list[npt.NDArray[Any]]) -> None:
    for a, b in zip(left, right, strict=True):
        assert a.tobytes() == b.tobytes()


OBSERVATION = ("velocity", "rendered_force", "grasp_force")
CONTROLLED = (*OBSERVATION, "rendered_force")
"""Signals of a controller's arguments; the last is the aligned F_v."""


@pytest.mark.parametrize("axes", [1, 3, 7])
@pytest.mark.parametrize("place", range(4))
def test_a_bad_number_gives_a_fault_no_force_and_no_memory(place: int, axes: int) -> None:
    for bad, message in bad_numbers(CONTROLLED[place]).items():
        arrays = signals(4, axes, 0)
        tick = TICKS // 2
        arrays[place][tick, axes - 1] = bad
        interventions = controller(axes).run(*arrays)
        assert fault_message(int(interventions.fault[tick])) == message
        for name in OBSERVED:
            assert np.isnan(getattr(interventions, name)[tick])
        assert not interventions.safety_force[tick].any()
        assert not interventions.device_force[tick].any()
        assert interventions.tripped[tick] == 0
        assert np.flatnonzero(interventions.fault).tolist() == [tick]
        others = np.delete(np.arange(TICKS), tick)
        undisturbed = controller(axes).run(*(array[others] for array in arrays))
        assert undisturbed.safety_force.any()
        assert_same(columns(interventions, others), columns(undisturbed))


@given(
    seed=st.integers(0, 2**32),
    axes=st.sampled_from((1, 2, 6)),
    faults=st.lists(
        st.tuples(
            st.integers(0, 3),
            st.integers(0, TICKS - 1),
            st.integers(0, 5),
            st.sampled_from((np.nan, np.inf, -np.inf, 1.5e4, -1e308)),
        ),
        max_size=8,
    ),
)
def test_any_number_of_faults_leaves_the_rest_alone(
    seed: int, axes: int, faults: list[tuple[int, int, int, float]]
) -> None:
    arrays = signals(4, axes, seed)
    for place, tick, axis, bad in faults:
        arrays[place][tick, axis % axes] = bad
    interventions = controller(axes).run(*arrays)
    faulty = sorted({tick for _, tick, _, _ in faults})
    assert np.flatnonzero(interventions.fault).tolist() == faulty
    assert not interventions.device_force[faulty].any()
    assert np.isfinite(interventions.device_force).all()
    others = np.delete(np.arange(TICKS), faulty)
    undisturbed = controller(axes).run(*(array[others] for array in arrays))
    assert_same(columns(interventions, others), columns(undisturbed))


@pytest.mark.parametrize("place", range(4))
def test_a_step_faults_as_a_run_does(place: int) -> None:
    for bad, message in bad_numbers(CONTROLLED[place]).items():
        stepped, expected = controller(2), controller(2)
        for tick, sample in enumerate(zip(*signals(4, 2, 1), strict=True)):
            one = [list(values) for values in sample]
            if tick == TICKS // 2:
                one[place][1] = bad
                intervention = stepped.step(*one)
                assert fault_message(intervention.fault) == message
                assert not intervention.safety_force.any()
                assert not intervention.device_force.any()
                assert intervention.tripped == 0
                assert all(np.isnan(getattr(intervention, name)) for name in OBSERVED)
            else:
                intervention, sound = stepped.step(*one), expected.step(*one)
                assert intervention.fault == 0
                assert intervention.device_force.tobytes() == sound.device_force.tobytes()
                assert intervention.tripped == sound.tripped


def test_a_large_number_within_the_bounds_is_no_fault() -> None:
    interventions = controller(1).run(np.array([-1e3]), np.array([1e4]), np.array([-1e4]))
    assert interventions.fault.tolist() == [0]
    assert interventions.device_force.tolist() == [5e3]


def test_fault_messages() -> None:
    assert fault_message(0) is None
    assert fault_message(11) == "the device failed"
    assert fault_message(22) == "position exceeds the speed bound of the device"
    assert fault_message(26) is None
    messages = [fault_message(code) for code in range(1, 11)]
    names = ("position", "velocity", "rendered_force", "grasp_force", "environment_force")
    expected = [bad_numbers(name)[bad] for bad in (np.nan, 1e300) for name in names]
    assert len(set(messages)) == 10
    assert sorted(filter(None, messages)) == sorted(expected)
    with pytest.raises(OverflowError):
        fault_message(256)


REFUSERS: dict[str, tuple[Callable[[int], Any], tuple[str, ...]]] = {
    "vfo": (lambda axes: VelocityForceObserver(axes=axes), OBSERVATION),
    "hgo": (lambda axes: HandGraspObserver(axes=axes), OBSERVATION),
    "so": (lambda axes: SafetyObserver(DeviceModel.phantom_desktop(axes)), OBSERVATION),
    "wso": (
        lambda axes: WindowedSafetyObserver(DeviceModel.phantom_desktop(axes), window=10),
        OBSERVATION,
    ),
    "po": (lambda axes: PassivityObserver(axes=axes), ("position", "rendered_force")),
    "limiter": (lambda axes: Limiter(axes=axes), ("rendered_force", "velocity")),
    "estimator": (lambda axes: Estimator(axes=axes), ("position", "rendered_force")),
    "estimator-window": (
        lambda axes: Estimator(EstimatorKind.savitzky_golay(), axes=axes),
        ("position", "rendered_force"),
    ),
}
"""Classes that refuse an invalid number, each with the signals of the arguments of `run`."""


def flat(results: Any) -> list[npt.NDArray[Any]]:  # noqa: ANN401
    return list(results) if isinstance(results, tuple) else [results]


@pytest.mark.parametrize("axes", [1, 3])
@pytest.mark.parametrize("name", REFUSERS)
def test_observers_and_estimators_refuse_and_name_the_tick(name: str, axes: int) -> None:
    build, inputs = REFUSERS[name]
    tick = 17
    for place, signal in enumerate(inputs):
        for bad, message in bad_numbers(signal).items():
            arrays = signals(len(inputs), axes, 2)
            sound = flat(build(axes).run(*(np.delete(array, tick, axis=0) for array in arrays)))
            arrays[place][tick, axes - 1] = bad
            state = build(axes)
            with pytest.raises(ValueError, match=f"^{re.escape(f'tick {tick}: {message}')}$"):
                state.run(*arrays)
            # The ticks before the invalid one have been taken, and nothing of the invalid one.
            after = flat(state.run(*(array[tick + 1 :] for array in arrays)))
            assert_same(after, [result[tick:] for result in sound])


def step(state: Any, one: list[list[float]], only: int | None = None) -> list[Any]:  # noqa: ANN401
    """Run one tick; an estimator takes two calls, and `only` selects one of them."""
    if not isinstance(state, Estimator):
        return flat(state.step(*one))
    moved = [] if only == 1 else list(state.step(one[0]))
    return moved if only == 0 else [*moved, state.align(one[1])]


@pytest.mark.parametrize("name", REFUSERS)
def test_a_refused_step_leaves_no_trace(name: str) -> None:
    build, inputs = REFUSERS[name]
    arrays = signals(len(inputs), 2, 3)
    state = build(2)
    stepped = []
    for tick in range(TICKS):
        one = [list(array[tick]) for array in arrays]
        for place, signal in enumerate(inputs):
            for bad, message in bad_numbers(signal).items():
                wrong = [list(sample) for sample in one]
                wrong[place][1] = bad
                with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
                    step(state, wrong, only=place)
        stepped.append(step(state, one))
    for column, whole in zip(zip(*stepped, strict=True), flat(build(2).run(*arrays)), strict=True):
        assert np.asarray(column, dtype=whole.dtype).tobytes() == whole.tobytes()


POSITIVE = "finite and above 0"
NON_NEGATIVE = "finite and 0 or more"
RATIO = "above 0 and at most 1"
WINDOW = "1 to 3600000 ticks"
HOLD = "between 0 and 60 s"
DAMPABLE = "between 0 and m / (5 dT)"

DEVICE = DeviceModel(mass_kg=0.157)
"""m / (5 dT) = 31.4 N s/m."""


def controlled(*names: str, **parameters: float) -> Callable[[], object]:
    return lambda: SafetyController(DEVICE, SafetySettings(names, **parameters))  # type: ignore[arg-type]


def limited(**parameters: float) -> Callable[[], object]:
    return lambda: Limiter(LimiterSettings(**parameters))


def estimated(kind: EstimatorKind, period_s: float = 1e-3) -> Callable[[], object]:
    return lambda: Estimator(kind, period_s=period_s)


NAN, INF = np.nan, np.inf
KIND = EstimatorKind
TABLE: list[tuple[str, float, str, Callable[[], object]]] = [
    *(("m", x, POSITIVE, lambda x=x: DeviceModel(mass_kg=x)) for x in (0.0, -1.0, NAN, INF)),
    *(("b", x, "finite", lambda x=x: DeviceModel(mass_kg=1.0, viscous=x)) for x in (NAN, -INF)),
    *(("c", x, NON_NEGATIVE, lambda x=x: DeviceModel(mass_kg=1.0, coulomb=x)) for x in (-1e-9, NAN, INF)),
    ("m", -1.0, POSITIVE, lambda: DeviceModel(mass_kg=[1.0, 1.0, -1.0], axes=3)),
    *(("V_t", x, POSITIVE, lambda x=x: VelocityForceObserver(velocity_threshold=x)) for x in (0.0, NAN)),
    *(("F_t", x, POSITIVE, lambda x=x: VelocityForceObserver(force_threshold_n=x)) for x in (0.0, INF)),
    *(("alpha", x, POSITIVE, lambda x=x: HandGraspObserver(grasp_floor_n=x)) for x in (0.0, -1.0, NAN)),
    *(("eta", x, RATIO, lambda x=x: SafetyObserver(DEVICE, energy_ratio=x)) for x in (0.0, 1.01)),
    *(("dT", x, POSITIVE, lambda x=x: SafetyObserver(DEVICE, period_s=x)) for x in (0.0, NAN)),
    *(("eta", x, RATIO, lambda x=x: WindowedSafetyObserver(DEVICE, energy_ratio=x)) for x in (-0.5, NAN, INF)),
    ("dT", -1e-3, POSITIVE, lambda: WindowedSafetyObserver(DEVICE, period_s=-1e-3)),
    *(("w", x, WINDOW, lambda x=x: WindowedSafetyObserver(DEVICE, window=x)) for x in (0, 3_600_001)),
    *(("mu", x, DAMPABLE, controlled("wsc", damping=x)) for x in (-1.0, 31.5, NAN)),
    *(("V_t", x, POSITIVE, controlled("vfc", velocity_threshold=x)) for x in (0.0, NAN)),
    *(("F_t", x, POSITIVE, controlled("vfc", vfc_force_threshold_n=x)) for x in (0.0, -1.0)),
    *(("zeta", x, "finite and above 1", controlled("hsc", grasp_threshold=x)) for x in (1.0, 0.5, NAN, INF)),
    *(("alpha", x, POSITIVE, controlled("hsc", grasp_floor_n=x)) for x in (0.0, INF)),
    *(("F_t", x, NON_NEGATIVE, controlled("hsc", hsc_force_threshold_n=x)) for x in (-0.1, NAN)),
    *(("V_s", x, NON_NEGATIVE, controlled("hsc", hsc_velocity_threshold=x)) for x in (-0.1, NAN)),
    *(("F_w", x, NON_NEGATIVE, controlled("wsc", wsc_force_threshold_n=x)) for x in (-0.1, NAN)),
    *(("delta", x, "finite and below 0", controlled("wsc", energy_threshold_j=x)) for x in (0.0, 0.03, NAN, -INF)),
    *(("eta", x, RATIO, controlled("wsc", energy_ratio=x)) for x in (0.0, 1.5)),
    *(("w", x, WINDOW, controlled("wsc", window=x)) for x in (0, 3_600_001)),
    *(("eta", x, RATIO, controlled("pc", energy_ratio=x)) for x in (0.0, NAN)),
    ("eta", 7.0, RATIO, controlled(energy_ratio=7.0)),  # invalid before any controller reads it
    ("w", 0, WINDOW, controlled("hsc", window=0)),
    *(("alpha", x, DAMPABLE, controlled("pc", pc_max_damping=x)) for x in (-1.0, 31.5)),
    *(("time", x, HOLD, controlled(hold_off_s=x)) for x in (-1e-3, 60.1, NAN)),
    *(("time", x, HOLD, controlled(release_ramp_s=x)) for x in (-1e-3, 60.1, INF)),
    *(("dT", x, POSITIVE, lambda x=x: SafetyController(DEVICE, SETTINGS, period_s=x)) for x in (0.0, INF)),
    *(("F_max", x, POSITIVE, limited(max_force_n=x)) for x in (0.0, NAN, INF)),
    *(("dF/dt", x, POSITIVE, limited(max_slew_n_per_s=x)) for x in (0.0, -1.0)),
    *(("P_max", x, POSITIVE, limited(max_power_w=x)) for x in (0.0, NAN)),
    *(("time", x, HOLD, limited(ramp_in_s=x)) for x in (-0.1, 61.0)),
    ("dT", 0.0, POSITIVE, lambda: Limiter(period_s=0.0)),
    *(("dT", x, POSITIVE, estimated(KIND(), x)) for x in (0.0, -1.0, NAN)),
    *(("f_c", x, POSITIVE, estimated(KIND.low_pass(cutoff_hz=x))) for x in (0.0, NAN)),
    (
        "f_c",
        500.1,
        "at most half the sample rate",
        estimated(KIND.low_pass(cutoff_hz=500.1)),
    ),
    ("d", 0.0, POSITIVE, estimated(KIND.adaptive_window(noise_bound_m=0.0))),
    *(("n", x, "1 to 128", estimated(KIND.adaptive_window(noise_bound_m=1.0, max_window=x))) for x in (0, 129)),
    *(("p", x, "2 or 3", estimated(KIND.savitzky_golay(degree=x))) for x in (1, 4)),
    *(("w", x, "above the degree and at most 128", estimated(KIND.savitzky_golay(window=x))) for x in (2, 129)),
    *(("q", x, POSITIVE, estimated(KIND.kalman(jerk_density=x, quantum_m=1e-5))) for x in (0.0, INF)),
    ("quantum", -1.0, POSITIVE, estimated(KIND.kalman(jerk_density=1.0, quantum_m=-1.0))),
]


@pytest.mark.parametrize(("symbol", "seen", "allowed", "build"), TABLE)
def test_a_parameter_out_of_range_is_refused(
    symbol: str, seen: float, allowed: str, build: Callable[[], object]
) -> None:
    number = "NaN" if np.isnan(seen) else f"{seen:.16g}".removesuffix(".0")
    number = "-0.000000001" if seen == -1e-9 else number
    message = f"({symbol}) = {number}: must be {allowed}"
    with pytest.raises(ValueError, match=rf"^\w+ {re.escape(message)}$"):
        build()


def test_a_kalman_filter_that_follows_nothing_is_refused() -> None:
    kind = EstimatorKind.kalman(jerk_density=1e-30, quantum_m=1.0)
    with pytest.raises(ValueError, match=r"\(omega dT\) = .*must be 0.001 to 10"):
        Estimator(kind)


@pytest.mark.parametrize(
    ("build", "message"),
    [
        (
            lambda: SafetySettings(["tsc"]),  # type: ignore[list-item]
            'controllers: "tsc" is none of "vfc", "hsc", "wsc", "pc"',
        ),
        (
            lambda: SafetySettings(vfc_form="sum"),  # type: ignore[arg-type]
            'vfc_form = "sum": must be "product" or "both"',
        ),
        (
            lambda: EstimatorKind.adaptive_window(noise_bound_m=1.0, fit="worst"),  # type: ignore[arg-type]
            'fit = "worst": must be "end" or "best"',
        ),
        (lambda: DeviceModel(mass_kg=[1.0, 2.0], axes=3), "mass_kg: 2 values, must have 3"),
        (
            lambda: DeviceModel(mass_kg=1.0, viscous=[1.0, 2.0], axes=3),
            "viscous: 2 values, must have 3",
        ),
        (
            lambda: DeviceModel(mass_kg=1.0, coulomb=[1.0, 2.0], axes=1),
            "coulomb: 2 values, must have 1",
        ),
    ],
)
def test_names_and_counts_are_refused(build: Callable[[], object], message: str) -> None:
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        build()


@pytest.mark.parametrize("key", ["window"])
def test_a_negative_count_is_refused(key: str) -> None:
    with pytest.raises(OverflowError):
        SafetySettings(**{key: -1})  # type: ignore[arg-type]


def test_the_paper_device_and_the_edges_of_the_ranges_are_accepted() -> None:
    device = DeviceModel.phantom_desktop(3)
    assert device.mass_kg == [0.157] * 3
    assert device.axes == 3
    settings = SafetySettings(
        ["vfc", "hsc", "wsc", "pc"],
        damping=31.4,
        pc_max_damping=0.0,
        grasp_threshold=float(np.nextafter(1.0, 2.0)),
        hsc_force_threshold_n=0.0,
        energy_threshold_j=-1e-300,
        energy_ratio=1.0,
        window=1,
        hold_off_s=60.0,
        release_ramp_s=60.0,
    )
    assert SafetyController(DEVICE, settings).axes == 1
    assert SafetySettings(["hsc"]) == SafetySettings(["hsc"])
    assert SafetySettings(["hsc"]) != SafetySettings(["wsc"])
    assert LimiterSettings() == LimiterSettings(max_force_n=7.9)
