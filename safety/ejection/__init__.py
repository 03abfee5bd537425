"""A bound on the speed of a device that a hand has let go, from settings alone: `docs/ejection_bound.md`."""
