"""Drivers of devices in Python: found, opened, and led by a loop."""
