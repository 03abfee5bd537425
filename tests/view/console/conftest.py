"""Two sides and a console for a test."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.view.console.served import Served, served


@pytest.fixture
def runs(tmp_path: Path) -> Iterator[Served]:
    """Two sides and a console for one test."""
    with served(tmp_path) as found:
        yield found
