"""Controllers of the caller's own, in Python, for simulated runs."""

from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

from haptether._core import ResearchObservation

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

SafetyForce: TypeAlias = "Sequence[float] | npt.NDArray[np.float64] | float | None"
"""F_c in N, one value per axis, or a number of a device with one; none to add no force."""


@runtime_checkable
class ResearchController(Protocol):
    """What a controller in Python is: called once a tick, after the controllers of the scene.

    It is made for each run, with the options of `[safety.research]` as keywords, and with `axes` and `period_s` where
    it has these. Where it also has a method `reset`, that is called when the layer forgets its past, after a fault.
    """

    def step(self, observation: ResearchObservation) -> SafetyForce:
        """F_c in N that is added to the rendered force, in the share that an intervention of the others leaves."""
        ...
