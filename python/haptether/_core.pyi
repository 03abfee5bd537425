"""The compiled part of Haptether. Import its names from the rooms: `haptether.safety`, `haptether.bridge`, ...

Units are SI, angles in rad; a positive force pushes the device along +x. Arrays over ticks have the
shape `(n_ticks, axes)`, for one axis also `(n_ticks,)`, and must hold float64; results have the shape
of the first argument, and one number per tick the shape `(n_ticks,)`. Strides do not matter. One sample
is a float for one axis, else a sequence of `axes` floats; it comes back as an array of shape `(axes,)`.
Devices have 1 to 7 axes.

What every call refuses: another shape, length or range with `ValueError`, which says what was seen and
what is allowed; another type, an array of another dtype among them, with `TypeError`; a negative
count or seed with `OverflowError`.

"Paper" in a `Source:` is "Safety Control for Impedance Haptic Interfaces".
"""

from collections.abc import Callable, Sequence
from os import PathLike
from typing import Any, ClassVar, Literal, Protocol, TypeAlias, final, overload, type_check_only

import numpy as np
import numpy.typing as npt

from haptether.safety import ControllerName

__all__ = [
    "CONTROLLERS",
    "ESTIMATORS",
    "LADDER_STATES",
    "METRICS",
    "OBSERVED",
    "OBSERVERS",
    "PRESS_S",
    "ROUND_TRIP_S",
    "TRIP_BITS",
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
"""What a run measures, by name, in the order of tables."""
PRESS_S: float
"""For how long in s a press of the clutch counts, and waits in ALIGNING."""
ROUND_TRIP_S: float
"""What of `PRESS_S` a press takes over the slowest link, besides a turn: 500 ms each way."""
CONTROLLERS: tuple[tuple[str, str, str], ...]
"""Name, title and source of each safety controller, in the order of the bits of `tripped`."""
TRIP_BITS: tuple[tuple[str, int], ...]
"""Controllers by their name, and "held", with the bit of each in `tripped`."""
OBSERVED: tuple[tuple[str, str, str], ...]
"""Of each controller: its name, the signal of its observer, and the symbol of that with its unit."""
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
        ValueError: A parameter outside its range, values of another number than `axes`, or no such `axes`.

    Source: paper Eq. 3.
    """

    def __new__(
        cls,
        *,
        mass_kg: _Sample,
        viscous: _Sample = ...,
        coulomb: _Sample = ...,
        axes: int = 1,
    ) -> DeviceModel: ...
    @staticmethod
    def phantom_desktop(axes: int = 1) -> DeviceModel:
        """The paper's PHANTOM Desktop: m = 0.157 kg, b = -0.005 N s/m, c = 0.038 N on each axis.

        Raises:
            ValueError: No such `axes`.

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

        The paper subtracts F_v. F_device is all the force that the device was commanded to exert, F_v + F_c: with
        F_v alone the controller's own force would look like a hand.

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
    """An estimator of velocity and acceleration with its parameters; without arguments the default.

    The default is `kalman(jerk_density=10.0, quantum_m=2.3e-5)`, for a stylus at 1 kHz: 39 Hz of
    bandwidth. Numbers are held against their ranges where an `Estimator` is built.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(cls) -> EstimatorKind: ...
    def __eq__(self, other: object, /) -> bool: ...
    @staticmethod
    def backward_difference() -> EstimatorKind:
        """Differences: `V[n] = (x[n] - x[n-1]) / dT`, `A[n] = (V[n] - V[n-1]) / dT`.

        A is the mean of the last two ticks. The estimator with the smallest lag; a position quantum q shows in A as
        q / dT².
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
            noise_bound_m: d in m (rad for joints), above 0; the encoder's quantum is a good start.
            max_window: Longest window in ticks, 1 to 128.
            fit: "end" takes the chord of the window, "best" its least-squares slope.

        Raises:
            ValueError: No such `fit`.

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
        """V of a quick Kalman filter, A of a calm one: less lag of V at the same noise of the grasp force.

        Args:
            velocity_jerk_density: q_v in m²/s⁵ (rad²/s⁵ for joints), above 0, of V.
            jerk_density: q in the same unit, above 0, of A.
            quantum_m: Quantum of the encoder in m (rad for joints), above 0.

        Source: Bar-Shalom, Li and Kirubarajan 2001, section 6.2.3; `docs/ejection_bound.md`, Eq. 5.
        """

@final
class Estimator:
    """V and A of a device from its sampled position; keeps its state from call to call.

    It takes the device to have rested at the first position it is given.

    Args:
        kind: Which estimator; without it the default of `EstimatorKind`.
        period_s: dT in s, above 0.
        axes: 1 to 7.

    Raises:
        ValueError: A parameter of `kind` or `period_s` outside its range, or no such `axes`.
    """

    def __new__(cls, kind: EstimatorKind | None = None, *, period_s: float = 1e-3, axes: int = 1) -> Estimator: ...
    @property
    def axes(self) -> int:
        """Number of axes."""

    def step(self, position: _Sample) -> tuple[_Array, _Array]:
        """Takes one position.

        Args:
            position: x in m.

        Returns:
            V in m/s and A in m/s², each of shape `(axes,)`.

        Raises:
            ValueError: A position that is not finite or exceeds 1000 m; the state stays as it was.
        """

    def align(self, device_force: _Sample) -> _Array:
        """Passes F_device[n-1] through the kernel that stands between the true acceleration and A[n].

        Call it after each `step` or never: it remembers past forces.

        Args:
            device_force: Force in N held over the tick that ended with the newest position.

        Returns:
            The force in N that Eq. 4 may subtract from m A, shape `(axes,)`.

        Raises:
            ValueError: A force that is not finite or exceeds 10000 N; the state stays as it was.

        Source: paper Eq. 4.
        """

    @overload
    def run(self, position: _Array, device_force: None = None) -> tuple[_Array, _Array, None]: ...
    @overload
    def run(self, position: _Array, device_force: _Array) -> tuple[_Array, _Array, _Array]:
        """As `step`, and `align` where forces are given, over arrays.

        Args:
            position: x in m, shape `(n_ticks, axes)`.
            device_force: F_device in N held before each position, the same shape.

        Returns:
            V in m/s, A in m/s² and the aligned force in N (none without `device_force`), each of shape
            `(n_ticks, axes)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.
                The ticks before it have been taken.
        """

@final
class VelocityForceObserver:
    """VFO: the device pushes the hand, and the hand moves along with the push.

    "product" is Eq. 1 as printed, `S_vf = V·F_v / (V_t F_t)`; "both" is what the paper's text says,
    `S_vf = min(V/V_t, |F_v|/F_t)` with V the speed along F_v. Above 1 is unsafe.

    Args:
        velocity_threshold: V_t in m/s, above 0.
        force_threshold_n: F_t in N, above 0.
        form: Which reading of Eq. 1.
        axes: 1 to 7.

    Raises:
        ValueError: A threshold outside its range, no such `form` or no such `axes`.

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
        """S_vf of one tick, without unit.

        Args:
            velocity: V in m/s.
            rendered_force: F_v in N.
            grasp_force: F_h in N; checked, not used.

        Raises:
            ValueError: A number that is not finite or absurd, or another number of axes.

        Source: paper Eq. 1.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """As `step`, over arrays of shape `(n_ticks, axes)`; S_vf of shape `(n_ticks,)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.

        Source: paper Eq. 1.
        """

@final
class HandGraspObserver:
    """HGO: near 1 while the hand holds against the rendered force, large when nobody holds.

    `S_h = |F_v| / (|F_h| + alpha)`

    Args:
        grasp_floor_n: alpha in N, above 0.
        axes: 1 to 7.

    Raises:
        ValueError: alpha outside its range or no such `axes`.

    Source: paper Eq. 5.
    """

    def __new__(cls, *, grasp_floor_n: float = 1e-3, axes: int = 1) -> HandGraspObserver: ...
    def step(self, velocity: _Sample, rendered_force: _Sample, grasp_force: _Sample) -> float:
        """S_h of one tick, without unit; safe up to zeta.

        Args:
            velocity: V in m/s; checked, not used.
            rendered_force: F_v in N.
            grasp_force: F_h in N.

        Raises:
            ValueError: A number that is not finite or absurd, or another number of axes.

        Source: paper Eq. 5.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """As `step`, over arrays of shape `(n_ticks, axes)`; S_h of shape `(n_ticks,)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.

        Source: paper Eq. 5.
        """

@final
class SafetyObserver:
    """SO: energy that the hand has put in since the start, less what a safe device would move with.

    `E_so(n) = dT sum_{i=1..n} F_h(i)·V(i) - V(n)' M V(n) / (2 eta)`

    It keeps all energy, so a long press hides a later ejection.

    Args:
        device: M, and the number of axes.
        period_s: dT in s, above 0.
        energy_ratio: eta, above 0 and at most 1.

    Raises:
        ValueError: A parameter outside its range.

    Source: paper Eq. 9.
    """

    def __new__(cls, device: DeviceModel, *, period_s: float = 1e-3, energy_ratio: float = 0.5) -> SafetyObserver: ...
    def step(self, velocity: _Sample, rendered_force: _Sample, grasp_force: _Sample) -> float:
        """E_so in J after one tick.

        Args:
            velocity: V in m/s.
            rendered_force: F_v in N; checked, not used.
            grasp_force: F_h in N.

        Raises:
            ValueError: A number that is not finite or absurd, or another number of axes; the state stays
                as it was.

        Source: paper Eq. 9.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """As `step`, over arrays of shape `(n_ticks, axes)`; E_so in J of shape `(n_ticks,)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.
                The ticks before it have been taken.

        Source: paper Eq. 9.
        """

    def reset(self) -> None:
        """Clears all energy."""

@final
class WindowedSafetyObserver:
    """WSO: SO over the last w ticks only, so that energy from long ago hides nothing.

    `E_wso(n) = dT sum_{i=max(1, n-w+1)..n} F_h(i)·V(i) - V(n)' M V(n) / (2 eta)`

    Args:
        device: M, and the number of axes.
        period_s: dT in s, above 0.
        energy_ratio: eta, above 0 and at most 1.
        window: w in ticks, 1 to 3600000.

    Raises:
        ValueError: A parameter outside its range.

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
        """E_wso in J after one tick.

        Args:
            velocity: V in m/s.
            rendered_force: F_v in N; checked, not used.
            grasp_force: F_h in N.

        Raises:
            ValueError: A number that is not finite or absurd, or another number of axes; the state stays
                as it was.

        Source: paper Eq. 11.
        """

    def run(self, velocity: _Array, rendered_force: _Array, grasp_force: _Array) -> _Array:
        """As `step`, over arrays of shape `(n_ticks, axes)`; E_wso in J of shape `(n_ticks,)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.
                The ticks before it have been taken.

        Source: paper Eq. 11.
        """

    def reset(self) -> None:
        """Clears all energy."""

@final
class PassivityObserver:
    """PO: energy that has flowed from the hand's side into what renders the force.

    `E(n) = - sum_{k<n} F_device(k)·(x(k+1) - x(k))`; negative: the environment has given out more than
    it took. Force times displacement is the exact work of a force that is held over a tick.

    Args:
        axes: 1 to 7.

    Raises:
        ValueError: No such `axes`.

    Source: Hannaford and Ryu 2002, Eq. 5; Stramigioli et al. 2005 (sampled energy).
    """

    def __new__(cls, *, axes: int = 1) -> PassivityObserver: ...
    def step(self, position: _Sample, held_force: _Sample) -> float:
        """E in J at one position.

        Args:
            position: x in m.
            held_force: F_device in N exerted since the last position; not used at the first.

        Raises:
            ValueError: A number that is not finite or absurd, or another number of axes; the state stays
                as it was.

        Source: Hannaford and Ryu 2002, Eq. 5.
        """

    def run(self, position: _Array, held_force: _Array) -> _Array:
        """As `step`, over arrays of shape `(n_ticks, axes)`; E in J of shape `(n_ticks,)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.
                The ticks before it have been taken.

        Source: Hannaford and Ryu 2002, Eq. 5.
        """

    def reset(self) -> None:
        """Clears all energy and the last position."""

@final
class SafetySettings:
    """Which controllers watch, their thresholds, and how an intervention begins and ends.

    The defaults are the paper's. Numbers are held against their ranges where a controller is built.

    Attributes:
        FRICTION_ROOM: Of c, what `probe_force_n` times `probe_threshold` must reach.
        PROBED_DAMPING: Of mu, what damps while a probe acts.

    Args:
        controllers: Any of "vfc" (Eq. 2), "hsc" (Eq. 14), "wsc" (Eq. 13), "pc" (Eq. 12).
        damping: mu in N s/m, between 0 and m / (5 dT).
        velocity_threshold: V_t in m/s, above 0 (Eq. 1).
        vfc_force_threshold_n: F_t in N, above 0 (Eq. 1).
        vfc_form: Which reading of Eq. 1, see `VelocityForceObserver`.
        grasp_threshold: zeta, above 1 (Eq. 8).
        grasp_floor_n: alpha in N, above 0 (Eq. 5).
        hsc_force_threshold_n: F_t in N, 0 or more (Eq. 14).
        hsc_velocity_threshold: V_s in m/s, 0 or more: HSC trips only while `V·F_v / |F_v| > V_s`; 0 is Eq. 14 as printed.
        energy_threshold_j: delta in J, below 0, by default -0.03 (Eq. 10).
        wsc_force_threshold_n: F_w in N, 0 or more: WSC trips only while `F_v·V / |V| > F_w`; 0 is Eq. 13 as printed.
        energy_ratio: eta, above 0 and at most 1 (Eq. 9).
        window: w in ticks, 1 to 3600000 (Eq. 11).
        pc_max_damping: Bound in N s/m on the damping of Eq. 12, between 0 and m / (5 dT).
        hold_off_s: Least duration of an intervention in s, 0 to 60.
        release_ramp_s: Least time in s over which an intervention fades out, 0 to 60.
        probe_force_n: A in N of the probe that a hand must answer before an intervention fades, at least 2 c / r_th; 0
            lets it fade by time alone.
        probe_threshold: r_th, the share of the probe that a hand holds against at least, above 0 and below 1.
        release_tries: After so many tries, of a second each, without the force being back for 1 s it is withheld; 0 is
            no end, and without a probe asks for no hand.

    Raises:
        ValueError: No such controller or `vfc_form`.

    Source: paper section 4 (thresholds).
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    FRICTION_ROOM: ClassVar[float]
    PROBED_DAMPING: ClassVar[float]

    def __new__(
        cls,
        controllers: Sequence[ControllerName] = ...,
        *,
        damping: float = 5.0,
        velocity_threshold: float = 0.6,
        vfc_force_threshold_n: float = 1.0,
        vfc_form: Literal["product", "both"] = "product",
        grasp_threshold: float = 1.5,
        grasp_floor_n: float = 1e-3,
        hsc_force_threshold_n: float = 0.1,
        hsc_velocity_threshold: float = 0.0,
        energy_threshold_j: float = ...,
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
    def __eq__(self, other: object, /) -> bool: ...

@final
class SafetyController:
    """Controllers combined: while one of VFC, HSC, WSC trips, `F_c = -F_v - mu V`, else 0.

    It stays on for the hold-off, then fades over the release ramp. PC, in the share that the fade leaves, dissipates
    what SO finds missing: `F_c = E_so V / (|V|² dT)` for E_so < 0, never more than `pc_max_damping` V.
    Keeps its state from call to call.

    Args:
        device: M, and the number of axes.
        settings: Controllers and thresholds.
        period_s: dT in s, above 0.

    Raises:
        ValueError: A parameter outside its range, with its symbol in the paper.

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
        """F_c of one tick.

        A number that is not finite or absurd is no error here: it returns a fault and zero force, and
        changes no state.

        Args:
            velocity: V in m/s.
            rendered_force: F_v in N.
            grasp_force: F_h in N.
            aligned_rendered_force: F_v in N as late as F_h (`Estimator.align`); F_v itself if not given.

        Raises:
            ValueError: Another number of axes.

        Source: paper Eq. 2, 12, 13 and 14.
        """

    def run(
        self,
        velocity: _Array,
        rendered_force: _Array,
        grasp_force: _Array,
        aligned_rendered_force: _Array | None = None,
    ) -> Interventions:
        """As `step`, over arrays.

        Args:
            velocity: V in m/s, shape `(n_ticks, axes)`.
            rendered_force: F_v in N, the same shape.
            grasp_force: F_h in N, the same shape.
            aligned_rendered_force: F_v in N passed through the kernel that made F_h late (`Estimator.run`), the
                same shape; F_v itself if not given. S_h compares it with F_h.

        Raises:
            ValueError: Another shape or length.

        Source: paper Eq. 2, 12, 13 and 14.
        """

    def reset(self) -> None:
        """Clears all energy and ends any intervention."""

@final
class Intervention:
    """What `SafetyController.step` decided at one tick, and what it saw."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(axes,)`."""

    @property
    def device_force(self) -> _Array:
        """F_v + F_c in N, before any limiter, shape `(axes,)`; zero at a fault."""

    @property
    def tripped(self) -> int:
        """Who tripped: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while an intervention is only held."""

    @property
    def fault(self) -> int:
        """Code for `fault_message`, 0 without fault."""

    @property
    def velocity_force(self) -> float:
        """S_vf; NaN without VFC or at a fault."""

    @property
    def grasp(self) -> float:
        """S_h; NaN without HSC or at a fault."""

    @property
    def windowed_energy_j(self) -> float:
        """E_wso in J; NaN without WSC or at a fault."""

    @property
    def energy_j(self) -> float:
        """E_so in J; NaN without PC or at a fault."""

@final
class Interventions:
    """What `SafetyController.run` decided at each tick, and what it saw.

    An observer that no controller reads is not computed: its array is none.
    """

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(n_ticks, axes)`."""

    @property
    def device_force(self) -> _Array:
        """F_v + F_c in N, before any limiter, shape `(n_ticks, axes)`; zero at a fault."""

    @property
    def tripped(self) -> _Bits:
        """Who tripped, shape `(n_ticks,)`: VFC 1, HSC 2, WSC 4, PC 8; 16 while only held."""

    @property
    def fault(self) -> _Bits:
        """Codes for `fault_message`, 0 without fault, shape `(n_ticks,)`."""

    @property
    def velocity_force(self) -> _Array | None:
        """S_vf, shape `(n_ticks,)`; NaN at a fault, none without VFC."""

    @property
    def grasp(self) -> _Array | None:
        """S_h, shape `(n_ticks,)`; NaN at a fault, none without HSC."""

    @property
    def windowed_energy_j(self) -> _Array | None:
        """E_wso in J, shape `(n_ticks,)`; NaN at a fault, none without WSC."""

    @property
    def energy_j(self) -> _Array | None:
        """E_so in J, shape `(n_ticks,)`; NaN at a fault, none without PC."""

@final
class LimiterSettings:
    """Bounds on the force that a device is commanded to exert; checked where a limiter is built.

    Args:
        max_force_n: Largest |F| in N, above 0; a PHANTOM Desktop exerts 7.9 N.
        max_slew_n_per_s: Largest growth of the force in N/s, above 0; unloading is free.
        max_power_w: Largest F·V in W that the device may put into the hand, above 0.
        ramp_in_s: Time in s in which the force rises from zero after a reset, 0 to 60.
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
    """Keeps the device force inside its bounds, as a vector: no axis is clipped on its own.

    In this order: the ramp-in scales, |F| is clipped, the step from the last force is limited beyond the
    part that only unloads, and the part along V is reduced until `F·V <= P_max`. |F| and power hold at
    every tick; the growth is exceeded only by what the power bound takes away.

    Args:
        settings: Bounds; without them the defaults of `LimiterSettings`.
        period_s: dT in s, above 0.
        axes: 1 to 7.

    Raises:
        ValueError: A bound or `period_s` outside its range, or no such `axes`.
    """

    def __new__(cls, settings: LimiterSettings | None = None, *, period_s: float = 1e-3, axes: int = 1) -> Limiter: ...
    def step(self, force: _Sample, velocity: _Sample) -> tuple[_Array, int]:
        """Limits the force of one tick.

        Args:
            force: Requested force in N.
            velocity: V in m/s.

        Returns:
            The limited force in N, shape `(axes,)`, and which bounds acted: sum of |F| 1, slew 2, power 4,
            ramp-in 8.

        Raises:
            ValueError: A number that is not finite or absurd, or another number of axes; the state stays
                as it was.
        """

    def run(self, force: _Array, velocity: _Array) -> tuple[_Array, _Bits]:
        """As `step`, over arrays of shape `(n_ticks, axes)`; bits of shape `(n_ticks,)`.

        Raises:
            ValueError: Another shape or length; a number that is not finite or absurd, with its tick.
                The ticks before it have been taken.
        """

    def reset(self) -> None:
        """Zero force at once, and the ramp-in starts anew."""

@final
class ResearchObservation:
    """What a controller in Python sees of one tick, as the controllers of the scene see it."""

    @property
    def time_s(self) -> float:
        """t in s since the first tick of the run."""

    @property
    def velocity(self) -> _Array:
        """V in m/s, estimated, shape `(axes,)`."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N, as far as the device can render it, shape `(axes,)`."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N of Eq. 4, shape `(axes,)`: late, as the acceleration is that it is had from."""

    @property
    def aligned_rendered_force(self) -> _Array:
        """F_v in N as late as F_h, shape `(axes,)`: to compare the two."""

def fault_message(code: int) -> str | None:
    """What a fault's code means: which signal was not a finite number or exceeds which bound.

    Bounds per axis: 1000 m, 1000 m/s, 10000 N. None for 0 and for codes that no fault has.

    Raises:
        OverflowError: A code outside 0 to 255.
    """

@final
class SampleBounds:
    """Bounds on the samples of a device.

    A sample is on the path where `|x - x_a - v k| <= velocity_change dT + quantum (k + 1)`, k ticks after the last one.

    Args:
        joints: If true, each axis is a joint in rad and must meet the bounds separately.
        speed: Speed bound of the device in m/s (rad/s), above 0; by default 20 m/s, of joints 60 rad/s.
        velocity_change: Largest change of velocity in m/s (rad/s) from a sample to the next, above 0; by default
            0.5 m/s, which is 0.5 mm off the path at 1 kHz, of joints 5 rad/s.
        quantum: Resolution of the position in m (rad), 0 or more.

    Raises:
        ValueError: A number outside its range.
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
        """In m/s (rad/s)."""

    @property
    def velocity_change(self) -> float:
        """In m/s (rad/s)."""

    @property
    def quantum(self) -> float:
        """In m (rad)."""

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
        """Takes the sample of a tick.

        Args:
            position: x in m (rad), shape `(axes,)`, of which seven count.
            orientation: Of a device that turns, as a unit quaternion.
            time_s: Time of the sample in s on the device's own clock, from a device that gives it.
            is_late: True if the tick was half a period late or more; it does not count then, nor does the next.
        """

    def interrupt(self) -> None:
        """Takes a tick without a sample."""

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

    The same code runs in the live endpoint. Keeps its state from call to call.

    Args:
        device: m, b, c of Eq. 3, and the number of axes.
        settings: Controllers and thresholds.
        estimator: How V and A are had from positions; the default is the Kalman filter.
        limiter: Bounds on the device force, always on.
        samples: Bounds on samples; by default those of joints from four axes on, else of a point.
        period_s: dT in s, above 0.

    Raises:
        ValueError: A parameter outside its range, with its symbol in the paper.

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
        """Samples that left the path of the others and were replaced by their prediction."""

    def step(self, position: _Sample, rendered_force: _Sample, velocity: _Sample | None = None) -> SafetyTick:
        """One tick. A number that is not finite or absurd, and a step beyond the speed bound of the device, return zero
        force and a fault that stays. A sample off the path of the others is held, and its prediction stands for it.

        Args:
            position: x in m.
            rendered_force: F_v in N.
            velocity: V in m/s from a device that measures it, at every tick or at none.

        Raises:
            ValueError: Another number of axes.
        """

    def run(self, position: _Array, rendered_force: _Array, velocity: _Array | None = None) -> SafetyTicks:
        """As `step`, over arrays of shape `(n_ticks, axes)`, or `(n_ticks,)` for one axis.

        Raises:
            ValueError: Another shape or length.
        """

    def reset(self, position: _Sample) -> None:
        """Clears a fault and the past: the device rests at `position` in m, its force rises from zero again.

        Raises:
            ValueError: A position that is not finite or absurd, or another number of axes.
        """

@final
class SafetyTick:
    """What `SafetyLayer.step` saw and decided."""

    @property
    def velocity(self) -> _Array:
        """V in m/s, shape `(axes,)`."""

    @property
    def acceleration(self) -> _Array:
        """A in m/s², shape `(axes,)`."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N as far as the bounds let the device render it: what the observers saw, shape `(axes,)`."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N; zero where no controller reads it, shape `(axes,)`."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(axes,)`."""

    @property
    def device_force(self) -> _Array:
        """F_device in N: what the device is to exert until the next tick; zero at a fault, shape `(axes,)`."""

    @property
    def tripped(self) -> int:
        """Who tripped: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while an intervention is held or fades."""

    @property
    def acted(self) -> int:
        """Which bounds acted: sum of norm 1, slew 2, power 4, ramp 8."""

    @property
    def fault(self) -> int:
        """Code for `fault_message`, 0 without fault; it stays until `SafetyLayer.reset`."""

    @property
    def owed_energy_j(self) -> float:
        """Energy in J that PC requested and the bounds kept it from dissipating."""

@final
class SafetyTicks:
    """What `SafetyLayer.run` saw and decided, one entry per tick."""

    @property
    def velocity(self) -> _Array:
        """V in m/s, shape `(n_ticks, axes)`."""

    @property
    def acceleration(self) -> _Array:
        """A in m/s², shape `(n_ticks, axes)`."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N as far as the bounds let the device render it: what the observers saw, shape `(n_ticks, axes)`."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N; zero where no controller reads it, shape `(n_ticks, axes)`."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N, shape `(n_ticks, axes)`."""

    @property
    def device_force(self) -> _Array:
        """F_device in N: what the device is to exert until the next tick; zero at a fault, shape `(n_ticks, axes)`."""

    @property
    def tripped(self) -> _Bits:
        """Who tripped: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while an intervention is held or fades, shape `(n_ticks,)`."""

    @property
    def acted(self) -> _Bits:
        """Which bounds acted: sum of norm 1, slew 2, power 4, ramp 8, shape `(n_ticks,)`."""

    @property
    def fault(self) -> _Bits:
        """Code for `fault_message`, 0 without fault; it stays until `SafetyLayer.reset`, shape `(n_ticks,)`."""

    @property
    def owed_energy_j(self) -> _Array:
        """Energy in J that PC requested and the bounds kept it from dissipating, shape `(n_ticks,)`."""

# ---------------------------------------------------------------------------------------------- master

@final
class HapticDevice:
    """Model of a haptic device along one axis, advanced exactly between ticks.

    `m A + b V + c sign(V) = F_device + F_h`; at rest, friction withstands up to c.

    Args:
        mass_kg: m in kg, above 0.
        viscous: b in N s/m, of any sign.
        coulomb: c in N, 0 or more.
        encoder_quantum: Resolution of the position in m, 0 or more; with 0 the device measures position
            and velocity exactly, so that no estimator is used.
        stops: Positions in m of the mechanical stops, lower and upper, which take all speed; infinite
            without stops.

    Raises:
        ValueError: A parameter outside its range.

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
            ValueError: A parameter outside its range.

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
        """Positions in m of the lower and the upper mechanical stop."""

@final
class Hand:
    """Model of a hand along one axis: an impedance towards a path, held by a finite grip that can let go.

    `F_h = K_h (x_target - x) - B_h V`, clipped to the grip strength.

    Args:
        stiffness: K_h in N/m, 0 or more.
        damping: B_h in N s/m, 0 or more.
        strength_n: Grip strength in N, 0 or more.
        start: Where the path begins, in m.
        legs: The path, leg by leg: duration in s (above 0), position at its end in m, "linear" or
            "minimum-jerk". The hand rests after the last.
        release: When the hand begins to let go, in s, and in which time in s (0 or more) what falls is zero;
            never without it.
        release_kind: What falls: "strength", so that nothing moves until it has fallen to the load, or "gain",
            the whole impedance.

    Raises:
        ValueError: A parameter outside its range, no such shape or kind.

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
        legs: Sequence[tuple[float, float, Literal["linear", "minimum-jerk"]]] = ...,
        release: tuple[float, float] | None = None,
        release_kind: Literal["strength", "gain"] = "strength",
    ) -> Hand: ...
    def __eq__(self, other: object, /) -> bool: ...
    @staticmethod
    def absent(*, position: float = 0.0) -> Hand:
        """Nobody holds the device, which rests at `position` in m.

        Raises:
            ValueError: A position that is not finite.
        """

    def target(self, time_s: float) -> float:
        """Position in m that the hand means to be at, at a time in s."""

    def strength(self, time_s: float) -> float:
        """Grip strength in N at a time in s."""

# ----------------------------------------------------------------------------------------------- slave

@final
class Wall:
    """A spring wall that fills x below its surface and pushes along +x.

    `F = K (x_w - x)` inside, 0 outside.

    Args:
        stiffness: K in N/m, 0 or more.
        position: Surface x_w in m.

    Raises:
        ValueError: A parameter outside its range.

    Source: paper Eq. 15 with B = 0.
    """

    __hash__: ClassVar[None]  # type: ignore[assignment]

    def __new__(cls, *, stiffness: float, position: float = 0.0) -> Wall: ...
    def __eq__(self, other: object, /) -> bool: ...
    def force(self, position: float) -> float:
        """Force in N on what is at `position` in m.

        Source: paper Eq. 15 with B = 0.
        """

@final
class SceneTouch:
    """What an arm that is not the scene's would touch there: `[environment]`, along the first axes of the arm's base.

    The scene's time begins when the caller says so: it is the `time_s` of every call. Pushers do not push before
    `start_pushers`.

    Args:
        scene_json: As `haptether.bridge.scene_json` gives it.

    Raises:
        ValueError: A scene that cannot be built, or one of more than 3 axes. From every method: what is not finite.
    """

    def __new__(cls, scene_json: bytes) -> SceneTouch: ...
    @property
    def axes(self) -> int:
        """1, 2 or 3; along the others there is no force."""
    @property
    def start(self) -> list[float]:
        """Where the scene's arm starts, in m, or its device if it has no arm; 3 numbers."""
    @property
    def touches(self) -> bool:
        """Whether the tool was inside an object when the force was last computed."""
    def reset(self) -> None:
        """Everything is as it was at first, and the pushers wait."""
    def start_pushers(self, time_s: float) -> None:
        """The time of the pushers begins at a time in s of the scene."""
    def force(self, time_s: float, position: Sequence[float], velocity: Sequence[float]) -> tuple[float, float, float]:
        """Force in N of objects and pushers on the tool at one instant; free bodies as they are now.

        Args:
            time_s: Time of the scene in s.
            position: Of the tool in m, (3,).
            velocity: Of the tool in m/s, (3,).
        """
    def advance(self, time_s: float, step_s: float, position: Sequence[float], velocity: Sequence[float]) -> None:
        """Moves the free bodies over a step in s that begins at `time_s`, while the tool moves on at its velocity."""

@final
class ForceSensor:
    """What a sensor makes of a force: `q round((F + bias + noise) / q)` on each of 3 axes.

    Args:
        noise_n: Standard deviation in N, 0 or more.
        bias_n: Offsets in N, (3,).
        quantum_n: Resolution in N; 0 is exact.
        seed: Of the noise.

    Raises:
        ValueError: A parameter outside its range. From `sample`: a force that is not finite.
    """

    def __new__(
        cls, *, noise_n: float = 0.0, bias_n: Sequence[float] = ..., quantum_n: float = 0.0, seed: int = 0
    ) -> ForceSensor: ...
    def sample(self, force: Sequence[float], index: int) -> tuple[float, float, float]:
        """Sample number `index` of a force in N, (3,): the same index yields the same noise."""

@final
class UrInverseSolver:
    """Inverse kinematics of a UR arm in closed form, refined for a unit: see `haptether.slave.UrInverse`.

    Args:
        model: Denavit-Hartenberg rows theta, a, d and alpha, six numbers each, in m and rad.
        unit: The same of a unit that differs from its model.
        position_min: Least joint angles in rad, -inf where there is none.
        position_max: Largest joint angles in rad.
        flange_from_tool: Rigid transform, (4, 4).

    Raises:
        ValueError: The model is not a UR arm, a number is not finite, limits leave nothing, or no rigid transform.
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
        """All branches, (n, 6), n up to 8, rad.

        Raises:
            ValueError: Not a rigid transform, (4, 4).
        """

    def nearest(self, base_from_tool: _Array, near: _Array) -> _Array | str:
        """The posture nearest to `near`, (6,), rad, or why there is none.

        Raises:
            ValueError: Not a rigid transform, (4, 4), or not six finite numbers.
        """

# ---------------------------------------------------------------------------------------------- netsim

@final
class DirectionStatistics:
    """What became of the datagrams of one direction of a proxy."""

    @property
    def received(self) -> int:
        """Datagrams accepted and judged."""

    @property
    def lost(self) -> int:
        """Of these, taken by the link's rules."""

    @property
    def queue_full(self) -> int:
        """Of these, dropped because too many were in flight."""

    @property
    def released(self) -> int:
        """Of these, sent on."""

    @property
    def unsent(self) -> int:
        """Of these, not sent on when due, because the socket refused them or the client was gone."""

    @property
    def damaged(self) -> int:
        """Of these, with other bytes than were received."""

    @property
    def extras(self) -> int:
        """What was to arrive beside the packets: copies, and what somebody makes up."""

    @property
    def extras_released(self) -> int:
        """Of these, sent."""

    @property
    def extras_lost(self) -> int:
        """Of these, not sent: too many in flight, or refused by the socket."""

    @property
    def overtaking(self) -> int:
        """Datagrams due before one accepted earlier: each overtakes at least one."""

    @property
    def oversize(self) -> int:
        """Datagrams too large to be carried, dropped before any rule saw them."""

    @property
    def refused(self) -> int:
        """Datagrams from a source that is not served, dropped before any rule saw them."""

    @property
    def dropped(self) -> dict[str, int]:
        """Datagrams accepted that were dropped, by cause: those of `lost` and `queue_full`."""

@final
class ProxyStatistics:
    """What a proxy has done so far."""

    @property
    def forward(self) -> DirectionStatistics:
        """From the client to the peer."""

    @property
    def backward(self) -> DirectionStatistics:
        """From the peer to the client."""

    @property
    def flows(self) -> int:
        """Clients that are served now."""

    @property
    def peer_unreachable(self) -> int:
        """Times the network reported that the peer cannot be reached."""

    @property
    def scheduling_error_p50_s(self) -> float:
        """How late the median datagram left, in s."""

    @property
    def scheduling_error_p99_s(self) -> float:
        """How late all but 1 % of the datagrams left at most, in s."""

    @property
    def scheduling_error_p999_s(self) -> float:
        """How late all but 0.1 % of the datagrams left at most, in s."""

    @property
    def scheduling_error_max_s(self) -> float:
        """How late the latest datagram left, in s."""

    @property
    def early(self) -> int:
        """Datagrams that left before they were due: none, ever."""

    @property
    def log_lost(self) -> int:
        """Records that the log lacks, because its writer was late."""

    @property
    def log_failed(self) -> bool:
        """Whether the log could not be written to its end, as on a full disk; the run is not valid then."""

    @property
    def scheduling(self) -> Literal["fifo", "normal"]:
        """How its thread is scheduled."""

    @property
    def receive_buffer_bytes(self) -> int:
        """What the kernel grants the listening socket for datagrams that wait, as it counts them."""

    @property
    def send_buffer_bytes(self) -> int:
        """The same for sending."""

    @property
    def valid(self) -> bool:
        """Whether the delays were those requested: p99 of the scheduling error within its limit."""

@final
class Proxy:
    """What `haptether.netsim.Proxy` wraps: a live UDP proxy between clients and one peer, on its own thread.

    It forwards to the peer only, and serves clients of this machine and those that `allow` names, up to 64 at a time.
    All share the link of their direction.

    Args:
        listen: Where the clients send to, `HOST:PORT`; port 0 lets the system choose.
        forward: The peer, `HOST:PORT`.
        forward_link: Network from the client to the peer, as JSON.
        backward_link: Network from the peer to the client, as JSON.
        seed: Key of all draws, 0 to 2⁶⁴ - 1.
        allow: Sources that are served beside those of this machine, `IP` or `IP:PORT`; by default none.
        realtime: Whether to request real-time scheduling; the statistics say what was got.
        max_error_s: Largest p99 of the scheduling error in s with which a run is valid.
        log: File for what became of each datagram, as CSV: `direction,index,kind,t_in_ns,t_due_ns,t_out_ns,cause,
            error_ns,size`. `kind` is empty for the packet itself, else why there is a copy; `t_out_ns` is when the call
            that sends it began.

    Raises:
        ValueError: An address that is none.
        OSError: An address that cannot be used.
    """

    def __new__(
        cls,
        *,
        listen: str,
        forward: str,
        forward_link: str,
        backward_link: str,
        seed: int = 0,
        allow: Sequence[str] = ...,
        realtime: bool = True,
        max_error_s: float = 1e-3,
        log: str | PathLike[str] | None = None,
    ) -> Proxy: ...
    @property
    def address(self) -> str:
        """Where it listens, with the port that was chosen."""

    @property
    def forward(self) -> str:
        """Address to which it forwards: the first of a name to which it can send."""

    @property
    def finished(self) -> bool:
        """Whether its thread has ended."""

    def change(self, direction: Literal["forward", "backward"], settings: str) -> None:
        """Other settings for the datagrams that arrive from now on; taken up within 20 ms, in order.

        Raises:
            ValueError: No such `direction`.
        """

    def statistics(self) -> ProxyStatistics:
        """What it has done so far, while it goes on."""

    def stop(self) -> ProxyStatistics:
        """Ends it, which takes up to 20 ms; what is still in flight is not sent.

        Raises:
            OSError: The proxy had ended on an error of its sockets.
            RuntimeError: Its thread panicked.
        """

@final
class Echo:
    """Answers the probes of `record`, one for one and of the same size; runs on its own thread.

    Args:
        listen: Where it listens, `HOST:PORT`; port 0 lets the system choose.

    Raises:
        ValueError: An address that is none.
        OSError: An address that cannot be used.
    """

    def __new__(cls, *, listen: str) -> Echo: ...
    @property
    def address(self) -> str:
        """Where it listens, with the port that was chosen."""

    @property
    def finished(self) -> bool:
        """Whether its thread has ended."""

    def stop(self) -> tuple[int, int]:
        """Ends it and returns how many probes it answered, and how many datagrams were none.

        Raises:
            OSError: It had ended on an error of its socket.
            RuntimeError: It was stopped before, or its thread panicked.
        """

@final
class Recording:
    """What `record` measured: each array of shape `(n_probes,)`, nan for a loss.

    Where the other direction lost a probe, the delay is that of the probe before: there was nothing to measure.
    """

    def __len__(self) -> int: ...
    @property
    def peer(self) -> str:
        """Address of the echo that answered, of a name with several."""

    @property
    def time_s(self) -> _Array:
        """When each probe was sent, in s since the first."""

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
        """Answers lost on the return path."""

    @property
    def shortest_s(self) -> float:
        """Shortest round trip in s, without the time at the echo."""

    @property
    def offset_s(self) -> float:
        """How far the echo's clock was taken to be ahead, in s, in the middle of the measurement."""

    @property
    def drift(self) -> float:
        """How much faster the echo's clock was taken to run, as a share."""

    @property
    def latest_s(self) -> float:
        """How late the latest probe was sent, in s."""

    def write_csv(self, path: str | PathLike[str]) -> None:
        """Writes `time_s,forward_delay_s,backward_delay_s`, an empty cell for a loss, below comments.

        Raises:
            OSError: A file that cannot be written.
        """

def record(peer: str, *, rate_hz: float = 1000.0, duration_s: float = 10.0, realtime: bool = True) -> Recording:
    """Measures the network to an `Echo` and back with a stream of probes.

    Only the round trip is measured for certain. With the echo's clock ahead by theta, a probe shows
    `a = forward + theta` and `b = backward - theta`; where it waited least, in windows of time, both directions are taken
    to be alike, `theta = (a - b) / 2`, and a line through the quieter half of the windows is theta(t).

    Args:
        peer: Where the echo is, `HOST:PORT`.
        rate_hz: Probes a second, at most 1000.
        duration_s: For how long, in s; at most ten million probes.
        realtime: Whether to request real-time scheduling.

    Raises:
        ValueError: A number outside its range, or an address that is none.
        OSError: Nobody answered, or the network cannot be used.

    Source: Mills 1991 (minimum filter); Paxson 1998 (drift through minima).
    """

def check_link(settings: str) -> None:
    """Refuses settings of a link, as JSON, that describe none.

    Raises:
        ValueError: `key = seen: must be ...` or `key: problem`.
    """

def link_bounds(settings: str) -> tuple[float, float]:
    """Longest time in s that a packet is in flight, and time in s of the last scheduled change.

    Raises:
        ValueError: As `check_link`.
    """

def read_link_file(form: str, data: bytes, direction: str) -> str:
    """What a file of a link says, as JSON of the setting that it stands for.

    Args:
        form: "csv", "irtt", "mahimahi" or "dist".
        data: Its bytes.
        direction: Whose delays, in a recording of both directions.

    Raises:
        ValueError: A file that is not what it should be, with line and column.
    """

def translate_netem(text: str) -> str:
    """What arguments of `tc netem` request, as JSON.

    `settings` are those of a link that does it; `asked` has the correlations of delay, loss, duplicate, corrupt and
    reorder, 0 to 1, and the limit.

    Raises:
        ValueError: Text that netem refuses, with its column, or what a link has no settings for.
    """

def verdict_causes() -> list[str]:
    """Names of the causes of `judge_packets`, by code."""

def judge_packets(
    settings: str,
    sent_ns: npt.NDArray[np.int64],
    sizes: npt.NDArray[np.int64] | None,
    direction: str,
    seed: int,
) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.int64], npt.NDArray[np.uint8]]:
    """What becomes of each packet: index, when sent, when it arrives, code of the cause; see `netsim.judge_all`.

    Raises:
        ValueError: As `check_link`, a number below 0, times that decrease, or no such `direction`.
    """

