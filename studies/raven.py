"""Attacks of the RAVEN II study on a teleoperation, with and without a key.

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
"""Overrides that disable or enable authentication of the frames."""

COASTING_S = 0.02
"""Time in s for which the arm follows a velocity that is not renewed; then the ladder holds."""
COMMAND_SPEED = 3.0
"""Bound of the arm's command in m/s."""
FADE_S = 0.1
"""Fade-out time in s of a force after the ladder leaves ENGAGED."""

WORKS: dict[Effect, Literal["yes", "denies", "delays", "no"]] = {
    "moved": "yes",
    "pushed": "yes",
    "stopped": "denies",
    "late": "delays",
    "none": "no",
}


class RavenRow(msgspec.Struct, frozen=True, kw_only=True):
    """One attack with one security setting. Lengths in mm, forces in N."""

    scene: str
    kind: str
    security: Security
    effect: Effect
    """Observed effect."""
    expected: Effect
    """Known effect."""
    because: str
    """Reason why the effect is not larger."""
    astray_mm: float
    """Largest distance of the arm's command from all previous positions of the hand."""
    astray_limit_mm: float
    """Distance without an attack: coasting for 20 ms, and one tick at the speed bound."""
    lag_mm: float
    """Largest difference of the arm's command from the run without an attack, while coupled."""
    extra_force_n: float
    """Excess of the largest force on the hand over the run without an attack."""
    extra_force_limit_n: float
    """Excess without an attack: the contact pressed by the allowed distance."""
    moved_in_hold_mm: float
    """Travel of the arm's command while its ladder held or stopped."""
    force_in_hold_n: float
    """Largest force on the hand later than 100 ms after its ladder left ENGAGED."""
    refused: int
    """Refused datagrams that were not of the peer, or not a frame."""
    final_states: tuple[str, str]
    """Final states of master and slave."""

    @property
    def works(self) -> Literal["yes", "denies", "delays", "no"]:
        """Success: "yes" if arm or hand obeyed the attacker; otherwise the effect on the connection only."""
        return WORKS[self.effect]

    @property
    def is_safe(self) -> bool:
        """True if held sides did not move."""
        return self.moved_in_hold_mm == 0.0 and self.force_in_hold_n == 0.0


class RavenReport(msgspec.Struct, frozen=True, kw_only=True):
    """All attacks with all security settings."""

    rows: tuple[RavenRow, ...]

    @property
    def is_as_expected(self) -> bool:
        """True if each attack had its known effect, and held sides did not move."""
        return all(row.effect == row.expected and row.is_safe for row in self.rows)

    def as_json(self) -> bytes:
        """Return the report as JSON."""
        rows = [{**msgspec.to_builtins(row), "works": row.works, "is_safe": row.is_safe} for row in self.rows]
        return msgspec.json.format(msgspec.json.encode({"rows": rows, "is_as_expected": self.is_as_expected}), indent=2)


def raven_suite(*, progress: Callable[[int, int], None] | None = None) -> RavenReport:
    """Run every attack with every security setting, and without the attack.

    Args:
        progress: If given, called after each run with the finished and the total number.
    """
    pairs = [(attack, security) for attack in RAVEN_ATTACKS for security in SECURITY]
    rows = []
    for attack, security in pairs:
        rows.append(measure_attack(attack, security))
        if progress is not None:
            progress(len(rows), len(pairs))
    return RavenReport(rows=tuple(rows))


def measure_attack(attack: RavenAttack, security: Security) -> RavenRow:
    """Run one attack with one security setting, and measure its effect."""
    scene = load_scene(attack.scene, SECURITY[security])
    attacked, alone = simulate(scene), simulate(scene, overrides=_nobody(scene))
    near, far = _coupled(attacked, "state"), _coupled(attacked, "slave_state")
    command = _signal(attacked, "slave_command")
    # Hand speed of the run without an attack.
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
    """Return the overrides that disable the attack."""
    links = {} if scene.link is None else {"forward": scene.link.forward, "backward": scene.link.backward}
    return [f"link.{direction}.attacks=[]" for direction, link in links.items() if link is not None and link.attacks]


def _stiffness(scene: Scene) -> float:
    """Return the largest contact stiffness of the arm in N/m."""
    objects = () if scene.environment is None else scene.environment.objects
    return max((item.contact.stiffness for item in objects), default=0.0)


def _signal(run: Run, name: str) -> Array:
    """Return a signal with one axis."""
    return np.asarray(run.signals[name], dtype=np.float64).reshape(-1)


def _coupled(run: Run, name: str) -> Flags:
    """Return the mask of ticks at which a side was coupled."""
    codes = _signal(run, name)
    coupled = [code for code in np.unique(codes) if ladder_state_name(int(code)) in ("engaged", "stale")]
    return np.isin(codes, coupled)


def _parted(coupled: Flags) -> bool:
    """Return True if a coupled side decoupled."""
    return bool((coupled[:-1] & ~coupled[1:]).any())


def _astray(hand: Array, command: Array, coupled: Flags) -> float:
    """Return the largest distance in m of the command from all previous positions of the hand.

    On one axis these positions form an interval, because a hand moves continuously.
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
    """Return the largest difference in m of the commands of both runs while all sides were coupled."""
    both = [_coupled(run, side) for run in (attacked, alone) for side in ("state", "slave_state")]
    commands = [_signal(run, "slave_command") for run in (attacked, alone)]
    ticks = min(map(len, [*both, *commands]))
    together = np.logical_and.reduce([flags[:ticks] for flags in both])
    return float(abs(commands[0][:ticks] - commands[1][:ticks])[together].max(initial=0.0))


def _travel(command: Array, coupled: Flags) -> float:
    """Return the travel in m of the command while the side was no longer coupled."""
    ever = np.logical_or.accumulate(coupled)
    held = (ever & ~coupled)[:-1] & ~coupled[1:]
    return float(abs(np.diff(command))[held].sum())


def _force_in_hold(run: Run, coupled: Flags) -> float:
    """Return the largest force in N on the hand later than `FADE_S` after its side decoupled."""
    time_s, force = _signal(run, "time_s"), _signal(run, "device_force")
    newest = np.maximum.accumulate(np.where(coupled, time_s, -np.inf))
    later = np.isfinite(newest) & (time_s - newest > FADE_S + 1e-9)
    return float(abs(force)[later].max(initial=0.0))


def _refused(run: Run) -> int:
    """Return the number of refused datagrams of both sides, from the texts of the run's events."""
    details = [event.detail for event in run.events if event.kind == "refused"]
    return sum(int(word) for detail in details for word in detail.split() if word.isdigit())


def _final_state(run: Run, name: str) -> str:
    return ladder_state_name(int(_signal(run, name)[-1]))
