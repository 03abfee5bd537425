"""The driver of a Touch against a stand-in of OpenHaptics: calls, frames, units, forces, faults, stale forces."""

import ctypes
import time
from collections.abc import Callable
from contextlib import closing
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.haptic.standins import RIGHT_HANDED, Failing, Standin, axes_matrix, built, rotation_matrix
from tests.haptic.ticks import REST, STIFFNESS, at_rest, begun, step, until

from haptether._core import HdCallback
from haptether.bridge import load_master
from haptether.bridge.devices.standalone import StandaloneRun, wait_until
from haptether.checklist import RefusedError
from haptether.master.touch import Touch

pytestmark = pytest.mark.live

SLOW: dict[str, Any] = {"watchdog_s": 0.05, "sample_timeout_s": 0.018}
NEEDS_UPDATE, NEEDS_HAND = 0x5001, 0x5002


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Standin:
    return Standin(built("touch/hd.c", tmp_path_factory.mktemp("hd")))


@pytest.fixture
def hd(shared: Standin) -> Standin:
    """Return the same library for each test, in its initial state."""
    shared.reset()
    return shared


def opened(hd: Standin, **options: Any) -> closing[Touch]:  # noqa: ANN401  # options of the driver
    return begun(Touch(**{"library": str(hd.path), **SLOW, **options}))


def exerted(hd: Standin, driver: Touch, force: tuple[float, ...], wanted: tuple[float, float, float]) -> None:
    """Assert that the device exerts a force, in its own frame, within some ticks."""
    until(driver, lambda _: np.allclose(hd.force(), wanted, atol=1e-9), force)


# ------------------------------------------------------------------------------------------------------ order of calls


def test_it_is_opened_scheduled_and_closed_in_the_order_of_the_vendor(hd: Standin) -> None:
    with opened(hd) as driver:
        calls = hd.calls()
        assert calls[: calls.index("hdStartScheduler()") + 1] == [
            "hdInitDevice(NULL)", "hdMakeCurrentDevice", "hdCheckCalibration", "hdEnable(0x4000)", "hdEnable(0x4001)",
            "hdScheduleAsynchronous(priority 0x7FFF)", "hdStartScheduler()",
        ]  # fmt: skip
        # A frame is begun, read, written and ended.
        frame = calls[calls.index("hdStartScheduler()") + 1 :]
        assert frame == [
            "hdMakeCurrentDevice", "hdBeginFrame", "hdGetDoublev(transform)", "hdGetDoublev(velocity)",
            "hdGetIntegerv(buttons)", "hdCheckCalibration", "hdSetDoublev(force)", "hdEndFrame",
        ]  # fmt: skip
        assert driver.period_s == 1e-3
        step(driver, (1.0, 0.0, 0.0), 5)
    calls = hd.calls()
    assert calls[calls.index("callback: done") :] == [
        "callback: done", "hdUnschedule(1)", "hdStopScheduler()", "hdMakeCurrentDevice", "hdDisable(0x4000)",
        "hdDisableDevice(0)",
    ]  # fmt: skip
    assert (hd.get("open"), hd.get("scheduler"), hd.get("output")) == (0, 0, 0)


def test_it_is_found_by_its_name_and_device_by_its_own(hd: Standin) -> None:
    driver = load_master("touch", {"library": str(hd.path)})
    assert isinstance(driver, Touch)
    assert (driver.kinds, driver.paces) == (("linear",), True)
    with opened(hd, device_name="Left"):
        assert "hdInitDevice(Left)" in hd.calls()


def test_each_sample_is_a_new_frame_and_its_device_paces(hd: Standin) -> None:
    with opened(hd) as driver:
        step(driver)
        begun_s, first = time.monotonic(), hd.get("ticks")
        step(driver, REST, 200)
        assert time.monotonic() - begun_s > 0.15
        assert hd.get("ticks") - first >= 199


# ------------------------------------------------------------------------------------------------ frames, signs, units


