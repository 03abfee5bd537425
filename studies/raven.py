"""Attacks on the path of a teleoperation: those of the RAVEN II study, with a key and without.

Each attack is a shipped scene. Its run is compared with a run of the same scene without the attack.

Source: arXiv 1504.04339 (Bonaci et al. 2015).
"""

from collections.abc import Callable
from typing import Literal, TypeAlias

import msgspec
import numpy as np
import numpy.typing as npt

from haptether.bridge import Run, Scene, ladder_state_name, load_scene, simulate
from haptether.studies.raven_attacks import RAVEN_ATTACKS, Effect, RavenAttack, Security

Array: TypeAlias = npt.NDArray[np.float64]
Flags: TypeAlias = npt.NDArray[np.bool_]

SECURITY: dict[Security, tuple[str, ...]] = {"off": ("security.secure=false",), "on": ("security.secure=true",)}
"""Overrides of a scene that turn authentication of frames off or on."""

COASTING_S = 0.02
"""Time for which the arm follows a velocity that is not renewed; then the ladder holds."""
COMMAND_SPEED = 3.0
"""Bound in m/s on an arm's command."""
FADE_S = 0.1
"""Time for a force to fade out after the ladder has left ENGAGED."""

WORKS: dict[Effect, Literal["yes", "denies", "delays", "no"]] = {
    "moved": "yes",
    "pushed": "yes",
    "stopped": "denies",
    "late": "delays",
    "none": "no",
}


class RavenRow(msgspec.Struct, frozen=True, kw_only=True):
    """One attack on one kind of frames. Lengths in mm, forces in N."""

    scene: str
    kind: str
    security: Security
    effect: Effect
    """Effect of the attack."""
    expected: Effect
    """Known effect of the attack."""
    because: str
    """Reason why it does no more."""
    astray_mm: float
    """Largest distance of the arm's command from all places to which the hand had led it so far."""
    astray_limit_mm: float
    """Largest such distance without an attack: coasting for 20 ms, and one tick at the speed bound."""
    lag_mm: float
    """Largest difference of the arm's command from the run without the attack, while both sides were coupled."""
    extra_force_n: float
    """Excess of the largest force on the hand over the run without the attack."""
    extra_force_limit_n: float
    """Largest such excess without an attack: the touched stiffness times the allowed distance."""
    moved_in_hold_mm: float
    """Travel of the arm's command while its ladder held or stopped."""
    force_in_hold_n: float
    """Largest force on the hand later than 100 ms after its ladder had left ENGAGED."""
    refused: int
    """Datagrams that were not from the peer, or no frames; they changed nothing."""
    final_states: tuple[str, str]
    """Final states of master and slave."""

    @property
    def works(self) -> Literal["yes", "denies", "delays", "no"]:
        """Outcome: arm or hand was led ("yes"), the link was cut ("denies") or slowed ("delays"), or none ("no")."""
        return WORKS[self.effect]

    @property
    def is_safe(self) -> bool:
        """True if each held side stayed at rest."""
        return self.moved_in_hold_mm == 0.0 and self.force_in_hold_n == 0.0


class RavenReport(msgspec.Struct, frozen=True, kw_only=True):
    """All attacks on all kinds of frames."""

    rows: tuple[RavenRow, ...]

    @property
    def is_as_expected(self) -> bool:
        """True if each attack has its known effect and held sides stayed at rest."""
        return all(row.effect == row.expected and row.is_safe for row in self.rows)

    def as_json(self) -> bytes:
        """Report as JSON."""
        rows = [{**msgspec.to_builtins(row), "works": row.works, "is_safe": row.is_safe} for row in self.rows]
        return msgspec.json.format(msgspec.json.encode({"rows": rows, "is_as_expected": self.is_as_expected}), indent=2)


def raven_suite(*, progress: Callable[[int, int], None] | None = None) -> RavenReport:
    """Run every attack on every kind of frames, with reference runs without attacks.

    Args:
        progress: Called after each attack with the number done and the total.
    """
    pairs = [(attack, security) for attack in RAVEN_ATTACKS for security in SECURITY]
    rows = []
    for attack, security in pairs:
        rows.append(measure_attack(attack, security))
        if progress is not None:
            progress(len(rows), len(pairs))
    return RavenReport(rows=tuple(rows))


