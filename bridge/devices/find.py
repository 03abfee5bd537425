"""Discovery of Python device drivers and controllers by package entry points."""

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
"""Group of the entry points of haptic devices."""
SLAVES = "haptether.slaves"
"""Group of the entry points of arms."""
GRIPPERS = "haptether.grippers"
"""Group of the entry points of grippers."""
RESEARCH_CONTROLLERS = "haptether.controllers"
"""Group of the entry points of controllers in Python."""
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
"""Scene key that names a driver of each group."""
_METHODS = {
    MASTERS: ("open", "read", "write", "close"),
    SLAVES: ("open", "read", "write", "stop", "close"),
    GRIPPERS: ("open", "read", "write", "hold", "close"),
    RESEARCH_CONTROLLERS: ("step",),
}
_PACED = {MASTERS, SLAVES}
"""Groups whose drivers declare whether they pace the loop."""


def device_names(group: str) -> tuple[str, ...]:
    """Return the names that installed packages declare in a group."""
    return tuple(sorted(entry_points(group=group).names))


def load_problems(group: str) -> dict[str, str]:
    """Return, by name, why installed drivers of a group cannot be loaded; loadable drivers are omitted.

    The packages are imported; nothing is called.
    """
    problems = {}
    for name in device_names(group):
        try:
            _maker(group, name)
        except ValueError as error:
            problems[name] = str(error).partition(f" = {name}: ")[2]
    return problems


def load_master(name: str, options: Mapping[str, Any]) -> "MasterDevice":
    """Create the driver of a haptic device with `options` as keyword arguments.

    Raises:
        ValueError: The driver does not exist, rejects an option, or is not a driver.
    """
    device: MasterDevice = _load(MASTERS, name, options)
    return device


def load_slave(name: str, options: Mapping[str, Any]) -> "SlaveDevice":
    """Create the driver of an arm with `options` as keyword arguments.

    Raises:
        ValueError: The driver does not exist, rejects an option, or is not a driver.
    """
    device: SlaveDevice = _load(SLAVES, name, options)
    return device


def load_gripper(name: str, options: Mapping[str, Any]) -> "Gripper":
    """Create the driver of a gripper with `options` as keyword arguments.

    Raises:
        ValueError: The driver does not exist, rejects an option, or is not a driver.
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
    """Create a Python controller with `options`, and with those of `offered` that it accepts, as keyword arguments.

    A controller registered in this process takes precedence over one of a package.

    Raises:
        ValueError: The controller does not exist, rejects an option, or is not a controller.
    """
    controller: ResearchController = _load(RESEARCH_CONTROLLERS, name, options, offered, registered)
    return controller


def load_maker(group: str, name: str) -> Callable[..., Any]:
    """Return the object that an entry point names, without calling it.

    Raises:
        ValueError: It does not exist or cannot be loaded.
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
        # Extension types may have no signature; the call itself then checks the arguments.
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
        # Invalid options; the driver's own text says why.
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
    """Return the entry point of a driver and its factory.

    Raises:
        ValueError: It does not exist or cannot be loaded.
    """
    named = _KEYS[group]
    found = entry_points(group=group, name=name)
    if not found:
        # The modelled arm has a name; the modelled haptic device is selected by omitting the driver.
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
        # The import runs code of another package, which may raise any exception.
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
