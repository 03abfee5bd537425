"""Servo models: model numbers, table defaults and motor data.

Source: ROBOTIS e-Manual, the page of each model; other sources are named beside the value.
"""

import math
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final

from haptether.dynamixel.control_table import (
    X330_TABLE,
    XC430_TABLE,
    XL430_TABLE,
    XM430_TABLE,
    XM540_TABLE,
    ControlTable,
)


class OperatingMode(IntEnum):
    """Controlled quantity, address 11."""

    CURRENT = 0
    VELOCITY = 1
    POSITION = 3
    EXTENDED_POSITION = 4
    CURRENT_BASED_POSITION = 5
    PWM = 16


CURRENT_MODES: Final = frozenset({OperatingMode.CURRENT, OperatingMode.CURRENT_BASED_POSITION})
"""Modes that require current control."""

BAUD_RATES: Final = (9600, 57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000, 4_500_000)
"""Rates in bit/s by the code at address 8; the last is not available on 330 models."""


@dataclass(frozen=True, slots=True)
class Stall:
    """Stall torque at one supply voltage; not a continuous rating."""

    voltage_v: float
    torque_nm: float
    current_a: float


@dataclass(frozen=True, slots=True)
class Published:
    """Published torque constant."""

    nm_per_a: float
    source: str


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoModel:
    """Servo data from its maker."""

    name: str
    number: int
    """Value of address 0 and of a ping answer."""
    table: ControlTable
    stall: tuple[Stall, ...]
    """Stalls at increasing voltages; the middle one is recommended."""
    no_load_rpm: float
    """No-load speed at the recommended voltage."""
    torque_constant_nm_per_a: float | None = None
    """Output torque per ampere of `Present Current`; None if the maker states none."""
    other_constants: tuple[Published, ...] = ()
    """Torque constants from other sources."""
    fast_read_firmware: int = 45
    """First firmware with fast sync read and fast bulk read. Source: e-Manual, Protocol 2.0."""

    @property
    def has_current_control(self) -> bool:
        """True if modes 0 and 5 exist."""
        return "Goal Current" in self.table

    @property
    def operating_modes(self) -> frozenset[OperatingMode]:
        """Available modes."""
        return frozenset(OperatingMode) - (frozenset() if self.has_current_control else CURRENT_MODES)

    @property
    def recommended(self) -> Stall:
        """Stall at the recommended voltage."""
        return self.stall[len(self.stall) // 2]

    @property
    def current_unit_a(self) -> float | None:
        """Ampere per unit of current; None without current control."""
        return self.table["Goal Current"].scale if self.has_current_control else None

    @property
    def max_current_a(self) -> float | None:
        """Largest goal current in A; None without current control."""
        if not self.has_current_control:
            return None
        limit = self.table["Current Limit"]
        return (limit.maximum or 0) * limit.scale

    @property
    def stall_ratio_nm_per_a(self) -> float:
        """Stall torque divided by stall current at the recommended voltage.

        Valid as torque per current only near stall, because gear friction dominates small currents.
        """
        return self.recommended.torque_nm / self.recommended.current_a

    @property
    def nominal_nm_per_a(self) -> float:
        """Likely K_t: the maker's, otherwise the stall ratio."""
        return self.torque_constant_nm_per_a or self.stall_ratio_nm_per_a

    @property
    def published(self) -> tuple[Published, ...]:
        """All published K_t, including the stall ratio."""
        maker = self.torque_constant_nm_per_a
        return (
            *(() if maker is None else (Published(maker, "the maker"),)),
            *(Published(at.torque_nm / at.current_a, f"stall at {at.voltage_v:g} V") for at in self.stall),
            *self.other_constants,
        )

    @property
    def largest_nm_per_a(self) -> float:
        """Largest published K_t: with i = tau / K_t the torque does not exceed tau for any of them."""
        return max(one.nm_per_a for one in self.published)

    @property
    def no_load_rad_s(self) -> float:
        """No-load speed in rad/s at the recommended voltage."""
        return self.no_load_rpm * 2.0 * math.pi / 60.0


@dataclass(frozen=True, slots=True, kw_only=True)
class _Start:
    """Table defaults of one model that differ from the family."""

    velocity: int
    voltage: tuple[int, int]
    """Lowest and highest limit in 0.1 V."""
    lowest: int | None = None
    """Lower bound of both limits, if it is not the default lower limit."""
    current: int | None = None
    gains: tuple[int, int, int, int, int] = (1920, 100, 0, 0, 800)
    """Gains: velocity I, velocity P, position D, position I, position P."""
    other: dict[str, int] = field(default_factory=dict)

    def table(self, family: ControlTable) -> ControlTable:
        names = ("Velocity I Gain", "Velocity P Gain", "Position D Gain", "Position I Gain", "Position P Gain")
        low, high = self.voltage
        lowest = low if self.lowest is None else self.lowest
        changes: dict[str, dict[str, int | float]] = {
            "Velocity Limit": {"default": self.velocity},
            "Min Voltage Limit": {"default": low, "minimum": lowest, "maximum": high},
            "Max Voltage Limit": {"default": high, "minimum": lowest, "maximum": high},
            **{name: {"default": gain} for name, gain in zip(names, self.gains, strict=True)},
            **{name: {"default": value} for name, value in self.other.items()},
        }
        if self.current is not None:
            changes["Current Limit"] = {"default": self.current, "maximum": self.current}
        return family.changed(changes)


WORKBENCH: Final = Published(
    1.0 / (149.795386991 * 2.69e-3), "ROBOTIS dynamixel-workbench, torque_to_current_value_ratio of the XM430, 2.69 mA"
)
SERVO_MODELS: Final = {
    model.name: model
    for model in (
        ServoModel(
            name="XL330-M077",
            number=1190,
            table=_Start(
                velocity=1620, voltage=(35, 70), lowest=31, current=1750, gains=(400, 40, 0, 400, 400),
                other={"Shutdown": 53},
            ).table(X330_TABLE),
            stall=(Stall(3.7, 0.180, 1.11), Stall(5.0, 0.215, 1.47), Stall(6.0, 0.228, 1.74)),
            no_load_rpm=383,
            fast_read_firmware=46,
        ),
        ServoModel(
            name="XL330-M288",
            number=1200,
            table=_Start(
                velocity=445, voltage=(35, 70), lowest=31, current=1750, gains=(1600, 180, 0, 0, 400),
                other={"Shutdown": 53},
            ).table(X330_TABLE),
            stall=(Stall(3.7, 0.42, 1.11), Stall(5.0, 0.52, 1.47), Stall(6.0, 0.60, 1.74)),
            no_load_rpm=103,
            # At 5 V and stall; 0.378 at 3.7 V, 0.345 at 6 V.
            torque_constant_nm_per_a=0.354,
            fast_read_firmware=46,
        ),
        ServoModel(
            name="XC330-T181",
            number=1210,
            table=_Start(
                velocity=510, voltage=(55, 140), current=910, gains=(1200, 40, 0, 0, 900), other={"PWM Slope": 255}
            ).table(X330_TABLE),
            stall=(Stall(9.0, 0.65, 0.61), Stall(11.1, 0.76, 0.80), Stall(12.0, 0.80, 0.88)),
            no_load_rpm=104,
            # dynamixel-sdk 4.1.0, xc330_t181.model: 0.00067095 N m per unit.
            torque_constant_nm_per_a=0.6709470296,
            fast_read_firmware=46,
        ),
        ServoModel(
            name="XC330-T288",
            number=1220,
            table=_Start(
                velocity=320, voltage=(55, 140), current=910, gains=(1200, 40, 0, 0, 900), other={"PWM Slope": 255}
            ).table(X330_TABLE),
            stall=(Stall(9.0, 0.76, 0.61), Stall(11.1, 0.92, 0.80), Stall(12.0, 1.00, 0.88)),
            no_load_rpm=65,
            # dynamixel-sdk 4.1.0, xc330_t288.model: 0.00096748 N m per unit.
            torque_constant_nm_per_a=0.9674796740,
            other_constants=(Published(1e3 / 1158.73, "FACTR and GELLO, 1158.73 mA per N m"),),
            fast_read_firmware=46,
        ),
        ServoModel(
            name="XC330-M181",
            number=1230,
            table=_Start(
                velocity=545, voltage=(35, 70), lowest=31, current=2352, gains=(1400, 100, 500, 0, 1200)
            ).table(X330_TABLE),
            # The e-Manual overview prints the stall of the XL330-M077 here. The only other figure found is from a
            # public servo list that refers to the model's page.
            stall=(Stall(5.0, 0.60, 1.80),),
            no_load_rpm=129,
            fast_read_firmware=46,
        ),
        ServoModel(
            name="XC330-M288",
            number=1240,
            table=_Start(
                velocity=350, voltage=(35, 70), lowest=31, current=2352, gains=(1600, 50, 500, 0, 1100)
            ).table(X330_TABLE),
            stall=(Stall(3.7, 0.69, 1.34), Stall(5.0, 0.93, 1.80), Stall(6.0, 1.10, 2.15)),
            no_load_rpm=81,
            # At 5 V and stall; 0.515 at 3.7 V, 0.512 at 6 V.
            torque_constant_nm_per_a=0.517,
            fast_read_firmware=46,
        ),
        ServoModel(
            name="XL430-W250",
            number=1060,
            table=_Start(
                velocity=265, voltage=(60, 140), gains=(1000, 100, 4000, 0, 640), other={"Temperature Limit": 72}
            ).table(XL430_TABLE),
            stall=(Stall(9.0, 1.0, 1.0), Stall(11.1, 1.4, 1.3), Stall(12.0, 1.5, 1.4)),
            no_load_rpm=57,
        ),
        ServoModel(
            name="XC430-W150",
            number=1070,
            table=_Start(velocity=460, voltage=(60, 160), gains=(1920, 100, 0, 0, 460)).table(XC430_TABLE),
            stall=(Stall(9.0, 1.2, 1.1), Stall(11.1, 1.4, 1.3), Stall(12.0, 1.6, 1.4)),
            no_load_rpm=99,
        ),
        ServoModel(
            name="XC430-W240",
            number=1080,
            table=_Start(velocity=306, voltage=(60, 160), gains=(1920, 100, 0, 0, 700)).table(XC430_TABLE),
            stall=(Stall(9.0, 1.4, 1.1), Stall(11.1, 1.7, 1.3), Stall(12.0, 1.9, 1.4)),
            no_load_rpm=65,
        ),
        ServoModel(
            name="XM430-W350",
            number=1020,
            table=_Start(velocity=200, voltage=(95, 160), current=1193).table(XM430_TABLE),
            stall=(Stall(11.1, 3.8, 2.1), Stall(12.0, 4.1, 2.3), Stall(14.8, 4.8, 2.7)),
            no_load_rpm=46,
            other_constants=(
                WORKBENCH,
                Published(1.61 / 0.9, "slope of the e-Manual's performance graph, forum.robotis.com/t/5827"),
            ),
        ),
        ServoModel(
            name="XM430-W210",
            number=1030,
            table=_Start(velocity=330, voltage=(95, 160), current=1193).table(XM430_TABLE),
            stall=(Stall(11.1, 2.7, 2.1), Stall(12.0, 3.0, 2.3), Stall(14.8, 3.7, 2.7)),
            no_load_rpm=77,
            # A unit in FACTR's 1000 / 2.69 may be 1 mA, as its comment states, or 2.69 mA, as on this servo, which
            # gives 1.
            other_constants=(WORKBENCH, Published(2.69, "FACTR and GELLO, 1000 / 2.69 mA per N m")),
        ),
        ServoModel(
            name="XM540-W270",
            number=1120,
            table=_Start(velocity=128, voltage=(95, 160), current=2047).table(XM540_TABLE),
            stall=(Stall(11.1, 10.0, 4.2), Stall(12.0, 10.6, 4.4), Stall(14.8, 12.9, 5.5)),
            no_load_rpm=30,
        ),
        ServoModel(
            name="XM540-W150",
            number=1130,
            # Velocity limit from the page of 2018; other models' limits were changed later.
            table=_Start(velocity=380, voltage=(95, 160), current=2047).table(XM540_TABLE),
            stall=(Stall(11.1, 6.9, 4.2), Stall(12.0, 7.3, 4.4), Stall(14.8, 8.9, 5.5)),
            no_load_rpm=53,
        ),
    )
}  # fmt: skip
"""Models by e-Manual name without the connector letter."""

SERVO_MODELS_BY_NUMBER: Final = {model.number: model for model in SERVO_MODELS.values()}
"""Models by the number in a ping answer."""
