"""Invalid numbers from the device and from Python."""

import math
import secrets
import sys
import time
from collections.abc import Callable
from functools import partial

import numpy as np
from numpy.typing import NDArray
from tests.faults.rows import Complaints, Row
from tests.faults.signals import NAMES
from tests.faults.virtual import CLEAN, PERIOD_S
from tests.scene.two_sides import reports, two_sides

from haptether.bridge import LiveMaster, LiveSlave, scene_json, simulate
from haptether.cli.live.sides import baseline_scene
from haptether.master import Hand, HapticDevice
from haptether.safety import DeviceModel, LimiterSettings, SafetyLayer, SafetySettings, SafetyTicks, fault_message
from haptether.slave import Wall
from haptether.studies import RAVEN_ATTACKS
from haptether.studies.raven import measure_attack

BAD = {"NaN": math.nan, "+Inf": math.inf, "-Inf": -math.inf, "1e300": 1e300, "largest": sys.float_info.max}
TINY = {"denormal": 5e-324, "-denormal": -2.2e-308, "-0": -0.0}
TICKS, AT = 400, 200
PUSH_S = 1.0
"""Time in s after engaging."""
OF_SLAVE = "fault of the slave: environment force exceeds 10000 N"


def from_device(signal: str) -> Row:
    """Measure one bad sample in a master tick: fault and zero force in the same tick, latched."""
    found = Complaints()
    worst_ticks, force_n, reasons = 0, 0.0, set()
    for name, bad in BAD.items():
        ticks = _layer(signal, bad)
        faulty = np.flatnonzero(ticks.fault)
        if not faulty.size:
            found.check(False, f"{name}: no fault")
            continue
        reasons.add(str(fault_message(int(ticks.fault[AT]))))
        worst_ticks = max(worst_ticks, int(faulty[0]) - AT)
        force_n = max(force_n, float(np.abs(ticks.device_force[AT:]).max()))
        found.check(np.abs(ticks.device_force[:AT]).max() > 0.5, f"{name}: no force before it")
        found.check(faulty.tolist() == list(range(AT, TICKS)), f"{name}: faulty at {faulty[:3].tolist()}...")
    found.check(worst_ticks == 0, f"{worst_ticks} ticks late")
    found.check(force_n == 0.0, f"{force_n:g} N after it")
    return Row(
        fault=f"{', '.join(BAD)} from the device: {signal.replace('_', ' ')}", how="calls",
        expected="fault, zero force in the same tick, latched", measured="; ".join(sorted(reasons)),
        reaction_s=worst_ticks * 1e-3, limit_s=0.0, force_n=force_n, complaints=found.all(),
    )  # fmt: skip


def from_arm() -> Row:
    """Measure a force at the arm beyond the measurable range: fault at the slave in its tick, where a scene ends.

    The reaction of both sides is tested at the endpoints: `bridge/tests/all/device_failure.rs`.
    """
    found = Complaints()
    took_s, force_n = 0.0, 0.0
    for pushers in (1, 10, 1000):
        push_n = 1e4 * pushers
        scene = two_sides(
            run={"duration_s": 3.0, "seed": 7},
            operator={"legs": [{"duration_s": 0.8, "end": -0.03}]},
            environment={"pushers": [{"at_s": PUSH_S, "force_n": 1e4, "duration_s": 0.5}] * pushers},
            link={"forward": CLEAN, "backward": CLEAN},
            security={},
        )
        run = simulate(scene)
        (_, report), last = reports(run), run.events[-1]
        pushed_s = report.engaged_s + PUSH_S
        found.check((last.kind, last.detail) == ("diverged", OF_SLAVE), f"{push_n:g} N: {last.kind}, {last.detail}")
        found.check("fault" in {event.kind for event in run.events}, f"{push_n:g} N: the slave went to no fault")
        took_s = max(took_s, last.time_s - pushed_s)
        signals = run.signals
        force = np.abs(signals.device_force)
        grown_n = float(force[signals.time_s >= pushed_s].max() - force[signals.time_s < pushed_s].max())
        force_n = max(force_n, grown_n)
    found.check(
        took_s <= PERIOD_S + 1e-9, f"the slave's fault followed after {took_s:g} s, must be {PERIOD_S:g} s at most"
    )
    # The press still settles, by less than this bound. The smallest effect of the shove would be 1 N, the limiter's
    # step.
    found.check(force_n <= 1e-6, f"{force_n:g} N more on the hand")
    for push_n in (1e300, sys.float_info.max):
        shove = f"environment.pushers=[{{force_n={push_n}}}]"
        found.check(_refuses(partial(simulate, two_sides(), overrides=[shove])), f"{push_n:g} N was taken")
    return Row(
        fault="1e4, 1e5, 1e7 N at the arm", how="virtual",
        expected="slave: fault in its tick; more than 1e4 N a push: refused",
        measured="fault; no force from it on the hand", reaction_s=took_s, limit_s=PERIOD_S, force_n=max(force_n, 0.0),
        complaints=found.all(),
    )  # fmt: skip


