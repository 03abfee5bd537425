"""Emulated leader and follower press a wall over a slow network, under the coupling that `haptether check` advises."""

import json
import re
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from tests.dynamixel.emulated import emulated_bus
from tests.live.sides import Never
from tests.ur.stalls import anew_after_stalls

from haptether.bridge import Scene, load_scene, override_scene, save_scene, simulate, write_key
from haptether.dynamixel.emulator import JointSettings
from haptether.dynamixel.emulator.joint import POSITION_BANDWIDTH
from haptether.dynamixel.models import SERVO_MODELS
from haptether.studies import check_scene
from haptether.studies.processes import child_process, slave_behind

pytestmark = pytest.mark.live

MODEL = "XM430-W350"
WALL_RAD, K_WALL = 0.1, 10.0
TARGET_RAD, K_HAND, D_HAND = 0.8, 2.0, 0.0
LASTS_S, LIMIT_S, PATIENCE_S = 8.0, "60", 20.0
LOAD = JointSettings.of(SERVO_MODELS[MODEL])
CONSTANT = SERVO_MODELS[MODEL].nominal_nm_per_a
SCENE = f"""
schema = 1
[run]
duration_s = {LASTS_S}
period_s = 0.004
[master]
kind = "joints"
axes = 1
mass_kg = {LOAD.inertia}
viscous = {LOAD.viscous}
coulomb = {LOAD.coulomb}
measures_velocity = true
encoder_quantum = 1.5339808e-3
driver = "dynamixel"
[master.options]
port = "LEADER"
arm = "ARM"
offsets = [0.0]
signs = [1]
torque_constant = [{CONSTANT}]
timeout_s = 0.1
watchdog_s = 0.5
verify_watchdog = false
[operator]
stiffness = {K_HAND}
damping = {D_HAND}
grip_strength_n = 50.0
start = 0.0
legs = [{{ duration_s = 1.0, end = 0.0 }}, {{ duration_s = 1.0, end = {TARGET_RAD} }}]
clutch = "auto"
[slave]
# The position loop of an emulated servo, critically damped.
mass_kg = {LOAD.inertia}
bandwidth_hz = {POSITION_BANDWIDTH / (2.0 * np.pi)}
position = 0.0
max_speed = 6.0
period_s = 0.004
device = "dynamixel"
[slave.options]
port = "FOLLOWER"
arm = "SERVOS"
max_speed = 6.0
coulomb = [{LOAD.coulomb}]
viscous = [{LOAD.viscous}]
timeout_s = 0.1
watchdog_s = 0.5
lost_after_s = 0.3
release_s = 0.0
verify_watchdog = false
[[environment.objects]]
shape = {{ kind = "plane", normal = [-1.0], point = [{WALL_RAD}] }}
contact = {{ stiffness = {K_WALL}, damping = {np.sqrt(2.0 * LOAD.inertia * K_WALL)} }}
[record]
[safety]
controllers = []
[safety.ladder]
hold_after_s = 0.1
stop_after_s = 1.0
"""
ARM = f"""
name = "upright"
title = "One joint about a vertical axis"
source = "made up"
[[joints]]
name = "only"
servo = 1
model = "{MODEL}"
sign = 1
xyz_m = [0.0, 0.0, 0.0]
axis = [0.0, 0.0, 1.0]
low_rad = -2.0
high_rad = 2.0
[tool]
xyz_m = [0.1, 0.0, 0.0]
"""
SERVOS = f"""
[[servo]]
id = 1
model = "{MODEL}"
torque_constant = {CONSTANT}
"""


def over(round_trip_s: float, folder: Path) -> Scene:
    """Return the scene over a network, with the coupling whose lines `haptether check` shows."""
    text = SCENE
    for name, content in (("ARM", ARM), ("SERVOS", SERVOS), ("LEADER", ""), ("FOLLOWER", "")):
        text = text.replace(f'"{name}"', f'"{folder / name}"')
        if content:
            (folder / name).write_text(content)
    (folder / "given.toml").write_text(text)
    links = [f"link.{direction}.delay_s={round_trip_s / 2.0}" for direction in ("forward", "backward")]
    scene = load_scene(folder / "given.toml", links)
    (advice,) = (one.text for one in check_scene(scene).findings if one.name == "coupling")
    fields = re.findall(r'(kind|stiffness|damping) = "?([a-z0-9.-]+)', advice)
    assert len(fields) == 3, advice
    return override_scene(scene, [f"coupling.{name}={value}" for name, value in fields])


@pytest.mark.parametrize(
    "round_trip_s",
    [pytest.param(0.005, marks=pytest.mark.thorough), 0.04, pytest.param(0.2, marks=pytest.mark.thorough)],
)
@anew_after_stalls
def test_the_advised_coupling_holds_contact_with_the_torque_of_virtual_time(
    round_trip_s: float, tmp_path: Path
) -> None:
    scene = over(round_trip_s, tmp_path)
    key, file, trace, result = (tmp_path / name for name in ("key", "s.toml", "t.npz", "m.json"))
    write_key(key, replace=True)
    save_scene(scene, file)
    network = SimpleNamespace(delay_s=round_trip_s / 2.0, jitter_s=0.0, loss=0.0, seed=1)
    both = ("--scene", str(file), "--key", str(key), "--force")
    with ExitStack() as stack:
        bus = ("--servos", f"1={MODEL}", "--socket")
        leader = stack.enter_context(emulated_bus(*bus, str(tmp_path / "LEADER")))
        wall = ("--stops", f"1=-10:{WALL_RAD}:{K_WALL}")
        follower = stack.enter_context(emulated_bus(*bus, str(tmp_path / "FOLLOWER"), *wall))
        leader.do(f"hand 1 0 {K_HAND} {D_HAND}")
        _, address = slave_behind(network, LIMIT_S, stack, Never(), *both)
        master = stack.enter_context(child_process(
            "master", *both, "--peer", address, "--clutch", "auto", "--duration-s", str(LASTS_S),
            "--trace", str(trace), "--json", str(result), says="master: engaged",
        ))  # fmt: skip
        master.headline(Never())
        time.sleep(1.0)
        leader.do(f"hand 1 {TARGET_RAD} {K_HAND} {D_HAND} 1.0")
        time.sleep(LASTS_S - 2.0)
        pressed_nm = K_WALL * (follower.servo(1)["position_rad"] - WALL_RAD)
        assert master.process.wait(PATIENCE_S) == 0, master.said()
    report = json.loads(result.read_text())
    assert (report["final_state"], report["holds"]) == ("engaged", 0)
    with np.load(trace) as arrays:
        late = arrays["time_s"] > arrays["time_s"][-1] - 1.0
        felt_nm = arrays["rendered_force"][late]
    expected = simulate(scene).signals
    expected_nm = np.ravel(expected.rendered_force)[expected.time_s > LASTS_S - 1.0]
    # A unit of Present Current is 5 mN m.
    assert np.ptp(felt_nm) < 0.01
    assert felt_nm.mean() == pytest.approx(expected_nm.mean(), rel=0.02)
    assert pressed_nm == pytest.approx(-expected_nm.mean(), rel=0.02)
