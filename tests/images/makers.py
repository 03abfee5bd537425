"""Makers of the documents' pictures: the command line on the page of each, or a function that photographs a screen."""

import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.images.panel import photograph_panel
from tests.images.report import photograph_report
from tests.images.tuning import photograph_tuning

ROOT = Path(__file__).resolve().parents[2]
LONGEST_S = 900.0

Maker = Callable[[Path], None]
"""Function that writes a picture to a path."""


def run(*command: str) -> None:
    """Run a command that must succeed."""
    subprocess.run(command, check=True, timeout=LONGEST_S, cwd=ROOT, stdout=subprocess.DEVNULL)


def haptether(*arguments: str) -> Maker:
    """Return the maker of a command whose last option takes the path of the picture."""
    return lambda path: run(sys.executable, "-m", "haptether", *arguments, str(path), "--force")


def from_folder(name: str, *command: str) -> Maker:
    """Return the maker of a command that writes into a folder, and keep one file of it."""

    def make(path: Path) -> None:
        with TemporaryDirectory() as folder:
            run(sys.executable, *command, folder)
            shutil.copyfile(Path(folder) / name, path)

    return make


MAKERS: Mapping[str, Maker] = {
    "console.png": lambda path: run(sys.executable, "-m", "tests.view.console.screenshot", str(path)),
    "couplings.png": haptether("evaluate", "--couplings", "all", "--controllers", "all", "--quick", "--plot"),
    "demo.png": from_folder("demo.png", "-m", "haptether", "demo", "--out"),
    "flame_remote_push.png": lambda path: run(
        sys.executable, "benches/flame_graph.py", "--before", "benches/profiles/remote_push_before.json",
        "--plot", str(path),
    ),
    "netsim_lte_driving.png": haptether(
        "netsim", "sample", "--preset", "lte-driving", "--packets", "20000", "--plot"
    ),
    "panel.png": photograph_panel,
    "paper_active_force.png": from_folder("fig12_to_15_active_force.png", "-m", "haptether", "paper", "--plot"),
    "paper_controllers.png": from_folder("fig08_to_11_controllers.png", "-m", "haptether", "paper", "--plot"),
    "paper_ejection.png": from_folder("fig04_ejection.png", "-m", "haptether", "paper", "--plot"),
    "paper_mev.png": from_folder("fig05_mev.png", "-m", "haptether", "paper", "--plot"),
    "paper_observers.png": from_folder("fig06_observers.png", "-m", "haptether", "paper", "--plot"),
    "paper_sensitivity.png": from_folder(
        "sensitivity.png", "-m", "haptether", "paper", "--sensitivity", "--plot"
    ),
    "paper_window.png": from_folder("table1_window.png", "-m", "haptether", "paper", "--plot"),
    "report.png": photograph_report,
    "run_remote_push.png": haptether("simulate", "remote_push", "--plot"),
    "sweep_delay.png": haptether(
        "sweep", "remote_push", "--vary", "link.forward.delay_s=0.01:0.1:10", "--vary", "run.seed=1,2,3,4,5", "--plot"
    ),
    "thresholds.png": haptether(
        "thresholds", "free_motion", "paper_wall", "active_force", "moving_wall", "sliding_mass", "remote_push",
        "--round-trip-s", "0", "0.1", "0.3", "--hands", "6", "--plot",
    ),
    "tune.png": photograph_tuning,
    "try.png": lambda path: run(sys.executable, "-m", "tests.view.trial.screenshot", str(path)),
    "view_push.gif": haptether(
        "view", "remote_push", "--compare", "safety.controllers=[]", "--title", "with WSC",
        "--title", "without a controller", "--from-s", "2.5", "--until-s", "3.1", "--speed", "0.2", "--fps", "12",
        "--size", "880x560", "--movie",
    ),
    "view_remote_push.png": haptether("view", "remote_push", "--at-s", "2.745", "--size", "1000x600", "--screenshot"),
    "view_ur_pick.png": haptether("view", "ur_pick", "--camera", "corner", "--at-s", "4", "--screenshot"),
    "work_precision.png": from_folder("work_precision.png", "benches/work_precision.py", "--plot"),
}  # fmt: skip
"""Makers by file name under docs/images."""