def tiny_from_device() -> Row:
    """Measure denormal numbers: they are valid, and act like zero."""
    found = Complaints()
    apart_n = 0.0
    for signal in ("position", "rendered_force", "velocity"):
        zero = _layer(signal, 0.0)
        for name, tiny in TINY.items():
            ticks = _layer(signal, tiny)
            found.check(not ticks.fault.any(), f"{name} as {signal}: fault")
            apart_n = max(apart_n, float(np.abs(ticks.device_force - zero.device_force).max()))
    # The tolerance is a force as small as the sample itself.
    found.check(apart_n <= 1e-300, f"{apart_n:g} N from what zero gives")
    return Row(
        fault=f"{', '.join(TINY)} from the device", how="calls", expected="as zero: no fault, the same force",
        measured="no fault", force_n=apart_n, complaints=found.all(),
    )  # fmt: skip


def outliers_from_device() -> Row:
    """Measure isolated wrong samples: force and V are those of a run without them, and they are counted."""
    found = Complaints()
    force_n, count = 0.0, 0
    clean = _spoiled(np.zeros(TICKS))
    for size_m in (0.6e-3, 2e-3, 1e-2, 3e-2, 0.5):
        for in_a_row in (1, 2, 3):
            wrong = np.zeros(TICKS)
            for place in range(100, TICKS - 3, 50):
                wrong[place : place + in_a_row] = size_m * np.array([1.0, -1.0, 1.0])[:in_a_row]
            seen = _spoiled(wrong)
            found.check(not seen.fault.any(), f"{size_m:g} m: fault")
            force_n = max(force_n, float(np.abs(seen.device_force - clean.device_force).max()))
            count += int(np.count_nonzero(wrong))
    found.check(force_n <= 0.5, f"{force_n:g} N")
    return Row(
        fault="1 to 3 wrong samples of 0.6 mm to 0.5 m", how="calls", expected="replaced: at most 0.5 N",
        measured=f"{count} samples, no fault", force_n=force_n, complaints=found.all(),
    )  # fmt: skip


def step_from_device() -> Row:
    """Measure a position that steps beyond the speed bound and stays: a fault after 3 ticks, then no force."""
    found = Complaints()
    took_s, force_n = 0.0, 0.0
    for size_m in (0.021, -0.1, 0.5):
        seen = _spoiled(np.where(np.arange(TICKS) < AT, 0.0, size_m))
        faulty = np.flatnonzero(seen.fault)
        found.check(faulty.tolist() == list(range(AT + 3, TICKS)), f"{size_m:g} m: faulty at {faulty[:3].tolist()}...")
        took_s = max(took_s, (int(faulty[0]) - AT) * 1e-3 if faulty.size else math.inf)
        force_n = max(force_n, float(np.abs(seen.device_force[AT + 3 :]).max()))
    found.check(force_n == 0.0, f"{force_n:g} N after it")
    return Row(
        fault="position steps by 21 mm to 0.5 m, and stays", how="calls", expected="fault, zero force, latched",
        measured="fault", reaction_s=took_s, limit_s=3e-3, force_n=force_n, complaints=found.all(),
    )  # fmt: skip


def _spoiled(wrong_m: NDArray[np.float64]) -> SafetyTicks:
    time_s = np.arange(TICKS) * 1e-3
    layer = SafetyLayer(DeviceModel.phantom_desktop(), SafetySettings(["vfc", "hsc", "wsc", "pc"]))
    return layer.run(0.02 * np.sin(9.0 * time_s) + wrong_m, np.full(TICKS, 1.0) * np.minimum(1.0, 5.0 * time_s))


def _layer(signal: str, sample: float) -> SafetyTicks:
    time_s = np.arange(TICKS) * 1e-3
    signals = {
        "position": 1e-3 * np.sin(9.0 * time_s),
        "rendered_force": np.full(TICKS, 1.0),
        "velocity": 9e-3 * np.cos(9.0 * time_s),
    }
    signals[signal][AT] = sample
    layer = SafetyLayer(DeviceModel.phantom_desktop(), SafetySettings(["wsc"]))
    return layer.run(signals["position"], signals["rendered_force"], signals["velocity"])


