"""Driver of Force Dimension devices against a stand-in of the SDK: calls, frames, units, forces, faults."""

import math
import threading
import time
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.haptic.standins import RIGHT_HANDED, Failing, Standin, axes_matrix, built, rotation_matrix
from tests.haptic.ticks import HALF, REST, STIFFNESS, at_rest, begun, step, until

from haptether.bridge import load_master
from haptether.bridge.devices.standalone import StandaloneRun, wait_until
from haptether.checklist import Checklist, RefusedError
from haptether.master.force_dimension import ForceDimension
from haptether.master.force_dimension.driver import Session

pytestmark = pytest.mark.live

OMEGA_3, OMEGA_7, SIGMA_7 = 33, 35, 104
SLOW: dict[str, Any] = {"watchdog_s": 0.0318}
SLACK = 50.0
"""Factor on the watchdog's time: test machines may pause a process for longer. Only the watchdog test uses 1."""


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Standin:
    return Standin(built("force_dimension/dhd.c", tmp_path_factory.mktemp("dhd")))


@pytest.fixture
def dhd(shared: Standin) -> Standin:
    """Return the same library for each test, in its state after loading."""
    shared.reset()
    shared.set(watchdog_slack=SLACK)
    return shared


def opened(dhd: Standin, **options: Any) -> closing[ForceDimension]:  # noqa: ANN401  # options of the driver
    return begun(ForceDimension(**{"library": str(dhd.path), **SLOW, **options}))


# ------------------------------------------------------------------------------------------------------ order of calls


def test_forces_are_off_until_the_first_write_and_the_device_is_closed_without_force(dhd: Standin) -> None:
    with opened(dhd, serial=1234) as driver:
        assert dhd.calls() == [
            "dhdEnableExpertMode()", "dhdGetDeviceCount()", "dhdOpenSerial(1234)", "dhdEnableForce(0)", "dhdGetStatus",
            "dhdSetGravityCompensation(1)", "dhdSetWatchdog(254)", "dhdGetWatchdog()", "dhdSetWatchdog(0)",
        ]  # fmt: skip
        # A running watchdog would trip before the first force.
        assert (dhd.get("watchdog"), dhd.get("force"), dhd.get("brake")) == (0, 0, 1)
        driver.read()
        assert dhd.get("force") == 0
        driver.write((1.0, 0.0, 0.0))
        assert dhd.get("force") == 1
        step(driver, (1.0, 0.0, 0.0), 3)
    calls = dhd.calls()
    begin = calls.index("dhdEnableForce(1)")
    assert calls[begin : begin + 3] == [
        "dhdEnableForce(1)", "dhdSetForceAndTorqueAndGripperForce", "dhdSetWatchdog(254)",
    ]  # fmt: skip
    assert calls[-3:] == ["dhdStop()", "dhdSetWatchdog(0)", "dhdClose()"]
    assert "dhdSetForceAndTorqueAndGripperForce" in calls[-8:-3]
    assert (dhd.get("open"), dhd.get("force"), dhd.get("brake")) == (0, 0, 1)


def test_it_is_found_by_its_name(dhd: Standin) -> None:
    driver = load_master("force-dimension", {"library": str(dhd.path)})
    assert isinstance(driver, ForceDimension)
    assert (driver.kinds, driver.paces) == (("linear",), False)
    assert not hasattr(driver, "write_trigger")


# ------------------------------------------------------------------------------------------------ frames, signs, units


