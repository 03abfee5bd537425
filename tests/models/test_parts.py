"""Models of device, hand, wall, pusher and arm, and the closed-form loop without a network."""

import re
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
import numpy.typing as npt
import pytest

from haptether.bridge import LocalTrace, Sinusoid, run_local
from haptether.master import Hand, HapticDevice
from haptether.safety import EstimatorKind, LimiterSettings, SafetySettings
from haptether.slave import Wall

MASS = 0.157
STIFFNESS = 200.0
DEPTH = 0.039
DT = 1e-3
DELTA, ETA = -0.03, 0.5
"""The paper's thresholds of WSC."""

OPEN = LimiterSettings(max_force_n=100.0, max_slew_n_per_s=1e6, max_power_w=1e3, ramp_in_s=0.0)
"""Limits that nothing here reaches: the first force acts at once."""

NAN, INF = np.nan, np.inf
POSITIVE = "finite and above 0"
NON_NEGATIVE = "finite and 0 or more"


def device(**parameters: float) -> Callable[[], object]:
    return lambda: HapticDevice(**{"mass_kg": 1.0} | parameters)  # type: ignore[arg-type]


def hand(**parameters: Any) -> Callable[[], object]:  # noqa: ANN401
    sound = {"stiffness": 1.0, "damping": 1.0, "strength_n": 1.0, "start": 0.0}
    return lambda: Hand(**sound | parameters)


TABLE: list[tuple[float, str, Callable[[], object]]] = [
    *((x, POSITIVE, device(mass_kg=x)) for x in (0.0, -1.0, NAN, INF)),
    *((x, "finite", device(viscous=x)) for x in (NAN, INF)),
    *((x, NON_NEGATIVE, device(coulomb=x)) for x in (-0.5, NAN, INF)),
    *((x, NON_NEGATIVE, device(encoder_quantum=x)) for x in (-0.5, NAN, INF)),
    *((x, "below the upper stop", lambda x=x: HapticDevice(mass_kg=1.0, stops=(x, 0.5))) for x in (0.5, 0.6, NAN, INF)),
    (-0.5, NON_NEGATIVE, lambda: HapticDevice.phantom_desktop(encoder_quantum=-0.5)),
    *((x, NON_NEGATIVE, hand(stiffness=x)) for x in (-0.5, NAN, INF)),
    *((x, NON_NEGATIVE, hand(damping=x)) for x in (-0.5, NAN)),
    *((x, "0 or more", hand(strength_n=x)) for x in (-0.5, NAN)),
    *((x, "finite", hand(start=x)) for x in (NAN, INF)),
    *((x, "finite and at least 1e-9", hand(legs=[(1.0, 0.0, "linear"), (x, 0.0, "linear")])) for x in (0.0, NAN)),
    *((x, "finite", hand(legs=[(1.0, x, "linear")])) for x in (NAN, INF)),
    *((x, "finite", hand(release=(x, 0.1))) for x in (NAN, INF)),
    *((x, NON_NEGATIVE, hand(release=(0.1, x))) for x in (-0.5, NAN)),
    *((x, "finite", lambda x=x: Hand.absent(position=x)) for x in (NAN, INF)),
    *((x, NON_NEGATIVE, lambda x=x: Wall(stiffness=x)) for x in (-0.5, NAN, INF)),
    *((x, "finite", lambda x=x: Wall(stiffness=1.0, position=x)) for x in (NAN, INF)),
]


@pytest.mark.parametrize(("seen", "allowed", "build"), TABLE)
def test_a_parameter_out_of_range_is_refused(seen: float, allowed: str, build: Callable[[], object]) -> None:
    number = "NaN" if np.isnan(seen) else f"{seen:g}"
    with pytest.raises(ValueError, match=rf"^[\w ]+ = {re.escape(number)}: must be {allowed}$"):
        build()


def test_other_shapes_of_legs_are_refused() -> None:
    message = 'leg shape "cubic": must be "linear", "smooth" or "minimum-jerk"'
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        hand(legs=[(1.0, 0.0, "cubic")])()


@pytest.mark.parametrize("amplitude", [(NAN, 5.0), (1.0, INF)])
def test_a_sinusoid_is_finite(amplitude: tuple[float, float]) -> None:
    with pytest.raises(ValueError, match=r"must be finite$"):
        Sinusoid(amplitude_n=amplitude[0], rate=amplitude[1])


