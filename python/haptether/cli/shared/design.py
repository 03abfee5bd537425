"""Findings by design that a live side prints at its start."""

import shlex
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import Scene
    from haptether.studies import DesignCheck

WORDS = {"bad": "BAD  ", "warning": "warn ", "not judged": "?    ", "good": "good ", "note": "note "}
"""Labels of the states of a finding."""


def summary(found: "DesignCheck") -> str:
    """Return how many findings are bad, have little room, or were not judged."""
    counted = (
        (found.of("bad"), "bad"),
        (found.of("warning"), "with little room"),
        (found.of("not judged"), "not judged"),
    )
    said = [f"{len(of)} {words}" for of, words in counted if of]
    if not found.of("bad"):
        said.insert(0, "nothing bad")
    return ", ".join(said) if len(said) > 1 or found.of("bad") else "nothing bad, room everywhere"


def design_lines(scene: "Scene", name: str | None, changes: Iterable[str] = ()) -> Iterator[str]:
    """Yield the findings that are bad or have little room, if quick to compute; a failed check is one line.

    Args:
        scene: The scene that is about to run.
        name: Its name, as `haptether check` takes it; None if options alone made it.
        changes: Changes of its fields, as `--set` takes them.
    """
    try:
        from haptether.studies import check_at_once

        found = [one for one in check_at_once(scene) if one.state in {"bad", "warning"}]
    except Exception as error:
        # A failed check must not keep a side from running.
        yield f"not checked by design: {' '.join(str(error).split())}"
        return
    for one in found:
        yield f"{WORDS[one.state]}{one.name}: {one.text}"
    if found and name is not None:
        settings = "".join(f" --set {shlex.quote(change)}" for change in changes)
        yield f"the rest, and what mends it: haptether check {shlex.quote(name)}{settings}"
