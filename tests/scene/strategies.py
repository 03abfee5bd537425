"""Strategies for Hypothesis: valid scenes with any combination of their parts, small and short enough to run."""

import math
from typing import Any

import msgspec
from hypothesis import strategies as st

from haptether.bridge import Scene

Raw = dict[str, Any]

DEVICES = ("phantom-desktop", "phantom-omni", "touch", "phantom-premium-1.5", "inverse3", "dynamixel-leader")


def real(low: float, high: float) -> st.SearchStrategy[float]:
    return st.floats(low, high, allow_subnormal=False)


def maybe(strategy: st.SearchStrategy[Any]) -> st.SearchStrategy[Any]:
    return st.none() | strategy


def table(required: Raw | None = None, /, **optional: st.SearchStrategy[Any]) -> st.SearchStrategy[Raw]:
    """Return a table whose optional keys may be missing."""
    return st.fixed_dictionaries(required or {}, optional=optional)


def per_axis(axes: int, low: float, high: float) -> st.SearchStrategy[Any]:
    number = real(low, high)
    return number | st.lists(number, min_size=axes, max_size=axes)


def series(axes: int, low: float, high: float) -> st.SearchStrategy[Raw]:
    def of(steps: list[float]) -> st.SearchStrategy[Raw]:
        times = [sum(steps[: count + 1]) for count in range(len(steps))]
        rows = st.lists(per_axis(axes, low, high), min_size=len(times), max_size=len(times))
        return rows.map(lambda values: {"time_s": times, "values": values})

    return st.lists(real(1e-3, 0.1), min_size=1, max_size=5).flatmap(of)


# ------------------------------------------------------------------------------------------------ near


@st.composite
def masters(draw: st.DrawFn, axes: int) -> Raw:
    master: Raw = {"axes": axes}
    if draw(st.booleans()):
        master["device"] = draw(st.sampled_from(DEVICES))
    else:
        master["mass_kg"] = draw(per_axis(axes, 1e-2, 2.0))
    friction = draw(st.sampled_from(["vector", "axis"]))
    options: dict[str, st.SearchStrategy[Any]] = {
        "viscous": per_axis(axes, -0.05, 5.0),
        "encoder_quantum": real(1e-6, 1e-4) | st.just(0.0),
        "measures_velocity": st.booleans(),
        "max_force_n": real(0.5, 50.0) | st.just("unbounded"),
        "force_quantum_n": real(1e-3, 0.1),
        "stops": st.just([-0.3, 0.3]),
        "velocity": per_axis(axes, -0.5, 0.5),
    }
    master |= draw(table({}, **options))
    if draw(st.booleans()):
        master["friction"] = friction
        master["coulomb"] = draw(real(0.0, 0.5) if friction == "vector" else per_axis(axes, 0.0, 0.5))
    return master


@st.composite
def aimed_operators(draw: st.DrawFn, axes: int, duration_s: float) -> Raw:
    aim = table(
        {"at_s": real(0.0, duration_s), "target": per_axis(axes, -0.08, 0.08), "strength_n": real(0.0, 30.0)},
        over_s=real(0.001, 0.4),
        stiffness=real(0.0, 1000.0),
        damping=real(0.0, 20.0),
    )
    rows = draw(st.lists(aim, max_size=6))
    operator: Raw = {"aims": {"rows": sorted(rows, key=lambda row: float(row["at_s"]))}}
    return operator | draw(table(start=per_axis(axes, -0.05, 0.05)))


