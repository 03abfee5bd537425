"""A Chromium for the tests of a module only: while it is open, no other test can start an event loop."""

from pathlib import Path
from typing import TYPE_CHECKING

import pytest
from tests.view.console.browser import chromium
from tests.view.console.served import Served, served

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    with chromium() as found:
        yield found


@pytest.fixture
def runs(tmp_path: Path) -> "Iterator[Served]":
    """Two sides and a console for one test."""
    with served(tmp_path) as found:
        yield found
