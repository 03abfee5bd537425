"""Run time against error of the kinematics of UR arms, beside pinocchio, ur-analytic-ik and other solvers.

- Forward kinematics with Jacobian: the error is the largest of any entry against the same chain in 80 bits.
- Inverse kinematics: each returned posture goes through that chain. The errors are the largest over all poses of random
  postures.
- Streamed steps: the error is the largest of any joint's velocity against the minimum. The minimum is refined in 80
  bits and held to its conditions. Programs that a solver gives up are counted.

All entries of a table are timed in turns, round by round. Required:

- forward kinematics and Jacobian in one call in 3 us, inverse kinematics in 20 us, both within 1e-12 of the chain,
- the round trip of postures within 1e-10,
- every streamed step within 1e-9 of its conditions,
- a period of `UrStreaming` that turns the tool of a UR arm, within the limits of its driver, in 10 us.
"""

import importlib
import importlib.util
import sys
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import partial
from itertools import groupby
from operator import attrgetter
from typing import Any, TextIO

import casadi
import msgspec
import numpy as np
import numpy.typing as npt

from _report import add_number, bench_options, in_turns, print_table, table_file, write_json
from haptether.slave import (
    QuadraticProgram,
    SelfKeepOut,
    StreamingCost,
    StreamingLimits,
    UrCalibration,
    UrInverse,
    UrKinematics,
    UrModel,
    UrStreaming,
    WorkspacePlane,
    model_limits,
    ur_model,
)
from haptether.slave.ur.kinematics.chain import dh_rows
from haptether.slave.ur.kinematics.pose import pose_from_transform
from haptether.slave.ur.modes import POSE_COST, JointTracking
from haptether.slave.ur.options import ur_options
from haptether.slave.ur.set_point import Attitude
from haptether.slave.ur.state import UrState
from ur.arms import CALIBRATIONS, PinocchioArm
from ur.figures import figure
from ur.quadratic import solvers
from ur.references import apart, extended_chain, minimum, residual

Array = npt.NDArray[np.float64]
Work = Callable[[int], object]
"""Runs task n of a list, modulo its length."""

EXAMPLE = "example: python benches/kinematics.py --json -"
MODEL = "ur5e"
UNIT = "ur10 far"
FORWARD_US, INVERSE_US, STEP_US = 3.0, 20.0, 10.0
TURNED = "joints, self, tool turned"
"""Solver settings that a UR driver nearly always uses, at its limits."""
WITHIN = "all but tool speed, within limits"
TIGHT, ROUND_TRIP, CONDITIONS = 1e-12, 1e-10, 1e-9
PERIOD_S = 0.002
CALLS = 200
"""Calls in one timed block."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Row:
    """One line of a table."""

    table: str
    name: str
    us: float
    """Least time per call over the rounds."""
    us_median: float
    errors: dict[str, float]
    """Errors by column."""


def timed(works: dict[str, Work], rounds: int) -> dict[str, tuple[float, float]]:
    """Return least and median time of a call in us; the works take turns in every round."""

    def block(work: Work) -> None:
        for index in range(CALLS):
            work(index)

    blocks = in_turns({name: partial(block, work) for name, work in works.items()}, range(rounds))
    scale = 1e-3 / CALLS
    return {name: (scale * min(times), scale * float(np.median(times))) for name, times in blocks.items()}


def over(call: Callable[..., object], *arguments: Sequence[Any] | Array) -> Work:
    """Return a call with the n-th entry of each argument."""
    if len(arguments) == 1:
        (only,) = arguments
        return lambda index: call(only[index])
    if len(arguments) == 2:
        first, second = arguments
        return lambda index: call(first[index], second[index])
    one, two, three = arguments
    return lambda index: call(one[index], two[index], three[index])


def postures(count: int, seed: int) -> Array:
    """Return random joint angles over both turns."""
    return np.random.default_rng(seed).uniform(-2 * np.pi, 2 * np.pi, (count, 6))


# Forward kinematics and Jacobian


def raw_casadi(model: UrModel, calibration: UrCalibration | None) -> Callable[[Array], tuple[Array, Array]]:
    """Return the same expressions as direct calls of CasADi functions."""
    chain = UrKinematics(model, calibration).chain
    function: Any = casadi.Function("plain", [chain.q], [chain.transform, chain.jacobian])

    def call(q: Array) -> tuple[Array, Array]:
        transform, jacobian = function(q)
        return np.asarray(transform), np.asarray(jacobian)

    return call


def forward_rows(rounds: int) -> list[Row]:
    """Return rows of ours, direct CasADi and pinocchio, for a model and for a unit with its calibration."""
    q = np.ascontiguousarray(postures(CALLS, 1))
    found = []
    for arm, (model, calibration) in {MODEL: (ur_model(MODEL), None), UNIT: CALIBRATIONS[UNIT]}.items():
        peer = PinocchioArm(model, calibration, np.eye(4))
        calls: dict[str, Callable[[Array], tuple[Array, Array]]] = {
            "ours": UrKinematics(model, calibration).forward_and_jacobian,
            "plain CasADi call": raw_casadi(model, calibration),
            "pinocchio": peer.forward_and_jacobian,
        }
        poses, jacobians = extended_chain(dh_rows(model, calibration), q)
        errors = dict.fromkeys(calls, 0.0)
        for name, call in calls.items():
            for index in range(CALLS):
                transform, jacobian = call(q[index])
                off = np.abs(transform - poses[index]).max(), np.abs(jacobian - jacobians[index]).max()
                errors[name] = max(errors[name], float(max(off)))
        works = {name: over(call, q) for name, call in calls.items()}
        for name, (fastest, median) in timed(works, rounds).items():
            table = f"forward kinematics and Jacobian, {arm}"
            found.append(Row(table=table, name=name, us=fastest, us_median=median, errors={"error": errors[name]}))
    return found


# Inverse kinematics


def closest_of(package: Any) -> Callable[[Array, Array], Array | None]:  # noqa: ANN401  # it has no types
    """Return the peer's posture nearest to the previous one."""

    def call(pose: Array, near: Array) -> Array | None:
        found = package.inverse_kinematics_closest(pose, *near.tolist())
        return np.asarray(found[0]).ravel() if found else None

    return call


