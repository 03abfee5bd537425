"""The numbers behind the documents' pictures: the output of commands, stored together with the pictures."""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

from tests.images.tuning import record_numbers

ROOT = Path(__file__).resolve().parents[2]
KEPT = Path(__file__).with_name("numbers.json")
LONGEST_S = 900.0

UNSTABLE = re.compile(r"^(picture|drawn|screenshot|movie|computed in)\b|\bwall_time_s\b")
"""Lines with a path or a run time."""

REMOTE_PUSH = "simulate remote_push"

COMMANDS: dict[str, tuple[str, ...]] = {
    "console.png": (REMOTE_PUSH,),
    "couplings.png": ("evaluate --couplings all --controllers all --quick",),
    "demo.png": tuple(f"{REMOTE_PUSH} --set safety.controllers={kinds}" for kinds in ("[]", "[vfc]", "[hsc]", "[wsc]")),
    "netsim_lte_driving.png": ("netsim sample --preset lte-driving --packets 20000",),
    "panel.png": (REMOTE_PUSH,),
    "paper_active_force.png": ("paper",),
    "paper_controllers.png": ("paper",),
    "paper_ejection.png": ("paper",),
    "paper_mev.png": ("paper",),
    "paper_observers.png": ("paper",),
    "paper_sensitivity.png": ("paper --sensitivity",),
    "paper_window.png": ("paper",),
    "report.png": (REMOTE_PUSH,),
    "run_remote_push.png": (REMOTE_PUSH,),
    "sweep_delay.png": (
        "sweep remote_push --vary link.forward.delay_s=0.01:0.1:10 --vary run.seed=1,2,3,4,5 --json -",
    ),
    "thresholds.png": (
        (
            "thresholds free_motion paper_wall active_force moving_wall sliding_mass remote_push "
            "--round-trip-s 0 0.1 0.3 --hands 6"
        ),
    ),
    "tune.png": ("tune",),
    "view_push.gif": (REMOTE_PUSH, f"{REMOTE_PUSH} --set safety.controllers=[]"),
    "view_remote_push.png": (REMOTE_PUSH,),
    "view_ur_pick.png": ("simulate ur_pick",),
}
"""Commands by picture. `flame_remote_push.png` shows a stored profile; `work_precision.png` depends on the machine."""

SLOW = frozenset(command for name in ("couplings.png", "thresholds.png", "tune.png") for command in COMMANDS[name])
"""Commands that take more than 10 s."""


def output(command: str) -> list[str]:
    """Return the lines that a command prints, without paths and run times."""
    if command == "tune":
        lines = record_numbers()
    else:
        words = [sys.executable, "-m", "haptether", *command.split()]
        ran = subprocess.run(words, check=True, timeout=LONGEST_S, cwd=ROOT, stdout=subprocess.PIPE, text=True)
        lines = ran.stdout.splitlines()
    return [line.rstrip() for line in lines if not UNSTABLE.search(line.strip())]


def sha256(picture: Path) -> str:
    """Return the digest of a picture."""
    return hashlib.sha256(picture.read_bytes()).hexdigest()


def keep(pictures: list[Path]) -> None:
    """Store the digests of new pictures, and the numbers behind them."""
    kept = json.loads(KEPT.read_text()) if KEPT.exists() else {"pictures": {}, "commands": {}}
    for picture in pictures:
        kept["pictures"][picture.name] = sha256(picture)
    for command in sorted({command for picture in pictures for command in COMMANDS.get(picture.name, ())}):
        kept["commands"][command] = output(command)
    KEPT.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")
