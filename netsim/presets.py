"""Networks that were measured."""

from types import MappingProxyType

PRESETS: MappingProxyType[str, object] = MappingProxyType({})
