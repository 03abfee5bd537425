"""What an option of a driver may be, as text, from the annotation of its field."""

from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

from msgspec import Meta, Struct


def allowed(options: type[Struct], key: str) -> str:
    """What may stand at a key of the options, such as `0 to 50 kg`.

    The unit is that of the annotation, `Meta(extra={"unit": "kg"})`.
    """
    return _text(get_type_hints(options, include_extras=True)[key], Meta())


def _text(kind: Any, meta: Meta) -> str:  # noqa: ANN401  # a type as typing writes it
    origin, parts = get_origin(kind), get_args(kind)
    unit = f" {meta.extra['unit']}" if meta.extra else ""
    if origin is Annotated:
        text = _text(parts[0], parts[1])
    elif origin in {UnionType, Union}:
        # A scene cannot write the none that stands for a default.
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
