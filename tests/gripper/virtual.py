"""A gripper and its client in virtual time: no socket, no thread, no clock."""

from collections.abc import Callable, Generator

from haptether.slave import ROBOTIQ_MODELS, GripperCommand, GripperSample
from haptether.slave.robotiq.models import Scale
from haptether.slave.robotiq.protocol import Progress, Request, parsed
from haptether.slave.robotiq.session import START, Order, Session
from haptether.slave.ur_emulator import EmulatedGripper, GrippedObject, GripperSettings
from haptether.slave.ur_emulator.gripper.port import answered

CYCLE_S = 0.002
NS = 1_000_000_000
MM = 1e-3


def gripper(object_mm: float | None = None, *, model: str = "2f-85", active: bool = True) -> EmulatedGripper:
    """Return an emulated gripper, by default activated and open."""
    grips = None if object_mm is None else GrippedObject(width_m=MM * object_mm)
    return EmulatedGripper(GripperSettings(model=ROBOTIQ_MODELS[model], grips=grips, active=active))


def scale(model: str = "2f-85") -> Scale:
    """Return the counts of a model."""
    return Scale(ROBOTIQ_MODELS[model], ROBOTIQ_MODELS[model].counts)


def reply(of: EmulatedGripper, request: Request) -> int | None:
    """Return the server's reply, as the driver reads it."""
    progress, value = parsed(answered(of, request.text.strip(), bare=False), request.reads)
    assert progress is not Progress.PARTIAL
    return value


def move(position: float, speed: float = 1.0, force_n: float = 50.0) -> GripperCommand:
    return GripperCommand(position=position, speed=speed, force_n=force_n)


class Led:
    """A session with an emulated gripper.

    Args:
        of: The gripper; activated.
        rate_hz: Rate of the driver.
        round_trip_s: Time from a request to its reply.
        begin_s: Age of the gripper at the beginning.
        answer: Returns the bytes that replace the gripper's own reply.
    """

    def __init__(
        self,
        of: EmulatedGripper,
        *,
        rate_hz: float = 50.0,
        round_trip_s: float = CYCLE_S,
        begin_s: float = 0.0,
        answer: Callable[[Request, int | None], int | None] = lambda _, value: value,
    ) -> None:
        self.gripper = of
        self.now_s = begin_s
        self.round_trip_s = round_trip_s
        self.answer = answer
        self.requests: list[tuple[float, Request]] = []
        self.order: Order | None = None
        values = {variable: of.read(variable) or 0 for variable in START}
        self.session = Session(scale(of.settings.model.name), rate_hz, values, None, self.now_ns)

    @property
    def now_ns(self) -> int:
        return round(self.now_s * NS)

    @property
    def sample(self) -> GripperSample:
        return self.session.sample(self.now_ns)

    @property
    def settings(self) -> list[str]:
        """Return the SET requests, without the readings."""
        return [request.shown for _, request in self.requests if request.reads is None]

    def write(self, command: GripperCommand) -> None:
        self.order = Order(self._number, command)

    def hold(self) -> None:
        self.order = Order(self._number, None)

    def run(self, duration_s: float, until: Callable[[GripperSample], bool] = lambda _: False) -> float:
        """Let time pass until a condition holds; return the time in s."""
        begun_s = self.now_s
        while self.now_s - begun_s < duration_s and not until(self.sample):
            request = self.session.due(self.order, self.now_ns)
            if request is None:
                # At least one cycle of the emulator must pass.
                self._pass(max(CYCLE_S, self.session.wait_ns(self.order, self.now_ns) / NS))
                continue
            sent_ns = self.now_ns
            self.requests.append((self.now_s, request))
            value = self.answer(request, reply(self.gripper, request))
            self._pass(self.round_trip_s)
            self.session.replied(request, value, sent_ns, self.now_ns)
        return self.now_s - begun_s

    @property
    def _number(self) -> int:
        return 1 if self.order is None else self.order.number + 1

    def _pass(self, duration_s: float) -> None:
        for _ in range(max(1, round(duration_s / CYCLE_S))):
            self.now_s += CYCLE_S
            self.gripper.advance(self.now_s)


def performed(of: EmulatedGripper, steps: Generator[Request | float, int | None, None], limit_s: float = 60.0) -> float:
    """Perform an activation in virtual time; return its duration in s."""
    now_s, value = 0.0, None
    while now_s < limit_s:
        try:
            step = steps.send(value)
        except StopIteration:
            return now_s
        value = None
        if isinstance(step, Request):
            value = reply(of, step)
            step = CYCLE_S
        now_s += step
        of.advance(now_s)
    message = f"not performed within {limit_s} s"
    raise TimeoutError(message)