def measure_attack(attack: RavenAttack, security: Security) -> RavenRow:
    """Run one attack on one kind of frames and measure its effect."""
    scene = load_scene(attack.scene, SECURITY[security])
    attacked, alone = simulate(scene), simulate(scene, overrides=_nobody(scene))
    near, far = _coupled(attacked, "state"), _coupled(attacked, "slave_state")
    command = _signal(attacked, "slave_command")
    # The hand's speed comes from the run without the attack.
    speed = float(abs(_signal(alone, "velocity")).max())
    astray_limit = speed * COASTING_S + COMMAND_SPEED * scene.run.period_s
    extra_limit = _stiffness(scene) * astray_limit
    astray = _astray(_signal(attacked, "position"), command, far)
    extra = float(abs(_signal(attacked, "device_force")).max() - abs(_signal(alone, "device_force")).max())
    lag = _lag(attacked, alone)
    expected = attack.without if security == "off" else attack.protected
    effect: Effect = "none"
    if astray > astray_limit:
        effect = "moved"
    elif extra > extra_limit:
        effect = "pushed"
    elif _parted(near) or _parted(far):
        effect = "stopped"
    elif lag > astray_limit:
        effect = "late"
    return RavenRow(
        scene=attack.scene,
        kind=attack.kind,
        security=security,
        effect=effect,
        expected=expected,
        because=attack.because
        if expected == attack.protected
        else "without a key, whoever knows the format is believed",
        astray_mm=1e3 * astray,
        astray_limit_mm=1e3 * astray_limit,
        lag_mm=1e3 * lag,
        extra_force_n=extra,
        extra_force_limit_n=extra_limit,
        moved_in_hold_mm=1e3 * _travel(command, far),
        force_in_hold_n=_force_in_hold(attacked, near),
        refused=_refused(attacked),
        final_states=(_final_state(attacked, "state"), _final_state(attacked, "slave_state")),
    )


def _nobody(scene: Scene) -> list[str]:
    links = {} if scene.link is None else {"forward": scene.link.forward, "backward": scene.link.backward}
    return [f"link.{direction}.attacks=[]" for direction, link in links.items() if link is not None and link.attacks]


def _stiffness(scene: Scene) -> float:
    """Largest stiffness that the arm can touch in N/m."""
    objects = () if scene.environment is None else scene.environment.objects
    return max((item.contact.stiffness for item in objects), default=0.0)


def _signal(run: Run, name: str) -> Array:
    return np.asarray(run.signals[name], dtype=np.float64).reshape(-1)


def _coupled(run: Run, name: str) -> Flags:
    """Mask of the ticks at which a side was coupled."""
    codes = _signal(run, name)
    coupled = [code for code in np.unique(codes) if ladder_state_name(int(code)) in ("engaged", "stale")]
    return np.isin(codes, coupled)


def _parted(coupled: Flags) -> bool:
    """True if a coupled side was decoupled."""
    return bool((coupled[:-1] & ~coupled[1:]).any())


def _astray(hand: Array, command: Array, coupled: Flags) -> float:
    """Largest distance in m of the command from all places to which the hand had led it so far.

    On one axis these places are an interval, because the hand's path is continuous.
    """
    if not coupled.any():
        return 0.0
    first = int(np.argmax(coupled))
    ticks = slice(first, min(len(hand), len(command)))
    led = hand[ticks] - hand[first] + command[first]
    above = command[ticks] - np.maximum.accumulate(led)
    below = np.minimum.accumulate(led) - command[ticks]
    return float(max(above.max(), below.max(), 0.0))


def _lag(attacked: Run, alone: Run) -> float:
    """Largest difference in m between the commands of two runs while all their sides were coupled."""
    both = [_coupled(run, side) for run in (attacked, alone) for side in ("state", "slave_state")]
    commands = [_signal(run, "slave_command") for run in (attacked, alone)]
    ticks = min(map(len, [*both, *commands]))
    together = np.logical_and.reduce([flags[:ticks] for flags in both])
    return float(abs(commands[0][:ticks] - commands[1][:ticks])[together].max(initial=0.0))


def _travel(command: Array, coupled: Flags) -> float:
    """Travel in m of the command between ticks at which the side was no longer coupled."""
    ever = np.logical_or.accumulate(coupled)
    held = (ever & ~coupled)[:-1] & ~coupled[1:]
    return float(abs(np.diff(command))[held].sum())


def _force_in_hold(run: Run, coupled: Flags) -> float:
    """Largest force in N on the hand later than `FADE_S` after its side was decoupled."""
    time_s, force = _signal(run, "time_s"), _signal(run, "device_force")
    newest = np.maximum.accumulate(np.where(coupled, time_s, -np.inf))
    later = np.isfinite(newest) & (time_s - newest > FADE_S + 1e-9)
    return float(abs(force)[later].max(initial=0.0))


def _refused(run: Run) -> int:
    """Number of datagrams that either side refused, from the texts of the run's events."""
    details = [event.detail for event in run.events if event.kind == "refused"]
    return sum(int(word) for detail in details for word in detail.split() if word.isdigit())


def _final_state(run: Run, name: str) -> str:
    return ladder_state_name(int(_signal(run, name)[-1]))
