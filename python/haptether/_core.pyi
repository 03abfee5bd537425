"""Compiled part of Haptether. Import its names from the rooms: `haptether.safety`, `haptether.bridge`, ...

Units are SI, angles in rad; a positive force pushes the device along +x. Arrays over ticks have the shape `(n_ticks,
axes)`, for one axis also `(n_ticks,)`, and must hold float64; results have the shape of the first argument, and one
number per tick the shape `(n_ticks,)`. Strides do not matter. One sample is a float for one axis, else a sequence of
`axes` floats; it comes back as an array of shape `(axes,)`. Devices have 1 to 7 axes.

Every call raises `ValueError` for a wrong shape, length or range, with the value seen and the values allowed. It raises
`TypeError` for a wrong type, also a wrong dtype, and `OverflowError` for a negative count or seed.

"Paper" in a `Source:` is "Safety Control for Impedance Haptic Interfaces".
"""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, ClassVar, Literal, Protocol, TypeAlias, final, overload, type_check_only

import numpy as np
import numpy.typing as npt

from haptether.safety import ControllerName

__all__ = [
    "CANCELLING",
    "CONTROLLERS",
    "COUPLINGS",
    "ESTIMATORS",
    "LADDER_STATES",
    "METRICS",
    "OBSERVED",
    "OBSERVERS",
    "PRESS_S",
    "ROUND_TRIP_S",
    "TRIP_BITS",
    "CouplingFacts",
    "DeviceModel",
    "DirectionStatistics",
    "DynamixelBus",
    "Echo",
    "Estimator",
    "EstimatorKind",
    "ForceSensor",
    "Hand",
    "HandGraspObserver",
    "HapticDevice",
    "HdCallback",
    "Intervention",
    "Interventions",
    "Limiter",
    "LimiterSettings",
    "LinkStatistics",
    "LiveMaster",
    "LiveSlave",
    "LocalTrace",
    "LoopReport",
    "MasterLoop",
    "MasterTrace",
    "PassivityObserver",
    "PathReport",
    "Proxy",
    "ProxyStatistics",
    "Recording",
    "RecordingColumns",
    "RecordingReport",
    "Renewal",
    "ResearchObservation",
    "SafetyController",
    "SafetyLayer",
    "SafetyObserver",
    "SafetySettings",
    "SafetyTick",
    "SafetyTicks",
    "SampleBounds",
    "SceneRun",
    "SceneTouch",
    "SignalRelay",
    "Sinusoid",
    "SlaveLoop",
    "SlaveTrace",
    "SyncRead",
    "UrInverseSolver",
    "VelocityForceObserver",
    "Wall",
    "WindowedSafetyObserver",
    "__version__",
    "check_link",
    "coupling_facts",
    "fault_message",
    "judge_packets",
    "ladder_reason",
    "ladder_state_name",
    "link_bounds",
    "read_link_file",
    "read_recording_columns",
    "record",
    "replay_recording",
    "run_local",
    "simulate_scene",
    "sweep_scenes",
    "translate_netem",
    "verdict_causes",
]

_Array: TypeAlias = npt.NDArray[np.float64]
_Bits: TypeAlias = npt.NDArray[np.uint8]
_Sample: TypeAlias = float | Sequence[float] | _Array
_Rows: TypeAlias = tuple[Sequence[float], Sequence[float], Sequence[float], Sequence[float]]

__version__: str

METRICS: tuple[str, ...]
"""Names of the metrics of a run, in the order of tables."""
PRESS_S: float
"""Time in s for which a press of the clutch counts, and waits in ALIGNING."""
ROUND_TRIP_S: float
"""Part of `PRESS_S` that a press takes over the slowest link, besides a turn: 500 ms each way."""
CONTROLLERS: tuple[tuple[str, str, str], ...]
"""Name, title and source of each safety controller, in the order of the bits of `tripped`."""
COUPLINGS: tuple[tuple[str, str, str], ...]
"""Name, title and source of each coupling, in the order of its code in frames."""
TRIP_BITS: tuple[tuple[str, int], ...]
"""Controllers by name, and "held", with their bits in `tripped`."""
CANCELLING: tuple[str, ...]
"""Controllers whose intervention takes the rendered force away; the others add a force."""
OBSERVED: tuple[tuple[str, str, str], ...]
"""Each controller's name, the signal of its observer, and that signal's symbol with unit."""
LADDER_STATES: tuple[str, ...]
"""States of the ladder in the order of their codes."""
OBSERVERS: tuple[tuple[str, str, str], ...]
"""Name, title and source of each safety observer."""
ESTIMATORS: tuple[tuple[str, str, str], ...]
"""Name, title and source of each estimator of velocity and acceleration."""
"""Version of the distribution, as in `pip show haptether`."""

# ---------------------------------------------------------------------------------------------- safety

@final
class DeviceModel:
    """Dynamics of the haptic device as a point mass, per axis.

    `m A + b V + c sign(V) = F_device + F_h`; for several axes sign(V) is the direction V / |V|.

    Args:
        mass_kg: m in kg, above 0; one value serves all axes.
        viscous: b in N s/m, of any sign; the paper's device has b = -0.005.
        coulomb: c in N, 0 or more.
        axes: 1 to 7.

    Raises:
        ValueError: A parameter is outside its range, values of another number than `axes`, or an invalid number of
            `axes`.

    Source: paper Eq. 3.
    """

    def __new__(
        cls,
        *,
        mass_kg: _Sample,
        viscous: _Sample = 0.0,
        coulomb: _Sample = 0.0,
        axes: int = 1,
    ) -> DeviceModel: ...
    @staticmethod
    def phantom_desktop(axes: int = 1) -> DeviceModel:
        """The paper's PHANTOM Desktop: m = 0.157 kg, b = -0.005 N s/m, c = 0.038 N on each axis.

        Raises:
            ValueError: The number of `axes` is invalid.

        Source: paper section 4.1.
        """

    @property
    def axes(self) -> int:
        """Number of axes."""

    @property
    def mass_kg(self) -> list[float]:
        """m in kg, one value per axis."""

    def grasp_force(self, velocity: _Array, acceleration: _Array, aligned_device_force: _Array) -> _Array:
        """Force of the hand on the device: `F_h = m A + b V + c sign(V) - F_device`.

        The paper subtracts F_v. F_device is the whole commanded force, F_v + F_c: with F_v alone the controller's own
        force would look like a hand.

        Args:
            velocity: V in m/s, shape `(n_ticks, axes)`.
            acceleration: A in m/s², the same shape.
            aligned_device_force: F_device in N as `Estimator` aligns it with A, the same shape.

        Returns:
            F_h in N, shape `(n_ticks, axes)`.

        Raises:
            ValueError: Arrays of another shape or of different lengths.

        Source: paper Eq. 4.
        """

@final
class EstimatorKind:
    """Estimator of velocity and acceleration with its parameters; without arguments the default.

    The default is `kalman(jerk_density=10.0, quantum_m=2.3e-5)`, for a stylus at 1 kHz: 39 Hz of bandwidth. `Estimator`
    checks the ranges.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(cls) -> EstimatorKind: ...
    def __eq__(self, other: object, /) -> bool: ...
    @staticmethod
    def backward_difference() -> EstimatorKind:
        """Differences: `V[n] = (x[n] - x[n-1]) / dT`, `A[n] = (V[n] - V[n-1]) / dT`.

        V is in m/s, A in m/s² and the mean of the last two ticks. This estimator has the smallest lag. A position
        quantum q appears in A as q / dT².

        Source: paper Eq. 4.
        """

    @staticmethod
    def low_pass(*, cutoff_hz: float) -> EstimatorKind:
        """First-order low-pass on the difference D: `V[n] = V[n-1] + beta (D[n] - V[n-1])`.

        `beta = 1 - exp(-2 pi f_c dT)`, `A[n] = (V[n] - V[n-1]) / dT`.

        Args:
            cutoff_hz: f_c in Hz, above 0 and at most half the sample rate.

        Source: Franklin, Powell and Workman 1998, section 6.2 (pole matching).
        """

    @staticmethod
    def adaptive_window(
        *, noise_bound_m: float, max_window: int = 32, fit: Literal["end", "best"] = "end"
    ) -> EstimatorKind:
        """Slope of the longest straight line that stays within d of all samples it spans.

        Args:
            noise_bound_m: d in m (rad for joints), above 0; start with the encoder's quantum.
            max_window: Longest window in ticks, 1 to 128.
            fit: "end" takes the chord of the window, "best" its least-squares slope.

        Raises:
            ValueError: The `fit` is invalid.

        Source: Janabi-Sharifi, Hayward and Chen 2000 (FOAW).
        """

    @staticmethod
    def savitzky_golay(*, degree: int = 2, window: int = 15) -> EstimatorKind:
        """Derivatives, at the newest sample, of the polynomial fitted to the last w samples.

        Args:
            degree: p, 2 or 3.
            window: w in samples, above `degree` and at most 128.

        Source: Savitzky and Golay 1964; Gorry 1990 (weights at the end point).
        """

    @staticmethod
    def kalman(*, jerk_density: float, quantum_m: float) -> EstimatorKind:
        """Steady-state Kalman filter of position, velocity and acceleration under white jerk.

        Its bandwidth omega in rad/s follows from `omega⁶ = 12 q / (quantum² dT)`; omega dT must lie
        within 0.001 and 10.

        Args:
            jerk_density: q in m²/s⁵ (rad²/s⁵ for joints), above 0.
            quantum_m: Quantum of the encoder in m (rad for joints), above 0.

        Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.2.3.
        """

    @staticmethod
    def dual_kalman(*, velocity_jerk_density: float, jerk_density: float, quantum_m: float) -> EstimatorKind:
        """V of a fast Kalman filter, A of a slow one: less lag of V at the same noise of the grasp force.

        Args:
            velocity_jerk_density: q_v in m²/s⁵ (rad²/s⁵ for joints), above 0, of V.
            jerk_density: q in the same unit, above 0, of A.
            quantum_m: Quantum of the encoder in m (rad for joints), above 0.

        Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.2.3; `docs/ejection_bound.md`, Eq. 5.
        """

@final
class Estimator:
    """V and A of a device from its sampled position; keeps its state between calls.

    Assumes that the device was at rest at the first position.

    One sample is a float for one axis, else `axes` floats.

    Args:
        kind: Estimator; by default that of `EstimatorKind`.
        period_s: dT in s, above 0.
        axes: 1 to 7.

    Raises:
        ValueError: A parameter of `kind` or `period_s` outside its range, or an invalid number of `axes`.
    """

    def __new__(cls, kind: EstimatorKind | None = None, *, period_s: float = 1e-3, axes: int = 1) -> Estimator: ...
    @property
    def axes(self) -> int:
        """Number of axes."""

    def step(self, position: _Sample) -> tuple[_Array, _Array]:
        """Process one position.

        Args:
            position: x in m, shape `(axes,)`.

        Returns:
            V in m/s and A in m/s², each of shape `(axes,)`.

        Raises:
            ValueError: A position is not finite or exceeds 1000 m; the state is unchanged.
        """

    def align(self, device_force: _Sample) -> _Array:
        """Filter F_device[n-1] with the kernel between the true acceleration and A[n].

        Call it after every `step` or never: it stores past forces.

        Args:
            device_force: Force in N, shape `(axes,)`, held over the tick that ended with the newest position.

        Returns:
            The force in N that Eq. 4 may subtract from m A, shape `(axes,)`.

        Raises:
            ValueError: A force is not finite or exceeds 10000 N; the state is unchanged.

        Source: paper Eq. 4.
        """

    @overload
    def run(self, position: _Array, device_force: None = None) -> tuple[_Array, _Array, None]: ...
    @overload
    def run(self, position: _Array, device_force: _Array) -> tuple[_Array, _Array, _Array]:
        """Run `step`, and `align` if forces are given, over arrays.

        Args:
            position: x in m, shape `(n_ticks, axes)`.
            device_force: F_device in N held before each position, the same shape; None skips `align`.

        Returns:
            V in m/s, A in m/s² and the aligned force in N (None without `device_force`), each of shape `(n_ticks,
            axes)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick). Earlier ticks
                are processed.
        """

@final
class VelocityForceObserver:
    """VFO: the device pushes the hand, and the hand moves in the same direction.

    "product" is Eq. 1 as printed, `S_vf = V·F_v / (V_t F_t)`; "both" is the paper's text, `S_vf = min(V/V_t,
    |F_v|/F_t)` with V the speed along F_v. Above 1 is unsafe.

    One sample is a float for one axis, else `axes` floats.

    Args:
        velocity_threshold: V_t in m/s, above 0.
        force_threshold_n: F_t in N, above 0.
        form: Form of Eq. 1.
        axes: 1 to 7.

    Raises:
        ValueError: A threshold is outside its range, an invalid `form` or an invalid number of `axes`.

    Source: paper Eq. 1.
    """

    def __new__(
        cls,
        *,
        velocity_threshold: float = 0.6,
        force_threshold_n: float = 1.0,
        form: Literal["product", "both"] = "product",
        axes: int = 1,
    ) -> VelocityForceObserver: ...
    def step(self, velocity: _Sample, rendered_force: _Sample, grasp_force: _Sample) -> float:
        """Return S_vf of one tick, without unit.

        Args:
            velocity: V in m/s, shape `(axes,)`.
            rendered_force: F_v in N, shape `(axes,)`.
            grasp_force: F_h in N, shape `(axes,)`; checked, not used.

        Raises:
            ValueError: A number is not finite or out of bounds, or the number of axes differs.

        Source: paper Eq. 1.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """Run `step` over arrays of shape `(n_ticks, axes)`; S_vf of shape `(n_ticks,)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick).

        Source: paper Eq. 1.
        """

@final
class HandGraspObserver:
    """HGO: near 1 while the hand holds against the rendered force, large when nobody holds.

    `S_h = |F_v| / (|F_h| + alpha)`

    One sample is a float for one axis, else `axes` floats.

    Args:
        grasp_floor_n: alpha in N, above 0.
        axes: 1 to 7.

    Raises:
        ValueError: alpha is outside its range or an invalid number of `axes`.

    Source: paper Eq. 5.
    """

    def __new__(cls, *, grasp_floor_n: float = 1e-3, axes: int = 1) -> HandGraspObserver: ...
    def step(self, velocity: _Sample, rendered_force: _Sample, grasp_force: _Sample) -> float:
        """Return S_h of one tick, without unit; safe up to zeta.

        Args:
            velocity: V in m/s, shape `(axes,)`; checked, not used.
            rendered_force: F_v in N, shape `(axes,)`.
            grasp_force: F_h in N, shape `(axes,)`.

        Raises:
            ValueError: A number is not finite or out of bounds, or the number of axes differs.

        Source: paper Eq. 5.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """Run `step` over arrays of shape `(n_ticks, axes)`; S_h of shape `(n_ticks,)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick).

        Source: paper Eq. 5.
        """