@pytest.mark.parametrize("model", [OMEGA_3, OMEGA_7, SIGMA_7])
@pytest.mark.parametrize(
    ("axes", "ours"),
    [(["x", "y", "z"], (0.02, 0.01, -0.03)), (["-y", "x", "z"], (-0.01, 0.02, -0.03)), (["z"], (-0.03,))],
)
def test_positions_and_forces_are_turned_into_our_frame(
    dhd: Standin, model: int, axes: list[str], ours: tuple[float, ...]
) -> None:
    dhd.set(type=model, hand_x=0.03, hand_y=0.01, hand_z=-0.02)
    with opened(dhd, axes=axes, origin=(0.01, 0.0, 0.01), device_velocity=True) as driver:
        rest = (0.0,) * len(axes)
        sample = until(driver, lambda sample: at_rest(sample) and np.allclose(sample.position, ours, atol=1e-5), rest)
        assert (sample.fault, sample.orientation, sample.trigger) == (None, None, None)
        # 2 N on a spring of 200 N/m: 10 mm along the first of our axes.
        force = (2.0, 0.0, 0.0)[: len(axes)]
        moving = until(driver, lambda sample: not at_rest(sample), force)
        assert moving.velocity is not None
        assert moving.velocity[0] > 0.0  # type: ignore[index]
        pushed = (ours[0] + 2.0 / STIFFNESS, *ours[1:])
        until(driver, lambda sample: np.allclose(sample.position, pushed, atol=1e-5), force)
        commanded = [0.0, 0.0, 0.0]
        commanded["xyz".index(axes[0].removeprefix("-"))] = -2.0 if axes[0].startswith("-") else 2.0
        assert dhd.force() == tuple(commanded)
    used = "dhdSetForce" if model == OMEGA_3 else "dhdSetForceAndTorqueAndGripperForce"
    assert {call for call in dhd.calls() if call.startswith("dhdSetForce")} == {used}


def test_a_pose_is_turned_and_an_active_wrist_exerts_torque(dhd: Standin) -> None:
    # The rotation is about the device's x; with axes -y, x, z it is about our y.
    dhd.set(type=SIGMA_7, qw=HALF, qx=HALF)
    with opened(dhd, wrist=True, axes=["-y", "x", "z"], max_torque_n_m=0.5) as driver:
        assert driver.kinds == ("linear", "pose")
        sample = step(driver, (0.0, 0.0, 1.0), 3, (0.05, 0.0, 0.1))
        assert sample.orientation == pytest.approx((HALF, 0.0, HALF, 0.0))
        assert [dhd.get(name) for name in ("tx", "ty", "tz")] == pytest.approx([0.0, -0.05, 0.1])
        # CHAI3D allows 0.2 N m for this model, regardless of the option.
        step(driver, REST, 3, (0.0, 0.0, 0.9))
        assert dhd.get("tz") == pytest.approx(0.2)
        step(driver, REST, 3)
        assert dhd.get("tz") == 0.0