# ---------------------------------------------------------------------------------------------- bridge

@final
class Sinusoid:
    """An active force `F_v = a sin(w t)`.

    Args:
        amplitude_n: a in N.
        rate: w in rad/s.

    Raises:
        ValueError: A number that is not finite.

    Source: paper section 4.5.
    """

    def __new__(cls, *, amplitude_n: float, rate: float) -> Sinusoid: ...

@type_check_only
class _ObservedTicks:
    """What the controllers saw of each tick, and who tripped."""

    @property
    def grasp_force(self) -> _Array:
        """F_h in N as estimated; 0 where no controller reads it.

        Source: paper Eq. 4.
        """

    @property
    def velocity_force(self) -> _Array:
        """S_vf; NaN where not observed.

        Source: paper Eq. 1.
        """

    @property
    def grasp(self) -> _Array:
        """S_h; NaN where not observed.

        Source: paper Eq. 5.
        """

    @property
    def windowed_energy_j(self) -> _Array:
        """E_wso in J; NaN where not observed.

        Source: paper Eq. 11.
        """

    @property
    def tripped(self) -> _Bits:
        """Who tripped: sum of VFC 1, HSC 2, WSC 4, PC 8; 16 while only held."""

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
        """E_so in J; NaN where not observed.

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
    """The loop without a network: device and hand under a force rendered on the spot.

    The force is computed once a tick and held; between ticks the motion is exact.

    Args:
        device: The device.
        hand: Who holds it.
        rendered: What is rendered.
        ticks: Number of ticks, at most 2e7.
        settings: Safety controllers; without them none.
        estimator: For a device with an encoder; without it the default of `EstimatorKind`.
        limiter: Bounds; without them the defaults of `LimiterSettings`, without ramp-in.
        period_s: dT in s, a whole number of ns between 1e-6 and 1.
        start: Position in m and velocity in m/s; without it at rest where the hand's path begins.
        device_delay: Ticks by which the force of the device acts late, at most 1000; no controller knows of it.

    Raises:
        ValueError: A parameter outside its range.

    Source: paper Eq. 15 and section 4 (the experiments).
    """

@type_check_only
class _SideTicks:
    """How a side and its ladder stood at each tick."""

    def __len__(self) -> int: ...
    @property
    def time_s(self) -> _Array:
        """Time since the run began, in s."""

    @property
    def state(self) -> _Bits:
        """State of the ladder, for `ladder_state_name`."""

    @property
    def reason(self) -> _Bits:
        """Why it stands there, for `ladder_reason`; 0 where it began."""

    @property
    def clutch(self) -> _Bits:
        """1 while the clutch is closed, as far as this side knows."""

    @property
    def age_s(self) -> _Array:
        """Silence of the peer in s; infinite before its first frame."""

    @property
    def round_trip_s(self) -> _Array:
        """Round trip in s of the newest echo, both loops' waits for their ticks included; infinite before the first."""

    @property
    def overshoot_s(self) -> _Array:
        """How late the loop woke, in s; in virtual time only where the clock of this side is set."""

    @property
    def fault(self) -> _Bits:
        """Code for `fault_message`, 0 without fault, shape `(n_ticks,)`."""

