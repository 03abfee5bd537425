"""Real time, the interpreter's lock and recordings of live loops: the subject is the operating system."""

import os
import secrets
import shutil
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, TypedDict, Unpack

import numpy as np
import pytest
from tests.scene.two_sides import two_sides

from haptether.bridge import (
    LiveMaster,
    LiveSlave,
    LoopReport,
    MasterLoop,
    MasterTrace,
    load_scene,
    read_recording,
    scene_json,
)

pytestmark = pytest.mark.alone

PERIOD_S = 1e-3
BUSY_S = 4.0


class Options(TypedDict, total=False):
    """Requests of a loop."""

    realtime: str
    priority: int
    cpu: int
    record: Path
    min_free_bytes: int


@pytest.fixture
def peer() -> Iterator[str]:
    """Yield the address of a socket that nobody reads."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sink:
        sink.bind(("127.0.0.1", 0))
        yield f"127.0.0.1:{sink.getsockname()[1]}"


def start(peer: str, patience_s: float | None = None, **options: Unpack[Options]) -> LiveMaster:
    scene = scene_json(two_sides(operator={"clutch": []}))
    return LiveMaster(scene, peer=peer, run_id=1, insecure=True, patience_s=patience_s, **options)


def run_for(peer: str, seconds: float, **options: Unpack[Options]) -> tuple[MasterTrace, LoopReport]:
    master = start(peer, seconds, **options)
    while not master.finished:
        time.sleep(0.01)
    return master.finish()


def loop_threads() -> list[int]:
    """Return the kernel's numbers of this process's loop threads."""
    tasks = Path("/proc/self/task")
    return [int(task.name) for task in tasks.iterdir() if (task / "comm").read_text().strip() == "haptether-loop"]


# Real time


@pytest.mark.parametrize("demand", ["auto", "off"])
def test_the_report_is_what_the_kernel_says(peer: str, demand: str) -> None:
    master = start(peer, realtime=demand, priority=7)
    (thread,) = loop_threads()
    policy, priority = os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority
    said = master.realtime
    _, report = master.finish()
    assert report.realtime == said
    assert report.is_realtime == (policy == os.SCHED_FIFO)
    assert ("SCHED_FIFO 7" in said) == (policy == os.SCHED_FIFO and priority == 7)
    if demand == "off":
        assert said == "off: ordinary scheduling"
        assert policy == os.SCHED_OTHER


def test_memory_is_locked_while_a_loop_runs(peer: str) -> None:
    def locked_kib() -> int:
        (line,) = [line for line in Path("/proc/self/status").read_text().splitlines() if line.startswith("VmLck")]
        return int(line.split()[1])

    first, second = start(peer), start(peer)
    is_locked = "memory locked" in first.realtime
    first.finish()
    assert (locked_kib() > 0) == is_locked, "the second still runs"
    second.finish()
    assert locked_kib() == 0


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"realtime": "please"}, 'realtime = "please": must be "auto", "off" or "require"'),
        ({"priority": 0}, "priority = 0: must be 1 to 99"),
        ({"priority": 100}, "priority = 100: must be 1 to 99"),
        ({"realtime": "off", "cpu": 0}, "cpu: must not be given"),
    ],
)
def test_what_cannot_be_asked_for_is_refused(peer: str, options: Options, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        start(peer, **options)


def test_a_processor_that_is_not_there_is_refused_politely_or_not(peer: str) -> None:
    _, report = run_for(peer, 0.05, cpu=1023)
    assert "refused (the processor: Invalid argument" in report.realtime
    with pytest.raises(OSError, match="real time is required: refused"):
        start(peer, cpu=1023, realtime="require")


def test_a_refused_start_of_a_driver_closes_its_recording(peer: str, tmp_path: Path) -> None:
    scene = scene_json(two_sides(operator={"clutch": []}))
    record = tmp_path / "hand.mcap"
    loop = MasterLoop(scene, peer=peer, run_id=1, insecure=True, record=record, cpu=1023, realtime="require")
    with pytest.raises(OSError, match="real time is required: refused"):
        loop.begin()
    _, report = loop.finish()
    assert report.recording is not None
    assert "refused (the processor" in report.realtime
    assert read_recording(record).whole


@pytest.mark.skipif(os.geteuid() != 0 or shutil.which("setpriv") is None, reason="takes rights away from root")
@pytest.mark.parametrize("demand", ["auto", "require"])
def test_without_the_right_it_says_so_and_goes_on_unless_required(demand: str) -> None:
    ended = subprocess.run(
        [
            "setpriv", "--bounding-set", "-sys_nice,-ipc_lock", sys.executable, "-m", "haptether", "master",
            "--insecure", "--peer", "127.0.0.1:9", "--patience-s", "0.2", "--realtime", demand,
        ],
        capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    assert ended.returncode == 1, "nobody answers there"
    assert "SCHED_FIFO needs CAP_SYS_NICE" in ended.stderr
    assert "locked memory needs CAP_IPC_LOCK" in ended.stderr
    assert ("real time is required" in ended.stderr) == (demand == "require")
    assert ("no slave answered" in ended.stderr) == (demand == "auto")


# The interpreter's lock


def test_a_thread_that_holds_the_interpreter_does_not_hold_the_loop(peer: str) -> None:
    master = start(peer)
    began = time.monotonic()
    held_s = 0.0
    while held_s < 0.3:
        # One call into C that keeps all other threads out of Python.
        before = time.monotonic()
        sum(range(30_000_000))
        held_s = max(held_s, time.monotonic() - before)
        if time.monotonic() - began > 5.0:
            break
    trace, report = master.finish()
    assert report.ticks > 100
    # A loop that needed the interpreter would be as late as this call takes; the machine itself may be busy.
    assert float(trace.overshoot_s.max()) < max(0.1, 0.5 * held_s)


def test_the_collector_of_garbage_does_not_hold_the_loop(peer: str) -> None:
    import gc

    heap = [[number] for number in range(2_000_000)]
    master = start(peer)
    longest_s = 0.0
    for _ in range(5):
        before = time.monotonic()
        gc.collect()
        longest_s = max(longest_s, time.monotonic() - before)
    busy = threading.Thread(target=lambda: [number**2 for number in range(2_000_000)])
    busy.start()
    busy.join()
    trace, report = master.finish()
    assert len(heap) == 2_000_000
    assert report.ticks > 100
    assert float(trace.overshoot_s.max()) < max(0.1, longest_s)


# Recordings


def test_a_recording_holds_every_tick(peer: str, tmp_path: Path) -> None:
    path = tmp_path / "run.mcap"
    trace, report = run_for(peer, 0.5, record=path, min_free_bytes=0)
    assert report.recording is not None
    assert (report.recording.written, report.recording.dropped, report.recording.end) == (report.ticks, 0, None)
    recording = read_recording(path)
    assert (recording.side, recording.security, recording.whole) == ("master", "insecure", True)
    signals = recording.signals
    assert len(signals["time_ns"]) == report.ticks == len(trace)
    np.testing.assert_array_equal(signals["time_ns"] * 1e-9, trace.time_s)
    np.testing.assert_array_equal(signals["position"][:, 0], trace.position)
    np.testing.assert_array_equal(signals["overshoot_s"], trace.overshoot_s)
    assert np.isnan(signals["age_s"]).all()
    assert set(signals["state"]) == {"disengaged"}
    assert set(signals["security"]) == {"insecure"}
    assert recording.meanings["rendered_force"] == "F_v in N"


def test_what_is_no_recording_is_refused(tmp_path: Path) -> None:
    (tmp_path / "other.mcap").write_bytes(b"not a recording")
    with pytest.raises(ValueError, match="no recording of Haptether"):
        read_recording(tmp_path / "other.mcap")


def test_a_recording_that_cannot_begin_says_where(peer: str, tmp_path: Path) -> None:
    with pytest.raises(OSError, match=r"record = .*nowhere/run\.mcap: No such file"):
        start(peer, record=tmp_path / "nowhere" / "run.mcap")
    with pytest.raises(OSError, match="bytes are free on the disk, must be at least"):
        start(peer, record=tmp_path / "run.mcap", min_free_bytes=2**62)


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """Yield a disk of 512 KiB."""
    folder = tmp_path / "disk"
    folder.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=512k", "tmpfs", str(folder)], capture_output=True, text=True, check=False
    )
    if mounted.returncode != 0:
        pytest.skip(f"mount is refused: {mounted.stderr.strip()}")
    try:
        yield folder
    finally:
        subprocess.run(["umount", "--lazy", str(folder)], check=True)


@pytest.mark.parametrize(
    ("min_free_bytes", "end", "whole"),
    [(0, "No space left on device", False), (200_000, "too little space is left on the disk", True)],
)
def test_a_full_disk_costs_records_and_nothing_else(
    peer: str, small_disk: Path, min_free_bytes: int, end: str, whole: bool
) -> None:
    trace, report = run_for(peer, 2.5, record=small_disk / "run.mcap", min_free_bytes=min_free_bytes)
    assert report.recording is not None
    assert end in (report.recording.end or "")
    assert report.recording.written > 0
    assert report.recording.dropped > 0
    assert report.recording.written + report.recording.dropped == report.ticks == len(trace)
    assert trace.time_s[-1] >= 2.5 - PERIOD_S, "the loop went on to its end"
    recording = read_recording(small_disk / "run.mcap")
    assert recording.whole == whole
    read = len(recording.signals["time_ns"])
    assert report.recording.written <= read <= report.ticks
    np.testing.assert_array_equal(recording.signals["time_ns"] * 1e-9, trace.time_s[:read])


def test_a_disk_that_does_not_answer_costs_records_and_nothing_else(peer: str, tmp_path: Path) -> None:
    """The disk is a pipe that nobody empties."""
    path = tmp_path / "run.mcap"
    os.mkfifo(path)
    reader = os.open(path, os.O_RDONLY | os.O_NONBLOCK)
    try:
        trace, report = run_for(peer, 1.0, record=path, min_free_bytes=0)
    finally:
        # The recorder's thread ends with an error instead of waiting for ever.
        os.close(reader)
    assert report.recording is not None
    assert report.recording.end == "the disk did not take the rest within 2 s"
    assert report.recording.dropped > 0
    assert report.recording.written + report.recording.dropped == report.ticks == len(trace)
    assert trace.time_s[-1] >= 1.0 - PERIOD_S


def test_late_wakes_are_no_fault_of_a_clock() -> None:
    """Two loops of one machine share its clock, however late they wake: here beside two processes that never sleep."""
    scene = scene_json(load_scene("remote_push"))
    busy = [sys.executable, "-c", f"import time; end = time.monotonic() + {BUSY_S}\nwhile time.monotonic() < end: pass"]
    burning = [subprocess.Popen(busy) for _ in range(2)]
    try:
        both: dict[str, Any] = {"key": secrets.token_bytes(32), "realtime": "off"}
        slave = LiveSlave(scene, listen="127.0.0.1:0", run_id=1, **both)
        master = LiveMaster(scene, peer=slave.address, run_id=2, **both)
        time.sleep(BUSY_S)
        reports = [run.finish()[1] for run in (master, slave)]
    finally:
        for process in burning:
            process.kill()
            process.wait()
    late = [report.path for report in reports]
    assert [path.clock_faults for path in late] == [0, 0], [path.last_clock_fault for path in late]
    # They have heard from one another, and woke late.
    assert min(report.link.fresh for report in reports) > 100
    assert sum(report.skipped for report in reports) > 0
