"""Bound of the speed of a device after a release, computed from settings: `docs/ejection_bound.md`."""