def inverse_rows(rounds: int, poses: int) -> list[Row]:
    """Return rows of ours and ur-analytic-ik for a model; of ours for a unit with its calibration."""
    found = []
    for arm, (model, calibration) in {MODEL: (ur_model(MODEL), None), UNIT: CALIBRATIONS[UNIT]}.items():
        inverse, rows = UrInverse(model, calibration), dh_rows(model, calibration)
        nearest: dict[str, Callable[[Array, Array], Array | None]] = {"ours, nearest": inverse.nearest}
        every: dict[str, Callable[[Array], Any]] = {"ours, all": inverse.all}
        if calibration is None and importlib.util.find_spec("ur_analytic_ik") is not None:
            package: Any = getattr(importlib.import_module("ur_analytic_ik"), arm)
            nearest["ur-analytic-ik, nearest"] = closest_of(package)
            every["ur-analytic-ik, all"] = package.inverse_kinematics
        # It takes angles within half a turn only; ours gets the same.
        q = np.ascontiguousarray(postures(poses, 2) / 2)
        exact, _ = extended_chain(rows, q)
        targets = np.ascontiguousarray(exact.astype(np.float64))
        errors: dict[str, dict[str, float]] = {}
        for name, call in nearest.items():
            back, missed = np.full_like(q, np.nan), 0
            for index in range(poses):
                posture = call(targets[index], q[index])
                if posture is None:
                    missed += 1
                else:
                    back[index] = posture
            there = ~np.isnan(back[:, 0])
            metres, radians = apart(extended_chain(rows, back[there])[0], exact[there])
            joints = np.abs(np.remainder(back[there] - q[there] + np.pi, 2 * np.pi) - np.pi)
            errors[name] = {
                "m": float(metres.max()),
                "rad": float(radians.max()),
                "joints rad": float(joints.max()),
                "missed": missed,
            }
        for name, branches in every.items():
            few = min(poses, 2000)
            postures_of = [np.atleast_2d(np.asarray(branches(targets[index]))) for index in range(few)]
            counts = [len(some) for some in postures_of]
            back = np.concatenate([some.reshape(-1, 6) for some in postures_of])
            metres, radians = apart(extended_chain(rows, back)[0], np.repeat(exact[:few], counts, axis=0))
            errors[name] = {"m": float(metres.max()), "rad": float(radians.max())}
        works = {name: over(call, targets, q) for name, call in nearest.items()}
        works |= {name: over(call, targets) for name, call in every.items()}
        for name, (fastest, median) in timed(works, rounds).items():
            table = f"inverse kinematics, {arm}"
            found.append(Row(table=table, name=name, us=fastest, us_median=median, errors=errors[name]))
    return found


# Streamed steps


LIMITS = {
    "speed": StreamingLimits(max_speed=(1.0,) * 6),
    "speed, table and wall": StreamingLimits(
        max_speed=(1.0,) * 6,
        planes=(
            WorkspacePlane(normal=(0.0, 0.0, 1.0), offset_m=0.0, whole_arm=True),
            WorkspacePlane(normal=(-1.0, 0.0, 0.0), offset_m=-0.6),
        ),
    ),
}


