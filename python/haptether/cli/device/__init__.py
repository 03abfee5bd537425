"""Commands about drivers of devices: `check-device`, `identify`."""
