"""Demonstration of pick, turn and place with a full hand, as processes on one machine."""

import contextlib
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import load_scene, read_recording, write_key
from haptether.studies.leader import LEADER_S, led_leader
from haptether.studies.processes import (
    END_TIMEOUT_S,
    START_TIMEOUT_S,
    StopRequest,
    child_process,
    emulated_ur,
    slave_behind,
    until_ended,
)
from haptether.view.style.colours import SIGNALS
from haptether.view.style.figure import Columns, letter, new_figure, styled, write_figure
from haptether.view.style.legend import legend_above

SCENE = "ur_pick"
CARRIED_M = 0.1
"""Sideways distance in m that the scene's hand carries the object."""
TURNED_RAD = 1.0471975511965976
WITHIN_M = 2e-3
"""Largest position error of the arm in m, after it has come to rest."""
WITHIN_RAD = 0.02


class PickScene(msgspec.Struct, frozen=True, kw_only=True):
    """Course of the demonstration."""

    delay_s: float = 0.02
    jitter_s: float = 0.001
    loss: float = 0.01
    seed: int = 1
    slave: Literal["simulated", "ur"] = "ur"
    """Simulated arm, or an emulated UR controller with a Robotiq gripper, driven by the vendor's client library."""
    master: Literal["simulated", "dynamixel"] = "simulated"
    """Simulated device, or an emulated Dynamixel leader arm with a scripted hand."""


class PickResult(msgspec.Struct, frozen=True, kw_only=True):
    """Motion of arm and gripper, from the slave's recording."""

    grips: int
    """Number of times that the gripper gripped an object."""
    carried_m: float
    """Sideways distance while it held the object."""
    turned_rad: float
    """Rotation while it held the object."""
    lifted_m: float
    """Height while it held the object."""
    open_at_end: bool
    """True if the gripper had released the object at the end."""
    holds: int
    """Number of times that the sides decoupled."""
    final_state: str
    """Final state of the slave's ladder."""

    @property
    def is_done(self) -> bool:
        """True if the object was gripped once, carried and turned like the hand, and placed."""
        near = abs(self.carried_m - CARRIED_M) < WITHIN_M and abs(self.turned_rad - TURNED_RAD) < WITHIN_RAD
        return self.grips == 1 and self.open_at_end and near and self.holds == 0


def run_pick(scene: PickScene, folder: Path, show: Callable[[str, float], None], stopped: StopRequest) -> PickResult:
    """Run slave, network and master once, and return the arm's motion; arguments as for `run_demo`.

    Raises:
        Interrupted: A stop was requested; all processes have ended.
        RuntimeError: A process failed; the message contains its output.
    """
    duration_s = load_scene(SCENE).run.duration_s
    # Counted from each process's start, because the others may start slowly.
    limit = str(duration_s + 5 * START_TIMEOUT_S + END_TIMEOUT_S)
    recording, trace = folder / "pick.mcap", folder / "pick.npz"
    with contextlib.ExitStack() as stack:
        show("starting", 0.0)
        key = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "pick.key"
        write_key(key)
        arm = _ur_arm(limit, stack, stopped) if scene.slave == "ur" else SIMULATED
        slave, address = slave_behind(
            scene, limit, stack, stopped, "--scene", SCENE, "--key", str(key), "--record", str(recording), "--force",
            "--min-free-bytes", "0", *arm,
        )  # fmt: skip
        leader = None if scene.master == "simulated" else led_leader(limit, stack, stopped)
        if leader is not None:
            leader.prepare(duration_s)
        led = () if leader is None else leader.options
        # The driver's checklist and the rise of its torque precede the hand's path.
        lasts_s = duration_s + (0.0 if leader is None else LEADER_S)
        master = stack.enter_context(child_process(
            "master", "--scene", SCENE, "--peer", address, "--listen", "127.0.0.1:0", "--key", str(key),
            "--duration-s", str(lasts_s), "--trace", str(trace), "--force", *SIMULATED, *led,
        ))  # fmt: skip
        master.headline(stopped)
        if leader is not None:
            leader.lead(stopped)
        stage = "the hand leads arm and gripper"
        until_ended(master, lasts_s, lambda at_s: show(stage, min(at_s, duration_s)), stopped)
        if master.process.returncode != 0:
            raise RuntimeError(master.failure(slave))
        # The recording is complete once the slave has ended.
        slave.end()
        signals = read_recording(recording).signals
    return picked(signals)


SIMULATED = ("--set", "slave.device=simulated", "--set", "slave.options={}", "--set", "slave.gripper.device=simulated",
             "--set", "slave.gripper.options={}")  # fmt: skip


