"""Independent reference: device, hand and wall on one axis, integrated piece by piece with SciPy.

Motion is smooth between two events: the wall is met or left, the velocity passes zero, friction gives way, the grip
starts or stops slipping, a kink of path or grip. Each piece is one call of `solve_ivp` with DOP853, which ends at the
first event. Brent's method locates its time on the dense output.
"""

from collections.abc import Callable
from dataclasses import dataclass, replace
from math import inf

import numpy as np
import numpy.typing as npt
from scipy.integrate import solve_ivp

from haptether.bridge import Plane, Scene

Array = npt.NDArray[np.float64]
Law = Callable[[float, Array], float]

RTOL, ATOL = 1e-13, 1e-15
MAX_PIECES = 10_000
KINKED = 1e-12
"""Time in s within which a kink counts as reached."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Motion:
    """Position in m and velocity in m/s at each tick, and times in s at which the wall started and stopped pushing."""

    time_s: Array
    position: Array
    velocity: Array
    met_s: tuple[float, ...]
    left_s: tuple[float, ...]
    pieces: int


@dataclass(frozen=True, slots=True, kw_only=True)
class Regime:
    """Laws in force."""

    grip: float | None = 0.0
    """0: the grip holds; +1 or -1: it slips, with its force in that direction; None: nobody grips."""
    rub: float | None = None
    """+1 or -1: friction against a motion in that direction; 0: friction holds the device; None: no friction."""
    wall: str = "away"
    """away, pushes, or slack: inside a wall that would have to pull."""


def number(value: object) -> float:
    """Return a field that is given for one axis."""
    if not isinstance(value, float | int):
        message = f"{value!r}: must be one number: one axis"
        raise TypeError(message)
    return float(value)


class Plant:
    """Numbers of a one-axis scene: a device, perhaps a hand, a wall that fills x < 0, and a steady push."""

    def __init__(self, scene: Scene) -> None:
        device, hand, environment = scene.master, scene.operator, scene.environment
        self.mass = number(device.mass_kg)
        self.viscous = number(device.viscous or 0.0)
        self.coulomb = number(device.coulomb or 0.0)
        self.stiffness = self.damping = 0.0
        self.strength, self.release = inf, None
        self.knots, self.ends = [0.0], [0.0]
        if hand is not None:
            self.stiffness, self.damping = hand.stiffness, hand.damping
            self.strength = inf if hand.grip_strength_n is None else hand.grip_strength_n
            self.ends = [number(hand.start)]
            for leg in hand.legs:
                if leg.shape != "minimum-jerk":
                    raise NotImplementedError(leg.shape)
                self.knots.append(self.knots[-1] + leg.duration_s)
                self.ends.append(number(leg.end))
            if hand.release is not None:
                self.release = (hand.release.at_s, hand.release.at_s + hand.release.decay_s)
        start = self.ends[0] if device.position is None else device.position
        self.position, self.velocity = number(start), number(device.velocity)
        self.wall_stiffness = self.wall_damping = self.push = 0.0
        if environment is not None:
            for one in environment.objects:
                if one.shape != Plane():
                    raise NotImplementedError(one.shape)
                self.wall_stiffness, self.wall_damping = one.contact.stiffness, one.contact.damping
            for pusher in environment.pushers:
                if pusher.shape != "step" or pusher.at_s != 0.0 or pusher.duration_s is not None:
                    raise NotImplementedError(pusher.shape)
                self.push += number(pusher.force_n)

    def kinks(self) -> list[float]:
        """Return the times at which path or grip are not smooth."""
        return sorted({*self.knots[1:], *(self.release or ())})

    def target(self, t: float) -> float:
        """Return the position that the hand aims at: `10 s³ - 15 s⁴ + 6 s⁵` of each leg."""
        leg = int(np.searchsorted(self.knots, t, side="right"))
        if leg >= len(self.knots):
            return self.ends[-1]
        begin, end = self.knots[leg - 1], self.knots[leg]
        s = (t - begin) / (end - begin)
        return self.ends[leg - 1] + (self.ends[leg] - self.ends[leg - 1]) * s**3 * (10.0 - 15.0 * s + 6.0 * s * s)

    def grip(self, t: float) -> float:
        """Return the strength of the grip in N."""
        if self.release is None or t <= self.release[0]:
            return self.strength
        begins, ends = self.release
        return self.strength * max(0.0, (ends - t) / (ends - begins))

    def wish(self, t: float, x: float, v: float) -> float:
        """Return the force in N that the hand would exert with an unlimited grip."""
        return self.stiffness * (self.target(t) - x) - self.damping * v

    def pressed(self, x: float, v: float) -> float:
        """Return the force in N of a pushing wall."""
        return -self.wall_stiffness * x - self.wall_damping * v

    def load(self, regime: Regime, t: float, x: float, v: float) -> float:
        """Return the sum of forces in N without Coulomb friction."""
        force = self.push - self.viscous * v
        if regime.grip is not None:
            force += regime.grip * self.grip(t) if regime.grip else self.wish(t, x, v)
        if regime.wall == "pushes":
            force += self.pressed(x, v)
        return force

    def slope(self, regime: Regime) -> Callable[[float, Array], tuple[float, float]]:
        """Return the right-hand side of the equation of motion."""
        if regime.rub == 0.0:
            return lambda _, __: (0.0, 0.0)
        friction = self.coulomb * (regime.rub or 0.0)

        def slope(t: float, y: Array) -> tuple[float, float]:
            x, v = y.tolist()
            return v, (self.load(regime, t, x, v) - friction) / self.mass

        return slope

    def margins(self, regime: Regime) -> dict[str, Law]:
        """Return the functions that fall through zero at the events that can end the regime."""
        found: dict[str, Law] = {}
        sign = regime.grip
        if sign == 0.0 and self.strength < inf:
            found["slips"] = lambda t, y: self.grip(t) - abs(self.wish(t, y[0], y[1]))
        elif sign:
            found["holds"] = lambda t, y: sign * self.wish(t, y[0], y[1]) - self.grip(t)
        if regime.rub == 0.0:
            found["sets off"] = lambda t, y: self.coulomb - abs(self.load(regime, t, y[0], 0.0))
        elif (motion_sign := regime.rub) is not None:
            found["turns"] = lambda _, y: motion_sign * y[1]
        if self.wall_stiffness == 0.0:
            return found
        if regime.wall == "away":
            found["meets"] = lambda _, y: y[0]
        else:
            found["leaves"] = lambda _, y: -y[0]
            if self.wall_damping > 0.0:
                pushes = 1.0 if regime.wall == "pushes" else -1.0
                found["slackens" if pushes > 0.0 else "tightens"] = lambda _, y: pushes * self.pressed(y[0], y[1])
        return found

    def rubbed(self, regime: Regime, t: float, x: float) -> Regime:
        """Return the regime of a device at rest."""
        if self.coulomb == 0.0:
            return replace(regime, rub=None)
        load = self.load(regime, t, x, 0.0)
        return replace(regime, rub=0.0 if abs(load) <= self.coulomb else float(np.sign(load)))

    def begin(self) -> Regime:
        """Return the regime at time 0."""
        x, v = self.position, self.velocity
        regime = Regime()
        if x < 0.0 and self.wall_stiffness > 0.0:
            regime = replace(regime, wall="pushes" if self.pressed(x, v) > 0.0 else "slack")
        if self.stiffness == self.damping == 0.0:
            regime = replace(regime, grip=None)
        elif abs(self.wish(0.0, x, v)) > self.grip(0.0):
            regime = replace(regime, grip=float(np.sign(self.wish(0.0, x, v))))
        if v == 0.0 or self.coulomb == 0.0:
            return self.rubbed(regime, 0.0, x)
        return replace(regime, rub=float(np.sign(v)))

    def after(self, event: str, regime: Regime, t: float, x: float, v: float) -> tuple[Regime, float, float]:
        """Return regime, position and velocity after an event."""
        if event == "slips":
            return replace(regime, grip=float(np.sign(self.wish(t, x, v)))), x, v
        if event == "sets off":
            return replace(regime, rub=float(np.sign(self.load(regime, t, x, 0.0)))), x, 0.0
        if event == "turns":
            return self.rubbed(regime, t, x), x, 0.0
        left: dict[str, Regime] = {
            "holds": replace(regime, grip=0.0),
            "meets": replace(regime, wall="pushes"),
            "leaves": replace(regime, wall="away"),
            "slackens": replace(regime, wall="slack"),
            "tightens": replace(regime, wall="pushes"),
        }
        return left[event], 0.0 if event in {"meets", "leaves"} else x, v


def ticks_of(scene: Scene) -> Array:
    """Return the times of a run's ticks in s."""
    return np.arange(round(scene.run.duration_s / scene.run.period_s), dtype=np.float64) * scene.run.period_s