def test_the_phantom_is_that_of_the_paper() -> None:
    phantom = HapticDevice.phantom_desktop()
    assert (phantom.mass_kg, phantom.viscous, phantom.coulomb) == (MASS, -0.005, 0.038)
    assert phantom.encoder_quantum == 2.3e-5
    same = HapticDevice(mass_kg=MASS, viscous=-0.005, coulomb=0.038, encoder_quantum=2.3e-5)
    assert phantom == same
    assert phantom != HapticDevice.phantom_desktop(encoder_quantum=0.0)


def test_a_hand_follows_its_path_and_lets_go() -> None:
    held = Hand(
        stiffness=300.0,
        damping=5.0,
        strength_n=20.0,
        start=1.0,
        legs=[(1.0, -2.0, "minimum-jerk"), (2.0, 2.0, "linear")],
        release=(1.0, 0.04),
    )
    for time_s, target in [(-1.0, 1.0), (0.0, 1.0), (1.0, -2.0), (2.0, 0.0), (3.0, 2.0), (9.0, 2.0)]:
        assert abs(held.target(time_s) - target) <= 1e-15
    for s in np.linspace(0.0, 1.0, 21):
        # 10 s³ - 15 s⁴ + 6 s⁵; the model uses Horner's rule: some roundings of values below 20.
        expected = 1.0 - 3.0 * (10 * s**3 - 15 * s**4 + 6 * s**5)
        assert abs(held.target(float(s)) - expected) <= 1e-14
    for time_s, strength in [(0.0, 20.0), (1.0, 20.0), (1.01, 15.0), (1.03, 5.0), (1.04, 0.0)]:
        assert abs(held.strength(time_s) - strength) <= 1e-12
    sudden = Hand(stiffness=1.0, damping=0.0, strength_n=20.0, start=0.0, release=(1.0, 0.0))
    assert (sudden.strength(0.999), sudden.strength(1.0)) == (20.0, 0.0)
    absent = Hand.absent(position=0.3)
    assert (absent.target(5.0), absent.strength(0.0)) == (0.3, 0.0)
    assert absent == Hand.absent(position=0.3)
    assert absent != held


def test_a_wall_pushes_out_and_never_pulls() -> None:
    wall = Wall(stiffness=200.0, position=0.1)
    for position, force in [(0.2, 0.0), (0.1, 0.0), (0.06, 8.0), (-0.9, 200.0)]:
        assert abs(wall.force(position) - force) <= 1e-13
    assert wall == Wall(stiffness=200.0, position=0.1)
    assert wall != Wall(stiffness=200.0)


def ejected(settings: SafetySettings | None = None, stiffness: float = STIFFNESS, depth: float = DEPTH) -> LocalTrace:
    """Release the device at rest, in a wall, without a hand."""
    return run_local(
        HapticDevice(mass_kg=MASS),
        Hand.absent(position=-depth),
        Wall(stiffness=stiffness),
        ticks=400,
        settings=settings,
        limiter=OPEN,
    )


def sampled(stiffness: float, depth: float) -> float:
    """Return the speed at which a sampled and held wall ejects the device."""
    z, v = -depth, 0.0
    while z < 0.0:
        force = -stiffness * z
        z += v * DT + force * DT * DT / (2 * MASS)
        v += force * DT / MASS
    return v


@pytest.mark.parametrize(("stiffness", "depth"), [(200.0, 0.039), (1000.0, 0.0078), (500.0, 0.01)])
def test_an_ejection_without_a_controller(stiffness: float, depth: float) -> None:
    trace = ejected(stiffness=stiffness, depth=depth)
    peak = trace.velocity.max()
    # The model solves this recursion; the difference is the rounding of some 60 ticks.
    assert abs(peak - sampled(stiffness, depth)) <= 1e-12
    # Energy conservation; sampling gains exp(pi/8 dT sqrt(K/m)): 1.4 % at 200 N/m, 3.2 % at 1000.
    rate = np.sqrt(stiffness / MASS)
    assert abs(peak / (rate * depth) - np.exp(np.pi / 8 * DT * rate)) <= 3e-3
    assert peak / (rate * depth) - 1 < (0.03 if stiffness < 1000 else 0.035)
    assert not trace.tripped.any()
    assert np.array_equal(trace.device_force, trace.rendered_force)