@final
class MasterTrace(_SideTicks, _ObservedTicks):
    """Ticks of a master: each signal an array of shape `(n_ticks,)`, or `(n_ticks, axes)` for vectors of several axes."""

    @property
    def position(self) -> _Array:
        """Position x in m, as the device measures it."""

    @property
    def velocity(self) -> _Array:
        """True velocity V in m/s where the device is a model, else as estimated."""

    @property
    def hand_force(self) -> _Array:
        """True force of the hand in N where the device is a model, else 0."""

    @property
    def rendered_force(self) -> _Array:
        """F_v in N, faded by the ladder and bounded to what the device can render."""

    @property
    def safety_force(self) -> _Array:
        """F_c in N."""

    @property
    def device_force(self) -> _Array:
        """F_device in N, after the limiter."""

    @property
    def orientation(self) -> _Array | None:
        """R as the device measures it, unit quaternions w, x, y, z of shape `(n_ticks, 4)`; none but of kind "pose"."""

    @property
    def angular_velocity(self) -> _Array | None:
        """True w in rad/s where the device is a model, else as estimated."""

    @property
    def hand_torque(self) -> _Array | None:
        """True torque of the hand in N m where the device is a model, else 0."""

    @property
    def rendered_torque(self) -> _Array | None:
        """Requested torque in N m, faded by the ladder and bounded to what the device can render."""

    @property
    def grasp_torque(self) -> _Array | None:
        """Torque of the hand in N m, as estimated."""

    @property
    def safety_torque(self) -> _Array | None:
        """Of the controllers in N m."""

    @property
    def device_torque(self) -> _Array | None:
        """Of the device in N m, after the limiter."""

    @property
    def acted(self) -> _Bits:
        """Which bounds of the limiter acted: sum of |F| 1, slew 2, power 4, ramp-in 8."""

    @property
    def trigger(self) -> _Array:
        """What leads the gripper, 0 (open) to 1 (closed); NaN where it is not known, or without a gripper."""

    @property
    def trigger_velocity(self) -> _Array | None:
        """V of a trigger that the finger feels in m/s, positive closing, as estimated; none of others, as all that follows."""

    @property
    def trigger_rendered_force(self) -> _Array | None:
        """F_v at the trigger in N, as far as it can be rendered."""

    @property
    def trigger_safety_force(self) -> _Array | None:
        """F_c at the trigger in N."""

    @property
    def trigger_device_force(self) -> _Array | None:
        """F_device at the trigger in N, after the limiter."""

    @property
    def trigger_tripped(self) -> _Bits | None:
        """Who tripped by the trigger, as `tripped`."""

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
    def orientation(self) -> _Array | None:
        """R of the tool, unit quaternions w, x, y, z of shape `(n_ticks, 4)`; none but of kind "pose"."""

    @property
    def command_orientation(self) -> _Array | None:
        """Commanded R; the tool's own before the first command."""

    @property
    def environment_torque(self) -> _Array | None:
        """Torque of the environment on the tool in N m."""

    @property
    def limited(self) -> _Bits:
        """Which bounds acted on the remote command: speed 1, reach 2, angular speed 4, turn 8."""

    @property
    def gripper(self) -> _Array:
        """Position of the gripper, 0 (open) to 1 (closed); NaN without one."""

    @property
    def gripper_command(self) -> _Array:
        """Its last command, 0 (open) to 1 (closed); NaN before the first."""

    @property
    def gripper_force(self) -> _Array:
        """Between its jaws in N; NaN without one."""

    @property
    def holds_object(self) -> _Bits:
        """1 where something stops its jaws."""

