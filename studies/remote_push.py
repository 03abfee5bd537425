"""Effect of a remote push on a hand: figures of `haptether master` and `haptether demo`."""

from pathlib import Path

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import LoopReport, MasterTrace, ladder_state_name
from haptether.private_file import private_file, refuse_link
from haptether.safety import fault_message

TRACE_SIGNALS = (
    "time_s",
    "position",
    "velocity",
    "hand_force",
    "rendered_force",
    "grasp_force",
    "safety_force",
    "device_force",
    "velocity_force",
    "grasp",
    "windowed_energy_j",
    "tripped",
    "acted",
    "state",
    "age_s",
    "round_trip_s",
    "overshoot_s",
    "fault",
)
FINGER_SIGNALS = (
    "trigger_velocity", "trigger_rendered_force", "trigger_safety_force", "trigger_device_force", "trigger_tripped",
)  # fmt: skip
"""Additional signals of a trigger with force feedback."""
ROTATION_SIGNALS = (
    "orientation", "angular_velocity", "hand_torque", "rendered_torque", "grasp_torque", "safety_torque",
    "device_torque",
)  # fmt: skip
"""Additional signals of a trace of kind "pose"."""


class PushResult(msgspec.Struct, frozen=True, kw_only=True):
    """One run of a master. Times in s, forces in N, speeds in m/s; None if not applicable or not measured."""

    controller: str
    security: str
    """"secure", or "insecure" for unencrypted frames."""
    engaged_s: float | None
    """Time of engagement since the start."""
    release_s: float | None
    """Time of the release since the start; None without a release."""
    peak_hand_speed: float | None
    """Largest speed away from the wall after the release, or over the run without a planned release."""
    peak_force_n: float | None
    """Largest device force."""
    time_to_trip_s: float | None
    """Time from the release to the first intervention after it; 0 if one was active."""
    trips_before_release: int | None
    """Interventions that began while the hand held."""
    intervention_s: float | None
    """Time under intervention."""
    sent: int
    lost: int
    """Frames of the slave that never arrived."""
    late: int
    """Frames of the slave that arrived after a newer one."""
    refused: int
    """Datagrams that were not of the slave."""
    round_trip_s: float | None
    """Round trip of the latest echo."""
    overshoot_p50_s: float
    overshoot_p99_s: float
    """Lateness of the loop's wakes."""
    ticks: int
    skipped_ticks: int
    holds: int
    """Number of silences of the slave above 20 ms."""
    outliers: int
    """Samples that left their path and were replaced."""
    dropped_records: int
    """Ticks missing in these figures, because only the last ones of a run are kept."""
    unsent: int
    """Frames that the system refused to send."""
    force_at_release_n: float | None
    """Device force at the release; None without a release."""
    final_state: str
    fault: str | None
    """Reason of the state `fault`."""
    renewal: float | None = None
    """Share of the ticks with a new sample of the driver's device, as last measured over a motion."""


def _along(signal: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return a signal of one axis, or the norm of several axes."""
    return signal if signal.ndim == 1 else np.sqrt((signal**2).sum(axis=1))


def measure_push(controller: str, trace: MasterTrace, report: LoopReport, release_after_s: float | None) -> PushResult:
    """Measure a run of a master.

    Args:
        controller: Name of the controller set, for the result.
        trace: Ticks of the master.
        report: Report of its loop.
        release_after_s: Time of the release in s after engagement; None without a release.
    """
    time_s, velocity, force = trace.time_s, _along(trace.velocity), _along(trace.device_force)
    on = trace.tripped > 0
    period_s = float(time_s[-1]) / max(len(trace) - 1, 1) if len(trace) else 0.0
    engaged_s = report.engaged_s if np.isfinite(report.engaged_s) else None
    release_s = None
    if engaged_s is not None and release_after_s is not None:
        release_s = engaged_s + release_after_s
    begins = on & ~np.concatenate([[False], on[:-1]]) if len(trace) else on
    after = time_s >= (release_s if release_s is not None else 0.0)
    tripped_at = time_s[after & on]
    engaged = engaged_s is not None and len(trace) > 0
    before = ~after if release_s is not None else np.ones_like(after)
    trips = int(np.count_nonzero(begins & before))
    return PushResult(
        controller=controller,
        security="secure" if report.secure else "insecure",
        engaged_s=engaged_s,
        release_s=release_s,
        peak_hand_speed=float(velocity[after].max()) if engaged and after.any() else None,
        peak_force_n=float(np.abs(force).max()) if engaged else None,
        time_to_trip_s=(float(tripped_at[0]) - release_s if release_s is not None and tripped_at.size else None),
        trips_before_release=trips if engaged else None,
        intervention_s=float(np.count_nonzero(on)) * period_s if engaged else None,
        sent=report.link.sent,
        lost=report.link.missing,
        late=report.link.late,
        refused=report.link.refused,
        # The link reports 0 before the first echo.
        round_trip_s=report.link.round_trip_s or None,
        overshoot_p50_s=float(np.percentile(trace.overshoot_s, 50)) if len(trace) else 0.0,
        overshoot_p99_s=float(np.percentile(trace.overshoot_s, 99)) if len(trace) else 0.0,
        ticks=report.ticks,
        skipped_ticks=report.skipped,
        holds=report.holds,
        outliers=report.outliers,
        renewal=report.renewal,
        dropped_records=report.dropped_records,
        unsent=report.unsent,
        force_at_release_n=(float(force[after][0]) if release_s is not None and after.any() else None),
        final_state=ladder_state_name(int(trace.state[-1])) if len(trace) else "disengaged",
        fault=fault_message(int(trace.fault[-1])) if len(trace) else None,
    )


def save_master_trace(trace: MasterTrace, path: Path) -> None:
    """Write every signal of a run as an array of a NumPy `.npz` file with mode 0600.

    Raises:
        OSError: The file cannot be written, or is a symbolic link.
    """
    refuse_link(path)
    signals = {name: getattr(trace, name) for name in TRACE_SIGNALS}
    if np.isfinite(trace.trigger).any():
        signals["trigger"] = trace.trigger
    if trace.orientation is not None:
        signals |= {name: getattr(trace, name) for name in ROTATION_SIGNALS}
    if trace.trigger_velocity is not None:
        signals |= {name: getattr(trace, name) for name in FINGER_SIGNALS}
    with private_file(path) as file:
        np.savez_compressed(file, **signals)