def first_trip(trace: LocalTrace) -> int:
    return int(np.flatnonzero(trace.tripped)[0])


def test_wsc_trips_at_its_speed_after_a_release_from_rest() -> None:
    trace = ejected(SafetySettings(["wsc"], energy_threshold_j=DELTA, energy_ratio=ETA))
    # Without a hand no work is done: E_wso = -m V² / (2 eta), which passes delta at this speed.
    speed = np.sqrt(2 * ETA * abs(DELTA) / MASS)
    assert abs(speed - 0.437) < 5e-4
    tick = first_trip(trace)
    assert tick == np.flatnonzero(trace.velocity > speed)[0]
    moving = MASS * trace.velocity[: tick + 1] ** 2 / (2 * ETA)
    # F_h cancels to rounding of 8 N; each tick so far adds 8 N * 1 m/s * dT * u.
    assert np.all(abs(trace.windowed_energy_j[: tick + 1] + moving) <= 1e-15)
    assert abs(trace.grasp_force[: tick + 1]).max() <= 1e-12
    # After the trip the device renders the damping alone, as long as WSC stays tripped.
    on = np.flatnonzero(trace.tripped == 4)
    assert np.all(abs(trace.device_force[on] + 5.0 * trace.velocity[on]) <= 1e-14)
    assert trace.velocity.max() < 0.36 * ejected().velocity.max()


def test_wsc_trips_late_with_the_whole_press_inside_its_window() -> None:
    hold_stiffness, pressed_s = 5000.0, 2.0
    target = -DEPTH * (1.0 + STIFFNESS / hold_stiffness)
    hand_model = Hand(
        stiffness=hold_stiffness,
        damping=2 * np.sqrt(hold_stiffness * MASS),
        strength_n=100.0,
        start=0.0,
        legs=[(pressed_s, target, "minimum-jerk")],
        release=(pressed_s + 0.3, 0.0),
    )
    trace = run_local(
        HapticDevice(mass_kg=MASS),
        hand_model,
        Wall(stiffness=STIFFNESS),
        ticks=2500,
        settings=SafetySettings(["wsc"], window=5000),
        limiter=OPEN,
    )
    released = 2300
    assert abs(trace.position[released] + DEPTH) <= 1e-9
    tick = first_trip(trace)
    assert tick > released
    # The hand has stored K D²/2 in the wall; that energy less m V² / (2 eta) passes delta at this speed.
    speed = np.sqrt((abs(DELTA) + STIFFNESS * DEPTH**2 / 2) * 2 * ETA / MASS)
    assert abs(speed - 1.077) < 5e-4
    # The speed grows by one tick of K z / m up to the trip. The rectangle rule of Eq. 11 misses
    # K dT int V² = K dT (10/7) D² / T of the work on a minimum-jerk press, which lowers the speed.
    left = np.sqrt(DEPTH**2 - MASS * speed**2 / STIFFNESS)
    step = STIFFNESS * left / MASS * DT
    missed = STIFFNESS * DT * (10 / 7) * DEPTH**2 / pressed_s
    lowered = missed * 2 * ETA / MASS / (2 * speed)
    assert lowered < 2e-3
    # The factor 2 covers the ideal motion in `left` and in the press.
    assert trace.velocity[tick] > speed - 2 * lowered
    assert trace.velocity[tick - 1] < speed
    assert trace.velocity[tick] < speed + 1.1 * step


def test_a_sinusoid_moves_a_free_device_as_its_integral_says() -> None:
    amplitude, rate, ticks = 1.0, 5.0, 300
    trace = run_local(
        HapticDevice(mass_kg=MASS),
        Hand.absent(),
        Sinusoid(amplitude_n=amplitude, rate=rate),
        ticks=ticks,
        limiter=OPEN,
    )
    force = amplitude * np.sin(rate * np.arange(ticks) * DT)
    assert np.all(abs(trace.rendered_force - force) <= 1e-15)
    velocity = np.concatenate([[0.0], np.cumsum(force)[:-1]]) * DT / MASS
    # Each tick rounds a velocity below 2 m/s.
    assert np.all(abs(trace.velocity - velocity) <= ticks * 2.0 * 2.0**-52)
    # Half a tick late against the continuous integral.
    exact = amplitude / (rate * MASS) * (1 - np.cos(rate * (trace.time_s - DT / 2)))
    assert np.all(abs(trace.velocity - exact)[1:] <= amplitude / MASS * DT**2 * rate)


