"""Faults of the machine under a side: a full disk, and a wall clock that is set."""

import os
import shutil
import subprocess
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
from tests.faults.processes import Judged, Limits, again
from tests.faults.rows import Row
from tests.faults.running import PRESSED_S, Recorded, Stage
from tests.faults.signals import ENGAGED, NAMES, Ticks

DISK_KIB = 512
"""Size of the full disk, in KiB: a second of a recording."""
FULL_DISK = f"full disk: {DISK_KIB} KiB tmpfs under the recordings of both sides"
WALL_CLOCK = "wall clock of both sides set: +1 h, then -2 h"
STEPPED_S = 4.2
"""Time from the start of a process until its wall clock has been set twice (`wall_step.c`), in s."""


def mount_namespace() -> tuple[str, ...] | None:
    """Return a command prefix for an own mount namespace, also without root; None if unavailable."""
    if shutil.which("unshare") is None:
        return None
    within = ("unshare", "--map-root-user", "--mount", "sh", "-c")
    tried = subprocess.run([*within, "mount -t tmpfs tmpfs /mnt"], capture_output=True, timeout=10, check=False)
    return within if tried.returncode == 0 else None


def full_disk(limits: Limits) -> Row:
    """Fill the disk of the recordings; other disks of the machine have room."""
    name = FULL_DISK
    within = mount_namespace()
    if within is None:
        return Row(fault=name, how="-", expected="-", measured="no leave to mount a tmpfs here", applies=False)
    with Stage.set() as stage:
        disks = {side: stage.path(f"disk-{side}") for side in ("slave", "master")}
        for disk in disks.values():
            disk.mkdir()
        # The shell replaces itself with the command, so that signals reach the command.
        mounted = {
            side: (*within, f'mount -t tmpfs -o size={DISK_KIB}k tmpfs "$0" && exec "$@"', str(disk))
            for side, disk in disks.items()
        }
        slave = stage.slave("slave", record=disks["slave"] / "full.mcap", within=mounted["slave"])
        master = stage.master(
            slave.address, "master", "--trace", str(stage.path("master.npz")), record=disks["master"] / "full.mcap",
            within=mounted["master"],
        )  # fmt: skip
        time.sleep(PRESSED_S + 1.5)
        stage.end_together(slave, master)
        reports = {side: stage.report(side) for side in disks}
        traced = _traced(stage.path("master.npz"))
    judged = Judged(limits)
    judged.never_held(traced.before_end())
    for side, report in reports.items():
        link = report["link"]
        judged.wrong.check(link["recording_end"] is not None, f"{side}: the recording never ended")
        judged.wrong.check(link["unrecorded"] > 500, f"{side}: {link['unrecorded']} records not taken")
        judged.wrong.check(report["ticks"] > 2_500, f"{side}: {report['ticks']} ticks")
        judged.say(f"{side}: {link['recorded']} records, {link['unrecorded']} counted as lost")
    judged.say(f"ended: {reports['slave']['link']['recording_end']}; no hold")
    return judged.row(name, "recording ends, losses counted; control goes on")


def _traced(path: Path) -> Recorded:
    with np.load(path) as arrays:
        ticks = Ticks(
            time_s=arrays["time_s"], state=arrays["state"].astype(np.int64), age_s=arrays["age_s"],
            output=arrays["device_force"],
        )  # fmt: skip
        return Recorded(
            ticks=ticks, reasons=[""] * len(ticks.time_s), overshoot_s=[float(late) for late in arrays["overshoot_s"]]
        )


def wall_clock(limits: Limits) -> Row:
    """Set the wall clock of two processes; the clock of the machine stays untouched."""
    name = WALL_CLOCK
    compiler = shutil.which(os.environ.get("CC", "cc"))
    if compiler is None:
        return Row(fault=name, how="-", expected="-", measured="no C compiler", applies=False)
    with Stage.set() as stage:
        library = stage.path("wall_step.so")
        source = Path(__file__).with_name("wall_step.c")
        subprocess.run([compiler, "-shared", "-fPIC", "-O1", "-o", library, source, "-ldl"], timeout=60, check=True)
        stepped = {**os.environ, "LD_PRELOAD": str(library)}
        slave = stage.slave(environment=stepped)
        master = stage.master(slave.address, environment=stepped)
        loaded = [library.name in Path(f"/proc/{one.process.pid}/maps").read_text() for one in (slave, master)]
        time.sleep(max(PRESSED_S, master.begun_s + STEPPED_S - time.monotonic()))
        stage.end_together(slave, master)
        sides = [stage.ticks("slave").before_end(), stage.ticks("master").before_end()]
    judged = Judged(limits)
    judged.never_held(*sides)
    judged.slave(sides[0])
    judged.wrong.check(all(loaded), "the clock was not set: the library was not loaded")
    for side in sides:
        step_s = np.diff(side.ticks.time_s)
        judged.wrong.check(step_s.min() > 0.0, "time ran backwards in a recording")
        judged.wrong.check(step_s.max() < 0.1, f"{step_s.max():g} s between two ticks")
    widest_s = max(float(np.diff(side.ticks.time_s).max()) for side in sides)
    judged.say(f"{NAMES[ENGAGED]} all the time; {widest_s * 1e3:.0f} ms between two ticks at most")
    return judged.row(name, "nothing")


def rows(limits: Limits | None = None) -> dict[str, Callable[[], Row]]:
    """Return all rows by name, to run one after the other."""
    bounds = limits or Limits()
    measures = {FULL_DISK: full_disk, WALL_CLOCK: wall_clock}
    return {fault: again(partial(measure, bounds), fault) for fault, measure in measures.items()}
