"""Picture of `haptether tune`: hands that press the wall of `remote_push` and hold, and their thresholds."""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from haptether.bridge import override_scene, simulate
from haptether.studies.task import HandBounds, Task

HANDS = 40
SETTINGS = (
    "safety.energy_ratio=0.5",
    "safety.energy_threshold_j=-0.03",
    "safety.velocity_threshold=0.6",
    "safety.hsc_velocity_threshold=0.05",
    "safety.hsc_force_threshold_n=1.0",
    "safety.window=10",
    "safety.wsc_force_threshold_n=0.1",
    "safety.vfc_form=both",
    "safety.vfc_force_threshold_n=0.3",
)
"""Settings of docs/thresholds.md."""


def record_hands(folder: Path, hands: int = HANDS, seed: int = 1) -> list[Path]:
    """Record masters, each with another random hand that holds."""
    task = Task("remote_push", 0.1)
    drawn, held = task.hands(hands, seed, HandBounds()), task.with_controllers(task.lasting(HandBounds()), None, {})
    files = [folder / f"hand{hand}.mcap" for hand in range(hands)]
    for hand, file in enumerate(files):
        changes = [
            f"{path}={int(values[hand]) if path == 'run.seed' else float(values[hand])}"
            for path, values in drawn.items()
        ]
        simulate(override_scene(held, changes), record=(file, folder / "slave.mcap"))
    return files


def photograph_tuning(path: Path) -> None:
    """Draw the plot of `haptether tune` for these recordings."""
    tune("--plot", str(path), "--force")


def record_numbers() -> list[str]:
    """Return the lines that `haptether tune` prints for these recordings."""
    return tune()


def tune(*options: str) -> list[str]:
    """Run the command on new recordings; return its output without the folder of the recordings."""
    with TemporaryDirectory() as folder:
        files = map(str, record_hands(Path(folder)))
        changes = [word for setting in SETTINGS for word in ("--set", setting)]
        command = [sys.executable, "-m", "haptether", "tune", *files, *changes, *options]
        # Status 1 means that the recordings are too short for a threshold; 0 means that they are not.
        ran = subprocess.run(command, check=True, timeout=900.0, stdout=subprocess.PIPE, text=True)
        return ran.stdout.replace(f"{folder}/", "").splitlines()


if __name__ == "__main__":
    photograph_tuning(Path(sys.argv[1]))