@final
class SafetyObserver:
    """SO: energy from the hand since the start, minus the kinetic energy of a safe device.

    `E_so(n) = dT sum_{i=1..n} F_h(i)·V(i) - V(n)' M V(n) / (2 eta)`

    It keeps all energy, so a long press hides a later ejection.

    One sample is a float for one axis, else `axes` floats.

    Args:
        device: M, and the number of axes.
        period_s: dT in s, above 0.
        energy_ratio: eta, above 0 and at most 1.

    Raises:
        ValueError: A parameter is outside its range.

    Source: paper Eq. 9.
    """

    def __new__(cls, device: DeviceModel, *, period_s: float = 1e-3, energy_ratio: float = 0.5) -> SafetyObserver: ...
    def step(self, velocity: _Sample, rendered_force: _Sample, grasp_force: _Sample) -> float:
        """Return E_so in J after one tick.

        Args:
            velocity: V in m/s, shape `(axes,)`.
            rendered_force: F_v in N, shape `(axes,)`; checked, not used.
            grasp_force: F_h in N, shape `(axes,)`.

        Raises:
            ValueError: A number is not finite or out of bounds, or the number of axes differs; the state is unchanged.

        Source: paper Eq. 9.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """Run `step` over arrays of shape `(n_ticks, axes)`; E_so in J of shape `(n_ticks,)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick). Earlier ticks
                are processed.

        Source: paper Eq. 9.
        """

    def reset(self) -> None:
        """Clear all energy."""

@final
class WindowedSafetyObserver:
    """WSO: SO over the last w ticks only, so that old energy hides nothing.

    `E_wso(n) = dT sum_{i=max(1, n-w+1)..n} F_h(i)·V(i) - V(n)' M V(n) / (2 eta)`

    One sample is a float for one axis, else `axes` floats.

    Args:
        device: M, and the number of axes.
        period_s: dT in s, above 0.
        energy_ratio: eta, above 0 and at most 1.
        window: w in ticks, 1 to 3600000.

    Raises:
        ValueError: A parameter is outside its range.

    Source: paper Eq. 11.
    """

    def __new__(
        cls,
        device: DeviceModel,
        *,
        period_s: float = 1e-3,
        energy_ratio: float = 0.5,
        window: int = 100,
    ) -> WindowedSafetyObserver: ...
    def step(self, velocity: _Sample, rendered_force: _Sample, grasp_force: _Sample) -> float:
        """Return E_wso in J after one tick.

        Args:
            velocity: V in m/s, shape `(axes,)`.
            rendered_force: F_v in N, shape `(axes,)`; checked, not used.
            grasp_force: F_h in N, shape `(axes,)`.

        Raises:
            ValueError: A number is not finite or out of bounds, or the number of axes differs; the state is unchanged.

        Source: paper Eq. 11.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """Run `step` over arrays of shape `(n_ticks, axes)`; E_wso in J of shape `(n_ticks,)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick). Earlier ticks
                are processed.

        Source: paper Eq. 11.
        """

    def reset(self) -> None:
        """Clear all energy."""

@final
class PassivityObserver:
    """PO: energy that has flowed from the hand's side into what renders the force.

    `E(n) = - sum_{k<n} F_device(k)·(x(k+1) - x(k))`; negative: the environment has given out more than it took. Force
    times displacement is the exact work of a force that is held over a tick.

    One sample is a float for one axis, else `axes` floats.

    Args:
        axes: 1 to 7.

    Raises:
        ValueError: The number of `axes` is invalid.

    Source: Hannaford and Ryu 2002, Eq. 5; Stramigioli et al. 2005 (sampled energy).
    """

    def __new__(cls, *, axes: int = 1) -> PassivityObserver: ...
    def step(self, position: _Sample, held_force: _Sample) -> float:
        """Return E in J at one position.

        Args:
            position: x in m, shape `(axes,)`.
            held_force: F_device in N, shape `(axes,)`, exerted since the last position; not used at the first.

        Raises:
            ValueError: A number is not finite or out of bounds, or the number of axes differs; the state is unchanged.

        Source: Hannaford and Ryu 2002, Eq. 5.
        """

    def run(self, position: _Array, held_force: _Array) -> _Array:
        """Run `step` over arrays of shape `(n_ticks, axes)`; E in J of shape `(n_ticks,)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick). Earlier ticks
                are processed.

        Source: Hannaford and Ryu 2002, Eq. 5.
        """

    def reset(self) -> None:
        """Clear all energy and the last position."""

@final
class SafetySettings:
    """Active controllers, their thresholds, and the start and end of an intervention.

    The defaults are the paper's. `SafetyController` checks the ranges.

    Attributes:
        FRICTION_ROOM: Multiple of c that `probe_force_n` times `probe_threshold` must reach.
        PROBED_DAMPING: Share of mu that damps while a probe acts.

    Args:
        controllers: Any of "vfc" (Eq. 2), "hsc" (Eq. 14), "wsc" (Eq. 13), "pc" (Eq. 12).
        damping: mu in N s/m, between 0 and m / (5 dT).
        velocity_threshold: V_t in m/s, above 0 (Eq. 1).
        vfc_force_threshold_n: F_t in N, above 0 (Eq. 1).
        vfc_form: Form of Eq. 1, see `VelocityForceObserver`.
        grasp_threshold: zeta, above 1 (Eq. 8).
        grasp_floor_n: alpha in N, above 0 (Eq. 5).
        hsc_force_threshold_n: F_t in N, 0 or more (Eq. 14).
        hsc_velocity_threshold: V_s in m/s, 0 or more: HSC trips only while `V·F_v / |F_v| > V_s`; 0 is Eq. 14 as
            printed.
        energy_threshold_j: delta in J, below 0, by default -0.03 (Eq. 10).
        wsc_force_threshold_n: F_w in N, 0 or more: WSC trips only while `F_v·V / |V| > F_w`; 0 is Eq. 13 as printed.
        energy_ratio: eta, above 0 and at most 1 (Eq. 9).
        window: w in ticks, 1 to 3600000 (Eq. 11).
        pc_max_damping: Bound in N s/m on the damping of Eq. 12, between 0 and m / (5 dT).
        hold_off_s: Least duration of an intervention in s, 0 to 60.
        release_ramp_s: Least time in s over which an intervention fades out, 0 to 60.
        probe_force_n: A in N of the probe that a hand must answer before an intervention fades, at least 2 c / r_th; at
            0 only time counts.
        probe_threshold: r_th, smallest share of the probe that a hand resists, above 0 and below 1.
        release_tries: Number of tries, of a second each, after which the force stays off unless it was back for 1 s. 0
            means no end and, without a probe, requires no hand.

    Raises:
        ValueError: A controller or `vfc_form` is invalid.

    Source: paper section 4 (thresholds).
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    FRICTION_ROOM: ClassVar[float]
    PROBED_DAMPING: ClassVar[float]

    def __new__(
        cls,
        controllers: Sequence[ControllerName] = (),
        *,
        damping: float = 5.0,
        velocity_threshold: float = 0.6,
        vfc_force_threshold_n: float = 1.0,
        vfc_form: Literal["product", "both"] = "product",
        grasp_threshold: float = 1.5,
        grasp_floor_n: float = 1e-3,
        hsc_force_threshold_n: float = 0.1,
        hsc_velocity_threshold: float = 0.0,
        energy_threshold_j: float = -0.03,
        wsc_force_threshold_n: float = 0.0,
        energy_ratio: float = 0.5,
        window: int = 100,
        pc_max_damping: float = 10.0,
        hold_off_s: float = 0.0,
        release_ramp_s: float = 0.0,
        probe_force_n: float = 0.0,
        probe_threshold: float = 0.2,
        release_tries: int = 0,
    ) -> SafetySettings: ...
    @property
    def thresholds(self) -> dict[str, float]:
        """Threshold of each controller's observer by the controller's name; positive: it trips above, else below."""

    def __eq__(self, other: object, /) -> bool: ...

@final
class SafetyController:
    """Controllers combined: while one of VFC, HSC, WSC trips, `F_c = -F_v - mu V`, else 0.

    The force lasts for the hold-off, then fades over the release ramp. PC, scaled by the rest of the fade, dissipates
    the energy that SO finds missing: `F_c = E_so V / (|V|² dT)` for E_so < 0, never more than `pc_max_damping` V. Keeps
    its state between calls.

    One sample is a float for one axis, else `axes` floats.

    Args:
        device: M, and the number of axes.
        settings: Controllers and thresholds.
        period_s: dT in s, above 0.

    Raises:
        ValueError: A parameter is outside its range, with its symbol in the paper.

    Source: paper Eq. 2, 12, 13 and 14.
    """

    def __new__(cls, device: DeviceModel, settings: SafetySettings, *, period_s: float = 1e-3) -> SafetyController: ...
    @property
    def axes(self) -> int:
        """Number of axes."""

    def step(
        self,
        velocity: _Sample,
        rendered_force: _Sample,
        grasp_force: _Sample,
        aligned_rendered_force: _Sample | None = None,
    ) -> Intervention:
        """Return F_c of one tick.

        A number that is not finite or out of bounds raises no error: the result is a fault and zero force, and the
        state is unchanged.

        Args:
            velocity: V in m/s, shape `(axes,)`.
            rendered_force: F_v in N, shape `(axes,)`.
            grasp_force: F_h in N, shape `(axes,)`.
            aligned_rendered_force: F_v in N, shape `(axes,)`, with the delay of F_h (`Estimator.align`); by default F_v
                itself.

        Raises:
            ValueError: Wrong number of axes.

        Source: paper Eq. 2, 12, 13 and 14.
        """

    def run(
        self,
        velocity: _Array,
        rendered_force: _Array,
        grasp_force: _Array,
        aligned_rendered_force: _Array | None = None,
    ) -> Interventions:
        """Run `step` over arrays.

        Args:
            velocity: V in m/s, shape `(n_ticks, axes)`.
            rendered_force: F_v in N, the same shape.
            grasp_force: F_h in N, the same shape.
            aligned_rendered_force: F_v in N, filtered by the kernel that delays F_h (`Estimator.run`), the same shape;
                F_v itself if not given. S_h compares it with F_h.

        Raises:
            ValueError: Wrong shape or length.

        Source: paper Eq. 2, 12, 13 and 14.
        """

    def reset(self) -> None:
        """Clear all energy and end any intervention."""

@final
class Intervention:
    """Decision and observations of `SafetyController.step` at one tick."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(axes,)`."""

    @property
    def device_force(self) -> _Array:
        """F_v + F_c in N, before any limiter, shape `(axes,)`; zero at a fault."""

    @property
    def tripped(self) -> int:
        """Tripped controllers: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while an intervention is only held."""

    @property
    def fault(self) -> int:
        """Code for `fault_message`; 0 without fault."""

    @property
    def velocity_force(self) -> float:
        """S_vf; NaN without VFC or at a fault."""

    @property
    def grasp(self) -> float:
        """S_h; NaN without HSC or at a fault."""

    @property
    def windowed_energy_j(self) -> float:
        """E_wso [J]; NaN without WSC or at a fault."""

    @property
    def energy_j(self) -> float:
        """E_so [J]; NaN without PC or at a fault."""