@pytest.mark.parametrize("delay", [1, 3, 40])
def test_a_force_that_acts_late_moves_a_free_device_so_much_later(delay: int) -> None:
    late, prompt = (
        run_local(
            HapticDevice(mass_kg=MASS, coulomb=0.0),
            Hand.absent(),
            Sinusoid(amplitude_n=1.0, rate=5.0),
            ticks=300,
            limiter=OPEN,
            device_delay=ticks,
        )
        for ticks in (delay, 0)
    )
    assert np.all(late.velocity[:delay] == 0.0)
    # The sums are the same; time enters the model's steps, and rounds.
    assert np.all(abs(late.velocity[delay:] - prompt.velocity[:-delay]) <= 1e-14)
    assert np.array_equal(late.device_force, prompt.device_force), "what is commanded, not what acts"
    with pytest.raises(ValueError, match="device_delay = 1001: must be at most 1000"):
        run_local(HapticDevice(mass_kg=MASS), Hand.absent(), Wall(stiffness=0.0), ticks=1, device_delay=1001)


@pytest.mark.parametrize("kind", ["strength", "gain"])
def test_what_falls_at_a_release(kind: Literal["strength", "gain"]) -> None:
    """Check both kinds of release: the bound of F_h falls, or F_h itself (Hogan 1989; master/src/hand.rs).

    F_h = K_h (target - x) - B_h V.
    """
    stiffness, damping, strength, target, begin, decay = 300.0, 5.0, 11.7, -0.065, 0.5, 0.08
    held = Hand(
        stiffness=stiffness, damping=damping, strength_n=strength, start=0.0, legs=[(0.4, target, "minimum-jerk")],
        release=(begin, decay), release_kind=kind,
    )  # fmt: skip
    trace = run_local(HapticDevice(mass_kg=MASS), held, Wall(stiffness=STIFFNESS), ticks=700)
    grip = np.clip(1.0 - (trace.time_s - begin) / decay, 0.0, 1.0)
    wish = stiffness * (target - trace.position) - damping * trace.velocity
    expected = grip * wish if kind == "gain" else np.clip(wish, -grip * strength, grip * strength)
    after = slice(401, None)
    assert np.all(abs(trace.hand_force - expected)[after] <= 1e-9)
    assert 0.0 < abs(trace.hand_force[540]) < 7.8
    with pytest.raises(ValueError, match='release_kind "both"'):
        Hand(stiffness=1.0, damping=1.0, strength_n=1.0, start=0.0, release_kind="both")  # type: ignore[arg-type]


def test_friction_stops_the_device_for_good() -> None:
    trace = run_local(
        HapticDevice(mass_kg=MASS, coulomb=0.038),
        Hand.absent(),
        Wall(stiffness=0.0),
        ticks=1000,
        start=(0.0, 0.1),
    )
    # v² / (2 c / m), and v m / c until rest.
    assert abs(trace.position[-1] - 0.1**2 * MASS / (2 * 0.038)) <= 1e-15
    rests = 0.1 * MASS / 0.038
    assert np.all((trace.velocity > 0) == (trace.time_s < rests))


def test_a_stop_takes_all_speed() -> None:
    stopped = HapticDevice(mass_kg=MASS, stops=(-0.1, 0.05))
    for speed, stop in [(0.5, 0.05), (-0.5, -0.1)]:
        trace = run_local(stopped, Hand.absent(), Wall(stiffness=0.0), ticks=300, start=(0.0, speed))
        reached = trace.time_s >= stop / speed
        # 0.5 m/s for at most 200 ticks, each rounded once.
        free = speed * trace.time_s
        assert np.all(abs(trace.position - np.where(reached, stop, free)) <= 200 * 2.0**-54)
        assert np.array_equal(trace.velocity != 0.0, ~reached)
    assert stopped.stops == (-0.1, 0.05)
    assert HapticDevice.phantom_desktop().stops == (-INF, INF)
    pushed = run_local(stopped, Hand.absent(), Wall(stiffness=100.0, position=0.2), ticks=500, limiter=OPEN)
    assert pushed.position[-1] == 0.05, "pushed against the stop"
    assert pushed.velocity[-1] == 0.0


