"""Options of a driver: conversion from a scene, and the allowed values as text from annotations."""

import ipaddress
import math
import socket
from collections.abc import Iterator, Mapping
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta, Struct

Options = TypeVar("Options", bound=Struct)
NO_PEER = ipaddress.IPv4Network("0.0.0.0/8")
"""Addresses of this host on this network (RFC 1122, 3.2.1.3)."""


def converted(kind: type[Options], given: Mapping[str, Any], device: str, required: Mapping[str, str]) -> Options:
    """Convert the options of a scene; numbers may be given as text.

    Args:
        kind: Type of the options.
        given: Options in the scene.
        device: Scene text that names the driver, such as `device = ur`.
        required: Required keys with their allowed values.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    known = kind.__struct_fields__
    for key in given:
        if key not in known:
            raise refused(device, key, given[key], f"is no option: must be one of {', '.join(known)}")
    for key, what in required.items():
        if key not in given:
            message = f"{device}: options: {key} is missing: must be {what}"
            raise ValueError(message)
    for key, value in given.items():
        if not all(map(math.isfinite, _numbers(value))):
            raise refused(device, key, value, "must be finite")
    try:
        return msgspec.convert(dict(given), kind, strict=False)
    except msgspec.ValidationError as error:
        _, _, place = str(error).partition(" - at `$.")
        key = place.split("[")[0].split(".")[0].rstrip("`")
        raise refused(device, key, given.get(key), f"must be {allowed(kind, key)}") from None


def refused(device: str, key: str, value: object, why: str) -> ValueError:
    """Return the error of an option: driver, key, given value, allowed values."""
    return ValueError(f"{device}: {key} = {value!r}: {why}")


def check_host(device: str, host: str) -> None:
    """Check the option `host`, the address of a peer.

    Raises:
        ValueError: Empty, with a port, or an address that no peer has, such as 0.0.0.0.
    """
    if not host or any(sign.isspace() or sign in ":/[]" for sign in host):
        raise refused(device, "host", host, "must be an IPv4 address or a name, without a port")
    try:
        # Short forms are addresses, too: 0 is 0.0.0.0.
        address = ipaddress.IPv4Address(socket.inet_aton(host))
    except OSError:
        return
    if address in NO_PEER or address.is_multicast or address.is_reserved:
        raise refused(device, "host", host, "is the address of no peer: must be that of the device")


def allowed(options: type[Struct], key: str) -> str:
    """Describe the allowed values of an option, such as `0 to 50 kg`.

    The unit comes from the annotation, `Meta(extra={"unit": "kg"})`.
    """
    return _text(get_type_hints(options, include_extras=True)[key], Meta())


def _text(kind: Any, meta: Meta) -> str:  # noqa: ANN401  # a type as typing writes it
    origin, parts = get_origin(kind), get_args(kind)
    unit = f" {meta.extra['unit']}" if meta.extra else ""
    if origin is Annotated:
        text = _text(parts[0], parts[1])
    elif origin in {UnionType, Union}:
        # A scene cannot express the None of a default.
        text = " or ".join(_text(part, meta) for part in parts if part is not NoneType)
    elif origin is Literal:
        text = f"one of {', '.join(parts)}" if isinstance(parts[0], str) else " or ".join(map(str, parts)) + unit
    elif origin is tuple and parts[-1] is Ellipsis:
        text = f"a list of {_text(parts[0], meta)} each"
    elif origin is tuple:
        text = f"{len(parts)} numbers"
    else:
        text = {bool: "true or false", str: "a string"}.get(kind) or f"{_range(meta)}{unit}"
    return text


def _range(meta: Meta) -> str:
    if meta.ge is not None and meta.le is not None:
        return f"{meta.ge:g} to {meta.le:g}"
    limits = (("above", meta.gt), ("at least", meta.ge), ("below", meta.lt), ("at most", meta.le))
    return " and ".join(f"{word} {limit:g}" for word, limit in limits if limit is not None) or "a number"


def _numbers(value: object) -> Iterator[float]:
    if isinstance(value, float | int):
        try:
            yield float(value)
        except OverflowError:
            yield math.inf
    elif isinstance(value, list | tuple):
        for part in value:
            yield from _numbers(part)
    elif isinstance(value, str) and value.strip().lstrip("+-").lower() in {"nan", "inf", "infinity"}:
        yield math.nan