@st.composite
def operators(draw: st.DrawFn, axes: int, duration_s: float, *, has_arm: bool, may_aim: bool = False) -> Raw:
    leg = table(
        {"duration_s": real(0.01, 0.3), "end": per_axis(axes, -0.08, 0.08)},
        shape=st.sampled_from(["linear", "smooth", "minimum-jerk"]),
    )
    if may_aim and draw(st.integers(0, 7)) == 0:
        return draw(aimed_operators(axes, duration_s))
    operator: Raw = draw(table(stiffness=real(10.0, 1000.0), damping=real(0.1, 20.0), grip_strength_n=real(0.0, 30.0)))
    match draw(st.sampled_from(["legs", "recorded", "still"])):
        case "legs":
            operator["start"] = draw(per_axis(axes, -0.05, 0.05))
            operator["legs"] = draw(st.lists(leg, min_size=1, max_size=3))
        case "recorded":
            operator["recorded"] = draw(series(axes, -0.05, 0.05))
    if draw(st.booleans()):
        kinds = ["strength", "gain"] if "grip_strength_n" in operator else ["gain"]
        release = {"at_s": real(0.0, duration_s), "kind": st.sampled_from(kinds)}
        operator["release"] = draw(table(release, decay_s=real(0.0, 0.1)))
        if draw(st.booleans()):
            operator["regrasp"] = draw(table(reaction_s=real(0.0, 0.1), rise_s=real(0.0, 0.1)))
    if draw(st.booleans()):
        operator["tremor"] = draw(table(amplitude=real(0.0, 1e-3), frequency_hz=real(1.0, 20.0)))
    if has_arm and draw(st.booleans()):
        schedule = st.lists(st.integers(0, 400), min_size=4, max_size=4, unique=True).map(sorted)
        times = schedule.map(lambda of: [[of[0] * 1e-3, of[1] * 1e-3], [of[2] * 1e-3, of[3] * 1e-3]])
        operator["clutch"] = draw(st.sampled_from(["auto", "once"]) | times)
    return operator


# ------------------------------------------------------------------------------------------------- far


@st.composite
def contacts(draw: st.DrawFn, axes: int, shape: str) -> Raw:
    laws = ["kelvin-voigt"] if shape == "spring" else ["kelvin-voigt", "hunt-crossley"]
    contact: Raw = {"law": draw(st.sampled_from(laws)), "stiffness": draw(real(0.0, 3000.0) | real(1e4, 1e6))}
    contact |= draw(table(damping=real(0.0, 50.0)))
    if contact["law"] == "hunt-crossley":
        contact |= draw(table(exponent=real(1.0, 3.0)))
    if axes > 1 and shape != "spring":
        contact |= draw(table(friction=real(0.0, 1.5)))
    return contact


@st.composite
def objects(draw: st.DrawFn, axes: int) -> Raw:
    kind = draw(st.sampled_from(["plane", "sphere", "box", "spring"]))
    shape: Raw = {"kind": kind}
    place = per_axis(axes, -0.05, 0.05)
    match kind:
        case "plane":
            shape |= draw(table(point=place))
            if draw(st.booleans()):
                normal = st.lists(real(-1.0, 1.0), min_size=axes, max_size=axes)
                shape["normal"] = draw(normal.filter(lambda n: sum(abs(x) for x in n) > 1e-2))
        case "sphere":
            shape |= {"radius": draw(real(1e-3, 0.1))} | draw(table(centre=place))
        case "box":
            shape |= {"half_extents": draw(per_axis(axes, 1e-3, 0.1))} | draw(table(centre=place))
        case _:
            shape |= draw(table(anchor=place))
    thing: Raw = {"shape": shape, "contact": draw(contacts(axes, kind))}
    match draw(st.sampled_from(["fixed", "fixed", "moving", "free"])):
        case "moving":
            motion = table(velocity=per_axis(axes, -0.2, 0.2), from_s=real(0.0, 0.2), frequency_hz=real(0.1, 20.0))
            thing["motion"] = draw(motion)
            if "frequency_hz" in thing["motion"]:
                thing["motion"]["amplitude"] = draw(per_axis(axes, -0.02, 0.02))
        case "free":
            thing["body"] = draw(
                table(
                    {"mass_kg": real(1e-2, 5.0)},
                    viscous=real(0.0, 5.0),
                    coulomb=real(0.0, 2.0),
                    velocity=per_axis(axes, -0.2, 0.2),
                )
            )
    return thing


@st.composite
def pushers(draw: st.DrawFn, axes: int) -> Raw:
    shape = draw(st.sampled_from(["step", "ramp", "half-sine", "sine", "recorded"]))
    pusher: Raw = {"shape": shape, "at_s": draw(real(0.0, 0.3))}
    if shape == "recorded":
        pusher["recorded"] = draw(series(axes, -5.0, 5.0))
    else:
        pusher["force_n"] = draw(per_axis(axes, -10.0, 10.0))
    if shape == "ramp":
        pusher["rise_s"] = draw(real(0.0, 0.2))
    if shape == "sine":
        pusher["frequency_hz"] = draw(real(0.1, 100.0))
    if shape == "half-sine" or draw(st.booleans()):
        pusher["duration_s"] = draw(real(1e-3, 0.3))
    return pusher


