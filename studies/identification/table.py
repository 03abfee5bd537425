"""The `[master]` table of an identified device, and warnings about its data."""

import json
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from haptether.studies.identification.fit import EXPLAINED, Estimate, IdentifiedAxis


def encoder_quantum(position: NDArray[np.float64]) -> float | None:
    """Resolution of positions of shape `(n,)` if all steps are multiples of it; else None."""
    steps = np.abs(np.diff(position))
    steps = steps[steps > 1e-12]
    if len(steps) < 20:
        return None
    quantum = float(steps.min())
    multiples = steps / quantum
    if float(np.abs(multiples - np.round(multiples)).max()) > 0.05:
        return None
    return float(f"{quantum:.3g}")


def master_table(
    driver: str,
    options: Mapping[str, object],
    kind: str,
    axes: Sequence[IdentifiedAxis],
    quantum: float | None,
) -> str:
    """Table in TOML. A number indistinguishable from 0 is written as 0."""

    def per_axis(name: str, floor: float | None = None) -> str:
        numbers = []
        for axis in axes:
            estimate: Estimate = getattr(axis, name)
            value = 0.0 if abs(estimate.value) <= estimate.half else float(f"{estimate.value:.3g}")
            numbers.append(value if floor is None else max(floor, value))
        return repr(numbers[0]) if len(numbers) == 1 else repr(numbers)

    lines = [
        "[master]",
        f'kind = "{kind}"',
        f"axes = {len(axes)}",
        f"mass_kg = {per_axis('mass_kg')}",
        f"viscous = {per_axis('viscous')}",
        f"coulomb = {per_axis('coulomb', 0.0)}",
    ]
    if kind == "joints":
        lines.append('friction = "axis"')
    if quantum is not None:
        lines.append(f"encoder_quantum = {quantum!r}")
    lines.append(f"driver = {_toml(driver)}")
    if options:
        lines.append(f"options = {_toml(options)}")
    return "\n".join(lines)


def warnings(axes: Mapping[int, IdentifiedAxis], kind: str) -> list[str]:
    """Undetermined numbers and model deviations of each axis, keyed by its number."""
    force = "N m" if kind == "joints" else "N"
    per_speed = "N m s/rad" if kind == "joints" else "N s/m"
    said = []
    for number, axis in axes.items():
        for name, unit in (
            ("mass_kg", "kg m²" if kind == "joints" else "kg"),
            ("viscous", per_speed),
            ("coulomb", force),
        ):
            estimate: Estimate = getattr(axis, name)
            if abs(estimate.value) <= estimate.half:
                said.append(
                    f"axis {number}: {name} cannot be told from 0: between {estimate.value - estimate.half:.3g} and"
                    f" {estimate.value + estimate.half:.3g} {unit}; more speed tells more"
                )
            elif not estimate.is_determined:
                said.append(
                    f"axis {number}: {name} is known to {100.0 * estimate.half / abs(estimate.value):.0f} % only; more"
                    " speed, force or travel tells more"
                )
        if axis.coulomb.value < -axis.coulomb.half:
            said.append(
                f"axis {number}: a negative Coulomb friction of {axis.coulomb.value:.3g} {force}: 0 in the table"
            )
        if abs(axis.offset_n.value) > max(axis.offset_n.half, axis.coulomb.value, 0.02):
            said.append(
                f"axis {number}: {axis.offset_n.value:+.3g} {force} act on it all the time: a weight that nothing"
                " compensates, or a motor that is off zero; a hand feels that"
            )
        if axis.unexplained > EXPLAINED:
            said.append(
                f"axis {number}: m, b and c leave {100.0 * axis.unexplained:.1f} % of the squared force unexplained: is"
                " it held, does it touch something, or does its friction depend on where it is?"
            )
    return said


def _toml(value: object) -> str:
    """Format an option's value in TOML."""
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return json.dumps(value, ensure_ascii=False)
    if isinstance(value, Mapping):
        return "{ " + ", ".join(f"{_toml(str(key))} = {_toml(part)}" for key, part in value.items()) + " }"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    return repr(value)