def streaming_rows(rounds: int) -> list[Row]:
    """Return rows of random-step programs, for every installed solver."""
    found = []
    draws = np.random.default_rng(3)
    middle = np.array((-0.6, -1.6, 1.7, -1.5, -1.4, 0.3))
    steps = [
        (middle + draws.normal(0, 0.5, 6), draws.normal(0, 0.05, 6), draws.normal(0, 1.0, 6)) for _ in range(8 * CALLS)
    ]
    for name, limits in LIMITS.items():
        streaming = UrStreaming(UrKinematics(ur_model(MODEL)), limits, period_s=PERIOD_S)
        programs: list[QuadraticProgram] = []
        minima: list[Array] = []
        worst = 0.0
        for q, qd, twist in steps:
            velocity = streaming.velocity(q, qd, twist)
            if streaming.reason or len(programs) == CALLS:
                continue
            programs.append(streaming.program)
            worst = max(worst, residual(programs[-1], velocity, streaming.multipliers))
            minima.append(minimum(programs[-1], streaming.multipliers))
        works: dict[str, Work] = {}
        errors: dict[str, dict[str, float]] = {}
        for solver, prepare in solvers().items():
            solve = prepare(programs)
            solutions = [solve(program) for program in programs]
            off = [float(np.abs(x - best).max()) for x, best in zip(solutions, minima, strict=True) if x is not None]
            errors[solver] = {"error rad/s": max(off), "missed": len(programs) - len(off)}
            works[solver] = over(solve, programs)
        errors["ours (daqp, warm)"]["conditions"] = worst
        for solver, (fastest, median) in timed(works, rounds).items():
            table = f"streamed step, {name}: {len(programs)} programs of {len(programs[0].rows)} rows"
            found.append(Row(table=table, name=solver, us=fastest, us_median=median, errors=errors[solver]))
    return found


def whole_steps(rounds: int) -> list[Row]:
    """Return rows of a period of `UrStreaming.velocity` with each set of options, repeated along a run."""
    joints = model_limits(ur_model(MODEL))
    planes, keep_out = LIMITS["speed, table and wall"].planes, SelfKeepOut()
    named = {
        "nothing": StreamingLimits(),
        "joints": joints,
        "joints, tool speed": msgspec.structs.replace(joints, max_tool_speed=0.2),
        "joints, planes, self": msgspec.structs.replace(joints, planes=planes, self_keep_out=keep_out),
        "all": msgspec.structs.replace(joints, max_tool_speed=0.2, planes=planes, self_keep_out=keep_out),
    }
    turned = {
        "joints, tool turned": joints,
        TURNED: msgspec.structs.replace(joints, self_keep_out=keep_out),
        WITHIN: msgspec.structs.replace(joints, planes=planes, self_keep_out=keep_out),
        "joints, planes, self, tool turned": msgspec.structs.replace(joints, planes=planes, self_keep_out=keep_out),
    }
    works: dict[str, Work] = {}
    errors: dict[str, dict[str, float]] = {}
    for name, limits in (named | turned).items():
        cost = StreamingCost(**POSE_COST) if name in turned else None
        streaming = UrStreaming(UrKinematics(ur_model(MODEL)), limits, period_s=PERIOD_S, cost=cost)
        q, qd, twist = np.zeros((CALLS, 6)), np.zeros((CALLS, 6)), np.zeros((CALLS, 6))
        q[0] = (-0.6, -1.6, 1.7, -1.5, -1.4, 0.3)
        # Back and forth with a turn, at twice the limit: after its acceleration the tool moves at its speed limit.
        twist[:, 1] = 0.4 * np.sign(np.sin(np.arange(CALLS) * 2 * np.pi / CALLS))
        twist[:, 5] = 0.3
        if name in turned:
            # As fast as 60 degrees back and forth within 4 s, about two axes.
            twist[:, 3] = 1.6 * np.sin(np.arange(CALLS) * 2 * np.pi / CALLS)
            twist[:, 5] = 1.6 * np.cos(np.arange(CALLS) * 2 * np.pi / CALLS)
        if name == WITHIN:
            twist *= 0.1
            qd[0] = np.linalg.pinv(streaming.kinematics.forward_and_jacobian(q[0])[1]) @ twist[0]
        slow = braked = held = 0
        for index in range(CALLS - 1):
            qd[index + 1] = streaming.velocity(q[index], qd[index], twist[index])
            q[index + 1] = q[index] + qd[index + 1] * PERIOD_S
            slow += streaming.speed_multiplier > 0
            braked += streaming.reason != ""
            held += int(streaming.multipliers.any())
        errors[name] = {"at limits": held, "at tool speed": slow, "braked": braked}
        works[name] = over(streaming.velocity, q, qd, twist)
    return [
        Row(
            table=f"a period of UrStreaming over {CALLS} along a run, with limits of",
            name=name,
            us=fastest,
            us_median=median,
            errors=errors[name],
        )
        for name, (fastest, median) in timed(works, rounds).items()
    ]