@st.composite
def slaves(draw: st.DrawFn, axes: int, period_s: float) -> Raw:
    control = draw(st.sampled_from(["position", "velocity", "pd"]))
    sensor = table(
        noise_n=real(0.0, 0.1),
        bias_n=per_axis(axes, -0.1, 0.1),
        quantum_n=real(0.0, 0.1),
        rate_hz=real(10.0, 1e4),
    )
    slave: Raw = {"control": control}
    options: dict[str, st.SearchStrategy[Any]] = {
        "mass_kg": real(0.1, 10.0),
        "bandwidth_hz": real(0.5, 50.0),
        "max_speed": real(0.05, 2.0) | st.just("unbounded"),
        "max_acceleration": real(0.1, 100.0),
        "period_s": st.sampled_from([period_s, 5e-4, 1e-3, 2e-3, 8e-3]),
        "force_sensor": sensor,
    }
    slave |= draw(table({}, **options))
    if control != "velocity":
        slave |= draw(table(takes_force=st.booleans()))
    if control == "pd":
        slave["stiffness"] = draw(real(1e-2, 5000.0))
        slave |= draw(table(damping=real(0.0, 200.0)))
    return slave


@st.composite
def links(draw: st.DrawFn) -> Raw:
    delay_s = draw(real(0.0, 0.1))
    return {"delay_s": delay_s} | draw(table(jitter_s=real(0.0, delay_s / 4.0), loss=real(0.0, 1.0)))


@st.composite
def couplings(draw: st.DrawFn, axes: int, duration_s: float) -> Raw:
    angle = draw(real(-3.0, 3.0)) if axes == 3 else 0.0
    frame = {
        "quat_wxyz": st.just([math.cos(angle), 0.0, math.sin(angle), 0.0]),
        "locked_axes": st.lists(st.integers(0, axes - 1), unique=True),
    }
    scales = {"position_scale": real(0.1, 5.0), "force_scale": real(0.1, 5.0)}
    bounds = {"command_speed": real(0.05, 3.0) | st.just("unbounded"), "command_reach": real(0.01, 1.0)}
    coupling = draw(table(**scales, **frame, **bounds))
    changes = [
        {"at_s": at_s, "force_scale": 0.5} | draw(table(**scales, **frame))
        for at_s in sorted(draw(st.lists(real(0.0, duration_s), max_size=2)))
    ]
    return {**coupling, "changes": changes}


@st.composite
def ladders(draw: st.DrawFn) -> Raw:
    stale_after_s = draw(real(1e-3, 0.01))
    hold_after_s = stale_after_s + draw(real(1e-3, 0.03))
    times = {"stale_after_s": stale_after_s, "hold_after_s": hold_after_s}
    stop_after_s = hold_after_s + draw(real(1e-3, 0.2))
    return {**times, "stop_after_s": stop_after_s} | draw(table(fade_out_s=real(0.05, 0.1), fade_in_s=real(0.2, 1.0)))


# ---------------------------------------------------------------------------------------------- safety


def estimators(period_s: float) -> st.SearchStrategy[Raw]:
    return st.one_of(
        st.just({"kind": "backward-difference"}),
        st.builds(lambda hz: {"kind": "low-pass", "cutoff_hz": hz}, real(1.0, 0.5 / period_s)),
        table(
            {"kind": st.just("adaptive-window")},
            noise_bound_m=real(1e-6, 1e-4),
            max_window=st.integers(1, 128),
            fit=st.sampled_from(["end", "best"]),
        ),
        table({"kind": st.just("savitzky-golay")}, degree=st.sampled_from([2, 3]), window=st.integers(4, 128)),
        st.just({"kind": "kalman", "jerk_density": 10.0, "quantum_m": 2.3e-5}),
        st.just({"kind": "dual-kalman", "velocity_jerk_density": 500.0, "quantum_m": 2.3e-5}),
    )


