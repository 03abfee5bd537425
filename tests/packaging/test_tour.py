"""Files named in the documents exist, and names beside a file in the tour are defined in that file."""

import re
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
TOUR = ROOT / "docs" / "tour.md"
PAGES = sorted([ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "SECURITY.md", *(ROOT / "docs").rglob("*.md")])
FILE = re.compile(r"[\w.-]+(?:/[\w.-]+)+\.(?:rs|py|pyi|md|toml)")
NOT_YET = {
    "safety/src/controller/speed.rs",
    "bridge/src/coupling/method/registry/spring.rs",
    "netsim/src/impairments/micro_fade.rs",
    "src/my_stylus/driver.py",
}
"""The files that CONTRIBUTING shows how to add, and a file of `haptether new-driver`."""
DEFINITIONS = {
    ".rs": r"\b(?:fn|struct|enum|trait|type|const|static)\s+{name}\b",
    ".py": r"^\s*(?:(?:async\s+)?def|class)\s+{name}\b|^{name}\s*[:=]",
}
PASSAGE = re.compile(r"\n\s*\n|\n(?=\d+\. )|\n(?=\|)|\n(?=#)")
"""Separator of steps, rows, headings or paragraphs: a name belongs to the file before it in its own passage."""


def missing_files(text: str) -> Iterator[str]:
    """Yield files in backticks that do not exist."""
    for quoted in re.findall(r"`([^`\n]+)`", text):
        if FILE.fullmatch(quoted) and quoted not in NOT_YET and not (ROOT / quoted).is_file():
            yield quoted


def named_beside_files(text: str) -> Iterator[tuple[str, str]]:
    """Yield each name in backticks with the file before it."""
    for passage in PASSAGE.split(text):
        file = None
        for quoted in re.findall(r"`([^`]+)`", passage):
            if FILE.fullmatch(quoted):
                file = quoted
            elif file is not None and re.fullmatch(r"[A-Za-z]\w{2,}", quoted):
                yield file, quoted


def is_defined(file: str, name: str) -> bool:
    """Return true if a file of the tree defines a function, type or constant of that name."""
    pattern = DEFINITIONS[Path(file).suffix].format(name=re.escape(name))
    return re.search(pattern, (ROOT / file).read_text(), re.MULTILINE) is not None


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.name)
def test_files_that_a_page_names_exist(page: Path) -> None:
    assert not list(missing_files(page.read_text()))


def test_what_the_tour_names_is_defined_where_it_says() -> None:
    named = list(named_beside_files(TOUR.read_text()))
    assert len(named) > 100
    assert not [pair for pair in named if not is_defined(*pair)]


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("1. `bridge/src/side.rs` `MasterSide`, `tick`: steps", []),
        ("1. `bridge/src/side.rs` `MasterSite`, `tick`: steps", ["MasterSite"]),
        ("1. `bridge/src/side.rs` `tick`,\n   `stop_all`: steps\n2. `bridge/src/wire.rs` `Frame`", ["stop_all"]),
        ("| stop | `slave/ur/stop.py` `SoftStop`; `slave/ur/driver.py` `SoftStop` |", ["SoftStop"]),
        ("`python/haptether/cli/entry.py` `COMMANDS`, `COMMAND`", ["COMMAND"]),
    ],
)
def test_a_wrong_name_is_found(text: str, wrong: list[str]) -> None:
    assert [name for file, name in named_beside_files(text) if not is_defined(file, name)] == wrong


def test_a_file_that_has_moved_is_found() -> None:
    text = "`bridge/src/side.rs`, `bridge/src/sides.rs`, `side.rs`, `bridge/scenes/`, `docs/tour.md`"
    assert list(missing_files(text)) == ["bridge/src/sides.rs"]
