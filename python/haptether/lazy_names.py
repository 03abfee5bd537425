"""Public names of a package that load on first use (PEP 562)."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def lazy_names(
    package: str, modules: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """Return `__getattr__` and `__dir__` of `package`, for the names of each of its modules."""
    module_of = {name: module for module, names in modules.items() for name in names}

    def load(name: str) -> object:
        if (module := module_of.get(name)) is None:
            message = f"module {package!r} has no attribute {name!r}"
            raise AttributeError(message)
        try:
            found = import_module(f"{package}.{module}")
        except AttributeError as error:
            # An AttributeError would say that the name is missing, but not why.
            message = f"{package}.{module} cannot be loaded: {error}"
            raise ImportError(message) from error
        value = getattr(found, name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of})

    return load, names