@st.composite
def safeties(draw: st.DrawFn, period_s: float, has_arm: bool) -> Raw:
    safety: Raw = {"estimator": draw(estimators(period_s))}
    safety["controllers"] = draw(st.lists(st.sampled_from(["vfc", "hsc", "wsc", "pc"]), unique=True))
    options: dict[str, st.SearchStrategy[Any]] = {
        "velocity_threshold": real(0.01, 2.0),
        "vfc_force_threshold_n": real(0.01, 5.0),
        "vfc_form": st.sampled_from(["product", "both"]),
        "grasp_threshold": real(1.01, 5.0),
        "grasp_floor_n": real(1e-4, 1.0),
        "hsc_force_threshold_n": real(0.0, 2.0),
        "hsc_velocity_threshold": real(0.0, 0.5),
        "wsc_force_threshold_n": real(0.0, 1.0),
        "energy_threshold_j": real(-0.1, -1e-4),
        "energy_ratio": real(0.01, 1.0),
        "window": st.integers(1, 400),
        "hold_off_s": real(0.0, 0.3),
        "release_ramp_s": real(0.0, 0.3),
    }
    safety |= draw(table({}, **options))
    limiter = table(
        max_force_n=real(0.1, 50.0),
        max_slew_n_per_s=real(10.0, 1e5),
        max_power_w=real(0.1, 100.0),
        ramp_in_s=real(0.0, 0.3),
    )
    safety["limiter"] = draw(limiter | st.just({"enabled": False}))
    if not has_arm:
        safety |= draw(table(signals=st.sampled_from(["estimated", "true"])))
    return safety


# ---------------------------------------------------------------------------------------------- scenes


@st.composite
def raw_scenes(draw: st.DrawFn, *, arm: bool | None = None) -> Raw:
    """Draw tables of a valid scene.

    Args:
        draw: Given by Hypothesis.
        arm: True with an arm, False without; by default either.
    """
    axes = draw(st.sampled_from([1, 3]))
    period_s = draw(st.sampled_from([5e-4, 1e-3, 2e-3, 5e-3]))
    duration_s = draw(real(0.05, 0.5))
    has_arm = draw(st.booleans()) if arm is None else arm
    scene: Raw = {
        "schema": 1,
        "run": {"duration_s": duration_s, "period_s": period_s, "seed": draw(st.integers(0, 99))},
        "master": draw(masters(axes)),
        "safety": draw(safeties(period_s, has_arm)),
        "record": {"every": draw(st.integers(1, 3))},
    }
    scene["run"]["stop_early"] = draw(st.booleans())
    if draw(st.booleans()):
        scene["operator"] = draw(operators(axes, duration_s, has_arm=has_arm, may_aim=has_arm))
    if draw(st.integers(0, 4)) > 0:
        things = st.lists(objects(axes), max_size=3)
        pushes = st.lists(pushers(axes), max_size=2)
        environment: Raw = {"objects": draw(things), "pushers": draw(pushes)}
        if not has_arm:
            linear = all(is_linear(part) and part["shape"]["kind"] == "plane" for part in environment["objects"])
            linear = linear and all(push["shape"] != "recorded" for push in environment["pushers"])
            if linear and draw(st.booleans()):
                environment["rendering"] = "continuous"
            else:
                environment |= draw(table(delay_ticks=st.integers(0, 50)))
        scene["environment"] = environment
    if has_arm:
        scene["slave"] = draw(slaves(axes, period_s))
        scene |= draw(
            table(
                link=table(forward=links(), backward=links()),
                coupling=couplings(axes, duration_s),
                security=table(secure=st.booleans()),
            )
        )
        if draw(st.booleans()):
            scene["safety"]["ladder"] = draw(ladders())
    return scene


def is_linear(thing: Raw) -> bool:
    """Return true for a resting plane or Kelvin-Voigt spring without friction."""
    contact = thing["contact"]
    return (
        thing["shape"]["kind"] in {"plane", "spring"}
        and contact["law"] == "kelvin-voigt"
        and contact.get("friction", 0.0) == 0.0
        and not {"motion", "body"} & set(thing)
    )


def scenes(*, arm: bool | None = None) -> st.SearchStrategy[Scene]:
    """Valid scenes; see `plain_scenes`."""
    return raw_scenes(arm=arm).map(lambda raw: msgspec.convert(raw, Scene))
