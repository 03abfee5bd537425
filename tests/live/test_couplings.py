"""Couplings of two live sides over UDP."""

import time
from pathlib import Path

import numpy as np
import pytest
from tests.live.sides import until
from tests.scene.test_couplings import pressed

from haptether.bridge import LiveMaster, LiveSlave, Scene, override_scene, read_recording, scene_json, simulate

pytestmark = pytest.mark.live
KEY = bytes(range(32))


def live(scene: Scene) -> Scene:
    """Give the ladder time for a machine that stalls a loop."""
    return override_scene(scene, ["safety.ladder.hold_after_s=0.1", "safety.ladder.stop_after_s=1.0"])


@pytest.mark.parametrize("kind", ["position-force-computed", "pd-damped", "wave", "four-channel"])
def test_a_live_contact_has_the_force_of_virtual_time(kind: str) -> None:
    """The hand presses for 1 s and holds; both runs then rest at the same force, over sockets and in virtual time."""
    scene = live(pressed(kind, 0.0, run={"duration_s": 6.0}, coupling={"damping": 8.0}))
    json = scene_json(scene)
    slave = LiveSlave(json, listen="127.0.0.1:0", run_id=2, key=KEY)
    master = LiveMaster(json, peer=slave.address, run_id=1, key=KEY)
    until(lambda: (master.state, slave.state) == ("engaged", "engaged"), 20.0)
    time.sleep(5.0)
    assert (master.state, slave.state) == ("engaged", "engaged")
    near, _ = master.finish()
    slave.finish()
    signals = simulate(scene).signals
    assert signals is not None
    felt = near.rendered_force[np.isin(near.state, (2, 3))][-200:].mean()
    expected = signals.rendered_force[-200:].mean()
    assert abs(expected) > 0.5
    assert felt == pytest.approx(expected, rel=0.01)


def test_sides_of_different_couplings_do_not_meet() -> None:
    """The handshake names both couplings, and nothing engages."""
    of_master, of_slave = (scene_json(live(pressed(kind, 0.0))) for kind in ("pd-damped", "position-position"))
    slave = LiveSlave(of_slave, listen="127.0.0.1:0", run_id=2, key=KEY)
    master = LiveMaster(of_master, peer=slave.address, run_id=1, key=KEY)
    time.sleep(1.0)
    states = {master.state, slave.state}
    (_, near), (_, far) = master.finish(), slave.finish()
    assert not states & {"engaged", "stale"}
    assert np.isinf([near.engaged_s, far.engaged_s]).all()


def test_a_switch_reaches_both_sides_and_a_slave_that_starts_anew(tmp_path: Path) -> None:
    """The command releases the clutch, and only a press engages, with the other coupling at both sides."""
    scene = live(pressed("pd-damped", 0.0, run={"duration_s": 60.0}, coupling={"alternatives": [{"kind": "pspm"}]}))
    json, files = scene_json(scene), [tmp_path / name for name in ("master.mcap", "slave.mcap")]
    slave = LiveSlave(json, listen="127.0.0.1:0", run_id=2, key=KEY)
    master = LiveMaster(json, peer=slave.address, run_id=1, key=KEY, record=files[0])
    with pytest.raises(ValueError, match="must be that of the scene or one of its"):
        master.switch_coupling("wave")
    until(lambda: (master.state, slave.state) == ("engaged", "engaged"), 20.0)
    master.switch_coupling("pspm")
    until(lambda: master.state == "disengaged")
    time.sleep(0.5)
    assert "engaged" not in {master.state, slave.state}
    master.press_clutch()
    until(lambda: (master.state, slave.state) == ("engaged", "engaged"))
    address = slave.address
    slave.finish()
    until(lambda: master.state != "engaged")
    slave = LiveSlave(json, listen=address, run_id=3, key=KEY, record=files[1])
    time.sleep(1.0)
    assert "engaged" not in {master.state, slave.state}
    master.press_clutch()
    until(lambda: (master.state, slave.state) == ("engaged", "engaged"))
    time.sleep(1.0)
    assert [side.finish()[1].link.coupling for side in (master, slave)] == ["pspm", "pspm"]
    # Only PSPM counts its energy.
    for file in files:
        signals = read_recording(file).signals
        counts = np.isfinite(signals["left_j"])[signals["state"] == "engaged"]
        assert counts[-1]
        assert counts[0] == (file == files[1])
