"""Stability of a coupling with two halves and a virtual tool, as a sampled loop with both delays as queues."""

from collections.abc import Iterable
from itertools import pairwise
from math import ceil, floor, log, pi
from typing import Any

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import Scene, coupling_facts
from haptether.bridge.scene.ejection import settings_of
from haptether.safety.ejection.kernel import kernel
from haptether.studies.design.contact import contacts, largest_scale, scene_numbers
from haptether.studies.design.delay import Follower
from haptether.studies.design.loops import scene_loops
from haptether.studies.design.wall import exponential

Complex = npt.NDArray[np.complex128]
Array = npt.NDArray[np.float64]

RADIUS = 1.0 + 1e-6
"""Roots within this radius count as stable: a common drift of both sides is a root at 1."""
GRID = 3000
"""Frequencies of the first grid."""
MOST_TURN = 1.0
"""Largest turn in rad between two frequencies; a larger one is split."""
SPLITS = 40
HALVINGS = 50
STIFFEST_WALL = 2000.0
"""Stiffness in N/m of the walls that the virtual tool of a scene without any is for."""


class Tool(msgspec.Struct, frozen=True, kw_only=True):
    """Virtual tool `M_v a = F_c + F_e - B_v v`, which commands `x_v + tau v_v`."""

    mass_kg: float
    damping: float
    """B_v in N s/m."""
    lead_s: float
    """tau in s."""


class CoupledLoop(msgspec.Struct, frozen=True, kw_only=True):
    """Hand and device, both halves of a coupling, virtual tool and arm, along one axis; or an arm that takes forces."""

    period_s: float
    """T in s, of both sides."""
    mass_kg: float
    """m of device and hand in kg."""
    damping: float
    """b of device and hand in N s/m."""
    hand_stiffness: float = 0.0
    """k in N/m; 0 if the hand only follows."""
    scale: float = 1.0
    """`lambda_f lambda_p`."""
    master: tuple[float, ...]
    """Coefficients of F_m in x_m, v_m, x_s', v_s', F_c'."""
    slave: tuple[float, ...]
    """Coefficients of F_c in x_v, v_v, x_m', v_m'."""
    velocity: tuple[float, ...] | None = None
    """Response of the estimated V in 1/s to a reading of 1 m, one value per tick; None if V is exact."""
    tool: Tool | None
    """Virtual tool; None for an arm that takes forces."""
    follower: Follower
    """Arm that follows the tool, or takes F_c: then without stiffness."""
    environment_stiffness: float = 0.0
    """K_e in N/m; 0 in free motion."""
    environment_damping: float = 0.0
    """B_e in N s/m."""


def virtual_tool(spec: dict[str, Any]) -> Tool:
    """Return the virtual tool of a scene's numbers, same as `bridge/src/scene/sides.rs`.

    An arm that takes forces is its own tool.
    """
    slave, coupling = spec["slave"], spec["coupling"]
    if slave["takes_force"]:
        return Tool(mass_kg=slave["mass_kg"], damping=slave["viscous"], lead_s=0.0)
    pole = 2.0 * pi * slave["bandwidth_hz"]
    if slave["control"] == "pd":
        pole, lag_s = (slave["stiffness"] / slave["mass_kg"]) ** 0.5, 0.0
    else:
        lag_s = (2.0 if slave["control"] == "position" else 1.0) / pole
    walls = (spec["environment"] or {}).get("objects", ())
    linear = [wall["contact"]["stiffness"] for wall in walls if wall["contact"]["law"] == "kelvin-voigt"]
    stiffest = max(linear, default=0.0) or STIFFEST_WALL
    mass_kg, damping, lead_s = (coupling[f"tool_{name}"] for name in ("mass_kg", "damping", "lead_s"))
    if mass_kg is None:
        mass_kg = stiffest / (0.4 * pole) ** 2
    return Tool(
        mass_kg=mass_kg,
        damping=10.0 * mass_kg if damping is None else damping,
        lead_s=lag_s if lead_s is None else lead_s,
    )


