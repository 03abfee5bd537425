"""A Chromium for the tests of a module only: while it is open, no other test can start an event loop."""

from typing import TYPE_CHECKING

import pytest
from tests.view.console.browser import chromium

if TYPE_CHECKING:
    from collections.abc import Iterator

    from playwright.sync_api import Browser


@pytest.fixture(scope="module")
def browser() -> "Iterator[Browser]":
    with chromium() as found:
        yield found
