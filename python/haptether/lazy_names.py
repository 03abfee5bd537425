"""Public names of a package that are loaded when they are asked for (PEP 562)."""

import sys
from collections.abc import Callable, Mapping
from importlib import import_module


def lazy_names(
    package: str, modules: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], object], Callable[[], list[str]]]:
    """The `__getattr__` and `__dir__` of `package`, by its modules and the names that each of them gives."""
    module_of = {name: module for module, names in modules.items() for name in names}

    def load(name: str) -> object:
        if (module := module_of.get(name)) is None:
            message = f"module {package!r} has no attribute {name!r}"
            raise AttributeError(message)
        try:
            found = import_module(f"{package}.{module}")
        except AttributeError as error:
            # Whoever imports the name would be told that it is not there, and not why.
            message = f"{package}.{module} cannot be loaded: {error}"
            raise ImportError(message) from error
        value = getattr(found, name)
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*vars(sys.modules[package]), *module_of})

    return load, names