@final
class LinkStatistics:
    """What one side has sent and received."""

    @property
    def sent(self) -> int:
        """Frames sent."""

    @property
    def fresh(self) -> int:
        """Frames that were newer than all before when they arrived."""

    @property
    def late(self) -> int:
        """Frames that arrived after a newer one: counted, not used."""

    @property
    def duplicate(self) -> int:
        """Frames that had arrived before."""

    @property
    def refused(self) -> int:
        """Datagrams that were no frame of the peer."""

    @property
    def missing(self) -> int:
        """Frames between the first and the newest that have not arrived."""

    @property
    def round_trip_s(self) -> float:
        """Round trip in s of the newest echo, without the time that the peer held it; 0 before any."""

    @property
    def least_round_trip_s(self) -> float:
        """Least round trip in s; 0 before any."""

@final
class PathReport:
    """What the path did to the peer's frames up to the end of a run, and what is known of the peer's clock."""

    @property
    def expected(self) -> int:
        """Frames from the first to the newest that arrived."""

    @property
    def received(self) -> int:
        """Different frames among them that arrived."""

    @property
    def lost(self) -> int:
        """Those that did not."""

    @property
    def loss(self) -> float:
        """Their share; 0 before the first frame."""

    @property
    def bursts(self) -> int:
        """Runs of lost frames."""

    @property
    def mean_burst(self) -> float:
        """Mean length of a run in frames; 0 without any."""

    @property
    def longest_burst(self) -> int:
        """The longest run in frames."""

    @property
    def reordered(self) -> int:
        """Frames that arrived after a newer one."""

    @property
    def mean_extent(self) -> float:
        """By how many arrivals they were too late, on average (RFC 4737); 0 without any."""

    @property
    def longest_extent(self) -> int:
        """By how many at most."""

    @property
    def duplicate(self) -> int:
        """Frames that had arrived before; those of a session are in `LoopReport.rejections`."""

    @property
    def too_late(self) -> int:
        """Frames so late that they count as lost, or of before the first."""

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
        """Bound of the age in s that the link is used to, which the ladder measures against; none before any echo."""

    @property
    def offset_s(self) -> float | None:
        """The peer's clock less ours in s; none before it is known."""

    @property
    def offset_bound_s(self) -> float | None:
        """How wrong `offset_s` may be, in s."""

    @property
    def clock_steps(self) -> int:
        """How often a clock was proven to step."""

    @property
    def clock_faults(self) -> int:
        """Exchanges that no healthy clocks make, steps included."""

    @property
    def last_clock_fault(self) -> str | None:
        """The last of them."""

