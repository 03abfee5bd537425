"""What the driver of a Robotiq gripper is called with."""

from collections.abc import Mapping
from typing import Annotated, Any, Final, Literal, TypeAlias

import msgspec
from msgspec import Meta

from haptether.options import converted, refused
from haptether.slave.robotiq.models import ROBOTIQ_MODELS, Scale

DEVICE: Final = "gripper = robotiq"
PORT: Final = 63352
Count: TypeAlias = Annotated[int, Meta(ge=0, le=255)]


class RobotiqOptions(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """Options of the driver `robotiq`, in SI units."""

    host: str
    """Address or name of the UR controller that the URCap runs on."""
    port: Annotated[int, Meta(ge=1, le=65535)] = PORT
    """Of the URCap's server."""
    model: Literal["2f-85", "2f-140", "hand-e"] = "2f-85"
    """The gripper: its stroke, speeds and forces."""
    slave_id: Count | None = None
    """Which gripper, where the URCap has several; by default its own, which is 9."""
    activate: bool = False
    """Let `open` activate a gripper that is not active: its jaws open and close once, and drop what they hold."""
    rate_hz: Annotated[float, Meta(ge=1.0, le=100.0, extra={"unit": "Hz"})] = 50.0
    """How often the position is asked for at most; a server that answers slowly is asked less often."""
    reply_timeout_s: Annotated[float, Meta(ge=0.05, le=2.0, extra={"unit": "s"})] = 0.5
    """How long a reply may take."""
    open_count: Count | None = None
    """What POS reads when the jaws are open; by default that of the model."""
    closed_count: Count | None = None
    """What POS reads when the jaws are closed; by default that of the model."""

    @property
    def scale(self) -> Scale:
        """Counts to SI units and back."""
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
    """The options from what a scene has, whose numbers may be written as text.

    Raises:
        ValueError: A key that there is not or that is missing, or a value that it cannot have; names the key.
    """
    options = converted(RobotiqOptions, given, DEVICE, {"host": "the address of the UR controller"})
    host = options.host
    if not host or any(sign.isspace() or sign in ":/" for sign in host):
        raise refused(DEVICE, "host", host, "must be an IPv4 address or a name, without a port")
    opened, closed = options.scale.counts
    if not opened < closed:
        key = "open_count" if options.closed_count is None else "closed_count"
        why = f"the jaws are open at {opened} and closed at {closed}: closed_count must be above open_count"
        raise refused(DEVICE, key, getattr(options, key), why)
    return options
