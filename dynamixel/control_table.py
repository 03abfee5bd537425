"""Control tables of the X series: servo registers by address, with units and ranges.

Source: ROBOTIS e-Manual, "Control Table" of each model that `haptether.dynamixel.models` names; addresses and sizes
also in the `.model` files of dynamixel-sdk 4.1.0, which the tests compare.
"""

import math
from dataclasses import dataclass, replace
from typing import Final

RAM: Final = 64
"""First address that is writable while torque is on, and lost at power-off."""
TICKS_PER_TURN: Final = 4096
CENTRE: Final = 2048
"""Position at the mechanical centre, without a homing offset."""
RAD_PER_TICK: Final = 2.0 * math.pi / TICKS_PER_TURN
RAD_S_PER_UNIT: Final = 0.229 * 2.0 * math.pi / 60.0
"""Velocity unit of the tables, 0.229 rev/min."""
MAX_MULTI_TURN: Final = 256 * TICKS_PER_TURN - 1
"""Largest goal position of the multi-turn modes, in either direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Item:
    """Table entry: integer n at an address; n * scale is in `unit`."""

    name: str
    """Name in the e-Manual."""
    address: int
    size: int
    """Size of 1, 2 or 4 bytes, little-endian."""
    signed: bool = False
    """True for two's complement."""
    writable: bool = True
    minimum: int = 0
    maximum: int | None = None
    """Range of writable values; None allows all that fit the size."""
    limit: str | None = None
    """Entry whose value limits the magnitude of this one."""
    unit: str = ""
    scale: float = 1.0
    default: int = 0

    @property
    def is_eeprom(self) -> bool:
        """True if kept at power-off and locked while torque is on."""
        return self.address < RAM

    def encoded(self, value: int) -> bytes:
        """Encode a value.

        Raises:
            ValueError: The value does not fit.
        """
        try:
            return value.to_bytes(self.size, "little", signed=self.signed)
        except OverflowError:
            low = -(1 << (8 * self.size - 1)) if self.signed else 0
            high = (1 << (8 * self.size - self.signed)) - 1
            message = f"{self.name} = {value}: must be {low} to {high}"
            raise ValueError(message) from None

    def decoded(self, encoded: bytes) -> int:
        """Decode a value.

        Raises:
            ValueError: The number of bytes differs.
        """
        if len(encoded) != self.size:
            message = f"{self.name}: {len(encoded)} bytes: must be {self.size}"
            raise ValueError(message)
        return int.from_bytes(encoded, "little", signed=self.signed)


class ControlTable:
    """Entries of a model.

    Args:
        items: Entries without overlap.

    Raises:
        ValueError: Two entries overlap.
    """

    def __init__(self, items: tuple[Item, ...]) -> None:
        self.items = tuple(sorted(items, key=lambda item: item.address))
        self._by_name = {item.name: item for item in self.items}
        self.by_address: dict[int, Item] = {}
        """Entry of each byte."""
        for item in self.items:
            for address in range(item.address, item.address + item.size):
                if address in self.by_address:
                    message = f"{item.name}: address {address} belongs to {self.by_address[address].name}"
                    raise ValueError(message)
                self.by_address[address] = item
        self.size = max(self.by_address) + 1
        """Size in bytes up to the end of the last entry."""

    def __getitem__(self, name: str) -> Item:
        """Return an entry by name.

        Raises:
            KeyError: The model has no such entry.
        """
        return self._by_name[name]

    def __contains__(self, name: str) -> bool:
        return name in self._by_name

    def changed(self, changes: dict[str, dict[str, int | float]], without: tuple[str, ...] = ()) -> "ControlTable":
        """Return a copy with changed fields of some entries, and without others."""
        return ControlTable(
            tuple(
                replace(item, **changes.get(item.name, {}))  # type: ignore[arg-type]
                for item in self.items
                if item.name not in without
            )
        )

    def extended(self, *items: Item) -> "ControlTable":
        """Return a copy with additional entries."""
        return ControlTable((*self.items, *items))


def _indirect(address: int, to: int, count: int, last: int, first: int = 1) -> tuple[Item, ...]:
    """Return indirect addresses and their data; initially each targets itself."""
    return tuple(
        item
        for index in range(count)
        for item in (
            Item(
                name=f"Indirect Address {first + index}", address=address + 2 * index, size=2,
                minimum=RAM, maximum=last, default=to + index,
            ),
            Item(name=f"Indirect Data {first + index}", address=to + index, size=1),
        )
    )  # fmt: skip


MAX_GAIN: Final = 16383
MAX_PROFILE: Final = 32767