def coupled_loops(scene: Scene, wall_stiffness: float | None = None, *, held: bool = True) -> list[CoupledLoop]:
    """Return the loops of a scene whose coupling has two halves: per felt axis, in free motion and at each contact.

    Args:
        scene: Scene with a [slave], of a coupling other than position-force.
        wall_stiffness: Stiffness in N/m of one wall that replaces the scene's contacts.
        held: True if the scene's hand holds the device.

    Raises:
        ValueError: The coupling is position-force, whose loops are those of `scene_loops`.
    """
    spec = scene_numbers(scene)
    coupling, settings = spec["coupling"], settings_of(scene)
    facts = coupling_facts(coupling["kind"], stiffness=coupling["stiffness"], damping=coupling["damping"])
    if facts.master is None or facts.slave is None:
        message = f"coupling.kind = {coupling['kind']!r}: has no halves: use scene_loops"
        raise ValueError(message)
    period_s = max(spec["run"]["period_s"], spec["slave"]["period_s"])
    velocity: tuple[float, ...] | None = None
    if settings.estimator is not None:
        try:
            velocity = tuple(kernel(settings.estimator, settings.period_s).velocity_noise)
        except ValueError:
            # A window that adapts is at its shortest in fast motion.
            velocity = (1.0 / settings.period_s, -1.0 / settings.period_s)
    springs, walls = contacts(spec) if wall_stiffness is None else ([], [(wall_stiffness, 0.0)])
    spring = tuple(map(sum, zip((0.0, 0.0), *springs, strict=True)))
    tool = virtual_tool(spec)
    takes_force = spec["slave"]["takes_force"]
    own_arm = Follower(mass_kg=tool.mass_kg, damping=tool.damping, stiffness=0.0)
    places = sorted({(spring[0] + k, spring[1] + b) for k, b in ((0.0, 0.0), *walls)})
    return [
        CoupledLoop(
            period_s=period_s,
            mass_kg=loop.mass_kg,
            damping=loop.damping,
            hand_stiffness=loop.hand_stiffness,
            scale=largest_scale(spec, "force_scale") * largest_scale(spec, "position_scale"),
            master=tuple(facts.master),
            slave=tuple(facts.slave),
            velocity=velocity,
            tool=None if takes_force else tool,
            follower=own_arm if takes_force else loop.follower,
            environment_stiffness=stiffness,
            environment_damping=damping,
        )
        for loop in scene_loops(scene, 0.0, held=held)
        if loop.follower is not None
        for stiffness, damping in places
    ]


def coupled_delays(loops: Iterable[CoupledLoop], up_to_s: float) -> tuple[tuple[float, float], ...]:
    """Return the intervals of the sum of both delays in s, 0 to `up_to_s`, in which all loops are stable.

    As for `stable_delays`, the delay includes the tick for which sample and hold stand: a force that is d ticks old
    counts as d + 1.
    """
    common: tuple[tuple[float, float], ...] = ((0.0, up_to_s),)
    for loop in loops:
        period_s = loop.period_s
        ticks = stable_ticks(loop, max(1, ceil(up_to_s / period_s)))
        own = [(0.0 if low == 0.0 else (low + 1.0) * period_s, (high + 1.0) * period_s) for low, high in ticks]
        both = ((max(low, begin), min(high, end)) for low, high in common for begin, end in own)
        common = tuple((low, high) for low, high in both if low < high)
    return common


def stable_ticks(loop: CoupledLoop, up_to: int) -> list[tuple[float, float]]:
    """Return the intervals of d, the sum of both delays in ticks, 0 to `up_to`, with all roots inside the unit circle.

    The loop is `a(z) + c(z) z^-d = 0`. Roots cross the circle at the delays with `z^d = -c / a` of all z with
    `|a| = |c|`; between two of them their number outside is that at any whole d (argument principle).

    Source: Walton and Marshall 1987, here for sampled loops.
    """
    motion = _Motion(loop)
    changes = sorted({0.0, float(up_to), *_crossings(motion, up_to)})
    found: list[tuple[float, float]] = []
    for low, high in pairwise(changes):
        whole = min(max(round(0.5 * (low + high)), ceil(low)), floor(high))
        is_stable = bool(found) and found[-1][1] == low
        if low <= whole <= high:
            is_stable = motion.outside(whole) == 0
        if is_stable and found and found[-1][1] == low:
            found[-1] = (found[-1][0], high)
        elif is_stable:
            found.append((low, high))
    return found


def _crossings(motion: "_Motion", up_to: int) -> list[float]:
    """Return the delays in ticks, 0 to `up_to`, at which a root is on the circle."""

    def ratio(frequency: Array) -> Complex:
        fixed, delayed = motion.parts(frequency)
        return -delayed / fixed

    size = np.log(np.abs(ratio(motion.grid)))
    places = np.flatnonzero(np.sign(size[:-1]) != np.sign(size[1:]))
    low, high, rises = motion.grid[places], motion.grid[places + 1], size[places] < 0.0
    for _ in range(HALVINGS if places.size else 0):
        middle = 0.5 * (low + high)
        is_below = (np.abs(ratio(middle)) < 1.0) == rises
        low, high = np.where(is_below, middle, low), np.where(is_below, high, middle)
    if not places.size:
        return []
    phases = np.angle(ratio(low)) % (2.0 * pi)
    return [
        float(delay)
        for frequency, phase in zip(low, phases, strict=True)
        for delay in np.arange(phase / frequency, up_to, 2.0 * pi / frequency)
    ]


