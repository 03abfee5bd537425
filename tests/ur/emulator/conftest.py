"""Emulated controllers: in virtual time, or as a process that the tests of a module share."""

from collections.abc import Iterator

import pytest
from tests.ur.emulated import Emulated, emulator
from tests.ur.virtual import World


@pytest.fixture
def world() -> World:
    return World()


@pytest.fixture(scope="module")
def shared(request: pytest.FixtureRequest) -> Iterator[Emulated]:
    """Run the emulator with the module's options in EMULATOR."""
    with emulator(*getattr(request.module, "EMULATOR", ())) as running:
        yield running


@pytest.fixture
def arm(shared: Emulated) -> Emulated:
    shared.do("reset")
    return shared
