"""Commands by name: only the requested one is imported."""

from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from typing import Any, Protocol, Self


class Command(Protocol):
    """Interface of a command."""

    def run(self) -> int:
        """Run the command and return the exit status."""


class CommandTable(Mapping[str, type[Any]]):
    """Classes of commands by name, each imported when it is looked up.

    Args:
        places: Module within `haptether.cli` and class, as `live.master:Master`, by name.
    """

    def __init__(self, places: Mapping[str, str]) -> None:
        self._places = places

    @classmethod
    def joined(cls, tables: "Iterable[CommandTable]") -> Self:
        """Return the commands of all tables, in their order."""
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