def at_construction() -> Row:
    """Measure invalid settings of a side: they are refused before the side exists."""
    builds: dict[str, Callable[[float], object]] = {
        "force_scale": lambda bad: baseline_scene(force_scale=bad),
        "mass_kg": lambda bad: HapticDevice(mass_kg=bad),
        "hand stiffness": lambda bad: Hand(stiffness=bad, damping=8.0, strength_n=12.0, start=0.0),
        "wall stiffness": lambda bad: Wall(stiffness=bad),
        "wall position": lambda bad: Wall(stiffness=1.0, position=bad),
        "arm mass": lambda bad: simulate(two_sides(), overrides=[f"slave.mass_kg={bad}"]),
        "max_force_n": lambda bad: SafetyLayer(
            DeviceModel.phantom_desktop(), SafetySettings(["wsc"]), limiter=LimiterSettings(max_force_n=bad)
        ),
        "hold_after_s": lambda bad: simulate(two_sides(), overrides=[f"safety.ladder.hold_after_s={bad}"]),
    }
    found = Complaints()
    attempts = 0
    for key, build in builds.items():
        # A large value may be legitimate; these values never are.
        for name in ("NaN", "+Inf", "-Inf"):
            attempts += 1
            found.check(_refuses(partial(build, BAD[name])), f"{key} = {name} was taken")
    return Row(
        fault="NaN, +Inf, -Inf from Python: settings", how="calls", expected="ValueError, nothing is built",
        measured=f"{attempts} refused" if not found.all() else "; ".join(found.all()), complaints=found.all(),
    )  # fmt: skip


def to_a_living_loop() -> Row:
    """Measure an invalid scale, set on running loops: it is refused, and they run on."""
    key = secrets.token_bytes(32)
    scene = scene_json(baseline_scene())
    slave = LiveSlave(scene, listen="127.0.0.1:0", run_id=1, key=key, realtime="off")
    master = LiveMaster(scene, peer=slave.address, run_id=2, key=key, realtime="off")
    found = Complaints()
    attempts = 0
    time.sleep(1.5)
    for set_scale, who in ((master.set_force_scale, "force_scale"), (slave.set_position_scale, "position_scale")):
        for name, bad in {**BAD, "-1": -1.0, "0": 0.0, "denormal": 5e-324, "200": 200.0}.items():
            attempts += 1
            found.check(_refuses(partial(set_scale, bad)), f"{who} = {name} was taken")
    time.sleep(0.2)
    # For any permitted scale, the limiter and the bounds of a command apply.
    for scale in (2.0, 0.5, 2.0):
        master.set_force_scale(scale)
        slave.set_position_scale(scale)
        time.sleep(0.2)
    trace, _ = master.finish()
    far, _ = slave.finish()
    force_n = float(np.abs(trace.device_force).max())
    step_m = float(np.abs(np.diff(far.command)).max())
    max_n = LIMITER_N
    found.check(np.isfinite(trace.device_force).all(), "a force that is no number")
    found.check(np.isfinite(far.command).all(), "a command that is no number")
    found.check(force_n <= max_n + 1e-9, f"{force_n:g} N, must be {max_n:g} N at most")
    grown_n = float(np.diff(np.abs(trace.device_force)).max())
    found.check(grown_n <= GROWTH_N + 1e-9, f"{grown_n:g} N more within a tick, must be {GROWTH_N:g} N at most")
    return Row(
        fault="the same, 0, -1, 200 and denormal to living loops", how="calls",
        expected="ValueError with value and bounds; what is taken stays within force and speed bounds",
        measured=f"{attempts} refused; twice and half in turn: {NAMES[int(trace.state.max())]}; "
        f"{force_n:.2f} N, {grown_n:.2f} N more a tick at most, {step_m * 1e3:.2f} mm a tick",
        complaints=found.all(),
    )  # fmt: skip


LIMITER_N = 7.9
"""Largest force in N of a PHANTOM Desktop: the limiter's default."""
GROWTH_N = 1.0
"""Largest growth of a force in N per tick: 1000 N/s; unloading is free."""


def in_frames(security: str) -> Row:
    """Measure a sender with NaN poses: with a key they are refused as foreign, without one as invalid."""
    (attack,) = (attack for attack in RAVEN_ATTACKS if attack.scene == "raven_nan")
    row = measure_attack(attack, "on" if security == "on" else "off")
    found = Complaints()
    found.check(row.effect == row.expected, f"{row.effect}, must be {row.expected}")
    found.check(row.is_safe, "moved in hold")
    return Row(
        fault=f"NaN in frames, key {security}", how="virtual", expected="refused, counted; nothing moves",
        measured=f"{row.refused} refused; effect {row.effect}, ends {row.final_states[1]}",
        moved_m=row.moved_in_hold_mm * 1e-3, force_n=row.force_in_hold_n, complaints=found.all(),
    )  # fmt: skip


def _refuses(call: Callable[[], object]) -> bool:
    try:
        call()
    except ValueError:
        return True
    return False


def rows() -> list[Callable[[], Row]]:
    """Return all measurements, to be run one after the other."""
    return [
        *(partial(from_device, signal) for signal in ("position", "rendered_force", "velocity")),
        from_arm,
        tiny_from_device,
        outliers_from_device,
        step_from_device,
        at_construction,
        to_a_living_loop,
        *(partial(in_frames, security) for security in ("on", "off")),
    ]