def test_a_start_is_where_and_how_fast() -> None:
    trace = run_local(HapticDevice(mass_kg=MASS), Hand.absent(), Wall(stiffness=0.0), ticks=3, start=(0.2, -0.5))
    assert np.all(abs(trace.position - [0.2, 0.1995, 0.199]) <= 1e-16)
    assert trace.velocity.tolist() == [-0.5] * 3


def test_a_trace_has_one_number_a_tick() -> None:
    signals = (
        *("time_s", "position", "velocity", "hand_force", "rendered_force", "grasp_force"),
        *("device_force", "velocity_force", "grasp", "windowed_energy_j", "energy_j", "tripped"),
    )
    for ticks in (0, 7):
        trace = run_local(HapticDevice.phantom_desktop(), Hand.absent(), Wall(stiffness=1.0), ticks=ticks)
        assert len(trace) == ticks
        for name in signals:
            signal: npt.NDArray[Any] = getattr(trace, name)
            assert signal.shape == (ticks,)
            assert signal.dtype == (np.uint8 if name == "tripped" else np.float64)
        assert np.isnan(trace.grasp).all()


def test_the_encoder_and_its_estimator_are_in_the_loop() -> None:
    def grasp(kind: EstimatorKind | None) -> npt.NDArray[np.float64]:
        return run_local(
            HapticDevice.phantom_desktop(),
            Hand.absent(position=-DEPTH),
            Wall(stiffness=STIFFNESS),
            ticks=30,
            # HSC reads F_h; its threshold is out of reach, as nobody holds.
            settings=SafetySettings(["hsc"], grasp_threshold=1e9),
            estimator=kind,
            limiter=OPEN,
        ).grasp_force

    rough, smooth = grasp(EstimatorKind.backward_difference()), grasp(None)
    # A quantum q shows in the second difference as m q / dT² = 3.6 N.
    assert abs(rough).max() > 0.5 * MASS * 2.3e-5 / DT**2
    assert abs(smooth).max() < 0.5 * abs(rough).max()


LOOP = (HapticDevice(mass_kg=MASS), Hand.absent(), Wall(stiffness=1.0))


@pytest.mark.parametrize(
    ("keywords", "message"),
    [
        ({"ticks": 20_000_001}, r"^ticks = 20000001: must be at most 20000000$"),
        ({"ticks": 1, "period_s": 0.0}, r"^period_s \(dT\) = 0: must be a whole number of nano"),
        ({"ticks": 1, "period_s": 1e-7}, r"^period_s \(dT\) = .*between 1e-6 and 1$"),
        ({"ticks": 1, "period_s": 1 / 3000}, r"^period_s \(dT\) = 0.00033.*whole number"),
        ({"ticks": 1, "period_s": NAN}, r"^period_s \(dT\) = NaN"),
        ({"ticks": 1, "start": (NAN, 0.0)}, r"^position = NaN: must be finite$"),
        ({"ticks": 1, "start": (0.0, INF)}, r"^velocity = inf: must be finite$"),
        (
            {"ticks": 1, "settings": SafetySettings(["wsc"], window=0)},
            r"^window \(w\) = 0: must be 1 to 3600000 ticks$",
        ),
        (
            {"ticks": 1, "limiter": LimiterSettings(max_force_n=0.0)},
            r"^max_force_n \(F_max\) = 0: must be finite and above 0$",
        ),
    ],
)
def test_a_loop_that_cannot_be_is_refused(keywords: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        run_local(*LOOP, **keywords)


def test_only_a_wall_or_a_sinusoid_is_rendered() -> None:
    with pytest.raises(ValueError, match=r"^rendered: HapticDevice, must be a Wall or a Sinusoid$"):
        run_local(*LOOP[:2], LOOP[0], ticks=1)  # type: ignore[arg-type]
