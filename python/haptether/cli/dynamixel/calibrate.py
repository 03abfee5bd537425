"""`haptether dynamixel calibrate`."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from haptether.cli.shared.output import FileOptions

if TYPE_CHECKING:
    from haptether.dynamixel.arm import ServoSettings
    from haptether.dynamixel.arm.guide import FoundServo


@dataclass(frozen=True, kw_only=True)
class Calibrate(FileOptions):
    """Find where the zero of an arm is, which way its joints turn, and how far; a person moves it, without torque.

    It writes the file of the arm, for the options of the drivers. For each servo it stores id, model, direction, offset
    of the zero, and limits. A servo knows one turn: an offset counts from the mechanical centre of its output, with its
    homing offset, and the limits select the turn. Switch the supply on with every joint that can turn more than once
    near the pose of the calibration. Shadows of a joint and the ends of a gripper are not found: write `shadows` into
    the file, and `open_rad` and `closed_rad` into the scene.

    With --weigh it measures the torque constant of one servo of an existing file, by a known weight: published
    constants of a servo differ by up to a factor of two.

    Examples:

    haptether dynamixel calibrate /dev/ttyUSB0 arm.toml --round

    haptether dynamixel calibrate /dev/ttyUSB0 arm.toml --ids 1 2 3 4 5 6 --pose 0 -1.57 1.57 -1.57 -1.57 0

    haptether dynamixel calibrate /dev/ttyUSB0 arm.toml --weigh 2 --mass 0.5 --lever 0.12
    """

    port: Annotated[str, tyro.conf.Positional, tyro.conf.arg(metavar="PORT")]
    """The serial port; also as --port PORT."""
    path: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")]
    """File of the arm."""
    baud: int | None = None
    """Rate of the servos in bit/s; by default all are tried."""
    ids: tuple[int, ...] = ()
    """Servos in the order of the joints; by default all of ids 1 to 20 that answer."""
    pose: Annotated[tuple[float, ...], tyro.conf.arg(metavar="Q")] = ()
    """Angles in rad of the pose into which the arm is put; by default 0."""
    round: bool = False
    """Round offsets to multiples of pi/2, if the horns are mounted so."""
    margin: float = 0.05
    """Distance in rad of the limits inside the shown range."""
    weigh: Annotated[int | None, tyro.conf.arg(metavar="ID")] = None
    """Measure the torque constant of this servo of FILE instead: the arm holds its joints, with torque, and moves this
    one by 0.1 rad up and down, without a weight and with it."""
    mass: Annotated[float | None, tyro.conf.arg(metavar="KG")] = None
    """Mass of the weight in kg."""
    lever: Annotated[float | None, tyro.conf.arg(metavar="M")] = None
    """Horizontal distance in m from the axis of the joint to the weight."""
    tolerance: float = 0.02
    """Relative error of mass times lever."""
    yes: bool = False
    """A person answers, although standard input is not a terminal."""

    def run(self) -> int:
        """Ask step by step, and write the file."""
        import math
        import os

        from haptether.cli.device.consent import check_terminal
        from haptether.cli.dynamixel.prompt import Operator
        from haptether.dynamixel import DynamixelBus
        from haptether.dynamixel.arm import write_calibration
        from haptether.dynamixel.arm.guide import Guide, calibrated
        from haptether.private_file import refuse_existing

        check_terminal("calibrate", yes=self.yes)
        if not self.path.name:
            message = "FILE: is empty: must name the file to write"
            raise ValueError(message)
        if self.weigh is not None or self.mass is not None or self.lever is not None:
            return self._weigh()
        if not self.force:
            refuse_existing(self.path)
        if not 0.0 <= self.margin <= 0.5:
            message = f"margin = {self.margin:g}: must be 0 to 0.5 rad"
            raise ValueError(message)
        folder = Path(os.path.realpath(self.path)).parent
        if not (folder.is_dir() and os.access(folder, os.W_OK)):
            message = f"{self.path}: its folder must be one that can be written to"
            raise ValueError(message)
        servos = self._servos()
        pose = self.pose or (0.0,) * len(servos)
        if len(pose) != len(servos) or not all(math.isfinite(q) and abs(q) <= 100.0 for q in pose):
            message = f"pose: {' '.join(f'{q:g}' for q in pose)}: must be {len(servos)} angles in rad, within 100"
            raise ValueError(message)
        baud = servos[0].baud
        operator = Operator()
        bus = DynamixelBus(self.port, baud=baud, timeout_s=0.1)
        try:
            guide = Guide(bus, servos, operator.say, operator.answer, operator.forget)
            operator.forget()
            operator.say(
                "hold the arm, and what its gripper holds: as soon as you press Enter EVERY servo on this bus loses its"
                " torque, that of a gripper, too"
            )
            operator.wait()
            guide.loosen()
            operator.say(f"no torque: servo {', '.join(str(servo.servo_id) for servo in servos)}, verified")
            at_pose = guide.pose(pose)
            signs = guide.directions()
            ranges = guide.ranges()
        finally:
            bus.close()
        arm, left = calibrated(
            servos, pose, at_pose, signs, ranges, rounded=self.round, margin_rad=self.margin
        )  # fmt: skip
        write_calibration(self.path, baud, arm)
        for joint, one in enumerate(arm):
            self._print(joint, one, float(left[joint]))
        print(f"{self.path}: written; [slave.options] arm = {str(self.path)!r}")
        return 0

    def _weigh(self) -> int:
        """Measure one constant, and write it into the file."""
        from dataclasses import replace

        from haptether.cli.dynamixel.prompt import Operator
        from haptether.dynamixel.arm import ArmSettings, ServoArm, read_calibration, write_calibration
        from haptether.dynamixel.arm.weigh import GRAVITY, Weighing, weighed_constant
        from haptether.dynamixel.models import OperatingMode

        baud, servos = read_calibration(self.path)
        index = self._weighed(servos)
        weighed = servos[index]
        assert self.mass is not None
        assert self.lever is not None
        load_nm = self.mass * GRAVITY * self.lever
        modes = OperatingMode.EXTENDED_POSITION, OperatingMode.CURRENT_BASED_POSITION
        holding = tuple(replace(servo, mode=modes[servo.servo.has_current_control]) for servo in servos)
        operator = Operator()
        arm = ServoArm(ArmSettings(port=self.port, servos=holding, baud=self.baud or baud, timeout_s=0.05))

        def ask(what: str) -> None:
            operator.forget()
            operator.say(what)
            weighing.hold(lambda: operator.answer(0.0) is not None)

        operator.forget()
        operator.say(
            f"clamp the base, nobody and nothing in reach. Hold the arm so that the lever of servo {weighed.servo_id}"
            " is level, WITHOUT the weight, and press Enter: all joints then hold where they are, WITH TORQUE"
        )
        operator.wait()
        weighing = Weighing(arm, index)
        try:
            arm.open()
            ask("it holds: take your hands off and press Enter; the joint then moves by 0.1 rad up and down")
            without = weighing.swing()
            ask(f"hang {self.mass:g} kg onto it, {self.lever:g} m from the axis, hands off, and press Enter")
            with_weight = weighing.swing()
            ask("hold the arm, take the weight off, and press Enter: it then loses its torque")
        finally:
            arm.close()
        found = weighed_constant(weighed, load_nm, self.tolerance, without, with_weight)
        constant, uncertainty = found.nm_per_a, found.uncertainty_nm_per_a
        measured = replace(weighed, torque_constant=constant, torque_constant_uncertainty=uncertainty)
        write_calibration(self.path, baud, (*servos[:index], measured, *servos[index + 1 :]))
        published = sorted(one.nm_per_a for one in weighed.servo.published)
        print(
            f"servo {weighed.servo_id}: {constant:.3f} +- {uncertainty:.3f} N m/A; published of a {weighed.model}:"
            f" {published[0]:.3f} to {published[-1]:.3f}; friction {found.friction_a * constant:.3f} N m"
        )
        print(f"{self.path}: written")
        return 0

    def _weighed(self, servos: "tuple[ServoSettings, ...]") -> int:
        """Return the index of the weighed servo.

        Raises:
            ValueError: An option that is missing or invalid, or a servo without current control.
        """
        for name, value, most, unit in (("mass", self.mass, 20.0, "kg"), ("lever", self.lever, 2.0, "m")):
            if value is None or not 0.0 < value <= most:
                seen = "is missing" if value is None else f"= {value:g}"
                message = f"{name} {seen}: with --weigh it must be above 0 and at most {most:g} {unit}"
                raise ValueError(message)
        if not 0.0 <= self.tolerance <= 0.1:
            message = f"tolerance = {self.tolerance:g}: must be 0 to 0.1"
            raise ValueError(message)
        ids = [servo.servo_id for servo in servos]
        if self.weigh not in ids:
            message = f"weigh = {self.weigh}: must be a servo of {self.path}: {', '.join(map(str, ids))}"
            raise ValueError(message)
        servo = servos[ids.index(self.weigh)]
        if not servo.servo.has_current_control:
            message = f"weigh = {self.weigh}: a {servo.model} measures no current: must be a servo with current control"
            raise ValueError(message)
        if servo.shadows:
            message = (
                f"weigh = {self.weigh}: turns its joint with servo {', '.join(map(str, servo.shadows))}: take them off"
            )
            raise ValueError(message)
        return ids.index(self.weigh)

    def _servos(self) -> "list[FoundServo]":
        """Return the answering servos, all of known models and of one rate."""
        from haptether.cli.dynamixel.search import found_servos

        servos = found_servos(self.port, self.baud, self.ids or range(1, 21))
        missing = [servo_id for servo_id in self.ids if servo_id not in {servo.servo_id for servo in servos}]
        if missing or not servos:
            message = f"{self.port}: servo {', '.join(map(str, missing)) or 'of any id'} does not answer"
            raise RuntimeError(message)
        if len({servo.baud for servo in servos}) > 1:
            message = f"{self.port}: servos of several rates: give all the same, or name one by --baud"
            raise RuntimeError(message)
        for servo in servos:
            print(f"id {servo.servo_id}: {servo.model.name if servo.model else f'model {servo.number}'}", flush=True)
            if servo.model is None:
                message = f"servo {servo.servo_id}: model {servo.number} is not known"
                raise RuntimeError(message)
        return servos

    def _print(self, joint: int, one: "ServoSettings", left: float) -> None:
        rest = f", {left:+.3f} rad rounded away" if self.round else ""
        print(
            f"joint {joint + 1}: servo {one.servo_id}, sign {one.sign:+d}, offset {one.offset_rad:+.4f} rad{rest},"
            f" {one.low_rad:+.3f} to {one.high_rad:+.3f} rad"
        )
        if one.near_rad is not None:
            print(f"  it turns more than once: have it near {one.near_rad:+.2f} rad when its supply comes on")
        if abs(left) > 0.3:
            print("  much is rounded away: the pose was another, or its horn is not mounted at a quarter turn")