def terminal(law: Law) -> Law:
    """Return an event that ends the piece when `law` falls through zero."""

    def event(t: float, y: Array) -> float:
        return law(t, y)

    event.terminal = True  # type: ignore[attr-defined]
    event.direction = -1.0  # type: ignore[attr-defined]
    return event


def integrate(scene: Scene, rtol: float = RTOL, max_step_s: float | None = None) -> Motion:
    """Return the motion at each tick of a scene with a continuous wall.

    Args:
        scene: One axis, at most one wall, a steady push; nothing else is implemented.
        rtol: Relative tolerance of `solve_ivp`; the absolute one is a hundredth of it.
        max_step_s: Longest step; by default a tick, so that the dense output is as good as the steps.
    """
    plant, period = Plant(scene), scene.run.period_s
    ticks = ticks_of(scene)
    positions, velocities = np.empty(len(ticks)), np.empty(len(ticks))
    t, x, v, regime = 0.0, plant.position, plant.velocity, plant.begin()
    positions[0], velocities[0] = x, v
    met: list[float] = []
    left: list[float] = []
    pieces, known = 0, 1
    for end in [*(kink for kink in plant.kinks() if kink < ticks[-1]), float(ticks[-1])]:
        while t < end:
            pieces += 1
            if pieces > MAX_PIECES:
                message = f"{pieces} pieces until {t} s"
                raise RuntimeError(message)
            laws = plant.margins(regime)
            requested = ticks[known:][ticks[known:] < end - KINKED]
            requested = requested[requested > t]
            solved = solve_ivp(
                plant.slope(regime), (t, end), (x, v), method="DOP853", rtol=rtol, atol=rtol * ATOL / RTOL,
                max_step=period if max_step_s is None else max_step_s,
                t_eval=[*requested, end], events=[terminal(law) for law in laws.values()],
            )  # fmt: skip
            happened = [
                (times[0], states[0], name)
                for times, states, name in zip(solved.t_events or (), solved.y_events or (), laws, strict=True)
                if len(times)
            ]
            seen = min(len(solved.t), len(requested))
            if seen:
                positions[known : known + seen], velocities[known : known + seen] = solved.y[:, :seen]
                known += seen
            if happened:
                t, (x, v), name = min(happened, key=lambda one: one[0])
                pushed = regime.wall == "pushes"
                regime, x, v = plant.after(name, regime, t, float(x), float(v))
                if pushed != (regime.wall == "pushes"):
                    (left if pushed else met).append(float(t))
            else:
                t, (x, v) = end, solved.y[:, -1].tolist()
        if known < len(ticks) and abs(ticks[known] - end) <= KINKED:
            positions[known], velocities[known] = x, v
            known += 1
        if plant.release is not None and t >= plant.release[1]:
            regime = replace(regime, grip=None)
    return Motion(
        time_s=ticks, position=positions, velocity=velocities, met_s=tuple(met), left_s=tuple(left), pieces=pieces
    )


