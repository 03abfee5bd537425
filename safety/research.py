"""Protocol of research controllers in Python, for simulated runs."""

from typing import TYPE_CHECKING, Protocol, TypeAlias, runtime_checkable

from haptether._core import ResearchObservation

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy as np
    import numpy.typing as npt

SafetyForce: TypeAlias = "Sequence[float] | npt.NDArray[np.float64] | float | None"
"""F_c in N: one value per axis, a number for a device with one axis, or None to add no force."""


@runtime_checkable
class ResearchController(Protocol):
    """Controller in Python, called once per tick after the controllers of the scene.

    An instance is created for each run, with the options of `[safety.research]` as keyword arguments. It also receives
    `axes` and `period_s` if its parameters include them. An optional method `reset` is called when the layer resets its
    state after a fault.
    """

    def step(self, observation: ResearchObservation) -> SafetyForce:
        """Return F_c in N.

        It is added to F_v, scaled by the share of F_v that the other controllers let through.
        """
        ...
