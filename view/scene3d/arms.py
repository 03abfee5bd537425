"""Arms to draw: those that a scene drives or the caller names, because settings do not name the arm."""

from dataclasses import dataclass

from haptether.bridge import Scene
from haptether.dynamixel.description import ArmDescription, ArmDescriptionError, arm_names, load_arm
from haptether.slave import UR_MODELS, UrModel, ur_model


@dataclass(frozen=True, slots=True, kw_only=True)
class Arms:
    """Arms of both ends."""

    slave: UrModel | ArmDescription | None = None
    """A UR or a chain of servos; None for a tool without a known arm."""
    master: ArmDescription | None = None
    """A leader of servos; None for a stylus."""


def arms_of(scene: Scene | None, *, arm: str = "", leader: str = "") -> Arms:
    """Arms by their names.

    Args:
        scene: Scene, which may drive a UR.
        arm: Arm of the slave: a UR, or a servo description by name or path; empty for the scene's.
        leader: Arm of the master: a servo description by name or path.

    Raises:
        ValueError: There is no such arm; the text lists the arms.
    """
    slave: UrModel | ArmDescription | None = None
    if arm:
        slave = ur_model(arm) if arm in UR_MODELS else _described("--arm", arm, tuple(UR_MODELS))
    elif scene is not None and scene.slave is not None and scene.slave.device == "ur":
        name = str(scene.slave.options.get("model", "ur5e"))
        slave = ur_model(name) if name in UR_MODELS else None
    return Arms(slave=slave, master=_described("--leader", leader, ()) if leader else None)


def _described(option: str, name: str, besides: tuple[str, ...]) -> ArmDescription:
    known = ", ".join((*besides, *arm_names()))
    if name not in arm_names() and not name.endswith(".toml"):
        message = f"{option} {name}: must be one of {known}, or the path of a description of servos (.toml)"
        raise ValueError(message)
    try:
        return load_arm(name)
    except (ArmDescriptionError, OSError) as error:
        message = f"{option}: {error}"
        raise ValueError(message) from None
