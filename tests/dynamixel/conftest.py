"""Shared fixtures: an emulated bus, emulated servos in virtual time, and the description of an arm."""

from collections.abc import Iterator
from pathlib import Path

import pytest
from tests.dynamixel.emulated import EmulatedBus
from tests.dynamixel.test_description import TWO_LINKS
from tests.dynamixel.virtual import World

from haptether.dynamixel.description import ArmDescription, load_arm


@pytest.fixture
def emulated(shared: EmulatedBus) -> EmulatedBus:
    """Reset the bus of a module to its state after the start."""
    return shared.as_new()


@pytest.fixture
def two(tmp_path: Path) -> ArmDescription:
    path = tmp_path / "two.toml"
    path.write_text(TWO_LINKS)
    return load_arm(path)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> Iterator[World]:
    with monkeypatch.context() as patched:
        yield World(patched)
