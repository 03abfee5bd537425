"""Numbers of the command line: conversion from text, and bounds that several commands share."""

import types
from pathlib import Path
from typing import Any, Union, get_args

from tyro.conf import UseAppendAction
from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo


def check_seed(seed: int) -> None:
    """Refuse a seed that is not an unsigned 64-bit number.

    Raises:
        ValueError: A seed out of its bounds; the message names them.
    """
    if not 0 <= seed < 2**64:
        message = f"seed = {seed}: must be between 0 and 2^64 - 1"
        raise ValueError(message)


def check_random_seed(seed: int) -> None:
    """Refuse an invalid seed of `numpy.random.default_rng`.

    Raises:
        ValueError: A seed below 0.
    """
    if seed < 0:
        message = f"seed = {seed}: must be 0 or more"
        raise ValueError(message)


def check_duration(key: str, seconds: float | None) -> None:
    """Refuse an invalid duration of a run.

    Raises:
        ValueError: A duration out of its bounds; the message names them.
    """
    if seconds is not None and not 0.0 <= seconds <= 1e9:
        message = f"{key} = {seconds}: must be between 0 and 1e9 s"
        raise ValueError(message)


# ------------------------------------------------------------------------------------------------- rules of the parser

EXPECTED: dict[type, str] = {float: "a number", int: "a whole number", Path: "a path", str: "text"}
"""Types of an option with one argument, and its description; an optional one takes the same."""
NUMBERS = ConstructorRegistry()


@NUMBERS.primitive_rule
def _one_argument(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    kinds = [kind for kind in get_args(info.type) if kind is not type(None)]
    if info.type in {float, int, Path}:
        kinds = [info.type]
    elif info.type_origin not in {Union, types.UnionType, tuple}:
        return None
    if info.type == tuple[Path, ...] and UseAppendAction not in info.markers:
        # The parser's own rule for lists does not say which argument is wrong, and why.
        return PrimitiveConstructorSpec(
            nargs="*",
            metavar="[PATH [PATH ...]]",
            instance_from_str=lambda texts: tuple(_value(Path, text) for text in texts),
            is_instance=lambda value: isinstance(value, tuple),
            str_from_instance=lambda values: list(map(str, values)),
        )
    if info.type_origin is tuple and set(kinds) == {float}:
        count = len(kinds)
        return PrimitiveConstructorSpec(
            nargs=count,
            metavar=" ".join(["FLOAT"] * count),
            instance_from_str=lambda texts: tuple(_value(float, text) for text in texts),
            is_instance=lambda value: isinstance(value, tuple),
            str_from_instance=lambda values: list(map(str, values)),
        )
    if info.type_origin is tuple or len(kinds) != 1 or kinds[0] not in EXPECTED:
        return None
    (kind,) = kinds
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=lambda texts: _value(kind, texts[0]),
        is_instance=lambda value: value is None or isinstance(value, (kind, int) if kind is float else kind),
        str_from_instance=lambda value: [str(value)],
    )


def _value(kind: type, text: str) -> Any:  # noqa: ANN401  # of that type
    try:
        if kind is Path and not text:
            raise ValueError
        return kind(text)
    except ValueError:
        message = f"{text!r}: must be {EXPECTED[kind]}"
        raise ValueError(message) from None
