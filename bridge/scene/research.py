"""Python controllers: lookup by name, creation per run, and timing."""

import hashlib
import inspect
import re
import secrets
import threading
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias

from msgspec import json

from haptether.bridge.devices.find import RESEARCH_CONTROLLERS, device_names, load_controller, load_maker
from haptether.bridge.devices.open import DeviceError
from haptether.bridge.scene.errors import Raw, SceneError
from haptether.bridge.scene.tables.session import Scene
from haptether.safety import CONTROLLERS

if TYPE_CHECKING:
    from collections.abc import Callable

    from haptether.safety import ResearchController

MakeController: TypeAlias = "Callable[..., ResearchController]"
_REGISTERED: dict[str, MakeController] = {}
_NAME = re.compile(r"[A-Za-z0-9_][A-Za-z0-9_.-]*")
_BUILT_IN = ("none", *(name for name, _, _ in CONTROLLERS))


def register_controller(name: str, make: MakeController) -> None:
    """Register a controller by name for the scenes of this process; it replaces an earlier one of the same name.

    Packages use an entry point of the group `haptether.controllers` instead.

    Args:
        name: Name for `[safety.research] controller`.
        make: Factory, called once per run with the options as keywords, and with `axes` and `period_s` if it accepts
            them.

    Raises:
        ValueError: The name belongs to a built-in controller, or `make` is not callable.
    """
    _check_name(name)
    if not callable(make):
        message = f"make = {make!r}: must be a class or a function"
        raise ValueError(message)
    _REGISTERED[name] = make


def controller_names() -> tuple[str, ...]:
    """Return the names of available Python controllers: from installed packages and registered in this process."""
    names = {*_REGISTERED, *device_names(RESEARCH_CONTROLLERS)}
    return tuple(sorted(name for name in names if _NAME.fullmatch(name) and name not in _BUILT_IN))


def with_own_controllers(raw: Raw) -> Raw:
    """Move a Python controller named in `safety.controllers` to `safety.research`.

    `safety.research.controller = "none"` means no such table, so that a sweep may vary it.

    Raises:
        SceneError: The scene names two Python controllers, or another one than `safety.research`.
    """
    safety = raw.get("safety") if isinstance(raw, dict) else None
    if not isinstance(raw, dict) or not isinstance(safety, dict):
        return raw
    research, named = safety.get("research"), safety.get("controllers")
    if isinstance(research, dict) and research.get("controller") == "none":
        safety = {**safety, "research": None}
        research = None
    unknown = [name for name in named if name not in _BUILT_IN] if isinstance(named, list | tuple) else []
    own = [name for name in unknown if name in controller_names()] if unknown else []
    if own and isinstance(named, list | tuple):
        of_table = [research["controller"]] if isinstance(research, dict) and "controller" in research else []
        if len(both := list(dict.fromkeys([*own, *of_table]))) > 1:
            message = f"[safety] controllers: {' and '.join(map(str, both))}: at most one in Python"
            raise SceneError(message)
        table = {**(research if isinstance(research, dict) else {}), "controller": own[0]}
        safety = {**safety, "controllers": [name for name in named if name != own[0]], "research": table}
    return {**raw, "safety": safety}


def _check_name(name: str) -> None:
    """Refuse a name that has another meaning where controllers are named.

    Raises:
        ValueError: Gives the allowed names.
    """
    if not isinstance(name, str) or not _NAME.fullmatch(name) or name in _BUILT_IN:
        message = f"name = {name!r}: must be none of {', '.join(_BUILT_IN)}, and of letters, digits, _, - and ."
        raise ValueError(message)


@dataclass
class ControllerTime:
    """Time used by the Python controllers of this process."""

    ticks: int = 0
    """Ticks of all runs that ended normally."""
    seconds: float = 0.0
    """Time in s in the controllers, including call overhead."""


_TAKEN = ControllerTime()
_COUNTING = threading.Lock()


class _OfThread(threading.local):
    """Time used in the runs and sweeps that a thread started."""

    ticks = 0
    seconds = 0.0


_TAKEN_BY_THREAD = _OfThread()


def controller_time() -> ControllerTime:
    """Return the time used by the Python controllers of this process so far."""
    return replace(_TAKEN)


def count_controller_time(ticks: int, seconds: float) -> None:
    """Add time used by Python controllers, here or in a worker of this process."""
    with _COUNTING:
        _TAKEN.ticks += ticks
        _TAKEN.seconds += seconds
    _TAKEN_BY_THREAD.ticks += ticks
    _TAKEN_BY_THREAD.seconds += seconds


def thread_controller_time() -> ControllerTime:
    """Return the time used by Python controllers in runs and sweeps that this thread started."""
    return ControllerTime(_TAKEN_BY_THREAD.ticks, _TAKEN_BY_THREAD.seconds)


class Research:
    """Factory of the controller for each run."""

    def make(self, name: str, options: str, axes: int, period_s: float) -> "ResearchController":
        """Create a new controller; `options` is a JSON object.

        Raises:
            ValueError: No controller has this name, it cannot be loaded, or it rejects the options.
        """
        _check_name(name)
        offered = {"axes": axes, "period_s": period_s}
        return load_controller(name, json.decode(options), offered=offered, registered=_REGISTERED)

    def spent(self, ticks: int, seconds: float) -> None:
        """Add the time used by the controllers of a run or a sweep."""
        count_controller_time(ticks, seconds)


def research_of(scene: Scene) -> Research | None:
    """Return the factory of the scene's Python controller, or None.

    Raises:
        SceneError: No controller has this name, or it rejects the options.
    """
    table = scene.safety.research
    if table is None:
        return None
    research = Research()
    try:
        research.make(table.controller, json.encode(table.options).decode(), scene.master.axes, scene.run.period_s)
    except DeviceError as error:
        message = f"[safety.research] controller = {table.controller}: {error}"
        raise SceneError(message) from error
    except ValueError as error:
        raise SceneError(str(error)) from error
    return research


def maker_of(name: str) -> MakeController:
    """Return the registered or installed controller of this name, without calling it.

    Raises:
        ValueError: It does not exist or cannot be loaded.
    """
    return _REGISTERED.get(name) or load_maker(RESEARCH_CONTROLLERS, name)


def source_of(name: str) -> str:
    """Return a digest of the controller's file; a unique value for each call if the file is unknown."""
    make = maker_of(name)
    try:
        file = inspect.getsourcefile(make)
        content = b"" if file is None else Path(file).read_bytes()
    except (TypeError, OSError):
        content = b""
    digest = hashlib.sha256(content).hexdigest() if content else secrets.token_hex()
    return f"{getattr(make, '__module__', '')}:{getattr(make, '__qualname__', '')} {digest}"
