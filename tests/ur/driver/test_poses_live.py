"""Poses through the real ur_rtde, with an emulated controller as a process, at 500 Hz: figures of the bench."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from tests.ur.emulated import free_host
from tests.ur.stalls import anew_after_stalls

pytest.importorskip("rtde_control")
pytestmark = [pytest.mark.alone, pytest.mark.timeout(300)]

BENCH = Path(__file__).resolve().parents[3] / "benches" / "pose_tracking.py"
SHARED_S = 0.05
"""Delay that a shared machine may add, except for 5 % of the samples, in s."""
STALLED_S = 0.5
"""Largest delay that it may add, in s: an arm that jumps or runs away exceeds it."""
LATE_S = {"servoj": 0.056, "servol": 0.057, "speedl": 0.003, "direct-torque": 0.025}
"""Lookahead and transport, in s; for direct-torque the lag of its springs."""
SAG_M = {"direct-torque": 0.004}


def measured(mode: str) -> dict[str, dict[str, Any]]:
    """Return rows of the bench by path; its process can be killed if the library hangs."""
    command = [sys.executable, str(BENCH), "--mode", mode, "--host", free_host(), "--json", "-"]
    ended = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
    assert ended.returncode == 0, ended.stderr
    # The library prints further text.
    rows = json.loads(ended.stdout[ended.stdout.index("[\n") :])
    assert len(rows) == 3
    return {row["path"]: row for row in rows}


# tests/ur/driver/test_poses.py covers virtual time; the pick demonstration covers the real client.
@pytest.mark.thorough
@pytest.mark.parametrize("mode", LATE_S)
@anew_after_stalls
def test_the_arm_follows_poses_and_goes_through_its_wrist(mode: str) -> None:
    rows = measured(mode)
    for row in rows.values():
        assert row["fault"] == ""
        # No joint jumps: the controller would stop it beyond 1.05 of its largest speed.
        assert row["fastest_joint"] < 0.9, row
    figure, late_s = rows["figure"], LATE_S[mode] + SHARED_S
    assert figure["angular_speed"] > 1.5
    for share, most_s in (("p95", late_s), ("worst", late_s + STALLED_S)):
        assert figure[f"{share}_m"] < figure["speed"] * most_s + SAG_M.get(mode, 0.0), figure
        assert figure[f"{share}_rad"] < figure["angular_speed"] * most_s, figure
    for path in ("singularity", "beside it"):
        row = rows[path]
        begin, end = row["joint_5"]
        assert begin == pytest.approx(0.5, abs=1e-3)
        assert end < -0.4
        assert row["p95_m"] < 0.006, row
        assert row["p95_rad"] < 0.3, row
        assert row["end_rad"] < 0.02, row
