"""Runs of shipped scenes that several tests share; they are read-only."""

from functools import lru_cache

from haptether.bridge import Run, simulate


@lru_cache(maxsize=16)
def shipped(name: str, *overrides: str) -> Run:
    """Return the run of a shipped scene, simulated once per process."""
    run = simulate(name, overrides=list(overrides))
    for values in run.signals.values():
        values.setflags(write=False)
    return run
