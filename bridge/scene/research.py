"""Controllers in Python: found by their name, made for each run, timed."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeAlias

from msgspec import json

from haptether.bridge.devices.find import RESEARCH_CONTROLLERS, device_names, load_controller
from haptether.bridge.scene.errors import SceneError
from haptether.bridge.scene.tables.session import Scene
from haptether.safety import CONTROLLERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.safety import ResearchController

MakeController: TypeAlias = "Callable[..., ResearchController]"
_REGISTERED: dict[str, MakeController] = {}


def register_controller(name: str, make: MakeController) -> None:
    """Names a controller for the scenes of this process; one that was named so before is replaced.

    A package names its own by an entry point of the group `haptether.controllers`.

    Args:
        name: Of `[safety.research] controller`.
        make: Called once a run with the options as keywords, and with `axes` and `period_s` where it has these.

    Raises:
        ValueError: A name of one that is built in, or nothing that can be called.
    """
    built_in = [known for known, _, _ in CONTROLLERS]
    if name in {*built_in, "none", ""} or any(mark in name for mark in "+,[]\"' "):
        message = f"name = {name!r}: must be none of {', '.join(built_in)}, none, and have no blank, comma, quote or +"
        raise ValueError(message)
    if not callable(make):
        message = f"make = {make!r}: must be a class or a function"
        raise ValueError(message)
    _REGISTERED[name] = make


def controller_names() -> tuple[str, ...]:
    """Names of the controllers in Python that there are: of installed packages, and registered in this process."""
    return tuple(sorted({*_REGISTERED, *device_names(RESEARCH_CONTROLLERS)}))


@dataclass
class ControllerTime:
    """What the controllers in Python of this process have taken."""

    ticks: int = 0
    """Ticks of all runs that ended well."""
    seconds: float = 0.0
    """Time in s inside them, with the way there and back."""


_TAKEN = ControllerTime()


def controller_time() -> ControllerTime:
    """What the controllers in Python of this process have taken until now."""
    return replace(_TAKEN)


class Research:
    """Makes the controller of each run."""

    def make(self, name: str, options: str, axes: int, period_s: float) -> "ResearchController":
        """A controller that has seen nothing; `options` is a JSON object.

        Raises:
            ValueError: There is none of this name, it cannot be loaded, or not with these options.
        """
        offered = {"axes": axes, "period_s": period_s}
        return load_controller(name, json.decode(options), offered=offered, registered=_REGISTERED)

    def spent(self, ticks: int, seconds: float) -> None:
        """Counts what the controllers of a run or a sweep took."""
        _TAKEN.ticks += ticks
        _TAKEN.seconds += seconds


def research_of(scene: Scene) -> Research | None:
    """Who makes the controller that a scene asks for, if it asks for one.

    Raises:
        SceneError: There is none of that name, or not with these options.
    """
    table = scene.safety.research
    if table is None:
        return None
    research = Research()
    try:
        research.make(table.controller, json.encode(table.options).decode(), scene.master.axes, scene.run.period_s)
    except ValueError as error:
        raise SceneError(str(error)) from error
    return research
