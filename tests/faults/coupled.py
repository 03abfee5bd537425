"""The ten hardest rows with processes, under each coupling with two halves."""

from collections.abc import Callable
from dataclasses import replace

from tests.faults import hostile, presses, processes
from tests.faults.rows import Row
from tests.faults.running import Stage

from haptether.bridge import COUPLINGS, coupling_facts

EASY = {processes.WRONG_KEY, processes.SECOND_MASTER}
HARD = {presses.cut_name(0.13, True), hostile.REPLAYED, hostile.COPIED}


def rows(limits: processes.Limits | None = None) -> dict[str, Callable[[], Row]]:
    """Return the measurements by coupling and fault."""
    limits = limits or processes.Limits()
    hardest = {name: row for name, row in processes.rows(limits).items() if name not in EASY}
    others = {**presses.rows(), **hostile.rows(limits)}
    hardest |= {name: row for name, row in others.items() if name in HARD}
    kinds = [kind for kind, *_ in COUPLINGS if coupling_facts(kind).stiffness is not None]
    return {f"{kind}, {name}": under(kind, row) for kind in kinds for name, row in hardest.items()}


def under(kind: str, measure: Callable[[], Row]) -> Callable[[], Row]:
    """Return the row with this coupling at both sides."""

    def coupled() -> Row:
        before, Stage.overrides = Stage.overrides, (f"coupling.kind={kind}",)
        try:
            return replace(measure(), coupling=kind)
        finally:
            Stage.overrides = before

    return coupled