def _ur_arm(limit: str, stack: contextlib.ExitStack, stopped: StopRequest) -> tuple[str, ...]:
    """Start an emulated controller with a gripper for `limit` s; return the slave's options."""
    gripper = ("--gripper", "2f-85", "--gripper-object-mm", "40", "--gripper-active")
    host = emulated_ur(limit, stack, stopped, *gripper)
    return ("--set", f"slave.options.host={host}", "--set", f"slave.gripper.options.host={host}")


def angles(quat_wxyz: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return the rotation angle in rad of each orientation, shape `(n, 4)`, relative to the first."""
    between: npt.NDArray[np.float64] = np.abs(quat_wxyz @ quat_wxyz[0])
    return np.asarray(2.0 * np.arccos(np.minimum(between, 1.0)))


def picked(signals: dict[str, npt.NDArray[Any]]) -> PickResult:
    """Return the result from the slave's recording."""
    held = signals["holds_object"].astype(bool)
    position = signals["position"]
    begins = int(np.count_nonzero(held[1:] & ~held[:-1])) + int(held[0])
    states = signals["state"].tolist()
    carried, turned, lifted = 0.0, 0.0, 0.0
    if held.any():
        from_there = position[held] - position[held][0]
        carried = float(np.hypot(from_there[-1, 0], from_there[-1, 1]))
        lifted = float(from_there[:, 2].max())
        turned = float(angles(signals["orientation"][held])[-1])
    holds = sum(now == "hold" and before in {"engaged", "stale"} for before, now in pairwise(states))
    # The end of the master does not count as a decoupling.
    ended = sum("ended" in reason for reason in set(signals["reason"].tolist()))
    return PickResult(
        grips=begins,
        carried_m=carried,
        turned_rad=turned,
        lifted_m=lifted,
        open_at_end=not held[-1],
        holds=max(0, holds - ended),
        final_state=states[-1],
    )


def draw_pick(scene: PickScene, folder: Path, path: Path, columns: Columns = 2) -> None:
    """Draw height, sideways motion, rotation and gripper of hand and arm over time.

    Args:
        scene: Scene of the run.
        folder: Folder with the files of `run_pick`.
        path: Target picture, .png, .pdf or .svg.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
    """
    far = read_recording(folder / "pick.mcap").signals
    with np.load(folder / "pick.npz") as arrays:
        near = {name: arrays[name] for name in ("time_s", "position", "orientation", "trigger", "state")}
    far_s = far["time_ns"] * 1e-9
    # The sides have separate clocks, so align them at the engagement.
    far_s = far_s - far_s[np.flatnonzero(np.isin(far["state"], ("engaged", "stale")))[0]]
    near_s = near["time_s"] - near["time_s"][np.flatnonzero(near["state"] == 2)[0]]
    arm = "an emulated UR5e with a 2F-85" if scene.slave == "ur" else "a model"
    at = int(np.flatnonzero(far_s >= 0.0)[0])
    rows = (
        ("height [m]", near["position"][:, 2], far["position"][:, 2] - far["position"][at, 2]),
        ("aside [m]", near["position"][:, 1], far["position"][:, 1] - far["position"][at, 1]),
        ("turned [deg]", np.degrees(angles(near["orientation"])), np.degrees(angles(far["orientation"]))),
        ("gripper", near["trigger"], far["gripper"]),
    )
    held = far["holds_object"].astype(bool)
    with styled():
        title = (
            f"Something is picked up, turned and put down by {arm},\n"
            f"{scene.delay_s * 1e3:g} ms (σ {scene.jitter_s * 1e3:g} ms) and {scene.loss:.1%} loss each way"
        )
        figure = new_figure(columns, 5.4, title)
        panels = figure.subplots(4, 1, sharex=True)
        for panel, (label, hand, tool) in zip(panels, rows, strict=True):
            names = ("trigger", "jaws") if label == "gripper" else ("hand", "arm")
            panel.plot(near_s, hand, label=names[0], color=SIGNALS["hand"])
            panel.plot(far_s, tool, label=names[1], color=SIGNALS["arm"], ls="--")
            panel.fill_between(far_s, 0.0, 1.0, where=held.tolist(), color="#e3e6ea", lw=0.0, zorder=0.5,
                               transform=panel.get_xaxis_transform(), label="holds something")  # fmt: skip
            panel.set_ylabel(label)
            legend_above(panel)
        panels[3].set_xlabel("time since engagement [s]")
        panels[3].set_xlim(0.0, float(near_s[-1]))
        letter(panels)
        figure.align_ylabels(list(panels))
    write_figure(figure, path)
