"""Haply Inverse3 through the vendor's service: driver `inverse3`, and an emulated service."""

from typing import TYPE_CHECKING

from haptether.lazy_names import lazy_names

if TYPE_CHECKING:
    from haptether.master.inverse3.driver import Inverse3

__all__ = ["Inverse3"]

if not TYPE_CHECKING:  # otherwise a type checker would accept any name
    # The emulator must not load the driver.
    __getattr__, __dir__ = lazy_names(__name__)
