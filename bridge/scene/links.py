"""`[link.forward]`, `[link.backward]`: settings of `haptether.netsim`, in the words of a scene."""

from collections.abc import Callable
from pathlib import Path as FilePath
from typing import Any, Literal, TypeVar

from msgspec.structs import replace

from haptether.bridge.scene.errors import Path, SceneError, place
from haptether.bridge.scene.tables.session import LinksTable
from haptether.netsim import LinkError, LinkSettings, link_spec, with_files

_Made = TypeVar("_Made")
_Direction = Literal["forward", "backward"]


def embedded_links(links: LinksTable, folder: FilePath) -> LinksTable:
    """The links with the contents of the files that they name, relative to `folder`.

    Raises:
        SceneError: A file that cannot be read, with its line.
    """

    def embedded(link: LinkSettings, direction: _Direction) -> LinkSettings:
        return with_files(link, folder, direction)

    return replace(links, **_each(links, embedded))


def spec_of_links(links: LinksTable) -> dict[str, dict[str, Any] | None]:
    """Both directions as the Rust side takes them.

    Raises:
        SceneError: Settings that describe no link.
    """
    return _each(links, link_spec)


def _each(links: LinksTable, make: Callable[[LinkSettings, _Direction], _Made]) -> dict[str, _Made | None]:
    made: dict[str, _Made | None] = {}
    directions: tuple[_Direction, ...] = ("forward", "backward")
    for direction in directions:
        link: LinkSettings | None = getattr(links, direction)
        try:
            made[direction] = None if link is None else make(link, direction)
        except LinkError as error:
            steps: Path = tuple(int(step) if step.isdigit() else step for step in error.key.split("."))
            raise SceneError(f"{place(('link', direction, *steps))}{error.problem}") from None
    return made