@final
class Interventions:
    """Decisions and observations of `SafetyController.run` at each tick.

    An observer that no controller reads is not computed: its array is None.
    """

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(n_ticks, axes)`."""

    @property
    def device_force(self) -> _Array:
        """F_v + F_c in N, before any limiter, shape `(n_ticks, axes)`; zero at a fault."""

    @property
    def tripped(self) -> _Bits:
        """Tripped controllers, shape `(n_ticks,)`: VFC 1, HSC 2, WSC 4, PC 8; 16 while only held."""

    @property
    def fault(self) -> _Bits:
        """Codes for `fault_message`, 0 without fault, shape `(n_ticks,)`."""

    @property
    def velocity_force(self) -> _Array | None:
        """S_vf, shape `(n_ticks,)`; NaN at a fault, None without VFC."""

    @property
    def grasp(self) -> _Array | None:
        """S_h, shape `(n_ticks,)`; NaN at a fault, None without HSC."""

    @property
    def windowed_energy_j(self) -> _Array | None:
        """E_wso [J], shape `(n_ticks,)`; NaN at a fault, None without WSC."""

    @property
    def energy_j(self) -> _Array | None:
        """E_so [J], shape `(n_ticks,)`; NaN at a fault, None without PC."""

@final
class LimiterSettings:
    """Bounds on the commanded device force; `Limiter` checks the ranges.

    Args:
        max_force_n: Largest |F| in N, above 0; a PHANTOM Desktop exerts 7.9 N.
        max_slew_n_per_s: Largest growth of the force in N/s, above 0; unloading is free.
        max_power_w: Largest F·V in W that the device may put into the hand, above 0.
        ramp_in_s: Rise time of the force from zero after a reset in s, 0 to 60.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(
        cls,
        *,
        max_force_n: float = 7.9,
        max_slew_n_per_s: float = 1000.0,
        max_power_w: float = 20.0,
        ramp_in_s: float = 0.2,
    ) -> LimiterSettings: ...
    def __eq__(self, other: object, /) -> bool: ...

@final
class Limiter:
    """Keeps the device force inside its bounds, as a vector: no axis is clipped separately.

    In this order: the ramp-in scales, |F| is clipped, the step from the last force is limited except for unloading, and
    the part along V is reduced until `F·V <= P_max`. The bounds on |F| and power hold at every tick. Only a reduction
    by the power bound may exceed the slew bound.

    One sample is a float for one axis, else `axes` floats.

    Args:
        settings: Bounds; by default those of `LimiterSettings`.
        period_s: dT in s, above 0.
        axes: 1 to 7.

    Raises:
        ValueError: A bound or `period_s` is outside its range, or an invalid number of `axes`.
    """

    def __new__(cls, settings: LimiterSettings | None = None, *, period_s: float = 1e-3, axes: int = 1) -> Limiter: ...
    def step(self, force: _Sample, velocity: _Sample) -> tuple[_Array, int]:
        """Limit the force of one tick.

        Args:
            force: Requested force in N, shape `(axes,)`.
            velocity: V in m/s, shape `(axes,)`.

        Returns:
            The limited force in N, shape `(axes,)`, and the bounds that acted: sum of |F| 1, slew 2, power 4, ramp-in
            8.

        Raises:
            ValueError: A number is not finite or out of bounds, or the number of axes differs; the state is unchanged.
        """

    def run(self, force: _Array, velocity: _Array) -> tuple[_Array, _Bits]:
        """Run `step` over arrays of shape `(n_ticks, axes)`; bits of shape `(n_ticks,)`.

        Raises:
            ValueError: Wrong shape or length; or a number is not finite or out of bounds (with its tick). Earlier ticks
                are processed.
        """

    def reset(self) -> None:
        """Set the force to zero at once and restart the ramp-in."""

@final
class ResearchObservation:
    """Observations of one tick for a Python controller, equal to those of the scene's controllers."""

    @property
    def time_s(self) -> float:
        """t in s since the first tick of the run."""

    @property
    def velocity(self) -> _Array:
        """V in m/s, estimated, shape `(axes,)`."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N, within the device's bounds, shape `(axes,)`."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N of Eq. 4, shape `(axes,)`: late by the delay of the estimated acceleration."""

    @property
    def aligned_rendered_force(self) -> _Array:
        """F_v in N with the delay of F_h, for comparison, shape `(axes,)`."""

def fault_message(code: int) -> str | None:
    """Return the meaning of a fault code: the signal that was not finite or exceeded a bound, and the bound.

    Bounds per axis: 1000 m, 1000 m/s, 10000 N. None for 0 and for unused codes.

    Raises:
        OverflowError: The code is outside 0 to 255.
    """

@final
class SampleBounds:
    """Bounds on the samples of a device.

    A sample is on the path where `|x - x_a - v k| <= velocity_change dT + quantum (k + 1)`, k ticks after the last one.

    Args:
        joints: If true, each axis is a joint in rad and must meet the bounds separately.
        speed: Speed bound of the device in m/s (rad/s), above 0; by default 20 m/s, of joints 60 rad/s.
        velocity_change: Largest change of velocity in m/s (rad/s) from a sample to the next, above 0; by default 0.5
            m/s, which is 0.5 mm off the path at 1 kHz, of joints 5 rad/s.
        quantum: Resolution of the position in m (rad), 0 or more.

    Raises:
        ValueError: A number is outside its range.

    Source: derived here.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(
        cls,
        *,
        joints: bool = False,
        speed: float | None = None,
        velocity_change: float | None = None,
        quantum: float = 0.0,
    ) -> SampleBounds: ...
    @property
    def speed(self) -> float:
        """Speed bound in m/s (rad/s)."""

    @property
    def velocity_change(self) -> float:
        """Largest change of velocity in m/s (rad/s)."""

    @property
    def quantum(self) -> float:
        """Position resolution in m (rad)."""

    def __eq__(self, other: object, /) -> bool: ...

@final
class Renewal:
    """How often a device renews its samples, by all of them in turn.

    A sample is new if its time differs from the last, without times if position or orientation does. A change counts if it
    is like the one before and not equal to it, so that a coarse encoder that moves slowly is not taken for a slow device.

    Source: derived here.
    """

    MIN_SHARE: ClassVar[float]
    """Share of the ticks with a new sample below which the device is slower than its loop."""

    def __new__(cls) -> Renewal: ...
    def step(
        self,
        position: Sequence[float],
        *,
        orientation: Sequence[float] | None = None,
        time_s: float | None = None,
        is_late: bool = False,
    ) -> None:
        """Take the sample of a tick.

        Args:
            position: x in m (rad), shape `(axes,)`; the first seven axes count.
            orientation: Unit quaternion of a device that turns, shape `(4,)`; None for any other.
            time_s: Time of the sample in s on the device's own clock; None from a device without one.
            is_late: True if the tick was half a period late or more; it does not count then, nor does the next.
        """

    def interrupt(self) -> None:
        """Take a tick without a sample."""

    @property
    def share(self) -> float | None:
        """Share of the ticks with a new sample over the last 128 or more that count; none before."""

    @property
    def total_share(self) -> float | None:
        """The same over all ticks that count; none if they are fewer."""

    @property
    def unclear(self) -> int:
        """Changes after a repeat that may be steps of one quantum, and did not count."""

@final
class SafetyLayer:
    """Estimator, grasp force, observers, controllers and limiter: the whole pipeline of one master tick.

    The same code runs in the live endpoint. Keeps its state between calls.

    One sample is a float for one axis, else `axes` floats.

    Args:
        device: m, b, c of Eq. 3, and the number of axes.
        settings: Controllers and thresholds.
        estimator: Source of V and A from positions; by default that of `EstimatorKind`.
        limiter: Bounds on the device force, always on; by default those of `LimiterSettings`.
        samples: Bounds on samples; by default those of joints for four or more axes, else of a point.
        period_s: dT in s, above 0.

    Raises:
        ValueError: A parameter is outside its range, with its symbol in the paper.

    Source: paper Eq. 1 to 14.
    """

    def __new__(
        cls,
        device: DeviceModel,
        settings: SafetySettings,
        *,
        estimator: EstimatorKind | None = None,
        limiter: LimiterSettings | None = None,
        samples: SampleBounds | None = None,
        period_s: float = 1e-3,
    ) -> SafetyLayer: ...
    @property
    def axes(self) -> int:
        """Number of axes."""

    @property
    def outliers(self) -> int:
        """Samples off the path, each replaced by its prediction."""

    def step(self, position: _Sample, rendered_force: _Sample, velocity: _Sample | None = None) -> SafetyTick:
        """Advance by one tick.

        A number that is not finite or out of bounds returns zero force and a fault that stays; so does a step beyond
        the device's speed bound. A sample off the path is held, and its prediction replaces it.

        Args:
            position: x in m, shape `(axes,)`.
            rendered_force: F_v in N, shape `(axes,)`.
            velocity: V in m/s, shape `(axes,)`, from a device that measures it, at every tick or at none; None without.

        Raises:
            ValueError: Wrong number of axes.
        """

    def run(self, position: _Array, rendered_force: _Array, velocity: _Array | None = None) -> SafetyTicks:
        """Run `step` over arrays of shape `(n_ticks, axes)`, or `(n_ticks,)` for one axis.

        A fault is recorded at its tick and raises no error.

        Raises:
            ValueError: Wrong shape or length.
        """

    def reset(self, position: _Sample) -> None:
        """Clear a fault and the history: the device rests at `position` in m, its force rises from zero again.

        Raises:
            ValueError: The position is not finite or out of bounds, or the number of axes differs.
        """

@final
class SafetyTick:
    """Observations and decision of `SafetyLayer.step`."""

    @property
    def velocity(self) -> _Array:
        """V in m/s, shape `(axes,)`."""

    @property
    def acceleration(self) -> _Array:
        """A in m/s², shape `(axes,)`."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N within the device's bounds, as the observers receive it, shape `(axes,)`."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N; zero if no controller reads it, shape `(axes,)`."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(axes,)`."""

    @property
    def device_force(self) -> _Array:
        """F_device in N: the commanded force until the next tick; zero at a fault, shape `(axes,)`."""

    @property
    def tripped(self) -> int:
        """Tripped controllers: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while an intervention is held or fades."""

    @property
    def acted(self) -> int:
        """Bounds that acted: sum of norm 1, slew 2, power 4, ramp 8."""

    @property
    def fault(self) -> int:
        """Code for `fault_message`; 0 without fault; it stays until `SafetyLayer.reset`."""

    @property
    def owed_energy_j(self) -> float:
        """Energy in J that PC requested but the bounds prevented."""

@final
class SafetyTicks:
    """Observations and decisions of `SafetyLayer.run`, one entry per tick."""

    @property
    def velocity(self) -> _Array:
        """V in m/s, shape `(n_ticks, axes)`."""

    @property
    def acceleration(self) -> _Array:
        """A in m/s², shape `(n_ticks, axes)`."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N within the device's bounds, as the observers receive it, shape `(n_ticks, axes)`."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N; zero if no controller reads it, shape `(n_ticks, axes)`."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(n_ticks, axes)`."""

    @property
    def device_force(self) -> _Array:
        """F_device in N: the commanded force until the next tick; zero at a fault, shape `(n_ticks, axes)`."""

    @property
    def tripped(self) -> _Bits:
        """Tripped controllers, shape `(n_ticks,)`: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while held or fading."""

    @property
    def acted(self) -> _Bits:
        """Bounds that acted: sum of norm 1, slew 2, power 4, ramp 8, shape `(n_ticks,)`."""

    @property
    def fault(self) -> _Bits:
        """Code for `fault_message`; 0 without fault; it stays until `SafetyLayer.reset`, shape `(n_ticks,)`."""

    @property
    def owed_energy_j(self) -> _Array:
        """Energy in J that PC requested but the bounds prevented, shape `(n_ticks,)`."""

# ---------------------------------------------------------------------------------------------- master

