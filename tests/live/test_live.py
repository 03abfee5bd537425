"""Live runs with real processes and sockets; bounds on time are loose, because the subject is the operating system."""

import json
import re
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from tests.scene.two_sides import reports, two_sides
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import (
    LiveMaster,
    LiveSlave,
    override_scene,
    scene_json,
    simulate,
    write_key,
)
from haptether.cli.live.sides import baseline_scene

pytestmark = pytest.mark.live

COMMAND = [sys.executable, "-m", "haptether"]
START_TIMEOUT_S = 30.0


@pytest.fixture(scope="module")
def key(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("key") / "session.key"
    write_key(path)
    return path


class Child:
    """A command under test with its first line, which says that its socket is open."""

    def __init__(self, *arguments: str) -> None:
        self.process = subprocess.Popen(
            [*COMMAND, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self.process.stderr is not None
        self.headline = self.process.stderr.readline()

    def address(self) -> str:
        found = re.search(r"(?:listens on|master on) (\S+:\d+)", self.headline)
        assert found, self.headline
        return found[1].rstrip(",")

    def engaged(self) -> None:
        """Wait until it prints that it is engaged; the timeout of the test bounds the wait."""
        assert self.process.stderr is not None
        said: list[str] = []
        for line in self.process.stderr:
            if line.strip().endswith(": engaged"):
                return
            said.append(line)
        pytest.fail(f"it ended before: {''.join(said)}")

    def end(self) -> str:
        """Wait for the end and return its standard error."""
        _, said = self.process.communicate(timeout=START_TIMEOUT_S)
        return said or ""


def load(path: Path) -> dict[str, npt.NDArray[np.float64]]:
    with np.load(path) as arrays:
        return {name: np.asarray(arrays[name], dtype=np.float64) for name in arrays.files}


def explain(path: Path) -> dict[str, Any]:
    """Return the output of `haptether explain` for a flight recorder's file."""
    ended = subprocess.run(
        [*COMMAND, "explain", str(path), "--json", "-"],
        capture_output=True, text=True, timeout=START_TIMEOUT_S, check=True,
    )  # fmt: skip
    said: dict[str, Any] = json.loads(ended.stdout)
    return said


@pytest.fixture
def children() -> Iterator[list[Child]]:
    running: list[Child] = []
    yield running
    for child in running:
        if child.process.poll() is None:
            child.process.kill()
        child.process.communicate()


@pytest.mark.sampled(1)
@pytest.mark.parametrize("controller", ["none", "hsc", "wsc"])
@anew_after_stalls
def test_a_killed_slave_takes_the_force_from_the_hand(
    key: Path, controller: str, children: list[Child], tmp_path: Path
) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0", "--patience-s", "30")
    children.append(slave)
    trace_path, json_path = tmp_path / "run.npz", tmp_path / "run.json"
    master = Child(
        "master", "--key", str(key), "--peer", slave.address(), "--controller", controller, "--duration-s", "3.5",
        "--trace", str(trace_path), "--json", str(json_path), "--flight", str(tmp_path / "master.flight"), "--force",
    )  # fmt: skip
    children.append(master)
    master.engaged()
    time.sleep(1.5)
    slave.process.send_signal(signal.SIGKILL)
    said = master.end()
    assert master.process.returncode == 1, "a run that ended in stop has failed"
    assert "the slave fell silent" in said
    result = json.loads(json_path.read_text())
    assert (result["final_state"], result["outliers"]) == ("stop", 0)
    explained = explain(tmp_path / "master.flight")
    because = [(step["to"], step["reason"]) for step in explained["transitions"]]
    assert because[-2:] == [("hold", "peer is silent"), ("stop", "no working peer for too long")]
    assert explained["at_hold"][-1]["state"] == "hold"
    assert len(explained["at_hold"]) == len(explained["latest"]) == 50

    trace = load(trace_path)
    trips = trace["tripped"] > 0
    assert explained["interventions_seen"] == int((trips[1:] & ~trips[:-1]).sum()) + int(trips[0])
    time_s, force, age_s = trace["time_s"], trace["device_force"], trace["age_s"]
    last_arrival_s = float(time_s[-1] - age_s[-1])
    before = (time_s > last_arrival_s - 0.2) & (time_s <= last_arrival_s)
    after = time_s >= last_arrival_s + 0.12
    assert np.count_nonzero(after) > 100
    assert float(np.abs(force[before]).min()) > 1.0, "the hand pressed the wall until the end"
    assert float(np.abs(force[after]).max()) == 0.0
    falling = np.abs(force[time_s > last_arrival_s + 0.03])
    assert float(np.abs(np.diff(falling)).max()) < 1.0, "it fades, it does not drop"


@anew_after_stalls
def test_a_stopped_slave_holds_until_the_clutch_is_pressed_anew(
    key: Path, children: list[Child], tmp_path: Path
) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0", "--patience-s", "30")
    children.append(slave)
    trace_path = tmp_path / "run.npz"
    master = Child(
        "master",
        "--key",
        str(key),
        "--peer",
        slave.address(),
        "--duration-s",
        "4",
        "--trace",
        str(trace_path),
        "--force",
    )
    children.append(master)
    master.engaged()
    time.sleep(1.0)
    slave.process.send_signal(signal.SIGSTOP)
    time.sleep(0.1)
    slave.process.send_signal(signal.SIGCONT)
    time.sleep(1.0)
    for side in (slave, master):
        # There is nothing to acknowledge: the signal has no effect, and does not end the process.
        side.process.send_signal(signal.SIGUSR2)
    master.process.send_signal(signal.SIGUSR1)
    said = master.end()
    assert master.process.returncode == 0, said
    trace = load(trace_path)
    held = trace["state"] == 4
    assert "master: there was nothing to acknowledge here" in said
    assert np.count_nonzero(held) > 800, "the link was up again after 0.1 s, and it still held"
    begun = int(np.flatnonzero(held)[0])
    assert not trace["device_force"][begun + 120 :][held[begun + 120 :]].any()
    assert trace["state"][-1] in {2, 3}, "pressed anew"
    assert abs(trace["device_force"][-1]) > 0.5


@pytest.mark.sampled(1)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_both_commands_end_cleanly_on_a_signal(key: Path, children: list[Child], number: signal.Signals) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0")
    children.append(slave)
    # On a busy machine it is late, which is not the subject here.
    netsim = Child(
        "netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", slave.address(), "--max-error-s", "1"
    )  # fmt: skip
    children.append(netsim)
    master = Child(
        "master", "--key", str(key), "--peer", netsim.address(), "--controller", "wsc", "--patience-s", "30"
    )  # fmt: skip
    children.append(master)
    master.engaged()
    time.sleep(1.0)
    for child in (master, netsim, slave):
        child.process.send_signal(number)
        said = child.end()
        assert child.process.returncode == 0, said
        assert "Traceback" not in said


def test_a_master_without_a_slave_says_so(key: Path, children: list[Child]) -> None:
    master = Child("master", "--key", str(key), "--peer", "127.0.0.1:9", "--patience-s", "0.5")
    children.append(master)
    said = master.end()
    assert master.process.returncode == 1
    assert "no slave answered at 127.0.0.1:9 within 0.5 s" in said


def test_a_taken_address_is_one_line(key: Path, children: list[Child]) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0")
    children.append(slave)
    second = subprocess.run(
        [*COMMAND, "slave", "--key", str(key), "--listen", slave.address()],
        capture_output=True, text=True, timeout=START_TIMEOUT_S, check=False,
    )  # fmt: skip
    assert second.returncode == 1
    assert second.stderr.startswith("haptether: cannot listen on 127.0.0.1:")
    assert second.stderr.count("\n") == 1


@anew_after_stalls
def test_ipv6_works_and_a_mix_is_refused(key: Path, children: list[Child]) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "[::1]:0", "--duration-s", "1", "--patience-s", "20")
    children.append(slave)
    if "cannot listen" in slave.headline:
        pytest.skip("this machine has no IPv6")
    found = re.search(r"listens on (\S+)", slave.headline)
    assert found
    mixed = subprocess.run(
        [*COMMAND, "master", "--key", str(key), "--peer", found[1], "--listen", "127.0.0.1:0"],
        capture_output=True, text=True, timeout=START_TIMEOUT_S, check=False,
    )  # fmt: skip
    assert mixed.returncode == 2
    assert "of the same kind, IPv4 or IPv6" in mixed.stderr
    master = Child("master", "--key", str(key), "--peer", found[1], "--duration-s", "0.8")
    children.append(master)
    assert "no slave answered" not in master.end()
    assert master.process.returncode == 0


@anew_after_stalls
def test_a_slave_ends_its_duration_after_engaging_however_long_it_waited(
    key: Path, children: list[Child], tmp_path: Path
) -> None:
    result = tmp_path / "slave.json"
    slave = Child(
        "slave", "--key", str(key), "--listen", "127.0.0.1:0", "--duration-s", "0.4", "--json", str(result), "--force"
    )  # fmt: skip
    children.append(slave)
    assert "waits for a master, and ends 0.4 s after engaging; --patience-s bounds the wait" in slave.headline
    time.sleep(0.8)
    assert slave.process.poll() is None, "the wait for a master was counted"
    master = Child("master", "--key", str(key), "--peer", slave.address(), "--duration-s", "20")
    children.append(master)
    master.engaged()
    slave.end()
    assert slave.process.returncode == 0
    assert master.process.poll() is None or "slave" in master.end()
    assert json.loads(result.read_text())["ticks"] > 800


@anew_after_stalls
def test_a_second_master_is_refused_while_the_first_lives(key: Path, children: list[Child], tmp_path: Path) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0")
    children.append(slave)
    first_json, second_json = tmp_path / "first.json", tmp_path / "second.json"
    first = Child("master", "--key", str(key), "--peer", slave.address(), "--json", str(first_json), "--force")
    children.append(first)
    first.engaged()
    second = Child(
        "master", "--key", str(key), "--peer", slave.address(), "--patience-s", "0.8", "--duration-s", "2.5",
        "--json", str(second_json), "--force",
    )  # fmt: skip
    children.append(second)
    said = second.end()
    assert second.process.returncode == 1
    assert "refused: another master has the lease of this slave" in said
    assert first.process.poll() is None, "the first was to outlive the second"
    first.process.send_signal(signal.SIGINT)
    first.end()
    assert json.loads(first_json.read_text())["final_state"] in {"engaged", "stale"}
    assert json.loads(second_json.read_text())["engaged_s"] is None


def test_live_and_virtual_time_run_the_same_scene(key: Path, children: list[Child], tmp_path: Path) -> None:
    """Parity: the same press, push and release, over loopback and in virtual time."""
    slave = Child(
        "slave", "--key", str(key), "--listen", "127.0.0.1:0", "--push-at-s", "1.8", "--patience-s", "30",
    )  # fmt: skip
    children.append(slave)
    trace_path = tmp_path / "live.npz"
    master = Child(
        "master", "--key", str(key), "--peer", slave.address(), "--controller", "hsc", "--release-at-s", "2.2",
        "--duration-s", "2.8", "--trace", str(trace_path),
    )  # fmt: skip
    children.append(master)
    master.end()
    live = load(trace_path)

    scene = baseline_scene(controller="hsc", release_at_s=2.2, push_at_s=1.8)
    run = simulate(override_scene(scene, ["run.duration_s=2.8", "record.every=1"]))
    virtual, (report, _) = run.signals, reports(run)
    engaged = int(np.flatnonzero(live["state"] == 2)[0])
    offset = round(report.engaged_s * 1e3)
    if not np.isin(live["state"][engaged:], (2, 3)).all():
        pytest.skip("the machine stalled a loop for over 20 ms: the live run held, as it should")
    for time_s in (0.5, 1.0, 1.5, 2.1):
        ticks = round(time_s * 1e3)
        # Loopback and the two loops' phase cost up to a few ticks; the hand moves at most 0.08 m/s here. Ticks are
        # matched by time, because a loop that wakes late skips ticks.
        tick = int(np.searchsorted(live["time_s"], live["time_s"][engaged] + time_s - 5e-4))
        assert live["position"][tick] == pytest.approx(virtual.position[offset + ticks], abs=5e-4)
        assert live["device_force"][tick] == pytest.approx(virtual.device_force[offset + ticks], abs=0.15)


def test_demo_shows_that_protection_holds(tmp_path: Path) -> None:
    report_path = tmp_path / "demo.json"
    ended = subprocess.run(
        [*COMMAND, "demo", "--out", str(tmp_path), "--json", str(report_path)],
        capture_output=True, text=True, timeout=100, check=False,
    )  # fmt: skip
    assert ended.returncode == 0, ended.stdout + ended.stderr
    report = json.loads(report_path.read_text())
    peak = {result["controller"]: result["peak_hand_speed"] for result in report["results"]}
    assert peak["none"] > 1.0, "unprotected, the stylus is thrown"
    assert max(peak["hsc"], peak["wsc"]) < 0.5 * peak["none"]
    assert report["protected"] is True
    for result in report["results"]:
        assert result["lost"] > 0, "1 % loss was asked for"
        assert 0.07 < result["round_trip_s"] < 0.2
    assert (tmp_path / "demo.png").stat().st_size > 10_000


MAX_MIB = 120.0
"""Largest memory in MiB that a side uses and locks by default."""


def status_mib(pid: int) -> dict[str, float]:
    """Return the sizes in /proc/PID/status in MiB."""
    found = re.findall(r"^(\w+):\s+(\d+) kB$", Path(f"/proc/{pid}/status").read_text(), re.MULTILINE)
    return {name: int(size) / 1024.0 for name, size in found}


def loop_faults(pid: int) -> int:
    """Return the page faults of the loop's thread so far."""
    for task in Path(f"/proc/{pid}/task").iterdir():
        if (task / "comm").read_text().strip() == "haptether-loop":
            fields = (task / "stat").read_text().rpartition(")")[2].split()
            return int(fields[7]) + int(fields[9])
    pytest.fail("it has no loop")


@pytest.mark.parametrize(
    ("scene", "recorded"), [([], False), (["--scene", "peg_in_hole"], True)], ids=["points", "poses-recorded"]
)
def test_a_side_locks_what_its_ticks_use_and_little_more(
    key: Path, scene: list[str], recorded: bool, children: list[Child], tmp_path: Path
) -> None:
    def start(side: str, *arguments: str) -> Child:
        outputs = [
            "--record",
            str(tmp_path / f"{side}.mcap"),
            "--min-free-bytes",
            "0",
            "--telemetry",
            str(tmp_path / side),
        ]
        children.append(Child(side, "--key", str(key), *arguments, *scene, *(outputs if recorded else [])))
        return children[-1]

    slave = start("slave", "--listen", "127.0.0.1:0")
    address = slave.address()
    before = [loop_faults(slave.process.pid)]
    master = start("master", "--peer", address, "--clutch", "auto")
    master.engaged()
    before.append(loop_faults(master.process.pid))
    time.sleep(1.5)
    for child, faults in zip((slave, master), before, strict=True):
        sizes = status_mib(child.process.pid)
        assert max(sizes["VmRSS"], sizes["VmLck"]) <= MAX_MIB, sizes
        # Without the right to lock memory, page faults may occur.
        if sizes["VmLck"] > 0.0:
            assert loop_faults(child.process.pid) == faults


def descendants(of: int) -> set[int]:
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                parent = int((entry / "stat").read_text().rsplit(")", 1)[1].split()[1])
            except (OSError, IndexError):
                continue
            if parent == of:
                found |= {int(entry.name)} | descendants(int(entry.name))
    return found


@pytest.mark.skipif(not Path("/proc").exists(), reason="looks for child processes in /proc")
def test_ctrl_c_leaves_no_process_behind(tmp_path: Path) -> None:
    demo = subprocess.Popen(
        [*COMMAND, "demo", "--out", str(tmp_path)],
        stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    try:
        deadline = time.monotonic() + START_TIMEOUT_S
        while len(descendants(demo.pid)) < 3 and time.monotonic() < deadline:
            time.sleep(0.05)
        started = descendants(demo.pid)
        assert len(started) == 3
        demo.send_signal(signal.SIGINT)
        assert demo.wait(timeout=30) == 130
        alive = [pid for pid in started if Path(f"/proc/{pid}").exists()]
        assert not alive
    finally:
        if demo.poll() is None:
            demo.kill()
            demo.wait()


def test_sockets_are_not_left_open(key: Path, children: list[Child]) -> None:
    """A slave that has ended releases its address."""
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0", "--patience-s", "0.3")
    children.append(slave)
    address = slave.address()
    slave.end()
    again = Child("slave", "--key", str(key), "--listen", address, "--patience-s", "0.3")
    children.append(again)
    assert again.address() == address
    assert "no master came within 0.3 s" in again.end()
    assert again.process.returncode == 1


def test_check_link_measures_and_moves_nothing(key: Path, children: list[Child], tmp_path: Path) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0", "--json", str(tmp_path / "slave.json"))
    children.append(slave)
    path = tmp_path / "link.json"
    check = Child("check-link", "--key", str(key), "--peer", slave.address(), "--duration-s", "2", "--json", str(path))
    children.append(check)
    said = check.end()
    report = json.loads(path.read_text())
    # The quality of this machine is not the subject: the status must only match the verdict.
    assert check.process.returncode == (0 if report["verdict"]["good"] else 1), said
    link, verdict = report["link"], report["verdict"]
    assert link["arrived"] > 100
    assert link["rate_hz"] <= 1000.5
    # Both ends check once per millisecond. The waits there and back add up to that, minus the work of two ticks.
    assert 0.5e-3 <= link["round_trip_p50_s"] <= link["round_trip_p99_s"] <= link["round_trip_max_s"]
    assert verdict["delay_s"] == pytest.approx(link["round_trip_p99_s"] + 1e-3)
    assert verdict["bearable_delay_s"] is None, "a soft wall under a firm hand"
    assert verdict["bearable_gap_s"] == pytest.approx(0.021)
    slave.process.send_signal(signal.SIGINT)
    slave.end()
    seen = json.loads((tmp_path / "slave.json").read_text())
    assert seen["final_state"] == "disengaged"
    assert seen["peak_environment_force_n"] is None, "it never engaged"
    assert seen["link"]["arrived"] > 100


def test_check_link_says_when_a_coupling_bears_less_than_the_link_has(
    key: Path, children: list[Child], tmp_path: Path
) -> None:
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0")
    children.append(slave)
    netsim = Child(
        "netsim", "proxy", "--listen", "127.0.0.1:0", "--forward", slave.address(), "--delay-s", "0.02",
        "--max-error-s", "1",
    )  # fmt: skip
    children.append(netsim)
    path = tmp_path / "link.json"
    check = Child(
        "check-link", "--key", str(key), "--peer", netsim.address(), "--duration-s", "1", "--wall-stiffness", "500",
        "--json", str(path),
    )  # fmt: skip
    children.append(check)
    check.end()
    assert check.process.returncode == 1
    verdict = json.loads(path.read_text())["verdict"]
    assert verdict["delay_s"] >= 0.04
    assert 0.0 < verdict["bearable_delay_s"] < 0.04
    assert any("contact would oscillate" in complaint for complaint in verdict["complaints"])


def test_check_link_judges_the_coupling_of_a_scene(key: Path, children: list[Child], tmp_path: Path) -> None:
    """Three axes, a slave at 2 ms, and its own wall and arm; without an operator nobody presses either."""
    scene = tmp_path / "stiff.toml"
    scene.write_text(
        "schema = 1\n"
        'master = { device = "phantom-desktop", axes = 3 }\n'
        "slave = { mass_kg = 2.0, bandwidth_hz = 8.0, period_s = 2e-3 }\n"
        "coupling = { force_scale = 0.5 }\n"
        "safety = { ladder = { hold_after_s = 0.03 } }\n"
        "[[environment.objects]]\n"
        "contact = { stiffness = 5000.0 }\n"
    )
    slave = Child("slave", "--key", str(key), "--listen", "127.0.0.1:0", "--scene", str(scene))
    children.append(slave)
    path = tmp_path / "link.json"
    check = Child(
        "check-link", "--key", str(key), "--peer", slave.address(), "--duration-s", "1", "--scene", str(scene),
        "--json", str(path),
    )  # fmt: skip
    children.append(check)
    said = check.end()
    assert check.process.returncode == 1, said
    report = json.loads(path.read_text())
    verdict = report["verdict"]
    assert verdict["delay_s"] == pytest.approx(report["link"]["round_trip_p99_s"] + 2e-3)
    assert verdict["bearable_delay_s"] == 0.0, "nobody holds the device, and its own friction is negative"
    assert verdict["bearable_gap_s"] == pytest.approx(0.032)


def test_check_link_without_a_slave_says_so(key: Path, children: list[Child]) -> None:
    check = Child("check-link", "--key", str(key), "--peer", "127.0.0.1:9", "--duration-s", "0.5")
    children.append(check)
    assert "no slave answered at 127.0.0.1:9 within 0.5 s" in check.end()
    assert check.process.returncode == 1


def test_both_sides_record_what_they_did(key: Path, children: list[Child], tmp_path: Path) -> None:
    from haptether.bridge import read_recording

    slave_path, master_path = tmp_path / "slave.mcap", tmp_path / "master.mcap"
    slave = Child(
        "slave", "--key", str(key), "--listen", "127.0.0.1:0", "--duration-s", "1", "--record", str(slave_path),
        "--min-free-bytes", "0", "--json", str(tmp_path / "slave.json"),
    )  # fmt: skip
    children.append(slave)
    trace_path = tmp_path / "run.npz"
    master = Child(
        "master", "--key", str(key), "--peer", slave.address(), "--duration-s", "0.8", "--record", str(master_path),
        "--min-free-bytes", "0", "--trace", str(trace_path),
    )  # fmt: skip
    children.append(master)
    master.end()
    slave.end()
    trace, recording = load(trace_path), read_recording(master_path)
    assert recording.whole
    np.testing.assert_array_equal(recording.signals["device_force"][:, 0], trace["device_force"])
    np.testing.assert_array_equal(np.isnan(recording.signals["round_trip_s"]), np.isinf(trace["round_trip_s"]))
    assert "engaged" in set(recording.signals["state"])
    other = read_recording(slave_path)
    assert (other.side, other.security) == ("slave", "secure")
    assert len(other.signals["time_ns"]) == json.loads((tmp_path / "slave.json").read_text())["link"]["recorded"]


@anew_after_stalls
def test_scales_change_while_both_sides_run() -> None:
    scene = two_sides(
        operator={"grip_strength_n": 20.0, "legs": [{"duration_s": 0.4, "end": -0.03}]},
        safety={"ladder": {"hold_after_s": 0.1, "stop_after_s": 1.0}},
    )
    key = bytes(range(32))
    slave = LiveSlave(scene_json(scene), listen="127.0.0.1:0", run_id=2, key=key)
    master = LiveMaster(scene_json(scene), peer=slave.address, run_id=1, key=key)
    for refused in (0.0, -1.0, float("nan"), float("inf"), 1e308, 5e-324, 100.1):
        with pytest.raises(ValueError, match=r"force_scale .*must be between 0\.5 and 2"):
            master.set_force_scale(refused)
        with pytest.raises(ValueError, match=r"position_scale .*must be between 0\.5 and 2"):
            slave.set_position_scale(refused)
    end_s = time.monotonic() + START_TIMEOUT_S
    while (master.state, slave.state) != ("engaged", "engaged"):
        assert time.monotonic() < end_s, (master.state, slave.state)
        time.sleep(0.01)
    # While coupled, a scale may change at most by a factor of two.
    for refused in (2.1, 0.4, 5.0, 99.0):
        with pytest.raises(ValueError, match="release the clutch first"):
            master.set_force_scale(refused)
        with pytest.raises(ValueError, match="release the clutch first"):
            slave.set_position_scale(refused)
    # The hand has arrived after 0.4 s.
    time.sleep(0.8)
    master.set_force_scale(0.5)
    slave.set_position_scale(2.0)
    # There is nothing to acknowledge: the calls have no effect.
    master.acknowledge()
    slave.acknowledge()
    time.sleep(0.8)
    assert (master.state, slave.state) == ("engaged", "engaged")
    near, _ = master.finish()
    far, _ = slave.finish()
    felt, measured = (
        float(of[np.flatnonzero(np.isin(side.state, (2, 3)))[-1]])
        for side, of in ((near, near.rendered_force), (far, far.environment_force))
    )
    assert abs(measured) > 1.0
    assert felt == pytest.approx(0.5 * measured, rel=0.1)
    assert np.nanmax(np.abs(np.diff(far.command))) <= 3.0 * 0.05, "no jump"
    for acknowledge in (master.acknowledge, slave.acknowledge):
        with pytest.raises(RuntimeError, match="ended"):
            acknowledge()