@final
class RecordingReport:
    """What became of a recording."""

    @property
    def written(self) -> int:
        """Records that the system took."""

    @property
    def dropped(self) -> int:
        """Records of the loop that are not in the file; while it runs, those that wait are among them."""

    @property
    def end(self) -> str | None:
        """Why the recording ended before the run; none if it did not."""

@final
class LoopReport:
    """How the loop of one side went."""

    @property
    def ticks(self) -> int:
        """Ticks done."""

    @property
    def skipped(self) -> int:
        """Ticks left out because the loop woke too late."""

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
        """What the path did to the peer's frames, and what is known of its clock."""

    @property
    def holds(self) -> int:
        """How often the ladder went to HOLD."""

    @property
    def limited(self) -> int:
        """Ticks at which a bound acted on the remote command; of a master 0."""

    @property
    def outliers(self) -> int:
        """Samples that left the path of the others and were replaced by their prediction."""

    @property
    def renewal(self) -> float | None:
        """Share of the ticks with a new sample of the driver's device, as last measured over a motion; none before."""

    @property
    def secure(self) -> bool:
        """Whether frames were encrypted and authenticated."""

    @property
    def rejections(self) -> dict[str, int]:
        """Datagrams that the session did not take, by cause; causes without any are left out."""

    @property
    def engaged_s(self) -> float:
        """When the sides first engaged, in s since the start; infinite if never."""

    @property
    def realtime(self) -> str:
        """What the loop's thread got of the system, as read back from it."""

    @property
    def is_realtime(self) -> bool:
        """Whether the loop ran under SCHED_FIFO."""

    @property
    def recording(self) -> RecordingReport | None:
        """What became of the recording; none without one."""

    @property
    def out_of_memory(self) -> bool:
        """Whether the loop was ended because no memory was left."""

