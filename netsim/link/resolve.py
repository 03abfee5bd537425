"""A link as the Rust side takes it: preset and defaults filled in, every number held against its range."""

import difflib
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import replace

from haptether import _core
from haptether.netsim.link.errors import LinkError, of_rules, of_types, refuse_infinite, wrong
from haptether.netsim.link.files import with_files
from haptether.netsim.link.parts import DelayTrace, Opportunities
from haptether.netsim.link.settings import DISTRIBUTIONS, LINK_DEFAULTS, Direction, LinkSettings
from haptether.netsim.presets import PRESETS

_LOSSES = ("loss", "mean_burst", "mean_burst_s", "gilbert_elliott", "four_state")
_DELAYS = ("delay_s", "jitter_s", "distribution", "distribution_shape", "jitter_correlation_s", "timeline", "slots")
_INSTEAD = {
    "gilbert_elliott": _LOSSES,
    "four_state": _LOSSES,
    "mean_burst": ("mean_burst_s", "gilbert_elliott", "four_state"),
    "mean_burst_s": ("mean_burst", "gilbert_elliott", "four_state"),
    "loss": ("gilbert_elliott", "four_state"),
    "rate_bps": ("opportunities",),
    "opportunities": ("rate_bps",),
    "trace": (*_DELAYS, *_LOSSES, "outages"),
}
"""Settings of a preset that do not count once another way to say the same is given."""


def filled(settings: LinkSettings, direction: Direction) -> LinkSettings:
    """The settings with those of their preset, which what is given overrides.

    Raises:
        LinkError: No such preset.
    """
    if settings.preset is None:
        return settings
    if settings.preset not in PRESETS:
        near = difflib.get_close_matches(settings.preset, PRESETS, n=1, cutoff=0.5)
        allowed = f"one of {', '.join(PRESETS)}{f': did you mean {near[0]}?' if near else ''}"
        raise wrong("preset", settings.preset, allowed)
    given = {name: getattr(settings, name) for name in settings.__struct_fields__}
    given = {name: value for name, value in given.items() if value is not None}
    preset = PRESETS[settings.preset]
    base = preset.forward if direction == "forward" else preset.backward
    instead = {dropped for name in given for dropped in _INSTEAD.get(name, ())}
    if given.get("loss") == 0.0:
        instead |= {"mean_burst", "mean_burst_s"}
    if given.get("jitter_s") == 0.0:
        instead |= {"distribution", "distribution_shape", "jitter_correlation_s"}
    return replace(base, **(dict.fromkeys(instead) | given | {"preset": None}))


def link_spec(settings: LinkSettings, direction: Direction) -> dict[str, Any]:
    """Exactly the fields of `netsim/src/settings/`: preset and defaults filled in; files have been read.

    Raises:
        LinkError: A number out of its range, or settings that do not go together.
    """
    settings = filled(checked(settings), direction)
    spec = {
        name: LINK_DEFAULTS.get(name) if (value := getattr(settings, name)) is None else value
        for name in settings.__struct_fields__
        if name != "preset"
    }
    distribution = spec["distribution"]
    if isinstance(distribution, str) and distribution not in DISTRIBUTIONS:
        raise wrong("distribution", distribution, f"one of {', '.join(DISTRIBUTIONS)}, or a .dist file that was read")
    spec = {name: _plain(value, name) for name, value in spec.items()}
    try:
        _core.check_link(_json(spec))
    except ValueError as error:
        raise of_rules(error) from None
    return spec


def link_json(settings: LinkSettings, direction: Direction) -> str:
    """As `link_spec`, written; files that the settings name are read from the working folder.

    Raises:
        LinkError: As `link_spec`, or a file that cannot be read, with its line.
    """
    return _json(link_spec(with_files(settings, Path(), direction), direction))


def checked(settings: LinkSettings) -> LinkSettings:
    """The settings, held against their types and ranges: a struct that was built in Python was not yet.

    Raises:
        LinkError: The first that does not fit.
    """
    plain = msgspec.to_builtins(settings, enc_hook=_of_numpy)
    refuse_infinite(plain)
    try:
        return msgspec.convert(plain, LinkSettings)
    except msgspec.ValidationError as error:
        raise of_types(error, plain, LinkSettings) from None


def _of_numpy(value: object) -> object:
    """Numbers of NumPy as such of Python."""
    return value.item() if hasattr(value, "item") else value


def _json(spec: dict[str, Any]) -> str:
    return msgspec.json.encode(spec).decode()


def _plain(value: object, key: str) -> Any:  # noqa: ANN401  # as different as the settings are
    """A value with all its fields, also those that have their defaults."""
    if isinstance(value, tuple):
        return [_plain(item, f"{key}.{index}") for index, item in enumerate(value)]
    if not isinstance(value, msgspec.Struct):
        return value
    hidden: tuple[str, ...] = ()
    if isinstance(value, Opportunities):
        hidden = ("file",)
        _embedded(key, value.file, {"time_ms": value.time_ms})
    if isinstance(value, DelayTrace):
        hidden = ("file", "format", "direction")
        _embedded(key, value.file, {"time_s": value.time_s, "delay_s": value.delay_s})
    config = value.__struct_config__
    tag = {} if config.tag_field is None else {config.tag_field: config.tag}
    fields = {
        name: _plain(getattr(value, name), f"{key}.{name}") for name in value.__struct_fields__ if name not in hidden
    }
    return {**tag, **fields}


def _embedded(key: str, file: str | None, series: dict[str, tuple[Any, ...] | None]) -> None:
    """Refuses a recording that has a file and numbers, or neither."""
    names = " and ".join(series)
    if file is not None:
        raise LinkError(f"{key}.file", f": either file, or {names}")
    if any(values is None for values in series.values()):
        raise LinkError(key, f": needs file, or {names}")
