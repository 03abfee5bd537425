"""Runs that the tests of the view look at, each computed once a process."""

import functools

from haptether.bridge import Run, Scene, load_scene, simulate
from haptether.view import Description, describe


@functools.cache
def shown(name: str, *overrides: str) -> tuple[Run, Scene, Description]:
    """A run of a shipped scene, the scene, and its description."""
    scene = load_scene(name, overrides)
    run = simulate(name, overrides=overrides)
    return run, scene, describe(run, scene)