@final
class SignalRelay:
    """What signals request of live loops, done by a thread that waits neither for Python nor for whoever reads its output.

    `signal.set_wakeup_fd(relay.fileno())` has Python write the numbers of its signals to it, for those that have a
    handler. SIGINT, SIGTERM and SIGHUP end the attached loops; SIGUSR1 presses the clutch of a master and allows
    another master at a slave, unless a stop was requested; a second SIGINT ends the process with status 130, once the
    loops are at rest, or after 0.3 s. Memory that the system no longer grants ends the loops, too.

    Raises:
        MemoryError: What is set aside for the end of a run is not there.
        OSError: No thread or socket can be made.
    """

    def __new__(cls) -> SignalRelay: ...
    def fileno(self) -> int:
        """Takes the numbers of signals, a byte each; never blocks."""

    def attach(self, of: LiveMaster | LiveSlave | MasterLoop | SlaveLoop) -> None:
        """Has signals reach a loop; one that has arrived before ends it."""

    def stop(self) -> None:
        """Ends the attached loops, as SIGTERM does."""

    @property
    def stopped(self) -> bool:
        """Whether a stop was requested."""

    @property
    def out_of_memory(self) -> bool:
        """Whether the loops of this process were ended because no memory was left."""

    def spend_reserve(self) -> None:
        """Ends the loops of this process, and frees the memory that was set aside for that."""

    def take_acknowledgement(self) -> bool:
        """Whether SIGUSR2 has arrived within the last 0.5 s, and was not taken before."""

    def close(self) -> None:
        """Ends its thread."""

@type_check_only
class _LiveSide:
    """What a live side has, whoever paces its loop."""

    @property
    def address(self) -> str:
        """Where it listens, with the port that was chosen."""

    @property
    def state(self) -> str:
        """Where the ladder stands: a name of `ladder_state_name`."""

    @property
    def kind(self) -> Literal["linear", "joints", "pose"]:
        """What the coordinates of the scene's sides are."""

    @property
    def ticks(self) -> int:
        """Ticks done so far."""

    @property
    def finished(self) -> bool:
        """Whether the loop has ended."""

    @property
    def is_answered(self) -> bool:
        """Whether the peer has answered a frame of this side."""

    @property
    def recording(self) -> RecordingReport | None:
        """How the recording stands; none without one."""

    def poll(self) -> int:
        """How many ticks the trace holds by now."""

    def stop(self) -> None:
        """Requests the loop to end after its current tick."""

    def security_events(self) -> list[str]:
        """What has happened to the session since the last call, as text."""

    def flight(self) -> str | None:
        """The last states and commands as JSON, as of the last STOP or FAULT, or of the end; none before."""

    @property
    def ineffective_presses(self) -> tuple[int, str | None]:
        """How often the clutch was pressed for nothing, and why the last time, as text; none where `cause` has it.

        Counted are calls of `press_clutch` while something else had to be done before, that were read late, or at a device
        with a button of its own, and a start that was more than 5 s ago when the loop began; 0 at a slave.
        """

    @property
    def start_is_void(self) -> bool:
        """True if the start was to press the clutch, was too long ago, and no button of the device can press instead."""

    def cause(self) -> str | None:
        """Why the two sides are not coupled, as JSON: `state`, `at`, `text` and `steps`; none where all is well.

        `at` is where it happened, "master", "slave" or "link", `text` what, in the driver's own words where there are
        any. `steps` are what to do in order: `at`, `remedy` (acknowledge, start, wait, turn or press) and `text` of each.
        """

    def acknowledge(self) -> None:
        """Says that the fault of this side is mended: the master's clutch must then be released and pressed.

        Raises:
            RuntimeError: The loop has ended, or hangs.
        """

@type_check_only
class _MasterSide(_LiveSide):
    """What the side of the hand has."""

    def press_clutch(self) -> None:
        """Lets go of the clutch for 0.1 s and presses it again: a command of this side's operator.

        Void if the loop does not read it within 0.25 s, or was late within 0.25 s before.
        """

    def set_force_scale(self, scale: float) -> None:
        """Changes lambda_f from the next tick on: it fades within `safety.ladder.fade_in_s`.

        Raises:
            ValueError: A scale out of its bounds: while the clutch is closed the scene's value by a factor of
                `coupling.change_factor` (2), with an open clutch by 100, up and down.
            RuntimeError: The loop has ended, or hangs.
        """

    def finish(self) -> tuple[MasterTrace, LoopReport]:
        """Ends the loop and returns its newest ticks (`keep_s`) and how it went.

        Raises:
            RuntimeError: Called a second time, or the loop panicked.
        """

@type_check_only
class _SlaveSide(_LiveSide):
    """What the side of the robot has."""

    def allow_takeover(self) -> None:
        """Lets another master begin, if the one before has been silent for 2 s: a command of the slave's operator."""

    def set_position_scale(self, scale: float) -> None:
        """Changes lambda_p from the next tick on: it fades within `safety.ladder.fade_in_s`; the arm goes on from where it is.

        Raises:
            ValueError: A scale out of its bounds: while the clutch is closed the scene's value by a factor of
                `coupling.change_factor` (2), with an open clutch by 100, up and down.
            RuntimeError: The loop has ended, or hangs.
        """

    def finish(self) -> tuple[SlaveTrace, LoopReport]:
        """Ends the loop and returns its newest ticks (`keep_s`) and how it went.

        Raises:
            RuntimeError: Called a second time, or the loop panicked.
        """

