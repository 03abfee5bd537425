"""Each picture of the documents exists, is shown, and has a maker."""

import json
import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.images.makers import MAKERS, ROOT
from tests.images.numbers import COMMANDS, KEPT, SLOW, output, sha256

IMAGES = ROOT / "docs" / "images"
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").glob("*.md")])
SHOWN = {
    (page.parent / target).resolve()
    for page in PAGES
    for target in re.findall(r"!\[[^\]]+\]\((?!https?:)([^)]+)\)", page.read_text())
}


def test_pictures_that_are_kept_are_those_that_are_shown_and_those_that_can_be_made() -> None:
    kept = {path.name for path in IMAGES.iterdir()}
    assert {path.name for path in SHOWN} == kept
    assert set(MAKERS) == kept
    assert {path.parent for path in SHOWN} == {IMAGES}


@pytest.mark.parametrize("path", sorted(IMAGES.iterdir()), ids=lambda path: path.name)
def test_a_picture_is_one(path: Path) -> None:
    with Image.open(path) as picture:
        picture.load()
        assert min(picture.size) >= 300
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


NUMBERS = json.loads(KEPT.read_text())
OF_COMMANDS = sorted({command for commands in COMMANDS.values() for command in commands})
WITHOUT_NUMBERS = {"flame_remote_push.png", "try.png", "work_precision.png"}


def test_pictures_are_those_that_were_made_with_the_numbers() -> None:
    assert {path.name: sha256(path) for path in IMAGES.iterdir()} == NUMBERS["pictures"], "run `make images`"
    assert set(COMMANDS) == set(MAKERS) - WITHOUT_NUMBERS
    assert sorted(NUMBERS["commands"]) == OF_COMMANDS


@pytest.mark.parametrize(
    "command",
    [pytest.param(command, marks=[pytest.mark.thorough] if command in SLOW else []) for command in OF_COMMANDS],
)
def test_numbers_behind_a_picture_are_those_of_the_product(command: str) -> None:
    assert output(command) == NUMBERS["commands"][command], "picture and product differ: run `make images`"
