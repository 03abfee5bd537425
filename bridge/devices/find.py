"""Drivers of devices and controllers in Python, found by the entry points that packages declare."""

import inspect
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from importlib.metadata import EntryPoint, entry_points
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

from haptether.bridge.devices.open import DeviceError, failure

if TYPE_CHECKING:
    from haptether.master import MasterDevice
    from haptether.safety import ResearchController
    from haptether.slave import Gripper, SlaveDevice

MASTERS = "haptether.masters"
SLAVES = "haptether.slaves"
GRIPPERS = "haptether.grippers"
RESEARCH_CONTROLLERS = "haptether.controllers"
OWN_CONTROLLERS = (
    f"a controller of your own has a name once a package with an entry point of the group {RESEARCH_CONTROLLERS} is"
    " installed, or after register_controller in Python: docs/own_controller.md"
)
"""How a controller in Python gets a name, where one is not known."""
_KEYS = {
    MASTERS: "[master] driver",
    SLAVES: "[slave] device",
    GRIPPERS: "[slave.gripper] device",
    RESEARCH_CONTROLLERS: "[safety.research] controller",
}
"""What names it in a scene."""
_METHODS = {
    MASTERS: ("open", "read", "write", "close"),
    SLAVES: ("open", "read", "write", "stop", "close"),
    GRIPPERS: ("open", "read", "write", "hold", "close"),
    RESEARCH_CONTROLLERS: ("step",),
}
_PACED = {MASTERS, SLAVES}
"""What may have a pace of its own, and says whether."""


def device_names(group: str) -> tuple[str, ...]:
    """Names that installed packages have in a group."""
    return tuple(sorted(entry_points(group=group).names))


def load_problems(group: str) -> dict[str, str]:
    """Why drivers of a group that are installed cannot be loaded, by name; of those that can there is nothing.

    Their packages are imported, and nothing is called.
    """
    problems = {}
    for name in device_names(group):
        try:
            _maker(group, name)
        except ValueError as error:
            problems[name] = str(error).partition(f" = {name}: ")[2]
    return problems


def load_master(name: str, options: Mapping[str, Any]) -> "MasterDevice":
    """The driver of a haptic device, called with `options` as keywords.

    Raises:
        ValueError: No such driver, options that it does not have, or something that is none.
    """
    device: MasterDevice = _load(MASTERS, name, options)
    return device


def load_slave(name: str, options: Mapping[str, Any]) -> "SlaveDevice":
    """The driver of an arm, called with `options` as keywords.

    Raises:
        ValueError: No such driver, options that it does not have, or something that is none.
    """
    device: SlaveDevice = _load(SLAVES, name, options)
    return device


def load_gripper(name: str, options: Mapping[str, Any]) -> "Gripper":
    """The driver of a gripper, called with `options` as keywords.

    Raises:
        ValueError: No such driver, options that it does not have, or something that is none.
    """
    gripper: Gripper = _load(GRIPPERS, name, options)
    return gripper


def load_controller(
    name: str,
    options: Mapping[str, Any],
    *,
    offered: Mapping[str, Any],
    registered: Mapping[str, Callable[..., Any]],
) -> "ResearchController":
    """A controller in Python, called with `options` as keywords, and with those of `offered` that it takes.

    One that was registered in this process goes before one of a package.

    Raises:
        ValueError: No such controller, options that it does not have, or something that is none.
    """
    controller: ResearchController = _load(RESEARCH_CONTROLLERS, name, options, offered, registered)
    return controller


def load_maker(group: str, name: str) -> Callable[..., Any]:
    """What an entry point of a group names, which nobody has called.

    Raises:
        ValueError: There is none, or none that can be loaded.
    """
    return _maker(group, name)[1]


def _load(
    group: str,
    name: str,
    options: Mapping[str, Any],
    offered: Mapping[str, Any] = MappingProxyType({}),
    registered: Mapping[str, Callable[..., Any]] = MappingProxyType({}),
) -> Any:  # noqa: ANN401  # of that group
    named = _KEYS[group]
    if name in registered:
        make = registered[name]
        origin = getattr(make, "__qualname__", repr(make))
    else:
        point, make = _maker(group, name, registered)
        origin = point.value
    try:
        signature = inspect.signature(make)
    except ValueError:
        # What C has made may say nothing of its arguments: the call itself will.
        signature = inspect.Signature([inspect.Parameter("options", inspect.Parameter.VAR_KEYWORD)])
    takes_any = any(one.kind is one.VAR_KEYWORD for one in signature.parameters.values())
    options = {**{key: offered[key] for key in offered if takes_any or key in signature.parameters}, **options}
    try:
        signature.bind(**options)
    except TypeError as error:
        message = f"{named} = {name}: options {dict(options)}: {error}: it takes {signature}"
        raise ValueError(message) from None
    try:
        device = make(**options)
    except (ValueError, DeviceError):
        # Of options that cannot be, in the driver's own words.
        raise
    except (Exception, SystemExit) as error:
        raise failure(make, error) from error
    missing = [method for method in _METHODS[group] if not callable(getattr(device, method, None))]
    if group in _PACED and not isinstance(getattr(device, "paces", None), bool):
        missing.append("paces")
    if missing:
        message = f"{named} = {name}: {origin} has no {', '.join(missing)}"
        raise ValueError(message)
    return device


def _maker(group: str, name: str, others: Iterable[str] = ()) -> tuple[EntryPoint, Callable[..., Any]]:
    """The entry point of a driver, and what makes it.

    Raises:
        ValueError: There is none, or none that can be loaded.
    """
    named = _KEYS[group]
    found = entry_points(group=group, name=name)
    if not found:
        # A model of an arm has a name; that of a haptic device is what a scene without a driver has.
        names = (*(("simulated",) if group == SLAVES else ()), *device_names(group), *others)
        near = get_close_matches(name, names, 1)
        there = f"there is {', '.join(names)}" if names else "none is installed"
        if group == MASTERS:
            there += "; without the key it is a model"
        hint = f"did you mean {near[0]}? {there}" if near else there
        if group == RESEARCH_CONTROLLERS:
            hint += f"; {OWN_CONTROLLERS}"
        message = f"{named} = {name}: no such {_what(group)} ({group}): {hint}"
        raise ValueError(message)
    if len({point.value for point in found}) > 1:
        message = f"{named} = {name}: several packages have it: {', '.join(sorted(map(_origin, found)))}"
        raise ValueError(message)
    (point,) = tuple(found)[:1]
    try:
        make = point.load()
    except (Exception, SystemExit) as error:
        # Another package's own code runs here, and whatever it raises is why there is no such driver.
        why = str(error) if isinstance(error, ImportError | AttributeError) else f"{type(error).__name__}: {error}"
        message = f"{named} = {name}: {point.value} of {_origin(point)} cannot be loaded: {why}"
        raise ValueError(message) from error
    if not callable(make):
        message = (
            f"{named} = {name}: {point.value} of {_origin(point)} is no {_what(group)}: must be a class or a function"
        )
        raise ValueError(message)
    return point, make


def _what(group: str) -> str:
    return "controller" if group == RESEARCH_CONTROLLERS else "driver"


def _origin(point: EntryPoint) -> str:
    return point.dist.name if point.dist is not None else point.value
