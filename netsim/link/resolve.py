"""Resolution of link settings for the Rust side: preset, files and defaults filled in, ranges checked."""

import difflib
from pathlib import Path
from typing import Any, TypeVar

import msgspec
from msgspec.structs import replace

from haptether import _core
from haptether.input_file import read_bytes
from haptether.netsim.link.errors import LinkError, of_rules, of_types, refuse_infinite, wrong
from haptether.netsim.link.settings import (
    DISTRIBUTIONS,
    LINK_DEFAULTS,
    DelayTrace,
    Direction,
    DistributionTable,
    LinkSettings,
    Opportunities,
)
from haptether.netsim.presets import PRESETS

_Setting = TypeVar("_Setting")

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
"""Preset settings that an alternative setting replaces."""


def link_spec(settings: LinkSettings, direction: Direction) -> dict[str, Any]:
    """Return exactly the fields of Rust's `LinkSettings`, with preset and defaults filled in; files must be read.

    Raises:
        LinkError: A number is out of range, or settings contradict each other.
    """
    settings = with_preset(_checked(settings), direction)
    spec = {
        name: LINK_DEFAULTS.get(name) if (value := getattr(settings, name)) is None else value
        for name in settings.__struct_fields__
        if name != "preset"
    }
    distribution = spec["distribution"]
    if isinstance(distribution, str) and distribution not in DISTRIBUTIONS:
        raise wrong("distribution", distribution, f"one of {', '.join(DISTRIBUTIONS)}, or a .dist file that was read")
    spec = {name: _spelled_out(value, name) for name, value in spec.items()}
    try:
        _core.check_link(_json(spec))
    except ValueError as error:
        raise of_rules(error) from None
    return spec


def link_json(settings: LinkSettings, direction: Direction) -> str:
    """Return `link_spec` as JSON; files named by the settings are read from the working folder.

    Raises:
        LinkError: Same as for `link_spec`, or a file cannot be read; gives the line.
    """
    return _json(link_spec(with_files(settings, Path(), direction), direction))


def with_files(settings: LinkSettings, folder: Path, direction: Direction) -> LinkSettings:
    """Return the settings with the contents of their files.

    Args:
        settings: Settings of the link.
        folder: Folder of relative paths.
        direction: Direction of the delays in a recording of both directions.

    Raises:
        LinkError: A file cannot be read (gives line and column), or both a file and numbers are given.
    """
    trace, opportunities, distribution = settings.trace, settings.opportunities, settings.distribution
    if trace is not None and trace.file is not None:
        if trace.time_s is not None or trace.delay_s is not None:
            raise LinkError("trace.file", ": either file, or time_s and delay_s")
        form = trace.format or ("irtt" if trace.file.endswith(".json") else "csv")
        read = _read("trace.file", folder / trace.file, form, trace.direction or direction, DelayTrace)
        trace = replace(read, interpolate=trace.interpolate, repeat=trace.repeat)
    if opportunities is not None and opportunities.file is not None:
        if opportunities.time_ms is not None:
            raise LinkError("opportunities.file", ": either file, or time_ms")
        file = folder / opportunities.file
        opportunities = _read("opportunities.file", file, "mahimahi", direction, Opportunities)
    if isinstance(distribution, str) and distribution not in DISTRIBUTIONS:
        if not distribution.endswith(".dist"):
            raise wrong("distribution", distribution, f"one of {', '.join(DISTRIBUTIONS)}, or a .dist file")
        distribution = _read("distribution", folder / distribution, "dist", direction, DistributionTable)
    return replace(settings, trace=trace, opportunities=opportunities, distribution=distribution)


def _read(key: str, file: Path, form: str, direction: Direction, setting: type[_Setting]) -> _Setting:
    try:
        return msgspec.json.decode(_core.read_link_file(form, read_bytes(file), direction), type=setting)
    except OSError as error:
        raise LinkError(key, f": {file}: cannot be read: {error.strerror}") from None
    except ValueError as error:
        raise LinkError(key, f": {file}: {error}") from None


def _checked(settings: LinkSettings) -> LinkSettings:
    """Check the settings for types and ranges, because a struct built in Python is unchecked.

    Raises:
        LinkError: Names the first invalid setting.
    """
    raw = msgspec.to_builtins(settings, enc_hook=_of_numpy)
    refuse_infinite(raw)
    try:
        return msgspec.convert(raw, LinkSettings)
    except msgspec.ValidationError as error:
        raise of_types(error, raw, LinkSettings) from None


def _of_numpy(value: object) -> object:
    """Convert NumPy numbers to Python numbers."""
    return value.item() if hasattr(value, "item") else value


def with_preset(settings: LinkSettings, direction: Direction) -> LinkSettings:
    """Merge the preset into the settings; given settings override it.

    Raises:
        LinkError: The preset does not exist.
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


def _spelled_out(value: object, key: str) -> Any:  # noqa: ANN401  # as different as the settings are
    """Convert a value with all its fields, including defaults."""
    if isinstance(value, tuple):
        return [_spelled_out(item, f"{key}.{index}") for index, item in enumerate(value)]
    if not isinstance(value, msgspec.Struct):
        return value
    hidden: tuple[str, ...] = ()
    if isinstance(value, Opportunities):
        hidden = ("file",)
        _embedded(key, value.file, {"time_ms": value.time_ms})
    if isinstance(value, DelayTrace):
        hidden = ("file", "format", "direction", "half_round_trips")
        _embedded(key, value.file, {"time_s": value.time_s, "delay_s": value.delay_s})
    config = value.__struct_config__
    tag = {} if config.tag_field is None else {config.tag_field: config.tag}
    fields = {
        name: _spelled_out(getattr(value, name), f"{key}.{name}")
        for name in value.__struct_fields__
        if name not in hidden
    }
    return {**tag, **fields}


def _embedded(key: str, file: str | None, series: dict[str, tuple[Any, ...] | None]) -> None:
    """Refuse a recording with both a file and numbers, or neither."""
    names = " and ".join(series)
    if file is not None:
        raise LinkError(f"{key}.file", f": either file, or {names}")
    if any(values is None for values in series.values()):
        raise LinkError(key, f": needs file, or {names}")


def _json(spec: dict[str, Any]) -> str:
    return msgspec.json.encode(spec).decode()
