"""What one unit's kinematics differ by from its model: `calibration.toml`.

The four keys are those of the controller's `calibration.conf`, six numbers each, in m and rad:

    delta_theta = [2.1e-5, 0.97, -1.86, 0.89, 5.7e-5, -7.5e-5]
    delta_a = [3.9e-4, 0.184, 0.145, -6.4e-5, 7.8e-6, 0.0]
    delta_d = [4.0e-5, 278.2, -183.7, -94.5, 3.0e-4, 1.2e-4]
    delta_alpha = [-2.7e-4, 1.3e-3, -3.2e-3, 6.5e-4, -5.9e-4, 0.0]

Axes 2, 3 and 4 are all but parallel, so that their common normals, from which `d` and `theta` count, lie wherever the
last micrometre puts them: hundreds of metres away, and back again with the next row. So these rows have wide bounds
each, and the chain as a whole a narrow one.

Source: Universal Robots' ROS driver, `ur_calibration`, "algorithm": why the rows of a real arm look like that.
"""

import math
import tomllib
from pathlib import Path
from typing import Final

import msgspec

from haptether.slave.ur.kinematics.chain import deviation, dh_rows
from haptether.slave.ur.kinematics.models import Six, UrModel

# Per joint; several times what published calibrations of real arms have (446 m, 7.2 rad, 0.63 m, 0.014 rad).
LIMITS: Final[dict[str, Six]] = {
    "delta_theta": (0.1, 12.6, 12.6, 12.6, 0.1, 0.1),
    "delta_a": (0.02, 2.0, 2.0, 0.02, 0.02, 0.02),
    "delta_d": (0.02, 2000.0, 2000.0, 2000.0, 0.02, 0.02),
    "delta_alpha": (0.05, 0.05, 0.05, 0.05, 0.05, 0.05),
}
# What a mounted arm of that model may be off; published ones are off by millimetres and mrad.
MAX_M: Final = 0.05
MAX_RAD: Final = 0.05
NONE: Final[Six] = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0)


class UrCalibration(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Deltas to the Denavit-Hartenberg rows of a model, base to flange.

    Raises:
        ValueError: A delta is not finite, or larger than any arm has.
    """

    delta_theta: Six = NONE
    """rad."""
    delta_a: Six = NONE
    """m."""
    delta_d: Six = NONE
    """m."""
    delta_alpha: Six = NONE
    """rad."""

    def __post_init__(self) -> None:
        for key, limits in LIMITS.items():
            deltas: Six = getattr(self, key)
            if len(deltas) != 6:
                message = f"{key} has {len(deltas)} numbers: must have 6"
                raise ValueError(message)
            for joint, (delta, limit) in enumerate(zip(deltas, limits, strict=True), start=1):
                if not (math.isfinite(delta) and abs(delta) <= limit):
                    message = f"{key} of joint {joint} = {delta!r}: must be finite and within +-{limit:g}"
                    raise ValueError(message)

    def check(self, model: UrModel) -> None:
        """Refuses deltas that cannot be of an arm of this model, above all those of another model.

        Raises:
            ValueError: The tool would be more than 0.05 m or 0.05 rad from where the model has it.
        """
        metres, radians = deviation(dh_rows(model, self), dh_rows(model))
        if metres > MAX_M or radians > MAX_RAD:
            message = (
                f"deltas move the flange of a {model.name} by {metres:.3g} m and {radians:.3g} rad: "
                f"must be at most {MAX_M:g} m and {MAX_RAD:g} rad"
            )
            raise ValueError(message)


def read_calibration(path: Path | str, model: UrModel) -> UrCalibration:
    """The deltas in a `calibration.toml`, held to a model; a key that is absent is six zeros.

    Raises:
        ValueError: Not TOML, an unknown key, a wrong length, a number that is not finite or absurdly large, or deltas
            of another model; names file and key.
        OSError: The file cannot be read.
    """
    try:
        plain = tomllib.loads(Path(path).read_text(encoding="utf-8"))
        calibration = msgspec.convert(plain, UrCalibration)
        calibration.check(model)
    except ValueError as error:
        # msgspec's ValidationError and tomllib's TOMLDecodeError are ValueErrors too.
        message = f"{path}: {error}"
        raise ValueError(message) from None
    return calibration
