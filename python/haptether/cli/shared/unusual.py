"""Questions about units: numbers far outside their usual range, before anything runs."""

import contextlib
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import Scene
    from haptether.cli.shared.screen import Screen


def ask_units(console: "Screen", scenes: Iterable["Scene"], values: Iterable[tuple[str, object]] = ()) -> None:
    """Print one line for each unusual number, each line once.

    Args:
        console: Output.
        scenes: Scenes whose numbers are checked.
        values: Further numbers, each with its path or its option, for example varied ones.
    """
    from haptether.bridge.scene.unusual import unusual_numbers, unusual_values

    scenes = tuple(scenes)
    of_joints = any(scene.master.kind == "joints" for scene in scenes)
    lines = [line for scene in scenes for line in unusual_numbers(scene)]
    lines += [line for path, value in values for line in unusual_values(value, path, of_joints=of_joints)]
    for line in dict.fromkeys(lines):
        console.print(line, soft_wrap=True)


def check_times(option: str, values: Iterable[float], most_s: float) -> None:
    """Refuse times of an option outside 0 to `most_s`.

    Raises:
        ValueError: A time out of its bounds; the message names option, value, bounds and the likely unit.
    """
    from haptether.bridge.scene.unusual import unit_question

    for value in values:
        if not 0.0 <= value <= most_s:
            message = f"{option} {value:g}: must be 0 to {most_s:g} s{unit_question(value, option)}"
            raise ValueError(message)


def tasks_of(names: Iterable[str], overrides: Iterable[str]) -> Iterator["Scene"]:
    """Yield scenes by name or path, without those that cannot be built: the study that runs them reports why."""
    from haptether.bridge import SceneError, load_scene

    overrides = tuple(overrides)
    for name in names:
        with contextlib.suppress(SceneError):
            yield load_scene(name, overrides)
