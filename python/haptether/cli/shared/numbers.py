"""How a word of the command line becomes the value of an option; one that may be left out takes the same words."""

import types
from collections.abc import Callable
from pathlib import Path
from typing import Any, Union, get_args

from tyro.constructors import ConstructorRegistry, PrimitiveConstructorSpec, PrimitiveTypeInfo


def _float(word: str) -> float:
    try:
        return float(word)
    except ValueError:
        message = f"{word!r}: must be a number"
        raise ValueError(message) from None


def _int(word: str) -> int:
    try:
        return int(word)
    except ValueError:
        message = f"{word!r}: must be a whole number"
        raise ValueError(message) from None


KINDS: dict[type, Callable[[str], Any]] = {float: _float, int: _int, Path: Path, str: str}
NUMBERS = ConstructorRegistry()


@NUMBERS.primitive_rule
def _one_word(info: PrimitiveTypeInfo) -> PrimitiveConstructorSpec[Any] | None:
    kinds = [kind for kind in get_args(info.type) if kind is not type(None)]
    if info.type in {float, int}:
        kinds = [info.type]
    elif info.type_origin not in {Union, types.UnionType, tuple}:
        return None
    if info.type_origin is tuple and set(kinds) == {float}:
        count = len(kinds)
        return PrimitiveConstructorSpec(
            nargs=count,
            metavar=" ".join(["FLOAT"] * count),
            instance_from_str=lambda words: tuple(map(_float, words)),
            is_instance=lambda value: isinstance(value, tuple),
            str_from_instance=lambda values: list(map(str, values)),
        )
    if info.type_origin is tuple or len(kinds) != 1 or kinds[0] not in KINDS:
        return None
    (kind,) = kinds
    return PrimitiveConstructorSpec(
        nargs=1,
        metavar=kind.__name__.upper(),
        instance_from_str=lambda words: KINDS[kind](words[0]),
        is_instance=lambda value: value is None or isinstance(value, (kind, int) if kind is float else kind),
        str_from_instance=lambda value: [str(value)],
    )
