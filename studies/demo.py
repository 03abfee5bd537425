"""Demonstration: slave, network and master as processes, once per controller."""

import contextlib
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from haptether.bridge import COUPLINGS, load_scene, write_key
from haptether.studies.design.gains import pressed_couplings
from haptether.studies.processes import (
    END_TIMEOUT_S,
    START_TIMEOUT_S,
    StopRequest,
    child_process,
    emulated_ur,
    slave_behind,
    until_ended,
)
from haptether.studies.remote_push import PushResult
from haptether.view.style.colours import controller_look, controller_title
from haptether.view.style.events import EventMark, name_events
from haptether.view.style.figure import Columns, letter, new_figure, styled, write_figure
from haptether.view.style.legend import legend_beside

SCENE = "remote_push"
"""Scene of pair and wall for a coupling or an arm of its own."""
UP_TO_S = 1.0
"""Largest round trip in s for which gains are examined."""
DEMO_CONTROLLERS = ("none", "vfc", "hsc", "wsc")
"""Controllers of the demonstration, a run each."""


class DemoScene(msgspec.Struct, frozen=True, kw_only=True):
    """Course of the demonstration. Times in s since engagement.

    Wall and grip keep the delayed loop stable for any delay while the hand holds: the wall's 100 N/m is below the
    smallest impedance of the hand, min |K_h - m w^2 + j w B_h| = 284 N/m (small gain).
    """

    delay_s: float = 0.05
    jitter_s: float = 0.005
    loss: float = 0.01
    seed: int = 1
    wall_stiffness: float = 100.0
    depth: float = 0.045
    push_at_s: float = 1.6
    push_force_n: float = 3.5
    push_duration_s: float = 2.0
    release_at_s: float = 2.6
    duration_s: float = 3.6
    slave: Literal["simulated", "ur"] = "simulated"
    """Simulated arm, or an emulated UR controller driven by the vendor's client library."""
    coupling: str = "position-force"
    gains: tuple[str, ...] = ()
    """Overrides that set the coupling with its gains; none for position-force."""


def with_coupling(scene: DemoScene, coupling: str) -> DemoScene:
    """Return the demonstration under a coupling, with gains that its pair bears over its link.

    Raises:
        ValueError: An unknown coupling, or no gains are stable over the link.
    """
    if coupling not in (names := [name for name, *_ in COUPLINGS]):
        message = f"coupling = {coupling!r}: must be one of {', '.join(names)}"
        raise ValueError(message)
    links = [
        f"link.{way}.{key}={value!r}"
        for way in ("forward", "backward")
        for key, value in (("delay_s", scene.delay_s), ("jitter_s", scene.jitter_s), ("loss", scene.loss))
    ]
    pair = load_scene(SCENE, [*links, f"environment.objects.0.contact.stiffness={scene.wall_stiffness}"])
    found = next(pressed_couplings(pair, UP_TO_S, (coupling,)), None)
    if found is None:
        message = f"coupling = {coupling}: no gains are stable over {2.0 * scene.delay_s * 1e3:g} ms"
        raise ValueError(message)
    return msgspec.structs.replace(scene, coupling=coupling, gains=found.changes)


def run_demo(
    scene: DemoScene,
    controller: str,
    folder: Path,
    show: Callable[[str, float], None],
    stopped: StopRequest,
) -> PushResult:
    """Run the three processes once and return the master's measurements.

    Args:
        scene: Course of the demonstration.
        controller: Safety controller of the master.
        folder: Target folder of `CONTROLLER.npz` and `CONTROLLER.json`.
        show: Called with the stage and the time in s.
        stopped: Polled; a stop ends all processes.

    Raises:
        Interrupted: A stop was requested; all processes have ended.
        RuntimeError: A process failed; the message contains its output.
    """
    # Counted from each process's start, because the others may start slowly.
    limit = str(scene.duration_s + 3 * START_TIMEOUT_S + END_TIMEOUT_S)
    with contextlib.ExitStack() as stack:
        show(f"{controller}: starting", 0.0)
        key = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "demo.key"
        write_key(key)
        if scene.slave == "ur":
            arm = _ur_arm(scene, limit, stack, stopped)
        else:
            arm = _far(scene) if scene.gains else _simulated_arm(scene)
        slave, address = slave_behind(scene, limit, stack, stopped, "--key", str(key), *arm)
        result, trace = folder / f"{controller}.json", folder / f"{controller}.npz"
        result.unlink(missing_ok=True)
        master = stack.enter_context(child_process(
            "master", "--peer", address, "--listen", "127.0.0.1:0", "--key", str(key), *_hand(scene, controller),
            "--clutch", "auto", "--duration-s", str(scene.duration_s), "--json", str(result), "--trace", str(trace),
            "--force",
        ))  # fmt: skip
        master.headline(stopped)

        def each(at_s: float) -> None:
            if at_s < scene.push_at_s:
                stage = "the hand presses the remote wall"
            elif at_s < scene.release_at_s:
                stage = "the arm is shoved"
            else:
                stage = "the hand has let go"
            show(f"{controller}: {stage}", min(at_s, scene.duration_s))

        until_ended(master, scene.duration_s, each, stopped)
        if master.process.returncode != 0 or not result.exists():
            raise RuntimeError(master.failure(slave))
        return msgspec.json.decode(result.read_bytes(), type=PushResult)