def tracked(rounds: int) -> list[Row]:
    """Return rows of a period of the driver's `JointTracking` (with a streamed step), with and without orientation."""
    options = ur_options({"host": "127.0.0.1", "axes": 3, "max_angular_speed": 3.0})
    kinematics = UrKinematics(ur_model(MODEL))
    begin = (-1.6, -1.7, -2.2, -0.8, 1.6, 0.0)
    pose = tuple(pose_from_transform(kinematics.forward(begin)).tolist())
    home = UrState(1.0, begin, begin, (0.0,) * 6, pose, (0.0,) * 6, (0.0,) * 6, 7, 1, 1, 2, 1.0)
    path = figure(pose, amplitude_m=0.05, angle=np.radians(60.0), period_s=8.0)
    poses = [path(PERIOD_S * index) for index in range(CALLS)]
    works: dict[str, Work] = {}
    for name in ("point", "pose"):
        joints = JointTracking(kinematics, options, PERIOD_S)

        def work(index: int, joints: JointTracking = joints, turns: bool = name == "pose") -> None:
            if index == 0:
                joints.begin(home)
            at = poses[index]
            attitude = Attitude(at.orientation, at.angular_velocity) if turns else None
            joints.follow(at.position, at.velocity, PERIOD_S, attitude)

        works[name] = work
    return [
        Row(table="a period of the driver's JointTracking, led by a", name=name, us=us, us_median=median, errors={})
        for name, (us, median) in timed(works, rounds).items()
    ]


# Reporting


def missed(rows: list[Row]) -> list[str]:
    """Return the requirements that do not hold."""
    found = []
    for row in rows:
        where = f"{row.table}: {row.name}"
        if row.name == TURNED and row.us > STEP_US:
            found.append(f"{where}: {row.us:.2f} us")
        if not row.name.startswith("ours"):
            continue
        if row.table.startswith("forward") and (row.us > FORWARD_US or row.errors["error"] > TIGHT):
            found.append(f"{where}: {row.us:.2f} us, {row.errors['error']:.1e}")
        if row.table.startswith("inverse"):
            if row.us > INVERSE_US or max(row.errors["m"], row.errors["rad"]) > TIGHT:
                found.append(f"{where}: {row.us:.2f} us, {row.errors['m']:.1e} m")
            if row.errors.get("missed", 0):
                found.append(f"{where}: {row.errors['missed']} missed")
            # For a unit's postures, its iteration reaches 5e-13 m and rad.
            if MODEL in row.table and row.errors.get("joints rad", 0.0) > ROUND_TRIP:
                found.append(f"{where}: {row.errors['joints rad']:.1e} rad")
        if row.table.startswith("streamed") and (
            row.errors["conditions"] > CONDITIONS or row.errors["error rad/s"] > CONDITIONS or row.errors["missed"]
        ):
            found.append(f"{where}: {row.errors}")
    return found


def show(rows: list[Row], out: TextIO) -> None:
    """Print the tables."""
    for table, of_table in groupby(rows, attrgetter("table")):
        lines = (
            (row.name, f"{row.us:.2f}", f"{row.us_median:.2f}",
             "  ".join(f"{key} {value:.1e}" if value % 1 else f"{key} {value:g}" for key, value in row.errors.items()))
            for row in of_table
        )  # fmt: skip
        print(table, file=out)
        print_table(("", "us", "median", "errors"), lines, out)
        print(file=out)


def main() -> int:
    """Measure, print, and check the requirements."""
    options = bench_options(__doc__, EXAMPLE)
    add_number(options, "--rounds", 60, "rounds in which all take turns")
    add_number(options, "--poses", 100_000, "of the round trip", least=CALLS)
    arguments = options.parse_args()

    rounds = arguments.rounds
    rows = forward_rows(rounds) + inverse_rows(rounds, arguments.poses) + streaming_rows(rounds) + whole_steps(rounds)
    rows += tracked(rounds)
    out = table_file(arguments.json)
    show(rows, out)
    wrong = missed(rows)
    print(f"required: {'; '.join(wrong) + ': MISSED' if wrong else 'met'}", file=out)
    report = {"rounds": rounds, "poses": arguments.poses, "rows": [asdict(row) for row in rows], "missed": wrong}
    write_json(arguments.json, report)
    return 1 if wrong else 0


if __name__ == "__main__":
    sys.exit(main())