@type_check_only
class _DrivenLoop:
    """What a loop has that a driver steps."""

    @property
    def axes(self) -> int:
        """Number of axes of a sample."""

    @property
    def is_blocked(self) -> bool:
        """Whether the driver that `begin` named is in a call that has not returned for 0.5 s."""

    def begin(self, driver: str | None = None) -> str:
        """Time begins; requests real time of the system for this thread, and returns what was granted.

        Args:
            driver: Its name; a thread then watches it. Each turn begins with `take_acknowledgement`. If `read` (before
                `step`) or `write` (after it) does not return for 0.5 s, or the first `read` for 1 s, the thread ticks in
                the driver's place: a fault that names the driver and the call, on both sides.

        Raises:
            OSError: Real time is required and refused, or there is no room for a thread; the loop is over.
        """

    def wait(self) -> None:
        """Sleeps until the next tick is due: for a device that does not wait in `read`."""

    def fail(self, text: str = "") -> None:
        """The device is gone: a fault, which is sent to the peer for 60 ticks; the loop is over.

        Args:
            text: The driver's own, which both sides show: up to 239 bytes of UTF-8 on one line.
        """

    def take_acknowledgement(self) -> bool:
        """Whether the device's fault was acknowledged by the control socket since the last call, and within 0.25 s."""

    def announce_end(self) -> None:
        """Announces to the peer that this side ends, within 20 ms; the loop is over. `finish` does it where nobody has."""

@final
class LiveMaster(_MasterSide):
    """The side of the hand, live over UDP on a thread of its own.

    Args:
        scene: As `scene_json` gives it; its device is a model that its operator holds.
        peer: The slave or a proxy before it, `HOST:PORT`.
        run_id: Drawn anew at every start, 0 to 2⁶⁴ - 1.
        key: The 32 bytes that both sides share, of `read_key`; copied: a bytearray may be wiped then.
        insecure: Goes without a key: frames travel in the clear, and anybody who can send can steer.
        listen: Its own address, `HOST:PORT`, of the peer's kind (IPv4 or IPv6). If not given, that from which the system
            sends to the peer, with any free port: a peer on this machine is talked to on loopback.
        duration_s: Ends this long after the two sides engaged, in s; without it only by a stop.
        patience_s: Ends if the two sides have not engaged after this time in s; without it never.
        started_s: When the operator started this side, by `time.monotonic()`; without it now. At the first tick it counts
            as a press of the clutch if it is at most 5 s old.
        keep_s: How much of the end of the run the trace holds, in s; its memory is taken at the start. By default 16 MiB:
            87 s of a master along one axis, 24 s of poses.
        realtime: "auto": requests SCHED_FIFO and locked memory, and goes on without; "off": requests nothing; "require":
            fails without.
        priority: Under SCHED_FIFO, 1 to 99.
        cpu: Processor that the loop stays on; without it the kernel chooses.
        record: File for an MCAP recording of every tick (`read_recording`); one that is there is replaced.
        min_free_bytes: The recording ends, and nothing else does, when fewer are free on its disk.
        telemetry: A Unix socket of this path sends samples and events, see `TelemetryReader`; the loop waits for no reader.
        control: A Unix socket of this path takes requests (docs/console.md): stop, press and hold, scales. A thread of its
            own serves it without the interpreter.

    Raises:
        ValueError: An address that is none, a time outside 0 to 1e9 s, a start that is to come, a key of another length,
            neither a key nor `insecure`, both, no such real time, or a scene without a [slave] and a [coupling].
        OSError: An address or a file that cannot be used, or real time that is required and refused.
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
        min_free_bytes: int = ...,
        telemetry: str | PathLike[str] | None = None,
        control: str | PathLike[str] | None = None,
    ) -> LiveMaster: ...
    @property
    def realtime(self) -> str:
        """What the loop's thread got of the system, as read back from it."""

@final
class LiveSlave(_SlaveSide):
    """The side of the robot, live over UDP on a thread of its own; it learns the master's address.

    Args:
        scene: As `scene_json` gives it; its arm is a model in its environment.
        listen: Its address, `HOST:PORT`; port 0 lets the system choose.

    The others are those of `LiveMaster`.

    Raises:
        ValueError: An address that is none, a time outside 0 to 1e9 s, a key of another length, neither a key nor
            `insecure`, both, no such real time, or a scene without a [slave] and a [coupling].
        OSError: An address or a file that cannot be used, or real time that is required and refused.
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
        min_free_bytes: int = ...,
        telemetry: str | PathLike[str] | None = None,
        control: str | PathLike[str] | None = None,
    ) -> LiveSlave: ...
    @property
    def realtime(self) -> str:
        """What the loop's thread got of the system, as read back from it."""

@final
class MasterLoop(_MasterSide, _DrivenLoop):
    """The side of the hand, live over UDP, stepped by a driver at each sample of its device: `begin`, `step`, `finish`.

    Args:
        scene: As `scene_json` gives it; its device and its arm are left to drivers.
        clutch: Of a device without a button: "once" is pressed by the start, if the device opens within 5 s, and anew by
            `press_clutch` only; "auto" also by a simulated operator, 0.5 s (or its reaction) after each hold.
            The scene's operator has no say.

    The others are those of `LiveMaster`.

    Raises:
        ValueError: An address that is none, a time outside 0 to 1e9 s, a start that is to come, a key of another length,
            neither a key nor `insecure`, both, no such real time or clutch, or a scene without a [slave] and a
            [coupling], or with times at which its operator presses.
        OSError: An address or a file that cannot be used.
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
        min_free_bytes: int = ...,
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
        """One tick, at a sample of the device.

        A number that is not finite or absurd leads to zero force and a fault, and no exception.

        Args:
            position: x in m, a number for one axis or shape `(axes,)`.
            velocity: V in m/s from a device that measures it, at every sample or at none.
            clutch: Whether it is pressed, from a device with a button; none without one.
            fault: What the device says is wrong with it, which both sides show: up to 239 bytes of UTF-8 on one line.
            trigger: What leads the slave's gripper, 0 (open) to 1 (closed); none, or another number, leaves it as it is.
            orientation: R of kind "pose", as a unit quaternion w, x, y, z; of other kinds nothing is taken of it.
            angular_velocity: w in rad/s in the base frame from a device that measures it, at every sample or at none.
            buttons: Bit n, button n is pressed; none where they are not known, which is no release. What they do is said
                by `[master.buttons]` of the scene.
            time_s: Time of the sample in s on the device's own clock, at every sample or at none; it never goes back.

        Returns:
            F_device in N, shape `(axes,)`, and of kind "pose" that and the torque in N m, shape `(3,)` each; none where
            the run is over.

        Raises:
            TypeError: A sample that is no number, of another number of axes, or without an orientation of kind "pose";
                nothing was done.
            ValueError: A `time_s` that is not finite or goes back; nothing was done.
            RuntimeError: Another thread steps it.
        """

    @property
    def trigger_force(self) -> float | None:
        """F_device in N at the trigger after the last tick, positive closing; none without `[master.gripper]`."""

@final
class SlaveLoop(_SlaveSide, _DrivenLoop):
    """The side of the robot, live over UDP, stepped by a driver at each sample of its arm: `begin`, `step`, `finish`.

    Args:
        scene: As `scene_json` gives it; its device and its arm are left to drivers.
        listen: Its address, `HOST:PORT`; port 0 lets the system choose.

    The others are those of `LiveMaster`.

    Raises:
        ValueError: An address that is none, a time outside 0 to 1e9 s, a key of another length, neither a key nor
            `insecure`, both, no such real time, or a scene without a [slave] and a [coupling].
        OSError: An address or a file that cannot be used.
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
        min_free_bytes: int = ...,
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
        """One tick, at a sample of the arm.

        A number that is not finite or absurd leads to a stop and a fault, and no exception.

        Args:
            position: Of the tool in m, a number for one axis or shape `(axes,)`.
            velocity: Of the tool in m/s.
            force: F_e in N.
            fault: What the arm says is wrong with it, which both sides show: up to 239 bytes of UTF-8 on one line.
            gripper: Of a scene with `[slave.gripper]`: position, 0 (open) to 1 (closed), velocity in 1/s, force in N, and
                whether it holds something; numbers that no gripper has are sent as not known.
            orientation: R of kind "pose", as a unit quaternion w, x, y, z; of other kinds nothing is taken of it.
            angular_velocity: w in rad/s in the base frame, of kind "pose".
            torque: Of the environment on the tool in N m, in the base frame about the tool point, of kind "pose".
            time_s: Time of the sample in s on the arm's own clock, at every sample or at none; it never goes back.

        Returns:
            "wait", "move" or "stop", and where the arm is to move in m and with which velocity in m/s, shape `(axes,)`
            each, both empty unless it is to move; of kind "pose" a move has the orientation and the angular velocity as
            well. None where the run is over. An arm that is no longer led is moved to rest with constant deceleration,
            `slave.max_acceleration` of the scene or 5 m/s², and 25 rad/s².

        Raises:
            TypeError: A sample that is no number, of another number of axes, or of kind "pose" without one of the last
                three; nothing was done.
            ValueError: A `time_s` that is not finite or goes back; nothing was done.
            RuntimeError: Another thread steps it.
        """

    @property
    def buttons(self) -> int | None:
        """Of the master, by its newest frame at the last tick: bit n, button n is pressed; none in a scene without."""

    @property
    def gripper_command(self) -> tuple[float, float, float] | None:
        """Position, 0 (open) to 1 (closed), speed in 1/s and force in N after the last tick; none: it keeps its grip."""

def ladder_reason(code: int) -> str:
    """Why the ladder stands where it does, for the codes of `MasterTrace.reason` from 1; 0 stands for no step yet.

    Raises:
        ValueError: No such code.
        OverflowError: A code outside 0 to 255.
    """

def ladder_state_name(code: int) -> str:
    """Name of a state of the ladder: 0 disengaged, 1 aligning, 2 engaged, 3 stale, 4 hold, 5 stop, 6 fault.

    Raises:
        ValueError: No such code.
        OverflowError: A code outside 0 to 255.
    """

# ------------------------------------------------------------------------------------------- dynamixel

@final
class SyncRead:
    """A read of the same addresses of several servos, whose values come together or not at all.

    Args:
        address: First address.
        length: Bytes of each.
        ids: The servos, in the order of their values, none twice.
        fast: Whether they answer with one packet, which newer firmware can, or each with its own.

    Raises:
        ValueError: What no packet can carry.
    """

    def __new__(cls, address: int, length: int, ids: Sequence[int], *, fast: bool = True) -> SyncRead: ...
    @property
    def alerts(self) -> tuple[int, ...]:
        """The servos that reported a hardware error in the last read; their values are valid."""