def recursion(scene: Scene) -> Motion:
    """Return the motion under a wall that is sampled at each tick and held until the next: linear within a tick.

    Its transition matrix is summed in extended precision. Hand and push are constant, without friction.
    """
    plant, period = Plant(scene), scene.run.period_s
    if plant.coulomb != 0.0 or plant.strength < inf or len(plant.knots) > 1 or plant.wall_damping != 0.0:
        raise NotImplementedError
    ticks = ticks_of(scene)
    exact = np.longdouble
    # x, V and the steady acceleration.
    rates = np.zeros((3, 3), dtype=exact)
    rates[0, 1] = rates[1, 2] = 1.0
    rates[1, 0] = -exact(plant.stiffness) / exact(plant.mass)
    rates[1, 1] = -(exact(plant.damping) + exact(plant.viscous)) / exact(plant.mass)
    step, term = np.eye(3, dtype=exact), np.eye(3, dtype=exact)
    for power in range(1, 60):
        term = term @ rates * (exact(period) / power)
        step = step + term
    state = np.array([plant.position, plant.velocity, 0.0], dtype=exact)
    states = np.empty((len(ticks), 2))
    for tick in range(len(ticks)):
        states[tick] = state[:2]
        steady = exact(plant.push) + exact(plant.stiffness) * exact(plant.ends[0])
        state[2] = (steady + exact(plant.wall_stiffness) * max(-state[0], exact(0.0))) / exact(plant.mass)
        state = step @ state
    return Motion(time_s=ticks, position=states[:, 0], velocity=states[:, 1], met_s=(), left_s=(), pieces=len(ticks))


def tick_by_tick(scene: Scene) -> Motion:
    """Return the same motion by DOP853, one call per tick."""
    plant, period = Plant(scene), scene.run.period_s
    ticks = ticks_of(scene)
    states = np.empty((len(ticks), 2))
    state = np.array([plant.position, plant.velocity])
    for tick in range(len(ticks)):
        states[tick] = state
        held = plant.wall_stiffness * max(-state[0], 0.0)

        def slope(t: float, y: Array, held: float = held) -> tuple[float, float]:
            x, v = y.tolist()
            return v, (plant.load(Regime(), t, x, v) + held) / plant.mass

        state = solve_ivp(slope, (0.0, period), state, method="DOP853", rtol=RTOL, atol=ATOL).y[:, -1]
    return Motion(time_s=ticks, position=states[:, 0], velocity=states[:, 1], met_s=(), left_s=(), pieces=len(ticks))
