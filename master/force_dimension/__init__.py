"""Force Dimension omega, delta and sigma through the vendor's SDK: driver `force-dimension`."""

from haptether.master.force_dimension.driver import ForceDimension

__all__ = ["ForceDimension"]
