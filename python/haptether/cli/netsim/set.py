"""`haptether netsim set`."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro

from haptether.cli.shared.assignments import refuse_twice
from haptether.cli.shared.output import FileOptions


@dataclass(frozen=True, kw_only=True)
class Set(FileOptions):
    """Change the link of a proxy that runs with --control, from its next packets on, and print the previous settings.

    KEY=VALUE changes a setting in both directions, forward.KEY=VALUE and backward.KEY=VALUE in one. Values are TOML,
    bare words are strings; KEY= restores the default. If one setting is invalid, nothing changes.

    Examples:

    haptether netsim set --control ./netsim.sock delay_s=0.1 backward.loss=0.02

    haptether netsim set --control 127.0.0.1:9100 mean_burst= loss=0 --show
    """

    settings: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="KEY=VALUE")] = ()
    """Settings to change."""
    control: Annotated[str, tyro.conf.arg(metavar="PATH|127.0.0.1:PORT")]
    """Control socket of the proxy: the value of its --control."""
    show: bool = False
    """Print the link afterwards, and what the proxy has done so far."""
    json: Annotated[Path | None, tyro.conf.arg(metavar="PATH")] = None
    """Write settings and statistics as JSON; - for standard output."""

    def run(self) -> int:
        """Send the request and print the answer."""
        from haptether.bridge.scene.unusual import unusual_values
        from haptether.cli.shared.output import check_target, write_report
        from haptether.cli.shared.screen import screen
        from haptether.netsim import ask_control

        check_target(self.json, force=self.force)
        request = requested(self.settings)
        show = self.show or self.json is not None
        if not request and not show:
            message = "nothing to change: give KEY=VALUE, or --show"
            raise ValueError(message)
        answer = ask_control(self.control, {**request, **({"show": True} if show else {})})
        if answer.pop("ok", None) is not True:
            message = f"the proxy changed nothing: {answer.get('error', 'it did not say why')}"
            raise ValueError(message)
        for line in unusual_values(request, "link"):
            screen(self.json).print(line, soft_wrap=True)
        self._print(answer)
        write_report(self.json, answer)
        return 0

    def _print(self, answer: dict[str, Any]) -> None:
        from haptether.cli.shared.screen import screen

        console = screen(self.json)
        for direction, changes in answer.get("changed", {}).items():
            for key, change in changes.items():
                console.print(f"{direction}.{key}: {_shown(change['old'])} -> {_shown(change['new'])}", soft_wrap=True)
        if not self.show:
            return
        for direction in ("forward", "backward"):
            settings = ", ".join(f"{key} = {value}" for key, value in answer[direction].items()) or "a perfect network"
            console.print(f"{direction}: {settings}", soft_wrap=True)
        for direction in ("forward", "backward"):
            counts = answer["statistics"][direction]
            text = ", ".join(f"{counts[name]} {name}" for name in ("received", "released", "lost"))
            console.print(f"so far {direction}: {text}", soft_wrap=True)


def _shown(value: object) -> str:
    return "not set" if value is None else str(value)


def requested(settings: tuple[str, ...]) -> dict[str, dict[str, Any]]:
    """Return the request of the assignments.

    Raises:
        ValueError: A setting is given twice.
        SceneError: No assignment, an unknown setting, or a value that is not TOML.
    """
    from haptether.bridge.scene.errors import SceneError
    from haptether.bridge.scene.load import path_of, toml_value

    request: dict[str, dict[str, Any]] = {}
    given: dict[str, str] = {}
    for setting in settings:
        name, equals, text = setting.partition("=")
        # A setting for both directions and then for one is permitted.
        refuse_twice(given, name, name.strip()[:80])
        first, dot, key = name.strip().partition(".")
        directions, key = (
            ((first,), key) if dot and first in {"forward", "backward"} else (("forward", "backward"), name)
        )
        key = key.strip().replace("-", "_")
        if not equals or not key or "." in key:
            message = f"{setting[:80]}: must be KEY=VALUE, forward.KEY=VALUE or backward.KEY=VALUE"
            raise SceneError(message)
        for direction in directions:
            path = path_of(f"link.{direction}.{key}")
            request.setdefault(direction, {})[key] = toml_value(text.strip(), path) if text.strip() else None
    return request