@settings(max_examples=15)
@given(st.sampled_from(RIGHT_HANDED), st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_whatever_the_axes_and_the_turn_are_all_is_in_one_frame(
    shared: Standin, axes: list[str], parts: list[float]
) -> None:
    """Check by matrices, which the driver does not use: R is C R C^T, a point C x, a force C^T f."""
    norm = float(np.linalg.norm(parts))
    quat = np.array(parts) / norm if norm > 0.1 else np.array([1.0, 0.0, 0.0, 0.0])
    turn, dhd = axes_matrix(axes), shared
    dhd.reset()
    dhd.set(qw=quat[0], qx=quat[1], qy=quat[2], qz=quat[3], type=SIGMA_7, watchdog_slack=SLACK)
    force = np.array([0.3, -0.2, 0.1])
    with opened(dhd, wrist=True, axes=axes) as driver:
        sample = until(driver, lambda sample: sample.fault is None)
        assert sample.orientation is not None
        seen = rotation_matrix(np.array(sample.orientation))
        np.testing.assert_allclose(seen, turn @ rotation_matrix(quat) @ turn.T, atol=1e-9)
        driver.read()
        driver.write(tuple(force), tuple(0.1 * force))
        np.testing.assert_allclose(dhd.force(), turn.T @ force, atol=1e-12)
        np.testing.assert_allclose([dhd.get(name) for name in ("tx", "ty", "tz")], 0.1 * turn.T @ force, atol=1e-12)


def test_a_passive_wrist_exerts_no_torque_and_says_so(dhd: Standin, capfd: pytest.CaptureFixture[str]) -> None:
    dhd.set(type=OMEGA_7, qw=HALF, qz=-HALF)
    with opened(dhd, wrist=True) as driver:
        sample = step(driver, (1.0, 0.0, 0.0), 3, (0.1, 0.1, 0.1))
        # Both signs describe the same orientation.
        assert sample.orientation is not None
        assert abs(np.dot(sample.orientation, (HALF, 0.0, 0.0, -HALF))) == pytest.approx(1.0)
        assert dhd.force() == (1.0, 0.0, 0.0)
        assert [dhd.get(name) for name in ("tx", "ty", "tz")] == [0.0, 0.0, 0.0]
    assert "torque: none is exerted: its wrist is turned and does not turn" in capfd.readouterr().err


def test_buttons_are_the_bits_of_the_device(dhd: Standin) -> None:
    dhd.set(buttons=0b101)
    with opened(dhd) as driver:
        assert driver.read().buttons == 0b101


def test_the_gripper_is_a_trigger_that_pushes_the_finger(dhd: Standin) -> None:
    options: dict[str, Any] = {"gripper_open_m": 0.03, "gripper_closed_m": 0.01}
    with opened(dhd, **options) as driver:
        until(driver, lambda sample: sample.trigger == pytest.approx(0.0, abs=1e-3))
        dhd.set(finger=0.02)
        until(driver, lambda sample: sample.trigger == pytest.approx(0.5, abs=1e-3))
        # Closing is positive; 1 N on the finger's spring of 200 N/m is 5 mm of its 20 mm stroke.
        driver.write_trigger(1.0)
        until(driver, lambda sample: sample.trigger == pytest.approx(0.75, abs=1e-3))
        assert dhd.get("fg") == -1.0
        driver.write_trigger(-100.0)
        step(driver)
        assert dhd.get("fg") == 4.0
        # Zero acts at once, not with the next `write`.
        driver.write_trigger(0.0)
        assert dhd.get("fg") == 0.0
        driver.write_trigger(math.nan)
        step(driver)
        assert dhd.get("fg") == 0.0
        dhd.set(finger=0.05)
        until(driver, lambda sample: sample.trigger == 0.0)
    with opened(dhd, gripper_sign=1, **options) as driver:
        step(driver)
        driver.write_trigger(1.0)
        step(driver)
        assert dhd.get("fg") == 1.0


def test_gravity_compensation_holds_the_weight_with_every_force(dhd: Standin) -> None:
    weight_kg = 0.1
    dhd.set(weight_kg=weight_kg)
    with opened(dhd, effector_mass_kg=0.05) as driver:
        assert "dhdSetEffectorMass(0.05)" in dhd.calls()
        until(driver, lambda sample: np.allclose(sample.position, REST, atol=1e-5))
    with opened(dhd, gravity_compensation=False) as driver:
        sunk = -weight_kg * 9.81 / STIFFNESS
        until(driver, lambda sample: np.allclose(sample.position, (0.0, 0.0, sunk), atol=1e-5))


def test_long_forces_are_shortened_and_bad_ones_are_none(dhd: Standin) -> None:
    with opened(dhd, max_force_n=1.0) as driver:
        step(driver, (3.0, 0.0, 4.0))
        assert dhd.force() == pytest.approx((0.6, 0.0, 0.8))
        step(driver, (float("nan"), 0.0, 0.0))
        assert dhd.force() == REST
        assert driver.read().fault is None
    # CHAI3D allows 12 N for an omega, regardless of the option.
    dhd.set(hand_k=2000)
    with opened(dhd, max_force_n=20.0) as driver:
        step(driver, (0.0, 19.0, 0.0))
        assert dhd.force() == pytest.approx((0.0, 12.0, 0.0))


def test_a_force_is_exerted_only_for_a_tick_that_was_read(dhd: Standin) -> None:
    with opened(dhd) as driver:
        step(driver, (1.0, 0.0, 0.0))
        assert dhd.force() == (1.0, 0.0, 0.0)
        driver.write((1.0, 0.0, 0.0))
        assert dhd.force() == REST


def test_the_controller_ends_the_force_of_a_process_that_hangs(dhd: Standin) -> None:
    with opened(dhd) as driver:
        step(driver, (1.0, 0.0, 0.0), 3)
        assert (dhd.get("watchdog"), dhd.force()) == (254, (1.0, 0.0, 0.0))
        dhd.set(watchdog_slack=1)
        time.sleep(0.1)
        assert (dhd.force(), dhd.get("cause")) == (REST, 3)
        sample = until(driver, lambda sample: sample.fault is not None, (1.0, 0.0, 0.0))
        assert sample.fault is not None
        assert "watchdog: its controller got no new force in time" in sample.fault


# --------------------------------------------------------------------------------------------------------- checklist


@pytest.mark.parametrize(
    ("numbers", "options", "said"),
    [
        ({"devices": 0}, {}, "devices: 0: is it plugged in and on, and may this user open it?"),
        ({"devices": 2}, {}, "devices: 2: give serial"),
        ({}, {"serial": 99}, "open: dhdOpenSerial: error 5, no device found: is it plugged in"),
        ({"in_use": 1}, {}, "open: dhdOpenID: error 20, another error: another program has it: end that"),
        ({"power": 0}, {}, "status: no power: is its supply on?"),
        ({"started": 0}, {}, "status: not started: switch it off and on"),
        ({"reset": 1}, {}, "status: not calibrated: put its end-effector into its rest position"),
        ({"error": 1}, {}, "status: error of its controller"),
        ({"type": OMEGA_3}, {"wrist": True}, "wrist: none: leave out the option wrist"),
        ({"type": OMEGA_3}, {"gripper_open_m": 0.03}, "gripper: none: leave out the option gripper_open_m"),
        ({"watchdog_there": 0}, {}, "watchdog: none (dhdSetWatchdog: error 6, not available): a killed process"),
        ({"watchdog_rounds": 1}, {}, "watchdog: 31 ms without a force: must be 31.75 ms, as was asked for"),
    ],
)
def test_a_device_that_is_not_ready_is_refused_and_closed(
    dhd: Standin, numbers: dict[str, float], options: dict[str, Any], said: str
) -> None:
    dhd.set(**numbers)
    driver = ForceDimension(**{"library": str(dhd.path), **SLOW, **options})
    with pytest.raises(RefusedError) as refused:
        driver.open()
    driver.close()
    assert said in str(refused.value)
    assert (dhd.get("open"), dhd.get("force")) == (0, 0)
    assert "dhdEnableForce(1)" not in dhd.calls()


def test_a_device_that_ends_its_answers_while_it_opens_is_closed(dhd: Standin) -> None:
    dhd.fail("dhdSetGravityCompensation", 2)
    with pytest.raises(RefusedError, match="device: dhdSetGravityCompensation: error 2, communication error: see its"):
        ForceDimension(library=str(dhd.path)).open()
    assert dhd.get("open") == 0


def test_a_device_without_a_watchdog_is_taken_where_that_is_asked_for(dhd: Standin) -> None:
    dhd.set(watchdog_there=0)
    with opened(dhd, require_watchdog=False) as driver:
        assert step(driver, (1.0, 0.0, 0.0), 5).fault is None
        assert dhd.force() == (1.0, 0.0, 0.0)


def test_the_checklist_says_what_changes_forces(dhd: Standin, capfd: pytest.CaptureFixture[str]) -> None:
    with opened(dhd, gravity_compensation=False):
        pass
    told = capfd.readouterr().err
    for line in (
        f"library: {dhd.path}", "device: omega.7, serial number 1234", "status: on, calibrated",
        "frame: base plate at 40°", "force: at most 4 N; CHAI3D has 12 N for this model",
        "gravity compensation: off: it falls", "watchdog: 31.75 ms without a force",
    ):  # fmt: skip
        assert f"force-dimension: ok       {line}" in told


# ------------------------------------------------------------------------------------------------------------ faults


FAULTS: list[tuple[dict[str, float], dict[str, float], str]] = [
    ({"force_button": 1}, {"force_button": 0}, "force button: forces were switched off at the device"),
    ({"fastest": -1}, {"fastest": 2}, "over-speed: it braked"),
    ({"power": 0}, {"power": 1}, "no power: "),
    ({"reset": 1}, {"reset": 0}, "not calibrated: "),
    ({"error": 1}, {"error": 0}, "error of its controller: "),
    ({"timeguard": 1}, {"timeguard": 0}, "no new position: 20 in a row were old"),
    ({"nan": 1}, {"nan": 0}, "malformed sample: position [nan, "),
    ({"position_scale": 1000.0}, {"position_scale": 0}, "malformed sample: position ["),
    ({"bad_matrix": 1}, {"bad_matrix": 0}, "malformed sample: orientation "),
    ({"nan_gap": 1}, {"nan_gap": 0}, "malformed sample: gripper [nan]: must be finite"),
    ({"connected": 0}, {"connected": 1}, "error 2, communication error: see its USB cable"),
]


@pytest.mark.parametrize(("wrong", "mended", "said"), FAULTS)
def test_a_fault_is_named_ends_the_force_and_stays_until_it_is_acknowledged(
    dhd: Standin, wrong: dict[str, float], mended: dict[str, float], said: str
) -> None:
    with opened(dhd, wrist=True, gripper_open_m=0.03) as driver:
        assert step(driver, (0.5, 0.0, 0.0), 40).fault is None
        assert dhd.force() == (0.5, 0.0, 0.0)
        driver.write_trigger(1.0)
        dhd.set(**wrong)
        sample = until(driver, lambda sample: sample.fault is not None, (0.5, 0.0, 0.0))
        assert sample.fault is not None
        assert said in sample.fault
        # The driver exerts no force, whatever the command; the fault stays though its cause is gone.
        dhd.set(**mended)
        step(driver, (0.5, 0.0, 0.0), 10)
        driver.write_trigger(1.0)
        assert (dhd.force(), dhd.get("fg"), dhd.get("force")) == (REST, 0.0, 0.0)
        assert driver.read().fault is not None
        # One acknowledgement is enough, or two after a lost device: the operator must see its new state first.
        end_s = time.monotonic() + 10.0
        while step(driver, (0.5, 0.0, 0.0)).fault is not None:
            assert time.monotonic() < end_s, driver.read()
            driver.acknowledge()
            time.sleep(0.01)
        assert step(driver, (0.5, 0.0, 0.0), 10).fault is None
        assert dhd.force() == (0.5, 0.0, 0.0)
        assert dhd.get("watchdog") == 254
    assert dhd.get("open") == 0


@pytest.mark.parametrize("call", ["dhdSetForceAndTorqueAndGripperForce", "dhdGetPosition", "dhdGetStatus"])
@pytest.mark.parametrize(("error", "said", "calls"), [(2, "acknowledge to open it anew", 1), (7, ", acknowledge", 0)])
def test_a_call_that_fails_once_is_a_fault_and_what_is_lost_is_opened_anew(
    dhd: Standin, call: str, error: int, said: str, calls: int
) -> None:
    with opened(dhd) as driver:
        step(driver, (0.5, 0.0, 0.0), 10)
        before = dhd.calls().count("dhdClose()")
        dhd.fail(call, error)
        sample = until(driver, lambda sample: sample.fault is not None, (0.5, 0.0, 0.0))
        assert sample.fault is not None
        assert f"{call}: error {error}, " in sample.fault
        assert said in sample.fault
        assert dhd.force() == REST
        end_s = time.monotonic() + 10.0
        while step(driver, (0.5, 0.0, 0.0)).fault is not None:
            assert time.monotonic() < end_s
            driver.acknowledge()
        assert dhd.calls().count("dhdClose()") - before == calls
        assert dhd.get("open") == 1


def test_a_stop_that_fails_is_tried_again(dhd: Standin) -> None:
    with opened(dhd) as driver:
        step(driver, (0.5, 0.0, 0.0), 10)
        # The bus stalls: both the position and the stop fail, and the connection stays.
        dhd.fail("dhdGetPosition", 7)
        dhd.fail("dhdStop", 7, 3)
        assert until(driver, lambda sample: sample.fault is not None, (0.5, 0.0, 0.0)).fault is not None
        step(driver, (0.5, 0.0, 0.0), 5)
        assert dhd.force() == REST
        # The driver does not repeat a stop that has succeeded.
        before = dhd.calls().count("dhdStop()")
        step(driver, (0.5, 0.0, 0.0), 5)
        assert dhd.calls().count("dhdStop()") == before


def test_an_unplugged_device_is_not_taken_for_one_that_is_there(dhd: Standin) -> None:
    with opened(dhd) as driver:
        step(driver, (0.5, 0.0, 0.0), 5)
        dhd.set(connected=0)
        until(driver, lambda sample: sample.fault is not None)
        driver.acknowledge()
        sample = until(driver, lambda sample: "not ready: " in (sample.fault or ""))
        assert "no device found: is it plugged in" in (sample.fault or "")
        # The fault sample has the last position.
        assert sample.position is not None


def test_a_fault_that_nobody_has_seen_is_not_acknowledged(dhd: Standin) -> None:
    with opened(dhd) as driver:
        step(driver, ticks=5)
        dhd.fail("dhdSetForceAndTorqueAndGripperForce", 7)
        driver.read()
        driver.write((0.5, 0.0, 0.0))
        driver.acknowledge()
        assert driver.read().fault is not None
        driver.acknowledge()
        assert driver.read().fault is None


def test_it_is_closed_without_force_after_an_exception_of_its_loop(dhd: Standin) -> None:
    run = StandaloneRun(ForceDimension(library=str(dhd.path), **SLOW), Failing((1.0, 0.0, 0.0), 50))
    assert wait_until(lambda: run.finished, 20.0)
    assert (run.rests, "out of tune" in str(run.error)) == (True, True)
    assert dhd.get("largest") == 1.0
    assert dhd.calls()[-1] == "dhdClose()"
    assert (dhd.force(), dhd.get("open")) == (REST, 0)


def test_it_closes_whatever_it_was_in(dhd: Standin) -> None:
    driver = ForceDimension(library=str(dhd.path))
    driver.close()
    with opened(dhd) as driver:
        step(driver, (1.0, 0.0, 0.0), 3)
    driver.close()
    driver.write((1.0, 0.0, 0.0))
    assert driver.read().fault is not None
    assert dhd.calls().count("dhdClose()") == 1
    # The device is unplugged, so that every call of the close fails.
    with opened(dhd) as driver:
        step(driver, (1.0, 0.0, 0.0), 3)
        dhd.set(connected=0)
    assert dhd.get("open") == 0
    dhd.set(connected=1)
    # Close while the driver reopens the device.
    with opened(dhd) as driver:
        step(driver)
        dhd.fail("dhdGetPosition", 2)
        until(driver, lambda sample: sample.fault is not None)
        driver.acknowledge()
    assert dhd.get("open") == 0


def test_it_is_opened_again_as_new_and_not_twice(dhd: Standin) -> None:
    driver = ForceDimension(library=str(dhd.path), **SLOW)
    for _ in range(2):
        driver.open()
        with pytest.raises(ValueError, match="force-dimension: is open"):
            driver.open()
        assert step(driver, (1.0, 0.0, 0.0), 5).fault is None
        assert dhd.force() == (1.0, 0.0, 0.0)
        dhd.fail("dhdGetPosition", 2)
        until(driver, lambda sample: sample.fault is not None)
        driver.close()
        assert dhd.get("open") == 0


def test_what_is_closed_while_it_opens_is_closed(dhd: Standin, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = ForceDimension(library=str(dhd.path), **SLOW)
    connect = driver._connect

    def slowly(checklist: Checklist) -> Session:
        session = connect(checklist)
        # Another thread closes the device at this moment.
        driver.close()
        return session

    monkeypatch.setattr(driver, "_connect", slowly)
    with pytest.raises(RefusedError, match="closed before it was open"):
        driver.open()
    assert dhd.get("open") == 0


def test_what_is_opened_anew_after_the_end_is_closed(dhd: Standin, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("haptether.master.vendor.device.JOIN_S", 0.05)
    goes_on = threading.Event()
    with opened(dhd) as driver:
        step(driver)
        connect = driver._connect

        def slowly(checklist: Checklist) -> Session:
            goes_on.wait(20.0)
            return connect(checklist)

        monkeypatch.setattr(driver, "_connect", slowly)
        dhd.fail("dhdGetPosition", 2)
        until(driver, lambda sample: sample.fault is not None)
        driver.acknowledge()
        reopening = driver._reopening
    goes_on.set()
    assert reopening is not None
    reopening.join(20.0)
    assert (reopening.is_alive(), dhd.get("open"), dhd.calls()[-1]) == (False, 0, "dhdClose()")


# ----------------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"axes": ["x", "z", "y"]}, "left-handed"),
        ({"origin": [2.0, 0.0, 0.0]}, "must be within 1 m"),
        ({"max_force_n": 0.0}, "must be above 0 and at most 20 N"),
        ({"max_torque_n_m": 2.0}, "must be above 0 and at most 1 N m"),
        ({"watchdog_s": 0.04}, "watchdog_s = 0.04: must be 0.002 to 0.0318 s"),
        ({"gripper_sign": 0}, "must be -1 or 1"),
        ({"gripper_open_m": 0.01, "gripper_closed_m": 0.01}, "must be at least 1 mm above gripper_closed_m = 0.01"),
        ({"wrist": True, "axes": ["x"]}, "must be false with fewer than three axes"),
        ({"serial": "nan"}, "must be finite"),
        ({"speed": 1}, "is no option: must be one of library, serial"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match="driver = force-dimension") as refused:
        ForceDimension(**options)
    assert said in str(refused.value)


def test_the_watchdog_is_in_steps_of_125_us() -> None:
    for seconds, steps in ((0.002, 16), (0.02, 160), (0.0318, 254)):
        assert ForceDimension(watchdog_s=seconds).options.watchdog_steps == steps
