"""`Rows`: at every terminal width nothing is cut, and no number is broken."""

import io
import re

import pytest
from hypothesis import given
from hypothesis import strategies as st
from rich.cells import cell_len
from rich.text import Text

from haptether.cli.shared.screen import Screen
from haptether.cli.shared.table import Column, Rows


def shown(table: Rows, width: int, **how: object) -> str:
    file = io.StringIO()
    Screen(file=file, width=width, color_system=None, **how).print(table)
    return file.getvalue()


NUMBERS = st.floats(-1e12, 1e12).map(lambda value: f"{value:.6g}")
WORDS = st.lists(st.text("abcdefghij", min_size=1, max_size=30), min_size=1, max_size=8).map(" ".join)


@given(st.data(), st.integers(40, 120))
def test_nothing_is_cut_at_any_width(data: st.DataObject, width: int) -> None:
    kinds = data.draw(st.lists(st.booleans(), min_size=1, max_size=9))
    columns = [Column(data.draw(WORDS), numbers=kind) for kind in kinds]
    cells = data.draw(st.lists(st.tuples(*(NUMBERS if kind else WORDS for kind in kinds)), min_size=1, max_size=4))
    table = Rows(*columns, keys=data.draw(st.integers(1, 2)), gap=data.draw(st.integers(1, 2)))
    for row in cells:
        table.add(*row)
    text = shown(table, width)
    assert all(cell_len(line) <= width for line in text.splitlines())
    for row in cells:
        for kind, cell in zip(kinds, row, strict=True):
            if kind:
                assert re.search(rf"(?<![\w.+-]){re.escape(cell)}(?![\w.+-])", text), cell
    letters = sum(len(re.sub(r"[^a-j]", "", cell)) for row in cells for cell in row)
    assert sum(character in "abcdefghij" for character in text) >= letters


@pytest.mark.parametrize("width", [40, 60, 80])
def test_numbers_among_text_stay_whole(width: int) -> None:
    table = Rows("", "")
    value = "1.5 / 12345.670 / -12345.670e-12 and 123456789 of 987654321 (1.00%)"
    table.add("a name of many words that takes what it is given", value)
    text = shown(table, width)
    assert all(number in text for number in ("12345.670", "-12345.670e-12", "123456789", "987654321", "(1.00%)"))


def test_a_table_that_fits_is_one_and_as_narrow_as_it_can_be() -> None:
    table = Rows("controller", Column("wsc [N]", numbers=True), Column("hsc [N]", numbers=True))
    table.add("force", "1.25", "-3.5")
    assert shown(table, 80) == (
        "controller  wsc [N]  hsc [N]\n────────────────────────────\nforce          1.25     -3.5\n"
    )


def test_a_wide_table_becomes_a_long_one() -> None:
    names = [f"environment.objects.{number}.stiffness" for number in range(5)]
    table = Rows("scene", *(Column(name, numbers=True) for name in names))
    table.add("push", *(f"{number}.123456789" for number in range(5)))
    text = shown(table, 40)
    assert text.count("push") > 1
    assert all(f"{number}.123456789" in text for number in range(5))
    records = Rows("a", "b", "c", "d", keys=3)
    records.add("one two three four", "five six seven eight", "nine ten eleven", "twelve thirteen")
    assert shown(records, 40).splitlines()[:2] == ["a: one two three four", "b: five six seven eight"]


def test_no_cell_acts_on_the_terminal_and_colours_are_kept() -> None:
    table = Rows("\x1b[31mname", "value")
    table.add("\x1b]0;x\x07", Text("holds", style="green"))
    text = shown(table, 40, force_terminal=False)
    assert "\x1b" not in text
    assert "holds" in text


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="1 cells for 2 columns"):
        Rows("a", "b").add("1")


def test_every_table_of_the_command_line_is_made_here() -> None:
    from pathlib import Path

    import haptether.cli

    folder = Path(haptether.cli.__file__).parent
    makers = [path.name for path in folder.rglob("*.py") if re.search(r"rich\.table|\bTable\(", path.read_text())]
    assert makers == ["table.py"]
