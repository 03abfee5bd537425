"""`haptether list`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import tyro

from haptether.cli.shared.output import FileOptions


@dataclass(frozen=True, kw_only=True)
class List(FileOptions):
    """List the available drivers, device presets, scenes, hands, networks and safety controllers.

    Drivers and controllers in Python are entry points of the groups `haptether.masters`, `haptether.slaves`,
    `haptether.grippers` and `haptether.controllers`; other installed packages may provide more. A driver whose package
    cannot be loaded is listed with the reason.

    Examples:

    haptether list

    haptether list --json -
    """

    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write the same as JSON; - for standard output."""

    def run(self) -> int:
        """Print the names of each kind."""
        from rich.padding import Padding

        from haptether.bridge import (
            COUPLINGS,
            GRIPPERS,
            MASTERS,
            RESEARCH_CONTROLLERS,
            SLAVES,
            controller_names,
            device_names,
            load_problems,
            population_names,
            scene_names,
        )
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.master import DEVICE_PRESETS
        from haptether.netsim import PRESETS
        from haptether.safety import CONTROLLERS, ESTIMATORS, OBSERVERS

        check_target(self.json, force=self.force)
        kinds: dict[str, tuple[str, tuple[str, ...]]] = {
            "[master] driver": ("drivers of haptic devices; without one a model", device_names(MASTERS)),
            "[slave] device": ("drivers of arms, and a model", ("simulated", *device_names(SLAVES))),
            "[slave.gripper] device": (
                "drivers of grippers, for haptether.bridge.load_gripper",
                device_names(GRIPPERS),
            ),
            "[safety.research] controller": ("controllers in Python, of simulated runs", controller_names()),
            "[master] device": ("presets of haptic devices", tuple(DEVICE_PRESETS)),
            "SCENE": (
                "scenes: haptether simulate --list says what they show, haptether raven lists attacks",
                scene_names(),
            ),
            "--population": ("hands that haptether sweep draws: docs/populations.md has them", population_names()),
            "preset": ("networks: haptether netsim list says where they come from", tuple(PRESETS)),
        }
        registries = {
            "[coupling] kind": ("what each side feels of the other", COUPLINGS),
            "[safety] controllers": ("what intervenes when the hand is not safe", CONTROLLERS),
            "observer": ("what the controllers act on", OBSERVERS),
            "[safety.estimator] kind": ("how velocity and acceleration are had from the position", ESTIMATORS),
        }
        groups = {
            "[master] driver": MASTERS,
            "[slave] device": SLAVES,
            "[slave.gripper] device": GRIPPERS,
            "[safety.research] controller": RESEARCH_CONTROLLERS,
        }
        problems = {key: load_problems(group) for key, group in groups.items()}
        console = screen(self.json)
        for key, (what, names) in kinds.items():
            console.print(f"{key}: {what}", style="bold")
            broken = problems.get(key, {})
            console.print(Padding(", ".join(name for name in names if name not in broken) or "-", (0, 0, 0, 2)))
            for name, why in broken.items():
                console.print(Padding(f"{name}: {why}", (0, 0, 0, 2)))
        for key, (what, registry) in registries.items():
            console.print(f"{key}: {what}", style="bold")
            for name, title, source in registry:
                console.print(Padding(f"{name}: {title} ({source})", (0, 0, 0, 2)))
        report: dict[str, object] = {key: list(names) for key, (_, names) in kinds.items()}
        report |= {key: [name for name, _, _ in registry] for key, (_, registry) in registries.items()}
        report["cannot be loaded"] = {key: broken for key, broken in problems.items() if broken}
        write_report(self.json, report)
        return 0