@final
class HapticDevice:
    """Model of a haptic device along one axis; its motion between ticks is exact.

    `m A + b V + c sign(V) = F_device + F_h`; at rest, friction withstands up to c.

    Args:
        mass_kg: m in kg, above 0.
        viscous: b in N s/m, of any sign.
        coulomb: c in N, 0 or more.
        encoder_quantum: Resolution of the position in m, 0 or more; with 0 the device measures position and velocity
            exactly, without an estimator.
        stops: Positions in m of the mechanical stops, lower and upper, which stop the device at once; infinite without
            stops.

    Raises:
        ValueError: A parameter is outside its range.

    Source: paper Eq. 3.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(
        cls,
        *,
        mass_kg: float,
        viscous: float = 0.0,
        coulomb: float = 0.0,
        encoder_quantum: float = 0.0,
        stops: tuple[float, float] = ...,
    ) -> HapticDevice: ...
    def __eq__(self, other: object, /) -> bool: ...
    @staticmethod
    def phantom_desktop(*, encoder_quantum: float = 2.3e-5, stops: tuple[float, float] = ...) -> HapticDevice:
        """The paper's PHANTOM Desktop: m = 0.157 kg, b = -0.005 N s/m, c = 0.038 N.

        Args:
            encoder_quantum: Resolution in m; 0.023 mm is the vendor's nominal one.
            stops: Positions in m of the mechanical stops; infinite without stops.

        Raises:
            ValueError: A parameter is outside its range.

        Source: paper section 4.1.
        """

    @property
    def mass_kg(self) -> float:
        """m in kg."""

    @property
    def viscous(self) -> float:
        """b in N s/m."""

    @property
    def coulomb(self) -> float:
        """c in N."""

    @property
    def encoder_quantum(self) -> float:
        """Resolution of the position in m; 0 is exact."""

    @property
    def stops(self) -> tuple[float, float]:
        """Positions in m of the lower and upper mechanical stops."""

@final
class Hand:
    """Model of a hand along one axis: an impedance towards a path, held by a finite grip that can let go.

    `F_h = K_h (x_target - x) - B_h V`, clipped to the grip strength.

    Args:
        stiffness: K_h in N/m, 0 or more.
        damping: B_h in N s/m, 0 or more.
        strength_n: Grip strength in N, 0 or more.
        start: Start of the path in m.
        legs: Legs of the path: duration in s (above 0), final position in m, and "linear", "smooth" or "minimum-jerk".
            The hand rests after the last.
        release: Start of the release in s, and its duration in s (0 or more) until the falling quantity is zero; None
            for no release.
        release_kind: Falling quantity: "strength", so that nothing moves until it has fallen to the load, or "gain",
            the whole impedance.

    Raises:
        ValueError: A parameter is outside its range, or a shape or kind is invalid.

    Source: Hogan 1989 (impedance); Johansson and Westling 1984 (grip); Flash and Hogan 1985 (path).
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(
        cls,
        *,
        stiffness: float,
        damping: float,
        strength_n: float,
        start: float,
        legs: Sequence[tuple[float, float, Literal["linear", "smooth", "minimum-jerk"]]] = (),
        release: tuple[float, float] | None = None,
        release_kind: Literal["strength", "gain"] = "strength",
    ) -> Hand: ...
    def __eq__(self, other: object, /) -> bool: ...
    @staticmethod
    def absent(*, position: float = 0.0) -> Hand:
        """Return no hand: the device rests at `position` in m.

        Raises:
            ValueError: The position is not finite.
        """

    def target(self, time_s: float) -> float:
        """Return the position in m that the hand aims at, at a time in s."""

    def strength(self, time_s: float) -> float:
        """Return the grip strength in N at a time in s."""

# ----------------------------------------------------------------------------------------------- slave

