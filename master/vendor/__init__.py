"""What drivers through a vendor's C library share: how it is found, and how a device of it faults and comes back."""

from haptether.master.vendor.device import BadSampleError, LostError, VendorDevice
from haptether.master.vendor.library import Function, Vendor, load_library

__all__ = ["BadSampleError", "Function", "LostError", "Vendor", "VendorDevice", "load_library"]