@final
class DynamixelBus:
    """The servos on one serial port, with Protocol 2.0 in Rust; calls of several threads are one after the other.

    An answer must be there `timeout_s` after its bytes could be. Before the first instruction, and after one that
    failed, the line must be silent for as long, so that no late answer is taken for a new one; it is given up after eight
    times that. A call that waits while another thread calls `stop` ends within a few ms with `RuntimeError`.

    Args:
        port: Path of the serial port.
        baud: Rate in bit/s, 1200 to 10 000 000.
        timeout_s: 0.001 to 10 s.

    Raises:
        ValueError: A rate or a timeout that cannot be.
        OSError: A port that cannot be opened, or that another process has.
    """

    BROADCAST: ClassVar[int]
    """The id that every servo listens to, and none answers to."""

    def __new__(cls, port: str, *, baud: int, timeout_s: float = 0.02) -> DynamixelBus: ...
    def ping(self, servo_id: int) -> tuple[int, int]:
        """Model number and firmware version.

        Raises:
            TimeoutError: No answer, and so below.
            OSError: The port is gone, and so below.
            RuntimeError: A wrong answer, or one that says no, and so below.
        """

    def read(self, servo_id: int, address: int, length: int) -> bytes:
        """Bytes from an address on."""

    def write(self, servo_id: int, address: int, written: bytes) -> bool:
        """Sets bytes from an address on; whether the servo has a hardware error. Of `BROADCAST` nothing is answered."""

    def reboot(self, servo_id: int) -> None:
        """Starts a servo anew, which is silent for a while then."""

    def sync_read(self, read: SyncRead) -> bytes:
        """The bytes of all servos, one after the other."""

    def sync_write(self, address: int, length: int, ids: bytes, written: bytes) -> None:
        """Sets `length` bytes of each servo; none answers, and what is refused is not seen.

        Raises:
            ValueError: Bytes that do not fit the ids.
        """

    def stop(self, address: int, length: int, ids: bytes, written: bytes) -> None:
        """Sets `length` bytes of each servo, whatever the line does and other threads have the bus do.

        It is sent three times. The first goes out at once, or after the few ms in which a call of another thread ends;
        the others each after the time that was left of an answer it may have collided with, at most `timeout_s`.

        Raises:
            ValueError: Bytes that do not fit the ids.
            OSError: None of them could be sent.
        """

    def close(self) -> None:
        """Gives the port back; any other call raises `ValueError` then."""

# -------------------------------------------------------------------------------------------- OpenHaptics

@final
class HdCallback:
    """What the scheduler of OpenHaptics calls: one frame of a device, in Rust and without the interpreter's lock.

    It exerts the newest force, and zero before the first one, once that is older than the watchdog's time, after an
    error until it is acknowledged, and in its last frame. Its memory is never given back.

    Args:
        functions: Addresses of hdMakeCurrentDevice, hdBeginFrame, hdEndFrame, hdGetDoublev, hdGetIntegerv, hdSetDoublev,
            hdGetError and hdCheckCalibration, in this order; any others end the process.
        device: Its handle.
        watchdog_s: 0.001 to 0.1 s.
        max_force_n: Longer forces are shortened to this.

    Raises:
        ValueError: An address of 0, or a number that cannot be.
    """

    def __new__(cls, functions: Sequence[int], device: int, *, watchdog_s: float, max_force_n: float) -> HdCallback: ...
    @property
    def address(self) -> int:
        """What hdScheduleAsynchronous is to call."""

    @property
    def context(self) -> int:
        """What it is to be called with."""

    @property
    def starved(self) -> int:
        """Frames without force because the newest one was too old."""

    def write(self, force: Sequence[float]) -> None:
        """The force in N from the next frame on, in the vendor's frame."""

    def wait(self, after: int, limit_s: float) -> tuple[int, list[float], list[float], int, int, int, int] | None:
        """The newest sample after a frame, as soon as there is one; none within the time.

        Returns:
            Number of the frame, transform (column by column, mm), velocity (mm/s), buttons, what hdCheckCalibration
            said, the first error since the last acknowledgement and its internal code.
        """

    def acknowledge(self) -> None:
        """Forgets the first error."""

    def end(self, limit_s: float) -> bool:
        """Has the next frame be the last, of zero force; whether that was within the time."""

# ---------------------------------------------------------------------------------------------- scenes

@final
class SceneRun:
    """What `simulate_scene` saw."""

    @property
    def signals(self) -> dict[str, npt.NDArray[Any]]:
        """Recorded signals by name, each with the first axis of `time_s`; empty where nothing is recorded.

        Signals with a value per axis have the shape `(n, axes)`, for one axis `(n,)`.
        """

    @property
    def events(self) -> list[tuple[float, str, str]]:
        """What happened, in the order of time: time in s, kind, detail."""

    @property
    def metrics(self) -> dict[str, float | int | bool | str | None]:
        """The figures of the run, by name; none where it does not apply or was not measured."""

    @property
    def reports(self) -> tuple[LoopReport, LoopReport] | None:
        """How the loops of master and slave went; none without an arm."""

@type_check_only
class _ResearchFactory(Protocol):
    """Makes the controllers in Python of a run or a sweep."""

    def make(self, name: str, options: str, axes: int, period_s: float) -> object: ...
    def spent(self, ticks: int, seconds: float) -> None: ...

def simulate_scene(
    scene_json: bytes,
    record: tuple[str | PathLike[str], str | PathLike[str]] | None = None,
    research: _ResearchFactory | None = None,
) -> SceneRun:
    """Runs a scene in virtual time, without the interpreter's lock but for a controller in Python.

    Args:
        scene_json: The scene as `haptether.bridge.scene_json` writes it: every field, nothing else.
        record: MCAP files for what `--record` of master and slave would write.
        research: Makes the controller of a scene with `[safety.research]`; without it such a scene is refused.

    Raises:
        ValueError: JSON that is no such scene, or a number that a part of it does not take; a file that cannot be written.
        RuntimeError: The controller in Python has raised; that is its cause.
    """

@final
class RecordingColumns:
    """What was read of a recording."""

    @property
    def about(self) -> dict[str, str]:
        """What the file says of itself: schema, side, security, version, scene; empty where it is no recording."""
    @property
    def meanings(self) -> dict[str, str]:
        """What each signal is, with its unit."""
    @property
    def columns(self) -> dict[str, npt.NDArray[Any] | tuple[list[str], npt.NDArray[np.uint8]]]:
        """One value a tick; of what has axes, shape `(n_ticks, axes)`. Null is NaN.

        Of names those that occur, and at each tick the place of that which it was.
        """
    @property
    def causes(self) -> list[bytes]:
        """Why the two sides were not coupled, as JSON, in the order of the file."""
    @property
    def begun_ns(self) -> int:
        """When the run began, in ns of the wall clock; 0 without a tick."""
    @property
    def whole(self) -> bool:
        """True if the file was read to its end."""
    @property
    def invalid(self) -> int:
        """Records, of ticks or others, that are not valid and were left out."""
    @property
    def damaged(self) -> bool:
        """True if reading ended at bytes that are no record, before the end of the file."""

def read_recording_columns(path: str | PathLike[str]) -> RecordingColumns:
    """Reads an MCAP file of `record=` as far as it goes, without the interpreter's lock.

    A message that does not fit is left out: no JSON, a signal of another kind or number of axes than before, a count
    beyond 64 bits, a time that is negative or not after the one before. What it takes of memory is bounded by a multiple of what it read.

    Raises:
        OSError: It cannot be read.
        ValueError: A recording whose chunks somebody compressed.
    """

def replay_recording(
    scene_json: bytes,
    signals: dict[str, npt.NDArray[Any]],
    times_ns: list[int],
    *,
    recouples: bool,
    hand: tuple[float, float, float] | None = None,
) -> dict[str, npt.NDArray[Any]]:
    """Steps the side of a hand through what was recorded of it.

    Args:
        scene_json: The scene with the settings, as for `simulate_scene`.
        signals: What was recorded at each tick, by the names of a recording; `past` as 0 kept, 1 stalled,
            2 acknowledged, and `grip`, whether the hand holds the device.
        times_ns: Times of the ticks since the run began, in ns.
        recouples: Whether the coupling requests anew of the force that was received.
        hand: M in kg, B in N s/m and K in N/m of a hand that answers to a force that was not recorded.

    Raises:
        ValueError: A scene that cannot be built, or a signal that is missing or of another length.
    """

def sweep_scenes(
    parts: list[tuple[bytes, list[tuple[str, _Array]]]],
    threads: int,
    lanes: bool,
    progress: Callable[[int], None] | None,
    research: _ResearchFactory | None = None,
    metrics: list[str] | None = None,
) -> list[dict[str, npt.NDArray[Any]]]:
    """Runs each scene once per row of its own, without the interpreter's lock. Threads and lanes change no number.

    Rows that differ in their controllers alone, of one scene or of several, are run once as long as none of these
    intervenes, which changes no number either. With a controller in Python there is one thread, and nothing is shared.

    Args:
        parts: Scenes as for `simulate_scene`, each with the numbers that differ between its rows: by their dotted path
            in the JSON ("operator.legs.0.end.0"), with one value per row; whole numbers for fields that count.
        threads: How many threads, 1 or more.
        lanes: Whether rows may be advanced side by side in one thread.
        progress: Called from time to time with the number of rows that are done; what it raises ends the sweep.
        research: Makes the controllers of a scene with `[safety.research]`, one a row; without it each row is refused.
        metrics: Names of the metrics to measure, of `METRICS`; by default all, those of rotation for poses only.

    Returns:
        Of each scene how its rows ended, the metrics, and why a row was refused or diverged, by name, one value per
        row; NaN where a metric does not apply or was not measured.

    Raises:
        ValueError: A metric that there is not; JSON that is no scene; columns of different lengths, or a path that is
            not there.
        RuntimeError: A controller in Python has raised; that is its cause.
    """
