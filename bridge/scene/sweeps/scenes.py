"""Whole scenes as values of a sweep, under the path "scene"."""

from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from collections.abc import Set as AbstractSet
from dataclasses import dataclass, field
from os import PathLike
from typing import Any

from haptether.bridge.scene.errors import SceneError, shown
from haptether.bridge.scene.load import Checked
from haptether.bridge.scene.run import named_scene
from haptether.bridge.scene.tables.session import Scene

SCENE = "scene"
"""Path of a sweep whose values are scenes."""


@dataclass(frozen=True)
class SceneChoice:
    """Scene that some rows use."""

    name: str
    """Name as given, or the title."""
    checked: Checked = field(repr=False)

    def __str__(self) -> str:
        return self.name

    def __hash__(self) -> int:
        return hash(self.name)


def with_scenes(argument: str, varied: Mapping[str, Any] | None, overrides: Iterable[str]) -> Mapping[str, Any] | None:
    """Return the varied values with their scenes loaded and overridden like the first.

    `argument` names the values in messages.

    Raises:
        SceneError: The values are not a list, or a scene is invalid.
        ValueError: The values are not given by path, or two scenes have the same name.
    """
    if varied is not None and not (isinstance(varied, Mapping) and all(isinstance(path, str) for path in varied)):
        message = f'{argument} = {varied!r}: must be values by path, such as {{"run.seed": [1, 2, 3]}}'
        raise ValueError(message)
    if varied is not None and isinstance(varied.get(SCENE), Iterator):
        varied = {**varied, SCENE: list(varied[SCENE])}
    for path, values in (varied or {}).items():
        is_list = isinstance(values, Collection) and not isinstance(values, str | bytes | Mapping | AbstractSet)
        if not is_list or getattr(values, "ndim", 1) == 0:
            kind = "scenes" if path == SCENE else "values, such as [1, 2, 3]"
            message = f"{path} = {shown(values)}: must be a list of {kind}"
            raise SceneError(message)
    if varied is None or SCENE not in varied:
        return varied
    return {**varied, SCENE: scene_choices(varied[SCENE], overrides)}


def scene_choices(
    scenes: Sequence[Scene | SceneChoice | str | PathLike[str]], overrides: Iterable[str]
) -> list[SceneChoice]:
    """Load each of the named scenes once.

    Raises:
        SceneError: A scene is invalid.
        ValueError: Two scenes have the same name.
    """
    overrides, known, found = tuple(overrides), dict[str, SceneChoice](), []
    for scene in scenes:
        if isinstance(scene, SceneChoice):
            found.append(scene)
            continue
        if not isinstance(scene, Scene) and (choice := known.get(str(scene))) is not None:
            found.append(choice)
            continue
        if not isinstance(scene, Scene | str | PathLike):
            message = f"{SCENE} = {scene}: must be a scene: a name, a path, or what `load_scene` gave"
            raise SceneError(message)
        choice = SceneChoice(*named_scene(scene, overrides))
        other = known.setdefault(choice.name, choice)
        if other.checked.scene != choice.checked.scene:
            message = f"{SCENE} = {choice.name}: two scenes have this name: give them titles of their own"
            raise ValueError(message)
        found.append(other)
    return found
