"""Each picture of the documents is there, is shown, and can be made anew."""

import re
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.images.makers import MAKERS, ROOT

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