def _hand(scene: DemoScene, controller: str) -> tuple[str, ...]:
    """Return the master's options for hand, controller and coupling."""
    if not scene.gains:
        return "--controller", controller, "--depth", str(scene.depth), "--release-at-s", str(scene.release_at_s)
    return _of_scene(
        *scene.gains,
        f"safety.controllers=[{'' if controller == 'none' else controller}]",
        f"operator.legs.0.end={-scene.depth}",
        f"operator.release.at_s={scene.release_at_s}",
    )


def _far(scene: DemoScene) -> tuple[str, ...]:
    """Return the slave's options for wall, push and coupling."""
    return _of_scene(
        *scene.gains,
        f"environment.objects.0.contact.stiffness={scene.wall_stiffness}",
        f"environment.pushers.0.at_s={scene.push_at_s}",
        f"environment.pushers.0.force_n={scene.push_force_n}",
        f"environment.pushers.0.duration_s={scene.push_duration_s}",
    )


def _of_scene(*changes: str) -> tuple[str, ...]:
    return ("--scene", SCENE, *(word for change in changes for word in ("--set", change)))


def _simulated_arm(scene: DemoScene) -> tuple[str, ...]:
    """Return the slave's options for the simulated arm."""
    return (
        "--wall-stiffness", str(scene.wall_stiffness), "--push-at-s", str(scene.push_at_s),
        "--push-force-n", str(scene.push_force_n), "--push-duration-s", str(scene.push_duration_s),
    )  # fmt: skip


def _ur_arm(scene: DemoScene, limit: str, stack: contextlib.ExitStack, stopped: StopRequest) -> tuple[str, ...]:
    """Start an emulated controller for `limit` s with wall and push at its tool; return the slave's options."""
    far = _far(scene)
    host = emulated_ur(limit, stack, stopped, *far)
    return (
        *far, "--set", "slave.device=ur", "--set", f"slave.options.host={host}", "--set", "slave.period_s=0.002",
    )  # fmt: skip


def draw_demo(scene: DemoScene, results: Sequence[PushResult], folder: Path, path: Path, columns: Columns = 2) -> None:
    """Draw hand velocity, device force and position of every run from the traces in `folder`.

    Args:
        scene: Course of the demonstration.
        results: One result per controller.
        folder: Folder with the files of the runs.
        path: Target picture, .png, .pdf or .svg.
        columns: Width in page columns.

    Raises:
        ImportError: matplotlib (`haptether[analysis]`) is not installed.
        ValueError: The picture has another suffix.
    """
    signals = ("velocity", "device_force", "position")
    labels = ("hand velocity [m/s]", "force on the hand [N]", "hand position [m]")
    title = (
        f"A remote push reaches a hand that lets go: {scene.delay_s * 1e3:g} ms (σ {scene.jitter_s * 1e3:g} ms) "
        f"each way, {scene.loss:.1%} loss"
        + (", emulated UR5e" if scene.slave == "ur" else "")
        + (f", {scene.coupling}" if scene.gains else "")
    )
    with styled():
        figure = new_figure(columns, 3.0 if columns == 2 else 5.6, title if columns == 2 else title.replace(": ", "\n"))
        panels = list(figure.subplots(1, 3) if columns == 2 else figure.subplots(3, 1, sharex=True))
        for result in results:
            with np.load(folder / f"{result.controller}.npz") as arrays:
                trace = {signal: arrays[signal] for signal in ("time_s", *signals)}
            time_s = trace["time_s"] - (result.release_s or 0.0)
            shown = (time_s > -1.0) & (time_s < 0.8)
            for panel, signal in zip(panels, signals, strict=True):
                panel.plot(time_s[shown], trace[signal][shown], label=controller_title(result.controller),
                           **controller_look(result.controller))  # fmt: skip
        for panel, label in zip(panels, labels, strict=True):
            panel.set_ylabel(label)
            panel.set_xlim(-1.0, 0.8)
            if panel in (panels if columns == 2 else panels[-1:]):
                panel.set_xlabel("time since the hand let go [s]")
        legend_beside(figure, panels[0].get_legend_handles_labels()[0])
        letter(panels)
        marks = [EventMark(scene.push_at_s - scene.release_at_s, "arm shoved"), EventMark(0.0, "lets go")]
        if columns == 2:
            for panel in panels:
                name_events([panel], marks, 2.0)
        else:
            name_events(panels, marks, 2.0)
    write_figure(figure, path)
