"""Commands by their names: the one that is asked for is imported, and no other."""

from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any, Protocol, Self


class Command(Protocol):
    """What one command is."""

    def run(self) -> int:
        """Does it and returns the exit status."""


class CommandTable(Mapping[str, type[Any]]):
    """Classes by the names of their commands, each imported when it is looked up.

    Args:
        places: Module within `haptether.cli` and class, as `live.master:Master`, by name.
    """

    def __init__(self, places: Mapping[str, str]) -> None:
        self._places = places

    @classmethod
    def joined(cls, tables: "Iterable[CommandTable]") -> Self:
        """The commands of all tables, in their order."""
        return cls({name: place for table in tables for name, place in table._places.items()})

    def __getitem__(self, name: str) -> type[Any]:
        module, _, of = self._places[name].partition(":")
        found: type[Any] = getattr(import_module(f"haptether.cli.{module}"), of)
        return found

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)