@pytest.mark.parametrize(
    ("axes", "ours", "pushed"),
    [
        # The device has x right, y up, z to the user; ours has x to the user, y right, z up.
        (None, (0.03, 0.01, 0.02), (0.0, 0.0, 2.0)),
        (["x", "-z", "y"], (0.01, -0.03, 0.02), (2.0, 0.0, 0.0)),
        (["-y"], (-0.02,), (0.0, -2.0, 0.0)),
    ],
)
def test_positions_and_forces_are_turned_into_our_frame(
    hd: Standin, axes: list[str] | None, ours: tuple[float, ...], pushed: tuple[float, float, float]
) -> None:
    hd.set(hand_x=0.02, hand_y=0.02, hand_z=0.03)
    chosen: dict[str, Any] = {} if axes is None else {"axes": axes}
    with opened(hd, origin=(0.01, 0.0, 0.0), device_velocity=True, **chosen) as driver:
        rest = (0.0,) * len(ours)
        sample = until(driver, lambda sample: at_rest(sample) and np.allclose(sample.position, ours, atol=1e-5), rest)
        assert (sample.fault, sample.orientation, sample.trigger, sample.buttons) == (None, None, None, 0)
        # 2 N on a spring of 200 N/m are 10 mm along the first of our axes.
        force = (2.0, 0.0, 0.0)[: len(ours)]
        moving = until(driver, lambda sample: not at_rest(sample), force)
        assert moving.velocity is not None
        assert 0.0 < moving.velocity[0] < 5.0  # type: ignore[index]
        there = (ours[0] + 2.0 / STIFFNESS, *ours[1:])
        until(driver, lambda sample: np.allclose(sample.position, there, atol=1e-5), force)
        exerted(hd, driver, force, pushed)


def test_a_pose_is_turned_into_our_frame_and_torque_is_left_out(hd: Standin, capfd: pytest.CaptureFixture[str]) -> None:
    # The turn is about the device's y, which is up: our z. A transform read row by row would turn the other way.
    hd.set(qw=np.cos(0.3), qy=np.sin(0.3), buttons=0b10)
    with opened(hd, orientation=True) as driver:
        assert driver.kinds == ("linear", "pose")
        sample = until(driver, lambda sample: sample.fault is None)
        assert sample.orientation == pytest.approx((np.cos(0.3), 0.0, 0.0, np.sin(0.3)))
        assert sample.buttons == 0b10
        driver.read()
        driver.write((0.0, 0.0, 1.0), (0.0, 0.0, 0.3))
    assert "torque: none is exerted: the stylus is turned and does not turn" in capfd.readouterr().err


@settings(max_examples=15)
@given(st.sampled_from(RIGHT_HANDED), st.lists(st.floats(-1.0, 1.0), min_size=4, max_size=4))
def test_whatever_the_axes_and_the_turn_are_all_is_in_one_frame(
    shared: Standin, axes: list[str], parts: list[float]
) -> None:
    """R is C R C^T, a point C x, a force C^T f; by matrices, which the driver does not use."""
    norm = float(np.linalg.norm(parts))
    quat = np.array(parts) / norm if norm > 0.1 else np.array([1.0, 0.0, 0.0, 0.0])
    turn, hd = axes_matrix(axes), shared
    hd.reset()
    hd.set(qw=quat[0], qx=quat[1], qy=quat[2], qz=quat[3])
    force = np.array([0.3, -0.2, 0.1])
    with opened(hd, orientation=True, axes=axes) as driver:
        sample = until(driver, lambda sample: sample.fault is None)
        assert sample.orientation is not None
        seen = rotation_matrix(np.array(sample.orientation))
        np.testing.assert_allclose(seen, turn @ rotation_matrix(quat) @ turn.T, atol=1e-9)
        x, y, z = (turn.T @ force).tolist()
        exerted(hd, driver, tuple(force.tolist()), (x, y, z))


