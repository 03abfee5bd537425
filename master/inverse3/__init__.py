"""Haply Inverse3 through the vendor's service: driver `inverse3`, and an emulated service."""

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from haptether.master.inverse3.driver import Inverse3

__all__ = ["Inverse3"]


def __getattr__(name: str) -> object:
    # The emulator must not load the driver.
    if name == "Inverse3":
        from haptether.master.inverse3.driver import Inverse3  # noqa: PLC0415

        return Inverse3
    message = f"module {__name__!r} has no attribute {name!r}"
    raise AttributeError(message)
