"""Common parts of drivers on a vendor's C library: loading, faults and recovery."""

from haptether.master.vendor.device import BadSampleError, LostError, VendorDevice
from haptether.master.vendor.library import Function, Vendor, load_library

__all__ = ["BadSampleError", "Function", "LostError", "Vendor", "VendorDevice", "load_library"]
