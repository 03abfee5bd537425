"""Runs that the tests of the view share, each computed once per process."""

import functools

from haptether.bridge import Run, Scene, load_scene, simulate
from haptether.view import Description, describe


@functools.cache
def shown(name: str, *overrides: str) -> tuple[Run, Scene, Description]:
    """Return a run of a shipped scene, the scene, and its description."""
    scene = load_scene(name, overrides)
    run = simulate(name, overrides=overrides)
    return run, scene, describe(run, scene)
