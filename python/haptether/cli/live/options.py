"""What both live commands are asked for beside their side: a scene, real time and a recording."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import tyro


@dataclass(frozen=True, kw_only=True)
class LiveOptions:
    """The scene, real time and recording."""

    scene: Annotated[str | None, tyro.conf.arg(metavar="SCENE")] = None
    """Take everything but the network from a scene, the same at both sides, and drive the devices that it names."""
    set: Annotated[tyro.conf.UseAppendAction[tuple[str, ...]], tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Change the scene, as in `haptether simulate`; may be given often."""
    debug: bool = False
    """Show the traceback of what ended the run, a driver's exception above all."""
    realtime: Literal["auto", "off", "require"] = "auto"
    """Ask for SCHED_FIFO and locked memory and go on without (auto), do not ask (off), or fail without (require)."""
    priority: Annotated[int, tyro.conf.arg(metavar="1-99")] = 80
    """Priority under SCHED_FIFO."""
    cpu: Annotated[int | None, tyro.conf.arg(metavar="N")] = None
    """Processor that the loop stays on; without it the kernel chooses."""
    record: Annotated[Path | None, tyro.conf.arg(metavar="PATH.mcap")] = None
    """Record every tick as MCAP, about 2 GB an hour; what a slow or full disk does not take is dropped and counted."""
    min_free_bytes: Annotated[int, tyro.conf.arg(metavar="N")] = 1_000_000_000
    """End the recording, and nothing else, when fewer bytes than this are free on its disk."""

    def live(self) -> dict[str, Any]:
        """As arguments of `LiveMaster` and `LiveSlave`.

        Raises:
            ValueError: A number out of its bounds.
        """
        from haptether.cli.shared.output import check_target

        check_target(self.record)
        if str(self.record) == "-":
            message = "record = -: must be a file"
            raise ValueError(message)
        for name, value, least, most in (
            ("priority", self.priority, 1, 99),
            ("cpu", self.cpu, 0, 1023),
            ("min-free-bytes", self.min_free_bytes, 0, 2**63),
        ):
            if value is not None and not least <= value <= most:
                message = f"{name} = {value}: must be {least} to {most}"
                raise ValueError(message)
        return {
            "realtime": self.realtime,
            "priority": self.priority,
            "cpu": self.cpu,
            "record": self.record,
            "min_free_bytes": self.min_free_bytes,
        }
