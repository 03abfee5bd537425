"""What a live side says at its start of what its scene bears by design."""

import shlex
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.bridge import Scene
    from haptether.studies import DesignCheck

WORDS = {"bad": "BAD  ", "warning": "warn ", "not judged": "?    ", "good": "good ", "note": "note "}
"""What a finding is, before its name."""


def summary(found: "DesignCheck") -> str:
    """How many findings are bad, have little room, or were not judged."""
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
    """What is bad by design, or has little room, as far as that is had at once; a check that fails is one line.

    Args:
        scene: That is about to run.
        name: Of it, as `haptether check` takes it; none where options alone made it.
        changes: Of its fields, as `--set` took them.
    """
    try:
        from haptether.studies import check_at_once

        found = [one for one in check_at_once(scene) if one.state in {"bad", "warning"}]
    except Exception as error:
        # What is only said must not keep a side from running.
        yield f"not checked by design: {' '.join(str(error).split())}"
        return
    for one in found:
        yield f"{WORDS[one.state]}{one.name}: {one.text}"
    if found and name is not None:
        settings = "".join(f" --set {shlex.quote(change)}" for change in changes)
        yield f"the rest, and what mends it: haptether check {shlex.quote(name)}{settings}"