def test_long_forces_are_shortened_and_bad_ones_are_none(hd: Standin) -> None:
    with opened(hd, max_force_n=1.0) as driver:
        exerted(hd, driver, (3.0, 0.0, 4.0), (0.0, 0.8, 0.6))
        exerted(hd, driver, (float("nan"), 0.0, 0.0), REST)
    # The force is at most the device's own limit.
    hd.set(hand_k=2000)
    with opened(hd, max_force_n=9.0) as driver:
        exerted(hd, driver, (0.0, 8.0, 0.0), (3.3, 0.0, 0.0))
    assert hd.get("largest") == pytest.approx(3.3)


# ---------------------------------------------------------------------------------------------------- stale forces


def test_a_force_is_exerted_only_for_a_tick_that_was_read(hd: Standin) -> None:
    with opened(hd) as driver:
        exerted(hd, driver, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        driver.write((1.0, 0.0, 0.0))
        time.sleep(0.02)
        assert hd.force() == REST


def test_a_force_ends_where_its_loop_hangs(hd: Standin, capfd: pytest.CaptureFixture[str]) -> None:
    with opened(hd, watchdog_s=0.010) as driver:
        exerted(hd, driver, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        time.sleep(0.6)
        assert hd.force() == REST
        assert hd.library.standin_forced(100) == 0
        # The force returns with the next tick.
        exerted(hd, driver, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    assert driver.starved_ticks > 100
    assert "frames without force: none came in time" in capfd.readouterr().err


def test_a_force_ends_even_while_nobody_gives_the_interpreter_back(hd: Standin) -> None:
    """A callback in Python could not end the force: it waits for the lock."""
    holds = ctypes.PyDLL(None)  # unlike CDLL, its calls keep the interpreter's lock
    with opened(hd, watchdog_s=0.010) as driver:
        exerted(hd, driver, (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
        before = hd.get("ticks")
        driver.read()
        driver.write((1.0, 0.0, 0.0))
        holds.usleep(600_000)
        assert hd.get("ticks") - before > 100
        assert hd.library.standin_forced(100) == 0


# --------------------------------------------------------------------------------------------------------- checklist


@pytest.mark.parametrize(
    ("numbers", "options", "said"),
    [
        ({"there": 0}, {}, "device: the default one: communication (0x0302, internal -770): see its USB cable"),
        # The handle alone may indicate this.
        ({"there": 0, "silent_init": 1}, {}, "device: the default one: no handle: run the vendor's Touch_Setup"),
        ({}, {"device_name": "Right"}, "device: Right: communication"),
        ({"axes": 0}, {}, "force axes: 0: must be 3"),
        ({"calibration": NEEDS_HAND}, {}, "calibration: needs a hand: put the stylus into the inkwell"),
        # An update that takes the current pose as neutral needs a person.
        ({"calibration": NEEDS_UPDATE, "style": 1}, {}, "calibration: needs an update: put the stylus"),
        ({"max_force": 0}, {}, "force: the device says at most 0 N"),
        ({"rate": 60}, {}, "rate: 60 Hz: must be 400 to 4000 Hz"),
        ({"real_rate": 500}, {}, "frames a second: must be 1000, as the library says"),
        ({"no_scheduler": 1}, {}, "scheduler: timer (0x0304, internal -772)"),
        ({"hangs": 1}, {}, "scheduler: no frame within 2 s"),
    ],
)
def test_a_device_that_is_not_ready_is_refused_and_closed(
    hd: Standin, numbers: dict[str, float], options: dict[str, Any], said: str
) -> None:
    hd.set(**numbers)
    driver = Touch(**{"library": str(hd.path), **SLOW, **options})
    with pytest.raises(RefusedError) as refused:
        driver.open()
    driver.close()
    assert said in str(refused.value)
    assert (hd.get("open"), hd.get("output"), hd.get("scheduler")) == (0, 0, 0)


def test_a_stylus_in_its_inkwell_is_calibrated_at_the_begin(hd: Standin) -> None:
    hd.set(calibration=NEEDS_UPDATE)
    with opened(hd) as driver:
        assert "hdUpdateCalibration(4)" in hd.calls()
        until(driver, lambda sample: sample.fault is None)
        # In a run an update would move the position under the hand.
        hd.set(calibration=NEEDS_UPDATE)
        step(driver, REST, 250)
        assert hd.calls().count("hdUpdateCalibration(4)") == 1


# ------------------------------------------------------------------------------------------------------------ faults


def set_numbers(**numbers: float) -> Callable[[Standin], None]:
    return lambda hd: hd.set(**numbers)


def raise_error(code: int) -> Callable[[Standin], None]:
    return lambda hd: hd.error(code)


def nothing(hd: Standin) -> None:
    """Do nothing: the cause is gone by itself."""


FAULTS = [
    (raise_error(0x200), nothing, "warm motors (0x0200, internal -512): let it cool down"),
    (raise_error(0x201), nothing, "force too large (0x0201, "),
    (raise_error(0x203), nothing, "too fast (0x0203, "),
    (raise_error(0x402), nothing, "frame error (0x0402, "),
    (raise_error(0x777), nothing, "error (0x0777, "),
    (raise_error(0x300), nothing, "device fault (0x0300, "),
    (raise_error(0x304), nothing, "timer (0x0304, "),
    (set_numbers(connected=0), set_numbers(connected=1), "communication (0x0302, "),
    (set_numbers(calibration=NEEDS_HAND), set_numbers(calibration=0x5000), "not calibrated: put the stylus into the"),
    (set_numbers(nan=1), set_numbers(nan=0), "malformed sample: position [nan, "),
    (set_numbers(bad_matrix=1), set_numbers(bad_matrix=0), "malformed sample: orientation "),
    (set_numbers(hangs=1), set_numbers(hangs=0), "no frame of the vendor's scheduler within 0.018 s"),
]


@pytest.mark.parametrize(("wrong", "mended", "said"), FAULTS)
def test_a_fault_is_named_ends_the_force_and_stays_until_it_is_acknowledged(
    hd: Standin, wrong: Callable[[Standin], None], mended: Callable[[Standin], None], said: str
) -> None:
    with opened(hd, orientation=True) as driver:
        exerted(hd, driver, (0.5, 0.0, 0.0), (0.0, 0.0, 0.5))
        wrong(hd)
        end_s = time.monotonic() + 10.0
        while (sample := step(driver, (0.5, 0.0, 0.0))).fault is None:
            assert time.monotonic() < end_s
        assert sample.fault is not None
        assert said in sample.fault
        # There is no force for any command, and the fault stays though its cause is gone.
        mended(hd)
        step(driver, (0.5, 0.0, 0.0), 10)
        time.sleep(0.02)
        assert hd.force() == REST
        assert driver.read().fault is not None
        # One acknowledgement suffices, or two after a lost device: its new state must be seen first.
        while step(driver, (0.5, 0.0, 0.0)).fault is not None:
            assert time.monotonic() < end_s, driver.read()
            driver.acknowledge()
            time.sleep(0.01)
        exerted(hd, driver, (0.5, 0.0, 0.0), (0.0, 0.0, 0.5))
    assert (hd.get("open"), hd.get("scheduler")) == (0, 0)


def test_a_scheduler_that_has_stopped_is_lost_and_opened_anew(hd: Standin) -> None:
    with opened(hd) as driver:
        step(driver, REST, 3)
        hd.set(hangs=1)
        end_s = time.monotonic() + 10.0
        while "since 0.5 s: acknowledge to open it anew" not in (driver.read().fault or ""):
            assert time.monotonic() < end_s
            driver.acknowledge()
        hd.set(hangs=0)
        while step(driver).fault is not None:
            assert time.monotonic() < end_s
            driver.acknowledge()
    assert hd.calls().count("hdDisableDevice(0)") == 2


def test_a_frame_that_does_not_come_is_waited_for_no_longer_than_the_option_says(hd: Standin) -> None:
    taken = []
    for _ in range(5):
        with opened(hd) as driver:
            step(driver, REST, 3)
            hd.set(hangs=1)
            step(driver, REST, 2)
            begun_s = time.monotonic()
            assert driver.read().fault is not None
            taken.append(time.monotonic() - begun_s)
            hd.set(hangs=0)
    # The default is 15 ms; delays by the machine are not the driver's.
    assert min(taken) < 0.1
    with pytest.raises(ValueError, match="sample_timeout_s"):
        Touch(library=str(hd.path), sample_timeout_s=0.019)


def test_it_is_closed_without_force_after_an_exception_of_its_loop(hd: Standin) -> None:
    run = StandaloneRun(Touch(library=str(hd.path), **SLOW), Failing((1.0, 0.0, 0.0), 50))
    assert wait_until(lambda: run.finished, 20.0)
    assert (run.rests, "out of tune" in str(run.error)) == (True, True)
    assert hd.get("largest") == 1.0
    assert (hd.calls()[-1], hd.get("scheduler"), hd.get("output")) == ("hdDisableDevice(0)", 0, 0)


def test_it_closes_whatever_it_was_in(hd: Standin) -> None:
    driver = Touch(library=str(hd.path))
    driver.close()
    with opened(hd) as driver:
        step(driver, (1.0, 0.0, 0.0), 3)
    driver.close()
    driver.write((1.0, 0.0, 0.0))
    assert driver.read().fault is not None
    assert hd.calls().count("hdDisableDevice(0)") == 1
    # The scheduler does not reach the last frame.
    with opened(hd) as driver:
        step(driver, (1.0, 0.0, 0.0), 3)
        hd.set(hangs=1)
    assert (hd.get("open"), hd.get("scheduler"), hd.get("output")) == (0, 0, 0)
    hd.set(hangs=0)
    # The device is closed while it is reopened.
    with opened(hd) as driver:
        step(driver)
        hd.error(0x302)
        until(driver, lambda sample: "communication" in (sample.fault or ""))
        driver.acknowledge()
    assert (hd.get("open"), hd.get("scheduler")) == (0, 0)


# ----------------------------------------------------------------------------------------------------------- options


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ({"axes": ["x", "z", "y"]}, "left-handed"),
        ({"origin": [0.0, -2.0, 0.0]}, "must be within 1 m"),
        ({"max_force_n": 0.0}, "must be above 0 and at most 10 N"),
        ({"watchdog_s": 0.2}, "watchdog_s = 0.2: must be 0.003 to 0.05 s"),
        ({"sample_timeout_s": 0.02}, "must be 0.003 to 0.018 s"),
        ({"orientation": True, "axes": ["x"]}, "must be false with fewer than three axes"),
        ({"device_name": "a\0b"}, "must be a name"),
        ({"speed": 1}, "is no option: must be one of library, device_name"),
    ],
)
def test_bad_options_are_refused(options: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match="driver = touch") as refused:
        Touch(**options)
    assert said in str(refused.value)


@pytest.mark.parametrize(
    ("functions", "watchdog_s", "max_force_n", "said"),
    [
        ([1] * 7 + [0], 0.01, 1.0, "functions: must be eight addresses"),
        ([1] * 8, 0.2, 1.0, "watchdog_s = 0.2: must be 0.001 to 0.1 s"),
        ([1] * 8, float("nan"), 1.0, "watchdog_s = NaN"),
        ([1] * 8, 0.01, float("inf"), "max_force_n = inf: must be above 0 N"),
    ],
)
def test_a_callback_of_what_cannot_be_is_refused(
    functions: list[int], watchdog_s: float, max_force_n: float, said: str
) -> None:
    with pytest.raises(ValueError, match="must be") as refused:
        HdCallback(functions, 0, watchdog_s=watchdog_s, max_force_n=max_force_n)
    assert said in str(refused.value)