_COMMON: Final = ControlTable(
    (
        Item(name="Model Number", address=0, size=2, writable=False),
        Item(name="Model Information", address=2, size=4, writable=False),
        Item(name="Firmware Version", address=6, size=1, writable=False),
        Item(name="ID", address=7, size=1, maximum=252, default=1),
        Item(name="Baud Rate", address=8, size=1, maximum=7, default=1),
        Item(name="Return Delay Time", address=9, size=1, maximum=254, default=250, unit="s", scale=2e-6),
        Item(name="Drive Mode", address=10, size=1, maximum=13),
        Item(name="Operating Mode", address=11, size=1, maximum=16, default=3),
        # 253 and above disables it.
        Item(name="Secondary(Shadow) ID", address=12, size=1, maximum=255, default=255),
        Item(name="Protocol Type", address=13, size=1, minimum=1, maximum=2, default=2),
        Item(
            name="Homing Offset", address=20, size=4, signed=True, minimum=-1_044_479, maximum=1_044_479,
            unit="rad", scale=RAD_PER_TICK,
        ),
        Item(
            name="Moving Threshold", address=24, size=4, maximum=1023, default=10, unit="rad/s", scale=RAD_S_PER_UNIT
        ),
        Item(name="Temperature Limit", address=31, size=1, maximum=100, default=80, unit="degC"),
        Item(name="Max Voltage Limit", address=32, size=2, minimum=95, maximum=160, default=160, unit="V", scale=0.1),
        Item(name="Min Voltage Limit", address=34, size=2, minimum=95, maximum=160, default=95, unit="V", scale=0.1),
        Item(name="PWM Limit", address=36, size=2, maximum=885, default=885, unit="%", scale=0.113),
        Item(name="Current Limit", address=38, size=2, maximum=1193, default=1193, unit="A", scale=2.69e-3),
        Item(name="Velocity Limit", address=44, size=4, maximum=1023, default=200, unit="rad/s", scale=RAD_S_PER_UNIT),
        Item(name="Max Position Limit", address=48, size=4, maximum=4095, default=4095, unit="rad", scale=RAD_PER_TICK),
        Item(name="Min Position Limit", address=52, size=4, maximum=4095, unit="rad", scale=RAD_PER_TICK),
        Item(name="Shutdown", address=63, size=1, default=52),
        Item(name="Torque Enable", address=64, size=1, maximum=1),
        Item(name="LED", address=65, size=1, maximum=1),
        Item(name="Status Return Level", address=68, size=1, maximum=2, default=2),
        Item(name="Registered Instruction", address=69, size=1, writable=False),
        Item(name="Hardware Error Status", address=70, size=1, writable=False),
        Item(name="Velocity I Gain", address=76, size=2, maximum=MAX_GAIN, default=1920),
        Item(name="Velocity P Gain", address=78, size=2, maximum=MAX_GAIN, default=100),
        Item(name="Position D Gain", address=80, size=2, maximum=MAX_GAIN),
        Item(name="Position I Gain", address=82, size=2, maximum=MAX_GAIN),
        Item(name="Position P Gain", address=84, size=2, maximum=MAX_GAIN, default=800),
        Item(name="Feedforward 2nd Gain", address=88, size=2, maximum=MAX_GAIN),
        Item(name="Feedforward 1st Gain", address=90, size=2, maximum=MAX_GAIN),
        # -1 after it has tripped.
        Item(name="Bus Watchdog", address=98, size=1, signed=True, maximum=127, unit="s", scale=0.02),
        Item(name="Goal PWM", address=100, size=2, signed=True, limit="PWM Limit", unit="%", scale=0.113),
        Item(name="Goal Current", address=102, size=2, signed=True, limit="Current Limit", unit="A", scale=2.69e-3),
        Item(
            name="Goal Velocity", address=104, size=4, signed=True, limit="Velocity Limit", unit="rad/s",
            scale=RAD_S_PER_UNIT,
        ),
        # rev/min^2 in rad/s^2.
        Item(
            name="Profile Acceleration", address=108, size=4, maximum=MAX_PROFILE, unit="rad/s2",
            scale=214.577 * 2.0 * math.pi / 3600.0,
        ),
        Item(
            name="Profile Velocity", address=112, size=4, maximum=MAX_PROFILE, unit="rad/s", scale=RAD_S_PER_UNIT
        ),
        # Multi-turn modes; in mode 3 the position limits apply.
        Item(
            name="Goal Position", address=116, size=4, signed=True, minimum=-MAX_MULTI_TURN, maximum=MAX_MULTI_TURN,
            unit="rad", scale=RAD_PER_TICK,
        ),
        Item(name="Realtime Tick", address=120, size=2, writable=False, unit="s", scale=1e-3),
        Item(name="Moving", address=122, size=1, writable=False),
        Item(name="Moving Status", address=123, size=1, writable=False),
        Item(name="Present PWM", address=124, size=2, signed=True, writable=False, unit="%", scale=0.113),
        Item(name="Present Current", address=126, size=2, signed=True, writable=False, unit="A", scale=2.69e-3),
        Item(
            name="Present Velocity", address=128, size=4, signed=True, writable=False, unit="rad/s",
            scale=RAD_S_PER_UNIT,
        ),
        Item(
            name="Present Position", address=132, size=4, signed=True, writable=False, unit="rad", scale=RAD_PER_TICK
        ),
        Item(
            name="Velocity Trajectory", address=136, size=4, signed=True, writable=False, unit="rad/s",
            scale=RAD_S_PER_UNIT,
        ),
        Item(
            name="Position Trajectory", address=140, size=4, signed=True, writable=False, unit="rad",
            scale=RAD_PER_TICK,
        ),
        Item(name="Present Input Voltage", address=144, size=2, writable=False, unit="V", scale=0.1),
        Item(name="Present Temperature", address=146, size=1, writable=False, unit="degC"),
    )
)  # fmt: skip

