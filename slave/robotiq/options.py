"""Options of a Robotiq gripper's driver."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta

from haptether.options import check_host, converted, refused
from haptether.slave.robotiq.models import ROBOTIQ_MODELS, Scale

DEVICE: Final = "gripper = robotiq"
PORT: Final = 63352
Count: TypeAlias = Annotated[int, Meta(ge=0, le=255)]


class RobotiqOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `robotiq`, in SI units."""

    host: str
    """Address or name of the UR controller that the URCap runs on."""
    port: Annotated[int, Meta(ge=1, le=65535)] = PORT
    """Port of the URCap's server."""
    model: Literal["2f-85", "2f-140", "hand-e"] = "2f-85"
    """Gripper model, which sets stroke, speeds and forces."""
    slave_id: Count | None = None
    """Id of the gripper if the URCap has several; by default 9."""
    activate: bool = False
    """True to let `open` activate an inactive gripper: its jaws open and close once, and drop any object."""
    rate_hz: Annotated[float, Meta(ge=1.0, le=100.0, extra={"unit": "Hz"})] = 50.0
    """Largest rate of position reads; lower if the server is slow."""
    reply_timeout_s: Annotated[float, Meta(ge=0.05, le=2.0, extra={"unit": "s"})] = 0.5
    """Timeout of a reply."""
    open_count: Count | None = None
    """POS with open jaws; by default from the model."""
    closed_count: Count | None = None
    """POS with closed jaws; by default from the model."""

    @property
    def scale(self) -> Scale:
        """Return the map between counts and SI units."""
        model = ROBOTIQ_MODELS[self.model]
        opened, closed = model.counts
        return Scale(
            model,
            (
                opened if self.open_count is None else self.open_count,
                closed if self.closed_count is None else self.closed_count,
            ),
        )


def robotiq_options(given: Mapping[str, Any]) -> RobotiqOptions:
    """Convert the options of a scene; numbers may be given as text.

    Raises:
        ValueError: A key is unknown or missing, or a value is invalid; names the key.
    """
    options = converted(RobotiqOptions, given, DEVICE, {"host": "the address of the UR controller"})
    check_host(DEVICE, options.host)
    opened, closed = options.scale.counts
    if not opened < closed:
        key = "open_count" if options.closed_count is None else "closed_count"
        why = f"the jaws are open at {opened} and closed at {closed}: closed_count must be above open_count"
        raise refused(DEVICE, key, getattr(options, key), why)
    return options