@final
class Wall:
    """Spring wall that fills x below its surface and pushes along +x.

    `F = K (x_w - x)` inside, 0 outside.

    Args:
        stiffness: K in N/m, 0 or more.
        position: Surface x_w in m.

    Raises:
        ValueError: A parameter is outside its range.

    Source: paper Eq. 15 with B = 0.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(cls, *, stiffness: float, position: float = 0.0) -> Wall: ...
    def __eq__(self, other: object, /) -> bool: ...
    def force(self, position: float) -> float:
        """Return the force in N on a tool at `position` in m.

        Source: paper Eq. 15 with B = 0.
        """

@final
class SceneTouch:
    """Environment of a scene for an external arm: `[environment]`, along the first axes of the arm's base.

    The caller sets the scene's time: the `time_s` of every call. Pushers do not push before `start_pushers`.

    Args:
        scene_json: Output of `haptether.bridge.scene_json`.

    Raises:
        ValueError: The scene cannot be built or has more than 3 axes.
    """

    def __new__(cls, scene_json: bytes) -> SceneTouch: ...
    @property
    def axes(self) -> int:
        """1, 2 or 3; there is no force along the others."""
    @property
    def start(self) -> list[float]:
        """Start of the scene's arm in m, or of its device if it has no arm; 3 numbers."""
    @property
    def touches(self) -> bool:
        """True if the tool was inside an object when the force was last computed."""
    def reset(self) -> None:
        """Restore the initial state; the pushers wait."""
    def start_pushers(self, time_s: float) -> None:
        """Start the time of the pushers at a time in s of the scene.

        Raises:
            ValueError: The time is not finite.
        """
    def force(self, time_s: float, position: Sequence[float], velocity: Sequence[float]) -> tuple[float, float, float]:
        """Return the force in N of objects and pushers on the tool at one instant; free bodies keep their state.

        Args:
            time_s: Time of the scene in s.
            position: Tool position in m, shape `(3,)`.
            velocity: Tool velocity in m/s, shape `(3,)`.

        Raises:
            ValueError: A number is not finite.
        """
    def advance(self, time_s: float, step_s: float, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Move the free bodies over one step; the tool keeps its velocity.

        Args:
            time_s: Time of the scene in s at which the step begins.
            step_s: Duration of the step in s.
            position: Tool position in m, shape `(3,)`.
            velocity: Tool velocity in m/s, shape `(3,)`.

        Raises:
            ValueError: A number is not finite.
        """

@final
class ForceSensor:
    """Model of a force sensor: `q round((F + bias + noise) / q)` on each of 3 axes.

    Args:
        noise_n: Standard deviation in N, 0 or more.
        bias_n: Offsets in N, shape `(3,)`.
        quantum_n: Resolution in N; 0 is exact.
        seed: Seed of the noise.

    Raises:
        ValueError: A parameter is outside its range.
    """

    def __new__(
        cls, *, noise_n: float = 0.0, bias_n: Sequence[float] = (0.0, 0.0, 0.0), quantum_n: float = 0.0, seed: int = 0
    ) -> ForceSensor: ...
    def sample(self, force: Sequence[float], index: int) -> tuple[float, float, float]:
        """Return sample number `index` of a force in N, shape `(3,)`: the same index yields the same noise.

        Raises:
            ValueError: A force is not finite.
        """

@final
class UrInverseSolver:
    """Inverse kinematics of a UR arm in closed form, refined for a unit: see `haptether.slave.UrInverse`.

    Args:
        model: Denavit-Hartenberg rows theta, a, d and alpha, six numbers each, in m and rad.
        unit: Same rows of a unit that differs from its model; None for a unit that does not.
        position_min: Least joint angles in rad, shape `(6,)`; -inf without a limit.
        position_max: Largest joint angles in rad, shape `(6,)`.
        flange_from_tool: Rigid transform in m, shape `(4, 4)`.

    Raises:
        ValueError: The model is not a UR arm, a number is not finite, limits leave no range, or a transform is not
            rigid.
    """

    def __new__(
        cls,
        model: _Rows,
        unit: _Rows | None,
        position_min: Sequence[float],
        position_max: Sequence[float],
        flange_from_tool: _Array,
    ) -> UrInverseSolver: ...
    def all(self, base_from_tool: _Array) -> _Array:
        """Return all branches in rad, shape `(n, 6)`, n up to 8.

        Raises:
            ValueError: Not a rigid transform of shape `(4, 4)`.
        """

    def nearest(self, base_from_tool: _Array, near: _Array) -> _Array | str:
        """Return the posture nearest to `near` in rad, shape `(6,)`, or the reason if there is none.

        Raises:
            ValueError: Not a rigid transform of shape `(4, 4)`, or not six finite numbers.
        """

# ---------------------------------------------------------------------------------------------- netsim

@final
class DirectionStatistics:
    """Counts of the datagrams in one direction of a proxy."""

    @property
    def received(self) -> int:
        """Datagrams accepted and judged."""

    @property
    def lost(self) -> int:
        """Accepted datagrams that the link's rules removed."""

    @property
    def queue_full(self) -> int:
        """Accepted datagrams dropped because too many were in flight."""

    @property
    def released(self) -> int:
        """Accepted datagrams that were forwarded."""

    @property
    def unsent(self) -> int:
        """Accepted datagrams not forwarded when due: the socket refused them or the client was gone."""

    @property
    def damaged(self) -> int:
        """Accepted datagrams whose bytes were changed."""

    @property
    def extras(self) -> int:
        """Additional datagrams planned beside the packets: copies and forgeries."""

    @property
    def extras_released(self) -> int:
        """Additional datagrams that were sent."""

    @property
    def extras_lost(self) -> int:
        """Additional datagrams not sent: too many in flight, or refused by the socket."""

    @property
    def overtaking(self) -> int:
        """Datagrams due before one accepted earlier: each overtakes at least one."""

    @property
    def oversize(self) -> int:
        """Datagrams too large to carry, dropped before any rule."""

    @property
    def refused(self) -> int:
        """Datagrams from a source that is not served, dropped before any rule."""

    @property
    def dropped(self) -> dict[str, int]:
        """Accepted datagrams that were dropped, by cause: those of `lost` and `queue_full`."""

@final
class ProxyStatistics:
    """Counts and timing of a proxy so far."""

    @property
    def forward(self) -> DirectionStatistics:
        """From the client to the peer."""

    @property
    def backward(self) -> DirectionStatistics:
        """From the peer to the client."""

    @property
    def flows(self) -> int:
        """Clients now served."""

    @property
    def peer_unreachable(self) -> int:
        """Number of network reports that the peer is unreachable."""

    @property
    def scheduling_error_p50_s(self) -> float:
        """Lateness of the median datagram in s."""

    @property
    def scheduling_error_p99_s(self) -> float:
        """Largest lateness of all datagrams except 1 %, in s."""

    @property
    def scheduling_error_p999_s(self) -> float:
        """Largest lateness of all datagrams except 0.1 %, in s."""

    @property
    def scheduling_error_max_s(self) -> float:
        """Lateness of the latest datagram in s."""

    @property
    def early(self) -> int:
        """Datagrams that left before they were due: always none."""

    @property
    def log_lost(self) -> int:
        """Record missing from the log because its writer was late."""

    @property
    def log_failed(self) -> bool:
        """True if the log could not be written to its end, for example on a full disk; the run is then invalid."""

    @property
    def scheduling(self) -> Literal["fifo", "normal"]:
        """Scheduling of its thread."""

    @property
    def receive_buffer_bytes(self) -> int:
        """Buffer of the listening socket for waiting datagrams, by the kernel's count."""

    @property
    def send_buffer_bytes(self) -> int:
        """Buffer for sending, by the kernel's count."""

    @property
    def valid(self) -> bool:
        """True if the delays were as requested: p99 of the scheduling error within its limit."""

@final
class Proxy:
    """Live UDP proxy between clients and one peer, on its own thread; `haptether.netsim.Proxy` wraps it.

    It forwards to the peer only, and serves clients of this machine and those that `allow` names, up to 64 at a time.
    All share the link of their direction.

    Args:
        listen: Address for the clients, `HOST:PORT`; port 0 lets the system choose.
        forward: The peer, `HOST:PORT`.
        forward_link: Network from the client to the peer, as JSON.
        backward_link: Network from the peer to the client, as JSON.
        seed: Key of all draws, 0 to 2⁶⁴ - 1.
        allow: Additional sources to serve beside this machine, `IP` or `IP:PORT`; by default none.
        realtime: True to request real-time scheduling; the statistics show the scheduling granted.
        max_error_s: Largest p99 of the scheduling error in s with which a run is valid.
        log: CSV file, by default none, with the result of each datagram:
            `direction,index,kind,t_in_ns,t_due_ns,t_out_ns,cause,error_ns,size`. `kind` is empty for the packet itself,
            else the reason for a copy; `t_out_ns` is the start of the sending call.

    Raises:
        ValueError: An address or the settings of a link are invalid.
        OSError: An address or the log cannot be used.
        RuntimeError: No thread can be created.
    """

    def __new__(
        cls,
        *,
        listen: str,
        forward: str,
        forward_link: str,
        backward_link: str,
        seed: int = 0,
        allow: Sequence[str] = (),
        realtime: bool = True,
        max_error_s: float = 1e-3,
        log: str | PathLike[str] | None = None,
    ) -> Proxy: ...
    @property
    def address(self) -> str:
        """Listening address, with the chosen port."""

    @property
    def forward(self) -> str:
        """Address to which it forwards: the first of a name that accepts packets."""

    @property
    def finished(self) -> bool:
        """True if its thread has ended."""

    def change(self, direction: Literal["forward", "backward"], settings: str) -> None:
        """Change the settings for datagrams that arrive from now on; acts within 20 ms, in order.

        Args:
            direction: Direction that changes.
            settings: New settings of its link, as JSON.

        Raises:
            ValueError: The `direction` or the settings are invalid.
        """

    def statistics(self) -> ProxyStatistics:
        """Return the statistics so far; the proxy continues."""

    def stop(self) -> ProxyStatistics:
        """End the proxy, within 20 ms; packets still in flight are not sent.

        Raises:
            OSError: The proxy had ended on an error of its sockets.
            RuntimeError: Its thread panicked.
        """

@final
class Echo:
    """Answers each probe of `record` with one of the same size; runs on its own thread.

    Args:
        listen: Listening address, `HOST:PORT`; port 0 lets the system choose.

    Raises:
        ValueError: An address is invalid.
        OSError: An address cannot be used.
    """

    def __new__(cls, *, listen: str) -> Echo: ...
    @property
    def address(self) -> str:
        """Listening address, with the chosen port."""

    @property
    def finished(self) -> bool:
        """True if its thread has ended."""

    def stop(self) -> tuple[int, int]:
        """End the echo; return the number of answered probes and of other datagrams.

        Raises:
            OSError: It had ended on an error of its socket.
            RuntimeError: It was stopped before, or its thread panicked.
        """

@final
class Recording:
    """Measurements of `record`: each array of shape `(n_probes,)`, nan for a loss.

    If the other direction lost a probe, the delay is that of the previous probe.
    """

    def __len__(self) -> int: ...
    @property
    def peer(self) -> str:
        """Address of the answering echo, if a name has several."""

    @property
    def time_s(self) -> _Array:
        """Time of sending of each probe, in s since the first."""

    @property
    def forward_delay_s(self) -> _Array:
        """Delay of the probe in s."""

    @property
    def backward_delay_s(self) -> _Array:
        """Delay of its answer in s."""

    @property
    def lost_forward(self) -> int:
        """Probes lost towards the echo."""

    @property
    def lost_backward(self) -> int:
        """Answer lost on the return path."""

    @property
    def shortest_s(self) -> float:
        """Shortest round trip in s, without the time at the echo."""

    @property
    def offset_s(self) -> float:
        """Estimated lead of the echo's clock in s, in the middle of the measurement."""

    @property
    def drift(self) -> float:
        """Estimated excess rate of the echo's clock, as a share."""

    @property
    def latest_s(self) -> float:
        """Largest lateness of a sent probe in s."""

    def write_csv(self, path: str | PathLike[str]) -> None:
        """Write `time_s,forward_delay_s,backward_delay_s`, with an empty cell for a loss, below comments.

        Raises:
            OSError: The file cannot be written.
        """

def record(peer: str, *, rate_hz: float = 1000.0, duration_s: float = 10.0, realtime: bool = True) -> Recording:
    """Measure the network to an `Echo` and back with a stream of probes.

    Only the round trip is certain. With the echo's clock ahead by theta, a probe shows `a = forward + theta` and `b =
    backward - theta`. For the probe with the least wait in each time window, both directions are assumed equal: `theta
    = (a - b) / 2`. A line through the quieter half of the windows gives theta(t).

    Args:
        peer: Address of the echo, `HOST:PORT`.
        rate_hz: Probes per second, at most 1000.
        duration_s: Duration in s; at most ten million probes.
        realtime: True to request real-time scheduling.

    Raises:
        ValueError: A number is outside its range, or an address is invalid.
        OSError: Nobody answered, or the network cannot be used.

    Source: Mills 1991 (minimum filter); Paxson 1998 (drift through minima).
    """

def check_link(settings: str) -> None:
    """Check the settings of a link, as JSON.

    Raises:
        ValueError: A setting is invalid; the message names its key, the value and the limits.
    """

def link_bounds(settings: str) -> tuple[float, float]:
    """Return the longest time in s that a packet is in flight, and the time in s of the last scheduled change.

    Raises:
        ValueError: As `check_link`.
    """

def read_link_file(form: str, data: bytes, direction: str) -> str:
    """Return the setting of a link file as JSON.

    Args:
        form: "csv", "irtt", "mahimahi" or "dist".
        data: Bytes of the file.
        direction: "forward" or "backward": that of the delays in a recording of both directions.

    Raises:
        ValueError: `form` or `direction` is invalid, or the file; the message then gives line and column.
    """

def translate_netem(text: str) -> str:
    """Return the request of `tc netem` arguments as JSON.

    `settings` are those of an equivalent link; `asked` has the correlations of delay, loss, duplicate, corrupt and
    reorder, 0 to 1, and the limit.

    Raises:
        ValueError: Text that netem refuses, with its column, or a request for which a link has no settings.
    """

def verdict_causes() -> list[str]:
    """Return the names of the causes of `judge_packets`, by code."""

def judge_packets(
    settings: str,
    sent_ns: npt.NDArray[np.int64],
    sizes: npt.NDArray[np.int64] | None,
    direction: str,
    seed: int,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
    """Return index, times of sending and arrival in ns, and cause code of each packet; see `netsim.judge_all`.

    Args:
        settings: Settings of the link, as JSON.
        sent_ns: Times of sending in ns, shape `(n,)`, not decreasing.
        sizes: Sizes in bytes, shape `(n,)`; None for 0.
        direction: "forward" or "backward".
        seed: Key of all draws.

    Returns:
        Four arrays of equal shape, one entry per packet and per additional packet; the arrival is -1 for a loss.

    Raises:
        ValueError: As `check_link`, a number below 0, times that decrease, wrong lengths or an invalid `direction`.
    """

# ---------------------------------------------------------------------------------------------- bridge

@final
class Sinusoid:
    """Active force `F_v = a sin(w t)`.

    Args:
        amplitude_n: a in N.
        rate: w in rad/s.

    Raises:
        ValueError: A number is not finite.

    Source: paper section 4.5.
    """

    def __new__(cls, *, amplitude_n: float, rate: float) -> Sinusoid: ...

@type_check_only
class _ObservedTicks:
    """Observations of the controllers at each tick, and the tripped controllers."""

    @property
    def grasp_force(self) -> _Array:
        """Estimated F_h in N; 0 if no controller reads it.

        Source: paper Eq. 4.
        """

    @property
    def velocity_force(self) -> _Array:
        """S_vf; NaN if not observed.

        Source: paper Eq. 1.
        """

    @property
    def grasp(self) -> _Array:
        """S_h; NaN if not observed.

        Source: paper Eq. 5.
        """

    @property
    def windowed_energy_j(self) -> _Array:
        """E_wso in J; NaN if not observed.

        Source: paper Eq. 11.
        """

    @property
    def tripped(self) -> _Bits:
        """Tripped controllers: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while only held."""

@final
class LocalTrace(_ObservedTicks):
    """Ticks of `run_local`: each signal an array of shape `(n_ticks,)`."""

    def __len__(self) -> int: ...
    @property
    def time_s(self) -> _Array:
        """Time in s."""

    @property
    def position(self) -> _Array:
        """True position x in m."""

    @property
    def velocity(self) -> _Array:
        """True velocity V in m/s."""

    @property
    def hand_force(self) -> _Array:
        """True force of the hand on the device in N."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N."""

    @property
    def device_force(self) -> _Array:
        """F_device in N, after the limiter."""

    @property
    def energy_j(self) -> _Array:
        """E_so in J; NaN if not observed.

        Source: paper Eq. 9.
        """

def run_local(
    device: HapticDevice,
    hand: Hand,
    rendered: Wall | Sinusoid,
    *,
    ticks: int,
    settings: SafetySettings | None = None,
    estimator: EstimatorKind | None = None,
    limiter: LimiterSettings | None = None,
    period_s: float = 1e-3,
    start: tuple[float, float] | None = None,
    device_delay: int = 0,
) -> LocalTrace:
    """Run the loop without a network: device and hand under a locally rendered force.

    The force is computed once per tick and held; between ticks the motion is exact.

    Args:
        device: Model of the device, with its encoder.
        hand: Hand that holds it.
        rendered: Source of the rendered force.
        ticks: Number of ticks, at most 2e7.
        settings: Safety controllers; None for no controller.
        estimator: Estimator for a device with an encoder; by default that of `EstimatorKind`.
        limiter: Bounds; by default those of `LimiterSettings`, without ramp-in.
        period_s: dT in s, a whole number of ns between 1e-6 and 1.
        start: Position in m and velocity in m/s; by default at rest at the start of the hand's path.
        device_delay: Delay of the device force in ticks, at most 1000; unknown to the controllers.

    Raises:
        ValueError: A parameter is outside its range.

    Source: paper Eq. 15 and section 4 (the experiments).
    """

@type_check_only
class _SideTicks:
    """State of a side and its ladder at each tick."""

    def __len__(self) -> int: ...
    @property
    def time_s(self) -> _Array:
        """Time since the start of the run in s."""

    @property
    def state(self) -> _Bits:
        """State of the ladder, for `ladder_state_name`."""

    @property
    def reason(self) -> _Bits:
        """Reason of the state, for `ladder_reason`; 0 for the initial state."""

    @property
    def clutch(self) -> _Bits:
        """1 while this side knows that the clutch is closed."""

    @property
    def age_s(self) -> _Array:
        """Silence of the peer in s; infinite before its first frame."""

    @property
    def round_trip_s(self) -> _Array:
        """Round trip in s of the newest echo, both loops' waits for their ticks included; infinite before the first."""

    @property
    def overshoot_s(self) -> _Array:
        """Lateness of the loop's wake in s; in virtual time only if the clock of this side is set."""

    @property
    def fault(self) -> _Bits:
        """Code for `fault_message`; 0 without fault, shape `(n_ticks,)`."""

@final
class MasterTrace(_SideTicks, _ObservedTicks):
    """Ticks of a master: each signal an array of shape `(n_ticks,)`, or `(n_ticks, axes)` for vectors of several axes."""

    @property
    def position(self) -> _Array:
        """Position x in m, as the device measures it."""

    @property
    def velocity(self) -> _Array:
        """True velocity V in m/s for a model device, else estimated."""

    @property
    def hand_force(self) -> _Array:
        """True force of the hand in N for a model device, else 0."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N, faded by the ladder and limited to the device's bounds."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N."""

    @property
    def device_force(self) -> _Array:
        """F_device in N, after the limiter."""

    @property
    def orientation(self) -> _Array | None:
        """Measured R, unit quaternions w, x, y, z of shape `(n_ticks, 4)`; None except for kind "pose"."""

    @property
    def angular_velocity(self) -> _Array | None:
        """True w in rad/s for a model device, else estimated."""

    @property
    def hand_torque(self) -> _Array | None:
        """True torque of the hand in N m for a model device, else 0."""

    @property
    def rendered_torque(self) -> _Array | None:
        """Requested torque in N m, faded by the ladder and limited to the device's bounds."""

    @property
    def grasp_torque(self) -> _Array | None:
        """Estimated torque of the hand in N m."""

    @property
    def safety_torque(self) -> _Array | None:
        """Torque of the controllers in N m."""

    @property
    def device_torque(self) -> _Array | None:
        """Torque of the device in N m, after the limiter."""

    @property
    def acted(self) -> _Bits:
        """Which bounds of the limiter acted: sum of |F| 1, slew 2, power 4, ramp-in 8."""

    @property
    def trigger(self) -> _Array:
        """Command of the gripper, 0 (open) to 1 (closed); NaN if unknown or without a gripper."""

    @property
    def trigger_velocity(self) -> _Array | None:
        """Estimated V of a force-feedback trigger in m/s, positive closing.

        None without one, also for the signals below.
        """

    @property
    def trigger_rendered_force(self) -> _Array | None:
        """F_v at the trigger in N, limited to its bounds."""

    @property
    def trigger_safety_force(self) -> _Array | None:
        """F_c at the trigger in N."""

    @property
    def trigger_device_force(self) -> _Array | None:
        """F_device at the trigger in N, after the limiter."""

    @property
    def trigger_tripped(self) -> _Bits | None:
        """Tripped controllers of the trigger, coded like `tripped`."""

@final
class SlaveTrace(_SideTicks):
    """Ticks of a slave: each signal an array of shape `(n_ticks,)`, or `(n_ticks, axes)` for vectors of several axes."""

    @property
    def position(self) -> _Array:
        """Position of the tool in m."""

    @property
    def command(self) -> _Array:
        """Commanded position in m; the tool's own before the first command."""

    @property
    def environment_force(self) -> _Array:
        """F_e in N, of wall and pusher on the tool."""

    @property
    def exerted_force(self) -> _Array:
        """F_c in N on an arm that takes forces; NaN while it follows a position."""

    @property
    def orientation(self) -> _Array | None:
        """R of the tool, unit quaternions w, x, y, z of shape `(n_ticks, 4)`; None except for kind "pose"."""

    @property
    def command_orientation(self) -> _Array | None:
        """Commanded R; the tool's own before the first command."""

    @property
    def environment_torque(self) -> _Array | None:
        """Torque of the environment on the tool in N m."""

    @property
    def limited(self) -> _Bits:
        """Bounds that acted on the remote command: speed 1, reach 2, angular speed 4, turn 8."""

    @property
    def gripper(self) -> _Array:
        """Position of the gripper, 0 (open) to 1 (closed); NaN without one."""

    @property
    def gripper_command(self) -> _Array:
        """Last gripper command, 0 (open) to 1 (closed); NaN before the first."""

    @property
    def gripper_force(self) -> _Array:
        """Force between the jaws in N; NaN without a gripper."""

    @property
    def holds_object(self) -> _Bits:
        """1 if something stops the jaws."""

@final
class LinkStatistics:
    """Sent and received frames of one side."""

    @property
    def sent(self) -> int:
        """Frames sent."""

    @property
    def fresh(self) -> int:
        """Frames newer than all earlier ones on arrival."""

    @property
    def late(self) -> int:
        """Frames that arrived after a newer one: counted, not used."""

    @property
    def duplicate(self) -> int:
        """Frames that had already arrived."""

    @property
    def refused(self) -> int:
        """Datagrams that were not a frame of the peer."""

    @property
    def missing(self) -> int:
        """Frames between the first and the newest that have not arrived."""

    @property
    def round_trip_s(self) -> float:
        """Round trip in s of the newest echo, without the time at the peer; 0 before any."""

    @property
    def least_round_trip_s(self) -> float:
        """Least round trip in s; 0 before any."""

    @property
    def play_out_s(self) -> float:
        """Wait in s that the play-out adds to the fastest frames; 0 without one."""

    @property
    def coupling(self) -> str:
        """Coupling of the sent frames; an operator may switch it."""

@final
class PathReport:
    """Effects of the path on the peer's frames in a run, and knowledge of the peer's clock."""

    @property
    def expected(self) -> int:
        """Frames from the first to the newest that arrived."""

    @property
    def received(self) -> int:
        """Different frames of these that arrived."""

    @property
    def lost(self) -> int:
        """Frames of these that did not arrive."""

    @property
    def loss(self) -> float:
        """Share of lost frames; 0 before the first frame."""

    @property
    def bursts(self) -> int:
        """Runs of lost frames."""

    @property
    def mean_burst(self) -> float:
        """Mean length of a run in frames; 0 without any."""

    @property
    def longest_burst(self) -> int:
        """Longest run in frames."""

    @property
    def reordered(self) -> int:
        """Frames that arrived after a newer one."""

    @property
    def mean_extent(self) -> float:
        """Mean lateness of these in arrivals (RFC 4737); 0 without any."""

    @property
    def longest_extent(self) -> int:
        """Largest lateness in arrivals."""

    @property
    def duplicate(self) -> int:
        """Frames that had already arrived; those of a session are in `LoopReport.rejections`."""

    @property
    def too_late(self) -> int:
        """Frames so late that they count as lost, or from before the first."""

    @property
    def jitter_s(self) -> float:
        """Interarrival jitter in s (RFC 3550)."""

    @property
    def rate_hz(self) -> float:
        """Mean rate of arrival in Hz."""

    @property
    def worst_gap_s(self) -> float:
        """Longest time in s without a frame, the end of the run included."""

    @property
    def usual_age_s(self) -> float | None:
        """Bound of the usual age in s, the ladder's reference; None before any echo."""

    @property
    def offset_s(self) -> float | None:
        """Lead of the peer's clock in s; None before it is known."""

    @property
    def offset_bound_s(self) -> float | None:
        """Error bound of `offset_s` in s."""

    @property
    def clock_steps(self) -> int:
        """Number of proven clock steps."""

    @property
    def clock_faults(self) -> int:
        """Exchanges that healthy clocks cannot make, steps included."""

    @property
    def last_clock_fault(self) -> str | None:
        """Most recent clock fault."""

@final
class RecordingReport:
    """Result of a recording."""

    @property
    def written(self) -> int:
        """Records that the system accepted."""

    @property
    def dropped(self) -> int:
        """Records of the loop missing from the file; while it runs, waiting records count too."""

    @property
    def end(self) -> str | None:
        """Reason if the recording ended before the run, else None."""

@final
class LoopReport:
    """Result of one side's loop."""

    @property
    def ticks(self) -> int:
        """Completed ticks."""

    @property
    def skipped(self) -> int:
        """Ticks skipped because the loop woke too late."""

    @property
    def dropped_records(self) -> int:
        """Ticks that newer ones have replaced in the trace: it holds the last `keep_s`."""

    @property
    def unsent(self) -> int:
        """Frames that the system refused to send."""

    @property
    def link(self) -> LinkStatistics:
        """Counts of the link."""

    @property
    def path(self) -> PathReport:
        """Effects of the path on the peer's frames, and knowledge of its clock."""

    @property
    def holds(self) -> int:
        """Number of transitions to HOLD."""

    @property
    def limited(self) -> int:
        """Ticks at which a bound limited the remote command; 0 for a master."""

    @property
    def outliers(self) -> int:
        """Samples off the path, each replaced by its prediction."""

    @property
    def renewal(self) -> float | None:
        """Share of the ticks with a new sample of the driver's device, as last measured over a motion; none before."""

    @property
    def secure(self) -> bool:
        """True if frames were encrypted and authenticated."""

    @property
    def rejections(self) -> dict[str, int]:
        """Datagrams that the session rejected, by cause; causes without any are omitted."""

    @property
    def engaged_s(self) -> float:
        """Time in s from the start to the first engagement; infinite if never."""

    @property
    def realtime(self) -> str:
        """Real-time settings granted to the loop's thread, as read back from the system."""

    @property
    def is_realtime(self) -> bool:
        """True if the loop ran under SCHED_FIFO."""

    @property
    def recording(self) -> RecordingReport | None:
        """Result of the recording; None without one."""

    @property
    def out_of_memory(self) -> bool:
        """True if the loop was ended because no memory was left."""

@final
class SignalRelay:
    """Applies signals to live loops, in a thread that waits neither for Python nor for a reader of its output.

    With `signal.set_wakeup_fd(relay.fileno())` Python writes the numbers of its signals with a handler to it. SIGINT,
    SIGTERM and SIGHUP end the attached loops; SIGUSR1 presses the clutch of a master and allows another master at a
    slave, unless a stop was requested; a second SIGINT ends the process with status 130, once the loops are at rest, or
    after 0.3 s. A failed memory allocation also ends the loops.

    Raises:
        MemoryError: The memory reserve for the end of a run is not available.
        OSError: No thread or socket can be created.
    """

    def __new__(cls) -> SignalRelay: ...
    def fileno(self) -> int:
        """Return the descriptor that takes the numbers of signals, a byte each; it never blocks."""

    def attach(self, of: LiveMaster | LiveSlave | MasterLoop | SlaveLoop) -> None:
        """Pass signals to a loop; one that has already arrived ends it.

        Raises:
            TypeError: `of` is no live loop.
        """

    def stop(self) -> None:
        """End the attached loops, as SIGTERM does."""

    @property
    def stopped(self) -> bool:
        """True if a stop was requested."""

    @property
    def out_of_memory(self) -> bool:
        """True if the loops of this process were ended because no memory was left."""

    def spend_reserve(self) -> None:
        """End the loops of this process, and free their memory reserve."""

    def take_acknowledgement(self) -> bool:
        """Return True if SIGUSR2 has arrived within the last 0.5 s and was not yet taken."""

    def close(self) -> None:
        """End its thread.

        Raises:
            OSError: The system refuses to close its socket.
        """

@type_check_only
class _LiveSide:
    """Common part of live sides, with any pacing of the loop."""

    @property
    def address(self) -> str:
        """Listening address, with the chosen port."""

    @property
    def state(self) -> str:
        """State of the ladder: a name of `ladder_state_name`."""

    @property
    def kind(self) -> Literal["linear", "joints", "pose"]:
        """Kind of the coordinates of the scene's sides."""

    @property
    def ticks(self) -> int:
        """Ticks completed so far."""

    @property
    def finished(self) -> bool:
        """True if the loop has ended."""

    @property
    def is_answered(self) -> bool:
        """True if the peer has answered a frame of this side."""

    @property
    def recording(self) -> RecordingReport | None:
        """State of the recording; None without one."""

    def poll(self) -> int:
        """Return the number of ticks that the trace now holds."""

    def stop(self) -> None:
        """Request the loop to end after its current tick."""

    def security_events(self) -> list[str]:
        """Return the session events since the last call, as text."""

    def flight(self) -> str | None:
        """Last states and commands as JSON, at the last STOP or FAULT or at the end; None before."""

    @property
    def ineffective_presses(self) -> tuple[int, str | None]:
        """Return the number of clutch presses without effect, and the last reason as text; None if `cause` has it.

        Counts calls of `press_clutch` before another required step, read late, or at a device with its own button.
        Counts also a start more than 5 s before the loop. A slave returns 0.
        """

    @property
    def start_is_void(self) -> bool:
        """True if the start should press the clutch but was too long ago, and the device has no button for it."""

    def cause(self) -> str | None:
        """Reason why the two sides are not coupled, as JSON: `state`, `at`, `text` and `steps`; None if coupled.

        `at` is the place, "master", "slave" or "link"; `text` the reason, in the driver's own words if it gave any.
        `steps` are the remedies in order: `at`, `remedy` (acknowledge, start, wait, turn or press) and `text` of each.
        """

    def acknowledge(self) -> None:
        """Acknowledge that the fault of this side is repaired; then release and press the master's clutch.

        Raises:
            RuntimeError: The loop has ended or hangs.
        """

@type_check_only
class _MasterSide(_LiveSide):
    """Live side of the hand."""

    def press_clutch(self) -> None:
        """Release the clutch for 0.1 s and press it again: a command of this side's operator.

        Without effect if the loop does not read it within 0.25 s, or was late within the preceding 0.25 s.
        """

    def set_force_scale(self, scale: float) -> None:
        """Change lambda_f from the next tick; it fades within `safety.ladder.fade_in_s`.

        Raises:
            ValueError: The scale differs from the scene's by more than a factor of `coupling.change_factor` (2) with a
                closed clutch, or 100 with an open one.
            RuntimeError: The loop has ended, or hangs.
        """

    def switch_coupling(self, kind: str) -> None:
        """Release the clutch, and switch both sides to another coupling. The next press engages with it.

        Raises:
            ValueError: Unknown name, or neither the coupling of the scene nor one of `coupling.alternatives`.
            RuntimeError: The loop has ended, or hangs.
        """

    def finish(self) -> tuple[MasterTrace, LoopReport]:
        """End the loop; return its newest ticks (`keep_s`) and its report.

        Raises:
            RuntimeError: Called a second time, or the loop panicked.
        """

@type_check_only
class _SlaveSide(_LiveSide):
    """Live side of the robot."""

    def allow_takeover(self) -> None:
        """Let another master begin if the previous one has been silent for 2 s: a command of the slave's operator."""

    def set_position_scale(self, scale: float) -> None:
        """Change lambda_p from the next tick; it fades within `safety.ladder.fade_in_s`.

        The arm continues from its position.

        Raises:
            ValueError: The scale differs from the scene's by more than a factor of `coupling.change_factor` (2) with a
                closed clutch, or 100 with an open one.
            RuntimeError: The loop has ended, or hangs.
        """

    def finish(self) -> tuple[SlaveTrace, LoopReport]:
        """End the loop; return its newest ticks (`keep_s`) and its report.

        Raises:
            RuntimeError: Called a second time, or the loop panicked.
        """

@type_check_only
class _DrivenLoop:
    """Loop that a driver steps."""

    @property
    def axes(self) -> int:
        """Number of axes of a sample."""

    @property
    def is_blocked(self) -> bool:
        """True if the driver that `begin` named is in a call that has not returned for 0.5 s."""

    def begin(self, driver: str | None = None) -> str:
        """Start time, request real time for this thread, and return the settings granted.

        Args:
            driver: Driver name; a thread then monitors it. By default none does. Each turn begins with
                `take_acknowledgement`. If `read` (before `step`) or `write` (after it) does not return for 0.5 s, or
                the first `read` for 1 s, the thread ticks in its place. Both sides then have a fault that names the
                driver and the call.

        Raises:
            OSError: Required real time is refused, or no thread can be created; the loop is over.
            RuntimeError: Another thread steps it.
        """

    def wait(self) -> None:
        """Sleep until the next tick is due: for a device that does not wait in `read`.

        Raises:
            RuntimeError: Another thread steps it.
        """

    def fail(self, text: str = "") -> None:
        """Report a lost device: the fault is sent to the peer for 60 ticks, and the loop is over.

        Args:
            text: The driver's text, which both sides show: up to 239 bytes of UTF-8 on one line.

        Raises:
            RuntimeError: Another thread steps it.
        """

    def take_acknowledgement(self) -> bool:
        """Return True if the control socket acknowledged the device's fault since the last call and within 0.25 s."""

    def announce_end(self) -> None:
        """Announce to the peer within 20 ms that this side ends; the loop is over. Otherwise `finish` does it.

        Raises:
            RuntimeError: Another thread steps it.
        """

@final
class LiveMaster(_MasterSide):
    """Live side of the hand over UDP, on its own thread.

    Args:
        scene: Output of `scene_json`; its device is a model that its operator holds.
        peer: Address of the slave or a proxy before it, `HOST:PORT`.
        run_id: New random number at every start, 0 to 2⁶⁴ - 1.
        key: The 32 bytes that both sides share, of `read_key`; None with `insecure`. They are copied: a bytearray may
            then be wiped.
        insecure: True to run without a key: frames are not encrypted, and any sender can steer.
        listen: Own address, `HOST:PORT`, of the peer's kind (IPv4 or IPv6). By default the system's source address for
            the peer (loopback for a peer on this machine), with any free port.
        duration_s: Time in s from engagement to the end; by default only a stop ends it.
        patience_s: Time in s after which it ends unless the two sides have engaged; by default never.
        started_s: Time of the operator's start, by `time.monotonic()`; by default now. At the first tick it counts as a
            press of the clutch if it is at most 5 s old.
        keep_s: Time in s before the end that the trace holds, above 0 and at most 3600; its memory is allocated at the
            start. By default 16 MiB: 87 s of a master along one axis, 24 s of poses.
        realtime: "auto": requests SCHED_FIFO and locked memory, and continues without; "off": requests nothing;
            "require": fails without.
        priority: Under SCHED_FIFO, 1 to 99.
        cpu: Processor of the loop, not with `realtime` "off"; by default the kernel chooses.
        record: File for an MCAP recording of every tick (`read_recording`), by default none; an existing file is
            replaced.
        min_free_bytes: Free bytes on the disk below which the recording ends, and nothing else.
        telemetry: Path of a Unix socket that sends samples and events, see `TelemetryReader`; by default none. The loop
            waits for no reader.
        control: Path of a Unix socket that takes requests (docs/console.md): stop, press and hold, scales, aims; by
            default none. A separate thread serves it without the interpreter.

    Raises:
        ValueError: An address or `realtime` is invalid; a time is outside 0 to 1e9 s; a start is in the future; a key
            has the wrong length; key and `insecure` are both given or both missing; or the scene lacks a [slave] or a
            [coupling].
        OSError: An address or a file cannot be used, or required real time is refused.
        MemoryError: The memory for the trace, or the reserve for the end of a run, is not available.
    """

    def __new__(
        cls,
        scene: bytes,
        *,
        peer: str,
        run_id: int,
        key: bytes | bytearray | None = None,
        insecure: bool = False,
        listen: str | None = None,
        duration_s: float | None = None,
        patience_s: float | None = None,
        started_s: float | None = None,
        keep_s: float | None = None,
        realtime: str = "auto",
        priority: int = 80,
        cpu: int | None = None,
        record: str | PathLike[str] | None = None,
        min_free_bytes: int = 1000000000,
        telemetry: str | PathLike[str] | None = None,
        control: str | PathLike[str] | None = None,
    ) -> LiveMaster: ...
    @property
    def realtime(self) -> str:
        """Real-time settings granted to the loop's thread, as read back from the system."""

@final
class LiveSlave(_SlaveSide):
    """Live side of the robot over UDP, on its own thread; it learns the master's address.

    Args:
        scene: Output of `scene_json`; its arm is a model in its environment.
        listen: Own address, `HOST:PORT`; port 0 lets the system choose.

    The other arguments are those of `LiveMaster`.

    Raises:
        ValueError: An address or `realtime` is invalid; a time is outside 0 to 1e9 s; a key has the wrong length; key
            and `insecure` are both given or both missing; or the scene lacks a [slave] or a [coupling].
        OSError: An address or a file cannot be used, or required real time is refused.
        MemoryError: The memory for the trace, or the reserve for the end of a run, is not available.
    """

    def __new__(
        cls,
        scene: bytes,
        *,
        listen: str,
        run_id: int,
        key: bytes | bytearray | None = None,
        insecure: bool = False,
        duration_s: float | None = None,
        patience_s: float | None = None,
        keep_s: float | None = None,
        realtime: str = "auto",
        priority: int = 80,
        cpu: int | None = None,
        record: str | PathLike[str] | None = None,
        min_free_bytes: int = 1000000000,
        telemetry: str | PathLike[str] | None = None,
        control: str | PathLike[str] | None = None,
    ) -> LiveSlave: ...
    @property
    def realtime(self) -> str:
        """Real-time settings granted to the loop's thread, as read back from the system."""

@final
class MasterLoop(_MasterSide, _DrivenLoop):
    """Live side of the hand over UDP, stepped by a driver at each sample of its device: `begin`, `step`, `finish`.

    Args:
        scene: Output of `scene_json`; drivers replace its device and its arm.
        clutch: Clutch of a device without a button. "once": the start presses it if the device opens within 5 s,
            afterwards only `press_clutch`. "auto": also a simulated operator, 0.5 s (or its reaction) after each hold.
            The scene's operator has no effect.

    The other arguments are those of `LiveMaster`.

    Raises:
        ValueError: An address, `realtime` or `clutch` is invalid; a time is outside 0 to 1e9 s; a start is in the
            future; a key has the wrong length; key and `insecure` are both given or both missing; or the scene lacks a
            [slave] or a [coupling], or has times at which its operator presses.
        OSError: An address or a file cannot be used.
        MemoryError: The memory for the trace, or the reserve for the end of a run, is not available.
    """

    def __new__(
        cls,
        scene: bytes,
        *,
        peer: str,
        run_id: int,
        key: bytes | bytearray | None = None,
        insecure: bool = False,
        listen: str | None = None,
        clutch: Literal["once", "auto"] = "once",
        duration_s: float | None = None,
        patience_s: float | None = None,
        started_s: float | None = None,
        keep_s: float | None = None,
        realtime: str = "auto",
        priority: int = 80,
        cpu: int | None = None,
        record: str | PathLike[str] | None = None,
        min_free_bytes: int = 1000000000,
        telemetry: str | PathLike[str] | None = None,
        control: str | PathLike[str] | None = None,
    ) -> MasterLoop: ...
    def step(
        self,
        position: _Sample,
        velocity: _Sample | None = None,
        clutch: bool | None = None,
        *,
        fault: str | None = None,
        trigger: float | None = None,
        orientation: Sequence[float] | None = None,
        angular_velocity: Sequence[float] | None = None,
        buttons: int | None = None,
        time_s: float | None = None,
    ) -> tuple[Any, ...] | None:
        """Run one tick at a sample of the device.

        A number that is not finite or out of bounds causes zero force and a fault, not an exception.

        Args:
            position: x in m, a number for one axis or shape `(axes,)`.
            velocity: V in m/s, shape `(axes,)`, from a device that measures it, at every sample or at none.
            clutch: True if pressed, from a device with a button; None without one.
            fault: Fault text of the device, which both sides show: up to 239 bytes of UTF-8 on one line; None without.
            trigger: Command of the slave's gripper, 0 (open) to 1 (closed); None or another number leaves it unchanged.
            orientation: R of kind "pose", as a unit quaternion w, x, y, z; None or ignored for other kinds.
            angular_velocity: w in rad/s, shape `(3,)`, in the base frame, from a device that measures it, at every
                sample or at none.
            buttons: Bit n: button n is pressed; None if unknown, which is no release. The scene's `[master.buttons]`
                sets their functions.
            time_s: Time of the sample in s on the device's own clock, at every sample or at none; None without a
                clock. It never decreases.

        Returns:
            F_device in N, shape `(axes,)`, for kind "pose" also the torque in N m, shape `(3,)` each; None if the run
            is over.

        Raises:
            TypeError: A sample is no number, has a wrong number of axes, lacks an orientation of kind "pose", or has a
                field that only some samples have; the tick did not run.
            ValueError: `time_s` is not finite or decreases; the tick did not run.
            RuntimeError: Another thread steps it.
        """

    @property
    def trigger_force(self) -> float | None:
        """F_device in N at the trigger after the last tick, positive closing; None without `[master.gripper]`."""

@final
class SlaveLoop(_SlaveSide, _DrivenLoop):
    """Live side of the robot over UDP, stepped by a driver at each sample of its arm: `begin`, `step`, `finish`.

    Args:
        scene: Output of `scene_json`; drivers replace its device and its arm.
        listen: Own address, `HOST:PORT`; port 0 lets the system choose.

    The other arguments are those of `LiveMaster`.

    Raises:
        ValueError: An address or `realtime` is invalid; a time is outside 0 to 1e9 s; a key has the wrong length; key
            and `insecure` are both given or both missing; or the scene lacks a [slave] or a [coupling].
        OSError: An address or a file cannot be used.
        MemoryError: The memory for the trace, or the reserve for the end of a run, is not available.
    """

    def __new__(
        cls,
        scene: bytes,
        *,
        listen: str,
        run_id: int,
        key: bytes | bytearray | None = None,
        insecure: bool = False,
        duration_s: float | None = None,
        patience_s: float | None = None,
        keep_s: float | None = None,
        realtime: str = "auto",
        priority: int = 80,
        cpu: int | None = None,
        record: str | PathLike[str] | None = None,
        min_free_bytes: int = 1000000000,
        telemetry: str | PathLike[str] | None = None,
        control: str | PathLike[str] | None = None,
    ) -> SlaveLoop: ...
    def step(
        self,
        position: _Sample,
        velocity: _Sample,
        force: _Sample,
        *,
        fault: str | None = None,
        gripper: tuple[float, float, float, bool] | None = None,
        orientation: Sequence[float] | None = None,
        angular_velocity: Sequence[float] | None = None,
        torque: Sequence[float] | None = None,
        time_s: float | None = None,
    ) -> tuple[Any, ...] | None:
        """Run one tick at a sample of the arm.

        A number that is not finite or out of bounds causes a stop and a fault, not an exception.

        Args:
            position: Tool position in m, a number for one axis or shape `(axes,)`.
            velocity: Tool velocity in m/s, shape `(axes,)`.
            force: F_e in N, shape `(axes,)`.
            fault: Fault text of the arm, which both sides show: up to 239 bytes of UTF-8 on one line; None without.
            gripper: Position, 0 (open) to 1 (closed), velocity in 1/s, force in N, and True if it holds an object; None
                without `[slave.gripper]`. Invalid numbers are sent as unknown.
            orientation: R of kind "pose", as a unit quaternion w, x, y, z; None or ignored for other kinds.
            angular_velocity: w in rad/s, shape `(3,)`, in the base frame; only for kind "pose".
            torque: Environment torque on the tool in N m, shape `(3,)`, in the base frame about the tool point; only
                for kind "pose".
            time_s: Time of the sample in s on the arm's own clock, at every sample or at none; None without a
                clock. It never decreases.

        Returns:
            "wait", "move" or "stop", and the commanded position in m and velocity in m/s, shape `(axes,)` each, both
            empty except for "move". For kind "pose" a move also has the orientation and the angular velocity. Or, for an
            arm that takes forces, "exert", the force in N, shape `(axes,)`, and for kind "pose" the torque in N m. None
            if the run is over. An arm without commands is brought to rest with constant deceleration,
            `slave.max_acceleration` of the scene or 5 m/s², and 25 rad/s².

        Raises:
            TypeError: A sample is no number, has a wrong number of axes, has `time_s` unlike earlier samples, or for kind
                "pose" lacks orientation, angular velocity or torque; the tick did not run.
            ValueError: `time_s` is not finite or decreases; the tick did not run.
            RuntimeError: Another thread steps it.
        """

    @property
    def buttons(self) -> int | None:
        """Master's buttons in its newest frame at the last tick: bit n is set while button n is pressed.

        None for a scene without buttons.
        """

    @property
    def gripper_command(self) -> tuple[float, float, float] | None:
        """Position, 0 (open) to 1 (closed), speed in 1/s and force in N after the last tick; None keeps the grip."""

@final
class CouplingFacts:
    """Facts of a coupling, by its own halves; `coupling_facts` makes it. position-force has only `push_may_grow`."""

    @property
    def stiffness(self) -> float | None:
        """K in N/m."""
    @property
    def damping(self) -> float | None:
        """B in N s/m."""
    @property
    def master(self) -> list[float] | None:
        """Coefficients of F_m in x_m, v_m, x_s', v_s', F_c' (N/m, N s/m, and 1 for a force); None if not linear in them."""
    @property
    def slave(self) -> list[float] | None:
        """Coefficients of F_c in x_s, v_s, x_m', v_m'; None if not linear in them."""
    @property
    def impedance(self) -> float | None:
        """b in N s/m of waves, d0 of the master's port, or d at each side; None if the coupling has none."""
    @property
    def start_energy_j(self) -> float | None:
        """E_0 in J of each side at the engagement; None for a coupling that keeps no ledger of energy."""
    @property
    def least_damping(self) -> float | None:
        """Least B in N s/m with which it is passive; None if it claims no passivity."""
    @property
    def compliance(self) -> float | None:
        """C in m/N in series between hand and tool at rest; None for position-force, whose arm stands for it."""
    @property
    def keeps_ledger(self) -> bool:
        """True if both sides count their energy, so that any delay, jitter and loss create none."""
    @property
    def push_may_grow(self) -> bool:
        """True if the push on a released stylus may grow."""

def coupling_facts(
    name: str,
    *,
    stiffness: float | None = None,
    damping: float | None = None,
    impedance: float | None = None,
    spread_s: float | None = None,
    round_trip_s: float = 0.0,
    period_s: float = 1e-3,
) -> CouplingFacts:
    """Facts of a coupling.

    Args:
        name: Name in `COUPLINGS`.
        stiffness: K in N/m; by default that of the coupling.
        damping: B in N s/m; by default that of the coupling.
        impedance: b, d0 or d in N s/m; by default that of the coupling.
        spread_s: Time in s over which waves are spread; by default that of the coupling.
        round_trip_s: Round trip T1 + T2 in s, for the least damping and the compliance.
        period_s: Tick in s, for the same.

    Raises:
        ValueError: Unknown name, or a number out of range.
    """

def ladder_reason(code: int) -> str:
    """Return the reason of the ladder's state, for the codes of `MasterTrace.reason` from 1; 0 means no step yet.

    Raises:
        ValueError: The code is invalid.
        OverflowError: The code is outside 0 to 255.
    """

def ladder_state_name(code: int) -> str:
    """Return the name of a ladder state: 0 disengaged, 1 aligning, 2 engaged, 3 stale, 4 hold, 5 stop, 6 fault.

    Raises:
        ValueError: The code is invalid.
        OverflowError: The code is outside 0 to 255.
    """

# ------------------------------------------------------------------------------------------- dynamixel

@final
class SyncRead:
    """Read of the same addresses of several servos; their values arrive together or not at all.

    Args:
        address: First address.
        length: Bytes per servo.
        ids: Servos in the order of their values, without repetition.
        fast: True for one common packet, which needs newer firmware; False for one packet each.

    Raises:
        ValueError: The request does not fit into a packet.
    """

    def __new__(cls, address: int, length: int, ids: Sequence[int], *, fast: bool = True) -> SyncRead: ...
    @property
    def alerts(self) -> tuple[int, ...]:
        """Servos that reported a hardware error in the last read; their values are valid."""

@final
class DynamixelBus:
    """Servos on one serial port, with Protocol 2.0 in Rust; calls of several threads run one after the other.

    An answer must arrive within `timeout_s` beyond its transmission time. Before the first instruction, and after a
    failed one, the line must be silent for that time. A late answer thus never counts as a new one. After eight times
    that the call fails. A call that waits while another thread calls `stop` ends within a few ms with `RuntimeError`.

    Args:
        port: Path of the serial port.
        baud: Rate in bit/s, 1200 to 10 000 000.
        timeout_s: 0.001 to 10 s.

    Raises:
        ValueError: A rate or a timeout is outside its range.
        OSError: The port cannot be opened, or another process uses it.
    """

    BROADCAST: ClassVar[int]
    """Id that every servo accepts and none answers."""

    def __new__(cls, port: str, *, baud: int, timeout_s: float = 0.02) -> DynamixelBus: ...
    def ping(self, servo_id: int) -> tuple[int, int]:
        """Return model number and firmware version.

        Raises:
            TimeoutError: No answer.
            OSError: The port is gone.
            RuntimeError: A wrong or negative answer, or another thread has called `stop`.
            ValueError: The bus is closed.
        """

    def read(self, servo_id: int, address: int, length: int) -> bytes:
        """Read `length` bytes from an address.

        Raises:
            TimeoutError, OSError, RuntimeError, ValueError: As `ping`.
        """

    def write(self, servo_id: int, address: int, written: bytes) -> bool:
        """Write bytes from an address; return True if the servo has a hardware error. `BROADCAST` gets no answer.

        Raises:
            TimeoutError, OSError, RuntimeError, ValueError: As `ping`, or the bytes do not fit into a packet.
        """

    def reboot(self, servo_id: int) -> None:
        """Restart a servo, which is then silent for a while.

        Raises:
            TimeoutError, OSError, RuntimeError, ValueError: As `ping`.
        """

    def sync_read(self, read: SyncRead) -> bytes:
        """Return the bytes of all servos, one after the other.

        Raises:
            TimeoutError, OSError, RuntimeError, ValueError: As `ping`.
        """

    def sync_write(self, address: int, length: int, ids: bytes, written: bytes) -> None:
        """Write `length` bytes of each servo; none answers, so a refusal is not detected.

        Args:
            address: First address.
            length: Bytes per servo.
            ids: Ids of the servos, a byte each.
            written: Bytes of all servos, in the order of `ids`.

        Raises:
            ValueError: The bytes do not fit the ids, or the bus is closed.
            OSError, RuntimeError: As `ping`.
        """

    def stop(self, address: int, length: int, ids: bytes, written: bytes) -> None:
        """Write `length` bytes of each servo, regardless of the line and other threads.

        It is sent three times. The first is sent at once, or after the few ms in which a call of another thread ends.
        Each other one follows after the remaining time of an answer that it may have collided with, at most
        `timeout_s`.

        The arguments are those of `sync_write`.

        Raises:
            ValueError: The bytes do not fit the ids, or the bus is closed.
            OSError: None of them could be sent.
        """

    def close(self) -> None:
        """Release the port; any other call then raises `ValueError`."""

# -------------------------------------------------------------------------------------------- OpenHaptics

@final
class HdCallback:
    """Callback of the OpenHaptics scheduler: one frame of a device, in Rust and without the interpreter's lock.

    It exerts the newest force. The force is zero before the first one, if it is older than the watchdog's time, after
    an error until its acknowledgement, and in the last frame. Its memory is never freed.

    Args:
        functions: Addresses of hdMakeCurrentDevice, hdBeginFrame, hdEndFrame, hdGetDoublev, hdGetIntegerv,
            hdSetDoublev, hdGetError and hdCheckCalibration, in this order; any others end the process.
        device: Its handle.
        watchdog_s: 0.001 to 0.1 s.
        max_force_n: Bound in N, above 0, to which a larger |F| is scaled down.

    Raises:
        ValueError: An address is 0, or a number is outside its range.
    """

    def __new__(cls, functions: Sequence[int], device: int, *, watchdog_s: float, max_force_n: float) -> HdCallback: ...
    @property
    def address(self) -> int:
        """Address of the callback for hdScheduleAsynchronous."""

    @property
    def context(self) -> int:
        """Argument of the callback."""

    @property
    def starved(self) -> int:
        """Frames without force because the newest one was too old."""

    def write(self, force: Sequence[float]) -> None:
        """Set the force in N, shape `(3,)`, from the next frame, in the vendor's frame."""

    def wait(self, after: int, limit_s: float) -> tuple[int, list[float], list[float], int, int, int, int] | None:
        """Return the newest sample after a frame as soon as it exists; None after the time limit in s.

        Returns:
            Number of the frame, transform (column by column, mm), velocity (mm/s), buttons, result of
            hdCheckCalibration, the first error since the last acknowledgement and its internal code.

        Raises:
            ValueError: The limit is outside 0 to 10 s.
        """

    def acknowledge(self) -> None:
        """Forget the first error."""

    def end(self, limit_s: float) -> bool:
        """Make the next frame the last one, with zero force; return True if it ran within the time in s.

        Raises:
            ValueError: The limit is outside 0 to 10 s.
        """

# ---------------------------------------------------------------------------------------------- scenes

@final
class SceneRun:
    """Results of `simulate_scene`."""

    @property
    def signals(self) -> dict[str, npt.NDArray[Any]]:
        """Recorded signals by name, each with the first axis of `time_s`; empty without a recording.

        Signals with a value per axis have the shape `(n, axes)`, for one axis `(n,)`.
        """

    @property
    def events(self) -> list[tuple[float, str, str]]:
        """Events in the order of time: time in s, kind, detail."""

    @property
    def metrics(self) -> dict[str, float | int | bool | str | None]:
        """Metrics of the run, by name; None if not applicable or not measured."""

    @property
    def reports(self) -> tuple[LoopReport, LoopReport] | None:
        """Reports of the loops of master and slave; None without an arm."""

@type_check_only
class _ResearchFactory(Protocol):
    """Creates the Python controllers of a run or a sweep."""

    def make(self, name: str, options: str, axes: int, period_s: float) -> object: ...
    def spent(self, ticks: int, seconds: float) -> None: ...

def simulate_scene(
    scene_json: bytes,
    record: tuple[str | PathLike[str], str | PathLike[str]] | None = None,
    research: _ResearchFactory | None = None,
) -> SceneRun:
    """Run a scene in virtual time, without the interpreter's lock except for a Python controller.

    Args:
        scene_json: The scene as `haptether.bridge.scene_json` writes it: every field, nothing else.
        record: MCAP files as `--record` of master and slave would write them; by default none.
        research: Creates the controller of a scene with `[safety.research]`, which is refused without it; by default
            none.

    Raises:
        ValueError: The JSON is not a scene, a number is invalid for a part of it, or a file cannot be written.
        RuntimeError: The Python controller has raised; its exception is the cause.
    """

@final
class RecordingColumns:
    """Contents of a recording."""

    @property
    def about(self) -> dict[str, str]:
        """Header of the file: schema, side, security, version, scene; empty if it is no recording."""
    @property
    def meanings(self) -> dict[str, str]:
        """Meaning of each signal, with its unit."""
    @property
    def columns(self) -> dict[str, npt.NDArray[Any] | tuple[list[str], npt.NDArray[np.uint8]]]:
        """One value per tick; signals with axes have the shape `(n_ticks, axes)`. Null is NaN.

        A signal of names has the list of names, and the index into it at each tick.
        """
    @property
    def causes(self) -> list[bytes]:
        """Reasons why the two sides were not coupled, as JSON, in the order of the file."""
    @property
    def begun_ns(self) -> int:
        """Start of the run in ns of the wall clock; 0 without a tick."""
    @property
    def whole(self) -> bool:
        """True if the file was read to its end."""
    @property
    def invalid(self) -> int:
        """Invalid records, of ticks or others, which were skipped."""
    @property
    def damaged(self) -> bool:
        """True if reading ended at invalid bytes, before the end of the file."""

def read_recording_columns(path: str | PathLike[str]) -> RecordingColumns:
    """Read an MCAP file of `record=` up to its last valid record, without the interpreter's lock.

    Invalid messages are skipped: no JSON, a signal with a new kind or number of axes, a count beyond 64 bits, a time
    that is negative or not increasing. Memory is bounded by a multiple of the bytes read.

    Raises:
        OSError: The file cannot be read.
        ValueError: The chunks of the recording are compressed.
    """

def replay_recording(
    scene_json: bytes,
    signals: dict[str, npt.NDArray[Any]],
    times_ns: list[int],
    *,
    recouples: bool,
    hand: tuple[float, float, float] | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Step the side of a hand through its recorded signals.

    Args:
        scene_json: The scene with the settings, as for `simulate_scene`.
        signals: Signals at each tick, by the names of a recording; `past` is 0 kept, 1 stalled, 2 acknowledged; `grip`
            is True while the hand holds the device.
        times_ns: Times of the ticks since the start of the run, in ns.
        recouples: True if the coupling computes its request again from the received force.
        hand: M in kg, B in N s/m and K in N/m of a hand that responds to a force not in the recording; None to keep the
            recorded motion.

    Raises:
        ValueError: The scene cannot be built, or a signal is missing or has a wrong length.
    """

def sweep_scenes(
    parts: list[tuple[bytes, list[tuple[str, _Array]]]],
    threads: int,
    lanes: bool,
    progress: Callable[[int], None] | None,
    research: _ResearchFactory | None = None,
    metrics: list[str] | None = None,
) -> list[dict[str, npt.NDArray[Any]]]:
    """Run each scene once per row of its own, without the interpreter's lock; threads and lanes change no number.

    Rows that differ only in their controllers, of one scene or several, share one run until a controller intervenes;
    this changes no number either. With a Python controller there is one thread, and nothing is shared.

    Args:
        parts: Scenes as for `simulate_scene`, each with the numbers that differ between its rows: by their dotted path
            in the JSON ("operator.legs.0.end.0"), with one value per row; whole numbers for fields that count.
        threads: Number of threads, 1 or more.
        lanes: True if rows may advance side by side in one thread.
        progress: Called from time to time with the number of completed rows; an exception from it ends the sweep.
        research: Creates the controllers of a scene with `[safety.research]`, one per row; without it each row is
            refused.
        metrics: Names of the metrics to measure, of `METRICS`; by default all, those of rotation for poses only.

    Returns:
        For each scene, by name and with one value per row: the outcome, the metrics, and the reason of a refused or
            diverged row. NaN if a metric does not apply or was not measured.

    Raises:
        ValueError: A metric or a path does not exist, JSON is not a scene, or columns have different lengths.
        RuntimeError: A Python controller has raised; its exception is the cause.
    """