# Same for every model; the present current is a load in servos without current control.
HOMING_OFFSET: Final = _COMMON["Homing Offset"].address
TORQUE_ENABLE: Final = _COMMON["Torque Enable"].address
HARDWARE_STATUS: Final = _COMMON["Hardware Error Status"].address
STATUS_SIZE: Final = HARDWARE_STATUS + 1 - TORQUE_ENABLE
"""Bytes from Torque Enable to Hardware Error Status."""
STATUS_RETURN_LEVEL: Final = _COMMON["Status Return Level"].address
BUS_WATCHDOG: Final = _COMMON["Bus Watchdog"].address
GOAL_PWM: Final = _COMMON["Goal PWM"].address
GOAL_CURRENT: Final = _COMMON["Goal Current"].address
GOAL_POSITION: Final = _COMMON["Goal Position"].address
PRESENT_CURRENT: Final = _COMMON["Present Current"].address
PRESENT_POSITION: Final = _COMMON["Present Position"].address
PRESENT_TEMPERATURE: Final = _COMMON["Present Temperature"].address

_STARTUP: Final = Item(name="Startup Configuration", address=60, size=1, maximum=3)
"""Older firmware refuses to read it."""
_BACKUP: Final = Item(name="Backup Ready", address=147, size=1, writable=False)
_LARGE_INDIRECT: Final = (*_indirect(168, 224, 28, 661), *_indirect(578, 634, 28, 661, first=29))

XM430_TABLE: Final = _COMMON.extended(_STARTUP, *_LARGE_INDIRECT)
"""XM430: current control in 2.69 mA."""
XM540_TABLE: Final = XM430_TABLE.extended(
    *(Item(name=f"External Port Mode {n}", address=55 + n, size=1, maximum=3, default=3) for n in (1, 2, 3)),
    *(Item(name=f"External Port Data {n}", address=150 + 2 * n, size=2) for n in (1, 2, 3)),
)
"""XM540: XM430 with three pins."""
XC430_TABLE: Final = (
    _COMMON.changed({}, without=("Current Limit", "Goal Current", "Present Current"))
    .extended(
        Item(name="Present Load", address=126, size=2, signed=True, writable=False, unit="%", scale=0.1),
        _STARTUP,
        *_LARGE_INDIRECT,
    )
)  # fmt: skip
"""XC430: no current control; an inferred load replaces the current."""
XL430_TABLE: Final = XC430_TABLE.extended(_BACKUP)
"""XL430: XC430 with the registers of newer firmware."""
X330_TABLE: Final = _COMMON.changed(
    {
        "Baud Rate": {"maximum": 6},
        "Protocol Type": {"minimum": 2, "maximum": 22},
        "Current Limit": {"scale": 1e-3},
        "Goal Current": {"scale": 1e-3},
        "Present Current": {"scale": 1e-3},
        "Velocity Limit": {"maximum": 2047},
        "Temperature Limit": {"default": 70},
    }
).extended(
    _STARTUP,
    Item(name="PWM Slope", address=62, size=1, minimum=1, maximum=255, default=140),
    _BACKUP,
    *_indirect(168, 208, 20, 227),
)
"""XL330 and XC330: current control in 1 mA, 20 indirect addresses (firmware 52; older firmware differs)."""
