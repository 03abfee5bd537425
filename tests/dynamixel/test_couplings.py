"""Emulated leader and follower press a wall over a slow network, under the coupling that `haptether check` advises."""

import json
import re
import time
from contextlib import ExitStack
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import numpy.typing as npt
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
Array = npt.NDArray[np.float64]
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


def given(round_trip_s: float, folder: Path) -> Scene:
    """Return the scene over a network."""
    text = SCENE
    for name, content in (("ARM", ARM), ("SERVOS", SERVOS), ("LEADER", ""), ("FOLLOWER", "")):
        text = text.replace(f'"{name}"', f'"{folder / name}"')
        if content:
            (folder / name).write_text(content)
    (folder / "given.toml").write_text(text)
    links = [f"link.{direction}.delay_s={round_trip_s / 2.0}" for direction in ("forward", "backward")]
    return load_scene(folder / "given.toml", links)


def advised(scene: Scene) -> Scene:
    """Return the scene with the coupling whose lines `haptether check` shows."""
    (advice,) = (one.text for one in check_scene(scene).findings if one.name == "coupling")
    fields = re.findall(r'(kind|stiffness|damping) = "?([a-z0-9.-]+)', advice)
    assert len(fields) == 3, advice
    return override_scene(scene, [f"coupling.{name}={value}" for name, value in fields])


ACCELERATION_FORM = (
    "slave.takes_force=true", f"slave.viscous={LOAD.viscous}", "slave.max_force_n=3.0", "slave.bandwidth_hz=4.0",
    "slave.options.mode=current", f"slave.options.inertia=[{LOAD.inertia}]",
    f"slave.options.torque_constant=[{CONSTANT}]",
    "coupling.kind=four-channel", f"coupling.stiffness={800.0 * LOAD.inertia}",
    f"coupling.damping={40.0 * LOAD.inertia}", "coupling.impedance=0.05",
    "coupling.environment_gain=0.5", "coupling.grasp_gain=0.5",
)  # fmt: skip
"""Kp 800, Kd 40 and Kf = 1 / 2M of both joints."""


def pressed(scene: Scene, folder: Path) -> tuple[Array, float, float]:
    """Press the wall with the pair over the network of a scene.

    Returns:
        F_v of the last second and F_e of the wall in N m, and the angle in rad of the leader beyond the follower.
    """
    assert scene.link is not None
    assert scene.link.forward is not None
    key, file, trace, result = (folder / name for name in ("key", "s.toml", "t.npz", "m.json"))
    write_key(key, replace=True)
    save_scene(scene, file)
    network = SimpleNamespace(delay_s=scene.link.forward.delay_s, jitter_s=0.0, loss=0.0, seed=1)
    both = ("--scene", str(file), "--key", str(key), "--force")
    with ExitStack() as stack:
        bus = ("--servos", f"1={MODEL}", "--socket")
        leader = stack.enter_context(emulated_bus(*bus, str(folder / "LEADER")))
        wall = ("--stops", f"1=-10:{WALL_RAD}:{K_WALL}")
        follower = stack.enter_context(emulated_bus(*bus, str(folder / "FOLLOWER"), *wall))
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
        place, place_of_leader = (float(bus.servo(1)["position_rad"]) for bus in (follower, leader))
        assert master.process.wait(PATIENCE_S) == 0, master.said()
    report = json.loads(result.read_text())
    assert (report["final_state"], report["holds"]) == ("engaged", 0)
    with np.load(trace) as arrays:
        late = arrays["time_s"] > arrays["time_s"][-1] - 1.0
        felt_nm = np.asarray(arrays["rendered_force"][late])
    return felt_nm, K_WALL * (place - WALL_RAD), place_of_leader - place


@pytest.mark.parametrize(
    "round_trip_s",
    [pytest.param(0.005, marks=pytest.mark.thorough), 0.04, pytest.param(0.2, marks=pytest.mark.thorough)],
)
@anew_after_stalls
def test_the_advised_coupling_holds_contact_with_the_torque_of_virtual_time(
    round_trip_s: float, tmp_path: Path
) -> None:
    scene = advised(given(round_trip_s, tmp_path))
    felt_nm, pressed_nm, _ = pressed(scene, tmp_path)
    expected = simulate(scene).signals
    expected_nm = np.ravel(expected.rendered_force)[expected.time_s > LASTS_S - 1.0]
    # A unit of Present Current is 5 mN m.
    assert np.ptp(felt_nm) < 0.01
    assert felt_nm.mean() == pytest.approx(expected_nm.mean(), rel=0.02)
    assert pressed_nm == pytest.approx(-expected_nm.mean(), rel=0.02)


@anew_after_stalls
def test_a_follower_in_current_mode_is_where_the_leader_is(tmp_path: Path) -> None:
    """Without dry friction both are at one place; with c of each gear they may stick c / K apart.

    Hand and wall share 0.7 rad / (1/K_h + 1/K_e), within c of each joint.
    """
    scene = override_scene(given(0.005, tmp_path), ACCELERATION_FORM)
    felt_nm, pressed_nm, apart = pressed(scene, tmp_path)
    assert scene.coupling is not None
    assert scene.coupling.stiffness is not None
    assert abs(apart) < LOAD.coulomb / scene.coupling.stiffness
    shared_nm = (TARGET_RAD - WALL_RAD) / (1.0 / K_HAND + 1.0 / K_WALL)
    assert felt_nm.mean() == pytest.approx(-shared_nm, abs=LOAD.coulomb)
    assert pressed_nm == pytest.approx(shared_nm, abs=2.0 * LOAD.coulomb)
    # F_h and F_e change by M / T with a unit of Present Velocity, 0.024 rad/s, in 0.05 of a second after their filters.
    assert np.ptp(felt_nm) < 0.2
