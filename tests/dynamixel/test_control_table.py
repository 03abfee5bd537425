"""Control tables and models, against the lists of the vendor's client and the figures of the e-Manual."""

import csv
import math
from importlib import resources

import pytest
from hypothesis import given
from hypothesis import strategies as st

from haptether.dynamixel import (
    BAUD_RATES,
    SERVO_MODELS,
    SERVO_MODELS_BY_NUMBER,
    ControlTable,
    Item,
    OperatingMode,
    ServoModel,
)

MODELS = list(SERVO_MODELS.values())
by_model = pytest.mark.parametrize("model", MODELS, ids=lambda model: model.name)
NAMES_BY_SDK = {"Indirect Address Write", "Indirect Data Write", "Indirect Address Read", "Indirect Data Read"}
"""Names in the client's lists for ranges of indirect entries, not for single addresses."""


def listed_by_sdk(name: str) -> dict[str, tuple[int, int]]:
    """Return address and size of each entry, by name."""
    folder = resources.files("dynamixel_easy_sdk") / "control_table"
    stem = name.lower().replace("-", "_")
    files = [folder / f"{stem}_fw52.model", folder / f"{stem}.model"]
    text = next(file for file in files if file.is_file()).read_text(encoding="utf-8")
    lines = text.replace("\r", "").partition("[control table]\n")[2].splitlines()
    rows = list(csv.reader(lines, delimiter="\t"))
    assert rows[0] == ["Address", "Size", "Data Name"]
    return {row[2]: (int(row[0]), int(row[1])) for row in rows[1:] if len(row) == 3 and row[2] not in NAMES_BY_SDK}


@by_model
def test_addresses_and_sizes_are_those_of_the_vendors_client(model: ServoModel) -> None:
    listed = listed_by_sdk(model.name)
    assert len(listed) > 50
    ours = {item.name: (item.address, item.size) for item in model.table.items}
    assert {name: ours.get(name) for name in listed} == listed


@by_model
def test_what_the_vendors_client_does_not_list_is_little(model: ServoModel) -> None:
    further = {item.name for item in model.table.items if not item.name.startswith("Indirect")}
    assert further - set(listed_by_sdk(model.name)) <= {"Startup Configuration", "Backup Ready"}


def test_model_numbers() -> None:
    numbers = {
        "XL330-M077": 1190, "XL330-M288": 1200, "XC330-T181": 1210, "XC330-T288": 1220, "XC330-M181": 1230,
        "XC330-M288": 1240, "XL430-W250": 1060, "XC430-W150": 1070, "XC430-W240": 1080, "XM430-W350": 1020,
        "XM430-W210": 1030, "XM540-W270": 1120, "XM540-W150": 1130,
    }  # fmt: skip
    assert {model.name: model.number for model in MODELS} == numbers
    assert {number: model.name for number, model in SERVO_MODELS_BY_NUMBER.items()} == {
        number: name for name, number in numbers.items()
    }


@by_model
def test_defaults_are_values_that_may_be_written(model: ServoModel) -> None:
    for item in model.table.items:
        assert item.decoded(item.encoded(item.default)) == item.default
        if item.writable and item.maximum is not None:
            assert item.minimum <= item.default <= item.maximum, item.name
        if item.limit is not None:
            assert item.limit in model.table


@pytest.mark.parametrize(
    ("name", "unit_a", "max_a", "ratio", "no_load"),
    [
        # Source: e-Manual, stall and no-load speed at the recommended voltage, current limits.
        ("XL330-M288", 1e-3, 1.75, 0.52 / 1.47, 103),
        ("XC330-T288", 1e-3, 0.91, 0.92 / 0.80, 65),
        ("XC330-M288", 1e-3, 2.352, 0.93 / 1.80, 81),
        ("XM430-W350", 2.69e-3, 1193 * 2.69e-3, 4.1 / 2.3, 46),
        ("XM540-W270", 2.69e-3, 2047 * 2.69e-3, 10.6 / 4.4, 30),
        ("XL430-W250", None, None, 1.4 / 1.3, 57),
    ],
)
def test_motor_figures(name: str, unit_a: float | None, max_a: float | None, ratio: float, no_load: float) -> None:
    model = SERVO_MODELS[name]
    assert model.current_unit_a == unit_a
    assert model.max_current_a == (None if max_a is None else pytest.approx(max_a))
    assert model.stall_ratio_nm_per_a == pytest.approx(ratio)
    assert model.no_load_rad_s == pytest.approx(no_load * math.pi / 30.0)
    assert model.has_current_control == (unit_a is not None)
    assert (OperatingMode.CURRENT in model.operating_modes) == model.has_current_control


def test_units() -> None:
    table = SERVO_MODELS["XM430-W350"].table
    for name, unit, scale in (("Present Position", "rad", 0.0015339808), ("Present Velocity", "rad/s", 0.0239808)):
        assert table[name].unit == unit
        assert table[name].scale == pytest.approx(scale, rel=1e-5)
    assert (table["Bus Watchdog"].unit, table["Bus Watchdog"].scale) == ("s", 0.02)
    assert (table["Return Delay Time"].unit, table["Return Delay Time"].scale) == ("s", 2e-6)
    assert table["Current Limit"].is_eeprom
    assert not table["Goal Current"].is_eeprom
    assert BAUD_RATES[1] == 57_600


def test_two_entries_at_one_address_are_refused() -> None:
    with pytest.raises(ValueError, match="b: address 11 belongs to a"):
        ControlTable((Item(name="a", address=10, size=2), Item(name="b", address=11, size=1)))


@given(st.integers(-(2**40), 2**40), st.sampled_from([1, 2, 4]), st.booleans())
def test_bytes_of_a_value(value: int, size: int, signed: bool) -> None:
    item = Item(name="entry", address=64, size=size, signed=signed)
    low, high = (-(2 ** (8 * size - 1)), 2 ** (8 * size - 1) - 1) if signed else (0, 2 ** (8 * size) - 1)
    if low <= value <= high:
        assert item.decoded(item.encoded(value)) == value
    else:
        with pytest.raises(ValueError, match=f"entry = {value}: must be {low} to {high}"):
            item.encoded(value)
    with pytest.raises(ValueError, match=f"{size + 1} bytes: must be {size}"):
        item.decoded(bytes(size + 1))