class _Motion:
    """A loop as `a(z) + c(z) z^-d` on the circle, with its open poles outside."""

    def __init__(self, loop: CoupledLoop) -> None:
        self.loop, period_s, arm, tool = loop, loop.period_s, loop.follower, loop.tool
        hand = np.zeros((3, 3))
        hand[0, 1] = 1.0
        hand[1] = [-loop.hand_stiffness / loop.mass_kg, -loop.damping / loop.mass_kg, 1.0 / loop.mass_kg]
        self.hand = exponential(hand * period_s)[:2]

        wall = np.array([loop.environment_stiffness, loop.environment_damping])
        x, v, force = loop.master[2:5]
        if tool is None:
            # States x_a, v_a of an arm under a held F_c, in contact.
            motion = np.zeros((3, 3))
            motion[0, 1] = 1.0
            motion[1] = np.array([-wall[0], -arm.damping - wall[1], 1.0]) / arm.mass_kg
            step = exponential(motion * period_s)[:2]
            self.step, self.push = step[:, :2] + np.outer(step[:, 2], loop.slave[:2]), step[:, 2]
            back = np.array([x + force * loop.slave[0], v + force * loop.slave[1]])
            self._end(back, force)
            return
        # Arm under a held command of position and velocity, in contact.
        follows = arm.damping if arm.follows_velocity else 0.0
        motion = np.zeros((4, 4))
        motion[0, 1] = 1.0
        motion[1] = np.array([-arm.stiffness - wall[0], -arm.damping - wall[1], arm.stiffness, follows]) / arm.mass_kg
        step = exponential(motion * period_s)[:2]

        # States x_v, v_v, x_a, v_a, and the input from the master.
        per = period_s / tool.mass_kg
        speed = np.array([per * loop.slave[0], 1.0 + per * loop.slave[1], -per * wall[0], -per * wall[1], per])
        speed /= 1.0 + per * tool.damping
        place = period_s * speed + np.array([1.0, 0.0, 0.0, 0.0, 0.0])
        command = np.stack((place + tool.lead_s * speed, speed))
        at_arm = step[:, 2:] @ command
        at_arm[:, 2:4] += step[:, :2]
        whole = np.vstack((place, speed, at_arm))
        self.step, self.push = whole[:, :4], whole[:, 4]
        # Numbers for the master: x of the tool, v of the arm, F_c.
        back = np.zeros(4)
        back[0] += x + force * loop.slave[0]
        back[1] += force * loop.slave[1]
        back[3] += v
        self._end(back, force)

    def _end(self, back: Array, force: float) -> None:
        """Set the numbers for the master, by the states and by the input; then the grid, and the open poles outside."""
        self.back, self.through = back, force
        self.grid = np.unique(np.concatenate((np.geomspace(1e-9, pi, GRID), np.linspace(1e-3, pi, GRID))))
        self.poles = sum(
            int((np.abs(np.linalg.eigvals(matrix)) > RADIUS).sum()) for matrix in (self.hand[:, :2], self.step)
        )

    def parts(self, frequency: Array) -> tuple[Complex, Complex]:
        """Return a and c at frequencies in rad per tick."""
        loop, z = self.loop, RADIUS * np.exp(1j * frequency)
        (a, b, first), (c, d, second) = self.hand
        bottom = (z - a) * (z - d) - b * c
        x = ((z - d) * first + b * second) / bottom
        v = ((z - a) * second + c * first) / bottom
        if loop.velocity is not None:
            v = x * np.polyval(loop.velocity[::-1], 1.0 / z)
        states = z[:, None, None] * np.eye(len(self.step)) - self.step
        inverse = np.linalg.solve(states, self.push[:, None].astype(np.complex128))
        slave = inverse[:, :, 0] @ self.back + self.through
        fixed = 1.0 + loop.scale * (loop.master[0] * x + loop.master[1] * v)
        return fixed, loop.scale * (loop.slave[2] * x + loop.slave[3] * v) * slave

    def outside(self, ticks: int) -> int:
        """Return the number of roots outside the circle at a delay, by the turns of the loop along it."""

        def loop(frequency: Array) -> Complex:
            fixed, delayed = self.parts(frequency)
            late: Complex = fixed + delayed * np.exp(-1j * frequency * ticks - log(RADIUS) * ticks)
            return late

        frequency = self.grid
        values = loop(frequency)
        for _ in range(SPLITS):
            turns = np.angle(values[1:] / values[:-1])
            far = np.flatnonzero(np.abs(turns) > MOST_TURN)
            if not far.size:
                break
            middle = 0.5 * (frequency[far] + frequency[far + 1])
            frequency = np.insert(frequency, far + 1, middle)
            values = np.insert(values, far + 1, loop(middle))
        return self.poles - round(float(turns.sum()) / pi)
